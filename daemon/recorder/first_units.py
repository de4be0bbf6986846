"""Checks once, from the first bytes of each device, whether the device uses the configured protocol.

The recorder writes any bytes that arrive; a wrong protocol must be noticed before the end of the flight.
"""

from __future__ import annotations

import threading
import time

from swath.daemon.config import DeviceEntry
from swath.daemon.devices.identify import Heard, not_understood
from swath.drivers.driver import find_driver
from swath.drivers.transports.base import UnitBlock
from swath.georef.arrays import Int64Array
from swath.georef.records import ChunkBatch

JUDGED_BYTES = 64 * 1024  # several messages of every protocol
JUDGED_AFTER_S = 10.0  # a slow device has sent several messages by then, and the start of the recording is over


class FirstUnits:
    """The first units of one device, kept until they are judged.

    A receive thread adds units and another thread takes them; after that no more are kept.
    """

    def __init__(self, entry: DeviceEntry) -> None:
        self.entry = entry
        self._kept: list[ChunkBatch] = []
        self._bytes = 0
        self._first_s: float | None = None
        self._closed = False
        self._lock = threading.Lock()

    def add(self, log_time_ns: Int64Array, block: UnitBlock) -> None:
        """Keep units as long as they are needed."""
        if self._closed:
            return
        room = max(1, (JUDGED_BYTES - self._bytes) // max(1, block.units.shape[1]))
        with self._lock:
            self._kept.append(ChunkBatch(self.entry.source, log_time_ns[:room], block.units[:room].copy()))
            self._bytes += self._kept[-1].units.size
            self._first_s = self._first_s or time.monotonic()
            self._closed = self._bytes >= JUDGED_BYTES

    def take(self) -> list[ChunkBatch] | None:
        """Return the units to judge, once; return None before enough have arrived, and ever after."""
        with self._lock:
            waited = self._first_s is not None and time.monotonic() - self._first_s >= JUDGED_AFTER_S
            if not self._kept or not waited:
                return None
            self._closed = True
            kept, self._kept = self._kept, []
            return kept


def judge(entry: DeviceEntry, kept: list[ChunkBatch]) -> str | None:
    """Return a description of the mismatch if a device does not use the configured protocol; None if it does."""
    parser = find_driver(entry.kind, entry.protocol).make_parser(entry.settings)
    heard = Heard()
    for batch in kept:
        heard.add(parser.feed_batch(batch))
    heard.add(parser.close())
    counters = parser.counters
    messages = counters.messages.total()  # a receiver that is understood may be silent about time until it has a fix
    remarks = [] if messages else parser.remarks()
    return not_understood(entry, heard, messages, kept, refused=counters.bad_messages, remarks=remarks)
