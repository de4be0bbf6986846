"""From a log's messages to a stream of points: parsers are fed in the order of the file, the stream decides at ticks.

A tick is where the newest log time so far passes a multiple of 200 ms, or where 32 MiB have come since the last one.
Both depend on the order of the messages alone, so it is the same for a log that is read whole, one that is followed
while it is written, and one that comes message by message.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from swath.daemon.log.format import source_of_topic
from swath.daemon.log.host_messages import edges_of, readings_of
from swath.daemon.log.mcap.chunks import LogBatch
from swath.daemon.log.reader import Session
from swath.daemon.processing.setup.models import connect
from swath.daemon.processing.setup.setup import Setup
from swath.drivers.parser import Parser
from swath.georef.points import Points
from swath.georef.records import (
    IMU_DTYPE,
    INS_DTYPE,
    ChunkBatch,
    DeviceClockSamples,
    GnssFix,
    ImuSamples,
    InsSolution,
    Record,
    ScannerReturns,
    StructArray,
    TimeMessage,
)
from swath.georef.scanner.mount import AngleSeries, MountError
from swath.georef.stream.clocks import FrozenClocks, HostClocks
from swath.georef.stream.stream import CONTEXT_FLAG, Stream, StreamSettings
from swath.georef.trajectory.buffer import SOLUTION_STATUS

if TYPE_CHECKING:
    from swath.daemon.processing.navigation.live import Navigator

TICK_NS = 200_000_000
TICK_BYTES = 32 << 20
JOINED_BYTES = 256 << 10  # of a source's units, that are decoded at once where others' stand between them
Placed = list[tuple[str, Points]]
Tick = tuple[int, int, int | None]  # messages from one to before another, and the tick that comes after them


class _Run:
    """Consecutive units of a source that wait to be decoded together, for a call of a parser costs as much as many."""

    def __init__(self, parse: Callable[[list[ChunkBatch]], None]) -> None:
        self._parse = parse
        self._held: list[ChunkBatch] = []
        self._bytes = 0

    def add(self, units: ChunkBatch) -> None:
        """The next ones, of any length; those of another wire are decoded before them."""
        if self._held and self._held[0].source != units.source:
            self.flush()
        self._held.append(units)
        self._bytes += units.units.size
        if self._bytes >= JOINED_BYTES:
            self.flush()

    def flush(self) -> None:
        """Decode them now."""
        held, self._held, self._bytes = self._held, [], 0
        if held:
            self._parse(held)


def _any_status(status: NDArray[np.uint32]) -> NDArray[np.bool_]:
    return np.ones(len(status), np.bool_)


class LogFeed:
    """Feeds one session's log into a stream.

    Args:
        setup: makes the sources' parsers.
        stream: made by `Setup.stream`; its clocks are the session's.

    Attributes:
        counts: by source, of records taken and of what was left out.
    """

    def __init__(self, setup: Setup, stream: Stream) -> None:
        self.stream = stream
        self.counts: dict[str, Counter[str]] = {}
        self._setup = setup
        self._parsers = setup.parsers(("gnss", "scanner")) | setup.ins_parser()
        # of a growing log; until the device's own INS has a solution
        self.navigator: Navigator | None = None if stream.clocks.frozen else setup.navigator(stream.clocks)
        self._is_solution = SOLUTION_STATUS.get(setup.ins_protocol, _any_status)
        if self.navigator is not None:
            self._parsers |= self.navigator.parsers
        for name in stream.scanners:
            connect(stream.chain(name), self._parsers[f"scanner/{name}"])
        self._newest_ns: int | None = None
        self._bytes = 0
        self._context = False
        self._takers: dict[str, Callable[[LogBatch], None] | None] = {}
        self._runs: dict[str, _Run] = {}

    def take(self, batch: LogBatch, *, context: bool = False) -> Placed:
        """The next messages; the points that have become final.

        Args:
            batch: in the order of the file.
            context: they stand around the piece of the log that is wanted: they feed clocks, trajectory and parsers,
                and their returns give no points.
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
                placed += self.stream.advance(tick_ns)
        return placed

    def _navigate(self, tick_ns: int | None) -> None:
        if self.navigator is not None:
            poses = self.navigator.close() if tick_ns is None else self.navigator.advance(tick_ns)
            if len(poses):
                self.stream.path.add(poses)

    def flush(self) -> None:
        """Decode what is held to be decoded together."""
        for run in self._runs.values():
            run.flush()

    def close(self) -> Placed:
        """The log is over."""
        self.flush()
        for source, parser in self._parsers.items():
            self._take_records(source, parser.close())
        self._navigate(None)
        return self.stream.close()

    def parser(self, source: str) -> Parser:
        """The parser of a source (``scanner/left``), for its counters."""
        return self._parsers[source]

    def _pieces(self, batch: LogBatch) -> Iterator[Tick]:
        """Runs of messages, and the tick that comes after each; the last run has none unless it fills the bytes."""
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
        """What takes the messages of a topic; None: nobody wants them."""
        if topic == "/clock":
            return self._take_readings
        source = source_of_topic(topic)
        if source is None:
            return None
        if source.startswith("pps/"):
            edge = self._setup.edge_of(source)
            return None if edge is None else lambda batch: self._take_edges(source, edge, batch)
        inside = [name for name in self._setup.inside(source.removesuffix("/aux")) if name in self._parsers]
        if not inside:
            return None

        def parse(batches: list[ChunkBatch]) -> None:
            for name in inside:
                self._take_records(name, self._parsers[name].feed_batches(batches))

        if source.startswith("scanner/"):  # whose records wait for the tick, each scanner's for themselves
            run = self._runs.setdefault(inside[0], _Run(parse))
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
                rows = np.flatnonzero(record.rows["number_of_returns"])  # the others are pulses that gave none
            counts[type(record).__name__] += 1 if rows is None else len(rows)
            if isinstance(record, ScannerReturns):
                self._take_returns(source, record.rows)
            elif isinstance(record, TimeMessage) and source in clocks.host.plan.gnss:
                clocks.add_message(source, record)
            elif isinstance(record, DeviceClockSamples) and source.removeprefix("scanner/") in self.stream.scanners:
                if source in clocks.host.plan.devices:
                    clocks.add_samples(source, record.rows)
            elif isinstance(record, InsSolution) and source == self._setup.ins_source:
                self.stream.path.add(self._setup.ins_rows(record.rows))
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


