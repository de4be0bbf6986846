"""A range correction by intensity as a cubic through knots that rises and falls only where the knots do.

Between knots the curve is Hermite's cubic. Its slopes are Fritsch and Carlson's (1980, "Monotone piecewise cubic
interpolation", SIAM J. Numer. Anal. 17, 238–246) in the form of Fritsch and Butland (1984, SIAM J. Sci. Stat. Comput.
5, 300–304): harmonic means of the secants at either side, 0 where these differ in sign; at the ends by three points. A
calibration's table is read linearly, so that the curve is handed on as nodes close enough for that.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from swath.georef.arrays import FloatArray

# Nodes from a knot to the next. Read linearly they miss the cubic by 1.5 / STEPS² of what the knots differ, at most:
# slopes are at most three secants, which bends it by 12 of these a knot's distance
STEPS = 40


def nodes_of(knots: FloatArray) -> FloatArray:
    """Return (d,) intensities of the nodes, all knots (k,) among them as they are."""
    nodes = [np.linspace(low, high, STEPS, endpoint=False) for low, high in pairwise(knots.tolist())]
    return np.concatenate([*nodes, knots[-1:]])


def at_knots(correction_m: FloatArray) -> FloatArray:
    """Return (k,) of a correction at nodes (d,)."""
    return correction_m[::STEPS]


def curve(knots: FloatArray, correction_m: FloatArray) -> FloatArray:
    """Return (d,) correction at the nodes.

    Args:
        knots: (k,) rising intensities, two or more.
        correction_m: (k,) at them.
    """
    by_value, by_slope = _cubics(knots)
    whole: FloatArray = by_value @ correction_m + by_slope @ _slopes(knots, correction_m)[0]
    whole[::STEPS] = correction_m
    return whole


def curve_by_knots(knots: FloatArray, correction_m: FloatArray) -> FloatArray:
    """Return (k, d) derivatives of `curve` by the corrections at the knots.

    Where a slope has none (two secants change from one sign to the other, or both are zero) it is one of those beside.
    """
    by_value, by_slope = _cubics(knots)
    secants = np.diff(np.eye(len(knots)), axis=0) / np.diff(knots)[:, np.newaxis]
    derivatives: FloatArray = by_value + by_slope @ _slopes(knots, correction_m)[1] @ secants
    return np.ascontiguousarray(derivatives.T)


def _cubics(knots: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return (d, k) weights of the knots' values, and of their slopes, at the nodes (Hermite's basis)."""
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
    """Return (k,) slopes at the knots; (k, k − 1) their derivatives by the secants."""
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
    """Return harmonic mean of two secants, and its derivatives by them; each weighs more, the shorter it is."""
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
    """Return slope of a parabola through the last three knots, last first, kept from turning back; its derivatives."""
    shares = np.array([2.0 * lengths[0] + lengths[1], -lengths[0]]) / lengths.sum()
    slope = float(shares @ secants)
    if np.sign(slope) != np.sign(secants[0]):
        return 0.0, np.zeros(2)
    if secants[0] * secants[1] < 0.0 and abs(slope) > 3.0 * abs(secants[0]):
        return float(3.0 * secants[0]), np.array([3.0, 0.0])
    return slope, shares
