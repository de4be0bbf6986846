"""Tests Pandar40P, Pandar64, Pandar128, OT128 by packets made by hand from the SDK's structures and by the encoder."""

from __future__ import annotations

import datetime as dt
import struct

import numpy as np
import pytest

from swath.drivers.driver import find_driver
from swath.drivers.parser import DeviceSettings
from swath.drivers.scanner.hesai.heads import MODE_LAST_STRONGEST, MODE_STRONGEST, HesaiHead
from swath.drivers.scanner.hesai.pandar import OT128, PANDAR40P, PANDAR64, PANDAR128
from swath.drivers.scanner.hesai.parser import HesaiParser
from swath.georef.records import RETURN_FLAG_LAST, RETURN_FLAG_STRONGEST, Chunk, DeviceClockSamples
from tests.drivers.builders import feed, returns_of
from tests.drivers.harness import check_packet_damage, check_packets
from tests.drivers.scanner.hesai.builders import NOON, NOON_NS, decode, packet
from tests.drivers.spinning import payloads

HEADS = {
    "hesai-pandar40p": PANDAR40P,
    "hesai-pandar64": PANDAR64,
    "hesai-pandar128": PANDAR128,
    "hesai-ot128": OT128,
}
EVERY_HEAD = pytest.mark.parametrize("head", HEADS.values(), ids=HEADS.keys())


def old_tail(mode: int, microsecond: int, utc: bytes, sequence: int | None = 7) -> bytes:
    """Return the 22 bytes behind the blocks (HS_LIDAR_TAIL_L40, HS_LIDAR_TAIL_L64), and the UDP sequence."""
    tail = struct.pack("<5sBHHIBB6s", b"\x01\x02\x03\0\0", 0, 0, 600, microsecond, mode, 0x42, utc)
    assert len(tail) == 22
    return tail + (b"" if sequence is None else struct.pack("<I", sequence))


NOON_2000 = bytes((26, 11, 21, 12, 0, 0))  # year counted from 2000
NOON_1900 = bytes((126, 11, 21, 12, 0, 0))


def pandar40p_by_hand(mode: int, sequence: int | None, utc: bytes = NOON_2000) -> bytes:
    """Return ten blocks of FF EE, azimuth, 40 times distance and reflectivity: laser n at 1000 + 10 n units of 4 mm."""
    lasers = b"".join(struct.pack("<HB", 1000 + 10 * laser, laser) for laser in range(40))
    body = b"".join(b"\xff\xee" + struct.pack("<H", (35_900 + 20 * block) % 36_000) + lasers for block in range(10))
    assert len(body) == 10 * 124
    return body + old_tail(mode, 250_000, utc, sequence)


def test_a_pandar40p_packet_computed_by_hand_is_decoded() -> None:
    """Laser 1 of the last block fires 28.58 µs + 42.22 µs before the stamp, and blocks are 55.56 µs apart."""
    for sequence, length in ((None, 1262), (7, 1266)):
        unit = pandar40p_by_hand(MODE_STRONGEST, sequence)
        assert len(unit) == length
        rows = decode(unit, PANDAR40P)
        assert len(rows) == 400
        times = rows["device_time_ns"].reshape(10, 40) - NOON_NS
        assert times[9, 0] == -28_580 - 42_220
        assert times[0, 3] == -28_580 - 9 * 55_560 - 3_620
        np.testing.assert_allclose(rows["range_m"].reshape(10, 40)[0, [0, 39]], [4.0, 5.56], atol=1e-9)
        assert (rows["intensity"].reshape(10, 40)[3] == np.arange(40)).all()
        # 359 degrees, turned back by 42.22 us at 10 revolutions a second
        assert np.degrees(rows["encoder_rad"][0]) == pytest.approx(359 - 3.6e-3 * 42.22, abs=1e-9)
        assert (rows["flags"] == RETURN_FLAG_STRONGEST).all()


