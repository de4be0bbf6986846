"""Tests real receivers' time messages on one clock: UTC with leap seconds and GPS week name one second.

The recordings have no arrival times, so edges are put at the beginning of the receiver's own seconds and messages 50 ms
later. The tests show that all kinds of messages agree, and that the label is the receiver's second.
"""

from __future__ import annotations

import datetime as dt
import gzip
from dataclasses import replace
from pathlib import Path

import pytest

from swath.drivers.driver import find_driver
from swath.drivers.parser import DeviceSettings
from swath.georef.records import Chunk, NamesEdge, TimeMessage, TimeScale, TimeTag
from swath.georef.timescales import (
    HOUR_NS,
    SECOND_NS,
    PpsClock,
    TimeState,
    gps_ns_from_utc,
    week_from_gps,
    whole_gps_ns,
)

FIXTURES = Path(__file__).resolve().parents[3] / "fixtures"
HOST_0 = 10**13
RECORDINGS = [
    ("ubx/ublox-8-time.log.gz", "ubx", {"NAV-SOL", "NAV-TIMEGPS"}),
    ("ubx/ublox-zed-f9p-hp.log.gz", "ubx", {"NAV-PVT", "NAV-TIMEGPS", "NAV-TIMELS"}),
    ("ubx/ublox-zed-f9t-rtcm3.log.gz", "ubx", {"NAV-PVT", "NAV-TIMEGPS"}),
    ("novatel/propak6-basic-fix.gps.gz", "novatel", {"INSPVAX"}),
    ("novatel/time.gps", "novatel", {"TIME"}),
]


def messages_of(path: Path, protocol: str) -> list[TimeMessage]:
    """Return all time messages of a recording, in order."""
    data = gzip.decompress(path.read_bytes()) if path.suffix == ".gz" else path.read_bytes()
    parser = find_driver("gnss", protocol).make_parser(DeviceSettings("gnss/rover"))
    records = [
        record for at in range(0, len(data), 64) for record in parser.feed(Chunk("gnss/rover", 0, data[at : at + 64]))
    ]
    return [record for record in records if isinstance(record, TimeMessage)]


