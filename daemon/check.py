"""Opens everything a configuration names for some seconds and says of each what it answers and what is wrong.

Nothing is written, nothing is sent. Every wire has its own thread, so all are heard at the same time.
"""

from __future__ import annotations

import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from shutil import disk_usage
from typing import Any

import numpy as np

from daemon.config import Config, DeviceEntry
from daemon.identify import Heard, describe_time, identify
from drivers.core.parser import Parser
from drivers.core.registry import find_driver
from drivers.session import Session
from drivers.transports.base import RawEdge, UnitBlock
from drivers.transports.can_link import interface_bitrate
from drivers.transports.uri import TransportSpec, open_transport, parse_pps
from georef.records import ChunkBatch

SLICE_S = 0.1
KEPT_BYTES = 1 << 20  # of each wire, to find out what it is if it is not what was configured
EDGE_SPACING_TOLERANCE_S = 0.05  # of a user-space stamp on a busy computer


@dataclass(frozen=True, slots=True)
class Span:
    """How long to listen: ``seconds``, or until ``stop`` is set."""

    seconds: float
    stop: threading.Event = field(default_factory=threading.Event)

    def listen(self, session: Session[Any]) -> Iterable[list[Any]]:
        """What a session hands over until the time is up."""
        deadline_s = time.monotonic() + self.seconds
        while not self.stop.is_set() and (left_s := deadline_s - time.monotonic()) > 0:
            if got := session.receive(min(SLICE_S, left_s)):
                yield got


@dataclass(slots=True)
class Report:
    """What one source answered.

    Attributes:
        source: ``kind/name``; ``/aux`` behind it for a head's second port; ``log`` for the log directory.
        opens: the device could be opened.
        bytes, units: what came in the time.
        records: decoded records by type (rows, where they come in batches).
        time: what it says of its time, for the eye.
        problems: what is wrong, one line each.
        notes: what is worth knowing and not wrong.
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

    def plain(self) -> dict[str, Any]:
        """As plain values, the form of ``--json``."""
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
            "ok": not self.problems,
        }


def check_everything(config: Config, seconds: float) -> list[Report]:
    """Listen to all sources of a configuration at once for ``seconds``."""
    span = Span(seconds)
    jobs = list(_jobs(config, span))
    with ThreadPoolExecutor(max_workers=max(1, len(jobs)), thread_name_prefix="check") as pool:
        try:
            futures = [pool.submit(job) for job in jobs]
            found = [report for future in futures for report in future.result()]
        finally:
            span.stop.set()  # an interrupt does not wait for the rest of the time
    return [*found, check_directory(Path(config.session.directory), config.session.reserve_mb)]


def _jobs(config: Config, span: Span) -> Iterable[Callable[[], list[Report]]]:
    """One job a wire."""
    devices = list(config.devices())
    for name, pps in config.pps.items():
        yield partial(check_pps, f"pps/{name}", pps.source, pps.edge, span)
    for device in devices:
        if device.transport.kind == "gnss":
            continue
        inside = [d for d in devices if d.transport.kind == "gnss" and f"gnss/{d.transport.address}" == device.source]
        yield partial(check_wire, device, inside, span)
        if device.auxiliary is not None:
            yield partial(check_auxiliary, device, device.auxiliary, span)


def check_directory(directory: Path, reserve_mb: float) -> Report:
    """Whether logs can be written there, and how much room is left."""
    report = Report("log")
    existing = next(path for path in (directory, *directory.parents) if path.exists())
    try:
        with tempfile.TemporaryFile(dir=existing):
            report.opens = True
    except OSError as error:
        report.problems.append(f"session.directory {directory}: cannot be written: {error.strerror}")
    free_mb = disk_usage(existing).free / 1e6
    report.notes.append(f"{directory}: {free_mb / 1000:.1f} GB free")
    if free_mb <= reserve_mb:
        report.problems.append(f"session.directory {directory}: {free_mb:.0f} MB free, reserve_mb is {reserve_mb:g}")
    return report


def check_pps(source: str, text: str, edge: str, span: Span) -> list[Report]:
    """Count the edges of a PPS source."""
    report = Report(source, protocol=text)
    session: Session[RawEdge] = Session(lambda: parse_pps(text, edge=edge))
    edges: list[RawEdge] = []
    for got in span.listen(session):
        edges += got
    session.close()
    report.opens, report.units = session.openings > 0, len(edges)
    report.records["edges"] = len(edges)
    if not report.opens:
        report.problems.append(session.last_error)
        return [report]
    if not edges:
        report.problems.append(
            f"no {edge} edge in {span.seconds:g} s; is the PPS wired, and does the receiver put it out?"
        )
    if session.last_error:
        report.problems.append(f"went away: {session.last_error}")
    stamps = np.array([item.realtime_ns for item in edges], dtype=np.int64)
    if len(stamps) > 1:
        spacing_s = float(np.median(np.diff(stamps))) * 1e-9
        report.time = f"every {spacing_s:.4f} s"
        if abs(spacing_s - round(spacing_s)) > EDGE_SPACING_TOLERANCE_S or spacing_s < 0.5:
            report.problems.append(f"edges are {spacing_s:.4f} s apart, want 1 s: noise, or another pulse")
    if any(not item.kernel_stamp for item in edges):
        report.notes.append("stamped after a wake-up, not by the kernel: tens of microseconds")
    return [report]


def check_wire(device: DeviceEntry, inside: list[DeviceEntry], span: Span) -> list[Report]:
    """Listen to a device; also of the devices inside its stream."""
    parsers = [
        (entry, find_driver(entry.kind, entry.protocol).make_parser(entry.settings)) for entry in (device, *inside)
    ]
    reports = [Report(entry.source, entry.protocol) for entry, _ in parsers]
    heard = [Heard() for _ in parsers]
    session = Session(lambda: open_transport(device.transport))
    kept: list[ChunkBatch] = []
    for blocks in span.listen(session):
        for block in blocks:
            batch = _batch(device.source, block)
            _keep(kept, batch)
            for (_, parser), report, records in zip(parsers, reports, heard, strict=True):
                _count_units(report, block)
                records.add(parser.feed_batch(batch))
    for (_, parser), records in zip(parsers, heard, strict=True):
        records.add(parser.close())
    for (entry, parser), report, records in zip(parsers, reports, heard, strict=True):
        report.opens = session.openings > 0
        report.records, report.time = records.counts, describe_time(entry, records)
        report.problems += _wire_problems(session, device.transport, report, span.seconds)
        if report.bytes:
            report.problems += _answer_problems(entry, parser, records, kept)
    session.close()
    return reports


def check_auxiliary(device: DeviceEntry, auxiliary: TransportSpec, span: Span) -> list[Report]:
    """Listen to a head's second port; what it carries is read with the first."""
    report = Report(f"{device.source}/aux", device.protocol)
    session = Session(lambda: open_transport(auxiliary))
    for blocks in span.listen(session):
        for block in blocks:
            _count_units(report, block)
    report.opens = session.openings > 0
    report.problems += _wire_problems(session, auxiliary, report, span.seconds)
    session.close()
    return [report]


