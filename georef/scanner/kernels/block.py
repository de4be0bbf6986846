"""A block of returns in `swath.georef.scanner.kernels.rays`: a table with a row for each quantity.

Each step goes over the block once, reads some rows and fills others. Steps without a branch are compiled for several
returns at once, and a block stays in the nearest cache.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from swath.georef.arrays import FloatArray
from swath.georef.compiled import jit_inline, whole
from swath.georef.geodesy.vectors import (
    LARGE_ANGLE,
    SMALL_ANGLE_2,
    plus,
    sin_cos,
    sine_cosine,
    sine_cosine_of_large,
    small_sine_cosine,
    small_turn_factors,
    times,
    turn_factors,
    turned_by,
)
from swath.georef.scanner.kernels.beam import (
    AIMED,
    LINE,
    NUTATING,
    SPINNING,
    line_beam,
    line_turn,
    mirror_angle,
    nutating_beam,
    nutating_turn,
    raised,
    risley_beam,
    risley_turn,
    spinning_angle,
    spinning_beam,
    spinning_turn,
)
from swath.georef.scanner.kernels.types import Eight, Matrix, Three

BLOCK = 64

# One row each: θ; ρ, its measured part and the rest; a return's position in its intervals of position and of attitude;
# factors of the turn since the interval began; sine and cosine of up to two angles of the beam, and of slope · θ
THETA, RHO, COUNTED, MORE, SHARE, TURN_SHARE, A, B, ANGLE = (whole(row) for row in range(9))
SIN, COS, SIN_2, COS_2, SLOPE_SIN, SLOPE_COS = (whole(row) for row in range(9, 15))
# Three rows each: direction and start of the beam in the head, and then in the axes that the boresight's ω and φ turn;
# ∂point/∂θ and ∂point/∂Δη or ∂point/∂elevation (the first two of them also hold origin and point in e)
HEAD, HEAD_START, ALONG, START, ACROSS, TILT = (whole(row) for row in range(15, 33, 3))
BEAM = whole(33)  # the row of the geometry's table, eight rows
# For covariances: rot_e_from_b, three rows of three; effect of a later attitude and of a later pulse, per second; the
# covariance xx xy xz, yy yz zz. One each: range as measured; variance of the range; encoder reading from its offset on,
# rate, acceleration, and the effect of an error in these on the scan angle
ROT, ROT_2, ROT_3, TURNING, MOVED, COVARIANCE, COVARIANCE_2 = (whole(row) for row in range(41, 62, 3))
MEASURED, VARIANCE, READING, RATE, ACCELERATION, ANGLE_OFF = (whole(row) for row in range(62, 68))
ROWS = 68


@jit_inline
def three(block: FloatArray, at: int, i: int) -> Three:
    """Return the values of three successive rows."""
    return block[at, i], block[at + 1, i], block[at + 2, i]


@jit_inline
def put(block: FloatArray, at: int, i: int, v: Three) -> None:
    """Set the values of three successive rows."""
    block[at, i], block[at + 1, i], block[at + 2, i] = v


@jit_inline
def clear(block: FloatArray, at: int) -> None:
    """Set three successive rows to zero."""
    for i in range(BLOCK):
        put(block, at, i, (0.0, 0.0, 0.0))


@jit_inline
def beam_at(block: FloatArray, i: int) -> Eight:
    """Return the geometry's row of a return."""
    return (
        block[BEAM, i],
        block[BEAM + 1, i],
        block[BEAM + 2, i],
        block[BEAM + 3, i],
        block[BEAM + 4, i],
        block[BEAM + 5, i],
        block[BEAM + 6, i],
        block[BEAM + 7, i],
    )


@jit_inline
def sines(block: FloatArray, n: int, sin: int, cos: int) -> None:
    """Compute sine and cosine of row ANGLE."""
    large = 0
    for i in range(n):
        large += not abs(block[ANGLE, i]) < LARGE_ANGLE
    for i in range(n):
        block[sin, i], block[cos, i] = sin_cos(block[ANGLE, i])
    if large:
        for i in range(n):
            block[sin, i], block[cos, i] = sine_cosine_of_large(block[ANGLE, i], block[sin, i], block[cos, i])


@jit_inline
def lift(block: FloatArray, elevation: Any) -> None:
    """Set the beams' elevations to those of the returns."""
    n = len(elevation)
    for i in range(n):
        block[ANGLE, i] = elevation[i]
    sines(block, n, SIN, COS)
    for i in range(n):
        block[BEAM, i], block[BEAM + 1, i] = block[SIN, i], block[COS, i]


