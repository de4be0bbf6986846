"""Tests the adjustment: FORMULAS' worked numbers, a dense solution, true errors over many runs, refusals."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy import stats

from swath.calib.adjust import adjust, predict
from swath.calib.equations.normals import NormalError, TrajectoryWeight, moved, normals
from swath.calib.equations.rows import Rows
from swath.calib.equations.solve import Settings
from swath.calib.equations.tie_rows import Ties
from swath.calib.equations.trajectory_prior import Taus, TrajectoryPrior, gauss_markov
from swath.calib.features import ControlPoint, Features, Sighting, TiePoint
from swath.calib.flight import Flight
from swath.calib.intensity_curve import STEPS, at_knots, curve_by_knots
from swath.calib.outcome import Adjusted
from swath.calib.parameters import MODELS, ParameterOptions, unknowns
from swath.georef.arrays import FloatArray
from swath.georef.scanner.calibration import INDEX, PARAMETERS, Calibration, nominal
from swath.georef.trajectory.trajectory import Trajectory
from tests.calib.builders import controlled, design, in_planes
from tests.calib.printed import TRUTH, Printed, printed
from tests.calib.roofs import LINES, NOISE, Line, Made, made, roofs

pytestmark = pytest.mark.xdist_group("kernels")
PLAIN = Settings(huber=0.0, family=0.0, tolerance=1e-7)


@cache
def worked() -> Printed:
    return printed()


@cache
def adjusted_as_printed() -> Adjusted:
    flight, features = worked().flight()
    return adjust(flight, features, ParameterOptions(), None, PLAIN)


def test_the_printed_adjustment_is_reproduced() -> None:
    found = adjusted_as_printed()
    assert found.names == ("left.omega_rad", "left.phi_rad", "left.kappa_rad", "left.range_offset_m")
    assert len(worked().observed) == 1522
    printed_values = [0.003665169848263187, -0.006111363445060003, 0.0021017691137531266, 0.18402286108779703]
    printed_sigmas = [4.190375990579231e-06, 4.519601098956462e-06, 2.6157347643027155e-05, 0.021912635891225555]
    np.testing.assert_allclose(found.sigmas, printed_sigmas, rtol=2e-4)
    # FORMULAS linearise at the adjusted observations, so results agree within a hundredth of a sigma
    np.testing.assert_allclose((found.values - printed_values) / found.sigmas, 0.0, atol=1e-2)
    np.testing.assert_allclose((found.values - np.array(TRUTH)) / found.sigmas, 0.0, atol=3.0)
    assert found.redundancy == pytest.approx(1443.0, abs=1e-3)
    assert found.variance_factor == pytest.approx(1.0417581361552588, rel=2e-4)
    assert not found.scaled
    assert found.global_test == pytest.approx(stats.chi2.sf(1443 * 1.0417581361552588, 1443), rel=0.02)
    (residuals,) = found.residuals
    np.testing.assert_allclose(residuals.redundancy.min(), 0.8469059274646641, rtol=5e-4)
    assert np.sqrt((residuals.normalised.astype(float) ** 2).mean()) == pytest.approx(1.0205406770769523, rel=2e-4)
    assert np.abs(residuals.normalised).max() == pytest.approx(3.598971266583061, rel=1e-3)
    mdb = 4.13 * residuals.sigma_m.astype(float) / np.sqrt(residuals.redundancy.astype(float))
    assert mdb.mean() == pytest.approx(0.24292794322106298, rel=2e-4)
    assert any("independent from return to return" in note for note in found.notes)


def test_the_printed_blunder_has_the_largest_w_and_is_removed() -> None:
    flight, features = worked().with_blunder().flight()
    plain = adjust(flight, features, ParameterOptions(), None, PLAIN)
    (residuals,) = plain.residuals
    worst = int(np.abs(residuals.normalised).argmax())
    assert abs(residuals.normalised[worst]) == pytest.approx(7.980954746253744, rel=3e-3)
    line = np.flatnonzero(worked().line == residuals.swath[worst])
    assert line[residuals.at[worst]] == 137
    kept = adjust(flight, features, ParameterOptions())
    (residuals,) = kept.residuals
    assert residuals.weight[worst] == 0.0
    assert residuals.weight.sum() == 1521
    clean = adjusted_as_printed()
    assert (np.abs(kept.values - clean.values) / clean.sigmas < 0.35).all()


NO_TIES = np.zeros(0, np.float32)


def block(
    flight: Flight, features: Features, options: ParameterOptions, prior: TrajectoryPrior | None
) -> tuple[Rows, Ties, TrajectoryWeight]:
    rows = Rows(flight, features.planes, unknowns(flight, options), prior)
    return rows, Ties(rows, features.ties, None), TrajectoryWeight(rows)


def knots(flown: Trajectory, every_s: float = 6.0) -> TrajectoryPrior:
    """Return a trajectory prior with a dense covariance, which no model describes."""
    g = np.random.default_rng(8)
    starts = flown.time_ns[np.concatenate([[True], np.diff(flown.time_ns) > 1_000_000_000])]
    times = np.concatenate([start + np.arange(3) * int(every_s * 1e9) for start in starts])
    count = len(times)
    sigma = np.tile([0.02, 0.02, 0.03, 3e-5, 3e-5, 8e-5], count)
    mixed = np.eye(6 * count) + 0.3 * g.normal(size=(6 * count, 6 * count)) / np.sqrt(6 * count)
    covariance = mixed @ mixed.T * np.outer(sigma, sigma)
    return TrajectoryPrior(np.zeros(count, np.int64), times, np.repeat(np.arange(len(starts)) + 1, 3), covariance)


@cache
def small() -> Made:
    return made(lines=LINES[:3], points=6)


@pytest.mark.parametrize("weighted", [True, False])
def test_reduced_equations_give_the_whole_dense_solution(weighted: bool) -> None:
    built, prior = small(), knots(small().flight.trajectories[0])
    rows, ties, weight = block(built.flight, built.features, ParameterOptions(priors={"range_offset_m": 0.05}), prior)
    state = rows.start()
    share = np.ones(rows.count, np.float32)
    state = moved(state, normals(rows, ties, weight, state, share, NO_TIES, 0.0).step())
    if weighted:
        share = np.random.default_rng(4).uniform(0.2, 1, rows.count).astype(np.float32)
    equations = normals(rows, ties, weight, state, share, NO_TIES, 0.0)
    columns, misclosure, variance, _ = design(rows, state)
    own = np.zeros((rows.count, 3 * len(rows.planes)))
    for row, (place, which) in enumerate(zip(*in_planes(rows, state), strict=True)):
        own[row, 3 * which : 3 * which + 3] = *place, 1.0
    whole = np.hstack([columns, own])
    p = share / variance
    normal, right = (whole.T * p) @ whole, (whole.T * p) @ misclosure
    u, rot = rows.size, np.kron(np.eye(len(prior.time_ns)), np.kron(np.eye(2), np.eye(3)))
    rot = weight.to_e(rot)
    inverse = np.linalg.inv(rot @ prior.covariance @ rot.T)
    states = state.knots.reshape(-1)
    normal[4:u, 4:u] += inverse
    right[4:u] += inverse @ states
    normal[3, 3] += 1 / 0.05**2
    right[3] += state.values[3] / 0.05**2
    scale = 1 / np.sqrt(np.diag(normal))
    covariance = np.linalg.inv(normal * np.outer(scale, scale)) * np.outer(scale, scale)
    sigma = np.sqrt(np.diag(covariance))
    scaled = covariance / np.outer(sigma, sigma)
    np.testing.assert_allclose(equations.covariance() / np.outer(sigma[:u], sigma[:u]), scaled[:u, :u], atol=1e-8)
    done, of_planes, _ = equations.step()
    step = -covariance @ right
    np.testing.assert_allclose(done / sigma[:u], step[:u] / sigma[:u], atol=1e-6)
    np.testing.assert_allclose(of_planes.ravel() / sigma[u:], step[u:] / sigma[u:], atol=1e-6)


def test_the_hard_constraint_equals_the_limit_of_a_weighted_one() -> None:
    """Four unknowns of a plane are tied by s1² + s2² + s3² = 1 with σ = 1e-7 (ISO/TS 19159-2 Eq. 18, 20)."""
    built = small()
    rows, ties, weight = block(built.flight, built.features, ParameterOptions(priors={"range_offset_m": 0.05}), None)
    ones, none = np.ones(rows.count, np.float32), NO_TIES
    state = rows.start()
    for _ in range(2):
        state = moved(state, normals(rows, ties, weight, state, ones, none, 0.0).step())
    equations = normals(rows, ties, weight, state, ones, none, 0.0)
    columns, misclosure, variance, plane = design(rows, state)
    places, _ = in_planes(rows, state)
    table = rows.plane_table(state)
    own = np.zeros((rows.count, 4 * len(rows.planes)))
    for row, which in enumerate(plane):
        away = places[row] @ np.stack([table.first_e[which], table.second_e[which]])
        own[row, 4 * which : 4 * which + 4] = *away, 1.0
    whole, p = np.hstack([columns, own]), 1.0 / variance
    normal, right = (whole.T * p) @ whole, (whole.T * p) @ misclosure
    normal[3, 3] += 1 / 0.05**2
    right[3] += state.values[3] / 0.05**2
    for index, mine in enumerate(state.normal_e):
        constraint = np.zeros(len(normal))
        constraint[4 + 4 * index : 7 + 4 * index] = 2.0 * mine
        normal += np.outer(constraint, constraint) * 1e14
    scale = 1 / np.sqrt(np.diag(normal))
    step = -np.linalg.solve(normal * np.outer(scale, scale), right * scale) * scale
    sigma = np.sqrt(np.diag(equations.covariance()))
    np.testing.assert_allclose(equations.step()[0] / sigma, step[:4] / sigma, atol=1e-4)
    assert np.abs(np.linalg.norm(moved(state, equations.step()).normal_e, axis=1) - 1.0).max() < 1e-15


def tied(built: Made, noise_m: float, seed: int) -> tuple[TiePoint, ...]:
    """Return the planes' centres as tie points, each seen where a return of every swath near it places it."""
    g, ties = np.random.default_rng(seed), []
    truth, flight = built.truth, built.flight
    for plane in built.features.planes:
        sightings = []
        for patch in plane.patches:
            at = int(patch.at[0])
            swath = flight.swaths[patch.swath]
            there = flight.place(swath, truth, np.array([at]))[0]
            point = swath.points_t[at] + (plane.centre_t - there) + noise_m * g.normal(size=3)
            sightings.append(Sighting(patch.swath, at, point, np.eye(3) * max(noise_m, 1e-3) ** 2))
        ties.append(TiePoint(plane.name, tuple(sightings)))
    return tuple(ties)


