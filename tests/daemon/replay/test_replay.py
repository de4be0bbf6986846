"""Tests that ``swath replay`` gives a second recorder what the first one recorded."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from statistics import median

import can
import pytest

from swath.daemon.replay.wire_player import Output, PtyOutput, TimedUnit, play
from swath.drivers.transports.base import TransportError
from tests.builders import ROOT
from tests.daemon.builders import ROVER_CONFIG, SREP, Pty, nmea_zda
from tests.daemon.log_check import LogContent, read_log
from tests.daemon.rig import HANGS_S, Recorder, free_udp_port, one_processor, session_table

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("replay")]  # one worker records once what is replayed
SECONDS = 10
# it is LOCKED after the table's end too
TIMED = ROVER_CONFIG.replace('protocol = "nmea"', 'protocol = "nmea"\nleap_seconds = 18')
BUS = '[imu.main]\ntransport = "can:udp_multicast:239.74.163.2?port={port}"\nprotocol = "canmod-gps"\n'


def record_first(folder: Path) -> LogContent:
    """Record a log of two parts with datagrams, sentences and edges of some seconds."""
    port, link, fifo = free_udp_port(), folder / "rover", folder / "pps"
    folder.mkdir()
    os.mkfifo(fifo)
    pty = Pty(link)
    can_port = free_udp_port()
    config = session_table(folder / "logs") + SREP.format(port=port) + TIMED.format(path=link, fifo=fifo)
    with (
        Recorder(folder, config + BUS.format(port=can_port)) as recorder,
        fifo.open("w") as edges,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
        can.Bus(interface="udp_multicast", channel="239.74.163.2", port=can_port) as bus,
    ):
        recorder.wait_said("device_opened", times=4)
        start = time.time_ns() + 200_000_000
        with one_processor():
            for second in range(SECONDS):
                due = start + second * 1_000_000_000
                time.sleep(max(0.0, (due - time.time_ns()) * 1e-9))
                edges.write(f"{due} {second + 1}\n")
                edges.flush()
                time.sleep(0.2)
                pty.write(nmea_zda(40_000 + second))
                for _ in range(50):
                    sender.sendto(os.urandom(400), ("127.0.0.1", port))
                for number in range(10):
                    bus.send(
                        can.Message(arbitration_id=second, data=bytes([number] * 8), is_extended_id=second % 2 > 0)
                    )
                if second == SECONDS // 2:
                    recorder.process.send_signal(signal.SIGHUP)
        time.sleep(0.5)
        assert recorder.stop() == 0, recorder.stderr()
    pty.unplug()
    assert len(list((folder / "logs").glob("*.mcap"))) == 2
    return read_log(folder / "logs")


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, LogContent]:
    folder = tmp_path_factory.mktemp("replay") / "first"
    return folder / "logs", record_first(folder)


def replay_into_a_recorder(folder: Path, logs: Path, pace: str) -> tuple[LogContent, str]:
    """Play logs to a second recorder that was started first, and return what it recorded and what replay reported."""
    port, link, fifo = free_udp_port(), folder / "rover", folder / "pps"
    config = session_table(folder / "logs") + SREP.format(port=port) + TIMED.format(path=link, fifo=fifo)
    config += BUS.format(port=free_udp_port())
    config += (
        f'[scanner.right]\ntransport = "udp:127.0.0.1:{free_udp_port()}"\nprotocol = "srep"\nmirror_factor = 1.0\n'
    )
    with Recorder(folder, config) as recorder:
        recorder.wait_said("scanner/left device_opened")
        recorder.wait_said("imu/main device_opened")
        command = [
            sys.executable,
            "-m",
            "swath.daemon.cli.main",
            "replay",
            "--pace",
            pace,
            "--wire",
            str(recorder.config),
        ]
        played = subprocess.run(
            [*command, "--wait", "30", str(logs)],
            cwd=ROOT,
            capture_output=True,
            text=True,
            timeout=HANGS_S,
            check=False,
        )
        assert played.returncode == 0, played.stderr
        time.sleep(1.2)
        assert recorder.stop() == 0, recorder.stderr()
    return read_log(folder / "logs"), played.stderr


def same_bytes(one: LogContent, other: LogContent) -> None:
    assert other.data("gnss/rover") == one.data("gnss/rover")
    for source, count in (("scanner/left", 50 * SECONDS), ("imu/main", 10 * SECONDS)):
        units = [[data for _, data in log.units[source]] for log in (one, other)]
        assert units[0] == units[1]
        assert len(units[0]) == count


def time_states(content: LogContent) -> list[str]:
    return [value["time_state"] for _, value in content.messages["/status/pps/main"]]


def test_a_second_recorder_gets_the_same_bytes_edges_and_seconds(
    tmp_path: Path, first: tuple[Path, LogContent]
) -> None:
    logs, before = first
    after, said = replay_into_a_recorder(tmp_path, logs, "1")
    same_bytes(before, after)
    edges = [[value["edge_time_ns"] for _, value in log.messages["/pps/main"]] for log in (before, after)]
    assert len(edges[1]) == SECONDS
    steps = [[late - early for early, late in pairwise(times)] for times in edges]
    # a stamp follows the wall clock, which may be slewed by 500 ppm; the writer rounds to a nanosecond
    assert all(abs(new - old) < 1_000_000 for old, new in zip(*steps, strict=True)), steps
    assert time_states(before)[-1] == time_states(after)[-1] == "LOCKED"
    known = [log.events("second_known") for log in (before, after)]
    assert [[event["text"] for event in events] for events in known] == [["by gnss/rover ZDA"]] * 2
    # a sentence has the same delay after its edge as in the recording, unless the machine was busy
    delays = [arrival_after_edge(log) for log in (before, after)]
    later = [abs(new - old) for old, new in zip(*delays, strict=True)]
    assert median(later) < 0.1, delays
    assert "scanner/right: no data for it in" in said


def arrival_after_edge(content: LogContent) -> list[float]:
    """Return the seconds from each edge to the first sentence after it."""
    arrivals = [time_ns for time_ns, _ in content.units["gnss/rover"]]
    edges = [value["edge_time_ns"] for _, value in content.messages["/pps/main"]]
    return [min(arrival - edge for arrival in arrivals if arrival > edge) * 1e-9 for edge in edges]


def test_at_another_speed_no_edges_and_no_times_are_replayed(tmp_path: Path, first: tuple[Path, LogContent]) -> None:
    logs, before = first
    after, _ = replay_into_a_recorder(tmp_path, logs, "2")
    same_bytes(before, after)
    assert after.messages["/pps/main"] == []
    assert set(time_states(after)) == {"NO_TIME"}


def test_info_names_a_missing_first_part_and_reports_no_wrong_count(
    tmp_path: Path, first: tuple[Path, LogContent]
) -> None:
    second = sorted(first[0].glob("*.mcap"))[1]
    shutil.copy(second, tmp_path / second.name)
    command = [sys.executable, "-m", "swath.daemon.cli.main", "info", "--json", str(tmp_path)]
    told = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=HANGS_S, check=False)
    assert told.returncode == 1, told.stderr
    (session,) = json.loads(told.stdout)["sessions"]
    assert session["missing_parts"] == [0]
    assert {source["account_errors"] for source in session["sources"].values()} == {0}


def test_an_unread_port_does_not_delay_the_others(tmp_path: Path) -> None:
    output = PtyOutput(tmp_path / "port")
    started = time.monotonic()
    refused = sum(not output.send(b"x" * 4096, 0) for _ in range(200))
    assert refused > 190
    assert time.monotonic() - started < 30  # waited for once, not two hundred times
    output.close()
    assert not (tmp_path / "port").is_symlink()


def test_a_device_link_is_kept_and_one_left_by_a_killed_replay_is_replaced(tmp_path: Path) -> None:
    """A replay with the aircraft's own configuration must not replace udev's name of the receiver."""
    link = tmp_path / "rover"
    link.symlink_to("/dev/null")
    with pytest.raises(TransportError, match="is not a link to a pseudo-terminal"):
        PtyOutput(link)
    assert link.readlink() == Path("/dev/null")
    for left in ("/dev/pts/ptmx", "/dev/pts/999999"):
        link.unlink()
        link.symlink_to(left)
        output = PtyOutput(link)
        assert link.readlink() != Path(left)
        output.close()
        assert not link.is_symlink()
        link.symlink_to(left)


class Dues(Output):
    """Output that accepts everything and records when each unit was due."""

    def __init__(self) -> None:
        self.realtime_ns: list[int] = []

    def send(self, data: bytes, due_realtime_ns: int) -> bool:
        self.realtime_ns.append(due_realtime_ns)
        return True

    def close(self) -> None:
        return None


def test_time_begins_with_the_first_unit_however_long_reading_takes() -> None:
    """Otherwise only the first units of every source would be late."""
    output, read_ns = Dues(), []

    def units() -> Iterator[TimedUnit]:
        read_ns.append(time.time_ns())
        yield TimedUnit(5_000_000, "gnss/rover", b"$")
        yield TimedUnit(6_000_000, "gnss/rover", b"$")

    with one_processor():
        play(units(), {"gnss/rover": output})
    first_ns, second_ns = output.realtime_ns
    assert first_ns >= read_ns[0]
    assert second_ns - first_ns == 1_000_000
