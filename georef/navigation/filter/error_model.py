"""Propagate the errors of the state: transition and process noise over a step, and the covariance.

Errors are true − computed: δr, δv in e, ψ with rot_e_from_b true = exp([ψ]×) computed, sensors' biases and scales, then
the optional errors of `Layout`; misalignments l of a triad, with M(l) as in `strapdown.corrected`, are sensors' errors
too. With C = rot_e_from_b, f and ω as corrected, Ω the earth's rate, Γ gravity's gradient (Groves 2013, 14.2.2, with
the signs of this package):

    d δr = δv
    d δv = ψ × C f + C δf − 2 Ω × δv + Γ δr          δf = −(δb_a + f δs_a) / (1 + s_a) − M(δl_a) f
    d ψ  = −Ω × ψ + C δω                             δω = −(δb_g + ω δs_g) / (1 + s_g) − M(δl_g) ω

The first 9 rows of a transition matrix are kept in full, (9, core), core 21 or with misalignments 27: no other errors
move these nine. The rows below are diagonal.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from swath.georef.arrays import FloatArray
from swath.georef.compiled import jit_cached, jit_inline
from swath.georef.geodesy.gravity import EARTH_RATE_RADPS, gradient_of
from swath.georef.geodesy.vectors import cross
from swath.georef.navigation.filter.strapdown import (
    ACCEL_SCALE,
    ATTITUDE,
    GYRO_BIAS,
    GYRO_LEAN,
    GYRO_SCALE,
    HEIGHT_BIAS,
    LEVER_ARM,
    POSITION,
    SLOW,
    SLOW_HEADING,
    SLOW_VELOCITY,
    SUM_FORCE,
    SUM_FORCE_ACROSS,
    SUM_RATE,
    SUM_RATE_ACROSS,
    SUM_TIME,
    SUM_TURN,
    SUMS_SIZE,
    SUMS_SIZE_ACROSS,
    TIME_OFFSET,
    three,
)
from swath.georef.navigation.inputs import Setup
from swath.georef.scanner.kernels.types import Three

E_POSITION, E_VELOCITY, E_ATTITUDE, E_SENSORS = 0, 3, 6, 9
E_GYRO_BIAS, E_ACCEL_BIAS, E_GYRO_SCALE, E_ACCEL_SCALE = 9, 12, 15, 18
MOVED, CORE = 9, 21  # rows of a transition that are not diagonal; its columns without misalignments
E_GYRO_LEAN, E_ACCEL_LEAN, LEANS = 21, 24, 6  # columns of the misalignments if they are estimated


class Layout(NamedTuple):
    """Columns of the optional errors; −1: not estimated.

    Attributes:
        size: number of error states.
        lean: 6, misalignments of gyroscopes and accelerometers.
        lever_arm: 3, of antenna 0, b.
        time_offset: 1, of GNSS.
        slow: 3, the time-correlated part of GNSS positions, in units of its sigma.
        slow_velocity: 3, the same of GNSS velocities.
        slow_heading: 2, the same of the heading and the pitch of a baseline.
        height_bias: 1, of a barometer.
    """

    size: int
    lean: int
    lever_arm: int
    time_offset: int
    slow: int
    slow_velocity: int
    slow_heading: int
    height_bias: int

    @property
    def core(self) -> int:
        """The number of columns in a transition's first rows."""
        return CORE if self.lean < 0 else CORE + LEANS

    @property
    def sums_size(self) -> int:
        """The number of sums over a step that the transition needs."""
        return SUMS_SIZE if self.lean < 0 else SUMS_SIZE_ACROSS


class Drive(NamedTuple):
    """The process noise of a setup.

    Attributes:
        angle, velocity: variance per second of the white noise of rates and forces.
        variance: (n,) of the Gauss–Markov errors, 0: constant.
        correlation_s: (n,) their e-folding times, inf: constant.
    """

    angle: float
    velocity: float
    variance: FloatArray
    correlation_s: FloatArray


def layout_of(setup: Setup, *, heights: bool = False) -> Layout:
    """Return the errors that a setup estimates; a barometer's bias if there are heights."""
    size, places = CORE, []
    for asked, count in (
        (setup.noise.misalignment > 0.0, LEANS),
        (setup.estimate_lever_arm > 0.0, 3),
        (setup.estimate_time_offset_s > 0.0, 1),
        (setup.gnss_correlated_share > 0.0, 3),
        (setup.gnss_velocity_share > 0.0, 3),
        (setup.gnss_heading_share > 0.0 and setup.baseline_b is not None, 2),
        (heights and setup.height_bias_m > 0.0, 1),
    ):
        places.append(size if asked else -1)
        size += count if asked else 0
    return Layout(size, *places)


