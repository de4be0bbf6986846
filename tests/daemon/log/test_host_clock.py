"""Tests that kernel stamps become host time correctly, whatever the wall clock does."""

from __future__ import annotations

import time

import numpy as np
import pytest

from swath.daemon.log.host_clock import (
    STA_UNSYNC,
    ClockDiscipline,
    ClockPair,
    HostClock,
    StampConverter,
    read_clock_discipline,
    read_clock_pair,
    read_clock_sample,
)

REALTIME_0 = 1_800_000_000_000_000_000
MONOTONIC_0 = 5_000_000_000_000
SECOND = 1_000_000_000
HOUR = 3600 * SECOND


def pair(seconds: float, step_ns: int = 0) -> ClockPair:
    """Return the clocks some seconds after the start, with the wall clock stepped by ``step_ns``."""
    elapsed = round(seconds * SECOND)
    return ClockPair(REALTIME_0 + elapsed + step_ns, MONOTONIC_0 + elapsed, 100)


def host(seconds: float) -> int:
    return REALTIME_0 + round(seconds * SECOND)


@pytest.fixture
def converter(monkeypatch: pytest.MonkeyPatch) -> StampConverter:
    monkeypatch.setattr(time, "monotonic_ns", lambda: MONOTONIC_0)
    return StampConverter(HostClock(pair(0)))


def test_timestamps_without_a_step_are_host_time(converter: StampConverter) -> None:
    stamps = np.array([host(0.9), host(0.95)], dtype=np.int64)
    assert converter.convert_at(stamps, 2, pair(1.0)).tolist() == [host(0.9), host(0.95)]
    assert converter.ambiguous == 0


@pytest.mark.parametrize("step_ns", [HOUR, -HOUR, 60_000, -60_000])
def test_a_batch_across_a_step_uses_both_offsets(converter: StampConverter, step_ns: int) -> None:
    converter.convert_at(None, 1, pair(1.0))
    before = np.array([host(1.2)], dtype=np.int64)  # stamped before the step, read after it
    after = np.array([host(1.4) + step_ns], dtype=np.int64)
    times = converter.convert_at(np.concatenate([before, after]), 2, pair(1.5, step_ns))
    if abs(step_ns) == HOUR:
        assert times.tolist() == [host(1.2), host(1.4)]
        assert converter.ambiguous == 0
    else:
        # within half a second, 60 µs fit both ways: the read time is used and counted.
        assert times.tolist() == [host(1.5), host(1.5)]
        assert converter.ambiguous == 2
    later = np.array([host(1.7) + step_ns], dtype=np.int64)
    assert converter.convert_at(later, 1, pair(1.8, step_ns)).tolist() == [host(1.7)]


def test_a_timestamp_that_fits_neither_offset_uses_the_read_time(converter: StampConverter) -> None:
    converter.convert_at(None, 1, pair(1.0))
    stale = np.array([host(-600)], dtype=np.int64)
    assert converter.convert_at(stale, 1, pair(1.5, HOUR)).tolist() == [host(1.5)]
    assert converter.ambiguous == 1


@pytest.mark.parametrize("step_ns", [HOUR, -HOUR, SECOND, -SECOND])
def test_a_unit_between_a_reading_and_the_previous_batch_is_timed(converter: StampConverter, step_ns: int) -> None:
    converter.convert_at(None, 1, pair(1.0))
    came = np.array([host(0.98)], dtype=np.int64)  # the thread was delayed between its read and the clocks
    assert converter.convert_at(came, 1, pair(1.5, step_ns)).tolist() == [host(0.98)]
    assert converter.ambiguous == 0


def test_a_wide_bracket_is_not_taken_for_a_step(converter: StampConverter) -> None:
    wobble = ClockPair(REALTIME_0 + SECOND + 90_000, MONOTONIC_0 + SECOND, 200_000)
    stamps = np.array([host(0.9)], dtype=np.int64)
    assert converter.convert_at(stamps, 1, wobble).tolist() == [host(0.9)]
    assert converter.ambiguous == 0


def test_a_timestamp_of_a_clock_stepped_on_and_back_uses_the_read_time(converter: StampConverter) -> None:
    """Both steps lie between two readings: no step is seen, but no unit is dated an hour after it was read."""
    stamps = np.array([host(0.9), host(0.95) + HOUR], dtype=np.int64)
    assert converter.convert_at(stamps, 2, pair(1.0)).tolist() == [host(0.9), host(1.0)]
    assert converter.ambiguous == 1


def test_units_without_a_stamp_take_the_read_time(converter: StampConverter) -> None:
    assert converter.convert_at(None, 2, pair(1.0)).tolist() == [host(1.0)] * 2
    mixed = np.array([0, host(1.9)], dtype=np.int64)
    assert converter.convert_at(mixed, 2, pair(2.0)).tolist() == [host(2.0), host(1.9)]


def test_clock_pair_is_tight_and_host_time_follows_monotonic() -> None:
    reading = read_clock_pair()
    assert 0 <= reading.width_ns < 50_000_000
    clock = HostClock(reading)
    assert clock.step_ns(reading) == 0
    before = time.monotonic_ns()
    assert before + clock.offset_ns <= clock.now_ns()


def test_clock_sample_has_the_three_clocks() -> None:
    clocks = {
        "realtime_ns": time.CLOCK_REALTIME,
        "monotonic_ns": time.CLOCK_MONOTONIC,
        "monotonic_raw_ns": time.CLOCK_MONOTONIC_RAW,
    }
    before = {name: time.clock_gettime_ns(clock) for name, clock in clocks.items()}
    sample = read_clock_sample(read_clock_discipline())
    after = {name: time.clock_gettime_ns(clock) for name, clock in clocks.items()}
    for name in clocks:
        assert before[name] <= int(sample[name]) <= after[name], name
    assert -500 <= sample["frequency_ppm"] <= 500


def test_a_clock_sample_gives_the_maximum_error_of_a_synchronised_wall_clock() -> None:
    assert read_clock_sample(ClockDiscipline(0.0, 0, 0.01))["max_error_s"] == 0.01
    assert "max_error_s" not in read_clock_sample(ClockDiscipline(0.0, STA_UNSYNC, 0.01))


def test_discipline_needs_sync_and_a_bounded_error() -> None:
    assert ClockDiscipline(0.0, 0, 0.01).disciplined
    assert not ClockDiscipline(0.0, STA_UNSYNC, 0.01).disciplined
    assert not ClockDiscipline(0.0, 0, 16.0).disciplined
    assert read_clock_discipline().max_error_s >= 0
