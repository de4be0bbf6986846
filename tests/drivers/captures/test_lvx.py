"""Tests files of Livox Viewer: a file of each kind computed by hand, times of every type, cut and damaged files.

The collection has no recording. The layouts are those of the maker's writer (Livox-SDK, sample/lidar_lvx_file) and of
the "LVX2 Specifications" v1.0.
"""

from __future__ import annotations

import datetime as dt
import gzip
import struct
from pathlib import Path

import numpy as np
import pytest

from swath.drivers.captures.base import CapturedUnit, CaptureTally
from swath.drivers.captures.opening import is_lvx, read_lvx, read_lvx_heads, tells_time
from swath.drivers.scanner.livox.layout import (
    GPS_2,
    IMU_1,
    NO_SYNC,
    POINTS_1,
    POINTS_2,
    PPS_1,
    PPS_GPS_1,
    encode_packet_1,
    encode_packet_2,
    utc_bytes,
)
from swath.drivers.transports.base import TransportError
from swath.georef.arrays import StructArray
from tests.drivers.lvx_files import FileHead, beginning, lvx1_package, lvx2_package, lvx_file

S = 1_000_000_000
START_NS = 1_800_000_000 * S
AVIA = FileHead("3JEDHB300100641", 0, 7, (1.5, -90.0, 180.0, 0.25, -0.5, 1.125))
MID360 = FileHead("47MDK4A0020123", 0x0C01A8C0, 9, enabled=0)
BEGUN = dt.datetime(2026, 11, 27, 10, 59, 59, 999_000, tzinfo=dt.UTC)
BEGUN_NS = int(BEGUN.timestamp()) * S + 999_000_000


def write(folder: Path, data: bytes, name: str = "flight.lvx") -> Path:
    """Write a file and return its path."""
    path = folder / name
    path.write_bytes(data)
    return path


def read(path: Path, start_ns: int | None = START_NS) -> tuple[list[CapturedUnit], CaptureTally]:
    """Return the units of a file and what was counted."""
    tally = CaptureTally()
    return list(read_lvx(path, start_ns, tally)), tally


def imu_1(time: int | bytes, time_type: int = NO_SYNC) -> bytes:
    """Return a packet of SDK 1 with a sample of the IMU: a time without duration."""
    return encode_packet_1(IMU_1, time_type, time, [((0.1, 0.2, 0.3), (0, 0, 1))])


def points(count: int) -> StructArray:
    """Return points of SDK 2 in millimetres."""
    return np.ones(count, dtype=POINTS_2[1].dtype)


def test_a_file_of_sdk_1_is_read_as_computed_by_hand(tmp_path: Path) -> None:
    """The frame begins at byte 24 + 5 + 59 = 88; its package has 1 + 18 + 24 bytes and ends at byte 155."""
    sent = bytes.fromhex("05 01 01 00 00820000 03 06 1a0b1b0a 58cc92d6") + struct.pack("<6f", 1, 2, 3, 0.5, 0, -1)
    data = b"livox_tech\0\0\0\0\0\0" + bytes.fromhex("01010000 67a70eac") + bytes.fromhex("32000000 01")
    data += b"3JEDHB300100641\0" + bytes(16) + b"\0\7\1" + struct.pack("<6f", 1.5, -90, 180, 0.25, -0.5, 1.125)
    data += struct.pack("<3Q", 88, 155, 0) + b"\0" + sent
    assert len(sent) == 42
    assert len(data) == 155
    path = write(tmp_path, data)
    assert data == lvx_file(1, [AVIA], [[lvx1_package(0, sent)]])
    assert is_lvx(data[:24])
    assert tells_time(path)
    units, tally = read(path, None)
    assert tally == CaptureTally()
    # 3 599 944 792 µs past 10 h of 2026-11-27
    hour_ns = int(dt.datetime(2026, 11, 27, 10, tzinfo=dt.UTC).timestamp()) * S
    assert int.from_bytes(bytes.fromhex("58cc92d6"), "little") == 3_599_944_792
    assert units == [CapturedUnit(hour_ns + 3_599_944_792_000, sent, "3JEDHB300100641")]
    head = read_lvx_heads(path).heads[0]
    assert head.words() == (
        "3JEDHB300100641: Livox Avia; the file claims roll 1.50°, pitch -90.00°, yaw 180.00°, x 0.250 m, y -0.500 m, "
        "z 1.125 m"
    )
    assert head.protocol == "livox-avia"


def test_a_package_of_sdk_2_becomes_the_datagram_computed_by_hand(tmp_path: Path) -> None:
    """Two points 5 µs apart by the data sheet: 50 units of 0.1 µs; the file keeps no CRC, and none is made up."""
    content = struct.pack("<3h2B3h2B", 300, 0, 400, 9, 0, 0, -1200, 500, 8, 0x24)
    time = struct.pack("<Q", 1_700_000_000_250_000_000)
    package = struct.pack("<BIBB8sHBIB4s", 0, 0x0C01A8C0, 0, 2, time, 17_473, 2, 16, 7, b"")
    assert len(package) == 27
    data = beginning(2, [MID360])
    assert len(data) == 24 + 5 + 63
    data += struct.pack("<3Q", 92, 92 + 24 + 27 + 16, 0) + package + content
    path = write(tmp_path, data, "flight.lvx2")
    units, tally = read(path, None)
    assert tally == CaptureTally()
    # version, length, interval, points, counter, frame, type of data, of time, reserved, CRC, time, points
    wanted = struct.pack("<B4H3B12xI", 0, 52, 50, 2, 17_473, 7, 2, 2, 0) + time + content
    assert units == [CapturedUnit(1_700_000_000_250_005_000, wanted, "47MDK4A0020123")]
    head = read_lvx_heads(path).heads[MID360.number]
    assert head.protocol == "livox-mid360"
    assert head.words().endswith("z 0.000 m (not to be used)")
    sent = encode_packet_2(1, GPS_2, BEGUN_NS, points(96), count=5, crc=False)  # 4750 units, as this type sends
    (unit,), _ = read(write(tmp_path, lvx_file(2, [MID360], [[lvx2_package(MID360.number, sent)]])))
    assert unit.data == sent


