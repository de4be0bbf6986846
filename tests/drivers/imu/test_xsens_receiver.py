"""Tests the receiver and the solution of an Xsens unit: recordings against another library, local frames, times."""

from __future__ import annotations

import datetime as dt
import math
import struct
from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from swath.drivers.driver import find_driver
from swath.drivers.imu.xsens_xbus import wire as xbus
from swath.drivers.parser import DeviceSettings
from swath.georef.records import DeviceStatus, FixType, GnssFix, InsSolution, Record, TimeMessage
from tests.drivers.builders import of_type, rows_of, times
from tests.drivers.gnss.builders import fixes
from tests.drivers.harness import canonical, check_damage, check_stream, feed_pieces
from tests.drivers.imu_xsens import FORMATS, NAMES, decoded, make, parse, recording, vector
from tests.drivers.recordings import FIXTURES

LEAP = 18
GOOD = 0x0180_0007  # orientation valid, fix, filter with GNSS
WEEK, DAY = 2037, dt.date(2019, 1, 20)
UTC = (100_000_000, 2019, 1, 20, 13, 47, 24, 0x07)
GPS_NS = (WEEK * 604_800 + 13 * 3600 + 47 * 60 + 24 + LEAP) * 10**9
PVT = xbus.Pvt(
    *(49_662_000, 2019, 1, 20, 13, 47, 24, 0x37, 5, -250_000, 3, 1, 11, 0, 118_825_704, 576_794_453, 81_777, 43_306),
    *(20, 30, -27, 10, -2, 29, 0, 50, 15_028_634, 131_072, 154, 139, 68, 112, 83, 55, 62),
)


def pvt_message(pvt: xbus.Pvt = PVT) -> bytes:
    return xbus.encode_mtdata2(xbus.encode_item(xbus.GNSS_PVT_DATA, pvt))


@cache
def vouched(name: str) -> bytes:
    """Return a recording whose status words call the orientation valid, which it does not yet do."""
    data, made, position = recording(name), b"", 0
    while position < len(data):
        long = data[position + 3] == 0xFF
        length = struct.unpack_from(">H", data, position + 4)[0] + 7 if long else data[position + 3] + 5
        content = bytearray(data[position + (6 if long else 4) : position + length - 1])
        for mark, valid_at in ((b"\xe0\x20\x04", 6), (b"\xe0\x10\x01", 3)):
            at = content.find(mark)
            if at >= 0:
                content[at + valid_at] |= xbus.ORIENTATION_VALID
        made += xbus.encode_message(0x36, bytes(content))
        position += length
    return made


def pvt_of(lines: list[str]) -> dict[str, int]:
    return {name: int(value) for name, value in (line.split(":") for line in lines)}


# --- recordings ---


@pytest.mark.parametrize("name", NAMES)
def test_fixes_match_the_reference_library(name: str) -> None:
    found = fixes(parse(recording(name))[0])
    theirs = [pvt_of(block["GNSSPVTData"]) for block in decoded(name) if "GNSSPVTData" in block]
    assert len(found) == len(theirs) == 4
    for fix, pvt in zip(found, theirs, strict=True):
        assert (fix.time.week, fix.time.time_ns) == (
            WEEK,
            pvt["ITOW"] * 10**6 + (pvt["Nano"] + 500_000) % 10**6 - 500_000,
        )
        assert (fix.valid, fix.fix_type, fix.satellites) == (True, FixType.SINGLE, pvt["NumSV"])
        assert fix.lat_rad is not None
        assert fix.lon_rad is not None
        place = (math.degrees(fix.lat_rad), math.degrees(fix.lon_rad), fix.height_m)
        assert place == pytest.approx((pvt["Lat"] / 1e7, pvt["Lon"] / 1e7, pvt["Height"] / 1e3), abs=1e-9)
        assert fix.undulation_m == pytest.approx((pvt["Height"] - pvt["HMSL"]) / 1e3)
        assert fix.velocity_l == pytest.approx([pvt[key] / 1e3 for key in ("VelN", "VelE", "VelD")])
        assert fix.position_cov_l is not None
        assert fix.velocity_cov_l is not None
        level, up = pvt["HAcc"] / 1e3, pvt["VAcc"] / 1e3
        assert np.diag(fix.position_cov_l) == pytest.approx([level**2 / 2, level**2 / 2, up**2])
        assert np.diag(fix.velocity_cov_l)[2] == pytest.approx((pvt["SAcc"] / 1e3) ** 2)


