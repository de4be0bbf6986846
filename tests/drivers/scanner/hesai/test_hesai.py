"""PandarXT-32 and PandarQT: real dual-return recordings against nebula's clouds, the manuals' figures, damage."""

from __future__ import annotations

import datetime as dt
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike

from swath.drivers.driver import find_driver
from swath.drivers.parser import DeviceSettings, DriverSettingsError
from swath.drivers.scanner.beams import beam_points
from swath.drivers.scanner.hesai.gps import encode_gps_packet
from swath.drivers.scanner.hesai.heads import QT64, XT32, HesaiHead, read_angle_file
from swath.drivers.scanner.hesai.parser import (
    DUAL_NAMES,
    MODE_FIRST,
    MODE_FIRST_STRONGEST,
    MODE_LAST,
    MODE_LAST_FIRST,
    MODE_LAST_STRONGEST,
    MODE_STRONGEST,
    SINGLE_FLAGS,
    HesaiParser,
    encode_point_packet,
)
from swath.georef.arrays import StructArray
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
from tests.drivers.harness import check_packet_damage, check_packets
from tests.drivers.recordings import FIXTURES
from tests.drivers.spinning import are_near, payloads, read_pcd

XYZ = np.dtype([("x", "f4"), ("y", "f4"), ("z", "f4")])
NOON = dt.datetime(2026, 11, 21, 12, 0, 0, 250_000, tzinfo=dt.UTC)
NOON_NS = 1_795_262_400_250_000_000  # `date -u -d '2026-11-21 12:00:00' +%s`


@dataclass(frozen=True)
class Model:
    """A recording of a model and what is known of it."""

    head: HesaiHead
    capture: str
    angles: str
    cloud: str
    motor_rpm: int
    mode: int

    def settings(self) -> DeviceSettings:
        return DeviceSettings("scanner/left", {}, {"geometry": (FIXTURES / "hesai" / self.angles).read_bytes()})

    def parser(self) -> HesaiParser:
        return HesaiParser(self.settings(), self.head)


XT = Model(
    XT32, "hesai/nebula_xt32.pcap.gz", "calib_PandarXT32.csv", "nebula_xt32_golden_1673400678101968885", 599, 0x39
)
QT = Model(
    QT64, "hesai/nebula_qt64.pcap.gz", "calib_PandarQT64.csv", "nebula_qt64_golden_1673401196087570870", 600, 0x3B
)
MODELS = pytest.mark.parametrize("model", [XT, QT], ids=["xt32", "qt64"])


def packet(
    head: HesaiHead = XT32,
    mode: int = MODE_STRONGEST,
    time: dt.datetime = NOON,
    ranges: ArrayLike = 5000,
    light: ArrayLike = 7,
    sequence: int | None = 1,
) -> bytes:
    blocks = np.arange(head.blocks) // (2 if mode in DUAL_NAMES else 1)
    full = np.broadcast_to(np.asarray(ranges), (head.blocks, head.channels))
    return encode_point_packet(time, 1000 + 18 * blocks, full, light, mode, head=head, sequence=sequence)


def decode(unit: bytes, head: HesaiHead = XT32) -> StructArray:
    return returns_of(HesaiParser(DeviceSettings("scanner/left"), head).feed(Chunk("scanner/left", 1, unit)))


# --- real recordings ------------------------------------------------------------------------------------------------


@MODELS
def test_points_agree_with_the_golden_cloud_of_nebula(model: Model) -> None:
    """nebula leaves out the turn between the reading of the azimuth and the firing; without it every point is there."""
    parser = model.parser()
    rows = returns_of(feed(parser, payloads(model.capture)))
    assert parser.counters.errors == {}
    cloud = read_pcd(FIXTURES / "hesai" / f"{model.cloud}.pcd.gz", XYZ)
    theirs = np.stack([cloud["x"], cloud["y"], cloud["z"]], axis=1).astype(np.float64)
    turned = model.head.offset_ns[rows["channel"]] * (model.motor_rpm / 60 * 2 * np.pi * 1e-9)
    unturned = rows.copy()
    unturned["encoder_rad"] -= turned
    assert are_near(theirs, beam_points(unturned, parser.beams), 1e-4).all()
    assert len(theirs) > 30_000


