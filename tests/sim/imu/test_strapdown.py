"""Tests that the measurements of perfect sensors lead back to the flight."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from swath.georef.arrays import FloatArray
from swath.sim.flight.trajectory import Trajectory
from swath.sim.gravity import EARTH_RATE_RADPS
from swath.sim.imu.sensors import Increments, true_increments
from swath.sim.imu.strapdown import States, navigate
from tests.sim.inertial_motion import rough_flight

RATE_HZ = 400
MINUTES = 10
LIMIT_M = 0.01


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Trajectory:
    return rough_flight(Path(tmp_path_factory.getbasetemp()))


def edges_s(seconds: float) -> FloatArray:
    return np.arange(round(seconds * RATE_HZ) + 1) / RATE_HZ


def navigated(flight: Trajectory, seconds: float, lever_arm_b: FloatArray | None = None) -> States:
    """Navigate from the true start with increments alone, made five seconds at a time."""
    edges = edges_s(seconds)
    cuts = range(0, len(edges) - 1, 5 * RATE_HZ)
    blocks: list[Increments] = [true_increments(flight, edges[k : k + 5 * RATE_HZ + 1], lever_arm_b) for k in cuts]
    start = flight.motion(edges[:1])
    position_e, velocity_e, rot_e_from_b = start.position_e[0], start.velocity_e[0], start.rot_e_from_b[0]
    if lever_arm_b is not None:
        position_e = position_e + rot_e_from_b @ lever_arm_b
        velocity_e = velocity_e + rot_e_from_b @ np.cross(start.rate_eb_b[0], lever_arm_b)
    angle_b = np.concatenate([block.angle_b for block in blocks])
    velocity_b = np.concatenate([block.velocity_b for block in blocks])
    return navigate(position_e, velocity_e, rot_e_from_b, angle_b, velocity_b, np.diff(edges))


def distances_m(states: States, flight: Trajectory, seconds: float, lever_arm_b: FloatArray) -> FloatArray:
    """Return distances from the truth, ten times a second and at the end."""
    step = RATE_HZ // 10
    truth = flight.poses(edges_s(seconds)[step::step])
    points_e = truth.position_e + truth.rot_e_from_b @ lever_arm_b
    distances: FloatArray = np.linalg.norm(states.position_e[step - 1 :: step] - points_e, axis=1)
    return distances


@pytest.mark.slow
def test_ten_turbulent_minutes_are_integrated_to_a_centimetre(flight: Trajectory) -> None:
    seconds = 60.0 * MINUTES
    assert flight.end_s > seconds
    roll_rad, _, heading_rad = flight.attitude(edges_s(seconds)[::RATE_HZ])
    assert np.ptp(np.unwrap(heading_rad)) > np.pi
    assert np.degrees(roll_rad).max() > 15
    assert np.degrees(roll_rad).min() < -15
    states = navigated(flight, seconds)
    assert distances_m(states, flight, seconds, np.zeros(3)).max() < LIMIT_M
    truth = flight.motion(edges_s(seconds)[-1:])
    turned = Rotation.from_matrix(truth.rot_e_from_b[0]).inv() * states.rot_e_from_b[-1]
    assert turned.magnitude() < 1e-6
    np.testing.assert_allclose(states.velocity_e[-1], truth.velocity_e[0], rtol=0, atol=1e-4)


def test_integration_off_the_body_origin_is_accurate_to_a_centimetre(flight: Trajectory) -> None:
    seconds, lever_arm_b = 120.0, np.array([1.5, -0.8, 0.6])
    states = navigated(flight, seconds, lever_arm_b)
    assert distances_m(states, flight, seconds, lever_arm_b).max() < LIMIT_M


def test_small_rate_and_gravity_errors_break_the_centimetre(flight: Trajectory) -> None:
    """A hundredth of the earth's rate, or a tenth of a milligal, exceeds the limit, so the limit is strict enough."""
    seconds = 300.0
    edges = edges_s(seconds)
    increments = true_increments(flight, edges)
    start = flight.motion(edges[:1])
    began = start.position_e[0], start.velocity_e[0], start.rot_e_from_b[0]
    span_s = np.diff(edges)[:, None]
    turned = increments.angle_b + span_s * [0.01 * EARTH_RATE_RADPS, 0.0, 0.0]
    pushed = increments.velocity_b + span_s * [0.0, 0.0, 1e-6]
    for angle_b, velocity_b in ((turned, increments.velocity_b), (increments.angle_b, pushed)):
        states = navigate(*began, angle_b, velocity_b, np.diff(edges))
        assert distances_m(states, flight, seconds, np.zeros(3)).max() > LIMIT_M
