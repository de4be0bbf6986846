"""Reads logs: finished, cut off by a crash, or recovered; one file, several, or a directory of them.

`open_logs` gives sessions in the order of time, their parts in the order of their number. A chunk is used only after
its CRC has been checked; what cannot be read is skipped and stands in `Session.damage`.
"""

from __future__ import annotations

import heapq
import struct
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np
from mcap import records

from daemon.log.claim import is_being_written
from daemon.log.format import PROFILE, SESSION_METADATA, ChannelSpec, ChunkClass, LogError, SessionInfo
from daemon.log.scan import (
    OP_ATTACHMENT,
    OP_CHANNEL,
    OP_CHUNK,
    OP_HEADER,
    OP_MESSAGE,
    OP_METADATA,
    OP_SCHEMA,
    Damage,
    Record,
    parse_record,
    scan,
)
from georef.records import ByteRows, Int64Array

TopicFilter = Callable[[str], bool]
RECOVERED = ".recovered.mcap"
_MESSAGE_HEAD = 31
_HEAD = struct.Struct("<BQ")
LOOK_AHEAD_NS = 1_000_000_000  # a chunk is open for 250 ms and waits for the writer a little longer


@dataclass(frozen=True, slots=True)
class LogBatch:
    """Consecutive messages of equal length of one channel, as they stand in a chunk.

    Attributes:
        log_time_ns: (n,) host time.
        rows: (n, 31 + length) uint8, the whole message records, a view into the chunk.
    """

    channel: ChannelSpec
    channel_id: int
    log_time_ns: Int64Array
    rows: ByteRows

    @property
    def units(self) -> ByteRows:
        """(n, length) uint8, the messages' data, a view into the chunk."""
        return self.rows[:, _MESSAGE_HEAD:]


@dataclass(frozen=True, slots=True)
class PartDamage:
    """What could not be read of a part."""

    path: Path
    damage: Damage


@dataclass(slots=True)
class Part:
    """One file of a session."""

    path: Path
    info: SessionInfo
    number: int


@dataclass(slots=True)
class Session:
    """One recording: its parts, and what was found while reading them.

    Attributes:
        damage: what could not be read.
        growing: the part that was being written meanwhile; that it has no end yet is no damage.
    """

    info: SessionInfo
    parts: list[Part]
    damage: list[PartDamage] = field(default_factory=list)
    growing: Path | None = None
    _noted: set[PartDamage] = field(default_factory=set, repr=False)

    @property
    def session_id(self) -> str:
        """Name of the session."""
        return self.info.session_id

    @property
    def missing_parts(self) -> list[int]:
        """Numbers below the highest that are not there."""
        there = {part.number for part in self.parts}
        return [number for number in range(max(there) + 1) if number not in there]

    def batches(self, topics: TopicFilter | None = None) -> Iterator[LogBatch]:
        """All messages in the order in which they stand in the files."""
        for chunk in self._chunks(topics):
            yield from chunk

    def batches_by_time(self, topics: TopicFilter | None = None) -> Iterator[LogBatch]:
        """All messages merged by log time: batches are split where another's messages come between.

        A second of messages is held, longer than a chunk stays open.
        """
        held: list[LogBatch] = []
        for chunk in self._chunks(topics):
            chunk = [run for batch in chunk for run in _in_order(batch)]
            held += chunk
            newest_ns = min((int(batch.log_time_ns.min()) for batch in chunk), default=None)
            if newest_ns is not None:
                ready, held = _older_than(held, newest_ns - LOOK_AHEAD_NS)
                yield from _merge(ready)
        yield from _merge(held)

    def attachments(self) -> dict[str, bytes]:
        """Attachments by name, of the first part that has each."""
        found: dict[str, bytes] = {}
        for part in self.parts:
            for record in self._records(part, chunks=False):
                if record.opcode == OP_ATTACHMENT:
                    attachment = parse_record(records.Attachment, record.body)
                    found.setdefault(attachment.name, attachment.data)
        return found

    def _chunks(self, topics: TopicFilter | None) -> Iterator[list[LogBatch]]:
        for part in self.parts:
            channels: dict[int, ChannelSpec] = {}
            schemas: dict[int, str] = {}
            for record in self._records(part):
                if record.opcode == OP_CHUNK:
                    orphans: Counter[int] = Counter()
                    try:
                        yield list(chunk_batches(record.body, channels, schemas, topics, orphans))
                    except LogError as error:
                        self._note(part, Damage(record.offset, record.length, str(error)))
                    if orphans:
                        self._note(part, orphan_damage(record, orphans))
                elif record.opcode == OP_CHANNEL:
                    _take_channel(record.body, channels, schemas)
                elif record.opcode == OP_SCHEMA:
                    _take_schema(record.body, schemas)

    def _records(self, part: Part, *, chunks: bool = True) -> Iterator[Record]:
        growing = is_being_written(part.path)
        with part.path.open("rb") as file:
            size = part.path.stat().st_size
            for found in scan(file, size, chunks=chunks):
                if isinstance(found, Record):
                    yield found
                elif growing and found.offset + found.length == size:
                    self.growing = part.path
                else:
                    self._note(part, found)

    def _note(self, part: Part, damage: Damage) -> None:
        entry = PartDamage(part.path, damage)
        if entry not in self._noted:
            self._noted.add(entry)
            self.damage.append(entry)


