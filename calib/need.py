"""Determine how accurate a calibration has to be, and which errors it leaves in the points.

A point has errors of trajectory and range whatever the calibration. By default the calibration may add no more than
half of these, which makes the total larger by an eighth: an angle may err by that amount divided by the distance at
which it acts, the range offset by that amount itself. The errors that the calibration leaves in points follow from its
joint covariance, so errors that cancel in a point (a range offset and the scan angle scale that was held beside it)
cancel here too.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from swath.calib.flight import Flight, Swath
from swath.calib.outcome import TrajectoryFit
from swath.calib.parameters import ANGLES
from swath.calib.strips.effects import SeenFrom, effect_columns
from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.scanner.calibration import PARAMETERS, Calibration

POINT = "point"  # key of the user's accuracies: of a point, metres
SHARE = 0.5  # of a point's own sigma; a calibration may add this much
SAMPLE = 60  # returns per swath
STEP = 0.1  # sigmas by which a parameter is changed to see its effect


@dataclass(frozen=True)
class Need:
    """The accuracy that points need and the accuracy that they have.

    Attributes:
        point_m: one sigma (root of the sum of three variances) that a calibration may leave in points.
        wanted: one sigma, SI, by parameter's name.
        own_m: one sigma of points without errors of the calibration; nan: the trajectory has no sigmas.
        left_m: by scanner, one sigma that its calibration leaves in points.
    """

    point_m: float
    wanted: Mapping[str, float]
    own_m: float
    left_m: Mapping[str, float]


def need_of(
    flight: Flight,
    calibrations: Mapping[str, Calibration],
    trajectory: TrajectoryFit | None,
    wanted: Mapping[str, float] | None = None,
) -> Need:
    """Determine the accuracy that a flight's points need of a calibration.

    Args:
        flight: placed with the calibrations.
        calibrations: by scanner, with sigmas.
        trajectory: trajectory errors known before the adjustment; None: unknown.
        wanted: accuracies the user requires, SI, by parameter's name or `POINT`; missing ones are derived.
    """
    given = dict(wanted or {})
    samples = [_sample(len(swath)) for swath in flight.swaths]
    squares: dict[str, list[FloatArray]] = {name: [] for name in calibrations}
    for swath, at in zip(flight.swaths, samples, strict=True):
        name = flight.heads[swath.head].name
        squares[name].append(_left_m2(flight, swath, at, calibrations[name]))
    left_m = {name: _root_mean(parts) for name, parts in squares.items()}
    arm, own_m = _seen(flight, samples, trajectory)
    point_m = given.pop(POINT, SHARE * own_m)
    distance_m = np.sqrt(np.nanmean(arm**2, axis=0)) if len(arm) else np.full(3, np.nan)  # forward, right, down
    level_m, slant_m = float(np.hypot(*distance_m[:2])), float(np.linalg.norm(distance_m))
    derived = dict(zip(ANGLES, (point_m / slant_m, point_m / slant_m, point_m / max(level_m, 1e-9)), strict=True))
    derived["range_offset_m"] = point_m
    return Need(point_m, {**derived, **given}, own_m, left_m)


def _sample(count: int) -> Int64Array:
    """Return indexes spread evenly over a swath; the step is odd so that they do not keep to one scan angle."""
    return np.arange(0, count, max(1, count // SAMPLE) | 1, dtype=np.int64)


def _root_mean(parts: list[FloatArray]) -> float:
    every = np.concatenate([np.zeros(0), *parts])
    every = every[np.isfinite(every)]
    return float(np.sqrt(every.mean())) if len(every) else float("nan")


def _left_m2(flight: Flight, swath: Swath, at: Int64Array, calibration: Calibration) -> FloatArray:
    """Return the sums (n,) of the variances of points along three axes, due to the calibration's covariance alone."""
    covariance, sigmas = calibration.covariance(), calibration.all_sigmas
    known = np.flatnonzero(sigmas)
    points = flight.place(swath, calibration, at)
    columns = np.empty((len(known), *points.shape))
    for row, index in enumerate(known.tolist()):
        name, step = PARAMETERS[index].name, STEP * float(sigmas[index])
        changed = calibration.changed(**{name: calibration.value(name) + step})
        moved = flight.place(swath, changed, at)
        columns[row] = (moved - points) / step
    found: FloatArray = np.einsum("ina,ij,jna->n", columns, covariance[np.ix_(known, known)], columns)
    return np.where(np.isfinite(points).all(axis=1), np.maximum(found, 0.0), np.nan)


def _seen(flight: Flight, samples: list[Int64Array], trajectory: TrajectoryFit | None) -> tuple[FloatArray, float]:
    """Return distances (n, 3) of points from the body's axes, and one sigma of points without calibration errors.

    The distances are forward, right, down.
    """
    points = [swath.points_t[at] for swath, at in zip(flight.swaths, samples, strict=True)]
    strips = [np.full(len(at), number, dtype=np.int64) for number, at in enumerate(samples)]
    times = [swath.time_ns[at] for swath, at in zip(flight.swaths, samples, strict=True)]
    points_t, strip, time_ns = np.concatenate(points), np.concatenate(strips), np.concatenate(times)
    there = np.isfinite(points_t).all(axis=1)
    points_t, strip, time_ns = points_t[there], strip[there], time_ns[there]
    if not len(points_t):
        return np.zeros((0, 3)), float("nan")
    _, errors = effect_columns(points_t, strip, time_ns, np.zeros(len(points_t)), SeenFrom.of(flight))
    turned = np.linalg.norm(errors[:, 3:], axis=2)  # metres per radian about the body's axes: distances from them
    whole = 0.5 * (turned**2).sum(axis=1)
    arm = np.sqrt(np.maximum(whole[:, np.newaxis] - turned**2, 0.0))
    if trajectory is None or not len(trajectory.time_ns):
        return arm, float("nan")
    position_m2 = float((trajectory.prior_position_sigma_l**2).sum(axis=1).mean())
    turn_rad2 = (trajectory.prior_attitude_sigma_rad**2).mean(axis=0)
    range_m = max((head.noise.range_m for head in flight.heads), default=0.0)
    return arm, float(np.sqrt(position_m2 + (turned**2 @ turn_rad2).mean() + range_m**2))
