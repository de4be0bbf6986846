"""Makes a navigated flight from the reference flight's truth and errors of known size."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swath.daemon.processing.trajectory.series import Flight
from swath.georef.geodesy.earth import e_from_geodetic, rot_e_from_l
from swath.georef.geodesy.rotations import quaternion_from_rot, rot_l_from_b
from swath.georef.navigation.inputs import GRADES, INNOVATION_DTYPE, Fate, Kind, Setup, Solution
from swath.georef.records import FixType
from swath.georef.timescales.gps_time import SECOND_NS
from tests.georef.navigation.vehicles import flight_arrays

Array = NDArray[Any]
WEEK, WEEK_S = 2376, 604_800
GNSS_SIGMA_M = np.array([0.01, 0.01, 0.02])
VELOCITY_SIGMA_MPS = np.array([0.02, 0.02, 0.04])
FILTER_SIGMA = np.array([0.008, 0.007, 0.011]), np.array([0.01, 0.01, 0.012]), np.radians([0.004, 0.004, 0.009])
SMOOTHER_SIGMA = np.array([0.003, 0.003, 0.005]), np.array([0.004, 0.004, 0.005]), np.radians([0.002, 0.002, 0.004])


def reference_truth() -> Array:
    """Return rows of the survey flight's truth."""
    truth: Array = flight_arrays("tactical")["truth"]
    return truth


def solution(sigmas: Any, errors: tuple[Array, ...], truth: Array, innovations: Array) -> Solution:
    """Return the truth with errors (n, 3) of position (north, east, down; m), velocity (m/s) and attitude (rad)."""
    t, lat_deg, lon_deg, height_m = truth[:, 1:5].T
    time_ns = WEEK * WEEK_S * SECOND_NS + np.rint(t * 1e3).astype(np.int64) * 1_000_000
    lat, lon = np.radians(lat_deg), np.radians(lon_deg)
    to_e = rot_e_from_l(lat, lon)
    turn = to_e @ rot_l_from_b(*(np.radians(truth[:, 8:11]) + errors[2]).T)
    n, nodes = len(t), slice(None, None, 20)
    count = len(time_ns[nodes])
    place, speed, angle = (np.broadcast_to(sigma, (n, 3)).copy() for sigma in sigmas)
    none, bias = np.zeros((count, 3)), GRADES["tactical"]
    return Solution(
        time_ns=time_ns,
        position_e=e_from_geodetic(lat, lon, height_m) + np.einsum("nij,nj->ni", to_e, errors[0]),
        velocity_e=np.einsum("nij,nj->ni", to_e, truth[:, 5:8] + errors[1]),
        q_e_from_b=quaternion_from_rot(turn),
        position_sigma_l=place,
        velocity_sigma_l=speed,
        attitude_sigma_rad=angle,
        bridged=np.zeros(n, bool),
        node_time_ns=time_ns[nodes],
        gyro_bias=none + bias.gyro_bias * np.array([0.5, -0.8, 1.1]),
        accel_bias=none + bias.accel_bias * np.array([0.2, 0.4, -0.6]),
        gyro_scale=none + bias.gyro_scale * np.array([-0.5, 0.3, 1.2]),
        accel_scale=none + bias.accel_scale * np.array([0.1, -1.1, 0.4]),
        gyro_bias_sigma=none + bias.gyro_bias * np.geomspace(1.0, 0.1, count)[:, np.newaxis],
        accel_bias_sigma=none + bias.accel_bias * np.geomspace(1.0, 0.2, count)[:, np.newaxis],
        gyro_scale_sigma=none + bias.gyro_scale * np.geomspace(1.0, 0.2, count)[:, np.newaxis],
        accel_scale_sigma=none + bias.accel_scale * np.geomspace(1.0, 0.4, count)[:, np.newaxis],
        gyro_misalignment=none + bias.misalignment * np.array([0.2, -0.9, 0.4]),
        accel_misalignment=none + bias.misalignment * np.array([0.1, 0.5, -1.3]),
        gyro_misalignment_sigma=none + bias.misalignment * np.geomspace(1.0, 0.3, count)[:, np.newaxis],
        accel_misalignment_sigma=none + bias.misalignment * np.geomspace(1.0, 0.5, count)[:, np.newaxis],
        lever_arm_b=none + np.array([0.35, -0.12, -1.1]),
        lever_arm_sigma=none.copy(),
        time_offset_s=np.zeros(count),
        time_offset_sigma_s=np.zeros(count),
        innovations=innovations,
        counts=Counter(positions=len(innovations) // 2),
    )


def innovations_of(truth: Array, random: np.random.Generator) -> Array:
    """Return a position and a velocity innovation each second, white and as large as predicted."""
    seconds = np.arange(np.ceil(truth[0, 1]), truth[-1, 1])
    rows = np.zeros(2 * len(seconds), INNOVATION_DTYPE)
    base_ns = WEEK * WEEK_S * SECOND_NS
    for part, kind, sigma in ((0, Kind.POSITION, GNSS_SIGMA_M), (1, Kind.VELOCITY, VELOCITY_SIGMA_MPS)):
        mine = rows[part::2]
        mine["time_ns"] = base_ns + seconds.astype(np.int64) * SECOND_NS
        mine["kind"], mine["fate"], mine["fix_type"] = kind, Fate.TAKEN, FixType.RTK_FIXED
        mine["satellites"], mine["dimension"], mine["inflation"] = 14, 3, 1.0
        mine["normalised"] = random.standard_normal((len(seconds), 3))
        mine["sigma"] = sigma
        mine["value"] = mine["normalised"] * sigma
        mine["chi2"] = (mine["normalised"] ** 2).sum(axis=1)
    return rows


def sound_flight(seed: int = 1, every: int = 4) -> Flight:
    """Return a sound flight of 30 min with epochs at 20 Hz / every."""
    random = np.random.default_rng(seed)
    truth = reference_truth()[::every]
    rows = innovations_of(truth, random)
    n = len(truth)
    own = tuple(sigma * random.standard_normal((n, 3)) for sigma in SMOOTHER_SIGMA)
    apart = [
        np.sqrt(filtered**2 - smoothed**2) * random.standard_normal((n, 3))
        for filtered, smoothed in zip(FILTER_SIGMA, SMOOTHER_SIGMA, strict=True)
    ]
    other = tuple(a + b for a, b in zip(own, apart, strict=True))
    return Flight(
        title="thurgau-north",
        forward=solution(FILTER_SIGMA, other, truth, rows),
        smoothed=solution(SMOOTHER_SIGMA, own, truth, rows),
        setup=Setup(GRADES["tactical"], lever_arms_b=np.array([[0.35, -0.12, -1.1]])),
        start="static alignment over 140 s: heading to 0.4°",
    )


def with_rows(flight: Flight, rows: Array) -> Flight:
    """Return the flight with other innovations."""
    smoothed = None if flight.smoothed is None else replace(flight.smoothed, innovations=rows)
    return replace(flight, forward=replace(flight.forward, innovations=rows), smoothed=smoothed)
