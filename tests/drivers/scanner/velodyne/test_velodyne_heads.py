"""Tests other Velodyne heads: a real VLP-32C against other decoders, the manuals' figures, calibration files."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from swath.drivers.driver import find_driver
from swath.drivers.parser import DeviceSettings, DriverSettingsError
from swath.drivers.scanner.beams import beam_points
from swath.drivers.scanner.velodyne.calibration import read_calibration
from swath.drivers.scanner.velodyne.heads import (
    BLOCKS,
    HDL32E,
    PLACES,
    VLP16,
    VLP16_HIRES,
    VLP32C,
    VLS128,
    SpinningHead,
)
from swath.drivers.scanner.velodyne.parser import (
    MODE_DUAL,
    MODE_LAST,
    MODE_STRONGEST,
    VelodyneParser,
    encode_data_packet,
)
from swath.drivers.scanner.velodyne.position import encode_position_packet
from swath.georef.arrays import StructArray
from swath.georef.records import (
    RETURN_DTYPE,
    RETURN_FLAG_LAST,
    RETURN_FLAG_STRONGEST,
    Chunk,
    DeviceClockSamples,
    DeviceStatus,
    ScannerReturns,
)
from tests.drivers.builders import feed, returns_of
from tests.drivers.harness import check_packet_damage, check_packets
from tests.drivers.recordings import FIXTURES
from tests.drivers.spinning import payloads, read_pcd, ros_points, xyz

VLP32C_CAPTURE = "velodyne/nebula_vlp32.pcap.gz"
XYZ = np.dtype([("x", "f4"), ("y", "f4"), ("z", "f4")])
HEADS = {
    "velodyne-hdl32e": HDL32E,
    "velodyne-vlp16": VLP16,
    "velodyne-vlp16-hires": VLP16_HIRES,
    "velodyne-vlp32c": VLP32C,
    "velodyne-vls128": VLS128,
}
EVERY_HEAD = pytest.mark.parametrize("head", HEADS.values(), ids=HEADS.keys())


def make_parser(head: SpinningHead, calibration: str | None = None) -> VelodyneParser:
    files = {} if calibration is None else {"geometry": (FIXTURES / "velodyne" / calibration).read_bytes()}
    return VelodyneParser(DeviceSettings("scanner/left", {}, files), head)


def azimuths(head: SpinningHead, dual: bool, first: int = 100, step: int = 20) -> list[int]:
    """Return one azimuth for each group, the same in all its blocks."""
    group = len(head.block_flags) * (2 if dual else 1)
    return [(first + step * (block // group)) % 36_000 for block in range(BLOCKS)]


def packet(head: SpinningHead, mode: int = MODE_STRONGEST, stamp_us: int = 2_000, first: int = 100) -> bytes:
    turned = azimuths(head, mode == MODE_DUAL, first)
    return encode_data_packet(stamp_us, turned, np.full((BLOCKS, PLACES), 5000), 7, mode, head)


def decode(unit: bytes, head: SpinningHead) -> StructArray:
    return returns_of(make_parser(head).feed(Chunk("scanner/left", 1, unit)))


# --- VLP-32C: real recording ----------------------------------------------------------------------------------------


def test_vlp32c_agrees_with_velodyne_decoder() -> None:
    rows = returns_of(feed(make_parser(VLP32C), payloads(VLP32C_CAPTURE)))
    assert len(rows) == 131305
    with np.load(FIXTURES / "velodyne" / "nebula_vlp32.velodyne_decoder.npz") as archive:
        theirs = archive["points"]
    ours, ring = rows[: len(theirs)], np.argsort(np.argsort(VLP32C.beams.elevation_deg))[rows["channel"]]
    theirs = theirs[np.lexsort([theirs["ring"], theirs["column"]])]
    column = np.unique(ours["device_time_ns"] - VLP32C.offset_ns[ours["channel"]], return_inverse=True)[1]
    ours = ours[np.lexsort([ring[: len(theirs)], column])]
    column.sort()
    np.testing.assert_array_equal(column, theirs["column"])
    np.testing.assert_array_equal(np.argsort(np.argsort(VLP32C.beams.elevation_deg))[ours["channel"]], theirs["ring"])
    np.testing.assert_array_equal(ours["intensity"], theirs["intensity"])
    points = ros_points(ours, VLP32C.beams)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), np.linalg.norm(xyz(theirs), axis=1), atol=2e-5)
    np.testing.assert_allclose(points[:, 2], theirs["z"], atol=1e-5)
    seconds = ours["device_time_ns"] * 1e-9
    np.testing.assert_allclose(seconds - seconds.min(), theirs["time"] - theirs["time"].min(), atol=1e-6)
    # theirs uses one speed per packet, also where the field of view skips from 90° to 270°
    azimuth = np.arctan2(points[:, 1], points[:, 0]) - np.arctan2(theirs["y"], theirs["x"])
    apart_deg = np.degrees(np.abs(np.angle(np.exp(1j * azimuth))))
    turned = np.degrees(ours["encoder_rad"])
    inside = ~((turned > 86.0) & (turned < 94.0)) & ~((turned > 266.0) & (turned < 274.0))
    assert inside.mean() > 0.9
    assert apart_deg[inside].max() < 0.025


def test_vlp32c_agrees_with_the_golden_cloud_of_nebula() -> None:
    """Each point's laser (by elevation) and raw distance equal ours, and so does its azimuth rotated as nebula does it.

    Nebula lets each laser fire 2.304 µs after the last (the manual: each pair), and leaves some blocks unrotated.
    """
    parser = make_parser(VLP32C, "calib_VLP32.yaml")  # as nebula has it: without vertical corrections
    beams = parser.beams
    rows = returns_of(feed(parser, payloads(VLP32C_CAPTURE)))
    cloud = xyz(read_pcd(FIXTURES / "velodyne" / "nebula_vlp32_golden_1713492677464078412.pcd.gz", XYZ))
    assert len(cloud) == 26216
    range_m = np.linalg.norm(cloud, axis=1)
    elevation = np.degrees(np.arcsin(cloud[:, 2] / range_m))
    laser = np.abs(elevation[:, np.newaxis] - beams.elevation_deg).argmin(axis=1)
    np.testing.assert_allclose(elevation, beams.elevation_deg[laser], atol=2e-3)
    np.testing.assert_allclose(np.rint(range_m / 0.004) * 0.004, range_m, atol=1e-4)
    azimuth = np.arctan2(-cloud[:, 1], cloud[:, 0]) - np.radians(beams.azimuth_deg)[laser]

    def key(laser: object, range_m: object, azimuth_rad: object) -> object:
        pulse = np.asarray(laser, dtype=np.int64) * 65_536 + np.rint(np.asarray(range_m) / 0.004)
        return 10 * pulse + (np.asarray(azimuth_rad) + np.pi) % (2 * np.pi)  # the field of view ends far from 180°

    theirs = np.asarray(key(laser, range_m, azimuth))
    deg_per_ns = 3.6e-6  # 10 rev/s
    block_rad = rows["encoder_rad"] - np.radians(deg_per_ns) * VLP32C.offset_ns[rows["channel"]]
    apart_deg = np.full(len(cloud), np.inf)
    for each_ns in (2_304, 0):
        turned = block_rad + np.radians(deg_per_ns * each_ns) * rows["channel"]
        ours = np.sort(np.asarray(key(rows["channel"], rows["range_m"], turned)))
        place = np.searchsorted(ours, theirs).clip(1, len(ours) - 1)
        nearest = np.minimum(np.abs(ours[place] - theirs), np.abs(ours[place - 1] - theirs))
        apart_deg = np.minimum(apart_deg, np.degrees(nearest))
    assert apart_deg.max() < 0.02
    assert np.median(apart_deg) < 0.004


def test_vlp32c_gaps_left_by_the_recorder_are_counted() -> None:
    """The bag has the beginnings of three scans, 50 ms apart: packets of the other half turn were filtered out."""
    units = payloads(VLP32C_CAPTURE)
    parser = make_parser(VLP32C)
    rows = returns_of(feed(parser, units))
    assert parser.counters.messages == {"data": 379}
    assert parser.counters.errors == {"cadence_gap": 4 * round(50_375 / 663.552) - 4}
    raw = np.frombuffer(b"".join(units), dtype=np.uint8).reshape(-1, 1206)[:, :1200].reshape(-1, 100)[:, 4:]
    places = raw.reshape(-1, 32, 3)
    ranges = places[..., 0].astype(np.int64) + 256 * places[..., 1].astype(np.int64)
    np.testing.assert_allclose(rows["range_m"], ranges[ranges > 0] * 0.004, atol=1e-12)
    np.testing.assert_array_equal(rows["intensity"], places[..., 2][ranges > 0])
    assert (rows["flags"] == RETURN_FLAG_STRONGEST).all()


@pytest.mark.slow
def test_vlp32c_returns_do_not_depend_on_how_batches_are_cut() -> None:
    units = payloads(VLP32C_CAPTURE)[:160]
    check_packets(lambda: make_parser(VLP32C), units)
    check_packet_damage(lambda: make_parser(VLP32C), units[:20])


# --- the manuals' figures -------------------------------------------------------------------------------------------


def test_vlp32c_firing_times_follow_the_manual() -> None:
    """VLP-32C manual 9.4 gives 55.296 µs · sequence + 2.304 µs · (laser / 2); dual return has two blocks a sequence."""
    times = decode(packet(VLP32C), VLP32C)["device_time_ns"].reshape(12, 32) - 2_000_000
    for block, laser, want_us in ((0, 0, 0.0), (0, 1, 0.0), (0, 31, 34.56), (1, 0, 55.296), (11, 31, 642.816)):
        assert times[block, laser] == round(1000 * want_us)
    times = decode(packet(VLP32C, MODE_DUAL), VLP32C)["device_time_ns"].reshape(6, 32) - 2_000_000
    assert times[5, 31] == round(1000 * (5 * 55.296 + 34.56))


def test_vlp32c_precision_azimuth_follows_the_manual() -> None:
    """VLP-32C manual 9.5 gives azimuth + gap · 2.304 µs · K / 55.296 µs + the laser's offset, for K of 16 pairs."""
    rows = decode(packet(VLP32C, first=35_990), VLP32C)
    want = 359.9 + 0.2 * (np.arange(12)[:, np.newaxis] + np.arange(32) // 2 * 2.304 / 55.296)
    np.testing.assert_allclose(np.degrees(rows["encoder_rad"]), want.reshape(-1) % 360, atol=1e-9)
    point = beam_points(rows[28:29], VLP32C.beams)[0]  # laser 28: −2°, +4.2°
    azimuth = np.radians(want[0, 28] + 4.2)
    flat = 20.0 * np.cos(np.radians(2.0))
    height = -20.0 * np.sin(np.radians(2.0)) + 0.0424 * np.tan(np.radians(2.0))
    np.testing.assert_allclose(point, [flat * np.sin(azimuth), flat * np.cos(azimuth), height], atol=1e-9)


def test_vls128_firing_times_follow_the_manual() -> None:
    """By VLS-128 manual 9.4 a sequence starts at −8.7 µs and has eight lasers each 2.665 µs, none in the ninth slot."""
    times = decode(packet(VLS128), VLS128)["device_time_ns"].reshape(3, 128) - 2_000_000
    for sequence, laser, want_us in (
        (0, 0, -8.7),
        (0, 7, -8.7),
        (0, 8, -6.035),
        (0, 24, -0.705),
        (0, 63, 9.955),
        (0, 64, 15.285),
        (0, 127, 33.94),
        (1, 0, 44.6),
        (2, 127, 140.54),
    ):
        assert times[sequence, laser] == round(1000 * want_us)
    times = decode(packet(VLS128, MODE_DUAL), VLS128)["device_time_ns"] - 2_000_000
    assert len(times) == 128
    assert times[127] == 33_940
    early = decode(packet(VLS128, stamp_us=5), VLS128)["device_time_ns"]
    assert early[0] == 3_600_000_000_000 - 3_700


def test_vls128_packet_layout_follows_the_manual() -> None:
    """A sequence has a block for each of four banks; dual return has two for each, and four empty blocks at the end."""
    single, dual = packet(VLS128), packet(VLS128, MODE_DUAL)
    assert [single[at : at + 2].hex() for at in range(0, 1200, 100)] == 3 * ["ffee", "ffdd", "ffcc", "ffbb"]
    pairs = ["ffee", "ffee", "ffdd", "ffdd", "ffcc", "ffcc", "ffbb", "ffbb"]
    assert [dual[at : at + 2].hex() for at in range(0, 1200, 100)] == [*pairs, *4 * ["0000"]]
    for at, unit in ((800, dual), (1100, dual), (1102, dual)):
        assert len(decode(unit[:at] + b"\xff\xff" + unit[at + 2 :], VLS128)) == 128  # of an empty block
    for at, unit, code in (
        (100, single, "bad_block_flag"),
        (700, dual, "bad_block_flag"),
        (702, dual, "bad_azimuth"),
        (1102, single, "bad_azimuth"),
    ):
        parser = make_parser(VLS128)
        assert parser.feed(Chunk("scanner/left", 1, unit[:at] + b"\xff\xff" + unit[at + 2 :])) == []
        assert parser.counters.errors == {code: 1}


def test_vls128_design_angles_follow_the_manual() -> None:
    """The manual (9.3.1.2) has 128 lasers from −25° (laser 36) to +15°, with eight azimuth offsets."""
    beams = VLS128.beams
    assert len(beams) == len(np.unique(beams.elevation_deg)) == 128
    assert (beams.elevation_deg.min(), beams.elevation_deg.max()) == (-25.0, 15.0)
    np.testing.assert_array_equal(np.unique(beams.azimuth_deg, return_counts=True)[1], 16)
    assert beams.elevation_deg[36] == -25.0
    assert beams.azimuth_deg[36] == -0.911  # VLS128.yaml: rot_correction 0.0158999… rad
    np.testing.assert_allclose(beams.up_m[36], 0.05863 * np.tan(np.radians(25.0)))


def test_vls128_dual_return_uses_the_rotation_since_the_previous_packet() -> None:
    """A dual-return packet has one azimuth, so the rotation comes from the previous packet, also after a lost one."""
    number = np.array([0, 1, 2, 5, 6, 7, 8])
    azimuth = (35_970 + 20 * number) % 36_000
    azimuth[-2:] += 9_000  # the field of view steps on
    units = [
        encode_data_packet(round(1000 + 53.3 * n), np.full(12, at), np.full((12, 32), 100), 1, MODE_DUAL, VLS128)
        for n, at in zip(number.tolist(), azimuth.tolist(), strict=True)
    ]
    parser = make_parser(VLS128)
    rows = returns_of(feed(parser, units))
    assert parser.counters.errors == {"cadence_gap": 2}
    degrees = np.degrees(rows["encoder_rad"]).reshape(len(units), 128)
    fraction = VLS128.offset_ns / VLS128.group_ns
    np.testing.assert_allclose(degrees[0], 359.7, atol=1e-9)  # nothing is known before
    want = azimuth[1:, np.newaxis] / 100 + 0.2 * fraction
    np.testing.assert_allclose(degrees[1:], want % 360, atol=1e-9)


def test_hdl32e_firing_times_follow_the_manual() -> None:
    """Appendix E of the manual gives block · 46.08 µs + laser · 1.152 µs, and 542.592 µs from first to last firing."""
    times = decode(packet(HDL32E), HDL32E)["device_time_ns"].reshape(12, 32) - 2_000_000
    for block, laser, want_us in ((0, 0, 0.0), (0, 1, 1.152), (0, 31, 35.712), (1, 0, 46.08), (11, 31, 542.592)):
        assert times[block, laser] == round(1000 * want_us)
    times = decode(packet(HDL32E, MODE_DUAL), HDL32E)["device_time_ns"].reshape(6, 32) - 2_000_000
    assert times[5, 31] == round(1000 * (5 * 46.08 + 35.712))


def test_hdl32e_lasers_follow_the_firing_order() -> None:
    """By the manual's firing sequence the lowest laser is first, then both banks of 16 alternate, in steps of 4/3°."""
    elevation = HDL32E.beams.elevation_deg
    np.testing.assert_allclose(elevation[0::2], -92 / 3 + 4 / 3 * np.arange(16), atol=0.01)
    np.testing.assert_allclose(elevation[1::2], -28 / 3 + 4 / 3 * np.arange(16), atol=0.01)
    assert elevation[15] == 0.0  # DSR 15
    np.testing.assert_allclose(HDL32E.beams.up_m, -0.02883 * np.tan(np.radians(elevation)), atol=1e-4)
    assert not HDL32E.beams.azimuth_deg.any()


@pytest.mark.slow
def test_returns_of_every_head_do_not_depend_on_how_batches_are_cut() -> None:
    for head in HEADS.values():
        random = np.random.default_rng(1)
        units, stamp_us = [], 3_599_990_000.0
        for at in range(90):
            mode = MODE_DUAL if 30 <= at < 70 else MODE_STRONGEST
            groups = head.groups(dual=mode == MODE_DUAL)
            turned = azimuths(head, mode == MODE_DUAL, first=round(35_000 + stamp_us / 2.6) % 36_000)
            ranges = random.integers(0, 3, (BLOCKS, PLACES)) * 700
            if at % 17:
                units.append(encode_data_packet(int(stamp_us) % 3_600_000_000, turned, ranges, at, mode, head))
            stamp_us += groups * head.group_ns / 1000
        units.insert(40, encode_position_packet(3_599_999_000, 2, ""))
        check_packets(partial(make_parser, head), units)
        check_packet_damage(partial(make_parser, head), units[25:45], examples=15)


def test_a_puck_hi_res_has_its_own_angles() -> None:
    """Table 9-1 puts laser 0 at −10° and 7.4 mm up, and laser 7 at 4.667° and 3.7 mm down; a VLP-16 refuses them."""
    units = payloads("velodyne/made_vlp16_hires.pcap.gz")
    parsers = {protocol: make_parser(head) for protocol, head in HEADS.items()}
    rows = {
        protocol: sum(len(record.rows) for record in feed(parser, units) if isinstance(record, ScannerReturns))
        for protocol, parser in parsers.items()
    }
    assert find_driver("scanner", "velodyne-vlp16-hires").make_parser(DeviceSettings("scanner/left"))
    assert rows == {**dict.fromkeys(HEADS, 0), "velodyne-vlp16-hires": 300 * 384}
    assert parsers["velodyne-vlp16-hires"].counters.errors == {}
    assert parsers["velodyne-vlp16"].counters.errors == {"wrong_product": 300}
    first = decode(units[0], VLP16_HIRES)[:16]
    points = beam_points(first, VLP16_HIRES.beams)
    for laser, elevation_deg, up_m in ((0, -10.0, 0.0074), (7, 4.667, -0.0037), (15, 10.0, -0.0074)):
        assert points[laser, 2] == pytest.approx(10 * np.sin(np.radians(elevation_deg)) + up_m, abs=1e-9)
        assert np.hypot(*points[laser, :2]) == pytest.approx(10 * np.cos(np.radians(elevation_deg)), abs=1e-9)
    np.testing.assert_allclose(np.diff(np.sort(VLP16_HIRES.beams.elevation_deg)), 4 / 3, atol=1e-3)


@EVERY_HEAD
def test_modes_and_products_are_recognised(head: SpinningHead) -> None:
    assert (decode(packet(head, MODE_LAST), head)["flags"] == RETURN_FLAG_LAST).all()
    assert (decode(packet(head), head)["flags"] == RETURN_FLAG_STRONGEST).all()
    assert (decode(packet(head, MODE_DUAL), head)["flags"] == RETURN_FLAG_STRONGEST | RETURN_FLAG_LAST).all()
    for product in head.product_ids:
        assert len(decode(packet(head)[:-1] + bytes([product]), head)) == BLOCKS * PLACES
    for other in HEADS.values():
        if other is not head:
            parser = make_parser(other)
            assert parser.feed(Chunk("scanner/left", 1, packet(head))) == []
            assert parser.counters.errors.keys() <= {"wrong_product", "bad_block_flag"}


@EVERY_HEAD
@given(seed=st.integers(0, 2**32 - 1), mode=st.sampled_from([MODE_STRONGEST, MODE_LAST]))
@settings(max_examples=30, deadline=None)
def test_encoded_packets_are_decoded_to_their_input(head: SpinningHead, seed: int, mode: int) -> None:
    random = np.random.default_rng(seed)
    ranges = random.integers(0, 2, (BLOCKS, PLACES)) * random.integers(0, 65_536, (BLOCKS, PLACES))
    light = random.integers(0, 256, (BLOCKS, PLACES))
    stamp_us = int(random.integers(0, 3_600_000_000))
    rows = decode(encode_data_packet(stamp_us, azimuths(head, False), ranges, light, mode, head), head)
    there = ranges.reshape(-1) > 0
    groups = head.groups(dual=False)
    np.testing.assert_array_equal(np.rint(rows["range_m"] / head.range_unit_m).astype(int), ranges[ranges > 0])
    np.testing.assert_array_equal(rows["intensity"], light[ranges > 0])
    np.testing.assert_array_equal(rows["channel"], np.tile(head.channel, groups)[there])
    np.testing.assert_array_equal(rows["pulse_id"], np.flatnonzero(there))
    times = head.stamp_ns + (np.arange(groups)[:, np.newaxis] * head.group_ns + head.offset_ns).reshape(-1)[there]
    np.testing.assert_array_equal(rows["device_time_ns"], (stamp_us * 1000 + times) % 3_600_000_000_000)
    turned = 1.0 + 0.2 * (np.arange(groups)[:, np.newaxis] + head.offset_ns / head.group_ns).reshape(-1)[there]
    np.testing.assert_allclose(np.degrees(rows["encoder_rad"]), turned, atol=1e-9)


@EVERY_HEAD
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None)
def test_dual_returns_are_paired(head: SpinningHead, seed: int) -> None:
    random = np.random.default_rng(seed)
    ranges, light = random.integers(0, 4, (BLOCKS, PLACES)) * 500, random.integers(0, 256, (BLOCKS, PLACES))
    rows = decode(encode_data_packet(0, azimuths(head, True), ranges, light, MODE_DUAL, head), head)
    used = len(head.used_block_flags(dual=True))
    last, odd = ranges[:used:2].reshape(-1), ranges[1:used:2].reshape(-1)
    want = [sorted({one, other} - {0}) for one, other in zip(last.tolist(), odd.tolist(), strict=True)]
    got: list[list[int]] = [[] for _ in want]
    for row in rows:
        got[int(row["pulse_id"])].append(round(row["range_m"] / head.range_unit_m))
    assert got == want
    np.testing.assert_array_equal(rows["channel"], np.tile(head.channel, head.groups(dual=True))[rows["pulse_id"]])


