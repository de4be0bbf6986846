"""The earth of the virtual aircraft, by PROJ: geodetic and earth-centred coordinates, and the site frame.

The site frame is Cartesian, in metres, with its origin on the ellipsoid at the plan's origin; there x points east, y
north and z up (a tangent plane: at distance d the ellipsoid lies d²/2R below it).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pyproj import Transformer

from swath.georef.arrays import FloatArray

_E_FROM_GEODETIC = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
_GEODETIC_FROM_E = Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)


def e_from_geodetic(lat_rad: FloatArray, lon_rad: FloatArray, height_m: FloatArray) -> FloatArray:
    """Return (n, 3) ECEF of WGS 84 latitudes, longitudes and ellipsoidal heights, (n,) each."""
    xyz = _E_FROM_GEODETIC.transform(np.degrees(lon_rad), np.degrees(lat_rad), height_m)
    return np.stack(xyz, axis=-1)


def geodetic_from_e(points_e: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return latitude, longitude (radians) and ellipsoidal height of (n, 3) ECEF."""
    lon_deg, lat_deg, height_m = _GEODETIC_FROM_E.transform(points_e[..., 0], points_e[..., 1], points_e[..., 2])
    return np.radians(lat_deg), np.radians(lon_deg), np.asarray(height_m)


def rot_e_from_ned(lat_rad: FloatArray, lon_rad: FloatArray) -> FloatArray:
    """Return (n, 3, 3) rotations whose columns are north, east and down (the ellipsoid's normal) in e."""
    sin_lat, cos_lat, sin_lon, cos_lon = np.sin(lat_rad), np.cos(lat_rad), np.sin(lon_rad), np.cos(lon_rad)
    zero = np.zeros_like(sin_lat)
    north = np.stack([-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat], axis=-1)
    east = np.stack([-sin_lon, cos_lon, zero], axis=-1)
    down = np.stack([-cos_lat * cos_lon, -cos_lat * sin_lon, -sin_lat], axis=-1)
    return np.stack([north, east, down], axis=-1)


@dataclass(frozen=True)
class Site:
    """The site frame at an origin.

    Attributes:
        lat_rad, lon_rad: latitude and longitude of the origin.
        origin_e: (3,) ECEF of the origin, on the ellipsoid.
        rot_site_from_e: (3, 3).
    """

    lat_rad: float
    lon_rad: float
    origin_e: FloatArray
    rot_site_from_e: FloatArray

    @classmethod
    def at(cls, lat_deg: float, lon_deg: float) -> Site:
        """Return the site frame at a place, by PROJ's topocentric conversion."""
        lat_rad, lon_rad = np.radians(lat_deg), np.radians(lon_deg)
        zero = np.zeros(1)
        origin_e = e_from_geodetic(zero + lat_rad, zero + lon_rad, zero)[0]
        to_site = Transformer.from_pipeline(
            f"+proj=topocentric +ellps=WGS84 +lat_0={lat_deg!r} +lon_0={lon_deg!r} +h_0=0"
        )
        corners = origin_e + 1e6 * np.eye(3)
        axes = np.stack(to_site.transform(corners[:, 0], corners[:, 1], corners[:, 2]), axis=0) / 1e6
        left, _, right = np.linalg.svd(axes)
        return cls(float(lat_rad), float(lon_rad), origin_e, left @ right)

    def site_from_e(self, points_e: FloatArray) -> FloatArray:
        """Return (n, 3) site coordinates of (n, 3) ECEF."""
        moved: FloatArray = (points_e - self.origin_e) @ self.rot_site_from_e.T
        return moved

    def e_from_site(self, points: FloatArray) -> FloatArray:
        """Return (n, 3) ECEF of (n, 3) site coordinates."""
        moved: FloatArray = points @ self.rot_site_from_e + self.origin_e
        return moved

    def site_from_ground(self, east_m: FloatArray, north_m: FloatArray, height_m: FloatArray) -> FloatArray:
        """Return (n, 3) site coordinates with these x and y and this ellipsoidal height, to 0.1 mm or better.

        The arguments are (n,) each. An error of the site's z is nearly an equal error of height (the normal is within a
        degree of z over 100 km), so a few plain corrections end at rounding.
        """
        points = np.stack(np.broadcast_arrays(east_m, north_m, height_m), axis=-1).astype(np.float64)
        for _ in range(4):
            _, _, reached_m = geodetic_from_e(self.e_from_site(points))
            points[..., 2] += height_m - reached_m
        return points

    def heights(self, points: FloatArray) -> FloatArray:
        """Return (n,) ellipsoidal heights of (n, 3) site coordinates."""
        return geodetic_from_e(self.e_from_site(points))[2]
