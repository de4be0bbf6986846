"""Tests GSOF reports and POS groups: packets built by hand, pages, fixes, INS rows, times, damage."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from swath.drivers.gnss.applanix import groups as pos
from swath.drivers.gnss.applanix import gsof
from swath.drivers.gnss.applanix.parser import GsofParser, PosParser
from swath.drivers.parser import DeviceSettings, DriverSettingsError, Parser
from swath.georef.records import DeviceStatus, EventMark, FixType, InsSolution, Record
from tests.drivers.builders import of_type, rows_of, times
from tests.drivers.gnss.builders import fixes
from tests.drivers.harness import (
    canonical,
    check_bytewise,
    check_damage,
    check_garbage,
    check_random_reads,
    check_stream,
    feed_pieces,
)
from tests.drivers.recordings import FIXTURES

SETTINGS = DeviceSettings("gnss/test")
WEEK, MS = 2342, 302_400_000
S = 1_000_000_000
LAT, LON = math.radians(47.0), math.radians(8.5)
TIME = gsof.PositionTime(MS, WEEK, 21, 0x1F, 0x07, 1)
PLACE = gsof.LatLonHeight(LAT, LON, 555.0)
VELOCITY = gsof.Velocity(1, 50.0, math.radians(330.0), 1.5)
SIGMA = gsof.PositionSigma(0.5, 0.012, 0.011, -4e-5, 0.023, 0.013, 0.010, 30.0, 1.0, 10)
INS = gsof.InsNavigation(
    *(WEEK, MS, 4, 4, 47.0, 8.5, 555.0, 43.3, -25.0, -1.5, 50.0),
    *(-3.25, 2.5, 331.0, 330.0, 0.5, -0.25, 1.0, 0.1, 0.2, -0.3),
)
RMS = gsof.InsRms(WEEK, MS, 4, 4, 0.011, 0.012, 0.023, 0.01, 0.02, 0.03, 0.005, 0.006, 0.02)
RECORDS = [
    gsof.POSITION_TIME.encode(TIME),
    gsof.LAT_LON_HEIGHT.encode(PLACE),
    gsof.VELOCITY.encode(VELOCITY),
    gsof.POSITION_SIGMA.encode(SIGMA),
    gsof.CURRENT_TIME.encode(gsof.CurrentTime(MS, WEEK, 18, 3)),
    gsof.POSITION_TYPE.encode(gsof.PositionType(1.0, 5, 3, 0.5)),
    gsof.BASE_POSITION.encode(gsof.BasePosition(MS, WEEK, LAT, LON, 500.0, 1)),
    gsof.INS_RMS.encode(RMS),
    gsof.INS_NAVIGATION.encode(INS),
    gsof.LAT_LON_GEOID.encode(gsof.LatLonGeoid(LAT, LON, 506.5)),
]

GPS = pos.TimeDistance(302_400.25, 55.0, -0.001, 0x01, 1)  # time 1 is GPS, time 2 POS
NAVIGATION = pos.Navigation(
    *(47.0, 8.5, 555.0, 43.3, -25.0, -1.5, -3.25, 2.5, 331.0, 12.5, 330.0, 50.0),
    *(0.5, -0.25, 1.0, 0.1, 0.2, -0.3, 0),
)
PERFORMANCE = pos.Performance(0.011, 0.012, 0.023, 0.01, 0.02, 0.03, 0.005, 0.006, 0.02, 0.013, 0.01, 30.0)
# 2 m ahead of and 1 m below the vehicle's point, mounted 1° right of it; along its own heading and across to starboard
SENSOR = pos.SensorNavigation(
    *(47.0 + math.degrees(2 * math.cos(math.radians(331)) / 6.371e6), 8.5, 554.0, 49.97, -1.74, -1.5),
    *(-3.0, 2.25, 332.0, 12.5, 0.1, 0.5, -0.25, 1.0, 0.1, 0.2, -0.3),
)
SENSOR_RMS = pos.SensorPerformance(0.013, 0.014, 0.024, 0.01, 0.03, 0.03, 0.007, 0.008, 0.03)
STATUS = pos.GnssStatus(0.6, 0.9, 0.0, 65535, WEEK, 18.0, 0.17, 48.5, 16, 0)
GROUPS = [
    pos.encode_gnss_status(GPS, 7, STATUS, bytes(40)),
    pos.PERFORMANCE.encode(GPS, PERFORMANCE),
    pos.NAVIGATION.encode(GPS, NAVIGATION),
    pos.PPS.encode(GPS._replace(time1_s=302_401.0), pos.Pps(1677, 2)),
    pos.EVENT_1.encode(GPS._replace(time1_s=302_400.125), pos.Event(7)),
    pos.EVENT_2.encode(GPS, pos.Event(8)),
    pos.GENERAL.encode(GPS, pos.General(368, 8_716_288, 4096)),
    pos.IMU.encode(GPS, pos.ImuHead(2, 34, 2, 0)),
    pos.SENSOR_PERFORMANCES[0].encode(GPS, SENSOR_RMS),
    pos.SENSORS[0].encode(GPS, SENSOR),
    pos.SENSORS[1].encode(GPS, SENSOR._replace(height_m=553.0)),
    pos.encode_frame(b"$MSG", 50, bytes(8)),
]


def parse(
    make: type[GsofParser] | type[PosParser], *data: bytes, settings: DeviceSettings = SETTINGS
) -> tuple[list[Record], Parser]:
    parser = make(settings)
    return feed_pieces(parser, data), parser


parse_gsof, parse_pos = partial(parse, GsofParser), partial(parse, PosParser)


def rot_l_from_vehicle(roll: float, pitch: float, heading: float) -> Any:
    """Return the rotation from forward, right, down to north, east, down, by SciPy's intrinsic z, y', x''."""
    return Rotation.from_euler("ZYX", [heading, pitch, roll]).as_matrix()


# --- GSOF ---


def test_a_report_laid_out_by_hand_is_read() -> None:
    """Records 1 and 2 of Trimble's OEM receiver help are big-endian, and the checksum precedes the last byte."""
    data = bytes.fromhex("01 0a 12063d80 0926 15 1f 07 01") + b"\x02\x18" + struct.pack(">3d", LAT, LON, 555.0)
    content = b"\x28\x40" + bytes([3 + len(data)]) + b"\x09\0\0" + data
    records, parser = parse_gsof(b"\x02" + content + bytes([sum(content) % 256]) + b"\x03")
    (fix,) = fixes(records)
    assert (fix.time.week, fix.time.time_ns, fix.satellites) == (WEEK, 302_398_848_000_000, 21)
    assert (fix.lat_rad, fix.lon_rad, fix.height_m, fix.valid) == (LAT, LON, 555.0, True)
    assert parser.counters.messages == {"GENOUT": 1, "GSOF1": 1, "GSOF2": 1}


