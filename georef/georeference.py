"""Compute points on the map from a scanner's returns: the whole chain, equation by equation.

    sensor     x_s = ρ · (−sin Δη, sin θ cos Δη, cos θ cos Δη)
               ISO/TS 19159-2 Eq. 14; swath.georef.scanner.beams
    body       x_b = lever_arm_b + R(ω, φ, κ) · T · x_s
               Eq. 2, 15; NGA Eq. 3 with a gimbal
    earth      x_e = x_b^e + rot_e_from_l · rot_l_from_b · x_b
               Eq. 10; Eq. 3, 4, 7 in the trajectory
    air        ρ by the group index, the beam bent towards the nadir
               NGA Eq. 4 to 11; swath.georef.air.atmosphere
    map        x_m = projection and heights of x_e, by PROJ
               Eq. 8; swath.georef.mapping.frame
    sigmas     C_m = J C Jᵀ of trajectory, range, angle and calibration
               Eq. 13, 14; swath.georef.scanner.uncertainty

The first three are one pass (`swath.georef.scanner.sensor_model`, `swath.georef.scanner.kernels.rays`). Returns are
processed in blocks, so that results between two steps stay in the processor's cache; a point depends on its return and
the trajectory alone.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from swath.georef.arrays import ByteArray, FloatArray, Int64Array, StructArray
from swath.georef.compiled import jit_cached
from swath.georef.mapping.cells import Mapped
from swath.georef.mapping.frame import Mapping, MappingError
from swath.georef.points import Fate, Points, Rays, contiguous
from swath.georef.return_rows import plain
from swath.georef.scanner.encoder_motion import TellsMotion
from swath.georef.scanner.kernels.types import PointColumns
from swath.georef.scanner.ranging import PulseRates
from swath.georef.scanner.sensor_model import SensorModel
from swath.georef.scanner.uncertainty import Uncertainty
from swath.georef.trajectory.trajectory import Trajectory

BLOCK_ROWS = 8192


class Georeferencer:
    """Computes points from one scanner's returns.

    Args:
        model: of the scanner, with its calibration and its air.
        mapping: frame of the points; None: e.
        uncertainty: computes sigmas; None: no sigmas.
        encoder_motion: of the scanner's encoder, where its calibration has a latency or torsion.
        prf_hz: pulse rate, where its calibration has range offsets by it; the attribute ``rates`` gives it by pulse.
        with_beams, with_covariances: also give these columns of `Points`, where there are sigmas and a mapping frame.
    """

    def __init__(
        self,
        model: SensorModel,
        mapping: Mapping | None = None,
        uncertainty: Uncertainty | None = None,
        encoder_motion: TellsMotion | None = None,
        prf_hz: float | None = None,
        *,
        with_beams: bool = False,
        with_covariances: bool = False,
    ) -> None:
        self.model, self.mapping, self.uncertainty = model, mapping, uncertainty
        projected = mapping is not None and uncertainty is not None
        self.with_beams, self.with_covariances = with_beams and projected, with_covariances and projected
        self.encoder_motion, self.prf_hz = encoder_motion, prf_hz
        self._mapped = False  # whether any point was mapped so far
        self.rates: PulseRates | None = None

    def georeference(self, rows: StructArray, time_ns: Int64Array, trajectory: Trajectory) -> tuple[Points, ByteArray]:
        """Return the points of returns, and the fate of each return.

        Args:
            rows: (n,) `RETURN_DTYPE` or `AIMED_RETURN_DTYPE`, preferably in the order of their times.
            time_ns: (n,) GPS time of their emission by the scanner's stamps; negative: unknown.
            trajectory: of the body.

        Returns:
            The points of those that could be georeferenced, in their order; and the `Fate` of each row.

        Raises:
            TrajectoryError: the trajectory has no attitude.
            MappingError: the mapping frame has coordinates for no point of the first batches. In later batches, or
                where some points have coordinates, those without are NOT_FINITE.
        """
        motion = None
        if self.encoder_motion is not None and self.model.needs_encoder_motion:
            # for all rows at once: the rate at a reading depends on its neighbours
            motion = self.encoder_motion.motion(rows, time_ns)
        points = Points.empty(
            len(rows),
            with_sigmas=self.uncertainty is not None,
            with_beams=self.with_beams,
            with_covariances=self.with_covariances,
        )
        fates = np.empty(len(rows), np.uint8)
        filled = 0
        failed: MappingError | None = None
        for block, prf_hz in self._blocks(rows):
            rate, acceleration = (None, None) if motion is None else (motion[0][block], motion[1][block])
            rays = self.model.rays(
                rows[block],
                time_ns[block],
                trajectory,
                encoder_rate=rate,
                encoder_acceleration=acceleration,
                uncertainty=self.uncertainty,
                prf_hz=prf_hz,
            )
            count, failure = self._fill(points, filled, rows[block], rays)
            fates[block] = rays.fate
            filled, failed = filled + count, failed or failure
        if failed is not None and not filled and not self._mapped:
            raise failed
        self._mapped = self._mapped or filled > 0
        return points if filled == len(rows) else points.take(slice(filled)), fates

    def _blocks(self, rows: StructArray) -> Iterator[tuple[slice, float | None]]:
        """Yield slices of rows to process at once, of one pulse rate where that matters, with the rate."""
        runs = [(0, len(rows), self.prf_hz)]
        if self.rates is not None and any(row.prf_hz is not None for row in self.model.calibration.range_offsets):
            runs = [(start, stop, prf_hz) for start, stop, prf_hz, _ in self.rates.runs(rows["pulse_id"])]
        for first, last, prf_hz in runs:
            for start in range(first, last, BLOCK_ROWS):
                yield slice(start, min(start + BLOCK_ROWS, last)), prf_hz

    def _fill(self, points: Points, filled: int, rows: StructArray, rays: Rays) -> tuple[int, MappingError | None]:
        """Correct rays for the air, map those that reached the ground, and fill points from row ``filled`` on.

        Returns:
            The number of points; and the mapping's error if some rays have no coordinates. Their fate is NOT_FINITE.
        """
        if self.model.air is not None:
            self.model.air.apply(rays.origin_e, rays.points_e)  # in place; NGA Eq. 4 to 11
        done = rays.fate == Fate.GEOREFERENCED
        kept, failure = rays if done.all() else rays.take(done), None
        try:
            mapped = self._mapped_points(kept)
        except MappingError as error:
            failure = error
            assert self.mapping is not None
            reached = self.mapping.reaches(kept.points_e)
            rays.fate[np.flatnonzero(done)[~reached]] = Fate.NOT_FINITE
            done[done], kept = reached, kept.take(reached)
            mapped = self._mapped_points(kept)
        to = slice(filled, filled + len(mapped.points_map))
        for name, values in mapped._asdict().items():
            if values is not None:
                getattr(points, name)[to] = values
        columns = PointColumns(*(getattr(points, name)[to] for name in PointColumns._fields))
        rows = rows if done.all() else rows[done]
        fill_columns(contiguous(plain(rows)), kept.time_ns, kept.off_nadir_rad, kept.range_m, columns)
        return len(mapped.points_map), failure

    def _mapped_points(self, rays: Rays) -> Mapped:
        """Return coordinates (n, 3), sigmas along the same axes, and what else was asked for (ISO Eq. 8, 13, 14).

        Raises:
            MappingError: some points have no coordinates.
        """
        covariance_e = rays.covariance_e
        if self.mapping is None:
            sigma_e = None if covariance_e is None else np.sqrt(covariance_e[:, [0, 3, 5]]).astype(np.float32)
            return Mapped(rays.points_e, sigma_e)
        if covariance_e is None:
            return Mapped(self.mapping.map_from_e(rays.points_e))
        origin_e = rays.origin_e if self.with_beams else None
        return self.mapping.map_with_beams(rays.points_e, covariance_e, origin_e, whole=self.with_covariances)


@jit_cached
def fill_columns(
    rows: StructArray, time_ns: Int64Array, off_nadir_rad: FloatArray, range_m: FloatArray, to: PointColumns
) -> None:
    """Fill columns of points from rows (n,) `RETURN_DTYPE` and from columns (n,) of their rays."""
    times, angles, ranges, intensity, number, numbers, channel, zone = to
    for i in range(len(rows)):
        times[i] = time_ns[i]
        angles[i], ranges[i] = off_nadir_rad[i], range_m[i]
    for i in range(len(rows)):
        row = rows[i]
        intensity[i], channel[i] = row.intensity, row.channel
        number[i], numbers[i], zone[i] = row.return_number, row.number_of_returns, row.mta_zone
