"""Reads logs: finished, cut off by a crash, or recovered; one file, several, or a directory of them.

`open_logs` gives sessions in the order of time, their parts in the order of their number. A chunk is used only after
its CRC has been checked; whatever cannot be read is skipped and listed in `Session.damage`.
"""

from __future__ import annotations

import heapq
import struct
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import islice, pairwise
from pathlib import Path

import numpy as np
from mcap import records

from swath.daemon.log.claim import is_being_written
from swath.daemon.log.format import PROFILE, SESSION_METADATA, ChannelSpec, LogError, SessionInfo
from swath.daemon.log.mcap.chunks import LogBatch, TopicFilter, chunk_batches, damage_within, take_description
from swath.daemon.log.mcap.scan import (
    OP_ATTACHMENT,
    OP_CHANNEL,
    OP_CHUNK,
    OP_HEADER,
    OP_METADATA,
    OP_SCHEMA,
    ChannelFilter,
    Damage,
    Record,
    parse_record,
    scan,
)

RECOVERED = ".recovered.mcap"
LOOK_AHEAD_NS = 1_000_000_000  # a chunk stays open for 250 ms and then waits a little for the writer

# Limits on the memory that a foreign log may take; logs of swath stay far below.
LOOK_AHEAD_BYTES = 128 << 20
MAX_ATTACHMENTS_BYTES = 128 << 20
MAX_DAMAGE = 1000  # number of places that are listed
MAX_MISSING = 1000


@dataclass(frozen=True, slots=True)
class PartDamage:
    """A stretch of a part that could not be read."""

    path: Path
    damage: Damage


@dataclass(slots=True)
class Part:
    """One file of a session: path, session and number."""

    path: Path
    info: SessionInfo
    number: int


@dataclass(slots=True)
class Session:
    """One recording: its parts, and the damage found while reading them.

    Attributes:
        damage: the stretches that could not be read.
        growing: the part that was being written during reading; its missing end is not damage.
        progress: called during reading with the bytes of the parts that are read or skipped, and with all of them.
    """

    info: SessionInfo
    parts: list[Part]
    damage: list[PartDamage] = field(default_factory=list)
    growing: Path | None = None
    progress: Callable[[int, int], None] = field(default=lambda done, total: None, repr=False, compare=False)
    _noted: set[PartDamage] = field(default_factory=set, repr=False)

    @property
    def session_id(self) -> str:
        """Name of the session."""
        return self.info.session_id

    @property
    def missing_parts(self) -> list[int]:
        """Numbers below the highest whose parts are missing, at most the first thousand."""
        there = {part.number for part in self.parts}
        return list(islice((number for number in range(max(there) + 1) if number not in there), MAX_MISSING))

    def batches(self, topics: TopicFilter | None = None, *, skim: bool = False) -> Iterator[LogBatch]:
        """Yield all messages in their order in the files.

        With ``skim``, a chunk whose index lists no wanted channel is not read, so damage inside it is not found.
        """
        for chunk in self._chunks(topics, skim=skim):
            yield from chunk

    def batches_by_time(self, topics: TopicFilter | None = None) -> Iterator[LogBatch]:
        """Yield all messages merged by log time; a batch is split where messages of another one come between.

        One second of messages is held in memory, more than a chunk stays open; at most 128 MiB, in case the log's times
        do not advance.
        """
        held: list[LogBatch] = []
        limit_ns, size = 0, 0
        for chunk in self._chunks(topics):
            chunk = [run for batch in chunk for run in _in_order(batch)]
            held += chunk
            newest_ns = min((int(batch.log_time_ns.min()) for batch in chunk), default=None)
            if newest_ns is not None and newest_ns - LOOK_AHEAD_NS > limit_ns:
                limit_ns = newest_ns - LOOK_AHEAD_NS
                ready, held = _older_than(held, limit_ns)
                yield from _merge(ready)
            size += _chunk_bytes(chunk)
            if size > LOOK_AHEAD_BYTES:
                size = _chunk_bytes(held)  # batches already given out no longer count
                if size > LOOK_AHEAD_BYTES // 2:
                    yield from _merge(held)
                    held, size = [], 0
        yield from _merge(held)

    def attachments(self) -> dict[str, bytes]:
        """Return attachments by name, each from the first part that has it; those beyond 128 MiB in total
        are left out.
        """
        found: dict[str, bytes] = {}
        size = 0
        for part in self.parts:
            for record in self._records(part, chunks=False):
                if record.opcode != OP_ATTACHMENT:
                    continue
                attachment = parse_record(records.Attachment, record.body)
                if attachment.name in found:
                    continue
                size += len(record.body)
                if size > MAX_ATTACHMENTS_BYTES:
                    self._note(part, Damage(record.offset, record.length, "attachments beyond 128 MiB were not read"))
                    return found
                found[attachment.name] = attachment.data
        return found

    def _chunks(self, topics: TopicFilter | None, *, skim: bool = False) -> Iterator[list[LogBatch]]:
        for part in self.parts:
            channels: dict[int, ChannelSpec] = {}
            schemas: dict[int, records.Schema] = {}
            wanted = partial(_is_wanted, channels, topics) if skim and topics is not None else None
            for record in self._records(part, wanted=wanted):
                if record.opcode == OP_CHUNK:
                    lost: Counter[str] = Counter()
                    try:
                        yield list(chunk_batches(record.body, channels, schemas, topics, lost))
                    except LogError as error:
                        self._note(part, Damage(record.offset, record.length, str(error)))
                    if lost:
                        self._note(part, damage_within(record, lost))
                elif record.opcode in (OP_CHANNEL, OP_SCHEMA):
                    try:
                        take_description(record, channels, schemas)
                    except LogError as error:
                        self._note(part, Damage(record.offset, record.length, str(error)))

    def _records(self, part: Part, *, chunks: bool = True, wanted: ChannelFilter | None = None) -> Iterator[Record]:
        growing = is_being_written(part.path)
        sizes = [one.path.stat().st_size for one in self.parts]
        before, total = sum(sizes[: self.parts.index(part)]), sum(sizes)
        with part.path.open("rb") as file:
            size = part.path.stat().st_size
            for found in scan(file, size, chunks=chunks, wanted=wanted):
                if chunks:
                    self.progress(before + found.offset, total)
                if isinstance(found, Record):
                    yield found
                elif growing and found.offset + found.length == size:
                    self.growing = part.path
                else:
                    self._note(part, found)

    def _note(self, part: Part, damage: Damage) -> None:
        entry = PartDamage(part.path, damage)
        if entry in self._noted or len(self.damage) > MAX_DAMAGE:
            return
        if len(self.damage) == MAX_DAMAGE:
            entry = PartDamage(part.path, Damage(damage.offset, 0, "more damage exists that is not listed"))
        self._noted.add(entry)
        self.damage.append(entry)