@pytest.mark.parametrize("page_bytes", [244, 100, 37, 7])
def test_pages_of_a_report_are_put_together(page_bytes: int) -> None:
    whole, _ = parse_gsof(gsof.encode_report(RECORDS, 5))
    pages, parser = parse_gsof(gsof.encode_report(RECORDS, 5, page_bytes=page_bytes))
    assert canonical(pages) == canonical(whole)
    assert parser.counters.errors == {}
    assert parser.counters.messages["GSOF49"] == 1


def test_a_lost_page_loses_its_report_only() -> None:
    report = gsof.encode_report(RECORDS, 5, page_bytes=100)
    page = 100 + 3 + 6
    frames = [report[at : at + page] for at in range(0, len(report), page)]
    assert len(frames) >= 4
    good = gsof.encode_report(RECORDS, 6)
    for missing in range(len(frames)):
        kept = frames[:missing] + frames[missing + 1 :]
        records, parser = parse_gsof(*kept, good)
        assert len(fixes(records)) == 1
        assert parser.counters.errors == {"pages_incomplete": parser.counters.errors["pages_incomplete"]}
        assert parser.counters.errors["pages_incomplete"] >= 1


def test_records_of_a_report_make_one_fix() -> None:
    records, _ = parse_gsof(gsof.encode_report(RECORDS, 1))
    (fix,) = fixes(records)
    assert (fix.lat_rad, fix.lon_rad, fix.height_m, fix.undulation_m) == (LAT, LON, 555.0, 48.5)
    assert fix.velocity_l == pytest.approx((50 * math.cos(math.radians(330)), -25.0, -1.5))
    assert fix.position_cov_l is not None
    expected = [[0.011**2, -4e-5, 0], [-4e-5, 0.012**2, 0], [0, 0, 0.023**2]]
    np.testing.assert_allclose(fix.position_cov_l, expected, rtol=1e-6)
    assert (fix.fix_type, fix.valid, fix.satellites) == (FixType.RTK_FIXED, True, 21)
    first, second = times(records)
    assert (first.message, first.time.week, first.time.time_ns, first.valid) == ("GSOF1", WEEK, MS * 1_000_000, True)
    assert (second.message, second.time.leap_seconds) == ("GSOF16", 18)
    assert [status.message for status in of_type(records, DeviceStatus)] == ["GSOF38", "GSOF41"]


