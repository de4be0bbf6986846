"""Test the sigmas of a calibration against the virtual aircraft's truth, over many runs and over whole flights.

python -m benchmarks.calibration.accuracy --runs 400 [--flight FOLDER] [--rows 200000] [--json FILE]
python -m benchmarks.calibration.accuracy --seeds 5 [--json FILE]

`--runs`: every run draws new observations (`benchmarks.calibration.runs`), with the sensors' noise and the covariance
of the smoothed trajectory, and adjusts them; it starts from the nominal installation. NEES is the mean square of a
parameter's error divided by its sigma; coverage is how often the truth lies within 1.96 sigmas.

`--seeds`: whole flights of the preset `calibration`, with new noise of every sensor, go through `swath sim fly` and
`swath calibrate`, which gets nothing but the logs and the control points.

All random numbers follow from the master seed in seed.toml. Exit status 1 if a limit is not met.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import pickle
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.calibration.runs import Outcome, Reference, read_reference, run
from swath.georef.arrays import FloatArray
from swath.georef.scanner.calibration import PARAMETERS, read_calibration

ROOT = Path(__file__).resolve().parents[2]
SEED_FILE = Path(__file__).with_name("seed.toml")
NEES, COVERAGE = (0.8, 1.25), (92.0, 98.0)
EACH = {"omega_deg": 0.004, "phi_deg": 0.004, "kappa_deg": 0.008, "range_offset_m": 0.01}
RMS = {"omega_deg": 0.002, "phi_deg": 0.002, "kappa_deg": 0.004}
SHOWN = {"range_offset_m": ("range_offset_mm", 1e3)}
BATCH = 20  # runs per task of a worker process

_reference: list[Reference] = []


def master_seed() -> int:
    """Return the seed from which all others follow."""
    return int(tomllib.loads(SEED_FILE.read_text("utf-8"))["master"])


def flight_seeds(count: int) -> list[int]:
    """Return the seeds of the virtual flights; the first one is that of the runs' flight."""
    return [int(one.generate_state(1)[0]) for one in np.random.SeedSequence([master_seed(), 1]).spawn(count)]


def swath(*arguments: str) -> str:
    """Run a command of swath and return what it prints.

    Raises:
        SystemExit: the command failed.
    """
    command = [sys.executable, "-m", "swath.daemon.cli.main", *arguments]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"swath {' '.join(arguments)}: {done.stderr.strip().splitlines()[-1:]}")
    return done.stdout


# ---------------------------------------------------------------------- many runs


def take(file: str) -> None:
    """Load the reference into a worker process, before its first run."""
    _reference.append(pickle.loads(Path(file).read_bytes()))


def runs_of(task: tuple[FloatArray, Sequence[np.random.SeedSequence]]) -> list[Outcome]:
    """Return the outcomes of one task's runs."""
    return [run(_reference[0], errors, seed) for errors, seed in zip(*task, strict=True)]


def many(folder: Path, work: Path, count: int, rows: int, workers: int) -> list[Outcome]:
    """Return the outcomes of all runs, in order; worker processes share the runs."""
    begun_s = time.monotonic()
    reference, root = read_reference(folder, work, rows, workers)
    drawing, *seeds = np.random.SeedSequence([master_seed(), 2]).spawn(count + 1)
    errors = (root @ np.random.default_rng(drawing).standard_normal((len(root), count))).T.reshape(count, -1, 6)
    del root
    file = work / "reference.pickle"
    file.write_bytes(pickle.dumps(reference))
    taken = sum(plane.points for plane in reference.features.planes)
    print(f"{taken:,} returns on {len(reference.features.planes)} planes in {len(reference.flight.swaths)} strips")
    print(f"read and matched in {time.monotonic() - begun_s:.0f} s", flush=True)
    tasks = [(errors[at : at + BATCH], seeds[at : at + BATCH]) for at in range(0, count, BATCH)]
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    outcomes: list[Outcome] = []
    with multiprocessing.get_context("spawn").Pool(workers, take, (str(file),)) as pool:
        for found in pool.imap(runs_of, tasks):
            outcomes += found
            print(f"\r{len(outcomes)} of {count} runs, {time.monotonic() - begun_s:.0f} s", end="", file=sys.stderr)
    print(file=sys.stderr)
    return outcomes


def unit_of(name: str) -> tuple[str, float]:
    """Return the key and the factor from SI to the key's unit, for a parameter such as ``left.omega_rad``."""
    bare = name.split(".", 1)[1]
    for parameter in PARAMETERS:
        if parameter.name == bare:
            return parameter.key, 1.0 / parameter.factor
    return bare, 1.0


def judged(outcomes: Sequence[Outcome]) -> tuple[dict[str, dict[str, float]], bool]:
    """Return the figures of each parameter, and whether all limits are met."""
    error, sigma = (np.array([getattr(one, what) for one in outcomes]) for what in ("error", "sigma"))
    table, good = {}, all(one.converged for one in outcomes)
    for place, name in enumerate(outcomes[0].names):
        key, factor = unit_of(name)
        off = error[:, place] / sigma[:, place]
        figures = {
            "mean": factor * float(error[:, place].mean()),
            "rms": factor * float(np.sqrt((error[:, place] ** 2).mean())),
            "sigma": factor * float(sigma[:, place].mean()),
            "nees": float((off**2).mean()),
            "coverage": 100.0 * float((np.abs(off) < 1.96).mean()),
        }
        good &= NEES[0] <= figures["nees"] <= NEES[1] and COVERAGE[0] <= figures["coverage"] <= COVERAGE[1]
        table[key] = figures
    return table, good


