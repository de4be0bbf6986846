"""Runs a simulated clock through PpsClock second by second, and compares its claims with the truth."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from swath.georef.timescales import PpsClock, TimeState
from tests.georef.clock_simulation import HOST_START_NS, NS, Simulation

SURE = (TimeState.LOCKED, TimeState.HOLDOVER)


@dataclass
class Outcome:
    """The result of a run: states by second, and errors (ns) with their sigmas where LOCKED or HOLDOVER."""

    clock: PpsClock
    states: list[TimeState] = field(default_factory=list)
    wrong_seconds: int = 0
    seconds: list[int] = field(default_factory=list)
    errors_ns: list[float] = field(default_factory=list)
    sigmas_ns: list[float] = field(default_factory=list)
    ahead_errors_ns: list[float] = field(default_factory=list)
    ahead_sigmas_ns: list[float] = field(default_factory=list)
    events: list[tuple[int, str, str]] = field(default_factory=list)

    @property
    def codes(self) -> list[str]:
        """Codes of the events, in order."""
        return [code for _, code, _ in self.events]

    def counts(self, start: int = 0, stop: int | None = None) -> Counter[TimeState]:
        """Return how often each state was seen between two seconds."""
        return Counter(self.states[start:stop])


def run(
    simulation: Simulation,
    clock: PpsClock,
    *,
    ahead_s: float = 0.0,
    each_second: Callable[[int, int], None] | None = None,
) -> Outcome:
    """Feed the clock; ask it in the middle of every second, and for ahead_s later as if no edge came any more."""
    outcome = Outcome(clock)
    second = 0
    for host_ns, kind, source, message in simulation:
        while simulation.host_ns(second + 0.5) <= host_ns:
            _ask(simulation, clock, outcome, second, ahead_s)
            if each_second is not None:
                each_second(second, simulation.host_ns(second + 0.5))
            second += 1
        if kind == "edge":
            clock.add_edge(host_ns, 0)
        elif message is not None:
            clock.add_message(source, message)
        for event in clock.drain_events():
            outcome.events.append(((event.host_ns - HOST_START_NS) // NS, event.code, event.text))
    return outcome


def _ask(simulation: Simulation, clock: PpsClock, outcome: Outcome, second: int, ahead_s: float) -> None:
    host_ns = simulation.host_ns(second + 0.5)
    status = clock.status(host_ns)
    outcome.states.append(status.state)
    if status.state not in SURE or status.offset_ns is None:
        return
    error = host_ns + status.offset_ns - simulation.true_gps_ns(host_ns)
    outcome.wrong_seconds += abs(error) > NS // 2
    outcome.seconds.append(second)
    outcome.errors_ns.append(error)
    outcome.sigmas_ns.append(status.sigma_ns)
    if ahead_s and second + 1 + ahead_s < simulation.seconds:
        later_ns = simulation.host_ns(second + 0.5 + ahead_s)
        later = clock.status(later_ns)
        assert later.offset_ns is not None
        outcome.ahead_errors_ns.append(later_ns + later.offset_ns - simulation.true_gps_ns(later_ns))
        outcome.ahead_sigmas_ns.append(later.sigma_ns)


def rms(values: list[float] | np.ndarray) -> float:
    """Return the root mean square of values."""
    return float(np.sqrt(np.mean(np.square(np.asarray(values, dtype=np.float64)))))
