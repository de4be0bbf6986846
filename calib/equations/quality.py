"""Assess an adjustment: residuals and their redundancy, by group and by control point (FORMULAS 6.5).

Residuals are those of the misclosures, e = −(w + A δ) at the last linearisation; r = 1 − A Q Aᵀ / M with the cofactors
of parameters, trajectory states and features together (Baarda 1968; Förstner 1979 for groups). M covers all errors of a
return, also those that it shares with the other returns of its moment; `swath.calib.equations.sums.inspect` explains
which part of A Q Aᵀ then counts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from swath.calib.equations.normals import Extra, Feature, Normals, TrajectoryWeight, extras
from swath.calib.equations.robust import least_detectable
from swath.calib.equations.rows import Batch, Rows, Run, State
from swath.calib.equations.tables import OF_PLANE
from swath.calib.equations.tie_rows import Seen, Ties
from swath.calib.outcome import ControlFit, GroupFit, Residuals, TrajectoryFit
from swath.georef.arrays import FloatArray, SingleArray

BLOCK = 1 << 20  # residuals that are summed at a time


@dataclass(frozen=True, eq=False)
class Quality:
    """The quality of an adjustment.

    Attributes:
        residuals, groups, control: see `swath.calib.outcome.Adjusted`.
        square, redundancy: Σ p e², and its expectation.
        least_detectable: by name.
    """

    residuals: tuple[Residuals, ...]
    groups: tuple[GroupFit, ...]
    control: tuple[ControlFit, ...]
    square: float
    redundancy: float
    least_detectable: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Solution:
    """A converged adjustment, with the matrices that its assessment needs.

    Attributes:
        rows, ties, trajectory: observations.
        state: state at which the equations are linearised.
        normals: equations; covariance: (u, u) of parameters and states.
        row_weight, tie_weight: of rows and sightings; 0: rejected.
    """

    rows: Rows
    ties: Ties
    trajectory: TrajectoryWeight
    state: State
    normals: Normals
    covariance: FloatArray
    row_weight: SingleArray
    tie_weight: SingleArray

    @property
    def parameters(self) -> FloatArray:
        """Covariance (p, p) of the parameters."""
        return self.covariance[: self.normals.parameters, : self.normals.parameters]


def examine(solution: Solution) -> Quality:
    """Compute the quality of a solution in one pass over the rows."""
    on_planes, detectable = _on_planes(solution)
    on_ties, tie_square = _on_ties(solution)
    controls = _controls(solution)
    residuals = [one for one in (on_planes, on_ties, controls.residuals) if len(one.misclosure_m)]
    groups = [_fit(one, tie_square if one is on_ties else None) for one in residuals]
    groups += [fit for fit in _pseudo(solution) if fit.observations]
    square = sum(fit.variance_factor * fit.redundancy for fit in groups)
    redundancy = sum(fit.redundancy for fit in groups)
    if len(on_ties.misclosure_m):
        detectable["ties"] = _typical(least_detectable(on_ties.sigma_m**2, on_ties.redundancy))
    if len(controls.residuals.misclosure_m):
        mine = controls.residuals
        detectable["control"] = _typical(least_detectable(mine.sigma_m**2, mine.redundancy))
    return Quality(tuple(residuals), tuple(groups), controls.fits, square, redundancy, detectable)


def trajectory_fit(solution: Solution) -> TrajectoryFit | None:
    """Return the estimated corrections of the trajectory in north, east, down; None without a prior."""
    prior, p = solution.rows.prior, solution.normals.parameters
    if prior is None:
        return None
    states = solution.trajectory.to_l(solution.state.knots.reshape(-1, 1)).reshape(-1, 2, 3)
    sigmas = np.sqrt(solution.trajectory.variances_l(solution.covariance[p:, p:])).reshape(-1, 2, 3)
    before = np.sqrt(np.diag(prior.covariance)).reshape(-1, 2, 3)
    columns = (states[:, 0], states[:, 1], sigmas[:, 0], sigmas[:, 1], before[:, 0], before[:, 1])
    return TrajectoryFit(prior.trajectory_index, prior.time_ns, prior.strip, *columns)


def _on_planes(solution: Solution) -> tuple[Residuals, dict[str, float]]:
    rows, count = solution.rows, solution.rows.count
    table = _room("planes", count)
    ranges = []
    known = [_of_feature(solution.covariance, feature) for feature in solution.normals.planes]
    weights = solution.row_weight
    for batch, looks in rows.looks(solution.state, lambda batch: _cofactors(solution, batch, known), weights):
        mine = slice(batch.begin, batch.begin + batch.size)
        weight = weights[mine].astype(np.float64)
        with np.errstate(invalid="ignore"):
            redundancy = 1.0 - weight * looks.spread / looks.variance
            spread = looks.variance - np.where(weight > 0.0, 1.0, -1.0) * looks.spread
            normalised = -looks.misclosure / np.sqrt(np.maximum(spread, 1e-9 * looks.variance))
        table.feature[mine] = np.repeat([run.plane for run in batch.runs], [len(run.at) for run in batch.runs])
        table.swath[mine] = batch.swath
        table.at[mine] = np.concatenate([run.at for run in batch.runs])
        lost = ~np.isfinite(looks.misclosure)
        table.misclosure_m[mine], table.sigma_m[mine] = -looks.misclosure, np.sqrt(looks.variance)
        table.redundancy[mine], table.normalised[mine] = redundancy, np.where(lost, 0.0, normalised)
        table.weight[mine] = np.where(lost, 0.0, weight)
        ranges.append(_typical(least_detectable(looks.variance, redundancy) / np.abs(looks.along)))
    return table, {"range_m": float(np.mean(ranges))} if ranges else {}


def _room(group: str, count: int) -> Residuals:
    """Allocate residuals in single precision: ten million rows take a third of a gigabyte."""
    single: list[Any] = [np.zeros(count, np.float32) for _ in range(5)]
    feature: Any = np.zeros(count, np.int32)
    swath: Any = np.zeros(count, np.int32)
    return Residuals(group, feature, swath, np.zeros(count, np.int64), *single)


def _typical(errors: FloatArray) -> float:
    """Return the median of the finite values; inf if there are none."""
    found = errors[np.isfinite(errors)]
    return float(np.median(found)) if len(found) else float("inf")


def _of_feature(covariance: FloatArray, feature: Feature) -> tuple[FloatArray, FloatArray]:
    """Return the cofactors of a feature's unknowns with its own parameters (m, 3), and of the latter (3, 3)."""
    half = feature.mixed @ feature.inverse
    mixed = -covariance[np.ix_(feature.unknowns, feature.unknowns)] @ half
    return mixed, feature.inverse - half.T @ mixed


