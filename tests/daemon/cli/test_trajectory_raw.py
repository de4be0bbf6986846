"""Tests logs for post-processing: raw measurements, an IMU without a receiver, and gaps in them."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

from swath.daemon.cli.main import run_app
from swath.daemon.config import load_config
from swath.daemon.errors import UserError
from swath.daemon.log.channels import JsonChannel
from swath.daemon.processing.navigation.inputs import InputOptions, read_inputs
from swath.daemon.processing.navigation.times import imu_times, stretches
from swath.drivers.gnss.novatel.encoder import encode_frame
from swath.georef.formats.trajectory.file import read_trajectory
from swath.georef.trajectory.trajectory import Trajectory
from swath.sim.gnss.novatel import NovatelMessages
from tests.daemon.short_flight import Flown, errors, fly_short, post_processed, two_lines

pytestmark = pytest.mark.xdist_group("kernels")

S = 1_000_000_000
SECONDS = 45.0
RANGECMP = 140
WALL_ERROR_S = 0.002
PLAN = two_lines("raw", gnss="rate_hz = 2")


@contextmanager
def raw_measurements() -> Iterator[None]:
    """Let virtual receivers send raw measurements only, and chrony discipline the host's wall clock."""
    encode = JsonChannel.encode

    def epoch(self: NovatelMessages, epochs: Any, row: int) -> list[bytes]:
        stamp = self._calendar.at(float(epochs.time_s[row]))
        return [encode_frame(RANGECMP, bytes(4), stamp.week, stamp.tow_ms)]

    def kept(self: JsonChannel, log_time_ns: int, value: dict[str, Any]) -> Any:
        told = {"max_error_s": WALL_ERROR_S} if "monotonic_raw_ns" in value else {}
        return encode(self, log_time_ns, value | told)

    with ExitStack() as stack:
        stack.enter_context(patch("tests.daemon.short_flight.marking", ExitStack))
        stack.enter_context(patch.object(NovatelMessages, "epoch", epoch))
        stack.enter_context(patch.object(JsonChannel, "encode", kept))
        yield


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    folder = tmp_path_factory.mktemp("raw")
    with raw_measurements():
        flown = fly_short(folder, PLAN, SECONDS)
    (folder / "ppk.pos").write_text(post_processed(flown.truth(), flown.truth().span))
    return flown


def without_receiver(flown: Flown) -> Path:
    """Write the configuration without its receiver, and return its path."""
    text = (flown.folder / "swath.toml").read_text()
    first = text.index("[gnss.rover]")
    after = text.index("\n[", first)
    path = flown.folder / "alone.toml"
    path.write_text(text[:first] + text[after:])
    return path


def trajectory(folder: Path, flown: Flown, *arguments: str) -> tuple[dict[str, Any], Trajectory]:
    """Return summary and SBET of a run."""
    given = ["--gnss", str(flown.folder / "ppk.pos"), "--no-page", *arguments]
    assert run_app(["trajectory", str(flown.log), "-o", str(folder / "a.sbet"), *given]) == 0
    told: dict[str, Any] = json.loads((folder / "a.json").read_text())
    smrmsg = (folder / "a.smrmsg").read_bytes()
    data = (folder / "a.sbet").read_bytes()
    return told, read_trajectory(data, "a.sbet", span_ns=flown.truth().span, smrmsg=smrmsg)


def test_raw_measurements_and_a_file_of_positions_are_navigated(flown: Flown, tmp_path: Path) -> None:
    """Raw measurements name the second of each pulse; positions of 3 mm, 3 mm, 6 mm come from the file."""
    told, found = trajectory(tmp_path, flown)
    position, _ = errors(found, flown.truth())
    assert np.sqrt((position**2).mean(axis=0)).max() < 0.01
    (session,) = told["sessions"]
    assert session["imu"]["time_by"] == "latch"
    assert session["gnss"]["observations"]["position"] == pytest.approx(2 * SECONDS, abs=4)
    assert told["complete"]


