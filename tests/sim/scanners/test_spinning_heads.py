"""Tests spinning heads: the manuals' firing times, points of formula sheet and drivers, cuts, refusals."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from swath.drivers.scanner.beams import beam_points as velodyne_points
from swath.drivers.scanner.ouster.head import beam_points as ouster_points
from swath.drivers.scanner.ouster.head import read_head
from swath.drivers.scanner.velodyne.heads import VLP16
from swath.georef.arrays import FloatArray
from swath.georef.records import RETURN_DTYPE
from swath.sim.plan.errors import PlanError
from swath.sim.plan.tables import ScannerTable
from swath.sim.scanners.ouster_wire import os1_metadata
from swath.sim.scanners.spinning_heads import Os1Head, Vlp16Head
from swath.sim.shots import Pulses
from tests.sim.heads import joined, plan_of


def table_of(kind: str, **keys: Any) -> ScannerTable:
    return plan_of(kind, **keys).tables.scanner["left"]


def head_of(kind: str, **keys: Any) -> Vlp16Head | Os1Head:
    head = Vlp16Head if kind == "vlp16" else Os1Head
    return head(table_of(kind, **keys), "left")


def points_at(pulses: Pulses, range_m: FloatArray | float) -> FloatArray:
    points: FloatArray = pulses.origin_s + np.reshape(range_m, (-1, 1)) * pulses.direction_s
    return points


def turned_deg(one: FloatArray, other: FloatArray) -> FloatArray:
    """Return by how many degrees the azimuth of directions (n, 3) grows from one to the other: x at 90°, y at 0°."""
    difference = np.arctan2(other[:, 0], other[:, 1]) - np.arctan2(one[:, 0], one[:, 1])
    degrees: FloatArray = np.degrees((difference + np.pi) % (2 * np.pi) - np.pi)
    return degrees


# --- when -----------------------------------------------------------------------------------------------------------


def test_lasers_of_a_vlp16_fire_as_the_manual_states() -> None:
    # 9.4: 24 firing sequences of 55.296 µs a packet, 2.304 µs from laser to laser
    pulses = head_of("vlp16").pulses(0.0, 0.25)
    np.testing.assert_array_equal(pulses.number, np.arange(len(pulses)))
    np.testing.assert_array_equal(pulses.channel, pulses.number % 16)
    fired_ns = pulses.number // 16 * 55_296 + pulses.number % 16 * 2_304
    np.testing.assert_allclose(1e9 * pulses.time_s, fired_ns, rtol=0, atol=1e-3)
    assert pulses.time_s[-1] < 0.25
    assert head_of("vlp16").pulses(0.25, 0.2501).number[0] == len(pulses)


@pytest.mark.parametrize("scan_hz", [10.0, 20.0])
def test_an_os1_has_1024_columns_a_turn(scan_hz: float) -> None:
    pulses = head_of("os1", scan_hz=scan_hz).pulses(0.0, 0.15)
    np.testing.assert_array_equal(pulses.number, np.arange(len(pulses)))
    np.testing.assert_array_equal(pulses.channel, pulses.number % 64)
    column = pulses.number // 64
    np.testing.assert_allclose(pulses.time_s, column / (1024 * scan_hz), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(pulses.encoder, column % 1024 * 88)  # 90 112 ticks a turn


@pytest.mark.parametrize("kind", ["vlp16", "os1"])
def test_pulses_do_not_depend_on_how_time_is_cut(kind: str) -> None:
    oscillator = {"offset_ppm": 40.0, "drift_ppm_per_h": 5.0, "wander_ppm": 0.5}
    head = head_of(kind, oscillator=oscillator, true={"encoder_latency_us": 3.0})
    whole = joined([head.pulses(12.0, 12.2)])
    inside = whole["time_s"][[len(whole["time_s"]) // 3, 2 * len(whole["time_s"]) // 3]]
    cuts = [12.0, 12.0, 12.001, 12.00101, *inside.tolist(), float(inside[1]) + 1e-9, 12.2]
    pieces = [head.pulses(start, stop) for start, stop in pairwise(cuts)]
    assert len(pieces[0]) == 0
    parts = joined(pieces)
    for name, column in whole.items():
        np.testing.assert_array_equal(parts[name], column)
    assert (np.diff(whole["number"]) == 1).all()
    assert whole["time_s"].min() >= 12.0
    assert whole["time_s"].max() < 12.2


@pytest.mark.parametrize("kind", ["vlp16", "os1"])
def test_a_fast_oscillator_makes_the_head_fire_and_turn_faster(kind: str) -> None:
    steady, fast = head_of(kind), head_of(kind, oscillator={"offset_ppm": 200.0})
    at_s = 100.0
    before = steady.pulses(at_s * (1 + 200e-6), at_s * (1 + 200e-6) + 1e-3)
    after = fast.pulses(at_s, at_s + 1e-3)
    many = min(len(before), len(after)) - 64
    np.testing.assert_array_equal(after.number[:many], before.number[:many])
    np.testing.assert_allclose(after.direction_s[:many], before.direction_s[:many], rtol=0, atol=1e-12)


# --- where to -------------------------------------------------------------------------------------------------------


def test_vlp16_point_matches_the_formula_sheet() -> None:
    # FORMULAS 2.2: 50 m, α 123°, ω −9°; laser 6 has −9° and starts 6.6 mm above the centre
    reading_deg = 360.0 * 10.0 * 6 * 2.304e-6
    pulses = head_of("vlp16", true={"scan_angle_offset_deg": reading_deg - 123.0}).pulses(0.0, 20e-6)
    sheet = np.array([41.417257, -26.896681, -7.821723])
    np.testing.assert_allclose(points_at(pulses, 50.0)[6] - [0, 0, 0.0066], sheet, rtol=0, atol=6e-7)


def test_os1_point_matches_the_formula_sheet() -> None:
    # FORMULAS 2.2: 50 m, tick 22528, azimuth 3.2°, altitude −9°, n 15.806 mm, in the lidar frame
    altitude_deg = json_head().altitude_rad[48] * 180 / np.pi
    beam = {"channel": 48, "azimuth_deg": 3.2 - 4.23, "elevation_deg": -9.0 - altitude_deg}
    pulses = head_of("os1", beam=[beam]).pulses(0.0, 0.1)
    assert pulses.encoder[256 * 64 + 48] == 22_528
    lidar = np.array([-2.755841, -49.307634, -7.819251])
    sensor = lidar * [-1, -1, 1] + [0, 0, 0.03618]
    np.testing.assert_allclose(points_at(pulses, 50.0)[256 * 64 + 48], sensor, rtol=0, atol=6e-7)


def json_head() -> Any:
    return read_head(os1_metadata(table_of("os1")))


def test_metadata_of_an_os1_64_has_its_figures() -> None:
    head = json_head()
    assert (head.beams, head.columns_per_frame, head.model) == (64, 1024, "OS-1-64")
    np.testing.assert_allclose(np.degrees(head.altitude_rad[[0, -1]]), [16.6, -16.6], atol=1e-9)
    assert (np.diff(head.altitude_rad) < 0).all()
    assert head.timestamp_mode == "TIME_FROM_SYNC_PULSE_IN"
    assert head.beam_origin_m == (0.015806, 0.0)


def test_vlp16_points_match_the_driver_at_the_true_azimuth() -> None:
    pulses = head_of("vlp16", scan_hz=17.3).pulses(0.0, 0.06)
    rows = np.zeros(len(pulses), RETURN_DTYPE)
    rows["range_m"] = np.random.default_rng(1).uniform(1, 130, len(rows))
    rows["encoder_rad"] = 2 * np.pi * 17.3 * pulses.time_s
    rows["channel"] = pulses.channel
    theirs = velodyne_points(rows, VLP16.beams)
    np.testing.assert_allclose(points_at(pulses, rows["range_m"]), theirs, rtol=0, atol=1e-8)
    np.testing.assert_allclose(np.linalg.norm(pulses.direction_s, axis=1), 1.0, rtol=0, atol=1e-14)


def test_os1_points_match_the_driver() -> None:
    # the reported range counts from the pulse's origin, so nothing is added
    pulses = head_of("os1").pulses(0.0, 0.1)
    rows = np.zeros(len(pulses), RETURN_DTYPE)
    rows["range_m"] = np.random.default_rng(1).uniform(1, 200, len(rows))
    rows["encoder_rad"] = 2 * np.pi * (1 - pulses.encoder / 90_112)
    rows["channel"] = pulses.channel
    np.testing.assert_allclose(points_at(pulses, rows["range_m"]), ouster_points(rows, json_head()), rtol=0, atol=1e-9)


@pytest.mark.parametrize("scan_hz", [5.0, 10.0, 20.0])
def test_a_vlp16_reports_the_azimuth_of_the_first_firing_of_each_group(scan_hz: float) -> None:
    pulses = head_of("vlp16", scan_hz=scan_hz).pulses(0.0, 0.4)
    whole = len(pulses) // 32 * 32
    said = pulses.encoder[:whole].reshape(-1, 32)
    assert (said == said[:, :1]).all()
    assert (said >= 0).all()
    assert (said < 36_000).all()
    first = np.stack([np.sin(np.radians(said[:, 0] / 100)), np.cos(np.radians(said[:, 0] / 100)), 0.0 * said[:, 0]], 1)
    error = turned_deg(first, pulses.direction_s[:whole:32])
    assert np.abs(error).max() <= 0.005 + 1e-9
    assert np.abs(error).max() > 0.0045
    # a turn has the right duration
    steps = turned_deg(pulses.direction_s[: whole - 32 : 32], pulses.direction_s[32:whole:32])
    np.testing.assert_allclose(steps, 360 * scan_hz * 110.592e-6, rtol=0, atol=1e-9)


# --- errors ---------------------------------------------------------------------------------------------------------


def test_encoder_errors_of_a_vlp16_turn_the_beam_as_the_conventions_state() -> None:
    # θ = θ_encoder − offset + latency · dθ/dt, azimuth growing at 3600°/s
    plain = head_of("vlp16").pulses(0.0, 0.1)
    off = head_of("vlp16", true={"scan_angle_offset_deg": 0.3, "encoder_latency_us": 50.0}).pulses(0.0, 0.1)
    np.testing.assert_array_equal(off.encoder, plain.encoder)
    np.testing.assert_allclose(turned_deg(plain.direction_s, off.direction_s), -0.3 + 0.18, rtol=0, atol=1e-9)


def test_encoder_errors_of_an_os1_turn_the_beam_as_the_conventions_state() -> None:
    # its angle falls at 3600°/s, and grows from x to y
    plain = head_of("os1").pulses(0.0, 0.1)
    off = head_of("os1", true={"scan_angle_offset_deg": 0.3, "encoder_latency_us": 50.0}).pulses(0.0, 0.1)
    np.testing.assert_allclose(-turned_deg(plain.direction_s, off.direction_s), -0.3 - 0.18, rtol=0, atol=1e-9)
    start, end = (piece.origin_s - [0, 0, 0.03618] for piece in (plain, off))
    np.testing.assert_allclose(-turned_deg(start, end)[::640], -0.48, rtol=0, atol=1e-9)


@pytest.mark.parametrize("kind", ["vlp16", "os1"])
def test_beams_follow_their_table_and_corrections(kind: str) -> None:
    beam = {"channel": 5, "azimuth_deg": 0.2, "elevation_deg": -0.1, "range_m": 0.5}
    plain, off = head_of(kind).pulses(0.0, 0.05), head_of(kind, beam=[beam]).pulses(0.0, 0.05)
    hit = plain.channel == 5
    np.testing.assert_array_equal(off.direction_s[~hit], plain.direction_s[~hit])
    lifted = np.degrees(np.arcsin(off.direction_s[hit, 2]) - np.arcsin(plain.direction_s[hit, 2]))
    np.testing.assert_allclose(lifted, -0.1, rtol=0, atol=1e-9)
    # both makers' azimuths of beams are clockwise seen from above
    np.testing.assert_allclose(turned_deg(plain.direction_s, off.direction_s)[hit], 0.2, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("kind", "keys", "named"),
    [
        ("vlp16", {"scan_hz": 4.9}, "scan_hz"),
        ("vlp16", {"scan_hz": 20.5}, "scan_hz"),
        ("os1", {"scan_hz": 15.0}, "scan_hz"),
        ("vlp16", {"true": {"scan_angle_scale_ppm": 1.0}}, "true.scan_angle_scale_ppm"),
        ("os1", {"true": {"torsion_us2": 1.0}}, "true.torsion_us2"),
        ("os1", {"true": {"scan_plane_tilt_deg": 0.1}}, "true.scan_plane_tilt_deg"),
        ("vlp16", {"true": {"pitch_slope_ppm": -1.0}}, "true.pitch_slope_ppm"),
        ("vlp16", {"beam": [{"channel": 3}, {"channel": 16}]}, "beam[1].channel"),
        ("os1", {"beam": [{"channel": 64}]}, "beam[0].channel"),
        ("os1", {"installation": [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]]}, "installation"),
    ],
)
def test_settings_that_no_such_head_has_are_refused(kind: str, keys: dict[str, Any], named: str) -> None:
    with pytest.raises(PlanError) as caught:
        head_of(kind, **keys)
    assert caught.value.key == f"scanner.left.{named}"
    assert "want" in str(caught.value)
    assert "\n" not in str(caught.value)
