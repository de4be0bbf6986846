"""Coarse alignment: gross errors of boresight and range made small, so that planes can be recognised.

Heights of the swaths are laid on each other, first much smoothed, then less and less (Gauss–Newton on gridded heights,
coarse to fine). How heights change with a parameter is had by placing a sample of the returns again with it changed, so
any scanner and mount of the sensor model will do.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from calib.flight import Flight, Swath
from calib.height_grids import Lattice, Surface, surface
from calib.plane_cells import spacing_m
from georef.calibration import INDEX, Calibration
from georef.records import Int64Array

FloatArray = NDArray[np.float64]

NAMES = ("omega_rad", "phi_rad", "kappa_rad", "range_offset_m")
_STEPS = (1e-4, 1e-4, 1e-4, 0.1)  # by which parameters are changed to see what that does
_CELLS_MOST, _CELLS_LEAST = 400_000, 200
_CELL_LEAST_M = 3.0
_SMOOTH_POINTS = 2.0  # least sigma of the smoothing in units of the distance between points
_CONTROL_REACH_M, _CONTROL_POINTS = 4.0, 3  # around a control point, returns whose median height counts
_STEP_MOST_RAD = np.radians(2.0)
_REWEIGHTINGS, _HUBER, _SIGMA_LEAST_M = 3, 2.0, 0.02


class PrealignError(ValueError):
    """Swaths that cannot be laid on each other; one line for the user."""


@dataclass(frozen=True, slots=True)
class PrealignSettings:
    """How it is done.

    Attributes:
        smooth_m: sigmas of the smoothing, coarse to fine.
        returns: of a swath that are placed.
        rounds: most a level.
        boresight_sigma_rad, range_sigma_m: what is known before; holds what this flight does not determine.
        settled_rad: the finest level ends when no angle changes by more; a coarser one when by as much more.
        greatest_rad: beyond this it is no coarse error of a mounting but a wrong installation matrix.
        control_sigma_m: of control against heights of the surface.
    """

    smooth_m: tuple[float, ...] = (48.0, 24.0, 12.0, 6.0)
    returns: int = 100_000
    rounds: int = 8
    boresight_sigma_rad: float = float(np.radians(2.0))
    range_sigma_m: float = 3.0
    settled_rad: float = float(np.radians(0.004))
    greatest_rad: float = float(np.radians(6.0))
    control_sigma_m: float = 0.1


_DEFAULT = PrealignSettings()


def prealign(
    flight: Flight,
    settings: PrealignSettings = _DEFAULT,
    start: Mapping[str, Calibration] | None = None,
    control_t: FloatArray | None = None,
) -> dict[str, Calibration]:
    """Calibrations by scanner, whose boresight angles are good to some hundredths of a degree.

    Args:
        flight: at least two swaths that overlap.
        settings: of the way there.
        start: calibrations to begin with; None: those of the flight's heads.
        control_t: (k, 3) surveyed points on open ground, which also fix the height.

    Raises:
        PrealignError: there is one swath only, swaths do not overlap, or their heights do not come together.
    """
    if len(flight.swaths) < 2:
        raise PrealignError(f"prealignment: got {len(flight.swaths)} swath, want at least two that overlap")
    found = dict(start or flight.starts())
    began = {name: one.parameters.copy() for name, one in found.items()}
    samples = [_sample(swath, settings.returns) for swath in flight.swaths]
    step = np.zeros((len(flight.heads), len(NAMES)))
    apart_m = _spacing(flight, samples)
    finest_m = max(settings.smooth_m[-1], _SMOOTH_POINTS * apart_m)
    for smooth_m in dict.fromkeys(max(one, finest_m) for one in settings.smooth_m):
        coarser = smooth_m / finest_m
        fewer = [at[:: max(1, int(0.5 * coarser))] for at in samples]
        motions = [_motion(flight, *one, found) for one in zip(flight.swaths, fewer, strict=True)]
        for _ in range(settings.rounds):
            placed = [_placed(flight, *one, found) for one in zip(flight.swaths, fewer, motions, strict=True)]
            found, step = _improved(flight, placed, found, began, smooth_m, settings, control_t)
            if np.abs(step[:, :3]).max() < coarser * settings.settled_rad:
                break
    _refuse(found, began, step, settings)
    return found


def _refuse(
    found: Mapping[str, Calibration], began: Mapping[str, FloatArray], step: FloatArray, settings: PrealignSettings
) -> None:
    for name, calibration in found.items():
        for parameter in NAMES[:3]:
            turned = calibration.value(parameter) - float(began[name][INDEX[parameter]])
            if abs(turned) > settings.greatest_rad:
                text = f"{parameter.removesuffix('_rad')} came to {np.degrees(turned):.1f}° from the start"
                raise PrealignError(f"prealignment of {name}: {text}; want the installation matrix and mount checked")
    last = float(np.abs(step[:, :3]).max())
    if last > 10.0 * settings.settled_rad:
        text = f"the last step still turned a scanner by {np.degrees(last):.2f}°"
        raise PrealignError(
            f"prealignment: does not come to rest, {text}; want strips that overlap over relief or roofs"
        )


def _sample(swath: Swath, count: int) -> Int64Array:
    """Rising indexes of last returns, evenly over a swath."""
    at = np.arange(0, len(swath), max(1, len(swath) // count))
    rows = swath.rows[at]
    last: Int64Array = at[rows["return_number"] == rows["number_of_returns"]]
    return last


def _spacing(flight: Flight, samples: list[Int64Array]) -> float:
    """Metres from one of the sample's points to the next, of the thinnest swath; PrealignError: one has no points."""
    spacings = [
        spacing_m(swath) * np.sqrt(len(swath) / max(len(at), 1))
        for swath, at in zip(flight.swaths, samples, strict=True)
    ]
    if not np.isfinite(spacings).all():
        text = "a swath has no points; want a trajectory and a calibration that place them"
        raise PrealignError(f"prealignment: {text}")
    return float(max(spacings))


