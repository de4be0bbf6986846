"""What a wire or controller says of its own trouble: told when it begins, counted all the time.

None of it is a loss of units: error frames are units themselves, and what a line garbled is recorded as it came.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from swath.daemon.log.events import Events, Severity
from swath.drivers.transports.base import TransportCounters

TOLD_AGAIN_S = 30.0  # trouble that goes on is told so often, with what came meanwhile


@dataclass(frozen=True, slots=True)
class _Kind:
    """One of the counters of a transport, and how its growth is told."""

    counter: str
    severity: Severity
    code: str
    text: str


_KINDS = (
    _Kind("bus_off", Severity.ERROR, "can_bus_off", "times the controller went off the bus; frames are missing since"),
    _Kind(
        "error_frames",
        Severity.WARNING,
        "can_errors",
        "error frames, recorded as such; look at cabling, termination and bit rate",
    ),
    _Kind(
        "line_errors",
        Severity.WARNING,
        "line_errors",
        "framing, parity or overrun errors of the line; is the baud rate right?",
    ),
    _Kind(
        "refused", Severity.WARNING, "units_refused", "units refused: of another sender, or nothing that can be read"
    ),
)


class WireTrouble:
    """Follows the counters of one wire.

    Args:
        source: whose events these are.
        events: where they go.
        monotonic_s: the clock that says when going trouble is told again.
    """

    def __init__(self, source: str, events: Events, monotonic_s: Callable[[], float] = time.monotonic) -> None:
        self._source = source
        self._events = events
        self._monotonic_s = monotonic_s
        self._told: dict[str, int] = {}
        self._told_s: dict[str, float] = {}

    def look(self, counters: TransportCounters) -> dict[str, int]:
        """Tell what has grown; the counters that are not zero."""
        counts: dict[str, int] = {}
        for kind in _KINDS:
            count: int = getattr(counters, kind.counter)
            if count:
                counts[kind.counter] = count
                self._tell(kind, count)
        return counts

    def _tell(self, kind: _Kind, count: int) -> None:
        now_s = self._monotonic_s()
        grown = count - self._told.get(kind.counter, 0)
        if grown > 0 and now_s - self._told_s.get(kind.counter, -TOLD_AGAIN_S) >= TOLD_AGAIN_S:
            self._told[kind.counter], self._told_s[kind.counter] = count, now_s
            self._events.post(kind.severity, self._source, kind.code, f"{grown} {kind.text}")
