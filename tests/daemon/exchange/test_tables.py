"""Tests that tables of records go through ``swath import``: an export comes in again, and gives the same trajectory."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import swath as library
from swath.daemon.config import load_config
from swath.daemon.errors import UserError
from swath.daemon.exchange.capture_files import ImportOptions, find_captures
from swath.daemon.exchange.routes import Routes
from swath.daemon.processing.records.files import _with_validity
from tests.daemon.commands import swath
from tests.daemon.exchange.builders import run_import, write_config
from tests.daemon.short_flight import Flown
from tests.library.builders import fly

CONFIG = """
[session]
name = "records"
directory = "logs"

[gnss.rover]
transport = "udp:0.0.0.0:9001"
protocol = "records"
lever_arm_m = [0.1, -0.05, -1.2]

[imu.main]
transport = "udp:0.0.0.0:9002"
protocol = "records"
rate_hz = 100
"""
KINDS = {"gnss/rover": ("fixes", "headings", "marks", "times"), "imu/main": ("samples", "solutions")}
# of samples, the counter gives way to the GPS time that is known by then
REPLACED = {"device_time_ns", "pps_time_ns", "gps_week"}


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    return fly(tmp_path_factory.mktemp("tables"), seconds=20.0)


def with_records(text: str) -> str:
    """Return a configuration whose receiver and inertial unit have protocol records, with the same arms and noise."""
    tables = re.split(r"(?m)^(?=\[)", text)
    made = ""
    for number, table in enumerate(tables):
        name = table.partition("]")[0]
        if name in ("[gnss.rover", "[imu.main"):
            kept = [line for line in table.splitlines() if line.startswith(("lever", "secondary", "rate_hz"))]
            table = "\n".join(
                [f"{name}]", f'transport = "udp:0.0.0.0:{9000 + number}"', 'protocol = "records"', *kept, ""]
            )
        if not name.startswith(("[scanner", "[pps", "[imu.main.signals", "[output", "[plan")):
            made += table + "\n"
    return made


@pytest.mark.slow
@pytest.mark.parametrize("form", ["csv", "parquet"])
def test_an_export_comes_in_again_as_it_was(flown: Flown, tmp_path: Path, form: str) -> None:
    """All values of all tables are equal, but for the counters of samples, and so is the navigated trajectory."""
    done = swath("export", str(flown.folder / "logs"), str(tmp_path / "out"), "--records", form)
    assert done.returncode == 0, done.stderr
    [folder] = (tmp_path / "out").iterdir()
    (folder / f"scanner-left_returns.{form}").unlink()
    config = write_config(tmp_path, with_records((flown.folder / "swath.toml").read_text()))
    report, captures = run_import(config, [folder], tmp_path / "logs")
    assert set(report.units) == {"gnss/rover", "imu/main"}
    assert not any(capture.tally.damage for capture in captures)
    before, after = library.open(flown.folder / "logs"), library.open(tmp_path / "logs")
    for source, kinds in KINDS.items():
        for kind in kinds:
            of_before = "gnss/rover" if kind == "solutions" else source
            one, other = before.to_pandas(of_before, kind).reset_index(), after.to_pandas(source, kind).reset_index()
            assert list(one.columns) == list(other.columns)
            assert len(one) > 10
            if kind == "samples":  # whose sigma is kept in single precision
                np.testing.assert_allclose(other.pop("time_sigma_s"), one.pop("time_sigma_s"), rtol=1e-7)
            for name in set(one.columns) - REPLACED:
                np.testing.assert_array_equal(other[name], one[name], err_msg=f"{kind} {name}")
    tracks = [library.navigate(log).trajectory for log in (before, after)]
    for name in ("time_ns", "position_e", "q_e_from_b", "velocity_e", "position_sigma_l"):
        np.testing.assert_array_equal(getattr(tracks[1], name), getattr(tracks[0], name), err_msg=name)


def test_a_table_finds_its_device(tmp_path: Path) -> None:
    """By the name of an export, else by its columns; solutions of a receiver become those of the inertial unit."""
    place = "lat_deg,lon_deg,height_m"
    for name, columns in (
        ("positions.csv", place),
        ("gnss-rover_fixes.csv", place),
        ("gnss-rover_solutions.csv", f"{place},roll_deg,pitch_deg,heading_deg"),
        ("times.csv", "edge"),
    ):
        (tmp_path / name).write_text(f"gps_ns,{columns},note\n")
    routes = Routes.of(write_config(tmp_path, CONFIG))
    files = sorted(tmp_path.glob("*.csv"))
    captures = {capture.path.name: capture for capture in find_captures(routes, files, ImportOptions())}
    sources = {name: capture.port.source for name, capture in captures.items() if capture.port is not None}
    assert sources == {
        "positions.csv": "gnss/rover",
        "gnss-rover_fixes.csv": "gnss/rover",
        "gnss-rover_solutions.csv": "imu/main",
        "times.csv": "gnss/rover",
    }
    assert [capture.tells_time for capture in captures.values()] == [False, True, False, False]
    assert captures["times.csv"].tally.passed == {"columns (note)": 1}
    [only] = find_captures(routes, [], ImportOptions([f"gnss/rover={tmp_path / 'positions.csv'}"]))
    assert only.tells_time


@pytest.mark.parametrize(
    ("config", "named", "words"),
    [
        (CONFIG, "", 'holds rows of [scanner.…]; devices of protocol "records" that fit: none; want a section with'),
        (CONFIG.replace("imu.main", "imu.b").replace("9002", "9") + CONFIG[CONFIG.index("[imu") :], "", "table"),
        (CONFIG, "gnss/rover", "is no table of fixes: missing columns such as lat_rad"),
    ],
)
def test_a_table_without_a_device_is_refused_in_a_line(tmp_path: Path, config: str, named: str, words: str) -> None:
    path = tmp_path / "some.csv"
    path.write_text("gps_ns,x_m,y_m,z_m\n")
    if words == "table":
        path.write_text("a,b\n")
        words = 'is a table; devices of protocol "records" that fit: gnss/rover or imu/b or imu/main; want --source'
    write_config(tmp_path, config)
    routes = Routes.of(load_config(tmp_path / "swath.toml"))
    options = ImportOptions([f"{named}={path}"] if named else [])
    with pytest.raises(UserError) as refused:
        find_captures(routes, [] if named else [path], options)
    assert words in str(refused.value)
    assert len(str(refused.value).splitlines()) == 1


def test_solutions_that_the_device_does_not_vouch_for_are_left_out(tmp_path: Path) -> None:
    """An INS of NovAtel that aligns sends attitudes of 0; its status is known to the export only."""
    columns: dict[str, Any] = {"status": np.array([1, 3, 6], np.uint32), "roll_rad": np.zeros(3)}
    assert _with_validity(columns, "novatel")["valid"].tolist() == [False, True, True]
    assert _with_validity(columns, "records")["valid"].tolist() == [True, True, True]
    head = "gps_ns,lat_deg,lon_deg,height_m,roll_deg,pitch_deg,heading_deg,status,valid\n"
    rows = [f"{1_465_549_218_000_000_000 + n},47,8,500,0,0,{n},{status},{valid}\n" for n, status, valid in LOST]
    (tmp_path / "ins.csv").write_text(head + "".join(rows))
    run_import(write_config(tmp_path, CONFIG), [tmp_path / "ins.csv"], tmp_path / "logs")
    with library.open(tmp_path / "logs") as log:
        solutions = log["imu/main"].solutions()
    assert np.degrees(solutions["heading_rad"]).round().tolist() == [2.0, 3.0]


LOST = ((1, 1, "false"), (2, 3, "true"), (3, 6, "true"))
