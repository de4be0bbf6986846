"""Tests that each check of the soak test can fail."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from benchmarks.soak.__main__ import Sample, Soak, problems
from benchmarks.soak.sensors import Pulse, Receiver


@pytest.fixture
def good(tmp_path: Path) -> Iterator[Soak]:
    """Return a run without problems."""
    soak = Soak(tmp_path, 10.0, 0.1, keep=False)
    soak.exit_status = 0
    for number, sensor in enumerate(soak.sensors, start=1000):
        sensor.sent, sensor.bytes = number, 50 * number
        soak.found.units[sensor.source], soak.found.bytes[sensor.source] = number, 50 * number
        soak.found.status[sensor.source] = {"written": number, "bytes": 50 * number, "time_state": "LOCKED"}
    soak.found.events = [{"code": "session_started"}, {"code": "part_closed"}]
    soak.samples = [Sample(float(at), 45.0 + at % 3, 32 + at % 2) for at in range(600)]
    soak.ages = [(float(at), 0.25 + 0.01 * (at % 5)) for at in range(600)]
    yield soak
    for sensor in soak.sensors:
        sensor.close()
        if isinstance(sensor, (Receiver, Pulse)):
            sensor.unplug()


def test_a_good_run_has_no_problems(good: Soak) -> None:
    assert problems(good) == []


def lose_a_frame(soak: Soak) -> None:
    soak.found.units["imu/main"] -= 1


def lose_a_byte(soak: Soak) -> None:
    soak.found.bytes["gnss/base"] -= 1


def tell_more_than_there_is(soak: Soak) -> None:
    soak.found.status["scanner/left"]["written"] += 1


def say_something(soak: Soak) -> None:
    soak.found.events.append({"code": "silent"})


def lose_time(soak: Soak) -> None:
    soak.found.status["gnss/rover"]["time_state"] = "HOLDOVER"


def leak_memory(soak: Soak) -> None:
    for sample in soak.samples:
        sample.rss_mb += 0.025 * sample.seconds


def leak_files(soak: Soak) -> None:
    for sample in soak.samples:
        sample.descriptors += int(sample.seconds / 100)


def fall_behind(soak: Soak) -> None:
    soak.ages = [(at, age * (1.0 + at / 500.0)) for at, age in soak.ages]


def see_no_chunk(soak: Soak) -> None:
    soak.ages = []


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (lose_a_frame, "imu/main: 1003 sent, 1003 told, 1002 in the log"),
        (lose_a_byte, "gnss/base: 50100 sent, 50100 told, 50099 in the log"),
        (tell_more_than_there_is, "scanner/left: 1005 sent, 1006 told"),
        (say_something, "event: {'code': 'silent'}"),
        (lose_time, "gnss/rover is HOLDOVER at the end"),
        (leak_memory, "memory grew by 4."),
        (leak_files, "open files grew"),
        (fall_behind, "latency grew, or was not seen: ['0."),
        (see_no_chunk, "latency grew, or was not seen: []"),
    ],
)
def test_each_check_can_fail(good: Soak, spoil: Callable[[Soak], None], told: str) -> None:
    spoil(good)
    (line,) = problems(good)
    assert told in line
