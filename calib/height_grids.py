"""Heights of swaths on one grid, smoothed, and how they change with a scanner's parameters.

A surface of points that move by (dx, dy, dz) changes at a fixed place by dz − ∂z/∂x · dx − ∂z/∂y · dy, which is all
that is needed to lay surfaces of swaths on each other (least squares matching; FORMULAS 5.3 for what to expect).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from swath.georef.arrays import FloatArray

SUPPORT = 0.9  # of what is typical for a swath: a kernel's share that lies on cells with points
_TYPICAL = 75.0  # percentile of a swath's cells, how much support they have: thin samples leave cells empty
_REACH = 3.0  # of a kernel, in sigmas


@dataclass(frozen=True, slots=True)
class Lattice:
    """Cells of one size over all swaths: west, south, metres a cell, rows and columns."""

    west: float
    south: float
    cell_m: float
    rows: int
    columns: int

    @classmethod
    def over(cls, points: list[FloatArray], cell_m: float, most: int) -> Lattice:
        """All points (n, 3); cells become larger where there were more than so many."""
        low = np.min([np.min(one[:, :2], axis=0) for one in points], axis=0)
        high = np.max([np.max(one[:, :2], axis=0) for one in points], axis=0)
        east, north = high - low
        cell_m = max(cell_m, float(np.sqrt(east * north / most)))
        west, south = (float(np.floor(value / cell_m)) * cell_m for value in low)
        return cls(west, south, cell_m, int(north / cell_m) + 2, int(east / cell_m) + 2)

    def cells(self, points: FloatArray) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """(n,) cells of points, and whether they are on the lattice."""
        column = np.floor((points[:, 0] - self.west) / self.cell_m).astype(np.int64)
        row = np.floor((points[:, 1] - self.south) / self.cell_m).astype(np.int64)
        inside = (column >= 0) & (row >= 0) & (column < self.columns) & (row < self.rows)
        return np.where(inside, row * self.columns + column, 0), inside


@dataclass(frozen=True, eq=False)
class Surface:
    """A swath's heights on a lattice, from `cells` on.

    Attributes:
        cells: (c,) cells that are well supported, rising.
        height_m: (c,).
        change: (c, p) of the height with each parameter.
    """

    cells: NDArray[np.int64]
    height_m: FloatArray
    change: FloatArray


def surface(lattice: Lattice, points: FloatArray, motion: FloatArray, smooth_m: float) -> Surface:
    """Of points (n, 3) and their motion with p parameters (p, n, 3); smoothed by a Gaussian of so many metres."""
    cell, inside = lattice.cells(points)
    cell, points, motion = cell[inside], points[inside], motion[:, inside]
    rows, columns = np.divmod(cell, lattice.columns)
    margin = int(np.ceil(_REACH * smooth_m / lattice.cell_m)) + 1
    row0, column0 = max(int(rows.min()) - margin, 0), max(int(columns.min()) - margin, 0)
    shape = (
        min(int(rows.max()) + margin, lattice.rows - 1) - row0 + 1,
        min(int(columns.max()) + margin, lattice.columns - 1) - column0 + 1,
    )
    at = (rows - row0) * shape[1] + columns - column0
    base = float(np.median(points[:, 2]))

    def smoothed(weights: FloatArray | None) -> FloatArray:
        total = np.bincount(at, weights, minlength=shape[0] * shape[1]).reshape(shape).astype(np.float64)
        out: FloatArray = gaussian_filter(total, smooth_m / lattice.cell_m, mode="constant", truncate=_REACH)
        return out

    count = np.maximum(smoothed(None), 1e-12)
    filled = (np.bincount(at, minlength=shape[0] * shape[1]) > 0).reshape(shape).astype(np.float64)
    support = gaussian_filter(filled, smooth_m / lattice.cell_m, mode="constant", truncate=_REACH)
    height = smoothed(points[:, 2] - base) / count
    slope_y, slope_x = (axis.ravel()[at] for axis in np.gradient(height, lattice.cell_m))
    change = [smoothed(one[:, 2] - slope_x * one[:, 0] - slope_y * one[:, 1]) / count for one in motion]
    good = support >= SUPPORT * np.percentile(support[filled > 0.0], _TYPICAL)
    row, column = np.nonzero(good)
    cells = (row + row0) * lattice.columns + column + column0
    return Surface(cells, height[good] + base, np.stack([one[good] for one in change], axis=1))
