"""Prepare the inputs of the loops over rows as tables: returns, their scanner and their trajectory."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from swath.calib.equations.tables import Beam, Head, RowDiagnostics, Sigmas
from swath.calib.flight import Flight, Swath
from swath.calib.intensity_curve import at_knots, curve_by_knots
from swath.calib.parameters import Unknowns
from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.geodesy.rotations import rot_x, rot_y, rot_z
from swath.georef.points import Rays, contiguous
from swath.georef.return_rows import plain
from swath.georef.scanner.beams import OusterGeometry
from swath.georef.scanner.calibration import Calibration
from swath.georef.scanner.kernels.types import Track
from swath.georef.scanner.sensor_model import SensorModel
from swath.georef.trajectory.trajectory import Trajectory

SECOND_NS = 1e9
TRACKED = ("time_ns", "position_e", "q_e_from_b", "position_sigma_l", "attitude_sigma_rad")


def new_looks(count: int, cofactor: FloatArray, design: FloatArray) -> RowDiagnostics:
    """Allocate the diagnostics of n rows."""
    return RowDiagnostics(np.zeros(count), np.zeros(count), np.zeros(count), np.zeros(count), cofactor, design)


def writeable(trajectory: Trajectory) -> Trajectory:
    """Return a trajectory whose columns the kernels accept without conversion."""
    columns: dict[str, Any] = {name: contiguous(getattr(trajectory, name)) for name in TRACKED}
    return replace(trajectory, **columns)


def rays_of(flight: Flight, swath: Swath, model: SensorModel, rows: Any, at: Int64Array) -> Rays:
    still = np.zeros(len(at))
    rays = model.rays(
        rows,
        swath.time_ns[at],
        flight.trajectories[swath.trajectory_index],
        encoder_rate=still if swath.encoder_rate is None else swath.encoder_rate[at],
        encoder_acceleration=still if swath.encoder_acceleration is None else swath.encoder_acceleration[at],
        with_axes=True,
    )
    if model.air is not None:
        model.air.apply(rays.origin_e, rays.points_e)
    return rays


def beam_table(rows: Any, rays: Rays) -> Beam:
    columns: dict[str, Any] = {"rows": plain(rows)}
    for name in Beam._fields[1:]:
        column = getattr(rays, name)
        columns[name] = column.T if name.endswith("_b") else column
    return Beam(**columns)


def track_of(trajectory: Trajectory, calibration: Calibration) -> Track:
    return Track(
        trajectory.time_ns,
        trajectory.position_e,
        trajectory.q_e_from_b,
        trajectory.rotvec_b,
        trajectory.max_gap_ns,
        calibration.value("time_offset_s") * SECOND_NS,
        calibration.value("imu_latency_s") * SECOND_NS,
    )


def sigmas_of(trajectory: Trajectory) -> Sigmas:
    """Return a trajectory's sigmas, 0 where it has none."""
    return Sigmas(np.nan_to_num(trajectory.position_sigma_l), np.nan_to_num(trajectory.attitude_sigma_rad))


def head_table(unknowns: Unknowns, flight: Flight, index: int, model: SensorModel) -> Head:
    head, calibration = flight.heads[index], model.calibration
    value, deflection = calibration.value, head.geometry.deflection(calibration)
    outer = rot_x(value("omega_rad")) @ rot_y(value("phi_rad"))
    inner = rot_z(value("kappa_rad")) @ calibration.installation_matrix @ deflection.rot_s_from_head
    before_m = np.nan
    if isinstance(head.geometry, OusterGeometry):
        before_m = float(np.hypot(*head.geometry.beam_origin_m))
    nodes, by_knot = np.zeros(0), np.zeros((0, 0))
    if len(unknowns.knots) and calibration.ibrc is not None:
        nodes, by_knot = calibration.ibrc[0], curve_by_knots(unknowns.knots, at_knots(calibration.ibrc[1]))
    return Head(
        *unknowns.of_head(index),
        calibration.parameters,
        outer[np.newaxis],
        (outer @ inner)[np.newaxis, :, 2].copy(),
        before_m,
        nodes,
        by_knot,
        float(head.noise.range_m),
        float(head.noise.angle_rad),
        float(head.noise.angle_rad) if model.aimed else 0.0,
        float(head.noise.time_s),
        float(head.noise.divergence_rad),
    )
