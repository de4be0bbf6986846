"""Sends events, each once and at the time it happens, to the log and to the service's journal."""

from __future__ import annotations

import logging
from dataclasses import asdict, dataclass
from enum import StrEnum

from swath.daemon.log.block_queue import BlockQueue, QueueItem
from swath.daemon.log.channels import ChannelTable, JsonChannel
from swath.daemon.log.host_clock import HostClock
from swath.daemon.log.mcap.encode import EncodedBlock

log = logging.getLogger("swath")


class Severity(StrEnum):
    """The importance of an event for the flight."""

    INFO = "info"
    WARNING = "warning"
    ERROR = "error"
    CRITICAL = "critical"


_LOG_LEVEL = {
    Severity.INFO: logging.INFO,
    Severity.WARNING: logging.WARNING,
    Severity.ERROR: logging.ERROR,
    Severity.CRITICAL: logging.CRITICAL,
}


@dataclass(frozen=True, slots=True)
class Event:
    """One event, as a message of ``/events``."""

    time_ns: int
    severity: Severity
    source: str
    code: str
    text: str


class Events:
    """Takes events from every thread, logs them and passes them to the recorder."""

    def __init__(self, clock: HostClock, queue: BlockQueue, channels: ChannelTable) -> None:
        self._clock = clock
        self._queue = queue
        self._channel = JsonChannel(channels, "events", "/events", "swath.Event")
        self.channel_id = self._channel.channel_id

    def post(self, severity: Severity, source: str, code: str, text: str) -> Event:
        """Report an event; ``source`` is kind/name, or another subject of the event (``recorder``, ``disk``)."""
        event = self._note(severity, source, code, text)
        self._queue.put(QueueItem("events", self._encode(event)), always=True)
        return event

    def make(self, severity: Severity, source: str, code: str, text: str) -> EncodedBlock:
        """Return the event's block, for the writer itself, which must place it in a certain part."""
        return self._encode(self._note(severity, source, code, text))

    def _note(self, severity: Severity, source: str, code: str, text: str) -> Event:
        event = Event(self._clock.now_ns(), severity, source, code, text)
        log.log(_LOG_LEVEL[severity], "%s %s: %s", source, code, text)
        return event

    def _encode(self, event: Event) -> EncodedBlock:
        return self._channel.encode(event.time_ns, asdict(event))
