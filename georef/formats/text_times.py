"""Dates, clock times and UTC in text files of trajectories."""

from __future__ import annotations

import datetime as dt
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from georef.records import Int64Array
from georef.timescales.gps_time import (
    DAY_NS,
    GPS_EPOCH,
    LEAP_TABLE_VALID_UNTIL,
    SECOND_NS,
    table_leap_seconds,
)
from georef.trajectory import TrajectoryError

FloatArray = NDArray[np.float64]


def gps_days(texts: Sequence[str], order: str, name: str) -> Int64Array:
    """(n,) days since the GPS epoch of dates like ``2026/11/22`` in an order like YMD; two-digit years are 20yy."""
    distinct, which = np.unique(np.asarray(texts), return_inverse=True)
    days = [_date(str(text), order, name).toordinal() - GPS_EPOCH.toordinal() for text in distinct]
    return np.asarray(days, dtype=np.int64)[which]


def clock_ns(texts: Sequence[str], name: str) -> Int64Array:
    """(n,) nanoseconds of the day of times like ``19:34:18.499``."""
    try:
        parts = [text.split(":") for text in texts]
        return np.array([(int(h) * 60 + int(m)) * 60 * SECOND_NS + _ns(s) for h, m, s in parts], dtype=np.int64)
    except ValueError:
        bad = next((text for text in texts if text.count(":") != 2), texts[0])
        raise TrajectoryError(f"{name}: {bad!r} is no time of day; hh:mm:ss is expected") from None


def gps_ns_of_day(days: Int64Array, of_day_ns: Int64Array) -> Int64Array:
    """(n,) GPS time of days since the GPS epoch and nanoseconds of the day, both in GPS time."""
    gps_ns: Int64Array = days * DAY_NS + of_day_ns
    return gps_ns


def leap_seconds_on(day: int, said: int | None, name: str) -> int:
    """GPS − UTC on a day since the GPS epoch: what was said, or the built-in table as far as it reaches."""
    if said is not None:
        return said
    date = GPS_EPOCH + dt.timedelta(days=int(day))
    leap, certain = table_leap_seconds(date)
    if not certain:
        raise TrajectoryError(
            f"{name}: its time is UTC, and leap seconds are known here until {LEAP_TABLE_VALID_UNTIL} only; "
            f"export it in GPS time"
        )
    return leap


def _date(text: str, order: str, name: str) -> dt.date:
    parts = text.replace("-", "/").replace(".", "/").split("/")
    try:
        fields = {letter: int(part) for letter, part in zip(order, parts, strict=True)}
        year = fields["Y"] + (2000 if fields["Y"] < 100 else 0)
        return dt.date(year, fields["M"], fields["D"])
    except (ValueError, KeyError):
        raise TrajectoryError(f"{name}: {text!r} is no date in the order {order}") from None


def _ns(seconds: str) -> int:
    return round(float(seconds) * SECOND_NS)
