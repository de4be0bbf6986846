"""Opens everything that a configuration names for some seconds and reports the answer and the faults of each device.

It writes and sends nothing, and listens as `swath.aio` does: to all wires at the same time.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import tempfile
from collections import Counter
from collections.abc import AsyncIterator, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from shutil import disk_usage
from typing import Any

import numpy as np

from swath.daemon.config import Config, DeviceEntry
from swath.daemon.devices.identify import Heard, describe_time, not_understood
from swath.daemon.devices.listening import Batch, Decoder, Listening
from swath.daemon.devices.values import Values
from swath.daemon.log.directory import nearest_there
from swath.daemon.log.host_clock import ClockDiscipline, read_clock_discipline
from swath.daemon.log.wires import mixed_text
from swath.drivers.driver import RAW, find_driver
from swath.drivers.guard import GuardedParser
from swath.drivers.listening import Listener
from swath.drivers.session import Session
from swath.drivers.transports.base import RawEdge, TransportCounters
from swath.drivers.transports.can.bitrate import interface_bitrate
from swath.drivers.transports.spec import TransportSpec
from swath.georef.records import ChunkBatch, Record, TimeMessage
from swath.georef.timescales import SECOND_NS, ahead_s, distance_text
from swath.georef.timescales.stamp_scale import ABSOLUTE_FROM_NS, NEVER_SET_S, date_text

KEPT_BYTES = 1 << 20  # of each wire, to identify a device that does not use the configured protocol
DAMAGED_SHARE = 0.01  # of the messages; a larger share is a fault of wire or settings, not chance
CLOCK_RATE_FACTOR = 5.0  # a counter faster or slower by this factor is read in the wrong unit
EDGE_SPACING_TOLERANCE_S = 0.05  # of a user-space stamp on a busy computer


@dataclass(slots=True)
class Report:
    """The result of checking one source.

    Attributes:
        source: ``kind/name``; ``/aux`` behind it for a head's second port; ``log`` for the log directory.
        opens: the device could be opened.
        bytes, units: received in the time.
        records: decoded records by type (rows, if they come in batches).
        time: the device's own time, as text.
        problems: faults, one line each.
        notes: remarks that are not faults.
        facts: what its values say, such as the fix and the specific force.
        doubts: values that a sound system that stands still does not have, one line each.
    """

    source: str
    protocol: str = ""
    opens: bool = False
    bytes: int = 0
    units: int = 0
    records: Counter[str] = field(default_factory=Counter)
    time: str = ""
    problems: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    facts: list[str] = field(default_factory=list)
    doubts: list[str] = field(default_factory=list)

    @property
    def ok(self) -> bool:
        """True without problems and doubts."""
        return not (self.problems or self.doubts)

    def add(self, batch: ChunkBatch) -> None:
        """Count the units of a batch."""
        self.units += len(batch.units)
        self.bytes += int(batch.units.size)

    def plain(self) -> dict[str, Any]:
        """Return the report as plain values, the form of ``--json``."""
        return {
            "source": self.source,
            "protocol": self.protocol,
            "opens": self.opens,
            "bytes": self.bytes,
            "units": self.units,
            "records": dict(self.records),
            "time": self.time,
            "problems": self.problems,
            "notes": self.notes,
            "facts": self.facts,
            "doubts": self.doubts,
            "ok": self.ok,
        }


class Reading:
    """One device: the results of its parser, and the first bytes of its own port."""

    def __init__(self, decoder: Decoder) -> None:
        self.entry, self.parser = decoder.entry, decoder.parser
        self.report = Report(self.entry.source, self.entry.protocol)
        self.heard = Heard()
        self.values = Values(line_scanner=find_driver(self.entry.kind, self.entry.protocol).line_scanner)
        self.kept: list[ChunkBatch] = []
        self._kept_bytes = 0

    def take(self, records: list[Record]) -> None:
        """Take decoded records of any of its ports."""
        self.heard.add(records)
        self.values.add(records)

    def keep(self, units: list[ChunkBatch]) -> None:
        """Count units of the device's own port, and keep the first."""
        for batch in units:
            self.report.add(batch)
            if self._kept_bytes < KEPT_BYTES:
                self._kept_bytes += batch.units.size
                self.kept.append(ChunkBatch(batch.source, batch.host_time_ns, batch.units.copy()))

    def finish(self) -> None:
        """Complete the report after the last byte: the device's time, and its faults."""
        self.take(self.parser.close())
        self.report.records = self.heard.counts
        if self.report.bytes:
            self.report.time = describe_time(self.entry, self.heard)
            self.report.problems += _answer_problems(self)
            self.report.facts, self.report.doubts = self.values.judge(self.entry.kind, self.entry.settings.config)
            never_set = stamp_doubts(self.entry, self.heard)
            self.report.doubts += never_set
            self.report.notes += self.parser.warnings
            self.report.notes += [] if never_set else lock_notes(self.entry, self.heard)
            self.report.notes += far_notes(self.heard, read_clock_discipline())