def show_runs(table: dict[str, dict[str, float]], outcomes: Sequence[Outcome]) -> None:
    """Print the table of the runs."""
    want = f"{NEES[0]} … {NEES[1]}", f"{COVERAGE[0]:.0f} … {COVERAGE[1]:.0f} %"
    print(f"{'':<22}{'mean':>11}{'RMS':>11}{'sigma':>11}{'NEES':>12}{'95 %':>12}")
    print(f"{'':<22}{'':>33}{want[0]:>12}{want[1]:>12}")
    for key, one in table.items():
        print(
            f"{key:<22}{one['mean']:>11.5f}{one['rms']:>11.5f}{one['sigma']:>11.5f}{one['nees']:>12.3f}"
            f"{one['coverage']:>10.1f} %"
        )
    factors = {name: np.mean([one.groups[name] for one in outcomes]) for name in outcomes[0].groups}
    by_group = ", ".join(f"{name} {factor:.3f}" for name, factor in factors.items())
    print(f"variance factor {np.mean([one.variance_factor for one in outcomes]):.3f}: {by_group}")


# ---------------------------------------------------------------------- whole flights


def end_to_end(folder: Path, seed: int) -> dict[str, tuple[float, float]]:
    """Fly and calibrate a flight of this seed; return each parameter's error and sigma by key."""
    swath("sim", "fly", "calibration", "-o", str(folder), "--seed", str(seed), "--no-truth")
    made, control = folder / "found.toml", folder / "control.csv"
    swath("calibrate", str(folder), "-o", str(made), "--control", str(control), "--trajectory-datum", "same")
    found = read_calibration(made.read_text("utf-8"), made.name)
    (file,) = folder.glob("*.true.toml")
    truth = read_calibration(file.read_text("utf-8"), file.name)
    errors = {}
    for place, parameter in enumerate(PARAMETERS):
        sigma = float(found.sigmas[place])
        if sigma > 0.0:
            error = found.value(parameter.name) - truth.value(parameter.name)
            errors[parameter.key] = (error / parameter.factor, sigma / parameter.factor)
    return errors


def flights(work: Path, first: int, count: int) -> dict[int, dict[str, tuple[float, float]]]:
    """Fly and calibrate the flights of all seeds, and print each result."""
    found = {}
    for seed in flight_seeds(first + count)[first:]:
        begun_s = time.monotonic()
        with tempfile.TemporaryDirectory(prefix="flight-", dir=work) as folder:
            found[seed] = end_to_end(Path(folder), seed)
        errors = ", ".join(f"{key} {error:+.5f} ± {sigma:.5f}" for key, (error, sigma) in found[seed].items())
        print(f"seed {seed} ({time.monotonic() - begun_s:.0f} s): {errors}", flush=True)
    return found


def show_flights(found: dict[int, dict[str, tuple[float, float]]], spread: dict[str, float]) -> bool:
    """Print the table of the whole flights, and return whether all limits are met.

    Beside each parameter stands the RMS of its error in the runs, if these were made.
    """
    keys = list(next(iter(found.values())))
    good = True
    print(f"{'':<22}{'greatest':>11}{'limit':>9}{'RMS':>11}{'limit':>9}{'in sigmas':>11}{'spread of runs':>16}")
    for key in keys:
        each = np.array([one[key] for one in found.values() if key in one])
        greatest, rms = float(np.abs(each[:, 0]).max()), float(np.sqrt((each[:, 0] ** 2).mean()))
        in_sigmas = float(np.sqrt(((each[:, 0] / each[:, 1]) ** 2).mean()))
        good &= greatest <= EACH.get(key, np.inf) and rms <= RMS.get(key, np.inf)
        limits = [f"{table[key]:.3f}" if key in table else "" for table in (EACH, RMS)]
        runs = f"{spread[key]:.5f}" if key in spread else ""
        print(f"{key:<22}{greatest:>11.5f}{limits[0]:>9}{rms:>11.5f}{limits[1]:>9}{in_sigmas:>11.2f}{runs:>16}")
    return good


def main() -> None:
    """Measure and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=0, help="number of runs with drawn observations")
    parser.add_argument("--seeds", type=int, default=0, help="number of whole flights, from simulation to calibration")
    parser.add_argument("--first", type=int, default=0, help="index of the first seed, to fly only part of them")
    parser.add_argument("--rows", type=int, default=200_000, help="number of returns on planes in a run")
    parser.add_argument("--flight", type=Path, help="flight of the runs, made by swath sim fly; default: make one")
    parser.add_argument("--work", type=Path, help="folder for flights and returns, some 5 GB; default: a temporary one")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="number of worker processes")
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    arguments = parser.parse_args()
    if not arguments.runs and not arguments.seeds:
        parser.error("nothing to measure: give --runs N, --seeds N or both")
    print(f"master seed {master_seed()}")
    figures: dict[str, Any] = {"master": master_seed()}
    good, spread = True, {}
    with tempfile.TemporaryDirectory(prefix="swath-accuracy-", dir=arguments.work) as folder:
        work = Path(folder)
        if arguments.runs:
            flight = arguments.flight
            if flight is None:
                flight = work / "flight"
                swath("sim", "fly", "calibration", "-o", str(flight), "--seed", str(flight_seeds(1)[0]), "--no-truth")
            outcomes = many(flight, work, arguments.runs, arguments.rows, arguments.workers)
            figures["runs"], kept = judged(outcomes)
            show_runs(figures["runs"], outcomes)
            spread, good = {key: one["rms"] for key, one in figures["runs"].items()}, good and kept
        if arguments.seeds:
            figures["seeds"] = flights(work, arguments.first, arguments.seeds)
            good = show_flights(figures["seeds"], spread) and good
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=1))
    print("all limits met" if good else "a limit is not met")
    raise SystemExit(0 if good else 1)


if __name__ == "__main__":
    main()
