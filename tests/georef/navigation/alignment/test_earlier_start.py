"""Tests a start moved back in time: it agrees with the truth of an exact motion, and its sigmas hold."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pyproj import Transformer
from scipy.spatial.transform import Rotation

from swath.georef.arrays import FloatArray, StructArray
from swath.georef.navigation.alignment.earlier_start import drift_rad, earlier_start
from swath.georef.navigation.inputs import GRADES, OBSERVATION_DTYPE, Inertial, Kind, Setup, Start, imu_noise

S = 1_000_000_000
START_NS = 1_465_549_218 * S
RATE_HZ = 100
EARTH = np.array([0.0, 0.0, 7.292115e-5])
ARM = np.array([0.4, -0.3, -1.2])
TURN_B = np.array([0.3, -0.1, 0.25])  # rad/s, of the body relative to e, constant
SPEED_E = np.array([20.0, -30.0, 25.0])
SECONDS = 20.0
SETUP = Setup(GRADES["tactical"], ARM[None])


def place_e(since_s: FloatArray) -> FloatArray:
    origin = np.array(Transformer.from_crs(4979, 4978, always_xy=True).transform(8.9, 47.5, 900.0))
    place: FloatArray = origin + np.multiply.outer(since_s, SPEED_E)
    return place


def turned_e(since_s: FloatArray) -> Rotation:
    return Rotation.from_euler("ZYX", [0.7, 0.2, -0.4]) * Rotation.from_rotvec(np.multiply.outer(since_s, TURN_B))


def samples() -> Inertial:
    """Return exact turns relative to inertial space, whose axes coincide with e at the beginning."""
    ends = np.arange(1, round(SECONDS * RATE_HZ) + 1) / RATE_HZ
    inertial = [Rotation.from_rotvec(np.multiply.outer(at, EARTH)) * turned_e(at) for at in (ends - 1 / RATE_HZ, ends)]
    angle_b = (inertial[0].inv() * inertial[1]).as_rotvec()
    n = len(ends)
    time_ns = START_NS + np.rint(ends * S).astype(np.int64)
    return Inertial(time_ns, np.full(n, 1 / RATE_HZ), angle_b, np.zeros((n, 3)), np.zeros(n, np.bool_))


def l_from_e(position_e: FloatArray) -> FloatArray:
    """Return the rotation (3, 3) computed by another library."""
    lon, lat, _ = np.radians(Transformer.from_crs(4978, 4979, always_xy=True).transform(*position_e))
    up = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
    east = np.array([-np.sin(lon), np.cos(lon), 0.0])
    return np.stack([np.cross(up, east), east, -up])


def observations(*, velocities: bool) -> StructArray:
    since = np.arange(0.2, SECONDS, 0.5)
    swung = turned_e(since).apply(ARM)
    rows = np.zeros(len(since), OBSERVATION_DTYPE)
    rows["time_ns"], rows["kind"] = START_NS + np.rint(since * S).astype(np.int64), Kind.POSITION
    rows["value"], rows["sigma"] = place_e(since) + swung, [0.01, 0.02, 0.03]
    if not velocities:
        return rows
    moving = rows.copy()
    moving["kind"], moving["sigma"] = Kind.VELOCITY, 0.05
    speed = SPEED_E + turned_e(since).apply(np.cross(TURN_B, ARM))
    moving["value"] = [l_from_e(place) @ v for place, v in zip(rows["value"], speed, strict=True)]
    return np.concatenate([rows, moving])


def start_at(since_s: float) -> Start:
    place = place_e(np.array([since_s]))[0]
    attitude = Rotation.from_matrix(l_from_e(place)) * turned_e(np.array(since_s))
    yaw, pitch, roll = attitude.as_euler("ZYX")
    nothing = np.full(3, 0.001)
    speed = l_from_e(place) @ SPEED_E
    return Start(START_NS + round(since_s * S), place, speed, np.array([roll, pitch, yaw]), nothing, nothing, nothing)


@pytest.mark.parametrize("velocities", [True, False])
def test_the_earlier_start_matches_the_truth(velocities: bool) -> None:
    found = earlier_start(samples(), observations(velocities=velocities), SETUP, start_at(15.0))
    true = start_at(0.2)
    assert found.time_ns == true.time_ns
    assert np.abs(found.attitude_rad - true.attitude_rad).max() < 1e-6  # with the turn between the places' frames
    assert np.abs(found.position_e - true.position_e).max() < 1e-5
    assert (np.abs(found.velocity_l - true.velocity_l) <= (1e-5 if velocities else found.velocity_sigma_l)).all()


def test_sigmas_of_the_earlier_start_combine_gnss_and_gyroscope_drift() -> None:
    found = earlier_start(samples(), observations(velocities=True), SETUP, start_at(15.0))
    assert found.position_sigma_l == pytest.approx([0.03, 0.06, 0.09])
    drift = drift_rad(SETUP.noise, 14.8)
    assert found.attitude_sigma_rad == pytest.approx(np.full(3, np.hypot(0.001, drift)))
    assert drift_rad(imu_noise(3.0, 0.1, 4.0, 1.0), 3600.0) == pytest.approx(np.radians(5.0))


def test_strongly_drifting_gyroscopes_reach_back_less() -> None:
    poor = replace(SETUP, noise=replace(SETUP.noise, gyro_bias=np.radians(0.4)))
    found = earlier_start(samples(), observations(velocities=True), poor, start_at(15.0))
    assert (START_NS + 15 * S - found.time_ns) / S == pytest.approx(4.8)


def test_without_earlier_samples_the_start_is_unchanged() -> None:
    start = start_at(0.1)
    assert earlier_start(samples(), observations(velocities=True), SETUP, start) is start
    assert earlier_start(samples(), observations(velocities=True)[:0], SETUP, start_at(9.0)).time_ns == START_NS + 9 * S
