"""Test the sigmas of the strips' diagnosis on a virtual flight whose trajectory errs as navigation predicts.

python -m benchmarks.strip_diagnosis [--runs 50] [--json FILE]

A flight over a village (east, west, south, north) is simulated to a log and navigated, which gives the joint covariance
of the smoother's errors along the four strips. Strips along the same lines are then cast with the true calibration on a
true trajectory. Every run adds trajectory errors drawn from that covariance, and noise to every range. The strips are
compared and diagnosed twice: with the covariance, and with the trajectory's sigmas alone. The calibration is right, so
every effect found should be zero; NEES is the mean square of an effect divided by its sigma. Exit status 1 if, with the
covariance, the NEES of all effects together is not within 0.8 to 1.25.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from swath.calib.equations.trajectory_prior import TrajectoryPrior, apply, draw
from swath.calib.flight import Flight
from swath.calib.strips.cells import StripRules
from swath.calib.strips.differences import differences
from swath.calib.strips.effects import NAMES, SeenFrom
from swath.calib.strips.signatures import signatures
from swath.daemon.processing.calibration.returns import read_flight, smoothed_prior
from swath.daemon.processing.flights.read import GeorefOptions
from swath.daemon.processing.flights.trajectory_choice import TrajectoryOptions
from swath.daemon.processing.setup.setup import Options
from swath.georef.arrays import FloatArray
from swath.georef.scanner.calibration import Calibration
from tests.calib.cast_flight import cast_flight
from tests.calib.village import village

NEES = (0.8, 1.25)
WAYS = ("joint covariance", "sigmas alone")
RULES = StripRules(most_cells=3000)
RANGE_SIGMA_M = 0.02
SEED = 20_261


def prior_of(folder: Path) -> TrajectoryPrior:
    """Make the log of a flight, navigate it and return the joint covariance of its trajectory errors."""
    made = village(folder, prf_hz=2_000.0, lines=(0, 1, 2, 3))
    work = folder / "navigated"
    work.mkdir()
    georef_options = GeorefOptions(
        [made.flown.log], work, TrajectoryOptions(navigate=True), Options(datum="same", uncertainty=False)
    )
    prior = smoothed_prior(read_flight(georef_options, work, lambda *_: None))
    assert prior is not None
    return prior


def along(prior: TrajectoryPrior, flight: Flight) -> TrajectoryPrior:
    """Return the covariance with its knots moved to the strips of another flight along the same lines, in order."""
    time_ns = prior.time_ns.copy()
    for swath, strip in zip(flight.swaths, np.unique(prior.strip).tolist(), strict=True):
        own = prior.strip == strip
        since = (time_ns[own] - time_ns[own][0]) / (time_ns[own][-1] - time_ns[own][0])
        time_ns[own] = swath.time_ns[0] + np.rint(since * (swath.time_ns[-1] - swath.time_ns[0])).astype(np.int64)
    return replace(prior, time_ns=time_ns)


def with_sigmas(flight: Flight, prior: TrajectoryPrior) -> Flight:
    """Return the flight with a trajectory whose sigmas are those of the covariance along the strips."""
    (trajectory,) = flight.trajectories
    sigmas = np.sqrt(np.mean(prior.sigmas() ** 2, axis=0))
    tilt = math.hypot(*sigmas[3:5]) / math.sqrt(2.0)
    reported = replace(
        trajectory,
        position_sigma_l=np.tile(sigmas[:3], (len(trajectory), 1)),
        attitude_sigma_rad=np.tile([tilt, tilt, sigmas[5]], (len(trajectory), 1)),
    )
    return replace(flight, trajectories=(reported,))


def once(
    truth: Flight, calibration: Calibration, prior: TrajectoryPrior, rng: np.random.Generator
) -> list[tuple[FloatArray, FloatArray]]:
    """Return values and sigmas (effects,) of one run: with the covariance, and with the trajectory's sigmas alone."""
    (trajectory,) = truth.trajectories
    wrong = apply(trajectory, 0, prior, -draw(prior, rng))
    swaths = []
    for swath in truth.swaths:
        rows = swath.rows.copy()
        rows["range_m"] += RANGE_SIGMA_M * rng.standard_normal(len(rows))
        swaths.append(replace(swath, rows=rows))
    flight = replace(truth, trajectories=(wrong,), swaths=tuple(swaths)).placed({"left": calibration})
    checks, seen = differences(flight, RULES).checks, SeenFrom.of(flight)
    found = []
    for known in (prior, None):
        effects = signatures(checks, seen, known).found
        found.append((np.array([one.value for one in effects]), np.array([one.sigma for one in effects])))
    return found


def tell(runs: Sequence[Sequence[tuple[FloatArray, FloatArray]]]) -> dict[str, dict[str, float]]:
    """Print the figures and return them."""
    figures: dict[str, dict[str, float]] = {}
    for at, words in enumerate(WAYS):
        values, sigmas = (np.array([run[at][which] for run in runs]) for which in (0, 1))
        normalised = values / sigmas
        known = np.isfinite(normalised)
        row = {"all": float(np.mean(normalised[known] ** 2)), "told": float(known.sum())}
        row["beyond 3.29"] = float((np.abs(normalised[known]) > 3.29).sum())
        print(words, "  ".join(f"{key} {value:.4g}" for key, value in row.items()))
        for k, name in enumerate(NAMES):
            if known[:, k].any():
                row[name] = float(np.mean(normalised[known[:, k], k] ** 2))
                size = math.sqrt(float(np.mean(sigmas[known[:, k], k] ** 2)))
                print(f"    {name}: NEES {row[name]:.2f} of {known[:, k].sum()}, sigma {size:.3g} (SI)")
        figures[words] = row
    return figures


def main() -> int:
    """Measure and print the figures; return 1 if the NEES is outside its limits."""
    parser = argparse.ArgumentParser(description="Test the sigmas of the strips' diagnosis on a virtual flight.")
    parser.add_argument("--runs", type=int, default=50)
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="swath-") as name:
        prior = prior_of(Path(name))
    figures = tell(run_all(prior, asked.runs))
    if asked.json is not None:
        asked.json.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    return 0 if NEES[0] <= figures[WAYS[0]]["all"] <= NEES[1] else 1


def run_all(prior: TrajectoryPrior, count: int) -> list[list[tuple[FloatArray, FloatArray]]]:
    """Run all seeds and return their values and sigmas."""
    begun_s = time.monotonic()
    made = cast_flight(prf_hz=20_000.0, range_sigma_m=0.0, angle_sigma_rad=0.0)
    moved = along(prior, made.flight)
    truth = with_sigmas(made.flight, moved)
    runs = []
    for seed in np.random.SeedSequence(SEED).spawn(count):
        runs.append(once(truth, made.truth, moved, np.random.default_rng(seed)))
        print(f"\r{len(runs)} of {count} runs, {time.monotonic() - begun_s:.0f} s", end="", file=sys.stderr)
    print(file=sys.stderr)
    return runs


if __name__ == "__main__":
    raise SystemExit(main())
