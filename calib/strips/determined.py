"""Decide which corrections of strips the returns determine, and estimate these (decision 0034; FORMULAS 7.4).

The calibration is held. Its errors move the estimates: with the mixed part M of the normal matrix, of unknowns and held
parameters, by −C M / f for each unit. What its covariance leaves that way is kept apart (FORMULAS 7.4).

The unknowns are scaled to prior sigmas of 1. N is the returns' normal matrix, b its right-hand side, f the variance
factor of their misclosures. All unknowns are estimated together, each with its prior:

    x̂ = C b / f,   C = (N / f + 1)⁻¹

An unknown is determined if at most 1/16 of its prior variance is left, C_ii, and the held calibration's errors move its
estimate by no more than its prior sigma. Only these estimates are used. The others
stay in the equations so that their errors do not go into the estimates that are used.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from swath.calib.equations.trajectory_prior import ERRORS
from swath.georef.arrays import BoolArray, FloatArray, Int64Array

LEAST_KNOWN = 15.0  # times the prior's information; below, a quarter or more of the prior's sigma is left
MOST_LEFT = 1.0 / (1.0 + LEAST_KNOWN)  # share of the prior variance that the returns may leave
MOST_OF_CALIBRATION = 1.0  # of the prior variance; beyond it, the correction is likely to be worse than none
MOST_LEFT_OF_BENDS = 0.5  # their prior is the stiffness of a curve that is determined as a whole
ALONG, DOWN, PITCH = 0, 2, 4  # indices of components
ORDERS = 3  # of a component's parameters: constant, drift, bends


@dataclass(frozen=True, eq=False)
class Quadratic:
    """The function χ²(x) = constant − 2 right · x + x · normal x, of corrections x (6k,) in l or parameters.

    Attributes:
        held: (6k, h) by how much one sigma of each independent error of the held calibration lowers `right`; (6k, 0):
            its file tells no sigmas.
    """

    normal: FloatArray
    right: FloatArray
    constant: float
    observations: int
    held: FloatArray

    def square(self, x: FloatArray) -> float:
        """Return χ² of corrections or parameters."""
        return float(self.constant - 2.0 * self.right @ x + x @ self.normal @ x)

    def of(self, basis: FloatArray) -> Quadratic:
        """Return χ² as a function of parameters (u,) with x = basis · parameters."""
        return Quadratic(
            basis.T @ self.normal @ basis,
            basis.T @ self.right,
            self.constant,
            self.observations,
            basis.T @ self.held,
        )


@dataclass(frozen=True, eq=False)
class Unknowns:
    """Describes the columns of the basis, (u,) each.

    Attributes:
        strip: index of the strip.
        component: along, across, down, turns about these: 0 … 5.
        order: 0: a component's constant, 1: its drift, 2: its bends.
    """

    strip: Int64Array
    component: Int64Array
    order: Int64Array

    def at(self, columns: Int64Array) -> Unknowns:
        """Return those of some columns."""
        return Unknowns(self.strip[columns], self.component[columns], self.order[columns])

    @property
    def part(self) -> Int64Array:
        """Number of each column's part: one order of one component of one strip."""
        return (self.strip * ERRORS + self.component) * ORDERS + self.order