@pytest.mark.parametrize(("name", "protocol", "kinds"), RECORDINGS, ids=[name for name, _, _ in RECORDINGS])
def test_all_messages_name_the_same_second(name: str, protocol: str, kinds: set[str]) -> None:
    """The clock locks on the receiver's own second; no voter contradicts it, and every message is placed."""
    clock = PpsClock(18)
    first_ns = second_ns = None
    voters = set()
    for number, message in enumerate(messages_of(FIXTURES / name, protocol)):
        gps_ns = whole_gps_ns(message.time, 18)
        if (
            gps_ns is not None
            and message.valid
            and message.names_edge is NamesEdge.PREVIOUS
            and gps_ns % SECOND_NS == 0
        ):
            first_ns = first_ns or gps_ns
            for edge_ns in range(second_ns or first_ns - SECOND_NS, gps_ns, SECOND_NS):
                clock.add_edge(HOST_0 + edge_ns + SECOND_NS - first_ns, 0)
            second_ns = max(gps_ns, second_ns or 0)
        if first_ns is None or second_ns is None:
            continue
        voters.add(message.message)
        arrival = HOST_0 + second_ns - first_ns + SECOND_NS // 20 + number % 10 * 1_000_000
        clock.add_message("gnss/rover", replace(message, host_time_ns=arrival))
    assert first_ns is not None
    assert second_ns is not None
    status = clock.status(HOST_0 + second_ns - first_ns + SECOND_NS // 10)
    assert status.state is TimeState.LOCKED
    assert status.offset_ns == pytest.approx(first_ns - HOST_0, abs=1000)
    assert [event.code for event in clock.drain_events()] == ["second_known"]
    assert "unplaced" not in status.messages_refused
    assert kinds <= voters


@pytest.mark.parametrize(("year", "leap"), [(2014, 16), (2016, 17), (2026, 18)])
def test_a_leap_count_without_a_date_is_compared_with_that_of_the_recording_day(year: int, leap: int) -> None:
    """RMC labels the edges by the table; NAV-TIMELS, without a date, then reports the same count."""
    date = dt.date(year, 5, 10)
    start_ns = gps_ns_from_utc(date, 12 * HOUR_NS, leap)
    clock = PpsClock()
    for second in range(90):
        edge_ns = HOST_0 + second * SECOND_NS
        clock.add_edge(edge_ns)
        tag = TimeTag(TimeScale.UTC, 12 * HOUR_NS + second * SECOND_NS, date=date)
        clock.add_message("gnss/rover", TimeMessage(edge_ns + 150_000_000, tag, NamesEdge.PREVIOUS, message="RMC"))
        if second >= 40:
            time_ns = week_from_gps(start_ns + second * SECOND_NS)[1]
            tag = TimeTag(TimeScale.GPS, time_ns, leap_seconds=leap)
            message = TimeMessage(edge_ns + 160_000_000, tag, NamesEdge.PREVIOUS, message="NAV-TIMELS")
            clock.add_message("gnss/rover", message)
        status = clock.status(edge_ns + 500_000_000)
        if second > 5:
            assert status.state is TimeState.LOCKED
            assert status.offset_ns is not None
            assert abs(HOST_0 + status.offset_ns - start_ns) < 1_000_000
    assert [event.code for event in clock.drain_events()] == ["second_known"]


def labelled(
    clock: PpsClock, date: dt.date, errors: dict[str, int], leap: int, said: dict[str, int]
) -> tuple[int, int]:
    """Feed 60 s of RMC by source (UTC off by `errors` s; `said` leap counts); return error and sigma at the end, ns."""
    start_ns = gps_ns_from_utc(date, 12 * HOUR_NS, leap)
    for second in range(60):
        edge_ns = HOST_0 + second * SECOND_NS
        clock.add_edge(edge_ns)
        for number, (source, error_s) in enumerate(errors.items()):
            of_day_ns = 12 * HOUR_NS + (second + error_s) * SECOND_NS
            tag = TimeTag(TimeScale.UTC, of_day_ns, date=date, leap_seconds=said.get(source))
            arrival_ns = edge_ns + 150_000_000 + number * 10_000_000
            clock.add_message(source, TimeMessage(arrival_ns, tag, NamesEdge.PREVIOUS, message="RMC"))
    status = clock.status(HOST_0 + 59 * SECOND_NS + SECOND_NS // 2)
    assert status.offset_ns is not None
    return HOST_0 + status.offset_ns - start_ns, round(status.sigma_ns)


@pytest.mark.parametrize("stale", [13, 16, 17])
def test_a_stale_leap_count_applies_only_to_its_own_receiver(stale: int) -> None:
    """One receiver states a leap count of years ago for its UTC; the other states none and is right."""
    clock = PpsClock()
    errors = {"gnss/base": 0, "gnss/rover": 18 - stale}
    error_ns, sigma_ns = labelled(clock, dt.date(2026, 3, 10), errors, 18, {"gnss/rover": stale})
    assert clock.status(HOST_0 + 60 * SECOND_NS).state is TimeState.LOCKED
    assert abs(error_ns) < 1_000_000
    assert sigma_ns < 1_000_000
    assert clock.leap_seconds_at(gps_ns_from_utc(dt.date(2026, 3, 10), 0, 18)) == 18
    assert clock.status(HOST_0 + 60 * SECOND_NS).leap_seconds == 18
    (event,) = [event for event in clock.drain_events() if event.code == "leap_seconds_changed"]
    assert "holds for this receiver's own messages alone" in event.text


@pytest.mark.parametrize(("year", "leap"), [(2010, 15), (2014, 16), (2016, 17), (2018, 18)])
def test_without_a_configured_leap_count_the_table_is_used(year: int, leap: int) -> None:
    clock = PpsClock()
    error_ns, _ = labelled(clock, dt.date(year, 5, 1), {"gnss/rover": 0}, leap, {})
    status = clock.status(HOST_0 + 60 * SECOND_NS)
    assert (status.state, status.leap_origin, status.leap_doubt) == (TimeState.LOCKED, "table", "")
    assert abs(error_ns) < 1_000_000


@pytest.mark.parametrize(
    ("assumed", "date", "truth", "doubt"),
    [
        (18, dt.date(2014, 5, 1), 16, "leap_seconds = 18 is configured, and GPS − UTC was 16 s on 2014-05-01"),
        (None, dt.date(2027, 5, 1), 19, "the built-in leap seconds end at 2026-06-28, and this is 2027-05-01"),
        (None, dt.date(2033, 5, 1), 20, "the built-in leap seconds end at 2026-06-28, and this is 2033-05-01"),
    ],
)
def test_a_guessed_leap_count_never_locks_and_its_sigma_contains_the_error(
    assumed: int | None, date: dt.date, truth: int, doubt: str
) -> None:
    clock = PpsClock(assumed)
    error_ns, sigma_ns = labelled(clock, date, {"gnss/rover": 0}, truth, {})
    status = clock.status(HOST_0 + 60 * SECOND_NS)
    assert (status.state, status.leap_origin) == (TimeState.COARSE, "guess")
    assert abs(error_ns) <= 1.3 * sigma_ns
    assert sigma_ns >= 1e9
    assert status.leap_doubt.startswith(doubt)
    (event,) = [event for event in clock.drain_events() if event.code == "leap_unknown"]
    assert doubt in event.text
