"""Measure what the overlap of neighbouring lines costs `swath live` while one of 200 lines is flown.

python -m benchmarks.inflight.overlap [--lines 200] [--length-m 10000]

The lines are parallel, and all are flown. Live judges the line that is flown anew every other second of the log's time,
and compares its swath with those beside it. Figures are milliseconds of processor time: for each time, for each second
of flight, and when a line is compared for the first time. `inflight.extra` says how much live does in a second.
"""

from __future__ import annotations

import argparse
import math
import time
from dataclasses import replace

import numpy as np

from swath.daemon.config.tables import PlanConfig
from swath.daemon.processing.flightplan.judge import LineVerdict
from swath.daemon.processing.flightplan.lines import Pass
from swath.daemon.processing.flightplan.overlap import Overlaps
from swath.daemon.processing.flightplan.plan import FlightPlan, PlannedLine
from swath.daemon.processing.flightplan.watch import LineWatch
from swath.daemon.processing.live.lines import SAVE_NS
from swath.georef.timescales.gps_time import SECOND_NS

SPACING_DEG, HALF_M, CELL_M = 0.004, 346.0, 10.0  # 445 m between lines, whose swaths have 693 m
TIMES = 200


def flown_lines(count: int, length_m: float) -> tuple[FlightPlan, LineWatch, PlanConfig]:
    """Return a plan of parallel lines, all of which have been flown."""
    config = PlanConfig.model_validate({"file": "made.kml", "wanted": {"overlap_percent": 20.0}})
    away_deg = math.degrees(length_m / 6.38e6 / math.cos(math.radians(47.0)))
    nan = np.full(2, math.nan)
    lines = tuple(
        PlannedLine(str(n), np.full(2, 47.0 + n * SPACING_DEG), np.array([9.0, 9.0 + away_deg]), nan, nan)
        for n in range(count)
    )
    plan = FlightPlan("made", lines)
    watch = LineWatch(plan, config)
    for number, line in enumerate(watch.lines):
        cells = math.ceil(line.length_m / CELL_M)
        edge = np.full(cells, HALF_M)
        line.verdict = LineVerdict([], np.ones(cells, np.bool_), CELL_M, -edge, edge, np.zeros(cells))
        line.passes = [Pass(number, number, False, number * 100 * SECOND_NS)]
    return plan, watch, config


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lines", type=int, default=200)
    parser.add_argument("--length-m", type=float, default=10_000.0)
    chosen = parser.parse_args()
    plan, watch, config = flown_lines(chosen.lines, chosen.length_m)
    overlaps = Overlaps(plan.lines, watch.geometry)
    began_s = time.process_time()
    overlaps.blame(watch.lines, config, range(chosen.lines))
    first_ms = 1000.0 * (time.process_time() - began_s) / chosen.lines
    line = watch.lines[chosen.lines // 2]
    began_s = time.process_time()
    for _ in range(TIMES):
        assert line.verdict is not None
        line.verdict = replace(line.verdict)
        overlaps.blame(watch.lines, config, [chosen.lines // 2])
    each_ms = 1000.0 * (time.process_time() - began_s) / TIMES
    print(f"{first_ms:8.2f} ms for a line that is compared for the first time")
    print(f"{each_ms:8.2f} ms each time that the line that is flown is judged")
    print(f"{each_ms * SECOND_NS / SAVE_NS:8.2f} ms for each second of flight")


if __name__ == "__main__":
    main()