def _cofactors(solution: Solution, batch: Batch, known: Sequence[tuple[FloatArray, FloatArray]]) -> FloatArray:
    """Return the cofactors (g, c, c) of the runs' columns; ``known`` holds `_of_feature` of all planes."""
    made = [_cofactor(solution, run, *known[run.plane]) for run in batch.runs]
    widest = max(len(one) for one in made)
    table = np.zeros((len(made), widest, widest))
    for place, one in enumerate(made):
        table[place, : len(one), : len(one)] = one
    return table


def _cofactor(solution: Solution, run: Run, mixed: FloatArray, own: FloatArray) -> FloatArray:
    rows, feature = solution.rows, solution.normals.planes[run.plane]
    unknowns, expanded = rows.expansion(run, solution.state.normal_e[run.plane])
    p = len(rows.unknowns)
    knots = [rows.places[run.plane, knot] for knot in (run.before, run.after) if knot >= 0]
    mine = np.concatenate([unknowns[unknowns < p], *(p + 6 * knot + np.arange(6) for knot in knots)])
    at = feature.unknowns[mine]
    size = expanded.shape[1]
    whole = np.empty((size + OF_PLANE, size + OF_PLANE))
    whole[:size, :size] = expanded.T @ solution.covariance[np.ix_(at, at)] @ expanded
    whole[:size, size:] = expanded.T @ mixed[mine]
    whole[size:, :size], whole[size:, size:] = whole[:size, size:].T, own
    return whole


