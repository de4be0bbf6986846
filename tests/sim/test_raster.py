"""Tests ground from GeoTIFFs, and rasters that cannot be used."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from pyproj import Transformer
from rasterio.transform import Affine

from swath.georef.arrays import FloatArray
from swath.sim.plan.errors import PlanError
from swath.sim.scene.scene import Scene, build_scene
from swath.sim.site import Site, geodetic_from_e
from tests.sim.scenes import plan_of

CRS = "EPSG:32632"
CENTER = Transformer.from_crs("EPSG:4326", CRS, always_xy=True).transform(8.9, 47.5)
SQUARE = 200.0 * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])


def heights_at(easting: FloatArray, northing: FloatArray) -> FloatArray:
    """Return heights, m, of a plane, which bilinear interpolation reproduces."""
    height_m: FloatArray = 500.0 + 0.03 * (easting - CENTER[0]) - 0.05 * (northing - CENTER[1])
    return height_m


def pixel_centers(transform: Affine, count: int) -> tuple[FloatArray, FloatArray]:
    """Return easting and northing, m, of the pixels of a square raster."""
    column, row = np.meshgrid(np.arange(count) + 0.5, np.arange(count) + 0.5)
    a, b, c, d, e, f = transform[:6]
    return a * column + b * row + c, d * column + e * row + f


def write(folder: Path, half_m: float = 400.0, pixel_m: float = 5.0, **others: Any) -> None:
    """Write ``dem.tif`` around the site's origin."""
    transform = Affine(pixel_m, 0.0, CENTER[0] - half_m, 0.0, -pixel_m, CENTER[1] + half_m)
    count = int(2 * half_m / pixel_m)
    values = heights_at(*pixel_centers(transform, count))
    profile = {"crs": CRS, "transform": transform, "nodata": None} | others
    values = profile.pop("change", lambda same: same)(values)
    with rasterio.open(
        folder / "dem.tif", "w", driver="GTiff", width=count, height=count, count=1, dtype="float64", **profile
    ) as file:
        file.write(values, 1)


def scene_in(folder: Path, text: str = "", corners: FloatArray = SQUARE) -> Scene:
    """Return the scene on the raster."""
    plan = plan_of(f"raster = 'dem.tif'\nheight_m = 480\n{text}", folder)
    return build_scene(plan, Site.at(*plan.tables.flight.origin_deg), corners)


def refused(folder: Path, text: str = "", corners: FloatArray = SQUARE) -> str:
    """Return the single error line."""
    with pytest.raises(PlanError) as error:
        scene_in(folder, text, corners)
    assert "\n" not in str(error.value)
    return str(error.value)


@pytest.mark.parametrize("rotated", [False, True])
def test_heights_match_the_map_at_every_node(tmp_path: Path, rotated: bool) -> None:
    write(tmp_path)
    if rotated:
        cos, sin = 5.0 * np.cos(np.radians(30.0)), 5.0 * np.sin(np.radians(30.0))
        corner = CENTER[0] - 90 * cos - 90 * sin, CENTER[1] - 90 * sin + 90 * cos
        turn = Affine(cos, sin, corner[0], sin, -cos, corner[1])
        with rasterio.open(
            tmp_path / "dem.tif", "w", driver="GTiff", width=180, height=180, count=1, dtype="float64", crs=CRS,
            transform=turn,
        ) as file:  # fmt: skip
            file.write(heights_at(*pixel_centers(turn, 180)), 1)
    scene = scene_in(tmp_path)
    east, north = (axis.ravel() for axis in np.meshgrid(np.arange(-200.0, 201.0, 25.0), np.arange(-200.0, 201.0, 25.0)))
    points = np.stack([east, north, scene.site_z(east, north)], axis=1)
    lat, lon, height_m = geodetic_from_e(scene.site.e_from_site(points))
    easting, northing = Transformer.from_crs("EPSG:4326", CRS, always_xy=True).transform(
        np.degrees(lon), np.degrees(lat)
    )
    np.testing.assert_allclose(height_m, heights_at(easting, northing), rtol=0, atol=1e-5)
    np.testing.assert_allclose(scene.ground_m(east, north), height_m, rtol=0, atol=1e-9)


