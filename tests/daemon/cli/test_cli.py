"""Tests the command line as users and scripts see it, in real processes: help, one-line errors, exit codes."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from typer.testing import CliRunner

from swath.daemon.cli.main import COMMANDS, make_app
from swath.daemon.errors import ExitCode
from swath.drivers.driver import KINDS, all_drivers
from tests.builders import ROOT
from tests.daemon.builders import run_python, swath
from tests.daemon.rig import HANGS_S

AIRCRAFT = ROOT / "fixtures/config/aircraft.toml"
BAD = ROOT / "fixtures/config/bad"
INTERRUPTED, PIPE_CLOSED = 130, 141


class TestHelp:
    def test_fits_a_screen_and_names_every_command_with_its_panel(self) -> None:
        run = swath("--help", COLUMNS="80")
        assert run.returncode == 0
        lines = run.stdout.splitlines()
        assert len([line for line in lines if line.strip()]) <= 48
        for listed in COMMANDS:
            assert any(line.startswith(f"│ {listed.name} ") for line in lines), listed.name
            assert any(line.startswith(f"╭─ {listed.panel} ") for line in lines), listed.panel

    def test_documents_every_exit_code(self) -> None:
        text = swath("--help").stdout
        for code in [*ExitCode, INTERRUPTED]:
            assert f"{int(code)} " in text.split("Exit codes:")[1]

    def test_the_page_names_every_command_and_exit_code(self) -> None:
        page = (ROOT / "docs/commands.md").read_text()
        assert [name for name in (listed.name for listed in COMMANDS) if f"| `swath {name}" not in page] == []
        codes = [
            int(line.split()[1]) for line in page.splitlines() if line.startswith("| ") and line.split()[1].isdigit()
        ]
        assert codes == [*(int(code) for code in ExitCode), INTERRUPTED, PIPE_CLOSED]

    @pytest.mark.slow
    def test_every_command_has_its_own_help(self) -> None:
        for listed in COMMANDS:
            result = CliRunner().invoke(make_app(None), [listed.name, "--help"])
            assert result.exit_code == 0, listed.name
            assert "Usage:" in result.output

    @pytest.mark.parametrize("name", ["georef", "live"])
    def test_help_explains_where_positions_come_from_without_an_ins(self, name: str) -> None:
        text = CliRunner().invoke(make_app(None), [name, "--help"], env={"COLUMNS": "300"}).output
        assert "IMU and GNSS" in " ".join(text.split())

    def test_the_help_loads_no_heavy_module(self) -> None:
        run = run_python(
            "code = cli.run_app(['--help'])\n"
            "heavy = ('numpy', 'pydantic', 'mcap', 'cantools', 'can', 'serial', 'scipy', 'pyproj')\n"
            "print('loaded:', [name for name in heavy if name in sys.modules])"
        )
        assert run.stdout.splitlines()[-1] == "loaded: []"

    def test_without_arguments_the_usage_is_shown(self) -> None:
        run = swath()
        assert "Usage: swath" in run.stdout
        assert run.returncode == ExitCode.USAGE

    def test_version_is_printed(self) -> None:
        run = swath("--version")
        assert run.returncode == 0
        assert run.stdout.startswith("swath 0.")


class TestErrors:
    @pytest.mark.parametrize(
        ("arguments", "line"),
        [
            (["fly"], "swath: No such command 'fly'; see `swath --help`"),
            (["check"], "swath: Missing argument 'CONFIG'; see `swath check --help`"),
            (["run"], "swath: Missing argument 'CONFIG'; see `swath run --help`"),
            (["devices", "--jsn"], "swath: No such option: --jsn"),
            (["check", "x.toml", "--seconds", "soon"], "swath: Invalid value for '--seconds'"),
            (["setup", "x.toml", "--from-baud", "2147483648"], "swath: Invalid value for '--from-baud'"),
            (["replay", "x.mcap", "--wire", "x.toml", "--pace", "nan"], "swath: --pace nan: must be a number above 0"),
            (["check", "nowhere.toml"], "swath: nowhere.toml: No such file or directory; give the path"),
        ],
    )
    def test_a_usage_error_is_one_line_and_exit_code_2(self, arguments: list[str], line: str) -> None:
        run = swath(*arguments)
        assert run.returncode == ExitCode.USAGE
        assert run.stderr.startswith(line)
        assert len(run.stderr.splitlines()) == 1
        assert run.stdout == ""

    @pytest.mark.parametrize("command", ["check", "run"])
    def test_a_wrong_configuration_lists_every_mistake_and_exits_with_2(self, command: str, tmp_path: Path) -> None:
        bad = BAD / "unknown_key.toml"
        run = swath(command, str(bad))
        assert run.returncode == ExitCode.USAGE
        assert sorted(run.stderr.splitlines()) == [
            f"swath: {bad}: pps.main.color: unknown key; there are: source, edge, delay_ns",
            f"swath: {bad}: scaner: unknown key; did you mean scanner?",
            f"swath: {bad}: session.splt_minutes: unknown key; did you mean split_minutes?",
        ]

    def test_an_internal_error_is_one_line_with_details_in_a_file(self, tmp_path: Path) -> None:
        run = run_python(
            "cli.make_app(None).command('boom')(lambda: 1 / 0)\nsys.exit(cli.run_app(['boom']))", TMPDIR=str(tmp_path)
        )
        assert run.returncode == ExitCode.PROBLEM
        [line] = run.stderr.splitlines()
        assert line.startswith("swath: internal error: ZeroDivisionError: division by zero (details in ")
        [details] = tmp_path.glob("swath-error-*.txt")
        assert line.endswith(f"{details})")
        assert "Traceback (most recent call last)" in details.read_text()

    def test_a_service_writes_error_details_to_its_state_directory(self, tmp_path: Path) -> None:
        run = run_python(
            "cli.make_app(None).command('boom')(lambda: {}['x'])\nsys.exit(cli.run_app(['boom']))",
            STATE_DIRECTORY=str(tmp_path),
        )
        assert run.returncode == ExitCode.PROBLEM
        assert len(list(tmp_path.glob("swath-error-*.txt"))) == 1

    def test_unwritable_output_is_an_io_error(self) -> None:
        with Path("/dev/full").open("w") as full:
            run = subprocess.run(
                [sys.executable, "-m", "swath.daemon.cli.main", "devices", "--json"],
                cwd=ROOT,
                stdout=full,
                stderr=subprocess.PIPE,
                text=True,
                timeout=HANGS_S,
                check=False,
            )
        assert run.returncode == ExitCode.IO
        [line] = run.stderr.splitlines()
        assert line == "swath: output: No space left on device; free some space and run the command again"

    def test_a_closed_pipe_ends_the_program_quietly(self) -> None:
        process = subprocess.Popen(
            [sys.executable, "-m", "swath.daemon.cli.main", "devices"],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        assert process.stdout is not None
        process.stdout.close()
        assert process.stderr is not None
        with process, process.stderr:
            assert process.stderr.read() == b""
            assert process.wait(timeout=HANGS_S) == PIPE_CLOSED

    def test_ctrl_c_ends_the_program_quietly_and_at_once(self, tmp_path: Path) -> None:
        config = tmp_path / "swath.toml"
        config.write_text(f'[session]\nname = "x"\ndirectory = "."\n[pps.main]\nsource = "fixed:{tmp_path}/edges"\n')
        os.mkfifo(tmp_path / "edges")
        process = subprocess.Popen(
            [sys.executable, "-m", "swath.daemon.cli.main", "check", str(config), "--seconds", "3000"],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # a background job's is ignored
        )
        with process:
            deadline_s = time.monotonic() + HANGS_S
            while not _has_open(process.pid, tmp_path / "edges") and time.monotonic() < deadline_s:
                time.sleep(0.05)
            process.send_signal(signal.SIGINT)
            _, stderr = process.communicate(timeout=HANGS_S)
        assert (process.returncode, stderr) == (INTERRUPTED, "swath: interrupted\n")


def _has_open(pid: int, path: Path) -> bool:
    """Return True if a process has opened the file."""
    folder = Path(f"/proc/{pid}/fd")
    links = [os.path.realpath(link) for link in folder.iterdir()] if folder.exists() else []
    return os.path.realpath(path) in links


class TestDevices:
    def test_json_lists_every_driver_with_its_requirements(self) -> None:
        run = swath("devices", "--json")
        listed = {(row["kind"], row["protocol"]): row for row in json.loads(run.stdout)["devices"]}
        assert set(listed) == {("raw", "raw"), *((kind, protocol) for kind in KINDS for protocol in all_drivers(kind))}
        srep = listed["scanner", "srep"]
        assert srep["transports"] == ["udp"]
        assert srep["needs"] == ["mirror_factor"]
        assert "ScannerReturns" in srep["yields"]

    def test_the_table_names_every_protocol_and_record(self) -> None:
        text = swath("devices").stdout
        for kind in KINDS:
            for driver in all_drivers(kind).values():
                assert driver.protocol in text
                assert all(record.__name__ in text for record in driver.yields)


SOURCES = ["pps/main", "gnss/rover", "imu/main", "scanner/left", "corrections/base", "raw/radar"]


class TestCheckOffline:
    def test_a_valid_configuration_opens_nothing_and_lists_its_sources(self) -> None:
        run = swath("check", "--offline", str(AIRCRAFT))
        assert run.returncode == 0
        first, second, *_ = run.stdout.splitlines()
        assert (
            first
            == f"{AIRCRAFT}: valid; 6 sources: pps/main, gnss/rover, imu/main, scanner/left, {', '.join(SOURCES[4:])}"
        )
        assert second == "imu/main: its x forward, y right, z down"

    def test_json_lists_the_sources(self) -> None:
        run = swath("check", "--offline", "--json", str(AIRCRAFT))
        assert json.loads(run.stdout)["sources"] == [
            "pps/main",
            "gnss/rover",
            "imu/main",
            "scanner/left",
            "corrections/base",
            "raw/radar",
        ]
