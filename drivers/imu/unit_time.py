"""GPS time of inertial units that have a receiver: a message's time, and the second that it names."""

from __future__ import annotations

from typing import NamedTuple

from swath.drivers.gnss.date_floor import GREATEST_WEEK, read_date_floor, week_of
from swath.drivers.parser import DeviceSettings, ParserCounters
from swath.georef.records import NamesEdge, TimeMessage, TimeScale, TimeTag
from swath.georef.timescales.gps_time import SECOND_NS

WEEK_NS = 604_800 * SECOND_NS
LATEST_IN_SECOND_NS = SECOND_NS // 2  # a message later in its second may arrive in the next one


class Moment(NamedTuple):
    """GPS time of a message: full week, nanoseconds of the week, and whether the unit vouches for it."""

    week: int
    tow_ns: int
    valid: bool

    @property
    def gps_ns(self) -> int:
        """Nanoseconds since the GPS epoch."""
        return self.week * WEEK_NS + self.tow_ns

    @property
    def tag(self) -> TimeTag:
        """The time as a tag."""
        return TimeTag(TimeScale.GPS, self.tow_ns, week=self.week)


class UnitTime:
    """Checks a unit's GPS times and makes time messages of them, one for each second.

    Args:
        settings: of the device's table, ``date_floor`` is read.
        counters: the parser's counters.
        message: name of the time messages.
    """

    def __init__(self, settings: DeviceSettings, counters: ParserCounters, message: str) -> None:
        self._errors = counters.errors
        self._floor_week = week_of(read_date_floor(settings))
        self._message = message
        self._second: int | None = None

    def moment(self, week: int, tow_ns: int, *, valid: bool) -> Moment | None:
        """Return a message's time; None where it is impossible, or before the date floor, which is counted."""
        if not 0 <= tow_ns < WEEK_NS or not 0 < week <= GREATEST_WEEK:
            return None
        if week < self._floor_week:
            self._errors["date_before_floor"] += 1
            return None
        return Moment(week, tow_ns, valid)

    def name_second(self, host_time_ns: int, moment: Moment | None, leap_seconds: int | None) -> list[TimeMessage]:
        """Return the second of the first message in it; its edge is the one before the arrival."""
        if moment is None or moment.tow_ns % SECOND_NS >= LATEST_IN_SECOND_NS:
            return []
        second = moment.gps_ns // SECOND_NS
        if second == self._second:
            return []
        self._second = second
        time_ns = moment.tow_ns // SECOND_NS * SECOND_NS
        tag = TimeTag(TimeScale.GPS, time_ns, week=moment.week, leap_seconds=leap_seconds)
        return [TimeMessage(host_time_ns, tag, NamesEdge.PREVIOUS, valid=moment.valid, message=self._message)]
