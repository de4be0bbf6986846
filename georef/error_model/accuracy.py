"""Figures of accuracy from covariances: differences, CE90, LE90, the error ellipse (FORMULAS 10.3, 10.5)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq
from scipy.special import erf

from swath.georef.arrays import FloatArray

LE90_PER_SIGMA = 1.6448536269514722  # of a normal variable, 90 % of whose values lie within
ROOT_2 = float(np.sqrt(2.0))
CE90_PER_SIGMA = 2.145966026289347  # √(2 ln 10): of two variables of equal sigmas


@dataclass(frozen=True, slots=True)
class Ellipse:
    """The ellipse of one sigma of a horizontal error.

    Attributes:
        major_m, minor_m: half axes.
        azimuth_deg: of the major one, clockwise from the second coordinate (north), 0 … 180.
    """

    major_m: float
    minor_m: float
    azimuth_deg: float


def principal_root(covariance: FloatArray) -> FloatArray:
    """Return the symmetric roots of covariances (…, n, n): V √D Vᵀ (FORMULAS 10.3).

    Negative eigenvalues count as zero.
    """
    values, vectors = np.linalg.eigh(covariance)
    roots = np.sqrt(np.maximum(values, 0.0))
    root: FloatArray = (vectors * roots[..., np.newaxis, :]) @ np.swapaxes(vectors, -1, -2)
    return root


def cross_covariance(first: FloatArray, second: FloatArray, correlation: float) -> FloatArray:
    """Return the covariance of the errors of two points with covariances (n, n) and a correlation (S4 Eq. 6)."""
    crossed: FloatArray = correlation * principal_root(first) @ principal_root(second).T
    return crossed


def relative_covariance(first: FloatArray, second: FloatArray, crossed: FloatArray) -> FloatArray:
    """Return the covariances (…, n, n) of differences: Σ_rr + Σ_ss − Σ_rs − Σ_rsᵀ (ULEM Eq. 2)."""
    difference: FloatArray = first + second - crossed - np.swapaxes(crossed, -1, -2)
    return difference


def le90(variance: float) -> float:
    """Return the half width that holds 90 % of errors of a variance."""
    return LE90_PER_SIGMA * float(np.sqrt(variance))


def ce90(covariance: FloatArray) -> float:
    """Return the radius of the circle that holds 90 % of errors with a covariance (2, 2).

    It is the error's density along the minor axis times the share of the errors along the major one that stay within
    the circle, integrated by Gauss and Legendre's rule over the angle whose sine the first is of the radius.

    Raises:
        ValueError: the matrix is no covariance.
    """
    values = np.linalg.eigvalsh(np.asarray(covariance, np.float64))
    if not np.isfinite(values).all() or values[0] < -1e-9 * max(values[1], 0.0):
        raise ValueError("the horizontal covariance has a negative eigenvalue; it is no covariance")
    small, large = np.sqrt(np.maximum(values, 0.0))
    if large == 0.0:
        return 0.0
    at, weight = np.polynomial.legendre.leggauss(100)

    def lacks(radius: float) -> float:
        if small == 0.0:
            return float(erf(radius / (ROOT_2 * large))) - 0.9
        end = np.arcsin(min(1.0, 9.0 * small / radius))
        angle = 0.5 * end * (at + 1.0)
        density = 2.0 * np.exp(-0.5 * (radius * np.sin(angle) / small) ** 2) / (small * np.sqrt(2.0 * np.pi))
        inside = erf(radius * np.cos(angle) / (ROOT_2 * large))
        return float(0.5 * end * (weight * density * inside * radius * np.cos(angle)).sum()) - 0.9

    return float(brentq(lacks, 0.5 * large, 4.0 * large, xtol=1e-12 * large, rtol=1e-12))


def ellipse(covariance: FloatArray) -> Ellipse:
    """Return the ellipse of a covariance (2, 2) of first (east) and second (north) coordinate."""
    values, vectors = np.linalg.eigh(np.asarray(covariance, np.float64))
    small, large = np.sqrt(np.maximum(values, 0.0))
    east, north = vectors[:, 1]
    return Ellipse(float(large), float(small), float(np.degrees(np.arctan2(east, north)) % 180.0))
