"""Captures into an ordinary log: as a recorder would have written it, with the captures' stamps as log times.

Files are merged by time, each read in its own order and never whole. Chunks, statuses and parts follow log time,
where a recorder's follow its clock.
"""

from __future__ import annotations

import heapq
import importlib.metadata
import platform
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from daemon.account import Account
from daemon.acquire import BLOCK_BYTES, MAX_SENDERS, SILENT_AFTER_S
from daemon.block_queue import BlockQueue, SourceCount
from daemon.capture_routes import Port, Routes
from daemon.captures import Capture, ImportUnit
from daemon.channels import ChannelTable
from daemon.config import Config
from daemon.errors import ExitCode, UserError
from daemon.events import Events, Severity
from daemon.host_clock import ClockPair, HostClock
from daemon.log.encode import encode_block
from daemon.log.format import CHUNK_OPEN_NS, SessionInfo
from daemon.log.writer import PartWriter
from daemon.parts import Attachment, Parts
from daemon.run import read_boot_id
from drivers.transports.capture_base import Address

STATUS_NS = 1_000_000_000
_BEHIND = 1000  # units in a row so far behind the newest: its stamp was the wrong one
_NO_DISK_FIGURES = {"queue_high_water": 0, "write_ms_max": 0.0, "sync_ms_max": 0.0}


def merge(captures: Iterable[Capture], routes: Routes) -> Iterator[ImportUnit]:
    """Units of all files, the earliest of those that are next first; each file keeps its own order."""
    streams = [capture.read(routes) for capture in captures]
    waiting = []
    for number, stream in enumerate(streams):
        unit = next(stream, None)
        if unit is not None:
            waiting.append((unit.time_ns, number, unit))
    heapq.heapify(waiting)
    while waiting:
        _, number, unit = waiting[0]
        yield unit
        following = next(streams[number], None)
        if following is None:
            heapq.heappop(waiting)
        else:
            heapq.heapreplace(waiting, (following.time_ns, number, following))