def check_everything(config: Config, seconds: float) -> list[Report]:
    """Listen to all sources of a configuration at once for ``seconds``, and return their reports."""
    return asyncio.run(_check_everything(config, seconds))


async def _check_everything(config: Config, seconds: float) -> list[Report]:
    listening = Listening(config.devices(), config.pps)
    readings = {source: Reading(decoder) for source, decoder in listening.decoders.items()}
    edges: dict[str, list[RawEdge]] = {f"pps/{name}": [] for name in config.pps}
    reports = {f"pps/{name}": Report(f"pps/{name}", pps.source) for name, pps in config.pps.items()}
    for source, reading in readings.items():
        reports[source] = reading.report
        if reading.entry.auxiliary is not None:
            reports[f"{source}/aux"] = Report(f"{source}/aux", reading.entry.protocol)
    async for batch in _batches(listening, seconds):
        if batch.edges:
            edges[batch.wire] += batch.edges
        for source, records in batch.records.items():
            readings[source].take(records)
            if batch.wire in readings:
                readings[source].keep(batch.units)
        if batch.wire not in readings:
            for units in batch.units:
                reports[batch.wire].add(units)
    for name, pps in config.pps.items():
        source = f"pps/{name}"
        report_pps(reports[source], pps.edge, listening.listeners[source], edges[source], seconds)
    for wire in listening.specs:
        inside = [reading.report for reading in readings.values() if reading.entry.transport.carrier == wire]
        for report in [reports[wire], *inside]:
            report_wire(report, listening, wire, seconds)
    for reading in readings.values():
        reading.finish()
    return [*reports.values(), check_directory(Path(config.session.directory), config.session.reserve_mb)]


async def _batches(listening: Listening, seconds: float) -> AsyncIterator[Batch]:
    """Yield what the wires give in a time; then close them and yield the rest."""
    loop = asyncio.get_running_loop()
    async with listening:
        ends_s = loop.time() + seconds
        with contextlib.suppress(TimeoutError):
            while (left_s := ends_s - loop.time()) > 0:
                async with asyncio.timeout(left_s):
                    batch = await listening.take()
                if batch is not None:
                    yield batch
    while (batch := await listening.take()) is not None:
        yield batch


def report_wire(report: Report, listening: Listening, wire: str, seconds: float) -> None:
    """Report the faults of a wire, after it was closed."""
    listener, spec, senders = listening.listeners[wire], listening.specs[wire], listening.senders[wire]
    counters = listener.counters
    report.opens = listener.session.openings > 0
    report.problems += _wire_problems(listener.session, counters, report, seconds)
    if senders.mixed and report.protocol != RAW:
        report.problems.append(mixed_text(senders.counts, recorded=False))
    if spec.kind == "can" and spec.interface == "socketcan":
        report.problems += bitrate_problems(spec, interface_bitrate(spec.channel))
    if counters.refused:
        what = "unreadable messages or lines; check the speed of the adapter"
        if spec.kind == "udp":
            what = f"datagrams from senders other than the configured source: {counters.refused_text()}"
        report.notes.append(f"{counters.refused} {what}")


def check_directory(directory: Path, reserve_mb: float) -> Report:
    """Check that logs can be written to a directory, and report the free space."""
    report = Report("log")
    existing, permitted = nearest_there(directory)
    if not permitted:
        report.problems.append(
            f"session.directory {directory}: user {os.geteuid()} may not enter {existing}; run this as root "
            f"or as the recording user, or choose another directory"
        )
        return report
    try:
        with tempfile.TemporaryFile(dir=existing):
            report.opens = True
    except OSError as error:
        report.problems.append(f"session.directory {directory}: cannot be written: {error.strerror}")
    free_mb = disk_usage(existing).free / 1e6
    report.notes.append(f"{directory}: {free_mb / 1000:.1f} GB free")
    if free_mb <= reserve_mb:
        report.problems.append(
            f"session.directory {directory}: {free_mb:.0f} MB free, reserve_mb is {reserve_mb:g}; free some space"
        )
    return report


