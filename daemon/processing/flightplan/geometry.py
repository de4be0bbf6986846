"""The place of an aircraft relative to planned lines: across, along, above.

Between two vertices a line is the geodesic. It is replaced by the section of the ellipsoid with the plane through both
vertices and the ellipsoid's normal between them, which departs from the geodesic by less than 1 mm over
`LONGEST_SECTION_M`; longer ones are halved. Along and across are arcs of the osculating circles there, with Euler's
radii of curvature, so that they are lengths on the ellipsoid, whatever the height.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from swath.daemon.processing.flightplan.plan import PlannedLine
from swath.georef.arrays import BoolArray, FloatArray, Int64Array
from swath.georef.geodesy.earth import (
    e_from_geodetic,
    geodetic_from_e,
    meridian_radius_m,
    prime_vertical_radius_m,
    rot_e_from_l,
)

LONGEST_SECTION_M = 50_000.0


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """Places relative to lines; arrays (n, lines).

    Attributes:
        along_m: from the line's begin; negative before it, beyond the length after its end.
        across_m: positive to the right of the line's own direction.
        azimuth_rad: of the line beside the place, clockwise from north, −π … π.
        distance_m: to the nearest place of the line.
        height_m: planned ellipsoidal height beside the place; nan: none.
        above_ground_m: planned height above ground beside the place; nan: none.
    """

    along_m: FloatArray
    across_m: FloatArray
    azimuth_rad: FloatArray
    distance_m: FloatArray
    height_m: FloatArray
    above_ground_m: FloatArray


class LineGeometry:
    """Lines, cut into sections that are straight on the ellipsoid.

    Attributes:
        length_m: (lines,) lengths on the ellipsoid.
    """

    def __init__(self, lines: Sequence[PlannedLine]) -> None:
        sections = [_sections(line) for line in lines]
        count = [len(one) - 1 for one in sections]
        ends = np.concatenate([np.empty((0, 5)), *(one[:-1] for one in sections)])
        others = np.concatenate([np.empty((0, 5)), *(one[1:] for one in sections)])
        self._first: Int64Array = np.cumsum([0, *count], dtype=np.int64)[:-1]
        is_first, is_last = np.zeros(len(ends), np.bool_), np.zeros(len(ends), np.bool_)
        if len(ends):
            is_first[self._first], is_last[self._first + np.array(count) - 1] = True, True
        self._is_first, self._is_last = is_first, is_last
        self._lay(ends, others)
        sizes = np.add.reduceat(self._size_m, self._first) if len(ends) else np.empty(0)
        self.length_m: FloatArray = sizes
        begin = np.concatenate([[0.0], np.cumsum(self._size_m)])[:-1]
        self._begin_m: FloatArray = begin - np.repeat(begin[self._first], count) if len(ends) else begin
        self._heights = ends[:, 3:], others[:, 3:]

    def _lay(self, ends: FloatArray, others: FloatArray) -> None:
        """Lay a frame in the middle of each section: along, right, up, and its radii of curvature."""
        one, other = ends[:, :3], others[:, :3]
        lat, lon, _ = geodetic_from_e((one + other) / 2.0)
        self._origin_e = e_from_geodetic(lat, lon, np.zeros_like(lat))
        rot = rot_e_from_l(lat, lon)
        north, east, up = rot[..., 0], rot[..., 1], -rot[..., 2]
        chord = other - one
        along = chord - _dot(chord, up)[:, np.newaxis] * up
        along /= np.linalg.norm(along, axis=-1, keepdims=True)
        self._along, self._right, self._up = along, np.cross(along, up), up
        cos2, sin2 = _dot(along, north) ** 2, _dot(along, east) ** 2
        meridian, vertical = meridian_radius_m(lat), prime_vertical_radius_m(lat)
        self._radius_m = 1.0 / (cos2 / meridian + sin2 / vertical)
        self._radius_across_m = 1.0 / (sin2 / meridian + cos2 / vertical)
        self._half_m = -self._arcs(one - self._origin_e)[0]
        self._size_m = self._half_m + self._arcs(other - self._origin_e)[0]

    def _arcs(self, away_e: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return along and across from the middle, and the angle along, of vectors (…, sections, 3)."""
        angle = np.arctan2(_dot(away_e, self._along), self._radius_m + _dot(away_e, self._up))
        share = np.clip(_dot(away_e, self._right) / self._radius_across_m, -1.0, 1.0)
        return self._radius_m * angle, self._radius_across_m * np.arcsin(share), angle

    def places(self, lat_rad: FloatArray, lon_rad: FloatArray) -> Places:
        """Return where positions (n,) are relative to every line."""
        lat, lon = np.atleast_1d(lat_rad), np.atleast_1d(lon_rad)
        count = len(self._first)
        if not count or not len(lat):
            return Places(*(np.empty((len(lat), count)) for _ in range(6)))
        flat_e = e_from_geodetic(lat, lon, np.zeros_like(lat))
        middle, across, angle = self._arcs(flat_e[:, np.newaxis, :] - self._origin_e)
        along = middle + self._half_m
        inside = np.clip(along, 0.0, self._size_m)
        distance = np.hypot(along - inside, across)
        best = _least(distance, self._first)
        free = np.where(self._is_last, np.maximum(inside, along), inside)
        free = np.where(self._is_first, np.minimum(free, along), free)
        rows = np.arange(len(lat))[:, np.newaxis]
        heights = [self._planned(kind, inside)[rows, best] for kind in (0, 1)]
        azimuth = self._azimuth(lat, lon, angle, best)
        return Places(
            (free + self._begin_m)[rows, best],
            across[rows, best],
            azimuth,
            distance[rows, best],
            heights[0],
            heights[1],
        )

    def _planned(self, kind: int, inside_m: FloatArray) -> FloatArray:
        one, other = self._heights[0][:, kind], self._heights[1][:, kind]
        planned: FloatArray = one + (other - one) * (inside_m / self._size_m)
        return planned

    def _azimuth(self, lat: FloatArray, lon: FloatArray, angle: FloatArray, best: Int64Array) -> FloatArray:
        """Return the direction (n, lines) of the nearest section at the foot of the perpendicular."""
        rows = np.arange(len(lat))[:, np.newaxis]
        turned = angle[rows, best][..., np.newaxis]
        forward = np.cos(turned) * self._along[best] - np.sin(turned) * self._up[best]
        rot = rot_e_from_l(lat, lon)
        north, east = rot[:, np.newaxis, :, 0], rot[:, np.newaxis, :, 1]
        azimuth: FloatArray = np.arctan2(_dot(forward, east), _dot(forward, north))
        return azimuth


