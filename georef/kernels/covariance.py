"""Covariance of points, one pass over what the sensor model left of each return (FORMULAS 5.2, 6.2).

The parameters' covariance is L Lᵀ: each column of L is one independent error of all parameters at once, and turns,
shifts, lengthens and tilts the beam. The covariance of a point is the sum of the outer products of what these errors
do to it, and of what trajectory, range, angle and time do. What turns with the body is summed in b.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from georef.compiled import kept, kernel
from georef.kernels.types import FloatArray, Six, Three
from georef.records import Int64Array

# Columns of `Known.errors`: what one independent error does.
TURN, TURN_BY_ANGLE, SHIFT = 0, 3, 6  # rotation vectors of the beam in b, the second times θ; metres in b
LONGER, LONGER_BY_RANGE, TILTED, LATER, ATTITUDE_LATER = 9, 10, 11, 12, 13
ANGLE, ANGLE_BY_READING, ANGLE_BY_RATE, ANGLE_BY_ACCELERATION = 14, 15, 16, 17
COLUMNS = 18


class Seen(NamedTuple):
    """Of each return, (n,) or (n, 3): `georef.points.Rays`; incidence_rad (0,): the surface is not known."""

    q_e_from_b: FloatArray
    epoch: Int64Array
    share: FloatArray
    arm_b: FloatArray
    range_axis_b: FloatArray
    angle_axis_b: FloatArray
    tilt_axis_b: FloatArray
    range_m: FloatArray
    angle_rad: FloatArray
    measured_m: FloatArray
    encoder_rad: FloatArray
    encoder_rate: FloatArray
    encoder_acceleration: FloatArray
    incidence_rad: FloatArray


class Flown(NamedTuple):
    """Of the trajectory from epoch ``first`` on.

    Attributes:
        first: number of the first epoch here.
        position_e: (m, 6) covariance xx xy xz yy yz zz, m².
        turn_b: (m, 6) covariance of the attitude as a rotation vector in b, rad².
        velocity_e, rate_b: (m, 3) of the interval that begins with the epoch, m/s, rad/s.
    """

    first: int
    position_e: FloatArray
    turn_b: FloatArray
    velocity_e: FloatArray
    rate_b: FloatArray


class Known(NamedTuple):
    """What the calibration says of itself, and the scanner's own noise.

    Attributes:
        errors: (p, 18) independent errors of one sigma, columns as above.
        along_only: whether no error has more than turn, shift and length.
        lever_arm_b: (3,).
        angle_offset_rad: of the parameters.
        range_sigma_m, angle_sigma_rad, time_sigma_s: of one return.
        divergence_rad: of the beam, full.
    """

    errors: FloatArray
    along_only: bool
    lever_arm_b: FloatArray
    angle_offset_rad: float
    range_sigma_m: float
    angle_sigma_rad: float
    time_sigma_s: float
    divergence_rad: float


@kernel
def cross(a: Three, b: Three) -> Three:
    """a × b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@kernel
def plus_scaled(a: Three, factor: float, b: Three) -> Three:
    """a + factor · b."""
    return a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2]


