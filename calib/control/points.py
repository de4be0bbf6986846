"""Take surveyed ground control points and find the planes of the swaths' returns on which they lie.

A surveyed point is only useful if the ground around it is flat: a plane is fitted to each swath's returns around the
point, and the point must lie within these returns. Heights are never extrapolated beyond returns.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from swath.calib.features import ControlPoint, Features, Patch, Plane
from swath.calib.flight import Flight, Swath, Tangent
from swath.calib.planes.local import LocalPlane, PlaneRules, is_inside, robust_plane
from swath.georef.arrays import BoolArray, FloatArray, Int64Array
from swath.georef.geodesy.earth import e_from_geodetic

SAME_PLACE_M = 0.01
BLOCK = 1_000_000  # returns that are processed at a time
CELLS_A_SIDE = 4096  # at most, of the grid that excludes returns far from all points


class ControlError(ValueError):
    """A control file that cannot be used; its message has one line for each mistake: file, line, remedy."""


@dataclass(frozen=True, slots=True)
class Surveyed:
    """A surveyed point: geodetic in the datum of the flight's positions, radians, metres
    above the ellipsoid, one sigma of each coordinate."""

    name: str
    lat_rad: float
    lon_rad: float
    height_m: float
    sigma_m: float


@dataclass(frozen=True, slots=True)
class ControlRules:
    """Requirements on the ground around a control point.

    Attributes:
        radius_m: horizontal radius around the point in which returns are used.
        widest_m: greater radius, for swaths with fewer than twice the returns that a plane needs.
        plane: rules of the plane through them.
        farthest_m: greatest distance of the point from the plane; larger distances are not errors of calibration.
        together_m: greatest distance of a swath's plane from the median at the point; farther planes are other
            surfaces.
        together_deg: likewise for their directions.
    """

    radius_m: float = 1.5
    widest_m: float = 4.0
    plane: PlaneRules = field(default_factory=lambda: PlaneRules(roughest_m=0.08))
    farthest_m: float = 10.0
    together_m: float = 2.0
    together_deg: float = 10.0


@dataclass(frozen=True, eq=False)
class Ground:
    """The ground that one swath shows at a control point.

    Attributes:
        point, swath: indexes in the points and in ``flight.swaths``.
        at: (n,) rising indexes of the returns of the plane.
        plane: plane through them.
        above_m: height of the surveyed point above the plane, along up.
    """

    point: int
    swath: int
    at: Int64Array
    plane: LocalPlane
    above_m: float


def same_places(points: Sequence[Surveyed]) -> list[tuple[int, int]]:
    """Return indexes of points that have the place of an earlier one, each with the earlier one's."""
    if len(points) < 2:
        return []
    places = e_from_geodetic(*np.array([[one.lat_rad, one.lon_rad, one.height_m] for one in points]).T)
    distance, nearest = cKDTree(places).query(places, k=2, distance_upper_bound=SAME_PLACE_M)
    found = {tuple(sorted(pair)) for pair in nearest[np.isfinite(distance).all(axis=1)].tolist()}
    return [(later, earlier) for earlier, later in sorted(found)]


def in_t(surveyed: Sequence[Surveyed], frame: Tangent) -> tuple[ControlPoint, ...]:
    """Transform surveyed points to a flight's frame t."""
    if not surveyed:
        return ()
    geodetic = np.array([[point.lat_rad, point.lon_rad, point.height_m] for point in surveyed])
    points_t = frame.t_from_e(e_from_geodetic(*geodetic.T))
    return tuple(ControlPoint(one.name, place, one.sigma_m) for one, place in zip(surveyed, points_t, strict=True))


def control_planes(flight: Flight, points: Sequence[ControlPoint], rules: ControlRules | None = None) -> Features:
    """Find the planes that control lies on, one for each point, with the returns of every swath that shows it.

    Args:
        flight: with its points placed as accurately as possible.
        points: in the flight's frame.
        rules: None: `ControlRules()`.

    Returns:
        planes of kind ``control``, named after their point; refused: counts of swaths' patches by reason, and points
        that no swath shows as ``control: no returns``.
    """
    rules = rules or ControlRules()
    grounds, refused = grounds_at(flight, points, rules)
    planes = []
    for number, point in enumerate(points):
        own = [one for one in grounds if one.point == number]
        near = [one for one in own if abs(one.above_m) <= rules.farthest_m]
        refused["control: far above or below"] += len(own) - len(near)
        kept = _of_one_surface(near, rules)
        refused["control: another surface"] += len(near) - len(kept)
        if kept:
            planes.append(_joined(flight, point, kept))
    return Features(planes=tuple(planes), refused=+refused)


def grounds_at(
    flight: Flight, points: Sequence[ControlPoint], rules: ControlRules
) -> tuple[list[Ground], Counter[str]]:
    """Return the ground that every swath shows at every point, in the points' order; count refusals by reason."""
    found: list[Ground] = []
    refused: Counter[str] = Counter()
    seen = np.zeros(len(points), dtype=bool)
    for number, swath in enumerate(flight.swaths):
        for point, wide in _returns_around(swath, points, max(rules.radius_m, rules.widest_m)):
            seen[point] = True
            place = points[point].position_t
            ground, reason = _ground(swath, number, point, place, _near(swath, place, wide, rules), rules)
            if ground is None:
                refused[f"control: {reason}"] += 1
            else:
                found.append(ground)
    refused["control: no returns"] += int((~seen).sum())
    return sorted(found, key=lambda one: one.point), +refused


