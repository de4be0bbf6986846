"""PPS from the kernel: /dev/ppsN by the ioctls of RFC 2783's Linux binding (<linux/pps.h>)."""

from __future__ import annotations

import errno
import fcntl
import os
import struct
import sys
import threading

from swath.drivers.transports.base import PpsSource, RawEdge, TransportError
from swath.drivers.transports.pps.fixed import FixedPps
from swath.drivers.transports.pps.serial_dcd import SerialDcdPps

__all__ = ["FixedPps", "KernelPps", "SerialDcdPps"]

# _IOC(direction, 'p', number, size); the header gives all of them the size of a pointer
PPS_GETPARAMS = 0x8000_70A1 | struct.calcsize("@P") << 16
PPS_SETPARAMS = 0x4000_70A2 | struct.calcsize("@P") << 16
PPS_GETCAP = 0x8000_70A3 | struct.calcsize("@P") << 16
PPS_FETCH = 0xC000_70A4 | struct.calcsize("@P") << 16

# struct pps_ktime: sec s64, nsec s32, flags u32
# struct pps_fdata: assert_sequence, clear_sequence u32; assert_tu, clear_tu; current_mode int and padding; timeout
FETCH_DATA = struct.Struct("=IIqiIqiIi4xqiI")
# struct pps_kparams: api_version, mode int; assert_off_tu, clear_off_tu
PARAMETERS = struct.Struct("=iiqiIqiI")

PPS_CAPTUREASSERT = 0x01
PPS_CAPTURECLEAR = 0x02
LONGEST_FETCH_S = 0.4  # an edge between two fetches is found by the next one, before the following edge


class KernelPps(PpsSource):
    """Reads one kernel PPS source; stamps are taken in the interrupt."""

    def __init__(self, path: str, edge: str = "assert") -> None:
        self._path = path
        self._edge = edge
        self._fd = -1
        self._last_sequence = 0
        self._lock = threading.Lock()

    def open(self) -> None:
        """Open the device and make sure that it captures the requested edge.

        Raises:
            TransportError: the device is absent, not permitted, not a PPS device, or does not capture that edge.
        """
        with self._lock:
            self._fd = self._opened()
            try:
                self._select_edge()
                self._last_sequence = self._fetch(0.0).sequence
            except OSError as error:
                os.close(self._fd)
                self._fd = -1
                if isinstance(error, TransportError):
                    raise
                raise TransportError(self._why(error)) from error

    def _opened(self) -> int:
        try:
            return os.open(self._path, os.O_RDWR | os.O_CLOEXEC)
        except OSError as error:
            raise TransportError(self._why(error)) from error

    def _why(self, error: OSError) -> str:
        if error.errno in (errno.ENOENT, errno.ENXIO, errno.ENODEV):
            return f"{self._path}: no such PPS device; check that its driver is loaded (pps-gpio, pps-ldisc)"
        if error.errno in (errno.EACCES, errno.EPERM):
            return (
                f'{self._path}: not permitted to this user; install the udev rule (KERNEL=="pps[0-9]*", '
                'GROUP="swath", MODE="0660") or add the user to the device\'s group'
            )
        if error.errno in (errno.ENOTTY, errno.EINVAL, errno.EISDIR):
            return f"{self._path}: is not a PPS device; want /dev/ppsN"
        return f"{self._path}: PPS device failed: {error.strerror}"

    def _select_edge(self) -> None:
        wanted = PPS_CAPTUREASSERT if self._edge == "assert" else PPS_CAPTURECLEAR
        capable = int.from_bytes(fcntl.ioctl(self._fd, PPS_GETCAP, bytes(4)), sys.byteorder)
        if not capable & wanted:
            raise TransportError(
                f"{self._path}: its driver does not capture the {self._edge} edge; set pps.….edge to the other one"
            )
        parameters = PARAMETERS.unpack(fcntl.ioctl(self._fd, PPS_GETPARAMS, bytes(PARAMETERS.size)))
        if parameters[1] & wanted:
            return
        changed = PARAMETERS.pack(parameters[0], parameters[1] | wanted, *parameters[2:])
        try:
            fcntl.ioctl(self._fd, PPS_SETPARAMS, changed)
        except PermissionError as error:
            raise TransportError(
                f"{self._path}: capture of the {self._edge} edge is off, and turning it on needs CAP_SYS_TIME; "
                f"`ppstest {self._path}` as root turns it on"
            ) from error

    def _fetch(self, timeout_s: float) -> RawEdge:
        """Return the latest edge, after waiting at most ``timeout_s`` for one newer than this call."""
        seconds, nanoseconds = divmod(round(timeout_s * 1e9), 1_000_000_000)
        request = FETCH_DATA.pack(*(0,) * 9, seconds, nanoseconds, 0)
        try:
            answer = fcntl.ioctl(self._fd, PPS_FETCH, request)
        except TimeoutError:
            return self._fetch(0.0)
        return edge_of(answer, self._edge)

    def receive(self, timeout_s: float) -> list[RawEdge]:
        """Receive edges as `PpsSource.receive` does; one call waits 0.4 s at most, whatever ``timeout_s`` is."""
        with self._lock:
            if self._fd < 0:
                raise TransportError(f"{self._path}: is closed")
            try:
                edge = self._fetch(0.0)
                if edge.sequence == self._last_sequence and timeout_s > 0:
                    edge = self._fetch(min(timeout_s, LONGEST_FETCH_S))
                if edge.sequence == self._last_sequence:
                    self._see_that_it_is_there()
            except InterruptedError:
                return []
            except TransportError:
                raise
            except OSError as error:
                raise TransportError(self._why(error)) from error
            if edge.sequence == self._last_sequence:
                return []
            self._last_sequence = edge.sequence
            return [edge]

    def _see_that_it_is_there(self) -> None:
        """Raise an error if the path no longer names the open device; the kernel does not report an unregistered
        source.
        """
        opened, now = os.fstat(self._fd), os.stat(self._path)
        if (now.st_dev, now.st_ino) != (opened.st_dev, opened.st_ino):
            raise TransportError(f"{self._path}: was replaced by another PPS device")

    def close(self) -> None:
        """Close the device after a running `receive`, which takes 0.4 s at most."""
        with self._lock:
            if self._fd >= 0:
                os.close(self._fd)
                self._fd = -1


def edge_of(answer: bytes, edge: str) -> RawEdge:
    """Return the edge of one polarity in a `struct pps_fdata`."""
    fields = FETCH_DATA.unpack(answer)
    sequence, at = (fields[0], 2) if edge == "assert" else (fields[1], 5)
    return RawEdge(fields[at] * 1_000_000_000 + fields[at + 1], sequence, edge)
