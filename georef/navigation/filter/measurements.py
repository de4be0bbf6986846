"""Predict each kind of observation from the state, with the derivatives by the errors.

The innovation is observed − predicted, and H the derivative of the prediction by the errors, both in l for positions
and velocities (components north, east, down). With l the lever arm, C = rot_e_from_b, v and a the antenna's:

    position    r + C l + v τ + ½ a τ² + L √share c      τ the time offset, c the slow error, L Lᵀ its covariance
    velocity    v + C (ω_eb × l) + a τ + L √share c
    heading     direction of C · baseline in l, + σ √share c
    attitude    roll, pitch, heading of C in l
    zero        v = 0 ;  non-holonomic: y and z of Cᵀ v are 0 ;  height: of r, + the barometer's bias
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from swath.georef.arrays import ByteArray, FloatArray
from swath.georef.compiled import jit_cached, jit_inline
from swath.georef.geodesy.gravity import EARTH_RATE_RADPS, gravity_of, normal_of
from swath.georef.geodesy.vectors import cross, dot, plus, rot_of, times, transposed_times
from swath.georef.navigation.filter.error_model import (
    E_ATTITUDE,
    E_GYRO_BIAS,
    E_GYRO_LEAN,
    E_GYRO_SCALE,
    E_POSITION,
    E_VELOCITY,
    Layout,
)
from swath.georef.navigation.filter.kalman import factorise
from swath.georef.navigation.filter.level import attitude_rows, in_level, level_axes, wrapped
from swath.georef.navigation.filter.strapdown import (
    ATTITUDE,
    GYRO_LEAN,
    GYRO_SCALE,
    HEIGHT_BIAS,
    LAST_FORCE,
    LAST_RATE,
    LEVER_ARM,
    POSITION,
    SLOW,
    SLOW_HEADING,
    SLOW_VELOCITY,
    TIME_OFFSET,
    VELOCITY,
    copy_into,
    leaned,
    put,
    row,
    three,
)
from swath.georef.navigation.inputs import Kind, Setup
from swath.georef.records import FixType
from swath.georef.scanner.kernels.types import Matrix, Three

_POSITION, _VELOCITY, _HEADING, _ZERO = int(Kind.POSITION), int(Kind.VELOCITY), int(Kind.HEADING), 3
_NON_HOLONOMIC, _HEIGHT, _ATTITUDE = int(Kind.NON_HOLONOMIC), int(Kind.HEIGHT), int(Kind.ATTITUDE)
assert _ZERO == int(Kind.ZERO_VELOCITY)

FIX_TYPES = len(FixType)
POSITION_FLOORS_M = {
    FixType.RTK_FLOAT: 0.05,
    FixType.DIFFERENTIAL: 0.2,
    FixType.SINGLE: 0.5,
    FixType.DEAD_RECKONING: 2.0,
}


class Rules(NamedTuple):
    """The installation and the assumptions about observations.

    Attributes:
        arms_b, baseline_b: (k, 3) lever arms; (3,), nan: no baseline.
        share, velocity_share, heading_share: slow share of GNSS positions', velocities' and headings' variance.
        position_floor_m: (fix types,).
        position_scale, velocity_scale: (fix types, 2) of the horizontal and the vertical, floors included.
        heading_scale: the same of headings.
        velocity_floor_mps, attitude_floor_rad: the least sigmas.
        gate: (4,) χ² of the gate by number of components.
        reject: factor on it.
        angle_variance: of the gyroscopes' white noise, per second.
    """

    arms_b: FloatArray
    baseline_b: FloatArray
    share: float
    velocity_share: float
    heading_share: float
    position_floor_m: FloatArray
    position_scale: FloatArray
    velocity_scale: FloatArray
    heading_scale: float
    velocity_floor_mps: float
    attitude_floor_rad: float
    gate: FloatArray
    reject: float
    angle_variance: float


def rules_of(setup: Setup) -> Rules:
    """Return a setup's rules as compiled loops take them."""
    floors = [max(setup.position_floor_m, POSITION_FLOORS_M.get(fix, 0.0)) for fix in FixType]
    baseline = np.full(3, np.nan) if setup.baseline_b is None else np.array(setup.baseline_b, dtype=np.float64)
    gate = np.array([np.inf, *chdtri([1, 2, 3], setup.gate_probability)])
    return Rules(
        np.ascontiguousarray(setup.lever_arms_b, dtype=np.float64).reshape(-1, 3),
        baseline,
        float(setup.gnss_correlated_share),
        float(setup.gnss_velocity_share),
        float(setup.gnss_heading_share),
        np.array(floors),
        _scales_of(setup.gnss_sigma_scale, setup.gnss_vertical_scale),
        _scales_of(setup.gnss_velocity_scale, setup.gnss_velocity_vertical_scale),
        float(setup.gnss_heading_scale),
        float(setup.velocity_floor_mps),
        float(setup.attitude_floor_rad),
        gate,
        float(setup.reject_factor**2),
        float(setup.noise.angle_random_walk**2),
    )


