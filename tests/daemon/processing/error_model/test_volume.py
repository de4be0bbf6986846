"""Tests volumes and their sigmas on ground and with errors whose answer is known in closed form."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import pytest

from swath.daemon.cli.main import run_app
from swath.daemon.errors import ExitCode, UserError
from swath.daemon.processing.error_model.file import RECORD, ModelFile
from swath.daemon.processing.error_model.volume import area_of, read_polygon, volume
from swath.georef.arrays import FloatArray
from swath.georef.error_model.model import ErrorModel, Unit, path_axes
from swath.georef.formats.las_header import append_evlr, encode_evlr
from tests.georef.error_model.builders import SECOND, SLOW, unit

pytestmark = pytest.mark.xdist_group("kernels")

Ground = Callable[[FloatArray, FloatArray], FloatArray]
SQUARE = "easting,northing\n0,0\n40,0\n40,40\n0,40\n"


def level(east: FloatArray, north: FloatArray) -> FloatArray:
    """Return level ground 5 m high."""
    return np.full(len(east), 5.0) + 0.0 * north


def quiet(strip: int, offset: FloatArray, noise_m: float = 0.0) -> Unit:
    """Return a unit whose only errors are one of the calibration, in the map's axes, and a range noise."""
    one = unit(strip)
    calibration = np.zeros((1, 7))
    calibration[0, :3] = path_axes(one.azimuth_rad).T @ offset
    still = np.zeros_like(one.covariance)
    noise = np.array([noise_m, 0.0, 0.0])
    return replace(one, covariance=still, calibration=calibration, unmodelled=np.zeros((3, 3)), noise=noise)


def points_file(folder: Path, units: list[Unit], ground: Ground, count: int = 4000) -> list[Path]:
    """Write a file of points for each unit, with the model in it."""
    model = ModelFile(ErrorModel(units, SLOW), {"left": 0}, np.ones(3), "", "test", "test")
    record, paths, rng = encode_evlr(*RECORD, model.text().encode(), "error model, JSON"), [], np.random.default_rng(3)
    for one in units:
        las = laspy.create(point_format=6, file_version="1.4")
        las.header.scales, las.header.offsets = [0.001] * 3, [0.0] * 3
        las.header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
        east, north = rng.uniform(-10.0, 50.0, (2, count))
        las.x, las.y, las.z = east, north, ground(east, north)
        # the body is above the points then, so that beams are upright
        las.gps_time = np.full(count, one.start_ns / SECOND - 1e9)
        las.point_source_id = np.full(count, one.strip, np.uint16)
        paths.append(folder / f"strip{one.strip}.laz")
        las.write(paths[-1])
        with paths[-1].open("r+b") as stream:
            append_evlr(stream, record)
    return paths


def polygon(folder: Path, text: str = SQUARE) -> Path:
    """Write a polygon."""
    path = folder / "polygon.csv"
    path.write_text(text)
    return path


def test_a_common_height_error_counts_with_the_area(tmp_path: Path) -> None:
    paths = points_file(tmp_path, [quiet(1, np.array([0.0, 0.0, 0.02]))], level)
    told = volume(paths, read_polygon(polygon(tmp_path)), 3.0)
    assert told["volume_m3"] == pytest.approx(1600.0 * 2.0, rel=3e-3)
    assert told["sigma_m3"] == pytest.approx(1600.0 * 0.02, rel=3e-3)
    assert told["sigma_of_mean_height_m"] == pytest.approx(0.02, rel=1e-6)
    assert told["covered_m2"] == pytest.approx(1600.0, rel=3e-3)


def test_a_shift_in_plan_counts_by_the_slope(tmp_path: Path) -> None:
    units = [quiet(1, np.array([0.05, 0.0, 0.0]))]
    square = read_polygon(polygon(tmp_path))
    slope = volume(points_file(tmp_path, units, lambda east, north: 5.0 + 0.3 * east), square, 0.0)
    assert slope["sigma_m3"] == pytest.approx(1600.0 * 0.3 * 0.05, rel=0.03)
    assert slope["volume_m3"] == pytest.approx(1600.0 * (5.0 + 0.3 * 20.0), rel=0.01)

    def heap(east: FloatArray, north: FloatArray) -> FloatArray:
        return np.maximum(0.0, 10.0 - np.hypot(east - 20.0, north - 20.0))

    symmetric = volume(points_file(tmp_path, units, heap), square, 0.0)
    assert symmetric["sigma_m3"] < 0.03 * 1600.0 * 0.3 * 0.05
    assert symmetric["volume_m3"] == pytest.approx(np.pi * 10.0**3 / 3.0, rel=0.03)


