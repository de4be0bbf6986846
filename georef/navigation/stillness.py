"""Find where a vehicle stands still, by its inertial unit and its receiver; each such second is an observation.

Neither is sufficient alone: to the inertial unit straight flight at constant speed equals rest, and a receiver's zero
velocity may be a hover or a slow roll.
"""

from __future__ import annotations

import numpy as np

from swath.georef.arrays import BoolArray, StructArray
from swath.georef.geodesy.gravity import EARTH_RATE_RADPS
from swath.georef.navigation.inputs import OBSERVATION_DTYPE, Inertial, Kind, sort_observations
from swath.georef.timescales import SECOND_NS

TURN_RADPS = 4e-3  # mean of a second: above it the vehicle turns; biases of a good unit are smaller
FORCE_MPS2 = 0.08  # greatest difference between means of neighbouring seconds
SIGMAS = 3.0  # of a receiver's velocity or change of position: limit of standing still
MOVES_MPS = (0.05, 0.3)  # range of that limit: below the first it never moves, above the second always
DRIFTS_M = (0.3, 1.0)  # the same for positions some time apart, without observed velocities
APART_NS = 5 * SECOND_NS // 2  # minimum: epochs of a fast receiver are too close to show slow motion
SIGMA_MPS = 0.02  # a standing aircraft sways in the wind, and a running engine shakes it
BESIDE = 2  # seconds on either side that must be still too


def still_seconds(inertial: Inertial, observations: StructArray) -> StructArray:
    """Return zero-velocity observations, one in the middle of each whole second of GPS time that the vehicle stood.

    Args:
        inertial: of a piece without gaps.
        observations: `OBSERVATION_DTYPE`; seconds without a receiver's position or velocity are never taken.

    Returns:
        `OBSERVATION_DTYPE` of Kind.ZERO_VELOCITY, sorted.
    """
    if len(inertial) < 2:
        return np.zeros(0, OBSERVATION_DTYPE)
    first, last = int(inertial.time_ns[0]) // SECOND_NS + 1, int(inertial.time_ns[-1]) // SECOND_NS
    count = max(last - first, 0)
    still = _feels_still(inertial, first, count) & _seen_still(observations, first, count)
    around = np.ones(count, np.bool_)
    for shift in range(-BESIDE, BESIDE + 1):
        around &= np.roll(still, shift)
    around[:BESIDE] = around[count - BESIDE :] = False
    seconds = first + np.flatnonzero(around)
    rows = np.zeros(len(seconds), OBSERVATION_DTYPE)
    rows["time_ns"] = seconds * SECOND_NS + SECOND_NS // 2
    rows["kind"], rows["sigma"] = Kind.ZERO_VELOCITY, SIGMA_MPS
    return rows


def with_still_seconds(inertial: Inertial, observations: StructArray) -> StructArray:
    """Return the observations together with those of standing still."""
    return sort_observations(np.concatenate([observations, still_seconds(inertial, observations)]))


def _feels_still(inertial: Inertial, first: int, count: int) -> BoolArray:
    """Return (count,) whether whole seconds from ``first`` on have only the earth's turn and the neighbours' force."""
    number = (inertial.time_ns - 1) // SECOND_NS - first
    inside = (number >= 0) & (number < count)
    number = number[inside]
    time_s = np.bincount(number, inertial.interval_s[inside], count)
    made_up = np.bincount(number, inertial.bridged[inside], count) > 0
    known = (time_s > 0.5) & ~made_up
    turn, force = (
        np.stack([np.bincount(number, column[inside, axis], count) for axis in range(3)], axis=1)
        / np.where(known, time_s, np.inf)[:, np.newaxis]
        for column in (inertial.angle_b, inertial.velocity_b)
    )
    even = np.linalg.norm(np.diff(force, axis=0, prepend=force[:1]), axis=1) < FORCE_MPS2
    still: BoolArray = known & even & (np.linalg.norm(turn, axis=1) < TURN_RADPS + EARTH_RATE_RADPS)
    return still


def _seen_still(observations: StructArray, first: int, count: int) -> BoolArray:
    """Return (count,) whether a receiver's velocities, or without them its positions, show no motion."""
    seen, moves = np.zeros(count, np.bool_), np.zeros(count, np.bool_)
    for kind, moving in ((Kind.VELOCITY, _by_velocity), (Kind.POSITION, _by_position)):
        rows = observations[observations["kind"] == kind]
        rows = rows[np.isfinite(rows["value"]).all(axis=1) & np.isfinite(rows["sigma"]).all(axis=1)]
        number = rows["time_ns"] // SECOND_NS - first
        inside = (number >= 0) & (number < count)
        if len(rows) and not seen.any():
            seen[number[inside]] = True
            moves[number[inside & moving(rows)]] = True
    return seen & ~moves


def _by_velocity(rows: StructArray) -> BoolArray:
    limit = np.clip(SIGMAS * np.linalg.norm(rows["sigma"], axis=1), *MOVES_MPS)
    moves: BoolArray = np.linalg.norm(rows["value"], axis=1) > limit
    return moves


def _by_position(rows: StructArray) -> BoolArray:
    """Return whether each position moved since some time before: by more than its noise, or than a slow roll allows."""
    back = np.maximum(np.searchsorted(rows["time_ns"], rows["time_ns"] - APART_NS, side="right") - 1, 0)
    away = np.linalg.norm(rows["value"] - rows["value"][back], axis=1)
    moves: BoolArray = away > np.clip(SIGMAS * np.linalg.norm(rows["sigma"], axis=1), *DRIFTS_M)
    return moves