@pytest.mark.slow
def test_tie_points_alone_determine_the_truth() -> None:
    built = made(noise=0.0)
    prior = gauss_markov(built.flight, Taus(), 4.0)
    control = ControlPoint("a", built.features.planes[0].centre_t, 0.01)
    ties = tied(built, 0.0, 1)
    ties = (replace(ties[0], control=control), *ties[1:])
    exact = adjust(built.flight, Features(ties=ties), ParameterOptions(), prior, Settings(tolerance=1e-6))
    np.testing.assert_allclose(exact.values, built.truth.parameters[:4], atol=1e-9)
    sightings = sum(len(tie.sightings) for tie in ties)
    assert exact.redundancy == pytest.approx(3 * sightings + 3 - 3 * len(ties) - 4, abs=1e-6)
    noisy = adjust(built.flight, Features(ties=tied(built, 0.05, 2)), ParameterOptions(), prior)
    assert (np.abs(noisy.values - built.truth.parameters[:4]) < 3.5 * noisy.sigmas).all()
    assert 0.8 < noisy.variance_factor < 1.2
    figures = [noisy.variance_factor, noisy.global_test, *((one.variance_factor, one.rms_m) for one in noisy.groups)]
    assert json.loads(json.dumps(figures))


def test_a_wrong_sighting_is_removed() -> None:
    built = made(noise=0.0)
    prior = gauss_markov(built.flight, Taus(), 4.0)
    ties = list(tied(built, 0.05, 2))
    good = adjust(built.flight, Features(ties=tuple(ties)), ParameterOptions(), prior)
    first = ties[3].sightings[0]
    wrong = replace(first, point_t=first.point_t + np.array([0.0, 2.0, 0.5]))
    ties[3] = replace(ties[3], sightings=(wrong, *ties[3].sightings[1:]))
    found = adjust(built.flight, Features(ties=tuple(ties)), ParameterOptions(), prior)
    (residuals,) = (one for one in found.residuals if one.group == "ties")
    taken = np.flatnonzero(residuals.weight == 0.0)
    assert set(residuals.feature[taken]) == {3}
    assert set(residuals.swath[taken]) == {first.swath}
    (of_ties,) = (one for one in found.groups if one.group == "ties")
    assert (of_ties.observations, of_ties.rejected) == (len(residuals.weight), len(taken))  # all, and the rejected
    assert (np.abs(found.values - good.values) < 0.5 * good.sigmas).all()


