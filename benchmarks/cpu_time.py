"""How long work takes of this process's own CPU time, which other processes' work disturbs least."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable


def cpu_seconds(work: Callable[[], object], repeats: int, *, at_least_s: float = 0.0) -> float:
    """Median over the repeats, after a first time that does not count.

    Args:
        work: is done.
        repeats: measurements.
        at_least_s: how long one should take: shorter work is done as often within it.
    """
    work()
    rounds = 1
    if at_least_s > 0.0:
        rounds = max(1, int(at_least_s / max(_seconds(work, 1), 1e-6)))
    return statistics.median(_seconds(work, rounds) / rounds for _ in range(repeats))


def _seconds(work: Callable[[], object], rounds: int) -> float:
    start = time.process_time()
    for _ in range(rounds):
        work()
    return time.process_time() - start
