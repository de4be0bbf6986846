"""Reads recorded bytes of a serial line: with a table of arrivals, with RTKLIB's time tags, or without times.

Time tags have the form that RTKLIB's str2str writes beside a stream (``FILE.tag``). They are read and written here.

Source: src/stream.c, `openfile_`, `readfile` and `writefile`, of github.com/rtklibexplorer/RTKLIB @ 01225392d7ce. All
little-endian:

    60 bytes   text that begins with "TIMETAG RTKLIB"
     4 bytes   the computer's tick when the file was opened, ms; RTKLIB plays several files in step by it
    12 bytes   GPS time of the opening: seconds since 1970-01-01 (u32), fraction of a second (f64)
     8 bytes   a write: milliseconds since the opening (u32), size of the stream after it (u32); repeated

Older versions (github.com/tomojitakasu/RTKLIB @ 02a5688c2bf5) write time and sizes as the computer lays them out in
memory: seconds and sizes have 8 bytes on a 64-bit computer. With the option ``::P=8`` sizes have 8 bytes on any
computer. The reader recognises a file's layout by whether its numbers are plausible.
"""

from __future__ import annotations

import csv
import datetime as dt
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from io import BufferedIOBase
from pathlib import Path

import numpy as np

from swath.drivers.captures.base import (
    CaptureDamageError,
    CapturedUnit,
    CaptureTally,
    open_capture,
    read_bytes,
    read_lines,
    until_damage,
)
from swath.drivers.transports.base import TransportError
from swath.georef.arrays import Int64Array
from swath.georef.timescales import SECOND_NS, table_leap_seconds

MARK = b"TIMETAG RTKLIB"

_TEXT_BYTES = 60

_MS_NS = 1_000_000

_UNIX_DAY = dt.date(1970, 1, 1)

_LEAST_FRACTION = 1e-7  # RTKLIB's clock has microseconds; misread bytes give far smaller fractions

_LATEST_FIRST_MS = 2**28  # three days; misread bytes of a fraction give larger counts

_UNIX_1990_S, _UNIX_2106_S = 631_152_000, 2**32

_ENTRY = np.dtype([("tick_ms", "<u4"), ("size", "<u4")])

_LOOKED_AT_BYTES = 16 + 48 * 16  # bytes that determine the layout; after 16, whole entries of both 8 and 12

_ENTRIES_A_READ = 4096


@dataclass(frozen=True, slots=True)
class TagLayout:
    """Field sizes of a tag file, which differ between versions of RTKLIB."""

    seconds: str  # struct code
    size: str

    @property
    def entry(self) -> struct.Struct:
        """Layout of one write."""
        return struct.Struct(f"<I{self.size}")

    @property
    def time(self) -> struct.Struct:
        """Layout of the opening time."""
        return struct.Struct(f"<{self.seconds}d")


_LAYOUTS = (TagLayout("I", "I"), TagLayout("I", "Q"), TagLayout("q", "Q"), TagLayout("q", "I"))


def read_tags(stream: BufferedIOBase) -> Iterator[tuple[int, int]]:
    """Yield the time and the stream's size after each write; an unfinished last entry is left out.

    Yields:
        nanoseconds since 1970 (UTC; leap seconds by the built-in table), bytes of the stream so far.

    Raises:
        ValueError: the stream is not a tag file, or its layout is unknown.
    """
    head = stream.read(_TEXT_BYTES + 4)
    if len(head) < _TEXT_BYTES + 4 or not head.startswith(MARK):
        raise ValueError(f"does not begin with {MARK.decode()}")
    start = stream.read(_LOOKED_AT_BYTES)
    layout = _layout_of(start)
    seconds, fraction = layout.time.unpack_from(start)
    open_ns = _unix_ns(seconds * SECOND_NS + round(fraction * SECOND_NS))
    rest = start[layout.time.size :]
    ticks, tick_before, sizes, size_before = 0, 0, 0, 0
    while rest:
        whole = len(rest) // layout.entry.size * layout.entry.size
        for tick, size in layout.entry.iter_unpack(rest[:whole]):
            ticks += 2**32 if tick < tick_before else 0  # the counter of milliseconds wraps after 49.7 days
            sizes += 2**32 if size < size_before and layout.size == "I" else 0
            tick_before, size_before = tick, size
            yield open_ns + (ticks + tick) * _MS_NS, sizes + size
        more = stream.read(_ENTRIES_A_READ * layout.entry.size)
        rest = rest[whole:] + more if more else b""


def _layout_of(start: bytes) -> TagLayout:
    """Return the first layout that makes the numbers plausible; for a short file, prefer one that its length fits."""
    possible = [layout for layout in _LAYOUTS if _makes_sense(layout, start)]
    if not possible:
        raise ValueError("has an unknown layout")
    if len(start) < _LOOKED_AT_BYTES:
        possible.sort(key=lambda layout: (len(start) - layout.time.size) % layout.entry.size != 0)
    return possible[0]


