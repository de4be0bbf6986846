"""Explain the differences between strips by the calibration's parameters that would remove them (FORMULAS 5.3).

A difference of two strips on a plane is the sum of their errors there, along the plane's normal. Each effect moves
points in its own way with scan angle, flight direction, scan direction, range and speed. The size of each effect in the
differences is estimated together with the trajectory's errors at knots along the strips, whose joint covariance is
known beforehand: differences that these errors explain are not attributed to the calibration. Errors that neighbouring
strips share, or all of a flight, look like a boresight error, and only the joint covariance separates them from one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import csr_array

from swath.calib.equations.trajectory_prior import ERRORS, Taus, TrajectoryPrior, gauss_markov_at, knots_within
from swath.calib.flight import FlightError
from swath.calib.labels import with_sigma
from swath.calib.strips.differences import Checks
from swath.calib.strips.effects import EFFECTS, NAMES, Effect, SeenFrom, effect_columns, error_columns
from swath.georef.arrays import BoolArray, FloatArray, Int64Array
from swath.georef.geodesy.earth import geodetic_from_e, rot_e_from_l
from swath.georef.geodesy.rotations import rot_from_quaternion
from swath.georef.trajectory.trajectory import Trajectory

SIGNIFICANT = 3.29  # sigmas; one in a thousand by chance
MATTERS_M = 0.01  # on the ground, at the swath's edge
TELLS_M = 0.02  # at the edge, one sigma: effects that are less certain are not reported
TELLS = 1.5  # or this multiple of the error that the trajectory's attitude leaves in the best of flights
NOT_APART = 5.0  # factor by which another effect's sigma may grow
ROUGH_M = 0.3  # RMS of the differences: above, planes of one cell may be different surfaces, and effects are not linear
MOST_ROWS = 12_000
MOST_KNOTS, KNOT_S = 300, 1.0  # of a trajectory without a joint covariance
POSITION_SIGMA_M, ATTITUDE_SIGMA_DEG = 0.05, (0.005, 0.005, 0.01)  # of trajectories without sigmas
# Shares of a trajectory's sigmas: half of the variance of roll and pitch lasts for the whole flight, because
# accelerometers' biases tilt it, and a fifth of the heading's; the rest fades as fast as a tactical unit's gyroscopes
# walk. A smoothed flight with such a unit has up to 0.46 of its pitch in common between any two strips, and up to 0.24
# of its roll.
ASSUMED = Taus(position_s=60.0, roll_pitch_s=10.0, heading_s=20.0, lasting_tilt=0.5, lasting_heading=0.2)


@dataclass(frozen=True, slots=True)
class Signature:
    """The estimate of one effect in the residuals.

    Attributes:
        effect: the effect.
        value, sigma: to be added to the parameter to remove it, SI; nan: not determined.
        edge_m: movement by the value at the swaths' edges.
        level: ``none``, ``small``, ``significant``, ``not told``, ``rough``.
        words: the verdict, one sentence.
    """

    effect: Effect
    value: float
    sigma: float
    edge_m: float
    level: str
    words: str


@dataclass(frozen=True, eq=False)
class Signatures:
    """Estimates of all effects, and the part of the differences that they and the trajectory's errors explain.

    Attributes:
        found: one per effect, in the order of `EFFECTS`.
        rows: number of differences used.
        rms_m, left_rms_m: of the differences, before and after.
        variance_factor: of the remaining differences, against their noise.
        prior_notes: source of the covariance of the trajectory's errors.
    """

    found: tuple[Signature, ...]
    rows: int
    rms_m: float
    left_rms_m: float
    variance_factor: float
    prior_notes: tuple[str, ...] = ()

    @property
    def rough(self) -> bool:
        """True if the strips are too far apart for an estimate of effects."""
        return any(one.level == "rough" for one in self.found)

    @property
    def lines(self) -> list[str]:
        """The verdicts for display: one line per effect, or a single line if strips are too far apart."""
        return list(dict.fromkeys(one.words for one in self.found))


def signatures(
    checks: Checks, seen: SeenFrom, prior: TrajectoryPrior | None = None, *, most_rows: int = MOST_ROWS
) -> Signatures:
    """Estimate every effect that the differences determine.

    Args:
        checks: of `swath.calib.strips.differences`, points in t.
        seen: the places from which they were seen.
        prior: joint covariance of the trajectory's errors, knots of the trajectories in the order of
            ``seen.trajectories`` (`swath.calib.equations.trajectory_prior.from_smoother`); None: `assumed_prior`.
        most_rows: greatest number of checks used, drawn evenly.
    """
    checks = checks.take(_known(checks, seen))
    if len(checks) > most_rows:
        checks = checks.take(np.random.default_rng(6_7).choice(len(checks), most_rows, replace=False))
    if len(checks) < 10:
        few = tuple(_not_told(effect, "too few differences") for effect in EFFECTS)
        return Signatures(few, len(checks), math.nan, math.nan, math.nan)
    rms_m = float(np.sqrt(np.mean(checks.distance_m**2)))
    if rms_m > ROUGH_M:
        words = (
            f"rough: strips differ by {rms_m:.2f} m (RMS point to plane), too much to find the cause; run swath "
            "calibrate"
        )
        rough = tuple(Signature(effect, math.nan, math.nan, math.nan, "rough", words) for effect in EFFECTS)
        return Signatures(rough, len(checks), rms_m, math.nan, math.nan)
    prior = assumed_prior(checks, seen) if prior is None else prior
    design, errors, edges = _design(checks, seen, prior)
    fit = _Fit(design, errors, prior.information, checks.distance_m, checks.noise_m)
    taken, refused = _choose(fit, edges, _worst_m(prior, seen, edges))
    values, sigmas = fit.solve(taken)
    found = []
    for number, effect in enumerate(EFFECTS):
        if number in refused:
            found.append(_not_told(effect, refused[number]))
        else:
            at = taken.index(number)
            found.append(_told(effect, float(values[at]), float(sigmas[at]), float(edges[number])))
    return Signatures(tuple(found), len(checks), rms_m, fit.left_rms_m, fit.variance_factor, prior.notes)


def _known(checks: Checks, seen: SeenFrom) -> BoolArray:
    """Return a mask of the rows for which both strips' trajectories are known."""
    known = np.ones(len(checks), bool)
    for strip, time_ns in ((checks.first, checks.point_ns), (checks.second, checks.centre_ns)):
        for number in np.unique(strip):
            own = strip == number
            known[own] &= seen.trajectories[seen.trajectory_index[number]].fates(time_ns[own]) == 0
    return known


