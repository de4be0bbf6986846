"""Makes an ordinary log at the pace of its units' stamps, for imported captures and flights of the virtual aircraft.

Chunks, statuses and parts follow the stamps as those of a recorder follow its clock.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from swath.daemon.config import Config
from swath.daemon.errors import ExitCode, UserError
from swath.daemon.exchange.routes import Port
from swath.daemon.log.account import Account
from swath.daemon.log.block_queue import BlockQueue, SourceCount
from swath.daemon.log.channels import ChannelTable
from swath.daemon.log.events import Events, Severity
from swath.daemon.log.format import CHUNK_OPEN_NS, SessionInfo
from swath.daemon.log.host_clock import ClockPair, HostClock
from swath.daemon.log.mcap.encode import MESSAGE_HEADER_BYTES, encode_block
from swath.daemon.log.mcap.writer import PartWriter
from swath.daemon.log.parts import Attachment, Parts
from swath.daemon.log.wires import BLOCK_BYTES, MAX_SENDERS, SILENT_AFTER_S
from swath.drivers.captures.base import Address

STATUS_NS = 1_000_000_000
_BEHIND = 1000  # so many units in a row behind the newest stamp prove that stamp wrong
_NO_DISK_FIGURES = {"queue_high_water": 0, "write_ms_max": 0.0, "sync_ms_max": 0.0}


class MadeClock(HostClock):
    """A clock that shows the time of the current unit as the recorder's time."""

    def __init__(self, realtime_ns: int, monotonic_ns: int) -> None:
        super().__init__(ClockPair(realtime_ns, monotonic_ns, 0))
        self.time_ns = realtime_ns

    def now_ns(self) -> int:
        """Return the stamp of the latest unit."""
        return self.time_ns


@dataclass(slots=True)
class _Run:
    """Consecutive units of a source that share channel and length."""

    channel_id: int
    length: int
    times_ns: list[int] = field(default_factory=list)
    units: list[bytes] = field(default_factory=list)


@dataclass(slots=True)
class Source:
    """Channels and account of a source."""

    port: Port
    channel_ids: dict[Address | None, int] = field(default_factory=dict)
    sequences: Counter[int] = field(default_factory=Counter)
    run: _Run | None = None
    units: int = 0
    bytes: int = 0
    last_ns: int = 0

    def count(self, length: int, now_ns: int) -> None:
        """Count one more unit."""
        self.units += 1
        self.bytes += length
        self.last_ns = now_ns


