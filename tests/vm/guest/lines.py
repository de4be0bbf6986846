"""Connects a flight outside the machine: CAN frames from a TCP stream, PPS at the moments it has outside.

    lines.py CAN_INTERFACE CAN_PORT CLOCK_HOST:CLOCK_PORT

Whoever connects to CAN_PORT sends frames of 16 bytes (struct can_frame), one after the other. The clock is asked over
UDP and answers with sixteen bytes: its wall clock, and the phase of its pulses within its second (-1: none yet), both
in ns. pps_sim is adjusted every two seconds so that its pulses have that phase.
"""

from __future__ import annotations

import socket
import struct
import sys
import threading
import time
from pathlib import Path

PPS = Path("/sys/module/pps_sim/parameters")
NANO = 1_000_000_000
ASKED, EVERY_S = 20, 2.0


def feed_can(interface: str, port: int) -> None:
    """Forward frames until the stream ends."""
    bus = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    bus.bind((interface,))
    with socket.create_server(("0.0.0.0", port)) as server:
        stream = server.accept()[0]
    stream.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    rest = b""
    while data := stream.recv(65536):
        rest += data
        for at in range(0, len(rest) - len(rest) % 16, 16):
            send(bus, rest[at : at + 16])
        rest = rest[len(rest) - len(rest) % 16 :]


def send(bus: socket.socket, frame: bytes) -> None:
    """Send one frame, and wait while the queue is full."""
    while True:
        try:
            bus.send(frame)
            return
        except OSError as error:
            if error.errno != 105:  # ENOBUFS
                raise
            time.sleep(0.001)


def asked(sock: socket.socket) -> tuple[int, int, int]:
    """Return round-trip time, clock difference and phase of the other's pulses, all in ns."""
    sock.send(b"?")
    before = time.time_ns()
    try:
        other_ns, phase_ns = struct.unpack("<qq", sock.recv(16))
    except TimeoutError:
        return 1 << 62, 0, -1
    after = time.time_ns()
    return after - before, (before + after) // 2 - other_ns, phase_ns


def follow(clock: str) -> None:
    """Keep the pulses where they are outside."""
    host, port = clock.split(":")
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.settimeout(0.5)
    sock.connect((host, int(port)))
    (PPS / "on").write_text("0")
    while True:
        _, ahead_ns, phase_ns = min(asked(sock) for _ in range(ASKED))
        if phase_ns >= 0:
            (PPS / "offset_ns").write_text(str((phase_ns + ahead_ns) % NANO))
            (PPS / "on").write_text("1")
        time.sleep(EVERY_S)


def main() -> None:
    """Run until the power is cut."""
    interface, port, clock = sys.argv[1:]
    threading.Thread(target=feed_can, args=(interface, int(port)), daemon=True).start()
    follow(clock)


if __name__ == "__main__":
    main()
