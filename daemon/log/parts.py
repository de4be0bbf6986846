"""Manages the files of a session, one part after the other, each complete in itself, and the sign of the
growing one.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import time
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePath

from swath.daemon.log.channels import ChannelTable
from swath.daemon.log.directory import keep_directory
from swath.daemon.log.durable import sync_directory
from swath.daemon.log.format import MAX_PART, SessionInfo
from swath.daemon.log.mcap.encode import EncodedBlock
from swath.daemon.log.mcap.writer import PartWriter

RECORDING_SIGN = "recording.json"
_MOST_SIGN_BYTES = 4096
_NAME = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9_.-]{0,200}")  # names of sessions and parts as the recorder makes them
_DROP_CACHE_AFTER_S = 60.0


@dataclass(frozen=True, slots=True)
class Attachment:
    """A file of the configuration, stored in every part; ``name`` is a name, never a path on disk."""

    name: str
    media_type: str
    data: bytes


@dataclass(frozen=True, slots=True)
class Sign:
    """Content of ``recording.json``, which names the growing file of a directory."""

    session_id: str
    part: int
    path: Path
    boot_id: str


def read_sign(directory: Path) -> Sign | None:
    """Return the sign of a directory; None if nothing is being recorded, or the file is not a sign of swath."""
    try:
        with (directory / RECORDING_SIGN).open("rb") as file:
            fields = json.loads(file.read(_MOST_SIGN_BYTES))
        sign = Sign(
            fields["session_id"], fields["part"], directory / PurePath(fields["path"]).name, str(fields["boot_id"])
        )
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None
    names = isinstance(sign.session_id, str) and _NAME.fullmatch(sign.session_id) and _NAME.fullmatch(sign.path.stem)
    number = type(sign.part) is int and 0 <= sign.part <= MAX_PART
    return sign if names and number and sign.path.suffix == ".mcap" else None


@dataclass(slots=True)
class Parts:
    """Opens parts, adds blocks to the current one and counts written and lost messages over all of them.

    Attributes:
        lock: descriptor of the directory's lock; None if it is not locked.
        written, lost: messages by channel in all parts closed so far; `total_written` adds the current one's.
    """

    directory: Path
    info: SessionInfo
    channels: ChannelTable
    attachments: Sequence[Attachment]
    compression: str
    part: int = -1
    current: PartWriter | None = None
    opened_monotonic_s: float = 0.0
    lock: int | None = None
    written: Counter[int] = field(default_factory=Counter)
    lost: Counter[int] = field(default_factory=Counter)
    _known: set[int] = field(default_factory=set)
    _released_bytes: int = 0
    _finished: deque[tuple[float, Path]] = field(default_factory=deque)

    def open_next(self, log_time_ns: int) -> PartWriter | None:
        """Open the next part, with session and attachments, and record in ``recording.json`` that it is growing.

        Returns:
            The previously current part, whose counts are kept; the caller finishes it.

        Raises:
            OSError: it cannot be created; the current part stays, and nothing is left of the attempt.
        """
        self.directory.mkdir(parents=True, exist_ok=True)
        number, path = self._next()
        writer = PartWriter(path, self.info, number, compression=self.compression)
        try:
            for attachment in self.attachments:
                writer.add_attachment(attachment.name, attachment.media_type, attachment.data, log_time_ns)
            self._write_sign(number, path)
        except OSError:
            writer.abandon()
            raise
        before = self.release()
        self.part, self.current = number, writer
        self._known = set()
        self.opened_monotonic_s = time.monotonic()
        return before

    def keep_directory(self) -> None:
        """Lock the directory again if it was recreated; raises OSError, or BlockingIOError if another recorder holds
        it.
        """
        if self.lock is not None:
            keep_directory(self.directory, self.lock)

    def _next(self) -> tuple[int, Path]:
        """Return number and path of the next part; a name that exists already is skipped, never written to."""
        number = self.part + 1
        while os.path.lexists(path := self.directory / f"{self.info.session_id}_{number}.mcap"):
            number += 1
        return number, path

    def has_gone(self) -> bool:
        """Return whether the current part is no longer at its path: removed, moved, or its folder with it."""
        return self.current is not None and not self.current.stands_at(self.current.path)

    def add(self, block: EncodedBlock) -> None:
        """Add a block to the current part; raises OSError if a chunk that it completed could not be written."""
        assert self.current is not None
        if block.channel_id not in self._known:
            self.current.add_channel(block.channel_id, self.channels.specs[block.channel_id])
            self._known.add(block.channel_id)
        self.current.add(block)

    def add_last(self, writer: PartWriter, block: EncodedBlock) -> None:
        """Add a block to a part that has been released; raises OSError."""
        writer.add_channel(block.channel_id, self.channels.specs[block.channel_id])
        writer.add(block)

    def release(self) -> PartWriter | None:
        """Release the current part and keep its counts; the caller finishes it."""
        writer, self.current = self.current, None
        if writer is not None:
            self.written.update(writer.written)
            self.lost.update(writer.lost)
            self._released_bytes += writer.bytes_written
            self._finished.append((time.monotonic(), writer.path))
        return writer

    def bytes_written(self) -> int:
        """Return the size of all parts together, in bytes."""
        return self._released_bytes + (self.current.bytes_written if self.current is not None else 0)

    def total_written(self, channel_id: int) -> int:
        """Return the number of messages of a channel in the log, over all parts."""
        return self.written[channel_id] + (self.current.written.get(channel_id, 0) if self.current else 0)

    def total_lost(self, channel_id: int) -> int:
        """Return the number of messages of a channel that could not be written, over all parts."""
        return self.lost[channel_id] + (self.current.lost.get(channel_id, 0) if self.current else 0)

    def drop_page_cache(self) -> None:
        """Drop parts that were finished a while ago from the page cache."""
        while self._finished and time.monotonic() - self._finished[0][0] > _DROP_CACHE_AFTER_S:
            _, path = self._finished.popleft()
            try:
                fd = os.open(path, os.O_RDONLY)
            except OSError:
                continue  # moved away meanwhile: its pages cannot be dropped
            try:
                os.posix_fadvise(fd, 0, 0, os.POSIX_FADV_DONTNEED)
            finally:
                os.close(fd)

    def _write_sign(self, part: int, path: Path) -> None:
        sign = {
            "session_id": self.info.session_id,
            "part": part,
            "path": path.name,
            "pid": os.getpid(),
            "boot_id": self.info.boot_id,
        }
        new = self.directory / (RECORDING_SIGN + ".new")
        with new.open("w") as file:
            file.write(json.dumps(sign) + "\n")
            file.flush()
            os.fsync(file.fileno())
        new.replace(self.directory / RECORDING_SIGN)
        sync_directory(self.directory)

    def remove_sign(self) -> None:
        """Remove the sign, since no file is growing any more; errors are ignored, as an unreachable sign misleads no
        reader.
        """
        with contextlib.suppress(OSError):
            (self.directory / RECORDING_SIGN).unlink(missing_ok=True)
