"""Find pairs of flown strips by which a calibration is determined: opposite, crossing, at two heights."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from swath.georef.arrays import FloatArray, StructArray
from swath.georef.strips import StripRules, straight_spans

EARTH_M = 6.371e6
OPPOSITE_RAD = math.radians(20.0)
CROSSING_RAD = math.radians(45.0)  # two strips cross if their angle is that much from parallel
BESIDE = 0.5  # of the narrower half swath: opposite strips lie no farther apart
ALONG = 0.3  # of the shorter strip that lies beside the other one
HEIGHTS = 1.7  # times as high above the same ground: docs/planning-a-calibration.md, "What to fly"


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """A straight strip with the laser on.

    Attributes:
        begin_m, end_m: (2,) east and north.
        above_m: median height above the ground; nan: unknown.
        half_m: half the swath's width.
        begin_ns, end_ns: GPS times.
    """

    begin_m: FloatArray
    end_m: FloatArray
    above_m: float
    half_m: float
    begin_ns: int = 0
    end_ns: int = 0

    @property
    def length_m(self) -> float:
        """Length of the strip."""
        return float(np.linalg.norm(self.end_m - self.begin_m))

    @property
    def along(self) -> FloatArray:
        """Unit vector (2,) of the direction of flight."""
        found: FloatArray = (self.end_m - self.begin_m) / self.length_m
        return found

    def places_m(self, points_m: FloatArray) -> FloatArray:
        """Return places (n, 2) of points (n, 2): along the strip, and to its right."""
        away = points_m - self.begin_m
        along = self.along
        return np.stack([away @ along, away @ np.array([along[1], -along[0]])], axis=-1)


@dataclass(frozen=True, slots=True)
class FlownPairs:
    """Numbers of pairs of strips: opposite, crossing, at two heights; ``strips``: of strips."""

    strips: int = 0
    opposite: int = 0
    crossing: int = 0
    heights: int = 0


def tracks_of(rows: StructArray) -> list[Track]:
    """Return the straight strips of moments (n,) in the order of time, without those in which no return came."""
    if len(rows) < 2:
        return []
    about = float(rows["lat_rad"][0]), float(rows["lon_rad"][0])
    turned = (rows["lon_rad"] - about[1] + math.pi) % (2.0 * math.pi) - math.pi
    places = EARTH_M * np.stack([turned * math.cos(about[0]), rows["lat_rad"] - about[0]], axis=-1)
    rules, found = StripRules(), []
    for begin, end in straight_spans(rows["gps_ns"], rows["track_rad"], rows["roll_rad"], rules):
        at = np.flatnonzero((rows["gps_ns"] >= begin) & (rows["gps_ns"] < end) & (rows["returns"] > 0))
        if len(at) < rules.min_strip_s or not np.any(places[at[0]] != places[at[-1]]):
            continue
        strip = rows[at]
        half_m = _median((strip["right_m"] - strip["left_m"]) / 2.0)
        half_m = 0.0 if math.isnan(half_m) else half_m
        times = int(strip["gps_ns"][0]), int(strip["gps_ns"][-1])
        found.append(Track(places[at[0]], places[at[-1]], _median(strip["above_m"]), half_m, *times))
    return found


def _median(values: FloatArray) -> float:
    known = values[~np.isnan(values)]
    return float(np.median(known)) if len(known) else math.nan


def pairs_of(tracks: list[Track]) -> FlownPairs:
    """Count the pairs of strips that determine a calibration."""
    opposite = crossing = heights = 0
    for one, other in combinations(tracks, 2):
        angle = math.acos(max(-1.0, min(1.0, float(one.along @ other.along))))
        across = min(angle, math.pi - angle) >= CROSSING_RAD and _cross(one, other)
        beside = angle >= math.pi - OPPOSITE_RAD and _beside(one, other, BESIDE * min(one.half_m, other.half_m))
        opposite += beside
        crossing += across
        low, high = sorted((one.above_m, other.above_m))
        parallel = min(angle, math.pi - angle) <= OPPOSITE_RAD and _beside(one, other, one.half_m + other.half_m)
        heights += bool(low > 0.0 and high >= HEIGHTS * low and (across or parallel))
    return FlownPairs(len(tracks), opposite, crossing, heights)


def _cross(one: Track, other: Track) -> bool:
    """Return whether each strip passes through the other's swath."""
    return all(_meets(a, b) for a, b in ((one, other), (other, one)))


def _meets(one: Track, other: Track) -> bool:
    (along_b, right_b), (along_e, right_e) = one.places_m(np.stack([other.begin_m, other.end_m])).tolist()
    if right_b == right_e or right_b * right_e > 0.0:
        return False
    along = along_b + (along_e - along_b) * right_b / (right_b - right_e)
    return bool(-one.half_m <= along <= one.length_m + one.half_m)


def _beside(one: Track, other: Track, reach_m: float) -> bool:
    (along_b, right_b), (along_e, right_e) = one.places_m(np.stack([other.begin_m, other.end_m])).tolist()
    common_m = min(max(along_b, along_e), one.length_m) - max(min(along_b, along_e), 0.0)
    enough = common_m >= ALONG * min(one.length_m, other.length_m)
    return bool(enough and abs(right_b + right_e) / 2.0 <= reach_m)
