"""Protect the adjustment against blunders: weights for large misclosures, and tests that find outliers (FORMULAS 6.5).

Huber's weights (in `swath.calib.equations.sums.weigh`) bring the adjustment close to the solution; then Baarda's w-test
rejects single observations, by the assumed variances. A rejected observation comes back if a later solution fits it.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy import stats

from swath.georef.arrays import FloatArray

HUBER = 1.5  # sigmas; larger misclosures lose weight
LEVEL = 0.001  # α0 of a single test (Baarda 1968)
POWER = 0.80  # probability with which a least detectable error is found


def w_critical(count: int, family: float = 0.05, level: float = LEVEL) -> float:
    """Return the greatest |w| of a good observation.

    Args:
        count: number of observations tested together.
        family: probability that any good one of them is rejected (Bonferroni).
        level: α0 of one test, used where it is smaller than the family's share: for few observations the limit is 3.29.
    """
    return float(stats.norm.isf(min(level, family / max(count, 1)) / 2.0))


@cache
def least_shift(level: float = LEVEL, power: float = POWER) -> float:
    """Return δ0 of Baarda's internal reliability: the error, in sigmas of w, that is found with this power."""
    return float(stats.norm.isf(level / 2.0) + stats.norm.isf(1.0 - power))


def least_detectable(variance: FloatArray, redundancy: FloatArray) -> FloatArray:
    """Return ∇ = δ0 √(M / r) of misclosures, metres; inf for uncontrolled ones."""
    with np.errstate(divide="ignore"):
        errors: FloatArray = least_shift() * np.sqrt(variance / np.maximum(redundancy, 0.0))
    return errors


def global_test(square: float, redundancy: float) -> float:
    """Return the probability that Σ p e² is this large by chance, χ²(r); 1 without redundancy."""
    return float(stats.chi2.sf(square, redundancy)) if redundancy > 0.0 else 1.0
