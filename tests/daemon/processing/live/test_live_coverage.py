"""Tests the coverage that `swath live` exports, read by rasterio and by the standard library."""

from __future__ import annotations

import importlib.util
import io
import json
import zipfile
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import rasterio
from PIL import Image
from pyproj import Transformer

from swath.daemon.cli.main import run_app
from swath.daemon.config.tables import LiveConfig
from swath.daemon.processing.live.coverage import GEOTIFF, KMZ, write_coverage
from swath.daemon.processing.live.products import LiveProducts
from swath.daemon.processing.live.tiles import INDEX, TILES, TileReader
from swath.georef.arrays import FloatArray
from swath.georef.timescales.gps_time import SECOND_NS
from tests.daemon.processing.live.builders import PLAN, Utm, flight, points_at

pytestmark = pytest.mark.xdist_group("kernels")


def flown(folder: Path) -> FloatArray:
    """Write the map of points on a slope, and return the points."""
    trajectory = flight()
    products = LiveProducts(folder, LiveConfig(), Utm(), 0, "EPSG:32632")
    away = np.random.default_rng(1).uniform(-300, 300, (40_000, 3))
    points: FloatArray = Utm().map_from_e(trajectory.position_e)[-1] + away
    points[:, 2] = 400.0 + 0.1 * (points[:, 0] - points[0, 0])
    products.take("left", points_at(points), trajectory, SECOND_NS)
    products.save_map({"session_id": "a<b"}, SECOND_NS, last=True)
    assert products.export_coverage() == []
    products.close()
    return points


def test_the_coverage_lies_where_the_points_are(tmp_path: Path) -> None:
    points = flown(tmp_path)
    with rasterio.open(tmp_path / GEOTIFF) as made:
        assert made.crs.to_epsg() == 32632
        assert made.res == (2.0, 2.0)
        assert made.descriptions[0] == "points per square metre"
        density, height, strips, difference = made.read()
        rows, columns = rasterio.transform.rowcol(made.transform, points[:, 0], points[:, 1])
    expected = np.zeros(density.shape)
    np.add.at(expected, (rows, columns), 1)
    np.testing.assert_array_equal(np.nan_to_num(density) * 4.0, expected)
    assert np.isnan(density[expected == 0]).all()
    np.testing.assert_allclose(height[rows, columns], points[:, 2], atol=0.25)  # two metres of a slope of 0.1
    np.testing.assert_array_equal(np.nan_to_num(strips), expected > 0)
    assert np.isnan(difference).all()
    with zipfile.ZipFile(tmp_path / KMZ) as archive:
        kml = ElementTree.fromstring(archive.read("doc.kml"))
        image = np.asarray(Image.open(io.BytesIO(archive.read("coverage.png"))).convert("RGBA"))
    assert kml.findtext(".//{*}Document/{*}name") == "Coverage a<b"
    corners = np.array(
        [[float(one) for one in pair.split(",")] for pair in kml.findtext(".//{*}coordinates", "").split()]
    )
    east, north = Transformer.from_crs("EPSG:4979", "EPSG:32632", always_xy=True).transform(*corners.T)
    width, height_m = image.shape[1] * 2.0, image.shape[0] * 2.0
    np.testing.assert_allclose(east - east[0], [0.0, width, width, 0.0], atol=0.1)
    np.testing.assert_allclose(north - north[0], [0.0, 0.0, height_m, height_m], atol=0.1)
    across = np.floor((points[:, 0] - east[0]) / 2.0 + 0.01).astype(int)
    down = np.floor((north[2] - points[:, 1]) / 2.0 + 0.01).astype(int)
    assert (image[np.clip(down, 0, len(image) - 1), np.clip(across, 0, image.shape[1] - 1), 3] > 0).mean() > 0.97


def test_what_cannot_be_exported_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert write_coverage(tmp_path) == ["no coverage is written: the map is empty"]
    flown(tmp_path)
    index = json.loads((tmp_path / TILES / INDEX).read_text())
    (tmp_path / TILES / INDEX).write_text(json.dumps(index | {"crs": "EPSG:4978 (no [output] crs)", "placement": None}))
    geotiff, kmz = write_coverage(tmp_path)
    assert geotiff == "coverage.tif is not written: the output has no map coordinates; set output.crs"
    assert kmz == "coverage.kmz is not written: the map's place on the earth is not known"
    (tmp_path / TILES / INDEX).write_text(json.dumps(index | {"tiles": {**index["tiles"], "90000_0": 1}}))
    assert "which a wrong point causes" in write_coverage(tmp_path)[0]
    (tmp_path / TILES / INDEX).write_text(json.dumps(index))
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert write_coverage(tmp_path) == ["coverage.tif is not written: it needs `pip install 'swath[gis]'`"]


@pytest.mark.slow
def test_painted_cells_are_those_of_the_truth(tmp_path: Path) -> None:
    """Map the true places of the echoes by PROJ, without the flight's end, for which the log has no pose any more."""
    plan = tmp_path / "plan.toml"
    plan.write_text(PLAN.replace("prf_hz = 5000", "prf_hz = 30000"))
    log, out = tmp_path / "log", tmp_path / "out"
    assert run_app(["sim", "fly", str(plan), "-o", str(log), "--seconds", "7"]) == 0
    config = log / "true.toml"
    text = (log / "swath.toml").read_text().replace(".nominal.toml", ".true.toml")
    config.write_text(text)
    assert run_app(["live", "--replay", str(log), "-o", str(out), "--accept-verdict", str(config)]) == 0
    reader = TileReader(out)
    assert reader.refresh()
    extent_m, truth = reader.extent_m(), np.load(log / "truth.npz")
    assert extent_m is not None
    view = reader.view(*extent_m, reader.cell_m, ["points"])
    assert view is not None
    known_ns = json.loads((out / "live.json").read_text())["trajectory"]["covered_until_gps_ns"]
    echoes_e = np.concatenate(
        [truth[f"{name}.point_e"][truth[f"{name}.gps_ns"] <= known_ns] for name in ("left", "right")]
    )
    to_map = Transformer.from_crs("EPSG:4978", reader.index["crs"], always_xy=True)
    east, north, _ = to_map.transform(*echoes_e.T)
    origin = reader.index["origin"]
    across = np.floor((east - origin[0] - view.west_m) / view.cell_m).astype(int)
    up = np.floor((north - origin[1] - view.south_m) / view.cell_m).astype(int)
    rows, columns = view.shape
    covered = np.zeros((rows, columns), bool)
    inside = (across >= 0) & (across < columns) & (up >= 0) & (up < rows)
    covered[up[inside], across[inside]] = True
    painted = view.layers["points"] > 0
    assert inside.mean() > 0.999
    assert covered.sum() > 5000  # 20,000 m²
    assert np.count_nonzero(covered != painted) < 0.01 * covered.sum()
