"""The aircraft's path for a stream of records: a complete trajectory, or one that grows with a device's INS."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from swath.georef.arrays import StructArray
from swath.georef.timescales import SECOND_NS
from swath.georef.trajectory.buffer import TrajectoryBuffer
from swath.georef.trajectory.trajectory import Trajectory

KEPT_BEHIND_S = 30.0  # length of a growing trajectory behind its newest epoch: longer than any return waits
SHORTEST_TRAJECTORY = 2  # epochs


class Path(Protocol):
    """The aircraft's path, as far as known."""

    @property
    def covered_until_ns(self) -> int | None:
        """GPS time up to which poses are known; None: no poses."""

    def add(self, rows: StructArray) -> None:
        """Take solutions of a device's INS, `INS_DTYPE`."""

    def update(self) -> Trajectory | None:
        """Process the input since the last call, and return the trajectory so far."""


class CompletePath:
    """A trajectory that is complete from the start."""

    covered_until_ns = int(np.iinfo(np.int64).max)

    def __init__(self, trajectory: Trajectory) -> None:
        self._trajectory = trajectory

    def add(self, rows: StructArray) -> None:
        """Ignore a device's own solution."""

    def update(self) -> Trajectory:
        """Return the complete trajectory."""
        return self._trajectory


class GrowingPath:
    """The last half minute of a trajectory that grows with the solutions of a device's INS.

    Args:
        buffer: collects them.
        deflection_rad: ξ, η if the device's attitude refers to the plumb line; None: to the ellipsoid's normal.
    """

    def __init__(self, buffer: TrajectoryBuffer, deflection_rad: tuple[float, float] | None = None) -> None:
        self._buffer = buffer
        self._deflection_rad = deflection_rad
        self._new: list[StructArray] = []
        self._forgotten_ns = 0
        self._trajectory: Trajectory | None = None

    @property
    def covered_until_ns(self) -> int | None:
        """GPS time of the newest epoch; None before there are two."""
        return None if self._trajectory is None else self._buffer.covered_until_ns

    def add(self, rows: StructArray) -> None:
        """Take solutions, in the order in which they came."""
        self._new.append(rows)

    def update(self) -> Trajectory | None:
        """Append all new solutions at once, and return the trajectory so far."""
        if not self._new:
            return self._trajectory
        self._buffer.append(np.concatenate(self._new))
        self._new.clear()
        self._forget()
        trajectory = self._buffer.snapshot()
        if len(trajectory) >= SHORTEST_TRAJECTORY:
            deflection = self._deflection_rad
            self._trajectory = trajectory if deflection is None else trajectory.with_deflection(*deflection)
        return self._trajectory

    def _forget(self) -> None:
        newest_ns = self._buffer.covered_until_ns
        behind_ns = round(KEPT_BEHIND_S * SECOND_NS)
        if newest_ns is not None and newest_ns - behind_ns > self._forgotten_ns + behind_ns // 4:
            self._forgotten_ns = newest_ns - behind_ns
            self._buffer.forget_before(self._forgotten_ns)
