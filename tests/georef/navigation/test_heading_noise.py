"""Tests which part of a second antenna's heading errors lasts, and how long, as estimated from a flight.

`python -m benchmarks.navigation_honesty --headings` flies twenty flights of each kind.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from swath.georef.geodesy.quaternions import conjugate, product, rotation_vector
from swath.georef.navigation.alignment.noise import HEADING_STEP_NS, spaced_headings
from swath.georef.navigation.filter.filter import run_filter
from swath.georef.navigation.filter.smoother import smooth
from swath.georef.navigation.heading_noise import find_heading_noise
from swath.georef.navigation.inputs import GRADES, Kind, Setup
from swath.georef.navigation.noise import EVIDENCE, NoiseFound
from swath.georef.navigation.solve import stretch_of
from swath.georef.records import FixType
from tests.georef.navigation.flights import BASELINE_B, Truth, drawn_start, fly, noised, survey
from tests.georef.navigation.honesty import judge, squares
from tests.georef.navigation.receivers import ARM, DUAL_ANTENNAS, HEADING_SHARE, SHARE, TAU_S, Receiver, compared
from tests.georef.navigation.vehicles import ns, observed

pytestmark = pytest.mark.xdist_group("kernels")


@cache
def flight(seconds: float) -> Truth:
    """Return a flight with lines of 90 s; heading is observable in the turns between them."""
    return fly(survey(line_s=150.0), seconds, 50.0)


def knowing(receiver: Receiver, grade: str) -> Setup:
    """Return a setup with the true noise."""
    fixes = receiver.fixes
    return Setup(
        GRADES[grade],
        ARM[None],
        baseline_b=BASELINE_B,
        gnss_correlated_share=fixes.share,
        gnss_correlation_s=fixes.tau_s,
        gnss_heading_share=fixes.heading_share,
        gnss_heading_correlation_s=fixes.heading_tau_s,
        position_floor_m=1e-3,
        velocity_floor_mps=1e-3,
        attitude_floor_rad=1e-6,
    )


def found_of(receiver: Receiver, seconds: float, seed: int, *, doubted: bool = False) -> tuple[Setup, NoiseFound]:
    """Return the assumed setup, and the heading noise found where positions and velocities are well known."""
    inertial, rows = noised(flight(seconds), GRADES["tactical"], receiver.fixes, ARM, seed)
    start = drawn_start(flight(seconds), seed)
    assumed = replace(knowing(receiver, "tactical"), gnss_heading_share=HEADING_SHARE, gnss_heading_correlation_s=TAU_S)
    stretch = stretch_of(inertial, rows, start)
    nothing = NoiseFound(assumed, (), {}, {}, doubted=doubted)
    return assumed, find_heading_noise(nothing, stretch(assumed), stretch)


@pytest.mark.slow
def test_white_headings_are_recognised_as_white() -> None:
    _, found = found_of(DUAL_ANTENNAS["white"], 180.0, 3)
    assert found.setup.gnss_heading_share == 0.0
    assert found.setup.gnss_heading_scale == pytest.approx(1.0, abs=0.06)
    assert found.heading_evidence > EVIDENCE


@pytest.mark.slow
def test_heading_errors_correlated_over_seconds_are_found() -> None:
    """Half of the variance lasts for 10 s; white sigma is found to a tenth, lasting to a fifth, the time roughly."""
    _, found = found_of(DUAL_ANTENNAS["half lasting 10 s"], 240.0, 3)
    scale, share = found.setup.gnss_heading_scale, found.setup.gnss_heading_share
    assert scale * np.sqrt(1.0 - share) == pytest.approx(np.sqrt(0.5), rel=0.1)
    assert scale * np.sqrt(share) == pytest.approx(np.sqrt(0.5), rel=0.2)
    assert 6.0 < found.setup.gnss_heading_correlation_s < 17.0
    assert found.heading_evidence > EVIDENCE


@pytest.mark.parametrize("doubted", [False, True], ids=["few", "doubted"])
def test_headings_keep_their_assumed_noise_if_it_cannot_be_estimated(doubted: bool) -> None:
    """This is so with fewer than sixty headings, and where positions are too far off for it to be noise."""
    seconds = 180.0 if doubted else 11.0
    assumed, found = found_of(DUAL_ANTENNAS["white"], seconds, 3, doubted=doubted)
    assert found.setup is assumed
    assert found.heading_evidence == 0.0


@pytest.mark.slow
def test_errors_with_correlated_headings_are_as_large_as_their_sigmas() -> None:
    """12 flights are solved with the true heading noise; the attitude's NEES must be within its 99.8 % interval."""
    receiver = DUAL_ANTENNAS["half lasting 10 s"]
    flights = []
    for seed in range(12):
        inertial, rows = noised(flight(240.0), GRADES["mems"], receiver.fixes, ARM, seed)
        run = run_filter(inertial, rows, knowing(receiver, "mems"), drawn_start(flight(240.0), seed))
        headings = run.innovations[run.innovations["kind"] == Kind.HEADING]
        white = headings["normalised"][:, 0]
        assert abs(np.mean(white[1:] * white[:-1])) < 0.12
        flights.append(squares(flight(240.0), smooth(run), 5.0, 0.5))
    for part, honesty in judge(flights).items():
        assert honesty.holds, (part, honesty)


