"""Counts points in square cells, tile by tile, in bounded memory."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from swath.georef.arrays import FloatArray, UInt64Array
from swath.georef.compiled import jit_cached

TILE = 256  # cells along a side
_TILE_BITS = 8
TILES = 256  # maximum number of tiles held: 64 MiB
_SLOTS = 1024  # size of the hash table of tiles
_FREQUENCIES = 1 << 16  # maximum points in a cell that quantiles resolve
_FAR = 1 << 20  # tiles from the origin; no place on earth is farther
_EMPTY = -(1 << 62)


class CountGrid:
    """Counts of points by cell. If more tiles are needed than may be held, cells become twice as wide, without loss.

    Attributes:
        cell_m: current width of a cell.
        points: points counted; ``refused``: points not finite, or farther from the origin than the earth is wide.
    """

    def __init__(self, cell_m: float, tiles: int = TILES) -> None:
        self.cell_m = cell_m
        self.points = self.refused = 0
        self._tiles = tiles
        self._counts = np.zeros((tiles, TILE, TILE), dtype=np.uint32)
        self._keys = np.full(_SLOTS, _EMPTY, dtype=np.int64)
        self._slots = np.zeros(_SLOTS, dtype=np.int64)
        self._places = np.zeros((tiles, 2), dtype=np.int64)  # column and row of each tile held
        self._state = np.zeros(2, dtype=np.int64)  # tiles held, points refused

    def add(self, points: FloatArray, east: float = 0.0, north: float = 0.0, unit_m: float = 1.0) -> None:
        """Count points (n, 3): east, north, up, of which up is ignored. Blocks may be cut anywhere.

        Args:
            points: coordinates of the points.
            east, north: the grid's origin in their coordinates.
            unit_m: metres per unit of the coordinates.
        """
        done = 0
        while done < len(points):
            done = count_points(
                points,
                east,
                north,
                done,
                unit_m / self.cell_m,
                self._counts,
                self._keys,
                self._slots,
                self._places,
                self._state,
            )
            if done < len(points):
                self._coarsen()
        self.refused = int(self._state[1])
        self.points += len(points)

    def _coarsen(self) -> None:
        """Double the width of the cells: each new count is the sum of four."""
        held = int(self._state[0])
        counts, places = self._counts[:held].copy(), self._places[:held].copy()
        self.cell_m *= 2.0
        self._counts[:] = 0
        self._keys[:] = _EMPTY
        self._state[0] = 0
        half = TILE // 2
        for tile, (column, row) in zip(counts, places.tolist(), strict=True):
            sums = tile.reshape(half, 2, half, 2).sum(axis=(1, 3), dtype=np.uint32)
            slot = _take_tile(column >> 1, row >> 1, self._keys, self._slots, self._places, self._state)
            top, left = (row & 1) * half, (column & 1) * half
            self._counts[slot, top : top + half, left : left + half] += sums

    def extent(self) -> tuple[int, int, int, int] | None:
        """Return west, south, east, north of the tiles held (east and north beyond the last); None
        if there are none.
        """
        held = int(self._state[0])
        if not held:
            return None
        west, south = self._places[:held].min(axis=0).tolist()
        east, north = (self._places[:held].max(axis=0) + 1).tolist()
        return west, south, east, north

    def image(self, limit: int) -> tuple[UInt64Array, float, float, float]:
        """Return counts with north up, at most ``limit`` cells along a side.

        Returns:
            Counts (rows, columns); west and north edge, and width of the image's cells, in metres.
        """
        extent = self.extent()
        if extent is None:
            return np.zeros((0, 0), dtype=np.uint64), 0.0, 0.0, self.cell_m
        west, south, east, north = extent
        block = 1
        while max(east - west, north - south) * TILE > limit * block:
            block *= 2
        tiles, side = max(1, block // TILE), max(1, TILE // block)  # a far point: tiles per cell; else cells per tile
        within = TILE // side
        rows, columns = -((south - north) // tiles) * side, -((west - east) // tiles) * side
        image = np.zeros((rows, columns), dtype=np.uint64)
        for tile, (column, row) in zip(self._counts, self._places[: int(self._state[0])].tolist(), strict=False):
            sums = tile.reshape(side, within, side, within).sum(axis=(1, 3), dtype=np.uint64)
            top, left = (north - 1 - row) // tiles * side, (column - west) // tiles * side
            image[top : top + side, left : left + side] += sums[::-1]
        width_m = self.cell_m * block
        return image, west * TILE * self.cell_m, north * TILE * self.cell_m, width_m

    def numbers(self) -> dict[str, Any]:
        """Return the covered area, the density there, and its quantiles over the cells, for people and scripts."""
        frequency = np.zeros(_FREQUENCIES, dtype=np.int64)
        _count_cells(self._counts, int(self._state[0]), frequency)
        cells, cell_m2 = int(frequency[1:].sum()), self.cell_m**2
        found: dict[str, Any] = {
            "cell_m": self.cell_m,
            "points": self.points,
            "points_refused": self.refused,
            "covered_m2": round(cells * cell_m2, 1),
        }
        if cells:
            below = np.cumsum(frequency[1:])
            quantiles = {
                f"p{percent:02}": (1 + int(np.searchsorted(below, percent / 100 * cells))) / cell_m2
                for percent in (5, 50, 95)
            }
            mean = (self.points - self.refused) / (cells * cell_m2)
            found["density_per_m2"] = {name: round(value, 3) for name, value in ({"mean": mean} | quantiles).items()}
        return found


def _find_tile(column: int, row: int, keys: Any, slots: Any, places: Any, state: Any) -> int:
    """Return the tile's slot, a new one if it is not held; -1 if all slots are taken."""
    key = column * (4 * _FAR) + row
    at = (column * 73_856_093 ^ row * 19_349_663) & (_SLOTS - 1)
    while keys[at] != _EMPTY and keys[at] != key:
        at = (at + 1) & (_SLOTS - 1)
    if keys[at] == key:
        return int(slots[at])
    if state[0] == len(places):
        return -1
    keys[at], slots[at] = key, state[0]
    places[state[0], 0], places[state[0], 1] = column, row
    state[0] += 1
    return int(slots[at])


