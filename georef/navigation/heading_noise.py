"""Estimate the errors of dual-antenna headings on a flight: their size, their lasting part, and its time constant.

Errors are a white part and a Gauss–Markov process, both in proportion to the receiver's sigma. Gyroscopes know changes
of heading over seconds far better than two antennas do, so that innovations show the white part and the decay of the
other. Both parts and the e-folding time are fitted together by Fisher scoring: steps of the inverse information times
the slope of ln likelihood, the information being the sum of the squares of single innovations' slopes (Berndt, Hall,
Hall and Hausman 1974). A prior about the assumed values is included: one sigma of it is `PRIOR_SIGMA` of ln (lasting /
white variance), and of ln of the time.

Three hypotheses are compared by the likelihood of the same innovations: the assumed values with a matching scale, the
fit, and white errors alone. A lasting part needs `EVIDENCE` against white errors, and either result needs it against
the assumed values.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from swath.georef.arrays import FloatArray, StructArray
from swath.georef.navigation.inputs import Kind, Setup
from swath.georef.navigation.noise import (
    ENOUGH,
    EVIDENCE,
    PRIOR_SIGMA,
    SCALES,
    Hypothesis,
    Judged,
    NoiseFound,
    Run,
    log_likelihoods,
)
from swath.georef.timescales import SECOND_NS

LONGEST_S = 1000.0  # an error beyond this cannot be told from a constant within ten minutes
LEAST_SHARE = 1e-4
DIFFERENCE = 0.02  # of a parameter, for numerical slopes
LARGEST_STEP = 1.5
ROUNDS, HALVINGS = 6, 3
STAYS = 0.1  # gain of ln likelihood below which no further round is made


def find_heading_noise(found: NoiseFound, innovations: StructArray, stretch: Run) -> NoiseFound:
    """Add a receiver's heading noise to the noise found so far.

    Args:
        found: for its positions and velocities.
        innovations: of a whole run with the assumed setup.
        stretch: returns the innovations of a run over a part of the flight with a setup, one row per observation.
    """
    rows = innovations[innovations["kind"] == Kind.HEADING]
    assumed = found.setup
    if found.doubted or assumed.gnss_heading_share <= 0.0 or int(rows["dimension"].sum()) < ENOUGH:
        return found
    judged = Judged(stretch)
    first = judged.matched(assumed)
    white = judged.matched(replace(first.setup, gnss_heading_share=0.0))
    fitted = _fitted(judged, first.setup, _least_s(rows))
    best = fitted if fitted.log_likelihood - white.log_likelihood >= EVIDENCE else white
    won = best.log_likelihood - first.log_likelihood
    if won < EVIDENCE:
        return replace(found, setup=first.setup)
    return replace(found, setup=best.setup, heading_evidence=won)


def _least_s(headings: StructArray) -> float:
    """Return the median time between headings: errors that last less are white."""
    between = np.diff(headings["time_ns"])
    return float(np.median(between[between > 0])) / SECOND_NS


def _fitted(judged: Judged, assumed: Setup, least_s: float) -> Hypothesis:
    """Return the likeliest hypothesis of headings' white and lasting parts and of the lasting part's time."""
    at = _parameters(assumed)
    about, tightness = at @ _OF_PRIOR.T, np.full(2, PRIOR_SIGMA**-2)
    low = np.log([SCALES[0], SCALES[0], least_s])
    high = np.log([SCALES[1], SCALES[1], LONGEST_S])

    def of(parameters: FloatArray) -> tuple[FloatArray, float]:
        """Return ln likelihoods (n,) of innovations, and their sum with that of the prior."""
        each = log_likelihoods(judged.innovations(_with_parameters(assumed, parameters)))
        off = _OF_PRIOR @ parameters - about
        return each, float(each.sum() - 0.5 * (tightness * off**2).sum())

    each, worth = of(at)
    for _ in range(ROUNDS):
        slopes = np.stack([of(at + step)[0] - each for step in DIFFERENCE * np.eye(3)], axis=1) / DIFFERENCE
        slope = slopes.sum(axis=0) - (tightness * (_OF_PRIOR @ at - about)) @ _OF_PRIOR
        step = np.linalg.solve(slopes.T @ slopes + (_OF_PRIOR.T * tightness) @ _OF_PRIOR, slope)
        step *= min(1.0, LARGEST_STEP / float(np.abs(step).max()))
        for _ in range(HALVINGS):
            there = np.clip(at + step, low, high)
            found = of(there)
            if found[1] > worth:
                break
            step *= 0.5
        else:
            break
        won = found[1] - worth
        at, (each, worth) = there, found
        if won < STAYS:
            break
    return Hypothesis(float(each.sum()), _with_parameters(assumed, at))


# From ln white sigma, ln lasting sigma, ln time to the prior's variables: ln (lasting / white variance) and ln time
_OF_PRIOR = np.array([[-2.0, 2.0, 0.0], [0.0, 0.0, 1.0]])


def _parameters(setup: Setup) -> FloatArray:
    """Return (3,) ln of the white and the lasting sigma, relative to the receiver's, and of the e-folding time in s."""
    scale, share = setup.gnss_heading_scale, max(setup.gnss_heading_share, LEAST_SHARE)
    white, lasting = scale * math.sqrt(1.0 - share), scale * math.sqrt(share)
    return np.log([white, lasting, setup.gnss_heading_correlation_s])


def _with_parameters(setup: Setup, parameters: FloatArray) -> Setup:
    """Return the setup with these parameters."""
    white, lasting, time_s = np.exp(parameters).tolist()
    variance = white**2 + lasting**2
    return replace(
        setup,
        gnss_heading_scale=math.sqrt(variance),
        gnss_heading_share=lasting**2 / variance,
        gnss_heading_correlation_s=time_s,
    )
