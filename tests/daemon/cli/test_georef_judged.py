"""Tests products made with a wrong trajectory or map: refused, marked, or accepted on request."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from swath.daemon.cli.main import run_app
from swath.daemon.errors import ExitCode
from swath.georef.formats.trajectory.csv import csv_text
from swath.georef.trajectory.trajectory import Trajectory
from swath.sim.fly import VirtualFlight, open_truth
from swath.sim.plan.plan import parse_plan
from tests.calib.village import judge_unusable
from tests.daemon.short_flight import Flown, fly_short, two_lines

pytestmark = [pytest.mark.xdist_group("kernels"), pytest.mark.slow]

ARM, MIRRORED = "[0.4, -0.25, -1.2]", "[-0.4, 0.25, 1.2]"
SIGN = "the lever arm has another sign"
ELSEWHERE = "lies 7.5 km off the fixes of gnss/rover"
SAID = {"away": [ELSEWHERE], "other": ["give the trajectory of this flight", "it may belong to another flight"]}


def plan(seed: int, half_m: float, norths_m: tuple[float, float]) -> str:
    """Return the plan of two lines with an antenna beside the body."""
    return two_lines(
        "judged",
        flight=f"seed = {seed}\nlead_s = 3.0",
        half_m=half_m,
        norths_m=norths_m,
        gnss=f'grade = "rtk"\nlever_arm_m = {ARM}',
        prf_hz=3000,
    )


def true_of_another_flight(folder: Path) -> Trajectory:
    """Return a trajectory at the same time over the same land, with longer lines and a wider turn to the other side."""
    folder.mkdir()
    other = parse_plan(plan(6, 800.0, (100.0, -300.0)), folder)
    VirtualFlight(other, open_truth(other, folder / "truth.npz")).finish_truth()
    told: Any = np.load(folder / "truth.npz")
    keys = ("gps_ns", "lat_rad", "lon_rad", "height_m", "velocity_l", "roll_rad", "pitch_rad", "heading_rad")
    return Trajectory.from_geodetic(*(told[f"trajectory.{key}"] for key in keys), name="other")


@dataclass(frozen=True)
class Judged:
    """The flight, and trajectories for it by name: true, judged (the true one, called unusable), away, other."""

    flown: Flown

    def trajectory(self, name: str) -> Path:
        return self.flown.folder / f"{name}.csv"

    def georef(self, output: Path, *more: str, trajectory: str = "true") -> list[str]:
        """Return the arguments of ``swath georef`` with a trajectory file."""
        crs = () if "--crs" in more else ("--crs", "EPSG:32632")
        return ["georef", str(self.flown.log), "-o", str(output), *crs, *self.given(trajectory), "--no-sigma", *more]

    def navigated(self, output: Path) -> list[str]:
        """Return the arguments of a command that navigates the log with the lever arm of opposite sign."""
        config = self.flown.changed("mirrored.toml", **{ARM: MIRRORED}).path
        more = ("--config", str(config), "--crs", "EPSG:32632", "--workers", "1", "--no-sigma")
        return ["georef", str(self.flown.log), "-o", str(output), *self.calibration, *more]

    @property
    def calibration(self) -> tuple[str, str]:
        return "--calibration", str(self.flown.folder / "left.true.toml")

    def given(self, trajectory: str) -> tuple[str, ...]:
        datum = ("--trajectory-datum", "same", "--workers", "1")
        return (*self.calibration, *datum, "--trajectory", str(self.trajectory(trajectory)))


@pytest.fixture(scope="module")
def judged(tmp_path_factory: pytest.TempPathFactory) -> Judged:
    flown = fly_short(tmp_path_factory.mktemp("judged"), plan(5, 600.0, (0.0, 200.0)))
    made, true = Judged(flown), flown.truth()
    lat, lon, height = true.geodetic()
    away = Trajectory.from_geodetic(
        true.time_ns, lat, lon + np.radians(0.1), height, true.velocity_l(), *true.attitude(), name="away"
    )
    other = true_of_another_flight(flown.folder / "other")
    for name, trajectory in (("true", true), ("judged", true), ("away", away), ("other", other)):
        made.trajectory(name).write_text(csv_text(trajectory))
    judge_unusable(made.trajectory("judged"), SIGN)
    return made


def sidecar(output: Path) -> dict[str, Any]:
    (path,) = output.glob("*.json")
    read: dict[str, Any] = json.loads(path.read_text())
    return read


# ---------------------------------------------------------------------- verdicts


def test_points_on_a_trajectory_with_a_wrong_lever_arm_exit_with_1(
    judged: Judged, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The verdict comes first with its reason; the points are written nevertheless."""
    capsys.readouterr()
    assert run_app(judged.navigated(tmp_path)) == ExitCode.PROBLEM
    said = capsys.readouterr()
    first = said.out.splitlines()[0]
    assert first.startswith("not to be used: navigated trajectory of ")
    assert "the data fit -l better than the given lever_arm_m, [-0.40, 0.25, 1.20] m" in first
    assert f"{first}; use --accept-verdict to accept it" in said.err
    told = sidecar(tmp_path)
    assert told["complete"]
    assert (told["verdict"]["level"], told["verdict"]["accepted"]) == ("not to be used", False)
    assert told["flights"][0]["trajectory"]["source"] == "navigated"
    assert len(list(tmp_path.glob("*_strip*.laz"))) == 2


