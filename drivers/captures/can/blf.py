"""Reads BLF logs of Vector's CANalyzer and CANoe, and of programs that write them, as a stream.

Vector does not publish the layout; it follows python-can 4.6 (can/io/blf.py) and Wireshark's wiretap/blf.h. All is
little-endian. Own rules: times stay integers, and after a damaged object the reading goes on with the next.
"""

from __future__ import annotations

import datetime as dt
import struct
import zlib
from collections.abc import Iterator
from io import BufferedIOBase
from pathlib import Path

from swath.drivers.can_frames import CANFD_BRS, CANFD_ESI, CANFD_LENGTHS, data_frame
from swath.drivers.captures.base import (
    LATEST_NS,
    CaptureDamageError,
    CapturedUnit,
    CaptureTally,
    open_capture,
    read_bytes,
    report,
    until_damage,
)
from swath.drivers.captures.can.clock import FileClock, FileTime, local_time
from swath.drivers.transports.base import TransportError

MAGIC = b"LOGG"
_HEADER = struct.Struct("<4sI32x8H")  # magic, size of the header, start: year, month, weekday, day, hour, …, ms
_OBJECT = struct.Struct("<4sHHII")  # magic, size of the header, its version, size with the header, kind
_OBJECT_MAGIC = b"LOBJ"
_TIME, _TIME_VERSIONS = struct.Struct("<I4xQ"), (1, 2)  # unit of the time, time; in headers of both versions
_TIME_UNIT_NS = {1: 10_000, 2: 1}
_CONTAINER_HEAD = struct.Struct("<H6xI4x")  # compression, size unpacked
_CONTAINER = 10
_PLAIN, _ZLIB = 0, 2
_MAX_OBJECT_BYTES = _MAX_UNPACKED_BYTES = 64 << 20
_MAX_INNER_BYTES = 4 << 20  # an object in containers, which have some 128 KiB each
_SEARCHED_BYTES = 1 << 20

_MESSAGES = {1, 86}
_MESSAGE = struct.Struct("<HBBI8s")  # channel, flags, length code, identifier, data
_FD_MESSAGE_KIND, _FD_MESSAGE = 100, struct.Struct("<HBBIIBBB5x64s")  # …, length in time, bits, FD flags, length, data
_FD_MESSAGE_64_KIND, _FD_MESSAGE_64 = 101, struct.Struct("<BBBxI4xI18xBB4x")  # channel, code, length, …, where data end
_ERRORS = {2, 73, 104}
_REMOTE = 0x80
_EDL, _BRS, _ESI = 0x1, 0x2, 0x4
_REMOTE_64, _EDL_64, _BRS_64, _ESI_64 = 0x10, 0x1000, 0x2000, 0x4000


def blf_time(path: Path) -> FileTime:
    """Return whether a log tells the local time of its beginning."""
    with open_capture(path) as stream:
        return FileTime.LOCAL if _began(_header(stream, path)) is not None else FileTime.SINCE_BEGIN


def read_blf(path: Path | str, clock: FileClock, tally: CaptureTally | None = None) -> Iterator[CapturedUnit]:
    """Read the frames of a log as SocketCAN units of 16 or 72 bytes; a channel has its number as its name.

    Args:
        path: the file, possibly gzipped.
        clock: the zone of the file's start, or the beginning of its times.
        tally: counts damage, and objects of other kinds; where None, damage is raised.

    Raises:
        TransportError: the file is not a BLF log, or does not tell when it begins; without tally also: it is damaged.
    """
    return until_damage(_Log(Path(path), clock, tally).units(), tally)


def _header(stream: BufferedIOBase, path: Path) -> tuple[int, ...]:
    head = read_bytes(stream, _HEADER.size, path)
    if len(head) < _HEADER.size or not head.startswith(MAGIC):
        raise TransportError(f"{path}: is not a BLF log, or ends in its header")
    return _HEADER.unpack(head)


def _began(header: tuple[int, ...]) -> dt.datetime | None:
    year, month, _, day, hour, minute, second, ms = header[2:]
    try:
        return local_time(year, month, day, hour, minute, second, ms * 1000)
    except ValueError:
        return None


