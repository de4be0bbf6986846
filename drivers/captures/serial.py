"""Bytes of a serial line as others kept them: with a table of arrivals, with RTKLIB's time tags, or bare."""

from __future__ import annotations

import csv
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from io import BufferedIOBase
from pathlib import Path

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
from swath.drivers.transports.rtklib_tag import read_tags

_LARGEST_FILE_BYTES = 2**62
MAX_READ_BYTES = 16 << 20  # of one arrival; the recorder's own reads are far below
_BARE_READ_BYTES = 512
_COLUMNS = ["arrival_unix_s", "offset", "length"]


def read_serial(
    path: Path | str, chunks: Path | str | None = None, tally: CaptureTally | None = None
) -> Iterator[CapturedUnit]:
    """Reads of a serial port or a TCP stream: the bytes, and a table of when which of them arrived.

    Args:
        path: the bytes, possibly gzipped.
        chunks: CSV with the columns ``arrival_unix_s,offset,length``; by default the file beside it that is named
            ``<stem>.chunks.csv`` or ``<stem>.chunks.csv.gz``.
        tally: counts damage; where None, it is raised.

    Raises:
        TransportError: a file is absent; without tally also: the table does not fit the bytes.
    """
    path = Path(path)
    return until_damage(_tabled(path, Path(chunks) if chunks is not None else None), tally)


def chunk_table(path: Path) -> Path | None:
    """The table of arrivals beside a file of bytes; None where there is none."""
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
        raise CaptureDamageError(f"{path}: cannot be read on: {error}") from error


def _rows(table: Path) -> Iterator[tuple[int, int, int, int]]:
    """Line number, arrival, offset and length of each row."""
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
    """A stream of str2str with its time tags: one unit a write, to the millisecond.

    Args:
        path: the bytes, possibly gzipped.
        tags: the tag file, possibly gzipped.
        tally: counts damage; where None, it is raised.

    Raises:
        TransportError: a file is absent; without tally also: the tags are none, or do not fit the bytes.
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
            raise CaptureDamageError(f"{tags}: holds no time")
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
            raise CaptureDamageError(f"{tags}: speaks of {count} bytes more than {path.name} has")
        count -= len(data)
        yield data


@dataclass(frozen=True, slots=True)
class BareTime:
    """When the bytes of a file without times came.

    Attributes:
        start_ns: when the first bit came, nanoseconds since 1970.
        baud: bits a second; 0: all bytes at once.
        bits: of one character on the line, with start, parity and stop bits.
    """

    start_ns: int
    baud: float = 0.0
    bits: float = 10.0

    def after(self, count: int) -> int:
        """When ``count`` bytes had come, if the line never paused."""
        return self.start_ns + (round(count * self.bits / self.baud * 1e9) if self.baud else 0)


def read_bare(path: Path | str, time: BareTime, tally: CaptureTally | None = None) -> Iterator[CapturedUnit]:
    """Bytes without times, in units of 512, each with the time of its last byte.

    Args:
        path: the bytes, possibly gzipped.
        time: how they came.
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
