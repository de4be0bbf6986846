"""Follows a growing log for work that may fall behind: data that is too old is skipped, and no data is read from disk.

Whole chunks are skipped, and only those of scanners: clocks and trajectory go on, so that the points after a gap are as
right as those before it. To the reader of the messages it is a log with a hole in it.
"""

from __future__ import annotations

import ctypes
import os
import re
import struct
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from swath.daemon.log.claim import is_being_written
from swath.daemon.log.directory import LOCK
from swath.daemon.log.follow import PartFollower
from swath.daemon.log.format import LogError
from swath.daemon.log.mcap.chunks import LogBatch
from swath.daemon.log.mcap.scan import OP_CHUNK, OP_DATA_END, OP_MESSAGE_INDEX, next_chunk
from swath.daemon.log.parts import Sign, read_sign

BEHIND_NS = 5_000_000_000  # if farther behind the end of the log, scanners' chunks are skipped
WARM_NS = 120_000_000_000  # log time before a late start that is read: clocks lock and a trajectory begins in it
LOOK_S = 0.1  # between two checks of the end of the file while chunks wait
GONE_S = 2.0  # without new data for so long, check whether the recorder still runs
_CACHE_STEP = 8 << 20
_CACHE_LIMIT = 4 << 30
_HEAD = struct.Struct("<BQ")
_PEEK_BYTES = _HEAD.size + 16
_NUMBER = re.compile(r"0|[1-9][0-9]{0,5}")  # number of a part
_PAGE = os.sysconf("SC_PAGESIZE")


@dataclass(frozen=True, slots=True)
class ChunkPlace:
    """A complete chunk in a part: its place, and the log times of its first and last message."""

    at: int
    length: int
    first_ns: int
    last_ns: int


@dataclass(frozen=True, slots=True)
class Skipped:
    """Marks scanners' chunks between two log times that were skipped."""

    first_ns: int
    last_ns: int


class LivePart(PartFollower):
    """A part whose chunks are listed before they are read."""

    def __init__(self, path: Path) -> None:
        """Open a part as `PartFollower` does."""
        super().__init__(path)
        self.first_chunk_at = self._at
        self.places: deque[ChunkPlace] = deque()

    @property
    def is_read(self) -> bool:
        """True if the part has ended and all its chunks have been read."""
        return self.ended and not self.places

    def look_ahead(self) -> None:
        """List the chunks that have become complete."""
        while not self.ended and (head := self._whole_record()) is not None:
            opcode, length = head
            if opcode == OP_CHUNK:
                peek = self._pread(self._at + _HEAD.size, 16)
                self.places.append(ChunkPlace(self._at, length, *struct.unpack("<QQ", peek)))
            elif opcode == OP_DATA_END:
                self.ended = True
            self._at += _HEAD.size + length

    def read(self, place: ChunkPlace, *, scanners: bool = True) -> Iterator[LogBatch]:
        """Yield the messages of a chunk, without those of scanners if ``scanners`` is False."""
        for batch in self._chunk(place.at, place.length):
            if scanners or batch.channel.chunk_class != "scanner":
                yield batch

    def is_scanners(self, place: ChunkPlace) -> bool:
        """Return True if the index behind a chunk shows that it holds scanners' messages; False if unknown."""
        peek = self._pread(place.at + _HEAD.size + place.length, _HEAD.size + 2)
        if len(peek) < _HEAD.size + 2 or peek[0] != OP_MESSAGE_INDEX:
            return False
        channel = self._channels.get(int.from_bytes(peek[_HEAD.size :], "little"))
        return channel is not None and channel.chunk_class == "scanner"

    def is_cached(self, place: ChunkPlace) -> bool:
        """Return True if a chunk can be read from memory, without the disk."""
        return is_cached(self._file.fileno(), place.at, _HEAD.size + place.length)

    def go_to_cached(self) -> None:
        """Go forward to where the file is in memory up to its end."""
        size = self._size()
        begin = cached_from(self._file.fileno(), size) if size > _CACHE_STEP else 0
        if begin > self._at:
            found = next_chunk(self._file, begin, size)
            self._at = size if found is None else found


