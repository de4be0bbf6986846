"""Tests frames lost on a CAN bus: the rest is counted and navigated, and the loss is reported."""

from __future__ import annotations

import json
import random
import shutil
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from swath.daemon.cli.main import run_app
from swath.georef.formats.trajectory.file import read_trajectory
from tests.daemon.short_flight import Flown, fly_short, two_lines

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("kernels")]

LOST = 0.005  # of the frames, at random
SILENT_S = (60.0, 63.0)  # of the log, without a frame
SAMPLE = {"101", "102", "103", "100"}  # the frames of a sample; the last one closes it


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    return fly_short(tmp_path_factory.mktemp("can"), two_lines("can", gnss='grade = "rtk"', prf_hz=100))


@pytest.fixture(scope="module")
def lossy(flown: Flown, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, int]:
    """Return a log in which frames were lost before the recorder, and the number of its complete samples."""
    folder = tmp_path_factory.mktemp("lossy")
    assert run_app(["export", str(flown.log), str(folder / "files")]) == 0
    (files,) = (folder / "files").iterdir()
    (files / "imu-main.log.swath.csv.gz").unlink()  # it would reveal what the file contained
    draws = random.Random(1)
    lines = (files / "imu-main.log").read_text().splitlines(keepends=True)
    begin_s = float(lines[0][1:18])
    kept = [
        line
        for line in lines
        if draws.random() >= LOST and not SILENT_S[0] <= float(line[1:18]) - begin_s < SILENT_S[1]
    ]
    (files / "imu-main.log").write_text("".join(kept))
    shutil.move(files / "config", folder / "config")
    config = str(folder / "config" / "config.toml")
    assert run_app(["import", config, str(files), "-o", str(folder / "logs")]) == 0
    return folder / "logs", sum(whole(kept))


def whole(lines: list[str]) -> Iterator[bool]:
    """Yield for each sample of a candump whether each of its frames is there exactly once."""
    frames = [line.split()[2].partition("#")[0] for line in lines]
    ends = [-1, *(at for at, frame in enumerate(frames) if frame == "100")]
    for begin, end in pairwise(ends):
        sample = [frame for frame in frames[begin + 1 : end + 1] if frame in SAMPLE]
        yield len(sample) == len(SAMPLE) == len(set(sample))


def test_samples_with_a_missing_frame_are_counted_and_dropped(
    lossy: tuple[Path, int], capsys: pytest.CaptureFixture[str]
) -> None:
    logs, samples = lossy
    capsys.readouterr()
    assert run_app(["info", "--json", str(logs)]) == 0
    (session,) = json.loads(capsys.readouterr().out)["sessions"]
    unit = session["sources"]["imu/main"]["decoded"]
    assert unit["records"]["ImuSamples"] == samples
    assert unit["errors"]["sample_incomplete"] > 100
    assert unit["errors"]["packet_gap"] > 100


def test_remaining_samples_are_navigated_and_missing_ones_reported(
    flown: Flown, lossy: tuple[Path, int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Single samples are bridged; three seconds are a gap, and the rest is within its sigmas."""
    output = tmp_path / "t.csv"
    assert run_app(["trajectory", str(lossy[0]), "-o", str(output), "--no-page"]) == 1
    told = capsys.readouterr()
    assert "of the inertial samples are missing and were interpolated: find out with swath info" in told.out
    assert told.err.strip().endswith("3.0 s: no samples")
    got, truth = read_trajectory(output.read_bytes(), "t.csv"), flown.truth()
    off = got.position_e[50:-50] - truth.poses(got.time_ns[50:-50]).position_e
    sigma = got.position_sigma_l[50:-50].max(axis=1)
    assert np.median(np.linalg.norm(off, axis=1) / sigma) < 3.0
    assert np.linalg.norm(off, axis=1).max() < 0.3
