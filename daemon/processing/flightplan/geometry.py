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
from typing import Any

import numpy as np

from swath.daemon.processing.flightplan.plan import PlannedLine
from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.compiled import jit_cached
from swath.georef.geodesy.earth import (
    A_M,
    E2,
    e_from_geodetic,
    geodetic_from_e,
    meridian_radius_m,
    prime_vertical_radius_m,
    rot_e_from_l,
)
from swath.georef.geodesy.vectors import dot, vector_at

LONGEST_SECTION_M = 50_000.0


ALONG, ACROSS, AZIMUTH, DISTANCE, HEIGHT, ABOVE_GROUND = range(6)  # columns of `Places`


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """Places relative to lines.

    Attributes:
        columns: (6, n, lines) the values below.
    """

    columns: FloatArray

    @property
    def along_m(self) -> FloatArray:
        """From the line's begin (n, lines); negative before it, beyond the length after its end."""
        return self._column(ALONG)

    @property
    def across_m(self) -> FloatArray:
        """Distance to the line (n, lines), positive to the right of its own direction."""
        return self._column(ACROSS)

    @property
    def azimuth_rad(self) -> FloatArray:
        """Direction of the line (n, lines) beside the place, clockwise from north, −π … π."""
        return self._column(AZIMUTH)

    @property
    def distance_m(self) -> FloatArray:
        """Distance (n, lines) to the nearest place of the line."""
        return self._column(DISTANCE)

    @property
    def height_m(self) -> FloatArray:
        """Planned ellipsoidal height (n, lines) beside the place; nan: none."""
        return self._column(HEIGHT)

    @property
    def above_ground_m(self) -> FloatArray:
        """Planned height above ground (n, lines) beside the place; nan: none."""
        return self._column(ABOVE_GROUND)

    def _column(self, number: int) -> FloatArray:
        column: FloatArray = self.columns[number]
        return column

    def last(self) -> Places:
        """Return the last place relative to every line."""
        return Places(self.columns[:, -1:])


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
        self._first: Int64Array = np.cumsum([0, *count], dtype=np.int64)
        self._lay(ends, others)
        size_m = self._sizes[:, 3]
        begin = np.concatenate([[0.0], np.cumsum(size_m)])
        self.length_m: FloatArray = np.diff(begin[self._first])
        self._sizes[:, 4] = begin[:-1] - np.repeat(begin[self._first[:-1]], count)
        self._heights = np.stack([ends[:, 3:], others[:, 3:]], axis=1)

    def _lay(self, ends: FloatArray, others: FloatArray) -> None:
        """Lay a frame in the middle of each section, and measure it.

        ``_frames`` (sections, 4, 3) has origin, along, right, up; ``_sizes`` (sections, 5) the radii of curvature along
        and across, half of the length, the length, and the way along the line to the section's begin.
        """
        one, other = ends[:, :3], others[:, :3]
        lat, lon, _ = geodetic_from_e((one + other) / 2.0)
        origin_e = e_from_geodetic(lat, lon, np.zeros_like(lat))
        rot = rot_e_from_l(lat, lon)
        north, east, up = rot[..., 0], rot[..., 1], -rot[..., 2]
        chord = other - one
        along = chord - _dot(chord, up)[:, np.newaxis] * up
        along /= np.linalg.norm(along, axis=-1, keepdims=True)
        cos2, sin2 = _dot(along, north) ** 2, _dot(along, east) ** 2
        meridian, vertical = meridian_radius_m(lat), prime_vertical_radius_m(lat)
        radius_m, radius_across_m = 1.0 / (cos2 / meridian + sin2 / vertical), 1.0 / (sin2 / meridian + cos2 / vertical)

        def arc(place_e: FloatArray) -> FloatArray:
            away_e = place_e - origin_e
            length: FloatArray = radius_m * np.arctan2(_dot(away_e, along), radius_m + _dot(away_e, up))
            return length

        half_m = -arc(one)
        self._frames = np.stack([origin_e, along, np.cross(along, up), up], axis=1)
        self._sizes = np.stack([radius_m, radius_across_m, half_m, half_m + arc(other), np.zeros_like(half_m)], axis=1)

    def places(self, lat_rad: FloatArray, lon_rad: FloatArray) -> Places:
        """Return where positions (n,) are relative to every line."""
        lat, lon = (np.ascontiguousarray(np.atleast_1d(angle), np.float64) for angle in (lat_rad, lon_rad))
        found = np.empty((6, len(lat), len(self.length_m)))
        if found.size:
            _place(lat, lon, self._first, self._frames, self._sizes, self._heights, found)
        return Places(found)


@jit_cached
def _place(lat: Any, lon: Any, first: Any, frames: Any, sizes: Any, heights: Any, found: Any) -> None:
    """Fill ``found`` (6, n, lines) with the columns of `Places`, of the nearest section of each line; nan: no place."""
    for i in range(len(lat)):
        sin_lat, cos_lat, sin_lon, cos_lon = math.sin(lat[i]), math.cos(lat[i]), math.sin(lon[i]), math.cos(lon[i])
        normal_m = A_M / math.sqrt(1.0 - E2 * sin_lat**2)
        x_e, y_e = normal_m * cos_lat * cos_lon, normal_m * cos_lat * sin_lon
        z_e = (1.0 - E2) * normal_m * sin_lat
        for line in range(len(first) - 1):
            least = math.inf
            found[:, i, line] = math.nan
            for at in range(first[line], first[line + 1]):
                frame, size = frames[at], sizes[at]
                away = x_e - frame[0, 0], y_e - frame[0, 1], z_e - frame[0, 2]
                angle = math.atan2(dot(away, vector_at(frame, 1)), size[0] + dot(away, vector_at(frame, 3)))
                share = min(max(dot(away, vector_at(frame, 2)) / size[1], -1.0), 1.0)
                along, across = size[0] * angle + size[2], size[1] * math.asin(share)
                inside = min(max(along, 0.0), size[3])
                distance = math.hypot(along - inside, across)
                if not distance < least:
                    continue
                least = distance
                free = inside
                if at == first[line + 1] - 1:
                    free = max(free, along)
                if at == first[line]:
                    free = min(free, along)
                cos, sin = math.cos(angle), math.sin(angle)
                fx = cos * frame[1, 0] - sin * frame[3, 0]
                fy = cos * frame[1, 1] - sin * frame[3, 1]
                fz = cos * frame[1, 2] - sin * frame[3, 2]
                found[ALONG, i, line], found[ACROSS, i, line] = free + size[4], across
                found[DISTANCE, i, line] = distance
                north = cos_lat * fz - sin_lat * (cos_lon * fx + sin_lon * fy)
                found[AZIMUTH, i, line] = math.atan2(cos_lon * fy - sin_lon * fx, north)
                for kind in range(2):
                    one, other = heights[at, 0, kind], heights[at, 1, kind]
                    found[HEIGHT + kind, i, line] = one + (other - one) * (inside / size[3])


def _dot(one: FloatArray, other: FloatArray) -> FloatArray:
    product: FloatArray = np.sum(one * other, axis=-1)
    return product


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
