"""Tests profiles beside an adjustment: what moves them, and sigmas with trajectory errors that change in time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from swath.calib.adjust import adjust
from swath.calib.equations.trajectory_prior import Taus, TrajectoryPrior, apply, draw, gauss_markov
from swath.calib.features import ControlPoint
from swath.calib.flight import Flight
from swath.calib.outcome import Adjusted
from swath.calib.parameters import ParameterOptions
from swath.calib.planes.search import find_planes
from swath.calib.profiles.check import CHECK, check, compare
from swath.calib.profiles.influence import influence
from swath.calib.profiles.measure import KINDS, PARAMETER
from swath.calib.profiles.stepwise import Given, Profile, survey
from swath.daemon.processing.calibration.report.profiles import (
    comparison_table,
    formulas_table,
    pictures,
    profiles_table,
)
from swath.daemon.processing.pages.blocks import Table
from swath.georef.arrays import FloatArray
from tests.calib.analytic_scene import Line, Scanner, fly, gables
from tests.calib.roofs import exactly_known

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("kernels")]

LINES = (Line(-145, 0, 90, 290, 300), Line(145, 10, 270, 290, 300), Line(-145, 110, 90, 290, 300))
CONTROL = [
    ControlPoint(f"c{k}", np.array([x, y, 0.0]), 0.01)
    for k, (x, y) in enumerate([(-132.0, 20.0), (-132.0, -60.0), (-132.0, 80.0), (132.0, 40.0)])
]
NAMES = tuple(f"left.{PARAMETER[kind]}" for kind in KINDS)
TAUS = Taus(3.0, 3.0, 3.0)  # shorter than a line, so constants of a line would be no good model
DRAWS = 8


@pytest.fixture(scope="module")
def flight() -> Flight:
    return fly(LINES, gables(), scanner=Scanner(prf_hz=10_000.0))


@pytest.fixture(scope="module")
def prior(flight: Flight) -> TrajectoryPrior:
    return gauss_markov(flight, TAUS, knot_s=0.5)


def known(flight: Flight) -> Adjusted:
    """Return an outcome that equals the truth and is known exactly."""
    none = np.zeros(len(NAMES))
    return Adjusted(
        calibrations=flight.starts(),
        names=NAMES,
        start=none,
        values=none,
        sigmas=none,
        prior_sigmas=none + np.inf,
        correlation=np.eye(len(NAMES)),
        held=(),
        trajectory=None,
        residuals=(),
        groups=(),
        control=(),
        variance_factor=1.0,
        redundancy=1.0,
        global_test=1.0,
        iterations=1,
        matchings=1,
        converged=True,
    )


def flown_wrong(flight: Flight, prior: TrajectoryPrior, errors: FloatArray) -> Flight:
    """Place the flight on a trajectory that needs these errors added to be true."""
    wrong = tuple(apply(one, number, prior, -errors) for number, one in enumerate(flight.trajectories))
    moved = replace(flight, trajectories=wrong)
    return moved.placed(moved.starts())


def profile_of(flight: Flight, kind: str) -> Profile:
    return survey(flight, kind, CONTROL, CHECK).profiles[0]


@pytest.mark.parametrize("kind", KINDS)
def test_each_parameter_moves_a_profile_as_predicted(flight: Flight, prior: TrajectoryPrior, kind: str) -> None:
    """The prediction is compared with the effect of really changing the parameter or the trajectory."""
    profile = profile_of(flight, kind)
    told = influence(flight, profile, flight.starts(), prior, NAMES)
    assert told.by_parameter[PARAMETER[kind]] == pytest.approx(1.0, abs=0.02)
    given = [] if kind == "range" else [Given(kind, profile.first, profile.second, *profile.ends_t)]
    (same, *_) = survey(flight, kind, CONTROL, CHECK, given=given).profiles
    for parameter, size in zip((PARAMETER[one] for one in KINDS), (3e-4, 3e-4, 3e-4, 0.02), strict=True):
        start = flight.heads[0].start
        wrong = {"left": start.changed(**{parameter: start.value(parameter) - size})}
        (other, *_) = survey(flight.placed(wrong), kind, CONTROL, CHECK, wrong, given).profiles
        expected = influence(flight, same, flight.starts(), prior, NAMES).by_parameter[parameter] * size
        assert other.found - same.found == pytest.approx(expected, abs=2.0 * same.noise_sigma + 0.1 * abs(expected))


def test_sigmas_hold_with_time_varying_trajectory_errors(flight: Flight, prior: TrajectoryPrior) -> None:
    rng = np.random.default_rng(7)
    normalised = []
    for _ in range(DRAWS):
        moved = flown_wrong(flight, prior, draw(prior, rng))
        comparisons = check(moved, known(moved), prior, CONTROL).comparisons
        assert {one.parameter for one in comparisons} == set(PARAMETER.values())
        normalised.append([one.normalised for one in comparisons])
    squares = np.square(normalised)
    # 32 draws of χ²(1): their mean is 1 ± 0.25; three sigmas of it
    assert 0.4 < squares.mean() < 1.75
    assert np.abs(normalised).max() < 4.0


def test_opposite_lines_side_by_side_do_not_separate_heading_from_pitch(prior: TrajectoryPrior) -> None:
    opposite = fly((LINES[0], Line(145, 90, 270, 290, 300)), gables(), scanner=Scanner(prf_hz=10_000.0))
    checked = check(opposite, known(opposite), gauss_markov(opposite, TAUS, knot_s=0.5))
    assert "phi_rad" not in {one.parameter for one in checked.comparisons}
    assert ("left", "pitch") in checked.missing
    assert ("left", "range") in checked.missing


def test_planes_and_profiles_agree_within_their_sigmas(flight: Flight, prior: TrajectoryPrior) -> None:
    moved = flown_wrong(flight, prior, draw(prior, np.random.default_rng(3)))
    known = {name: exactly_known(one) for name, one in moved.starts().items()}
    options = ParameterOptions("basic", fix=frozenset({"range_offset_m"}))
    adjusted = adjust(moved, find_planes(moved), options, prior, start=known)
    placed = moved.placed(adjusted.calibrations)
    checked = check(placed, adjusted, prior)
    assert {one.parameter for one in checked.comparisons} == {"omega_rad", "phi_rad", "kappa_rad"}
    for one in checked.comparisons:
        assert abs(one.normalised) < 3.0, one
        assert one.told_sigma > 0.9 * one.adjusted_sigma  # the adjustment uses more observations
    # larger errors are seen too; points that moved are profiled at other places, where sigmas are up to half
    # as large again, so 12 sigmas become 8, minus the 3 that are allowed above
    start = adjusted.calibrations["left"]
    for parameter in ("omega_rad", "phi_rad"):
        sigma = next(one.difference_sigma for one in checked.comparisons if one.parameter == parameter)
        wrong = {"left": start.changed(**{parameter: start.value(parameter) + 12.0 * sigma})}
        seen = check(moved.placed(wrong), replace(adjusted, calibrations=wrong), prior)
        assert any(one.parameter == parameter and one.normalised < -4.0 for one in seen.comparisons)


def test_profile_check_appears_in_the_report(flight: Flight, prior: TrajectoryPrior) -> None:
    checked = check(flight, known(flight), prior, CONTROL)
    compared, every = comparison_table(checked), profiles_table(checked)
    assert isinstance(compared, Table)
    assert every is not None
    assert len(compared.rows) == 4
    assert len(every.rows) == len(checked.profiles)
    formulas = formulas_table(checked)
    assert formulas is not None
    assert len(formulas.rows) == len(checked.profiles)
    assert all("=" in str(row[-1]) for row in formulas.rows)
    assert pictures(checked, flight, CONTROL)[0].svg.startswith("<?xml")
    assert compare(flight, (), known(flight), prior) == ()
