"""Counts the content of logs for `swath info`: units, rates, gaps, losses, time status, damage."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from swath.daemon.log.format import LogError, source_of_topic
from swath.daemon.log.mcap.chunks import LogBatch, json_objects
from swath.daemon.log.parsers import stored_config, stored_parsers
from swath.daemon.log.reader import Session
from swath.daemon.log.wires import Senders
from swath.daemon.log.words import stream_faults
from swath.drivers.parser import Parser
from swath.georef.arrays import Int64Array
from swath.georef.records import ChunkBatch, Record

USUAL_SHARE = 0.95  # intervals up to this quantile count as usual: those within bursts and the pauses between them
GAP_MIN_NS = 1 << 27  # 0.134 s: a scanner whose laser is off still sends ten times a second
MAX_MARKS = 10_000  # more than an operator sets in a flight; a foreign log may hold any number
MAX_WORDS = 32
MAX_SENDERS_TEXT = 100  # three addresses with their counts
_ACCOUNT = ("units", "written", "lost_kernel", "lost_queue", "lost_write")
_TROUBLE = ("bus_off", "error_frames", "line_errors", "refused")


@dataclass(slots=True)
class Intervals:
    """A histogram of the time between units in powers of two of a nanosecond; its memory does not grow with the log."""

    bins: Int64Array = field(default_factory=lambda: np.zeros(64, np.int64))
    longest_ns: int = 0
    longest_at_ns: int = 0
    _last_ns: int | None = None

    def add(self, times_ns: Int64Array) -> None:
        """Add the times of the next units."""
        if self._last_ns is not None:
            times_ns = np.concatenate([[self._last_ns], times_ns])
        self._last_ns = int(times_ns[-1])
        steps = np.maximum(np.diff(times_ns), 0)
        if not len(steps):
            return
        self.bins += np.bincount(np.frexp(steps.astype(np.float64))[1], minlength=64)[:64]
        widest = int(steps.argmax())
        if steps[widest] > self.longest_ns:
            self.longest_ns, self.longest_at_ns = int(steps[widest]), int(times_ns[widest])

    def gaps(self) -> int:
        """Return the number of gaps: intervals above `GAP_MIN_NS` in a higher bin than the usual ones.

        Bins are powers of two, so a gap may be less than twice as long as a usual interval.
        """
        total = int(self.bins.sum())
        if total < 3:
            return 0
        usual_bin = int(np.searchsorted(self.bins.cumsum(), USUAL_SHARE * total))
        first = max(usual_bin + 1, int(np.frexp(float(GAP_MIN_NS))[1]))
        return int(self.bins[first:].sum())


@dataclass(slots=True)
class SourceNumbers:
    """The counts of one source of a session."""

    units: int = 0
    bytes: int = 0
    first_ns: int | None = None
    last_ns: int | None = None
    intervals: Intervals = field(default_factory=Intervals)
    status: dict[str, Any] | None = None
    time_states: Counter[str] = field(default_factory=Counter)
    account_errors: int = 0
    miscounted: int = 0
    parser: Parser | None = None
    second_port: bool = False
    records: Counter[str] = field(default_factory=Counter)
    senders: Senders = field(default_factory=Senders)

    def add(self, times_ns: Int64Array, units: Any) -> None:
        """Count units that were read."""
        self.units += len(times_ns)
        self.bytes += int(units.size)
        self.first_ns = int(times_ns[0]) if self.first_ns is None else self.first_ns
        self.last_ns = int(times_ns[-1])
        self.intervals.add(times_ns)

    def add_status(self, status: dict[str, Any]) -> None:
        """Check a status: the account's equation must hold, and ``written`` must equal the units read so far in a
        complete log.
        """
        self.status = status
        units, written, *lost = (_count(status, key) for key in _ACCOUNT)
        self.account_errors += units != written + sum(lost)
        self.miscounted += written != self.units
        if "time_state" in status:
            _count_word(self.time_states, status["time_state"])

    def add_sender(self, batch: LogBatch) -> None:
        """Count the datagrams of a batch by their sender, if the log names it."""
        if address := batch.channel.metadata.get("source_address"):
            first_ns, last_ns = int(batch.log_time_ns.min()), int(batch.log_time_ns.max())
            self.senders.add(str(address), first_ns, last_ns, len(batch.log_time_ns))

    def plain(self, *, complete: bool) -> dict[str, Any]:
        """Return plain values for ``--json``; in a complete log every status must agree with the units read
        before it.
        """
        first, last = self.first_ns, self.last_ns
        duration_s = (last - first) * 1e-9 if first is not None and last is not None else 0.0
        status = self.status or {}
        numbers: dict[str, Any] = {
            "units": self.units,
            "bytes": self.bytes,
            "rate_hz": round((self.units - 1) / duration_s, 3) if duration_s > 0 else None,
            "longest_gap_s": round(self.intervals.longest_ns * 1e-9, 6),
            "longest_gap_at_ns": self.intervals.longest_at_ns or None,
            "gaps": self.intervals.gaps(),
            "lost": {key: _count(status, key) for key in _ACCOUNT[2:]},
            "trouble": {key: count for key in _TROUBLE if (count := _count(status, key))},
            "mixed_senders": dict(self.senders.counts) if self.senders.mixed else {},
            "refused_senders": str(status.get("refused_senders", ""))[:MAX_SENDERS_TEXT],
            "account_errors": self.account_errors + (self.miscounted if complete else 0),
            "state": status.get("state"),
            "has_status": self.status is not None,
        }
        if self.time_states:
            numbers["time_state"] = status.get("time_state")
            numbers["time_sigma_ns"] = status.get("time_sigma_ns")
            numbers["time_states"] = dict(self.time_states)
        if self.second_port:  # what its parser counts is said once, at the first port
            numbers["decoded"] = {
                "messages": {},
                "records": dict(self.records),
                "bad_checksums": 0,
                "bad_messages": 0,
                "bytes_skipped": 0,
                "errors": {},
            }
        elif self.parser is not None:
            counters = self.parser.counters
            numbers["degraded"] = stream_faults(
                counters.errors, counters.messages.total(), duration_s, counters.bad_checksums
            )
            numbers["decoded"] = {
                "messages": dict(counters.messages),
                "records": dict(self.records),
                "bad_checksums": counters.bad_checksums,
                "bad_messages": counters.bad_messages,
                "bytes_skipped": counters.bytes_skipped,
                "errors": dict(counters.errors),
            }
        return numbers


@dataclass(slots=True)
class EventNumbers:
    """Event counts of a session by severity, the operator's marks, and the latest events above severity "info"."""

    severities: Counter[str] = field(default_factory=Counter)
    marks: list[dict[str, Any]] = field(default_factory=list)
    last: deque[dict[str, Any]] = field(default_factory=lambda: deque(maxlen=10))

    def add(self, event: dict[str, Any]) -> None:
        """Count the next event."""
        _count_word(self.severities, event.get("severity"))
        if event.get("code") == "mark" and len(self.marks) < MAX_MARKS:
            self.marks.append(event)
        if event.get("severity") != "info":
            self.last.append(event)


