"""Test the sigmas of a calibration on virtual flights of many designs, for estimated and for held parameters.

    python -m benchmarks.calibration.designs --flights 200

Each flight draws:

- a design: one line, two opposite, two crossing, three, three parallel, six at one height, or eight at two heights;
  low or high; roofs or level ground; with or without control points;
- a grade of inertial unit, and a model;
- noise, and errors of the trajectory, drawn from their prior;
- an error of every parameter of the model, boresight and range offset included, as large as is plausible for it; lever
  arms that the model does not estimate get the error that a survey leaves.

The planes are given, so that the test concerns the adjustment, its choice of held parameters, and the sigmas. Ranges
are made with the formulas of docs/conventions.md, without the code of georef. A parameter, estimated or held,
that is further than four of its sigmas from the truth is a failure; one in 500 may fail.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from swath.calib.adjust import adjust
from swath.calib.equations.normals import NormalError, TrajectoryWeight
from swath.calib.equations.rows import Rows
from swath.calib.equations.solve import Settings
from swath.calib.equations.trajectory_prior import Taus, gauss_markov
from swath.calib.features import ControlPoint, Features
from swath.calib.outcome import Adjusted
from swath.calib.parameters import INSTALLED, MODELS, ParameterOptions, unknowns
from swath.georef.scanner.calibration import INDEX, PARAMETERS, nominal
from tests.calib.builders import shifted
from tests.calib.roofs import LINES, Line, Made, made, roofs, trajectory

LIMIT = 4.0  # sigmas
ALLOWED = 1.0 / 500.0
DESIGNS: dict[str, tuple[Line, ...]] = {
    "one": LINES[:1],
    "two opposite": LINES[:2],
    "two crossing": (LINES[0], LINES[4]),
    "three": (LINES[0], LINES[1], LINES[4]),
    "three parallel": LINES[:3],
    "six": LINES[:6],
    "two heights": LINES,
}
NOT_MADE = ("scan_angle_offset_rad", "encoder_latency_s", "torsion_s2")  # not modelled by `tests.calib.roofs.ranges`
GRADES = {"tactical": 1.0, "MEMS": 6.0}  # factor on the attitude sigmas of the tactical unit
MODEL_NAMES = ("basic", "scanner", "full")


@dataclass(frozen=True)
class Case:
    """Choices that define one flight.

    Attributes:
        seed: seed of all that is drawn.
        design, grade, model: keys of the tables above.
        scale: factor on the heights above ground.
        slope_deg: slope of the roofs; 0: level ground only.
        control: whether level planes have control points of 1 cm.
    """

    seed: int
    design: str
    grade: str
    model: str
    scale: float
    slope_deg: float
    control: bool

    @property
    def words(self) -> str:
        """Description of the case for the printed lines."""
        ground = "roofs" if self.slope_deg else "level"
        control = "control" if self.control else "no control"
        return f"{self.design}, × {self.scale:g}, {ground}, {control}, {self.grade}, {self.model}"


@dataclass(frozen=True)
class Offset:
    """The error of one parameter in sigmas, and whether the parameter was held."""

    case: Case
    name: str
    normalised: float
    held: bool


def case_of(seed: int) -> Case:
    """Draw the choices of a flight from its seed."""
    rng = np.random.default_rng(seed)
    return Case(
        seed,
        str(rng.choice(list(DESIGNS))),
        str(rng.choice(list(GRADES))),
        str(rng.choice(MODEL_NAMES)),
        float(rng.choice([0.25, 1.0, 2.0])),
        float(rng.choice([35.0, 35.0, 35.0, 0.0])),
        bool(rng.integers(2)),
    )


def lines_of(case: Case) -> tuple[Line, ...]:
    """Return the design's lines, with heights and distances aside scaled by the case's factor."""
    return tuple(
        Line(one.heading_deg, case.scale * one.height_m, case.scale * one.aside_m) for one in DESIGNS[case.design]
    )


def true_errors(case: Case) -> dict[str, float]:
    """Return each parameter's error at the start, SI, except for those that the made ranges do not model."""
    rng = np.random.default_rng([case.seed, 1])
    names = MODELS[case.model if case.model == "full" else "scanner"]
    known = {name: PARAMETERS[INDEX[name]].plausible for name in names}
    sizes = {**INSTALLED, **known}
    return {name: size * float(rng.normal()) for name, size in sizes.items() if name not in NOT_MADE}