def _scales_of(scale: Mapping[int, float], vertical: Mapping[int, float]) -> FloatArray:
    """Return factors (fix types, 2) of the horizontal and the vertical."""
    whole = np.array([float(scale.get(int(fix), 1.0)) for fix in FixType])
    return np.stack([whole, whole * [float(vertical.get(int(fix), 1.0)) for fix in FixType]], axis=1)


@jit_inline
def _acceleration(x: FloatArray, sums: FloatArray, rot: Matrix) -> tuple[Three, Three]:
    """Return the latest sample's specific force in e, and the body's resulting acceleration relative to e."""
    f = times(rot, three(sums, LAST_FORCE))
    g = gravity_of(x[POSITION], x[POSITION + 1], x[POSITION + 2])
    twice = 2.0 * EARTH_RATE_RADPS
    return f, (f[0] + g[0] + twice * x[VELOCITY + 1], f[1] + g[1] - twice * x[VELOCITY], f[2] + g[2])


@jit_inline
def _arm_of(x: FloatArray, rules: Rules, layout: Layout, antenna: int) -> Three:
    """Return the lever arm of an antenna, as estimated if the filter estimates it."""
    if antenna == 0 and layout.lever_arm >= 0:
        return three(x, LEVER_ARM)
    return row(rules.arms_b, antenna)


@jit_inline
def _swing_of(x: FloatArray, sums: FloatArray, rot: Matrix, arm: Three) -> tuple[Three, Three]:
    """Return the body's rate relative to e, in b, and the velocity that it gives the arm's end, in b."""
    earth = transposed_times(rot, (0.0, 0.0, EARTH_RATE_RADPS))
    rate = plus(three(sums, LAST_RATE), -1.0, earth)
    return rate, cross(rate, arm)


@jit_inline
def _set_noise(noise: FloatArray, sigma: Three, correlation: FloatArray, of: int) -> None:
    """Set the covariance from three sigmas and the correlations (of, of + 1, of + 2) of pairs 01, 02, 12."""
    for i in range(3):
        noise[i, i] = sigma[i] * sigma[i]
    for i, j, k in ((0, 1, 0), (0, 2, 1), (1, 2, 2)):
        share = correlation[of + k]
        if not abs(share) < 0.999:
            share = 0.0
        noise[i, j] = noise[j, i] = share * sigma[i] * sigma[j]


