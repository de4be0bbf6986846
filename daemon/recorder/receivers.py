"""Receives from the wires, one thread for each: wait, take the kernel's data, stamp it, pass it to the recorder.

The receivers know no protocols. Only GNSS bytes are parsed as well, for their time messages, after they have been
passed on.

Faults that a wire or controller reports are posted when they begin and counted all the time. They are not lost units:
error frames are units themselves, and bytes garbled on the line are recorded as they arrive.
"""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from swath.daemon.log.block_queue import BlockQueue, QueueItem, SourceCount
from swath.daemon.log.channels import ChannelTable, JsonChannel
from swath.daemon.log.events import Events, Severity
from swath.daemon.log.format import ChannelSpec
from swath.daemon.log.host_clock import HostClock, StampConverter, read_clock_pair
from swath.daemon.log.mcap.encode import MESSAGE_HEADER_BYTES, EncodedBlock, encode_block
from swath.daemon.log.wires import BLOCK_BYTES, MAX_SENDERS, SILENT_AFTER_S, Senders, Wire, mixed_text
from swath.daemon.system import name_thread
from swath.drivers.session import Session, SessionState
from swath.drivers.transports.base import RawEdge, TransportCounters, UnitBlock
from swath.georef.arrays import Int64Array

REPORT_AGAIN_S = 30.0  # a continuing fault is reported at this interval, with the new counts


@dataclass(frozen=True, slots=True)
class _Kind:
    """One of the counters of a transport, and the event that reports its growth."""

    counter: str
    severity: Severity
    code: str
    text: str


_KINDS = (
    _Kind("bus_off", Severity.ERROR, "can_bus_off", "times the controller went off the bus; frames were lost"),
    _Kind(
        "error_frames",
        Severity.WARNING,
        "can_errors",
        "error frames (recorded); check cabling, termination and bit rate",
    ),
    _Kind(
        "line_errors",
        Severity.WARNING,
        "line_errors",
        "framing, parity or overrun errors on the line; check the baud rate",
    ),
    _Kind("refused", Severity.WARNING, "units_refused", "units rejected: from another sender, or unreadable"),
)


class WireTrouble:
    """Follows the error counters of one wire.

    Args:
        source: source of the events.
        events: receives the events.
        monotonic_s: the clock that decides when a continuing fault is reported again.
    """

    def __init__(self, source: str, events: Events, monotonic_s: Callable[[], float] = time.monotonic) -> None:
        self._source = source
        self._events = events
        self._monotonic_s = monotonic_s
        self._reported: dict[str, int] = {}
        self._reported_s: dict[str, float] = {}

    def look(self, counters: TransportCounters) -> dict[str, int | str]:
        """Report counters that have grown; return all that are not zero, and the most frequent senders refused."""
        found: dict[str, int | str] = {}
        senders = counters.refused_text()
        for kind in _KINDS:
            count: int = getattr(counters, kind.counter)
            if count:
                found[kind.counter] = count
                self._tell(kind, count, f"; most of {senders}" if senders and kind.counter == "refused" else "")
        if senders:
            found["refused_senders"] = senders
        return found

    def _tell(self, kind: _Kind, count: int, more: str) -> None:
        now_s = self._monotonic_s()
        grown = count - self._reported.get(kind.counter, 0)
        if grown > 0 and now_s - self._reported_s.get(kind.counter, -REPORT_AGAIN_S) >= REPORT_AGAIN_S:
            self._reported[kind.counter], self._reported_s[kind.counter] = count, now_s
            self._events.post(kind.severity, self._source, kind.code, f"{grown} {kind.text}{more}")


WAIT_S = 0.2  # a receive thread returns from its wait at least this often
ACCOUNT_S = 0.25  # and reports its losses at least this often
DRAIN_S = 1.0  # at the end, data that the kernel already holds is taken for no longer than this
QUEUE_REPORT_S = 1.0  # the queue counts as having room again after so long without a refusal