def test_control_determines_the_range_offset_and_reports_each_point() -> None:
    built = made()
    prior = gauss_markov(built.flight, Taus(), 4.0)
    features = controlled(built)
    without = adjust(built.flight, built.features, ParameterOptions(), prior, PLAIN)
    found = adjust(built.flight, features, ParameterOptions(), prior, PLAIN)
    assert found.sigmas[3] < 0.9 * without.sigmas[3]
    assert abs(found.values[3] - built.truth.parameters[3]) < 3 * found.sigmas[3]
    planes = list(features.planes)
    left_out = planes[5].control[1]
    planes[5] = replace(planes[5], control=planes[5].control[:1])
    again = adjust(built.flight, Features(tuple(planes)), ParameterOptions(), prior, PLAIN)
    (fit,) = (one for one in found.control if one.name == left_out.name)
    change = (again.values - found.values) / found.sigmas
    np.testing.assert_allclose([fit.influence[name] for name in found.names], change, atol=1e-4)
    assert np.abs(change).max() > 1e-3
    assert len(found.control) == 10


def test_control_that_is_too_high_is_seen() -> None:
    built = made()
    prior = gauss_markov(built.flight, Taus(), 4.0)
    features = controlled(built)
    planes = list(features.planes)
    point = planes[10].control[0]
    high = replace(point, position_t=point.position_t + np.array([0.0, 0.0, 0.3]))
    planes[10] = replace(planes[10], control=(high, planes[10].control[1]))
    found = adjust(built.flight, Features(tuple(planes)), ParameterOptions(), prior)
    worst = max(found.control, key=lambda fit: abs(fit.normalised))
    assert worst.name == point.name
    assert worst.misclosure_m > 0.1
    assert worst.normalised > 5.0


