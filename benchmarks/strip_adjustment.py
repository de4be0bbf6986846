"""Measure what a strip adjustment costs on one core, by the number of strips.

OPENBLAS_NUM_THREADS=1 python -m benchmarks.strip_adjustment [--strips 5 10 20 30] [--json FILE]

Half of the strips fly north or south, half east or west, all over the same planes; each third one errs by some
centimetres. Only equations and choice of models are measured, not reading the log, the search for planes and the
comparison of the strips, whose times grow with the returns. Times are CPU time of this process; memory is the most
that Python's arrays hold during the adjustment.
"""

from __future__ import annotations

import argparse
import json
import time
import tracemalloc
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from swath.calib.equations.trajectory_prior import TrajectoryPrior, apply, knots_of
from swath.calib.flight import Flight
from swath.calib.strips.corrections import Settings, adjust_strips
from tests.calib.planned_flight import flown, noised

HEIGHT_M, OFFSETS_M, SEED = 800.0, 250.0, 5
ERROR = (0.05, -0.05, 0.04, 2e-4, 0.0, 0.0)  # north, east, down, turns about them


@dataclass
class Figures:
    """The cost of one adjustment."""

    strips: int
    returns: int
    seconds: float
    megabytes: float


def block(strips: int) -> list[tuple[float, float, float]]:
    """Return lines: course (degrees), height and offset (metres)."""
    offsets = np.linspace(-OFFSETS_M, OFFSETS_M, (strips + 1) // 2)
    return [((0.0, 90.0, 180.0, 270.0)[line % 4], HEIGHT_M, float(offsets[line // 2])) for line in range(strips)]


def spoilt(flight: Flight) -> Flight:
    """Return the flight with an error in the trajectory of each third strip."""
    knots = knots_of(flight, 1.0)
    errors = np.zeros((len(knots), 6))
    errors[knots.strip % 3 == 0] = ERROR
    prior = TrajectoryPrior(knots.trajectory_index, knots.time_ns, knots.strip, np.eye(6 * len(knots)))
    return replace(flight, trajectories=(apply(flight.trajectories[0], 0, prior, -errors),))


def measure(strips: int) -> Figures:
    """Return the cost of adjusting so many strips."""
    flight, features = flown(block(strips))
    flight = spoilt(noised(flight, SEED))
    returns = sum(len(patch.at) for plane in features.planes for patch in plane.patches)
    began = time.process_time()
    adjust_strips(flight, features, flight.starts(), Settings())
    seconds = time.process_time() - began
    tracemalloc.start()  # slows the second run
    adjust_strips(flight, features, flight.starts(), Settings())
    peak_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return Figures(strips, returns, seconds, peak_bytes / 1e6)


def main() -> None:
    """Measure, and print a line for each number of strips."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--strips", type=int, nargs="+", default=[5, 10, 20, 30])
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    measure(5)  # compiles the loops
    figures = [measure(strips) for strips in options.strips]
    for one in figures:
        print(f"{one.strips:3d} strips, {one.returns:,} returns: {one.seconds:.1f} s, {one.megabytes:.0f} MB")
    if options.json:
        options.json.write_text(json.dumps([asdict(one) for one in figures], indent=2) + "\n")


if __name__ == "__main__":
    main()