class MadeLog:
    """A log made from stamped units; used by one thread.

    Args:
        config: describes the devices; it is stored in the log.
        directory: of the log; created if necessary.
        info: of its session; the first units have its ``realtime_ns`` or later.
        author: the source of the log's own events.

    Attributes:
        paths: of its parts.

    Raises:
        UserError: a log of this name exists already.
        OSError: the directory cannot be written.
    """

    def __init__(self, config: Config, directory: Path, info: SessionInfo, author: str) -> None:
        self.info = info
        refuse_session(directory, info.session_id)
        first_ns = info.realtime_ns
        self.clock = MadeClock(first_ns, info.monotonic_ns)
        self.channels = ChannelTable()
        self._events_queue = BlockQueue(0)
        self.events = Events(self.clock, self._events_queue, self.channels)
        self._author = author
        attachments = [Attachment(*attachment) for attachment in config.attachments()]
        self._parts = Parts(directory, info, self.channels, attachments, config.session.compression)
        self._account = Account(self._parts, self.channels, self.events, self.clock, self.time_status)
        self._split_bytes = config.session.split_size_mb * 1e6
        self._split_ns = config.session.split_minutes * 60e9
        self.sources: dict[str, Source] = {}
        self._newest_ns = self._flushed_ns = self._status_ns = self._part_opened_ns = first_ns
        self._behind = 0
        self.paths: list[Path] = []
        self._open_part()

    # ------------------------------------------------------------------ overridden by each kind of log

    def count_of(self, source: Source, now_ns: int) -> SourceCount:
        """Return the account of a source as a recorder's receiver gives it."""
        silent = now_ns - source.last_ns > SILENT_AFTER_S * 1e9
        state = "silent" if silent else "receiving"
        return SourceCount(units=source.units, bytes=source.bytes, last_unit_ns=source.last_ns, state=state)

    def time_status(self, source: str) -> dict[str, object]:
        """Return the status entries for the source's time; empty if this kind of log does not judge time."""
        return {}

    # ------------------------------------------------------------------ units and events

    def add_source(self, port: Port) -> Source:
        """Add a source, which gets a status from now on."""
        source = self.sources[port.source] = Source(port)
        self._account.add_source(port.source)
        return source

    def add_unit(self, source: Source, peer: Address | None, now_ns: int, data: bytes) -> None:
        """Add one unit after `go_on` to its time; ``peer`` is a datagram's sender. Raises OSError."""
        channel_id = source.channel_ids.get(peer) or self._channel(source, peer)
        run, length = source.run, len(data)
        if run is None or run.channel_id != channel_id or run.length != length:
            self._lay_run(source)
            run = source.run = _Run(channel_id, length)
        run.times_ns.append(now_ns)
        run.units.append(data)
        source.count(length, now_ns)
        if len(run.units) * (length + MESSAGE_HEADER_BYTES) >= BLOCK_BYTES:
            self._lay_run(source)

    def event(self, severity: Severity, code: str, text: str) -> None:
        """Write an event that concerns the log as a whole."""
        self._parts.add(self.events.make(severity, self._author, code, text))

    def lay_told(self) -> None:
        """Write the messages and events that were posted since the last call."""
        for item in self._events_queue.take_all():
            if item.block is not None:
                self._parts.add(item.block)

    def units(self) -> dict[str, int]:
        """Return the number of units by source."""
        return {name: source.units for name, source in sorted(self.sources.items())}

    def bytes_written(self) -> int:
        """Return the size of all parts so far, in bytes."""
        return self._parts.bytes_written()

    def finish(self) -> None:
        """Write the last statuses and the index; raises OSError."""
        self._tell_status()
        self.event(Severity.INFO, "session_ended", f"session {self.info.session_id} ended")
        part = self._parts.release()
        assert part is not None
        part.finish()
        self._parts.remove_sign()

    def give_up(self) -> None:
        """Close and remove all written parts, because an incomplete log would look like a whole one."""
        part = self._parts.release()
        if part is not None:
            part.close()
        for path in self.paths:
            path.unlink(missing_ok=True)
        self._parts.remove_sign()

    def go_on(self, now_ns: int) -> None:
        """Advance to a stamp, and flush, write statuses and split parts as they become due.

        Only a stamp newer than all before makes anything due: alternating stamps of two clocks, years apart, must not
        trigger all of it each time.
        """
        self.clock.time_ns = now_ns
        if now_ns < self._newest_ns - STATUS_NS:
            self._behind += 1
            if self._behind < _BEHIND:
                return
            self._flushed_ns = self._status_ns = self._part_opened_ns = now_ns
        self._newest_ns = now_ns if self._behind >= _BEHIND else max(now_ns, self._newest_ns)
        self._behind = 0
        if self._newest_ns - self._flushed_ns >= CHUNK_OPEN_NS:
            self._flush()
        if self._newest_ns - self._status_ns >= STATUS_NS:
            self._tell_status()
            if self._split_due():
                self._split()

    # ------------------------------------------------------------------ channels, chunks

    def _channel(self, source: Source, peer: Address | None) -> int:
        """Return the channel of a sender; all senders beyond `MAX_SENDERS` share one, as in a recorder."""
        if len(source.channel_ids) >= MAX_SENDERS:
            peer = None
        if peer in source.channel_ids:
            return source.channel_ids[peer]
        spec = source.port.channel
        if peer is not None:
            sender = {"source_address": peer[0], "source_port": str(peer[1])}
            spec = replace(spec, metadata=spec.metadata | sender)
        channel_id = source.channel_ids[peer] = self.channels.add(source.port.source, spec)
        return channel_id

    def _lay_run(self, source: Source) -> None:
        run, source.run = source.run, None
        if run is None:
            return
        rows = np.frombuffer(b"".join(run.units), np.uint8).reshape(len(run.units), run.length)
        times = np.array(run.times_ns, dtype=np.int64)
        first = source.sequences[run.channel_id]
        self._parts.add(encode_block(run.channel_id, first, times, rows))
        source.sequences[run.channel_id] += len(run.units)

    def _flush(self) -> None:
        for source in self.sources.values():
            self._lay_run(source)
        assert self._parts.current is not None
        self._parts.current.flush()
        self._flushed_ns = self._newest_ns

    # ------------------------------------------------------------------ statuses, parts

    def _tell_status(self) -> None:
        """Write the statuses as the recorder does: first all open chunks, so that the counts are of written ones, then
        statuses.
        """
        self._flush()
        now_ns = self.clock.time_ns
        for name, source in self.sources.items():
            self._account.note(name, self.count_of(source, now_ns))
        for block in self._account.encode(self._account.statuses(_NO_DISK_FIGURES)):
            self._parts.add(block)
        self.lay_told()
        self._flush()
        self._status_ns += STATUS_NS
        if self._newest_ns - self._status_ns >= STATUS_NS:  # after a gap: one status, not one for every second of it
            self._status_ns = self._newest_ns

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
        self._parts.add_last(old, self.events.make(Severity.INFO, self._author, "part_closed", name))
        old.finish()

    def _open_part(self) -> PartWriter | None:
        old = self._parts.open_next(self.clock.time_ns)
        assert self._parts.current is not None
        self.paths.append(self._parts.current.path)
        self._part_opened_ns = self._newest_ns
        return old


def refuse_session(directory: Path, session_id: str) -> None:
    """Refuse a directory that already holds a log of this session; raises UserError."""
    if directory.is_dir():
        there = next(iter(sorted(directory.glob(f"{session_id}_*.mcap"))), None)
        if there is not None:
            raise UserError(f"{there}: already exists; remove it or choose another directory", ExitCode.IO)
