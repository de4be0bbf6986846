"""Gives records GPS times as they come, by clocks that know what came before them, and follows a growing log."""

from __future__ import annotations

import math
import threading
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from swath.daemon.config.config import Config
from swath.daemon.devices.listening import QUEUE_BYTES, Batch, Status, Times, decoded_counts, row_count
from swath.daemon.errors import ExitCode, UserError
from swath.daemon.log.follow import LogFollower, LogListening, PartFollower
from swath.daemon.log.format import LogError, SessionInfo, source_of_topic
from swath.daemon.log.host_messages import feed_clocks
from swath.daemon.log.mcap.chunks import LogBatch, json_objects
from swath.daemon.log.parsers import stored_config
from swath.daemon.processing.navigation.times import GrowingCounter
from swath.daemon.processing.points.runs import Run
from swath.daemon.processing.records.times import arrival_times, clock_times, named_times, own_times
from swath.daemon.processing.setup.sources import Sources
from swath.drivers.listening import Measured, Overflow
from swath.drivers.parser import DeviceKind
from swath.georef.arrays import StructArray
from swath.georef.records import (
    ChunkBatch,
    DeviceClockSamples,
    ImuSamples,
    InsSolution,
    PpsEdge,
    Record,
    ScannerReturns,
    TimeMessage,
)
from swath.georef.stream.clocks import DevicePlan, StreamClocks
from swath.georef.timescales import SECOND_NS, WEEK_NS

POLL_S = 0.05
EVENTS, STATUS = "/events", "/status/"
_EVERY_KIND: tuple[DeviceKind, ...] = ("gnss", "imu", "scanner", "corrections", "raw")


class LiveClocks:
    """The clocks of a running session; any thread may call them.

    Args:
        sources: the devices.
        info: of the session, for its host time.
    """

    def __init__(self, sources: Sources, info: SessionInfo) -> None:
        plan = sources.clock_plan(info)
        self._counters: dict[str, GrowingCounter] = {}
        imus: dict[str, DevicePlan] = {}
        for name, imu in sources.config.imu.items():
            clock = sources.clock_of(imu.pps)
            if clock is not None:
                imus[f"imu/{name}"] = DevicePlan(clock)
                self._counters[f"imu/{name}"] = GrowingCounter(imu.rate_hz)
        self._clocks = StreamClocks.growing(replace(plan, devices={**plan.devices, **imus}))
        self._host = self._clocks.host
        self._first = next(iter(self._host.by_source), None)
        self._lock = threading.Lock()

    def add_reading(
        self, realtime_ns: int, monotonic_ns: int, monotonic_raw_ns: int, max_error_s: float = math.inf
    ) -> None:
        """Take the host's clocks, read side by side."""
        with self._lock:
            self._clocks.add_reading(realtime_ns, monotonic_ns, monotonic_raw_ns, max_error_s)

    def add_edge(self, source: str, edge: PpsEdge) -> None:
        """Take an edge of ``pps/name``."""
        with self._lock:
            self._clocks.add_edge(source, edge)

    def take(self, source: str, records: Sequence[Record], *, late: bool = False) -> list[Times]:
        """Take records of a source in order of arrival, and return their times.

        Args:
            source: ``kind/name``.
            records: as its parser gives them.
            late: their host times may be too late by any time; what arrival means for a clock is then not used.
        """
        if not records:
            return []
        with self._lock:
            counted = [self._hear(source, record, late=late) for record in records]
            self._clocks.update()
            times = [self._rows_times(source, rows) if rows is not None else None for rows in counted]
            single = [record for record, found in zip(records, times, strict=True) if found is None]
            others = self._event_times(source, single)
            found = [next(others) if one is None else one for one in times]
        return found

    def state(self, source: str, host_ns: int) -> tuple[str, float] | None:
        """Return a clock's state and sigma, s, by its source; None: the source is no clock."""
        with self._lock:
            if source not in self._host.by_source:
                return None
            self._clocks.update()
            status = self._host.status(source, host_ns)
        return status.state.name, status.sigma_ns / SECOND_NS if math.isfinite(status.sigma_ns) else math.nan

    def _hear(self, source: str, record: Record, *, late: bool) -> Record | StructArray | None:
        """Give a record to the clocks; return it if it has rows, with counted samples, else None."""
        plan = self._host.plan
        if isinstance(record, TimeMessage) and source in plan.gnss and not late:
            self._clocks.add_message(source, record)
        elif isinstance(record, DeviceClockSamples) and source in plan.devices and not late:
            self._clocks.add_samples(source, record.rows)
        elif isinstance(record, ImuSamples) and source in self._counters and not late:
            return ImuSamples(self._counters[source].told(record.rows, self._clocks, source))
        return record if isinstance(record, ImuSamples | InsSolution | ScannerReturns | DeviceClockSamples) else None

    def _rows_times(self, source: str, record: Any) -> Times:
        """Return the times of a record with rows."""
        rows = record.rows
        if isinstance(record, InsSolution):
            return own_times(rows["gps_ns"], rows["gps_ns"] >= 0)
        if isinstance(record, ImuSamples) and (rows["gps_week"] >= 0).any():
            own_ns = rows["gps_week"].astype(np.int64) * WEEK_NS + rows["device_time_ns"]
            return own_times(own_ns, rows["gps_week"] >= 0)
        if isinstance(record, DeviceClockSamples) or source not in self._host.plan.devices:
            return arrival_times(self._host, source, rows["host_time_ns"], self._first)
        gps_ns, sigma_ns = self._clocks.gps_from_device(source, rows["device_time_ns"], rows["host_time_ns"])
        return clock_times(gps_ns, np.where(rows["device_time_ns"] >= 0, sigma_ns, math.inf))

    def _event_times(self, source: str, records: Sequence[Any]) -> Iterator[Times]:
        """Yield the times of records without rows: those that they name, else those of their arrival."""
        naming = [hasattr(record, "time") for record in records]
        named = named_times(self._host, source, [record for record in records if hasattr(record, "time")])
        arrived = np.array([record.host_time_ns for record in records], np.int64)
        by_arrival = arrival_times(self._host, source, arrived, self._first)
        places = iter(range(len(named.gps_ns)))
        for at, names in enumerate(naming):
            times, place = (named, next(places)) if names else (by_arrival, at)
            yield Times(times.gps_ns[place : place + 1], times.sigma_s[place : place + 1])


