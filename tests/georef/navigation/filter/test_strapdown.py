"""Tests the strapdown against the simulator's exact motions, coning in closed form, Schuler's period, and pyins."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from pyins import strapdown as of_pyins
from pyins.transform import lla_to_ecef
from pyins.util import DV_COLS, LLA_COLS, RPH_COLS, THETA_COLS, VEL_COLS
from scipy.linalg import expm

from swath.georef.arrays import FloatArray
from swath.georef.geodesy.earth import e_from_geodetic, geodetic_from_e, rot_e_from_l
from swath.georef.geodesy.gravity import EARTH_RATE_RADPS
from swath.georef.geodesy.rotations import quaternion_from_rot, rot_l_from_b
from swath.georef.navigation.filter.filter import start_state
from swath.georef.navigation.filter.strapdown import ACCEL_BIAS, GYRO_BIAS, STATE_SIZE, navigate
from swath.georef.navigation.inputs import ImuNoise, Inertial
from swath.sim.gravity import gravity_e
from swath.sim.imu.sensors import true_increments
from tests.georef.navigation.flights import drawn_start, errors, fly, setup_for, survey
from tests.georef.navigation.vehicles import ns, reference
from tests.sim.inertial_motion import circling_the_pole

pytestmark = pytest.mark.xdist_group("kernels")

RADIUS_M = 6_378_137.0
PERFECT = ImuNoise(0.0, 0.0, 0.0, 0.0)


def state_of(position_e: FloatArray, velocity_e: FloatArray, rot_e_from_b: FloatArray) -> FloatArray:
    state = np.zeros(STATE_SIZE)
    state[:3], state[3:6], state[6:10] = position_e, velocity_e, quaternion_from_rot(rot_e_from_b)
    return state


def samples(edges_s: FloatArray, angle_b: FloatArray, velocity_b: FloatArray) -> Inertial:
    return Inertial(ns(edges_s[1:]), np.diff(edges_s), angle_b, velocity_b, np.zeros(len(angle_b), np.bool_))


def at_rest(
    lat_deg: float, lon_deg: float, height_m: float, seconds: float, rate_hz: float
) -> tuple[Inertial, FloatArray]:
    """Return perfect samples of a unit at rest, and its state."""
    lat, lon = np.radians([lat_deg]), np.radians([lon_deg])
    position_e = e_from_geodetic(lat, lon, [height_m])
    rot = rot_e_from_l(lat, lon)[0] @ rot_l_from_b(0.05, -0.03, 2.0)
    edges = np.arange(round(seconds * rate_hz) + 1) / rate_hz
    one = np.ones((len(edges) - 1, 1)) / rate_hz
    angle = one * (np.array([0.0, 0.0, EARTH_RATE_RADPS]) @ rot)
    push = one * (-gravity_e(position_e)[0] @ rot)
    return samples(edges, angle, push), state_of(position_e[0], np.zeros(3), rot)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("lat_deg", "lon_deg", "height_m"),
    [(90.0, 0.0, 30.0), (-90.0, 0.0, 2800.0), (89.9999999, 120.0, 0.0), (47.0, 180.0, 500.0), (-20.0, 8.0, 6000.0)],
)
def test_a_unit_at_rest_stays_in_place(lat_deg: float, lon_deg: float, height_m: float) -> None:
    """In ten minutes only the error of Bowring's single step, 1e-11 of gravity, moves it, by micrometres."""
    inertial, state = at_rest(lat_deg, lon_deg, height_m, 600.0, 50.0)
    end = navigate(inertial, state)[-1]
    assert np.abs(end[:3] - state[:3]).max() < 1e-5
    assert np.abs(end[3:6]).max() < 1e-7
    assert np.abs(end[6:] - state[6:10]).max() < 1e-11


