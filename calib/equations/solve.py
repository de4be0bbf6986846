"""Solve an adjustment by iteration: linearise, solve, update; robustly at first, then without outliers."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from swath.calib.equations.normals import Normals, TrajectoryWeight, moved, normals
from swath.calib.equations.observability import Rules, decide
from swath.calib.equations.quality import Quality, Solution, examine
from swath.calib.equations.robust import HUBER, w_critical
from swath.calib.equations.rows import Rows, State
from swath.calib.equations.tie_rows import Ties
from swath.calib.equations.trajectory_prior import TrajectoryPrior
from swath.calib.features import Features
from swath.calib.flight import Flight
from swath.calib.outcome import Residuals
from swath.calib.parameters import Unknowns
from swath.georef.arrays import FloatArray, SingleArray
from swath.georef.progress import Tell
from swath.georef.scanner.calibration import Calibration

NOISE_TELLS = 1000.0  # redundancy above which residuals show how much a scanner's returns scatter
FEW = 1e-5  # of the rows; a change of so few rejections does not affect the result


@dataclass(frozen=True)
class Settings:
    """Settings of an adjustment.

    Attributes:
        huber: misclosures above this many sigmas lose weight while blunders are searched; 0: all keep theirs.
        family: probability that any good observation is rejected; 0: no rejection.
        tolerance: step at which the adjustment has converged, in sigmas, root of the mean square of parameters and
            states; the next step would be a hundredth of it.
        iterations: greatest number in each stage.
        rounds: greatest number of rejections with a new solution.
        matchings: greatest number of searches for correspondences.
        test_level: of the global test.
        thin_above: with more rows, a part of them is used for the first steps.
        rules: rules that decide which unknowns are observable.
        own_noise: where returns on planes scatter less than their sigmas predict, weight them by their actual scatter.
    """

    huber: float = HUBER
    family: float = 0.05
    tolerance: float = 0.02
    iterations: int = 15
    rounds: int = 3
    matchings: int = 3
    test_level: float = 0.01
    thin_above: int = 1_000_000
    rules: Rules = field(default_factory=Rules)
    own_noise: bool = False


@dataclass(frozen=True, eq=False)
class Block:
    """Observations and unknowns of one adjustment."""

    rows: Rows
    ties: Ties
    trajectory: TrajectoryWeight

    @classmethod
    def of(
        cls,
        flight: Flight,
        features: Features,
        asked: Unknowns,
        prior: TrajectoryPrior | None,
        placed_with: Mapping[str, Calibration] | None,
    ) -> Block:
        """Create the block from a flight's observed features.

        Raises:
            NormalError: the prior's covariance has no inverse.
        """
        rows = Rows(flight, features.planes, asked, prior)
        return cls(rows, Ties(rows, features.ties, placed_with), TrajectoryWeight(rows))

    def with_unknowns(self, asked: Unknowns) -> Block:
        """Return the same observations with other unknowns."""
        rows = Rows(self.rows.flight, self.rows.planes, asked, self.rows.prior)
        return Block(rows, self.ties.of(rows), self.trajectory)

    def weights(self) -> tuple[SingleArray, SingleArray]:
        """Return the weights of rows and sightings before any rejection."""
        sightings = sum(len(tie.sightings) for tie in self.ties.ties)
        return self.rows.weights(), np.ones(sightings, np.float32)

    def part(self, most: int) -> tuple[Block, tuple[SingleArray, SingleArray]]:
        """Return a block with a part of the rows, each weighted for the omitted ones; itself if there are few rows."""
        rows, sightings = self.weights()
        if len(rows) <= most:
            return self, (rows, sightings)
        step = -(-4 * len(rows) // most)
        less = self.rows.thinned(step)
        return replace(self, rows=less), (step * less.weights(), sightings)

    def with_noise(self, shares: FloatArray) -> Block:
        """Return the same observations with shares (h,) of the heads' configured noise."""
        rows = self.rows.with_noise(shares)
        return Block(rows, self.ties.of(rows), self.trajectory)

    def normals(self, state: State, weights: tuple[SingleArray, SingleArray], huber: float = 0.0) -> Normals:
        """Return the normal equations at a state."""
        return normals(self.rows, self.ties, self.trajectory, state, *weights, huber)

    def start(self) -> State:
        """Return the state before the first step."""
        return self.rows.start(len(self.ties.ties))