def flight_of(case: Case) -> tuple[Made, Features]:
    """Make the flight of a case and its features.

    The trajectory that the adjustment gets differs from the true one by errors drawn from their prior.
    """
    lines, rng = lines_of(case), np.random.default_rng([case.seed, 2])
    reported = trajectory(lines)
    reported = replace(reported, attitude_sigma_rad=reported.attitude_sigma_rad * GRADES[case.grade])
    squeeze = min(case.scale, 1.0)
    planes = [(centre * [squeeze, squeeze, 1.0], normal) for centre, normal in roofs(case.slope_deg)]
    base = made(lines=lines, planes=planes, points=2, seed=case.seed)
    flight = replace(base.flight, trajectories=(reported,))
    prior = gauss_markov(flight, Taus(), 4.0)
    weight = TrajectoryWeight(Rows(flight, (), unknowns(flight, ParameterOptions()), prior))
    draw = np.linalg.cholesky(prior.covariance) @ rng.normal(size=len(prior.covariance))
    true = shifted(reported, prior, weight.to_e(draw[:, np.newaxis]).reshape(-1, 6))
    start = nominal("left", base.flight.heads[0].start.lever_arm_b, np.eye(3))
    truth = {name: start.value(name) + error for name, error in true_errors(case).items()}
    built = made(truth=truth, lines=lines, planes=planes, points=24, seed=case.seed, true=true)
    head = replace(built.flight.heads[0], start=start)
    flight = replace(built.flight, heads=(head,), trajectories=(reported,)).placed({"left": start})
    features = surveyed(built.features, rng) if case.control else built.features
    return replace(built, flight=flight), features


def surveyed(features: Features, rng: np.random.Generator) -> Features:
    """Return the features with a control point of 1 cm on every level plane."""
    planes = tuple(
        replace(
            plane, control=(ControlPoint(plane.name, plane.centre_t + np.array([0.0, 0.0, 0.01 * rng.normal()]), 0.01),)
        )
        if plane.normal_t[2] > 0.999
        else plane
        for plane in features.planes
    )
    return Features(planes)


def offsets_of(case: Case) -> list[Offset]:
    """Return every parameter's error in its sigmas; an empty list if the flight cannot be adjusted."""
    built, features = flight_of(case)
    prior = gauss_markov(built.flight, Taus(), 4.0)
    try:
        found = adjust(built.flight, features, ParameterOptions(case.model), prior, Settings(huber=0.0, family=0.0))
    except NormalError:
        return []
    return normalised(case, built, found)


def normalised(case: Case, built: Made, found: Adjusted) -> list[Offset]:
    """Return the errors of estimated and of held parameters, divided by their sigmas."""
    offsets: list[Offset] = []
    for name, value, sigma in zip(found.names, found.values.tolist(), found.sigmas.tolist(), strict=True):
        short = name.partition(".")[2]
        offsets.append(Offset(case, short, (value - built.truth.value(short)) / sigma, held=False))
    for one in found.considered:
        offsets.append(Offset(case, one.name, (one.value - built.truth.value(one.name)) / one.sigma, held=True))
    return offsets


def run(seeds: Sequence[int], minutes: float) -> tuple[list[Offset], int]:
    """Fly all seeds, or as many as the time allows; return the offsets and the number of flights."""
    offsets: list[Offset] = []
    begin = time.monotonic()
    for count, seed in enumerate(seeds):
        if time.monotonic() - begin > 60.0 * minutes:
            return offsets, count
        mine = offsets_of(case_of(seed))
        offsets += mine
        for one in mine:
            if abs(one.normalised) > LIMIT:
                print(
                    f"seed {seed}: {one.name}{' (held)' if one.held else ''} {one.normalised:+.1f}: {one.case.words}",
                    flush=True,
                )
    return offsets, len(seeds)


def main() -> None:
    """Fly and print how many parameters are further than four sigmas from the truth."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--flights", type=int, default=200)
    parser.add_argument("--first", type=int, default=1, help="first seed")
    parser.add_argument("--minutes", type=float, default=1e9, help="begin no flight after so many minutes")
    given = parser.parse_args()
    offsets, flights = run(range(given.first, given.first + given.flights), given.minutes)
    estimated = [one for one in offsets if not one.held]
    beyond = [one for one in offsets if abs(one.normalised) > LIMIT]
    squares: dict[str, list[float]] = {}
    for one in estimated:
        squares.setdefault(one.name, []).append(one.normalised**2)
    for name, mine in squares.items():
        print(f"{name:22} {len(mine):5} estimates  NEES {np.mean(mine):.2f}  largest {np.sqrt(max(mine)):.1f} sigmas")
    print(
        f"flights {flights}, parameters {len(offsets)} ({len(estimated)} estimated), "
        f"beyond {LIMIT:g} sigmas {len(beyond)}"
    )
    print(dict(Counter(one.case.design for one in beyond)))
    print(
        "limit met"
        if len(beyond) <= max(ALLOWED * len(offsets), 0)
        else f"LIMIT NOT MET: more than one in {1 / ALLOWED:.0f}"
    )


if __name__ == "__main__":
    main()
