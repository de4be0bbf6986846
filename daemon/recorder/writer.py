"""The writer thread: takes blocks from the queue, adds them to the current part and accounts for every unit.

A status message is written after all chunks that its counts cover, so it is true for the file up to its own position.
"""

from __future__ import annotations

import errno
import logging
import os
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum

from swath.daemon.log.account import Account, TimeStatus
from swath.daemon.log.block_queue import BlockQueue, QueueItem
from swath.daemon.log.channels import ChannelTable
from swath.daemon.log.events import Events, Severity
from swath.daemon.log.host_clock import HostClock
from swath.daemon.log.mcap.encode import EncodedBlock
from swath.daemon.log.mcap.writer import PartWriter
from swath.daemon.log.parts import Parts
from swath.daemon.system import name_thread

log = logging.getLogger("swath")

TAKE_S = 0.02  # pause between two reads of the queue
STATUS_S = 1.0
SPLIT_AGAIN_S = 10.0  # after a failure to open the next part
RESUME_LONGEST_S = 30.0  # between two attempts to write again; begins with a status period, doubles
EVENTS_KEPT = 10_000  # while nothing can be written
_ROOM_AGAIN = 1.05  # recording resumes with this much more than the reserve
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT)


class Writing(StrEnum):
    """The state of writing to the disk."""

    RECORDING = "recording"
    RESERVE = "reserve"  # free space is down to the reserve, or the disk is full
    FAILED = "failed"  # stopped by another error of the disk or directory


