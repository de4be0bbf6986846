"""Tests that bridged samples are as wrong as stated, against the lost samples and over whole flights."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from swath.georef.arrays import BoolArray
from swath.georef.navigation.bridging import UNKNOWN_RATE_RADPS, made_up_variance, new_bridges
from swath.georef.navigation.filter.filter import run_filter
from swath.georef.navigation.filter.smoother import smooth
from swath.georef.navigation.filter.strapdown import Samples, samples_of
from swath.georef.navigation.inputs import GRADES, Inertial
from swath.georef.navigation.samples import Sampler
from swath.georef.records import IMU_DTYPE
from tests.georef.navigation.flights import Fixes, drawn_start, errors, fly, noised, setup_for, survey
from tests.georef.navigation.vehicles import ns

pytestmark = pytest.mark.xdist_group("kernels")

ARM = np.array([0.35, -0.12, -1.1])
RATE_HZ = 100.0
SECONDS = 120.0


def lossy(inertial: Inertial, gone: BoolArray, rate_hz: float = RATE_HZ) -> Inertial:
    """Return the samples without those that are gone, assembled and bridged as a log's are."""
    rows = np.zeros(len(inertial), IMU_DTYPE)
    rows["specific_force_b"] = inertial.velocity_b / inertial.interval_s[:, None]
    rows["angular_rate_b"] = inertial.angle_b / inertial.interval_s[:, None]
    return Sampler(rate_hz).feed(rows[~gone], inertial.time_ns[~gone])


def lost(count: int, share: float, run: int, seed: int) -> BoolArray:
    """(count,) which samples are gone: runs of so many on end."""
    gone = np.zeros(count, np.bool_)
    for first in np.random.default_rng(seed).integers(50, count - 50, round(count * share / run)).tolist():
        gone[first : first + run] = True
    return gone


def shaken(axis: int, seed: int) -> Inertial:
    """Return white noise, with a vibration on one axis in the second half."""
    rng, n = np.random.default_rng(seed), round(SECONDS * RATE_HZ)
    t = np.arange(1, n + 1) / RATE_HZ
    angle, push = 1e-4 * rng.standard_normal((n, 3)), 1e-3 * rng.standard_normal((n, 3))
    angle[:, axis] += np.where(t > SECONDS / 2, 2e-3 * np.sin(2.0 * np.pi * 31.0 * t), 0.0)
    return Inertial(ns(t), np.full(n, 1.0 / RATE_HZ), angle, push, np.zeros(n, np.bool_))


@pytest.mark.parametrize("run", [1, 2, 3, 10])
def test_variance_of_bridged_samples_matches_that_of_the_lost_samples(run: int) -> None:
    """For each axis, quiet and vibrating, the ratio of squared errors to predicted ones is 1 within five sigmas."""
    whole = shaken(1, 3)
    gone = lost(len(whole), 0.02 * np.sqrt(run), run, 5)
    bridged = lossy(whole, gone)
    variance = made_up_variance(samples_of(bridged), new_bridges())
    begins = np.flatnonzero(np.diff(gone.astype(np.int8)) == 1) + 1
    ends = np.flatnonzero(np.diff(gone.astype(np.int8)) == -1) + 1
    of_length = (ends - begins == run) & (np.minimum(begins, abs(begins - len(whole) // 2)) > 6.0 * RATE_HZ)
    off = np.concatenate([bridged.angle_b - whole.angle_b, bridged.velocity_b - whole.velocity_b], axis=1)
    spans = [slice(*span) for span in np.stack([begins, ends], axis=1)[of_length].tolist()]
    squares = np.array([off[span].sum(axis=0) ** 2 for span in spans])
    predicted = np.array([variance[span].sum(axis=0) for span in spans])
    assert (predicted > 0.0).all()
    shaken_half = begins[of_length] > len(whole) // 2
    for half in (shaken_half, ~shaken_half):
        ratio = (squares[half] / predicted[half]).mean(axis=0)
        np.testing.assert_allclose(ratio, 1.0, atol=5.0 * np.sqrt(2.0 / half.sum()) + 0.1)
    assert not variance[~bridged.bridged].any()


def test_a_shaken_axis_has_a_larger_variance_than_a_quiet_one() -> None:
    bridged = lossy(shaken(1, 3), lost(round(SECONDS * RATE_HZ), 0.02, 1, 5))
    variance = made_up_variance(samples_of(bridged), new_bridges())
    late = bridged.bridged & (bridged.time_ns > ns(SECONDS * 0.6))
    assert variance[late, 1].min() > 30.0 * variance[late, 0].max()


def test_without_history_the_variance_is_cautious() -> None:
    bridged = lossy(shaken(1, 3), np.isin(np.arange(round(SECONDS * RATE_HZ)), [5, 6]))
    variance = made_up_variance(samples_of(bridged), new_bridges())
    assert np.sqrt(variance[:10, 0].sum()) == pytest.approx(UNKNOWN_RATE_RADPS * 2 / RATE_HZ)


def test_results_do_not_depend_on_how_samples_are_cut() -> None:
    bridged = lossy(shaken(1, 3), lost(round(SECONDS * RATE_HZ), 0.05, 3, 5))
    samples, pieces = samples_of(bridged), new_bridges()
    cuts = [0, *np.sort(np.random.default_rng(1).integers(0, len(bridged), 60)).tolist(), len(bridged)]
    parts = [
        made_up_variance(Samples._make(column[first:last] for column in samples), pieces)
        for first, last in pairwise(cuts)
    ]
    assert np.array_equal(np.concatenate(parts), made_up_variance(samples, new_bridges()))


@pytest.mark.parametrize("run", [1, 10])
def test_losing_one_sample_in_a_hundred_does_little_harm(run: int) -> None:
    """In three flights with a tactical unit, losses of single samples or ten in a row enlarge errors by at most 1.3."""
    truth = fly(survey(), SECONDS, RATE_HZ)
    squares = np.zeros((2, 9))
    for seed in range(3):
        inertial, rows = noised(truth, GRADES["tactical"], Fixes(rate_hz=5.0, velocity_mps=0.02), ARM, seed)
        torn = lossy(inertial, lost(len(inertial), 0.01, run, seed))
        assert torn.bridged.sum() > 0.008 * len(torn)
        for which, samples in enumerate((inertial, torn)):
            found = smooth(run_filter(samples, rows, setup_for(GRADES["tactical"], ARM), drawn_start(truth, seed)))
            t = truth.edges[np.searchsorted(ns(truth.edges), found.time_ns)]
            squares[which] += (errors(truth, t, found.position_e, found.velocity_e, found.q_e_from_b) ** 2).mean(axis=0)
    worse = np.sqrt(squares[1] / squares[0])
    assert (worse[[0, 1, 2, 6, 7, 8]] < 1.3).all(), worse
