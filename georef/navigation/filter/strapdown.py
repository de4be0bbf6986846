"""Strapdown mechanisation in e: position, velocity and attitude from increments.

Attitude is integrated by rotation vectors, with coning from the previous and the present increments; velocity likewise
with rotation compensation and sculling (Savage 1998, J. Guidance 21(1), 21(2)); e turns by the earth's rate, gravity
and Coriolis acceleration are taken at the middle of each interval, position by the trapezium rule. The equations are
regular at a pole and do not jump at the antimeridian (Groves 2013, 5.3).

The state is an array x; its columns are the constants below, in the order of the corresponding error states.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from swath.georef.arrays import BoolArray, FloatArray, Int64Array
from swath.georef.compiled import jit_cached, jit_inline
from swath.georef.geodesy.gravity import EARTH_RATE_RADPS, gravity_of
from swath.georef.geodesy.vectors import cross, plus, rot_of, times
from swath.georef.navigation.inputs import Inertial
from swath.georef.scanner.kernels.types import Matrix, Three

POSITION, VELOCITY, ATTITUDE = 0, 3, 6  # m, m/s relative to the earth in e; q_e_from_b, scalar first
GYRO_BIAS, ACCEL_BIAS, GYRO_SCALE, ACCEL_SCALE = 10, 13, 16, 19
LEVER_ARM, TIME_OFFSET, SLOW, HEIGHT_BIAS = 22, 25, 26, 29
GYRO_LEAN, ACCEL_LEAN = 30, 33  # rad, of axes y and z, z and x, x and y towards each other
SLOW_VELOCITY = 36
SLOW_HEADING = 39  # of the heading and of the pitch of a baseline
STATE_SIZE = 41

# Sums over a step for the covariance: ∫ C dt, ∫ C diag(ω) dt, ∫ C diag(f) dt by rows, ∫ dt, and the last means
SUM_TURN, SUM_RATE, SUM_FORCE, SUM_TIME = 0, 9, 18, 27
LAST_RATE, LAST_FORCE = 28, 31  # rad/s and m/s² in b, corrected, of the latest part
SUMS_SIZE = 34
# With misalignments estimated: ∫ C (eⱼ ωₖ + eₖ ωⱼ) dt and the same of f, a column for the axis that is neither
SUM_RATE_ACROSS, SUM_FORCE_ACROSS = 34, 43
SUMS_SIZE_ACROSS = 52

_SMALL_2 = 1e-3  # rad², below which the series are exact to the last bit


class Samples(NamedTuple):
    """Columns of `Inertial`, as compiled loops take them; and (n, 6) variances that made-up samples add, by axis."""

    time_ns: Int64Array
    interval_s: FloatArray
    angle_b: FloatArray
    velocity_b: FloatArray
    bridged: BoolArray
    made_up: FloatArray


def samples_of(inertial: Inertial) -> Samples:
    """Return the columns of inertial samples, contiguous."""
    return Samples(
        np.ascontiguousarray(inertial.time_ns, dtype=np.int64),
        np.ascontiguousarray(inertial.interval_s, dtype=np.float64),
        np.ascontiguousarray(inertial.angle_b, dtype=np.float64),
        np.ascontiguousarray(inertial.velocity_b, dtype=np.float64),
        np.ascontiguousarray(inertial.bridged, dtype=np.bool_),
        np.zeros((0, 6)),
    )


@jit_inline
def row(array: FloatArray, k: int) -> Three:
    """Return row k of (n, 3)."""
    return array[k, 0], array[k, 1], array[k, 2]


@jit_inline
def three(array: FloatArray, k: int) -> Three:
    """Return elements k, k + 1, k + 2 of (n,)."""
    return array[k], array[k + 1], array[k + 2]


@jit_inline
def put(array: FloatArray, k: int, v: Three) -> None:
    """Set elements k, k + 1, k + 2 of (n,)."""
    array[k], array[k + 1], array[k + 2] = v


@jit_inline
def copy_into(out: FloatArray, of: FloatArray) -> None:
    """Copy out[i] ← of[i] as far as out goes; this compiles ten times as quickly as an assignment of slices."""
    for i in range(len(out)):
        out[i] = of[i]


@jit_inline
def corrected(measured: Three, bias: Three, scale: Three, lean: Three, interval_s: float) -> Three:
    """Return true increments of measured ones: u = (measured − bias · interval) / (1 + scale), less cross-axis parts.

    With axes that lean towards each other by angles l the result is u − M(l) u, M = [[0, l_z, l_y], [l_z, 0, l_x],
    [l_y, l_x, 0]]: the triad's mean axes are the body's.
    """
    u = (measured[0] - bias[0] * interval_s) / (1.0 + scale[0])
    v = (measured[1] - bias[1] * interval_s) / (1.0 + scale[1])
    w = (measured[2] - bias[2] * interval_s) / (1.0 + scale[2])
    return leaned((u, v, w), lean)


@jit_inline
def leaned(u: Three, lean: Three) -> Three:
    """Return u − M(l) u."""
    return (
        u[0] - (lean[2] * u[1] + lean[1] * u[2]),
        u[1] - (lean[2] * u[0] + lean[0] * u[2]),
        u[2] - (lean[1] * u[0] + lean[0] * u[1]),
    )


@jit_inline
def rotated_velocity(angle: Three, velocity: Three) -> Three:
    """Return ∫ exp([φ(t)]×) f dt over an interval of constant rate and force, in the axes at its start.

    Savage 1998, part 2, Eq. 20:
    Velocity increment + (1 − cos φ) / φ² φ × Δv + (φ − sin φ) / φ³ φ × (φ × Δv).
    """
    square = angle[0] * angle[0] + angle[1] * angle[1] + angle[2] * angle[2]
    if square < _SMALL_2:
        first = 0.5 - square * (1.0 / 24.0 - square * (1.0 / 720.0 - square / 40320.0))
        second = 1.0 / 6.0 - square * (1.0 / 120.0 - square * (1.0 / 5040.0 - square / 362880.0))
    else:
        size = math.sqrt(square)
        first = (1.0 - math.cos(size)) / square
        second = (1.0 - math.sin(size) / size) / square
    once = cross(angle, velocity)
    return plus(plus(velocity, first, once), second, cross(angle, once))


@jit_inline
def half_turn(angle: Three) -> tuple[float, float]:
    """Return cos(φ/2), sin(φ/2) / φ of a rotation vector."""
    square = 0.25 * (angle[0] * angle[0] + angle[1] * angle[1] + angle[2] * angle[2])
    if square < _SMALL_2:
        cos = 1.0 - square * (0.5 - square * (1.0 / 24.0 - square * (1.0 / 720.0 - square / 40320.0)))
        sin = 1.0 - square * (1.0 / 6.0 - square * (1.0 / 120.0 - square * (1.0 / 5040.0 - square / 362880.0)))
        return cos, 0.5 * sin
    size = math.sqrt(square)
    return math.cos(size), 0.5 * math.sin(size) / size


@jit_inline
def turn(x: FloatArray, angle_b: Three, earth_rad: float) -> None:
    """Turn the attitude, q ← exp(−earth / 2) ⊗ q ⊗ exp(angle_b / 2), and normalise it."""
    cos, half = half_turn(angle_b)
    i, j, k = half * angle_b[0], half * angle_b[1], half * angle_b[2]
    a, b, c, d = x[ATTITUDE], x[ATTITUDE + 1], x[ATTITUDE + 2], x[ATTITUDE + 3]
    w, u = a * cos - b * i - c * j - d * k, a * i + b * cos + c * k - d * j
    v, t = a * j - b * k + c * cos + d * i, a * k + b * j - c * i + d * cos
    e = 0.5 * earth_rad  # 4e-5 rad a second: its sine equals the angle
    w, u, v, t = w + e * t, u + e * v, v - e * u, t - e * w
    length = 1.0 / math.sqrt(w * w + u * u + v * v + t * t)
    x[ATTITUDE], x[ATTITUDE + 1] = w * length, u * length
    x[ATTITUDE + 2], x[ATTITUDE + 3] = v * length, t * length


@jit_inline
def add_sums(sums: FloatArray, rot: Matrix, angle: Three, velocity: Three, span_s: float) -> None:
    """Add a part of a sample to the sums, with the attitude at its middle."""
    for i in range(3):
        m = plus(rot[i], 0.5, cross(rot[i], angle))  # row i of C (I + ½ [φ]×)
        for j in range(3):
            sums[SUM_TURN + 3 * i + j] += m[j] * span_s
            sums[SUM_RATE + 3 * i + j] += m[j] * angle[j]
            sums[SUM_FORCE + 3 * i + j] += m[j] * velocity[j]
        if len(sums) > SUMS_SIZE:
            for j, k, n in ((1, 2, 0), (2, 0, 1), (0, 1, 2)):
                sums[SUM_RATE_ACROSS + 3 * i + n] += m[j] * angle[k] + m[k] * angle[j]
                sums[SUM_FORCE_ACROSS + 3 * i + n] += m[j] * velocity[k] + m[k] * velocity[j]
    sums[SUM_TIME] += span_s
    put(sums, LAST_RATE, (angle[0] / span_s, angle[1] / span_s, angle[2] / span_s))
    put(sums, LAST_FORCE, (velocity[0] / span_s, velocity[1] / span_s, velocity[2] / span_s))


@jit_cached
def advance_part(x: FloatArray, sums: FloatArray, angle_b: Three, velocity_b: Three, span_s: float) -> None:
    """Navigate over a sample or a part of one.

    Args:
        x: (STATE_SIZE,) the state, changed.
        sums: (SUMS_SIZE,) or (SUMS_SIZE_ACROSS,) added to.
        angle_b, velocity_b: increments as measured, coning and sculling added.
        span_s: length.
    """
    angle = corrected(angle_b, three(x, GYRO_BIAS), three(x, GYRO_SCALE), three(x, GYRO_LEAN), span_s)
    velocity = corrected(velocity_b, three(x, ACCEL_BIAS), three(x, ACCEL_SCALE), three(x, ACCEL_LEAN), span_s)
    rot = rot_of(x[ATTITUDE], x[ATTITUDE + 1], x[ATTITUDE + 2], x[ATTITUDE + 3])
    add_sums(sums, rot, angle, velocity, span_s)
    earth = EARTH_RATE_RADPS * span_s
    p, v, q = times(rot, rotated_velocity(angle, velocity))
    p, v = p + 0.5 * earth * v, v - 0.5 * earth * p  # on average e has turned by half of it
    vx, vy, vz = x[VELOCITY], x[VELOCITY + 1], x[VELOCITY + 2]
    half = 0.5 * span_s
    g = gravity_of(x[POSITION] + half * vx, x[POSITION + 1] + half * vy, x[POSITION + 2] + half * vz)
    ax, ay, az = p + span_s * g[0], v + span_s * g[1], q + span_s * g[2]
    nx = vx + ax + 2.0 * earth * (vy + 0.5 * ay)
    ny = vy + ay - 2.0 * earth * (vx + 0.5 * ax)
    nz = vz + az
    x[POSITION] += half * (vx + nx)
    x[POSITION + 1] += half * (vy + ny)
    x[POSITION + 2] += half * (vz + nz)
    x[VELOCITY], x[VELOCITY + 1], x[VELOCITY + 2] = nx, ny, nz
    turn(x, angle, earth)


@jit_inline
def coning_and_sculling(before: FloatArray, angle: Three, velocity: Three, span_s: float) -> tuple[Three, Three]:
    """Return the second interval's increments with coning and sculling, for rate and force linear over two intervals.

    With h₁ and h₂ their lengths: h₂² / (6 h₁ (h₁ + h₂)) times the products of the increments, 1/12 of them where the
    lengths are equal (Savage 1998, Eq. 1-38 and 2-36).

    Args:
        before: (7,) increments of the interval before and its length; 0 if there is none.
        angle, velocity: increments.
        span_s: length.
    """
    ahead = before[6]
    if ahead <= 0.0:
        return angle, velocity
    share = span_s * span_s / (6.0 * ahead * (ahead + span_s))
    angle_1, velocity_1 = three(before, 0), three(before, 3)
    coned = plus(angle, share, cross(angle_1, angle))
    sculled = plus(velocity, share, cross(angle_1, velocity))
    return coned, plus(sculled, share, cross(velocity_1, angle))


@jit_inline
def keep_before(before: FloatArray, angle: Three, velocity: Three, span_s: float) -> None:
    """Store this interval as the one before."""
    put(before, 0, angle)
    put(before, 3, velocity)
    before[6] = span_s


@jit_cached
def _navigate(samples: Samples, begin_ns: int, x: FloatArray, states: FloatArray) -> None:
    before, sums, now_ns = np.zeros(7), np.zeros(SUMS_SIZE), begin_ns
    for i in range(len(samples.time_ns)):
        span_s = 1e-9 * (samples.time_ns[i] - now_ns)
        angle, velocity = row(samples.angle_b, i), row(samples.velocity_b, i)
        coned, sculled = coning_and_sculling(before, angle, velocity, span_s)
        advance_part(x, sums, coned, sculled, span_s)
        keep_before(before, angle, velocity, span_s)
        now_ns = samples.time_ns[i]
        copy_into(states[i], x)


def navigate(inertial: Inertial, state: FloatArray) -> FloatArray:
    """Navigate by inertial samples alone.

    Args:
        inertial: n samples; the first begins its interval before its time.
        state: (STATE_SIZE,) at that moment, sensors' errors included.

    Returns:
        (n, 10) position and velocity in e, q_e_from_b at the end of each sample.
    """
    states = np.empty((len(inertial), 10))
    if len(inertial):
        begin_ns = int(inertial.time_ns[0]) - round(1e9 * float(inertial.interval_s[0]))
        _navigate(samples_of(inertial), begin_ns, np.array(state, dtype=np.float64), states)
    return states
