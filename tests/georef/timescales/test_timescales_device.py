"""Tests device clocks: latched edges, UTC-hour stamps, arrivals; restarts, missing and spurious latches."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest

from swath.georef.arrays import BoolArray, FloatArray, Int64Array, StructArray
from swath.georef.records import DEVICE_CLOCK_DTYPE, NamesEdge, TimeMessage, TimeScale, TimeTag
from swath.georef.timescales import DeviceClock, PpsClock, TimeState
from tests.builders import NS, START_S, host_clock, host_ns
from tests.georef.clock_run import rms

POWER_ON_NS = 77_000_000_000  # device time at START_S
DEVICE_RATE = 1.0 - 41e-6


def device_ns(true_s: FloatArray | float) -> Int64Array:
    """Return device time, ns, of true seconds since START_S, in whole ticks of 100 ns."""
    ticks = np.rint((POWER_ON_NS + np.asarray(true_s, dtype=np.float64) * DEVICE_RATE * NS) / 100.0)
    return ticks.astype(np.int64) * 100


def test_an_edge_stamped_in_the_future_does_not_stop_the_clock() -> None:
    """One wrong entry of a FIFO, an hour ahead, is refused, and the edges that follow are accepted."""
    clock = host_clock(30)
    before = dict(clock.edges_refused)
    clock.add_edge(int(host_ns(3630.4)))
    for second in range(30, 45):
        clock.add_edge(int(host_ns(second)), second)
    status = clock.status(int(host_ns(45)))
    assert status.state is TimeState.LOCKED
    assert clock.edges_refused == before | {"off_prediction": 1}


def rows_of(
    true_s: FloatArray,
    latency_s: FloatArray | float = 0.0005,
    *,
    latched: bool = True,
    locked: int = -1,
) -> StructArray:
    """Return rows sent at true seconds and received with a latency; the latch is that of the last whole second."""
    rows = np.zeros(len(true_s), dtype=DEVICE_CLOCK_DTYPE)
    rows["host_time_ns"] = host_ns(true_s + latency_s)
    rows["device_time_ns"] = device_ns(true_s)
    rows["pps_time_ns"] = device_ns(np.floor(true_s)) if latched else -1
    rows["pps_count"] = np.floor(true_s).astype(np.int64) + 1 if latched else -1
    rows["locked"] = locked
    return rows


def errors_ns(clock: DeviceClock, true_s: FloatArray, host: Int64Array | None = None) -> FloatArray:
    """Return errors of device times of true seconds."""
    gps, sigma = clock.gps_from_device(device_ns(true_s), host)
    assert np.all(np.isfinite(sigma))
    return np.asarray((gps - START_S * NS) - np.rint(true_s * NS), dtype=np.float64)


def test_a_latched_device_is_accurate_to_its_ticks() -> None:
    """With ticks of 100 ns, times are within 0.3 µs, even if datagrams are up to 0.25 s late."""
    random = np.random.default_rng(1)
    clock = DeviceClock(host_clock(120))
    times = np.arange(20.003, 110.0, 0.02)
    clock.add(rows_of(times, random.uniform(0.0, 0.25, len(times))))
    assert np.max(np.abs(errors_ns(clock, np.arange(21.0, 109.0, 0.0371)))) < 300
    assert abs(errors_ns(clock, np.array([112.0]))[0]) < 2_000
    status = clock.status()
    assert status.latched
    assert status.drift_ppm == pytest.approx(-41.0, abs=0.1)
    assert (status.edges_used, status.segments) == (90, 1)


def test_batches_of_any_size_give_the_same_clock() -> None:
    host = host_clock(60)
    times = np.arange(20.003, 50.0, 0.02)
    whole, parts = DeviceClock(host), DeviceClock(host)
    rows = rows_of(times)
    whole.add(rows)
    for start in range(0, len(rows), 37):
        parts.add(rows[start : start + 37])
    asked = device_ns(np.arange(20.0, 51.0, 0.1))
    np.testing.assert_array_equal(whole.gps_from_device(asked)[0], parts.gps_from_device(asked)[0])


def test_stalled_datagrams_do_not_shift_the_second() -> None:
    """First datagrams of a second that come 1.0 s late name the next edge, but the others outvote them."""
    times = np.arange(20.003, 60.0, 0.02)
    latency = np.where((times % 1.0 < 0.02) & (np.floor(times) % 8 == 3), 1.0, 0.001)
    clock = DeviceClock(host_clock(120))
    clock.add(rows_of(times, latency))
    assert np.max(np.abs(errors_ns(clock, np.arange(21.0, 59.0, 0.1)))) < 300


def test_latches_more_than_three_tenths_of_a_second_off_are_not_paired() -> None:
    """Latched edges that the host saw 0.4 s off are not paired; arrivals are used instead, with their larger sigma."""
    times = np.arange(20.003, 60.0, 0.02)
    clock = DeviceClock(host_clock(120))
    clock.add(rows_of(times, 0.4))
    _, sigma = clock.gps_from_device(device_ns(np.array([40.0])))
    assert sigma[0] > 1e6


def test_missing_latches_are_bridged_and_spurious_ones_refused() -> None:
    """A latch that is missing for 20 s is bridged; one between two seconds is refused and counted."""
    times = np.arange(20.003, 90.0, 0.02)
    rows = rows_of(times)
    gone = (times > 40) & (times < 60)
    rows["pps_time_ns"][gone] = device_ns(40.0)
    spurious = (times > 70.5) & (times < 71.0)
    rows["pps_time_ns"][spurious] = device_ns(70.4)
    clock = DeviceClock(host_clock(120))
    clock.add(rows)
    assert clock.status().refused == {"spacing": 1}
    assert np.max(np.abs(errors_ns(clock, np.arange(21.0, 89.0, 0.0371)))) < 300


def test_a_spurious_first_latch_is_discarded() -> None:
    """After a spurious first latch all later ones look wrong, so the chain restarts and the time becomes right."""
    times = np.arange(20.503, 60.0, 0.02)
    rows = rows_of(times)
    rows["pps_time_ns"][times < 21] = device_ns(20.2)
    clock = DeviceClock(host_clock(120))
    clock.add(rows)
    assert np.max(np.abs(errors_ns(clock, np.arange(30.0, 59.0, 0.1)))) < 300


@pytest.mark.parametrize("pulses_from_s", [40.0, math.inf])
def test_a_latch_register_of_zero_before_the_first_pulse_is_not_an_edge(pulses_from_s: float) -> None:
    """The device was switched on 0.2 s after a whole second; its latch reads 0 until a pulse comes, if one does."""
    times = np.arange(20.003, 60.0, 0.02)
    rows = rows_of(times)
    switched_on_ns = int(device_ns(5.2))
    for column in ("device_time_ns", "pps_time_ns"):
        rows[column] -= switched_on_ns
    rows["pps_time_ns"][times < pulses_from_s] = 0
    rows["pps_count"] = -1
    clock = DeviceClock(host_clock(120), keep_history=True)
    clock.add(rows)
    gps, sigma = clock.gps_from_device(rows["device_time_ns"], rows["host_time_ns"])
    error = np.abs(gps - START_S * NS - np.rint(times * NS))
    assert np.all(error < 4.0 * sigma)
    assert np.all(sigma < 3e6)
    assert np.all(sigma[times > pulses_from_s + 5.0] < 1e4)


def test_a_counter_restart_begins_a_new_segment() -> None:
    """The counter starts again near zero; the host time selects the segment, and both segments are right."""
    times = np.arange(20.003, 60.0, 0.02)
    before, after = rows_of(times), rows_of(times + 50.0)
    reset = int(device_ns(70.0)) - 5 * NS
    for column in ("device_time_ns", "pps_time_ns"):
        after[column] -= reset
    after["pps_count"] -= 68
    clock = DeviceClock(host_clock(120))
    clock.add(np.concatenate((before, after)))
    assert clock.status().segments == 2
    assert np.max(np.abs(errors_ns(clock, times[100:1900], host_ns(times[100:1900])))) < 300
    gps, _ = clock.gps_from_device(device_ns(times + 50.0) - reset)
    late = gps[100:1900] - START_S * NS - np.rint((times[100:1900] + 50.0) * NS)
    assert np.max(np.abs(late)) < 300


def fed_whole_and_in_pieces(rows: StructArray, seconds: int) -> Iterator[DeviceClock]:
    """Return a clock fed at once as a log is read, and one fed in pieces as it is followed."""
    for step in (len(rows), 37):
        clock = DeviceClock(host_clock(seconds), keep_history=True)
        for start in range(0, len(rows), step):
            clock.add(rows[start : start + step])
        yield clock


def head_rows(times: FloatArray, free: BoolArray, free_s: FloatArray) -> StructArray:
    """Return rows of a head whose second follows the edge while locked, and which runs 20 ppm fast while free."""
    rows = rows_of(times, latched=False)
    rows["device_time_ns"] = np.rint((times + np.where(free, 20e-6 * free_s, 0.0)) * NS)
    rows["locked"] = ~free
    rows["pps_time_ns"] = np.where(free, -1, rows["device_time_ns"] // NS * NS)
    return rows


@pytest.mark.parametrize("latched", [False, True])
@pytest.mark.parametrize(("silent_s", "ahead_s"), [(0.02, 20.123), (0.02, 1.7e9), (60.0, -20.123)])
def test_a_jump_of_device_time_begins_a_new_segment(silent_s: float, ahead_s: float, latched: bool) -> None:
    """The device was set to another time scale, or restarted during a silence; host time contradicts its counter."""
    times = np.arange(20.003, 60.0, 0.02)
    after = np.arange(times[-1] + silent_s, times[-1] + silent_s + 60.0, 0.02)
    rows, later = rows_of(times, latched=latched), rows_of(after, latched=latched)
    later["device_time_ns"] += round(ahead_s * NS)
    if latched:
        later["pps_time_ns"] += round(ahead_s * NS)
    rows, times = np.concatenate((rows, later)), np.concatenate((times, after))
    rows["pps_count"] = -1
    for clock in fed_whole_and_in_pieces(rows, 200):
        gps, sigma = clock.gps_from_device(rows["device_time_ns"], rows["host_time_ns"])
        assert np.all(np.abs(gps - START_S * NS - np.rint(times * NS)) < 4.0 * sigma + 300)
        assert clock.status().segments == 2


def test_a_late_label_applies_to_earlier_edges() -> None:
    """Edges latched before the host knew its second are labelled once it does."""
    host = PpsClock(18, keep_history=True)
    clock = DeviceClock(host)
    times = np.arange(2.003, 30.0, 0.02)
    for second in range(40):
        host.add_edge(int(host_ns(second)), second)
    clock.add(rows_of(times))
    assert np.all(np.isinf(clock.gps_from_device(device_ns(times))[1]))
    for second in range(30, 40):
        week, of_week = divmod(START_S + second, 604_800)
        message = TimeMessage(
            int(host_ns(second + 0.1)), TimeTag(TimeScale.GPS, of_week * NS, week), NamesEdge.PREVIOUS
        )
        host.add_message("gnss/rover", message)
    assert np.max(np.abs(errors_ns(clock, times[60:]))) < 300


def test_without_latch_the_least_delayed_arrivals_count() -> None:
    """Latencies are 1 ms plus an exponential tail of mean 5 ms; errors are within a sigma that is never a latch's."""
    random = np.random.default_rng(2)
    clock = DeviceClock(host_clock(400))
    times = np.arange(20.0, 390.0, 0.02)
    clock.add(rows_of(times, 0.001 + random.exponential(0.005, len(times)), latched=False))
    asked = np.arange(30.0, 380.0, 0.5)
    gps, sigma = clock.gps_from_device(device_ns(asked))
    error = gps - START_S * NS - np.rint(asked * NS)
    assert not clock.status().latched
    assert 1e6 < np.median(sigma) < 5e6
    assert rms(error / sigma) < 1.25
    assert np.max(np.abs(error)) < 3e6


