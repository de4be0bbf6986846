"""Reads the records of a log's sources, all or a slice of time; of a slice only its chunks are read.

The host's clock is settled by the whole log first, because a receiver may name a wrong second at its beginning; only
edges, readings of clocks and receivers' messages are read for it. The clock of an IMU or a scanner is then found from
the slice and a margin around it, with a sigma that says how well.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from swath.daemon.config.config import Config
from swath.daemon.config.tables import ImuConfig
from swath.daemon.errors import ConfigError, UserError
from swath.daemon.log.chunk_index import LogIndex, index_log, read_chunks
from swath.daemon.log.format import source_of_topic
from swath.daemon.log.mcap.chunks import LogBatch, json_objects
from swath.daemon.log.reader import PartDamage, Session
from swath.daemon.processing.head_clocks import find_stamps
from swath.daemon.processing.navigation.sources import config_of_log, files_of
from swath.daemon.processing.navigation.times import imu_times
from swath.daemon.processing.points.clocks import read_clocks
from swath.daemon.processing.points.runs import Run
from swath.daemon.processing.records.tables import KINDS, NO_TIME_NS, RecordKind, timed_rows
from swath.daemon.processing.records.times import arrival_times, clock_times, named_times
from swath.daemon.processing.setup.models import geometry_of
from swath.daemon.processing.setup.sources import Sources
from swath.drivers.parser import DeviceKind, Parser, ParserCounters
from swath.georef.arrays import Int64Array, StructArray
from swath.georef.records import (
    ChunkBatch,
    DeviceClockSamples,
    ImuSamples,
    InsSolution,
    Record,
    ScannerReturns,
)
from swath.georef.scanner.beams import Geometry
from swath.georef.stream.clocks import FrozenClocks, HostClocks, StreamClocks
from swath.georef.timescales import SECOND_NS, unix_from_gps

MARGIN_NS = 5 * SECOND_NS  # messages before a slice that belong to its epochs, and edges that a scanner latched
IMU_MARGIN_NS = 60 * SECOND_NS  # over which the counter of an IMU without a latch is compared with arrivals
SETTLE_NS = 2 * SECOND_NS  # returns wait for latched edges on both sides, as in georeferencing
EVER = (-(1 << 62), 1 << 62)
Span = tuple[int, int]


@dataclass
class LogRecords:
    """Gives the records of one session's sources.

    Attributes:
        config: configuration of the log, or another one.
        counters: counts of the parser that read a source last, by source.
        damage: parts of the files that could not be read.
    """

    session: Session
    config: Config
    files: dict[str, bytes]
    counters: dict[str, ParserCounters] = field(default_factory=dict)
    damage: list[PartDamage] = field(default_factory=list)

    @classmethod
    def of_session(cls, session: Session, config: Config | None = None) -> LogRecords:
        """Return the records of a session.

        Raises:
            UserError: the log holds no configuration that can be used, and none is given.
            OSError: a file that a given configuration names cannot be read.
        """
        files = files_of(session, config)
        try:
            return cls(session, config or config_of_log(files), files)
        except UserError as error:
            raise UserError(f"{session.parts[0].path}: {error}", error.exit_code) from error

    @cached_property
    def without_driver(self) -> dict[str, str]:
        """Why sources have no driver here, by source; their units can be read all the same."""
        return {source: str(error) for source, (_, error) in self.config.without_driver().items()}

    @cached_property
    def _sources(self) -> Sources:
        """The devices; only receivers must have a driver, whose time is that of all."""
        others = [source for source in self.without_driver if not source.startswith("gnss/")]
        return Sources(self.config.with_raw(others), self.files, sorted(self.config.scanner))

    @cached_property
    def _wires(self) -> Sources:
        return Sources(self.config.with_raw(self.without_driver), self.files)

    @cached_property
    def _index(self) -> LogIndex:
        return index_log(self.session)

    @cached_property
    def _host(self) -> HostClocks:
        return read_clocks(self.session, self._sources, motion=False).clocks.host

    @cached_property
    def _frozen(self) -> FrozenClocks:
        return find_stamps(self._index, self._sources, self._host)

    @property
    def sources(self) -> dict[str, DeviceKind]:
        """The kinds of the configured devices by source."""
        return {f"{kind}/{name}": kind for kind, name, _ in self.config.device_tables()}

    def protocol(self, source: str) -> str:
        """Return a source's protocol."""
        return next(table.protocol for kind, name, table in self.config.device_tables() if f"{kind}/{name}" == source)

    def host_span(self, start_ns: int | None, stop_ns: int | None) -> Span:
        """Return the host's times of a span of GPS time, [start, stop); None: the log's begin or end.

        Raises:
            UserError: the log does not know GPS time.
        """
        if start_ns is None and stop_ns is None:
            return EVER
        clock = self._clock()
        if clock is None:
            raise UserError(f"{self.session.parts[0].path}: no GPS time is known in this log; leave start and stop out")
        first = self.begin_host_ns
        found = [
            edge if given is None else self._host_from_gps(clock, given, first)
            for given, edge in ((start_ns, EVER[0]), (stop_ns, EVER[1]))
        ]
        return found[0], found[1]

    @property
    def begin_host_ns(self) -> int:
        """The host's time of the log's first message, ns; 0: it has none."""
        return min((place.start_ns for place in self._index.chunks), default=0)

    def _clock(self) -> str | None:
        """Return the source whose clock gives the host's time; None: no clock has locked."""
        at = np.array([place.end_ns for place in self._index.chunks[-1:]], np.int64)
        for source in [*self._host.plan.pps, *self._host.plan.gnss]:
            if len(at) and np.isfinite(self._host.gps_from_host(source, at)[1]).all():
                return source
        return None

    def _host_from_gps(self, clock: str, gps_ns: int, near_ns: int) -> int:
        """Return the host's time of a GPS time; the two clocks differ by parts in a million, so few steps suffice."""
        host_ns = near_ns
        for _ in range(4):
            there, _sigma = self._host.gps_from_host(clock, np.array([host_ns], np.int64))
            host_ns += gps_ns - int(there[0])
        return host_ns

    def span(self) -> Span | None:
        """Return the GPS times of the log's first and last message; None: no GPS time is known."""
        clock = self._clock()
        if clock is None:
            return None
        ends = [self.begin_host_ns, max(p.end_ns for p in self._index.chunks)]
        first, last = self._host.gps_from_host(clock, np.array(ends, np.int64))[0].tolist()
        return first, last

    @cached_property
    def _host_late_ns(self) -> int:
        """POSIX time less the host's, at the log's end; 0 without a clock."""
        clock = self._clock()
        if clock is None:
            return 0
        end_ns = self._index.chunks[-1].end_ns
        gps_ns, _sigma = self._host.gps_from_host(clock, np.array([end_ns], np.int64))
        return unix_from_gps(int(gps_ns[0])) - end_ns

    def posix_of_host(self, host_ns: int) -> int:
        """Return the POSIX time of a time of the host's clock, ns, corrected where the log knows GPS time."""
        return host_ns + self._host_late_ns

    def posix_ns(self, table: StructArray) -> Int64Array:
        """Return the POSIX times (n,) of a table's rows, ns, by their GPS times and the built-in table of leap seconds.

        Of rows without a GPS time by the host's clock, corrected where the log knows GPS time.
        """
        gps_ns: Int64Array = table["gps_ns"]
        times: Int64Array = table["host_time_ns"] + self._host_late_ns
        known = np.flatnonzero(gps_ns >= 0)
        if len(known):  # leap seconds are those of the first
            first = int(gps_ns[known[0]])
            times[known] = gps_ns[known] + (unix_from_gps(first) - first)
        return times

    # ------------------------------------------------------------------ reading

    def units(self, source: str, host_span: Span = EVER) -> Iterator[tuple[int, bytes]]:
        """Yield the units of the wire that carries a source, with their host times, ns."""
        for batch in self._batches(source, host_span):
            inside = (batch.host_time_ns >= host_span[0]) & (batch.host_time_ns < host_span[1])
            for time_ns, unit in zip(batch.host_time_ns[inside].tolist(), batch.units[inside], strict=True):
                yield time_ns, unit.tobytes()

    def records(self, source: str, host_span: Span = EVER) -> Iterator[list[Record]]:
        """Yield the records of a source as its parser gives them, in pieces, from the chunks of a span of host time."""
        parser = self._parser(source)
        self.counters[source] = parser.counters
        found: list[Record] = []
        run = Run(lambda batches: found.extend(parser.feed_batches(batches)))
        for batch in self._batches(source, host_span):
            run.add(batch)
            if found:
                yield found.copy()
                found.clear()
        run.flush()
        yield [*found, *parser.close()]

    def events(self) -> Iterator[dict[str, Any]]:
        """Yield the recorder's events, in order."""
        places = [place for place in self._index.chunks if place.other]
        for batch in read_chunks(self._index, places, lambda topic: topic == "/events", self.damage):
            yield from (event for _, event in json_objects(batch))

    def in_body(self, source: str, rows: StructArray) -> StructArray:
        """Return a source's solutions with the attitude of the body instead of the IMU's own axes."""
        return self._sources.ins_rows(rows, source)

    def geometry(self, source: str) -> Geometry:
        """Return the geometry of a scanner's beams.

        Raises:
            ValueError: it is not known; one line.
        """
        return geometry_of(self.config.scanner[source.removeprefix("scanner/")], self._parser(source))

    def _parser(self, source: str) -> Parser:
        if source in self.without_driver:
            raise ConfigError(f"{source.replace('/', '.')}.protocol: {self.without_driver[source]}")
        return self._sources.parsers((self.sources[source],), whole=True)[source]

    def _batches(self, source: str, host_span: Span) -> Iterator[ChunkBatch]:
        """Yield the units of a source's wire from the chunks that reach into a span of host time."""
        scanner = self.sources[source] == "scanner" or self._wires.is_in_scanner(source)
        start_ns, stop_ns = host_span

        def is_of_wire(topic: str) -> bool:
            wire = (source_of_topic(topic) or "").removesuffix("/aux")
            return bool(wire) and source in self._wires.inside(wire)

        places = [
            place
            for place in self._index.chunks
            if (place.scanner if scanner else place.other) and place.start_ns < stop_ns and place.end_ns >= start_ns
        ]
        for batch in read_chunks(self._index, places, is_of_wire, self.damage):
            yield _chunk_batch(batch)

    # ------------------------------------------------------------------ tables

    def table(self, source: str, name: str, start_ns: int | None = None, stop_ns: int | None = None) -> StructArray:
        """Return a table (n,) of a source's records of one kind in a span of GPS time, [start, stop).

        Args:
            source: ``gnss/rover``.
            name: a name in `KINDS`.
            start_ns, stop_ns: GPS ns; None: the log's begin or end. Without both, records without a time come too.

        Raises:
            UserError: the log does not know GPS time, and a span is wanted.
        """
        kind = KINDS[name]
        if kind.record is ScannerReturns:
            pieces = list(self.returns(source, start_ns, stop_ns))
            return np.concatenate(pieces) if pieces else np.empty(0, kind.dtype)
        return self.tables(source, [name], start_ns, stop_ns)[name]

    def tables(
        self, source: str, names: Iterable[str], start_ns: int | None = None, stop_ns: int | None = None
    ) -> dict[str, StructArray]:
        """Return tables of a source's records of several kinds, returns excepted, in one reading; see `table`."""
        kinds = [KINDS[name] for name in names]
        begin, end = self.host_span(start_ns, stop_ns)
        margin = IMU_MARGIN_NS if any(kind.record is ImuSamples for kind in kinds) else MARGIN_NS
        found: dict[type, list[Any]] = {kind.record: [] for kind in kinds}
        for records in self.records(source, (begin - margin, end + margin)):
            for record in records:
                if type(record) in found:
                    found[type(record)].append(record)
        placed = {kind.name: self._placed(source, kind, found[kind.record]) for kind in kinds}
        return {name: _within(table, start_ns, stop_ns) for name, table in placed.items()}

    def _placed(self, source: str, kind: RecordKind, records: list[Any]) -> StructArray:
        """Return a table of records with their GPS times."""
        if kind.record is ImuSamples:
            return self._samples(source, records)
        table = kind.table(records)
        if not len(table):
            return table
        if kind.record is InsSolution:
            table["time_sigma_s"][table["gps_ns"] >= 0] = 0.0
            return table
        if kind.names_time:
            times = named_times(self._host, source, records)
        else:
            times = arrival_times(self._host, source, table["host_time_ns"], self._clock())
        table["gps_ns"], table["time_sigma_s"] = times
        return table

    def _samples(self, source: str, records: list[ImuSamples]) -> StructArray:
        rows = np.concatenate([record.rows for record in records]) if records else KINDS["samples"].table([])
        if not len(rows):
            return KINDS["samples"].table([])
        imu = self._imu(source)
        times = imu_times(rows, self._host, self._sources.clock_of(imu.pps), imu.rate_hz)
        table = timed_rows(rows)
        table["gps_ns"][times.placed], table["time_sigma_s"][times.placed] = times.gps_ns, times.sigma_ns / SECOND_NS
        return table

    def _imu(self, source: str) -> ImuConfig:
        return self.config.imu[source.removeprefix("imu/")]

    def returns(self, source: str, start_ns: int | None = None, stop_ns: int | None = None) -> Iterator[StructArray]:
        """Yield tables of a scanner's returns in a span of GPS time, in order of arrival; memory is bounded.

        Raises:
            UserError: the log does not know GPS time, and a span is wanted.
        """
        begin, end = self.host_span(start_ns, stop_ns)
        waiting = _Waiting(source, self._frozen.for_stream())
        for records in self.records(source, (begin - MARGIN_NS, end + MARGIN_NS)):
            for table in waiting.take(records):
                yield from _some(_within(table, start_ns, stop_ns))
        for table in waiting.close():
            yield from _some(_within(table, start_ns, stop_ns))