def _makes_sense(layout: TagLayout, start: bytes) -> bool:
    """Return whether the time is plausible, and ticks and sizes never decrease."""
    if len(start) < layout.time.size:
        return False
    seconds, fraction = layout.time.unpack_from(start)
    if not (_UNIX_1990_S <= seconds < _UNIX_2106_S and (fraction == 0.0 or _LEAST_FRACTION <= fraction < 1.0)):
        return False
    rest = start[layout.time.size :]
    whole = len(rest) // layout.entry.size * layout.entry.size
    entries = np.array(list(layout.entry.iter_unpack(rest[:whole])), dtype=np.float64).reshape(-1, 2)
    if not len(entries):
        return True
    first_tick_ms, first_size = entries[0]
    return bool((np.diff(entries, axis=0) >= 0).all() and first_size > 0 and first_tick_ms < _LATEST_FIRST_MS)


def _unix_ns(gps_as_unix_ns: int) -> int:
    """Return the UTC of a GPS time that counts from 1970."""
    leap = 0
    for _ in range(2):  # leap counts begin on days of UTC, which the first pass finds
        day = _UNIX_DAY + dt.timedelta(seconds=gps_as_unix_ns // SECOND_NS - leap)
        leap, _ = table_leap_seconds(day)
    return gps_as_unix_ns - leap * SECOND_NS


def _gps_as_unix_ns(unix_ns: int) -> int:
    leap, _ = table_leap_seconds(_UNIX_DAY + dt.timedelta(seconds=unix_ns // SECOND_NS))
    return unix_ns + leap * SECOND_NS


class TagWriter:
    """Writes the tag file of a stream whose first bytes came at ``first_ns`` (nanoseconds since 1970, UTC)."""

    def __init__(self, stream: BufferedIOBase, first_ns: int) -> None:
        self._stream = stream
        self._open_ms = max(0, first_ns) // _MS_NS
        self._tick_ms = 0
        seconds, rest_ms = divmod(_gps_as_unix_ns(self._open_ms * _MS_NS) // _MS_NS, 1000)
        stream.write((MARK + b" swath").ljust(_TEXT_BYTES, b"\0") + struct.pack("<I", self._open_ms % 2**32))
        stream.write(struct.pack("<Id", seconds % 2**32, rest_ms / 1000))

    def add(self, times_ns: Int64Array, sizes: Int64Array) -> None:
        """Append entries for the writes that followed.

        Args:
            times_ns: (n,) time of each write. RTKLIB allows no decreasing time: such a write gets the latest time
                before it.
            sizes: (n,) bytes of the stream after each; beyond 4 GiB they wrap.
        """
        ticks = np.maximum.accumulate(np.maximum(times_ns // _MS_NS - self._open_ms, self._tick_ms))
        self._tick_ms = int(ticks[-1])
        entries = np.empty(len(ticks), _ENTRY)
        entries["tick_ms"], entries["size"] = ticks & 0xFFFF_FFFF, sizes & 0xFFFF_FFFF
        self._stream.write(entries.tobytes())


_LARGEST_FILE_BYTES = 2**62
MAX_READ_BYTES = 16 << 20  # largest arrival; the recorder's own reads are far smaller
_BARE_READ_BYTES = 512
_COLUMNS = ["arrival_unix_s", "offset", "length"]


def read_serial(
    path: Path | str, chunks: Path | str | None = None, tally: CaptureTally | None = None
) -> Iterator[CapturedUnit]:
    """Read the units of a serial port or TCP stream from a file of bytes and a table of their arrivals.

    Args:
        path: the bytes, possibly gzipped.
        chunks: CSV with the columns ``arrival_unix_s,offset,length``; by default the file beside ``path`` named
            ``<stem>.chunks.csv`` or ``<stem>.chunks.csv.gz``.
        tally: counts damage; where None, it is raised.

    Raises:
        TransportError: a file is absent; without tally also: the table does not fit the bytes.
    """
    path = Path(path)
    return until_damage(_tabled(path, Path(chunks) if chunks is not None else None), tally)


def chunk_table(path: Path) -> Path | None:
    """Return the table of arrivals beside a file of bytes; None where no table exists."""
    bare = path.with_suffix("") if path.suffix == ".gz" else path
    tables = (bare.with_suffix(suffix) for suffix in (".chunks.csv", ".chunks.csv.gz"))
    return next((table for table in tables if table.exists()), None)


def _tabled(path: Path, given: Path | None) -> Iterator[CapturedUnit]:
    table = given or chunk_table(path)
    if table is None:
        bare = path.with_suffix("") if path.suffix == ".gz" else path
        name = bare.with_suffix(".chunks.csv").name
        raise TransportError(f"{path}: no table of arrival times {name}[.gz] beside it")
    position = 0
    with open_capture(path) as stream:
        for number, time_ns, offset, length in _rows(table):
            data = None
            if 0 <= length <= MAX_READ_BYTES and 0 <= offset <= _LARGEST_FILE_BYTES:
                _seek(stream, offset, position, path)
                data = read_bytes(stream, length, path)
            if data is None or len(data) < length:
                raise CaptureDamageError(f"{table}: line {number}: bytes {offset}+{length} are not in {path.name}")
            position = offset + length
            yield CapturedUnit(time_ns, data, "serial")


def _seek(stream: BufferedIOBase, offset: int, position: int, path: Path) -> None:
    try:
        if offset != position:
            stream.seek(offset)
    except (EOFError, OSError, zlib.error) as error:
        raise CaptureDamageError(f"{path}: cannot be read further: {error}") from error


def _rows(table: Path) -> Iterator[tuple[int, int, int, int]]:
    """Yield line number, arrival, offset and length of each row."""
    lines = read_lines(table)
    header = next(lines, (1, ""))[1].split(",")
    for number, line in lines:
        try:
            row = dict(zip(header, next(csv.reader([line])), strict=True))
            seconds, _, fraction = row["arrival_unix_s"].partition(".")
            time_ns = int(seconds) * 1_000_000_000 + int(fraction[:9].ljust(9, "0"))
            yield number, time_ns, int(row["offset"]), int(row["length"])
        except (KeyError, ValueError, csv.Error) as error:
            raise CaptureDamageError(f"{table}: line {number}: want {','.join(_COLUMNS)}") from error


def read_tagged(path: Path | str, tags: Path | str, tally: CaptureTally | None = None) -> Iterator[CapturedUnit]:
    """Read a stream of str2str with its time tags: one unit a write, to the millisecond.

    Args:
        path: the bytes, possibly gzipped.
        tags: the tag file, possibly gzipped.
        tally: counts damage; where None, it is raised.

    Raises:
        TransportError: a file is absent; without tally also: the tag file is invalid, or does not fit the bytes.
    """
    return until_damage(_tagged(Path(path), Path(tags)), tally)


def _tagged(path: Path, tags: Path) -> Iterator[CapturedUnit]:
    position = 0
    time_ns: int | None = None
    with open_capture(path) as stream, open_capture(tags) as tag_stream:
        for time_ns, size in _tag_entries(tag_stream, tags):
            if size < position:
                raise CaptureDamageError(f"{tags}: steps back at byte {position} of {path.name}")
            if size > position:
                for data in _take(stream, size - position, path, tags):
                    yield CapturedUnit(time_ns, data, "serial")
                position = size
        if time_ns is None:
            raise CaptureDamageError(f"{tags}: contains no time")
        while data := read_bytes(stream, _BARE_READ_BYTES, path):  # str2str was stopped between bytes and tag
            yield CapturedUnit(time_ns, data, "serial")


def _tag_entries(stream: BufferedIOBase, tags: Path) -> Iterator[tuple[int, int]]:
    try:
        yield from read_tags(stream)
    except (ValueError, EOFError, OSError) as error:
        raise CaptureDamageError(f"{tags}: {error}; want the time tags of RTKLIB's str2str") from error


def _take(stream: BufferedIOBase, count: int, path: Path, tags: Path) -> Iterator[bytes]:
    while count:
        data = read_bytes(stream, min(count, MAX_READ_BYTES), path)
        if not data:
            raise CaptureDamageError(f"{tags}: counts {count} bytes more than {path.name} holds")
        count -= len(data)
        yield data


@dataclass(frozen=True, slots=True)
class BareTime:
    """Arrival times of the bytes of a file without times.

    Attributes:
        start_ns: arrival of the first bit, nanoseconds since 1970.
        baud: bits a second; 0: all bytes at once.
        bits: bits of one character on the line, with start, parity and stop bits.
    """

    start_ns: int
    baud: float = 0.0
    bits: float = 10.0

    def after(self, count: int) -> int:
        """Return the arrival time of byte number ``count``, on a line that never pauses."""
        return self.start_ns + (round(count * self.bits / self.baud * 1e9) if self.baud else 0)


def read_bare(path: Path | str, time: BareTime, tally: CaptureTally | None = None) -> Iterator[CapturedUnit]:
    """Read bytes without times, in units of 512, each with the time of its last byte.

    Args:
        path: the bytes, possibly gzipped.
        time: start and rate of the bytes' arrival.
        tally: counts damage; where None, it is raised.

    Raises:
        TransportError: the file is absent; without tally also: it cannot be read to its end.
    """
    return until_damage(_bare(Path(path), time), tally)


def _bare(path: Path, time: BareTime) -> Iterator[CapturedUnit]:
    count = 0
    with open_capture(path) as stream:
        while data := read_bytes(stream, _BARE_READ_BYTES, path):
            count += len(data)
            yield CapturedUnit(time.after(count), data, "serial")
