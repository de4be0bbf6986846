"""Tests detection of standing still: a unit that stands, flies steadily, turns and rolls, and the true flight."""

from __future__ import annotations

import numpy as np
import pytest

from swath.georef.arrays import FloatArray, StructArray
from swath.georef.geodesy.earth import e_from_geodetic
from swath.georef.navigation.inputs import OBSERVATION_DTYPE, Inertial, Kind, sort_observations
from swath.georef.navigation.stillness import SIGMA_MPS, still_seconds, with_still_seconds
from swath.georef.timescales import SECOND_NS
from tests.georef.navigation.vehicles import flight_arrays

EPOCH_NS = 1_447_000_000 * SECOND_NS
RATE_HZ = 100


def unit(seconds: int, force: FloatArray, turn: FloatArray) -> Inertial:
    """Return mean force and angular rate by second."""
    n = seconds * RATE_HZ
    time_ns = EPOCH_NS + np.arange(1, n + 1) * (SECOND_NS // RATE_HZ)
    each = np.repeat(np.arange(seconds), RATE_HZ)
    noise = np.random.default_rng(5).normal(0.0, 0.05, (n, 3))
    return Inertial(
        time_ns, np.full(n, 1 / RATE_HZ), turn[each] / RATE_HZ, (force[each] + noise) / RATE_HZ, np.zeros(n, np.bool_)
    )


def velocities(speed: FloatArray, sigma: float) -> StructArray:
    rows = np.zeros(len(speed), OBSERVATION_DTYPE)
    rows["time_ns"] = EPOCH_NS + np.arange(len(speed)) * SECOND_NS
    rows["kind"], rows["sigma"], rows["value"][:, 0] = Kind.VELOCITY, sigma, speed
    return rows


def seconds_of(rows: StructArray) -> list[int]:
    return [int(number) for number in (rows["time_ns"] - EPOCH_NS) // SECOND_NS]


@pytest.fixture
def calm() -> tuple[FloatArray, FloatArray]:
    return np.tile([0.0, 0.0, -9.81], (40, 1)), np.zeros((40, 3))


def test_a_stationary_vehicle_is_detected_except_at_the_ends(
    calm: tuple[FloatArray, FloatArray],
) -> None:
    rows = still_seconds(unit(40, *calm), velocities(np.zeros(40), 0.02))
    assert seconds_of(rows) == list(range(3, 38))
    assert (rows["sigma"] == SIGMA_MPS).all()
    assert not rows["value"].any()


@pytest.mark.parametrize("rate_hz", [1, 20])
@pytest.mark.parametrize(("speed_mps", "stands"), [(0.0, True), (0.3, False), (1.5, False)])
def test_positions_alone_tell_slow_flight_from_standing_at_any_rate(
    calm: tuple[FloatArray, FloatArray], rate_hz: int, speed_mps: float, stands: bool
) -> None:
    rows = np.zeros(40 * rate_hz, OBSERVATION_DTYPE)
    t = np.arange(len(rows)) / rate_hz
    rows["time_ns"] = EPOCH_NS + np.rint(t * 1e9).astype(np.int64)
    rows["kind"], rows["sigma"] = Kind.POSITION, 0.02
    rows["value"] = e_from_geodetic(0.8, 0.1, 500.0) + np.outer(speed_mps * t, [0.0, 1.0, 0.0])
    assert bool(len(still_seconds(unit(40, *calm), rows))) == stands


def test_smooth_straight_flight_is_not_taken_for_standing(
    calm: tuple[FloatArray, FloatArray],
) -> None:
    assert not len(still_seconds(unit(40, *calm), velocities(np.full(40, 60.0), 0.02)))
    assert not len(still_seconds(unit(40, *calm), velocities(np.full(40, 0.4), 2.0))), "whatever the receiver's sigma"
    assert not len(still_seconds(unit(40, *calm), velocities(np.zeros(0), 0.02))), "nor where nobody sees it"


@pytest.mark.parametrize("sensor", ["force", "turn"])
def test_a_second_with_motion_and_its_neighbours_are_excluded(sensor: str, calm: tuple[FloatArray, FloatArray]) -> None:
    force, turn = calm
    (force if sensor == "force" else turn)[20, 1] = 0.2 if sensor == "force" else 0.01
    missing = set(range(3, 38)) - set(seconds_of(still_seconds(unit(40, force, turn), velocities(np.zeros(40), 0.02))))
    assert {18, 19, 20, 21, 22} <= missing <= set(range(18, 24))


def test_positions_detect_motion_without_velocities(calm: tuple[FloatArray, FloatArray]) -> None:
    for speed, expected in ((0.0, 35), (0.5, 0)):
        rows = velocities(np.zeros(40), 0.05)
        rows["kind"] = Kind.POSITION
        rows["value"] = [6_378_137.0, 0.0, 0.0]
        rows["value"][:, 1] = speed * np.arange(40)
        assert len(still_seconds(unit(40, *calm), rows)) == expected


def test_the_reference_flight_stands_where_its_truth_does() -> None:
    flight = flight_arrays("mems")
    time_ns = np.rint(flight["imu_t"] * 1e9).astype(np.int64)
    inertial = Inertial(
        time_ns,
        np.diff(time_ns, prepend=time_ns[0] - 5_000_000) / SECOND_NS,
        flight["imu_dtheta"].astype(np.float64),
        flight["imu_dv"].astype(np.float64),
        np.zeros(len(time_ns), np.bool_),
    )
    fixes = flight["gnss"]
    rows = np.zeros(len(fixes), OBSERVATION_DTYPE)
    rows["time_ns"], rows["kind"] = np.rint(fixes[:, 0] * 1e9), Kind.POSITION
    rows["value"] = e_from_geodetic(np.radians(fixes[:, 1]), np.radians(fixes[:, 2]), fixes[:, 3])
    rows["sigma"] = fixes[:, 4:7]
    truth = flight["truth"]
    speed = np.linalg.norm(truth[:, 5:8], axis=1)
    both = with_still_seconds(inertial, sort_observations(rows))
    found_s = both["time_ns"][both["kind"] == Kind.ZERO_VELOCITY] / SECOND_NS
    assert (np.diff(both["time_ns"]) >= 0).all()
    assert np.interp(found_s, truth[:, 1], speed).max() < 1e-3
    stands_s = np.count_nonzero(speed < 1e-3) * float(np.median(np.diff(truth[:, 1])))
    assert len(found_s) > 0.9 * stands_s
