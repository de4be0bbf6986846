"""Turns samples of the way into a curve with four continuous derivatives: a compact kernel, then a quintic spline.

The kernel is a box convolved with four short boxes: a jump of acceleration becomes a steady rise with rounded ends. It
is symmetric and its sum is one, so that a straight at constant speed is unchanged farther than the half-width from its
ends.
"""

from __future__ import annotations

import numpy as np
from scipy.interpolate import BSpline

from swath.georef.arrays import FloatArray

STEP_S = 1.0 / 32.0  # between knots; exact in binary
SPLINE_REACH = 5  # distance in knots up to which one value changes the spline
PEAK = 2.0 / 3.0  # peak of the kernel's density times its half-width

_DEGREE = 5


def kernel(half: int) -> FloatArray:
    """Return (2·half + 1,) weights; the highest is at most `PEAK` / half."""
    rounding = half // 16
    weights = np.ones(2 * (half - 4 * rounding) + 1)
    for _ in range(4):
        weights = np.convolve(weights, np.ones(2 * rounding + 1))
    smooth: FloatArray = weights / weights.sum()
    return smooth


def smoothed(values: FloatArray, half: int, margin: int) -> FloatArray:
    """Return (n − 2·margin,) smoothed values of values (n,).

    ``half`` is at most ``margin``, the number of samples lost at either end.
    """
    kept = values[margin - half : len(values) - margin + half]
    return np.convolve(kept, kernel(half), mode="valid")


def spline_through(first: int, values: FloatArray) -> BSpline:
    """Return the quintic spline through values (n, k) at knots ``first``, ``first`` + 1, …, in steps of `STEP_S`.

    Its error is of the sixth order of `STEP_S`.

    Its coefficients are c = (1 − δ²/4 + 13 δ⁴/240) f, the first terms of the inverse of a quintic B-spline at whole
    knots (1 + δ²/4 + δ⁴/120), so that a point at rest stays exactly at rest, whatever comes later. The spline is
    defined from knot first + 4 to knot first + n − 5 and is nan elsewhere.
    """
    second = np.diff(values, 2, axis=0)
    fourth = np.diff(second, 2, axis=0)
    coefficients = values[2:-2] - second[1:-1] / 4.0 + fourth * (13.0 / 240.0)
    knots = STEP_S * np.arange(first - 1, first + len(coefficients) + _DEGREE, dtype=np.float64)
    return BSpline(knots, coefficients, _DEGREE, extrapolate=False)
