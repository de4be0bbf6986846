"""What the differences between strips look like: the calibration's parameters that would remove them (FORMULAS 5.3).

A difference of two strips on a plane is what is wrong with each of them there, along the plane's normal. Each effect
moves points in a way of its own with scan angle, flight direction, scan direction, range and speed; how much of each
is in the differences is estimated together with an error of position and attitude of every strip, which the sigmas of
the trajectory bound: what is explained by them is not taken for a calibration.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.effects import EFFECTS, NAMES, Effect, SeenFrom, effect_columns
from calib.strips import Checks
from georef.records import Int64Array

FloatArray = NDArray[np.float64]

SIGNIFICANT = 3.29  # sigmas; one in a thousand by chance
MATTERS_M = 0.01  # on the ground, at the swath's edge
TELLS_M, TELLS = (
    0.02,
    1.5,
)  # at the edge, one sigma: what is known worse is not told; so many times what attitude leaves
NOT_APART = 5.0  # times that another effect's sigma may grow
MOST_ROWS = 12_000
WANDER = 0.3  # of a trajectory's sigmas of height and roll: as much as its errors change within a strip
MOST_PIECES, SHORTEST_PIECE_S = 150, 2.0  # of strips, each with a wander of its own
POSITION_SIGMA_M, ATTITUDE_SIGMA_DEG = 0.05, (0.005, 0.005, 0.01)  # of trajectories that say none


@dataclass(frozen=True, slots=True)
class Signature:
    """One effect in the residuals.

    Attributes:
        effect: which.
        value, sigma: to be added to the parameter to remove it, SI; nan: not told.
        edge_m: what the value moves at the swaths' edges.
        level: ``none``, ``small``, ``significant``, ``not told``.
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
    """All effects; and how much of the differences they and the strips' own errors explain.

    Attributes:
        found: an effect each, in the order of `EFFECTS`.
        rows: differences that were used.
        rms_m, left_rms_m: of the differences, before and after.
        variance_factor: of what is left, against its noise.
    """

    found: tuple[Signature, ...]
    rows: int
    rms_m: float
    left_rms_m: float
    variance_factor: float


def signatures(checks: Checks, seen: SeenFrom, *, most_rows: int = MOST_ROWS) -> Signatures:
    """Estimate every effect that the differences can tell.

    Args:
        checks: of `calib.strips`, points in t.
        seen: where from.
        most_rows: checks that are used, drawn evenly.
    """
    checks = checks.take(_known(checks, seen))
    if len(checks) > most_rows:
        checks = checks.take(np.random.default_rng(6_7).choice(len(checks), most_rows, replace=False))
    if len(checks) < 10:
        return Signatures(
            tuple(_not_told(effect, "too few differences") for effect in EFFECTS), len(checks), *[np.nan] * 3
        )
    pieces = _Pieces.of(checks, len(seen.flown))
    design, strips, edges = _design(checks, seen, pieces)
    bounds = _bounds(checks, seen, pieces)
    fit = _Fit(design, strips, bounds, checks.distance_m, checks.noise_m)
    taken, refused = _choose(fit, edges, _worst_m(bounds, edges, len(seen.flown)))
    values, sigmas = fit.solve(taken)
    found = []
    for number, effect in enumerate(EFFECTS):
        if number in refused:
            found.append(_not_told(effect, refused[number]))
        else:
            at = taken.index(number)
            found.append(_told(effect, float(values[at]), float(sigmas[at]), float(edges[number])))
    rms_m = float(np.sqrt(np.mean(checks.distance_m**2)))
    return Signatures(tuple(found), len(checks), rms_m, fit.left_rms_m, fit.variance_factor)


def _known(checks: Checks, seen: SeenFrom) -> NDArray[np.bool_]:
    """Rows of which both strips' trajectory is known."""
    known = np.ones(len(checks), bool)
    for strip, time_ns in ((checks.first, checks.point_ns), (checks.second, checks.centre_ns)):
        for number in np.unique(strip):
            own = strip == number
            known[own] &= seen.trajectories[seen.flown[number]].fates(time_ns[own]) == 0
    return known


# ---------------------------------------------------------------------- columns


