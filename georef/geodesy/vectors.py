"""Rotations of single vectors with plain numbers, for compiled loops."""

from __future__ import annotations

import math

import numpy as np

from swath.georef.arrays import FloatArray
from swath.georef.compiled import jit_inline
from swath.georef.scanner.kernels.types import Matrix, Three

SMALL_ANGLE_2 = 1e-2  # below 0.1 rad the series below are exact to the last bit
LARGE_ANGLE = 1e5  # up to here a whole number of quarter turns times the first part of π/2 is exact
_PER_QUARTER = 2.0 / math.pi
_TO_WHOLE = 1.5 * 2.0**52  # adding it rounds away the fraction
_QUARTER = (1.5707963267341256, 6.077100506506192e-11, 2.022266248795951e-21)  # π/2 in three parts of 33 bits


@jit_inline
def vector_at(array: FloatArray, k: int) -> Three:
    """Return row k of (n, 3)."""
    return array[k, 0], array[k, 1], array[k, 2]


@jit_inline
def matrix_at(array: FloatArray, k: int) -> Matrix:
    """Return matrix k of (n, 3, 3)."""
    return (
        (array[k, 0, 0], array[k, 0, 1], array[k, 0, 2]),
        (array[k, 1, 0], array[k, 1, 1], array[k, 1, 2]),
        (array[k, 2, 0], array[k, 2, 1], array[k, 2, 2]),
    )


@jit_inline
def rot_at(q: FloatArray, k: int) -> Matrix:
    """Return the matrix of unit quaternion k of (n, 4), scalar first."""
    return rot_of(q[k, 0], q[k, 1], q[k, 2], q[k, 3])


@jit_inline
def rot_of(w: float, x: float, y: float, z: float) -> Matrix:
    """Return the matrix of a unit quaternion."""
    return (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )


@jit_inline
def dot(a: Three, b: Three) -> float:
    """Return the inner product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@jit_inline
def times(m: Matrix, v: Three) -> Three:
    """Return the product of a matrix and a vector."""
    return dot(m[0], v), dot(m[1], v), dot(m[2], v)


@jit_inline
def small_sine_cosine(square: float, angle: float) -> tuple[float, float]:
    """Return factor · sin(x)/x and cos(x) of small x, from x² and the factor; with factor x, the sine."""
    sin = 1.0 - square * (1.0 / 6.0 - square * (1.0 / 120.0 - square * (1.0 / 5040.0 - square / 362880.0)))
    cos = 1.0 - square * (0.5 - square * (1.0 / 24.0 - square * (1.0 / 720.0 - square / 40320.0)))
    return angle * sin, cos


@jit_inline
def heading_and_roll(lat_rad: float, lon_rad: float, rot_e_from_b: Matrix) -> tuple[float, float]:
    """Return heading, 0 … 2π, and roll, −π … π, of a body at a place (FORMULAS 1.4)."""
    sin_lat, cos_lat, sin_lon, cos_lon = math.sin(lat_rad), math.cos(lat_rad), math.sin(lon_rad), math.cos(lon_rad)
    north, east = (-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat), (-sin_lon, cos_lon, 0.0)
    down = (-cos_lat * cos_lon, -cos_lat * sin_lon, -sin_lat)
    nose = (rot_e_from_b[0][0], rot_e_from_b[1][0], rot_e_from_b[2][0])
    right = (rot_e_from_b[0][1], rot_e_from_b[1][1], rot_e_from_b[2][1])
    belly = (rot_e_from_b[0][2], rot_e_from_b[1][2], rot_e_from_b[2][2])
    heading = math.atan2(dot(east, nose), dot(north, nose)) % (2.0 * math.pi)
    return heading, math.atan2(dot(down, right), dot(down, belly))


@jit_inline
def sine_cosine(square: float, angle: float) -> tuple[float, float]:
    """Return sin(angle), cos(angle) of mostly small angles; ``square`` is the angle squared."""
    if square >= SMALL_ANGLE_2:
        return math.sin(angle), math.cos(angle)
    return small_sine_cosine(square, angle)


@jit_inline
def sine_cosine_of_large(angle: float, sin: float, cos: float) -> tuple[float, float]:
    """Return the given `sin_cos` result, or the library's where the angle is beyond its limit."""
    if abs(angle) < LARGE_ANGLE:
        return sin, cos
    return math.sin(angle), math.cos(angle)


