"""Tests MicroStrain MIP: a recording by the maker's library, the SDK's example, and what the recording lacks."""

from __future__ import annotations

import gzip
from math import degrees, nan, radians
from typing import Any

import numpy as np
import pytest

from swath.drivers.driver import find_driver
from swath.drivers.framing.checksums import ubx_fletcher
from swath.drivers.imu.microstrain import wire
from swath.drivers.imu.microstrain.parser import STANDARD_GRAVITY, MicrostrainParser, make_time_parser
from swath.drivers.imu.microstrain.startup import receiver_startup_messages, startup_messages
from swath.drivers.imu.microstrain.wire import FILTER, GNSS, SENSOR, SYSTEM, encode_data
from swath.drivers.parser import DeviceSettings, DriverSettingsError
from swath.drivers.startup import Answer, StartupOptions
from swath.georef.records import (
    Chunk,
    DeviceStatus,
    EventMark,
    FixType,
    GnssFix,
    ImuSamples,
    InsSolution,
    Record,
    TimeMessage,
)
from tests.drivers.harness import check_bytewise, check_damage, check_every_cut, check_garbage, check_random_cuts
from tests.drivers.recordings import FIXTURES

WEEK, TOW_S = 2443, 303_000.25
# of the SDK's example (packet_example_cpp_check.txt): reference time and step, scaled and integrated values
EXAMPLE = bytes.fromhex(
    "7565804C0AD5000000055EE67CC00AD6000000014E434A000E043D9EE88D387FDB00BF7AAF030E05BB0C1E30BB572E68BBAA24AE"
    "0E07BC8AAC80BC72C50EBCC4E2C10E083EEE3D9FBD66DADDC0AFDEF59196"
)


def recording() -> bytes:
    return gzip.decompress((FIXTURES / "microstrain/mip_data.bin.gz").read_bytes())


def make(**config: Any) -> MicrostrainParser:
    return MicrostrainParser(DeviceSettings("imu/main", config))


def parse(*data: bytes, **config: Any) -> tuple[list[Record], MicrostrainParser]:
    parser = make(**config)
    return [*parser.feed(Chunk("imu/main", 7, b"".join(data))), *parser.close()], parser


def of(records: list[Record], kind: Any) -> list[Any]:
    return [record for record in records if isinstance(record, kind)]


def rows_of(records: list[Record], kind: Any) -> Any:
    found = [record.rows for record in of(records, kind)]
    return np.concatenate(found) if found else np.empty(0)


# --- the recording ---


def test_samples_are_those_of_the_makers_library() -> None:
    """Counts and sums are those of fixtures/microstrain/SOURCE.md."""
    data = recording()
    records, parser = parse(data)
    assert parser.counters.messages == {"base": 1, "sensor": 7157, "filter": 714, "system": 512}
    assert (parser.counters.bytes_framed, parser.counters.errors) == (len(data), {})
    rows = rows_of(records, ImuSamples)
    assert len(rows) == 4473
    force = rows["specific_force_b"].sum(axis=0) / STANDARD_GRAVITY
    np.testing.assert_allclose(force, [-226.327225335, -260.278321891, -4225.26918924], rtol=1e-11)
    rate = rows["angular_rate_b"].sum(axis=0)
    np.testing.assert_allclose(rate, [-15.674383901, -27.4738632246, 36.2000023603], rtol=1e-11)
    assert rows["device_time_ns"][[0, -1]].tolist() == [282_809_000_000, 318_585_000_000]
    assert set(np.diff(rows["device_time_ns"])) == {8_000_000}
    assert set(rows["pps_time_ns"]) == set(rows["gps_week"]) == {-1}


def test_attitude_of_the_filter_agrees_with_gravity() -> None:
    """Pitch is positive with the nose up, roll with the right wing down, and z points down."""
    angles = []
    at, data = 0, recording()
    while at < len(data):
        end = at + wire.measure(data, at, True)
        values = wire.read_values(data[at:end]) or {}
        angles += [values["euler"][:3]] if "euler" in values else []
        at = end
    assert len(angles) == 714
    np.testing.assert_allclose(np.sum(angles, axis=0), [50.0084992551, -38.0415027103, -1131.07742822], rtol=1e-11)
    rows = rows_of(parse(data)[0], ImuSamples)
    x, y, z = rows["specific_force_b"][:100].mean(axis=0) / STANDARD_GRAVITY
    roll, pitch, _ = np.mean(angles[:16], axis=0)
    assert z < -0.95
    assert x == pytest.approx(np.sin(pitch), abs=0.002)
    assert y == pytest.approx(-np.sin(roll), abs=0.002)


