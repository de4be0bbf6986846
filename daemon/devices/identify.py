"""Identifies a device by its bytes: counts of records, its time, and the protocol that the bytes really follow."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from swath.daemon.config import CorrectionsConfig, DeviceEntry, DeviceTable, GnssConfig, ImuConfig, ScannerConfig
from swath.drivers.driver import RAW, all_drivers, find_driver
from swath.drivers.parser import DeviceKind, DeviceSettings, DriverSettingsError
from swath.georef.records import ChunkBatch, DeviceClockSamples, ImuSamples, Record, TimeMessage, TimeTag

LEAST_MESSAGES = 2  # a single frame may be chance
LEAST_CLOCK_SPAN_NS = 500_000_000  # too short a span gives no rate of a counter
IDENTITY = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]


@dataclass(slots=True)
class Heard:
    """Counts of a device's records, with the state of its time.

    Attributes:
        counts: by type; rows, if they come in batches.
        time_messages: number of messages with a time.
        valid_time: the last one that the device marked as valid.
        sees_pps: latest report of the device that it has latched a PPS or is locked to it; None if it does not report
            this.
        imu_clock: host and device time of the first and of the last inertial sample since the counter last went back.
        stamp: host and device time of the latest sample of a scanner's clock, ns since 1970 and as the head counts.
    """

    counts: Counter[str] = field(default_factory=Counter)
    time_messages: int = 0
    valid_time: TimeMessage | None = None
    sees_pps: bool | None = None
    imu_clock: tuple[tuple[int, int], tuple[int, int]] | None = None
    stamp: tuple[int, int] | None = None

    def add(self, records: list[Record]) -> None:
        """Count records and keep the state of the device's time."""
        for record in records:
            rows = getattr(record, "rows", None)
            self.counts[type(record).__name__] += 1 if rows is None else len(rows)
            if isinstance(record, TimeMessage):
                self.time_messages += 1
                self.valid_time = record if record.valid else self.valid_time
            elif isinstance(record, DeviceClockSamples):
                self._add_clock(record)
            elif isinstance(record, ImuSamples):
                self._add_imu_clock(record)

    @property
    def imu_clock_rate(self) -> float | None:
        """Seconds of the device's counter for each second of the host; None without a counter, or with too
        little data.
        """
        if self.imu_clock is None:
            return None
        (first_host, first_device), (last_host, last_device) = self.imu_clock
        span_ns = last_host - first_host
        return (last_device - first_device) / span_ns if span_ns >= LEAST_CLOCK_SPAN_NS else None

    def _add_imu_clock(self, record: ImuSamples) -> None:
        rows = record.rows[record.rows["device_time_ns"] >= 0]
        device_ns = rows["device_time_ns"]
        if not len(rows):
            return
        pairs = list(zip(rows["host_time_ns"].tolist(), device_ns.tolist(), strict=True))
        began_again = np.flatnonzero(device_ns[1:] < device_ns[:-1])
        if len(began_again):
            first = pairs[began_again[-1] + 1]
        elif self.imu_clock is not None and pairs[0][1] >= self.imu_clock[1][1]:
            first = self.imu_clock[0]
        else:
            first = pairs[0]
        self.imu_clock = (first, pairs[-1])

    def _add_clock(self, record: DeviceClockSamples) -> None:
        rows = record.rows
        if len(rows):
            self.stamp = int(rows["host_time_ns"][-1]), int(rows["device_time_ns"][-1])
        latched, locked = rows["pps_time_ns"] >= 0, rows["locked"]
        says = latched | (locked >= 0) | (rows["pps_count"] >= 0)
        if np.any(says):
            last = np.flatnonzero(says)[-1]
            self.sees_pps = bool(locked[last] == 1 or (locked[last] < 0 and latched[last]))


def describe_time(entry: DeviceEntry, heard: Heard) -> str:
    """Describe the device's time in a few words."""
    if heard.valid_time is not None:
        return f"{describe_tag(heard.valid_time.time)} ({heard.valid_time.message})"
    if heard.time_messages:
        return "not valid"
    if heard.sees_pps is not None and find_driver(entry.kind, entry.protocol).tells_pps:
        return "PPS seen" if heard.sees_pps else "no PPS"
    return "none" if entry.kind == "gnss" else ""