def test_dual_returns_of_a_pandar40p_are_paired() -> None:
    """Blocks 1 and 2 are one firing: the return 4 mm farther is the last, and of equal ones the second is strongest."""
    unit = packet(PANDAR40P, MODE_LAST_STRONGEST, ranges=np.tile([[1001], [1000]], (5, 40)), light=9)
    rows = decode(unit, PANDAR40P)
    assert len(rows) == 400
    assert set(rows["number_of_returns"]) == {2}
    near, far = rows[0], rows[1]
    assert (near["flags"], far["flags"]) == (RETURN_FLAG_STRONGEST, RETURN_FLAG_LAST)
    assert (near["device_time_ns"] - NOON_NS, near["pulse_id"]) == (-28_580 - 4 * 55_560 - 42_220, far["pulse_id"])


def test_a_year_of_zero_is_2000_in_the_older_packets() -> None:
    """A head without a receiver counts from 2000; newer protocols put seconds since 1970 behind a year of 0."""
    rows = decode(pandar40p_by_hand(MODE_STRONGEST, 7, bytes((0, 1, 1, 0, 0, 1))), PANDAR40P)
    start_ns = int(dt.datetime(2000, 1, 1, 0, 0, 1, 250_000, tzinfo=dt.UTC).timestamp() * 1000) * 1_000_000
    assert rows["device_time_ns"][-1] - start_ns == -28_580 - 3_620


def test_a_pandar64_packet_computed_by_hand_is_decoded() -> None:
    """The packet has six blocks of 64 lasers behind a header of 8 bytes (HS_LIDAR_L64_Header)."""
    block = b"".join(struct.pack("<HB", 2000 + laser, laser) for laser in range(64))
    body = b"".join(struct.pack("<H", 1000 + 20 * number) + block for number in range(6))
    unit = b"\xee\xff" + bytes((64, 6, 0, 4, 0, 0)) + body + old_tail(MODE_STRONGEST, 250_000, NOON_2000)
    assert len(unit) == 1198
    rows = decode(unit, PANDAR64)
    times = rows["device_time_ns"].reshape(6, 64) - NOON_NS
    assert times[5, 0] == -42_580 - 23_180
    assert times[0, 11] == -42_580 - 5 * 55_560 - 54_668
    np.testing.assert_allclose(rows["range_m"][:64], 8 + 0.004 * np.arange(64), atol=1e-9)
    assert np.degrees(rows["encoder_rad"][64]) == pytest.approx(10.2 - 3.6e-3 * 23.18, abs=1e-9)
    for at, new in ((2, 63), (3, 7), (5, 3), (0, 0)):
        parser = HesaiParser(DeviceSettings("scanner/left"), PANDAR64)
        parser.feed(Chunk("scanner/left", 0, unit[:at] + bytes([new]) + unit[at + 1 :]))
        assert parser.counters.errors == {"bad_header": 1}


def packet_128_by_hand(operation: int, azimuth_flag: int, ranges: tuple[int, int]) -> bytes:
    """Return a packet of protocol 1.4 with functional safety, IMU and UDP sequence: 861 bytes."""
    header = b"\xee\xff" + bytes((1, 4, 0, 0, 128, 2, 0, 4, 1, 0b111))
    body = b"".join(
        struct.pack("<H", 9000 + 10 * number) + struct.pack("<HB", ranges[number], 50) * 128 for number in range(2)
    )
    tail = bytes(9) + struct.pack("<HBBH6sIB", azimuth_flag, operation, 0x37, 600, NOON_1900, 250_000, 0x42)
    unit = header + body + bytes(4) + bytes(17) + tail + struct.pack("<I", 9) + bytes(22) + bytes(4)
    assert len(unit) == 861
    return unit


