"""Tests Hesai heads: the manuals' figures, every return mode, damage on the wire, GPS data packets."""

from __future__ import annotations

import datetime as dt

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from swath.drivers.driver import find_driver
from swath.drivers.parser import DeviceSettings, DriverSettingsError
from swath.drivers.scanner.beams import beam_points
from swath.drivers.scanner.hesai.gps import encode_gps_packet
from swath.drivers.scanner.hesai.heads import (
    MODE_FIRST,
    MODE_FIRST_LAST_STRONGEST,
    MODE_FIRST_SECOND,
    MODE_FIRST_STRONGEST,
    MODE_LAST,
    MODE_LAST_FIRST,
    MODE_LAST_STRONGEST,
    MODE_SECOND,
    MODE_STRONGEST,
    MODE_STRONGEST_SECOND,
    HesaiHead,
    echoes_of,
    read_angle_file,
)
from swath.drivers.scanner.hesai.models import QT64, QT128, XT16, XT32, XT32M2X
from swath.drivers.scanner.hesai.parser import HesaiParser, encode_point_packet
from swath.georef.records import (
    RETURN_FLAG_LAST,
    RETURN_FLAG_PPS_LOCKED,
    RETURN_FLAG_STRONGEST,
    Chunk,
    DeviceClockSamples,
    DeviceStatus,
    NamesEdge,
    Record,
    ScannerReturns,
    TimeMessage,
)
from swath.georef.timescales import DeviceClock
from tests.builders import START_S, host_clock, host_ns
from tests.drivers.builders import clock_of, feed, returns_of
from tests.drivers.recordings import FIXTURES
from tests.drivers.scanner.hesai.builders import MODELS, NOON, NOON_NS, decode, packet

# --- the manuals' figures -------------------------------------------------------------------------------------------


def test_firing_times_follow_the_xt32_manual() -> None:
    """By appendix II, PandarXT, block N is at t0 + 5.632 − 50 (8 − N) µs, channel n at 0.368 + 1.512 (n − 1) µs."""
    times = decode(packet())["device_time_ns"].reshape(8, 32) - NOON_NS
    for block, channel, want_us in ((8, 1, 6.0), (8, 32, 52.872), (1, 1, -344.0), (7, 2, -42.488)):
        assert times[block - 1, channel - 1] == round(1000 * want_us)
    times = decode(packet(mode=MODE_LAST_STRONGEST))["device_time_ns"].reshape(4, 32) - NOON_NS
    assert times[3, 0] == 6_000  # blocks 7 and 8
    assert times[0, 31] == -150_000 + 52_872  # blocks 1 and 2


def test_firing_times_follow_the_qt64_driver() -> None:
    """HesaiLidar_General_ROS has 25.71 µs + 166.67 µs per round + 10 µs + the channel's own time."""
    times = decode(packet(QT64), QT64)["device_time_ns"].reshape(4, 64) - NOON_NS
    for block, channel, want_us in ((1, 1, 38.02), (4, 1, 538.02), (2, 64, 338.827), (3, 17, 405.653)):
        assert times[block - 1, channel - 1] == pytest.approx(1000 * want_us, abs=1)
    times = decode(packet(QT64, MODE_LAST_FIRST), QT64)["device_time_ns"].reshape(2, 64) - NOON_NS
    assert times[1, 0] == pytest.approx(25_710 + 166_667 + 12_310, abs=1)  # blocks 3 and 4