@pytest.mark.parametrize(
    ("flags1", "flags2", "fix_type", "valid"),
    [
        (0x0F, 0, FixType.SINGLE, True),
        (0x0F, 1, FixType.DIFFERENTIAL, True),
        (0x0F, 3, FixType.RTK_FLOAT, True),
        (0x0F, 7, FixType.RTK_FIXED, True),
        (0x00, 7, FixType.NONE, False),
    ],
)
def test_flags_give_the_fix_type(flags1: int, flags2: int, fix_type: FixType, valid: bool) -> None:
    time = gsof.POSITION_TIME.encode(TIME._replace(flags1=flags1, flags2=flags2))
    records, _ = parse_gsof(gsof.encode_report([time, *RECORDS[1:3]], 1))
    (fix,) = fixes(records)
    assert (fix.fix_type, fix.valid, fix.lat_rad is None) == (fix_type, valid, not valid)
    assert [time.valid for time in times(records)] == [valid]


def test_ins_rows_have_the_attitude_of_the_vehicle_and_sigmas() -> None:
    """Roll of −3.25° lifts the right wing, and pitch of +2.5° the nose; SciPy's rotation of the axes confirms both."""
    for records in (parse_gsof(gsof.encode_report(RECORDS, 1))[0], parse_pos(*GROUPS)[0]):
        (row,) = rows_of(records, InsSolution)
        forward, right, _ = rot_l_from_vehicle(row["roll_rad"], row["pitch_rad"], row["heading_rad"]).T
        assert math.degrees(math.atan2(forward[1], forward[0])) % 360 == pytest.approx(331.0)
        assert math.degrees(math.asin(-forward[2])) == pytest.approx(2.5)
        assert right[2] < 0.0
        assert row["velocity_l"] == pytest.approx([43.3, -25.0, -1.5], abs=1e-5)
        assert np.degrees([row["lat_rad"], row["lon_rad"]]) == pytest.approx([47.0, 8.5])
        assert row["position_sigma_l"] == pytest.approx([0.011, 0.012, 0.023])
        assert np.degrees(row["attitude_sigma_rad"]) == pytest.approx([0.005, 0.006, 0.02])
    assert row["gps_ns"] == (WEEK * 604_800 + 302_400) * S + S // 4


def test_ins_without_alignment_is_counted_and_old_sigmas_are_not_used() -> None:
    records, parser = parse_gsof(gsof.encode_report([gsof.INS_NAVIGATION.encode(INS._replace(alignment=2))], 1))
    assert (records, parser.counters.errors) == ([], {"ins_not_aligned": 1})
    records, parser = parse_pos(GROUPS[0], pos.NAVIGATION.encode(GPS, NAVIGATION._replace(alignment=2)))
    assert (of_type(records, InsSolution), parser.counters.errors) == ([], {"ins_not_aligned": 1})
    late = gsof.INS_NAVIGATION.encode(INS._replace(milliseconds=MS + 2000))
    (row,) = rows_of(
        parse_gsof(gsof.encode_report([gsof.INS_RMS.encode(RMS)], 1), gsof.encode_report([late], 2))[0], InsSolution
    )
    assert np.isnan(row["position_sigma_l"]).all()