def prior_variance(setup: Setup, layout: Layout) -> FloatArray:
    """Return variances (size,) at the start of all errors but position, velocity and attitude."""
    noise = setup.noise
    variance = np.zeros(layout.size)
    for first, sigma in (
        (E_GYRO_BIAS, noise.gyro_bias),
        (E_ACCEL_BIAS, noise.accel_bias),
        (E_GYRO_SCALE, noise.gyro_scale),
        (E_ACCEL_SCALE, noise.accel_scale),
    ):
        variance[first : first + 3] = sigma**2
    for first, count, sigma in (
        (layout.lean, LEANS, noise.misalignment),
        (layout.lever_arm, 3, setup.estimate_lever_arm),
        (layout.time_offset, 1, setup.estimate_time_offset_s),
        (layout.slow, 3, 1.0),
        (layout.slow_velocity, 3, 1.0),
        (layout.slow_heading, 2, 1.0),
        (layout.height_bias, 1, setup.height_bias_m),
    ):
        if first >= 0:
            variance[first : first + count] = sigma**2
    return variance


def drive_of(setup: Setup, layout: Layout) -> Drive:
    """Return the process noise of a setup."""
    correlation_s = np.full(layout.size, np.inf)
    correlation_s[E_GYRO_BIAS : E_ACCEL_BIAS + 3] = setup.noise.bias_correlation_s
    if layout.slow >= 0:
        correlation_s[layout.slow : layout.slow + 3] = setup.gnss_correlation_s
    if layout.slow_velocity >= 0:
        correlation_s[layout.slow_velocity : layout.slow_velocity + 3] = setup.gnss_velocity_correlation_s
    if layout.slow_heading >= 0:
        correlation_s[layout.slow_heading : layout.slow_heading + 2] = setup.gnss_heading_correlation_s
    if layout.height_bias >= 0:
        correlation_s[layout.height_bias] = setup.height_correlation_s
    variance = np.where(np.isfinite(correlation_s), prior_variance(setup, layout), 0.0)
    return Drive(setup.noise.angle_random_walk**2, setup.noise.velocity_random_walk**2, variance, correlation_s)


@jit_inline
def _put_skew(top: FloatArray, i: int, j: int, factor: float, v: Three) -> None:
    """Set block (i, j) ← factor [v]×."""
    top[i, j], top[i, j + 1], top[i, j + 2] = 0.0, -factor * v[2], factor * v[1]
    top[i + 1, j], top[i + 1, j + 1], top[i + 1, j + 2] = factor * v[2], 0.0, -factor * v[0]
    top[i + 2, j], top[i + 2, j + 1], top[i + 2, j + 2] = -factor * v[1], factor * v[0], 0.0


@jit_inline
def _put_sensor(top: FloatArray, row: int, at: int, sums: FloatArray, first: int, gain: Three) -> None:
    """Set three columns of one sensor error: its sum with the minus sign, divided by 1 + scale.

    For gyroscopes this includes the effect of their turn on velocity and position within the step.
    """
    span_s = sums[SUM_TIME]
    force = _force_of(sums)
    for j in range(3):
        scale = -1.0 / (1.0 + gain[j])
        column = scale * sums[first + j], scale * sums[first + 3 + j], scale * sums[first + 6 + j]
        pushed = cross(column, force)
        for i in range(3):
            top[row + i, at + j] = column[i]
            if row == E_ATTITUDE:
                top[E_VELOCITY + i, at + j] = 0.5 * pushed[i]
                top[E_POSITION + i, at + j] = span_s / 6.0 * pushed[i]
            else:
                top[E_POSITION + i, at + j] = 0.5 * span_s * column[i]


@jit_inline
def _force_of(sums: FloatArray) -> Three:
    """Return ∫ C f dt, the row sums of the force's sums."""
    return (
        sums[SUM_FORCE] + sums[SUM_FORCE + 1] + sums[SUM_FORCE + 2],
        sums[SUM_FORCE + 3] + sums[SUM_FORCE + 4] + sums[SUM_FORCE + 5],
        sums[SUM_FORCE + 6] + sums[SUM_FORCE + 7] + sums[SUM_FORCE + 8],
    )


