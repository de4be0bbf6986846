"""The status of a clock, and its events."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

MAX_EVENTS = 1000


class TimeState(StrEnum):
    """The quality of the host's clock in GPS time."""

    NO_TIME = "no_time"  # no source has given the time yet
    COARSE = "coarse"  # by messages only, to tenths of a second; or the second is not certain
    LOCKED = "locked"  # PPS edges, and their seconds are known
    HOLDOVER = "holdover"  # no edge for some seconds; sigma grows
    LOST = "lost"  # no edge for too long


class Severity(StrEnum):
    """The severity of an event, as in ``/events``."""

    INFO = "info"
    WARNING = "warning"
    ERROR = "error"


@dataclass(frozen=True, slots=True)
class ClockEvent:
    """An event for the log. host_ns is on the clock's own host scale."""

    host_ns: int
    severity: Severity
    code: str
    text: str


@dataclass(frozen=True, slots=True)
class ClockStatus:
    """A clock's status at one host time.

    Attributes:
        state, sigma_ns: see `TimeState`; of gps_from_host there, inf without time.
        offset_ns, drift_ppm: GPS − host, None without time; of the host clock, positive: fast, None without edges.
        noise_ns: sigma of the edges' stamps from the data; None without edges.
        source: the source of the seconds' names ("gnss/rover RMC"), "wall_clock", or empty.
        ambiguous: why the second is not certain; empty if it is.
        leap_seconds, leap_origin: GPS − UTC in use, and its origin (receiver, second_60, configured, table, guess);
        None: not needed yet.
        leap_doubt: why that is a guess, and the remedy; empty if it is not.
        edges_used, edges_refused, messages_refused: edges in the line; counts by reason.
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
    """Events until they are fetched; beyond a limit the oldest are dropped."""

    def __init__(self) -> None:
        self._events: list[ClockEvent] = []
        self._said: set[str] = set()

    def add(self, host_ns: int, severity: Severity, code: str, text: str) -> None:
        """Keep an event."""
        self._events.append(ClockEvent(host_ns, severity, code, text))
        del self._events[:-MAX_EVENTS]

    def add_once(self, host_ns: int, code: str, text: str) -> None:
        """Keep a warning of a kind that is given only once per session."""
        if code not in self._said:
            self._said.add(code)
            self.add(host_ns, Severity.WARNING, code, text)

    def drain(self) -> list[ClockEvent]:
        """Return the events since the last call."""
        events, self._events = self._events, []
        return events
