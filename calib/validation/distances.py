"""Measure distances of swaths from each other and from control for a validation, with their expected errors.

These errors are noise, the trajectory's errors along the strips, and the calibration's own sigmas.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Any

import numpy as np
from scipy import optimize, sparse

from swath.calib.control.points import ControlRules, Ground, grounds_at
from swath.calib.equations.trajectory_prior import ERRORS, TrajectoryPrior
from swath.calib.features import ControlPoint, Features, Plane
from swath.calib.flight import Flight
from swath.calib.planes.local import LocalPlane, plane_through
from swath.calib.strips.effects import EFFECTS, SeenFrom, effect_columns
from swath.georef.arrays import BoolArray, FloatArray, Int64Array
from swath.georef.geodesy.earth import geodetic_from_e, rot_e_from_l
from swath.georef.scanner.calibration import INDEX, Calibration

FLOOR_M = 0.003  # of a distance, at most: variation of natural planes from one sight to another
HALF = math.sqrt(0.5)  # share of each sight in the floor
FAR_M = 10.0
FEWEST = 6  # returns of a sight
MOST_ROWS = 1500
FLOOR_ROWS = 500  # rows used to estimate the floor: that takes twenty factorisations


@dataclass(frozen=True, eq=False)
class Rows:
    """Distances (n,) along the planes' normals.

    Attributes:
        value_m: first swath − second, or swath − control.
        first, second: indexes of swaths; second −1: control.
        noise_m: sigma of each distance's own error.
        shared: (n, m) change by one sigma of each shared error: the calibrations', the survey's.
        name: of the planes or points.
        effects: (n, heads · effects) change by one unit (SI) of each effect of a calibration; (n, 0): no effects.
        local: sparse (n, m) change by one sigma of each error that only the distances of one plane or point share;
            None: there are no such errors.
        sights: (n, 2) numbers of the first and the second sight of a plane; (0, 2): all are different.
        by_knot: sparse (n, 6k) change by a unit of the trajectory's errors at each knot; None: these count as zero.
        knots: (6k, 6k) covariance of these, as of `swath.calib.equations.trajectory_prior.TrajectoryPrior`.
        floor: sparse (n, sights) change by a metre of each sight's own deviation from its plane; None: no deviations.
        floor_m: sigma of these deviations times √2, so that it is a distance's.
        heads: names of the scanners behind the effects.
    """

    value_m: FloatArray
    first: Int64Array
    second: Int64Array
    noise_m: FloatArray
    shared: FloatArray
    name: tuple[str, ...]
    effects: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    local: Any = None
    sights: Int64Array = field(default_factory=lambda: np.zeros((0, 2), np.int64))
    by_knot: Any = None
    knots: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    floor: Any = None
    floor_m: float = FLOOR_M
    heads: tuple[str, ...] = ()

    def __len__(self) -> int:
        """Return the number of distances."""
        return len(self.value_m)

    def take(self, which: Any) -> Rows:
        """Select some of the rows, drawn evenly if they are more than can be tested together."""
        at = np.flatnonzero(which)
        if len(at) > MOST_ROWS:
            at = np.sort(np.random.default_rng(6_8).choice(at, MOST_ROWS, replace=False))
        local, by_knot, floor = (None if one is None else one[at] for one in (self.local, self.by_knot, self.floor))
        return replace(
            self,
            value_m=self.value_m[at],
            first=self.first[at],
            second=self.second[at],
            noise_m=self.noise_m[at],
            shared=self.shared[at],
            name=tuple(self.name[int(number)] for number in at),
            effects=self.effects[at] if len(self.effects) else self.effects,
            local=local,
            sights=self.sights[at] if len(self.sights) else self.sights,
            by_knot=by_knot,
            floor=floor,
        )

    def independent(self, which: Any) -> BoolArray:
        """Return a mask (n,) of the chosen distances that are independent: k sights of a plane have k − 1.

        The distances with the most certain sights are kept; all others are sums and differences of them.
        """
        chosen = np.zeros(len(self), bool)
        if not len(self.sights):
            chosen[which] = True
            return chosen
        at = np.flatnonzero(which)
        groups = np.arange(int(self.sights.max(initial=-1)) + 1).tolist()  # links to another sight of the same group

        def group(sight: int) -> int:
            while groups[sight] != sight:
                groups[sight] = groups[groups[sight]]
                sight = groups[sight]
            return sight

        variance = self.noise_m**2 + (
            0.0 if self.local is None else np.asarray(self.local.power(2).sum(axis=1)).ravel()
        )
        for row in at[np.argsort(variance[at], kind="stable")].tolist():
            first, second = (group(sight) for sight in self.sights[row].tolist())
            chosen[row] = first != second
            groups[first] = second
        return chosen

    def covariance(self) -> FloatArray:
        """Return the expected covariance (n, n), m²."""
        expected: FloatArray = np.diag(self.noise_m**2) + self.shared @ self.shared.T
        if self.local is not None:
            expected = expected + (self.local @ self.local.T).toarray()
        if self.by_knot is not None:
            expected = expected + self.by_knot @ (self.by_knot @ self.knots).T
        return expected + self.floor_m**2 * self.floor_pattern()

    def floor_pattern(self) -> FloatArray:
        """Return the change (n, n) of the covariance per square metre of the floor."""
        if self.floor is None:
            return np.zeros((len(self), len(self)))
        pattern: FloatArray = (self.floor @ self.floor.T).toarray()
        return pattern


def estimated_floor_m(rows: Rows) -> float:
    """Estimate how much planes themselves vary from sight to sight, at most `FLOOR_M`.

    Restricted maximum likelihood (Patterson and Thompson 1971, Biometrika 58): all parts that an error of a calibration
    could explain are projected out first, so that such an error does not count as roughness.

    Args:
        rows: independent rows (`Rows.independent`).
    """
    if rows.floor is None or len(rows) < 2:
        return rows.floor_m
    at = np.arange(len(rows))
    if len(at) > FLOOR_ROWS:
        at = np.sort(np.random.default_rng(6_8).choice(at, FLOOR_ROWS, replace=False))
    part = rows.take(np.isin(np.arange(len(rows)), at))
    fixed, pattern = replace(part, floor_m=0.0).covariance(), part.floor_pattern()
    left, singular, _ = np.linalg.svd(_scaled(part.effects), full_matrices=False)
    explained = left[:, singular > 1e-6]

    def deviance(floor_m: float) -> float:
        factor = np.linalg.cholesky(fixed + floor_m**2 * pattern + 1e-12 * np.eye(len(part)))
        whitened = np.linalg.solve(factor, np.column_stack([part.value_m, explained]))
        basis, triangle = np.linalg.qr(whitened[:, 1:])
        misfit = whitened[:, 0] - basis @ (basis.T @ whitened[:, 0])
        logs = np.log(np.diag(factor)).sum() + np.log(np.abs(np.diag(triangle))).sum()
        return float(misfit @ misfit + 2.0 * logs)

    found = optimize.minimize_scalar(deviance, bounds=(0.0, FLOOR_M), method="bounded", options={"xatol": 1e-5})
    return float(found.x)


def _scaled(effects: FloatArray) -> FloatArray:
    """Scale columns (n, m) to length 1, and drop zero columns."""
    length = np.linalg.norm(effects, axis=0)
    scaled: FloatArray = effects[:, length > 0.0] / length[length > 0.0]
    return scaled


@dataclass(frozen=True, eq=False)
class _Sight:
    """A plane as one swath shows it.

    Attributes:
        swath: index.
        plane: its fit.
        time_ns: mean time.
        direction: of the scan.
        spread_m: spread of its returns across their longest direction.
    """

    swath: int
    plane: LocalPlane
    time_ns: int
    direction: float
    spread_m: float = 1.0


def plane_rows(
    flight: Flight, features: Features, calibrations: Mapping[str, Calibration], prior: TrajectoryPrior
) -> Rows:
    """Compare every two swaths on every plane: the mean of the first one's returns from the second one's plane.

    Args:
        flight: with points.
        features: planes.
        calibrations: by scanner, of the points.
        prior: the trajectory's errors.
    """
    values, firsts, seconds, names = [], [], [], []
    for plane in features.planes:
        sights = [_sight(flight, plane, number) for number in range(len(plane.patches))]
        for first, second in combinations([one for one in sights if one is not None], 2):
            away = first.plane.centre_t - second.plane.centre_t
            if abs(float(away @ second.plane.normal_t)) < FAR_M:
                values.append(float(away @ second.plane.normal_t))
                firsts.append(first)
                seconds.append(second)
                names.append(plane.name)
    normals = np.array([one.plane.normal_t for one in seconds]).reshape(-1, 3)
    of_first, of_second = (_moved(flight, sights, normals, calibrations, prior) for sights in (firsts, seconds))
    number: dict[_Sight, int] = {}
    of_sights = [
        [number.setdefault(sight, len(number)) for sight in pair] for pair in zip(firsts, seconds, strict=True)
    ]
    sights_at = np.array(of_sights, np.int64).reshape(-1, 2)
    walked = np.column_stack([of_first.walk_m, of_second.walk_m])
    return Rows(
        np.array(values),
        np.array([one.swath for one in firsts], np.int64),
        np.array([one.swath for one in seconds], np.int64),
        np.zeros(len(values)),
        of_first.heads - of_second.heads,
        tuple(names),
        of_first.effects - of_second.effects,
        _noise(firsts, seconds, sights_at, walked),
        sights_at,
        of_first.knots - of_second.knots,
        prior.covariance,
        _floor(sights_at),
        FLOOR_M,
        tuple(head.name for head in flight.heads),
    )


def _sight(flight: Flight, plane: Plane, number: int) -> _Sight | None:
    """Fit a plane to a swath's placed returns on a plane; None if these are too few."""
    patch = plane.patches[number]
    swath = flight.swaths[patch.swath]
    points = np.asarray(swath.points_t[patch.at])
    there = np.isfinite(points).all(axis=1)
    if there.sum() < FEWEST:
        return None
    points, at = points[there], patch.at[there]
    fit = plane_through(points)
    spread_m = float(np.linalg.svd(points - fit.centre_t, compute_uv=False)[1]) / math.sqrt(fit.count)
    if fit.normal_t @ plane.normal_t < 0.0:
        fit = LocalPlane(fit.centre_t, -fit.normal_t, fit.rms_m, fit.count)
    times = swath.time_ns[at]
    rate = 0.0 if swath.encoder_rate is None else float(np.mean(np.sign(swath.encoder_rate[at])))
    return _Sight(patch.swath, fit, int(times[0]) + int(np.mean(times - times[0])), rate, spread_m)


