"""Move a start back to an earlier time: the attitude by the gyroscopes, position and velocity by GNSS at that time.

Alignment knows the start only at the end of the motion that determined it; a flight that is processed afterwards need
not lose the time before. Gyroscopes alone carry the attitude back (Savage 1998, attitude by products of rotation
vectors).
"""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

import numpy as np

from swath.georef.arrays import FloatArray, StructArray
from swath.georef.geodesy.earth import geodetic_from_e, rot_e_from_l
from swath.georef.geodesy.quaternions import product
from swath.georef.geodesy.rotations import attitude_of, rot_from_quaternion, rot_l_from_b, rot_z
from swath.georef.navigation.inputs import ImuNoise, Inertial, Kind, Setup, Start
from swath.georef.timescales import SECOND_NS
from swath.georef.trajectory.trajectory import EARTH_RATE_RADPS

StartT = TypeVar("StartT", bound=Start)

MOST_DRIFT_RAD = float(np.radians(2.0))  # greatest drift of the attitude on its way back
NEAR_NS = SECOND_NS // 2  # greatest time between a position and the velocity used with it
APART_NS = SECOND_NS  # minimum time between two positions that give a velocity where none is observed
ACCELERATION_MPS2 = 3.0  # assumed acceleration of an aircraft between them
CAREFUL = 3.0  # factor on the observations' sigmas, because the filter uses them again
RATE_NS = SECOND_NS // 10  # time over which the turn rate for the lever arm is taken


def drift_rad(noise: ImuNoise, seconds: float) -> float:
    """Return the standard deviation of the gyroscopes' drift over a time, per axis."""
    return float(np.hypot(noise.gyro_bias * seconds, noise.angle_random_walk * np.sqrt(seconds)))


def earlier_start(inertial: Inertial, observations: StructArray, setup: Setup, start: StartT) -> StartT:
    """Return the start at the earliest position that the gyroscopes reach back to, or the given start if none is.

    Args:
        inertial: samples without gaps.
        observations: `OBSERVATION_DTYPE`, by time.
        setup: lever arms and noise.
        start: the start from alignment.
    """
    if not len(inertial):
        return start
    begins_ns = int(inertial.time_ns[0]) - round(float(inertial.interval_s[0]) * SECOND_NS)
    places = observations[
        (observations["kind"] == Kind.POSITION)
        & (observations["time_ns"] >= begins_ns)
        & (observations["time_ns"] < start.time_ns)
        & (observations["antenna"] < len(setup.lever_arms_b))
        & np.isfinite(observations["value"]).all(axis=1)
        & (observations["sigma"] > 0.0).all(axis=1)
    ]
    for number, place in enumerate(places):
        drift = drift_rad(setup.noise, (start.time_ns - int(place["time_ns"])) / SECOND_NS)
        if drift > MOST_DRIFT_RAD:
            continue
        moving = _velocity(places[number:], observations, int(place["time_ns"]))
        if moving is not None:
            return _at(inertial, setup, start, place, moving, drift)
    return start


def _velocity(places: StructArray, observations: StructArray, time_ns: int) -> tuple[FloatArray, FloatArray] | None:
    """Return the antenna's velocity (3,), north, east, down, m/s, and its sigmas; None if unknown.

    It is an observed velocity near the time, else that between the first position and a later one.
    """
    velocities = observations[
        (observations["kind"] == Kind.VELOCITY) & (observations["antenna"] == places[0]["antenna"])
    ]
    away = np.abs(velocities["time_ns"] - time_ns)
    if len(velocities) and away.min() <= NEAR_NS and np.isfinite(velocities[int(np.argmin(away))]["value"]).all():
        near = velocities[int(np.argmin(away))]
        return near["value"], np.hypot(near["sigma"], ACCELERATION_MPS2 * away.min() / SECOND_NS)
    same = places[places["antenna"] == places[0]["antenna"]]
    later = same[same["time_ns"] - time_ns >= APART_NS]
    if not len(later) or int(later[0]["time_ns"]) - time_ns > 2 * APART_NS:
        return None
    seconds = (int(later[0]["time_ns"]) - time_ns) / SECOND_NS
    rot = _rot_e_from_l(places[0]["value"])
    velocity = rot.T @ (later[0]["value"] - places[0]["value"]) / seconds
    return velocity, np.hypot(later[0]["sigma"], places[0]["sigma"]) / seconds + ACCELERATION_MPS2 * seconds / 2.0


def _at(
    inertial: Inertial,
    setup: Setup,
    start: StartT,
    place: np.void,
    moving: tuple[FloatArray, FloatArray],
    drift: float,
) -> StartT:
    """Return the start at a position: the antenna's position and velocity, converted to the body's origin."""
    time_ns = int(place["time_ns"])
    rot_e_from_b = _rot_e_from_b(inertial, start, time_ns)
    arm = setup.lever_arms_b[place["antenna"]]
    rot = _rot_e_from_l(place["value"])
    near = slice(*np.searchsorted(inertial.time_ns, [time_ns, time_ns + RATE_NS + 1]).tolist())
    rate_ib = inertial.angle_b[near].sum(axis=0) / max(float(inertial.interval_s[near].sum()), 1e-9)
    rate_eb = rate_ib - rot_e_from_b.T @ np.array([0.0, 0.0, EARTH_RATE_RADPS])
    swing_l = rot.T @ rot_e_from_b @ np.cross(rate_eb, arm)
    return replace(
        start,
        time_ns=time_ns,
        position_e=place["value"] - rot_e_from_b @ arm,
        velocity_l=moving[0] - swing_l,
        attitude_rad=np.array([float(angle) for angle in attitude_of(rot.T @ rot_e_from_b)]),
        position_sigma_l=CAREFUL * place["sigma"],
        velocity_sigma_l=CAREFUL * moving[1],
        attitude_sigma_rad=np.hypot(start.attitude_sigma_rad, drift),
    )


def _rot_e_from_b(inertial: Inertial, start: Start, time_ns: int) -> FloatArray:
    """Return (3, 3) at an earlier time: back by the turns of the samples in between, and by the earth's."""
    first, last = np.searchsorted(inertial.time_ns, [time_ns, start.time_ns], side="right").tolist()
    turned = rot_from_quaternion(_chained(inertial.angle_b[first:last]))
    at_start = _rot_e_from_l(start.position_e) @ rot_l_from_b(*start.attitude_rad)
    seconds = (start.time_ns - time_ns) / SECOND_NS
    rot: FloatArray = rot_z(EARTH_RATE_RADPS * seconds) @ at_start @ turned.T
    return rot


def _chained(angle_b: FloatArray) -> FloatArray:
    """Return the product (4,) of successive turns (n, 3), computed by pairs."""
    size = np.linalg.norm(angle_b, axis=1, keepdims=True)
    q = np.concatenate([np.cos(size / 2), angle_b * (np.sinc(size / (2 * np.pi)) / 2)], axis=1)
    unit = np.array([[1.0, 0.0, 0.0, 0.0]])
    q = np.concatenate([q, unit]) if len(q) else unit
    while len(q) > 1:
        if len(q) % 2:
            q = np.concatenate([q, unit])
        q = product(q[0::2], q[1::2])
    whole: FloatArray = q[0]
    return whole


def _rot_e_from_l(position_e: FloatArray) -> FloatArray:
    lat, lon, _ = geodetic_from_e(position_e)
    rot: FloatArray = rot_e_from_l(lat, lon)
    return rot
