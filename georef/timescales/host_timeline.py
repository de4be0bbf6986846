"""Convert host time (CLOCK_MONOTONIC plus the session's constant) to CLOCK_MONOTONIC_RAW and back.

MONOTONIC is slewed by NTP and RAW is not; a clock model must run in RAW (LOG_FORMAT, Time stamps).
"""

from __future__ import annotations

from collections import deque

import numpy as np

from swath.georef.arrays import FloatArray, Int64Array

MAX_SLEW = 1e-3  # of MONOTONIC against RAW: adjtimex allows 500 ppm on each side
READ_TOLERANCE_NS = 5_000  # the two clocks are not read at one instant
REFUSALS_IN_A_ROW = 3  # after this many the new offset is accepted
SLOPE_SPAN_NS = 2_000_000_000  # the pairs of this last span give the slope for extrapolation


class HostTimeline:
    """Piecewise-linear map between host time and RAW, fed by the readings of ``/clock``.

    Without any reading RAW is taken as MONOTONIC. A reading torn by preemption is refused and counted.
    """

    def __init__(self, host_minus_monotonic_ns: int = 0, *, keep_history: bool = False) -> None:
        """Prepare a timeline; host_minus_monotonic_ns: realtime_ns − monotonic_ns of ``swath.session``.

        Without keep_history, for live use, it remembers 10 minutes.
        """
        self.host_minus_monotonic_ns = host_minus_monotonic_ns
        self.refused = 0
        self._refused_in_a_row = 0
        self._host: deque[int] = deque(maxlen=None if keep_history else 6000)
        self._offset: deque[int] = deque(maxlen=None if keep_history else 6000)  # RAW − host
        self._slope = 0.0
        self._slope_from: deque[tuple[int, int]] = deque()
        self._arrays: tuple[Int64Array, FloatArray, int] | None = None

    def add(self, realtime_ns: int, monotonic_ns: int, monotonic_raw_ns: int) -> None:
        """Take one reading of the three clocks; realtime_ns is ignored, so that a stepped wall clock has no effect."""
        del realtime_ns
        host = monotonic_ns + self.host_minus_monotonic_ns
        offset = monotonic_raw_ns - host
        if self._host and not self._plausible(host, offset):
            return
        self._refused_in_a_row = 0
        self._host.append(host)
        self._offset.append(offset)
        self._arrays = None
        recent = self._slope_from
        recent.append((host, offset))
        while len(recent) > 2 and host - recent[0][0] > SLOPE_SPAN_NS:
            recent.popleft()
        self._slope = (offset - recent[0][1]) / (host - recent[0][0]) if len(recent) > 1 else 0.0

    def _plausible(self, host: int, offset: int) -> bool:
        """Return whether a reading continues the last one; count it if not."""
        elapsed = host - self._host[-1]
        if elapsed <= 0:
            self.refused += 1
            return False
        if abs(offset - self._offset[-1]) <= READ_TOLERANCE_NS + MAX_SLEW * elapsed:
            return True
        self.refused += 1
        self._refused_in_a_row += 1
        if self._refused_in_a_row < REFUSALS_IN_A_ROW:
            return False
        self._slope_from.clear()
        return True

    def raw_at(self, host_ns: int) -> int:
        """Return RAW of one host time, for live use (usually at or after the last reading)."""
        if not self._host:
            return host_ns - self.host_minus_monotonic_ns
        last = self._host[-1]
        if host_ns >= last:
            return host_ns + self._offset[-1] + round(self._slope * (host_ns - last))
        return int(self.raw_from_host(np.array([host_ns], dtype=np.int64))[0])

    def raw_from_host(self, host_ns: Int64Array) -> Int64Array:
        """Return RAW (n,) of host times (n,)."""
        host = np.asarray(host_ns, dtype=np.int64)
        if not self._host:
            return host - self.host_minus_monotonic_ns
        return host + self._interpolate(host)

    def _interpolate(self, times: Int64Array) -> Int64Array:
        """Return RAW − host at host times, with the last slope beyond the last reading."""
        if self._arrays is None:
            first = self._offset[0]
            self._arrays = (
                np.array(self._host, dtype=np.int64),
                np.array([offset - first for offset in self._offset], dtype=np.float64),
                first,
            )
        knots, relative, first = self._arrays
        elapsed = (times - knots[0]).astype(np.float64)
        offsets = np.interp(elapsed, (knots - knots[0]).astype(np.float64), relative)
        beyond = np.maximum(times - knots[-1], 0).astype(np.float64)
        rounded: Int64Array = np.rint(offsets + self._slope * beyond).astype(np.int64)
        return rounded + first
