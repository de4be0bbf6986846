"""Keeps time while recording, from edges and time messages of the running session, with the state of each clock.

It does not change the logged data: a later reading of the log repeats the computation from the same edges and bytes.
"""

from __future__ import annotations

import contextlib
import math
import threading
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace

from swath.daemon.log.events import Events, Severity
from swath.daemon.log.host_clock import ClockDiscipline
from swath.drivers.guard import GuardedParser
from swath.drivers.parser import Parser
from swath.drivers.transports.base import UnitBlock
from swath.georef.arrays import Int64Array
from swath.georef.records import ChunkBatch, NamesEdge, Record, TimeMessage
from swath.georef.timescales import HostTimeline, PpsClock, WallComparison

STOPPED_NS = 5_000_000_000  # data, but no time message for so long, and for three times the longest pause before …
STOPPED_LONGEST_NS = 60_000_000_000  # … or for this long in any case


@dataclass(slots=True)
class _TimeSource:
    """A GNSS stream whose time messages are read; time messages may stop while other bytes continue."""

    source: str
    clock: PpsClock
    parser: Parser
    names_edge: NamesEdge | None
    units_ns: int = 0  # host times of the newest unit and time message
    message_ns: int | None = None
    longest_ns: int = 0  # between two messages
    reported: bool = False
    remarks: list[str] = field(default_factory=list)  # posted so far

    def note_message(self, host_ns: int) -> int | None:
        """Note a time message; return the length of the pause before it, if that pause had been reported."""
        pause_ns = 0 if self.message_ns is None else max(0, host_ns - self.message_ns)
        self.message_ns, self.longest_ns = host_ns, max(self.longest_ns, pause_ns)
        reported, self.reported = self.reported, False
        return pause_ns if reported else None

    def note_stop(self) -> int | None:
        """Return the time without a time message while data arrived, once it is too long; None before and
        after that.
        """
        if self.message_ns is None or self.reported:
            return None
        pause_ns = self.units_ns - self.message_ns
        self.reported = pause_ns > min(max(STOPPED_NS, 3 * self.longest_ns), STOPPED_LONGEST_NS)
        return pause_ns if self.reported else None


