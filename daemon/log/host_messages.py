"""Decodes the messages that the recorder itself writes: clock readings and PPS edges."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any, Protocol

from swath.daemon.log.format import source_of_topic
from swath.daemon.log.mcap.chunks import LogBatch, json_objects
from swath.georef.records import PpsEdge

MAX_NS = 1 << 62  # limit for the clock values of a foreign log, in either direction


class TakesHostMessages(Protocol):
    """Clocks that are fed with the recorder's own messages: `swath.georef.stream.clocks.HostClocks`."""

    def add_reading(
        self, realtime_ns: int, monotonic_ns: int, monotonic_raw_ns: int, max_error_s: float = math.inf, /
    ) -> None:
        """Take the host's clocks read side by side."""

    def add_edge(self, source: str, edge: PpsEdge, /) -> None:
        """Take an edge of ``pps/name``."""


def feed_clocks(batch: LogBatch, clocks: TakesHostMessages, edge_of: Callable[[str], str | None]) -> bool:
    """Feed clocks with messages of ``/clock`` and ``/pps/<name>``; return False for those of any other topic.

    Args:
        batch: messages of one topic.
        clocks: take the readings and edges.
        edge_of: returns the wanted polarity of a source's edges; None: no such source is configured.
    """
    if batch.channel.topic == "/clock":
        for reading in readings_of(batch):
            clocks.add_reading(*reading)
        return True
    source = source_of_topic(batch.channel.topic) or ""
    if not source.startswith("pps/"):
        return False
    polarity = edge_of(source)
    for edge in edges_of(batch, polarity) if polarity is not None else ():
        if edge is not None:
            clocks.add_edge(source, edge)
    return True


def readings_of(batch: LogBatch) -> Iterator[tuple[int, int, int, float]]:
    """Yield realtime_ns, monotonic_ns, monotonic_raw_ns and max_error_s (inf if absent) of ``/clock`` messages.

    Messages without three valid times are skipped.
    """
    for _, value in json_objects(batch):
        realtime_ns, monotonic_ns = _time_of(value.get("realtime_ns")), _time_of(value.get("monotonic_ns"))
        raw_ns = _time_of(value.get("monotonic_raw_ns"))
        if realtime_ns is not None and monotonic_ns is not None and raw_ns is not None:
            yield realtime_ns, monotonic_ns, raw_ns, _error_of(value.get("max_error_s"))


def _error_of(value: Any) -> float:
    is_stated = isinstance(value, int | float) and not isinstance(value, bool) and value >= 0
    return float(value) if is_stated else math.inf


def edges_of(batch: LogBatch, edge: str) -> Iterator[PpsEdge | None]:
    """Yield the edges of ``/pps/<name>`` that have the wanted polarity, and None for every other message."""
    for _, value in json_objects(batch):
        time_ns, sequence = _time_of(value.get("edge_time_ns")), _time_of(value.get("sequence", 0))
        wanted = value.get("edge", edge) == edge
        yield PpsEdge(time_ns, sequence) if wanted and time_ns is not None and sequence is not None else None


def _time_of(value: Any) -> int | None:
    """Return a whole number that can be a time; None for any other value that a foreign log may hold."""
    return value if isinstance(value, int) and not isinstance(value, bool) and abs(value) < MAX_NS else None
