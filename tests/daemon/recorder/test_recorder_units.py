"""Tests the recorder's parts one by one, on real files and sockets, without its threads."""

from __future__ import annotations

import errno
import os
import resource
import socket
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from swath.daemon.log.block_queue import BlockQueue, QueueItem, SourceCount
from swath.daemon.log.channels import ChannelTable
from swath.daemon.log.events import Events, Severity
from swath.daemon.log.format import ChannelSpec, SessionInfo
from swath.daemon.log.host_clock import HostClock
from swath.daemon.log.mcap.encode import MESSAGE_HEADER_BYTES, EncodedBlock, encode_block
from swath.daemon.log.mcap.writer import PartWriter
from swath.daemon.log.parts import Attachment, Parts
from swath.daemon.log.wires import Wire
from swath.daemon.recorder.receivers import PpsReceiver, Receiver, Shared, UnitReceiver, WireTrouble
from swath.daemon.recorder.run import a_restart_helps_nobody, sentence, stuck_threads
from swath.daemon.recorder.service_manager import ServiceManager
from swath.daemon.recorder.writer import Recorder, RecorderSettings, WriterHealth, Writing
from swath.drivers.session import Session
from swath.drivers.transports.base import PpsSource, RawEdge, TransportCounters, UnitBlock
from swath.drivers.transports.serial_port import SerialTransport
from swath.drivers.transports.spec import parse_transport
from tests.daemon.builders import Pty
from tests.daemon.journal import journal_of
from tests.daemon.log_check import official_counts, read_log

SOURCE = "gnss/rover"
SPEC = ChannelSpec("/gnss/rover/raw", "x-swath-serial", {"protocol": "nmea"})


def block_of(channel_id: int, count: int, length: int = 100) -> EncodedBlock:
    return encode_block(channel_id, 0, np.arange(count, dtype=np.int64), np.zeros((count, length), np.uint8))


# --- the queue ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, 2, 300])
def test_messages_written_around_units_in_place_equal_copied_ones(count: int) -> None:
    units = np.random.default_rng(1).integers(0, 256, (count, 40), dtype=np.uint8)
    rows = np.full((count, MESSAGE_HEADER_BYTES + 40), 0xEE, np.uint8)
    rows[:, MESSAGE_HEADER_BYTES:] = units
    times = np.arange(count, dtype=np.int64) * 1000
    copied = encode_block(7, 4_294_967_200, times, units)
    in_place = encode_block(7, 4_294_967_200, times, rows[:, MESSAGE_HEADER_BYTES:], rows=rows)
    assert in_place.data.tobytes() == copied.data.tobytes()
    assert in_place.offsets.tolist() == copied.offsets.tolist()
    assert len(in_place.data) == len(copied.data) == count * (MESSAGE_HEADER_BYTES + 40)


def test_the_queue_is_bounded_for_data_and_not_for_events_and_counters() -> None:
    block = block_of(1, 10)
    queue = BlockQueue(int(2.5 * len(block.data)))
    assert [queue.put(QueueItem(SOURCE, block)) for _ in range(4)] == [True, True, False, False]
    assert queue.put(QueueItem(SOURCE, count=SourceCount(units=40)))
    assert queue.put(QueueItem("events", block), always=True)
    assert [item.source for item in queue.take_all()] == [SOURCE, SOURCE, SOURCE, "events"]
    assert queue.pop_high_water() == 3 * len(block.data)
    assert queue.pop_high_water() == 0
    assert queue.put(QueueItem(SOURCE, block))


# --- parts and the writer -------------------------------------------------------------------------------------------


@dataclass
class Bench:
    """A recorder without threads whose turns the test runs by hand."""

    logs: Path
    queue: BlockQueue
    events: Events
    parts: Parts
    recorder: Recorder
    channel_id: int
    units: int = 0

    def receive(self, count: int) -> None:
        self.units += count
        self.queue.put(QueueItem(SOURCE, block_of(self.channel_id, count), SourceCount(units=self.units)))

    def turn(self, *, second: bool = False) -> None:
        if second:
            self.recorder._status_due_s = 0.0
        self.recorder.turn()

    def end(self) -> None:
        self.recorder.stop.set()
        self.recorder.run()


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    clock, channels, queue = HostClock(), ChannelTable(), BlockQueue(1 << 20)
    events = Events(clock, queue, channels)
    info = SessionInfo("unit", "swath", "host", "boot", clock.realtime_ns, clock.monotonic_ns)
    parts = Parts(tmp_path / "logs", info, channels, [Attachment("config.toml", "application/toml", b"# x\n")], "auto")
    settings = RecorderSettings(1 << 30, 1800.0, 1.0, 0)
    recorder = Recorder(parts, settings, queue, channels, events, clock, lambda source: {})
    recorder.add_source(SOURCE)
    made = Bench(parts.directory, queue, events, parts, recorder, channels.add(SOURCE, SPEC))
    recorder.open_first()
    yield made
    if parts.current is not None:
        parts.current.close()


