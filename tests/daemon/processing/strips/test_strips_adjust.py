"""Tests ``swath strips --adjust`` from a log to corrected trajectories: the error of one strip is found."""

from __future__ import annotations

import errno
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from pyproj import Transformer

from swath.daemon.cli.main import run_app
from swath.daemon.errors import ExitCode, UserError
from swath.daemon.processing.carried_verdict import ADJUSTMENT, file_verdicts
from swath.daemon.processing.strips import adjust as strip_adjust
from swath.daemon.processing.strips import adjust_products as strip_adjust_products
from swath.daemon.processing.strips.adjust import AdjustOptions, StripsCorrected, correct_strips
from swath.daemon.processing.strips.adjust_products import write_adjustment
from swath.georef.formats.trajectory.csv import csv_text
from swath.georef.formats.trajectory.file import read_trajectory
from swath.georef.geodesy.earth import rot_e_from_l
from swath.georef.trajectory.trajectory import Trajectory
from swath.georef.verdicts import Level
from tests.calib.village import Made, judge_unusable, village

pytestmark = [pytest.mark.xdist_group("kernels"), pytest.mark.slow]

UP_M = 0.12
LIFTED = 1  # index of the swath whose trajectory is put too high


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    return village(tmp_path_factory.mktemp("village"), lines=(0, 1, 2))


def raised(made: Made, up_m: float, swaths: tuple[int, ...]) -> Trajectory:
    """Return the true trajectory, raised along some strips by `up_m`."""
    trajectory, margin_ns = made.trajectory, 2_000_000_000
    lat, lon, _ = trajectory.geodetic()
    up_e = -rot_e_from_l(lat, lon)[:, :, 2]
    position_e = trajectory.position_e.copy()
    for number in swaths:
        times = made.flight.swaths[number].time_ns
        along = (trajectory.time_ns > times[0] - margin_ns) & (trajectory.time_ns < times[-1] + margin_ns)
        position_e[along] += up_m * up_e[along]
    return replace(trajectory, position_e=position_e)