def _improved(
    flight: Flight,
    placed: list[tuple[FloatArray, FloatArray]],
    found: Mapping[str, Calibration],
    began: Mapping[str, FloatArray],
    smooth_m: float,
    settings: PrealignSettings,
    control_t: FloatArray | None,
) -> tuple[dict[str, Calibration], FloatArray]:
    """One step: better calibrations, and by how much each head's parameters changed, (h, 4)."""
    if any(not len(points) for points, _ in placed):
        text = "a swath has no points; want a trajectory and a calibration that place them"
        raise PrealignError(f"prealignment: {text}")
    lattice = Lattice.over([points for points, _ in placed], max(smooth_m / 3.0, _CELL_LEAST_M), _CELLS_MOST)
    surfaces = [surface(lattice, points, motion, smooth_m) for points, motion in placed]
    heads = [swath.head for swath in flight.swaths]
    apart, design = _differences(surfaces, heads, len(flight.heads))
    sigma_m, weight = _robust(apart, design)
    alike = max(1.0, 4.0 * np.pi * (smooth_m / lattice.cell_m) ** 2)  # cells that the smoothing makes one
    normal = (design * weight[:, np.newaxis]).T @ design / (sigma_m**2 * alike)
    right = design.T @ (weight * apart) / (sigma_m**2 * alike)
    if control_t is not None and len(control_t):
        above, rows = _against_control(placed, heads, len(flight.heads), np.asarray(control_t))
        normal += rows.T @ rows / settings.control_sigma_m**2
        right += rows.T @ above / settings.control_sigma_m**2
    names = [head.name for head in flight.heads]
    away = np.concatenate([[found[name].value(p) - began[name][INDEX[p]] for p in NAMES] for name in names])
    prior = np.tile([settings.boresight_sigma_rad] * 3 + [settings.range_sigma_m], len(names)) ** -2.0
    step = -np.linalg.solve(normal + np.diag(prior), right + prior * away).reshape(-1, len(NAMES))
    step *= min(1.0, _STEP_MOST_RAD / max(float(np.abs(step[:, :3]).max()), 1e-12))
    better = {
        name: found[name].changed(**{p: found[name].value(p) + float(by) for p, by in zip(NAMES, one, strict=True)})
        for name, one in zip(names, step, strict=True)
    }
    return {**found, **better}, step