@pytest.mark.parametrize(
    ("mode", "block", "channel", "want_us"),
    [  # of the XT16: 5.632 + 0.368 µs, 3.024 µs a channel; of the XT32M2X: 2.888 µs a pair of channels; 50 µs a round
        (MODE_STRONGEST, 8, 16, 51.36),
        (MODE_STRONGEST, 1, 1, -344.0),
        (MODE_LAST_STRONGEST, 4, 2, -90.976),
    ],
)
def test_firing_times_follow_the_xt16_tables(mode: int, block: int, channel: int, want_us: float) -> None:
    times = decode(packet(XT16, mode), XT16)["device_time_ns"].reshape(-1, 16) - NOON_NS
    assert times[(block - 1) // echoes_of(mode), channel - 1] == round(1000 * want_us)


@pytest.mark.parametrize(
    ("mode", "block", "channel", "want_us"),
    [
        (MODE_STRONGEST, 6, 17, 6.0),
        (MODE_STRONGEST, 1, 32, 49.32 - 250),
        (MODE_SECOND, 1, 16, 49.32 - 250),
        (MODE_FIRST_SECOND, 3, 2, 8.888 - 50),
        (MODE_FIRST_LAST_STRONGEST, 3, 1, 6.0 - 50),
        (MODE_FIRST_LAST_STRONGEST, 4, 1, 6.0),
    ],
)
def test_firing_times_follow_the_xt32m2x_tables(mode: int, block: int, channel: int, want_us: float) -> None:
    """By udp6_1_parser.cc a round of one, two or three blocks fires 50 µs before the next one."""
    times = decode(packet(XT32M2X, mode), XT32M2X)["device_time_ns"].reshape(-1, 32) - NOON_NS
    assert times[(block - 1) // echoes_of(mode), channel - 1] == round(1000 * want_us)


@pytest.mark.parametrize(
    ("mode", "flag", "block", "channel", "want_us"),
    [  # firetime correction file: laser 99 is the first of loop 1, the second of loop 2; laser 1 fires in loop 2 only
        (MODE_STRONGEST, 0, 1, 99, 9 + 1.456),
        (MODE_STRONGEST, 0, 2, 99, 9 + 111.11 + 0.6),
        (MODE_STRONGEST, 1, 1, 99, 9 + 0.6),
        (MODE_STRONGEST, 0, 1, 1, 9 + 2.312),
        (MODE_LAST_STRONGEST, 0, 1, 65, 9 + 0.6),
        (MODE_LAST_STRONGEST, 1, 1, 61, 9 + 100.52),
    ],
)
def test_firing_times_follow_the_loops_of_the_qt128(
    mode: int, flag: int, block: int, channel: int, want_us: float
) -> None:
    """In udp3_2_parser.cc the azimuth advances by the loop's time too, at 600 rpm by 3.6e-3° per µs."""
    rows = decode(packet(QT128, mode, mode_flag=flag), QT128)
    at = (block - 1) // echoes_of(mode), channel - 1
    assert rows["device_time_ns"].reshape(-1, 128)[at] - NOON_NS == round(1000 * want_us)
    in_round_us = want_us - 9 - 111.11 * at[0]
    turned = np.degrees(rows["encoder_rad"].reshape(-1, 128)[at])
    assert turned == pytest.approx(10 + 0.18 * at[0] + 3.6e-3 * in_round_us, abs=1e-9)


def test_azimuth_is_advanced_to_each_firing() -> None:
    """10 rev/s are 3.6° in a millisecond, also across 0°."""
    azimuth = (35_990 + 18 * np.arange(8)) % 36_000
    unit = encode_point_packet(NOON, azimuth, np.full((8, 32), 100), 1, motor_rpm=600)
    rows = decode(unit)
    degrees = np.degrees(rows["encoder_rad"]).reshape(8, 32)
    want = (359.9 + 0.18 * np.arange(8)[:, np.newaxis] + 3.6e-3 * (6.0 + 1.512 * np.arange(32))) % 360
    np.testing.assert_allclose(degrees, want, atol=1e-9)
    assert (rows["encoder_rad"] < 2 * np.pi).all()


@pytest.mark.parametrize(
    ("mode", "flags"),
    [(MODE_FIRST, 0), (MODE_STRONGEST, RETURN_FLAG_STRONGEST), (MODE_LAST, RETURN_FLAG_LAST)],
)
def test_single_return_modes_are_flagged(mode: int, flags: int) -> None:
    assert (decode(packet(mode=mode))["flags"] == flags).all()


@pytest.mark.parametrize(
    ("mode", "pair", "want"),
    [  # ((range, reflectivity) of the odd and of the even block), [(range, flags)]
        (MODE_LAST_STRONGEST, ((900, 5), (400, 9)), [(400, 1), (900, 2)]),
        (MODE_LAST_STRONGEST, ((900, 9), (400, 5)), [(400, 0), (900, 3)]),
        (MODE_LAST_STRONGEST, ((900, 9), (900, 9)), [(900, 3)]),
        (MODE_LAST_FIRST, ((900, 9), (400, 5)), [(400, 0), (900, 2)]),
        (MODE_LAST_FIRST, ((900, 9), (900, 9)), [(900, 3)]),
        (MODE_FIRST_STRONGEST, ((400, 5), (900, 9)), [(400, 0), (900, 1)]),
        (MODE_FIRST_STRONGEST, ((400, 9), (900, 5)), [(400, 1), (900, 0)]),
        (MODE_LAST_STRONGEST, ((0, 0), (0, 0)), []),
        (MODE_FIRST_SECOND, ((400, 5), (900, 9)), [(400, 0), (900, 0)]),
        (MODE_STRONGEST_SECOND, ((400, 9), (900, 5)), [(400, 1), (900, 0)]),
    ],
)
def test_dual_return_modes_follow_the_manual(
    mode: int, pair: tuple[tuple[int, int], tuple[int, int]], want: list[tuple[int, int]]
) -> None:
    """The table is that of the PandarXT-16 User Manual 3.1.2; the last two modes are of udp_protocol_v3_2.h."""
    head = QT128 if mode in (MODE_FIRST_SECOND, MODE_STRONGEST_SECOND) else XT32
    ranges, light = np.zeros((head.blocks, head.channels), dtype=int), np.zeros((head.blocks, head.channels), dtype=int)
    ranges[:2, 5], light[:2, 5] = [one[0] for one in pair], [one[1] for one in pair]
    parser = HesaiParser(DeviceSettings("scanner/left"), head)
    records = parser.feed(Chunk("scanner/left", 1, packet(head, mode, ranges=ranges, light=light)))
    rows = [record.rows for record in records if isinstance(record, ScannerReturns)]
    got = [(round(row["range_m"] / 0.004), int(row["flags"])) for table in rows for row in table]
    assert got == want
    assert all((table["number_of_returns"] == len(want)).all() and (table["channel"] == 5).all() for table in rows)


@pytest.mark.parametrize(
    ("triple", "want"),
    [  # (range, reflectivity) of first, last, strongest; [(range, flags)]
        (((400, 5), (900, 4), (600, 9)), [(400, 0), (600, 1), (900, 2)]),
        (((400, 9), (900, 4), (400, 9)), [(400, 1), (900, 2)]),
        (((400, 5), (900, 9), (900, 9)), [(400, 0), (900, 3)]),
        (((400, 5), (900, 5), (600, 5)), [(400, 0), (600, 1), (900, 2)]),
        (((400, 5), (400, 5), (400, 5)), [(400, 3)]),
        (((0, 0), (0, 0), (0, 0)), []),
        (((0, 3), (700, 1), (0, 0)), [(700, 3)]),
    ],
)
@pytest.mark.parametrize("compiled", [False, True])
def test_three_returns_are_ordered_and_named(
    triple: tuple[tuple[int, int], ...], want: list[tuple[int, int]], compiled: bool
) -> None:
    """Blocks 4 to 6 of an XT32M2X are used; distances are in the header's unit: 5 mm here, 4 mm in the encoder."""
    ranges, light = np.zeros((6, 32), dtype=int), np.zeros((6, 32), dtype=int)
    ranges[3:6, 5], light[3:6, 5] = [one[0] for one in triple], [one[1] for one in triple]
    unit = bytearray(packet(XT32M2X, MODE_FIRST_LAST_STRONGEST, ranges=ranges, light=light))
    unit[9] = 5
    parser = HesaiParser(DeviceSettings("scanner/left", compiled=compiled), XT32M2X)
    records = parser.feed(Chunk("scanner/left", 1, bytes(unit)))
    rows = [row for record in records if isinstance(record, ScannerReturns) for row in record.rows]
    assert [(round(row["range_m"] / 0.005), int(row["flags"])) for row in rows] == want
    assert [row["return_number"] for row in rows] == list(range(1, len(want) + 1))
    assert {row["number_of_returns"] for row in rows} <= {len(want)}
    assert {row["channel"] for row in rows} <= {5}


def test_design_angles_are_used_without_an_angle_file() -> None:
    parser = HesaiParser(DeviceSettings("scanner/left"), XT32)
    rows = returns_of(parser.feed(Chunk("scanner/left", 1, packet())))[:32].copy()
    rows["encoder_rad"], rows["range_m"] = np.radians(123.0), 50.0
    rows["channel"] = 24  # −9° by the manual's table: FORMULAS 2.2's example
    np.testing.assert_allclose(beam_points(rows, parser.beams)[0], [41.417257, -26.896681, -7.821723], atol=1e-6)
    for name, head, within_deg in (
        ("QT64", QT64, 0),
        ("QT128", QT128, 5e-5),
        ("XT16", XT16, 0),
        ("XT32M", XT32M2X, 0.25),  # this table is measured instead of designed
    ):
        own = read_angle_file((FIXTURES / "hesai" / f"calib_Pandar{name}.csv").read_bytes(), head)
        np.testing.assert_allclose(head.beams.elevation_deg, own.elevation_deg, rtol=0, atol=within_deg)
        np.testing.assert_allclose(head.beams.azimuth_deg, own.azimuth_deg, rtol=0, atol=within_deg)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda text: text.replace("7,8.917419,", "7,up,"), "line 8"),
        (lambda text: text.replace("7,8.917419,", "7,98.9,"), "line 8"),
        (lambda text: text.replace("\n7,", "\n6,"), "channel 6 appears twice"),
        (lambda text: text[: text.index("\n32,")], "31 channels, want channels 1 to 32"),
        (lambda text: text + "33,0,0\n", "33 channels"),
        (lambda _: "", "0 channels"),
        (lambda _: "\0\xff" * 99, "0 channels"),
    ],
)
def test_impossible_angle_files_are_refused(change: object, says: str) -> None:
    text = (FIXTURES / "hesai" / "calib_PandarXT32.csv").read_text()
    broken = DeviceSettings("scanner/left", {}, {"geometry": change(text).encode()})  # type: ignore[operator]
    with pytest.raises(DriverSettingsError, match=says):
        HesaiParser(broken, XT32)