class LiveFollower:
    """Follows the recording of a directory from part to part, until it ends.

    Attributes:
        part: the file that is read; None: there is no recording yet.
        skipped_ns: log time whose scanners' chunks were skipped; without those skipped at a late start.
        ended: why there will be no more data; empty: there may be more.
        newest_ns: log time of the newest message known in the log.
        read_ns: log time up to which it has been read.
    """

    def __init__(self, directory: Path, *, from_start: bool = False) -> None:
        """Follow a directory; ``from_start``: read from the recording's beginning and skip no old data."""
        self.part: LivePart | None = None
        self.skipped_ns = 0
        self.ended = ""
        self.newest_ns = self.read_ns = 0
        self.damaged = 0
        self._directory = directory
        self._from_start = from_start
        self._catching_up = from_start
        self._advanced_s = self._asked_s = time.monotonic()

    def close(self) -> None:
        """Close the current file."""
        if self.part is not None:
            self.part.close()

    # ------------------------------------------------------------------ from chunk to chunk

    def poll(self) -> Iterator[LogBatch | Skipped]:
        """Yield all messages that have become readable since the last call, in the file's order."""
        sign = read_sign(self._directory)
        if self.part is None:
            if sign is None:
                return
            yield from self._begin(sign)
        while (part := self.part) is not None and not self.ended:
            yield from self._read_part(part, growing=sign is not None and sign.path == part.path)
            sign = read_sign(self._directory)  # read after the search for the part's end: then it names the next part
            if not self._go_on(part, sign):
                return

    def _read_part(self, part: LivePart, *, growing: bool) -> Iterator[LogBatch | Skipped]:
        self._look(part)
        looked_s = time.monotonic()
        while part.places:
            behind = part.places[-1].last_ns - part.places[0].first_ns > BEHIND_NS
            self._catching_up &= behind or not growing
            if behind and not self._catching_up:
                yield from self._pass_over(part)
            else:
                place = part.places.popleft()
                yield from part.read(place)
                self.read_ns = max(self.read_ns, place.last_ns)
            if time.monotonic() - looked_s > LOOK_S:
                self._look(part)
                looked_s = time.monotonic()

    def _look(self, part: LivePart) -> None:
        part.look_ahead()
        if part.places and part.places[-1].last_ns > self.newest_ns:
            self.newest_ns = part.places[-1].last_ns
            self._advanced_s = time.monotonic()

    def _pass_over(self, part: LivePart, *, counted: bool = True) -> Iterator[LogBatch | Skipped]:
        """Go to the end; on the way read chunks in memory that are not scanners'."""
        first_ns = last_ns = 0
        for place in part.places:
            if part.is_scanners(place) or not part.is_cached(place):
                first_ns, last_ns = min(first_ns or place.first_ns, place.first_ns), max(last_ns, place.last_ns)
            else:
                yield from part.read(place, scanners=False)
            self.read_ns = max(self.read_ns, place.last_ns)
        part.places.clear()
        if last_ns > first_ns:
            self.skipped_ns += (last_ns - first_ns) * counted
            yield Skipped(first_ns, last_ns)

    # ------------------------------------------------------------------ from part to part

    def _begin(self, sign: Sign) -> Iterator[LogBatch | Skipped]:
        """Open the first file; yield the data before the present that clocks need, unless reading from the start."""
        path = sign.path
        if self._from_start:
            path = next(iter(_parts_before(self._directory, sign)), path)
        part = self._open(path)
        if part is None or self._from_start:
            return
        part.go_to_cached()
        part.look_ahead()
        if not part.places:
            return
        self.newest_ns = part.places[-1].last_ns
        limit_ns = self.newest_ns - WARM_NS
        earlier = self._directory / f"{sign.session_id}_{sign.part - 1}.mcap"
        if part.places[0].last_ns > limit_ns and (before := _opened(earlier)) is not None:
            before.go_to_cached()
            before.look_ahead()
            yield from self._warm(before, limit_ns)
            before.close()
        if part.places[-1].last_ns - part.places[0].first_ns > BEHIND_NS:
            yield from self._warm(part, limit_ns)

    def _warm(self, part: LivePart, limit_ns: int) -> Iterator[LogBatch | Skipped]:
        """Yield the cached messages since a time before a late start, without scanners."""
        while part.places and part.places[0].last_ns < limit_ns:
            part.places.popleft()
        yield from self._pass_over(part, counted=False)

    def _open(self, path: Path) -> LivePart | None:
        """Switch to another file and return it; None if it cannot be read (yet)."""
        part = _opened(path)
        if part is not None:
            if self.part is not None:
                self.damaged += self.part.damaged
                self.part.close()
            self.part = part
        return part

    def _go_on(self, part: LivePart, sign: Sign | None) -> bool:
        """Open the session's next part once this one is read to its end, or note the end of the recording."""
        if not part.is_read and not self._is_abandoned(part):
            return False
        session_id = part.info.session_id
        following = self._directory / f"{session_id}_{part.number + 1}.mcap"
        if not os.path.exists(following) and sign is not None and sign.session_id == session_id:
            following = sign.path  # the recorder skips a file name that is taken
        if os.path.exists(following) and following != part.path:
            return self._open(following) is not None
        if is_being_written(self._directory / LOCK) and (sign is None or sign.session_id == session_id):
            return False  # the disk is full: the recorder goes on in a new part when there is space
        self.ended = "the recording has ended" if part.is_read else "the recorder stopped without closing its log"
        return False

    def _is_abandoned(self, part: LivePart) -> bool:
        """Return True if a part without an end is no longer written; asked rarely, and only without new data."""
        now_s = time.monotonic()
        if now_s - max(self._advanced_s, self._asked_s) < GONE_S:
            return False
        self._asked_s = now_s
        if is_being_written(part.path):
            return False
        part.look_ahead()  # data that was written before the writer let go
        return not part.places and not part.ended


