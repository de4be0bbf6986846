"""Provides inertial samples and observations with known truth: reference flights, recordings, exact motions."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation

from swath.georef.arrays import FloatArray, Int64Array, StructArray
from swath.georef.geodesy.earth import e_from_geodetic, geodetic_from_e, rot_e_from_l
from swath.georef.geodesy.quaternions import rotation_vector
from swath.georef.geodesy.rotations import quaternion_from_rot, rot_l_from_b
from swath.georef.navigation.inputs import (
    OBSERVATION_DTYPE,
    ImuNoise,
    Inertial,
    Kind,
    Setup,
    Start,
    imu_noise,
    sort_observations,
)
from swath.georef.records import FixType
from swath.sim.flight.trajectory import Trajectory
from swath.sim.imu.sensors import error_matrix, true_increments

FIXTURES = Path(__file__).parents[3] / "fixtures"
NAVIGATION = FIXTURES / "navigation"
BEGIN_NS = 2300 * 604_800 * 10**9


def ns(t: FloatArray | float) -> Int64Array:
    """Return GPS time, ns, of seconds in the recording's week."""
    return BEGIN_NS + np.rint(np.asarray(t) * 1e9).astype(np.int64)


def observed(kind: Kind, t: FloatArray, value: FloatArray, sigma: FloatArray, fix: FixType) -> StructArray:
    rows = np.zeros(len(t), OBSERVATION_DTYPE)
    rows["time_ns"], rows["kind"], rows["fix_type"] = ns(t), kind, fix
    rows["value"], rows["sigma"] = value, sigma
    return rows


@dataclass(frozen=True, eq=False)
class Recording:
    """A recording: what a filter receives, and the vehicle's true motion.

    Attributes:
        truth: maps times (n,) to rot_l_from_b (n, 3, 3), velocity_l (n, 3), position_e (n, 3); None if unknown.
    """

    inertial: Inertial
    rows: StructArray
    setup: Setup
    truth: Callable[[FloatArray], tuple[FloatArray, FloatArray, FloatArray]] | None = None

    def cut(self, begin: float, end: float) -> Recording:
        """Return the part between two times."""
        edges = ns(np.array([begin, end]))
        first, last = np.searchsorted(self.inertial.time_ns, edges).tolist()
        rows = self.rows[(self.rows["time_ns"] >= edges[0]) & (self.rows["time_ns"] < edges[1])]
        return Recording(self.inertial.between(first, last), rows, self.setup, self.truth)

    def only(self, *kinds: Kind) -> StructArray:
        """Keep the observations of some kinds."""
        kept: StructArray = self.rows[np.isin(self.rows["kind"], kinds)]
        return kept


@cache
def flight_arrays(name: str) -> dict[str, NDArray[Any]]:
    """Return the arrays of the survey flight with a "tactical" or "mems" unit, from planes of bytes (see SOURCE.md)."""
    kinds = {"imu_dtheta": np.float32, "imu_dv": np.float32}
    found = {}
    with np.load(NAVIGATION / f"reference_flight/{name}.npz") as planes:
        for key in planes.files:
            rows = np.ascontiguousarray(planes[key].T).view(kinds.get(key, np.float64))
            found[key] = rows[:, 0] if rows.shape[1] == 1 else rows
    return found