def report_pps(report: Report, edge: str, listener: Listener[Any, Batch], edges: list[RawEdge], seconds: float) -> None:
    """Check the edges of a pulse."""
    session = listener.session
    if refused := listener.counters.refused:
        report.notes.append(f"{refused} lines are not edges; want 'realtime_ns sequence', both whole numbers")
    report.opens, report.units = session.openings > 0, len(edges)
    report.records["edges"] = len(edges)
    if session.last_error:
        report.problems.append(f"disconnected: {session.last_error}" if report.opens else session.last_error)
    elif not edges:
        report.problems.append(f"no {edge} edge in {seconds:g} s; check the wiring and the PPS output of the receiver")
    stamps = np.array([item.realtime_ns for item in edges], dtype=np.int64)
    if len(stamps) > 1:
        spacing_s = float(np.median(np.diff(stamps))) * 1e-9
        report.time = f"every {spacing_s:.4f} s"
        if abs(spacing_s - round(spacing_s)) > EDGE_SPACING_TOLERANCE_S or spacing_s < 0.5:
            report.problems.append(f"edges are {spacing_s:.4f} s apart, want 1 s; check for noise or another signal")
    if any(not item.kernel_stamp for item in edges):
        report.notes.append("time-stamped by this program, not by the kernel; errors of tens of microseconds")


def _wire_problems(session: Session[Any], counters: TransportCounters, report: Report, seconds: float) -> Iterable[str]:
    """Yield the faults of the wire itself."""
    if not report.opens:
        yield session.last_error or "did not open in time; listen longer (--seconds)"
        return
    if session.last_error:
        yield f"disconnected: {session.last_error}"
    if not report.bytes:
        yield f"opened, but sent nothing in {seconds:g} s; check its power, wiring and output port"
    granted, asked = counters.receive_buffer_bytes, counters.receive_buffer_asked_bytes
    if 0 < granted < asked:
        yield (
            f"receive buffer: asked for {asked} bytes, got {granted}; "
            f"run `sysctl -w net.core.rmem_max={asked}` (permanently: in /etc/sysctl.d)"
        )
    if counters.lost_kernel:
        yield f"the kernel dropped {counters.lost_kernel} units"
    if counters.error_frames or counters.bus_off:
        yield f"CAN errors: {counters.error_frames} error frames, {counters.bus_off} times bus-off"


def bitrate_problems(spec: TransportSpec, actual: int | None) -> list[str]:
    """Return a line if the interface runs at another bit rate than the configured one.

    An ``actual`` rate of None means that the interface has none (vcan) or that the kernel did not answer; it is not a
    fault.
    """
    wanted = spec.options.get("bitrate")
    if wanted is None or actual is None or int(wanted) == actual:
        return []
    command = f"ip link set {spec.channel} down && ip link set {spec.channel} up type can bitrate {wanted}"
    return [f"{spec.channel} runs at {actual} bit/s, but {wanted} is configured; run `{command}`"]


def _answer_problems(reading: Reading) -> list[str]:
    """Return the faults of the received data."""
    entry, heard, counters = reading.entry, reading.heard, reading.parser.counters
    if entry.protocol == RAW:
        return []
    if isinstance(reading.parser, GuardedParser) and reading.parser.fault:
        return [reading.parser.fault.removeprefix(f"{entry.source}: ")]
    good = counters.messages.total()
    remarks = reading.parser.remarks()
    other = not_understood(entry, heard, good, reading.kept, refused=counters.bad_messages, remarks=remarks)
    if other is not None:
        return [other]
    found: list[str] = []
    if not heard.counts and entry.kind != "corrections":  # of corrections only an occasional station message is decoded
        names = ", ".join(f"{name} {count}" for name, count in counters.messages.most_common(5))
        found.append(
            f"sends {entry.protocol}, but no decoded message ({names}); enable the messages that swath setup shows"
        )
    bad = counters.bad_checksums + counters.bad_messages
    if bad > DAMAGED_SHARE * good:
        found.append(f"{bad} of {bad + good} messages damaged")
    return found + _time_problems(entry, heard)


