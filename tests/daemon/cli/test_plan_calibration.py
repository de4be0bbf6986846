"""Tests ``swath plan-calibration``: verdicts of plans with known answers, the picture, and refusals."""

from __future__ import annotations

import contextlib
import io
import json
from pathlib import Path
from typing import Any

import pytest
import typer
from pypdf import PdfReader

from swath.daemon.cli.plan_calibration import command
from swath.daemon.errors import ExitCode, UserError
from tests.daemon.processing.pages.builders import Tables, faults_of

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("kernels")]

HEAD = """
[flight]
name = "planned"
lead_s = 3.0
bank_max_deg = 38.0

[terrain]
height_m = 450.0
relief_m = 0.0
cell_m = 10.0

[imu.main]
grade = "{grade}"

[control]
points = 10

[scanner.left]
kind = "{kind}"
prf_hz = {prf_hz}
range_max_m = 2500.0
"""
VILLAGE = """
[[terrain.village]]
center_m = [0.0, 0.0]
size_m = [300.0, 300.0]
heading_deg = 20.0
houses = 40
"""
# Only boresight and range offset are unknown; further unknown parameters would blur them
KNOWN = """
model = "basic"
[parameters]
range_scale_ppm = { prior = 1.0 }
scan_angle_scale_ppm = { prior = 2.0 }
scan_plane_tilt_deg = { prior = 0.0002 }
time_offset_us = { prior = 5.0 }
"""
OPPOSITE = (("there", (-350, 0), (350, 0), 1150), ("back", (350, 0), (-350, 0), 1150))
CROSSING = (
    *OPPOSITE,
    ("beside", (-350, 200), (350, 200), 1150),
    ("down", (0, 350), (0, -350), 1150),
    ("up", (150, -350), (150, 350), 1150),
)


def plan_of(
    folder: Path,
    lines: Any = CROSSING,
    more: str = "",
    grade: str = "tactical",
    kind: str = "oscillating",
    prf_hz: float = 50_000.0,
) -> str:
    text = HEAD.format(grade=grade, kind=kind, prf_hz=prf_hz) + more
    for name, (x0, y0), (x1, y1), height in lines:
        text += (
            f'[[line]]\nname = "{name}"\nfrom_m = [{x0}.0, {y0}.0]\nto_m = [{x1}.0, {y1}.0]\nheight_m = {height}.0\n'
        )
    path = folder / "plan.toml"
    path.write_text(text)
    return str(path)


def planned(plan: str, picture: Path, **options: Any) -> None:
    model = Path(plan).with_name("known.toml")
    model.write_text(KNOWN)
    asked = {
        "model": str(model),
        "sigmas": None,
        "no_control": False,
        "control_sigma": 0.01,
        "as_json": True,
        "overwrite": True,
    }
    command(plan, picture, **asked | options)


def sigmas_of(told: Any) -> dict[str, float]:
    return {row["name"]: row["sigma"] for row in told["parameters"]}


@pytest.fixture(scope="module")
def over_a_village(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Any]:
    """Plan crossing lines over a village once; return the picture and the JSON output."""
    folder, written = tmp_path_factory.mktemp("village"), io.StringIO()
    with contextlib.redirect_stdout(written):
        planned(plan_of(folder, more=VILLAGE), folder / "plan.png")
    return folder / "plan.png", json.loads(written.getvalue())


def test_lines_over_a_village_determine_the_boresight(over_a_village: tuple[Path, Any]) -> None:
    """The sigmas have realistic sizes, and the picture has one page."""
    picture, told = over_a_village
    assert told["verdict"] == "This flight determines boresight and range offset, and 4 of 4 others."
    assert told["picture"] == str(picture)
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert told["planes"] > 60
    assert told["control_points"] >= 8
    expected = told["trajectory_sigmas"]
    assert 0.005 < expected["position_m"] < 0.02
    assert 0.002 < expected["roll_pitch_deg"] < 0.01
    sigma = sigmas_of(told)
    assert 0.001 < sigma["omega_deg"] < 0.004
    assert 0.002 < sigma["kappa_deg"] < 0.01
    assert sigma["range_offset_m"] < 0.02


