"""Validation: a true calibration passes every method, a wrong one fails those that can see it, and the tests reject as
often as they promise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from calib.features import ControlPoint, Features, Patch, Plane
from calib.local_plane import plane_through
from calib.validation import CODES, Method, distance_tests, same_logs, validate
from calib.validation_rows import Rows, plane_rows
from georef.calibration import INDEX, Calibration
from sim.shots import ROOF
from tests.calib.cast_flight import Cast, cast_flight

pytestmark = pytest.mark.xdist_group("kernels")

FloatArray = NDArray[np.float64]
LINES = ((-200, 0, 200, 0, 850), (200, 60, -200, 60, 850), (0, 200, 0, -200, 850), (60, -200, 60, 200, 1050))


@pytest.fixture(scope="module")
def made() -> Cast:
    """Two opposite lines, a crossing one, and a crossing one higher up."""
    return cast_flight(lines=LINES, prf_hz=25_000.0, true={})


@pytest.fixture(scope="module")
def roofs(made: Cast) -> Features:
    """Roofs by the scene's own word, every plane's returns where they truly lie."""
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
    """Places on the true ground, surveyed to a centimetre, on no roof and no wall."""
    draws = np.random.default_rng(2)
    ground = np.flatnonzero(made.surface[0] == np.bincount(made.surface[0]).argmax())
    chosen = draws.choice(ground, 40, replace=False)
    places = made.true_t[0][chosen] + draws.normal(0.0, 0.01, (40, 3))
    return [ControlPoint(f"P{number}", place, 0.01) for number, place in enumerate(places)]


def methods(
    made: Cast, roofs: Features, control: list[ControlPoint] | None = None, **wrong: float
) -> dict[str, Method]:
    """Of a calibration that is wrong by so much and knows nothing of it."""
    calibrations = {"left": made.truth.changed(**wrong)}
    found = validate(made.flight.placed(calibrations), roofs, calibrations, control or ())
    assert [method.name for method in found.methods] == list(CODES)
    return {method.name: method for method in found.methods}


def with_sigmas(calibration: Calibration, **sigmas: float) -> Calibration:
    """The same with sigmas of some parameters."""
    whole = calibration.sigmas.copy()
    for name, sigma in sigmas.items():
        whole[INDEX[name]] = sigma
    return replace(calibration, sigmas=whole)


# ---------------------------------------------------------------------- the methods


def test_a_true_calibration_passes_all_that_the_flight_can_show(
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
    assert "want the log of a second flight" in found["secondFlight"].sentence
    assert found["measurementActualParameters"].passed is None


def test_methods_take_the_pairs_they_are_named_after(made: Cast, roofs: Features) -> None:
    found = methods(made, roofs)
    counts = {name: found[name].more.get("pairs") for name in ("crossStripFlight", "secondAltitude", "other")}
    assert counts == {"crossStripFlight": 4, "secondAltitude": 3, "other": 6}  # of two east-west, two north-south


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


def test_what_the_calibration_does_not_claim_to_know_is_no_fault(made: Cast, roofs: Features) -> None:
    wrong = made.truth.changed(phi_rad=6e-4)
    sure, unsure = wrong, with_sigmas(wrong, phi_rad=6e-4)
    flight = made.flight.placed({"left": wrong})
    assert validate(flight, roofs, {"left": sure}).passed is False
    assert validate(flight, roofs, {"left": unsure}).passed is True


def test_two_flights_are_a_method_of_their_own(made: Cast, roofs: Features) -> None:
    swaths = tuple(replace(swath, flown=number // 2) for number, swath in enumerate(made.flight.swaths))
    flight = replace(made.flight, trajectories=made.flight.trajectories * 2, swaths=swaths).placed({"left": made.truth})
    method = next(one for one in validate(flight, roofs, {"left": made.truth}).methods if one.name == "secondFlight")
    assert method.passed is True
    assert method.more["pairs"] == 4


def test_parameters_measured_anew_are_compared_with_their_joint_sigmas(made: Cast) -> None:
    told = with_sigmas(made.truth, omega_rad=3e-5, phi_rad=4e-5)
    near, far = (with_sigmas(made.truth.changed(omega_rad=by), omega_rad=4e-5, phi_rad=3e-5) for by in (5e-5, 4e-4))
    for anew, passed in ((near, True), (far, False)):
        validation = validate(made.flight, Features(), {"left": told}, anew={"left": anew})
        method = validation.methods[4]
        assert method.passed is passed
        (test,) = method.tests
        assert test.value == pytest.approx((anew.value("omega_rad") / 5e-5) ** 2)
        assert test.freedom == 2.0
        assert "omega_deg" in method.sentence


def test_nothing_to_look_at_is_said(made: Cast) -> None:
    validation = validate(made.flight, Features(), {"left": made.truth})
    assert validation.passed is None
    assert validation.sentence == "nothing could be validated"
    assert all("not applied: want" in method.sentence for method in validation.methods)


def test_few_sights_of_control_are_too_few(made: Cast, roofs: Features, control: list[ControlPoint]) -> None:
    away = [ControlPoint("A", control[0].position_t + np.array([5000.0, 0.0, 0.0]), 0.01)]
    method = methods(made, roofs, away)["testfield"]
    assert method.passed is None
    assert "control is seen 0 times only" in method.sentence


# ---------------------------------------------------------------------- the tests themselves


def test_the_tests_reject_as_often_as_they_promise() -> None:
    draws = np.random.default_rng(9)
    shared = draws.normal(0.0, 0.02, (40, 12))
    noise = draws.uniform(0.005, 0.02, 40)
    rows = Rows(np.zeros(40), np.zeros(40, int), np.ones(40, int), noise, shared, ("a",) * 40)
    effects = draws.normal(0.0, 100.0, (40, 3))
    rows = replace(rows, effects=np.column_stack([effects, effects[:, :2] @ [0.3, 0.7]]))
    p = np.empty((600, 3))
    for run in range(600):
        value = noise * draws.standard_normal(40) + shared @ draws.standard_normal(12)
        p[run] = [test.p for test in distance_tests(replace(rows, value_m=value))]
    for column in p.T:
        assert 0.03 < (column < 0.05).mean() < 0.075
        assert 0.45 < column.mean() < 0.55


@pytest.mark.slow
def test_planes_that_many_swaths_show_are_tested_as_often_as_promised(made: Cast, roofs: Features) -> None:
    """Each sight errs once, in all its distances, as returns and 3 mm of a distance say; so does a strip on a plane."""
    calibrations, flight = {"left": made.truth}, made.flight.placed({"left": made.truth})
    planes = tuple(plane for plane in roofs.planes if len(plane.patches) == 4)
    rows = plane_rows(flight, Features(planes=planes), calibrations)
    fits = [
        plane_through(np.asarray(flight.swaths[patch.swath].points_t[patch.at])) for p in planes for patch in p.patches
    ]
    sigma = np.hypot([fit.rms_m / np.sqrt(fit.count) for fit in fits], 0.003 / np.sqrt(2.0)).reshape(-1, 4)
    on = np.repeat(np.arange(len(planes)), 6)
    chosen = rows.independent(np.ones(len(rows), bool))
    assert len(rows) == 6 * len(planes) > 60
    assert chosen.sum() == 3 * len(planes)
    assert chosen.reshape(-1, 6).sum(axis=1).tolist() == [3] * len(planes)
    draws, p = np.random.default_rng(4), np.empty((600, 3))
    for run in range(600):
        error = sigma * draws.standard_normal(sigma.shape)
        strips, wandered = draws.standard_normal(24), 0.3 * draws.standard_normal((len(planes), 24))
        value = (rows.shared[:, :24] * (strips + wandered[on])).sum(axis=1)
        tested = replace(rows, value_m=value + error[on, rows.first] - error[on, rows.second]).take(chosen)
        p[run] = [test.p for test in distance_tests(tested)]
    for column in p.T:
        assert 0.03 < (column < 0.05).mean() < 0.07
        assert (column < 0.001).sum() <= 3


def test_a_shift_of_all_is_seen_by_the_mean() -> None:
    noise = np.full(30, 0.01)
    rows = Rows(noise * 0.8, np.zeros(30, int), np.ones(30, int), noise, np.zeros((30, 1)), ("a",) * 30)
    chi2, mean = distance_tests(rows)
    assert chi2.value == pytest.approx(30 * 0.64)
    assert chi2.passed
    assert mean.value == pytest.approx(0.8 * np.sqrt(30.0))
    assert not mean.passed


def test_the_logs_of_the_calibration_itself_are_told(made: Cast) -> None:
    header = {"logs": [{"name": "a.mcap", "sha256": "12ab"}]}
    calibration = replace(made.truth, header=header)
    (line,) = same_logs(calibration, [("b.mcap", "12ab"), ("a.mcap", "34cd")])
    assert line.startswith("b.mcap: ")
    assert "no independent validation" in line
    assert same_logs(made.truth, [("b.mcap", "12ab")]) == ()


def test_more_rows_than_can_be_tested_together_are_drawn_evenly(made: Cast) -> None:
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
