"""Tests that ``swath monitor`` reports of a running recorder what was sent to it."""

from __future__ import annotations

import gzip
import io
import json
import os
import pty
import signal
import socket
import subprocess
import sys
import termios
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from swath.daemon.cli.monitor import page, time_text
from swath.daemon.log.follow import Growth, LogFollower, PartFollower
from swath.daemon.log.mcap.encode import encode_block
from swath.daemon.log.mcap.writer import PartWriter
from swath.daemon.log.reader import open_logs
from swath.daemon.log.session import read_boot_id
from swath.daemon.monitor.source import Decoding
from swath.drivers.parser import PacketParser
from swath.drivers.scanner.srep.layout import SrepHeader, encode_datagram
from swath.georef.arrays import Int64Array
from swath.georef.records import ByteRows, Record
from tests.builders import ROOT
from tests.daemon.builders import (
    CAPTURE,
    INFO,
    SCANNER_CHANNEL,
    START_NS,
    Numbers,
    nmea_sentence,
    scanner,
    write_part,
)
from tests.daemon.commands import swath
from tests.daemon.log_check import read_log
from tests.daemon.monitor.builders import Looking
from tests.daemon.rig import HANGS_S, Recorder, disk_of, free_udp_port, session_table, wait_until
from tests.daemon.wires import pty as serial_port

ROVER = '[gnss.rover]\ntransport = "serial:{path}?baud=115200"\nprotocol = "nmea"\n'
PULSES = 10


def srep(sequence: int) -> bytes:
    header = SrepHeader(sequence=sequence, flags=1, pps_count=3, pps_ticks=1_000_000, first_ticks=1_500_000 + 20_000)
    return encode_datagram(header, np.arange(PULSES) * 50, np.arange(PULSES) * 100, np.full((PULSES, 1), 9_000_000))


@contextmanager
def srep_sender(port: int, hz: float, left_out: Callable[[int], bool] = lambda sequence: False) -> Iterator[None]:
    """Send datagrams with a sequence number, leaving some out."""
    stop = threading.Event()

    def send() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
            began_s, sequence = time.monotonic(), 0
            while not stop.is_set():
                if not left_out(sequence):
                    sock.sendto(srep(sequence), ("127.0.0.1", port))
                sequence += 1
                time.sleep(max(0.0, began_s + sequence / hz - time.monotonic()))

    thread = threading.Thread(target=send)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def once(where: Path) -> tuple[int, dict[str, Any]]:
    run = swath("monitor", "--once", "--json", str(where))
    assert run.stderr == ""
    return run.returncode, json.loads(run.stdout)


def once_when(where: Path, fits: Callable[[dict[str, Any]], bool], what: str) -> tuple[int, dict[str, Any]]:
    """Return the monitor's first output that fits, which comes later on a busy machine."""
    said: list[tuple[int, dict[str, Any]]] = []

    def is_said() -> bool:
        said.append(once(where))
        return fits(said[-1][1])

    wait_until(is_said, what)
    return said[-1]


def comes_as_sent(found: dict[str, Any]) -> bool:
    left = found["sources"].get("scanner/left", {})
    pulses_hz = left.get("decoded", {}).get("records_hz", {}).get("ScannerReturns", 0.0)
    return bool(
        found["verdict"] == "recording"
        and left.get("rate_hz") == pytest.approx(200.0, rel=0.05)
        and left.get("bytes_per_s") == pytest.approx(200.0 * len(srep(0)), rel=0.05)
        and pulses_hz == pytest.approx(200.0 * PULSES, rel=0.2)
    )


