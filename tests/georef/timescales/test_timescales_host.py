"""Tests the conversion of host time to CLOCK_MONOTONIC_RAW, and the clock's properties for any input."""

from __future__ import annotations

import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from swath.georef.records import NamesEdge, TimeMessage, TimeScale, TimeTag
from swath.georef.timescales import HostTimeline, PpsClock, TimeState
from tests.georef.clock_run import SURE, run
from tests.georef.clock_simulation import Edges, Oscillator, Sender, Simulation, utc_tag, week_tag

NS = 1_000_000_000
CONSTANT = 1_790_000_000 * NS
START = 1_479_297_618


def slewed(seconds: np.ndarray) -> np.ndarray:
    """Return MONOTONIC (ns) at RAW seconds: slewed by −30 ppm, between 100 s and 200 s by +100 ppm (chrony)."""
    slew = -30e-6 * seconds + 130e-6 * np.clip(seconds - 100.0, 0.0, 100.0)
    return np.rint((seconds + slew) * NS).astype(np.int64) + 4 * NS


def timeline(*, step_s: float = 0.0, keep_history: bool = True) -> HostTimeline:
    """Return 300 s of readings at 10 Hz, with the wall clock stepped half-way by `step_s`."""
    line = HostTimeline(CONSTANT, keep_history=keep_history)
    for raw_s in np.arange(0.0, 300.0, 0.1):
        monotonic = int(slewed(np.array(raw_s)))
        realtime = CONSTANT + monotonic + (round(step_s * NS) if raw_s > 150 else 0)
        line.add(realtime, monotonic, round(raw_s * NS))
    return line


def test_raw_clock_is_interpolated_between_and_extrapolated_after_readings() -> None:
    """Errors are within 2 µs between readings and 10 µs where the slew changed."""
    line = timeline()
    raw = np.arange(0.05, 310.0, 0.037)
    host = slewed(raw) + CONSTANT
    found = line.raw_from_host(host)
    error = np.abs(found - np.rint(raw * NS))
    assert np.max(error) < 10_000
    assert np.median(error) < 100
    assert np.all(np.diff(found) > 0)
    assert line.raw_at(int(host[500])) == found[500]
    assert abs(line.raw_at(int(host[-1])) - int(found[-1])) <= 1


def test_wall_clock_steps_change_nothing() -> None:
    """Steps of an hour in either direction give the same map."""
    host = slewed(np.arange(1.0, 299.0)) + CONSTANT
    straight = timeline().raw_from_host(host)
    for step in (3600.0, -3600.0):
        np.testing.assert_array_equal(timeline(step_s=step).raw_from_host(host), straight)


def test_torn_reading_is_refused() -> None:
    """Readings torn by preemption (2 ms) are refused; a lasting change is accepted after three."""
    line = timeline()
    last = int(slewed(np.array(300.0)))
    line.add(0, last, 300 * NS + 2_000_000)
    assert line.refused == 1
    host = np.array([last + CONSTANT])
    assert abs(int(line.raw_from_host(host)[0]) - 300 * NS) < 10_000
    for k in range(1, 5):
        later = int(slewed(np.array(300.0 + 0.1 * k)))
        line.add(0, later, round((300.0 + 0.1 * k) * NS) + 2_000_000)
    assert abs(line.raw_at(later + CONSTANT) - round(300.4 * NS) - 2_000_000) < 10_000
    line.add(0, later - 5, 0)
    assert line.refused == 4


def test_without_readings_raw_equals_monotonic() -> None:
    """Without a /clock channel MONOTONIC is the best approximation of RAW."""
    line = HostTimeline(CONSTANT)
    host = np.array([CONSTANT + 5, CONSTANT + 10 * NS])
    np.testing.assert_array_equal(line.raw_from_host(host), host - CONSTANT)
    assert line.raw_at(CONSTANT + 7) == 7


