"""Derivatives of a point by parameters and observations: analytic columns (FORMULAS 5.2; ISO/TS 19159-2 Eq. 14).

They are the exact derivatives of the model, at the values of the rays, in e; `columns_l` turns them to l. The bending
of the beam is left out, and in the column of the time offset the gimbal's own motion.
"""

from __future__ import annotations

import numpy as np

from swath.georef.arrays import FloatArray
from swath.georef.geodesy.earth import geodetic_from_e, rot_e_from_l
from swath.georef.geodesy.rotations import attitude_of, rot_from_quaternion, rot_x, rot_y
from swath.georef.points import Rays
from swath.georef.scanner.calibration import INDEX, PARAMETERS
from swath.georef.scanner.sensor_model import SensorModel
from swath.georef.trajectory.trajectory import Trajectory

OBSERVATIONS = ("x_e", "y_e", "z_e", "roll_rad", "pitch_rad", "heading_rad", "range_m", "encoder_rad")
ELEVATION = len(OBSERVATIONS)  # the column after these, of returns with an elevation of their own
_SECOND_NS = 1e9


def parameter_columns_e(rays: Rays, model: SensorModel, trajectory: Trajectory) -> FloatArray:
    """Return ∂point/∂parameter in e.

    Args:
        rays: with axes, (n,).
        model: that made them.
        trajectory: on which they were made.

    Returns:
        (n, 16, 3) in the order of `PARAMETERS`, metres per SI unit; rows of returns that were not georeferenced are
        undefined.
    """
    value = model.calibration.value
    arm, by_range, by_angle, by_tilt = _axes(rays)
    columns = np.zeros((len(rays.fate), len(PARAMETERS), 3))
    turning = arm - model.calibration.lever_arm_b  # the part of the arm that the boresight turns
    outer = rot_x(value("omega_rad"))
    slope = value("pitch_slope")
    outer_of_row = outer @ rot_y(value("phi_rad") + slope * rays.angle_rad)
    columns[:, INDEX["omega_rad"]] = np.cross([1.0, 0.0, 0.0], turning)
    columns[:, INDEX["phi_rad"]] = np.cross(outer[:, 1], turning)
    columns[:, INDEX["kappa_rad"]] = np.cross(outer_of_row[:, :, 2], turning)
    columns[:, INDEX["pitch_slope"]] = rays.angle_rad[:, np.newaxis] * columns[:, INDEX["phi_rad"]]
    columns[:, INDEX["range_offset_m"]] = by_range
    columns[:, INDEX["range_scale"]] = _column(rays.measured_m) * by_range
    columns[:, INDEX["scan_angle_offset_rad"]] = -(1.0 + value("scan_angle_scale")) * by_angle
    columns[:, INDEX["scan_angle_scale"]] = (_column(rays.encoder_rad) - value("scan_angle_offset_rad")) * by_angle
    columns[:, INDEX["encoder_latency_s"]] = _column(rays.encoder_rate) * by_angle
    columns[:, INDEX["torsion_s2"]] = _column(rays.encoder_acceleration) * by_angle
    columns[:, INDEX["scan_plane_tilt_rad"]] = by_tilt
    first = INDEX["lever_arm_x_m"]
    columns[:, first : first + 3] = np.eye(3)
    rate_eb_b, velocity_e = _motion(rays, value("imu_latency_s"), trajectory)
    columns[:, INDEX["imu_latency_s"]] = columns[:, INDEX["time_offset_s"]] = np.cross(rate_eb_b, arm)
    columns = columns @ _rot_b_from_e(rays)
    columns[:, INDEX["time_offset_s"]] += velocity_e
    columns[:, [INDEX[name] for name in model.geometry.without]] = 0.0
    return columns


