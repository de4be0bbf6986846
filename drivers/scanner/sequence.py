"""Follows datagrams by a counter or by their stamps (gaps, late and repeated ones), and thins out clock samples.

All give the same result however the datagrams are cut into batches.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from swath.georef.arrays import BoolArray, FloatArray, Int64Array

_U32 = 1 << 32
LATE_DATAGRAMS = 64  # the network delays a datagram by at most so many places; a larger step back is a restart
LATE_NS = 1_000_000_000
LATE_PACKETS = 16  # the network delays a packet by at most so many places; a larger step back is a clock change


@dataclass(frozen=True, slots=True)
class _Last:
    sequence: int
    unwrapped: int
    first_time_ns: int
    pps_count: int
    host_time_ns: int


class SequenceTracker:
    """Unwraps a datagram counter and distinguishes gaps from restarts.

    Counted in ``errors``: ``sequence_gap`` (datagrams missing), ``out_of_order`` (datagrams that came late, each
    counted as missing before), ``duplicate``, ``restart`` (pps_count fell, or first_ticks went back: a new clock
    segment, after which the numbering continues without a gap).

    Args:
        errors: the parser's ``counters.errors``.
        modulus: number of values of the counter before it wraps.
        largest_gap: a longer step counts as a restart; None: a step of half the modulus or more counts as out of order.
    """

    def __init__(self, errors: Counter[str], modulus: int = _U32, largest_gap: int | None = None) -> None:
        self._errors = errors
        self._modulus = modulus
        self._largest_gap = largest_gap
        self._last: _Last | None = None
        self._missing: set[int] = set()  # unwrapped numbers just behind the newest that are missing

    def restart(self, sequence: int, first_time_ns: int) -> None:
        """Note that the device reported a restart: the datagram with this counter will follow without a gap."""
        if self._last is not None:
            self._errors["restart"] += 1
            before = (sequence - 1) % self._modulus
            self._remember(before, self._last.unwrapped, first_time_ns, 0, self._last.host_time_ns)

    def follow(
        self,
        sequence: NDArray[np.integer],
        first_time_ns: Int64Array,
        pps_count: NDArray[np.integer],
        host_time_ns: Int64Array,
    ) -> tuple[Int64Array, BoolArray]:
        """Take consecutive datagrams, all arrays (n,).

        Args:
            sequence: the datagrams' numbers.
            first_time_ns: device time of their first pulse.
            pps_count: number of their latest edge.
            host_time_ns: host time of their arrival.

        Returns:
            unwrapped: (n,) int64, the counter without wraps, never used twice.
            fresh: (n,) bool, False for a datagram that has come before.
        """
        if self._last is None and len(sequence):
            self._missing = set(range(int(sequence[0]) - LATE_DATAGRAMS, int(sequence[0])))
        if self._regular(sequence, first_time_ns, pps_count):
            start = 0 if self._last is None else self._last.unwrapped + 1
            offset = int(sequence[0]) if self._last is None else start
            unwrapped = offset + np.arange(len(sequence), dtype=np.int64)
            ends = (array[-1] for array in (sequence, unwrapped, first_time_ns, pps_count, host_time_ns))
            self._remember(*(int(end) for end in ends))
            return unwrapped, np.ones(len(sequence), dtype=np.bool_)
        columns = (array.tolist() for array in (sequence, first_time_ns, pps_count, host_time_ns))
        steps = [self._step(*row) for row in zip(*columns, strict=True)]
        return np.array([at for at, _ in steps], dtype=np.int64), np.array([new for _, new in steps], dtype=np.bool_)

    def _regular(
        self, sequence: NDArray[np.integer], first_time_ns: Int64Array, pps_count: NDArray[np.integer]
    ) -> bool:
        """Return whether every datagram directly follows the one before."""
        last = self._last
        if last is not None and (
            int(sequence[0]) != (last.sequence + 1) % self._modulus
            or int(first_time_ns[0]) < last.first_time_ns
            or int(pps_count[0]) < last.pps_count
        ):
            return False
        return bool(
            (np.diff(sequence) == 1).all()
            and (first_time_ns[1:] >= first_time_ns[:-1]).all()
            and (pps_count[1:] >= pps_count[:-1]).all()
        )

    def _step(self, sequence: int, first_time_ns: int, pps_count: int, host_time_ns: int) -> tuple[int, bool]:
        """Take one datagram; return its unwrapped number and whether it is new."""
        last = self._last
        if last is None:
            return self._remember(sequence, sequence, first_time_ns, pps_count, host_time_ns), True
        ahead = (sequence - last.sequence - 1) % self._modulus
        behind = self._modulus - 1 - ahead
        if behind == 0 and first_time_ns == last.first_time_ns:
            self._errors["duplicate"] += 1
            return last.unwrapped, False
        if (
            0 < behind <= LATE_DATAGRAMS
            and 0 < last.first_time_ns - first_time_ns < LATE_NS
            and host_time_ns - last.host_time_ns < LATE_NS  # else the head was restarted early
        ):
            return self._late(last.unwrapped - behind)
        set_anew = self._largest_gap is not None and ahead > self._largest_gap
        if pps_count < last.pps_count or first_time_ns < last.first_time_ns or set_anew:
            self._errors["restart"] += 1
            ahead = 0
        elif ahead >= self._modulus // 2:
            self._errors["out_of_order"] += 1
            ahead = 0
        elif ahead:
            self._errors["sequence_gap"] += ahead
        newest = last.unwrapped + 1 + ahead
        oldest = newest - LATE_DATAGRAMS
        self._missing = {at for at in self._missing if at >= oldest}
        self._missing.update(range(max(last.unwrapped + 1, oldest), newest))
        return self._remember(sequence, newest, first_time_ns, pps_count, host_time_ns), True

    def _late(self, at: int) -> tuple[int, bool]:
        """Classify a datagram behind the newest as late or as a duplicate; return its number and whether it is new."""
        if at not in self._missing:
            self._errors["duplicate"] += 1
            return at, False
        self._missing.discard(at)
        self._errors["out_of_order"] += 1
        return at, True

    def _remember(self, sequence: int, unwrapped: int, first_time_ns: int, pps_count: int, host_time_ns: int) -> int:
        self._last = _Last(sequence, unwrapped, first_time_ns, pps_count, host_time_ns)
        return unwrapped


class SampleThinner:
    """Chooses the first unit of each bin of host time, which is enough for a clock model of thousands of units a
    second.

    Args:
        bin_ns: width of a bin.
    """

    def __init__(self, bin_ns: int = 50_000_000) -> None:
        self._bin_ns = bin_ns
        self._last_bin: int | None = None

    def choose(self, host_time_ns: Int64Array) -> BoolArray:
        """Return (n,) bool, True where a unit lies in another bin than the unit before it."""
        bins = host_time_ns // self._bin_ns
        chosen = np.ones(len(bins), dtype=np.bool_)
        chosen[1:] = bins[1:] != bins[:-1]
        if len(bins):
            chosen[0] = bins[0] != self._last_bin
            self._last_bin = int(bins[-1])
        return chosen


class StampTracker:
    """Follows the stamps of packets and counts missing, late and repeated ones.

    Counted in ``errors``: ``cadence_gap`` (packets missing), ``out_of_order`` (packets that came late, each counted as
    missing before), ``duplicate``, ``stamp_jump`` (the clock was set: no gap).

    The result is the same however the packets are cut into batches.

    Args:
        errors: the parser's ``counters.errors``.
        wrap: value at which the stamps wrap, in the unit of all times here.
        max_silence: a longer step means that the clock was set, not that packets were lost.
    """

    def __init__(self, errors: Counter[str], wrap: int, max_silence: int) -> None:
        self._errors = errors
        self._wrap = wrap
        self._max_silence = max_silence
        self._newest: int | None = None
        self._recent: deque[int] = deque(maxlen=LATE_PACKETS + 1)

    def follow(self, stamps: Int64Array, nominal: FloatArray) -> BoolArray:
        """Take packets (n,) and the time that each spans; return (n,) False for a packet that has come before."""
        if not len(stamps):
            return np.zeros(0, dtype=np.bool_)
        before = np.concatenate([[stamps[0] if self._newest is None else self._newest], stamps[:-1]])
        step = (stamps - before) % self._wrap
        if self._newest is None:
            step[0] = round(nominal[0])
        if not ((step > 0) & (step <= self._max_silence)).all():
            pairs = zip(stamps.tolist(), nominal.tolist(), strict=True)
            return np.array([self._step(stamp, nominal) for stamp, nominal in pairs], dtype=np.bool_)
        self._count("cadence_gap", int(np.maximum(np.rint(step / nominal).astype(np.int64) - 1, 0).sum()))
        self._newest = int(stamps[-1])
        self._recent.extend(stamps[-LATE_PACKETS - 1 :].tolist())
        return np.ones(len(stamps), dtype=np.bool_)

    def _step(self, stamp: int, nominal: float) -> bool:
        """Take one packet; return whether it is new."""
        if stamp in self._recent:
            self._errors["duplicate"] += 1
            return False
        newest = self._newest
        self._recent.append(stamp)
        if newest is not None:
            step = (stamp - newest) % self._wrap
            if self._wrap - step <= LATE_PACKETS * nominal:
                self._errors["out_of_order"] += 1
                return True
            if step > self._max_silence:
                self._errors["stamp_jump"] += 1
                self._recent = deque([stamp], LATE_PACKETS + 1)
            else:
                self._count("cadence_gap", max(0, round(step / nominal) - 1))
        self._newest = stamp
        return True

    def _count(self, code: str, count: int) -> None:
        if count:
            self._errors[code] += count
