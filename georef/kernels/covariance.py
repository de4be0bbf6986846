"""Covariance of points, one pass over what the sensor model left of each return (FORMULAS 5.2, 6.2).

The parameters' covariance is L Lᵀ: each column of L is one independent error of all parameters at once, and turns,
shifts, lengthens and tilts the beam. The covariance of a point is the sum of the outer products of what these errors
do to it, and of what trajectory, range, angle and time do. Where the errors only turn, shift and lengthen, their sum is
taken before the returns. What turns with the body is summed in b.

Returns go through in blocks, none of them longer than an interval of the trajectory, step by step: see
`georef.kernels.block`.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from georef.compiled import kept, kernel, whole
from georef.kernels.block import BLOCK, put, three
from georef.kernels.rotations import cross, dot, plus
from georef.kernels.types import FloatArray, Six, Three
from georef.records import Int64Array

# Columns of `Known.errors`: what one independent error does.
TURN, TURN_BY_ANGLE, SHIFT = 0, 3, 6  # rotation vectors of the beam in b, the second times θ; metres in b
LONGER, LONGER_BY_RANGE, TILTED, LATER, ATTITUDE_LATER = 9, 10, 11, 12, 13
ANGLE, ANGLE_BY_READING, ANGLE_BY_RATE, ANGLE_BY_ACCELERATION = 14, 15, 16, 17
COLUMNS = 18
ALONG_ONLY = (*range(TURN, TURN + 3), *range(SHIFT, SHIFT + 3), LONGER, LONGER_BY_RANGE)  # columns of `Known.gram`

# Rows of a block: rot_e_from_b; vectors in b; what a later attitude and a later pulse do, per second; numbers of the
# return; its covariance
ROT, ROT_2, ROT_3, ARM, ALONG, ACROSS, TILT, TURNING, MOVED = (whole(row) for row in range(0, 27, 3))
SHARE, VARIANCE, MEASURED, THETA, ANGLE_OFF, COVARIANCE, COVARIANCE_2 = (whole(27 + k) for k in (0, 1, 2, 3, 4, 5, 8))
ROWS, FIRST = 38, whole(0)


class Seen(NamedTuple):
    """Of each return, (n,), (3, n), (4, n): `georef.points.Rays`; incidence_rad (0,): the surface is not known."""

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
        gram: (8, 8) the covariance of these, which do for all errors then.
        lever_arm_b: (3,).
        angle_offset_rad: of the parameters.
        range_sigma_m, angle_sigma_rad, time_sigma_s: of one return.
        divergence_rad: of the beam, full.
    """

    errors: FloatArray
    along_only: bool
    gram: FloatArray
    lever_arm_b: FloatArray
    angle_offset_rad: float
    range_sigma_m: float
    angle_sigma_rad: float
    time_sigma_s: float
    divergence_rad: float


@kernel
def with_outer(c: Six, factor: float, a: Three) -> Six:
    """C + factor · a aᵀ; xx, xy, xz, yy, yz, zz."""
    x, y, z = factor * a[0], factor * a[1], factor * a[2]
    return c[0] + x * a[0], c[1] + x * a[1], c[2] + x * a[2], c[3] + y * a[1], c[4] + y * a[2], c[5] + z * a[2]


