"""Fit a plane to the few returns around a place (FORMULAS 8), and test roughness, slope, and whether it is inside."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from swath.georef.arrays import BoolArray, FloatArray

TRIPLES = 60  # of returns, each defining a candidate for the first plane
INLIER_SIGMAS = 3.0
FEWEST_SHARE = 0.6  # of the returns; if fewer lie on the plane, it is not the ground
ROUNDS = 5


@dataclass(frozen=True, slots=True)
class PlaneRules:
    """Rules for a plane: the least number of returns, the greatest √λ0 (metres), the steepest slope (degrees)."""

    fewest: int = 6
    roughest_m: float = 0.06
    steepest_deg: float = 45.0


@dataclass(frozen=True, eq=False)
class LocalPlane:
    """A plane fitted to returns.

    Attributes:
        centre_t: (3,) mean of its returns.
        normal_t: (3,) unit, upwards.
        rms_m: √λ0, of its returns from it.
        count: number of returns.
    """

    centre_t: FloatArray
    normal_t: FloatArray
    rms_m: float
    count: int

    def distance_m(self, point_t: FloatArray) -> float:
        """Return the signed distance of a point along the normal: d = n · (p − c)."""
        return float(self.normal_t @ (point_t - self.centre_t))

    def above_m(self, point_t: FloatArray) -> float:
        """Return the height of a point above the plane, along up: Δz = d / n_z."""
        return self.distance_m(point_t) / float(self.normal_t[2])

    @property
    def slope_rad(self) -> float:
        """Slope against the horizontal."""
        return math.acos(min(1.0, abs(float(self.normal_t[2]))))


def plane_through(points_t: FloatArray) -> LocalPlane:
    """Fit a plane by least squares to points (n, 3).

    The normal belongs to the smallest eigenvalue λ0 of their covariance.
    """
    centre = points_t.mean(axis=0)
    offsets = points_t - centre
    values, vectors = np.linalg.eigh(offsets.T @ offsets / len(points_t))
    normal = vectors[:, 0] * (1.0 if vectors[2, 0] >= 0.0 else -1.0)
    return LocalPlane(centre, normal, math.sqrt(max(float(values[0]), 0.0)), len(points_t))


def robust_plane(points_t: FloatArray, rules: PlaneRules) -> tuple[LocalPlane | None, BoolArray, str]:
    """Fit the plane on which most of points (n, 3) lie; return it, a mask of these points, and any reason of failure.

    The first plane is the one through three points that has the least median distance from the points (least median of
    squares, Rousseeuw 1984); then follows least squares of those within three sigmas, until they stay the same.
    """
    none = np.zeros(len(points_t), dtype=bool)
    if len(points_t) < rules.fewest:
        return None, none, "too few returns"
    distances = _first_distances(points_t)
    kept = none
    for _ in range(ROUNDS):
        sigma_m = max(1.4826 * float(np.median(distances)), rules.roughest_m / 3.0)
        near = distances <= INLIER_SIGMAS * min(sigma_m, rules.roughest_m)
        if (near == kept).all() or near.sum() < rules.fewest:
            break
        kept = near
        plane = plane_through(points_t[kept])
        distances = np.abs((points_t - plane.centre_t) @ plane.normal_t)
    if kept.sum() < max(rules.fewest, FEWEST_SHARE * len(points_t)):
        return None, none, "no plane"
    if plane.rms_m > rules.roughest_m:
        return None, none, "too rough"
    if plane.slope_rad > math.radians(rules.steepest_deg):
        return None, none, "too steep"
    return plane, kept, ""


def _first_distances(points_t: FloatArray) -> FloatArray:
    """Return distances (n,) from the best plane through three of the points; the number of points seeds the draw."""
    draws = np.random.default_rng(len(points_t))
    triples = points_t[np.argsort(draws.random((TRIPLES, len(points_t))), axis=1)[:, :3]]
    normals = np.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    length = np.linalg.norm(normals, axis=1)
    good = length > 1e-9
    if not good.any():
        return np.full(len(points_t), np.inf)
    normals = normals[good] / length[good, np.newaxis]
    offsets = points_t[np.newaxis] - triples[good, :1]
    distances: FloatArray = np.abs(np.einsum("tni,ti->tn", offsets, normals))
    best: FloatArray = distances[np.argmin(np.median(distances, axis=1))]
    return best


def is_inside(point: FloatArray, around: FloatArray) -> bool:
    """Return whether a place (2,) lies within the convex hull of places (n, 2).

    That is so if no half of the horizon around it is free of them.
    """
    offsets = around - point
    if not (np.abs(offsets).sum(axis=1) > 0.0).all():
        return True
    angles = np.sort(np.arctan2(offsets[:, 1], offsets[:, 0]))
    gaps = np.diff(np.append(angles, angles[0] + 2.0 * math.pi))
    return bool(gaps.max() <= math.pi)
