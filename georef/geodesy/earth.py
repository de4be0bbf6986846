"""The ellipsoid of WGS 84: geodetic and earth-centred coordinates, the local level frame (FORMULAS 1.2, 1.3).

Latitude and longitude are in radians, heights above the ellipsoid in metres; e is ECEF (EPSG:4978), l is north, east,
down along the ellipsoid's normal.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from swath.georef.arrays import FloatArray
from swath.georef.compiled import jit_cached, jit_inline

A_M = 6_378_137.0
F = 1.0 / 298.257223563
B_M = A_M * (1.0 - F)
E2 = F * (2.0 - F)
EP2 = E2 / (1.0 - E2)


def prime_vertical_radius_m(lat_rad: ArrayLike) -> FloatArray:
    """Return the radius of curvature N across the meridian (ISO/TS 19159-2 Eq. 7)."""
    radius: FloatArray = A_M / np.sqrt(1.0 - E2 * np.sin(np.asarray(lat_rad, dtype=np.float64)) ** 2)
    return radius


def meridian_radius_m(lat_rad: ArrayLike) -> FloatArray:
    """Return the radius of curvature M of the meridian."""
    sin = np.sin(np.asarray(lat_rad, dtype=np.float64))
    radius: FloatArray = A_M * (1.0 - E2) / (1.0 - E2 * sin**2) ** 1.5
    return radius


def e_from_geodetic(lat_rad: ArrayLike, lon_rad: ArrayLike, height_m: ArrayLike) -> FloatArray:
    """Return ECEF positions (…, 3) of geodetic coordinates (ISO/TS 19159-2 Eq. 7, completed)."""
    lat, lon, height = np.broadcast_arrays(*(np.asarray(a, dtype=np.float64) for a in (lat_rad, lon_rad, height_m)))
    radius = prime_vertical_radius_m(lat)
    flat = (radius + height) * np.cos(lat)
    return np.stack([flat * np.cos(lon), flat * np.sin(lon), ((1.0 - E2) * radius + height) * np.sin(lat)], axis=-1)


def geodetic_from_e(position_e: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return latitude, longitude (−π … π) and height (…,) of ECEF positions (…, 3).

    They are exact to 1e-9 m or better up to 100 km of height.
    """
    position = np.asarray(position_e, dtype=np.float64)
    flat = np.ascontiguousarray(position.reshape(-1, 3))
    lat, lon, height = np.empty((3, len(flat)))
    _geodetic(flat, lat, lon, height)
    shape = position.shape[:-1]
    return lat.reshape(shape), lon.reshape(shape), height.reshape(shape)


def rot_e_from_l(lat_rad: ArrayLike, lon_rad: ArrayLike) -> FloatArray:
    """Return rotations (…, 3, 3), columns north, east, down in e (ISO/TS 19159-2 Eq. 4, whose caption is reversed)."""
    lat, lon = np.broadcast_arrays(np.asarray(lat_rad, dtype=np.float64), np.asarray(lon_rad, dtype=np.float64))
    sin_lat, cos_lat, sin_lon, cos_lon = np.sin(lat), np.cos(lat), np.sin(lon), np.cos(lon)
    zero = np.zeros_like(lat)
    rows = (
        (-sin_lat * cos_lon, -sin_lon, -cos_lat * cos_lon),
        (-sin_lat * sin_lon, cos_lon, -cos_lat * sin_lon),
        (cos_lat, zero, -sin_lat),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


@jit_inline
def geodetic_of(x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return latitude, longitude and height of one ECEF position: Bowring's step, twice (FORMULAS 1.2)."""
    flat = math.hypot(x, y)
    beta = math.atan2(A_M * z, B_M * flat)
    lat = 0.0
    for _ in range(2):
        sin, cos = math.sin(beta), math.cos(beta)
        lat = math.atan2(z + EP2 * B_M * sin * sin * sin, flat - E2 * A_M * cos * cos * cos)
        beta = math.atan2(B_M * math.sin(lat), A_M * math.cos(lat))
    sin, cos = math.sin(lat), math.cos(lat)
    height = flat * cos + z * sin - A_M * math.sqrt(1.0 - E2 * sin * sin)
    return lat, math.atan2(y, x), height


@jit_inline
def down_of(lat_rad: float, lon_rad: float) -> tuple[float, float, float]:
    """Return the ellipsoid's nadir direction in e, of unit length."""
    cos = math.cos(lat_rad)
    return -cos * math.cos(lon_rad), -cos * math.sin(lon_rad), -math.sin(lat_rad)


@jit_cached
def _geodetic(position_e: FloatArray, lat: FloatArray, lon: FloatArray, height: FloatArray) -> None:
    for i in range(len(position_e)):
        lat[i], lon[i], height[i] = geodetic_of(position_e[i, 0], position_e[i, 1], position_e[i, 2])