_take_tile = jit_cached(_find_tile)


def _count_points(
    points: Any,
    east: float,
    north: float,
    first: int,
    per_unit: float,
    counts: Any,
    keys: Any,
    slots: Any,
    places: Any,
    state: Any,
) -> int:
    """Count points from ``first`` on; return how far it came: less than all if there was no slot for a tile."""
    column_before, row_before, tile = _FAR + 1, 0, -1
    for i in range(first, len(points)):
        x, y = (points[i, 0] - east) * per_unit, (points[i, 1] - north) * per_unit
        if not (abs(x) < _FAR * TILE and abs(y) < _FAR * TILE):
            state[1] += 1
            continue
        x_cell, y_cell = math.floor(x), math.floor(y)
        column, row = x_cell >> _TILE_BITS, y_cell >> _TILE_BITS
        if column != column_before or row != row_before:
            tile = _take_tile(column, row, keys, slots, places, state)
            if tile < 0:
                return i
            column_before, row_before = column, row
        counts[tile, y_cell & (TILE - 1), x_cell & (TILE - 1)] += np.uint32(1)
    return len(points)


count_points = jit_cached(_count_points)


@jit_cached
def _count_cells(counts: Any, held: int, frequency: Any) -> None:
    """Count into ``frequency`` how many cells hold each number of points; its last entry counts all larger numbers."""
    most = len(frequency) - 1
    for tile in range(held):
        for row in range(TILE):
            for column in range(TILE):
                frequency[min(most, counts[tile, row, column])] += 1