@dataclass(frozen=True, eq=False)
class _Cells:
    """A grid of cells no smaller than a radius, with a mask of cells that contain or adjoin given places.

    Most returns are far from all control: their cell shows that without a search for the nearest point.
    """

    corner: FloatArray
    cell_m: float
    taken: BoolArray

    @classmethod
    def around(cls, places: FloatArray, radius_m: float) -> _Cells:
        """Create the grid for places (k, 2)."""
        low, high = places.min(axis=0), places.max(axis=0)
        cell_m = max(radius_m, float((high - low).max()) / CELLS_A_SIDE)
        corner = low - cell_m
        at = ((places - corner) / cell_m).astype(np.int64)
        taken = np.zeros(at.max(axis=0) + 2, np.bool_)
        for column in (-1, 0, 1):
            for row in (-1, 0, 1):
                taken[at[:, 0] + column, at[:, 1] + row] = True
        return cls(corner, cell_m, taken)

    def have(self, points: FloatArray) -> Int64Array:
        """Return rising indexes of points (n, 2) in such cells; points with nan are left out."""
        column, row = ((points[:, axis] - self.corner[axis]) / self.cell_m for axis in (0, 1))
        columns, rows = self.taken.shape
        inside = np.flatnonzero((column >= 0.0) & (row >= 0.0) & (column < columns) & (row < rows))
        taken = self.taken[column[inside].astype(np.int64), row[inside].astype(np.int64)]
        return np.asarray(inside[taken], np.int64)


def _returns_around(swath: Swath, points: Sequence[ControlPoint], radius_m: float) -> list[tuple[int, Int64Array]]:
    """Return the indexes of the points that have returns within a radius, each with the indexes of these returns."""
    if not points:
        return []
    places = np.array([point.position_t[:2] for point in points])
    tree, cells = cKDTree(places), _Cells.around(places, radius_m)
    near: list[Int64Array] = []
    for begin in range(0, len(swath), BLOCK):
        block = np.asarray(swath.points_t[begin : begin + BLOCK, :2])
        inside = cells.have(block)
        close = tree.query(block[inside], distance_upper_bound=radius_m)[0] < radius_m
        near.append(inside[close] + begin)
    at = np.concatenate([*near, np.zeros(0, np.int64)])
    if not len(at):
        return []
    around = cKDTree(swath.points_t[at, :2]).query_ball_point(places, radius_m, return_sorted=True)
    return [(number, at[np.array(one, dtype=np.int64)]) for number, one in enumerate(around) if len(one)]


def _near(swath: Swath, place_t: FloatArray, at: Int64Array, rules: ControlRules) -> Int64Array:
    """Return the returns within the radius around a point, or, if these are too few, twice as many as a plane needs."""
    away = np.hypot(*(swath.points_t[at, :2] - place_t[:2]).T)
    wanted = min(2 * rules.plane.fewest, len(at))
    farthest_m = max(rules.radius_m, float(np.partition(away, wanted - 1)[wanted - 1]))
    return np.asarray(at[away <= farthest_m], np.int64)


def _ground(
    swath: Swath, number: int, point: int, place_t: FloatArray, at: Int64Array, rules: ControlRules
) -> tuple[Ground | None, str]:
    returns_t = np.asarray(swath.points_t[at])
    plane, kept, reason = robust_plane(returns_t, rules.plane)
    if plane is None:
        return None, reason
    if not is_inside(place_t[:2], returns_t[kept, :2]):
        return None, "returns do not surround it"
    return Ground(point, number, at[kept], plane, plane.above_m(place_t)), ""


def _of_one_surface(grounds: list[Ground], rules: ControlRules) -> list[Ground]:
    """Return the grounds that lie on the same surface as the median one."""
    if len(grounds) < 2:
        return grounds
    above = np.array([one.above_m for one in grounds])
    normals = np.array([one.plane.normal_t for one in grounds])
    middle = int(np.argmin(np.abs(above - np.median(above))))
    agree = (np.abs(above - above[middle]) <= rules.together_m) & (
        normals @ normals[middle] >= math.cos(math.radians(rules.together_deg))
    )
    return [one for one, good in zip(grounds, agree, strict=True) if good]


def _joined(flight: Flight, point: ControlPoint, grounds: list[Ground]) -> Plane:
    points_t = np.concatenate([flight.swaths[one.swath].points_t[one.at] for one in grounds])
    normal = np.sum([one.plane.normal_t * len(one.at) for one in grounds], axis=0)
    rms_m = math.sqrt(sum(one.plane.rms_m**2 * len(one.at) for one in grounds) / sum(len(one.at) for one in grounds))
    return Plane(
        name=f"control {point.name}",
        centre_t=points_t.mean(axis=0),
        normal_t=normal / np.linalg.norm(normal),
        patches=tuple(Patch(one.swath, one.at) for one in grounds),
        rms_m=rms_m,
        control=(point,),
        kind="control",
    )
