"""Simulate a full set of sensors for the soak; each sends at its own rate and counts and numbers what it sends.

`benchmarks.soak` runs this; it has no command of its own.
"""

from __future__ import annotations

import errno
import functools
import operator
import os
import socket
import struct
import threading
import time
import tty
import zlib
from abc import ABC, abstractmethod
from pathlib import Path

import can
import numpy as np

from swath.drivers.scanner.srep.parser import SrepHeader, encode_datagram

PULSES = 72  # with one return slot: datagrams of 1204 bytes
TICK_HZ = 10_000_000
PRF_HZ = 1000
ZDA_DELAY_S = 0.2
LONGEST_SLEEP_S = 0.005


class Sensor(threading.Thread, ABC):
    """A thread that sends what is due, until it is stopped.

    Attributes:
        source: its name in the log.
        sent: number of units sent, or of writes to a serial line.
        bytes: number of bytes sent.
        late_s: longest time between two turns of the thread; shows how loaded the machine was.
        stop: set it to stop the thread.
        failed: the error that ended the thread, or None.
    """

    def __init__(self, source: str) -> None:
        super().__init__(name=source, daemon=True)
        self.source = source
        self.sent = self.bytes = 0
        self.late_s = 0.0
        self.stop = threading.Event()
        self.failed: BaseException | None = None

    def run(self) -> None:
        """Send until the thread is stopped."""
        start_s = before_s = time.monotonic()
        try:
            while not self.stop.is_set():
                now_s = time.monotonic()
                self.late_s, before_s = max(self.late_s, now_s - before_s), now_s
                self.send_due(now_s - start_s)
                time.sleep(LONGEST_SLEEP_S)
        except BaseException as error:
            self.failed = error
            raise
        finally:
            self.close()

    @abstractmethod
    def send_due(self, elapsed_s: float) -> None:
        """Send all data due at this time after the start."""

    def close(self) -> None:
        """Close the wire."""


class Scanner(Sensor):
    """A scanner of SREP/1 datagrams with correct sequence, ticks and CRC; the ranges are always the same."""

    def __init__(self, source: str, port: int, rate_hz: float) -> None:
        super().__init__(source)
        self._rate_hz = rate_hz
        ranges = np.random.default_rng(port).integers(1, 1 << 24, (PULSES, 1))
        header = SrepHeader(scanner_id=port, tick_hz=TICK_HZ, prf_mhz=PRF_HZ * 1000)
        self._datagram = bytearray(encode_datagram(header, np.arange(PULSES), np.arange(PULSES), ranges))
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect(("127.0.0.1", port))

    def send_due(self, elapsed_s: float) -> None:
        """Send the datagrams due; sequence is at byte 8, first_ticks at 32, CRC at the end (PROTOCOLS, SREP/1)."""
        while self.sent < elapsed_s * self._rate_hz:
            struct.pack_into("<I", self._datagram, 8, self.sent & 0xFFFFFFFF)
            struct.pack_into("<Q", self._datagram, 32, int(self.sent * TICK_HZ / self._rate_hz))
            struct.pack_into("<I", self._datagram, len(self._datagram) - 4, zlib.crc32(self._datagram[:-4]))
            self.bytes += self._socket.send(self._datagram)
            self.sent += 1

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class Receiver(Sensor):
    """A GNSS receiver on a pseudo-terminal: ZDA after every second, and proprietary sentences to fill the line."""

    def __init__(self, source: str, link: Path, bytes_per_s: float) -> None:
        super().__init__(source)
        self._bytes_per_s = bytes_per_s
        self._main, self._secondary = os.openpty()
        tty.setraw(self._secondary)
        os.set_blocking(self._main, False)
        link.symlink_to(os.ttyname(self._secondary))
        self._filler = nmea("PSWTH," + "x" * 97)
        self._second = int(time.time() - ZDA_DELAY_S)
        self.refused = 0

    def send_due(self, elapsed_s: float) -> None:
        """Send the sentences due, each of them whole."""
        second = int(time.time() - ZDA_DELAY_S)
        if second != self._second:
            self._second = second
            self._write(nmea(time.strftime("GPZDA,%H%M%S.00,%d,%m,%Y,00,00", time.gmtime(second))))
        while self.bytes < elapsed_s * self._bytes_per_s:
            self._write(self._filler)

    def _write(self, data: bytes) -> None:
        """Write a sentence, and wait while the line is full."""
        while data and not self.stop.is_set():
            try:
                written = os.write(self._main, data)
            except OSError as error:
                if error.errno != errno.EAGAIN:
                    raise
                self.refused += 1
                time.sleep(0.001)
                continue
            self.bytes += written
            data = data[written:]
        self.sent += 1

    def close(self) -> None:
        """Leave the line open, because the recorder takes a closed line for a lost device; `unplug` closes it later."""

    def unplug(self) -> None:
        """Close the line, after the recorder has ended."""
        os.close(self._main)
        os.close(self._secondary)


class InertialUnit(Sensor):
    """An inertial unit of fixtures/config/imu.dbc on a udp_multicast bus, three frames a sample."""

    def __init__(self, source: str, group: str, port: int, rate_hz: float) -> None:
        super().__init__(source)
        self._rate_hz = rate_hz
        self._samples = 0
        self._bus = can.Bus(interface="udp_multicast", channel=group, port=port)

    def send_due(self, elapsed_s: float) -> None:
        """Send ACC and GYR, then SAMPLE, which has the microseconds and the count of samples and ends the sample."""
        while self._samples < elapsed_s * self._rate_hz:
            ticks = int(self._samples * 1e6 / self._rate_hz) & 0xFFFFFFFF
            self._send(257, struct.pack("<hhh", 1, 2, -1962))
            self._send(258, struct.pack("<hhh", 3, 4, 5))
            self._send(256, struct.pack("<IhBB", ticks, 2500, 0, self._samples & 0xFF))
            self._samples += 1

    def _send(self, identifier: int, data: bytes) -> None:
        """Send a frame and count it."""
        message = can.Message(arbitration_id=identifier, data=data, is_extended_id=False, timestamp=time.time())
        self._bus.send(message)
        self.sent += 1
        self.bytes += 16

    def close(self) -> None:
        """Leave the bus for good."""
        self._bus.shutdown()


class Pulse(Sensor):
    """A PPS source that writes an edge at every whole second of the wall clock to a FIFO."""

    def __init__(self, source: str, fifo: Path) -> None:
        super().__init__(source)
        os.mkfifo(fifo)
        self._fd = os.open(fifo, os.O_RDWR)
        self._second = int(time.time())

    def send_due(self, elapsed_s: float) -> None:
        """Send the edge of the second that has just begun."""
        second = int(time.time())
        if second != self._second:
            self._second = second
            self.sent += 1
            self.bytes += os.write(self._fd, b"%d %d\n" % (second * 1_000_000_000, self.sent))

    def close(self) -> None:
        """Leave the FIFO open, because edges that the recorder has not read yet would be lost."""

    def unplug(self) -> None:
        """Close the FIFO, after the recorder has ended."""
        os.close(self._fd)


def nmea(body: str) -> bytes:
    """Return a sentence with its checksum."""
    return f"${body}*{functools.reduce(operator.xor, body.encode()):02X}\r\n".encode()
