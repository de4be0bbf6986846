"""Tests whether sigmas equal errors: normalised estimation errors squared (NEES) over many flights.

Errors at neighbouring moments are correlated, so that a flight of many samples has few independent ones. Their number
follows from the flights: with v₁ the variance of the NEES at one moment, and v the variance from flight to flight of
its mean over a flight, a flight counts as v₁ / v samples.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from swath.georef.arrays import FloatArray
from swath.georef.navigation.inputs import Solution
from tests.georef.navigation.flights import Truth, errors
from tests.georef.navigation.vehicles import BEGIN_NS

PARTS = {"position": slice(0, 3), "velocity": slice(3, 6), "attitude": slice(6, 9)}


@dataclass(frozen=True)
class Honesty:
    """Consistency of one part of the state.

    Attributes:
        mean: NEES of three components over 3; 1 where sigmas are right.
        low, high: bounds of its 99.8 % interval.
        independent: number of independent samples that it is worth, over all flights.
    """

    mean: float
    low: float
    high: float
    independent: float

    @property
    def holds(self) -> bool:
        """True if the mean lies within its bounds."""
        return self.low <= self.mean <= self.high


def squares(truth: Truth, solution: Solution, from_s: float, step_s: float) -> FloatArray:
    """Return (k, 9) squares of normalised errors, every `step_s` from `from_s` on."""
    t = (solution.time_ns - BEGIN_NS) / 1e9
    at = np.searchsorted(t, np.arange(max(from_s, t[0]), t[-1], step_s))
    off = errors(truth, t[at], solution.position_e[at], solution.velocity_e[at], solution.q_e_from_b[at])
    sigma = (solution.position_sigma_l, solution.velocity_sigma_l, solution.attitude_sigma_rad)
    normalised: FloatArray = (off / np.concatenate([column[at] for column in sigma], axis=1)) ** 2
    return normalised


def judge(flights: list[FloatArray]) -> dict[str, Honesty]:
    """Judge each part of the state from the squares of many flights of one length."""
    stacked = np.stack(flights)
    found = {}
    for name, part in PARTS.items():
        nees = stacked[:, :, part].mean(axis=2)  # (flights, moments)
        means = nees.mean(axis=1)
        each = nees.var(axis=0, ddof=1).mean()
        independent = len(means) * float(np.clip(each / means.var(ddof=1), 1.0, nees.shape[1]))
        degrees = 2.0 / each * independent  # degrees of freedom of a χ² with mean 1 and this variance at a moment
        low, high = chi2.ppf([0.001, 0.999], degrees) / degrees
        found[name] = Honesty(float(means.mean()), float(low), float(high), independent)
    return found
