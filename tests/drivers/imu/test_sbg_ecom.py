"""Tests SBG sbgECom by frames written by hand from the maker's document and by the encoder: no recording exists."""

from __future__ import annotations

import gzip
import struct
from functools import partial
from math import degrees, nan, radians
from typing import Any

import numpy as np
import pytest

from swath.drivers.driver import find_driver
from swath.drivers.framing.framer import OVER_BOUND
from swath.drivers.imu.sbg_ecom import wire
from swath.drivers.imu.sbg_ecom.parser import SbgEcomParser, make_time_parser
from swath.drivers.imu.sbg_ecom.wire import encode_frame, encode_log
from swath.drivers.parser import DeviceSettings, DriverSettingsError
from swath.georef.records import (
    Chunk,
    DeviceStatus,
    EventMark,
    FixType,
    GnssFix,
    GnssHeading,
    ImuSamples,
    InsSolution,
    Record,
    TimeMessage,
)
from tests.drivers.harness import check_damage, check_garbage, check_stream
from tests.drivers.recordings import FIXTURES

WEEK, LEAP_S = 2443, 18
TOW_S = 303_000
DATE = (2026, 11, 4, 12, 9, 42)  # UTC of that second: 303 000 s − 18 s after Sunday 2026-11-01
FULLY_VALID = 3 << 1 | 2 << 6
OK = 0x03FF
NAVIGATING = 4 | 0xF0
WRAP = 1 << 32


def utc(stamp_us: int, second: int = 0, nanosecond: int = 0, status: int = FULLY_VALID) -> bytes:
    year, month, day, hour, minute, first = DATE
    tow_ms = (TOW_S + second) * 1000 + nanosecond // 1_000_000
    fields = (year, month, day, hour, minute, first + second, nanosecond, tow_ms)
    return encode_log(wire.UTC_TIME, stamp_us % WRAP, status, *fields, more=bytes(12))


def imu(stamp_us: int, status: int = OK, force: float = -9.75, rate: float = 0.125) -> bytes:
    scale = 12_304_174 if status & 0x400 else 67_108_864
    counts = (0, 1_048_576, round(force * 1_048_576), round(rate * scale), 0, -scale)
    return encode_log(wire.IMU_SHORT, stamp_us % WRAP, status, *counts, 21 * 256 + 128)


def nav(stamp_us: int, status: int = NAVIGATING) -> bytes:
    numbers = (50.0, 1.0, -2.0, 0.01, 0.02, 0.03, 47.5, 8.75, 500.0, 48.0, 0.1, 0.2, 0.3)
    return encode_log(wire.EKF_NAV, stamp_us, *numbers, status)


def euler(stamp_us: int) -> bytes:
    return encode_log(
        wire.EKF_EULER, stamp_us, 0.01, 0.02, -1.5, 0.001, 0.002, 0.003, NAVIGATING, more=struct.pack("<2f", 0, 0)
    )


def position(tow_ms: int = TOW_S * 1000, kind: int = 7, log: int = 14, state: int = 0) -> bytes:
    numbers = (47.5, 8.75, 500.0, 48.0, 0.5, 0.25, 1.0)
    return encode_log(
        log, 5, state | kind << 6 | 1 << 12, tow_ms, *numbers, more=struct.pack("<B2HBI", 12, 0, 0, 20, 0)
    )


def velocity(tow_ms: int = TOW_S * 1000, log: int = 13, kind: int = 2) -> bytes:
    return encode_log(log, 5, kind << 6, tow_ms, 50, 1, -2, 0.1, 0.2, 0.3, more=struct.pack("<2f", 1, 0.1))


def heading(state: int = 0x40) -> bytes:
    return encode_log(15, 5, state, TOW_S * 1000, 350.0, 0.5, -2.0, 0.7, more=struct.pack("<fBB", 1.25, 20, 18))


