"""Tests VLP-16: real recordings against two other decoders, the manual's figures, and damaged packets."""

from __future__ import annotations

import datetime as dt
import gzip
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from swath.drivers.driver import find_driver
from swath.drivers.parser import DeviceSettings
from swath.drivers.scanner.beams import beam_points
from swath.drivers.scanner.velodyne.heads import VLP16
from swath.drivers.scanner.velodyne.parser import (
    MODE_DUAL,
    MODE_LAST,
    MODE_STRONGEST,
    VelodyneParser,
    encode_data_packet,
)
from swath.drivers.scanner.velodyne.position import encode_position_packet, rmc_time
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
from tests.drivers.builders import feed, returns_of
from tests.drivers.harness import check_packet_damage, check_packets
from tests.drivers.spinning import payloads, read_pcd, ros_points, xyz

FIXTURES = Path(__file__).parents[4] / "fixtures" / "velodyne"
SETTINGS = DeviceSettings("scanner/left", {})
RING = np.argsort(np.argsort(VLP16.beams.elevation_deg))  # other decoders number lasers from the lowest
_XYZ, _ANGLES = [("x", "f4"), ("y", "f4"), ("z", "f4")], [("azimuth", "f4"), ("elevation", "f4"), ("distance", "f4")]
GOLDEN_DTYPE = np.dtype(
    [*_XYZ, ("intensity", "u1"), ("return_type", "u1"), ("channel", "u2"), *_ANGLES, ("time_stamp", "u4")]
)


def make_parser() -> VelodyneParser:
    return VelodyneParser(SETTINGS)


def recording() -> list[bytes]:
    data = gzip.decompress((FIXTURES / "vlp16-go_recording.bin.gz").read_bytes())
    return [data[at : at + 1206] for at in range(0, len(data), 1206)]


# --- real recordings ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "total"), [("mrpt_vlp16_gps", 73486), ("nebula_vlp16", 59414)])
def test_points_agree_with_velodyne_decoder(name: str, total: int) -> None:
    rows = returns_of(feed(make_parser(), [p for p in payloads(f"velodyne/{name}.pcap.gz") if len(p) == 1206]))
    assert len(rows) == total
    with np.load(FIXTURES / f"{name}.velodyne_decoder.npz") as archive:
        theirs = archive["points"]
    ours = rows[: len(theirs)]
    # the other decoder gives a pair's last return first; both are sorted by firing, then range
    their_range = np.linalg.norm(xyz(theirs), axis=1)
    theirs = theirs[np.lexsort([their_range, theirs["ring"], theirs["column"]])]
    column = np.unique(ours["device_time_ns"] - 2304 * ours["channel"].astype(np.int64), return_inverse=True)[1]
    ours = ours[np.lexsort([ours["range_m"], RING[ours["channel"]], column])]
    np.testing.assert_array_equal(RING[ours["channel"]], theirs["ring"])
    np.testing.assert_array_equal(ours["intensity"], theirs["intensity"])
    points = ros_points(ours, VLP16.beams)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), np.linalg.norm(xyz(theirs), axis=1), atol=2e-5)
    np.testing.assert_allclose(points[:, 2], theirs["z"], atol=1e-4)
    azimuth = np.arctan2(points[:, 1], points[:, 0]) - np.arctan2(theirs["y"], theirs["x"])
    assert np.degrees(np.abs(np.angle(np.exp(1j * azimuth))).max()) < 0.025  # theirs uses one speed per packet
    seconds = ours["device_time_ns"] * 1e-9
    np.testing.assert_allclose(seconds - seconds.min(), theirs["time"] - theirs["time"].min(), atol=1e-6)


def golden() -> StructArray:
    return read_pcd(FIXTURES / "nebula_vlp16_golden_1673400472138016708.pcd.gz", GOLDEN_DTYPE)


