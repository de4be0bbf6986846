"""Gauss–Markov noise at fixed steps; row k is the same however the rows are requested."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.signal import lfilter

from swath.georef.arrays import FloatArray
from swath.sim.clocks import generator

BLOCK_ROWS = 512


class Noise:
    """Stationary noise of m components.

    Its autocorrelation is exp(−t/τ); with ``smooth`` it is (1 + t/τ) exp(−t/τ), which has a derivative. With τ = 0 the
    noise is white.

    Args:
        seed, names: names that its random numbers depend on.
        sigma: (m,) one sigma of each component.
        tau_s: correlation time τ.
        step_s: time from row to row.
        smooth: True makes a process of second order.
    """

    def __init__(
        self,
        seed: int,
        names: Sequence[str],
        sigma: ArrayLike,
        tau_s: float,
        step_s: float,
        *,
        smooth: bool = False,
    ) -> None:
        self._seed, self._names = seed, tuple(names)
        self._sigma = np.array(sigma, np.float64)
        phi = float(np.exp(-step_s / tau_s)) if tau_s > 0.0 else 0.0
        rest = 1.0 - phi * phi
        self._poles = np.array([1.0, -2.0 * phi, phi * phi]) if smooth else np.array([1.0, -phi])
        self._gain = np.sqrt(rest**3 / (1.0 + phi * phi)) if smooth else np.sqrt(rest)
        self._next_to_last = 2.0 * phi / (1.0 + phi * phi)  # correlation of neighbours, second order
        self._starts = [self._stationary()]  # the filter's state before each block
        self._recent: dict[int, FloatArray] = {}

    def rows(self, first: int, count: int) -> FloatArray:
        """Return (count, m) rows from row ``first`` on."""
        blocks = range(first // BLOCK_ROWS, (first + max(count, 1) - 1) // BLOCK_ROWS + 1)
        rows = np.concatenate([self._block(block) for block in blocks])
        offset = first - blocks[0] * BLOCK_ROWS
        return rows[offset : offset + count]

    def _stationary(self) -> FloatArray:
        """Return the filter's state (order, m) after two outputs of the stationary process."""
        newest, other = generator(self._seed, *self._names, "start").standard_normal((2, len(self._sigma)))
        if len(self._poles) == 2:
            behind: FloatArray = -self._poles[1] * newest[None, :]
            return behind
        share = self._next_to_last
        before = share * newest + np.sqrt(1.0 - share * share) * other
        return np.stack([-self._poles[1] * newest - self._poles[2] * before, -self._poles[2] * newest])

    def _block(self, block: int) -> FloatArray:
        """Return a block of rows; if the state before it is unknown, make the earlier blocks first."""
        if block in self._recent:
            return self._recent[block]
        rows = np.empty(0)
        for number in range(min(block, len(self._starts) - 1), block + 1):
            draws = generator(self._seed, *self._names, number).standard_normal((BLOCK_ROWS, len(self._sigma)))
            rows, end = lfilter([self._gain], self._poles, draws, axis=0, zi=self._starts[number])
            if number + 1 == len(self._starts):
                self._starts.append(end)
        rows = rows * self._sigma
        self._recent = {**dict(list(self._recent.items())[-1:]), block: rows}
        return rows
