"""Sums points up in square cells, tile by tile, in bounded memory: numbers, heights, the newest time and strip."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np

from swath.daemon.processing.live.tiles import NO_DIFFERENCE, SIDE, Head, Place, blank_tile
from swath.georef.arrays import FloatArray, Int64Array, SingleArray, StructArray, UInt64Array
from swath.georef.compiled import jit_cached
from swath.georef.points import Points
from swath.georef.timescales.gps_time import SECOND_NS

TILES = 2048  # maximum number of tiles held: 33.5 million cells, 805 MB
_BITS = 7  # of a cell's place within its tile
_SLOTS = 8192  # size of the hash table of tiles
_FREQUENCIES = 1 << 16  # maximum points in a cell that quantiles resolve
_FAR = 1 << 20  # tiles from the origin; no place on earth is farther
_HIGH_M = 1e5  # above or below the origin; no point of the ground is farther
_EMPTY = -(1 << 62)
_LAST_SECOND = (1 << 16) - 1
CELL_DTYPE = np.dtype(
    [
        ("points", "u4"),
        ("height", "f4"),  # mean of all points, above the origin
        ("seconds", "u2"),  # of the newest point, from 1
        ("pulses", "u2"),  # first returns
        ("lowest", "i2"),  # in centimetres above the tile's base
        ("highest", "i2"),
        ("strip", "u2"),  # the newest
        ("difference", "i2"),  # of two strips, in millimetres
        ("no_return", "u2"),  # pulses without a return
        ("strips", "u1"),
        ("compared", "u1"),  # 1: two strips have been compared
    ],
    align=True,
)
NO_STRIPS: Int64Array = np.zeros((0, 3), np.int64)


class CellGrid:
    """Cells of points. If more tiles are needed than may be held, cells become twice as wide.

    Attributes:
        cell_m: current width of a cell.
        points: points counted; ``refused``: points not finite, or farther from the origin than the earth is wide.
        coarsened: number of times that cells have become wider.
        first_gps_s: GPS second that seconds of cells count from, beginning with 1; 0: there are no points.
    """

    def __init__(self, cell_m: float, tiles: int = TILES) -> None:
        self.cell_m = cell_m
        self.points = self.refused = self.coarsened = self.first_gps_s = 0
        self._tiles = tiles
        self._cells = np.zeros((tiles, SIDE, SIDE), dtype=CELL_DTYPE)
        self._bases = np.zeros(tiles, np.float32)
        self._changed = np.zeros(tiles, np.uint8)
        self._unseen = np.zeros(tiles, np.uint8)  # taken by `take_changed`, and not yet by `take_unseen`
        self._keys = np.full(_SLOTS, _EMPTY, dtype=np.int64)
        self._slots = np.zeros(_SLOTS, dtype=np.int64)
        self._places = np.zeros((tiles, 2), dtype=np.int64)  # column and row of each tile held
        self._state = np.zeros(2, dtype=np.int64)  # tiles held, points refused

    def add(
        self,
        points: Points,
        origin: FloatArray,
        unit_m: FloatArray,
        strips: Int64Array = NO_STRIPS,
        places: FloatArray | None = None,
    ) -> None:
        """Add points, in blocks that may be cut anywhere.

        Args:
            points: the points.
            origin: (3,) origin of the grid in their coordinates.
            unit_m: (3,) metres in a unit of the coordinates.
            strips: (m, 3) first GPS nanosecond, the one after the last, and number of strips, in the order of time.
            places: (n, 3) coordinates to use in place of the points' own.
        """
        if not len(points):
            return
        if not self.first_gps_s:
            self.first_gps_s = int(points.time_ns[0]) // SECOND_NS
        xyz = points.points_map if places is None else places
        scale = np.append(unit_m[:2] / self.cell_m, unit_m[2])
        done = 0
        while done < len(points):
            done = paint_points(
                xyz,
                points.time_ns,
                points.return_number,
                done,
                origin,
                scale,
                self.first_gps_s * SECOND_NS,
                strips,
                self._cells,
                self._bases,
                self._changed,
                self._keys,
                self._slots,
                self._places,
                self._state,
            )
            if done < len(points):
                self._coarsen()
                scale = np.append(unit_m[:2] / self.cell_m, unit_m[2])
        self.refused = int(self._state[1])
        self.points += len(points)

    def add_no_return(self, places: FloatArray) -> None:
        """Add pulses without a return at places (n, 3) in the frame ``local``; not in tiles that would not fit."""
        cells = np.floor(places[:, :2] / self.cell_m).astype(np.int64)
        near = np.flatnonzero((np.abs(cells) < _FAR).all(axis=1))
        tiles, of_tile = np.unique(cells[near] >> _BITS, axis=0, return_inverse=True)
        for number, (column, row) in enumerate(tiles.tolist()):
            own = near[of_tile.reshape(-1) == number]
            held = self.held
            slot = _take_tile(column, row, self._keys, self._slots, self._places, self._state)
            if slot < 0:
                continue
            if self.held > held:
                self._bases[slot] = np.round(places[own[0], 2])
            across, up = (cells[own] & (SIDE - 1)).T
            counts = np.bincount(up * SIDE + across, minlength=SIDE * SIDE).reshape(SIDE, SIDE)
            part = self._cells[slot]["no_return"]
            part[:] = np.minimum(part + counts, _LAST_SECOND)
            self._changed[slot] = 1

    @property
    def held(self) -> int:
        """Number of tiles held."""
        return int(self._state[0])

    def _coarsen(self) -> None:
        """Double the width of the cells, joining four to one."""
        held = self.held
        cells, places, bases = self._cells[:held].copy(), self._places[:held].copy(), self._bases[:held].copy()
        self.cell_m *= 2.0
        self.coarsened += 1
        self._cells[:] = 0
        self._keys[:] = _EMPTY
        self._state[0] = 0
        half = SIDE // 2
        for tile, base, (column, row) in zip(cells, bases, places.tolist(), strict=True):
            before = self.held
            slot = _take_tile(column >> 1, row >> 1, self._keys, self._slots, self._places, self._state)
            if self.held > before:
                self._bases[slot] = base
            top, left = (row & 1) * half, (column & 1) * half
            shift = round(100.0 * float(base - self._bases[slot]))
            self._cells[slot, top : top + half, left : left + half] = _joined(tile, shift)
        self._changed[:] = self._unseen[:] = 0
        self._changed[: self.held] = 1

    def take_changed(self) -> Iterator[tuple[Place, Callable[[Head], bytearray]]]:
        """Yield the places of tiles that have changed since the last call, each with a function that makes its file."""
        for slot in np.flatnonzero(self._changed[: self.held]).tolist():
            column, row = self._places[slot].tolist()
            yield (column, row), partial(self._packed, slot)
            self._changed[slot], self._unseen[slot] = 0, 1

    def take_unseen(self) -> Iterator[tuple[Place, StructArray]]:
        """Yield places and cells (`SIDE`, `SIDE`), `CELL_DTYPE`, of tiles that have changed since the last call."""
        for slot in np.flatnonzero((self._changed | self._unseen)[: self.held]).tolist():
            column, row = self._places[slot].tolist()
            yield (column, row), self._cells[slot]
            self._unseen[slot] = 0

    @property
    def has_changed(self) -> bool:
        """True if a tile has changed since `take_changed`."""
        return bool(self._changed.any())

    def _packed(self, slot: int, head: Head) -> bytearray:
        whole = Head(
            head.column,
            head.row,
            head.generation,
            head.cell_m,
            head.sequence,
            float(self._bases[slot]),
            self.first_gps_s,
        )
        data, layers = blank_tile(whole)
        _split(self._cells[slot], *layers.values())
        return data

    def set_differences(self, across: int, up: int, fine_m: float, cell_m: float, dz_m: SingleArray) -> None:
        """Set differences of strips; where there is one already, the larger remains.

        Args:
            across, up: column and row of the first cell, counted in cells of ``fine_m``, the grid's width at first.
            fine_m: that width.
            cell_m: side of the cells that were compared.
            dz_m: (rows, columns) of these cells, metres; nan: not compared.
        """
        factor = round(self.cell_m / fine_m)
        if cell_m > self.cell_m:
            times = round(cell_m / self.cell_m)
            dz_m = dz_m.repeat(times, axis=0).repeat(times, axis=1)
        elif cell_m < self.cell_m:
            times = min(round(self.cell_m / cell_m), len(dz_m))
            dz_m = _means(dz_m, times)
        column, row = across // factor, up // factor
        slot = _take_tile(column >> _BITS, row >> _BITS, self._keys, self._slots, self._places, self._state)
        if slot < 0:
            return
        left, low = column & (SIDE - 1), row & (SIDE - 1)
        part = self._cells[slot, low : low + len(dz_m), left : left + dz_m.shape[1]]
        millimetres = np.clip(np.rint(np.nan_to_num(dz_m) * 1000.0), NO_DIFFERENCE + 1, -NO_DIFFERENCE - 1)
        before = np.where(part["compared"] > 0, np.abs(part["difference"].astype(np.int32)), -1)
        better = np.isfinite(dz_m) & (np.abs(millimetres) > before)
        part["difference"][better] = millimetres[better]
        part["compared"][better] = 1
        self._changed[slot] = 1

    def forget_strip(self, number: int) -> None:
        """Take a strip out of the cells: what it was turned out to be too short for one."""
        for slot in range(self.held):
            cells = self._cells[slot]
            there = cells["strip"] == number
            if there.any():
                cells["strip"][there] = 0
                cells["strips"][there] -= np.minimum(cells["strips"][there], 1)
                self._changed[slot] = 1

    def extent(self) -> tuple[int, int, int, int] | None:
        """Return west, south, east, north of the tiles held (east and north beyond the last); None
        if there are none.
        """
        held = self.held
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
        while max(east - west, north - south) * SIDE > limit * block:
            block *= 2
        tiles, side = max(1, block // SIDE), max(1, SIDE // block)  # a far point: tiles per cell; else cells per tile
        within = SIDE // side
        rows, columns = -((south - north) // tiles) * side, -((west - east) // tiles) * side
        image = np.zeros((rows, columns), dtype=np.uint64)
        for tile, (column, row) in zip(self._cells["points"], self._places[: self.held].tolist(), strict=False):
            sums = tile.reshape(side, within, side, within).sum(axis=(1, 3), dtype=np.uint64)
            top, left = (north - 1 - row) // tiles * side, (column - west) // tiles * side
            image[top : top + side, left : left + side] += sums[::-1]
        width_m = self.cell_m * block
        return image, west * SIDE * self.cell_m, north * SIDE * self.cell_m, width_m

    def numbers(self) -> dict[str, Any]:
        """Return the covered area, the density there, and its quantiles over the cells, for people and scripts."""
        frequency = np.zeros(_FREQUENCIES, dtype=np.int64)
        _count_cells(self._cells, self.held, frequency)
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


def _means(values: SingleArray, times: int) -> SingleArray:
    """Return the means of known values in blocks of ``times`` by ``times``; nan where there are none."""
    blocks = values.reshape(len(values) // times, times, values.shape[1] // times, times)
    known = np.isfinite(blocks)
    count = known.sum(axis=(1, 3))
    total = np.where(known, blocks, 0.0).sum(axis=(1, 3))
    return np.where(count > 0, total / np.maximum(count, 1), np.nan).astype(np.float32)


def _joined(tile: StructArray, shift: int) -> StructArray:
    """Return a tile's cells (`SIDE`, `SIDE`) joined four to one.

    ``shift``: its base minus that of the tile they go to, in centimetres.
    """
    four = np.stack([tile[up::2, across::2] for up in (0, 1) for across in (0, 1)])
    there = four["points"] > 0
    made = np.zeros(four.shape[1:], CELL_DTYPE)
    total = four["points"].sum(axis=0, dtype=np.uint32)
    made["points"] = total
    weighted = (four["points"] * four["height"].astype(np.float64)).sum(axis=0)
    made["height"] = weighted / np.maximum(total, 1)
    for name, none, smallest in (("lowest", 1 << 20, True), ("highest", -(1 << 20), False)):
        values = np.where(there, four[name].astype(np.int32) + shift, none)
        best = values.min(axis=0) if smallest else values.max(axis=0)
        made[name] = np.where(total > 0, np.clip(best, NO_DIFFERENCE + 1, -NO_DIFFERENCE - 1), 0)
    for name in ("pulses", "no_return"):
        made[name] = np.minimum(four[name].sum(axis=0, dtype=np.uint32), _LAST_SECOND)
    for name in ("seconds", "strip", "strips"):
        made[name] = four[name].max(axis=0)
    known = four["compared"] > 0
    made["compared"] = known.any(axis=0)
    sums = np.where(known, four["difference"].astype(np.int32), 0).sum(axis=0)
    made["difference"] = np.rint(sums / np.maximum(known.sum(axis=0), 1))
    return made


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


def _paint_points(
    points: Any,
    time_ns: Any,
    return_number: Any,
    first: int,
    origin: Any,
    scale: Any,
    first_ns: int,
    strips: Any,
    cells: Any,
    bases: Any,
    changed: Any,
    keys: Any,
    slots: Any,
    places: Any,
    state: Any,
) -> int:
    """Add points from ``first`` on; return how far it came: less than all if there was no slot for a tile."""
    column_before, row_before, tile = _FAR + 1, 0, -1
    begin_ns, end_ns, strip, second = np.int64(0), np.int64(0), 0, 0  # of the stretch of time with one second and strip
    for i in range(first, len(points)):
        x, y = (points[i, 0] - origin[0]) * scale[0], (points[i, 1] - origin[1]) * scale[1]
        z = (points[i, 2] - origin[2]) * scale[2]
        if not (abs(x) < _FAR * SIDE and abs(y) < _FAR * SIDE and abs(z) < _HIGH_M):
            state[1] += 1
            continue
        x_cell, y_cell = math.floor(x), math.floor(y)
        column, row = x_cell >> _BITS, y_cell >> _BITS
        if column != column_before or row != row_before:
            held = state[0]
            tile = _take_tile(column, row, keys, slots, places, state)
            if tile < 0:
                return i
            if state[0] > held:
                bases[tile] = np.float32(round(z))
            changed[tile] = 1
            column_before, row_before = column, row
        t = time_ns[i]
        if t < begin_ns or t >= end_ns:
            since = (t - first_ns) // SECOND_NS
            begin_ns = first_ns + since * SECOND_NS
            end_ns = begin_ns + SECOND_NS
            second, strip = min(max(since + 1, 1), _LAST_SECOND), 0
            for k in range(len(strips)):
                if strips[k, 0] <= t < strips[k, 1]:
                    strip = strips[k, 2]
                    begin_ns, end_ns = max(begin_ns, strips[k, 0]), min(end_ns, strips[k, 1])
                elif t < strips[k, 0]:
                    end_ns = min(end_ns, strips[k, 0])
                else:
                    begin_ns = max(begin_ns, strips[k, 1])
        cell = cells[tile, y_cell & (SIDE - 1), x_cell & (SIDE - 1)]
        height = min(max(round((z - bases[tile]) * 100.0), NO_DIFFERENCE + 1), -NO_DIFFERENCE - 1)
        if cell.points == 0:
            cell.lowest = height
            cell.highest = height
            cell.height = z
        else:
            cell.height += (z - cell.height) / (cell.points + 1)
            if height < cell.lowest:
                cell.lowest = height
            if height > cell.highest:
                cell.highest = height
        cell.points += 1
        if return_number[i] <= 1 and cell.pulses < _LAST_SECOND:
            cell.pulses += 1
        if second > cell.seconds:
            cell.seconds = second
        if strip > 0 and strip != cell.strip:
            cell.strip = strip
            if cell.strips < 255:
                cell.strips += 1
    return len(points)


paint_points = jit_cached(_paint_points)


@jit_cached
def _split(
    cells: Any,
    points: Any,
    pulses: Any,
    height: Any,
    lowest: Any,
    highest: Any,
    seconds: Any,
    strip: Any,
    difference: Any,
    no_return: Any,
    strips: Any,
) -> None:
    """Fill the layers of a tile's file, each (`SIDE`, `SIDE`), in the order of `STORED`, from its cells."""
    for row in range(SIDE):
        for column in range(SIDE):
            cell = cells[row, column]
            empty = cell.points == 0
            points[row, column], pulses[row, column] = cell.points, cell.pulses
            height[row, column] = np.float32(math.nan) if empty else cell.height
            lowest[row, column] = NO_DIFFERENCE if empty else cell.lowest
            highest[row, column] = NO_DIFFERENCE if empty else cell.highest
            seconds[row, column], strip[row, column] = cell.seconds, cell.strip
            # a difference of zero is stored as such only where one was found
            difference[row, column] = cell.difference if cell.compared else NO_DIFFERENCE
            no_return[row, column], strips[row, column] = cell.no_return, cell.strips


@jit_cached
def _count_cells(cells: Any, held: int, frequency: Any) -> None:
    """Count into ``frequency`` how many cells hold each number of points; its last entry counts all larger numbers."""
    most = len(frequency) - 1
    for tile in range(held):
        for row in range(SIDE):
            for column in range(SIDE):
                frequency[min(most, cells[tile, row, column].points)] += 1
