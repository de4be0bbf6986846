"""Base of parsers whose byte stream is divided into frames."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Sequence

from swath.drivers.framing.framer import Frame, FrameKind, Framer
from swath.drivers.parser import StreamParser
from swath.drivers.record_rows import Row, join_rows
from swath.georef.records import Chunk, ChunkBatch, Record


class FramedParser(StreamParser):
    """Divides the stream into frames; a subclass implements `decode_frames`, and `finish` if it holds items back.

    Args:
        kinds: the kinds of frames that the stream may contain.
        wanted: the record types to return; None: all.
    """

    def __init__(self, kinds: Sequence[FrameKind], wanted: tuple[type, ...] | None = None) -> None:
        super().__init__()
        self._framer = Framer(kinds, self.counters)
        self._wanted = wanted

    def feed(self, chunk: Chunk) -> list[Record]:
        """Take one read; return the records that it completed."""
        return join_rows(self.decode_frames(self._framer.feed(chunk.data, chunk.host_time_ns)), self._wanted)

    def feed_batch(self, batch: ChunkBatch) -> list[Record]:
        """Take consecutive reads; return neighbouring rows of all of them as one array."""
        frames: list[Frame] = []
        for host_time_ns, unit in zip(batch.host_time_ns.tolist(), batch.units, strict=True):
            frames += self._framer.feed(unit.tobytes(), host_time_ns)
        return join_rows(self.decode_frames(frames), self._wanted)

    def close(self) -> list[Record]:
        """Return the records held back."""
        return join_rows([*self.decode_frames(self._framer.close()), *self.finish()], self._wanted)

    @abstractmethod
    def decode_frames(self, frames: list[Frame]) -> Iterable[Record | Row]:
        """Decode consecutive frames; return their records, or rows of them, in order."""

    def finish(self) -> Iterable[Record | Row]:
        """Return what is held back until the end of the stream; nothing, unless a subclass says otherwise."""
        return ()
