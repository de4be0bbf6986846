"""Tests that strip adjustment finds errors in the strips that have them, with their model, and in no others."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from swath.calib.equations.trajectory_prior import TrajectoryPrior, apply, knots_of
from swath.calib.features import ControlPoint, Features
from swath.calib.flight import Flight
from swath.calib.strips import corrections as strip_functions
from swath.calib.strips import determined as strip_unknowns
from swath.calib.strips.corrections import Settings, StripAdjusted, StripError, adjust_strips
from swath.georef.arrays import FloatArray
from swath.georef.geodesy.rotations import rot_z
from swath.georef.scanner.calibration import INDEX
from tests.calib.planned_flight import ONE_HEIGHT, flown, noised

pytestmark = pytest.mark.xdist_group("kernels")

TURN, HEIGHT_M = float(np.radians(0.02)), 795.0  # above the planes
PRIORS = np.repeat([0.2, TURN], 3)
ACROSS_M = np.linspace(-460.0, 460.0, 47)  # over the whole swath


@pytest.fixture(scope="module")
def clean() -> tuple[Flight, Features]:
    flight, features = flown(ONE_HEIGHT)
    return noised(flight, 3), features


def spoilt(flight: Flight, strip: int, along: FloatArray, knot_s: float = 1.0) -> Flight:
    """Return the flight with errors (k, 6), spread evenly along one strip, missing from its trajectory."""
    knots = knots_of(flight, knot_s)
    at = np.flatnonzero(knots.strip == strip)
    errors = np.zeros((len(knots), 6))
    places = np.linspace(0.0, 1.0, len(along))
    errors[at] = np.stack([np.interp(np.linspace(0, 1, len(at)), places, column) for column in along.T], axis=1)
    prior = TrajectoryPrior(knots.trajectory_index, knots.time_ns, knots.strip, np.eye(6 * len(knots)))
    return replace(flight, trajectories=(apply(flight.trajectories[0], 0, prior, -errors),))


def adjusted(flight: Flight, features: Features, **settings: Any) -> StripAdjusted:
    return adjust_strips(flight, features, flight.starts(), replace(Settings(), **settings))


def off_planes(flight: Flight, features: Features, strip: int) -> float:
    """Return the RMS distance, m, of a strip's returns from the true planes."""
    found = []
    for plane in features.planes:
        for patch in plane.patches:
            swath = flight.swaths[patch.swath]
            if swath.strip == strip:
                points = flight.place(swath, flight.heads[0].start, patch.at)
                found.append((points - swath.points_t[patch.at]) @ plane.normal_t)
    return float(np.sqrt(np.mean(np.concatenate(found) ** 2)))


def test_without_features_nothing_is_adjusted(clean: tuple[Flight, Features]) -> None:
    with pytest.raises(StripError, match="several strips share neither planes nor tie points"):
        adjusted(clean[0], Features(()))


def test_a_sound_flight_gets_no_corrections(clean: tuple[Flight, Features]) -> None:
    """Its misclosures are as large as its noise."""
    flight, features = clean
    result = adjusted(flight, features)
    assert [choice.model for choice in result.choices] == ["none"] * 6
    assert [choice.strip for choice in result.choices] == [1, 2, 3, 4, 5, 6]
    assert not result.fit.position_l.any()
    assert result.parameters == 0.0
    freedom = result.observations - 3 * len(features.planes)
    factor = result.variance_after * result.observations / freedom
    assert abs(factor - 1.0) < 4.0 * np.sqrt(2.0 / freedom)
    np.testing.assert_array_equal(result.trajectories[0].position_e, flight.trajectories[0].position_e)


