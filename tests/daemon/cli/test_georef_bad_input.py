"""Tests ``swath georef`` with damaged or missing input and full disks: partial products and refusals."""

from __future__ import annotations

import json
import resource
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from swath.daemon.cli.main import run_app
from swath.daemon.log.reader import open_logs
from swath.daemon.processing.setup.setup import Options, Setup
from swath.daemon.processing.undecoded import refused_by
from swath.daemon.system import held_interrupts
from swath.georef.formats.sbet import sbet_bytes
from swath.georef.formats.trajectory.csv import csv_text
from swath.georef.records import ChunkBatch
from swath.georef.trajectory.trajectory import Trajectory
from tests.daemon.one_line import PLAN, Flown

pytestmark = [pytest.mark.xdist_group("kernels"), pytest.mark.slow]

S = 1_000_000_000
FAULT = """
[[fault]]
source = "scanner/left"
kind = "corrupted"
at_s = 14.0
for_s = 1.0

[[fault]]  # the last ones too
source = "scanner/left"
kind = "corrupted"
at_s = 20.0
for_s = 60.0
"""


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    """Fly twelve seconds of one line, in one of which every datagram is damaged."""
    folder = tmp_path_factory.mktemp("bad")
    plan = folder / "line.toml"
    plan.write_text(PLAN.replace("[-1000.0, -80.0]", "[-300.0, -80.0]").replace("[1000.0, -80.0]", "[300.0, -80.0]"))
    plan.write_text(plan.read_text() + FAULT)
    assert run_app(["sim", "fly", str(plan), "-o", str(folder / "flight")]) == 0
    made = Flown(folder / "flight")
    made.sbet.write_bytes(sbet_bytes(made.trajectory()))
    return made


def georef(flown: Flown, output: Path, *more: str, trajectory: Trajectory | None = None) -> tuple[int, dict[str, Any]]:
    """Run ``swath georef``; return exit code and sidecar."""
    arguments = flown.arguments(output, "--no-sigma", *more)
    if trajectory is not None:
        file = output.parent / "trajectory.csv"
        file.write_text(csv_text(trajectory))
        arguments[arguments.index("--trajectory") + 1] = str(file)
    code = run_app(arguments)
    sidecars = list(output.glob("*.json"))
    return code, json.loads(sidecars[0].read_text()) if sidecars else {}


def without(trajectory: Trajectory, first_ns: int, last_ns: int) -> Trajectory:
    """Return the trajectory with a gap."""
    keep = (trajectory.time_ns <= first_ns) | (trajectory.time_ns >= last_ns)
    columns = ("time_ns", "position_e", "q_e_from_b", "velocity_e", "position_sigma_l", "attitude_sigma_rad")
    return replace(trajectory, **{column: getattr(trajectory, column)[keep] for column in columns})