def test_a_surveyed_plane_determines_the_height() -> None:
    built = made()
    prior = gauss_markov(built.flight, Taus(), 4.0)
    given = tuple(replace(plane, given_sigma_m=0.005, given_sigma_rad=1e-4) for plane in built.features.planes)
    free = adjust(built.flight, built.features, ParameterOptions(), prior)
    found = adjust(built.flight, Features(given), ParameterOptions(), prior)
    assert found.sigmas[3] < 0.7 * free.sigmas[3]
    assert (np.abs(found.values - built.truth.parameters[:4]) < 3.5 * found.sigmas).all()


def test_ten_percent_of_gross_errors_change_results_by_less_than_a_sigma() -> None:
    built = made()
    prior = gauss_markov(built.flight, Taus(), 4.0)
    good = adjust(built.flight, built.features, ParameterOptions(), prior)
    g, swaths, wrong = np.random.default_rng(6), [], 0
    for swath in built.flight.swaths:
        rows = swath.rows.copy()
        hit = g.uniform(size=len(rows)) < 0.1
        rows["range_m"][hit] += g.uniform(0.5, 6.0, int(hit.sum()))
        wrong += int(hit.sum())
        swaths.append(replace(swath, rows=rows))
    found = adjust(replace(built.flight, swaths=tuple(swaths)), built.features, ParameterOptions(), prior)
    (residuals,) = found.residuals
    assert (np.abs(found.values - good.values) < good.sigmas).all()
    assert 0.97 * wrong <= (residuals.weight == 0.0).sum() <= 1.02 * wrong
    assert 0.9 < found.variance_factor < 1.1


