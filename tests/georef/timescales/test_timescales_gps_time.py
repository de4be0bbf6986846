"""Tests GPS time and UTC against FORMULAS 12 and the calendar of the standard library."""

from __future__ import annotations

import datetime as dt

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swath.georef.records import TimeScale, TimeTag
from swath.georef.timescales import (
    DAY_NS,
    HOUR_NS,
    LEAP_SECOND_TABLE,
    SECOND_NS,
    WEEK_NS,
    complete_time,
    full_week,
    gps_ns_from_unix,
    gps_ns_from_utc,
    gps_ns_from_week,
    gps_ns_past_hour,
    las_adjusted_s,
    nearest_gps_ns,
    table_leap_seconds,
    unix_ns_from_gps,
    utc_from_gps,
    week_difference_ns,
    week_from_gps,
)

CHECK_S = 1_479_297_618
NOON = dt.date(2026, 11, 21)
gps_times = st.integers(0, 4 * 10**9 * SECOND_NS)


def test_gps_time_matches_the_check_of_formulas_12() -> None:
    """FORMULAS 12 gives these figures for 2026-11-21T12:00:00Z with 18 leap seconds."""
    gps = gps_ns_from_utc(NOON, 12 * HOUR_NS, 18)
    assert gps == CHECK_S * SECOND_NS
    assert week_from_gps(gps) == (2445, 561_618 * SECOND_NS)
    assert week_from_gps(gps)[0] % 1024 == 397
    assert full_week(397, 2400) == 2445
    assert las_adjusted_s(gps) == 479_297_618.0


def test_las_time_zero_is_in_september_2011() -> None:
    """LAS adjusted time 0 is 2011-09-14 01:46:25 UTC (leap seconds 15)."""
    gps = gps_ns_from_utc(dt.date(2011, 9, 14), (1 * 3600 + 46 * 60 + 25) * SECOND_NS, 15)
    assert las_adjusted_s(gps) == 0.0


@pytest.mark.parametrize(
    ("day", "week"), [(dt.date(1999, 8, 22), 1024), (dt.date(2019, 4, 7), 2048), (dt.date(2038, 11, 21), 3072)]
)
def test_week_rollovers_are_resolved_from_any_near_reference(day: dt.date, week: int) -> None:
    """The 10-bit week is 0 again on these days; the full one is found from any reference within 511 weeks."""
    found, of_week = week_from_gps(gps_ns_from_utc(day, 0, 0))
    assert (found, of_week) == (week, 0)
    assert full_week(0, week - 500) == week
    assert full_week(1023, week + 500) == week - 1
    assert full_week(week % 4096, week, 4096) == week


def test_leap_second_is_one_second_long() -> None:
    """23:59:59, :60 and 00:00:00 of 2016-12-31 are consecutive GPS seconds."""
    last = dt.date(2016, 12, 31)
    times = [
        gps_ns_from_utc(last, DAY_NS - SECOND_NS, 17),
        gps_ns_from_utc(last, DAY_NS, 17),
        gps_ns_from_utc(dt.date(2017, 1, 1), 0, 18),
    ]
    assert np.diff(times).tolist() == [SECOND_NS, SECOND_NS]


def test_leap_second_table_grows_by_one_and_knows_its_end() -> None:
    """Each row has one leap second more, and the table says whether a date is beyond its end."""
    counts = [count for _, count in LEAP_SECOND_TABLE]
    assert counts == list(range(19))
    assert table_leap_seconds(dt.date(2016, 12, 31)) == (17, True)
    assert table_leap_seconds(dt.date(2017, 1, 1)) == (18, True)
    assert table_leap_seconds(dt.date(2030, 1, 1)) == (18, False)


