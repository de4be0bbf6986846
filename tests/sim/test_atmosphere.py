"""Tests the air: Ciddor's published values, closed forms of the formula sheet, and another ray integrator."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp

from swath.georef.arrays import FloatArray
from swath.sim.atmosphere import (
    Air,
    bending_by_layers,
    group_refractivity_ppm,
    phase_refractivity_ppm,
    vapour_fraction,
)
from swath.sim.plan.tables import AtmosphereTable

DOWN = np.array([0.0, 0.0, -1.0])


def one(value: float) -> FloatArray:
    return np.array([value])


def air_of(wavelength_nm: float = 1064.0, **keys: Any) -> Air:
    return Air(AtmosphereTable(**keys), wavelength_nm)


# --- group index ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("temperature_c", "pressure_kpa", "humidity_percent", "published"),
    [
        (20, 80, 0, 21458.0),
        (20, 100, 0, 26824.4),
        (20, 120, 0, 32191.6),
        (10, 100, 0, 27774.7),
        (30, 100, 0, 25937.2),
        (20, 80, 75, 21394.0),
        (20, 120, 75, 32127.8),
        (40, 120, 75, 29941.8),
        (50, 80, 100, 19058.4),
        (50, 120, 100, 28792.4),
    ],
)
def test_phase_index_matches_ciddor(
    temperature_c: float, pressure_kpa: float, humidity_percent: float, published: float
) -> None:
    # Ciddor 1996, tables 1 and 3: 633 nm, 450 ppm of CO2, 1e8 (n − 1)
    temperature_k, pressure_pa = one(temperature_c + 273.15), one(1e3 * pressure_kpa)
    vapour = vapour_fraction(temperature_k, pressure_pa, 0.01 * humidity_percent)
    refractivity = phase_refractivity_ppm(0.633, temperature_k, pressure_pa, vapour, 450.0)
    assert 100.0 * refractivity[0] == pytest.approx(published, abs=0.06)


@pytest.mark.parametrize(
    ("temperature_c", "pressure_pa", "vapour_pa", "co2_ppm", "published"),
    [
        (19.526, 102_094.8, 1065, 510, 27392.9),
        (19.173, 102_993.0, 641, 450, 27682.4),
        (19.188, 102_918.8, 706, 450, 27658.7),
        (19.534, 103_599.2, 951, 610, 27802.2),
    ],
)
def test_phase_index_matches_laboratory_air(
    temperature_c: float, pressure_pa: float, vapour_pa: float, co2_ppm: float, published: float
) -> None:
    # Ciddor 1996, table 2
    enhancement = 1.00062 + 3.14e-8 * pressure_pa + 5.6e-7 * temperature_c**2
    air = one(temperature_c + 273.15), one(pressure_pa), one(enhancement * vapour_pa / pressure_pa)
    assert 100.0 * phase_refractivity_ppm(0.633, *air, co2_ppm)[0] == pytest.approx(published, abs=0.06)


@pytest.mark.parametrize(
    ("wavelength_um", "sheet"), [(0.532, 289.404), (0.905, 277.965), (1.064, 276.360), (1.550, 274.164)]
)
def test_group_refractivity_matches_the_formula_sheet(wavelength_um: float, sheet: float) -> None:
    # 15 °C, 1013.25 hPa, 10 hPa of vapour: FORMULAS 3.2 by 50 digits
    temperature_k, pressure_pa = one(288.15), one(101_325.0)
    saturated = vapour_fraction(temperature_k, pressure_pa, 1.0)
    enhancement = 1.00062 + 3.14e-8 * pressure_pa + 5.6e-7 * 15.0**2
    humidity = float((1000.0 / (saturated * pressure_pa / enhancement))[0])
    vapour = vapour_fraction(temperature_k, pressure_pa, humidity)
    refractivity = group_refractivity_ppm(wavelength_um, temperature_k, pressure_pa, vapour)
    assert refractivity[0] == pytest.approx(sheet, abs=0.0006)


def closed_refractivity_ppm(height_m: float, wavelength_um: float) -> float:
    """Return IAG 1999's closed form in the standard atmosphere's closed form, ppm; the module uses neither."""
    temperature_k = 288.15 - 0.0065 * height_m
    pressure_hpa = 1013.25 * (temperature_k / 288.15) ** 5.255876
    group = 287.6155 + 4.88660 / wavelength_um**2 + 0.06800 / wavelength_um**4
    return float(273.15 / 1013.25 * group * pressure_hpa / temperature_k)


@pytest.mark.parametrize(("low_m", "high_m"), [(0.0, 300.0), (200.0, 3000.0), (450.0, 9000.0)])
@pytest.mark.parametrize("wavelength_nm", [905.0, 1064.0, 1550.0])
def test_path_means_match_closed_forms(low_m: float, high_m: float, wavelength_nm: float) -> None:
    air = air_of(wavelength_nm)
    closed = quad(closed_refractivity_ppm, low_m, high_m, args=(1e-3 * wavelength_nm,), epsabs=1e-6)[0]
    mean = air.group_refractivity_ppm(one(high_m), one(low_m))[0]
    assert mean == pytest.approx(closed / (high_m - low_m), abs=0.15)  # the two formulas differ by less than 0.1 ppm
    np.testing.assert_allclose(air.group_refractivity_ppm(one(low_m), one(high_m)), mean, rtol=1e-12)


def test_mean_over_a_path_is_exact_to_a_hundredth_of_a_ppm() -> None:
    air = air_of()
    heights_m = np.linspace(137.0, 4871.0, 4001)
    local = air.group_refractivity_ppm(heights_m, heights_m)
    mean = np.sum(0.5 * (local[1:] + local[:-1])) / 4000
    assert air.group_refractivity_ppm(one(137.0), one(4871.0))[0] == pytest.approx(mean, abs=1e-4)
    assert np.abs(air.group_refractivity_ppm(heights_m, heights_m + 1.001) - local).max() < 0.02


def test_measured_air_is_reproduced_at_its_height() -> None:
    air = air_of(model="measured", temperature_c=-10.0, pressure_hpa=850.0, humidity_percent=0.0, height_m=1200.0)
    local = air.group_refractivity_ppm(one(1200.0), one(1200.0))[0]
    closed = 273.15 / 1013.25 * 291.984975 * 850.0 / 263.15  # FORMULAS 3.2, dry
    assert local == pytest.approx(closed, abs=0.1)


def test_standard_values_as_measurement_give_the_standard_atmosphere() -> None:
    measured = air_of(model="measured", temperature_c=2.0, pressure_hpa=794.9522, humidity_percent=0.0, height_m=2000.0)
    standard = air_of()  # ISO 2533 at 2000 m: 275.15 K, 794.952 hPa
    path = one(3500.0), one(300.0)
    assert measured.group_refractivity_ppm(*path)[0] == pytest.approx(
        standard.group_refractivity_ppm(*path)[0], abs=0.001
    )


def test_humidity_makes_light_faster() -> None:
    dry, wet = (
        air_of(model="measured", temperature_c=30.0, humidity_percent=humidity).group_refractivity_ppm(
            one(0.0), one(0.0)
        )[0]
        for humidity in (0.0, 50.0)
    )
    # 21.2 hPa of vapour (3.089 ppm at 13.33 hPa and 20 °C) replace air (291.98 ppm at 0 °C)
    wanted = 3.089 * 21.23 / 13.33 * 293.15 / 303.15 - 291.98 * 273.15 / 303.15 * 21.23 / 1013.25
    assert wet - dry == pytest.approx(wanted, abs=0.02)


def test_a_device_that_uses_the_vacuum_speed_measures_too_long() -> None:
    ranges = np.array([[1000.0, 1200.0, np.nan], [0.0, np.nan, np.nan], [900.0, 0.0, np.nan]])
    from_m = np.array([1500.0, 1500.0, 1400.0])
    to_m = np.array([[520.0, 330.0, np.nan], [np.nan, np.nan, np.nan], [510.0, np.nan, np.nan]])
    air = air_of(ranges="vacuum")
    said = air.device_range(ranges, from_m, to_m)
    mean = air.group_refractivity_ppm(np.array([1500.0, 1500.0, 1400.0]), np.array([520.0, 330.0, 510.0]))
    np.testing.assert_allclose(said[[0, 0, 2], [0, 1, 0]], ranges[[0, 0, 2], [0, 1, 0]] * (1 + 1e-6 * mean), rtol=1e-15)
    assert 0.24 < said[0, 0] - 1000.0 < 0.27
    np.testing.assert_array_equal(np.isnan(said), np.isnan(ranges))
    np.testing.assert_array_equal(said[[1, 2], [0, 1]], 0.0)
    np.testing.assert_array_equal(air.device_range(ranges[:, 0], from_m, to_m[:, 0]), said[:, 0])
    np.testing.assert_array_equal(air_of().device_range(ranges, from_m, to_m), ranges)


# --- bending --------------------------------------------------------------------------------------------------------


def test_ardc_bending_matches_the_formula_sheet() -> None:
    air = air_of(refraction="ardc")
    bent = air.bending(np.radians(one(20.0)), one(3000.0), one(200.0))
    assert 1e6 * bent[0] == pytest.approx(10.872107, abs=6e-7)


@pytest.mark.parametrize(
    ("nadir_deg", "sheet_urad"), [(20.0, 11.6109), (45.0, 31.906), (60.0, 55.285), (75.0, 119.377)]
)
def test_layer_bending_matches_the_formula_sheet(nadir_deg: float, sheet_urad: float) -> None:
    # visible light, C = 78.83 ppm K / hPa
    bent = bending_by_layers(np.radians(one(nadir_deg)), one(3000.0), one(200.0), 78.83)
    assert 1e6 * bent[0] == pytest.approx(sheet_urad, abs=6e-4)


def test_spherical_bending_depends_on_the_wavelength() -> None:
    angle = np.radians(one(20.0))
    infrared = air_of(1064.0, refraction="spherical").bending(angle, one(3000.0), one(200.0))
    assert 1e6 * infrared[0] == pytest.approx(11.4777, abs=0.001)
    visible = air_of(574.0, refraction="spherical").bending(angle, one(3000.0), one(200.0))
    assert visible[0] / infrared[0] == pytest.approx(78.90 / 77.926, abs=1e-4)


@pytest.mark.parametrize("height_m", [300.0, 3000.0, 9000.0])
@pytest.mark.parametrize("nadir_deg", [5.0, 45.0, 79.0])
def test_ray_bending_matches_another_integration(height_m: float, nadir_deg: float) -> None:
    # the vector ray equation d/ds (n t) = ∇n in the plane, by an adaptive integrator
    radius_m, constant = 6_371_000.0, 78.83

    def index(height: float) -> float:
        fahrenheit = 59.0 - 0.00356 * height / 0.3048
        pressure_hpa = 0.4788025898 * 2116.0 * ((fahrenheit + 459.7) / 518.6) ** 5.256
        return float(1.0 + 1e-6 * constant * pressure_hpa / ((fahrenheit + 459.67) / 1.8))

    def ray(_: float, state: FloatArray) -> list[float]:
        radius = np.hypot(state[0], radius_m + height_m + state[1])
        height = radius - radius_m
        gradient = (index(height + 1.0) - index(height - 1.0)) / 2.0
        up = np.array([state[0], radius_m + height_m + state[1]]) / radius
        return [*(state[2:] / index(height)), *(gradient * up)]

    class Ground:
        """The event that ends the ray, when it has come down to 200 m."""

        terminal = True

        def __call__(self, _: float, state: FloatArray) -> float:
            return float(np.hypot(state[0], radius_m + height_m + state[1]) - radius_m - 200.0)

    nadir = np.radians(nadir_deg)
    start = index(height_m) * np.array([np.sin(nadir), -np.cos(nadir)])
    solved = solve_ivp(ray, (0.0, 1e6), [0.0, 0.0, *start], events=Ground(), rtol=1e-12, atol=1e-9, max_step=2e4)
    east, up = solved.y_events[0][0][:2]
    bent = bending_by_layers(one(float(nadir)), one(height_m), one(200.0), constant)
    assert 1e6 * bent[0] == pytest.approx(1e6 * (nadir - np.arctan2(east, -up)), abs=0.01)


@pytest.mark.parametrize("refraction", ["ardc", "spherical"])
def test_beams_bend_towards_the_vertical(refraction: str) -> None:
    rng = np.random.default_rng(3)
    nadir, heading = np.arccos(rng.uniform(np.cos(1.2), 1.0, 500)), rng.uniform(0, 2 * np.pi, 500)
    direction = np.stack([np.sin(nadir) * np.sin(heading), np.sin(nadir) * np.cos(heading), -np.cos(nadir)], axis=1)
    sensor_m, ground_m = rng.uniform(1000, 4000, 500), rng.uniform(0, 700, 500)
    air = air_of(refraction=refraction)
    bent = air.bend(direction, DOWN, sensor_m, ground_m)
    np.testing.assert_allclose(np.linalg.norm(bent, axis=1), 1.0, rtol=0, atol=1e-15)
    reached = np.arctan2(np.hypot(bent[:, 0], bent[:, 1]), -bent[:, 2])
    np.testing.assert_allclose(nadir - reached, air.bending(nadir, sensor_m, ground_m), rtol=0, atol=1e-14)
    np.testing.assert_allclose(np.arctan2(bent[:, 0], bent[:, 1]) % (2 * np.pi), heading, rtol=0, atol=1e-12)
    each = air.bend(direction, np.tile(DOWN, (500, 1)), sensor_m, ground_m)
    np.testing.assert_array_equal(each, bent)
    assert (nadir - reached > 0).all()


@pytest.mark.parametrize("refraction", ["ardc", "spherical"])
def test_unusual_beams_stay_finite(refraction: str) -> None:
    air = air_of(refraction=refraction)
    direction = np.array([[0, 0, -1.0], [1e-12, 0, -1.0], [1.0, 0, 0], [0, 1.0, 0.01], [0, 0, 1.0], [1, 0, -0.01]])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    bent = air.bend(direction, DOWN, np.full(6, 900.0), np.full(6, 400.0))
    np.testing.assert_array_equal(
        bent[[0, 1, 3, 4]], direction[[0, 1, 3, 4]]
    )  # beams that go down or above the horizon are unchanged
    np.testing.assert_allclose(bent, direction, rtol=0, atol=1e-4)
    below = air.bending(one(0.5), one(300.0), one(400.0))
    np.testing.assert_allclose(below, 0.0, rtol=0, atol=1e-12)


def test_without_refraction_beams_are_straight() -> None:
    air = air_of()
    direction = np.array([[0.6, 0.0, -0.8]])
    assert not air.bends
    np.testing.assert_array_equal(air.bend(direction, DOWN, one(3000.0), one(0.0)), direction)
    np.testing.assert_array_equal(air.bending(one(0.7), one(3000.0), one(0.0)), 0.0)
    assert air_of(refraction="ardc").bends


# --- dimming --------------------------------------------------------------------------------------------------------


def test_visibility_is_the_distance_of_two_percent_contrast() -> None:
    # at 550 nm, there and back over half the visibility equals once over all of it
    for sight_km in (3.0, 23.0, 80.0):
        air = air_of(550.0, visibility_km=sight_km)
        left = air.transmission(np.array([0.0, 500.0 * sight_km]))
        np.testing.assert_allclose(left, [1.0, 0.02], rtol=1e-3)


def test_infrared_light_goes_farther_in_haze() -> None:
    green, infrared = (
        air_of(wavelength, visibility_km=10.0).transmission(one(3000.0)) for wavelength in (550.0, 1550.0)
    )
    assert np.log(infrared)[0] / np.log(green)[0] == pytest.approx((1550.0 / 550.0) ** -1.3, rel=1e-12)  # Kruse