def test_the_recording_however_cut_and_damaged() -> None:
    data = recording()
    check_every_cut(make, data[:3000])
    check_random_cuts(make, data, count=40)
    check_bytewise(make, data[:8192])
    check_damage(make, data[:4096], examples=20, starts=[b"ue", b"ue\x80\xff", b"ue\x82\x00"])
    check_garbage(make, examples=20, starts=[b"ue\x80\x0e", b"ue\x82"])


# --- what the recording lacks ---


def test_the_example_of_the_sdk() -> None:
    values = wire.read_values(EXAMPLE)
    assert values is not None
    assert wire.MIP.intact(EXAMPLE)
    assert encode_data(SENSOR, values) == EXAMPLE
    assert values["reference_ns"] == (23_067_000_000,)
    assert values["accel_g"] == pytest.approx((0.0775919929, 6.10006973e-05, -0.979232967))


def test_increments_are_divided_by_the_step_of_the_reference_time() -> None:
    [row] = rows_of(parse(EXAMPLE, sample="increment", rate_hz=100)[0], ImuSamples)
    np.testing.assert_allclose(
        row["specific_force_b"], np.array([0.46531388, -0.05636107, -5.4959664]) * 9.80665 / 5.608
    )
    np.testing.assert_allclose(
        row["angular_rate_b"], np.array([-0.01692796, -0.01481749, -0.02403391]) / 5.608, rtol=1e-6
    )
    bare = encode_data(SENSOR, {"delta_theta": (0.01, 0, 0), "delta_velocity_gs": (0, 0, -0.01)})
    [row] = rows_of(parse(bare, sample="increment", rate_hz=100)[0], ImuSamples)
    assert row["angular_rate_b"][0] == pytest.approx(1.0)
    assert row["specific_force_b"][2] == pytest.approx(-9.80665)
    records, parser = parse(bare, sample="increment")
    assert (records, parser.counters.errors) == ([], {"bad_value": 1})  # no step and no rate


def sample(tow_s: float, flags: int = 3, **more: tuple[Any, ...]) -> bytes:
    times = {"reference_ns": (round(tow_s * 1e9) - 300_000 * 10**9,), "gps_time": (tow_s, WEEK, flags)}
    return encode_data(SENSOR, {**times, "accel_g": (0, 0, -1), "gyro": (0.1, 0, 0), **more})


def test_samples_have_gps_time_where_it_is_valid_and_the_latched_counter_with_pps() -> None:
    data = sample(TOW_S, temperature=(20, 22, 21.5), overrange=(0x44,)), sample(TOW_S + 1, 1)
    records, _ = parse(*data)
    rows = rows_of(records, ImuSamples)
    assert rows["gps_week"].tolist() == [WEEK, -1]
    assert rows["device_time_ns"].tolist() == [303_000_250_000_000, 3_001_250_000_000]
    assert (rows["temperature_c"][0], rows["status"][0]) == (21.5, 0x44)
    times = of(records, TimeMessage)
    assert [(one.time.time_ns, one.time.week, one.valid) for one in times] == [
        (303_000_000_000_000, WEEK, True),
        (303_001_000_000_000, WEEK, False),
    ]
    latched = rows_of(parse(*data, pps="main")[0], ImuSamples)
    assert latched["pps_time_ns"].tolist() == [3_000_000_000_000, -1]
    assert set(latched["gps_week"]) == {-1}
    assert make_time_parser(DeviceSettings("imu/main")).feed(Chunk("imu/main", 7, data[0])) == times[:1]


def test_the_older_gps_time_of_the_sensor_needs_both_of_its_flags() -> None:
    def at(flags: int) -> bytes:
        return encode_data(SENSOR, {"sensor_time": (TOW_S, WEEK, flags), "accel_g": (0, 0, 1), "gyro": (0, 0, 0)})

    rows = rows_of(parse(at(0x1F), at(0x0F), at(0x17))[0], ImuSamples)
    assert rows["gps_week"].tolist() == [WEEK, -1, -1]


