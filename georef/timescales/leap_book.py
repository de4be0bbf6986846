"""GPS − UTC as far as anybody has said it: the receivers, a second 23:59:60 seen, the configuration, the table."""

from __future__ import annotations

import datetime as dt
from dataclasses import dataclass
from typing import NamedTuple

from georef.records import TimeScale, TimeTag
from georef.timescales.gps_time import DAY_NS, gps_ns_from_week, table_leap_seconds, utc_from_gps
from georef.timescales.labelling import LeapTrust


class LeapSeconds(NamedTuple):
    """A leap count and where it comes from: receiver, second_60, configured, table or guess."""

    seconds: int
    origin: str

    @property
    def trust(self) -> LeapTrust:
        """How far a label may rest on it. A configured count that the table contradicts is no more than a guess."""
        if self.origin in ("receiver", "second_60"):
            return LeapTrust.SAID
        return LeapTrust.GUESSED if self.origin == "guess" else LeapTrust.ASSUMED


@dataclass(frozen=True, slots=True)
class LeapChange:
    """A receiver said another count than the one in use (before). said_before: a receiver had said that one, too."""

    source: str
    before: int
    now: int
    said_before: bool


class LeapBook:
    """Who said which leap count."""

    def __init__(self, assumed: int | None) -> None:
        self.assumed = assumed
        self._date: dt.date | None = None  # of the latest message that had one: what is assumed goes by it
        self._said: dict[str, int] = {}
        self._inserted: dict[str, tuple[dt.date, int]] = {}  # source: first day of the new count, the count

    def on(self, source: str, date: dt.date) -> LeapSeconds:
        """The count for a UTC message of a source on a date; source "": as far as anybody knows."""
        inserted = self._inserted.get(source)
        if inserted is None and not source:
            inserted = next(iter(self._inserted.values()), None)
        if inserted is not None and date >= inserted[0]:
            return LeapSeconds(inserted[1], "second_60")
        return self._without_insertion(source, date)

    def _without_insertion(self, source: str, date: dt.date) -> LeapSeconds:
        said = self._said.get(source, next(iter(self._said.values()), None))
        if said is not None:
            return LeapSeconds(said, "receiver")
        seconds, known = table_leap_seconds(date)
        if self.assumed is not None:
            plausible = self.assumed == seconds if known else self.assumed >= seconds
            return LeapSeconds(self.assumed, "configured" if plausible else "guess")
        return LeapSeconds(seconds, "table" if known else "guess")

    def hear(self, source: str, tag: TimeTag) -> LeapChange | None:
        """Note what a tag says about leap seconds; the change, where it differs from what was in use."""
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
        return LeapChange(source, before.seconds, said, said_before)

    def _note_date(self, tag: TimeTag) -> None:
        """A leap count is often said without a date (NAV-TIMELS), also in a recording of years ago."""
        if tag.scale is TimeScale.GPS and tag.week is not None:
            leap = table_leap_seconds(dt.date.max)[0]  # of years ago there were fewer: no other date but at midnight
            self._date = utc_from_gps(gps_ns_from_week(tag.week, tag.time_ns), leap)[0]
        elif tag.date is not None:
            self._date = tag.date

    def _latest(self, source: str) -> LeapSeconds:
        inserted = self._inserted.get(source)
        return LeapSeconds(inserted[1], "second_60") if inserted else self._without_insertion(source, dt.date.max)

    def _see_second_60(self, source: str, date: dt.date, said: int | None) -> None:
        """A second 23:59:60 on the last day of a month: from the next day on there is one more."""
        next_day = date + dt.timedelta(days=1)
        if next_day.day == 1 and source not in self._inserted:
            before = said if said is not None else self._without_insertion(source, date).seconds
            self._inserted[source] = (next_day, before + 1)