def test_unusable_points_are_accepted_with_the_users_override(
    judged: Judged, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    capsys.readouterr()
    assert run_app(judged.georef(tmp_path, "--accept-verdict", trajectory="judged")) == 0
    said = capsys.readouterr()
    assert said.out.startswith(f"not to be used: trajectory {judged.trajectory('judged')}: {SIGN}")
    assert "not to be used" not in said.err
    assert sidecar(tmp_path)["verdict"]["accepted"]


@pytest.fixture(scope="module")
def points(judged: Judged, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make strips that agree, with a trajectory that was declared unusable."""
    output = tmp_path_factory.mktemp("points")
    assert run_app(judged.georef(output, trajectory="judged")) == ExitCode.PROBLEM
    assert sidecar(output)["verdict"]["level"] == "not to be used"
    return output


def test_unusable_points_exit_with_1_however_well_strips_agree(
    judged: Judged, points: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    capsys.readouterr()
    assert run_app(["strips", str(points)]) == ExitCode.PROBLEM
    said = capsys.readouterr()
    assert said.out.startswith(f"Not to be used: trajectory {judged.trajectory('judged')}: {SIGN}")
    assert said.out.count(str(judged.trajectory("judged"))) == 1
    # nothing is said about the strips, and stdout has the reason; the first run of a loop says that it is compiled
    told = [line for line in said.err.splitlines() if not line.startswith("compiling")]
    assert told == ['swath: the verdict is "not to be used"; use --accept-verdict to accept it']


def test_strips_of_unusable_points_are_compared_with_the_users_override(
    points: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    capsys.readouterr()
    assert run_app(["strips", str(points), "-o", str(tmp_path / "out"), "--accept-verdict"]) == 0
    said = capsys.readouterr()
    assert said.out.startswith("Not to be used: trajectory ")
    assert said.err == ""
    verdict = json.loads((tmp_path / "out" / "strips.json").read_text())["verdict"]
    assert (verdict["level"], verdict["accepted"]) == ("not to be used", True)


# ---------------------------------------------------------------------- trajectories of something else


@pytest.mark.parametrize("name", list(SAID))
def test_a_trajectory_of_another_flight_needs_force(
    judged: Judged, name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    capsys.readouterr()
    output = tmp_path / "out"
    assert run_app(judged.georef(output, trajectory=name)) == ExitCode.PROBLEM
    lines = capsys.readouterr().err.splitlines()
    for line, words in zip(lines, SAID[name], strict=True):
        assert words in line
        assert line.startswith(f"swath: {judged.trajectory(name)}: ")
        assert line.endswith("; use --force-trajectory to accept it")
    assert not list(tmp_path.glob("out/*"))
    assert run_app(judged.georef(output, "--force-trajectory", trajectory=name)) == 0
    capsys.readouterr()
    for words in SAID[name]:
        assert any(words in line for line in sidecar(output)["warnings"])


@pytest.mark.parametrize("command", ["calibrate", "validate", "strips"])
def test_every_command_refuses_a_trajectory_of_another_place(
    judged: Judged, command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    capsys.readouterr()
    assert run_app(on_log(judged, command, tmp_path / "out.toml", "away")) == ExitCode.PROBLEM
    said = capsys.readouterr()
    (line,) = said.err.splitlines()
    assert ELSEWHERE in line
    assert line.endswith("; use --force-trajectory to accept it")
    assert said.out == ""
    assert not (tmp_path / "out.toml").exists()


@pytest.mark.parametrize("command", ["validate", "strips"])
def test_a_forced_trajectory_of_another_place_gives_a_warning(
    judged: Judged, command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """All strips are displaced alike there, so only this warning reveals the error."""
    capsys.readouterr()
    assert run_app([*on_log(judged, command, tmp_path / "out", "away"), "--force-trajectory"]) == 0
    told = [line for line in capsys.readouterr().out.splitlines() if ELSEWHERE in line]
    assert len(told) == 1
    (record,) = (tmp_path / "out").glob("*.json")
    assert told[0] in json.loads(record.read_text())["notes"]


def on_log(judged: Judged, command: str, output: Path, trajectory: str) -> list[str]:
    """Return the arguments of a command on the log with a trajectory file."""
    log, out = str(judged.flown.log), ("-o", str(output))
    calibration, given = judged.calibration, judged.given(trajectory)
    if command == "strips":
        return ["strips", log, *out, *given]
    rest = given[len(calibration) :]
    return ["validate", calibration[1], log, *out, *rest] if command == "validate" else ["calibrate", log, *out, *rest]


# ---------------------------------------------------------------------- maps that do not suit


def test_the_likely_code_for_the_flights_place_is_proposed_for_an_unknown_name(
    judged: Judged, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    capsys.readouterr()
    assert run_app(judged.georef(tmp_path / "out", "--crs", "UTM32")) == ExitCode.USAGE
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(
        'swath: output.crs = "UTM32" is unknown to PROJ; write EPSG:25832 (ETRS89 / UTM zone 32N), or EPSG:32632'
    )
    assert run_app(judged.georef(tmp_path / "out", "--crs", "epsg: 4978")) == ExitCode.USAGE
    assert 'output.crs = "epsg: 4978" (WGS 84) is geocentric' in capsys.readouterr().err


@pytest.mark.parametrize(
    ("crs", "words"),
    [
        ("EPSG:3857", "(WGS 84 / Pseudo-Mercator): at 47.5"),
        ("EPSG:32633", "(WGS 84 / UTM zone 33N) is used from 12° to 18° E, 0° to 84° N, and 23"),
    ],
)
def test_a_map_of_another_place_is_refused_with_a_suggestion_unless_forced(
    judged: Judged, crs: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    capsys.readouterr()
    output = tmp_path / "out"
    assert run_app(judged.georef(output, "--crs", crs)) == ExitCode.USAGE
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f'swath: output.crs = "{crs}" {words}')
    assert 'use "EPSG:32632" (WGS 84 / UTM zone 32N)' in line
    assert line.endswith("; use --force-crs to accept it")
    assert not list(tmp_path.glob("out/*"))
    assert run_app(judged.georef(output, "--crs", crs, "--force-crs")) == 0
    capsys.readouterr()
    assert any(words in warning for warning in sidecar(output)["warnings"])
    assert sidecar(output)["options"]["force_crs"] is True
