"""A strapdown navigator of the simulator's own: it recovers the trajectory from increments to prove them right.

It is mechanised in e (Savage, Strapdown Inertial Navigation Integration Algorithm Design, J. Guidance 21(1) and 21(2),
1998): attitude by quaternion with the coning of neighbouring increments, velocity with rotation compensation and
sculling, normal gravity at the middle of each interval, Coriolis acceleration, position by the trapezium rule.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from swath.georef.arrays import FloatArray
from swath.sim.compiled import jit_cached, jit_inline
from swath.sim.gravity import EARTH_RATE_RADPS, gravity_at

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class States:
    """States at the ends of n intervals.

    Attributes:
        position_e: (n, 3) metres.
        velocity_e: (n, 3) m/s, against e.
        rot_e_from_b: n rotations.
    """

    position_e: FloatArray
    velocity_e: FloatArray
    rot_e_from_b: Rotation


def navigate(
    position_e: FloatArray,
    velocity_e: FloatArray,
    rot_e_from_b: FloatArray,
    angle_b: FloatArray,
    velocity_b: FloatArray,
    span_s: FloatArray,
) -> States:
    """Navigate by increments alone.

    Args:
        position_e, velocity_e: (3,) at the start.
        rot_e_from_b: (3, 3) at the start.
        angle_b, velocity_b: (n, 3) increments of `swath.sim.imu.sensors.true_increments`.
        span_s: (n,) lengths of their intervals.
    """
    attitude = Rotation.from_matrix(rot_e_from_b).as_quat(scalar_first=True)
    states = _navigate(np.concatenate([position_e, velocity_e, attitude]), angle_b, velocity_b, span_s)
    return States(states[:, :3], states[:, 3:6], Rotation.from_quat(states[:, 6:], scalar_first=True))


# Compiled functions use tuples as vectors and quaternions: they allocate nothing and compile in a fraction of the time.


@jit_inline
def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@jit_inline
def _plus(a: Vector, factor: float, b: Vector) -> Vector:
    """Return a + factor · b."""
    return a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2]


@jit_inline
def _product(p: Quaternion, q: Quaternion) -> Quaternion:
    """Return Hamilton's product of two quaternions, scalar first."""
    return (
        p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3],
        p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
        p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1],
        p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0],
    )


@jit_inline
def _turned(q: Quaternion, vector: Vector) -> Vector:
    """Return q v q* for a unit quaternion q."""
    axis = (q[1], q[2], q[3])
    once = _cross(axis, vector)
    return _plus(_plus(vector, 2.0 * q[0], once), 2.0, _cross(axis, once))


@jit_inline
def _quaternion(angle: Vector) -> Quaternion:
    """Return the quaternion of a rotation vector of a small angle."""
    square = 0.25 * (angle[0] * angle[0] + angle[1] * angle[1] + angle[2] * angle[2])
    half_sine = 0.5 * (1.0 - square / 6.0 * (1.0 - square / 20.0 * (1.0 - square / 42.0)))
    cosine = 1.0 - square / 2.0 * (1.0 - square / 12.0 * (1.0 - square / 30.0))
    return cosine, half_sine * angle[0], half_sine * angle[1], half_sine * angle[2]


@jit_inline
def _force_increment(angle: Vector, force: Vector, angle_before: Vector, force_before: Vector) -> Vector:
    """Return ∫ f in the axes of the interval's start, exact for a steady rotation, with sculling."""
    square = angle[0] * angle[0] + angle[1] * angle[1] + angle[2] * angle[2]
    first, second = 0.5 - square / 24.0 * (1.0 - square / 30.0), 1.0 / 6.0 - square / 120.0 * (1.0 - square / 42.0)
    once = _cross(angle, force)
    turned = _plus(_plus(force, first, once), second, _cross(angle, once))
    return _plus(_plus(turned, 1.0 / 12.0, _cross(angle_before, force)), 1.0 / 12.0, _cross(force_before, angle))


@jit_cached
def _navigate(start: FloatArray, angles: FloatArray, forces: FloatArray, spans: FloatArray) -> FloatArray:
    states = np.empty((len(spans), 10))
    position, velocity = (start[0], start[1], start[2]), (start[3], start[4], start[5])
    attitude = (start[6], start[7], start[8], start[9])
    zero, rate = (0.0, 0.0, 0.0), (0.0, 0.0, EARTH_RATE_RADPS)
    angle_before, force_before = zero, zero
    for k in range(len(spans)):
        span = spans[k]
        angle, force = (angles[k, 0], angles[k, 1], angles[k, 2]), (forces[k, 0], forces[k, 1], forces[k, 2])
        felt = _turned(attitude, _force_increment(angle, force, angle_before, force_before))
        felt = _plus(felt, -0.5 * span, _cross(rate, felt))  # e rotates meanwhile: take its axes at the middle
        middle = _plus(position, 0.5 * span, velocity)
        pushed = _plus(felt, span, gravity_at(middle[0], middle[1], middle[2]))
        half_way = _plus(_plus(velocity, 0.5, pushed), -span, _cross(rate, velocity))
        after = _plus(_plus(velocity, 1.0, pushed), -2.0 * span, _cross(rate, half_way))
        position = _plus(_plus(position, 0.5 * span, velocity), 0.5 * span, after)
        velocity = after
        turn = _quaternion(_plus(angle, 1.0 / 12.0, _cross(angle_before, angle)))
        attitude = _product(_quaternion(_plus(zero, -span, rate)), _product(attitude, turn))
        q0, q1, q2, q3 = attitude
        shrink = 1.0 / np.sqrt(q0 * q0 + q1 * q1 + q2 * q2 + q3 * q3)
        attitude = (shrink * q0, shrink * q1, shrink * q2, shrink * q3)
        states[k, 0], states[k, 1], states[k, 2] = position
        states[k, 3], states[k, 4], states[k, 5] = velocity
        states[k, 6], states[k, 7], states[k, 8], states[k, 9] = attitude
        angle_before, force_before = angle, force
    return states
