"""Tests the errors' transition and observation derivatives against differences of the nonlinear equations."""

from __future__ import annotations

import numpy as np
import pytest

from swath.georef.arrays import FloatArray
from swath.georef.geodesy.earth import e_from_geodetic, rot_e_from_l
from swath.georef.geodesy.rotations import quaternion_from_rot, rot_l_from_b
from swath.georef.navigation.filter.error_model import (
    CORE,
    LEANS,
    MOVED,
    Drive,
    accumulate,
    add_noise,
    begin_accumulation,
    decays,
    inject,
    layout_of,
    propagate,
    transition,
)
from swath.georef.navigation.filter.measurements import predict, rules_of
from swath.georef.navigation.filter.smoother import difference
from swath.georef.navigation.filter.strapdown import (
    GYRO_LEAN,
    HEIGHT_BIAS,
    LEVER_ARM,
    SLOW,
    SLOW_HEADING,
    SLOW_VELOCITY,
    STATE_SIZE,
    TIME_OFFSET,
    advance_part,
)
from swath.georef.navigation.inputs import GRADES, Kind, Setup
from swath.georef.records import FixType

pytestmark = pytest.mark.xdist_group("kernels")

SETUP = Setup(
    GRADES["mems"],
    np.array([[0.4, -0.2, -1.1], [1.0, 0.3, -0.9]]),
    np.array([0.9, 0.2, -0.1]),
    estimate_lever_arm=0.1,
    estimate_time_offset_s=0.1,
    gnss_correlated_share=0.4,
    gnss_velocity_share=0.3,
    gnss_heading_share=0.2,
)
LAYOUT = layout_of(SETUP, heights=True)
SENSORS = slice(MOVED, LAYOUT.core)
PLACES = {
    "equator": (0.0, 3.0),
    "mid-latitude": (0.82, 0.15),
    "antimeridian": (-0.6, np.pi),
    "near a pole": (1.57, 1.0),
}
STEPS = np.array([1.0, 0.1, 1e-4, 1e-4, 1e-2, 1e-3, 1e-3, 1e-3, 1e-3, 0.1, 1e-2, 0.5, 0.5, 0.5, 1.0])
OF_STATES = [3, 3, 3, 3, 3, 3, 3, 3, 3, 3, 1, 3, 3, 2, 1]
STEP = np.repeat(STEPS, OF_STATES)  # of each error


def state_at(lat: float, lon: float, rng: np.random.Generator) -> FloatArray:
    """Return a state in flight in which every error of a sensor and of the installation is non-zero."""
    x = np.zeros(STATE_SIZE)
    rot = rot_e_from_l(lat, lon)
    x[:3] = e_from_geodetic(lat, lon, 1200.0)
    x[3:6] = rot @ [45.0, -30.0, 2.0]
    x[6:10] = quaternion_from_rot(rot @ rot_l_from_b(0.3, -0.1, 2.2))
    x[10:22] = rng.standard_normal(12) * np.repeat([1e-3, 0.05, 2e-3, 2e-3], 3)
    x[GYRO_LEAN : GYRO_LEAN + LEANS] = 3e-4 * rng.standard_normal(LEANS)
    x[LEVER_ARM : LEVER_ARM + 3], x[TIME_OFFSET] = SETUP.lever_arms_b[0], 0.02
    x[SLOW : SLOW + 3], x[SLOW_VELOCITY : SLOW_VELOCITY + 3] = [0.3, -0.7, 1.1], [-0.4, 0.9, 0.2]
    x[SLOW_HEADING : SLOW_HEADING + 2], x[HEIGHT_BIAS] = [0.8, -0.5], 4.0
    return x


