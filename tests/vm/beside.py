"""How much of this computer others had meanwhile: the proofs want one that has nothing else to do."""

from __future__ import annotations

import os
import time
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

TICKS_PER_S = os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True)
class Moment:
    """Processor time so far, seconds.

    Attributes:
        monotonic_s: when.
        busy_s: of all processors, with what a hypervisor gave to others.
        own_s: of this process and all that descend from it, those that have ended too.
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
        """Of all processors from this moment to now, 0 … 1."""
        now, processors = Moment.here(), os.cpu_count() or 1
        others_s = (now.busy_s - self.busy_s) - (now.own_s - self.own_s)
        return max(0.0, others_s / (processors * max(now.monotonic_s - self.monotonic_s, 0.01)))


def _living_s() -> float:
    """Of this process and the living ones below it, with those below them that have ended (proc(5), stat)."""
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
