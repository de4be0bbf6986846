"""Tests RoboSense heads by packets built by hand from the SDK's structures and by the encoder, and with damage."""

from __future__ import annotations

import datetime as dt
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike

from swath.drivers.driver import find_driver
from swath.drivers.parser import DeviceSettings, DriverSettingsError
from swath.drivers.scanner.beams import beam_points
from swath.drivers.scanner.robosense.heads import (
    BPEARL,
    BPEARL_V4,
    HELIOS16P,
    HELIOS32,
    MODE_DUAL,
    RS16,
    RS32,
    RobosenseHead,
    read_angles,
)
from swath.drivers.scanner.robosense.parser import RobosenseParser, encode_difop, encode_msop
from swath.georef.arrays import StructArray
from swath.georef.records import RETURN_FLAG_LAST, RETURN_FLAG_STRONGEST, Chunk, DeviceClockSamples, DeviceStatus
from tests.drivers.builders import clock_of, feed, returns_of
from tests.drivers.harness import check_packet_damage, check_packets
from tests.drivers.recordings import FIXTURES
from tests.drivers.spinning import payloads

NOON = dt.datetime(2026, 11, 21, 12, 0, 0, 250_000, tzinfo=dt.UTC)
NOON_NS = 1_795_262_400_250_000_000  # `date -u -d '2026-11-21 12:00:00' +%s`
HEADS = {
    "rs16": RS16,
    "rs32": RS32,
    "helios32": HELIOS32,
    "helios16p": HELIOS16P,
    "bpearl": BPEARL,
    "bpearl-v4": BPEARL_V4,
}
EVERY_HEAD = pytest.mark.parametrize("head", HEADS.values(), ids=HEADS.keys())
RS16_DEG = [-15, -13, -11, -9, -7, -5, -3, -1, 15, 13, 11, 9, 7, 5, 3, 1]


def angles(head: RobosenseHead) -> list[float]:
    return [float(one) for one in RS16_DEG] if head.lasers == 16 else (np.arange(32) - 20.5).tolist()


def parser_of(head: RobosenseHead, mode: int = 1) -> RobosenseParser:
    file = encode_difop(head, angles(head), mode=mode)
    return RobosenseParser(DeviceSettings("scanner/left", {}, {"geometry": file}), head)