def _motion(flight: Flight, swath: Swath, at: Int64Array, found: Mapping[str, Calibration]) -> FloatArray:
    """(4, n, 3) how points of returns move with each of the parameters; it stays nearly the same all the while."""
    calibration = found[flight.heads[swath.head].name]
    points = flight.place(swath, calibration, at)
    motion = np.empty((len(NAMES), *points.shape))
    for index, (name, by) in enumerate(zip(NAMES, _STEPS, strict=True)):
        moved = flight.place(swath, calibration.changed(**{name: calibration.value(name) + by}), at)
        motion[index] = (moved - points) / by
    return motion


def _placed(
    flight: Flight, swath: Swath, at: Int64Array, motion: FloatArray, found: Mapping[str, Calibration]
) -> tuple[FloatArray, FloatArray]:
    """Points (m, 3) of those returns that have one, and their motion (4, m, 3)."""
    points = flight.place(swath, found[flight.heads[swath.head].name], at)
    there = np.isfinite(points).all(axis=1) & np.isfinite(motion).all(axis=(0, 2))
    return points[there], motion[:, there]


def _differences(surfaces: list[Surface], heads: list[int], count: int) -> tuple[FloatArray, FloatArray]:
    """Heights of one swath above another (m,) in all cells that two have, and their change with all unknowns (m, u)."""
    apart, design = [], []
    for one, other in combinations(range(len(surfaces)), 2):
        first, second = surfaces[one], surfaces[other]
        _, a, b = np.intersect1d(first.cells, second.cells, assume_unique=True, return_indices=True)
        rows = np.zeros((len(a), count, len(NAMES)))
        rows[:, heads[one]] += first.change[a]
        rows[:, heads[other]] -= second.change[b]
        apart.append(first.height_m[a] - second.height_m[b])
        design.append(rows.reshape(len(a), count * len(NAMES)))
    if sum(len(one) for one in apart) < _CELLS_LEAST:
        raise PrealignError("prealignment: the swaths do not overlap; want strips over the same ground")
    return np.concatenate(apart), np.concatenate(design)


def _robust(apart: FloatArray, design: FloatArray) -> tuple[float, FloatArray]:
    """Sigma of a difference once the parameters are right, and weights (m,): what one strip sees and another does not,
    as trees and what walls hide, counts little (Huber 1981)."""
    weight = np.ones(len(apart))
    sigma_m = 1.0
    damping = 1e-9 * np.diag((design**2).sum(axis=0) + 1e-12)
    for _ in range(_REWEIGHTINGS):
        weighted = design * weight[:, np.newaxis]
        step = np.linalg.solve(weighted.T @ design + damping, weighted.T @ apart)
        left = np.abs(apart - design @ step)
        sigma_m = max(1.4826 * float(np.median(left)), _SIGMA_LEAST_M)
        weight = 1.0 / np.maximum(1.0, left / (_HUBER * sigma_m)) ** 2
    return sigma_m, weight


def _against_control(
    placed: list[tuple[FloatArray, FloatArray]], heads: list[int], count: int, control_t: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Heights of swaths above control points (m,), and their change with all unknowns (m, u)."""
    above, design = [np.zeros(0)], [np.zeros((0, count * len(NAMES)))]
    for (points, motion), head in zip(placed, heads, strict=True):
        near = cKDTree(points[:, :2]).query_ball_point(control_t[:, :2], _CONTROL_REACH_M)
        for place, at in zip(control_t, near, strict=True):
            if len(at) >= _CONTROL_POINTS:
                row = np.zeros((count, len(NAMES)))
                row[head] = np.median(motion[:, at, 2], axis=1)
                above.append(np.array([np.median(points[at, 2]) - place[2]]))
                design.append(row.reshape(1, -1))
    return np.concatenate(above), np.concatenate(design)
