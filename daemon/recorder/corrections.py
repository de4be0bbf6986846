"""Corrections of base stations beside their recording: counted by message, and handed on to a receiver's port.

What is recorded does not depend on it: the bytes are the writer's before they come here, and a port that takes nothing
holds up only its own thread.
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
from swath.georef.records import Chunk, Int64Array

MOST_WAITING = 64  # reads that a receiver's port has not taken yet; corrections older than that help nobody
WAIT_S = 0.2


class Relay(threading.Thread):
    """Sends what is put into it, in order, to one port; drops and counts what the port does not take in time.

    Attributes:
        forwarded_bytes: taken by the port.
        dropped_bytes: not taken: the port is away, or too slow.
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
        self._telling = threading.Lock()  # who puts counts too

    def put(self, data: bytes) -> None:
        """Never waits; the first begins the thread."""
        if self.ident is None:
            self.start()
        try:
            self._waiting.put_nowait(data)
        except queue.Full:
            self._tell(taken=False, count=len(data))

    def run(self) -> None:
        """Until told to stop; what still waits then is let go."""
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
            text = f"{self.target} takes corrections again"
            self._events.post(Severity.INFO, self._source, "forwarding_again", text)
        else:
            text = f"{self.target} does not take the corrections; they are recorded all the same"
            self._events.post(Severity.WARNING, self._source, "forwarding_failed", text)


class CorrectionsWatch:
    """What one source of corrections sends.

    `units_seen` belongs to its receive thread, `status` may come from another.
    """

    def __init__(self, source: str, parser: Parser, relay: Relay | None) -> None:
        self.relay = relay
        self._source = source
        self._parser = parser
        self._lock = threading.Lock()

    def units_seen(self, log_time_ns: Int64Array, block: UnitBlock) -> None:
        """Hand on, then count."""
        for time_ns, unit in zip(log_time_ns.tolist(), block.units, strict=True):
            data = unit.tobytes()
            if self.relay is not None:
                self.relay.put(data)
            with self._lock:
                self._parser.feed(Chunk(self._source, time_ns, data))

    def status(self) -> dict[str, Any]:
        """For the source's status: messages by number, what was damaged, what was handed on."""
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
