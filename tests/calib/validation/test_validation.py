"""Validation: a true calibration passes every method, a wrong one fails those that can see it, and the tests reject as
often as they promise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from swath.calib.equations.trajectory_prior import Taus, TrajectoryPrior, apply, draw, gauss_markov
from swath.calib.features import ControlPoint, Features, Patch, Plane
from swath.calib.planes.local import plane_through
from swath.calib.strips.effects import EFFECTS
from swath.calib.validation.distances import FLOOR_M, HALF, Rows, estimated_floor_m, plane_rows
from swath.calib.validation.methods import (
    ALPHA,
    CODES,
    POWER,
    Asked,
    Method,
    distance_tests,
    same_logs,
    smallest_errors,
    validate,
)
from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.scanner.calibration import INDEX, Calibration
from swath.sim.shots import ROOF
from tests.calib.cast_flight import Cast, cast_flight

pytestmark = pytest.mark.xdist_group("kernels")

LINES = ((-200, 0, 200, 0, 850), (200, 60, -200, 60, 850), (0, 200, 0, -200, 850), (60, -200, 60, 200, 1050))


@pytest.fixture(scope="module")
def made() -> Cast:
    """Return two opposite lines, a crossing one, and a crossing one at another height."""
    return cast_flight(lines=LINES, prf_hz=25_000.0, true={})


@pytest.fixture(scope="module")
def roofs(made: Cast) -> Features:
    """Return the true roofs of the scene, with every plane's returns on it."""
    patches: dict[int, list[Patch]] = {}
    for number in range(len(made.flight.swaths)):
        at = np.flatnonzero(made.surface[number] == ROOF)
        on = made.faces(number, at)
        for plane in np.flatnonzero(on.sum(axis=0) >= 12):
            if made.planes[plane, 2] > 0.5:
                patches.setdefault(int(plane), []).append(Patch(number, at[on[:, plane]]))
    planes = [
        Plane(f"roof {plane}", np.zeros(3), made.planes[plane, :3], tuple(found))
        for plane, found in patches.items()
        if len(found) > 1
    ]
    assert len(planes) > 30
    return Features(planes=tuple(planes))


@pytest.fixture(scope="module")
def control(made: Cast) -> list[ControlPoint]:
    """Return places on the true ground, surveyed to a centimetre, away from roofs and walls."""
    draws = np.random.default_rng(2)
    ground = np.flatnonzero(made.surface[0] == np.bincount(made.surface[0]).argmax())
    chosen = draws.choice(ground, 40, replace=False)
    places = made.true_t[0][chosen] + draws.normal(0.0, 0.01, (40, 3))
    return [ControlPoint(f"P{number}", place, 0.01) for number, place in enumerate(places)]


def methods(
    made: Cast, roofs: Features, control: list[ControlPoint] | None = None, **wrong: float
) -> dict[str, Method]:
    """Return by name the methods of a validation of a calibration that is wrong by the given amounts.

    The calibration's sigmas do not include these errors.
    """
    calibrations = {"left": made.truth.changed(**wrong)}
    found = validate(made.flight.placed(calibrations), roofs, calibrations, Asked(control))
    assert [method.name for method in found.methods] == list(CODES)
    return {method.name: method for method in found.methods}


def with_sigmas(calibration: Calibration, **sigmas: float) -> Calibration:
    """Return the calibration with sigmas of some parameters."""
    whole = calibration.sigmas.copy()
    for name, sigma in sigmas.items():
        whole[INDEX[name]] = sigma
    return replace(calibration, sigmas=whole)


# ---------------------------------------------------------------------- the methods


@pytest.mark.slow
def test_a_true_calibration_passes_every_applicable_method(
    made: Cast, roofs: Features, control: list[ControlPoint]
) -> None:
    found = methods(made, roofs, control)
    for name in ("testfield", "crossStripFlight", "secondAltitude", "other"):
        method = found[name]
        assert method.passed is True, method.sentence
        assert method.numbers is not None
        assert method.numbers.rms_m < 0.03
        assert f"({CODES[name]})" in method.sentence
        assert "as expected" in method.sentence
    assert found["secondFlight"].passed is None
    assert "needs the log of a second flight" in found["secondFlight"].sentence
    assert found["measurementActualParameters"].passed is None


def test_each_method_uses_the_pairs_it_is_named_after(made: Cast, roofs: Features) -> None:
    found = methods(made, roofs)
    counts = {name: found[name].more.get("pairs") for name in ("crossStripFlight", "secondAltitude", "other")}
    assert counts == {"crossStripFlight": 4, "secondAltitude": 3, "other": 6}  # 2 lines east-west, 2 north-south


