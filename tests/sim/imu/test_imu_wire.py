"""Tests frames of the virtual unit with the parser that reads any DBC: values, stamps and edges return."""

from __future__ import annotations

import tomllib
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import tomlkit

from swath.daemon.config.tables import ImuConfig
from swath.drivers.can_frames import CAN_FRAME_DTYPE
from swath.drivers.driver import find_driver
from swath.drivers.parser import DeviceSettings
from swath.georef.arrays import FloatArray, StructArray
from swath.georef.records import ChunkBatch, DeviceClockSamples, ImuSamples
from swath.sim.clocks import PulsePerSecond
from swath.sim.imu.sensors import InertialUnit
from swath.sim.imu.wire import FORCE_UNIT_MPS2, RATE_UNIT_RADPS, ImuWire, config_table, dbc_text
from swath.sim.plan.errors import PlanError
from swath.sim.plan.tables import ImuTable, OscillatorTable, PpsTable
from swath.sim.shots import WireUnit
from tests.sim.inertial_motion import circling_the_pole, standing

SECONDS = 6.0
OSCILLATOR = OscillatorTable(offset_ppm=40.0, drift_ppm_per_h=20.0, wander_ppm=0.2, ticks_at_start=2**32 - 2_000_000)
SYNC = 260


def made(noise: bool = True, **keys: Any) -> InertialUnit:
    """Return a tactical unit in a steady turn."""
    table = ImuTable(**({"oscillator": OSCILLATOR} | keys))
    return InertialUnit(table, circling_the_pole(SECONDS, 800.0, 0.075, 6357500.0), 4, "main", noise=noise)


def wired(unit: InertialUnit, jitter_us: float = 60.0, jitter_ns: float = 0.0, **keys: Any) -> ImuWire:
    pulse = PulsePerSecond(PpsTable(jitter_ns=jitter_ns), 4, "main", noise=unit.noise)
    return ImuWire(unit, pulse, jitter_us, **keys)


def settings(table: ImuTable) -> DeviceSettings:
    config = config_table(table, "main", "can:virtual:imu")
    return DeviceSettings("imu/main", config, {"dbc": dbc_text(table).encode()})


def decoded(units: list[WireUnit], table: ImuTable) -> tuple[StructArray, StructArray]:
    """Return samples and device clock rows, and check that no frame was faulty."""
    parser = find_driver("imu", "dbc").make_parser(settings(table))
    host_ns = np.array([round(one.time_s * 1e9) for one in units], np.int64) + 10**15
    rows = np.stack([np.frombuffer(one.data, np.uint8) for one in units])
    records = [*parser.feed_batch(ChunkBatch("imu/main", host_ns, rows)), *parser.close()]
    assert not +parser.counters.errors
    samples = [record.rows for record in records if isinstance(record, ImuSamples)]
    return np.concatenate(samples), np.concatenate(
        [record.rows for record in records if isinstance(record, DeviceClockSamples)]
    )


def gps_times_s(rows: StructArray) -> FloatArray:
    """Return times of samples, s, interpolated linearly between the edges that they carry.

    The first edge is that of second 0.
    """
    edges_ns = np.unique(rows["pps_time_ns"])
    assert len(edges_ns) == SECONDS
    assert edges_ns[0] >= 0
    second = np.searchsorted(edges_ns, rows["pps_time_ns"])
    slope = np.diff(edges_ns)[np.minimum(second, len(edges_ns) - 2)]
    times_s: FloatArray = second + (rows["device_time_ns"] - rows["pps_time_ns"]) / slope
    return times_s


