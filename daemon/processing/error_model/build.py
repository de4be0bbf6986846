"""Builds the error model of a run of `swath georef`: samples of its strips, and its trajectories' covariances."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from swath.daemon.errors import UserError
from swath.daemon.processing.error_model.sample import Sampled, sample_strip
from swath.daemon.processing.flights.read import Flight
from swath.daemon.processing.points.jobs import Job, JobPlan, JobResult
from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.error_model.build import (
    azimuth_of,
    correlations_in_time,
    exponentials,
    joint_turned,
    noise_of,
    offsets_of,
    turned_to_map,
    unmodelled_of,
)
from swath.georef.error_model.correlation import Fitted
from swath.georef.error_model.model import GROUPS, ErrorModel, Unit
from swath.georef.geodesy.earth import geodetic_from_e, rot_e_from_l
from swath.georef.scanner.uncertainty import Noise
from swath.georef.timescales import SECOND_NS

POST_S = 5.0  # of posts in a strip
MOST_JOINT = 180  # moments of a flight to which correlations are fitted
FOLLOWERS_S = (0.0, 0.25, 0.75, 2.0, 5.0)
MARGIN_S = 1.0
# of trajectories that come from elsewhere, as `swath calibrate` assumes (calib.equations.trajectory_prior.Taus)
ASSUMED_TAU_S = (60.0, 60.0, 100.0, 200.0)
LEAST_SAMPLES = 20


@dataclass(frozen=True, eq=False)
class Built:
    """A model, and what its fits leave; None: the correlations are assumed."""

    model: ErrorModel
    fits: list[Fitted] | None

    def summary(self) -> dict[str, Any]:
        """Return the entry of the sidecar."""
        entry: dict[str, Any] = {
            "units": len(self.model.units),
            "posts": sum(len(unit.post_ns) for unit in self.model.units),
            "trajectory": "joint covariance of the smoother" if self.fits else "sigmas of the file",
            "correlation_in_time": {},
        }
        for number, (group, one) in enumerate(zip(GROUPS, self.model.correlations, strict=True)):
            left = {} if self.fits is None else {"rms": self.fits[number].rms, "largest": self.fits[number].largest}
            entry["correlation_in_time"][group] = {
                **{"a": one.a, "alpha": one.alpha, "beta": one.beta, "tau_s": one.tau},
                **({"assumed": True} if self.fits is None else {"residual": left}),
            }
        return entry


@dataclass(frozen=True, eq=False)
class _Posts:
    time_ns: Int64Array
    position_e: FloatArray
    covariance_l: FloatArray


def build_model(flights: Sequence[Flight], jobs: Sequence[Job], results: Sequence[JobResult]) -> Built:
    """Build the error model of all strips of a run.

    Raises:
        UserError: the points have no sigmas, or no strip has returns enough; one line.
        OSError: a log cannot be read.
    """
    units: list[Unit] = []
    for job, result in zip(jobs, results, strict=True):
        if job.trajectory is None or not result.points:
            continue
        units += _units(flights[job.session], job, result)
    if not units:
        raise UserError(
            f"{flights[0].log}: no strip has {LEAST_SAMPLES} returns and a trajectory with sigmas, so there is no "
            "error model; leave --error-model out"
        )
    fits = _fits(flights, units)
    return Built(
        ErrorModel(units, exponentials(ASSUMED_TAU_S) if fits is None else [one.correlation for one in fits]), fits
    )


def _units(flight: Flight, job: Job, result: JobResult) -> list[Unit]:
    mapping = flight.setup.mapping
    assert mapping is not None
    assert result.first_gps_ns is not None
    assert result.last_gps_ns is not None
    noises = {name: _noise(flight, name) for name in flight.setup.scanners}
    samples = sample_strip(JobPlan(flight.index, flight.setup, flight.clocks.clocks), job, noises)
    posts = _posts(flight, job, result.first_gps_ns, result.last_gps_ns)
    if posts is None:
        return []
    units = []
    for name, sampled in samples.items():
        if len(sampled.time_ns) >= LEAST_SAMPLES:
            units.append(
                _unit(flight, job.segment.strip, name, sampled, posts, (result.first_gps_ns, result.last_gps_ns))
            )
    return units


def _unit(flight: Flight, strip: int, name: str, sampled: Sampled, posts: _Posts, span: tuple[int, int]) -> Unit:
    assert flight.setup.mapping is not None
    sample, rot_m_from_e = sampled.in_map(flight.setup.mapping)
    position_m = flight.setup.mapping.map_from_e(posts.position_e) * flight.setup.mapping.unit_m
    azimuth = azimuth_of(position_m)
    calibration, left = offsets_of(sample, azimuth)
    unmodelled, in_space = unmodelled_of(sample, left, azimuth)
    lat, lon, _ = geodetic_from_e(posts.position_e.mean(axis=0))
    return Unit(
        strip,
        name,
        *span,
        azimuth,
        posts.time_ns,
        position_m,
        turned_to_map(posts.covariance_l, rot_m_from_e @ rot_e_from_l(lat, lon)),
        calibration,
        unmodelled,
        in_space,
        noise_of(sample, azimuth),
    )


def _noise(flight: Flight, name: str) -> Noise:
    table = flight.setup.config.scanner[name]
    wide = 0.0 if flight.setup.options.surface == "none" else 1e-3 * table.divergence_mrad
    return Noise(table.range_sigma_m, float(np.radians(table.angle_sigma_deg)), divergence_rad=wide)


def _post_times(first_ns: int, last_ns: int) -> Int64Array:
    first, last = first_ns - MARGIN_S * SECOND_NS, last_ns + MARGIN_S * SECOND_NS
    count = max(2, int(np.ceil((last - first) / (POST_S * SECOND_NS))) + 1)
    return np.rint(np.linspace(first, last, count)).astype(np.int64)


def _posts(flight: Flight, job: Job, first_ns: int, last_ns: int) -> _Posts | None:
    """Return the posts of a strip; None where the trajectory has no sigmas."""
    trajectory = job.trajectory
    assert trajectory is not None
    begin, end = trajectory.span
    times = np.unique(np.clip(_post_times(first_ns, last_ns), begin, end))
    for leg in [] if flight.navigated is None else flight.navigated.legs:
        chain = leg.solved.error_chain(times)
        within = (chain.time_ns >= begin) & (chain.time_ns <= end)
        if flight.navigated is not None and flight.navigated.smooth and within.sum() >= 2:
            covariance = np.einsum("kij,kjl->kil", chain.left[within], chain.right[within])
            symmetric = 0.5 * (covariance + covariance.transpose(0, 2, 1))
            return _Posts(chain.time_ns[within], trajectory.poses(chain.time_ns[within]).position_e, symmetric)
    poses = trajectory.poses(times)
    epoch = np.clip(np.searchsorted(trajectory.time_ns, times), 0, len(trajectory) - 1)
    position, attitude = trajectory.position_sigma_l[epoch], trajectory.attitude_sigma_rad[epoch]
    known = np.isfinite(position).all(axis=1) & np.isfinite(attitude).all(axis=1)
    if known.sum() < 2:
        return None
    heading = trajectory.attitude()[2][epoch]
    covariance = np.zeros((len(times), 6, 6))
    covariance[:, range(3), range(3)] = position**2
    turn = np.zeros((len(times), 3, 3))  # roll and pitch are about the body's axes, whose tilt does not matter here
    turn[:, 0, 0], turn[:, 0, 1], turn[:, 1, 0], turn[:, 1, 1] = (
        np.cos(heading), -np.sin(heading), np.sin(heading), np.cos(heading),
    )  # fmt: skip
    turn[:, 2, 2] = 1.0
    covariance[:, 3:, 3:] = (turn * attitude[:, np.newaxis, :] ** 2) @ turn.transpose(0, 2, 1)
    return _Posts(times[known], poses.position_e[known], covariance[known])


def _near_and_far(times: Int64Array) -> Int64Array:
    """Return some of the posts' times, each with followers: near points need correlations at small lags."""
    some = times[np.unique(np.linspace(0, len(times) - 1, MOST_JOINT // len(FOLLOWERS_S)).astype(np.int64))]
    after = np.rint(np.array(FOLLOWERS_S) * SECOND_NS).astype(np.int64)
    return np.unique((some[:, np.newaxis] + after).ravel())


def _fits(flights: Sequence[Flight], units: Sequence[Unit]) -> list[Fitted] | None:
    """Fit correlations in time to the smoother's own; None where a trajectory comes from elsewhere.

    The longest flight of the run stands for all of it.
    """
    longest: tuple[float, list[Fitted]] | None = None
    noise = np.mean([unit.noise for unit in units], axis=0)
    for flight in flights:
        navigated = flight.navigated
        if navigated is None or not navigated.smooth or not navigated.legs:
            return None
        for leg in navigated.legs:
            azimuths = {int(time_ns): unit.azimuth_rad for unit in units for time_ns in unit.post_ns}
            times = np.array(sorted(azimuths), np.int64)
            chain = leg.solved.error_chain(_near_and_far(times))
            if len(chain) < 3:
                continue
            nearest = times[np.abs(times - chain.time_ns[:, np.newaxis]).argmin(axis=1)]
            azimuth = np.array([azimuths[int(time_ns)] for time_ns in nearest])
            turn = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
            fitted = correlations_in_time(chain.time_ns, joint_turned(chain.covariance(), turn), azimuth, noise)
            length = float(chain.time_ns[-1] - chain.time_ns[0])
            if longest is None or length > longest[0]:
                longest = length, fitted
    return None if longest is None else longest[1]
