"""A coarse terrain model that predicts the range of a beam, so that pulses in air find their zone (FORMULAS 3.3)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from swath.georef.arrays import FloatArray
from swath.georef.geodesy.earth import geodetic_from_e, rot_e_from_l

ToGrid = Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]

STEPS = 30
NEAR_M = 0.5  # a beam has arrived when it is this close to the terrain's height
ROUND_COLUMNS = 0.5  # tolerance from a whole turn within which a grid counts as going round the earth
STEEPEST_COS = 0.05  # smallest cosine of the nadir angle of beams that reach the ground within a swath


class TerrainError(ValueError):
    """Raised for an invalid terrain grid."""


class CoarseTerrain:
    """Ellipsoidal heights at the nodes of a regular grid, bilinear in between.

    Args:
        height_m: (rows, columns) ellipsoidal; nan where unknown.
        first: x and y of height_m[0, 0]: longitude and latitude in radians, or the units that ``to_grid`` returns.
        step: from column to column and from row to row; either may be negative.
        to_grid: converts latitudes and longitudes (n,) in radians to x and y of the grid; None: the grid is in
            longitude and latitude.
        turn: the change of x once round the earth, where x is a longitude; None: x is not a longitude.

    Raises:
        TerrainError: the grid is smaller than two by two, or a step is 0.
    """

    def __init__(
        self,
        height_m: ArrayLike,
        first: tuple[float, float],
        step: tuple[float, float],
        to_grid: ToGrid | None = None,
        turn: float | None = None,
    ) -> None:
        self._height_m = np.asarray(height_m, dtype=np.float64)
        if self._height_m.ndim != 2 or min(self._height_m.shape) < 2:
            raise TerrainError(f"terrain: got heights of shape {self._height_m.shape}, want a grid of 2 by 2 or more")
        if not (step[0] and step[1]):
            raise TerrainError(f"terrain: got steps of {step[0]:g} and {step[1]:g}, want none that is 0")
        self._first, self._step, self._to_grid = first, step, to_grid
        self._turn = 2.0 * np.pi if to_grid is None else turn
        columns = self._height_m.shape[1]
        if self._turn is not None and abs(columns - abs(self._turn / step[0])) < ROUND_COLUMNS:
            self._height_m = np.concatenate([self._height_m, self._height_m[:, :1]], axis=1)

    def height_at(self, lat_rad: ArrayLike, lon_rad: ArrayLike) -> FloatArray:
        """Return (n,) ellipsoidal heights, nan outside the grid."""
        lat, lon = np.asarray(lat_rad, dtype=np.float64), np.asarray(lon_rad, dtype=np.float64)
        x, y = (lon, lat) if self._to_grid is None else self._to_grid(lat, lon)
        column, row = (x - self._first[0]) / self._step[0], (y - self._first[1]) / self._step[1]
        if self._turn is not None:  # longitudes may be given a turn higher or lower
            column %= abs(self._turn / self._step[0])
        rows, columns = self._height_m.shape
        inside = (column >= 0) & (column <= columns - 1) & (row >= 0) & (row <= rows - 1)
        left = np.where(inside, np.minimum(column, columns - 2), 0).astype(np.intp)
        lower = np.where(inside, np.minimum(row, rows - 2), 0).astype(np.intp)
        across, along = column - left, row - lower
        grid = self._height_m
        near = (1.0 - across) * grid[lower, left] + across * grid[lower, left + 1]
        far = (1.0 - across) * grid[lower + 1, left] + across * grid[lower + 1, left + 1]
        height: FloatArray = np.where(inside, (1.0 - along) * near + along * far, np.nan)
        return height

    def predicted_m(self, origin_e: FloatArray, direction_e: FloatArray) -> FloatArray:
        """Return (n,) ranges at which beams meet the terrain, to about a metre; nan if they miss it or leave the grid.

        Each step goes to where the beam would reach the ground if the ground ahead were level. Once a step has led
        below the ground, as on slopes that face the beam, later steps stay between the two, where a line through both
        heights is zero.

        Args:
            origin_e: (n, 3) metres.
            direction_e: (n, 3) unit vectors.
        """
        lat, lon, height_m = geodetic_from_e(origin_e)
        fall = np.einsum("ni,ni->n", direction_e, rot_e_from_l(lat, lon)[..., 2])
        above_m = height_m - self.height_at(lat, lon)
        falling = (fall > STEEPEST_COS) & (above_m > 0.0)
        slope = np.where(falling, fall, 1.0)
        range_m = np.where(falling, above_m / slope, np.nan)
        near_m, near_above_m = np.zeros_like(range_m), above_m
        far_m, far_above_m = np.full_like(range_m, np.nan), np.full_like(range_m, np.nan)
        for _ in range(STEPS):
            lat, lon, height_m = geodetic_from_e(origin_e + range_m[:, np.newaxis] * direction_e)
            above_m = height_m - self.height_at(lat, lon)
            arrived = np.abs(above_m) < NEAR_M
            if (arrived | np.isnan(above_m)).all():
                break
            below = above_m < 0.0
            near_m, near_above_m = np.where(below, near_m, range_m), np.where(below, near_above_m, above_m)
            far_m, far_above_m = np.where(below, range_m, far_m), np.where(below, above_m, far_above_m)
            share = np.clip(near_above_m / (near_above_m - far_above_m), 0.1, 0.9)
            step_m = np.where(np.isnan(far_m), range_m + above_m / slope, near_m + share * (far_m - near_m))
            range_m = np.where(arrived, range_m, step_m)
        return np.where(np.abs(above_m) < NEAR_M, range_m, np.nan)
