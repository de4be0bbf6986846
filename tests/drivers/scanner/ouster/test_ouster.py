"""Tests Ouster: real recordings against the maker's own decoder, the manual's formula, and damaged packets."""

from __future__ import annotations

import hashlib
import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from swath.drivers.driver import find_driver
from swath.drivers.parser import DeviceSettings
from swath.drivers.scanner.ouster.head import beam_points, read_head
from swath.drivers.scanner.ouster.imu import SAMPLE_DTYPE, encode_imu_packet
from swath.drivers.scanner.ouster.layout import PROFILES, with_crc
from swath.drivers.scanner.ouster.parser import OusterParser
from swath.georef.records import (
    RETURN_DTYPE,
    RETURN_FLAG_LAST,
    RETURN_FLAG_STRONGEST,
    Chunk,
    DeviceClockSamples,
    DeviceStatus,
    ImuSamples,
    ScannerReturns,
)
from tests.drivers.builders import feed, returns_of
from tests.drivers.harness import check_packet_damage, check_packets
from tests.drivers.ouster_cases import (
    EXPECTED,
    FIXTURES,
    SERIAL,
    frames_of,
    measurement_ids,
    metadata,
    metadata_of,
    parser_of,
    payloads,
    random_fields,
    recorded,
    samples_of,
)
from tests.drivers.scanner.ouster.builders import lidar_packets

DUAL, LEGACY, LOW = "OS-0-32-U1_v2.2.0_1024x10", "OS-1-32-G_v2.1.1_1024x10", "OS-1-128_v2.3.0_1024x10_lb_n3"
SINGLE = f"{DUAL}-single-packet"
LIDAR = (DUAL, SINGLE, LEGACY, LOW, "crc_test", "windowed_frame1")
RETURNS = {DUAL: 21_803, SINGLE: 223, LEGACY: 27_310, LOW: 322_536, "crc_test": 29_692, "windowed_frame1": 9_246}


def md5(image: np.ndarray[Any, Any]) -> str:
    return hashlib.md5(np.ascontiguousarray(image).tobytes()).hexdigest()


# --- real recordings ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("capture", LIDAR)
def test_every_field_of_every_frame_matches_the_digest_of_the_manufacturers_decoder(capture: str) -> None:
    layout, packets = lidar_packets(capture)
    shape = (layout.head.beams, layout.head.columns_per_frame)
    scans = EXPECTED[f"{capture}.pcap"]["scans"]
    assert {scan["frame_id"] for scan in scans} == set(layout.frame_id(packets).tolist())
    for scan in scans:
        columns = packets["columns"][layout.frame_id(packets) == scan["frame_id"]]
        columns = columns[layout.valid(columns)]
        assert len(columns) == scan["valid_columns"]
        assert (columns["time_ns"].min(), columns["time_ns"].max()) == (scan["ts_first"], scan["ts_last"])
        assert set(scan["fields"]) == set(layout.profile.fields)
        for name, expected in scan["fields"].items():
            image = np.zeros(shape, dtype=expected["dtype"])
            image[:, columns["id"]] = layout.field(columns["pixels"], name).T
            assert md5(image) == expected["md5"], (scan["frame_id"], name)