@given(seed=st.integers(0, 2**32 - 1), head=st.sampled_from([model.head for model in MODELS]))
@settings(max_examples=40, deadline=None)
def test_encoded_packets_are_decoded_to_their_input(seed: int, head: HesaiHead) -> None:
    random = np.random.default_rng(seed)
    mode = int(random.choice([one for one in head.modes if echoes_of(one) == 1]))
    shape = (head.blocks, head.channels)
    ranges = random.integers(0, 2, shape) * random.integers(0, 65_536, shape)
    light = random.integers(0, 256, shape)
    second = int(random.integers(0, 2**31))
    time = dt.datetime.fromtimestamp(second, dt.UTC).replace(microsecond=int(random.integers(0, 10**6)))
    rows = decode(packet(head, mode, time, ranges, light), head)
    there = ranges > 0
    np.testing.assert_array_equal(np.rint(rows["range_m"] / (head.units_mm[0] * 1e-3)).astype(np.int64), ranges[there])
    np.testing.assert_array_equal(rows["intensity"], light[there])
    np.testing.assert_array_equal(rows["channel"], np.broadcast_to(np.arange(head.channels), shape)[there])
    states = np.arange(1, head.blocks + 1) % len(head.offset_ns)
    start = head.round_start_ns(head.blocks)[:, np.newaxis] + head.offset_ns[states]
    np.testing.assert_array_equal(rows["device_time_ns"], second * 10**9 + time.microsecond * 1000 + start[there])


