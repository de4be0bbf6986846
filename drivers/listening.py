"""Listens to wires, each in a thread of its own, and hands what came to a reader that may be slower.

A thread waits in the kernel and decodes; its results wait in a `Backlog` whose lane for each wire is bounded. If a
lane is full, the thread either waits, so that the kernel's buffer fills, then loses and counts; or the oldest results
go and are counted. The reader may be an asyncio loop: it is woken once when it has nothing left, however many results
come until it runs.
"""

from __future__ import annotations

import asyncio
import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Generic, TypeVar

from swath.drivers.session import Session, SessionState
from swath.drivers.transports.base import TransportCounters

WAIT_S = 0.2  # a listening thread returns from its wait at least this often
LATE_S = 0.1  # a thread that waited longer for its reader finds old bytes in the kernel's buffer afterwards …
LATE_BYTES = 2048  # … until a reading has fewer than this: half the buffer of a terminal
SILENT_AFTER_S = 3.0

UnitT = TypeVar("UnitT")
ItemT = TypeVar("ItemT")


class Overflow(StrEnum):
    """Says what a wire does with results that the reader does not take in time: it waits, or drops the oldest."""

    WAIT = "wait"
    DROP = "drop"


@dataclass(frozen=True, slots=True)
class Measured(Generic[ItemT]):
    """The outcome of one reading of a wire.

    Attributes:
        item: for the reader; None: there is nothing to hand over.
        size_bytes: memory that it holds.
        units, raw_bytes: received in the reading.
    """

    item: ItemT | None
    size_bytes: int
    units: int
    raw_bytes: int


@dataclass(slots=True)
class _Lane(Generic[ItemT]):
    """Holds the items of one wire that wait for the reader, with the number of their arrival, oldest first."""

    items: deque[tuple[int, Measured[ItemT]]] = field(default_factory=deque)
    size_bytes: int = 0
    dropped: int = 0  # units

    def push(self, number: int, item: Measured[ItemT]) -> None:
        self.items.append((number, item))
        self.size_bytes += item.size_bytes

    def pop(self) -> Measured[ItemT]:
        _, item = self.items.popleft()
        self.size_bytes -= item.size_bytes
        return item


class Backlog(Generic[ItemT]):
    """Holds the items that several threads have put and one reader has not taken yet; bounded for each wire.

    Args:
        limit_bytes: memory that the items of a wire may hold; a single larger item finds room in an empty lane.
        overflow: what happens at the limit.
        wake: called in a putting thread, once after each `pop` that found nothing, when there is something again or
            the backlog was closed; must not block.
    """

    def __init__(self, limit_bytes: int, overflow: Overflow, wake: Callable[[], None] = lambda: None) -> None:
        self._limit_bytes, self._overflow, self._wake = limit_bytes, overflow, wake
        self._lanes: dict[str, _Lane[ItemT]] = {}
        self._room = threading.Condition()
        self._number = 0
        self._hungry = False
        self._closed = False
        self._error: BaseException | None = None

    def put(self, wire: str, item: Measured[ItemT]) -> float:
        """Add an item of a wire; return the seconds that this waited for room. Once closed, the item is dropped."""
        waited_s = 0.0
        with self._room:
            lane = self._lanes.setdefault(wire, _Lane())
            while not self._closed and lane.items and lane.size_bytes + item.size_bytes > self._limit_bytes:
                if self._overflow is Overflow.DROP:
                    lane.dropped += lane.pop().units
                    continue
                begun_s = time.monotonic()
                self._room.wait()
                waited_s += time.monotonic() - begun_s
            if not self._closed:
                self._number += 1
                lane.push(self._number, item)
            self._feed()
        return waited_s

    def _feed(self) -> None:
        """Wake the reader if it waits; the caller holds the lock."""
        if self._hungry:
            self._hungry = False
            self._wake()

    def pop(self) -> ItemT | None:
        """Take the item that came first; None: there is none now, and `wake` will be called.

        Raises:
            BaseException: what a thread failed with, after the items before it.
        """
        with self._room:
            lanes = [lane for lane in self._lanes.values() if lane.items]
            if not lanes:
                if self._error is not None:
                    raise self._error
                self._hungry = not self._closed
                return None
            found = min(lanes, key=lambda lane: lane.items[0][0]).pop()
            self._room.notify_all()
        return found.item

    def fail(self, error: BaseException) -> None:
        """End the reading with an error, which is a defect of the thread."""
        with self._room:
            self._error = self._error or error
            self._feed()

    def close(self) -> None:
        """Let every waiting thread go on, and drop what they put from now on; items that wait can still be taken."""
        with self._room:
            self._closed = True
            self._room.notify_all()
            self._feed()

    @property
    def is_closed(self) -> bool:
        """True if nothing will be added."""
        return self._closed

    def dropped(self, wire: str) -> int:
        """Return the number of units of a wire that were dropped."""
        lane = self._lanes.get(wire)
        return 0 if lane is None else lane.dropped


