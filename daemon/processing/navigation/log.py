"""Reads a log for navigation: the IMU's samples, fixes, headings, marks, and the clocks that place them in time."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from swath.daemon.log.chunk_index import SCANNER, Listening
from swath.daemon.log.format import source_of_topic
from swath.daemon.log.host_messages import feed_clocks
from swath.daemon.log.reader import Session
from swath.daemon.processing.undecoded import refused_by
from swath.georef.arrays import StructArray
from swath.georef.records import (
    IMU_DTYPE,
    INS_DTYPE,
    ChunkBatch,
    EventMark,
    GnssFix,
    GnssHeading,
    ImuSamples,
    InsSolution,
    Record,
    TimeMessage,
)
from swath.georef.stream.clocks import HostClocks

if TYPE_CHECKING:
    from swath.daemon.log.mcap.chunks import LogBatch
    from swath.daemon.processing.navigation.sources import NavigationSources


@dataclass(slots=True)
class NavigationLog:
    """The navigation data of one session.

    Attributes:
        host: the host's clocks, complete.
        imu: rows of the IMU, `IMU_DTYPE`, axes of the IMU itself.
        fixes, headings: records of the receiver, in order of arrival.
        marks: event marks of all receivers, with their source.
        ins: solutions of a device's INS, `INS_DTYPE`, attitude of b.
        counts: number of records by source and type.
        refused: messages that gave no record, by source and reason.
        heard: by source: number of bytes, of bytes outside any message, and of messages by name.
        lost: number of units that the recorder lost, by source.
        warnings: doubts about the sources' messages, one line each.
        remarks: parsers' lines for the user.
    """

    session: Session
    host: HostClocks
    imu: StructArray
    fixes: list[GnssFix] = field(default_factory=list)
    headings: list[GnssHeading] = field(default_factory=list)
    marks: list[tuple[str, EventMark]] = field(default_factory=list)
    ins: StructArray = field(default_factory=lambda: np.empty(0, INS_DTYPE))
    counts: dict[str, Counter[str]] = field(default_factory=dict)
    refused: dict[str, Counter[str]] = field(default_factory=dict)
    heard: dict[str, tuple[int, int, Counter[str]]] = field(default_factory=dict)
    lost: dict[str, int] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)


class _Reader:
    """Collects the navigation records of a session."""

    def __init__(self, sources: NavigationSources, session: Session) -> None:
        unnamed = sources.gnss_name is None
        host = HostClocks(sources.clock_plan(session.info), keep_history=True, wall_names=unnamed)
        self.found = NavigationLog(session, host, np.empty(0, IMU_DTYPE))
        self._sources = sources
        self._parsers = sources.parsers()
        self._imu: list[StructArray] = []
        self._ins: list[StructArray] = []

    def take(self, batch: LogBatch) -> None:
        """Take the next messages."""
        if feed_clocks(batch, self.found.host, self._sources.edge_of):
            return
        source = source_of_topic(batch.channel.topic)
        if source is None:
            return
        for name in self._sources.inside(source):
            if name in self._parsers:
                units = ChunkBatch(source, batch.log_time_ns, batch.units)
                self._take_records(name, self._parsers[name].feed_batch(units))

    def close(self) -> NavigationLog:
        """Read the tails of the streams, settle all clocks at once, and return the log's data."""
        found = self.found
        for name, parser in self._parsers.items():
            self._take_records(name, parser.close())
            found.refused[name] = refused_by(parser)
            found.remarks += parser.remarks()
            counters = parser.counters
            found.heard[name] = counters.bytes, counters.bytes_skipped, counters.messages
            found.warnings += [f"{name}: {doubt}" for doubt in parser.warnings]
        found.host.update()
        found.remarks += found.host.settle()
        if self._imu:
            found.imu = np.concatenate(self._imu)
        if self._ins:
            found.ins = np.concatenate(self._ins)
        return found

    def _take_records(self, source: str, records: list[Record]) -> None:
        if not records:
            return
        counts = self.found.counts.setdefault(source, Counter())
        for record in records:
            rows = getattr(record, "rows", None)
            counts[type(record).__name__] += 1 if rows is None else len(rows)
            self._take_record(source, record)

    def _take_record(self, source: str, record: Record) -> None:
        found, sources = self.found, self._sources
        if isinstance(record, ImuSamples) and source == sources.imu_source:
            self._imu.append(record.rows)
        elif isinstance(record, InsSolution) and source == sources.ins_source:
            self._ins.append(sources.ins_rows_in_b(record.rows))
        elif isinstance(record, TimeMessage) and source in found.host.plan.gnss:
            found.host.add_message(source, record)
        elif isinstance(record, GnssFix) and source == sources.gnss_source:
            found.fixes.append(record)
        elif isinstance(record, GnssHeading) and source == sources.gnss_source:
            found.headings.append(record)
        elif isinstance(record, EventMark):
            found.marks.append((source, record))


def read_navigation_log(session: Session, sources: NavigationSources) -> NavigationLog:
    """Read all messages of a session except the scanners', chunk by chunk; those of a scanner that holds the IMU too.

    Raises:
        ConfigError: a driver cannot work with its settings.
        LogError, OSError: the log cannot be read.
    """
    listening = Listening(session)
    reader = _Reader(sources, listening)
    for batch in listening.batches(lambda topic: not topic.startswith(SCANNER) or sources.holds_imu(topic), skim=True):
        reader.take(batch)
    session.growing = listening.growing
    found = reader.close()
    found.session, found.lost = session, listening.lost()
    return found


def session_holes(session: Session) -> list[str]:
    """Return the gaps and damage of a session that has been read, one line each."""
    folder = session.parts[0].path.parent
    lines = [f"{folder}: part {number} of {session.session_id} is missing" for number in session.missing_parts]
    if session.growing is not None:
        lines.append(f"{session.growing}: is still being recorded; the trajectory covers the part recorded so far")
    for part in session.damage:
        damage = part.damage
        lines.append(f"{part.path}: at byte {damage.offset}: {damage.length} bytes, {damage.what}")
    return lines