def _noise(firsts: Sequence[_Sight], seconds: Sequence[_Sight], sights: Int64Array, walked_m: FloatArray) -> Any:
    """Return the effects of each sight's noise on distances, sparse (n, sights · 4).

    The four columns of a sight are its place along the normal and the turn of its plane. Because of the turn, the place
    is less certain where the other sight's returns lie away from its middle.

    Args:
        firsts, seconds: sights of each distance.
        sights: (n, 2) their numbers.
        walked_m: (n, 2) one sigma of the attitude's random walk between knots.
    """
    moved = np.zeros((len(firsts), 2, 4))
    for row, (first, second) in enumerate(zip(firsts, seconds, strict=True)):
        away = first.plane.centre_t - second.plane.centre_t
        along = away - (away @ second.plane.normal_t) * second.plane.normal_t
        sigmas = [one.plane.rms_m / math.sqrt(one.plane.count) for one in (first, second)]
        moved[row, :, 0] = math.hypot(sigmas[0], walked_m[row, 0]), -math.hypot(sigmas[1], walked_m[row, 1])
        moved[row, 1, 1:] = -sigmas[1] * along / max(second.spread_m, 1e-3)
    row_of = np.repeat(np.arange(len(firsts)), 8)
    column = 4 * np.repeat(sights.reshape(-1), 4) + np.tile(np.arange(4), 2 * len(firsts))
    shape = len(firsts), 4 * (int(sights.max(initial=-1)) + 1)
    return sparse.csr_array((moved.reshape(-1), (row_of, column)), shape=shape)