def session_statistics(session: Session, *, decode: bool = True) -> dict[str, Any]:
    """Compute all numbers of a session, in one pass over its parts.

    Args:
        session: as `open_logs` gives it.
        decode: run the sources' parsers, for their messages, checksum errors and the devices' own sequence gaps.
    """
    attachments = session.attachments()
    parsers, troubles = stored_parsers(attachments) if decode else ({}, [])
    sources: dict[str, SourceNumbers] = {}
    events = EventNumbers()
    first_ns: int | None = None
    last_ns = 0
    for batch in session.batches():
        start, end = int(batch.log_time_ns.min()), int(batch.log_time_ns.max())
        first_ns = start if first_ns is None else min(first_ns, start)
        last_ns = max(last_ns, end)
        _take(batch, sources, events, parsers)
    for source, numbers in sorted(sources.items()):
        if numbers.parser is not None:
            for record in numbers.parser.close():
                numbers.records[type(record).__name__] += record_count(record)
            if not source.endswith("/aux"):
                troubles += parser_lines(source, numbers.parser)
    for source, numbers in sources.items():
        numbers.second_port = source.endswith("/aux") and _is_read(sources.get(source.removesuffix("/aux")))
    complete = not session.missing_parts and all(entry.damage.index_only for entry in session.damage)
    if decode:
        troubles += _silent_antennas(attachments, sources)
    return {
        "session_id": session.session_id,
        "software": session.info.software,
        "host": session.info.host,
        "origin": session.info.origin or "recording",
        "start_ns": first_ns,
        "duration_s": round((last_ns - first_ns) * 1e-9, 3) if first_ns is not None else 0.0,
        "bytes": sum(part.path.stat().st_size for part in session.parts),
        "parts": [part.path.name for part in session.parts],
        "missing_parts": session.missing_parts,
        "growing": None if session.growing is None else session.growing.name,
        "attachments": sorted(attachments),
        "sources": {source: numbers.plain(complete=complete) for source, numbers in sorted(sources.items())},
        "events": dict(events.severities),
        "marks": events.marks,
        "last_events": list(events.last),
        "damage": [
            {
                "file": entry.path.name,
                "offset": entry.damage.offset,
                "length": entry.damage.length,
                "what": entry.damage.what,
                "messages": entry.damage.messages,
                "index_only": entry.damage.index_only,
            }
            for entry in session.damage
        ],
        "notes": troubles,
    }


