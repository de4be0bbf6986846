"""Gives the columns of a block of a table as NumPy arrays, whatever their type in the file."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow
import pyarrow.compute
import pyarrow.types

from swath.drivers.captures.base import CaptureTally, report
from swath.drivers.captures.tables.columns import Column
from swath.drivers.record_frames import NO_TIME_NS
from swath.georef.arrays import FloatArray, Int64Array


class Cells:
    """Gives the columns of a block as numbers, whatever their type in the file; what is none is counted as damage."""

    def __init__(self, path: Path, block: Mapping[str, Any], tally: CaptureTally | None) -> None:
        self._path, self._block, self._tally = path, block, tally
        self.count = len(next(iter(block.values()))) if block else 0

    def numbers(self, column: Column) -> FloatArray:
        """Return a column (n,) in the row's unit; nan: not given."""
        found: FloatArray = self._cast(column, "double", np.nan) * column.factor
        return found

    def whole(self, column: Column, missing: int) -> Int64Array:
        """Return a column (n,) of whole numbers, or of flags."""
        found: Int64Array = self._cast(column, "int64", missing)
        return found

    def times(self, column: Column) -> Int64Array:
        """Return a column (n,) of times, ns; −1: not given. Seconds are read to the last digit of a double."""
        scale_ns = column.factor
        if scale_ns == 1.0:
            return self.whole(column, NO_TIME_NS)
        seconds = self._cast(column, "double", np.nan)
        known = np.isfinite(seconds) & (seconds >= 0.0) & (seconds < 2.0**62 / scale_ns)
        whole = np.floor(np.where(known, seconds, 0.0))
        rest = np.where(known, seconds, 0.0) - whole
        time_ns = whole.astype(np.int64) * round(scale_ns) + np.rint(rest * scale_ns).astype(np.int64)
        return np.where(known, time_ns, NO_TIME_NS)

    def words(self, column: Column) -> list[str]:
        """Return a column (n,) of words; empty where there is none."""
        texts = self._block[column.name].cast(pyarrow.string())
        return [text or "" for text in texts.to_pylist()]

    def moments(self, column: Column) -> Int64Array:
        """Return a column (n,) of dates and times of UTC, as POSIX ns; −1: not given."""
        cells = self._block[column.name]
        if pyarrow.types.is_string(cells.type) or pyarrow.types.is_large_string(cells.type):
            cells = pyarrow.compute.replace_substring_regex(cells, r"(Z|\+00:00|\+0000)$", "")
        try:
            stamps = cells.cast(pyarrow.timestamp("ns")).cast(pyarrow.int64())
            return np.asarray(stamps.fill_null(NO_TIME_NS).to_numpy(zero_copy_only=False), np.int64)
        except pyarrow.ArrowInvalid:
            found = []
            for text in cells.to_pylist():
                try:
                    found.append(pyarrow.scalar(text).cast(pyarrow.timestamp("ns")).cast(pyarrow.int64()).as_py())
                except pyarrow.ArrowInvalid:
                    self._damaged(column, text, "time in UTC such as 2026-06-15T09:00:05.25Z")
                    found.append(NO_TIME_NS)
            return np.array([NO_TIME_NS if one is None else one for one in found], np.int64)

    def _cast(self, column: Column, kind: str, missing: float) -> Any:
        cells = self._block[column.name]
        if pyarrow.types.is_string(cells.type) and kind == "int64" and column.quantity.dimension == "none":
            cells = _flags(cells)
        dtype = np.int64 if kind == "int64" else np.float64
        try:
            if pyarrow.types.is_floating(cells.type) and kind == "int64":
                cells = cells.cast(kind, safe=False)
            return np.asarray(cells.cast(kind).fill_null(missing).to_numpy(zero_copy_only=False), dtype)
        except pyarrow.ArrowInvalid:
            return np.array([self._one(column, cell, kind, missing) for cell in cells.to_pylist()], dtype)

    def _one(self, column: Column, cell: Any, kind: str, missing: float) -> Any:
        """Return one cell as a number, where not all of them are."""
        if cell is None:
            return missing
        for read in (int, float) if kind == "int64" else (float,):
            with suppress(ValueError, OverflowError):
                number = read(cell)
                if kind != "int64":
                    return number
                if abs(number) < 1 << 62:
                    return round(number)
        self._damaged(column, cell, "number")
        return missing

    def _damaged(self, column: Column, cell: object, wanted: str) -> None:
        report(self._tally, f'{self._path}: column "{column.name}": {str(cell)[:40]!r} is no {wanted}')


def _flags(cells: Any) -> Any:
    """Return texts in which true and false are 1 and 0."""
    lower = pyarrow.compute.utf8_lower(cells)
    return pyarrow.compute.if_else(
        pyarrow.compute.equal(lower, "true"),
        "1",
        pyarrow.compute.if_else(pyarrow.compute.equal(lower, "false"), "0", cells),
    )
