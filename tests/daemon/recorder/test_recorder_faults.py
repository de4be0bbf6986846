"""Tests faults inflicted on a running recorder; afterwards every unit is accounted for."""

from __future__ import annotations

import itertools
import json
import os
import shutil
import signal
import socket
import subprocess
import threading
import time
import tty
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from swath.daemon.errors import UserError
from swath.daemon.log.directory import take_directory
from swath.daemon.log.reader import open_logs
from swath.daemon.log.wires import MAX_SENDERS
from swath.daemon.recorder.repair import MCAP_MAGIC, unfinished_logs
from tests.daemon.builders import Numbers, scanner, write_part
from tests.daemon.commands import swath
from tests.daemon.log_check import LogContent, check_status, official_counts, read_log
from tests.daemon.rig import HANGS_S, Recorder, free_udp_port, session_table, wait_until

SPECIAL = "tests.daemon.special_recorder"


@pytest.fixture
def numbers() -> Iterator[Numbers]:
    sender = Numbers(free_udp_port())
    yield sender
    sender.close()


def found(content: LogContent) -> list[int]:
    return [int.from_bytes(data[:8], "little") for _, data in content.units["scanner/left"]]


def last_status(content: LogContent, source: str = "scanner/left") -> dict[str, Any]:
    status: dict[str, Any] = content.messages[f"/status/{source}"][-1][1]
    return status


@pytest.mark.slow
def test_a_full_queue_is_counted_reported_and_survived(tmp_path: Path, logs: Path, numbers: Numbers) -> None:
    config = session_table(logs) + scanner(numbers.port)
    with Recorder(tmp_path, config, module=(SPECIAL, "small-queue")) as recorder:
        recorder.wait_said("device_opened")
        numbers.send(20)
        time.sleep(0.3)
        with recorder.stopped_thread("writer"):
            numbers.send(600, 0.001)
            recorder.wait_said("scanner/left queue_full")
            numbers.send(100, 0.001)
        time.sleep(1.5)
        numbers.send(50, 0.001)
        recorder.wait_said("scanner/left queue_drained")
        time.sleep(0.5)
        assert recorder.stop() == 0, recorder.stderr()
    content = read_log(logs)
    status = last_status(content)
    assert status["units"] == numbers.sent
    assert status["lost_queue"] > 0
    assert len(found(content)) == status["written"] == numbers.sent - status["lost_queue"]
    assert found(content)[-50:] == list(range(numbers.sent - 50, numbers.sent))
    assert len(content.events("queue_full")) == 1
    (drained,) = content.events("queue_drained")
    assert f" {status['lost_queue']} units" in drained["text"]
    assert max(value["queue_high_water"] for _, value in content.messages["/status/scanner/left"]) > 200_000
    assert not content.events("account_mismatch")


def test_kernel_drops_are_counted_exactly(tmp_path: Path, logs: Path, numbers: Numbers) -> None:
    config = session_table(logs) + scanner(numbers.port, "?buffer_mb=1")
    with Recorder(tmp_path, config) as recorder:
        recorder.wait_said("device_opened")
        numbers.send(100)
        time.sleep(0.3)
        recorder.process.send_signal(signal.SIGSTOP)
        numbers.send(4000)
        recorder.process.send_signal(signal.SIGCONT)
        recorder.wait_said("scanner/left lost_kernel")
        numbers.send(100, 0.001)
        assert recorder.stop() == 0
    content = read_log(logs)
    status = last_status(content)
    assert status["lost_kernel"] > 1000
    assert status["units"] == numbers.sent
    assert len(found(content)) == numbers.sent - status["lost_kernel"]
    assert found(content)[-100:] == list(range(numbers.sent - 100, numbers.sent))