def stamp_doubts(entry: DeviceEntry, heard: Heard) -> list[str]:
    """Report a scanner that stamps neither past the hour nor by a pulse, and whose clock nobody has set.

    Its stamps then show a date days from this computer's, or count from its own start.
    """
    clock = str(entry.settings.config.get("clock"))
    if entry.kind != "scanner" or heard.stamp is None or heard.sees_pps is not None or clock == "free":
        return []
    driver = find_driver(entry.kind, entry.protocol)
    if driver.past_hour or driver.line_scanner:
        return []
    host_ns, device_ns = heard.stamp
    if device_ns < ABSOLUTE_FROM_NS:
        shows = f"counts from its own start ({device_ns / SECOND_NS:,.0f} s ago)"
    elif abs(device_ns - host_ns) >= NEVER_SET_S * SECOND_NS:
        shows = f"shows {date_text(device_ns)}, this computer's {date_text(host_ns)}"
    else:
        return []
    return [
        f"its clock {shows}: neither PTP nor a receiver has set it; without time its returns make no points: wait "
        "until the head's web page shows a lock, or connect PTP or a receiver to it"
    ]


def lock_notes(entry: DeviceEntry, heard: Heard) -> list[str]:
    """Report if a scanner is not locked to its PPS, or if its lock is unknown; its stamps may then be unusable."""
    if entry.kind != "scanner" or not heard.counts["DeviceClockSamples"]:
        return []
    if heard.sees_pps:
        void = heard.time_messages and heard.valid_time is None
        return ["the time sentences at its input are void; wait until the receiver has a fix"] if void else []
    if heard.sees_pps is not None:
        unlocked = "it reports that it is not locked to a pulse; wire the receiver's PPS to it"
        return [] if entry.pps is not None else [unlocked]
    clock = entry.settings.config.get("clock", "auto")
    if clock != "auto":
        return [
            f'its data do not tell whether it is locked; its time stamps are used as configured (clock = "{clock}")'
        ]
    taken = "its time stamps are used only if their arrival shows that they are UTC or TAI, or if clock sets it"
    if TimeMessage not in find_driver(entry.kind, entry.protocol).yields:
        return [f"its data do not tell whether PTP or a pulse sets its clock; {taken}"]
    port = "none arrived at auxiliary" if entry.auxiliary is not None else "set auxiliary"
    ports = "Velodyne port 8308, Hesai 10110"
    return [f"no position packet ({ports}) shows whether it is locked to its PPS ({port}); without it, {taken}"]


def far_notes(heard: Heard, discipline: ClockDiscipline) -> list[str]:
    """Report if a device's time is hours or days from this computer's clock; either may be the wrong one."""
    message = heard.valid_time
    ahead = None if message is None else ahead_s(message.time, message.host_time_ns)
    if ahead is None:
        return []
    text = distance_text(ahead, kept=discipline.disciplined, clock="this computer's clock")
    return [text] if text else []


def _time_problems(entry: DeviceEntry, heard: Heard) -> list[str]:
    """Return the faults of a device's time.

    A GNSS must give a valid time, a counter must run at the rate of time, and a device that reports its PPS must see
    it.
    """
    if entry.kind == "gnss":
        if heard.time_messages == 0:
            return ["sends no time message, so it cannot set the clock; enable one"]
        return [] if heard.valid_time is not None else ["its time is not valid yet"]
    rate = heard.imu_clock_rate
    if entry.kind == "imu" and rate is not None and not 1.0 / CLOCK_RATE_FACTOR < rate < CLOCK_RATE_FACTOR:
        return [f"its counter runs {rate:.3g} times as fast as time; check tick_hz"]
    if entry.pps is None or entry.transport.carrier is not None or entry.kind not in ("imu", "scanner"):
        return []
    if heard.sees_pps is False:
        return [f"does not see its PPS ({entry.pps})"]
    untold = (
        heard.sees_pps is None
        and heard.valid_time is None
        and not str(entry.settings.config.get("clock")).startswith("ptp")
    )
    if untold and find_driver(entry.kind, entry.protocol).tells_pps:
        return [f"nothing shows that it sees its PPS ({entry.pps}); check the wiring, or remove pps"]
    return []
