"""Tests ``swath strips`` on files of `swath georef` and on a flight: verdicts, exit codes, words."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import typer
from pypdf import PdfReader
from pyproj import CRS

from swath.calib.flight import Flight
from swath.calib.strips.cells import StripRules
from swath.calib.verdict import overall_rms_m
from swath.daemon.cli import strips
from swath.daemon.errors import ExitCode, UserError
from swath.daemon.processing.calibration.products import strips_entry
from swath.daemon.processing.calibration.returns import refuse_installations
from swath.daemon.processing.quicklook.run import look_at, numbers_of
from swath.daemon.processing.setup.setup import Options, Setup
from swath.daemon.processing.strip_agreement import before_and_after, difference_map
from swath.daemon.processing.strips.inputs import strips_of_files, strips_of_flight
from swath.georef.formats.trajectory.csv import csv_text
from swath.georef.mapping.frame import Mapping
from swath.georef.timescales.gps_time import WEEK_NS
from tests.calib.cast_flight import Cast, cast_flight
from tests.daemon.builders import EAST_M, NORTH_M, lattice, plane, write_laz
from tests.daemon.processing.pages.builders import faults_of
from tests.daemon.standin import aircraft_config

pytestmark = pytest.mark.xdist_group("kernels")

LINES = ((-150, 0, 150, 0, 850), (150, 40, -150, 40, 850))
FLAT = "height_m = 450.0\nrelief_m = 0.0"


def run(*arguments: str) -> None:
    """Run the command in this process."""
    app = typer.Typer()
    app.command()(strips.command)
    app(args=list(arguments), standalone_mode=False)


def lifted(folder: Path, lift_m: float, south_m: float = 30.0) -> Path:
    """Return two strips over a slope, the second higher."""
    folder.mkdir()
    for number, (south, lift) in enumerate([(0.0, 0.0), (south_m, lift_m)], start=1):
        x, y = lattice(EAST_M, NORTH_M + south, 120.0, 50.0, 0.5)
        write_laz(folder / f"s{number}.laz", x, y, plane(x, y) + lift, number, crs=CRS.from_epsg(25832))
    return folder


@pytest.fixture(scope="module")
def made() -> Cast:
    """Return two opposite lines over flat ground."""
    return cast_flight(FLAT, LINES, prf_hz=40_000.0, true={})


def products(
    folder: Path,
    flight: Flight,
    mapping: Mapping | None = None,
    *,
    session: str = "a",
    up_m: float = 0.0,
    of_week: Sequence[int] = (),
) -> Path:
    """Write a flight's points as a folder of `swath georef`: LAZ for each strip, trajectory, sidecar.

    Strips ``of_week`` have the seconds of the GPS week, as other programs write them.
    """
    folder.mkdir()
    mapping = mapping or Mapping("EPSG:25832", datum="same")
    for number, swath in enumerate(flight.swaths, start=1):
        points = mapping.map_from_e(flight.frame.e_from_t(np.asarray(swath.points_t)))
        seconds = (swath.time_ns - 1_000_000_000_000_000_000) / 1e9
        if number in of_week:
            seconds = swath.time_ns % WEEK_NS / 1e9
        number_of = np.asarray(swath.rows["number_of_returns"])
        write_laz(
            folder / f"a_strip{number:02d}.laz",
            points[:, 0],
            points[:, 1],
            points[:, 2] + up_m,
            number,
            crs=CRS.from_epsg(25832),
            adjusted=number not in of_week,
            gps_time=seconds,
            return_number=np.asarray(swath.rows["return_number"]),
            number_of_returns=number_of,
        )
    (folder / f"{session}_trajectory.csv").write_text(csv_text(flight.trajectories[0]))
    sidecar = {
        "flights": [{"session": session}],
        "strips": [
            {
                "number": number,
                "file": f"a_strip{number:02d}.laz",
                "first_gps_ns": int(swath.time_ns.min()),
            }
            for number, swath in enumerate(flight.swaths, start=1)
        ],
        "crs": mapping.description(),
    }
    (folder / "a.json").write_text(json.dumps(sidecar))
    return folder


@pytest.mark.slow
def test_record_and_table_show_the_numbers_of_a_lifted_strip(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = lifted(tmp_path / "now", 0.07)
    run(str(folder), "-o", str(tmp_path / "out"), "--json")
    record = json.loads(capsys.readouterr().out)
    (pair,) = record["pairs"]
    assert (pair["first"], pair["second"]) == ("1", "2")
    for numbers in (pair["dz"], pair["gridded"], record["all"]["gridded"]):
        assert numbers["mean_m"] == pytest.approx(-0.07, abs=2e-4)
        assert numbers["rms_m"] == pytest.approx(0.07, abs=2e-4)
        assert numbers["max_m"] == pytest.approx(0.07, abs=5e-4)
        assert numbers["std_m"] == pytest.approx(0.0, abs=1e-3)
    assert pair["point_to_plane"]["mean_m"] == pytest.approx(-0.07 / np.hypot(1.0, np.hypot(0.12, 0.07)), abs=2e-4)
    assert record["quality"]["best"] == "QL2"  # 4 pulses a square metre are too few for QL1
    assert record["signatures"] is None
    assert any("no trajectory" in line or "no signatures" in line for line in record["notes"])
    assert json.loads((tmp_path / "out" / "strips.json").read_text()) == record
    assert (tmp_path / "out" / "differences.png").read_bytes()[:4] == b"\x89PNG"
    assert record["page"] == str(tmp_path / "out" / "strips.html")


def test_the_page_begins_with_the_verdict_and_shows_strips_pairs_and_the_map(tmp_path: Path) -> None:
    folder = lifted(tmp_path / "now", 0.07)
    with pytest.raises(UserError):
        run(str(folder), "-o", str(tmp_path / "out"), "--level", "QL1")
    text = (tmp_path / "out" / "strips.html").read_text(encoding="utf-8").replace("\xa0", " ")
    sentence = "Not to be used: strips do not meet QL1, because of its limit of 8 pulses per m²; strips agree to 7.0 cm"
    assert 0 < text.index(sentence) < text.index("<h2>Strips</h2>") < text.index("<h2>Pairs</h2>")
    assert "data:image/png;base64" in text
    for cell in ("<td>1</td><td>1</td>", "<td>−7.0</td><td>7.0</td>", "<td>+7.0</td><td>7.0</td>"):
        assert cell in text, cell
    assert faults_of(text) == []
    read = PdfReader(tmp_path / "out" / "strips.pdf")
    assert read.metadata is not None
    assert read.metadata.title == "now: comparison of strips"


@pytest.mark.slow
def test_the_console_has_verdict_strips_and_the_ten_worst_pairs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Six strips over one slope, each 1 cm above the previous one, have 15 pairs."""
    folder = tmp_path / "six"
    folder.mkdir()
    x, y = lattice(EAST_M, NORTH_M, 120.0, 50.0, 0.5)
    for number in range(1, 7):
        z = plane(x, y) + 0.01 * number
        write_laz(folder / f"s{number}.laz", x, y, z, number, crs=CRS.from_epsg(25832))
    run(str(folder), "-o", str(tmp_path / "out"))
    lines = capsys.readouterr().out.splitlines()
    assert re.fullmatch(r"Good: strips agree to \d\.\d cm \(RMSDz of 15 pairs\), and meet QL0\.", lines[0])
    assert lines[1].split()[:4] == ["strip", "pairs", "cells", "above"]
    assert [line.split()[0] for line in lines[2:8]] == ["1", "2", "3", "4", "5", "6"]
    assert [line.split()[3] for line in (lines[2], lines[7])] == ["−3.0", "+3.0"]
    assert lines[8] == "the 10 worst of 15 pairs, cm (--all-pairs shows all)"
    pairs = [line for line in lines if re.match(r"\d − \d ", line)]
    assert len(pairs) == 10
    assert pairs[0].startswith("1 − 6 ")
    assert lines[20].startswith("all ")
    assert len(set(lines)) == len(lines)
    run(str(folder), "--all-pairs")
    told = capsys.readouterr().out
    assert len(re.findall(r"^\d − \d ", told, re.MULTILINE)) == 15
    assert "--all-pairs" not in told
    record = json.loads((tmp_path / "out" / "strips.json").read_text())
    assert len(record["pairs"]) == 15