def _dot(one: FloatArray, other: FloatArray) -> FloatArray:
    product: FloatArray = np.sum(one * other, axis=-1)
    return product


def _least(values: FloatArray, first: Int64Array) -> Int64Array:
    """Return for each row and group of columns, which begin at ``first``, the column of the least value."""
    least = np.minimum.reduceat(values, first, axis=1)
    sizes = np.diff(np.append(first, values.shape[1]))
    is_least: BoolArray = values == np.repeat(least, sizes, axis=1)
    columns = np.where(is_least, np.arange(values.shape[1]), values.shape[1])
    found: Int64Array = np.minimum.reduceat(columns, first, axis=1)
    return found


def _sections(line: PlannedLine) -> FloatArray:
    """Return the vertices of a line's sections: (n, 5) ECEF on the ellipsoid, height, height above ground."""
    e = e_from_geodetic(np.radians(line.lat_deg), np.radians(line.lon_deg), np.zeros(len(line.lat_deg)))
    vertices = np.column_stack([e, line.height_m, line.above_ground_m])
    found = [vertices[:1]]
    for one, other in pairwise(vertices):
        found.append(_halved(one, other)[1:])
    return np.concatenate(found)


def _halved(one: FloatArray, other: FloatArray) -> FloatArray:
    """Return a section's ends, and places between them no farther apart than a section may be long."""
    if math.dist(one[:3], other[:3]) <= LONGEST_SECTION_M:
        return np.stack([one, other])
    middle = (one + other) / 2.0
    lat, lon, _ = geodetic_from_e(middle[:3])
    middle[:3] = e_from_geodetic(lat, lon, 0.0)
    return np.concatenate([_halved(one, middle), _halved(middle, other)[1:]])