@jit_cached
def transition(sums: FloatArray, x: FloatArray, top: FloatArray) -> None:
    """Compute the first nine rows of the transition matrix over a step, to second order in its length.

    Args:
        sums: (SUMS_SIZE,) of `strapdown.advance_part` over the step.
        x: (STATE_SIZE,) the state: position at the step's end, and the sensors' errors that were used.
        top: (9, core) is filled.
    """
    span_s = sums[SUM_TIME]
    gradient = gradient_of(x[POSITION], x[POSITION + 1], x[POSITION + 2])
    force = _force_of(sums)
    earth = EARTH_RATE_RADPS * span_s
    top[:, :] = 0.0
    _put_skew(top, E_POSITION, E_ATTITUDE, -0.5 * span_s, force)
    _put_skew(top, E_VELOCITY, E_ATTITUDE, -1.0, force)
    for i in range(3):
        for j in range(3):
            fall = gradient[i][j] * span_s
            top[i, j] = 0.5 * span_s * fall
            top[E_VELOCITY + i, j] = fall
            top[E_VELOCITY + i, E_VELOCITY + j] = 0.5 * span_s * fall
        top[i, i] += 1.0
        top[i, E_VELOCITY + i] = span_s
        top[E_VELOCITY + i, E_VELOCITY + i] += 1.0
        top[E_ATTITUDE + i, E_ATTITUDE + i] = 1.0
    for first, turned in ((E_VELOCITY, 2.0 * earth), (E_ATTITUDE, earth)):
        top[first, first + 1] += turned
        top[first + 1, first] -= turned
    top[E_POSITION, E_VELOCITY + 1] += earth * span_s
    top[E_POSITION + 1, E_VELOCITY] -= earth * span_s
    _put_sensor(top, E_ATTITUDE, E_GYRO_BIAS, sums, SUM_TURN, three(x, GYRO_SCALE))
    _put_sensor(top, E_ATTITUDE, E_GYRO_SCALE, sums, SUM_RATE, three(x, GYRO_SCALE))
    _put_sensor(top, E_VELOCITY, E_ACCEL_BIAS, sums, SUM_TURN, three(x, ACCEL_SCALE))
    _put_sensor(top, E_VELOCITY, E_ACCEL_SCALE, sums, SUM_FORCE, three(x, ACCEL_SCALE))
    if top.shape[1] > CORE:
        _put_sensor(top, E_ATTITUDE, E_GYRO_LEAN, sums, SUM_RATE_ACROSS, (0.0, 0.0, 0.0))
        _put_sensor(top, E_VELOCITY, E_ACCEL_LEAN, sums, SUM_FORCE_ACROSS, (0.0, 0.0, 0.0))


@jit_cached
def decays(drive: Drive, span_s: float, decay: FloatArray) -> None:
    """Compute (n,) e^(−t/τ) of every error; 1 where it is constant."""
    last_s, last = math.inf, 1.0
    for i in range(len(decay)):
        if drive.correlation_s[i] != last_s:
            last_s = drive.correlation_s[i]
            last = math.exp(-span_s / last_s)
        decay[i] = last


@jit_inline
def fade(x: FloatArray, decay: FloatArray, layout: Layout) -> None:
    """Reduce the estimates of lasting observation errors (STATE_SIZE,) towards zero, as their expectation decays.

    The unit's biases are left out: most of a bias was present at turn-on and stays, so that over minutes it hardly
    decays.
    """
    for first, count, column in (
        (layout.slow, 3, SLOW),
        (layout.slow_velocity, 3, SLOW_VELOCITY),
        (layout.slow_heading, 2, SLOW_HEADING),
        (layout.height_bias, 1, HEIGHT_BIAS),
    ):
        if first >= 0:
            for i in range(count):
                x[column + i] *= decay[first + i]


@jit_cached
def propagate(p: FloatArray, top: FloatArray, decay: FloatArray, work: FloatArray) -> None:
    """Propagate the covariance over a step: P ← Φ P Φᵀ.

    Args:
        p: (n, n) symmetric, stays so.
        top, decay: (9, core), (n,), Φ's rows and diagonal.
        work: (9, n).
    """
    n, core = len(p), top.shape[1]
    for i in range(MOVED):
        work[i, :] = 0.0
        for k in range(core):
            factor = top[i, k]
            if factor != 0.0:
                for j in range(n):
                    work[i, j] += factor * p[k, j]
    for i in range(MOVED):
        for j in range(i + 1):
            value = 0.0
            for k in range(core):
                value += work[i, k] * top[j, k]
            p[i, j] = p[j, i] = value
        for j in range(MOVED, n):
            p[i, j] = p[j, i] = work[i, j] * decay[j]
    for i in range(MOVED, n):
        for j in range(MOVED, n):
            p[i, j] *= decay[i] * decay[j]


