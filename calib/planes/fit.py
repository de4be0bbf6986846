"""A plane through points of one swath, how far they should lie from it, and whether it is one.

Curvature and roughness are told apart from noise by the sigmas of a single return (FORMULAS 6.2 and 6.6).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from swath.calib.flight import Flight, Swath, sensor_t
from swath.calib.plane_settings import PlaneSettings
from swath.georef.arrays import FloatArray
from swath.georef.records import Int64Array
from swath.georef.scanner.uncertainty import Noise

GATE = 4.0  # sigmas within which a return belongs to a plane
_ROUNDS = 10


@dataclass(frozen=True, eq=False)
class Sight:
    """A plane as one swath shows it.

    Attributes:
        at: (n,) rising indexes of its returns.
        centre_t, normal_t: (3,) of the points; the normal points up.
        rms_m: of the points from it.
        sigma_m: expected of a single return along the normal.
        gate_m: within which returns were taken.
        normal_sigma_rad: of the normal's less certain direction.
        sag_m, sag_sigma_m: height of the arc of a curved surface through them over its length.
    """

    at: Int64Array
    centre_t: FloatArray
    normal_t: FloatArray
    rms_m: float
    sigma_m: float
    gate_m: float
    normal_sigma_rad: float
    sag_m: float
    sag_sigma_m: float


def expected_sigma(noise: Noise, away_t: FloatArray, normal_t: FloatArray, settings: PlaneSettings) -> FloatArray:
    """(n,) metres along normals (n, 3) of returns at (n, 3) from the scanner, trajectory and calibration apart.

    Range by the cosine of incidence, angle and footprint by its sine (FORMULAS 6.2), roughness whole.
    """
    range_m = np.linalg.norm(away_t, axis=-1)
    cosine = np.minimum(np.abs((away_t * normal_t).sum(axis=-1)) / range_m, 1.0)
    sine = np.sqrt(1.0 - cosine**2)
    aside = range_m * sine * np.hypot(noise.angle_rad, 0.25 * noise.divergence_rad)
    sigma: FloatArray = np.sqrt((noise.range_m * cosine) ** 2 + aside**2 + settings.surface_m**2)
    return sigma


def fit_sight(
    flight: Flight, swath: Swath, at: Int64Array, settings: PlaneSettings, *, bent: bool = True
) -> Sight | None:
    """The plane most of these returns lie on, and those of them that do; None: fewer than three are left.

    What lies farther from it than `GATE` expected sigmas is left out, again and again from all, until nothing changes.
    ``bent``: how curved they are is asked too.
    """
    if len(at) < 4:
        return None
    points = np.asarray(swath.points_t[at])
    noise = flight.heads[swath.head].noise
    away = points.mean(axis=0) - sensor_t(flight, swath, at[len(at) // 2 : len(at) // 2 + 1])[0]
    kept = np.ones(len(at), np.bool_)
    for _ in range(_ROUNDS):
        if kept.sum() < 4:
            return None
        centre, axes, _ = principal(points[kept])
        sigma_m = float(expected_sigma(noise, away, axes[0], settings))
        distance = (points - centre) @ axes[0]
        gate = GATE * max(sigma_m, min(1.4826 * float(np.median(np.abs(distance[kept]))), settings.rough * sigma_m))
        now = np.abs(distance) <= gate
        if (now == kept).all():
            break
        kept = now
    return _sight(at[kept], points[kept], sigma_m, gate, bent)


def principal(points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Mean (3,), axes (3, 3) as rows, the normal first and pointing up, and variances along them (3,), rising."""
    centre = points.mean(axis=0)
    off = points - centre
    variances, vectors = np.linalg.eigh(off.T @ off / len(points))
    axes = vectors.T * (1.0 if vectors[2, 0] >= 0.0 else -1.0)
    return centre, axes, np.maximum(variances, 0.0)


def _sight(at: Int64Array, points: FloatArray, sigma_m: float, gate_m: float, bent: bool) -> Sight | None:
    if len(at) < 4:
        return None
    centre, axes, variances = principal(points)
    rms_m = float(np.sqrt(variances[0] * len(at) / (len(at) - 3)))
    spread = float(np.sqrt(variances[1]))
    sag_m, sag_sigma_m = _sag(points - centre, axes, max(rms_m, 1e-6)) if bent else (0.0, np.inf)
    normal_sigma = max(rms_m, 1e-6) / (np.sqrt(len(at)) * max(spread, 1e-6))
    return Sight(at, centre, axes[0], rms_m, sigma_m, gate_m, float(normal_sigma), sag_m, sag_sigma_m)


def _sag(off: FloatArray, axes: FloatArray, rms_m: float) -> tuple[float, float]:
    """Greatest arc height of a quadratic surface over the points' length, of both directions and between; its sigma."""
    if len(off) < 7:
        return 0.0, np.inf
    across, u, v = (off @ axes.T).T
    length_u, length_v = np.ptp(u), np.ptp(v)
    u, v = u / max(length_u, 1e-6), v / max(length_v, 1e-6)
    design = np.stack([np.ones(len(u)), u, v, u * u, u * v, v * v], axis=1)
    normal = design.T @ design
    try:
        inverse = np.linalg.inv(normal)
    except np.linalg.LinAlgError:
        return 0.0, np.inf
    bent = (inverse @ (design.T @ across))[3:]
    at = int(np.argmax(np.abs(bent)))
    return float(abs(bent[at]) / 4.0), float(rms_m * np.sqrt(max(inverse[3 + at, 3 + at], 0.0)) / 4.0)


def refusal(sight: Sight | None, settings: PlaneSettings, slack: float = 1.0) -> str:
    """Why this is no plane; empty: it is one. Slack: of what was one before, so that it stays one."""
    if sight is None or len(sight.at) < settings.least_points:
        return "too few returns"
    if sight.rms_m > slack * settings.rough * sight.sigma_m:
        return "too rough"
    if sight.normal_t[2] < np.cos(settings.wall_slope_rad):
        return "wall"
    if sight.normal_sigma_rad > slack * settings.normal_sigma_rad:
        return "too small"
    if sight.sag_m > slack * settings.sag_m and sight.sag_m > 3.0 * sight.sag_sigma_m:
        return "curved"
    return ""