@pytest.mark.parametrize("name", NAMES)
def test_solutions_match_the_reference_library_and_turn_gravity_down(name: str) -> None:
    """Its angles and velocities count from east, north, up; SciPy makes the rotation from them."""
    records, parser = parse(vouched(name))
    rows = rows_of(records, InsSolution)
    theirs = [block for block in decoded(name) if "LatLon" in block]
    assert parser.counters.errors == {}
    assert len(rows) == len(theirs) > 70
    utc = [dt.datetime.fromisoformat(block["UTCTime"][0]) for block in theirs]
    start = dt.datetime(1980, 1, 6, tzinfo=dt.UTC)
    gps_us = [(now - start) // dt.timedelta(microseconds=1) + LEAP * 10**6 for now in utc]
    assert rows["gps_ns"].tolist() == [moment * 1000 for moment in gps_us]
    assert np.degrees(rows["lat_rad"]) == pytest.approx([vector(b, "LatLon")[0] for b in theirs], abs=1e-12)
    assert np.degrees(rows["lon_rad"]) == pytest.approx([vector(b, "LatLon")[1] for b in theirs], abs=1e-12)
    assert rows["height_m"].tolist() == [float(block["AltitudeEllipsoid"][0]) for block in theirs]
    east, north, up = np.array([vector(block, "VelocityXYZ") for block in theirs]).T
    assert rows["velocity_l"].tolist() == np.stack([north, east, -up], axis=1).tolist()
    enu = Rotation.from_euler("xyz", [vector(block, "EulerAngles") for block in theirs], degrees=True).as_matrix()
    ned = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]]) @ enu
    angles = np.stack([rows["heading_rad"], rows["pitch_rad"], rows["roll_rad"]], axis=1)
    np.testing.assert_allclose(Rotation.from_euler("ZYX", angles).as_matrix(), ned, atol=1e-9)
    force = np.array([vector(block, "Acceleration") for block in theirs])
    np.testing.assert_allclose(np.einsum("nij,nj->ni", ned, force).mean(axis=0), [0, 0, -9.81], atol=0.05)
    assert parser.remarks()[0].startswith("imu/main: LatLon comes as f")


@pytest.mark.slow
def test_cuts_and_damage_change_no_solution() -> None:
    assert len(check_stream(make, vouched("1_output")).rows["InsSolution"]) > 70
    check_damage(make, vouched("2_output"))


# --- a message laid out by hand ---


def test_a_pvt_laid_out_by_hand_is_read() -> None:
    """Offsets are those of the structure in the maker's SDK, xsrawgnsspvtdata.h, with the high byte first."""
    item = bytearray(94)
    for offset, form, value in (
        *((0, ">I", 302_400_000), (4, ">H", 2024), (6, ">B", 11), (7, ">B", 27), (8, ">B", 11), (9, ">B", 59)),
        *((10, ">B", 42), (11, ">B", 7), (20, ">B", 3), (21, ">B", 3), (22, ">B", 17), (24, ">i", 85_000_000)),
        *((28, ">i", -470_000_000), (32, ">i", 555_000), (36, ">i", 507_000), (40, ">I", 14), (44, ">I", 20)),
        *((48, ">i", 43_300), (52, ">i", -25_000), (56, ">i", -1_500), (68, ">I", 100)),
    ):
        struct.pack_into(form, item, offset, value)
    body = b"\xff\x36\x61" + b"\x70\x10\x5e" + item
    records, _ = parse(b"\xfa" + body + bytes([-sum(body) & 0xFF]))
    (fix,) = fixes(records)
    assert (fix.time.week, fix.time.time_ns) == (2342, 302_400 * 10**9)
    assert fix.lat_rad == pytest.approx(math.radians(-47.0))
    assert fix.lon_rad == pytest.approx(math.radians(8.5))
    assert (fix.height_m, fix.undulation_m, fix.velocity_l) == (555.0, 48.0, (43.3, -25.0, -1.5))
    assert (fix.fix_type, fix.satellites, fix.valid) == (FixType.DIFFERENTIAL, 17, True)
    (time,) = times(records)
    assert (time.time.week, time.time.time_ns, time.time.leap_seconds) == (2342, 302_400 * 10**9, LEAP)


