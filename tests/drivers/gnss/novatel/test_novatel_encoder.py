"""Tests NovAtel logs written by the encoder: messages without a recording, and broken or odd input."""

from __future__ import annotations

import math
import struct
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from swath.drivers.driver import find_driver
from swath.drivers.gnss.novatel import layouts as nov
from swath.drivers.gnss.novatel.encoder import encode_frame, encode_log
from swath.drivers.gnss.novatel.parser import NovatelParser, make_time_parser
from swath.drivers.gnss.novatel.tables import IMU_SCALES, TIME_STATUS_FINE
from swath.drivers.parser import DeviceSettings, DriverSettingsError
from swath.georef.records import (
    Chunk,
    EventMark,
    FixType,
    GnssFix,
    GnssHeading,
    ImuSamples,
    InsSolution,
    NamesEdge,
    Record,
    TimeMessage,
    TimeScale,
    TimeTag,
)
from tests.drivers.harness import packed_rows
from tests.drivers.novatel_ascii import WEEK_NS, recording

TIME_STATUS_UNKNOWN = 20
TIME_STATUS_SATTIME = 200  # time of satellite data, not of the receiver
HOST_NS = 1_700_000_000_000_000_000
WEEK, MS = 2400, 345_600_000
BEST_POS = nov.BestPos(
    0, 50, 47.5, 9.25, 400.0, 48.5, 61, 0.01, 0.02, 0.03, b"0001", 1.0, 0.0, 30, 24, 24, 20, 0, 0, 0, 0
)
BEST_VEL = nov.BestVel(0, 8, 0.15, 0.0, 60.0, 90.0, -2.0, 0.0)
TIME = nov.Time(0, 2.5e-9, 1e-9, -18.0, 2026, 1, 6, 23, 59, 42_000, 1)
INS_PVA = nov.InsPva(WEEK, 345_600.005, 47.5, 9.25, 448.5, 10.0, 20.0, 3.0, 1.0, 2.0, 90.0, 3)
INS_PVAX = nov.InsPvax(3, 56, 47.5, 9.25, 400.0, 48.5, 10.0, 20.0, 3.0, 1.0, 2.0, 90.0, *(0.5,) * 9, 0, 0)
RAW_IMU = nov.RawImu(WEEK, 345_600.005, 7, 1000, -200, 30, 400, -50, 6)
HEADING = nov.Heading2(0, 50, 2.0, 359.5, -1.5, 0.0, 0.25, 0.5, b"ROVR", b"MSTR", 20, 20, 20, 20, 0, 0, 0, 0)
ONE_STATION = nov.Heading(*HEADING[:8], b"MSTR", *HEADING[10:])
MARK = nov.MarkTime(WEEK, 604_799.9999999, -2e-7, 1e-8, -18.0, 0)


def parse(data: bytes, **config: Any) -> tuple[list[Record], NovatelParser]:
    """Parse a stream; return records and parser."""
    parser = NovatelParser(DeviceSettings("gnss/rover", config))
    return [*parser.feed(Chunk("gnss/rover", HOST_NS, data)), *parser.close()], parser


def one(data: bytes, kind: type[Any], **config: Any) -> Any:
    """Return the only record of a type."""
    (record,) = [record for record in parse(data, **config)[0] if isinstance(record, kind)]
    return record


def test_real_logs_are_encoded_byte_for_byte() -> None:
    data = recording("time.gps")[:76]
    time = nov.Time._make(nov.LAYOUTS[101].wire.unpack(data[28:72]))
    ours = encode_log("TIME", time, 2070, 241_084_000)
    assert ours[28:-4] == data[28:-4]
    assert one(ours, TimeMessage) == one(data, TimeMessage)
    short = next(frame for frame in recording("ins1.gps").split(b"\xaaD\x13") if frame[1:3] == b"\xfc\x01")[
        : 12 - 3 + 92
    ]
    pva = nov.InsPva._make(nov.LAYOUTS[508].wire.unpack(short[9:-4]))
    week, milliseconds = struct.unpack_from("<HI", short, 3)
    assert encode_log("INSPVAS", pva, week, milliseconds) == b"\xaaD\x13" + short


@pytest.mark.parametrize(
    ("status", "valid"), [(180, True), (160, True), (170, True), (130, False), (100, False), (60, False), (20, False)]
)
def test_time_is_valid_only_while_the_clock_is_steered(status: int, valid: bool) -> None:
    time = one(encode_log("TIME", TIME, WEEK, MS, time_status=status), TimeMessage)
    assert time.valid is valid
    assert time.bound


