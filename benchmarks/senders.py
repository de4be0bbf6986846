"""Send loads for the recording benchmarks, each from a process of its own: datagrams by sendmmsg(2), and CAN frames.

python -m benchmarks.senders udp PORT BYTES RATE SECONDS   prints the number sent and the seconds it took
python -m benchmarks.senders vlp16 PORT FILE RATE SECONDS  the same, with a head's datagram, stamped anew each time
python -m benchmarks.senders file PORT BYTES FILE RATE SECONDS  the same, with a file of datagrams, again and again
python -m benchmarks.senders can CHANNEL RATE SECONDS      prints the number sent
"""

from __future__ import annotations

import ctypes
import os
import socket
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from swath.georef.records import ByteRows

_libc = ctypes.CDLL(None, use_errno=True)
_SLOTS = 256
_VLP16_STAMP = 1200  # offset of the microseconds past the hour, u32 (VLP-16 User Manual, 9.3.1.4)
_HEADER = np.dtype(
    {
        "names": ["iov", "iovlen"],
        "formats": [np.uintp, np.uintp],
        "offsets": [16, 24],
        "itemsize": 64,
    }
)
_IOVEC = np.dtype([("base", np.uintp), ("len", np.uintp)])


def send_udp(port: int, length: int, rate: float, seconds: float) -> tuple[int, float]:
    """Send datagrams at a rate; return the number sent and the seconds it took.

    Each datagram begins with its number, u64 little-endian.
    """
    rng = np.random.default_rng(1)
    units = rng.integers(0, 256, (_SLOTS, length), dtype=np.uint8)
    numbers = units[:, :8].view("<u8")[:, 0]

    def fill(first: int, count: int) -> None:
        numbers[:count] = np.arange(first, first + count)

    return _send(port, units, fill, rate, seconds)


def send_vlp16(port: int, datagram: bytes, rate: float, seconds: float) -> tuple[int, float]:
    """Send a VLP-16's datagram at a rate, with the microseconds past the hour of each; return as `send_udp` does."""
    units = np.tile(np.frombuffer(datagram, np.uint8), (_SLOTS, 1))
    stamps = units[:, _VLP16_STAMP : _VLP16_STAMP + 4].view("<u4")[:, 0]

    def fill(first: int, count: int) -> None:
        stamps[:count] = np.arange(first, first + count) * 1e6 / rate

    return _send(port, units, fill, rate, seconds)


def send_file(port: int, datagrams: ByteRows, rate: float, seconds: float) -> tuple[int, float]:
    """Send datagrams (n, length) at a rate, in order and again from the first; return as `send_udp` does."""
    units = np.empty((_SLOTS, datagrams.shape[1]), np.uint8)

    def fill(first: int, count: int) -> None:
        units[:count] = datagrams[np.arange(first, first + count) % len(datagrams)]

    return _send(port, units, fill, rate, seconds)


def _send(
    port: int, units: ByteRows, fill: Callable[[int, int], None], rate: float, seconds: float
) -> tuple[int, float]:
    """Send rows of units at a rate; ``fill`` numbers the first rows, from a number on."""
    length = units.shape[1]
    iovecs = np.zeros(_SLOTS, _IOVEC)
    iovecs["base"] = units.ctypes.data + np.arange(_SLOTS) * length
    iovecs["len"] = length
    headers = np.zeros(_SLOTS, _HEADER)
    headers["iov"] = iovecs.ctypes.data + np.arange(_SLOTS) * _IOVEC.itemsize
    headers["iovlen"] = 1
    sent, at = 0, headers.ctypes.data
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4 << 20)
        sock.connect(("127.0.0.1", port))
        fd, start = sock.fileno(), time.monotonic()
        while (elapsed := time.monotonic() - start) < seconds:
            due = min(int(elapsed * rate) - sent, _SLOTS)
            if due <= 0:
                time.sleep(0.0005)
                continue
            fill(sent, due)
            count = _libc.sendmmsg(fd, ctypes.c_void_p(at), due, 0)
            if count < 0:
                raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
            sent += count
        return sent, time.monotonic() - start


def send_can(channel: str, rate: float, seconds: float) -> int:
    """Send numbered 8-byte frames on a udp_multicast bus and return their number."""
    import can

    sent, start = 0, time.monotonic()
    with can.Bus(interface="udp_multicast", channel=channel) as bus:
        while (elapsed := time.monotonic() - start) < seconds:
            while sent < elapsed * rate:
                bus.send(can.Message(arbitration_id=0x121, data=sent.to_bytes(8, "little"), is_extended_id=False))
                sent += 1
            time.sleep(0.0005)
    return sent


def main() -> None:
    """Send the load that the command line asks for, and print the number sent."""
    kind, *rest = sys.argv[1:]
    if kind == "udp":
        print(*send_udp(int(rest[0]), int(rest[1]), float(rest[2]), float(rest[3])))
    elif kind == "vlp16":
        print(*send_vlp16(int(rest[0]), Path(rest[1]).read_bytes(), float(rest[2]), float(rest[3])))
    elif kind == "file":
        datagrams = np.fromfile(rest[2], np.uint8).reshape(-1, int(rest[1]))
        print(*send_file(int(rest[0]), datagrams, float(rest[3]), float(rest[4])))
    else:
        print(send_can(rest[0], float(rest[1]), float(rest[2])))


if __name__ == "__main__":
    main()