def test_hour_timestamps_are_used_only_while_locked() -> None:
    """A locked Velodyne counts µs past the UTC hour; before lock it counts from power-on, which is not UTC."""
    host = host_clock(7300, message_s=0.05)
    times = np.arange(100.0, 7200.0, 0.5)
    locked = times >= 1000.0
    rows = rows_of(times, latched=False)
    past_hour = np.rint(times * 1e6).astype(np.int64) * 1000 % (3600 * NS)
    rows["device_time_ns"] = np.where(locked, past_hour, rows["device_time_ns"])
    rows["locked"] = locked
    clock = DeviceClock(host, past_utc_hour=True, keep_history=True)
    clock.add(rows)
    gps, sigma = clock.gps_from_device(rows["device_time_ns"], rows["host_time_ns"])
    error = gps - START_S * NS - np.rint(times * NS)
    assert np.max(np.abs(error[locked])) < 1_000
    assert np.all(sigma[locked] == 20_000.0)
    assert np.max(np.abs(error[~locked])) < 3e6
    assert np.all(sigma[~locked] > 1e6)


def test_a_head_that_loses_its_pulse_is_not_treated_as_latched() -> None:
    """Its second is the edge while locked; it drifts by 20 ppm for a minute, 1.2 ms, and is then set right again."""
    times = np.arange(20.003, 160.0, 0.02)
    free = (times >= 60.0) & (times < 120.0)
    rows = head_rows(times, free, times - 60.0)
    for clock in fed_whole_and_in_pieces(rows, 180):
        gps, sigma = clock.gps_from_device(rows["device_time_ns"], rows["host_time_ns"])
        error = np.abs(gps - START_S * NS - np.rint(times * NS))
        assert np.all(error < 4.0 * sigma + 300)
        assert np.all(sigma[free & (times > 70.5)] > 1e6)
        assert np.max(error[~free]) < 300