def test_a_packet_of_an_event_is_a_mark_and_no_sample() -> None:
    records, _ = parse(sample(TOW_S, event_source=(0,)), sample(TOW_S + 0.1, event_source=(2,)))
    assert len(rows_of(records, ImuSamples)) == 1
    [mark] = of(records, EventMark)
    assert (mark.channel, mark.time.time_ns, mark.rising, mark.valid) == ("trigger2", 303_000_350_000_000, None, True)


def solution(**changed: tuple[Any, ...]) -> bytes:
    values: dict[str, tuple[Any, ...]] = {
        "gps_time": (TOW_S, WEEK, 3),
        "position": (47.5, 8.75, 500.0, 1),
        "velocity": (50.0, 1.0, -2.0, 1),
        "euler": (0.01, 0.02, -1.5, 1),
        "position_sigma": (0.1, 0.2, 0.3, 1),
        "velocity_sigma": (0.01, 0.02, 0.03, 0),
        "euler_sigma": (0.001, 0.002, 0.003, 1),
        "status": (4, 1, 0x20),
    }
    return encode_data(FILTER, {**values, **changed})


def test_solutions_of_the_filter() -> None:
    records, parser = parse(
        solution(), solution(position=(0, 0, 0, 0)), solution(gps_time=(TOW_S, WEEK, 1)), solution(status=(2, 1, 0))
    )
    rows = rows_of(records, InsSolution)
    assert len(rows) == 2
    row = rows[0]
    assert row["gps_ns"] == WEEK * 604_800 * 10**9 + 303_000_250_000_000
    assert (degrees(row["lat_rad"]), degrees(row["lon_rad"]), row["height_m"]) == pytest.approx((47.5, 8.75, 500.0))
    assert row["velocity_l"].tolist() == [50, 1, -2]
    assert (row["roll_rad"], row["pitch_rad"], row["heading_rad"]) == pytest.approx((0.01, 0.02, -1.5))
    np.testing.assert_allclose(row["position_sigma_l"], [0.1, 0.2, 0.3], rtol=1e-6)
    assert np.isnan(row["velocity_sigma_l"]).all()
    np.testing.assert_allclose(row["attitude_sigma_rad"], [0.001, 0.002, 0.003], rtol=1e-6)
    assert row["status"] == 4 | 0x20 << 16
    assert parser.counters.errors == {"ins_no_solution": 1, "time_unknown": 1}
    assert [status.values["filter_state"] for status in of(records, DeviceStatus)] == [4, 2]


def fix_packet(descriptor_set: int = GNSS, **changed: tuple[Any, ...]) -> bytes:
    values: dict[str, tuple[Any, ...]] = {
        "epoch": (303_000.0, WEEK, 3),
        "position": (47.5, 8.75, 550.0, 502.0, 1.0, 2.0, 0x1F),
        "velocity": (50.0, 1.0, -2.0, 50.1, 50.0, 1.0, 0.1, 0.5, 0x3F),
        "fix": (0, 12, 0, 7),
        "leap_seconds": (18, 2),
    }
    return encode_data(descriptor_set, {**values, **changed})


def test_positions_of_receivers() -> None:
    records, _ = parse(
        *(fix_packet(), fix_packet()),
        fix_packet(0x92, fix=(6, 20, 0, 7)),
        fix_packet(0x91, fix=(0, 9, 1, 7), position=(47.5, 8.75, 550.0, 502.0, 1.0, 2.0, 0x09)),
        fix_packet(0x91, fix=(3, 2, 0, 7), epoch=(303_000.2, WEEK, 3)),
        fix_packet(0x93),  # a third receiver, for which there is no lever arm
    )
    first, second, third, none = of(records, GnssFix)
    assert (first.fix_type, first.satellites, first.antenna, first.valid) == (FixType.SINGLE, 12, "primary", True)
    assert (first.lat_rad, first.height_m, first.undulation_m) == (radians(47.5), 550.0, 48.0)
    assert first.velocity_l == (50.0, 1.0, -2.0)
    np.testing.assert_allclose(np.diag(first.position_cov_l), [0.5, 0.5, 4.0])
    np.testing.assert_allclose(np.diag(first.velocity_cov_l), [0.01] * 3, rtol=1e-6)
    assert (second.antenna, second.fix_type) == ("secondary", FixType.RTK_FIXED)
    assert (third.antenna, third.fix_type, third.height_m, third.undulation_m) == (
        "primary",
        FixType.DIFFERENTIAL,
        None,
        None,
    )
    assert np.isnan(third.position_cov_l[2, 2])
    assert (none.valid, none.lat_rad, none.fix_type) == (False, None, FixType.NONE)
    [time] = of(records, TimeMessage)
    assert (time.time.time_ns, time.time.leap_seconds) == (303_000_000_000_000, 18)


