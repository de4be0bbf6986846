"""Do inertial samples and GNSS describe one motion of one body? Fits over windows tell what is mounted otherwise.

The fit of `alignment_fit` takes nothing for granted about how the unit is mounted: it finds the attitude with which
what was felt agrees with GNSS. Where that fails, other orders and signs of the gyroscopes' axes are tried; where it
succeeds, the body's axes are compared with the way the vehicle went, and the lever arm is fitted as well.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import permutations, product
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from georef.navigation.alignment_blocks import Blocks, Felt
from georef.navigation.alignment_fit import ARM, TILT, Fitted, Problem
from georef.navigation.diagnosis_time import velocities
from georef.navigation.inputs import Inertial, Kind, Setup
from georef.records import Int64Array, StructArray
from georef.rotations import rot_z
from georef.timescales.gps_time import SECOND_NS

FloatArray = NDArray[np.float64]
Sensor = Literal["gyro", "accel"]

WINDOW_NS = 40 * SECOND_NS
MOST_WINDOWS = 6
THINNED_NS = 9 * SECOND_NS // 10
FEWEST = 8  # positions in a window
FITS, FAILS = 20.0, 60.0  # reduced χ² of a fit that is right, of one that is not
BETTER = 10.0  # times less χ² than the axes as they are
COURSE_MPS = 5.0
ALONG = 0.85  # of 1: how well the body's axes must lie along the vehicle's, turned by right angles
ARM_SIGMA_M = 5.0
NO_INDEX = np.zeros(0, np.int64)


@dataclass(frozen=True, eq=False)
class Window:
    """A stretch with motion.

    Attributes:
        inertial: samples.
        felt: integrals back to its end.
        rows: observations in it, thinned, by time.
        fitted: by positions and velocities alone.
    """

    inertial: Inertial
    felt: Felt
    rows: StructArray
    fitted: Fitted


@dataclass(frozen=True, slots=True)
class Axes:
    """Which of the sensor's axes a body axis takes: b = matrix · as it is now."""

    matrix: FloatArray
    gain: float  # how much better, or how well


def windows(inertial: Inertial, observations: StructArray, setup: Setup) -> list[Window]:
    """The stretches in which most happens, by time; fewer where data are few."""
    rows = _used(observations, len(setup.lever_arms_b))
    place = rows[rows["kind"] == Kind.POSITION]
    begins_ns = np.arange(max(_first(inertial.time_ns), _first(place["time_ns"])), _last(inertial.time_ns), WINDOW_NS)
    scores = [_eventfulness(inertial, rows, int(begin)) for begin in begins_ns]
    chosen = sorted(np.argsort(np.array(scores), kind="stable")[::-1][:MOST_WINDOWS].tolist())
    found = []
    for number in chosen:
        window = _window(inertial, rows, setup, int(begins_ns[number])) if scores[number] > 0.0 else None
        if window is not None:
            found.append(window)
    return found


def sensor_axes(chosen: list[Window], setup: Setup) -> tuple[Sensor, Axes] | None:
    """Another order, other signs or another unit of one sensor's axes with which gyroscopes and accelerometers agree.

    Of the gyroscopes 48 ways to take the axes and two units are tried, of the accelerometers the 24 mirrored ways:
    turned accelerometers are the same as gyroscopes turned back.

    Returns:
        None where the axes as they are do, or no others do.
    """
    misfit = np.array([window.fitted.misfit for window in chosen])
    if not len(chosen) or np.median(misfit) < FAILS:
        return None
    worst = [chosen[k] for k in np.argsort(misfit, kind="stable")[::-1][:2]]
    units = [np.eye(3) * np.pi / 180.0, np.eye(3) * 180.0 / np.pi]
    tries: list[tuple[Sensor, list[FloatArray]]] = [
        ("gyro", [*_signed_permutations(), *units]),
        ("accel", [matrix for matrix in _signed_permutations() if np.linalg.det(matrix) < 0.0]),
    ]
    for sensor, matrices in tries:
        values = [_problem(worst[0], sensor, matrix, setup).unlikeness() for matrix in matrices]
        matrix = matrices[int(np.argmin(values))]
        problems = [_problem(window, sensor, matrix, setup) for window in worst]
        left = [problem.fit(problem.first_guess()).misfit for problem in problems]
        gains = [window.fitted.misfit / value for window, value in zip(worst, left, strict=True)]
        if max(left) < FITS and min(gains) > BETTER:
            return sensor, Axes(matrix, min(gains))
    return None