def test_dual_returns_agree_with_the_golden_cloud_of_nebula() -> None:
    cloud = golden()
    rows = returns_of(feed(make_parser(), payloads("velodyne/nebula_vlp16.pcap.gz")[450:]))
    points = ros_points(rows, VLP16.beams)
    distance, nearest = np.empty(len(cloud)), np.empty(len(cloud), dtype=np.intp)
    for ring in range(16):
        theirs, ours = np.flatnonzero(cloud["channel"] == ring), np.flatnonzero(RING[rows["channel"]] == ring)
        if not len(theirs):
            continue
        apart = np.linalg.norm(xyz(cloud)[theirs, np.newaxis] - points[ours][np.newaxis], axis=2)
        nearest[theirs], distance[theirs] = ours[apart.argmin(axis=1)], apart.min(axis=1)
    assert (distance < 0.03).mean() > 0.995
    assert distance.max() < 0.05
    # ReturnType of nebula: 6 identical, 4 and 5 the weaker of two, 9 and 10 the stronger of two
    sure = (distance < 0.015) & (np.abs(rows["range_m"][nearest] - cloud["distance"]) < 0.003)
    kind, flags = cloud["return_type"][sure], rows["flags"][nearest][sure]
    assert (flags[kind == 6] == RETURN_FLAG_STRONGEST | RETURN_FLAG_LAST).mean() > 0.995
    assert ((flags[np.isin(kind, (4, 5))] & RETURN_FLAG_STRONGEST) == 0).mean() > 0.95
    assert ((flags[np.isin(kind, (9, 10))] & RETURN_FLAG_STRONGEST) != 0).mean() > 0.95


def test_dual_returns_are_numbered_by_range() -> None:
    rows = returns_of(feed(make_parser(), payloads("velodyne/nebula_vlp16.pcap.gz")))
    assert {0x39, 0x22} == set(payloads("velodyne/nebula_vlp16.pcap.gz")[0][-2:])
    two = rows["number_of_returns"] == 2
    first, last = rows[two & (rows["return_number"] == 1)], rows[two & (rows["return_number"] == 2)]
    assert len(first) == len(last) == 708
    np.testing.assert_array_equal(first["pulse_id"], last["pulse_id"])
    np.testing.assert_array_equal(first["device_time_ns"], last["device_time_ns"])
    assert (first["range_m"] < last["range_m"]).all()
    assert (last["flags"] & RETURN_FLAG_LAST).all()
    assert not (first["flags"] & RETURN_FLAG_LAST).any()
    assert ((first["flags"] ^ last["flags"]) & RETURN_FLAG_STRONGEST).all()
    alone = rows[~two]
    assert (alone["flags"] == RETURN_FLAG_LAST | RETURN_FLAG_STRONGEST).all()
    assert len(np.unique(rows["pulse_id"])) == len(rows) - 708