@pytest.mark.parametrize("capture", LIDAR)
def test_returns_rebuild_the_images_of_the_manufacturers_decoder(capture: str) -> None:
    """Ranges and intensities fill the manufacturer's images exactly, with no other pixel set."""
    parser = recorded(capture)
    rows = returns_of(feed(parser, payloads(capture)))
    assert not parser.counters.errors
    assert not parser.counters.bad_checksums
    assert parser.counters.bytes == parser.counters.bytes_framed == sum(map(len, payloads(capture)))
    assert len(rows) == RETURNS[capture]
    head, (layout, packets) = parser.head, lidar_packets(capture)
    shape = (head.beams, head.columns_per_frame)
    light = "SIGNAL" if "SIGNAL" in layout.profile.fields else "REFLECTIVITY"
    for scan in EXPECTED[f"{capture}.pcap"]["scans"]:
        of_frame = (rows["device_time_ns"] >= scan["ts_first"]) & (rows["device_time_ns"] <= scan["ts_last"])
        frame = rows[of_frame]
        places = (frame["channel"], measurement_ids(frame, head.columns_per_frame))
        near, far = np.zeros((2, *shape), dtype=np.uint32)
        first = frame["return_number"] == 1
        near[places[0][first], places[1][first]] = np.rint(frame["range_m"][first] * 1000)
        far[places[0][~first], places[1][~first]] = np.rint(frame["range_m"][~first] * 1000)
        if not layout.dual:
            assert md5(near) == scan["fields"]["RANGE"]["md5"]
            assert not far.any()
            continue
        columns = packets["columns"].reshape(-1)
        both = np.zeros((2, *shape), dtype=np.uint32)
        both[:, :, columns["id"]] = [layout.field(columns["pixels"], name).T for name in ("RANGE", "RANGE2")]
        assert md5(both[0]) == scan["fields"]["RANGE"]["md5"]
        two = both.all(axis=0)
        np.testing.assert_array_equal(near, np.where(two, both.min(axis=0), both.max(axis=0)))
        np.testing.assert_array_equal(far, np.where(two, both.max(axis=0), 0))
    image = np.zeros(shape, dtype=np.uint16)
    columns = packets["columns"].reshape(-1)
    image[:, columns["id"]] = layout.field(columns["pixels"], light).T  # the last frame
    if not layout.dual:
        np.testing.assert_array_equal(frame["intensity"], image[places])


@pytest.mark.parametrize("capture", LIDAR)
def test_points_match_the_manufacturers_decoder(capture: str) -> None:
    parser = recorded(capture)
    rows = returns_of(feed(parser, payloads(capture)))
    with np.load(FIXTURES / f"{capture}.ouster_sdk.npz") as archive:
        ranges, stamps, theirs = archive["RANGE"], archive["timestamp"], archive["xyz_first_200_columns"]
    column = measurement_ids(rows, parser.head.columns_per_frame)
    mine = (column < 200) & (rows["device_time_ns"] == stamps[column])
    mine &= np.rint(rows["range_m"] * 1000) == ranges[rows["channel"], column]  # second returns are not in `ranges`
    assert mine.sum() == np.count_nonzero(ranges[:, :200])
    points = beam_points(rows[mine], parser.head)
    np.testing.assert_allclose(points, theirs[rows["channel"][mine], column[mine]], atol=1e-5)  # theirs: 4 bytes each


def test_an_azimuth_window_gives_its_columns_only() -> None:
    rows = returns_of(feed(recorded("windowed_frame1"), payloads("windowed_frame1")))
    column = measurement_ids(rows, 512)
    assert (column.min(), column.max()) == (1, 256)


def test_two_returns_are_numbered_by_range() -> None:
    rows = returns_of(feed(recorded(DUAL), payloads(DUAL)))
    two = rows["number_of_returns"] == 2
    first, last = rows[two & (rows["return_number"] == 1)], rows[two & (rows["return_number"] == 2)]
    assert len(first) == len(last) == 57
    np.testing.assert_array_equal(first["pulse_id"], last["pulse_id"])
    assert (first["range_m"] <= last["range_m"]).all()
    assert (last["flags"] & RETURN_FLAG_LAST).all()
    assert not (first["flags"] & RETURN_FLAG_LAST).any()
    assert ((first["flags"] ^ last["flags"]) & RETURN_FLAG_STRONGEST).all()
    strongest = np.where(first["flags"] & RETURN_FLAG_STRONGEST, first["intensity"], last["intensity"])
    assert (strongest >= np.minimum(first["intensity"], last["intensity"])).all()
    assert (rows[~two]["flags"] == RETURN_FLAG_LAST | RETURN_FLAG_STRONGEST).all()


def test_status_reports_whether_the_metadata_belongs_to_this_start() -> None:
    (status,) = [one for one in feed(recorded("crc_test"), payloads("crc_test")) if isinstance(one, DeviceStatus)]
    assert status.values["timestamp_mode"] == "TIME_FROM_INTERNAL_OSC"
    assert status.values["profile"] == "RNG15_RFL8_NIR8"
    assert status.values["init_id"] == 11_394_290
    assert status.values["metadata_of_this_start"] is True
    (old,) = [one for one in feed(recorded(LEGACY), payloads(LEGACY)) if isinstance(one, DeviceStatus)]
    assert old.values == {"model": "OS-1-32-G", "profile": "LEGACY", "timestamp_mode": "unsaid"}


