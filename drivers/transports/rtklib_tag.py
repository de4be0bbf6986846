"""Time tags as RTKLIB's str2str writes them beside a stream (``FILE.tag``): read and written.

Source: src/stream.c, `openfile_`, `readfile` and `writefile`, of github.com/rtklibexplorer/RTKLIB @ 01225392d7ce. All
little-endian:

    60 bytes   text that begins with "TIMETAG RTKLIB"
     4 bytes   the computer's tick when the file was opened, ms; RTKLIB plays several files in step by it
    12 bytes   GPS time of the opening: seconds since 1970-01-01 (u32), fraction of a second (f64)
     8 bytes   a write: milliseconds since the opening (u32), size of the stream after it (u32); repeated

Older versions (github.com/tomojitakasu/RTKLIB @ 02a5688c2bf5) write time and sizes as the computer lays them out in
memory: seconds and sizes have 8 bytes on one of 64 bits. With the option ``::P=8`` sizes have 8 bytes anywhere. Which
layout a file has shows in whether its numbers make sense.
"""

from __future__ import annotations

import datetime as dt
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from io import BufferedIOBase

import numpy as np

from swath.georef.records import Int64Array
from swath.georef.timescales import SECOND_NS, table_leap_seconds

MARK = b"TIMETAG RTKLIB"
_TEXT_BYTES = 60
_MS_NS = 1_000_000
_UNIX_DAY = dt.date(1970, 1, 1)
_LEAST_FRACTION = 1e-7  # RTKLIB's clock has microseconds; parts of other numbers are far smaller as a fraction
_LATEST_FIRST_MS = 2**28  # three days; the parts of a fraction are larger as a count
_UNIX_1990_S, _UNIX_2106_S = 631_152_000, 2**32
_ENTRY = np.dtype([("tick_ms", "<u4"), ("size", "<u4")])
_LOOKED_AT_BYTES = 16 + 48 * 16  # by which the layout is told; from 16 bytes on whole entries of 8 and of 12
_ENTRIES_A_READ = 4096


@dataclass(frozen=True, slots=True)
class TagLayout:
    """Sizes that differ between versions of RTKLIB."""

    seconds: str  # struct code
    size: str

    @property
    def entry(self) -> struct.Struct:
        """One write."""
        return struct.Struct(f"<I{self.size}")

    @property
    def time(self) -> struct.Struct:
        """When the file was opened."""
        return struct.Struct(f"<{self.seconds}d")


_LAYOUTS = (TagLayout("I", "I"), TagLayout("I", "Q"), TagLayout("q", "Q"), TagLayout("q", "I"))


def read_tags(stream: BufferedIOBase) -> Iterator[tuple[int, int]]:
    """Time and size of the stream after each write; an unfinished last entry is left out.

    Yields:
        nanoseconds since 1970 (UTC; leap seconds by the built-in table), bytes of the stream so far.

    Raises:
        ValueError: it is no tag file, or of no known layout.
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
    """The first layout by which the numbers make sense; of a short file rather one that its length fits."""
    possible = [layout for layout in _LAYOUTS if _makes_sense(layout, start)]
    if not possible:
        raise ValueError("is of no known layout")
    if len(start) < _LOOKED_AT_BYTES:
        possible.sort(key=lambda layout: (len(start) - layout.time.size) % layout.entry.size != 0)
    return possible[0]


def _makes_sense(layout: TagLayout, start: bytes) -> bool:
    """Whether the time is of this age, and ticks and sizes never step back."""
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
    """UTC of a GPS time that counts from 1970."""
    leap = 0
    for _ in range(2):  # the day a leap count begins is a day of UTC
        day = _UNIX_DAY + dt.timedelta(seconds=gps_as_unix_ns // SECOND_NS - leap)
        leap, _ = table_leap_seconds(day)
    return gps_as_unix_ns - leap * SECOND_NS


def _gps_as_unix_ns(unix_ns: int) -> int:
    leap, _ = table_leap_seconds(_UNIX_DAY + dt.timedelta(seconds=unix_ns // SECOND_NS))
    return unix_ns + leap * SECOND_NS


class TagWriter:
    """The tag file of a stream whose first bytes came at ``first_ns`` (nanoseconds since 1970, UTC)."""

    def __init__(self, stream: BufferedIOBase, first_ns: int) -> None:
        self._stream = stream
        self._open_ms = max(0, first_ns) // _MS_NS
        self._tick_ms = 0
        seconds, rest_ms = divmod(_gps_as_unix_ns(self._open_ms * _MS_NS) // _MS_NS, 1000)
        stream.write((MARK + b" swath").ljust(_TEXT_BYTES, b"\0") + struct.pack("<I", self._open_ms % 2**32))
        stream.write(struct.pack("<Id", seconds % 2**32, rest_ms / 1000))

    def add(self, times_ns: Int64Array, sizes: Int64Array) -> None:
        """Writes that followed.

        Args:
            times_ns: (n,) when. RTKLIB knows no time that steps back: such a write gets the latest time before it.
            sizes: (n,) bytes of the stream after each; beyond 4 GiB they wrap.
        """
        ticks = np.maximum.accumulate(np.maximum(times_ns // _MS_NS - self._open_ms, self._tick_ms))
        self._tick_ms = int(ticks[-1])
        entries = np.empty(len(ticks), _ENTRY)
        entries["tick_ms"], entries["size"] = ticks & 0xFFFF_FFFF, sizes & 0xFFFF_FFFF
        self._stream.write(entries.tobytes())