@MODELS
def test_every_packet_of_a_recording_is_decoded_without_gaps(model: Model) -> None:
    units = payloads(model.capture)
    parser = model.parser()
    records = feed(parser, units)
    assert parser.counters.messages == {"points": len(units)}
    assert parser.counters.bytes == parser.counters.bytes_framed == sum(map(len, units))
    raw = np.frombuffer(b"".join(units), dtype=model.head.packet_dtype())
    assert (raw["mode"] == model.mode).all()
    np.testing.assert_allclose(raw["motor_rpm"], model.motor_rpm, atol=1)
    rows, clock = returns_of(records), clock_of(records)
    assert (clock["locked"] == -1).all()
    assert (clock["pps_time_ns"] == -1).all()
    pair = raw["blocks"]["returns"]["range"].reshape(len(units), -1, 2, model.head.channels)
    count = (pair.max(axis=2) > 0).sum() + ((pair.min(axis=2) > 0) & (pair[:, :, 0] != pair[:, :, 1])).sum()
    assert len(rows) == count
    steps_ns = np.diff(np.unique(rows["device_time_ns"]))
    assert steps_ns.max() < 60_000
    rounds = model.head.blocks // 2
    period_ns = rounds * model.head.round_ns
    np.testing.assert_allclose(np.diff(clock["device_time_ns"]), period_ns, atol=1500)  # stamps are microseconds
    first = rows[rows["channel"] == rows["channel"][0]]
    azimuth = np.unwrap(first["encoder_rad"])
    rev_per_s = np.ptp(azimuth) / (2 * np.pi) / (np.ptp(first["device_time_ns"]) * 1e-9)
    assert rev_per_s == pytest.approx(model.motor_rpm / 60, abs=0.02)


@MODELS
def test_dual_returns_are_numbered_by_range(model: Model) -> None:
    rows = returns_of(feed(model.parser(), payloads(model.capture)[:300]))
    two = rows["number_of_returns"] == 2
    first, last = rows[two & (rows["return_number"] == 1)], rows[two & (rows["return_number"] == 2)]
    assert len(first) == len(last) > 1000
    np.testing.assert_array_equal(first["pulse_id"], last["pulse_id"])
    np.testing.assert_array_equal(first["device_time_ns"], last["device_time_ns"])
    np.testing.assert_array_equal(first["encoder_rad"], last["encoder_rad"])
    assert (first["range_m"] < last["range_m"]).all()
    assert ((last["flags"] & RETURN_FLAG_LAST) != 0).all()
    assert ((first["flags"] & RETURN_FLAG_LAST) == 0).all()
    assert (rows["flags"][~two] == RETURN_FLAG_LAST | RETURN_FLAG_STRONGEST).all()
    assert len(np.unique(rows["pulse_id"])) == len(rows) - len(first)


@MODELS
def test_returns_do_not_depend_on_how_batches_are_cut(model: Model) -> None:
    gps = [encode_gps_packet(NOON.replace(microsecond=40, second=second), locked=second > 1) for second in range(4)]
    units = payloads(model.capture)[:200]
    for at, unit in enumerate(gps):
        units.insert(9 + 51 * at, unit)
    check_packets(model.parser, units)
    check_packets(lambda: HesaiParser(model.settings(), model.head, clock_only=True), units)
    check_packet_damage(model.parser, units[:20])


