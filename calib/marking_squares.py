"""Squares of ground: how flat each is in a swath, how strong its pattern of intensities, which returns lie about."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from swath.calib.flight import Flight, Swath
from swath.georef.arrays import FloatArray

IndexArray = NDArray[np.int64]

CHUNK = 1_000_000
LEAST_RMS_M = 0.002


@dataclass(frozen=True, eq=False)
class Grid:
    """Squares over a flight: the south-west corner (2,), their side, columns and rows of them."""

    corner_t: FloatArray
    side_m: float
    columns: int
    rows: int

    def number(self, points_t: FloatArray) -> IndexArray:
        """(n,) of the squares points (n, ≥ 2) lie in; −1: nan."""
        placed = np.isfinite(points_t[:, 0])
        away = np.where(placed[:, np.newaxis], points_t[:, :2], self.corner_t) - self.corner_t
        column, row = np.floor(away / self.side_m).astype(np.int64).T
        return np.where(placed, row * self.columns + column, -1)

    def centre(self, number: int) -> FloatArray:
        """(2,) east and north."""
        row, column = divmod(number, self.columns)
        centre: FloatArray = self.corner_t + self.side_m * (np.array([column, row]) + 0.5)
        return centre

    def around(self, number: int) -> list[int]:
        """A square and its neighbours."""
        row, column = divmod(number, self.columns)
        return [
            r * self.columns + c
            for r in range(max(row - 1, 0), min(row + 2, self.rows))
            for c in range(max(column - 1, 0), min(column + 2, self.columns))
        ]


@dataclass(frozen=True, eq=False)
class Square:
    """A square as a swath shows it.

    Attributes:
        number: in the grid.
        centre_t: (2,); height_m: of its plane there; slopes: (2,) to the east and north.
        rms_m: of the returns about the plane; sigma_m: of its height, from their scatter.
        density: returns a square metre.
        contrast: standard deviation of the intensities as a share of their mean.
    """

    number: int
    centre_t: FloatArray
    height_m: float
    slopes: FloatArray
    rms_m: float
    sigma_m: float
    density: float
    contrast: float

    @property
    def slope(self) -> float:
        """The steepest."""
        return float(np.hypot(*self.slopes))

    def height_at(self, place_t: FloatArray) -> float:
        """Of the plane at a place (2,)."""
        return self.height_m + float(self.slopes @ (place_t - self.centre_t))

    def heights_at(self, places_t: FloatArray) -> FloatArray:
        """Of the plane at places (n, 2)."""
        heights: FloatArray = self.height_m + (places_t - self.centre_t) @ self.slopes
        return heights


def grid_of(flight: Flight, side_m: float) -> Grid | None:
    """Over all points of a flight; None where it has none."""
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for swath in flight.swaths:
        for begin in range(0, len(swath), CHUNK):
            points = np.asarray(swath.points_t[begin : begin + CHUNK, :2])
            points = points[np.isfinite(points[:, 0])]
            low, high = (
                np.minimum(low, points.min(axis=0, initial=np.inf)),
                np.maximum(high, points.max(axis=0, initial=-np.inf)),
            )
    if not np.isfinite(low).all():
        return None
    corner = np.floor(low / side_m) * side_m
    columns, rows = (np.floor((high - corner) / side_m).astype(np.int64) + 1).tolist()
    return Grid(corner, side_m, columns, rows)


def squares_of(swath: Swath, grid: Grid, least_density: float) -> Iterator[Square]:
    """Those in which a swath has returns enough."""
    count = grid.columns * grid.rows
    sums = np.zeros((12, count))  # 1 x y z xx xy yy xz yz zz, intensity and its square
    for begin in range(0, len(swath), CHUNK):
        points = np.asarray(swath.points_t[begin : begin + CHUNK])
        square = grid.number(points)
        placed = square >= 0
        points, square = points[placed], square[placed]
        row, column = np.divmod(square, grid.columns)
        x, y = (points[:, :2] - grid.corner_t - grid.side_m * (np.stack([column, row], axis=1) + 0.5)).T
        z = points[:, 2]
        intensity = swath.rows["intensity"][begin : begin + CHUNK][
            np.isfinite(swath.points_t[begin : begin + CHUNK, 0])
        ]
        columns = (x, y, z, x * x, x * y, y * y, x * z, y * z, z * z, intensity, intensity**2)
        sums[0] += np.bincount(square, minlength=count)
        for at, values in enumerate(columns, 1):
            sums[at] += np.bincount(square, values, count)
    least = max(least_density * grid.side_m**2, 10.0)
    for number in np.flatnonzero(sums[0] >= least).tolist():
        found = _square(number, grid, sums[:, number])
        if found is not None:
            yield found


def _square(number: int, grid: Grid, sums: FloatArray) -> Square | None:
    """Plane and contrast of a square from its sums (12,)."""
    n, x, y, z, xx, xy, yy, xz, yz, zz, i, ii = (float(value) for value in sums)
    normal = np.array([[n, x, y], [x, xx, xy], [y, xy, yy]])
    if np.linalg.cond(normal / n) > 1e4:
        return None
    inverse = np.linalg.inv(normal)
    plane = inverse @ [z, xz, yz]
    rms_m = math.sqrt(max((zz - float(plane @ [z, xz, yz])) / (n - 3.0), 0.0))
    mean = i / n
    contrast = math.sqrt(max(ii / n - mean**2, 0.0)) / mean if mean > 0.0 else 0.0
    sigma_m = max(rms_m, LEAST_RMS_M) * float(np.sqrt(inverse[0, 0]))
    return Square(number, grid.centre(number), float(plane[0]), plane[1:], rms_m, sigma_m, n / grid.side_m**2, contrast)


def near(swath: Swath, grid: Grid, numbers: Sequence[int]) -> dict[int, IndexArray]:
    """By square, the returns in it and in its neighbours, rising."""
    wanted = np.zeros(grid.columns * grid.rows, np.bool_)
    for number in numbers:
        wanted[grid.around(number)] = True
    found, squares = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for begin in range(0, len(swath), CHUNK):
        numbers_here = grid.number(np.asarray(swath.points_t[begin : begin + CHUNK]))
        chosen = np.flatnonzero((numbers_here >= 0) & wanted[numbers_here])
        found.append(begin + chosen)
        squares.append(numbers_here[chosen])
    at, square = np.concatenate(found), np.concatenate(squares)
    order = np.argsort(square, kind="stable")
    at, square = at[order], square[order]
    first, last = (
        np.searchsorted(square, np.arange(len(wanted)), side="left"),
        np.searchsorted(square, np.arange(len(wanted)), side="right"),
    )
    return {
        number: np.sort(np.concatenate([at[first[one] : last[one]] for one in grid.around(number)]))
        for number in numbers
    }