def packet(
    head: RobosenseHead, step: int = 20, blocks: int = 1, ranges: ArrayLike = 1000, first: int = 1000, light: int = 7
) -> bytes:
    """Return a packet whose azimuths grow by a step (in 0.01°) after each group of so many blocks."""
    azimuth = (first + step * (np.arange(12) // blocks)) % 36_000
    return encode_msop(NOON, azimuth, np.broadcast_to(np.asarray(ranges), (12, 32)), light, head)


def decode(unit: bytes, head: RobosenseHead, mode: int = 1) -> StructArray:
    return returns_of(parser_of(head, mode).feed(Chunk("scanner/left", 1, unit)))


# --- packets put together by hand


def msop_by_hand(head: bytes, block: bytes, azimuths: list[int]) -> bytes:
    """Return a data packet of 1248 bytes: header, twelve blocks of FF EE, azimuth and 32 returns, index, tail."""
    body = b"".join(b"\xff\xee" + struct.pack(">H", azimuth) + block for azimuth in azimuths)
    unit = head + body + bytes(4) + b"\x00\xff"
    assert len(unit) == 1248
    return unit


def old_header() -> bytes:
    """Return a header with 2026-11-21 12:00:00.250125, date and time in binary, milliseconds, microseconds."""
    stamp = bytes((26, 11, 21, 12, 0, 0)) + struct.pack(">HH", 250, 125)
    return bytes.fromhex("55aa050a5aa550a0") + bytes(12) + stamp + bytes(12)


def test_an_rs16_packet_computed_by_hand_is_decoded() -> None:
    """A block holds two rounds of 16 lasers: laser 3 of block 2 fires at 111 + 8.4 µs and at 111 + 63.9 µs."""
    block = b"".join(struct.pack(">HB", 2000 + place, place) for place in range(32))
    rows = decode(msop_by_hand(old_header(), block, [9000 + 40 * at for at in range(12)]), RS16)
    assert len(rows) == 384
    times = rows["device_time_ns"].reshape(12, 32) - NOON_NS - 125_000
    assert times[1, [3, 19]].tolist() == [111_000 + 8_400, 111_000 + 63_900]
    assert times[11, 31] == 11 * 111_000 + 97_500
    assert rows["channel"][:32].tolist() == [*range(16), *range(16)]
    np.testing.assert_allclose(rows["range_m"][:32], 10 + 0.005 * np.arange(32), atol=1e-9)
    assert rows["intensity"][31] == 31
    want_deg = 90 + 0.4 * 63.9 / 111.0
    assert np.degrees(rows["encoder_rad"][19]) == pytest.approx(want_deg, abs=1e-9)


def test_dual_returns_of_an_rs16_lie_in_the_halves_of_a_block() -> None:
    """In dual return a block is one round of 55.5 µs; only the device information packet reports this mode."""
    ranges = np.tile(np.repeat([2000, 1000], 16), (12, 1))
    rows = decode(packet(RS16, ranges=ranges), RS16, MODE_DUAL)
    assert len(rows) == 384
    near, far = rows[0], rows[1]
    assert (near["range_m"], far["range_m"]) == pytest.approx((5.0, 10.0))
    assert (near["flags"], far["flags"]) == (RETURN_FLAG_STRONGEST, RETURN_FLAG_LAST)
    assert near["pulse_id"] == far["pulse_id"]
    times = rows["device_time_ns"].reshape(12, 16, 2)[..., 0] - NOON_NS
    assert times[3, 15] == 3 * 55_500 + 42_000


def test_an_rs32_packet_computed_by_hand_is_decoded() -> None:
    """Lasers 1 and 17 fire 1.44 µs apart; a block takes 55.52 µs; pairs of equal azimuths mean dual return."""
    block = b"".join(struct.pack(">HB", 1000, 200) for _ in range(32))
    single = decode(msop_by_hand(old_header(), block, [100 + 20 * at for at in range(12)]), RS32)
    times = single["device_time_ns"].reshape(12, 32) - NOON_NS - 125_000
    assert times[2, [0, 15, 16, 31]].tolist() == [111_040, 111_040 + 44_640, 111_040 + 1_440, 111_040 + 46_080]
    dual = decode(msop_by_hand(old_header(), block, [100 + 20 * (at // 2) for at in range(12)]), RS32)
    assert len(dual) == 6 * 32
    assert dual["device_time_ns"][-1] - NOON_NS - 125_000 == 5 * 55_520 + 46_080


def test_a_helios_packet_computed_by_hand_is_decoded() -> None:
    """The stamp has six bytes of seconds since 1970 and four of µs; ranges count 2.5 mm; lasers are 1.73 µs apart."""
    header = bytes.fromhex("55aa055a") + bytes(16) + struct.pack(">HII", 0, 1_795_262_400, 250_125) + bytes(12)
    block = b"".join(struct.pack(">HB", 4000, 9) for _ in range(32))
    unit = msop_by_hand(header, block, [100 + 20 * at for at in range(12)])
    rows = decode(unit, HELIOS32)
    times = rows["device_time_ns"].reshape(12, 32) - NOON_NS - 125_000
    assert times[1, 31] == 55_560 + 53_630
    assert rows["range_m"][0] == pytest.approx(10)
    twice = decode(unit, HELIOS16P)["device_time_ns"].reshape(12, 32) - NOON_NS - 125_000
    assert twice[1, [16, 31]].tolist() == [111_120 + 27_680, 111_120 + 53_630]


def test_points_start_ahead_of_the_axis() -> None:
    """decoder_RS32.hpp has forward d cos v cos(a + h) + Rx cos a, and left −d cos v sin(a + h) − Rx sin a."""
    file = encode_difop(RS32, np.linspace(-25, 15, 32), np.full(32, 8.0))
    parser = RobosenseParser(DeviceSettings("scanner/left", {}, {"geometry": file}), RS32)
    row = returns_of(parser.feed(Chunk("scanner/left", 1, packet(RS32, first=3000))))[:1]
    azimuth, elevation, distance_m = np.radians(30.0), np.radians(-25.0), 5.0
    forward = distance_m * np.cos(elevation) * np.cos(azimuth + np.radians(8)) + 0.03997 * np.cos(azimuth)
    left = -distance_m * np.cos(elevation) * np.sin(azimuth + np.radians(8)) - 0.03997 * np.sin(azimuth)
    assert parser.beams is not None
    np.testing.assert_allclose(
        beam_points(row, parser.beams)[0], [-left, forward, distance_m * np.sin(elevation)], atol=1e-9
    )


def test_a_jump_over_a_part_of_the_circle_takes_its_time() -> None:
    """From 100.6° to 280.6°, at 0.2° in 55.52 µs, 180° last 900 blocks; within a block the usual rotation holds."""
    azimuth = [10_000, 10_020, 10_040, 10_060, *(28_060 + 20 * at for at in range(8))]
    unit = encode_msop(NOON, azimuth, np.full((12, 32), 1000), 1, RS32)
    rows = decode(unit, RS32)
    times = (rows["device_time_ns"].reshape(12, 32) - NOON_NS)[:, 0]
    np.testing.assert_allclose(times[[3, 4, 11]], np.array([3, 903, 910]) * 55_520, atol=1)
    degrees = np.degrees(rows["encoder_rad"].reshape(12, 32))
    assert degrees[3, 31] == pytest.approx(100.6 + 0.2 * 46.08 / 55.52, abs=1e-9)


@pytest.mark.parametrize(("mode", "flags"), [(1, RETURN_FLAG_STRONGEST), (2, RETURN_FLAG_LAST), (9, 0)])
def test_single_returns_are_flagged_by_the_mode_of_the_information_packet(mode: int, flags: int) -> None:
    assert (decode(packet(RS32), RS32, mode)["flags"] == flags).all()
    assert (decode(packet(HELIOS32), HELIOS32, {1: 4, 2: 5}.get(mode, mode))["flags"] == flags).all()


# --- angles


def test_angles_of_information_packets_are_read() -> None:
    """An RS-LiDAR-16 has one of two units, the others sign and value; the packet may be anywhere in a capture."""
    for head in HEADS.values():
        elevation, azimuth, mode = read_angles(b"pcap" + encode_difop(head, angles(head), 1.5, mode=2) + b"more", head)
        np.testing.assert_allclose(elevation, angles(head), atol=1e-9)
        np.testing.assert_allclose(azimuth, 0 if head is RS16 else 1.5, atol=1e-9)
        assert mode == 2
    coarse = bytearray(encode_difop(RS16, RS16_DEG))
    coarse[1165 : 1165 + 48] = b"".join(round(1000 * abs(one)).to_bytes(3, "big") for one in RS16_DEG)
    np.testing.assert_allclose(read_angles(bytes(coarse), RS16)[0], RS16_DEG, atol=1e-9)
    text = "\n".join(f"{one},0.5" for one in RS16_DEG)
    elevation, azimuth, mode = read_angles(text.encode(), RS16)
    np.testing.assert_allclose(np.stack([elevation, azimuth - 0.5]), np.stack([RS16_DEG, np.zeros(16)]))
    assert mode == -1


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"", "0 lasers, want 32"),
        (b"1,2\nx,3\n", "line 2 is 'x,3'"),
        (b"99,0\n" * 32, "not angles"),
        (b"1,0\n" * 32, "all lasers have one elevation"),
        (b"nan,0\n" * 32, "not angles"),
        (encode_difop(RS32, np.arange(32))[:700], "has 700 bytes"),
        (encode_difop(RS16, RS16_DEG), "holds no angles of a RS-LiDAR-32"),
        (encode_difop(RS32, np.arange(32))[:337] + b"\1" + encode_difop(RS32, np.arange(32))[338:], "reverses"),
    ],
)
def test_impossible_angle_files_are_refused(data: bytes, says: str) -> None:
    with pytest.raises(DriverSettingsError, match=says):
        RobosenseParser(DeviceSettings("scanner/left", {}, {"geometry": data}), RS32)


def test_other_angles_of_the_head_are_reported() -> None:
    parser = parser_of(RS32)
    same, other = encode_difop(RS32, angles(RS32)), encode_difop(RS32, np.array(angles(RS32)) + 0.1, mode=2)
    records = feed(parser, [same, packet(RS32), other, encode_difop(RS16, RS16_DEG)])
    assert parser.counters.errors == {"angles_differ": 1, "no_angles": 1}
    assert parser.counters.messages == {"difop": 3, "data": 1}
    assert [record.values for record in records if isinstance(record, DeviceStatus)][:2] == [
        {"return_mode": 1, "motor_rpm": 600},
        {"return_mode": 2, "motor_rpm": 600},
    ]
    assert parser.remarks() == [
        "scanner/left: its DIFOP packets state other angles than geometry.file, or without it than the first of them; "
        "give one of them as the file"
    ]
    assert parser_of(RS32).remarks() == []


def difop_by_hand() -> bytes:
    """Return a DIFOP packet of an RS-LiDAR-32: at 468 a sign and two bytes of 0.001° upwards for each of 32 lasers, at
    564 the same of the azimuth (RSCalibrationAngle of decoder.hpp, AdapterDifopPkt of decoder_RS32.hpp).
    """
    upward = b"".join(struct.pack(">BH", int(laser < 16), 1000 + 100 * laser) for laser in range(32))
    turned = b"".join(struct.pack(">BH", laser % 2, 8_000) for laser in range(32))
    head = bytes.fromhex("a5ff005a11115555") + struct.pack(">H", 600)
    unit = head.ljust(300, b"\0") + b"\x02"
    unit = unit.ljust(468, b"\0") + upward + turned
    return unit.ljust(1246, b"\0") + b"\x0f\xf0"


def test_the_heads_own_packets_give_the_angles_without_a_file() -> None:
    """Returns before the packet are decoded and counted; the first packet counts, a later one is compared with it."""
    parser = RobosenseParser(DeviceSettings("scanner/left"), RS32)
    before = returns_of(feed(parser, [packet(RS32)] * 3))
    assert len(before) == 3 * 384
    assert (before["flags"] == 0).all()  # the return mode is not known yet
    assert parser.beams is None
    assert len(parser.warnings) == 1
    assert "no DIFOP packet" in parser.warnings[0]
    after = returns_of(feed(parser, [difop_by_hand(), packet(RS32), encode_difop(RS32, angles(RS32))]))
    assert (after["flags"] == RETURN_FLAG_LAST).all()
    assert parser.counters.errors == {"before_difop": 3, "angles_differ": 1}
    assert parser.beams is not None
    assert parser.warnings == ()
    np.testing.assert_allclose(parser.beams.elevation_deg[[0, 15, 16, 31]], [-1, -2.5, 2.6, 4.1], atol=1e-9)
    np.testing.assert_allclose(parser.beams.azimuth_deg[:2], [8, -8], atol=1e-9)


@EVERY_HEAD
def test_the_packet_with_the_angles_is_found_among_others(head: RobosenseHead) -> None:
    """Packets of other models hold no angles of this one, or none at all; a log may hold them too."""
    protocol = next(f"robosense-{name}" for name, one in HEADS.items() if one is head)
    sent = find_driver("scanner", protocol).sent_file
    assert sent is not None
    other = encode_difop(RS32 if head is RS16 else RS16, angles(RS32 if head is RS16 else RS16))
    own, later = encode_difop(head, angles(head), mode=2), encode_difop(head, np.array(angles(head)) / 2)
    units = np.frombuffer(b"".join([packet(head), other, own, later]), dtype=np.uint8).reshape(4, -1)
    assert sent.find(units) == own
    assert sent.find(units[:2]) is None
    assert sent.find(units[:, 1:]) is None
    read_angles(sent.example(), head)


# --- every head


@EVERY_HEAD
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=15, deadline=None)
def test_encoded_packets_are_decoded_to_their_input(head: RobosenseHead, seed: int) -> None:
    random = np.random.default_rng(seed)
    ranges = random.integers(0, 2, (12, 32)) * random.integers(0, 65_536, (12, 32))
    rows = decode(packet(head, ranges=ranges), head)
    np.testing.assert_array_equal(np.rint(rows["range_m"] / head.range_unit_m), ranges[ranges > 0])
    assert (np.diff(rows["pulse_id"]) > 0).all()


@EVERY_HEAD
def test_returns_do_not_depend_on_how_batches_are_cut(head: RobosenseHead) -> None:
    random = np.random.default_rng(2)
    units = []
    for at in range(30):
        ranges = random.integers(0, 2, (12, 32)) * random.integers(0, 65_536, (12, 32))
        units.append(packet(head, blocks=2 if 10 < at < 20 else 1, ranges=ranges, first=240 * at))
        if at % 9 == 8:
            units.append(encode_difop(head, angles(head), mode=at % 2))
    check_packets(lambda: parser_of(head), units, seeds=(1,))
    check_packet_damage(lambda: parser_of(head), units[5:12], examples=15)


@pytest.mark.parametrize(
    ("at", "new", "code"),
    [
        (0, b"\x54", "bad_header"),
        (3, b"\x5a", "wrong_product"),
        (31, b"\x03\x04", "wrong_product"),
        (42, b"\0", "bad_block"),
        (44, b"\x8c\xa0", "bad_azimuth"),
        (21, b"\x0d", "bad_time"),
        (23, b"\x18", "bad_time"),
        (26, b"\x04", "bad_time"),
    ],
)
def test_impossible_packets_are_counted(at: int, new: bytes, code: str) -> None:
    good = packet(RS32)
    parser = parser_of(RS32)
    rows = returns_of(feed(parser, [good, good[:at] + new + good[at + len(new) :], good, good[:-1]]))
    assert parser.counters.errors == {code: 1, "bad_length": 1}
    assert parser.counters.bad_messages == 2
    assert parser.counters.bytes == parser.counters.bytes_framed + parser.counters.bytes_skipped
    np.testing.assert_array_equal(np.unique(rows["host_time_ns"]), [0, 2_000_000])


@pytest.mark.parametrize("name", HEADS)
def test_the_driver_declares_its_records(name: str) -> None:
    head, driver = HEADS[name], find_driver("scanner", f"robosense-{name}")
    units = [unit for unit in payloads("robosense/made.pcap.gz") if unit[: len(head.identity)] == head.identity]
    file = DeviceSettings("scanner/left", {}, {"geometry": (FIXTURES / "robosense" / f"{name}.difop").read_bytes()})
    assert driver.make_time_parser is not None
    records = feed(driver.make_time_parser(file), units)
    assert {type(record) for record in records} == {DeviceClockSamples}
    assert len(clock_of(records)) < len(units)
    bare = driver.make_parser(DeviceSettings("scanner/left"))
    assert len(returns_of(feed(bare, units))) > 1000
    assert bare.counters.messages["data"] >= 20
