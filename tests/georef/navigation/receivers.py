"""Provides receivers that state their sigmas truly, too small, too large or not, and the ideal smoother."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from swath.georef.arrays import FloatArray, StructArray
from swath.georef.navigation.filter.filter import run_filter
from swath.georef.navigation.filter.smoother import smooth
from swath.georef.navigation.inputs import GRADES, Kind, Setup, Solution
from swath.georef.navigation.solve import Solved, solve
from tests.georef.navigation.flights import BASELINE_B, Fixes, Truth, drawn_start, errors, noised
from tests.georef.navigation.vehicles import ns

ARM = np.array([0.35, -0.12, -1.1])
SHARE, TAU_S = 0.5, 60.0  # share of the positions' variance that lasts, and its time constant
HEADING_SHARE = 0.36  # the same for headings, as `swath trajectory` assumes


@dataclass(frozen=True)
class Receiver:
    """A receiver's true errors, and the sigmas that it states.

    Attributes:
        fixes: true errors.
        position_m, velocity_mps: sigmas assumed where the receiver states none; None where it states them.
    """

    fixes: Fixes
    position_m: tuple[float, float, float] | None = None
    velocity_mps: tuple[float, float, float] | None = None

    def told(self, rows: StructArray, optimism: float) -> StructArray:
        """Return the receiver's observations with the stated sigmas divided by a factor.

        For positions without a stated sigma, the true errors exceed the usual assumption by this factor.
        """
        rows = rows.copy()
        place, speed = rows["kind"] == Kind.POSITION, rows["kind"] == Kind.VELOCITY
        rows["sigma"][place] = np.array(self.position_m or self.fixes.sigma_m) / optimism
        rows["sigma"][speed] = self.velocity_mps or np.full(3, self.fixes.velocity_mps / optimism)
        rows["sigma"][rows["kind"] == Kind.HEADING] /= optimism
        return rows


RECEIVERS = {
    "NovAtel": Receiver(Fixes((0.01, 0.01, 0.02), SHARE, TAU_S, 5.0, 0.02), velocity_mps=(0.03, 0.03, 0.06)),
    "UBX": Receiver(Fixes((0.014, 0.014, 0.02), SHARE, TAU_S, 5.0, 0.03)),
    "NMEA": Receiver(Fixes((0.01, 0.01, 0.02), SHARE, TAU_S, 1.0), position_m=(0.02, 0.02, 0.04)),
}
_DIRECTIONS = replace(RECEIVERS["UBX"].fixes, heading_rad=math.radians(0.1))
DUAL_ANTENNAS = {
    "white": Receiver(_DIRECTIONS),
    "half lasting 60 s": Receiver(replace(_DIRECTIONS, heading_share=0.5, heading_tau_s=60.0)),
    "half lasting 10 s": Receiver(replace(_DIRECTIONS, heading_share=0.5, heading_tau_s=10.0)),
}


@dataclass(frozen=True, eq=False)
class Compared:
    """One flight solved twice: with the noise estimated from it, and by a smoother that knows the true noise."""

    solved: Solved
    best: Solution

    def squares(self, truth: Truth) -> tuple[FloatArray, FloatArray]:
        """Return the (9,) mean squares of errors, every tenth of a second, of both solutions: solved, best."""
        found = []
        for one in (self.solved.smoothed, self.best):
            at = slice(None, None, max(round(0.1 / float(truth.edges[1])), 1))
            t = truth.edges[np.searchsorted(ns(truth.edges), one.time_ns[at])]
            off = errors(truth, t, one.position_e[at], one.velocity_e[at], one.q_e_from_b[at])
            found.append((off**2).mean(axis=0))
        return found[0], found[1]


def compared(truth: Truth, receiver: Receiver, grade: str, seed: int, optimisms: Iterable[float]) -> Iterator[Compared]:
    """Fly one flight of a receiver, and navigate it for each factor by which its sigmas are too small.

    The filter assumes that `SHARE` of the positions' variance lasts for `TAU_S`, and `HEADING_SHARE` of the headings',
    whatever the receiver's true errors are.
    """
    inertial, rows = noised(truth, GRADES[grade], receiver.fixes, ARM, seed)
    start = drawn_start(truth, seed)
    setup = Setup(GRADES[grade], ARM[None], gnss_correlated_share=SHARE, gnss_correlation_s=TAU_S)
    if receiver.fixes.heading_rad:
        setup = replace(
            setup, baseline_b=BASELINE_B, gnss_heading_share=HEADING_SHARE, gnss_heading_correlation_s=TAU_S
        )
    knowing = replace(
        setup,
        position_floor_m=1e-3,
        velocity_floor_mps=1e-3,
        gnss_correlated_share=receiver.fixes.share,
        gnss_correlation_s=receiver.fixes.tau_s,
        gnss_velocity_share=receiver.fixes.velocity_share,
        gnss_velocity_correlation_s=receiver.fixes.velocity_tau_s,
        attitude_floor_rad=1e-6,
        gnss_heading_share=receiver.fixes.heading_share,
        gnss_heading_correlation_s=receiver.fixes.heading_tau_s,
    )
    best = smooth(run_filter(inertial, rows, knowing, start))
    for optimism in optimisms:
        yield Compared(solve(inertial, receiver.told(rows, optimism), setup, start), best)