UnitsSeen = Callable[[Int64Array, UnitBlock], None]


@dataclass(slots=True)
class _Account:
    """Running totals of one receiver; `snapshot` travels with the blocks."""

    units: int = 0
    bytes: int = 0
    lost_kernel: int = 0
    lost_queue: int = 0
    last_unit_ns: int | None = None
    receive_buffer_bytes: int = 0
    state: str = "opening"
    ambiguous: int = 0
    trouble: dict[str, int | str] = field(default_factory=dict)

    def snapshot(self) -> SourceCount:
        return SourceCount(
            units=self.units,
            bytes=self.bytes,
            lost_kernel=self.lost_kernel,
            lost_queue=self.lost_queue,
            stamp_ambiguous=self.ambiguous,
            last_unit_ns=self.last_unit_ns,
            receive_buffer_bytes=self.receive_buffer_bytes,
            state=self.state,
            trouble=self.trouble,
        )


@dataclass(slots=True)
class Shared:
    """The objects that all receivers of a session share."""

    clock: HostClock
    queue: BlockQueue
    channels: ChannelTable
    events: Events
    stop: threading.Event = field(default_factory=threading.Event)


class Receiver(threading.Thread, ABC):
    """Runs a receive thread; subclasses take units and edges.

    Attributes:
        came_back_ns: CLOCK_MONOTONIC of the last return from a wait, for the watchdog.
        failed: the thread ended by a defect.
    """

    def __init__(self, source: str, shared: Shared) -> None:
        super().__init__(name=source, daemon=True)
        self.source = source
        self.came_back_ns = time.monotonic_ns()
        self.failed = False
        self.shared = shared
        self.account = _Account()
        self.stamps = StampConverter(shared.clock)
        self._accounted_ns = 0
        self._reported_state = SessionState.CLOSED
        self._reported_error = ""
        self._reported_silent = False
        self._opened_ns = self._silent_since_ns = shared.clock.now_ns()
        self._refused_ns: int | None = None  # CLOCK_MONOTONIC when the queue last had no room
        self._lost_before = 0  # lost_queue before the queue refused blocks

    def run(self) -> None:
        """Receive until the stop event; an error here is a defect, which the watchdog turns into a restart."""
        name_thread(self.source)
        try:
            while not self.shared.stop.is_set():
                self.receive_once()
                self.came_back_ns = time.monotonic_ns()
            self.finish()
        except Exception as error:
            self.failed = True
            text = f"receive thread failed: {type(error).__name__}: {error}"
            self.shared.events.post(Severity.CRITICAL, self.source, "receiver_failed", text)
            raise

    @property
    @abstractmethod
    def opening(self) -> bool:
        """True if the device is being opened at this moment."""

    @abstractmethod
    def take(self, timeout_s: float) -> int | None:
        """Wait for data and pass it on; return the host time that the kernel gave the newest unit.

        None if there was no unit; 0 where the kernel gives no time, so that a unit may have waited since any moment.
        """

    @abstractmethod
    def receive_once(self) -> None:
        """Wait once, handle the data, and report states and counts."""

    @abstractmethod
    def finish(self) -> None:
        """Close the device and give the last account."""

    def drain(self) -> None:
        """Take the data that the kernel held when the stop was requested."""
        ended_ns, limit_ns = self.shared.clock.now_ns(), time.monotonic_ns() + int(DRAIN_S * 1e9)
        while time.monotonic_ns() < limit_ns:
            newest_ns = self.take(0.0)
            if newest_ns is None or newest_ns >= ended_ns:
                return

    def hand_over(self, block: EncodedBlock) -> None:
        """Put a block and the account so far into the queue; blocks it refuses are counted, with one event for each
        episode.
        """
        now_ns = time.monotonic_ns()
        if not self.shared.queue.put(QueueItem(self.source, block, self.account.snapshot())):
            if self._refused_ns is None:
                self._lost_before = self.account.lost_queue
                text = "the writer is too slow and its queue is full; units are being dropped and counted"
                self.shared.events.post(Severity.CRITICAL, self.source, "queue_full", text)
            self._refused_ns = now_ns
            self.account.lost_queue += block.count
        elif self._refused_ns is not None and now_ns - self._refused_ns > QUEUE_REPORT_S * 1e9:
            self._refused_ns = None
            text = f"the queue has space again; {self.account.lost_queue - self._lost_before} units were dropped"
            self.shared.events.post(Severity.WARNING, self.source, "queue_drained", text)

    def tell_account(self, *, now: bool = False) -> None:
        """Send the totals to the recorder, even if no unit arrived."""
        monotonic = time.monotonic_ns()
        if now or monotonic - self._accounted_ns >= ACCOUNT_S * 1e9:
            self._accounted_ns = monotonic
            self.shared.queue.put(QueueItem(self.source, count=self.account.snapshot()))

    def tell_state(self, state: SessionState, last_error: str) -> None:
        """Post opening, loss, a changed reason for absence, silence and return as events, each once."""
        if state is not self._reported_state:
            self._tell_change(state, last_error)
            self._reported_state = state
        elif state is SessionState.WAITING and last_error != self._reported_error:
            self.shared.events.post(Severity.WARNING, self.source, "device_absent", f"{last_error}; waiting for it")
        self._reported_error = last_error
        self.account.state = self._state_word(state)

    def _tell_change(self, state: SessionState, last_error: str) -> None:
        post = self.shared.events.post
        if state is SessionState.OPEN:
            self.account.last_unit_ns = None
            self._opened_ns = self.shared.clock.now_ns()
            self._reported_silent = False
            post(Severity.INFO, self.source, "device_opened", "opened")
        elif self._reported_state is SessionState.OPEN:
            post(Severity.ERROR, self.source, "device_lost", f"{last_error}; waiting for it")
        elif self._reported_state is SessionState.CLOSED and state is SessionState.WAITING:
            post(Severity.WARNING, self.source, "device_absent", f"{last_error}; waiting for it")

    def _state_word(self, state: SessionState) -> str:
        if state is not SessionState.OPEN:
            return "absent" if state is SessionState.WAITING else "opening"
        last = self.account.last_unit_ns or self._opened_ns
        silent_s = (self.shared.clock.now_ns() - last) * 1e-9
        if silent_s <= SILENT_AFTER_S:
            return "receiving"
        if not self._reported_silent:
            self._reported_silent = True
            self._silent_since_ns = last
            self.shared.events.post(Severity.WARNING, self.source, "silent", f"no data for {silent_s:.0f} s")
        return "silent"

    def note_units(self, count: int, length: int, last_ns: int) -> None:
        """Count units; post an event if they end a silence."""
        if self._reported_silent:
            self._reported_silent = False
            gap_s = (last_ns - self._silent_since_ns) * 1e-9
            self.shared.events.post(Severity.INFO, self.source, "resumed", f"data again after {gap_s:.1f} s")
        self.account.units += count
        self.account.bytes += count * length
        self.account.last_unit_ns = last_ns