def test_a_circle_around_the_pole_stays_a_circle() -> None:
    """In a minute on a circle of 100 m around the pole, longitude takes every value; the position must not suffer."""
    path = circling_the_pole(60.0, 100.0, 0.2, 6_356_752.3)
    edges = np.arange(12_001) / 200.0
    exact = true_increments(path, edges)
    begin, end = path.motion(edges[:1]), path.motion(edges[-1:])
    state = state_of(begin.position_e[0], begin.velocity_e[0], begin.rot_e_from_b[0])
    found = navigate(samples(edges, exact.angle_b, exact.velocity_b), state)[-1]
    assert np.abs(found[:3] - end.position_e[0]).max() < 2e-3
    assert np.abs(found[3:6] - end.velocity_e[0]).max() < 1e-4


def test_a_flight_is_reproduced_from_its_increments() -> None:
    """In two minutes with turns and a vibrating fuselage, the rest is as small as the two-sample algorithms' error."""
    truth = fly(survey(), 120.0, 200.0)
    start = drawn_start(truth, 0, position_m=0.0, velocity_mps=0.0, attitude_rad=(0.0, 0.0, 0.0))
    found = navigate(truth.inertial(), start_state(setup_for(PERFECT, np.zeros(3)), start))
    off = errors(truth, truth.edges[1:], found[:, :3], found[:, 3:6], found[:, 6:])
    assert np.abs(off[:, :3]).max() < 5e-3
    assert np.abs(off[:, 3:6]).max() < 2e-4
    assert np.abs(off[:, 6:]).max() < 1e-7


def test_coning_is_compensated() -> None:
    """Over a cone of 1° at 5 Hz, an uncompensated strapdown would be off by 4e-4 rad in 20 s.

    This is Ω a²/2 (1 − sin φ / φ), with φ the cone's turn in a sample. The body's z axis goes round a cone, which q(t)
    = (cos a/2, sin a/2 cos Ωt, sin a/2 sin Ωt, 0) describes (Bortz 1971); its rate is (−Ω sin a sin Ωt, Ω sin a cos Ωt,
    −2 Ω sin² a/2).
    """
    half, omega, rate_hz, seconds = np.radians(1.0), 2.0 * np.pi * 5.0, 200.0, 20.0
    edges = np.arange(round(seconds * rate_hz) + 1) / rate_hz
    phase = omega * edges
    along = np.column_stack(
        [np.sin(half) * np.cos(phase), np.sin(half) * np.sin(phase), -2.0 * omega * np.sin(half / 2.0) ** 2 * edges]
    )
    first = np.array([np.cos(half / 2), np.sin(half / 2), 0.0, 0.0])
    state = np.zeros(STATE_SIZE)
    state[:3], state[6:10] = (RADIUS_M, 0.0, 0.0), first
    inertial = samples(edges, np.diff(along, axis=0), np.zeros((len(edges) - 1, 3)))
    end = navigate(inertial, state)[-1, 6:]
    turned = EARTH_RATE_RADPS * seconds / 2.0
    cos, sin = np.cos(turned), np.sin(turned)
    w, x, y, z = end  # the turn of e taken back: (cos, 0, 0, sin) ⊗ q
    inertial_end = np.array([cos * w - sin * z, cos * x - sin * y, cos * y + sin * x, cos * z + sin * w])
    expected = np.array([np.cos(half / 2), np.sin(half / 2), 0.0, 0.0])  # after whole turns
    assert np.abs(inertial_end - expected).max() < 2e-6


