"""Align coarsely: reduce gross errors of boresight and range so that planes can be recognised.

Heights of the swaths are matched to each other, at first much smoothed, then less and less (Gauss–Newton on gridded
heights, coarse to fine). The change of heights with a parameter comes from placing a sample of the returns again with
that parameter changed, so the method works for any scanner and mount of the sensor model.

All swaths' smoothed heights, and their changes with a scanner's parameters, use one grid.

A surface of points that move by (dx, dy, dz) changes at a fixed place by dz − ∂z/∂x · dx − ∂z/∂y · dy; this is
sufficient to match surfaces of swaths (least squares matching; FORMULAS 5.3 for the expected effects).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree

from swath.calib.flight import Flight, Swath
from swath.calib.scale import Scale, area_spacing_m, scale_of
from swath.georef.arrays import BoolArray, FloatArray, Int64Array
from swath.georef.scanner.calibration import INDEX, Calibration

SUPPORT = 0.9  # least support (share of a kernel that lies on cells with points), of the swath's typical one
_TYPICAL = 75.0  # percentile of the support of a swath's cells that is typical; thin samples leave cells empty
_REACH = 3.0  # radius of a kernel, in sigmas

NAMES = ("omega_rad", "phi_rad", "kappa_rad", "range_offset_m")
_STEPS = (1e-4, 1e-4, 1e-4, 0.1)  # changes of the parameters for difference quotients
_CELLS_MOST, _CELLS_LEAST = 400_000, 200
_SMOOTH_CELLS = 3.0  # cells per sigma of the smoothing
_SMOOTH_POINTS = 2.0  # least sigma of the smoothing in units of the distance between points
_SMOOTH_HEIGHTS = (0.06, 0.03, 0.015, 0.0075)  # sigmas in heights above ground: 3.4° of boresight, then half of it, …
_SMOOTH_FINEST_M = (1.0, 6.0)  # limits of the finest: below, only edges of roofs remain; above, roofs vanish
_SMOOTH_WIDTHS = 0.125  # greatest sigma in widths of a swath; a wider kernel does not fit into it
_CONTROL_SPACINGS, _CONTROL_POINTS = 1.3, 3  # radius around a control point; fewest returns there
_RANGE_HEIGHTS, _RANGE_LEAST_M = 0.0075, 0.2
_OVERSAMPLED = 4  # factor of the returns that are examined to find those where swaths overlap
_OVERLAP_WIDTHS = 0.1  # side of the cells that find overlap, in widths of a swath
_BACK = 0.5  # share of a step that the next one reverses where steps oscillate
_HELD = 1e-9  # rad, or m, by which a held parameter may move
_STEP_MOST_RAD = np.radians(2.0)
_NO_POINTS = "a swath has no points; use a trajectory and a calibration that georeference them"
# One sigma of the horizontal distance between matched surfaces, as a share of the finest smoothing: houses hide ground
# from one strip that another strip sees, and that biases all matches the same way. 0.01 to 0.25 on four flights 20 m,
# 60 m and 600 m above houses.
_LEANS = 0.15
_REWEIGHTINGS, _HUBER, _SIGMA_LEAST_M = 3, 2.0, 0.02


class PrealignError(ValueError):
    """Swaths that cannot be matched to each other; the message is one line for the user."""


@dataclass(frozen=True, slots=True)
class PrealignSettings:
    """Settings of the pre-alignment.

    Attributes:
        smooth_m: sigmas of the smoothing, coarse to fine; None: by the flight's height, width and density.
        returns: number of returns of a swath that are placed.
        rounds: greatest number of iterations at a level.
        boresight_sigma_rad, range_sigma_m: prior sigmas; they hold the parameters that this flight does not determine.
            The sigma of the range offset is `_RANGE_HEIGHTS` of the height above ground where that is less.
        settled_rad: the finest level ends when no angle changes by more; a coarser level has a proportionally larger
            limit.
        greatest_rad: a larger correction is not an error of mounting but a wrong installation matrix.
        control_sigma_m: of control against heights of the surface.
        held: of `NAMES`, by scanner as ``left.kappa_rad`` or for all: these keep their start.
    """

    smooth_m: tuple[float, ...] | None = None
    returns: int = 100_000
    rounds: int = 8
    boresight_sigma_rad: float = float(np.radians(2.0))
    range_sigma_m: float = 3.0
    settled_rad: float = float(np.radians(0.004))
    greatest_rad: float = float(np.radians(6.0))
    control_sigma_m: float = 0.1
    held: frozenset[str] = frozenset()


_DEFAULT = PrealignSettings()


def prealign(
    flight: Flight,
    settings: PrealignSettings = _DEFAULT,
    start: Mapping[str, Calibration] | None = None,
    control_t: FloatArray | None = None,
) -> dict[str, Calibration]:
    """Return calibrations by scanner, with boresight angles accurate to some hundredths of a degree.

    Args:
        flight: at least two swaths that overlap.
        settings: settings of the pre-alignment.
        start: calibrations to begin with; None: those of the flight's heads.
        control_t: (k, 3) surveyed points on open ground, which also fix the height.

    Raises:
        PrealignError: there is one swath only, swaths do not overlap, or their heights do not converge.
    """
    return prealigned(flight, settings, start, control_t).calibrations


@dataclass(frozen=True)
class Prealigned:
    """The outcome of a pre-alignment.

    Attributes:
        calibrations: by scanner.
        sigmas: (4,) of `NAMES` by scanner, SI, from heights of the strips, including the effect of houses that hide the
            ground behind them; parameters that heights do not determine have the sigmas of the settings.
    """

    calibrations: dict[str, Calibration]
    sigmas: dict[str, FloatArray]


def prealigned(
    flight: Flight,
    settings: PrealignSettings = _DEFAULT,
    start: Mapping[str, Calibration] | None = None,
    control_t: FloatArray | None = None,
) -> Prealigned:
    """Return coarse calibrations with sigmas; see `prealign` for arguments and errors."""
    if len(flight.swaths) < 2:
        raise PrealignError(
            f"prealignment: the flight has {len(flight.swaths)} swath; at least two that overlap are needed"
        )
    found = dict(start or flight.starts())
    began = {name: one.parameters.copy() for name, one in found.items()}
    samples, scale = _samples(flight, found, settings.returns)
    range_m = min(settings.range_sigma_m, max(_RANGE_HEIGHTS * scale.height_m, _RANGE_LEAST_M))
    settings = replace(settings, range_sigma_m=range_m)
    step, sigma = np.zeros((2, len(flight.heads), len(NAMES)))
    levels, improved = _levels(scale, settings), None
    control = None if control_t is None else _Control(control_t, _CONTROL_SPACINGS * scale.spacing_m)
    for smooth_m in levels:
        coarser = smooth_m / levels[-1]
        fewer = [at[:: max(1, int(0.5 * coarser))] for at in samples]
        motions = [_motion(flight, *one, found) for one in zip(flight.swaths, fewer, strict=True)]
        share, last = 1.0, np.zeros_like(step)
        for _ in range(settings.rounds):
            placed = [_placed(flight, *one, found) for one in zip(flight.swaths, fewer, motions, strict=True)]
            improved = _improved(flight, placed, found, began, smooth_m, settings, control, share)
            if improved is None:  # the overlap may be too narrow for this level but not for a finer one
                break
            found, step, sigma = improved
            share, last = share * _damping(last, step), step
            if np.abs(step[:, :3]).max() < coarser * settings.settled_rad:
                break
    if improved is None:
        raise PrealignError("prealignment: the swaths do not overlap; use strips over the same ground")
    _refuse(found, began, step, settings)
    arms_m = np.array([scale.height_m, scale.height_m, 0.5 * scale.width_m])
    sigma[:, :3] = np.hypot(sigma[:, :3], _LEANS * levels[-1] / arms_m)
    return Prealigned(found, {head.name: one for head, one in zip(flight.heads, sigma, strict=True)})


def _refuse(
    found: Mapping[str, Calibration], began: Mapping[str, FloatArray], step: FloatArray, settings: PrealignSettings
) -> None:
    for name, calibration in found.items():
        for parameter in NAMES[:3]:
            turned = calibration.value(parameter) - float(began[name][INDEX[parameter]])
            if abs(turned) > settings.greatest_rad:
                text = f"{parameter.removesuffix('_rad')} moved {np.degrees(turned):.1f}° from its initial value"
                raise PrealignError(f"prealignment of {name}: {text}; check the installation matrix and the mount")
    last = float(np.abs(step[:, :3]).max())
    if last > 10.0 * settings.settled_rad:
        text = f"the last step still turned a scanner by {np.degrees(last):.2f}°"
        raise PrealignError(f"prealignment: does not converge, {text}; use strips that overlap over relief or roofs")


@dataclass(frozen=True, eq=False)
class _Control:
    """Surveyed points (k, 3), and the radius around them in which returns are used."""

    points_t: FloatArray
    reach_m: float


def _levels(scale: Scale, settings: PrealignSettings) -> tuple[float, ...]:
    """Return sigmas of the smoothing, coarse to fine, limited to those that the flight's sizes allow."""
    finest_m = _SMOOTH_POINTS * scale.spacing_m
    if settings.smooth_m is not None:
        return tuple(dict.fromkeys(max(one, finest_m) for one in settings.smooth_m))
    wanted = [share * scale.height_m for share in _SMOOTH_HEIGHTS]
    least, most = _SMOOTH_FINEST_M
    while wanted[-1] > most:
        wanted.append(max(0.5 * wanted[-1], most))
    widest_m = max(_SMOOTH_WIDTHS * scale.width_m, least, finest_m)
    return tuple(dict.fromkeys(min(max(one, least, finest_m), widest_m) for one in wanted))


