"""Accounts for every unit. For every source, at all times: units = written + lost_kernel + lost_queue + lost_write."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping

from swath.daemon.log.block_queue import SourceCount
from swath.daemon.log.channels import ChannelTable, JsonChannel
from swath.daemon.log.events import Events, Severity
from swath.daemon.log.host_clock import HostClock
from swath.daemon.log.mcap.encode import EncodedBlock
from swath.daemon.log.parts import Parts

STUCK_AFTER_S = 5.0  # without an account; a working receiver sends four a second while its device is open

TimeStatus = Callable[[str], "dict[str, object]"]


class Account:
    """Compares the units that the receivers took with the units that the parts wrote; used by the writer thread only.

    Attributes:
        counts: the latest account of each source, up to its last block that was taken from the queue.
        unwritten: number of messages by channel that arrived while nothing could be written.
    """

    def __init__(
        self, parts: Parts, channels: ChannelTable, events: Events, clock: HostClock, time_status: TimeStatus
    ) -> None:
        self.counts: dict[str, SourceCount] = {}
        self.unwritten: Counter[int] = Counter()
        self._heard_ns: dict[str, int] = {}
        self._parts = parts
        self._channels = channels
        self._events = events
        self._clock = clock
        self._time_status = time_status
        self._status_channels: dict[str, JsonChannel] = {}
        self._mismatch_told: set[str] = set()

    def add_source(self, source: str) -> None:
        """Register a source and its status channel."""
        self.note(source, SourceCount())
        self._status_channels[source] = JsonChannel(self._channels, "status", f"/status/{source}", "swath.Status")

    def note(self, source: str, count: SourceCount) -> None:
        """Store the latest account of a receiver and the time when it arrived."""
        self.counts[source] = count
        self._heard_ns[source] = self._clock.now_ns()

    def statuses(self, common: Mapping[str, object]) -> dict[str, dict[str, object]]:
        """Return one status for each source; ``common`` holds the values that all share: queue and disk."""
        return {source: self._status(source, common) for source in self.counts}

    def encode(self, statuses: Mapping[str, dict[str, object]]) -> list[EncodedBlock]:
        """Return the statuses as encoded messages."""
        now_ns = self._clock.now_ns()
        return [self._status_channels[source].encode(now_ns, status) for source, status in statuses.items()]

    def lost_write(self) -> int:
        """Return the number of units, over all sources, that were not written."""
        return sum(self._written_and_lost(source)[1] for source in self.counts)

    def _written_and_lost(self, source: str) -> tuple[int, int]:
        channel_ids = self._channels.of_source(source)
        written = sum(map(self._parts.total_written, channel_ids))
        lost = sum(self._parts.total_lost(id_) + self.unwritten[id_] for id_ in channel_ids)
        return written, lost

    def _status(self, source: str, common: Mapping[str, object]) -> dict[str, object]:
        count = self.counts[source]
        written, lost_write = self._written_and_lost(source)
        self._check(source, count, written, lost_write)
        now_ns = self._clock.now_ns()
        age = None if count.last_unit_ns is None else round((now_ns - count.last_unit_ns) * 1e-9, 3)
        quiet = now_ns - self._heard_ns[source] > STUCK_AFTER_S * 1e9
        status: dict[str, object] = {
            "bytes": count.bytes,
            "units": count.units,
            "written": written,
            "lost_kernel": count.lost_kernel,
            "lost_queue": count.lost_queue,
            "lost_write": lost_write,
            "last_unit_age_s": age,
            "receive_buffer_bytes": count.receive_buffer_bytes,
            **common,
            "state": "stuck" if quiet and count.state in ("receiving", "silent") else count.state,
            "stamp_ambiguous": count.stamp_ambiguous,
            **count.trouble,
        }
        return status | self._time_status(source)

    def _check(self, source: str, count: SourceCount, written: int, lost_write: int) -> None:
        accounted = written + count.lost_kernel + count.lost_queue + lost_write
        if count.units != accounted and source not in self._mismatch_told:
            self._mismatch_told.add(source)
            text = f"{count.units} units came, {accounted} are accounted for"
            self._events.post(Severity.CRITICAL, source, "account_mismatch", text)
