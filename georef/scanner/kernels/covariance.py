"""Covariance of points: the effects of errors of trajectory, range, angle, time and calibration (FORMULAS 5.2, 6.2).

The parameters' covariance is L Lᵀ: each column of L is one independent error of all parameters at once, and turns,
shifts, lengthens and tilts the beam. The covariance of a point is the sum of the outer products of the effects of these
errors and of those of trajectory, range, angle and time. If the errors only turn, shift and lengthen, they are summed
once before the returns. Effects that turn with the body are summed in b.

These are steps over a block of returns (`swath.georef.scanner.kernels.block`) in `swath.georef.scanner.kernels.rays`.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple, TypeAlias

from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.compiled import jit_cached, jit_inline
from swath.georef.geodesy.earth import down_of, geodetic_of
from swath.georef.geodesy.vectors import cross, dot, plus, rot_at, transposed_times, vector_at
from swath.georef.scanner.kernels.block import (
    ACCELERATION,
    ACROSS,
    ANGLE_OFF,
    COVARIANCE,
    COVARIANCE_2,
    HEAD,
    MEASURED,
    MOVED,
    RATE,
    READING,
    RHO,
    ROT,
    ROT_2,
    ROT_3,
    SHARE,
    START,
    THETA,
    TILT,
    TURNING,
    VARIANCE,
    A,
    B,
    put,
    three,
)
from swath.georef.scanner.kernels.types import Matrix, Six, Three

# Columns of `Known.errors`: the effect of one independent error.
TURN, TURN_BY_ANGLE, SHIFT = 0, 3, 6  # rotation vectors of the beam in b, the second times θ; metres in b
LONGER, LONGER_BY_RANGE, TILTED, LATER, ATTITUDE_LATER = 9, 10, 11, 12, 13
ANGLE, ANGLE_BY_READING, ANGLE_BY_RATE, ANGLE_BY_ACCELERATION = 14, 15, 16, 17
COLUMNS = 18
ALONG_ONLY = (*range(TURN, TURN + 3), *range(SHIFT, SHIFT + 3), LONGER, LONGER_BY_RANGE)  # columns of `Known.gram`

# Of one interval of the trajectory: covariances of position in e and of attitude in b at its start, and their change
# until its end; velocity in e and rate in b
Interval: TypeAlias = tuple[Six, Six, Six, Six, Three, Three]
NOTHING = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


class Flown(NamedTuple):
    """Columns of `swath.georef.trajectory.trajectory.Trajectory`, and its motion between the epochs."""

    time_ns: Int64Array
    position_e: FloatArray
    q_e_from_b: FloatArray
    rotvec_b: FloatArray
    position_sigma_l: FloatArray
    attitude_sigma_rad: FloatArray


class Known(NamedTuple):
    """The calibration's covariance, and the scanner's own noise.

    Attributes:
        errors: (p, 18) independent errors of one sigma, columns as above.
        along_only: whether no error has more than turn, shift and length.
        gram: (8, 8) the covariance of these, which then stands for all errors; shifts are those of the body's origin.
        lever_arm_b: (3,).
        angle_offset_rad: of the parameters.
        range_sigma_m, angle_sigma_rad, elevation_sigma_rad, time_sigma_s: of one return; the third is 0 where returns
            have no elevation.
        divergence_rad: of the beam, full.
    """

    errors: FloatArray
    along_only: bool
    gram: FloatArray
    lever_arm_b: FloatArray
    angle_offset_rad: float
    range_sigma_m: float
    angle_sigma_rad: float
    elevation_sigma_rad: float
    time_sigma_s: float
    divergence_rad: float


class Doubt(NamedTuple):
    """Inputs and output of covariances.

    Attributes:
        flown, known: trajectory, and calibration and noise.
        incidence_rad: (n,) between beam and the surface's normal; (0,): the surface is unknown.
        covariance_e: (n, 6) xx xy xz yy yz zz, m².
    """

    flown: Flown
    known: Known
    incidence_rad: FloatArray
    covariance_e: FloatArray


@jit_inline
def with_outer(c: Six, factor: float, a: Three) -> Six:
    """Return C + factor · a aᵀ as xx, xy, xz, yy, yz, zz."""
    x, y, z = factor * a[0], factor * a[1], factor * a[2]
    return c[0] + x * a[0], c[1] + x * a[1], c[2] + x * a[2], c[3] + y * a[1], c[4] + y * a[2], c[5] + z * a[2]


@jit_inline
def sum_of(a: Six, factor: float, b: Six) -> Six:
    """Return a + factor · b."""
    return (
        a[0] + factor * b[0],
        a[1] + factor * b[1],
        a[2] + factor * b[2],
        a[3] + factor * b[3],
        a[4] + factor * b[4],
        a[5] + factor * b[5],
    )


@jit_inline
def with_transpose(a: Three, b: Three) -> Six:
    """Return a bᵀ + b aᵀ."""
    mixed = a[0] * b[1] + a[1] * b[0], a[0] * b[2] + a[2] * b[0], a[1] * b[2] + a[2] * b[1]
    return 2.0 * a[0] * b[0], mixed[0], mixed[1], 2.0 * a[1] * b[1], mixed[2], 2.0 * a[2] * b[2]


@jit_inline
def applied(c: Six, a: Three) -> Three:
    """Return C a."""
    return (
        c[0] * a[0] + c[1] * a[1] + c[2] * a[2],
        c[1] * a[0] + c[3] * a[1] + c[4] * a[2],
        c[2] * a[0] + c[4] * a[1] + c[5] * a[2],
    )


@jit_inline
def turned(c: Six, rows: Matrix) -> Six:
    """Return R C Rᵀ."""
    x, y, z = rows
    cx, cy, cz = applied(c, x), applied(c, y), applied(c, z)
    return dot(x, cx), dot(x, cy), dot(x, cz), dot(y, cy), dot(y, cz), dot(z, cz)


@jit_inline
def of_turn(c: Six, arm: Three) -> Six:
    """Return the covariance of δψ × arm, with C that of the rotation vector δψ: −[arm]× C [arm]×, written out."""
    x, y, z = arm
    xx, xy, xz, yy, yz, zz = c
    return (
        z * (z * yy - 2.0 * y * yz) + y * y * zz,
        z * (x * yz - z * xy) + y * (z * xz - x * zz),
        y * (z * xy - y * xz) + x * (y * yz - z * yy),
        z * (z * xx - 2.0 * x * xz) + x * x * zz,
        z * (x * xy - y * xx) + x * (y * xz - x * yz),
        y * (y * xx - 2.0 * x * xy) + x * x * yy,
    )


@jit_inline
def six(block: FloatArray, i: int) -> Six:
    """Return a return's covariance so far."""
    at = COVARIANCE
    return block[at, i], block[at + 1, i], block[at + 2, i], block[at + 3, i], block[at + 4, i], block[at + 5, i]


