"""Against blunders: weights that large misclosures lose, and tests that find what does not belong (FORMULAS 6.5).

Huber's weights (in `swath.calib.equations.sums.weigh`) bring the adjustment near; then Baarda's w-test takes single
observations out, by the variances that were assumed. A rejected observation comes back if a later solution fits it.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy import stats

from swath.georef.arrays import FloatArray

HUBER = 1.5  # sigmas, from which an observation loses weight
LEVEL = 0.001  # α0 of a single test (Baarda 1968)
POWER = 0.80  # with which a least detectable error is found


def w_critical(count: int, family: float = 0.05, level: float = LEVEL) -> float:
    """Return greatest |w| of a good observation.

    Args:
        count: observations tested together.
        family: probability that any good one of them is rejected (Bonferroni).
        level: α0 of one test, where that asks for less: among few observations 3.29.
    """
    return float(stats.norm.isf(min(level, family / max(count, 1)) / 2.0))


@cache
def least_shift(level: float = LEVEL, power: float = POWER) -> float:
    """Return δ0 of Baarda's internal reliability: an error of so many sigmas of w is found with this power."""
    return float(stats.norm.isf(level / 2.0) + stats.norm.isf(1.0 - power))


def least_detectable(variance: FloatArray, redundancy: FloatArray) -> FloatArray:
    """Return ∇ = δ0 √(M / r) of misclosures, metres; inf where nothing controls one."""
    with np.errstate(divide="ignore"):
        errors: FloatArray = least_shift() * np.sqrt(variance / np.maximum(redundancy, 0.0))
    return errors


def global_test(square: float, redundancy: float) -> float:
    """Return probability of so large a Σ p e² by chance, χ²(r); 1 without redundancy."""
    return float(stats.chi2.sf(square, redundancy)) if redundancy > 0.0 else 1.0
