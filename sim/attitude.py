"""The attitude an aircraft needs to fly along a path: coordinated turns, nose into the relative wind."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from swath.sim.gravity import RATE_IE_E, gravity_e
from swath.sim.plan.tables import FlightTable
from swath.sim.site import geodetic_from_e, rot_e_from_ned

FloatArray = NDArray[np.float64]

_ROLLING_MPS = 1.0  # slower, and the runway says where the nose points


def coordinated(
    motion_e: tuple[FloatArray, FloatArray, FloatArray], runway_e: FloatArray, airborne: FloatArray, flight: FlightTable
) -> FloatArray:
    """(n, 3) roll, pitch and heading, radians.

    The nose points along the air's velocity in the level plane and ``pitch_deg`` above the path; the roll is that at
    which what the body feels (acceleration in inertial space less gravity) has nothing to the side. On the ground the
    wings and the nose are level and the wheels hold the course.

    Args:
        motion_e: position, velocity and acceleration, (n, 3) each, ECEF.
        runway_e: (3,) direction of the runway.
        airborne: (n,) 0 on the ground, 1 in the air, in between at take-off.
        flight: the plan's table.
    """
    position_e, velocity_e, acceleration_e = motion_e
    lat_rad, lon_rad, _ = geodetic_from_e(position_e)
    rot_e_from_l = rot_e_from_ned(lat_rad, lon_rad)
    force_e = acceleration_e + 2.0 * np.cross(RATE_IE_E, velocity_e) - gravity_e(position_e)
    velocity_l, force_l = (np.einsum("nji,nj->ni", rot_e_from_l, vector) for vector in (velocity_e, force_e))
    runway_l = np.einsum("nji,j->ni", rot_e_from_l, runway_e)
    air = velocity_l[:, :2] - airborne[:, np.newaxis] * np.array([flight.wind_mps[1], flight.wind_mps[0]])
    speed_mps = np.hypot(velocity_l[:, 0], velocity_l[:, 1])
    nose = np.where(speed_mps[:, np.newaxis] > _ROLLING_MPS, air, runway_l[:, :2])
    heading = np.arctan2(nose[:, 1], nose[:, 0])
    pitch = airborne * (np.arctan2(-velocity_l[:, 2], speed_mps) + math.radians(flight.pitch_deg))
    forward = force_l[:, 0] * np.cos(heading) + force_l[:, 1] * np.sin(heading)
    right = force_l[:, 1] * np.cos(heading) - force_l[:, 0] * np.sin(heading)
    down = np.sin(pitch) * forward + np.cos(pitch) * force_l[:, 2]
    return np.stack([airborne * np.arctan2(right, -down), pitch, heading], axis=-1)


def quaternions_e_from_b(position_e: FloatArray, angles_rad: FloatArray) -> FloatArray:
    """(n, 4) x, y, z, w of roll, pitch, heading (n, 3) at places (n, 3), without a change of sign on the way."""
    lat_rad, lon_rad, _ = geodetic_from_e(position_e)
    rot_e_from_l = Rotation.from_matrix(rot_e_from_ned(lat_rad, lon_rad))
    turned = rot_e_from_l * Rotation.from_euler("ZYX", angles_rad[:, ::-1])
    quaternions: FloatArray = turned.as_quat()
    flips = np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0.0
    quaternions[1:][np.cumsum(flips) % 2 == 1] *= -1.0
    return quaternions
