"""The ground of the virtual site: nodes on a square grid, bilinear between them, from analytic hills or a raster."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import RectBivariateSpline

from swath.georef.arrays import BoolArray, FloatArray, Int64Array
from swath.sim.clocks import generator
from swath.sim.plan.errors import PlanError
from swath.sim.plan.plan import Plan
from swath.sim.plan.terrain_tables import TerrainTable
from swath.sim.scene.raster import RasterHeights
from swath.sim.site import Site

HeightsOnGrid = Callable[[FloatArray, FloatArray], FloatArray]
"""Ellipsoidal heights (rows, columns) at east (columns,) and north (rows,)."""

MARGIN_M = 100.0
LARGEST_NODES = 30_000_000  # of 8 bytes each
COARSE_M = 1000.0
LAKE_DEPTH_M = 3.0
# Waves of the hills: share of the relief, wavelength as a share of the plan's, azimuth against the first one's.
_WAVES = ((0.4, 1.0, 0.0), (0.4, 1.0, 90.0), (0.1, 0.63, 37.0), (0.1, 0.47, 118.0))


@dataclass(frozen=True)
class Ground:
    """The bilinear ground.

    Attributes:
        site: site whose frame it is in.
        west_m, south_m: site coordinates of the first node.
        cell_m: distance between nodes.
        z: (rows, columns) site z of the nodes, metres; rows go north, columns east.
    """

    site: Site
    west_m: float
    south_m: float
    cell_m: float
    z: FloatArray

    @property
    def east_m(self) -> float:
        """Site x of the last column."""
        return float(self.west_m + (self.z.shape[1] - 1) * self.cell_m)

    @property
    def north_m(self) -> float:
        """Site y of the last row."""
        return float(self.south_m + (self.z.shape[0] - 1) * self.cell_m)

    def covers(self, east_m: FloatArray, north_m: FloatArray) -> BoolArray:
        """Return (n,) True where places lie on the grid."""
        across = (east_m >= self.west_m) & (east_m <= self.east_m)
        return across & (north_m >= self.south_m) & (north_m <= self.north_m)

    def site_z(self, east_m: FloatArray, north_m: FloatArray) -> FloatArray:
        """Return the site z of the ground at site x and y, metres; beyond the grid that of its nearest place."""
        rows, columns = self.z.shape
        across = np.clip((east_m - self.west_m) / self.cell_m, 0.0, columns - 1)
        along = np.clip((north_m - self.south_m) / self.cell_m, 0.0, rows - 1)
        column = np.minimum(across.astype(np.int64), columns - 2)
        row = np.minimum(along.astype(np.int64), rows - 2)
        u, v = across - column, along - row
        southern = (1 - u) * self.z[row, column] + u * self.z[row, column + 1]
        northern = (1 - u) * self.z[row + 1, column] + u * self.z[row + 1, column + 1]
        z: FloatArray = (1 - v) * southern + v * northern
        return z

    def points(self, east_m: FloatArray, north_m: FloatArray) -> FloatArray:
        """Return (…, 3) site coordinates of points on the ground."""
        return np.stack([east_m, north_m, self.site_z(east_m, north_m)], axis=-1)

    def ground_m(self, east_m: FloatArray, north_m: FloatArray) -> FloatArray:
        """Return the ellipsoidal heights of the ground at site x and y; beyond the grid those of its nearest places."""
        east = np.clip(np.asarray(east_m, np.float64), self.west_m, self.east_m)
        north = np.clip(np.asarray(north_m, np.float64), self.south_m, self.north_m)
        return self.site.heights(self.points(east, north))

    def slope(self, east_m: FloatArray, north_m: FloatArray) -> FloatArray:
        """Return the tangent of the steepest slope of the grid around places (n,), over two cells."""
        step = self.cell_m
        across = self.site_z(east_m + step, north_m) - self.site_z(east_m - step, north_m)
        along = self.site_z(east_m, north_m + step) - self.site_z(east_m, north_m - step)
        return np.hypot(across, along) / (2 * step)


class OfHeight:
    """A smooth function of place and height on a grid, interpolated: cubic between coarse nodes, linear in height.

    It serves for the site z of a height, or for map coordinates. Over 20 km their second derivative by height stays
    below 2e-12 per metre, and the cubic's error from the earth's curvature below a micrometre.

    Args:
        function: of east, north, height (n,) each.
        east_m, north_m: of the grid's first and last column and row.
        height_m: height about which it is linear.
    """

    def __init__(
        self,
        function: Callable[[FloatArray, FloatArray, FloatArray], FloatArray],
        east_m: tuple[float, float],
        north_m: tuple[float, float],
        height_m: float,
    ) -> None:
        axes = [np.linspace(*ends, max(4, 1 + int((ends[1] - ends[0]) / COARSE_M))) for ends in (north_m, east_m)]
        north, east = (axis.ravel() for axis in np.meshgrid(*axes, indexing="ij"))
        shape = (len(axes[0]), len(axes[1]))
        low, high = (function(east, north, np.full(east.shape, height_m + up)) for up in (-500.0, 500.0))
        self._middle = RectBivariateSpline(*axes, 0.5 * (low + high).reshape(shape))
        self._gain = RectBivariateSpline(*axes, ((high - low) / 1000.0).reshape(shape))
        self._height_m = height_m

    def __call__(self, east_m: FloatArray, north_m: FloatArray, height_m: FloatArray | float) -> FloatArray:
        """Return (rows, columns) values at east (columns,), north (rows,) and heights (rows, columns)."""
        value: FloatArray = self._middle(north_m, east_m) + self._gain(north_m, east_m) * (height_m - self._height_m)
        return value


def build_ground(plan: Plan, site: Site, corners: FloatArray) -> Ground:
    """Return the ground under corners (k, 2) east, north, and `MARGIN_M` around.

    Raises:
        PlanError: ``terrain.cell_m``: there are too many nodes; ``terrain.raster``: see `swath.sim.scene.raster`.
    """
    table = plan.tables.terrain
    cell_m = table.cell_m
    low = np.floor((np.min(corners, axis=0) - MARGIN_M) / cell_m).astype(np.int64)
    high = np.ceil((np.max(corners, axis=0) + MARGIN_M) / cell_m).astype(np.int64)
    _check_size(high - low, cell_m)
    east, north = (cell_m * np.arange(low[axis], high[axis] + 1, dtype=np.float64) for axis in (0, 1))
    ends = (east[0], east[-1]), (north[0], north[-1])

    def of_height(function: Callable[[FloatArray, FloatArray, FloatArray], FloatArray]) -> OfHeight:
        return OfHeight(function, *ends, table.height_m)

    lift = of_height(lambda x, y, height: site.site_from_ground(x, y, height)[:, 2])
    heights: HeightsOnGrid = RasterHeights(plan, site, *ends, of_height) if table.raster else analytic_heights(table)
    z = np.empty((len(north), len(east)))
    block = max(1, 1_000_000 // len(east))
    for first in range(0, len(north), block):
        rows = slice(first, first + block)
        z[rows] = lift(east, north[rows], heights(east, north[rows]))
    return Ground(site, float(east[0]), float(north[0]), cell_m, z)


def _check_size(cells: Int64Array, cell_m: float) -> None:
    nodes = float(np.prod(cells + 1.0))
    if nodes > LARGEST_NODES:
        width, depth = cells * cell_m / 1000.0
        least = np.ceil(10 * cell_m * np.sqrt(nodes / LARGEST_NODES)) / 10
        raise PlanError(
            "terrain.cell_m",
            f"{cell_m:g} m over {width:.1f} × {depth:.1f} km makes {nodes / 1e6:.0f} million nodes, more than "
            f"{LARGEST_NODES / 1e6:.0f}; set {least:g} m or more",
        )


def analytic_heights(table: TerrainTable) -> HeightsOnGrid:
    """Return a function that gives the plan's slope and hills on a grid.

    The height is `TerrainTable.height_m` at the origin; hills rise by ``relief_m`` from foot to top.
    """
    draws = generator(table.seed, "terrain", "hills")
    turned = draws.uniform(0.0, 360.0)
    waves = []
    for share, length, azimuth_deg in _WAVES:
        azimuth, number = np.radians(azimuth_deg + turned), 2 * np.pi / (length * table.wavelength_m)
        waves.append((0.5 * share, number * np.sin(azimuth), number * np.cos(azimuth), draws.uniform(0.0, 2 * np.pi)))
    fall = 0.01 * table.slope_percent
    towards = np.radians(table.slope_towards_deg)

    def heights(east_m: FloatArray, north_m: FloatArray) -> FloatArray:
        x, y = east_m[np.newaxis, :], north_m[:, np.newaxis]
        hills = np.zeros((len(north_m), len(east_m)))
        for share, of_x, of_y, phase in waves:
            hills += share * (np.cos(of_x * x + of_y * y + phase) - np.cos(phase))
        fallen = fall * (np.sin(towards) * x + np.cos(towards) * y)
        height_m: FloatArray = table.height_m + table.relief_m * hills - fallen
        return height_m

    return heights


@dataclass(frozen=True)
class Lake:
    """Level water in the shape of a disc.

    Attributes:
        center: (3,) site coordinates on its surface.
        up: (3,) the ellipsoid's normal there.
        radius_m, returns: of the plan.
    """

    center: FloatArray
    up: FloatArray
    radius_m: float
    returns: float


def fill_lake(ground: Ground, center_m: list[float], radius_m: float, returns: float) -> Lake:
    """Return a lake as high as the lowest place of its rim, and dig out the ground within.

    Only cells that lie wholly within the circle change, so the shore is the ground as it was.
    """
    turn = np.linspace(0.0, 2 * np.pi, 180, endpoint=False)
    rim_m = ground.ground_m(center_m[0] + radius_m * np.cos(turn), center_m[1] + radius_m * np.sin(turn))
    level_m = np.min(rim_m)
    center = ground.site.site_from_ground(*(np.array([value]) for value in (*center_m, level_m)))
    up = ups(ground.site, center)[0]
    wide = int(2 * radius_m / ground.cell_m)
    columns, rows = (
        np.arange(max(0, int(np.ceil((middle - radius_m - first) / ground.cell_m))), count)[: wide + 1]
        for middle, first, count in zip(center_m, (ground.west_m, ground.south_m), ground.z.shape[::-1], strict=True)
    )
    x = ground.west_m + ground.cell_m * columns[np.newaxis, :] - center_m[0]
    y = ground.south_m + ground.cell_m * rows[:, np.newaxis] - center_m[1]
    within = np.hypot(x, y) <= radius_m - np.sqrt(2.0) * ground.cell_m
    bed = center[0, 2] - (up[0] * x + up[1] * y) / up[2] - LAKE_DEPTH_M
    z = ground.z[np.ix_(rows, columns)]
    ground.z[np.ix_(rows, columns)] = np.where(within, np.minimum(z, bed), z)
    return Lake(center[0], up, radius_m, returns)


def ups(site: Site, points: FloatArray) -> FloatArray:
    """Return (n, 3) the ellipsoid's outward normals at (n, 3) site coordinates, in the site frame."""
    step_m = 100.0
    beside = [site.heights(points + step_m * axis) - site.heights(points - step_m * axis) for axis in np.eye(3)]
    gradient = np.stack(beside, axis=-1)
    unit: FloatArray = gradient / np.linalg.norm(gradient, axis=-1, keepdims=True)
    return unit