@dataclass(slots=True)
class WriterHealth:
    """The writer's state for the watchdog and for people, updated each second.

    Attributes:
        status_ns: CLOCK_MONOTONIC when the latest status was written and synced, or when free space was last checked
            while writing is stopped for lack of it. An error of the disk does not advance it.
        free_bytes: on the log's file system.
        reserve_bytes: part of the free bytes that is kept free.
        bytes_per_s: written over the last second.
        reason: why writing is stopped, in words.
    """

    state: Writing = Writing.RECORDING
    status_ns: int = 0
    free_bytes: int = 0
    reserve_bytes: int = 0
    bytes_per_s: float = 0.0
    reason: str = ""
    statuses: dict[str, dict[str, object]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class RecorderSettings:
    """Settings from [session]: when to split, sync and stop."""

    split_bytes: int
    split_s: float
    fsync_s: float
    reserve_bytes: int


class Recorder(threading.Thread):
    """Owns the log's files; no other thread writes to them."""

    def __init__(
        self,
        parts: Parts,
        settings: RecorderSettings,
        queue: BlockQueue,
        channels: ChannelTable,
        events: Events,
        clock: HostClock,
        time_status: TimeStatus,
    ) -> None:
        super().__init__(name="writer", daemon=True)
        self.health = WriterHealth(status_ns=time.monotonic_ns(), reserve_bytes=settings.reserve_bytes)
        self.new_part = threading.Event()
        self.stop = threading.Event()
        self._parts = parts
        self._settings = settings
        self._queue = queue
        self._events = events
        self._clock = clock
        self._account = Account(parts, channels, events, clock, time_status)
        self._events_laid: deque[EncodedBlock] = deque(maxlen=EVENTS_KEPT)  # events of the current part, newest last
        self._events_waiting: deque[EncodedBlock] = deque(maxlen=EVENTS_KEPT)  # events for the next part
        self._synced_s = self._bytes_at_s = time.monotonic()
        self._status_due_s = time.monotonic() + STATUS_S
        self._split_after_s = self._resume_after_s = 0.0
        self._resume_wait_s = STATUS_S
        self._bytes_before = 0
        self._write_ms_max = self._sync_ms_max = 0.0

    # ------------------------------------------------------------------ sources and opening

    def add_source(self, source: str) -> None:
        """Add a source that gets a status; call this before the thread starts."""
        self._account.add_source(source)

    def open_first(self) -> None:
        """Open part 0, or stop at once if free space is below the reserve; raises OSError if the directory cannot be
        written.
        """
        self.health.free_bytes = self._free_bytes() or 0
        if self.health.free_bytes < self._settings.reserve_bytes:
            text = self._reserve_text()
            self._stop_writing(Writing.RESERVE, text)
            self._events.post(Severity.CRITICAL, "disk", "disk_reserve", text)
            return
        self._parts.open_next(self._clock.now_ns())

    # ------------------------------------------------------------------ the thread

    def run(self) -> None:
        """Write until the stop event, then write all that is still queued, the last status and the index."""
        name_thread("writer")
        try:
            while not self.stop.is_set():
                self.turn()
                time.sleep(TAKE_S)
            self._take()
            self._tell_status()
            self._finish_part()
            self._parts.remove_sign()
        except Exception as error:
            text = f"the writer failed: {type(error).__name__}: {error}"
            log.critical("recorder writer_failed: %s", text)
            self._stop_writing(Writing.FAILED, text)
            raise

    def turn(self) -> None:
        """Take the queued blocks, and do what is due."""
        self._take()
        self._guard(lambda part: part.close_due(time.monotonic_ns()))
        now_s = time.monotonic()
        if now_s >= self._status_due_s:
            self._status_due_s += STATUS_S
            if self._status_due_s <= now_s:  # after a stall: one status, not one for every second of it
                self._status_due_s = now_s + STATUS_S
            self._each_second()
        elif now_s - self._synced_s >= self._settings.fsync_s:
            self._sync()
        if self.new_part.is_set() or self._split_due(now_s):
            self.new_part.clear()
            self._split()

    def _each_second(self) -> None:
        if self.health.state is not Writing.RECORDING:
            self._try_resume()
        self._tell_status()
        self._sync()
        if self.health.state is Writing.RECORDING:
            self._look_after_part()
        if self.health.state is not Writing.FAILED:
            self.health.status_ns = time.monotonic_ns()
        self._parts.drop_page_cache()

    def _take(self) -> None:
        for item in self._queue.take_all():
            self._accept(item)

    def _accept(self, item: QueueItem) -> None:
        if item.block is not None:
            self._lay(item.block)
        if item.count is not None:
            self._account.note(item.source, item.count)

    def _lay(self, block: EncodedBlock) -> None:
        """Add a block to the current part; without one, events wait for the next part and units are counted as lost."""
        is_event = block.channel_id == self._events.channel_id
        if self._parts.current is not None:
            if is_event:
                self._events_laid.append(block)
            self._guard(lambda part: self._parts.add(block))
        elif is_event:
            self._events_waiting.append(block)
        else:
            self._account.unwritten[block.channel_id] += block.count

    def _guard(self, action: Callable[[PartWriter], None]) -> None:
        """Run an action on the current part; an error of the disk stops the writing, but not the recorder."""
        part = self._parts.current
        if part is None:
            return
        started = time.monotonic()
        try:
            action(part)
        except OSError as error:
            self._write_failed(error)
        self._write_ms_max = max(self._write_ms_max, (time.monotonic() - started) * 1e3)

    def _sync(self) -> None:
        self._guard(lambda part: part.flush())
        part = self._parts.current
        if part is None:
            return
        started = time.monotonic()
        try:
            part.sync()
        except OSError as error:
            self._write_failed(error)
        self._synced_s = time.monotonic()
        self._sync_ms_max = max(self._sync_ms_max, (self._synced_s - started) * 1e3)

    def _tell_status(self) -> None:
        """Flush, so that the counts are of written chunks, then write one status for each source."""
        self._guard(lambda part: part.flush())
        common = {
            "queue_high_water": self._queue.pop_high_water(),
            "write_ms_max": round(self._write_ms_max, 2),
            "sync_ms_max": round(self._sync_ms_max, 2),
        }
        self._write_ms_max = self._sync_ms_max = 0.0
        statuses = self.health.statuses = self._account.statuses(common)
        if self._parts.current is not None:
            for block in self._account.encode(statuses):
                self._lay(block)
            self._guard(lambda part: part.flush())
        self._measure_rate()

    def _measure_rate(self) -> None:
        now_s, written = time.monotonic(), self._parts.bytes_written()
        if now_s > self._bytes_at_s:
            self.health.bytes_per_s = max(0.0, (written - self._bytes_before) / (now_s - self._bytes_at_s))
        self._bytes_at_s, self._bytes_before = now_s, written

    # ------------------------------------------------------------------ disk

    def _free_bytes(self) -> int | None:
        """Return the free bytes on the log's file system for this user; None if the directory cannot be accessed."""
        try:
            stat = os.statvfs(self._parts.directory)
        except OSError:
            return None
        return stat.f_bavail * stat.f_frsize

    def _reserve_text(self) -> str:
        free_mb, reserve_mb = self.health.free_bytes / 1e6, self._settings.reserve_bytes / 1e6
        return (
            f"{free_mb:.0f} MB free in {self._parts.directory}, reserve is {reserve_mb:.0f} MB: "
            "recording is paused until there is more space"
        )

    def _look_after_part(self) -> None:
        """Check that there is free space, and that the file is still at its path."""
        if self._parts.has_gone() and time.monotonic() >= self._split_after_s:
            self._go_on_elsewhere()
        free_bytes = self._free_bytes()
        if free_bytes is None or self.health.state is not Writing.RECORDING:
            return
        self.health.free_bytes = free_bytes
        if free_bytes < self._settings.reserve_bytes:
            text = self._reserve_text()
            self._lay(self._events.make(Severity.CRITICAL, "disk", "disk_reserve", text))
            self._finish_part()
            self._stop_writing(Writing.RESERVE, text)
        elif time.monotonic() - self._parts.opened_monotonic_s > 2 * STATUS_S:
            self._resume_wait_s = STATUS_S

    def _go_on_elsewhere(self) -> None:
        part = self._parts.current
        assert part is not None
        text = f"{part.path} was removed or moved; recording continues in a new part"
        self._events.post(Severity.CRITICAL, "disk", "log_gone", text)
        self._split()
        if self._parts.current is part and part.is_unlinked():
            self._write_failed(OSError(errno.ENOENT, "the log was removed and a new one cannot be created"))

    def _write_failed(self, error: OSError) -> None:
        no_room = error.errno in _NO_ROOM
        what = "no space left" if no_room else (error.strerror or str(error))
        text = f"{what} in {self._parts.directory}: units are being lost and counted"
        self._finish_part()
        self._stop_writing(Writing.RESERVE if no_room else Writing.FAILED, text)
        self._events.post(Severity.CRITICAL, "disk", "write_failed", text)

    def _stop_writing(self, state: Writing, reason: str) -> None:
        self.health.state = state
        self.health.reason = reason
        self.health.free_bytes = self._free_bytes() or 0
        self._resume_after_s = time.monotonic() + self._resume_wait_s
        self._resume_wait_s = min(2 * self._resume_wait_s, RESUME_LONGEST_S)
        self._parts.remove_sign()

    def _try_resume(self) -> None:
        free_bytes = self._free_bytes()
        self.health.free_bytes = free_bytes or 0
        if free_bytes is not None and free_bytes < self._settings.reserve_bytes * _ROOM_AGAIN:
            return
        if time.monotonic() < self._resume_after_s:
            return
        try:
            self._open_next()
        except OSError as error:
            self.health.reason = f"{error.strerror or error} in {self._parts.directory}: units are being lost"
            return
        self.health.state = Writing.RECORDING
        lost = self._account.lost_write()
        waiting, self._events_waiting = self._events_waiting, deque(maxlen=EVENTS_KEPT)
        self._events_laid.clear()
        for block in waiting:
            self._lay(block)
        text = f"{lost} units of this session were not written"
        self._events.post(Severity.WARNING, "disk", "recording_resumed", text)

    # ------------------------------------------------------------------ parts

    def _split_due(self, now_s: float) -> bool:
        part = self._parts.current
        return (
            part is not None
            and now_s >= self._split_after_s
            and (
                part.bytes_written >= self._settings.split_bytes
                or now_s - self._parts.opened_monotonic_s >= self._settings.split_s
            )
        )

    def _open_next(self) -> PartWriter | None:
        """Open the next part; if its directory was recreated, lock it again, or post an event with the
        reason why not.
        """
        old = self._parts.open_next(self._clock.now_ns())
        try:
            self._parts.keep_directory()
        except OSError as error:
            why = "another recorder is running there" if isinstance(error, BlockingIOError) else error.strerror
            text = f"{self._parts.directory} was created again and is not locked: {why}; recording continues"
            self._events.post(Severity.ERROR, "recorder", "directory_unlocked", text)
        return old

    def _split(self) -> None:
        """Open the next part and write its first chunk before the old one is finished."""
        self._guard(lambda part: part.flush())
        if self._parts.current is None:
            return
        try:
            old = self._open_next()
        except OSError as error:
            self._split_after_s = time.monotonic() + SPLIT_AGAIN_S
            text = f"the next part cannot be opened ({error.strerror or error}); recording continues in this one"
            self._events.post(Severity.CRITICAL, "disk", "split_failed", text)
            return
        assert old is not None
        assert self._parts.current is not None
        name = self._parts.current.path.name
        self._events_laid.clear()
        closed = self._events.make(Severity.INFO, "recorder", "part_closed", name)
        self._lay(self._events.make(Severity.INFO, "recorder", "part_opened", name))
        self._sync()
        self._close(old, closed)

    def _finish_part(self) -> None:
        """Finish the current part; events whose chunk the disk refused wait for the next one."""
        part = self._parts.current
        if part is None:
            return
        try:
            part.flush()
        except OSError as error:
            log.error("recorder last chunk not written: %s", error.strerror or error)
        self._parts.release()
        lost_events = part.lost[self._events.channel_id]
        if lost_events:
            self._events_waiting.extend(list(self._events_laid)[-lost_events:])
        self._close(part, None)

    def _close(self, part: PartWriter, last: EncodedBlock | None) -> None:
        try:
            if last is not None:
                self._parts.add_last(part, last)
            part.finish()
        except OSError as error:
            part.close()
            text = (
                f"{part.path.name} could not be finished: {error.strerror or error}; run swath recover to complete it"
            )
            self._events.post(Severity.ERROR, "recorder", "part_unfinished", text)
