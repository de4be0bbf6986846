"""Compute the covariance of alignment's residuals, between GNSS's velocities and positions and sensor integrals.

White noise of the sensors is integrated into random walks that neighbouring residuals share; an accelerometer's error
also wanders, under vibration and road, by a share of its bias. Headings are few enough to be taken as white.
"""

from __future__ import annotations

import math

import numpy as np

from swath.georef.arrays import FloatArray, StructArray
from swath.georef.navigation.alignment.blocks import FeltAt
from swath.georef.navigation.inputs import Setup

G_MPS2 = 9.80665
STILL_MPS = 0.003  # residual motion of a vehicle that stands still
HEADING_STEP_NS = 5_000_000_000  # interval between headings whose errors last: those in between add little information
# share of its bias by which an accelerometer's error changes in motion, and its time constant
WANDER, WANDER_S = 0.25, 5.0


def covariances(
    speed: FeltAt, place: FeltAt, speed_rows: StructArray, place_rows: StructArray, setup: Setup
) -> list[tuple[FloatArray, FloatArray]]:
    """Return residual covariances (m, m) by axis north, east, down, velocities then positions.

    Each pair is the total and the inertial unit's share.
    """
    still = len(speed.before_s) - len(speed_rows)
    floor = np.array([1.0, 1.0, 1.5])
    scale = np.array([setup.gnss_sigma_scale.get(int(fix), 1.0) for fix in place_rows["fix_type"]])
    of_place = np.maximum(place_rows["sigma"] * scale[:, None], setup.position_floor_m * floor)
    of_speed = np.maximum(speed_rows["sigma"], setup.velocity_floor_mps * floor)
    of_speed = np.concatenate([of_speed, np.full((still, 3), STILL_MPS)])
    by_tilt, by_push = _walks(speed.before_s, place.before_s)
    apart_s = np.abs(place.before_s[:, None] - place.before_s)
    share = setup.gnss_correlated_share
    common = share * np.exp(-apart_s / setup.gnss_correlation_s)
    n = len(of_speed)
    wander = WANDER * setup.noise.accel_bias
    push = setup.noise.velocity_random_walk**2 + 2.0 * wander**2 * WANDER_S
    covariances = []
    for axis, sway in enumerate((G_MPS2, G_MPS2, 0.0)):
        own = (sway * setup.noise.angle_random_walk) ** 2 * by_tilt + push * by_push
        total = own.copy()
        total[n:, n:] += np.outer(of_place[:, axis], of_place[:, axis]) * common
        white = np.concatenate([of_speed[:, axis] ** 2, (1.0 - share) * of_place[:, axis] ** 2])
        total[np.diag_indices_from(total)] += np.maximum(white, 1e-10)
        covariances.append((total, own))
    return covariances


def _walks(speed_s: FloatArray, place_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return covariances of velocities and positions at times before T, of unit white noise of rates and of forces.

    Rate noise acts under 1 m/s². A disturbance at s before T has changed the velocity at t > s before T by (t − s)
    times the force for rate noise, by 1 for force noise; the position by one integral more, with the opposite sign.
    """
    age = np.concatenate([speed_s, place_s])
    order = np.concatenate([np.zeros(len(speed_s)), np.ones(len(place_s))])
    common = np.minimum(age[:, None], age)
    covariances = []
    for base in (1.0, 0.0):
        degree = order + base  # (t − s)^degree / degree!, (t − s) = x + rest, x from 0 to the common age
        total = np.zeros_like(common)
        coefficients = [_powers(age[:, None] - common, degree[:, None]), _powers(age - common, degree)]
        for i, left in enumerate(coefficients[0]):
            for j, right in enumerate(coefficients[1]):
                total += left * right * common ** (i + j + 1) / (i + j + 1)
        sign = 1.0 - 2.0 * (order[:, None] != order)
        covariances.append(sign * total)
    return covariances[0], covariances[1]


def _powers(rest: FloatArray, degree: FloatArray) -> list[FloatArray]:
    """Return coefficients of x⁰, x¹, x² in (x + rest)^degree / degree!, degree 0, 1 or 2."""
    cases = [degree == 0.0, degree == 1.0, degree == 2.0]
    zero, one = np.zeros_like(rest), np.ones_like(rest)
    return [
        np.select(cases, [one, rest, 0.5 * rest**2]),
        np.select(cases, [zero, one, rest]),
        np.select(cases, [zero, zero, 0.5 * one]),
    ]


def spaced_headings(rows: StructArray, setup: Setup) -> StructArray:
    """Thin headings, sorted by time, whose errors last, and set their sigmas to those of equivalent white errors."""
    if setup.gnss_heading_share <= 0.0 or not len(rows):
        return rows
    spaced = rows[np.unique(rows["time_ns"] // HEADING_STEP_NS, return_index=True)[1]]
    spaced["sigma"] *= white_factor(
        HEADING_STEP_NS, math.sqrt(setup.gnss_heading_share), setup.gnss_heading_correlation_s
    )
    return spaced


def white_factor(step_ns: int, share: float, tau_s: float) -> float:
    """Return the sigma factor for values a step apart, a share of whose error is a Gauss–Markov process of tau.

    With it the mean of many has its true variance, although their errors are treated as white.
    """
    stays = math.exp(-step_ns * 1e-9 / tau_s)
    return math.sqrt(1.0 - share**2 + share**2 * (1.0 + stays) / (1.0 - stays))