# ---------------------------------------------------------------------- the trajectory's errors


def assumed_prior(checks: Checks, seen: SeenFrom) -> TrajectoryPrior:
    """Return the covariance of trajectories' errors from their sigmas and from usual correlation times.

    Errors fade according to `ASSUMED`, whose lasting shares are on the safe side: a larger share makes larger sigmas of
    the boresight. Trajectories without sigmas get `POSITION_SIGMA_M` and `ATTITUDE_SIGMA_DEG`.
    """
    spans = _spans(checks, seen)
    trajectories = [_with_sigmas(trajectory) for trajectory in seen.trajectories]
    prior = gauss_markov_at(knots_within(spans, KNOT_S, MOST_KNOTS), trajectories, ASSUMED)
    lasting = f"{100 * ASSUMED.lasting_tilt:.0f} % of roll and pitch, {100 * ASSUMED.lasting_heading:.0f} % of heading"
    note = f"trajectory errors follow its sigmas; share assumed to last the whole flight: {lasting}"
    return replace(prior, notes=(note,))


def _spans(checks: Checks, seen: SeenFrom) -> list[tuple[int, int, int, int]]:
    """Return (trajectory, number, begin, end) of stretches with checks; overlapping stretches are joined."""
    strip = np.concatenate([checks.first, checks.second])
    time_ns = np.concatenate([checks.point_ns, checks.centre_ns])
    own = sorted(
        (seen.trajectory_index[number], int(time_ns[strip == number].min()), int(time_ns[strip == number].max()))
        for number in np.unique(strip).tolist()
    )
    joined: list[tuple[int, int, int]] = []
    for trajectory_index, begin, end in own:
        if joined and joined[-1][0] == trajectory_index and begin <= joined[-1][2]:
            joined[-1] = (trajectory_index, joined[-1][1], max(end, joined[-1][2]))
        else:
            joined.append((trajectory_index, begin, end))
    return [
        (trajectory_index, number, begin, max(end, begin + 1))
        for number, (trajectory_index, begin, end) in enumerate(joined)
    ]


