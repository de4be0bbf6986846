"""The sensor model: from returns to points in e (ISO/TS 19159-2 Eq. 10; CONVENTIONS, "The beam").

    x_e = x_b^e + rot_e_from_b · ( lever_arm_b + R(ω, φ + slope · θ, κ) · G · T · x_s(ρ, θ) )

with the position at the pulse's time, GPS stamp + time_offset, the attitude at that + imu_latency, and the gimbal G, if
there is one (NGA Eq. 3). The beam is straight and air has no effect here: `swath.georef.georeference` applies it
afterwards.
"""

from __future__ import annotations

import math

import numpy as np

from swath.georef.air.atmosphere import Air
from swath.georef.arrays import FloatArray, Int64Array, StructArray
from swath.georef.geodesy.rotations import rot_x, rot_y, rot_z
from swath.georef.points import Fate, Rays, contiguous
from swath.georef.return_rows import elevations, plain
from swath.georef.scanner.beams import Geometry
from swath.georef.scanner.calibration import INDEX, Calibration
from swath.georef.scanner.kernels.beam import AIMED, FIBRE_BY_CHANNEL, FIBRE_BY_ENCODER, FIXED_ANGLE, SPINNING
from swath.georef.scanner.kernels.rays import cast
from swath.georef.scanner.kernels.types import Axes, Model, Mounted, Out, Ranging, Scanning, Track
from swath.georef.scanner.mount import Mount
from swath.georef.scanner.uncertainty import Uncertainty
from swath.georef.trajectory.trajectory import Trajectory

IBRC_STEPS_A_KNOT = 16
PRF_TOLERANCE = 0.01  # relative tolerance between a nominal and a measured pulse rate
_SECOND_NS = 1e9
_RIGID = Mount()


