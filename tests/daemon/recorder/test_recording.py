"""Tests ``swath run`` as a service runs it: real ports, real files, every byte, every state."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest

from tests.daemon.builders import ROVER_CONFIG, SREP, Pty, nmea_zda
from tests.daemon.log_check import official_counts, read_log
from tests.daemon.rig import HANGS_S, Recorder, free_udp_port, one_processor, session_table, wait_until


@pytest.fixture
def sender() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        yield sock


@pytest.mark.slow
def test_every_byte_of_every_wire_is_logged(tmp_path: Path, logs: Path, sender: socket.socket) -> None:
    port, link, fifo = free_udp_port(), tmp_path / "rover", tmp_path / "pps"
    os.mkfifo(fifo)
    pty = Pty(link)
    config = session_table(logs) + SREP.format(port=port) + ROVER_CONFIG.format(path=link, fifo=fifo)
    datagrams = [os.urandom(1206) for _ in range(500)] + [os.urandom(n) for n in (1, 7, 60000, 1206, 1206)]
    lines = []
    with Recorder(tmp_path, config) as recorder, fifo.open("w") as edges:
        recorder.wait_said("device_opened", times=3)
        with one_processor():
            for index, datagram in enumerate(datagrams):
                sender.sendto(datagram, ("127.0.0.1", port))
                if index % 50 == 0:
                    edges.write(f"{time.time_ns()} {index // 50 + 1}\n")
                    edges.flush()
                    lines.append(nmea_zda(index))
                    pty.write(lines[-1])
                    time.sleep(0.1)
        time.sleep(1.3)
        assert recorder.stop() == 0, recorder.stderr()
    pty.unplug()
    (path,) = logs.glob("*.mcap")
    content = read_log(path)
    assert [data for _, data in content.units["scanner/left"]] == datagrams
    assert content.data("gnss/rover") == b"".join(lines)
    assert [value["sequence"] for _, value in content.messages["/pps/main"]] == list(range(1, 12))
    last = content.messages["/status/scanner/left"][-1][1]
    assert (last["units"], last["written"], last["bytes"]) == (505, 505, sum(map(len, datagrams)))
    assert content.damage == 0
    counts = official_counts(path)
    assert counts["/scanner/left/raw"] == 505
    assert counts["/pps/main"] == 11
    assert not (logs / "recording.json").exists()


def test_units_have_the_kernel_timestamps(tmp_path: Path, logs: Path, sender: socket.socket) -> None:
    port = free_udp_port()
    with Recorder(tmp_path, session_table(logs) + SREP.format(port=port)) as recorder:
        recorder.wait_said("device_opened")
        sent = []
        for _ in range(20):
            sent.append(time.time_ns())
            sender.sendto(b"x" * 100, ("127.0.0.1", port))
            time.sleep(0.03)
        sent.append(time.time_ns())
        recorder.stop()
    times = [time_ns for time_ns, _ in read_log(logs).units["scanner/left"]]
    # loopback delivers within the send call, so a stamp lies between this send and the next
    spans = list(zip(times, pairwise(sent), strict=True))
    assert all(this - 1_000_000 <= time_ns < following for time_ns, (this, following) in spans), spans


@pytest.mark.slow
def test_absent_sensors_are_waited_for_and_never_restart_the_service(tmp_path: Path, logs: Path) -> None:
    config = session_table(logs) + ROVER_CONFIG.format(path=tmp_path / "nothing", fifo=tmp_path / "nofifo")
    limit_s = 2.0  # limit of systemd's watchdog, longer than a busy machine's short delays
    with Recorder(tmp_path, config, watchdog_s=limit_s) as recorder:
        fed = recorder.notify.count("WATCHDOG")
        started = time.monotonic()
        longest, last = 0.0, started
        while time.monotonic() - started < 5 * limit_s:
            recorder.notify.poll(0.05)
            if recorder.notify.count("WATCHDOG") > fed:
                fed = recorder.notify.count("WATCHDOG")
                longest, last = max(longest, time.monotonic() - last), time.monotonic()
        assert max(longest, time.monotonic() - last) < limit_s
        assert "gnss/rover absent" in recorder.notify.last("STATUS")
        assert recorder.stop() == 0
    assert {event["source"] for event in read_log(logs).events("device_absent")} == {"gnss/rover", "pps/main"}


@pytest.mark.slow
def test_a_blocked_writer_does_not_notify_the_watchdog(tmp_path: Path, logs: Path) -> None:
    config = session_table(logs) + SREP.format(port=free_udp_port())
    with Recorder(tmp_path, config, watchdog_s=1.0) as recorder:
        wait_until(lambda: recorder.notify.count("WATCHDOG") >= 3, "watchdog fed while all is well")
        with recorder.stopped_thread("writer"):
            time.sleep(3.0)  # the time allowed without progress; afterwards the watchdog must not be fed

            def is_silent() -> bool:
                fed = recorder.notify.count("WATCHDOG")
                time.sleep(2.0)
                return recorder.notify.count("WATCHDOG") == fed

            wait_until(is_silent, "the watchdog is not fed")
        assert "most recent call first" in recorder.stderr()  # where every thread stood
        recorder.kill()  # what the service manager does now
    with Recorder(tmp_path / "again", config) as restarted:
        wait_until(lambda: (logs / "recording.json").exists(), "recording again")
        restarted.wait_said("log_repaired")
        assert restarted.stop() == 0
    assert len(list(logs.glob("*.recovered.mcap"))) == 1


@pytest.mark.slow
def test_an_unread_journal_blocks_nothing(tmp_path: Path, logs: Path) -> None:
    """stderr is a full pipe from the start, so that no line of the recorder is accepted."""
    unread, full = os.pipe()
    os.set_blocking(full, False)
    with contextlib.suppress(BlockingIOError):
        while True:
            os.write(full, b"x" * 4096)
    os.set_blocking(full, True)
    port, absent = free_udp_port(), tmp_path / "nothing"
    config = session_table(logs) + SREP.format(port=port) + ROVER_CONFIG.format(path=absent, fifo=tmp_path / "nofifo")
    with (
        Recorder(tmp_path, config, watchdog_s=1.0, says_to=full) as recorder,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        wait_until(lambda: recorder.notify.count("WATCHDOG") >= 3, "watchdog fed")
        for number in range(200):
            sender.sendto(number.to_bytes(4, "big"), ("127.0.0.1", port))
        fed = recorder.notify.count("WATCHDOG")
        wait_until(lambda: recorder.notify.count("WATCHDOG") >= fed + 12, "watchdog fed for 3 s more")
        assert recorder.stop() == 0
    os.close(unread)
    os.close(full)
    content = read_log(logs)
    assert [int.from_bytes(data, "big") for _, data in content.units["scanner/left"]] == list(range(200))
    assert {event["source"] for event in content.events("device_absent")} == {"gnss/rover", "pps/main"}


@pytest.mark.slow
def test_a_serial_port_unplugged_and_plugged_in_again_is_reopened(tmp_path: Path, logs: Path) -> None:
    link, fifo = tmp_path / "rover", tmp_path / "pps"
    os.mkfifo(fifo)
    config = session_table(logs) + ROVER_CONFIG.format(path=link, fifo=fifo)
    with Recorder(tmp_path, config) as recorder:
        recorder.wait_said("gnss/rover device_absent")
        sent = []
        for turn in range(3):
            pty = Pty(link)
            recorder.wait_said("gnss/rover device_opened", times=turn + 1)
            for second in range(10):
                sent.append(nmea_zda(turn * 100 + second))
                pty.write(sent[-1])
            wait_until(lambda pty=pty: not _waiting_to_be_read(pty), "bytes taken")  # type: ignore[misc]
            time.sleep(0.3)
            pty.unplug()
            recorder.wait_said("gnss/rover device_lost", times=turn + 1)
        assert recorder.stop() == 0
    content = read_log(logs)
    assert content.data("gnss/rover") == b"".join(sent)
    assert len([event for event in content.events("device_lost") if event["source"] == "gnss/rover"]) == 3


def _waiting_to_be_read(pty: Pty) -> int:
    import fcntl
    import struct
    import termios

    return int(struct.unpack("i", fcntl.ioctl(pty.slave, termios.FIONREAD, b"\0" * 4))[0])


@pytest.mark.slow
def test_udp_silence_and_its_end_are_reported(tmp_path: Path, logs: Path, sender: socket.socket) -> None:
    port = free_udp_port()
    with Recorder(tmp_path, session_table(logs) + SREP.format(port=port)) as recorder:
        recorder.wait_said("device_opened")
        sender.sendto(b"first", ("127.0.0.1", port))
        recorder.wait_said("scanner/left silent")
        wait_until(lambda: "scanner/left silent" in recorder.notify.last("STATUS"), "silence in STATUS")
        sender.sendto(b"second", ("127.0.0.1", port))
        recorder.wait_said("scanner/left resumed")
        assert recorder.stop() == 0
    content = read_log(logs)
    assert [data for _, data in content.units["scanner/left"]] == [b"first", b"second"]
    states = [value["state"] for _, value in content.messages["/status/scanner/left"]]
    assert "silent" in states


def test_sighup_starts_a_new_part(tmp_path: Path, logs: Path, sender: socket.socket) -> None:
    port = free_udp_port()
    numbers = 0
    with Recorder(tmp_path, session_table(logs) + SREP.format(port=port)) as recorder:
        recorder.wait_said("device_opened")
        for part in range(3):
            for _ in range(200):
                sender.sendto(numbers.to_bytes(4, "little"), ("127.0.0.1", port))
                numbers += 1
                time.sleep(0.001)
            if part < 2:
                recorder.process.send_signal(signal.SIGHUP)
                wait_until(lambda part=part: len(list(logs.glob("*.mcap"))) == part + 2, "next part")  # type: ignore[misc]
        assert recorder.stop() == 0
    paths = sorted(logs.glob("*.mcap"))
    assert [path.stem.rsplit("_", 1)[1] for path in paths] == ["0", "1", "2"]
    content = read_log(*paths)
    assert [int.from_bytes(data, "little") for _, data in content.units["scanner/left"]] == list(range(numbers))
    closed = content.events("part_closed")
    assert [event["text"] for event in closed] == [path.name for path in paths[1:]]
    for path in paths[:-1]:
        assert read_log(path).messages["/events"][-1][1]["code"] == "part_closed"
    for path in paths:
        assert official_counts(path)["/scanner/left/raw"] > 0


def test_a_second_recorder_in_one_directory_is_refused(tmp_path: Path, logs: Path) -> None:
    config = session_table(logs) + SREP.format(port=free_udp_port())
    with Recorder(tmp_path, config):
        second = Recorder(tmp_path / "second", session_table(logs) + SREP.format(port=free_udp_port()))
        assert second.process.wait(HANGS_S) == 3
        assert second.stderr().strip().count("\n") == 0
        assert "another recorder" in second.stderr()
        second.notify.close()


def test_a_running_recorder_has_not_imported_processing_modules(
    tmp_path: Path, logs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPROFILEIMPORTTIME", "1")  # the running process lists every module it imports
    link, fifo = tmp_path / "rover", tmp_path / "pps"
    config = session_table(logs) + SREP.format(port=free_udp_port()) + ROVER_CONFIG.format(path=link, fifo=fifo)
    with Recorder(tmp_path, config) as recorder:
        assert recorder.stop() == 0
    lines = [line for line in recorder.stderr().splitlines() if line.startswith("import time:")]
    imported = {line.rsplit("|", 1)[1].strip() for line in lines}
    assert {"numpy", "swath.daemon", "swath.drivers", "swath.georef"} <= imported
    assert not imported & {"numba", "scipy", "pyproj", "laspy", "matplotlib", "swath.calib"}