@kernel
def sum_of(a: Six, b: Six) -> Six:
    """a + b."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2], a[3] + b[3], a[4] + b[4], a[5] + b[5]


@kernel
def with_transpose(a: Three, b: Three) -> Six:
    """a bᵀ + b aᵀ."""
    mixed = a[0] * b[1] + a[1] * b[0], a[0] * b[2] + a[2] * b[0], a[1] * b[2] + a[2] * b[1]
    return 2.0 * a[0] * b[0], mixed[0], mixed[1], 2.0 * a[1] * b[1], mixed[2], 2.0 * a[2] * b[2]


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


@kernel
def six_at(array: FloatArray, k: int) -> Six:
    """Row k of (n, 6)."""
    return array[k, 0], array[k, 1], array[k, 2], array[k, 3], array[k, 4], array[k, 5]


@kernel
def six(block: FloatArray, i: int) -> Six:
    """The covariance so far."""
    at = COVARIANCE
    return block[at, i], block[at + 1, i], block[at + 2, i], block[at + 3, i], block[at + 4, i], block[at + 5, i]


@kernel
def keep(block: FloatArray, i: int, c: Six) -> None:
    """The covariance so far."""
    put(block, COVARIANCE, i, (c[0], c[1], c[2]))
    put(block, COVARIANCE_2, i, (c[3], c[4], c[5]))


@kernel
def axes_at(block: FloatArray, i: int) -> tuple[Three, Three, Three]:
    """Rows of rot_e_from_b."""
    return three(block, ROT, i), three(block, ROT_2, i), three(block, ROT_3, i)


@kernel
def take_vector(block: FloatArray, at: int, n: int, column: Any) -> None:
    """Three rows from those of (3, n)."""
    for axis in range(3):
        for i in range(n):
            block[at + axis, i] = column[axis, i]


@kernel
def take_number(block: FloatArray, at: int, n: int, column: Any) -> None:
    """One row."""
    for i in range(n):
        block[at, i] = column[i]


@kernel
def take(block: FloatArray, n: int, here: Any, seen: Seen, known: Known) -> None:
    """Fill a block."""
    q = seen.q_e_from_b[:, here]
    for i in range(n):
        rows = axes_of(q[0, i], q[1, i], q[2, i], q[3, i])
        put(block, ROT, i, rows[0])
        put(block, ROT_2, i, rows[1])
        put(block, ROT_3, i, rows[2])
    take_vector(block, ARM, n, seen.arm_b[:, here])
    take_vector(block, ALONG, n, seen.range_axis_b[:, here])
    take_vector(block, ACROSS, n, seen.angle_axis_b[:, here])
    take_number(block, SHARE, n, seen.share[here])
    take_number(block, MEASURED, n, seen.measured_m[here])
    own, quarter = known.range_sigma_m * known.range_sigma_m, 0.25 * known.divergence_rad
    for i in range(n):
        block[VARIANCE, i] = own
    if len(seen.incidence_rad):  # a footprint on a surface that leans (FORMULAS 6.2)
        incidence, ranges = seen.incidence_rad[here], seen.range_m[here]
        for i in range(n):
            smear = quarter * ranges[i] * math.tan(incidence[i])
            block[VARIANCE, i] += smear * smear
    if not known.along_only:
        take_vector(block, TILT, n, seen.tilt_axis_b[:, here])
        take_number(block, THETA, n, seen.angle_rad[here])


@kernel
def move(block: FloatArray, n: int, rate_b: Three, velocity_e: Three) -> None:
    """Rows TURNING and MOVED."""
    for i in range(n):
        turning = cross(rate_b, three(block, ARM, i))
        rows = axes_at(block, i)
        put(block, TURNING, i, turning)
        moved = plus(plus(turning, velocity_e[0], rows[0]), velocity_e[1], rows[1])
        put(block, MOVED, i, plus(moved, velocity_e[2], rows[2]))


@kernel
def begin(block: FloatArray, n: int, here: Six, there: Six, angle_variance: float, time_variance: float) -> None:
    """What attitude, scan angle and time do."""
    for i in range(n):
        c = of_turn(between(here, there, block[SHARE, i]), three(block, ARM, i))
        c = with_outer(c, angle_variance, three(block, ACROSS, i))
        keep(block, i, with_outer(c, time_variance, three(block, MOVED, i)))


@kernel
def add_along(block: FloatArray, n: int) -> None:
    """What the range does."""
    for i in range(n):
        keep(block, i, with_outer(six(block, i), block[VARIANCE, i], three(block, ALONG, i)))


@kernel
def add_gram(block: FloatArray, n: int, g: FloatArray, lever: Three) -> None:
    """What all errors do that turn, shift and lengthen: 8 × 8 of their columns; and the range."""
    turn = g[0, 0], g[0, 1], g[0, 2], g[1, 1], g[1, 2], g[2, 2]
    shift = g[3, 3], g[3, 4], g[3, 5], g[4, 4], g[4, 5], g[5, 5]
    by_x, by_y, by_z = (g[0, 3], g[1, 3], g[2, 3]), (g[0, 4], g[1, 4], g[2, 4]), (g[0, 5], g[1, 5], g[2, 5])
    turn_longer, turn_scaled = (g[0, 6], g[1, 6], g[2, 6]), (g[0, 7], g[1, 7], g[2, 7])
    shift_longer, shift_scaled = (g[3, 6], g[4, 6], g[5, 6]), (g[3, 7], g[4, 7], g[5, 7])
    longer, both, scaled = g[6, 6], g[6, 7], g[7, 7]
    for i in range(n):
        c, own = six(block, i), of_turn(turn, plus(three(block, ARM, i), -1.0, lever))
        keep(block, i, sum_of(sum_of(c, own), shift))
    for i in range(n):
        c, beam = six(block, i), plus(three(block, ARM, i), -1.0, lever)
        x, y, z = cross(by_x, beam), cross(by_y, beam), cross(by_z, beam)  # columns; their transpose counts too
        keep(block, i, sum_of(c, (2.0 * x[0], x[1] + y[0], x[2] + z[0], 2.0 * y[1], y[2] + z[1], 2.0 * z[2])))
    for i in range(n):
        c, beam, along = six(block, i), plus(three(block, ARM, i), -1.0, lever), three(block, ALONG, i)
        far = block[MEASURED, i]
        variance = block[VARIANCE, i] + longer + far * (2.0 * both + far * scaled)
        h = plus(cross(plus(turn_longer, far, turn_scaled), beam), 1.0, plus(shift_longer, far, shift_scaled))
        h = plus(h, 0.5 * variance, along)
        keep(block, i, sum_of(c, with_transpose(h, along)))


@kernel
def add_error(block: FloatArray, n: int, e: Any, lever: Three) -> None:
    """What one error does; its part in the scan angle stands in row ANGLE_OFF."""
    turn, by_angle = (e[0], e[1], e[2]), (e[TURN_BY_ANGLE], e[TURN_BY_ANGLE + 1], e[TURN_BY_ANGLE + 2])
    shift, longer, by_range = (e[SHIFT], e[SHIFT + 1], e[SHIFT + 2]), e[LONGER], e[LONGER_BY_RANGE]
    tilted, later, attitude_later = e[TILTED], e[LATER], e[ATTITUDE_LATER]
    for i in range(n):
        beam = plus(three(block, ARM, i), -1.0, lever)
        effect = plus(shift, 1.0, cross(plus(turn, block[THETA, i], by_angle), beam))
        effect = plus(effect, longer + by_range * block[MEASURED, i], three(block, ALONG, i))
        effect = plus(effect, block[ANGLE_OFF, i], three(block, ACROSS, i))
        effect = plus(effect, tilted, three(block, TILT, i))
        effect = plus(effect, later, three(block, MOVED, i))
        effect = plus(effect, attitude_later, three(block, TURNING, i))
        keep(block, i, with_outer(six(block, i), 1.0, effect))


@kernel
def add_errors(block: FloatArray, n: int, here: Any, seen: Seen, known: Known, lever: Three) -> None:
    """What the errors do one by one."""
    readings, rates, accelerations = seen.encoder_rad[here], seen.encoder_rate[here], seen.encoder_acceleration[here]
    offset = known.angle_offset_rad
    for p in range(len(known.errors)):
        e = known.errors[p]
        constant, by_reading, by_rate, by_acceleration = e[14], e[15], e[16], e[17]
        for i in range(n):
            angle = constant + by_reading * (readings[i] - offset)
            block[ANGLE_OFF, i] = angle + by_rate * rates[i] + by_acceleration * accelerations[i]
        add_error(block, n, e, lever)


@kernel
def give(block: FloatArray, n: int, here: Six, there: Six, covariance_e: Any) -> None:
    """Turn what stands in b to e, and add the position's."""
    for i in range(n):
        place = between(here, there, block[SHARE, i])
        keep(block, i, sum_of(turned(six(block, i), axes_at(block, i)), place))
    for i in range(n):
        c = six(block, i)
        covariance_e[i, 0], covariance_e[i, 1], covariance_e[i, 2] = c[0], c[1], c[2]
        covariance_e[i, 3], covariance_e[i, 4], covariance_e[i, 5] = c[3], c[4], c[5]


