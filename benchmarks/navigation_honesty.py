"""Test whether navigation's sigmas agree with its errors over many flights: NEES of position, velocity and attitude.

python -m benchmarks.navigation_honesty [--seeds 50] [--receivers [NAME …] | --lasting | --headings [GRADE …]]

Virtual flights of ten minutes at 60 m/s, 50 Hz, have fixes at 1 Hz, with white errors or with errors of which 70 % of
the variance lasts a minute; the filter knows the share. Truth and inertial samples come from the simulator. The
interval is that of χ² at 99.8 %, for as many independent samples as the scatter between flights shows
(`tests.georef.navigation.honesty`). For innovations, the second moment is printed, and the largest correlation of
neighbours with its one-sigma bound.

``--receivers`` flies other receivers instead (`tests.georef.navigation.receivers`): their sigmas are true, too small by
3, too large by 3, or missing, and half of their variance lasts a minute; `solve` does not know which. Beside the NEES
of its solution stands the largest ratio of its RMS errors over the flights to those of a smoother that knows the noise.
The lines "known" have the NEES of that smoother on the same flights, which shows the effect of the random draws. A
flight is drawn once for the three kinds of sigmas, and takes some 2 s.

``--lasting`` flies the UBX receiver with the tactical unit, where another share of the positions' variance lasts than
`solve` assumes, or for another time. Printed are the NEES of position; the RMS errors over those of the smoother that
knows the noise, for the worst component; and the RMS sigmas over that smoother's, for all three components together.

``--headings`` flies the UBX receiver with a second antenna that measures headings to 0.1° at 5 Hz, on lines of 90 s,
with sigmas that are true, too small by 3 or too large by 3. Printed are the NEES of attitude; the RMS errors over those
of the smoother that knows the noise, for the worst of roll, pitch and heading and for heading alone; and the RMS sigmas
of heading over that smoother's. A flight takes some 10 s.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from functools import cache

import numpy as np

from swath.georef.arrays import FloatArray
from swath.georef.navigation.filter.filter import run_filter
from swath.georef.navigation.filter.smoother import forward, smooth
from swath.georef.navigation.inputs import GRADES, Fate, Solution
from tests.georef.navigation.flights import Fixes, Truth, drawn_start, fly, noised, setup_for, survey
from tests.georef.navigation.honesty import judge, squares
from tests.georef.navigation.receivers import DUAL_ANTENNAS, RECEIVERS, compared

ARM = np.array([0.35, -0.12, -1.1])
LASTING = ((0.5, 60.0), (0.0, 60.0), (0.2, 60.0), (0.5, 10.0), (0.5, 300.0))  # lasting share of the variance, time in s
OPTIMISMS = {"honest": 1.0, "optimistic by 3": 3.0, "pessimistic by 3": 1.0 / 3.0}


@cache
def flight() -> Truth:
    """Make the true flight of ten minutes."""
    return fly(survey(), 600.0, 50.0)


def flown(grade: str, share: float, seed: int) -> tuple[Solution, Solution]:
    """Return the filtered and the smoothed solution of a flight with the errors of this seed."""
    inertial, rows = noised(flight(), GRADES[grade], Fixes(share=share, tau_s=60.0), ARM, seed)
    setup = replace(setup_for(GRADES[grade], ARM), gnss_correlated_share=share, position_floor_m=0.001)
    run = run_filter(inertial, rows, setup, drawn_start(flight(), seed))
    return forward(run), smooth(run)


def with_receivers(names: list[str], seeds: int) -> None:
    """Fly these receivers with both inertial units, and print a line for each kind."""
    heads = "".join(f"{part:>30}" for part in ("position", "velocity", "attitude"))
    print(f"{'NEES (99.8 %), ' + str(seeds) + ' flights':<30}{heads}   error / best: position, velocity, attitude")
    for name in names:
        for grade in ("tactical", "mems"):
            found: dict[str, list[FloatArray]] = {words: [] for words in ("known", *OPTIMISMS)}
            errors = {words: np.zeros((2, 9)) for words in OPTIMISMS}
            for seed in range(2000, 2000 + seeds):
                flights = compared(flight(), RECEIVERS[name], grade, seed, OPTIMISMS.values())
                for words, one in zip(OPTIMISMS, flights, strict=True):
                    found[words].append(squares(flight(), one.solved.smoothed, 5.0, 0.5))
                    errors[words] += one.squares(flight())
                found["known"].append(squares(flight(), one.best, 5.0, 0.5))
            for words, squared in found.items():
                nees = "".join(f"{of.mean:>12.3f} ({of.low:.3f} … {of.high:.3f})" for of in judge(squared).values())
                worst = ""
                if words in errors:
                    ratio = np.sqrt(errors[words][0] / errors[words][1]).reshape(3, 3).max(axis=1)
                    worst = "".join(f"{value:>8.3f}" for value in ratio)
                print(f"{f'{name}, {grade}, {words}':<34}{nees}  {worst}", flush=True)


def with_lasting(seeds: int) -> None:
    """Fly a receiver whose errors last for other times than assumed, and print a line for each."""
    receiver = RECEIVERS["UBX"]
    print(f"{'NEES (99.8 %), ' + str(seeds) + ' flights':<30}{'position':>24}   known   error / best   sigma / best")
    for share, tau_s in LASTING:
        found: tuple[list[FloatArray], list[FloatArray]] = ([], [])
        errors, variances = np.zeros((2, 9)), np.zeros((2, 3))
        other = replace(receiver, fixes=replace(receiver.fixes, share=share, tau_s=tau_s))
        for seed in range(2000, 2000 + seeds):
            (one,) = compared(flight(), other, "tactical", seed, (1.0,))
            errors += one.squares(flight())
            for row, solution in enumerate((one.solved.smoothed, one.best)):
                found[row].append(squares(flight(), solution, 5.0, 0.5))
                variances[row] += np.square(solution.position_sigma_l).mean(axis=0)
        solved, known = (judge(squared)["position"] for squared in found)
        ratio = float(np.sqrt(errors[0] / errors[1])[:3].max())
        wider = float(np.sqrt(variances[0].sum() / variances[1].sum()))
        interval = f"({solved.low:.2f} … {solved.high:.2f})"
        print(
            f"{f'{share:.0%} lasting {tau_s:.0f} s':<30}{solved.mean:>8.2f} {interval}{known.mean:>8.2f}{ratio:>15.3f}"
            f"{wider:>15.2f}",
            flush=True,
        )


@cache
def long_lines() -> Truth:
    """Make a true flight of ten minutes with lines of 90 s; only the turns between them show the heading."""
    return fly(survey(line_s=150.0), 600.0, 50.0)


def with_headings(grades: list[str], seeds: int) -> None:
    """Fly receivers with two antennas and several kinds of heading errors, and print a line for each."""
    head = f"{'NEES (99.8 %), ' + str(seeds) + ' flights':<50}{'attitude':>24}"
    print(f"{head}   errors / best: worst, heading   sigma / best")
    for grade in grades:
        for name, receiver in DUAL_ANTENNAS.items():
            found: dict[str, list[FloatArray]] = {words: [] for words in ("known", *OPTIMISMS)}
            errors = {words: np.zeros((2, 9)) for words in OPTIMISMS}
            variances = {words: np.zeros(2) for words in OPTIMISMS}
            for seed in range(2000, 2000 + seeds):
                flights = compared(long_lines(), receiver, grade, seed, OPTIMISMS.values())
                for words, one in zip(OPTIMISMS, flights, strict=True):
                    found[words].append(squares(long_lines(), one.solved.smoothed, 5.0, 0.5))
                    errors[words] += one.squares(long_lines())
                    both = one.solved.smoothed, one.best
                    variances[words] += [np.square(run.attitude_sigma_rad[:, 2]).mean() for run in both]
                found["known"].append(squares(long_lines(), one.best, 5.0, 0.5))
            for words, squared in found.items():
                of = judge(squared)["attitude"]
                line = f"{f'{name}, {grade}, {words}':<50}{of.mean:>8.2f} ({of.low:.2f} … {of.high:.2f})"
                if words in errors:
                    ratio = np.sqrt(errors[words][0] / errors[words][1])
                    wider = float(np.sqrt(variances[words][0] / variances[words][1]))
                    line += f"{ratio[6:].max():>12.3f}{ratio[8]:>8.3f}{wider:>12.2f}"
                print(line, flush=True)


def main() -> None:
    """Fly and print the table of the chosen kind."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=50, help="flights of each kind")
    parser.add_argument("--receivers", nargs="*", choices=RECEIVERS, help="fly these receivers; without a name, all")
    parser.add_argument("--lasting", action="store_true", help="fly errors that last for other times than assumed")
    parser.add_argument(
        "--headings",
        nargs="*",
        choices=("tactical", "mems"),
        help="fly two antennas with these grades; without a name, both",
    )
    arguments = parser.parse_args()
    if arguments.receivers is not None:
        with_receivers(arguments.receivers or list(RECEIVERS), arguments.seeds)
        return
    if arguments.headings is not None:
        with_headings(arguments.headings or ["tactical", "mems"], arguments.seeds)
        return
    if arguments.lasting:
        with_lasting(arguments.seeds)
        return
    print(f"{'':<28}{'part':<10} {'NEES':>6} {'interval':>14} {'independent':>12}")
    for grade in ("tactical", "mems"):
        for share in (0.0, 0.7):
            filtered, smoothed, moments, neighbours = [], [], [], []
            for seed in range(1000, 1000 + arguments.seeds):
                ahead, behind = flown(grade, share, seed)
                filtered.append(squares(flight(), ahead, 60.0, 0.5))
                smoothed.append(squares(flight(), behind, 5.0, 0.5))
                innovations = ahead.innovations[ahead.innovations["fate"] <= Fate.REACQUIRED]["normalised"][30:]
                moments.append(np.mean(innovations**2))
                neighbours.append((innovations[1:] * innovations[:-1]).mean(axis=0) / (innovations**2).mean(axis=0))
            name = f"{grade}, {'lasting' if share else 'white'}"
            for what, flights in (("filtered", filtered), ("smoothed", smoothed)):
                for part, of in judge(flights).items():
                    mark = "" if of.holds else "  outside"
                    text = f"{of.low:.3f} … {of.high:.3f}"
                    print(
                        f"{name + ', ' + what:<28}{part:<10} {of.mean:>6.3f} {text:>14} {of.independent:>12,.0f}{mark}"
                    )
            alike = float(np.abs(np.mean(neighbours, axis=0)).max())
            chance = 1.0 / np.sqrt(arguments.seeds * len(innovations))
            print(f"{name}: innovations' second moment {np.mean(moments):.3f}, neighbours {alike:.4f} ± {chance:.4f}")


if __name__ == "__main__":
    main()
