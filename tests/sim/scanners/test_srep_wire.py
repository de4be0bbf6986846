"""Tests SREP on the wire: this project's parser returns every true return, in the order of its row."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import pytest

from swath.daemon.config.tables import ScannerConfig
from swath.drivers.scanner.srep.layout import HEADER_DTYPE, SrepHeader, encode_datagram, encode_datagrams, pulse_dtype
from swath.georef.arrays import FloatArray, Int64Array
from swath.sim.clocks import Oscillator, PulsePerSecond
from swath.sim.plan.errors import PlanError
from swath.sim.plan.tables import HostTable, PpsTable, ScannerTable
from swath.sim.scanners.line_heads import LineHead
from swath.sim.scanners.srep_wire import PROCESSING_S, SrepWire, config_table
from swath.sim.shots import Measured, Pulses
from swath.sim.truth import RETURN_TRUTH_DTYPE
from tests.sim.srep_spoken import (
    C_MPS,
    TRANSPORT,
    Spoken,
    joined,
    measured_count,
    measured_of,
    pulse_per_second,
    scanner,
    speak,
)


def expected_angle(table: ScannerTable, encoder: Int64Array) -> FloatArray:
    """Return θ_encoder, rad, as the page of SREP defines it."""
    shaft = 2 * np.pi * encoder / table.encoder_counts
    if table.kind == "polygon":
        facet = np.floor(encoder * table.facets / table.encoder_counts)
        return np.asarray(2.0 * (shaft - 2 * np.pi * (facet + 0.5) / table.facets))
    return np.asarray(shaft * (2.0 if table.kind == "oscillating" else 1.0))


# ---------------------------------------------------------------------------------------------- whole ranges


@pytest.mark.parametrize("slots", [1, 3, 7])
@pytest.mark.parametrize("kind", ["oscillating", "polygon", "monogon", "nutating", "risley"])
def test_every_return_is_parsed_in_the_order_of_its_row(kind: str, slots: int) -> None:
    table = scanner(kind=kind, return_slots=slots)
    spoken = speak(table)
    rows, _ = spoken.parsed()
    truth, pulses = spoken.truth, joined(spoken.pulses)
    fired = measured_count(pulses["number"], slots).sum()
    assert len(rows) == len(truth) == fired
    at = np.searchsorted(pulses["number"], truth["pulse"])
    np.testing.assert_allclose(rows["range_m"], truth["range_m"], atol=0.5e-4 + 1e-9)
    np.testing.assert_array_equal(rows["return_number"], truth["return_number"])
    np.testing.assert_array_equal(rows["channel"], truth["channel"] if kind == "polygon" else 0)
    np.testing.assert_allclose(rows["encoder_rad"], expected_angle(table, pulses["encoder"][at]), atol=1e-12)
    ticks = [round(k * table.tick_hz / table.prf_hz) for k in truth["pulse"].tolist()]
    np.testing.assert_array_equal(rows["device_time_ns"], [tick * 10**9 // table.tick_hz for tick in ticks])
    oscillator = Oscillator(table.tick_hz, table.oscillator)
    np.testing.assert_allclose(oscillator.phase(pulses["time_s"][at]), ticks, atol=1e-5)
    number = np.unique(truth["pulse"], return_index=True)[1]
    assert len(np.unique(rows["pulse_id"])) == len(number)
    assert rows["intensity"].max() > 3900
    np.testing.assert_allclose(rows["pulse_width_ns"], 3.0 + (truth["range_m"] - 900.0) / 200.0, atol=0.006)


def test_a_header_has_the_fields_of_the_protocol_page() -> None:
    ticks_at_start = 2**63 - 5
    oscillator = {"ticks_at_start": ticks_at_start}
    table = scanner(oscillator=oscillator, prf_hz=150_000.0, tick_hz=20_000_000, return_slots=2, encoder_counts=100_000)
    keys: dict[str, Any] = {"ranges_m": (900.0, 990.0), "scanner_id": 513, "first_sequence": 2**32 - 2}
    spoken = speak(table, (3.0, 3.2), pps=pulse_per_second(0.0), **keys)
    head = struct.unpack("<IBBHIHBBIIQQII", spoken.units[0].data[:48])
    first = spoken.pulses[0].number[0]
    assert first == 450_000
    assert head == (
        0x50455253, 1, 7, 100, 2**32 - 2, 513, 2, 0, 4, 20_000_000, ticks_at_start + 60_000_000,
        ticks_at_start + 60_000_000, 100_000, 150_000_000,
    )  # fmt: skip
    headers = spoken.headers()
    assert headers["sequence"].tolist()[:4] == [2**32 - 2, 2**32 - 1, 0, 1]
    assert len(headers) == 300
    rows, clocks = spoken.parsed()
    assert (rows["flags"] == 4).all()  # PPS locked
    last = [50 * round(k * 20_000_000 / 150_000) for k in range(first + 99, first + 30_000, 100)]
    np.testing.assert_array_equal(np.diff(clocks["device_time_ns"]), np.diff(last))


def test_datagrams_share_a_zone_that_counts_the_emissions_in_between() -> None:
    table = scanner(prf_hz=400_000.0, return_slots=1)
    spoken = speak(table, (1.0, 1.01), ranges_m=(300.0, 2300.0))
    rows, _ = spoken.parsed()
    unambiguous_m = C_MPS / (2 * 400_000.0)
    np.testing.assert_array_equal(rows["mta_zone"], np.floor(spoken.truth["range_m"] / unambiguous_m))
    assert set(rows["mta_zone"].tolist()) == set(range(7))
    np.testing.assert_allclose(rows["range_m"], spoken.truth["range_m"], atol=0.5e-4 + 1e-9)
    headers = spoken.headers()
    assert headers["pulses"].sum() == 4000
    assert (headers["mta_zone"][1:] != headers["mta_zone"][:-1]).all()  # cut for no other reason


def test_a_pulse_without_return_stays_in_the_current_zone() -> None:
    table = scanner(prf_hz=150_000.0, return_slots=2)
    pulses = LineHead(table, "left").pulses(0.0, 11.5 / 150_000)
    range_m = np.zeros((len(pulses), 2))
    range_m[[2, 5, 6], 0] = 1100.0, 1200.0, 900.0  # R_a is 999.3 m
    range_m[6, 1] = 1020.0  # the second return of a pulse does not change its zone
    wire = SrepWire(table, "left", None, HostTable(), 1, noise=False)
    spoken = Spoken(table, wire)
    for start, stop in ((0, 4), (4, len(pulses))):
        part = Pulses(*(getattr(pulses, name)[start:stop] for name in Pulses.__dataclass_fields__))
        rows = np.zeros((stop - start, 2), RETURN_TRUTH_DTYPE)
        spoken.add(wire.units(part, Measured(*([range_m[start:stop]] * 3)), rows))
    spoken.add(wire.close())
    headers = spoken.headers()
    assert headers["mta_zone"].tolist() == [0, 1, 0]
    assert headers["pulses"].tolist() == [2, 4, 6]


def test_empty_slots_in_between_are_removed_on_the_wire() -> None:
    table = scanner(return_slots=3)
    pulses = LineHead(table, "left").pulses(0.0, 1.5 / table.prf_hz)
    range_m = np.array([[0.0, 500.0, 600.0], [400.0, 0.0, 450.0]])
    truth = np.zeros((2, 3), RETURN_TRUTH_DTYPE)
    truth["range_m"], truth["return_number"] = range_m, [1, 2, 3]
    spoken = Spoken(table, SrepWire(table, "left", None, HostTable(), 1, noise=False))
    spoken.add(spoken.wire.units(pulses, Measured(range_m, range_m, range_m), truth))
    spoken.add(spoken.wire.close())
    rows, _ = spoken.parsed()
    np.testing.assert_allclose(rows["range_m"], [500.0, 600.0, 400.0, 450.0], atol=1e-9)
    assert spoken.truth["range_m"].tolist() == [500.0, 600.0, 400.0, 450.0]
    assert rows["return_number"].tolist() == spoken.truth["return_number"].tolist() == [1, 2, 1, 2]


# ---------------------------------------------------------------------------------------------- blocks, pauses, time


@pytest.mark.parametrize("zone", ["resolved", "apparent"])
@pytest.mark.parametrize("kind", ["oscillating", "polygon"])
def test_bytes_do_not_depend_on_how_time_is_cut(kind: str, zone: str) -> None:
    table = scanner(kind=kind, zone=zone, prf_hz=200_000.0)
    idle, ranges_m = [(10.02, 10.35)], (740.0, 1400.0)  # some echoes are in the previous zone, which ends at 749.5 m
    one = speak(table, (10.0, 10.02, 10.35, 10.4), noise=True, idle=idle, ranges_m=ranges_m)
    cuts = (10.0, 10.000003, 10.0111, 10.0111, 10.02, 10.13, 10.2, 10.35, 10.350001, 10.3777, 10.4)
    other = speak(table, cuts, noise=True, idle=idle, ranges_m=ranges_m)
    assert one.units == other.units
    np.testing.assert_array_equal(one.truth, other.truth)
    assert one.wire.lost_echoes == other.wire.lost_echoes
    assert len(one.parsed()[0]) == len(one.truth)


def test_a_pause_ends_a_datagram_and_is_filled_with_heartbeats() -> None:
    table = scanner(true={"time_offset_us": 400.0})
    spoken = speak(table, (5.0, 5.00251, 5.4, 5.403), idle=[(5.00251, 5.4)])
    headers = spoken.headers()
    assert headers["pulses"].tolist() == [100, 100, 51, 0, 0, 0, 100, 100, 100]
    assert (headers["flags"] & 4 > 0).tolist() == (headers["pulses"] > 0).tolist()  # laser on
    assert headers["sequence"].tolist() == list(range(9))
    oscillator = Oscillator(table.tick_hz, table.oscillator)
    beats_s = np.array([5.1, 5.2, 5.3])
    np.testing.assert_array_equal(headers["first_ticks"][3:6], np.floor(oscillator.phase(beats_s - 400e-6)))
    np.testing.assert_allclose([unit.time_s for unit in spoken.units[3:6]], beats_s + PROCESSING_S, atol=1e-12)
    rows, clocks = spoken.parsed()
    assert len(rows) == len(spoken.truth)
    assert len(clocks) == 9
    assert (np.diff(clocks["device_time_ns"]) > 0).all()


def test_truth_of_returns_sent_in_a_pause_comes_with_the_next_units() -> None:
    table = scanner(return_slots=1)
    wire, head = SrepWire(table, "left", None, HostTable(), 1, noise=False), LineHead(table, "left")
    pulses = head.pulses(0.0, 50 / table.prf_hz)
    measured, truth = measured_of(pulses, 1, 500.0, 600.0)
    units, rows = wire.units(pulses, measured, truth)
    assert (len(units), len(rows)) == (0, 0)
    assert len(wire.idle(0.001, 0.05)) == 1
    units, rows = wire.close()
    assert len(units) == 0
    np.testing.assert_array_equal(rows, truth[measured.range_m > 0])
    assert wire.close()[1].size == 0


def test_a_long_gap_between_pulses_ends_a_datagram_too() -> None:
    table = scanner()
    wire, head = SrepWire(table, "left", None, HostTable(), 1, noise=False), LineHead(table, "left")
    spoken = Spoken(table, wire)
    for start in (0.0, 0.5):
        pulses = head.pulses(start + 1e-6, start + 0.000251)
        spoken.add(wire.units(pulses, *measured_of(pulses, 3, 500.0, 600.0)))
    spoken.add(wire.close())
    assert spoken.headers()["pulses"].tolist() == [25, 25]


def test_ticks_since_the_first_pulse_fit_their_field() -> None:
    """At 1 GHz and 100 pulses a second 2³² ticks pass in 430 pulses."""
    oscillator = {"ticks_at_start": 12}
    table = scanner(tick_hz=1_000_000_000, prf_hz=100.0, pulses_per_datagram=1000, oscillator=oscillator)
    spoken = speak(table, (0.0, 6.0))
    rows, _ = spoken.parsed()
    expected = 12 + spoken.truth["pulse"] * 10_000_000
    np.testing.assert_array_equal(rows["device_time_ns"], expected)
    assert spoken.headers()["pulses"].sum() == 600


def test_units_arrive_after_a_fixed_time_and_jitter_in_order() -> None:
    table = scanner(pulses_per_datagram=10)
    quiet, noisy = (speak(table, (10.0, 10.5), noise=noise) for noise in (False, True))
    pulses = joined(quiet.pulses)
    np.testing.assert_allclose(
        [unit.time_s for unit in quiet.units], pulses["time_s"][9::10] + PROCESSING_S, atol=1e-12
    )
    times = np.array([unit.time_s for unit in noisy.units])
    assert (np.diff(times) >= 0.0).all()
    late = times - pulses["time_s"][9::10] - PROCESSING_S
    assert late.min() >= 0.0
    assert late.mean() == pytest.approx(30e-6, rel=5 / np.sqrt(len(late)))  # only one in 100 µs waits for another
    assert [unit.data for unit in noisy.units] == [unit.data for unit in quiet.units]
    assert {unit.source for unit in noisy.units} == {"scanner/left"}


# ---------------------------------------------------------------------------------------------- the pulse per second


def test_the_latch_is_that_at_the_sending_of_each_datagram() -> None:
    table = scanner(true={"time_offset_us": 90.0})
    pps = pulse_per_second(500.0)
    spoken = speak(table, (0.0, 0.4, 2.3), pps=pps)
    headers = spoken.headers()
    sent_s = np.array([unit.time_s for unit in spoken.units])
    edges_s = pps.edges(np.arange(4))
    edges_s = edges_s[edges_s >= 0.0]  # the counter starts with the plan
    count = (sent_s[:, np.newaxis] >= edges_s).sum(axis=1)
    np.testing.assert_array_equal(headers["pps_count"], count)
    latched = np.floor(Oscillator(table.tick_hz, table.oscillator).phase(edges_s))
    np.testing.assert_array_equal(headers["pps_ticks"][count > 0], latched[count[count > 0] - 1])
    np.testing.assert_array_equal(headers["flags"] & 1, count > 0)
    assert (headers["pps_ticks"] > headers["first_ticks"]).any()  # an edge between first pulse and sending


def test_an_edge_before_power_on_is_not_latched() -> None:
    early = (PulsePerSecond(PpsTable(jitter_ns=500.0), seed, "main", noise=True) for seed in range(100))
    pps = next(pps for pps in early if pps.edges(np.zeros(1, np.int64))[0] < -100e-9)
    off, on = (
        speak(scanner(oscillator={"ticks_at_start": ticks}), (0.0, 0.01), pps=pps).headers() for ticks in (0, 1000)
    )
    assert not off["pps_count"].any()
    assert (on["pps_count"] == 1).all()
    assert ((on["pps_ticks"] > 950) & (on["pps_ticks"] < 1000)).all()


def test_a_lost_pps_keeps_the_count_and_loses_the_lock() -> None:
    table = scanner(prf_hz=1000.0, pulses_per_datagram=20)
    spoken = speak(table, (0.0, 8.0), pps=pulse_per_second(0.0), lost_pps=[(0.0, 1.5), (3.7, 6.2), (7.1, 7.9)])
    headers = spoken.headers()
    sent_s = np.array([unit.time_s for unit in spoken.units])
    seconds = [2, 3, 7, 8]
    count = sum((sent_s >= second).astype(int) for second in seconds)
    np.testing.assert_array_equal(headers["pps_count"], count)
    locked = ((sent_s >= 2.0) & (sent_s < 4.5)) | (sent_s >= 7.0)
    np.testing.assert_array_equal(headers["flags"] & 1, locked)
    ticks = np.floor(Oscillator(table.tick_hz, table.oscillator).phase(np.array([0.0, *seconds])))
    ticks[0] = 0
    np.testing.assert_array_equal(headers["pps_ticks"], ticks[count])


def test_without_a_pps_nothing_is_latched() -> None:
    table = scanner()
    wire, head = SrepWire(table, "left", None, HostTable(), 1, noise=False), LineHead(table, "left")
    pulses = head.pulses(100.0, 100.01)
    spoken = Spoken(table, wire)
    spoken.add(wire.units(pulses, *measured_of(pulses, 3, 500.0, 600.0)))
    headers = spoken.headers()
    assert (headers["flags"] == 6).all()
    assert not headers["pps_count"].any()
    assert (spoken.parsed()[1]["pps_time_ns"] == -1).all()


# ---------------------------------------------------------------------------------------------- encoder, configuration


def test_many_datagrams_at_once_equal_those_sent_singly() -> None:
    rng = np.random.default_rng(1)
    m, n, slots = 5, 7, 3
    body = np.zeros((m, n), pulse_dtype(slots))
    body["ticks"], body["encoder"] = rng.integers(0, 2**32, (m, n)), rng.integers(-(2**31), 2**31, (m, n))
    body["slot"]["range"] = rng.integers(0, 2**32, (m, n, slots))
    body["slot"]["intensity"], body["slot"]["pulse_width"] = rng.integers(0, 2**16, (2, m, n, slots))
    header = np.zeros(m, HEADER_DTYPE)
    header["sequence"], header["first_ticks"] = np.arange(m), 10**12 + np.arange(m)
    one_by_one = [
        encode_datagram(
            SrepHeader(sequence=k, tick_hz=0, encoder_counts=0, first_ticks=10**12 + k),
            body["ticks"][k], body["encoder"][k],
            body["slot"]["range"][k], body["slot"]["intensity"][k], body["slot"]["pulse_width"][k],
        )
        for k in range(m)
    ]  # fmt: skip
    assert encode_datagrams(header, body) == one_by_one


@pytest.mark.parametrize("kind", ["oscillating", "polygon", "monogon", "nutating", "risley"])
def test_its_table_is_valid_in_a_configuration(kind: str) -> None:
    table = scanner(
        kind=kind,
        model="VUX-SIM",
        serial="77",
        installation=[[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]],
        nominal={"lever_arm_x_m": 0.5, "lever_arm_y_m": -0.25, "lever_arm_z_m": 1.5},
        true={"lever_arm_x_m": 0.6},
    )
    config = ScannerConfig.model_validate(config_table(table, "left", TRANSPORT))
    assert config.lever_arm_m == [0.5, -0.25, 1.5]
    assert (config.protocol, config.pps, config.model, config.serial) == ("srep", "main", "VUX-SIM", "77")
    assert config.mirror_factor == (2.0 if kind == "oscillating" else 1.0)
    assert config.installation == table.installation
    assert (config.range_min_m, config.range_max_m) == (20.0, 3000.0)
    assert config.geometry is not None
    assert config.geometry.type == kind
    assert "pps" not in config_table(scanner(pps=None), "left", TRANSPORT)


def test_impossible_values_are_refused_by_their_key() -> None:
    def wire(**keys: Any) -> None:
        SrepWire(scanner(**keys), "left", None, HostTable(), 1, noise=False)

    wire(pulses_per_datagram=1022, return_slots=7)
    with pytest.raises(PlanError, match=r"^scanner\.left\.pulses_per_datagram: got 1023, want at most 1022: UDP"):
        wire(pulses_per_datagram=1023, return_slots=7)
    wire(zone="apparent", prf_hz=2e6, range_max_m=20_000.0)
    with pytest.raises(PlanError, match=r"^scanner\.left\.range_max_m: got 20000, want less than 19112: at most 255"):
        wire(prf_hz=2e6, range_max_m=20_000.0)
    mirrored = scanner(installation=[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]])
    with pytest.raises(PlanError, match=r"^scanner\.left\.installation: is no rotation"):
        config_table(mirrored, "left", TRANSPORT)
