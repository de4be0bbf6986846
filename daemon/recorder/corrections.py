"""Handles corrections of base stations besides their recording: counts messages and forwards them to a receiver's port.

The recording does not depend on it: the writer has the bytes before they arrive here, and a blocked port delays only
its own thread.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from typing import Any

from swath.daemon.log.events import Events, Severity
from swath.daemon.system import name_thread
from swath.drivers.parser import Parser
from swath.drivers.transports.base import UnitBlock
from swath.georef.arrays import Int64Array
from swath.georef.records import Chunk

MOST_WAITING = 64  # reads that a receiver's port has not taken yet; older corrections are useless
WAIT_S = 0.2


class Relay(threading.Thread):
    """Sends data to one port in order; drops and counts the data that the port does not take in time.

    Attributes:
        forwarded_bytes: taken by the port.
        dropped_bytes: not taken, because the port is missing or too slow.
    """

    def __init__(
        self, source: str, target: str, send: Callable[[bytes], bool], events: Events, stop: threading.Event
    ) -> None:
        super().__init__(name=f"{source} on", daemon=True)
        self.forwarded_bytes = self.dropped_bytes = 0
        self.target = target
        self._source = source
        self._send = send
        self._events = events
        self._waiting: queue.Queue[bytes] = queue.Queue(MOST_WAITING)
        self._ending = stop
        self._refused = False
        self._telling = threading.Lock()  # callers of `put` count too

    def put(self, data: bytes) -> None:
        """Queue data without waiting; the first call starts the thread."""
        if self.ident is None:
            self.start()
        try:
            self._waiting.put_nowait(data)
        except queue.Full:
            self._tell(taken=False, count=len(data))

    def run(self) -> None:
        """Forward data until the stop event; data that still waits then is dropped."""
        name_thread(self.name)
        while not self._ending.is_set():
            try:
                data = self._waiting.get(timeout=WAIT_S)
            except queue.Empty:
                continue
            self._tell(taken=self._send(data), count=len(data))

    def _tell(self, *, taken: bool, count: int) -> None:
        with self._telling:
            if taken:
                self.forwarded_bytes += count
            else:
                self.dropped_bytes += count
            if taken == self._refused:
                self._refused = not taken
                self._post(taken=taken)

    def _post(self, *, taken: bool) -> None:
        if taken:
            text = f"{self.target} accepts corrections again"
            self._events.post(Severity.INFO, self._source, "forwarding_again", text)
        else:
            text = f"{self.target} does not accept corrections; they are still recorded"
            self._events.post(Severity.WARNING, self._source, "forwarding_failed", text)


class CorrectionsWatch:
    """Watches one source of corrections.

    `units_seen` is called by its receive thread, `status` may be called by another.
    """

    def __init__(self, source: str, parser: Parser, relay: Relay | None) -> None:
        self.relay = relay
        self._source = source
        self._parser = parser
        self._lock = threading.Lock()

    def units_seen(self, log_time_ns: Int64Array, block: UnitBlock) -> None:
        """Forward the units, then count them."""
        for time_ns, unit in zip(log_time_ns.tolist(), block.units, strict=True):
            data = unit.tobytes()
            if self.relay is not None:
                self.relay.put(data)
            with self._lock:
                self._parser.feed(Chunk(self._source, time_ns, data))

    def status(self) -> dict[str, Any]:
        """Return status entries: messages by number, damaged data, and forwarded and dropped bytes."""
        with self._lock:
            counters = self._parser.counters
            found: dict[str, Any] = {
                "messages": dict(sorted(counters.messages.items())),
                "bad_checksums": counters.bad_checksums,
                "bytes_skipped": counters.bytes_skipped,
            }
        if self.relay is not None:
            found["forwarded_bytes"] = self.relay.forwarded_bytes
            found["forward_dropped_bytes"] = self.relay.dropped_bytes
        return found
