"""The adjustment: parameters of all scanners, the trajectory's errors, planes and tie points, all at once.

Every return on a plane is one condition, n · x(parameters, trajectory, range, angle) + offset = 0, with the variance M
of what was measured (Gauss–Helmert: ISO/TS 19159-2 Eq. 16 to 20; Skaloud and Lichti 2006); a tie point is three a
sighting (NGA Eq. 55 to 60). Conditions are linearised at the estimated unknowns and at the observations as adjusted:
with coefficients of the observations as measured the range scale would be off by its variance times the number of rows,
which is nothing where a row knows little of it, and sigmas where the trajectory's errors leave it no better.

The trajectory's errors are unknowns too, with what is known of them beforehand as their prior: correlated in time, they
are the same for thousands of returns, and a calibration that takes them as noise of each return believes itself far
too much. What this flight does not determine is held, and said (`swath.calib.equations.observability`).

A held parameter is wrong by something, too. With N the reduced normal matrix of the estimated ones, B their part with
the held ones and S what is plausible of these, the covariance is N⁻¹ + N⁻¹ B S Bᵀ N⁻¹, and −N⁻¹ B S between the two
(S. F. Schmidt, "Application of state-space methods to navigation problems", Advances in Control Systems 3, 1966).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import astuple, replace

import numpy as np

from swath.calib.equations.normals import NormalError
from swath.calib.equations.observability import spectrum
from swath.calib.equations.quality import Solution, trajectory_fit
from swath.calib.equations.robust import global_test
from swath.calib.equations.solve import Block, HeldEffects, Settings, Solved, determined, settled
from swath.calib.equations.trajectory_prior import TrajectoryPrior
from swath.calib.features import Features
from swath.calib.flight import Flight
from swath.calib.outcome import Adjusted, Considered
from swath.calib.parameters import ParameterOptions, Unknowns, unknowns
from swath.georef.arrays import FloatArray
from swath.georef.scanner.calibration import PARAMETERS, Calibration

Rematch = Callable[[dict[str, Calibration]], Features | None]

AS_USUAL = Settings()
STABLE = 0.1  # sigmas by which new correspondences may still move a parameter
CONTRADICTED = 4.0  # sigmas by which a flight may disagree with what is held
_NO_PRIOR = (
    "the trajectory's errors were taken as independent from return to return: sigmas are too small, perhaps by a "
    "factor of 5 to 10; want a trajectory with sigmas and its errors estimated along"
)


def adjust(
    flight: Flight,
    features: Features,
    wish: ParameterOptions,
    prior: TrajectoryPrior | None = None,
    settings: Settings = AS_USUAL,
    start: Mapping[str, Calibration] | None = None,
    rematch: Rematch | None = None,
    first: Mapping[str, Calibration] | None = None,
    doubted: Mapping[str, float] | None = None,
    entire: Rematch | None = None,
) -> Adjusted:
    """Estimate.

    Args:
        flight: returns and trajectories.
        features: what was observed.
        wish: what is to be estimated.
        prior: of the trajectory's errors; None: its sigmas count as noise of single returns, and a note says so.
        settings: how.
        start: calibrations to start from, by scanner; None: the heads' own. What is held keeps their values.
        rematch: finds the features anew with better calibrations; None, or if it gives None: they stay.
        first: by scanner, boresight angles from which iterations begin; None: from the start.
        doubted: by name, as ``left.kappa_rad``, least sigma (SI) of its start where it is held.
        entire: gives everything that was observed, once correspondences of a part of it stay; None, or if it gives
            None: that part is all.

    Returns:
        What was found. Sigmas are those that the observations' sigmas imply; where the global test rejects, times the
        root of the variance factor if that is above 1; and with what is plausible of the parameters that are held.

    Raises:
        ParameterError: the wish cannot be met; NormalError: nothing can be solved.
    """
    if not features.planes and not features.ties:
        raise NormalError("no planes and no tie points: nothing to adjust; want strips that overlap over roofs")
    asked, placed_with = unknowns(flight, wish, start, first, doubted), None
    found: Solved | None = None
    for matching in range(1, settings.matchings + 1):
        before = found
        found = settled(Block.of(flight, features, asked, prior, placed_with), settings, before)
        placed_with = found.calibrations()
        last = rematch is None or matching == settings.matchings or (before is not None and _stable(before, found))
        again = None if last or rematch is None else rematch(placed_with)
        if again is None:
            everything = None if entire is None else entire(placed_with)
            if everything is not None:
                whole = Block.of(flight, everything, asked, prior, placed_with)
                found = settled(whole, replace(settings, own_noise=True), found)
            return _adjusted(flight, found, settings, matching)
        features = again
    raise ValueError(f"matchings: got {settings.matchings}, want at least 1")


def predict(
    flight: Flight,
    features: Features,
    wish: ParameterOptions,
    prior: TrajectoryPrior | None = None,
    settings: Settings = AS_USUAL,
    start: Mapping[str, Calibration] | None = None,
) -> tuple[Unknowns, FloatArray]:
    """Return what would be found: the same equations without misclosures, for planning.

    Returns:
        The unknowns that would be determined, with what is held, and their covariance (u, u).

    Raises:
        ParameterError, NormalError: as of `adjust`.
    """
    block = determined(Block.of(flight, features, unknowns(flight, wish, start), prior, None), settings)
    state, weights, asked = block.start(), block.weights(), block.rows.unknowns
    equations = block.normals(state, weights)
    p, covariance = equations.parameters, equations.covariance()
    moved = HeldEffects.at(block, state, weights, covariance).by_unit * [one.plausible for one in asked.considered]
    return asked, covariance[:p, :p] + moved @ moved.T


def _stable(before: Solved, found: Solved) -> bool:
    """Return whether new correspondences moved no parameter by much of its sigma."""
    names, values = before.solution.rows.unknowns.names, before.solution.state.values
    old = dict(zip(names, values.tolist(), strict=True))
    sigmas = np.sqrt(np.diag(found.solution.parameters))
    new = zip(found.solution.rows.unknowns.names, found.solution.state.values, sigmas, strict=True)
    return all(name in old and abs(value - old[name]) < STABLE * sigma for name, value, sigma in new)


def _of_noise(told: Flight, found: Flight) -> tuple[str, ...]:
    """Return by how much scanners' returns scatter less than was told, a line each."""
    lines = []
    for head, own in zip(told.heads, found.heads, strict=True):
        share = sum(astuple(own.noise)) / sum(astuple(head.noise))  # all are scaled alike, and some may be 0
        if share < 1.0:
            lines.append(
                f"returns of {head.name} scatter {share:.2f} times what range_sigma_m, angle_sigma_deg and "
                "divergence_mrad let expect, and were weighed by that"
            )
    return tuple(lines)