@pytest.mark.parametrize("capture", [DUAL, LEGACY, "crc_test", "windowed_frame1", "imu_zm_no_lidar"])
def test_returns_do_not_depend_on_how_batches_are_cut(capture: str) -> None:
    units = payloads(capture)
    check_packets(lambda: recorded(capture), units)
    check_packets(lambda: parser_of(metadata_of(capture), clock_only=True), units, seeds=(1,))


@pytest.mark.parametrize("capture", [DUAL, LEGACY, "crc_test", "imu_zm_no_lidar"])
def test_damaged_packets_never_raise(capture: str) -> None:
    check_packet_damage(lambda: recorded(capture), payloads(capture)[:6], examples=30)


# --- IMU ------------------------------------------------------------------------------------------------------------


def test_imu_samples_match_the_manufacturers_decoder() -> None:
    parser = recorded("imu_zm_no_lidar")
    rows = samples_of(feed(parser, payloads("imu_zm_no_lidar")))
    assert parser.counters.messages == {"imu": 8, "zone": 1}
    assert not parser.counters.errors
    assert not parser.counters.bad_checksums
    fields = EXPECTED["imu_zm_no_lidar.pcap"]["scans"][0]["fields"]
    sent = b"".join(unit[132:-32] for unit in payloads("imu_zm_no_lidar") if len(unit) == 452)
    table = np.frombuffer(sent, dtype=SAMPLE_DTYPE)
    for name, field, column in (
        ("acceleration", "IMU_ACC", "specific_force_b"),
        ("rate", "IMU_GYRO", "angular_rate_b"),
        ("time_ns", "IMU_TIMESTAMP", "device_time_ns"),
        ("status", "IMU_STATUS", "status"),
    ):
        assert md5(table[name]) == fields[field]["md5"]
        np.testing.assert_array_equal(rows[column], table[name])


