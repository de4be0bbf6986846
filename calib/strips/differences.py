"""Measure the remaining distances of strips: point to plane on planar overlap (ISO/TS 19159-2, 6.7; FORMULAS 8).

The overlap is cut into cells. Where the returns of both strips in a cell form planes, one return of the first strip is
a check point, and its distance from the second strip's plane is the difference: d along the normal, Δz along up, the
first strip minus the second. Only single returns count, which excludes vegetation.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from swath.calib.flight import Flight
from swath.calib.strips.cells import FlightStrip, Gathered, StripRules, blocks_of, gather, overlap_cells
from swath.georef.arrays import BoolArray, FloatArray, Int64Array

OVERLAP_SLOPE_DEG = 10.0  # USGS: overlap is judged on gentler slopes only
GENTLE = math.cos(math.radians(OVERLAP_SLOPE_DEG))  # least vertical component of their normals
FLOOR_M = 0.003  # of the noise of a difference: no natural plane is smoother


@dataclass(frozen=True, eq=False)
class Checks:
    """Check points against planes, one row each (n,) or (n, 3).

    Attributes:
        first, second: index of the check point's strip and of the plane's.
        point, centre: the check point, and the mean of the plane's returns.
        normal: of the plane, unit, upwards.
        distance_m: d = n · (p − c).
        height_m: Δz = d / n_z.
        noise_m: sigma of d by the roughness of both planes.
        count: returns of the plane.
        point_ns, centre_ns: GPS time of the check point; mean time of the plane's returns.
        point_direction, centre_direction: of the scan, −1 … 1.
    """

    first: Int64Array
    second: Int64Array
    point: FloatArray
    centre: FloatArray
    normal: FloatArray
    distance_m: FloatArray
    height_m: FloatArray
    noise_m: FloatArray
    count: Int64Array
    point_ns: Int64Array
    centre_ns: Int64Array
    point_direction: FloatArray
    centre_direction: FloatArray

    def __len__(self) -> int:
        """Return the number of check points."""
        return len(self.distance_m)

    @property
    def gentle(self) -> BoolArray:
        """Mask (n,) of the slopes on which specifications judge heights."""
        return np.asarray(self.normal[:, 2] >= GENTLE)

    def take(self, which: Any) -> Checks:
        """Select some rows."""
        return Checks(*(getattr(self, name)[which] for name in self.__dataclass_fields__))


@dataclass(frozen=True, slots=True)
class Numbers:
    """Statistics of differences, metres; RMS² = mean² + std² (divided by their number)."""

    count: int
    mean_m: float
    std_m: float
    rms_m: float
    max_m: float
    median_m: float
    p95_m: float

    @classmethod
    def of(cls, values: FloatArray) -> Numbers:
        """Compute the statistics of values (n,); nan if there are none."""
        if not len(values):
            return cls(0, *([math.nan] * 6))
        size = np.abs(values)
        return cls(
            len(values),
            float(values.mean()),
            float(values.std()),
            float(np.sqrt(np.mean(values**2))),
            float(size.max()),
            float(np.median(values)),
            float(np.percentile(size, 95.0)),
        )


@dataclass(frozen=True, slots=True)
class PairReport:
    """The differences of two strips.

    Attributes:
        first, second: names.
        distance: d, all slopes.
        height: Δz where slopes are below 10°.
        noise_m: RMS that d would have from the returns' noise alone.
        systematic_m: the part of its RMS beyond that.
    """

    first: str
    second: str
    distance: Numbers
    height: Numbers
    noise_m: float
    systematic_m: float


@dataclass(frozen=True, eq=False)
class StripReport:
    """The differences of all strips from each other.

    Attributes:
        names: of the strips.
        pairs: pairs that share planar cells.
        all: all pairs together.
        roughness_m: by strip, RMS of √λ0 of its planes: its repeatability within itself.
        refused: cells of pairs that were not compared, by reason.
        cell_m: side of the cells.
        checks: the check points of all pairs.
    """

    names: tuple[str, ...]
    pairs: tuple[PairReport, ...]
    all: PairReport
    roughness_m: dict[str, float]
    refused: Counter[str]
    cell_m: float
    checks: Checks = field(repr=False)


def differences(flight: Flight, rules: StripRules | None = None) -> StripReport:
    """Compare the strips of a flight with its points as placed."""
    rules = rules or StripRules()
    strips = [FlightStrip(swath) for swath in flight.swaths]
    cells = overlap_cells(strips, rules)
    return report_of([strip.name for strip in strips], gather(blocks_of(strips), cells), rules, cells.cell_m)


def report_of(names: Sequence[str], gathered: Gathered, rules: StripRules, cell_m: float) -> StripReport:
    """Compute the differences from the returns in the cells."""
    planes = _planes(gathered, rules, cell_m)
    checks, refused = _checks(gathered, planes)
    pairs = []
    for first, second in sorted(set(zip(checks.first.tolist(), checks.second.tolist(), strict=True))):
        own = checks.take((checks.first == first) & (checks.second == second))
        pairs.append(_pair(names[first], names[second], own))
    rms = {
        name: float(np.sqrt(np.mean(planes.rms_m[good] ** 2)))
        for number, name in enumerate(names)
        if (good := (planes.strip == number) & (planes.reason == 0)).any()
    }
    return StripReport(tuple(names), tuple(pairs), _pair("", "", checks), rms, refused, cell_m, checks)


def single_return_sigma_m(variance_m2: FloatArray, count: FloatArray) -> float:
    """Return the sigma of single returns about a hard surface, metres.

    It comes from the lower quartile of the planes' variances, which vegetation on the other planes does not affect.
    Quartile of χ²: Wilson and Hilferty (1931).

    Args:
        variance_m2: (n,) of returns about their planes, by their number less 3.
        count: (n,) returns of each plane.
    """
    spread = 2.0 / (9.0 * np.maximum(count - 3, 1))
    quartile = (1.0 - spread - 0.67449 * np.sqrt(spread)) ** 3
    return float(np.sqrt(np.quantile(variance_m2 / quartile, 0.25)))


def _pair(first: str, second: str, checks: Checks) -> PairReport:
    distance = Numbers.of(checks.distance_m)
    noise_m = float(np.sqrt(np.mean(checks.noise_m**2))) if len(checks) else math.nan
    beyond = max(distance.rms_m**2 - noise_m**2, 0.0) if len(checks) else math.nan
    return PairReport(first, second, distance, Numbers.of(checks.height_m[checks.gentle]), noise_m, math.sqrt(beyond))


# ---------------------------------------------------------------------- planes


@dataclass(frozen=True, eq=False)
class _Planes:
    """A plane for each strip and cell, (n,) or (n, 3): its returns, its fit, and why it is refused (0: accepted)."""

    cell: Int64Array
    strip: Int64Array
    begin: Int64Array
    count: Int64Array
    centre: FloatArray
    normal: FloatArray
    rms_m: FloatArray
    reason: Int64Array


REASONS = ("", "too rough", "too steep", "returns in a line", "too few returns", "not within the returns")
NARROWEST = 0.125  # of a cell: the least spread (one sigma) of a plane's returns across their line


def _planes(gathered: Gathered, rules: StripRules, cell_m: float) -> _Planes:
    """Fit least squares planes: the normal is the eigenvector of the smallest eigenvalue λ0 of the covariance."""
    key = np.stack([gathered.cell, gathered.strip])
    begin = np.flatnonzero(np.append(True, (np.diff(key, axis=1) != 0).any(axis=0))[: key.shape[1]])
    count = np.diff(np.append(begin, key.shape[1]))
    if not len(begin):
        none, vectors = np.zeros(0, np.int64), np.zeros((0, 3))
        return _Planes(none, none, none, none, vectors, vectors, np.zeros(0), none)
    centre = np.add.reduceat(gathered.points, begin) / count[:, np.newaxis]
    offsets = gathered.points - np.repeat(centre, count, axis=0)
    covariance = np.empty((len(begin), 3, 3))
    for i in range(3):
        for j in range(i + 1):
            covariance[:, i, j] = covariance[:, j, i] = np.add.reduceat(offsets[:, i] * offsets[:, j], begin) / count
    values, vectors = np.linalg.eigh(covariance)
    normal = vectors[:, :, 0] * np.where(vectors[:, 2:, 0] >= 0.0, 1.0, -1.0)
    rms_m = np.sqrt(np.maximum(values[:, 0], 0.0) * count / np.maximum(count - 3, 1))
    reason = np.zeros(len(begin), np.int64)
    reason[rms_m > rules.roughest_m] = 1
    reason[normal[:, 2] < math.cos(math.radians(rules.steepest_deg))] = 2
    reason[values[:, 1] < (NARROWEST * cell_m) ** 2] = 3
    reason[count < rules.fewest] = 4
    return _Planes(gathered.cell[begin], gathered.strip[begin], begin, count, centre, normal, rms_m, reason)


def _checks(gathered: Gathered, planes: _Planes) -> tuple[Checks, Counter[str]]:
    """Return a check point for every two strips that are planar in a cell."""
    refused: Counter[str] = Counter()
    none = np.zeros(0, np.int64)
    pieces = [_checks_of(gathered, planes, none, none, refused)]
    apart = 1
    while len(at := np.flatnonzero(planes.cell[apart:] == planes.cell[:-apart])):
        pieces.append(_checks_of(gathered, planes, at, at + apart, refused))
        apart += 1
    columns = ([getattr(piece, name) for piece in pieces] for name in Checks.__dataclass_fields__)
    return Checks(*(np.concatenate(column) for column in columns)), +refused


def _checks_of(
    gathered: Gathered, planes: _Planes, first: Int64Array, second: Int64Array, refused: Counter[str]
) -> Checks:
    """Return the check points of pairs of planes; the planes of a pair share a cell."""
    worst = np.maximum(planes.reason[first], planes.reason[second])
    refused.update({REASONS[number]: int((worst == number).sum()) for number in range(1, 5)})
    first, second = first[worst == 0], second[worst == 0]
    nearest = _nearest(gathered, planes, first, planes.centre[second])
    point = gathered.points[nearest]
    inside = _inside(gathered, planes, second, point)
    refused[REASONS[5]] += int((~inside).sum())
    first, second, nearest, point = first[inside], second[inside], nearest[inside], point[inside]
    count, normal, centre = planes.count[second], planes.normal[second], planes.centre[second]
    distance = ((point - centre) * normal).sum(axis=1)
    noise = np.sqrt(planes.rms_m[first] ** 2 + planes.rms_m[second] ** 2 / np.maximum(count, 1))
    return Checks(
        first=planes.strip[first],
        second=planes.strip[second],
        point=point,
        centre=centre,
        normal=normal,
        distance_m=distance,
        height_m=distance / normal[:, 2],
        noise_m=np.maximum(noise, FLOOR_M),
        count=count,
        point_ns=gathered.time_ns[nearest],
        centre_ns=_mean_ns(gathered, planes, second),
        point_direction=gathered.direction[nearest].astype(np.float64),
        centre_direction=_of_members(gathered, planes, second, gathered.direction.astype(np.float64)),
    )


def _members(planes: _Planes, which: Int64Array) -> tuple[Int64Array, Int64Array]:
    """Return the returns of some planes, plane after plane, and the begin of each plane among them."""
    count = planes.count[which]
    begins = np.cumsum(count) - count
    within = np.arange(int(count.sum())) - np.repeat(begins, count)
    return np.repeat(planes.begin[which], count) + within, begins


def _nearest(gathered: Gathered, planes: _Planes, which: Int64Array, places: FloatArray) -> Int64Array:
    """Return, for each of some planes, the return that is horizontally nearest to its place (n, 3)."""
    if not len(which):
        return np.zeros(0, np.int64)
    members, begins = _members(planes, which)
    owner = np.repeat(np.arange(len(which)), planes.count[which])
    away = np.hypot(*(gathered.points[members, :2] - places[owner, :2]).T)
    order = np.lexsort((away, owner))
    return np.asarray(members[order][begins], np.int64)


def _inside(gathered: Gathered, planes: _Planes, which: Int64Array, places: FloatArray) -> BoolArray:
    """Return whether places lie within the convex hulls of planes' returns.

    That is so if no half of the horizon around a place is free of returns.
    """
    if not len(which):
        return np.zeros(0, bool)
    members, begins = _members(planes, which)
    owner = np.repeat(np.arange(len(which)), planes.count[which])
    offsets = gathered.points[members, :2] - places[owner, :2]
    angles = np.arctan2(offsets[:, 1], offsets[:, 0])
    angles = angles[np.lexsort((angles, owner))]
    following = np.append(angles[1:], 0.0)
    ends = begins + planes.count[which] - 1
    following[ends] = angles[begins] + 2.0 * math.pi
    return np.asarray(np.maximum.reduceat(following - angles, begins) <= math.pi)


def _of_members(gathered: Gathered, planes: _Planes, which: Int64Array, values: FloatArray) -> FloatArray:
    """Return means (n,) over planes' returns."""
    if not len(which):
        return np.zeros(0)
    members, begins = _members(planes, which)
    return np.asarray(np.add.reduceat(values[members], begins) / planes.count[which])


def _mean_ns(gathered: Gathered, planes: _Planes, which: Int64Array) -> Int64Array:
    """Return mean times (n,), computed relative to each plane's first return to keep their digits."""
    starts = gathered.time_ns[planes.begin]
    after = (gathered.time_ns - np.repeat(starts, planes.count)).astype(np.float64)
    return np.asarray(starts[which] + np.rint(_of_members(gathered, planes, which, after)).astype(np.int64))