@pytest.mark.parametrize("protocol", HEADS)
def test_the_driver_declares_its_records(protocol: str) -> None:
    driver = find_driver("scanner", protocol)
    assert driver.transports == ("udp",)
    assert driver.make_time_parser is not None
    head = HEADS[protocol]
    units = [
        packet(head, stamp_us=2_000_000),
        encode_position_packet(2_500_000, 2, ""),
        packet(head, stamp_us=2_900_000),
    ]
    thinned = feed(driver.make_time_parser(DeviceSettings("scanner/left")), units)
    assert {type(record) for record in thinned} == {DeviceClockSamples, DeviceStatus}
    records = feed(driver.make_parser(DeviceSettings("scanner/left")), units)
    assert {type(record) for record in records} == {DeviceClockSamples, DeviceStatus, ScannerReturns}
    assert returns_of(records)["range_m"][0] == pytest.approx(5000 * head.range_unit_m)


# --- a head's own calibration ---------------------------------------------------------------------------------------


def test_calibration_files_of_the_fixtures_are_read() -> None:
    for head, name in ((VLP32C, "calib_VLP32.yaml"), (VLP16, "calib_VLP16.yaml")):
        beams = make_parser(head, name).beams
        np.testing.assert_allclose(beams.elevation_deg, head.beams.elevation_deg, atol=1e-9)
        np.testing.assert_allclose(beams.azimuth_deg, head.beams.azimuth_deg, atol=1e-9)


