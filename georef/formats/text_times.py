"""Read dates, clock times and UTC in text files of trajectories."""

from __future__ import annotations

import datetime as dt
import re
from collections.abc import Sequence

import numpy as np

from swath.georef.arrays import Int64Array
from swath.georef.timescales.gps_time import (
    DAY_NS,
    GPS_EPOCH,
    LEAP_TABLE_VALID_UNTIL,
    SECOND_NS,
    WEEK_NS,
    table_leap_seconds,
)
from swath.georef.trajectory.trajectory import TrajectoryError

CLOCK = re.compile(r"(\d\d?):(\d\d?):(\d\d?(?:\.\d*)?)", re.ASCII)
WEEK, SECONDS = re.compile(r"\d{1,4}", re.ASCII), re.compile(r"\d{1,7}(\.\d*)?", re.ASCII)
FIRST_YEAR, LAST_YEAR = 1980, 2125  # limits of GPS time in 64 bits of nanoseconds, with a margin for differences


def gps_days(texts: Sequence[str], order: str, name: str) -> Int64Array:
    """Return (n,) days since the GPS epoch of dates like ``2026/11/22`` in an order like YMD; years yy are 20yy."""
    distinct, which = np.unique(np.asarray(texts), return_inverse=True)
    days = [_date(str(text), order, name).toordinal() - GPS_EPOCH.toordinal() for text in distinct]
    return np.asarray(days, dtype=np.int64)[which]


def clock_ns(texts: Sequence[str], name: str) -> Int64Array:
    """Return (n,) nanoseconds of the day of times like ``19:34:18.499``."""
    return np.array([_of_day_ns(text, name) for text in texts], dtype=np.int64)


def weeks_ns(weeks: Sequence[str], seconds: Sequence[str], name: str) -> Int64Array:
    """Return (n,) GPS time from weeks and seconds of the week."""
    for week, second in zip(weeks, seconds, strict=True):
        if not (WEEK.fullmatch(week) and SECONDS.fullmatch(second)):
            raise TrajectoryError(
                f"{name}: '{week} {second}' is neither a date with a time of day nor a GPS week with its seconds"
            )
    of_week = np.rint(np.array(seconds, dtype=np.float64) * SECOND_NS).astype(np.int64)
    gps_ns: Int64Array = np.array(weeks, dtype=np.int64) * WEEK_NS + of_week
    return gps_ns


def gps_ns_of_day(days: Int64Array, of_day_ns: Int64Array) -> Int64Array:
    """Return (n,) GPS time from days since the GPS epoch and nanoseconds of the day, both in GPS time."""
    gps_ns: Int64Array = days * DAY_NS + of_day_ns
    return gps_ns


def leap_seconds_on(day: int, said: int | None, name: str) -> int:
    """Return GPS − UTC on a day since the GPS epoch: the given value, or the built-in table as far as it reaches."""
    if said is not None:
        return said
    date = GPS_EPOCH + dt.timedelta(days=int(day))
    leap, certain = table_leap_seconds(date)
    if not certain:
        raise TrajectoryError(
            f"{name}: its time is UTC, and this program knows leap seconds only until {LEAP_TABLE_VALID_UNTIL}; "
            "export it in GPS time"
        )
    return leap


def _date(text: str, order: str, name: str) -> dt.date:
    parts = text.replace("-", "/").replace(".", "/").split("/")
    try:
        fields = {letter: int(part) for letter, part in zip(order, parts, strict=True)}
        year = fields["Y"] + (2000 if fields["Y"] < 100 else 0)
        if not FIRST_YEAR <= year <= LAST_YEAR:
            raise TrajectoryError(f"{name}: {text[:20]!r} is not in a year from {FIRST_YEAR} to {LAST_YEAR}")
        return dt.date(year, fields["M"], fields["D"])
    except TrajectoryError:
        raise
    except (ValueError, KeyError, OverflowError):
        raise TrajectoryError(f"{name}: {text!r} is not a date in the order {order}") from None


def _of_day_ns(text: str, name: str) -> int:
    match = CLOCK.fullmatch(text)
    if match is None:
        raise TrajectoryError(f"{name}: {text!r} is not a time of day; hh:mm:ss is expected")
    return (int(match[1]) * 60 + int(match[2])) * 60 * SECOND_NS + round(float(match[3]) * SECOND_NS)
