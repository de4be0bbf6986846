"""Tests which parameters are estimated, and how they return into calibrations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import PchipInterpolator

from swath.calib.flight import Flight, Head
from swath.calib.intensity_curve import at_knots
from swath.calib.parameters import MODELS, ParameterError, ParameterOptions, Unknowns, unknowns
from swath.georef.scanner.beams import LineGeometry, SpinningGeometry
from swath.georef.scanner.calibration import INDEX, PARAMETERS, BeamCorrection, Calibration, RangeOffset, nominal
from tests.calib.roofs import LINES, frame, trajectory


def spinning() -> SpinningGeometry:
    """Return a head with three beams."""
    nothing = np.zeros(3)
    return SpinningGeometry(np.array([-10.0, 0.0, 10.0]), nothing, nothing, nothing, nothing, nothing)


def flight() -> Flight:
    """Return a flight with a line scanner and a spinning head."""
    left, top = nominal("left", (0.1, 0.2, 0.3), np.eye(3)), nominal("top", (0.5, 0.0, -0.2), np.eye(3))
    heads = (Head("left", left, LineGeometry()), Head("top", top, spinning()))
    return Flight(frame(), heads, (trajectory(LINES[:1]),), ())


def test_models_match_the_program() -> None:
    assert MODELS["basic"] == ("omega_rad", "phi_rad", "kappa_rad", "range_offset_m")
    assert set(MODELS["scanner"]) - set(MODELS["basic"]) == {
        "scan_angle_scale",
        "range_scale",
        "scan_plane_tilt_rad",
        "time_offset_s",
    }
    assert set(MODELS["full"]) == set(INDEX)


def test_several_heads_share_one_vector() -> None:
    asked = unknowns(
        flight(), ParameterOptions("scanner", fix=frozenset(["left.kappa_rad"]), priors={"lever_arm_z_m": 0.02})
    )
    left, top = ([name.split(".", 1)[1] for name in asked.names if name.startswith(head)] for head in ("left", "top"))
    assert left == [name for name in INDEX if name in {*MODELS["scanner"], "lever_arm_z_m"} - {"kappa_rad"}]
    assert "scan_plane_tilt_rad" not in top  # a spinning head has none
    assert "kappa_rad" in top
    held = {(one.scanner, one.name): one for one in asked.held}
    assert held["left", "kappa_rad"].why == "held by your choice"
    assert held["left", "kappa_rad"].remedy == ""
    assert ("top", "scan_angle_scale") in held
    assert asked.start[asked.names.index("top.lever_arm_z_m")] == -0.2
    assert asked.prior_sigmas[asked.names.index("top.lever_arm_z_m")] == 0.02
    assert np.isinf(asked.prior_sigmas[asked.names.index("top.omega_rad")])


def test_the_scan_angle_offset_is_held_unless_freed() -> None:
    held = unknowns(flight(), ParameterOptions("full"))
    assert "left.scan_angle_offset_rad" not in held.names
    assert any(one.name == "scan_angle_offset_rad" and "boresight" in one.why for one in held.held)
    freed = unknowns(flight(), ParameterOptions("full", free=frozenset(["left.scan_angle_offset_rad"])))
    assert "left.scan_angle_offset_rad" in freed.names


def test_settings_of_one_scanner_override_those_of_all() -> None:
    asked = unknowns(
        flight(),
        ParameterOptions(
            fix=frozenset(["omega_rad", "left.phi_rad"]),
            free=frozenset(["top.omega_rad", "top.kappa_rad"]),
            priors={"phi_rad": 0.1, "kappa_rad": 0.2},
        ),
    )
    found = dict(zip(asked.names, asked.prior_sigmas.tolist(), strict=True))
    assert {name: sigma for name, sigma in found.items() if not name.endswith("range_offset_m")} == {
        "top.omega_rad": np.inf,
        "top.phi_rad": 0.1,
        "left.kappa_rad": 0.2,
        "top.kappa_rad": np.inf,
    }


def extras() -> Unknowns:
    """Return everything beyond the standard model."""
    made = flight()
    old = replace(
        made.heads[1].start,
        ibrc=(np.array([0.0, 100.0]), np.array([0.0, 0.1])),
        range_offsets=(RangeOffset(0.5, 2), RangeOffset(0.7, 2, 1)),
        beams={2: BeamCorrection(0.01, 0.02, 0.03)},
    )
    made = replace(made, heads=(made.heads[0], replace(made.heads[1], start=old)))
    options = ParameterOptions(
        ibrc_knots=(0.0, 50.0, 75.0, 100.0),
        ibrc_reference=50.0,
        beams=frozenset(["azimuth_rad", "range_m"]),
        range_offset_slots=(2,),
        range_offset_zones=(3,),
    )
    return unknowns(made, options)


def test_tables_start_from_the_existing_ones_and_are_returned() -> None:
    asked = extras()
    start = asked.calibrations(asked.start)["top"]
    assert start.ibrc is not None
    np.testing.assert_allclose(at_knots(start.ibrc[1]), [-0.05, 0.0, 0.025, 0.05])
    assert start.value("range_offset_m") == pytest.approx(-0.05)  # the range is the same
    values = asked.start + np.arange(1, len(asked) + 1) * 1e-3
    done = asked.calibrations(values)["top"]
    by_name = dict(zip(asked.names, values.tolist(), strict=True))
    assert done.ibrc is not None
    told = [by_name["top.ibrc.0"], 0.0, by_name["top.ibrc.2"], by_name["top.ibrc.3"]]
    assert at_knots(done.ibrc[0]).tolist() == [0.0, 50.0, 75.0, 100.0]
    assert at_knots(done.ibrc[1]).tolist() == told
    np.testing.assert_allclose(
        done.ibrc[1], PchipInterpolator([0.0, 50.0, 75.0, 100.0], told)(done.ibrc[0]), atol=1e-12
    )
    assert RangeOffset(by_name["top.range_offset_slot.2"], 2) in done.range_offsets
    assert RangeOffset(0.7, 2, 1) in done.range_offsets
    assert RangeOffset(by_name["top.range_offset_zone.3"], None, 3) in done.range_offsets
    assert len(done.range_offsets) == 3
    assert done.beams[2] == BeamCorrection(by_name["top.beam.2.azimuth_rad"], 0.02, by_name["top.beam.2.range_m"])
    assert "top.beam.0.range_m" not in asked.names  # the other beams are relative to the first
    assert done.value("phi_rad") == by_name["top.phi_rad"]


def test_a_curve_is_returned_at_the_same_knots() -> None:
    """A calibration can continue from what an earlier one wrote."""
    asked = extras()
    done = asked.calibrations(asked.start + np.arange(1, len(asked) + 1) * 1e-3)
    made = flight()
    again = replace(made, heads=tuple(replace(head, start=done[head.name]) for head in made.heads))
    options = ParameterOptions(ibrc_knots=(0.0, 50.0, 75.0, 100.0), ibrc_reference=50.0)
    asked = unknowns(again, options)
    for name, found in asked.calibrations(asked.start).items():
        before = done[name].ibrc
        assert before is not None
        np.testing.assert_array_equal(found.ibrc, before)


def test_pseudo_observations_are_priors_and_bends() -> None:
    asked = extras()
    values = asked.start + np.random.default_rng(1).normal(size=len(asked)) * 0.01
    design, misclosure = asked.pseudo(values)
    assert len(design) == 4  # two inner knots of each head
    step = np.random.default_rng(2).normal(size=len(asked)) * 0.01
    np.testing.assert_allclose(asked.pseudo(values + step)[1] - misclosure, design @ step, atol=1e-12)
    table = asked.calibrations(values)["top"].ibrc
    assert table is not None
    correction_m = at_knots(table[1])
    bend = correction_m[2] - (correction_m[1] + correction_m[3]) / 2.0
    assert misclosure[3] == pytest.approx(bend / 0.02)
    prior = unknowns(flight(), ParameterOptions(priors={"left.phi_rad": 0.01}))
    design, misclosure = prior.pseudo(prior.start + 0.005)
    assert design.shape == (1, 8)
    assert design[0, 1] == pytest.approx(100.0)
    assert misclosure[0] == pytest.approx(0.5)


def test_sigmas_and_correlations_are_returned_to_their_head() -> None:
    asked = unknowns(flight(), ParameterOptions())
    root = np.random.default_rng(5).normal(size=(8, 8))
    covariance = root @ root.T
    held = np.array([one.plausible for one in asked.considered])
    moved = 1e-3 * np.random.default_rng(6).normal(size=(8, len(held)))
    done = asked.finished(asked.start, covariance, held, moved)["top"]
    at = [INDEX[name] for name in MODELS["basic"]]
    np.testing.assert_allclose(done.covariance()[np.ix_(at, at)], covariance[4:, 4:])
    arm = INDEX["lever_arm_x_m"]
    own = [one.name for one in asked.considered].index("top.lever_arm_x_m")
    assert (done.sigmas[arm], done.held_sigmas[arm]) == (0.0, 0.002)
    np.testing.assert_allclose(done.covariance()[at, arm], moved[4:, own] * 0.002)


def held_sigma(name: str, options: ParameterOptions, start: Calibration | None = None) -> float:
    """Return one sigma of a parameter of ``left`` that is not estimated; 0 means that it counts as exact."""
    starts = flight().starts()
    asked = unknowns(flight(), options, starts if start is None else {**starts, "left": start})
    assert f"left.{name}" not in asked.names
    return {one.name: one.plausible for one in asked.considered}.get(f"left.{name}", 0.0)


def test_sigma_of_a_held_parameter_comes_from_user_calibration_or_plausibility() -> None:
    """The user's value comes first, then that of an earlier calibration, then the plausible error."""
    scale, fixed = INDEX["scan_angle_scale"], frozenset(["scan_angle_scale"])
    assert held_sigma("scan_angle_scale", ParameterOptions()) == pytest.approx(3e-4)
    assert held_sigma("scan_angle_scale", ParameterOptions("scanner", fix=fixed)) == pytest.approx(3e-4)
    assert held_sigma("scan_angle_scale", ParameterOptions(fix=fixed, priors={"scan_angle_scale": 1e-5})) == 1e-5
    assert (
        held_sigma(
            "scan_angle_scale",
            ParameterOptions(fix=frozenset(["left.scan_angle_scale"]), priors={"left.scan_angle_scale": 2e-5}),
        )
        == 2e-5
    )
    found = np.zeros(len(PARAMETERS))
    found[scale] = 6e-6
    earlier = replace(flight().starts()["left"], method="planes", sigmas=found)
    assert held_sigma("scan_angle_scale", ParameterOptions(), earlier) == 6e-6
    assert (
        held_sigma("scan_angle_scale", ParameterOptions(), replace(earlier, sigmas=0.0 * found, held_sigmas=found))
        == 6e-6
    )
    assert held_sigma("scan_angle_scale", ParameterOptions(), replace(earlier, method="nominal")) == pytest.approx(3e-4)
    assert held_sigma("lever_arm_z_m", ParameterOptions("scanner")) == 0.002
    assert held_sigma("lever_arm_z_m", ParameterOptions("full", fix=frozenset(["lever_arm_z_m"]))) == 0.05
    assert held_sigma("pitch_slope", ParameterOptions("scanner")) == 0.0
    assert held_sigma("scan_angle_offset_rad", ParameterOptions("full")) == 0.0


