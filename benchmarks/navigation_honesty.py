"""Whether sigmas are what errors are, over many flights: NEES of position, velocity, attitude; innovations.

python -m benchmarks.navigation_honesty [--seeds 50]

Made flights of ten minutes at 60 m/s, 50 Hz, fixes at 1 Hz with white errors and with errors that last a minute (70 %
of the variance), the filter told of it. Truth and inertial samples are the simulator's. The interval is that of χ² at
99.8 % with as many independent samples as the flights' own scatter shows (`tests.georef.navigation.honesty`). Of
innovations there is the second moment and the largest correlation of neighbours beside its one sigma.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from functools import cache

import numpy as np

from georef.navigation.filter import run_filter
from georef.navigation.inputs import GRADES, Fate, Solution
from georef.navigation.smoother import forward, smooth
from tests.georef.navigation.flights import Fixes, Truth, drawn_start, fly, noised, setup_for, survey
from tests.georef.navigation.honesty import judge, squares

ARM = np.array([0.35, -0.12, -1.1])


@cache
def flight() -> Truth:
    """Ten minutes of it."""
    return fly(survey(), 600.0, 50.0)


def flown(grade: str, share: float, seed: int) -> tuple[Solution, Solution]:
    """Filtered and smoothed."""
    inertial, rows = noised(flight(), GRADES[grade], Fixes(share=share, tau_s=60.0), ARM, seed)
    setup = replace(setup_for(GRADES[grade], ARM), gnss_correlated_share=share, position_floor_m=0.001)
    run = run_filter(inertial, rows, setup, drawn_start(flight(), seed))
    return forward(run), smooth(run)


def main() -> None:
    """Fly and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=50, help="flights of each kind")
    arguments = parser.parse_args()
    print(f"{'':<28}{'part':<10} {'NEES':>6} {'interval':>14} {'independent':>12}")
    for grade in ("tactical", "mems"):
        for share in (0.0, 0.7):
            filtered, smoothed, moments, neighbours = [], [], [], []
            for seed in range(1000, 1000 + arguments.seeds):
                ahead, behind = flown(grade, share, seed)
                filtered.append(squares(flight(), ahead, 60.0, 0.5))
                smoothed.append(squares(flight(), behind, 5.0, 0.5))
                told = ahead.innovations[ahead.innovations["fate"] <= Fate.REACQUIRED]["normalised"][30:]
                moments.append(np.mean(told**2))
                neighbours.append((told[1:] * told[:-1]).mean(axis=0) / (told**2).mean(axis=0))
            name = f"{grade}, {'lasting' if share else 'white'}"
            for what, flights in (("filtered", filtered), ("smoothed", smoothed)):
                for part, of in judge(flights).items():
                    mark = "" if of.holds else "  outside"
                    text = f"{of.low:.3f} … {of.high:.3f}"
                    print(
                        f"{name + ', ' + what:<28}{part:<10} {of.mean:>6.3f} {text:>14} {of.independent:>12,.0f}{mark}"
                    )
            alike = float(np.abs(np.mean(neighbours, axis=0)).max())
            chance = 1.0 / np.sqrt(arguments.seeds * len(told))
            print(f"{name}: innovations' second moment {np.mean(moments):.3f}, neighbours {alike:.4f} ± {chance:.4f}")


if __name__ == "__main__":
    main()
