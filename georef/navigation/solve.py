"""Solve a whole flight: filter, smoother, noise estimates, and further passes from the smoothed start.

The filter is linear about its own state, which is inaccurate while the heading is hardly known: a pass that begins with
the smoothed attitude has small errors from its first sample on. The prior knowledge of the start keeps its mean and its
sigmas (`smoother`), so that no information counts twice. A GNSS time offset is removed from the observations' times in
the same way, so that the remaining offset is small. The solutions are in GNSS's time, in which the laser fires too: the
epochs of the inertial unit less the whole offset.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from swath.georef.arrays import BoolArray, ByteArray, FloatArray, StructArray
from swath.georef.geodesy.earth import geodetic_from_e, rot_e_from_l
from swath.georef.geodesy.rotations import attitude_of, rot_from_quaternion
from swath.georef.navigation.cross_covariance import ErrorChain, error_chain
from swath.georef.navigation.filter.error_model import MOVED
from swath.georef.navigation.filter.filter import FilterRun, run_filter, start_state
from swath.georef.navigation.filter.smoother import SmoothedNodes, difference, forward, smooth_nodes, solution_of
from swath.georef.navigation.filter.stores import IN_MEMORY, Storage
from swath.georef.navigation.filter.strapdown import ATTITUDE, TIME_OFFSET
from swath.georef.navigation.heading_noise import find_heading_noise
from swath.georef.navigation.inputs import Inertial, Setup, Solution, Start
from swath.georef.navigation.noise import OF_GNSS, NoiseFound, Run, find_noise, not_blunders, rescaled
from swath.georef.progress import Tell, silent
from swath.georef.timescales import SECOND_NS

MOST_PASSES = 3
STRETCH_S = 600.0  # part of the flight on which noise hypotheses are compared
MOST_RESCALED = 2  # number of corrections by the whole flight to the scales found on that part
LINEAR_SHARE = 0.1  # greatest square of the angle, in units of the sigma
OFFSET_LEFT_S = 5e-4
WEAK = 0.5  # of the prior sigma: an estimate that keeps more has learnt little


@dataclass(frozen=True)
class Report:
    """Results of solving besides the trajectory.

    Attributes:
        passes: their number.
        start_change_rad: (passes,) angle between the smoothed attitude at the start and the assumed one.
        noise: of GNSS; None: not requested.
        time_offset_s: of GNSS, all passes together; 0 where not estimated.
        weak: names of the estimates that the flight hardly determines.
        setup: of the smoothed flight.
    """

    passes: int
    start_change_rad: tuple[float, ...]
    noise: NoiseFound | None
    time_offset_s: float
    weak: tuple[str, ...]
    setup: Setup


@dataclass(frozen=True, eq=False)
class Solved:
    """A solved flight: forward, from data up to each moment, and smoothed, from all data.

    Attributes:
        forward, smoothed: in GNSS's time, by the offset from the whole flight.
        report: further results.
        run: the smoothed run of the filter; in the inertial unit's time.
    """

    forward: Solution
    smoothed: Solution
    report: Report
    run: FilterRun

    def error_chain(self, time_ns: ArrayLike) -> ErrorChain:
        """Return the smoothed errors' chain at the nodes nearest to given times (GNSS's); see `error_chain`."""
        offset_ns = round(self.report.time_offset_s * SECOND_NS)
        chain = error_chain(self.run, np.asarray(time_ns, dtype=np.int64) + offset_ns)
        return replace(chain, time_ns=chain.time_ns - offset_ns)


def solve(
    inertial: Inertial,
    observations: StructArray,
    setup: Setup,
    start: Start,
    *,
    noise_from_flight: bool = True,
    storage: Storage = IN_MEMORY,
    tell: Tell = silent,
) -> Solved:
    """Filter and smooth a whole flight.

    Args:
        inertial, observations: of the flight, observations in any order.
        setup, start: of the first pass.
        noise_from_flight: whether to estimate and use GNSS's noise: factors on the sigmas of positions and velocities
            by fix type and of headings, and the lasting share of their errors; see `noise`, `heading_noise`.
        storage: where the runs and the solutions are kept.
        tell: called with the progress; the number of runs follows from the flight.
    """
    runs = 0

    def filtered(rows: StructArray) -> FilterRun:
        nonlocal runs
        runs += 1
        what, total = f"filter, run {runs}", len(inertial)
        tell(what, 0, total, "samples")
        return run_filter(
            inertial,
            rows,
            setup,
            start,
            storage=storage,
            passed=lambda samples: tell(what, samples, total, "samples"),
        )

    run = filtered(observations)
    found = None
    if noise_from_flight:
        tell("noise of GNSS", 0, 0)
        found = _noise(inertial, observations, setup, start, run)
        for _ in range(1 + MOST_RESCALED):
            if setup is found.setup:
                break
            setup = found.setup
            run = filtered(observations)
            found = replace(found, setup=rescaled(setup, run.innovations[not_blunders(run.innovations)])[0])
        found = replace(found, setup=setup)
    tell("smoother", 0, 0)
    flown, nodes = forward(run), smooth_nodes(run)
    changes, offset_s, asked = [_change(nodes)], 0.0, start
    while (_bent(nodes) or abs(nodes.state[0, TIME_OFFSET]) > OFFSET_LEFT_S) and len(changes) < MOST_PASSES:
        offset_s += float(nodes.state[0, TIME_OFFSET])
        start = replace(start, attitude_rad=_attitude(nodes))
        run = filtered(_shifted(observations, offset_s))
        tell("smoother", 0, 0)
        nodes = smooth_nodes(run, _mean(run, asked, offset_s))
        changes.append(_change(nodes))
    whole_s = offset_s + float(nodes.state[0, TIME_OFFSET])
    flown = _in_gnss_time(flown, 0.0, whole_s)
    smoothed = _in_gnss_time(solution_of(run, nodes), offset_s, whole_s)
    report = Report(len(changes), tuple(changes), found, whole_s, _weak(smoothed, setup), setup)
    return Solved(flown, smoothed, report, run)


def _noise(inertial: Inertial, observations: StructArray, setup: Setup, start: Start, run: FilterRun) -> NoiseFound:
    """Find the noise on the first `STRETCH_S` seconds."""
    stretch = stretch_of(inertial, observations, start)
    return find_heading_noise(find_noise(run.innovations, stretch, setup), run.innovations, stretch)


def stretch_of(inertial: Inertial, observations: StructArray, start: Start) -> Run:
    """Return a function from a setup to the first `STRETCH_S` seconds' innovations, one row per observation."""
    end_ns = start.time_ns + round(STRETCH_S * SECOND_NS)
    part = inertial.between(0, int(np.searchsorted(inertial.time_ns, end_ns)))
    rows = observations[observations["time_ns"] < end_ns]

    def stretch(asked: Setup) -> StructArray:
        return run_filter(part, rows, asked, start).innovations

    return stretch


