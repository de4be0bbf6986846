"""A whole flight: filter, smoother, the noise found, and further passes from where the smoothed flight began.

The filter is linear about its own state, which is poor while the heading is hardly known: a pass that begins with the
smoothed attitude has small errors from its first sample on. What was known of the start stays as it was, its mean and
its sigmas (`smoother`), so that nothing is learnt twice. A GNSS time offset is taken out of the observations' times
likewise, so that what is left of it is small. The solutions are in GNSS's time, in which the laser fires too: the
epochs of the inertial unit less the whole offset.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from swath.georef.arrays import FloatArray
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
from swath.georef.records import StructArray
from swath.georef.timescales import SECOND_NS

MOST_PASSES = 3
STRETCH_S = 600.0  # of the flight, on which hypotheses of noise are compared
MOST_RESCALED = 2  # times that the whole flight may correct the scales which the stretch told
LINEAR_SHARE = 0.1  # of the sigma: what an angle's square may be
OFFSET_LEFT_S = 5e-4
WEAK = 0.5  # of the prior sigma: an estimate that keeps so much has learnt little


@dataclass(frozen=True)
class Report:
    """What was found on the way.

    Attributes:
        passes: how many.
        start_change_rad: (passes,) how far the smoothed attitude at the start was from the assumed one.
        noise: of GNSS; None: not asked for.
        time_offset_s: of GNSS, all passes together; 0 where not estimated.
        weak: estimates that the flight says little of, by name.
        setup: that the flight was smoothed with.
    """

    passes: int
    start_change_rad: tuple[float, ...]
    noise: NoiseFound | None
    time_offset_s: float
    weak: tuple[str, ...]
    setup: Setup


@dataclass(frozen=True, eq=False)
class Solved:
    """A flight: by what was known at each moment, and by all of it.

    Attributes:
        forward, smoothed: in GNSS's time, by the offset that the whole flight tells.
        run: of the filter, that was smoothed; in the inertial unit's time.
    """

    forward: Solution
    smoothed: Solution
    report: Report
    run: FilterRun

    def error_chain(self, time_ns: ArrayLike) -> ErrorChain:
        """Return how the smoothed errors at the nodes nearest to some times (GNSS's) go together; see `error_chain`."""
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
) -> Solved:
    """Filter and smooth a whole flight.

    Args:
        inertial, observations: of it, observations in any order.
        setup, start: of the first pass.
        noise_from_flight: look how good GNSS is, and go by what is found: factors on the sigmas of positions and
            velocities by fix type and of headings, and which share of their errors lasts; see `noise`, `heading_noise`.
        storage: where the runs and the solutions are kept.
    """
    run = run_filter(inertial, observations, setup, start, storage=storage)
    found = None
    if noise_from_flight:
        found = _noise(inertial, observations, setup, start, run)
        for _ in range(1 + MOST_RESCALED):
            if setup is found.setup:
                break
            setup = found.setup
            run = run_filter(inertial, observations, setup, start, storage=storage)
            found = replace(found, setup=rescaled(setup, run.innovations[not_blunders(run.innovations)])[0])
        found = replace(found, setup=setup)
    flown, nodes = forward(run), smooth_nodes(run)
    changes, offset_s, asked = [_change(nodes)], 0.0, start
    while (_bent(nodes) or abs(nodes.state[0, TIME_OFFSET]) > OFFSET_LEFT_S) and len(changes) < MOST_PASSES:
        offset_s += float(nodes.state[0, TIME_OFFSET])
        start = replace(start, attitude_rad=_attitude(nodes))
        run = run_filter(inertial, _shifted(observations, offset_s), setup, start, storage=storage)
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
    """Return what gives the innovations of the first `STRETCH_S` seconds with a setup, a row an observation."""
    end_ns = start.time_ns + round(STRETCH_S * SECOND_NS)
    part = inertial.between(0, int(np.searchsorted(inertial.time_ns, end_ns)))
    rows = observations[observations["time_ns"] < end_ns]

    def stretch(asked: Setup) -> StructArray:
        return run_filter(part, rows, asked, start).innovations

    return stretch


def _attitude(nodes: SmoothedNodes) -> FloatArray:
    """Return (3,) smoothed roll, pitch, heading of the first node."""
    lat, lon, _ = geodetic_from_e(nodes.state[0, :3])
    rot = rot_e_from_l(lat, lon).T @ rot_from_quaternion(nodes.state[0, ATTITUDE : ATTITUDE + 4])
    return np.array(attitude_of(rot), dtype=np.float64)


def _mean(run: FilterRun, asked: Start, offset_s: float) -> FloatArray:
    """Return the mean (n,) of a run's errors at its start, by the start asked for and the time offset taken out, s."""
    mean = np.zeros(run.layout.size)
    difference(start_state(run.setup, asked), start_state(run.setup, run.start), mean[:MOVED])
    if run.layout.time_offset >= 0:
        mean[run.layout.time_offset] = -offset_s
    return mean


def _change(nodes: SmoothedNodes) -> float:
    """Return angle between the smoothed attitude at the start and the assumed one."""
    return float(np.linalg.norm(nodes.leave[0, 6:]))


def _bent(nodes: SmoothedNodes) -> bool:
    """Return whether the change at the start was too large for what is linear in it: its square against the sigma."""
    return bool(_change(nodes) ** 2 > LINEAR_SHARE * nodes.sigma[0, 6:].min())


def _of_gnss(kinds: NDArray[np.uint8]) -> NDArray[np.bool_]:
    return np.isin(kinds, [int(kind) for kind in OF_GNSS])


def _shifted(observations: StructArray, offset_s: float) -> StructArray:
    """Return observations with the offset added to the times of GNSS."""
    rows = observations.copy()
    rows["time_ns"][_of_gnss(rows["kind"])] += round(offset_s * SECOND_NS)
    return rows


def _in_gnss_time(solution: Solution, taken_s: float, whole_s: float) -> Solution:
    """Return a solution in the inertial unit's time, put into GNSS's: its epochs less the whole offset.

    Args:
        solution: its innovations of GNSS are at the observations' times and what was taken.
        taken_s: that had been added to the observations' times.
        whole_s: what is added to GNSS's time to get the unit's.
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
