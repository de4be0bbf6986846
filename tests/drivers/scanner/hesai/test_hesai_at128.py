"""Tests the AT128: packets and angle files made by hand from the maker's structures and by the encoders."""

from __future__ import annotations

import gzip
import hashlib
import struct

import numpy as np
import pytest

from swath.drivers.driver import find_driver
from swath.drivers.parser import DeviceSettings, DriverSettingsError
from swath.drivers.scanner.hesai.at128 import (
    AT128,
    AT128_4_1,
    CIRCLE,
    MirrorAngles,
    Mirrors,
    encode_mirror_angles,
    read_mirror_angles,
)
from swath.drivers.scanner.hesai.gps import encode_gps_packet
from swath.drivers.scanner.hesai.heads import (
    CONFIDENCE,
    MODE_LAST_STRONGEST,
    MODE_STRONGEST,
    SAFETY,
    SEQUENCE,
    SIGNATURE,
    HesaiHead,
)
from swath.drivers.scanner.hesai.parser import MirrorParser, encode_point_packet
from swath.georef.arrays import FloatArray, StructArray
from swath.georef.records import (
    AIMED_RETURN_DTYPE,
    RETURN_FLAG_LAST,
    RETURN_FLAG_STRONGEST,
    Chunk,
    DeviceClockSamples,
    DeviceStatus,
    ScannerReturns,
    TimeMessage,
)
from tests.drivers.at128_cases import DEG, WALL_M, made_angles, pcap_of, scan
from tests.drivers.builders import clock_of, feed, returns_of
from tests.drivers.harness import check_packet_damage, check_packets
from tests.drivers.recordings import FIXTURES
from tests.drivers.scanner.hesai.builders import NOON, NOON_NS
from tests.drivers.spinning import payloads

FILE = gzip.decompress((FIXTURES / "hesai" / "at128.dat.gz").read_bytes())
OLDER_FILE = encode_mirror_angles(made_angles(steps=36_000), older=True)


def parser_of(file: bytes = FILE) -> MirrorParser:
    return MirrorParser(DeviceSettings("scanner/front", {}, {"geometry": file}), AT128)


def decode(unit: bytes, file: bytes = FILE) -> StructArray:
    return returns_of(parser_of(file).feed(Chunk("scanner/front", 1, unit)))


def points(rows: StructArray) -> FloatArray:
    """Return points (n, 3): the formula of docs/conventions.md, x forward, y left, z up."""
    azimuth, elevation = rows["encoder_rad"], rows["elevation_rad"]
    flat = np.cos(elevation)
    unit: FloatArray = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=1)
    unit *= rows["range_m"][:, np.newaxis]
    return unit


# --- by hand


