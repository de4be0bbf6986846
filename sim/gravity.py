"""Normal gravity of WGS 84 and the earth's rotation, for the inertial unit and for the strapdown that checks it.

Gravity on the ellipsoid follows Somigliana's formula, above it the expansion to second order in height, along the
ellipsoid's normal (NIMA TR8350.2, 3rd ed., Eq. 4-1 and 4-3; CONVENTIONS, time). Gravity here is the acceleration of a
plumb bob at rest on the rotating earth: attraction and centrifugal acceleration together. By convention it leaves out
the bend of the plumb line above the ellipsoid (8e-9 m/s² per metre of height at 45°).
"""

from __future__ import annotations

import numba
import numpy as np

from swath.georef.arrays import FloatArray
from swath.sim.site import geodetic_from_e

# NIMA TR8350.2, tables 3.1, 3.3 and 3.4
EARTH_RATE_RADPS = 7.292115e-5
SEMI_MAJOR_AXIS_M = 6_378_137.0
FLATTENING = 1 / 298.257223563
ECCENTRICITY_SQUARED = FLATTENING * (2 - FLATTENING)
EQUATOR_GRAVITY_MPS2 = 9.7803253359
SOMIGLIANA_K = 0.00193185265241
GRAVITY_RATIO = 0.00344978650684  # m = ω²a²b/GM

RATE_IE_E = np.array([0.0, 0.0, EARTH_RATE_RADPS])

_HEIGHT_STEPS = 4


def normal_gravity(sin_lat: FloatArray, height_m: FloatArray) -> FloatArray:
    """Return (n,) the magnitude of normal gravity, m/s².

    Args:
        sin_lat: (n,) sines of geodetic latitudes.
        height_m: (n,) ellipsoidal heights.
    """
    square = sin_lat * sin_lat
    surface = EQUATOR_GRAVITY_MPS2 * (1 + SOMIGLIANA_K * square) / np.sqrt(1 - ECCENTRICITY_SQUARED * square)
    ratio = height_m / SEMI_MAJOR_AXIS_M
    linear = 2 * (1 + FLATTENING + GRAVITY_RATIO - 2 * FLATTENING * square)
    continued: FloatArray = surface * (1 - linear * ratio + 3 * ratio * ratio)
    return continued


_normal_gravity = numba.njit(cache=True)(normal_gravity)


def gravity_e(points_e: FloatArray) -> FloatArray:
    """Return (n, 3) normal gravity in e, m/s², at ECEF points (n, 3); PROJ supplies the geodetic coordinates."""
    lat_rad, lon_rad, height_m = geodetic_from_e(points_e)
    up = np.stack([np.cos(lat_rad) * np.cos(lon_rad), np.cos(lat_rad) * np.sin(lon_rad), np.sin(lat_rad)], axis=-1)
    downward: FloatArray = -normal_gravity(np.sin(lat_rad), height_m)[..., None] * up
    return downward


@numba.njit(cache=True)
def gravity_at(x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return normal gravity in e at one ECEF point; compiled, for the strapdown's thousand calls per second.

    The normal is found by the fixed point tan φ = (z + e² N sin φ) / p, which gains two digits per step.
    """
    distance = np.sqrt(x * x + y * y)
    top = z / (1 - ECCENTRICITY_SQUARED)
    prime = SEMI_MAJOR_AXIS_M
    for _ in range(_HEIGHT_STEPS):
        length = np.sqrt(distance * distance + top * top)
        sin_lat = top / length
        prime = SEMI_MAJOR_AXIS_M / np.sqrt(1 - ECCENTRICITY_SQUARED * sin_lat * sin_lat)
        top = z + ECCENTRICITY_SQUARED * prime * sin_lat
    length = np.sqrt(distance * distance + top * top)
    sin_lat = top / length
    height_m = length - prime  # (N + h) is the normal's length from the axis
    magnitude = _normal_gravity(sin_lat, height_m)
    scale = -magnitude / length
    return scale * x, scale * y, scale * top
