"""Reads a log twice, with our reader and the official one, which must agree on every message."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mcap.reader import make_reader

from swath.daemon.log.reader import open_logs


@dataclass
class LogContent:
    """Raw units by source and JSON messages by topic, in file order."""

    units: dict[str, list[tuple[int, bytes]]] = field(default_factory=lambda: defaultdict(list))
    messages: dict[str, list[tuple[int, dict[str, Any]]]] = field(default_factory=lambda: defaultdict(list))
    damage: int = 0

    def data(self, source: str) -> bytes:
        """Return all bytes of a source, joined."""
        return b"".join(data for _, data in self.units[source])

    def events(self, code: str) -> list[dict[str, Any]]:
        """Return the events of a code."""
        return [value for _, value in self.messages["/events"] if value["code"] == code]


def read_log(*paths: Path) -> LogContent:
    """Read everything in logs or a directory of them with our reader.

    Every status is checked against the units that precede it.
    """
    content = LogContent()
    seen: Counter[str] = Counter()
    for session in open_logs(list(paths)):
        for batch in session.batches():
            topic = batch.channel.topic
            for time_ns, row in zip(batch.log_time_ns.tolist(), batch.units, strict=True):
                if topic.endswith("/raw"):
                    source = topic[1 : -len("/raw")]
                    seen[source] += 1
                    content.units[source].append((time_ns, row.tobytes()))
                else:
                    value = json.loads(row.tobytes())
                    if topic.startswith("/pps/"):
                        seen[topic[1:]] += 1
                    if topic.startswith("/status/"):
                        check_status(topic, value, seen)
                    content.messages[topic].append((time_ns, value))
        content.damage += len(session.damage)
    return content


def check_status(topic: str, value: dict[str, Any], seen: Counter[str]) -> None:
    """Check the equation of counters, and that ``written`` equals the number of units before this status."""
    source = topic.removeprefix("/status/")
    accounted = value["written"] + value["lost_kernel"] + value["lost_queue"] + value["lost_write"]
    assert value["units"] == accounted, (source, value)
    assert value["written"] == seen[source], (source, value, seen[source])


def official_counts(path: Path) -> Counter[str]:
    """Count messages by topic, with the official reader, which checks CRCs and seeks by the index."""
    counts: Counter[str] = Counter()
    with path.open("rb") as file:
        for _, channel, _ in make_reader(file, validate_crcs=True).iter_messages():
            counts[channel.topic] += 1
    return counts