def test_sigmas_grow_if_observations_are_worse_than_stated() -> None:
    built = made(noise=2.0)
    prior = gauss_markov(built.flight, Taus(), 4.0)
    found = adjust(built.flight, built.features, ParameterOptions(), prior, Settings(family=0.0))
    said = adjust(built.flight, built.features, ParameterOptions(), prior, Settings(family=0.0, test_level=0.0))
    assert found.scaled
    assert not said.scaled
    assert 3.5 < found.variance_factor < 4.2
    np.testing.assert_allclose(found.sigmas, said.sigmas * np.sqrt(found.variance_factor), rtol=1e-9)


def test_undetermined_parameters_are_held_at_their_start() -> None:
    built = made(lines=LINES[:2], planes=roofs(0.0))
    prior = gauss_markov(built.flight, Taus(), 4.0)
    found = adjust(built.flight, built.features, ParameterOptions(), prior)
    assert {one.name for one in found.held} == {"range_offset_m"}
    assert found.names == ("left.omega_rad", "left.phi_rad", "left.kappa_rad")
    assert found.calibrations["left"].value("range_offset_m") == 0.0
    assert found.calibrations["left"].sigmas[0] == found.sigmas[0] > 0.0


def test_predicted_sigmas_match_the_adjustment() -> None:
    built = made()
    prior = gauss_markov(built.flight, Taus(), 4.0)
    at_truth = {"left": built.truth}
    asked, covariance = predict(built.flight, built.features, ParameterOptions(), prior, start=at_truth)
    found = adjust(built.flight, built.features, ParameterOptions(), prior, PLAIN, at_truth)
    assert asked.names == found.names
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), found.sigmas, rtol=1e-3)


def test_correspondences_are_repeated_until_stable() -> None:
    built = made()
    prior = gauss_markov(built.flight, Taus(), 4.0)
    asked = []

    def rematch(calibrations: object) -> Features:
        asked.append(calibrations)
        return built.features

    found = adjust(built.flight, built.features, ParameterOptions(), prior, rematch=rematch)
    assert found.matchings == 2
    assert len(asked) == 1
    coarse = Features(tuple(built.features.planes[:12]))
    more = adjust(built.flight, coarse, ParameterOptions(), prior, rematch=rematch)
    np.testing.assert_allclose(more.values, found.values, atol=0.02 * found.sigmas.min())
    assert more.matchings == 3


def test_all_observations_are_adjusted_once_correspondences_are_stable() -> None:
    built = made()
    prior = gauss_markov(built.flight, Taus(), 4.0)
    part = Features(tuple(built.features.planes[::2]))
    asked: list[dict[str, Calibration]] = []

    def everything(calibrations: dict[str, Calibration]) -> Features:
        asked.append(calibrations)
        return built.features

    found = adjust(built.flight, part, ParameterOptions(), prior, rematch=lambda _: part, entire=everything)
    whole = adjust(built.flight, built.features, ParameterOptions(), prior)
    less = adjust(built.flight, part, ParameterOptions(), prior)
    assert len(asked) == 1
    np.testing.assert_allclose(asked[0]["left"].parameters, less.calibrations["left"].parameters, atol=1e-6)
    np.testing.assert_allclose(found.values, whole.values, atol=0.05 * whole.sigmas.min())
    np.testing.assert_allclose(found.sigmas, whole.sigmas, rtol=1e-3)
    assert (found.sigmas < less.sigmas).all()
    same = adjust(built.flight, part, ParameterOptions(), prior, entire=lambda _: None)
    np.testing.assert_array_equal(same.values, less.values)


