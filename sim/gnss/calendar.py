"""The time stamps of a receiver: GPS week and time of week, UTC date and time of day."""

from __future__ import annotations

import datetime as dt
from dataclasses import dataclass

from swath.georef.timescales import utc_from_gps, week_from_gps
from swath.georef.timescales.gps_time import MILLISECOND_NS


@dataclass(frozen=True, slots=True)
class Stamp:
    """A moment on a whole millisecond of GPS time.

    Attributes:
        second: second of the plan if the moment is a whole second, else None.
        week, tow_ms: full GPS week and milliseconds of it.
        date, day_ns: UTC date and nanoseconds of that day.
    """

    second: int | None
    week: int
    tow_ms: int
    date: dt.date
    day_ns: int

    @property
    def clock(self) -> tuple[int, int, int]:
        """Hour, minute, and milliseconds of the minute, UTC."""
        minutes, ms = divmod(self.day_ns // MILLISECOND_NS, 60_000)
        return minutes // 60, minutes % 60, ms


@dataclass(frozen=True, slots=True)
class Calendar:
    """Converts a plan's time to stamps; holds the GPS time of the plan's start, and GPS − UTC."""

    start_gps_ns: int
    leap_seconds: int

    def at(self, time_s: float) -> Stamp:
        """Return the stamp of the millisecond nearest to a time."""
        since_ms = round(time_s * 1000.0)
        gps_ns = self.start_gps_ns + since_ms * MILLISECOND_NS
        week, tow_ns = week_from_gps(gps_ns)
        date, day_ns = utc_from_gps(gps_ns, self.leap_seconds)
        second = None if since_ms % 1000 else since_ms // 1000
        return Stamp(second, week, tow_ns // MILLISECOND_NS, date, day_ns)
