"""The surface around the points of one scanner, which grows while they come, and the sigmas that it changes."""

from __future__ import annotations

from typing import Literal, TypeAlias

import numpy as np

from swath.georef.arrays import FloatArray
from swath.georef.points import Points
from swath.georef.scanner.uncertainty import Noise
from swath.georef.surface.planes import (
    LEVEL_GROUND,
    PLANE,
    ROUGH,
    UNIT_M,
    Beam,
    Cubes,
    add_along_beams,
    add_points,
    find_planes,
    moved_over,
    new_cubes,
    on_level_ground,
)

SIZES_M = (0.5, 8.0)  # least and greatest size of the smallest cubes
WANTED = 12  # points in such a cube
COLUMN_M = 8.0  # where points are counted to choose the size
COUNTED = 1 << 17  # points that are counted
ROWS = 1 << 14  # of the table at first
KEPT_NS = 4_000_000_000  # cubes without a point for so long are forgotten when room is needed
Surface: TypeAlias = Literal["planes", "level", "none"]  # what the footprint of a beam is taken to fall on
_NOTHING = np.empty((0, 6), np.float32)
_NO_COLUMN = np.empty(0, np.float32)


class LocalSurface:
    """Finds the incidence of one scanner's points, and adds the footprint's effect to their sigmas (FORMULAS 6.2).

    Args:
        noise: of the scanner.
        unit_m: (3,) metres in a unit of each coordinate.
        level: take the ground as level everywhere.
        incidence: set the incidences of points.

    Attributes:
        planes, level, rough, steep: numbers of points on a plane, on level ground, among points that lie on no plane,
            and with an incidence beyond 80°, which counts as 80°.
    """

    def __init__(self, noise: Noise, unit_m: FloatArray, *, level: bool = False, incidence: bool = True) -> None:
        self._beam = Beam(noise.range_m**2, noise.angle_rad**2, 0.25 * noise.divergence_rad)
        self._unit_m = unit_m
        self._all_level, self._incidence = level, incidence
        self._cubes: Cubes | None = None
        self._count = 0
        self.planes = self.level = self.rough = self.steep = 0

    @property
    def size_m(self) -> float | None:
        """The size of the smallest cubes; None until it is chosen."""
        return None if self._cubes is None else UNIT_M * 2.0**self._cubes.shift

    def begin(self, points: Points) -> None:
        """Choose the size of the cubes by the density of points (n,), n > 0: most cubes shall hold enough of them."""
        places_m = points.points_map[:COUNTED] * self._unit_m
        origin_m = np.floor(places_m[0] / 1024.0) * 1024.0
        column = np.floor((places_m[:, :2] - origin_m[:2]) / COLUMN_M).astype(np.int64)
        _, where, counts = np.unique(column[:, 0] << 32 ^ column[:, 1], return_inverse=True, return_counts=True)
        wanted_m = COLUMN_M * np.sqrt(WANTED / np.median(counts[where]))
        size_m = np.clip(2.0 ** np.rint(np.log2(wanted_m)), *SIZES_M)
        self._cubes = new_cubes(ROWS, origin_m, round(np.log2(size_m / UNIT_M)))

    def add(self, points: Points) -> None:
        """Let points, in the order of their times, join the surface."""
        if not len(points) or self._all_level:
            return
        assert self._cubes is not None
        at, newest_ns = 0, int(points.time_ns[-1])
        while at < len(points):
            self._count, at = add_points(self._cubes, self._count, points.points_map, self._unit_m, newest_ns, at)
            if at < len(points):
                self.make_room(newest_ns - KEPT_NS)

    def make_room(self, since_ns: int) -> None:
        """Forget old cubes; if three quarters of them are younger, double the table."""
        assert self._cubes is not None
        rows = len(self._cubes.keys)
        young = int(np.count_nonzero(self._cubes.last_ns[: self._count] >= since_ns))
        rows = 2 * rows if 4 * young > 3 * rows else rows
        table = new_cubes(rows, self._cubes.origin_m, self._cubes.shift)
        self._count = moved_over(self._cubes, self._count, since_ns, table)
        self._cubes = table

    def apply(self, points: Points, *, counted: bool = True) -> None:
        """Set surface and, if wanted, incidence of points, and add the footprint's effect to their sigmas."""
        n = len(points)
        assert points.beam_map is not None
        assert points.sigma_map is not None
        tan2 = np.empty(n, np.float32)
        points.surface = np.empty(n, np.uint8)
        points.incidence_rad = np.empty(n, np.float32) if self._incidence else None
        incidence_rad = _NO_COLUMN if points.incidence_rad is None else points.incidence_rad
        if self._cubes is None:
            steep = on_level_ground(points.beam_map, tan2, incidence_rad, points.surface)
        else:
            steep = find_planes(
                self._cubes,
                points.points_map,
                self._unit_m,
                points.beam_map,
                points.range_m,
                self._beam,
                tan2,
                incidence_rad,
                points.surface,
            )
        add_along_beams(
            tan2,
            points.range_m,
            points.beam_map,
            self._beam,
            points.sigma_map,
            _NOTHING if points.covariance_map is None else points.covariance_map,
            _NO_COLUMN if points.range_sigma_m is None else points.range_sigma_m,
        )
        if not counted:
            return
        self.steep += steep
        self.planes += int(np.count_nonzero(points.surface == PLANE))
        self.level += int(np.count_nonzero(points.surface == LEVEL_GROUND))
        self.rough += int(np.count_nonzero(points.surface == ROUGH))


def warm_up_surface(points: Points, *, level: bool) -> None:
    """Run the loops once, on points (n,), n > 0, with sigmas and beams; the points change."""
    surface = LocalSurface(Noise(), np.ones(3), level=level)
    if not level:
        surface.begin(points)
        surface.add(points)
        surface.make_room(0)
    surface.apply(points)