@pytest.mark.slow
def test_an_imu_without_a_receiver_is_timed_by_the_wall_clock_and_its_pulses(flown: Flown, tmp_path: Path) -> None:
    config = without_receiver(flown)
    told, found = trajectory(tmp_path, flown, "--config", str(config), "--lever-arm", "0.1,-0.05,-1.2")
    position, _ = errors(found, flown.truth())
    assert np.sqrt((position**2).mean(axis=0)).max() < 0.01
    (session,) = told["sessions"]
    assert (session["gnss"]["source"], session["imu"]["time_by"]) == (None, "latch")
    assert any("wall clock alone names the seconds" in line for line in told["warnings"])


def test_an_absent_lever_arm_is_estimated_and_reported(flown: Flown) -> None:
    request = InputOptions(positions=flown.folder / "ppk.pos", config=load_config(without_receiver(flown)))
    inputs = read_inputs(flown.session(), request)
    assert inputs.setup.estimate_lever_arm == 2.0
    assert any("give --lever-arm X,Y,Z" in line for line in inputs.warnings)


def test_raw_measurements_need_a_position_file(flown: Flown) -> None:
    with pytest.raises(UserError, match=r"no position of gnss/rover.*--gnss FILE with post-processed positions"):
        read_inputs(flown.session(), InputOptions())


def test_a_lever_arm_without_a_position_file_is_refused(
    flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = [str(flown.log), "-o", str(tmp_path / "a.sbet"), "--lever-arm"]
    assert run_app(["trajectory", *arguments, "0,0,-1"]) == 2
    assert "--lever-arm needs --gnss FILE" in capsys.readouterr().err
    assert run_app(["trajectory", *arguments, "up", "--gnss", str(flown.folder / "ppk.pos")]) == 2
    assert "want x,y,z in metres" in capsys.readouterr().err


# ---------------------------------------------------------------------- holes


def test_stretches_without_time_are_reported_with_begin_and_end() -> None:
    """Of 1000 samples at 100 Hz, the first 100, 60 in the middle and the last 2 s have no time; 30 are too few."""
    host_ns = np.arange(1000) * S // 100 + 5 * S
    placed = np.ones(1000, np.bool_)
    placed[:100] = placed[400:460] = placed[600:630] = placed[800:] = False
    gps_ns = (host_ns + 1_000 * S)[placed]
    found = stretches(host_ns, placed, gps_ns, 100.0, "why")
    begins_s = [(part.begin_ns - 1_005 * S) / S for part in found]
    assert begins_s == pytest.approx([0.0, 3.99, 7.99])
    assert [part.seconds for part in found] == pytest.approx([1.0, 0.61, 2.0], abs=0.02)
    assert found[0].text.endswith("1.0 s: why")


def test_all_or_none_of_the_samples_timed_gives_no_stretch() -> None:
    host_ns = np.arange(500) * S // 100
    assert stretches(host_ns, np.zeros(500, np.bool_), host_ns[:0], 100.0, "") == ()
    assert stretches(host_ns, np.ones(500, np.bool_), host_ns, 100.0, "") == ()


@pytest.mark.slow
def test_samples_without_time_are_a_gap_of_the_trajectory(
    flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The counter reads zero for 12 s in the middle: these samples have no time, and the whole log reports it."""

    def silent(rows: Any, *others: Any) -> Any:
        rows = rows.copy()
        late = rows["host_time_ns"] - rows["host_time_ns"][0]
        rows["device_time_ns"][(late > 20 * S) & (late < 32 * S)] = -1
        return imu_times(rows, *others)

    with patch("swath.daemon.processing.navigation.inputs.imu_times", silent):
        given = ["--gnss", str(flown.folder / "ppk.pos"), "--no-page"]
        assert run_app(["trajectory", str(flown.log), "-o", str(tmp_path / "a.sbet"), *given]) == 1
    told = json.loads((tmp_path / "a.json").read_text())
    (session,) = told["sessions"]
    (part,) = session["missing"]
    assert part["seconds"] == pytest.approx(12.0, abs=0.1)
    assert "partial" in capsys.readouterr().err
    assert not told["complete"]
    assert any("12.0 s: " in line for line in told["holes"])
    reasons = [reason["name"] for leg in session["legs"] for reason in leg["verdict"]["reasons"]]
    assert "missing" in reasons
