"""Makes wrapping device counters continuous."""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from swath.georef.arrays import BoolArray, Int64Array, UInt64Array
from swath.georef.timescales.gps_time import SECOND_NS

RESTART_TOLERANCE_S = 2.0  # stalls may delay host stamps by this much
RESTART_TOLERANCE_RATE = 0.01  # rate error of both clocks together
LATE_LATCH_PART = 8  # a latched value may be ahead of its reference by this part of the wrap


class CounterUnwrapper:
    """Unwraps a counter of ``bits`` bits at ``tick_hz`` by its differences, and by host time across long gaps.

    A step that disagrees with host time by more than 2 s + 1 % (or goes back) is a restart of the device: the count
    restarts from the value read, which later stages treat as a new segment of its clock. The same happens where a
    counter that wraps within 4 s appears to have wrapped unseen, because host stamps delayed by a stall look the same.
    """

    def __init__(self, bits: int, tick_hz: float) -> None:
        self.restarts = 0
        self._bits = bits
        self._tick_hz = tick_hz
        self._last_raw: np.uint64 | None = None
        self._last_host_ns = 0
        self._last = 0

    def unwrap(self, raw: UInt64Array, host_time_ns: Int64Array) -> tuple[Int64Array, BoolArray]:
        """Return continuous counts (n,) of raw values (n,) with their host times, and (n,) True where the device
        restarted.
        """
        if not len(raw):
            return np.empty(0, np.int64), np.empty(0, np.bool_)
        first = self._last_raw is None
        last_raw = raw[0] if self._last_raw is None else self._last_raw
        last_host = int(host_time_ns[0]) if first else self._last_host_ns
        steps, restart = self._steps(
            np.concatenate([[last_raw], raw]), np.diff(host_time_ns, prepend=np.int64(last_host))
        )
        restart[0] |= first
        self.restarts += int(restart.sum()) - int(first)
        counts = self._accumulate(steps, restart, raw.view(np.int64))
        self._last_raw, self._last_host_ns, self._last = raw[-1], int(host_time_ns[-1]), int(counts[-1])
        restart[0] &= not first
        return counts, restart

    def _steps(self, raw: UInt64Array, host_step_ns: Int64Array) -> tuple[Int64Array, BoolArray]:
        """Return steps between neighbours in ticks, whole wraps added by host time, and where the device restarted."""
        span_s = host_step_ns / SECOND_NS
        expected = span_s * self._tick_hz
        steps: Int64Array = (raw[1:] - raw[:-1]).view(np.int64)
        unsure = np.zeros(len(steps), np.bool_)
        if self._bits < 63:
            wrap = 1 << self._bits
            steps = steps & (wrap - 1)
            wraps = np.maximum(np.rint((expected - steps) / wrap), 0).astype(np.int64)
            steps = steps + wraps * wrap
            if wrap < 2 * RESTART_TOLERANCE_S * self._tick_hz:  # a stall may last half a wrap, which rounds up to one
                unsure = wraps > 0
        tolerance = (RESTART_TOLERANCE_S + RESTART_TOLERANCE_RATE * np.abs(span_s)) * self._tick_hz
        return steps, unsure | (steps < 0) | (np.abs(expected - steps) > tolerance)

    def _accumulate(self, steps: Int64Array, restart: BoolArray, raw: Int64Array) -> Int64Array:
        """Return running counts; each restart begins at its own raw value."""
        sums = self._last + np.cumsum(np.where(restart, 0, steps))
        where = np.flatnonzero(restart)
        shift = np.concatenate([[0], raw[where] - sums[where]])
        counts: Int64Array = sums + shift[np.cumsum(restart)]
        return counts


class GapCounter:
    """Counts the values that a counter of sent samples skips; a step of half its range or more is a restart, not a
    gap.
    """

    def __init__(self, bits: int) -> None:
        self._bits = bits
        self._last: np.uint64 | None = None

    def missing(self, raw: UInt64Array) -> int:
        """Return how many values are missing between the raw ones (n,), starting after the last one of the previous
        call.
        """
        if not len(raw):
            return 0
        before = raw[:1] if self._last is None else np.array([self._last])
        self._last = raw[-1]
        steps = np.diff(np.concatenate([before, raw])) & np.uint64((1 << self._bits) - 1)
        skipped = steps[(steps > 1) & (steps < (1 << (self._bits - 1)))]
        return int(skipped.sum()) - len(skipped)


class LatchTracker:
    """Makes the counter latched at a PPS edge continuous, on the scale of its running counter.

    A new value is placed once, when it appears, at or below the running count of that moment, and then kept, so that a
    latch without new edges does not move forward with the wraps. After a restart it is unknown until it changes.
    """

    def __init__(self, bits: int) -> None:
        self._bits = bits
        self._last_raw = np.uint64(0)
        self._last_known = False
        self._last_count = -1

    def track(self, raw: UInt64Array, known: BoolArray, counts: Int64Array, restart: BoolArray) -> Int64Array:
        """Return continuous latched counts (n,), −1 where unknown.

        Args:
            raw: (n,) latched bits.
            known: (n,) whether a latched value exists.
            counts: (n,) the running counts.
            restart: (n,) where the device restarted.
        """
        if not len(raw):
            return np.empty(0, np.int64)
        before = np.concatenate([[self._last_raw], raw[:-1]])
        before_known = np.concatenate([[self._last_known], known[:-1]])
        renewed = known & (~before_known | (raw != before))
        placed = np.where(renewed, np.maximum(latched_before(raw, self._bits, counts), -1), -1)
        news = np.maximum.accumulate(np.where(renewed | restart | ~known, np.arange(len(raw)), -1))
        latched: Int64Array = np.where(news >= 0, placed[news], self._last_count)
        self._last_raw, self._last_known, self._last_count = raw[-1], bool(known[-1]), int(latched[-1])
        return latched


def latched_before(raw: UInt64Array, bits: int, reference: Int64Array) -> Int64Array:
    """Return continuous counts of latched raw values: the nearest at or below the reference counts.

    A latch may be reported a moment before the sample that follows it, so a value ahead of its reference by less than
    an eighth of the wrap counts as ahead.

    Args:
        raw: (n,) latched values.
        bits: the counter's bits.
        reference: (n,) reference counts.
    """
    if bits >= 63:
        return raw.view(np.int64).copy()
    wrap = 1 << bits
    behind = (reference - raw.view(np.int64)) & (wrap - 1)
    behind = np.where(behind > wrap - wrap // LATE_LATCH_PART, behind - wrap, behind)
    counts: Int64Array = reference - behind
    return counts


def nanoseconds(counts: Int64Array, tick_hz: Fraction) -> Int64Array:
    """Convert counts to nanoseconds, exactly for whole and fractional rates."""
    scaled = counts * tick_hz.denominator
    whole, rest = np.divmod(scaled, tick_hz.numerator)
    result: Int64Array = whole * SECOND_NS + rest * SECOND_NS // tick_hz.numerator
    return result
