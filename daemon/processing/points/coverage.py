"""Measures the ground that points cover, to state their density."""

from __future__ import annotations

import zlib
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from swath.georef.arrays import BoolArray, FloatArray

CELL_M = 4.0
MARGIN = 64  # cells by which the grid grows beyond a block of points
MOST_CELLS = 400_000_000  # of a grid: more ground is not measured


@dataclass(frozen=True)
class Covered:
    """The cells that a strip's points lie in, in plain values.

    Attributes:
        first: column and row of the first cell, counted from the origin of coordinates.
        shape: rows and columns.
        bits: a bit for each cell, row by row, compressed.
    """

    first: tuple[int, int]
    shape: tuple[int, int]
    bits: bytes

    @classmethod
    def of(cls, first: tuple[int, int], cells: BoolArray) -> Covered:
        """Return cells (rows, columns) in plain values."""
        rows, columns = cells.shape
        return cls(first, (rows, columns), zlib.compress(np.packbits(cells).tobytes(), 1))

    def cells(self) -> BoolArray:
        """Return the cells (rows, columns)."""
        count = self.shape[0] * self.shape[1]
        bits = np.unpackbits(np.frombuffer(zlib.decompress(self.bits), np.uint8), count=count)
        return bits.astype(np.bool_).reshape(self.shape)

    @property
    def area_m2(self) -> float:
        """The covered area."""
        return _area_m2(self.cells())


class Coverage:
    """Collects the cells of points."""

    def __init__(self, unit_m: float) -> None:
        """Begin without points.

        Args:
            unit_m: metres in a unit of the points' easting and northing.
        """
        self._cell = CELL_M / unit_m
        self._column, self._row = 0, 0  # of the grid's first cell
        self._cells = np.zeros((0, 0), np.bool_)
        self._too_large = False

    def add(self, easting: FloatArray, northing: FloatArray) -> None:
        """Add points (n,), in units of the map."""
        if self._too_large or not len(easting):
            return
        column = np.floor(easting / self._cell).astype(np.int64)
        row = np.floor(northing / self._cell).astype(np.int64)
        self._hold(int(column.min()), int(column.max()), int(row.min()), int(row.max()))
        if not self._too_large:
            self._cells[row - self._row, column - self._column] = True

    def covered(self) -> Covered | None:
        """Return the cells; None: there are none, or too many."""
        if self._too_large or not self._cells.any():
            return None
        rows, columns = (np.flatnonzero(self._cells.any(axis=axis)) for axis in (1, 0))
        used = self._cells[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        return Covered.of((self._column + int(columns[0]), self._row + int(rows[0])), used)

    def _hold(self, west: int, east: int, south: int, north: int) -> None:
        """Let the grid hold these columns and rows."""
        rows, columns = self._cells.shape
        if rows and self._column <= west and east < self._column + columns:
            if self._row <= south and north < self._row + rows:
                return
        if rows:
            west, east = min(west, self._column), max(east, self._column + columns - 1)
            south, north = min(south, self._row), max(north, self._row + rows - 1)
        first = west - MARGIN, south - MARGIN
        shape = north - south + 1 + 2 * MARGIN, east - west + 1 + 2 * MARGIN
        if shape[0] * shape[1] > MOST_CELLS:
            self._too_large, self._cells = True, np.zeros((0, 0), np.bool_)
            return
        grown = np.zeros(shape, np.bool_)
        at = self._row - first[1], self._column - first[0]
        grown[at[0] : at[0] + rows, at[1] : at[1] + columns] = self._cells
        (self._column, self._row), self._cells = first, grown


def area_of_all_m2(covered: Iterable[Covered | None]) -> float | None:
    """Return the area that several strips cover, ground that they share once; None: it is not known of one, or of all
    it is too large a grid.
    """
    known = [one for one in covered if one is not None]
    if not known:
        return None
    first = [min(one.first[axis] for one in known) for axis in (0, 1)]
    end = [max(one.first[axis] + one.shape[1 - axis] for one in known) for axis in (0, 1)]
    if (end[0] - first[0]) * (end[1] - first[1]) > MOST_CELLS:
        return None
    cells = np.zeros((end[1] - first[1], end[0] - first[0]), np.bool_)
    for one in known:
        column, row = one.first[0] - first[0], one.first[1] - first[1]
        cells[row : row + one.shape[0], column : column + one.shape[1]] |= one.cells()
    return _area_m2(cells)


def _area_m2(cells: BoolArray) -> float:
    """Return the area of cells; those at the edge are covered by half on average."""
    framed = np.pad(cells, 1)
    inside = framed[:-2, 1:-1] & framed[2:, 1:-1] & framed[1:-1, :-2] & framed[1:-1, 2:] & cells
    whole, some = int(inside.sum()), int(cells.sum())
    return CELL_M**2 * (whole + 0.5 * (some - whole))
