"""Tests Livox packets: bytes and points computed by hand, every type of point and time, cut and damaged.

The collection has no recording. Time and form of the first packet are those of a user's report (Livox-SDK #130: "21-6-8
8:1661272021"); the figures are computed by hand or by `datetime`.
"""

from __future__ import annotations

import datetime as dt
import math
import struct
import zlib

import numpy as np
import pytest

from swath.drivers.captures.opening import read_pcap
from swath.drivers.driver import find_driver
from swath.drivers.parser import DeviceSettings, PacketParser
from swath.drivers.scanner.livox.layout import (
    HEADER_1,
    HEADER_2,
    NO_SYNC,
    POINTS_1,
    POINTS_2,
    PPS_1,
    encode_packet_1,
    encode_packet_2,
)
from swath.georef.records import (
    AIMED_RETURN_DTYPE,
    RETURN_FLAG_DOUBTED,
    RETURN_FLAG_LAST,
    RETURN_FLAG_PPS_LOCKED,
    DeviceClockSamples,
    DeviceStatus,
    ImuSamples,
    ScannerReturns,
)
from tests.drivers.builders import clock_of, feed, of_type, returns_of, rows_of
from tests.drivers.harness import check_packet_damage, check_packets
from tests.drivers.livox_cases import FILES, FIXTURES, WALL_M, pcap_of, rosette

S = 1_000_000_000


def parser_of(name: str, *, clock_only: bool = False) -> PacketParser:
    """Return the parser of a family of models."""
    driver = find_driver("scanner", f"livox-{name}")
    make = driver.make_time_parser if clock_only else driver.make_parser
    assert make is not None
    made = make(DeviceSettings("scanner/front"))
    assert isinstance(made, PacketParser)
    return made


def avia_by_hand() -> bytes:
    """Return 96 tagged points, of which four are set, with header and points byte by byte from livox_def.h."""
    when = struct.pack("<4BI", 21, 6, 8, 8, 1_661_272_021)
    header = struct.pack("<4BIBB", 5, 1, 1, 0, 33_280, 3, 2) + when
    points = {
        0: (3000, 4000, 0, 50, 0x00),  # 5 m, 53.130102° to the left
        1: (
            1000,
            -1000,
            1414,
            60,
            0x02,
        ),  # 1.999849 m, 45° to the right, 44.9957° up (45° − 0.21356/1414.1/2 rad); noise with medium confidence
        7: (-2000, 0, 0, 70, 0x10),  # behind the head; bits of the return's number do not mean noise
        95: (0, 0, -2500, 80, 0x00),  # straight down
    }
    rows = [struct.pack("<3i2B", *points.get(at, (0, 0, 0, 0, 0))) for at in range(96)]
    return header + b"".join(rows)