def open_logs(paths: Sequence[Path | str], passed_over: list[str] | None = None) -> list[Session]:
    """Sessions of logs and of directories of them, in order of time.

    Args:
        paths: files and directories.
        passed_over: takes a line for each file of a directory that is no log, as a crash at a part's very beginning
            leaves one; where None, such a file is an error like one that was named.

    Raises:
        LogError: a file is no log, or there is none.
    """
    by_session: dict[str, list[Part]] = {}
    named = {Path(path) for path in paths}
    for path in _files([Path(path) for path in paths]):
        try:
            part = read_part_head(path)
        except LogError as error:
            if passed_over is None or path in named:
                raise
            passed_over.append(str(error))
            continue
        by_session.setdefault(part.info.session_id, []).append(part)
    if not by_session:
        raise LogError(f"{', '.join(map(str, paths))}: no logs (*.mcap) there")
    sessions = [_session(parts) for parts in by_session.values()]
    return sorted(sessions, key=lambda session: session.info.realtime_ns)


def _session(parts: list[Part]) -> Session:
    parts.sort(key=lambda part: part.number)
    for one, other in pairwise(parts):
        if one.number == other.number:
            raise LogError(f"{other.path}: is part {other.number} of its session, and so is {one.path}")
    return Session(parts[0].info, parts)


def _files(paths: list[Path]) -> list[Path]:
    """The files named, and those in the directories named; a recovered copy among them stands for its original."""
    files: list[Path] = []
    for path in paths:
        if path.is_dir():
            files += sorted(path.glob("*.mcap"))
        elif path.exists():
            files.append(path)
        else:
            raise LogError(f"{path}: no such file or directory")
    recovered = {str(file).removesuffix(RECOVERED) for file in files if file.name.endswith(RECOVERED)}
    return [file for file in dict.fromkeys(files) if str(file).removesuffix(".mcap") not in recovered]


def read_part_head(path: Path) -> Part:
    """Session and number of a part, from its first records.

    Raises:
        LogError: it is no log of this program.
    """
    try:
        with path.open("rb") as file:
            for found in scan(file, path.stat().st_size):
                if isinstance(found, Damage):
                    break
                if found.opcode == OP_HEADER:
                    profile = parse_record(records.Header, found.body).profile
                    if profile != PROFILE:
                        raise LogError(f"{path}: is an MCAP file of profile {profile!r}, not {PROFILE!r}")
                elif found.opcode == OP_METADATA:
                    metadata = parse_record(records.Metadata, found.body)
                    if metadata.name == SESSION_METADATA:
                        info, number = SessionInfo.from_metadata(metadata.metadata)
                        return Part(path, info, number)
                elif found.opcode == OP_CHUNK:
                    break
    except LogError as error:
        text = str(error)
        raise LogError(text if text.startswith(str(path)) else f"{path}: {text}") from error
    except (OSError, struct.error, UnicodeDecodeError) as error:
        raise LogError(f"{path}: cannot be read: {error}") from error
    raise LogError(f"{path}: no {SESSION_METADATA} at its beginning; not a log of swath, or cut off before it began")


# ---------------------------------------------------------------------- inside a chunk