@jit_cached
def add_noise(p: FloatArray, sums: FloatArray, drive: Drive, decay: FloatArray, bridged: FloatArray) -> None:
    """Add a step's noise, P ← P + Q: white noise of rates and forces, the drift of biases, made-up samples.

    Args:
        p: (n, n).
        sums: of the step.
        drive, decay: process noise, and decays over the step.
        bridged: (6, 3) covariances in e of attitude and velocity that made-up samples add; changed.
    """
    span_s = sums[SUM_TIME]
    force = _force_of(sums)
    turned, pushed = bridged[:3], bridged[3:]
    for i in range(3):
        turned[i, i] += drive.angle * span_s
        pushed[i, i] += drive.velocity * span_s
    for i in range(3):
        for j in range(3):
            p[i, j] += pushed[i, j] * span_s * span_s / 3.0
            p[i, E_VELOCITY + j] += 0.5 * pushed[i, j] * span_s
            p[E_VELOCITY + j, i] = p[i, E_VELOCITY + j]
            p[E_VELOCITY + i, E_VELOCITY + j] += pushed[i, j]
            p[E_ATTITUDE + i, E_ATTITUDE + j] += turned[i, j]
    # a turn changes the velocity by −[∫ C f]× of it: half of that in the covariance with the turn, a third in its own
    for j in range(3):
        tilted = cross((turned[0, j], turned[1, j], turned[2, j]), force)
        for i in range(3):
            p[E_VELOCITY + i, E_ATTITUDE + j] += 0.5 * tilted[i]
            p[E_ATTITUDE + j, E_VELOCITY + i] = p[E_VELOCITY + i, E_ATTITUDE + j]
            pushed[i, j] = tilted[i]
    for i in range(3):
        tilted = cross((pushed[i, 0], pushed[i, 1], pushed[i, 2]), force)
        for j in range(3):
            p[E_VELOCITY + i, E_VELOCITY + j] += tilted[j] / 3.0
    for i in range(MOVED, len(p)):
        p[i, i] += drive.variance[i] * (1.0 - decay[i] * decay[i])


@jit_cached
def accumulate(
    total: FloatArray, total_decay: FloatArray, top: FloatArray, decay: FloatArray, work: FloatArray
) -> None:
    """Accumulate transitions: Φ of all steps ← Φ of this step · Φ of the steps before.

    Args:
        total, total_decay: (9, core), (n,), changed.
        top, decay: of this step.
        work: (9, n).
    """
    core = top.shape[1]
    for i in range(MOVED):
        for j in range(core):
            work[i, j] = 0.0 if j < MOVED else top[i, j] * total_decay[j]
        for k in range(MOVED):
            factor = top[i, k]
            for j in range(core):
                work[i, j] += factor * total[k, j]
    for i in range(MOVED):
        for j in range(core):
            total[i, j] = work[i, j]
    for j in range(len(total_decay)):
        total_decay[j] *= decay[j]


@jit_cached
def begin_accumulation(total: FloatArray, total_decay: FloatArray) -> None:
    """Set the accumulated transition to the identity."""
    total[:, :] = 0.0
    for i in range(MOVED):
        total[i, i] = 1.0
    total_decay[:] = 1.0


@jit_inline
def turned_on_by(x: FloatArray, psi: Three) -> None:
    """Turn the attitude by an error: q ← exp(ψ / 2) ⊗ q, of unit length."""
    size2 = 0.25 * (psi[0] * psi[0] + psi[1] * psi[1] + psi[2] * psi[2])
    cos, half = 1.0, 0.5
    if size2 > 0.0:
        size = math.sqrt(size2)
        cos, half = math.cos(size), 0.5 * math.sin(size) / size
    i, j, k = half * psi[0], half * psi[1], half * psi[2]
    a, b, c, d = x[ATTITUDE], x[ATTITUDE + 1], x[ATTITUDE + 2], x[ATTITUDE + 3]
    w, u = cos * a - i * b - j * c - k * d, cos * b + i * a + j * d - k * c
    v, t = cos * c - i * d + j * a + k * b, cos * d + i * c - j * b + k * a
    length = 1.0 / math.sqrt(w * w + u * u + v * v + t * t)
    x[ATTITUDE], x[ATTITUDE + 1] = w * length, u * length
    x[ATTITUDE + 2], x[ATTITUDE + 3] = v * length, t * length


@jit_cached
def inject(x: FloatArray, error: FloatArray, layout: Layout) -> None:
    """Add an error (n,) to the state (STATE_SIZE,), attitude by its exponential."""
    for i in range(6):
        x[POSITION + i] += error[i]
    turned_on_by(x, three(error, E_ATTITUDE))
    for i in range(12):
        x[GYRO_BIAS + i] += error[E_SENSORS + i]
    for first, count, column in (
        (layout.lean, LEANS, GYRO_LEAN),
        (layout.lever_arm, 3, LEVER_ARM),
        (layout.time_offset, 1, TIME_OFFSET),
        (layout.slow, 3, SLOW),
        (layout.slow_velocity, 3, SLOW_VELOCITY),
        (layout.slow_heading, 2, SLOW_HEADING),
        (layout.height_bias, 1, HEIGHT_BIAS),
    ):
        if first >= 0:
            for i in range(count):
                x[column + i] += error[first + i]
