"""Make the observations of a calibration flight anew in every run, from a truth that fits the model exactly.

The flight is read and matched once. The ranges of its returns on planes are then changed so that every point lies
on its plane exactly, with the true calibration and the smoothed trajectory; these two are the truth. A run adds what
the sensors would add: trajectory errors drawn from the smoother's joint covariance at its own nodes, which are closer
together than the knots of the adjustment; the gyroscopes' random walk between nodes; noise of range, scan angle and
control. `benchmarks.calibration.accuracy` runs this and prints the figures.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import cholesky

from swath.calib.adjust import adjust
from swath.calib.control.points import control_planes, in_t
from swath.calib.equations.solve import Settings
from swath.calib.equations.trajectory_prior import Knots, TrajectoryPrior, apply, from_smoother, knots_of
from swath.calib.features import Features, Patch, Plane
from swath.calib.flight import Flight, Swath
from swath.calib.parameters import MODELS, ParameterOptions
from swath.calib.planes.fit import PlaneSettings
from swath.calib.planes.returns import thinned
from swath.calib.planes.search import find_planes
from swath.daemon.processing.calibration.returns import KNOT_S, read_flight, replaced
from swath.daemon.processing.control.place import place_control
from swath.daemon.processing.control.text import read_text
from swath.daemon.processing.flights.read import GeorefOptions as Logs
from swath.daemon.processing.flights.trajectory_choice import TrajectoryOptions
from swath.daemon.processing.setup.setup import Options
from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.navigation.cross_covariance import ErrorChain
from swath.georef.scanner.calibration import Calibration, read_calibration

MODEL = ParameterOptions("scanner")
SETTINGS = Settings(huber=0.0, family=0.0)  # the observations have no outliers
MOST_POINTS = 2000  # at most, of a plane in a strip
NODE_S = 0.02  # less than the spacing of the smoother's nodes, so that each is used
STEP_NS = 20_000_000  # step of the random walk between nodes
JITTER = 1e-9  # share of a variance, added because errors of neighbouring nodes are nearly equal


@dataclass(frozen=True, eq=False)
class Reference:
    """The truth of all runs, and the prior for their adjustment.

    Attributes:
        flight: its swaths hold only returns on planes; its heads start from the nominal installation.
        features: planes and control points; every point lies on its plane.
        truth: true calibration of the scanner.
        prior: prior of the trajectory, at the adjustment's knots.
        range_sigma_m: by swath, (n,) sigmas of the ranges, from their noise and the footprint on the surface.
        nodes: nodes of the smoother.
        walk: random walk of the attitude between nodes, rad/√s.
    """

    flight: Flight
    features: Features
    truth: Calibration
    prior: TrajectoryPrior
    range_sigma_m: tuple[FloatArray, ...]
    nodes: Knots
    walk: float


@dataclass(frozen=True)
class Outcome:
    """The result of one run.

    Attributes:
        names: names of the parameters.
        error, sigma: (p,) errors and sigmas of the parameters, SI.
        variance_factor: variance factor of all observations.
        groups: variance factors by group of observations.
        converged: whether the adjustment converged.
    """

    names: tuple[str, ...]
    error: FloatArray
    sigma: FloatArray
    variance_factor: float
    groups: dict[str, float]
    converged: bool


def read_reference(folder: Path, work: Path, rows: int, workers: int) -> tuple[Reference, FloatArray]:
    """Read and match a flight, and make the truth of all runs.

    Args:
        folder: the flight, as `swath sim fly` writes it.
        work: folder for the returns.
        rows: most returns to use.
        workers: number of processes.

    Returns:
        The reference, and the lower root (6k, 6k) of the nodes' joint covariance.
    """
    options = Options(datum="same", uncertainty=False)
    georef_options = Logs([folder], work, TrajectoryOptions(navigate=True), options, workers=workers)
    kept = read_flight(georef_options, work, lambda *_: None)
    (head,) = kept.flight.heads
    true_calibration = read_calibration((folder / f"{head.name}.true.toml").read_text("utf-8"), "truth")
    truth = head.start.changed(**{name: true_calibration.value(name) for name in MODELS[MODEL.model]})
    flight = replaced(kept.flight, {head.name: truth}, work, "truth")
    mapping = kept.logged[0].setup.mapping
    assert mapping is not None
    table = read_text((folder / "control.csv").read_text("utf-8"), Path("control.csv"))
    surveyed = in_t(place_control(table, None, mapping, np.empty((0, 2))).points, flight.frame)
    planes = find_planes(flight, PlaneSettings(most_points=MOST_POINTS))
    features = fewer(Features.joined([planes, control_planes(flight, surveyed)]), rows)
    compact, features = own_returns(flight, features)
    compact, features, sigmas = consistent(compact, features, truth)
    assert kept.logged[0].navigated is not None
    solved = kept.logged[0].navigated.legs[0].solved
    knots, nodes = knots_of(flight, KNOT_S), knots_of(flight, NODE_S, 1_000_000)
    prior = from_smoother(flight, [solved.error_chain(knots.time_ns)], KNOT_S)
    chain = solved.error_chain(nodes.time_ns)
    covariance = chain.covariance()
    nodes = Knots(np.zeros(len(chain), np.int64), chain.time_ns, np.zeros(len(chain), np.int64), NODE_S, False)
    reference = Reference(compact, features, truth, prior, sigmas, nodes, walked(chain, covariance))
    return reference, root_of(covariance)


def fewer(features: Features, rows: int) -> Features:
    """Return the features with large patches thinned, so that they hold at most so many returns together."""
    sizes = np.sort([len(patch.at) for plane in features.planes for patch in plane.patches])
    before = np.concatenate([[0], np.cumsum(sizes)])[:-1]
    caps = (rows - before) // np.arange(len(sizes), 0, -1)  # of the larger patches, if all smaller ones stay whole
    most = max(int(caps[int(np.argmax(caps <= sizes))]) if (caps <= sizes).any() else MOST_POINTS, 1)
    planes = tuple(
        replace(plane, patches=tuple(Patch(patch.swath, thinned(patch.at, most)) for patch in plane.patches))
        for plane in features.planes
    )
    return Features(planes)


def own_returns(flight: Flight, features: Features) -> tuple[Flight, Features]:
    """Return a flight that holds only the returns of these features, and the features with its indexes."""
    swaths: list[Swath] = []
    patches: list[dict[int, Patch]] = [{} for _ in features.planes]
    for index, swath in enumerate(flight.swaths):
        mine = [
            (p, patch.at) for p, plane in enumerate(features.planes) for patch in plane.patches if patch.swath == index
        ]
        at = np.concatenate([one for _, one in mine])
        owner = np.concatenate([np.full(len(one), p) for p, one in mine])
        order = np.argsort(at, kind="stable")
        at, owner = at[order], owner[order]
        for p, _ in mine:
            patches[p][index] = Patch(index, np.flatnonzero(owner == p))
        columns: dict[str, Any] = {
            name: np.ascontiguousarray(getattr(swath, name)[at])
            for name in ("rows", "time_ns", "points_t", "encoder_rate", "encoder_acceleration")
        }
        swaths.append(replace(swath, **columns))
    planes = (
        replace(plane, patches=tuple(mine[one] for one in sorted(mine)))
        for plane, mine in zip(features.planes, patches, strict=True)
    )
    return replace(flight, swaths=tuple(swaths)), Features(tuple(planes))


def consistent(
    flight: Flight, features: Features, truth: Calibration
) -> tuple[Flight, Features, tuple[FloatArray, ...]]:
    """Change ranges and control points so that they lie on their planes; return also the sigma of every range."""
    swaths, sigmas = [], []
    for index, swath in enumerate(flight.swaths):
        normal, centre = np.zeros((len(swath), 3)), np.zeros((len(swath), 3))
        for plane in features.planes:
            for patch in plane.patches:
                if patch.swath == index:
                    normal[patch.at], centre[patch.at] = plane.normal_t, plane.centre_t
        rows = swath.rows.copy()
        for _ in range(3):
            here = flight.place(replace(swath, rows=rows), truth)
            beyond = rows.copy()
            beyond["range_m"] += 1.0
            beam = flight.place(replace(swath, rows=beyond), truth) - here
            along = (normal * beam).sum(axis=1)
            rows["range_m"] -= (normal * (here - centre)).sum(axis=1) / along
        cosine = np.abs(along) / np.linalg.norm(beam, axis=1)
        noise = flight.heads[swath.head].noise
        foot_m = 0.25 * noise.divergence_rad * rows["range_m"] * np.sqrt(1.0 - cosine**2) / cosine
        sigmas.append(np.hypot(noise.range_m, foot_m))
        swaths.append(replace(swath, rows=rows))
    planes = []
    for plane in features.planes:
        points = tuple(
            replace(
                point,
                position_t=point.position_t - plane.normal_t * (plane.normal_t @ (point.position_t - plane.centre_t)),
            )
            for point in plane.control
        )
        planes.append(replace(plane, control=points))
    return replace(flight, swaths=tuple(swaths)), Features(tuple(planes)), tuple(sigmas)


def walked(chain: ErrorChain, covariance: FloatArray) -> float:
    """Return the random walk of the attitude's errors from node to node, rad/√s, where nodes are close together."""
    count = len(chain)
    joint = covariance.reshape(count, 6, count, 6)
    at, apart_s = np.arange(count - 1), np.diff(chain.time_ns) / 1e9
    moved = sum(
        joint[at, axis, at, axis] + joint[at + 1, axis, at + 1, axis] - 2.0 * joint[at, axis, at + 1, axis]
        for axis in range(3, 6)
    )
    near = apart_s < 2.0 * np.median(apart_s)
    return float(np.sqrt(np.median((moved / 3.0 / apart_s)[near])))