def _adjusted(flight: Flight, found: Solved, settings: Settings, matchings: int) -> Adjusted:
    solution, quality, asked = found.solution, found.quality, found.solution.rows.unknowns
    factor = quality.square / quality.redundancy if quality.redundancy > 0.0 else 1.0
    chance = global_test(quality.square, quality.redundancy)
    scaled = chance < settings.test_level and factor > 1.0
    effects = HeldEffects.at(
        Block(solution.rows, solution.ties, solution.trajectory),
        solution.state,
        (solution.row_weight, solution.tie_weight),
        solution.covariance,
    )
    considered = considered_of(asked, effects, factor if scaled else 1.0)
    held_sigmas = np.array([one.sigma for one in considered], dtype=np.float64)
    moved = effects.by_unit * held_sigmas
    covariance = solution.parameters * (factor if scaled else 1.0) + moved @ moved.T
    sigmas = np.sqrt(np.diag(covariance))
    notes = (_NO_PRIOR,) if solution.rows.prior is None else solution.rows.prior.notes
    notes += _of_noise(flight, solution.rows.flight)
    return Adjusted(
        calibrations=asked.finished(solution.state.values, covariance, held_sigmas, moved),
        names=asked.names,
        start=asked.start,
        values=solution.state.values,
        sigmas=sigmas,
        prior_sigmas=asked.prior_sigmas,
        correlation=covariance / np.outer(sigmas, sigmas),
        held=asked.held,
        trajectory=trajectory_fit(solution),
        residuals=quality.residuals,
        groups=quality.groups,
        control=quality.control,
        variance_factor=factor,
        redundancy=quality.redundancy,
        global_test=chance,
        iterations=found.iterations,
        matchings=matchings,
        converged=found.converged,
        least_detectable=quality.least_detectable,
        spectrum=spectrum(solution.normals.of_parameters),
        scaled=scaled,
        notes=notes,
        planes_e=_planes(solution),
        considered=considered,
        moved=moved,
    )


def considered_of(asked: Unknowns, effects: HeldEffects, factor: float) -> tuple[Considered, ...]:
    """Return the held parameters with their sigmas; where the flight contradicts one, with what the flight says.

    The score of the held ones has the covariance f I + I S I, with I their information and S what is plausible of them.
    The one that is farthest beyond is taken to be wrong by what the flight says, until none is. Who holds one and gives
    no sigma says that it is right, whatever is plausible: of that one its own part of S does not count.

    Args:
        asked: whose `considered` they are.
        effects: at the solution.
        factor: of the observations' variances.
    """
    sigmas = np.array([item.plausible for item in asked.considered], dtype=np.float64)
    likely = np.array([PARAMETERS[item.kind].plausible for item in asked.considered], dtype=np.float64)
    information, own = effects.information, np.diag(effects.information)
    seen = own * likely**2 > 1e-2  # else the flight knows it to ten times what is plausible, and rounding as much
    told = np.where(seen, effects.score / np.where(seen, own, 1.0), np.nan)
    wrong = np.zeros(len(sigmas), np.bool_)
    words = {(one.scanner, one.name) for one in asked.held if not one.remedy}
    at_word = np.array([tuple(item.name.split(".", 1)) in words for item in asked.considered], np.bool_)
    at_word &= sigmas == likely  # else the user, or an earlier calibration, gave a sigma
    while True:
        spread = np.diag(factor * information + (information * sigmas**2) @ information)
        spread = spread / np.where(seen, own, 1.0) ** 2 - np.where(seen & at_word, sigmas, 0.0) ** 2
        spread = np.sqrt(np.maximum(spread, 0.0))
        beyond = np.where(seen & ~wrong, np.abs(told) / np.where(seen & (spread > 0.0), spread, 1.0), 0.0)
        worst = int(np.argmax(beyond)) if len(beyond) else -1
        if worst < 0 or beyond[worst] <= CONTRADICTED:
            break
        wrong[worst], sigmas[worst] = True, max(abs(float(told[worst])), float(sigmas[worst]))
    found = []
    for at, item in enumerate(asked.considered):
        scanner, _, name = item.name.partition(".")
        told_sigma = float(spread[at]) if seen[at] else np.inf
        one = Considered(scanner, name, item.start, float(sigmas[at]), float(told[at]), told_sigma, bool(wrong[at]))
        found.append(one)
    return tuple(found)


def _planes(solution: Solution) -> FloatArray:
    table = solution.rows.plane_table(solution.state)
    distance = table.offset - np.einsum("ij,ij->i", table.normal_e, table.centre_e)
    return np.column_stack([table.normal_e, distance])
