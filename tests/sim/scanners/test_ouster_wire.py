"""Tests an OS1's packets with this project's parser: returns, columns, sync pulse stamps, metadata."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from swath.daemon.config.tables import ScannerConfig
from swath.drivers.parser import DeviceSettings
from swath.drivers.scanner.ouster.head import beam_points, read_head
from swath.drivers.scanner.ouster.parser import OusterParser
from swath.georef.arrays import FloatArray, StructArray
from swath.georef.records import RETURN_FLAG_LAST, RETURN_FLAG_STRONGEST, DeviceClockSamples, ScannerReturns
from swath.sim.plan.errors import PlanError
from swath.sim.plan.plan import Plan
from swath.sim.scanners.ouster_wire import OusterWire, config_table, os1_metadata
from swath.sim.scanners.spinning_heads import Os1Head
from swath.sim.shots import WireUnit
from tests.sim.heads import Shots, feed, measured_of, plan_of, pulse, rows_of

PER_PACKET = 16 * 64


def wire_of(plan: Plan, lost: list[tuple[float, float]] | None = None, *, wired: bool = True) -> OusterWire:
    return OusterWire(plan, "left", pulse(plan) if wired else None, lost or [])


def sent(
    plan: Plan, cuts: list[float], wire: OusterWire | None = None
) -> tuple[list[WireUnit], StructArray, list[Shots]]:
    """Return units and truth of the time between the cuts, s."""
    wire = wire or wire_of(plan)
    head = Os1Head(plan.tables.scanner["left"], "left")
    shots = [measured_of(head.pulses(start, stop), 500.0) for start, stop in pairwise(cuts)]
    told = [wire.units(*shot) for shot in shots] + [wire.close()]
    return [unit for units, _ in told for unit in units], np.concatenate([rows for _, rows in told]), shots


def parser_of(plan: Plan) -> OusterParser:
    table = plan.tables.scanner["left"]
    config = config_table(table, "left", "udp:0.0.0.0:7502")
    return OusterParser(DeviceSettings("scanner/left", config, {"geometry": os1_metadata(table)}))


def read_back(plan: Plan, units: list[WireUnit]) -> tuple[StructArray, StructArray]:
    """Return returns and clock samples, and check that no packet is bad."""
    parser = parser_of(plan)
    records = feed(parser, units)
    assert not parser.counters.errors
    assert parser.counters.bad_checksums == parser.counters.bytes_skipped == 0
    assert parser.counters.messages["lidar"] == len(units)
    return rows_of(records, ScannerReturns), rows_of(records, DeviceClockSamples)


# --- returns --------------------------------------------------------------------------------------------------------


def expected_returns(shot: Shots, most: int) -> list[tuple[int, int, int, float]]:
    """Return (pulse, range in mm, number, light) of the strongest returns, sorted by range, for each pulse."""
    found = []
    for number, ranges, lights in zip(shot.pulses.number, shot.measured.range_m, shot.measured.intensity, strict=True):
        echoes = [(float(lights[slot]), -slot, round(r / 0.001)) for slot, r in enumerate(ranges) if r]
        chosen = sorted(sorted(echoes, reverse=True)[:most], key=lambda echo: echo[2])
        found += [(int(number), raw, place + 1, light) for place, (light, _, raw) in enumerate(chosen)]
    return found


@pytest.mark.parametrize("dual", [False, True])
def test_returns_are_parsed_in_the_order_of_the_truth(dual: bool) -> None:
    plan = plan_of("os1", dual_return=dual)
    units, truth, (shot,) = sent(plan, [0.0, 0.03])
    rows, _ = read_back(plan, units)
    assert len(units) == len(shot.pulses) // PER_PACKET == 19
    expected = [row for row in expected_returns(shot, 2 if dual else 1) if row[0] < len(units) * PER_PACKET]
    raw = np.rint(rows["range_m"] / 0.001).astype(int)
    columns = rows["pulse_id"], raw, rows["return_number"], rows["intensity"]
    assert list(zip(*(column.tolist() for column in columns), strict=True)) == expected
    np.testing.assert_array_equal(truth["pulse"], rows["pulse_id"])
    np.testing.assert_array_equal(truth["channel"], rows["channel"])
    np.testing.assert_array_equal(truth["return_number"], rows["return_number"])
    np.testing.assert_array_equal(truth["incidence_rad"], rows["intensity"])
    assert np.abs(truth["range_m"] - rows["range_m"]).max() <= 0.0005 + 1e-12
    assert ((rows["return_number"] == 2).sum() > 4000) == dual


def test_of_two_returns_at_one_range_the_stronger_comes_first() -> None:
    plan = plan_of("os1", dual_return=True)
    units, truth, (shot,) = sent(plan, [0.0, 0.02])
    rows, _ = read_back(plan, units)
    second = np.flatnonzero(rows["return_number"] == 2)
    same = second[rows["range_m"][second] == rows["range_m"][second - 1]]
    assert len(same) > 50
    assert (rows["intensity"][same - 1] >= rows["intensity"][same]).all()
    np.testing.assert_array_equal(truth["incidence_rad"][same], rows["intensity"][same])
    strongest = shot.measured.intensity.max(axis=1, initial=0.0, where=shot.measured.range_m > 0)[truth["pulse"]]
    flagged = (rows["flags"] & RETURN_FLAG_STRONGEST) > 0
    np.testing.assert_array_equal(rows["intensity"][flagged], strongest[flagged])
    assert ((rows["flags"][second] & RETURN_FLAG_LAST) > 0).all()


def test_values_that_a_packet_cannot_express_give_no_return() -> None:
    plan = plan_of("os1")
    pulses = Os1Head(plan.tables.scanner["left"], "left").pulses(0.0, 0.01)
    shot = measured_of(pulses)
    shot.measured.range_m[:] = 524.2876  # 2¹⁹ mm, less 0.4 mm
    shot.measured.range_m[:, 1] = np.where(pulses.number % 2, 524.2873, 0.0004)
    units, truth = wire_of(plan).units(*shot)
    rows, _ = read_back(plan, units)
    assert (truth["pulse"] % 2 == 1).all()
    assert len(rows) == len(truth) == len(units) * PER_PACKET // 2
    np.testing.assert_allclose(rows["range_m"], 524.287, rtol=0, atol=1e-9)


def test_points_of_the_driver_match_the_truth_within_quanta() -> None:
    plan = plan_of("os1")
    units, truth, (shot,) = sent(plan, [0.0, 0.06])
    rows, _ = read_back(plan, units)
    pulses, at = shot.pulses, truth["pulse"]
    true = pulses.origin_s[at] + truth["range_m"][:, np.newaxis] * pulses.direction_s[at]
    points = beam_points(rows, read_head(os1_metadata(plan.tables.scanner["left"])))
    assert np.linalg.norm(points - true, axis=1).max() <= 0.0005 + 1e-9


def test_each_turn_is_a_frame() -> None:
    plan = plan_of("os1", scan_hz=20.0)
    units, truth, _ = sent(plan, [0.045, 0.06])
    rows, _ = read_back(plan, units)
    first = truth["pulse"][0] // PER_PACKET
    assert truth["pulse"][0] % PER_PACKET < 8
    column = truth["pulse"] // 64 % 1024
    np.testing.assert_allclose(rows["encoder_rad"], 2 * np.pi * (-column % 1024) / 1024, rtol=0, atol=1e-12)
    frames = [int.from_bytes(unit.data[2:4], "little") for unit in units]
    assert frames == [(first + at) // 64 for at in range(len(units))]
    assert set(frames) == {0, 1}


def test_bytes_do_not_depend_on_how_time_is_cut() -> None:
    plan = plan_of("os1", noise=True, dual_return=True)
    one, truth, _ = sent(plan, [0.0, 0.05])
    other, other_truth, _ = sent(plan, [0.0, 0.0001, 0.0001, 0.0201, 0.021, 0.049, 0.05])
    np.testing.assert_array_equal(other_truth, truth)
    assert one == other
    assert len(one) == 32


# --- time -----------------------------------------------------------------------------------------------------------


def test_timestamps_count_the_seconds_since_power_on() -> None:
    plan = plan_of("os1", true={"time_offset_us": -120.0}, oscillator={"offset_ppm": 30.0, "ticks_at_start": 5 * 10**9})
    units, truth, _ = sent(plan, [2.98, 3.03])
    rows, clock = read_back(plan, units)
    # half a minute to start up, and the ticks at the plan's start
    np.testing.assert_allclose(rows["device_time_ns"], truth["gps_ns"] + 35e9 + 120_000, rtol=0, atol=1.5)
    seconds = rows["device_time_ns"].min() // 10**9, rows["device_time_ns"].max() // 10**9
    assert seconds == (37, 38)
    np.testing.assert_array_equal(clock["pps_time_ns"], clock["device_time_ns"] // 10**9 * 10**9)
    late_ns = clock["host_time_ns"] - (clock["device_time_ns"] - 35 * 10**9 - 120_000)
    np.testing.assert_allclose(late_ns, 100_000, rtol=0, atol=2)  # no jitter: the last column and a fixed delay


def ahead_us(plan: Plan, lost: list[tuple[float, float]], times_s: list[float], *, wired: bool = True) -> FloatArray:
    """Return stamp − true time − 30 s, µs, of the packets that begin soon after each time."""
    wire, head = wire_of(plan, lost, wired=wired), Os1Head(plan.tables.scanner["left"], "left")
    found = []
    for at_s in times_s:
        units, truth = wire.units(*measured_of(head.pulses(at_s, at_s + 0.005)))
        rows = rows_of(feed(parser_of(plan), units), ScannerReturns)
        found.append(1e-3 * float(rows["device_time_ns"][0] - 30 * 10**9 - truth["gps_ns"][0]))
    return np.array(found)


def test_after_lost_pulses_the_head_continues_by_its_oscillator() -> None:
    plan = plan_of("os1", oscillator={"offset_ppm": -80.0})
    times_s = [0.9, 1.9, 2.5, 3.95, 4.9, 5.02, 6.0]
    drift = ahead_us(plan, [(1.5, 3.5)], times_s)
    np.testing.assert_allclose(drift[[0, 1, 5, 6]], 0.0, rtol=0, atol=0.002)
    np.testing.assert_allclose(drift[[2, 3, 4]], -80.0 * (np.array(times_s)[[2, 3, 4]] - 2.0), rtol=0, atol=0.2)


def test_the_first_pulse_sets_the_whole_second() -> None:
    plan = plan_of("os1", oscillator={"ticks_at_start": 2_300_000_000})
    shown = ahead_us(plan, [(0.0, 1.5)], [0.5, 2.5, 3.02, 9.0])
    np.testing.assert_allclose(shown, [2.3e6, 2.3e6, 2.0e6, 2.0e6], rtol=0, atol=0.002)


def test_a_head_without_pulses_counts_by_its_oscillator() -> None:
    plan = plan_of("os1", oscillator={"offset_ppm": 10.0}, true={"time_offset_us": 500.0}, pps=None)
    np.testing.assert_allclose(ahead_us(plan, [], [0.0, 50.0], wired=False), [0.0, 500.0], rtol=0, atol=0.1)
    assert "pps" not in config_table(plan.tables.scanner["left"], "left", "udp:0.0.0.0:7502")


# --- metadata and configuration -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("dual", "profile"), [(False, "RNG19_RFL8_SIG16_NIR16"), (True, "RNG19_RFL8_SIG16_NIR16_DUAL")]
)
def test_the_metadata_describes_the_packets(dual: bool, profile: str) -> None:
    head = read_head(os1_metadata(plan_of("os1", dual_return=dual, serial="992200").tables.scanner["left"]))
    assert (head.profile, head.serial, head.return_order) == (profile, 992_200, "STRONGEST_TO_WEAKEST")
    assert head.header == "standard"


@pytest.mark.parametrize("serial", ["0123", str(2**40), "9" * 30])
def test_serial_numbers_that_packets_cannot_carry_are_refused(serial: str) -> None:
    with pytest.raises(PlanError, match="without leading zeros") as caught:
        wire_of(plan_of("os1", serial=serial))
    assert caught.value.key == "scanner.left.serial"


@pytest.mark.parametrize("serial", ["1", str(2**40 - 1), "SIM-7", ""])
def test_other_serial_numbers_are_recorded(serial: str) -> None:
    plan = plan_of("os1", serial=serial)
    units, truth, _ = sent(plan, [0.0, 0.005])
    rows, _ = read_back(plan, units)
    assert len(rows) == len(truth) > 1000


def test_the_configuration_that_records_it_is_valid() -> None:
    config: dict[str, Any] = config_table(plan_of("os1").tables.scanner["left"], "left", "udp:0.0.0.0:7502")
    read = ScannerConfig.model_validate(config)
    assert (read.protocol, read.pps, read.auxiliary) == ("ouster", "main", None)
    assert read.geometry is not None
    assert read.geometry.file == "left.json"
