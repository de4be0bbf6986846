"""Tests the clocks of a stream: the second that the recorder knew is known again when its log is read."""

from __future__ import annotations

import datetime as dt
import math

import pytest

from swath.georef.records import NamesEdge, PpsEdge, TimeMessage, TimeScale, TimeTag
from swath.georef.stream.clocks import ClockPlan, GnssPlan, HostClocks, PpsPlan
from swath.georef.timescales import HOUR_NS, SECOND_NS, TimeState, gps_ns_from_utc, unix_ns_from_gps

DATE = dt.date(2026, 5, 10)
START_NS = gps_ns_from_utc(DATE, 12 * HOUR_NS, 18)
HOST_NS = unix_ns_from_gps(START_NS, 18)
OFFSET_NS = HOST_NS - 1000 * SECOND_NS  # host time less MONOTONIC


def told(clocks: HostClocks, delay_ns: int, max_error_s: float, *, seconds: int, ticks_s: int) -> None:
    """Feed edges, RMC messages with a delay and ten clock readings a second.

    The clocks are updated every `ticks_s` seconds; 0 means only at the end.
    """
    for second in range(seconds):
        edge_ns = HOST_NS + second * SECOND_NS
        for reading_ns in range(edge_ns, edge_ns + SECOND_NS, SECOND_NS // 10):
            monotonic_ns = reading_ns - OFFSET_NS
            clocks.add_reading(reading_ns, monotonic_ns, monotonic_ns, max_error_s)
        clocks.add_edge("pps/main", PpsEdge(edge_ns, second))
        tag = TimeTag(TimeScale.UTC, 12 * HOUR_NS + second * SECOND_NS, date=DATE)
        message = TimeMessage(edge_ns + delay_ns, tag, NamesEdge.PREVIOUS, message="RMC")
        clocks.add_message("gnss/rover", message)
        if ticks_s and second % ticks_s == 0:
            clocks.update()
    clocks.update()


@pytest.mark.parametrize("ticks_s", [0, 1, 7])
@pytest.mark.parametrize("delay_ms", [100, 800, 1200])
def test_a_synchronised_wall_clock_decides_the_second_of_late_messages(delay_ms: int, ticks_s: int) -> None:
    """NMEA that is late by 0.8 s is ambiguous, by 1.2 s it looks 0.2 s late; chrony decides, as while recording."""
    plan = ClockPlan(OFFSET_NS, pps={"pps/main": PpsPlan(18)}, gnss={"gnss/rover": GnssPlan("pps/main")})
    clocks = HostClocks(plan, keep_history=True)
    told(clocks, delay_ms * 1_000_000, 0.01, seconds=400, ticks_s=ticks_s)
    status = clocks.status("pps/main", HOST_NS + 400 * SECOND_NS)
    assert status.state is TimeState.LOCKED
    assert status.offset_ns is not None
    assert abs(HOST_NS - OFFSET_NS + status.offset_ns - START_NS) < 1_000_000


def test_an_unsynchronised_wall_clock_decides_no_second() -> None:
    plan = ClockPlan(OFFSET_NS, pps={"pps/main": PpsPlan(18)}, gnss={"gnss/rover": GnssPlan("pps/main")})
    clocks = HostClocks(plan, keep_history=True)
    told(clocks, 800_000_000, math.inf, seconds=60, ticks_s=0)
    assert clocks.status("pps/main", HOST_NS + 60 * SECOND_NS).state is TimeState.COARSE


def test_a_wall_clock_alone_gives_no_time() -> None:
    """No sigma includes the wall clock's drift between readings, and a missing receiver would go unnoticed."""
    plan = ClockPlan(OFFSET_NS, pps={"pps/main": PpsPlan(18)}, gnss={"gnss/rover": GnssPlan(None)})
    clocks = HostClocks(plan, keep_history=True)
    told(clocks, 100_000_000, 0.01, seconds=60, ticks_s=1)
    assert clocks.status("pps/main", HOST_NS + 60 * SECOND_NS).state is TimeState.NO_TIME


def test_a_receiver_in_local_time_is_reported_beside_the_recording_clock() -> None:
    plan = ClockPlan(OFFSET_NS - 7200 * SECOND_NS, pps={"pps/main": PpsPlan(18)}, gnss={"gnss/rover": GnssPlan(None)})
    clocks = HostClocks(plan, keep_history=True)
    for second in range(30):
        host_ns = HOST_NS + (second - 7200) * SECOND_NS
        monotonic_ns = host_ns - plan.host_minus_monotonic_ns
        clocks.add_reading(host_ns, monotonic_ns, monotonic_ns, 0.01)
        tag = TimeTag(TimeScale.UTC, 12 * HOUR_NS + second * SECOND_NS, date=DATE)
        clocks.add_message("gnss/rover", TimeMessage(host_ns, tag, NamesEdge.PREVIOUS, message="RMC"))
    clocks.update()
    (line,) = clocks.settle()
    assert line.startswith("gnss/rover: its time is 2 h ahead of the recording computer's clock")