def test_sigmas_follow_the_expected_trajectory_accuracy(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Half the trajectory's sigmas give hardly more than half the calibration's."""
    plan, picture = plan_of(tmp_path, more=VILLAGE), tmp_path / "plan.png"
    found = []
    for sigmas in ("0.02,0.004,0.01", "0.01,0.002,0.005"):
        planned(plan, picture, sigmas=sigmas)
        told = json.loads(capsys.readouterr().out)
        assert ",".join(f"{part:g}" for part in told["trajectory_sigmas"].values()) == sigmas
        found.append(sigmas_of(told))
    for name in ("omega_deg", "phi_deg", "kappa_deg"):
        assert 0.45 < found[1][name] / found[0][name] < 0.7


@pytest.mark.parametrize(
    ("noise", "worse"),
    [
        # more gyroscope noise makes all angles worse, heading included
        ("angle_random_walk_deg_per_sqrt_h = 0.3", {"omega_deg": 1.5, "phi_deg": 1.5, "kappa_deg": 1.5}),
        # misaligned gyroscopes look like pitch after a turn
        ("misalignment_mrad = 1.0", {"phi_deg": 1.5}),
    ],
)
def test_sigmas_follow_the_noise_of_the_imu(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    over_a_village: tuple[Path, Any],
    noise: str,
    worse: dict[str, float],
) -> None:
    """Single figures of the plan count, not only the IMU's grade."""
    with contextlib.suppress(UserError):
        planned(plan_of(tmp_path, more=f"{VILLAGE}[imu.main.noise]\n{noise}\n"), tmp_path / "plan.png")
    found, usual = sigmas_of(json.loads(capsys.readouterr().out)), sigmas_of(over_a_village[1])
    for name, factor in worse.items():
        assert found[name] / usual[name] > factor, (name, found)


def test_parameters_of_a_model_file_are_predicted_and_its_tables_are_not(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A held heading may be wrong by a degree, which blurs roll; tables are reported as not predicted."""
    plan, picture, model = (
        plan_of(tmp_path, more=VILLAGE, prf_hz=100_000.0),
        tmp_path / "plan.png",
        tmp_path / "model.toml",
    )
    model.write_text(
        f'{KNOWN}kappa_deg = "fixed"\nphi_deg = {{ prior = 0.0001 }}\n'
        "[ibrc]\nknots = [100, 1000]\n[range_offset]\nreturn_slots = [1, 2]\n"
    )
    with pytest.raises(UserError, match=r"This flight does not determine roll \(ω\)"):
        planned(plan, picture, model=str(model))
    told = json.loads(capsys.readouterr().out)
    assert told["verdict"] == "This flight does not determine roll (ω)."
    known = {"range_scale_ppm", "scan_angle_scale_ppm", "scan_plane_tilt_deg", "time_offset_us"}
    assert set(sigmas_of(told)) == {"omega_deg", "phi_deg", "range_offset_m", *known}
    assert sigmas_of(told)["phi_deg"] < 0.0001
    words = ("ibrc at 100, 1000, smooth to 0.02 m", "range offset of return slot 1, 2")
    assert told["notes"] == [
        f"not predicted: {one}; planned pulses have one return, without intensity" for one in words
    ]
    with pytest.raises(typer.Exit):
        planned(plan_of(tmp_path, OPPOSITE, prf_hz=10_000.0), picture, model=str(model), as_json=False)
    assert "not predicted: ibrc at 100, 1000" in capsys.readouterr().out


def test_without_a_receiver_the_trajectory_follows_the_grade(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = Path(plan_of(tmp_path, more=VILLAGE))
    path.write_text("gnss = {}\n" + path.read_text())
    planned(str(path), tmp_path / "plan.png")
    told = json.loads(capsys.readouterr().out)
    assert told["trajectory_sigmas"] == {"position_m": 0.02, "roll_pitch_deg": 0.004, "heading_deg": 0.01}


def test_opposite_lines_over_flat_ground_determine_roll_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Pitch, heading and range are declared undeterminable, each with what to fly; control determines the range.

    There are few returns: a body that pitches in gusts shows its scanner's pitch by heights, to 0.005° with so good a
    unit and all returns of 100 kHz.
    """
    plan, picture = plan_of(tmp_path, OPPOSITE, grade="navigation", prf_hz=10_000.0), tmp_path / "plan.pdf"
    with pytest.raises(typer.Exit) as ended:  # stderr does not repeat the verdict
        planned(plan, picture, no_control=True, as_json=False)
    assert ended.value.exit_code == ExitCode.PROBLEM
    told = capsys.readouterr().out
    assert told.count("does not determine pitch (φ), heading (κ) and range offset.") == 1
    assert "left phi_deg: " in told
    assert "to determine it: fly opposite lines over roofs or slopes that face along the track" in told
    assert "left range_offset_m: " in told
    assert "at least 8 points at 1 cm" in told
    assert picture.read_bytes().startswith(b"%PDF")
    with pytest.raises(UserError, match=r"does not determine pitch \(φ\) and heading \(κ\)\."):
        planned(plan, picture)


def test_two_lines_do_not_separate_roll_from_the_levelling_of_a_poor_imu(tmp_path: Path) -> None:
    """An accelerometer's bias tilts both lines to the same side of the body, as the boresight's roll does."""
    with pytest.raises(UserError, match=r"does not determine roll \(ω\), pitch \(φ\)"):
        planned(plan_of(tmp_path, OPPOSITE), tmp_path / "plan.png")


def test_a_poor_imu_is_reported_before_the_flight(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A MEMS unit's attitude on the same lines is too poor for these sigmas."""
    with pytest.raises(UserError, match="does not determine"):
        planned(plan_of(tmp_path, more=VILLAGE, grade="mems"), tmp_path / "plan.svg")
    told = json.loads(capsys.readouterr().out)
    assert any(not row["determined"] and row["sigma"] for row in told["parameters"])


@pytest.mark.parametrize(
    ("made", "options", "words"),
    [
        (
            {"kind": "nutating"},
            {},
            "a nutating scanner cannot be planned for; want one of oscillating, polygon, monogon",
        ),
        ({"lines": OPPOSITE[:1]}, {"no_control": True}, "no two lines see the same roof or ground"),
        (
            {"more": "[[gnss.rover.outage]]\nat_s = 0.0\nfor_s = 3000.0\n"},
            {},
            "gnss.rover.outage: lasts the whole flight; let it end",
        ),
        ({}, {"model": "all"}, '--model: got "all", want basic, scanner, full, or a file FILE.toml'),
        ({}, {"sigmas": "0.02,0.004"}, '--sigmas: got "0.02,0.004", want three numbers'),
        ({}, {"sigmas": "0.02,0,0.01"}, '--sigmas: got "0.02,0,0.01", want numbers above 0'),
    ],
)
def test_an_impossible_plan_is_refused_in_one_line(
    tmp_path: Path, made: dict[str, Any], options: dict[str, Any], words: str
) -> None:
    with pytest.raises(UserError) as ended:
        planned(plan_of(tmp_path, **made), tmp_path / "plan.png", **options)
    assert words in ended.value.message
    assert "\n" not in ended.value.message
    assert ended.value.exit_code == ExitCode.USAGE


def test_a_page_shows_verdict_parameters_and_what_to_fly(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="does not determine"):
        planned(plan_of(tmp_path, OPPOSITE), tmp_path / "plan.html", no_control=True)
    text = (tmp_path / "plan.html").read_text(encoding="utf-8")
    assert faults_of(text) == []
    (parameters, missing) = Tables(text).tables[:2]
    assert parameters[0] == ["parameter", "unit", "predicted sigma", "largest useful sigma", "determined"]
    rows = {row[0]: row for row in parameters[1:]}
    assert rows["boresight ω (roll)"][1:2] + rows["boresight ω (roll)"][3:4] == ["°", "0.005"]
    undetermined = {row[0] for row in parameters[1:] if row[4] == "no"}
    assert undetermined == {row[0] for row in missing[1:]}
    assert undetermined
    assert "This flight does not determine" in text
    assert "EPSG:32632" in text
    read = PdfReader(tmp_path / "plan.pdf")
    assert read.metadata is not None
    assert str(read.metadata.title).endswith(": planned calibration")


def test_unwritable_pictures_are_reported_in_one_line(tmp_path: Path) -> None:
    plan = plan_of(tmp_path, OPPOSITE)
    with pytest.raises(UserError, match=r"plan.bmp: want a file's name that ends in one of .html, .pdf, .png, .svg"):
        planned(plan, tmp_path / "plan.bmp")
    with pytest.raises(UserError, match=r"plan\.toml: File exists") as ended:
        planned(plan, Path(plan) / "plan.png")
    assert ended.value.exit_code == ExitCode.IO