@MODELS
def test_lost_and_repeated_packets_are_counted(model: Model) -> None:
    units = payloads(model.capture)[:60]
    parser = model.parser()
    rows = returns_of(feed(parser, units[:20] + units[23:40] + units[39:40] + units[41:]))
    assert parser.counters.errors == {"sequence_gap": 4, "duplicate": 1}
    whole = returns_of(feed(model.parser(), units))
    assert set(np.diff(np.unique(rows["pulse_id"]))) >= set(np.diff(np.unique(whole["pulse_id"])))
    assert rows["pulse_id"][-1] == whole["pulse_id"][-1]


# --- the manuals' figures -------------------------------------------------------------------------------------------


def test_firing_times_follow_the_xt32_manual() -> None:
    """Appendix II, PandarXT: block N at t0 + 5.632 − 50 (8 − N) µs, channel n at 0.368 + 1.512 (n − 1) µs."""
    times = decode(packet())["device_time_ns"].reshape(8, 32) - NOON_NS
    for block, channel, want_us in ((8, 1, 6.0), (8, 32, 52.872), (1, 1, -344.0), (7, 2, -42.488)):
        assert times[block - 1, channel - 1] == round(1000 * want_us)
    times = decode(packet(mode=MODE_LAST_STRONGEST))["device_time_ns"].reshape(4, 32) - NOON_NS
    assert times[3, 0] == 6_000  # blocks 7 and 8
    assert times[0, 31] == -150_000 + 52_872  # blocks 1 and 2


def test_firing_times_follow_the_qt64_driver() -> None:
    """HesaiLidar_General_ROS: 25.71 µs + 166.67 µs a round + 10 µs + the channel's own."""
    times = decode(packet(QT64), QT64)["device_time_ns"].reshape(4, 64) - NOON_NS
    for block, channel, want_us in ((1, 1, 38.02), (4, 1, 538.02), (2, 64, 338.827), (3, 17, 405.653)):
        assert times[block - 1, channel - 1] == pytest.approx(1000 * want_us, abs=1)
    times = decode(packet(QT64, MODE_LAST_FIRST), QT64)["device_time_ns"].reshape(2, 64) - NOON_NS
    assert times[1, 0] == pytest.approx(25_710 + 166_667 + 12_310, abs=1)  # blocks 3 and 4


def test_azimuth_is_advanced_to_each_firing() -> None:
    """10 rev/s are 3.6° in a millisecond; across 0° too."""
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
    ],
)
def test_dual_return_modes_follow_the_manual(
    mode: int, pair: tuple[tuple[int, int], tuple[int, int]], want: list[tuple[int, int]]
) -> None:
    """PandarXT-16 User Manual 3.1.2, table of return modes."""
    ranges, light = np.zeros((8, 32), dtype=int), np.zeros((8, 32), dtype=int)
    ranges[2:4, 5], light[2:4, 5] = [one[0] for one in pair], [one[1] for one in pair]
    parser = HesaiParser(DeviceSettings("scanner/left"), XT32)
    records = parser.feed(Chunk("scanner/left", 1, packet(mode=mode, ranges=ranges, light=light)))
    rows = [record.rows for record in records if isinstance(record, ScannerReturns)]
    got = [(round(row["range_m"] / 0.004), int(row["flags"])) for table in rows for row in table]
    assert got == want
    assert all((table["number_of_returns"] == len(want)).all() and (table["channel"] == 5).all() for table in rows)


def test_design_angles_are_used_without_an_angle_file() -> None:
    parser = HesaiParser(DeviceSettings("scanner/left"), XT32)
    rows = returns_of(parser.feed(Chunk("scanner/left", 1, packet())))[:32].copy()
    rows["encoder_rad"], rows["range_m"] = np.radians(123.0), 50.0
    rows["channel"] = 24  # −9° by the manual's table: FORMULAS 2.2's example
    np.testing.assert_allclose(beam_points(rows, parser.beams)[0], [41.417257, -26.896681, -7.821723], atol=1e-6)
    own = read_angle_file((FIXTURES / "hesai" / "calib_PandarQT64.csv").read_bytes(), QT64)
    np.testing.assert_array_equal(QT64.beams.elevation_deg, own.elevation_deg)
    np.testing.assert_array_equal(QT64.beams.azimuth_deg, own.azimuth_deg)


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


