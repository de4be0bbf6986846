"""Tests SocketCAN: real vcan, two emulated controllers, and one whose errors are controlled."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from swath.daemon.log.parsers import stored_parsers
from swath.daemon.log.reader import open_logs
from swath.georef.records import ChunkBatch, ImuSamples
from tests.daemon.log_check import LogContent, read_log
from tests.vm.aboard_can import BUS_OFF, CONTROLLER, ERROR, RESTARTED, sample_frames
from tests.vm.crew import aboard, facts
from tests.vm.machine import MODULES

pytestmark = pytest.mark.alone

CLOCKS_NS = 50_000  # REALTIME and MONOTONIC are read one after the other, and only a change beyond this is a step
KVASER = ["-object", "can-bus,id=bus", *["-device", "kvaser_pci,canbus=bus"] * 2]


def last_status(content: LogContent, source: str) -> dict[str, int]:
    """Return the last status of a source."""
    status: dict[str, int] = content.messages[f"/status/{source}"][-1][1]
    return status


def units(content: LogContent, source: str) -> list[bytes]:
    return [data for _, data in content.units[source]]


def frames_of(samples: range, period_us: int) -> list[bytes]:
    return [frame for number in samples for frame in sample_frames(number, period_us)]


def assert_nothing_lost(content: LogContent, source: str) -> None:
    status = last_status(content, source)
    assert [status[key] for key in ("lost_kernel", "lost_queue", "lost_write")] == [0, 0, 0], status


def decoded(logs: Path, source: str) -> int:
    """Return the number of samples that the log's own parser finds, and check the number encoded in each."""
    (session,) = open_logs([logs])
    parsers, troubles = stored_parsers(session.attachments())
    assert troubles == []
    rows = []
    for batch in session.batches(lambda topic: topic == f"/{source}/raw"):
        found = parsers[source].feed_batch(ChunkBatch(source, batch.log_time_ns, batch.units))
        rows += [record.rows for record in found if isinstance(record, ImuSamples)]
    forces = np.concatenate(rows)["specific_force_b"]
    number = np.rint(forces[:, 0] / 0.005) + np.rint(forces[:, 1] / 0.005) * 32768
    assert np.array_equal(number, np.arange(len(number)))
    return len(number)


@pytest.mark.parametrize("seconds", [20, pytest.param(60, marks=pytest.mark.long)])
def test_can_at_1_khz_is_recorded_without_loss_and_with_kernel_timestamps(tmp_path: Path, seconds: int) -> None:
    finished = aboard(tmp_path, "aboard_can", "rate", seconds, seconds=seconds + 20)
    content = read_log(tmp_path / "logs")
    assert units(content, "imu/main") == frames_of(range(1000 * seconds), 1000), finished.output
    assert_nothing_lost(content, "imu/main")
    assert not content.events("receive_buffer_small")
    assert decoded(tmp_path / "logs", "imu/main") == 1000 * seconds
    (session,) = open_logs([tmp_path / "logs"])
    stamps = np.array([time_ns for time_ns, _ in content.units["imu/main"]])
    stamps -= session.info.realtime_ns - session.info.monotonic_ns
    before, after = np.fromfile(tmp_path / "sent", np.int64).reshape(-1, 2).T
    # the kernel stamps a frame during the call that sends it, but a read may collect frames for 16 ms
    outside = (stamps < before - CLOCKS_NS) | (stamps > after + CLOCKS_NS)
    assert not outside.any(), (np.count_nonzero(outside), (stamps - before)[outside][:9], (stamps - after)[outside][:9])
    assert last_status(content, "imu/main").get("stamp_ambiguous", 0) == 0


def test_asyncio_hears_every_sample_of_a_bus_with_kernel_timestamps(tmp_path: Path) -> None:
    samples = 5000
    finished = aboard(tmp_path, "aboard_can", "listen", samples, seconds=30)
    heard = facts(tmp_path, "heard")
    in_order = heard.pop("in_order")
    assert in_order, finished.output
    assert heard == {"units": 3 * samples, "lost_kernel": 0, "dropped": 0, "damaged": 0}
    late = facts(tmp_path, "late")
    assert -CLOCKS_NS < late["median_ns"] < 1_000_000, late  # a reading of many frames may come 16 ms later