def live_clocks(config: Config, info: SessionInfo) -> LiveClocks:
    """Return the clocks of a configuration's devices, before anything was heard."""
    return LiveClocks(Sources(config, {}, sorted(config.scanner)), info)


class DecodedLog(LogListening[Batch]):
    """Follows the log that a recorder writes and decodes it, for one task of an asyncio loop.

    Args:
        directory: of the recorder's logs.
        tail_s: how much of an already existing recording is read first.
        overflow, queue_bytes: as in `LogListening`.

    Attributes:
        session_id: of the recording that is followed; empty before the first.
    """

    def __init__(
        self,
        directory: Path,
        *,
        tail_s: float = 0.0,
        overflow: Overflow = Overflow.WAIT,
        queue_bytes: int = QUEUE_BYTES,
    ) -> None:
        follower = LogFollower(directory, tail_s)
        super().__init__(follower, self._decoded, poll_s=POLL_S, overflow=overflow, queue_bytes=queue_bytes)
        self.session_id = ""
        self._part: PartFollower | None = None
        self._session: _SessionDecoder | None = None

    def status(self, source: str) -> Status:
        """Return state and counts of a source; its state is that of the log: following, or waiting for a recording."""
        found = Status(source, "following" if self.is_recorded else "waiting", dropped=self.dropped)
        return found if self._session is None else self._session.with_counts(found)

    @property
    def sources(self) -> list[str]:
        """Names of the devices in the log that is followed."""
        return [] if self._session is None else list(self._session.parsers)

    def _decoded(self, follower: LogFollower) -> Iterator[Measured[Batch]]:
        """Yield batches of all that has become readable.

        Raises:
            UserError: the log's configuration cannot be used.
        """
        for messages in follower.poll():
            part = follower.part
            if part is not self._part and part is not None:
                self._part = part
                if part.info.session_id != self.session_id:
                    self.session_id, self._session = part.info.session_id, _SessionDecoder(part)
            if self._session is not None:
                yield from self._session.take(messages)
        if self._session is not None:
            yield from self._session.flush()


class _SessionDecoder:
    """Decodes one session's messages in the order of its log.

    Scanners' units are joined before they are decoded, because each call of a parser costs as much as many units; the
    others are decoded at once, because clocks depend on them.
    """

    def __init__(self, part: PartFollower) -> None:
        try:
            config = stored_config(part.attachments)
            if config is None:
                raise UserError("holds no configuration, by which it could be decoded")
            self._sources = Sources(config, part.attachments, sorted(config.scanner))
            self.parsers = self._sources.parsers(_EVERY_KIND, whole=True)
        except (UserError, LogError) as error:
            raise UserError(f"{part.path}: {error}", ExitCode.IO) from error
        self._clocks = LiveClocks(self._sources, part.info)
        self._made: list[Batch] = []
        self._units: Counter[str] = Counter()
        self._bytes: Counter[str] = Counter()
        self._records: dict[str, Counter[str]] = {source: Counter() for source in self.parsers}
        self._runs: dict[str, Run] = {}

    def take(self, batch: LogBatch) -> Iterator[Measured[Batch]]:
        """Take messages of one channel; yield what is decoded."""
        if feed_clocks(batch, self._clocks, self._sources.edge_of):
            return
        topic = batch.channel.topic
        source = source_of_topic(topic)
        if topic == EVENTS or topic.startswith(STATUS):
            self._made.append(Batch(topic, [], {}, reports=list(json_objects(batch))))
        elif source is not None:
            run = self._runs.setdefault(source, Run(partial(self._parse, source)))
            run.add(ChunkBatch(source, batch.log_time_ns, batch.units))
            if not source.startswith("scanner/"):
                run.flush()
        yield from self._decoded()

    def flush(self) -> Iterator[Measured[Batch]]:
        """Decode the units that wait to be decoded together; yield what is decoded."""
        for run in self._runs.values():
            run.flush()
        yield from self._decoded()

    def _decoded(self) -> Iterator[Measured[Batch]]:
        made, self._made = self._made, []
        for batch in made:
            yield batch.measured

    def _parse(self, wire: str, units: list[ChunkBatch]) -> None:
        batch, device = Batch(wire, units, {}), wire.removesuffix("/aux")
        self._units[device] += sum(len(one.units) for one in units)
        self._bytes[device] += sum(one.units.size for one in units)
        for source in self._sources.inside(wire.removesuffix("/aux")):
            records = self.parsers[source].feed_batches(units)
            batch.records[source] = records
            batch.times[source] = self._clocks.take(source, records)
            for record in records:
                self._records[source][type(record).__name__] += row_count(record)
        self._made.append(batch)

    def with_counts(self, status: Status) -> Status:
        """Return a source's status with its counts."""
        source = status.source
        if source not in self.parsers:
            return status
        return replace(
            status,
            units=self._units[source],
            bytes=self._bytes[source],
            **decoded_counts(self.parsers[source], self._records[source]),
        )