@jit_inline
def keep(block: FloatArray, i: int, c: Six) -> None:
    """Store a return's covariance so far."""
    put(block, COVARIANCE, i, (c[0], c[1], c[2]))
    put(block, COVARIANCE_2, i, (c[3], c[4], c[5]))


@jit_inline
def axes_at(block: FloatArray, i: int) -> Matrix:
    """Return the rows of rot_e_from_b."""
    return three(block, ROT, i), three(block, ROT_2, i), three(block, ROT_3, i)


@jit_inline
def put_axes(block: FloatArray, i: int, rows: Matrix) -> None:
    """Store the rows of rot_e_from_b."""
    put(block, ROT, i, rows[0])
    put(block, ROT_2, i, rows[1])
    put(block, ROT_3, i, rows[2])


@jit_inline
def take_axes(block: FloatArray, n: int, rot: Matrix, phi: Three) -> None:
    """Compute rot_e_from_b of returns from the attitude ``rot``, by rows A and B of `turn_factors` about φ."""
    once = cross(rot[0], phi), cross(rot[1], phi), cross(rot[2], phi)  # r · (φ × v) = (r × φ) · v
    twice = cross(once[0], phi), cross(once[1], phi), cross(once[2], phi)
    for i in range(n):
        a, b = block[A, i], block[B, i]
        x = plus(plus(rot[0], a, once[0]), b, twice[0])
        y = plus(plus(rot[1], a, once[1]), b, twice[1])
        put_axes(block, i, (x, y, plus(plus(rot[2], a, once[2]), b, twice[2])))