@pytest.mark.parametrize(
    "keys",
    [
        {},
        {"tick_bits": 24, "rate_hz": 100},
        {"tick_bits": 16, "rate_hz": 1000},
        {"tick_bits": 16, "tick_hz": 10_000, "rate_hz": 10},
        {"tick_hz": 100_000_000, "rate_hz": 2000, "grade": "navigation"},
        {"rotation_b_imu": [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], "grade": "mems"},
    ],
    ids=lambda keys: " ".join(map(str, keys.values())) or "plain",
)
def test_the_parser_reads_the_measurements_of_the_unit(keys: dict[str, Any]) -> None:
    unit = made(**keys)
    rows, clock = decoded(wired(unit).units(0.0, SECONDS + 1.0), unit.table)
    end_s, force, rate = unit.samples(1, unit.last)
    assert len(rows) == unit.last
    np.testing.assert_allclose(rows["specific_force_b"], force, rtol=0, atol=0.501 * FORCE_UNIT_MPS2)
    np.testing.assert_allclose(rows["angular_rate_b"], rate, rtol=0, atol=0.501 * RATE_UNIT_RADPS)
    assert FORCE_UNIT_MPS2 <= 2e-6
    assert RATE_UNIT_RADPS <= 2e-8
    np.testing.assert_allclose(rows["temperature_c"], 38.0)
    tick_ns = 1e9 / unit.table.tick_hz
    elapsed_ns = rows["device_time_ns"] - rows["device_time_ns"][0]
    counted_ns = unit.oscillator.phase(end_s) * tick_ns
    np.testing.assert_allclose(elapsed_ns, counted_ns - counted_ns[0], rtol=0, atol=1.01 * tick_ns)
    np.testing.assert_array_equal(clock["pps_time_ns"], rows["pps_time_ns"])
    np.testing.assert_allclose(gps_times_s(rows), end_s, rtol=0, atol=3.0 / unit.table.tick_hz + 1e-8)


def test_samples_carry_the_latest_transmitted_edge() -> None:
    """The edge's frame is sent within a millisecond of the edge; from then on every sample carries it."""
    unit = made(noise=False)
    units = wired(unit).units(0.0, SECONDS)
    rows, _ = decoded(units, unit.table)
    edges = unit.oscillator.phase(np.arange(7.0))
    counts = edges[:1] + (rows["pps_time_ns"] - rows["pps_time_ns"][0]) * 1e-3
    end_s = unit.samples(1, len(rows))[0]
    expected = edges[np.floor(end_s + 0.0005).astype(int)]
    clear = np.abs(end_s - np.rint(end_s)) > 0.001
    np.testing.assert_allclose(counts[clear], expected[clear], rtol=0, atol=1.01)
    told = [one.time_s for one in units if int(np.frombuffer(one.data, CAN_FRAME_DTYPE)["can_id"][0]) == SYNC]
    assert len(told) == 6
    assert all(0.0 < time_s % 1.0 <= 0.001 for time_s in told)


def test_the_counter_wraps_in_flight() -> None:
    unit = made()
    frames = np.stack([np.frombuffer(one.data, CAN_FRAME_DTYPE)[0] for one in wired(unit).units(0.0, SECONDS)])
    ticks = frames["data"][frames["can_id"] == 256][:, :4].copy().view("<u4").ravel().astype(np.int64)
    assert np.count_nonzero(np.diff(ticks) < 0) == 1
    rows, _ = decoded(wired(unit).units(0.0, SECONDS), unit.table)
    assert np.diff(rows["device_time_ns"]).min() > 4_990_000


@pytest.mark.parametrize("latency_us", [0.0, 1500.0, 40_000.0, -3000.0])
def test_timestamps_are_late_by_the_latency_and_frames_follow_them(latency_us: float) -> None:
    unit = made(noise=False, latency_us=latency_us, oscillator=OscillatorTable())
    units = wired(unit).units(0.0, SECONDS)
    rows, _ = decoded(units, unit.table)
    end_s = unit.samples(1, len(rows))[0]
    np.testing.assert_array_equal(rows["device_time_ns"], np.rint((end_s + 1e-6 * latency_us) * 1e9))
    closing_s = (rows["host_time_ns"] - 10**15) * 1e-9
    behind_s = closing_s - end_s - max(1e-6 * latency_us, 0.0)
    np.testing.assert_allclose(behind_s, 50e-6 + 4 * 120e-6, rtol=0, atol=2e-9)


def test_host_timestamps_lag_by_the_jitter_and_keep_their_order() -> None:
    quiet, rough = (wired(made(), jitter_us).units(0.0, SECONDS) for jitter_us in (0.0, 60.0))
    assert [one.data for one in quiet] == [one.data for one in rough]
    stamps = np.array([one.time_s for one in rough])
    lag_s = stamps - [one.time_s for one in quiet]
    assert np.diff(stamps).min() >= 0.0
    assert lag_s.min() >= 0.0
    assert 60e-6 < lag_s.mean() < 120e-6  # a late frame delays those after it, so the mean exceeds 60 µs
    assert {one.source for one in rough} == {"imu/main"}