@kept
def covariances(seen: Seen, flown: Flown, known: Known, covariance_e: FloatArray) -> None:
    """Fill covariance_e (n, 6) xx xy xz yy yz zz, m²."""
    lever = known.lever_arm_b[0], known.lever_arm_b[1], known.lever_arm_b[2]
    angle_variance, time_variance = known.angle_sigma_rad**2, known.time_sigma_s**2
    epochs, velocities, rates = seen.epoch, flown.velocity_e, flown.rate_b
    block = np.zeros((ROWS, BLOCK))
    k = FIRST
    while k < len(epochs):
        last, n = min(len(epochs), k + BLOCK), 1
        while k + n < last and epochs[k + n] == epochs[k]:
            n += 1
        here, at = slice(k, k + n), epochs[k] - flown.first
        take(block, n, here, seen, known)
        rate = rates[at, 0], rates[at, 1], rates[at, 2]
        move(block, n, rate, (velocities[at, 0], velocities[at, 1], velocities[at, 2]))
        begin(block, n, six_at(flown.turn_b, at), six_at(flown.turn_b, at + 1), angle_variance, time_variance)
        if known.along_only:
            add_gram(block, n, known.gram, lever)
        else:
            add_along(block, n)
            add_errors(block, n, here, seen, known, lever)
        give(block, n, six_at(flown.position_e, at), six_at(flown.position_e, at + 1), covariance_e[here])
        k += n