def test_imu_of_older_firmware_is_converted_from_g_and_degrees() -> None:
    units = [unit for unit in payloads("crc_test") if len(unit) == 48]
    rows = samples_of(feed(recorded("crc_test"), units))
    for row, unit in zip(rows, units, strict=True):
        _, force_ns, rate_ns, *values = struct.unpack("<3Q6f", unit)
        np.testing.assert_allclose(row["specific_force_b"] / 9.80665, values[:3], rtol=1e-12)
        np.testing.assert_allclose(np.degrees(row["angular_rate_b"]), values[3:], rtol=1e-12)
        assert abs(row["device_time_ns"] - (force_ns + rate_ns) // 2) <= 1
    # the same head at rest, a year later and in SI units, in the other recording
    later = samples_of(feed(recorded("imu_zm_no_lidar"), payloads("imu_zm_no_lidar")))
    np.testing.assert_allclose(np.linalg.norm(rows["specific_force_b"].mean(axis=0)), 9.9, atol=0.1)
    np.testing.assert_allclose(np.linalg.norm(later["specific_force_b"].mean(axis=0)), 9.9, atol=0.1)
    np.testing.assert_allclose(rows["angular_rate_b"].mean(axis=0), later["angular_rate_b"].mean(axis=0), atol=0.01)


@pytest.mark.parametrize("capture", ["crc_test", "imu_zm_no_lidar"])
def test_encoded_imu_packets_are_decoded_to_their_input(capture: str) -> None:
    head = read_head(metadata_of(capture))
    count = head.imu_samples
    force, rate = np.linspace(-9.0, 9.0, 3 * count).reshape(-1, 3), np.linspace(1.0, -1.0, 3 * count).reshape(-1, 3)
    unit = encode_imu_packet(head, 1_000_000 * np.arange(1, count + 1), force, rate)
    assert len(unit) in {len(one) for one in payloads(capture)}
    rows = samples_of(feed(recorded(capture), [unit]))
    np.testing.assert_allclose(rows["specific_force_b"], force, atol=1e-6)
    np.testing.assert_allclose(rows["angular_rate_b"], rate, atol=1e-6)
    np.testing.assert_array_equal(rows["device_time_ns"], 1_000_000 * np.arange(1, count + 1))


@pytest.mark.parametrize("word", [0x7FC0_0000, 0x7FA0_0000, 0xFF80_0000], ids=["NaN", "signalling NaN", "-infinity"])
def test_non_finite_imu_samples_are_dropped(word: int) -> None:
    parser = recorded("crc_test")
    assert feed(parser, [struct.pack("<3QI5f", 1, 2, 3, word, 0, 1, 0, 0, 0)]) == []
    assert parser.counters.errors == {"bad_sample": 1}


# --- the manual's figures -------------------------------------------------------------------------------------------


def test_points_match_the_formula_sheet() -> None:
    """FORMULAS 2.2 has 50 m at tick 22528, azimuth 3.2°, altitude −9°, n 15.806 mm, before the sensor's own frame."""
    head = read_head(metadata())
    head.azimuth_rad[2], head.altitude_rad[2] = np.radians([3.2, -9.0])
    row = np.zeros(1, dtype=RETURN_DTYPE)
    row["channel"], row["range_m"], row["encoder_rad"] = 2, 50.0, 2 * np.pi * (1 - 22_528 / 90_112)
    x, y, z = beam_points(row, head)[0]
    np.testing.assert_allclose([-x, -y, z - 0.03618], [-2.755841, -49.307634, -7.819251], atol=1e-6)


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize(("beams", "columns"), [(16, 512), (64, 2048)])
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=5, deadline=None)
def test_encoded_packets_are_decoded_to_their_input(profile: str, beams: int, columns: int, seed: int) -> None:
    parser = parser_of(metadata(profile, beams, columns))
    layout, random = parser.layout, np.random.default_rng(seed)
    fields, status = random_fields(layout, random), random.integers(0, 2, 16)
    place = int(random.integers(0, columns // 16))
    time_ns = 1_000_000_000 + 97_656 * np.arange(16)
    unit = layout.encode(65_535, 16 * place, time_ns, fields, status)
    rows = feed(parser, [unit])
    assert parser.counters.messages == {"lidar": 1}
    table = np.frombuffer(unit, dtype=layout.dtype)
    for name, values in fields.items():
        np.testing.assert_array_equal(layout.field(table["columns"]["pixels"][0], name), values)
    valid = status[:, np.newaxis] == 1
    ranges = [fields[name] * valid for name in ("RANGE", "RANGE2") if name in fields]
    assert sum(map(np.count_nonzero, ranges)) == sum(len(one.rows) for one in rows if isinstance(one, ScannerReturns))
    if not any(map(np.count_nonzero, ranges)):
        return
    found = returns_of(rows)
    pulse = found["pulse_id"].astype(np.int64) % (16 * beams)
    np.testing.assert_array_equal(found["channel"], pulse % beams)
    np.testing.assert_array_equal(measurement_ids(found, columns), 16 * place + pulse // beams)
    np.testing.assert_array_equal(found["device_time_ns"], time_ns[pulse // beams])
    sent = np.stack([one.reshape(-1)[pulse] for one in ranges])
    assert (np.rint(found["range_m"] * 1000) == sent).any(axis=0).all()


@pytest.mark.parametrize("order", ["STRONGEST_TO_WEAKEST", "FARTHEST_TO_NEAREST", "NEAREST_TO_FARTHEST"])
@pytest.mark.parametrize("profile", ["RNG19_RFL8_SIG16_NIR16_DUAL", "RNG15_RFL8_NIR8_DUAL"])
def test_two_returns_follow_the_return_order(profile: str, order: str) -> None:
    parser = parser_of(metadata(profile, return_order=order))
    fields = random_fields(parser.layout, np.random.default_rng(3))
    if order != "STRONGEST_TO_WEAKEST":
        pair = np.sort(np.stack([fields["RANGE"], fields["RANGE2"]]), axis=0)
        fields["RANGE"], fields["RANGE2"] = pair if order == "NEAREST_TO_FARTHEST" else pair[::-1]
    light = "SIGNAL" if "SIGNAL" in fields else "REFLECTIVITY"
    got = returns_of(feed(parser, [parser.layout.encode(1, 0, np.arange(1, 17), fields)]))
    want = []
    for place in range(16 * 16):
        both = [(int(fields[f"RANGE{k}"].flat[place]), int(fields[f"{light}{k}"].flat[place])) for k in ("", "2")]
        there = [one for one in both if one[0]]
        strongest = (
            there[0] if there and order == "STRONGEST_TO_WEAKEST" else max(there, key=lambda one: one[1], default=0)
        )
        for number, one in enumerate(sorted(there, key=lambda one: one[0]), start=1):
            said = len(there) == 1 or order == "STRONGEST_TO_WEAKEST" or light == "SIGNAL"
            flags = RETURN_FLAG_STRONGEST * (said and one is strongest) + RETURN_FLAG_LAST * (number == len(there))
            want.append((place, one[0], one[1], number, len(there), flags))
    columns = ("pulse_id", "range_m", "intensity", "return_number", "number_of_returns", "flags")
    scaled = [got[name] * 1000 if name == "range_m" else got[name] for name in columns]
    base = int(got["pulse_id"][0]) // 256 * 256
    found = np.rint(np.stack([column.astype(np.float64) for column in scaled], axis=1)).astype(np.int64)
    found[:, 0] -= base
    assert [tuple(row) for row in found.tolist()] == want


@pytest.mark.parametrize(
    ("order", "flag"),
    [
        ("STRONGEST_TO_WEAKEST", RETURN_FLAG_STRONGEST),
        ("FARTHEST_TO_NEAREST", RETURN_FLAG_LAST),
        ("NEAREST_TO_FARTHEST", 0),
    ],
)
def test_a_single_return_follows_the_return_order(order: str, flag: int) -> None:
    parser = parser_of(metadata(return_order=order))
    assert (returns_of(feed(parser, frames_of(parser.layout, 1)))["flags"] == flag).all()


@pytest.mark.parametrize(
    ("mode", "config", "latched"),
    [
        ("TIME_FROM_SYNC_PULSE_IN", {"pps": "main"}, True),
        ("TIME_FROM_SYNC_PULSE_IN", {"pps": None}, False),
        ("TIME_FROM_INTERNAL_OSC", {"pps": "main"}, False),
        ("TIME_FROM_PTP_1588", {"pps": "main"}, False),
    ],
)
def test_the_pulse_lies_at_the_whole_second_where_one_is_wired(
    mode: str, config: dict[str, Any], latched: bool
) -> None:
    parser = parser_of(metadata(timestamp_mode=mode), **config)
    records = feed(parser, frames_of(parser.layout, 40))
    clock = np.concatenate([record.rows for record in records if isinstance(record, DeviceClockSamples)])
    assert len(clock) == 40
    np.testing.assert_array_equal(clock["device_time_ns"], 5_000_000_000 + 97_656 * (16 * np.arange(1, 41) - 1))
    np.testing.assert_array_equal(clock["pps_time_ns"], 5_000_000_000 if latched else -1)
    assert set(clock["locked"].tolist()) == {-1}
    (status,) = [record for record in records if isinstance(record, DeviceStatus)]
    assert status.values["timestamp_mode"] == mode
    assert status.values.get("nmea_input") == (False if "SYNC" in mode else None)


# --- lost, repeated and damaged -------------------------------------------------------------------------------------


@pytest.mark.parametrize("profile", ["LEGACY", "RNG15_RFL8_NIR8", "FUSA_RNG15_RFL8_NIR8_DUAL"])
def test_lost_packets_are_counted(profile: str) -> None:
    parser = parser_of(metadata(profile, columns=512))
    units = frames_of(parser.layout, 200)
    rows = returns_of(
        feed(
            parser,
            units[:30] + units[35:80] + units[79:80] + units[90:100] + units[101:102] + units[100:101] + units[102:],
        )
    )
    assert parser.counters.errors == {"sequence_gap": 5 + 10 + 1, "duplicate": 1, "out_of_order": 1}
    assert len(np.unique(rows["pulse_id"])) == len(np.unique(rows[["pulse_id", "return_number"]])) - (
        np.count_nonzero(rows["return_number"] == 2)
    )
    whole = returns_of(feed(parser_of(metadata(profile, columns=512)), units))
    assert set(rows["pulse_id"].tolist()) <= set(whole["pulse_id"].tolist())


def test_frame_numbers_wrap_without_a_gap() -> None:
    parser = parser_of(metadata(columns=512))
    time_ns = 97_656 * np.arange(16)
    for frame in (65_534, 65_535, 0, 1):
        units = [parser.layout.encode(frame, 16 * at, time_ns + at, {"RANGE": 5000}) for at in range(32)]
        time_ns += 100_000_000
        feed(parser, units)
    assert not parser.counters.errors


@pytest.mark.parametrize(("window", "places"), [((100, 400), range(6, 26)), ((480, 40), [0, 1, 2, 30, 31])])
def test_an_azimuth_window_is_not_a_gap(window: tuple[int, int], places: list[int]) -> None:
    parser = parser_of(metadata(columns=512, window=window))
    units = [
        parser.layout.encode(frame, 16 * at, 10**8 * frame + 10**5 * at + np.arange(16), {"RANGE": 5000})
        for frame in range(3)
        for at in places
    ]
    feed(parser, units)
    assert not parser.counters.errors
    feed(parser, [parser.layout.encode(3, 16 * 28, 4 * 10**8 + np.arange(16), {"RANGE": 5000})])
    assert parser.counters.errors == {"outside_window": 1}
    feed(parser, units[2 * len(places) + 2 :])
    feed(parser, [parser.layout.encode(3, 16 * places[2], 5 * 10**8 + np.arange(16), {"RANGE": 5000})])
    assert parser.counters.errors["sequence_gap"] >= 2


def test_a_restarted_head_is_not_a_gap() -> None:
    parser = parser_of(metadata(columns=512))
    units = frames_of(parser.layout, 40)
    anew = [
        parser.layout.encode(0, 16 * at, 10**9 + 10**6 * at + np.arange(16), {"RANGE": 5000}, init_id=78)
        for at in range(3, 9)
    ]
    records = feed(parser, units + anew)
    assert parser.counters.errors == {"restart": 1}
    said = [one.values["metadata_of_this_start"] for one in records if isinstance(one, DeviceStatus)]
    assert said == [True, False]
    rows = returns_of(records)
    first_of = np.unique(rows["pulse_id"][rows["host_time_ns"] >= 40_000_000] // 256)
    last_of = np.unique(rows["pulse_id"][rows["host_time_ns"] < 40_000_000] // 256)
    assert first_of.min() == last_of.max() + 1


def test_a_restarted_frame_number_is_not_a_gap() -> None:
    """LEGACY packets have no start identifier, and under PTP the timestamps continue."""
    parser = parser_of(metadata("LEGACY", columns=512, timestamp_mode="TIME_FROM_PTP_1588"))
    units = [
        parser.layout.encode(frame, 16 * at, 10**18 + 10**9 * turn + 10**6 * at + np.arange(16), {"RANGE": 5000})
        for turn, frame in enumerate((40_000, 40_001, 0, 1))
        for at in range(32)
    ]
    feed(parser, units)
    assert parser.counters.errors == {"restart": 1}


def test_health_is_reported_only_when_it_changes() -> None:
    parser = parser_of(metadata())
    units = frames_of(parser.layout, 6)
    for at, seconds in ((2, 30), (3, 29), (4, 29)):
        unit = bytearray(units[at])
        unit[16] = seconds
        units[at] = with_crc(bytes(unit))
    told = [one.values["shutdown_countdown_s"] for one in feed(parser, units) if isinstance(one, DeviceStatus)]
    assert told == [0, 30, 29, 0]


@pytest.mark.parametrize(
    ("at", "new", "code"),
    [
        (0, b"\x02", "bad_packet_type"),
        (7, b"\x00", "wrong_serial"),
        (40 + 16 * 12 + 12, b"\x09", "bad_column"),  # id of the second column
        (39, b"\x80", "bad_timestamp"),
    ],
)
def test_impossible_packets_are_counted(at: int, new: bytes, code: str) -> None:
    parser = parser_of(metadata())
    units = frames_of(parser.layout, 3)
    units[1] = with_crc(units[1][:at] + new + units[1][at + len(new) :])
    rows = returns_of(feed(parser, units))
    assert parser.counters.errors == {code: 1, "sequence_gap": 1}
    assert parser.counters.bad_messages == 1
    assert parser.counters.bytes_skipped == len(units[1])
    assert set(rows["host_time_ns"].tolist()) == {0, 2_000_000}


def test_imu_packets_of_another_head_are_counted() -> None:
    parser = recorded("imu_zm_no_lidar")
    units = list(payloads("imu_zm_no_lidar"))
    for at, place in ((1, 0), (2, 7), (3, 140)):
        unit = bytearray(units[at])
        unit[place] ^= 0x40
        units[at] = bytes(unit) if place == 140 else with_crc(bytes(unit))
    rows = samples_of(feed(parser, units))
    assert parser.counters.errors == {"bad_packet_type": 1, "wrong_serial": 1}
    assert parser.counters.bad_checksums == 1
    assert parser.counters.messages == {"imu": 5, "zone": 1}
    assert len(rows) == 5 * 8


def test_encoder_counts_of_another_mode_are_refused() -> None:
    """LEGACY packets contain the encoder, which reveals metadata with another number of columns."""
    units = frames_of(parser_of(metadata("LEGACY", columns=512)).layout, 10)
    parser = parser_of(metadata("LEGACY", columns=1024))
    feed(parser, units)
    assert parser.counters.errors == {"bad_column": 10}


def test_the_crc_detects_every_flipped_bit() -> None:
    units = [unit for unit in payloads("crc_test") if len(unit) > 48]
    random = np.random.default_rng(5)
    for _ in range(20):
        broken = bytearray(units[3])
        broken[random.integers(0, len(broken) - 8)] ^= 1 << int(random.integers(0, 8))
        parser = recorded("crc_test")
        rows = returns_of(feed(parser, [*units[:3], bytes(broken), *units[4:8]]))
        assert parser.counters.bad_checksums == 1
        assert parser.counters.errors == {"sequence_gap": 1}
        assert parser.counters.bytes_skipped == len(broken)
        assert 3_000_000 not in rows["host_time_ns"]


def test_a_crc_field_that_the_firmware_does_not_fill_is_accepted() -> None:
    assert {unit[-8:] for unit in payloads("windowed_frame1") if len(unit) > 48} == {bytes.fromhex("dec00000efbeadde")}
    assert {unit[-8:] for unit in payloads(DUAL) if len(unit) > 48} == {bytes(8)}


def test_packets_of_another_length_are_counted() -> None:
    parser = recorded("crc_test")
    unit = payloads("crc_test")[0]
    for length in (0, 1, 47, 49, 680, 8447):
        assert parser.feed(Chunk("scanner/left", 0, unit[:length])) == []
    assert parser.counters.errors == {"bad_length": 5}
    assert parser.counters.bad_checksums == 1  # 680 is the length of a zone packet
    assert parser.counters.bytes_skipped == 47 + 1 + 49 + 680 + 8447


def test_the_driver_declares_its_records() -> None:
    driver = find_driver("scanner", "ouster")
    assert driver.transports == ("udp",)
    assert driver.make_time_parser is not None
    settings = DeviceSettings("scanner/left", {}, {"geometry": metadata_of("crc_test")})
    parser = driver.make_time_parser(settings)
    assert isinstance(parser, OusterParser)
    assert {type(one) for one in feed(parser, payloads("crc_test"))} == {DeviceClockSamples, DeviceStatus}
    everything = {type(one) for one in feed(recorded("crc_test"), payloads("crc_test"))}
    assert everything == {DeviceClockSamples, DeviceStatus, ScannerReturns, ImuSamples} == set(driver.yields)


def test_a_head_is_recognised_by_its_packet_format() -> None:
    driver = find_driver("scanner", "ouster")
    assert driver.make_probe is not None
    probe = driver.make_probe(DeviceSettings("scanner/left"))
    for capture in LIDAR:
        for unit in payloads(capture):
            probe.feed(Chunk("scanner/left", 0, unit))
    assert probe.counters.messages == {"lidar": 64 + 1 + 64 + 192 + 34 + 17}
    both = driver.make_probe(DeviceSettings("scanner/left"))
    for unit in payloads("same_ports"):  # a LEGACY head of 64 beams, one with two returns, and their IMUs
        both.feed(Chunk("scanner/left", 0, unit))
    assert both.counters.messages == {"lidar": 2}
    assert both.counters.bytes == both.counters.bytes_framed + both.counters.bytes_skipped
    others = driver.make_probe(DeviceSettings("scanner/left"))
    random = np.random.default_rng(1)
    for length in range(64, 9000, 16):
        others.feed(Chunk("scanner/left", 0, random.bytes(length)))
    assert not others.counters.messages


def test_serial_numbers_match_the_metadata() -> None:
    for capture in (DUAL, LOW, "crc_test", "windowed_frame1"):
        layout, packets = lidar_packets(capture)
        assert set(layout.serial(packets).tolist()) == {layout.head.serial}
        assert set(layout.init_id(packets).tolist()) == {layout.head.init_id}
    assert read_head(metadata()).serial == SERIAL