def test_can_overruns_are_counted_exactly(tmp_path: Path) -> None:
    sent = 20_000  # the buffer has space for about 2700
    aboard(tmp_path, "aboard_can", "overrun", sent, seconds=25)
    content = read_log(tmp_path / "logs")
    numbers = [int.from_bytes(data[8:16], "little") for data in units(content, "imu/main") if data[:2] == b"\0\7"]
    after = [data for data in units(content, "imu/main") if data[:2] == b"\1\7"]
    status = last_status(content, "imu/main")
    assert status["lost_kernel"] > sent // 2, status
    assert numbers == list(range(len(numbers)))  # the buffer keeps the first frames
    assert len(after) == 100
    assert sent + 100 == status["written"] + status["lost_kernel"] == status["units"], status
    assert len(numbers) + status["lost_kernel"] == sent
    assert content.events("lost_kernel")


def test_can_fd_error_frames_and_an_interface_down_and_up_are_recorded(tmp_path: Path) -> None:
    aboard(tmp_path, "aboard_can", "trouble", seconds=35)
    content = read_log(tmp_path / "logs")
    sent = [bytes.fromhex(frame) for frame in facts(tmp_path, "sent")["frames"]]
    recorded = units(content, "imu/main")
    # the kernel marks FD frames (CANFD_FDF), whatever the sender wrote there
    assert [_without_flags(frame) for frame in recorded] == [_without_flags(frame) for frame in sent]
    assert [len(frame) for frame in recorded] == [len(frame) for frame in sent]
    assert sum(int.from_bytes(frame[:4], "little") == ERROR | BUS_OFF for frame in recorded) == 1
    assert_nothing_lost(content, "imu/main")
    assert len(content.events("can_bus_off")) == 1
    assert content.events("can_errors")
    assert len(content.events("device_opened")) == 3
    assert len(content.events("device_lost")) == 2


def _without_flags(frame: bytes) -> bytes:
    return frame if len(frame) == 16 else frame[:5] + b"\0" + frame[6:]


def test_a_can_controller_recovers_from_bus_off_by_itself_and_on_request(tmp_path: Path) -> None:
    aboard(tmp_path, "aboard_can", "bus_off", MODULES / "can_sim.ko", seconds=30)
    content = read_log(tmp_path / "logs")
    recorded = units(content, "imu/main")
    identifiers = [int.from_bytes(frame[:4], "little") for frame in recorded]
    data = [frame for frame, identifier in zip(recorded, identifiers, strict=True) if not identifier & ERROR]
    # frames sent while it was off do not appear
    assert [frame.hex() for frame in data] == facts(tmp_path, "sent")["frames"]
    told = [identifier & ~ERROR for identifier in identifiers if identifier & ERROR]
    assert told == [CONTROLLER, BUS_OFF, RESTARTED, BUS_OFF, RESTARTED]
    assert_nothing_lost(content, "imu/main")
    assert last_status(content, "imu/main")["bus_off"] == 2
    assert content.events("can_bus_off")
    assert len(content.events("device_lost")) == 1


def test_two_can_controllers_are_recorded_at_200_hz(tmp_path: Path) -> None:
    seconds = 10
    aboard(tmp_path, "aboard_can", "controllers", seconds, qemu=KVASER, seconds=2 * seconds + 30)
    content = read_log(tmp_path / "logs")
    count = 200 * seconds
    both = frames_of(range(2 * count), 5000)
    later = frames_of(range(2 * count, 2 * count + 200), 5000)
    for source in ("imu/left", "imu/right"):
        data = [frame for frame in units(content, source) if not frame[3] & 0x20]  # a controller may report its state
        assert data == both + later, (source, len(data))
        assert_nothing_lost(content, source)
    assert len(content.events("device_lost")) == 1