@pytest.mark.slow
def test_a_shift_and_a_drift_are_found_in_their_strips(clean: tuple[Flight, Features]) -> None:
    """One strip is 15 cm too high and 10 cm aside, another's roll drifts; both are corrected and no other moves."""
    flight, features = clean
    shifted = np.tile([0.05, -0.1, 0.15, 0.0, 0.0, 0.0], (2, 1))
    drifting = np.array([[0.0, 0.0, 0.0, -TURN, 0.0, 0.0], [0.0, 0.0, 0.0, TURN, 0.0, 0.0]])
    bad = spoilt(spoilt(flight, 3, shifted), 5, drifting)
    assert off_planes(bad, features, 3) > 0.1
    result = adjusted(bad, features)
    assert [choice.model for choice in result.choices] == ["none", "none", "constant", "none", "linear", "none"]
    corrected = replace(bad, trajectories=result.trajectories)
    for strip in (3, 5):
        assert off_planes(corrected, features, strip) < 1.03 * off_planes(flight, features, strip)
        mine = result.fit.strip == strip
        truth = shifted[:1] if strip == 3 else np.interp(np.linspace(-1, 1, mine.sum()), [-1, 1], [-TURN, TURN])
        found = np.concatenate([result.fit.position_l, result.fit.attitude_rad], axis=1)[mine]
        sigma = np.concatenate([result.fit.position_sigma_l, result.fit.attitude_sigma_rad], axis=1)[mine]
        wanted = np.tile(truth, (len(found), 1)) if strip == 3 else truth[:, np.newaxis] * [0, 0, 0, 1, 0, 0]
        if strip == 3:  # on a course of north returns show only the sum of this shift and a turn about east
            wanted[:, 4] = wanted[:, 0] / HEIGHT_M
        assert (np.abs(found - wanted) < 3.5 * sigma).all()
        assert (sigma[:, 2] < 0.02).all()
    components = result.choices[2].components
    np.testing.assert_array_equal(components.determined, [False, True, True, True, True, True])
    assert components.absorbs[4, 0]
    assert components.absorbs.sum() == 1
    others = ~np.isin(result.fit.strip, [3, 5])
    assert not result.fit.position_l[others].any()
    assert result.variance_after < 1.1 < 3.0 < result.variance_before
    gains = result.choices[2].gains
    assert gains["constant"] == 0.0
    assert gains["none"] > 1000.0
    assert 0.0 < gains["linear"] < gains["spline"]


@pytest.mark.slow
def test_a_bend_needs_a_spline_with_knots(clean: tuple[Flight, Features]) -> None:
    """A strip's height rises by 12 cm in its middle."""
    flight, features = clean
    swell = np.zeros((9, 6))
    swell[:, 2] = 0.12 * np.sin(np.linspace(0.0, np.pi, 9)) ** 2
    bad = spoilt(flight, 2, swell)
    result = adjusted(bad, features, knot_s=3.0)
    assert [choice.model for choice in result.choices] == ["none", "spline", "none", "none", "none", "none"]
    middle = result.fit.position_l[result.fit.strip == 2, 2]
    assert middle.max() == pytest.approx(0.12, abs=0.02)
    corrected = replace(bad, trajectories=result.trajectories)
    assert off_planes(corrected, features, 2) < 1.1 * off_planes(flight, features, 2)
    stiff = adjusted(bad, features, knot_s=3.0, models=("none", "constant", "linear"))
    assert "spline" not in [choice.model for choice in stiff.choices]
    assert stiff.variance_after > 1.3 * result.variance_after
    assert adjusted(bad, features, knot_s=3.0, criterion="aicc").choices[1].model == "spline"


@pytest.mark.slow
@pytest.mark.parametrize("lifts", [{1: 0.15}, {6: 0.15}, {1: 0.15, 3: 0.1}, {1: -0.1, 2: 0.1}])
def test_only_the_displaced_strips_are_corrected(clean: tuple[Flight, Features], lifts: dict[int, float]) -> None:
    """The other strips agree, so none of them may be moved to the wrong one, whichever it is."""
    flight, features = clean
    bad = flight
    for strip, lift in lifts.items():
        bad = spoilt(bad, strip, np.tile([0.0, 0.0, lift, 0.0, 0.0, 0.0], (2, 1)))
    result = adjusted(bad, features)
    models = {choice.strip: choice.model for choice in result.choices}
    assert models == {strip: "constant" if strip in lifts else "none" for strip in range(1, 7)}
    for strip, lift in lifts.items():
        mine = result.fit.strip == strip
        off = np.abs(result.fit.position_l[mine, 2] - lift)
        assert (off < 3.5 * result.fit.position_sigma_l[mine, 2]).all()


@pytest.mark.slow
def test_a_common_shift_is_found_only_with_control(clean: tuple[Flight, Features]) -> None:
    """All strips are 12 cm too high; nothing is found without control, and it is right within a centimetre with it."""
    flight, features = clean
    low = flight
    for strip in range(1, 7):
        low = spoilt(low, strip, np.tile([0.0, 0.0, 0.12, 0.0, 0.0, 0.0], (2, 1)))
    assert [choice.model for choice in adjusted(low, features).choices] == ["none"] * 6
    planes = tuple(
        replace(plane, control=(ControlPoint(f"c{index}", plane.centre_t, 0.005),))
        if plane.normal_t[2] > 0.99
        else plane
        for index, plane in enumerate(features.planes)
    )
    result = adjusted(low, replace(features, planes=planes), models=("none", "constant"))
    assert [choice.model for choice in result.choices] == ["constant"] * 6
    down = [off_planes(replace(low, trajectories=result.trajectories), features, strip) for strip in range(1, 7)]
    assert max(down) < 0.03 < off_planes(low, features, 1)


