"""Convert between GPS time and UTC: leap seconds, weeks, roll-overs, incomplete time tags.

GPS time is int64 nanoseconds since 1980-01-06T00:00:00, continuous (FORMULAS 12). UTC appears at interfaces only.
"""

from __future__ import annotations

import datetime as dt
import functools
from bisect import bisect_right

import numpy as np

from swath.georef.arrays import BoolArray, Int64Array
from swath.georef.records import TimeScale, TimeTag

SECOND_NS = 1_000_000_000
MILLISECOND_NS = 1_000_000
HOUR_NS = 3600 * SECOND_NS
DAY_NS = 86_400 * SECOND_NS
WEEK_S = 604_800
WEEK_NS = WEEK_S * SECOND_NS
GPS_EPOCH = dt.date(1980, 1, 6)
GPS_EPOCH_UNIX_S = 315_964_800
LAS_ADJUSTED_ZERO_S = 1_000_000_000

# First UTC day on which GPS − UTC has the value beside it. Source: IERS Bulletin C 1 … 52 (TAI − UTC less 19 s).
LEAP_SECOND_TABLE: tuple[tuple[dt.date, int], ...] = (
    (dt.date(1980, 1, 6), 0),
    (dt.date(1981, 7, 1), 1),
    (dt.date(1982, 7, 1), 2),
    (dt.date(1983, 7, 1), 3),
    (dt.date(1985, 7, 1), 4),
    (dt.date(1988, 1, 1), 5),
    (dt.date(1990, 1, 1), 6),
    (dt.date(1991, 1, 1), 7),
    (dt.date(1992, 7, 1), 8),
    (dt.date(1993, 7, 1), 9),
    (dt.date(1994, 7, 1), 10),
    (dt.date(1996, 1, 1), 11),
    (dt.date(1997, 7, 1), 12),
    (dt.date(1999, 1, 1), 13),
    (dt.date(2006, 1, 1), 14),
    (dt.date(2009, 1, 1), 15),
    (dt.date(2012, 7, 1), 16),
    (dt.date(2015, 7, 1), 17),
    (dt.date(2017, 1, 1), 18),
)
# The table is certain up to here; later it is only the best guess. (Bulletin C 70: none at the end of 2025.)
LEAP_TABLE_VALID_UNTIL = dt.date(2026, 6, 28)
_LEAP_DAYS = [day for day, _ in LEAP_SECOND_TABLE]

# A solution's epoch may lie this far before the host time of its message, and this far after it.
MAX_AGE_NS = 10 * SECOND_NS
MAX_AHEAD_NS = SECOND_NS // 2


def table_leap_seconds(date: dt.date) -> tuple[int, bool]:
    """Return GPS − UTC on a UTC day by the built-in table, and whether the table reaches that far (else: a guess)."""
    row = max(0, bisect_right(_LEAP_DAYS, date) - 1)
    return LEAP_SECOND_TABLE[row][1], date <= LEAP_TABLE_VALID_UNTIL


def gps_ns_from_utc(date: dt.date, time_of_day_ns: int, leap_seconds: int) -> int:
    """Return GPS ns of a UTC day and time.

    In a leap second time_of_day_ns ≥ 86 400 s and leap_seconds is the old count.
    """
    return (date.toordinal() - GPS_EPOCH.toordinal()) * DAY_NS + time_of_day_ns + leap_seconds * SECOND_NS


def gps_ns_from_unix(unix_ns: int, leap_seconds: int) -> int:
    """Return GPS ns of a POSIX time stamp (CLOCK_REALTIME)."""
    return unix_ns - GPS_EPOCH_UNIX_S * SECOND_NS + leap_seconds * SECOND_NS


def gps_ns_from_datetime(moment: dt.datetime) -> int:
    """Return GPS ns of a moment with a time zone, to a microsecond, by the built-in table of leap seconds."""
    utc = moment.astimezone(dt.UTC)
    since = utc - dt.datetime(1970, 1, 1, tzinfo=dt.UTC)
    unix_ns = (since.days * 86_400 + since.seconds) * SECOND_NS + since.microseconds * 1000
    return gps_ns_from_unix(unix_ns, table_leap_seconds(utc.date())[0])


def unix_ns_from_gps(gps_ns: int, leap_seconds: int) -> int:
    """Return POSIX ns of a GPS time."""
    return gps_ns + GPS_EPOCH_UNIX_S * SECOND_NS - leap_seconds * SECOND_NS


def unix_from_gps(gps_ns: int) -> int:
    """Return POSIX ns of a GPS time for time stamps shown to people; leap seconds are from the built-in table."""
    second, rest_ns = divmod(gps_ns, SECOND_NS)
    return _unix_of_second(second) + rest_ns


@functools.lru_cache(maxsize=16)
def _unix_of_second(gps_s: int) -> int:
    gps_ns = gps_s * SECOND_NS
    date: dt.date = utc_from_gps(gps_ns, 18)[0]
    return max(0, unix_ns_from_gps(gps_ns, table_leap_seconds(date)[0]))


