"""Measure what navigation costs on one core, beside python-ins on the same samples, and how large its errors are.

python -m benchmarks.navigation [--repeats 5] [--json FILE]

The reference flight has a tactical unit (200 Hz), positions at 1 Hz and 21 error states. Figures are samples a second
of this process's own CPU time, medians over the repeats; python-ins runs once, over a minute of the flight. "Filter and
smoother" computes the covariance of every sample; "solved" also finds the noise and makes further passes. "Sample by
sample" feeds the filter as in flight. The second table has the errors of both reference flights.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from pyins import filters, inertial_sensor, measurements, strapdown
from pyins.util import LLA_COLS, RPH_COLS, VEL_COLS

from benchmarks.cpu_time import cpu_seconds
from swath.georef.arrays import StructArray
from swath.georef.geodesy.earth import geodetic_from_e
from swath.georef.navigation.filter.filter import NavigationFilter, run_filter
from swath.georef.navigation.filter.smoother import smooth
from swath.georef.navigation.inputs import Inertial, Kind, Setup, Start
from swath.georef.navigation.solve import solve
from tests.georef.navigation.scores import (
    FILTER,
    LINES_S,
    OUTAGES_M,
    SMOOTHER,
    flight_errors,
    of_maxima,
    outages,
    rms,
    start_of,
    without,
)
from tests.georef.navigation.vehicles import reference

Flight = tuple[Inertial, StructArray, Setup, Start]
PYINS_S = 60.0
LIVE_SAMPLES = 20_000


@dataclass
class Figure:
    """One line of the table of speeds."""

    name: str
    samples_per_s: float
    asked: float | None


def flight_of(name: str) -> Flight:
    """Return a reference flight with positions only."""
    flown = reference(name)
    return flown.inertial, flown.only(Kind.POSITION), flown.setup, start_of("reference_flight", name)


def speeds(flight: Flight, repeats: int) -> list[Figure]:
    """Measure all lines of the table of speeds."""
    inertial, rows, setup, start = flight
    count = int(np.count_nonzero(inertial.time_ns > start.time_ns))

    def line(name: str, work: Callable[[], object], asked: float | None = None) -> Figure:
        return Figure(name, count / cpu_seconds(work, repeats), asked)

    figures = [
        line("filter", partial(run_filter, inertial, rows, setup, start), 200_000),
        line("filter and smoother", lambda: smooth(run_filter(inertial, rows, setup, start)), 120_000),
        line("solved", partial(solve, inertial, rows, setup, start)),
        Figure("filter, sample by sample", live(flight), 1_000),
    ]
    for name, seconds, samples in of_pyins(flight):
        figures.append(Figure(f"python-ins, {name}", samples / seconds, None))
    return figures


def live(flight: Flight) -> float:
    """Return the samples a second of a filter that gets each sample alone."""
    inertial, rows, setup, start = flight
    machine = NavigationFilter(setup, start, smoothed=False, hold_s=0.3)
    machine.observe(rows)
    first = int(np.searchsorted(inertial.time_ns, start.time_ns))
    begin = time.process_time()
    for k in range(first, first + LIVE_SAMPLES):
        machine.feed(inertial.between(k, k + 1))
        machine.new_path()
    return LIVE_SAMPLES / (time.process_time() - begin)


def of_pyins(flight: Flight) -> list[tuple[str, float, int]]:
    """Run the filter of python-ins over a minute of the flight, with the same sensor errors and without a smoother.

    Returns:
        Name, CPU seconds and number of samples.
    """
    inertial, rows, setup, start = flight
    first = int(np.searchsorted(inertial.time_ns, start.time_ns, side="right"))
    part = inertial.between(first, first + round(PYINS_S * 200))
    seconds = (part.time_ns - start.time_ns) / 1e9
    names = ["gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z"]
    increments = strapdown.compute_increments_from_imu(
        pd.DataFrame(np.hstack([part.angle_b, part.velocity_b]), index=seconds, columns=names), "increment"
    )
    lat, lon, height = geodetic_from_e(rows["value"])
    fixes = np.column_stack([np.degrees(lat), np.degrees(lon), height])
    seen = pd.DataFrame(fixes, index=(rows["time_ns"] - start.time_ns) / 1e9, columns=LLA_COLS)
    place = [float(value) for value in geodetic_from_e(start.position_e)]
    angles = np.degrees(start.attitude_rad)
    state = [np.degrees(place[0]), np.degrees(place[1]), place[2], *start.velocity_l, *angles]
    pva = pd.Series(state, LLA_COLS + VEL_COLS + RPH_COLS, name=0.0)
    noise = setup.noise
    gyro = inertial_sensor.EstimationModel(
        noise.gyro_bias, noise.angle_random_walk, None, np.diag([noise.gyro_scale] * 3)
    )
    accel = inertial_sensor.EstimationModel(
        noise.accel_bias, noise.velocity_random_walk, None, np.diag([noise.accel_scale] * 3)
    )
    seen = seen[(seen.index > 0) & (seen.index < PYINS_S)]
    fix = measurements.Position(seen, 0.015, setup.lever_arms_b[0])
    begin = time.process_time()
    filters.run_feedback_filter(pva, 0.05, 0.05, 0.05, 0.5, increments, gyro, accel, [fix], time_step=setup.step_s)
    return [("filter", time.process_time() - begin, len(part))]


def quality(name: str) -> dict[str, Any]:
    """Return the RMS errors on the lines and in outages, of filter and smoother."""
    inertial, rows, setup, start = flight_of(name)
    found: dict[str, Any] = {}
    solved = solve(inertial, rows, setup, start)
    lost = solve(inertial, without(rows, outages(name)), setup, start)
    spans = outages(name)
    for what, solution, gap in (
        ("filter", solved.forward, lost.forward),
        ("smoother", solved.smoothed, lost.smoothed),
    ):
        found[what] = rms(flight_errors(name, solution, LINES_S)[1]).tolist()
        t, off = flight_errors(name, gap, (spans.min(), spans.max() + 1.0))
        found[f"{what}, outages"] = of_maxima(t, np.linalg.norm(off[:, :3], axis=1), spans)
    return found


def show(figures: list[Figure], found: dict[str, dict[str, Any]]) -> None:
    """Print the two tables."""
    print(f"{'navigation, 200 Hz, one core':<36} {'samples/s':>10} {'asked':>9}")
    for one in figures:
        asked = f"{one.asked:>9,.0f}" if one.asked else ""
        print(f"{one.name:<36} {one.samples_per_s:>10,.0f} {asked}")
    heads = "".join(f"{head:>8}" for head in ("N m", "E m", "D m", "roll °", "pitch °", "head. °"))
    print(f"\n{'RMS on the lines':<26}{heads} outages m")
    for name, of in found.items():
        for what, others, gap in (("filter", FILTER, 0), ("smoother", SMOOTHER, 1)):
            for who, values, metres in (
                ("", of[what], of[f"{what}, outages"]),
                (", others", others[name], OUTAGES_M[name][gap]),
            ):
                print(f"{name + ', ' + what + who:<26}" + "".join(f"{v:>8.4f}" for v in values) + f" {metres:>9.3f}")


def main() -> None:
    """Measure and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=5, help="measurements per figure; the median counts")
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    arguments = parser.parse_args()
    figures = speeds(flight_of("tactical"), arguments.repeats)
    found = {name: quality(name) for name in ("tactical", "mems")}
    show(figures, found)
    if arguments.json:
        arguments.json.write_text(json.dumps({"speed": [asdict(one) for one in figures], "figures": found}, indent=1))


if __name__ == "__main__":
    main()