# --- fixes ---


@pytest.mark.parametrize(
    ("kind", "flags", "rtk", "fix_type", "valid"),
    [
        (0, 1, 2, FixType.NONE, False),
        (1, 1, 2, FixType.DEAD_RECKONING, True),
        (2, 1, 0, FixType.SINGLE, True),
        (3, 0, 0, FixType.SINGLE, False),
        (3, 3, 0, FixType.DIFFERENTIAL, True),
        (3, 3, 1, FixType.RTK_FLOAT, True),
        (4, 3, 2, FixType.RTK_FIXED, True),
        (5, 1, 0, FixType.NONE, False),
    ],
)
def test_fix_type_of_the_pvt_and_of_the_status_word(
    kind: int, flags: int, rtk: int, fix_type: FixType, valid: bool
) -> None:
    status = xbus.encode_mtdata2(xbus.encode_item(xbus.STATUS_WORD, [rtk << 27]))
    records, _ = parse(status, pvt_message(PVT._replace(fix_type=kind, flags=flags)))
    (fix,) = fixes(records)
    assert (fix.fix_type, fix.valid, fix.lat_rad is None) == (fix_type, valid, fix_type is FixType.NONE)


def test_impossible_pvts_are_counted_and_unknown_dates_leave_the_week_open() -> None:
    for wrong in ({"itow_ms": 604_800_000}, {"lat_1e7_deg": 900_000_001}, {"nano_ns": 2**31 - 1}):
        records, parser = parse(pvt_message(PVT._replace(**wrong)))
        assert (fixes(records), parser.counters.errors) == ([], {"bad_value": 1})
    for undated in ({"valid": 0}, {"month": 13}, {"hour": 24}):
        records, parser = parse(pvt_message(PVT._replace(**undated)))
        assert [fix.time.week for fix in fixes(records)] == [None]
        assert times(records) == []
    records, parser = parse(pvt_message(PVT._replace(year=2000)))
    assert ([fix.time.week for fix in fixes(records)], times(records)) == ([None], [])
    assert parser.counters.errors == {"date_before_floor": 1}
    (time,) = times(parse(pvt_message(PVT._replace(second=20, nano_ns=500_000_000)))[0])
    assert not time.valid  # UTC and time of week are not whole seconds apart


def test_pvts_name_their_second_until_a_sample_has_utc() -> None:
    """The epoch of the whole second has a nano of −0.25 ms; the last one is in the second half."""
    epochs = [PVT._replace(itow_ms=PVT.itow_ms + ms, nano_ns=-250_000 + ms * 10**6) for ms in (0, 250, 500)]
    later = PVT._replace(itow_ms=PVT.itow_ms + 1000, second=25)
    utc = xbus.encode_mtdata2(xbus.encode_item(xbus.UTC_TIME, (5_000_000, 2019, 1, 20, 13, 47, 26, 7)))
    last = PVT._replace(itow_ms=PVT.itow_ms + 2000, second=26)
    found = times(parse(*map(pvt_message, (*epochs, later)), utc, pvt_message(last))[0])
    assert [message.message for message in found] == ["GnssPvtData", "GnssPvtData", "UtcTime"]
    assert [message.time.leap_seconds for message in found] == [LEAP] * 3
    assert [message.time.time_ns for message in found[:2]] == [49_662 * 10**9, 49_663 * 10**9]
    assert all(message.valid for message in found)


