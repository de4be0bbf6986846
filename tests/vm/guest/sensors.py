"""Simulates an aircraft's sensors in the machine with numbered units: UDP, serial, CAN; notes when it sent them.

    sensors.py FOLDER [--udp PORT:RATE] [--serial DEVICE] [--can INTERFACE:RATE] [--seconds S]

FOLDER/sent gets a line each tenth of a second: CLOCK_MONOTONIC in ns, then the number of units sent before that by udp,
serial, can. It is written through at once, so that it survives a power cut if FOLDER is the host's.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import socket
import struct
import termios
import time
import tty
from collections.abc import Callable
from pathlib import Path

TURN_S = 0.01


def udp(place: str) -> tuple[Callable[[int], None], float]:
    """Return a sender of datagrams, each beginning with its number (eight bytes, little-endian), and its rate, Hz."""
    port, rate = place.split(":")
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    address = ("127.0.0.1", int(port))
    return lambda number: void(sock.sendto(number.to_bytes(8, "little") + b"x" * 400, address)), float(rate)


def serial(device: str) -> tuple[Callable[[int], None], float]:
    """Return a sender of lines ``$P,<number>`` on a serial port, and its rate, Hz."""
    fd = os.open(device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    tty.setraw(fd)
    settings = termios.tcgetattr(fd)
    settings[4] = settings[5] = termios.B115200
    termios.tcsetattr(fd, termios.TCSANOW, settings)
    return lambda number: void(os.write(fd, b"$P,%010d\r\n" % number)), 20.0


def can(place: str) -> tuple[Callable[[int], None], float]:
    """Return a sender of frames 0x123, each with its number (eight bytes, little-endian), and its rate, Hz."""
    interface, rate = place.split(":")
    sock = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    sock.bind((interface,))
    return lambda number: void(sock.send(struct.pack("<IB3xQ", 0x123, 8, number))), float(rate)


def void(_: object) -> None:
    """Ignore the result of a call."""


def main() -> None:
    """Send until the power goes, or for a number of seconds."""
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("--udp")
    parser.add_argument("--serial")
    parser.add_argument("--can")
    parser.add_argument("--seconds", type=float, default=1e9)
    asked = parser.parse_args()
    makers = {"udp": (udp, asked.udp), "serial": (serial, asked.serial), "can": (can, asked.can)}
    senders = {name: make(place) for name, (make, place) in makers.items() if place}
    sent = dict.fromkeys(makers, 0)
    file = os.open(asked.folder / "sent", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    begin = told = time.monotonic()
    while (now := time.monotonic()) < begin + asked.seconds:
        for name, (send, rate) in senders.items():
            with contextlib.suppress(BlockingIOError):  # no one reads at the other end, so the unit is sent later
                while sent[name] < (now - begin) * rate:
                    send(sent[name])
                    sent[name] += 1
        if now - told >= 0.1:
            told = now
            os.write(file, b"%d %d %d %d\n" % (time.monotonic_ns(), *sent.values()))
        time.sleep(TURN_S)
    os.write(file, b"%d %d %d %d\n" % (time.monotonic_ns(), *sent.values()))


if __name__ == "__main__":
    main()
