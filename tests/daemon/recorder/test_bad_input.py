"""Tests users' mistakes: one line with fact and remedy, and the right exit code."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from swath.drivers.captures.opening import read_pcap
from tests.daemon.commands import swath
from tests.daemon.log_check import read_log
from tests.daemon.rig import HANGS_S, Recorder, free_udp_port, session_table
from tests.daemon.wires import pty, udp_sender
from tests.drivers.recordings import recording
from tests.drivers.srep_cases import scan_lines

ROOT = Path(__file__).resolve().parents[3]
SCANNER = '[scanner.{name}]\ntransport = "udp:127.0.0.1:{port}"\nprotocol = "srep"\nmirror_factor = 1.0\n'


def run_once(tmp_path: Path, tables: str) -> subprocess.CompletedProcess[str]:
    config = tmp_path / "swath.toml"
    config.write_text(session_table(tmp_path / "logs") + tables)
    command = [sys.executable, "-m", "swath.daemon.cli.main", "run", "--seconds", "1", str(config)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=HANGS_S, check=False)


def the_line(done: subprocess.CompletedProcess[str], exit_code: int) -> str:
    assert done.returncode == exit_code, done.stderr
    (line,) = done.stderr.splitlines()
    assert line.startswith("swath: ")
    return line


def test_two_sources_on_one_port_are_refused(tmp_path: Path) -> None:
    tables = SCANNER.format(name="left", port=2368) + SCANNER.format(name="right", port=2368)
    line = the_line(run_once(tmp_path, tables), 2)
    assert "scanner.left.transport and scanner.right.transport: both use UDP port 2368" in line
    assert not (tmp_path / "logs").exists()


def test_a_dbc_without_the_named_signals_is_refused(tmp_path: Path) -> None:
    shutil.copy(ROOT / "fixtures" / "config" / "imu.dbc", tmp_path / "imu.dbc")
    tables = (
        '[imu.main]\ntransport = "can:virtual:test"\nprotocol = "dbc"\ndbc = "imu.dbc"\nrate_hz = 200\n'
        "[imu.main.signals]\n"
        'specific_force = ["ACC.acc_x", "ACC.acc_y", "ACC.sideways"]\n'
        'angular_rate = ["GYR.gyr_x", "GYR.gyr_y", "GYR.gyr_z"]\n'
    )
    line = the_line(run_once(tmp_path, tables), 2)
    assert "no signal ACC.sideways in imu.dbc" in line
    assert "message ACC has: acc_x, acc_y, acc_z" in line


def test_a_missing_configuration_is_refused(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "swath.daemon.cli.main", "run", str(tmp_path / "nothing.toml")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=HANGS_S, check=False)
    assert "nothing.toml" in the_line(done, 2)


@pytest.mark.parametrize("command", ["mark", "monitor"])
def test_a_note_given_as_a_directory_is_refused_in_one_line(command: str) -> None:
    """The text is longer than a file name may be, and the error is still one line."""
    note = "line 4, clouds below us and turbulence, " * 8
    done = swath(*((command, "logs", note) if command == "mark" else (command, "--once", note)))
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "; give the log directory or a configuration file" in done.stderr
    assert "internal error" not in done.stderr


@pytest.mark.slow
def test_a_configuration_of_another_aircraft_is_reported_device_by_device(tmp_path: Path) -> None:
    """Each device with another protocol is named, the right one is not, and every byte is recorded."""
    ubx = recording("ubx", "ublox-zed-f9p-hp.log")
    srep = scan_lines()
    velodyne = [unit.data for unit in read_pcap(ROOT / "fixtures/velodyne/nebula_vlp16.pcap.gz")]
    left, right = free_udp_port(), free_udp_port()
    tables = SCANNER.format(name="left", port=left) + SCANNER.format(name="right", port=right)
    with (
        pty(lambda number: ubx[number * 1000 % len(ubx) :][:1000]) as path,
        udp_sender(left, lambda number: srep[number % len(srep)]),
        udp_sender(right, lambda number: velodyne[number % len(velodyne)]),
    ):
        tables += f'[gnss.rover]\ntransport = "serial:{path}"\nprotocol = "novatel"\n'
        with Recorder(tmp_path, session_table(tmp_path / "logs") + tables) as recorder:
            recorder.wait_said("wrong_protocol", times=2)
            assert recorder.stop() == 0
    log = read_log(tmp_path / "logs")
    assert {event["source"]: event["text"] for event in log.events("wrong_protocol")} == {
        "gnss/rover": "sends ubx, but novatel is configured; recording continues",
        "scanner/right": "sends velodyne-vlp16, but srep is configured; recording continues",
    }
    assert all(log.units[source] for source in ("gnss/rover", "scanner/left", "scanner/right"))


@pytest.mark.parametrize("what", ["absent", "no PPS device"])
def test_an_unusable_pps_is_reported_and_the_others_are_recorded(tmp_path: Path, what: str) -> None:
    path = tmp_path / "pps0"
    if what != "absent":
        path.write_text("")
    port = free_udp_port()
    tables = f'[pps.main]\nsource = "{path}"\n' + SCANNER.format(name="left", port=port)
    with Recorder(tmp_path, session_table(tmp_path / "logs") + tables) as recorder:
        recorder.wait_said("pps/main device_absent")
        recorder.wait_said("scanner/left device_opened")
        assert recorder.stop() == 0
    (event,) = [event for event in read_log(tmp_path / "logs").events("device_absent") if event["source"] == "pps/main"]
    assert str(path) in event["text"]
    assert "\n" not in event["text"]


def test_a_receive_buffer_that_is_not_granted_is_reported_with_the_command(tmp_path: Path) -> None:
    setpriv = shutil.which("setpriv")
    assert setpriv is not None, "setpriv (util-linux) is needed to run without CAP_NET_ADMIN"
    assert int(Path("/proc/sys/net/core/rmem_max").read_text()) < 32 << 20, "this machine grants 32 MiB to everybody"
    port = free_udp_port()
    without = [setpriv, "--bounding-set", "-net_admin", "--inh-caps", "-net_admin"]
    config = session_table(tmp_path / "logs") + SCANNER.format(name="left", port=port)
    with Recorder(tmp_path, config, prefix=without if os.geteuid() == 0 else None) as recorder:
        recorder.wait_said("receive_buffer_small")
        assert recorder.stop() == 0
    (event,) = read_log(tmp_path / "logs").events("receive_buffer_small")
    assert "sysctl -w net.core.rmem_max=" in event["text"]
