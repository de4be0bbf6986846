"""Tests the surface around points, and what it adds to sigmas, on ground whose slopes and noise are known."""

from __future__ import annotations

import numpy as np
import pytest

from swath.georef.arrays import FloatArray
from swath.georef.points import Points
from swath.georef.scanner.uncertainty import Noise
from swath.georef.surface.local import LocalSurface
from swath.georef.surface.planes import LEVEL_GROUND, ROUGH, STEEPEST_RAD, least_axis

pytestmark = pytest.mark.xdist_group("kernels")

NOISE = Noise(range_m=0.02, angle_rad=0.0, divergence_rad=3e-4)
SIGMA_M = 0.03  # of the other errors, in each coordinate
METRES = np.ones(3)


def beam(off_nadir_deg: float) -> FloatArray:
    """Return the direction of a beam that points right of the nadir, towards easting."""
    angle = np.radians(off_nadir_deg)
    return np.array([np.sin(angle), 0.0, -np.cos(angle)])


def points_on(places: FloatArray, direction: FloatArray, range_m: float) -> Points:
    """Return points (n, 3) with range noise, seen along one direction."""
    n = len(places)
    noise = np.random.default_rng(3).normal(0.0, NOISE.range_m, n)
    points = Points.empty(n, with_sigmas=True, with_beams=True, with_covariances=True)
    points.points_map[:] = places + noise[:, np.newaxis] * direction + [500_000.0, 5_300_000.0, 400.0]
    points.time_ns[:] = np.arange(n) * 10_000
    points.range_m[:] = range_m
    for name, value in {"sigma_map": SIGMA_M, "beam_map": direction, "covariance_map": 0.0}.items():
        getattr(points, name)[:] = value
    points.range_sigma_m = np.full(n, NOISE.range_m, np.float32)
    return points


def field(slope_deg: float = 0.0, count: int = 20_000, size_m: float = 70.0, seed: int = 1) -> FloatArray:
    """Return places (n, 3) on a plane that rises towards easting, in the order of northing."""
    rng = np.random.default_rng(seed)
    east, north = rng.uniform(0.0, size_m, (2, count))
    return np.stack([east, np.sort(north), np.tan(np.radians(slope_deg)) * east], axis=1)


def applied(points: Points, noise: Noise = NOISE, unit_m: FloatArray = METRES) -> LocalSurface:
    """Let points be their own surface."""
    surface = LocalSurface(noise, unit_m)
    surface.begin(points)
    surface.add(points)
    surface.apply(points)
    return surface


def added_m(points: Points) -> FloatArray:
    """Return what was added along the beams (n,), one sigma."""
    assert points.range_sigma_m is not None
    variance: FloatArray = points.range_sigma_m.astype(np.float64) ** 2 - NOISE.range_m**2
    return np.sqrt(np.maximum(variance, 0.0))


def test_flat_ground_1000_m_below_adds_5_cm_at_30_degrees() -> None:
    """1000 m is the height: the range is 1000 / cos 30°, and 0.3 mrad · 1154.7 m · tan 30° / 4 = 5.0 cm."""
    points = points_on(field(), beam(30.0), 1000.0 / np.cos(np.radians(30.0)))
    surface = applied(points)
    assert surface.size_m == 2.0
    assert surface.planes > 0.999 * len(points)
    assert np.median(added_m(points)) == pytest.approx(0.050, abs=2e-4)
    assert points.incidence_rad is not None
    assert np.median(np.degrees(points.incidence_rad)) == pytest.approx(30.0, abs=0.05)
    assert points.sigma_map is not None
    assert points.covariance_map is not None
    middle = np.median(points.sigma_map, axis=0)
    expected = np.hypot(SIGMA_M, 0.050 * np.abs(beam(30.0)))
    np.testing.assert_allclose(middle, expected, atol=2e-4)
    np.testing.assert_allclose(
        np.median(points.covariance_map, axis=0),
        0.050**2 * np.outer(beam(30.0), beam(30.0))[np.triu_indices(3)],
        atol=2e-5,
    )


