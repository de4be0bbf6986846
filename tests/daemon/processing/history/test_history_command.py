"""Tests ``swath history``: calibrations below folders as table, sentences, CSV and page."""

from __future__ import annotations

import csv
import datetime as dt
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from swath.calib.calibration_file import Header, calibration_text
from swath.calib.record.record import IDENTITY, RecordInput, record_json, record_of
from swath.calib.validation.history import date_words
from swath.daemon.cli.main import run_app
from swath.daemon.errors import ExitCode
from swath.daemon.processing.history.page import _apart, history_page
from swath.daemon.processing.history.run import collect
from swath.georef.scanner.calibration import INDEX, nominal
from tests.calib.made_outcome import made_outcome

SIGMAS = {"omega_rad": np.radians(0.002), "kappa_rad": np.radians(0.004), "range_offset_m": 0.008}


FLOWN = "2025-11-12"  # in tests.calib.made_outcome


def write(folder: Path, month: int, omega_deg: float, mounting: str = "HB-ABC/left/2026-01") -> Path:
    """Write a calibration that was made in a month of 2026."""
    sigmas = np.zeros(len(INDEX))
    for name, sigma in SIGMAS.items():
        sigmas[INDEX[name]] = sigma
    one = nominal("left", [0.12, -0.03, 0.28], np.eye(3).tolist())
    one = one.changed(omega_rad=float(np.radians(omega_deg)), range_offset_m=0.35)
    one = replace(one, id=f"cal-{month}", method="planes", sigmas=sigmas, correlation=np.eye(len(INDEX)))
    header = Header(
        id=one.id,
        created=dt.datetime(2026, month, 5, 10, tzinfo=dt.UTC),
        method="planes",
        scanner_serial="S-17",
        installation=mounting,
        logs=(),
        variance_factor=1.0,
        redundancy=1000,
    )
    path = folder / f"{month:02d}" / "left.toml"
    path.parent.mkdir(parents=True)
    path.write_text(calibration_text(one, header))
    return path


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    """Return a folder with four calibrations; ω jumps before the third, and the scanner is mounted anew after it."""
    folder = tmp_path / "archive"
    for month, omega_deg in ((1, 0.250), (2, 0.251), (3, 0.280)):
        write(folder, month, omega_deg)
    write(folder, 6, 0.41, "HB-ABC/left/2026-06")
    (folder / "swath.toml").write_text("[recording]\n")  # a configuration is TOML too
    return folder