def test_returns_with_less_scatter_than_stated_are_weighted_by_their_scatter() -> None:
    built = made(noise=0.5, points=30)
    prior = gauss_markov(built.flight, Taus(), 4.0)
    found = adjust(built.flight, built.features, ParameterOptions(), prior, entire=lambda _: built.features)
    quieter = replace(built.flight.heads[0], noise=NOISE.times(0.5))
    known = adjust(replace(built.flight, heads=(quieter,)), built.features, ParameterOptions(), prior)
    said = adjust(built.flight, built.features, ParameterOptions(), prior)
    np.testing.assert_allclose(found.sigmas, known.sigmas, rtol=0.05)
    assert (found.sigmas < 0.95 * said.sigmas).any()
    assert found.variance_factor == pytest.approx(1.0, abs=0.1)
    assert any("scatter 0.5" in note for note in found.notes)


@pytest.mark.parametrize("noise", [1.0, 1.5])
def test_returns_with_at_least_the_stated_scatter_keep_their_sigmas(noise: float) -> None:
    built = made(noise=noise, points=30)
    prior = gauss_markov(built.flight, Taus(), 4.0)
    found = adjust(built.flight, built.features, ParameterOptions(), prior, entire=lambda _: built.features)
    said = adjust(built.flight, built.features, ParameterOptions(), prior)
    np.testing.assert_allclose(found.sigmas, said.sigmas, rtol=1e-3)
    assert not any("scatter" in note for note in found.notes)


def test_adjusted_trajectory_sigmas_are_below_the_prior() -> None:
    built = made()
    prior = gauss_markov(built.flight, Taus(), 4.0)
    found = adjust(built.flight, built.features, ParameterOptions(), prior).trajectory
    assert found is not None
    assert found.position_l.shape == (len(prior.time_ns), 3)
    assert (found.attitude_sigma_rad <= found.prior_attitude_sigma_rad * (1 + 1e-9)).all()
    assert (found.attitude_sigma_rad < 0.7 * found.prior_attitude_sigma_rad).any()
    assert (np.abs(found.position_l) < 5 * found.prior_position_sigma_l).all()


def test_without_observations_one_line_is_reported() -> None:
    with pytest.raises(NormalError, match="tie points to adjust; use strips that overlap"):
        adjust(made(lines=LINES[:1]).flight, Features(), ParameterOptions())


SCALED = {
    "omega_rad": 0.0037,
    "phi_rad": -0.0061,
    "kappa_rad": 0.0021,
    "range_offset_m": 0.18,
    "scan_angle_scale": 2.5e-4,
}
CROSSING = (LINES[0], LINES[4])


def unknown_start(built: Made) -> dict[str, Calibration]:
    """Return a start of which only plausible bounds are known."""
    return {"left": nominal("left", built.flight.heads[0].start.lever_arm_b, np.eye(3))}