def test_impossible_records_are_counted() -> None:
    for record, code in (
        (gsof.POSITION_TIME.encode(TIME._replace(milliseconds=604_800_000)), "bad_time"),
        (gsof.LAT_LON_HEIGHT.encode(PLACE._replace(lat_rad=math.nan)), "not_finite"),
        (b"\x02\x08" + bytes(8), "bad_length"),
        (b"\x02\x18" + bytes(8), "bad_length"),
    ):
        records, parser = parse_gsof(gsof.encode_report([record], 1))
        assert (records, parser.counters.bad_messages, parser.counters.errors) == ([], 1, {code: 1})
    early = gsof.POSITION_TIME.encode(TIME._replace(week=WEEK - 1024))
    records, parser = parse_gsof(gsof.encode_report([early, *RECORDS[1:2]], 1))
    assert ([fix.valid for fix in fixes(records)], times(records)) == ([False], [])
    assert parser.counters.errors == {"date_before_floor": 1}


# --- POS groups ---


def test_a_group_laid_out_by_hand_is_read() -> None:
    """In the POS LV user ICD group 7 has 36 bytes after the length: time, distance, count, status, padding, sum."""
    body = struct.pack("<4sHHdddBBIBx", b"$GRP", 7, 36, 302_401.0, 55.0, -0.001, 1, 1, 1677, 2)
    words = sum(struct.unpack(f"<{len(body) // 2}H", body)) + 0x2324
    frame = body + struct.pack("<H", -words & 0xFFFF) + b"$#"
    assert len(frame) == 44
    assert frame == GROUPS[3]
    (time,) = times(parse_pos(GROUPS[0], frame)[0])
    assert (time.time.week, time.time.time_ns, time.time.leap_seconds) == (WEEK, 302_401 * S, 18)
    assert (time.bound, time.valid, time.message) == (True, True, "GRP7")
    assert [time.valid for time in times(parse_pos(frame)[0])] == [False]  # no week yet
    unsynchronised = pos.PPS.encode(GPS, pos.Pps(1, 3))
    assert [time.valid for time in times(parse_pos(GROUPS[0], unsynchronised)[0])] == [False]


def test_lengths_are_those_of_a_recording() -> None:
    """The lengths are of frames of a POS LV in clearpathrobotics/applanix_driver's tests (basic_data_smoke.pcap)."""
    lengths = {1: 140, 2: 88, 4: 68, 7: 44}
    layouts = {1: GROUPS[2], 2: GROUPS[1], 4: GROUPS[7], 7: GROUPS[3]}
    assert {number: len(frame) for number, frame in layouts.items()} == lengths


def test_events_and_status_are_decoded_and_other_groups_counted() -> None:
    records, parser = parse_pos(*GROUPS)
    first, second = of_type(records, EventMark)
    assert (first.channel, first.count, first.time.time_ns, first.time.week) == (
        "EVENT1",
        7,
        302_400 * S + S // 8,
        WEEK,
    )
    assert (second.channel, second.valid) == ("EVENT2", True)
    assert [status.message for status in of_type(records, DeviceStatus)] == ["GRP3", "GRP10", "GRP4"]
    assert parser.counters.messages == {
        **{f"GRP{number}": 1 for number in (1, 2, 3, 4, 5, 6, 7, 10, 102, 103, 104)},
        "MSG50": 1,
    }
    assert parser.counters.errors == {"imu_scale_unknown": 1, "imu_bad_frames": 2}
    assert parser.counters.bytes_skipped == 0


def test_the_type_of_the_imu_is_a_status_and_its_increments_are_counted() -> None:
    """Bytes 34 to 63 are of a recording of a POS LV in clearpathrobotics/applanix_driver: type 34, 200 Hz."""
    recorded = bytes.fromhex("43f4ffff9dffffffbbfffffff3ffffff07000000efffffff0022020000")
    frame = pos.encode_frame(b"$GRP", 4, pos.TIME_DISTANCE.pack(*GPS) + recorded)
    other = pos.IMU.encode(GPS, pos.ImuHead(4, 34, 9, 0))
    records, parser = parse_pos(frame, frame, other)
    assert [status.values for status in of_type(records, DeviceStatus)] == [
        {"imu_type": 34, "rate_code": 2, "rate_hz": 200},
        {"imu_type": 34, "rate_code": 9},
    ]
    assert parser.counters.errors == {"imu_scale_unknown": 3, "imu_bad_frames": 3}


# --- navigation of a sensor ---


def parse_sensor(*groups: bytes, number: int = 1) -> tuple[list[Record], Parser]:
    settings = DeviceSettings("imu/test", {"solution_of": f"sensor{number}"})
    return parse(PosParser, *groups, settings=settings)