def test_satellites_are_a_status() -> None:
    item = xbus.encode_satellites(1000, [(0, 5, 40, 0x1F), (6, 9, 30, 0x17), (2, 3, 45, 0x08)])
    records, _ = parse(xbus.encode_mtdata2(item))
    assert [status.values for status in of_type(records, DeviceStatus)] == [
        {"satellites_tracked": 3, "satellites_used": 2}
    ]
    for short in (item[:2] + bytes([len(item) - 4]) + item[3:-1], b"\x70\x20\x04" + bytes(4)):
        records, parser = parse(xbus.encode_mtdata2(short))
        assert (records, parser.counters.errors) == ([], {"bad_length": 1})


# --- the unit's own solution ---

NED_FROM = {
    0x0: np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]),
    0x4: np.eye(3),
    0x8: np.diag([1.0, -1.0, -1.0]),
}
ATTITUDE = Rotation.from_euler("ZYX", [331.0, 2.5, -3.25], degrees=True)  # north, east, down from the housing
VELOCITY = np.array([43.3, -25.0, -1.5])


def solution_message(axes: int, form: int = xbus.FLOAT64, *, euler: bool = False, **changed: Any) -> bytes:
    """Return a message with one attitude and velocity, written in a local frame."""
    to_local = NED_FROM[axes & 0x8 or axes].T
    turn = Rotation.from_matrix(to_local @ ATTITUDE.as_matrix())
    roll_pitch_yaw = turn.as_euler("xyz", degrees=True)
    quaternion = np.roll(turn.as_quat(), 1)
    orientation = (xbus.EULER_ANGLES, roll_pitch_yaw) if euler else (xbus.QUATERNION, quaternion)
    items: dict[int, Any] = {
        xbus.UTC_TIME: UTC,
        xbus.STATUS_WORD: [GOOD],
        orientation[0] | axes: orientation[1].tolist(),
        xbus.VELOCITY_XYZ | axes: (to_local @ VELOCITY).tolist(),
        xbus.LAT_LON: (47.0, 8.5),
        xbus.ALTITUDE_ELLIPSOID: [555.0],
        **{int(kind): value for kind, value in changed.items()},
    }
    return xbus.encode_mtdata2(*(xbus.encode_item(kind, values, form) for kind, values in items.items()))


@pytest.mark.parametrize("axes", NED_FROM)
@pytest.mark.parametrize("euler", [False, True])
def test_every_local_frame_and_format_gives_north_east_down(axes: int, euler: bool) -> None:
    """Right wing up by 3.25°, nose up by 2.5°, heading 331°, whatever frame the unit is set to."""
    for form in FORMATS:
        records, parser = parse(pvt_message(), solution_message(axes, form, euler=euler))
        (row,) = rows_of(records, InsSolution)
        assert parser.counters.errors == {}
        found = Rotation.from_euler("ZYX", [row["heading_rad"], row["pitch_rad"], row["roll_rad"]])
        assert (found * ATTITUDE.inv()).magnitude() < (1e-9 if form == xbus.FLOAT64 else 1e-5)
        assert row["velocity_l"] == pytest.approx(VELOCITY, abs=1e-5)
        assert np.degrees([row["lat_rad"], row["lon_rad"]]) == pytest.approx([47.0, 8.5], abs=1e-6)
        assert (row["height_m"], row["gps_ns"], row["status"]) == (555.0, GPS_NS + 10**8, GOOD)
        assert np.isnan(row["position_sigma_l"]).all()
        assert len(parser.remarks()) == (form in (xbus.FLOAT32, xbus.FP1220))


