"""Tests ``swath georef``: points are at the truth, every return is accounted for, and mistakes are named."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
from pyproj import Transformer

from swath.daemon.cli.main import run_app
from swath.daemon.log.chunk_index import index_log
from swath.daemon.log.reader import open_logs
from swath.georef.formats.sbet import sbet_bytes
from swath.georef.formats.trajectory.csv import csv_text
from swath.georef.timescales.gps_time import DAY_NS
from tests.daemon.one_line import Flown, fly

pytestmark = [pytest.mark.xdist_group("kernels"), pytest.mark.slow]

S = 1_000_000_000


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    return fly(tmp_path_factory.mktemp("line"))


@pytest.fixture(scope="module")
def products(flown: Flown, tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = tmp_path_factory.mktemp("products")
    assert run_app(flown.arguments(output)) == 0
    return output


def record(output: Path) -> dict[str, Any]:
    """Return the sidecar."""
    read: dict[str, Any] = json.loads(next(output.glob("*.json")).read_text())
    return read


def refused(capsys: pytest.CaptureFixture[str], output: Path, arguments: list[str]) -> str:
    """Return the single error line of a command that wrote no file."""
    capsys.readouterr()
    assert run_app(arguments) in (1, 2, 3)
    line = capsys.readouterr().err
    assert line.startswith("swath: ")
    assert line.count("\n") == 1, line
    assert "internal error" not in line
    assert not list(output.glob("*"))
    return line


class TestProducts:
    def test_points_match_the_truth(self, flown: Flown, products: Path) -> None:
        las = laspy.read(next(products.glob("*_strip01.laz")))
        truth = flown.truth
        to_map = Transformer.from_crs("EPSG:4978", "EPSG:32632", always_xy=True)
        expected = np.stack(to_map.transform(*truth["left.point_e"].T), axis=1)
        of_time = np.lexsort((truth["left.return_number"], truth["left.gps_ns"]))
        mine = np.lexsort((np.asarray(las.return_number), np.asarray(las.gps_time)))
        assert len(las) == len(expected) > 50_000
        gps_s = (truth["left.gps_ns"][of_time] - 10**18) / 1e9
        assert np.abs(np.asarray(las.gps_time)[mine] - gps_s).max() < 2e-7
        # an SREP packet counts in 1 mm and the file too
        assert np.abs(las.xyz[mine] - expected[of_time]).max() < 0.002
        assert np.array_equal(np.asarray(las.return_number)[mine], truth["left.return_number"][of_time])

    def test_sigmas_come_from_the_trajectory(self, products: Path) -> None:
        las = laspy.read(next(products.glob("*_strip01.laz")))
        for name in ("sigma_easting", "sigma_northing", "sigma_height"):
            assert 0.02 <= np.median(las[name]) < 0.08, name

    def test_the_sidecar_describes_the_inputs(self, flown: Flown, products: Path) -> None:
        told = record(products)
        assert (told["format"], told["complete"], told["holes"]) == ("swath.georef", True, [])
        digest = hashlib.sha256(flown.log.read_bytes()).hexdigest()
        assert told["logs"] == [{"name": flown.log.name, "sha256": digest}]
        calibration = told["flights"][0]["calibrations"]["left"]
        assert calibration["id"] in (flown.folder / "left.true.toml").read_text()
        assert calibration["parameters"]["phi_deg"] == pytest.approx(-0.4021)
        assert told["crs"]["name"] == "WGS 84 / UTM zone 32N"
        edge = told["flights"][0]["atmosphere_at_edge"]["left"]
        assert edge["angle_deg"] == pytest.approx(30.0, abs=2.0)  # rolling in turbulence
        assert 200 < edge["height_above_ground_m"] < 400
        (strip,) = told["strips"]
        assert strip["file"] == f"{flown.name}_strip01.laz"
        assert {path.name for path in products.iterdir()} == {strip["file"], *told["files"], f"{flown.name}.json"}

    def test_the_file_contains_the_calibration(self, flown: Flown, products: Path) -> None:
        with laspy.open(next(products.glob("*_strip01.laz"))) as reader:
            ours = next(vlr for vlr in reader.header.vlrs if vlr.user_id == "swath")
        assert json.loads(ours.record_data)["calibrations"] == {
            "left": record(products)["flights"][0]["calibrations"]["left"]["id"]
        }

    def test_the_trajectory_that_was_used_can_be_used_again(self, flown: Flown, products: Path, tmp_path: Path) -> None:
        again = flown.arguments(tmp_path / "again")
        again[again.index("--trajectory") + 1] = str(products / f"{flown.name}_trajectory.sbet")
        assert run_app(again) == 0
        one, other = (laspy.read(next(path.glob("*_strip01.laz"))) for path in (products, tmp_path / "again"))
        assert np.abs(one.xyz - other.xyz).max() <= 0.001 + 1e-9

    def test_an_attitude_about_the_plumb_line_is_converted_to_the_ellipsoid(self, flown: Flown, tmp_path: Path) -> None:
        """The reference is the matrix of FORMULAS 1.8 (headings are geodetic), applied to the true body."""
        xi, eta = np.radians(np.array([100.0, -70.0]) / 3600)
        config = tmp_path / "plumb.toml"
        text = (flown.folder / "swath.toml").read_text()
        config.write_text(f'{text}\n[attitude]\nvertical = "plumb"\nxi_arcsec = 100.0\neta_arcsec = -70.0\n')
        for name in ("main.dbc", "left.nominal.toml", "plan.toml"):
            (tmp_path / name).write_bytes((flown.folder / name).read_bytes())
        assert run_app(flown.arguments(tmp_path / "out", "--config", str(config), "--no-sigma")) == 0
        las, truth = laspy.read(next((tmp_path / "out").glob("*_strip01.laz"))), flown.truth
        at_ns, of_ns = truth["trajectory.gps_ns"] - truth["left.gps_ns"][0], truth["left.gps_ns"]
        lat, lon, height_m = (truth[f"trajectory.{name}"] for name in ("lat_rad", "lon_rad", "height_m"))
        to_e = Transformer.from_crs(4979, 4978, always_xy=True)
        places_e = np.stack(to_e.transform(np.degrees(lon), np.degrees(lat), height_m), axis=1)
        body_e = np.stack([np.interp(of_ns - of_ns[0], at_ns, column) for column in places_e.T], axis=1)
        middle = len(lat) // 2
        (sin_lat, cos_lat), (sin_lon, cos_lon) = ((np.sin(x[middle]), np.cos(x[middle])) for x in (lat, lon))
        ned = np.array(
            [
                [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
                [-sin_lon, cos_lon, 0.0],
                [-cos_lat * cos_lon, -cos_lat * sin_lon, -sin_lat],
            ]
        )
        turn = np.array([[1.0, 0.0, -xi], [0.0, 1.0, -eta], [xi, eta, 1.0]])
        tilted_e = body_e + (truth["left.point_e"] - body_e) @ (ned.T @ turn @ ned).T
        to_map = Transformer.from_crs("EPSG:4978", "EPSG:32632", always_xy=True)
        expected = np.stack(to_map.transform(*tilted_e.T), axis=1)
        of_time = np.lexsort((truth["left.return_number"], of_ns))
        mine = np.lexsort((np.asarray(las.return_number), np.asarray(las.gps_time)))
        assert np.abs(las.xyz[mine] - expected[of_time]).max() < 0.002
        assert np.abs(tilted_e - truth["left.point_e"]).max() > 0.1
        again = flown.arguments(tmp_path / "again", "--config", str(config), "--no-sigma")
        again[again.index("--trajectory") + 1] = str(tmp_path / "out" / f"{flown.name}_trajectory.sbet")
        assert run_app(again) == 0
        twice = laspy.read(next((tmp_path / "again").glob("*_strip01.laz")))
        assert np.abs(las.xyz - twice.xyz).max() <= 0.001 + 1e-9  # what is written refers to the plumb line again

    def test_without_a_trajectory_imu_and_receiver_are_navigated(self, flown: Flown, tmp_path: Path) -> None:
        arguments = flown.arguments(tmp_path / "x", "--no-sigma")
        del arguments[arguments.index("--trajectory") : arguments.index("--trajectory") + 2]
        assert run_app(arguments) in (0, 1)  # so short a flight is not aligned at once, so it may be partial
        (flight,) = record(tmp_path / "x")["flights"]
        assert flight["trajectory"]["name"] == "navigation of the log's IMU and GNSS"
        assert flight["trajectory"]["epochs"] > 1000

    def test_without_imu_or_receiver_the_error_names_the_missing_device(
        self, flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        text = re.sub(r"(?ms)^\[imu\..*?(?=^\[(?!imu))", "", (flown.folder / "swath.toml").read_text())
        config = flown.folder / "no_imu.toml"
        config.write_text(text)
        arguments = flown.arguments(tmp_path / "x", "--config", str(config))
        del arguments[arguments.index("--trajectory") : arguments.index("--trajectory") + 2]
        line = refused(capsys, tmp_path / "x", arguments)
        assert "no IMU" in line
        assert "give --trajectory FILE" in line


class TestStrips:
    def times(self, flown: Flown, path: Path, *spans_s: tuple[float, float]) -> Path:
        """Write a file of strips from spans in seconds since the first return."""
        first = int(flown.truth["left.gps_ns"][0])
        lines = [f"{first + round(start * S)},{first + round(end * S)}" for start, end in spans_s]
        path.write_text("\n".join(["start_gps_ns,end_gps_ns", *lines]))
        return path

    def test_every_return_is_written_or_counted(self, flown: Flown, tmp_path: Path) -> None:
        file = self.times(flown, tmp_path / "times.csv", (2.0, 16.0), (16.0, 29.5))
        assert run_app(flown.arguments(tmp_path / "out", "--strips", str(file), "--json")) == 0
        told = record(tmp_path / "out")
        counts = told["counts"]["left"]
        truth_ns = np.sort(flown.truth["left.gps_ns"])
        assert counts["read"] == len(truth_ns)
        assert counts["written"] + sum(counts["dropped"].values()) == counts["read"]
        assert set(counts["dropped"]) == {"between_strips"}
        times = []
        for number, (start, end) in enumerate(((2.0, 16.0), (16.0, 29.5)), start=1):
            las = laspy.read(tmp_path / "out" / f"{flown.name}_strip{number:02d}.laz")
            assert set(np.asarray(las.point_source_id)) == {number}
            since = np.sort(np.asarray(las.gps_time)) + 1e9 - truth_ns[0] / 1e9
            assert abs(since[0] - start) < 0.05  # a datagram belongs to one strip as a whole
            assert abs(since[-1] - end) < 0.05
            times.append(since)
        joined = np.concatenate(times)
        assert len(joined) == counts["written"]
        assert np.diff(joined).min() >= 0

    def test_a_strip_that_the_trajectory_does_not_reach_is_partial(
        self, flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        first = int(flown.truth["left.gps_ns"][0])
        short = flown.trajectory().between(first - 20 * S, first + 4 * S)
        (tmp_path / "short.csv").write_text(csv_text(short))
        arguments = flown.arguments(tmp_path / "out", "--strips", "whole")
        arguments[arguments.index("--trajectory") + 1] = str(tmp_path / "short.csv")
        assert run_app(arguments) == 1
        assert "partial" in capsys.readouterr().err
        told = record(tmp_path / "out")
        outside = int((flown.truth["left.gps_ns"] > short.span[1]).sum())
        assert told["counts"]["left"]["dropped"] == {"outside_trajectory": outside}
        assert told["holes"] == [f"strip 1: {outside:,} returns of left are outside the trajectory"]

    def test_cloud_optimised_files_contain_the_same_points(self, flown: Flown, products: Path, tmp_path: Path) -> None:
        assert run_app(flown.arguments(tmp_path / "out", "--copc", "--no-sigma")) == 0
        with laspy.CopcReader.open(tmp_path / "out" / f"{flown.name}_strip01.copc.laz") as reader:
            found = reader.query()
        plain = laspy.read(next(products.glob("*_strip01.laz")))
        orders = [np.lexsort((np.asarray(las.Z), np.asarray(las.gps_time))) for las in (found, plain)]
        assert np.array_equal(np.asarray(found.X)[orders[0]], np.asarray(plain.X)[orders[1]])
        assert list(found.point_format.extra_dimension_names) == []


class TestPartial:
    def test_a_damaged_chunk_is_named_and_the_others_are_processed(
        self, flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        log = flown.copy_of_log(tmp_path / "bad")
        chunks = index_log(open_logs([log])[0]).scanner_chunks()
        chunk = chunks[len(chunks) // 2]
        data = bytearray(log.read_bytes())
        data[chunk.offset + chunk.length // 2] ^= 0xFF
        log.write_bytes(data)
        assert run_app(flown.arguments(tmp_path / "out", log=log)) == 1
        assert "partial" in capsys.readouterr().err
        told = record(tmp_path / "out")
        assert not told["complete"]
        assert len(told["holes"]) == 1
        assert log.name in told["holes"][0]
        assert "CRC" in told["holes"][0]
        missing = len(flown.truth["left.gps_ns"]) - told["counts"]["left"]["written"]
        assert 0 < missing < 5_000

    def test_a_truncated_log_is_processed_to_its_end(self, flown: Flown, tmp_path: Path) -> None:
        log = flown.copy_of_log(tmp_path / "cut")
        log.write_bytes(log.read_bytes()[: log.stat().st_size * 2 // 3])
        assert run_app(flown.arguments(tmp_path / "out", log=log)) == 1
        told = record(tmp_path / "out")
        assert not told["complete"]
        assert any("the file ends" in line or "unreadable" in line for line in told["holes"])
        assert told["counts"]["left"]["written"] > 20_000

    def test_an_interrupted_run_leaves_no_files(
        self, flown: Flown, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def interrupted(*_: object) -> None:
            raise KeyboardInterrupt

        monkeypatch.setattr("swath.daemon.processing.georeferencing.run.write_sidecar", interrupted)
        monkeypatch.setattr("swath.daemon.processing.georeferencing.run._write_trajectory", interrupted)
        assert run_app(flown.arguments(tmp_path / "out")) == 130
        assert not (tmp_path / "out").exists()


class TestRefusals:
    def test_products_of_an_earlier_run_are_kept(
        self, flown: Flown, products: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        before = {path.name: path.stat().st_mtime_ns for path in products.iterdir()}
        assert run_app(flown.arguments(products)) == 2
        assert "--overwrite" in capsys.readouterr().err
        assert {path.name: path.stat().st_mtime_ns for path in products.iterdir()} == before

    @pytest.mark.parametrize("command", ["georef", "calibrate", "validate", "strips"])
    def test_force_trajectory_needs_a_trajectory_file(
        self, command: str, flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        arguments = [command, str(flown.log), "-o", str(tmp_path / "out"), "--force-trajectory"]
        if command == "validate":
            arguments.insert(1, str(flown.folder / "left.true.toml"))
        assert run_app(arguments) == 2
        assert "--force-trajectory: needs --trajectory FILE, because it accepts that file" in capsys.readouterr().err
        assert list(tmp_path.iterdir()) == []

    def test_a_trajectory_is_replaced_only_on_request_and_never_if_it_is_read(
        self, flown: Flown, products: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        (made,) = products.glob("*_trajectory.csv")
        there = tmp_path / made.name
        shutil.copy(made, there)
        before = there.stat().st_mtime_ns
        arguments = flown.arguments(tmp_path)
        assert run_app(arguments) == 2
        assert f"{there}: already exists; choose another folder or use --overwrite" in capsys.readouterr().err
        arguments[arguments.index("--trajectory") + 1] = str(there)
        assert run_app([*arguments, "--overwrite"]) == 2
        assert f"{there}: is an input and would be overwritten" in capsys.readouterr().err
        assert [path.name for path in tmp_path.iterdir()] == [made.name]
        assert there.stat().st_mtime_ns == before

    def test_strips_of_a_run_of_several_sessions_are_kept(
        self, flown: Flown, products: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        """The sidecar of such a run has the name of the first session."""
        (made, *_) = products.glob("*_strip*.laz")
        shutil.copy(made, tmp_path)
        assert run_app(flown.arguments(tmp_path)) == 2
        assert (
            f"{tmp_path / made.name}: already exists; choose another folder or use --overwrite"
            in capsys.readouterr().err
        )
        assert [path.name for path in tmp_path.iterdir()] == [made.name]

    def test_a_single_session_is_not_replaced_if_the_sidecar_covers_several(
        self, flown: Flown, products: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        (sidecar,) = products.glob("*.json")
        record = json.loads(sidecar.read_text())
        record["flights"].insert(0, record["flights"][0] | {"session": "20260101T080000-first"})
        there = tmp_path / "20260101T080000-first.json"
        there.write_text(json.dumps(record))
        assert run_app([*flown.arguments(tmp_path), "--overwrite"]) == 2
        said = capsys.readouterr().err
        assert f"{there}: belongs to one run with 20260101T080000-first; process all its sessions at once" in said
        assert said.count("\n") == 1
        assert [path.name for path in tmp_path.iterdir()] == [there.name]

    @pytest.mark.parametrize(
        ("shift_s", "words"),
        [
            (18, "its time is UTC, not GPS: add +18 s"),
            (-7 * 86_400, "its week is wrong: add -1"),
            (3 * 3600, "do not overlap; give the trajectory of this flight, or --week"),
        ],
    )
    def test_error_names_a_trajectory_of_another_time(
        self, flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str], shift_s: int, words: str
    ) -> None:
        truth = flown.trajectory()
        (tmp_path / "late.csv").write_text(csv_text(replace(truth, time_ns=truth.time_ns - shift_s * S)))
        arguments = flown.arguments(tmp_path / "out")
        arguments[arguments.index("--trajectory") + 1] = str(tmp_path / "late.csv")
        line = refused(capsys, tmp_path / "out", arguments)
        assert "late.csv" in line
        assert words in line

    def test_error_names_times_in_seconds_of_day(
        self, flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        table = np.frombuffer(sbet_bytes(flown.trajectory()), "<f8").reshape(-1, 17).copy()
        table[:, 0] %= DAY_NS // S
        (tmp_path / "day.sbet").write_bytes(table.tobytes())
        arguments = flown.arguments(tmp_path / "out")
        arguments[arguments.index("--trajectory") + 1] = str(tmp_path / "day.sbet")
        assert "seconds of the day" in refused(capsys, tmp_path / "out", arguments)

    @pytest.mark.parametrize(
        ("more", "words"),
        [
            (("--strips", "nowhere.csv"), "nowhere.csv"),
            (("--min-strip", "500"), "no strip"),
            (("--scale", "0.0000001"), "exceeds the range of a LAS file"),
            (("--trajectory-at", "nose"), "want body, antenna, scanner or x,y,z"),
            (("--scheduler", "tcp://127.0.0.1:1"), "no Dask scheduler"),
            (("--calibration", "right=left.true.toml"), "left.true.toml"),
        ],
    )
    def test_wrong_options_are_refused(
        self,
        flown: Flown,
        tmp_path: Path,
        capsys: pytest.CaptureFixture[str],
        monkeypatch: pytest.MonkeyPatch,
        more: tuple[str, str],
        words: str,
    ) -> None:
        monkeypatch.setattr("swath.daemon.processing.points.workers.CONNECT_S", 1)
        assert words in refused(capsys, tmp_path / "out", flown.arguments(tmp_path / "out", *more))

    def test_a_calibration_of_another_head_or_atmosphere_is_refused(
        self, flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        text = (flown.folder / "left.true.toml").read_text()
        for old, new, words in (
            ('scanner_serial = "', 'scanner_serial = "other-', "another head"),
            ('refraction = "none"', 'refraction = "ardc"', "estimated with refraction"),
        ):
            assert old in text
            (tmp_path / "other.toml").write_text(text.replace(old, new))
            arguments = flown.arguments(tmp_path / "out")
            arguments[arguments.index("--calibration") + 1] = str(tmp_path / "other.toml")
            line = refused(capsys, tmp_path / "out", arguments)
            assert "other.toml" in line
            assert words in line

    def test_error_names_the_clock_by_messages_and_not_the_trajectory(
        self, flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        lines = (flown.folder / "swath.toml").read_text().replace('[pps.main]\nsource = "/dev/pps0"\n', "").splitlines()
        config = flown.folder / "no_pps.toml"
        config.write_text("\n".join(line for line in lines if line != 'pps = "main"'))
        output = tmp_path / "out"
        capsys.readouterr()
        assert run_app(flown.arguments(output, "--config", str(config))) == 1
        line = capsys.readouterr().err
        assert line.startswith(f"swath: {flown.log}: scanner/left: ")
        assert "record PPS edges and time messages throughout" in line
        assert not list(output.glob("*"))

    def test_earth_centred_coordinates_are_refused_as_a_map(
        self, flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("swath.daemon.processing.flights.read.read_clocks", None)  # before any work
        arguments = flown.arguments(tmp_path / "out")
        arguments[arguments.index("--crs") + 1] = "EPSG:4978"
        line = refused(capsys, tmp_path / "out", arguments)
        assert line.startswith('swath: output.crs = "EPSG:4978" (WGS 84) is geocentric; ')

    def test_two_recordings_of_one_time_are_refused(
        self, flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        log = flown.copy_of_log(tmp_path / "second")
        renamed = log.read_bytes().replace(flown.name.encode(), flown.name[:-4].encode() + b"0000")
        log.write_bytes(renamed)
        line = refused(capsys, tmp_path / "out", flown.arguments(tmp_path / "out", str(log)))
        assert "the recordings overlap in time" in line


def test_georef_ends_with_calibration_trajectory_crs_density_and_time(
    flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    capsys.readouterr()
    assert run_app(flown.arguments(tmp_path / "points")) == 0
    lines, told = capsys.readouterr().out.splitlines(), record(tmp_path / "points")
    calibration, trajectory, crs, surface, density, seconds = lines[-7:-1]
    assert surface.startswith("surface for the sigmas: planes under ")
    (entry,) = told["flights"][0]["calibrations"].values()
    assert calibration == f"calibration: {entry['id']} of left, made {entry['created'][:10]}, {entry['verdict']}"
    sizes = r"sigmas [\d.]+\s.m in plan, [\d.]+\s.m in height, .*° roll and pitch, .*° heading"
    assert re.fullmatch(rf"trajectory: .*; {sizes}; .*", trajectory)
    assert crs.startswith(f"CRS: {told['crs']['name']}")
    assert f"heights {told['crs']['heights']}" in crs
    totals = told["totals"]
    assert totals["points"] == sum(strip["points"] for strip in told["strips"])
    assert re.fullmatch(r"density: [\d.]+ per m²( \([\d.]+ last returns\))?, all strips together; .* km²", density)
    assert f"; {totals['points']:,} points, {totals['strips']} strip" in density
    assert re.fullmatch(r"time: [\d.]+ s, [\d,]+ returns a second", seconds)
    for strip in told["strips"]:
        (low, high), area_m2 = strip["bounds"], strip["area_m2"]
        assert 0.3 < area_m2 / ((high[0] - low[0]) * (high[1] - low[1])) <= 1.02
        assert strip["density_m2"]["all"] == pytest.approx(strip["points"] / area_m2)
        assert strip["last_returns"] <= strip["points"]
        assert f"{strip['points']:,} points" in lines[strip["number"] - 1]
    assert max(strip["area_m2"] for strip in told["strips"]) <= totals["area_m2"]
    assert "elapsed_s" not in told  # two runs write the same sidecar
    sigma = told["flights"][0]["trajectory"]["quality"]["sigma_rms"]
    assert 0.0 < sigma["north_m"] < 1.0


def test_georef_with_a_nominal_calibration_prints_a_warning_and_exits_with_1(
    flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = flown.arguments(tmp_path / "points")
    arguments[arguments.index("--calibration") + 1] = str(flown.folder / "left.nominal.toml")
    capsys.readouterr()
    assert run_app(arguments) == 1
    said = capsys.readouterr()
    first = said.out.splitlines()[0]
    assert first.startswith("not to be used: calibration ")
    assert "is nominal: points may lie 2.5 m off at 100 m of range" in first
    assert "--accept-verdict" in said.err
    told = record(tmp_path / "points")
    assert told["complete"]
    assert told["verdict"]["level"] == "not to be used"
    las = laspy.read(next((tmp_path / "points").glob("*.laz")))
    assert np.median(las["sigma_northing"]) > 1.0  # a degree at more than 100 m
    assert run_app([*arguments, "--overwrite", "--accept-verdict"]) == 0
    assert record(tmp_path / "points")["verdict"]["accepted"]