@pytest.mark.parametrize("off_nadir_deg", [0.0, 20.0])
def test_points_on_a_roof_of_45_degrees_get_the_sigmas_of_its_slope(off_nadir_deg: float) -> None:
    roof = field(45.0)
    level = field(seed=2) - [100.0, 0.0, 0.0]
    points = points_on(np.concatenate([level, roof]), beam(off_nadir_deg), 800.0)
    applied(points)
    for part, incidence_deg in ((slice(20_000), off_nadir_deg), (slice(20_000, None), 45.0 - off_nadir_deg)):
        right_m = 0.25 * 3e-4 * 800.0 * np.tan(np.radians(incidence_deg))
        assert np.median(added_m(points)[part]) == pytest.approx(right_m, abs=0.002)


def test_a_ridge_belongs_to_the_slopes_beside_it() -> None:
    both = field()
    both[:, 2] = -np.abs(both[:, 0] - 35.0) * np.tan(np.radians(35.0))
    points = points_on(both, beam(0.0), 800.0)
    applied(points)
    right_m = 0.25 * 3e-4 * 800.0 * np.tan(np.radians(35.0))
    near = np.abs(both[:, 0] - 35.0) < 1.0
    assert np.quantile(added_m(points)[near], 0.02) > 0.8 * right_m
    assert np.median(added_m(points)[near]) == pytest.approx(right_m, rel=0.15)


def test_a_wall_is_a_plane_and_its_incidence_ends_at_80_degrees() -> None:
    rng = np.random.default_rng(5)
    wall = np.stack([np.full(4000, 3.3), rng.uniform(0, 20, 4000), rng.uniform(0, 12, 4000)], axis=1)
    points = points_on(wall, beam(5.0), 300.0)
    surface = applied(points)
    assert surface.planes > 0.99 * len(points)
    assert surface.steep > 0.99 * len(points)
    assert points.incidence_rad is not None
    assert np.median(np.degrees(points.incidence_rad)) == pytest.approx(85.0, abs=0.2)
    most_m = 0.25 * 3e-4 * 300.0 * np.tan(STEEPEST_RAD)
    assert added_m(points).max() == pytest.approx(most_m, rel=1e-4)
    assert np.median(added_m(points)) == pytest.approx(most_m, rel=1e-4)


def test_points_on_no_plane_get_the_slope_that_their_roughness_allows() -> None:
    """A crown's points fill their cube evenly: 1 + 3 in tan², at the nadir, within the scatter of few points."""
    crown = np.random.default_rng(6).uniform(0.0, 8.0, (3000, 3))
    points = points_on(crown, beam(0.0), 1000.0)
    surface = applied(points)
    assert surface.rough > 0.95 * len(points)
    assert points.surface is not None
    rough = points.surface == ROUGH
    assert 0.25 * 3e-4 * 1000.0 < np.median(added_m(points)[rough]) <= 0.25 * 3e-4 * 1000.0 * 2.0


def test_few_points_lie_on_level_ground() -> None:
    alone = np.array([[0.0, 0.0, 0.0], [300.0, 0.0, 5.0], [0.0, 400.0, 50.0], [900.0, 0.0, 0.0]])
    points = points_on(alone, beam(40.0), 600.0)
    surface = applied(points)
    assert surface.level == len(points)
    assert points.surface is not None
    assert set(points.surface) == {LEVEL_GROUND}
    np.testing.assert_allclose(added_m(points), 0.25 * 3e-4 * 600.0 * np.tan(np.radians(40.0)), rtol=1e-4)


def test_level_ground_is_taken_everywhere_if_asked() -> None:
    points = points_on(field(45.0, 500), beam(89.0), 100.0)
    surface = LocalSurface(NOISE, METRES, level=True)
    surface.add(points)
    surface.apply(points)
    assert (surface.planes, surface.level, surface.rough, surface.steep) == (0, 500, 0, 500)
    np.testing.assert_allclose(added_m(points), 0.25 * 3e-4 * 100.0 * np.tan(STEEPEST_RAD), rtol=1e-4)


