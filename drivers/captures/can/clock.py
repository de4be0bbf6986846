"""Tells the times of logs whose times count from a beginning, or are local times without a zone."""

from __future__ import annotations

import datetime as dt
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

from swath.drivers.transports.base import TransportError

_UNIX = dt.datetime(1970, 1, 1, tzinfo=dt.UTC)
_MICROSECOND = dt.timedelta(microseconds=1)


def local_time(
    year: int, month: int, day: int, hour: int = 0, minute: int = 0, second: int = 0, microsecond: int = 0
) -> dt.datetime:
    """Return a local time without a zone, which `FileClock` gives it.

    Raises:
        ValueError: there is no such time.
    """
    return dt.datetime(year, month, day, hour, minute, second, microsecond)  # noqa: DTZ001  (the file names no zone)


class FileTime(Enum):
    """The times that a file tells."""

    UTC = "UTC"
    LOCAL = "local time without a zone"
    SINCE_BEGIN = "times since an unknown beginning"
    NONE = "no times"


@dataclass(frozen=True, slots=True)
class FileClock:
    """Holds what the user knows of a file's times.

    Attributes:
        start_ns: the time at which the file's own times are 0, nanoseconds since 1970; None: as the file tells.
        zone: the zone of its local times.
    """

    start_ns: int | None = None
    zone: dt.tzinfo = dt.UTC

    def begin(self, told: dt.datetime | None, path: Path) -> int:
        """Return the time at which a file's times are 0, nanoseconds since 1970.

        Args:
            told: the local time that the file tells, if any.
            path: of the file.

        Raises:
            TransportError: neither the file nor the user tells it.
        """
        if self.start_ns is not None:
            return self.start_ns
        if told is None:
            raise TransportError(f"{path}: does not tell when it begins; want its start")
        return self.unix_ns(told)

    def unix_ns(self, local: dt.datetime) -> int:
        """Return nanoseconds since 1970 of a local time without a zone."""
        return (local.replace(tzinfo=self.zone) - _UNIX) // _MICROSECOND * 1000


def decimal_ns(text: str, unit_ns: int = 1_000_000_000) -> int:
    """Return nanoseconds of a decimal number of a unit, without rounding through a float; raises ValueError."""
    whole, _, fraction = text.partition(".")
    if not (whole + fraction).isdecimal() or len(whole) > 12 or len(fraction) > 15 or not text.isascii():
        raise ValueError(f"{text[:20]} is not a time")
    digits = int(fraction) * unit_ns // 10 ** len(fraction) if fraction else 0
    return int(whole or "0") * unit_ns + digits