def utc_at(head: HesaiHead) -> int:
    """Return the offset of the date in a packet."""
    fields = head.packet_dtype().fields
    assert fields is not None
    return int(fields["utc"][1])


def test_a_date_in_seconds_since_1970_is_decoded() -> None:
    """In HesaiLidar_SDK_2.0 a year of 0 is followed by seconds since 1970, highest byte first."""
    unit = bytearray(packet())
    at = utc_at(XT32)
    unit[at : at + 6] = b"\0\0" + (1_795_262_400).to_bytes(4, "big")
    assert decode(bytes(unit))["device_time_ns"][-1] == NOON_NS + 52_872


@pytest.mark.parametrize(("head", "year"), [(QT64, 26), (QT64, 126), (XT32, 126), (XT32, 226)])
def test_a_year_of_either_century_is_decoded(head: HesaiHead, year: int) -> None:
    """These are 2026 by HesaiLidar_SDK_2.0, udp_protocol_v3_1.h and v6_1.h, GetMicroLidarTimeU64."""
    unit = bytearray(packet(head))
    unit[utc_at(head)] = year
    np.testing.assert_array_equal(decode(bytes(unit), head), decode(packet(head), head))


def test_qt64_packets_without_udp_sequence_are_decoded() -> None:
    units = [packet(QT64, time=NOON.replace(microsecond=667 * at), sequence=None) for at in range(3)]
    assert {len(unit) for unit in units} == {1068}
    parser = HesaiParser(DeviceSettings("scanner/left"), QT64)
    rows = returns_of(feed(parser, units))
    np.testing.assert_array_equal(rows["pulse_id"], np.arange(3 * 256))
    assert HesaiParser(DeviceSettings("x"), XT32).feed(Chunk("x", 0, bytes(1076))) == []


