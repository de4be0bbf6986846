"""Signatures: the effects of FORMULAS 5.3 against printed numbers and central differences; what a wrong calibration
leaves in the strips is found with its size, and what is not there is not."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from swath.calib.equations.trajectory_prior import Taus, apply, draw, gauss_markov
from swath.calib.flight import Flight
from swath.calib.strips.cells import StripRules
from swath.calib.strips.differences import differences
from swath.calib.strips.effects import NAMES, SeenFrom, effect_columns
from swath.calib.strips.signatures import Signature, record_of, signatures
from swath.georef.arrays import FloatArray
from swath.georef.formats.trajectory.csv import csv_text
from swath.georef.formats.trajectory.file import read_trajectory
from swath.georef.geodesy.rotations import rot_x
from swath.georef.scanner.jacobian import parameter_columns_e
from swath.georef.scanner.mount import Mount, Stage
from tests.calib.cast_flight import Cast, cast_flight

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("kernels")]

RULES = StripRules(most_cells=3000)


@pytest.fixture(scope="module")
def made() -> Cast:
    """Return four lines over a village at 400 m, without errors except the noise of single returns."""
    return cast_flight(prf_hz=20_000.0, true={})


def found_in(flight: Flight) -> dict[str, Signature]:
    """Return the found parameters by name."""
    found = signatures(differences(flight, RULES).checks, SeenFrom.of(flight)).found
    assert tuple(one.effect.name for one in found) == NAMES
    return {one.effect.name: one for one in found}


def wrong(made: Cast, **values: float) -> Flight:
    """Place the flight with a calibration that is wrong by the given amounts."""
    return made.flight.placed({"left": made.truth.changed(**values)})


def mounted(flight: Flight, rot_b_from_s: FloatArray, offset_rad: float) -> Flight:
    """Return the same returns as seen by a head with another mounting."""
    turn = rot_b_from_s[1, 1] / abs(rot_b_from_s[1, 1])
    (head,) = flight.heads
    start = replace(head.start, installation_matrix=rot_b_from_s)
    swaths = []
    for swath in flight.swaths:
        rows = swath.rows.copy()
        rows["encoder_rad"] = turn * rows["encoder_rad"] + offset_rad
        rate = None if swath.encoder_rate is None else turn * swath.encoder_rate
        swaths.append(replace(swath, rows=rows, encoder_rate=rate))
    again = replace(flight, heads=(replace(head, start=start),), swaths=tuple(swaths)).placed({"left": start})
    assert again.swaths[1].points_t == pytest.approx(flight.swaths[1].points_t, abs=1e-6, nan_ok=True)
    return again


MOUNTINGS = {
    "ahead": (np.eye(3), 0.0),
    "back": (np.diag([-1.0, -1.0, 1.0]), 0.0),
    "oblique": (rot_x(math.radians(20.0)), math.radians(20.0)),
}


@pytest.mark.parametrize("mounting", MOUNTINGS)
def test_columns_match_the_sensor_model(made: Cast, mounting: str) -> None:
    flight = mounted(made.flight, *MOUNTINGS[mounting])
    swath, head = flight.swaths[2], flight.heads[0]
    at = np.arange(100, len(swath), 5000)
    rays = flight.rays(swath, head.start, at)
    model, trajectory = head.model(head.start), flight.trajectories[0]
    from_model = parameter_columns_e(rays, model, trajectory) @ flight.frame.rot_t_from_e.T
    strip, direction = np.full(len(at), 2), np.ones(len(at))
    seen = replace(SeenFrom.of(flight), scan_rate=[7.0] * 4)
    columns, errors = effect_columns(swath.points_t[at], strip, swath.time_ns[at], direction, seen)
    by_model = {"roll": 0, "pitch": 1, "heading": 2, "torsion": 6, "time": 11, "range": 3}
    for name, column in by_model.items():
        assert columns[:, NAMES.index(name)] == pytest.approx(from_model[:, column], rel=2e-3, abs=0.2)
    # in a head that looks ahead, θ̇ τ moves a beam as a roll of −θ̇ τ does
    latency = -7.0 * math.copysign(1.0, head.start.installation_matrix[0, 0]) * columns[:, NAMES.index("roll")]
    assert columns[:, NAMES.index("scan direction")] == pytest.approx(latency, rel=1e-2, abs=30.0)
    assert errors[:, 3:] == pytest.approx(columns[:, :3])
    assert errors[:, :3] == pytest.approx(np.broadcast_to(np.eye(3), errors[:, :3].shape))


def test_a_trajectory_without_velocities_still_shows_a_time_offset(made: Cast) -> None:
    flight = made.flight
    whole = flight.trajectories[0]
    unsaid = replace(whole, velocity_e=np.full_like(whole.velocity_e, np.nan))
    trajectory = read_trajectory(csv_text(unsaid).encode(), "unsaid.csv")
    swath = flight.swaths[1]
    at = np.arange(100, len(swath), 5000)
    seen = SeenFrom.of(flight)
    found, expected = (
        effect_columns(swath.points_t[at], np.ones(len(at), int), swath.time_ns[at], np.ones(len(at)), one)[0]
        for one in (replace(seen, trajectories=[trajectory]), seen)
    )
    np.testing.assert_allclose(found, expected, rtol=0, atol=0.5)  # metres, of a flight at 50 m/s


def test_a_true_calibration_shows_no_error(made: Cast) -> None:
    whole = signatures(differences(made.flight, RULES).checks, SeenFrom.of(made.flight))
    for one in whole.found:
        assert one.level in ("none", "not told")
    levels = {one.effect.name: one.level for one in whole.found}
    assert [levels[name] for name in ("roll", "pitch", "heading", "torsion")] == ["none"] * 4
    assert levels["scan direction"] == "not told"
    assert whole.variance_factor == pytest.approx(0.93, abs=0.1)  # Huber's weights reduce the tails
    assert whole.left_rms_m == pytest.approx(whole.rms_m, rel=0.01)


def test_errors_are_found_with_a_gimbal(made: Cast) -> None:
    (head,) = made.flight.heads
    turned = replace(head, mount=Mount((Stage(np.array([0.0, 0.0, math.pi])),)))
    for rot_b_from_s in SeenFrom.of(replace(made.flight, heads=(turned,))).rot_b_from_s:
        assert rot_b_from_s == pytest.approx(np.diag([-1.0, -1.0, 1.0]), abs=1e-12)


@pytest.mark.parametrize("mounting", MOUNTINGS)
def test_torsion_is_separated_from_roll_however_the_head_is_mounted(made: Cast, mounting: str) -> None:
    flight = mounted(made.flight, *MOUNTINGS[mounting])
    start = flight.heads[0].start
    found = found_in(flight.placed({"left": start.changed(scan_angle_scale=1e-3)}))
    assert found["torsion"].value == pytest.approx(-1e-3, abs=3.5 * found["torsion"].sigma)
    assert found["torsion"].level == "significant"
    assert found["roll"].level in ("none", "not told", "small"), found["roll"].words


@pytest.mark.parametrize(
    ("name", "parameter", "error", "key"),
    [
        ("roll", "omega_rad", 2.5e-4, "omega_deg"),
        ("pitch", "phi_rad", -4.0e-4, "phi_deg"),
        ("heading", "kappa_rad", 9.0e-4, "kappa_deg"),
        ("torsion", "scan_angle_scale", 1.5e-3, "scan_angle_scale_ppm"),
        ("time", "time_offset_s", 2.0e-3, "time_offset_us"),
    ],
)
def test_a_wrong_parameter_is_found_with_its_correction(
    made: Cast, name: str, parameter: str, error: float, key: str
) -> None:
    found = found_in(wrong(made, **{parameter: error}))
    one = found[name]
    assert one.level == "significant"
    assert one.value == pytest.approx(-error, abs=3.5 * one.sigma)
    assert abs(one.value) > 5.0 * one.sigma
    assert f"to {key} (" in one.words  # the key of the calibration file, in whose unit the number is
    for other in found.values():
        assert other is one or other.level in ("none", "not told", "small"), other.words


def test_several_wrong_parameters_are_separated(made: Cast) -> None:
    errors = {"omega_rad": -2e-4, "phi_rad": 3e-4, "kappa_rad": 8e-4}
    flight = wrong(made, **errors)
    whole = signatures(differences(flight, RULES).checks, SeenFrom.of(flight))
    for one, error in zip(whole.found[:3], errors.values(), strict=True):
        assert one.value == pytest.approx(-error, abs=3.5 * one.sigma)
        assert one.level == "significant"
    assert whole.left_rms_m < 0.5 * whole.rms_m


def test_scan_direction_is_found_if_the_encoder_determines_it(made: Cast) -> None:
    """A mirror swings to and fro with every other sweep backwards, and a latency of 8 µs acts at ±3 rad/s."""
    rate = 3.0
    swaths = []
    for number, swath in enumerate(made.flight.swaths):
        back = np.where((swath.time_ns // 20_000_000) % 2, 1.0, -1.0)
        with_rate = replace(swath, encoder_rate=rate * back)
        seen = replace(SeenFrom.of(made.flight), scan_rate=[rate] * 4)
        columns, _ = effect_columns(swath.points_t, np.full(len(swath), number), swath.time_ns, back, seen)
        moved = swath.points_t + 8e-6 * columns[:, NAMES.index("scan direction")]
        swaths.append(replace(with_rate, points_t=moved))
    one = found_in(replace(made.flight, swaths=tuple(swaths)))["scan direction"]
    assert one.value == pytest.approx(-8e-6, abs=3.5 * one.sigma)
    assert abs(one.value) > 5.0 * one.sigma


def test_errors_of_single_strips_are_not_taken_for_a_calibration_error(made: Cast) -> None:
    """Strips are shifted within the 2 cm of their trajectory's sigma, so no error may be significant."""
    shifts = np.random.default_rng(1).normal(0.0, 0.02, (4, 3))
    swaths = [
        replace(swath, points_t=swath.points_t + shift) for swath, shift in zip(made.flight.swaths, shifts, strict=True)
    ]
    found = found_in(replace(made.flight, swaths=tuple(swaths)))
    assert [one.words for one in found.values() if one.level == "significant"] == []
    assert found["pitch"].sigma > math.radians(0.001)