def root_of(covariance: FloatArray) -> FloatArray:
    """Compute the lower root of a covariance in place, because it has up to 1e8 elements."""
    sigmas = np.sqrt(np.diag(covariance))
    covariance /= sigmas
    covariance /= sigmas[:, np.newaxis]
    covariance[np.diag_indices(len(sigmas))] += JITTER
    root: FloatArray = cholesky(covariance.T, lower=True, overwrite_a=True, check_finite=False)
    root *= sigmas[:, np.newaxis]
    return root


def errors_along(reference: Reference, at_nodes: FloatArray, rng: np.random.Generator) -> tuple[Int64Array, FloatArray]:
    """Return times (m,) and trajectory errors (m, 6) that agree with given errors (k, 6) at the nodes.

    Between nodes the attitude follows a Brownian bridge.
    """
    nodes = reference.nodes.time_ns
    times = np.unique(np.concatenate([nodes, np.arange(nodes[0], nodes[-1], STEP_NS)]))
    near = np.abs(times - nodes[np.clip(np.searchsorted(nodes, times), 0, len(nodes) - 1)]) < 1_000_000_000
    times = times[near]
    since, at = (times - nodes[0]).astype(np.float64), (nodes - nodes[0]).astype(np.float64)
    errors = np.stack([np.interp(since, at, column) for column in at_nodes.T], axis=1)
    steps = rng.standard_normal((len(times), 3)) * np.sqrt(np.diff(times, prepend=times[0]) / 1e9)[:, np.newaxis]
    walk = reference.walk * steps.cumsum(axis=0)
    for axis in range(3):
        errors[:, 3 + axis] += walk[:, axis] - np.interp(since, at, walk[np.isin(times, nodes), axis])
    return times, errors


