"""What a validation looks at: distances of swaths from each other and from control, with the errors that are expected
of them: noise, the strips' trajectories, the calibration's own sigmas."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from calib.control import ControlRules, Ground, grounds_at
from calib.effects import EFFECTS, SeenFrom, effect_columns
from calib.features import ControlPoint, Features, Plane
from calib.flight import Flight
from calib.local_plane import LocalPlane, plane_through
from georef.calibration import INDEX, Calibration
from georef.records import Int64Array

FloatArray = NDArray[np.float64]

FLOOR_M = 0.003  # of a distance: no natural plane is better
SIGMAS = (0.05, 0.05, 0.05, *np.radians([0.005, 0.005, 0.01]).tolist())  # of strips whose trajectory says none
HALF = math.sqrt(0.5)  # of the floor, each sight's
WANDER = 0.3  # of a trajectory's sigmas: as much as its errors change from plane to plane
FAR_M = 10.0
MOST_ROWS = 1500


@dataclass(frozen=True, eq=False)
class Rows:
    """Distances (n,) along the planes' normals.

    Attributes:
        value_m: first swath − second, or swath − control.
        first, second: indexes of swaths; second −1: control.
        noise_m: sigma that each has for itself.
        shared: (n, m) what one sigma of each shared error moves.
        name: of the planes or points.
        effects: (n, heads · effects) what one unit (SI) of each effect of a calibration moves; (n, 0): none.
        local: sparse (n, m) what one sigma of each error moves that only one plane's or point's share; None: none.
        sights: (n, 2) which sight of a plane is the first, and the second; (0, 2): all are different.
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

    def __len__(self) -> int:
        """Number of distances."""
        return len(self.value_m)

    def take(self, which: Any) -> Rows:
        """Some of them, evenly drawn where they are more than can be tested together."""
        at = np.flatnonzero(which)
        if len(at) > MOST_ROWS:
            at = np.sort(np.random.default_rng(6_8).choice(at, MOST_ROWS, replace=False))
        names = tuple(self.name[int(number)] for number in at)
        effects = self.effects[at] if len(self.effects) else self.effects
        local = None if self.local is None else self.local[at]
        sights = self.sights[at] if len(self.sights) else self.sights
        columns = (self.value_m[at], self.first[at], self.second[at], self.noise_m[at], self.shared[at])
        return Rows(*columns, names, effects, local, sights)

    def independent(self, which: Any) -> NDArray[np.bool_]:
        """(n,) of the distances chosen those that tell something beyond the others: k sights of a plane have k − 1.

        Those whose sights are surest stay; any others are sums and differences of them.
        """
        chosen = np.zeros(len(self), bool)
        if not len(self.sights):
            chosen[which] = True
            return chosen
        at = np.flatnonzero(which)
        groups = np.arange(int(self.sights.max(initial=-1)) + 1).tolist()  # a sight leads to another that it hangs on

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
        """(n, n) that is expected, m²."""
        expected: FloatArray = np.diag(self.noise_m**2) + self.shared @ self.shared.T
        return expected if self.local is None else expected + (self.local @ self.local.T).toarray()


@dataclass(frozen=True, eq=False)
class _Sight:
    """A plane as one swath shows it: its fit, mean time, the scan's direction, and the spread of its returns across
    their longest direction."""

    swath: int
    plane: LocalPlane
    time_ns: int
    direction: float
    spread_m: float = 1.0


