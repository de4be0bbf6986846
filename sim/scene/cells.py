"""The grid of square cells that list the objects in them, and the height that each cell reaches."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from swath.georef.arrays import FloatArray, Int64Array
from swath.sim.scene.terrain import Ground

CELL_M = 20.0
MOST_CELLS = 4_000_000  # with more, cells are made larger


class Cells(NamedTuple):
    """Square cells from the ground's south-west corner on; rows go north.

    Attributes:
        size_m: of a cell.
        top: (2, rows, columns) upper limit of site z of everything in a cell, and of its ground.
        first: (2, cells + 1) cell c lists ``item[first[0, c] : first[0, c + 1]]`` of the objects on the ground, by row
            1 its covers.
        item: codes as in `Listed`.
    """

    size_m: float
    top: FloatArray
    first: Int64Array
    item: Int64Array


@dataclass(frozen=True)
class Listed:
    """Objects that cells are to list.

    Attributes:
        item: (n,) code of each object.
        box: (n, 4) west, south, east, north of the area where a ray may meet it; one object may have several boxes.
        top_z: (n,) site z that it does not exceed.
    """

    item: Int64Array
    box: FloatArray
    top_z: FloatArray


def build_cells(ground: Ground, things: list[Listed], covers: list[Listed]) -> Cells:
    """Return the lists of all cells over the ground."""
    extent = (ground.east_m - ground.west_m, ground.north_m - ground.south_m)
    size_m = CELL_M * np.ceil(np.sqrt(extent[0] * extent[1] / (CELL_M**2 * MOST_CELLS)))
    columns, rows = (max(1, int(np.ceil(length / size_m))) for length in extent)
    ground_top = _ground_top(ground, size_m, rows, columns)
    cell, item, top_z = _spread(ground, size_m, _joined(things), rows, columns)
    top = ground_top.ravel().copy()
    np.maximum.at(top, cell, top_z)
    first, item = _lists(cell, item, rows * columns)
    cell, cover, _ = _spread(ground, size_m, _joined(covers), rows, columns)
    first_cover, cover = _lists(cell, cover, rows * columns)
    return Cells(
        float(size_m),
        np.stack([top.reshape(rows, columns), ground_top]),
        np.stack([first, first_cover + len(item)]),
        np.concatenate([item, cover]),
    )


def _joined(listed: list[Listed]) -> Listed:
    return Listed(*(np.concatenate([getattr(one, name) for one in listed]) for name in ("item", "box", "top_z")))


def _ground_top(ground: Ground, size_m: float, rows: int, columns: int) -> FloatArray:
    """Return (rows, columns) the highest node of each cell and of the patches that it cuts."""

    def spans(count: int, nodes: int) -> tuple[Int64Array, Int64Array]:
        edge = np.arange(count + 1) * size_m / ground.cell_m
        first = np.clip(np.floor(edge[:-1] - 1e-6).astype(np.int64), 0, nodes - 2)
        last = np.clip(np.ceil(edge[1:] + 1e-6).astype(np.int64), 1, nodes - 1)
        return first, last

    def highest(z: FloatArray, first: Int64Array, last: Int64Array) -> FloatArray:
        """Return the highest values over rows first … last of each span."""
        top = z[first]
        for step in range(1, int(np.max(last - first)) + 1):
            top = np.maximum(top, z[np.minimum(first + step, last)])
        return top

    by_rows = highest(ground.z, *spans(rows, ground.z.shape[0]))
    return np.ascontiguousarray(highest(by_rows.T, *spans(columns, ground.z.shape[1])).T)


def _spread(
    ground: Ground, size_m: float, listed: Listed, rows: int, columns: int
) -> tuple[Int64Array, Int64Array, FloatArray]:
    """Return (cell, item, top_z) of every cell that each box touches; parts of boxes off the grid are left out."""
    origin = np.array([ground.west_m, ground.south_m])
    low = np.floor((listed.box[:, :2] - origin) / size_m).astype(np.int64)
    high = np.floor((listed.box[:, 2:] - origin) / size_m).astype(np.int64)
    low, high = np.maximum(low, 0), np.minimum(high, [columns - 1, rows - 1])
    extent = np.maximum(high - low + 1, 0)
    count = extent[:, 0] * extent[:, 1]
    which = np.repeat(np.arange(len(count)), count)
    number = np.arange(len(which)) - np.repeat(np.cumsum(count) - count, count)
    row, column = low[which, 1] + number // extent[which, 0], low[which, 0] + number % extent[which, 0]
    return row * columns + column, listed.item[which], listed.top_z[which]


def _lists(cell: Int64Array, item: Int64Array, cells: int) -> tuple[Int64Array, Int64Array]:
    """Return the first item of each cell (cells + 1,), and the items, each once per cell."""
    width = int(np.max(item, initial=0)) + 1
    pairs = np.unique(cell * width + item)
    first = np.searchsorted(pairs, width * np.arange(cells + 1, dtype=np.int64))
    return first.astype(np.int64), pairs % width
