"""Watches one source of a log that is followed: its condition by its statuses, and by the content of its bytes."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from swath.daemon.log.mcap.chunks import LogBatch
from swath.daemon.log.words import stream_faults
from swath.drivers.parser import DriverSettingsError, Parser
from swath.georef.records import ChunkBatch

RATE_STATUSES = 6  # for rates over the last five seconds
DECODED_SECONDS = 10  # of parser results that are kept
DECODE_SHARE = 0.05  # of one processor, for each source's parser
DECODE_AT_ONCE_S = 0.5  # allowed on top of the share, for the beginning and for bursts
DAMAGED_SHARE = 0.01  # of the messages; a larger share is a fault of wire or settings, not chance
_LOST = ("lost_kernel", "lost_queue", "lost_write")
_COUNTS = ("units", "bytes", *_LOST)
_WORDS = ("state", "time_state")
_MEASURED = ("last_unit_age_s", "time_sigma_ns")
_MOST = 1 << 63  # limit of counts and measured values


@dataclass(slots=True)
class DecodedSecond:
    """A parser's results for one second of the log."""

    records: Counter[str] = field(default_factory=Counter)
    messages: int = 0
    bad: int = 0
    errors: Counter[str] = field(default_factory=Counter)


class Decoding:
    """Runs a source's parser on whole seconds of the log, and on only some of them if all would take too long.

    After a skipped second a new parser starts, so that skipped data does not count as a gap.

    Attributes:
        seconds: the latest that were decoded.
        share: part of all seconds that were decoded.
    """

    def __init__(self, make_parser: Callable[[], Parser]) -> None:
        self.seconds: deque[DecodedSecond] = deque(maxlen=DECODED_SECONDS)
        self._make_parser = make_parser
        self._parser: Parser | None = None
        self._before = (0, 0, Counter[str]())
        self._second: int | None = None
        self._decoding = False
        self._spent_s = 0.0
        self._began_s = time.monotonic()
        self._seen = self._decoded = 0

    @property
    def share(self) -> float:
        """Part of the seconds that were decoded, 0 to 1."""
        return self._decoded / self._seen if self._seen else 0.0

    def feed(self, source: str, batch: LogBatch) -> None:
        """Decode units of the source, or of its second port."""
        second = int(batch.log_time_ns[0]) // 1_000_000_000
        if self._second is None or second > self._second:
            self._begin_second(second)
        if not self._decoding or self._parser is None:
            return
        started_s = time.thread_time()
        now = self.seconds[-1]
        for record in self._parser.feed_batch(ChunkBatch(source, batch.log_time_ns, batch.units)):
            rows = getattr(record, "rows", None)
            now.records[type(record).__name__] += 1 if rows is None else len(rows)
        self._note_counters(now)
        self._spent_s += time.thread_time() - started_s

    def _begin_second(self, second: int) -> None:
        went_on = self._decoding
        allowed_s = DECODE_AT_ONCE_S + (time.monotonic() - self._began_s) * DECODE_SHARE
        self._decoding = self._spent_s <= allowed_s
        self._second = second
        self._seen += 1
        if not self._decoding:
            return
        self._decoded += 1
        self.seconds.append(DecodedSecond())
        if self._parser is None or not went_on:
            try:
                self._parser = self._make_parser()
            except DriverSettingsError:
                self._parser = None  # `swath info` reports the fault
            self._before = (0, 0, Counter())

    def _note_counters(self, now: DecodedSecond) -> None:
        assert self._parser is not None
        counters = self._parser.counters
        messages, bad = counters.messages.total(), counters.bad_checksums + counters.bad_messages
        messages_before, bad_before, errors_before = self._before
        now.messages += messages - messages_before
        now.bad += bad - bad_before
        now.errors += counters.errors - errors_before
        self._before = (messages, bad, Counter(counters.errors))

    def plain(self) -> dict[str, Any]:
        """Return rates and counts of the latest seconds for ``--json``; the current second counts when it is over."""
        whole = list(self.seconds)[:-1] or list(self.seconds)
        total = DecodedSecond()
        for second in whole:
            total.records += second.records
            total.messages += second.messages
            total.bad += second.bad
            total.errors += second.errors
        return {
            "records_hz": {name: round(count / len(whole), 1) for name, count in total.records.most_common()},
            "messages": total.messages,
            "bad": total.bad,
            "errors": dict(total.errors),
            "gaps": sum(count for code, count in total.errors.items() if code.endswith("_gap")),
            "seconds": len(whole),
            "share": round(self.share, 3),
        }


