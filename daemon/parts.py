"""The files of a session: one part after the other, each complete in itself, and the sign of which one is growing."""

from __future__ import annotations

import json
import os
import time
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from daemon.channels import ChannelTable
from daemon.log.encode import EncodedBlock
from daemon.log.format import SessionInfo
from daemon.log.writer import PartWriter

RECORDING_SIGN = "recording.json"
_DROP_CACHE_AFTER_S = 60.0


@dataclass(frozen=True, slots=True)
class Attachment:
    """A file of the configuration, stored in every part; ``name`` is a name, never a path on disk."""

    name: str
    media_type: str
    data: bytes


def sync_directory(directory: Path) -> None:
    """Make a directory's entries durable."""
    fd = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


@dataclass(slots=True)
class Parts:
    """Opens parts, lays blocks into the current one and counts what was written and lost over all of them.

    Attributes:
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
    written: Counter[int] = field(default_factory=Counter)
    lost: Counter[int] = field(default_factory=Counter)
    _known: set[int] = field(default_factory=set)
    _finished: deque[tuple[float, Path]] = field(default_factory=deque)

    def next_path(self) -> Path:
        """Where the next part will be."""
        return self.directory / f"{self.info.session_id}_{self.part + 1}.mcap"

    def open_next(self, log_time_ns: int) -> None:
        """Open the next part, with session and attachments, and say in ``recording.json`` that it is growing.

        Raises:
            OSError: it cannot be created.
        """
        path = self.next_path()
        writer = PartWriter(path, self.info, self.part + 1, compression=self.compression)
        for attachment in self.attachments:
            writer.add_attachment(attachment.name, attachment.media_type, attachment.data, log_time_ns)
        self.part += 1
        self.current = writer
        self._known = set()
        self.opened_monotonic_s = time.monotonic()
        self._write_sign(path)

    def add(self, block: EncodedBlock) -> None:
        """Lay a block into the current part; raises OSError when a chunk that it closed could not be written."""
        assert self.current is not None
        if block.channel_id not in self._known:
            self.current.add_channel(block.channel_id, self.channels.specs[block.channel_id])
            self._known.add(block.channel_id)
        self.current.add(block)

    def release(self) -> PartWriter | None:
        """Take the current part out, its counts kept; the caller finishes it."""
        writer, self.current = self.current, None
        if writer is not None:
            self.written.update(writer.written)
            self.lost.update(writer.lost)
            self._finished.append((time.monotonic(), writer.path))
        return writer

    def total_written(self, channel_id: int) -> int:
        """Messages of a channel in the log, over all parts."""
        return self.written[channel_id] + (self.current.written.get(channel_id, 0) if self.current else 0)

    def total_lost(self, channel_id: int) -> int:
        """Messages of a channel that could not be written, over all parts."""
        return self.lost[channel_id] + (self.current.lost.get(channel_id, 0) if self.current else 0)

    def drop_page_cache(self) -> None:
        """Give the memory of parts finished a while ago back to the system."""
        while self._finished and time.monotonic() - self._finished[0][0] > _DROP_CACHE_AFTER_S:
            _, path = self._finished.popleft()
            try:
                fd = os.open(path, os.O_RDONLY)
            except OSError:
                continue  # moved away meanwhile: nothing of it to drop
            try:
                os.posix_fadvise(fd, 0, 0, os.POSIX_FADV_DONTNEED)
            finally:
                os.close(fd)

    def _write_sign(self, path: Path) -> None:
        sign = {
            "session_id": self.info.session_id,
            "part": self.part,
            "path": path.name,
            "pid": os.getpid(),
            "boot_id": self.info.boot_id,
        }
        new = self.directory / (RECORDING_SIGN + ".new")
        new.write_text(json.dumps(sign) + "\n")
        new.replace(self.directory / RECORDING_SIGN)
        sync_directory(self.directory)

    def remove_sign(self) -> None:
        """Nothing is growing any more."""
        (self.directory / RECORDING_SIGN).unlink(missing_ok=True)