def file_by_hand(more: dict[tuple[int, int], tuple[int, int]]) -> bytes:
    """Return a file with a unit of 2: three mirrors of 120° from 24°, laser n at −2.4° and n · 0.01° up, and
    corrections of azimuth and elevation by laser and step of 2°.
    """
    header = b"\xee\xff" + bytes((1, 5, 128, 3, 3, 1, 2, 4, 0, 0, 0, 0, 0, 2))
    whole = [at * 25_600 // 2 for at in (24, 144, 264, 144, 264, 24)]
    azimuth, elevation = [-24 * 2560 // 2] * 128, [128 * laser for laser in range(128)]
    corrections = np.zeros((2, 128, 180), dtype=np.int8)
    for (laser, step), values in more.items():
        corrections[:, laser, step] = values
    content = header + struct.pack("<6I128i128i", *whole, *azimuth, *elevation) + corrections.tobytes()
    return content + hashlib.sha256(content).digest()


def packet_by_hand(azimuths: tuple[tuple[int, int], tuple[int, int]], mode: int = 0x37) -> bytes:
    """Return a packet of protocol 4.3 of 1086 bytes: laser n at 2500 + n units of 4 mm."""
    header = b"\xee\xff" + bytes((4, 3, 0, 0, 128, 2, 0, 4, 1, 0b10001))
    lasers = b"".join(struct.pack("<HBB", 2500 + laser, laser, 200) for laser in range(128))
    body = b"".join(struct.pack("<HB", *azimuth) + lasers for azimuth in azimuths)
    seconds = b"\0\0" + (1_795_262_400).to_bytes(4, "big")
    tail = bytes(18) + struct.pack("<hIBB6s", 2000, 250_000, mode, 0x42, seconds)
    unit = header + body + bytes(4) + tail + struct.pack("<I", 9) + bytes(4)
    assert len(unit) == 1086
    return unit


def test_a_packet_and_a_file_by_hand_are_decoded() -> None:
    """Shaft 69° is 45° into the first mirror: the maker's azimuth is 2 · 45° + 2.4° + the correction.

    It is half way between the steps at 68° and 70°, where laser 3 has 0.2° and 0.1° (a unit is 0.02°) and upwards 0 and
    −0.04°. Shaft 24.5° less is in the third mirror, whose part of the circle goes over 0.
    """
    file = file_by_hand({(3, 34): (10, 0), (3, 35): (5, -2)})
    rows = decode(packet_by_hand(((6900, 0), (450, 128))), file)
    assert rows.dtype == AIMED_RETURN_DTYPE
    assert len(rows) == 256
    first, second = rows[:128], rows[128:]
    forward, up = np.degrees(first["encoder_rad"]), np.degrees(first["elevation_rad"])
    assert forward[0] == pytest.approx(90 - (90 + 2.4), abs=1e-9)
    assert (forward[3], up[3]) == pytest.approx((90 - (90 + 2.4 + 0.15), 0.03 - 0.02), abs=1e-9)
    assert up[127] == pytest.approx(1.27, abs=1e-9)
    # 4.505° is 100.505° into the third mirror
    assert np.degrees(second["encoder_rad"][5]) == pytest.approx(90 - (2 * 100.505 + 2.4), abs=1e-9)
    np.testing.assert_allclose(first["range_m"], 10 + 0.004 * np.arange(128), atol=1e-9)
    assert (first["intensity"] == np.arange(128)).all()
    assert (rows["channel"] == np.tile(np.arange(128), 2)).all()
    # nebula, pandar_at128.hpp: block 2 begins 9.249 + 41.666 µs before the stamp; laser 9 fires 12.424 µs later
    assert first["device_time_ns"][[0, 8]].tolist() == [NOON_NS - 92_581, NOON_NS - 92_581 + 12_424]
    assert second["device_time_ns"][127] == NOON_NS - 50_915 + 8_264
    assert (rows["flags"] == RETURN_FLAG_STRONGEST).all()


def test_a_packet_of_the_older_protocol_by_hand_is_decoded() -> None:
    """4.1 has no fine azimuth and no CRC; the corrections of a file of 1.3 are those of the shaft's 0.01°."""
    header = b"\xee\xff" + bytes((4, 1, 0, 0, 128, 2, 0, 4, 1, 1))
    block = b"".join(struct.pack("<HBB", 2500, laser, 200) for laser in range(128))
    body = b"".join(struct.pack("<H", azimuth) + block for azimuth in (6900, 6905))
    tail = bytes(10) + struct.pack("<hIBB6sI", 200, 250_000, 0x38, 0x42, bytes((126, 11, 21, 12, 0, 0)), 7)
    more = np.zeros((2, 36_000), dtype=np.int8)
    more[:, 6905] = 7, -3
    content = b"\xee\xff" + bytes((1, 3, 128, 3, 3, 0, 0, 0, 0, 0, 0, 0, 0, 1))
    content += struct.pack("<6H128h128h", 2400, 14_400, 26_400, 14_400, 26_400, 2400, *[-240] * 128, *range(128))
    content += more.tobytes()
    rows = decode(header + body + tail, content + hashlib.sha256(content).digest())
    assert len(header + body + tail) == 1068
    assert len(rows) == 256
    degrees = np.degrees([[row["encoder_rad"], row["elevation_rad"]] for row in rows[[4, 132]]])
    np.testing.assert_allclose(degrees, [[-2.4, 0.04], [-2.4 - 0.1 - 0.07, 0.04 - 0.03]], atol=1e-9)
    assert rows["device_time_ns"][128] == NOON_NS - 50_915
    assert (rows["flags"] == RETURN_FLAG_LAST).all()


def test_dual_returns_share_their_firing() -> None:
    unit = bytearray(packet_by_hand(((6900, 7), (6900, 7)), mode=MODE_LAST_STRONGEST))
    unit[12 + 515 + 3 : 12 + 515 + 5] = struct.pack("<H", 2400)  # laser 1 in the second block
    rows = decode(bytes(unit))
    near, far = rows[:2]
    assert len(rows) == 129  # equal ranges are one return
    assert (near["range_m"], far["range_m"]) == pytest.approx((9.6, 10.0))
    assert near["pulse_id"] == far["pulse_id"]
    assert near["device_time_ns"] == far["device_time_ns"] == NOON_NS - 50_915
    assert (near["encoder_rad"], near["elevation_rad"]) == (far["encoder_rad"], far["elevation_rad"])
    assert far["flags"] & RETURN_FLAG_LAST


# --- a wall, by the encoder


@pytest.mark.parametrize(("head", "file"), [(AT128, FILE), (AT128_4_1, OLDER_FILE)], ids=["4.3", "4.1"])
def test_a_wall_before_the_head_is_plane(head: HesaiHead, file: bytes) -> None:
    """Ranges were made laser by laser by the maker's formula; they are rounded to 4 mm."""
    rows = returns_of(feed(parser_of(file), scan(head, read_mirror_angles(file), 12)))
    assert len(rows) > 2400
    found = points(rows)
    np.testing.assert_allclose(found[:, 0], WALL_M, atol=0.0021)
    assert found[:, 1].min() < -WALL_M < WALL_M < found[:, 1].max()
    assert found[:, 2].min() < -5 < 5 < found[:, 2].max()


def test_every_angle_of_the_shaft_has_directions_within_a_circle() -> None:
    mirrors = Mirrors(made_angles())
    azimuth, elevation, inside = mirrors.directions(np.arange(0, CIRCLE, 5003))
    assert inside.all()
    assert np.abs(azimuth).max() <= np.pi
    assert np.degrees(np.abs(elevation)).max() < 14
    # within a mirror's part azimuth falls by twice the shaft's turn, give or take the corrections
    turned = np.degrees(np.diff(azimuth[:, 7])) % 360
    assert np.percentile(360 - turned, [5, 95]) == pytest.approx([2 * 5003 / DEG] * 2, abs=0.03)


def test_blocks_of_no_mirror_are_counted_and_have_no_returns() -> None:
    start = made_angles().start
    file = encode_mirror_angles(MirrorAngles(**{**made_angles().__dict__, "end": (start + 100 * DEG) % CIRCLE}))
    parser = parser_of(file)
    rows = returns_of(feed(parser, [packet_by_hand(((6900, 0), (13_000, 0)))]))
    assert len(rows) == 128
    assert parser.counters.errors == {"outside_mirrors": 1}
    assert parser.counters.messages == {"points": 1}


def test_packets_about_faults_are_counted_and_give_a_status() -> None:
    """FaultMessageVersion4_3: 99 bytes with the operating state at 13, that of faults at 14, their number at 17."""
    fault = b"\xcd\xdc\x03" + bytes(10) + bytes((2, 1, 0, 7, 4)) + bytes(81)
    parser = parser_of()
    records = feed(parser, [fault, fault, b"\xcd\xdd" + fault[2:], bytes(273), fault[:14] + b"\0" + fault[15:]])
    assert [one.values for one in records if isinstance(one, DeviceStatus)] == [
        {"operating_state": 2, "fault_state": 1, "faults": 4},
        {"operating_state": 2, "fault_state": 0, "faults": 4},
    ]
    assert parser.counters.messages == {"fault": 3, "report": 1}
    assert parser.counters.errors == {"bad_header": 1}
    assert parser.counters.bytes == parser.counters.bytes_framed + parser.counters.bytes_skipped == 4 * 99 + 273


# --- files


def test_files_are_read_as_they_were_written() -> None:
    for older, unit, steps in ((False, 1, 180), (False, 2, 180), (True, 1, 36_000)):
        angles = made_angles(steps=steps)
        read = read_mirror_angles(b"\0" + encode_mirror_angles(angles, unit=unit, older=older))
        for name, tolerance in (("start", 1), ("end", 1), ("azimuth_deg", 1e-4), ("elevation_deg", 1e-4)):
            np.testing.assert_allclose(getattr(read, name), getattr(angles, name), atol=tolerance)
        np.testing.assert_allclose(read.more_azimuth_deg, angles.more_azimuth_deg, atol=0.0101)
        np.testing.assert_allclose(read.more_elevation_deg, angles.more_elevation_deg, atol=0.0101)
    assert len(FILE) == 47_176  # as the files of the maker and of nebula


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"Channel,Elevation,Azimuth\n1,2,3\n", "no angle correction file"),
        (FILE[:15], "no angle correction file"),
        (FILE[:3] + b"\4" + FILE[4:], "version 1.4"),
        (FILE[:4] + b"\x40" + FILE[5:], "64 lasers"),
        (FILE[:6] + b"\0" + FILE[7:], "0 frames"),
        (FILE[:15] + b"\0" + FILE[16:], "unit 0"),
        (FILE[:-1], "47175 bytes, want 47176"),
        (FILE[:2000] + b"\x55" + FILE[2001:], "SHA-256 is wrong"),
        (OLDER_FILE[:15] + b"\2" + OLDER_FILE[16:], "unit of 2, want 1"),
        (encode_mirror_angles(MirrorAngles(**{**made_angles().__dict__, "start": np.full(3, CIRCLE)})), "a circle"),
    ],
)
def test_impossible_files_are_refused(data: bytes, says: str) -> None:
    with pytest.raises(DriverSettingsError, match=rf"geometry\.file: .*{says}"):
        parser_of(data)