def _batch(source: str, block: UnitBlock) -> ChunkBatch:
    now_ns = time.time_ns()
    stamps = np.full(len(block.units), now_ns, dtype=np.int64)
    if block.kernel_realtime_ns is not None:
        stamps = np.where(block.kernel_realtime_ns > 0, block.kernel_realtime_ns, now_ns).astype(np.int64)
    return ChunkBatch(source, stamps, block.units)


def _keep(kept: list[ChunkBatch], batch: ChunkBatch) -> None:
    if sum(item.units.size for item in kept) < KEPT_BYTES:
        kept.append(ChunkBatch(batch.source, batch.host_time_ns.copy(), batch.units.copy()))


def _count_units(report: Report, block: UnitBlock) -> None:
    report.units += len(block.units)
    report.bytes += int(block.units.size)


def _wire_problems(session: Session[Any], spec: TransportSpec, report: Report, seconds: float) -> list[str]:
    """What is wrong with the wire itself."""
    if not report.opens:
        return [session.last_error]
    found: list[str] = []
    if session.last_error:
        found.append(f"went away: {session.last_error}")
    if not report.bytes:
        found.append(f"silent: opened, but no byte in {seconds:g} s; is it powered, wired and sending here?")
    counters = session.poll_counters()
    granted, asked = counters.receive_buffer_bytes, counters.receive_buffer_asked_bytes
    if 0 < granted < asked:
        found.append(
            f"receive buffer: asked for {asked} bytes, got {granted}; "
            f"`sysctl -w net.core.rmem_max={asked}`, for good in /etc/sysctl.d"
        )
    if counters.lost_kernel:
        found.append(f"the kernel dropped {counters.lost_kernel} units")
    if counters.refused:
        report.notes.append(f"{counters.refused} datagrams of other senders than the configured source")
    if counters.error_frames or counters.bus_off:
        found.append(f"CAN trouble: {counters.error_frames} error frames, {counters.bus_off} times bus-off")
    if spec.kind == "can" and spec.interface == "socketcan":
        found += bitrate_problems(spec, interface_bitrate(spec.channel))
    return found


def bitrate_problems(spec: TransportSpec, actual: int | None) -> list[str]:
    """Whether the interface runs at the configured bit rate; None: it has none (vcan) or cannot be asked."""
    wanted = spec.options.get("bitrate")
    if wanted is None or actual is None or int(wanted) == actual:
        return []
    command = f"ip link set {spec.channel} down && ip link set {spec.channel} up type can bitrate {wanted}"
    return [f"{spec.channel} runs at {actual} bit/s, configured is {wanted}; `{command}`"]


def _answer_problems(entry: DeviceEntry, parser: Parser, heard: Heard, kept: list[ChunkBatch]) -> list[str]:
    """What is wrong with what came."""
    counters = parser.counters
    good = counters.messages.total()
    if not good or not heard.counts:
        other = identify(entry, kept, than=good)
        if other is not None:
            return [f"answers as {other}, configured as {entry.protocol}"]
    if not good:
        hint = "; is the baud rate right?" if entry.transport.kind == "serial" else ""
        return [f"nothing of it is {entry.protocol} nor any other {entry.kind} protocol known{hint}"]
    found: list[str] = []
    if not heard.counts:
        names = ", ".join(f"{name} {count}" for name, count in counters.messages.most_common(5))
        found.append(f"speaks {entry.protocol}, but sends nothing that is decoded ({names})")
    bad = counters.bad_checksums + counters.bad_messages
    if bad > 0.01 * good:
        found.append(f"{bad} of {bad + good} messages damaged")
    return found + _time_problems(entry, heard)


def _time_problems(entry: DeviceEntry, heard: Heard) -> list[str]:
    """A GNSS must say a valid time; a device on a PPS must see it."""
    if entry.kind == "gnss":
        if heard.time_messages == 0:
            return ["no time message: the clock cannot be set by it; switch one on"]
        return [] if heard.valid_time is not None else ["its time is not valid (yet)"]
    if entry.pps is not None and heard.clock_rows and not heard.clock_sees_pps:
        return [f"does not see its PPS ({entry.pps})"]
    return []
