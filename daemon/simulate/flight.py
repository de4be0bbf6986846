"""Defines what `daemon` needs of a flight of the virtual aircraft: its units, its host's clock, the faults of its
wires.

`swath.sim.fly.VirtualFlight` implements it; only the command imports that class, so that no recorder loads the modules
for flying.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Protocol


class VirtualUnit(Protocol):
    """A unit on its way to the recorder; a PPS edge has no bytes."""

    @property
    def time_s(self) -> float:
        """True time at which the host stamps it, seconds since the flight's start."""

    @property
    def source(self) -> str:
        """``kind/name``, with ``/aux`` for a head's second port."""

    @property
    def data(self) -> bytes:
        """Bytes of the unit."""


class VirtualClock(Protocol):
    """The clocks of the virtual host at a true time; nanoseconds."""

    def host_ns(self, time_s: float) -> int:
        """Return the host time, which is the log's."""

    def monotonic_ns(self, time_s: float) -> int:
        """Return the time of CLOCK_MONOTONIC."""

    def realtime_ns(self, time_s: float) -> int:
        """Return the time of CLOCK_REALTIME, including the steps so far."""


class Flight(Protocol):
    """A flight of the virtual aircraft, which can be flown once."""

    @property
    def duration_s(self) -> float:
        """Duration of the flight in seconds."""

    @property
    def sources(self) -> tuple[str, ...]:
        """All sources, including those that stay silent."""

    @property
    def host_clock(self) -> VirtualClock:
        """Clock of the virtual host."""

    @property
    def wall_steps(self) -> Sequence[tuple[float, float]]:
        """Steps of the wall clock as (time_s, step_s)."""

    @property
    def unplugged(self) -> Sequence[tuple[str, float, float]]:
        """Intervals in which a wire is unplugged, as (source, from_s, to_s)."""

    @property
    def returns(self) -> int:
        """Number of laser returns in the units given so far."""

    def units(self) -> Iterator[VirtualUnit]:
        """Yield the units of all sources, in order of time."""

    def finish_truth(self) -> None:
        """Write the end of the truth file, if there is one, after the last unit; raises OSError."""