@pytest.mark.parametrize(
    ("head", "operation", "azimuth_flag", "ranges", "want"),
    [  # (laser, block): nanoseconds after the stamp; the table's row of laser 1 is 4436 far and 5201 near in mode 2
        (PANDAR128, 2, 0, (5000, 5000), {(1, 2): 3148 + 4436, (1, 1): 3148 - 55_556 + 4436, (2, 2): 3148 + 28_554}),
        (PANDAR128, 2, 0, (5000, 712), {(1, 2): 3148 + 5201, (1, 1): 3148 - 55_556 + 4436}),
        (PANDAR128, 3, 0, (5000, 713), {(1, 2): 3148 + 4436}),
        (PANDAR128, 0, 0b00_01 << 12, (5000, 5000), {(1, 1): 3148 - 27_778 + 4436, (2, 2): 3148 + 776, (1, 2): 3148}),
        (OT128, 0, 0b01_10 << 12, (5000, 5000), {(1, 1): -27_778 + 18_867, (3, 2): 21_011, (4, 2): 6289}),
        (OT128, 2, 0b00_01 << 12, (5000, 5000), {(3, 1): -55_556 + 18_867, (3, 2): 21_011, (1, 2): 46_645}),
        (OT128, 9, 0, (5000, 5000), {(1, 1): -55_556, (128, 2): 0}),
    ],
)
def test_firing_times_of_128_lasers_follow_the_tables(
    head: HesaiHead, operation: int, azimuth_flag: int, ranges: tuple[int, int], want: dict[tuple[int, int], int]
) -> None:
    """Times come from the tables of HesaiLidar_SDK_2.0; 712 units of 4 mm are less than 2.85 m, so count as near."""
    rows = decode(packet_128_by_hand(operation, azimuth_flag, ranges), head)
    times = rows["device_time_ns"].reshape(2, 128) - NOON_NS
    assert {at: int(times[at[1] - 1, at[0] - 1]) for at in want} == want
    turn_deg = 3.6e-6 * (times[1, 0] - head.start_ns)
    assert np.degrees(rows["encoder_rad"].reshape(2, 128)[1, 0]) == pytest.approx(90.1 + turn_deg, abs=1e-9)


def test_codes_among_the_ranges_of_an_ot128_are_no_returns() -> None:
    """Nebula gives their meaning: 1 is too near, 2 too near for far lasers, and 3 no return."""
    assert len(decode(packet_128_by_hand(2, 0, (3, 4)), OT128)) == 128
    assert len(decode(packet_128_by_hand(2, 0, (3, 4)), PANDAR128)) == 256


def test_optional_parts_of_128_lasers_are_found_by_the_flags() -> None:
    """Each combination has a length of its own, except that confidence, weight and light take the same space."""
    layouts = PANDAR128.layouts()
    assert len(layouts) == 16 * 4
    assert {861, 1117} <= set(layouts)
    assert sum(int(layout.fits.sum()) for layout in layouts.values()) == 256
    unit = packet_128_by_hand(2, 0, (5000, 5000))
    parser = HesaiParser(DeviceSettings("scanner/left"), PANDAR128)
    parser.feed(Chunk("scanner/left", 0, unit[:11] + b"\x17" + unit[12:]))
    assert parser.counters.errors == {"bad_header": 1}


@EVERY_HEAD
def test_packets_do_not_depend_on_how_batches_are_cut(head: HesaiHead) -> None:
    random = np.random.default_rng(5)
    shape = (head.blocks, head.channels)
    units = [
        packet(
            head,
            MODE_LAST_STRONGEST if at % 7 > 3 else MODE_STRONGEST,
            NOON.replace(microsecond=250_000 + 300 * at),
            random.integers(0, 2, shape) * random.integers(1, 65_536, shape),
            random.integers(0, 256, shape),
            None if at % 11 == 10 else at,
            **({"operation": at % 4, "azimuth_flag": at << 9 & 0xFFFF} if head.channels == 128 else {}),
        )
        for at in range(40)
    ]
    check_packets(lambda: HesaiParser(DeviceSettings("scanner/left"), head), units, seeds=(1,))
    check_packet_damage(lambda: HesaiParser(DeviceSettings("scanner/left"), head), units[:8], examples=15)


@pytest.mark.parametrize("protocol", HEADS)
def test_made_packets_are_decoded_by_their_driver(protocol: str) -> None:
    driver = find_driver("scanner", protocol)
    units = [unit for unit in payloads("hesai/made_pandar.pcap.gz") if len(unit) in HEADS[protocol].layouts()]
    assert len(units) >= 20
    parser = driver.make_parser(DeviceSettings("scanner/left"))
    assert isinstance(parser, HesaiParser)
    assert len(returns_of(feed(parser, units))) > 1000
    assert parser.counters.messages == {"points": len(units)}
    assert driver.make_time_parser is not None
    assert {type(one) for one in feed(driver.make_time_parser(DeviceSettings("x")), units)} == {DeviceClockSamples}