def _design(checks: Checks, seen: SeenFrom, pieces: _Pieces) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Differences by effects (n, effects), by errors of both strips (n, strips · errors), and by effect what one unit
    moves at the edges (effects,). Signs: what is to be added to a parameter, so that the difference goes."""
    sides = (
        (checks.point, checks.first, checks.point_ns, checks.point_direction, 1.0),
        (checks.centre, checks.second, checks.centre_ns, checks.centre_direction, -1.0),
    )
    rows = np.arange(len(checks))
    design = np.zeros((len(checks), len(EFFECTS)))
    strips = np.zeros((len(checks), len(seen.flown), 6 + 2 * pieces.count))
    edges = np.zeros(len(EFFECTS))
    for points_t, strip, time_ns, direction, sign in sides:
        columns, errors = effect_columns(points_t, strip, time_ns, direction, seen)
        design -= sign * np.einsum("nki,ni->nk", columns, checks.normal)
        own = -sign * np.einsum("nki,ni->nk", errors, checks.normal)
        piece = pieces.at(strip, time_ns)
        strips[rows, strip, :6] = own
        strips[rows, strip, 6 + piece] = own[:, 2]
        strips[rows, strip, 6 + pieces.count + piece] = own[:, 3]
        edges = np.maximum(edges, np.percentile(np.linalg.norm(columns, axis=2), 95.0, axis=0))
    return design, strips.reshape(len(checks), -1), edges


@dataclass(frozen=True, eq=False)
class _Pieces:
    """Strips in pieces of time: begin and length (strips,) ns, and how many of each."""

    begin_ns: Int64Array
    length_ns: FloatArray
    count: int

    @classmethod
    def of(cls, checks: Checks, strips: int) -> _Pieces:
        """As many as the longest strip wants, and not too many in all."""
        strip = np.concatenate([checks.first, checks.second])
        time_ns = np.concatenate([checks.point_ns, checks.centre_ns])
        begin, end = np.full(strips, np.iinfo(np.int64).max), np.full(strips, np.iinfo(np.int64).min)
        np.minimum.at(begin, strip, time_ns)
        np.maximum.at(end, strip, time_ns)
        length = np.where(end > begin, (end.astype(np.float64) - begin), 1.0) + 1.0
        wanted = int(length.max() / 1e9 / SHORTEST_PIECE_S)
        count = max(1, min(wanted, MOST_PIECES // max(strips, 1)))
        return cls(begin, length / count, count)

    def at(self, strip: Int64Array, time_ns: Int64Array) -> Int64Array:
        """(n,) the piece."""
        piece = ((time_ns - self.begin_ns[strip]) / self.length_ns[strip]).astype(np.int64)
        return np.clip(piece, 0, self.count - 1)


def _bounds(checks: Checks, seen: SeenFrom, pieces: _Pieces) -> FloatArray:
    """(strips · errors,) sigmas of the strips' errors, by their trajectories."""
    bounds = np.tile(np.array([*[POSITION_SIGMA_M] * 3, *np.radians(ATTITUDE_SIGMA_DEG)]), (len(seen.flown), 1))
    for number, flown in enumerate(seen.flown):
        times = np.concatenate([checks.point_ns[checks.first == number], checks.centre_ns[checks.second == number]])
        if len(times):
            trajectory = seen.trajectories[flown]
            within = trajectory.between(int(times.min()), int(times.max()))
            for at, sigmas in ((0, within.position_sigma_l[:, [1, 0, 2]]), (3, within.attitude_sigma_rad)):
                if np.isfinite(sigmas).any():
                    bounds[number, at : at + 3] = np.sqrt(np.nanmean(sigmas**2, axis=0))
    wander = WANDER * np.repeat(bounds[:, [2, 3]], pieces.count, axis=1)
    return np.hstack([bounds, wander]).ravel()


# ---------------------------------------------------------------------- estimation


