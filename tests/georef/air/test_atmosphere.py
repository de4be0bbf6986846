"""Tests the air: the formula sheet's numbers, PROJ's verticals, exact integrals, the virtual aircraft's air."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest
from pyproj import Transformer
from scipy.integrate import quad
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from swath.georef.air.atmosphere import (
    SPHERE_M,
    Air,
    AtmosphereError,
    _table,
    ardc_k,
    group_refractivity_ppm,
    layer_air,
    layer_constant_ppm,
    saturated_hpa,
    spherical_bending,
    standard_air,
)
from swath.georef.air.kernels import BLOCK, means
from swath.georef.arrays import FloatArray
from swath.sim.atmosphere import Air as SimulatedAir
from swath.sim.plan.tables import AtmosphereTable

pytestmark = pytest.mark.xdist_group("kernels")

TO_E = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
TO_GEODETIC = Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
MEASURED: dict[str, Any] = {"model": "measured", "temperature_c": 24.0, "pressure_hpa": 955.0, "height_m": 480.0}


def beams(
    n: int, *, height_m: tuple[float, float] = (300.0, 6000.0), nadir_deg: float = 60.0, up_to_m: float = 4000.0
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return beams (n, 3) in e all over the earth, and the verticals (down) there from PROJ."""
    rng = np.random.default_rng(11)
    lon, lat, sensor_m = rng.uniform(-180, 180, n), rng.uniform(-90, 90, n), rng.uniform(height_m[0], height_m[1], n)
    origin = np.stack(TO_E.transform(lon, lat, sensor_m), axis=1)
    down = np.stack(TO_E.transform(lon, lat, sensor_m - 1000.0), axis=1) - origin
    down /= np.linalg.norm(down, axis=1, keepdims=True)
    across = np.cross(down, rng.normal(size=(n, 3)))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    nadir = np.radians(nadir_deg) * np.sqrt(rng.random(n))[:, np.newaxis]
    deepest_m = (sensor_m + 500.0) / np.cos(nadir.reshape(n))
    range_m = np.minimum(rng.uniform(20.0, up_to_m, n), deepest_m)[:, np.newaxis]
    return origin, origin + range_m * (np.cos(nadir) * down + np.sin(nadir) * across), down


def heights(points_e: FloatArray) -> FloatArray:
    x, y, z = points_e.T
    _, _, above_m = TO_GEODETIC.transform(x, y, z)
    return np.asarray(above_m)


def lengths(vectors: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.norm(vectors, axis=1))


# ------------------------------------------------------------------------------------------------- refractivity


@pytest.mark.parametrize(
    ("wavelength_nm", "sheet_ppm"), [(532, 289.4238), (905, 278.0041), (1064, 276.3942), (1550, 274.1915)]
)
def test_group_refractivity_matches_the_formula_sheet(wavelength_nm: float, sheet_ppm: float) -> None:
    assert float(group_refractivity_ppm(wavelength_nm, 288.15, 1013.25, 10.0)) == pytest.approx(sheet_ppm, abs=5e-5)


def test_cold_thin_air_matches_the_formula_sheet() -> None:
    assert float(group_refractivity_ppm(1064.0, 263.15, 850.0, 2.0)) == pytest.approx(254.16416, abs=5e-6)


@pytest.mark.parametrize(
    ("wavelength_nm", "sheet_ppm"), [(532, 305.730085), (905, 293.683234), (1064, 291.984975), (1550, 289.661246)]
)
def test_standard_refractivity_matches_the_formula_sheet(wavelength_nm: float, sheet_ppm: float) -> None:
    assert float(group_refractivity_ppm(wavelength_nm, 273.15, 1013.25, 0.0)) == pytest.approx(sheet_ppm, abs=5e-7)


