"""Follows packets that have no number by their stamps past the hour: missing, late and repeated ones, a clock set."""

from __future__ import annotations

from collections import Counter, deque

import numpy as np
from numpy.typing import NDArray

from swath.georef.records import Int64Array

LATE_PACKETS = 16  # a packet at most this far behind its place was delayed by the network; further: the clock was set


class StampTracker:
    """Counted in ``errors``: ``cadence_gap`` (packets missing), ``out_of_order`` (packets that came late, each counted
    as missing before), ``duplicate``, ``stamp_jump`` (the clock was set: no gap).

    The same answer however the packets are cut into batches.

    Args:
        errors: the parser's ``counters.errors``.
        wrap_us: where the stamps wrap.
        max_silence_us: a longer step is a clock that was set, not packets that were lost.
    """

    def __init__(self, errors: Counter[str], wrap_us: int, max_silence_us: int) -> None:
        self._errors = errors
        self._wrap_us = wrap_us
        self._max_silence_us = max_silence_us
        self._newest_us: int | None = None
        self._recent: deque[int] = deque(maxlen=LATE_PACKETS + 1)

    def follow(self, stamp_us: Int64Array, nominal_us: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Take packets (n,) and the time each spans; (n,) False for a packet that has come before."""
        if not len(stamp_us):
            return np.zeros(0, dtype=np.bool_)
        before = np.concatenate([[stamp_us[0] if self._newest_us is None else self._newest_us], stamp_us[:-1]])
        step_us = (stamp_us - before) % self._wrap_us
        if self._newest_us is None:
            step_us[0] = round(nominal_us[0])
        if not ((step_us > 0) & (step_us <= self._max_silence_us)).all():
            pairs = zip(stamp_us.tolist(), nominal_us.tolist(), strict=True)
            return np.array([self._step(stamp, nominal) for stamp, nominal in pairs], dtype=np.bool_)
        self._count("cadence_gap", int(np.maximum(np.rint(step_us / nominal_us).astype(np.int64) - 1, 0).sum()))
        self._newest_us = int(stamp_us[-1])
        self._recent.extend(stamp_us[-LATE_PACKETS - 1 :].tolist())
        return np.ones(len(stamp_us), dtype=np.bool_)

    def _step(self, stamp_us: int, nominal_us: float) -> bool:
        """One packet; whether it is a new one."""
        if stamp_us in self._recent:
            self._errors["duplicate"] += 1
            return False
        newest_us = self._newest_us
        self._recent.append(stamp_us)
        if newest_us is not None:
            step_us = (stamp_us - newest_us) % self._wrap_us
            if self._wrap_us - step_us <= LATE_PACKETS * nominal_us:
                self._errors["out_of_order"] += 1
                return True
            if step_us > self._max_silence_us:
                self._errors["stamp_jump"] += 1
                self._recent = deque([stamp_us], LATE_PACKETS + 1)
            else:
                self._count("cadence_gap", max(0, round(step_us / nominal_us) - 1))
        self._newest_us = stamp_us
        return True

    def _count(self, code: str, count: int) -> None:
        if count:
            self._errors[code] += count