@pytest.fixture(scope="module")
def lifted(made: Made, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a trajectory file that is 12 cm too high along one strip."""
    path = tmp_path_factory.mktemp("lifted") / "lifted.csv"
    path.write_text(csv_text(raised(made, UP_M, (LIFTED,))))
    return path


def arguments(made: Made, trajectory: Path, output: Path, *more: str) -> list[str]:
    given = ("--trajectory", str(trajectory), "--trajectory-datum", "same", "--workers", "1")
    calibration = ("--calibration", str(made.flown.folder / "left.true.toml"))
    return ["strips", str(made.flown.log), *given, *calibration, "--adjust", str(output), *more]


Done = tuple[AdjustOptions, StripsCorrected]


@pytest.fixture(scope="module")
def adjusted_once(made: Made, lifted: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Done]:
    """Return the folder written by the command, and its outcome before it was written."""
    folder = tmp_path_factory.mktemp("adjusted") / "new" / "folder"
    outcomes: list[Done] = []

    def kept(request: AdjustOptions, returns: Path, tell: Any) -> StripsCorrected:
        outcomes.append((request, correct_strips(request, returns, tell)))
        return outcomes[-1][1]

    with patch.object(strip_adjust, "correct_strips", kept):
        assert run_app(arguments(made, lifted, folder)) == 0
    return folder, outcomes[0]


@pytest.fixture
def adjusted(adjusted_once: tuple[Path, Done]) -> Path:
    return adjusted_once[0]


@pytest.fixture
def done(adjusted_once: tuple[Path, Done]) -> Done:
    return adjusted_once[1]


def record_of(folder: Path) -> Any:
    return json.loads((folder / ADJUSTMENT).read_text())


def trajectory_of(folder: Path, suffix: str) -> Path:
    (path,) = folder.glob(f"*_trajectory{suffix}")
    return path


def test_strip_errors_are_found_within_their_sigma(made: Made, adjusted: Path) -> None:
    strips = record_of(adjusted)["strips"]
    numbers = [swath.strip for swath in made.flight.swaths]
    assert [strip["strip"] for strip in strips] == numbers
    assert [strip["model"] for strip in strips] == ["none", "constant", "none"]
    assert strips[0]["mean"] is None
    found = strips[LIFTED]
    assert all(gain > 10.0 for model, gain in found["criterion_gains"].items() if model != "constant")
    for knot in found["knots"]:
        assert 0.0 < knot["sigma_down_m"] < 0.02
        assert abs(knot["down_m"] - UP_M) < 3.0 * knot["sigma_down_m"]
        assert abs(knot["north_m"]) < 3.0 * knot["sigma_north_m"] <= 3.0 * knot["prior_sigma_north_m"]
    times = made.flight.swaths[LIFTED].time_ns
    assert found["knots"][0]["gps_ns"] <= times[0] < times[-1] <= found["knots"][-1]["gps_ns"]


def test_strips_agree_after_adjustment(adjusted: Path) -> None:
    record = record_of(adjusted)
    before, after = (record["differences"][when]["all"]["rms_m"] for when in ("before", "after"))
    assert before > 0.08
    assert after < 0.035  # two returns of 2 cm
    lifted = record["strips"][LIFTED]["rms_dz_m"]
    assert lifted["before"] == pytest.approx(UP_M, abs=0.02)
    assert lifted["after"] < 0.035
    assert record["variance"]["after"] < 1.0 < 2.0 < record["variance"]["before"]


def test_no_calibration_is_written(made: Made, adjusted: Path) -> None:
    record = record_of(adjusted)
    assert record["what"].startswith("Correction of the trajectory by strips")
    assert "No calibration" in record["what"]
    assert record["calibrations_held"] == {"left": made.truth.id}
    assert {path.suffix for path in adjusted.iterdir()} == {".json", ".csv", ".sbet", ".smrmsg"}
    hashes = {entry["name"]: entry["sha256"] for entry in [*record["inputs"], *record["trajectories"]]}
    assert {made.flown.log.name, "lifted.csv", "left.true.toml", trajectory_of(adjusted, ".csv").name} <= set(hashes)
    assert any("the datum is not determined" in note for note in record["notes"])


def test_the_corrected_trajectory_is_readable_and_needs_no_correction(
    made: Made, adjusted: Path, tmp_path: Path
) -> None:
    for suffix in (".csv", ".sbet"):
        path = trajectory_of(adjusted, suffix)
        first = int(made.trajectory.time_ns[0])
        read = read_trajectory(path.read_bytes(), path.name, span_ns=(first, first + 1))
        times = made.flight.swaths[LIFTED].time_ns
        along = (read.time_ns > times[0]) & (read.time_ns < times[-1])
        heights_m, true_m = (one.geodetic()[2][along] for one in (read, made.trajectory))
        np.testing.assert_allclose(heights_m, true_m, rtol=0.0, atol=0.015)
    assert run_app(arguments(made, path, tmp_path / "again")) == 0
    assert {strip["model"] for strip in record_of(tmp_path / "again")["strips"]} == {"none"}


def check_table(made: Made, told: str) -> None:
    """Check what is printed about the corrections of a lifted strip by a constant."""
    assert f"no calibration; held: left {made.truth.id}" in told
    assert "note: model of all strips: constant\n" in told
    assert "file tells no sigmas, and no sigma here contains its errors" in told  # the true calibration's
    row = next(line for line in told.splitlines() if line.startswith(f"{made.flight.swaths[LIFTED].strip:02d} "))
    assert "constant" in row
    assert "not determined" in row  # over almost level ground its horizontal shift is not determined
    assert "→" in row


def test_an_unusable_trajectory_is_reported_first_and_stays_unusable(
    made: Made, lifted: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The exit code is 1; the files are written, and products made with them carry the verdict.

    The table lists the corrections, and the calibration is unchanged.
    """
    file, calibration = tmp_path / "flight.csv", made.flown.folder / "left.true.toml"
    was = calibration.read_bytes(), calibration.stat().st_mtime_ns
    file.write_bytes(lifted.read_bytes())
    judge_unusable(file, "the lever arm has another sign")
    output = tmp_path / "out"
    assert run_app(arguments(made, file, output, "--strip-model", "constant")) == 1
    told = capsys.readouterr()
    line = f"not to be used: trajectory {file}: the lever arm has another sign"
    assert told.out.splitlines()[0] == line
    assert told.err.endswith('swath: the verdict is "not to be used"; use --accept-verdict to accept it\n')
    assert line not in told.err
    (said,), source = file_verdicts(trajectory_of(output, ".sbet"), made.trajectory.span)
    assert (said.level, source) == (Level.UNUSABLE, "navigated")
    check_table(made, told.out)
    assert str(output / ADJUSTMENT) in told.out
    assert (calibration.read_bytes(), calibration.stat().st_mtime_ns) == was
    assert run_app(arguments(made, file, output, "--strip-model", "constant", "--overwrite", "--accept-verdict")) == 0
    assert record_of(output)["verdict"]["accepted"]


def test_a_common_shift_is_found_with_control(made: Made, tmp_path: Path) -> None:
    path = tmp_path / "high.csv"
    path.write_text(csv_text(raised(made, UP_M, (0, 1, 2))))
    on_map = tmp_path / "control.txt"
    on_map.write_text(utm32_text(made.flown.folder / "control.csv"))
    control = ("--control", str(on_map), "--control-crs", "EPSG: 25832", "--strip-model", "constant")
    assert run_app(arguments(made, path, tmp_path / "out", *control)) == 0
    record = record_of(tmp_path / "out")
    assert record["control"] > 0
    assert any("points in EPSG:25832 (ETRS89 / UTM zone 32N), heights above" in note for note in record["notes"])
    assert any("no point has a sigma: 0.02 m is used" in note for note in record["notes"])
    assert not any("datum is not determined" in note for note in record["notes"])
    for strip in record["strips"]:
        mean = strip["mean"]
        assert abs(mean["down_m"] - UP_M) < 3.0 * mean["sigma_down_m"] < 0.5 * UP_M


def utm32_text(control: Path, *, swapped: bool = False) -> str:
    """Return the points of a control file as an office exports them, with decimal commas."""
    to_map = Transformer.from_crs("EPSG:4979", "EPSG:32632", always_xy=True)
    lines = ["Punkt-Nr.;Hochwert;Rechtswert;Höhe;Code" if swapped else "Punkt-Nr.;Rechtswert;Hochwert;Höhe;Code"]
    for row in control.read_text().splitlines()[1:]:
        name, lat, lon, height, _ = row.split(",")
        east, north, up = to_map.transform(float(lon), float(lat), float(height))
        lines.append(f"{name};{east:.4f};{north:.4f};{up:.4f};GCP".replace(".", ","))
    return "\n".join(lines) + "\n"


# ---------------------------------------------------------------------- what cannot be


def spans(folder: Path, *times: tuple[int, int]) -> tuple[str, str]:
    """Return the option for strips at these times (GPS ns)."""
    path = folder / "strips.csv"
    path.write_text("\n".join(["start_gps_ns,end_gps_ns", *(f"{start},{end}" for start, end in times)]) + "\n")
    return "--strips", str(path)


def refused(capsys: pytest.CaptureFixture[str], given: list[str]) -> tuple[int, str]:
    """Return exit code and the only line of a command that made nothing."""
    capsys.readouterr()
    code = run_app(given)
    line = capsys.readouterr().err
    assert line.startswith("swath: ")
    assert line.count("\n") == 1, line
    assert "internal error" not in line
    return code, line


def test_mistakes_are_reported_in_one_line_and_leave_no_files(
    made: Made, lifted: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "out"
    times = [(int(swath.time_ns[0]), int(swath.time_ns[-1])) for swath in made.flight.swaths]
    beginnings = [(start, start + 2_500_000_000) for start, _ in times[:2]]  # lines are opposite: these are far apart
    far = tmp_path / "far.csv"
    far.write_text("name,lat_deg,lon_deg,h_ellipsoidal_m,sigma_m\na,47.5,9.5,450,0.02\n")
    swapped = tmp_path / "swapped.txt"
    swapped.write_text(utm32_text(made.flown.folder / "control.csv", swapped=True))
    (tmp_path / "points").mkdir()
    (tmp_path / "points" / "a.laz").touch()
    full = arguments(made, lifted, output)
    nominal = [word for word in full if word not in ("--calibration", str(made.flown.folder / "left.true.toml"))]
    points = [full[0], str(tmp_path / "points"), *full[2:]]
    for given, code, words in (
        ([*full, "--strip-model", "cubic"], 2, 'got "cubic", want one of none, constant, linear, spline, auto'),
        ([*full, "--level", "QL1"], 2, "--level is for a comparison"),
        (points, 2, "contains points; give the logs of these points"),
        (nominal, 2, "left: has only the nominal calibration"),
        ([*full, "--control", str(tmp_path / "no.csv")], 3, "no.csv: cannot be read"),
        ([*full, "--control", str(far)], 1, "no control point lies near the flight"),
        ([*full, "--control", str(swapped)], 1, "easting and northing look swapped: exchange the names of the two"),
        ([*full, "--control", str(swapped), "--control-crs", "UTM 32"], 2, "write EPSG:25832 (ETRS89 / UTM zone 32N)"),
        ([*full, *spans(tmp_path, times[0])], 1, "1 strip with returns; an adjustment compares strips"),
    ):
        found, line = refused(capsys, given)
        assert found == code, line
        assert words in line
        assert not output.exists()
    assert "no two strips see a common plane" in refused(capsys, [*full, *spans(tmp_path, *beginnings)])[1]
    assert not output.exists()


def test_existing_files_are_kept(
    made: Made, lifted: Path, adjusted: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    was = {path: path.read_bytes() for path in adjusted.iterdir()}
    code, line = refused(capsys, arguments(made, lifted, adjusted))
    assert code == 2
    assert f"{ADJUSTMENT}: already exists; choose another folder or use --overwrite" in line
    own = arguments(made, trajectory_of(adjusted, ".sbet"), adjusted, "--overwrite")
    assert "is the trajectory to correct; choose another folder" in refused(capsys, own)[1]
    assert "is a file; give a folder" in refused(capsys, arguments(made, lifted, lifted))[1]
    assert {path: path.read_bytes() for path in adjusted.iterdir()} == was
    code, line = refused(capsys, ["strips", str(made.flown.log), "--strip-model", "linear"])
    assert code == 2
    assert "needs --adjust DIR" in line


@pytest.mark.parametrize("there", [True, False], ids=["folder there", "folder not there"])
def test_a_full_disk_leaves_no_files(done: Done, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, there: bool) -> None:
    def full(record: Any, stream: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(strip_adjust_products, "write_json", full)
    output = tmp_path / "out"
    if there:
        output.mkdir()
    with pytest.raises(UserError, match=r"no space left on the disk .*; nothing written") as caught:
        write_adjustment(replace(done[0], output=output), done[1], lambda *_: None)
    assert caught.value.exit_code == ExitCode.IO
    assert "\n" not in caught.value.message
    assert output.exists() == there
    assert list(tmp_path.rglob("*")) == [output] * there


def test_a_trajectory_is_written_back_about_the_plumb_line_of_its_input(made: Made, done: Done, tmp_path: Path) -> None:
    """Otherwise the deflection of the vertical would be removed twice."""
    xi_eta_rad = tuple(np.radians([12.0 / 3600.0, -7.0 / 3600.0]))
    request, outcome = replace(done[0], output=tmp_path / "out"), done[1]
    (logged,) = outcome.kept.logged
    plumbed: Any = SimpleNamespace(
        log=logged.log,
        session=logged.session,
        setup=SimpleNamespace(deflection_rad=xi_eta_rad),
        verdicts=logged.verdicts,
        trajectory_verdicts=logged.trajectory_verdicts,
        source=logged.source,
    )
    kept = replace(outcome.kept, logged=[plumbed])
    write_adjustment(request, replace(outcome, kept=kept), lambda *_: None)
    path = trajectory_of(tmp_path / "out", ".csv")
    read = read_trajectory(path.read_bytes(), path.name)
    for turned, same in ((read, False), (read.with_deflection(*xi_eta_rad), True)):
        attitudes = np.array(turned.attitude()), np.array(outcome.adjusted.trajectories[0].attitude())
        assert np.allclose(*attitudes, rtol=0.0, atol=1e-8) == same  # the inverse is exact but for ξ · η
