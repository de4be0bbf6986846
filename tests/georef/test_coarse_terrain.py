"""Tests the coarse terrain model: heights by SciPy, and beams that end where they were aimed."""

from __future__ import annotations

import numpy as np
import pytest
from pyproj import Transformer
from scipy.interpolate import RegularGridInterpolator

from swath.georef.arrays import FloatArray
from swath.georef.coarse_terrain import CoarseTerrain, TerrainError

pytestmark = pytest.mark.xdist_group("kernels")

TO_E = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
FIRST_DEG, STEP_DEG = (8.9, 47.6), (0.001, -0.0008)  # west to east, north to south, as rasters come


def hills(rows: int = 160, columns: int = 130) -> FloatArray:
    row, column = np.mgrid[:rows, :columns]
    height: FloatArray = 500.0 + 120.0 * np.sin(row / 9.0) * np.cos(column / 7.0)
    return height


def terrain(height_m: FloatArray) -> CoarseTerrain:
    first, step = (tuple(np.radians(pair)) for pair in (FIRST_DEG, STEP_DEG))
    return CoarseTerrain(height_m, (first[0], first[1]), (step[0], step[1]))


def aimed(n: int, height_m: FloatArray, sensor_m: float, aside_deg: float) -> tuple[FloatArray, FloatArray]:
    """Return sensors and ground places beside them, (n, 3) each: longitude, latitude in degrees, height in m."""
    rng = np.random.default_rng(2)
    grid = RegularGridInterpolator((np.arange(height_m.shape[0]), np.arange(height_m.shape[1])), height_m)
    row, column = rng.uniform(40, 120, n), rng.uniform(40, 90, n)
    ground = [FIRST_DEG[0] + STEP_DEG[0] * column, FIRST_DEG[1] + STEP_DEG[1] * row, grid((row, column))]
    aside = aside_deg * rng.uniform(-1, 1, (2, n))
    return np.stack([ground[0] + aside[0], ground[1] + aside[1], np.full(n, sensor_m)], 1), np.stack(ground, 1)


def test_heights_are_interpolated_bilinearly() -> None:
    height_m, rng = hills(), np.random.default_rng(1)
    row, column = rng.uniform(0, 159, 500), rng.uniform(0, 129, 500)
    row[:2], column[:2] = (0, 159), (129, 0)  # includes corners
    lat, lon = np.radians(FIRST_DEG[1] + STEP_DEG[1] * row), np.radians(FIRST_DEG[0] + STEP_DEG[0] * column)
    wanted = RegularGridInterpolator((np.arange(160), np.arange(130)), height_m)((row, column))
    inner = slice(2, None)
    np.testing.assert_allclose(terrain(height_m).height_at(lat, lon)[inner], wanted[inner], rtol=0, atol=1e-6)
    outside = terrain(height_m).height_at(lat + np.radians(1.0), lon)
    assert np.isnan(outside).all()


@pytest.mark.parametrize("step_deg", [0.001, -0.001])
@pytest.mark.parametrize("middle_deg", [0.0, 180.0, -180.0, 360.0])
def test_a_grid_across_the_antimeridian_is_continuous(middle_deg: float, step_deg: float) -> None:
    height_m = hills()
    first, step = (np.radians(middle_deg - 64.5 * step_deg), np.radians(47.6)), np.radians((step_deg, -0.0008))
    model = CoarseTerrain(height_m, first, (step[0], step[1]))
    column = np.linspace(0.5, 128.5, 50)
    lat, lon = np.full(50, first[1] + 80 * step[1]), first[0] + column * step[0]
    wanted = np.interp(column, np.arange(130), height_m[80])
    for turns in (-1, 0, 1):
        np.testing.assert_allclose(model.height_at(lat, lon + 2 * np.pi * turns), wanted, rtol=0, atol=1e-6)
    beside = first[0] + np.array([-1.0, 130.0]) * step[0]
    assert np.isnan(model.height_at(lat[:2], (beside + np.pi) % (2 * np.pi) - np.pi)).all()