@given(seed=st.integers(0, 2**32 - 1), mode=st.sampled_from(sorted(SINGLE_FLAGS)), qt=st.booleans())
@settings(max_examples=40, deadline=None)
def test_encoded_packets_are_decoded_to_their_input(seed: int, mode: int, qt: bool) -> None:
    head, random = QT64 if qt else XT32, np.random.default_rng(seed)
    shape = (head.blocks, head.channels)
    ranges = random.integers(0, 2, shape) * random.integers(0, 65_536, shape)
    light = random.integers(0, 256, shape)
    second = int(random.integers(0, 2**31))
    time = dt.datetime.fromtimestamp(second, dt.UTC).replace(microsecond=int(random.integers(0, 10**6)))
    rows = decode(packet(head, mode, time, ranges, light), head)
    there = ranges > 0
    np.testing.assert_array_equal(np.rint(rows["range_m"] / 0.004).astype(np.int64), ranges[there])
    np.testing.assert_array_equal(rows["intensity"], light[there])
    np.testing.assert_array_equal(rows["channel"], np.broadcast_to(np.arange(head.channels), shape)[there])
    start = head.round_start_ns(head.blocks)[:, np.newaxis] + head.offset_ns
    np.testing.assert_array_equal(rows["device_time_ns"], second * 10**9 + time.microsecond * 1000 + start[there])


def utc_at(head: HesaiHead) -> int:
    """Return the offset of the date in a packet."""
    fields = head.packet_dtype().fields
    assert fields is not None
    return int(fields["utc"][1])


def test_a_date_in_seconds_since_1970_is_decoded() -> None:
    """HesaiLidar_SDK_2.0: a year of 0 is followed by seconds since 1970, the highest byte first."""
    unit = bytearray(packet())
    at = utc_at(XT32)
    unit[at : at + 6] = b"\0\0" + (1_795_262_400).to_bytes(4, "big")
    assert decode(bytes(unit))["device_time_ns"][-1] == NOON_NS + 52_872


@pytest.mark.parametrize(("head", "year"), [(QT64, 26), (QT64, 126), (XT32, 126), (XT32, 226)])
def test_a_year_of_either_century_is_decoded(head: HesaiHead, year: int) -> None:
    """HesaiLidar_SDK_2.0, udp_protocol_v3_1.h and v6_1.h, GetMicroLidarTimeU64: 2026 in all of these."""
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
    """PandarXT-16 and PandarXT User Manual 3.2.3: 30 32 34 30 37 30 and 38 35 37 30 34 30 are 2020-04-07 04:07:58."""
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
    """Through `DeviceClock`: to its microseconds while locked, whatever the delay; by arrival while it is not."""
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
    """2006-11-06 is 1024 weeks before 2026-06-22. Device times stay as the head counts them."""
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


@pytest.mark.parametrize("protocol", ["hesai-xt32", "hesai-qt64"])
def test_the_driver_declares_its_records(protocol: str) -> None:
    driver = find_driver("scanner", protocol)
    assert driver.transports == ("udp",)
    assert driver.make_time_parser is not None
    model = XT if protocol == "hesai-xt32" else QT
    units = [*payloads(model.capture)[:100], encode_gps_packet(NOON)]
    records = feed(driver.make_time_parser(model.settings()), units)  # type: ignore[arg-type]
    given_types = {type(record) for record in records}
    assert given_types == {DeviceClockSamples, TimeMessage, DeviceStatus}
    assert given_types | {ScannerReturns} == set(driver.yields)
    parser = driver.make_parser(model.settings())
    assert isinstance(parser, HesaiParser)
    assert len(parser.beams) == model.head.channels
