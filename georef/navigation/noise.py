"""Estimate a receiver's noise from a flight: the size of errors, by kind and fix type, and their lasting share.

Innovations of a filter are white and as large as predicted if its noise is right (Mehra 1970). They answer two
questions.

Size: sigmas of positions and velocities of each fix type, and of headings, are scaled, up or down, until the mean
square of normalised innovations is 1. A scale other than 1 needs `ENOUGH` observations and a gain of ln likelihood of
`EVIDENCE`; n components with the mean square m gain n/2 (m − 1 − ln m).

Lasting share: positions' errors are a white part and a Gauss–Markov process. Innovations show it where the inertial
unit knows more over seconds than the receiver: much at 5 Hz, little at 1 Hz. Shares are compared by the likelihood of
the innovations, with scales matched for each, together with a prior, `PRIOR_SIGMA` of ln (lasting / white variance)
about the assumed share; another share needs `EVIDENCE` too. Against a setup that assumes white errors it needs
`SIGNIFICANT`.

Velocities' errors last for seconds where a receiver filters them. Their share is estimated in the same way, with the
times of `VELOCITY_TIMES_S`, before that of the positions, which otherwise absorbs it if the setup assumes white
velocities; it needs `SIGNIFICANT`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from swath.georef.arrays import BoolArray, FloatArray, StructArray
from swath.georef.navigation.inputs import Fate, Kind, Setup

Run = Callable[[Setup], StructArray]

ENOUGH = 120  # components of one source: the horizontal ones of 60 positions
EVIDENCE = 2.0  # of ln likelihood: chance reaches it once in twenty
SIGNIFICANT = 8.0  # the same, for a share against a setup that assumes white errors
SCALES = (0.02, 30.0)
LARGEST = 5.0  # times the stated sigma of positions: a larger scale means a wrong time, lever arm or frame, not noise
NEAR = 0.03  # deviation of the mean square from 1 that needs no other scale
ROUNDS = 4  # greatest number of runs until scales stay constant
VELOCITY_TIMES_S = (0.7, 1.4, 2.8, 5.6)  # candidate e-folding times of velocities' errors
LITTLE = 0.2  # first trial share of velocities': if even that is less likely than 0, there is no lasting share
STEP = 0.7  # of ln (lasting / white variance) between trial shares
# first trial share without an assumed one; greatest number of steps either way
MIDDLE, PRIOR_SIGMA, REACH = 0.5, 1.0, 7
GREATEST = 50.0  # limit of an innovation's χ² in the likelihood
OUTLIER = 20.0  # times the median square: an innovation beyond carries no information about the others
CHI2_MEDIAN = np.array([np.nan, 0.45494, 1.38629, 2.36597])  # of 1, 2, 3 degrees of freedom
FEW = 0.1  # share of positions far beyond the gate: fewer are blunders, more are noise larger than stated
OF_GNSS = (Kind.POSITION, Kind.VELOCITY, Kind.HEADING)
HORIZONTAL, VERTICAL = slice(0, 2), slice(2, 3)
Source = tuple[int, int, bool]  # kind, fix type (of headings 0), whether it is the vertical


@dataclass(frozen=True)
class Part:
    """The names of the fields of `Setup` that hold a lasting share and its scales."""

    share: str
    scales: str

    def of(self, setup: Setup) -> float:
        """Return the share in a setup."""
        return float(getattr(setup, self.share))

    def with_share(self, setup: Setup, share: float) -> Setup:
        """Return a setup with another lasting share and an equally large white part."""
        white = math.sqrt((1.0 - self.of(setup)) / (1.0 - share))
        scales = getattr(setup, self.scales)
        every = {fix: white * scales.get(fix, 1.0) for fix in range(16)}
        changes: dict[str, Any] = {self.share: share, self.scales: every}
        return replace(setup, **changes)


POSITIONS = Part("gnss_correlated_share", "gnss_sigma_scale")
VELOCITIES = Part("gnss_velocity_share", "gnss_velocity_scale")


@dataclass(frozen=True)
class Hypothesis:
    """Lasting shares of positions' and velocities' variances, with their scales.

    Attributes:
        log_likelihood: of the innovations, relative to the assumed share.
        setup: with these shares, scales matched.
    """

    log_likelihood: float
    setup: Setup

    @property
    def share(self) -> float:
        """The lasting share of the positions' variance."""
        return self.setup.gnss_correlated_share