@pytest.mark.parametrize("lines", [CROSSING, LINES[:3]], ids=["two crossing", "three"])
def test_a_held_scale_enters_the_sigma_of_the_range_offset(lines: tuple[Line, ...]) -> None:
    """A scan angle scale 250 ppm off moves the range offset by decimetres, many of the sigmas that ignore it."""
    built = made(truth=SCALED, lines=lines, points=100)
    prior, start = gauss_markov(built.flight, Taus(), 4.0), unknown_start(built)
    found = adjust(built.flight, built.features, ParameterOptions(), prior, PLAIN, start)
    assert found.names == tuple(f"left.{name}" for name in MODELS["basic"])
    error = np.abs(found.values - built.truth.parameters[:4])
    own = np.sqrt(found.sigmas**2 - (found.moved**2).sum(axis=1))
    assert (error < 3.0 * found.sigmas).all()
    assert lines != CROSSING or error[3] > 5.0 * own[3]
    column = [one.name for one in found.considered].index("scan_angle_scale")
    assert abs(found.moved[3, column]) > own[3]
    written = found.calibrations["left"]
    assert written.held_sigmas[INDEX["scan_angle_scale"]] == pytest.approx(3e-4)
    crossed = written.covariance()[INDEX["range_offset_m"], INDEX["scan_angle_scale"]]
    assert crossed == pytest.approx(found.moved[3, column] * 3e-4)


def test_parameters_partly_determined_by_two_lines_use_their_start_as_observation() -> None:
    """With the model `scanner` each sigma is at most the plausible one, and the scale spoils no range."""
    built = made(truth=SCALED, lines=CROSSING, points=100)
    prior, start = gauss_markov(built.flight, Taus(), 4.0), unknown_start(built)
    found = adjust(built.flight, built.features, ParameterOptions("scanner"), prior, PLAIN, start)
    kinds = [INDEX[name.partition(".")[2]] for name in found.names]
    assert INDEX["scan_angle_scale"] in kinds
    assert (found.sigmas <= [1.001 * PARAMETERS[kind].plausible for kind in kinds]).all()
    assert (np.abs(found.values - built.truth.parameters[kinds]) < 3.0 * found.sigmas).all()


def test_the_effect_of_a_held_parameter_equals_that_of_another_start() -> None:
    """The reference is the adjustment itself, started with the parameter one sigma away."""
    built = made(lines=LINES[:6])
    prior, start = gauss_markov(built.flight, Taus(), 4.0), unknown_start(built)
    found = adjust(built.flight, built.features, ParameterOptions(), prior, PLAIN, start)
    for name in ("scan_angle_scale", "range_scale", "time_offset_s"):
        column = [one.name for one in found.considered].index(name)
        away = {"left": start["left"].changed(**{name: found.considered[column].sigma})}
        other = adjust(built.flight, built.features, ParameterOptions(), prior, PLAIN, away)
        moved = found.moved[:, column]  # linear to a thousandth
        assert (np.abs(other.values - found.values - moved) < 1e-3 * (np.abs(moved) + found.sigmas)).all()


def test_a_flight_that_contradicts_a_held_parameter_reports_it() -> None:
    """A scale declared known to 5 ppm is 250 ppm off: the flight reveals it, and its sigma is rejected."""
    built = made(truth=SCALED)
    prior, start = gauss_markov(built.flight, Taus(), 4.0), unknown_start(built)
    options = ParameterOptions(fix=frozenset(["scan_angle_scale"]), priors={"scan_angle_scale": 5e-6})
    found = adjust(built.flight, built.features, options, prior, PLAIN, start)
    (one,) = (one for one in found.considered if one.contradicted)
    assert one.name == "scan_angle_scale"
    assert abs(one.told - 2.5e-4) < 4.0 * one.told_sigma
    assert one.sigma == pytest.approx(abs(one.told))
    assert (np.abs(found.values - built.truth.parameters[:4]) < 4.0 * found.sigmas).all()
    plain = adjust(built.flight, built.features, ParameterOptions(), prior, PLAIN, start)
    assert not any(one.contradicted for one in plain.considered)


