"""Tests `swath view --gis`: maps and features agree with the points, as GDAL reads them."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pyogrio
import pytest
import rasterio
from pyproj import CRS, Transformer

from swath.daemon.cli.main import run_app
from swath.daemon.processing.pages.names import QUICK_LOOK_FEATURES, QUICK_LOOK_MAPS
from swath.georef.mapping.frame import Mapping
from tests.daemon.builders import EAST_M, NORTH_M, Array, lattice, plane, write_laz

pytestmark = pytest.mark.xdist_group("kernels")

BEGIN_NS, STEP_NS = 1_465_549_218_000_000_000, 100_000_000  # 2026-06-15 09:00:00 UTC
STRIPS = {1: (0.0, 0.0), 2: (30.0, 0.07)}  # south of the first strip's edge, and lift, metres
SPAN_NS = {1: (BEGIN_NS, BEGIN_NS + 20 * STEP_NS), 2: (BEGIN_NS + 60 * STEP_NS, BEGIN_NS + 80 * STEP_NS)}
CONTROL = (EAST_M + 40.0, NORTH_M + 20.0, 401.5)


def path_at(time_ns: int) -> tuple[float, float, float]:
    """Return where the aircraft is: 50 m/s to the east, 500 m above the ground."""
    return EAST_M + 50.0 * (time_ns - BEGIN_NS) / 1e9, NORTH_M + 25.0, 900.0


def trajectory_text() -> str:
    """Return the aircraft's path as a trajectory CSV."""
    lines = ["gps_ns,lat_deg,lon_deg,height_m,vel_n_mps,vel_e_mps,vel_d_mps,roll_deg,pitch_deg,heading_deg"]
    to_geographic = Transformer.from_crs("EPSG:25832", "EPSG:4258", always_xy=True)
    for number in range(100):
        time_ns = BEGIN_NS + number * STEP_NS
        east_m, north_m, height_m = path_at(time_ns)
        lon_deg, lat_deg = to_geographic.transform(east_m, north_m)
        lines.append(f"{time_ns},{lat_deg:.11f},{lon_deg:.11f},{height_m},0,50,0,0,0,90")
    return "\n".join(lines) + "\n"


def write_products(folder: Path) -> Path:
    """Write two strips with sidecar, trajectory, and the records of a calibration and a validation."""
    folder.mkdir()
    for number, (south_m, lift_m) in STRIPS.items():
        x, y = lattice(EAST_M, NORTH_M + south_m, 120.0, 50.0, 0.5)
        z, sigma_m = plane(x, y) + lift_m, (0.031, 0.032, 0.0215)
        crs = CRS.from_epsg(25832)
        write_laz(folder / f"s{number}.laz", x, y, z, number, crs=crs, sigma_m=sigma_m, intensity=1000 * number)
    sidecar = {
        "crs": Mapping("EPSG:25832", datum="same").description(),
        "flights": [{"session": "one"}],
        "strips": [
            {"number": number, "file": f"s{number}.laz", "first_gps_ns": span[0], "last_gps_ns": span[1]}
            for number, span in SPAN_NS.items()
        ],
    }
    (folder / "one.json").write_text(json.dumps(sidecar))
    (folder / "one_trajectory.csv").write_text(trajectory_text())
    east_m, north_m, height_m = CONTROL
    place = {"easting": east_m, "northing": north_m, "height": height_m, "crs": "EPSG:25832"}
    one = {"name": "P1", "laser_above_m": 0.012, "sigma_m": 0.01, "normalised": 1.1} | place
    (folder / "calibration.json").write_text(json.dumps({"control": [one]}))
    other_east, other_north = Transformer.from_crs("EPSG:25832", "EPSG:25833", always_xy=True).transform(
        east_m, north_m
    )
    elsewhere = {"easting": other_east, "northing": other_north, "height": height_m, "crs": "EPSG:25833"}
    two = {"name": "P1", "laser_above_m": -0.021, "sights": 2} | elsewhere
    (folder / "report").mkdir()
    (folder / "report" / "validation.json").write_text(json.dumps({"control": [two, {"name": "no place"}]}))
    return folder


