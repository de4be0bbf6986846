"""Loops of the error model over points and pairs of points."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.compiled import jit_cached, jit_inline

MOVING = 9  # independent errors of the trajectory, six, and the unmodelled, three
LONGEST = 700.0


class Numbers(NamedTuple):
    """A model, packed; u units, k posts of all of them in a row, vectors in m.

    Attributes:
        first_post: (u + 1,) of each unit.
        post_ns: (k,); position_m: (k, 3); root: (k, 6, 6) root of the posts' covariances.
        calibration: (u, q, 7) offsets of position (m), of angles (m's axes) and of range by each independent error.
        scanner: (u,) number of the scanner; units of one share the calibration's errors.
        axes: (u, 3, 3) from the path system to m.
        unmodelled: (u, 3, 3) root of the covariance; in_space: (u, 3, 4) A, α, β, τ along u, v, w.
        in_time: (6, 4) A, α, β, τ of the trajectory's components.
        noise: (u, 3) along the beam (m), across and along the path (rad).
    """

    first_post: Int64Array
    post_ns: Int64Array
    position_m: FloatArray
    root: FloatArray
    calibration: FloatArray
    scanner: Int64Array
    axes: FloatArray
    unmodelled: FloatArray
    in_space: FloatArray
    in_time: FloatArray
    noise: FloatArray


@jit_inline
def _correlation(values: FloatArray, lag: float) -> float:
    apart = abs(lag)
    if apart == 0.0:
        return 1.0
    a, alpha, beta = values[0], values[1], values[2]
    return float(a * (alpha + (1.0 - alpha) * (1.0 + beta) / (beta + math.exp(min(apart / values[3], LONGEST)))))


@jit_inline
def _effect(
    numbers: Numbers,
    point: FloatArray,
    time_ns: int,
    unit: int,
    moving: FloatArray,
    lasting: FloatArray,
    beam: FloatArray,
) -> None:
    """Compute one sigma's effect on a point of each error: ``moving`` (3, 9), ``lasting`` (3, q); and the beam."""
    first, last = numbers.first_post[unit], numbers.first_post[unit + 1] - 1
    low, high = first, last
    while high - low > 1:
        middle = (low + high) // 2
        if numbers.post_ns[middle] <= time_ns:
            low = middle
        else:
            high = middle
    share = 0.0
    if high > low:
        share = float(time_ns - numbers.post_ns[low]) / float(numbers.post_ns[high] - numbers.post_ns[low])
        share = min(max(share, 0.0), 1.0)
    for axis in range(3):
        at = (1.0 - share) * numbers.position_m[low, axis] + share * numbers.position_m[high, axis]
        beam[axis] = point[axis] - at
    x, y, z = beam[0], beam[1], beam[2]
    for error in range(6):
        r0 = (1.0 - share) * numbers.root[low, 0, error] + share * numbers.root[high, 0, error]
        r1 = (1.0 - share) * numbers.root[low, 1, error] + share * numbers.root[high, 1, error]
        r2 = (1.0 - share) * numbers.root[low, 2, error] + share * numbers.root[high, 2, error]
        t0 = (1.0 - share) * numbers.root[low, 3, error] + share * numbers.root[high, 3, error]
        t1 = (1.0 - share) * numbers.root[low, 4, error] + share * numbers.root[high, 4, error]
        t2 = (1.0 - share) * numbers.root[low, 5, error] + share * numbers.root[high, 5, error]
        moving[0, error] = r0 + t1 * z - t2 * y
        moving[1, error] = r1 + t2 * x - t0 * z
        moving[2, error] = r2 + t0 * y - t1 * x
    for error in range(3):
        for axis in range(3):
            moving[axis, 6 + error] = numbers.unmodelled[unit, axis, error]
    far = math.sqrt(x * x + y * y + z * z)
    for error in range(lasting.shape[1]):
        c = numbers.calibration[unit, error]
        longer = c[6] / far
        lasting[0, error] = c[0] + c[4] * z - c[5] * y + longer * x
        lasting[1, error] = c[1] + c[5] * x - c[3] * z + longer * y
        lasting[2, error] = c[2] + c[3] * y - c[4] * x + longer * z


@jit_inline
def _add_noise(numbers: Numbers, unit: int, beam: FloatArray, out: FloatArray) -> None:
    """Add the noise of one return: along the beam, across the path and along it, at right angles to the beam."""
    x, y, z = beam[0], beam[1], beam[2]
    far = math.sqrt(x * x + y * y + z * z)
    along, across, forward = numbers.noise[unit, 0], numbers.noise[unit, 1] * far, numbers.noise[unit, 2] * far
    ux, uy, uz = x / far, y / far, z / far
    axes = numbers.axes[unit]
    fx, fy, fz = axes[0, 0], axes[1, 0], axes[2, 0]
    shared = fx * ux + fy * uy + fz * uz
    fx, fy, fz = fx - shared * ux, fy - shared * uy, fz - shared * uz
    length = math.sqrt(fx * fx + fy * fy + fz * fz)
    if length < 1e-6:  # a beam along the path has no side
        fx, fy, fz = axes[0, 2], axes[1, 2], axes[2, 2]
        length = 1.0
    fx, fy, fz = fx / length, fy / length, fz / length
    sx, sy, sz = uy * fz - uz * fy, uz * fx - ux * fz, ux * fy - uy * fx
    along, across, forward = along * along, across * across, forward * forward
    out[0, 0] += along * ux * ux + across * sx * sx + forward * fx * fx
    out[0, 1] += along * ux * uy + across * sx * sy + forward * fx * fy
    out[0, 2] += along * ux * uz + across * sx * sz + forward * fx * fz
    out[1, 1] += along * uy * uy + across * sy * sy + forward * fy * fy
    out[1, 2] += along * uy * uz + across * sy * sz + forward * fy * fz
    out[2, 2] += along * uz * uz + across * sz * sz + forward * fz * fz


@jit_cached
def point_covariances(
    numbers: Numbers, points: FloatArray, time_ns: Int64Array, unit: Int64Array, found: FloatArray
) -> None:
    """Fill covariances (n, 3, 3) of points (n, 3)."""
    moving, beam = np.empty((3, MOVING)), np.empty(3)
    lasting = np.empty((3, numbers.calibration.shape[1]))
    for i in range(len(points)):
        _effect(numbers, points[i], time_ns[i], unit[i], moving, lasting, beam)
        out = found[i]
        for row in range(3):
            for column in range(row, 3):
                sum_ = 0.0
                for error in range(MOVING):
                    sum_ += moving[row, error] * moving[column, error]
                for error in range(lasting.shape[1]):
                    sum_ += lasting[row, error] * lasting[column, error]
                out[row, column] = sum_
        _add_noise(numbers, unit[i], beam, out)
        out[1, 0], out[2, 0], out[2, 1] = out[0, 1], out[0, 2], out[1, 2]


@jit_cached
def crossed_covariances(
    numbers: Numbers,
    points: FloatArray, time_ns: Int64Array, unit: Int64Array,
    others: FloatArray, other_ns: Int64Array, other_unit: Int64Array,
    found: FloatArray,
) -> None:  # fmt: skip
    """Fill covariances (n, 3, 3) of the errors of points with those of other points, of two different returns."""
    moving, beam, weight = np.empty((3, MOVING)), np.empty(3), np.empty(MOVING)
    lasting = np.empty((3, numbers.calibration.shape[1]))
    moving_2, lasting_2 = np.empty_like(moving), np.empty_like(lasting)
    for i in range(len(points)):
        a, b = unit[i], other_unit[i]
        _effect(numbers, points[i], time_ns[i], a, moving, lasting, beam)
        _effect(numbers, others[i], other_ns[i], b, moving_2, lasting_2, beam)
        lag_s = float(other_ns[i] - time_ns[i]) * 1e-9
        for error in range(6):
            weight[error] = _correlation(numbers.in_time[error], lag_s)
        together = 0.0
        if a == b:
            together = 1.0
            for axis in range(3):
                apart = 0.0
                for row in range(3):
                    apart += numbers.axes[a, row, axis] * (others[i, row] - points[i, row])
                together *= _correlation(numbers.in_space[a, axis], apart)
        weight[6:] = together
        same = 1.0 if numbers.scanner[a] == numbers.scanner[b] else 0.0
        for row in range(3):
            for column in range(3):
                sum_ = 0.0
                for error in range(MOVING):
                    sum_ += weight[error] * moving[row, error] * moving_2[column, error]
                for error in range(lasting.shape[1]):
                    sum_ += same * lasting[row, error] * lasting_2[column, error]
                found[i, row, column] = sum_
