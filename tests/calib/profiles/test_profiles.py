"""Tests profiles: the lecture's numbers and signs, angles changed one at a time, and honest sigmas."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from functools import cache, partial
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.text import Text

from swath.calib.features import ControlPoint
from swath.calib.flight import Flight
from swath.calib.profiles.check import Check
from swath.calib.profiles.measure import Settings
from swath.calib.profiles.stepwise import (
    Given,
    Profile,
    formula,
    heading_rad,
    measure,
    pitch_rad,
    range_m,
    roll_rad,
    stepwise,
    survey,
)
from swath.daemon.processing.calibration.report.profiles import draw, most_precise, svg
from swath.georef.arrays import BoolArray, FloatArray
from tests.calib.analytic_scene import Line, Scanner, fly, gables, only, retold, truth_of
from tests.daemon.processing.pages.builders import overlapping

pytestmark = pytest.mark.xdist_group("kernels")

FRONT, REAR = np.eye(3), np.diag([-1.0, -1.0, 1.0])  # T = I and T = R3(180°)
THERE, BACK = Line(-145, 0, 90, 290, 300), Line(145, 10, 270, 290, 300)
BESIDE = Line(-145, 110, 90, 290, 300)
LINES = (THERE, BACK, BESIDE)
CONTROL = [
    ControlPoint(f"c{k}", np.array([x, y, 0.0]), 0.01)
    for k, (x, y) in enumerate([(-132.0, 20.0), (-132.0, -60.0), (-132.0, 80.0), (132.0, 40.0)])
]
THIN = Scanner(prf_hz=10_000.0)
ONE_AT_A_TIME = [("omega_rad", "roll"), ("phi_rad", "pitch"), ("kappa_rad", "heading"), ("range_offset_m", "range")]


ROUGH = Settings(rms_m=0.12)


def only_kind(found: tuple[Profile, ...], kind: str) -> list[Profile]:
    return [profile for profile in found if profile.kind == kind]


@cache
def village(lines: tuple[Line, ...] = LINES, *, rear: bool = False, **true: float) -> Flight:
    return fly(lines, gables(), true=true, installation=REAR if rear else FRONT, scanner=THIN)


def test_angles_match_the_numbers_of_the_lecture() -> None:
    assert roll_rad(4.8, 1002.0) == pytest.approx(0.00479038, abs=5e-9)
    assert pitch_rad(17.92, 902.5) == pytest.approx(0.00992765, abs=5e-9)
    assert heading_rad(0.61, 493.0) == pytest.approx(0.0012373, abs=5e-8)


def test_range_offset_uses_the_cosine_of_oblique_beams() -> None:
    cosine = np.cos(np.radians([0.0, 10.0, 25.0]))
    assert range_m(0.2 * cosine, cosine) == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("kind", "separation_m", "baseline_m", "words", "front_deg", "rear_deg"),
    [
        ("roll", -4.8, 1002.0, "counter-clockwise", -0.27447, "+0.27447"),
        ("pitch", 17.92, 1805.0, "forward", 0.56881, "-0.56881"),
        ("heading", -0.61, 493.0, "left rearward", -0.07089, ""),
    ],
)
def test_corrections_of_the_lecture_are_described_in_words_and_by_mounting(
    kind: str, separation_m: float, baseline_m: float, words: str, front_deg: float, rear_deg: str
) -> None:
    front = formula(kind, separation_m, baseline_m, FRONT)
    assert words in front
    assert f"{front_deg:+.5f}°" in front
    assert "own axes" not in front
    rear = formula(kind, separation_m, baseline_m, REAR)
    assert f"{front_deg:+.5f}°" in rear  # about the body's axes nothing changes
    assert (f"{rear_deg}° in the scanner's own axes" in rear) == bool(rear_deg)


@pytest.mark.slow
@pytest.mark.parametrize(("sign", "rear"), [(1.0, False), (-1.0, True)])
@pytest.mark.parametrize(("parameter", "kind"), ONE_AT_A_TIME)
def test_each_single_error_is_found(parameter: str, kind: str, sign: float, rear: bool) -> None:
    size = {"omega_rad": 0.004, "phi_rad": 0.006, "kappa_rad": 0.008, "range_offset_m": 0.15}[parameter] * sign
    lines = {"heading": (THERE, BESIDE), "range": (THERE,)}.get(kind, (THERE, BACK))
    found = survey(village(lines, rear=rear, **{parameter: size}), kind, CONTROL).profiles
    assert found
    for profile in found:
        # On the true trajectory only noise is left, and what a large error of one kind changes in another.
        assert abs(profile.found - size) < 3.0 * profile.noise_sigma + 0.01 * abs(size)
        assert abs(profile.found - size) < profile.sigma
        assert np.sign(profile.separation_m) == sign


@pytest.mark.slow
def test_a_flight_without_errors_gives_no_corrections() -> None:
    flight = village()
    found = measure(flight, CONTROL)
    assert {profile.kind for profile in found} == {"roll", "pitch", "heading", "range"}
    for profile in found:
        assert abs(profile.found) < 4.0 * profile.noise_sigma


@pytest.mark.slow
def test_the_procedure_finds_all_errors_and_is_reproducible() -> None:
    true = {"omega_rad": 0.012, "phi_rad": -0.01, "kappa_rad": 0.01, "range_offset_m": 0.35}
    result = stepwise(village(**true), CONTROL)
    assert [step.kind for step in result.steps] == 2 * ["roll", "pitch", "heading", "range"]
    assert not result.missing
    for name, value in true.items():
        assert abs(result.calibrations["left"].value(name) - value) < result.sigmas[f"left.{name}"]
    first, second = result.steps[0].found["left"][0], result.steps[4].found["left"][0]
    assert abs(first - true["omega_rad"]) > 0.5 * abs(second)  # the first round left an error for the second


def test_trajectory_errors_move_the_result_within_its_sigma() -> None:
    right = village((THERE, BACK))
    given = [
        Given("roll", 0, 1, np.array([-132.0, -120.0]), np.array([-132.0, 120.0])),
        Given("pitch", 0, 1, np.array([-140.0, 12.0]), np.array([140.0, 12.0])),
    ]
    for one in given:
        start, end = one.start_t, one.end_t
        low, high = np.minimum(start, end) - 6.0, np.maximum(start, end) + 6.0
        part = only(right, partial(_between, low, high))
        (profile,) = survey(part, one.kind, given=[one]).profiles
        for number, line in enumerate((THERE, BACK)):
            for state in range(number, 6, 2):  # each of the six states is wrong on one of the two lines
                moved = retold(part, (THERE, BACK), _told_wrong(number, line, state))
                (other,) = survey(moved, one.kind, given=[one]).profiles
                expected = -profile.by_trajectory[number][state]  # what is found corrects the visible error
                assert other.found - profile.found == pytest.approx(expected, abs=0.12 * profile.sigma)
        of_trajectory = sum(float(effect @ effect) for effect in profile.by_trajectory.values())
        assert profile.sigma == pytest.approx(math.sqrt(profile.noise_sigma**2 + of_trajectory), rel=0.1)
        assert profile.sigma > 5e-5 / math.sqrt(2.0)  # the turns of two lines, averaged


def _between(low: FloatArray, high: FloatArray, points: FloatArray) -> BoolArray:
    return np.asarray(((points[:, :2] > low) & (points[:, :2] < high)).all(axis=1))


def _told_wrong(number: int, line: Line, state: int) -> FloatArray:
    """Return (2, 6) errors of one sigma in one state (north, east, down, roll, pitch, heading) of one of two lines.

    The form is that of `retold`.
    """
    sin, cos = math.sin(math.radians(line.heading_deg)), math.cos(math.radians(line.heading_deg))
    turned = {
        0: (0.0, 0.02, 0.0, 0.0, 0.0, 0.0),
        1: (0.02, 0.0, 0.0, 0.0, 0.0, 0.0),
        2: (0.0, 0.0, -0.02, 0.0, 0.0, 0.0),
        3: (0.0, 0.0, 0.0, 5e-5 * cos, 5e-5 * sin, 0.0),
        4: (0.0, 0.0, 0.0, -5e-5 * sin, 5e-5 * cos, 0.0),
        5: (0.0, 0.0, 0.0, 0.0, 0.0, 5e-5),
    }
    errors = np.zeros((2, 6))
    errors[number] = turned[state]
    return errors


def test_noise_moves_the_result_within_its_noise_sigma() -> None:
    flight = village((THERE, BACK))
    flight = only(flight, lambda points: np.abs(points[:, 1] - 12.0) < 6.0)
    given = [Given("pitch", 0, 1, np.array([-140.0, 12.0]), np.array([140.0, 12.0]))]
    rng = np.random.default_rng(5)
    found, sigmas = [], []
    for _ in range(18):
        swaths = []
        for swath in flight.swaths:
            rows = swath.rows.copy()
            rows["range_m"] += rng.normal(0.0, 0.03, len(rows))
            swaths.append(replace(swath, rows=rows))
        (profile,) = survey(
            replace(flight, swaths=tuple(swaths)).placed(flight.starts()), "pitch", settings=ROUGH, given=given
        ).profiles
        found.append(profile.found)
        sigmas.append(profile.noise_sigma * 0.03 / math.hypot(0.02, 0.03))  # the noise that never changes
    assert np.std(found) / np.mean(sigmas) == pytest.approx(1.0, abs=0.5)  # 18 draws: ± 3 × 0.17


def test_a_given_profile_is_measured() -> None:
    flight = village((THERE, BACK), omega_rad=0.004)
    ends = np.array([-132.0, -120.0, 0.0]), np.array([-132.0, 120.0, 0.0])
    given = Given("roll", 0, 1, *ends)
    (profile,) = only_kind(measure(flight, given=[given]), "roll")
    np.testing.assert_allclose(profile.ends_t[:, :2], [ends[0][:2], ends[1][:2]])
    assert profile.found == pytest.approx(0.004, abs=5e-5)
    assert profile.separation_m == pytest.approx(math.tan(profile.found) * profile.baseline_m)


def test_flat_ground_gives_roll_only() -> None:
    flight = fly(LINES, lambda x, y: np.zeros(np.shape(x)), true={"omega_rad": 0.004}, scanner=THIN)
    result = stepwise(flight, settings=Settings(rounds=1))
    assert set(result.sigmas) == {"left.omega_rad"}
    assert set(result.missing) == {("left", "pitch"), ("left", "heading"), ("left", "range")}
    assert result.calibrations["left"].value("omega_rad") == pytest.approx(0.004, abs=2e-5)
    assert result.refused["pitch: both swaths share too few smooth slopes along the profile"] > 0


def test_even_slope_gives_pitch_as_in_the_lecture() -> None:
    """The profile has one slope, so a height error looks like a shift along it, which the sigma must include."""
    slope = 0.25
    flight = fly(
        [THERE, BACK],
        lambda x, y: slope * x,
        true={"phi_rad": 0.006},
        scanner=THIN,
        sigmas=(0.002, 5e-5),
        lowest_m=-45.0,
        highest_m=45.0,
    )
    found = survey(flight, "pitch").profiles
    assert found
    for profile in found:
        assert abs(profile.found - 0.006) < 3.0 * profile.noise_sigma
        assert sum(abs(effect[2]) for effect in profile.by_trajectory.values()) > 0.7 * 2 * 0.002 / slope / 600.0


def test_unsuitable_lines_give_no_profile() -> None:
    crossing = [THERE, Line(0, 145, 180, 290, 300)]
    flight = fly(crossing, gables(), scanner=Scanner(prf_hz=4_000.0))
    result = stepwise(flight)
    assert not result.sigmas
    assert {kind for _, kind in result.missing} == {"roll", "pitch", "heading", "range"}
    assert not any(step.profiles for step in result.steps)


@pytest.mark.slow
def test_opposite_lines_side_by_side_do_not_separate_heading_from_pitch() -> None:
    opposite = (THERE, Line(145, 90, 270, 290, 300))
    result = stepwise(village(opposite, phi_rad=0.006), settings=Settings(rounds=1))
    assert not result.sigmas
    assert {("left", "pitch"), ("left", "heading")} <= set(result.missing)
    same = (THERE, Line(-145, 90, 90, 290, 300))
    result = stepwise(village(same, phi_rad=0.006), settings=Settings(rounds=1))
    assert set(result.sigmas) == {"left.kappa_rad"}
    assert abs(result.calibrations["left"].value("kappa_rad")) < result.sigmas["left.kappa_rad"]


def test_trees_are_harmless() -> None:
    flight = village((THERE, BACK), phi_rad=0.006)
    rng = np.random.default_rng(2)
    swaths = []
    for swath in flight.swaths:
        rows = swath.rows.copy()
        x, y = swath.points_t[:, 0], swath.points_t[:, 1]
        tree = (np.hypot((x % 30.0) - 15.0, (y % 30.0) - 15.0) < 4.0) & (rng.uniform(size=len(rows)) < 0.7)
        rows["range_m"][tree] -= rng.uniform(0.0, 12.0, int(tree.sum()))
        swaths.append(replace(swath, rows=rows))
    flight = replace(flight, swaths=tuple(swaths)).placed(flight.starts())
    found = survey(flight, "pitch").profiles
    assert found
    for profile in found:
        assert abs(profile.found - 0.006) < profile.sigma


def test_corrected_sections_coincide() -> None:
    flight = village((THERE, BACK), omega_rad=0.004)
    profile = survey(flight, "roll").profiles[0]
    for pair, tilt in ((profile.before, 2.0 * 0.004), (profile.after, 0.0)):
        slopes = []
        for section in pair:
            flat = section.height_m < 1.5
            slopes.append(np.polyfit(section.distance_m[flat], section.height_m[flat], 1)[0])
        assert abs(slopes[0] - slopes[1]) == pytest.approx(tilt, abs=3e-4)


def test_points_lie_on_the_ground_with_the_true_calibration() -> None:
    """This checks the simulated scene itself."""
    true = {"omega_rad": 0.004, "phi_rad": -0.006, "kappa_rad": 0.01, "range_offset_m": 0.15}
    flight = fly(
        [THERE],
        lambda x, y: 0.1 * x,
        true=true,
        scanner=Scanner(prf_hz=2_000.0, range_noise_m=0.0),
        lowest_m=-20.0,
        highest_m=20.0,
    )
    points = flight.place(flight.swaths[0], truth_of(flight, **true))
    np.testing.assert_allclose(points[:, 2], 0.1 * points[:, 0], atol=1e-4)


def test_the_picture_is_valid_svg_with_strip_names_and_without_the_formula() -> None:
    profile = survey(village((THERE, BACK), phi_rad=0.006), "pitch").profiles[0]
    text = svg(profile)
    ElementTree.fromstring(text)  # one well-formed drawing
    assert text == svg(profile)
    figure = draw(profile)
    words = " ".join(one.get_text() for one in figure.findobj(Text) if isinstance(one, Text))
    assert profile.formula.split(" = ")[0] not in words  # the formula is in the appendix
    assert {"Before", "After", *profile.names} <= set(words.split())
    assert overlapping(figure) == []
    assert re.search(r"found [+−]0\.\d+ ± 0\.0*\d\d°, ", words)  # the sigma with two digits
    assert not re.search(r"(?<!\w)-\d", words)
    legend = figure.axes[1].get_legend()
    assert legend is not None
    assert [handle.get_marker() for handle in legend.get_lines()] == ["o", "^"]


def test_the_report_shows_a_range_section_before_and_after() -> None:
    """The range is wrong by 1.37 m: the ground is too high by that before, and by the remaining error after."""
    flight = village((THERE,), range_offset_m=1.37)
    start = flight.heads[0].start
    for left_m in (0.0, 0.2):
        adjusted = {"left": start.changed(range_offset_m=1.37 - left_m)}
        profiles = survey(flight.placed(adjusted), "range", CONTROL, calibrations=adjusted).profiles
        (shown,) = most_precise(Check(profiles, ()), flight, CONTROL)
        before, after = draw(shown).axes
        heights = [np.asarray(axes.collections[0].get_offsets())[:, 1] for axes in (before, after)]
        assert len(heights[0]) == len(heights[1]) > 1
        # along the vertical a range error counts by the cosine of the beam's angle, at most 24° here
        assert (heights[0] > 1.37 * 0.9).all()
        assert (heights[0] < 1.37 * 1.01 + 0.05).all()
        np.testing.assert_allclose(heights[1], left_m * heights[0] / 1.37, atol=0.05)
        assert before.get_xlim() == after.get_xlim()


def test_the_report_shows_the_roll_left_by_the_adjustment() -> None:
    """The profile's own finding is not applied, because it would always make the two lines coincide."""
    flight = village((THERE, BACK), omega_rad=0.01)
    adjusted = {"left": flight.heads[0].start.changed(omega_rad=0.006)}
    profiles = survey(flight.placed(adjusted), "roll", calibrations=adjusted).profiles[:1]
    (shown,) = most_precise(Check(profiles, ()), flight)
    apart = []
    for axes in draw(shown).axes:
        sections = [np.asarray(one.get_offsets(), np.float64) for one in axes.collections]
        lines = [np.polyfit(section[:, 0], section[:, 1], 1)[0] for section in sections]
        apart.append(abs(lines[0] - lines[1]))
    assert apart[0] == pytest.approx(2.0 * 0.01, rel=0.2)
    assert apart[1] == pytest.approx(2.0 * 0.004, rel=0.3)


@pytest.mark.slow
def test_a_pitch_found_for_one_scanner_does_not_apply_to_another() -> None:
    """Scanner left flew lines that determine pitch; right flew opposite lines side by side, which heading moves too."""
    one = village(phi_rad=0.006)
    other = village((THERE, Line(145, 90, 270, 290, 300)), phi_rad=0.006)
    right = replace(other.heads[0], name="right", start=replace(other.heads[0].start, scanner="right"))
    flown = (*one.trajectories, *other.trajectories)
    swaths = (
        *one.swaths,
        *(replace(swath, head=1, trajectory_index=len(LINES) + swath.trajectory_index) for swath in other.swaths),
    )
    flight = replace(one, heads=(*one.heads, right), trajectories=flown, swaths=swaths)
    result = stepwise(flight, settings=Settings(rounds=1))
    assert {"left.phi_rad", "left.kappa_rad"} <= set(result.sigmas)
    assert not any(name.startswith("right.") for name in result.sigmas)
