"""The oldest date believed: a receiver whose firmware is one roll-over of the 10-bit week behind says 1024 weeks less.

The default catches this for all days until 2028-08-16 (2009-01-01 plus 1024 weeks); later the setting ``date_floor``
of the device moves it. It is not the build date, so that older recordings can be read.
"""

from __future__ import annotations

import datetime as dt

from drivers.core.parser import DeviceSettings, DriverSettingsError

DEFAULT_DATE_FLOOR = dt.date(2009, 1, 1)
GPS_EPOCH = dt.date(1980, 1, 6)


def read_date_floor(settings: DeviceSettings) -> dt.date:
    """The setting ``date_floor``, a date or its text.

    Raises:
        DriverSettingsError: it is no date.
    """
    value = settings.config.get("date_floor")
    if value is None:
        return DEFAULT_DATE_FLOOR
    if isinstance(value, dt.date):
        return value
    try:
        return dt.date.fromisoformat(value)
    except (TypeError, ValueError):
        raise DriverSettingsError(f"date_floor: {value!r} is no date; right would be 2009-01-01") from None


def week_of(date: dt.date) -> int:
    """Full GPS week a date lies in."""
    return (date - GPS_EPOCH).days // 7
