"""Joins chunks of one channel, so that each is decoded in one go."""

from __future__ import annotations

from collections.abc import Callable

from swath.georef.records import ChunkBatch

JOINED_BYTES = 256 << 10  # of a source's units, that are decoded at once where others' stand between them


class Run:
    """Consecutive units of a source that wait to be decoded together, for a call of a parser costs as much as many."""

    def __init__(self, parse: Callable[[list[ChunkBatch]], None]) -> None:
        self._parse = parse
        self._held: list[ChunkBatch] = []
        self._bytes = 0

    def add(self, units: ChunkBatch) -> None:
        """The next ones, of any length; those of another wire are decoded before them."""
        if self._held and self._held[0].source != units.source:
            self.flush()
        self._held.append(units)
        self._bytes += units.units.size
        if self._bytes >= JOINED_BYTES:
            self.flush()

    def flush(self) -> None:
        """Decode them now."""
        held, self._held, self._bytes = self._held, [], 0
        if held:
            self._parse(held)
