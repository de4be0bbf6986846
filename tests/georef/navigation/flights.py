"""Makes one truth with many noises: increments of the simulated inertial unit, and a filter's start."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from swath.georef.arrays import FloatArray, StructArray
from swath.georef.geodesy.earth import e_from_geodetic, geodetic_from_e, rot_e_from_l
from swath.georef.geodesy.rotations import attitude_of, rot_from_quaternion, rot_l_from_b
from swath.georef.navigation.inputs import ImuNoise, Inertial, Kind, Setup, Start
from swath.georef.records import FixType
from swath.sim.flight.trajectory import Trajectory
from swath.sim.imu.sensors import error_matrix, true_increments
from tests.georef.navigation.vehicles import Motion, ns, observed

PLACE = (np.radians(47.0), np.radians(8.0), 900.0)
BASELINE_B = np.array([2.0, 0.0, 0.0])


def survey(speed_mps: float = 60.0, line_s: float = 40.0) -> Motion:
    """Return a motion along lines there and back with turns, with small movements in roll and pitch as in air."""

    def heading(t: FloatArray) -> FloatArray:
        phase = t / line_s
        turned: FloatArray = np.pi * (np.floor(phase) + _step((phase % 1.0 - 0.6) / 0.4)) + 0.02 * np.sin(0.4 * t)
        return turned

    grid = np.linspace(-5.0, 2000.0, 40_101)
    course = heading(grid)
    way = np.cumsum(speed_mps * np.stack([np.cos(course), np.sin(course)]), axis=1).T * 0.05

    def north_east_down_m(t: FloatArray) -> FloatArray:
        place = np.stack([np.interp(t, grid, column) for column in way.T], axis=1)
        return np.column_stack([place, 2.0 * np.sin(0.3 * t) - 5.0 * np.sin(0.05 * t)])

    def attitude(t: FloatArray) -> FloatArray:
        rate = (heading(t + 0.05) - heading(t - 0.05)) / 0.1
        roll = np.arctan(rate * speed_mps / 9.8) + 0.02 * np.sin(1.1 * t)
        return np.column_stack([roll, 0.03 + 0.015 * np.sin(0.7 * t), heading(t)])

    return Motion(PLACE, north_east_down_m, attitude)


def _step(x: FloatArray) -> FloatArray:
    """Return 0 to 1 on 0 … 1, a smooth step with four derivatives zero at either end."""
    x = np.clip(x, 0.0, 1.0)
    return x**5 * (126.0 - 420.0 * x + 540.0 * x**2 - 315.0 * x**3 + 70.0 * x**4)


@dataclass(frozen=True, eq=False)
class Truth:
    """True motion of a flight of n samples.

    Attributes:
        edges: (n + 1,) s; angle_b, velocity_b: (n, 3) exact increments.
        flight: the simulator's trajectory.
    """

    edges: FloatArray
    angle_b: FloatArray
    velocity_b: FloatArray
    flight: Trajectory

    def inertial(self) -> Inertial:
        """Return the samples of a perfect unit."""
        return Inertial(
            ns(self.edges[1:]), np.diff(self.edges), self.angle_b, self.velocity_b, np.zeros(len(self.angle_b), bool)
        )


def fly(motion: Motion, seconds: float, rate_hz: float) -> Truth:
    """Return the motion as a spline, with its exact increments."""
    lat, lon, height = motion.place
    origin_e, rot = e_from_geodetic(lat, lon, height), rot_e_from_l(lat, lon)
    knots = np.arange(-2.0, seconds + 2.0, 0.05)
    attitude = Rotation.from_matrix(rot @ rot_l_from_b(*motion.attitude(knots).T)).as_quat()
    attitude[1:] *= np.cumprod(np.sign((attitude[1:] * attitude[:-1]).sum(axis=1)))[:, None]
    values = np.column_stack([motion.north_east_down_m(knots) @ rot.T, attitude])
    flight = Trajectory(make_interp_spline(knots, values, 5), origin_e, (), seconds)
    edges = np.arange(round(seconds * rate_hz) + 1) / rate_hz
    exact = true_increments(flight, edges)
    return Truth(edges, exact.angle_b, exact.velocity_b, flight)


@dataclass(frozen=True)
class Fixes:
    """Errors of the simulated GNSS: sigmas of position, velocity and heading, and their correlated parts.

    A share is the part of a variance whose errors last; it has a correlation time. The pitch of the baseline, which is
    `BASELINE_B`, forward, errs twice as much as the heading. A heading sigma of 0 means that there is no second
    antenna.
    """

    sigma_m: tuple[float, float, float] = (0.01, 0.01, 0.02)
    share: float = 0.0
    tau_s: float = 60.0
    rate_hz: float = 1.0
    velocity_mps: float = 0.0
    first_s: float = 0.3217
    velocity_share: float = 0.0
    velocity_tau_s: float = 2.0
    heading_rad: float = 0.0
    heading_share: float = 0.0
    heading_tau_s: float = 60.0


def markov(rng: np.random.Generator, steps: int, columns: int, step_s: float, tau_s: float) -> FloatArray:
    """Return (steps, columns) of Gauss–Markov processes of sigma 1."""
    kept = np.exp(-step_s / tau_s)
    drive = rng.standard_normal((steps, columns)) * np.sqrt(1.0 - kept**2)
    drive[0] = rng.standard_normal(columns)
    walked: FloatArray = lfilter([1.0], [1.0, -kept], drive, axis=0)
    return walked


def noised(
    truth: Truth, noise: ImuNoise, fixes: Fixes, lever_arm_b: FloatArray, seed: int
) -> tuple[Inertial, StructArray]:
    """Return samples and fixes with errors.

    Samples have random walks, drifting biases, scale factors and misaligned axes; fixes have white and lasting errors.
    """
    rng = np.random.default_rng(seed)
    span_s, n = float(truth.edges[1]), len(truth.angle_b)
    biases = markov(rng, n, 6, span_s, noise.bias_correlation_s)
    scale = rng.standard_normal((2, 3))
    lean = noise.misalignment * np.random.default_rng([seed, 5]).standard_normal((2, 3))
    walk = rng.standard_normal((2, n, 3)) * np.sqrt(span_s)
    angle = truth.angle_b @ error_matrix(noise.gyro_scale * scale[0], lean[0])
    push = truth.velocity_b @ error_matrix(noise.accel_scale * scale[1], lean[1])
    angle += noise.gyro_bias * biases[:, :3] * span_s
    push += noise.accel_bias * biases[:, 3:] * span_s
    inertial = Inertial(
        ns(truth.edges[1:]),
        np.full(n, span_s),
        angle + noise.angle_random_walk * walk[0],
        push + noise.velocity_random_walk * walk[1],
        np.zeros(n, np.bool_),
    )
    t = np.arange(fixes.first_s, truth.edges[-1], 1.0 / fixes.rate_hz)
    at = truth.flight.motion(t)
    here = rot_e_from_l(*geodetic_from_e(at.position_e)[:2])
    lasting = markov(rng, len(t), 3, 1.0 / fixes.rate_hz, fixes.tau_s)
    error = np.sqrt(fixes.share) * lasting + np.sqrt(1.0 - fixes.share) * rng.standard_normal((len(t), 3))
    place = at.position_e + at.rot_e_from_b @ lever_arm_b + np.einsum("nij,nj->ni", here, error * fixes.sigma_m)
    rows = observed(Kind.POSITION, t, place, np.array(fixes.sigma_m), FixType.RTK_FIXED)
    if fixes.velocity_mps:
        swing = np.einsum("nij,nj->ni", at.rot_e_from_b, np.cross(at.rate_eb_b, lever_arm_b))
        speed = np.einsum("nji,nj->ni", here, at.velocity_e + swing)
        error = np.sqrt(1.0 - fixes.velocity_share) * rng.standard_normal(speed.shape)
        if fixes.velocity_share:
            lasting = markov(rng, len(t), 3, 1.0 / fixes.rate_hz, fixes.velocity_tau_s)
            error += np.sqrt(fixes.velocity_share) * lasting
        speed = speed + fixes.velocity_mps * error
        sigma = np.full(3, fixes.velocity_mps)
        rows = np.concatenate([rows, observed(Kind.VELOCITY, t, speed, sigma, FixType.RTK_FIXED)])
    if fixes.heading_rad:
        line = np.einsum("nji,nj->ni", here, at.rot_e_from_b @ BASELINE_B)
        rows = np.concatenate([rows, _directions(t, line, fixes, np.random.default_rng([seed, 7]))])
    return inertial, rows


def _directions(t: FloatArray, line_l: FloatArray, fixes: Fixes, rng: np.random.Generator) -> StructArray:
    """Return rows of headings and pitches of a baseline (n, 3), north, east, down, with errors."""
    sigma = fixes.heading_rad * np.array([1.0, 2.0])
    lasting = markov(rng, len(t), 2, 1.0 / fixes.rate_hz, fixes.heading_tau_s)
    error = np.sqrt(fixes.heading_share) * lasting + np.sqrt(1.0 - fixes.heading_share) * rng.standard_normal(
        (len(t), 2)
    )
    north, east, down = line_l.T
    angles = np.stack([np.arctan2(east, north), -np.arctan2(down, np.hypot(north, east))], axis=1) + sigma * error
    unsaid = np.full(len(t), np.nan)
    return observed(Kind.HEADING, t, np.column_stack([angles, unsaid]), np.append(sigma, np.nan), FixType.RTK_FIXED)


def drawn_start(
    truth: Truth, seed: int, *, position_m: float = 0.05, velocity_mps: float = 0.05,
    attitude_rad: tuple[float, float, float] = (1e-3, 1e-3, 5e-3), at_s: float = 0.0,
) -> Start:  # fmt: skip
    """Return a filter start with errors drawn from its sigmas."""
    rng = np.random.default_rng(seed + 1_000_000)
    at = truth.flight.motion(np.array([at_s]))
    rot = rot_e_from_l(*(angle[0] for angle in geodetic_from_e(at.position_e)[:2]))
    angles = np.array(attitude_of(rot.T @ at.rot_e_from_b[0]))
    off = rng.standard_normal((3, 3))
    return Start(
        int(ns(at_s)),
        at.position_e[0] + position_m * off[0],
        rot.T @ at.velocity_e[0] + velocity_mps * off[1],
        angles + np.array(attitude_rad) * off[2],
        np.full(3, position_m),
        np.full(3, velocity_mps),
        np.array(attitude_rad),
    )


def errors(truth: Truth, t: FloatArray, position_e: FloatArray, velocity_e: FloatArray, q: FloatArray) -> FloatArray:
    """Return (n, 9) found − true position (m), velocity (m/s) north, east, down and roll, pitch, heading (rad)."""
    at = truth.flight.motion(t)
    level = rot_e_from_l(*geodetic_from_e(at.position_e)[:2])
    off = np.einsum("nji,nj->ni", level, position_e - at.position_e)
    faster = np.einsum("nji,nj->ni", level, velocity_e - at.velocity_e)
    back = np.swapaxes(level, 1, 2)
    found, true = attitude_of(back @ rot_from_quaternion(q)), attitude_of(back @ at.rot_e_from_b)
    turned = np.stack(found, axis=1) - np.stack(true, axis=1)
    return np.concatenate([off, faster, (turned + np.pi) % (2.0 * np.pi) - np.pi], axis=1)


def setup_for(noise: ImuNoise, lever_arm_b: FloatArray) -> Setup:
    """Return a filter setup that knows the unit's noise and one lever arm (3,), m, in b."""
    return Setup(noise, lever_arm_b[None])