def full_table(unit: str) -> bytes:
    """Return a VLP-16's table, each laser that of FORMULAS 2.2's check, as YAML (rad, m) or db.xml (°, cm)."""
    if unit == "yaml":
        laser = (
            "- {{laser_id: {}, rot_correction: 0.020943951023931952, vert_correction: -0.15707963267948966, "
            "dist_correction: 0.05, vert_offset_correction: 0.2, horiz_offset_correction: 0.026}}"
        )
        return "\n".join(["distance_resolution: 0.002", "lasers:", *map(laser.format, range(16))]).encode()
    px = (
        "<item><px><id_>{}</id_><rotCorrection_>1.2</rotCorrection_><vertCorrection_>-9</vertCorrection_>"
        "<distCorrection_>5</distCorrection_><vertOffsetCorrection_>20</vertOffsetCorrection_>"
        "<horizOffsetCorrection_>2.6</horizOffsetCorrection_></px></item>"
    )
    items = "".join(map(px.format, range(16)))
    return f"<archive><DB><distLSB_>0.2</distLSB_><points_>{items}</points_></DB></archive>".encode()


@pytest.mark.parametrize("unit", ["yaml", "xml"])
def test_full_calibration_table_matches_the_formula_sheet(unit: str) -> None:
    """The point is that of FORMULAS 2.2 for 50 m, azimuth 123°, ω −9°, rot 1.2°, v 0.2 m, h 0.026 m, ΔR 0.05 m."""
    beams = read_calibration(full_table(unit), VLP16)
    rows = np.zeros(1, dtype=RETURN_DTYPE)
    rows["range_m"], rows["encoder_rad"], rows["channel"] = 50.0, np.radians(123.0), 7
    np.testing.assert_allclose(beam_points(rows, beams)[0], [42.053718, -26.043818, -7.632007], atol=1e-6)