def _attitude(nodes: SmoothedNodes) -> FloatArray:
    """Return smoothed roll, pitch, heading (3,) of the first node."""
    lat, lon, _ = geodetic_from_e(nodes.state[0, :3])
    rot = rot_e_from_l(lat, lon).T @ rot_from_quaternion(nodes.state[0, ATTITUDE : ATTITUDE + 4])
    return np.array(attitude_of(rot), dtype=np.float64)


def _mean(run: FilterRun, asked: Start, offset_s: float) -> FloatArray:
    """Return the mean (n,) of a run's errors at its start, given the requested start and the removed time offset, s."""
    mean = np.zeros(run.layout.size)
    difference(start_state(run.setup, asked), start_state(run.setup, run.start), mean[:MOVED])
    if run.layout.time_offset >= 0:
        mean[run.layout.time_offset] = -offset_s
    return mean


def _change(nodes: SmoothedNodes) -> float:
    """Return the angle between the smoothed attitude at the start and the assumed one."""
    return float(np.linalg.norm(nodes.leave[0, 6:]))


def _bent(nodes: SmoothedNodes) -> bool:
    """Return whether the square of the change at the start is too large against the sigma for a linear treatment."""
    return bool(_change(nodes) ** 2 > LINEAR_SHARE * nodes.sigma[0, 6:].min())


def _of_gnss(kinds: ByteArray) -> BoolArray:
    return np.isin(kinds, [int(kind) for kind in OF_GNSS])


def _shifted(observations: StructArray, offset_s: float) -> StructArray:
    """Return observations with the offset added to the times of GNSS."""
    rows = observations.copy()
    rows["time_ns"][_of_gnss(rows["kind"])] += round(offset_s * SECOND_NS)
    return rows


def _in_gnss_time(solution: Solution, taken_s: float, whole_s: float) -> Solution:
    """Return a solution in the inertial unit's time converted to GNSS's: its epochs less the whole offset.

    Args:
        solution: its innovations of GNSS are at the observations' times plus taken_s.
        taken_s: the offset already added to the observations' times.
        whole_s: the offset from GNSS's time to the unit's.
    """
    if taken_s == whole_s == 0.0:
        return solution
    earlier_ns = round(whole_s * SECOND_NS)
    innovations = _shifted(solution.innovations, -taken_s)
    innovations["time_ns"][~_of_gnss(innovations["kind"])] -= earlier_ns
    return replace(
        solution,
        time_ns=solution.time_ns - earlier_ns,
        node_time_ns=solution.node_time_ns - earlier_ns,
        innovations=innovations,
        time_offset_s=solution.time_offset_s + taken_s,
    )


def _weak(solution: Solution, setup: Setup) -> tuple[str, ...]:
    """Return estimates of the installation that keep most of their prior sigma."""
    last: list[tuple[str, float, float]] = []
    if setup.estimate_lever_arm > 0.0:
        for name, sigma in zip("xyz", solution.lever_arm_sigma[-1].tolist(), strict=True):
            last.append((f"lever arm {name}", sigma, setup.estimate_lever_arm))
    if setup.estimate_time_offset_s > 0.0:
        last.append(("time offset", float(solution.time_offset_sigma_s[-1]), setup.estimate_time_offset_s))
    return tuple(name for name, sigma, prior in last if sigma > WEAK * prior)
