"""Follows a log that is being written: each chunk as it becomes complete, then the next part, then the next session.

It only reads files and holds one chunk in memory at a time; the recorder is not affected. `LogListening` follows in a
thread, for programs of asyncio.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import struct
import threading
from collections import Counter, deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Generic, Self, TypeVar

from mcap import records

from swath.daemon.log.format import MAGIC, SESSION_METADATA, ChannelSpec, LogError, SessionInfo
from swath.daemon.log.mcap.chunks import LogBatch, chunk_batches
from swath.daemon.log.mcap.scan import (
    MAX_RECORD_BYTES,
    OP_ATTACHMENT,
    OP_CHUNK,
    OP_DATA_END,
    OP_MESSAGE_INDEX,
    OP_METADATA,
    OPCODES,
    next_chunk,
    parse_record,
    unpack_chunk,
)
from swath.daemon.log.parts import Sign, read_sign
from swath.drivers.listening import LoopReader, Measured, Overflow

LOG = "log"  # the one lane of a log
ItemT = TypeVar("ItemT")
EVENT_CHUNKS = 100  # latest chunks of a part whose events are shown for the time before following began
GROWTH_STEP_NS = 10_000_000_000
GROWTH_STEPS = 180  # half an hour
_HEAD = struct.Struct("<BQ")
_PEEK_BYTES = _HEAD.size + 16  # reaches a chunk's first and last time, and a message index's channel
_EVENTS = "/events"


class Growth:
    """Counts the bytes of chunks by ten seconds of the log's time, over the last half hour."""

    def __init__(self) -> None:
        self._bytes: dict[int, int] = {}

    def add(self, newest_ns: int, length: int) -> None:
        """Add a chunk: the time of its newest message and its bytes."""
        number = newest_ns // GROWTH_STEP_NS
        self._bytes[number] = self._bytes.get(number, 0) + length
        if len(self._bytes) > GROWTH_STEPS:
            newest = max(self._bytes)
            self._bytes = {at: size for at, size in self._bytes.items() if at > newest - GROWTH_STEPS}

    def highest_bytes_per_s(self) -> float:
        """Return the highest rate over ten seconds; 0 before the log spans whole ones."""
        whole = sorted(self._bytes)[1:-1]
        return max((self._bytes[at] for at in whole), default=0) / (GROWTH_STEP_NS * 1e-9)


