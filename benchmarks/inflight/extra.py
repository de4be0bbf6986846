"""Measure what the map, the last moments and the lines cost the live georeferencer, beside all else that it does.

python -m benchmarks.inflight.extra [--log FOLDER] [--repeats 5]

Replays a log (default: the preset ``small``, 50,000 pulses a second, with its plan) and takes this process's CPU time
within the functions of the map and of the lines, without the time that taking it costs. As both are taken in one run,
the share hardly depends on other programs. Of a head with more pulses the share is smaller: most of it is spent by the
second of flight, not by the pulse.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.georef_log import run_swath
from swath.daemon.config.tables import LiveConfig
from swath.daemon.log.reader import open_logs
from swath.daemon.processing.live.lines import LiveLines
from swath.daemon.processing.live.look import LastLook
from swath.daemon.processing.live.painting import LiveMap
from swath.daemon.processing.live.products import LiveProducts
from swath.daemon.processing.live.session import LiveSession, replay
from swath.daemon.processing.setup.setup import Options, Setup
from swath.daemon.system import keep_freed_memory

LIMIT_PERCENT = 15.0  # of live's own work
PARTS: dict[str, list[tuple[type, tuple[str, ...]]]] = {
    "map and last moments": [
        (LiveMap, ("take", "update", "end")),
        (LastLook, ("take", "take_pose")),
        (LiveProducts, ("save_map",)),
    ],
    "lines": [
        (LiveLines, ("record", "tick", "_take_events", "_take_status")),
        (LiveSession, ("_save_lines",)),
    ],
}


class Clocked:
    """Takes the CPU time within methods."""

    def __init__(self) -> None:
        self.spent_ns: Counter[str] = Counter()
        self.calls: Counter[str] = Counter()

    def wrap(self, owner: type, method: str, part: str) -> None:
        """Count a method's time for a part."""
        work: Callable[..., Any] = getattr(owner, method)

        def clocked(*args: Any, **kwargs: Any) -> Any:
            began_ns = time.thread_time_ns()
            try:
                return work(*args, **kwargs)
            finally:
                self.spent_ns[part] += time.thread_time_ns() - began_ns
                self.calls[part] += 1

        setattr(owner, method, clocked)

    def own_ns(self, calls: int = 20_000) -> tuple[float, float]:
        """Return what taking the time of one call costs in all, and how much of that is counted for its part."""

        class Nothing:
            def work(self) -> None:
                """Do nothing at all."""

        self.wrap(Nothing, "work", "")
        one = Nothing()
        began_ns = time.thread_time_ns()
        for _ in range(calls):
            one.work()
        whole = (time.thread_time_ns() - began_ns) / calls
        inside = self.spent_ns.pop("") / self.calls.pop("")
        return whole, inside


def measure(log: Path, repeats: int) -> dict[str, float]:
    """Return the share of each part of live's own CPU time, per cent: medians."""
    clocked = Clocked()
    for part, owners in PARTS.items():
        for owner, methods in owners:
            for method in methods:
                clocked.wrap(owner, method, part)
    session = open_logs([log])[0]
    shares: dict[str, list[float]] = {part: [] for part in PARTS}
    for repeat in range(repeats + 1):
        setup = Setup.of_log(session.attachments(), Options(uncertainty=False))
        clocked.spent_ns.clear()
        clocked.calls.clear()
        with tempfile.TemporaryDirectory() as folder:
            began_ns = time.thread_time_ns()
            replay(session, setup, Path(folder), LiveConfig(), None)
            whole_ns = time.thread_time_ns() - began_ns
        calls, spent_ns = clocked.calls.copy(), clocked.spent_ns.copy()
        each_ns, inside_ns = clocked.own_ns()
        extra_ns = {part: spent_ns[part] - inside_ns * calls[part] for part in PARTS}
        own_ns = whole_ns - each_ns * calls.total() - sum(extra_ns.values())
        if repeat:  # the first one compiles and fills the page cache
            for part in PARTS:
                shares[part].append(100.0 * extra_ns[part] / own_ns)
    return {part: statistics.median(values) for part, values in shares.items()}


def main() -> None:
    """Measure and print the shares."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--log", type=Path, help="use this log instead of making one")
    parser.add_argument("--repeats", type=int, default=5, help="measurements; the medians count")
    arguments = parser.parse_args()
    keep_freed_memory()  # as every command of swath does
    with tempfile.TemporaryDirectory() as folder:
        log = arguments.log
        if log is None:
            log = Path(folder, "log")
            run_swath("sim", "fly", "small", "--no-truth", "-o", str(log))
        shares = measure(log, arguments.repeats)
    print("extra work of live, % of its own, by replay")
    for part, share in shares.items():
        print(f"  {part:<24} {share:>6.1f}")
    print(f"  {'together':<24} {sum(shares.values()):>6.1f}   limit {LIMIT_PERCENT:g}")


if __name__ == "__main__":
    main()
