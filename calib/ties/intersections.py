"""Find tie points where planes meet, ridges and corners, swath by swath (NGA Eq. 55 to 60).

Every swath's own planes, fitted to its own returns, are intersected: three in a corner; two in a ridge, of which the
point at a common place is used and counts as unknown along the ridge. The covariance comes from the fits. Such points
are made of the returns of the planes: they are observations beside other features, or instead of these planes, but not
together with them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.spatial import cKDTree

from swath.calib.features import Features, Plane, Sighting, TiePoint
from swath.calib.flight import Flight
from swath.georef.arrays import FloatArray, Int64Array

LEAST_RMS_M = 0.002  # lower limit of a patch's scatter
SPACINGS = 2.5  # patches that end within this many point spacings of a line may still meet in it


@dataclass(frozen=True, slots=True)
class TieSettings:
    """Limits for ridges and corners.

    Attributes:
        least_angle_rad: least angle between two planes of a ridge.
        least_volume: of the three unit normals of a corner; 1: at right angles.
        least_returns: of a patch.
        reach_m: greatest distance from the intersection to the returns of each patch; more where returns are sparse.
        least_length_m: of the stretch of a ridge that all its patches share.
        along_sigma_m: of a ridge's point along it: its place is unknown, but a covariance has to be finite.
        greatest_sigma_m: of a corner, and across a ridge.
        neighbours_m: greatest distance between planes' centres.
    """

    least_angle_rad: float = np.radians(20.0)
    least_volume: float = 0.15
    least_returns: int = 12
    reach_m: float = 1.5
    least_length_m: float = 1.0
    along_sigma_m: float = 100.0
    greatest_sigma_m: float = 0.10
    neighbours_m: float = 30.0


_DEFAULT = TieSettings()


@dataclass(frozen=True, eq=False)
class PatchFit:
    """A plane fitted to one swath's returns of a plane.

    Attributes:
        at: (n,) of the returns in the swath; `points_t`: (n, 3).
        centre_t: (3,) their mean.
        axes: (3, 3) rows: normal and the two main directions in the plane.
        variance: (3,) of height, and of the slopes along the two directions; uncorrelated, being principal axes.
        spacing_m: of the returns.
    """

    at: Int64Array
    points_t: FloatArray
    centre_t: FloatArray
    axes: FloatArray
    variance: FloatArray
    spacing_m: float

    def variance_at(self, point_t: FloatArray) -> float:
        """Return the variance in m² of the plane's place along its normal, at a point (3,) on it."""
        off = self.axes[1:] @ (point_t - self.centre_t)
        return float(self.variance @ [1.0, off[0] ** 2, off[1] ** 2])


def fit_patch(points_t: FloatArray, at: Int64Array, towards: FloatArray) -> PatchFit:
    """Fit a plane by orthogonal least squares to points (n, 3), n > 3; the normal points towards ``towards``."""
    centre = points_t.mean(axis=0)
    off = points_t - centre
    squares, axes = np.linalg.eigh(off.T @ off)
    axes = axes.T
    if axes[0] @ towards < 0.0:
        axes = -axes
    count = len(points_t)
    noise = max(float(squares[0]) / (count - 3), LEAST_RMS_M**2)
    spread = np.maximum(squares[:0:-1], 1e-9)
    axes = axes[[0, 2, 1]]
    area = 12.0 * float(np.sqrt(spread[0] * spread[1])) / count  # of a rectangle of even density
    variance = noise / np.array([count, spread[0], spread[1]])
    return PatchFit(at, points_t, centre, axes, variance, float(np.sqrt(area / count)))


