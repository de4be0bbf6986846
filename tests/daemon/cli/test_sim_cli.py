"""Tests ``swath sim``: a complete log or none, wires in real time, one-line errors."""

from __future__ import annotations

import functools
import importlib.util
import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import swath.daemon.cli.main as cli
from swath.daemon.cli.sim import PRESETS
from swath.daemon.config import load_config
from swath.daemon.errors import ExitCode, UserError
from swath.daemon.log.reader import open_logs
from swath.daemon.replay.wire_player import Output, TimedUnit
from swath.daemon.simulate.ahead import AHEAD_S, BATCH_S, Ahead, FlightFacts
from swath.daemon.simulate.folder import FlightFolder
from swath.daemon.simulate.on_wires import WallClock, fly_on_wires, open_wires, own_wires
from swath.drivers.extras import how_to_install
from swath.sim.plan.plan import PRESETS as REAL_PRESETS
from tests.builders import ROOT
from tests.daemon.builders import swath
from tests.daemon.log_check import official_counts, read_log
from tests.daemon.rig import HANGS_S, Recorder, one_processor, session_table, wait_until
from tests.daemon.standin import (
    SOURCES,
    Standin,
    aircraft_config,
    make_standin,
    refuse,
    standin_for,
    stepping_for,
    stumble,
    vanish,
)

PLAN = """
[flight]
name = "tiny"
lead_s = 0.0

[[line]]
name = "one"
from_m = [-100.0, 0.0]
to_m = [100.0, 0.0]
height_m = 700.0

[terrain]
cell_m = 20.0

[control]
points = 3

[scanner.left]
prf_hz = 5_000.0
range_max_m = 1500.0
on_lines_only = false
"""
BESIDE = {"README.md", "control.csv", "left.nominal.toml", "left.true.toml", "main.dbc", "plan.toml", "swath.toml"}
SECONDS = "4"


