"""Tests that long work shows a bar on a terminal and lines elsewhere, and short work nothing."""

from __future__ import annotations

import io
import json
import time
from pathlib import Path
from typing import Any

import numba
import pytest
from rich.console import Console

from swath.daemon.cli import progress
from swath.daemon.cli.main import run_app
from swath.daemon.cli.progress import COMPILING, Display, progress_bar
from swath.georef.progress import BYTES
from tests.daemon.builders import INFO, run_python, write_part
from tests.daemon.one_line import fly

pytestmark = pytest.mark.xdist_group("kernels")
AFTER_S = 5.0


class Clock:
    """A clock that stands still until the test advances it."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock() -> Clock:
    """Return a clock that stands still."""
    return Clock()


@pytest.fixture(autouse=True)
def after(monkeypatch: pytest.MonkeyPatch) -> None:
    """Show progress as a user sees it; other tests see none."""
    monkeypatch.setattr(progress, "AFTER_S", AFTER_S)


def test_each_phase_gets_one_line_with_its_seconds_amount_and_rate(clock: Clock) -> None:
    said: list[str] = []
    display = Display(said.append, clock=clock)
    display.tell("returns", 0, 200_000_000, BYTES)
    clock.now_s += 4.0
    display.tell("returns", 200_000_000, 200_000_000, BYTES)
    display.tell("planes", 0, 0)
    clock.now_s += 12.34
    display.tell("adjustment 1", 1, 0, "iterations")
    clock.now_s += 1.0
    display.close()
    assert said == ["returns: 4.0 s, 200.0 MB, 50.0 MB/s", "planes: 12.3 s", "adjustment 1: 1.0 s, 1 iteration"]


def test_work_of_less_than_five_seconds_writes_nothing(clock: Clock) -> None:
    said: list[str] = []
    display = Display(said.append, clock=clock)
    for what in ("clocks", "points"):
        display.tell(what, 0, 0)
        clock.now_s += 2.4
        display.tick()
    display.close()
    assert said == []


def test_a_long_phase_writes_percentage_and_remaining_time_each_minute(clock: Clock) -> None:
    said: list[str] = []
    display = Display(said.append, clock=clock)
    for second in range(1, 151):
        clock.now_s += 1.0
        display.tell("placing returns", 100 * second, 30_000, "returns")
        display.tick()
    assert said == [
        "placing returns: 20 %, 6,100 of 30,000 returns, 102 returns/s, 60 s so far, about 4 min remaining",
        "placing returns: 40 %, 12,100 of 30,000 returns, 101 returns/s, 2 min so far, about 3 min remaining",
    ]


def test_no_remaining_time_is_told_while_loops_are_compiled(clock: Clock) -> None:
    said: list[str] = []
    display = Display(said.append, clock=clock)
    compiled_s = 0.0
    display.compile_s = lambda: compiled_s
    for phase in ("clocks", "points"):  # loops of a later phase are compiled when it comes to them
        display.tell(phase, 0, 100_000_000, BYTES)
        compiled_s += 30.0
        clock.now_s += 61.0
        display.tell(phase, 1_000_000, 100_000_000, BYTES)
        display.tick()
    assert said == [
        "clocks: 1 %, 61 s so far",
        "clocks: 61.0 s, 100.0 MB",
        "points: 1 %, 61 s so far",
    ]
    display.tell("pages", 0, 100, "pages")
    clock.now_s += 61.0
    display.tell("pages", 50, 100, "pages")
    display.tick()
    assert said[-1] == "pages: 50 %, 50 of 100 pages, 61 s so far, about 61 s remaining"


def test_a_phase_that_was_not_finished_has_no_line_of_its_end(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(progress, "AFTER_S", 0.0)

    def fail() -> None:
        with progress_bar() as tell:
            tell("one", 0, 0)
            tell("two", 0, 0)
            time.sleep(3 * progress.TICK_S)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert [line.split(":")[0] for line in capsys.readouterr().err.splitlines()] == ["one"]


def test_a_terminal_shows_the_running_phase_and_keeps_the_ended_ones(clock: Clock) -> None:
    said: list[str] = []
    shown: list[tuple[str, float | None, str]] = []
    display = Display(said.append, lambda *facts: shown.append(facts), clock)
    display.tell("points", 0, 400_000_000, BYTES)
    clock.now_s += 100.0
    display.tell("points", 100_000_000, 400_000_000, BYTES)
    display.tick()
    assert shown == [("points", 0.25, "25 %, 1.0 MB/s, 100 s so far, about 5 min remaining")]
    assert said == []
    display.tell("sidecar", 0, 0)
    display.tick()
    assert said == ["points: 100.0 s, 400.0 MB, 4.0 MB/s"]  # the next phase began, so all of it was done
    assert shown[-1] == ("sidecar", None, "0 s so far")


def test_a_bar_on_a_terminal_disappears(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "TICK_S", 0.02)
    written = io.StringIO()
    terminal = Console(file=written, force_terminal=True, width=100)
    with progress._display(terminal) as display, progress._ticking(display):
        display.tell("points", 25, 100, "strips")
        time.sleep(0.3)
    assert "25 %, 25 of 100 strips" in written.getvalue()
    assert written.getvalue().endswith("\x1b[2K")  # the bar's line is erased


def test_compiling_is_told_once_with_the_time_it_took(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(progress, "LEAST_TOLD_S", 1e-9)
    with progress_bar(compiling=True):
        numba.njit(lambda x: 7 * x)(2)
        numba.njit(lambda x: 8 * x)(2)
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == COMPILING
    assert len(lines) == 2
    assert lines[1].startswith("compiling took ")
    assert "swath warm-up" in lines[0]
    with progress_bar(compiling=True):
        pass
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("command", ["info", "recover", "export", "offload"])
def test_commands_for_the_aircraft_do_not_load_the_compiler(tmp_path: Path, command: str) -> None:
    """Loading takes minutes where the recorder leaves little of the processor, and these commands compile no loop."""
    logs, out = tmp_path / "logs", tmp_path / "out"
    logs.mkdir()
    out.mkdir()
    write_part(logs / f"{INFO.session_id}_0.mcap", finish=command != "recover")  # only its index is missing
    arguments = [command, str(logs), *([] if command in ("info", "recover") else [str(out)])]
    if command == "offload":
        arguments.append("--same-disk")
    run = run_python(f"code = cli.run_app({arguments!r})\nprint('ended:', code, 'numba' in sys.modules)")
    assert run.stdout.splitlines()[-1] == "ended: 0 False", run.stdout + run.stderr
    assert command != "recover" or list(logs.glob("*.recovered.mcap"))


def test_json_on_stdout_is_not_mixed_with_progress(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(progress, "AFTER_S", 0.0)
    flown = fly(tmp_path)
    capsys.readouterr()
    assert run_app([*flown.arguments(tmp_path / "out"), "--json"]) == 0
    written = capsys.readouterr()
    record: dict[str, Any] = json.loads(written.out)
    assert record["complete"]
    phases = [line.split(":")[0] for line in written.err.splitlines()]
    assert [phase for phase in phases if phase in ("clocks", "points")] == ["clocks", "points"]
    assert run_app(["info", "--json", str(flown.log)]) == 0
    written = capsys.readouterr()
    assert json.loads(written.out)["sessions"]
    assert written.err.startswith(f"reading {flown.name}: ")