@dataclass(frozen=True, eq=False)
class HeldEffects:
    """Effects of held parameters on an adjustment (Schmidt 1966: "consider" parameters).

    Attributes:
        by_unit: (u, c) change of each unknown per unit of each held parameter's error.
        information: (c, c) of the observations about the held ones, unknowns, states and features eliminated.
        score: (c,) gradient there: information · (what the observations would change them by), 0 at the optimum.
    """

    by_unit: FloatArray
    information: FloatArray
    score: FloatArray

    @classmethod
    def at(
        cls, block: Block, state: State, weights: tuple[SingleArray, SingleArray], covariance: FloatArray
    ) -> HeldEffects:
        """Compute the effects at a solution, whose parameters and states have this covariance (n, n)."""
        asked = block.rows.unknowns
        p, c = len(asked), len(asked.considered)
        if not c:
            return cls(np.zeros((p, 0)), np.zeros((0, 0)), np.zeros(0))
        values = np.concatenate([state.values, [item.start for item in asked.considered]])
        wider = block.with_unknowns(asked.complete()).normals(replace(state, values=values), weights)
        held = np.arange(p, p + c)
        own = np.delete(np.arange(len(wider.normal)), held)
        mixed = wider.normal[np.ix_(own, held)]
        gain = covariance @ mixed
        information = wider.normal[np.ix_(held, held)] - mixed.T @ gain
        score = -(wider.right[held] - gain.T @ wider.right[own])
        return cls(-gain[:p], (information + information.T) / 2.0, score)


@dataclass(frozen=True, eq=False)
class Solved:
    """A solution with its quality and the number of linearisations."""

    solution: Solution
    quality: Quality
    iterations: int
    converged: bool

    def calibrations(self) -> dict[str, Calibration]:
        """Return the calibrations by scanner."""
        return self.solution.rows.unknowns.calibrations(self.solution.state.values)


def determined(block: Block, settings: Settings) -> Block:
    """Return the block without the unknowns that these observations, by their expected accuracy, do not determine."""
    part, weights = block.part(settings.thin_above)
    return _without(block, part.normals(part.start(), weights), settings) or block


def counted(tell: Tell, what: str) -> Callable[[], None]:
    """Return a function that tells of one more iteration of a phase."""
    numbers = itertools.count(1)
    return lambda: tell(what, next(numbers), 0, "iterations")


def settled(
    block: Block, settings: Settings, before: Solved | None = None, stepped: Callable[[], None] = lambda: None
) -> Solved:
    """Solve for the unknowns that are determined, both at the start and at the solution.

    Args:
        block: observations, and all unknowns that were requested.
        settings: settings of the adjustment.
        before: a solution with other correspondences, to start from.
        stepped: called before each iteration.

    Raises:
        NormalError: an unknown is not determined after all.
    """
    less: Block | None = determined(block, settings)
    while less is not None:
        block = less
        state = block.start() if before is None else _carried(before.solution, block)
        found = solved(block, settings, state, stepped)
        less, before = _without(block, found.solution.normals, settings), found
    return found


def solved(block: Block, settings: Settings, state: State, stepped: Callable[[], None] = lambda: None) -> Solved:
    """Iterate robustly until convergence, then without observations that the w-test rejects, until these stay the same.

    If there are many rows, the robust steps use a part of them.
    """
    part, taken = block.part(settings.thin_above)
    state, huber = moved(state, part.normals(state, taken).step()), settings.huber
    state, equations, count, converged = _iterated(part, settings, state, taken, huber, stepped)
    weights = block.weights()
    solution, quality = _examined(block, state, equations, weights)
    if settings.own_noise:
        shares = noise_shares(quality.residuals, block.rows.flight)
        if (shares < 1.0).any():
            block = block.with_noise(shares)
    for _ in range(settings.rounds):
        chosen = _kept(quality.residuals, weights, settings)
        changed = sum(int((new != old).sum()) for new, old in zip(chosen, weights, strict=True))
        if changed <= FEW * block.rows.count and huber == 0.0 and part is block:
            break
        weights, huber, part = chosen, 0.0, block
        del solution, quality  # frees memory before it is needed again: a third of a gigabyte for ten million rows
        state, equations, more, converged = _iterated(block, settings, state, weights, 0.0, stepped)
        solution, quality = _examined(block, state, equations, weights)
        count += more
    return Solved(solution, quality, count + 1, converged)