def _floor(sights: Int64Array) -> Any:
    """Return `Rows.floor`, sparse (n, sights): first less second, each with its share of a distance's floor."""
    row = np.repeat(np.arange(len(sights)), 2)
    shape = len(sights), int(sights.max(initial=-1)) + 1
    return sparse.csr_array((np.tile([HALF, -HALF], len(sights)), (row, sights.reshape(-1))), shape=shape)


def control_rows(
    flight: Flight,
    points: Sequence[ControlPoint],
    calibrations: Mapping[str, Calibration],
    rules: ControlRules,
    prior: TrajectoryPrior,
) -> Rows:
    """Compare every swath with every control point: the swath above the point; see `plane_rows` for the arguments."""
    grounds, _ = grounds_at(flight, points, rules)
    grounds = [one for one in grounds if abs(one.above_m) < FAR_M]
    sights = [_sight_of_ground(flight, one) for one in grounds]
    normals = np.array([one.plane.normal_t for one in sights]).reshape(-1, 3)
    surveyed = np.array([np.broadcast_to(points[one.point].sigma_m, 3) for one in grounds]).reshape(-1, 3)
    values = np.array([-one.plane.distance_m(points[one.point].position_t) for one in grounds])
    moved = _moved(flight, sights, normals, calibrations, prior)
    noise = np.array([math.hypot(one.rms_m / math.sqrt(one.count), FLOOR_M) for one in (g.plane for g in grounds)])
    number = np.array([one.point for one in grounds], np.int64)
    of_points = np.zeros((len(grounds), len(points)))
    of_points[np.arange(len(grounds)), number] = np.sqrt(((surveyed * normals) ** 2).sum(axis=1))
    return Rows(
        values,
        np.array([one.swath for one in grounds], np.int64),
        np.full(len(grounds), -1),
        np.hypot(noise, moved.walk_m),
        np.hstack([moved.heads, of_points]),
        tuple(points[one.point].name for one in grounds),
        moved.effects,
        by_knot=moved.knots,
        knots=prior.covariance,
        heads=tuple(head.name for head in flight.heads),
    )