def moved(x: FloatArray, increments: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the state after samples of 5 ms, and the sums over them."""
    state, sums = x.copy(), np.zeros(LAYOUT.sums_size)
    for angle, push in increments:
        advance_part(state, sums, tuple(angle), tuple(push), 0.005)
    return state, sums


def off_by(x: FloatArray, error: FloatArray) -> FloatArray:
    state = x.copy()
    inject(state, error, LAYOUT)
    return state


@pytest.mark.parametrize("place", PLACES.values(), ids=PLACES.keys())
def test_the_transition_matrix_matches_difference_quotients_of_the_strapdown(place: tuple[float, float]) -> None:
    """Over a step of 0.1 s in a steep turn, they agree to 1e-3 of each block's largest element.

    Terms of second order in the step agree to a tenth, because the model takes the force as constant within the step.
    """
    rng = np.random.default_rng(3)
    x = state_at(*place, rng)
    rate = np.array([0.4, -0.2, 0.5]) + 0.1 * rng.standard_normal((20, 3))
    force = np.array([1.0, -2.0, -9.0]) + 0.5 * rng.standard_normal((20, 3))
    increments = 0.005 * np.stack([rate, force], axis=1)
    end, sums = moved(x, increments)
    top = np.empty((MOVED, LAYOUT.core))
    transition(sums, end, top)
    quotient, out = np.empty((MOVED, LAYOUT.core)), np.empty(9)
    for j in range(LAYOUT.core):
        error = np.zeros(LAYOUT.size)
        error[j] = STEP[j]
        difference(moved(off_by(x, error), increments)[0], moved(off_by(x, -error), increments)[0], out)
        quotient[:, j] = out / (2.0 * STEP[j])
    for row in range(0, MOVED, 3):
        for column in range(0, LAYOUT.core, 3):
            block = slice(row, row + 3), slice(column, column + 3)
            size = np.abs(quotient[block]).max()
            second_order = (row < 3 and column >= 6) or (row, column) in ((3, 9), (3, 15), (3, 21))
            allowed = (0.1 if second_order else 1e-3) * size + 1e-9
            np.testing.assert_allclose(top[block], quotient[block], rtol=0, atol=allowed, err_msg=f"{row}, {column}")


OBSERVED = {
    Kind.POSITION: ([0.3, 0.2, -0.4], [0.02, 0.03, 0.05]),
    Kind.VELOCITY: ([44.0, -29.0, 1.5], [0.05, 0.06, 0.07]),
    Kind.HEADING: ([2.3, 0.1, np.nan], [0.01, 0.02, 0.01]),
    Kind.ZERO_VELOCITY: ([0.0, 0.0, 0.0], [0.01, 0.01, 0.01]),
    Kind.NON_HOLONOMIC: ([0.0, 0.0, 0.0], [1.0, 0.1, 0.1]),
    Kind.HEIGHT: ([1190.0, np.nan, np.nan], [1.0, 1.0, 1.0]),
    Kind.ATTITUDE: ([0.31, -0.12, 2.1], [0.001, 0.002, 0.003]),
}


def innovation(x: FloatArray, sums: FloatArray, kind: Kind, antenna: int = 0) -> tuple[int, FloatArray, FloatArray]:
    value, sigma = (np.array(column) for column in OBSERVED[kind])
    if kind is Kind.POSITION:
        value = value + REFERENCE_E
    figures = np.concatenate([value, sigma, [0.3, -0.2, 0.1]])
    what = np.array([kind, FixType.RTK_FIXED, 12, antenna], np.uint8)
    nu, rows, noise = np.empty(3), np.empty((3, LAYOUT.size)), np.empty((3, 3))
    return predict(x, sums, rules_of(SETUP), LAYOUT, what, figures, nu, rows, noise), nu, rows


REFERENCE_E = e_from_geodetic(0.82, 0.15, 1200.0)


@pytest.mark.parametrize("antenna", [0, 1])
@pytest.mark.parametrize("kind", OBSERVED, ids=lambda kind: kind.name)
def test_derivatives_of_each_observation_match_difference_quotients(kind: Kind, antenna: int) -> None:
    """All errors are compared, including those of the installation and of the receiver."""
    rng = np.random.default_rng(5)
    x = state_at(*PLACES["mid-latitude"], rng)
    angle, push = np.array([2e-3, -1e-3, 2.5e-3]), np.array([0.005, -0.01, -0.046])

    def after(error: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the state after a step in which an error of the gyroscopes changes the rate.

        Their effect within the time offset is left out.
        """
        state, sums = off_by(x, error), np.zeros(LAYOUT.sums_size)
        if error[SENSORS].any():
            state[TIME_OFFSET] = 0.0
        clean = state.copy()
        advance_part(state, sums, tuple(angle), tuple(push), 0.005)
        return clean, sums

    m, _, rows = innovation(*after(np.zeros(LAYOUT.size)), kind, antenna)
    assert m == {Kind.HEADING: 2, Kind.NON_HOLONOMIC: 2, Kind.HEIGHT: 1}.get(kind, 3)
    for j in range(LAYOUT.size):
        error = np.zeros(LAYOUT.size)
        error[j] = STEP[j]
        ahead, behind = innovation(*after(error), kind, antenna)[1], innovation(*after(-error), kind, antenna)[1]
        quotient = -(ahead - behind)[:m] / (2.0 * STEP[j])
        allowed = 1e-3 * np.abs(quotient).max() + TURNING
        np.testing.assert_allclose(rows[:m, j], quotient, rtol=0, atol=allowed, err_msg=f"{j}")


TURNING = 1e-4  # north and east turn with the position, the lever arm with the earth


def test_covariance_propagation_matches_dense_matrices() -> None:
    """The reference is Φ P Φᵀ with dense matrices; Φ of two steps must be the product of the two."""
    rng = np.random.default_rng(1)
    n, core = LAYOUT.size, LAYOUT.core
    drive = Drive(1e-6, 1e-4, rng.random(n), np.where(np.arange(n) >= MOVED, 50.0, np.inf))
    decay, work = np.empty(n), np.empty((MOVED, n))
    decays(drive, 3.0, decay)
    np.testing.assert_allclose(decay[MOVED:], np.exp(-3.0 / 50.0))
    root = rng.standard_normal((n, n))
    p = root @ root.T
    total, total_decay, whole = np.empty((MOVED, core)), np.empty(n), np.eye(n)
    begin_accumulation(total, total_decay)
    expected = p.copy()
    for _ in range(2):
        top = rng.standard_normal((MOVED, core))
        dense = np.diag(decay)
        dense[:MOVED, :core] = top
        expected, whole = dense @ expected @ dense.T, dense @ whole
        propagate(p, top, decay, work)
        accumulate(total, total_decay, top, decay, work)
    np.testing.assert_allclose(p, expected, rtol=1e-10)
    np.testing.assert_allclose(total, whole[:MOVED, :core], rtol=1e-10)
    np.testing.assert_allclose(np.diag(total_decay)[MOVED:, MOVED:], whole[MOVED:, MOVED:], rtol=1e-12)


def test_process_noise_matches_the_covariance_of_sampled_random_walks() -> None:
    """The reference is the covariance of 20 000 draws of white rates and forces over 0.5 s of constant specific force.

    They agree to 3 %.
    """
    rng = np.random.default_rng(8)
    sums = np.zeros(LAYOUT.sums_size)
    force, span_s, steps = np.array([3.0, -1.0, -9.0]), 0.5, 100
    sums[18:27] = np.diag(force * span_s).ravel()
    sums[27] = span_s
    drive = Drive(4e-4, 1e-2, np.zeros(CORE), np.full(CORE, np.inf))
    p = np.zeros((CORE, CORE))
    add_noise(p, sums, drive, np.ones(CORE), np.zeros((6, 3)))
    np.testing.assert_array_equal(p, p.T)
    dt = span_s / steps
    turn = np.cumsum(rng.standard_normal((20_000, steps, 3)) * np.sqrt(drive.angle * dt), axis=1)
    push = rng.standard_normal((20_000, steps, 3)) * np.sqrt(drive.velocity * dt)
    velocity = np.cumsum(np.cross(turn, force) * dt + push, axis=1)
    drawn = np.concatenate([velocity.sum(axis=1) * dt, velocity[:, -1], turn[:, -1]], axis=1)
    found = np.cov(drawn.T)
    scale = np.sqrt(np.outer(np.diag(found), np.diag(found)))
    inside = np.ix_(range(3, 9), range(3, 9))
    np.testing.assert_allclose((p[:9, :9] / scale)[inside], (found / scale)[inside], atol=0.03)
