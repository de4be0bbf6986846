"""The writer thread: takes blocks from the queue, lays them into the current part and accounts for every unit.

For every source, always: units = written + lost_kernel + lost_queue + lost_write. A status message is written after
all chunks that its counts speak of, so it is true of the file that it stands in, up to the place where it stands.
"""

from __future__ import annotations

import errno
import logging
import os
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum

from daemon.block_queue import BlockQueue, QueueItem, SourceCount
from daemon.channels import ChannelTable, JsonChannel
from daemon.events import Events, Severity
from daemon.host_clock import HostClock
from daemon.log.encode import EncodedBlock
from daemon.log.writer import PartWriter
from daemon.parts import Parts
from daemon.threads import name_thread

log = logging.getLogger("swath")

TAKE_S = 0.02  # pause between two looks at the queue
STATUS_S = 1.0
_ROOM_AGAIN = 1.05  # recording resumes with this much more than the reserve

TimeStatus = Callable[[str], "dict[str, object]"]


class Writing(StrEnum):
    """Whether data reaches the disk."""

    RECORDING = "recording"
    RESERVE = "reserve"  # stopped on purpose: the disk is full up to the reserve
    FAILED = "failed"  # stopped by an error of the disk or directory


@dataclass(slots=True)
class WriterHealth:
    """What the watchdog and people want to know, updated each second.

    Attributes:
        status_ns: CLOCK_MONOTONIC when the latest status was written and synced, or the stop was looked at.
        free_bytes: on the log's file system.
        bytes_per_s: written over the last second.
        reason: why nothing is written, in words.
    """

    state: Writing = Writing.RECORDING
    status_ns: int = 0
    free_bytes: int = 0
    bytes_per_s: float = 0.0
    reason: str = ""
    write_ms_max: float = 0.0
    sync_ms_max: float = 0.0
    statuses: dict[str, dict[str, object]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class RecorderSettings:
    """From [session]: when to split, sync and stop."""

    split_bytes: int
    split_s: float
    fsync_s: float
    reserve_bytes: int


class Recorder(threading.Thread):
    """Owns the log's files; nobody else writes to them."""

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
        self.health = WriterHealth(status_ns=time.monotonic_ns())
        self.new_part = threading.Event()
        self.stop = threading.Event()
        self._parts = parts
        self._settings = settings
        self._queue = queue
        self._channels = channels
        self._events = events
        self._clock = clock
        self._time_status = time_status
        self._counts: dict[str, SourceCount] = {}
        self._unwritten: Counter[int] = Counter()  # messages that came while nothing could be written
        self._status_channels: dict[str, JsonChannel] = {}
        self._pending_events: list[EncodedBlock] = []
        self._synced_s = time.monotonic()
        self._status_due_s = time.monotonic() + STATUS_S
        self._bytes_before = 0
        self._mismatch_told: set[str] = set()

    # ------------------------------------------------------------------ sources and opening

    def add_source(self, source: str) -> None:
        """A source that gets a status; before the thread starts."""
        self._counts[source] = SourceCount()
        self._status_channels[source] = JsonChannel(self._channels, "status", f"/status/{source}", "swath.Status")

    def open_first(self) -> None:
        """Open part 0, or stop at the reserve at once; raises OSError when the directory cannot be written."""
        if self._free_bytes() < self._settings.reserve_bytes:
            self._stop_writing(Writing.RESERVE, self._reserve_text())
            return
        self._parts.open_next(self._clock.now_ns())

    # ------------------------------------------------------------------ the thread

    def run(self) -> None:
        """Write until told to stop, then everything that is still queued, the last status and the index."""
        name_thread("writer")
        try:
            while not self.stop.is_set():
                self._turn()
                time.sleep(TAKE_S)
            self._take()
            self._tell_status()
            self._finish_part()
            if self.health.state is Writing.RECORDING:
                self._parts.remove_sign()
        except Exception as error:
            log.critical("writer failed: %s: %s", type(error).__name__, error)
            raise

    def _turn(self) -> None:
        self._take()
        now_s = time.monotonic()
        self._guard(lambda part: part.close_due(time.monotonic_ns()))
        if now_s >= self._status_due_s:
            self._status_due_s = max(self._status_due_s + STATUS_S, now_s)
            self._each_second()
        elif now_s - self._synced_s >= self._settings.fsync_s:
            self._sync()
        if self.new_part.is_set() or self._split_due(now_s):
            self.new_part.clear()
            self._split()

    def _each_second(self) -> None:
        if self.health.state is Writing.RECORDING:
            self._check_room()
        else:
            self._try_resume()
        self._tell_status()
        self._sync()
        self._parts.drop_page_cache()
        self.health.status_ns = time.monotonic_ns()

    def _take(self) -> None:
        for item in self._queue.take_all():
            self._accept(item)

    def _accept(self, item: QueueItem) -> None:
        if item.block is not None:
            if self._parts.current is not None:
                block = item.block
                self._guard(lambda part: self._parts.add(block))
            elif item.block.channel_id == self._events.channel_id:
                self._pending_events = [*self._pending_events[-999:], item.block]
            else:
                self._unwritten[item.block.channel_id] += item.block.count
        if item.count is not None:
            self._counts[item.source] = item.count

    def _guard(self, action: Callable[[PartWriter], None]) -> None:
        """Do something to the current part; an error of the disk stops the writing, never the recorder."""
        part = self._parts.current
        if part is None:
            return
        started = time.monotonic()
        try:
            action(part)
        except OSError as error:
            self._write_failed(error)
        self.health.write_ms_max = max(self.health.write_ms_max, (time.monotonic() - started) * 1e3)

    def _sync(self) -> None:
        part = self._parts.current
        if part is None:
            return
        started = time.monotonic()
        try:
            part.flush()
            part.sync()
        except OSError as error:
            self._write_failed(error)
        self._synced_s = time.monotonic()
        self.health.sync_ms_max = max(self.health.sync_ms_max, (self._synced_s - started) * 1e3)

    # ------------------------------------------------------------------ accounting

    def _tell_status(self) -> None:
        """Flush, so that the counts are of written chunks, then write one status a source."""
        self._guard(lambda part: part.flush())
        statuses = {source: self._status(source) for source in self._counts}
        self.health.statuses = statuses
        if self._parts.current is not None:
            now_ns = self._clock.now_ns()
            for source, status in statuses.items():
                block = self._status_channels[source].encode(now_ns, status)
                self._guard(lambda part, block=block: self._parts.add(block))  # type: ignore[misc]
            self._guard(lambda part: part.flush())
        part = self._parts.current
        written = part.bytes_written if part is not None else 0
        self.health.bytes_per_s = max(0, written - self._bytes_before) / STATUS_S
        self._bytes_before = written
        self.health.write_ms_max = self.health.sync_ms_max = 0.0

    def _status(self, source: str) -> dict[str, object]:
        count = self._counts[source]
        channel_ids = [id_ for id_, owner in self._channels.sources.copy().items() if owner == source]
        written = sum(self._parts.total_written(id_) for id_ in channel_ids)
        lost_write = sum(self._parts.total_lost(id_) + self._unwritten[id_] for id_ in channel_ids)
        age = None if count.last_unit_ns is None else round((self._clock.now_ns() - count.last_unit_ns) * 1e-9, 3)
        self._check_account(source, count, written, lost_write)
        status: dict[str, object] = {
            "bytes": count.bytes,
            "units": count.units,
            "written": written,
            "lost_kernel": count.lost_kernel,
            "lost_queue": count.lost_queue,
            "lost_write": lost_write,
            "last_unit_age_s": age,
            "receive_buffer_bytes": count.receive_buffer_bytes,
            "queue_high_water": self._queue.pop_high_water() if source == next(iter(self._counts)) else 0,
            "write_ms_max": round(self.health.write_ms_max, 2),
            "sync_ms_max": round(self.health.sync_ms_max, 2),
            "state": count.state,
            "stamp_ambiguous": count.stamp_ambiguous,
        }
        return status | self._time_status(source)

    def _check_account(self, source: str, count: SourceCount, written: int, lost_write: int) -> None:
        accounted = written + count.lost_kernel + count.lost_queue + lost_write
        if count.units != accounted and source not in self._mismatch_told:
            self._mismatch_told.add(source)
            text = f"{count.units} units came, {accounted} are accounted for"
            self._events.post(Severity.CRITICAL, source, "account_mismatch", text)

    # ------------------------------------------------------------------ disk

    def _free_bytes(self) -> int:
        try:
            stat = os.statvfs(self._parts.directory)
        except OSError:
            return 0
        return stat.f_bavail * stat.f_frsize

    def _reserve_text(self) -> str:
        free_mb, reserve_mb = self._free_bytes() / 1e6, self._settings.reserve_bytes / 1e6
        return (
            f"{free_mb:.0f} MB free in {self._parts.directory}, reserve is {reserve_mb:.0f} MB: "
            "recording stopped until there is room"
        )

    def _check_room(self) -> None:
        self.health.free_bytes = self._free_bytes()
        if self.health.free_bytes < self._settings.reserve_bytes:
            text = self._reserve_text()
            block = self._events.make(Severity.CRITICAL, "disk", "disk_reserve", text)
            self._guard(lambda part: self._parts.add(block))
            self._finish_part()
            self._stop_writing(Writing.RESERVE, text)

    def _write_failed(self, error: OSError) -> None:
        what = "no space left" if error.errno == errno.ENOSPC else (error.strerror or str(error))
        text = f"{what} in {self._parts.directory}: units are being lost and counted"
        self._finish_part()
        self._stop_writing(Writing.FAILED, text)
        self._events.post(Severity.CRITICAL, "disk", "write_failed", text)

    def _stop_writing(self, state: Writing, reason: str) -> None:
        self.health.state = state
        self.health.reason = reason
        self.health.free_bytes = self._free_bytes()

    def _try_resume(self) -> None:
        self.health.free_bytes = self._free_bytes()
        if self.health.free_bytes < self._settings.reserve_bytes * _ROOM_AGAIN:
            return
        try:
            self._parts.open_next(self._clock.now_ns())
        except OSError as error:
            self.health.reason = f"{error.strerror or error} in {self._parts.directory}: units are being lost"
            return
        self.health.state = Writing.RECORDING
        lost = sum(self._unwritten.values())
        self._events.post(Severity.WARNING, "disk", "recording_resumed", f"room again; {lost} units were not written")
        for block in self._pending_events:
            self._guard(lambda part, block=block: self._parts.add(block))  # type: ignore[misc]
        self._pending_events = []

    # ------------------------------------------------------------------ parts

    def _split_due(self, now_s: float) -> bool:
        part = self._parts.current
        return part is not None and (
            part.bytes_written >= self._settings.split_bytes
            or now_s - self._parts.opened_monotonic_s >= self._settings.split_s
        )

    def _split(self) -> None:
        """Open the next part and write its first chunk before the old one is finished."""
        if self._parts.current is None:
            return
        self._guard(lambda part: part.flush())
        next_name = self._parts.next_path().name
        closing = self._events.make(Severity.INFO, "recorder", "part_closed", next_name)
        old = self._parts.release()
        try:
            self._parts.open_next(self._clock.now_ns())
        except OSError as error:
            self._parts.current = None
            self._close_old(old, None)
            self._write_failed(error)
            return
        opened = self._events.make(Severity.INFO, "recorder", "part_opened", next_name)
        self._guard(lambda part: self._parts.add(opened))
        self._sync()
        self._close_old(old, closing)

    def _close_old(self, old: PartWriter | None, closing: EncodedBlock | None) -> None:
        if old is None:
            return
        try:
            if closing is not None:
                old.add(closing)
            old.finish()
        except OSError as error:
            text = f"{old.path.name} could not be finished: {error.strerror or error}; swath recover completes it"
            self._events.post(Severity.ERROR, "recorder", "part_unfinished", text)

    def _finish_part(self) -> None:
        self._guard_release()

    def _guard_release(self) -> None:
        part = self._parts.current
        if part is None:
            return
        try:
            part.flush()
        except OSError as error:
            log.error("last chunk not written: %s", error.strerror or error)
        self._close_old(self._parts.release(), None)