def noise_shares(residuals: Sequence[Residuals], flight: Flight) -> FloatArray:
    """Return by head the share (h,) of their sigmas that its returns on planes scatter, at most 1.

    The share is the root of the variance component Σ p e² / Σ r (Förstner 1979), increased by three of its own sigmas;
    it is 1 where the redundancy is too small.
    """
    shares = np.ones(len(flight.heads))
    for one in (one for one in residuals if one.group == "planes"):
        kept = one.weight > 0.0
        head = np.array([swath.head for swath in flight.swaths])[one.swath[kept]]
        squares = one.weight[kept] * (one.misclosure_m[kept].astype(np.float64) / one.sigma_m[kept]) ** 2
        square = np.bincount(head, squares, minlength=len(shares))
        free = np.bincount(head, one.redundancy[kept], minlength=len(shares))
        enough = free > NOISE_TELLS
        free = np.where(enough, free, 1.0)
        shares = np.where(enough, np.sqrt(square / free * (1.0 + 3.0 * np.sqrt(2.0 / free))), 1.0)
    return np.minimum(shares, 1.0)


def _examined(
    block: Block, state: State, equations: Normals, weights: tuple[SingleArray, SingleArray]
) -> tuple[Solution, Quality]:
    solution = Solution(block.rows, block.ties, block.trajectory, state, equations, equations.covariance(), *weights)
    return solution, examine(solution)


def _without(block: Block, equations: Normals, settings: Settings) -> Block | None:
    """Return the block with undetermined unknowns held, or observed at their start; None if all are determined."""
    asked = block.rows.unknowns
    held, weak = decide(equations.of_parameters, asked.names, asked.given_sigmas, settings.rules)
    assumed = {item.name for item in asked.items if item.assumed}
    if not held and weak.keys() <= assumed:
        return None
    return block.with_unknowns(
        asked.without(frozenset(f"{one.scanner}.{one.name}" for one in held), held).assuming(weak)
    )


def _carried(before: Solution, block: Block) -> State:
    """Return the start state with parameters and trajectory of another solution; planes and tie points are new."""
    state, names = block.start(), before.rows.unknowns.names
    old = dict(zip(names, before.state.values.tolist(), strict=True))
    new = zip(block.rows.unknowns.names, state.values.tolist(), strict=True)
    values = np.array([old.get(name, value) for name, value in new], dtype=np.float64)
    return replace(state, values=values, knots=before.state.knots)


def _iterated(
    block: Block,
    settings: Settings,
    state: State,
    weights: tuple[SingleArray, SingleArray],
    huber: float,
    stepped: Callable[[], None],
) -> tuple[State, Normals, int, bool]:
    """Iterate until a step is less than the tolerance."""
    for count in range(1, settings.iterations + 1):
        stepped()
        equations = block.normals(state, weights, huber)
        step = equations.step()
        state = moved(state, step)
        # δᵀ S δ is the sum of squares of independent combinations of the unknowns, each in its sigma
        if float(step[0] @ equations.normal @ step[0]) < settings.tolerance**2 * max(len(step[0]), 1):
            return state, equations, count, True
    return state, equations, settings.iterations, False


def _kept(
    residuals: Sequence[Residuals], before: tuple[SingleArray, SingleArray], settings: Settings
) -> tuple[SingleArray, SingleArray]:
    """Return weights of rows and sightings by the w-test; rejected observations that fit now are accepted again."""
    count = sum(len(one.normalised) for one in residuals)
    critical = w_critical(count, settings.family) if settings.family > 0.0 else np.inf
    rows, sightings = before
    for one in residuals:
        good = (np.abs(one.normalised) <= critical).astype(np.float32)
        if one.group == "planes":
            rows = good
        elif one.group == "ties":
            sightings = good.reshape(-1, 3).min(axis=1)
    return rows, sightings