def test_places_far_from_the_origin_are_found_at_their_height(tmp_path: Path) -> None:
    """At 8 km a height of 300 m moves a place on the map by 0.4 m, which is 40 mm on a slope of a tenth."""
    east_m = 8000.0
    transform = Affine(10.0, 0.0, CENTER[0] + east_m - 600.0, 0.0, -10.0, CENTER[1] + 600.0)
    easting, _ = pixel_centers(transform, 120)
    with rasterio.open(
        tmp_path / "dem.tif", "w", driver="GTiff", width=120, height=120, count=1, dtype="float64", crs=CRS,
        transform=transform,
    ) as file:  # fmt: skip
        file.write(800.0 + 0.1 * (easting - CENTER[0] - east_m), 1)
    scene = scene_in(tmp_path, corners=SQUARE + np.array([east_m, 0.0]))
    place = np.array([[east_m, 0.0], [east_m + 150.0, -100.0]]).T
    points = np.stack([*place, scene.site_z(*place)], axis=1)
    lat, lon, height_m = geodetic_from_e(scene.site.e_from_site(points))
    found, _ = Transformer.from_crs("EPSG:4326", CRS, always_xy=True).transform(np.degrees(lon), np.degrees(lat))
    np.testing.assert_allclose(height_m, 800.0 + 0.1 * (found - CENTER[0] - east_m), rtol=0, atol=1e-5)


def test_a_missing_or_unreadable_raster_is_refused(tmp_path: Path) -> None:
    assert refused(tmp_path).startswith(f"terrain.raster: the file {tmp_path / 'dem.tif'} does not exist; give")
    (tmp_path / "dem.tif").write_text("no raster")
    assert refused(tmp_path).startswith(f"terrain.raster: {tmp_path / 'dem.tif'} cannot be read: ")


def test_rasters_with_blocks_too_large_to_read_are_refused(tmp_path: Path) -> None:
    profile = {"crs": CRS, "transform": Affine(5.0, 0.0, CENTER[0], 0.0, -5.0, CENTER[1]), "SPARSE_OK": True}
    blocks = {"tiled": True, "blockxsize": 512, "blockysize": 512, "interleave": "pixel"}
    with rasterio.open(
        tmp_path / "dem.tif", "w", driver="GTiff", width=9, height=9, count=400, dtype="float64", **profile, **blocks
    ):
        pass
    assert refused(tmp_path).endswith(
        "dem.tif has 400 bands in blocks of 512 × 512; use a raster with one band of heights"
    )


def test_error_for_another_crs_names_the_required_one(tmp_path: Path) -> None:
    write(tmp_path, crs="EPSG:25832")
    assert (
        refused(tmp_path)
        == f"terrain.raster: {tmp_path / 'dem.tif'} is in EPSG:25832; use a raster in flight.crs, EPSG:32632"
    )
    write(tmp_path, crs=None)
    assert (
        refused(tmp_path)
        == f"terrain.raster: {tmp_path / 'dem.tif'} has no CRS; use a raster in flight.crs, EPSG:32632"
    )


def test_a_compound_crs_is_compared_by_its_horizontal_part(tmp_path: Path) -> None:
    write(tmp_path)
    plan = plan_of("raster = 'dem.tif'", tmp_path).changed({"flight": {"crs": "EPSG:32632+7837"}})
    scene = build_scene(plan, Site.at(47.5, 8.9), SQUARE)
    assert scene.ground_m(np.zeros(1), np.zeros(1))[0] == pytest.approx(500.0, abs=0.01)


def test_an_unknown_crs_is_reported_for_the_flight(tmp_path: Path) -> None:
    write(tmp_path)
    plan = plan_of("raster = 'dem.tif'", tmp_path).changed({"flight": {"crs": "EPSG:0"}})
    with pytest.raises(PlanError, match=r"^flight\.crs: PROJ does not know 'EPSG:0'; write it like EPSG:25832$"):
        build_scene(plan, Site.at(47.5, 8.9), SQUARE)


def test_error_for_a_raster_that_is_too_small_names_the_missing_corner(tmp_path: Path) -> None:
    write(tmp_path, half_m=250.0)
    assert "does not reach the south-west corner at" in refused(tmp_path)
    write(tmp_path)
    assert "does not reach the south-east corner at" in refused(tmp_path, corners=SQUARE + np.array([105.0, 60.0]))


@pytest.mark.parametrize("nothing", [-9999.0, np.nan])
def test_error_for_a_hole_gives_its_place(tmp_path: Path, nothing: float) -> None:
    def pierced(values: FloatArray) -> FloatArray:
        values[60, 100] = nothing
        return values

    write(tmp_path, change=pierced, nodata=-9999.0)
    message = refused(tmp_path, "cell_m = 2.5")
    assert message.startswith("terrain.raster: has no data at ")
    at = [float(number.rstrip(";")) for number in message.split()[5:7] for number in [number.rstrip(",")]]
    np.testing.assert_allclose(at, [CENTER[0] - 400.0 + 502.5, CENTER[1] + 400.0 - 302.5], rtol=0, atol=8.0)


def test_holes_outside_the_area_do_no_harm(tmp_path: Path) -> None:
    def framed(values: FloatArray) -> FloatArray:
        values[:10] = -9999.0
        return values

    write(tmp_path, change=framed, nodata=-9999.0)
    assert np.isfinite(scene_in(tmp_path).ground.z).all()


def test_without_rasterio_the_error_names_the_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rasterio", None)
    assert "pip install '.[raster]'" in refused(tmp_path)
