"""Defines the frame ``local`` for viewers: east, north, up in metres, near the flight, so that single precision
suffices.
"""

from __future__ import annotations

import math
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS

from swath.daemon.processing.live.mcap import CLOUD_DTYPE
from swath.daemon.processing.live.tiles import fit_placement
from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.compiled import jit_cached
from swath.georef.geodesy.earth import e_from_geodetic, geodetic_from_e, rot_e_from_l
from swath.georef.geodesy.vectors import rot_of
from swath.georef.points import Points

ORIGIN_STEP = 100.0  # the origin's coordinates are whole hundreds, which are easy to add in one's head
STEP_M = 10.0  # steps along the body's axes, to find their direction on the map
PLACED_M, PLACED_STEPS = 80_000.0, 9
EARTH_M = 6.371e6
POLAR_STEPS = 10  # iterations that suffice for a map's scale of up to ten
_ENU_OF_L = [1, 0, 2]
_ENU_SIGNS = np.array([1.0, 1.0, -1.0])


class Maps(Protocol):
    """The part of `swath.georef.mapping.frame.Mapping` that is used here."""

    @property
    def unit_m(self) -> FloatArray:
        """Metres per unit (3,) of easting, northing, height."""

    @property
    def wkt(self) -> str:
        """The CRS as WKT."""

    def map_from_e(self, points_e: FloatArray) -> FloatArray:
        """Return map coordinates (n, 3): east, north, height."""


