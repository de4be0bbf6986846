"""Measures how much of this computer other programs used, because the proofs need an idle one."""

from __future__ import annotations

import os
import time
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

TICKS_PER_S = os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True)
class Moment:
    """Processor time so far, in seconds.

    Attributes:
        monotonic_s: the moment.
        busy_s: time of all processors, with that which a hypervisor gave to other machines.
        own_s: time of this process and all its descendants, those that have ended too.
    """

    monotonic_s: float
    busy_s: float
    own_s: float

    @classmethod
    def here(cls) -> Moment:
        """Return the present moment."""
        user, nice, system, _idle, _waiting, irq, softirq, stolen = Path("/proc/stat").read_text().split()[1:9]
        busy = sum(map(int, (user, nice, system, irq, softirq, stolen)))
        ended = os.times()
        own = ended.children_user + ended.children_system + _living_s()
        return cls(time.monotonic(), busy / TICKS_PER_S, own)

    def share_of_others(self) -> float:
        """Return the share of all processors that others used from this moment to now, 0 … 1."""
        now, processors = Moment.here(), os.cpu_count() or 1
        others_s = (now.busy_s - self.busy_s) - (now.own_s - self.own_s)
        return max(0.0, others_s / (processors * max(now.monotonic_s - self.monotonic_s, 0.01)))


def _living_s() -> float:
    """Return the processor time, s, of this process and its living descendants.

    It includes descendants of these that have ended (proc(5), stat).
    """
    children, ticks = defaultdict(list), {}
    for place in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = place.read_text().rpartition(")")[2].split()
        except (FileNotFoundError, ProcessLookupError):
            continue
        pid = int(place.parent.name)
        children[int(fields[1])].append(pid)
        ticks[pid] = sum(map(int, fields[11:15] if pid != os.getpid() else fields[11:13]))
    total, waiting = 0, [os.getpid()]
    while waiting:
        pid = waiting.pop()
        total += ticks.get(pid, 0)
        waiting += children[pid]
    return total / TICKS_PER_S
