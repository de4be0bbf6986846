"""Tests trajectories whose times are wrong by a known amount, in rough air of the virtual aircraft."""

from __future__ import annotations

import re
import tracemalloc
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.trajectory.trajectory import Trajectory, TrajectoryError
from swath.georef.trajectory.turn_rates import TimeShift, correlate_turn_rates
from swath.sim.imu.sensors import true_increments
from tests.georef.flown import START_NS, flown
from tests.sim.inertial_motion import rough_flight

pytestmark = pytest.mark.xdist_group("kernels")

DAY_S = 86_400
FIRST_S, LAST_S, RATE_HZ = 60.0, 240.0, 100


class Felt(NamedTuple):
    time_ns: Int64Array
    rate_b: FloatArray


class Flight(NamedTuple):
    trajectory: Trajectory
    felt: Felt


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Flight:
    """Return three minutes with a turn, a vibrating MEMS IMU, and an attitude with white errors of 0.01° per axis."""
    truth = rough_flight(Path(tmp_path_factory.mktemp("plan")))
    rng = np.random.default_rng(4)
    edges_s = np.arange(FIRST_S, LAST_S, 1 / RATE_HZ)
    rate_b = true_increments(truth, edges_s).angle_b * RATE_HZ
    rate_b += rng.normal([0.002, -0.001, 0.003], 0.01, rate_b.shape)
    samples_ns = START_NS + np.rint(edges_s * 1e9).astype(np.int64)
    epochs_s = np.arange(FIRST_S - 30, LAST_S + 30, 1 / 50)
    motion = truth.motion(epochs_s)
    body = Rotation.from_matrix(motion.rot_e_from_b) * Rotation.from_rotvec(rng.normal(0, 2e-4, (len(epochs_s), 3)))
    nothing = np.full((len(epochs_s), 3), np.nan)
    trajectory = Trajectory(
        START_NS + np.rint(epochs_s * 1e9).astype(np.int64),
        motion.position_e,
        np.roll(body.as_quat(), 1, axis=1),
        motion.velocity_e,
        nothing,
        nothing,
        name="flown",
    )
    return Flight(trajectory, Felt(samples_ns, np.concatenate([rate_b[:1], rate_b])))


def late(trajectory: Trajectory, seconds: float) -> Trajectory:
    """Return the trajectory with timestamps that are too small by so much."""
    return replace(trajectory, time_ns=trajectory.time_ns - round(seconds * 1e9))


def shift_of(flight: Flight, seconds: float) -> TimeShift:
    return correlate_turn_rates(late(flight.trajectory, seconds), *flight.felt)


def test_a_correct_time_is_confirmed(flight: Flight) -> None:
    shift = shift_of(flight, 0.0)
    assert shift.correlation > 0.9
    assert abs(shift.seconds) < 0.005
    assert not shift.is_wrong
    assert shift.what == ""


@pytest.mark.parametrize(
    ("seconds", "what"),
    [
        (18.0, r"^its time is UTC, not GPS: add \+18 s$"),
        (-18.0, r"^leap seconds were added to it twice: add -18 s$"),
        (3.3, r"^its time is off: add \+3\.\d+ s$"),
        (-0.25, r"^its time is off: add -0\.2\d+ s$"),
        (7.0 * DAY_S, r"^its week is wrong: add \+1$"),
        (-14.0 * DAY_S, r"^its week is wrong: add -2$"),
        (7.0 * DAY_S + 18.0, r"^its week is wrong: add \+1; its time is UTC, not GPS: add \+18 s"),
        (6.0 * DAY_S, r"^its day is wrong, or its time is in seconds of the day: add \+518400 s$"),
        (1024 * 7.0 * DAY_S, r"^its week is wrong: add \+1024$"),
    ],
)
def test_wrong_time_is_named(flight: Flight, seconds: float, what: str) -> None:
    shift = shift_of(flight, seconds)
    assert shift.seconds == pytest.approx(seconds, abs=0.005)
    assert shift.correlation > 0.9
    assert shift.is_wrong
    assert re.search(what, shift.what), shift.what


