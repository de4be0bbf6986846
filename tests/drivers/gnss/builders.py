"""Records of receivers that tests of several protocols select."""

from __future__ import annotations

from swath.georef.records import GnssFix, Record


def fixes(records: list[Record]) -> list[GnssFix]:
    """Return the fixes among records."""
    return [record for record in records if isinstance(record, GnssFix)]