def body_axes(chosen: list[Window]) -> Axes | None:
    """The turn by right angles (24) that takes the body's axes to the vehicle's; the identity where they are right.

    Returns:
        None where the vehicle did not go fast enough, or its axes lie between.
    """
    total, count = np.zeros((3, 3)), 0
    for window in chosen:
        time_ns, velocity_l = velocities(window.rows)
        fast = np.hypot(velocity_l[:, 0], velocity_l[:, 1]) > COURSE_MPS
        if window.fitted.misfit > FAILS or not fast.any():
            continue
        turn = window.felt.at(time_ns[fast]).rot
        track = rot_z(np.arctan2(velocity_l[fast, 1], velocity_l[fast, 0]))
        total += (np.swapaxes(track, 1, 2) @ (window.fitted.rot_l_from_b @ turn)).sum(axis=0)
        count += int(fast.sum())
    if count < FEWEST:
        return None
    scores = [(float(np.trace(matrix.T @ total)) / (3 * count), matrix) for matrix in _signed_permutations(proper=True)]
    score, matrix = max(scores, key=lambda each: each[0])
    return Axes(matrix, score) if score > ALONG else None


def heading_offset(chosen: list[Window], setup: Setup) -> tuple[float, float] | None:
    """Dual-antenna heading less the heading of the baseline by motion, and its sigma, rad; None where either lacks."""
    if setup.baseline_b is None:
        return None
    offsets, sigmas = [], []
    for window in chosen:
        rows = window.rows[window.rows["kind"] == Kind.HEADING]
        sigma = float(window.fitted.sigma(TILT)[2])
        if len(rows) < FEWEST or sigma > 0.2 or window.fitted.misfit > FAILS:
            continue
        turn = window.felt.at(rows["time_ns"]).rot
        ahead = np.einsum("nij,j->ni", window.fitted.rot_l_from_b @ turn, setup.baseline_b)
        off = rows["value"][:, 0] - np.arctan2(ahead[:, 1], ahead[:, 0])
        offsets.append(np.exp(1j * off).mean())
        sigmas.append(sigma)
    if not offsets:
        return None
    mean = complex(np.mean(offsets))
    return float(np.angle(mean)), max(float(np.median(sigmas)), float(np.std(np.angle(np.array(offsets) / mean))))


def other_signs(arm_b: FloatArray, fitted_b: FloatArray, sigma_m: FloatArray) -> FloatArray | None:
    """Signs (3,) with which a lever arm fits clearly better than as it is; None where it does as it is, or none do."""
    off = np.linalg.norm(fitted_b - arm_b)
    if off < max(0.3, 8.0 * float(sigma_m.max())):
        return None
    patterns = [np.array(signs) for signs in product((1.0, -1.0), repeat=3)]
    best = min(patterns, key=lambda signs: float(np.linalg.norm(fitted_b - signs * arm_b)))
    best = np.where(np.abs(arm_b) > 0.1, best, 1.0)
    better = np.linalg.norm(fitted_b - best * arm_b) < 0.35 * off
    return best if better and (best < 0.0).any() else None


def lever_arm(chosen: list[Window], setup: Setup) -> tuple[FloatArray, FloatArray] | None:
    """Lever arm (3,) of antenna 0 that positions and velocities fit best, m in b, and its sigma (3,)."""
    information, weighted = np.zeros((3, 3)), np.zeros(3)
    for window in chosen:
        if window.fitted.misfit > FAILS:
            continue
        rows = window.rows[(window.rows["antenna"] == 0) & _is_motion(window.rows)]
        if (rows["kind"] == Kind.POSITION).sum() < FEWEST:
            continue
        free = Problem(window.felt, rows, setup, NO_INDEX, ARM_SIGMA_M).fit(window.fitted.rot_l_from_b)
        weight = np.linalg.inv(free.covariance[ARM, ARM] * max(free.misfit, 1.0))
        information += weight
        weighted += weight @ (setup.lever_arms_b[0] + free.arm_b)
    if not information.any():
        return None
    covariance = np.linalg.inv(information)
    return np.asarray(covariance @ weighted, dtype=np.float64), np.sqrt(np.diag(covariance))