@dataclass(frozen=True)
class NoiseFound:
    """The receiver's noise as found from a flight.

    Attributes:
        setup: with the noise found.
        tried: hypotheses, the assumed share first.
        second_moment: by source, mean square of normalised innovations of the first run.
        count: by source, the number of components behind it.
        evidence: gain of ln likelihood by the first scale of each source; by the share: `share_evidence`.
        velocity_evidence: by the lasting share of velocities' errors; 0: no such share was found.
        heading_evidence: by the headings' noise (`heading_noise`); 0: it is as assumed.
        doubted: positions deviate too much for noise, so that nothing was estimated.
    """

    setup: Setup
    tried: tuple[Hypothesis, ...]
    second_moment: dict[Source, float]
    count: dict[Source, int]
    evidence: dict[Source, float] = field(default_factory=dict)
    share_evidence: float = 0.0
    velocity_evidence: float = 0.0
    heading_evidence: float = 0.0
    doubted: bool = False

    @property
    def share(self) -> float:
        """The lasting share of the positions' variance."""
        return self.setup.gnss_correlated_share


def not_blunders(run: StructArray) -> BoolArray:
    """Return a mask (n,) of the innovations at times when a run neither refused nor re-acquired a position.

    Seconds of a wrong fix are not noise, and would hide the noise of the other hours.
    """
    place = run[(run["kind"] == Kind.POSITION) & (run["fate"] <= Fate.REACQUIRED)]
    far = place[np.isin(place["fate"], (Fate.REJECTED, Fate.REACQUIRED))]
    if len(far) > FEW * len(place):
        return np.ones(len(run), np.bool_)
    kept: BoolArray = ~np.isin(run["time_ns"], far["time_ns"])
    return kept


def second_moments(innovations: StructArray) -> tuple[dict[Source, float], dict[Source, int]]:
    """Return the mean square of normalised innovations, without outliers, and its number of components, by source."""
    rows = innovations[_usable(innovations)]
    fix = np.where(rows["kind"] == Kind.HEADING, 0, rows["fix_type"])
    moments: dict[Source, float] = {}
    counts: dict[Source, int] = {}
    for kind, one in sorted(set(zip(rows["kind"].tolist(), fix.tolist(), strict=True))):
        mine = rows[(rows["kind"] == kind) & (fix == one)]
        sound = mine[_not_outlying(mine)]
        parts = ((False, slice(0, 3)),) if kind == Kind.HEADING else ((False, HORIZONTAL), (True, VERTICAL))
        for vertical, part in parts:
            squares = sound["normalised"][:, part] ** 2
            known = int(np.isfinite(squares).sum())
            if known:
                moments[kind, one, vertical] = float(np.nansum(squares) / known)
                counts[kind, one, vertical] = known
    return moments, counts


def _usable(innovations: StructArray) -> BoolArray:
    """Return a mask (n,) of the innovations that are of GNSS and have a size."""
    known = (innovations["fate"] <= Fate.REACQUIRED) & (innovations["dimension"] > 0)
    usable: BoolArray = known & np.isfinite(innovations["chi2"]) & np.isin(innovations["kind"], OF_GNSS)
    return usable


def _not_outlying(rows: StructArray) -> BoolArray:
    """Return a mask (n,) of one source's innovations that are not far larger than the others."""
    median = np.median(rows["chi2"] / CHI2_MEDIAN[rows["dimension"]]) if len(rows) else 0.0
    sound: BoolArray = rows["chi2"] <= OUTLIER * median
    return sound


def log_likelihood(innovations: StructArray) -> float:
    """Return −½ Σ (ln |S| + χ²) of innovations; χ² is limited to `GREATEST`."""
    return float(log_likelihoods(innovations).sum())


def log_likelihoods(innovations: StructArray) -> FloatArray:
    """Return ln likelihood (n,) of each innovation, whose sum is `log_likelihood`."""
    each: FloatArray = -0.5 * (innovations["log_det"] + np.minimum(innovations["chi2"], GREATEST))
    return each


