"""Tests ``swath trajectory``: the truth within its sigmas, everything accounted for, mistakes in one line."""

from __future__ import annotations

import csv
import hashlib
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from swath.daemon.cli.main import run_app
from swath.daemon.log.reader import open_logs
from swath.daemon.processing.navigation.navigate import NavigationOptions, attitude_of_text, navigate_session
from swath.daemon.processing.trajectory.event_marks import PLACED
from swath.georef.formats.trajectory.file import read_trajectory
from swath.georef.trajectory.trajectory import Trajectory
from swath.sim.plan.plan import Plan, parse_plan
from tests.daemon import short_flight
from tests.daemon.short_flight import MARK_AFTER_NS, Flown, errors, fly_short, post_processed, two_lines

pytestmark = pytest.mark.xdist_group("kernels")

S = 1_000_000_000
PLAN = two_lines("navigated", gnss="rate_hz = 2\nsecondary_lever_arm_m = [0.1, 1.15, -1.2]")
SECONDS = 55.0


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    return fly_short(tmp_path_factory.mktemp("navigated"), PLAN, SECONDS)


@pytest.fixture(scope="module")
def made(flown: Flown, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a smoothed trajectory with all products."""
    folder = tmp_path_factory.mktemp("made")
    arguments = [
        "trajectory",
        str(flown.log),
        "-o",
        str(folder / "a.sbet"),
        "--csv",
        "--events",
        str(folder / "marks.csv"),
    ]
    assert run_app(arguments) == 0
    return folder


def summary(folder: Path) -> dict[str, Any]:
    read: dict[str, Any] = json.loads((folder / "a.json").read_text())
    return read


def read(folder: Path, flown: Flown) -> Trajectory:
    span = flown.truth().span
    smrmsg = (folder / "a.smrmsg").read_bytes()
    return read_trajectory((folder / "a.sbet").read_bytes(), "a.sbet", span_ns=span, smrmsg=smrmsg)


class TestSmoothed:
    @pytest.mark.slow
    def test_the_trajectory_matches_the_truth_within_its_sigmas(self, flown: Flown, made: Path) -> None:
        trajectory, truth = read(made, flown), flown.truth()
        inside = truth.fates(trajectory.time_ns) == 0
        position, attitude = errors(trajectory, truth)
        assert inside.sum() > (SECONDS - 3) * 100  # from the first position on, although the alignment came later
        assert np.sqrt((position**2).mean(axis=0)).max() < 0.03  # RTK of 1 cm, 1 cm, 2 cm
        assert np.degrees(np.sqrt((attitude**2).mean(axis=0))).max() < 0.2
        normalised = np.concatenate(
            [position / trajectory.position_sigma_l[inside], attitude / trajectory.attitude_sigma_rad[inside]], axis=1
        )
        spread = np.sqrt((normalised**2).mean(axis=0))
        assert (spread < 3.0).all(), spread  # a single flight has few independent errors
        assert np.sqrt((normalised**2).mean()) > 0.2  # the sigmas are not too large either

    @pytest.mark.slow
    def test_the_summary_describes_the_inputs(self, flown: Flown, made: Path) -> None:
        told = summary(made)
        assert (told["format"], told["solution"], told["point"]) == ("swath.trajectory", "smoothed", "body")
        assert (told["complete"], told["holes"]) == (True, [])
        digest = hashlib.sha256(flown.log.read_bytes()).hexdigest()
        assert told["logs"] == [{"name": flown.log.name, "sha256": digest}]
        assert set(told["files"]) | {"a.json"} == {path.name for path in made.iterdir()}
        (session,) = told["sessions"]
        assert session["imu"]["samples"]["taken"] == pytest.approx(SECONDS * 100, abs=5)
        assert session["imu"]["time_by"] == "latch"
        assert session["legs"][0]["setup"]["lever_arms_b"][0] == [0.1, -0.05, -1.2]
        (leg,) = session["legs"]
        fates = leg["figures"]["observations"]["position"]
        assert fates["seen"] == sum(fates[fate] for fate in ("taken", "inflated", "reacquired", "rejected", "unusable"))
        assert leg["verdict"]["level"] in {"good", "care"}
        assert leg["start"]["words"]

    def test_the_page_matches_the_summary(self, made: Path) -> None:
        page = (made / "a.html").read_text()
        session = summary(made)["sessions"][0]
        assert session["session"] in page
        assert session["imu"]["noise_by_grade"] == {}  # the virtual aircraft's configuration has every key
        assert "data:image/png" in page
        assert "virtual" in page  # the name of the aircraft
        assert (made / "a.pdf").read_bytes().startswith(b"%PDF")

    def test_event_marks_match_the_position_of_the_aircraft(self, flown: Flown, made: Path) -> None:
        rows = list(csv.DictReader((made / "marks.csv").read_text().splitlines()))
        assert len(rows) >= SECONDS - 2
        assert summary(made)["events"] == {
            fate: sum(row["fate"] == fate for row in rows) for fate in {row["fate"] for row in rows}
        }
        placed = [row for row in rows if row["fate"] == PLACED]
        assert len(placed) >= SECONDS - 15
        truth = flown.truth()
        lat, _, height = truth.geodetic()
        for row in placed:
            assert abs(int(row["gps_ns"]) % S - MARK_AFTER_NS) <= 200
            since = truth.time_ns - int(row["gps_ns"])
            assert float(row["lat_deg"]) == pytest.approx(np.degrees(np.interp(0.0, since, lat)), abs=1e-6)
            assert float(row["height_m"]) == pytest.approx(np.interp(0.0, since, height), abs=0.1)

    def test_the_function_for_georeferencing_gives_the_same_trajectory(self, flown: Flown, made: Path) -> None:
        trajectory = read(made, flown)
        again = navigate_session(open_logs([flown.log])[0], NavigationOptions()).trajectory()
        assert np.abs(again.position_e - trajectory.position_e).max() < 1e-6
        assert np.abs(again.position_sigma_l - trajectory.position_sigma_l).max() < 1e-12


class TestOptions:
    def test_the_real_time_trajectory_is_that_of_the_filter(
        self, flown: Flown, made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        output = tmp_path / "a.sbet"
        capsys.readouterr()
        assert run_app(["trajectory", str(flown.log), "-o", str(output), "--realtime", "--no-page", "--json"]) == 0
        assert json.loads(capsys.readouterr().out) == summary(tmp_path)
        assert summary(tmp_path)["solution"] == "realtime"
        assert not (tmp_path / "a.html").exists()
        filtered, smoothed = read(tmp_path, flown), read(made, flown)
        both = np.isin(filtered.time_ns, smoothed.time_ns)
        ours, theirs = (t.between(int(filtered.time_ns[both][0]), t.span[1]) for t in (filtered, smoothed))
        assert (ours.attitude_sigma_rad.mean(axis=0) > 1.2 * theirs.attitude_sigma_rad.mean(axis=0)).all()
        position, _ = errors(filtered, flown.truth())
        assert np.sqrt((position**2).mean(axis=0)).max() < 0.2

    def test_a_csv_in_a_new_folder_holds_the_same_trajectory_bit_for_bit(
        self, flown: Flown, made: Path, tmp_path: Path
    ) -> None:
        output = tmp_path / "new" / "t.csv"
        assert run_app(["trajectory", str(flown.log), "-o", str(output), "--no-page"]) == 0
        assert {path.name for path in output.parent.iterdir()} == {"t.csv", "t.json"}
        assert output.read_bytes() == (made / "a.csv").read_bytes()

    @pytest.mark.slow
    def test_swapped_antennas_are_named(self, flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        primary, secondary = "= [0.1, -0.05, -1.2]", "= [0.1, 1.15, -1.2]"
        flown.changed("swapped.toml", **{primary: "= [0, 0, 0]", secondary: primary, "= [0, 0, 0]": secondary})
        capsys.readouterr()
        arguments = ["-o", str(tmp_path / "a.sbet"), "--no-page", "--config", str(flown.folder / "swapped.toml")]
        assert run_app(["trajectory", str(flown.log), *arguments]) == 1
        why, *findings = capsys.readouterr().err.splitlines()
        assert "no alignment: inertial samples do not fit" in why
        assert "the antennas are exchanged; swap lever_arm_m and secondary_lever_arm_m" in findings[0]
        assert all(line.startswith(f"swath: {flown.log}: ") for line in (why, *findings))
        assert not list(tmp_path.iterdir())

    def test_an_imu_with_another_mounting_makes_the_trajectory_unusable(
        self, flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        """A rotated attitude fits the rotated IMU, so positions are right; only gravity and course reveal the error."""
        turned = "rotation_b_imu = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]"
        alone = {"secondary_lever_arm_m": "# ", "lever_arm_m = [0.1, -0.05, -1.2]": "lever_arm_m = [0, 0, 0]"}
        plain = "rotation_b_imu = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]"
        flown.changed("turned.toml", **{plain: turned}, **alone)
        capsys.readouterr()
        arguments = ["-o", str(tmp_path / "a.sbet"), "--no-page", "--config", str(flown.folder / "turned.toml")]
        assert run_app(["trajectory", str(flown.log), *arguments]) == 1
        printed = capsys.readouterr()
        assert "body y reads +1 g" in printed.err
        assert "rotation_b_imu" in printed.err
        (leg,) = summary(tmp_path)["sessions"][0]["legs"]
        reasons = [line for line in printed.out.splitlines() if line.startswith("also: ")]
        assert len(reasons) == len(leg["verdict"]["reasons"]) - 1 > 0
        assert all(reason["what"] in line for reason, line in zip(leg["verdict"]["reasons"][1:], reasons, strict=True))

    @pytest.mark.slow
    def test_a_given_attitude_starts_the_navigation(
        self, flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        """A key of the noise that was not set is named with its grade, on the page too."""
        flown.changed("alone.toml", **{"secondary_lever_arm_m": "# ", "accel_scale_ppm": "# "})
        capsys.readouterr()
        arguments = ["-o", str(tmp_path / "a.sbet"), "--config", str(flown.folder / "alone.toml")]
        assert run_app(["trajectory", str(flown.log), *arguments, "--start", "-1.3,2.0,90.3", "--imu", "main"]) == 0
        words = "(imu.main.noise does not set these): accel_scale_ppm 300"
        assert words in capsys.readouterr().out
        assert words in (tmp_path / "a.html").read_text()
        (leg,) = summary(tmp_path)["sessions"][0]["legs"]
        assert leg["start"]["method"] == "given"
        _, attitude = errors(read(tmp_path, flown), flown.truth())
        assert np.degrees(np.sqrt((attitude**2).mean(axis=0))).max() < 0.5


class TestRefusals:
    def refused(self, capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
        capsys.readouterr()
        assert run_app(["trajectory", *arguments]) in (1, 2, 3)
        line = capsys.readouterr().err
        assert line.startswith("swath: ")
        assert line.count("\n") == 1, line
        assert "internal error" not in line
        return line

    def test_existing_files_are_kept(self, flown: Flown, made: Path, capsys: pytest.CaptureFixture[str]) -> None:
        before = (made / "a.sbet").stat().st_mtime_ns
        assert "--overwrite" in self.refused(capsys, str(flown.log), "-o", str(made / "a.sbet"))
        assert (made / "a.sbet").stat().st_mtime_ns == before

    @pytest.mark.parametrize(
        ("arguments", "said"),
        [
            (["--imu", "none"], "--imu: the configuration has no [imu.none]"),
            (["--start", "north"], '--start: got "north", want roll,pitch,heading in degrees'),
            (["--ins", "maybe"], "want ignore, observe, as-is"),
            (["--ins", "as-is"], "the log has no INS solution"),
            (["--gnss", "nowhere.pos"], "--gnss nowhere.pos: cannot be read"),
        ],
    )
    def test_wrong_options_are_refused(
        self, flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], said: str
    ) -> None:
        assert said in self.refused(capsys, str(flown.log), "-o", str(tmp_path / "a.sbet"), *arguments)
        assert not list(tmp_path.iterdir())

    @pytest.mark.parametrize(("output", "marks"), [("a.sbet", "a.csv"), ("a.csv", "a.csv"), ("a.sbet", "a.json")])
    def test_event_marks_do_not_overwrite_the_trajectory(
        self, flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str], output: str, marks: str
    ) -> None:
        arguments = ["-o", str(tmp_path / output), "--csv", "--events", str(tmp_path / "." / marks), "--overwrite"]
        assert "is a file of the trajectory itself" in self.refused(capsys, str(flown.log), *arguments)
        assert not list(tmp_path.iterdir())

    def test_a_missing_log_is_refused(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        said = self.refused(capsys, str(tmp_path / "no.mcap"), "-o", str(tmp_path / "a.sbet"))
        assert "no such file or directory" in said

    def test_a_damaged_log_gives_a_partial_result(
        self, flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        data = bytearray(flown.log.read_bytes())
        log = tmp_path / flown.log.name
        log.write_bytes(data[: len(data) * 9 // 10])
        assert "a.json: partial: " in self.refused(capsys, str(log), "-o", str(tmp_path / "a.sbet"), "--no-page")
        told = summary(tmp_path)
        assert not told["complete"]
        assert log.name in told["holes"][0]
        assert read(tmp_path, flown).span[1] > flown.truth().span[0] + 35 * S

    def test_files_of_a_directory_that_are_not_logs_are_skipped(
        self, flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        logs = tmp_path / "logs"
        logs.mkdir()
        (logs / flown.log.name).symlink_to(flown.log)
        begun = logs / "begun_0.mcap"
        begun.touch()
        said = self.refused(capsys, str(logs), "-o", str(tmp_path / "a.sbet"), "--no-page")
        assert said.endswith(f"a.json: partial: skipped: {begun}: is not an MCAP file\n")
        assert summary(tmp_path)["holes"] == [f"skipped: {begun}: is not an MCAP file"]


@pytest.mark.parametrize("text", ["1,2", "1,2,x", "1,2,nan", "200,0,0", "0,91,0", "0,0,400", ""])
def test_an_impossible_attitude_is_refused(text: str) -> None:
    with pytest.raises(Exception, match="want roll,pitch,heading in degrees"):
        attitude_of_text(text)


def test_a_given_attitude_is_in_degrees() -> None:
    assert attitude_of_text("1.5, -2,270") == pytest.approx(np.radians([1.5, -2.0, 270.0]).tolist())


def test_post_processed_positions_improve_the_trajectory(flown: Flown, made: Path, tmp_path: Path) -> None:
    """They replace the receiver's; errors and sigmas shrink, and all of them are counted."""
    truth = flown.truth()
    file = tmp_path / "ppk.pos"
    file.write_text(post_processed(truth, truth.span))
    assert (
        run_app(["trajectory", str(flown.log), "-o", str(tmp_path / "a.sbet"), "--gnss", str(file), "--no-page"]) == 0
    )
    before, after = read(made, flown), read(tmp_path, flown)
    (old, _), (new, attitude) = errors(before, truth), errors(after, truth)
    assert np.sqrt((new**2).mean()) < 0.6 * np.sqrt((old**2).mean())
    inside = truth.fates(after.time_ns) == 0
    spread = np.sqrt(((new / after.position_sigma_l[inside]) ** 2).mean(axis=0))
    assert (spread < 2.0).all(), spread
    turned = np.sqrt(((attitude / after.attitude_sigma_rad[inside]) ** 2).mean(axis=0))
    assert (turned < 3.0).all(), turned
    assert after.position_sigma_l[inside].mean() < before.position_sigma_l[inside].mean()
    (session,) = summary(tmp_path)["sessions"]
    lines = len(file.read_text().splitlines()) - 2
    assert session["gnss"]["observations"]["position"] == lines
    assert session["gnss"]["refused"]["fix_replaced_from_outside"] == pytest.approx(2 * SECONDS, abs=3)


def test_sessions_are_ordered_by_trajectory_despite_a_clock_set_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Sessions are sorted by the host's clock; the trajectories show which came first."""

    def begun_late(text: str, folder: Path) -> Plan:
        """Return a plan whose host clock is further off than a plan may state."""
        plan = parse_plan(text, folder)
        host = plan.tables.host.model_copy(update={"utc_offset_s": -1200.0})
        return replace(plan, tables=plan.tables.model_copy(update={"host": host}))

    for name in ("first", "second"):
        (tmp_path / name).mkdir()
    first = fly_short(tmp_path / "first", PLAN, 16.0)
    monkeypatch.setattr(short_flight, "parse_plan", begun_late)
    later = PLAN.replace("seed = 5", "seed = 5\nstart = 2026-06-15T09:10:00Z")
    second = fly_short(tmp_path / "second", later, 16.0)
    logs = [first.log, second.log]
    assert [session.parts[0].path for session in open_logs(logs)] == logs[::-1]
    capsys.readouterr()
    assert run_app(["trajectory", *map(str, logs), "-o", str(tmp_path / "a.sbet"), "--no-page"]) == 0
    told = summary(tmp_path)
    assert [log["name"] for log in told["logs"]] == [log.name for log in logs]
    assert [session["session"] for session in told["sessions"]] == [open_logs([log])[0].session_id for log in logs]
    joined = read_trajectory((tmp_path / "a.sbet").read_bytes(), "a.sbet", span_ns=first.truth().span)
    assert joined.span[1] - joined.span[0] > 600 * S