def test_a_failed_opening_leaves_no_file_and_recording_continues(
    bench: Bench, caplog: pytest.LogCaptureFixture
) -> None:
    sign = bench.logs / "recording.json"
    sign.unlink()
    (sign / "in the way").mkdir(parents=True)
    bench.receive(5)
    bench.recorder.new_part.set()
    bench.turn()
    assert [path.name for path in bench.logs.glob("*.mcap")] == ["unit_0.mcap"]
    assert bench.recorder.health.state is Writing.RECORDING
    assert journal_of(caplog)[-1].code == "split_failed"
    (sign / "in the way").rmdir()
    sign.rmdir()
    bench.receive(5)
    bench.recorder.new_part.set()
    bench.turn()
    bench.receive(5)
    bench.end()
    assert sorted(path.name for path in bench.logs.iterdir()) == ["unit_0.mcap", "unit_1.mcap"]
    content = read_log(bench.logs)
    assert len(content.units[SOURCE]) == 15
    assert [official_counts(bench.logs / f"unit_{part}.mcap")["/gnss/rover/raw"] for part in (0, 1)] == [10, 5]


def test_an_existing_file_is_never_written_to(bench: Bench) -> None:
    (bench.logs / "unit_1.mcap").write_bytes(b"somebody's")
    bench.recorder.new_part.set()
    bench.turn()
    bench.end()
    assert (bench.logs / "unit_1.mcap").read_bytes() == b"somebody's"
    assert read_log(bench.logs / "unit_0.mcap").events("part_closed")[0]["text"] == "unit_2.mcap"
    assert official_counts(bench.logs / "unit_2.mcap")["/events"] == 1


def test_a_part_without_any_event_still_ends_with_part_closed(bench: Bench) -> None:
    bench.receive(3)
    bench.recorder.new_part.set()
    bench.turn()
    bench.end()
    assert [value["code"] for _, value in read_log(bench.logs / "unit_0.mcap").messages["/events"]] == ["part_closed"]


def test_a_refused_chunk_is_counted_and_its_events_go_to_the_next_part(bench: Bench) -> None:
    bench.receive(10)
    bench.turn(second=True)
    bench.events.post(Severity.WARNING, SOURCE, "silent", "told while the disk fails")
    bench.receive(100)
    part = bench.parts.current
    assert part is not None
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (part.bytes_written + 10, limits[1]))
    try:
        bench.turn(second=True)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    health = bench.recorder.health
    assert health.state is Writing.FAILED
    assert os.strerror(errno.EFBIG) in health.reason
    assert not (bench.logs / "recording.json").exists()
    status_ns = health.status_ns
    bench.receive(20)
    bench.turn(second=True)
    assert health.status_ns == status_ns  # an error of the disk does not feed the watchdog
    assert health.statuses[SOURCE]["lost_write"] == 120
    bench.recorder._resume_after_s = 0.0
    bench.turn(second=True)
    bench.receive(7)
    bench.turn(second=True)
    bench.end()
    content = read_log(bench.logs)
    assert len(content.units[SOURCE]) == 17
    status = content.messages["/status/gnss/rover"][-1][1]
    assert (status["units"], status["written"], status["lost_write"]) == (137, 17, 120)
    codes = [value["code"] for _, value in content.messages["/events"]]
    assert codes == ["silent", "part_unfinished", "write_failed", "recording_resumed"]


def test_after_a_stall_one_status_holds_the_maxima_since_the_previous_one(bench: Bench) -> None:
    bench.recorder._status_due_s = time.monotonic() - 30.0
    bench.receive(5)
    bench.turn()
    bench.turn()
    bench.recorder._write_ms_max = 77.0
    bench.recorder._sync_ms_max = 88.0
    bench.turn(second=True)
    bench.end()
    statuses = [value for _, value in read_log(bench.logs).messages["/status/gnss/rover"]]
    assert len(statuses) == 3  # after the stall, the next, the last
    assert (statuses[1]["write_ms_max"], statuses[1]["sync_ms_max"]) == (77.0, 88.0)
    assert statuses[2]["write_ms_max"] < 77.0
    assert statuses[0]["queue_high_water"] > 500 > statuses[1]["queue_high_water"]


