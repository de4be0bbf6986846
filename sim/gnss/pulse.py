"""What a receiver knows of the pulses it drives."""

from __future__ import annotations

import numpy as np

from swath.sim.clocks import PulsePerSecond


class Pulse:
    """Its own edges; none where no pulse is wired."""

    def __init__(self, edges: PulsePerSecond | None) -> None:
        self.wired = edges is not None
        self._edges = edges

    def late_s(self, second: int) -> float:
        """By how much an edge comes after its true second."""
        return float(self._edges.edges(np.array([second]))[0] - second) if self._edges is not None else 0.0