@pytest.mark.parametrize("name", ["kappa_rad", "scan_angle_scale"])
def test_a_fixed_parameter_is_reported_as_wrong_if_the_flight_contradicts_it(name: str) -> None:
    """A plausible error is reported too, and the held parameter keeps its plausible sigma."""
    built = made(truth=SCALED)
    prior, start = gauss_markov(built.flight, Taus(), 4.0), {"left": replace(built.truth, method="nominal")}
    options, away = ParameterOptions(fix=frozenset([name])), {"kappa_rad": 3e-3, "scan_angle_scale": 2.5e-4}[name]
    right = adjust(built.flight, built.features, options, prior, PLAIN, start)
    assert not any(one.contradicted for one in right.considered)
    off = {"left": start["left"].changed(**{name: built.truth.value(name) + away})}
    found = adjust(built.flight, built.features, options, prior, PLAIN, off)
    (one,) = (one for one in found.considered if one.contradicted)
    assert one.name == name
    assert abs(one.told + away) < 4.0 * one.told_sigma < away
    assert one.sigma == pytest.approx(PARAMETERS[INDEX[name]].plausible)


def test_all_parameters_are_held_if_none_is_determined() -> None:
    built = made(lines=LINES[:1], planes=roofs(0.0))
    prior = gauss_markov(built.flight, Taus(), 4.0)
    found = adjust(built.flight, built.features, ParameterOptions(), prior)
    assert found.names == ()
    assert {one.name for one in found.held} == {"omega_rad", "phi_rad", "kappa_rad", "range_offset_m"}
    assert found.calibrations["left"].value("omega_rad") == 0.0


KNOTS = np.array([0.0, 10.0, 25.0, 45.0, 70.0, 100.0])
INTENSITY = np.linspace(0.0, 100.0, 401)
LOGARITHM = 0.3 * np.log((INTENSITY + 30.0) / (KNOTS[3] + 30.0))


def by_intensity(correction_m: FloatArray, noise: float = 1.0) -> Adjusted:
    """Return the calibration of a scanner with this correction at `INTENSITY`."""
    built = made(ibrc=(INTENSITY, correction_m), points=24, noise=noise)
    options = ParameterOptions(ibrc_knots=tuple(KNOTS.tolist()), ibrc_reference=45.0, ibrc_smoothness_m=1.0)
    return adjust(built.flight, built.features, options, gauss_markov(built.flight, Taus(), 4.0))


@pytest.mark.parametrize("share", [1.0, 0.0], ids=["there", "none is invented"])
def test_a_correction_by_intensity_lies_within_its_sigmas(share: float) -> None:
    """The sigmas are checked at the knots and in the middle between them."""
    found = by_intensity(share * LOGARITHM)
    assert found.converged
    at = [found.names.index(f"left.ibrc.{knot}") for knot in (0, 1, 2, 4, 5)]
    covariance = found.correlation[np.ix_(at, at)] * np.outer(found.sigmas[at], found.sigmas[at])
    assert (found.sigmas[at] < 0.004).all()
    table = found.calibrations["left"].ibrc
    assert table is not None
    assert at_knots(table[1])[3] == 0.0
    looked = np.arange(0, len(table[0]), STEPS // 2)
    looked = looked[looked != 3 * STEPS]
    by_knot = curve_by_knots(KNOTS, at_knots(table[1]))[[0, 1, 2, 4, 5]][:, looked]
    sigma_m = np.sqrt(np.einsum("kd,kl,ld->d", by_knot, covariance, by_knot))
    error_m = (table[1] - share * np.interp(table[0], INTENSITY, LOGARITHM))[looked]
    assert (np.abs(error_m) < 3.0 * sigma_m).all()


def test_a_smooth_correction_is_closer_than_any_piecewise_linear_one() -> None:
    """There is hardly any noise; the comparison is with the best polygon through the same knots."""
    hats = np.stack([np.interp(INTENSITY, KNOTS, one) for one in np.eye(len(KNOTS))], axis=1)
    best = hats @ np.linalg.lstsq(hats, LOGARITHM)[0]
    table = by_intensity(LOGARITHM, noise=1e-3).calibrations["left"].ibrc
    assert table is not None
    missed_m, lines_m = np.interp(INTENSITY, *table) - LOGARITHM, best - LOGARITHM
    assert np.sqrt(np.mean(missed_m**2)) < 0.25 * np.sqrt(np.mean(lines_m**2))
    assert (np.diff(table[1]) > 0.0).all()