def test_an_abandoned_part_does_not_delete_a_file_that_replaced_it(tmp_path: Path) -> None:
    info = SessionInfo("unit", "swath", "host", "boot", 1, 1)
    writer = PartWriter(tmp_path / "a.mcap", info, 0)
    (tmp_path / "a.mcap").rename(tmp_path / "b.mcap")
    (tmp_path / "a.mcap").write_text("another's")
    assert not writer.stands_at(tmp_path / "a.mcap")
    writer.abandon()
    assert (tmp_path / "a.mcap").read_text() == "another's"
    assert (tmp_path / "b.mcap").exists()


# --- PPS ------------------------------------------------------------------------------------------------------------


class ScriptedPps(PpsSource):
    """A source of edges with the given sequence numbers, all at once."""

    def __init__(self, sequences: list[int]) -> None:
        self._sequences = sequences

    def open(self) -> None:
        """Do nothing, because there is no device to open."""

    def receive(self, timeout_s: float) -> list[RawEdge]:
        """Return all edges, once."""
        sequences, self._sequences = self._sequences, []
        return [RawEdge(time.time_ns(), sequence, "assert") for sequence in sequences]

    def close(self) -> None:
        """Do nothing, because there is no device to close."""


@pytest.mark.parametrize(("overwrites", "lost"), [(True, 4), (False, 0)])
def test_edges_overwritten_in_the_kernel_are_counted_as_lost_units(overwrites: bool, lost: int) -> None:
    clock, channels, queue = HostClock(), ChannelTable(), BlockQueue(1 << 20)
    shared = Shared(clock, queue, channels, Events(clock, queue, channels))
    openings = [ScriptedPps([7, 8, 11, 12, 15]), ScriptedPps([2, 3])]
    session = Session(lambda: openings.pop(0))
    seen: list[int] = []
    receiver = PpsReceiver("main", session, shared, lambda _, sequence: seen.append(sequence), overwrites=overwrites)
    receiver.receive_once()
    receiver.receive_once()
    session._release()
    session._open()  # what the device counted while it was away is no loss of the recorder
    receiver.receive_once()
    receiver.finish()
    assert seen == [7, 8, 11, 12, 15, 2, 3]
    last = [item.count for item in queue.take_all() if item.count is not None][-1]
    assert (last.units, last.lost_kernel) == (7 + lost, lost)


# --- serial bytes at the stop ---------------------------------------------------------------------------------------


def test_all_bytes_that_wait_in_a_serial_port_at_the_stop_are_taken(tmp_path: Path) -> None:
    """More of them than a read returns wait, and the time of a read does not tell when they came."""
    clock, channels, queue = HostClock(), ChannelTable(), BlockQueue(1 << 20)
    pty = Pty(tmp_path / "rover")
    session: Session[UnitBlock] = Session(lambda: SerialTransport(parse_transport(f"serial:{tmp_path / 'rover'}")))
    wire = Wire("gnss/rover", "/gnss/rover/raw", "x-swath-serial", "other", {"protocol": "nmea"})
    receiver = UnitReceiver(wire, session, Shared(clock, queue, channels, Events(clock, queue, channels)))
    receiver.receive_once()
    waiting = os.urandom(10_000)
    pty.write(waiting)
    receiver.finish()
    pty.unplug()
    last = [item.count for item in queue.take_all() if item.count is not None][-1]
    assert (last.bytes, last.units) == (len(waiting), 3)


# --- a wire's own trouble --------------------------------------------------------------------------------------------


def test_a_problem_is_reported_at_once_and_then_every_half_minute(caplog: pytest.LogCaptureFixture) -> None:
    clock, channels, queue = HostClock(), ChannelTable(), BlockQueue(1 << 20)
    events = Events(clock, queue, channels)
    now_s = 1000.0
    trouble = WireTrouble("imu/main", events, lambda: now_s)
    counters = TransportCounters(receive_buffer_bytes=1000)
    assert trouble.look(counters) == {}
    for _ in range(100):  # 100 s, ten error frames a second, one of them bus-off after a minute
        counters.error_frames += 10
        counters.bus_off += now_s == 1060.0
        assert trouble.look(counters)["error_frames"] == counters.error_frames
        now_s += 1.0
    now_s += 60.0
    trouble.look(counters)
    trouble.look(counters)
    told = [(event.code, event.severity, int(event.text.split()[0])) for event in journal_of(caplog)]
    errors = [("can_errors", Severity.WARNING, count) for count in (10, 300, 300, 300, 90)]
    assert told == [*errors[:2], ("can_bus_off", Severity.ERROR, 1), *errors[2:]]


# --- what people and the service manager are told -------------------------------------------------------------------