def rescaled(setup: Setup, innovations: StructArray) -> tuple[Setup, dict[Source, float]]:
    """Return the setup with the scales that a run's innovations require, and each scale's gain of ln likelihood.

    If none is required, the setup itself and an empty dictionary.
    """
    moments, counts = second_moments(innovations)
    factors: dict[Source, float] = {}
    won: dict[Source, float] = {}
    for source, moment in moments.items():
        gain = 0.5 * counts[source] * (moment - 1.0 - math.log(moment)) if moment > 0.0 else 0.0
        enough = counts[source] >= ENOUGH and abs(moment - 1.0) >= NEAR and gain >= EVIDENCE
        factors[source] = math.sqrt(moment) if enough else 1.0
        if enough:
            won[source] = gain
    return (_with_factors(setup, factors), won) if won else (setup, won)


def _with_factors(setup: Setup, factors: Mapping[Source, float]) -> Setup:
    """Return the setup with its scales multiplied by factors."""
    position, velocity = dict(setup.gnss_sigma_scale), dict(setup.gnss_velocity_scale)
    up, rising = dict(setup.gnss_vertical_scale), dict(setup.gnss_velocity_vertical_scale)
    heading = setup.gnss_heading_scale
    for (kind, fix, vertical), factor in factors.items():
        if kind == Kind.HEADING:
            heading = _bounded(heading * factor)
            continue
        scales, of_vertical = (position, up) if kind == Kind.POSITION else (velocity, rising)
        if vertical:
            of_vertical[fix] = of_vertical.get(fix, 1.0) * factor / factors.get((kind, fix, False), 1.0)
        else:
            scales[fix] = _bounded(scales.get(fix, 1.0) * factor)
    return replace(
        setup,
        gnss_sigma_scale=position,
        gnss_velocity_scale=velocity,
        gnss_vertical_scale=up,
        gnss_velocity_vertical_scale=rising,
        gnss_heading_scale=heading,
    )


def _bounded(scale: float) -> float:
    return min(max(scale, SCALES[0]), SCALES[1])


def find_noise(innovations: StructArray, stretch: Run, setup: Setup) -> NoiseFound:
    """Find the receiver's noise.

    Args:
        innovations: of a whole run with `setup`.
        stretch: returns the innovations of a run over a part of the flight with another setup, one row per observation.
        setup: of the run.
    """
    sound = innovations[not_blunders(innovations)]
    moments, counts = second_moments(sound)
    if sum(count for (kind, *_), count in counts.items() if kind == Kind.POSITION) < ENOUGH:
        return NoiseFound(setup, (Hypothesis(0.0, setup),), moments, counts)
    begun, evidence = rescaled(setup, sound)
    judged = Judged(stretch)
    first = judged.matched(begun)
    of_speeds = 0.0
    if sum(count for (kind, *_), count in counts.items() if kind == Kind.VELOCITY) >= ENOUGH:
        white = first if POSITIONS.of(setup) > 0.0 else _of_positions(judged, first)[1]
        lasting = _of_velocities(judged, white)
        if lasting is not white:
            of_speeds, first = lasting.log_likelihood - white.log_likelihood, lasting
    tried, best = _of_positions(judged, first)
    gain = best.log_likelihood - first.log_likelihood
    relative = tuple(replace(one, log_likelihood=one.log_likelihood - first.log_likelihood) for one in tried)
    if _too_large(best.setup, setup, counts):
        return NoiseFound(setup, relative, moments, counts, doubted=True)
    return NoiseFound(best.setup, relative, moments, counts, evidence, gain, of_speeds)


def _of_positions(judged: Judged, first: Hypothesis) -> tuple[list[Hypothesis], Hypothesis]:
    """Return hypotheses of the positions' lasting share, the assumed one first, and the one to use."""
    if POSITIONS.of(first.setup) > 0.0:
        tried, best = _shares(judged, first, POSITIONS)
        needed = EVIDENCE
    else:
        tried, best = _shares(judged, judged.matched(POSITIONS.with_share(first.setup, MIDDLE)), POSITIONS)
        tried, needed = [first, *tried], SIGNIFICANT
    return tried, best if best.log_likelihood - first.log_likelihood >= needed else first