@pytest.mark.slow
def test_monitor_shows_the_sources_and_that_all_is_well(tmp_path: Path, logs: Path) -> None:
    port = free_udp_port()
    with Recorder(tmp_path, session_table(logs) + scanner(port)) as recorder, srep_sender(port, 200.0):
        recorder.wait_said("device_opened")
        code, found = once_when(recorder.config, comes_as_sent, "the rates of what is sent")
        line = swath("monitor", "--once", str(logs))
        assert recorder.stop() == 0
    assert (code, found["verdict"], found["troubles"]) == (0, "recording", [])
    left = found["sources"]["scanner/left"]
    assert left["state"] == "receiving"
    assert left["age_s"] < 2.0
    assert left["lost"] == {"lost_kernel": 0, "lost_queue": 0, "lost_write": 0}
    assert (left["decoded"]["gaps"], left["decoded"]["bad"]) == (0, 0)
    disk = os.statvfs(logs)
    free = disk.f_bavail * disk.f_frsize
    assert found["free_bytes"] == pytest.approx(free, rel=0.05)
    hours = (found["free_bytes"] - 1_000_000) / found["bytes_per_s"] / 3600
    assert found["hours_left"] == pytest.approx(hours, rel=0.01)
    assert [event["code"] for event in found["events"]] == ["session_started", "device_opened"]
    assert line.returncode == 0
    assert line.stdout.startswith(f"recording {found['session_id']} part 0: all 1 sources deliver data; ")
    assert line.stdout.count("\n") == 1


@pytest.mark.slow
def test_sequence_gaps_and_damaged_messages_degrade_the_verdict(tmp_path: Path, logs: Path) -> None:
    """Three of every hundred datagrams are omitted; one of two sentences has a wrong checksum."""
    port = free_udp_port()
    good = nmea_sentence("GPZDA,101500.00,21,11,2026,00,00")
    bad = good.replace(b"ZDA", b"ZDB")
    with (
        serial_port(lambda number: good if number % 2 else bad) as path,
        Recorder(tmp_path, session_table(logs) + scanner(port) + ROVER.format(path=path)) as recorder,
        srep_sender(port, 100.0, lambda sequence: sequence % 100 in (7, 8, 9)),
    ):
        recorder.wait_said("device_opened", times=2)

        def are_seen(found: dict[str, Any]) -> bool:
            decoded = [found["sources"].get(name, {}).get("decoded") for name in ("scanner/left", "gnss/rover")]
            return all(decoded) and decoded[0]["gaps"] > 0 and decoded[1]["messages"] > 10

        code, found = once_when(logs, are_seen, "gaps and damaged messages")
        assert recorder.stop() == 0
    assert (code, found["verdict"]) == (1, "degraded")
    decoded = found["sources"]["scanner/left"]["decoded"]
    assert decoded["gaps"] == 3 * round(decoded["gaps"] / 3) > 0
    assert decoded["gaps"] <= 3 * (decoded["seconds"] + 1)
    rover = found["sources"]["gnss/rover"]["decoded"]
    assert rover["bad"] == pytest.approx(rover["messages"], abs=2)
    troubles = "; ".join(found["troubles"])
    assert f"{decoded['gaps']} missing in its sequence" in troubles
    assert "messages damaged" in troubles


@pytest.mark.slow
def test_a_device_inside_a_stream_is_decoded_from_it(tmp_path: Path, logs: Path) -> None:
    """It has no units and no status of its own; its parser receives the stream's bytes."""
    data = gzip.decompress(CAPTURE.read_bytes())[:200_000]
    config = session_table(logs) + ROVER.replace("nmea", "novatel")
    config += '[imu.main]\ntransport = "gnss:rover"\nprotocol = "novatel"\n'
    with (
        serial_port(lambda number: data[number * 1500 : (number + 1) * 1500]) as path,
        Recorder(tmp_path, config.format(path=path)) as recorder,
    ):
        recorder.wait_said("device_opened")
        time.sleep(4.0)
        found: dict[str, Any] = {}

        def is_decoded() -> bool:  # on a busy machine this may skip some seconds
            found.update(once(logs)[1])
            return "decoded" in found["sources"]["imu/main"]

        wait_until(is_decoded, "messages of the inertial unit in the monitor's line")
        assert recorder.stop() == 0
    main = found["sources"]["imu/main"]
    assert main["state"] == "in gnss/rover"
    assert main["units"] == 0
    assert main["decoded"]["messages"] > 10
    assert not any("imu/main" in trouble for trouble in found["troubles"])


