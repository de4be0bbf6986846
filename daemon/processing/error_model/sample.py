"""Samples a strip's returns for its error model: a few moments of the log, a few returns of each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from swath.daemon.log.chunk_index import ChunkPlace
from swath.daemon.processing.points.feed import LogFeed
from swath.daemon.processing.points.jobs import Job, JobPlan, JobResult, feed_job
from swath.georef.arrays import ByteArray, FloatArray, Int64Array, StructArray
from swath.georef.error_model.build import Sample
from swath.georef.georeference import Georeferencer
from swath.georef.mapping.frame import Mapping as MappingFrame
from swath.georef.points import Fate, Points, Rays
from swath.georef.scanner.calibration import Calibration
from swath.georef.scanner.jacobian import ELEVATION, OBSERVATIONS, observation_columns_e, parameter_columns_e
from swath.georef.scanner.uncertainty import Noise
from swath.georef.surface.planes import STEEPEST_RAD
from swath.georef.trajectory.trajectory import Trajectory

MOMENTS = 12  # of a strip
TOGETHER = 2  # chunks at each
RETURNS = 40  # of each call of the georeferencer
STEP_M = 10.0  # of the derivatives of the mapping
_RANGE, _ANGLE = OBSERVATIONS.index("range_m"), OBSERVATIONS.index("encoder_rad")


@dataclass(frozen=True, eq=False)
class Sampled:
    """Returns sampled of a unit, and the effects of errors on them; vectors in e.

    Attributes:
        time_ns: (n,) GPS times; points_e, position_e: (n, 3) of point and body.
        calibration_e: (n, q, 3), noise_e: (n, e, 3), as of `Sample`.
    """

    time_ns: Int64Array
    points_e: FloatArray
    position_e: FloatArray
    calibration_e: FloatArray
    noise_e: FloatArray

    def in_map(self, mapping: MappingFrame) -> tuple[Sample, FloatArray]:
        """Return the sample in the mapping frame in metres, and the rotation m from e at its middle."""
        turn = rot_m_from_e(mapping, self.points_e.mean(axis=0))
        sample = Sample(
            mapping.map_from_e(self.points_e) * mapping.unit_m,
            mapping.map_from_e(self.position_e) * mapping.unit_m,
            self.calibration_e @ turn.T,
            self.noise_e @ turn.T,
        )
        return sample, turn


class _Sampler(Georeferencer):
    """Replaces the georeferencer of a chain: keeps the effects of errors on some returns, and makes no points."""

    def __init__(self, georeferencer: Georeferencer, noise: Noise, kept: list[Sampled]) -> None:
        super().__init__(georeferencer.model, None, None, georeferencer.encoder_motion, georeferencer.prf_hz)
        self._noise, self._kept, self._factor = noise, kept, independent_errors(georeferencer.model.calibration)

    def georeference(self, rows: StructArray, time_ns: Int64Array, trajectory: Trajectory) -> tuple[Points, ByteArray]:
        """Keep some of the returns; return no points, and the fate of every row."""
        rate, acceleration = None, None
        if self.encoder_motion is not None and self.model.needs_encoder_motion:
            rate, acceleration = self.encoder_motion.motion(rows, time_ns)
        some = np.unique(np.linspace(0, len(rows) - 1, min(RETURNS, len(rows))).astype(np.int64))
        rays = self.model.rays(
            rows[some],
            time_ns[some],
            trajectory,
            encoder_rate=None if rate is None else rate[some],
            encoder_acceleration=None if acceleration is None else acceleration[some],
            with_axes=True,
            prf_hz=self.prf_hz,
        )
        rays = rays.take(rays.fate == Fate.GEOREFERENCED)
        if len(rays.fate):
            by_parameter = parameter_columns_e(rays, self.model, trajectory)
            by_reading = observation_columns_e(rays, self.model, trajectory)
            sigma = self._noise
            noise = [by_reading[:, _RANGE] * sigma.range_m, by_reading[:, _ANGLE] * sigma.angle_rad]
            if self.model.aimed:
                noise.append(by_reading[:, ELEVATION] * sigma.angle_rad)
            noise.append(_footprint(rays, sigma.divergence_rad))
            self._kept.append(
                Sampled(
                    rays.time_ns,
                    rays.points_e,
                    trajectory.poses(rays.time_ns).position_e,
                    np.einsum("npi,pq->nqi", by_parameter, self._factor),
                    np.stack(noise, axis=1),
                )
            )
        return Points.empty(0, with_sigmas=False), np.full(len(rows), Fate.GEOREFERENCED, np.uint8)


def _footprint(rays: Rays, divergence_rad: float) -> FloatArray:
    """Return one sigma (n, 3) in e of the footprint's error on level ground, along the beam (FORMULAS 5)."""
    slope = np.tan(np.minimum(np.abs(rays.off_nadir_rad), STEEPEST_RAD))
    beam = rays.points_e - rays.origin_e
    footprint: FloatArray = beam * (divergence_rad * slope / 4.0)[:, np.newaxis]
    return footprint


def independent_errors(calibration: Calibration) -> FloatArray:
    """Return one sigma of each independent error of the parameters, (16, q): columns of a root of their covariance."""
    active = np.flatnonzero(calibration.all_sigmas > 0.0)
    factor = np.zeros((len(calibration.all_sigmas), len(active)))
    factor[active] = np.linalg.cholesky(calibration.covariance()[np.ix_(active, active)])
    return factor


def rot_m_from_e(mapping: MappingFrame, point_e: FloatArray) -> FloatArray:
    """Return the rotation (3, 3) from e to easting, northing and height at a place, from differences of the mapping."""
    steps = np.concatenate([np.eye(3), -np.eye(3)]) * STEP_M
    mapped = mapping.map_from_e(point_e + steps) * mapping.unit_m
    left, _, right = np.linalg.svd((mapped[:3] - mapped[3:]).T)
    rotation: FloatArray = left @ right
    return rotation


def sample_strip(plan: JobPlan, job: Job, noises: Mapping[str, Noise]) -> dict[str, Sampled]:
    """Return samples of a strip's returns by scanner; a scanner without returns has none.

    Raises:
        OSError: the log cannot be read.
    """
    assert job.trajectory is not None
    stream = plan.setup.office_stream(plan.clocks, job.trajectory)
    kept: dict[str, list[Sampled]] = {name: [] for name in stream.scanners}
    for name in stream.scanners:
        chain = stream.chain(name)
        chain.georeferencer = _Sampler(plan.setup.georeferencer(name), noises[name], kept[name])
    result = JobResult(job.session, job.segment.strip, job.segment.start_ns, job.segment.end_ns)
    thinned = replace(job, places=_some(job.places))
    feed_job(plan, thinned, result, LogFeed(plan.setup, stream), lambda placed: None, lambda size: None)
    return {name: _joined(pieces) for name, pieces in kept.items() if pieces}


def _some(places: list[ChunkPlace]) -> list[ChunkPlace]:
    first = np.unique(np.linspace(0, max(len(places) - TOGETHER, 0), MOMENTS).astype(np.int64))
    chosen = sorted({int(at) + step for at in first for step in range(TOGETHER) if at + step < len(places)})
    return [places[at] for at in chosen]


def _joined(pieces: list[Sampled]) -> Sampled:
    return Sampled(
        *(
            np.concatenate([getattr(piece, name) for piece in pieces])
            for name in ("time_ns", "points_e", "position_e", "calibration_e", "noise_e")
        )
    )