class LocalFrame:
    """East, north, up in metres from an origin near the first position.

    The axes are the mapping frame's; where there is none, or an earth-centred one, they are level at the origin.

    Attributes:
        origin: (3,) in the coordinates of the points: map or e.
        unit_m: (3,) metres per unit of those.
        is_level: True if the axes are level at the origin, not those of the points' coordinates.
    """

    def __init__(self, position_e: FloatArray, mapping: Maps | None) -> None:
        """Place the frame at ``position_e`` (3,), the first position."""
        self._mapping, self._position_e = mapping, position_e
        self.is_level = mapping is None or bool(CRS.from_wkt(mapping.wkt).is_geocentric)
        self.unit_m: FloatArray = np.ones(3) if mapping is None else mapping.unit_m
        self.origin: FloatArray = self._mapped(position_e[np.newaxis])[0].copy()
        if self.is_level:
            lat, lon, _ = geodetic_from_e(self.origin)
            rot = rot_e_from_l(np.asarray(lat), np.asarray(lon))
            self._rot_points_from_enu = np.ascontiguousarray(rot[:, _ENU_OF_L] * _ENU_SIGNS)
        else:
            self.origin = np.floor(self.origin / ORIGIN_STEP) * ORIGIN_STEP

    def _mapped(self, points_e: FloatArray) -> FloatArray:
        return points_e if self._mapping is None else self._mapping.map_from_e(points_e)

    def placement(self) -> dict[str, Any] | None:
        """Return polynomials between the frame and latitude and longitude: `tiles.Placement`; None: none can be made.

        They are fitted to a square of `PLACED_M` about the first position, at its height.
        """
        lat, lon, height = (float(value) for value in geodetic_from_e(self._position_e))
        steps = np.linspace(-0.5, 0.5, PLACED_STEPS) * PLACED_M / EARTH_M
        up, across = (grid.ravel() for grid in np.meshgrid(steps, steps / max(math.cos(lat), 0.02), indexing="ij"))
        try:
            local = self.of_e(e_from_geodetic(lat + up, lon + across, np.full(len(up), height)))
        except ValueError:  # the frame ends nearby
            return None
        here = math.degrees(lat), math.degrees(lon)
        middle = self.of_e(self._position_e[np.newaxis])[0, :2]
        return fit_placement(here, np.degrees(np.stack([up, across], axis=-1)), middle, local[:, :2])

    def of_points(self, points: FloatArray) -> FloatArray:
        """Return local coordinates (n, 3) of points as the georeferencer gives them."""
        away: FloatArray = points - self.origin
        return away @ self._rot_points_from_enu if self.is_level else away * self.unit_m

    def of_geodetic(self, lat_lon_deg: FloatArray) -> FloatArray:
        """Return east and north (n, 2) of latitudes and longitudes (n, 2) in degrees, at the first position's height.

        Raises:
            ValueError: the mapping frame has no place for one of them.
        """
        lat, lon = np.radians(lat_lon_deg).T
        height = np.full(len(lat), float(geodetic_from_e(self._position_e)[2]))
        return self.of_e(e_from_geodetic(lat, lon, height))[:, :2]

    def of_e(self, positions_e: FloatArray) -> FloatArray:
        """Return local coordinates (n, 3) of positions in e."""
        return self.of_points(self._mapped(positions_e))

    def cloud_of(self, points: Points, keep: Int64Array) -> NDArray[Any]:
        """Return the points with the indexes ``keep`` as `CLOUD_DTYPE`."""
        cloud = np.empty((len(keep), 4), np.float32)
        if self.is_level:
            cloud[:, :3] = self.of_points(points.points_map.take(keep, axis=0))
            cloud[:, 3] = points.intensity.take(keep)
        else:
            _fill_cloud(points.points_map, points.intensity, keep, self.origin, self.unit_m, cloud)
        return cloud.view(CLOUD_DTYPE).reshape(-1)

    def pose_of(self, position_e: FloatArray, q_e_from_b: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return position (3,) and quaternion (4,), scalar first and ≥ 0, of the body.

        The axes are those of the frame at the body's place: three steps along b, mapped and made perpendicular.
        """
        places, q_local_from_b = np.empty((4, 3)), np.empty(4)
        _step_along(position_e, q_e_from_b, places)
        mapped = self.of_e(places)
        _attitude_of(mapped, q_local_from_b)
        return mapped[0], q_local_from_b


@jit_cached
def _step_along(position_e: Any, q_e_from_b: Any, places: Any) -> None:
    """Fill ``places`` (4, 3) with a position and a step from there along each axis of b."""
    rot = rot_of(q_e_from_b[0], q_e_from_b[1], q_e_from_b[2], q_e_from_b[3])
    for axis in range(3):
        places[:, axis] = position_e[axis]
        for of_b in range(3):
            places[1 + of_b, axis] += STEP_M * rot[axis][of_b]


@jit_cached
def _attitude_of(places: Any, q: Any) -> None:
    """Fill ``q`` (4,), scalar first, with the rotation nearest to the steps (4, 3), made perpendicular.

    Polar decomposition by Newton's iteration (Higham 1986, SIAM J. Sci. Stat. Comput. 7), then Shepperd 1978.
    """
    m = np.empty((3, 3))  # one column each, up to scale
    for axis in range(3):
        m[:, axis] = (places[1 + axis] - places[0]) / STEP_M
    for _ in range(POLAR_STEPS):
        inverse = np.empty((3, 3))
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            for axis in range(3):
                up, down = (axis + 1) % 3, (axis + 2) % 3
                inverse[i, axis] = m[j, up] * m[k, down] - m[j, down] * m[k, up]
        m = 0.5 * (m + inverse / (m[0] * inverse[0]).sum())
    i = int(np.argmax(np.array([m[0, 0], m[1, 1], m[2, 2]])))
    j, k = (i + 1) % 3, (i + 2) % 3
    trace = m[0, 0] + m[1, 1] + m[2, 2]
    if trace > m[i, i]:
        q[:] = (1.0 + trace, m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1])
    else:
        q[0], q[1 + i] = m[k, j] - m[j, k], 1.0 + m[i, i] - m[j, j] - m[k, k]
        q[1 + j], q[1 + k] = m[j, i] + m[i, j], m[k, i] + m[i, k]
    q /= math.copysign(math.sqrt((q * q).sum()), q[0])


@jit_cached
def _fill_cloud(points: Any, intensity: Any, keep: Any, origin: Any, unit_m: Any, cloud: Any) -> None:
    """Fill ``cloud`` with rows of x, y, z, intensity; the frame's axes are those of the points."""
    for k in range(len(keep)):
        i = keep[k]
        for axis in range(3):
            cloud[k, axis] = (points[i, axis] - origin[axis]) * unit_m[axis]
        cloud[k, 3] = intensity[i]
