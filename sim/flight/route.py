"""The way of the aircraft before it is smoothed: straights and circles in the site plane, with times.

Between two lines the way is the shortest of Dubins' six words (L. E. Dubins, "On curves of minimal length with a
constraint on average curvature", Am. J. Math. 79, 1957), in the closed form of A. M. Shkel and V. Lumelsky,
"Classification of the Dubins set", Robotics and Autonomous Systems 34, 2001. Courses are clockwise from north (y of the
site), so that their "left" is right here; a right turn has positive curvature.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from swath.georef.arrays import FloatArray

TURN = 2.0 * math.pi
_NO_TURN_RAD = 1e-9  # an angle that falls short of a whole turn by less is rounding
_EXTENSIONS = 200


@dataclass(frozen=True, slots=True)
class Pose:
    """A place in the site plane, metres, and a course, clockwise from north."""

    east_m: float
    north_m: float
    course_rad: float

    def ahead(self, distance_m: float) -> Pose:
        """Return the pose this far straight ahead, or back if the distance is negative."""
        return Arc(self, distance_m, 0.0).end


@dataclass(frozen=True, slots=True)
class Arc:
    """Part of a circle, or a straight.

    Attributes:
        start: pose at its beginning.
        length_m: its length.
        curvature_per_m: positive to the right; 0 is a straight.
    """

    start: Pose
    length_m: float
    curvature_per_m: float

    def positions(self, along_m: FloatArray) -> FloatArray:
        """Return (n, 2) east, north at distances (n,) from the start, also beyond either end.

        They follow from the chord and half the turn.
        """
        half_turn = 0.5 * self.curvature_per_m * along_m
        chord_m = along_m * np.sinc(half_turn / math.pi)
        course = self.start.course_rad + half_turn
        return np.stack(
            [self.start.east_m + chord_m * np.sin(course), self.start.north_m + chord_m * np.cos(course)], axis=-1
        )

    @property
    def end(self) -> Pose:
        """Pose at the end."""
        half_turn = 0.5 * self.curvature_per_m * self.length_m
        chord_m = self.length_m * (math.sin(half_turn) / half_turn if half_turn else 1.0)
        course = self.start.course_rad + half_turn
        east_m = self.start.east_m + chord_m * math.sin(course)
        return Pose(east_m, self.start.north_m + chord_m * math.cos(course), course + half_turn)


Way = tuple[Arc, ...]


def length_m(way: Way) -> float:
    """Return the length of a whole way."""
    return sum(arc.length_m for arc in way)


@dataclass(frozen=True, slots=True)
class Turning:
    """The tightest turns that an aircraft can fly.

    Attributes:
        radius_m: radius of any turn.
        reversal_radius_m: radius of a turn that a turn to the other side follows at once.
        reversal_gap_m: straight between two opposite turns from which on they count as separate turns.
    """

    radius_m: float
    reversal_radius_m: float
    reversal_gap_m: float


def shortest_way(start: Pose, end: Pose, turning: Turning) -> Way:
    """Return the shortest way from pose to pose; it has no arc if both are the same."""
    words = _words(start, end, turning)
    return _way(start, min(words, key=lambda word: word.radius_m * sum(word.parts)))


def way_of_length(start: Pose, end: Pose, turning: Turning, least_m: float) -> Way:
    """Return the shortest way that is at least ``least_m`` long.

    Whole circles lengthen it first; turning later adds the rest.
    """
    shortest = shortest_way(start, end, turning)
    missing_m = least_m - length_m(shortest)
    if missing_m <= 0.0:
        return shortest
    circle_m = TURN * turning.radius_m
    circles = math.floor(missing_m / circle_m)
    choices = [(*_circles(start, shortest, turning, circles + 1), *shortest)]
    for on_m in np.linspace(0.0, 0.5 * circle_m, _EXTENSIONS + 1)[1:].tolist():
        late, early = start.ahead(on_m), end.ahead(-on_m)
        turn = shortest_way(late, early, turning)
        longer = (Arc(start, on_m, 0.0), *_circles(late, turn, turning, circles), *turn, Arc(early, on_m, 0.0))
        if length_m(longer) >= least_m:
            choices.append(longer)
    return min(choices, key=length_m)


def _circles(start: Pose, way: Way, turning: Turning, count: int) -> Way:
    """Return whole circles, flown to the side to which the way turns next."""
    if count == 0:
        return ()
    curvature = next((arc.curvature_per_m for arc in way if arc.curvature_per_m != 0.0), 1.0)
    return (Arc(start, count * TURN * turning.radius_m, math.copysign(1.0 / turning.radius_m, curvature)),)


@dataclass(frozen=True, slots=True)
class _Word:
    """Three turns (1 right, 0 straight, −1 left) and their lengths in radii."""

    turns: tuple[int, int, int]
    parts: tuple[float, float, float]
    radius_m: float

    def fits(self, turning: Turning) -> bool:
        """Return True if the radius is as wide as the word needs."""
        near = self.parts[1] * self.radius_m < turning.reversal_gap_m
        reverses = self.turns[1] != 0 or (self.turns[0] != self.turns[2] and near)
        return self.radius_m >= (turning.reversal_radius_m if reverses else turning.radius_m)


def _words(start: Pose, end: Pose, turning: Turning) -> Iterator[_Word]:
    """Yield all words that connect two poses, each with the radii that it may be flown with."""
    east_m, north_m = end.east_m - start.east_m, end.north_m - start.north_m
    bearing, distance_m = math.atan2(east_m, north_m), math.hypot(east_m, north_m)
    for radius_m in (turning.radius_m, turning.reversal_radius_m):
        for side in (1, -1):
            alpha, beta = side * (start.course_rad - bearing), side * (end.course_rad - bearing)
            for (first, middle, last), parts in _right_words(alpha, beta, distance_m / radius_m):
                word = _Word((side * first, side * middle, side * last), parts, radius_m)
                if word.fits(turning):
                    yield word


def _right_words(
    alpha: float, beta: float, distance: float
) -> Iterator[tuple[tuple[int, int, int], tuple[float, float, float]]]:
    """Yield LSL, LRL and LSR of Shkel and Lumelsky, their left being right; the mirror images are the other three."""
    x, y = distance + math.sin(alpha) - math.sin(beta), math.cos(beta) - math.cos(alpha)
    between, heading = math.hypot(x, y), math.atan2(y, x)
    yield (1, 0, 1), (_positive(heading - alpha), between, _positive(beta - heading))
    if between <= 4.0:
        middle = TURN - 2.0 * math.asin(between / 4.0)
        yield (1, -1, 1), (_positive(heading - alpha + middle / 2), middle, _positive(beta - heading + middle / 2))
    x, y = distance + math.sin(alpha) + math.sin(beta), -math.cos(alpha) - math.cos(beta)
    if x * x + y * y >= 4.0:
        straight = math.sqrt(x * x + y * y - 4.0)
        heading = math.atan2(y, x) + math.atan2(2.0, straight)
        yield (1, 0, -1), (_positive(heading - alpha), straight, _positive(heading - beta))


def _positive(angle_rad: float) -> float:
    """Return the same angle in [0, 2π)."""
    angle_rad %= TURN
    return 0.0 if angle_rad > TURN - _NO_TURN_RAD else angle_rad


def _way(start: Pose, word: _Word) -> Way:
    arcs: list[Arc] = []
    for turn, part in zip(word.turns, word.parts, strict=True):
        if part > 0.0:
            arcs.append(Arc(arcs[-1].end if arcs else start, part * word.radius_m, turn / word.radius_m))
    return tuple(arcs)


@dataclass(frozen=True, slots=True)
class Leg:
    """A way and how it is flown.

    Speed changes evenly in time. Height changes evenly too, except for a wait at either end.

    Attributes:
        way: at least one arc.
        duration_s: time that it takes.
        speeds_mps: over the ground at its start and end.
        heights_m: ellipsoidal, at its start and end.
        wait_s: level flight before and after the change of height.
        line: index of the flight line that this leg is; −1 for any other leg.
        airborne: False on the ground.
    """

    way: Way
    duration_s: float
    speeds_mps: tuple[float, float]
    heights_m: tuple[float, float]
    wait_s: float = 0.0
    line: int = -1
    airborne: bool = True

    @classmethod
    def over(cls, way: Way, speeds_mps: tuple[float, float], heights_m: tuple[float, float], line: int = -1) -> Leg:
        """Make a leg whose duration follows from its speeds and the length of its way."""
        return cls(way, 2.0 * length_m(way) / sum(speeds_mps), speeds_mps, heights_m, line=line)

    @property
    def end(self) -> Pose:
        """Pose at the end."""
        return self.way[-1].end

    def sample(self, time_s: FloatArray) -> FloatArray:
        """Return (n, 4) east, north, height, airborne (0 or 1) at times (n,) since the leg's start."""
        first, last = self.speeds_mps
        along_m = first * time_s + 0.5 * (last - first) / self.duration_s * time_s**2
        starts = np.cumsum([0.0, *(arc.length_m for arc in self.way[:-1])])
        part = np.maximum(np.searchsorted(starts, along_m, side="right") - 1, 0)
        sampled = np.full((len(time_s), 4), float(self.airborne))
        for i, arc in enumerate(self.way):
            sampled[part == i, :2] = arc.positions(along_m[part == i] - starts[i])
        share = np.clip((time_s - self.wait_s) / (self.duration_s - 2.0 * self.wait_s), 0.0, 1.0)
        sampled[:, 2] = self.heights_m[0] + share * (self.heights_m[1] - self.heights_m[0])
        return sampled


class Route:
    """Consecutive legs from time 0; the motion continues unchanged before the first and after the last leg.

    Args:
        legs: the first and the last are straight or at rest, at constant speed and height.
    """

    def __init__(self, legs: list[Leg]) -> None:
        self.legs = tuple(legs)
        self.starts_s: FloatArray = np.cumsum([0.0, *(leg.duration_s for leg in legs)])

    def sample(self, time_s: FloatArray) -> FloatArray:
        """Return (n, 4) east, north, height, airborne (0 or 1) at times (n,), which ascend."""
        cuts = np.searchsorted(time_s, self.starts_s[1:-1])
        parts = zip(self.legs, self.starts_s[:-1], np.split(time_s, cuts), strict=True)
        return np.concatenate([leg.sample(part - start_s) for leg, start_s, part in parts])
