"""Tells Ouster's lidar packets from others by their form alone, where a head's metadata is not at hand."""

from __future__ import annotations

import numpy as np

from swath.drivers.parser import DeviceSettings, PacketParser
from swath.drivers.scanner.ouster.layout import FOOTER_BYTES, HEADER_BYTES, LIDAR_PACKET
from swath.drivers.scanner.sequence import BoolArray
from swath.georef.records import ByteRows, Int64Array, Record

COLUMNS_PER_PACKET = 16  # "not user configurable", Firmware User Manual, Get the lidar data format
LEAST_BEAMS = 16
_ID_AT = 8  # in a column, all profiles


class OusterProbe(PacketParser):
    """Counts what looks like lidar packets; decodes nothing."""

    def __init__(self, settings: DeviceSettings) -> None:
        super().__init__()

    def parse_units(self, host_time_ns: Int64Array, units: ByteRows) -> list[Record]:
        """Count packets of equal length; see `PacketParser.parse_units`."""
        found = int(looks_like_lidar(units).sum())
        self.counters.bytes += units.size
        self.counters.bytes_framed += found * units.shape[1]
        self.counters.bytes_skipped += (len(units) - found) * units.shape[1]
        if found:
            self.counters.messages["lidar"] += found
        return []


def looks_like_lidar(units: ByteRows) -> BoolArray:
    """(n,) whether packets of one length are of sixteen columns, one behind the other.

    Args:
        units: (n, length).
    """
    length = units.shape[1]
    modern, legacy = length - HEADER_BYTES - FOOTER_BYTES, length
    found = np.zeros(len(units), dtype=np.bool_)
    if modern % COLUMNS_PER_PACKET == 0 and modern // COLUMNS_PER_PACKET >= 12 + 4 * LEAST_BEAMS:
        found |= (units[:, 0] == LIDAR_PACKET) & _counts_on(units, HEADER_BYTES, modern // COLUMNS_PER_PACKET)
    if legacy % COLUMNS_PER_PACKET == 0 and legacy // COLUMNS_PER_PACKET >= 20 + 12 * LEAST_BEAMS:
        found |= _counts_on(units, 0, legacy // COLUMNS_PER_PACKET)
    return found


def _counts_on(units: ByteRows, start: int, column_bytes: int) -> BoolArray:
    """(n,) whether the measurement ids of columns that begin at ``start`` are consecutive, from a multiple of 16 on."""
    at = start + _ID_AT + column_bytes * np.arange(COLUMNS_PER_PACKET)
    ids = units[:, at].astype(np.int64) + 256 * units[:, at + 1].astype(np.int64)
    steady: BoolArray = (np.diff(ids, axis=1) == 1).all(axis=1) & (ids[:, 0] % COLUMNS_PER_PACKET == 0)
    return steady