def plane_rows(flight: Flight, features: Features, calibrations: Mapping[str, Calibration]) -> Rows:
    """Every two swaths on every plane: the mean of the one's returns from the other's plane."""
    values, firsts, seconds, places = [], [], [], []
    for place, plane in enumerate(features.planes):
        sights = [_sight(flight, plane, number) for number in range(len(plane.patches))]
        for first, second in combinations([one for one in sights if one.plane.count >= 6], 2):
            away = first.plane.centre_t - second.plane.centre_t
            if abs(float(away @ second.plane.normal_t)) < FAR_M:
                values.append(float(away @ second.plane.normal_t))
                firsts.append(first)
                seconds.append(second)
                places.append(place)
    normals = np.array([one.plane.normal_t for one in seconds]).reshape(-1, 3)
    of_first, of_second = (_shared(flight, sights, normals, calibrations) for sights in (firsts, seconds))
    shared, effects = of_first[0] - of_second[0], of_first[1] - of_second[1]
    number: dict[_Sight, int] = {}
    of_sights = [
        [number.setdefault(sight, len(number)) for sight in pair] for pair in zip(firsts, seconds, strict=True)
    ]
    sights_at = np.array(of_sights, np.int64).reshape(-1, 2)
    wander = _wander(shared[:, : len(flight.swaths) * 6], np.array(places, np.int64))
    return Rows(
        np.array(values),
        np.array([one.swath for one in firsts], np.int64),
        np.array([one.swath for one in seconds], np.int64),
        np.zeros(len(values)),
        shared,
        tuple(features.planes[place].name for place in places),
        effects,
        sparse.hstack([_noise(firsts, seconds, sights_at), wander], format="csr"),
        sights_at,
    )


def _sight(flight: Flight, plane: Plane, number: int) -> _Sight:
    patch = plane.patches[number]
    swath = flight.swaths[patch.swath]
    points = np.asarray(swath.points_t[patch.at])
    fit = plane_through(points)
    spread_m = float(np.linalg.svd(points - fit.centre_t, compute_uv=False)[1]) / math.sqrt(fit.count)
    if fit.normal_t @ plane.normal_t < 0.0:
        fit = LocalPlane(fit.centre_t, -fit.normal_t, fit.rms_m, fit.count)
    times = swath.time_ns[patch.at]
    rate = 0.0 if swath.encoder_rate is None else float(np.mean(np.sign(swath.encoder_rate[patch.at])))
    return _Sight(patch.swath, fit, int(times[0]) + int(np.mean(times - times[0])), rate, spread_m)


def _noise(firsts: Sequence[_Sight], seconds: Sequence[_Sight], sights: Int64Array) -> Any:
    """Sparse (n, sights · 4): of each sight its place along the normal, and the turn of its plane, by which the place
    grows unsure where the other's returns lie off its middle."""
    moved = np.zeros((len(firsts), 2, 4))
    for row, (first, second) in enumerate(zip(firsts, seconds, strict=True)):
        away = first.plane.centre_t - second.plane.centre_t
        along = away - (away @ second.plane.normal_t) * second.plane.normal_t
        sigmas = [one.plane.rms_m / math.sqrt(one.plane.count) for one in (first, second)]
        moved[row, :, 0] = math.hypot(sigmas[0], FLOOR_M * HALF), -math.hypot(sigmas[1], FLOOR_M * HALF)
        moved[row, 1, 1:] = -sigmas[1] * along / max(second.spread_m, 1e-3)
    row_of = np.repeat(np.arange(len(firsts)), 8)
    column = 4 * np.repeat(sights.reshape(-1), 4) + np.tile(np.arange(4), 2 * len(firsts))
    shape = len(firsts), 4 * (int(sights.max(initial=-1)) + 1)
    return sparse.csr_array((moved.reshape(-1), (row_of, column)), shape=shape)


def _wander(of_strips: FloatArray, place: Int64Array) -> Any:
    """Sparse (n, places · m) what strips' errors (n, m) change from place to place."""
    row, column = np.nonzero(of_strips)
    shape = len(of_strips), of_strips.shape[1] * (int(place.max(initial=-1)) + 1)
    values = WANDER * of_strips[row, column]
    return sparse.csr_array((values, (row, column + of_strips.shape[1] * place[row])), shape=shape)


