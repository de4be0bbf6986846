"""Reads tables of records block by block, by pyarrow, into units of protocol ``records``.

A cell that is no number counts as damage and is unknown; the row is read all the same.
"""

from __future__ import annotations

import codecs
import csv
import io
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow
import pyarrow.csv
import pyarrow.parquet
import pyarrow.types

from swath.drivers.captures.base import CaptureDamageError, CapturedUnit, CaptureTally, open_capture, report
from swath.drivers.captures.tables.cells import Cells
from swath.drivers.captures.tables.columns import Plan, plan_of
from swath.drivers.captures.tables.rows import rows_of
from swath.drivers.record_frames import (
    NO_ARRIVAL,
    NO_TIME_NS,
    TELLS_TIME,
    RowKind,
    Scale,
    most_rows,
    pack_frame,
    posix_from_gps,
)
from swath.drivers.transports.base import TransportError
from swath.georef.arrays import Int64Array
from swath.georef.timescales.gps_time import WEEK_NS

PARQUET = b"PAR1"
DELIMITERS = ",;\t"
HEAD_BYTES = 65_536
GREATEST_WEEK = 8192  # of the numbers that receivers send
ROWS_AT_ONCE = 1 << 16
FRAME_NS = 10_000_000  # of returns without an arrival that become one unit


def column_names(path: Path) -> list[str]:
    """Return the names of a table's columns.

    Raises:
        TransportError: it cannot be read.
    """
    with _opened(path) as table:
        return table.names


def read_table(path: Path, device: str, *, tells_time: bool, tally: CaptureTally | None) -> Iterator[CapturedUnit]:
    """Read a table as units of a device of protocol ``records``, in its own order.

    A unit is the rows that arrived together, at the time of their arrival if the table has it (``host_time_ns``), else
    at their own time as POSIX time.

    Args:
        path: of a CSV file, also gzipped, or a Parquet file.
        device: ``gnss``, ``imu``, ``scanner``.
        tells_time: the fixes also name the seconds in which they arrive.
        tally: counts damage; where None, it is raised.

    Raises:
        TransportError: it is not a table that can be read; without tally also: it is damaged.
    """
    with _opened(path) as table:
        plan = plan_of(path, table.names, device)
        maker = _UnitMaker(path, plan, tells_time, tally)
        for block in table.blocks([column.name for column in plan.columns()], tally):
            yield from maker.units(block)


@dataclass(frozen=True, slots=True)
class _Table:
    """An open table: its columns' names, and a function that yields blocks of columns."""

    names: list[str]
    blocks: Any


@contextmanager
def _opened(path: Path) -> Iterator[_Table]:
    with open_capture(path) as stream:
        try:
            if stream.peek(4)[:4] == PARQUET:  # type: ignore[attr-defined]
                yield _parquet(path, stream)
            else:
                yield _csv(path, stream)
        except (pyarrow.ArrowException, EOFError, OSError, UnicodeDecodeError, zlib.error) as error:
            raise CaptureDamageError(f"{path}: cannot be read further: {_words(error)}") from error


def _words(error: Exception) -> str:
    return " ".join(str(error).split())[:200]


def _parquet(path: Path, stream: Any) -> _Table:
    if not stream.seekable():
        stream = io.BytesIO(stream.read())
    file = pyarrow.parquet.ParquetFile(stream)

    def blocks(names: list[str], tally: CaptureTally | None) -> Iterator[Mapping[str, Any]]:
        del tally
        for batch in file.iter_batches(ROWS_AT_ONCE, columns=names):
            yield {name: _plain(column) for name, column in zip(batch.schema.names, batch.columns, strict=True)}

    return _Table(list(file.schema_arrow.names), blocks)


def _plain(cells: Any) -> Any:
    """Return a column whose words, if it has any, are of the usual type."""
    kind = cells.type.value_type if pyarrow.types.is_dictionary(cells.type) else cells.type
    worded = pyarrow.types.is_string(kind) or pyarrow.types.is_large_string(kind) or pyarrow.types.is_string_view(kind)
    return cells.cast("string") if worded else cells


def _csv(path: Path, stream: Any) -> _Table:
    """Return an open text table; lines before the header that begin with # are comments."""
    skipped = 0
    line = stream.readline(HEAD_BYTES)
    while line.startswith(b"#") and line.endswith(b"\n"):
        skipped, line = skipped + 1, stream.readline(HEAD_BYTES)
    text = line.decode("utf-8-sig", "replace").rstrip("\r\n")
    delimiter = max(DELIMITERS, key=text.count)
    try:
        names = next(csv.reader([text], delimiter=delimiter), [])
    except csv.Error:  # a line's end within the line
        names = []
    if not all(name.strip() for name in names) or not any(name.strip() for name in names):
        raise TransportError(f"{path}: its first line names no columns; want a header such as gps_ns,lat_deg,…")
    if len(set(names)) != len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise TransportError(f'{path}: has two columns "{twice}"; rename one')

    def blocks(wanted: list[str], tally: CaptureTally | None) -> Iterator[Mapping[str, Any]]:
        uneven: list[str] = []

        def skip(row: Any) -> str:  # in a thread of pyarrow, which loses exceptions
            uneven.append(f"{path}: a row has {row.actual_columns} columns, the header {row.expected_columns}")
            return "skip"

        reader = pyarrow.csv.open_csv(
            _Utf8(stream),
            pyarrow.csv.ReadOptions(column_names=names),
            pyarrow.csv.ParseOptions(delimiter=delimiter, invalid_row_handler=skip),
            pyarrow.csv.ConvertOptions(
                column_types=dict.fromkeys(names, pyarrow.string()), include_columns=wanted, strings_can_be_null=True
            ),
        )
        for batch in reader:
            while uneven:
                report(tally, uneven.pop(0))
            yield dict(zip(batch.schema.names, batch.columns, strict=True))

    return _Table(names, blocks)


