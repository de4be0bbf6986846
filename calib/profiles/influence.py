"""Compute how a profile's result depends on every parameter, and on the trajectory at every moment."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from swath.calib.equations.trajectory_prior import ERRORS, TrajectoryPrior
from swath.calib.flight import Flight, Swath
from swath.calib.profiles.measure import PARAMETER, Ground
from swath.calib.profiles.sections import Corridor
from swath.calib.profiles.stepwise import Profile
from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.scanner.calibration import PARAMETERS, Calibration

STEP = {"rad": 1e-5, "m": 1e-3, "s": 1e-6}  # steps of a parameter by its unit; otherwise the next one
PURE_STEP = 1e-5


@dataclass(frozen=True, eq=False)
class Influence:
    """Derivatives of a profile's result.

    Attributes:
        by_parameter: per unit of the correction that a parameter of its scanner needs.
        by_knot: (6 knots,) per unit of the trajectory's correction, as in `TrajectoryPrior`.
        by_target: per metre of a surveyed point's height, by name.
    """

    by_parameter: Mapping[str, float]
    by_knot: FloatArray
    by_target: Mapping[str, float] = field(default_factory=dict)


def influence(
    flight: Flight,
    profile: Profile,
    calibrations: Mapping[str, Calibration],
    prior: TrajectoryPrior,
    estimated: Collection[str],
) -> Influence:
    """Compute the derivatives of a profile's result.

    Args:
        flight: with the points used for the measurement.
        profile: the profile.
        calibrations: of the points, by scanner.
        prior: prior with the knots.
        estimated: parameters that matter, as ``left.omega_rad``.
    """
    calibration = calibrations[profile.scanner]
    wanted = set(PARAMETER.values()) | {name.partition(".")[2] for name in estimated}
    parameters = [parameter.name for parameter in PARAMETERS if parameter.name in wanted]
    by_parameter, by_knot = np.zeros(len(parameters)), np.zeros((len(prior), ERRORS))
    for swath, sign in ((profile.first, 1.0), (profile.second, -1.0)):
        if swath < 0:
            continue
        pieces = _pieces(flight, flight.swaths[swath], profile, calibration, parameters)
        gain = -sign * profile.gain  # the correction is the negative error
        by_parameter += gain @ pieces.by_parameter
        _to_knots(
            by_knot, prior, flight.swaths[swath].trajectory_index, pieces.time_ns, gain[:, np.newaxis] * pieces.by_state
        )
    targets = dict(zip(profile.targets, profile.gain.tolist(), strict=False))
    return Influence(dict(zip(parameters, by_parameter.tolist(), strict=True)), by_knot.ravel(), targets)


@dataclass(frozen=True, eq=False)
class _Pieces:
    """The pieces (k,) of one swath: the times at which they were seen, and the derivatives of their heights.

    Attributes:
        time_ns: (k,).
        by_state: (k, 6) per metre of the body to north, east, down, per radian of its turns about them.
        by_parameter: (k, parameters).
    """

    time_ns: Int64Array
    by_state: FloatArray
    by_parameter: FloatArray


def _pieces(
    flight: Flight, swath: Swath, profile: Profile, calibration: Calibration, parameters: Sequence[str]
) -> _Pieces:
    small, piece = _returns(swath, profile.cells)
    rays = flight.rays(small, calibration, with_axes=False)
    origin_t, points_t = flight.frame.t_from_e(rays.origin_e), flight.frame.t_from_e(rays.points_e)
    slope = profile.slope_t[piece]
    east, north, up = (points_t - origin_t).T
    slope_e, slope_n, down = slope[:, 0], slope[:, 1], -up
    ones = np.ones(len(piece))
    turns = (-east + slope_e * down, north - slope_n * down, slope_n * east - slope_e * north)
    states = np.stack([-slope_n, -slope_e, -ones, *turns], axis=1)
    changes = np.zeros((len(piece), len(parameters)))
    for column, name in enumerate(parameters):
        unit = next(one.name for one in PARAMETERS if one.name == name).rpartition("_")[2]
        step = STEP.get(unit, PURE_STEP)
        moved = flight.place(small, calibration.changed(**{name: calibration.value(name) + step})) - points_t
        changes[:, column] = (moved[:, 2] - (slope * moved[:, :2]).sum(axis=1)) / step
    begin_ns = int(small.time_ns[0]) if len(small) else 0
    since = _means((small.time_ns - begin_ns).astype(np.float64)[:, np.newaxis], piece, len(profile.cells))[:, 0]
    return _Pieces(
        begin_ns + np.rint(since).astype(np.int64),
        _means(states, piece, len(profile.cells)),
        _means(changes, piece, len(profile.cells)),
    )


def _returns(swath: Swath, cells: Sequence[Corridor]) -> tuple[Swath, Int64Array]:
    """Return the returns of all cells, one cell after the other, and the cell of each return."""
    ground = Ground.of(swath)
    parts = [ground.rows_near(cell) for cell in cells]
    piece = np.repeat(np.arange(len(cells)), [len(part) for part in parts])
    return ground.taken(np.concatenate([np.zeros(0, np.int64), *parts])), piece


def _means(values: FloatArray, group: Int64Array, groups: int) -> FloatArray:
    """Return means (groups, c) of columns (n, c); 0 for empty groups."""
    count = np.maximum(np.bincount(group, minlength=groups), 1)
    return np.stack([np.bincount(group, column, groups) / count for column in values.T], axis=1)


def _to_knots(
    by_knot: FloatArray, prior: TrajectoryPrior, trajectory_index: int, time_ns: Int64Array, effects: FloatArray
) -> None:
    """Distribute effects (k, 6) at moments (k,) to the knots (knots, 6) before and after them."""
    before, after, share = prior.between(trajectory_index, time_ns)
    np.add.at(by_knot, before, (1.0 - share[:, np.newaxis]) * effects)
    np.add.at(by_knot, after, share[:, np.newaxis] * effects)
