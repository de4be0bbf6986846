"""Tests that returns of a planned flight lie where georef places them, and that predicted sigmas hold."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from swath.calib.equations.normals import TrajectoryWeight, normals
from swath.calib.equations.rows import Rows
from swath.calib.equations.tie_rows import Ties
from swath.calib.equations.trajectory_prior import apply, draw, gauss_markov
from swath.calib.features import ControlPoint
from swath.calib.flight import FlightError
from swath.calib.parameters import ParameterOptions, unknowns
from swath.calib.plan import MOST_MADE, Scan, planned, predict, search_cell_m
from swath.georef.arrays import FloatArray
from tests.calib.planned_flight import (
    FRAME,
    NOISE,
    ONE_HEIGHT,
    OPPOSITE,
    TWO_HEIGHTS,
    flown,
    noised,
    path,
    scanner,
    surfaces,
)

pytestmark = pytest.mark.xdist_group("kernels")

DEG = float(np.radians(1.0))


@pytest.mark.parametrize("looks", ["ahead", "back"])
def test_returns_lie_on_the_planes(looks: str) -> None:
    """With a boresight, an offset and scales, points lie within a micrometre of their targets and within the scan."""
    values = {
        "omega_rad": 0.3 * DEG, "phi_rad": -0.5 * DEG, "kappa_rad": 0.8 * DEG, "range_offset_m": 0.4,
        "range_scale": 3e-5, "scan_angle_scale": 2e-4, "scan_angle_offset_rad": 0.1 * DEG, "time_offset_s": 2e-3,
    }  # fmt: skip
    head, (trajectory, lines) = scanner("left", **values), path(ONE_HEIGHT)
    if looks == "back":
        head = replace(head, start=replace(head.start, installation_matrix=np.diag([-1.0, -1.0, 1.0])))
    pieces = surfaces()
    flight, features = planned(FRAME, [head], [Scan(20.0 * DEG, 1e5)], [trajectory], lines, pieces, MOST_MADE)
    normals_t = {piece.name: piece.normal_t for piece in pieces}
    seen = 0
    for swath in flight.swaths:
        assert (np.diff(swath.time_ns) >= 0).all()
        np.testing.assert_allclose(flight.place(swath, head.start), swath.points_t, atol=1e-6)
        angle = flight.rays(swath, head.start).angle_rad
        assert np.abs(angle).max() < 20.001 * DEG
    assert len(flight.swaths) == len(lines)
    for plane in features.planes:
        assert len(plane.patches) > 1
        for patch in plane.patches:
            assert 4 <= len(patch.at) <= MOST_MADE
            away = flight.swaths[patch.swath].points_t[patch.at] - plane.centre_t
            assert np.abs(away @ normals_t[plane.name]).max() < 1e-9
            seen += len(patch.at)
    assert seen == sum(len(swath) for swath in flight.swaths)


@pytest.mark.slow
def test_sigmas_match_flights_with_simulated_errors() -> None:
    """60 flights with new errors of trajectory, range and angle give, after one step, the χ² that four parameters have.

    A trajectory taken as white would make these four sigmas several times too small.
    """
    flight, features = flown(ONE_HEIGHT)
    prior, wanted = gauss_markov(flight), unknowns(flight, ParameterOptions())
    predicted = predict(flight, features, ParameterOptions(), prior)
    assert predicted.held == ()
    assert predicted.returns == sum(len(swath) for swath in flight.swaths)
    covariance = predicted.correlation * np.outer(predicted.sigmas, predicted.sigmas)
    rng, found, white = np.random.default_rng(11), [], []
    careless = predict(flight, features, ParameterOptions(), None)
    for seed in range(60):
        errors = draw(prior, rng)
        spoilt = replace(flight, trajectories=(apply(flight.trajectories[0], 0, prior, -errors),))
        rows = Rows(noised(spoilt, seed), features.planes, wanted, prior)
        ones, ties = np.ones(rows.count, np.float32), Ties(rows, (), None)
        system = normals(rows, ties, TrajectoryWeight(rows), rows.start(), ones, np.zeros(0, np.float32), 0.0)
        step = system.step()[0][: len(wanted)]
        found.append(float(step @ np.linalg.solve(covariance, step)))
        white.append((step / careless.sigmas) ** 2)
    low, high = chi2.ppf([0.001, 0.999], 4 * len(found)) / len(found)
    assert low < np.mean(found) < high
    assert np.mean(white) > 4.0


def test_a_second_height_separates_time_from_pitch_and_control_fixes_the_range() -> None:
    """A second height separates time from pitch and scale from offset; control points determine the range offset."""
    one, two = flown(ONE_HEIGHT), flown(TWO_HEIGHTS)
    model = ParameterOptions("scanner")
    low = predict(one[0], one[1], model, gauss_markov(one[0]))
    high = predict(two[0], two[1], model, gauss_markov(two[0]))
    sigma_low, sigma_high = (dict(zip(one.names, one.sigmas.tolist(), strict=True)) for one in (low, high))
    assert sigma_high["left.range_scale"] < 0.5 * sigma_low.get("left.range_scale", np.inf)
    assert sigma_high["left.time_offset_s"] < sigma_low.get("left.time_offset_s", np.inf)
    flight, features = flown(OPPOSITE, roofs=False)
    told = {held.name for held in predict(flight, features, ParameterOptions(), gauss_markov(flight)).held}
    assert told == {"range_offset_m"}
    planes = tuple(
        replace(plane, control=(ControlPoint(f"{index}", plane.centre_t, 0.01),)) if index % 4 == 0 else plane
        for index, plane in enumerate(features.planes)
    )
    controlled = replace(features, planes=planes)
    sigmas = predict(flight, controlled, ParameterOptions(), gauss_markov(flight))
    assert sigmas.held == ()
    assert sigmas.sigmas[sigmas.names.index("left.range_offset_m")] < 0.02


def test_a_single_line_has_planes_only_with_control() -> None:
    trajectory, lines = path(ONE_HEIGHT[:1])
    scan = Scan(30.0 * DEG, 1e5)
    with pytest.raises(FlightError, match="no two lines see the same roof or ground; plan lines that overlap"):
        planned(FRAME, [scanner()], [scan], [trajectory], lines, surfaces(), MOST_MADE)
    piece = surfaces()[24]
    controlled = replace(piece, control=(ControlPoint("1", piece.points_t[24], 0.01),))
    _, features = planned(FRAME, [scanner()], [scan], [trajectory], lines, [controlled], MOST_MADE)
    assert [len(plane.patches) for plane in features.planes] == [1]
    assert len(planned(FRAME, [scanner()], [scan], [trajectory], lines * 2, surfaces(), MOST_MADE)[1].planes) > 9
    with pytest.raises(FlightError, match="no two lines see"):  # too few pulses for a patch to be found
        planned(FRAME, [scanner()], [Scan(30.0 * DEG, 2000.0)], [trajectory], lines * 2, surfaces(), MOST_MADE)
    near = replace(scanner(), range_gate=(20.0, 300.0))
    with pytest.raises(FlightError, match="no two lines see"):  # out of range
        planned(FRAME, [near], [scan], [trajectory], lines * 2, surfaces(), MOST_MADE)


@pytest.mark.parametrize(
    ("scan", "speed_mps", "cell_m"),
    [
        (Scan(0.5, 1e5), 50.0, 1.0),  # 5 a square metre
        (Scan(0.5, 1e5, 100.0), 50.0, 1.0),
        (Scan(0.5, 1e5, 12.5), 50.0, 6.0),  # 4 m between lines
        (Scan(0.5, 1e5, 12.5, "sine"), 50.0, 3.0),  # two lines an oscillation
        (Scan(0.5, 1e5, 12.5, "turning", 4), 50.0, 1.5),  # four a turn
        (Scan(0.5, 1e5, 400.0), 50.0, 3.0),  # lines of pulses 1.6 m apart
        (Scan(0.5, 1e4), 50.0, 4.0),  # 0.5 a square metre
    ],
)  # fmt: skip
def test_cells_hold_several_lines(scan: Scan, speed_mps: float, cell_m: float) -> None:
    """The swath is 400 m wide; the cell sizes are those that a search chooses from."""
    per_m2 = scan.rate_hz / (speed_mps * 400.0)
    assert search_cell_m(scan, np.full(9, per_m2), speed_mps) == cell_m


def test_larger_cells_lose_more_of_the_rim_of_a_roof() -> None:
    roof = replace(surfaces()[0], area_m2=100.0, kind="roof")
    assert [roof.taken_m2(cell_m) for cell_m in (0.5, 1.0, 4.0, 12.0)] == [81.0, 81.0, 36.0, 0.0]
    assert replace(roof, kind="ground").taken_m2(4.0) == 100.0


def test_encoder_rates_are_derivatives_of_the_scan() -> None:
    """Rates and accelerations are compared with differences of the motion itself."""
    t, h = np.linspace(0.001, 0.011, 7), 1e-6

    def sine(at: FloatArray) -> FloatArray:
        return np.asarray(0.5 * np.sin(2 * np.pi * 20.0 * at))

    def triangle(at: FloatArray) -> FloatArray:
        return np.asarray(0.5 * 4 * 20.0 * at)

    for angle_of in (sine, triangle):
        scan = Scan(0.5, 1e5, 20.0, angle_of.__name__)
        rate, acceleration = scan.encoder_motion(angle_of(t))
        np.testing.assert_allclose(np.abs(rate), (angle_of(t + h) - angle_of(t - h)) / (2 * h), rtol=1e-6)
        second = (angle_of(t + 1e-4) - 2 * angle_of(t) + angle_of(t - 1e-4)) / 1e-8
        np.testing.assert_allclose(acceleration, second, rtol=1e-3, atol=1e-3)
        assert rate[0] > 0.0 > rate[1]
    rate, acceleration = Scan(0.5, 1e5, 20.0).encoder_motion(t)
    assert (rate == 2 * np.pi * 20.0).all()
    assert not acceleration.any()
    assert NOISE.range_m == 0.02
