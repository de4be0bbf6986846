"""Predicts how good the trajectory of a planned flight will be, as navigation would report it.

The covariance of a filter and its smoother depends on the path and on the sigmas of the sensors, hardly on their
readings. So the planned motion is navigated as a log's is, by the same filter: the inertial unit's samples are free of
errors and have the noise that the configuration would give; GNSS solutions have the errors of their grade, because the
filter adapts to the noise that it finds in them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from swath.calib.equations.trajectory_prior import TrajectoryPrior, from_smoother, knots_of
from swath.calib.flight import Flight
from swath.daemon.config.tables import NoiseConfig
from swath.daemon.processing.navigation.observations import heading_observations
from swath.daemon.processing.navigation.sources import filter_setup, noise_of
from swath.georef.arrays import BoolArray, FloatArray, Int64Array, StructArray
from swath.georef.geodesy.earth import e_from_geodetic
from swath.georef.navigation.cross_covariance import error_chain
from swath.georef.navigation.filter.filter import FilterRun
from swath.georef.navigation.inputs import (
    OBSERVATION_DTYPE,
    Inertial,
    Kind,
    NavigationError,
    Setup,
    Solution,
    Start,
    sort_observations,
)
from swath.georef.navigation.solve import solve
from swath.georef.records import FixType, GnssHeading
from swath.georef.timescales import SECOND_NS
from swath.sim.gnss.receiver import Epochs, Receiver
from swath.sim.imu.sensors import true_increments
from swath.sim.imu.wire import config_table
from swath.sim.plan.tables import GnssTable, ImuTable
from swath.sim.preview.coverage import Survey

KNOT_S = 1.0  # at half this distance sigmas become larger by a few per cent
BEGIN_S = 1.0
# sigmas of the start; a flight of minutes forgets them
PLACE_SIGMA_M, VELOCITY_SIGMA_MPS = 0.05, 0.05
ATTITUDE_SIGMA_RAD = np.radians([1.0, 1.0, 3.0])


@dataclass(frozen=True, eq=False)
class PlannedNavigation:
    """Navigation of a planned flight.

    Attributes:
        run: run of the filter, with the smoother's nodes.
        sigmas: root mean squares along the lines: position (m), roll and pitch, heading (degrees).
    """

    run: FilterRun
    sigmas: tuple[float, float, float]

    def prior(self, flight: Flight) -> TrajectoryPrior:
        """Return the errors' joint covariance at knots of a flight that has this trajectory alone."""
        knots = knots_of(flight, KNOT_S)
        return from_smoother(flight, [error_chain(self.run, knots.time_ns)], KNOT_S)


def navigated(survey: Survey, begin_ns: int) -> PlannedNavigation | None:
    """Navigate a plan with its first inertial unit and its first receiver; None if it lacks one of them.

    Args:
        survey: the plan, flown.
        begin_ns: GPS time of its start.

    Raises:
        NavigationError: there are no satellites during the whole flight, or the filter cannot run.
        PlanError: the receiver's two antennas have the same place.
    """
    tables = survey.plan.tables
    unit, receiver = next(iter(tables.imu.items()), None), next(iter(tables.gnss.items()), None)
    if unit is None or receiver is None:
        return None
    noise = noise_of(NoiseConfig.model_validate(config_table(unit[1], unit[0], "")["noise"]))
    antennas = [receiver[1].lever_arm_m, receiver[1].secondary_lever_arm_m]
    setup = filter_setup(noise, [np.array(arm) for arm in antennas if arm is not None])
    observations = _observations(survey, *receiver, setup, begin_ns)
    solved = solve(_samples(survey, unit[1], begin_ns), observations, setup, _start(survey, begin_ns))
    return PlannedNavigation(solved.run, _along_lines(survey, solved.smoothed, begin_ns))


def _gps(begin_ns: int, time_s: FloatArray) -> Int64Array:
    since: Int64Array = np.rint(time_s * SECOND_NS).astype(np.int64)
    return begin_ns + since