def describe_tag(tag: TimeTag) -> str:
    """Format a device's time as completely as it is given: ``2026-11-21 10:15:03 UTC``, ``GPS week 2443,
    555303.0 s``.
    """
    seconds = tag.time_ns * 1e-9
    if tag.scale == "gps":
        return f"GPS week {tag.week if tag.week is not None else '?'}, {seconds:.1f} s"
    whole = int(seconds)
    clock = f"{whole // 3600:02}:{whole // 60 % 60:02}:{whole % 60:02} UTC"
    return f"{tag.date} {clock}" if tag.date is not None else clock


def identify(entry: DeviceEntry, kept: list[ChunkBatch], than: int) -> str | None:
    """Return the protocol of the same kind that decodes most of the bytes, if the configured one decodes no records.

    Scanner heads whose packets do not differ are named together, as ``robosense-helios16p or robosense-helios32``.

    A parser that decodes records is preferred to one that only finds messages (receivers mix protocols on a port, and
    their parsers frame each other's messages); the latter must find more than ``than``, the count of the configured
    protocol. A driver that needs settings which only the right configuration has is tried by its probe, or left out.
    """
    found = recognise(entry.kind, entry.transport.text, kept, than=than, but=entry.protocol)
    return " or ".join(found.protocols) if found is not None else None


@dataclass(frozen=True, slots=True)
class Recognised:
    """The protocol that decodes most of some bytes, with its number of records and of messages; several if scanners of
    several protocols decode the same.
    """

    protocols: tuple[str, ...]
    records: int
    messages: int


def recognise(
    kind: DeviceKind, transport: str, kept: list[ChunkBatch], *, than: int = 0, but: str = ""
) -> Recognised | None:
    """Return the protocol of a kind that decodes most of the bytes, as `identify` has it; ``but`` is not tried."""
    best: tuple[str, ...] = ()
    most = (0, max(than, LEAST_MESSAGES - 1))
    for protocol, driver in all_drivers(kind).items():
        if protocol == but:
            continue
        try:
            parser = (driver.make_probe or driver.make_parser)(_default_settings(kind, transport, protocol))
        except DriverSettingsError:
            continue
        heard = Heard()
        for batch in kept:
            heard.add(parser.feed_batch(batch))
        heard.add(parser.close())
        found = (heard.counts.total(), parser.counters.messages.total())
        if found > most:
            best, most = (protocol,), found
        elif found == most and best and kind == "scanner":
            best += (protocol,)
    return Recognised(best, *most) if best else None


def not_understood(
    entry: DeviceEntry,
    heard: Heard,
    messages: int,
    kept: list[ChunkBatch],
    *,
    refused: int = 0,
    remarks: Sequence[str] = (),
) -> str | None:
    """Return a line if a device uses another protocol than the configured one, or no known protocol; None if it is
    understood.

    Args:
        entry: the device as configured.
        heard: records that the configured parser decoded from its bytes.
        messages: number of messages that the configured parser found in them.
        kept: the bytes, or the first of them.
        refused: number of messages that it could not decode. If they outnumber the good ones, the device counts as not
            understood: a head's second port may be readable although the head is another model, whose own port is not.
        remarks: of the configured parser on what it cannot read; they are better than a guess.
    """
    if entry.protocol == RAW or (messages and heard.counts and refused <= messages):
        return None
    other = identify(entry, kept, than=messages)
    if other is not None:
        return f"sends {other}, but {entry.protocol} is configured"
    if remarks and not heard.counts:
        return "; ".join(line.removeprefix(f"{entry.source}: ") for line in remarks)
    if messages:
        return None
    hint = {"serial": "; check the baud rate", "tcp": "; check the port number"}.get(entry.transport.kind, "")
    return f"its data are neither {entry.protocol} nor another known {entry.kind} protocol{hint}"


def _default_settings(kind: DeviceKind, transport: str, protocol: str) -> DeviceSettings:
    """Return settings of a device of which only the protocol is known; values that framing does not need are
    placeholders.
    """
    table: DeviceTable
    if kind == "gnss":
        table = GnssConfig(transport=transport, protocol=protocol)
    elif kind == "imu":
        table = ImuConfig(transport=transport, protocol=protocol, tick_hz=1_000_000.0)
    elif kind == "corrections":
        table = CorrectionsConfig(transport=transport, protocol=protocol)
    else:
        table = ScannerConfig(transport=transport, protocol=protocol, mirror_factor=1.0, installation=IDENTITY)
    return DeviceSettings(f"{kind}/unnamed", table.model_dump())