def _on_ties(solution: Solution) -> tuple[Residuals, float]:
    """Return the residuals of sightings, and Σ eᵀ W e, because the coordinates of a sighting are correlated."""
    ties, square = solution.ties, 0.0
    rot = ties.rows.flight.frame.rot_t_from_e
    columns: list[tuple[FloatArray, ...]] = []
    where, weights = [], solution.tie_weight.tolist()  # Python floats: a sum of float32 cannot be written as JSON
    for (tie, sighting), seen, weight in zip(ties.order, ties.seen(solution.state), weights, strict=True):
        where += [(tie, sighting.swath, sighting.at)] * 3
        if seen is None:
            columns.append((np.full(3, np.nan), np.ones(3), np.zeros(3), np.zeros(3), np.zeros(3)))
            continue
        spread = rot @ _tie_spread(solution, seen) @ rot.T
        covariance, error = rot @ seen.covariance_e @ rot.T, -(rot @ seen.misclosure_e)
        inverse = np.linalg.inv(covariance)
        square += weight * float(error @ inverse @ error)
        left = covariance - spread if weight > 0.0 else covariance + spread
        free = np.diag(np.eye(3) - spread @ inverse) if weight > 0.0 else np.ones(3)
        test = inverse @ error / np.sqrt(np.maximum(np.diag(inverse @ left @ inverse), 1e-12 * np.diag(inverse)))
        columns.append((error, np.sqrt(np.diag(covariance)), free, test, np.full(3, weight)))
    floats = [np.concatenate(column) for column in zip(*columns, strict=True)] or [np.zeros(0)] * 5
    return Residuals("ties", *np.array(where, dtype=np.int64).reshape(-1, 3).T, *floats), square


def _tie_spread(solution: Solution, seen: Seen) -> FloatArray:
    """Return A Q Aᵀ (3, 3) of a sighting."""
    feature = solution.normals.ties[seen.tie]
    mixed, own = _of_feature(solution.covariance, feature)
    inner = solution.covariance[np.ix_(seen.unknowns, seen.unknowns)]
    at = np.searchsorted(feature.unknowns, seen.unknowns)
    crossed = seen.design @ mixed[at]
    spread: FloatArray = seen.design @ inner @ seen.design.T - crossed - crossed.T + own
    return spread


@dataclass(frozen=True, eq=False)
class _Controls:
    residuals: Residuals
    fits: tuple[ControlFit, ...]


def _controls(solution: Solution) -> _Controls:
    """Return the residuals and fits of control on planes, of surveyed planes and of surveyed tie points."""
    columns, where, fits = [], [], []
    for extra in extras(solution.rows, solution.state):
        feature = solution.normals.planes[extra.plane]
        mixed, own = _of_feature(solution.covariance, feature)
        free = 1.0 - float(extra.design @ own @ extra.design)
        test = -extra.misclosure / np.sqrt(max(free, 1e-9))
        columns.append((-extra.misclosure * extra.sigma, extra.sigma, free, test, 1.0))
        where.append((extra.plane, -1, -1))
        if extra.point >= 0:
            fits.append(_control_fit(solution, extra, mixed @ extra.design, free))
    for tie, given in ((tie, solution.ties.control(tie)) for tie in range(len(solution.ties.ties))):
        if given is None:
            continue
        own = _of_feature(solution.covariance, solution.normals.ties[tie])[1]
        rot = solution.rows.flight.frame.rot_t_from_e
        away, spread, sigma = rot @ (given[0] - solution.state.ties_e[tie]), rot @ own @ rot.T, rot @ given[1] @ rot.T
        for axis in range(3):
            root = float(np.sqrt(sigma[axis, axis]))
            free = 1.0 - float(spread[axis, axis]) / root**2
            test = float(away[axis]) / (root * np.sqrt(max(free, 1e-9)))
            columns.append((float(away[axis]), root, free, test, 1.0))
            where.append((tie, -1, -1))
        name = solution.ties.ties[tie].name
        fits.append(ControlFit(name, float(away[2]), columns[-1][1], columns[-1][3]))
    floats = [np.array(column, dtype=np.float64) for column in zip(*columns, strict=True)] or [np.zeros(0)] * 5
    residuals = Residuals("control", *np.array(where, dtype=np.int64).reshape(-1, 3).T, *floats)
    return _Controls(residuals, tuple(fits))


