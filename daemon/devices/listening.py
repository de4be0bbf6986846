"""Listens to several devices at once, for one task of an asyncio loop.

Each wire has a thread (decision 0003) that receives, stamps and decodes; the loop gets whole readings. Both ports of a
head feed one parser, and a device inside another one's stream reads along on its wire.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple, Protocol, Self

import numpy as np

from swath.daemon.config import DeviceEntry
from swath.daemon.config.tables import PpsConfig
from swath.daemon.log.host_clock import (
    HostClock,
    StampConverter,
    read_clock_discipline,
    read_clock_pair,
    read_clock_sample,
)
from swath.daemon.log.wires import Senders
from swath.drivers.driver import find_driver
from swath.drivers.listening import Listener, LoopReader, Measured, Overflow
from swath.drivers.parser import Parser
from swath.drivers.session import Session, SessionState
from swath.drivers.transports.base import RawEdge, UnitBlock
from swath.drivers.transports.opening import open_pps, open_transport
from swath.drivers.transports.spec import TransportSpec, parse_pps
from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.records import ChunkBatch, PpsEdge, Record

READING_S = 0.1  # between two readings of the host's clocks
EDGE_BYTES = 100
REPORT_BYTES = 2000
STREAMS = ("serial", "tcp", "ntrip")
QUEUE_BYTES = 64 << 20  # of each wire: raw units and decoded rows that the loop has not taken yet

Told = Callable[[SessionState, str], None]


class Times(NamedTuple):
    """GPS times of a record's rows; one row for a record without rows.

    Attributes:
        gps_ns: (n,) GPS ns since 1980-01-06; −1: unknown.
        sigma_s: (n,) standard deviation; 0: the device names the time itself; nan: unknown.
    """

    gps_ns: Int64Array
    sigma_s: FloatArray


class Clocks(Protocol):
    """The interface of clocks that give records GPS times as they come; any thread may call them."""

    def add_reading(
        self, realtime_ns: int, monotonic_ns: int, monotonic_raw_ns: int, max_error_s: float = math.inf
    ) -> None:
        """Take the host's clocks, read side by side."""

    def add_edge(self, source: str, edge: PpsEdge) -> None:
        """Take an edge of ``pps/name``."""

    def take(self, source: str, records: Sequence[Record], *, late: bool = False) -> list[Times]:
        """Take records of a source and return their times; ``late``: their host times are those of a late reading."""

    def state(self, source: str, host_ns: int) -> tuple[str, float] | None:
        """Return a clock's state and sigma, s, by its source; None: the source is no clock."""


@dataclass(frozen=True, slots=True)
class Batch:
    """Holds the units and records of one reading of a wire.

    Attributes:
        wire: ``scanner/left``, or ``scanner/left/aux`` for a second port.
        units: raw units with their host times, as received.
        records: decoded, by source: of the device, and of those inside its stream.
        times: GPS times of these records, in their order; empty without clocks.
        edges: of a pulse, as they were stamped; such a batch has nothing else.
        reports: of a recorder, with their host times, ns; the wire is ``/events`` or ``/status/scanner/left``.
    """

    wire: str
    units: list[ChunkBatch]
    records: dict[str, list[Record]]
    times: dict[str, list[Times]] = field(default_factory=dict)
    edges: list[RawEdge] = field(default_factory=list)
    reports: list[tuple[int, dict[str, Any]]] = field(default_factory=list)

    @property
    def measured(self) -> Measured[Batch]:
        """The batch with its size."""
        raw_bytes = sum(one.units.size for one in self.units)
        rows = sum(getattr(record, "rows", _NO_ROWS).nbytes for records in self.records.values() for record in records)
        size_bytes = raw_bytes + rows + EDGE_BYTES * len(self.edges) + REPORT_BYTES * len(self.reports)
        return Measured(self, size_bytes, sum(len(one.units) for one in self.units) + len(self.edges), raw_bytes)


_NO_ROWS = np.empty(0, np.uint8)


@dataclass(frozen=True, slots=True)
class Status:
    """State and counts of a source.

    Attributes:
        source: ``kind/name``.
        state: of its wire: opening, receiving, silent (3 s without data), absent, or closed.
        last_error: why the wire was refused or lost last; empty: never.
        openings: how often the wire was opened.
        units, bytes: received on its own wires, both ports of a head together; 0 for a device inside another's stream.
        lost_kernel: units that the kernel dropped because its buffer was full.
        dropped: units that were dropped because the reader was too slow (``overflow="drop"``).
        records: decoded so far, by type; rows, if they come in rows.
        damaged: messages with a wrong checksum or a content that cannot be decoded.
        errors: counts by error code of docs/devices.
        time_state, time_sigma_s: of a receiver's or pulse's clock; empty and nan: it is none, or times are not wanted.
    """

    source: str
    state: str
    last_error: str = ""
    openings: int = 0
    units: int = 0
    bytes: int = 0
    lost_kernel: int = 0
    dropped: int = 0
    records: dict[str, int] = field(default_factory=dict)
    damaged: int = 0
    errors: dict[str, int] = field(default_factory=dict)
    time_state: str = ""
    time_sigma_s: float = math.nan