def test_the_sigma_covers_an_error_common_to_all_strips(made: Cast) -> None:
    """A roll of 0.003°, one sigma of the trajectory, is common to all strips and looks like a boresight."""
    flight, roll_rad = made.flight, math.radians(0.003)
    leaning = wrong(made, omega_rad=roll_rad)
    found = signatures(differences(leaning, RULES).checks, SeenFrom.of(leaning))
    roll = found.found[0]
    assert roll.level in ("none", "not told"), roll.words
    assert roll.sigma > 0.5 * roll_rad
    shares = [f"{share} %" for share in (50, 20)]
    assert all(share in found.prior_notes[0] for share in shares)
    assert SeenFrom.of(flight).trajectories[0].attitude_sigma_rad[0, 0] == pytest.approx(roll_rad)


def test_sigmas_hold_if_errors_follow_their_covariance(made: Cast) -> None:
    """Errors of eight flights are drawn from the covariance.

    Σ(value / σ)² of m values is within χ²'s 1e-4 bounds on either side.
    """
    flight = made.flight
    prior = gauss_markov(flight, Taus(lasting_tilt=0.4, lasting_heading=0.2), 2.0)
    squares = []
    for seed in np.random.SeedSequence(77).spawn(8):
        rng = np.random.default_rng(seed)
        moved = apply(flight.trajectories[0], 0, prior, -draw(prior, rng))
        placed = replace(flight, trajectories=(moved,)).placed({"left": made.truth})
        found = signatures(differences(placed, RULES).checks, SeenFrom.of(placed), prior).found
        squares += [(one.value / one.sigma) ** 2 for one in found if math.isfinite(one.value)]
    low, high = chi2.ppf([1e-4, 1.0 - 1e-4], len(squares))
    assert len(squares) > 20
    assert low < sum(squares) < high