@pytest.mark.parametrize(("utc_status", "leap"), [(0, None), (1, 18), (2, None)])
def test_leap_seconds_are_taken_only_when_valid(utc_status: int, leap: int | None) -> None:
    time = one(encode_log("TIME", TIME._replace(utc_status=utc_status), WEEK, MS), TimeMessage)
    assert time.time == TimeTag(TimeScale.GPS, MS * 1_000_000, week=WEEK, leap_seconds=leap)
    assert time.names_edge is NamesEdge.PREVIOUS


def test_an_unset_clock_model_makes_the_time_invalid() -> None:
    time = one(encode_log("TIME", TIME._replace(clock_status=3, clock_offset_s=0.5), WEEK, MS), TimeMessage)
    assert not time.valid
    assert time.quantisation_ns == 0.0


def test_a_log_without_a_week_gives_no_time() -> None:
    records, _ = parse(encode_log("TIME", TIME, 0, 5000, time_status=TIME_STATUS_UNKNOWN))
    assert records == []


@pytest.mark.parametrize("status", [TIME_STATUS_UNKNOWN, TIME_STATUS_SATTIME])
def test_a_position_without_valid_time_names_no_second(status: int) -> None:
    records, _ = parse(encode_log("BESTPOS", BEST_POS, WEEK, MS, time_status=status))
    assert [type(record) for record in records] == [GnssFix]
    assert not one(encode_log("BESTPOS", BEST_POS, WEEK, MS, time_status=status), GnssFix).valid


def early_logs() -> dict[str, bytes]:
    """Return the dated logs of a receiver that is one roll-over of ten bits behind."""
    week = WEEK - 1024
    bodies: dict[str, nov.Body] = {
        "TIME": TIME,
        "BESTPOS": BEST_POS,
        "BESTVEL": BEST_VEL,
        "HEADING2": HEADING,
        "HEADING": ONE_STATION,
        "DUALANTENNAHEADING": ONE_STATION,
        "MARK1TIME": MARK._replace(week=week),
        "INSPVA": INS_PVA._replace(week=week),
        "INSPVAS": INS_PVA._replace(week=week),
        "INSPVAX": INS_PVAX,
        "INSATT": nov.InsAtt(week, 345_600.005, 1.0, 2.0, 90.0, 3),
    }
    return {name: encode_log(name, body, week, MS, time_status=TIME_STATUS_FINE) for name, body in bodies.items()}


@pytest.mark.parametrize("name", early_logs())
def test_a_week_one_rollover_behind_is_invalid(name: str) -> None:
    records, parser = parse(early_logs()[name])
    for record in records:
        assert isinstance(record, GnssFix | GnssHeading | EventMark)
        assert record.time is not None
        assert (record.valid, record.time.week) == (False, None)
    assert parser.counters.errors == {"date_before_floor": 1}
    records, parser = parse(early_logs()[name], date_floor="1999-08-22")
    assert records
    others: list[Any] = [record for record in records if not isinstance(record, InsSolution)]
    assert all(record.valid for record in others)
    assert not +parser.counters.errors


def test_the_recorder_takes_no_time_from_a_week_before_the_floor() -> None:
    for config, expected in (({}, set()), ({"date_floor": "1999-08-22"}, {True})):
        parser = make_time_parser(DeviceSettings("gnss/rover", config))
        records = parser.feed(Chunk("gnss/rover", HOST_NS, b"".join(early_logs().values())))
        assert {message.valid for message in records if isinstance(message, TimeMessage)} == expected


def test_a_raw_imu_week_before_the_date_floor_is_dropped() -> None:
    data = encode_log("RAWIMU", RAW_IMU._replace(week=WEEK - 1024), WEEK - 1024, MS)
    assert one(data, ImuSamples, imu_type="HG1900_CA50").rows["gps_week"] == [-1]


def test_an_invalid_date_floor_is_refused() -> None:
    with pytest.raises(DriverSettingsError, match="date_floor"):
        parse(b"", date_floor="soon")


def test_position_and_velocity_are_decoded() -> None:
    fix = one(encode_log("PPPPOS", BEST_POS, WEEK, MS + 5, time_status=TIME_STATUS_FINE), GnssFix)
    assert (fix.height_m, fix.fix_type, fix.satellites, fix.message) == (448.5, FixType.RTK_FIXED, 24, "PPPPOS")
    velocity = one(encode_log("BESTVEL", BEST_VEL, WEEK, 100), GnssFix)
    np.testing.assert_allclose(velocity.velocity_l, [0.0, 60.0, 2.0], atol=1e-12)
    assert velocity.time.week == WEEK - 1, "the latency reaches back over the week's end"
    assert velocity.time.time_ns == pytest.approx(WEEK_NS - 50_000_000, abs=10)


