"""Tests a coarse terrain model from a GeoTIFF."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from pyproj import Transformer
from rasterio.transform import Affine

from swath.daemon.errors import ConfigError
from swath.daemon.processing.setup.terrain import read_terrain
from swath.georef.geodesy.earth import e_from_geodetic, rot_e_from_l

pytestmark = pytest.mark.xdist_group("kernels")

EAST_M, NORTH_M = Transformer.from_crs("EPSG:4326", "EPSG:32632", always_xy=True).transform(8.9, 47.5)
LAT, LON = np.radians(47.5), np.radians(8.9)


def plane_m(east_m: Any, north_m: Any) -> Any:
    """Return heights, m, at distances east and north of the middle."""
    return 480.0 + 0.05 * north_m + 0.03 * east_m


def write(path: Path, **others: Any) -> None:
    """Write a raster of the plane `plane_m`: 30 m pixels, 3 km wide, 480 m high in the middle."""
    transform = Affine(30.0, 0.0, EAST_M - 1500.0, 0.0, -30.0, NORTH_M + 1500.0)
    from_west_m = 30.0 * (np.arange(100) + 0.5)
    values = plane_m(from_west_m[np.newaxis] - 1500.0, 1500.0 - from_west_m[:, np.newaxis])
    profile = {"crs": "EPSG:32632", "transform": transform} | others
    with rasterio.open(path, "w", driver="GTiff", width=100, height=100, count=1, dtype="float64", **profile) as file:
        file.write(values, 1)


def test_heights_and_ranges_match_the_plane(tmp_path: Path) -> None:
    write(tmp_path / "dem.tif")
    terrain = pickle.loads(pickle.dumps(read_terrain(tmp_path / "dem.tif")))
    to_geodetic = Transformer.from_crs("EPSG:32632", "EPSG:4326", always_xy=True)
    lon, lat = np.radians(to_geodetic.transform([EAST_M, EAST_M + 700.0], [NORTH_M, NORTH_M + 400.0]))
    np.testing.assert_allclose(terrain.height_at(lat, lon), [480.0, plane_m(700.0, 400.0)], atol=1e-6)
    origin_e = e_from_geodetic(LAT, LON, 1480.0)[np.newaxis]
    straight_down = rot_e_from_l(LAT, LON)[np.newaxis, :, 2]
    np.testing.assert_allclose(terrain.predicted_m(origin_e, straight_down), 1000.0, atol=1.0)


def test_heights_outside_and_in_holes_are_unknown(tmp_path: Path) -> None:
    write(tmp_path / "dem.tif", nodata=plane_m(15.0, 15.0))
    terrain = read_terrain(tmp_path / "dem.tif")
    assert np.isnan(terrain.height_at(np.array([LAT, np.radians(48.5)]), np.array([LON, LON]))).all()


@pytest.mark.parametrize("west_deg", [179.95, 359.95, -0.05])  # across 180° or Greenwich
def test_a_grid_in_degrees_continues_across_the_antimeridian(tmp_path: Path, west_deg: float) -> None:
    write(tmp_path / "dem.tif", crs="EPSG:4326", transform=Affine(0.001, 0.0, west_deg, 0.0, -0.001, 47.6))
    terrain = pickle.loads(pickle.dumps(read_terrain(tmp_path / "dem.tif")))
    north_m = 1500.0 - 30.0 * (47.6 - np.degrees(LAT + 0.001)) / 0.001
    for east_deg, turn_deg in ((0.02, 0.0), (0.08, 0.0), (0.08, -360.0), (0.08, 360.0)):
        found = terrain.height_at(np.array([LAT + 0.001]), np.radians([west_deg + east_deg + turn_deg]))
        np.testing.assert_allclose(found, plane_m(30.0 * east_deg / 0.001 - 1500.0, north_m), atol=1e-6)
    for lon_deg in (west_deg - 0.02, west_deg + 0.12):
        assert np.isnan(terrain.height_at(np.array([LAT + 0.001]), np.radians([lon_deg]))).all()


@pytest.mark.parametrize(
    ("others", "words"),
    [
        ({"crs": None}, "has no CRS; use a GeoTIFF with a CRS"),
        ({"transform": Affine(20.0, 10.0, 0.0, 10.0, -20.0, 0.0)}, "is rotated"),
        ({"transform": Affine(1e300, 0.0, 0.0, 0.0, -1.0, 0.0)}, r"has pixels of 1e\+300 × -1 from 0, 0 on"),
    ],
)
def test_unusable_terrain_is_refused(tmp_path: Path, others: dict[str, Any], words: str) -> None:
    write(tmp_path / "dem.tif", **others)
    with pytest.raises(ConfigError, match=words):
        read_terrain(tmp_path / "dem.tif")


def test_a_raster_without_a_location_is_refused() -> None:
    with pytest.raises(ConfigError, match="has no georeference; use a georeferenced GeoTIFF"):
        read_terrain(Path(__file__).parents[3] / "fuzz/seeds/terrain/nowhere")


def test_rasters_with_blocks_too_large_to_read_are_refused(tmp_path: Path) -> None:
    profile = {"crs": "EPSG:32632", "transform": Affine(30.0, 0.0, EAST_M, 0.0, -30.0, NORTH_M), "SPARSE_OK": True}
    blocks = {"tiled": True, "blockxsize": 512, "blockysize": 512, "interleave": "pixel"}
    with rasterio.open(
        tmp_path / "dem.tif", "w", driver="GTiff", width=9, height=9, count=100, dtype="float64", **profile, **blocks
    ):
        pass
    with pytest.raises(
        ConfigError, match="has 100 bands in blocks of 512 × 512; use a raster with one band of heights"
    ):
        read_terrain(tmp_path / "dem.tif")


def test_a_file_that_is_not_a_raster_is_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "dem.tif").write_text("no raster")
    with pytest.raises(ConfigError, match=r"^mta\.terrain: .*dem\.tif cannot be read: ") as refused:
        read_terrain(tmp_path / "dem.tif")
    assert "\n" not in str(refused.value)