class PartFollower:
    """Follows one file, growing or not; it gives the messages of every chunk once, when the chunk has become complete.

    Attributes:
        info, number: session and part number.
        attachments: those before its first chunk; the recorder writes them all there.
        ended: the data section is complete; nothing more will be written.
        damaged: number of chunks that could not be read.
        newest_ns: log time of the newest message so far.
        growth: bytes of its chunks by time.
    """

    def __init__(self, path: Path, growth: Growth | None = None) -> None:
        """Open the file and read the records before the first chunk.

        Raises:
            LogError: the file does not begin as a swath log, or its beginning is not yet complete.
            OSError: it cannot be read.
        """
        self.path = path
        self.attachments: dict[str, bytes] = {}
        self.ended = False
        self.damaged = 0
        self.newest_ns: int | None = None
        self.growth = Growth() if growth is None else growth
        self._grown_to = 0
        self._channels: dict[int, ChannelSpec] = {}
        self._schemas: dict[int, records.Schema] = {}
        self._file = path.open("rb")
        self._at = len(MAGIC)
        try:
            self.info, self.number = self._read_head()
        except (LogError, OSError):
            self.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _read_head(self) -> tuple[SessionInfo, int]:
        if self._pread(0, len(MAGIC)) != MAGIC:
            raise LogError(f"{self.path}: is not an MCAP file")
        session: tuple[SessionInfo, int] | None = None
        while (head := self._whole_record()) is not None and head[0] not in (OP_CHUNK, OP_DATA_END):
            opcode, length = head
            if opcode == OP_METADATA:
                metadata = parse_record(records.Metadata, self._pread(self._at + _HEAD.size, length))
                if metadata.name == SESSION_METADATA:
                    session = SessionInfo.from_metadata(metadata.metadata)
            elif opcode == OP_ATTACHMENT:
                attachment = parse_record(records.Attachment, self._pread(self._at + _HEAD.size, length))
                self.attachments[attachment.name] = attachment.data
            self._at += _HEAD.size + length
        if session is None:
            raise LogError(f"{self.path}: no {SESSION_METADATA} at its beginning")
        return session

    # ------------------------------------------------------------------ records

    def _pread(self, at: int, length: int) -> bytes:
        return os.pread(self._file.fileno(), length, at)

    def _size(self) -> int:
        return os.fstat(self._file.fileno()).st_size

    def _whole_record(self) -> tuple[int, int] | None:
        """Return opcode and length of the next record once it is complete, else None; bytes that cannot be a record are
        skipped.
        """
        head = self._pread(self._at, _HEAD.size)
        if len(head) < _HEAD.size:
            return None
        opcode, length = _HEAD.unpack(head)
        size = self._size()
        if opcode not in OPCODES or length > MAX_RECORD_BYTES:
            resumed = next_chunk(self._file, self._at + 1, size)
            if resumed is None:
                return None
            self.damaged += 1
            self._at = resumed
            return self._whole_record()
        return (opcode, length) if self._at + _HEAD.size + length <= size else None

    # ------------------------------------------------------------------ messages

    def batches(self) -> Iterator[LogBatch]:
        """Yield the messages that have become readable since the last call, in the file's order."""
        while not self.ended and (head := self._whole_record()) is not None:
            opcode, length = head
            at, self._at = self._at, self._at + _HEAD.size + length
            if opcode == OP_CHUNK:
                self._note_growth(at, length, self._pread(at, _PEEK_BYTES))
                yield from self._chunk(at, length)
            elif opcode == OP_DATA_END:
                self.ended = True

    def _note_growth(self, at: int, length: int, peek: bytes) -> int:
        """Count a chunk once; return the time of its newest message."""
        newest_ns = int.from_bytes(peek[17:25], "little")
        if at >= self._grown_to:
            self._grown_to = at + length
            self.growth.add(newest_ns, length)
        return newest_ns

    def read_growth(self) -> None:
        """Go to the end and count the bytes of all chunks; the messages are not read."""
        while (head := self._whole_record()) is not None and head[0] != OP_DATA_END:
            if head[0] == OP_CHUNK:
                self._note_growth(self._at, head[1], self._pread(self._at, _PEEK_BYTES))
            self._at += _HEAD.size + head[1]

    def _chunk(self, at: int, length: int) -> Iterator[LogBatch]:
        try:
            data = unpack_chunk(self._pread(at + _HEAD.size, length))
            for batch in chunk_batches(data, self._channels, self._schemas, None, Counter()):
                self.newest_ns = max(self.newest_ns or 0, int(batch.log_time_ns[-1]))
                yield batch
        except (LogError, struct.error):
            self.damaged += 1

    def tail(self, seconds: float) -> Iterator[LogBatch]:
        """Go to the end: yield the latest events of the skipped part, then all messages of the last ``seconds``.

        Of the skipped part, only the heads of chunks and of message indexes and the chunks with those events are read.
        """
        chunks: deque[tuple[int, int]] = deque()  # place and last time of the chunks within the last seconds
        with_events: deque[int] = deque(maxlen=EVENT_CHUNKS)
        chunk_at, events_id = self._at, None
        while (head := self._whole_record()) is not None and head[0] != OP_DATA_END:
            opcode, length = head
            peek = self._pread(self._at, _PEEK_BYTES)
            if opcode == OP_CHUNK:
                chunk_at, newest_ns = self._at, self._note_growth(self._at, length, peek)
                if events_id is None:
                    events_id = self._learn_events(self._at, length)
                chunks.append((chunk_at, newest_ns))
                while newest_ns - chunks[0][1] > seconds * 1e9:
                    chunks.popleft()
            elif opcode == OP_MESSAGE_INDEX and int.from_bytes(peek[9:11], "little") == events_id:
                with_events.append(chunk_at)
            self._at += _HEAD.size + length
        begin = chunks[0][0] if chunks else self._at
        for at in with_events:
            if at < begin:
                length = _HEAD.unpack(self._pread(at, _HEAD.size))[1]
                yield from (batch for batch in self._chunk(at, length) if batch.channel.topic == _EVENTS)
        self._at = begin
        yield from self.batches()

    def _learn_events(self, at: int, length: int) -> int | None:
        """Return the id of the events channel if this chunk has it; the first chunk of a part does."""
        ids = [batch.channel_id for batch in self._chunk(at, length) if batch.channel.topic == _EVENTS]
        return ids[0] if ids else None