class Decoder:
    """One device's parser, which two wires may feed."""

    def __init__(self, entry: DeviceEntry) -> None:
        self.entry = entry
        self.parser = find_driver(entry.kind, entry.protocol).make_parser(entry.settings)
        self.counts: Counter[str] = Counter()
        self._lock = threading.Lock()

    def feed(
        self, units: Sequence[ChunkBatch], timed: Callable[[Sequence[Record]], list[Times]] | None
    ) -> tuple[list[Record], list[Times]]:
        """Decode units; return the records and their times, which are empty without ``timed``."""
        with self._lock:
            records = self.parser.feed_batches(units)
            times = timed(records) if timed is not None else []
        for record in records:
            self.counts[type(record).__name__] += row_count(record)
        return records, times


def row_count(record: Record) -> int:
    """Return the number of a record's rows; 1 for a record without rows."""
    rows = getattr(record, "rows", None)
    return 1 if rows is None else len(rows)


def decoded_counts(parser: Parser, records: Mapping[str, int]) -> dict[str, Any]:
    """Return the counts of what a parser decoded, as fields of `Status`."""
    damaged = parser.counters.bad_checksums + parser.counters.bad_messages
    return {"records": dict(records), "damaged": damaged, "errors": dict(parser.counters.errors)}


class Listening:
    """Opens devices' wires, and gives a loop what comes; an asynchronous context manager.

    Args:
        devices: as a configuration has them.
        pulses: by name.
        overflow: what happens to a wire whose batches are not taken in time.
        queue_bytes: of each wire that may wait.
        make_clocks: makes clocks for the host's clock of this listening; None: records get no GPS times.

    Attributes:
        clock: gives the host times.
        decoders: by source.
        listeners: by wire: ``pps/main``, ``scanner/left``, ``scanner/left/aux``.
        specs: transports by wire, without the pulses.
        senders: counts of datagrams by sender, by wire.
    """

    def __init__(
        self,
        devices: Iterable[DeviceEntry],
        pulses: Mapping[str, PpsConfig],
        *,
        overflow: Overflow = Overflow.WAIT,
        queue_bytes: int = QUEUE_BYTES,
        make_clocks: Callable[[HostClock], Clocks] | None = None,
    ) -> None:
        self.clock = HostClock()
        self.decoders = {entry.source: Decoder(entry) for entry in devices}
        self.listeners: dict[str, Listener[Any, Batch]] = {}
        self.specs: dict[str, TransportSpec] = {}
        self.senders: dict[str, Senders] = {}
        self._clocks = None if make_clocks is None else make_clocks(self.clock)
        self._read_clocks = threading.Lock()
        self._read_s = -math.inf
        self._ending = threading.Event()
        self._changed = asyncio.Event()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._reader: LoopReader[Batch] = LoopReader(queue_bytes, overflow)
        for name, pps in pulses.items():
            self._add(f"pps/{name}", partial(open_pps, parse_pps(pps.source, pps.edge)), self._edges(f"pps/{name}"))
        for wire, spec, decoders in self._wires():
            self.specs[wire] = spec
            decode = self._units(wire, decoders, stream=spec.kind in STREAMS)
            self._add(wire, partial(open_transport, spec, self._ending.is_set), decode)

    def _wires(self) -> Iterator[tuple[str, TransportSpec, list[Decoder]]]:
        """Yield the wires with the decoders that read them."""
        for source, decoder in self.decoders.items():
            entry = decoder.entry
            if entry.transport.carrier is not None:
                continue
            inside = [other for other in self.decoders.values() if other.entry.transport.carrier == source]
            yield source, entry.transport, [decoder, *inside]
            if entry.auxiliary is not None:
                yield f"{source}/aux", entry.auxiliary, [decoder, *inside]

    def _add(self, wire: str, make: Callable[[], Any], decode: Callable[[list[Any], bool], Measured[Batch]]) -> None:
        def session(told: Told) -> Session[Any]:
            return Session(make, on_change=told)

        self.listeners[wire] = Listener(
            wire, session, self._reader.backlog, decode, look=self._look, changed=self._tell_change
        )

    # ------------------------------------------------------------------ in the wires' threads

    def _units(
        self, wire: str, decoders: Sequence[Decoder], *, stream: bool
    ) -> Callable[[list[UnitBlock], bool], Measured[Batch]]:
        """Return the function that decodes a wire's blocks; one reading of a ``stream`` may hold bytes of seconds."""
        stamps, senders = StampConverter(self.clock), self.senders.setdefault(wire, Senders())

        def decode(blocks: list[UnitBlock], late: bool) -> Measured[Batch]:
            times = stamps.stamp(blocks)
            units = [
                ChunkBatch(wire, at, block.units if block.rows is not None else block.units.copy())
                for at, block in zip(times, blocks, strict=True)
            ]
            for at, block in zip(times, blocks, strict=True):
                if block.peer is not None and len(at):
                    senders.add(block.peer[0], int(at[0]), int(at[-1]), len(at))
            batch = Batch(wire, units, {})
            for decoder in decoders:
                source = decoder.entry.source
                timed = None
                if self._clocks is not None:
                    timed = partial(self._clocks.take, source, late=late and stream)
                batch.records[source], batch.times[source] = decoder.feed(units, timed)
            return batch.measured

        return decode

    def _edges(self, source: str) -> Callable[[list[RawEdge], bool], Measured[Batch]]:
        """Return the function that gives a pulse's edges to the clocks."""
        stamps = StampConverter(self.clock)

        def take(edges: list[RawEdge], late: bool) -> Measured[Batch]:
            del late  # an edge has its own stamp
            realtime_ns = np.array([edge.realtime_ns for edge in edges], np.int64)
            times = stamps.convert_at(realtime_ns, len(edges), read_clock_pair())
            if self._clocks is not None:
                for edge, host_ns in zip(edges, times.tolist(), strict=True):
                    self._clocks.add_edge(source, PpsEdge(host_ns, edge.sequence))
            return Batch(source, [], {}, edges=edges).measured

        return take

    def _look(self) -> None:
        """Give the clocks a reading of the host's clocks ten times a second, from whichever thread comes by."""
        if self._clocks is None or time.monotonic() - self._read_s < READING_S:
            return
        if self._read_clocks.acquire(blocking=False):
            try:
                self._read_s = time.monotonic()
                sample = read_clock_sample(read_clock_discipline())
                self._clocks.add_reading(
                    int(sample["realtime_ns"]),
                    int(sample["monotonic_ns"]),
                    int(sample["monotonic_raw_ns"]),
                    float(sample.get("max_error_s", math.inf)),
                )
            finally:
                self._read_clocks.release()

    def _tell_change(self) -> None:
        if self._loop is not None:
            with contextlib.suppress(RuntimeError):  # the loop was closed
                self._loop.call_soon_threadsafe(self._changed.set)

    # ------------------------------------------------------------------ in the loop

    async def __aenter__(self) -> Self:
        """Begin to open the wires."""
        self._loop = asyncio.get_running_loop()
        for listener in self.listeners.values():
            listener.start()
        return self

    async def __aexit__(self, *_: object) -> None:
        """Close the wires and wait for their threads, also if the task was cancelled."""
        await asyncio.shield(asyncio.to_thread(self.close))

    def close(self) -> None:
        """Close the wires and wait for their threads."""
        self._ending.set()
        self._reader.backlog.close()
        for listener in self.listeners.values():
            listener.stop()
        for listener in self.listeners.values():
            if listener.ident is not None:
                listener.join()

    async def tried(self) -> None:
        """Wait until every wire was opened, or refused to be, once."""
        while not all(listener.was_tried for listener in self.listeners.values()):
            self._changed.clear()
            if all(listener.was_tried for listener in self.listeners.values()):
                return
            await self._changed.wait()

    async def take(self) -> Batch | None:
        """Wait for the batch that came first; None: the wires are closed, and all batches are taken.

        Raises:
            BusyError: another task waits for a batch already.
        """
        return await self._reader.take()

    async def send(self, source: str, data: bytes) -> str:
        """Send one unit to a device; return why it was not sent, or an empty text."""
        session = self.listeners[source].session
        if await asyncio.to_thread(session.send, data):
            return ""
        return session.last_error or f"{source}: is not open yet"

    # ------------------------------------------------------------------ report

    def status(self, source: str) -> Status:
        """Return state and counts of a source: ``gnss/rover``, ``pps/main``."""
        decoder = self.decoders.get(source)
        carrier = None if decoder is None else decoder.entry.transport.carrier
        own = [self.listeners[wire] for wire in (source, f"{source}/aux") if wire in self.listeners]
        main = self.listeners[carrier or source]
        clock = None if self._clocks is None else self._clocks.state(source, self.clock.now_ns())
        state, sigma_s = clock or ("", math.nan)
        found = Status(
            source,
            main.state,
            main.session.last_error,
            main.session.openings,
            units=sum(listener.units for listener in own),
            bytes=sum(listener.bytes for listener in own),
            lost_kernel=sum(listener.counters.lost_kernel for listener in own),
            dropped=sum(self._reader.backlog.dropped(listener.wire) for listener in own),
            time_state=state,
            time_sigma_s=sigma_s,
        )
        return found if decoder is None else replace(found, **decoded_counts(decoder.parser, decoder.counts))

    @property
    def sources(self) -> list[str]:
        """Names of the devices."""
        return list(self.decoders)