def _problem(window: Window, sensor: Sensor, matrix: FloatArray, setup: Setup) -> Problem:
    """With one sensor's values taken otherwise."""
    rows, felt = window.rows[_is_motion(window.rows)], window.felt
    if np.abs(matrix).max() != 1.0:  # turns of another size differ within blocks
        blocks = Blocks()
        blocks.feed(replace(window.inertial, angle_b=window.inertial.angle_b @ matrix.T))
        other = blocks.felt(int(felt.time_ns[0]), int(felt.time_ns[-1]))
        return Problem(felt if other is None else other, rows, setup, NO_INDEX)
    gyro, accel = (matrix, np.eye(3)) if sensor == "gyro" else (np.eye(3), matrix)
    return Problem(felt.taken(gyro, accel), rows, setup, NO_INDEX)


def _fit(felt: Felt, rows: StructArray, setup: Setup) -> Fitted:
    problem = Problem(felt, rows[_is_motion(rows)], setup, NO_INDEX)
    return problem.fit(problem.first_guess())


def _window(inertial: Inertial, rows: StructArray, setup: Setup, begin_ns: int) -> Window | None:
    span = np.array([begin_ns - SECOND_NS, begin_ns + WINDOW_NS + SECOND_NS])
    part = inertial.between(*np.searchsorted(inertial.time_ns, span).tolist())
    inside = rows[(rows["time_ns"] >= begin_ns) & (rows["time_ns"] <= begin_ns + WINDOW_NS)]
    place = inside[inside["kind"] == Kind.POSITION]
    if len(place) < FEWEST or len(part) < FEWEST:
        return None
    blocks = Blocks()
    blocks.feed(part)
    felt = blocks.felt(begin_ns, int(place["time_ns"][-1]))
    if felt is None:
        return None
    inside = inside[(inside["time_ns"] >= felt.time_ns[0]) & (inside["time_ns"] <= felt.time_ns[-1])]
    if (inside["kind"] == Kind.POSITION).sum() < FEWEST:
        return None
    return Window(part, felt, inside, _fit(felt, inside, setup))


def _used(observations: StructArray, antennas: int) -> StructArray:
    """Sound rows, thinned to about one a second of a kind."""
    rows = observations[np.isin(observations["kind"], (Kind.POSITION, Kind.VELOCITY, Kind.HEADING))]
    needed = np.where(rows["kind"] == Kind.HEADING, 1, 3)
    sound = np.isfinite(rows["value"]) & np.isfinite(rows["sigma"]) & (rows["sigma"] > 0.0)
    sound |= np.arange(3) >= needed[:, None]
    rows = rows[sound.all(axis=1) & (rows["antenna"] < antennas)]
    keep = np.zeros(len(rows), np.bool_)
    latest: dict[tuple[int, int], int] = {}
    for number, (time, kind, antenna) in enumerate(
        zip(rows["time_ns"].tolist(), rows["kind"].tolist(), rows["antenna"].tolist(), strict=True)
    ):
        if time - latest.get((kind, antenna), time - THINNED_NS) >= THINNED_NS:
            latest[kind, antenna] = time
            keep[number] = True
    used: StructArray = rows[keep]
    return used


def _eventfulness(inertial: Inertial, rows: StructArray, begin_ns: int) -> float:
    """How much GNSS's velocity or the felt turning changes in a window; 0 where either has a gap."""
    end_ns = begin_ns + WINDOW_NS
    first, last = np.searchsorted(inertial.time_ns, [begin_ns, end_ns])
    speed = rows[(rows["kind"] == Kind.VELOCITY) & (rows["time_ns"] >= begin_ns) & (rows["time_ns"] < end_ns)]
    place = rows[(rows["kind"] == Kind.POSITION) & (rows["time_ns"] >= begin_ns) & (rows["time_ns"] < end_ns)]
    if last - first < FEWEST or len(place) < FEWEST:
        return 0.0
    changed = float(np.std(speed["value"][:, :2], axis=0).max()) if len(speed) else 0.0
    turned = float(np.linalg.norm(inertial.angle_b[first:last].sum(axis=0)))
    return 1e-6 + changed + 5.0 * turned


def _is_motion(rows: StructArray) -> NDArray[np.bool_]:
    return np.asarray(np.isin(rows["kind"], (Kind.POSITION, Kind.VELOCITY)))


def _signed_permutations(*, proper: bool = False) -> Iterator[FloatArray]:
    """The 48 matrices that swap and mirror axes; of them the 24 rotations."""
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[np.arange(3), order] = signs
            if not proper or np.linalg.det(matrix) > 0.0:
                yield matrix


def _first(time_ns: Int64Array) -> int:
    return int(time_ns[0]) if len(time_ns) else 0


def _last(time_ns: Int64Array) -> int:
    return int(time_ns[-1]) if len(time_ns) else 0
