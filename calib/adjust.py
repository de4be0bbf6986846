"""Estimate the parameters of all scanners, trajectory errors, planes and tie points in one adjustment.

Every return on a plane gives one condition, n · x(parameters, trajectory, range, angle) + offset = 0, with the variance
M of the measurements (Gauss–Helmert: ISO/TS 19159-2 Eq. 16 to 20; Skaloud and Lichti 2006). Every sighting of a tie
point gives three (NGA Eq. 55 to 60). Conditions are linearised at the estimated unknowns and at the adjusted
observations. Coefficients at the observations as measured would bias the range scale by its variance times the number
of rows. That bias is negligible where a single row knows little of the range scale; it is several sigmas where
trajectory errors, which many rows share, keep that variance from falling with their number.

Trajectory errors are unknowns too, with the knowledge about them before the adjustment as their prior. They are
correlated in time and therefore the same for thousands of returns; a calibration that treats them as noise of single
returns reports sigmas that are far too small. Unknowns that the flight does not determine are held and reported
(`swath.calib.equations.observability`).

A held parameter has an error, too. With N the reduced normal matrix of the estimated parameters, B their part with the
held ones and S the plausible covariance of the held ones, the covariance is N⁻¹ + N⁻¹ B S Bᵀ N⁻¹, and −N⁻¹ B S between
the two (S. F. Schmidt, "Application of state-space methods to navigation problems", Advances in Control Systems 3,
1966).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import astuple, replace

import numpy as np

from swath.calib.equations.normals import NormalError
from swath.calib.equations.observability import spectrum
from swath.calib.equations.quality import Solution, trajectory_fit
from swath.calib.equations.robust import global_test
from swath.calib.equations.solve import Block, HeldEffects, Settings, Solved, counted, determined, settled
from swath.calib.equations.trajectory_prior import TrajectoryPrior
from swath.calib.features import Features
from swath.calib.flight import Flight
from swath.calib.outcome import Adjusted, Considered
from swath.calib.parameters import ParameterOptions, Unknowns, unknowns
from swath.georef.arrays import FloatArray
from swath.georef.progress import Tell, silent
from swath.georef.scanner.calibration import PARAMETERS, Calibration

Rematch = Callable[[dict[str, Calibration]], Features | None]

AS_USUAL = Settings()
STABLE = 0.1  # sigmas; a parameter that new correspondences move by less is stable
CONTRADICTED = 4.0  # sigmas; a flight that disagrees by more with a held value contradicts it
_NO_PRIOR = (
    "the adjustment took the trajectory's errors as independent from return to return, so the sigmas are too small, "
    "perhaps by a factor of 5 to 10; use a trajectory with sigmas and estimate its errors too"
)


def adjust(
    flight: Flight,
    features: Features,
    options: ParameterOptions,
    prior: TrajectoryPrior | None = None,
    settings: Settings = AS_USUAL,
    start: Mapping[str, Calibration] | None = None,
    rematch: Rematch | None = None,
    first: Mapping[str, Calibration] | None = None,
    doubted: Mapping[str, float] | None = None,
    entire: Rematch | None = None,
    tell: Tell = silent,
) -> Adjusted:
    """Estimate all unknowns, finding correspondences anew until they no longer change the result.

    Args:
        flight: returns and trajectories.
        features: observed planes, tie points and control.
        options: which parameters to estimate.
        prior: prior of trajectory errors; None: the trajectory's sigmas count as noise of single returns, and a note
            reports that.
        settings: settings of the solver.
        start: calibrations to start from, by scanner; None: the heads' own. Held parameters keep their values.
        rematch: finds the features anew with better calibrations; None, or if it returns None: the features stay.
        first: by scanner, boresight angles from which iterations begin; None: from the start.
        doubted: by name, as ``left.kappa_rad``, least sigma (SI) of its start where it is held.
        entire: returns all observations, once correspondences of a part of them are stable; None, or if it returns
            None: that part is everything.
        tell: called with the progress; the number of iterations follows from the observations.

    Returns:
        The result. Sigmas are those that the observations' sigmas imply, multiplied by the root of the variance factor
        where the global test rejects and that factor is above 1; they include the plausible errors of held parameters.

    Raises:
        ParameterError: the options cannot be met; NormalError: nothing can be solved.
    """
    if not features.planes and not features.ties:
        raise NormalError("the flight has neither planes nor tie points to adjust; use strips that overlap over roofs")
    asked, placed_with = unknowns(flight, options, start, first, doubted), None
    found: Solved | None = None
    for matching in range(1, settings.matchings + 1):
        before = found
        what = f"adjustment {matching}"
        tell(what, 0, 0, "iterations")
        found = settled(Block.of(flight, features, asked, prior, placed_with), settings, before, counted(tell, what))
        placed_with = found.calibrations()
        last = rematch is None or matching == settings.matchings or (before is not None and _stable(before, found))
        again = None if last or rematch is None else rematch(placed_with)
        if again is None:
            everything = None if entire is None else entire(placed_with)
            if everything is not None:
                whole = Block.of(flight, everything, asked, prior, placed_with)
                what = "adjustment, all planes"
                found = settled(whole, replace(settings, own_noise=True), found, counted(tell, what))
            tell("sigmas", 0, 0)
            return _adjusted(flight, found, settings, matching)
        features = again
    raise ValueError(f"matchings: got {settings.matchings}, want at least 1")


def predict(
    flight: Flight,
    features: Features,
    options: ParameterOptions,
    prior: TrajectoryPrior | None = None,
    settings: Settings = AS_USUAL,
    start: Mapping[str, Calibration] | None = None,
) -> tuple[Unknowns, FloatArray]:
    """Predict the covariance of an adjustment for planning: the same equations without misclosures.

    Returns:
        The unknowns that would be determined, with the held parameters, and their covariance (u, u).

    Raises:
        ParameterError, NormalError: see `adjust`.
    """
    block = determined(Block.of(flight, features, unknowns(flight, options, start), prior, None), settings)
    state, weights, asked = block.start(), block.weights(), block.rows.unknowns
    equations = block.normals(state, weights)
    p, covariance = equations.parameters, equations.covariance()
    moved = HeldEffects.at(block, state, weights, covariance).by_unit * [one.plausible for one in asked.considered]
    return asked, covariance[:p, :p] + moved @ moved.T


def _stable(before: Solved, found: Solved) -> bool:
    """Return whether new correspondences moved every parameter by less than `STABLE` sigmas."""
    names, values = before.solution.rows.unknowns.names, before.solution.state.values
    old = dict(zip(names, values.tolist(), strict=True))
    sigmas = np.sqrt(np.diag(found.solution.parameters))
    new = zip(found.solution.rows.unknowns.names, found.solution.state.values, sigmas, strict=True)
    return all(name in old and abs(value - old[name]) < STABLE * sigma for name, value, sigma in new)


def _of_noise(told: Flight, found: Flight) -> tuple[str, ...]:
    """Return one line for each scanner whose returns scatter less than its configured noise predicts."""
    lines = []
    for head, own in zip(told.heads, found.heads, strict=True):
        share = sum(astuple(own.noise)) / sum(astuple(head.noise))  # all noise terms share one scale, and some may be 0
        if share < 1.0:
            lines.append(
                f"returns of {head.name} scatter {share:.2f} times the value that range_sigma_m, angle_sigma_deg and "
                "divergence_mrad predict; the adjustment weights them by the larger value"
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
    """Return the held parameters with their sigmas, and the flight's estimate of those that it contradicts.

    The score of the held parameters has the covariance f I + I S I, where I is their information and S their plausible
    covariance. The parameter that exceeds its sigmas most is assumed to be wrong by the flight's estimate; this repeats
    until none exceeds them. A user who holds a parameter without a sigma states that it is right, however implausible:
    for that parameter its own part of S does not count.

    Args:
        asked: unknowns whose `considered` parameters are reported.
        effects: effects of the held parameters at the solution.
        factor: factor of the observations' variances.
    """
    sigmas = np.array([item.plausible for item in asked.considered], dtype=np.float64)
    likely = np.array([PARAMETERS[item.kind].plausible for item in asked.considered], dtype=np.float64)
    information, own = effects.information, np.diag(effects.information)
    seen = own * likely**2 > 1e-2  # otherwise rounding dominates: sigma ≥ 10 × plausible
    in_sigmas = np.where(seen, effects.score / np.where(seen, own, 1.0), np.nan)
    wrong = np.zeros(len(sigmas), np.bool_)
    words = {(one.scanner, one.name) for one in asked.held if not one.remedy}
    at_word = np.array([tuple(item.name.split(".", 1)) in words for item in asked.considered], np.bool_)
    at_word &= sigmas == likely  # a different sigma comes from the user or an earlier calibration
    while True:
        spread = np.diag(factor * information + (information * sigmas**2) @ information)
        spread = spread / np.where(seen, own, 1.0) ** 2 - np.where(seen & at_word, sigmas, 0.0) ** 2
        spread = np.sqrt(np.maximum(spread, 0.0))
        beyond = np.where(seen & ~wrong, np.abs(in_sigmas) / np.where(seen & (spread > 0.0), spread, 1.0), 0.0)
        worst = int(np.argmax(beyond)) if len(beyond) else -1
        if worst < 0 or beyond[worst] <= CONTRADICTED:
            break
        wrong[worst], sigmas[worst] = True, max(abs(float(in_sigmas[worst])), float(sigmas[worst]))
    found = []
    for at, item in enumerate(asked.considered):
        scanner, _, name = item.name.partition(".")
        told_sigma = float(spread[at]) if seen[at] else np.inf
        one = Considered(
            scanner, name, item.start, float(sigmas[at]), float(in_sigmas[at]), told_sigma, bool(wrong[at])
        )
        found.append(one)
    return tuple(found)


def _planes(solution: Solution) -> FloatArray:
    table = solution.rows.plane_table(solution.state)
    distance = table.offset - np.einsum("ij,ij->i", table.normal_e, table.centre_e)
    return np.column_stack([table.normal_e, distance])