@pytest.mark.parametrize("keys", [{}, {"latency_us": 7000.0, "rate_hz": 1000}])
def test_frames_do_not_depend_on_how_time_is_cut(keys: dict[str, Any]) -> None:
    whole = wired(made(**keys), jitter_ns=20.0).units(0.0, SECONDS + 1.0)
    wire = wired(made(**keys), jitter_ns=20.0)
    cuts = [0.0, 0.25, 0.2503, 0.5, 1.0003, 1.00031, 1.7, 2.0, 3.141592, 5.9999, 6.0004, 6.1, 7.0]
    pieces = [wire.units(start_s, stop_s) for start_s, stop_s in pairwise(cuts)]
    assert [one for piece in pieces for one in piece] == whole
    assert pieces[-1] == []
    assert wired(made(**keys, grade="mems")).units(0.0, 1.0) != whole[: len(pieces[0])]


def test_a_lost_pulse_is_not_latched() -> None:
    unit = made()
    rows, _ = decoded(wired(unit, lost_pps=[(1.5, 3.5)]).units(0.0, SECONDS), unit.table)
    edges_s = np.unique(rows["pps_time_ns"][rows["pps_time_ns"] >= 0]) * 1e-9
    np.testing.assert_allclose(np.diff(edges_s), [1.0, 3.0, 1.0], rtol=1e-4)


def test_without_pps_there_are_no_latches() -> None:
    unit = made(pps=None)
    units = ImuWire(unit, None, 60.0).units(0.0, SECONDS + 1.0)
    rows = decoded_without_clock(units, unit.table)
    assert len(units) == 4 * len(rows)
    assert "pps" not in config_table(unit.table, "main", "can:virtual:imu")
    assert set(rows["pps_time_ns"].tolist()) == {-1}


def decoded_without_clock(units: list[WireUnit], table: ImuTable) -> StructArray:
    parser = find_driver("imu", "dbc").make_parser(settings(table))
    rows = np.stack([np.frombuffer(one.data, np.uint8) for one in units])
    (record,) = parser.feed_batch(ChunkBatch("imu/main", np.arange(len(rows), dtype=np.int64), rows))
    assert isinstance(record, ImuSamples)
    return record.rows


def test_values_beyond_the_range_of_a_frame_are_clipped() -> None:
    table = ImuTable(grade="perfect", rate_hz=50)
    unit = InertialUnit(table, circling_the_pole(1.0, 50.0, 12.0, 6357500.0), 1, "main", noise=False)
    rows, _ = decoded(wired(unit).units(0.0, 1.5), table)
    assert rows["angular_rate_b"][:, 2].tolist() == [-RATE_UNIT_RADPS * (2**31 - 1)] * 50
    np.testing.assert_allclose(rows["specific_force_b"][:, 1], -FORCE_UNIT_MPS2 * (2**31 - 1), rtol=1e-12)


@pytest.mark.parametrize("grade", ["navigation", "tactical", "mems", "perfect"])
@pytest.mark.parametrize("pps", ["main", None])
def test_the_configuration_is_valid_for_the_recorder(grade: Any, pps: str | None) -> None:
    table = ImuTable(grade=grade, pps=pps, rate_hz=400, tick_hz=10_000_000)
    text = tomlkit.dumps({"imu": {"main": config_table(table, "main", "can:socketcan:can0?bitrate=1000000")}})
    read = ImuConfig.model_validate(tomllib.loads(text)["imu"]["main"])
    assert (read.pps, read.rate_hz, read.tick_hz, read.sample, read.stamp) == (pps, 400, 10_000_000, "mean", "end")
    assert read.noise.grade == ("navigation" if grade == "perfect" else grade)
    assert read.dbc == "main.dbc"


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        (
            {"tick_bits": 16, "tick_hz": 100_000_000},
            r"^imu\.main\.tick_bits: 16 bits at tick_hz = 100000000 wrap every 0\.655 ms, want 8 ms or more: more bits",
        ),
        ({"tick_bits": 16, "rate_hz": 10}, r"^imu\.main\.tick_bits: 16 bits .* wrap every 65\.5 ms, want 117 ms"),
        ({"tick_hz": 1000, "rate_hz": 2000}, r"^imu\.main\.tick_hz: got 1000, want rate_hz, 2000, or more$"),
    ],
)
def test_a_counter_that_cannot_be_followed_is_refused(keys: dict[str, Any], message: str) -> None:
    unit = InertialUnit(ImuTable(**keys), standing(2.0), 1, "main", noise=True)
    with pytest.raises(PlanError, match=message):
        ImuWire(unit, None, 60.0)