# --- damaged on the wire --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("at", "new", "code"),
    [
        (0, b"\xef", "bad_header"),
        (2, b"\x03", "wrong_product"),
        (6, b"\x10", "bad_header"),
        (7, b"\x06", "bad_header"),
        (9, b"\x02", "bad_header"),
        (11, b"\x00", "bad_header"),
        (13, b"\x8c", "bad_azimuth"),
        (1062, b"\x3d", "bad_return_mode"),
        (1066, b"\x0d", "bad_time"),
        (1067, b"\x00", "bad_time"),
        (1068, b"\x18", "bad_time"),
        (1074, b"\x7f", "bad_time"),
    ],
)
def test_impossible_packets_are_counted(at: int, new: bytes, code: str) -> None:
    good = [packet(time=NOON.replace(microsecond=400 * one), sequence=one) for one in range(3)]
    parser = HesaiParser(DeviceSettings("scanner/left"), XT32)
    rows = returns_of(feed(parser, [good[0], good[1][:at] + new + good[1][at + len(new) :], good[2]]))
    assert parser.counters.errors == {code: 1, "sequence_gap": 1}
    assert parser.counters.bad_messages == 1
    assert parser.counters.bytes_skipped == 1080
    np.testing.assert_array_equal(np.unique(rows["host_time_ns"]), [0, 2_000_000])


@pytest.mark.parametrize("at", [14, 700, 1043, 1070, 1090, 1094])
def test_packets_of_a_qt128_with_a_wrong_checksum_are_counted(at: int) -> None:
    good = [packet(QT128, time=NOON.replace(microsecond=400 * one), sequence=one) for one in range(3)]
    parser = HesaiParser(DeviceSettings("scanner/left"), QT128)
    rows = returns_of(feed(parser, [good[0], good[1][:at] + bytes([good[1][at] ^ 1]) + good[1][at + 1 :], good[2]]))
    assert (parser.counters.bad_checksums, parser.counters.bytes_skipped) == (1, 1127)
    assert parser.counters.errors == {"sequence_gap": 1}
    np.testing.assert_array_equal(np.unique(rows["host_time_ns"]), [0, 2_000_000])


def test_lengths_of_a_qt128_follow_the_flags_of_its_header() -> None:
    """udp_protocol_v3_2.h has 256 bytes of confidence, 17 of safety, 4 of sequence, 32 of signature, 818 without."""
    layouts = QT128.layouts()
    assert len(layouts) == 16
    assert min(layouts) == 12 + 2 * (2 + 3 * 128) + 4 + 26 + 4
    assert max(layouts) == min(layouts) + 256 + 17 + 4 + 32 == 1127
    bare = decode(packet(QT128, sequence=None), QT128)
    np.testing.assert_array_equal(bare["range_m"], decode(packet(QT128), QT128)["range_m"])