def test_sensitivities_match_the_formula_sheet() -> None:
    def at(temperature_c: float = 15.0, pressure_hpa: float = 1013.25, vapour_hpa: float = 10.0) -> float:
        return float(group_refractivity_ppm(1064.0, temperature_c + 273.15, pressure_hpa, vapour_hpa))

    assert (at(temperature_c=15.01) - at(temperature_c=14.99)) / 0.02 == pytest.approx(-0.9592, abs=5e-5)
    assert at() / 1013.25 == pytest.approx(0.2728, abs=5e-5)  # the sheet's dN/dP, without water vapour
    assert at(pressure_hpa=1013.75) - at(pressure_hpa=1012.75) == pytest.approx(0.273, abs=5e-4)
    assert at(vapour_hpa=10.5) - at(vapour_hpa=9.5) == pytest.approx(-0.03911, abs=5e-6)


def test_vapour_pressure_matches_the_formula_sheet() -> None:
    assert float(saturated_hpa(20.0)) == pytest.approx(23.32596, abs=5e-6)


def test_standard_atmosphere_matches_the_standard() -> None:
    # ISO 2533, table 5: geopotential heights; two of them above the tropopause
    temperature_k, pressure_hpa = standard_air([-500.0, 2000.0, 11_000.0, 15_000.0, 20_000.0])
    np.testing.assert_allclose(temperature_k, [291.4, 275.15, 216.65, 216.65, 216.65], rtol=0, atol=1e-9)
    np.testing.assert_allclose(pressure_hpa, [1074.78, 794.952, 226.32, 120.446, 54.7489], rtol=6e-6)


@pytest.mark.parametrize("known_m", [-200.0, 480.0, 11_500.0])
def test_air_through_a_measurement_reproduces_it(known_m: float) -> None:
    temperature_k, pressure_hpa = standard_air(known_m, known_m, 240.0, 321.0)
    assert (float(temperature_k), float(pressure_hpa)) == pytest.approx((240.0, 321.0), rel=1e-14)
    below, above = standard_air([known_m - 1.0, known_m + 1.0], known_m, 240.0, 321.0)[1]
    assert (above - below) / 2.0 == pytest.approx(-0.0341632 * 321.0 / 240.0, rel=1e-4)


def test_path_means_match_the_formula_sheet() -> None:
    # the sheet uses the air of NGA Eq. 10 and 11
    table = _table(lambda height_m: 1e-6 * group_refractivity_ppm(1064.0, *layer_air(height_m), 0.0))
    out = np.empty(4)
    means(table, np.array([3000.0, 3000.0, 200.0, 1600.0]), np.array([200.0, 3000.0, 200.0, 1600.0]), out)
    mean_ppm, high, low, middle = 1e6 * out
    assert mean_ppm == pytest.approx(237.5689, abs=5e-5)
    assert 0.5 * (high + low) == pytest.approx(238.73993, abs=5e-6)
    assert middle == pytest.approx(236.98348, abs=5e-6)


@pytest.mark.parametrize("keys", [{}, MEASURED, MEASURED | {"humidity_percent": 100.0, "temperature_c": 38.0}])
@pytest.mark.parametrize(("from_m", "to_m"), [(3000.0, 200.0), (12_500.0, -400.0), (510.0, 509.5), (740.0, 760.0)])
def test_path_means_are_exact(keys: dict[str, Any], from_m: float, to_m: float) -> None:
    def refractivity(height_m: float) -> float:
        if not keys:
            return 1e-6 * float(group_refractivity_ppm(1064.0, *standard_air(height_m), 0.0))
        known = 480.0, keys["temperature_c"] + 273.15, 955.0
        temperature_k, pressure_hpa = standard_air(height_m, *known)
        vapour_hpa = 0.01 * keys.get("humidity_percent", 50.0) * saturated_hpa(temperature_k - 273.15)
        return 1e-6 * float(group_refractivity_ppm(1064.0, temperature_k, pressure_hpa, vapour_hpa))

    kink = [11_000.0] if from_m > 11_000.0 else None
    exact = quad(refractivity, to_m, from_m, points=kink, epsabs=1e-13, epsrel=1e-13)[0] / (from_m - to_m)
    assert float(Air(**keys).mean_refractivity(from_m, to_m)[0]) == pytest.approx(exact, abs=1e-12)