# --- every packet


def test_optional_parts_are_found_by_the_flags() -> None:
    """The maker's input.h (checkPacketSize) adds these lengths; a packet of 4.1 has 1064 bytes, 1068 with sequence."""
    lengths = {
        12 + 2 * (3 + 128 * (4 if flags & CONFIDENCE else 3))
        + 4 + 32 + 4
        + (4 if flags & SEQUENCE else 0) + (17 if flags & SAFETY else 0) + (32 if flags & SIGNATURE else 0)
        for flags in (
            a | b | c | d for a in (0, SEQUENCE) for b in (0, SAFETY) for c in (0, SIGNATURE) for d in (0, CONFIDENCE)
        )
    }  # fmt: skip
    assert set(AT128.layouts()) == lengths | {1064, 1068}
    assert {1086, 1118} <= lengths


@pytest.mark.parametrize(
    ("at", "new", "code"),
    [
        (0, b"\xed", "bad_header"),
        (2, b"\5", "wrong_product"),
        (3, b"\7", "wrong_product"),
        (6, b"\x40", "bad_header"),
        (11, b"\1", "bad_header"),
        (13, b"\xff", "bad_azimuth"),
        (12 + 1030 + 4 + 24, b"\0", "bad_return_mode"),
    ],
)
def test_impossible_packets_are_counted(at: int, new: bytes, code: str) -> None:
    good = packet_by_hand(((6900, 0), (6905, 0)))
    parser = parser_of()
    feed(parser, [good, good[:at] + new + good[at + len(new) :], good[:-1]])
    assert parser.counters.errors == {code: 1, "bad_length": 1}
    assert parser.counters.bytes == parser.counters.bytes_framed + parser.counters.bytes_skipped