@jit_inline
def _position(
    x: FloatArray, sums: FloatArray, rules: Rules, layout: Layout, antenna: int, fix: int,
    figures: FloatArray, nu: FloatArray, rows: FloatArray, noise: FloatArray,
) -> None:  # fmt: skip
    """Predict an antenna's position."""
    axes = level_axes(x)
    rot = rot_of(x[ATTITUDE], x[ATTITUDE + 1], x[ATTITUDE + 2], x[ATTITUDE + 3])
    arm = _arm_of(x, rules, layout, antenna)
    arm_e = times(rot, arm)
    rate, swing = _swing_of(x, sums, rot, arm)
    swing_e = times(rot, swing)
    moving = plus(three(x, VELOCITY), 1.0, swing_e)
    force_e, acceleration = _acceleration(x, sums, rot)
    offset_s = x[TIME_OFFSET]
    predicted = plus(three(x, POSITION), 1.0, arm_e)
    predicted = plus(predicted, offset_s, moving)
    predicted = plus(predicted, 0.5 * offset_s * offset_s, acceleration)
    turned = plus(plus(arm_e, offset_s, swing_e), 0.5 * offset_s * offset_s, force_e)
    put(nu, 0, in_level(axes, plus(three(figures, 0), -1.0, predicted)))
    scale, floor = rules.position_scale[fix], rules.position_floor_m[fix]
    sigma = (
        scale[0] * max(figures[3], floor),
        scale[0] * max(figures[4], floor),
        scale[1] * max(figures[5], floor),
    )
    _set_noise(noise, sigma, figures, 6)
    for i in range(3):
        a = axes[i]
        put(rows[i], E_POSITION, a)
        put(rows[i], E_VELOCITY, (offset_s * a[0], offset_s * a[1], offset_s * a[2]))
        put(rows[i], E_ATTITUDE, cross(turned, a))
        if layout.lever_arm >= 0 and antenna == 0:
            in_b = transposed_times(rot, a)
            put(rows[i], layout.lever_arm, plus(in_b, offset_s, cross(in_b, rate)))
        if layout.time_offset >= 0:
            rows[i, layout.time_offset] = dot(a, plus(moving, offset_s, acceleration))
    if layout.slow >= 0:
        _add_slow(three(x, SLOW), rules.share, layout.slow, nu, rows, noise)


@jit_inline
def _add_slow(slow: Three, share: float, at: int, nu: FloatArray, rows: FloatArray, noise: FloatArray) -> None:
    """Add the time-correlated share of a position's or velocity's error, which begins at ``at`` among the errors."""
    factor = noise.copy()
    if not factorise(factor, 3):
        return
    root = math.sqrt(share)
    for i in range(3):
        for j in range(i + 1):
            rows[i, at + j] = root * factor[i, j]
            nu[i] -= root * factor[i, j] * slow[j]
        for j in range(3):
            noise[i, j] *= 1.0 - share


@jit_inline
def _velocity(
    x: FloatArray, sums: FloatArray, rules: Rules, layout: Layout, antenna: int, fix: int,
    figures: FloatArray, nu: FloatArray, rows: FloatArray, noise: FloatArray,
) -> None:  # fmt: skip
    """Predict an antenna's velocity."""
    axes = level_axes(x)
    rot = rot_of(x[ATTITUDE], x[ATTITUDE + 1], x[ATTITUDE + 2], x[ATTITUDE + 3])
    arm = _arm_of(x, rules, layout, antenna)
    rate, swing = _swing_of(x, sums, rot, arm)
    swing_e = times(rot, swing)
    force_e, acceleration = _acceleration(x, sums, rot)
    predicted = plus(plus(three(x, VELOCITY), 1.0, swing_e), x[TIME_OFFSET], acceleration)
    turned = plus(swing_e, x[TIME_OFFSET], force_e)
    put(nu, 0, plus(three(figures, 0), -1.0, in_level(axes, predicted)))
    floor = rules.velocity_floor_mps
    scale = rules.velocity_scale[min(fix, len(rules.velocity_scale) - 1)]
    sigma = (
        scale[0] * max(figures[3], floor),
        scale[0] * max(figures[4], floor),
        scale[1] * max(figures[5], floor),
    )
    _set_noise(noise, sigma, figures, 6)
    for i in range(3):
        a = axes[i]
        put(rows[i], E_VELOCITY, a)
        put(rows[i], E_ATTITUDE, cross(turned, a))
        in_b = transposed_times(rot, a)
        lever = cross(in_b, arm)
        felt = leaned(lever, three(x, GYRO_LEAN))
        for j in range(3):
            of_bias = felt[j] / (1.0 + x[GYRO_SCALE + j])
            rows[i, E_GYRO_BIAS + j] = of_bias
            rows[i, E_GYRO_SCALE + j] = of_bias * sums[LAST_RATE + j]
        if layout.lean >= 0:
            for j, k, n in ((1, 2, 0), (2, 0, 1), (0, 1, 2)):
                rows[i, E_GYRO_LEAN + n] = lever[j] * sums[LAST_RATE + k] + lever[k] * sums[LAST_RATE + j]
        if layout.lever_arm >= 0 and antenna == 0:
            put(rows[i], layout.lever_arm, cross(in_b, rate))
        if layout.time_offset >= 0:
            rows[i, layout.time_offset] = dot(a, acceleration)
    if layout.slow_velocity >= 0:
        _add_slow(three(x, SLOW_VELOCITY), rules.velocity_share, layout.slow_velocity, nu, rows, noise)


