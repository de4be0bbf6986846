"""Read the log that a soak's recorder writes, part by part, with swath's reader and the official MCAP reader.

`benchmarks.soak` runs this; it has no command of its own.
"""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mcap.reader import make_reader

from swath.daemon.log.format import source_of_topic
from swath.daemon.log.parsers import stored_parsers
from swath.daemon.log.reader import open_logs
from swath.drivers.parser import Parser
from swath.georef.records import ChunkBatch


@dataclass
class Found:
    """The contents of all parts read so far; parsers keep their state from one part to the next."""

    units: Counter[str] = field(default_factory=Counter)
    bytes: Counter[str] = field(default_factory=Counter)
    events: list[dict[str, Any]] = field(default_factory=list)
    status: dict[str, dict[str, Any]] = field(default_factory=dict)
    parsers: dict[str, Parser] = field(default_factory=dict)
    wrong: list[str] = field(default_factory=list)
    parts: int = 0

    def read(self, path: Path) -> None:
        """Read a finished part with both readers, which must find the same number of messages of every topic."""
        (session,) = open_logs([path])
        if not self.parsers:
            self.parsers, troubles = stored_parsers(session.attachments())
            self.wrong += troubles
        ours: Counter[str] = Counter()
        for batch in session.batches():
            ours[batch.channel.topic] += len(batch.units)
            self._take(batch.channel.topic, batch.log_time_ns, batch.units)
        self.wrong += [f"{path.name}: {entry.damage.what}" for entry in session.damage]
        with path.open("rb") as file:
            reader = make_reader(file, validate_crcs=True)
            theirs = Counter(channel.topic for _, channel, _ in reader.iter_messages(log_time_order=False))
        if ours != theirs:
            self.wrong.append(f"{path.name}: the readers disagree: {ours - theirs} {theirs - ours}")
        self.parts += 1

    def without_parsers(self) -> Found:
        """Add the parsers' errors to what is wrong, and drop the parsers, which other processes cannot take."""
        for source, parser in self.parsers.items():
            counters = parser.counters
            if counters.errors or counters.bad_checksums or counters.bytes_skipped:
                self.wrong.append(f"{source}: {dict(counters.errors)}, {counters.bad_checksums} bad checksums")
        self.parsers = {}
        return self

    def _take(self, topic: str, times_ns: Any, units: Any) -> None:
        """Count the messages of a batch, and parse or check them."""
        source = source_of_topic(topic)
        if source is not None:
            self.units[source] += len(units)
            self.bytes[source] += units.size
            if source in self.parsers:
                self.parsers[source].feed_batch(ChunkBatch(source, times_ns, units))
        elif topic == "/events":
            self.events += [json.loads(row.tobytes()) for row in units]
        elif topic.startswith("/status/"):
            for row in units:
                self._check_status(topic.removeprefix("/status/"), json.loads(row.tobytes()))

    def _check_status(self, source: str, status: dict[str, Any]) -> None:
        """Keep a status, and check its counts against each other and the log."""
        self.status[source] = status
        accounted = status["written"] + status["lost_kernel"] + status["lost_queue"] + status["lost_write"]
        if status["units"] != accounted or status["written"] != self.units[source]:
            self.wrong.append(f"{source}: {status} with {self.units[source]} units before it")


def is_finished(path: Path) -> bool:
    """Return whether a part ends with the magic bytes of MCAP."""
    with path.open("rb") as file:
        file.seek(0, 2)
        file.seek(max(0, file.tell() - 8))
        return file.read() == b"\x89MCAP0\r\n"