def test_alignment_takes_headings_far_enough_apart_to_be_independent() -> None:
    """The mean of many headings keeps the variance that lasting errors leave it; white headings are all taken."""
    t = np.arange(0.0, 200.0, 0.2)
    rows = observed(Kind.HEADING, t, np.zeros(3), np.full(3, 0.01), FixType.RTK_FIXED)
    setup = Setup(GRADES["mems"], gnss_heading_share=0.5, gnss_heading_correlation_s=10.0)
    spaced = spaced_headings(rows, setup)
    assert (np.diff(spaced["time_ns"]) == HEADING_STEP_NS).all()
    covariance = 1e-4 * 0.5 * np.exp(-np.abs(np.subtract.outer(t, t)) / 10.0)
    variance = covariance[::25, ::25].mean() + 1e-4 * 0.5 / len(spaced)
    assert spaced["sigma"][0, 0] ** 2 / len(spaced) == pytest.approx(variance, rel=0.1)
    assert rows["time_ns"][0] == ns(0.0)
    assert (rows["sigma"] == 0.01).all()
    assert len(spaced_headings(rows, replace(setup, gnss_heading_share=0.0))) == len(t)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("grade", "name"),
    [("tactical", "white"), ("mems", "white"), ("tactical", "half lasting 10 s"), ("mems", "half lasting 60 s")],
)
def test_a_flight_with_two_antennas_is_navigated_as_if_its_noise_were_known(grade: str, name: str) -> None:
    """3 flights of ten minutes have sigmas that are true, too small by 3 and too large by 3.

    Attitudes lie within a quarter sigma of those of the smoother that knows the noise, which adds 3 % to their errors,
    and sigmas equal that smoother's to a tenth. Attitude errors last for a whole flight, so only many flights can show
    whether they are as large as their sigmas.
    """
    apart, variances = [], np.zeros((2, 3))
    for seed, optimism in enumerate((1.0, 3.0, 1.0 / 3.0)):
        (one,) = compared(flight(600.0), DUAL_ANTENNAS[name], grade, 100 + seed, (optimism,))
        both = one.solved.smoothed, one.best
        turned = rotation_vector(product(conjugate(one.best.q_e_from_b), one.solved.smoothed.q_e_from_b))
        apart.append(np.mean((np.linalg.norm(turned, axis=1) / one.best.attitude_sigma_rad.max(axis=1)) ** 2))
        variances += [np.square(run.attitude_sigma_rad).mean(axis=0) for run in both]
    assert np.sqrt(np.mean(apart)) < 0.25
    np.testing.assert_allclose(np.sqrt(variances[0] / variances[1]), 1.0, atol=0.1)


@pytest.mark.slow
def test_correlated_share_of_positions_is_found_with_and_without_headings() -> None:
    (one,) = compared(flight(600.0), DUAL_ANTENNAS["half lasting 10 s"], "tactical", 7, (1.0,))
    assert abs(one.solved.report.setup.gnss_correlated_share - SHARE) < 0.2
