"""Reads a log's clocks before its returns are placed in time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from swath.daemon.log.chunk_index import SCANNER
from swath.daemon.log.format import source_of_topic
from swath.daemon.log.host_messages import feed_clocks
from swath.daemon.log.mcap.chunks import LogBatch
from swath.daemon.log.reader import Session
from swath.daemon.processing.points.runs import Run
from swath.daemon.processing.setup.sources import Sources
from swath.georef.arrays import StructArray
from swath.georef.records import (
    IMU_DTYPE,
    INS_DTYPE,
    ChunkBatch,
    GnssFix,
    ImuSamples,
    InsSolution,
    Record,
    TimeMessage,
)
from swath.georef.scanner.mount import AngleSeries, MountError
from swath.georef.stream.clocks import FrozenClocks, HostClocks
from swath.georef.stream.stream import StreamSettings
from swath.georef.trajectory.buffer import SOLUTION_STATUS


@dataclass(slots=True)
class LogClocks:
    """A log's records of time and motion, from every source except scanners; pickles.

    Attributes:
        clocks: the host's clock by source, complete.
        ins_rows: solutions of the device's INS, `INS_DTYPE`, attitude of b.
        imu_gps_ns: (n,) GPS time of the samples' arrival; imu_rate_b: (n, 3) rad/s, axes of b. To check that a
            trajectory's motion is this flight's.
        angles: angles of gimbals, by source.
        counts: number of records by source and type.
        imu_force_b: (n, 3) m/s², axes of b, and fixes: of receivers, by source. To check that a trajectory is of this
            flight; empty unless asked for.
        remarks: parsers' lines for the user.
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
    """Collects records of every source except scanners."""

    def __init__(self, sources: Sources, session: Session, *, positions: bool, motion: bool) -> None:
        self.host = HostClocks(sources.clock_plan(session.info), keep_history=True)
        self.fixes: dict[str, list[GnssFix]] = {}
        self._positions = positions
        self.ins: list[StructArray] = []
        self.imu: list[StructArray] = []
        self.gimbals: dict[str, list[StructArray]] = {source: [] for source in sources.gimbal_sources}
        self.counts: dict[str, Counter[str]] = {}
        self.remarks: list[str] = []
        self._sources = sources
        self._parsers = sources.parsers(("gnss", "imu") if motion else ("gnss",), whole=positions)
        self._runs: dict[str, Run] = {}

    def take(self, batch: LogBatch) -> None:
        """Take the next messages."""
        if feed_clocks(batch, self.host, self._sources.edge_of):
            return
        source = source_of_topic(batch.channel.topic)
        if source is not None:  # only the source's own order matters: times are settled all at once
            run = self._runs.setdefault(source, Run(partial(self._parse, self._sources.inside(source))))
            run.add(ChunkBatch(source, batch.log_time_ns, batch.units))

    def _parse(self, names: Iterable[str], batches: list[ChunkBatch]) -> None:
        for name in names:
            if name in self._parsers:
                self.take_records(name, self._parsers[name].feed_batches(batches))

    def close(self) -> None:
        """Read the tails of the streams and settle all times at once."""
        for run in self._runs.values():
            run.flush()
        for name, parser in self._parsers.items():
            self.take_records(name, parser.close())
            self.remarks += parser.remarks()
        self.host.update()
        self.remarks += self.host.settle()

    def angles(self) -> dict[str, AngleSeries]:
        """Return the angles of gimbals, from the sources that sent any."""
        found: dict[str, AngleSeries] = {}
        for source, pieces in sorted(self.gimbals.items()):
            rows = np.concatenate(pieces) if pieces else np.empty(0, INS_DTYPE)
            is_solution = SOLUTION_STATUS.get(self._sources.protocol(source))
            with suppress(MountError):  # fewer than two angles: the code that needs them reports it
                found[source] = AngleSeries.of_solutions(
                    rows if is_solution is None else rows[is_solution(rows["status"])]
                )
        return found

    def take_records(self, source: str, records: list[Record]) -> None:
        """Take the records of a parser."""
        counts = self.counts.setdefault(source, Counter())
        for record in records:
            rows = getattr(record, "rows", None)
            counts[type(record).__name__] += 1 if rows is None else len(rows)
            if isinstance(record, TimeMessage) and source in self.host.plan.gnss:
                self.host.add_message(source, record)
            elif isinstance(record, InsSolution) and source == self._sources.ins_source:
                self.ins.append(record.rows)
            elif isinstance(record, InsSolution) and source in self.gimbals:
                self.gimbals[source].append(record.rows)
            elif isinstance(record, ImuSamples) and source == self._sources.imu_source:
                self.imu.append(record.rows)
            elif isinstance(record, GnssFix) and self._positions:
                self.fixes.setdefault(source, []).append(record)


def read_clocks(session: Session, sources: Sources, *, positions: bool = False, motion: bool = True) -> LogClocks:
    """Read all messages of a session except the scanners', a first pass before its returns are georeferenced.

    Scanners' data are skipped chunk by chunk: a chunk holds one class of channels. Those of a scanner whose stream
    holds an IMU are read. With ``positions`` the receivers' fixes and the IMU's specific forces are kept too; without
    ``motion`` nothing of the IMUs is read.
    """
    reader = _ClockReader(sources, session, positions=positions, motion=motion)

    def is_read(topic: str) -> bool:
        return not topic.startswith(SCANNER) or (motion and sources.holds_imu(topic))

    for batch in session.batches(is_read, skim=True):
        reader.take(batch)
    reader.close()
    ins = sources.ins_rows(np.concatenate(reader.ins) if reader.ins else np.empty(0, INS_DTYPE))
    imu = np.concatenate(reader.imu) if reader.imu else np.empty(0, IMU_DTYPE)
    gps_ns, rate_b, force_b = np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3))
    clock = sources.clock_of_imu
    if len(imu) and clock is not None:
        gps_ns, sigma_ns = reader.host.gps_from_host(clock, imu["host_time_ns"])
        known = sigma_ns <= StreamSettings().max_time_sigma_ns  # a worse clock cannot test a trajectory's time
        gps_ns, rate_b = gps_ns[known], sources.in_b(imu["angular_rate_b"][known])
        if positions:
            force_b = sources.in_b(imu["specific_force_b"][known])
    host = FrozenClocks(reader.host)
    found = LogClocks(host, ins, gps_ns, rate_b, reader.angles(), reader.counts, force_b, reader.fixes)
    found.remarks = reader.remarks
    return found