def _opened(path: Path) -> LivePart | None:
    try:
        return LivePart(path)
    except (LogError, OSError):
        return None  # not begun yet, or deleted again: the next call will tell


def _parts_before(directory: Path, sign: Sign) -> Iterator[Path]:
    """Yield the earlier parts of the session that is recorded, the first one first."""
    names = (path.stem.rpartition("_")[2] for path in directory.glob(f"{sign.session_id}_*.mcap"))
    for number in sorted(int(name) for name in names if _NUMBER.fullmatch(name)):
        if number < sign.part:
            yield directory / f"{sign.session_id}_{number}.mcap"


# ---------------------------------------------------------------------------------------------- page cache

_LIBC = ctypes.CDLL(None, use_errno=True)
_LIBC.mmap.restype = ctypes.c_void_p
_LIBC.mmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int, ctypes.c_int, ctypes.c_int, ctypes.c_int64]
_LIBC.munmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t]
_LIBC.mincore.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_char_p]
_PROT_READ, _MAP_SHARED, _MAP_FAILED = 1, 1, ctypes.c_void_p(-1).value


def is_cached(fd: int, at: int, length: int) -> bool:
    """Return True if a whole stretch of a file is in memory (mincore(2)); False if that cannot be determined.

    The kernel answers only the file's owner and users who may write it; for others all pages look cached.
    """
    first = at // _PAGE * _PAGE
    span = at + length - first
    address = _LIBC.mmap(None, span, _PROT_READ, _MAP_SHARED, fd, first)
    if address == _MAP_FAILED:
        return False
    try:
        pages = ctypes.create_string_buffer(-(-span // _PAGE))
        if _LIBC.mincore(address, span, pages) != 0:
            return False
        return all(page & 1 for page in pages.raw[: -(-span // _PAGE)])
    finally:
        _LIBC.munmap(address, span)


def cached_from(fd: int, size: int) -> int:
    """Return from which byte on a file is in memory up to its end, in steps of 8 MiB; its size if no step is."""
    begin = size
    while begin > 0 and size - begin < _CACHE_LIMIT:
        before = max(0, begin - _CACHE_STEP)
        if not is_cached(fd, before, begin - before):
            break
        begin = before
    return begin