def test_a_packet_of_sdk_1_is_decoded_as_computed_by_hand() -> None:
    data = avia_by_hand()
    assert len(data) == 18 + 96 * 14 == 1362  # lds.h: 1362 bytes
    parser = parser_of("avia")
    records = feed(parser, [data])
    rows = returns_of(records)
    assert rows.dtype == AIMED_RETURN_DTYPE
    np.testing.assert_allclose(rows["range_m"], [5.0, 1.999849, 2.0, 2.5], atol=1e-6)
    np.testing.assert_allclose(np.degrees(rows["encoder_rad"]), [53.130102, -45.0, 180.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(np.degrees(rows["elevation_rad"]), [0.0, 44.995674, 0.0, -90.0], atol=1e-6)
    assert rows["intensity"].tolist() == [50, 60, 70, 80]
    assert rows["channel"].tolist() == [0, 1, 1, 5]  # six lasers in turn
    assert (rows["return_number"] == 1).all()
    assert (rows["number_of_returns"] == 1).all()
    locked = RETURN_FLAG_PPS_LOCKED
    assert rows["flags"].tolist() == [locked, locked | RETURN_FLAG_DOUBTED, locked, locked]
    first_ns = int(dt.datetime(2021, 6, 8, 8, 27, 41, tzinfo=dt.UTC).timestamp()) * S + 272_021_000
    np.testing.assert_array_equal(rows["device_time_ns"] - first_ns, [0, 4166, 29_166, 395_833])  # 240 000 a second
    clock = clock_of(records)
    assert clock["device_time_ns"].tolist() == [first_ns + 395_833]
    assert clock["pps_time_ns"].tolist() == [first_ns - 272_021_000]
    assert clock["locked"].tolist() == [1]
    (status,) = of_type(records, DeviceStatus)
    assert status.values == {"time": "pps+gprmc", "status_code": 33_280}
    assert parser.counters.messages == {"cartesian-tagged": 1}
    assert parser.counters.bytes_framed == len(data)


def test_a_packet_of_sdk_2_is_decoded_as_computed_by_hand() -> None:
    """Two points are 4.75 µs apart; type 2 counts centimetres; the CRC is that of time and points."""
    content = struct.pack("<Q", 1_700_000_000_250_000_000)
    content += struct.pack("<3h2B", 300, 0, 400, 9, 0) + struct.pack("<3h2B", 0, -1200, 500, 8, 0x24)
    head = struct.pack("<B4HBBB12x", 0, 36 + 16, 475, 2, 17_473, 0, 2, 2)
    parser = parser_of("mid360")
    good, bad, unsaid = (head + struct.pack("<I", crc) + content for crc in (zlib.crc32(content), 1, 0))
    records = feed(parser, [good, bad, unsaid])
    assert (parser.counters.bad_checksums, parser.counters.errors) == (1, {"duplicate": 1})
    rows = returns_of(records)
    np.testing.assert_allclose(rows["range_m"], [5.0, 13.0])
    np.testing.assert_allclose(np.degrees(rows["encoder_rad"]), [0.0, -90.0], atol=1e-9)
    np.testing.assert_allclose(np.degrees(rows["elevation_rad"]), [53.130102, 22.619865], atol=1e-6)
    np.testing.assert_array_equal(rows["device_time_ns"] - 1_700_000_000_250_000_000, [0, 47_500])
    assert rows["flags"].tolist() == [4, 4 | RETURN_FLAG_DOUBTED]
    assert clock_of(records)["pps_time_ns"].tolist() == [1_700_000_000 * S]


def test_spherical_points_are_zenith_angle_and_azimuth() -> None:
    """Zenith 60° is 30° up and azimuth 270° is right; a zenith of 180.01° is invalid."""
    points = np.zeros(4, dtype=POINTS_1[3].dtype)
    points["range"] = [10_000, 20_000, 0, 30_000]
    points["zenith"], points["azimuth"] = [6000, 18_000, 9000, 18_001], [27_000, 36_000, 100, 100]
    parser = parser_of("avia")
    rows = returns_of(feed(parser, [encode_packet_1(3, NO_SYNC, 5, points)]))
    np.testing.assert_allclose(np.degrees(rows["encoder_rad"]), [-90.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(np.degrees(rows["elevation_rad"]), [30.0, -90.0], atol=1e-9)
    assert rows["range_m"].tolist() == [10.0, 20.0]
    assert parser.counters.errors == {"bad_point": 1}


@pytest.mark.parametrize("data_type", [4, 5, 7, 8])
def test_returns_of_a_pulse_are_numbered_by_range(data_type: int) -> None:
    kind = POINTS_1[data_type]
    points = np.zeros(3, dtype=kind.dtype)
    name = "range" if kind.is_polar else "x"
    points["echoes"][name][:, :2] = [[9000, 4000], [0, 7000], [5000, 5000]]  # farther first; one; twice the same
    if kind.is_polar:
        points["zenith"] = 9000
    points["echoes"]["tag"][0, 0] = 0x04
    rows = returns_of(feed(parser_of("avia"), [encode_packet_1(data_type, NO_SYNC, 0, points)]))
    assert rows["range_m"].tolist() == [4.0, 9.0, 7.0, 5.0]
    assert rows["return_number"].tolist() == [1, 2, 1, 1]
    assert rows["number_of_returns"].tolist() == [2, 2, 1, 1]
    assert rows["pulse_id"].tolist() == [0, 0, 1, 2]
    last, doubted = RETURN_FLAG_LAST, RETURN_FLAG_DOUBTED
    assert rows["flags"].tolist() == [0, last | doubted, last, last]
    assert rows["device_time_ns"].tolist() == [0, 0, 4166, 8333]


def test_the_imu_is_in_si_units_and_has_the_time_of_its_packet() -> None:
    force = (0.01, -0.02, 1.0)
    records = feed(parser_of("mid360"), [encode_packet_2(0, 1, 3 * S, [((0.1, 0.2, -0.3), force)], span_100ns=0)])
    records += feed(parser_of("avia"), [encode_packet_1(6, PPS_1, 250_000_000, [((0.1, 0.2, -0.3), force)])])
    rows = rows_of(records, ImuSamples)
    np.testing.assert_allclose(rows["specific_force_b"], [[0.0980665, -0.196133, 9.80665]] * 2, rtol=1e-6)
    np.testing.assert_allclose(rows["angular_rate_b"], [[0.1, 0.2, -0.3]] * 2, rtol=1e-6)
    assert rows["device_time_ns"].tolist() == [3 * S, 250_000_000]
    assert rows["pps_time_ns"].tolist() == [-1, 0]
    broken = parser_of("avia")
    assert feed(broken, [encode_packet_1(6, NO_SYNC, 1, [((math.nan, 0, 0), (0, 0, 1))])]) == []
    assert broken.counters.errors == {"bad_sample": 1}


# --- time -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "time_type", "locked"), [("mid40", 0, -1), ("mid40", 1, -1), ("hap", 1, -1)])
def test_without_a_pulse_no_edge_is_claimed(name: str, time_type: int, locked: int) -> None:
    """With types 0 and 1 the arrival gives the origin, as for every head that does not report its lock."""
    time_ns = 1_764_000_000 * S + 5
    encode = encode_packet_1 if name == "mid40" else encode_packet_2
    data_type = 0 if name == "mid40" else 1
    dtype = (POINTS_1 if name == "mid40" else POINTS_2)[data_type].dtype
    records = feed(parser_of(name), [encode(data_type, time_type, time_ns, np.ones(2, dtype=dtype))])
    clock = clock_of(records)
    assert (clock["pps_time_ns"][0], clock["locked"][0]) == (-1, locked)
    assert returns_of(records)["device_time_ns"][0] == time_ns
    assert not returns_of(records)["flags"][0] & RETURN_FLAG_PPS_LOCKED


def test_times_since_the_pulse_go_on_by_the_hosts_seconds() -> None:
    """The stamp restarts at each pulse; a packet late by 0.3 s and 12 s without packets do not cost a second."""
    point = np.ones(1, dtype=POINTS_1[0].dtype)
    sent = [0.25, 0.75, 0.25, 0.90, 0.10, 0.35]
    host_s = [10.251, 10.751, 11.252, 12.2, 24.101, 24.351]
    parser = parser_of("mid40")
    records = []
    for stamp_s, at_s in zip(sent, host_s, strict=True):
        unit = np.frombuffer(encode_packet_1(0, PPS_1, round(stamp_s * S), point), dtype=np.uint8)
        records += parser.parse_units(np.array([round(at_s * S)]), unit[np.newaxis])
    clock = clock_of(records)
    np.testing.assert_allclose(clock["device_time_ns"] / S - 99 * 1e-5, [0.25, 0.75, 1.25, 1.90, 14.10, 14.35])
    assert (clock["pps_time_ns"] // S).tolist() == [0, 0, 1, 1, 14, 14]
    assert (clock["locked"] == 1).all()


def test_lost_late_and_repeated_packets_are_counted_by_their_stamps() -> None:
    point, begin_ns = np.ones(1, dtype=POINTS_1[0].dtype), 5 * S
    units = [encode_packet_1(0, NO_SYNC, begin_ns + at * 1_000_000, point) for at in (0, 1, 2, 5, 4, 5, 6)]
    parser = parser_of("mid40")
    rows = returns_of(feed(parser, units))
    assert parser.counters.errors == {"cadence_gap": 2, "out_of_order": 1, "duplicate": 1}
    assert ((rows["device_time_ns"] - begin_ns) // 1_000_000).tolist() == [0, 1, 2, 5, 4, 6]


def test_what_is_not_this_head_is_counted_by_a_code() -> None:
    point, other = np.ones(1, dtype=POINTS_1[0].dtype), np.ones(3, dtype=POINTS_2[1].dtype)
    good = encode_packet_1(0, NO_SYNC, 1, point)
    sdk_2 = encode_packet_2(1, NO_SYNC, 1, other)
    cases = {
        "bad_version": good.replace(b"\5", b"\4", 1),
        "bad_data_type": good[:9] + b"\x0b" + good[10:],
        "bad_length": good[:-1],
        "bad_time_type": good[:8] + b"\2" + good[9:],
        "bad_time": good[:8] + b"\3\0" + struct.pack("<4BI", 26, 13, 1, 0, 0) + good[18:],
        "other_head": encode_packet_1(0, NO_SYNC, 1, point, slot=3),
    }
    for code, unit in cases.items():
        parser = parser_of("mid40")
        records = feed(parser, [good, unit])
        assert parser.counters.errors == {code: 1}, code
        assert parser.counters.bytes_framed == len(good), code
        assert parser.counters.bytes_skipped == len(unit), code
        assert len(of_type(records, ScannerReturns)) == 1, code
    for unit, code in ((sdk_2[:-1], "bad_length"), (good, "bad_version"), (b"", "bad_length")):
        parser = parser_of("mid360")
        assert feed(parser, [unit]) == []
        assert parser.counters.errors == {code: 1}


# --- the captures of the encoder ------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", FILES)
def test_captures_are_what_the_encoder_makes_and_hold_the_wall(name: str) -> None:
    units = [unit.data for unit in read_pcap(FIXTURES / f"{name}.pcap")]
    assert units == FILES[name]()
    assert (FIXTURES / f"{name}.pcap").read_bytes() == pcap_of(name)
    parser = parser_of(name)
    records = feed(parser, units)
    assert parser.counters.bytes_framed == sum(map(len, units))
    assert set(parser.counters.errors) <= {"stamp_jump"}  # where the type of time changes
    rows = returns_of(records)
    near = rows[(rows["return_number"] == 1) & (rows["range_m"] < WALL_M / math.cos(1.0))]
    forward = near["range_m"] * np.cos(near["elevation_rad"]) * np.cos(near["encoder_rad"])
    echo = np.rint((forward - WALL_M) / 3.5)
    np.testing.assert_allclose(forward, WALL_M + 3.5 * echo, atol=0.012)  # 1 cm, or 0.01° at 0.6 rad of 40 m
    assert (echo == 0).mean() > 0.9
    assert np.abs(near["elevation_rad"]).max() < np.arctan(0.6 * np.sqrt(2))
    assert len(rosette(np.zeros(1))) == 1


@pytest.mark.parametrize("name", FILES)
def test_records_do_not_depend_on_how_batches_are_cut_and_damage_never_raises(name: str) -> None:
    units = FILES[name]()
    check_packets(lambda: parser_of(name), units, seeds=(1,))
    check_packets(lambda: parser_of(name, clock_only=True), units, seeds=(2,))
    check_packet_damage(lambda: parser_of(name), [units[0], units[-1], units[len(units) // 2]], examples=15)


def test_the_time_parser_gives_clock_samples_only() -> None:
    records = feed(parser_of("avia", clock_only=True), FILES["avia"]())
    assert {type(record) for record in records} == {DeviceClockSamples, DeviceStatus}
    assert len(clock_of(records)) < 20
    assert (HEADER_1.itemsize, HEADER_2.itemsize) == (18, 36)


def imu_parser_of(name: str) -> PacketParser:
    """Return the parser of the IMU inside a head."""
    made = find_driver("imu", f"livox-{name}").make_parser(DeviceSettings("imu/head"))
    assert isinstance(made, PacketParser)
    return made


@pytest.mark.parametrize("name", ["avia", "mid360"])
def test_the_parser_of_the_imu_alone_counts_points_and_returns_samples(name: str) -> None:
    units, whole, parser = FILES[name](), parser_of(name), imu_parser_of(name)
    wanted = rows_of(feed(whole, units), ImuSamples)
    records = feed(parser, units)
    found = rows_of(records, ImuSamples)
    for field in wanted.dtype.names or ():
        np.testing.assert_array_equal(found[field], wanted[field])
    assert len(wanted) > 0
    np.testing.assert_array_equal(clock_of(records)["device_time_ns"], wanted["device_time_ns"])
    assert {type(record) for record in records} == {ImuSamples, DeviceClockSamples}
    assert parser.counters.messages == whole.counters.messages
    assert parser.counters.bytes_framed == parser.counters.bytes == sum(map(len, units))
    check_packets(lambda: imu_parser_of(name), units, seeds=(3,))


def test_a_wrong_checksum_of_points_is_left_to_the_scanners_parser() -> None:
    sample = encode_packet_2(0, 1, 3 * S, [((0.1, 0.2, -0.3), (0, 0, 1))], span_100ns=0)
    point = encode_packet_2(1, 1, 3 * S, np.ones(2, dtype=POINTS_2[1].dtype))
    broken = [unit[:24] + b"\1\2\3\4" + unit[28:] for unit in (sample, point)]
    parser = imu_parser_of("mid360")
    assert feed(parser, broken) == []
    assert (parser.counters.bad_checksums, parser.counters.bytes_framed) == (1, len(point))