def test_a_solution_needs_the_units_word_its_time_and_possible_numbers() -> None:
    cases: list[tuple[dict[str, Any], str]] = [
        ({str(xbus.STATUS_WORD): [GOOD & ~xbus.ORIENTATION_VALID]}, "ins_no_solution"),
        ({str(xbus.STATUS_WORD): [GOOD & ~xbus.GNSS_VALID]}, "ins_no_solution"),
        ({str(xbus.STATUS_WORD): [GOOD & ~xbus.FILTER_MODE]}, "ins_no_solution"),
        ({str(xbus.UTC_TIME): (*UTC[:7], 3)}, "time_unknown"),
        ({str(xbus.UTC_TIME): (0, 2000, *UTC[2:])}, "date_before_floor"),
        ({str(xbus.UTC_TIME): (0, 9999, *UTC[2:])}, "bad_value"),
        ({str(xbus.LAT_LON): (91.0, 8.5)}, "bad_value"),
        ({str(xbus.ALTITUDE_ELLIPSOID): [math.nan]}, "bad_value"),
        ({str(xbus.QUATERNION | 4): (0.0, 0.0, 0.0, 0.0)}, "bad_value"),
    ]
    for changed, code in cases:
        records, parser = parse(pvt_message(), solution_message(4, **changed))
        assert (of_type(records, InsSolution), parser.counters.errors) == ([], {code: 1})
    records, parser = parse(solution_message(4))  # no leap seconds yet
    assert (of_type(records, InsSolution), parser.counters.errors) == ([], {"time_unknown": 1})
    records, parser = parse(pvt_message(), solution_message(0xC & 0xC))
    assert parser.counters.errors == {"bad_value": 1}  # no such frame


def stream() -> bytes:
    """Return messages of every local frame and number format, with fixes, satellites and samples between."""
    sample = xbus.encode_item(xbus.ACCELERATION, (0.0, 0.0, 9.8)) + xbus.encode_item(xbus.RATE_OF_TURN, (0.0, 0.1, 0.2))
    satellites = xbus.encode_satellites(1000, [(0, 5, 40, 0x1F), (6, 9, 30, 0x17)])
    status = {str(xbus.STATUS_WORD): [GOOD | 2 << 27]}
    messages = [xbus.encode_mtdata2(xbus.encode_item(xbus.STATUS_WORD, [GOOD | 2 << 27]), sample)]
    for n, (axes, form) in enumerate((axes, form) for axes in NED_FROM for form in FORMATS):
        pvt = PVT._replace(itow_ms=PVT.itow_ms + 1000 * n, second=24 + n, flags=3)
        own = solution_message(axes, form, euler=n % 2 == 0, **status)
        messages += [pvt_message(pvt), own, xbus.encode_mtdata2(satellites)]
    return b"".join(messages)


def test_the_fixture_is_what_the_encoder_writes() -> None:
    data = (FIXTURES / "xsens/mti_680.bin").read_bytes()
    assert data == stream()
    records, parser = parse(data)
    assert (len(fixes(records)), len(rows_of(records, InsSolution)), parser.counters.errors) == (12, 12, {})
    assert {fix.fix_type for fix in fixes(records)} == {FixType.RTK_FIXED}


# --- the receiver inside the unit ---


def test_the_receiver_inside_gives_its_records_only() -> None:
    driver = find_driver("gnss", "xsens-xbus")
    assert (driver.transports, driver.yields) == (("imu",), (TimeMessage, GnssFix))
    data = vouched("1_output")
    parser = driver.make_parser(DeviceSettings("gnss/rover", {"rate_hz": 100}))
    records: list[Record] = feed_pieces(parser, [data])
    assert {type(record) for record in records} == {TimeMessage, GnssFix}
    whole = [record for record in parse(data)[0] if isinstance(record, TimeMessage | GnssFix)]
    assert canonical(records) == canonical(whole)