@pytest.mark.slow
def test_poorly_determined_corrections_are_not_applied(
    clean: tuple[Flight, Features], monkeypatch: pytest.MonkeyPatch
) -> None:
    """With level ground and three returns of a roof, noise would move the strip sideways, where nothing is wrong."""
    flight, features = clean
    seen = [plane for plane in features.planes if 3 in [flight.swaths[patch.swath].strip for patch in plane.patches]]
    roof = next(plane for plane in seen if plane.normal_t[2] < 0.99)
    few = replace(roof, patches=tuple(replace(patch, at=patch.at[:3]) for patch in roof.patches))
    level = tuple(plane for plane in features.planes if plane.normal_t[2] > 0.99)
    poor = replace(features, planes=(*level, few))
    bad = spoilt(flight, 3, np.tile([0.0, 0.0, 0.15, 0.0, 0.0, 0.0], (2, 1)))
    result = adjusted(bad, poor)
    assert [choice.model for choice in result.choices] == ["none", "none", "constant", "none", "none", "none"]
    mine = result.fit.strip == 3
    height_sigma = result.fit.position_sigma_l[mine, 2]
    assert (np.abs(result.fit.position_l[mine, 2] - 0.15) < 3.5 * height_sigma).all()
    assert (height_sigma < 0.02).all()
    components = result.choices[2].components
    assert not components.determined[[0, 1]].any()
    assert not result.fit.position_l[mine, :2].any()
    np.testing.assert_array_equal(components.mean[~components.determined], 0.0)
    np.testing.assert_array_equal(components.sigma[[0, 1]], 0.2)
    monkeypatch.setattr(strip_unknowns, "MOST_LEFT", 1.0)
    assert np.abs(adjusted(bad, poor).fit.position_l[mine, :2]).max() > 0.02


def seen_by_few(flight: Flight, features: Features, alone: int) -> Features:
    """Remove a strip from all planes, so that it has no plane in common with another one."""
    planes = [
        replace(plane, patches=tuple(one for one in plane.patches if flight.swaths[one.swath].strip != alone))
        for plane in features.planes
    ]
    return replace(features, planes=tuple(planes))


def turned(components: FloatArray, course_deg: float) -> FloatArray:
    """Return components along, across, down as north, east, down."""
    rotation = rot_z(np.radians(course_deg))
    return np.concatenate([rotation @ components[:3], rotation @ components[3:]])


@pytest.mark.slow
def test_a_strip_beside_the_others_is_not_corrected_and_moves_none(clean: tuple[Flight, Features]) -> None:
    """Strip 6 shares no plane with others; strip 7 overlaps them only at its edge, where it is 30 cm too high.

    The edge shows height and roll together. Neither may be guessed, and no other strip may follow it.
    """
    flight, features = flown((*ONE_HEIGHT, (0.0, 800.0, 700.0)))
    features = seen_by_few(flight, features, 6)
    bad = spoilt(noised(flight, 5), 3, np.tile([0.0, 0.0, 0.15, 0.0, 0.0, 0.0], (2, 1)))
    bad = spoilt(bad, 6, np.tile([0.1, 0.1, -0.3, 0.0, 0.0, 0.0], (2, 1)))
    bad = spoilt(bad, 7, np.tile([0.0, 0.0, 0.3, 0.0, 0.0, 0.0], (2, 1)))
    result = adjusted(bad, features)
    models = {choice.strip: choice.model for choice in result.choices}
    assert [models[strip] for strip in (1, 2, 3, 4, 5, 6)] == ["none", "none", "constant", "none", "none", "none"]
    for strip in (1, 2, 4, 5, 6, 7):
        mine = result.fit.strip == strip
        assert not result.fit.position_l[mine].any()
        assert not result.fit.attitude_rad[mine].any()
        times = bad.swaths[strip - 1].time_ns
        assert bad.swaths[strip - 1].strip == strip
        was, corrected = (one.poses(times).position_e for one in (bad.trajectories[0], result.trajectories[0]))
        np.testing.assert_allclose(corrected, was, rtol=0.0, atol=1e-6)
    for strip, determined_here in ((1, True), (6, False), (7, False)):
        components = result.choices[strip - 1].components
        assert components.determined[[2, 3]].all() == determined_here
        assert components.determined[[2, 3]].any() == determined_here
        assert not components.datum.any()
    np.testing.assert_array_equal(result.choices[5].components.redundancy, 0.0)
    assert abs(result.choices[2].components.mean[2] - 0.15) < 3.5 * result.choices[2].components.sigma[2] < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1.0, 0.25])