def control_rows(
    flight: Flight, points: Sequence[ControlPoint], calibrations: Mapping[str, Calibration], rules: ControlRules
) -> Rows:
    """Every swath at every control point: the swath above the point."""
    grounds, _ = grounds_at(flight, points, rules)
    grounds = [one for one in grounds if abs(one.above_m) < FAR_M]
    sights = [_sight_of_ground(flight, one) for one in grounds]
    normals = np.array([one.plane.normal_t for one in sights]).reshape(-1, 3)
    surveyed = np.array([np.broadcast_to(points[one.point].sigma_m, 3) for one in grounds]).reshape(-1, 3)
    values = np.array([-one.plane.distance_m(points[one.point].position_t) for one in grounds])
    noise = np.array([math.hypot(one.rms_m / math.sqrt(one.count), FLOOR_M) for one in (g.plane for g in grounds)])
    number = np.array([one.point for one in grounds], np.int64)
    of_points = np.zeros((len(grounds), len(points)))
    of_points[np.arange(len(grounds)), number] = np.sqrt(((surveyed * normals) ** 2).sum(axis=1))
    shared, effects = _shared(flight, sights, normals, calibrations)
    return Rows(
        values,
        np.array([one.swath for one in grounds], np.int64),
        np.full(len(grounds), -1),
        noise,
        np.hstack([shared, of_points]),
        tuple(points[one.point].name for one in grounds),
        effects,
        _wander(shared[:, : len(flight.swaths) * 6], number),
    )


def _sight_of_ground(flight: Flight, ground: Ground) -> _Sight:
    swath = flight.swaths[ground.swath]
    times = swath.time_ns[ground.at]
    return _Sight(ground.swath, ground.plane, int(times[0]) + int(np.mean(times - times[0])), 0.0)


def _shared(
    flight: Flight, sights: Sequence[_Sight], normals: FloatArray, calibrations: Mapping[str, Calibration]
) -> tuple[FloatArray, FloatArray]:
    """What one sigma of strips' errors and of calibrations moves (n, swaths · 6 + heads · effects), and what one unit
    of calibrations' effects does (n, heads · effects)."""
    seen = SeenFrom.of(flight)
    effects = np.zeros((len(sights), len(flight.heads), len(EFFECTS)))
    of_strips, of_heads = np.zeros((len(sights), len(flight.swaths), 6)), np.zeros_like(effects)
    if sights:
        strip = np.array([one.swath for one in sights], np.int64)
        places = np.array([one.plane.centre_t for one in sights])
        times = np.array([one.time_ns for one in sights], np.int64)
        columns, errors = effect_columns(places, strip, times, np.array([one.direction for one in sights]), seen)
        own = np.einsum("nki,ni->nk", errors, normals) * _sigmas(flight, times, strip)
        of_strips[np.arange(len(sights)), _session_strip(flight)[strip]] = own
        moved = np.einsum("nki,ni->nk", columns, normals)
        for number, head in enumerate(flight.heads):
            mine = np.array([flight.swaths[one].head == number for one in strip])
            effects[mine, number] = moved[mine]
            of_heads[mine, number] = moved[mine] @ _root(calibrations[head.name])
    flat = [array.reshape(len(sights), array.shape[1] * array.shape[2]) for array in (of_strips, of_heads, effects)]
    return np.hstack(flat[:2]), flat[2]


def _session_strip(flight: Flight) -> Int64Array:
    """(swaths,) heads of one strip share its errors: the index of the strip's first swath."""
    first: dict[tuple[int, int], int] = {}
    return np.array([first.setdefault((one.flown, one.strip), at) for at, one in enumerate(flight.swaths)], np.int64)


def _sigmas(flight: Flight, times: Int64Array, strip: Int64Array) -> FloatArray:
    """(n, 6) of position east, north, up and of the turns about the body's axes, by the trajectories."""
    sigmas = np.tile(np.array(SIGMAS), (len(times), 1))
    for number in np.unique(strip):
        own = strip == number
        poses = flight.trajectories[flight.swaths[number].flown].poses(times[own])
        for at, told in ((0, poses.position_sigma_l[:, [1, 0, 2]]), (3, poses.attitude_sigma_rad)):
            part = sigmas[own, at : at + 3]
            sigmas[own, at : at + 3] = np.where(np.isfinite(told), told, part)
    return sigmas


def _root(calibration: Calibration) -> FloatArray:
    """(effects, effects) whose square is the covariance of the effects' parameters; zero where held fixed."""
    at = [INDEX[effect.parameter] for effect in EFFECTS]
    values, vectors = np.linalg.eigh(calibration.covariance()[np.ix_(at, at)])
    root: FloatArray = vectors * np.sqrt(np.maximum(values, 0.0))
    return root
