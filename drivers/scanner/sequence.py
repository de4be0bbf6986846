"""Follows a datagram counter: gaps, late and repeated datagrams, restarts; and thins clock samples out.

Both give the same answer however the datagrams are cut into batches.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from georef.records import Int64Array

BoolArray = NDArray[np.bool_]

_U32 = 1 << 32
LATE_DATAGRAMS = 64  # a datagram at most this far behind its place was delayed by the network; further: a restart
LATE_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class _Last:
    sequence: int
    unwrapped: int
    first_time_ns: int
    pps_count: int


class SequenceTracker:
    """Unwraps a u32 datagram counter and tells gaps from restarts.

    Counted in ``errors``: ``sequence_gap`` (datagrams missing), ``out_of_order`` (datagrams that came late, each
    counted as missing before), ``duplicate``, ``restart`` (pps_count fell, or first_ticks went back: a new clock
    segment, after which the numbering goes on without a gap).

    Args:
        errors: the parser's ``counters.errors``.
    """

    def __init__(self, errors: Counter[str]) -> None:
        self._errors = errors
        self._last: _Last | None = None
        self._missing: set[int] = set()  # unwrapped numbers just behind the newest that have not come

    def follow(
        self, sequence: NDArray[np.uint32], first_time_ns: Int64Array, pps_count: NDArray[np.uint32]
    ) -> tuple[Int64Array, BoolArray]:
        """Take consecutive datagrams, all arrays (n,); ``first_time_ns`` is the device time of their first pulse.

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
            self._remember(int(sequence[-1]), int(unwrapped[-1]), int(first_time_ns[-1]), int(pps_count[-1]))
            return unwrapped, np.ones(len(sequence), dtype=np.bool_)
        steps = [
            self._step(*row) for row in zip(sequence.tolist(), first_time_ns.tolist(), pps_count.tolist(), strict=True)
        ]
        return np.array([at for at, _ in steps], dtype=np.int64), np.array([new for _, new in steps], dtype=np.bool_)

    def _regular(self, sequence: NDArray[np.uint32], first_time_ns: Int64Array, pps_count: NDArray[np.uint32]) -> bool:
        """Whether every datagram simply follows the one before."""
        last = self._last
        if last is not None and (
            int(sequence[0]) != (last.sequence + 1) % _U32
            or int(first_time_ns[0]) < last.first_time_ns
            or int(pps_count[0]) < last.pps_count
        ):
            return False
        return bool(
            (np.diff(sequence) == 1).all()
            and (first_time_ns[1:] >= first_time_ns[:-1]).all()
            and (pps_count[1:] >= pps_count[:-1]).all()
        )

    def _step(self, sequence: int, first_time_ns: int, pps_count: int) -> tuple[int, bool]:
        """One datagram: its unwrapped number and whether it is a new one."""
        last = self._last
        if last is None:
            return self._remember(sequence, sequence, first_time_ns, pps_count), True
        ahead = (sequence - last.sequence - 1) % _U32
        behind = _U32 - 1 - ahead
        if behind == 0 and first_time_ns == last.first_time_ns:
            self._errors["duplicate"] += 1
            return last.unwrapped, False
        if 0 < behind <= LATE_DATAGRAMS and 0 < last.first_time_ns - first_time_ns < LATE_NS:
            return self._late(last.unwrapped - behind)
        if pps_count < last.pps_count or first_time_ns < last.first_time_ns:
            self._errors["restart"] += 1
            ahead = 0
        elif ahead >= _U32 // 2:
            self._errors["out_of_order"] += 1
            ahead = 0
        elif ahead:
            self._errors["sequence_gap"] += ahead
        newest = last.unwrapped + 1 + ahead
        oldest = newest - LATE_DATAGRAMS
        self._missing = {at for at in self._missing if at >= oldest}
        self._missing.update(range(max(last.unwrapped + 1, oldest), newest))
        return self._remember(sequence, newest, first_time_ns, pps_count), True

    def _late(self, at: int) -> tuple[int, bool]:
        """A datagram behind the newest: late, or come before."""
        if at not in self._missing:
            self._errors["duplicate"] += 1
            return at, False
        self._missing.discard(at)
        self._errors["out_of_order"] += 1
        return at, True

    def _remember(self, sequence: int, unwrapped: int, first_time_ns: int, pps_count: int) -> int:
        self._last = _Last(sequence, unwrapped, first_time_ns, pps_count)
        return unwrapped


class SampleThinner:
    """Chooses the first unit of each bin of host time: what a clock model needs of thousands of units a second.

    Args:
        bin_ns: width of a bin.
    """

    def __init__(self, bin_ns: int = 50_000_000) -> None:
        self._bin_ns = bin_ns
        self._last_bin: int | None = None

    def choose(self, host_time_ns: Int64Array) -> BoolArray:
        """(n,) bool, True where a unit lies in another bin than the unit before it."""
        bins = host_time_ns // self._bin_ns
        chosen = np.ones(len(bins), dtype=np.bool_)
        chosen[1:] = bins[1:] != bins[:-1]
        if len(bins):
            chosen[0] = bins[0] != self._last_bin
            self._last_bin = int(bins[-1])
        return chosen