def test_corrected_heights_are_no_worse_and_sigmas_honest(scale: float) -> None:
    """Strips 3, 5, 6 and 7 of forty flights err in all six components, by the prior's sigmas or a quarter of them."""
    flight, features = flown((*ONE_HEIGHT, (0.0, 800.0, 700.0)))
    features, courses = seen_by_few(flight, features, 6), (0.0, 180.0, 0.0, 0.0, 90.0, 270.0, 0.0)
    rng = np.random.default_rng(11)
    ratios: dict[int, list[float]] = {component: [] for component in range(6)}
    square_m: dict[int, list[tuple[float, float]]] = {3: [], 5: [], 6: [], 7: []}
    for run in range(40):
        bad, truth = noised(flight, 300 + run), {}
        for strip in square_m:
            truth[strip] = scale * PRIORS * rng.standard_normal(6)
            bad = spoilt(bad, strip, np.tile(turned(truth[strip], courses[strip - 1]), (2, 1)))
        for choice in adjusted(bad, features).choices:
            if choice.strip not in square_m:
                assert choice.model == "none"
                continue
            true, found = truth[choice.strip], choice.components
            np.testing.assert_array_equal(found.mean[~found.determined], 0.0)
            left = true - found.mean
            square_m[choice.strip].append(
                (
                    float(np.mean((true[2] + ACROSS_M * true[3]) ** 2)),
                    float(np.mean((left[2] + ACROSS_M * left[3]) ** 2)),
                )
            )
            if found.absorbs[4, 0]:  # together they shift the ground below by this much
                left[4] += true[0] / HEIGHT_M
            for component in np.flatnonzero(found.determined & (choice.model != "none")).tolist():
                ratios[component].append(float(left[component] / found.sigma[component]))
    for strip, pairs in square_m.items():
        before, after = np.array(pairs).T
        assert (after <= before).all()
        if strip in (3, 5):
            assert np.sqrt(after.mean()) < 0.005
    for component in (1, 2, 3, 4, 5):
        square = np.square(ratios[component])
        assert len(square) >= 70
        assert 0.7 < square.mean() < 1.6
        assert square.max() < 4.5**2


@pytest.mark.slow
def test_sigmas_contain_the_errors_of_the_held_calibration(clean: tuple[Flight, Features]) -> None:
    """The calibration of thirty flights errs by its own covariance; control makes all corrections absolute."""
    flight, features = clean
    planes = tuple(
        replace(plane, control=(ControlPoint(f"c{index}", plane.centre_t, 0.005),))
        for index, plane in enumerate(features.planes)
    )
    features, (start,) = replace(features, planes=planes), flight.starts().values()
    at = [INDEX[name] for name in ("omega_rad", "phi_rad", "kappa_rad", "range_offset_m")]
    sigmas, correlation = np.zeros(len(INDEX)), np.eye(len(INDEX))
    sigmas[at] = [*np.radians([0.004, 0.006, 0.008]), 0.01]
    correlation[at[0], at[1]] = correlation[at[1], at[0]] = 0.6
    told = replace(start, sigmas=sigmas, held_sigmas=np.zeros(len(INDEX)), correlation=correlation)
    rng, courses = np.random.default_rng(5), (0.0, 180.0, 0.0, 0.0, 90.0, 270.0)
    with_it: dict[int, list[float]] = {component: [] for component in range(6)}
    without_it: list[float] = []
    for run in range(30):
        true = PRIORS * rng.standard_normal(6) * [0, 1, 1, 1, 0, 1]  # returns show only the sum of along and pitch
        bad = spoilt(noised(flight, 900 + run), 3, np.tile(turned(true, courses[2]), (2, 1)))
        error = rng.multivariate_normal(np.zeros(len(INDEX)), told.covariance())
        held = {start.scanner: replace(told, parameters=told.parameters + error)}
        for choice in adjust_strips(bad, features, held, replace(Settings(), models=("constant",))).choices:
            found = choice.components
            left = (true if choice.strip == 3 else 0.0) - found.mean
            by_returns = np.sqrt(found.sigma**2 - found.of_calibration**2)
            for component in np.flatnonzero(found.determined).tolist():
                with_it[component].append(float(left[component] / found.sigma[component]))
                without_it.append(float(left[component] / by_returns[component]))
    assert all(len(with_it[component]) >= 100 for component in (1, 2, 3, 5))
    for ratios in with_it.values():
        if len(ratios) >= 100:
            assert 0.6 < np.mean(np.square(ratios)) < 1.6
    assert np.mean(np.square(without_it)) > 5.0