def flight() -> bytes:
    """Return two seconds of a unit's logs, the content of the fixture, from which the fuzzer makes other inputs."""
    pieces = [encode_log(wire.STATUS, 0, 3, 0, 0xFFFF, 0x0F, more=bytes(11)), b"$PSBGI,0*00\r\n"]
    for cycle in range(100):
        stamp_us = 4_294_000_000 + 20_000 * cycle  # wraps
        second, ns = divmod(20_000_000 * cycle, 1_000_000_000)
        pieces += [imu(stamp_us, rate=0.01 * cycle), utc(stamp_us, second, ns)]
        pieces += [nav(stamp_us % WRAP), euler(stamp_us % WRAP)]
        if cycle % 10 == 0:
            tow_ms = TOW_S * 1000 + 20 * cycle
            pieces += [velocity(tow_ms), position(tow_ms), velocity(tow_ms, 16), position(tow_ms, 2, 17), heading()]
        if cycle % 50 == 3:
            pieces.append(encode_log(24, (stamp_us - 57_000) % WRAP, 0b11, 1500, 0, 0, 0))
            pieces.append(encode_log(25, (stamp_us - 9_000) % WRAP, 0, 0, 0, 0, 0))
    pieces.append(encode_frame(48, b"{}", 0x90))
    return b"".join([*pieces, encode_log(wire.IMU_DATA, 1, OK, *[0.5] * 13), encode_frame(4, bytes(30))])


def make(**config: Any) -> SbgEcomParser:
    return SbgEcomParser(DeviceSettings("imu/main", config))


def parse(*data: bytes, **config: Any) -> tuple[list[Record], SbgEcomParser]:
    parser = make(**config)
    return [*parser.feed(Chunk("imu/main", 7, b"".join(data))), *parser.close()], parser


def of(records: list[Record], kind: Any) -> list[Any]:
    return [record for record in records if isinstance(record, kind)]


def rows_of(records: list[Record], kind: Any) -> Any:
    found = [record.rows for record in of(records, kind)]
    return np.concatenate(found) if found else np.empty(0)


# --- frames ---


def test_a_frame_written_by_hand() -> None:
    """IMU_SHORT follows binaryMessages.md byte by byte, and its CRC comes from the loop in binaryProtocol.md."""
    body = bytes.fromhex("2C 00 2000 40420F00 FF03 00000000 00001000 000064FF 00008000 00000000 000000FC 8015")
    crc = 0
    for byte in body:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0x8408 if crc & 1 else 0)
    frame = b"\xff\x5a" + body + bytes([crc & 0xFF, crc >> 8, 0x33])
    assert frame == imu(1_000_000)
    assert wire.intact(frame)
    [row] = rows_of(parse(frame)[0], ImuSamples)
    assert row["specific_force_b"].tolist() == [0.0, 1.0, -9.75]
    assert row["angular_rate_b"].tolist() == [0.125, 0.0, -1.0]
    assert (row["temperature_c"], row["status"], row["device_time_ns"]) == (21.5, OK, 1_000_000_000)


def test_logs_have_the_sizes_of_the_makers_document() -> None:
    """A layout ends before the fields that later firmware added."""
    sizes = {number: layout.size for number, layout in wire.LAYOUTS.items()}
    assert {number: sizes[number] for number in (3, 44, 7, 8)} == {3: 58, 44: 32, 7: 36, 8: 72}
    assert sizes[2] == 21
    assert sizes[6] == 32
    assert (sizes[14], sizes[13], sizes[15], sizes[24]) == (52, 36, 26, 14)


def test_the_made_stream_however_cut_and_damaged() -> None:
    data = gzip.decompress((FIXTURES / "sbg-ecom/made.bin.gz").read_bytes())
    assert data == flight()
    check_damage(make, data, examples=15, starts=[b"\xff\x5a", b"\xff\x5a\x2c\x00\x20\x00", b"\xff\x5a\x30\x90"])
    check_garbage(make, examples=15, starts=[b"\xff\x5a\x2c\x00\x20\x00"])
    _, parser = parse(data)
    assert parser.counters.errors == {}
    assert parser.counters.bytes_skipped == len(b"$PSBGI,0*00\r\n")
    assert parser.counters.messages["IMU_SHORT"] == parser.counters.messages["EKF_NAV"] == 100
    assert parser.counters.messages["large-48"] == parser.counters.messages["MAG"] == 1


