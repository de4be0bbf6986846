"""Tests UBX without NAV-PVT: older messages, NMEA in the stream, and receivers with inertial sensors."""

from __future__ import annotations

import datetime as dt
import math
from typing import Any

import numpy as np
import pyproj
import pytest
from pyubx2 import GET, UBXMessage, UBXReader
from pyubx2.ubxtypes_core import UBX_MSGIDS

from swath.drivers.framing.kinds import UBX_NAMES
from swath.drivers.gnss.nmea import sentences as nmea
from swath.drivers.gnss.nmea.beside import FORGET_AFTER_SENTENCES
from swath.drivers.gnss.ubx import messages as ubx
from swath.drivers.gnss.ubx import sensors
from swath.drivers.gnss.ubx.fix import geodetic_from_ecef
from swath.drivers.gnss.ubx.parser import UbxParser
from swath.drivers.imu.ubx_esf import make_imu_parser
from swath.drivers.parser import DeviceSettings, DriverSettingsError
from swath.georef.records import (
    DeviceStatus,
    FixType,
    GnssFix,
    GnssHeading,
    ImuSamples,
    InsSolution,
    Record,
    TimeMessage,
    TimeScale,
)
from tests.drivers.builders import of_type, rows_of, times
from tests.drivers.gnss.builders import fixes
from tests.drivers.harness import check_bytewise, check_random_reads, feed_pieces
from tests.drivers.recordings import FIXTURES, gpsd_reports, recording

SETTINGS = DeviceSettings("gnss/test")
S = 1_000_000_000
WEEK, TOW_MS = 2342, 302_400_000
TIME = ubx.NavTimegps(TOW_MS, 125, WEEK, 18, 7, 20)
POSLLH = ubx.NavPosllh(TOW_MS, 85_000_000, 470_000_000, 555_000, 507_000, 1_200, 2_400)
VELNED = ubx.NavVelned(TOW_MS, 5_000, -1_000, 150, 5_101, 5_099, 34_869_010, 30, 50_000)
STATUS = ubx.NavStatus(TOW_MS, 3, ubx.SOL_FIX_OK | ubx.SOL_DIFFERENTIAL | ubx.SOL_WEEK | ubx.SOL_TOW)
ATT = ubx.NavAtt(TOW_MS, 0, -150_000, 275_000, 34_869_010, 20_000, 30_000, 40_000)
RAWX = ubx.RXM_RAWX.encode(ubx.RxmRawx(302_400.0, WEEK, 18, 0, 1))


def parse(*frames: bytes, **config: Any) -> tuple[list[Record], UbxParser]:
    parser = UbxParser(DeviceSettings("gnss/test", config))
    return feed_pieces(parser, frames), parser


def degrees_of(fix: GnssFix) -> tuple[float, float]:
    assert fix.lat_rad is not None
    assert fix.lon_rad is not None
    return math.degrees(fix.lat_rad), math.degrees(fix.lon_rad)


def test_names_are_those_of_pyubx2() -> None:
    ours = {key: name for key, name in UBX_NAMES.items() if len(key) == 2}
    assert {ours[key] for key in ours if key in UBX_MSGIDS} == {UBX_MSGIDS[key] for key in ours if key in UBX_MSGIDS}
    assert ours[b"\x01\x17"] == "NAV-PVAT"
    assert sorted(name for key, name in ours.items() if key not in UBX_MSGIDS) == ["ESF-SLAS", "MGA-ACK", "MON-BATCH"]


def test_136_satellites_of_m8p_firmware_are_8() -> None:
    (fix,) = fixes(parse((FIXTURES / "ubx/numsv_bit7.ubx").read_bytes())[0])
    assert fix.satellites == 8


# --- older messages ---


