"""Tests a VLP-16's packets with this project's parser: returns, times, azimuths, PPS status, sentences."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from swath.daemon.config.tables import ScannerConfig
from swath.drivers.parser import DeviceSettings
from swath.drivers.scanner.beams import beam_points
from swath.drivers.scanner.velodyne.heads import VLP16
from swath.drivers.scanner.velodyne.parser import VelodyneParser
from swath.georef.arrays import FloatArray, StructArray
from swath.georef.records import (
    RETURN_FLAG_LAST,
    RETURN_FLAG_PPS_LOCKED,
    RETURN_FLAG_STRONGEST,
    DeviceClockSamples,
    DeviceStatus,
    Record,
    ScannerReturns,
    TimeMessage,
)
from swath.georef.timescales import HOUR_NS, gps_ns_from_utc, gps_ns_past_hour
from swath.sim.plan.plan import Plan
from swath.sim.scanners.spinning_heads import Vlp16Head
from swath.sim.scanners.spinning_wire import PPS_LOCKED, HeadClock
from swath.sim.scanners.velodyne_wire import VelodyneWire, config_table
from swath.sim.shots import WireUnit
from tests.sim.heads import Shots, Still, feed, measured_of, plan_of, pulse, rows_of

START_PAST_HOUR_S = 3598.0  # of the plans of tests.sim.heads


def wire_of(plan: Plan, lost: list[tuple[float, float]] | None = None, *, wired: bool = True) -> VelodyneWire:
    return VelodyneWire(plan, "left", pulse(plan) if wired else None, Still(), lost or [])


def sent(plan: Plan, wire: VelodyneWire, cuts: list[float]) -> tuple[list[WireUnit], StructArray, list[Shots]]:
    """Return units and truth of the time between the cuts, s."""
    head = Vlp16Head(plan.tables.scanner["left"], "left")
    shots = [measured_of(head.pulses(start, stop)) for start, stop in pairwise(cuts)]
    told = [wire.units(*shot) for shot in shots] + [wire.close()]
    return [unit for units, _ in told for unit in units], np.concatenate([rows for _, rows in told]), shots


def decode(units: list[WireUnit]) -> tuple[list[Record], VelodyneParser]:
    parser = VelodyneParser(DeviceSettings("scanner/left", {}))
    return feed(parser, units), parser


def data_of(units: list[WireUnit]) -> list[WireUnit]:
    return [unit for unit in units if unit.source == "scanner/left"]


def statuses(records: list[Record]) -> list[tuple[float, object]]:
    return [(1e-9 * r.host_time_ns, r.values["pps_status"]) for r in records if isinstance(r, DeviceStatus)]


# --- returns --------------------------------------------------------------------------------------------------------


def expected_single(shot: Shots) -> list[tuple[int, int, int, float]]:
    """Return (pulse, range in 2 mm, number, light) as the manual defines it, pulse by pulse."""
    found = []
    for number, ranges, lights in zip(shot.pulses.number, shot.measured.range_m, shot.measured.intensity, strict=True):
        echoes = [(light, -slot, round(r / 0.002)) for slot, (r, light) in enumerate(zip(ranges, lights, strict=True))]
        echoes = [echo for echo in echoes if echo[2]]
        if echoes:
            light, _, raw = max(echoes)
            found.append((int(number), raw, 1, float(light)))
    return found


def expected_pairs(shot: Shots) -> list[tuple[int, int, int, float]]:
    """Return the expected returns in dual mode: the last, and the strongest.

    If the strongest is the last, the second-strongest takes its place.
    """
    found = []
    for number, ranges, lights in zip(shot.pulses.number, shot.measured.range_m, shot.measured.intensity, strict=True):
        echoes = [(round(r / 0.002), float(lights[slot]), -slot) for slot, r in enumerate(ranges) if round(r / 0.002)]
        if not echoes:
            continue
        last = max(echoes)
        others = [echo for echo in echoes if echo[0] < last[0]]
        pair = [max(others, key=lambda echo: echo[1:]), last] if others else [last]
        found += [(int(number), raw, place + 1, light) for place, (raw, light, _) in enumerate(pair)]
    return found


@pytest.mark.parametrize("dual", [False, True])
def test_returns_are_parsed_in_the_order_of_the_truth(dual: bool) -> None:
    plan = plan_of("vlp16", dual_return=dual)
    units, truth, (shot,) = sent(plan, wire_of(plan), [0.0, 0.08])
    records, parser = decode(units)
    rows = rows_of(records, ScannerReturns)
    assert not parser.counters.errors
    assert parser.counters.bytes_skipped == 0
    packets, pulses_a_packet = len(data_of(units)), 192 if dual else 384
    expected = (expected_pairs if dual else expected_single)(shot)
    expected = [row for row in expected if row[0] < packets * pulses_a_packet]
    assert packets == len(shot.pulses) // pulses_a_packet
    number = rows["pulse_id"] // 384 * pulses_a_packet + rows["pulse_id"] % 384
    raw = np.rint(rows["range_m"] / 0.002).astype(int)
    found = zip(number.tolist(), raw.tolist(), rows["return_number"].tolist(), rows["intensity"].tolist(), strict=True)
    assert list(found) == expected
    assert len(truth) == len(rows) > 10_000
    np.testing.assert_array_equal(truth["pulse"], number)
    np.testing.assert_array_equal(truth["channel"], rows["channel"])
    np.testing.assert_array_equal(truth["return_number"], rows["return_number"])
    np.testing.assert_array_equal(truth["incidence_rad"], rows["intensity"])
    assert np.abs(truth["range_m"] - rows["range_m"]).max() <= 0.001 + 1e-12
    assert (number[rows["return_number"] == 2].size > 2000) == dual


def test_flags_of_dual_returns_describe_the_echoes() -> None:
    plan = plan_of("vlp16", dual_return=True)
    units, truth, (shot,) = sent(plan, wire_of(plan), [0.0, 0.05])
    rows = rows_of(decode(units)[0], ScannerReturns)
    strongest = shot.measured.intensity.max(axis=1, initial=0.0, where=shot.measured.range_m > 0)[truth["pulse"]]
    farthest = shot.measured.range_m.max(axis=1)[truth["pulse"]]
    flagged = (rows["flags"] & RETURN_FLAG_STRONGEST) > 0
    assert (rows["intensity"][flagged] == strongest[flagged]).all()
    last = (rows["flags"] & RETURN_FLAG_LAST) > 0
    np.testing.assert_array_equal(np.rint(rows["range_m"] / 0.002) == np.rint(farthest / 0.002), last)


def test_values_that_a_packet_cannot_express_give_no_return() -> None:
    plan = plan_of("vlp16")
    pulses = Vlp16Head(plan.tables.scanner["left"], "left").pulses(0.0, 0.01)
    shot = measured_of(pulses)
    ranges = np.full(shot.measured.range_m.shape, 131.0712)  # 65 536 units of 2 mm, less half a unit
    ranges[:, 1] = np.where(pulses.number % 2, 131.0709, 0.0009)
    shot.measured.range_m[:] = ranges
    units, truth = wire_of(plan).units(*shot)
    rows = rows_of(decode(units)[0], ScannerReturns)
    assert (truth["pulse"] % 2 == 1).all()
    assert len(rows) == len(truth) == len(data_of(units)) * 192
    np.testing.assert_allclose(rows["range_m"], 131.07, rtol=0, atol=1e-9)


# --- time -----------------------------------------------------------------------------------------------------------


def test_timestamps_are_utc_past_the_hour_across_the_end_of_the_hour() -> None:
    plan = plan_of("vlp16", true={"time_offset_us": 250.0}, oscillator={"offset_ppm": 20.0})
    wire = wire_of(plan)
    units, truth, _ = sent(plan, wire, [1.9, 2.1])
    records, parser = decode(units)
    rows = rows_of(records, ScannerReturns)
    assert not parser.counters.errors
    device = rows["device_time_ns"]
    assert device.min() < 1_000_000_000 < 3_599_000_000_000 < device.max()
    placed, believed = gps_ns_past_hour(device, plan.start_gps_ns + rows["host_time_ns"], plan.leap_seconds)
    assert believed.all()
    early_ns = plan.start_gps_ns + truth["gps_ns"] - placed - 250_000
    # rounding down to a microsecond, and 20 ppm over a packet
    assert early_ns.min() >= -30
    assert early_ns.max() < 1000


def test_azimuths_are_true_to_a_hundredth_of_a_degree() -> None:
    plan = plan_of("vlp16", scan_hz=13.0)
    units, truth, _ = sent(plan, wire_of(plan), [0.0, 0.2])
    rows = rows_of(decode(units)[0], ScannerReturns)
    true_rad = 2 * np.pi * 13.0 * 1e-9 * (truth["pulse"] // 16 * 55_296 + truth["pulse"] % 16 * 2_304)
    error = np.degrees((rows["encoder_rad"] - true_rad + np.pi) % (2 * np.pi) - np.pi)
    last_group = truth["pulse"] % 384 >= 352
    assert np.abs(error[~last_group]).max() <= 0.005 + 1e-9
    # the last group is extrapolated by the previous rotation, so the rounding of two azimuths is added
    assert 0.005 < np.abs(error[last_group]).max() <= 0.015


def test_points_of_the_driver_match_the_truth_within_quanta() -> None:
    plan = plan_of("vlp16")
    units, truth, (shot,) = sent(plan, wire_of(plan), [0.0, 0.1])
    rows = rows_of(decode(units)[0], ScannerReturns)
    pulses, at = shot.pulses, truth["pulse"]
    true = pulses.origin_s[at] + truth["range_m"][:, np.newaxis] * pulses.direction_s[at]
    missed = np.linalg.norm(beam_points(rows, VLP16.beams) - true, axis=1)
    quanta = np.where(at % 384 >= 352, 0.015, 0.005)
    assert (missed <= 0.001 + truth["range_m"] * np.radians(quanta) + 1e-9).all()


def test_bytes_do_not_depend_on_how_time_is_cut() -> None:
    plan = plan_of("vlp16", noise=True, dual_return=True)
    one, truth, _ = sent(plan, wire_of(plan), [0.0, 0.3])
    other, other_truth, _ = sent(plan, wire_of(plan), [0.0, 0.0004, 0.1, 0.1, 0.10061, 0.2, 0.299, 0.3])
    np.testing.assert_array_equal(other_truth, truth)
    assert one == other
    assert len(one) == len(data_of(one)) + 6
    assert (np.diff([unit.time_s for unit in one]) >= 0).all()


def test_a_pause_begins_a_new_packet() -> None:
    plan = plan_of("vlp16")
    head, wire = Vlp16Head(plan.tables.scanner["left"], "left"), wire_of(plan)
    first, _ = wire.units(*measured_of(head.pulses(0.0, 0.002)))
    assert len(data_of(first)) == 1
    assert len(wire.idle(0.002, 1.0)) == 20
    second, truth = wire.units(*measured_of(head.pulses(1.0, 1.01)))
    records, parser = decode([*first, *second])
    assert (truth["pulse"] >= 384 * 754).all()
    assert len(rows_of(records, ScannerReturns)[-len(truth) :]) == len(truth)
    assert set(parser.counters.errors) == {"cadence_gap"}


def test_the_host_timestamp_follows_the_last_firing() -> None:
    quiet = plan_of("vlp16")
    units, _, (shot,) = sent(quiet, wire_of(quiet), [0.0, 0.2])
    last_s = shot.pulses.time_s[383::384]
    np.testing.assert_allclose([u.time_s for u in data_of(units)], last_s + 100e-6, rtol=0, atol=1e-12)
    noisy = plan_of("vlp16", noise=True)
    late_s = np.array([u.time_s for u in data_of(sent(noisy, wire_of(noisy), [0.0, 2.0])[0])])
    assert (np.diff(late_s) >= 0).all()
    jitter_s = late_s - (np.arange(len(late_s)) * 24 + 23) * 55.296e-6 - 15 * 2.304e-6 - 100e-6
    assert jitter_s.min() >= -1e-12
    # exponential of mean 30 µs, 1500 draws
    assert jitter_s.mean() == pytest.approx(30e-6, rel=4 / np.sqrt(len(late_s)))


# --- PPS and sentences ----------------------------------------------------------------------------------------------


def test_position_packets_name_the_current_second_of_the_head() -> None:
    plan = plan_of("vlp16")
    wire = wire_of(plan)
    units = wire.idle(0.0, 4.0)
    assert [unit.source for unit in units] == 80 * ["scanner/left/aux"]
    records, parser = decode(units)
    assert parser.counters.messages["position"] == 80
    assert not parser.counters.errors  # no nmea_second_mismatch
    messages = [record for record in records if isinstance(record, TimeMessage)]
    assert len(messages) == 4
    for second, message in enumerate(messages):
        assert message.valid
        assert message.time.date is not None
        gps_ns = gps_ns_from_utc(message.time.date, message.time.time_ns, plan.leap_seconds)
        assert gps_ns == plan.start_gps_ns + second * 1_000_000_000
        assert 0.15 < 1e-9 * message.host_time_ns - second < 0.22
    assert [status for _, status in statuses(records)] == ["locked", "locked"]  # the second with a valid sentence
    assert b"$GPRMC,095958.00,A,4729." in units[10].data
    assert b",97.1922,36.8699,150626," in units[10].data  # 50 m/s in knots, course


def test_returns_report_the_locked_pulse() -> None:
    plan = plan_of("vlp16")
    units, _, _ = sent(plan, wire_of(plan), [0.0, 0.06])
    flags = rows_of(decode(units)[0], ScannerReturns)["flags"]
    assert not flags[0] & RETURN_FLAG_PPS_LOCKED  # before the first position packet
    assert flags[-1] & RETURN_FLAG_PPS_LOCKED


def past_hour_s(plan: Plan, lost: list[tuple[float, float]], times_s: list[float], *, wired: bool = True) -> FloatArray:
    """Return device time − true time past the hour, s, of the packets that begin soon after each time."""
    wire = wire_of(plan, lost, wired=wired)
    head = Vlp16Head(plan.tables.scanner["left"], "left")
    ahead = []
    for at_s in times_s:
        units, truth = wire.units(*measured_of(head.pulses(at_s, at_s + 0.004)))
        rows = rows_of(decode(data_of(units))[0], ScannerReturns)
        true_ns = truth["gps_ns"][0] + int(1e9 * START_PAST_HOUR_S)
        ahead.append(1e-9 * ((rows["device_time_ns"][0] - true_ns + HOUR_NS // 2) % HOUR_NS - HOUR_NS // 2))
    return np.array(ahead)


def test_after_lost_pulses_the_head_continues_by_its_oscillator() -> None:
    # edges of seconds 2 and 3 are lost; two consecutive edges lock again, at second 5
    plan = plan_of("vlp16", oscillator={"offset_ppm": 60.0}, true={"time_offset_us": 40.0})
    lost = [(1.5, 3.5)]
    units = wire_of(plan, lost).idle(0.0, 7.0)
    records, _ = decode(units)
    changes = [status for status in statuses(records) if status[1] != "locked" or status[0] > 1.0]
    assert [name for _, name in changes] == ["absent", "synchronizing", "locked"]
    np.testing.assert_allclose([at_s for at_s, _ in changes], [2.025, 4.025, 5.025], rtol=0, atol=2e-4)
    times_s = [0.5, 1.95, 2.5, 3.95, 4.9, 5.02, 6.0]
    ahead_us = 1e6 * past_hour_s(plan, lost, times_s)
    drift_us = [0, 0, 30, 117, 174, 0, 0]
    np.testing.assert_allclose(ahead_us, np.array(drift_us) - 40.0 - 0.5, rtol=0, atol=0.9)


def test_a_head_without_pulses_counts_from_power_on() -> None:
    oscillator = {"offset_ppm": -100.0, "ticks_at_start": 3_000_000}
    plan = plan_of("vlp16", oscillator=oscillator)
    ahead_s = past_hour_s(plan, [], [0.0, 20.0], wired=False)
    wanted = np.array([33.0, 33.0 - 0.002]) - START_PAST_HOUR_S + 3600.0
    np.testing.assert_allclose(ahead_s, wanted, rtol=0, atol=2e-6)
    units = wire_of(plan, wired=False).idle(0.0, 3.0)
    records, parser = decode(units)
    assert [name for _, name in statuses(records)] == ["absent"]
    assert not [record for record in records if isinstance(record, TimeMessage)]
    assert not parser.counters.errors
    assert all(unit.data[206:] == bytes(306) for unit in units)


def test_a_first_pulse_in_flight_sets_the_head() -> None:
    plan = plan_of("vlp16")
    lost = [(0.0, 1.5)]
    ahead_s = past_hour_s(plan, lost, [0.2, 1.9, 2.95, 3.02])
    # second 2 brings the first, second 3 locks; before, 30 s since power-on at the start, past the hour's end
    np.testing.assert_allclose(ahead_s, [32.0, 32.0, 32.0, 0.0], rtol=0, atol=2e-6)
    status = HeadClock(1_000_000, plan.tables.scanner["left"].oscillator, pulse(plan), lost, 0.0, 3598).status
    np.testing.assert_array_equal(status(np.array([0.5, 1.5, 2.5, 3.5, 60.5])), [0, 0, 1, PPS_LOCKED, PPS_LOCKED])


def test_clock_samples_follow_the_host() -> None:
    plan = plan_of("vlp16")
    units, _, _ = sent(plan, wire_of(plan), [0.0, 0.5])
    clock = rows_of(decode(data_of(units))[0], DeviceClockSamples)
    ahead_ns = clock["device_time_ns"] - clock["host_time_ns"] - int(1e9 * START_PAST_HOUR_S)
    assert len(clock) == len(data_of(units))
    assert ahead_ns.min() > -100_000 - 1100  # the fixed delay, floor to a microsecond
    assert ahead_ns.max() <= -100_000 + 1


# --- configuration --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("pps", ["main", None])
def test_the_configuration_that_records_it_is_valid(pps: str | None) -> None:
    table = plan_of("vlp16", pps=pps, model="VLP-16", serial="AG12").tables.scanner["left"]
    config: dict[str, Any] = config_table(table, "left", "udp:0.0.0.0:2368", "udp:0.0.0.0:8308")
    read = ScannerConfig.model_validate(config)
    assert (read.protocol, read.pps) == ("velodyne-vlp16", pps)
    assert (read.auxiliary, read.model, read.serial) == ("udp:0.0.0.0:8308", "VLP-16", "AG12")
    assert read.lever_arm_m == [0.12, -0.03, 0.28]
    assert read.installation is not None