@jit_inline
def _heading(
    x: FloatArray,
    rules: Rules,
    layout: Layout,
    figures: FloatArray,
    nu: FloatArray,
    rows: FloatArray,
    noise: FloatArray,
) -> None:
    """Predict the direction of the baseline: heading and pitch."""
    axes = level_axes(x)
    rot = rot_of(x[ATTITUDE], x[ATTITUDE + 1], x[ATTITUDE + 2], x[ATTITUDE + 3])
    line_e = times(rot, three(rules.baseline_b, 0))
    n, e, d = in_level(axes, line_e)
    flat2 = n * n + e * e
    flat, whole2 = math.sqrt(flat2), n * n + e * e + d * d
    zero = (0.0, 0.0, 0.0)
    # ∂ heading, ∂ pitch by the baseline in e; by ψ it is then ψ · (line × that)
    by_heading = plus(plus(zero, -e / flat2, axes.north), n / flat2, axes.east)
    by_pitch = plus(plus(zero, d * n / (flat * whole2), axes.north), d * e / (flat * whole2), axes.east)
    by_pitch = plus(by_pitch, -flat / whole2, axes.down)
    put(rows[0], E_ATTITUDE, cross(line_e, by_heading))
    put(rows[1], E_ATTITUDE, cross(line_e, by_pitch))
    nu[0] = wrapped(figures[0] - math.atan2(e, n))
    nu[1] = figures[1] - math.atan2(-d, flat)
    nu[2] = np.nan
    floor, scale = rules.attitude_floor_rad, rules.heading_scale
    _set_noise(noise, (scale * max(figures[3], floor), scale * max(figures[4], floor), 1.0), figures, 6)
    if layout.slow_heading >= 0:
        for i in range(2):
            rows[i, layout.slow_heading + i] = math.sqrt(rules.heading_share * noise[i, i])
            nu[i] -= rows[i, layout.slow_heading + i] * x[SLOW_HEADING + i]
            for j in range(2):
                noise[i, j] *= 1.0 - rules.heading_share


@jit_inline
def _attitude(
    x: FloatArray, rules: Rules, figures: FloatArray, nu: FloatArray, rows: FloatArray, noise: FloatArray
) -> None:
    """Predict roll, pitch and heading."""
    rot = rot_of(x[ATTITUDE], x[ATTITUDE + 1], x[ATTITUDE + 2], x[ATTITUDE + 3])
    angles, by = attitude_rows(level_axes(x), rot)
    for i in range(3):
        nu[i] = wrapped(figures[i] - angles[i])
        put(rows[i], E_ATTITUDE, by[i])
    floor = rules.attitude_floor_rad
    _set_noise(noise, (max(figures[3], floor), max(figures[4], floor), max(figures[5], floor)), figures, 6)


@jit_inline
def _standing(x: FloatArray, figures: FloatArray, nu: FloatArray, rows: FloatArray, noise: FloatArray) -> None:
    """Predict the velocity zero of a vehicle at rest."""
    axes = level_axes(x)
    still = in_level(axes, three(x, VELOCITY))
    for i in range(3):
        nu[i] = -still[i]
        put(rows[i], E_VELOCITY, axes[i])
    _set_noise(noise, three(figures, 3), figures, 6)


