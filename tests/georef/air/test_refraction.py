"""Tests bending: the numbers of the formula sheet (4.1 to 4.3), and its integral computed by SciPy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad

from swath.georef.air.atmosphere import (
    SPHERE_M,
    ardc_k,
    layer_air,
    layer_constant_ppm,
    layer_refractivity,
    spherical_bending,
)

VISIBLE, INFRARED = 78.83, 77.92557  # C of NGA Eq. 9, ppm K / hPa
SENSOR_M, GROUND_M = 3000.0, 200.0


def test_ardc_constant_matches_the_formula_sheet() -> None:
    k = float(ardc_k(SENSOR_M, GROUND_M))
    assert 1e6 * k == pytest.approx(29.87086749, abs=5e-9)
    bent = k * np.tan(np.radians(20.0))
    assert 1e6 * bent == pytest.approx(10.87210664, abs=5e-9)
    shift = 2800.0 * (np.tan(np.radians(20.0)) - np.tan(np.radians(20.0) - bent))
    assert shift == pytest.approx(0.0344745, abs=5e-8)
    assert 1e6 * float(ardc_k(SENSOR_M, 0.0)) == pytest.approx(30.0, abs=1e-12)


@pytest.mark.parametrize(("wavelength_nm", "constant"), [(1064.0, 77.92557), (532.0, 79.13209), (574.0, 78.90136)])
def test_layer_constant_matches_the_formula_sheet(wavelength_nm: float, constant: float) -> None:
    assert layer_constant_ppm(wavelength_nm) == pytest.approx(constant, abs=1e-5)


def test_layer_air_matches_the_formula_sheet() -> None:
    temperature_k, pressure_hpa = layer_air([0.0, 200.0, 3000.0])
    np.testing.assert_allclose(temperature_k, [288.15, 286.85225, 268.68368], rtol=0, atol=5e-6)
    np.testing.assert_allclose(pressure_hpa, [1014.1735, 990.39665, 702.19638], rtol=0, atol=6e-5)


@pytest.mark.parametrize(("constant", "k_urad"), [(VISIBLE, 31.9030463), (INFRARED, 31.5370169)])
def test_flat_layers_match_the_formula_sheet(constant: float, k_urad: float) -> None:
    """K is n̄ − n_s of the air that the spherical layers are made of (FORMULAS 4.2)."""
    refractivity_sum = quad(lambda height_m: float(layer_refractivity(height_m, constant)), GROUND_M, SENSOR_M)[0]
    mean = refractivity_sum / (SENSOR_M - GROUND_M)
    assert 1e6 * (mean - float(layer_refractivity(SENSOR_M, constant))) == pytest.approx(k_urad, abs=5e-7)


@pytest.mark.parametrize(
    ("constant", "nadir_deg", "sheet_urad", "decimals"),
    [
        (VISIBLE, 20.0, 11.6109257, 7),
        (INFRARED, 20.0, 11.4777449, 6),
        (VISIBLE, 45.0, 31.90614, 5),
        (VISIBLE, 60.0, 55.2846, 4),
        (VISIBLE, 75.0, 119.3766, 4),
    ],
)
def test_spherical_layers_match_the_formula_sheet(
    constant: float, nadir_deg: float, sheet_urad: float, decimals: int
) -> None:
    bent = spherical_bending(np.radians(nadir_deg), SENSOR_M, GROUND_M, constant)
    assert 1e6 * float(bent) == pytest.approx(sheet_urad, abs=10.0**-decimals)


def test_without_air_beams_are_straight() -> None:
    nadir = np.radians([0.0, 20.0, 60.0, 80.0])
    np.testing.assert_allclose(spherical_bending(nadir, SENSOR_M, GROUND_M, 0.0), 0.0, rtol=0, atol=3e-13)


@pytest.mark.parametrize("nadir_deg", [1.0, 45.0, 80.0])
@pytest.mark.parametrize(("sensor_m", "ground_m"), [(300.0, -50.0), (9000.0, 100.0)])
def test_the_number_of_quadrature_nodes_suffices(nadir_deg: float, sensor_m: float, ground_m: float) -> None:
    nadir = np.radians(nadir_deg)
    invariant = (1.0 + float(layer_refractivity(sensor_m, VISIBLE))) * (SPHERE_M + sensor_m) * np.sin(nadir)

    def rate(height_m: float) -> float:
        radius = SPHERE_M + height_m
        optical = (1.0 + float(layer_refractivity(height_m, VISIBLE))) * radius
        return float(invariant / (radius * np.sqrt(optical**2 - invariant**2)))

    central = quad(rate, ground_m, sensor_m, epsabs=0, epsrel=2e-14)[0]
    radius = SPHERE_M + ground_m
    chord = np.arctan2(radius * np.sin(central), sensor_m - ground_m + 2 * radius * np.sin(central / 2) ** 2)
    assert float(spherical_bending(nadir, sensor_m, ground_m, VISIBLE)) == pytest.approx(nadir - chord, abs=1e-12)