def test_a_sensors_groups_make_the_solution_where_the_configuration_asks_for_it() -> None:
    """Table 29 of the POS MV V5 ICD is packed by hand; SciPy turns its velocity from the heading to north, east."""
    numbers = struct.pack("<dddfffddddfffffff", *SENSOR)
    body = struct.pack("<4sHHdddBB", b"$GRP", 102, 128, *GPS) + numbers + b"\0\0"
    words = sum(struct.unpack(f"<{len(body) // 2}H", body)) + 0x2324
    frame = body + struct.pack("<H", -words & 0xFFFF) + b"$#"
    assert len(frame) == 136
    assert GROUPS[9] == frame
    records, parser = parse_sensor(*GROUPS)
    (row,) = rows_of(records, InsSolution)
    assert parser.counters.errors == {"imu_scale_unknown": 1, "imu_bad_frames": 2}
    assert row["gps_ns"] == (WEEK * 604_800 + 302_400) * S + S // 4
    place = (math.degrees(row["lat_rad"]), math.degrees(row["lon_rad"]), row["height_m"])
    assert place == pytest.approx(SENSOR[:3], abs=1e-12)
    level = Rotation.from_euler("Z", math.radians(332.0)).apply([49.97, -1.74, -1.5])
    assert row["velocity_l"] == pytest.approx(level, abs=1e-5)
    angles = [math.degrees(row[name]) % 360 for name in ("roll_rad", "pitch_rad", "heading_rad")]
    assert angles == pytest.approx([357.0, 2.25, 332.0])
    assert row["position_sigma_l"] == pytest.approx([0.013, 0.014, 0.024])
    assert np.degrees(row["attitude_sigma_rad"]) == pytest.approx([0.007, 0.008, 0.03])
    turned = Rotation.from_euler("Z", math.radians(332.0)).as_matrix()
    expected = np.sqrt(np.diag(turned @ np.diag(np.square([0.01, 0.03, 0.03])) @ turned.T))
    assert row["velocity_sigma_l"] == pytest.approx(expected, rel=1e-5)
    (second,) = rows_of(parse_sensor(*GROUPS, number=2)[0], InsSolution)
    assert second["height_m"] == 553.0
    assert np.isnan(second["position_sigma_l"]).all()
    (before,) = rows_of(parse_sensor(GROUPS[0], *GROUPS[8:11], GROUPS[2])[0], InsSolution)
    assert before["height_m"] == 554.0


def test_a_sensors_rows_need_the_vehicles_group_its_alignment_and_its_velocity() -> None:
    status, vehicle, sensor = GROUPS[0], GROUPS[2], GROUPS[9]
    later = GPS._replace(time1_s=302_400.5)
    course = SENSOR._replace(along_mps=50.0, across_mps=0.0)  # along the course of 330°, not the heading
    ahead = SENSOR._replace(lat_deg=47.0004)  # 44 m ahead, in a turn of 14 °/s
    turning = NAVIGATION._replace(z_rate_dps=14.0)
    for groups, code in (
        ((status, vehicle, pos.SENSORS[0].encode(later, SENSOR)), "vehicle_missing"),
        ((status, sensor, sensor, vehicle), "vehicle_missing"),
        ((status, pos.NAVIGATION.encode(GPS, NAVIGATION._replace(alignment=2)), sensor), "ins_not_aligned"),
        ((status, vehicle, pos.SENSORS[0].encode(GPS, course)), "velocity_disagrees"),
        ((status, vehicle, pos.SENSORS[0].encode(GPS, SENSOR._replace(roll_deg=math.nan))), "not_finite"),
        ((status, vehicle, pos.encode_frame(b"$GRP", 102, bytes(60))), "bad_length"),
        ((vehicle, sensor), "time_unknown"),
        ((status, pos.NAVIGATION.encode(GPS, turning), pos.SENSORS[0].encode(GPS, ahead._replace(across_mps=6.0))), ""),
    ):
        records, parser = parse_sensor(*groups)
        assert set(parser.counters.errors) == ({code} if code else set())
        rows = sum(len(found.rows) for found in of_type(records, InsSolution))
        assert rows == (code == "" or (groups[1] is sensor and groups[0] is status))
    with pytest.raises(DriverSettingsError, match="solution_of: got 'sensor3', want vehicle, sensor1 or sensor2"):
        parse_sensor(number=3)