def test_held_parameters_keep_their_start_and_estimated_ones_begin_at_nominal_values() -> None:
    starts = flight().starts()
    near = {name: one.changed(omega_rad=0.01, kappa_rad=0.02, range_offset_m=9.0) for name, one in starts.items()}
    asked = unknowns(flight(), ParameterOptions(fix=frozenset(["kappa_rad"])), starts, near)
    first = dict(zip(asked.names, asked.first.tolist(), strict=True))
    start = dict(zip(asked.names, asked.start.tolist(), strict=True))
    assert first["left.omega_rad"] == 0.01
    assert start["left.omega_rad"] == starts["left"].value("omega_rad")
    assert first["left.range_offset_m"] == start["left.range_offset_m"]
    found = asked.calibrations(asked.first)["left"]
    assert found.value("kappa_rad") == starts["left"].value("kappa_rad")
    less = asked.without(frozenset(["left.omega_rad"]))
    assert less.calibrations(less.first)["left"].value("omega_rad") == starts["left"].value("omega_rad")
    assert {one.name: one.plausible for one in less.considered}["left.omega_rad"] == pytest.approx(np.radians(1.0))


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (ParameterOptions("everything"), "want one of basic, scanner, full"),
        (ParameterOptions(fix=frozenset(["omega"])), "omega: unknown parameter"),
        (ParameterOptions(free=frozenset(["top.pitch_slope"])), "top.pitch_slope: cannot be estimated"),
        (ParameterOptions(priors={"phi_rad": 0.0}), "want a sigma above 0"),
        (
            ParameterOptions(fix=frozenset(["right.omega_rad"])),
            "parameters of right: this flight has no such scanner; its scanners are ",
        ),
        (ParameterOptions(priors={"fie_rad": 0.1}), "prior fie_rad"),
        (ParameterOptions(ibrc_knots=(5.0, 5.0)), "increasing intensities"),
        (ParameterOptions(beams=frozenset(["roll_rad"])), "beams: got 'roll_rad'"),
    ],
)
def test_impossible_options_are_refused(options: ParameterOptions, text: str) -> None:
    with pytest.raises(ParameterError, match=text.replace(".", r"\.")) as refused:
        unknowns(flight(), options)
    assert "\n" not in str(refused.value)


def test_a_beam_correction_needs_a_spinning_head() -> None:
    only = replace(flight(), heads=flight().heads[:1])
    with pytest.raises(ParameterError, match="this flight has no spinning head"):
        unknowns(only, ParameterOptions(beams=frozenset(["range_m"])))
