"""Fit a plane to points of one swath, predict their scatter, and test whether the points form a plane.

The sigmas of a single return separate curvature and roughness from noise (FORMULAS 6.2 and 6.6).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from swath.calib.flight import Flight, Swath, sensor_t
from swath.calib.scale import Scale, scale_of
from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.scanner.uncertainty import Noise

_CELLS_ACROSS, _CELL_LEAST_M = 50.0, 0.5  # fewest cells across a swath; smallest cell
_TILES_ACROSS, _TILE_LEAST_M = 4.0, 4.0

GATE = 4.0  # sigmas within which a return belongs to a plane
_ROUNDS = 10


@dataclass(frozen=True, eq=False)
class Sight:
    """A plane as one swath shows it.

    Attributes:
        at: (n,) rising indexes of its returns.
        centre_t, normal_t: (3,) of the points; the normal points up.
        rms_m: distance of the points from the plane.
        sigma_m: expected sigma of a single return along the normal.
        gate_m: distance within which returns were used.
        normal_sigma_rad: sigma of the normal's less certain direction.
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
    """Return the expected sigmas (n,) in metres along normals (n, 3) of returns at (n, 3) from the scanner.

    Range counts by the cosine of incidence, angle and footprint by its sine (FORMULAS 6.2), roughness fully. Errors of
    trajectory and calibration are not included.
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
    """Fit the plane on which most of these returns lie, and keep those returns; None if fewer than four are left.

    Returns farther from it than `GATE` expected sigmas are left out; this is repeated from all returns until the
    selection stays the same. ``bent``: whether the curvature is estimated too.
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
    """Return the mean (3,), the principal axes (3, 3) as rows, and the variances along them (3,), rising.

    The normal is the first axis and points up.
    """
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
    """Return the greatest arc height of a quadratic surface over the points' length, and its sigma.

    The arcs in both directions and between them are compared.
    """
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
    """Return why a sight is no plane; empty: it is one. A slack above 1 keeps former planes longer."""
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


class PlaneError(ValueError):
    """Planes cannot be searched in this flight; the message is one line for the user."""


@dataclass(frozen=True, slots=True)
class PlaneSettings:
    """Settings of the plane search, and of finding the same planes again.

    Attributes:
        cell_m: least size of a cell; cells are larger where a swath has fewer than ``cell_points`` per cell.
        cell_points: wanted average number of points in a cell.
        tile_m: greatest length of a piece of a plane; larger faces are cut, ground is cut along tiles of this size.
        least_points: returns a swath must have on a plane.
        most_points: returns of a swath on a plane that are kept: evenly drawn in the order of their times.
        most_planes: greatest number of planes: roofs first, larger ones earlier, in turn by the direction they face;
            then ground.
        ground_planes: pieces of level ground wanted of each third along and each fifth across a swath, for every other
            swath that sees them.
        roof_slope_rad: steeper planes are kept as roofs; the others are ground, and thinned.
        wall_slope_rad: steeper planes are left out.
        surface_m: roughness of surfaces that count as plane, one sigma.
        rough: greatest rms of a plane's points in units of the expected one.
        several: greatest share of points of pulses with several returns in a cell.
        sag_m: a plane's greatest curvature: height of the arc over its length.
        displacement_m: horizontal distance by which strips may differ at first.
        offset_m: vertical distance by which they may differ, at first and once calibrated.
        tight_m: distance along their normal by which planes of the same place may differ once the points were placed
            anew.
        normal_sigma_rad: greatest sigma of a plane's direction in one swath.
        angle_rad: angle between normals of the same plane in two swaths, beyond their noise.
        overlap: least share of the smaller one's cells that two sights of a plane have in common.
    """

    cell_m: float = 1.0
    cell_points: float = 6.0
    tile_m: float = 15.0
    least_points: int = 10
    most_points: int = 2000
    most_planes: int = 1000
    ground_planes: int = 1
    roof_slope_rad: float = float(np.radians(10.0))
    wall_slope_rad: float = float(np.radians(65.0))
    surface_m: float = 0.01
    rough: float = 1.5
    several: float = 0.3
    sag_m: float = 0.01
    displacement_m: float = 1.5
    offset_m: float = 0.3
    tight_m: float = 0.2
    normal_sigma_rad: float = float(np.radians(1.0))
    angle_rad: float = float(np.radians(1.0))
    overlap: float = 0.3

    def scaled(self, scale: Scale) -> PlaneSettings:
        """Return the settings for a flight of these sizes; the fields are meant for 800 m above ground.

        In narrow swaths cells and pieces are smaller, so that several lie side by side. From greater heights the same
        small angles move strips farther apart.
        """
        higher = max(scale.of_reference, 1.0)
        return replace(
            self,
            cell_m=max(min(self.cell_m, scale.width_m / _CELLS_ACROSS), _CELL_LEAST_M),
            tile_m=max(min(self.tile_m, scale.width_m / _TILES_ACROSS), _TILE_LEAST_M),
            displacement_m=self.displacement_m * higher,
            offset_m=self.offset_m * higher,
            tight_m=self.tight_m * higher,
        )


def scaled_to(flight: Flight, settings: PlaneSettings) -> PlaneSettings:
    """Return the settings for the sizes of a flight; unchanged if it has no points."""
    scale = scale_of(flight)
    return settings if scale is None else settings.scaled(scale)
