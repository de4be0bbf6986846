"""What a run's innovations say of GNSS positions: how large their errors are, and whether they last.

Innovations of a filter are white and as large as it predicts where its noise is right (Mehra 1970). Hypotheses are
compared by the likelihood of the innovations on a stretch of the flight: sigmas as the receiver says them, sigmas
scaled, and errors of which a share is a Gauss–Markov process. A hypothesis other than the first needs to be better by
more than chance gives.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from georef.navigation.inputs import Fate, Kind, Setup
from georef.records import FixType, StructArray

ENOUGH = 60  # innovations of one fix type
SIGNIFICANT = 8.0  # difference of ln likelihood
SCALES = (0.2, 10.0)
LET_BE = (0.6, 1.6)  # mean square of normalised innovations of a setup that is not rescaled
MOMENT_SCALES = (0.5, 20.0)
MOST_SCALES, NEAR = 3, 0.1  # tries of one share, until the mean square is so near to 1
SHARES = (0.5, 0.8, 0.95)
TAILS = 10.0  # degrees of freedom of the t distribution that stands for innovations: outliers weigh little
SOUND = (0.5, 1.7)  # mean square of normalised innovations of a hypothesis that explains them
FEW = 0.1  # share of positions far beyond the gate: so few are blunders, more are noise that is larger than said


@dataclass(frozen=True)
class Hypothesis:
    """GNSS positions' noise.

    Attributes:
        scale: factor on sigmas.
        share: of the variance that is time-correlated.
        log_likelihood: of the innovations, relative to the receiver's own sigmas, white.
        second_moment: mean square of normalised innovations with it; a hypothesis stands only where it is near 1.
    """

    scale: float
    share: float
    log_likelihood: float
    second_moment: float


@dataclass(frozen=True)
class NoiseFound:
    """What was found.

    Attributes:
        tried: hypotheses, the receiver's own sigmas first.
        best: the one that stands.
        second_moment: by fix type, mean square of normalised innovations of positions in the first pass.
        count: by fix type, how many innovations that is of.
    """

    tried: tuple[Hypothesis, ...]
    best: Hypothesis
    second_moment: dict[int, float]
    count: dict[int, int]

    @property
    def changed(self) -> bool:
        """Whether another hypothesis than the receiver's own sigmas stands."""
        return self.best.scale != 1.0 or self.best.share != 0.0


def without_blunders(innovations: StructArray, run: StructArray) -> StructArray:
    """Innovations but for positions of times at which a run with the receiver's own sigmas refused or re-acquired one.

    Seconds of a wrong fix are no noise, and would hide that of the other hours.
    """
    place = run[(run["kind"] == Kind.POSITION) & (run["fate"] <= Fate.REACQUIRED)]
    far = place[np.isin(place["fate"], (Fate.REJECTED, Fate.REACQUIRED))]
    if len(far) > FEW * len(place):
        return innovations
    kept: StructArray = innovations[~np.isin(innovations["time_ns"], far["time_ns"])]
    return kept


def second_moments(innovations: StructArray) -> tuple[dict[int, float], dict[int, int]]:
    """Mean square of normalised innovations of positions that were not refused, and how many, by fix type."""
    told = innovations[(innovations["kind"] == Kind.POSITION) & (innovations["fate"] <= Fate.REACQUIRED)]
    moments, counts = {}, {}
    for fix in np.unique(told["fix_type"]).tolist():
        normalised = told["normalised"][told["fix_type"] == fix]
        moments[fix], counts[fix] = float(np.nanmean(normalised**2)), len(normalised)
    return moments, counts


def log_likelihood(innovations: StructArray) -> float:
    """Of positions' innovations, −½ Σ (ln |S| + (k + m) ln(1 + χ² / k)), of a t distribution of k = `TAILS`."""
    told = innovations[(innovations["kind"] == Kind.POSITION) & (innovations["fate"] <= Fate.REACQUIRED)]
    weight = TAILS + told["dimension"]
    return float(-0.5 * (told["log_det"] + weight * np.log1p(told["chi2"] / TAILS)).sum())


def by_moments(setup: Setup, innovations: StructArray) -> Setup:
    """The setup, with positions' sigmas by fix type such that innovations are as large as predicted; itself: they are.

    For a setup that says how much of the errors lasts, which innovations hardly show. Where they are larger, all of it
    is; where they are smaller, only the part that does not last: what lasts is as the receiver's sigmas have it.
    """
    moments, counts = second_moments(without_blunders(innovations, innovations))
    off = {
        fix: math.sqrt(moment)
        for fix, moment in moments.items()
        if counts[fix] >= ENOUGH and not LET_BE[0] <= moment <= LET_BE[1]
    }
    if not off:
        return setup
    known = setup.gnss_sigma_scale
    larger = {fix: min(known.get(fix, 1.0) * factor, MOMENT_SCALES[1]) for fix, factor in off.items() if factor > 1.0}
    whiter = {fix: max(factor, MOMENT_SCALES[0]) for fix, factor in off.items() if factor < 1.0}
    return replace(setup, gnss_sigma_scale=known | larger, gnss_white_scale=setup.gnss_white_scale | whiter)


def find_noise(innovations: StructArray, stretch: Callable[[Setup], StructArray], setup: Setup) -> NoiseFound:
    """Compare hypotheses.

    Args:
        innovations: of a whole run with `setup`.
        stretch: innovations of a run over the stretch with another setup.
        setup: of the run, sigmas as the receiver says them and white.
    """
    moments, counts = second_moments(without_blunders(innovations, innovations))
    first = Hypothesis(1.0, 0.0, 0.0, _mean(moments, counts))
    if sum(counts.values()) < ENOUGH:
        return NoiseFound((first,), first, moments, counts)
    base = log_likelihood(without_blunders(stretch(setup), innovations))

    def tried(scale: float, share: float) -> Hypothesis:
        """With the scale, or one nearer to what innovations then say."""
        for _ in range(MOST_SCALES):
            scale = min(max(scale, SCALES[0]), SCALES[1])
            found = without_blunders(stretch(scaled(setup, scale, share)), innovations)
            one = Hypothesis(scale, share, log_likelihood(found) - base, _mean(*second_moments(found)))
            if abs(one.second_moment - 1.0) < NEAR:
                break
            scale *= math.sqrt(one.second_moment)
        return one

    white = tried(math.sqrt(first.second_moment), 0.0)
    slow = [tried(white.scale / math.sqrt(1.0 - share), share) for share in SHARES]
    if first.second_moment < 1.0 - NEAR:
        slow.append(tried(1.0, 1.0 - first.second_moment))
    best = first
    for one in sorted([white, *slow], key=lambda one: one.share):
        sound = SOUND[0] < one.second_moment < SOUND[1]
        if sound and one.log_likelihood > best.log_likelihood + SIGNIFICANT:
            best = one
    return NoiseFound((first, white, *slow), best, moments, counts)


def scaled(setup: Setup, scale: float, share: float) -> Setup:
    """A setup with GNSS positions' sigmas scaled, a share of their variance time-correlated."""
    scales = {int(fix): scale * setup.gnss_sigma_scale.get(int(fix), 1.0) for fix in FixType}
    return replace(setup, gnss_correlated_share=share, gnss_sigma_scale=scales)


def _mean(moments: dict[int, float], counts: dict[int, int]) -> float:
    """Over all fix types; 1 where there is none."""
    return sum(moments[fix] * counts[fix] for fix in moments) / max(sum(counts.values()), 1) if moments else 1.0
