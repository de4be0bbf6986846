"""Tests files of points read in another order or unit than written: COPC, heights and sigmas."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
from pyproj import CRS

from swath.daemon.processing.quicklook.point_files import UNREADABLE, PointReader, Selection, has_varying_chunks
from swath.daemon.processing.quicklook.read import Units, density_near, open_source
from swath.daemon.processing.quicklook.run import Look, look_at
from swath.georef.formats.copc import CopcWriter
from swath.georef.formats.las import LasSettings
from swath.georef.points import Points
from tests.daemon.builders import EAST_M, NORTH_M, lattice, plane, write_laz
from tests.daemon.processing.quicklook.builders import two_strips

pytestmark = pytest.mark.xdist_group("kernels")

FOOT_M = 1200.0 / 3937.0  # US survey foot, by its definition


def as_copc(laz: Path, path: Path) -> Path:
    """Write the same points as COPC."""
    las = laspy.read(laz)
    places = np.stack([las.x, las.y, las.z], axis=-1)
    n, byte = len(places), np.ones(len(places), np.uint8)
    single, channel = np.zeros(n, np.float32), np.zeros(n, np.uint16)
    points = Points(np.zeros(n, np.int64), places, None, single, single, single, byte, byte, channel, byte)
    crs = las.header.parse_crs()
    settings = LasSettings(crs.to_wkt("WKT1_GDAL"), tuple(las.header.offsets), (1e-4,) * 3, sigmas=False)
    with path.open("w+b") as file, tempfile.TemporaryFile() as spool, tempfile.TemporaryFile() as ordered:
        writer = CopcWriter(file, (spool, ordered), settings, int(las.point_source_id[0]))
        writer.write(points)
        writer.close()
    return path


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> tuple[Look, Path]:
    """Return two strips read as LAZ, and their folder as COPC, in chunks of several sizes."""
    laz, copc = tmp_path_factory.mktemp("laz"), tmp_path_factory.mktemp("copc")
    look = two_strips(laz, 0.07)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("swath.georef.formats.copc.NODE_POINTS", 10_000)
        for source in look.sources:
            made = as_copc(source.path, copc / f"{source.path.stem}.copc.laz")
            with laspy.open(made) as reader:
                assert has_varying_chunks(reader.header)
    return look, copc


@pytest.mark.slow
def test_points_of_copc_are_read_from_any_offset(both: tuple[Look, Path]) -> None:
    path = both[1] / "s1.copc.laz"
    everything = np.asarray(laspy.read(path).x)
    with PointReader(path, Selection.all()) as reader:
        for first in (10, 15_000, 70_000, 119_990):
            reader.go_to(first)
            np.testing.assert_array_equal(np.asarray(reader.read(10).x), everything[first : first + 10])
    with PointReader(path, Selection.all()) as reader, pytest.raises(UNREADABLE):
        reader.go_to(120_001)


def test_a_copc_file_looks_like_the_laz_file_of_its_points(both: tuple[Look, Path]) -> None:
    laz, copc = both[0], look_at([both[1]])
    assert copc.surface.points == laz.surface.points == 240_000
    assert copc.cells.frame.cell_m == pytest.approx(laz.cells.frame.cell_m, rel=0.5)
    assert copc.density == pytest.approx(laz.density, rel=0.03)
    (row,), (same,) = copc.overlap.rows, laz.overlap.rows
    assert row["median_m"] == pytest.approx(same["median_m"], abs=2e-4)


def test_a_profile_through_copc_contains_the_points_of_laz(
    both: tuple[Look, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The profile is at the far end, where only some of the blocks are needed."""
    monkeypatch.setattr("swath.daemon.processing.quicklook.read.BLOCK_POINTS", 5_000)
    ends = (EAST_M + 290.0, NORTH_M + 5.0, EAST_M + 290.0, NORTH_M + 155.0)
    heights = []
    for folder in (both[0].sources[0].path.parent, both[1]):
        profile = look_at([folder], 1.5, ends).profile
        assert profile is not None
        heights.append(np.sort(profile.height_m))
    assert len(heights[0]) > 1000
    np.testing.assert_allclose(heights[1], heights[0], rtol=0, atol=1e-9)


@pytest.mark.parametrize("size", [5_000, 100_000])
def test_density_does_not_depend_on_the_point_order(
    both: tuple[Look, Path], monkeypatch: pytest.MonkeyPatch, size: int
) -> None:
    """COPC orders points by a tree, so that a piece of the file is less dense than the whole."""
    monkeypatch.setattr("swath.daemon.processing.quicklook.read.SAMPLE_POINTS", size)
    assert density_near(open_source(both[1] / "s1.copc.laz"), Units()) == pytest.approx(4.0, rel=0.3)