def test_synchronisation_is_a_status_when_it_changes() -> None:
    def sync(locked: int) -> bytes:
        return encode_data(SYSTEM, {"time_sync": (locked, 1)})

    records, _ = parse(sync(0), sync(0), sync(1))
    assert [status.values for status in of(records, DeviceStatus)] == [
        {"pps_synchronised": False},
        {"pps_synchronised": True},
    ]


def test_what_is_missing_or_wrong_is_counted() -> None:
    half = encode_data(SENSOR, {"gyro": (0, 0, 0)})
    increments = encode_data(SENSOR, {"delta_theta": (0, 0, 0), "delta_velocity_gs": (0, 0, 0)})
    endless = encode_data(SENSOR, {"accel_g": (nan, 0, 0), "gyro": (0, 0, 0)})
    short = wire.encode_packet(SENSOR, (0x04, bytes(8)))
    outside = wire.encode_packet(SENSOR, (0x04, bytes(12)))[:-2] + b""
    outside = outside[:3] + bytes([outside[3] + 1]) + outside[4:] + b"\x09"
    broken = outside + bytes(ubx_fletcher(outside))
    back = sample(TOW_S, 0), sample(TOW_S - 10, 0)
    _, parser = parse(half, increments, endless, short, broken, *back, fix_packet(epoch=(303_000.0, 1000, 3)))
    assert parser.counters.errors == {
        **{"sample_incomplete": 1, "increments_only": 1, "bad_value": 1, "bad_length": 2, "restart": 1},
        **{"date_before_floor": 1, "time_unknown": 1},
    }
    _, parser = parse(sample(TOW_S), encode_data(SENSOR, {"delta_theta": (0, 0, 0)}), sample="increment", rate_hz=100)
    assert parser.counters.errors == {"rates_only": 1, "sample_incomplete": 1}


# --- set-up ---


def test_startup_asks_for_what_the_driver_reads_and_finds_the_answer() -> None:
    settings = DeviceSettings("imu/main", {"rate_hz": 500.0})
    messages = startup_messages(settings, StartupOptions(save=True, baud=921600))
    assert messages[1].lines == ("message format, set 80, every 2: D5 D6 D3 04 05 14 18",)
    assert (messages[0].baud, messages[-1].last) == (921600, True)
    # the form of the SDK's example of this command: 3DM, function 1, set, fields with decimations
    example = bytes.fromhex("75650C0E0E0F018003D5000A04000A05000A91CE")
    assert wire.encode_packet(0x0C, (0x0F, example[6:-2])) == example
    assert wire.MIP.intact(messages[1].data)
    increments = startup_messages(DeviceSettings("imu/main", {"sample": "increment"}), StartupOptions())
    assert increments[0].lines == ("message format, set 80, every 5: D5 D6 D3 07 08 14 18",)
    receiver = receiver_startup_messages(DeviceSettings("gnss/rover"), StartupOptions(save=True))
    assert receiver[0].lines == ("message format, set 91, every 1: 09 03 05 0B 11",)
    assert receiver[-1].data == messages[-1].data
    assert all("set 91" not in message.lines[0] for message in messages)
    data = recording()[:5000]
    for error, wanted in ((0, Answer(True)), (3, Answer(False, "invalid parameter"))):
        other = wire.encode_packet(0x0C, (0xF1, bytes([0x11, 0]))) + wire.encode_packet(0x01, (0xF1, bytes([0x0F, 0])))
        stream = data + other + wire.encode_packet(0x0C, (0xF1, bytes([0x0F, error]))) + data
        for size in (1, 7, 4096):
            listener = messages[1].listen()
            heard = (listener.hear(stream[at : at + size]) for at in range(0, len(stream), size))
            assert next((one for one in heard if one is not None), None) == wanted
    silent = messages[1].listen()
    assert silent.hear(data) is silent.close() is None


def test_a_rate_that_does_not_divide_1000_is_refused() -> None:
    with pytest.raises(DriverSettingsError, match="rate_hz: got 300, want a rate that divides 1000"):
        startup_messages(DeviceSettings("imu/main", {"rate_hz": 300.0}), StartupOptions())


def test_the_driver_is_registered() -> None:
    assert find_driver("imu", "microstrain").make_time_parser is make_time_parser