class SensorModel:
    """A scanner on its mount, with its calibration.

    Args:
        calibration: of the scanner.
        geometry: of its beams.
        range_gate: least and greatest ρ, metres.
        mount: stages of a gimbal.
        air: of the scanner's surroundings; kept for callers that apply it.

    Raises:
        GeometryError: the calibration has values that such a scanner does not have.
    """

    def __init__(
        self,
        calibration: Calibration,
        geometry: Geometry,
        range_gate: tuple[float, float] = (0.0, math.inf),
        mount: Mount = _RIGID,
        air: Air | None = None,
    ) -> None:
        self.calibration, self.geometry, self.mount, self.air = calibration, geometry, mount, air
        self.range_gate = range_gate
        value = calibration.value
        self._deflection = geometry.deflection(calibration)
        self._outer = rot_x(value("omega_rad")) @ rot_y(value("phi_rad"))[np.newaxis]
        self._kappa = rot_z(value("kappa_rad"))
        self._rigid = None if mount.moves else self._mounted(np.zeros(1, np.int64))
        self._ibrc = _ibrc_tables(calibration)
        self._deltas: dict[float | None, FloatArray] = {}

    @property
    def aimed(self) -> bool:
        """True if each return has an elevation of its own, besides the encoder's angle."""
        return self._deflection.kind == AIMED

    @property
    def needs_encoder_motion(self) -> bool:
        """True if encoder latency or torsion, or their sigmas, require the encoder's rate and acceleration."""
        asking = [INDEX["encoder_latency_s"], INDEX["torsion_s2"]]
        return bool(self.calibration.parameters[asking].any() or self.calibration.all_sigmas[asking].any())

    def rays(
        self,
        rows: StructArray,
        time_ns: Int64Array,
        trajectory: Trajectory,
        *,
        encoder_rate: FloatArray | None = None,
        encoder_acceleration: FloatArray | None = None,
        with_axes: bool = False,
        uncertainty: Uncertainty | None = None,
        incidence_rad: FloatArray | None = None,
        prf_hz: float | None = None,
    ) -> Rays:
        """Return the rays of returns, with their points.

        Args:
            rows: (n,) `RETURN_DTYPE`, or `AIMED_RETURN_DTYPE` where the geometry needs elevations; preferably in the
                order of their times.
            time_ns: (n,) GPS time of their emission by the scanner's stamps; negative: unknown.
            trajectory: of the body, with attitude.
            encoder_rate, encoder_acceleration: (n,) of the readings, rad/s, rad/s².
            with_axes: whether to compute the second half of `Rays` too, except covariances.
            uncertainty: computes these; they are nan where the trajectory has no sigmas.
            incidence_rad: (n,) between beam and the surface's normal, if the surface is known.
            prf_hz: of the scanner, for range offsets by pulse rate.

        Returns:
            Rays; their ``origin_e`` is the point on the beam from which (1 + range_scale) · measured range counts.

        Raises:
            ValueError: the calibration needs the encoder's motion, or the geometry elevations that rows do not have.
            TrajectoryError: the trajectory has no attitude.
        """
        if self.needs_encoder_motion and (encoder_rate is None or encoder_acceleration is None):
            text = "encoder latency and torsion need the encoder's motion"
            raise ValueError(f"calibration of {self.calibration.scanner}: {text}")
        trajectory.require_attitude()
        elevation = elevations(rows) if self.aimed else np.zeros(0)
        if self.aimed and len(elevation) != len(rows):
            raise ValueError(f"scanner {self.calibration.scanner}: its returns need an elevation, AIMED_RETURN_DTYPE")
        rows, time_ns = contiguous(plain(rows)), contiguous(time_ns)
        out, axes = _out(len(rows)), _axes(len(rows)) if with_axes else None
        doubt = None if uncertainty is None else uncertainty.doubt(trajectory, len(rows), incidence_rad)
        if len(trajectory) < 2:
            out.fate[:] = Fate.OUTSIDE_TRAJECTORY
        elif len(rows):
            scanning = self._scanning(encoder_rate, encoder_acceleration, elevation)
            model = self._model(time_ns, trajectory, scanning, prf_hz)
            cast(rows, time_ns, model, out, axes, doubt)
        covariance_e = None if doubt is None else doubt.covariance_e
        if axes is None:
            return Rays(**out._asdict(), covariance_e=covariance_e)
        still = np.zeros(len(rows))
        return Rays(
            **out._asdict(),
            **{name: column.T for name, column in axes._asdict().items()},
            measured_m=rows["range_m"].copy(),
            encoder_rad=self._readings(rows),
            encoder_rate=still if encoder_rate is None else encoder_rate,
            encoder_acceleration=still if encoder_acceleration is None else encoder_acceleration,
            covariance_e=covariance_e,
        )

    def offsets_by_rate_m(self, rows: StructArray, prf_hz: float | None) -> FloatArray:
        """Return (n,) of returns (n,): those of the calibration's range offsets that hold at this pulse rate only."""
        of_all, of_rate = (_range_offsets(self.calibration, rate) for rate in (None, prf_hz))
        added = of_rate - of_all
        if len(added) == 1:
            return np.zeros(len(rows))
        offsets: FloatArray = added[rows["return_number"], rows["mta_zone"]]
        return offsets

    def _model(
        self,
        time_ns: Int64Array,
        trajectory: Trajectory,
        scanning: Scanning,
        prf_hz: float | None,
    ) -> Model:
        """Return the model as the kernels take it."""
        offset_ns = self.calibration.value("time_offset_s") * _SECOND_NS
        return Model(
            self._ranging(prf_hz),
            scanning,
            self._rigid or self._mounted(time_ns + round(offset_ns)),
            self._track(trajectory, offset_ns),
        )

    def _ranging(self, prf_hz: float | None) -> Ranging:
        value = self.calibration.value
        if prf_hz not in self._deltas:
            self._deltas[prf_hz] = _range_offsets(self.calibration, prf_hz)
        scale, offset_m = 1.0 + value("range_scale"), value("range_offset_m")
        intensity, correction_m, slope, bucket, per_unit = self._ibrc
        minimum_m, maximum_m = self.range_gate
        return Ranging(
            scale,
            offset_m,
            float(minimum_m),
            float(maximum_m),
            self._deltas[prf_hz],
            intensity,
            correction_m,
            slope,
            bucket,
            per_unit,
        )

    def _scanning(self, rate: FloatArray | None, acceleration: FloatArray | None, elevation: FloatArray) -> Scanning:
        value, deflection = self.calibration.value, self._deflection
        if rate is None or acceleration is None or not self.needs_encoder_motion:
            rate = acceleration = np.zeros(0)
        return Scanning(
            kind=deflection.kind,
            table=deflection.table,
            select=deflection.select,
            scale=1.0 + value("scan_angle_scale"),
            offset_rad=value("scan_angle_offset_rad"),
            latency_s=value("encoder_latency_s"),
            torsion_s2=value("torsion_s2"),
            rate=contiguous(rate),
            acceleration=contiguous(acceleration),
            elevation=elevation,
        )

    def _mounted(self, time_ns: Int64Array) -> Mounted:
        """Return s to b at the pulses' times (n,), except for the part that depends on θ.

        It comprises κ, gimbal, installation and head.
        """
        gimbal, centre, known = self.mount.poses(time_ns)
        rot_mount_from_s = gimbal @ self.calibration.installation_matrix
        inner = self._kappa @ rot_mount_from_s @ self._deflection.rot_s_from_head
        shift = (centre + rot_mount_from_s @ self._deflection.head_s) @ self._kappa.T
        # beams of line scanners start at the scanner's origin
        shifted = bool(shift.any()) or self._deflection.kind == SPINNING
        slope = self.calibration.value("pitch_slope")
        return Mounted(self._outer, slope, inner, shift, shifted, known, self.calibration.lever_arm_b[np.newaxis])

    def _track(self, trajectory: Trajectory, offset_ns: float) -> Track:
        return Track(
            contiguous(trajectory.time_ns),
            contiguous(trajectory.position_e),
            contiguous(trajectory.q_e_from_b),
            contiguous(trajectory.rotvec_b),
            trajectory.max_gap_ns,
            offset_ns,
            self.calibration.value("imu_latency_s") * _SECOND_NS,
        )

    def _readings(self, rows: StructArray) -> FloatArray:
        """Return the readings (n,) from which the scan angle's offset is subtracted."""
        deflection, readings = self._deflection, rows["encoder_rad"]
        if deflection.select < FIBRE_BY_CHANNEL:
            return readings.copy()
        count = len(deflection.table)
        fibre = np.minimum(rows["channel"], count - 1)
        if deflection.select == FIBRE_BY_ENCODER:
            fibre = np.rint(readings * (count / (2.0 * np.pi))).astype(np.int64) % count
        chosen: FloatArray = deflection.table[fibre, FIXED_ANGLE]
        return chosen


