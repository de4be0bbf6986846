"""The adjustment: parameters of all scanners, the trajectory's errors, planes and tie points, all at once.

Every return on a plane is one condition, n · x(parameters, trajectory, range, angle) + offset = 0, with the variance M
of what was measured (Gauss–Helmert: ISO/TS 19159-2 Eq. 16 to 20; Skaloud and Lichti 2006); a tie point is three a
sighting (NGA Eq. 55 to 60). Conditions are linearised at the estimated unknowns and at the observations as adjusted:
with coefficients of the observations as measured the range scale would be off by its variance times the number of rows,
which is nothing where a row knows little of it, and sigmas where the trajectory's errors leave it no better.

The trajectory's errors are unknowns too, with what is known of them beforehand as their prior: correlated in time, they
are the same for thousands of returns, and a calibration that takes them as noise of each return believes itself far
too much. What this flight does not determine is held, and said (`calib.observability`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from calib.features import Features
from calib.flight import Flight
from calib.normals import NormalError
from calib.observability import spectrum
from calib.outcome import Adjusted
from calib.parameters import Unknowns, Wish, unknowns
from calib.quality import Solution, trajectory_fit
from calib.robust import global_test
from calib.solve import Block, Settings, Solved, determined, settled
from calib.trajectory_errors import TrajectoryPrior
from georef.calibration import Calibration

FloatArray = NDArray[np.float64]
Rematch = Callable[[dict[str, Calibration]], Features | None]

AS_USUAL = Settings()
STABLE = 0.1  # sigmas by which new correspondences may still move a parameter
_NO_PRIOR = (
    "the trajectory's errors were taken as independent from return to return: sigmas are too small, perhaps by a "
    "factor of 5 to 10; want a trajectory with sigmas and its errors estimated along"
)


def adjust(
    flight: Flight,
    features: Features,
    wish: Wish,
    prior: TrajectoryPrior | None = None,
    settings: Settings = AS_USUAL,
    start: Mapping[str, Calibration] | None = None,
    rematch: Rematch | None = None,
) -> Adjusted:
    """Estimate.

    Args:
        flight: returns and trajectories.
        features: what was observed.
        wish: what is to be estimated.
        prior: of the trajectory's errors; None: its sigmas count as noise of single returns, and a note says so.
        settings: how.
        start: calibrations to start from, by scanner, with which the flight's points are placed; None: the heads' own.
        rematch: finds the features anew with better calibrations; None, or if it gives None: they stay.

    Returns:
        What was found. Sigmas are those that the observations' sigmas imply; where the global test rejects, times the
        root of the variance factor if that is above 1.

    Raises:
        ParameterError: the wish cannot be met; NormalError: nothing can be solved.
    """
    if not features.planes and not features.ties:
        raise NormalError("no planes and no tie points: nothing to adjust; want strips that overlap over roofs")
    asked, placed_with = unknowns(flight, wish, start), None
    found: Solved | None = None
    for matching in range(1, settings.matchings + 1):
        before = found
        found = settled(Block.of(flight, features, asked, prior, placed_with), settings, before)
        placed_with = found.calibrations()
        last = rematch is None or matching == settings.matchings or (before is not None and _stable(before, found))
        again = None if last or rematch is None else rematch(placed_with)
        if again is None:
            return _adjusted(found, settings, matching)
        features = again
    raise ValueError(f"matchings: got {settings.matchings}, want at least 1")


def predict(
    flight: Flight,
    features: Features,
    wish: Wish,
    prior: TrajectoryPrior | None = None,
    settings: Settings = AS_USUAL,
    start: Mapping[str, Calibration] | None = None,
) -> tuple[Unknowns, FloatArray]:
    """What would be found: the same equations without misclosures, for planning.

    Returns:
        The unknowns that would be determined, with what is held, and their covariance (u, u).

    Raises:
        ParameterError, NormalError: as of `adjust`.
    """
    block = determined(Block.of(flight, features, unknowns(flight, wish, start), prior, None), settings)
    equations = block.normals(block.start(), block.weights())
    p = equations.parameters
    return block.rows.unknowns, equations.covariance()[:p, :p]


def _stable(before: Solved, found: Solved) -> bool:
    """Whether new correspondences moved no parameter by much of its sigma."""
    names, values = before.solution.rows.unknowns.names, before.solution.state.values
    old = dict(zip(names, values.tolist(), strict=True))
    sigmas = np.sqrt(np.diag(found.solution.parameters))
    new = zip(found.solution.rows.unknowns.names, found.solution.state.values, sigmas, strict=True)
    return all(name in old and abs(value - old[name]) < STABLE * sigma for name, value, sigma in new)


def _adjusted(found: Solved, settings: Settings, matchings: int) -> Adjusted:
    solution, quality, asked = found.solution, found.quality, found.solution.rows.unknowns
    factor = quality.square / quality.redundancy if quality.redundancy > 0.0 else 1.0
    chance = global_test(quality.square, quality.redundancy)
    scaled = chance < settings.test_level and factor > 1.0
    covariance = solution.parameters * (factor if scaled else 1.0)
    sigmas = np.sqrt(np.diag(covariance))
    notes = (_NO_PRIOR,) if solution.rows.prior is None else solution.rows.prior.notes
    return Adjusted(
        calibrations=asked.finished(solution.state.values, covariance),
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
    )


def _planes(solution: Solution) -> FloatArray:
    table = solution.rows.plane_table(solution.state)
    distance = table.offset - np.einsum("ij,ij->i", table.normal_e, table.centre_e)
    return np.column_stack([table.normal_e, distance])