@pytest.mark.slow
def test_the_made_stream_cut_everywhere() -> None:
    for config in ({}, {"pps": "main", "pps_event": "A"}):
        check_stream(partial(make, **config), flight()[:6000])


def test_a_length_over_the_bound_and_a_wrong_end_are_no_frame() -> None:
    assert wire.measure(b"\xff\x5a\x2c\x00\xf7\x0f", 0, False) == OVER_BOUND
    assert not wire.intact(imu(1)[:-1] + b"\x34")


# --- time ---


def test_samples_have_gps_time_by_the_latest_utc_log() -> None:
    records, _ = parse(imu(900), utc(1000), imu(11_000, 0x47FF), utc(12_000, status=1 << 1 | 2 << 6), imu(13_000))
    rows = rows_of(records, ImuSamples)
    assert rows["gps_week"].tolist() == [-1, WEEK, -1]
    assert rows["device_time_ns"].tolist() == [900_000, TOW_S * 10**9 + 10_000_000, 13_000_000]
    assert rows["angular_rate_b"][1, 0] == pytest.approx(0.125, abs=1e-7)  # by the scale of high rates
    [time] = of(records, TimeMessage)
    assert (time.time.time_ns, time.time.week, time.time.leap_seconds, time.valid) == (
        TOW_S * 10**9,
        WEEK,
        LEAP_S,
        True,
    )


def test_leap_seconds_are_given_only_where_the_unit_knows_them() -> None:
    [time] = of(parse(utc(0, status=3 << 1 | 1 << 6))[0], TimeMessage)
    assert (time.time.leap_seconds, time.valid) == (None, True)
    assert parse(utc(0, status=3 << 1))[0] == []
    assert make_time_parser(DeviceSettings("imu/main")).feed(Chunk("imu/main", 0, utc(0, status=6 | 64))) == [
        type(time)(0, time.time, time.names_edge, message="UTC_TIME")
    ]


def test_a_stamp_far_from_the_utc_log_has_no_gps_time() -> None:
    rows = rows_of(parse(utc(0), imu(9_000_000), imu(11_000_000), imu(-1000))[0], ImuSamples)
    assert rows["gps_week"].tolist() == [WEEK, -1, WEEK]
    assert rows["device_time_ns"][2] == TOW_S * 10**9 - 1_000_000


def test_with_pps_the_counter_continues_through_its_wrap_beside_the_latched_pulse() -> None:
    def pulse(stamp_us: int) -> bytes:
        return encode_log(24, stamp_us % WRAP, 0, 0, 0, 0, 0)

    start = WRAP - 500_000
    data = (
        imu(start - 1),
        pulse(start),
        imu(start + 100),
        imu(start + 900_000),
        pulse(start + 10**6),
        imu(start + 999_990),
    )
    parser = make(pps="main", pps_event="A")
    records: list[Record] = []
    for number, piece in enumerate(data):
        records += parser.feed(Chunk("imu/main", 10**10 + 3 * 10**8 * number, piece))
    rows = rows_of(records, ImuSamples)
    assert rows["device_time_ns"].tolist() == [(start + us) * 1000 for us in (-1, 100, 900_000, 999_990)]
    assert rows["pps_time_ns"].tolist() == [-1, start * 1000, start * 1000, (start + 10**6) * 1000]
    assert of(records, EventMark) == []


def test_with_pps_and_without_its_input_the_whole_second_of_utc_is_the_latch() -> None:
    rows = rows_of(parse(imu(10), utc(2_000_100, nanosecond=100_000), imu(2_500_000), pps="main")[0], ImuSamples)
    assert rows["pps_time_ns"].tolist() == [-1, 2_000_000_000]
    assert set(rows["gps_week"]) == {-1}