def test_every_type_of_data_passes_unchanged(tmp_path: Path) -> None:
    """Points of 1 ms are dated by their last pulse, so that no unit is older than its points; gzip is seen through."""
    sent = [encode_packet_1(key, PPS_GPS_1, utc_bytes(BEGUN), [], status=key) for key in (*POINTS_1, IMU_1)]
    packed = gzip.compress(lvx_file(1, [AVIA], [[lvx1_package(0, one) for one in sent]]))
    units, tally = read(write(tmp_path, packed, "flight.lvx.gz"), None)
    assert [unit.data for unit in units] == sent
    assert tally == CaptureTally()
    last = [round((POINTS_1[key].pulses - 1) * 1e9 / 240_000) for key in POINTS_1]
    assert [unit.time_ns - BEGUN_NS for unit in units] == [*last, 0]


def test_stamps_without_utc_count_from_the_given_start(tmp_path: Path) -> None:
    """Two heads began to count at different times; one is set in the third frame; the other restarts there."""
    tele = FileHead("TELE", 1, 2)
    frames = [
        [lvx1_package(0, imu_1(7 * S)), lvx1_package(0, imu_1(7 * S + 20_000_000))],
        [lvx1_package(1, imu_1(90 * S)), lvx1_package(0, imu_1(7 * S + 60_000_000))],
        [
            lvx1_package(1, imu_1(utc_bytes(BEGUN), PPS_GPS_1)),
            lvx1_package(0, imu_1(5)),
            lvx1_package(0, imu_1(1_000_005)),
        ],
    ]
    path = write(tmp_path, lvx_file(1, [AVIA, tele], frames))
    assert not tells_time(path)
    units, tally = read(path)
    assert tally.damage == 0
    assert [(unit.time_ns - START_NS) / 1e6 for unit in units[:4]] == [0, 20, 50, 60]
    assert units[4].time_ns == BEGUN_NS
    assert [(unit.time_ns - START_NS) / 1e6 for unit in units[5:]] == [110, 111]
    with pytest.raises(TransportError, match="have no UTC; give the time"):
        list(read_lvx(path))


def test_stamps_since_the_pulse_go_on_over_seconds_without_packages(tmp_path: Path) -> None:
    """The stamp restarts at each pulse; the count of frames gives the seconds of a gap of 3 s."""
    stamps = {0: [900_000_000, 950_000_000, 949_000_000], 2: [50_000_000], 62: [30_000_000]}
    frames = [[lvx1_package(0, imu_1(at, PPS_1)) for at in stamps.get(frame, [])] for frame in range(63)]
    units, _ = read(write(tmp_path, lvx_file(1, [AVIA], frames)))
    assert [(unit.time_ns - START_NS) / 1e6 for unit in units] == [0, 50, 49, 150, 3130]


def test_a_file_cut_anywhere_gives_its_whole_packages(tmp_path: Path) -> None:
    sent = [imu_1(S + at) for at in range(3)]
    file = lvx_file(1, [AVIA], [[lvx1_package(0, one) for one in sent[:2]], [lvx1_package(0, sent[2])]])
    ends = [88 + 24 + 43, 88 + 24 + 86, 88 + 24 + 86 + 24 + 43]
    for length in range(24, len(file)):
        path = write(tmp_path, file[:length])
        if length < 88:
            with pytest.raises(TransportError, match="ends in its"):
                list(read_lvx(path, START_NS))
            continue
        units, tally = read(path)
        assert [unit.data for unit in units] == sent[: sum(length >= end for end in ends)], length
        assert tally.damage == (length not in (88, ends[1])), length
    assert read(write(tmp_path, file))[1].damage == 0


def test_damage_is_counted_and_the_next_frame_is_read(tmp_path: Path) -> None:
    good = lvx1_package(0, imu_1(S))
    unknown = bytearray(good)
    unknown[10] = 9
    file = bytearray(
        lvx_file(1, [AVIA], [[bytes(unknown), good], [good + b"\0" * 9], [good], [lvx1_package(5, imu_1(S))]])
    )
    units, tally = read(write(tmp_path, bytes(file)))
    assert [unit.channel for unit in units] == [AVIA.code, AVIA.code, "head 5"]
    assert tally.damage == 2
    assert tally.first_damage.endswith("unknown type of data 9 at byte 112; the rest of its frame is left out")
    file[20] ^= 1
    file[88] ^= 1  # the first frame's own place
    assert read(write(tmp_path, bytes(file)))[1].damage == 4
    file[96:104] = bytes(8)  # where the next frame is
    units, tally = read(write(tmp_path, bytes(file)))
    assert units == []
    assert tally.damage == 3


@pytest.mark.parametrize(
    ("data", "problem"),
    [
        (beginning(1, [AVIA], version=b"\1\0\0\0"), "is of version 1.0 .* want 1.1"),
        (beginning(2, [MID360], version=b"\3\0\0\0"), "is of version 3.0"),
        (b"livox_tech", "ends in its header"),
    ],
)
def test_other_versions_are_refused_in_a_line(tmp_path: Path, data: bytes, problem: str) -> None:
    with pytest.raises(TransportError, match=problem):
        read_lvx_heads(write(tmp_path, data))
