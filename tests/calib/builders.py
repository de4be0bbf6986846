"""Rows of equations, control points and trajectories that several tests of the adjustment use."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from swath.calib.equations.rows import Rows, State
from swath.calib.equations.trajectory_prior import TrajectoryPrior
from swath.calib.features import ControlPoint, Features
from swath.georef.arrays import FloatArray
from swath.georef.trajectory.trajectory import Trajectory
from tests.calib.roofs import START_NS, Made


def design(rows: Rows, state: State) -> tuple[FloatArray, FloatArray, FloatArray, list[int]]:
    """Return columns of all unknowns except the planes' (n, u), f and M (n,), and planes (n,)."""
    columns, misclosures, variances, planes = [], [], [], []
    for batch, looks in rows.looks(state):
        begin = 0
        for run in batch.runs:
            mine = slice(begin, begin + len(run.at))
            at, expanded = rows.expansion(run, state.normal_e[run.plane])
            whole = np.zeros((len(run.at), rows.size))
            for one, column in zip(at.tolist(), (looks.design[mine, : expanded.shape[1]] @ expanded.T).T, strict=True):
                whole[:, one] += column
            columns.append(whole)
            planes += [run.plane] * len(run.at)
            begin += len(run.at)
        misclosures.append(looks.misclosure)
        variances.append(looks.variance)
    return np.concatenate(columns), np.concatenate(misclosures), np.concatenate(variances), planes


def shifted(flown: Trajectory, prior: TrajectoryPrior, errors_e: FloatArray) -> Trajectory:
    """Add errors (k, 6) in e at the knots to a trajectory, linear between them and constant beyond them."""
    seconds, knots = (flown.time_ns - START_NS) / 1e9, (prior.time_ns - START_NS) / 1e9
    error = np.stack([np.interp(seconds, knots, column) for column in errors_e.T], axis=1)
    turned = Rotation.from_rotvec(error[:, 3:]) * Rotation.from_quat(flown.q_e_from_b[:, [1, 2, 3, 0]])
    return replace(flown, position_e=flown.position_e + error[:, :3], q_e_from_b=turned.as_quat()[:, [3, 0, 1, 2]])


def in_planes(rows: Rows, state: State) -> tuple[FloatArray, list[int]]:
    """Return adjusted places of points in their planes (r, 2), and the plane of each."""
    places, planes = [], []
    for batch, looks in rows.looks(state):
        begin = 0
        for run in batch.runs:
            first = rows.expansion(run, state.normal_e[run.plane])[1].shape[1]
            places.append(looks.design[begin : begin + len(run.at), first : first + 2])
            planes += [run.plane] * len(run.at)
            begin += len(run.at)
    return np.concatenate(places), planes


def controlled(built: Made, seed: int = 9) -> Features:
    """Add ten surveyed points of 1 cm to the flat planes, two a plane."""
    g, planes = np.random.default_rng(seed), list(built.features.planes)
    for index in range(0, 25, 5):
        points = []
        for number in range(2):
            at = planes[index].centre_t + np.array([*g.uniform(-5, 5, 2), 0.01 * g.normal()])
            points.append(ControlPoint(f"p{index}.{number}", at, 0.01))
        planes[index] = replace(planes[index], control=tuple(points))
    return Features(tuple(planes))
