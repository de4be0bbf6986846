"""Sections of the ground along a line: returns in a narrow corridor, and the planes of its short pieces.

A section is measured by planes fitted to a few metres of it, never by single points: heights, slopes and their sigmas
come from all returns of a piece, and the scatter of a piece reveals a ridge, a hedge or a car in it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from swath.georef.arrays import BoolArray, FloatArray, Int64Array

ROUNDS = 3  # of a piece's plane: once from all its returns, then without distant ones
FAR = 3.0  # a return is left out beyond this multiple of the median deviation (as a sigma)
LEAST_RMS_M = 0.002  # lower limit of a piece's scatter
_SIGMA_OF_MEDIAN = 1.4826


@dataclass(frozen=True, eq=False)
class Corridor:
    """The corridor of a profile, on the map of t.

    Attributes:
        origin_t: (2,) east and north of its begin.
        along: (2,) unit vector to its end; `across` is 90° to the right of it.
        length_m: from begin to end.
        half_width_m: to either side.
    """

    origin_t: FloatArray
    along: FloatArray
    length_m: float
    half_width_m: float

    @classmethod
    def between(cls, start_t: FloatArray, end_t: FloatArray, half_width_m: float) -> Corridor:
        """Create the corridor from one point to another, (2,) or (3,), of which only east and north count."""
        way = np.asarray(end_t, np.float64)[:2] - np.asarray(start_t, np.float64)[:2]
        length_m = float(np.hypot(*way))
        return cls(np.array(start_t[:2], np.float64), way / length_m, length_m, half_width_m)

    @property
    def across(self) -> FloatArray:
        """Unit vector (2,) to the right of `along`."""
        return np.array([self.along[1], -self.along[0]])

    def coordinates(self, points_t: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return distances along (n,) and across (n,) of points (n, ≥ 2)."""
        away = points_t[:, :2] - self.origin_t
        return away @ self.along, away @ self.across

    def holds(self, points_t: FloatArray, wider_m: float = 0.0) -> BoolArray:
        """Return whether points lie in the corridor (n,), or in one that is longer by ``wider_m`` at either end."""
        distance, aside = self.coordinates(points_t)
        inside: BoolArray = np.abs(aside) <= self.half_width_m
        inside &= (distance >= -wider_m) & (distance <= self.length_m + wider_m)
        return inside

    def part(self, middle_m: float, length_m: float) -> Corridor:
        """Return a part of the corridor with a given length, around a distance from its begin."""
        begin_t = self.origin_t + (middle_m - 0.5 * length_m) * self.along
        return Corridor(begin_t, self.along, length_m, self.half_width_m)

    def meets(self, boxes_t: FloatArray, wider_m: float = 0.0) -> BoolArray:
        """Return whether boxes (k, 4) of least and greatest east and north may contain points that `holds` accepts."""
        middle, half = 0.5 * (boxes_t[:, :2] + boxes_t[:, 2:]), 0.5 * (boxes_t[:, 2:] - boxes_t[:, :2])
        distance, aside = self.coordinates(middle)
        inside: BoolArray = np.abs(aside) <= self.half_width_m + half @ np.abs(self.across)
        reach = wider_m + half @ np.abs(self.along)
        inside &= (distance >= -reach) & (distance <= self.length_m + reach)
        return inside

    def place(self, distance_m: FloatArray) -> FloatArray:
        """Return east and north (k, 2) of distances (k,) on the middle line."""
        places: FloatArray = self.origin_t + np.asarray(distance_m)[:, np.newaxis] * self.along
        return places


@dataclass(frozen=True, eq=False)
class Pieces:
    """Planes of a section's pieces, one row per piece (k,): h = height + slope · Δdistance + side_slope · Δacross.

    Attributes:
        height_m: in the middle of the piece; nan: no plane.
        slope, side_slope: along and across the corridor.
        sigma_m: of the height, from the scatter of the piece's returns.
        rms_m: of the returns about the plane, as a robust sigma of all of them.
        count: returns in the piece.
    """

    height_m: FloatArray
    slope: FloatArray
    side_slope: FloatArray
    sigma_m: FloatArray
    rms_m: FloatArray
    count: Int64Array


def grouped_median(values: FloatArray, group: Int64Array, groups: int) -> FloatArray:
    """Return the median (groups,) of the values (n,) of each group; nan for empty groups."""
    order = np.lexsort((values, group))
    count = np.bincount(group, minlength=groups)
    first = np.cumsum(count) - count
    median = np.full(groups, np.nan)
    full = count > 0
    low, high = first[full] + (count[full] - 1) // 2, first[full] + count[full] // 2
    median[full] = 0.5 * (values[order[low]] + values[order[high]])
    return median