def test_a_stall_within_the_buffer_loses_no_data(tmp_path: Path, logs: Path, numbers: Numbers) -> None:
    """The stall lasts for half of the granted buffer; the kernel charges 2304 bytes for a datagram of 1206."""
    config = session_table(logs) + scanner(numbers.port)
    with Recorder(tmp_path, config) as recorder:
        recorder.wait_said("device_opened")
        wait_until(lambda: read_log(logs).messages["/status/scanner/left"], "a first status in the log")
        granted = last_status(read_log(logs))["receive_buffer_bytes"]
        recorder.process.send_signal(signal.SIGSTOP)
        numbers.send(2 * granted // 2304 // 2)  # the kernel doubles what is asked for
        recorder.process.send_signal(signal.SIGCONT)
        assert recorder.stop() == 0
    content = read_log(logs)
    assert found(content) == list(range(numbers.sent))
    assert last_status(content)["lost_kernel"] == 0


def test_data_in_the_kernel_at_the_end_are_recorded(tmp_path: Path, logs: Path, numbers: Numbers) -> None:
    with Recorder(tmp_path, session_table(logs) + scanner(numbers.port)) as recorder:
        recorder.wait_said("device_opened")
        recorder.process.send_signal(signal.SIGSTOP)
        numbers.send(10_000)
        recorder.process.send_signal(signal.SIGTERM)
        recorder.process.send_signal(signal.SIGCONT)
        assert recorder.process.wait(HANGS_S) == 0
    content = read_log(logs)
    assert found(content) == list(range(10_000))
    assert last_status(content)["units"] == 10_000


@pytest.mark.slow
def test_part_changes_under_load_lose_and_reorder_no_data(tmp_path: Path, logs: Path, numbers: Numbers) -> None:
    config = session_table(logs, split_size_mb=1) + scanner(numbers.port)
    with Recorder(tmp_path, config) as recorder:
        recorder.wait_said("device_opened")
        for turn in range(4):
            numbers.send(800, 0.0005)
            recorder.process.send_signal(signal.SIGHUP)
            recorder.process.send_signal(signal.SIGHUP)
            wait_until(lambda turn=turn: len(list(logs.glob("*.mcap"))) > turn + 1, "a part more")  # type: ignore[misc]
        assert recorder.stop() == 0
    paths = sorted(logs.glob("*.mcap"), key=lambda path: int(path.stem.rsplit("_", 1)[1]))
    assert len(paths) >= 5
    content = read_log(*paths)
    assert found(content) == list(range(numbers.sent))
    assert last_status(content)["written"] == numbers.sent
    for path, following in itertools.pairwise(paths):
        event = read_events(path)[-1]
        assert (event["code"], event["text"]) == ("part_closed", following.name)
    assert sum(official_counts(path)["/scanner/left/raw"] for path in paths) == numbers.sent


def read_events(path: Path) -> list[dict[str, Any]]:
    """Return the events of one part."""
    content = LogContent()
    for session in open_logs([path]):
        for batch in session.batches():
            if batch.channel.topic == "/events":
                content.messages["/events"] += [(0, json.loads(row.tobytes())) for row in batch.units]
    return [value for _, value in content.messages["/events"]]


@pytest.mark.slow
def test_a_directory_removed_during_recording_is_made_again(tmp_path: Path, logs: Path, numbers: Numbers) -> None:
    with Recorder(tmp_path, session_table(logs) + scanner(numbers.port)) as recorder:
        recorder.wait_said("device_opened")
        numbers.send(100)
        time.sleep(1.2)
        shutil.rmtree(logs)
        recorder.wait_said("disk log_gone")
        recorder.wait_said("part_opened")
        before = numbers.sent
        numbers.send(100, 0.001)
        assert recorder.stop() == 0, recorder.stderr()
    (path,) = logs.glob("*.mcap")
    assert path.stem.endswith("_1")
    content = LogContent()
    for session in open_logs([path]):
        for batch in session.batches():
            if batch.channel.topic == "/scanner/left/raw":
                content.units["scanner/left"] += [(0, row.tobytes()) for row in batch.units]
    assert found(content) == list(range(before, numbers.sent))
    assert read_events(path)[0]["code"] in ("log_gone", "part_opened")


def test_logs_that_vanish_during_the_search_do_not_affect_the_recovery(tmp_path: Path) -> None:
    assert unfinished_logs(tmp_path / "gone") == []
    (tmp_path / "moved_0.mcap").symlink_to(tmp_path / "elsewhere.mcap")  # listed, and not there when it is opened
    write_part(tmp_path / "left_0.mcap", finish=False)
    (tmp_path / "whole_0.mcap").write_bytes(MCAP_MAGIC + b"and ended" + MCAP_MAGIC)
    assert unfinished_logs(tmp_path) == [tmp_path / "left_0.mcap"]


def test_the_remains_of_a_part_after_a_power_cut_are_not_recovered_at_every_start(tmp_path: Path) -> None:
    whole = tmp_path / "left_0.mcap"
    write_part(whole, finish=False, blocks=0)
    head = whole.read_bytes()
    assert unfinished_logs(tmp_path) == [whole]
    for number, left in enumerate((b"", head[:8], head[:60], bytes(len(head)))):
        (tmp_path / f"begun_{number}.mcap").write_bytes(left)
    assert unfinished_logs(tmp_path) == [whole]


@pytest.mark.slow
def test_lock_and_control_socket_are_restored_with_the_directory(tmp_path: Path, logs: Path) -> None:
    config = session_table(logs)
    with Recorder(tmp_path / "one", config) as recorder:
        recorder.wait_said("session_started")
        shutil.rmtree(logs)
        recorder.wait_said("part_opened")
        wait_until((logs / ".swath.control").is_socket, "the socket is back")
        assert swath("mark", "still here", str(logs)).returncode == 0
        with pytest.raises(UserError, match="another recorder is running there"):
            take_directory(logs)
        assert recorder.stop() == 0, recorder.stderr()
    assert not (logs / ".swath.control").exists()
    os.close(take_directory(logs))
    (path,) = logs.glob("*.mcap")
    assert "mark" in [event["code"] for event in read_events(path)]


def test_another_recorder_in_the_new_directory_is_reported_and_not_disturbed(tmp_path: Path, logs: Path) -> None:
    with Recorder(tmp_path, session_table(logs)) as recorder:
        recorder.wait_said("session_started")
        new = tmp_path / "new"
        lock = take_directory(new)
        (new / ".swath.control").touch()
        logs.rename(tmp_path / "old")
        new.rename(logs)
        recorder.wait_said("directory_unlocked")
        assert recorder.stop() == 0, recorder.stderr()
    with pytest.raises(UserError, match="another recorder is running there"):
        take_directory(logs)
    os.close(lock)
    assert (logs / ".swath.control").is_file()
    (path,) = logs.glob("*.mcap")
    assert "directory_unlocked" in [event["code"] for event in read_events(path)]


@pytest.mark.slow
def test_a_recorder_without_its_directory_does_not_notify_the_watchdog(
    tmp_path: Path, logs: Path, numbers: Numbers
) -> None:
    config = session_table(logs) + scanner(numbers.port)
    with Recorder(tmp_path, config, watchdog_s=1.0) as recorder:
        recorder.wait_said("device_opened")
        shutil.rmtree(logs)
        logs.write_text("in the way")
        recorder.wait_said("disk write_failed")
        wait_until(lambda: "NOT RECORDING" in recorder.notify.last("STATUS"), "said in STATUS")
        wait_until(lambda: "STUCK: writer" in recorder.notify.last("STATUS"), "the watchdog is not fed")
        logs.unlink()
        recorder.wait_said("disk recording_resumed")
        numbers.send(10)
        time.sleep(1.2)
        assert recorder.stop() == 0, recorder.stderr()
    (path,) = logs.glob("*.mcap")
    codes = [event["code"] for event in read_events(path)]
    assert "write_failed" in codes
    assert official_counts(path)["/scanner/left/raw"] == 10


def test_unknown_senders_on_the_port_share_one_channel(tmp_path: Path, logs: Path, numbers: Numbers) -> None:
    senders = MAX_SENDERS + 40
    with Recorder(tmp_path, session_table(logs) + scanner(numbers.port)) as recorder:
        recorder.wait_said("device_opened")
        for number in range(senders):
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
                sock.sendto(number.to_bytes(8, "little"), ("127.0.0.1", numbers.port))
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
            sock.sendto(b"", ("127.0.0.1", numbers.port))  # a datagram may be empty
            sock.sendto(bytes(65_507), ("127.0.0.1", numbers.port))  # or as long as UDP goes
        time.sleep(1.2)
        assert recorder.stop() == 0, recorder.stderr()
    content = read_log(logs)
    assert [len(data) for _, data in content.units["scanner/left"]][-2:] == [0, 65_507]
    assert last_status(content)["written"] == senders + 2
    assert len(content.events("many_senders")) == 1
    (session,) = open_logs([logs])
    channels = {
        (batch.channel_id, batch.channel.metadata.get("source_port"))
        for batch in session.batches()
        if batch.channel.topic == "/scanner/left/raw"
    }
    assert len(channels) == MAX_SENDERS + 1
    assert sum(port is None for _, port in channels) == 1


@pytest.mark.slow
def test_counters_continue_when_a_device_returns(tmp_path: Path, logs: Path) -> None:
    link = tmp_path / "rover"
    config = session_table(logs) + f'[gnss.rover]\ntransport = "serial:{link}"\nprotocol = "nmea"\n'
    sent = 0
    with Recorder(tmp_path, config) as recorder:
        for turn in range(2):
            master, slave = os.openpty()
            tty.setraw(slave)
            link.unlink(missing_ok=True)
            link.symlink_to(os.ttyname(slave))
            recorder.wait_said("gnss/rover device_opened", times=turn + 1)
            for _ in range(20):
                sent += os.write(master, b"$P" + bytes(30))
                time.sleep(0.01)
            time.sleep(1.3)
            os.close(slave)
            os.close(master)
            recorder.wait_said("gnss/rover device_lost", times=turn + 1)
        assert recorder.stop() == 0
    content = read_log(logs)
    status = last_status(content, "gnss/rover")
    assert status["bytes"] == len(content.data("gnss/rover")) == sent
    assert status["units"] == status["written"] == len(content.units["gnss/rover"])


def test_recording_begins_at_once_whatever_the_directory_contains(tmp_path: Path, logs: Path, numbers: Numbers) -> None:
    logs.mkdir()
    for number in range(5000):
        (logs / f"old-{number}.mcap").write_bytes(b"")
    with (logs / "crashed-20260101T000000Z-0000_0.mcap").open("wb") as file:
        file.write(b"\x89MCAP0\r\n")
        file.truncate(2 << 30)
    recorder = Recorder(tmp_path, session_table(logs) + scanner(numbers.port))
    with recorder:
        assert "recording test-" in recorder.notify.last("STATUS")
        assert "repair" not in recorder.stderr()  # READY came before any log was examined
        recorder.wait_said("scanner/left device_opened")
        numbers.send(500, 0.001)
        assert recorder.stop() == 0
    (path,) = logs.glob("test-*.mcap")
    assert found(read_log(path)) == list(range(500))


def test_stopping_during_the_start_leaves_no_unfinished_file(tmp_path: Path, logs: Path, numbers: Numbers) -> None:
    recorder = Recorder(tmp_path, session_table(logs) + scanner(numbers.port))
    wait_until(lambda: list(logs.glob("*.mcap")), "the first part")
    assert recorder.stop() == 0, recorder.stderr()
    recorder.notify.close()
    (path,) = logs.glob("*.mcap")
    assert [event["code"] for event in read_events(path)][-1] == "session_ended"
    assert official_counts(path)["/events"] >= 2
    assert not (logs / "recording.json").exists()


def test_a_restart_within_the_same_second_takes_another_name(tmp_path: Path, logs: Path, numbers: Numbers) -> None:
    config = session_table(logs) + scanner(numbers.port)
    for turn in range(2):
        with Recorder(tmp_path / str(turn), config) as recorder:
            recorder.kill()
    with Recorder(tmp_path / "last", config) as recorder:
        assert recorder.stop() == 0
    assert len({path.stem.rsplit("_", 1)[0] for path in logs.glob("test*_0.mcap")}) == 3


@pytest.mark.slow
def test_a_failing_writer_ends_the_process(tmp_path: Path, logs: Path, numbers: Numbers) -> None:
    config = session_table(logs) + scanner(numbers.port)
    with Recorder(tmp_path, config, module=(SPECIAL, "broken-writer")) as recorder:
        assert recorder.process.wait(HANGS_S) == 1
        assert "the writer failed: RuntimeError: a defect" in recorder.stderr()


@pytest.mark.slow
@pytest.mark.parametrize("watchdog_s", [None, 2.0])
def test_a_failing_receiver_ends_the_service_or_leaves_the_others_recording(
    tmp_path: Path, logs: Path, numbers: Numbers, watchdog_s: float | None
) -> None:
    """Under a service manager a new process begins at once; without one the others are still recorded."""
    config = session_table(logs) + scanner(numbers.port)
    with Recorder(tmp_path, config, watchdog_s=watchdog_s, module=(SPECIAL, "broken-receiver")) as recorder:
        recorder.wait_said("device_opened")
        numbers.send(1)
        recorder.wait_said("scanner/left receiver_failed")
        if watchdog_s is None:
            said: list[subprocess.CompletedProcess[str]] = []

            def is_told() -> bool:
                said.append(swath("monitor", "--once", str(logs)))
                return "scanner/left stuck" in said[-1].stdout

            wait_until(is_told, "the monitor tells that a receiver is stuck")
            assert said[-1].returncode == 1
            assert recorder.process.poll() is None
            assert recorder.stop() == 1
        else:
            assert recorder.process.wait(HANGS_S) == 1
    (path,) = logs.glob("*.mcap")
    assert read_events(path)[-1]["code"] == "session_ended"


@pytest.mark.slow
def test_loss_counters_are_exact_under_simultaneous_faults(tmp_path: Path, logs: Path, numbers: Numbers) -> None:
    """Parts, stalls and a flood come together; every status of every part fulfils the equation when it is read."""
    config = session_table(logs) + scanner(numbers.port, "?buffer_mb=1")
    with Recorder(tmp_path, config, module=(SPECIAL, "small-queue")) as recorder:
        recorder.wait_said("device_opened")
        flood = threading.Thread(target=numbers.send, args=(20_000, 0.0001))
        flood.start()
        for _ in range(3):
            time.sleep(0.4)
            recorder.process.send_signal(signal.SIGSTOP)
            time.sleep(0.3)
            recorder.process.send_signal(signal.SIGCONT)
            recorder.process.send_signal(signal.SIGHUP)
        flood.join()
        assert recorder.stop() == 0
    content = read_log(logs)
    status = last_status(content)
    assert status["units"] == numbers.sent
    assert found(content) == sorted(set(found(content)))
    assert not content.events("account_mismatch")
    check_status("/status/scanner/left", status, Counter({"scanner/left": len(found(content))}))