def test_a_stamp_that_goes_back_is_a_restart() -> None:
    assert parse(imu(9_000_000), imu(5))[1].counters.errors == {"restart": 1}


# --- solutions, fixes, events ---


def test_solutions_need_both_logs_of_one_stamp() -> None:
    half = radians(-30) / 2
    turned = encode_log(wire.EKF_QUAT, 30_000, np.cos(half), 0, 0, np.sin(half), 0.1, 0.2, 0.3, NAVIGATING)
    records, parser = parse(
        *(utc(0), nav(10_000), euler(10_000), euler(20_000), nav(20_000), nav(25_000)),
        *(turned, nav(30_000), euler(40_000), nav(40_000, 2)),
    )
    rows = rows_of(records, InsSolution)
    assert (rows["gps_ns"] - (WEEK * 604_800 + TOW_S) * 10**9).tolist() == [10**7, 2 * 10**7, 3 * 10**7]
    row = rows[0]
    assert (degrees(row["lat_rad"]), degrees(row["lon_rad"]), row["height_m"]) == pytest.approx((47.5, 8.75, 548.0))
    assert row["velocity_l"].tolist() == [50, 1, -2]
    assert (row["roll_rad"], row["pitch_rad"], row["heading_rad"]) == pytest.approx((0.01, 0.02, -1.5))
    np.testing.assert_allclose(row["position_sigma_l"], [0.1, 0.2, 0.3], rtol=1e-6)
    np.testing.assert_allclose(row["velocity_sigma_l"], [0.01, 0.02, 0.03], rtol=1e-6)
    np.testing.assert_allclose(row["attitude_sigma_rad"], [0.001, 0.002, 0.003], rtol=1e-6)
    assert row["status"] == NAVIGATING
    assert degrees(rows["heading_rad"][2]) == pytest.approx(-30, abs=1e-5)
    assert parser.counters.errors == {"ins_no_solution": 1}
    assert parse(nav(5), euler(5))[1].counters.errors == {"time_unknown": 1}


def test_the_quaternion_turns_the_body_to_north_east_down() -> None:
    """A quarter turn to the right about z (down) leads from north to east, and pitch is positive with the nose up."""
    for (w, x, y, z), wanted in (
        ((np.cos(0.1), np.sin(0.1), 0, 0), (0.2, 0, 0)),
        ((np.cos(0.1), 0, np.sin(0.1), 0), (0, 0.2, 0)),
        ((np.sqrt(0.5), 0, 0, np.sqrt(0.5)), (0, 0, np.pi / 2)),
    ):
        log = encode_log(wire.EKF_QUAT, 5, w, x, y, z, 0, 0, 0, NAVIGATING)
        [row] = rows_of(parse(utc(0), log, nav(5))[0], InsSolution)
        assert (row["roll_rad"], row["pitch_rad"], row["heading_rad"]) == pytest.approx(wanted, abs=1e-6)


def test_fixes_join_position_and_velocity_of_an_epoch() -> None:
    late = 604_799_800
    records, _ = parse(
        *(utc(0), velocity(), position(), velocity(log=16), position(kind=2, log=17)),
        *(velocity(late), position(late, state=1), position(late + 100, kind=0)),
    )
    first, none, other = (fix for fix in of(records, GnssFix) if fix.antenna == "primary")
    [second] = (fix for fix in of(records, GnssFix) if fix.antenna == "secondary")
    assert (first.fix_type, first.satellites, first.antenna) == (FixType.RTK_FIXED, 12, "primary")
    assert (first.valid, first.time.week, first.time.time_ns) == (True, WEEK, TOW_S * 10**9)
    assert (first.height_m, first.undulation_m, first.velocity_l) == (548.0, 48.0, (50, 1, -2))
    np.testing.assert_allclose(np.diag(first.position_cov_l), [0.25, 0.0625, 1.0])
    np.testing.assert_allclose(np.diag(first.velocity_cov_l), [0.01, 0.04, 0.09], rtol=1e-6)
    assert (second.antenna, second.fix_type) == ("secondary", FixType.SINGLE)
    assert (none.valid, none.lat_rad, other.lat_rad) == (False, None, None)
    assert none.time.week == WEEK
    records, parser = parse(position())
    assert (records, parser.counters.errors) == ([], {"time_unknown": 1})


