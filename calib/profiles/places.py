"""Find places for profiles: flight lines as straight tracks, and the corridors that Leica's procedure prescribes.

Roll: across both tracks of an opposite pair over one another. Pitch: along such a pair, below the aircraft. Heading:
along two overlapping lines side by side, below one of them (FORMULAS 5.4).
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from swath.calib.flight import Flight, Swath
from swath.calib.profiles.sections import Corridor
from swath.georef.arrays import FloatArray
from swath.georef.points import Fate
from swath.georef.scanner.calibration import Calibration

SAMPLES = 2000  # returns of a swath from which its track is estimated
PARALLEL = 0.985  # least cosine between tracks that count as parallel: 10°
ONE_ABOVE_OTHER = 0.2  # greatest distance, in heights above ground, of tracks that count as one track flown twice
SIDE_BY_SIDE = 0.2  # least distance of tracks for a heading, in heights above ground
STRAIGHT = 0.1  # greatest rms of a track from a straight line, in heights above ground
CROSS_PROFILES, ALONG_PROFILES = 9, 5  # candidates for a pair; those over the smoothest or the steepest ground are kept
NADIR = 0.06  # half width of the area that counts as below the aircraft, in heights above ground


@dataclass(frozen=True, eq=False)
class Track:
    """A swath's flight line, straight and level, on the map of t.

    Attributes:
        origin_t: (2,) below its middle.
        forward: (2,) unit vector; `right` is 90° to the right of it.
        height_m: mean, in t, of the scanner.
        half_length_m: to the ends of the ground it saw.
        above_m: mean height above the ground.
        left_m, right_m: how far the ground it saw reaches to the left (negative) and right of it.
        density: returns per square metre.
        straight: whether the line is straight enough.
    """

    origin_t: FloatArray
    forward: FloatArray
    height_m: float
    half_length_m: float
    above_m: float
    left_m: float
    right_m: float
    density: float
    straight: bool

    @property
    def right(self) -> FloatArray:
        """Unit vector (2,) to the right."""
        return np.array([self.forward[1], -self.forward[0]])

    def aside(self, places_t: FloatArray) -> FloatArray:
        """Return Y (k,): how far places (k, 2) are to the right of the track."""
        aside: FloatArray = (places_t - self.origin_t) @ self.right
        return aside


def track_of(flight: Flight, swath: Swath, calibration: Calibration) -> Track | None:
    """Return the track of a swath; None if too few of its returns can be placed."""
    if len(swath) < 10:
        return None
    at = np.unique(np.linspace(0, len(swath) - 1, SAMPLES).astype(np.int64))
    rays = flight.rays(swath, calibration, at, with_axes=False)
    good = rays.fate == Fate.GEOREFERENCED
    if good.sum() < 10:
        return None
    scanner_t = flight.frame.t_from_e(rays.origin_e[good])
    ground_t = flight.frame.t_from_e(rays.points_e[good])
    middle = scanner_t[:, :2].mean(axis=0)
    away = scanner_t[:, :2] - middle
    forward = np.linalg.svd(away, full_matrices=False)[2][0]
    if (away[-1] - away[0]) @ forward < 0.0:
        forward = -forward
    right = np.array([forward[1], -forward[0]])
    along, aside = (ground_t[:, :2] - middle) @ forward, (ground_t[:, :2] - middle) @ right
    first, last = np.percentile(along, [0.5, 99.5])
    left_m, right_m = np.percentile(aside, [0.5, 99.5])
    above_m = float(scanner_t[:, 2].mean() - np.median(ground_t[:, 2]))
    return Track(
        middle + 0.5 * (first + last) * forward,
        forward,
        float(scanner_t[:, 2].mean()),
        0.5 * float(last - first),
        above_m,
        float(left_m),
        float(right_m),
        len(swath) / max(float((last - first) * (right_m - left_m)), 1.0),
        bool(np.std(away @ right) <= STRAIGHT * above_m),
    )


def tracks_of(flight: Flight, calibrations: Mapping[str, Calibration]) -> list[Track | None]:
    """Return the tracks of all swaths."""
    return [track_of(flight, swath, calibrations[flight.heads[swath.head].name]) for swath in flight.swaths]


@dataclass(frozen=True, eq=False)
class Place:
    """A corridor for a profile of two swaths, given by their indexes in `Flight.swaths`."""

    kind: str
    first: int
    second: int
    corridor: Corridor


def places(
    flight: Flight, tracks: Sequence[Track | None], kind: str, half_width_m: float, pitch_unknown: Collection[str] = ()
) -> Iterator[list[Place]]:
    """Yield the corridors of a kind, ``roll``, ``pitch`` or ``heading``, for each pair of swaths of one scanner.

    A wrong pitch separates opposite lines side by side as a wrong heading does: such pairs are used for the heading
    only of scanners whose pitch is known, not of those in ``pitch_unknown``.
    """
    for first in range(len(tracks)):
        for second in range(first + 1, len(tracks)):
            one, other = tracks[first], tracks[second]
            if one is None or other is None or not (one.straight and other.straight):
                continue
            head = flight.swaths[first].head
            told_apart = kind != "heading" or flight.heads[head].name not in pitch_unknown
            if not told_apart and one.forward @ other.forward < 0.0:
                continue
            if flight.swaths[second].head == head:
                found = _PLACED[kind](one, other, half_width_m)
                if found:
                    yield [Place(kind, first, second, corridor) for corridor in found]


def _stretch(one: Track, other: Track) -> tuple[float, float]:
    """Return the begin and end, along the first track, of the stretch in which both swaths have ground."""
    sense = float(one.forward @ other.forward)
    middle = float((other.origin_t - one.origin_t) @ one.forward)
    half = abs(sense) * other.half_length_m
    return max(-one.half_length_m, middle - half), min(one.half_length_m, middle + half)


def _apart(one: Track, other: Track) -> float:
    """Return how far the other track is to the right of the first, where they overlap."""
    middle = one.origin_t + 0.5 * sum(_stretch(one, other)) * one.forward
    onto = other.origin_t + ((middle - other.origin_t) @ other.forward) * other.forward
    return float((onto - one.origin_t) @ one.right)


def _is_twice_flown(one: Track, other: Track) -> bool:
    opposite = float(one.forward @ other.forward) < -PARALLEL
    return opposite and abs(_apart(one, other)) <= ONE_ABOVE_OTHER * min(one.above_m, other.above_m)


def _across(one: Track, other: Track, half_width_m: float) -> list[Corridor]:
    """Return corridors across an opposite pair, over the full width that both saw."""
    low, high = _stretch(one, other)
    if not _is_twice_flown(one, other) or high - low < 4.0 * half_width_m:
        return []
    apart = _apart(one, other)
    left_m, right_m = max(one.left_m, apart - other.right_m), min(one.right_m, apart - other.left_m)
    if right_m - left_m < one.above_m * NADIR:
        return []
    border = 0.05 * (high - low)
    where = np.linspace(low + border, high - border, CROSS_PROFILES)
    ends = [one.origin_t + along * one.forward for along in where]
    return [Corridor.between(end + left_m * one.right, end + right_m * one.right, half_width_m) for end in ends]


def _along(one: Track, other: Track, half_width_m: float, middle_m: float) -> list[Corridor]:
    """Return corridors along the first track, around a line at a given distance to the right of it."""
    low, high = _stretch(one, other)
    if high - low < 10.0 * half_width_m:
        return []
    steps = np.arange(ALONG_PROFILES) - (ALONG_PROFILES - 1) / 2
    reach = max(NADIR * one.above_m, (ALONG_PROFILES - 1) * half_width_m)
    beside = middle_m + steps * 2.0 * reach / (ALONG_PROFILES - 1)
    starts = [one.origin_t + low * one.forward + right_m * one.right for right_m in beside]
    return [Corridor.between(start, start + (high - low) * one.forward, half_width_m) for start in starts]


def _below(one: Track, other: Track, half_width_m: float) -> list[Corridor]:
    """Return corridors along an opposite pair, at nadir of both."""
    return _along(one, other, half_width_m, 0.5 * _apart(one, other)) if _is_twice_flown(one, other) else []


def _beside(one: Track, other: Track, half_width_m: float) -> list[Corridor]:
    """Return corridors along two lines side by side, at nadir of each as far as the other sees it."""
    apart, sense = _apart(one, other), float(one.forward @ other.forward)
    if abs(sense) < PARALLEL or abs(apart) < SIDE_BY_SIDE * min(one.above_m, other.above_m):
        return []
    found: list[Corridor] = []
    turned = 1.0 if sense > 0.0 else -1.0
    if other.left_m < -turned * apart < other.right_m:  # the first track's nadir, if the other sees it
        found += _along(one, other, half_width_m, 0.0)
    if one.left_m < apart < one.right_m:
        found += _along(one, other, half_width_m, apart)
    return found


_PLACED = {"roll": _across, "pitch": _below, "heading": _beside}
