"""Assigns MCAP channels to sources; channel ids belong to the session and stay the same through all its parts."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field

from swath.daemon.log.format import ChannelSpec
from swath.daemon.log.mcap.encode import EncodedBlock, encode_json


@dataclass(slots=True)
class ChannelTable:
    """All channels of a session, in the order in which they were added."""

    specs: dict[int, ChannelSpec] = field(default_factory=dict)
    _of_source: dict[str, list[int]] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def add(self, source: str, spec: ChannelSpec) -> int:
        """Add a channel to a source and return its id. MCAP channel ids have 16 bits; id 0 is never used."""
        with self._lock:
            channel_id = len(self.specs) + 1
            self.specs[channel_id] = spec
            self._of_source.setdefault(source, []).append(channel_id)
        return channel_id

    def of_source(self, source: str) -> list[int]:
        """Return the ids of a source's channels."""
        with self._lock:
            return list(self._of_source.get(source, ()))


class JsonChannel:
    """A JSON topic that several threads may write to; it numbers its messages."""

    def __init__(self, table: ChannelTable, source: str, topic: str, schema: str) -> None:
        self.channel_id = table.add(source, ChannelSpec(topic, "json", {}, schema, "other"))
        self._sequence = 0
        self._lock = threading.Lock()

    def encode(self, log_time_ns: int, value: dict[str, object]) -> EncodedBlock:
        """Encode one message, ready for the writer."""
        with self._lock:
            sequence = self._sequence
            self._sequence += 1
        return encode_json(self.channel_id, sequence, log_time_ns, value)