def _out(count: int) -> Out:
    """Return room for the results of n returns."""
    return Out(
        fate=np.empty(count, np.uint8),
        time_ns=np.empty(count, np.int64),
        points_e=np.empty((count, 3)),
        origin_e=np.empty((count, 3)),
        angle_rad=np.empty(count),
        off_nadir_rad=np.empty(count),
        range_m=np.empty(count),
    )


def _axes(count: int) -> Axes:
    """Return room for the axes of n returns."""
    return Axes(
        q_e_from_b=np.empty((4, count)),
        epoch=np.zeros(count, np.int64),
        share=np.zeros(count),
        arm_b=np.empty((3, count)),
        range_axis_b=np.empty((3, count)),
        angle_axis_b=np.empty((3, count)),
        tilt_axis_b=np.empty((3, count)),
    )


def _range_offsets(calibration: Calibration, prf_hz: float | None) -> FloatArray:
    """Return metres (256, 256) by return number and MTA zone at this pulse rate; zeros (1, 1) without such a table."""
    matching = [
        row
        for row in calibration.range_offsets
        if row.prf_hz is None or (prf_hz is not None and abs(prf_hz - row.prf_hz) <= PRF_TOLERANCE * row.prf_hz)
    ]
    if not matching:
        return np.zeros((1, 1))
    added = np.zeros((256, 256))
    for row in matching:
        slots = slice(None) if row.return_slot is None else slice(row.return_slot, row.return_slot + 1)
        zones = slice(None) if row.mta_zone is None else slice(row.mta_zone, row.mta_zone + 1)
        added[slots, zones] += row.offset_m
    return added


def _ibrc_tables(calibration: Calibration) -> tuple[FloatArray, FloatArray, FloatArray, Int64Array, float]:
    """Return the tables of the intensity-based range correction, as `Ranging` has them.

    They are its knots, and for each step of intensity the knot at which the search begins.
    """
    if calibration.ibrc is None:
        nothing = np.zeros(0)
        return nothing, nothing, nothing, np.zeros(1, np.int64), 0.0
    intensity, correction_m = (np.ascontiguousarray(column, dtype=np.float64) for column in calibration.ibrc)
    steps = IBRC_STEPS_A_KNOT * len(intensity)
    per_unit = steps / max(float(intensity[-1] - intensity[0]), 1e-300)
    begins = intensity[0] + np.arange(steps + 1) / per_unit
    at = np.clip(np.searchsorted(intensity, begins, side="right") - 1, 0, max(len(intensity) - 2, 0))
    return intensity, correction_m, np.diff(correction_m) / np.diff(intensity), at.astype(np.int64), per_unit