def test_posllh_velned_and_status_make_one_fix() -> None:
    records, parser = parse(
        ubx.NAV_TIMEGPS.encode(TIME),
        ubx.NAV_POSLLH.encode(POSLLH),
        ubx.NAV_VELNED.encode(VELNED),
        ubx.NAV_STATUS.encode(STATUS),
    )
    (fix,) = fixes(records)
    assert (fix.time.scale, fix.time.week, fix.time.time_ns) == (TimeScale.GPS, WEEK, TOW_MS * 1_000_000 + 125)
    assert (fix.message, fix.valid, fix.fix_type) == ("NAV-POSLLH", True, FixType.DIFFERENTIAL)
    assert degrees_of(fix) == pytest.approx((47.0, 8.5), abs=1e-12)
    assert (fix.height_m, fix.undulation_m) == (555.0, 48.0)
    assert fix.velocity_l == (50.0, -10.0, 1.5)
    assert fix.position_cov_l is not None
    assert fix.velocity_cov_l is not None
    assert np.diag(fix.position_cov_l) == pytest.approx([0.72, 0.72, 5.76])
    assert np.diag(fix.velocity_cov_l) == pytest.approx([0.045, 0.045, 0.09])
    assert parser.counters.bad_messages == 0


def test_a_position_without_a_status_is_valid_if_accurate() -> None:
    assert [fix.valid for fix in fixes(parse(ubx.NAV_POSLLH.encode(POSLLH))[0])] == [True]
    vague = POSLLH._replace(horizontal_accuracy_mm=4_294_967_295)
    assert [fix.valid for fix in fixes(parse(ubx.NAV_POSLLH.encode(vague))[0])] == [False]
    lost = STATUS._replace(fix_type=0, flags=0)
    (fix,) = fixes(parse(ubx.NAV_POSLLH.encode(POSLLH), ubx.NAV_STATUS.encode(lost))[0])
    assert (fix.valid, fix.fix_type, fix.velocity_l) == (False, FixType.NONE, None)


@pytest.mark.parametrize(("lat", "lon", "height"), [(47.1, 8.5, 3000.0), (-33.9, -151.2, -20.0), (89.9999, 30.0, 0.0)])
def test_ecef_conversion_matches_proj(lat: float, lon: float, height: float) -> None:
    xyz = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True).transform(lon, lat, height)
    found = geodetic_from_ecef(*xyz)
    assert np.degrees(found[:2]) == pytest.approx([lat, lon], abs=1e-13)
    assert found[2] == pytest.approx(height, abs=1e-8)


def test_nav_sol_alone_gives_position_and_velocity_of_ecef() -> None:
    """The expected velocity is one second along PROJ's topocentric frame."""
    lat, lon, height = 47.0, 8.5, 555.0
    ecef = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    start = np.array(ecef.transform(lon, lat, height))
    enu = pyproj.Transformer.from_pipeline(
        f"+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 +lon_0={lon} +lat_0={lat} +h_0={height}"
    )
    velocity = (np.array(enu.transform(-10.0, 50.0, -1.5)) - start) * 100  # east, north, up
    (x, y, z), (vx, vy, vz) = np.rint(start * 100).astype(int).tolist(), np.rint(velocity).astype(int).tolist()
    sol = ubx.NavSol(TOW_MS, 125, WEEK, 3, 0x0D, x, y, z, 300, vx, vy, vz, 30, 150, 0x88)
    (fix,) = fixes(parse(ubx.NAV_SOL.encode(sol))[0])
    assert degrees_of(fix) == pytest.approx((lat, lon), abs=1e-7)
    assert fix.height_m == pytest.approx(height, abs=0.01)
    assert fix.velocity_l == pytest.approx((50.0, -10.0, 1.5), abs=0.02)
    assert (fix.satellites, fix.valid, fix.fix_type, fix.message) == (8, True, FixType.SINGLE, "NAV-SOL")