def test_the_console_shows_table_changes_and_courses(archive: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_app(["history", str(archive)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "left, serial S-17: 4 calibrations"
    assert lines[1].split() == ["flown", "calibration", "mounting", "ω", "°", "κ", "°", "Δρ", "m"]
    assert lines[2].split()[:6] == ["2026-01-05", "cal-1", "HB-ABC/left/2026-01", "0.2500", "±", "0.0020"]
    changed = "2026-02-05 to 2026-03-05: changed: omega_deg +0.0290 ± 0.0028 (10.3 σ)"
    assert any(line.startswith(changed) for line in lines)
    assert any(line.startswith("2026-03-05 to 2026-06-05, mounted anew: changed: omega_deg ") for line in lines)
    assert "HB-ABC/left/2026-01: boresight ω (roll): jumped by +0.0295 ± 0.0024° between 2026-02-05 and 2026-03-05" in (
        lines
    )
    assert any(line.startswith("HB-ABC/left/2026-01: range offset: constant, 0.3500 ± 0.0046 m") for line in lines)


def test_files_that_are_left_out_are_named_where_there_is_no_calibration(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "left.toml").write_text("[calibration]\nid = 1\n[parameters]\n")
    assert run_app(["history", str(tmp_path)]) == ExitCode.PROBLEM
    told = capsys.readouterr().err.splitlines()
    assert len(told) == 2
    assert told[0].startswith(f"swath: {tmp_path}/left.toml: ")
    assert told[0].endswith("; it was left out")
    assert told[1].endswith("no calibration there; give folders with files of swath calibrate")


@pytest.mark.slow
def test_page_pdf_and_csv_are_written(archive: Path, tmp_path: Path) -> None:
    output = tmp_path / "out"
    assert run_app(["history", str(archive), "-o", str(output)]) == 0
    assert sorted(path.name for path in output.iterdir()) == ["history.csv", "history.html", "history.pdf"]
    page = (output / "history.html").read_text(encoding="utf-8")
    assert page.count("data:image/png;base64") == 3
    for words in ("left, serial S-17", "From one calibration to the next", "boresight ω (roll)", "jumped by +0.0295"):
        assert words in page, words
    rows = list(csv.DictReader((output / "history.csv").read_text().splitlines()))
    assert [row["id"] for row in rows] == ["cal-1", "cal-2", "cal-3", "cal-6"]
    assert float(rows[2]["omega_deg"]) == pytest.approx(0.28)
    assert (rows[2]["omega_deg_sigma"], rows[2]["phi_deg_sigma"]) == ("0.002", "")
    assert (output / "history.pdf").read_bytes().startswith(b"%PDF")
    (output / "history.pdf").unlink()
    assert run_app(["history", str(archive), "-o", str(output)]) == ExitCode.USAGE  # as everywhere
    assert not (output / "history.pdf").exists()
    assert run_app(["history", str(archive), "-o", str(output), "--overwrite"]) == 0
    assert (output / "history.pdf").exists()


@pytest.mark.slow
def test_a_table_of_many_parameters_fits_a_sheet_and_dates_do_not_cover_each_other(archive: Path) -> None:
    """Calibrations of one flight have the same date, so their marks are drawn side by side."""
    collected = collect([archive])
    (scanner,) = collected.scanners
    wide = replace(scanner.entries[0], sigmas=np.full(len(INDEX), 1e-3))
    one = replace(scanner, entries=(wide, *scanner.entries[1:]))
    page = history_page(replace(collected, scanners=(one,)))
    heads = re.findall(r"<thead><tr>(.*?)</tr></thead>", page, re.S)
    assert max(head.count("<th") for head in heads) <= 6
    assert '4</b><span class="muted">calibrations' in page
    assert '2</b><span class="muted">significant changes' in page
    moved = _apart(np.array([20_000.0, 20_000.0, 20_100.0]))
    assert moved[0] == 20_000.0
    assert 1.0 < moved[1] - moved[0] < 3.0
    assert moved[2] == 20_100.0


def test_json_has_values_steps_and_courses(archive: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_app(["history", str(archive), "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    (scanner,) = record["scanners"]
    assert (scanner["scanner"], scanner["serial"]) == ("left", "S-17")
    assert [step["changed"] for step in scanner["steps"]] == [False, True, True]
    assert scanner["calibrations"][0]["sigmas"]["omega_deg"] == pytest.approx(0.002)
    jump = next(one for one in scanner["courses"] if one["parameter"] == "omega_deg")
    assert (jump["course"], jump["between"]) == ("jump", ["2026-02-05", "2026-03-05"])


def test_copies_count_once_and_contradicting_ones_are_named(archive: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = (archive / "01" / "left.toml").read_text()
    (archive / "copy.toml").write_text(text)
    (archive / "edited.toml").write_text(text.replace("omega_deg = 0.25", "omega_deg = 0.26", 1))
    (archive / "broken.toml").write_text("[calibration]\nid = 3\n")
    assert run_app(["history", str(archive)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "left, serial S-17: 4 calibrations"
    edited = f"{archive / 'edited.toml'}: has the id of {archive / '01' / 'left.toml'}, cal-1, but other values"
    assert any(line.startswith(edited) for line in lines)
    assert any(str(archive / "broken.toml") in line and line.endswith("it was left out") for line in lines)


@pytest.mark.slow
def test_a_calibration_only_in_a_record_is_one_of_its_scanner(
    archive: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Recent records have the scanner's serial number; older ones have only its name."""
    made = made_outcome()
    document = json.loads(
        record_json(record_of(RecordInput(made.flight, made.features, made.adjusted, "left", made.header)))
    )
    (archive / "report").mkdir()
    record = archive / "report" / "left.record.json"
    record.write_text(json.dumps(document))
    collected = collect([archive])
    assert [(one.serial, len(one.entries)) for one in collected.scanners] == [("S-17", 4), ("S2221234", 1)]
    assert date_words(collected.scanners[1].times_s[0])[:10] == FLOWN
    record.write_text(json.dumps({key: value for key, value in document.items() if key not in IDENTITY}))
    assert run_app(["history", str(archive)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "left, serial S-17: 5 calibrations"
    assert any(line.startswith(f"{FLOWN}  2026-11-21T10:15:00Z-ab12  mounting not recorded") for line in lines)


def test_what_has_no_calibration_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_app(["history", str(tmp_path)]) == ExitCode.PROBLEM
    assert "no calibration there; give folders with files of swath calibrate" in capsys.readouterr().err
    assert run_app(["history", str(tmp_path / "none")]) == ExitCode.IO
    assert capsys.readouterr().err == f"swath: {tmp_path / 'none'}: no such file or folder\n"