def test_antenna_is_named_primary_or_secondary() -> None:
    body = nov.LAYOUTS[42].wire.pack(*BEST_POS)
    assert one(encode_frame(42, body, WEEK, MS, message_type=1), GnssFix).antenna == "secondary"
    assert one(encode_frame(42, body, WEEK, MS, message_type=2), GnssFix).antenna == "primary"


def test_a_longer_header_and_a_longer_body_are_read() -> None:
    body = nov.LAYOUTS[42].wire.pack(*BEST_POS)
    expected = one(encode_frame(42, body, WEEK, MS), GnssFix)
    grown = one(encode_frame(42, body + b"newer", WEEK, MS, extra_header=b"\x01\x02\x03\x04"), GnssFix)
    assert (grown.lat_rad, grown.time) == (expected.lat_rad, expected.time)


def test_a_short_body_is_counted() -> None:
    records, parser = parse(encode_frame(42, bytes(71), WEEK, MS))
    assert records == []
    assert parser.counters.errors == {"bad_length": 1}
    assert parser.counters.bad_messages == 1


def test_command_responses_are_not_decoded_as_logs() -> None:
    body = nov.LAYOUTS[42].wire.pack(*BEST_POS)
    records, parser = parse(encode_frame(42, body, WEEK, MS, message_type=nov.RESPONSE_BIT))
    assert records == []
    assert +parser.counters.messages == {"BESTPOS-response": 1}


def test_ins_solutions_are_decoded() -> None:
    attitude = nov.InsAtt(WEEK, 345_600.02, 1.0, 2.0, 90.0, 3)
    attitude_x = nov.InsAttx(3, 56, 1.0, 2.0, 90.0, 0.25, 0.5, 0.75, 0, 0)
    logs: list[tuple[str, nov.Body]] = [
        ("INSPVAS", INS_PVA),
        ("INSPVA", INS_PVA),
        ("INSPVAX", INS_PVAX),
        ("INSATTS", attitude),
        ("INSATTX", attitude_x),
    ]
    rows = one(b"".join(encode_log(name, body, WEEK, MS + 20) for name, body in logs), InsSolution).rows
    assert rows["gps_ns"].tolist() == [
        WEEK * WEEK_NS + MS * 1_000_000 + offset for offset in (5_000_000, 5_000_000, *(20_000_000,) * 3)
    ]
    np.testing.assert_allclose(np.degrees(rows["roll_rad"]), 1.0)
    np.testing.assert_allclose(np.degrees(rows["pitch_rad"]), 2.0)
    np.testing.assert_allclose(np.degrees(rows["heading_rad"]), 90.0)
    assert rows["height_m"][:3].tolist() == [448.5] * 3, "INSPVA on the ellipsoid, INSPVAX above the geoid"
    assert rows["velocity_l"][0].tolist() == [10.0, 20.0, -3.0]
    assert np.isnan(rows["lat_rad"][3:]).all()
    np.testing.assert_allclose(np.degrees(rows["attitude_sigma_rad"][4]), [0.25, 0.5, 0.75], rtol=1e-6)


def test_a_solution_without_week_is_dropped_and_counted() -> None:
    records, parser = parse(encode_log("INSPVAS", INS_PVA._replace(week=0), 0, 0))
    assert records == []
    assert parser.counters.errors == {"time_unknown": 1}


def test_raw_counts_need_the_imu_type() -> None:
    stream = encode_log("RAWIMUS", RAW_IMU, WEEK, MS)
    records, parser = parse(stream)
    assert records == []
    assert parser.counters.errors == {"imu_scale_unknown": 1}
    rows = one(stream, ImuSamples, imu_type="LN200").rows
    np.testing.assert_allclose(rows["specific_force_b"][0], np.array([30, 200, 1000]) * 2.0**-14 * 200, rtol=1e-14)
    np.testing.assert_allclose(rows["angular_rate_b"][0], np.array([6, 50, 400]) * 2.0**-19 * 200, rtol=1e-14)
    announced = encode_frame(1945, struct.pack("<I", 8) + bytes(20), WEEK, MS)
    assert packed_rows(one(announced + stream, ImuSamples).rows) == packed_rows(rows)
    assert rows["device_time_ns"][0] == 345_600_005_000_000
    assert (rows["gps_week"][0], rows["status"][0]) == (WEEK, 7)


