"""Tests the receiver's noise estimated from a flight: scales by kind, fix type and axis; the lasting share.

`python -m benchmarks.navigation_honesty --receivers` flies fifty flights of each kind.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from swath.georef.arrays import StructArray
from swath.georef.geodesy.quaternions import conjugate, product, rotation_vector
from swath.georef.navigation.inputs import GRADES, INNOVATION_DTYPE, Fate, Kind, Setup
from swath.georef.navigation.noise import EVIDENCE, SIGNIFICANT, rescaled, second_moments
from swath.georef.records import FixType
from tests.georef.navigation.builders import flight
from tests.georef.navigation.honesty import judge
from tests.georef.navigation.honesty import squares as normalised_squares
from tests.georef.navigation.receivers import RECEIVERS, SHARE, Receiver, compared

pytestmark = pytest.mark.xdist_group("kernels")

FIXED, FLOAT = int(FixType.RTK_FIXED), int(FixType.RTK_FLOAT)


def innovations(
    kind: Kind, fix: int, times: tuple[float, float, float], count: int = 900, seed: int = 4
) -> StructArray:
    """Return rows of white innovations, `times` as large as predicted on each axis."""
    rows = np.zeros(count, INNOVATION_DTYPE)
    rows["kind"], rows["fate"], rows["fix_type"], rows["dimension"] = kind, Fate.TAKEN, fix, 3
    rows["time_ns"] = np.arange(count)
    rows["normalised"] = times * np.random.default_rng(seed).standard_normal((count, 3))
    rows["chi2"] = (rows["normalised"] ** 2).sum(axis=1)
    return rows


def test_sigmas_are_scaled_up_and_down_by_kind_fix_type_and_axis() -> None:
    rows = np.concatenate(
        [
            innovations(Kind.POSITION, FIXED, (3.0, 3.0, 1.5)),
            innovations(Kind.POSITION, FLOAT, (0.4, 0.4, 0.4)),
            innovations(Kind.VELOCITY, FIXED, (0.15, 0.15, 0.3)),
            innovations(Kind.HEADING, FIXED, (1.5, 1.5, 1.5)),
        ]
    )
    found, won = rescaled(Setup(GRADES["tactical"], gnss_sigma_scale={FIXED: 2.0}), rows)
    assert found.gnss_sigma_scale == pytest.approx({FIXED: 6.0, FLOAT: 0.4}, rel=0.06)
    assert found.gnss_vertical_scale == pytest.approx({FIXED: 0.5, FLOAT: 1.0}, rel=0.06)
    assert found.gnss_velocity_scale == pytest.approx({FIXED: 0.15}, rel=0.06)
    assert found.gnss_velocity_vertical_scale == pytest.approx({FIXED: 2.0}, rel=0.06)
    assert found.gnss_heading_scale == pytest.approx(1.5, rel=0.06)
    assert min(won.values()) > EVIDENCE


def test_innovations_within_chance_scale_nothing() -> None:
    """Innovations are as large as predicted, or there are fewer than sixty, too few to judge."""
    setup = Setup(GRADES["tactical"])
    few = innovations(Kind.VELOCITY, FIXED, (3.0, 3.0, 3.0), count=59)
    rows = np.concatenate([innovations(Kind.POSITION, FIXED, (1.0, 1.0, 1.0)), few])
    assert rescaled(setup, rows) == (setup, {})


def test_an_outlier_does_not_affect_the_other_scales() -> None:
    rows = innovations(Kind.POSITION, FIXED, (1.0, 1.0, 1.0))
    rows["normalised"][100], rows["chi2"][100] = 60.0, 3 * 3600.0
    assert second_moments(rows)[0][int(Kind.POSITION), FIXED, False] == pytest.approx(1.0, abs=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("optimism", [1.0, 3.0, 1.0 / 3.0], ids=["honest", "optimistic", "pessimistic"])
@pytest.mark.parametrize("name", RECEIVERS)
def test_a_flight_is_navigated_as_if_its_noise_were_known(name: str, optimism: float) -> None:
    """Errors of positions and velocities, and all sigmas, are near those of the smoother that knows the true noise.

    Errors of attitude last for a whole flight, so that two flights have few of them: each lies within half a sigma of
    that smoother's, which adds at most a quarter to the variance. The share of lasting errors is found to 0.12 where
    there are enough fixes to estimate it, and is assumed elsewhere.
    """
    squares, sigmas = np.zeros((2, 9)), np.zeros((2, 3, 3))
    for seed in range(2):
        (one,) = compared(flight(), RECEIVERS[name], "tactical", seed, (optimism,))
        squares += one.squares(flight())
        for row, found in enumerate((one.solved.smoothed, one.best)):
            of = (found.position_sigma_l, found.velocity_sigma_l, found.attitude_sigma_rad)
            sigmas[row] += [np.square(column).mean(axis=0) for column in of]
        assert abs(one.solved.report.setup.gnss_correlated_share - SHARE) < 0.25
        apart = rotation_vector(product(conjugate(one.best.q_e_from_b), one.solved.smoothed.q_e_from_b))
        spread = np.linalg.norm(one.best.attitude_sigma_rad, axis=1)
        assert np.sqrt(np.mean((np.linalg.norm(apart, axis=1) / spread) ** 2)) < 0.5
    assert (np.sqrt(squares[0] / squares[1])[:6] < 1.1).all()
    np.testing.assert_allclose(np.sqrt(sigmas[0] / sigmas[1]), 1.0, atol=0.2)


@pytest.mark.slow
@pytest.mark.parametrize("name", RECEIVERS)
def test_sigmas_equal_the_errors_whatever_the_receiver_states(name: str) -> None:
    """18 flights of 240 s have sigmas that are true, too small by 3 and too large by 3 in turn.

    NEES of position, velocity and attitude lie within the 99.8 % interval; RMS errors of positions and velocities are
    at most 1.05 times the best smoother's. 18 flights are too few to compare attitude errors like this: attitudes lie
    within a tenth of a sigma of the best, which adds half a percent to their errors.
    """
    flights, squared, apart = [], np.zeros((2, 9)), []
    for seed in range(18):
        (one,) = compared(flight(), RECEIVERS[name], "tactical", 100 + seed, ([1.0, 3.0, 1.0 / 3.0][seed % 3],))
        flights.append(normalised_squares(flight(), one.solved.smoothed, 5.0, 0.5))
        squared += one.squares(flight())
        turned = rotation_vector(product(conjugate(one.best.q_e_from_b), one.solved.smoothed.q_e_from_b))
        apart.append(np.mean((np.linalg.norm(turned, axis=1) / one.best.attitude_sigma_rad.max(axis=1)) ** 2))
    for part, honesty in judge(flights).items():
        assert honesty.holds, (part, honesty)
        assert honesty.independent > 18.0, (part, honesty)
    assert (np.sqrt(squared[0] / squared[1])[:6] < 1.05).all()
    assert np.sqrt(np.mean(apart)) < 0.1


def filtered(share: float, tau_s: float) -> Receiver:
    """Return a receiver that filters its velocities."""
    receiver = RECEIVERS["UBX"]
    return replace(receiver, fixes=replace(receiver.fixes, velocity_share=share, velocity_tau_s=tau_s))


@pytest.mark.slow
@pytest.mark.parametrize("grade", ["tactical", "mems"])
def test_velocity_errors_correlated_over_seconds_are_found(grade: str) -> None:
    """Half of the velocities' variance lasts for 2 s; the result is within a quarter of a sigma of the best smoother's.

    How long the errors last and how large their share is cannot be separated well, so neither is tested here.
    """
    (one,) = compared(flight(), filtered(0.5, 2.0), grade, 7, (1.0,))
    noise = one.solved.report.noise
    assert noise is not None
    assert noise.velocity_evidence > 10.0 * SIGNIFICANT
    for part in ("position_sigma_l", "velocity_sigma_l", "attitude_sigma_rad"):
        sigmas = [np.sqrt(np.mean(getattr(run, part) ** 2, axis=0)) for run in (one.solved.smoothed, one.best)]
        np.testing.assert_allclose(sigmas[0] / sigmas[1], 1.0, atol=0.2)
    off = one.solved.smoothed.velocity_e - one.best.velocity_e
    assert np.sqrt(np.mean(off**2)) < 0.25 * np.sqrt(np.mean(one.best.velocity_sigma_l**2))


@pytest.mark.slow
def test_white_velocities_are_not_reported_as_correlated() -> None:
    """The search for correlated velocity errors must find none and leave the setup unchanged."""
    (one,) = compared(flight(), RECEIVERS["UBX"], "tactical", 7, (1.0,))
    assert one.solved.report.noise is not None
    assert one.solved.report.noise.velocity_evidence == 0.0
    assert one.solved.report.setup.gnss_velocity_share == 0.0
