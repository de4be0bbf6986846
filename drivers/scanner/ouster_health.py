"""What an Ouster head says of itself in the headers of its lidar packets."""

from __future__ import annotations

import numpy as np

from swath.drivers.scanner.ouster.head import SYNC_PULSE
from swath.drivers.scanner.ouster.layout import HEALTH, LidarLayout
from swath.georef.records import DeviceStatus, Int64Array, StructArray


class HealthReader:
    """Tells a head's start, alerts and countdowns when they change, and what its metadata says beside them."""

    def __init__(self, layout: LidarLayout) -> None:
        self._layout = layout
        self._last: tuple[int, ...] | None = None

    def read(self, host_time_ns: Int64Array, packets: StructArray) -> list[DeviceStatus]:
        """One record a change in packets (n,), n at least 1, in order."""
        said = np.zeros((len(packets), 1 + len(HEALTH)), dtype=np.int64)
        said[:, 0] = self._layout.init_id(packets)
        if not self._layout.legacy:
            for place, name in enumerate(HEALTH, start=1):
                said[:, place] = packets[name]
        changes = np.flatnonzero((said[1:] != said[:-1]).any(axis=1)) + 1
        statuses = []
        for at in (0, *changes.tolist()):
            now = tuple(said[at].tolist())
            if now != self._last:
                self._last = now
                statuses.append(self._describe(int(host_time_ns[at]), now))
        return statuses

    def _describe(self, host_ns: int, said: tuple[int, ...]) -> DeviceStatus:
        head = self._layout.head
        values: dict[str, float | int | str | bool] = {
            "model": head.model,
            "profile": head.profile,
            "timestamp_mode": head.timestamp_mode or "unsaid",
        }
        if head.timestamp_mode == SYNC_PULSE:
            values["nmea_input"] = head.nmea_input
        if not self._layout.legacy:
            values["init_id"] = said[0]
            if head.init_id is not None:
                values["metadata_of_this_start"] = said[0] == head.init_id
            values |= dict(zip(HEALTH, said[1:], strict=True))
        return DeviceStatus(host_ns, values, message="lidar")