def import_session_info(name: str, first_ns: int) -> SessionInfo:
    """Session of captures that begin at ``first_ns``: host time is their wall clock."""
    boot_id = read_boot_id()
    try:
        start = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime(first_ns // 1_000_000_000))
    except (ValueError, OverflowError, OSError):
        start = str(first_ns)
    return SessionInfo(
        session_id=f"{name}-{start}-{boot_id[:4]}",
        software=f"swath {importlib.metadata.version('swath')}",
        host=platform.node(),
        boot_id=boot_id,
        realtime_ns=first_ns,
        monotonic_ns=first_ns,
        origin="import",
    )


class CaptureClock(HostClock):
    """The time of the unit at hand stands for the time of the recorder."""

    def __init__(self, first_ns: int) -> None:
        super().__init__(ClockPair(first_ns, first_ns, 0))
        self.time_ns = first_ns

    def now_ns(self) -> int:
        """Stamp of the latest unit."""
        return self.time_ns


@dataclass(slots=True)
class _Run:
    """Consecutive units of a source that share channel and length."""

    channel_id: int
    length: int
    times_ns: list[int] = field(default_factory=list)
    units: list[bytes] = field(default_factory=list)


@dataclass(slots=True)
class _Source:
    """A source's channels and account."""

    port: Port
    channel_ids: dict[Address | None, int] = field(default_factory=dict)
    sequences: Counter[int] = field(default_factory=Counter)
    run: _Run | None = None
    units: int = 0
    bytes: int = 0
    last_ns: int = 0

    def count(self, now_ns: int) -> SourceCount:
        """The account as a recorder's receiver gives it."""
        silent = now_ns - self.last_ns > SILENT_AFTER_S * 1e9
        state = "silent" if silent else "receiving"
        return SourceCount(units=self.units, bytes=self.bytes, last_unit_ns=self.last_ns, state=state)


class ImportLog:
    """The log of an import; used by one thread.

    Raises:
        UserError: a log of this name is there.
        OSError: the directory cannot be written.
    """

    def __init__(self, config: Config, directory: Path, first_ns: int) -> None:
        self.info = import_session_info(config.session.name, first_ns)
        if directory.is_dir():
            there = next(iter(sorted(directory.glob(f"{self.info.session_id}_*.mcap"))), None)
            if there is not None:
                text = f"{there}: is there already; remove it or give another directory"
                raise UserError(text, ExitCode.IO)
        self._clock = CaptureClock(first_ns)
        self._channels = ChannelTable()
        self._events = Events(self._clock, BlockQueue(0), self._channels)
        attachments = [Attachment(*attachment) for attachment in config.attachments()]
        self._parts = Parts(directory, self.info, self._channels, attachments, config.session.compression)
        self._account = Account(self._parts, self._channels, self._events, self._clock, lambda source: {})
        self._split_bytes = config.session.split_size_mb * 1e6
        self._split_ns = config.session.split_minutes * 60e9
        self._sources: dict[str, _Source] = {}
        self._newest_ns = self._flushed_ns = self._told_ns = self._part_opened_ns = first_ns
        self._behind = 0
        self.paths: list[Path] = []
        self._open_part()
        self.event(Severity.INFO, "session_started", f"session {self.info.session_id}, imported from captures")

    def add(self, unit: ImportUnit) -> None:
        """One unit; raises OSError when the disk refuses a chunk."""
        self._clock.time_ns = now_ns = unit.time_ns
        self._advance(now_ns)
        source = self._sources.get(unit.port.source) or self._add_source(unit.port)
        channel_id = source.channel_ids.get(unit.peer) or self._channel(source, unit.peer)
        run, length = source.run, len(unit.data)
        if run is None or run.channel_id != channel_id or run.length != length:
            self._lay_run(source)
            run = source.run = _Run(channel_id, length)
        run.times_ns.append(now_ns)
        run.units.append(unit.data)
        source.units += 1
        source.bytes += length
        source.last_ns = now_ns
        if len(run.units) * (length + 31) >= BLOCK_BYTES:
            self._lay_run(source)

    def event(self, severity: Severity, code: str, text: str) -> None:
        """Something to be known of the import, into the log."""
        self._parts.add(self._events.make(severity, "import", code, text))

    def units(self) -> dict[str, int]:
        """Units by source."""
        return {name: source.units for name, source in sorted(self._sources.items())}

    def finish(self) -> None:
        """The last statuses and the index; raises OSError."""
        self._tell_status()
        self.event(Severity.INFO, "session_ended", f"session {self.info.session_id} ended")
        part = self._parts.release()
        assert part is not None
        part.finish()
        self._parts.remove_sign()

    def give_up(self) -> None:
        """Close and remove what this import has written: half a log would look like a whole one."""
        part = self._parts.release()
        if part is not None:
            part.close()
        for path in self.paths:
            path.unlink(missing_ok=True)
        self._parts.remove_sign()

    def _advance(self, now_ns: int) -> None:
        """What is due at a stamp. The newest counts: stamps of two clocks, years apart, must not be due each time."""
        if now_ns < self._newest_ns - STATUS_NS:
            self._behind += 1
            if self._behind < _BEHIND:
                return
            self._flushed_ns = self._told_ns = self._part_opened_ns = now_ns
        self._newest_ns = now_ns if self._behind >= _BEHIND else max(now_ns, self._newest_ns)
        self._behind = 0
        if self._newest_ns - self._flushed_ns >= CHUNK_OPEN_NS:
            self._flush()
        if self._newest_ns - self._told_ns >= STATUS_NS:
            self._tell_status()
            if self._split_due():
                self._split()

    # ------------------------------------------------------------------ sources and channels

    def _add_source(self, port: Port) -> _Source:
        source = self._sources[port.source] = _Source(port)
        self._account.add_source(port.source)
        return source

    def _channel(self, source: _Source, peer: Address | None) -> int:
        """A channel a sender, and one for all beyond `MAX_SENDERS`, as a recorder has them."""
        if len(source.channel_ids) >= MAX_SENDERS:
            peer = None
        if peer in source.channel_ids:
            return source.channel_ids[peer]
        spec = source.port.channel
        if peer is not None:
            sender = {"source_address": peer[0], "source_port": str(peer[1])}
            spec = replace(spec, metadata=spec.metadata | sender)
        channel_id = source.channel_ids[peer] = self._channels.add(source.port.source, spec)
        return channel_id

    # ------------------------------------------------------------------ chunks, statuses, parts

    def _lay_run(self, source: _Source) -> None:
        run, source.run = source.run, None
        if run is None:
            return
        rows = np.frombuffer(b"".join(run.units), np.uint8).reshape(len(run.units), run.length)
        times = np.array(run.times_ns, dtype=np.int64)
        first = source.sequences[run.channel_id]
        self._parts.add(encode_block(run.channel_id, first, times, rows))
        source.sequences[run.channel_id] += len(run.units)

    def _flush(self) -> None:
        for source in self._sources.values():
            self._lay_run(source)
        assert self._parts.current is not None
        self._parts.current.flush()
        self._flushed_ns = self._newest_ns

    def _tell_status(self) -> None:
        """As the recorder: counts of written chunks, then the statuses, both in the file before anything else."""
        self._flush()
        now_ns = self._clock.time_ns
        for name, source in self._sources.items():
            self._account.counts[name] = source.count(now_ns)
        for block in self._account.encode(self._account.statuses(_NO_DISK_FIGURES)):
            self._parts.add(block)
        self._flush()
        self._told_ns = self._newest_ns

    def _split_due(self) -> bool:
        part = self._parts.current
        assert part is not None
        return part.bytes_written >= self._split_bytes or self._newest_ns - self._part_opened_ns >= self._split_ns

    def _split(self) -> None:
        old = self._open_part()
        assert old is not None
        name = self.paths[-1].name
        self.event(Severity.INFO, "part_opened", name)
        self._flush()
        self._parts.add_last(old, self._events.make(Severity.INFO, "import", "part_closed", name))
        old.finish()

    def _open_part(self) -> PartWriter | None:
        old = self._parts.open_next(self._clock.time_ns)
        assert self._parts.current is not None
        self.paths.append(self._parts.current.path)
        self._part_opened_ns = self._newest_ns
        return old


@dataclass(frozen=True, slots=True)
class ImportReport:
    """What came of an import; ``session_id`` and ``paths`` are empty where no capture held a unit."""

    session_id: str
    paths: list[Path]
    units: dict[str, int]


def import_captures(
    config: Config,
    routes: Routes,
    captures: list[Capture],
    directory: Path,
    progress: Callable[[int], None] = lambda _: None,
) -> ImportReport:
    """Make a log of captures.

    Args:
        config: stored in the log, and what its devices are.
        routes: of the same configuration.
        captures: read here, once; what was found in them stands in each.
        directory: of the log; made if need be.
        progress: called with the number of units so far, now and then.

    Raises:
        UserError: the log is there already.
        OSError: it cannot be written; nothing is left of it.
    """
    log: ImportLog | None = None
    try:
        for number, unit in enumerate(merge(captures, routes)):
            log = log or ImportLog(config, directory, unit.time_ns)
            log.add(unit)
            if number % 10_000 == 0:
                progress(number)
        if log is None:
            return ImportReport("", [], {})
        for capture in captures:
            _note(log, capture)
        log.finish()
    except BaseException:
        if log is not None:
            log.give_up()
        raise
    return ImportReport(log.info.session_id, log.paths, log.units())


def _note(log: ImportLog, capture: Capture) -> None:
    told = ", ".join(f"{count} units of {source}" for source, count in capture.units.items()) or "no unit"
    log.event(Severity.INFO, "capture_imported", f"{capture.path.name}: {told}")
    if capture.tally.damage:
        text = f"{capture.tally.damage} places of {capture.path.name}; the first: {capture.tally.first_damage}"
        log.event(Severity.WARNING, "capture_damaged", text)