def test_packets_do_not_depend_on_how_batches_are_cut() -> None:
    random, units = np.random.default_rng(5), []
    for at in range(40):
        ranges = random.integers(0, 2, (2, 128)) * random.integers(1, 65_536, (2, 128))
        mode = MODE_LAST_STRONGEST if at % 7 > 3 else MODE_STRONGEST
        shaft = (900 * at + 5.25 * np.arange(2) * (mode == MODE_STRONGEST)) % 36_000
        when = NOON.replace(microsecond=250_000 + 300 * at)
        head, sequence = (AT128_4_1 if at % 9 == 8 else AT128), None if at % 11 == 10 else at
        shaft = np.floor(shaft) if head is AT128_4_1 else shaft
        units.append(encode_point_packet(when, shaft, ranges, ranges % 256, mode, head=head, sequence=sequence))
    units.insert(7, encode_gps_packet(NOON))
    check_packets(parser_of, units, seeds=(1,))
    check_packet_damage(parser_of, units[3:11], examples=15)


def test_made_packets_are_decoded_by_their_driver() -> None:
    driver = find_driver("scanner", "hesai-at128")
    assert encode_mirror_angles(made_angles(), unit=2) == FILE
    units = payloads("hesai/made_at128.pcap.gz")
    assert gzip.decompress((FIXTURES / "hesai/made_at128.pcap.gz").read_bytes()) == pcap_of(
        scan(AT128, read_mirror_angles(FILE), 40)
    )
    with pytest.raises(DriverSettingsError, match=r"geometry\.file: missing"):
        driver.make_parser(DeviceSettings("scanner/front"))
    settings = DeviceSettings("scanner/front", {}, {"geometry": FILE})
    assert driver.make_time_parser is not None
    assert driver.make_probe is not None
    assert driver.aimed
    records = feed(driver.make_time_parser(settings), [*units, encode_gps_packet(NOON)])
    assert {type(one) for one in records} == {DeviceClockSamples, TimeMessage, DeviceStatus}
    assert len(clock_of(records)) < len(units)
    assert {type(one) for one in records} | {ScannerReturns} == set(driver.yields)
    probe = driver.make_probe(DeviceSettings("scanner/front"))
    assert len(returns_of(feed(probe, units))) > 5000
    assert probe.counters.messages == {"points": len(units)}
    # 3,072,000 places a second in dual return, 256 a packet
    assert driver.bytes_per_s == pytest.approx(3_072_000 / 256 * 1118, rel=1e-4)