def health_of(**states: dict[str, object]) -> WriterHealth:
    whole = {"lost_kernel": 0, "lost_queue": 0, "lost_write": 0, "state": "receiving", "last_unit_age_s": 0.1}
    statuses = {name.replace("_", "/"): whole | state for name, state in states.items()}
    return WriterHealth(free_bytes=100_000_000_000, bytes_per_s=10_000_000.0, statuses=statuses)


def test_the_sentence_contains_what_an_operator_needs() -> None:
    assert sentence("s", 2, health_of(gnss_rover={}, scanner_left={})) == (
        "recording s part 2: all 2 sources deliver data; 100.0 GB free (2 h 46 min)"
    )
    text = sentence(
        "s",
        0,
        health_of(
            gnss_rover={"state": "silent", "last_unit_age_s": 12.4, "time_state": "HOLDOVER"},
            scanner_left={"lost_kernel": 3, "lost_queue": 4},
            imu_main={"state": "absent", "last_unit_age_s": None},
            imu_spare={"state": "silent", "last_unit_age_s": None},
        ),
    )
    assert "gnss/rover silent for 12 s, time HOLDOVER; scanner/left 7 units lost; imu/main absent" in text
    assert "imu/spare no data yet" in text
    stopped = WriterHealth(state=Writing.RESERVE, reason="3 MB free")
    assert sentence("s", 0, stopped) == "NOT RECORDING: 3 MB free"
    assert "starting" in sentence("s", 0, WriterHealth())


def test_the_remaining_time_ends_at_the_reserve(bench: Bench) -> None:
    settings = RecorderSettings(1 << 30, 1800.0, 1.0, 1000)
    channels, clock = ChannelTable(), HostClock()
    recorder = Recorder(bench.parts, settings, bench.queue, channels, bench.events, clock, lambda source: {})
    assert recorder.health.reserve_bytes == 1000
    health = health_of(gnss_rover={})
    health.reserve_bytes = 99_400_000_000
    assert sentence("s", 0, health).endswith("100.0 GB free (1 min)")
    health.reserve_bytes = 200_000_000_000
    assert sentence("s", 0, health).endswith("100.0 GB free (0 s)")


def test_a_device_that_opens_slowly_is_reported_and_causes_no_restart() -> None:
    """A caster's name that is looked up for a minute must not cost the scanner's data."""
    now_ns = 100_000_000_000
    opening = SimpleNamespace(source="corrections/base", opening=True, came_back_ns=now_ns - 60_000_000_000)
    hangs = SimpleNamespace(source="scanner/left", opening=False, came_back_ns=now_ns - 3_000_000_000)
    writer = WriterHealth(status_ns=now_ns)
    for receivers, names, helps_nobody in (([opening], ["corrections/base"], True), ([hangs], ["scanner/left"], False)):
        threads = cast("list[Receiver]", receivers)
        stuck = stuck_threads(threads, writer, now_ns)
        assert stuck == names
        assert a_restart_helps_nobody(stuck, threads) == helps_nobody
    threads = cast("list[Receiver]", [opening, hangs])
    assert not a_restart_helps_nobody(stuck_threads(threads, writer, now_ns), threads)
    assert not a_restart_helps_nobody(["writer"], threads)
    assert a_restart_helps_nobody([], threads)


def test_a_writer_without_a_recent_status_is_stuck() -> None:
    now_ns = 100_000_000_000
    assert stuck_threads([], WriterHealth(status_ns=now_ns - 2_900_000_000), now_ns) == []
    assert stuck_threads([], WriterHealth(status_ns=now_ns - 3_100_000_000), now_ns) == ["writer"]


@pytest.mark.parametrize("abstract", [False, True])
def test_the_service_manager_is_notified_on_a_path_and_on_an_abstract_socket(tmp_path: Path, abstract: bool) -> None:
    name = f"@swath-{os.getpid()}" if abstract else str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind("\0" + name[1:] if abstract else name)
        service = ServiceManager({"NOTIFY_SOCKET": name, "WATCHDOG_USEC": "2000000"})
        service.notify(READY="1", STATUS="two\nlines")
        assert manager.recv(1000) == b"READY=1\nSTATUS=two lines"
        assert service.watchdog_s == 2.0
        while True:  # a manager that does not read must not stop the recorder
            started = time.monotonic()
            service.notify(WATCHDOG="1")
            if time.monotonic() - started > 0.2:
                break
    service.notify(WATCHDOG="1")  # a manager that has gone must not stop the recorder either


def test_the_watchdog_of_another_process_is_ignored() -> None:
    environment = {"WATCHDOG_USEC": "2000000", "WATCHDOG_PID": "1"}
    assert ServiceManager(environment).watchdog_s is None
    assert ServiceManager({}).watchdog_s is None
    ServiceManager({}).notify(READY="1")
