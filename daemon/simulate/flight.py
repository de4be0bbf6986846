"""What `daemon` knows of a flight of the virtual aircraft: its units, its host's clock, and what befalls its wires.

`swath.sim.fly.VirtualFlight` is one; only the command imports it, so that no recorder loads what flying takes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Protocol


class VirtualUnit(Protocol):
    """A unit on its way to the recorder; of a PPS edge, without bytes."""

    @property
    def time_s(self) -> float:
        """True time at which the host stamps it, seconds since the flight's start."""

    @property
    def source(self) -> str:
        """``kind/name``, with ``/aux`` for a head's second port."""

    @property
    def data(self) -> bytes:
        """Its bytes."""


class VirtualClock(Protocol):
    """The clocks of the virtual host at a true time; nanoseconds."""

    def host_ns(self, time_s: float) -> int:
        """Return host time, the log's."""

    def monotonic_ns(self, time_s: float) -> int:
        """Return CLOCK_MONOTONIC."""

    def realtime_ns(self, time_s: float) -> int:
        """Return CLOCK_REALTIME, with the steps so far."""


class Flight(Protocol):
    """A flight, to be flown once."""

    @property
    def duration_s(self) -> float:
        """How long it lasts."""

    @property
    def sources(self) -> tuple[str, ...]:
        """Every source there is, also those that stay silent."""

    @property
    def host_clock(self) -> VirtualClock:
        """Of the virtual host."""

    @property
    def wall_steps(self) -> Sequence[tuple[float, float]]:
        """(time_s, step_s) of the wall clock."""

    @property
    def unplugged(self) -> Sequence[tuple[str, float, float]]:
        """(source, from_s, to_s): the wire is out."""

    @property
    def returns(self) -> int:
        """Laser returns in the units given so far."""

    def units(self) -> Iterator[VirtualUnit]:
        """Of all sources, in order of time."""

    def finish_truth(self) -> None:
        """Write the truth, where there is one, behind the last unit; raises OSError."""