@pytest.fixture(scope="module")
def products(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = write_products(tmp_path_factory.mktemp("gis") / "products")
    assert run_app(["view", str(folder), "--gis"]) == 0
    return folder


def points_of(folder: Path, what: Callable[[laspy.LasData], Array]) -> tuple[Array, Array, Array]:
    """Return eastings, northings and a value of all points, as laspy reads them."""
    read = [laspy.read(path) for path in sorted(folder.glob("*.laz"))]
    columns = [[np.asarray(one.x), np.asarray(one.y), np.asarray(what(one), float)] for one in read]
    x, y, values = (np.concatenate(parts) for parts in zip(*columns, strict=True))
    return x, y, values


def means_at_pixels(raster: Any, x: Array, y: Array, values: Array) -> Array:
    """Return the mean value of the points in every pixel of a raster, by its own transform; nan: no points."""
    west, north, (across, up) = raster.bounds.left, raster.bounds.top, raster.res
    at = np.floor((north - y) / up).astype(int) * raster.width + np.floor((x - west) / across).astype(int)
    counts = np.bincount(at, minlength=raster.width * raster.height)
    with np.errstate(invalid="ignore"):
        means = np.bincount(at, values, minlength=len(counts)) / counts
    return np.asarray(means.reshape(raster.height, raster.width))


@pytest.mark.slow
def test_maps_are_cloud_optimised_and_have_the_crs_and_no_value_where_no_points_are(products: Path) -> None:
    for name in QUICK_LOOK_MAPS:
        with rasterio.open(products / "view" / name) as raster:
            assert raster.crs.to_epsg() == 25832, name
            assert raster.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG", name
            assert set(raster.dtypes) == {"float32"}
            assert math.isnan(raster.nodata)
            assert all(raster.descriptions), name
            west, south, east, north = raster.bounds
            assert EAST_M - 16.0 < west < EAST_M + 1.0 < EAST_M + 119.0 < east < EAST_M + 136.0, name
            assert NORTH_M - 16.0 < south < north < NORTH_M + 96.0, name


@pytest.mark.parametrize(
    ("name", "what"),
    [
        ("height.tif", lambda points: points.z),
        ("intensity.tif", lambda points: points.intensity),
        ("sigma.tif", lambda points: points.sigma_height),
    ],
)
def test_maps_hold_the_means_of_the_points_in_each_pixel(
    products: Path, name: str, what: Callable[[laspy.LasData], Array]
) -> None:
    with rasterio.open(products / "view" / name) as raster:
        expected = means_at_pixels(raster, *points_of(products, what))
        np.testing.assert_allclose(raster.read(1), expected, rtol=2e-6, atol=1e-6)
        assert np.isfinite(expected).sum() > 1000


def test_the_density_counts_every_first_return(products: Path) -> None:
    with rasterio.open(products / "view" / "density.tif") as raster:
        pulses = np.nansum(raster.read(1)) * raster.res[0] * raster.res[1]
    assert pulses == pytest.approx(48_000, rel=1e-6)


def test_differences_are_signed_and_lie_in_the_overlap_only(products: Path) -> None:
    with rasterio.open(products / "view" / "differences.tif") as raster:
        shown, values = raster.read()
        _, south, _, north = raster.bounds
    np.testing.assert_array_equal(np.isfinite(shown), np.isfinite(values))
    np.testing.assert_allclose(shown[np.isfinite(shown)], -0.07, atol=2e-4)  # as on the page, averaged
    known = values[np.isfinite(values)]
    np.testing.assert_allclose(known, -0.07, atol=2e-4)  # first strip minus second
    assert known.size > 200
    assert NORTH_M + 29.0 <= south < north <= NORTH_M + 52.0


def features_of(products: Path, layer: str) -> tuple[Any, list[Any], dict[str, Any]]:
    """Return CRS, geometries and attributes of a layer, as GDAL reads them."""
    path = products / "view" / QUICK_LOOK_FEATURES
    meta, _, shapes, columns = pyogrio.raw.read(path, layer=layer)
    return meta["crs"], list(shapes), dict(zip(meta["fields"], columns, strict=True))


def numbers_of_wkb(shape: bytes, skipped: int) -> Array:
    """Return the coordinates of a WKB point or line string of three dimensions."""
    return np.frombuffer(shape, "<f8", offset=skipped).reshape(-1, 3)


def test_footprints_cover_the_strips_and_carry_their_figures(products: Path) -> None:
    crs, shapes, columns = features_of(products, "strips")
    assert crs == "EPSG:25832"
    assert list(columns["strip"]) == ["1", "2"]
    assert list(columns["points"]) == [24_000, 24_000]
    np.testing.assert_allclose(columns["sigma_height_m"], 0.0215, atol=1e-5)
    for shape, (south_m, _) in zip(shapes, STRIPS.values(), strict=True):
        ring = np.frombuffer(shape[9 + 13 :], "<f8").reshape(-1, 2)  # a multi-polygon of one polygon with one ring
        east, north = (ring - [EAST_M, NORTH_M + south_m]).T
        area_m2 = 0.5 * abs(np.sum(east * np.roll(north, 1) - north * np.roll(east, 1)))
        assert area_m2 == pytest.approx(120.0 * 50.0, rel=0.15)  # whole cells
        np.testing.assert_allclose([east.min(), east.max(), north.min(), north.max()], [0, 120, 0, 50], atol=4.1)


def test_lines_follow_the_trajectory_over_each_strips_time(products: Path) -> None:
    crs, shapes, columns = features_of(products, "lines")
    assert crs == "EPSG:25832"
    assert list(columns["strip"]) == ["1", "2"]
    assert list(columns["session"]) == ["one", "one"]
    assert list(columns["begin_utc"]) == ["2026-06-15T09:00:00Z", "2026-06-15T09:00:06Z"]
    for shape, span_ns in zip(shapes, SPAN_NS.values(), strict=True):
        vertices = numbers_of_wkb(shape, 9)
        assert len(vertices) >= 4
        expected = np.array([path_at(time_ns) for time_ns in span_ns])
        np.testing.assert_allclose(vertices[[0, -1]], expected, rtol=0.0, atol=2e-3)
        np.testing.assert_allclose(
            vertices[:, 1:], np.broadcast_to(expected[0, 1:], (len(vertices), 2)), rtol=0.0, atol=2e-3
        )


@pytest.mark.slow
def test_control_residuals_of_both_records_lie_at_the_surveyed_place(
    products: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    crs, shapes, columns = features_of(products, "control")
    assert crs == "EPSG:25832"
    assert list(columns["record"]) == ["calibration", "validation"]
    np.testing.assert_allclose(columns["laser_above_m"], [0.012, -0.021])
    assert list(columns["sights"]) == [1, 2]
    for shape in shapes:
        np.testing.assert_allclose(numbers_of_wkb(shape, 5)[0], CONTROL, rtol=0.0, atol=2e-3)
    assert run_app(["view", str(products), "--gis", "--json", "--overwrite"]) == 0
    told = capsys.readouterr()
    assert [Path(one).name for one in json.loads(told.out)["gis"]] == [*QUICK_LOOK_MAPS, QUICK_LOOK_FEATURES]
    assert "validation.json: a control point is left out" in told.err


@pytest.mark.slow
def test_one_strip_without_a_crs_gives_maps_without_one_and_a_note(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    x, y = lattice(EAST_M, NORTH_M, 60.0, 40.0, 0.5)
    write_laz(tmp_path / "s.laz", x, y, plane(x, y))
    assert run_app(["view", str(tmp_path), "--gis"]) == 0
    assert "the files state no coordinate system" in capsys.readouterr().err
    written = {path.name for path in (tmp_path / "view").iterdir()}
    assert not {"differences.tif", "sigma.tif"} & written
    with rasterio.open(tmp_path / "view" / "height.tif") as raster:
        assert raster.crs is None
        assert raster.bounds.left == pytest.approx(EAST_M, abs=1.0)
    layers = pyogrio.list_layers(tmp_path / "view" / QUICK_LOOK_FEATURES)
    assert [name for name, _ in layers] == ["strips"]
    assert run_app(["view", str(tmp_path), "--overwrite"]) == 0  # a later run without --gis leaves no old maps
    assert not list((tmp_path / "view").glob("*.tif"))
    assert not (tmp_path / "view" / QUICK_LOOK_FEATURES).exists()


@pytest.mark.slow
def test_lines_are_those_of_the_strips_that_were_looked_at(products: Path, tmp_path: Path) -> None:
    assert run_app(["view", str(products / "s2.laz"), "--gis", "-o", str(tmp_path / "view")]) == 0
    _, _, columns = features_of(tmp_path, "lines")
    assert list(columns["strip"]) == ["2"]


@pytest.mark.slow
def test_coordinates_in_feet_stay_in_feet(tmp_path: Path) -> None:
    foot_m = 1200.0 / 3937.0
    x, y = (axis / foot_m for axis in lattice(EAST_M, NORTH_M, 60.0, 40.0, 0.5))
    z = 1000.0 + 0.01 * (x - x.min())
    write_laz(tmp_path / "s.laz", x, y, z, crs=CRS.from_epsg(2232), scale=0.001)
    assert run_app(["view", str(tmp_path), "--gis"]) == 0
    with rasterio.open(tmp_path / "view" / "height.tif") as raster:
        assert raster.crs.to_epsg() == 2232
        assert raster.bounds.left == pytest.approx(x.min(), abs=5.0)
        expected = means_at_pixels(raster, *points_of(tmp_path, lambda points: points.z))
        np.testing.assert_allclose(raster.read(1), expected, rtol=0.0, atol=2e-3)