def feet(folder: Path, name: str, crs: CRS, height: float, sidecar: dict[str, Any] | None = None) -> Look:
    """Return two strips in US survey feet, the second one unit higher, with sigmas of 3 cm."""
    inside = folder / name
    inside.mkdir()
    for number in (1, 2):
        x, y = lattice(6_300_000.0, 1_890_000.0, 150.0, 150.0, 2.0)
        z = height + number + 0.0 * x
        write_laz(inside / f"{number}.laz", x, y, z, number, crs=crs, sigma_m=(0.03, 0.03, 0.03), scale=0.001)
    if sidecar is not None:
        (inside / "flight.json").write_text(json.dumps(sidecar | {"strips": [{"file": "1.laz"}, {"file": "2.laz"}]}))
    return look_at([inside])


def test_the_height_unit_is_taken_from_crs_or_sidecar(tmp_path: Path) -> None:
    """If a CRS in feet does not define heights, `swath georef` writes metres, and its sidecar declares them."""
    said = {"crs": {"crs": "EPSG:2230", "units": {"metres": [FOOT_M, FOOT_M, 1.0]}}}
    without, vertical = CRS.from_epsg(2230), CRS.from_user_input("EPSG:2230+6360")
    metres = feet(tmp_path, "sidecar", without, 100.0, said)
    of_feet = feet(tmp_path, "vertical", vertical, 100.0)
    nothing = feet(tmp_path, "nothing", without, 100.0)
    for look, unit_m in ((metres, 1.0), (of_feet, FOOT_M), (nothing, FOOT_M)):
        assert look.surface.low_m[2] == pytest.approx(101.0 * unit_m, abs=1e-6)
        assert look.overlap.rows[0]["median_m"] == pytest.approx(-unit_m, abs=1e-6)
        assert look.units.name == "US survey foot"
        assert look.strips[0].density == pytest.approx((2.0 * FOOT_M) ** -2, rel=0.02)
    assert metres.notes == of_feet.notes == []
    assert nothing.notes == ["no vertical CRS: heights are assumed to be in US survey foot"]


def test_sigmas_are_in_metres_with_coordinates_in_feet(tmp_path: Path) -> None:
    look = feet(tmp_path, "feet", CRS.from_epsg(2230), 100.0)
    assert look.strips[0].sigma_m is not None
    np.testing.assert_allclose(look.strips[0].sigma_m, 0.03, atol=1e-6)


@pytest.mark.parametrize("units", [None, [], {"metres": 1.0}, {"metres": [1, 1, "m"]}, {"metres": [1.0, 1.0, 0.0]}])
def test_a_sidecar_without_a_unit_changes_nothing(tmp_path: Path, units: Any) -> None:
    look = feet(tmp_path, "odd", CRS.from_epsg(2230), 100.0, {"crs": {"units": units}})
    assert look.units.up_m == pytest.approx(FOOT_M)


def test_differences_of_metres_are_shown_in_metres(tmp_path: Path) -> None:
    """An aircraft that was never calibrated may differ by more than a metre, and nothing is clipped."""
    for number in (1, 2):
        x, y = lattice(EAST_M, NORTH_M, 60.0, 60.0, 0.5)
        write_laz(tmp_path / f"{number}.laz", x, y, plane(x, y) + 2.5 * number, number)
    numbers = look_at([tmp_path]).overlap.numbers()
    assert numbers is not None
    assert (numbers["median_m"], numbers["p95_m"]) == (pytest.approx(-2.5), pytest.approx(2.5))


def test_lengths_on_a_distorted_map_are_ground_lengths(tmp_path: Path) -> None:
    """At 47.5° N a ground metre is 1.48 m in web Mercator, so it has 2.19 times fewer pulses per square metre."""
    x, y = lattice(990_000.0, 6_024_000.0, 300.0, 100.0, 0.5)  # four a square metre of the map
    write_laz(tmp_path / "s.laz", x, y, 0.0 * x + 400.0, crs=CRS.from_epsg(3857))
    look = look_at([tmp_path])
    lat = 2.0 * np.arctan(np.exp(6_024_050.0 / 6_378_137.0)) - np.pi / 2
    assert look.density == pytest.approx(4.0 / np.cos(lat) ** 2, rel=0.02)
    (note,) = look.notes
    assert "a metre on the ground is 1.4" in note
    assert note.endswith("lengths and areas shown are those on the ground")
    assert '"EPSG:32632"' in note


def test_points_outside_the_area_of_use_of_their_crs_are_reported(tmp_path: Path) -> None:
    """The points are at 9° E in zone 33, which begins at 12° E."""
    x, y = lattice(47_000.0, 5_275_000.0, 50.0, 50.0, 0.5)
    write_laz(tmp_path / "s.laz", x, y, 0.0 * x + 400.0, crs=CRS.from_epsg(32633))
    (note,) = look_at([tmp_path]).notes
    assert "WGS 84 / UTM zone 33N is used from 12° to 18° E" in note


def test_points_inside_the_area_of_use_give_no_such_note(tmp_path: Path) -> None:
    x, y = lattice(500_000.0, 5_275_000.0, 50.0, 50.0, 0.5)
    write_laz(tmp_path / "s.laz", x, y, 0.0 * x + 400.0, crs=CRS.from_epsg(25832))
    assert look_at([tmp_path]).notes == []