def run(reference: Reference, at_nodes: FloatArray, seed: np.random.SeedSequence) -> Outcome:
    """Draw the observations of one run and adjust them from the nominal installation.

    Args:
        reference: the truth.
        at_nodes: (k, 6) errors of the trajectory at the nodes.
        seed: seed of all other errors.
    """
    rng = np.random.default_rng(seed)
    times, errors = errors_along(reference, at_nodes, rng)
    along = TrajectoryPrior(np.zeros(len(times), np.int64), times, np.zeros(len(times), np.int64), np.zeros((0, 0)))
    flown = apply(reference.flight.trajectories[0], 0, along, -errors)
    swaths = []
    for swath, sigma_m in zip(reference.flight.swaths, reference.range_sigma_m, strict=True):
        rows = swath.rows.copy()
        rows["range_m"] += sigma_m * rng.standard_normal(len(rows))
        rows["encoder_rad"] += reference.flight.heads[swath.head].noise.angle_rad * rng.standard_normal(len(rows))
        swaths.append(replace(swath, rows=rows))
    flight = replace(reference.flight, trajectories=(flown,), swaths=tuple(swaths))
    features = Features(tuple(resurveyed(plane, rng) for plane in reference.features.planes))
    found = adjust(flight, features, MODEL, reference.prior, SETTINGS)
    truth = np.array([reference.truth.value(name.split(".", 1)[1]) for name in found.names])
    groups = {one.group: one.variance_factor for one in found.groups}
    return Outcome(found.names, found.values - truth, found.sigmas, found.variance_factor, groups, found.converged)


def resurveyed(plane: Plane, rng: np.random.Generator) -> Plane:
    """Return the plane with survey errors drawn for its control points."""
    points = (
        replace(point, position_t=point.position_t + point.sigma_m * rng.standard_normal(3)) for point in plane.control
    )
    return replace(plane, control=tuple(points))