def test_strips_decimetres_apart_are_reported_as_rough_without_numbers(made: Cast) -> None:
    flight = wrong(made, omega_rad=math.radians(0.3))
    whole = signatures(differences(flight, RULES).checks, SeenFrom.of(flight))
    assert whole.rough
    (line,) = whole.lines
    assert "run swath calibrate" in line
    assert "±" not in line
    assert all(math.isnan(one.sigma) for one in whole.found)


def test_parallel_lines_over_flat_ground_do_not_separate_pitch_and_heading() -> None:
    flat = "height_m = 450.0\nrelief_m = 0.0"
    lines = ((-200, 0, 200, 0, 850), (200, 40, -200, 40, 850))
    made = cast_flight(flat, lines, prf_hz=15_000.0, true={})
    found = found_in(made.flight)
    assert found["roll"].level == "none"
    assert found["pitch"].level == "not told"
    assert "opposite lines over slopes or roofs" in found["pitch"].words
    assert found["heading"].level == "not told"
    assert math.isnan(found["heading"].value)


def test_too_few_differences_give_no_result_and_no_number_in_the_record(made: Cast) -> None:
    checks = differences(made.flight, RULES).checks.take(slice(0, 5))
    whole = signatures(checks, SeenFrom.of(made.flight))
    assert {one.level for one in whole.found} == {"not told"}
    effects = record_of(whole)["effects"]
    assert isinstance(effects, list)
    assert all(effect["value"] is None for effect in effects)


def test_checks_in_a_trajectory_gap_are_dropped(made: Cast) -> None:
    checks = differences(made.flight, RULES).checks
    late = checks.point_ns.copy()
    late[::2] += 50_000_000_000
    whole = signatures(replace(checks, point_ns=late), SeenFrom.of(made.flight))
    assert whole.rows == len(checks) - len(late[::2])