@given(gps_times, st.integers(0, 30))
def test_utc_and_unix_conversions_are_invertible(gps: int, leap: int) -> None:
    """GPS to UTC (or POSIX) and back is the identity; the date is that of Python's calendar."""
    date, of_day = utc_from_gps(gps, leap)
    assert gps_ns_from_utc(date, of_day, leap) == gps
    unix = unix_ns_from_gps(gps, leap)
    assert gps_ns_from_unix(unix, leap) == gps
    assert date == dt.datetime.fromtimestamp(unix // SECOND_NS, dt.UTC).date()


@given(st.integers(-3 * WEEK_NS, 3 * WEEK_NS))
def test_week_differences_are_folded(difference: int) -> None:
    """The result is within half a week and equal modulo a week."""
    folded = week_difference_ns(difference)
    assert -WEEK_NS // 2 <= folded < WEEK_NS // 2
    assert (folded - difference) % WEEK_NS == 0


@given(gps_times, st.integers(-300, 9_000), st.integers(-2, 2))
def test_complete_time_corrects_the_week(gps: int, age_ms: int, weeks_off: int) -> None:
    """A right time of week with a wrong or missing week number gives the right time, with the time of arrival."""
    week, of_week = week_from_gps(gps + 3 * WEEK_NS)
    truth = gps_ns_from_week(week, of_week)
    arrival = truth + age_ms * 1_000_000
    assert complete_time(TimeTag(TimeScale.GPS, of_week, week + weeks_off), arrival, None) == truth
    assert complete_time(TimeTag(TimeScale.GPS, of_week), arrival, None) == truth


@given(gps_times)
def test_complete_time_finds_the_day(gps: int) -> None:
    """UTC without a date (as in GGA) is completed to within half a day of the arrival."""
    gps += WEEK_NS
    _, of_day = utc_from_gps(gps, 18)
    tag = TimeTag(TimeScale.UTC, of_day)
    assert complete_time(tag, gps + SECOND_NS // 5, 18) == gps
    assert nearest_gps_ns(tag, gps + 11 * HOUR_NS, 18) == gps


def test_complete_time_refuses_impossible_tags() -> None:
    """Tags are not placed if they are far from the arrival or contain too little."""
    arrival = CHECK_S * SECOND_NS
    of_week = 561_618 * SECOND_NS
    assert complete_time(TimeTag(TimeScale.GPS, of_week + 2 * SECOND_NS, 2445), arrival, None) is None
    assert complete_time(TimeTag(TimeScale.GPS, of_week - 60 * SECOND_NS, 2445), arrival, None) is None
    assert complete_time(TimeTag(TimeScale.GPS, of_week), None, None) is None
    assert complete_time(TimeTag(TimeScale.UTC, 12 * HOUR_NS, date=NOON), None, None) is None
    assert complete_time(TimeTag(TimeScale.UTC, 12 * HOUR_NS), None, 18) is None
    assert complete_time(TimeTag(TimeScale.UTC, 12 * HOUR_NS, date=NOON), None, 18) == arrival
    assert (
        complete_time(TimeTag(TimeScale.UTC, 12 * HOUR_NS, date=NOON, leap_seconds=17), None, 18) == arrival - SECOND_NS
    )


@given(gps_times, st.integers(-450, 900))
def test_hour_timestamps_find_their_hour(gps: int, off_ms: int) -> None:
    """Stamps past the UTC hour are placed within ± 30 min; they are believed if up to 1 s old or 0.5 s ahead."""
    gps += WEEK_NS
    past = np.array([(gps - 18 * SECOND_NS) % HOUR_NS])
    placed, believed = gps_ns_past_hour(past, np.array([gps + off_ms * 1_000_000]), 18)
    assert placed[0] == gps
    assert believed[0]


def test_hour_timestamps_counted_from_power_on_are_refused() -> None:
    """A head without lock counts from power-on, so its stamps are far from any clock's time."""
    near = np.full(3, CHECK_S * SECOND_NS)
    past = np.array([5, 1500, 3599]) * SECOND_NS + SECOND_NS // 2
    _, believed = gps_ns_past_hour(past, near, 18)
    assert not believed[:2].any()
    assert believed[2]  # half a second before noon