class _Log:
    """Reads the objects of one log; those in containers may begin in one and end in the next."""

    def __init__(self, path: Path, clock: FileClock, tally: CaptureTally | None) -> None:
        self._path, self._clock, self._tally = path, clock, tally
        self._start_ns = 0
        self._rest = b""  # the beginning of an object that the next container goes on with

    def units(self) -> Iterator[CapturedUnit]:
        """Yield the units of the log."""
        with open_capture(self._path) as stream:
            header = _header(stream, self._path)
            self._start_ns = self._clock.begin(_began(header), self._path)
            rest = min(max(0, header[1] - _HEADER.size), _SEARCHED_BYTES)
            if len(read_bytes(stream, rest, self._path)) < rest:
                raise CaptureDamageError(f"{self._path}: ends in its header")
            for kind, data, body_at in self._outer(stream):
                if kind == _CONTAINER:
                    yield from self._inner(self._rest + self._unpacked(data[_OBJECT.size :]))
                elif (unit := self._unit(kind, data, body_at)) is not None:
                    yield unit
        if self._rest.strip(b"\0"):
            raise CaptureDamageError(f"{self._path}: ends in an object")

    def _outer(self, stream: BufferedIOBase) -> Iterator[tuple[int, bytes, int]]:
        """Yield kind, bytes and place of the content of the objects of the file itself."""
        held, is_lost = b"", False
        while True:
            held += read_bytes(stream, max(0, _OBJECT.size - len(held)), self._path)
            if not held.strip(b"\0"):
                if len(held) < _OBJECT.size:
                    return
                held = b""
                continue
            at = held.find(_OBJECT_MAGIC)
            if at:
                if not is_lost and (held[: max(at, 0)].strip(b"\0") or at < 0):
                    is_lost = True
                    report(self._tally, f"{self._path}: damaged BLF: no object where one should be")
                if at < 0 and len(held) < _OBJECT.size:
                    return
                held = held[at:] if at > 0 else held[1 - len(_OBJECT_MAGIC) :]
                continue
            if len(held) < _OBJECT.size:
                raise CaptureDamageError(f"{self._path}: ends in an object")
            _, body_at, _, size, kind = _OBJECT.unpack(held)
            if not _OBJECT.size <= body_at <= size <= _MAX_OBJECT_BYTES:
                report(self._tally, f"{self._path}: damaged BLF: an object of {size} bytes")
                held, is_lost = held[1:], True
                continue
            data = held + read_bytes(stream, size - _OBJECT.size, self._path)
            is_lost = False
            yield kind, data, body_at
            if len(data) < size:
                raise CaptureDamageError(f"{self._path}: ends in an object")
            held = b""

    def _unpacked(self, body: bytes) -> bytes:
        if len(body) < _CONTAINER_HEAD.size:
            return b""
        method, _ = _CONTAINER_HEAD.unpack_from(body)
        body = body[_CONTAINER_HEAD.size :]
        if method == _PLAIN:
            return body
        if method != _ZLIB:
            report(self._tally, f"{self._path}: a container is compressed by method {method}; want none or zlib")
            return b""
        unpacker, data = zlib.decompressobj(), b""
        try:
            data = unpacker.decompress(body, _MAX_UNPACKED_BYTES)
        except zlib.error as error:
            report(self._tally, f"{self._path}: damaged BLF: a container cannot be unpacked: {error}")
        return data

    def _inner(self, data: bytes) -> Iterator[CapturedUnit]:
        """Yield the units of the content of containers; up to 3 bytes fill an object."""
        at = 0
        while True:
            found = data.find(_OBJECT_MAGIC, at)
            if found < 0:
                self._rest = data[max(at, len(data) - len(_OBJECT_MAGIC) + 1) :]
                if data[at : len(data) - len(self._rest)].strip(b"\0"):
                    report(self._tally, f"{self._path}: damaged BLF: no object where one should be")
                return
            if data[at:found].strip(b"\0"):
                report(self._tally, f"{self._path}: damaged BLF: no object where one should be")
            if len(data) < found + _OBJECT.size:
                self._rest = data[found:]
                return
            _, body_at, _, size, kind = _OBJECT.unpack_from(data, found)
            if not _OBJECT.size <= body_at <= size <= _MAX_INNER_BYTES:
                report(self._tally, f"{self._path}: damaged BLF: an object of {size} bytes")
                at = found + 1
                continue
            if len(data) < found + size:
                self._rest = data[found:]
                return
            unit = self._unit(kind, data[found : found + size], body_at)
            if unit is not None:
                yield unit
            at = found + size

    def _unit(self, kind: int, data: bytes, body_at: int) -> CapturedUnit | None:
        """Return the unit of an object, or None where it is no frame or is damaged."""
        if kind in _ERRORS:
            self._pass("error frames")
        elif kind not in (*_MESSAGES, _FD_MESSAGE_KIND, _FD_MESSAGE_64_KIND):
            self._pass("objects that are not frames")
        else:
            try:
                version = struct.unpack_from("<H", data, 6)[0]
                unit, count = _TIME.unpack_from(data, _OBJECT.size)
                if version not in _TIME_VERSIONS:
                    raise ValueError(version)
                time_ns = self._start_ns + count * _TIME_UNIT_NS[unit]
                channel, frame = _frame(kind, data, body_at)
            except (struct.error, KeyError, IndexError, ValueError):
                report(self._tally, f"{self._path}: damaged BLF: a frame with invalid content")
                return None
            if time_ns <= LATEST_NS:
                return CapturedUnit(time_ns, frame, str(channel))
        return None

    def _pass(self, what: str) -> None:
        if self._tally is not None:
            self._tally.passed[what] += 1


def _frame(kind: int, data: bytes, at: int) -> tuple[int, bytes]:
    """Return channel and unit of an object; raises struct.error, IndexError or ValueError."""
    if kind in _MESSAGES:
        channel, bits, code, can_id, content = _MESSAGE.unpack_from(data, at)
        return channel, _classic(can_id, bits & _REMOTE, code, content)
    if kind == _FD_MESSAGE_KIND:
        channel, bits, code, can_id, _, _, fd, length, content = _FD_MESSAGE.unpack_from(data, at)
        is_fd, brs, esi, remote = fd & _EDL, fd & _BRS, fd & _ESI, bits & _REMOTE
    else:
        channel, code, length, can_id, fd, _, end = _FD_MESSAGE_64.unpack_from(data, at)
        start = at + _FD_MESSAGE_64.size
        content = data[start : min(start + length, end or len(data))]
        is_fd, brs, esi, remote = fd & _EDL_64, fd & _BRS_64, fd & _ESI_64, fd & _REMOTE_64
    if not is_fd:
        return channel, _classic(can_id, remote, code, content)
    length = CANFD_LENGTHS[code]
    flags = (CANFD_BRS if brs else 0) | (CANFD_ESI if esi else 0)
    return channel, data_frame(can_id, content[:length].ljust(length, b"\0"), is_fd=True, flags=flags)


def _classic(can_id: int, is_remote: int, code: int, content: bytes) -> bytes:
    length = min(code, 8)
    if is_remote:
        return data_frame(can_id, b"", is_fd=False, remote_length=length)
    return data_frame(can_id, content[:length].ljust(length, b"\0"), is_fd=False)