def test_a_missed_pulse_costs_no_returns() -> None:
    """A head unlocked for one second in five, 20 ppm off, errs by 20 µs; the 2 ms of arrivals would reject returns."""
    times = np.arange(21.003, 160.0, 0.02)
    free = times // 1.0 % 5 == 0
    rows = head_rows(times, free, times % 1.0)
    for clock in fed_whole_and_in_pieces(rows, 180):
        gps, sigma = clock.gps_from_device(rows["device_time_ns"], rows["host_time_ns"])
        error = np.abs(gps - START_S * NS - np.rint(times * NS))
        assert np.all(error < 4.0 * sigma + 300)
        assert np.max(sigma) < 3e5
        assert np.max(error) < 50_000


@pytest.mark.parametrize("off_s", [5.0, 1.0, -1.0])
def test_hour_timestamps_that_contradict_the_clock_are_refused(off_s: float) -> None:
    """A head reports lock but is seconds off because of its receiver's old leap count."""
    times = np.arange(100.0, 200.0, 0.5)
    rows = rows_of(times, latched=False, locked=1)
    rows["device_time_ns"] = np.rint((times + off_s) * 1e6).astype(np.int64) * 1000
    clock = DeviceClock(host_clock(220), past_utc_hour=True)
    clock.add(rows)
    _, sigma = clock.gps_from_device(rows["device_time_ns"], rows["host_time_ns"])
    assert np.all(sigma > 1e6)
    assert clock.status().refused["past_hour"] == len(rows)


def test_without_data_or_host_time_the_sigma_is_infinite() -> None:
    """There are no rows, or the host has no time; nothing raises."""
    empty = DeviceClock(PpsClock(18))
    assert math.isinf(empty.gps_from_device(np.array([5]))[1][0])
    empty.add(np.zeros(0, dtype=DEVICE_CLOCK_DTYPE))
    empty.add(rows_of(np.arange(1.0, 5.0, 0.1)))
    assert math.isinf(empty.gps_from_device(np.array([5]))[1][0])
    assert empty.gps_from_device(np.zeros(0, dtype=np.int64))[0].size == 0