@pytest.mark.parametrize("name", ["ublox-aek-4t.log", "ublox-lea-4t.log"])
def test_nav_sol_of_old_receivers_matches_gpsd(name: str) -> None:
    """Only the first fix is compared, because gpsd repeats its first position in these logs."""
    report = gpsd_reports("ubx", name)[0]
    fix = fixes(feed_pieces(UbxParser(SETTINGS), [recording("ubx", name)]))[0]
    assert (fix.message, fix.valid) == ("NAV-SOL", True)
    assert degrees_of(fix) == pytest.approx((report["lat"], report["lon"]), abs=6e-10)
    assert fix.height_m == pytest.approx(report["altHAE"], abs=6e-5)


# --- attitude and inertial sensors ---


def test_attitude_is_joined_with_the_fix_and_week_of_its_epoch() -> None:
    frames = (ubx.NAV_TIMEGPS.encode(TIME), ubx.NAV_POSLLH.encode(POSLLH), ubx.NAV_ATT.encode(ATT))
    records, _ = parse(*frames)
    (row,) = rows_of(records, InsSolution)
    assert row["gps_ns"] == (WEEK * 604_800_000 + TOW_MS) * 1_000_000 + 125
    angles = [row["roll_rad"], row["pitch_rad"], row["heading_rad"]]
    assert np.degrees(angles) == pytest.approx([-1.5, 2.75, 348.6901])
    assert np.degrees(row["attitude_sigma_rad"]) == pytest.approx([0.2, 0.3, 0.4])
    assert np.degrees(row["lat_rad"]) == pytest.approx(47.0)
    assert math.isnan(row["velocity_l"][0])
    theirs = UBXReader.parse(frames[-1])
    assert (theirs.roll, theirs.pitch, theirs.heading, theirs.accHeading) == (-1.5, 2.75, 348.6901, 0.4)
    unset = parse(*frames[:2], ubx.NAV_ATT.encode(ATT._replace(roll_accuracy_1e5_deg=0)))[0]
    assert of_type(unset, InsSolution) == []
    timeless, parser = parse(ubx.NAV_ATT.encode(ATT))
    assert (of_type(timeless, InsSolution), parser.counters.errors) == ([], {"time_unknown": 1})


def test_nav_pvat_written_by_pyubx2_is_read() -> None:
    """pyubx2 takes values in its own units; 12:00:00 UTC of 2024-11-27 is iTOW 302 418 000."""
    values: dict[str, Any] = {"iTOW": 302_418_000, "year": 2024, "month": 11, "day": 27, "hour": 12, "nano": -250}
    values |= {"numSV": 21, "fixType": 4, "validDate": 1, "validTime": 1, "fullyResolved": 1, "gnssFixOK": 1}
    values |= {"carrSoln": 2, "vehRollValid": 1, "vehPitchValid": 1, "vehHeadingValid": 1, "lon": 8.5, "lat": 47.0}
    values |= {"height": 555_000, "hMSL": 507_000, "hAcc": 14, "vAcc": 20, "velN": 50_000, "velE": -10_000}
    values |= {"velD": 1_500, "sAcc": 100, "vehRoll": -1.5, "vehPitch": 2.75, "vehHeading": 348.6901}
    values |= {"accRoll": 0.2, "accPitch": 0.3, "accHeading": 0.4}
    records, _ = parse(UBXMessage("NAV", "NAV-PVAT", GET, **values).serialize())
    (fix,), (row,), (time,) = fixes(records), rows_of(records, InsSolution), times(records)
    assert (fix.message, fix.fix_type, fix.satellites, fix.valid) == ("NAV-PVAT", FixType.RTK_FIXED, 21, True)
    assert fix.velocity_l == (50.0, -10.0, 1.5)
    assert (time.time.date, time.time.leap_seconds, time.valid) == (dt.date(2024, 11, 27), 18, True)
    angles = [row["roll_rad"], row["pitch_rad"], row["heading_rad"]]
    assert np.degrees(angles) == pytest.approx([-1.5, 2.75, 348.6901])
    assert np.degrees(row["attitude_sigma_rad"]) == pytest.approx([0.2, 0.3, 0.4])
    assert row["gps_ns"] == (2342 * 604_800_000 + 302_418_000) * 1_000_000 - 250
    assert row["velocity_l"].tolist() == [50.0, -10.0, 1.5]
    without = UBXMessage("NAV", "NAV-PVAT", GET, **(values | {"vehHeadingValid": 0})).serialize()
    assert of_type(parse(without)[0], InsSolution) == []


