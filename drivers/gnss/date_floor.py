"""Interprets a receiver's dates: roll-overs of the 10-bit week, the oldest accepted date, and implied leap counts.

A receiver whose firmware is one roll-over behind reports a week that is 1024 too small. Such a date is moved 1024 weeks
later where the setting ``add_weeks`` asks for it, or where the host's clock, which stamped the bytes, shows the moved
day to within one day: no other error of either is exactly that large. Any other date before the floor is refused. The
default floor catches a roll-over on all days until 2028-08-16 (2009-01-01 plus 1024 weeks); later the setting
``date_floor`` moves it. The floor is not the build date, so that older recordings can be read.
"""

from __future__ import annotations

import datetime as dt

from swath.drivers.parser import DeviceSettings, DriverSettingsError

DEFAULT_DATE_FLOOR = dt.date(2009, 1, 1)
GPS_EPOCH = dt.date(1980, 1, 6)
UNIX_EPOCH = dt.date(1970, 1, 1)
ROLLOVER_WEEKS = 1024
ROLLOVER_DAYS = 7 * ROLLOVER_WEEKS
HOST_DAY_TOLERANCE = 1  # a host's clock may keep local time
DAY_NS = 86_400_000_000_000
WEEK_MS = 604_800_000
GREATEST_WEEK = 8191  # 13 bits in the modern navigation message, to the year 2137
GREATEST_LEAP_S = 60  # largest GPS − UTC that a message's own two times may imply; more is another error


def read_date_floor(settings: DeviceSettings) -> dt.date:
    """Read the setting ``date_floor``, a date or its text.

    Raises:
        DriverSettingsError: the setting is not a date.
    """
    value = settings.config.get("date_floor")
    if value is None:
        return DEFAULT_DATE_FLOOR
    if isinstance(value, dt.date):
        return value
    try:
        return dt.date.fromisoformat(value)
    except (TypeError, ValueError):
        raise DriverSettingsError(f"date_floor: {value!r} is not a date; want a date such as 2009-01-01") from None


def week_of(date: dt.date) -> int:
    """Return the full GPS week that contains a date."""
    return (date - GPS_EPOCH).days // 7