def test_truncated_packets_are_counted() -> None:
    unit = packet()
    parser = HesaiParser(DeviceSettings("scanner/left"), XT32)
    for length in range(1080):
        assert parser.feed(Chunk("scanner/left", 0, unit[:length])) == []
    assert parser.counters.errors == {"bad_length": 1079, "bad_gps": 1}
    assert parser.counters.bytes_skipped == parser.counters.bytes == 1080 * 1079 // 2


# --- GPS data packets -----------------------------------------------------------------------------------------------


def run(*units: bytes) -> tuple[HesaiParser, list[Record]]:
    parser = HesaiParser(DeviceSettings("scanner/left"), XT32)
    return parser, feed(parser, list(units))


def test_the_example_gps_packet_of_the_manual_is_decoded() -> None:
    """In the PandarXT-16 and PandarXT User Manual 3.2.3 this is 2020-04-07 04:07:58.

    The bytes are 30 32 34 30 37 30 and 38 35 37 30 34 30.
    """
    unit = encode_gps_packet(dt.datetime(2020, 4, 7, 4, 7, 58, 120, tzinfo=dt.UTC))
    assert unit[:14] == bytes.fromhex("ffee 303234303730 383537303430")
    assert unit[18:102].rstrip(b"\0") == b""
    assert unit[102:506] == b"\xdf" * 404
    assert unit[506:508] == b"A\x01"
    parser, records = run(unit)
    [message] = [record for record in records if isinstance(record, TimeMessage)]
    assert message.time.date == dt.date(2020, 4, 7)
    assert message.time.time_ns == (4 * 3600 + 7 * 60 + 58) * 10**9
    assert message.names_edge is NamesEdge.PREVIOUS
    assert message.valid
    assert not message.bound
    [status] = [record.values for record in records if isinstance(record, DeviceStatus)]
    assert status == {"pps_locked": True, "gps_status": "valid"}
    clock = clock_of(records)
    assert clock["device_time_ns"][0] - clock["pps_time_ns"][0] == 120_000
    assert clock["locked"][0] == 1
    assert parser.counters.messages == {"gps": 1}


def test_a_locked_head_latches_the_whole_second() -> None:
    point = [packet(time=NOON.replace(microsecond=400 * at), sequence=at) for at in range(4)]
    locked = encode_gps_packet(NOON.replace(microsecond=30))
    lost = encode_gps_packet(NOON.replace(microsecond=30, second=1), locked=False)
    _, records = run(point[0], locked, point[1], lost, point[2])
    clock = clock_of(records)
    assert clock["locked"].tolist() == [-1, 1, 1, 0, 0]
    assert clock["pps_time_ns"].tolist() == [-1, NOON_NS - 250_000_000, NOON_NS - 250_000_000, -1, -1]
    rows = returns_of(records)
    flagged = (rows["flags"] & RETURN_FLAG_PPS_LOCKED) != 0
    np.testing.assert_array_equal(flagged, rows["host_time_ns"] == 2_000_000)


def test_a_locked_head_is_timed_by_its_latches_and_an_unlocked_one_by_arrival() -> None:
    """`DeviceClock` is right to the head's microseconds while locked, whatever the delay, else it uses arrivals."""
    parser = find_driver("scanner", "hesai-xt32").make_time_parser
    assert parser is not None
    random, host = np.random.default_rng(3), host_clock(70)
    for locked in (True, False):
        head, clock = parser(DeviceSettings("scanner/left")), DeviceClock(host)
        for tenth in range(51, 601):
            time = dt.datetime(2026, 11, 21, 12, 0, 0, 123_000, tzinfo=dt.UTC) + dt.timedelta(seconds=tenth / 10)
            arrival = int(host_ns(tenth / 10 + 0.123 + 0.02 * random.random()))
            units = [encode_gps_packet(time.replace(microsecond=20), locked=locked)] if tenth % 10 == 1 else []
            for unit in [*units, packet(time=time, sequence=tenth)]:
                for record in head.feed(Chunk("scanner/left", arrival, unit)):
                    if isinstance(record, DeviceClockSamples):
                        clock.add(record.rows)
        true_s = np.arange(10.0, 55.0, 0.37)
        device = NOON_NS - 250_000_000 + np.rint(true_s * 1e9).astype(np.int64)
        gps, sigma = clock.gps_from_device(device)
        error_ns = gps - START_S * 10**9 - np.rint(true_s * 1e9)
        assert clock.status().latched is locked
        assert np.abs(error_ns).max() < (300 if locked else 20e6)
        assert (sigma < 1e5).all() == locked


