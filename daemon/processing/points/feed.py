"""Turns a log's messages into a stream of points: parsers are fed in the order of the file, the stream decides at
ticks.

A tick is where the newest log time so far passes a multiple of 200 ms, or where 32 MiB have come since the last one.
Both depend on the order of the messages alone, so ticks are the same for a log that is read at once, one that is
followed while it is written, and one that comes message by message.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from swath.daemon.log.format import source_of_topic
from swath.daemon.log.host_messages import edges_of, readings_of
from swath.daemon.log.mcap.chunks import LogBatch
from swath.daemon.processing.navigation.live import Navigator, navigator_of
from swath.daemon.processing.points.runs import Run
from swath.daemon.processing.setup.models import connect
from swath.daemon.processing.setup.setup import Setup
from swath.drivers.parser import DeviceKind, Parser
from swath.georef.arrays import BoolArray, StructArray
from swath.georef.points import Points
from swath.georef.records import (
    ChunkBatch,
    DeviceClockSamples,
    GnssFix,
    InsSolution,
    Record,
    ScannerReturns,
    TimeMessage,
)
from swath.georef.stream.stream import CONTEXT_FLAG, Stream
from swath.georef.trajectory.buffer import SOLUTION_STATUS

TICK_NS = 200_000_000
TICK_BYTES = 32 << 20
Placed = list[tuple[str, Points]]
Tick = tuple[int, int, int | None]  # first message, the one after the last, and the tick that follows


def _any_status(status: NDArray[np.uint32]) -> BoolArray:
    return np.ones(len(status), np.bool_)


class FeedWatch(Protocol):
    """Sees what a feed takes, in the order of the log and with its ticks; the points do not depend on it."""

    def taker(self, topic: str) -> Callable[[LogBatch], None] | None:
        """Return the function that takes the messages of a topic that the feed does not use; None: not wanted."""

    def record(self, source: str, record: Record) -> None:
        """Take a record of a source."""

    def tick(self, tick_ns: int | None, placed: Placed) -> None:
        """Take the points that became final at a tick; None: at the end of the log."""


class LogFeed:
    """Feeds one session's log into a stream.

    Args:
        setup: makes the sources' parsers.
        stream: stream made by `Setup.stream`; its clocks are the session's.
        watch: sees everything too; receivers are then decoded whole.

    Attributes:
        counts: by source, number of records taken and of those left out.
        fixes: by source, the newest position of its first antenna.
    """

    def __init__(self, setup: Setup, stream: Stream, watch: FeedWatch | None = None) -> None:
        self.stream = stream
        self._watch = watch
        self.counts: dict[str, Counter[str]] = {}
        self.fixes: dict[str, GnssFix] = {}
        self._setup = setup
        kinds: tuple[DeviceKind, ...] = ("gnss", "scanner")
        self._parsers = setup.sources.parsers(kinds, whole=watch is not None) | setup.sources.ins_parser()
        # for a growing log, until the device's own INS has a solution
        self.navigator: Navigator | None = None
        if not stream.clocks.frozen:
            self.navigator = navigator_of(setup.config, setup.sources.attachments, stream.clocks)
        self._is_solution = SOLUTION_STATUS.get(setup.sources.ins_protocol, _any_status)
        if self.navigator is not None:
            self._parsers |= self.navigator.parsers
        for name in stream.scanners:
            connect(stream.chain(name), self._parsers[f"scanner/{name}"])
        self._newest_ns: int | None = None
        self._bytes = 0
        self._context = False
        self._takers: dict[str, Callable[[LogBatch], None] | None] = {}
        self._runs: dict[str, Run] = {}

    def take(self, batch: LogBatch, *, context: bool = False) -> Placed:
        """Take the next messages; return the points that have become final.

        Args:
            batch: messages in the order of the file.
            context: True for messages around the wanted piece of the log: they feed clocks, trajectory and parsers, and
                their returns give no points.
        """
        if context != self._context:
            self.flush()
            self._context = context
        placed: Placed = []
        for first, last, tick_ns in self._pieces(batch):
            if first < last:
                self._feed(batch.between(first, last))
            if tick_ns is not None:
                self.flush()
                self._navigate(tick_ns)
                given = self.stream.advance(tick_ns)
                placed += given
                if self._watch is not None:
                    self._watch.tick(tick_ns, given)
        return placed

    def _navigate(self, tick_ns: int | None) -> None:
        if self.navigator is not None:
            poses = self.navigator.close() if tick_ns is None else self.navigator.advance(tick_ns)
            if len(poses):
                self.stream.path.add(poses)

    def flush(self) -> None:
        """Decode the units that wait to be decoded together."""
        for run in self._runs.values():
            run.flush()

    def close(self) -> Placed:
        """Flush the stream at the end of the log and return the last points."""
        self.flush()
        for source, parser in self._parsers.items():
            self._take_records(source, parser.close())
        self._navigate(None)
        placed = self.stream.close()
        if self._watch is not None:
            self._watch.tick(None, placed)
        return placed

    def parser(self, source: str) -> Parser:
        """Return the parser of a source (``scanner/left``), for its counters."""
        return self._parsers[source]

    def _pieces(self, batch: LogBatch) -> Iterator[Tick]:
        """Yield runs of messages and the tick after each; the last run has none unless it reaches `TICK_BYTES`."""
        times, size = batch.log_time_ns, batch.rows.shape[1]
        if self._newest_ns is None:
            self._newest_ns = int(times[0])
        latest_ns = max(int(times.max()), self._newest_ns)
        if latest_ns // TICK_NS == self._newest_ns // TICK_NS and self._bytes + len(times) * size < TICK_BYTES:
            self._bytes, self._newest_ns = self._bytes + len(times) * size, latest_ns
            yield 0, len(times), None
            return
        newest = np.maximum.accumulate(np.maximum(times, self._newest_ns))
        before = np.concatenate([[self._newest_ns], newest[:-1]])
        crossing = np.flatnonzero(newest // TICK_NS > before // TICK_NS).tolist()
        first = 0
        for place in [*crossing, len(times)]:
            while (place - first) * size + self._bytes >= TICK_BYTES:
                full = first + max(1, -(-(TICK_BYTES - self._bytes) // size))
                self._bytes = 0
                yield first, full, int(newest[full - 1]) // TICK_NS * TICK_NS
                first = full
            if place < len(times):
                self._bytes = 0
                yield first, place, int(newest[place]) // TICK_NS * TICK_NS
                first = place
        self._bytes += (len(times) - first) * size
        self._newest_ns = int(newest[-1])
        yield first, len(times), None

    def _feed(self, batch: LogBatch) -> None:
        topic = batch.channel.topic
        if topic not in self._takers:
            self._takers[topic] = self._taker(topic)
        taker = self._takers[topic]
        if taker is not None:
            taker(batch)

    def _taker(self, topic: str) -> Callable[[LogBatch], None] | None:
        """Return the function that takes the messages of a topic; None: the topic is not used."""
        if topic == "/clock":
            return self._take_readings
        source = source_of_topic(topic)
        if source is None:
            return None if self._watch is None else self._watch.taker(topic)
        if source.startswith("pps/"):
            edge = self._setup.sources.edge_of(source)
            return None if edge is None else lambda batch: self._take_edges(source, edge, batch)
        inside = [name for name in self._setup.sources.inside(source.removesuffix("/aux")) if name in self._parsers]
        if not inside:
            return None

        def parse(batches: list[ChunkBatch]) -> None:
            for name in inside:
                self._take_records(name, self._parsers[name].feed_batches(batches))

        if source.startswith("scanner/"):  # records of a scanner wait for the tick, separately for each scanner
            run = self._runs.setdefault(inside[0], Run(parse))
            return lambda batch: run.add(ChunkBatch(source, batch.log_time_ns, batch.units))
        return lambda batch: parse([ChunkBatch(source, batch.log_time_ns, batch.units)])

    def _take_readings(self, batch: LogBatch) -> None:
        for reading in readings_of(batch):
            self.stream.clocks.add_reading(*reading)

    def _take_edges(self, source: str, edge: str, batch: LogBatch) -> None:
        counts = self.counts.setdefault(source, Counter())
        for found in edges_of(batch, edge):
            if found is None:
                counts["refused"] += 1
                continue
            counts["edges"] += 1
            self.stream.clocks.add_edge(source, found)

    def _take_records(self, source: str, records: list[Record]) -> None:
        if not records:
            return
        counts = self.counts.setdefault(source, Counter())
        clocks = self.stream.clocks
        for record in records:
            rows = getattr(record, "rows", None)
            if isinstance(record, ScannerReturns):
                rows = np.flatnonzero(record.rows["number_of_returns"])  # the others are pulses without a return
            # 228
            counts[type(record).__name__] += 1 if rows is None else len(rows)
            if isinstance(record, GnssFix) and record.lat_rad is not None and record.antenna == "primary":
                self.fixes[source] = record
            if self._watch is not None:
                self._watch.record(source, record)
            if isinstance(record, ScannerReturns):
                self._take_returns(source, record.rows)
            elif isinstance(record, TimeMessage) and source in clocks.host.plan.gnss:
                clocks.add_message(source, record)
            elif isinstance(record, DeviceClockSamples) and source.removeprefix("scanner/") in self.stream.scanners:
                if source in clocks.host.plan.devices:
                    clocks.add_samples(source, record.rows)
            elif isinstance(record, InsSolution) and source == self._setup.sources.ins_source:
                self.stream.path.add(self._setup.sources.ins_rows(record.rows))
                if self.navigator is not None and self._is_solution(record.rows["status"]).any():
                    self.navigator = None
            elif self.navigator is not None:
                self.navigator.take(source, record)

    def _take_returns(self, source: str, rows: StructArray) -> None:
        name = source.removeprefix("scanner/")
        if self._context:
            rows = rows.copy()
            rows["flags"] |= CONTEXT_FLAG
        self.stream.add_returns(name, rows)