def test_before_leap_seconds_utc_is_not_a_wrong_time(flight: Flight) -> None:
    early_ns = START_NS - 10**9 * 604_800 * 10
    trajectory = replace(flight.trajectory, time_ns=flight.trajectory.time_ns - early_ns)
    shift = correlate_turn_rates(late(trajectory, 7.0 * DAY_S), flight.felt.time_ns - early_ns, flight.felt.rate_b)
    assert shift.what == "its week is wrong: add +1"


def test_the_sigma_of_the_time_shift_is_realistic(flight: Flight) -> None:
    """Over parts of the flight the shift found differs from the true one by a few of its sigmas."""
    errors = []
    for begin in range(0, 16_000, 2_000):
        felt = Felt(flight.felt.time_ns[begin : begin + 4_000], flight.felt.rate_b[begin : begin + 4_000])
        shift = correlate_turn_rates(late(flight.trajectory, 1.2345), *felt)
        errors.append((shift.seconds - 1.2345) / shift.sigma)
    assert 0.1 < float(np.sqrt(np.mean(np.square(errors)))) < 4.0


def test_another_flight_gives_no_certain_result(flight: Flight) -> None:
    other = flown(12_000, step_s=0.02, start_ns=int(flight.felt.time_ns[0]) - 30 * 10**9)
    shift = correlate_turn_rates(other, *flight.felt)
    assert not shift.is_certain
    assert shift.what == ""


def test_too_little_overlap_gives_no_certain_result(flight: Flight) -> None:
    felt = Felt(flight.felt.time_ns[:1000], flight.felt.rate_b[:1000])
    shift = correlate_turn_rates(flight.trajectory, *felt)
    assert np.isnan(shift.correlation)
    assert not shift.is_wrong


def test_gaps_are_ignored(flight: Flight) -> None:
    keep = np.ones(len(flight.trajectory), np.bool_)
    keep[3000:4500] = False
    columns = {
        name: getattr(flight.trajectory, name)[keep]
        for name in ("time_ns", "position_e", "q_e_from_b", "velocity_e", "position_sigma_l", "attitude_sigma_rad")
    }
    holed = Trajectory(**columns, name="holed")
    shift = correlate_turn_rates(late(holed, 2.0), *flight.felt)
    assert shift.seconds == pytest.approx(2.0, abs=0.005)
    assert shift.correlation > 0.9


def test_non_finite_samples_are_ignored(flight: Flight) -> None:
    rate_b = flight.felt.rate_b.copy()
    rate_b[[0, 777, 9000], [0, 1, 2]] = np.nan
    shift = correlate_turn_rates(late(flight.trajectory, 2.0), flight.felt.time_ns, rate_b)
    assert shift.seconds == pytest.approx(2.0, abs=0.005)
    assert shift.correlation > 0.9


def test_a_single_epoch_days_earlier_uses_no_memory_and_hides_no_wrong_time(flight: Flight) -> None:
    """There are 17 million steps of 50 ms, of which 6000 matter."""
    time_ns = flight.trajectory.time_ns.copy()
    time_ns[0] -= 10 * DAY_S * 10**9
    stray = late(replace(flight.trajectory, time_ns=time_ns), 18.0)
    tracemalloc.start()
    shift = correlate_turn_rates(stray, *flight.felt)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert shift.what == "its time is UTC, not GPS: add +18 s"
    assert most < 50_000_000


def test_positions_without_attitude_give_no_turn_rates(flight: Flight) -> None:
    bare = replace(flight.trajectory, q_e_from_b=np.full_like(flight.trajectory.q_e_from_b, np.nan))
    with pytest.raises(TrajectoryError, match="no attitude"):
        correlate_turn_rates(bare, *flight.felt)