def test_damaged_datagrams_make_the_result_partial(
    flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, told = georef(flown, tmp_path / "out")
    assert (code, told["complete"]) == (1, False)
    unread = told["counts"]["left"]["messages_not_read"]
    assert unread["bad_checksum"] > 5
    assert unread == refused_alone(flown)
    assert (
        f"{flown.log}: {unread['bad_checksum']} messages of scanner/left were not read: a wrong checksum"
        in told["holes"]
    )
    assert "partial: " in capsys.readouterr().err
    times_ns = np.sort(flown.truth["left.gps_ns"])
    missing = len(times_ns) - told["counts"]["left"]["read"]
    assert missing > 1200  # of a laser of 1.5 kHz, more than a second is missing


def test_files_of_a_directory_that_are_not_logs_are_skipped(
    flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Such files are remains of a power cut at the start of a part, or written by another tool."""
    _, alone = georef(flown, tmp_path / "alone")
    log = flown.copy_of_log(tmp_path / "logs")
    begun, foreign = log.with_name("begun_0.mcap"), log.with_name("foreign.mcap")
    begun.touch()
    foreign.write_text("no log")
    arguments = flown.arguments(tmp_path / "out", "--no-sigma", log=log.parent)
    capsys.readouterr()
    assert run_app(arguments) == 1
    assert f"partial: skipped: {begun}: is not an MCAP file; " in capsys.readouterr().err
    told = json.loads(next((tmp_path / "out").glob("*.json")).read_text())
    assert told["holes"][:2] == [f"skipped: {path}: is not an MCAP file" for path in (begun, foreign)]
    assert told["holes"][2:] == [hole.replace(str(flown.log), str(log)) for hole in alone["holes"]]
    assert told["counts"] == alone["counts"]
    named = flown.arguments(tmp_path / "named", "--no-sigma", log=begun)
    assert run_app(named) == 3


def refused_alone(flown: Flown) -> dict[str, int]:
    """Return what a parser refuses if it is given all of the log's datagrams at once."""
    (session,) = open_logs([flown.log])
    parser = Setup.of_log(session.attachments(), Options(datum="same")).sources.parsers(("scanner",))["scanner/left"]
    for batch in session.batches(lambda topic: topic.startswith("/scanner/left")):
        parser.feed_batch(ChunkBatch("scanner/left", batch.log_time_ns, batch.units))
    return dict(refused_by(parser))


def test_returns_after_the_end_of_the_trajectory_are_missing_and_not_a_turn(flown: Flown, tmp_path: Path) -> None:
    first, last = (int(flown.truth["left.gps_ns"][at]) for at in (0, -1))
    short = flown.trajectory().between(first - 20 * S, (first + last) // 2)
    code, told = georef(flown, tmp_path / "out", trajectory=short)
    assert (code, told["complete"]) == (1, False)
    dropped = told["counts"]["left"]["dropped"]
    assert set(dropped) == {"outside_trajectory"}
    assert any(
        f"{dropped['outside_trajectory']:,} returns of left are outside the trajectory" in hole
        for hole in told["holes"]
    )


def test_a_gap_of_the_trajectory_is_not_a_turn(flown: Flown, tmp_path: Path) -> None:
    first = int(flown.truth["left.gps_ns"][0])
    code, told = georef(flown, tmp_path / "out", trajectory=without(flown.trajectory(), first + 2 * S, first + 5 * S))
    assert (code, told["complete"]) == (1, False)
    assert len(told["strips"]) == 1
    assert set(told["counts"]["left"]["dropped"]) == {"trajectory_gap"}


def test_without_any_georeferenced_return_no_product_is_written(
    flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, last = (int(flown.truth["left.gps_ns"][at]) for at in (0, -1))
    gone = without(flown.trajectory(), first - S, last + S)
    capsys.readouterr()
    code, told = georef(flown, tmp_path / "out", trajectory=gone)
    assert (code, told) == (1, {})
    assert not (tmp_path / "out").exists()
    assert capsys.readouterr().err.startswith(f"swath: {flown.log}: ")


@contextmanager
def files_at_most(size: int) -> Iterator[None]:
    """Limit the size of files, as a full disk does."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_full_disk_is_reported_in_one_line_and_leaves_no_files(
    flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    capsys.readouterr()
    with files_at_most(60_000):
        code, _ = georef(flown, tmp_path / "out")
    assert code == 3
    line = capsys.readouterr().err
    assert "strip01.laz: cannot be written; is the disk full?" in line
    assert line.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("text", "code", "words"),
    [
        (None, 3, "give auto, whole or a CSV file"),
        (b"\x89\xff", 3, "not text; want a CSV file"),
        (b"start_gps_ns,end_gps_ns\n1,2\n", 1, "none of its strips lies in the logs"),
    ],
)
def test_wrong_strip_files_are_refused(
    flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str], text: bytes | None, code: int, words: str
) -> None:
    file = tmp_path / "strips.csv"
    if text is not None:
        file.write_bytes(text)
    capsys.readouterr()
    assert georef(flown, tmp_path / "out", "--strips", str(file))[0] == code
    line = capsys.readouterr().err
    assert "strips.csv" in line
    assert words in line
    assert not (tmp_path / "out").exists()


def test_a_calibration_of_other_conventions_or_of_binary_content_is_refused(
    flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (flown.folder / "left.true.toml").read_text()
    (tmp_path / "two.toml").write_text(text.replace("conventions = 1", "conventions = 2"))
    (tmp_path / "right.toml").write_text(text.replace('scanner = "left"', 'scanner = "right"'))
    for file, code, words in (
        (tmp_path / "two.toml", 2, "calibration.conventions: got 2, want 1"),
        (tmp_path / "right.toml", 2, "scanner right: is not in the configuration"),
        (flown.log, 3, "not text; want a calibration file"),
        (tmp_path / "none.toml", 3, "cannot be read: No such file"),
    ):
        arguments = flown.arguments(tmp_path / "out")
        arguments[arguments.index("--calibration") + 1] = str(file)
        assert run_app(arguments) == code
        line = capsys.readouterr().err
        assert line.startswith(f"swath: {file}: ")
        assert words in line


@pytest.mark.parametrize("taken", ["here", "by another thread"])
def test_an_interrupt_waits_until_the_processes_have_started(taken: str) -> None:
    steps = []

    def begin() -> None:
        with held_interrupts():
            if taken == "here":
                signal.pthread_kill(threading.get_ident(), signal.SIGINT)
            else:  # Python calls the handler in the main thread
                handler = signal.getsignal(signal.SIGINT)
                assert callable(handler)
                handler(signal.SIGINT, None)
            steps.append("begun")

    with pytest.raises(KeyboardInterrupt):
        begin()
    assert steps == ["begun"]
    with held_interrupts():
        steps.append("again")
    assert steps == ["begun", "again"]