@pytest.mark.parametrize("what", ["accelerometer", "tilt", "gyroscope"])
def test_an_hour_shows_schuler_oscillation(what: str) -> None:
    """The reference is the matrix exponential of the linear error equations on the equator, towards north.

    With tilt θ (nose down) and heading ψ: dx = v, dv = g θ + b, dθ = ε − v / M + Ω ψ, dψ = −Ω (θ + x / M). Without Ω
    the solution is b / ω² (1 − cos ωt) and similar terms.
    """
    lat, lon = np.zeros(1), np.array([3.0])
    position_e = e_from_geodetic(lat, lon, [0.0])
    level = rot_e_from_l(lat, lon)[0]
    edges = np.arange(36_001) / 10.0
    one = np.full((36_000, 1), 0.1)
    gravity = gravity_e(position_e)[0]
    state = state_of(position_e[0], np.zeros(3), level)
    meridian_m = RADIUS_M * (1.0 - 0.00669437999014132)
    force, tilt, drift = 0.0, 0.0, 0.0
    if what == "accelerometer":
        force = 2e-4
        state[ACCEL_BIAS] = -force  # it is subtracted from the measurement
    elif what == "tilt":
        tilt = 2e-5
        state = state_of(position_e[0], np.zeros(3), level @ rot_l_from_b(0.0, -tilt, 0.0))
    else:
        drift = 2e-8
        state[GYRO_BIAS + 1] = drift
    matrix = np.zeros((6, 6))  # x, v, θ, ψ, b, ε
    matrix[0, 1], matrix[1, 2], matrix[1, 4] = 1.0, 9.7803253359, 1.0
    matrix[2, 1], matrix[2, 3], matrix[2, 5], matrix[3, 2] = -1.0 / meridian_m, EARTH_RATE_RADPS, 1.0, -EARTH_RATE_RADPS
    matrix[3, 0] = -EARTH_RATE_RADPS / meridian_m
    begin = np.array([0.0, 0.0, tilt, 0.0, force, drift])
    expected = np.array([(expm(matrix * t) @ begin)[0] for t in edges[1::600]])
    inertial = samples(edges, one * (np.array([0.0, 0.0, EARTH_RATE_RADPS]) @ level), one * (-gravity @ level))
    north = (navigate(inertial, state)[::600, :3] - position_e[0]) @ level[:, 0]
    assert np.abs(expected).max() > 100.0
    assert np.abs(north - expected).max() < 0.002 * np.abs(expected).max()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:The copy keyword")
def test_three_minutes_match_pyins() -> None:
    """Both integrate the increments of the reference flight; above the ground pyins' gravity differs by 3e-6 m/s²."""
    flown = reference("tactical").cut(100_700.0, 100_880.0)
    true = reference("tactical").truth
    assert true is not None
    begin = np.array([100_700.0])
    rot, velocity, place = (value[0] for value in true(begin))
    inertial = flown.inertial
    lat, lon, height = (float(v) for v in geodetic_from_e(place))
    state = state_of(place, rot_e_from_l(lat, lon) @ velocity, rot_e_from_l(lat, lon) @ rot)
    found = navigate(inertial, state)
    angles = np.degrees([np.arctan2(rot[2, 1], rot[2, 2]), -np.arcsin(rot[2, 0]), np.arctan2(rot[1, 0], rot[0, 0])])
    first = pd.Series([np.degrees(lat), np.degrees(lon), height, *velocity, *angles], LLA_COLS + VEL_COLS + RPH_COLS)
    first.name = 0.0
    columns = ["dt", *THETA_COLS, *DV_COLS]
    angle, push = _two_sample(inertial)
    table = pd.DataFrame(np.column_stack([inertial.interval_s, angle, push]), columns=columns)
    table.index = np.cumsum(inertial.interval_s)
    theirs = of_pyins.Integrator(first).integrate(table)
    there = lla_to_ecef(theirs[LLA_COLS].iloc[-1].to_numpy())
    travelled = np.linalg.norm(found[-1, :3] - place)
    assert np.linalg.norm(found[-1, :3] - there) < 0.2  # noise and biases cause hundreds of metres
    assert travelled > 2000.0


def _two_sample(inertial: Inertial) -> tuple[FloatArray, FloatArray]:
    """Return rotation vector and velocity increment in the axes at the interval's beginning, as pyins takes them."""
    a, v = inertial.angle_b, inertial.velocity_b
    angle, push = a.copy(), v + 0.5 * np.cross(a, v)
    angle[1:] += np.cross(a[:-1], a[1:]) / 12.0
    push[1:] += (np.cross(a[:-1], v[1:]) + np.cross(v[:-1], a[1:])) / 12.0
    return angle, push