def _control_fit(solution: Solution, extra: Extra, mixed: FloatArray, free: float) -> ControlFit:
    """Return the fit of a control point on a plane, with the change that leaving it out would cause.

    That change is δ₋ᵢ − δ = Q Aᵢᵀ w / r, in sigmas.
    """
    plane = solution.rows.planes[extra.plane]
    change = np.zeros(solution.rows.size)
    change[solution.normals.planes[extra.plane].unknowns] = mixed * (extra.misclosure / max(free, 1e-9))
    p = solution.normals.parameters
    inner = change[:p] / np.sqrt(np.diag(solution.parameters))
    influence = dict(zip(solution.rows.unknowns.names, inner.tolist(), strict=True))
    up = abs(float((solution.rows.flight.frame.rot_t_from_e @ solution.state.normal_e[extra.plane])[2]))
    upright = up if up > 0.3 else 1.0
    test = extra.misclosure / np.sqrt(max(free, 1e-9))
    metres = extra.misclosure * extra.sigma / upright
    return ControlFit(plane.control[extra.point].name, metres, extra.sigma / upright, float(test), influence)


def _pseudo(solution: Solution) -> list[GroupFit]:
    """Return the priors of parameters and of the trajectory as groups of observations."""
    p, values = solution.normals.parameters, solution.state.values
    design, misclosure = solution.rows.unknowns.pseudo(values)
    used = float(np.einsum("ij,jk,ik->", design, solution.parameters, design))
    fits = [_group("priors", len(design), len(design) - used, float(misclosure @ misclosure), 0.0)]
    states, normal = solution.state.knots.reshape(-1), solution.trajectory.normal
    used = float((normal * solution.covariance[p:, p:]).sum())
    square = float(states @ normal @ states)
    return [*fits, _group("trajectory", len(states), len(states) - used, square, 0.0)]


def _fit(residuals: Residuals, square: float | None) -> GroupFit:
    sums = np.zeros(5)  # kept observations, redundancy, Σ p (e / σ)², Σ e², rejected
    for begin in range(0, len(residuals.weight), BLOCK):
        mine = slice(begin, begin + BLOCK)
        kept = residuals.weight[mine] > 0.0
        columns = residuals.misclosure_m, residuals.sigma_m, residuals.redundancy, residuals.weight
        error, sigma, free, weight = (column[mine][kept].astype(np.float64) for column in columns)
        sums += kept.sum(), free.sum(), (weight * (error / sigma) ** 2).sum(), (error**2).sum(), (~kept).sum()
    count, redundancy, squares, errors, rejected = sums.tolist()
    rms = float(np.sqrt(errors / count)) if count else 0.0
    every, rejects = int(count + rejected), int(rejected)
    return _group(residuals.group, every, redundancy, squares if square is None else square, rms, rejects)


def _group(name: str, count: int, redundancy: float, square: float, rms: float, rejected: int = 0) -> GroupFit:
    """Return the fit of a group with its variance component Σ p e² / Σ r (Förstner 1979)."""
    factor = square / redundancy if redundancy > 1e-9 else 1.0
    return GroupFit(name, count, redundancy, factor, rms, rejected)