class ReceiverDates:
    """Moves a receiver's dates and weeks by the roll-overs that it is behind, and remembers refused dates.

    Attributes:
        floor: the oldest accepted date, after the move.
        floor_week: its GPS week.
    """

    def __init__(self, settings: DeviceSettings) -> None:
        """Read ``date_floor`` and ``add_weeks``.

        Raises:
            DriverSettingsError: ``date_floor`` is not a date, or ``add_weeks`` is not a multiple of 1024.
        """
        self.floor = read_date_floor(settings)
        self.floor_week = week_of(self.floor)
        self._name = settings.source.partition("/")[2] or "NAME"
        self._source = settings.source
        self._is_head = settings.source.startswith("scanner/")  # a head passes on a receiver's date, without such keys
        weeks = settings.config.get("add_weeks") or 0
        if not isinstance(weeks, int) or weeks % ROLLOVER_WEEKS or weeks < 0:
            raise DriverSettingsError(f"add_weeks: got {weeks!r}, want a multiple of {ROLLOVER_WEEKS}")
        self._add_weeks = weeks
        self._moved: tuple[dt.date, dt.date] | None = None  # the first moved date, as reported and as moved
        self._refused: tuple[dt.date, dt.date] | None = None  # the first refused date, as reported, and the host's date
        self._latest: tuple[dt.date | int, int, dt.date | int] | None = None  # as reported, host's day, as accepted

    def date(self, sent: dt.date, host_time_ns: int) -> dt.date:
        """Return a receiver's date after the move by roll-overs; compare it with `floor`."""
        latest = self._latest
        if latest is None or latest[0] != sent or latest[1] != host_time_ns // DAY_NS:
            latest = self._latest = sent, host_time_ns // DAY_NS, self._date(sent, host_time_ns)
        assert isinstance(latest[2], dt.date)
        return latest[2]

    def week(self, sent: int, host_time_ns: int) -> int:
        """Return a receiver's GPS week after the move by roll-overs; compare it with `floor_week`."""
        latest = self._latest
        if latest is None or latest[0] != sent or latest[1] != host_time_ns // DAY_NS:
            latest = self._latest = sent, host_time_ns // DAY_NS, self._week(sent, host_time_ns)
        assert isinstance(latest[2], int)
        return latest[2]

    def _date(self, sent: dt.date, host_time_ns: int) -> dt.date:
        host = UNIX_EPOCH + dt.timedelta(days=min(max(host_time_ns // DAY_NS, 0), 100_000))
        days = 7 * self._add_weeks
        if not days:
            behind = round((host - sent).days / ROLLOVER_DAYS)
            if behind > 0 and abs((host - sent).days - behind * ROLLOVER_DAYS) <= HOST_DAY_TOLERANCE:
                days = behind * ROLLOVER_DAYS
        if days and sent.toordinal() + days <= dt.date.max.toordinal():
            taken = sent + dt.timedelta(days=days)
            self._moved = self._moved or (sent, taken)
            return taken
        if sent < self.floor and self._refused is None:
            self._refused = sent, host
        return sent

    def _week(self, sent: int, host_time_ns: int) -> int:
        if sent <= 0 or sent > week_of(dt.date.max) - 1:
            return sent
        middle = GPS_EPOCH + dt.timedelta(days=7 * sent + 3)  # the host's day may be any day of the week
        host = UNIX_EPOCH + dt.timedelta(days=min(max(host_time_ns // DAY_NS, 0), 100_000))
        weeks = self._add_weeks
        if not weeks:
            behind = round((week_of(host) - sent) / ROLLOVER_WEEKS)
            apart = (host - middle).days - behind * ROLLOVER_DAYS
            if behind > 0 and abs(apart) <= 3 + HOST_DAY_TOLERANCE:
                weeks = behind * ROLLOVER_WEEKS
        first = GPS_EPOCH + dt.timedelta(days=7 * sent)
        if weeks:
            self._moved = self._moved or (first, GPS_EPOCH + dt.timedelta(days=7 * (sent + weeks)))
            return sent + weeks
        if sent < self.floor_week and self._refused is None:
            self._refused = first, host
        return sent

    def remarks(self) -> list[str]:
        """Return lines for the user about moved dates, with the reason, and about refused dates, with the remedy."""
        lines = []
        if self._moved is not None:
            sent, taken = self._moved
            behind = (taken - sent).days // ROLLOVER_DAYS
            why = "gnss.….add_weeks is set" if self._add_weeks else "the host clock shows that date"
            lines.append(
                f"{self._source}: sends the date {sent}, {behind} roll-over{'s' if behind > 1 else ''} of "
                f"{ROLLOVER_WEEKS} weeks behind; corrected to {taken}, because {why}"
            )
        if self._refused is not None:
            sent, host = self._refused
            later = sent + dt.timedelta(days=ROLLOVER_DAYS)
            floor = "" if self._is_head else f" (gnss.{self._name}.date_floor)"
            remedy = f"if so, set gnss.{self._name}.add_weeks = {ROLLOVER_WEEKS}; otherwise set an older date_floor"
            if self._is_head:
                remedy = "connect a receiver with the right date to the head, or record a receiver"
            lines.append(
                f"{self._source}: sends the date {sent}, before {self.floor}{floor}: probably one roll-over of "
                f"{ROLLOVER_WEEKS} weeks behind (then {later}; the host clock shows {host}); {remedy}"
            )
        return lines


def leap_seconds_of(date: dt.date, of_day_ms: int, itow_ms: int) -> int | None:
    """Return GPS − UTC in s, as implied by the UTC and the GPS time of week in one message.

    None where they are not whole seconds apart to 1 ms, or differ by more than `GREATEST_LEAP_S`.
    """
    week_ms = ((date - GPS_EPOCH).days % 7) * 86_400_000 + of_day_ms
    ahead_ms = (itow_ms - week_ms + WEEK_MS // 2) % WEEK_MS - WEEK_MS // 2
    leap = round(ahead_ms / 1000)
    return leap if abs(ahead_ms - leap * 1000) <= 1 and abs(leap) <= GREATEST_LEAP_S else None