class TimeKeeper:
    """Feeds one `PpsClock` for each PPS source (and for each GNSS without PPS); all calls are safe from any thread."""

    def __init__(self, events: Events, host_minus_monotonic_ns: int) -> None:
        self._events = events
        self._lock = threading.Lock()
        self._timeline = HostTimeline(host_minus_monotonic_ns)
        self._beside_wall = WallComparison("this computer's clock")
        self._far: set[str] = set()  # receivers whose time was reported as far from that clock
        self._clocks: dict[str, PpsClock] = {}  # by the source whose status shows it: pps/main, gnss/rover
        self._sources: dict[str, _TimeSource] = {}
        self._failed: set[str] = set()

    def add_pps(self, source: str, assumed_leap_seconds: int | None, delay_ns: int) -> None:
        """Add a PPS source, ``pps/name``."""
        self._clocks[source] = PpsClock(assumed_leap_seconds=assumed_leap_seconds, delay_ns=delay_ns)

    def add_gnss(
        self,
        source: str,
        pps_source: str | None,
        parser: Parser,
        names_edge: NamesEdge | None,
        assumed_leap_seconds: int | None,
    ) -> None:
        """Add a GNSS stream; its clock is that of its PPS, or one of time messages alone."""
        if pps_source is not None:
            self._clocks[source] = self._clocks[pps_source]
        else:
            self._clocks[source] = PpsClock(assumed_leap_seconds=assumed_leap_seconds)
        self._sources[source] = _TimeSource(source, self._clocks[source], parser, names_edge)

    @property
    def receivers(self) -> Collection[str]:
        """Sources whose time messages are read."""
        return self._sources.keys()

    def units_seen(self, source: str) -> Callable[[Int64Array, UnitBlock], None]:
        """Return the function that a GNSS receiver thread calls with the bytes it has just passed on."""

        def feed(log_time_ns: Int64Array, block: UnitBlock) -> None:
            time_source = self._sources[source]
            time_source.units_ns = int(log_time_ns[-1])
            with self._defects_reported(source):
                self._take(time_source, time_source.parser.feed_batch(ChunkBatch(source, log_time_ns, block.units)))
                self._tell_remarks(time_source)

        return feed

    @contextlib.contextmanager
    def _defects_reported(self, source: str) -> Iterator[None]:
        """Report a defect in parser or clock once for each source; it may cost a time state, but never the
        recording.
        """
        try:
            yield
        except Exception as error:
            if source not in self._failed:
                self._failed.add(source)
                text = f"time keeping failed, recording continues: {type(error).__name__}: {error}"
                self._events.post(Severity.ERROR, source, "time_parser_failed", text)

    def _take(self, time_source: _TimeSource, records: list[Record]) -> None:
        messages = [record for record in records if isinstance(record, TimeMessage)]
        if not messages:
            return
        with self._lock:
            pause_ns = time_source.note_message(messages[-1].host_time_ns)
            if pause_ns is not None:
                text = f"time messages again after {pause_ns * 1e-9:.0f} s"
                self._events.post(Severity.INFO, time_source.source, "time_messages_back", text)
            for message in messages:
                self._beside_wall.hear(time_source.source, message)
                names = time_source.names_edge or message.names_edge
                raw_ns = self._timeline.raw_at(message.host_time_ns)
                time_source.clock.add_message(
                    time_source.source, replace(message, host_time_ns=raw_ns, names_edge=names)
                )
            self._tell_far(time_source.source)
            self._drain(time_source.source, time_source.clock)

    def _tell_far(self, source: str) -> None:
        """Post an event, once for each receiver, if its time is hours or days from this computer's clock."""
        text = "" if source in self._far else self._beside_wall.verdict(source)
        if text:
            self._far.add(source)
            self._events.post(Severity.WARNING, source, "time_far_from_host", text)

    def _tell_remarks(self, time_source: _TimeSource) -> None:
        """Post each remark of the parser once: receiver data that it corrects, or refuses."""
        for remark in time_source.parser.remarks():
            if remark in time_source.remarks:
                continue
            time_source.remarks.append(remark)
            if isinstance(time_source.parser, GuardedParser) and remark == time_source.parser.fault:
                self._events.post(Severity.ERROR, time_source.source, "time_parser_failed", remark)
            else:
                self._events.post(Severity.WARNING, time_source.source, "date_doubtful", remark)

    def edge_seen(self, source: str) -> Callable[[int, int], None]:
        """Return the function that a PPS receiver thread calls with an edge's host time and sequence number."""

        def feed(host_ns: int, sequence: int) -> None:
            with self._defects_reported(source), self._lock:
                self._clocks[source].add_edge(self._timeline.raw_at(host_ns), sequence)
                self._drain(source, self._clocks[source])

        return feed

    def clock_sample(self, sample: Mapping[str, int | float], discipline: ClockDiscipline) -> None:
        """Take a reading of the host's clocks, ten times a second; a disciplined wall clock may determine which second
        it is.
        """
        realtime_ns, monotonic_ns = int(sample["realtime_ns"]), int(sample["monotonic_ns"])
        raw_ns = int(sample["monotonic_raw_ns"])
        with self._defects_reported("clock"), self._lock:
            self._timeline.add(realtime_ns, monotonic_ns, raw_ns)
            step_ns = realtime_ns - monotonic_ns - self._timeline.host_minus_monotonic_ns
            self._beside_wall.set_wall(step_ns, kept=discipline.disciplined)
            for clock in set(self._clocks.values()):
                clock.set_wall_clock(
                    raw_ns, realtime_ns, disciplined=discipline.disciplined, sigma_s=discipline.max_error_s
                )

    def status(self, source: str, host_ns: int) -> dict[str, object]:
        """Return ``time_state`` and ``time_sigma_ns`` of a gnss or pps source; an empty dict for the others."""
        clock = self._clocks.get(source)
        if clock is None:
            return {}
        with self._defects_reported(source), self._lock:
            if source in self._sources:
                self._tell_stop(self._sources[source])
            status = clock.status(self._timeline.raw_at(host_ns))
            self._drain(source, clock)
            sigma_ns = round(status.sigma_ns, 1) if math.isfinite(status.sigma_ns) else None
            return {"time_state": status.state.name, "time_sigma_ns": sigma_ns}
        return {"time_state": "NO_TIME", "time_sigma_ns": None}

    def _tell_stop(self, time_source: _TimeSource) -> None:
        """Post an event if time messages stop: edges alone continue the known second, so the state would not show the
        stop.
        """
        pause_ns = time_source.note_stop()
        if pause_ns is not None:
            text = f"data, but no time message for {pause_ns * 1e-9:.0f} s; check its messages and baud rate"
            self._events.post(Severity.WARNING, time_source.source, "time_messages_stopped", text)

    def _drain(self, source: str, clock: PpsClock) -> None:
        for event in clock.drain_events():
            self._events.post(Severity(event.severity), source, event.code, event.text)