def both(yaml: str, new_yaml: str, xml: str, new_xml: str) -> Callable[[bytes], bytes]:
    """Apply the same change to both files."""
    return lambda data: data.replace(yaml.encode(), new_yaml.encode()).replace(xml.encode(), new_xml.encode())


@pytest.mark.parametrize("unit", ["yaml", "xml"])
@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda _: b"", "neither db.xml nor YAML"),
        (lambda _: b"<", "neither db.xml nor YAML"),
        (lambda _: b"lasers: [1, 2]", "neither db.xml nor YAML"),
        (lambda _: b"lasers: {a: [b", "neither db.xml nor YAML"),
        (lambda _: b"\xff\x00\x01", "neither db.xml nor YAML"),
        (lambda _: b"[" * 20_000, "neither db.xml nor YAML of a Velodyne head: nested more than 16 deep"),
        (both("0.002", "0.004", ">0.2<", ">0.4<"), "of another model: distances in 0.004"),
        (both("laser_id: 3,", "laser_id: 30,", "<id_>3<", "<id_>30<"), "laser 3 is missing"),
        (both(" dist_correction", " dist_correction_x", "distCorrection_", "distCorrectionX_"), "_x of laser 0"),
        (both("laser_id: 3,", "laser_id: .inf,", "<id_>3<", "<id_>.inf<"), "neither db.xml nor YAML"),
        (lambda _: b'<?xml version="1.0" encoding="no-such"?><a/>', "neither db.xml nor YAML"),
        (both("-0.157", "-15.7", ">-9<", ">-999<"), "vert_correction of laser 0"),
        (both("vert_correction", "vert", "vertCorrection_", "vert_"), "neither db.xml nor YAML"),
        (both("-0.15707963267948966", ".nan", ">-9<", ">nan<"), "vert_correction of laser 0"),
    ],
)  # fmt: skip
def test_impossible_calibration_files_are_refused(unit: str, change: Callable[[bytes], bytes], says: str) -> None:
    files = {"geometry": change(full_table(unit))}
    with pytest.raises(DriverSettingsError, match=says):
        VelodyneParser(DeviceSettings("scanner/left", {}, files), VLP16)