@pytest.mark.parametrize(
    ("status", "locked", "valid", "name"),
    [
        (b"A", True, True, "valid"),
        (b"A", False, False, "valid"),
        (b"V", True, False, "invalid"),
        (b"\0", True, False, "none"),
        (b"0", True, False, "invalid"),
        (b"2", True, True, "valid"),
        (b"4", True, True, "valid"),
        (b"5", True, True, "valid"),
        (b"6", True, False, "estimated"),
        (b"8", True, False, "simulated"),
        (b"9", True, True, "valid"),
    ],
)
def test_time_is_valid_only_if_the_head_is_locked_and_has_a_position(
    status: bytes, locked: bool, valid: bool, name: str
) -> None:
    _, records = run(encode_gps_packet(NOON, status=status, locked=locked))
    assert [r.valid for r in records if isinstance(r, TimeMessage)] == [valid]
    assert [r.values["gps_status"] for r in records if isinstance(r, DeviceStatus)] == [name]


def test_a_date_one_rollover_behind_is_corrected_in_the_time_message() -> None:
    """2006-11-06 is 1024 weeks before 2026-06-22; device times stay as the head counts them."""
    parser = HesaiParser(DeviceSettings("scanner/left"), XT32)
    host_ns = int(dt.datetime(2026, 6, 22, 12, tzinfo=dt.UTC).timestamp()) * 10**9
    records = [
        record
        for day in (dt.datetime(2006, 11, 6, 12, tzinfo=dt.UTC), dt.datetime(2005, 1, 1, 12, tzinfo=dt.UTC))
        for record in parser.feed(Chunk("scanner/left", host_ns, encode_gps_packet(day)))
    ]
    moved, refused = [record for record in records if isinstance(record, TimeMessage)]
    assert (moved.time.date, moved.valid) == (dt.date(2026, 6, 22), True)
    assert (refused.time.date, refused.valid) == (dt.date(2005, 1, 1), False)
    assert parser.counters.errors == {"date_before_floor": 1}
    assert (
        clock_of(records)["device_time_ns"][0] == int(dt.datetime(2006, 11, 6, 12, tzinfo=dt.UTC).timestamp()) * 10**9
    )
    assert [line.partition(",")[0] for line in parser.remarks()] == [
        "scanner/left: sends the date 2006-11-06",
        "scanner/left: sends the date 2005-01-01",
    ]


@pytest.mark.parametrize(
    ("at", "new"),
    [(0, b"\xfe"), (2, b"A"), (4, b"31"), (8, b"16"), (12, b"52"), (506, b"?"), (507, b"\x02")],
)
def test_impossible_gps_packets_are_counted(at: int, new: bytes) -> None:
    unit = encode_gps_packet(NOON)
    parser, records = run(unit, unit[:at] + new + unit[at + len(new) :])
    assert parser.counters.errors == {"bad_gps": 1}
    assert parser.counters.bytes_skipped == 512
    assert len(clock_of(records)) == 1


def test_the_highest_rates_are_those_of_the_data_sheets() -> None:
    """PandarXT-32: 1,280,000 points a second in dual return, 256 a packet; PandarQT: 768,000, 256 a packet."""
    assert XT32.bytes_per_s == pytest.approx(1_280_000 / 256 * 1080)
    assert QT64.bytes_per_s == pytest.approx(768_000 / 256 * 1072)