def usable_status(received: dict[str, Any]) -> dict[str, Any]:
    """Return a status with only displayable values, because a log of another program may hold any value there."""
    status: dict[str, Any] = {key: _number(received.get(key), int) or 0 for key in _COUNTS}
    status |= {key: _number(received[key], int, float) for key in _MEASURED if key in received}
    status |= {key: str(received[key])[:64] for key in _WORDS if key in received}
    return {"state": "opening", "last_unit_age_s": None} | status


def _number(value: Any, *kinds: type) -> Any:
    """Return the value if it is a plausible number; else None."""
    return value if type(value) in kinds and -_MOST < value < _MOST else None


class SourceWatch:
    """Collects a source's statuses and units in log order."""

    def __init__(self, source: str, decoding: Decoding | None) -> None:
        self.source = source
        self._decoding = decoding
        self._statuses: deque[tuple[int, dict[str, Any]]] = deque(maxlen=RATE_STATUSES)
        self._last_ns: int | None = None

    def add_units(self, batch: LogBatch, *, decode: bool = True) -> None:
        """Take units of the source's own port."""
        self._last_ns = max(self._last_ns or 0, int(batch.log_time_ns[-1]))
        if decode:
            self.decode(batch)

    def decode(self, batch: LogBatch) -> None:
        """Take units for the parser only, as from a second port."""
        if self._decoding is not None:
            self._decoding.feed(self.source, batch)

    def add_status(self, time_ns: int, status: dict[str, Any]) -> None:
        """Take a status of the source."""
        self._statuses.append((time_ns, usable_status(status)))

    def plain(self, now_ns: int) -> dict[str, Any]:
        """Return the source's values for ``--json``; ``now_ns`` is host time."""
        status = self._statuses[-1][1] if self._statuses else {}
        found: dict[str, Any] = {
            "state": status.get("state", "opening"),
            "rate_hz": self._rate("units"),
            "bytes_per_s": self._rate("bytes"),
            "age_s": self._age_s(now_ns, status),
            "units": status.get("units", 0),
            "lost": {key: status.get(key, 0) for key in _LOST},
        }
        if "time_state" in status:
            found |= {"time_state": status["time_state"], "time_sigma_ns": status.get("time_sigma_ns")}
        if self._decoding is not None and self._decoding.seconds:
            found["decoded"] = self._decoding.plain()
        return found

    @property
    def status(self) -> dict[str, Any]:
        """Latest status; empty before the first."""
        return self._statuses[-1][1] if self._statuses else {}

    def _age_s(self, now_ns: int, status: dict[str, Any]) -> float | None:
        last_ns = self._last_ns
        told_s = status.get("last_unit_age_s")
        if last_ns is None and told_s is not None:
            last_ns = self._statuses[-1][0] - round(told_s * 1e9)
        return None if last_ns is None else max(0.0, round((now_ns - last_ns) * 1e-9, 2))

    def _rate(self, key: str) -> float | None:
        if len(self._statuses) < 2:
            return None
        (first_ns, first), (last_ns, last) = self._statuses[0], self._statuses[-1]
        if last_ns <= first_ns:
            return None
        return round(float(last.get(key, 0) - first.get(key, 0)) / ((last_ns - first_ns) * 1e-9), 1)


def decoded_trouble(decoded: dict[str, Any]) -> str:
    """Describe the faults in a source's bytes, in a few words; return an empty text when all is well."""
    words = []
    if decoded["bad"] > DAMAGED_SHARE * decoded["messages"]:
        words.append(f"{decoded['bad']} of {decoded['bad'] + decoded['messages']} messages damaged")
    if decoded["gaps"]:
        words.append(f"{decoded['gaps']} missing in its sequence")
    words += stream_faults(decoded["errors"], decoded["messages"], decoded["seconds"])
    return ", ".join(words)