@pytest.mark.parametrize("wavelength_nm", [905.0, 1064.0, 1550.0])
@pytest.mark.parametrize("keys", [{}, MEASURED])
def test_path_means_match_ciddor_of_the_simulator(keys: dict[str, Any], wavelength_nm: float) -> None:
    high, low = np.array([900.0, 3000.0, 5000.0]), np.array([400.0, 150.0, 2000.0])
    simulated = SimulatedAir(AtmosphereTable(**keys), wavelength_nm).group_refractivity_ppm(high, low)
    mean = 1e6 * Air(wavelength_nm=wavelength_nm, **keys).mean_refractivity(high, low)
    np.testing.assert_allclose(mean, simulated, rtol=0, atol=0.1)  # the closed form's own accuracy


# -------------------------------------------------------------------------------------------------------- ranges


@pytest.mark.parametrize("keys", [{}, MEASURED])
def test_vacuum_ranges_are_corrected_to_the_path_of_the_simulator(keys: dict[str, Any]) -> None:
    origin, true_points, _ = beams(3 * BLOCK + 7, up_to_m=6000.0)
    air = Air(ranges="vacuum", **keys)
    index = 1.0 + air.mean_refractivity(heights(origin), heights(true_points))
    points = origin + (true_points - origin) * index[:, np.newaxis]
    air.apply(origin, points)
    range_m = lengths(true_points - origin)
    assert np.abs(lengths(points - origin) / range_m - 1.0).max() < 1e-9
    np.testing.assert_allclose(points, true_points, rtol=0, atol=6e-6)


def test_the_correction_at_one_kilometre_matches_the_formula_sheet() -> None:
    # 15 °C, 1013.25 hPa and 10 hPa of vapour along a level path change 1000 m in real air by −0.27632 m
    humidity = 100.0 * 10.0 / float(saturated_hpa(15.0))
    air = Air("vacuum", "measured", 15.0, 1013.25, humidity, 0.0)
    origin = np.array([[6_378_137.0, 0.0, 0.0]])
    points = origin + np.array([0.0, 1000.0, 0.0])
    air.apply(origin, points)
    assert float(points[0, 1]) - 1000.0 == pytest.approx(-0.276317853, abs=2e-5)  # at the far end 0.08 m higher


def test_the_index_assumed_by_an_instrument_is_removed() -> None:
    origin, points, _ = beams(40)
    plain, other = points.copy(), points.copy()
    Air(ranges="vacuum").apply(origin, plain)
    Air(ranges="vacuum", reference_index=1.000_274).apply(origin, other)
    ratio = lengths(other - origin) / lengths(plain - origin)
    np.testing.assert_allclose(ratio, 1.000_274, rtol=0, atol=3e-8)  # it ends a metre lower, in denser air


def test_only_the_measured_path_is_corrected() -> None:
    origin, points, _ = beams(40)
    travelled = lengths(points - origin) - 7.0
    part = points.copy()
    air = Air(ranges="vacuum")
    air.apply(origin, part, travelled)
    index = 1.0 + air.mean_refractivity(heights(origin), heights(part))
    wanted = 7.0 + travelled / index
    np.testing.assert_allclose(lengths(part - origin), wanted, rtol=1e-9)


# ------------------------------------------------------------------------------------------------------- bending


def bent_by(air: Air, origin: FloatArray, points: FloatArray, down: FloatArray) -> FloatArray:
    """Return angles (n,), rad, by which `apply` turned beams: positive towards nadir, in a beam's vertical plane."""
    moved = points.copy()
    air.apply(origin, moved)
    before, after = points - origin, moved - origin
    np.testing.assert_allclose(lengths(after), lengths(before), rtol=0, atol=3e-9)
    out_of_plane = np.einsum("ni,ni->n", np.cross(before, down), after) / lengths(before)
    assert np.abs(out_of_plane).max() < 1e-8
    across = before - np.einsum("ni,ni->n", before, down)[:, np.newaxis] * down
    across /= lengths(across)[:, np.newaxis]

    def nadir(vectors: FloatArray) -> FloatArray:
        return np.asarray(np.arctan2(np.einsum("ni,ni->n", vectors, across), np.einsum("ni,ni->n", vectors, down)))

    return np.asarray(nadir(before) - nadir(after))


