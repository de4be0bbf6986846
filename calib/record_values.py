"""Values of a calibration record: what an attribute may hold, and how large matrices are told."""

from __future__ import annotations

import datetime as dt
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from georef.timescales.gps_time import GPS_EPOCH, SECOND_NS, table_leap_seconds

FloatArray = NDArray[np.float64]

INLINE = 400  # numbers a matrix may have to stand in the record itself


@dataclass(frozen=True, eq=False)
class Matrix:
    """Rows and columns of numbers.

    Attributes:
        array: (rows, columns) as kept.
        rows: that there are; more than kept where only every k-th row is.
        every: k.
    """

    array: FloatArray
    rows: int
    every: int = 1

    @classmethod
    def of(cls, array: FloatArray) -> Matrix:
        """All of it."""
        table = np.atleast_2d(np.asarray(array, np.float64))
        return cls(table, len(table))

    @property
    def inline(self) -> bool:
        """Small enough to stand in the record."""
        return self.array.size <= INLINE and self.every == 1 and bool(np.isfinite(self.array).all())


Plain: TypeAlias = str | int | float | tuple[float, ...]


@dataclass(frozen=True, eq=False)
class Value:
    """What an attribute holds.

    Attributes:
        content: text, a number, numbers, or a matrix.
        unit: of numbers; empty: none.
        note: how it is to be read.
    """

    content: Plain | Matrix
    unit: str = ""
    note: str = ""


def utc_text(gps_ns: int) -> str:
    """ISO 8601 of a GPS time, microseconds."""
    day = GPS_EPOCH + dt.timedelta(days=gps_ns // (86_400 * SECOND_NS))
    leap_seconds, _ = table_leap_seconds(day)
    start = dt.datetime(GPS_EPOCH.year, GPS_EPOCH.month, GPS_EPOCH.day, tzinfo=dt.UTC)
    moment = start + dt.timedelta(microseconds=gps_ns // 1000) - dt.timedelta(seconds=leap_seconds)
    return moment.isoformat().replace("+00:00", "Z")