@pytest.mark.slow
def test_silent_and_absent_sources_degrade_the_verdict(tmp_path: Path, logs: Path) -> None:
    config = session_table(logs) + scanner(free_udp_port()) + ROVER.format(path=tmp_path / "nothing")
    with Recorder(tmp_path, config) as recorder:
        recorder.wait_said("scanner/left silent")
        said: list[subprocess.CompletedProcess[str]] = []

        def is_said() -> bool:
            said.append(swath("monitor", "--once", str(logs)))
            return "gnss/rover absent" in said[-1].stdout and "scanner/left no data yet" in said[-1].stdout

        wait_until(is_said, "what does not come, in the monitor's line")
        assert recorder.stop() == 0
    assert said[-1].returncode == 1
    assert said[-1].stdout.startswith("DEGRADED: recording ")


@pytest.mark.slow
def test_without_a_recording_monitor_exits_with_2_and_gives_the_reason(tmp_path: Path, logs: Path) -> None:
    logs.mkdir()
    run = swath("monitor", "--once", str(logs))
    assert (run.returncode, run.stdout) == (2, f"NOT RECORDING: no recording in {logs}\n")
    with Recorder(tmp_path, session_table(logs)) as recorder:
        sign = (logs / "recording.json").read_text()
        assert recorder.stop() == 0
    code, found = once(logs)
    assert (code, found["verdict"]) == (2, "not recording")
    assert "last event: session_ended" in found["sentence"]
    (logs / "recording.json").write_text(sign)  # as for a moment after a part is complete
    code, found = once(logs)
    assert (code, found["verdict"]) == (2, "not recording")
    assert "is complete, and no other part has begun" in found["sentence"]
    with Recorder(tmp_path / "again", session_table(logs)) as recorder:
        time.sleep(1.0)
        recorder.kill()
    code, found = once(logs)
    assert code == 2
    assert "has stopped without completing the log" in found["sentence"]


@pytest.mark.slow
def test_a_recorder_stopped_at_the_reserve_is_not_recording(tmp_path: Path) -> None:
    """A note waits until there is space, and a new part is refused."""
    logs = tmp_path / "disk/logs"
    with (
        disk_of(tmp_path / "disk", 24) as disk,
        Recorder(tmp_path / "rig", session_table(logs, reserve_mb=8)) as recorder,
    ):
        time.sleep(1.5)
        (disk / "filler").write_bytes(bytes(18 << 20))
        recorder.wait_said("disk_reserve")
        code, found = once(logs)
        note, split = swath("mark", "while it is full", str(logs)), swath("split", str(logs))
        (disk / "filler").unlink()
        recorder.wait_said("recording_resumed")
        again, _ = once_when(logs, lambda found: found["verdict"] == "recording", "recording again")
        assert recorder.stop() == 0
        notes = [event["text"] for event in read_log(logs).events("mark")]
    assert (code, again) == (2, 0)
    assert "last event: disk_reserve: " in found["sentence"]
    assert (note.returncode, split.returncode) == (1, 1)
    assert "the note is written when it resumes" in note.stderr
    assert "no recording is running" in split.stderr
    assert notes == ["while it is full"]


@pytest.mark.slow
def test_a_stuck_writer_is_not_recording(tmp_path: Path, logs: Path) -> None:
    with Recorder(tmp_path, session_table(logs)) as recorder:
        time.sleep(1.5)
        recorder.process.send_signal(signal.SIGSTOP)
        time.sleep(6.0)
        code, found = once(logs)
        recorder.process.send_signal(signal.SIGCONT)
        assert recorder.stop() == 0
    assert code == 2
    assert "no data were written for" in found["sentence"]