def _samples(flight: Flight, found: Mapping[str, Calibration], count: int) -> tuple[list[Int64Array], Scale]:
    """Sample last returns evenly where another swath is too, and measure the flight's sizes.

    Of a long line that a short one crosses, only the crossed part is useful. Where no two swaths meet, the samples
    cover whole swaths: a coarse boresight may keep them apart.

    Returns:
        Rising indexes of the returns by swath; and the sizes, whose spacing is that of the thinnest of these samples.
    """
    many = [_last(swath, _OVERSAMPLED * count) for swath in flight.swaths]
    points = [
        flight.place(swath, found[flight.heads[swath.head].name], at)
        for swath, at in zip(flight.swaths, many, strict=True)
    ]
    scale = scale_of(flight, list(zip(many, points, strict=True)))
    there = [np.isfinite(one).all(axis=1) for one in points]
    if scale is None or not all(one.any() for one in there):
        raise PrealignError(f"prealignment: {_NO_POINTS}")
    shared = _shared(points, _OVERLAP_WIDTHS * scale.width_m)
    samples, spacings = [], []
    for at, place, good, here in zip(many, points, there, shared, strict=True):
        taken = np.flatnonzero(good & here if (good & here).any() else good)
        taken = taken[:: max(1, len(taken) // count)]
        samples.append(at[taken])
        spacings.append(area_spacing_m(place[taken]))
    return samples, Scale(scale.height_m, scale.width_m, max(spacings))


def _shared(points: Sequence[FloatArray], cell_m: float) -> list[BoolArray]:
    """Return, by swath, a mask of its points (n, 3) with points of another swath in their or a neighbouring cell."""
    of_swath = []
    for place in points:
        columns, rows = np.floor(np.nan_to_num(place[:, :2]).T / cell_m).astype(np.int64)
        of_swath.append((rows << 32) + columns)
    beside = np.array([(row << 32) + column for row in (-1, 0, 1) for column in (-1, 0, 1)], np.int64)
    wide = [np.unique(np.unique(cells)[:, np.newaxis] + beside) for cells in of_swath]
    keys, swaths = np.unique(np.concatenate(wide), return_counts=True)
    return [np.isin(cells, keys[swaths > 1]) for cells in of_swath]


def _last(swath: Swath, count: int) -> Int64Array:
    """Return rising indexes of last returns, evenly over a swath."""
    at = np.arange(0, len(swath), max(1, len(swath) // count))
    rows = swath.rows[at]
    last: Int64Array = at[rows["return_number"] == rows["number_of_returns"]]
    return last


def _improved(
    flight: Flight,
    placed: list[tuple[FloatArray, FloatArray]],
    found: Mapping[str, Calibration],
    began: Mapping[str, FloatArray],
    smooth_m: float,
    settings: PrealignSettings,
    control: _Control | None,
    share: float,
) -> tuple[dict[str, Calibration], FloatArray, FloatArray] | None:
    """Improve the calibrations by one step, of which only the given share is applied.

    Returns:
        Calibrations, the changes of each head's parameters (h, 4), and their sigmas (h, 4). None: too few cells are in
        two swaths.
    """
    if any(not len(points) for points, _ in placed):
        raise PrealignError(f"prealignment: {_NO_POINTS}")
    lattice = Lattice.over([points for points, _ in placed], smooth_m / _SMOOTH_CELLS, _CELLS_MOST)
    smooth_m = max(smooth_m, lattice.cell_m)
    surfaces = [surface(lattice, points, motion, smooth_m) for points, motion in placed]
    heads = [swath.head for swath in flight.swaths]
    apart, design = _differences(surfaces, heads, len(flight.heads))
    if len(apart) < _CELLS_LEAST:
        return None
    sigma_m, weight = _robust(apart, design)
    alike = max(1.0, 4.0 * np.pi * (smooth_m / lattice.cell_m) ** 2)  # cells that the smoothing merges into one
    normal = (design * weight[:, np.newaxis]).T @ design / (sigma_m**2 * alike)
    right = design.T @ (weight * apart) / (sigma_m**2 * alike)
    if control is not None and len(control.points_t):
        above, rows = _against_control(placed, heads, len(flight.heads), control)
        normal += rows.T @ rows / settings.control_sigma_m**2
        right += rows.T @ above / settings.control_sigma_m**2
    names = [head.name for head in flight.heads]
    away = np.concatenate([[found[name].value(p) - began[name][INDEX[p]] for p in NAMES] for name in names])
    sigmas = np.tile([settings.boresight_sigma_rad] * 3 + [settings.range_sigma_m], len(names))
    held = [p in settings.held or f"{name}.{p}" in settings.held for name in names for p in NAMES]
    prior = np.where(held, _HELD, sigmas) ** -2.0
    step = -np.linalg.solve(normal + np.diag(prior), right + prior * away).reshape(-1, len(NAMES))
    sigma = np.sqrt(np.diag(np.linalg.inv(normal + np.diag(prior)))).reshape(-1, len(NAMES))
    step *= share * min(1.0, _STEP_MOST_RAD / max(float(np.abs(step[:, :3]).max()), 1e-12))
    better = {
        name: found[name].changed(**{p: found[name].value(p) + float(by) for p, by in zip(NAMES, one, strict=True)})
        for name, one in zip(names, step, strict=True)
    }
    return {**found, **better}, step, sigma


def _damping(last: FloatArray, step: FloatArray) -> float:
    """Return the factor for the next step's share: a half if this step reversed most of the last one.

    On a fine level a few edges decide, and they differ before and after a step, so full steps would oscillate.
    """
    back = -float(np.sum(last[:, :3] * step[:, :3]))
    return 0.5 if back > _BACK * float(np.sum(last[:, :3] ** 2)) > 0.0 else 1.0


def _motion(flight: Flight, swath: Swath, at: Int64Array, found: Mapping[str, Calibration]) -> FloatArray:
    """Return the motion (4, n, 3) of returns' points with each parameter; it changes little over the iterations."""
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
    """Return points (m, 3) of the returns that can be placed, and their motion (4, m, 3)."""
    points = flight.place(swath, found[flight.heads[swath.head].name], at)
    there = np.isfinite(points).all(axis=1) & np.isfinite(motion).all(axis=(0, 2))
    return points[there], motion[:, there]


def _differences(surfaces: list[Surface], heads: list[int], count: int) -> tuple[FloatArray, FloatArray]:
    """Return heights of one swath above another (m,) in all cells that two share, and their derivatives (m, u)."""
    apart, design = [], []
    for one, other in combinations(range(len(surfaces)), 2):
        first, second = surfaces[one], surfaces[other]
        _, a, b = np.intersect1d(first.cells, second.cells, assume_unique=True, return_indices=True)
        rows = np.zeros((len(a), count, len(NAMES)))
        rows[:, heads[one]] += first.change[a]
        rows[:, heads[other]] -= second.change[b]
        apart.append(first.height_m[a] - second.height_m[b])
        design.append(rows.reshape(len(a), count * len(NAMES)))
    return np.concatenate(apart), np.concatenate(design)


def _robust(apart: FloatArray, design: FloatArray) -> tuple[float, FloatArray]:
    """Return the sigma of a difference after the parameters are corrected, and robust weights (m,).

    Objects that only one strip sees, such as trees and surfaces hidden by walls, get low weights (Huber 1981).
    """
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
    placed: list[tuple[FloatArray, FloatArray]], heads: list[int], count: int, control: _Control
) -> tuple[FloatArray, FloatArray]:
    """Return heights of swaths above control points (m,), and their derivatives by all unknowns (m, u)."""
    above, design = [np.zeros(0)], [np.zeros((0, count * len(NAMES)))]
    for (points, motion), head in zip(placed, heads, strict=True):
        near = cKDTree(points[:, :2]).query_ball_point(control.points_t[:, :2], control.reach_m)
        for place, at in zip(control.points_t, near, strict=True):
            if len(at) >= _CONTROL_POINTS:
                row = np.zeros((count, len(NAMES)))
                row[head] = np.median(motion[:, at, 2], axis=1)
                above.append(np.array([np.median(points[at, 2]) - place[2]]))
                design.append(row.reshape(1, -1))
    return np.concatenate(above), np.concatenate(design)


@dataclass(frozen=True, slots=True)
class Lattice:
    """A grid of square cells over all swaths: west, south, metres per cell, rows and columns."""

    west: float
    south: float
    cell_m: float
    rows: int
    columns: int

    @classmethod
    def over(cls, points: list[FloatArray], cell_m: float, most: int) -> Lattice:
        """Create a lattice that covers all points (n, 3); cells grow until there are at most ``most`` of them."""
        low = np.min([np.min(one[:, :2], axis=0) for one in points], axis=0)
        high = np.max([np.max(one[:, :2], axis=0) for one in points], axis=0)
        east, north = high - low
        cell_m = max(cell_m, float(np.sqrt(east * north / most)))
        west, south = (float(np.floor(value / cell_m)) * cell_m for value in low)
        return cls(west, south, cell_m, int(north / cell_m) + 2, int(east / cell_m) + 2)

    def cells(self, points: FloatArray) -> tuple[Int64Array, BoolArray]:
        """Return cells (n,) of points, and whether the points are on the lattice."""
        column = np.floor((points[:, 0] - self.west) / self.cell_m).astype(np.int64)
        row = np.floor((points[:, 1] - self.south) / self.cell_m).astype(np.int64)
        inside = (column >= 0) & (row >= 0) & (column < self.columns) & (row < self.rows)
        return np.where(inside, row * self.columns + column, 0), inside


@dataclass(frozen=True, eq=False)
class Surface:
    """A swath's heights on a lattice.

    Attributes:
        cells: (c,) cells that are well supported, rising.
        height_m: (c,).
        change: (c, p) of the height with each parameter.
    """

    cells: Int64Array
    height_m: FloatArray
    change: FloatArray


def surface(lattice: Lattice, points: FloatArray, motion: FloatArray, smooth_m: float) -> Surface:
    """Build the surface of points (n, 3) and their motion with p parameters (p, n, 3).

    A Gaussian with a sigma of ``smooth_m`` metres smooths the heights.
    """
    cell, inside = lattice.cells(points)
    cell, points, motion = cell[inside], points[inside], motion[:, inside]
    rows, columns = np.divmod(cell, lattice.columns)
    margin = int(np.ceil(_REACH * smooth_m / lattice.cell_m)) + 1
    row0, column0 = max(int(rows.min()) - margin, 0), max(int(columns.min()) - margin, 0)
    shape = (
        min(int(rows.max()) + margin, lattice.rows - 1) - row0 + 1,
        min(int(columns.max()) + margin, lattice.columns - 1) - column0 + 1,
    )
    at = (rows - row0) * shape[1] + columns - column0
    base = float(np.median(points[:, 2]))

    def smoothed(weights: FloatArray | None) -> FloatArray:
        total = np.bincount(at, weights, minlength=shape[0] * shape[1]).reshape(shape).astype(np.float64)
        out: FloatArray = gaussian_filter(total, smooth_m / lattice.cell_m, mode="constant", truncate=_REACH)
        return out

    count = np.maximum(smoothed(None), 1e-12)
    filled = (np.bincount(at, minlength=shape[0] * shape[1]) > 0).reshape(shape).astype(np.float64)
    support = gaussian_filter(filled, smooth_m / lattice.cell_m, mode="constant", truncate=_REACH)
    height = smoothed(points[:, 2] - base) / count
    slope_y, slope_x = (axis.ravel()[at] for axis in np.gradient(height, lattice.cell_m))
    change = [smoothed(one[:, 2] - slope_x * one[:, 0] - slope_y * one[:, 1]) / count for one in motion]
    good = support >= SUPPORT * np.percentile(support[filled > 0.0], _TYPICAL)
    row, column = np.nonzero(good)
    cells = (row + row0) * lattice.columns + column + column0
    return Surface(cells, height[good] + base, np.stack([one[good] for one in change], axis=1))