@kernel
def dot(a: Three, b: Three) -> float:
    """a · b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel
def with_outer(c: Six, factor: float, a: Three) -> Six:
    """C + factor · a aᵀ; xx, xy, xz, yy, yz, zz."""
    x, y, z = factor * a[0], factor * a[1], factor * a[2]
    return c[0] + x * a[0], c[1] + x * a[1], c[2] + x * a[2], c[3] + y * a[1], c[4] + y * a[2], c[5] + z * a[2]


@kernel
def applied(c: Six, a: Three) -> Three:
    """C a."""
    return (
        c[0] * a[0] + c[1] * a[1] + c[2] * a[2],
        c[1] * a[0] + c[3] * a[1] + c[4] * a[2],
        c[2] * a[0] + c[4] * a[1] + c[5] * a[2],
    )


@kernel
def turned(c: Six, rows: tuple[Three, Three, Three]) -> Six:
    """R C Rᵀ."""
    x, y, z = rows
    cx, cy, cz = applied(c, x), applied(c, y), applied(c, z)
    return dot(x, cx), dot(x, cy), dot(x, cz), dot(y, cy), dot(y, cz), dot(z, cz)


@kernel
def between(here: Six, there: Six, share: float) -> Six:
    """Linear between two covariances."""
    return (
        here[0] + share * (there[0] - here[0]),
        here[1] + share * (there[1] - here[1]),
        here[2] + share * (there[2] - here[2]),
        here[3] + share * (there[3] - here[3]),
        here[4] + share * (there[4] - here[4]),
        here[5] + share * (there[5] - here[5]),
    )


@kernel
def of_turn(c: Six, arm: Three) -> Six:
    """Of δψ × arm, where C is that of the rotation vector δψ."""
    x, y, z = arm
    return turned(c, ((0.0, z, -y), (-z, 0.0, x), (y, -x, 0.0)))


@kernel
def axes_of(w: float, x: float, y: float, z: float) -> tuple[Three, Three, Three]:
    """Rows of rot_e_from_b."""
    return (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )


@kept
def covariances(seen: Seen, flown: Flown, known: Known, covariance_e: FloatArray) -> None:
    """Fill covariance_e (n, 6) xx xy xz yy yz zz, m².

    Arrays are read here only: to hand one to a function costs more than the function does.
    """
    errors, lever = known.errors, (known.lever_arm_b[0], known.lever_arm_b[1], known.lever_arm_b[2])
    own_variance, quarter = known.range_sigma_m * known.range_sigma_m, 0.25 * known.divergence_rad
    angle_variance, time_variance = known.angle_sigma_rad**2, known.time_sigma_s**2
    q, arms, along_b, across_b, tilt_b = (
        seen.q_e_from_b,
        seen.arm_b,
        seen.range_axis_b,
        seen.angle_axis_b,
        seen.tilt_axis_b,
    )
    epochs, shares, incidence = seen.epoch, seen.share, seen.incidence_rad
    ranges, angles, measured, readings = seen.range_m, seen.angle_rad, seen.measured_m, seen.encoder_rad
    encoder_rates, accelerations = seen.encoder_rate, seen.encoder_acceleration
    velocities, rates, turns, places = flown.velocity_e, flown.rate_b, flown.turn_b, flown.position_e
    for k in range(len(ranges)):
        at, share, theta = epochs[k] - flown.first, shares[k], angles[k]
        on = at + 1
        arm = arms[k, 0], arms[k, 1], arms[k, 2]
        along = along_b[k, 0], along_b[k, 1], along_b[k, 2]
        across = across_b[k, 0], across_b[k, 1], across_b[k, 2]
        rows = axes_of(q[k, 0], q[k, 1], q[k, 2], q[k, 3])
        turning = cross((rates[at, 0], rates[at, 1], rates[at, 2]), arm)
        moved = plus_scaled(turning, velocities[at, 0], rows[0])
        moved = plus_scaled(plus_scaled(moved, velocities[at, 1], rows[1]), velocities[at, 2], rows[2])
        c = of_turn(
            between(
                (turns[at, 0], turns[at, 1], turns[at, 2], turns[at, 3], turns[at, 4], turns[at, 5]),
                (turns[on, 0], turns[on, 1], turns[on, 2], turns[on, 3], turns[on, 4], turns[on, 5]),
                share,
            ),
            arm,
        )
        variance = own_variance
        if len(incidence):  # a footprint on a surface that leans (FORMULAS 6.2)
            smear = quarter * ranges[k] * math.tan(incidence[k])
            variance += smear * smear
        c = with_outer(with_outer(c, variance, along), angle_variance, across)
        c = with_outer(c, time_variance, moved)
        beam = arm[0] - lever[0], arm[1] - lever[1], arm[2] - lever[2]
        for p in range(len(errors)):
            turn = errors[p, 0], errors[p, 1], errors[p, 2]
            longer = errors[p, LONGER] + errors[p, LONGER_BY_RANGE] * measured[k]
            if not known.along_only:
                by_angle = errors[p, TURN_BY_ANGLE], errors[p, TURN_BY_ANGLE + 1], errors[p, TURN_BY_ANGLE + 2]
                turn = plus_scaled(turn, theta, by_angle)
            effect = plus_scaled(cross(turn, beam), longer, along)
            effect = plus_scaled(effect, 1.0, (errors[p, SHIFT], errors[p, SHIFT + 1], errors[p, SHIFT + 2]))
            if not known.along_only:
                angle = errors[p, ANGLE] + errors[p, ANGLE_BY_READING] * (readings[k] - known.angle_offset_rad)
                angle += errors[p, ANGLE_BY_RATE] * encoder_rates[k]
                angle += errors[p, ANGLE_BY_ACCELERATION] * accelerations[k]
                effect = plus_scaled(effect, angle, across)
                effect = plus_scaled(effect, errors[p, TILTED], (tilt_b[k, 0], tilt_b[k, 1], tilt_b[k, 2]))
                effect = plus_scaled(effect, errors[p, LATER], moved)
                effect = plus_scaled(effect, errors[p, ATTITUDE_LATER], turning)
            c = with_outer(c, 1.0, effect)
        c = turned(c, rows)
        of_place = between(
            (places[at, 0], places[at, 1], places[at, 2], places[at, 3], places[at, 4], places[at, 5]),
            (places[on, 0], places[on, 1], places[on, 2], places[on, 3], places[on, 4], places[on, 5]),
            share,
        )
        for element in range(6):
            covariance_e[k, element] = c[element] + of_place[element]