class _Utf8(io.RawIOBase):
    """Reads a stream as UTF-8; bytes that are none become U+FFFD, because pyarrow refuses whole blocks for one."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream
        self._decoder = codecs.getincrementaldecoder("utf-8")("replace")
        self._rest = b""

    def readable(self) -> bool:
        """Return True, as the stream can be read."""
        return True

    def readinto(self, buffer: Any) -> int:
        """Fill a buffer; return the number of bytes, 0 at the end."""
        while not self._rest:
            data = self._stream.read(len(buffer))
            self._rest = self._decoder.decode(data, not data).encode()
            if not data and not self._rest:
                return 0
        piece, self._rest = self._rest[: len(buffer)], self._rest[len(buffer) :]
        buffer[: len(piece)] = piece
        return len(piece)


class _UnitMaker:
    """Makes the units of a table's rows."""

    def __init__(self, path: Path, plan: Plan, tells_time: bool, tally: CaptureTally | None) -> None:
        self._path, self._plan, self._tally = path, plan, tally
        self._flags = NO_ARRIVAL if plan.arrival is None else 0
        self._tells = tells_time

    def units(self, block: Mapping[str, Any]) -> Iterator[CapturedUnit]:
        """Yield the units of a block of columns."""
        cells = Cells(self._path, block, self._tally)
        scale, time_ns = self._times(cells)
        counted = self._counter(cells, time_ns)
        arrival_ns = self._arrivals(cells, scale, time_ns)
        lost = arrival_ns < 0
        for _ in range(int(lost.sum())):
            report(self._tally, f"{self._path}: a row has no time")
        pieces: list[tuple[int, int, bytes]] = []
        for kind, columns in self._plan.kinds.items():
            rows = rows_of(kind, columns, cells, scale)
            for of_scale, chosen, own_ns in ((scale, ~lost & ~counted[0], time_ns), (Scale.COUNTER, *counted)):
                chosen = chosen & ~lost
                if chosen.any():
                    rows["time_ns"] = own_ns
                    pieces += self._frames(kind, rows[chosen], of_scale, arrival_ns[chosen])
        if len(self._plan.kinds) > 1 or counted[0].any():
            pieces.sort(key=lambda piece: piece[:2])
        for at_ns, _, data in pieces:
            yield CapturedUnit(at_ns, data, "records")

    def _times(self, cells: Cells) -> tuple[Scale, Int64Array]:
        """Return the scale of the rows' times, and the times (n,), ns; −1: unknown."""
        column = self._plan.time
        name = column.quantity.name
        if name == "utc":
            return Scale.UTC, cells.moments(column)
        time_ns = cells.times(column)
        if name == "tow":
            assert self._plan.week is not None
            week = cells.whole(self._plan.week, -1)
            known = (week >= 0) & (week < GREATEST_WEEK) & (time_ns >= 0) & (time_ns < WEEK_NS)
            time_ns = np.where(known, np.where(known, week, 0) * WEEK_NS + time_ns, NO_TIME_NS)
        scales = {"unix": Scale.UTC, "counter": Scale.COUNTER}
        return scales.get(name, Scale.GPS), time_ns

    def _counter(self, cells: Cells, time_ns: Int64Array) -> tuple[Any, Int64Array]:
        """Return which rows (n,) have no time but that of a counter, and the counter's times (n,)."""
        column = self._plan.counter
        if column is None or RowKind.SAMPLE not in self._plan.kinds or column is self._plan.time:
            return np.zeros(len(time_ns), np.bool_), time_ns
        counter_ns = cells.times(column)
        return (time_ns < 0) & (counter_ns >= 0) & (self._plan.arrival is not None), counter_ns

    def _arrivals(self, cells: Cells, scale: Scale, time_ns: Int64Array) -> Int64Array:
        """Return the log's times (n,) of the rows, ns since 1970; −1: none."""
        if self._plan.arrival is not None:
            return cells.times(self._plan.arrival)
        if scale is Scale.GPS:
            return np.where(time_ns >= 0, posix_from_gps(time_ns), NO_TIME_NS)
        return time_ns if scale is Scale.UTC else np.full(len(time_ns), NO_TIME_NS)

    def _frames(
        self, kind: RowKind, rows: Any, scale: Scale, arrival_ns: Int64Array
    ) -> Iterator[tuple[int, int, bytes]]:
        """Yield time, kind and bytes of the frames of rows that arrived together."""
        flags = self._flags | (TELLS_TIME if self._tells and kind is RowKind.FIX else 0)
        together = arrival_ns
        if self._plan.arrival is None and kind in (RowKind.RETURN, RowKind.POINT):
            together = arrival_ns // FRAME_NS
        most = most_rows(kind)
        edges = [0, *(np.flatnonzero(np.diff(together)) + 1).tolist(), len(rows)]
        data, size = rows.tobytes(), rows.dtype.itemsize
        for first, last in pairwise(edges):
            for start in range(first, last, most):
                stop = min(start + most, last)
                frame = pack_frame(kind, data[start * size : stop * size], stop - start, scale, flags)
                yield int(arrival_ns[stop - 1]), kind, frame
