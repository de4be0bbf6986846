"""What a clock says about itself."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

MAX_EVENTS = 1000


class TimeState(StrEnum):
    """How well the host's clock is known in GPS time."""

    NO_TIME = "no_time"  # nothing has said the time yet
    COARSE = "coarse"  # by messages only, some tenths of a second; or which second is not certain
    LOCKED = "locked"  # PPS edges, and their seconds are known
    HOLDOVER = "holdover"  # no edge for some seconds; sigma grows
    LOST = "lost"  # too long without


class Severity(StrEnum):
    """Of an event, as in ``/events``."""

    INFO = "info"
    WARNING = "warning"
    ERROR = "error"


@dataclass(frozen=True, slots=True)
class ClockEvent:
    """Something the log should keep. host_ns is on the clock's own host scale."""

    host_ns: int
    severity: Severity
    code: str
    text: str


@dataclass(frozen=True, slots=True)
class ClockStatus:
    """A clock at one host time.

    Attributes:
        state: see `TimeState`. sigma_ns: of gps_from_host there; inf without time.
        offset_ns: GPS − host; None without time. drift_ppm: of the host clock, positive: fast; None without edges.
        noise_ns: sigma of the edges' stamps as the data show it; None without edges.
        source: who names the seconds ("gnss/rover RMC"), "wall_clock", or empty.
        ambiguous: why the second is not certain; empty where it is.
        leap_seconds, leap_origin: GPS − UTC in use, and who said so (receiver, second_60, configured, table, guess);
            None: not needed yet. leap_doubt: why that is a guess, and the remedy; empty where it is none.
        edges_used: edges in the line. edges_refused, messages_refused: counts by reason.
    """

    state: TimeState
    sigma_ns: float
    offset_ns: int | None = None
    drift_ppm: float | None = None
    noise_ns: float | None = None
    source: str = ""
    ambiguous: str = ""
    leap_seconds: int | None = None
    leap_origin: str = ""
    leap_doubt: str = ""
    edges_used: int = 0
    edges_refused: dict[str, int] = field(default_factory=dict)
    messages_refused: dict[str, int] = field(default_factory=dict)


class EventLog:
    """Events until they are fetched; the oldest go when nobody does."""

    def __init__(self) -> None:
        self._events: list[ClockEvent] = []
        self._said: set[str] = set()

    def add(self, host_ns: int, severity: Severity, code: str, text: str) -> None:
        """Keep an event."""
        self._events.append(ClockEvent(host_ns, severity, code, text))
        del self._events[:-MAX_EVENTS]

    def add_once(self, host_ns: int, code: str, text: str) -> None:
        """Keep a warning of a kind that is worth saying once a session."""
        if code not in self._said:
            self._said.add(code)
            self.add(host_ns, Severity.WARNING, code, text)

    def drain(self) -> list[ClockEvent]:
        """Return the events since the last call."""
        events, self._events = self._events, []
        return events
