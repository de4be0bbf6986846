"""The contract of every protocol parser: bytes in, records out, no I/O, no clock, no logging.

Bad input never raises: it is counted in `ParserCounters` and skipped. A mistake of the caller (wrong settings)
raises `DriverSettingsError` when the parser is made, never later.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from typing import Any, Literal

import numpy as np

from swath.georef.arrays import Int64Array
from swath.georef.records import ByteRows, Chunk, ChunkBatch, Record

DeviceKind = Literal["gnss", "imu", "scanner", "corrections", "raw"]


class DriverSettingsError(ValueError):
    """A setting that the driver cannot work with; the text names the key and a valid value."""


@dataclass(slots=True)
class ParserCounters:
    """Counts everything that a parser receives, so that no loss is silent.

    Attributes:
        bytes: all bytes fed.
        messages: complete messages with a good checksum, by name (``GGA``, ``NAV-PVT``, ``BESTPOS``, ``frame``).
        bad_checksums: frames whose checksum failed.
        bad_messages: frames with a good checksum that could not be decoded (length, content).
        bytes_skipped: bytes that belong to no frame.
        errors: specific errors by code, for example ``bad_length``, ``sequence_gap``.
        bytes_framed: bytes of frames with a good checksum. Of a stream, after `Parser.close`:
            ``bytes == bytes_framed + bytes_skipped``.
    """

    bytes: int = 0
    messages: Counter[str] = field(default_factory=Counter)
    bad_checksums: int = 0
    bad_messages: int = 0
    bytes_skipped: int = 0
    errors: Counter[str] = field(default_factory=Counter)
    bytes_framed: int = 0

    def count_bad(self, code: str, messages: int = 1, skipped: int = 0) -> None:
        """Count messages that cannot be decoded under an error code, and ``skipped`` bytes of each."""
        if messages:
            self.bad_messages += messages
            self.errors[code] += messages
            self.bytes_skipped += messages * skipped


class Parser(ABC):
    """Parses the units of one channel in the order of their arrival.

    ``feed``, ``feed_batch`` and ``feed_batches`` return the same records for the same bytes, however cut. `close`
    returns the records still held back and counts an unfinished tail in ``counters.bytes_skipped``.
    """

    def __init__(self) -> None:
        self.counters = ParserCounters()

    @abstractmethod
    def feed(self, chunk: Chunk) -> list[Record]:
        """Take one unit; return the records that it completed, in order."""

    @abstractmethod
    def feed_batch(self, batch: ChunkBatch) -> list[Record]:
        """Take consecutive units of equal length; return the records that they completed, in order."""

    def feed_batches(self, batches: Sequence[ChunkBatch]) -> list[Record]:
        """Take consecutive batches of one channel, of any lengths; return the records that they completed, in order.

        Neighbours of equal length go to `feed_batch` as one batch, as each call costs as much as many units.
        """
        records: list[Record] = []
        for _, equal in groupby(batches, key=lambda batch: batch.units.shape[1]):
            records += self.feed_batch(_joined(list(equal)))
        return records

    def close(self) -> list[Record]:
        """Return the records still held back at the end of a stream."""
        return []

    @property
    def warnings(self) -> tuple[str, ...]:
        """Facts that the units leave uncertain, one line for the user each."""
        return ()

    def remarks(self) -> list[str]:
        """Return lines for the user: which settings or data were reinterpreted or refused, and the remedy."""
        return []


def _joined(batches: list[ChunkBatch]) -> ChunkBatch:
    """Join batches of units of one length into one batch."""
    if len(batches) == 1:
        return batches[0]
    times = np.concatenate([batch.host_time_ns for batch in batches])
    return ChunkBatch(batches[0].source, times, np.concatenate([batch.units for batch in batches]))


class StreamParser(Parser):
    """Base of parsers for byte streams, whose units end anywhere; a subclass implements `feed`."""

    def feed_batch(self, batch: ChunkBatch) -> list[Record]:
        """Feed the rows one by one, as stream units are few."""
        records: list[Record] = []
        for host_time_ns, unit in zip(batch.host_time_ns.tolist(), batch.units, strict=True):
            records += self.feed(Chunk(batch.source, host_time_ns, unit.tobytes()))
        return records


class PacketParser(Parser):
    """Base of parsers for datagrams and CAN frames, whose units are whole; a subclass implements `parse_units`."""

    def feed(self, chunk: Chunk) -> list[Record]:
        """Parse one unit as a batch of one row."""
        units = np.frombuffer(chunk.data, dtype=np.uint8).reshape(1, -1)
        return self.parse_units(np.array([chunk.host_time_ns], dtype=np.int64), units)

    def feed_batch(self, batch: ChunkBatch) -> list[Record]:
        """Pass all rows to `parse_units` at once."""
        return self.parse_units(batch.host_time_ns, batch.units)

    @abstractmethod
    def parse_units(self, host_time_ns: Int64Array, units: ByteRows) -> list[Record]:
        """Decode units of equal length, vectorised.

        Args:
            host_time_ns: (n,) host time of each unit.
            units: (n, length) uint8, one row a unit, possibly strided.
        """


class RawParser(StreamParser):
    """Counts the units of a device that no driver reads: each is a whole message, and none is a record.

    Args:
        settings: of the device; nothing of them is used.
    """

    def __init__(self, settings: DeviceSettings) -> None:
        super().__init__()
        del settings

    def feed(self, chunk: Chunk) -> list[Record]:
        """Count one unit."""
        self.counters.bytes += len(chunk.data)
        self.counters.bytes_framed += len(chunk.data)
        self.counters.messages["unit"] += 1
        return []

    def feed_batch(self, batch: ChunkBatch) -> list[Record]:
        """Count units of equal length."""
        self.counters.bytes += batch.units.size
        self.counters.bytes_framed += batch.units.size
        self.counters.messages["unit"] += len(batch.units)
        return []


class ChosenRecords(Parser):
    """Returns the records of another parser that are of the wanted types; counters and remarks are that parser's.

    Attributes:
        parser: the other parser.
    """

    def __init__(self, parser: Parser, wanted: tuple[type, ...]) -> None:
        super().__init__()
        self.parser, self._wanted = parser, wanted
        self.counters = parser.counters

    def _chosen(self, records: list[Record]) -> list[Record]:
        return [record for record in records if isinstance(record, self._wanted)]

    def feed(self, chunk: Chunk) -> list[Record]:
        """Take one unit; return its wanted records."""
        return self._chosen(self.parser.feed(chunk))

    def feed_batch(self, batch: ChunkBatch) -> list[Record]:
        """Take consecutive units; return their wanted records."""
        return self._chosen(self.parser.feed_batch(batch))

    def feed_batches(self, batches: Sequence[ChunkBatch]) -> list[Record]:
        """Take consecutive batches; return their wanted records."""
        return self._chosen(self.parser.feed_batches(batches))

    def close(self) -> list[Record]:
        """Return the wanted records still held back."""
        return self._chosen(self.parser.close())

    @property
    def warnings(self) -> tuple[str, ...]:
        """The parser's warnings."""
        return self.parser.warnings

    def remarks(self) -> list[str]:
        """Return the parser's lines for the user."""
        return self.parser.remarks()


@dataclass(frozen=True, slots=True)
class DeviceSettings:
    """Holds everything that a parser may know of its configuration.

    Attributes:
        source: ``kind/name``.
        config: the device's table in the configuration, defaults filled in.
        files: contents of the files that the table names, by key (``dbc``, ``geometry``), from disk or from a log.
        compiled: decode returns by compiled loops, which need numba (``swath[process]``); the rows are the same, and
            decoding is faster where there are millions.
    """

    source: str
    config: Mapping[str, Any] = field(default_factory=dict)
    files: Mapping[str, bytes] = field(default_factory=dict)
    compiled: bool = False