def test_real_clocks_of_this_machine_are_mapped_within_a_millisecond() -> None:
    """The timeline reads this machine's clocks for 0.3 s; RAW read afterwards is found within 1 ms."""
    line = HostTimeline(0)
    for _ in range(30):
        line.add(
            time.time_ns(), time.clock_gettime_ns(time.CLOCK_MONOTONIC), time.clock_gettime_ns(time.CLOCK_MONOTONIC_RAW)
        )
        time.sleep(0.01)
    before = time.clock_gettime_ns(time.CLOCK_MONOTONIC)
    raw = time.clock_gettime_ns(time.CLOCK_MONOTONIC_RAW)
    after = time.clock_gettime_ns(time.CLOCK_MONOTONIC)
    assert line.raw_at(before) - 1_000_000 < raw < line.raw_at(after) + 1_000_000


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(
    st.integers(0, 10**6),
    st.floats(0.005, 1.0),
    st.sampled_from([0.001, 0.01, 0.05, 0.1]),
    st.sampled_from([0.0, 0.02, 0.1, 0.2]),
    st.floats(0.0, 0.1),
    st.floats(0.0, 0.05),
    st.sampled_from([50.0, 1500.0, 15e3, 300e3]),
    st.floats(-90.0, 90.0),
)
def test_the_second_is_never_wrong(
    seed: int,
    delay_s: float,
    jitter_s: float,
    stalls: float,
    missing: float,
    spurious: float,
    noise_ns: float,
    drift_ppm: float,
) -> None:
    senders = [
        Sender("RMC", utc_tag(18), delay_s=delay_s, jitter_s=jitter_s, stalls=stalls),
        Sender("TIME", week_tag(), delay_s=delay_s + 0.05, jitter_s=jitter_s, stalls=stalls),
    ]
    oscillator = Oscillator(200, seed=seed, drift_ppm=drift_ppm, ramps=seed % 2 == 0)
    edges = Edges(noise_ns=noise_ns, missing=missing, spurious=spurious)
    outcome = run(Simulation(START, oscillator, edges, senders, seed=seed), PpsClock(18))
    assert outcome.wrong_seconds == 0
    if delay_s + jitter_s < 0.45 and stalls <= 0.02:
        assert outcome.states[-1] in SURE


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 40 * NS), st.integers(0, 3), st.integers(-3, 3)), max_size=60))
def test_arbitrary_input_never_raises_or_gives_a_wrong_claim(items: list[tuple[int, int, int]]) -> None:
    """Edges and messages come in any order, at any time, with any second."""
    clock = PpsClock(18)
    for host, kind, off in items:
        if kind == 0:
            clock.add_edge(host, off)
            continue
        scale = TimeScale.GPS if kind == 1 else TimeScale.UTC
        tag = TimeTag(scale, (host // NS + off) % 80_000 * NS + (off == 3), 2000 if off > 0 else None)
        clock.add_message("gnss/x", TimeMessage(host, tag, NamesEdge.NEXT if off < 0 else NamesEdge.PREVIOUS))
        status = clock.status(host)
        assert status.state in TimeState
        assert status.sigma_ns >= 0.0
    gps, sigma = clock.gps_from_host(np.arange(0, 60 * NS, NS, dtype=np.int64))
    assert gps.shape == sigma.shape == (60,)


def test_time_is_monotone_and_continuous_across_a_relock() -> None:
    """The history has a gap, and a jump of the edges by 20 ms, which is spread over 1 s."""
    edges = Edges(silent=lambda s: 300 <= s < 360, late_s=lambda s: 0.02 if s >= 500 else 0.0)
    simulation = Simulation(START, Oscillator(800, seed=6), edges, [Sender("TIME", week_tag())], seed=6)
    clock = PpsClock(18, keep_history=True)
    outcome = run(simulation, clock)
    assert "pps_relocked" in outcome.codes
    hosts = np.array([simulation.host_ns(second) for second in np.arange(1.0, 799.0, 0.13)])
    gps, _ = clock.gps_from_host(hosts)
    assert np.all(np.diff(gps) > 0)
    assert np.max(np.abs(np.diff(gps) / np.diff(hosts) - 1.0)) < 0.03


def test_a_small_move_of_the_edges_spoils_no_earlier_second() -> None:
    """The receiver moves its pulse by 0.5 ms, which is so little that one chain could run through both."""
    clock = PpsClock(18, keep_history=True)
    true = np.arange(200) * NS
    edges = true + 10**13 + np.where(np.arange(200) >= 100, 500_000, 0)
    week, of_week = divmod(START, 604_800)
    for second, edge in enumerate(edges.tolist()):
        clock.add_edge(edge)
        tag = TimeTag(TimeScale.GPS, (of_week + second) * NS, week)
        clock.add_message("gnss/rover", TimeMessage(edge + 10**8, tag, NamesEdge.PREVIOUS, message="TIME"))
    assert "pps_relocked" in [event.code for event in clock.drain_events()]
    asked = np.arange(60.0, 99.0, 0.25)
    gps, sigma = clock.gps_from_host(10**13 + np.rint(asked * NS).astype(np.int64))
    assert np.max(sigma) < 5_000
    assert np.max(np.abs(gps - START * NS - np.rint(asked * NS))) < 1_000