class _Waiting:
    """Holds returns until their device's clock is known on both sides of them."""

    def __init__(self, source: str, clocks: StreamClocks) -> None:
        self._source, self._clocks = source, clocks
        self._held: list[StructArray] = []

    def take(self, records: list[Record]) -> Iterator[StructArray]:
        """Take a piece's records; yield tables of returns whose times are known now."""
        newest_ns = 0
        for record in records:
            if isinstance(record, DeviceClockSamples):
                self._clocks.add_samples(self._source, record.rows)
                newest_ns = max(newest_ns, int(record.rows["host_time_ns"].max(initial=0)))
            elif isinstance(record, ScannerReturns) and len(record.rows):
                self._held.append(record.rows)
        while self._held and int(self._held[0]["host_time_ns"][-1]) < newest_ns - SETTLE_NS:
            yield self._timed(self._held.pop(0))

    def close(self) -> Iterator[StructArray]:
        """Yield the tables that still wait."""
        while self._held:
            yield self._timed(self._held.pop(0))

    def _timed(self, rows: StructArray) -> StructArray:
        self._clocks.update()
        gps_ns, sigma_ns = self._clocks.gps_from_device(self._source, rows["device_time_ns"], rows["host_time_ns"])
        table = timed_rows(rows)
        table["gps_ns"], table["time_sigma_s"] = clock_times(gps_ns, sigma_ns)
        return table


def _chunk_batch(batch: LogBatch) -> ChunkBatch:
    return ChunkBatch(source_of_topic(batch.channel.topic) or "", batch.log_time_ns, batch.units)


def _within(table: StructArray, start_ns: int | None, stop_ns: int | None) -> StructArray:
    """Return the rows in a span of GPS time, [start, stop); without a span, all rows."""
    if start_ns is None and stop_ns is None:
        return table
    gps_ns: Int64Array = table["gps_ns"]
    inside = gps_ns != NO_TIME_NS
    if start_ns is not None:
        inside &= gps_ns >= start_ns
    if stop_ns is not None:
        inside &= gps_ns < stop_ns
    rows: StructArray = table[inside]
    return rows


def _some(table: StructArray) -> Iterator[StructArray]:
    if len(table):
        yield table
