"""Test the predicted errors of navigation on flights of the virtual aircraft: RMS on the lines, measured and predicted.

python -m benchmarks.navigation_seeds [--seeds 20] [--short] [--json FILE]

A flight of 30 min starts on a runway and has two short crossing lines and seven survey lines at 60 m/s, with the
simulator's own inertial unit (200 Hz) and fixes once a second. The sensors are, in turn: those of the reference
flights, whose noise the filter knows; the same with axes that lean towards each other; and the simulator's grades with
its RTK receiver, set up as `swath trajectory` does if it knows only the grade. The interval contains 99 % of the means
over the flights if the prediction is right (`tests.georef.navigation.virtual_aircraft`).
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from swath.daemon.processing.navigation.sources import filter_setup
from swath.georef.navigation.inputs import GRADES, ImuNoise, Setup
from swath.georef.navigation.solve import solve
from swath.sim.plan.tables import ImuTable
from tests.georef.navigation.flights import drawn_start
from tests.georef.navigation.virtual_aircraft import (
    ARM,
    BEGIN_S,
    REFERENCE,
    Aircraft,
    Seeds,
    aircraft,
    on_lines,
    receiver_fixes,
    reference_noise,
    seeds_of,
    sensed,
    survey_plan,
    white_fixes,
)

START_RAD = (float(np.radians(0.05)), float(np.radians(0.05)), float(np.radians(0.5)))
MISALIGNMENT_MRAD = 0.5
LONG, SHORT = (7, 5500.0, 120.0), (3, 3000.0, 60.0)  # number of lines, their length in metres, seconds on the ground


@dataclass(frozen=True, eq=False)
class Case:
    """Sensors of a flight, and the noise that the filter assumes.

    Attributes:
        name: name of the printed lines.
        table: the inertial unit of the simulator.
        noise: the noise that the filter assumes.
        receiver: whether fixes come from the simulator's RTK receiver; otherwise they have white errors of 1, 1, 2 cm.
    """

    name: str
    table: ImuTable
    noise: ImuNoise
    receiver: bool = False


def cases() -> list[Case]:
    """Return all cases, in the order of the table."""
    found = [Case(name, ImuTable(noise=REFERENCE[name]), reference_noise(name)) for name in REFERENCE]
    leaning = REFERENCE["mems"].model_copy(update={"misalignment_mrad": MISALIGNMENT_MRAD})
    noise = reference_noise("mems")
    found.append(Case("MEMS, leaning, not told", ImuTable(noise=leaning), noise))
    found.append(Case("MEMS, leaning", ImuTable(noise=leaning), replace(noise, misalignment=1e-3 * MISALIGNMENT_MRAD)))
    for grade in ("tactical", "mems"):
        table = ImuTable.model_validate({"grade": grade})
        found.append(Case(f"grade {grade}", table, GRADES[grade], receiver=True))
    return found


def setup_of(case: Case) -> Setup:
    """Return the filter's setup: white errors are known, errors of a receiver are assumed as swath assumes them."""
    return filter_setup(case.noise, [np.array(ARM)]) if case.receiver else Setup(case.noise, np.array([ARM]))


def flown(craft: Aircraft, case: Case, seeds: range) -> dict[str, Seeds]:
    """Return the errors of filter and smoother over all seeds."""
    found: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {"filter": [], "smoother": []}
    for seed in seeds:
        start = drawn_start(craft.truth, seed, attitude_rad=START_RAD, at_s=BEGIN_S)
        rows = receiver_fixes(craft, seed) if case.receiver else white_fixes(craft, seed)
        solved = solve(sensed(craft, case.table, seed), rows, setup_of(case), start, noise_from_flight=case.receiver)
        found["filter"].append(on_lines(craft, solved.forward))
        found["smoother"].append(on_lines(craft, solved.smoothed))
    return {what: seeds_of(squares) for what, squares in found.items()}


def show(name: str, what: str, of: Seeds) -> None:
    """Print two lines: measured RMS, and its ratio to the predicted one with the interval."""
    unit = np.array([1.0] * 3 + [float(np.degrees(1.0))] * 3)
    print(f"{name + ', ' + what:<34}" + "".join(f"{value:>15.4f}" for value in of.measured * unit))
    ratios = zip(of.measured / of.predicted, of.low / of.predicted, of.high / of.predicted, strict=True)
    print(f"{'  over predicted (99 %)':<34}" + "".join(f"{m:>5.2f} {a:.2f}–{b:.2f}" for m, a, b in ratios))


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20, help="flights of each kind")
    parser.add_argument("--short", action="store_true", help="make a flight of 13 minutes")
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    arguments = parser.parse_args()
    lines, length_m, static_s = SHORT if arguments.short else LONG
    craft = aircraft(survey_plan(lines, length_m, static_s=static_s))
    heads = "".join(f"{head:>15}" for head in ("N m", "E m", "D m", "roll °", "pitch °", "heading °"))
    print(f"{arguments.seeds} flights of {craft.end_s / 60.0:.1f} min, RMS on the lines\n{'':<34}{heads}")
    figures = {}
    for case in cases():
        for what, of in flown(craft, case, range(arguments.seeds)).items():
            show(case.name, what, of)
            figures[f"{case.name}, {what}"] = {
                "measured": of.measured.tolist(),
                "predicted": of.predicted.tolist(),
                "interval": [of.low.tolist(), of.high.tolist()],
            }
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=1))


if __name__ == "__main__":
    main()
