"""What a device says of itself: counts of records, its time, and which protocol its bytes really are."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from daemon.config import DeviceEntry, GnssConfig, ImuConfig, ScannerConfig
from drivers.core.parser import DeviceSettings, DriverSettingsError
from drivers.core.registry import all_drivers
from georef.records import ChunkBatch, DeviceClockSamples, Record, TimeMessage, TimeTag

LEAST_MESSAGES = 2  # one frame may be chance
IDENTITY = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]


@dataclass(slots=True)
class Heard:
    """Records of a device, counted.

    Attributes:
        counts: by type; rows, where they come in batches.
        time_messages: how many said a time.
        valid_time: the last one that the device vouches for.
        clock_rows: rows of the device's clock; clock_sees_pps: it has a PPS latched or says it is locked.
    """

    counts: Counter[str] = field(default_factory=Counter)
    time_messages: int = 0
    valid_time: TimeMessage | None = None
    clock_rows: int = 0
    clock_sees_pps: bool = False

    def add(self, records: list[Record]) -> None:
        """Count records."""
        for record in records:
            rows = getattr(record, "rows", None)
            self.counts[type(record).__name__] += 1 if rows is None else len(rows)
            if isinstance(record, TimeMessage):
                self.time_messages += 1
                self.valid_time = record if record.valid else self.valid_time
            elif isinstance(record, DeviceClockSamples):
                self.clock_rows += len(record.rows)
                latched = (record.rows["pps_time_ns"] >= 0) & (record.rows["locked"] != 0)
                self.clock_sees_pps |= bool(np.any(latched | (record.rows["locked"] == 1)))


def describe_time(entry: DeviceEntry, heard: Heard) -> str:
    """What the device says of its time, in a few words."""
    if heard.valid_time is not None:
        return f"{describe_tag(heard.valid_time.time)} ({heard.valid_time.message})"
    if heard.time_messages:
        return "not valid"
    if heard.clock_rows:
        return "PPS seen" if heard.clock_sees_pps else "no PPS"
    return "none" if entry.kind == "gnss" else ""


def describe_tag(tag: TimeTag) -> str:
    """A device's time as far as it says it: ``2026-11-21 10:15:03 UTC``, ``GPS week 2443, 555303.0 s``."""
    seconds = tag.time_ns * 1e-9
    if tag.scale == "gps":
        return f"GPS week {tag.week if tag.week is not None else '?'}, {seconds:.1f} s"
    whole = int(seconds)
    clock = f"{whole // 3600:02}:{whole // 60 % 60:02}:{whole % 60:02} UTC"
    return f"{tag.date} {clock}" if tag.date is not None else clock


def identify(entry: DeviceEntry, kept: list[ChunkBatch], than: int) -> str | None:
    """The protocol of the same kind whose parser finds most messages in the bytes, if more than ``than``.

    A driver that cannot work without settings that only the right configuration has is left out.
    """
    best, most = None, max(than, LEAST_MESSAGES - 1)
    for protocol, driver in all_drivers(entry.kind).items():
        if protocol == entry.protocol:
            continue
        try:
            parser = driver.make_parser(_default_settings(entry, protocol))
        except DriverSettingsError:
            continue
        for batch in kept:
            parser.feed_batch(batch)
        parser.close()
        found = parser.counters.messages.total()
        if found > most:
            best, most = protocol, found
    return best


def _default_settings(entry: DeviceEntry, protocol: str) -> DeviceSettings:
    """Settings of a device of which only the protocol is known; what frames need no value of ours is stood in for."""
    transport = entry.transport.text
    table: GnssConfig | ImuConfig | ScannerConfig
    if entry.kind == "gnss":
        table = GnssConfig(transport=transport, protocol=protocol)
    elif entry.kind == "imu":
        table = ImuConfig(transport=transport, protocol=protocol)
    else:
        table = ScannerConfig(transport=transport, protocol=protocol, mirror_factor=1.0, installation=IDENTITY)
    return DeviceSettings(entry.source, table.model_dump())