@cache
def reference(name: str) -> Recording:
    """Return the survey flight with a "tactical" or "mems" unit."""
    data, about = flight_arrays(name), json.loads((NAVIGATION / f"reference_flight/{name}.json").read_text())
    time_ns = ns(data["imu_t"])
    interval_s = np.diff(time_ns, prepend=time_ns[0] - 5_000_000) / 1e9
    fixes, speeds, truth = data["gnss"], data["gnss_velocity"], data["truth"]
    position_e = e_from_geodetic(np.radians(fixes[:, 1]), np.radians(fixes[:, 2]), fixes[:, 3])
    rows = np.concatenate(
        [
            observed(Kind.POSITION, fixes[:, 0], position_e, fixes[:, 4:7], FixType.RTK_FIXED),
            observed(Kind.VELOCITY, speeds[:, 0], speeds[:, 1:4], speeds[:, 4:7], FixType.RTK_FIXED),
        ]
    )
    angles = np.unwrap(np.radians(truth[:, 8:11]), axis=0)

    def true(t: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        columns = np.column_stack([truth[:, 2:8], angles])
        at = np.stack([np.interp(t, truth[:, 1], column) for column in columns.T])
        place = e_from_geodetic(np.radians(at[0]), np.radians(at[1]), at[2])
        return rot_l_from_b(at[6], at[7], at[8]), at[3:6].T, place

    angle_b, velocity_b = (data[name].astype(np.float64) for name in ("imu_dtheta", "imu_dv"))
    samples = Inertial(time_ns, interval_s, angle_b, velocity_b, np.zeros(len(time_ns), np.bool_))
    setup = Setup(_spec(about["spec"]), np.array([about["lever_FRD"]]))
    return Recording(samples, sort_observations(rows), setup, true)


@cache
def car() -> Recording:
    """Return a real drive of a car, whose true attitude is unknown."""
    folder = NAVIGATION / "gnss_imu_drive"
    imu, fixes, speeds = (np.loadtxt(folder / f"{name}.txt.xz") for name in ("imu", "gnss", "gnssvel"))
    about = json.loads((folder / "meta.json").read_text())
    time_ns = ns(imu[:, 0])
    interval_s = np.diff(time_ns, prepend=time_ns[0] - 10_000_000) / 1e9
    position_e = e_from_geodetic(np.radians(fixes[:, 1]), np.radians(fixes[:, 2]), fixes[:, 3])
    rows = np.concatenate(
        [
            observed(Kind.POSITION, fixes[:, 0], position_e, fixes[:, 4:7], FixType.RTK_FIXED),
            observed(Kind.VELOCITY, speeds[:, 0], speeds[:, 1:4], speeds[:, 4:7], FixType.RTK_FIXED),
        ]
    )
    samples = Inertial(time_ns, interval_s, imu[:, 1:4], imu[:, 4:7], np.zeros(len(imu), np.bool_))
    setup = Setup(_spec(about["spec"]), np.array([about["lever_FRD"]]))
    return Recording(samples, sort_observations(rows), setup)


@cache
def uav() -> Recording:
    """Return a real flight of a small aeroplane with single-frequency GPS; its own filter gives the true attitude."""
    from scipy.io import loadmat

    path = NAVIGATION / "umn_thor75/thor75.mat"
    data = loadmat(path, squeeze_me=True, struct_as_record=False)["flight_data"]
    new = np.flatnonzero(np.diff(data.GPS_TOW) != 0) + 1
    new = new[np.abs(data.lat[new]) > 1.0]
    position_e = e_from_geodetic(np.radians(data.lat[new]), np.radians(data.lon[new]), data.alt[new])
    velocity_l = np.stack([data.vn, data.ve, data.vd], axis=-1)[new]
    rows = np.concatenate(
        [
            observed(Kind.POSITION, data.time[new], position_e, np.array([2.0, 2.0, 4.0]), FixType.SINGLE),
            observed(Kind.VELOCITY, data.time[new], velocity_l, np.array([0.15, 0.15, 0.3]), FixType.SINGLE),
        ]
    )
    time_ns = ns(data.time)
    interval_s = np.diff(time_ns, prepend=time_ns[0] - 20_000_000) / 1e9
    rate = np.stack([data.p, data.q, data.r], axis=-1) * interval_s[:, None]
    force = np.stack([data.ax, data.ay, data.az], axis=-1) * interval_s[:, None]
    angles = np.unwrap(np.stack([data.phi, data.theta, data.psi]), axis=1)

    def true(t: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        at = np.stack([np.interp(t, data.time, angle) for angle in angles])
        return rot_l_from_b(*at), np.full((len(t), 3), np.nan), np.full((len(t), 3), np.nan)

    samples = Inertial(time_ns, interval_s, rate, force, np.zeros(len(time_ns), np.bool_))
    noise = imu_noise(0.5, 0.2, 200.0, 10.0, 1.0, 2000.0, 2000.0)
    return Recording(samples, sort_observations(rows), Setup(noise), true)


def _spec(said: dict[str, float]) -> ImuNoise:
    bias_mg = said["abstd"] * 1e-5 / 9.80665e-3
    return imu_noise(said["arw"], said["vrw"], said["gbstd"], bias_mg, said["corrtime"], said["gsstd"], said["asstd"])


@dataclass(frozen=True)
class Motion:
    """The motion of a made-up vehicle: functions of time (n,) in a plane at a place; angles in rad.

    Attributes:
        place: latitude, longitude rad, height m.
        north_east_down_m: maps times to (n, 3), metres from the place.
        attitude: maps times to roll, pitch, heading (n, 3) relative to the plane's north, east, down.
    """

    place: tuple[float, float, float]
    north_east_down_m: Callable[[FloatArray], FloatArray]
    attitude: Callable[[FloatArray], FloatArray]


def made(
    motion: Motion,
    seconds: float,
    noise: ImuNoise,
    seed: int,
    *,
    lever_arm_b: FloatArray,
    baseline_b: FloatArray | None = None,
    sigma: tuple[float, float] = (0.02, 0.02),
    rate_hz: float = 100.0,
) -> Recording:
    """Return samples of a unit with the given noise, biases and scale factors, and an antenna's fixes once a second."""
    rng = np.random.default_rng(seed)
    lat, lon, height = motion.place
    origin_e, rot = e_from_geodetic(lat, lon, height), rot_e_from_l(lat, lon)
    knots = np.arange(-2.0, seconds + 2.0, 0.05)
    attitude = Rotation.from_matrix(rot @ rot_l_from_b(*motion.attitude(knots).T)).as_quat()
    attitude[1:] *= np.cumprod(np.sign((attitude[1:] * attitude[:-1]).sum(axis=1)))[:, None]
    values = np.column_stack([motion.north_east_down_m(knots) @ rot.T, attitude])
    flight = Trajectory(make_interp_spline(knots, values, 5), origin_e, (), seconds)
    edges = np.arange(round(seconds * rate_hz) + 1) / rate_hz
    exact = true_increments(flight, edges)
    interval_s, samples = 1.0 / rate_hz, len(edges) - 1
    walk = rng.standard_normal((2, samples, 3)) * np.sqrt(interval_s)
    bias, scale = rng.standard_normal((2, 2, 3))
    lean = noise.misalignment * np.random.default_rng([seed, 5]).standard_normal((2, 3))
    angle = exact.angle_b @ error_matrix(noise.gyro_scale * scale[0], lean[0]) + noise.gyro_bias * bias[0] * interval_s
    push = exact.velocity_b @ error_matrix(noise.accel_scale * scale[1], lean[1])
    push += noise.accel_bias * bias[1] * interval_s
    inertial = Inertial(
        ns(edges[1:]),
        np.full(samples, interval_s),
        angle + noise.angle_random_walk * walk[0],
        push + noise.velocity_random_walk * walk[1],
        np.zeros(samples, np.bool_),
    )
    t = np.arange(0.5, seconds, 1.0)
    truth = flight.motion(t)
    swing = np.cross(truth.rate_eb_b, lever_arm_b)
    antenna_e = truth.position_e + truth.rot_e_from_b @ lever_arm_b
    speed_e = truth.velocity_e + np.einsum("nij,nj->ni", truth.rot_e_from_b, swing)
    here = rot_e_from_l(*geodetic_from_e(antenna_e)[:2])
    noisy_e = antenna_e + np.einsum("nij,nj->ni", here, sigma[0] * rng.standard_normal((len(t), 3)))
    speed_l = np.einsum("nji,nj->ni", here, speed_e) + sigma[1] * rng.standard_normal((len(t), 3))
    rows = [
        observed(Kind.POSITION, t, noisy_e, np.full(3, sigma[0]), FixType.RTK_FIXED),
        observed(Kind.VELOCITY, t, speed_l, np.full(3, sigma[1]), FixType.RTK_FIXED),
    ]
    if baseline_b is not None:
        ahead = np.einsum("nji,njk,k->ni", here, truth.rot_e_from_b, baseline_b)
        said = np.zeros((len(t), 3))
        said[:, 0] = np.arctan2(ahead[:, 1], ahead[:, 0]) % (2.0 * np.pi)
        said[:, 1] = -np.arctan2(ahead[:, 2], np.hypot(ahead[:, 0], ahead[:, 1]))
        said[:, :2] += 0.005 * rng.standard_normal((len(t), 2))
        rows.append(observed(Kind.HEADING, t, said, np.full(3, 0.005), FixType.RTK_FIXED))

    def true(at: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        moved = flight.motion(at)
        level = rot_e_from_l(*geodetic_from_e(moved.position_e)[:2])
        back = np.swapaxes(level, 1, 2)
        return back @ moved.rot_e_from_b, np.einsum("nij,nj->ni", back, moved.velocity_e), moved.position_e

    setup = Setup(noise, lever_arm_b[None], baseline_b)
    return Recording(inertial, sort_observations(np.concatenate(rows)), setup, true)


def normalised(recording: Recording, start: Start) -> FloatArray:
    """Return (9,) true − found attitude, velocity and position of a start, divided by its sigmas."""
    assert recording.truth is not None
    rot, velocity, place = (value[0] for value in recording.truth(np.array([(start.time_ns - BEGIN_NS) / 1e9])))
    turn = rotation_vector(quaternion_from_rot(rot @ rot_l_from_b(*start.attitude_rad).T))
    off_l = rot_e_from_l(*geodetic_from_e(place)[:2]).T @ (place - start.position_e)
    errors = (turn, velocity - start.velocity_l, off_l)
    sigmas = (start.attitude_sigma_rad, start.velocity_sigma_l, start.position_sigma_l)
    return np.concatenate([error / sigma for error, sigma in zip(errors, sigmas, strict=True)])