# ---------------------------------------------------------------------- all of a log's clocks, before its returns


@dataclass(slots=True)
class LogClocks:
    """What all of a log says of time and motion, but for its scanners; pickles.

    Attributes:
        clocks: the host's clock by source, complete.
        ins_rows: solutions of the device's INS, `INS_DTYPE`, attitude of b.
        imu_gps_ns: (n,) GPS time of the samples' arrival; imu_rate_b: (n, 3) rad/s, axes of b. To check that a
            trajectory's motion is this flight's.
        angles: of gimbals, by the source that told them.
        counts: records by source.
        imu_force_b: (n, 3) m/s², axes of b, and fixes: of receivers, by source. To check that a trajectory is of this
            flight; empty unless asked for.
        remarks: lines for the user, of parsers.
    """

    clocks: FrozenClocks
    ins_rows: StructArray
    imu_gps_ns: np.ndarray[Any, np.dtype[np.int64]]
    imu_rate_b: np.ndarray[Any, np.dtype[np.float64]]
    angles: dict[str, AngleSeries] = field(default_factory=dict)
    counts: dict[str, Counter[str]] = field(default_factory=dict)
    imu_force_b: np.ndarray[Any, np.dtype[np.float64]] = field(default_factory=lambda: np.empty((0, 3)))
    fixes: dict[str, list[GnssFix]] = field(default_factory=dict)
    remarks: list[str] = field(default_factory=list)


