"""Compare a receiver's time with the clock of the computer that recorded it: a time zone off, or days.

The result decides nothing, and a receiver's time is used unchanged: the computer's clock may be the wrong one.
"""

from __future__ import annotations

import datetime as dt
from collections import deque

import numpy as np

from swath.georef.records import TimeMessage, TimeTag
from swath.georef.timescales.gps_time import (
    DAY_NS,
    GPS_EPOCH,
    SECOND_NS,
    gps_ns_from_unix,
    nearest_gps_ns,
    table_leap_seconds,
    whole_gps_ns,
)

LEAST_MESSAGES = 10
LIVE_MESSAGES = 60  # number of messages in a comparison during recording
ALIKE_S = 2.0  # messages' delays differ by less than this …
ALIKE_SHARE = 0.8  # … for at least this share of them
APART_S = 30.0  # smaller differences are delays, or leap seconds, which other modules judge
ZONES_S = 14 * 3600.0  # the farthest time zone from UTC
HALF_HOUR_S = 1800.0
ROUND_WITHIN_S = 60.0  # tolerance from whole half hours or days, for a clock that was set but is not disciplined
DAY_S = 86_400.0


def ahead_s(tag: TimeTag, wall_ns: int) -> float | None:
    """Return the seconds by which a device's time is ahead of a wall clock (Unix ns); None if it cannot be placed.

    A time of day or of week alone is taken as the nearest such time.
    """
    day = GPS_EPOCH.toordinal() + gps_ns_from_unix(wall_ns, 0) // DAY_NS
    if not 1 <= day <= dt.date.max.toordinal():
        return None
    leap_seconds = table_leap_seconds(dt.date.fromordinal(day))[0]
    wall_gps_ns = gps_ns_from_unix(wall_ns, leap_seconds)
    gps_ns = whole_gps_ns(tag, leap_seconds)
    if gps_ns is None:
        gps_ns = nearest_gps_ns(tag, wall_gps_ns, leap_seconds)
    return None if gps_ns is None else (gps_ns - wall_gps_ns) / SECOND_NS


def distance_text(ahead: float, *, kept: bool, clock: str) -> str:
    """Return the meaning of a difference and its remedy, for the user; empty if it is negligible or meaningless.

    Args:
        ahead: s, of the receiver's time against the computer's clock.
        kept: whether the clock is disciplined (chrony). Another clock's difference means something only at whole half
            hours or days.
        clock: its name, as ``this computer's clock``.
    """
    size = abs(ahead)
    zone = size <= ZONES_S + ROUND_WITHIN_S and _is_round(size, HALF_HOUR_S)
    if size < APART_S or not (kept or zone or _is_round(size, DAY_S)):
        return ""
    if zone:
        apart, why = f"{round(size / HALF_HOUR_S) / 2:g} h", "as a wrong time zone would cause; set the receiver to UTC"
    elif size < DAY_S:
        apart, why = (f"{size / 60:.0f} min" if size >= 120 else f"{size:.0f} s"), "correct the receiver"
    else:
        days = round(size / DAY_S) if _is_round(size, DAY_S) else round(size / DAY_S, 1)
        apart = f"{days:,} day{'' if days == 1 else 's'}"
        why = "as an old date would cause; restart or correct the receiver"
    side = "ahead of" if ahead > 0 else "behind"
    keeper = " (kept by a time server or receiver)" if kept else ""
    return (
        f"its time is {apart} {side} {clock}{keeper}, {why}, or that clock (timedatectl); the receiver's time is used "
        "unchanged"
    )


def _is_round(size_s: float, unit_s: float) -> bool:
    whole = round(size_s / unit_s)
    return whole > 0 and abs(size_s - whole * unit_s) <= ROUND_WITHIN_S


class WallComparison:
    """Collects the differences between receivers' times and the computer's clock.

    Args:
        clock: name of the computer's clock, for the user.
        whole_log: whether all messages count, instead of the latest alone.
    """

    def __init__(self, clock: str, *, whole_log: bool = False) -> None:
        self._clock = clock
        self._length = None if whole_log else LIVE_MESSAGES
        self._step_ns = 0
        self._kept = False
        self._heard: dict[str, deque[tuple[float, bool]]] = {}  # s ahead, whether the clock was disciplined

    def set_wall(self, step_ns: int, *, kept: bool) -> None:
        """Take a reading of the wall clock: its step against host time since the session began, and its discipline."""
        self._step_ns, self._kept = step_ns, kept

    def hear(self, source: str, message: TimeMessage) -> None:
        """Take a time message, at its host time."""
        if not message.valid:
            return
        ahead = ahead_s(message.time, message.host_time_ns + self._step_ns)
        if ahead is not None:
            self._heard.setdefault(source, deque(maxlen=self._length)).append((ahead, self._kept))

    def verdict(self, source: str) -> str:
        """Return the meaning of a receiver's difference, see `distance_text`; empty if it is negligible or unknown."""
        heard = self._heard.get(source, ())
        by_kept = [ahead for ahead, kept in heard if kept]
        kept = len(by_kept) >= LEAST_MESSAGES
        values = np.array(by_kept if kept else [ahead for ahead, _ in heard])
        if len(values) < LEAST_MESSAGES:
            return ""
        middle = float(np.median(values))
        if np.mean(np.abs(values - middle) <= ALIKE_S) < ALIKE_SHARE:
            return ""
        return distance_text(middle, kept=kept, clock=self._clock)

    def lines(self) -> list[str]:
        """Return a line for each receiver whose time is far from the computer's clock."""
        return [f"{source}: {text}" for source in sorted(self._heard) if (text := self.verdict(source))]