def utc_from_gps(gps_ns: int, leap_seconds: int) -> tuple[dt.date, int]:
    """Return UTC date and nanoseconds of day of a GPS time; a leap second reads as the next day's first second."""
    days, time_of_day_ns = divmod(gps_ns - leap_seconds * SECOND_NS, DAY_NS)
    return dt.date.fromordinal(GPS_EPOCH.toordinal() + days), time_of_day_ns


def gps_ns_from_week(week: int, time_of_week_ns: int) -> int:
    """Return GPS ns of a full week number and time of week."""
    return week * WEEK_NS + time_of_week_ns


def week_from_gps(gps_ns: int) -> tuple[int, int]:
    """Return full week number and time of week in ns."""
    return divmod(gps_ns, WEEK_NS)


def full_week(week: int, reference_week: int, modulus: int = 1024) -> int:
    """Return the full week nearest to a reference for a week counted modulo 1024 (FORMULAS 12) or 4096."""
    return week + modulus * round((reference_week - week) / modulus)


def week_difference_ns(difference_ns: int) -> int:
    """Return a difference of times of week, folded to −302 400 … 302 400 s."""
    return (difference_ns + WEEK_NS // 2) % WEEK_NS - WEEK_NS // 2


def las_adjusted_s(gps_ns: int) -> float:
    """Return LAS adjusted standard GPS time: GPS seconds − 1e9."""
    return (gps_ns - LAS_ADJUSTED_ZERO_S * SECOND_NS) / SECOND_NS


def whole_gps_ns(tag: TimeTag, leap_seconds: int | None) -> int | None:
    """Return GPS ns of a complete tag (week or date); None if it is incomplete, or if UTC lacks a leap count.

    The tag's own leap count takes precedence over the given one.
    """
    if tag.scale is TimeScale.GPS:
        return None if tag.week is None else gps_ns_from_week(tag.week, tag.time_ns)
    leap = tag.leap_seconds if tag.leap_seconds is not None else leap_seconds
    if tag.date is None or leap is None:
        return None
    return gps_ns_from_utc(tag.date, tag.time_ns, leap)


def nearest_gps_ns(tag: TimeTag, near_gps_ns: int, leap_seconds: int | None) -> int | None:
    """Return GPS ns nearest to a prediction with the tag's time of week (or day); its week and date are ignored.

    That repairs 10-bit weeks and a week number that turned over before or after its time of week.
    """
    if tag.scale is TimeScale.GPS:
        period_ns, offset_ns = WEEK_NS, tag.time_ns
    else:
        leap = tag.leap_seconds if tag.leap_seconds is not None else leap_seconds
        if leap is None:
            return None
        period_ns, offset_ns = DAY_NS, tag.time_ns + leap * SECOND_NS
    return near_gps_ns + (offset_ns - near_gps_ns + period_ns // 2) % period_ns - period_ns // 2


def complete_time(
    tag: TimeTag, near_gps_ns: int | None, leap_seconds: int | None, *, max_age_ns: int = MAX_AGE_NS
) -> int | None:
    """Return GPS ns of a device's time tag, or None if it cannot be placed.

    With a prediction (the GPS time of the message's arrival) the tag must lie between max_age_ns before it and 0.5 s
    after it: a week number that turned over at another moment than its time of week is repaired, anything else refused.
    Without a prediction the tag must be complete.
    """
    if near_gps_ns is None:
        return whole_gps_ns(tag, leap_seconds)
    gps_ns = nearest_gps_ns(tag, near_gps_ns, leap_seconds)
    if gps_ns is None or not -max_age_ns <= gps_ns - near_gps_ns <= MAX_AHEAD_NS:
        return None
    return gps_ns


def gps_ns_past_hour(
    past_hour_ns: Int64Array,
    near_gps_ns: Int64Array,
    leap_seconds: int,
    *,
    max_age_ns: int = SECOND_NS,
    slack_ns: Int64Array | int = 0,
) -> tuple[Int64Array, BoolArray]:
    """Place stamps that count from the UTC hour (Velodyne, locked): GPS ns (n,), and whether each is credible.

    The hour is the one nearest to the prediction, the GPS time of arrival (so within ± 30 min); a stamp is refused if
    it then lies more than max_age_ns before it (as in a stalled packet) or 0.5 s after it: a head that is one second
    ahead appears ahead by that second less the packet's latency. slack_ns: added tolerance on either side, for a coarse
    prediction.
    """
    near = np.asarray(near_gps_ns, dtype=np.int64)
    offset = np.asarray(past_hour_ns, dtype=np.int64) + leap_seconds * SECOND_NS
    residual = (offset - near + HOUR_NS // 2) % HOUR_NS - HOUR_NS // 2
    return near + residual, (residual >= -max_age_ns - slack_ns) & (residual <= MAX_AHEAD_NS + slack_ns)