def test_a_grid_round_the_earth_has_no_seam() -> None:
    height_m = np.tile(np.arange(36.0), (2, 1))
    model = CoarseTerrain(
        height_m, tuple(np.radians((5.0, 40.0))), tuple(np.radians((10.0, 10.0)))
    )  # centres of pixels
    lon = np.radians([5.0, 355.0, -5.0, 357.5, -2.5, 0.0, 360.0, 2.5])
    np.testing.assert_allclose(
        model.height_at(np.full(8, np.radians(45.0)), lon), [0, 35, 35, 26.25, 26.25, 17.5, 17.5, 8.75]
    )


def test_holes_are_not_filled() -> None:
    height_m = hills()
    height_m[80, 60] = np.nan
    lat, lon = np.radians(FIRST_DEG[1] + STEP_DEG[1] * 80.4), np.radians(FIRST_DEG[0] + STEP_DEG[0] * 60.4)
    assert np.isnan(terrain(height_m).height_at(lat, lon))


def test_beams_end_at_their_targets() -> None:
    height_m = hills()
    sensors, ground = aimed(600, height_m, 1900.0, 0.006)
    origin, target = (np.stack(TO_E.transform(*place.T), axis=1) for place in (sensors, ground))
    range_m = np.linalg.norm(target - origin, axis=1)
    direction = (target - origin) / range_m[:, np.newaxis]
    found = terrain(height_m).predicted_m(origin, direction)
    assert np.isfinite(found).all()
    assert np.abs(found - range_m).max() < 2.0
    assert np.ptp(range_m) > 150.0


def test_beams_on_steep_slopes_end_on_the_ground() -> None:
    row, column = np.mgrid[:160, :130]
    height_m = 900.0 + 600.0 * np.sin(row / 4.0) * np.cos(column / 3.0)  # steeper than 60°
    sensors, ground = aimed(600, height_m, 2600.0, 0.012)
    origin, target = (np.stack(TO_E.transform(*place.T), axis=1) for place in (sensors, ground))
    direction = (target - origin) / np.linalg.norm(target - origin, axis=1, keepdims=True)
    model = terrain(height_m)
    found = model.predicted_m(origin, direction)
    assert np.isfinite(found).mean() > 0.95
    x, y, z = (origin + found[:, np.newaxis] * direction).T
    lon, lat, above_m = TO_E.transform(x, y, z, direction="INVERSE")
    missed = np.abs(above_m - model.height_at(np.radians(lat), np.radians(lon)))
    assert np.nanmax(missed) < 1.0


def test_a_grid_in_map_coordinates_is_supported() -> None:
    to_map = Transformer.from_crs("EPSG:4326", "EPSG:32632", always_xy=True)

    def to_grid(lat_rad: FloatArray, lon_rad: FloatArray) -> tuple[FloatArray, FloatArray]:
        x, y = to_map.transform(np.degrees(lon_rad), np.degrees(lat_rad))
        return np.asarray(x), np.asarray(y)

    east, north = to_map.transform(8.95, 47.55)
    model = CoarseTerrain([[400.0, 500.0], [400.0, 500.0]], (east, north), (1000.0, -1000.0), to_grid)
    lon, lat = to_map.transform(east + 300.0, north - 700.0, direction="INVERSE")
    assert float(model.height_at(np.radians([lat]), np.radians([lon]))[0]) == pytest.approx(430.0, abs=1e-3)


def test_beams_that_miss_the_terrain_have_no_predicted_range() -> None:
    height_m = hills()
    sensors, _ = aimed(3, height_m, 1900.0, 0.001)
    origin = np.stack(TO_E.transform(*sensors.T), axis=1)
    up = origin / np.linalg.norm(origin, axis=1, keepdims=True)
    level = np.cross(up, [0.0, 0.0, 1.0])
    level /= np.linalg.norm(level, axis=1, keepdims=True)
    far = 0.2 * -up + np.sqrt(0.96) * level  # 8 km aside: off the grid
    for direction in (up, level, far):
        assert np.isnan(terrain(height_m).predicted_m(origin, direction)).all()


@pytest.mark.parametrize(
    ("height_m", "step", "says"), [([[1.0, 2.0]], (1.0, 1.0), "shape"), (np.zeros((3, 3)), (1.0, 0.0), "steps")]
)
def test_impossible_grids_are_refused(height_m: FloatArray, step: tuple[float, float], says: str) -> None:
    with pytest.raises(TerrainError, match=says):
        CoarseTerrain(height_m, (0.0, 0.0), step)