def turned_towards(direction: FloatArray, down: FloatArray, bent_rad: FloatArray) -> FloatArray:
    """Return unit vectors (n, 3) turned about the horizontal towards nadir by angles (n,), rad, computed by SciPy."""
    axis = np.cross(direction, down)
    axis /= lengths(axis)[:, np.newaxis]
    turned: FloatArray = Rotation.from_rotvec(bent_rad[:, np.newaxis] * axis).apply(direction)
    return turned


def test_ardc_bending_matches_the_formula_sheet() -> None:
    """The sheet gives 10.872107 µrad, 34.47 mm on the ground, for a beam 20° from nadir from 3 km to 200 m."""
    top, foot = 6_378_137.0 + 3000.0, 6_378_137.0 + 200.0
    nadir = np.radians(20.0)
    range_m = top * np.cos(nadir) - np.sqrt(foot**2 - (top * np.sin(nadir)) ** 2)
    origin = np.array([[top, 0.0, 0.0]])
    points = origin + range_m * np.array([[-np.cos(nadir), np.sin(nadir), 0.0]])  # along the equator, a circle
    bent = bent_by(Air(refraction="ardc"), origin, points, np.array([[-1.0, 0.0, 0.0]]))
    assert 1e6 * bent[0] == pytest.approx(10.87210664, abs=2e-3)
    moved = points.copy()
    Air(refraction="ardc").apply(origin, moved)
    down_m = -(moved - origin)[0, 0]
    assert (points[0, 1] - moved[0, 1] * (origin - points)[0, 0] / down_m) == pytest.approx(0.0344745, abs=5e-5)


def test_ardc_bending_follows_its_formula() -> None:
    origin, points, down = beams(300, up_to_m=4000.0)
    ground_m = heights(points)
    keep = (ground_m > 0.0) & (lengths(points - origin) > 1000.0)  # at less, rounding exceeds 1e-9 rad
    origin, points, down = origin[keep], points[keep], down[keep]
    along = (points - origin) / lengths(points - origin)[:, np.newaxis]
    tan = np.tan(np.arccos(np.einsum("ni,ni->n", along, down)))
    wanted = ardc_k(heights(origin), ground_m[keep]) * tan
    np.testing.assert_allclose(bent_by(Air(refraction="ardc"), origin, points, down), wanted, rtol=0, atol=2e-9)
    moved = points.copy()
    Air(refraction="ardc").apply(origin, moved)
    exact = origin + lengths(points - origin)[:, np.newaxis] * turned_towards(along, down, wanted)
    np.testing.assert_allclose(moved, exact, rtol=0, atol=3e-6)


@pytest.mark.parametrize(("sensor_m", "ground_m"), [(400.0, 0.0), (3000.0, 200.0), (6000.0, -100.0), (10_000.0, 500.0)])
def test_layer_bending_equals_the_exact_integral(sensor_m: float, ground_m: float) -> None:
    # Eq. 6 to 8 give the place where the beam lands; the triangle with the earth's centre gives its distance
    constant = layer_constant_ppm(1064.0)
    nadir = np.radians([0.5, 10.0, 30.0, 45.0, 60.0, 70.0, 75.0 if sensor_m < 9000.0 else 70.0])
    wanted = spherical_bending(nadir, sensor_m, ground_m, constant)
    chord = nadir - wanted
    top, bottom = SPHERE_M + sensor_m, SPHERE_M + ground_m
    range_m = top * np.cos(chord) - np.sqrt(bottom**2 - (top * np.sin(chord)) ** 2)
    # on the ellipsoid, the place is one where the mean radius equals the sphere's
    lat = brentq(lambda lat: 6_356_752.314245 / (1 - 0.00669437999014 * np.sin(lat) ** 2) - SPHERE_M, 0.3, 1.0)
    origin = np.array([TO_E.transform(0.0, np.degrees(lat), sensor_m)] * len(nadir))
    down = np.array([-np.cos(lat), 0.0, -np.sin(lat)])
    direction = np.outer(np.cos(nadir), down) + np.outer(np.sin(nadir), [0.0, 1.0, 0.0])
    points = origin + range_m[:, np.newaxis] * direction
    got = bent_by(Air(refraction="spherical"), origin, points, np.broadcast_to(down, points.shape))
    np.testing.assert_allclose(got, wanted, rtol=0, atol=1e-9 + 4e-9 / range_m.min())


