"""Keeps a transport open: the device may be absent at start, vanish and return, and the reader never sees an error.

    CLOSED --receive--> OPENING --opened--> OPEN --error--> WAITING --time over--> OPENING
                                 --refused--> WAITING

The wait doubles from 0.25 s to 5 s with every failure. It restarts at 0.25 s once the device has delivered data or
has been open for longer than the longest wait.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import fields
from enum import StrEnum
from typing import Generic, Protocol, TypeVar

from swath.drivers.transports.base import PpsSource, Transport, TransportCounters, TransportError

FIRST_WAIT_S = 0.25
LONGEST_WAIT_S = 5.0

UnitT = TypeVar("UnitT")


class Source(Protocol[UnitT]):
    """The interface that a session keeps open: a `Transport` or a `PpsSource`."""

    def open(self) -> None:
        """Open the source; raises `TransportError`."""

    def receive(self, timeout_s: float) -> list[UnitT]:
        """Wait for units and return them; raises `TransportError`."""

    def close(self) -> None:
        """Close the source; a second call does nothing."""


class SessionState(StrEnum):
    """States of a session."""

    CLOSED = "closed"
    OPENING = "opening"
    OPEN = "open"
    WAITING = "waiting"


class Session(Generic[UnitT]):
    """Receives units from one source and reopens it after every failure.

    Args:
        make_source: makes a new, unopened transport or PPS source.
        on_change: called in the receiving thread with the new state and, for WAITING, the reason.
        monotonic_s: the clock that measures the waits.
        pause: waits the given seconds or until the session is closed, whichever is first; a test may return
            at once.

    `receive` belongs to one thread; `close` and `send` may come from another.
    """

    def __init__(
        self,
        make_source: Callable[[], Source[UnitT]],
        *,
        on_change: Callable[[SessionState, str], None] | None = None,
        monotonic_s: Callable[[], float] = time.monotonic,
        pause: Callable[[float], object] | None = None,
    ) -> None:
        self._make_source = make_source
        self._on_change = on_change
        self._monotonic_s = monotonic_s
        self._stopped = threading.Event()
        self._lock = threading.Lock()  # keeps _source and _past consistent
        self._pause = pause or self._stopped.wait
        self._source: Source[UnitT] | None = None
        self._wait_s = FIRST_WAIT_S
        self._attempt_at_s = 0.0
        self._opened_at_s = 0.0
        self._past = TransportCounters()
        self.state = SessionState.CLOSED
        self.last_error = ""
        self.openings = 0

    def receive(self, timeout_s: float) -> list[UnitT]:
        """Return the units of the next ``timeout_s``, empty while the device is away. Never raises `TransportError`.

        A call that opens the device may last as long as the opening and returns without reading.
        """
        if self._stopped.is_set():
            return []
        if self.state is SessionState.OPEN:
            return self._read(timeout_s)
        left_s = self._attempt_at_s - self._monotonic_s()
        if self.state is SessionState.WAITING and left_s > 0:
            self._pause(min(left_s, timeout_s))
        else:
            self._open()
        return []

    def _open(self) -> None:
        self._change(SessionState.OPENING)
        source = self._make_source()
        try:
            source.open()
        except OSError as error:  # not `TransportError` only: another try may succeed after any of them
            self._fail(error)
            return
        with self._lock:
            if self._stopped.is_set():  # closed while it was being opened
                source.close()
                return
            self._source = source
        self._opened_at_s = self._monotonic_s()
        self.openings += 1
        self._change(SessionState.OPEN)

    def _read(self, timeout_s: float) -> list[UnitT]:
        source = self._source
        if source is None:  # closed from another thread
            return []
        try:
            units = source.receive(timeout_s)
        except TransportError as error:
            if not self._stopped.is_set():
                self._release()
                self._fail(error)
            return []
        if units:
            self._wait_s = FIRST_WAIT_S
        return units

    def _fail(self, error: OSError) -> None:
        now_s = self._monotonic_s()
        if self.state is SessionState.OPEN and now_s - self._opened_at_s > LONGEST_WAIT_S:
            self._wait_s = FIRST_WAIT_S
        self.last_error = str(error)
        self._attempt_at_s = now_s + self._wait_s
        self._wait_s = min(2 * self._wait_s, LONGEST_WAIT_S)
        self._change(SessionState.WAITING, self.last_error)

    def _release(self) -> None:
        with self._lock:
            source, self._source = self._source, None
            if source is None:
                return
            source.close()
            if isinstance(source, Transport | PpsSource):
                self._past = _sum(self._past, source.poll_counters())

    def _change(self, state: SessionState, reason: str = "") -> None:
        if self._stopped.is_set() and state is not SessionState.CLOSED:
            return
        self.state = state
        if self._on_change is not None:
            self._on_change(state, reason)

    def send(self, data: bytes) -> bool:
        """Send one unit; return False when the device is away."""
        source = self._source
        if not isinstance(source, Transport):
            return False
        try:
            source.send(data)
        except TransportError as error:
            self.last_error = str(error)
            return False
        return True

    def poll_counters(self) -> TransportCounters:
        """Return the kernel's counts over all openings; the buffer sizes are those of the present or last opening."""
        with self._lock:
            source = self._source
            if isinstance(source, Transport | PpsSource):
                return _sum(self._past, source.poll_counters())
            return self._past

    def close(self) -> None:
        """End the session; a blocked `receive` returns, and every later one returns an empty list."""
        self._stopped.set()
        self._release()
        if self.state is not SessionState.CLOSED:
            self._change(SessionState.CLOSED)


_LATEST = {"receive_buffer_bytes", "receive_buffer_asked_bytes"}


def _sum(past: TransportCounters, present: TransportCounters) -> TransportCounters:
    """Add up the counts; take the buffer sizes from ``present``."""
    total = TransportCounters()
    for item in fields(TransportCounters):
        now = getattr(present, item.name)  # a number, or a Counter, which adds up too
        setattr(total, item.name, now if item.name in _LATEST else now + getattr(past, item.name))
    return total