def test_an_unknown_imu_type_is_refused_with_a_list_of_known_ones() -> None:
    with pytest.raises(DriverSettingsError, match="imu_type: got 'HG9999', want one of: ADIS16488, EPSON_G320"):
        parse(b"", imu_type="HG9999")
    assert parse(b"", imu_type="hg1700-ag58")[0] == []
    assert all(scale.rate_hz in (100.0, 125.0, 200.0, 400.0) for scale in IMU_SCALES.values())


def test_an_imu_error_is_counted() -> None:
    _, parser = parse(encode_log("RAWIMUSX", nov.RawImux(1, 8, *RAW_IMU), WEEK, MS))
    assert parser.counters.errors == {"imu_error": 1}


def test_encrypted_counts_give_no_samples() -> None:
    """By the manual RAWIMUX, IMU info bit 1, means "the IMU data is encrypted and should not be used"."""
    records, parser = parse(encode_log("RAWIMUSX", nov.RawImux(2, 8, *RAW_IMU), WEEK, MS))
    assert records == []
    assert parser.counters.errors == {"imu_encrypted": 1}


def test_headings_and_event_marks_are_decoded() -> None:
    heading = one(encode_log("HEADING2", HEADING, WEEK, MS), GnssHeading)
    assert math.degrees(heading.heading_rad) == pytest.approx(359.5)
    assert (heading.baseline_m, heading.valid) == (2.0, True)
    for name in ("HEADING", "DUALANTENNAHEADING"):
        same = one(encode_log(name, ONE_STATION, WEEK, MS), GnssHeading)
        assert same == replace(heading, message=name)
    mark = one(encode_log("MARK2TIME", MARK, WEEK, MS), EventMark)
    assert (mark.channel, mark.rising) == ("MARK2", None), "MARKCONTROL's polarity is in no log"
    assert mark.time.week == WEEK + 1, "the receiver's clock is behind: GPS time is in the next week"
    assert mark.time.time_ns == pytest.approx(100, abs=1)
    assert mark.sigma_s == 1e-8
    assert [one(encode_log(name, MARK, WEEK, MS), EventMark).channel for name in ("MARKTIME", "MARK1TIME")] == [
        "MARK1"
    ] * 2


def test_encoder_refuses_the_body_of_another_log() -> None:
    with pytest.raises(TypeError, match="TIME takes a Time, not a BestVel"):
        encode_log("TIME", BEST_VEL, WEEK, MS)


@settings(max_examples=300, deadline=None, derandomize=True)
@given(number=st.sampled_from(sorted(nov.LAYOUTS)), data=st.data())
def test_an_intact_log_never_raises_whatever_its_content(number: int, data: st.DataObject) -> None:
    layout = nov.LAYOUTS[number]
    size = layout.wire.size
    body = data.draw(
        st.binary(min_size=size, max_size=size) | st.sampled_from([bytes(size), b"\xff" * size, b"\x7f" * size])
    )
    week, milliseconds = data.draw(st.integers(0, 0xFFFF)), data.draw(st.integers(0, 0xFFFF_FFFF))
    _, parser = parse(encode_frame(number, body, week, milliseconds, short=layout.short), imu_type="LN200")
    assert parser.counters.messages[layout.name] == 1


def test_a_time_log_with_a_year_that_no_date_holds_is_decoded() -> None:
    body = bytearray(nov.LAYOUTS[101].wire.size)
    body[28:32] = (1 << 31).to_bytes(4, "little")  # the year
    _, parser = parse(encode_frame(101, bytes(body), 1512, 0, short=False), imu_type="LN200")
    assert parser.counters.messages[nov.LAYOUTS[101].name] == 1


def test_the_imu_of_a_span_system_is_found_inside_the_gnss_stream() -> None:
    driver = find_driver("imu", "novatel")
    assert driver.transports == ("gnss",)
    stream = encode_log("BESTPOS", BEST_POS, WEEK, MS) + encode_log("RAWIMUSX", nov.RawImux(0, 8, *RAW_IMU), WEEK, MS)
    records = driver.make_parser(DeviceSettings("imu/main")).feed(Chunk("imu/main", HOST_NS, stream))
    assert [type(record) for record in records] == [ImuSamples]
    receiver = find_driver("gnss", "novatel")
    assert receiver.names_edge is NamesEdge.PREVIOUS
    assert receiver.make_time_parser is not None