# --- two receivers on one body ---

RELPOS_MM = (1200.3, -900.4, 150.2)  # from the reference's antenna to this receiver's: north, east, down


def relposned(flags: int, **changes: int) -> bytes:
    north, east, down = (round(value) for value in RELPOS_MM)
    length = math.hypot(*RELPOS_MM)
    message = ubx.NavRelposned(
        *(1, 0, TOW_MS, north // 10, east // 10, down // 10, int(length // 10)),
        round(math.degrees(math.atan2(RELPOS_MM[1], RELPOS_MM[0])) % 360.0 * 1e5),
        *(north % 10 * 10, east % 10 * 10, down % 10 * 10, round(length % 10 * 10), 30, 30, 60, 40, 25_000, flags),
    )
    return ubx.NAV_RELPOSNED.encode(message._replace(**changes))


def test_relposned_gives_the_direction_to_the_references_antenna() -> None:
    """The receiver sends its own antenna's positions, so it is the primary; the vector has the other direction."""
    frame = relposned(0x137)
    theirs = UBXReader.parse(frame)
    assert (theirs.relPosN, theirs.relPosE, theirs.relPosD) == pytest.approx((120.0, -90.0, 15.0), abs=0.2)
    assert (theirs.isMoving, theirs.relPosHeadingValid, theirs.carrSoln, theirs.accHeading) == (1, 1, 2, 0.25)
    (heading,) = of_type(parse(frame)[0], GnssHeading)
    to_reference = -np.array(RELPOS_MM)
    assert heading.heading_rad == pytest.approx(math.atan2(to_reference[1], to_reference[0]) % math.tau, abs=1e-4)
    assert heading.pitch_rad == pytest.approx(math.asin(-to_reference[2] / np.linalg.norm(to_reference)), abs=1e-3)
    assert heading.baseline_m == pytest.approx(np.linalg.norm(RELPOS_MM) / 1e3, abs=1e-4)
    assert math.degrees(heading.heading_sigma_rad or 0.0) == pytest.approx(0.25)
    assert heading.pitch_sigma_rad == pytest.approx(0.006 / 1.508, rel=1e-3)
    assert (heading.valid, heading.time and heading.time.time_ns) == (True, TOW_MS * 1_000_000)


def test_relposned_counts_with_fixed_ambiguities_and_a_moving_reference_only() -> None:
    for flags, valid, errors in (
        (0x12F, False, {"heading_not_fixed": 1}),
        (0x037, False, {"heading_not_valid": 1}),
    ):
        records, parser = parse(relposned(flags))
        (heading,) = of_type(records, GnssHeading)
        assert (heading.valid, parser.counters.errors) == (valid, errors)
    assert parse(relposned(0x117))[0] == []  # a base station on the ground
    records, parser = parse(relposned(0x137, version=0))
    assert (records, parser.counters.errors) == ([], {"relposned_version": 1})
    (normalised,) = of_type(parse(relposned(0x337))[0], GnssHeading)
    assert normalised.baseline_m is None


FORCE, RATE = (0.5, -0.25, -9.75), (0.1, -0.2, 0.3)


def test_esf_raw_gives_a_sample_for_each_time_tag() -> None:
    """The frame is laid out by hand from the manual's table of ESF measurement data, and by the encoder."""
    words = [
        (14, round(math.degrees(0.1) * 4096)),
        (13, round(math.degrees(-0.2) * 4096)),
        (5, round(math.degrees(0.3) * 4096)),
        (12, 3175),
        *((16, 512), (17, -256), (18, -9984)),
    ]
    pairs = b"".join(
        (kind << 24 | value & 0xFF_FFFF).to_bytes(4, "little") + tag.to_bytes(4, "little")
        for tag in (0xFFFF_FF00, 0)
        for kind, value in words
    )
    frame = ubx.encode_frame(b"\x10\x03", bytes(4) + pairs)
    assert frame == sensors.encode_esf_raw([(0xFFFF_FF00, FORCE, RATE), (0, FORCE, RATE)], 31.75)
    rows = rows_of(parse(frame)[0], ImuSamples)
    assert rows["specific_force_b"].tolist() == [list(FORCE)] * 2
    assert rows["angular_rate_b"] == pytest.approx(np.array([RATE] * 2), abs=5e-6)
    assert rows["temperature_c"].tolist() == [31.75] * 2
    assert np.diff(rows["device_time_ns"]).tolist() == [10_000_000]  # 256 ticks of 1/25600 s, over the wrap
    assert np.diff(rows_of(parse(frame, tick_hz=1e6)[0], ImuSamples)["device_time_ns"]).tolist() == [256_000]


def test_esf_meas_gives_a_sample_until_esf_raw_comes() -> None:
    meas = [sensors.encode_esf_meas(tag, FORCE, RATE, 31.75) for tag in (1000, 1100)]
    raw = sensors.encode_esf_raw([(5, FORCE, RATE)], 31.75)
    theirs = UBXReader.parse(meas[0])
    assert (theirs.timeTag, theirs.numMeas) == (1000, 7)
    assert [getattr(theirs, f"dataType_0{at}") for at in range(1, 8)] == [14, 13, 5, 12, 16, 17, 18]
    assert np.diff(rows_of(parse(*meas)[0], ImuSamples)["device_time_ns"]).tolist() == [100_000_000]
    assert len(rows_of(parse(raw, *meas)[0], ImuSamples)) == 1
    wheel = ubx.encode_frame(b"\x10\x02", bytes(4) + (1 << 11).to_bytes(2, "little") + bytes(2) + b"\x07\0\0\x0b")
    assert parse(wheel)[0] == []
    partial = ubx.encode_frame(b"\x10\x02", meas[0][6:-6])
    records, parser = parse(partial)
    assert (of_type(records, ImuSamples), parser.counters.bad_messages) == ([], 1)
    with pytest.raises(DriverSettingsError, match="tick_hz: got -1"):
        parse(tick_hz=-1)


def test_esf_ins_gives_the_valid_components() -> None:
    (status,) = of_type(
        parse(sensors.encode_esf_ins(ubx.EsfIns(0x0900, TOW_MS, 1000, 2000, 3000, -981, 5, 6)))[0], DeviceStatus
    )
    assert status.values == {
        "itow_s": 302_400.0,
        "angular_rate_x_radps": pytest.approx(math.radians(1.0)),
        "acceleration_x_mps2": -9.81,
    }


def test_the_imu_parser_returns_inertial_records_only() -> None:
    parser = make_imu_parser(DeviceSettings("imu/main"))
    records = feed_pieces(
        parser,
        [
            ubx.NAV_TIMEGPS.encode(TIME),
            ubx.NAV_POSLLH.encode(POSLLH),
            ubx.NAV_ATT.encode(ATT),
            sensors.encode_esf_meas(1, FORCE, RATE, 20.0),
        ],
    )
    assert {type(record) for record in records} == {InsSolution, ImuSamples}


def encoded() -> bytes:
    """Return two seconds of messages without a recording: attitude, sensors and a moving base."""
    zeros = ubx.NavPvat(*[0] * len(ubx.NavPvat._fields))
    pvat = zeros._replace(
        itow_ms=TOW_MS, year=2024, month=11, day=27, hour=11, minute=59, second=42, valid=7, flags=0xB9
    )
    pvat = pvat._replace(fix_type=4, satellites=21, lat_1e7_deg=470_000_000, lon_1e7_deg=85_000_000)
    frames = (
        *(ubx.NAV_TIMEGPS.encode(TIME), ubx.NAV_POSLLH.encode(POSLLH), ubx.NAV_VELNED.encode(VELNED)),
        *(ubx.NAV_STATUS.encode(STATUS), ubx.NAV_ATT.encode(ATT), ubx.NAV_PVAT.encode(pvat), relposned(0x137)),
        *(sensors.encode_esf_meas(1000, FORCE, RATE, 31.75), sensors.encode_esf_raw([(5, FORCE, RATE)], 31.75)),
        *(
            sensors.encode_esf_ins(ubx.EsfIns(0x3F00, TOW_MS, 1000, 2000, 3000, -981, 5, 6)),
            ubx.NAV_EOE.encode(ubx.NavEoe(TOW_MS)),
        ),
    )
    return b"".join(frames) * 2


def test_the_encoded_fixture_is_what_the_encoder_writes_and_cuts_change_nothing() -> None:
    data = (FIXTURES / "ubx/encoded.ubx").read_bytes()
    assert data == encoded()
    kinds = {type(record) for record in parse(data)[0]}
    assert kinds == {TimeMessage, GnssFix, GnssHeading, InsSolution, ImuSamples, DeviceStatus}
    check_random_reads(lambda: UbxParser(SETTINGS), data)
    check_bytewise(lambda: UbxParser(SETTINGS), data)


# --- NMEA in the stream ---


def gga(second: int) -> bytes:
    return nmea.encode_gga(second * S, math.radians(47.0), math.radians(8.5), 507.0, 48.0, quality=4)


def pvt(second: int) -> bytes:
    zeros = ubx.NavPvt(*[0] * len(ubx.NavPvt._fields))
    return ubx.NAV_PVT.encode(zeros._replace(itow_ms=second * 1000, fix_type=3, flags=1))


def messages_of(records: list[Record]) -> list[str]:
    return [record.message for record in records if isinstance(record, GnssFix)]


def test_raw_measurements_and_nmea_give_fixes_and_time() -> None:
    stream = b"".join(RAWX + gga(second) + nmea.encode_gst(second * S, 0.01, 0.01, 0.02) for second in range(1, 6))
    records, parser = parse(stream)
    assert messages_of(records) == ["GGA"] * 5
    assert {time.message for time in times(records)} == {"RXM-RAWX"}
    assert parser.counters.messages == {"RXM-RAWX": 5, "GGA": 5, "GST": 5}
    assert all(fix.position_cov_l is not None for fix in fixes(records))
    for check in (check_random_reads, check_bytewise):
        check(lambda: UbxParser(SETTINGS), stream + pvt(6) + stream)
    time_parser = UbxParser(SETTINGS, wanted=(type(times(records)[0]),))
    assert len(feed_pieces(time_parser, [stream])) == len(times(records))


def test_nmea_gives_no_fix_where_ubx_gives_positions() -> None:
    both = [frame for second in range(1, 5) for frame in (gga(second), pvt(second))]
    records, parser = parse(*both, nmea.encode_sentence("GPGGA,120000.00,9100.0,N,00830.0,E,1,08,1.0,4.0,M,47.0,M,,"))
    assert messages_of(records) == ["NAV-PVT"] * 4
    assert parser.counters.bad_messages == 0
    assert messages_of(parse(RAWX, gga(1))[0]) == ["GGA"]  # alone: known at the end
    assert messages_of(parse(gga(1), gga(2))[0]) == []  # without any frame in UBX, it is a stream of NMEA


def test_nmea_counts_again_long_after_the_last_ubx_position() -> None:
    later = FORGET_AFTER_SENTENCES + 20
    records, _ = parse(pvt(1), *(gga(second) for second in range(1, later)), pvt(later), gga(later))
    used = [fix.time.time_ns // S for fix in fixes(records) if fix.message == "GGA"]
    assert used == list(range(FORGET_AFTER_SENTENCES, later))
    assert messages_of(records).count("NAV-PVT") == 2