def test_a_wrong_boresight_fails(made: Cast, roofs: Features) -> None:
    found = methods(made, roofs, phi_rad=6e-4)
    for name in ("crossStripFlight", "secondAltitude", "other"):
        assert found[name].passed is False
        assert "as an error of pitch would leave" in found[name].sentence


def test_a_wrong_range_offset_fails_on_the_test_field_with_its_sign(
    made: Cast, roofs: Features, control: list[ControlPoint]
) -> None:
    method = methods(made, roofs, control, range_offset_m=-0.12)["testfield"]
    assert method.passed is False
    assert method.numbers is not None
    assert method.numbers.mean_m == pytest.approx(0.11, abs=0.02)  # too short a range lifts the ground


def test_parameters_that_the_calibration_declares_unknown_are_not_a_fault(made: Cast, roofs: Features) -> None:
    wrong = made.truth.changed(phi_rad=6e-4)
    sure, unsure = wrong, with_sigmas(wrong, phi_rad=6e-4)
    flight = made.flight.placed({"left": wrong})
    assert validate(flight, roofs, {"left": sure}).passed is False
    assert validate(flight, roofs, {"left": unsure}).passed is True


def test_two_flights_are_a_separate_method(made: Cast, roofs: Features) -> None:
    swaths = tuple(replace(swath, trajectory_index=number // 2) for number, swath in enumerate(made.flight.swaths))
    flight = replace(made.flight, trajectories=made.flight.trajectories * 2, swaths=swaths).placed({"left": made.truth})
    method = next(one for one in validate(flight, roofs, {"left": made.truth}).methods if one.name == "secondFlight")
    assert method.passed is True
    assert method.more["pairs"] == 4


def test_remeasured_parameters_are_compared_by_their_joint_sigmas(made: Cast) -> None:
    told = with_sigmas(made.truth, omega_rad=3e-5, phi_rad=4e-5)
    near, far = (with_sigmas(made.truth.changed(omega_rad=by), omega_rad=4e-5, phi_rad=3e-5) for by in (5e-5, 4e-4))
    for anew, passed in ((near, True), (far, False)):
        validation = validate(made.flight, Features(), {"left": told}, Asked(anew={"left": anew}))
        method = validation.methods[4]
        assert method.passed is passed
        (test,) = method.tests
        assert test.value == pytest.approx((anew.value("omega_rad") / 5e-5) ** 2)
        assert test.freedom == 2.0
        assert "omega_deg" in method.sentence


def test_a_validation_without_features_says_that_nothing_was_validated(made: Cast) -> None:
    validation = validate(made.flight, Features(), {"left": made.truth})
    assert validation.passed is None
    assert validation.sentence == "nothing could be validated"
    assert all("not applied: needs" in method.sentence for method in validation.methods)


def test_few_control_sightings_are_too_few(made: Cast, roofs: Features, control: list[ControlPoint]) -> None:
    away = [ControlPoint("A", control[0].position_t + np.array([5000.0, 0.0, 0.0]), 0.01)]
    method = methods(made, roofs, away)["testfield"]
    assert method.passed is None
    assert "strips see control 0 times only" in method.sentence


# ---------------------------------------------------------------------- the tests themselves


def test_the_tests_reject_at_their_stated_rate() -> None:
    draws = np.random.default_rng(9)
    shared = draws.normal(0.0, 0.02, (40, 12))
    noise = draws.uniform(0.005, 0.02, 40)
    rows = Rows(np.zeros(40), np.zeros(40, int), np.ones(40, int), noise, shared, ("a",) * 40)
    effects = draws.normal(0.0, 100.0, (40, 3))
    rows = replace(rows, effects=np.column_stack([effects, effects[:, :2] @ [0.3, 0.7]]))
    p = np.empty((600, 4))
    for run in range(600):
        value = noise * draws.standard_normal(40) + shared @ draws.standard_normal(12)
        p[run] = [test.p for test in distance_tests(replace(rows, value_m=value))]
    for column in p[:, :3].T:
        assert 0.03 < (column < 0.05).mean() < 0.075
        assert 0.45 < column.mean() < 0.55
    assert (
        p[:, 3] < 0.05
    ).mean() < 0.075  # the best of several is not significant more often than stated, and less often if they are alike
    assert (p[:, 3] < 0.05).mean() > 0.01


@pytest.mark.slow
def test_planes_seen_by_many_swaths_are_rejected_at_the_stated_rate(made: Cast, roofs: Features) -> None:
    """Each sighting errs once in all its distances, by its returns and a floor of 3 mm; so does a strip on a plane."""
    calibrations, flight = {"left": made.truth}, made.flight.placed({"left": made.truth})
    planes = tuple(plane for plane in roofs.planes if len(plane.patches) == 4)
    prior = gauss_markov(flight, knot_s=1.0)
    rows = plane_rows(flight, Features(planes=planes), calibrations, prior)
    fits = [
        plane_through(np.asarray(flight.swaths[patch.swath].points_t[patch.at])) for p in planes for patch in p.patches
    ]
    sigma = np.hypot([fit.rms_m / np.sqrt(fit.count) for fit in fits], FLOOR_M * HALF).reshape(-1, 4)
    on = np.repeat(np.arange(len(planes)), 6)
    chosen = rows.independent(np.ones(len(rows), bool))
    assert len(rows) == 6 * len(planes) > 60
    assert chosen.sum() == 3 * len(planes)
    assert chosen.reshape(-1, 6).sum(axis=1).tolist() == [3] * len(planes)
    turns = rows.local[:, np.arange(rows.local.shape[1]) % 4 > 0]
    root = np.linalg.cholesky(prior.covariance)
    draws, p = np.random.default_rng(4), np.empty((600, 4))
    for run in range(600):
        error = sigma * draws.standard_normal(sigma.shape)
        value = rows.by_knot @ (root @ draws.standard_normal(len(root))) + turns @ draws.standard_normal(turns.shape[1])
        tested = replace(rows, value_m=value + error[on, rows.first] - error[on, rows.second]).take(chosen)
        p[run] = [test.p for test in distance_tests(tested)]
    for column in p[:, :3].T:
        assert 0.03 < (column < 0.05).mean() < 0.07
        assert (column < 0.001).sum() <= 3


@pytest.fixture(scope="module")
def drawn(made: Cast, roofs: Features) -> tuple[Rows, TrajectoryPrior]:
    """Return independent distances of the true calibration, and the trajectory's expected errors."""
    prior = gauss_markov(made.flight, Taus(5.0, 5.0, 5.0), 1.0)
    rows = plane_rows(made.at_truth(), roofs, {"left": made.truth}, prior)
    return rows.take(rows.independent(np.ones(len(rows), bool))), prior


def values_of(rows: Rows, prior: TrajectoryPrior, draws: np.random.Generator, floor_m: float) -> FloatArray:
    """Return distances as the rows expect them, with the given roughness, m."""
    sights = floor_m * draws.standard_normal(rows.floor.shape[1])
    local = rows.local @ draws.standard_normal(rows.local.shape[1])
    value: FloatArray = rows.by_knot @ draw(prior, draws).ravel() + rows.floor @ sights + local
    return value


def test_chi2_equals_the_redundancy_if_planes_and_trajectory_match_their_sigmas(made: Cast, roofs: Features) -> None:
    """Points are placed along erroneous trajectories, which does not use the rows' own linear model."""
    prior, draws = gauss_markov(made.flight, Taus(5.0, 5.0, 5.0), 1.0), np.random.default_rng(3)
    ratios, redundancy = [], 0.0
    for _ in range(4):
        erroneous = apply(made.flight.trajectories[0], 0, prior, -draw(prior, draws))
        flight = replace(made.flight, trajectories=(erroneous,)).placed({"left": made.truth})
        method = validate(flight, roofs, {"left": made.truth}, prior=prior).methods[-1]
        assert method.passed is True, method.sentence
        assert "as expected" in method.sentence
        ratios.append(method.tests[0].value / method.tests[0].freedom)
        redundancy += method.tests[0].freedom
    assert np.mean(ratios) == pytest.approx(1.0, abs=3.0 * np.sqrt(2.0 / redundancy) + 0.05)


def test_an_error_of_the_minimal_detectable_size_is_found_at_the_stated_rate(
    drawn: tuple[Rows, TrajectoryPrior],
) -> None:
    rows = drawn[0].take(np.arange(len(drawn[0])) % 3 == 0)
    smallest = {one.parameter: one.size for one in smallest_errors(rows)}
    factor = np.linalg.cholesky(rows.covariance())
    draws, runs = np.random.default_rng(5), 150
    for name in ("omega_rad", "phi_rad", "kappa_rad", "range_offset_m"):
        column = rows.effects[:, [one.parameter for one in EFFECTS].index(name)]
        found = 0
        for _ in range(runs):
            value = factor @ draws.standard_normal(len(rows)) + smallest[name] * column
            found += not distance_tests(replace(rows, value_m=value))[3].passed
        # at least, because a parameter's error is also detected by the test of a similar parameter
        assert POWER - 3.3 * np.sqrt(POWER * (1.0 - POWER) / runs) < found / runs < 0.95


def test_the_roughness_of_planes_is_estimated_from_the_flight(drawn: tuple[Rows, TrajectoryPrior]) -> None:
    rows, prior = drawn
    draws = np.random.default_rng(6)
    found = {
        floor_m: [estimated_floor_m(replace(rows, value_m=values_of(rows, prior, draws, floor_m))) for _ in range(3)]
        for floor_m in (0.0, 0.002, 0.02)
    }
    assert np.mean(found[0.0]) < 0.001
    assert np.mean(found[0.002]) == pytest.approx(0.002, abs=0.0007)
    assert np.mean(found[0.02]) == pytest.approx(FLOOR_M, rel=0.01)  # a natural plane is not rougher


def test_a_calibration_error_is_not_taken_for_roughness(drawn: tuple[Rows, TrajectoryPrior]) -> None:
    rows, prior = drawn
    sound = replace(rows, value_m=values_of(rows, prior, np.random.default_rng(7), 0.001))
    wrong = replace(sound, value_m=sound.value_m + rows.effects @ np.full(rows.effects.shape[1], 1e-4))
    assert estimated_floor_m(wrong) == pytest.approx(estimated_floor_m(sound), abs=1e-5)


# ---------------------------------------------------------------------- what could have been seen, and was asked for


def test_the_verdict_names_undetectable_errors(made: Cast, roofs: Features) -> None:
    calibrations = {"left": made.truth}
    validation = validate(made.at_truth(), roofs, calibrations)
    smallest = {one.parameter: one for one in validation.detectable}
    assert f"errors below {smallest['omega_rad'].words}, {smallest['phi_rad'].words}, " in validation.sentence
    assert "would not be detected (80 % of larger ones would)" in validation.sentence
    assert 1e-5 < smallest["omega_rad"].size < 5e-4
    for name in ("omega_rad", "phi_rad"):
        wrong = {"left": made.truth.changed(**{name: 2.0 * smallest[name].size})}
        assert validate(made.flight.placed(wrong), roofs, wrong).passed is False


def test_errors_within_the_sigmas_of_the_calibration_are_undetectable(made: Cast, roofs: Features) -> None:
    size = {}
    for sigma in (0.0, 1e-3):
        calibrations = {"left": with_sigmas(made.truth, phi_rad=sigma)}
        found = validate(made.at_truth(), roofs, calibrations).detectable
        size[sigma] = next(one.size for one in found if one.parameter == "phi_rad")
    shift = norm.isf(ALPHA / 14.0) + norm.ppf(POWER)  # seven effects are tested on both sides
    assert size[1e-3] == pytest.approx(np.hypot(size[0.0], shift * 1e-3), rel=0.01)


def test_a_test_without_power_is_reported(made: Cast, roofs: Features) -> None:
    """The trajectory's sigmas are far larger than its errors: χ² is far below its redundancy, and small errors hide."""
    trajectory = replace(
        made.flight.trajectories[0], attitude_sigma_rad=np.full((len(made.flight.trajectories[0]), 3), 0.01)
    )
    flight = replace(made.flight, trajectories=(trajectory,)).placed({"left": made.truth})
    validation = validate(flight, roofs, {"left": made.truth})
    assert "less than expected" in validation.methods[-1].sentence
    assert "the test is less sensitive than it could be" in validation.methods[-1].sentence
    assert {one.parameter: one for one in validation.detectable}["omega_rad"].size > 0.01


def test_control_that_was_not_seen_does_not_pass(made: Cast, roofs: Features, control: list[ControlPoint]) -> None:
    calibrations = {"left": made.truth}
    away = [ControlPoint("A", control[0].position_t + np.array([5000.0, 0.0, 0.0]), 0.01)]
    validation = validate(made.at_truth(), roofs, calibrations, Asked(away))
    assert validation.passed is True
    assert validation.holds is False
    assert validation.undone == ("control: strips see control 0 times only; 5 or more are needed",)
    assert validation.sentence.startswith("not validated as requested: a requested check could not be done: control: ")
    assert validate(made.at_truth(), roofs, calibrations).holds is True


def test_failed_remeasurements_and_comparisons_are_reported(made: Cast, roofs: Features) -> None:
    calibrations = {"left": made.truth}
    asked = Asked(anew={}, why_not_anew="the adjustment does not converge")
    validation = validate(made.at_truth(), roofs, calibrations, asked)
    assert validation.undone == ("independently measured parameters: the adjustment does not converge",)
    elsewhere = tuple(replace(plane, patches=plane.patches[:2]) for plane in roofs.planes)
    swaths = tuple(replace(swath, trajectory_index=number // 2) for number, swath in enumerate(made.flight.swaths))
    flight = replace(made.flight, trajectories=made.flight.trajectories * 2, swaths=swaths).placed(calibrations)
    alone = [plane for plane in elsewhere if {patch.swath // 2 for patch in plane.patches} == {0}]
    assert len(alone) > 5
    (line,) = validate(flight, Features(planes=tuple(alone)), calibrations).undone
    assert line == "2 flights: two of them share fewer than 5 distances between planes"


def test_a_scanner_that_no_test_covers_is_reported(made: Cast, roofs: Features) -> None:
    """The second head has no return on any plane."""
    head = replace(made.flight.heads[0], name="right")
    flight = replace(made.flight, heads=(*made.flight.heads, head)).placed({"left": made.truth, "right": made.truth})
    calibrations = {"left": made.truth, "right": made.truth}
    both = validate(flight, roofs, calibrations, Asked(scanners=["left", "right"]))
    assert both.undone == ("right: no method would detect an error of its calibration",)
    assert both.holds is False
    assert validate(flight, roofs, calibrations, Asked(scanners=["left"])).holds is True


def test_a_common_shift_is_found_by_the_mean() -> None:
    noise = np.full(30, 0.01)
    rows = Rows(noise * 0.8, np.zeros(30, int), np.ones(30, int), noise, np.zeros((30, 1)), ("a",) * 30)
    chi2, mean = distance_tests(rows)
    assert chi2.value == pytest.approx(30 * 0.64)
    assert chi2.passed
    assert mean.value == pytest.approx(0.8 * np.sqrt(30.0))
    assert not mean.passed


def test_logs_used_for_the_calibration_are_reported(made: Cast) -> None:
    header = {"logs": [{"name": "a.mcap", "sha256": "12ab"}]}
    calibration = replace(made.truth, header=header)
    (line,) = same_logs(calibration, [("b.mcap", "12ab"), ("a.mcap", "34cd")])
    assert line.startswith("b.mcap: ")
    assert "so this validation is not independent" in line
    assert same_logs(made.truth, [("b.mcap", "12ab")]) == ()


def test_returns_without_coordinates_are_not_part_of_a_sighting(made: Cast, roofs: Features) -> None:
    """A calibration that moves stamps beyond the trajectory's end leaves some returns without a place."""
    flight = made.flight.placed({"left": made.truth})
    prior = gauss_markov(flight)
    plane = max(roofs.planes, key=lambda one: (len(one.patches), one.points))
    first, second = plane.patches[:2]
    swaths = list(flight.swaths)
    for patch, lost in ((first, patch_part(first, 3)), (second, second.at)):
        points = np.array(swaths[patch.swath].points_t)
        points[lost] = np.nan
        swaths[patch.swath] = replace(swaths[patch.swath], points_t=points)
    less = replace(flight, swaths=tuple(swaths))
    one = replace(roofs, planes=(plane,))
    rows = plane_rows(less, one, {"left": made.truth}, prior)
    assert np.isfinite(rows.value_m).all()
    assert first.swath in rows.first
    assert second.swath not in {*rows.first.tolist(), *rows.second.tolist()}


def patch_part(patch: Patch, every: int) -> Int64Array:
    """Return a fraction of the returns of a patch."""
    return patch.at[::every]


def test_rows_beyond_the_limit_are_sampled_evenly(made: Cast) -> None:
    count = 4000
    rows = Rows(
        np.arange(count, dtype=np.float64),
        np.zeros(count, int),
        np.ones(count, int),
        np.ones(count),
        np.zeros((count, 1)),
        tuple(map(str, range(count))),
    )
    taken = rows.take(rows.value_m >= 1000.0)
    assert len(taken) == 1500
    assert taken.value_m.min() >= 1000.0
    assert [float(name) for name in taken.name] == taken.value_m.tolist()
