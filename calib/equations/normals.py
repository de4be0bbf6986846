"""Build and solve the normal equations of parameters and states; planes and tie points are eliminated (FORMULAS 6.4).

    S = N11 − Σ N12 N22⁻¹ N12ᵀ      b = b1 − Σ N12 N22⁻¹ b2      δ1 = −S⁻¹ b      δ2 = −N22⁻¹ (b2 + N12ᵀ δ1)

A plane's three unknowns are two turns and an offset: its normal keeps its length exactly, in accordance with the hard
constraint of ISO/TS 19159-2 Eq. 18.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from swath.calib.equations.inverse import inverted, scales
from swath.calib.equations.rows import Rows, State, tangents
from swath.calib.equations.tables import OF_PLANE
from swath.calib.equations.tie_rows import Seen, Ties, covariance_t
from swath.georef.arrays import FloatArray, Int64Array, SingleArray
from swath.georef.geodesy.earth import geodetic_from_e, rot_e_from_l

FLOOR = 1e-12  # of a plane's or tie point's normal matrix: smaller eigenvalues count as undetermined


class NormalError(ValueError):
    """Equations that cannot be solved; the message is one line for the user."""


@dataclass(frozen=True, eq=False)
class Feature:
    """A plane or tie point in the normal equations.

    Attributes:
        unknowns: (m,) that its observations contain.
        mixed: (m, 3) N12.
        inverse: (3, 3) N22⁻¹.
        right: (3,) b2.
    """

    unknowns: Int64Array
    mixed: FloatArray
    inverse: FloatArray
    right: FloatArray


@dataclass(frozen=True, eq=False)
class Extra:
    """A row, divided by its sigma, for a plane's own unknowns: from control on it or a survey of the plane.

    Attributes:
        plane: index.
        point: index of its control point; −1: the plane is surveyed.
        design: (3,).
        misclosure: in sigmas.
        sigma: metres, or rad.
    """

    plane: int
    point: int
    design: FloatArray
    misclosure: float
    sigma: float


class TrajectoryWeight:
    """The prior of the trajectory's states, in e.

    Attributes:
        normal: (6k, 6k) inverse of its covariance.
        rot_e_from_l: (k, 3, 3) from north, east, down at each knot.
    """

    def __init__(self, rows: Rows) -> None:
        """Prepare the prior's normal matrix in e.

        Raises:
            NormalError: the prior's covariance is not positive definite.
        """
        prior = rows.prior
        count = 0 if prior is None else len(prior.time_ns)
        self.rot_e_from_l = np.zeros((count, 3, 3))
        self.normal = np.zeros((6 * count, 6 * count))
        if prior is None:
            return
        for knot in range(count):
            trajectory = rows.flight.trajectories[int(prior.trajectory_index[knot])]
            epoch = min(int(np.searchsorted(trajectory.time_ns, prior.time_ns[knot])), len(trajectory) - 1)
            lat, lon, _ = geodetic_from_e(trajectory.position_e[epoch])
            self.rot_e_from_l[knot] = rot_e_from_l(lat, lon)
        try:
            self.normal = self.to_e(self.to_e(prior.information).T)
        except np.linalg.LinAlgError as error:
            text = "the trajectory's prior covariance is not positive definite; every knot needs sigmas above 0"
            raise NormalError(text) from error

    def to_e(self, rows: FloatArray) -> FloatArray:
        """Rotate states (6k, m) from north, east, down to e."""
        split = rows.reshape(len(self.rot_e_from_l), 2, 3, -1)
        turned: FloatArray = (self.rot_e_from_l[:, np.newaxis] @ split).reshape(rows.shape)
        return turned

    def to_l(self, rows: FloatArray) -> FloatArray:
        """Rotate states (6k, m) from e to north, east, down."""
        split = rows.reshape(len(self.rot_e_from_l), 2, 3, -1)
        turned: FloatArray = (self.rot_e_from_l.transpose(0, 2, 1)[:, np.newaxis] @ split).reshape(rows.shape)
        return turned

    def variances_l(self, covariance_e: FloatArray) -> FloatArray:
        """Return variances (6k,) in north, east, down, from the states' covariance (6k, 6k) in e."""
        count = len(self.rot_e_from_l)
        knot = np.arange(count)
        blocks = covariance_e.reshape(count, 2, 3, count, 2, 3)
        found = [
            np.einsum("kji,kjm,kmi->ki", self.rot_e_from_l, blocks[knot, part, :, knot, part], self.rot_e_from_l)
            for part in range(2)
        ]
        return np.stack(found, axis=1).reshape(-1)