def observation_columns_e(rays: Rays, model: SensorModel, trajectory: Trajectory) -> FloatArray:
    """Return ∂point/∂observation in e: the eight of ISO/TS 19159-2 Eq. 13, and the elevation of a return that has one.

    Args:
        rays, model, trajectory: as of `parameter_columns_e`.

    Returns:
        (n, 8, 3) in the order of `OBSERVATIONS`: position of the body in e; roll, pitch, heading; range as measured;
        encoder reading; (n, 9, 3) with the elevation last where returns have one.
    """
    value = model.calibration.value
    arm, by_range, by_angle, by_tilt = _axes(rays)
    rot_b_from_e = _rot_b_from_e(rays)
    body_e = _body_e(rays, trajectory)
    rot_e_l = _rot_e_from_l(body_e)
    roll, pitch, _ = attitude_of(np.swapaxes(rot_e_l, 1, 2) @ np.swapaxes(rot_b_from_e, 1, 2))
    columns = np.zeros((len(rays.fate), len(OBSERVATIONS) + model.aimed, 3))
    turned_back = np.swapaxes(rot_x(roll), 1, 2)  # axes in b: roll x, pitch Rx(−r) y, heading Rx(−r) Ry(−p) z
    columns[:, 3] = np.cross([1.0, 0.0, 0.0], arm)
    columns[:, 4] = np.cross(turned_back[:, :, 1], arm)
    columns[:, 5] = np.cross((turned_back @ rot_y(-pitch))[:, :, 2], arm)
    columns[:, 6] = (1.0 + value("range_scale")) * by_range
    columns[:, 7] = (1.0 + value("scan_angle_scale")) * by_angle
    if model.aimed:
        columns[:, ELEVATION] = by_tilt
    columns = columns @ rot_b_from_e
    columns[:, :3] = np.eye(3)
    return columns


def columns_l(columns_e: FloatArray, rays: Rays, trajectory: Trajectory) -> FloatArray:
    """Return columns (n, m, 3) in e converted to north, east, down at the body."""
    turned: FloatArray = columns_e @ _rot_e_from_l(_body_e(rays, trajectory))
    return turned


def _axes(rays: Rays) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    arm, by_range, by_angle, by_tilt = rays.arm_b, rays.range_axis_b, rays.angle_axis_b, rays.tilt_axis_b
    if arm is None or by_range is None or by_angle is None or by_tilt is None:
        raise ValueError("rays without axes; want rays(…, with_axes=True)")
    return arm, by_range, by_angle, by_tilt


def _column(values: FloatArray | None) -> FloatArray:
    """Return values as a column (n, 1); zero (1, 1) for None."""
    column: FloatArray = np.zeros((1, 1)) if values is None else values[:, np.newaxis]
    return column


def _rot_b_from_e(rays: Rays) -> FloatArray:
    """Return rotations (n, 3, 3); rows of vectors in b times these are rows in e."""
    if rays.q_e_from_b is None:
        raise ValueError("rays without axes; want rays(…, with_axes=True)")
    return np.swapaxes(rot_from_quaternion(rays.q_e_from_b), 1, 2)


def _body_e(rays: Rays, trajectory: Trajectory) -> FloatArray:
    """Return the body's positions (n, 3)."""
    if rays.epoch is None:
        raise ValueError("rays without axes; want rays(…, with_axes=True)")
    here, there = trajectory.position_e[rays.epoch], trajectory.position_e[rays.epoch + 1]
    body_e: FloatArray = here + _column(rays.share) * (there - here)
    return body_e


def _rot_e_from_l(body_e: FloatArray) -> FloatArray:
    lat_rad, lon_rad, _ = geodetic_from_e(body_e)
    return rot_e_from_l(lat_rad, lon_rad)


def _motion(rays: Rays, imu_latency_s: float, trajectory: Trajectory) -> tuple[FloatArray, FloatArray]:
    """Return the body's turn rate against e, in b, at the attitude's time, and its velocity in e at the position's.

    Both (n, 3) are those of the interpolated trajectory: constant between two of its epochs.
    """
    if rays.epoch is None:
        raise ValueError("rays without axes; want rays(…, with_axes=True)")
    later = rays.time_ns + round(imu_latency_s * _SECOND_NS)
    turn = np.clip(np.searchsorted(trajectory.time_ns, later, side="right") - 1, 0, len(trajectory.time_ns) - 2)
    seconds = np.diff(trajectory.time_ns) / _SECOND_NS
    way = trajectory.position_e[rays.epoch + 1] - trajectory.position_e[rays.epoch]
    return trajectory.rotvec_b[turn] / _column(seconds[turn]), way / _column(seconds[rays.epoch])
