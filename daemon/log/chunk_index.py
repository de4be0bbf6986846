"""Locates the chunks of a log, so that a job reads only the piece of the log that it needs.

The summary of a finished part gives the places, if its CRC is correct; a part that was cut off, or whose summary is
damaged, is walked through. Damage inside a chunk is found only when the chunk is read.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from mcap import records

from swath.daemon.log.format import ChannelSpec, LogError
from swath.daemon.log.mcap.chunks import (
    LogBatch,
    TopicFilter,
    chunk_batches,
    damage_within,
    json_objects,
    take_description,
)
from swath.daemon.log.mcap.scan import (
    OP_CHANNEL,
    OP_CHUNK,
    OP_SCHEMA,
    Damage,
    Record,
    end_is_whole,
    parse_record,
    scan,
    summary_records,
    unpack_chunk,
)
from swath.daemon.log.reader import PartDamage, Session
from swath.georef.arrays import Int64Array

OP_CHUNK_INDEX = 8
_RECORD_HEAD_BYTES = 9
_TAIL = struct.Struct("<BQQQI8s")  # footer and magic
_SPAN = struct.Struct("<QQ")
SCANNER = "/scanner/"
STATUS = "/status/"
LOSSES = ("lost_kernel", "lost_queue", "lost_write")


@dataclass(frozen=True, slots=True)
class ChunkPlace:
    """The place of one chunk of a session.

    Attributes:
        part: index into the session's parts.
        offset, length: the record in its file, including its head.
        start_ns, end_ns: log times of the first and the last of its messages.
        scanner, other: whether it holds messages of scanners, and of anything else.
    """

    part: int
    offset: int
    length: int
    start_ns: int
    end_ns: int
    scanner: bool
    other: bool


@dataclass(frozen=True, slots=True)
class PartChannels:
    """The channels and schemas of a part, by their ids."""

    channels: dict[int, ChannelSpec]
    schemas: dict[int, records.Schema]


@dataclass(slots=True)
class LogIndex:
    """The chunks of a session in the order of the files; it can be pickled.

    Attributes:
        damage: parts of the files that could not be read while the index was made.
    """

    paths: list[Path]
    parts: list[PartChannels]
    chunks: list[ChunkPlace]
    damage: list[PartDamage] = field(default_factory=list)

    def scanner_chunks(self) -> list[ChunkPlace]:
        """Return the chunks that hold scanner messages."""
        return [chunk for chunk in self.chunks if chunk.scanner]

    def between(self, start_ns: int, end_ns: int) -> list[ChunkPlace]:
        """Return the scanner chunks with messages in a span of log time, [start, end)."""
        return [chunk for chunk in self.scanner_chunks() if chunk.start_ns < end_ns and chunk.end_ns >= start_ns]

    def spans(self) -> tuple[Int64Array, Int64Array]:
        """Return the first and last log times (n,) of the scanner chunks."""
        chunks = self.scanner_chunks()
        return np.array([chunk.start_ns for chunk in chunks]), np.array([chunk.end_ns for chunk in chunks])


def index_log(session: Session, *, walk: bool = True) -> LogIndex:
    """Locate the chunks of a session.

    Args:
        session: the session.
        walk: walk through parts without a sound summary, which takes as long as reading them; False: leave out their
            chunks.

    Raises:
        LogError: a part is no longer a log.
        OSError: a part cannot be read.
    """
    index = LogIndex([part.path for part in session.parts], [], [])
    for number, part in enumerate(session.parts):
        with part.path.open("rb") as file:
            size = part.path.stat().st_size
            found = _from_summary(file, size, number)
            if found is None and walk:
                found = _from_walk(file, size, number, part.path, index.damage)
            elif found is None:
                found = PartChannels({}, {}), []
        index.parts.append(found[0])
        index.chunks += found[1]
    return index


def read_chunks(
    index: LogIndex, places: Iterable[ChunkPlace], topics: TopicFilter | None, damage: list[PartDamage]
) -> Iterator[LogBatch]:
    """Yield the messages of chunks, in order; a chunk that cannot be read is skipped and listed in ``damage``.

    Raises:
        OSError: a file cannot be read.
    """
    opened: tuple[int, BinaryIO] | None = None
    try:
        for place in places:
            if opened is None or opened[0] != place.part:
                if opened is not None:
                    opened[1].close()
                opened = (place.part, index.paths[place.part].open("rb"))
            yield from _read_chunk(index, place, opened[1], topics, damage)
    finally:
        if opened is not None:
            opened[1].close()


def _read_chunk(
    index: LogIndex, place: ChunkPlace, file: BinaryIO, topics: TopicFilter | None, damage: list[PartDamage]
) -> list[LogBatch]:
    path, known = index.paths[place.part], index.parts[place.part]
    file.seek(place.offset)
    record = file.read(place.length)
    lost: Counter[str] = Counter()
    batches: list[LogBatch] = []
    try:
        if len(record) < place.length or record[0] != OP_CHUNK:
            raise LogError("no chunk at the place that the index of the file names")
        batches = list(
            chunk_batches(unpack_chunk(record[_RECORD_HEAD_BYTES:]), known.channels, known.schemas, topics, lost)
        )
    except (LogError, struct.error) as error:
        damage.append(PartDamage(path, Damage(place.offset, place.length, str(error))))
    if lost:
        damage.append(PartDamage(path, damage_within(Record(OP_CHUNK, place.offset, place.length, b""), lost)))
    return batches


class Listening(Session):
    """A session that keeps the latest status of each source while another caller reads it.

    Attributes:
        statuses: latest ``/status/…`` message by source.
    """

    __slots__ = ("statuses",)

    def __init__(self, session: Session) -> None:
        super().__init__(session.info, session.parts, session.damage, progress=session.progress)
        self.statuses: dict[str, dict[str, Any]] = {}

    def batches(self, topics: TopicFilter | None = None, *, skim: bool = False) -> Iterator[LogBatch]:
        """Yield all messages, as `Session.batches` does, and keep the statuses among them."""
        for batch in super().batches(topics, skim=skim):
            if batch.channel.topic.startswith(STATUS):
                for _, value in json_objects(batch):
                    self.statuses[batch.channel.topic.removeprefix(STATUS)] = value
            yield batch

    def lost(self) -> dict[str, int]:
        """Return the number of units that the recorder lost, by source; sources without losses are left out."""
        counts = {
            source: sum(value for key in LOSSES if isinstance(value := status.get(key), int))
            for source, status in self.statuses.items()
        }
        return {source: count for source, count in counts.items() if count}


# ---------------------------------------------------------------------- a finished part


def _from_summary(file: BinaryIO, size: int, part: int) -> tuple[PartChannels, list[ChunkPlace]] | None:
    """Return the channels and chunks that the summary lists; None if there is no intact summary."""
    file.seek(max(0, size - _TAIL.size))
    tail = file.read(_TAIL.size)
    if len(tail) < _TAIL.size:
        return None
    opcode, length, summary_at, _, _, magic = _TAIL.unpack(tail)
    if (opcode, length, magic) != (2, 20, b"\x89MCAP0\r\n") or not 0 < summary_at < size:
        return None
    if not end_is_whole(file, summary_at, size):
        return None
    known = PartChannels({}, {})
    indexes: list[records.ChunkIndex] = []
    try:
        for record in summary_records(file, summary_at, size):
            if record.opcode in (OP_SCHEMA, OP_CHANNEL):
                take_description(record, known.channels, known.schemas)
            elif record.opcode == OP_CHUNK_INDEX:
                indexes.append(parse_record(records.ChunkIndex, record.body))
    except LogError:
        return None
    if not indexes or not _follow_each_other(indexes, size):
        return None
    return known, [_place(index, part, known) for index in indexes]


def _follow_each_other(indexes: Sequence[records.ChunkIndex], size: int) -> bool:
    """Return True if the chunks follow each other without overlap and lie within a file of ``size`` bytes."""
    at = 0
    for index in indexes:
        if index.chunk_start_offset < at or not index.message_index_offsets:
            return False
        at = index.chunk_start_offset + index.chunk_length
    return at <= size


def _place(index: records.ChunkIndex, part: int, known: PartChannels) -> ChunkPlace:
    specs = [known.channels.get(channel) for channel in index.message_index_offsets]
    topics = ["" if spec is None else spec.topic for spec in specs]
    return ChunkPlace(
        part,
        index.chunk_start_offset,
        index.chunk_length,
        index.message_start_time,
        index.message_end_time,
        scanner=any(topic.startswith(SCANNER) for topic in topics),
        other=any(not topic.startswith(SCANNER) for topic in topics),
    )


# ---------------------------------------------------------------------- a part without a whole summary


def _from_walk(
    file: BinaryIO, size: int, part: int, path: Path, damage: list[PartDamage]
) -> tuple[PartChannels, list[ChunkPlace]]:
    known = PartChannels({}, {})
    places: list[ChunkPlace] = []
    for found in scan(file, size):
        if isinstance(found, Damage):
            damage.append(PartDamage(path, found))
        elif found.opcode == OP_CHUNK:
            try:
                places += _place_of(found, part, known)
            except LogError as error:
                damage.append(PartDamage(path, Damage(found.offset, found.length, str(error))))
        elif found.opcode in (OP_SCHEMA, OP_CHANNEL):
            take_description(found, known.channels, known.schemas)
    return known, places


def _place_of(record: Record, part: int, known: PartChannels) -> Iterator[ChunkPlace]:
    """Yield the place of an unpacked chunk; yield nothing if none of its messages can be used."""
    place: ChunkPlace | None = None
    for batch in chunk_batches(record.body, known.channels, known.schemas, None, Counter()):
        start_ns, end_ns = int(batch.log_time_ns.min()), int(batch.log_time_ns.max())
        scanner = batch.channel.topic.startswith(SCANNER)
        if place is None:
            place = ChunkPlace(part, record.offset, record.length, start_ns, end_ns, scanner, not scanner)
        else:
            place = replace(
                place,
                start_ns=min(place.start_ns, start_ns),
                end_ns=max(place.end_ns, end_ns),
                scanner=place.scanner or scanner,
                other=place.other or not scanner,
            )
    if place is not None:
        yield place