def _with_sigmas(trajectory: Trajectory) -> Trajectory:
    position, attitude = trajectory.position_sigma_l, trajectory.attitude_sigma_rad
    return replace(
        trajectory,
        position_sigma_l=np.where(np.isfinite(position), position, POSITION_SIGMA_M),
        attitude_sigma_rad=np.where(np.isfinite(attitude), attitude, np.radians(ATTITUDE_SIGMA_DEG)),
    )


# ---------------------------------------------------------------------- columns


def _design(checks: Checks, seen: SeenFrom, prior: TrajectoryPrior) -> tuple[FloatArray, csr_array, FloatArray]:
    """Return the derivatives of the differences by the corrections that would remove them.

    Returns:
        (n, effects); (n, 6 knots) for the trajectory's errors, linear between knots; and by effect (effects,) the
        movement per unit at the swaths' edges.
    """
    sides = (
        (checks.point, checks.first, checks.point_ns, checks.point_direction, 1.0),
        (checks.centre, checks.second, checks.centre_ns, checks.centre_direction, -1.0),
    )
    count = len(checks)
    design, edges = np.zeros((count, len(EFFECTS))), np.zeros(len(EFFECTS))
    values, rows, columns = [], [], []
    for points_t, strip, time_ns, direction, sign in sides:
        moved, _ = effect_columns(points_t, strip, time_ns, direction, seen)
        design -= sign * np.einsum("nki,ni->nk", moved, checks.normal)
        edges = np.maximum(edges, np.percentile(np.linalg.norm(moved, axis=2), 95.0, axis=0))
        own = -sign * np.einsum("nki,ni->nk", error_columns(points_t, strip, time_ns, seen), checks.normal)
        for knot, share in _shares(prior, np.asarray(seen.trajectory_index)[strip], time_ns):
            values.append(share[:, np.newaxis] * own)
            rows.append(np.repeat(np.arange(count), ERRORS).reshape(count, ERRORS))
            columns.append(ERRORS * knot[:, np.newaxis] + np.arange(ERRORS))
    entries = np.concatenate(values).ravel(), (np.concatenate(rows).ravel(), np.concatenate(columns).ravel())
    return design, csr_array(entries, shape=(count, ERRORS * len(prior))), edges


def _shares(
    prior: TrajectoryPrior, trajectory_index: Int64Array, time_ns: Int64Array
) -> tuple[tuple[Int64Array, FloatArray], tuple[Int64Array, FloatArray]]:
    """Return the knots (n,) before and after each moment, and each knot's share in the error at that moment."""
    before, after = np.zeros(len(time_ns), np.int64), np.zeros(len(time_ns), np.int64)
    for number in np.unique(trajectory_index):
        own, knots = trajectory_index == number, np.flatnonzero(prior.trajectory_index == number)
        if not len(knots):
            raise FlightError(f"trajectory errors: the covariance has no knot of trajectory {number + 1}")
        at = np.searchsorted(prior.time_ns[knots], time_ns[own])
        before[own], after[own] = knots[np.maximum(at - 1, 0)], knots[np.minimum(at, len(knots) - 1)]
    apart = np.maximum((prior.time_ns[after] - prior.time_ns[before]).astype(np.float64), 1.0)
    later = np.clip((time_ns - prior.time_ns[before]).astype(np.float64) / apart, 0.0, 1.0)
    return (before, 1.0 - later), (after, later)


