"""Normal gravity of WGS 84 in e, continued to height, and its gradient.

Somigliana's formula holds on the ellipsoid, an expansion to second order in height above it, along the ellipsoid's
normal (NIMA TR8350.2, 3rd ed., Eq. 4-1 and 4-3). Gravity is the acceleration of a plumb bob at rest on the turning
earth: it includes the centrifugal acceleration.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from swath.georef.arrays import FloatArray
from swath.georef.compiled import jit_cached, jit_inline
from swath.georef.geodesy.earth import A_M, B_M, E2, EP2, F
from swath.georef.scanner.kernels.types import Matrix, Three

EARTH_RATE_RADPS = 7.292115e-5  # NIMA TR8350.2, table 3.1
EQUATOR_GRAVITY_MPS2 = 9.7803253359  # table 3.4
SOMIGLIANA_K = 0.00193185265241
GRAVITY_RATIO = 0.00344978650684  # m = ω² a² b / GM


@jit_inline
def normal_of(x: float, y: float, z: float) -> tuple[Three, float]:
    """Return the ellipsoid's upward normal in e and the height of a point, without trigonometry (Bowring 1976).

    At the poles, where longitude is undefined, the normal is ±z; the direction is good to 1e-11 rad below 20 km.
    """
    flat = math.sqrt(x * x + y * y)
    sin, cos = A_M * z, B_M * flat
    length = math.sqrt(sin * sin + cos * cos)
    sin, cos = sin / length, cos / length
    sin, cos = z + EP2 * B_M * sin * sin * sin, flat - E2 * A_M * cos * cos * cos
    length = math.sqrt(sin * sin + cos * cos)
    sin, cos = sin / length, cos / length
    share = cos / flat if flat > 0.0 else 0.0
    return (share * x, share * y, sin), flat * cos + z * sin - A_M * math.sqrt(1.0 - E2 * sin * sin)


@jit_inline
def normal_gravity(sin: float, height_m: float) -> float:
    """Return the magnitude, m/s², at the sine of a latitude and a height."""
    square = sin * sin
    surface = EQUATOR_GRAVITY_MPS2 * (1.0 + SOMIGLIANA_K * square) / math.sqrt(1.0 - E2 * square)
    ratio = height_m / A_M
    return surface * (1.0 - 2.0 * (1.0 + F + GRAVITY_RATIO - 2.0 * F * square) * ratio + 3.0 * ratio * ratio)


@jit_inline
def gravity_of(x: float, y: float, z: float) -> Three:
    """Return gravity in e at a point of e, m/s²."""
    up, height_m = normal_of(x, y, z)
    magnitude = normal_gravity(up[2], height_m)
    return -magnitude * up[0], -magnitude * up[1], -magnitude * up[2]


@jit_inline
def gradient_of(x: float, y: float, z: float) -> Matrix:
    """Return ∂ gravity / ∂ position in e, 1/s².

    The normal turns by 1 / (M + h) and 1 / (N + h), and the magnitude falls upward. The magnitude's change to the
    north, 8e-9 1/s² at most, is included.
    """
    up, height_m = normal_of(x, y, z)
    sin = up[2]
    cos = math.sqrt(up[0] * up[0] + up[1] * up[1])
    root = 1.0 - E2 * sin * sin
    across = A_M / math.sqrt(root)
    along = across * (1.0 - E2) / root
    magnitude = normal_gravity(sin, height_m)
    north = 2.0 * sin * cos * magnitude * (SOMIGLIANA_K / (1.0 + SOMIGLIANA_K * sin * sin) + 0.5 * E2 / root)
    north = north / (along + height_m)
    ratio = height_m / A_M
    upward = magnitude * (-2.0 * (1.0 + F + GRAVITY_RATIO - 2.0 * F * sin * sin) + 6.0 * ratio) / A_M
    upward = upward / (1.0 - 2.0 * ratio)
    east, meridian = magnitude / (across + height_m), magnitude / (along + height_m)
    share = 1.0 / cos if cos > 0.0 else 0.0
    e = (-up[1] * share, up[0] * share, 0.0) if cos > 0.0 else (0.0, 1.0, 0.0)
    n = (up[1] * e[2] - up[2] * e[1], up[2] * e[0] - up[0] * e[2], up[0] * e[1] - up[1] * e[0])
    return (
        _gradient_row(up[0], n[0], e[0], up, n, e, meridian, east, upward, north),
        _gradient_row(up[1], n[1], e[1], up, n, e, meridian, east, upward, north),
        _gradient_row(up[2], n[2], e[2], up, n, e, meridian, east, upward, north),
    )


@jit_inline
def _gradient_row(
    u_i: float,
    n_i: float,
    e_i: float,
    up: Three,
    n: Three,
    e: Three,
    meridian: float,
    east: float,
    upward: float,
    north: float,
) -> Three:
    """Return row i of −(g_h u uᵀ + g_n u nᵀ) − g (n nᵀ / (M + h) + e eᵀ / (N + h))."""
    a, b, c = -upward * u_i, -north * u_i - meridian * n_i, -east * e_i
    return (
        a * up[0] + b * n[0] + c * e[0],
        a * up[1] + b * n[1] + c * e[1],
        a * up[2] + b * n[2] + c * e[2],
    )


def gravity_e(position_e: ArrayLike) -> FloatArray:
    """Return normal gravity in e (…, 3), m/s², at positions (…, 3)."""
    position = np.asarray(position_e, dtype=np.float64)
    flat = np.ascontiguousarray(position.reshape(-1, 3))
    gravity = np.empty_like(flat)
    _gravities(flat, gravity)
    return gravity.reshape(position.shape)


@jit_cached
def _gravities(position_e: FloatArray, gravity: FloatArray) -> None:
    for i in range(len(position_e)):
        g = gravity_of(position_e[i, 0], position_e[i, 1], position_e[i, 2])
        gravity[i, 0], gravity[i, 1], gravity[i, 2] = g