def test_two_strips_share_the_calibration_and_average_what_they_do_not_share(tmp_path: Path) -> None:
    """Opposite flights turn a shift of the head to both sides: it cancels on a slope, a height error does not."""
    there, back = unit(1, 90.0), unit(2, 270.0, start_s=260)
    sideways, lower = np.zeros((1, 7)), np.zeros((1, 7))
    sideways[0, 0], lower[0, 2] = 0.05, 0.02
    square = read_polygon(polygon(tmp_path))
    for calibration, expected in ((sideways, 0.0), (lower, 1600.0 * 0.02)):
        units = [
            replace(quiet(one.strip, np.zeros(3)), azimuth_rad=one.azimuth_rad, calibration=calibration,
                    start_ns=one.start_ns, end_ns=one.end_ns, post_ns=one.post_ns)
            for one in (there, back)
        ]  # fmt: skip
        told = volume(points_file(tmp_path, units, lambda east, north: 5.0 + 0.3 * east, 8000), square, 0.0)
        assert told["sigma_m3"] == pytest.approx(expected, rel=0.05, abs=0.06 * 1600.0 * 0.3 * 0.05)
        assert told["strips"] == [1, 2]


def test_the_noise_of_single_returns_averages_out(tmp_path: Path) -> None:
    paths = points_file(tmp_path, [quiet(1, np.zeros(3), noise_m=0.1)], level)
    told = volume(paths, read_polygon(polygon(tmp_path)), 0.0)
    expected = 0.1 * 1600.0 / np.sqrt(told["points"])  # cells weigh alike, of 12 points and some: 5 % more
    assert told["sigma_m3"] == pytest.approx(told["sigma_of_noise_m3"]) == pytest.approx(expected, rel=0.1)


def test_holes_are_left_out_and_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    paths = points_file(tmp_path, [quiet(1, np.array([0.0, 0.0, 0.02]))], level)
    wide = polygon(tmp_path, SQUARE.replace("40", "100"))
    assert run_app(["accuracy", str(paths[0]), "--volume", str(wide), "--base", "3"]) == ExitCode.OK
    said = capsys.readouterr().out
    assert said.startswith("volume: ")
    assert "of 10,000.0 m² have no points" in said


def test_a_geojson_polygon_is_read(tmp_path: Path) -> None:
    corners = [[0, 0], [40, 0], [40, 40], [0, 40], [0, 0]]
    shape = {"type": "Polygon", "coordinates": [corners]}
    for content in (
        shape,
        {"type": "Feature", "geometry": shape},
        {"type": "FeatureCollection", "features": [{"type": "Feature", "geometry": shape}]},
    ):
        path = tmp_path / "polygon.geojson"
        path.write_text(json.dumps(content))
        assert area_of(read_polygon(path)) == 1600.0


@pytest.mark.parametrize(
    "text", ["", "a,b\n", "1,2\n3,4\n", '{"type": "Point"}', "0,0\n4,4\n4,0\n0,3\n", "0,0\nx,1\n1,0\n"]
)
def test_what_is_no_polygon_is_refused_in_one_line(tmp_path: Path, text: str) -> None:
    with pytest.raises(UserError) as caught:
        read_polygon(polygon(tmp_path, text))
    assert "\n" not in str(caught.value)
    assert "polygon" in str(caught.value)


def test_impossible_volumes_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (path,) = map(str, points_file(tmp_path, [quiet(1, np.zeros(3))], level, 400))
    far = str(polygon(tmp_path, "1000,0\n1040,0\n1040,40\n"))
    for arguments, told in (
        ([path, "--volume", far], "--volume FILE and --base H go together"),
        ([path, "--at", "1,2", "--base", "3"], "go together"),
        ([path, "--volume", far, "--base", "3"], "0 points lie in the polygon; a volume needs 30"),
        ([path, "--volume", str(tmp_path / "none"), "--base", "3"], "No such file"),
    ):
        capsys.readouterr()
        assert run_app(["accuracy", *arguments]) in (ExitCode.USAGE, ExitCode.PROBLEM)
        said = capsys.readouterr().err
        assert told in said, said
        assert said.count("\n") == 1