@pytest.fixture(scope="module")
def plan(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("plan") / "tiny.toml"
    path.write_text(PLAN)
    return str(path)


@pytest.fixture(scope="module")
def flown(plan: str, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    folder = tmp_path_factory.mktemp("flown") / "new" / "folder"
    done = swath("sim", "fly", plan, "-o", str(folder), "--seconds", SECONDS)
    assert done.returncode == 0, done.stderr
    phases = ("preparing the flight: ", "flying tiny: ", "packing the truth: ")  # printed where all takes over 5 s
    assert [line for line in done.stderr.splitlines() if not line.startswith(phases)] == []
    return folder, done.stdout


def in_process(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str]:
    """Run a command in this process, which saves the second of starting one, and return exit code and stderr."""
    code = cli.run_app(["sim", *arguments])
    return code, capsys.readouterr().err


def plan_with(folder: Path, before: str, after: str) -> str:
    assert before in PLAN
    path = folder / "other.toml"
    path.write_text(PLAN.replace(before, after))
    return str(path)


class TestFlyIntoALog:
    def test_the_log_is_written_with_its_files(self, flown: tuple[Path, str]) -> None:
        folder, said = flown
        [log] = folder.glob("*.mcap")
        assert {path.name for path in folder.iterdir()} == BESIDE | {"truth.npz", log.name}
        first, second, third = said.splitlines()
        assert first.startswith(f"{log.stem.removesuffix('_0')}: 4.0 s flown in ")
        assert second.strip() == str(log)
        assert third.strip() == f"beside it: {', '.join(sorted(BESIDE | {'truth.npz'}))}"
        content = read_log(log)
        assert content.damage == 0
        counts = official_counts(log)
        for topic in ("/gnss/rover/raw", "/imu/main/raw", "/scanner/left/raw", "/pps/main", "/clock"):
            assert counts[topic] > 3, topic
        units = sum(counts[f"/{source}"] + counts[f"/{source}/raw"] for source in SOURCES)
        assert f" {units:,} units, " in first

    def test_the_written_configuration_is_complete_and_equals_the_one_in_the_log(self, flown: tuple[Path, str]) -> None:
        folder, _ = flown
        said = swath("check", "--offline", str(folder / "swath.toml")).stdout
        assert "valid; 4 sources: pps/main, gnss/rover, imu/main, scanner/left" in said
        [session] = open_logs([folder])
        attachments = session.attachments()
        assert attachments["config.toml"] == (folder / "swath.toml").read_bytes()
        assert attachments["calibration/left.toml"] == (folder / "left.nominal.toml").read_bytes()
        assert attachments["dbc/main.dbc"] == (folder / "main.dbc").read_bytes()
        assert session.info.origin == "simulation"

    def test_the_same_plan_gives_the_same_bytes_under_another_file_name(
        self, plan: str, flown: tuple[Path, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        log = tmp_path / "again.mcap"
        assert in_process(capsys, "fly", plan, "-o", str(log), "--seconds", SECONDS) == (0, "")
        [before] = flown[0].glob("*.mcap")
        assert {path.name for path in tmp_path.iterdir()} == BESIDE | {"truth.npz", "again.mcap"}
        assert log.read_bytes() == before.read_bytes()
        for name in BESIDE | {"truth.npz"}:
            assert (tmp_path / name).read_bytes() == (flown[0] / name).read_bytes(), name

    def test_another_seed_changes_the_log_and_no_truth_is_written(
        self, plan: str, flown: tuple[Path, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        words = ("fly", plan, "-o", str(tmp_path), "--seconds", "2", "--seed", "7", "--no-truth")
        assert in_process(capsys, *words) == (0, "")
        [log], [before] = tmp_path.glob("*.mcap"), flown[0].glob("*.mcap")
        assert log.name != before.name
        assert read_log(log).data("imu/main") not in read_log(before).data("imu/main")
        assert {path.name for path in tmp_path.iterdir()} == BESIDE | {log.name}

    def test_existing_files_are_not_overwritten(
        self, plan: str, flown: tuple[Path, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        folder, _ = flown
        [log] = folder.glob("*.mcap")
        before = {path.name: path.read_bytes() for path in folder.iterdir()}
        line = f"swath: {folder / 'swath.toml'}: already exists; remove it or choose another place\n"
        assert in_process(capsys, "fly", plan, "-o", str(folder), "--seconds", SECONDS) == (ExitCode.IO, line)
        assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
        (tmp_path / log.name).write_bytes(before[log.name])
        line = f"swath: {tmp_path / log.name}: already exists; remove it or choose another directory\n"
        words = ("fly", plan, "-o", str(tmp_path), "--seconds", SECONDS, "--no-truth")
        assert in_process(capsys, *words) == (ExitCode.IO, line)
        assert [path.name for path in tmp_path.iterdir()] == [log.name]

    @pytest.mark.slow
    def test_an_interrupted_flight_leaves_no_files(self, tmp_path: Path) -> None:
        folder = tmp_path / "flight"
        command = [sys.executable, "-m", "swath.daemon.cli.main", "sim", "fly", "small", "-o", str(folder)]
        with subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True) as flying:
            wait_until(lambda: list(folder.rglob("*.mcap")), "a log that grows")
            flying.send_signal(signal.SIGINT)
            _, said = flying.communicate(timeout=HANGS_S)
        assert (flying.returncode, said.splitlines()) == (
            cli.INTERRUPTED,
            ["swath: interrupted; nothing written"],
        )
        assert list(tmp_path.iterdir()) == []

    def test_a_full_disk_leaves_no_files(
        self, plan: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def refuse_chunk(*_: object) -> None:
            raise OSError(28, "No space left on device")

        monkeypatch.setattr("swath.daemon.log.mcap.writer.PartWriter.flush", refuse_chunk)
        words = ("fly", plan, "-o", str(tmp_path / "flight"), "--seconds", "2", "--no-truth")
        code, said = in_process(capsys, *words)
        assert code == ExitCode.IO
        assert said.startswith(f"swath: {tmp_path / 'flight'}: no space left on the disk (")
        assert "; nothing written; free some space, or " in said
        assert said.count("\n") == 1
        assert list(tmp_path.iterdir()) == []

    def test_two_simultaneous_flights_do_not_interfere(self, tmp_path: Path) -> None:
        with FlightFolder(tmp_path / "logs") as folder:
            with pytest.raises(UserError, match="another flight runs there, or was killed there"):
                FlightFolder(tmp_path / "logs")
            folder.write({"one.txt": b"1"})
        assert list(tmp_path.iterdir()) == []


class TestErrors:
    @pytest.mark.parametrize(
        ("arguments", "line"),
        [
            (
                ("fly", "nowhere.toml", "-o", "x"),
                "nowhere.toml: No such file or directory; give a plan file or one of",
            ),
            (("fly", "small"), "no output given; use -o LOG or --wire"),
            (("fly", "small", "-o", "x", "--config", "y"), "--config needs --wire"),
            (("fly", "small", "-o", "x", "--set-clock"), "--set-clock needs --wire"),
            (
                ("fly", "small", "--wire", "-o", "x", "--config", "y"),
                "--wire takes -o (new wires in a folder) or --config",
            ),
            (("fly", "small", "--wire", "--config", "nowhere.toml"), "nowhere.toml: No such file or directory; give"),
            (("fly", "small", "-o", "x", "--seed", str(2**63)), "small: flight.seed: got 9223372036854775808, want"),
            (("plan", "small", "-o", "x.gif"), "x.gif: want a picture's name that ends in one of"),
        ],
    )
    def test_a_usage_error_is_one_line_and_exit_code_2(
        self,
        tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch,
        capsys: pytest.CaptureFixture[str],
        arguments: tuple[str, ...],
        line: str,
    ) -> None:
        monkeypatch.chdir(tmp_path)
        code, said = in_process(capsys, *arguments)
        assert (code, said.count("\n")) == (ExitCode.USAGE, 1)
        assert said.startswith(f"swath: {line}")
        assert list(tmp_path.iterdir()) == []

    @pytest.mark.parametrize(
        ("before", "after", "line"),
        [
            ("prf_hz", "prf_khz", "scanner.left.prf_khz: unknown key"),
            ("height_m = 700.0", "height_m = 460.0", "line[0].height_m: "),
            ("prf_hz", 'kind = "maser"\nprf_hz', "scanner.left.kind: got 'maser', want "),
            (
                "[control]",
                '[[fault]]\nsource = "imu/other"\nkind = "silent"\nat_s = 1.0\n[control]',
                "fault[0].source: ",
            ),
        ],
    )
    def test_error_for_a_plan_that_cannot_be_flown_names_its_key(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str], before: str, after: str, line: str
    ) -> None:
        path = plan_with(tmp_path, before, after)
        code, said = in_process(capsys, "fly", path, "-o", str(tmp_path / "logs"))
        assert (code, said.count("\n")) == (ExitCode.USAGE, 1), said
        assert said.startswith(f"swath: {path}: {line}")
        assert not (tmp_path / "logs").exists()

    @pytest.mark.parametrize("words", [("fly", "small", "-o", "x"), ("fly", "small", "--wire"), ("plan", "small")])
    def test_without_the_extra_the_error_names_the_packages(
        self,
        monkeypatch: pytest.MonkeyPatch,
        capsys: pytest.CaptureFixture[str],
        tmp_path: Path,
        words: tuple[str, ...],
    ) -> None:
        real = importlib.util.find_spec
        missing = ("numba", "scipy")
        monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name in missing else real(name))
        monkeypatch.chdir(tmp_path)
        line = f"swath: swath sim needs scipy, numba, which are not installed: {how_to_install('sim')}\n"
        assert in_process(capsys, *words) == (ExitCode.USAGE, line)
        assert list(tmp_path.iterdir()) == []

    def test_without_a_command_the_available_ones_are_listed(self) -> None:
        run = swath("sim")
        assert run.returncode == ExitCode.USAGE
        assert "Usage: swath sim" in run.stdout

    def test_the_help_lists_the_presets(self) -> None:
        assert PRESETS.split(", ") == list(REAL_PRESETS)


def test_a_plan_is_drawn_and_summarised(plan: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = tmp_path / "plan.png"
    assert cli.run_app(["sim", "plan", plan, "-o", str(picture), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert [line["name"] for line in told["lines"]] == ["one"]
    assert told["lines"][0]["length_m"] == pytest.approx(200.0)
    assert told["total"]["pulses"] == pytest.approx(5000 * told["total"]["seconds"], abs=1)
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert cli.run_app(["sim", "plan", plan, "-o", str(picture)]) == ExitCode.USAGE
    assert "choose another name or use --overwrite" in capsys.readouterr().err
    assert cli.run_app(["sim", "plan", plan, "-o", str(picture), "--overwrite"]) == 0
    text = capsys.readouterr().out
    assert text.splitlines()[1].split()[:3] == ["one", "200", "m"]
    assert text.splitlines()[-1] == str(picture)


class Noted(Output):
    """Output that accepts everything and notes what arrived when, and that it was closed."""

    def __init__(self, notes: list[tuple[str, bytes, int]], name: str) -> None:
        self._notes, self._name = notes, name

    def send(self, data: bytes, due_realtime_ns: int) -> bool:
        self._notes.append((self._name, data, due_realtime_ns))
        return True

    def close(self) -> None:
        self._notes.append((self._name, b"closed", time.time_ns()))


@pytest.fixture
def ahead() -> Iterator[Callable[..., Ahead]]:
    """Make flights in other processes and end them."""
    made: list[Ahead] = []

    def make(function: Callable[..., tuple[Standin, dict[str, bytes]]], *arguments: object) -> Ahead:
        made.append(Ahead(functools.partial(function, *arguments)))
        return made[-1]

    yield make
    for one in made:
        one.close()


class TestFlightInAnotherProcess:
    def test_the_same_units_arrive_in_the_same_order(self, ahead: Callable[..., Ahead]) -> None:
        one = ahead(make_standin, 5.0, ((1.0, 60.0),), (("gnss/rover", 2.0, 3.0),))
        facts = FlightFacts(5.0, SOURCES, ((1.0, 60.0),), (("gnss/rover", 2.0, 3.0),), {"README.md": b"none"})
        assert one.facts == facts
        want = [
            TimedUnit(round(unit.time_s * 1e9), unit.source, unit.data)
            for unit in Standin(5.0, pulled=(("gnss/rover", 2.0, 3.0),)).units()
        ]
        assert list(one.units()) == want

    def test_the_process_waits_when_it_is_far_enough_ahead(self, ahead: Callable[..., Ahead]) -> None:
        one = ahead(make_standin, 300.0)
        assert one.facts.duration_s == 300.0
        wait_until(lambda: one._words.full(), "a full queue")
        assert one._words.maxsize * BATCH_S == pytest.approx(AHEAD_S)
        assert next(one.units()).source == "pps/main"
        one.close()
        assert one._process.exitcode is not None

    def test_errors_of_the_process_are_reported(self, ahead: Callable[..., Ahead]) -> None:
        with pytest.raises(UserError, match="it cannot be flown"):
            assert ahead(refuse).facts
        with pytest.raises(RuntimeError, match="ZeroDivisionError"):
            assert ahead(stumble).facts
        with pytest.raises(RuntimeError, match="the process that computes the flight has ended unexpectedly"):
            assert ahead(vanish).facts


class TestWires:
    def test_own_wires_use_addresses_that_nothing_else_uses(self, tmp_path: Path) -> None:
        wires = own_wires(tmp_path, SOURCES, {"gnss/rover": 460_800})
        assert wires["gnss/rover"] == f"serial:{tmp_path}/gnss-rover?baud=460800"
        assert wires["pps/main"] == f"fixed:{tmp_path}/pps-main"
        config = aircraft_config(
            tmp_path,
            {
                "/dev/pps0": wires["pps/main"],
                "serial:/dev/ttyUSB0?baud=921600": wires["gnss/rover"],
                "can:socketcan:can0?bitrate=1000000": wires["imu/main"],
                "udp:0.0.0.0:2368": wires["scanner/left"],
                "udp:0.0.0.0:8308": wires["scanner/left/aux"],
            },
        )
        facts = FlightFacts(1.0, SOURCES, (), ())
        outputs, others = open_wires(config, facts)
        assert (sorted(outputs), others) == (sorted([*SOURCES, "raw/radar"]), {})
        for output in outputs.values():
            output.close()

    def test_units_leave_in_time_and_devices_are_unplugged_between_them(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        notes: list[tuple[str, bytes, int]] = []
        steps: list[int] = []

        def makers(*_: object, **__: object) -> dict[str, Callable[[], Output]]:
            return {source: functools.partial(Noted, notes, source) for source in SOURCES}

        monkeypatch.setattr("swath.daemon.simulate.on_wires.output_makers", makers)
        monkeypatch.setattr(time, "clock_settime_ns", lambda _, now_ns: steps.append(now_ns - time.time_ns()))
        flight = Standin(2.0, ((0.75, 3600.0),), (("gnss/rover", 0.05, 0.105),))
        facts = FlightFacts(2.0, SOURCES, tuple(flight.wall_steps), tuple(flight.unplugged))
        outputs, others = open_wires(aircraft_config(tmp_path), facts)
        sent = [TimedUnit(round(unit.time_s * 1e9), unit.source, unit.data) for unit in flight.units()]
        with one_processor():
            began_ns = time.time_ns()
            report = fly_on_wires(iter(sent), facts, outputs, others)
        assert time.time_ns() - began_ns > 1.9e9
        assert report.latest_s < 5.0
        for output in (*outputs.values(), *others.values()):
            output.close()
        units = [(name, data) for name, data, _ in notes if data != b"closed"]
        assert units == [(unit.source, unit.data) for unit in sent]
        pulled = [name for name, data, _ in notes if data == b"closed"]
        assert sorted(pulled) == sorted([*SOURCES, "gnss/rover"])  # all are closed at the end
        assert notes.index(next(note for note in notes if note[1] == b"closed")) < 30
        edges = [due_ns for name, data, due_ns in notes if name == "pps/main" and data == b""]
        assert edges[1] - edges[0] == pytest.approx(1e9 + 3600e9, abs=2)  # a second, measured by the stepped clock
        assert [round(step_ns / 1e9) for step_ns in steps] == [0, 3600, -3600]

    def test_a_wall_clock_without_permission_is_refused(self, monkeypatch: pytest.MonkeyPatch) -> None:
        def refuse_to(*_: object) -> None:
            raise PermissionError(1, "Operation not permitted")

        monkeypatch.setattr(time, "clock_settime_ns", refuse_to)
        with pytest.raises(UserError, match="--set-clock: this user may not set the clock"):
            WallClock()

    @pytest.mark.slow
    def test_a_recorder_receives_the_units_of_the_simulated_log(
        self, plan: str, flown: tuple[Path, str], tmp_path: Path
    ) -> None:
        folder = tmp_path / "wires"
        command = [sys.executable, "-m", "swath.daemon.cli.main", "sim", "fly", plan, "--wire", "-o", str(folder)]
        with subprocess.Popen([*command, "--seconds", SECONDS], cwd=ROOT, stderr=subprocess.PIPE, text=True) as flying:
            wait_until((folder / "swath.toml").exists, "a configuration")
            wait_until((folder / "pps-main").exists, "the last of the wires")
            text = (folder / "swath.toml").read_text()
            head = session_table(folder / "logs", name='"tiny"')
            config = text.replace(text[: text.index("[pps.main]")], head)
            for name in ("left.nominal.toml", "main.dbc", "plan.toml"):
                (tmp_path / name).write_bytes((folder / name).read_bytes())
            with Recorder(tmp_path, config) as recorder:
                _, said = flying.communicate(timeout=HANGS_S)
                time.sleep(1.2)
                assert recorder.stop() == 0
        assert flying.returncode == 0, said
        assert f"  swath run {folder}/swath.toml" in said.splitlines()
        assert "nobody has opened it" not in said
        sent, got = read_log(flown[0]), read_log(folder / "logs")
        assert got.data("gnss/rover") == sent.data("gnss/rover")
        for source in ("imu/main", "scanner/left"):
            assert [data for _, data in got.units[source]] == [data for _, data in sent.units[source]], source
            assert f"{source}: {len(got.units[source]):,} units, " in said
        assert len(got.messages["/pps/main"]) == len(sent.messages["/pps/main"])
        assert load_config(folder / "swath.toml").session.directory == str(folder / "logs")

    def test_existing_wires_are_not_overwritten(
        self, plan: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("swath.daemon.simulate.plans.make_flight_in_time", standin_for)
        path = tmp_path / "swath.toml"
        path.write_text("")
        code, said = in_process(capsys, "fly", plan, "--wire", "-o", str(tmp_path))
        line = f"swath: {path}: already exists; use its wires with --config {path}, or choose another folder\n"
        assert (code, said) == (ExitCode.IO, line)
        assert path.read_text() == ""

    def test_a_mismatch_between_wires_and_sources_is_refused(
        self, plan: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        path = tmp_path / "swath.toml"
        config = session_table(tmp_path / "logs")
        config += f'[pps.main]\nsource = "fixed:{tmp_path}/pps"\n[pps.other]\nsource = "fixed:{tmp_path}/other"\n'
        path.write_text(config)
        monkeypatch.setattr("swath.daemon.simulate.plans.make_flight_in_time", standin_for)
        with one_processor():
            code, said = in_process(capsys, "fly", plan, "--wire", "--config", str(path), "--wait", "0")
        assert code == 0
        lines = said.splitlines()
        assert "pps/main: no reader has opened it; flying without one" in lines
        assert f"imu/main: is in the flight but not in {path}; not sent" in lines
        assert f"pps/other: is in {path} but not in the flight" in lines
        assert "pps/main: 0 units, 0 bytes, 1 rejected by a reader" in lines
        assert not (tmp_path / "pps").exists()

    def test_stepping_the_clock_is_refused_before_any_wire_is_made(
        self, plan: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("swath.daemon.simulate.plans.make_flight_in_time", stepping_for)
        code, said = in_process(capsys, "fly", plan, "--wire", "-o", str(tmp_path / "wires"))
        assert (code, said.count("\n")) == (ExitCode.USAGE, 1)
        assert said.startswith("swath: fault clock_step would step this computer's wall clock (+60 s at 1 s)")
        assert list(tmp_path.iterdir()) == []
