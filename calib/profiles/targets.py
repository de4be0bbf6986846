"""Measure the range offset by heights of flat targets: laser heights above surveyed points (FORMULAS 5.4)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from swath.calib.features import ControlPoint
from swath.calib.flight import Flight
from swath.calib.profiles.fit import levers, solve, trajectory_sigmas
from swath.calib.profiles.measure import Ground, Measured, Settings, part_of
from swath.calib.profiles.places import Track
from swath.calib.profiles.sections import Corridor, fit_pieces
from swath.georef.arrays import FloatArray
from swath.georef.scanner.calibration import Calibration


def measure_range(
    flight: Flight,
    ground: Ground,
    track: Track,
    swath: int,
    control: Sequence[ControlPoint],
    calibrations: Mapping[str, Calibration],
    settings: Settings,
    margin_m: float,
) -> Measured | str:
    """Measure the range offset from flat targets that a swath shows; a string is the reason of failure."""
    calibration = calibrations[flight.heads[ground.swath.head].name]
    seen = [(point, _target(flight, track, ground, point, calibration, settings, margin_m)) for point in control]
    shown = [(point, target) for point, target in seen if target is not None]
    if not shown:
        return "no swath contains a flat target"
    height_m, sigma_m, lever, aside_m = np.array([target.figures for _, target in shown]).T
    prior = {swath: trajectory_sigmas(flight, swath, settings.unsaid_sigma)}
    fit = solve(height_m, sigma_m, lever, {swath: np.stack([target.levers for _, target in shown])}, prior)
    order = np.argsort(aside_m)
    edges = track.origin_t + np.outer([track.left_m, track.right_m], track.right)
    level = float(np.median([point.position_t[2] for point in control]))
    zero = (aside_m[order], np.zeros(len(order)))
    after = (aside_m[order], (height_m - lever * fit.error)[order])
    return Measured(
        "range",
        swath,
        -1,
        np.column_stack([edges, [level, level]]),
        ((aside_m[order], height_m[order]), zero),
        (after, zero),
        1.0,
        -fit.error,
        fit,
        int(fit.used.sum()),
        tuple(target.cell for _, target in shown),
        np.stack([target.slope_t for _, target in shown]),
        tuple(point.name for point, _ in shown),
    )


@dataclass(frozen=True, eq=False)
class _Target:
    """A surveyed point as a swath shows it.

    Attributes:
        figures: laser height above it, its sigma, lever of the range, distance from nadir to the right; metres.
        levers: (6,) of the trajectory's errors.
        cell: the ground that counts.
        slope_t: (2,) of it, east and north.
    """

    figures: tuple[float, float, float, float]
    levers: FloatArray
    cell: Corridor
    slope_t: FloatArray


def _target(
    flight: Flight,
    track: Track,
    ground: Ground,
    point: ControlPoint,
    calibration: Calibration,
    settings: Settings,
    margin_m: float,
) -> _Target | None:
    place = point.position_t[np.newaxis, :2]
    radius = settings.target_radius_m * max(1.0, math.sqrt(1.0 / max(track.density, 1e-6)) / settings.target_radius_m)
    start = point.position_t[:2] - radius * track.forward
    corridor = Corridor.between(start, start + 2.0 * radius * track.forward, radius)
    part = part_of(flight, ground, corridor, (margin_m, margin_m), calibration)
    if len(part.swath) < settings.least_returns:
        return None
    section = part.section("range_offset_m", 0.0)
    piece = fit_pieces(*section, 2.0 * radius, 1, settings.least_returns)
    if not (
        piece.rms_m[0] <= settings.rms_m and math.hypot(piece.slope[0], piece.side_slope[0]) <= settings.flat_slope
    ):
        return None
    rays = flight.rays(part.swath, calibration, slice(None), with_axes=False)
    beam = (rays.points_e - rays.origin_e).mean(axis=0) @ flight.frame.rot_t_from_e.T
    beam /= np.linalg.norm(beam)
    slopes = piece.slope[:, np.newaxis] * corridor.along + piece.side_slope[:, np.newaxis] * corridor.across
    states = levers(track, place, piece.height_m, slopes)[0]
    sigma = float(np.hypot(piece.sigma_m[0], np.broadcast_to(point.sigma_m, 3)[2]))
    lever = float(beam[2] - slopes[0] @ beam[:2])
    height_m = float(piece.height_m[0] - point.position_t[2])
    return _Target((height_m, sigma, lever, float(track.aside(place)[0])), states, corridor, slopes[0])
