"""From a scanner's returns to points on the map: the whole way, equation by equation.

    sensor     x_s = ρ · (−sin Δη, sin θ cos Δη, cos θ cos Δη)                ISO/TS 19159-2 Eq. 14; georef.beams
    body       x_b = lever_arm_b + R(ω, φ, κ) · T · x_s                        Eq. 2, 15; NGA Eq. 3 with a gimbal
    earth      x_e = x_b^e + rot_e_from_l · rot_l_from_b · x_b                 Eq. 10; Eq. 3, 4, 7 in the trajectory
    air        ρ by the group index, the beam bent towards the nadir           NGA Eq. 4 to 11; georef.atmosphere
    map        x_m = projection and heights of x_e, by PROJ                    Eq. 8; georef.mapping
    sigmas     C_m = J C Jᵀ of trajectory, range, angle and calibration        Eq. 13, 14; georef.uncertainty

The first three are one pass (`georef.sensor_model`, `georef.kernels.rays`). Returns are taken in blocks, so that what
is between two steps stays in the processor's cache; a point depends on its return and the trajectory alone.
"""

from __future__ import annotations

from dataclasses import fields
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from georef.mapping import Mapping
from georef.points import ByteArray, Fate, Points, Rays
from georef.records import Int64Array, StructArray
from georef.sensor_model import SensorModel
from georef.trajectory import Trajectory
from georef.uncertainty import Uncertainty

FloatArray = NDArray[np.float64]

BLOCK_ROWS = 16_384


class EncoderMotion(Protocol):
    """How the encoder moved when it was read."""

    def motion(self, rows: StructArray, time_ns: Int64Array) -> tuple[FloatArray, FloatArray]:
        """(n,) rate and acceleration of the readings, rad/s, rad/s²."""


class Georeferencer:
    """Makes points of one scanner's returns.

    Args:
        model: of the scanner, with its calibration and its air.
        mapping: frame of the points; None: e.
        uncertainty: gives sigmas; None: none.
        encoder_motion: of the scanner's encoder, where its calibration has a latency or torsion.
        prf_hz: pulse rate, where its calibration has range offsets by it.
    """

    def __init__(
        self,
        model: SensorModel,
        mapping: Mapping | None = None,
        uncertainty: Uncertainty | None = None,
        encoder_motion: EncoderMotion | None = None,
        prf_hz: float | None = None,
    ) -> None:
        self.model, self.mapping, self.uncertainty = model, mapping, uncertainty
        self.encoder_motion, self.prf_hz = encoder_motion, prf_hz

    def georeference(self, rows: StructArray, time_ns: Int64Array, trajectory: Trajectory) -> tuple[Points, ByteArray]:
        """Points of returns.

        Args:
            rows: (n,) `RETURN_DTYPE`, best in the order of their times.
            time_ns: (n,) GPS time of their emission by the scanner's stamps; negative: unknown.
            trajectory: of the body.

        Returns:
            The points of those that could be georeferenced, in their order; and what became of each row, as `Fate`.

        Raises:
            TrajectoryError: the trajectory has no attitude.
            MappingError: the mapping frame does not reach there.
        """
        motion = None
        if self.encoder_motion is not None and self.model.needs_encoder_motion:
            motion = self.encoder_motion.motion(rows, time_ns)  # of all at once: a reading's rate asks its neighbours
        pieces, fates = [], []
        for start in range(0, max(len(rows), 1), BLOCK_ROWS):
            block = slice(start, start + BLOCK_ROWS)
            rate, acceleration = (None, None) if motion is None else (motion[0][block], motion[1][block])
            rays = self.model.rays(
                rows[block],
                time_ns[block],
                trajectory,
                encoder_rate=rate,
                encoder_acceleration=acceleration,
                with_axes=self.uncertainty is not None,
                prf_hz=self.prf_hz,
            )
            fates.append(rays.fate)
            pieces.append(self._points(rows[block], rays, trajectory))
        return Points.concatenate(pieces), np.concatenate(fates)

    def _points(self, rows: StructArray, rays: Rays, trajectory: Trajectory) -> Points:
        """Through the air and onto the map: points of the rays that reached the ground."""
        done = rays.fate == Fate.GEOREFERENCED
        if not done.all():
            rows, rays = rows[done], _only(rays, done)
        points = rays.points_e
        if self.model.air is not None:
            self.model.air.apply(rays.origin_e, points)  # in place; NGA Eq. 4 to 11
        return Points(
            time_ns=rays.time_ns,
            points_map=points if self.mapping is None else self.mapping.map_from_e(points),  # ISO Eq. 8
            sigma_map=self._sigmas(rays, trajectory),
            scan_angle_rad=rays.angle_rad.astype(np.float32),
            range_m=rays.range_m.astype(np.float32),
            intensity=rows["intensity"].copy(),
            return_number=rows["return_number"].copy(),
            number_of_returns=rows["number_of_returns"].copy(),
            channel=rows["channel"].copy(),
            mta_zone=rows["mta_zone"].copy(),
        )

    def _sigmas(self, rays: Rays, trajectory: Trajectory) -> NDArray[np.float32] | None:
        """(n, 3) along the axes of the points (ISO Eq. 13, 14)."""
        if self.uncertainty is None:
            return None
        covariance_e = self.uncertainty.covariance_e(rays, trajectory)
        if self.mapping is None:
            return np.sqrt(covariance_e[:, [0, 3, 5]]).astype(np.float32)
        return self.mapping.sigma_map(rays.points_e, covariance_e)


def _only(rays: Rays, which: NDArray[np.bool_]) -> Rays:
    """Some of the rays."""
    columns: dict[str, Any] = {}
    for field in fields(Rays):
        column = getattr(rays, field.name)
        columns[field.name] = None if column is None else column[which]
    return Rays(**columns)