class LogFollower:
    """Follows a recording in a directory, from part to part and from session to session.

    Attributes:
        part: the file being read; None if nothing has been recorded since following began.
        sign: content of the directory's ``recording.json``, which names the growing file; None if there is none.
        growth: bytes written by time, over the last half hour.
    """

    def __init__(self, directory: Path, tail_s: float, *, every_part: bool = True) -> None:
        """Prepare to follow a directory.

        Args:
            directory: of logs.
            tail_s: how much of an already existing log is read.
            every_part: also read parts that were finished before the follower reached them.
        """
        self.part: PartFollower | None = None
        self.sign: Sign | None = None
        self.growth = Growth()
        self._directory = directory
        self._tail_s = tail_s
        self._every_part = every_part
        self._waited = False

    def poll(self) -> Iterator[LogBatch]:
        """Yield all messages that have become readable since the last call."""
        self.sign = read_sign(self._directory)
        if self.part is None:
            if self.sign is not None:
                yield from self._open(self.sign.path, tail=True)
            return
        got = False
        for batch in self.part.batches():
            got = True
            yield batch
        if self.sign is None or self.sign.path == self.part.path:
            self._waited = False
        elif self.part.ended or (self._waited and not got):
            yield from self._go_on(self.part, self.sign)
        else:  # a crash may have left the part open: first give the messages that it still holds
            self._waited = True

    def _go_on(self, part: PartFollower, sign: Sign) -> Iterator[LogBatch]:
        """Yield from the session's next part if it is wanted and exists, else from the file that is growing now."""
        following = self._directory / f"{part.info.session_id}_{part.number + 1}.mcap"
        if sign.path == following or (self._every_part and part.ended and os.path.exists(following)):
            yield from self._open(following, tail=False)
        else:
            yield from self._open(sign.path, tail=not self._every_part)

    def _open(self, path: Path, *, tail: bool) -> Iterator[LogBatch]:
        try:
            part = PartFollower(path, self.growth)
        except (LogError, OSError):
            return  # not yet begun, or already removed: the next poll decides
        if self.part is None:
            self._read_growth_before(part)
        else:
            self.part.close()
        self.part, self._waited = part, False
        yield from part.tail(self._tail_s) if tail else part.batches()

    def _read_growth_before(self, part: PartFollower) -> None:
        """Count the bytes of the part before the first one that is followed."""
        with contextlib.suppress(LogError, OSError):
            before = PartFollower(self._directory / f"{part.info.session_id}_{part.number - 1}.mcap", self.growth)
            with contextlib.closing(before):
                before.read_growth()

    def close(self) -> None:
        """Close the file that is being read."""
        if self.part is not None:
            self.part.close()


class LogListening(Generic[ItemT]):
    """Follows a log in a thread of its own, for one task of an asyncio loop; an asynchronous context manager.

    Args:
        follower: belongs to the thread until the end.
        look: makes the items of all that has become readable since its last call, which may be nothing.
        poll_s: seconds between two looks.
        overflow, queue_bytes: as in `swath.drivers.listening.Backlog`; the lane is the whole log's. A thread that waits
            reads the file later: nothing is lost.
    """

    def __init__(
        self,
        follower: LogFollower,
        look: Callable[[LogFollower], Iterator[Measured[ItemT]]],
        *,
        poll_s: float,
        overflow: Overflow = Overflow.WAIT,
        queue_bytes: int,
    ) -> None:
        self._follower, self._look, self._poll_s = follower, look, poll_s
        self._reader: LoopReader[ItemT] = LoopReader(queue_bytes, overflow)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="follow", daemon=True)

    async def __aenter__(self) -> Self:
        """Begin to follow."""
        self._thread.start()
        return self

    async def __aexit__(self, *_: object) -> None:
        """Close the log and wait for the thread, also if the task was cancelled."""
        await asyncio.shield(asyncio.to_thread(self.close))

    def close(self) -> None:
        """Close the log and wait for the thread."""
        self._stop.set()
        self._reader.backlog.close()
        if self._thread.ident is not None:
            self._thread.join()

    async def take(self) -> ItemT | None:
        """Wait for the item that came first; None: following has ended, and all items are taken.

        Raises:
            BusyError: another task waits for an item already.
            Exception: what ``look`` failed with, after the items before it.
        """
        return await self._reader.take()

    @property
    def is_recorded(self) -> bool:
        """True if a recording is under way, as far as the directory shows it."""
        return self._follower.sign is not None

    @property
    def dropped(self) -> int:
        """Number of units that were dropped because the reader was too slow."""
        return self._reader.backlog.dropped(LOG)

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                for item in self._look(self._follower):
                    self._reader.backlog.put(LOG, item)
                    if self._stop.is_set():
                        break
                self._stop.wait(self._poll_s)
        except Exception as error:
            self._reader.backlog.fail(error)
        finally:
            self._follower.close()
