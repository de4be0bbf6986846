"""Arithmetic of unit quaternions (…, 4), scalar first, in NumPy, without matrices in between to save memory."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from swath.georef.arrays import FloatArray


def about(axis: int, angle_rad: ArrayLike) -> FloatArray:
    """Return quaternions (…, 4) of right-handed turns by angles (…,) about axis 0, 1 or 2."""
    half = np.asarray(angle_rad, dtype=np.float64) / 2
    q = np.zeros((*half.shape, 4))
    q[..., 0], q[..., 1 + axis] = np.cos(half), np.sin(half)
    return q


def conjugate(q: FloatArray) -> FloatArray:
    """Return the inverse turn."""
    back: FloatArray = q * np.array([1.0, -1.0, -1.0, -1.0])
    return back


def product(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return a ⊗ b: first the turn b, then a, as with matrices."""
    aw, ax, ay, az = a[..., 0], a[..., 1], a[..., 2], a[..., 3]
    bw, bx, by, bz = b[..., 0], b[..., 1], b[..., 2], b[..., 3]
    q = np.empty(np.broadcast_shapes(a.shape, b.shape))
    q[..., 0] = aw * bw - ax * bx - ay * by - az * bz
    q[..., 1] = aw * bx + ax * bw + ay * bz - az * by
    q[..., 2] = aw * by - ax * bz + ay * bw + az * bx
    q[..., 3] = aw * bz + ax * by - ay * bx + az * bw
    return q


def rotated(q: FloatArray, vector: FloatArray) -> FloatArray:
    """Return vectors (…, 3) turned by q: q ⊗ v ⊗ q*."""
    twice = 2.0 * np.cross(q[..., 1:], vector)
    turned: FloatArray = vector + q[..., :1] * twice + np.cross(q[..., 1:], twice)
    return turned


def rotation_vector(q: FloatArray) -> FloatArray:
    """Return (…, 3) axis times angle, rad, of the shorter turn (angle ≤ π)."""
    sine = np.sqrt((q[..., 1:] ** 2).sum(axis=-1, keepdims=True))
    cosine = q[..., :1]
    half = np.arctan2(sine, np.abs(cosine))
    with np.errstate(invalid="ignore", divide="ignore"):
        factor = np.where(sine > 0.0, 2.0 * half / sine, 2.0)
    turned: FloatArray = np.where(cosine < 0.0, -factor, factor) * q[..., 1:]
    return turned


def rotations_between(q: FloatArray) -> FloatArray:
    """Return turns (n − 1, 3) from each of (n, 4) to the next, as `rotation_vector` in the axes of the first."""
    return rotation_vector(product(conjugate(q[:-1]), q[1:]))