def test_ardc_refuses_points_below_sea_level() -> None:
    origin = np.array([[6_378_137.0 + 2000.0, 0.0, 0.0], [6_378_137.0 - 100.0, 0.0, 0.0]])
    direction = np.array([-np.cos(0.5), np.sin(0.5), 0.0])
    points = origin + np.array([[2400.0 / np.cos(0.5)], [300.0]]) * direction  # from 2000 m to −400 m; and below 0 m
    got = bent_by(Air(refraction="ardc"), origin, points, np.tile([-1.0, 0.0, 0.0], (2, 1)))
    assert got[0] == pytest.approx(float(ardc_k(2000.0, 0.0)) * np.tan(0.5), abs=2e-9)
    assert got[1] == pytest.approx(0.0, abs=1e-10)


def test_layers_bend_level_and_rising_beams_downward() -> None:
    # a ray's radius of curvature is n / (−n' sin ψ), and its chord leaves it by half the path over this radius
    origin = np.array([[6_378_137.0 + 500.0, 0.0, 0.0]] * 3)
    nadir = np.radians([89.0, 90.0, 91.0])
    points = origin + 2000.0 * np.stack([-np.cos(nadir), np.sin(nadir), np.zeros(3)], axis=1)
    got = bent_by(Air(refraction="spherical"), origin, points, np.tile([-1.0, 0.0, 0.0], (3, 1)))
    gradient = 4.256 * 0.0065 / 284.9 * 77.926e-6 * 955.5 / 284.9
    np.testing.assert_allclose(got, 0.5 * 2000.0 * gradient, rtol=0.01)


def test_bending_matches_the_simulator() -> None:
    origin, points, down = beams(400, nadir_deg=75.0, up_to_m=6000.0)
    for refraction in ("ardc", "spherical"):
        along = (points - origin) / lengths(points - origin)[:, np.newaxis]
        simulated = SimulatedAir(AtmosphereTable.model_validate({"refraction": refraction}), 1064.0)
        wanted = simulated.bend(along, down, heights(origin), heights(points))
        moved = points.copy()
        Air(refraction=refraction).apply(origin, moved)
        keep = heights(points) > 0.0
        missed = lengths(moved - origin - lengths(points - origin)[:, np.newaxis] * wanted)[keep]
        assert missed.max() < 1e-4  # Ciddor's constant differs from the closed form's by 0.03 %
    assert lengths(points - moved).max() > 0.1


def test_slowing_and_bending_act_together() -> None:
    origin, true_points, down = beams(200, nadir_deg=50.0)
    air = Air(ranges="vacuum", refraction="spherical")
    chord = (true_points - origin) / lengths(true_points - origin)[:, np.newaxis]
    index = 1.0 + air.mean_refractivity(heights(origin), heights(true_points))
    first, range_m = chord, lengths(true_points - origin)[:, np.newaxis]
    for _ in range(3):  # iterate until the first directions lead to these chords
        bent = bent_by(Air(refraction="spherical"), origin, origin + range_m * first, down)
        first = turned_towards(chord, down, -bent)
    points = origin + (lengths(true_points - origin) * index)[:, np.newaxis] * first
    air.apply(origin, points)
    np.testing.assert_allclose(points, true_points, rtol=0, atol=6e-6)


# -------------------------------------------------------------------------------------------------- what it does


def test_the_defaults_change_no_bit() -> None:
    origin, points, _ = beams(50)
    before = points.tobytes()
    air = Air()
    air.apply(origin, points)
    assert points.tobytes() == before
    assert not air.corrects_range
    assert not air.bends