def meet(
    fits: Sequence[PatchFit], line: tuple[FloatArray, float, float] | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return the point (3,) where three planes meet, and its covariance (3, 3) m².

    Args:
        fits: three planes; or two, with
        line: direction (3,), place along it, and its variance, which define the third plane.
    """
    normals = [fit.axes[0] for fit in fits]
    places = [float(fit.axes[0] @ fit.centre_t) for fit in fits]
    if line is not None:
        normals, places = [*normals, line[0]], [*places, line[1]]
    inverse = np.linalg.inv(np.array(normals))
    point = inverse @ np.array(places)
    variance = [fit.variance_at(point) for fit in fits] + ([] if line is None else [line[2]])
    covariance: FloatArray = inverse @ np.diag(variance) @ inverse.T
    return point, covariance


def find_ties(flight: Flight, planes: Features, settings: TieSettings = _DEFAULT) -> Features:
    """Find ridges and corners of planes that several swaths saw.

    Args:
        flight: with points.
        planes: `Features` of `swath.calib.planes.search`, of this flight with these points.
        settings: limits for ridges and corners.

    Returns:
        Features with ties only, kind ``ridge`` or ``corner``; refused candidates are counted by reason.
    """
    search = _Search(flight, planes.planes, settings)
    ties = [*search.ridges(), *search.corners()]
    return Features(ties=tuple(ties), refused=search.refused)


class _Search:
    """Searches planes that lie beside each other for ridges and corners."""

    def __init__(self, flight: Flight, planes: Sequence[Plane], settings: TieSettings) -> None:
        self._flight, self._planes, self._settings = flight, planes, settings
        self.refused: Counter[str] = Counter()
        self._fits: list[dict[int, PatchFit]] = [self._fitted(plane) for plane in planes]
        self._meeting: dict[tuple[int, int], frozenset[int]] = {}  # pairs of planes: swaths in which they meet

    def _fitted(self, plane: Plane) -> dict[int, PatchFit]:
        fits = {}
        for patch in plane.patches:
            if len(patch.at) < self._settings.least_returns:
                continue
            points = np.asarray(self._flight.swaths[patch.swath].points_t[patch.at])
            placed = np.isfinite(points[:, 0])
            if placed.sum() >= self._settings.least_returns:
                fits[patch.swath] = fit_patch(points[placed], patch.at[placed], plane.normal_t)
        return fits

    def _pairs(self) -> Iterator[tuple[int, int]]:
        if len(self._planes) < 2:
            return
        tree = cKDTree([plane.centre_t for plane in self._planes])
        for first, second in sorted(tree.query_pairs(self._settings.neighbours_m)):
            if len(self._fits[first].keys() & self._fits[second].keys()) > 1:
                yield first, second

    def ridges(self) -> Iterator[TiePoint]:
        """Yield points on the lines in which two planes meet."""
        for first, second in self._pairs():
            if abs(self._planes[first].normal_t @ self._planes[second].normal_t) > np.cos(
                self._settings.least_angle_rad
            ):
                self.refused["ridge: the planes are nearly parallel"] += 1
                continue
            tie = self._ridge(first, second)
            if isinstance(tie, str):
                self.refused[f"ridge: {tie}"] += 1
            else:
                yield tie

    def _ridge(self, first: int, second: int) -> TiePoint | str:
        one, other = self._fits[first], self._fits[second]
        direction = np.cross(self._planes[first].normal_t, self._planes[second].normal_t)
        direction /= np.linalg.norm(direction)
        stretches = {}
        for swath in sorted(one.keys() & other.keys()):
            stretch = self._stretch((one[swath], other[swath]), direction)
            if stretch is not None:
                stretches[swath] = stretch
        self._meeting[first, second] = frozenset(stretches)
        if len(stretches) < 2:
            return "the planes do not intersect in two swaths"
        low, high = max(low for low, _ in stretches.values()), min(high for _, high in stretches.values())
        if high - low < self._settings.least_length_m:
            return "the swaths share too little of it"
        line = (direction, 0.5 * (low + high), self._settings.along_sigma_m**2)
        seen = {swath: meet((one[swath], other[swath]), line) for swath in stretches}
        good = {
            swath: (point, covariance)
            for swath, (point, covariance) in seen.items()
            if np.sqrt(np.linalg.eigvalsh(covariance)[1]) <= self._settings.greatest_sigma_m
        }
        if len(good) < 2:
            return "too uncertain"
        names = f"{self._planes[first].name}/{self._planes[second].name}"
        return self._tie(f"ridge {names}", "ridge", good, (first, second))

    def _reach(self, fit: PatchFit) -> float:
        return max(self._settings.reach_m, SPACINGS * fit.spacing_m)

    def _stretch(self, fits: tuple[PatchFit, PatchFit], direction: FloatArray) -> tuple[float, float] | None:
        """Return begin and end of the stretch of the ridge to which both patches come near; None if it is empty."""
        middle = float(direction @ (0.5 * (fits[0].centre_t + fits[1].centre_t)))
        on_line, _ = meet(fits, (direction, middle, 1.0))
        ends = []
        for fit in fits:
            off = fit.points_t - on_line
            along = off @ direction
            near = np.linalg.norm(off - along[:, np.newaxis] * direction, axis=1) <= self._reach(fit)
            if near.sum() < 3:
                return None
            ends.append((along[near].min() + middle, along[near].max() + middle))
        low, high = max(low for low, _ in ends), min(high for _, high in ends)
        return (float(low), float(high)) if high > low else None

    def corners(self) -> Iterator[TiePoint]:
        """Yield points in which three planes meet whose pairs meet in lines too; call `ridges` before."""
        beside: dict[int, set[int]] = {}
        for first, second in self._meeting:
            if self._meeting[first, second]:
                beside.setdefault(first, set()).add(second)
        for first, others in sorted(beside.items()):
            for second, third in combinations(sorted(others), 2):
                if not self._meeting.get((second, third)):
                    continue
                tie = self._corner(first, second, third)
                if isinstance(tie, str):
                    self.refused[f"corner: {tie}"] += 1
                else:
                    yield tie

    def _corner(self, *three: int) -> TiePoint | str:
        volume = abs(float(np.linalg.det([self._planes[index].normal_t for index in three])))
        if volume < self._settings.least_volume:
            return "the planes are nearly in one line"
        swaths = frozenset.intersection(*(self._meeting[pair] for pair in combinations(three, 2)))
        good: dict[int, tuple[FloatArray, FloatArray]] = {}
        met = 0
        for swath in sorted(swaths):
            fits = [self._fits[index][swath] for index in three]
            point, covariance = meet(fits)
            away = [float(np.min(np.linalg.norm(fit.points_t - point, axis=1))) for fit in fits]
            if any(gap > 2.0 * self._reach(fit) for gap, fit in zip(away, fits, strict=True)):
                continue
            met += 1
            if np.sqrt(np.linalg.eigvalsh(covariance)[-1]) <= self._settings.greatest_sigma_m:
                good[swath] = point, covariance
        if len(good) < 2:
            return "the planes do not intersect in two swaths" if met < 2 else "too uncertain"
        names = "/".join(self._planes[index].name for index in three)
        return self._tie(f"corner {names}", "corner", good, three)

    def _tie(
        self, name: str, kind: str, seen: Mapping[int, tuple[FloatArray, FloatArray]], planes: Sequence[int]
    ) -> TiePoint:
        sightings = []
        for swath, (point, covariance) in sorted(seen.items()):
            fits = [self._fits[index][swath] for index in planes]
            points, at = np.concatenate([fit.points_t for fit in fits]), np.concatenate([fit.at for fit in fits])
            nearest = int(at[np.argmin(np.sum((points - point) ** 2, axis=1))])
            sightings.append(Sighting(swath, nearest, point, covariance))
        return TiePoint(name, tuple(sightings), kind=kind)
