"""Time without edges: from the arrival of messages, or from the wall clock. It is good to tenths of a second."""

from __future__ import annotations

from collections import deque

from swath.georef.timescales.gps_time import SECOND_NS

MEMORY_S = 60
TYPICAL_DELAY_NS = 250_000_000  # prior: messages come 5 ms to 0.9 s after their second
COARSE_SIGMA_NS = 300_000_000.0
AMBIGUOUS_SIGMA_NS = 1e9
RATE_SPAN_NS = 20 * SECOND_NS  # messages over this span must advance with the host's clock
SETTLED_SPAN_NS = 5 * SECOND_NS  # minimum span for determining the messages' rate
RATE_SPREAD_NS = 2 * SECOND_NS  # delays vary by less than this, stalls included
RATE_MESSAGES = 4
STEADY_READINGS = 3
STEADY_SPAN_NS = 3 * SECOND_NS
WALL_STEP_NS = 50_000_000  # a change of wall − host beyond this (and 500 ppm) restarts the wall clock's probation
WALL_MAX_AGE_NS = 120 * SECOND_NS
WALL_DECIDES_SIGMA_S = 0.1


class CoarseClock:
    """GPS − host from the least delayed of the last minute's messages."""

    def __init__(self) -> None:
        self._offsets: deque[tuple[int, int]] = deque(maxlen=256)  # host ns, named second − arrival
        self.last_host_ns: int | None = None

    def add(self, host_ns: int, gps_ns: int) -> None:
        """Take a message that arrived at host_ns and named the second gps_ns as just passed."""
        self._offsets.append((host_ns, gps_ns - host_ns))
        self.last_host_ns = host_ns
        while host_ns - self._offsets[0][0] > MEMORY_S * SECOND_NS:
            self._offsets.popleft()

    def shift(self, seconds: int) -> None:
        """Shift all seconds named so far, after a correction of the leap count."""
        self._offsets = deque(((host, offset + seconds * SECOND_NS) for host, offset in self._offsets), maxlen=256)

    def settled(self) -> bool:
        """Return whether messages have come for long enough, and advance with the host's clock."""
        if not self._offsets or self._offsets[-1][0] - self._offsets[0][0] < SETTLED_SPAN_NS:
            return False
        return not self.runs_at_another_rate()

    def runs_at_another_rate(self) -> bool:
        """Return whether the last 20 s' messages drift from the host by more than delays can, outliers left out.

        The outermost message on either side is the outlier.
        """
        if not self._offsets:
            return False
        newest_ns = self._offsets[-1][0]
        recent = sorted(offset for host_ns, offset in self._offsets if newest_ns - host_ns <= RATE_SPAN_NS)
        return len(recent) >= RATE_MESSAGES and recent[-2] - recent[1] > RATE_SPREAD_NS

    def offset_ns(self) -> int | None:
        """Return GPS − host: the least delayed of those near the median, less a typical delay."""
        if not self._offsets or self.runs_at_another_rate():
            return None
        ordered = sorted(offset for _, offset in self._offsets)
        median = ordered[len(ordered) // 2]
        return max(offset for offset in ordered if offset - median <= 2 * SECOND_NS) + TYPICAL_DELAY_NS


class WallClock:
    """The host's wall clock against its continuous clock, and whether it is disciplined."""

    def __init__(self) -> None:
        self._host_ns = 0
        self._offset_ns: int | None = None
        self._sigma_s = 0.0
        self._disciplined = False
        self._steady_since_ns = 0
        self._steady = 0

    def set(self, host_ns: int, realtime_ns: int, disciplined: bool, sigma_s: float) -> None:
        """Take one reading; a step, or a reading without discipline, restarts the clock's probation."""
        offset = realtime_ns - host_ns
        previous = self._offset_ns
        allowed = WALL_STEP_NS + abs(host_ns - self._host_ns) // 2000
        if previous is None or not disciplined or abs(offset - previous) > allowed:
            self._steady, self._steady_since_ns = 0, host_ns
        self._steady += 1
        self._host_ns, self._offset_ns, self._disciplined, self._sigma_s = host_ns, offset, disciplined, sigma_s

    def on_probation(self, host_ns: int) -> bool:
        """Return whether the clock is disciplined and recent, but not yet observed for long enough to decide."""
        recent = self._disciplined and abs(host_ns - self._host_ns) <= WALL_MAX_AGE_NS
        return recent and self._sigma_s <= WALL_DECIDES_SIGMA_S and self.utc_offset_ns(host_ns) is None

    def utc_offset_ns(self, host_ns: int) -> int | None:
        """Return wall − host if it may decide between seconds, else None.

        For that it is disciplined, steady, recent, and has a sigma ≤ 0.1 s.
        """
        if self._offset_ns is None or not self._disciplined or self._sigma_s > WALL_DECIDES_SIGMA_S:
            return None
        if self._steady < STEADY_READINGS or self._host_ns - self._steady_since_ns < STEADY_SPAN_NS:
            return None
        return self._offset_ns if abs(host_ns - self._host_ns) <= WALL_MAX_AGE_NS else None

    @property
    def sigma_ns(self) -> float:
        """The sigma of the last reading."""
        return self._sigma_s * SECOND_NS
