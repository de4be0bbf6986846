"""Joins chunks of one channel so that they are decoded in one call."""

from __future__ import annotations

from collections.abc import Callable

from swath.georef.records import ChunkBatch

JOINED_BYTES = 256 << 10  # units of a source that are decoded at once, although units of others stand between them


class Run:
    """Consecutive units of a source that are decoded together: a call of a parser costs as much as many units."""

    def __init__(self, parse: Callable[[list[ChunkBatch]], None]) -> None:
        self._parse = parse
        self._held: list[ChunkBatch] = []
        self._bytes = 0

    def add(self, units: ChunkBatch) -> None:
        """Add units, of any length; units of another wire are decoded first."""
        if self._held and self._held[0].source != units.source:
            self.flush()
        self._held.append(units)
        self._bytes += units.units.size
        if self._bytes >= JOINED_BYTES:
            self.flush()

    def flush(self) -> None:
        """Decode the units that wait."""
        held, self._held, self._bytes = self._held, [], 0
        if held:
            self._parse(held)