# ---------------------------------------------------------------------- estimation


class _Fit:
    """Robust least squares of differences on chosen effects and the trajectory's errors."""

    def __init__(
        self, design: FloatArray, errors: csr_array, information: FloatArray, values: FloatArray, noise: FloatArray
    ) -> None:
        self._design, self._errors, self._information = design, errors, information
        self._values, self._noise = values, noise
        self._plain: FloatArray | None = None
        self.left_rms_m, self.variance_factor = math.nan, math.nan

    def sigmas(self, taken: Sequence[int]) -> FloatArray:
        """Return the sigmas (effects taken,) due to the noise and the trajectory's errors alone."""
        if self._plain is None:
            self._plain = self._reduced(np.ones(len(self._values)))[0]
        return _roots_of_inverse(self._plain[np.ix_(taken, taken)])

    def solve(self, taken: Sequence[int]) -> tuple[FloatArray, FloatArray]:
        """Return values and sigmas (effects taken,), with Huber's weights and the variance factor if it is above 1."""
        huber = np.ones(len(self._values))
        design = self._design[:, taken]
        for _ in range(5):
            normal, right, factor, mixed, below = self._reduced(huber)
            normal = normal[np.ix_(taken, taken)]
            found = np.asarray(np.linalg.solve(normal, right[taken]), np.float64) if taken else np.zeros(0)
            errors = cho_solve(factor, below - mixed[:, taken] @ found)
            misfits = (self._values - design @ found - self._errors @ errors) / self._noise
            spread = max(1.4826 * float(np.median(np.abs(misfits))), 1.0)
            huber = np.minimum(1.0, 1.5 * spread / np.maximum(np.abs(misfits), 1e-9))
        self.left_rms_m = float(np.sqrt(np.mean((misfits * self._noise) ** 2)))
        self.variance_factor = float((huber * misfits**2).sum()) / max(len(misfits) - len(taken), 1)
        return found, _roots_of_inverse(normal) * max(1.0, math.sqrt(self.variance_factor))

    def _reduced(
        self, huber: FloatArray
    ) -> tuple[FloatArray, FloatArray, tuple[FloatArray, bool], FloatArray, FloatArray]:
        """Return the equations of the effects with the trajectory's errors eliminated (Schur complement).

        Returns:
            (e, e) matrix, (e,) right side; and of the errors the factor, (k, e) mixed part and (k,) right side.
        """
        weights = huber / self._noise**2
        weighted = self._errors.multiply(weights[:, np.newaxis]).tocsr()
        inner = np.asarray((weighted.T @ self._errors).todense()) + self._information
        mixed, below = weighted.T @ self._design, weighted.T @ self._values
        factor = cho_factor(inner, lower=True, overwrite_a=True, check_finite=False)
        solved = cho_solve(factor, np.column_stack([mixed, below]), check_finite=False)
        own = self._design * weights[:, np.newaxis]
        normal = own.T @ self._design - mixed.T @ solved[:, :-1]
        return normal, own.T @ self._values - mixed.T @ solved[:, -1], factor, mixed, below


def _roots_of_inverse(normal: FloatArray) -> FloatArray:
    """Return the sigmas of a normal matrix; those of undetermined unknowns are very large."""
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    scaled = normal / np.outer(scale, scale)
    values, vectors = np.linalg.eigh(scaled)
    inverse = (vectors**2 / np.maximum(values, 1e-14)).sum(axis=1)
    return np.asarray(np.sqrt(inverse) / scale)