@jit_inline
def _rolling(x: FloatArray, figures: FloatArray, nu: FloatArray, rows: FloatArray, noise: FloatArray) -> None:
    """Predict zero velocity along y and z of b: δ(Cᵀ v) = Cᵀ (δv + v × ψ)."""
    rot = rot_of(x[ATTITUDE], x[ATTITUDE + 1], x[ATTITUDE + 2], x[ATTITUDE + 3])
    velocity = three(x, VELOCITY)
    nu[0] = np.nan
    for i in range(1, 3):
        axis = (rot[0][i], rot[1][i], rot[2][i])
        nu[i] = -dot(axis, velocity)
        put(rows[i], E_VELOCITY, axis)
        put(rows[i], E_ATTITUDE, cross(axis, velocity))
    _set_noise(noise, (1.0, figures[4], figures[5]), figures, 6)


@jit_inline
def _height(
    x: FloatArray, layout: Layout, figures: FloatArray, nu: FloatArray, rows: FloatArray, noise: FloatArray
) -> None:
    """Predict the ellipsoidal height of the body's origin, with a barometer's bias."""
    up, height_m = normal_of(x[POSITION], x[POSITION + 1], x[POSITION + 2])
    nu[0], nu[1], nu[2] = figures[0] - height_m - x[HEIGHT_BIAS], np.nan, np.nan
    put(rows[0], E_POSITION, up)
    if layout.height_bias >= 0:
        rows[0, layout.height_bias] = 1.0
    _set_noise(noise, (figures[3], 1.0, 1.0), figures, 6)


@jit_cached
def predict(
    x: FloatArray, sums: FloatArray, rules: Rules, layout: Layout, what: ByteArray, figures: FloatArray,
    nu: FloatArray, rows: FloatArray, noise: FloatArray,
) -> int:  # fmt: skip
    """Compute an innovation, its derivatives and the observation's covariance.

    Args:
        x, sums: (STATE_SIZE,); (SUMS_SIZE,), for the latest rate and force.
        what, figures: (4,) kind, fix type, satellites, antenna; (9,) value, sigma, correlation.
        nu, rows, noise: (3,), (3, n), (3, 3) are filled, usable components first.

    Returns:
        Number of components; 0: the observation cannot be used.
    """
    kind, fix, antenna = int(what[0]), int(what[1]), int(what[3])
    nu[:], rows[:, :], noise[:, :] = np.nan, 0.0, 0.0
    if antenna >= len(rules.arms_b) and (kind == _POSITION or kind == _VELOCITY):
        return 0
    if kind == _POSITION and 0 < fix < len(rules.position_floor_m):
        _position(x, sums, rules, layout, antenna, fix, figures, nu, rows, noise)
    elif kind == _VELOCITY:
        _velocity(x, sums, rules, layout, antenna, fix, figures, nu, rows, noise)
    elif kind == _HEADING:
        _heading(x, rules, layout, figures, nu, rows, noise)
    elif kind == _ATTITUDE:
        _attitude(x, rules, figures, nu, rows, noise)
    elif kind == _ZERO:
        _standing(x, figures, nu, rows, noise)
    elif kind == _NON_HOLONOMIC:
        _rolling(x, figures, nu, rows, noise)
    elif kind == _HEIGHT:
        _height(x, layout, figures, nu, rows, noise)
    return said_first(figures, nu, rows, noise)


@jit_inline
def said_first(figures: FloatArray, nu: FloatArray, rows: FloatArray, noise: FloatArray) -> int:
    """Move components with a finite innovation and a sigma to the front; return their number."""
    m = 0
    for i in range(3):
        if math.isfinite(nu[i]) and math.isfinite(noise[i, i]) and noise[i, i] > 0.0 and figures[3 + i] > 0.0:
            if m < i:
                nu[m] = nu[i]
                copy_into(rows[m], rows[i])
                for j in range(3):
                    noise[m, j] = noise[i, j]
                for j in range(3):
                    noise[j, m] = noise[j, i]
            m += 1
    return m