def test_utc_and_the_weeks_end_become_gps_time() -> None:
    utc = pos.TimeDistance(302_382.25, 55.0, 0.0, 0x02, 1)
    (row,) = rows_of(parse_pos(GROUPS[0], pos.NAVIGATION.encode(utc, NAVIGATION))[0], InsSolution)
    assert row["gps_ns"] == (WEEK * 604_800 + 302_400) * S + S // 4
    end = pos.encode_gnss_status(GPS._replace(time1_s=604_799.5), 7, STATUS)
    begin = pos.NAVIGATION.encode(GPS._replace(time1_s=0.25), NAVIGATION)
    (row,) = rows_of(parse_pos(end, begin)[0], InsSolution)
    assert row["gps_ns"] == (WEEK + 1) * 604_800 * S + S // 4
    start = pos.encode_gnss_status(GPS._replace(time1_s=0.5), 7, STATUS)
    before = pos.NAVIGATION.encode(GPS._replace(time1_s=604_799.75), NAVIGATION)
    (row,) = rows_of(parse_pos(start, before)[0], InsSolution)
    assert row["gps_ns"] == WEEK * 604_800 * S - S // 4
    records, parser = parse_pos(GROUPS[0], pos.NAVIGATION.encode(GPS._replace(time_types=0), NAVIGATION))
    assert (of_type(records, InsSolution), parser.counters.errors) == ([], {"time_unknown": 1})
    records, parser = parse_pos(pos.NAVIGATION.encode(GPS, NAVIGATION))
    assert (records, parser.counters.errors) == ([], {"time_unknown": 1})


def test_impossible_groups_are_counted() -> None:
    for frame, code in (
        (pos.NAVIGATION.encode(GPS, NAVIGATION._replace(lat_deg=math.nan)), "not_finite"),
        (pos.encode_frame(b"$GRP", 1, bytes(60)), "bad_length"),
        (pos.encode_frame(b"$GRP", 3, pos.TIME_DISTANCE.pack(*GPS) + b"\x07\x02\xff\xff" + bytes(60)), "bad_length"),
    ):
        records, parser = parse_pos(frame)
        assert (records, parser.counters.bad_messages, parser.counters.errors) == ([], 1, {code: 1})


def test_a_week_that_no_receiver_can_mean_gives_no_solution() -> None:
    """Week 65535 is the year 3236, which nanoseconds since 1980 in 64 bits do not reach."""
    status = pos.encode_gnss_status(GPS, 7, STATUS._replace(week=65535))
    records, parser = parse_pos(status, pos.NAVIGATION.encode(GPS, NAVIGATION))
    assert (of_type(records, InsSolution), parser.counters.errors) == ([], {"bad_time": 1, "time_unknown": 1})
    records, parser = parse_gsof(gsof.encode_report([gsof.INS_NAVIGATION.encode(INS._replace(week=65535))], 1))
    assert (records, parser.counters.errors) == ([], {"bad_time": 1})


# --- both ---

STREAMS: dict[str, tuple[type[GsofParser] | type[PosParser], Callable[[], bytes]]] = {
    "gsof/bx992.bin": (
        GsofParser,
        lambda: b"".join(gsof.encode_report(RECORDS, at, page_bytes=200) for at in range(12)),
    ),
    "applanix/pos_lv.bin": (PosParser, lambda: b"".join(GROUPS * 8)),
}


@pytest.mark.parametrize("name", STREAMS)
def test_the_fixture_is_what_the_encoder_writes_and_cuts_change_nothing(name: str) -> None:
    kind, made = STREAMS[name]
    data = (FIXTURES / name).read_bytes()
    assert data == made()
    check_random_reads(lambda: kind(SETTINGS), data)
    check_bytewise(lambda: kind(SETTINGS), data)
    check_garbage(lambda: kind(SETTINGS))


@pytest.mark.slow
@pytest.mark.parametrize("name", STREAMS)
def test_every_cut_gives_the_same_and_damage_never_raises(name: str) -> None:
    kind, _ = STREAMS[name]
    for settings in (SETTINGS, DeviceSettings("gnss/test", {"solution_of": "sensor1"})):
        check_stream(partial(kind, settings), (FIXTURES / name).read_bytes())
        check_damage(partial(kind, settings), (FIXTURES / name).read_bytes())
