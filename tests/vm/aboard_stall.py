"""Runs in the machine: a scanner's datagrams at the highest rate recorded here, and a stalled recorder."""

from __future__ import annotations

import os
import signal
import socket
import struct
import time
from pathlib import Path

from tests.vm.aboard import keep, main, recording, session, sh, wait_until

PORT = 7777
DATAGRAM_BYTES = 1206
SCANNER = f"""
[scanner.left]
transport = "udp:127.0.0.1:{PORT}"
protocol = "srep"
mirror_factor = 1.0
"""
RATES = (250, 500, 1000, 2000, 4000, 8000, 16000)
STALL_S = 0.5
DEFAULT_BUFFER_BYTES = 212_992


class Scanner:
    """Sends numbered datagrams."""

    def __init__(self) -> None:
        os.sched_setaffinity(0, {0})  # loopback keeps the order of one processor's datagrams only
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect(("127.0.0.1", PORT))
        self._rest = bytes(DATAGRAM_BYTES - 8)
        self.sent = 0

    def send(self, rate_hz: int, seconds: float) -> bool:
        """Send in real time, in bursts of up to 10 ms, and return whether the pace was held."""
        count, begin_s = round(rate_hz * seconds), time.monotonic()
        for number in range(count):
            left_s = begin_s + number / rate_hz - time.monotonic()
            if left_s > 0.01:
                time.sleep(left_s)
            self._socket.send(struct.pack("<Q", self.sent) + self._rest)
            self.sent += 1
        return time.monotonic() - begin_s < 1.1 * seconds


def _socket_row() -> list[str]:
    rows = [line.split() for line in Path("/proc/net/udp").read_text().splitlines()[1:]]
    return next(row for row in rows if row[1].endswith(f":{PORT:04X}"))


def drained() -> int:
    """Wait until the recorder has read everything, and return how many units the kernel dropped at its socket."""
    wait_until(lambda: _socket_row()[4].endswith(":00000000"), "an empty queue")
    return int(_socket_row()[12])


def stall() -> None:
    """Find the highest rate without loss, then stall at it with the installed settings and the kernel's default."""
    with recording(session("installed") + SCANNER, "installed") as recorder:
        recorder.wait_said("device_opened")
        scanner = Scanner()
        best = 0
        for rate_hz in RATES:
            held = scanner.send(rate_hz, 2.0)
            if drained() or not held:
                break
            best = rate_hz
        assert best, "it records no rate without loss"
        drops_before = drained()
        recorder.process.send_signal(signal.SIGSTOP)
        begin_s, first = time.monotonic(), scanner.sent
        scanner.send(best, STALL_S)
        stood_s = time.monotonic() - begin_s
        recorder.process.send_signal(signal.SIGCONT)
        in_stall = scanner.sent - first
        scanner.send(best, 0.5)
        installed = {"sent": scanner.sent, "before": drops_before, "drops": drained(), "stood_s": stood_s}
        time.sleep(1.5)
    sh(f"sysctl -w net.core.rmem_max={DEFAULT_BUFFER_BYTES}")
    with recording(session("default") + SCANNER, "default") as recorder:
        recorder.wait_said("device_opened")
        scanner = Scanner()
        scanner.send(best, 0.5)
        recorder.process.send_signal(signal.SIGSTOP)
        scanner.send(best, STALL_S)
        for _ in range(2):  # a slow machine's rate may not fill the buffer
            scanner.send(16_000, 0.05)
        recorder.process.send_signal(signal.SIGCONT)
        drained()
        scanner.send(best, 0.5)
        default = {"sent": scanner.sent, "drops": drained()}
        time.sleep(1.5)
    keep("told", {"rate_hz": best, "in_stall": in_stall, "installed": installed, "default": default})


if __name__ == "__main__":
    main({"stall": stall})