def chunk_batches(
    data: bytes,
    channels: dict[int, ChannelSpec],
    schemas: dict[int, str],
    topics: TopicFilter | None = None,
    orphans: Counter[int] | None = None,
) -> Iterator[LogBatch]:
    """Messages of an unpacked chunk as runs of equal channel and length; learns its channels on the way.

    Args:
        data: the chunk's records.
        channels, schemas: known so far, by id.
        topics: which are wanted.
        orphans: counts messages of channels that no record has described; without it they are an error.

    Raises:
        LogError: a record is malformed.
    """
    at, size = 0, len(data)
    array = np.frombuffer(data, np.uint8)
    while at + _HEAD.size <= size:
        opcode, length = _HEAD.unpack_from(data, at)
        end = at + _HEAD.size + length
        if end > size:
            raise LogError("chunk in which a record reaches beyond its end")
        if opcode == OP_MESSAGE and length >= _MESSAGE_HEAD - _HEAD.size:
            stride = end - at
            count = _run_length(array, at, stride)
            channel_id = int.from_bytes(data[at + 9 : at + 11], "little")
            spec = channels.get(channel_id)
            if spec is None:
                if orphans is None:
                    raise LogError(f"chunk with messages of channel {channel_id}, whose record is lost")
                orphans[channel_id] += count
            elif topics is None or topics(spec.topic):
                yield _batch(spec, channel_id, array[at : at + count * stride].reshape(count, stride))
            end = at + count * stride
        elif opcode == OP_CHANNEL:
            _take_channel(data[at + _HEAD.size : end], channels, schemas)
        elif opcode == OP_SCHEMA:
            _take_schema(data[at + _HEAD.size : end], schemas)
        at = end


def orphan_damage(chunk: Record, orphans: Counter[int]) -> Damage:
    """What is lost of a good chunk where the record of a channel was lost with another chunk."""
    which = ", ".join(map(str, sorted(orphans)))
    return Damage(chunk.offset, chunk.length, f"messages of channel {which}, whose record is lost", orphans.total())


def _run_length(array: ByteRows, at: int, stride: int) -> int:
    """Messages from here on with the same opcode, length and channel as the first: their eleven first bytes."""
    possible = (len(array) - at) // stride
    if possible <= 1:
        return possible
    # most runs in a chunk of several channels are short: look one ahead before looking at all
    if not np.array_equal(array[at : at + 11], array[at + stride : at + stride + 11]):
        return 1
    heads = array[at : at + possible * stride].reshape(possible, stride)[:, :11]
    differs = np.flatnonzero((heads != heads[0]).any(axis=1))
    return int(differs[0]) if len(differs) else possible


def _batch(spec: ChannelSpec, channel_id: int, rows: ByteRows) -> LogBatch:
    times: Int64Array = rows[:, 15:23].copy().view("<i8")[:, 0]
    return LogBatch(spec, channel_id, times, rows)


def _take_channel(body: bytes, channels: dict[int, ChannelSpec], schemas: dict[int, str]) -> None:
    channel = parse_record(records.Channel, body)
    chunk_class: ChunkClass = "scanner" if channel.topic.startswith("/scanner/") else "other"
    channels[channel.id] = ChannelSpec(
        channel.topic, channel.message_encoding, channel.metadata, schemas.get(channel.schema_id), chunk_class
    )


def _take_schema(body: bytes, schemas: dict[int, str]) -> None:
    schema = parse_record(records.Schema, body)
    schemas[schema.id] = schema.name


# ---------------------------------------------------------------------- merging by time


def _in_order(batch: LogBatch) -> Iterator[LogBatch]:
    """A batch split where its times step back: stamps of one socket come from several processors."""
    steps_back = np.flatnonzero(np.diff(batch.log_time_ns) < 0) + 1
    for first, last in pairwise([0, *steps_back.tolist(), len(batch.log_time_ns)]):
        yield _slice(batch, first, last)


def _older_than(held: list[LogBatch], limit_ns: int) -> tuple[list[LogBatch], list[LogBatch]]:
    """Batches split at a time: those before it, those after."""
    ready: list[LogBatch] = []
    rest: list[LogBatch] = []
    for batch in held:
        split = int(np.searchsorted(batch.log_time_ns, limit_ns))
        if split:
            ready.append(_slice(batch, 0, split))
        if split < len(batch.log_time_ns):
            rest.append(_slice(batch, split, len(batch.log_time_ns)))
    return ready, rest


def _slice(batch: LogBatch, first: int, last: int) -> LogBatch:
    return LogBatch(batch.channel, batch.channel_id, batch.log_time_ns[first:last], batch.rows[first:last])


def _merge(batches: list[LogBatch]) -> Iterator[LogBatch]:
    """Batches split at each other's times; equal times keep the order of the file."""
    heap = [(int(batch.log_time_ns[0]), number, 0) for number, batch in enumerate(batches)]
    heapq.heapify(heap)
    while heap:
        _, number, first = heapq.heappop(heap)
        batch = batches[number]
        times = batch.log_time_ns
        last = len(times)
        if heap:
            next_ns = heap[0][0] + (number < heap[0][1])  # of equal times the one first in the file goes first
            last = max(first + 1, first + int(np.searchsorted(times[first:], next_ns)))
        yield _slice(batch, first, last)
        if last < len(times):
            heapq.heappush(heap, (int(times[last]), number, last))