@jit_inline
def aim(block: FloatArray, n: int, kind: int) -> None:
    """Compute the beam in the head from θ."""
    if kind == LINE:
        for i in range(n):
            block[ANGLE, i] = mirror_angle(block[THETA, i])
    elif kind in (SPINNING, AIMED):
        for i in range(n):
            block[ANGLE, i] = spinning_angle(beam_at(block, i), block[THETA, i])
    else:
        for i in range(n):
            block[ANGLE, i] = block[THETA, i]
    sines(block, n, SIN, COS)
    if kind == LINE:
        for i in range(n):
            put(block, HEAD, i, line_beam(beam_at(block, i), block[SIN, i], block[COS, i]))
    elif kind in (SPINNING, AIMED):
        for i in range(n):
            start, direction = spinning_beam(beam_at(block, i), block[SIN, i], block[COS, i])
            put(block, HEAD_START, i, start)
            put(block, HEAD, i, direction)
    elif kind == NUTATING:
        for i in range(n):
            put(block, HEAD, i, nutating_beam(beam_at(block, i), block[SIN, i], block[COS, i]))
    else:
        for i in range(n):
            block[ANGLE, i] = block[BEAM + 5, i] * block[THETA, i]
        sines(block, n, SIN_2, COS_2)
        for i in range(n):
            first, second = (block[SIN, i], block[COS, i]), (block[SIN_2, i], block[COS_2, i])
            put(block, HEAD, i, risley_beam(beam_at(block, i), first, second))


@jit_inline
def swing(block: FloatArray, n: int, kind: int) -> None:
    """Compute ∂point/∂θ and ∂point/∂Δη in the head, m/rad.

    Only line scanners have Δη; where returns have their own elevation, ∂point/∂elevation takes its place.
    """
    if kind == LINE:
        for i in range(n):
            rho = block[RHO, i]
            across, tilt = line_turn(beam_at(block, i), block[SIN, i], block[COS, i])
            put(block, ACROSS, i, (rho * across[0], rho * across[1], rho * across[2]))
            put(block, TILT, i, (rho * tilt[0], rho * tilt[1], rho * tilt[2]))
        return
    for i in range(n):
        rho = block[RHO, i]
        put(block, TILT, i, (0.0, 0.0, 0.0))
        if kind == AIMED:
            put(block, TILT, i, raised(beam_at(block, i), block[SIN, i], block[COS, i], rho))
        if kind in (SPINNING, AIMED):
            start, direction = three(block, HEAD_START, i), three(block, HEAD, i)
            put(block, ACROSS, i, spinning_turn(beam_at(block, i), start, direction, rho))
        else:
            if kind == NUTATING:
                across = nutating_turn(beam_at(block, i), block[SIN, i], block[COS, i])
            else:
                first, second = (block[SIN, i], block[COS, i]), (block[SIN_2, i], block[COS_2, i])
                across = risley_turn(beam_at(block, i), first, second)
            put(block, ACROSS, i, (rho * across[0], rho * across[1], rho * across[2]))


@jit_inline
def lean(block: FloatArray, n: int, slope: float) -> None:
    """Compute sine and cosine of slope · θ."""
    if slope == 0.0:
        for i in range(n):
            block[SLOPE_SIN, i], block[SLOPE_COS, i] = 0.0, 1.0
        return
    for i in range(n):
        block[ANGLE, i] = slope * block[THETA, i]
    sines(block, n, SLOPE_SIN, SLOPE_COS)


@jit_inline
def mount(block: FloatArray, i: int, source: int, target: int, inner: Matrix, shift: Three) -> None:
    """Turn a vector of the head by κ, gimbal and installation, and about slope · θ."""
    v = plus(shift, 1.0, times(inner, three(block, source, i)))
    put(block, target, i, turned_by(block[SLOPE_SIN, i], block[SLOPE_COS, i], v))


@jit_inline
def factors(block: FloatArray, n: int, phi2: float) -> None:
    """Compute a, b of `turn_factors` for the share of the interval that has passed."""
    if phi2 < SMALL_ANGLE_2:
        for i in range(n):
            share = block[TURN_SHARE, i]
            block[A, i], block[B, i] = small_turn_factors(phi2 * share * share, share)
    else:
        for i in range(n):
            share = block[TURN_SHARE, i]
            block[A, i], block[B, i] = turn_factors(phi2 * share * share, share)


@jit_inline
def half_turns(block: FloatArray, n: int, phi2: float) -> None:
    """Compute rows SIN and COS of half the turn since the interval began, the sine divided by the turn's length."""
    if phi2 < SMALL_ANGLE_2:
        for i in range(n):
            half = 0.5 * block[TURN_SHARE, i]
            block[SIN, i], block[COS, i] = small_sine_cosine(half * half * phi2, half)
    else:
        length = math.sqrt(phi2)
        for i in range(n):
            half = 0.5 * block[TURN_SHARE, i] * length
            sin, cos = sine_cosine(half * half, half)
            block[SIN, i], block[COS, i] = sin / length, cos


@jit_inline
def give(block: FloatArray, n: int, at: int, out: Any) -> None:
    """Copy three rows to (n, 3)."""
    for i in range(n):
        out[i, 0], out[i, 1], out[i, 2] = block[at, i], block[at + 1, i], block[at + 2, i]


@jit_inline
def hand_over(block: FloatArray, n: int, at: int, out: FloatArray, k: int) -> None:
    """Copy three rows to those of (3, …) from column k on."""
    for axis in range(3):
        row = out[axis, k : k + n]
        for i in range(n):
            row[i] = block[at + axis, i]


@jit_inline
def new_block() -> FloatArray:
    """Return room for a block; its size is a constant so that the compiler knows that rows do not overlap."""
    return np.zeros((ROWS, BLOCK))