@dataclass(frozen=True, eq=False)
class Normals:
    """The normal equations at a state.

    Attributes:
        free: (u, u) S of the observations: without parameters' priors, with the trajectory's.
        normal, right: S and b, complete.
        planes, ties: features, eliminated.
        square: Σ p w² of all observations at the state.
        observations: number of rows, including pseudo-observations.
        parameters: p, the first of u.
    """

    free: FloatArray
    normal: FloatArray
    right: FloatArray
    planes: tuple[Feature, ...]
    ties: tuple[Feature, ...]
    square: float
    observations: int
    parameters: int

    def step(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return δ of parameters and states (u,), planes (q, 3), tie points (m, 3).

        Raises:
            NormalError: a parameter is not determined.
        """
        done = -_solved(self.normal, self.right)
        return done, _back(self.planes, done), _back(self.ties, done)

    def covariance(self) -> FloatArray:
        """Return the covariance S⁻¹ (u, u).

        Raises:
            NormalError: a parameter is not determined.
        """
        try:
            return inverted(self.normal)
        except np.linalg.LinAlgError as error:
            raise NormalError("these observations do not determine a parameter; hold it, or give it a prior") from error

    @cached_property
    def of_parameters(self) -> FloatArray:
        """Normal matrix (p, p) of the parameters without their priors, trajectory states eliminated."""
        p = self.parameters
        inner = self.free[p:, p:]
        if not len(inner):
            return self.free.copy()
        reduced: FloatArray = self.free[:p, :p] - self.free[:p, p:] @ _solved(inner, self.free[p:, :p])
        return (reduced + reduced.T) / 2.0


def normals(
    rows: Rows,
    ties: Ties,
    weight: TrajectoryWeight,
    state: State,
    row_weight: SingleArray,
    tie_weight: SingleArray,
    huber: float,
) -> Normals:
    """Build the normal equations of all observations at a state.

    Args:
        rows, ties: observations.
        weight: of the trajectory's prior.
        state: state at which they are linearised.
        row_weight: (n,) of the rows on planes; tie_weight: one per sighting, in their order.
        huber: see `Rows.summed`.
    """
    sums = rows.summed(state, row_weight, huber)
    p = len(rows.unknowns)
    free, right = sums.normal, sums.right
    square, count = float(sums.square[0]), int(sums.counts[0])
    for extra in extras(rows, state):
        sums.plane[extra.plane] += np.outer(extra.design, extra.design)
        sums.plane_right[extra.plane] += extra.design * extra.misclosure
        square, count = square + extra.misclosure**2, count + 1
    inverses = _inverted(sums.plane)
    planes = tuple(
        Feature(rows.lists[index], sums.mixed[sums.first[index] : sums.first[index + 1]], inverses[index], own)
        for index, own in enumerate(sums.plane_right)
    )
    tied, tie_square, tie_count = _tied(ties, state, tie_weight, free, right, huber)
    states = state.knots.reshape(-1)
    free[p:, p:] += weight.normal
    right[p:] += weight.normal @ states
    square += tie_square + float(states @ weight.normal @ states)
    for feature in (*planes, *tied):
        half = feature.mixed @ feature.inverse
        free[np.ix_(feature.unknowns, feature.unknowns)] -= half @ feature.mixed.T
        right[feature.unknowns] -= half @ feature.right
    design, misclosure = rows.unknowns.pseudo(state.values)
    whole = free.copy()
    whole[:p, :p] += design.T @ design
    right[:p] += design.T @ misclosure
    square += float(misclosure @ misclosure)
    count += tie_count + len(states) + len(misclosure)
    return Normals(free, whole, right, planes, tied, square, count, p)


def extras(rows: Rows, state: State) -> list[Extra]:
    """Return the rows of control on planes and of surveyed planes, at a state."""
    found = []
    rot = rows.flight.frame.rot_t_from_e
    firsts, seconds = tangents(state.normal_e)
    for index, plane in enumerate(rows.planes):
        normal_e, first, second = state.normal_e[index], firsts[index], seconds[index]
        for place, point in enumerate(plane.control):
            normal_t = rot @ normal_e
            sigma = float(np.sqrt(normal_t @ covariance_t(point) @ normal_t))
            away = (point.position_t - plane.centre_t) @ rot
            design = np.array([first @ away, second @ away, 1.0])
            misclosure = float(normal_e @ away + state.offset[index])
            found.append(Extra(index, place, design / sigma, misclosure / sigma, sigma))
        if plane.given_sigma_m is not None:
            sigma = plane.given_sigma_m
            found.append(Extra(index, -1, np.array([0.0, 0.0, 1.0]) / sigma, state.offset[index] / sigma, sigma))
        if plane.given_sigma_rad is not None:
            sigma, given = plane.given_sigma_rad, plane.normal_t @ rot
            for axis, tangent in enumerate((first, second)):
                design = np.eye(3)[axis] / sigma
                found.append(Extra(index, -1, design, float(-tangent @ given) / sigma, sigma))
    return found


def moved(state: State, step: tuple[FloatArray, FloatArray, FloatArray]) -> State:
    """Return the state after a step; normals keep their length."""
    done, of_planes, of_ties = step
    p = len(state.values)
    first, second = tangents(state.normal_e)
    normal = state.normal_e + first * of_planes[:, :1] + second * of_planes[:, 1:2]
    return replace(
        state,
        values=state.values + done[:p],
        knots=state.knots + done[p:].reshape(-1, 6),
        normal_e=normal / np.linalg.norm(normal, axis=1, keepdims=True),
        offset=state.offset + of_planes[:, 2],
        ties_e=state.ties_e + of_ties,
    )


def tie_share(seen: Seen, weight: float, huber: float) -> float:
    """Return a sighting's weight, multiplied by Huber's weight for its misclosure in sigmas."""
    size = float(np.sqrt(seen.misclosure_e @ np.linalg.solve(seen.covariance_e, seen.misclosure_e) / 3.0))
    return weight * (huber / size if 0.0 < huber < size else 1.0)


def _tied(
    ties: Ties, state: State, weights: SingleArray, normal: FloatArray, right: FloatArray, huber: float
) -> tuple[tuple[Feature, ...], float, int]:
    """Add the tie points' sightings to N11 and b1; return the tie points as features, Σ p w² and the number of rows."""
    square, count = 0.0, 0
    by_tie: list[list[tuple[Seen, float]]] = [[] for _ in ties.ties]
    for seen, weight in zip(ties.seen(state), weights.tolist(), strict=True):
        if seen is not None:
            by_tie[seen.tie].append((seen, tie_share(seen, weight, huber)))
    features = []
    for index, mine in enumerate(by_tie):
        unknowns = np.unique(np.concatenate([np.zeros(0, np.int64), *(seen.unknowns for seen, _ in mine)]))
        mixed, own, own_right = np.zeros((len(unknowns), 3)), np.zeros((3, 3)), np.zeros(3)
        for seen, weight in mine:
            inverse = weight * _inverted(seen.covariance_e)
            _add(normal, right, seen, inverse)
            np.add.at(mixed, np.searchsorted(unknowns, seen.unknowns), -seen.design.T @ inverse)
            own, own_right = own + inverse, own_right - inverse @ seen.misclosure_e
            square += float(seen.misclosure_e @ inverse @ seen.misclosure_e)
            count += 3 if weight > 0.0 else 0
        given = ties.control(index)
        if given is not None:
            inverse, away = _inverted(given[1]), state.ties_e[index] - given[0]
            own, own_right = own + inverse, own_right + inverse @ away
            square, count = square + float(away @ inverse @ away), count + 3
        features.append(Feature(unknowns, mixed, _inverted(own), own_right))
    return tuple(features), square, count


def _add(normal: FloatArray, right: FloatArray, seen: Seen, inverse: FloatArray) -> None:
    """Add a sighting to N11 and b1; a knot may occur twice if it is the only one, hence `np.add.at`."""
    product = seen.design.T @ inverse
    np.add.at(normal, np.ix_(seen.unknowns, seen.unknowns), product @ seen.design)
    np.add.at(right, seen.unknowns, product @ seen.misclosure_e)


def _back(features: Sequence[Feature], done: FloatArray) -> FloatArray:
    """Return the steps δ2 (q, 3) of features."""
    steps = [-one.inverse @ (one.right + one.mixed.T @ done[one.unknowns]) for one in features]
    return np.array(steps).reshape(-1, OF_PLANE)


def _solved(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Solve by Cholesky; the matrix is scaled to unit diagonal, as unknowns have units from metres to s²."""
    if not len(matrix):
        return right
    scale = scales(matrix)
    try:
        factor = cho_factor(matrix * np.outer(scale, scale), lower=True)
    except np.linalg.LinAlgError as error:
        raise NormalError("these observations do not determine a parameter; hold it, or give it a prior") from error
    shaped = scale if right.ndim == 1 else scale[:, np.newaxis]
    done: FloatArray = cho_solve(factor, right * shaped) * shaped
    return done


def _inverted(matrices: FloatArray) -> FloatArray:
    """Invert symmetric matrices (…, 3, 3); undetermined directions count as known."""
    if not len(matrices):
        return matrices
    inverse: Any = np.linalg.pinv(matrices, rcond=FLOOR, hermitian=True)
    done: FloatArray = inverse
    return done
