"""Measure work by this process's own CPU time, which is hardly disturbed by other processes.

The other benchmarks use it; it has no command of its own.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable


def cpu_seconds(work: Callable[[], object], repeats: int, *, at_least_s: float = 0.0) -> float:
    """Return the median CPU time of the work over the repeats; a first execution is not counted.

    Args:
        work: what is measured.
        repeats: number of measurements.
        at_least_s: least duration of one measurement; shorter work is repeated within it.
    """
    work()
    rounds = 1
    if at_least_s > 0.0:
        rounds = max(1, int(at_least_s / max(_seconds(work, 1), 1e-6)))
    return statistics.median(_seconds(work, rounds) / rounds for _ in range(repeats))


def _seconds(work: Callable[[], object], rounds: int) -> float:
    """Return the CPU seconds of so many rounds of the work."""
    start = time.process_time()
    for _ in range(rounds):
        work()
    return time.process_time() - start