class LoopReader(Generic[ItemT]):
    """Lets one task of an asyncio loop read a backlog.

    Args:
        limit_bytes, overflow: as in `Backlog`.

    Attributes:
        backlog: what the threads put into.
    """

    def __init__(self, limit_bytes: int, overflow: Overflow) -> None:
        self.backlog: Backlog[ItemT] = Backlog(limit_bytes, overflow, self._wake)
        self._arrived = asyncio.Event()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._taking = False

    def _wake(self) -> None:
        if self._loop is not None:
            with contextlib.suppress(RuntimeError):  # the loop was closed, so that nobody reads
                self._loop.call_soon_threadsafe(self._arrived.set)

    async def take(self) -> ItemT | None:
        """Wait for the item that came first; None: there will be no more.

        Raises:
            BusyError: another task waits for an item already.
        """
        if self._taking:
            raise BusyError("another task already reads from here; let one task read and give the others their part")
        self._loop = asyncio.get_running_loop()
        self._taking = True
        try:
            # A reader that is slower than its wires must not keep the loop to itself. The pause comes before an item is
            # taken, because a task that is cancelled in it must not take one along.
            await asyncio.sleep(0)
            while True:
                self._arrived.clear()
                item = self.backlog.pop()
                if item is not None:
                    return item
                if self.backlog.is_closed:
                    return None
                await self._arrived.wait()
        finally:
            self._taking = False


class BusyError(RuntimeError):
    """Two tasks read from one backlog at the same time."""


class Listener(threading.Thread, Generic[UnitT, ItemT]):
    """Keeps one wire open, decodes what comes, and puts it into a backlog.

    Args:
        wire: name of the wire in the backlog, ``scanner/left/aux``.
        make_session: makes the session; its argument is called with every new state and its reason.
        backlog: receives the items.
        decode: makes an item of the units of one reading. The second argument is True if the reader made the wire
            wait, so that the bytes may be older than their reading.
        look: called after every wait, for what has to be done regularly.
        changed: called in this thread after every change of state; must not block.

    Attributes:
        session: the session of the wire.
        units, bytes: received so far.
    """

    def __init__(
        self,
        wire: str,
        make_session: Callable[[Callable[[SessionState, str], None]], Session[UnitT]],
        backlog: Backlog[ItemT],
        decode: Callable[[list[UnitT], bool], Measured[ItemT]],
        *,
        look: Callable[[], None] = lambda: None,
        changed: Callable[[], None] = lambda: None,
    ) -> None:
        super().__init__(name=wire, daemon=True)
        self.wire = wire
        self.session = make_session(self._note)
        self.units = self.bytes = 0
        self._backlog, self._decode, self._look, self._changed = backlog, decode, look, changed
        self._stop_asked = threading.Event()
        self._heard_s = time.monotonic()
        self._tried = False

    def _note(self, state: SessionState, reason: str) -> None:
        del reason
        self._tried |= state in (SessionState.OPEN, SessionState.WAITING)
        self._heard_s = time.monotonic()
        self._changed()

    @property
    def was_tried(self) -> bool:
        """True if the wire was opened, or refused to be, at least once."""
        return self._tried

    @property
    def is_stopping(self) -> bool:
        """True if the thread was asked to end."""
        return self._stop_asked.is_set()

    @property
    def state(self) -> str:
        """State of the wire in the recorder's words: opening, receiving, silent, absent or closed."""
        state = self.session.state
        if state is SessionState.OPEN:
            return "receiving" if time.monotonic() - self._heard_s <= SILENT_AFTER_S else "silent"
        return {SessionState.WAITING: "absent", SessionState.OPENING: "opening"}.get(
            state, "closed" if self.is_stopping else "opening"
        )

    @property
    def counters(self) -> TransportCounters:
        """Counts of the kernel and the transport over all openings."""
        return self.session.poll_counters()

    def run(self) -> None:
        """Listen until `stop`; an error here is a defect, which the reader of the backlog gets."""
        late = False
        try:
            while not self.is_stopping:
                got = self.session.receive(WAIT_S)
                self._look()
                if not got:
                    late = False
                    continue
                self._heard_s = time.monotonic()
                found = self._decode(got, late)
                self.units += found.units
                self.bytes += found.raw_bytes
                waited_s = 0.0 if found.item is None else self._backlog.put(self.wire, found)
                late = waited_s > LATE_S or (late and found.raw_bytes >= LATE_BYTES)
        except Exception as error:
            self._backlog.fail(error)
        finally:
            self.session.close()

    def stop(self) -> None:
        """Close the wire and ask the thread to end; it does so at once, or when an opening has ended."""
        self._stop_asked.set()
        self.session.close()