def _is_wanted(channels: dict[int, ChannelSpec], topics: TopicFilter, channel: int) -> bool:
    """Return whether a channel's messages are wanted; a channel that is not known yet counts as wanted."""
    return channel not in channels or topics(channels[channel].topic)


def open_logs(paths: Sequence[Path | str], passed_over: list[str] | None = None) -> list[Session]:
    """Open logs and directories of logs, and return their sessions in order of time.

    Args:
        paths: files and directories.
        passed_over: receives a line for each file of a directory that is not a log, such as a crash at the very
            beginning of a part leaves; if None, such a file is an error, as if the user had named it.

    Raises:
        LogError: a file is not a log, or there are no logs.
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
        why = f"; {passed_over[0]}" if passed_over else ""
        more = f", and {len(passed_over) - 1} more" if passed_over and len(passed_over) > 1 else ""
        raise LogError(f"{', '.join(map(str, paths))}: no logs (*.mcap){why}{more}")
    sessions = [_session(parts) for parts in by_session.values()]
    return sorted(sessions, key=lambda session: session.info.realtime_ns)


def _session(parts: list[Part]) -> Session:
    parts.sort(key=lambda part: part.number)
    for one, other in pairwise(parts):
        if one.number == other.number:
            raise LogError(
                f"{other.path}: is part {other.number} of its session, as is {one.path}; remove one of the two"
            )
    return Session(parts[0].info, parts)


def _files(paths: list[Path]) -> list[Path]:
    """Return the named files and those in the named directories; a recovered copy replaces its original."""
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
    """Read session and number of a part from its first records.

    Raises:
        LogError: it is not a log of this program.
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
    raise LogError(f"{path}: no {SESSION_METADATA} at its beginning; not a log of swath, or cut off at its beginning")


# ---------------------------------------------------------------------- merging by time


def _in_order(batch: LogBatch) -> Iterator[LogBatch]:
    """Yield a batch in pieces, split where its times step back: stamps of one socket come from several processors."""
    steps_back = np.flatnonzero(np.diff(batch.log_time_ns) < 0) + 1
    for first, last in pairwise([0, *steps_back.tolist(), len(batch.log_time_ns)]):
        yield batch.between(first, last)


def _older_than(held: list[LogBatch], limit_ns: int) -> tuple[list[LogBatch], list[LogBatch]]:
    """Split batches at a time; return those before it and those after."""
    ready: list[LogBatch] = []
    rest: list[LogBatch] = []
    for batch in held:
        split = int(np.searchsorted(batch.log_time_ns, limit_ns))
        if split:
            ready.append(batch.between(0, split))
        if split < len(batch.log_time_ns):
            rest.append(batch.between(split, len(batch.log_time_ns)))
    return ready, rest


def _chunk_bytes(held: list[LogBatch]) -> int:
    """Return the memory that batches keep alive: for each one, the whole chunk that it is a view into."""
    chunks = {id(batch.rows.base): batch.rows.base for batch in held}
    return sum(chunk.nbytes for chunk in chunks.values() if isinstance(chunk, np.ndarray))


def _merge(batches: list[LogBatch]) -> Iterator[LogBatch]:
    """Yield batches split at each other's times; equal times keep the order of the file."""
    heap = [(int(batch.log_time_ns[0]), number, 0) for number, batch in enumerate(batches)]
    heapq.heapify(heap)
    while heap:
        _, number, first = heapq.heappop(heap)
        batch = batches[number]
        times = batch.log_time_ns
        last = len(times)
        if heap:
            next_ns = heap[0][0] + (number < heap[0][1])  # among equal times, the first in the file comes first
            last = max(first + 1, first + int(np.searchsorted(times[first:], next_ns)))
        yield batch.between(first, last)
        if last < len(times):
            heapq.heappush(heap, (int(times[last]), number, last))