def _worst_m(prior: TrajectoryPrior, seen: SeenFrom, edges: FloatArray) -> float:
    """Return the largest sigma, at the swath's edge, of an effect that is still reported.

    The limit accounts for the attitude error that remains even in the best of flights.
    """
    row = np.zeros((len(prior), ERRORS))
    for number in np.unique(prior.trajectory_index):
        own = prior.trajectory_index == number
        trajectory = seen.trajectories[number]
        at = np.clip(np.searchsorted(trajectory.time_ns, prior.time_ns[own]), 0, len(trajectory) - 1)
        right_e = rot_from_quaternion(trajectory.q_e_from_b[at])[:, :, 1]
        lat, lon, _ = geodetic_from_e(trajectory.position_e[at])
        row[own, 3:] = np.einsum("nij,ni->nj", rot_e_from_l(lat, lon), right_e) / len(prior)
    pitch = math.sqrt(float(row.ravel() @ prior.covariance @ row.ravel()))
    return max(TELLS_M, TELLS * pitch * float(edges[NAMES.index("pitch")]))


def _choose(fit: _Fit, edges: FloatArray, worst_m: float) -> tuple[list[int], dict[int, str]]:
    """Return the effects that the differences separate, and the reasons against the others."""
    taken: list[int] = []
    refused: dict[int, str] = {}
    for number, effect in enumerate(EFFECTS):
        if edges[number] == 0.0:
            refused[number] = f"nothing in these strips shows it; it needs {effect.remedy}"
            continue
        before = fit.sigmas(taken) if taken else np.zeros(0)
        after = fit.sigmas([*taken, number])
        if after[-1] * edges[number] > worst_m:
            refused[number] = f"this flight does not determine it; it needs {effect.remedy}"
        elif len(before) and (growth := after[:-1] / before).max() > NOT_APART:
            other = EFFECTS[taken[int(growth.argmax())]].name
            refused[number] = f"this flight cannot separate it from {other}; it needs {effect.remedy}"
        else:
            taken.append(number)
    return taken, refused


def _not_told(effect: Effect, why: str) -> Signature:
    return Signature(effect, math.nan, math.nan, math.nan, "not told", f"{effect.name}: {why}")


def _told(effect: Effect, value: float, sigma: float, edge: float) -> Signature:
    times, moves_m = abs(value) / sigma, abs(value) * edge
    number = f"{with_sigma(effect.factor * value, effect.factor * sigma)} {effect.unit}".replace(" °", "°")
    if times < SIGNIFICANT:
        return Signature(effect, value, sigma, moves_m, "none", f"{effect.name}: not significant ({number})")
    size_words = f"{times:.0f} σ, {100.0 * moves_m:.1f} cm at the edge"
    if moves_m < MATTERS_M:
        return Signature(
            effect, value, sigma, moves_m, "small", f"{effect.name}: {number}, too small to matter ({size_words})"
        )
    words = f"{effect.name}: {effect.look}; add {number} to {effect.key} ({size_words})"
    return Signature(effect, value, sigma, moves_m, "significant", words)


def record_of(found: Signatures) -> Mapping[str, object]:
    """Return the estimates for JSON; values have the report's unit, that of the key in calibration files."""
    return {
        "rows": found.rows,
        "rms_m": found.rms_m,
        "left_rms_m": found.left_rms_m,
        "variance_factor": found.variance_factor,
        "rough": found.rough,
        "trajectory_errors": list(found.prior_notes),
        "effects": [
            {
                "name": one.effect.name,
                "parameter": one.effect.key,
                "unit": one.effect.unit,
                "value": one.value * one.effect.factor if math.isfinite(one.value) else None,
                "sigma": one.sigma * one.effect.factor if math.isfinite(one.sigma) else None,
                "edge_m": one.edge_m if math.isfinite(one.edge_m) else None,
                "level": one.level,
                "words": one.words,
            }
            for one in found.found
        ],
    }
