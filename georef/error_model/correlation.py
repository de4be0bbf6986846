"""Correlation of errors at two moments or places: the strictly positive definite functions of CSM (FORMULAS 10.4)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares

from swath.georef.arrays import FloatArray

MOST_FLAT = 10.0  # of beta
LONGEST = 700.0  # of lag / tau, beyond which exp would overflow
NEAR_ONE = 0.003
LEAST_FLOOR, MOST_FLOOR = 0.0, 0.999


@dataclass(frozen=True, slots=True)
class Correlation:
    """A correlation function of four parameters: ρ(Δ) = A [α + (1 − α)(1 + β) / (β + exp(|Δ| / τ))], and 1 at Δ = 0.

    It is that of CSM's current header and code (ngageoint/csm, `csm::FourParameterCorrelationModel`). With A = 1 and
    α = β = 0 it is the exponential of a Gauss–Markov process.

    Attributes:
        a: 0 … 1; 1 − A is the share of the variance that is new at each moment.
        alpha: 0 … 1, without 1; the share that never fades.
        beta: 0 … 10; a flat top.
        tau: e-folding lag, in the unit of the lags, positive.
    """

    a: float
    alpha: float
    beta: float
    tau: float

    def __post_init__(self) -> None:
        """Refuse parameters for which the function is no correlation."""
        within = 0.0 < self.a <= 1.0 and 0.0 <= self.alpha < 1.0 and 0.0 <= self.beta <= MOST_FLAT and self.tau > 0.0
        if not within:
            raise ValueError(
                f"A {self.a:g}, α {self.alpha:g}, β {self.beta:g}, τ {self.tau:g} are no correlation function; "
                "0 < A ≤ 1, 0 ≤ α < 1, 0 ≤ β ≤ 10 and τ > 0 are"
            )

    def at(self, lag: ArrayLike) -> FloatArray:
        """Return the correlation at lags of any shape; 1 where the lag is zero."""
        apart = np.abs(np.asarray(lag, np.float64))
        fades = (1.0 + self.beta) / (self.beta + np.exp(np.minimum(apart / self.tau, LONGEST)))
        return np.where(apart == 0.0, 1.0, self.a * (self.alpha + (1.0 - self.alpha) * fades))

    def as_array(self) -> FloatArray:
        """Return A, α, β, τ."""
        return np.array([self.a, self.alpha, self.beta, self.tau])


@dataclass(frozen=True, slots=True)
class Fitted:
    """A fitted function, and the root mean square and the largest of what it leaves of the correlations."""

    correlation: Correlation
    rms: float
    largest: float


def fit(lag: ArrayLike, correlation: ArrayLike, *, smooth: bool = False, near_one: float = 1.0) -> Fitted:
    """Fit the parameters to correlations (n,) at lags (n,) by least squares.

    Differences of two errors have the variance 2 (1 − ρ): a correlation near 1 weighs by how near it is to it.

    Args:
        lag: positive; zero lags say nothing and are left out.
        correlation: −1 … 1.
        smooth: True where errors do not jump, so that A is 1.
        near_one: of 1 − ρ, below which it does not matter how near: the share of the variance that is lost in noise.

    Raises:
        ValueError: there is no lag but zero.
    """
    apart, seen = np.abs(np.asarray(lag, np.float64)), np.asarray(correlation, np.float64)
    some = apart > 0.0
    if not some.any():
        raise ValueError("a correlation function needs correlations at lags that are not zero")
    apart, seen = apart[some], seen[some]
    longest = float(apart.max())
    weight = 1.0 / (np.clip(1.0 - seen, 0.0, 1.0) + max(near_one, NEAR_ONE))

    def left(values: FloatArray) -> FloatArray:
        return weight * (_of(values).at(apart) - seen)

    low, high = (
        [1.0 - 1e-9 if smooth else 0.01, LEAST_FLOOR, 0.0, np.log(longest * 1e-3)],
        [1.0, MOST_FLOOR, MOST_FLAT, np.log(longest * 1e3)],
    )
    best = min(
        (
            least_squares(
                left, [1.0 - 5e-10 if smooth else 0.95, floor, flat, np.log(longest * share)], bounds=(low, high)
            )
            for floor in (0.05, 0.6)
            for flat in (0.1, 2.0)
            for share in (0.1, 1.0)
        ),
        key=lambda found: float(found.cost),
    )
    found = _of(best.x)
    rest = found.at(apart) - seen
    return Fitted(found, float(np.sqrt(np.mean(rest**2))), float(np.abs(rest).max()))


def _of(values: FloatArray) -> Correlation:
    a, alpha, beta, log_tau = (float(value) for value in values)
    return Correlation(a, alpha, beta, float(np.exp(log_tau)))