@jit_cached
def at_epoch(flown: Flown, k: int) -> tuple[Six, Six]:
    """Return covariances at an epoch: position in e, m², and attitude as a rotation vector in b, rad².

    Roll turns the body about its x, pitch about the horizontal y, heading about down.
    """
    x, y, z = vector_at(flown.position_e, k)
    lat, lon, _ = geodetic_of(x, y, z)
    sin_lat, sin_lon, cos_lon, down = math.sin(lat), math.sin(lon), math.cos(lon), down_of(lat, lon)
    north, east = (-sin_lat * cos_lon, -sin_lat * sin_lon, math.cos(lat)), (-sin_lon, cos_lon, 0.0)
    of_n, of_e, of_d = vector_at(flown.position_sigma_l, k)
    place = with_outer(with_outer(with_outer(NOTHING, of_n * of_n, north), of_e * of_e, east), of_d * of_d, down)
    rot = rot_at(flown.q_e_from_b, k)
    level = cross(down, (rot[0][0], rot[1][0], rot[2][0]))
    per_length2 = 1.0 / dot(level, level)
    of_r, of_p, of_h = vector_at(flown.attitude_sigma_rad, k)
    turn = with_outer(NOTHING, of_r * of_r, (1.0, 0.0, 0.0))
    turn = with_outer(turn, of_p * of_p * per_length2, transposed_times(rot, level))
    return place, with_outer(turn, of_h * of_h, transposed_times(rot, down))


@jit_cached
def interval_at(flown: Flown, at: int) -> Interval:
    """Return the `Interval` that begins with epoch ``at``."""
    place, turn = at_epoch(flown, at)
    next_place, next_turn = at_epoch(flown, at + 1)
    per_s = 1e9 / (flown.time_ns[at + 1] - flown.time_ns[at])
    way = plus(vector_at(flown.position_e, at + 1), -1.0, vector_at(flown.position_e, at))
    rotvec = vector_at(flown.rotvec_b, at)
    velocity = per_s * way[0], per_s * way[1], per_s * way[2]
    rate = per_s * rotvec[0], per_s * rotvec[1], per_s * rotvec[2]
    return place, sum_of(next_place, -1.0, place), turn, sum_of(next_turn, -1.0, turn), velocity, rate


@jit_inline
def doubt_range(block: FloatArray, n: int, known: Known, incidence_rad: Any) -> None:
    """Fill row VARIANCE; the footprint on an inclined surface adds to it (FORMULAS 6.2)."""
    own, quarter = known.range_sigma_m * known.range_sigma_m, 0.25 * known.divergence_rad
    for i in range(n):
        block[VARIANCE, i] = own
    if len(incidence_rad):
        for i in range(n):
            sigma = quarter * block[RHO, i] * math.tan(incidence_rad[i])
            block[VARIANCE, i] += sigma * sigma


@jit_inline
def add_along(block: FloatArray, n: int) -> None:
    """Add the effect of the range."""
    for i in range(n):
        keep(block, i, with_outer(six(block, i), block[VARIANCE, i], three(block, HEAD, i)))


@jit_inline
def begin(block: FloatArray, n: int, interval: Interval, more: Six, known: Known) -> None:
    """Set the effects of attitude, scan angle and time; ``more`` is added to the attitude's covariance."""
    _, _, turn, by_share, velocity, rate = interval
    angle_variance = known.angle_sigma_rad * known.angle_sigma_rad
    time_variance = known.time_sigma_s * known.time_sigma_s
    turn = sum_of(turn, 1.0, more)
    for i in range(n):
        arm = three(block, START, i)
        c = of_turn(sum_of(turn, block[SHARE, i], by_share), arm)
        keep(block, i, with_outer(c, angle_variance, three(block, ACROSS, i)))
    if known.elevation_sigma_rad > 0.0:
        elevation_variance = known.elevation_sigma_rad * known.elevation_sigma_rad
        for i in range(n):
            keep(block, i, with_outer(six(block, i), elevation_variance, three(block, TILT, i)))
    for i in range(n):
        turning, rows = cross(rate, three(block, START, i)), axes_at(block, i)
        moved = plus(plus(plus(turning, velocity[0], rows[0]), velocity[1], rows[1]), velocity[2], rows[2])
        put(block, TURNING, i, turning)
        put(block, MOVED, i, moved)
        keep(block, i, with_outer(six(block, i), time_variance, moved))