@pytest.mark.slow
def test_a_significant_effect_is_named_once(made: Cast, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bad = products(tmp_path / "bad", made.flight.placed({"left": made.truth.changed(omega_rad=4e-4)}))
    with pytest.raises(UserError):
        run(str(bad))
    told = capsys.readouterr().out
    assert told.splitlines()[0].startswith("Usable with care: roll: opposite strips tilt")
    assert told.splitlines()[1] == "remedy: run swath calibrate; it estimates all parameters together"
    assert told.count("roll:") == 1


def test_numbers_before_and_after_are_shown_side_by_side(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    now, then = lifted(tmp_path / "now", 0.01), lifted(tmp_path / "then", 0.20)
    run(str(now), "--before", str(then), "-o", str(tmp_path / "out"))
    told = capsys.readouterr().out
    assert "before: RMSDz 20.0 cm, largest 20.0 cm; now: RMSDz 1.0 cm, largest 1.0 cm" in told
    assert "strips meet QL2; QL1 fails its limit of 8 pulses per m²" in told
    assert "confirm them against the edition in the contract" in told
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "differences.png",
        "differences_before.png",
        "strips.html",
        "strips.json",
        "strips.pdf",
    ]
    text = (tmp_path / "out" / "strips.html").read_text(encoding="utf-8")
    assert "<td>before</td><td>−20.0</td><td>20.0</td>" in text
    assert "overlapping strips, before" in text


def test_a_missed_quality_level_is_a_problem(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Standard output has the verdict, which stderr does not repeat; with --json stderr has it instead."""
    folder = lifted(tmp_path / "now", 0.12)
    run(str(folder), "--level", "QL3")
    said = "strips do not meet QL2, because of its limit of 0.08 m RMSDz"
    with pytest.raises(UserError, match=re.escape(said)) as caught:
        run(str(folder), "--level", "QL2", "--json")
    assert caught.value.exit_code == ExitCode.PROBLEM
    capsys.readouterr()
    with pytest.raises(UserError) as caught:
        run(str(folder), "--level", "QL2")
    assert (caught.value.message, caught.value.exit_code) == ("", ExitCode.PROBLEM)
    assert said in capsys.readouterr().out.splitlines()[0]


@pytest.mark.slow
def test_a_wrong_roll_is_named_and_is_a_problem(made: Cast, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    good = products(tmp_path / "good", made.flight)
    run(str(good), "--json")
    record = json.loads(capsys.readouterr().out)
    effects = {one["name"]: one for one in record["signatures"]["effects"]}
    assert effects["roll"]["level"] == "none"
    assert record["notes"] == []
    bad = products(tmp_path / "bad", made.flight.placed({"left": made.truth.changed(omega_rad=4e-4)}))
    with pytest.raises(UserError, match=r"roll: opposite strips tilt .* to omega_deg") as caught:
        run(str(bad), "--json")
    assert caught.value.exit_code == ExitCode.PROBLEM
    roll = next(one for one in json.loads(capsys.readouterr().out)["signatures"]["effects"] if one["name"] == "roll")
    assert roll["value"] == pytest.approx(np.degrees(-4e-4), abs=3.5 * roll["sigma"])
    assert roll["sigma"] < 0.005


@pytest.mark.slow
def test_a_flight_and_its_files_give_the_same_differences(made: Cast, tmp_path: Path) -> None:
    """One way uses arrays in t, the other LAZ in a projection."""
    of_flight = strips_of_flight("flight", made.flight, StripRules())
    of_files = strips_of_files([products(tmp_path / "p", made.flight)], StripRules(), lambda *_: None)
    numbers = [one.look.overlap.numbers() for one in (of_flight, of_files)]
    assert numbers[0] is not None
    assert numbers[1] is not None
    assert numbers[0]["rms_m"] == pytest.approx(numbers[1]["rms_m"], rel=0.1)
    heights = of_files.gathered.points[:, 2], of_flight.gathered.points[:, 2]
    assert float(np.median(heights[0])) == pytest.approx(float(np.median(heights[1])), abs=0.05)


@pytest.mark.slow
def test_every_command_gives_the_same_figure_and_level_for_one_cloud(
    made: Cast, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """These are `calibrate`, the map of its report, `strips` and `view`; coordinates of files are rounded to 0.1 mm."""
    mapping = Mapping("EPSG:25832", datum="same")
    mapping.settle(made.flight.trajectories[0].position_e[:1])
    folder = products(tmp_path / "p", made.flight, mapping)
    run(str(folder), "--json")
    told = json.loads(capsys.readouterr().out)["quality"]
    seen = numbers_of(look_at([folder]))["quality"]
    tilted = made.flight.placed({"left": made.truth.changed(omega_rad=1e-3)})
    before, after = before_and_after(tilted, made.flight, mapping)
    calibrated = strips_entry(after)
    drawn = difference_map(before, after, 400)
    assert drawn is not None
    assert drawn.after_words == f"RMSDz {100.0 * told['rmsdz_m']:.1f} cm"
    assert before.rms_m > 5.0 * after.rms_m
    report = overall_rms_m(after.pairs())
    for rms_m in (seen["rmsdz_m"], calibrated["all"]["rms_m"], calibrated["quality"]["rmsdz_m"], report):
        assert rms_m == pytest.approx(told["rmsdz_m"], abs=5e-5)
    assert told["best"] is not None
    assert seen["best"] == calibrated["quality"]["best"] == told["best"]
    assert seen["measure"] == calibrated["quality"]["measure"] == told["measure"]
    assert after.agreement.level_words == f"strips meet {told['best']}"


@pytest.mark.slow
@pytest.mark.parametrize(
    "said",
    [
        {},  # EPSG:7912, moved to ETRS89
        {'datum = "EPSG:7912"': 'datum = "same"'},
        {'datum = "EPSG:7912"\n': "", "datum_accuracy_m = 0.05": "datum_accuracy_m = 2.0"},
    ],
)
def test_the_datum_is_taken_from_the_configuration(made: Cast, tmp_path: Path, said: dict[str, str]) -> None:
    """Points and trajectory must agree, whatever source and accuracy of the datum was configured."""
    setup = Setup.of_config(aircraft_config(tmp_path / "c", said), Options(crs="EPSG:25832", uncertainty=False))
    assert setup.mapping is not None
    setup.mapping.settle(made.flight.trajectories[0].position_e[:1])
    folder = products(tmp_path / "p", made.flight, setup.mapping)
    of_files = strips_of_files([folder], StripRules(), lambda *_: None)
    assert of_files.notes == []
    assert of_files.seen is not None
    swath, gathered = made.flight.swaths[0], of_files.gathered
    own = np.flatnonzero((gathered.time_ns > swath.time_ns[0]) & (gathered.time_ns < swath.time_ns[-1]))
    pulse = np.searchsorted(swath.time_ns, gathered.time_ns[own] - 1000)  # of the file, to 0.1 µs
    assert len(own) > 1000
    there = made.flight.frame.e_from_t(np.asarray(swath.points_t[pulse]))
    assert np.abs(of_files.seen.frame.e_from_t(gathered.points[own]) - there).max() < 0.01


@pytest.mark.slow
def test_strips_with_equal_numbers_of_two_runs_are_separate(made: Cast, tmp_path: Path) -> None:
    """This includes two aircraft at one time: each strip has the trajectory of its run."""
    first = products(tmp_path / "p", made.flight)
    second = products(tmp_path / "q", made.flight, session="b", up_m=0.07)
    strips = strips_of_files([first, second], StripRules(), lambda *_: None)
    assert strips.look.names == ["1", "2", "1/2", "2/2"]
    (row,) = (row for row in strips.look.overlap.rows if (row["first"], row["second"]) == (0, 2))
    assert row["median_m"] == pytest.approx(-0.07, abs=2e-3)
    assert strips.notes == [
        f"strip {number}/2 comes from {second / f'a_strip0{number}.laz'}, which belongs to other sessions than {number}"
        for number in (1, 2)
    ]
    assert strips.seen is not None
    assert strips.seen.trajectory_index == [0, 0, 1, 1]


@pytest.mark.slow
def test_strips_of_two_scanners_processed_apart_are_the_same_strips(made: Cast, tmp_path: Path) -> None:
    folders = [products(tmp_path / name, made.flight) for name in ("left", "right")]
    strips = strips_of_files(folders, StripRules(), lambda *_: None)
    assert (strips.look.names, strips.notes) == (["1", "2"], [])


@pytest.mark.slow
@pytest.mark.parametrize("of_week", [(2,), (1, 2)])
def test_seconds_of_the_week_belong_to_the_trajectory_beside_them(
    made: Cast, tmp_path: Path, of_week: tuple[int, ...]
) -> None:
    """The header of each file decides; files that mix both kinds are named."""
    folder = products(tmp_path / "p", made.flight, of_week=of_week)
    strips = strips_of_files([folder], StripRules(), lambda *_: None)
    begin, end = made.flight.trajectories[0].span
    assert ((strips.gathered.time_ns >= begin) & (strips.gathered.time_ns <= end)).all()
    mixed = (
        "files have different kinds of times: seconds of the GPS week in a_strip02.laz; adjusted standard GPS time in "
        "a_strip01.laz"
    )
    assert [note.startswith(mixed) for note in strips.notes] == [True] * (of_week == (2,))


@pytest.mark.slow
def test_points_of_another_time_than_their_trajectory_are_reported(made: Cast, tmp_path: Path) -> None:
    folder = products(tmp_path / "p", made.flight, of_week=(1, 2))
    week = made.flight.trajectories[0].span[0] // WEEK_NS
    strips = strips_of_files([folder], StripRules(), lambda *_: None, week - 1)
    assert len(strips.notes) == 1
    assert strips.notes[0].startswith("100 % of the points lie at other times")
    with pytest.raises(UserError, match="--week 24233 is not a GPS week; give whole weeks since 1980"):
        strips_of_files([folder], StripRules(), lambda *_: None, 24233)


def test_a_sidecar_without_a_datum_is_reported(made: Cast, tmp_path: Path) -> None:
    folder = products(tmp_path / "p", made.flight)
    sidecar = json.loads((folder / "a.json").read_text())
    del sidecar["crs"]["datum_said"]
    (folder / "a.json").write_text(json.dumps(sidecar))
    (note,) = strips_of_files([folder], StripRules(), lambda *_: None).notes
    assert "no signatures: the sidecar beside the points does not give their datum" in note


@pytest.mark.parametrize("what", ["one", "apart", "twice", "nothing", "absent", "level", "cell"])
def test_incomparable_files_are_refused_in_one_line(what: str, tmp_path: Path) -> None:
    folder = lifted(tmp_path / "now", 0.0, 500.0 if what == "apart" else 30.0)
    arguments, said = [str(folder)], ""
    if what == "one":
        (folder / "s2.laz").unlink()
        said = "now: has one strip only; differences need at least two strips that overlap"
    elif what == "apart":
        said = "now: no two of the 2 strips share smooth ground"
    elif what == "twice":
        x, y = lattice(EAST_M, NORTH_M, 120.0, 50.0, 0.5)
        write_laz(folder / "s2.laz", x, y, plane(x, y), 2, crs=CRS.from_epsg(25832))
        said = "strips 1 and 2 contain the same returns under two names"
    elif what == "nothing":
        (tmp_path / "empty").mkdir()
        arguments, said = [str(tmp_path / "empty")], "has neither LAS or LAZ files nor logs"
    elif what == "absent":
        arguments, said = [str(tmp_path / "no")], "no such file or folder"
    elif what == "cell":
        arguments, said = [str(folder), "--cell", "1e9"], r"--cell: got 1e\+09, want 0\.05 to 100 metres"
    else:
        arguments, said = [str(folder), "--level", "QL9"], 'got "QL9", want one of QL0, QL1, QL2, QL3'
    with pytest.raises(UserError, match=said) as caught:
        run(*arguments)
    assert "\n" not in caught.value.message
    codes = {"nothing": ExitCode.IO, "absent": ExitCode.IO, "level": ExitCode.USAGE, "cell": ExitCode.USAGE}
    assert caught.value.exit_code == codes.get(what, ExitCode.PROBLEM)


def logged(name: str, installation: str) -> Any:
    """Return a stand-in for a logged flight that only has an installation."""
    profile = SimpleNamespace(installation=installation)
    return SimpleNamespace(log=Path(name), setup=SimpleNamespace(config=SimpleNamespace(profile=profile)))


def test_logs_of_different_installations_are_refused() -> None:
    refuse_installations([logged("a.mcap", "HB-ABC/1"), logged("b.mcap", "HB-ABC/1")])
    with pytest.raises(
        UserError,
        match=r'b\.mcap: was recorded with installation "HB-ABC/2", a\.mcap with "HB-ABC/1"; use logs of one',
    ):
        refuse_installations([logged("a.mcap", "HB-ABC/1"), logged("b.mcap", "HB-ABC/2")])


def test_a_flight_of_one_strip_is_refused(made: Cast) -> None:
    with pytest.raises(UserError, match="one strip only"):
        strips_of_flight("x.mcap", replace(made.flight, swaths=made.flight.swaths[:1]), StripRules())