class _Fit:
    """Least squares of differences on chosen effects and all strips' errors, robust."""

    def __init__(
        self, design: FloatArray, strips: FloatArray, bounds: FloatArray, values: FloatArray, noise: FloatArray
    ) -> None:
        self._whole, self._values, self._noise = np.hstack([design, strips]), values, noise
        self._effects = design.shape[1]
        self._known = np.diag(np.concatenate([np.zeros(self._effects), 1.0 / bounds**2]))
        self._plain: FloatArray | None = None
        self.left_rms_m, self.variance_factor = math.nan, math.nan

    def sigmas(self, taken: Sequence[int]) -> FloatArray:
        """(effects taken,) by the noise and the strips' bounds alone."""
        if self._plain is None:
            self._plain = self._normal(np.ones(len(self._values)))
        return _roots_of_inverse(self._part(self._plain, taken))[: len(taken)]

    def solve(self, taken: Sequence[int]) -> tuple[FloatArray, FloatArray]:
        """Values and sigmas (effects taken,), with Huber's weights and a variance factor where it is above 1."""
        columns = self._columns(taken)
        huber = np.ones(len(self._values))
        for _ in range(5):
            normal = self._part(self._normal(huber), taken)
            right = self._whole[:, columns].T @ (huber / self._noise**2 * self._values)
            unknowns = np.asarray(np.linalg.solve(normal, right), np.float64)
            misfits = (self._values - self._whole[:, columns] @ unknowns) / self._noise
            spread = max(1.4826 * float(np.median(np.abs(misfits))), 1.0)
            huber = np.minimum(1.0, 1.5 * spread / np.maximum(np.abs(misfits), 1e-9))
        self.left_rms_m = float(np.sqrt(np.mean((misfits * self._noise) ** 2)))
        self.variance_factor = float((huber * misfits**2).sum()) / max(len(misfits) - len(taken), 1)
        sigmas = _roots_of_inverse(normal)[: len(taken)] * max(1.0, math.sqrt(self.variance_factor))
        return unknowns[: len(taken)], sigmas

    def _normal(self, huber: FloatArray) -> FloatArray:
        weighted = self._whole * (huber / self._noise**2)[:, np.newaxis]
        normal: FloatArray = weighted.T @ self._whole + self._known
        return normal

    def _columns(self, taken: Sequence[int]) -> list[int]:
        return [*taken, *range(self._effects, self._whole.shape[1])]

    def _part(self, normal: FloatArray, taken: Sequence[int]) -> FloatArray:
        return normal[np.ix_(self._columns(taken), self._columns(taken))]


def _roots_of_inverse(normal: FloatArray) -> FloatArray:
    """Sigmas; inf of what nothing determines."""
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    scaled = normal / np.outer(scale, scale)
    values, vectors = np.linalg.eigh(scaled)
    inverse = (vectors**2 / np.maximum(values, 1e-14)).sum(axis=1)
    return np.asarray(np.sqrt(inverse) / scale)


def _worst_m(bounds: FloatArray, edges: FloatArray, strips: int) -> float:
    """The largest sigma at the edge of an effect that is told: strips' attitude leaves some to the best of flights."""
    attitude = bounds.reshape(strips, -1)[:, 3:5]
    left_m = float(np.sqrt(np.mean(attitude**2) / strips) * edges[NAMES.index("pitch")])
    return max(TELLS_M, TELLS * left_m)


def _choose(fit: _Fit, edges: FloatArray, worst_m: float) -> tuple[list[int], dict[int, str]]:
    """The effects that the differences tell apart, and why not of the others."""
    taken: list[int] = []
    refused: dict[int, str] = {}
    for number, effect in enumerate(EFFECTS):
        if edges[number] == 0.0:
            refused[number] = f"nothing here shows it; it wants {effect.remedy}"
            continue
        before = fit.sigmas(taken) if taken else np.zeros(0)
        after = fit.sigmas([*taken, number])
        if after[-1] * edges[number] > worst_m:
            refused[number] = f"this flight does not tell it; it wants {effect.remedy}"
        elif len(before) and (growth := after[:-1] / before).max() > NOT_APART:
            other = EFFECTS[taken[int(growth.argmax())]].name
            refused[number] = f"not to be told apart from {other} here; it wants {effect.remedy}"
        else:
            taken.append(number)
    return taken, refused


def _not_told(effect: Effect, why: str) -> Signature:
    return Signature(effect, math.nan, math.nan, math.nan, "not told", f"{effect.name}: {why}")


def _told(effect: Effect, value: float, sigma: float, edge: float) -> Signature:
    times, moves_m = abs(value) / sigma, abs(value) * edge
    digits = max(0, 1 - math.floor(math.log10(effect.factor * sigma)))
    size, spread = effect.factor * value, effect.factor * sigma
    number = f"{size:+.{digits}f} ± {spread:.{digits}f} {effect.unit}".replace(" °", "°")
    if times < SIGNIFICANT:
        return Signature(effect, value, sigma, moves_m, "none", f"{effect.name}: no sign of it ({number})")
    told = f"{times:.0f} σ, {100.0 * moves_m:.1f} cm at the edge"
    if moves_m < MATTERS_M:
        return Signature(
            effect, value, sigma, moves_m, "small", f"{effect.name}: {number}, too small to matter ({told})"
        )
    words = f"{effect.name}: {effect.look}; add {number} to {effect.key} ({told})"
    return Signature(effect, value, sigma, moves_m, "significant", words)


def record_of(found: Signatures) -> Mapping[str, object]:
    """For JSON: values in the unit of the report, which is that of the parameter's key in calibration files."""
    return {
        "rows": found.rows,
        "rms_m": found.rms_m,
        "left_rms_m": found.left_rms_m,
        "variance_factor": found.variance_factor,
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