def test_position_packets_of_a_gps_capture_give_time_and_status() -> None:
    units = payloads("velodyne/mrpt_vlp16_gps.pcap.gz")
    parser = make_parser()
    records = feed(parser, units)
    assert parser.counters.messages == {"data": 293, "position": 57}
    assert not parser.counters.errors
    assert parser.counters.bytes == parser.counters.bytes_framed == 293 * 1206 + 57 * 512
    messages = [record for record in records if isinstance(record, TimeMessage)]
    assert len(messages) == 1
    assert messages[0].valid
    assert messages[0].names_edge is NamesEdge.PREVIOUS
    assert not messages[0].bound
    assert messages[0].time.date == dt.date(2016, 1, 21)
    assert messages[0].time.time_ns == (8 * 3600 + 18 * 60 + 2) * 10**9
    statuses = [record.values for record in records if isinstance(record, DeviceStatus)]
    assert statuses == [{"pps_status": "locked", "pps_locked": True, "nmea_valid": True}]
    clock = np.concatenate([record.rows for record in records if isinstance(record, DeviceClockSamples)])
    assert len(clock) == 350
    assert (clock["pps_time_ns"] == -1).all()
    since = np.flatnonzero(clock["locked"] == 1)
    first_position = next(at for at, unit in enumerate(units) if len(unit) == 512)
    np.testing.assert_array_equal(since, np.arange(first_position, 350))
    assert (clock["device_time_ns"] // 1_000_000_000 == 1082).all()
    rows = returns_of(records)
    np.testing.assert_array_equal(
        (rows["flags"] & RETURN_FLAG_PPS_LOCKED) != 0, rows["host_time_ns"] > first_position * 10**6
    )


def test_a_recording_without_gps_gives_returns_but_no_time() -> None:
    units = recording()
    assert units[0] == (FIXTURES / "vlp16-go_packet.bin").read_bytes()
    parser = make_parser()
    rows = returns_of(feed(parser, units))
    assert parser.counters.messages == {"data": 1000}
    assert not parser.counters.errors
    raw = np.frombuffer(b"".join(units), dtype=np.uint8).reshape(-1, 1206)[:, :1200].reshape(-1, 100)[:, 4:]
    places = raw.reshape(-1, 32, 3)
    ranges = places[..., 0].astype(np.int64) + 256 * places[..., 1].astype(np.int64)
    assert len(rows) == np.count_nonzero(ranges)
    np.testing.assert_allclose(rows["range_m"], ranges[ranges > 0] * 0.002, atol=1e-12)
    np.testing.assert_array_equal(rows["intensity"], places[..., 2][ranges > 0])
    assert (rows["flags"] == RETURN_FLAG_STRONGEST).all()
    assert (np.diff(rows["device_time_ns"]) > 0).all()
    turned = np.unwrap(rows["encoder_rad"])
    assert (np.diff(turned) > -1e-3).all()  # the azimuths it reports step back by up to 0.01°
    rev_per_s = (
        (turned[-1] - turned[0]) / (2 * np.pi) / ((rows["device_time_ns"][-1] - rows["device_time_ns"][0]) * 1e-9)
    )
    assert rev_per_s == pytest.approx(10.0, abs=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mrpt_vlp16_gps.pcap.gz", "nebula_vlp16.pcap.gz"])
def test_returns_do_not_depend_on_how_batches_are_cut(name: str) -> None:
    units = payloads(f"velodyne/{name}")
    check_packets(make_parser, units)
    check_packet_damage(make_parser, units[:20])
    check_packets(lambda: VelodyneParser(SETTINGS, clock_only=True), units)


def test_lost_packets_are_counted_by_their_timestamps() -> None:
    units = recording()[:200]
    parser = make_parser()
    feed(parser, units[:50] + units[53:120] + units[119:120] + units[160:])
    assert parser.counters.errors == {"cadence_gap": 3 + 40, "duplicate": 1}
    dual = payloads("velodyne/nebula_vlp16.pcap.gz")
    parser = make_parser()
    feed(parser, dual[:100])
    feed(parser, dual[107:])
    assert parser.counters.errors == {"cadence_gap": 7}


@pytest.mark.parametrize("cut", [1, 7, 1000])
def test_late_and_repeated_packets_are_not_jumps(cut: int) -> None:
    """Neighbours are swapped once, a packet comes four places late, and copies come three places later."""
    units = recording()[:200]
    units[20], units[21] = units[21], units[20]
    units.insert(64, units.pop(60))
    units.insert(103, units[100])
    units.insert(104, units[100])
    parser = make_parser()
    records: list[Record] = []
    for at in range(0, len(units), cut):
        records += feed(parser, units[at : at + cut])
    assert parser.counters.errors == {"cadence_gap": 2, "out_of_order": 2, "duplicate": 2}
    assert len(returns_of(records)) == len(returns_of(feed(make_parser(), recording()[:200])))


def test_a_restarted_head_is_one_jump_and_no_gap() -> None:
    parser = make_parser()
    feed(parser, [packet(900_000_000 + 1_327 * number) for number in range(20)])
    feed(parser, [packet(1_327 * number) for number in range(20)])
    assert parser.counters.errors == {"stamp_jump": 1}


# --- the manual's figures -------------------------------------------------------------------------------------------


def packet(
    stamp_us: int = 0, mode: int = MODE_STRONGEST, azimuth: list[int] | None = None, range_raw: int = 5000
) -> bytes:
    turned = [100 + 20 * block for block in range(12)] if azimuth is None else azimuth
    return encode_data_packet(stamp_us, turned, np.full((12, 32), 5000), 7, mode)


def decode(unit: bytes) -> StructArray:
    return returns_of(make_parser().feed(Chunk("scanner/left", 1, unit)))


def test_firing_times_follow_figure_9_9_of_the_manual() -> None:
    """In single return, block b, sequence s, laser k fires at 110.592 b + 55.296 s + 2.304 k µs."""
    times = decode(packet(stamp_us=2_000))["device_time_ns"].reshape(12, 2, 16) - 2_000_000
    for block, sequence, laser, want_us in [
        (0, 0, 0, 0.0),
        (0, 0, 15, 34.56),
        (0, 1, 0, 55.296),
        (11, 1, 15, 1306.368),
    ]:
        assert times[block, sequence, laser] == round(want_us * 1000)


def test_a_dual_return_block_advances_half_as_far() -> None:
    rows = decode(packet(mode=MODE_DUAL, azimuth=[100 + 20 * (block // 2) for block in range(12)]))
    assert len(rows) == 6 * 32
    assert rows["device_time_ns"].max() == 5 * 110_592 + 55_296 + 15 * 2_304
    assert len(np.unique(rows["pulse_id"])) == 6 * 32


def test_azimuth_is_advanced_to_each_firing() -> None:
    """Section 9.5 gives the rule; the azimuths cross 0°, and the last block turns as fast as the previous one."""
    azimuth = [(35_900 + 20 * block) % 36_000 for block in range(12)]
    rows = decode(packet(azimuth=azimuth))
    want = 359.0 + 0.2 * rows["device_time_ns"] / 110_592
    np.testing.assert_allclose(np.degrees(rows["encoder_rad"]), want % 360.0, atol=1e-9)
    assert (rows["encoder_rad"] >= 0).all()
    assert (rows["encoder_rad"] < 2 * np.pi).all()


def test_an_azimuth_of_360_degrees_is_north() -> None:
    """See PointCloudLibrary/pcl #20: "the rotation angle returned from the HDL might be 36000 (instead of 0)"."""
    azimuth = [(35_900 + 20 * block) % 36_000 for block in range(12)]
    full, zero = decode(packet(azimuth=[each or 36_000 for each in azimuth])), decode(packet(azimuth=azimuth))
    assert len(full) == 12 * 32
    np.testing.assert_allclose(full["encoder_rad"], zero["encoder_rad"], atol=1e-12)


def test_the_step_across_the_field_of_view_is_not_rotation() -> None:
    azimuth = [1000, 1020, 1040, 1060, 1080, 27_000, 27_020, 27_040, 27_060, 27_080, 27_100, 27_120]
    degrees = np.degrees(decode(packet(azimuth=azimuth))["encoder_rad"]).reshape(12, 32)
    assert degrees[4, -1] == pytest.approx(10.8 + 0.2 * 89.856 / 110.592, abs=1e-9)


def test_last_return_mode_is_flagged() -> None:
    assert (decode(packet(mode=MODE_LAST))["flags"] == RETURN_FLAG_LAST).all()


def test_times_stay_within_the_hour() -> None:
    times = decode(packet(stamp_us=3_599_999_500))["device_time_ns"]
    assert times[0] == 3_599_999_500_000
    assert times[-1] == 1_306_368 - 500_000


def test_the_hour_wrap_is_not_a_gap_and_a_clock_step_is_a_jump() -> None:
    parser = make_parser()
    feed(parser, [packet(3_599_999_000), packet(327), packet(1_654)])
    assert not parser.counters.errors
    feed(parser, [packet(900_000_000), packet(900_001_327)])
    assert parser.counters.errors == {"stamp_jump": 1}


def test_beam_points_match_the_formula_sheet() -> None:
    """FORMULAS 2.2 has 50 m at azimuth 123° and elevation −9°, without its laser's vertical correction (8.1 mm)."""
    rows = decode(packet())[:1].copy()
    rows["channel"], rows["encoder_rad"], rows["range_m"] = 6, np.radians(123.0), 50.0
    assert VLP16.beams.elevation_deg[6] == -9.0
    np.testing.assert_allclose(
        beam_points(rows, VLP16.beams)[0] - [0, 0, 6.6e-3], [41.417257, -26.896681, -7.821723], atol=1e-6
    )


@given(
    stamp_us=st.integers(0, 3_599_000_000),
    mode=st.sampled_from([MODE_STRONGEST, MODE_LAST]),
    seed=st.integers(0, 2**32 - 1),
)
@settings(max_examples=60, deadline=None)
def test_encoded_packets_are_decoded_to_their_input(stamp_us: int, mode: int, seed: int) -> None:
    random = np.random.default_rng(seed)
    ranges = random.integers(0, 3, (12, 32)) * random.integers(0, 32_768, (12, 32))
    light = random.integers(0, 256, (12, 32))
    rows = decode(encode_data_packet(stamp_us, [20 * block for block in range(12)], ranges, light, mode))
    there = ranges > 0
    np.testing.assert_array_equal(np.rint(rows["range_m"] / 0.002).astype(np.int64), ranges[there])
    np.testing.assert_array_equal(rows["intensity"], light[there])
    np.testing.assert_array_equal(rows["channel"], np.broadcast_to(np.arange(32) % 16, (12, 32))[there])
    np.testing.assert_array_equal(rows["pulse_id"], np.flatnonzero(there))


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=60, deadline=None)
def test_dual_pairs_follow_the_documented_rule(seed: int) -> None:
    random = np.random.default_rng(seed)
    ranges, light = random.integers(0, 4, (12, 32)) * 500, random.integers(0, 3, (12, 32))
    rows = decode(encode_data_packet(0, np.repeat(np.arange(6) * 20, 2), ranges, light, MODE_DUAL))
    want = []
    for pair in range(6):
        for place in range(32):
            last, odd = ((int(ranges[b, place]), int(light[b, place])) for b in (2 * pair, 2 * pair + 1))
            found = sorted({one[0]: one for one in (odd, last) if one[0]}.values())
            strongest = max(found, key=lambda one: (one[1], one == odd), default=None)
            for number, one in enumerate(found, start=1):
                flags = RETURN_FLAG_STRONGEST * (one == strongest) + RETURN_FLAG_LAST * (number == len(found))
                want.append((pair * 32 + place, one[0], one[1], number, len(found), flags))
    got = zip(
        rows["pulse_id"].tolist(),
        np.rint(rows["range_m"] / 0.002).astype(int).tolist(),
        rows["intensity"].astype(int).tolist(),
        rows["return_number"].tolist(),
        rows["number_of_returns"].tolist(),
        rows["flags"].tolist(),
        strict=True,
    )
    assert list(got) == want


# --- damaged on the wire --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("at", "new", "code"),
    [
        (0, b"\xfe", "bad_block_flag"),
        (1101, b"\xef", "bad_block_flag"),
        (102, b"\xff\xff", "bad_azimuth"),
        (1204, b"\x36", "bad_return_mode"),
        (1205, b"\x28", "wrong_product"),
    ],
)
def test_impossible_packets_are_counted(at: int, new: bytes, code: str) -> None:
    good = recording()[:3]
    broken = good[1][:at] + new + good[1][at + len(new) :]
    parser = make_parser()
    rows = returns_of(feed(parser, [good[0], broken, good[2]]))
    assert parser.counters.errors == {code: 1, "cadence_gap": 1}
    assert parser.counters.bad_messages == 1
    assert parser.counters.bytes_skipped == 1206
    np.testing.assert_array_equal(np.unique(rows["host_time_ns"]), [0, 2_000_000])


def test_truncated_packets_are_counted() -> None:
    unit = recording()[0]
    parser = make_parser()
    for length in range(1206):
        if length != 512:
            assert parser.feed(Chunk("scanner/left", 0, unit[:length])) == []
    assert parser.counters.errors == {"bad_length": 1205}
    assert parser.feed(Chunk("scanner/left", 0, unit[:512])) == []
    assert parser.counters.errors["bad_position"] == 1


# --- position packets -----------------------------------------------------------------------------------------------


def rmc(clock: str, status: str = "A", date: str = "210116") -> str:
    body = f"GPRMC,{clock},{status},3649.74,N,00224.45,W,0.034,212.5,{date},0.0,E,A"
    xor = 0
    for byte in body.encode():
        xor ^= byte
    return f"${body}*{xor:02X}"


def positions(*said: tuple[int, int, str]) -> tuple[VelodyneParser, list[Record]]:
    parser = make_parser()
    return parser, feed(parser, [encode_position_packet(*one) for one in said])


def test_a_repeated_sentence_does_not_name_the_second_again() -> None:
    """The packet after an edge still repeats the previous sentence; only a new sentence counts."""
    parser, records = positions(
        (1_000_200_000, 2, rmc("081639.00")),  # stale: the clock stands in second 40
        (1_000_300_000, 2, rmc("081640.00")),
        (1_000_900_000, 2, rmc("081640.00")),
        (1_001_050_000, 2, rmc("081640.00")),
        (1_001_150_000, 2, rmc("081641.00")),
    )
    seconds = [r.time.time_ns // 10**9 % 60 for r in records if isinstance(r, TimeMessage)]
    assert seconds == [40, 41]
    assert parser.counters.errors == {"nmea_second_mismatch": 1}


def test_without_lock_only_a_new_sentence_names_a_second() -> None:
    _, records = positions(
        (5_000_000, 0, rmc("081639.00")), (5_100_000, 0, rmc("081639.00")), (5_900_000, 1, rmc("081640.00"))
    )
    messages = [r for r in records if isinstance(r, TimeMessage)]
    assert [m.time.time_ns // 10**9 % 60 for m in messages] == [40]
    statuses = [r.values["pps_status"] for r in records if isinstance(r, DeviceStatus)]
    assert statuses == ["absent", "synchronizing"]


def test_a_receiver_with_status_void_gives_an_invalid_time() -> None:
    _, records = positions((1_000_200_000, 2, ""), (1_000_300_000, 2, rmc("081640.00", "V")))
    assert [r.valid for r in records if isinstance(r, TimeMessage)] == [False]
    assert [r.values["nmea_valid"] for r in records if isinstance(r, DeviceStatus)] == [False]


def test_a_date_one_rollover_behind_is_corrected_and_an_older_one_is_invalid() -> None:
    """On 2019-04-07, when the 10-bit week restarted, pucks sent 1999-08-22, which is 1024 weeks earlier."""
    parser, host_ns = make_parser(), int(dt.datetime(2019, 4, 7, tzinfo=dt.UTC).timestamp()) * 10**9
    said = [(1_000_200_000, rmc("081640.00", date="220899")), (1_001_200_000, rmc("081641.00", date="210898"))]
    units = [encode_position_packet(stamp_us, 2, sentence) for stamp_us, sentence in said]
    records = [record for unit in units for record in parser.feed(Chunk("scanner/left", host_ns, unit))]
    moved, refused = [r for r in records if isinstance(r, TimeMessage)]
    assert (moved.time.date, moved.valid) == (dt.date(2019, 4, 7), True)
    assert (refused.time.date, refused.valid) == (dt.date(1998, 8, 21), False)
    assert parser.counters.errors == {"date_before_floor": 1}
    first, second = parser.remarks()
    assert "1 roll-over of 1024 weeks behind; corrected to 2019-04-07" in first
    assert "sends the date 1998-08-21, before 2009-01-01" in second


def test_a_date_without_a_fix_causes_no_warning() -> None:
    parser, _ = positions((1_000_200_000, 2, rmc("081640.00", "V", "060180")))
    assert parser.remarks() == []
    assert not parser.counters.errors


def test_damaged_sentences_are_counted_once() -> None:
    bad = rmc("081640.00").replace("A,3649", "A,3648")
    parser, records = positions((1_000_200_000, 2, bad), (1_000_210_000, 2, bad))
    assert parser.counters.errors == {"bad_nmea": 1}
    assert not any(isinstance(r, TimeMessage) for r in records)


def test_a_counter_beyond_the_hour_is_taken_modulo_the_hour() -> None:
    """Lock and sentence count, and the sentence is that of the second in which the clock stands, as in data packets."""
    parser, records = positions((3_600_000_000 + 500_200_000, 2, rmc("080820.00")))
    assert not parser.counters.errors
    (message,) = [r for r in records if isinstance(r, TimeMessage)]
    assert message.valid
    (clock,) = [r for r in records if isinstance(r, DeviceClockSamples)]
    assert clock.rows["device_time_ns"].tolist() == [500_200_000 * 1000]
    assert clock.rows["locked"].tolist() == [1]


def test_impossible_position_packets_are_counted() -> None:
    parser, records = positions((0, 4, ""), (0, 3, ""))
    assert parser.counters.errors == {"bad_position": 1}
    assert [r.values["pps_status"] for r in records if isinstance(r, DeviceStatus)] == ["error"]


@pytest.mark.parametrize(
    ("sentence", "second"),
    [
        (rmc("235960.00", date="311216"), 86_400),
        (rmc("000000"), 0),
        (rmc("081802.00") + "\r\n", 29_882),
    ],
)
def test_seconds_of_rmc_sentences_are_read(sentence: str, second: int) -> None:
    named = rmc_time(sentence.encode())
    assert named is not None
    assert named[0].time_ns == second * 10**9


@pytest.mark.parametrize(
    "sentence",
    ["", "$", "*", "$GPRMC*4B", "garbage", rmc("0818"), rmc("08180x.00"), rmc("081802,5"), rmc("241802.00"),
     rmc("081802.00", date="310216"), rmc("081802.00", date="3102"), rmc("081802.00")[:-1], rmc("081802.²")],
)  # fmt: skip
def test_text_that_is_not_rmc_names_no_second(sentence: str) -> None:
    assert rmc_time(sentence.encode()) is None


@given(text=st.binary(max_size=80))
@settings(max_examples=200, deadline=None)
def test_random_bytes_as_a_sentence_never_raise(text: bytes) -> None:
    packet = bytearray(encode_position_packet(0, 2, ""))
    packet[206 : 206 + len(text)] = text
    parser = make_parser()
    parser.feed(Chunk("scanner/left", 0, bytes(packet)))
    assert parser.counters.messages == {"position": 1}


def test_the_driver_declares_its_records() -> None:
    driver = find_driver("scanner", "velodyne-vlp16")
    assert driver.transports == ("udp",)
    assert driver.make_time_parser is not None
    units = payloads("velodyne/mrpt_vlp16_gps.pcap.gz")
    parser = driver.make_time_parser(SETTINGS)
    assert isinstance(parser, VelodyneParser)
    records = feed(parser, units)
    given_types = {type(record) for record in records}
    assert given_types == {DeviceClockSamples, TimeMessage, DeviceStatus}
    assert given_types | {ScannerReturns} == set(driver.yields)