def test_the_held_calibration_is_part_of_the_sigmas(clean: tuple[Flight, Features]) -> None:
    """A roll of 0.004° becomes roll; a file without sigmas adds nothing, and a note reports it."""
    flight, features = clean
    bad = spoilt(flight, 3, np.tile([0.0, 0.0, 0.15, 0.0, 0.0, 0.0], (2, 1)))
    (start,) = flight.starts().values()
    sigmas = np.zeros(len(INDEX))
    sigmas[INDEX["omega_rad"]] = np.radians(0.004)
    bare = replace(start, sigmas=np.zeros(len(INDEX)), held_sigmas=np.zeros(len(INDEX)))
    told = replace(bare, sigmas=sigmas, correlation=np.eye(len(INDEX)))
    settings = replace(Settings(), models=("none", "constant"))
    without, with_it = (adjust_strips(bad, features, {start.scanner: held}, settings) for held in (bare, told))
    lacks = "the held calibration's file tells no sigmas, and no sigma here contains its errors"
    assert lacks in without.notes
    assert lacks not in with_it.notes
    one, two = (result.choices[2].components for result in (without, with_it))
    assert not one.of_calibration.any()
    np.testing.assert_array_equal(one.mean, two.mean)
    np.testing.assert_allclose(two.sigma**2, one.sigma**2 + two.of_calibration**2)
    assert two.of_calibration[1:].any()
    mine = with_it.fit.strip == 3
    assert (with_it.fit.position_sigma_l[mine] >= without.fit.position_sigma_l[mine]).all()
    assert (with_it.fit.attitude_sigma_rad[mine] >= without.fit.attitude_sigma_rad[mine]).all()


def test_a_calibration_that_may_be_far_off_corrects_no_strip(clean: tuple[Flight, Features]) -> None:
    """A roll that is known to 1° moves the strips by more than the prior sigmas, however good the returns are."""
    flight, features = clean
    bad = spoilt(flight, 3, np.tile([0.0, 0.0, 0.15, 0.0, 0.0, 0.0], (2, 1)))
    (start,) = flight.starts().values()
    sigmas = np.zeros(len(INDEX))
    sigmas[INDEX["omega_rad"]] = np.radians(1.0)
    told = replace(start, sigmas=sigmas, held_sigmas=np.zeros(len(INDEX)), correlation=np.eye(len(INDEX)))
    result = adjust_strips(
        bad, features, {start.scanner: told}, replace(Settings(), models=("none", "constant", "linear"))
    )
    for choice in result.choices:
        own = choice.components
        assert (own.mean[~own.determined] == 0.0).all()
        assert (own.of_calibration[own.determined] <= PRIORS[own.determined]).all()
    outweighed = np.array([choice.components.outweighed for choice in result.choices])
    sizes = np.array([choice.components.of_calibration for choice in result.choices])
    assert outweighed[:, 3].any()  # roll
    assert (sizes[outweighed] > np.broadcast_to(PRIORS, sizes.shape)[outweighed]).all()
    assert not np.abs(result.fit.attitude_rad[:, 0]).max() > 3.0 * PRIORS[3]


def test_more_strips_than_the_limit_share_one_model(
    clean: tuple[Flight, Features], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(strip_functions, "MOST_CHOSEN_SINGLY", 3)
    flight, features = clean
    bad = spoilt(flight, 3, np.tile([0.0, 0.0, 0.3, 0.0, 0.0, 0.0], (2, 1)))
    result = adjusted(bad, features)
    assert sorted(choice.model for choice in result.choices) == ["constant"] * 5 + ["none"]  # one holds the datum
    (held,) = (choice for choice in result.choices if choice.model == "none")
    assert held.components.datum.all()
    assert held.strip != 3
    found = result.choices[2].components
    assert abs(found.mean[2] - 0.3) < 3.5 * found.sigma[2] < 0.02
    assert f"no control: strip {held.strip:02d} keeps its trajectory, and corrections of others are relative to it" in (
        result.notes
    )
    assert "6 strips, more than 3, so all use the same model" in result.notes


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"models": ("none", "cubic")}, "strip model: got 'cubic', want some of none, constant, linear, spline"),
        ({"criterion": "cp"}, "criterion: got 'cp', want bic or aicc"),
        ({"models": ()}, "strip model: got none at all"),
    ],
)
def test_impossible_settings_are_refused(
    clean: tuple[Flight, Features], settings: dict[str, object], words: str
) -> None:
    with pytest.raises(StripError, match=words):
        adjusted(clean[0], clean[1], **settings)
