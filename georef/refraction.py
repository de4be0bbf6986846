"""Bending of beams by air: ARDC's K, spherical layers (FORMULAS 4; NGA Eq. 4 to 11).

A beam bends towards the vertical as the air gets denser: the point lies nearer to nadir than the beam leaves, by Δd.
Heights are taken as they come, which are ellipsoidal; the models count them from the sea. With a geoid 50 m from the
ellipsoid Δd changes by half a percent.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]

SPHERE_M = 6_371_000.0
FT_PER_M = 1.0 / 0.3048
HPA_PER_PSF = 0.4788025898
GAUSS_NODES, GAUSS_WEIGHTS = np.polynomial.legendre.leggauss(20)


def layer_constant_ppm(wavelength_nm: float) -> float:
    """C of NGA Eq. 9 in ppm K/hPa, re-derived: 0.27315/1.01325 · N_p of the closed form of IAG 1999 (FORMULAS 4.3)."""
    wave = (1e-3 * wavelength_nm) ** -2
    return 273.15 / 1013.25 * (287.6155 + 1.62887 * wave + 0.01360 * wave * wave)


def layer_air(height_m: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Temperature in K and pressure in hPa at heights (…,) in metres (NGA Eq. 10, 11); the troposphere's."""
    fahrenheit = 59.0 - 0.00356 * FT_PER_M * np.asarray(height_m, dtype=np.float64)
    pressure: FloatArray = HPA_PER_PSF * 2116.0 * ((fahrenheit + 459.7) / 518.6) ** 5.256
    return (fahrenheit + 459.67) * 5.0 / 9.0, pressure


def layer_refractivity(height_m: ArrayLike, constant_ppm: float) -> FloatArray:
    """n − 1 of dry air at heights (…,) in metres (NGA Eq. 9)."""
    temperature_k, pressure_hpa = layer_air(height_m)
    refractivity: FloatArray = 1e-6 * constant_ppm * pressure_hpa / temperature_k
    return refractivity


def ardc_k(sensor_m: ArrayLike, ground_m: ArrayLike) -> FloatArray:
    """K of the ARDC model in radians (NGA Eq. 5, restored), Δd = K tan α (Eq. 4); heights (…,) in metres, above 0."""
    upper, lower = 1e-3 * np.asarray(sensor_m, dtype=np.float64), 1e-3 * np.asarray(ground_m, dtype=np.float64)

    def term(height_km: FloatArray) -> FloatArray:
        return 2410.0 * height_km / (height_km**2 - 6.0 * height_km + 250.0)

    k: FloatArray = 1e-6 * (term(upper) - term(lower) * lower / upper)
    return k


def spherical_bending(nadir_rad: ArrayLike, sensor_m: ArrayLike, ground_m: ArrayLike, constant_ppm: float) -> Any:
    """Δd in radians of rays through spherical layers (NGA Eq. 6 to 8, restored), for beams that go down.

    Args:
        nadir_rad: (…,) of the beam as it leaves.
        sensor_m, ground_m: (…,) heights above a sphere of 6371 km.
        constant_ppm: `layer_constant_ppm`.
    """
    nadir, sensor, ground = (np.asarray(given, dtype=np.float64) for given in (nadir_rad, sensor_m, ground_m))
    invariant = (1.0 + layer_refractivity(sensor, constant_ppm)) * (SPHERE_M + sensor) * np.sin(nadir)
    heights = ground[..., np.newaxis] + (sensor - ground)[..., np.newaxis] * 0.5 * (1.0 + GAUSS_NODES)
    radius = SPHERE_M + heights
    optical = (1.0 + layer_refractivity(heights, constant_ppm)) * radius
    k = invariant[..., np.newaxis]
    central = 0.5 * (sensor - ground) * ((k / (radius * np.sqrt(optical**2 - k**2))) @ GAUSS_WEIGHTS)
    across = (SPHERE_M + ground) * np.sin(central)
    descent = (sensor - ground) + 2.0 * (SPHERE_M + ground) * np.sin(0.5 * central) ** 2
    return nadir - np.arctan2(across, descent)
