"""Whether the sigmas of the strips' diagnosis hold: a virtual flight, its trajectory wrong as navigation expects it.

python -m benchmarks.strip_diagnosis [--runs 50] [--flight FOLDER] [--json FILE]

A flight over a village is flown and read on its true trajectory with the true calibration; the same log is navigated
for the smoother's joint covariance. In every run the trajectory gets errors drawn from that covariance and every range
its noise, the strips are compared and diagnosed with it, and with nothing but the trajectory's sigmas. NEES is the mean
square of what is told of an effect (nothing is wrong with the calibration) in its sigmas. Exit status 1 where, with the
covariance, it is not within 0.8 to 1.25 for all effects together.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calib.effects import NAMES, SeenFrom
from calib.flight import Flight
from calib.signatures import signatures
from calib.strip_cells import StripRules
from calib.strips import differences
from calib.trajectory_errors import TrajectoryPrior, apply, draw
from daemon.processing.calibration_flight import read_flight, smoothed_prior
from daemon.processing.flights import Wish
from daemon.processing.flown import TrajectoryWish
from daemon.processing.setup import Options
from tests.calib.village import Made, village

FloatArray = NDArray[np.float64]

NEES = (0.8, 1.25)
RULES = StripRules(cell_m=2.0, most_cells=4000)
SEED = 20_261


def prior_of(made: Made, folder: Path) -> TrajectoryPrior:
    """Navigate the flight's log for the joint covariance of its errors."""
    folder.mkdir()
    wish = Wish([made.flown.log], folder, TrajectoryWish(navigate=True), Options(datum="same", uncertainty=False))
    prior = smoothed_prior(read_flight(wish, folder, lambda *_: None))
    assert prior is not None
    return prior


def once(
    truth: Flight, made: Made, prior: TrajectoryPrior, rng: np.random.Generator
) -> list[tuple[FloatArray, FloatArray]]:
    """Return values and sigmas (effects,) of one run: with the covariance, and with the trajectory's sigmas alone."""
    (trajectory,) = truth.trajectories
    wrong = apply(trajectory, 0, prior, -draw(prior, rng))
    swaths = []
    for swath in truth.swaths:
        rows = swath.rows.copy()
        rows["range_m"] += 0.02 * rng.standard_normal(len(rows))
        swaths.append(replace(swath, rows=rows))
    flight = replace(truth, trajectories=(wrong,), swaths=tuple(swaths)).placed({"left": made.truth})
    checks, seen = differences(flight, RULES).checks, SeenFrom.of(flight)
    found = []
    for known in (prior, None):
        told = signatures(checks, seen, known).found
        found.append((np.array([one.value for one in told]), np.array([one.sigma for one in told])))
    return found


def with_sigmas(made: Made, prior: TrajectoryPrior) -> Flight:
    """Return the flight on its true trajectory, which tells the sigmas that navigation has along the strips."""
    sigmas = np.sqrt(np.mean(prior.sigmas() ** 2, axis=0))
    count = len(made.trajectory)
    angles = np.hypot(*sigmas[3:5]) / np.sqrt(2.0)
    told = replace(
        made.trajectory,
        position_sigma_l=np.tile(sigmas[:3], (count, 1)),
        attitude_sigma_rad=np.tile([angles, angles, sigmas[5]], (count, 1)),
    )
    return replace(made.flight, trajectories=(told,))


def main() -> int:
    """Fly, run, tell."""
    parser = argparse.ArgumentParser(description="Whether the sigmas of the strips' diagnosis hold.")
    parser.add_argument("--runs", type=int, default=50)
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    begun_s = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="swath-") as name:
        folder = Path(name)
        made = village(folder, prf_hz=8_000.0, lines=(0, 1, 2, 3))
        prior = prior_of(made, folder / "navigated")
        truth = with_sigmas(made, prior)
        print(f"{len(prior)} knots; flown and navigated in {time.monotonic() - begun_s:.0f} s", flush=True)
        runs = []
        for seed in np.random.SeedSequence(SEED).spawn(asked.runs):
            runs.append(once(truth, made, prior, np.random.default_rng(seed)))
            print(f"\r{len(runs)} of {asked.runs} runs, {time.monotonic() - begun_s:.0f} s", end="", file=sys.stderr)
    print(file=sys.stderr)
    figures, good = {}, True
    for at, words in enumerate(("joint covariance", "sigmas alone")):
        values, sigmas = (np.array([run[at][which] for run in runs]) for which in (0, 1))
        square = (values / sigmas) ** 2
        figures[words] = {
            name: float(np.nanmean(square[:, k])) for k, name in enumerate(NAMES) if np.isfinite(square[:, k]).any()
        }
        figures[words]["all"] = float(np.nanmean(square))
        figures[words]["above 3.29"] = float((np.abs(values / sigmas) > 3.29).sum())
        figures[words]["told"] = int(np.isfinite(square).sum())
        print(words, "  ".join(f"{key} {value:.2f}" for key, value in figures[words].items()))
        for k, name in enumerate(NAMES):
            if np.isfinite(sigmas[:, k]).any():
                print(
                    f"    {name}: median sigma {np.nanmedian(sigmas[:, k]):.2e}, of {np.isfinite(sigmas[:, k]).sum()}"
                )
        good &= at == 1 or NEES[0] <= figures[words]["all"] <= NEES[1]
    if asked.json is not None:
        asked.json.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    return 0 if good else 1


if __name__ == "__main__":
    raise SystemExit(main())