def fit_pieces(
    distance_m: FloatArray, aside_m: FloatArray, height_m: FloatArray, piece_m: float, pieces: int, least: int
) -> Pieces:
    """Fit robust planes to the pieces 0 … pieces − 1, each piece_m long, with ``least`` or more of the returns."""
    group = np.floor(distance_m / piece_m).astype(np.int64)
    inside = (group >= 0) & (group < pieces)
    group, height = group[inside], height_m[inside]
    columns = np.stack([np.ones(len(group)), distance_m[inside] - (group + 0.5) * piece_m, aside_m[inside]], axis=1)
    count = np.bincount(group, minlength=pieces)
    kept = np.ones(len(group), np.bool_)
    level = np.full(pieces, np.nan)
    for _ in range(ROUNDS):
        plane, inverse = _planes(group[kept], columns[kept], height[kept], pieces, least)
        off = np.abs(height - np.einsum("ni,ni->n", columns, plane[group]))
        level = _SIGMA_OF_MEDIAN * grouped_median(np.where(np.isfinite(off), off, np.inf), group, pieces)
        kept = off <= FAR * np.maximum(level, LEAST_RMS_M)[group]
    plane, inverse = _planes(group[kept], columns[kept], height[kept], pieces, least)
    rms_m = np.where(np.isfinite(plane[:, 0]), level, np.nan)
    sigma_m = np.maximum(rms_m, LEAST_RMS_M) * np.sqrt(inverse[:, 0, 0])
    return Pieces(plane[:, 0], plane[:, 1], plane[:, 2], sigma_m, rms_m, count)


def _planes(
    group: Int64Array, columns: FloatArray, height: FloatArray, groups: int, least: int
) -> tuple[FloatArray, FloatArray]:
    """Return coefficients (groups, 3) and inverse normal matrices (groups, 3, 3) by least squares.

    They are nan for groups with too few returns, or with returns on one line.
    """
    normal, right = np.zeros((groups, 3, 3)), np.zeros((groups, 3))
    for i in range(3):
        right[:, i] = np.bincount(group, columns[:, i] * height, groups)
        for j in range(i + 1):
            normal[:, i, j] = normal[:, j, i] = np.bincount(group, columns[:, i] * columns[:, j], groups)
    plane, inverse = np.full((groups, 3), np.nan), np.full((groups, 3, 3), np.nan)
    count = normal[:, 0, 0]
    spread = np.linalg.det(normal) / np.maximum(count, 1.0) ** 3  # m⁴: variance along times variance across
    solid = (count >= least) & (spread > 1e-3)
    inverse[solid] = np.linalg.inv(normal[solid])
    plane[solid] = np.einsum("kij,kj->ki", inverse[solid], right[solid])
    return plane, inverse


def heights_by_bin(distance_m: FloatArray, height_m: FloatArray, bin_m: float, bins: int) -> FloatArray:
    """Return the median height (bins,) of the returns in each bin of a section; nan for empty bins."""
    group = np.floor(distance_m / bin_m).astype(np.int64)
    inside = (group >= 0) & (group < bins)
    return grouped_median(height_m[inside], group[inside], bins)


def best_shift(first_m: FloatArray, second_m: FloatArray, most: int, cap_m: float) -> tuple[int, float]:
    """Find the shift, in bins, by which the second section has to be read further on to look like the first.

    Heights may differ by a constant. The cost of a shift is the mean of the deviations' sizes, each at most cap_m.

    Args:
        first_m, second_m: (bins,) heights, nan for empty bins.
        most: bins to try, back and forth.
        cap_m: greatest deviation that counts.

    Returns:
        The shift with the least cost; and the least cost of any other shift not near it, as a multiple of that.
    """
    shifts: list[int] = list(range(-most, most + 1))
    cost = np.full(len(shifts), np.inf)
    bins = len(first_m)
    least = max(10, int(np.isfinite(first_m).sum()) // 3)
    for at, shift in enumerate(shifts):
        low, high = max(0, -shift), min(bins, bins - shift)
        if high <= low:
            continue
        difference = first_m[low:high] - second_m[low + shift : high + shift]
        difference = difference[np.isfinite(difference)]
        if len(difference) >= least:
            cost[at] = np.mean(np.minimum(np.abs(difference - np.median(difference)), cap_m))
    best = int(np.argmin(cost))
    rival = 1.0
    if np.isfinite(cost[best]):
        nearer = np.abs(np.array(shifts) - shifts[best]) <= 5
        rival = float(np.min(cost[~nearer], initial=np.inf) / max(cost[best], 1e-3))
    return shifts[best], rival