def _of_velocities(judged: Judged, white: Hypothesis) -> Hypothesis:
    """Return a hypothesis with a lasting share of velocities' errors if the evidence suffices, else the given one."""
    if VELOCITIES.of(white.setup) > 0.0:
        return white

    def begun(place: int) -> Hypothesis:
        """Return the hypothesis of a time from which the climb to its likeliest share begins."""
        setup = replace(white.setup, gnss_velocity_correlation_s=VELOCITY_TIMES_S[place])
        return judged.matched(VELOCITIES.with_share(setup, LITTLE))

    at = len(VELOCITY_TIMES_S) // 2
    if begun(at).log_likelihood <= white.log_likelihood:
        return white
    tried: dict[int, Hypothesis] = {}

    def worth(place: int) -> float:
        """Return the ln likelihood with the likeliest share for a time."""
        if place not in tried:
            _, likeliest = _shares(judged, begun(place), VELOCITIES)
            tried[place] = judged.matched(likeliest.setup)
        return tried[place].log_likelihood

    way = 1 if worth(at + 1) > worth(at) else -1
    while 0 <= at + way < len(VELOCITY_TIMES_S) and worth(at + way) > worth(at):
        at += way
    return tried[at] if worth(at) - white.log_likelihood >= SIGNIFICANT else white


def _too_large(found: Setup, asked: Setup, counts: Mapping[Source, int]) -> bool:
    """Return whether positions of a fix type would err more than `LARGEST` times as much as stated.

    Times that drift by milliseconds have this effect. A scale would average positions that are each right.
    """
    fixes = {fix for kind, fix, _ in counts if kind == Kind.POSITION}
    horizontal = {fix: found.gnss_sigma_scale.get(fix, 1.0) / asked.gnss_sigma_scale.get(fix, 1.0) for fix in fixes}
    return any(scale > LARGEST for scale in horizontal.values())


class Judged:
    """Setups compared by the same innovations: the sound ones of the first run.

    Args:
        stretch: returns the innovations of a run over a part of the flight with a setup, one row per observation.
    """

    def __init__(self, stretch: Run) -> None:
        self._stretch = stretch
        self._kept: BoolArray | None = None

    def innovations(self, setup: Setup) -> StructArray:
        """Return the sound innovations of a run with a setup."""
        found = self._stretch(setup)
        if self._kept is None:
            self._kept = not_blunders(found) & _usable(found)
            self._kept[self._kept] = _not_outlying(found[self._kept])
        return found[self._kept]

    def matched(self, setup: Setup) -> Hypothesis:
        """Return a hypothesis with the scales that suit a setup's shares."""
        for left in reversed(range(ROUNDS)):
            found = self.innovations(setup)
            other, won = rescaled(setup, found)
            if not won or not left:
                break
            setup = other
        return Hypothesis(log_likelihood(found), setup)


def _shares(judged: Judged, middle: Hypothesis, part: Part) -> tuple[list[Hypothesis], Hypothesis]:
    """Climb from an assumed share to the likeliest; return all trials, and the peak of a parabola through three."""
    centre = math.log(part.of(middle.setup) / (1.0 - part.of(middle.setup)))
    known = {0: middle}

    def worth(place: int) -> float:
        """Return ln likelihood and prior of a share, a number of steps from the middle."""
        if place not in known:
            share = 1.0 / (1.0 + math.exp(-(centre + STEP * place)))
            near = known[place - 1 if place > 0 else place + 1]
            known[place] = judged.matched(part.with_share(near.setup, share))
        return known[place].log_likelihood - 0.5 * (STEP * place / PRIOR_SIGMA) ** 2

    at, way = 0, 1 if worth(1) > worth(-1) else -1
    while abs(at) < REACH and worth(at + way) > worth(at):
        at += way
    if abs(at) >= REACH:
        return list(known.values()), known[at]
    below, here, above = worth(at - 1), worth(at), worth(at + 1)
    bend = 2.0 * here - below - above
    off = 0.5 * (above - below) / bend if bend > 0.0 else 0.0
    share = 1.0 / (1.0 + math.exp(-(centre + STEP * (at + off))))
    peak = known[at].log_likelihood + 0.25 * off * (above - below)
    return list(known.values()), Hypothesis(peak, part.with_share(known[at].setup, share))
