"""The pulses that a receiver drives, as the receiver itself knows them."""

from __future__ import annotations

import numpy as np

from swath.sim.clocks import PulsePerSecond


class Pulse:
    """The receiver's own edges; without a wired pulse it has no edges."""

    def __init__(self, edges: PulsePerSecond | None) -> None:
        self.wired = edges is not None
        self._edges = edges

    def late_s(self, second: int) -> float:
        """Return the delay of an edge after its true second; 0 without a wired pulse."""
        return float(self._edges.edges(np.array([second]))[0] - second) if self._edges is not None else 0.0
