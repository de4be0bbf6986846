"""Tests line scanners: FORMULAS 2.2's numbers, and the conventions' equations applied to encoder readings."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from scipy.optimize import brentq

from swath.daemon.config.tables import GeometryConfig
from swath.georef.arrays import FloatArray
from swath.sim.clocks import Oscillator
from swath.sim.plan.errors import PlanError
from swath.sim.plan.tables import ScannerTable
from swath.sim.scanners import mirrors, motions
from swath.sim.scanners.line_heads import LineHead, config_geometry
from swath.sim.shots import Pulses

KINDS = ("oscillating", "triangle", "polygon", "monogon", "nutating", "risley")
ERRORS: dict[str, float] = {
    "scan_angle_offset_deg": 0.05,
    "scan_angle_scale_ppm": 300.0,
    "scan_plane_tilt_deg": 0.02,
    "time_offset_us": 150.0,
    "encoder_latency_us": 1.0,
    "torsion_us2": 2000.0,
    "pitch_slope_ppm": 200.0,
}
LINE_ONLY = ("scan_plane_tilt_deg", "pitch_slope_ppm")
OSCILLATOR = {"offset_ppm": 4.0, "drift_ppm_per_h": 20.0, "wander_ppm": 0.5}


def scanner(kind: str, **keys: Any) -> ScannerTable:
    """Return a scanner table; "triangle" means the motion of an oscillating mirror."""
    named = {"kind": "oscillating", "motion": "triangle"} if kind == "triangle" else {"kind": kind}
    return ScannerTable.model_validate(named | keys)


def unit(*components: float | FloatArray) -> FloatArray:
    return np.stack(np.broadcast_arrays(*components), axis=-1)


# ---------------------------------------------------------------------------------------------- optics


def test_a_mirror_turns_the_beam_by_twice_its_rotation() -> None:
    beam = mirrors.swung_mirror(2 * np.radians([7.5]), 0.0, 0.0)
    assert np.degrees(np.arctan2(beam[0, 1], beam[0, 2])) == pytest.approx(15.0, abs=1e-12)


@pytest.mark.parametrize(("shaft_deg", "x_over_tilt"), [(0.0, 1.4142136), (7.5, 1.5867067), (-15.0, 0.99999999)])
def test_a_tilted_facet_follows_the_formula_sheet(shaft_deg: float, x_over_tilt: float) -> None:
    beam = mirrors.swung_mirror(2 * np.radians([shaft_deg]), 1e-4, 0.0)
    assert beam[0, 0] / 1e-4 == pytest.approx(x_over_tilt, abs=6e-8)  # printed with eight digits


def test_a_tilted_mirror_is_a_pitch_and_a_pitch_slope() -> None:
    step = 1e-5
    behind, at, ahead = mirrors.swung_mirror(np.array([-step, 0.0, step]), 1e-8, 0.0)[:, 0] / 1e-8
    assert at == pytest.approx(1.41421356, abs=1e-8)
    assert (ahead - behind) / (2 * step) == pytest.approx(0.70710678, abs=1e-6)


@pytest.mark.parametrize("optics", [mirrors.monogon, lambda beam, tilt: mirrors.swung_mirror(beam, 0.0, tilt)])
def test_a_tilted_scan_plane_is_the_cone_of_iso_14(optics: Any) -> None:
    theta, tilt = np.radians(np.linspace(-60, 60, 25)), np.radians(0.5)
    expected = unit(-np.sin(tilt), np.sin(theta) * np.cos(tilt), np.cos(theta) * np.cos(tilt))
    np.testing.assert_allclose(optics(theta, tilt), expected, atol=1e-15)


def test_a_tilted_monogon_follows_the_formula_sheet() -> None:
    beam = mirrors.monogon(np.radians([20.0]), 2e-4)
    assert beam[0, 0] / 1e-4 == pytest.approx(-1.999999987, abs=1e-9)


def test_palmer_scan_follows_the_formula_sheet() -> None:
    beam = mirrors.nutating(np.radians([0.0, 90.0, 180.0, 270.0]), np.radians(3.5))
    along, across = beam[:, 0] / beam[:, 2], beam[:, 1] / beam[:, 2]
    np.testing.assert_allclose(along[[0, 2]], [0.1227845609, -0.1227845609], atol=1e-10)
    np.testing.assert_allclose(across[[1, 3]], [0.08649700693, -0.08649700693], atol=1e-10)
    assert along[1] == pytest.approx(0.003740866104, abs=1e-12)


def test_risley_pair_follows_the_formula_sheet() -> None:
    wedge = np.radians(10.0)
    one = mirrors.risley(np.zeros(1), np.zeros(1), (wedge, 0.0), 1.51)
    assert np.degrees(np.arctan2(-one[0, 0], one[0, 2])) == pytest.approx(5.201161908, abs=1e-9)
    pair = mirrors.risley(np.radians([30.0]), np.radians([75.0]), (wedge, wedge), 1.51)[0]
    np.testing.assert_allclose(pair[:2] / pair[2], [-0.1038005615, -0.1361184971], atol=1e-10)
    assert np.linalg.norm(pair) == pytest.approx(1.0, abs=1e-15)


# ---------------------------------------------------------------------------------------------- motions


@pytest.mark.parametrize(
    "motion",
    [
        motions.sine(0.5, 40.0),
        motions.triangle(0.5, 40.0),
        motions.turning(40.0),
        motions.turning(40.0, 8),
        motions.polygon(40.0, 6),
    ],
)
def test_rates_and_accelerations_are_derivatives_of_the_angle(motion: motions.Motion) -> None:
    time_s, step_s = 3.0 + np.linspace(0.0, 0.05, 2001)[:-1] + 1.234e-5, 1e-7
    before, at, after = (motion(time_s + shift) for shift in (-step_s, 0.0, step_s))
    smooth = np.abs(after.angle_rad - before.angle_rad) < 1e-3  # except where a facet or turn ends
    assert smooth.mean() > 0.99
    rate = (after.angle_rad - before.angle_rad) / (2 * step_s)
    np.testing.assert_allclose(rate[smooth], at.rate_rps[smooth], atol=2e-5)
    acceleration = (after.rate_rps - before.rate_rps) / (2 * step_s)
    np.testing.assert_allclose(acceleration[smooth], at.acceleration_rps2[smooth], atol=20.0, rtol=1e-5)


def test_sine_motion_is_a_sine() -> None:
    time_s = np.linspace(0.0, 1.0, 5001)
    swing = motions.sine(0.5, 7.0)(time_s)
    np.testing.assert_allclose(swing.angle_rad, 0.5 * np.sin(2 * np.pi * 7.0 * time_s), atol=1e-13)


def test_triangle_motion_is_uniform_except_at_its_turns() -> None:
    half_angle = np.radians(30.0)
    time_s = np.linspace(0.0, 0.1, 100_001)
    swing = motions.triangle(half_angle, 10.0)(time_s)
    assert np.abs(swing.angle_rad).max() == pytest.approx(half_angle, abs=1e-9)
    assert swing.angle_rad[np.argmax(swing.angle_rad)] == pytest.approx(half_angle, abs=1e-9)
    assert time_s[np.argmax(swing.angle_rad)] == pytest.approx(0.025, abs=1e-6)
    even = swing.acceleration_rps2 == 0.0
    assert even.mean() == pytest.approx(1.0 - motions.TURNING_SHARE, abs=1e-3)
    speeds = np.abs(swing.rate_rps[even])
    assert np.ptp(speeds) < 1e-12 * speeds.max()
    assert np.abs(np.diff(swing.acceleration_rps2)).max() < 1e-3 * np.abs(swing.acceleration_rps2).max()


# ---------------------------------------------------------------------------------------------- emission


def test_pulses_leave_at_their_ticks_plus_the_time_offset() -> None:
    table = scanner(
        "oscillating", prf_hz=333_333.3, tick_hz=20_000_000, oscillator=OSCILLATOR, true={"time_offset_us": 250.0}
    )
    pulses = LineHead(table, "left").pulses(1000.0, 1000.01)
    ticks = [round(k * 20_000_000 / 333_333.3) for k in pulses.number.tolist()]
    oscillator = Oscillator(20_000_000, table.oscillator)

    def reached_s(tick: int) -> float:
        return float(brentq(lambda t: oscillator.phase(np.array([t]))[0] - tick, 999.0, 1001.0, xtol=1e-13))

    stamps = np.array([reached_s(tick) for tick in ticks[::500]])
    np.testing.assert_allclose(pulses.time_s[::500], stamps + 250e-6, atol=1e-12)
    assert np.diff(pulses.number).tolist() == [1] * (len(pulses) - 1)
    assert len(pulses) == pytest.approx(3333, abs=1)


@pytest.mark.parametrize("kind", KINDS)
def test_pulses_do_not_depend_on_how_time_is_cut(kind: str) -> None:
    table = scanner(kind, prf_hz=50_000.0, true={"time_offset_us": -80.0}, oscillator=OSCILLATOR)
    whole = LineHead(table, "left").pulses(0.0, 0.5)
    cuts = [0.0, 0.1, 0.1, 0.1000001, 0.23456789, float(whole.time_s[3000]), 0.49999, 0.5]
    parts = [LineHead(table, "left").pulses(start, stop) for start, stop in pairwise(sorted(cuts))]
    for name in Pulses.__dataclass_fields__:
        joined = np.concatenate([getattr(part, name) for part in parts])
        np.testing.assert_array_equal(joined, getattr(whole, name), name)
    assert whole.time_s.min() >= 0.0
    assert whole.time_s.max() < 0.5
    assert not whole.origin_s.any()


def test_the_first_pulse_is_number_0_at_tick_0() -> None:
    pulses = LineHead(scanner("oscillating", true={"time_offset_us": 30.0}), "left").pulses(0.0, 0.001)
    assert pulses.number[0] == 0
    assert pulses.time_s[0] == pytest.approx(30e-6, abs=1e-15)


@pytest.mark.parametrize(("kind", "share"), [("polygon", 4 * 35 / 360), ("monogon", 35 / 180), ("nutating", 1.0)])
def test_only_light_within_the_half_angle_leaves(kind: str, share: float) -> None:
    table = scanner(kind, half_angle_deg=35.0, prf_hz=200_000.0)
    pulses = LineHead(table, "left").pulses(0.0, 1.0)
    assert len(pulses) / 200_000 == pytest.approx(share, abs=4 * 40 / 200_000)  # one pulse a facet
    if kind != "nutating":
        theta = np.arctan2(pulses.direction_s[:, 1], pulses.direction_s[:, 2])
        assert np.degrees(np.abs(theta).max()) == pytest.approx(35.0, abs=0.2)
        assert np.degrees(np.abs(theta).max()) <= 35.0


# ---------------------------------------------------------------------------------------------- CONVENTIONS


def read_angle(table: ScannerTable, pulses: Pulses) -> tuple[FloatArray, FloatArray]:
    """Return θ_encoder (rad) and facet from readings, as the page of SREP defines them."""
    factor = 2.0 if table.kind == "oscillating" else 1.0
    if table.kind != "polygon":
        return 2 * np.pi * pulses.encoder / table.encoder_counts * factor, np.zeros(len(pulses))
    facet = np.floor(pulses.encoder * table.facets / table.encoder_counts)
    shaft = 2 * np.pi * pulses.encoder / table.encoder_counts
    return 2.0 * (shaft - 2 * np.pi * (facet + 0.5) / table.facets), np.mod(facet, table.facets)


def derivatives(table: ScannerTable, pulses: Pulses) -> tuple[FloatArray | float, FloatArray | float]:
    """Return dθ/dt and d²θ/dt², rad/s and rad/s².

    For an oscillating mirror they come from the beam's direction, for others from the steady rotation.
    """
    if table.kind == "oscillating":
        theta = np.arctan2(pulses.direction_s[:, 1], pulses.direction_s[:, 2])
        rate = np.gradient(theta, pulses.time_s, edge_order=2)
        return rate, np.gradient(rate, pulses.time_s, edge_order=2)
    return 2 * np.pi * table.scan_hz * (2.0 if table.kind == "polygon" else 1.0), 0.0


def direction_of(table: ScannerTable, theta: FloatArray) -> FloatArray:
    """Return the beam (n, 3) in s at the angle of the conventions, rad."""
    tilt = np.radians(table.true.scan_plane_tilt_deg)
    if table.kind == "nutating":
        psi = np.radians(table.nutation_deg)
        a, e1, e2 = np.array([-1, 0, 1]) / np.sqrt(2), np.array([1, 0, 1]) / np.sqrt(2), np.array([0, 1, 0])
        n = np.cos(psi) * a + np.sin(psi) * (np.outer(np.cos(theta), e1) + np.outer(np.sin(theta), e2))
        return unit(1.0 - 2 * n[:, 0] ** 2, -2 * n[:, 0] * n[:, 1], -2 * n[:, 0] * n[:, 2])
    if table.kind == "risley":
        return risley_by_angles(table, theta, table.prism_ratio * theta)
    return unit(-np.sin(tilt), np.sin(theta) * np.cos(tilt), np.cos(theta) * np.cos(tilt))


def risley_by_angles(table: ScannerTable, first: FloatArray, second: FloatArray) -> FloatArray:
    """Return beams (n, 3) behind both prisms by Snell's law in the plane of normal and ray.

    It uses sines of angles instead of a vector formula.
    """
    ray = np.tile([0.0, 0.0, 1.0], (len(first), 1))
    for turned, wedge_deg in zip((first, second), table.wedge_deg, strict=True):
        wedge = np.radians(wedge_deg)
        slanted = unit(np.sin(wedge) * np.cos(turned), np.sin(wedge) * np.sin(turned), np.cos(wedge))
        flat = np.tile([0.0, 0.0, 1.0], (len(first), 1))
        for normal, ratio in ((flat, 1 / table.refractive_index), (slanted, table.refractive_index)):
            cross = np.cross(normal, ray)
            sine = np.linalg.norm(cross, axis=1, keepdims=True)
            aside = np.cross(cross, normal) / np.where(sine > 0, sine, 1.0)
            behind = np.arcsin(ratio * sine)
            ray = np.cos(behind) * normal + np.sin(behind) * aside
    return ray


def miss_rad(table: ScannerTable, pulses: Pulses) -> FloatArray:
    """Return angles (n,), rad, between the beam and the direction that the conventions predict."""
    true = table.true
    reading, facet = read_angle(table, pulses)
    rate, acceleration = derivatives(table, pulses)
    theta = (1 + 1e-6 * true.scan_angle_scale_ppm) * (reading - np.radians(true.scan_angle_offset_deg))
    theta = theta + 1e-6 * true.encoder_latency_us * rate + 1e-12 * true.torsion_us2 * acceleration
    np.testing.assert_array_equal(facet, pulses.channel)
    if table.kind in ("oscillating", "polygon", "monogon"):
        quantum = 2 * np.pi / table.encoder_counts * 2
        np.testing.assert_allclose(pulses.phi_extra_rad, 1e-6 * true.pitch_slope_ppm * theta, atol=2e-4 * quantum)
    return np.asarray(np.linalg.norm(pulses.direction_s - direction_of(table, theta), axis=1))


@pytest.mark.parametrize("error", ["none", *ERRORS, "all"])
@pytest.mark.parametrize("kind", KINDS)
def test_the_readings_reproduce_the_beams_to_less_than_a_count(kind: str, error: str) -> None:
    true = ERRORS if error == "all" else {error: ERRORS[error]} if error != "none" else {}
    if kind in ("nutating", "risley"):
        true = {key: value for key, value in true.items() if key not in LINE_ONLY}
    table = scanner(kind, prf_hz=1_000_000.0, oscillator=OSCILLATOR, true=true)
    pulses = LineHead(table, "left").pulses(5.0, 5.06)
    assert len(pulses) > 10_000
    count_rad = 2 * np.pi / table.encoder_counts * (2 if kind in ("oscillating", "triangle", "polygon") else 1)
    missed = miss_rad(table, pulses)
    assert missed.max() < count_rad
    assert missed.max() > 0.2 * count_rad * (1 if kind not in ("nutating", "risley") else 0.2)  # readings are whole


@pytest.mark.parametrize("key", ["scan_angle_offset_deg", "scan_angle_scale_ppm", "encoder_latency_us", "torsion_us2"])
def test_an_omitted_error_changes_the_beam_by_many_counts(key: str) -> None:
    """The previous test could fail, because each of the errors turns the beam by many counts."""
    table = scanner("oscillating", prf_hz=1_000_000.0, true={key: ERRORS[key]})
    pulses = LineHead(table, "left").pulses(5.0, 5.03)
    blind = scanner("oscillating", prf_hz=1_000_000.0)
    assert miss_rad(blind, pulses).max() > 15 * 4 * np.pi / table.encoder_counts


def test_errors_have_their_documented_signs() -> None:
    """The reading at the centre is the offset, it is old by the latency, and the mirror lags it by the torsion."""

    def readings(**true: float) -> FloatArray:
        table = scanner("oscillating", motion="sine", scan_hz=50.0, prf_hz=100_000.0, true=true)
        return np.asarray(read_angle(table, LineHead(table, "left").pulses(0.0, 0.02))[0])

    plain, quantum = readings(), 4 * np.pi / 4_194_304
    assert readings(scan_angle_offset_deg=0.1)[0] == pytest.approx(np.radians(0.1), abs=quantum)
    late = readings(encoder_latency_us=10.0)  # one pulse of 100 kHz
    np.testing.assert_allclose(late[1:], plain[:-1], atol=1.1 * quantum)
    top = np.argmax(plain)
    stretched = readings(torsion_us2=1e4)[top] / plain[top] - 1
    assert stretched == pytest.approx(1e-8 * (100 * np.pi) ** 2, rel=5e-3)  # − τ θ̈ = + τ Ω² θ
    assert readings(scan_angle_scale_ppm=1000.0)[top] < plain[top]


def test_each_facet_of_a_polygon_has_its_own_tilt() -> None:
    """FORMULAS 2.2 has u_x = 2 cos i sin ε (times cos ε), with i = 45° − θ/2."""
    tilts = {0: 0.02, 2: -0.05}
    facet = [{"index": index, "tilt_deg": tilt} for index, tilt in tilts.items()]
    table = scanner("polygon", facets=5, facet=facet, half_angle_deg=40.0)
    pulses = LineHead(table, "left").pulses(0.0, 0.2)
    theta = read_angle(table, pulses)[0]
    assert set(pulses.channel.tolist()) == set(range(5))
    for index in range(5):
        own, tilt = pulses.channel == index, np.radians(tilts.get(index, 0.0))
        expected = 2 * np.cos(np.pi / 4 - theta[own] / 2) * np.sin(tilt)
        np.testing.assert_allclose(pulses.direction_s[own, 0], expected, atol=2 * abs(tilt) ** 3 + 1e-9)
        assert (expected != 0.0).all() == (index in tilts)


def test_the_reading_of_a_risley_pair_counts_whole_turns() -> None:
    """The reading alone determines both prisms, over the number of turns after which the second repeats."""
    table = scanner("risley", prism_ratio=-0.75, prf_hz=100_000.0, scan_hz=100.0, encoder_counts=100_000)
    pulses = LineHead(table, "left").pulses(0.0, 0.1)
    assert (pulses.encoder.min(), pulses.encoder.max()) == pytest.approx((-200_000, 200_000), abs=200)
    angle = 2 * np.pi * pulses.encoder / 100_000
    expected = risley_by_angles(table, angle, -0.75 * angle)
    np.testing.assert_allclose(pulses.direction_s, expected, atol=2 * np.pi / 100_000)
    np.testing.assert_array_equal(pulses.encoder[:6000], pulses.encoder[4000:])


# ---------------------------------------------------------------------------------------------- what cannot be


@pytest.mark.parametrize("kind", ["oscillating", "polygon", "monogon", "nutating", "risley"])
def test_the_geometry_is_valid_in_a_configuration(kind: str) -> None:
    geometry = config_geometry(scanner(kind))
    said = GeometryConfig.model_validate(geometry).model_dump(exclude_none=True)
    assert said == geometry
    assert said["type"] == kind
    assert len(said) == {"polygon": 2, "nutating": 3, "risley": 4}.get(kind, 1)


@pytest.mark.parametrize(
    ("keys", "error"),
    [
        ({"prf_hz": 60_000.0, "tick_hz": 100_000}, r"prf_hz: got 60000, want at most 50000: tick_hz / 2"),
        ({"kind": "polygon", "facets": 8, "half_angle_deg": 50.0}, r"half_angle_deg: got 50, want at most 44\.99"),
        (
            {"kind": "polygon", "facets": 6, "half_angle_deg": 59.99, "true": {"scan_angle_offset_deg": -0.5}},
            r"half_angle_deg: got 59\.99, want at most 59\.499: 6 facets of ±60° each",
        ),
        (
            {"kind": "polygon", "facets": 3, "facet": [{"index": 0, "tilt_deg": 1.0}, {"index": 3, "tilt_deg": 1.0}]},
            r"facet\[1\]\.index: got 3, want 0 to 2",
        ),
        (
            {"kind": "polygon", "facet": [{"index": 1, "tilt_deg": 1.0}, {"index": 1, "tilt_deg": 2.0}]},
            r"facet\[1\]\.index: facet 1 is given twice",
        ),
        (
            {"kind": "nutating", "true": {"scan_plane_tilt_deg": 0.1}},
            r"true\.scan_plane_tilt_deg: got 0\.1, want 0: kind nutating",
        ),
        ({"kind": "risley", "true": {"pitch_slope_ppm": 5.0}}, r"true\.pitch_slope_ppm: got 5, want 0: kind risley"),
        ({"kind": "risley", "wedge_deg": [30.0, 30.0]}, r"wedge_deg: got \[30\.0, 30\.0\], want smaller"),
        ({"kind": "risley", "prism_ratio": -0.72651}, r"prism_ratio: got -0\.72651, want a fraction whose denominator"),
        ({"true": {"scan_angle_scale_ppm": 2e5}}, r"true\.scan_angle_scale_ppm: got 200000, want -100000 to 100000"),
        ({"true": {"encoder_latency_us": 1e4}}, r"true\.encoder_latency_us: turns the beam by .*°, want at most 10°"),
        ({"true": {"torsion_us2": 1e8}}, r"true\.torsion_us2: turns the beam by"),
        ({"true": {"scan_angle_offset_deg": 11.0}}, r"true\.scan_angle_offset_deg: turns the beam by 11°"),
    ],
)
def test_impossible_values_are_refused_by_their_key(keys: dict[str, Any], error: str) -> None:
    with pytest.raises(PlanError, match=r"^scanner\.left\." + error):
        LineHead(ScannerTable.model_validate(keys), "left")


def test_a_polygon_at_its_limit_stays_within_its_facets() -> None:
    true = {"scan_angle_offset_deg": -0.5}
    table = scanner("polygon", facets=6, half_angle_deg=59.492, prf_hz=1_000_000.0, true=true, encoder_counts=100_000)
    pulses = LineHead(table, "left").pulses(0.0, 0.05)
    assert miss_rad(table, pulses).max() < 4 * np.pi / 100_000
