"""A range correction by intensity: a cubic through knots that rises and falls only where the knots do.

Between knots the curve is a cubic Hermite spline. Its slopes are Fritsch and Carlson's (1980, "Monotone piecewise cubic
interpolation", SIAM J. Numer. Anal. 17, 238–246) in the form of Fritsch and Butland (1984, SIAM J. Sci. Stat. Comput.
5, 300–304): harmonic means of the secants at either side, 0 where these differ in sign; at the ends by three points.
Readers interpolate a calibration's table linearly, so the curve is passed on as nodes close enough for that.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from swath.georef.arrays import FloatArray

# Nodes from a knot to the next. Linear interpolation between them misses the cubic by at most 1.5 / STEPS² of the
# knots' difference: slopes are at most three secants, so the second derivative is at most 12 of them per knot distance.
STEPS = 40


def nodes_of(knots: FloatArray) -> FloatArray:
    """Return the intensities (d,) of the nodes, which include all knots (k,) exactly."""
    nodes = [np.linspace(low, high, STEPS, endpoint=False) for low, high in pairwise(knots.tolist())]
    return np.concatenate([*nodes, knots[-1:]])


def at_knots(correction_m: FloatArray) -> FloatArray:
    """Return a correction's values (k,) at the knots from those at the nodes (d,)."""
    return correction_m[::STEPS]


def curve(knots: FloatArray, correction_m: FloatArray) -> FloatArray:
    """Return the correction (d,) at the nodes.

    Args:
        knots: (k,) rising intensities, two or more.
        correction_m: (k,) at the knots.
    """
    by_value, by_slope = _cubics(knots)
    whole: FloatArray = by_value @ correction_m + by_slope @ _slopes(knots, correction_m)[0]
    whole[::STEPS] = correction_m
    return whole


def curve_by_knots(knots: FloatArray, correction_m: FloatArray) -> FloatArray:
    """Return derivatives (k, d) of `curve` by the corrections at the knots.

    Where a slope has no derivative (two secants of different sign, or both zero), one of its one-sided derivatives is
    used.
    """
    by_value, by_slope = _cubics(knots)
    secants = np.diff(np.eye(len(knots)), axis=0) / np.diff(knots)[:, np.newaxis]
    derivatives: FloatArray = by_value + by_slope @ _slopes(knots, correction_m)[1] @ secants
    return np.ascontiguousarray(derivatives.T)


def _cubics(knots: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the weights (d, k) of the knots' values, and those of their slopes, at the nodes (Hermite basis)."""
    pieces = len(knots) - 1
    t = np.arange(STEPS) / STEPS
    by_value, by_slope = np.zeros((2, pieces * STEPS + 1, pieces + 1))
    for piece, length in enumerate(np.diff(knots).tolist()):
        rows = slice(piece * STEPS, (piece + 1) * STEPS)
        by_value[rows, piece], by_value[rows, piece + 1] = (1.0 + 2.0 * t) * (1.0 - t) ** 2, t**2 * (3.0 - 2.0 * t)
        by_slope[rows, piece], by_slope[rows, piece + 1] = length * t * (1.0 - t) ** 2, length * t**2 * (t - 1.0)
    by_value[-1, -1] = 1.0
    return by_value, by_slope


def _slopes(knots: FloatArray, correction_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the slopes (k,) at the knots, and their derivatives (k, k − 1) by the secants."""
    count = len(knots)
    lengths = np.diff(knots)
    secants = np.diff(correction_m) / lengths
    slopes, by_secant = np.zeros(count), np.zeros((count, count - 1))
    if count == 2:
        return np.repeat(secants, 2), np.ones((2, 1))
    for knot in range(1, count - 1):
        pair = slice(knot - 1, knot + 1)
        slopes[knot], by_secant[knot, pair] = _inner(secants[pair], lengths[pair])
    slopes[0], by_secant[0, :2] = _end(secants[:2], lengths[:2])
    slopes[-1], by_secant[-1, :-3:-1] = _end(secants[:-3:-1], lengths[:-3:-1])
    return slopes, by_secant


def _inner(secants: FloatArray, lengths: FloatArray) -> tuple[float, FloatArray]:
    """Return the harmonic mean of two secants and its derivatives by them; the shorter secant weighs more."""
    weights = np.array([2.0 * lengths[1] + lengths[0], lengths[1] + 2.0 * lengths[0]])
    whole = weights.sum()
    if not secants.any():
        return 0.0, weights / whole
    product = secants[0] * secants[1]
    if product <= 0.0:
        return 0.0, np.zeros(2)
    across = weights[0] * secants[1] + weights[1] * secants[0]
    return float(whole * product / across), whole * weights * (secants[::-1] / across) ** 2


def _end(secants: FloatArray, lengths: FloatArray) -> tuple[float, FloatArray]:
    """Return the limited end slope of a parabola through the last three knots, and its derivatives.

    Arguments begin at the end: the last secant comes first. The limit keeps the curve from turning back.
    """
    shares = np.array([2.0 * lengths[0] + lengths[1], -lengths[0]]) / lengths.sum()
    slope = float(shares @ secants)
    if np.sign(slope) != np.sign(secants[0]):
        return 0.0, np.zeros(2)
    if secants[0] * secants[1] < 0.0 and abs(slope) > 3.0 * abs(secants[0]):
        return float(3.0 * secants[0]), np.array([3.0, 0.0])
    return slope, shares
