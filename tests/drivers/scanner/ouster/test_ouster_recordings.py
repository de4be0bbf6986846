"""Tests Ouster: the maker's digests of fields in packets and in frames, and its poses of three frames."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree

from swath.drivers.captures.opening import read_pcap
from swath.drivers.driver import find_driver
from swath.drivers.parser import DeviceSettings
from swath.drivers.scanner.ouster.head import beam_points
from swath.drivers.scanner.ouster.layout import LidarLayout
from swath.georef.arrays import StructArray
from swath.georef.records import Chunk
from tests.drivers.builders import feed, returns_of
from tests.drivers.ouster_cases import EXPECTED, FIXTURES, metadata_of, payloads, recorded
from tests.drivers.scanner.ouster.builders import lidar_packets

DIGESTED = ("OS-0-32-U1_v2.2.0_1024x10", "OS-1-32-G_v2.1.1_1024x10")
SINGLE = "OS-0-32-U1_v2.2.0_1024x10-single-packet"
THREE = "OS-1-128_v2.3.0_1024x10_lb_n3"
# raw words that contain the fields; without ENCODER_COUNT if packets lack it, FRAME_ID once per packet
NOT_DECODED = {"RAW32_WORD1", "RAW32_WORD2", "RAW32_WORD3", "RAW32_WORD4"}
DTYPES = {"RANGE": "u4", "RANGE2": "u4", "SIGNAL": "u2", "SIGNAL2": "u2", "NEAR_IR": "u2"}  # the rest is of one byte


def md5(values: np.ndarray[Any, Any], dtype: str) -> str:
    return hashlib.md5(np.ascontiguousarray(values.astype(dtype)).tobytes()).hexdigest()


def column_values(layout: LidarLayout, columns: StructArray) -> Iterator[tuple[str, np.ndarray[Any, Any]]]:
    """Return the values that the manufacturer's decoder gives once a column, by name."""
    yield "TIMESTAMP", columns["time_ns"]
    yield "MEASUREMENT_ID", columns["id"]
    has_encoder = "encoder" in (columns.dtype.names or ())
    yield "STATUS", columns["status"] if has_encoder else layout.valid(columns)
    if has_encoder:
        yield "ENCODER_COUNT", columns["encoder"]


@pytest.mark.parametrize("capture", DIGESTED)
def test_packet_fields_match_the_manufacturers_digests(capture: str) -> None:
    """The manufacturer's digest covers each field through all packets, each packet beam by beam."""
    digests = json.loads((FIXTURES / f"{capture}_digest.json").read_text())["packet_hash"]
    layout, packets = lidar_packets(capture)
    dtypes = {"TIMESTAMP": "u8", "MEASUREMENT_ID": "u2", "STATUS": "i4", "ENCODER_COUNT": "u4"}
    found = {name: md5(values, dtypes[name]) for name, values in column_values(layout, packets["columns"])}
    for name in layout.profile.fields:
        beam_by_beam = layout.field(packets["columns"]["pixels"], name).transpose(0, 2, 1)
        found[name] = md5(beam_by_beam, DTYPES.get(name, "u1"))
    compared = {name: digest for name, digest in digests.items() if name in found}
    assert found == compared
    assert set(digests) - set(compared) <= {"FRAME_ID", "ENCODER_COUNT", *NOT_DECODED}


@pytest.mark.parametrize("capture", DIGESTED)
def test_frame_fields_match_the_manufacturers_digests(capture: str) -> None:
    """The image of each field is compared, its pixels staggered as sent, and the values of each column."""
    [digests] = json.loads((FIXTURES / f"{capture}_digest.json").read_text())["scans"]
    layout, packets = lidar_packets(capture)
    assert set(layout.frame_id(packets).tolist()) == {int(digests["FRAME_ID"])}
    columns = packets["columns"].reshape(-1)
    assert columns["id"].tolist() == list(range(layout.head.columns_per_frame))
    dtypes = {"TIMESTAMP": "u8", "MEASUREMENT_ID": "u2", "STATUS": "u8", "ENCODER_COUNT": "u8"}
    found = {name: md5(values, dtypes[name]) for name, values in column_values(layout, columns)}
    for name in layout.profile.fields:
        if not name.startswith("FLAGS"):
            found[name] = md5(layout.field(columns["pixels"], name).T, DTYPES.get(name, "u1"))
    compared = {name: digest for name, digest in digests.items() if name in found}
    assert found == compared
    assert set(digests) - set(compared) <= {"FRAME_ID", "ENCODER_COUNT"}


def test_a_single_packet_gives_its_part_of_the_frame() -> None:
    [packet] = payloads(SINGLE)
    assert packet in payloads(DIGESTED[0])
    with np.load(FIXTURES / f"{SINGLE}.ouster_sdk.npz") as archive:
        ranges, columns = archive["RANGE"], np.flatnonzero(archive["status"] & 1)
    rows = returns_of(feed(recorded(SINGLE), [packet]))
    assert len(np.unique(rows["device_time_ns"])) == len(columns) == 16
    nearest_or_only = rows[rows["return_number"] == 1]
    assert len(nearest_or_only) >= np.count_nonzero(ranges)


def test_the_manufacturers_poses_align_successive_frames() -> None:
    """The manufacturer's poses (rows of 3 × 4, in the sensor's frame) bring the later frames nearer to the first."""
    parser = recorded(THREE)
    rows = returns_of(feed(parser, payloads(THREE)))
    points = beam_points(rows, parser.head)
    poses = np.loadtxt(FIXTURES / f"{THREE}_poses_kitti.txt").reshape(-1, 3, 4)
    scans = EXPECTED[f"{THREE}.pcap"]["scans"]
    assert len(poses) == len(scans) == 3
    usable = (rows["range_m"] > 3.0) & (rows["range_m"] < 60.0)
    time_ns = rows["device_time_ns"]
    frames = [points[usable & (time_ns >= scan["ts_first"]) & (time_ns <= scan["ts_last"])] for scan in scans]
    first = cKDTree(frames[0])
    for frame, pose in zip(frames[1:], poses[1:], strict=True):
        some, rotation, moved = frame[::17], pose[:, :3], pose[:, 3]
        apart = [
            np.median(first.query(some_moved)[0])
            for some_moved in (some @ rotation.T + moved, some, (some - moved) @ rotation)
        ]
        assert apart[0] < 0.75 * apart[1] < 0.75 * apart[2]


# --- captures that are not Ouster's


@pytest.mark.parametrize("capture", ["VLI-16-one-packet.pcap.gz", "empty_pcap.pcap"])
@pytest.mark.parametrize("protocol", ["ouster", "velodyne-vlp16"])
def test_a_foreign_datagram_is_counted_and_gives_no_returns(capture: str, protocol: str) -> None:
    """One capture has 1212 bytes to Velodyne's port, of a head similar to a VLP-16; the other is empty."""
    units = [unit.data for unit in read_pcap(FIXTURES.parent / "captures" / capture)]
    assert [len(unit) for unit in units] == ([1212] if capture.startswith("VLI") else [])
    parser = find_driver("scanner", protocol).make_parser(
        DeviceSettings("scanner/left", {}, {"geometry": metadata_of(DIGESTED[0])} if protocol == "ouster" else {})
    )
    assert [record for unit in units for record in parser.feed(Chunk("scanner/left", 1, unit))] == []
    assert not +parser.counters.messages
    assert parser.counters.bytes == parser.counters.bytes_skipped == sum(map(len, units))
    assert parser.counters.errors == {"bad_length": 1} if units else not parser.counters.errors