class UnitReceiver(Receiver):
    """Takes serial reads, datagrams or CAN frames of one wire."""

    def __init__(
        self, wire: Wire, session: Session[UnitBlock], shared: Shared, units_seen: Sequence[UnitsSeen] = ()
    ) -> None:
        super().__init__(wire.source, shared)
        self._wire = wire
        self._session = session
        self._units_seen = units_seen
        self._channel_ids: dict[tuple[str, int] | None, int] = {}
        self._sequences: dict[int, int] = {}
        self._senders = Senders()
        self._reported_buffer = False
        self._trouble = WireTrouble(wire.source, shared.events)

    @property
    def opening(self) -> bool:
        """True if the device is being opened at this moment."""
        return self._session.state is SessionState.OPENING

    def take(self, timeout_s: float) -> int | None:
        """Wait for units, stamp them, pass them on, then give them to the callbacks in ``units_seen``."""
        blocks = self._session.receive(timeout_s)
        if not blocks:
            return None
        times = self.stamps.stamp(blocks)
        self.account.ambiguous = self.stamps.ambiguous
        self._update_kernel_losses(force=False)
        for block, log_time_ns in zip(blocks, times, strict=True):
            self._hand_over(block, log_time_ns)
        for units_seen in self._units_seen:
            for block, log_time_ns in zip(blocks, times, strict=True):
                units_seen(log_time_ns, block)
        return 0 if blocks[-1].kernel_realtime_ns is None else int(times[-1][-1])

    def receive_once(self) -> None:
        """Wait once; then report the state of the device, and losses."""
        took = self.take(WAIT_S) is not None
        self.tell_state(self._session.state, self._session.last_error)
        self._update_kernel_losses(force=not took)
        self.tell_account()

    def finish(self) -> None:
        """Take the rest and close; the closed socket gives the kernel's final count of losses."""
        if self._session.state is SessionState.OPEN:
            self.drain()
        self._session.close()
        self._update_kernel_losses(force=True)
        self.tell_account(now=True)

    def _hand_over(self, block: UnitBlock, log_time_ns: Int64Array) -> None:
        count, length = block.units.shape
        channel_id = self._channel(block.peer)
        if block.peer is not None and not self._senders.mixed:
            self._senders.add(block.peer[0], int(log_time_ns[0]), int(log_time_ns[-1]), count)
            if self._senders.mixed and not self._wire.source.startswith("raw/"):
                text = mixed_text(self._senders.counts, recorded=False)
                self.shared.events.post(Severity.ERROR, self.source, "mixed_senders", text)
        step = max(1, BLOCK_BYTES // (length + MESSAGE_HEADER_BYTES))
        for first in range(0, count, step):
            units, times = block.units[first : first + step], log_time_ns[first : first + step]
            sequence = self._sequences[channel_id]
            self._sequences[channel_id] = (sequence + len(units)) & 0xFFFFFFFF
            self.note_units(len(units), length, int(times[-1]))
            rows = None if block.rows is None else block.rows[first : first + step]
            self.hand_over(encode_block(channel_id, sequence, times, units, rows=rows))

    def _channel(self, peer: tuple[str, int] | None) -> int:
        channel_id = self._channel_ids.get(peer)
        if channel_id is None:
            if len(self._channel_ids) >= MAX_SENDERS:
                peer = None
            channel_id = self._channel_ids.get(peer) or self._add_channel(peer)
        return channel_id

    def _add_channel(self, peer: tuple[str, int] | None) -> int:
        metadata = dict(self._wire.metadata)
        if peer is not None:
            metadata |= {"source_address": peer[0], "source_port": str(peer[1])}
        elif self._channel_ids:
            text = f"more than {MAX_SENDERS} senders; all others are recorded on one channel without a sender"
            self.shared.events.post(Severity.WARNING, self.source, "many_senders", text)
        wire = self._wire
        spec = ChannelSpec(wire.topic, wire.encoding, metadata, None, wire.chunk_class)
        channel_id = self.shared.channels.add(self.source, spec)
        self._channel_ids[peer] = channel_id
        self._sequences[channel_id] = 0
        return channel_id

    def _update_kernel_losses(self, *, force: bool) -> None:
        now = time.monotonic_ns()
        if not force and now - self._accounted_ns < ACCOUNT_S * 1e9:
            return
        counters = self._session.poll_counters()
        lost = counters.lost_kernel - self.account.lost_kernel
        if lost > 0:
            self.account.lost_kernel += lost
            self.account.units += lost
            text = f"the kernel dropped {lost} units: the receive buffer was full"
            self.shared.events.post(Severity.ERROR, self.source, "lost_kernel", text)
        self.account.trouble = self._trouble.look(counters)
        granted = counters.receive_buffer_bytes
        self.account.receive_buffer_bytes = granted
        wanted = counters.receive_buffer_asked_bytes
        if granted < wanted and not self._reported_buffer:
            self._reported_buffer = True
            text = f"receive buffer of {granted} bytes granted, {wanted} wanted: sysctl -w net.core.rmem_max=67108864"
            self.shared.events.post(Severity.WARNING, self.source, "receive_buffer_small", text)


class PpsReceiver(Receiver):
    """Takes the edges of one PPS source; every edge goes to ``/pps/<name>``, whether the clock accepts it or not.

    Args:
        overwrites: the kernel keeps only the newest edge, so edges that it overwrote before they were fetched appear as
            a jump of the sequence. (A FIFO holds every edge: one that is missing there was never written.)
    """

    def __init__(
        self,
        name: str,
        session: Session[RawEdge],
        shared: Shared,
        edge_seen: Callable[[int, int], None],
        *,
        overwrites: bool = True,
    ) -> None:
        super().__init__(f"pps/{name}", shared)
        self._session = session
        self._edge_seen = edge_seen
        self._channel = JsonChannel(shared.channels, self.source, f"/pps/{name}", "swath.Pps")
        self._overwrites = overwrites
        self._trouble = WireTrouble(self.source, shared.events)
        self._sequence: int | None = None
        self._openings = 0

    @property
    def opening(self) -> bool:
        """True if the device is being opened at this moment."""
        return self._session.state is SessionState.OPENING

    def take(self, timeout_s: float) -> int | None:
        """Wait for edges and pass them on."""
        edges = self._session.receive(timeout_s)
        if not edges:
            return None
        stamps = np.array([edge.realtime_ns for edge in edges], dtype=np.int64)
        times = self.stamps.convert_at(stamps, len(edges), read_clock_pair())
        self.account.ambiguous = self.stamps.ambiguous
        for edge, host_ns in zip(edges, times.tolist(), strict=True):
            self._hand_over(edge, host_ns)
        return int(times[-1])

    def receive_once(self) -> None:
        """Wait once; then report the state of the device."""
        self.take(WAIT_S)
        self.account.trouble = self._trouble.look(self._session.poll_counters())
        self.tell_state(self._session.state, self._session.last_error)
        self.tell_account()

    def finish(self) -> None:
        """Take the rest, close and give the last account."""
        if self._session.state is SessionState.OPEN:
            self.drain()
        self._session.close()
        self.account.trouble = self._trouble.look(self._session.poll_counters())
        self.tell_account(now=True)

    def _hand_over(self, edge: RawEdge, host_ns: int) -> None:
        self._count_missed(edge.sequence)
        value: dict[str, object] = {
            "edge_time_ns": host_ns,
            "sequence": edge.sequence,
            "edge": edge.edge,
            "realtime_ns": edge.realtime_ns,
        }
        encoded = self._channel.encode(self.shared.clock.now_ns(), value)
        self.note_units(1, len(encoded.data) - MESSAGE_HEADER_BYTES, host_ns)
        self.hand_over(encoded)
        self._edge_seen(host_ns, edge.sequence)

    def _count_missed(self, sequence: int) -> None:
        """Count edges since the previous one that were overwritten before they were fetched, while the
        device was open.
        """
        if self._openings != self._session.openings:
            self._openings, self._sequence = self._session.openings, None
        previous, self._sequence = self._sequence, sequence
        missed = 0 if previous is None else ((sequence - previous) & 0xFFFFFFFF) - 1
        if self._overwrites and 0 < missed < 1000:
            self.account.lost_kernel += missed
            self.account.units += missed
            text = f"{missed} edges were overwritten before they could be fetched"
            self.shared.events.post(Severity.ERROR, self.source, "lost_kernel", text)