def _is_read(numbers: SourceNumbers | None) -> bool:
    return numbers is not None and numbers.parser is not None


def record_count(record: Record) -> int:
    """Return the number of rows of a record, 1 if it has none."""
    rows = getattr(record, "rows", None)
    return 1 if rows is None else len(rows)


def parser_lines(source: str, parser: Parser) -> list[str]:
    """Return what a parser has to tell the user of its data, one line each, with the source's name."""
    return [*parser.remarks(), *(f"{source}: {doubt}" for doubt in parser.warnings)]


def _silent_antennas(attachments: Mapping[str, bytes], sources: dict[str, SourceNumbers]) -> list[str]:
    """Return a line for each receiver that sent records, but no heading, though it has a second antenna."""
    try:
        config = stored_config(attachments)
    except LogError:  # its own line says so
        return []
    lines = []
    for name, table in config.gnss.items() if config is not None else ():
        records = sources.get(f"gnss/{name}", SourceNumbers()).records
        if table.secondary_lever_arm_m is not None and records and not records["GnssHeading"]:
            lines.append(
                f"gnss/{name}: sent no heading that this program reads, although secondary_lever_arm_m names a second "
                "antenna; let it send the heading messages that the page of its protocol lists"
            )
    return lines


def _take(batch: LogBatch, sources: dict[str, SourceNumbers], events: EventNumbers, parsers: dict[str, Parser]) -> None:
    topic = batch.channel.topic
    source = source_of_topic(topic)
    if source is not None:
        numbers = sources.setdefault(source, SourceNumbers())
        numbers.add(batch.log_time_ns, batch.units)
        numbers.add_sender(batch)
        parser = parsers.get(source.removesuffix("/aux"))
        if parser is not None:
            numbers.parser = parser
            for record in parser.feed_batch(ChunkBatch(source, batch.log_time_ns, batch.units)):
                numbers.records[type(record).__name__] += record_count(record)
    elif topic.startswith("/status/"):
        numbers = sources.setdefault(topic.removeprefix("/status/"), SourceNumbers())
        for _, value in json_objects(batch):
            numbers.add_status(value)
    elif topic == "/events":
        for _, value in json_objects(batch):
            events.add(value)


def _count_word(counts: Counter[str], word: object) -> None:
    """Count a word; once there are `MAX_WORDS` different words, as in a foreign log, new ones count as "other"."""
    key = str(word)[:64]
    counts[key if key in counts or len(counts) < MAX_WORDS else "other"] += 1


def _count(status: dict[str, Any], key: str) -> int:
    value = status.get(key)
    return value if isinstance(value, int) else 0