@jit_inline
def sin_cos(angle: float) -> tuple[float, float]:
    """Return sine and cosine at once, to about the last bit: Cody and Waite's reduction, the polynomials of fdlibm.

    It has no branch that stops vectorisation; beyond LARGE_ANGLE the result is meaningless.
    """
    quarters = (angle * _PER_QUARTER if abs(angle) < LARGE_ANGLE else 0.0) + _TO_WHOLE - _TO_WHOLE
    rest = angle - quarters * _QUARTER[0]
    low = quarters * _QUARTER[1]
    high = rest - low
    low = quarters * _QUARTER[2] - ((rest - high) - low)
    x = high - low
    z = x * x
    odd = 8.33333333332248946124e-03 + z * (
        -1.98412698298579493134e-04
        + z * (2.75573137070700676789e-06 + z * (-2.50507602534068634195e-08 + z * 1.58969099521155010221e-10))
    )
    even = 4.16666666666666019037e-02 + z * (
        -1.38888888888741095749e-03
        + z
        * (
            2.48015872894767294178e-05
            + z * (-2.75573143513906633035e-07 + z * (2.08757232129817482790e-09 - z * 1.13596475577881948265e-11))
        )
    )
    sin, cos = x + x * z * (z * odd - 1.66666666666666324348e-01), 1.0 - (0.5 * z - z * z * even)
    quadrant = np.int32(quarters) & 3
    if quadrant & 1:
        sin, cos = cos, sin
    return -sin if quadrant & 2 else sin, -cos if (quadrant + 1) & 2 else cos


@jit_inline
def angle_of(across: float, down: float) -> float:
    """Return atan2 to 2e-8 rad, by steps that every processor rounds alike (Abramowitz and Stegun 4.4.49)."""
    a, b = abs(across), abs(down)
    t = min(a, b) / max(a, b, 1e-300)
    s = t * t
    odd = -0.0752896400 + s * (0.0429096138 + s * (-0.0161657367 + s * 0.0028662257))
    odd = 1.0 + s * (-0.3333314528 + s * (0.1999355085 + s * (-0.1420889944 + s * (0.1065626393 + s * odd))))
    angle = t * odd
    angle = 0.5 * math.pi - angle if a > b else angle
    angle = math.pi - angle if down < 0.0 else angle
    return -angle if across < 0.0 else angle


@jit_inline
def plus(a: Three, factor: float, b: Three) -> Three:
    """Return a + factor · b."""
    return a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2]


@jit_inline
def unit(a: Three) -> Three:
    """Return a vector's direction; a zero vector for a zero vector."""
    per_length = 1.0 / math.sqrt(max(dot(a, a), 1e-300))
    return per_length * a[0], per_length * a[1], per_length * a[2]


@jit_inline
def cross(a: Three, b: Three) -> Three:
    """Return the vector product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@jit_inline
def transposed_times(m: Matrix, v: Three) -> Three:
    """Return the product of a transposed matrix and a vector."""
    a, b, c = m
    return plus(plus((v[0] * a[0], v[0] * a[1], v[0] * a[2]), v[1], b), v[2], c)


@jit_inline
def product(a: Matrix, b: Matrix) -> Matrix:
    """Return the product of two matrices."""
    return transposed_times(b, a[0]), transposed_times(b, a[1]), transposed_times(b, a[2])


@jit_inline
def turned_by(sin: float, cos: float, v: Three) -> Three:
    """Return Ry(angle) v, from the angle's sine and cosine."""
    return cos * v[0] + sin * v[2], v[1], cos * v[2] - sin * v[0]


@jit_inline
def small_turn_factors(square: float, share: float) -> tuple[float, float]:
    """Return `turn_factors` of turns that are certainly small."""
    first = 1.0 - square * (1.0 / 6.0 - square * (1.0 / 120.0 - square * (1.0 / 5040.0 - square / 362880.0)))
    second = 0.5 - square * (1.0 / 24.0 - square * (1.0 / 720.0 - square * (1.0 / 40320.0 - square / 3628800.0)))
    return share * first, share * share * second


@jit_inline
def turn_factors(square: float, share: float) -> tuple[float, float]:
    """Return a, b of exp(share [φ]×) v = v + a φ × v + b φ × (φ × v) (Rodrigues), of ``square`` = |share φ|²."""
    if square >= SMALL_ANGLE_2:
        angle = math.sqrt(square)
        sin, cos = math.sin(0.5 * angle), math.cos(0.5 * angle)
        return share * 2.0 * sin * cos / angle, share * share * 2.0 * sin * sin / square
    return small_turn_factors(square, share)


@jit_inline
def turned_on(phi: Three, a: float, b: float, v: Three) -> Three:
    """Return v + a φ × v + b φ × (φ × v)."""
    once = cross(phi, v)
    return plus(plus(v, a, once), b, cross(phi, once))