def test_an_epoch_of_the_week_before_has_that_week() -> None:
    date = (2026, 11, 8, 0, 0, 0)  # 18 s into week 2444
    log = encode_log(wire.UTC_TIME, 0, FULLY_VALID, *date, 0, 18_000)
    [fix] = of(parse(log, position(604_799_800), velocity(604_799_800))[0], GnssFix)
    assert fix.time.week == WEEK


def test_headings_of_two_antennas() -> None:
    records, _ = parse(heading(), utc(0), heading(), heading(0), heading(1))
    first, second, third = of(records, GnssHeading)
    assert (first.time, first.valid) == (None, False)
    assert (degrees(second.heading_rad), degrees(second.pitch_rad)) == pytest.approx((350, -2))
    assert (degrees(second.heading_sigma_rad), degrees(second.pitch_sigma_rad)) == pytest.approx((0.5, 0.7))
    assert (second.baseline_m, second.valid, third.baseline_m) == (1.25, True, None)


def test_events_of_one_log_are_marks() -> None:
    log = encode_log(26, 1000, 0b1011, 500, 0, 800, 0)
    records, parser = parse(log, utc(0), log, pps_event="A")
    marks = of(records, EventMark)
    assert [(mark.channel, mark.time.time_ns - TOW_S * 10**9) for mark in marks] == [
        ("SyncC", 1_000_000),
        ("SyncC", 1_500_000),
        ("SyncC", 1_800_000),
    ]
    assert parser.counters.errors == {"time_unknown": 3}


def test_state_is_given_when_it_changes() -> None:
    def status(aiding: int) -> bytes:
        return encode_log(wire.STATUS, aiding, 0x7F, 0, 1, aiding, more=bytes(11))

    found = of(parse(status(0), status(0), status(3))[0], DeviceStatus)
    assert [state.values["aiding_status"] for state in found] == [0, 3]


# --- what is wrong ---


def test_imu_data_are_taken_only_until_the_first_short_log() -> None:
    numbers = [1.0] * 6 + [25.0] + [2.0, 3.0, 4.0, 0.1, 0.2, 0.3]
    old = encode_log(wire.IMU_DATA, 5, OK, *numbers)
    rows = rows_of(parse(old, imu(6), old)[0], ImuSamples)
    assert len(rows) == 2
    assert rows["specific_force_b"][0].tolist() == [2, 3, 4]
    np.testing.assert_allclose(rows["angular_rate_b"][0], [0.1, 0.2, 0.3], rtol=1e-6)
    assert rows["temperature_c"][0] == 25.0


def test_wrong_logs_are_counted() -> None:
    date = list(DATE)
    date[1] = 13
    _, parser = parse(
        *(encode_log(wire.IMU_DATA, 5, OK, *[nan] * 13), imu(1, OK & ~1), encode_frame(44, bytes(31))),
        *(encode_log(wire.UTC_TIME, 0, FULLY_VALID, *date, 0, TOW_S * 1000), position(604_800_000)),
        encode_log(wire.UTC_TIME, 0, FULLY_VALID, *DATE, 0, TOW_S * 1000 + 500),  # the two times contradict each other
    )
    assert parser.counters.errors == {"imu_error": 1, "bad_length": 1, "bad_value": 4}


def test_increments_are_refused() -> None:
    with pytest.raises(DriverSettingsError, match="sample: sbg-ecom has no increments"):
        make(sample="increment")


def test_the_driver_is_registered() -> None:
    assert find_driver("imu", "sbg-ecom").make_time_parser is make_time_parser