@jit_inline
def add_gram(block: FloatArray, n: int, g: FloatArray) -> None:
    """Add the effects of all errors that turn, shift and lengthen, except the turns alone; and the range's."""
    shift = g[3, 3], g[3, 4], g[3, 5], g[4, 4], g[4, 5], g[5, 5]
    by_x, by_y, by_z = (g[0, 3], g[1, 3], g[2, 3]), (g[0, 4], g[1, 4], g[2, 4]), (g[0, 5], g[1, 5], g[2, 5])
    turn_longer, turn_scaled = (g[0, 6], g[1, 6], g[2, 6]), (g[0, 7], g[1, 7], g[2, 7])
    shift_longer, shift_scaled = (g[3, 6], g[4, 6], g[5, 6]), (g[3, 7], g[4, 7], g[5, 7])
    longer, both, scaled = g[6, 6], g[6, 7], g[7, 7]
    for i in range(n):
        c, arm = sum_of(six(block, i), 1.0, shift), three(block, START, i)
        # columns of a matrix, to which its transpose is added
        x, y, z = cross(by_x, arm), cross(by_y, arm), cross(by_z, arm)
        mixed = 2.0 * x[0], x[1] + y[0], x[2] + z[0], 2.0 * y[1], y[2] + z[1], 2.0 * z[2]
        keep(block, i, sum_of(c, 1.0, mixed))
    for i in range(n):
        arm, along, far = three(block, START, i), three(block, HEAD, i), block[MEASURED, i]
        variance = block[VARIANCE, i] + longer + far * (2.0 * both + far * scaled)
        h = plus(cross(plus(turn_longer, far, turn_scaled), arm), 1.0, plus(shift_longer, far, shift_scaled))
        h = plus(h, 0.5 * variance, along)
        keep(block, i, sum_of(six(block, i), 1.0, with_transpose(h, along)))


@jit_inline
def add_error(block: FloatArray, n: int, e: Any, lever: Three) -> None:
    """Add the effect of one error."""
    turn, by_angle = (e[0], e[1], e[2]), (e[TURN_BY_ANGLE], e[TURN_BY_ANGLE + 1], e[TURN_BY_ANGLE + 2])
    shift, longer, by_range = (e[SHIFT], e[SHIFT + 1], e[SHIFT + 2]), e[LONGER], e[LONGER_BY_RANGE]
    tilted, later, attitude_later = e[TILTED], e[LATER], e[ATTITUDE_LATER]
    constant, by_reading, by_rate, by_acceleration = e[14], e[15], e[16], e[17]
    for i in range(n):
        angle = constant + by_reading * block[READING, i]
        block[ANGLE_OFF, i] = angle + by_rate * block[RATE, i] + by_acceleration * block[ACCELERATION, i]
    for i in range(n):
        beam = plus(three(block, START, i), -1.0, lever)
        effect = plus(shift, 1.0, cross(plus(turn, block[THETA, i], by_angle), beam))
        effect = plus(effect, longer + by_range * block[MEASURED, i], three(block, HEAD, i))
        effect = plus(effect, block[ANGLE_OFF, i], three(block, ACROSS, i))
        effect = plus(effect, tilted, three(block, TILT, i))
        effect = plus(effect, later, three(block, MOVED, i))
        effect = plus(effect, attitude_later, three(block, TURNING, i))
        keep(block, i, with_outer(six(block, i), 1.0, effect))


@jit_inline
def spread(block: FloatArray, n: int, interval: Interval, known: Known) -> None:
    """Fill rows COVARIANCE, in e, from the other rows: vectors, share of the interval, angle, measured range, variance.

    READING, RATE and ACCELERATION are used if errors are not ``along_only``.
    """
    g = known.gram
    if known.along_only:
        begin(block, n, interval, (g[0, 0], g[0, 1], g[0, 2], g[1, 1], g[1, 2], g[2, 2]), known)
        add_gram(block, n, g)
    else:
        lever = known.lever_arm_b[0], known.lever_arm_b[1], known.lever_arm_b[2]
        begin(block, n, interval, NOTHING, known)
        add_along(block, n)
        for p in range(len(known.errors)):
            add_error(block, n, known.errors[p], lever)
    place, by_share = interval[0], interval[1]
    for i in range(n):
        c = turned(six(block, i), axes_at(block, i))
        keep(block, i, sum_of(sum_of(c, 1.0, place), block[SHARE, i], by_share))


@jit_inline
def give_six(block: FloatArray, n: int, covariance_e: Any) -> None:
    """Copy the covariances to (n, 6)."""
    for i in range(n):
        c = six(block, i)
        covariance_e[i, 0], covariance_e[i, 1], covariance_e[i, 2] = c[0], c[1], c[2]
        covariance_e[i, 3], covariance_e[i, 4], covariance_e[i, 5] = c[3], c[4], c[5]
