"""Compute the vectors between a point and its errors: vectors in b, for a block of georeferenced returns.

`swath.georef.scanner.kernels.rays` returns them, or makes covariances of them
(`swath.georef.scanner.kernels.covariance`).
"""

from __future__ import annotations

from typing import Any

from swath.georef.arrays import FloatArray
from swath.georef.compiled import jit_inline
from swath.georef.geodesy.vectors import (
    cross,
    dot,
    matrix_at,
    plus,
    rot_at,
    times,
    vector_at,
)
from swath.georef.scanner.kernels.beam import FIBRE_BY_CHANNEL, FIXED_ANGLE
from swath.georef.scanner.kernels.block import (
    ACCELERATION,
    ACROSS,
    ALONG,
    BEAM,
    COS,
    HEAD,
    MEASURED,
    RATE,
    READING,
    RHO,
    SHARE,
    SIN,
    START,
    TILT,
    clear,
    half_turns,
    hand_over,
    mount,
    put,
    swing,
    three,
)
from swath.georef.scanner.kernels.covariance import (
    Doubt,
    Interval,
    doubt_range,
    give_six,
    spread,
    take_axes,
)
from swath.georef.scanner.kernels.types import Axes, Mounted, Scanning, Three, Track

NOWHERE = (0.0, 0.0, 0.0)


@jit_inline
def through_mount(block: FloatArray, n: int, k: int, mounted: Mounted, source: int, target: int, moved: float) -> None:
    """Convert vectors of the head to the axes turned by ω and φ of the boresight.

    ``moved`` is 1 for positions, 0 for directions.
    """
    if len(mounted.inner) == 1:
        inner = matrix_at(mounted.inner, 0)
        shift = plus(NOWHERE, moved, vector_at(mounted.shift, 0))
        for i in range(n):
            mount(block, i, source, target, inner, shift)
    else:
        for i in range(n):
            shift = plus(NOWHERE, moved, vector_at(mounted.shift, k + i))
            mount(block, i, source, target, matrix_at(mounted.inner, k + i), shift)


@jit_inline
def attitudes(block: FloatArray, n: int, k: int, q_e_from_b: FloatArray, w: float, v: Three, r: Three) -> None:
    """Compute (w, v) ⊗ exp(share · r / 2), scalar first, from rows SIN and COS of `half_turns`."""
    here = slice(k, k + n)
    q_w, q_x, q_y, q_z = q_e_from_b[0, here], q_e_from_b[1, here], q_e_from_b[2, here], q_e_from_b[3, here]
    for i in range(n):
        sin, cos = block[SIN, i], block[COS, i]
        h = sin * r[0], sin * r[1], sin * r[2]
        crossed = cross(v, h)
        q_w[i] = w * cos - dot(v, h)
        q_x[i] = w * h[0] + v[0] * cos + crossed[0]
        q_y[i] = w * h[1] + v[1] * cos + crossed[1]
        q_z[i] = w * h[2] + v[2] * cos + crossed[2]


@jit_inline
def turn_axes(block: FloatArray, n: int, k: int, kind: int, mounted: Mounted, tilts: bool) -> None:
    """Compute rows in b: HEAD the beam, START the arm of the point, ACROSS ∂point/∂θ, TILT ∂point/∂Δη.

    The arm begins at the body's origin.
    """
    outer, lever, slope = matrix_at(mounted.outer, 0), vector_at(mounted.lever_arm_b, 0), mounted.slope
    by_phi = outer[0][1], outer[1][1], outer[2][1]
    swing(block, n, kind)
    through_mount(block, n, k, mounted, ACROSS, ACROSS, 0.0)
    if not mounted.shifted:
        clear(block, START)
    for i in range(n):
        along = times(outer, three(block, ALONG, i))
        put(block, HEAD, i, along)
        put(block, START, i, plus(times(outer, three(block, START, i)), block[RHO, i], along))
    for i in range(n):  # θ also turns φ, whose axis is Rx(ω) y
        by_slope = cross(by_phi, three(block, START, i))
        put(block, ACROSS, i, plus(times(outer, three(block, ACROSS, i)), slope, by_slope))
    for i in range(n):
        put(block, START, i, plus(lever, 1.0, three(block, START, i)))
    if tilts:
        through_mount(block, n, k, mounted, TILT, TILT, 0.0)
        for i in range(n):
            put(block, TILT, i, times(outer, three(block, TILT, i)))


@jit_inline
def fill_axes(block: FloatArray, n: int, k: int, track: Track, axes: Axes, turning: int, at: int, phi2: float) -> None:
    """Fill ``axes`` from row k on for the n returns of a block."""
    epochs, shares = axes.epoch[k : k + n], axes.share[k : k + n]
    for i in range(n):
        epochs[i], shares[i] = at, block[SHARE, i]
    hand_over(block, n, HEAD, axes.range_axis_b, k)
    hand_over(block, n, START, axes.arm_b, k)
    hand_over(block, n, ACROSS, axes.angle_axis_b, k)
    hand_over(block, n, TILT, axes.tilt_axis_b, k)
    half_turns(block, n, phi2)
    q = track.q_e_from_b
    v = q[turning, 1], q[turning, 2], q[turning, 3]
    attitudes(block, n, k, axes.q_e_from_b, q[turning, 0], v, vector_at(track.rotvec_b, turning))


@jit_inline
def take_readings(block: FloatArray, n: int, part: Any, scanning: Scanning, rate: Any, acceleration: Any) -> None:
    """Fill rows of encoder readings, as the errors of the encoder's parameters need them."""
    fixed = scanning.select >= FIBRE_BY_CHANNEL
    for i in range(n):
        reading = block[BEAM + FIXED_ANGLE, i] if fixed else part[i].encoder_rad
        block[READING, i] = reading - scanning.offset_rad
    if len(rate):
        for i in range(n):
            block[RATE, i], block[ACCELERATION, i] = rate[i], acceleration[i]


@jit_inline
def fill_covariance(
    block: FloatArray, n: int, k: int, part: Any, track: Track, turning: int, interval: Interval, doubt: Doubt
) -> None:
    """Fill covariances of the n returns of a block, whose axes and readings are computed, from row k on."""
    take_axes(block, n, rot_at(track.q_e_from_b, turning), vector_at(track.rotvec_b, turning))
    for i in range(n):
        block[MEASURED, i] = part[i].range_m
    doubt_range(block, n, doubt.known, doubt.incidence_rad[k : k + n])
    spread(block, n, interval, doubt.known)
    give_six(block, n, doubt.covariance_e[k : k + n])
