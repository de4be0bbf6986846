"""Rotations: elementary matrices, attitude, boresight, quaternions, deflection of the vertical (FORMULAS 0, 1.4–1.8).

All are active and right-handed: ``rot_b_from_s`` takes coordinates in s to coordinates in b. Quaternions are of unit
length, scalar first. Functions take angles (…,) in radians and return (…, 3, 3).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from swath.georef.arrays import FloatArray
from swath.georef.geodesy.earth import rot_e_from_l


def rot_x(angle_rad: ArrayLike) -> FloatArray:
    """Return the rotation about x: y turns towards z."""
    return _about(angle_rad, 1, 2)


def rot_y(angle_rad: ArrayLike) -> FloatArray:
    """Return the rotation about y: z turns towards x."""
    return _about(angle_rad, 2, 0)


def rot_z(angle_rad: ArrayLike) -> FloatArray:
    """Return the rotation about z: x turns towards y."""
    return _about(angle_rad, 0, 1)


def _about(angle_rad: ArrayLike, first: int, second: int) -> FloatArray:
    """Return the rotation that takes axis `first` towards axis `second`."""
    angle = np.asarray(angle_rad, dtype=np.float64)
    rotation = np.broadcast_to(np.eye(3), (*angle.shape, 3, 3)).copy()
    rotation[..., first, first] = rotation[..., second, second] = np.cos(angle)
    rotation[..., second, first] = np.sin(angle)
    rotation[..., first, second] = -np.sin(angle)
    return rotation


def rot_l_from_b(roll_rad: ArrayLike, pitch_rad: ArrayLike, heading_rad: ArrayLike) -> FloatArray:
    """Return the attitude, Rz(heading) Ry(pitch) Rx(roll) (ISO/TS 19159-2 Eq. 3, whose label is reversed)."""
    return rot_z(heading_rad) @ rot_y(pitch_rad) @ rot_x(roll_rad)


def attitude_of(rot_l_from_b: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return roll (−π … π), pitch (−π/2 … π/2) and heading (0 … 2π) of attitudes (…, 3, 3)."""
    rotation = np.asarray(rot_l_from_b, dtype=np.float64)
    roll = np.arctan2(rotation[..., 2, 1], rotation[..., 2, 2])
    pitch = np.arctan2(-rotation[..., 2, 0], np.hypot(rotation[..., 0, 0], rotation[..., 1, 0]))
    heading = np.arctan2(rotation[..., 1, 0], rotation[..., 0, 0]) % (2.0 * np.pi)
    return roll, pitch, heading


def boresight(omega_rad: ArrayLike, phi_rad: ArrayLike, kappa_rad: ArrayLike) -> FloatArray:
    """Return Rx(ω) Ry(φ) Rz(κ), from the installed scanner's axes to b (ISO/TS 19159-2 Eq. 2; FORMULAS 1.6)."""
    return rot_x(omega_rad) @ rot_y(phi_rad) @ rot_z(kappa_rad)


def skew(vector: ArrayLike) -> FloatArray:
    """Return matrices (…, 3, 3) of vectors (…, 3): skew(v) @ a = v × a."""
    x, y, z = np.moveaxis(np.asarray(vector, dtype=np.float64), -1, 0)
    zero = np.zeros_like(x)
    rows = ((zero, -z, y), (z, zero, -x), (-y, x, zero))
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def rot_l_from_plumb(lat_rad: ArrayLike, xi_rad: ArrayLike, eta_rad: ArrayLike) -> FloatArray:
    """Return the rotation from axes of the plumb line (x towards geodetic north) to l (FORMULAS 1.8).

    It is that of the deflection of the vertical: the astronomic frame of latitude + ξ and longitude + η /
    cos(latitude), turned back by the Laplace term η tan(latitude), so that headings stay geodetic; plumb-down is (−ξ,
    −η, 1) in l to first order.
    """
    lat, xi, eta = np.broadcast_arrays(*(np.asarray(a, dtype=np.float64) for a in (lat_rad, xi_rad, eta_rad)))
    east = eta / np.cos(lat)
    astronomic = np.swapaxes(rot_e_from_l(lat, 0.0), -1, -2) @ rot_e_from_l(lat + xi, east)
    return astronomic @ rot_z(-np.arctan2(astronomic[..., 1, 0], astronomic[..., 0, 0]))


def quaternion_from_rot(rotation: ArrayLike) -> FloatArray:
    """Return quaternions (…, 4) of matrices (…, 3, 3), scalar first and ≥ 0.

    They follow from the largest of the four components (Shepperd 1978).
    """
    r = np.asarray(rotation, dtype=np.float64)
    xx, yy, zz = r[..., 0, 0], r[..., 1, 1], r[..., 2, 2]
    # 4 q qᵀ, whose row with the largest diagonal element is q except for its length
    products = np.empty((*r.shape[:-2], 4, 4))
    products[..., 0, 0] = 1.0 + xx + yy + zz
    products[..., 1, 1] = 1.0 + xx - yy - zz
    products[..., 2, 2] = 1.0 - xx + yy - zz
    products[..., 3, 3] = 1.0 - xx - yy + zz
    for i, j, k in ((1, 2, 3), (2, 3, 1), (3, 1, 2)):
        products[..., 0, i] = products[..., i, 0] = r[..., k - 1, j - 1] - r[..., j - 1, k - 1]
        products[..., i, j] = products[..., j, i] = r[..., j - 1, i - 1] + r[..., i - 1, j - 1]
    largest = np.argmax(np.diagonal(products, axis1=-2, axis2=-1), axis=-1)
    row = np.take_along_axis(products, largest[..., np.newaxis, np.newaxis], axis=-2)[..., 0, :]
    row = row / np.linalg.norm(row, axis=-1, keepdims=True)
    quaternion: FloatArray = np.where(row[..., :1] < 0.0, -row, row)
    return quaternion


def rot_from_quaternion(quaternion: ArrayLike) -> FloatArray:
    """Return matrices (…, 3, 3) of unit quaternions (…, 4), scalar first."""
    w, x, y, z = np.moveaxis(np.asarray(quaternion, dtype=np.float64), -1, 0)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