def test_an_uncertain_plane_makes_sigmas_larger() -> None:
    """With the tilt's variance s², tan² i is larger by sec⁴ i · s²; here for nine points a metre apart.

    s² = σ² / (9 · 2/3 m²), the points' variance along each axis, and σ² = (2 cm · cos 60°)² + (7.5 cm · sin 60°)².
    """
    patches = np.arange(0.0, 4000.0, 16.0)
    grid = np.stack(np.meshgrid([0.5, 1.5, 2.5], [0.5, 1.5, 2.5], [0.1]), axis=-1).reshape(-1, 3)
    places = (patches[:, np.newaxis, np.newaxis] * [0.0, 1.0, 0.0] + grid).reshape(-1, 3)
    points = points_on(places, beam(60.0), 1000.0)
    points.points_map -= 0.9999 * (points.points_map - places - [500_000.0, 5_300_000.0, 400.0])  # no noise
    surface = applied(points)
    assert surface.planes == len(points)
    tilt_2 = (0.01**2 + 0.75 * 0.075**2) / (9 * 2.0 / 3.0)
    ratio = added_m(points) ** 2 / (0.075**2 * 3.0)
    np.testing.assert_allclose(ratio, 1.0 + 16.0 * tilt_2 / 3.0, atol=3e-4)


def test_pieces_and_forgotten_cubes_change_nothing() -> None:
    places = field(10.0, 40_000, 200.0)
    whole, pieces = (points_on(places, beam(10.0), 700.0) for _ in range(2))
    applied(whole)
    surface = LocalSurface(NOISE, METRES)
    surface.begin(pieces)
    for first in range(0, len(pieces), 1777):
        surface.add(pieces.take(slice(first, first + 1777)))
    surface.make_room(-1)
    parts = [pieces.take(slice(first, first + 999)) for first in range(0, len(pieces), 999)]
    for part in parts:
        surface.apply(part)
    again = Points.concatenate(parts)
    for name in ("sigma_map", "covariance_map", "incidence_rad", "surface"):
        np.testing.assert_array_equal(getattr(again, name), getattr(whole, name))


def test_the_table_of_cubes_grows_and_forgets() -> None:
    """Twenty kilometres of ground in cubes of 2 m are more than the table has room for."""
    north = np.repeat(np.arange(0.0, 20_000.0, 0.5), 4)
    east = np.tile([0.1, 0.6, 1.1, 1.6], len(north) // 4)
    points = points_on(np.stack([east, north, np.zeros(len(north))], axis=1), beam(20.0), 500.0)
    points.time_ns[:] = np.arange(len(points)) * 1_000_000
    surface = LocalSurface(NOISE, METRES)
    surface.begin(points)
    for first in range(0, len(points), 5000):
        part = points.take(slice(first, first + 5000))
        surface.add(part)
        surface.apply(part)
    assert surface.planes > 0.99 * len(points)
    cubes = surface._cubes
    assert cubes is not None
    assert len(cubes.keys) == 1 << 14


def test_feet_give_the_same_surface() -> None:
    feet = np.full(3, 0.3048)
    metres = points_on(field(25.0), beam(30.0), 900.0)
    in_feet = points_on(field(25.0), beam(30.0), 900.0)
    in_feet.points_map /= feet
    applied(metres)
    applied(in_feet, unit_m=feet)
    np.testing.assert_allclose(np.median(added_m(in_feet)), np.median(added_m(metres)), rtol=1e-3)


@pytest.mark.slow
def test_the_smallest_axis_is_that_of_numpy() -> None:
    rng = np.random.default_rng(8)
    for scale in ([1.0, 0.7, 0.02], [3.0, 0.1, 0.1], [1.0, 1.0, 1e-4], [2.0, 2.0, 2.0]):
        spread = rng.normal(size=(3, 3)) * scale
        matrix = spread.T @ spread
        values, vectors = np.linalg.eigh(matrix)
        least, middle, axis = least_axis(*matrix[np.triu_indices(3)])
        np.testing.assert_allclose([least, middle], values[:2], atol=1e-9)
        assert abs(vectors[:, 0] @ np.array(axis)) == pytest.approx(1.0, abs=1e-6)
    assert least_axis(1.0, 0.0, 0.0, 1.0, 0.0, 1.0) == (1.0, 1.0, (0.0, 0.0, 1.0))
    assert least_axis(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)[0] == 0.0