def _sight_of_ground(flight: Flight, ground: Ground) -> _Sight:
    swath = flight.swaths[ground.swath]
    times = swath.time_ns[ground.at]
    return _Sight(ground.swath, ground.plane, int(times[0]) + int(np.mean(times - times[0])), 0.0)


@dataclass(frozen=True, eq=False)
class _Moved:
    """Movements of places (n,) along normals.

    Attributes:
        heads: (n, heads · effects) by one sigma of the calibrations.
        effects: (n, heads · effects) by a unit (SI) of each effect.
        knots: sparse (n, 6k) by a unit of the trajectory's errors at the knots.
        walk_m: (n,) one sigma of the attitude's random walk between knots.
    """

    heads: FloatArray
    effects: FloatArray
    knots: Any
    walk_m: FloatArray


def _moved(
    flight: Flight,
    sights: Sequence[_Sight],
    normals: FloatArray,
    calibrations: Mapping[str, Calibration],
    prior: TrajectoryPrior,
) -> _Moved:
    """Return how sights' places move along normals (n, 3) with calibrations and the trajectory."""
    strip = np.array([one.swath for one in sights], np.int64)
    places = np.array([one.plane.centre_t for one in sights]).reshape(-1, 3)
    times = np.array([one.time_ns for one in sights], np.int64)
    direction = np.array([one.direction for one in sights])
    columns, _ = effect_columns(places, strip, times, direction, SeenFrom.of(flight))
    by_effect = np.einsum("nki,ni->nk", columns, normals)
    effects = np.zeros((len(sights), len(flight.heads), len(EFFECTS)))
    of_heads = np.zeros_like(effects)
    for number, head in enumerate(flight.heads):
        mine = np.array([flight.swaths[one].head == number for one in strip], bool)
        effects[mine, number] = by_effect[mine]
        of_heads[mine, number] = by_effect[mine] @ _root(calibrations[head.name])
    flat = len(sights), len(flight.heads) * len(EFFECTS)
    knots, walk_m = _by_knots(flight, places, normals, strip, times, prior)
    return _Moved(of_heads.reshape(flat), effects.reshape(flat), knots, walk_m)


def _by_knots(
    flight: Flight,
    places: FloatArray,
    normals: FloatArray,
    strip: Int64Array,
    times: Int64Array,
    prior: TrajectoryPrior,
) -> tuple[Any, FloatArray]:
    """Return ``knots`` and ``walk_m`` of `_Moved`.

    A place p seen from a body at x moves by n · (δx + δθ × (p − x)) along n.
    """
    trajectory_index = np.array([flight.swaths[one].trajectory_index for one in strip], np.int64)
    moved, walk = np.zeros((len(places), ERRORS)), np.zeros(len(places))
    row, column, value = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)], [np.zeros(0)]
    for number in np.unique(trajectory_index).tolist():
        own = np.flatnonzero(trajectory_index == number)
        position_e = flight.trajectories[number].poses(times[own]).position_e
        lat, lon, _ = geodetic_from_e(position_e)
        rot_t_from_l = flight.frame.rot_t_from_e @ rot_e_from_l(lat, lon)
        arm = places[own] - flight.frame.t_from_e(position_e)
        in_t = (normals[own], np.cross(arm, normals[own]))
        moved[own] = np.hstack([np.einsum("nij,ni->nj", rot_t_from_l, one) for one in in_t])
        before, after, share = prior.between(number, times[own])
        for knot, part in ((before, 1.0 - share), (after, share)):
            row.append(np.repeat(own, ERRORS))
            column.append((ERRORS * knot[:, np.newaxis] + np.arange(ERRORS)).ravel())
            value.append((part[:, np.newaxis] * moved[own]).ravel())
        if len(prior.walk_rad2):
            walk[own] = prior.walk_rad2[before] * share * (1.0 - share) * (moved[own, 3:] ** 2).sum(axis=1)
    at = np.concatenate(row), np.concatenate(column)
    shape = len(places), ERRORS * len(prior)
    return sparse.csr_array((np.concatenate(value), at), shape=shape), np.sqrt(walk)


def _root(calibration: Calibration) -> FloatArray:
    """Return a matrix root (effects, effects) of the covariance of the effects' parameters; zero where held fixed."""
    at = [INDEX[effect.parameter] for effect in EFFECTS]
    values, vectors = np.linalg.eigh(calibration.covariance()[np.ix_(at, at)])
    root: FloatArray = vectors * np.sqrt(np.maximum(values, 0.0))
    return root