def test_a_point_depends_on_itself_alone() -> None:
    origin, points, _ = beams(2 * BLOCK + 5)
    air = Air(ranges="vacuum", refraction="spherical")
    whole = points.copy()
    air.apply(origin, whole)
    for start, stop in ((0, 1), (1, 4), (4, BLOCK + 9), (BLOCK + 9, len(points))):
        part = points[start:stop].copy()
        air.apply(origin[start:stop], part)
        assert part.tobytes() == whole[start:stop].tobytes()


def test_rows_without_points_are_harmless() -> None:
    origin, points, _ = beams(6)
    lonely = points[1:2].copy()
    origin[0], points[2] = np.nan, np.nan
    points[3], points[4], origin[5] = origin[3], 1e300, np.inf
    air = Air(ranges="vacuum", refraction="spherical")
    air.apply(origin, points)
    air.apply(origin[1:2], lonely)
    np.testing.assert_array_equal(points[1], lonely[0])
    np.testing.assert_array_equal(points[3], origin[3])


def test_vertical_beams_and_beams_at_the_poles_are_not_bent() -> None:
    origin = np.array([[0.0, 0.0, 6_356_752.3 + 2000.0], [0.0, 0.0, -6_356_752.3 - 2000.0], [6_380_137.0, 0.0, 0.0]])
    points = origin * (1.0 - 1900.0 / 6_378_000.0)
    for refraction in ("ardc", "spherical"):
        moved = points.copy()
        Air(refraction=refraction).apply(origin, moved)
        np.testing.assert_allclose(moved, points, rtol=0, atol=2e-9)


def test_effects_at_the_swath_edge_match_the_exact_integrals() -> None:
    half_rad = np.radians(30.0)
    ground_m, above_m = 200.0, 2800.0
    described: list[dict[str, Any]] = [{"refraction": "ardc"}, {"refraction": "spherical", "ranges": "vacuum"}, {}]
    for keys in described:
        air = Air(**keys)
        effect = air.at_edge(above_m, half_rad, ground_m)
        exact = spherical_bending(half_rad, 3000.0, 200.0, layer_constant_ppm(1064.0))
        bent = ardc_k(3000.0, 200.0) * np.tan(half_rad) if keys.get("refraction") == "ardc" else exact
        assert effect.bending_m == pytest.approx(float(bent) * above_m / np.cos(half_rad), rel=1e-6)
        mean = quad(lambda z: group_refractivity_ppm(1064.0, *standard_air(z), 0.0), 200.0, 3000.0)[0] / 2800.0
        assert effect.range_m == pytest.approx(1e-6 * mean * above_m / np.cos(half_rad), rel=1e-9)
        assert (air.warning(above_m, half_rad, ground_m) is None) == ("refraction" in keys)
    assert Air().warning(300.0, half_rad, 100.0) is None  # 0.7 mm
    flat = Air(refraction="ardc").at_edge(100.0, 0.5 * np.pi), Air().at_edge(0.0, 1.0)
    assert np.isfinite([flat[0].bending_m, flat[0].range_m, flat[1].bending_m]).all()
    line = Air().warning(2800.0, half_rad, 200.0)
    assert line is not None
    assert "58.9 mm" in line
    assert "\n" not in line


@pytest.mark.parametrize(
    ("keys", "says"),
    [
        ({"ranges": "none"}, "ranges: got 'none', want one of corrected, vacuum"),
        ({"model": "us76"}, "model: got 'us76', want one of standard, measured"),
        ({"refraction": "flat"}, "refraction: got 'flat', want one of none, ardc, spherical"),
        ({"wavelength_nm": 1.064}, "wavelength_nm: got 1.064, want"),
        ({"reference_index": 0.99}, "reference_index: got 0.99, want"),
    ],
)
def test_impossible_air_is_refused(keys: dict[str, Any], says: str) -> None:
    with pytest.raises(AtmosphereError, match=says):
        Air(**keys)


def test_a_pickled_air_gives_the_same_points() -> None:
    origin, points, _ = beams(10)
    air = Air(ranges="vacuum", refraction="ardc", wavelength_nm=1550.0, **MEASURED)
    other = points.copy()
    air.apply(origin, points)
    pickle.loads(pickle.dumps(air)).apply(origin, other)
    assert other.tobytes() == points.tobytes()
