"""Estimate an angle from a profile pair: compare heights of two swaths' pieces at the same places.

A wrong angle moves every piece of a swath forward, to the right and down by FORMULAS 5.3; where the ground slopes, a
sideways movement changes the height above a place. So the difference of two swaths' heights over one place is linear in
the angle, with a lever that each piece has from its place and its slope:

    roll     −Y + H (g · right)        pitch     −H (g · forward)        heading     Y (g · forward)

with Y to the right of the track, H the height above ground, and g the slope of the ground. Errors of the trajectory,
constant over a profile, act alike and are unknowns with their own sigmas as priors; so the resulting sigma is
realistic.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from swath.calib.flight import Flight
from swath.calib.profiles.places import Track
from swath.calib.profiles.sections import Pieces
from swath.georef.arrays import BoolArray, FloatArray

STATES = 6  # per swath: north, east, down, roll, pitch, heading
TURNS = {"roll": 3, "pitch": 4, "heading": 5}  # index of the trajectory's error that acts like the angle's
ROBUST_ROUNDS = 12
HUBER, FAR = 1.5, 4.0  # sigmas: above the first a piece counts less, above the second hardly at all


@dataclass(frozen=True, eq=False)
class Fit:
    """An angle or range from one profile.

    Attributes:
        error: error that the placed points show, rad or m; the correction is its negative.
        sigma: its sigma, including trajectory errors.
        noise_sigma: its sigma from the points alone.
        by_trajectory: per swath (6,): change of it by one sigma of each of its `STATES`.
        used: (k,) mask of the pieces that counted.
        gain: (k,) change of ``error`` per unit of each piece's difference.
    """

    error: float
    sigma: float
    noise_sigma: float
    by_trajectory: Mapping[int, FloatArray]
    used: BoolArray
    gain: FloatArray


def trajectory_sigmas(flight: Flight, swath: int, unsaid: tuple[float, float]) -> FloatArray:
    """Return mean sigmas (6,) over a swath: north, east, down m, roll, pitch, heading rad.

    Where the trajectory has no sigmas, those of ``unsaid`` count, with that of heading doubled.
    """
    one = flight.swaths[swath]
    trajectory = flight.trajectories[one.trajectory_index]
    part = trajectory.between(int(one.time_ns[0]), int(one.time_ns[-1]))
    columns = np.concatenate([part.position_sigma_l, part.attitude_sigma_rad], axis=1)
    known = np.isfinite(columns)
    mean = np.where(known, columns, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    assumed = np.repeat(unsaid, 3) * [1.0, 1.0, 1.0, 1.0, 1.0, 2.0]
    sigmas: FloatArray = np.where(known.any(axis=0), mean, assumed)
    return sigmas


def levers(track: Track, places_t: FloatArray, height_m: FloatArray, slope_t: FloatArray) -> FloatArray:
    """Return the change (k, 6) of the height above a place per unit of each of `STATES`.

    Args:
        track: of the swath.
        places_t: (k, 2) of the pieces.
        height_m: (k,) of the pieces.
        slope_t: (k, 2) of the ground, east and north, m/m.
    """
    aside = track.aside(places_t)
    above = track.height_m - height_m
    to_right, forward = slope_t @ track.right, slope_t @ track.forward
    of_states = (
        -slope_t[:, 1],
        -slope_t[:, 0],
        np.full(len(aside), -1.0),
        -aside + above * to_right,
        -above * forward,
        aside * forward,
    )
    return np.stack(of_states, axis=1)


def comparable(first: Pieces, second: Pieces, rms_m: float, slope_apart: float) -> BoolArray:
    """Return a mask (k,) of the pieces in which both swaths show the same smooth plane."""
    with np.errstate(invalid="ignore"):
        good: BoolArray = np.maximum(first.rms_m, second.rms_m) <= rms_m
        good &= np.hypot(first.slope - second.slope, first.side_slope - second.side_slope) <= slope_apart
    return good


def solve(
    difference_m: FloatArray,
    sigma_m: FloatArray,
    lever: FloatArray,
    states: Mapping[int, FloatArray],
    prior_sigma: Mapping[int, FloatArray],
) -> Fit:
    """Find robustly the error that best explains differences of height (k,).

    Args:
        difference_m: first − second.
        sigma_m: (k,) of the pieces' fits.
        lever: (k,) of the angle or range to find.
        states: by swath (k, 6) levers of its trajectory, with the sign of the swath in the difference.
        prior_sigma: by swath (6,).
    """
    swaths = sorted(states)
    design = np.concatenate([lever[:, np.newaxis], *(states[swath] for swath in swaths)], axis=1)
    scale = np.concatenate([[1.0], *(prior_sigma[swath] for swath in swaths)])
    design = design * scale  # scales the unknowns to their sigmas
    prior = np.eye(len(scale))
    prior[0, 0] = 0.0
    weight = 1.0 / sigma_m**2
    robust, unit = np.ones(len(lever)), 1.0
    for _ in range(ROBUST_ROUNDS):
        gain, inverse = _gain(design, weight * robust / unit**2, prior)
        residual = np.abs(difference_m - design @ (gain @ difference_m)) / sigma_m
        level = 1.4826 * float(np.median(residual))
        unit = max(1.0, level)
        robust = np.where(residual <= HUBER * unit, 1.0, HUBER * unit / np.maximum(residual, 1e-9))
        robust[residual > FAR * unit] = 1e-6 if (residual <= FAR * unit).sum() > len(design) // 2 else 0.1
    gain, inverse = _gain(design, weight * robust / unit**2, prior)
    moved = gain[0] @ design
    by_trajectory = {swath: moved[1 + STATES * k : 1 + STATES * (k + 1)] for k, swath in enumerate(swaths)}
    noise_sigma = float(np.sqrt(np.sum((gain[0] * sigma_m * unit) ** 2 * np.minimum(robust, 1.0))))
    used = robust > 1e-3
    return Fit(float(gain[0] @ difference_m), float(np.sqrt(inverse[0, 0])), noise_sigma, by_trajectory, used, gain[0])


def _gain(design: FloatArray, weight: FloatArray, prior: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return N⁻¹ Aᵀ P (u, k) and N⁻¹ (u, u).

    If no observation depends on the first unknown, its variance is huge but finite.
    """
    normal = design.T @ (design * weight[:, np.newaxis]) + prior
    normal[0, 0] += 1e-12
    inverse = np.asarray(np.linalg.inv(normal), np.float64)
    return inverse @ (design.T * weight), inverse