def _samples(survey: Survey, table: ImuTable, begin_ns: int) -> Inertial:
    count = int(survey.trajectory.end_s * table.rate_hz)
    edges_s = np.arange(count + 1) / table.rate_hz
    felt = true_increments(survey.trajectory, edges_s)
    none = np.zeros(count, np.bool_)
    return Inertial(_gps(begin_ns, edges_s[1:]), np.diff(edges_s), felt.angle_b, felt.velocity_b, none)


def _start(survey: Survey, begin_ns: int) -> Start:
    time_s = np.array([BEGIN_S])
    trajectory = survey.trajectory
    return Start(
        int(_gps(begin_ns, time_s)[0]),
        trajectory.poses(time_s).position_e[0],
        trajectory.velocity_l(time_s)[0],
        np.concatenate(trajectory.attitude(time_s)),
        np.full(3, PLACE_SIGMA_M),
        np.full(3, VELOCITY_SIGMA_MPS),
        ATTITUDE_SIGMA_RAD,
    )


def _observations(survey: Survey, name: str, table: GnssTable, setup: Setup, begin_ns: int) -> StructArray:
    """Return observations at the receiver's epochs without its outages."""
    seed = survey.plan.tables.flight.seed
    receiver = Receiver(table, survey.trajectory, seed=seed, name=name, noise=True)
    epochs = receiver.epochs(1, int(survey.trajectory.end_s * table.rate_hz) - 1)
    there = epochs.fix != FixType.NONE
    if not there.any():
        raise NavigationError(f"gnss.{name}.outage: lasts the whole flight; let it end before the last line ends")
    time_ns, age_ns = _gps(begin_ns, epochs.time_s[there]), _gps(0, epochs.velocity_age_s[there])
    place_e = e_from_geodetic(epochs.lat_rad, epochs.lon_rad, epochs.height_m)
    position, velocity = np.zeros((2, len(time_ns)), OBSERVATION_DTYPE)
    position["time_ns"], position["kind"] = time_ns, Kind.POSITION
    position["value"], position["sigma"] = place_e[there], epochs.position_sigma_l[there]
    velocity["time_ns"], velocity["kind"] = time_ns - age_ns, Kind.VELOCITY
    velocity["value"], velocity["sigma"] = epochs.velocity_l[there], epochs.velocity_sigma_l[there]
    for rows in (position, velocity):
        rows["fix_type"], rows["satellites"] = epochs.fix[there], epochs.satellites[there]
    parts = [position, velocity]
    if setup.baseline_b is not None:
        told = _headings(epochs, there)
        times: list[int | None] = list(time_ns.tolist())
        parts.append(heading_observations(told, times, float(np.linalg.norm(setup.baseline_b))).rows)
    return sort_observations(np.concatenate(parts))


def _headings(epochs: Epochs, there: BoolArray) -> list[GnssHeading]:
    columns = (epochs.heading_rad, epochs.pitch_rad, epochs.heading_sigma_rad, epochs.pitch_sigma_rad)
    return [
        GnssHeading(-1, None, heading, pitch, None, heading_sigma, pitch_sigma)
        for heading, pitch, heading_sigma, pitch_sigma in np.stack(columns, axis=1)[there].tolist()
    ]


def _along_lines(survey: Survey, smoothed: Solution, begin_ns: int) -> tuple[float, float, float]:
    ends_s = np.array([[strip.start_s, strip.end_s] for strip in survey.strips])
    begins, ends = _gps(begin_ns, ends_s).T
    at = np.searchsorted(begins, smoothed.time_ns, side="right") - 1
    on = (at >= 0) & (smoothed.time_ns <= ends[at])
    attitude_deg = np.degrees(smoothed.attitude_sigma_rad[on])
    parts = (smoothed.position_sigma_l[on], attitude_deg[:, :2], attitude_deg[:, 2])
    position_m, tilt_deg, heading_deg = (float(np.sqrt(np.mean(part**2))) for part in parts)
    return position_m, tilt_deg, heading_deg