@pytest.mark.long
def test_the_log_of_another_computer_is_judged_by_its_growth(
    tmp_path: Path, logs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """This is the case over a network: clocks differ, and locks are not visible."""
    monkeypatch.setenv("SWATH_BOOT_ID", str(uuid.UUID(int=7)))
    port = free_udp_port()
    with Recorder(tmp_path, session_table(logs) + scanner(port)) as recorder, srep_sender(port, 100.0):
        monkeypatch.delenv("SWATH_BOOT_ID")
        recorder.wait_said("device_opened")
        time.sleep(2.5)
        monitor = Looking(logs)
        monitor.poll()
        assert monitor.snapshot()["verdict"] == "not recording"
        assert monitor.is_undecided
        time.sleep(1.0)
        monitor.poll()
        found = monitor.snapshot()
        assert not monitor.is_undecided
        assert found["verdict"] == "recording"
        assert found["sources"]["scanner/left"]["age_s"] < 1.0
        recorder.kill()
        time.sleep(5.5)
        monitor.poll()
        time.sleep(0.1)
    found = monitor.snapshot()
    monitor.close()
    assert (found["verdict"], found["sentence"][:33]) == ("not recording", "NOT RECORDING: no data were writt")


@pytest.mark.slow
def test_after_a_power_cut_and_restart_the_old_log_is_not_recording(tmp_path: Path, logs: Path) -> None:
    """The sign of the current recording outlives the recorder; a recorder of another boot has no visible lock."""
    with Recorder(tmp_path, session_table(logs)) as recorder:
        recorder.wait_said("session_started")
        time.sleep(1.5)
        recorder.kill()
    sign = logs / "recording.json"
    sign.write_text(sign.read_text().replace(read_boot_id(), str(uuid.UUID(int=7))))
    code, found = once(logs)
    assert code == 2
    assert found["sentence"].startswith("NOT RECORDING: ")
    assert "(of another computer or before a restart) has not grown for 5 s" in found["sentence"]


@pytest.mark.slow
def test_after_a_kill_the_sources_are_stale(tmp_path: Path, logs: Path) -> None:
    port = free_udp_port()
    monitor = Looking(logs)
    with Recorder(tmp_path, session_table(logs) + scanner(port)) as recorder, srep_sender(port, 100.0):
        recorder.wait_said("device_opened")

        def receives() -> bool:
            monitor.poll()
            return bool(monitor.snapshot()["sources"].get("scanner/left", {}).get("state") == "receiving")

        wait_until(receives, "the source is received")
        recorder.kill()
    monitor.poll()
    found = monitor.snapshot()
    monitor.close()
    assert found["verdict"] == "not recording"
    left = found["sources"]["scanner/left"]
    assert (left["state"], left["rate_hz"], "time_state" in left) == ("stale", None, False)
    written = io.StringIO()
    Console(file=written, width=100).print(page(found))
    assert "stale" in written.getvalue()
    assert "receiving" not in written.getvalue()


def test_the_room_left_goes_by_the_highest_rate_of_the_last_half_hour() -> None:
    growth = Growth()
    assert growth.highest_bytes_per_s() == 0.0
    second_ns = 1_000_000_000
    for second in range(100):  # 2 MB/s for ten seconds, then a slow stream
        growth.add((1_000_000 + second) * second_ns, 2_000_000 if 20 <= second < 30 else 1000)
    assert growth.highest_bytes_per_s() == 2_000_000
    for second in range(100, 1790):
        growth.add((1_000_000 + second) * second_ns, 1000)
    assert growth.highest_bytes_per_s() == 2_000_000
    for second in range(1790, 1900):
        growth.add((1_000_000 + second) * second_ns, 1000)
    assert growth.highest_bytes_per_s() == 1000


def test_the_growth_of_a_log_is_that_of_its_chunks(tmp_path: Path) -> None:
    """Read from the end or from the beginning, each chunk counts once."""
    path = tmp_path / f"{INFO.session_id}_0.mcap"
    write_part(path)
    counted = []
    for read in (PartFollower.batches, lambda part: part.tail(0.1), lambda part: part.read_growth() or ()):
        follower = PartFollower(path)
        list(read(follower))
        counted.append(dict(follower.growth._bytes))
        follower.close()
    assert counted[0] == counted[1] == counted[2]
    assert 0.5 < sum(counted[0].values()) / path.stat().st_size <= 1.0


@pytest.mark.parametrize("seed", range(40))
def test_garbage_in_a_log_never_raises(tmp_path: Path, seed: int) -> None:
    path = tmp_path / f"{INFO.session_id}_0.mcap"
    write_part(path)
    data = np.frombuffer(path.read_bytes(), np.uint8).copy()
    random = np.random.default_rng(seed)
    places = random.integers(600, len(data), random.integers(1, 200))
    data[places] = random.integers(0, 256, len(places))
    path.write_bytes(data[: random.integers(len(data) // 2, len(data) + 1)].tobytes())
    for read in (PartFollower.batches, lambda part: part.tail(0.1)):
        follower = PartFollower(path)
        assert sum(len(batch.units) for batch in read(follower)) <= 60 * 21 + 6
        follower.close()


def units_of(follower: LogFollower) -> list[int]:
    return [
        int.from_bytes(row[:8].tobytes(), "little")
        for batch in follower.poll()
        if batch.channel.topic.endswith("/raw")
        for row in batch.units
    ]


@pytest.mark.slow
def test_monitor_follows_parts_a_kill_and_a_restart(tmp_path: Path, logs: Path) -> None:
    """The follower reads exactly what is in the files, each unit once, in order."""
    numbers = Numbers(free_udp_port())
    config = session_table(logs) + scanner(numbers.port)
    follower = LogFollower(logs, tail_s=60.0)
    seen = units_of(follower)
    with Recorder(tmp_path, config) as recorder:
        recorder.wait_said("device_opened")
        for part in range(3):
            for _ in range(10):
                numbers.send(20, 0.001)
                seen += units_of(follower)
            recorder.process.send_signal(signal.SIGHUP)
            wait_until(lambda part=part: len(list(logs.glob("*.mcap"))) == part + 2, "next part")  # type: ignore[misc]
        numbers.send(50, 0.001)

        def all_is_seen() -> bool:
            seen.extend(units_of(follower))
            return len(seen) == numbers.sent

        wait_until(all_is_seen, "all that was sent, in the files")
        recorder.kill()
    with Recorder(tmp_path / "again", config) as recorder:
        recorder.wait_said("device_opened")
        numbers.send(50, 0.001)
        time.sleep(1.0)
        for _ in range(4):
            seen += units_of(follower)
        recorder.wait_said("log_repaired")
        assert recorder.stop() == 0
    numbers.close()
    for _ in range(2):
        seen += units_of(follower)
    follower.close()
    recorded = [
        int.from_bytes(row[:8].tobytes(), "little")
        for session in open_logs([logs])
        for batch in session.batches(lambda topic: topic.endswith("/raw"))
        for row in batch.units
    ]
    assert seen == recorded
    assert len(seen) == numbers.sent == 700


def test_a_chunk_is_read_once_it_is_complete(tmp_path: Path) -> None:
    """A log that grows in odd pieces gives the same as when it is read at once."""
    whole, growing = tmp_path / f"{INFO.session_id}_0.mcap", tmp_path / "growing.mcap"
    write_part(whole)
    data = whole.read_bytes()
    (session,) = open_logs([whole])
    expected = [(batch.channel.topic, batch.units.tobytes()) for batch in session.batches()]
    growing.write_bytes(data[:2000])
    random = np.random.default_rng(1)
    follower = PartFollower(growing)
    found, at = [], 2000
    while at < len(data):
        step = int(random.integers(1, 4000))
        with growing.open("ab") as file:
            file.write(data[at : at + step])
        at += step
        found += [(batch.channel.topic, batch.units.tobytes()) for batch in follower.batches()]
    follower.close()
    assert found == expected
    assert (follower.ended, follower.damaged) == (True, 0)


def test_a_damaged_chunk_is_counted_and_the_next_one_read(tmp_path: Path) -> None:
    path = tmp_path / f"{INFO.session_id}_0.mcap"
    write_part(path)
    (session,) = open_logs([path])
    expected = sum(len(batch.units) for batch in session.batches())
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    follower = PartFollower(path)
    found = sum(len(batch.units) for batch in follower.batches())
    follower.close()
    assert follower.damaged == 1
    assert 0 < found < expected


def test_a_damaged_chunk_of_the_growing_log_degrades_the_verdict(tmp_path: Path) -> None:
    """Data that the disk lost since are missing as well; the next session begins without the fault."""
    path = tmp_path / f"{INFO.session_id}_0.mcap"
    write_part(path, finish=False)
    data = bytearray(path.read_bytes())
    data[len(data) * 3 // 4] ^= 1
    path.write_bytes(data[: len(data) // 2])
    sign = {"session_id": INFO.session_id, "part": 0, "path": path.name, "boot_id": "another"}
    (tmp_path / "recording.json").write_text(json.dumps(sign))
    monitor = Looking(tmp_path, decode=False)
    monitor.poll()
    path.write_bytes(data)
    monitor.poll()
    found = monitor.snapshot()
    assert (found["verdict"], found["damaged_chunks"]) == ("degraded", 1)
    assert "1 DAMAGED chunks in the log" in found["sentence"]
    other = replace(INFO, session_id="later-20261121T110000Z-ab12")
    later = PartWriter(tmp_path / f"{other.session_id}_0.mcap", other, 0)
    later.add_channel(1, SCANNER_CHANNEL)
    later.add(encode_block(1, 0, np.array([START_NS + 10**9]), np.zeros((1, 9), np.uint8)))
    later.flush()
    sign |= {"session_id": other.session_id, "path": later.path.name}
    (tmp_path / "recording.json").write_text(json.dumps(sign))
    for _ in range(3):
        monitor.poll()
    later.add(encode_block(1, 1, np.array([START_NS + 2 * 10**9]), np.zeros((1, 9), np.uint8)))
    later.flush()
    monitor.poll()
    found = monitor.snapshot()
    later.abandon()
    monitor.close()
    assert (found["session_id"], found["verdict"], found["damaged_chunks"]) == (other.session_id, "recording", 0)


class Costly(PacketParser):
    """A parser that takes 50 ms of processor for each batch."""

    def parse_units(self, host_time_ns: Int64Array, units: ByteRows) -> list[Record]:
        until_s = time.thread_time() + 0.05
        while time.thread_time() < until_s:
            pass
        return []


def test_an_expensive_parser_gets_only_a_share_of_the_time(tmp_path: Path) -> None:
    path = tmp_path / f"{INFO.session_id}_0.mcap"
    write_part(path)
    (session,) = open_logs([path])
    (batch, *_) = [batch for batch in session.batches() if batch.channel.topic == "/scanner/left/raw"]
    decoding = Decoding(Costly)
    began_s = time.thread_time()
    for second in range(200):
        batch.log_time_ns[:] = (1000 + second) * 1_000_000_000
        decoding.feed("scanner/left", batch)
    assert time.thread_time() - began_s < 2.0  # decoding everything would take 10 s
    assert 0.05 <= decoding.share < 0.2
    assert decoding.plain()["share"] == round(decoding.share, 3)


@pytest.mark.long
@pytest.mark.slow
def test_memory_is_bounded_and_processor_load_is_low(tmp_path: Path, logs: Path) -> None:
    """Memory stays constant over some 100 MB, and the processor time is too small to disturb the recorder."""
    port = free_udp_port()
    with Recorder(tmp_path, session_table(logs, split_size_mb=16) + scanner(port)) as recorder:
        recorder.wait_said("device_opened")
        command = [sys.executable, "-m", "swath.daemon.cli.main", "monitor", str(logs), "--json"]
        numbers = Numbers(port)
        with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as monitor:
            resident_kb, began_s = [], time.monotonic()
            while time.monotonic() - began_s < 10.0:
                numbers.send(80, 0.0)
                time.sleep(0.01)
                resident_kb.append(_resident_kb(monitor.pid))
            spent_s = _processor_s(monitor.pid)
            monitor.send_signal(signal.SIGINT)
            lines = monitor.communicate(timeout=HANGS_S)[0].splitlines()
        numbers.close()
        assert recorder.stop() == 0
    assert numbers.sent * 1206 > 40e6
    assert len(list(logs.glob("*.mcap"))) > 2
    quarter = len(resident_kb) // 4
    assert max(resident_kb[3 * quarter :]) - max(resident_kb[quarter : 2 * quarter]) < 20_000
    assert spent_s < 6.0
    last = json.loads(lines[-1])
    assert last["part"] > 0
    assert last["sources"]["scanner/left"]["units"] > 0


def _resident_kb(pid: int) -> int:
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGESIZE") // 1024


def _processor_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@pytest.mark.slow
def test_on_a_terminal_a_page_is_shown_until_ctrl_c_and_a_key_marks(tmp_path: Path, logs: Path) -> None:
    port = free_udp_port()
    main, secondary = pty.openpty()
    environment = os.environ | {"TERM": "xterm", "COLUMNS": "100", "LINES": "30"}
    with Recorder(tmp_path, session_table(logs) + scanner(port)) as recorder, srep_sender(port, 100.0):
        recorder.wait_said("device_opened")
        time.sleep(2.5)
        command = [sys.executable, "-m", "swath.daemon.cli.main", "monitor", str(logs)]
        process = subprocess.Popen(
            command, cwd=ROOT, stdin=secondary, stdout=secondary, stderr=subprocess.PIPE, env=environment
        )
        before = termios.tcgetattr(main)
        wanted = (b"GB free", b"scanner/left", b"receiving", b"session_started", b"h left at the highest")
        shown = b""
        deadline_s = time.monotonic() + HANGS_S
        while not all(words in shown for words in wanted) and time.monotonic() < deadline_s:
            shown += os.read(main, 65536)  # a page comes in pieces
        os.write(main, b"m")
        while (
            not all(words in shown for words in (b"marked at ", b"operator mark: ")) and time.monotonic() < deadline_s
        ):
            shown += os.read(main, 65536)
        process.send_signal(signal.SIGINT)
        with process:
            assert process.stderr is not None
            with process.stderr:
                assert process.stderr.read() == b""
            assert process.wait(HANGS_S) == 130
        assert termios.tcgetattr(main) == before
        os.close(secondary)
        assert recorder.stop() == 0
    os.close(main)
    for words in (*wanted, b"marked at ", b"operator mark: "):
        assert words in shown


@pytest.mark.parametrize("columns", [80, 120])
def test_the_page_fits_and_hides_no_number(tmp_path: Path, columns: int) -> None:
    monitor = Looking(tmp_path)
    monitor.poll()
    found = monitor.snapshot()
    lost = {"lost_kernel": 12, "lost_queue": 0, "lost_write": 34567}
    source = {"state": "receiving", "rate_hz": 20000.0, "bytes_per_s": 24e6, "age_s": 0.04, "lost": lost}
    source |= {"time_state": "HOLDOVER", "time_sigma_ns": 57_712.3}
    found["sources"] = {"scanner/left-front/aux": source}
    found["events"] = [{"time_ns": 0, "severity": "info", "source": "operator", "code": "mark", "text": "\x1b[2J[red]"}]
    written = io.StringIO()
    Console(file=written, width=columns).print(page(found))
    text = written.getvalue()
    assert max(map(len, text.splitlines())) <= columns
    for words in ("20,000.0", "12/0/34567", "57.7", "[red]"):
        assert words in text
    assert "\x1b" not in text
    assert "…" not in text


def test_sigma_is_shown_in_its_unit() -> None:
    assert time_text({"time_state": "LOCKED", "time_sigma_ns": 312.0}) == "LOCKED ±0.3 µs"
    assert time_text({"time_state": "COARSE", "time_sigma_ns": 289e6}) == "COARSE ±289 ms"
    assert time_text({"time_state": "NO_TIME", "time_sigma_ns": None}) == "NO_TIME"
    assert time_text({}) == ""
