"""GPS − UTC from all sources: receivers, an observed second 23:59:60, the configuration, the table."""

from __future__ import annotations

import datetime as dt
from dataclasses import dataclass
from typing import NamedTuple

from swath.georef.records import TimeScale, TimeTag
from swath.georef.timescales.gps_time import (
    DAY_NS,
    LEAP_TABLE_VALID_UNTIL,
    gps_ns_from_week,
    table_leap_seconds,
    utc_from_gps,
)
from swath.georef.timescales.labelling import LeapTrust

GUESS_SIGMA_S = 1.0  # of a count beyond the table, in its first years: leap seconds came every two years on average
YEARS_A_LEAP_SECOND = 2
DAYS_A_YEAR = 365.25


class LeapSeconds(NamedTuple):
    """A leap count, its origin (receiver, second_60, configured, table or guess) and the possible error of a guess.

    sigma_s: one sigma of a guess; 0 for a known count.
    """

    seconds: int
    origin: str
    sigma_s: float = 0.0

    @property
    def trust(self) -> LeapTrust:
        """The trust that a label may place in it. A configured count that the table contradicts is only a guess."""
        if self.origin in ("receiver", "second_60"):
            return LeapTrust.SAID
        return LeapTrust.GUESSED if self.origin == "guess" else LeapTrust.ASSUMED


@dataclass(frozen=True, slots=True)
class LeapChange:
    """A receiver gave another count than the one in use (before). said_before: a receiver had given that one too.

    stale: by the table not a count of that date: an old one of its firmware, which holds for its own messages alone.
    """

    source: str
    before: int
    now: int
    said_before: bool
    stale: bool = False


def is_stale(seconds: int, date: dt.date) -> bool:
    """Return True if a count cannot be right on a UTC date (or the days beside it), as far as the table reaches."""
    count, known = table_leap_seconds(date)
    if not known:
        return abs(seconds - count) > 1 + _years_beyond_table(date) // YEARS_A_LEAP_SECOND
    return seconds not in {table_leap_seconds(date + dt.timedelta(days=days))[0] for days in (-1, 0, 1)}


def _years_beyond_table(date: dt.date) -> int:
    return max(0, int((date - LEAP_TABLE_VALID_UNTIL).days / DAYS_A_YEAR))


class LeapBook:
    """The leap counts given by each source."""

    def __init__(self, assumed: int | None) -> None:
        self.assumed = assumed
        self._date: dt.date | None = None  # of the latest dated message, for which assumed counts are valid
        self._said: dict[str, int] = {}
        self._inserted: dict[str, tuple[dt.date, int]] = {}  # source: first day of the new count, the count

    def on(self, source: str, date: dt.date) -> LeapSeconds:
        """Return the count for a UTC message of a source on a date; source "": the best known."""
        inserted = self._inserted.get(source)
        if inserted is None and not source:
            inserted = next(iter(self._inserted.values()), None)
        if inserted is not None and date >= inserted[0]:
            return LeapSeconds(inserted[1], "second_60")
        return self._without_insertion(source, date)

    def _without_insertion(self, source: str, date: dt.date) -> LeapSeconds:
        said = self._said.get(source)
        if said is None:
            said = next((count for count in self._said.values() if not is_stale(count, date)), None)
        if said is not None:
            return LeapSeconds(said, "receiver")
        seconds, known = table_leap_seconds(date)
        beyond_s = 0.0 if known else GUESS_SIGMA_S + _years_beyond_table(date) // YEARS_A_LEAP_SECOND
        if self.assumed is None:
            return LeapSeconds(seconds, "table" if known else "guess", beyond_s)
        if self.assumed == seconds if known else self.assumed >= seconds:
            return LeapSeconds(self.assumed, "configured")
        return LeapSeconds(self.assumed, "guess", max(beyond_s, float(abs(self.assumed - seconds))))

    def guess_text(self) -> str:
        """Return why the count in use is only a guess, and the remedy; empty if it is known."""
        if self._date is None:
            return ""
        leap = self.on("", self._date)
        if leap.origin != "guess":
            return ""
        seconds, known = table_leap_seconds(self._date)
        if known:
            return (
                f"leap_seconds = {leap.seconds} is configured, and GPS − UTC was {seconds} s on {self._date}: "
                "leave gnss.….leap_seconds out"
            )
        remedy = f"set gnss.….leap_seconds (IERS Bulletin C), or let the receiver send it; {leap.seconds} s is a guess"
        return f"the built-in leap seconds end at {LEAP_TABLE_VALID_UNTIL}, and this is {self._date}: {remedy}"

    def hear(self, source: str, tag: TimeTag) -> LeapChange | None:
        """Note a tag's leap count and second 60; return the change if the count differs from the one in use."""
        if tag.scale is TimeScale.UTC and tag.date is not None and tag.time_ns >= DAY_NS:
            self._see_second_60(source, tag.date, tag.leap_seconds)
        self._note_date(tag)
        said = tag.leap_seconds
        if said is None or said == self._said.get(source):
            return None
        before = self.on(source, self._date) if self._date is not None else self._latest(source)
        said_before = source in self._said
        self._said[source] = said
        inserted = self._inserted.get(source)
        if inserted is not None and inserted[1] == said:
            del self._inserted[source]
            return None
        if before.seconds == said:
            return None
        stale = self._date is not None and is_stale(said, self._date)
        return LeapChange(source, before.seconds, said, said_before, stale)

    def _note_date(self, tag: TimeTag) -> None:
        """Note a tag's date, because leap counts often lack one (NAV-TIMELS), also in recordings of years ago."""
        if tag.scale is TimeScale.GPS and tag.week is not None:
            # years ago there were fewer, which changes the date only near midnight
            leap = table_leap_seconds(dt.date.max)[0]
            self._date = utc_from_gps(gps_ns_from_week(tag.week, tag.time_ns), leap)[0]
        elif tag.date is not None:
            self._date = tag.date

    def _latest(self, source: str) -> LeapSeconds:
        inserted = self._inserted.get(source)
        return LeapSeconds(inserted[1], "second_60") if inserted else self._without_insertion(source, dt.date.max)

    def _see_second_60(self, source: str, date: dt.date, said: int | None) -> None:
        """Note a second 23:59:60 on the last day of a month: from the next day on the count is larger by one."""
        next_day = date + dt.timedelta(days=1)
        if next_day.day == 1 and source not in self._inserted:
            before = said if said is not None else self._without_insertion(source, date).seconds
            self._inserted[source] = (next_day, before + 1)