class _ClockReader:
    """Collects what all but the scanners say."""

    def __init__(self, setup: Setup, session: Session, *, positions: bool) -> None:
        self.host = HostClocks(setup.clock_plan(session.info), keep_history=True)
        self.fixes: dict[str, list[GnssFix]] = {}
        self._positions = positions
        self.ins: list[StructArray] = []
        self.imu: list[StructArray] = []
        self.gimbals: dict[str, list[StructArray]] = {source: [] for source in setup.gimbal_sources}
        self.counts: dict[str, Counter[str]] = {}
        self.remarks: list[str] = []
        self._setup = setup
        self._parsers = setup.parsers(("gnss", "imu"), whole=positions)
        self._runs: dict[str, _Run] = {}

    def take(self, batch: LogBatch) -> None:
        """The next messages."""
        topic = batch.channel.topic
        source = source_of_topic(topic)
        if topic == "/clock":
            for reading in readings_of(batch):
                self.host.add_reading(*reading)
        elif source is not None and source.startswith("pps/"):
            edge = self._setup.edge_of(source)
            for found in edges_of(batch, edge) if edge is not None else ():
                if found is not None:
                    self.host.add_edge(source, found)
        elif source is not None:  # its own order is enough: times are taken all at once
            run = self._runs.setdefault(source, _Run(partial(self._parse, self._setup.inside(source))))
            run.add(ChunkBatch(source, batch.log_time_ns, batch.units))

    def _parse(self, names: Iterable[str], batches: list[ChunkBatch]) -> None:
        for name in names:
            if name in self._parsers:
                self.take_records(name, self._parsers[name].feed_batches(batches))

    def close(self) -> None:
        """Tails of the streams, and all times at once."""
        for run in self._runs.values():
            run.flush()
        for name, parser in self._parsers.items():
            self.take_records(name, parser.close())
            self.remarks += parser.remarks()
        self.host.update()
        self.remarks += self.host.settle()

    def angles(self) -> dict[str, AngleSeries]:
        """Of gimbals, from the sources that told some."""
        found: dict[str, AngleSeries] = {}
        for source, pieces in sorted(self.gimbals.items()):
            rows = np.concatenate(pieces) if pieces else np.empty(0, INS_DTYPE)
            is_solution = SOLUTION_STATUS.get(self._setup.protocol(source))
            with suppress(MountError):  # fewer than two: who needs them says so
                found[source] = AngleSeries.of_solutions(
                    rows if is_solution is None else rows[is_solution(rows["status"])]
                )
        return found

    def take_records(self, source: str, records: list[Record]) -> None:
        """Of a parser."""
        counts = self.counts.setdefault(source, Counter())
        for record in records:
            rows = getattr(record, "rows", None)
            counts[type(record).__name__] += 1 if rows is None else len(rows)
            if isinstance(record, TimeMessage) and source in self.host.plan.gnss:
                self.host.add_message(source, record)
            elif isinstance(record, InsSolution) and source == self._setup.ins_source:
                self.ins.append(record.rows)
            elif isinstance(record, InsSolution) and source in self.gimbals:
                self.gimbals[source].append(record.rows)
            elif isinstance(record, ImuSamples) and source == self._setup.imu_source:
                self.imu.append(record.rows)
            elif isinstance(record, GnssFix) and self._positions:
                self.fixes.setdefault(source, []).append(record)


def read_clocks(session: Session, setup: Setup, *, positions: bool = False) -> LogClocks:
    """Read all but the scanners' messages of a session, a first pass before its returns are georeferenced.

    What belongs to scanners is passed over chunk by chunk: a chunk holds one class of channels. With ``positions``
    the receivers' fixes and the IMU's specific forces are kept too.
    """
    reader = _ClockReader(setup, session, positions=positions)
    for batch in session.batches(lambda topic: not topic.startswith("/scanner/"), skim=True):
        reader.take(batch)
    reader.close()
    ins = setup.ins_rows(np.concatenate(reader.ins) if reader.ins else np.empty(0, INS_DTYPE))
    imu = np.concatenate(reader.imu) if reader.imu else np.empty(0, IMU_DTYPE)
    gps_ns, rate_b, force_b = np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3))
    clock = setup.clock_of_imu
    if len(imu) and clock is not None:
        gps_ns, sigma_ns = reader.host.gps_from_host(clock, imu["host_time_ns"])
        known = sigma_ns <= StreamSettings().max_time_sigma_ns  # a worse clock says nothing of a trajectory's
        gps_ns, rate_b = gps_ns[known], setup.in_b(imu["angular_rate_b"][known])
        if positions:
            force_b = setup.in_b(imu["specific_force_b"][known])
    host = FrozenClocks(reader.host)
    found = LogClocks(host, ins, gps_ns, rate_b, reader.angles(), reader.counts, force_b, reader.fixes)
    found.remarks = reader.remarks
    return found