@dataclass(frozen=True, eq=False)
class Solved:
    """Parameters, scaled to prior sigmas of 1: those that the returns determine as estimated, the others zero.

    Attributes:
        values: (u,).
        whole: (u,) estimates of all, whether determined or not.
        square: χ² with all estimates.
        freedom: number of parameters that the returns know of, in part: the trace of N (N + 1)⁻¹.
        determined: (u,) flags.
        outweighed: (u,) flags of parameters that the returns determine, but that the held calibration's errors move by
            more than their prior sigma.
        merged: (u,) flags of parameters whose error another one of the strip contains, because the returns show only
            their sum.
        left: (u,) share of the prior variance that the returns leave.
        covariance: (u, u) of the errors of `values` by the returns; of a parameter that contains a merged one: of the
            sum's.
        held: (u, h) by how much one sigma of each independent error of the held calibration moves `values`, or would
            move one that it outweighs.
    """

    values: FloatArray
    whole: FloatArray
    square: float
    freedom: float
    determined: BoolArray
    outweighed: BoolArray
    merged: BoolArray
    left: FloatArray
    covariance: FloatArray
    held: FloatArray

    @property
    def parameters(self) -> float:
        """Number of parameters that the returns determine."""
        return float(np.sum(1.0 - self.left[self.determined]))

    @classmethod
    def of(cls, quadratic: Quadratic, columns: Int64Array, unknowns: Unknowns) -> Solved:
        """Solve for some parameters, with the others held at zero.

        Misclosures above their sigmas count as noise: the variance factor, if above 1, reduces the information.
        """
        normal, right = quadratic.normal[np.ix_(columns, columns)], quadratic.right[columns]
        count = len(columns)
        inverse = np.linalg.inv(normal + np.eye(count))
        best = inverse @ right
        square = quadratic.constant - 2.0 * float(right @ best) + float(best @ normal @ best)
        freedom = count - float(np.trace(inverse))
        factor = max(1.0, square / max(quadratic.observations - freedom, 1.0))
        covariance = _left(normal, factor)
        left = np.diag(covariance).copy()
        merged = _merged(left, unknowns)
        free = ~merged
        if merged.any():
            covariance = np.eye(count)
            covariance[np.ix_(free, free)] = _left(normal[np.ix_(free, free)], factor)
            left[free] = np.diag(covariance)[free]
        whole = np.where(free, covariance @ np.where(free, right, 0.0) / factor, 0.0)
        determined = _determined(left, unknowns) & free
        held = -covariance @ np.where(free[:, np.newaxis], quadratic.held[columns], 0.0) / factor
        held[~determined] = 0.0
        outweighed = _outweighed(np.sum(held**2, axis=1), unknowns) & determined
        determined &= ~outweighed
        covariance[np.ix_(~determined, ~determined)] = np.eye(int((~determined).sum()))
        values = np.where(determined, whole, 0.0)
        return cls(values, whole, square, freedom, determined, outweighed, merged, left, covariance, held)


def _left(normal: FloatArray, factor: float) -> FloatArray:
    """Return the covariance (u, u) of unknowns whose prior sigmas are 1."""
    return np.asarray(np.linalg.inv(normal / factor + np.eye(len(normal))), np.float64)


def _determined(left: FloatArray, unknowns: Unknowns) -> BoolArray:
    """Return flags (u,) of determined parameters; without its constant a component has no drift, and so on.

    A component's bends count together.
    """
    mean = np.bincount(unknowns.part, left) / np.maximum(np.bincount(unknowns.part), 1)
    own = mean[unknowns.part] <= np.array([MOST_LEFT, MOST_LEFT, MOST_LEFT_OF_BENDS])[unknowns.order]
    for order in (1, 2):
        lacking = unknowns.part[~own & (unknowns.order == order - 1)] + 1
        own &= ~np.isin(unknowns.part, lacking)
    return np.asarray(own)


def _outweighed(moved: FloatArray, unknowns: Unknowns) -> BoolArray:
    """Return flags (u,) of parameters whose variance by the calibration, ``moved`` (u,), exceeds the prior's.

    A component's bends count together, and where a constant or a drift is outweighed, what follows it is too.
    """
    mean = np.bincount(unknowns.part, moved) / np.maximum(np.bincount(unknowns.part), 1)
    beyond = mean[unknowns.part] > MOST_OF_CALIBRATION
    for order in (1, 2):
        beyond |= np.isin(unknowns.part, unknowns.part[beyond & (unknowns.order == order - 1)] + 1)
    return np.asarray(beyond)


def _merged(left: FloatArray, unknowns: Unknowns) -> BoolArray:
    """Return flags (u,) of shifts along the course, or turns about the axis across it, that the other one contains.

    Both move the ground below alike. Where the returns do not determine both, the one that they know less is left out.
    """
    own, merged = _determined(left, unknowns), np.zeros(len(left), np.bool_)
    for strip in np.unique(unknowns.strip).tolist():
        for order in range(ORDERS):
            pair = [
                np.flatnonzero((unknowns.strip == strip) & (unknowns.component == one) & (unknowns.order == order))
                for one in (ALONG, PITCH)
            ]
            if not all(map(len, pair)) or all(own[one].all() for one in pair) or any(merged[one].any() for one in pair):
                continue
            less = max(pair, key=lambda one: float(left[one].mean()))
            merged |= (
                (unknowns.strip == strip)
                & (unknowns.component == unknowns.component[less[0]])
                & (unknowns.order >= order)
            )
    return merged
