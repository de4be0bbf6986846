"""Tests the reader of bags: every type of message in every container, recorded bags, other forms and damage."""

from __future__ import annotations

import gzip
import sqlite3
import sys
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from swath.drivers.captures.base import CaptureDamageError, CapturedUnit, CaptureTally
from swath.drivers.captures.opening import open_bag, read_bag, read_pcap
from swath.drivers.captures.rosbag.messages import RAW_TYPES
from swath.drivers.captures.rosbag.unwrap import Packets, Unit
from swath.drivers.transports.base import TransportError
from tests.drivers.captures.bags import (
    CONTAINERS,
    START_NS,
    Container,
    Ros,
    Units,
    bag_writer,
    every_type,
    payloads,
    write_bag,
)
from tests.drivers.recordings import FIXTURES

RECORDED = {
    "nebula_vlp16": ("/velodyne_packets", "velodyne", 603),
    "nebula_xt16": ("/pandar_packets", "hesai", 1626),
    "nebula_xt32m": ("/pandar_packets", "hesai", 1815),
    "nebula_qt128": ("/pandar_packets", "hesai", 1800),
}
SCAN, PACKET = "pandar_msgs/msg/PandarScan", "pandar_msgs/msg/PandarPacket"


def by_topic(units: list[CapturedUnit]) -> Units:
    """Return time and bytes of the units of each topic."""
    found: Units = {}
    for unit in units:
        found.setdefault(unit.channel, []).append((unit.time_ns, unit.data))
    return found


@pytest.mark.parametrize("container", CONTAINERS)
def test_every_type_gives_the_units_that_it_was_made_of(tmp_path: Path, container: Container) -> None:
    """The messages are serialised by rosbags; stamps of 0 give way to the bag's times."""
    messages, units = every_type(Ros(container))
    assert {kind for _, kind, _, _ in messages} == set(RAW_TYPES)
    file = write_bag(tmp_path / "bag", container, messages)
    with open_bag(file) as bag:
        names = list(bag.topics)
        assert {topic.kind for topic in bag.topics.values()} == set(RAW_TYPES)
        assert bag.kind == ("ROS 1" if container == "bag" else "ROS 2")
    assert by_topic(list(read_bag(file, names))) == units
    if container == "db3":  # as recorders before schema 4 write it: without the definitions
        with sqlite3.connect(file) as database:
            database.executescript("DELETE FROM message_definitions; UPDATE schema SET schema_version = 3")
        database.close()
        assert by_topic(list(read_bag(file, names))) == units
        assert by_topic(list(read_bag(file.parent, names))) == units
    assert set(by_topic(list(read_bag(file, ["/rslidar_packets"])))) == {"/rslidar_packets", "/rslidar_packets#2"}


@pytest.mark.parametrize("name", RECORDED)
def test_a_recorded_bag_gives_the_datagrams_of_its_capture(tmp_path: Path, name: str) -> None:
    """Another program made the capture, and the clouds that the scanners' tests compare, from the same bag."""
    topic, folder, count = RECORDED[name]
    (tmp_path / "part#1 of 2?.db3").write_bytes(gzip.decompress((FIXTURES / "rosbag" / f"{name}.db3.gz").read_bytes()))
    units = list(read_bag(tmp_path / "part#1 of 2?.db3", [topic]))
    captured = list(read_pcap(FIXTURES / folder / f"{name}.pcap.gz"))
    assert len(units) == count
    assert [(unit.time_ns, unit.data) for unit in units] == [(unit.time_ns, unit.data) for unit in captured]


@pytest.mark.parametrize("container", ["db3", "mcap"])
def test_a_second_form_of_packets_is_found(tmp_path: Path, container: Container) -> None:
    """Packages of one name disagree about the length of packets; a bag without definitions does not say which it is."""
    ros, packets = Ros(container, 1), payloads(1194, 4)
    file = write_bag(
        tmp_path / "bag", container, [("/p", SCAN, START_NS, ros.scan(SCAN, PACKET, packets, sized=True))], 1
    )
    if container == "db3":
        with sqlite3.connect(file) as database:
            database.executescript("DELETE FROM message_definitions; UPDATE schema SET schema_version = 3")
        database.close()
    assert by_topic(list(read_bag(file, ["/p"]))) == {"/p": packets}


def test_a_message_of_other_fields_than_its_type_is_damage(tmp_path: Path) -> None:
    """Another package of the same name defines a frame without its flags."""
    kind = "can_msgs/msg/Frame"
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg("uint32 id\nuint8[] data\n", kind))
    with Writer(tmp_path / "bag", version=9) as writer:
        connection = writer.add_connection("/can", kind, typestore=store)
        message = store.types[kind](id=1, data=np.zeros(3, np.uint8))
        writer.write(connection, START_NS, store.serialize_cdr(message, kind))
    tally = CaptureTally()
    assert list(read_bag(tmp_path / "bag", ["/can"], tally)) == []
    assert tally.damage == 1
    assert "a message of /can is not can_msgs/msg/Frame: 'can_msgs__msg__Frame' object has no" in tally.first_damage


@pytest.mark.parametrize("mode", [CompressionMode.FILE, CompressionMode.MESSAGE, CompressionMode.STORAGE])
def test_a_compressed_bag_is_read_by_its_folder(tmp_path: Path, mode: CompressionMode) -> None:
    """Files and messages are compressed by rosbag2 itself, chunks by the container."""
    container: Container = "mcap" if mode == CompressionMode.STORAGE else "db3"
    ros, packets = Ros(container), payloads(568, 5)
    writer, file = bag_writer(tmp_path / "bag", container)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection("/p", SCAN, typestore=ros.store)
        scan = ros.scan(SCAN, PACKET, packets, length=1500, sized=True)
        writer.write(connection, START_NS, ros.store.serialize_cdr(scan, SCAN))
    assert by_topic(list(read_bag(tmp_path / "bag", ["/p"]))) == {"/p": packets}
    if mode == CompressionMode.MESSAGE:
        tally = CaptureTally()
        assert not list(read_bag(file, ["/p"], tally))
        assert "is not CDR; if its messages are compressed, give the folder" in tally.first_damage


def test_big_endian_cdr_is_read() -> None:
    """DDSI-RTPS, 10.2: an encapsulation of 00 00 says that numbers are big-endian."""
    body = b"\0\0\0\0" + bytes(8) + b"\0\0\0\1\0" + bytes(3) + b"\0\0\0\2"
    packets = [
        b"\0\0\0\1\0\0\0\2" + b"ab" + bytes(2) + b"\0\0\0\1",
        b"\0\0\0\3\0\0\0\4" + b"cd" + bytes(2) + b"\0\0\0\2",
    ]
    fixed = Packets(ros2=True, header=True, length=2, sized=True)
    assert list(fixed.units(body + b"".join(packets))) == [Unit(1_000_000_002, b"a"), Unit(3_000_000_004, b"cd")]
    varying = Packets(ros2=True, header=False, length=None, sized=False)
    data = b"\0\0\0\0\0\0\0\1" + b"\0\0\0\5\0\0\0\6\0\0\0\3abc"
    assert list(varying.units(data)) == [Unit(5_000_000_006, b"abc")]


@pytest.mark.parametrize("container", CONTAINERS)
def test_damaged_messages_are_counted_and_the_others_read(tmp_path: Path, container: Container) -> None:
    ros, packets = Ros(container), payloads(568, 2)
    good = ros.scan(SCAN, PACKET, packets, length=1500, sized=True)
    long = ros.scan(SCAN, PACKET, packets, length=1500, sized=True)
    long.packets[0].size = 1501
    serialise = ros.store.serialize_ros1 if container == "bag" else ros.store.serialize_cdr
    whole = bytes(serialise(good, SCAN))
    messages = [
        ("/p", SCAN, START_NS + n, m) for n, m in enumerate([good, whole[:-9], b"", whole + bytes(9), long, good])
    ]
    tally = CaptureTally()
    file = write_bag(tmp_path / "bag", container, messages)
    assert by_topic(list(read_bag(file, ["/p"], tally)))["/p"] == [*packets, packets[1], *packets]
    assert tally.damage == 4
    assert "a message of /p is not pandar_msgs/msg/PandarScan: " in tally.first_damage
    with pytest.raises(CaptureDamageError, match="a message of /p"):
        list(read_bag(file, ["/p"]))


@pytest.mark.parametrize("container", CONTAINERS)
def test_a_damaged_bag_is_refused_or_read_to_its_damage(tmp_path: Path, container: Container) -> None:
    """Whatever the library raises of a file that is cut off or overwritten, it becomes one line."""
    ros = Ros(container)
    scans = [ros.scan(SCAN, PACKET, payloads(568, 9, n), length=1500, sized=True) for n in range(40)]
    messages = [("/p", SCAN, START_NS + n * 10**8, scan) for n, scan in enumerate(scans)]
    whole = write_bag(tmp_path / "bag", container, messages).read_bytes()
    refusals: list[str] = []
    counted = 0
    for number in range(1, 12):
        at = len(whole) * number // 12
        for data in (whole[:at], whole[:at] + b"\xff" * 600 + whole[at + 600 :]):
            file = tmp_path / f"damaged.{container}"
            file.write_bytes(data)
            tally = CaptureTally()
            try:
                assert len(list(read_bag(file, ["/p"], tally))) <= 360
                counted += tally.damage > 0
            except TransportError as error:
                refusals.append(str(error))
    assert refusals
    assert all(one.startswith(f"{file}: cannot be read as a bag: ") and "\n" not in one for one in refusals)
    assert counted > 0


@pytest.mark.parametrize("container", ["mcap", "bag"])
def test_a_bag_without_its_index_is_read_to_its_end(tmp_path: Path, container: Container) -> None:
    """A recorder that is killed leaves whole chunks and a part of one; what precedes that part is read."""
    ros, packets = Ros(container), payloads(568, 400)
    scans = [ros.scan(SCAN, PACKET, packets[n : n + 100], length=1500, sized=True) for n in range(0, 400, 100)]
    messages = [("/p", SCAN, START_NS + n * 10**8, scan) for n, scan in enumerate(scans * 20)]
    whole = write_bag(tmp_path / "bag", container, messages).read_bytes()
    file = tmp_path / f"killed.{container}.active"
    for length in (len(whole) // 2, len(whole) // 3):
        file.write_bytes(whole[:length])
        tally = CaptureTally()
        units = by_topic(list(read_bag(file, ["/p"], tally)))["/p"]
        assert units == (packets * 20)[: len(units)]
        assert 0.7 * length < 1512 * len(units) < length
        assert tally.damage == 1
        assert tally.first_damage.startswith(f"{file}: cannot be read further: ")
        with open_bag(file) as bag:
            assert bag.topics["/p"].count * 100 == len(units)
            assert bag.span_ns("/p") is not None


def test_files_that_are_no_bags_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    packed = FIXTURES / "rosbag" / "nebula_vlp16.db3.gz"
    with pytest.raises(TransportError, match="compressed as a whole; unpack it first"):
        open_bag(packed)
    with pytest.raises(TransportError, match=r"nowhere.bag: No such file or directory"):
        open_bag(tmp_path / "nowhere.bag")
    (tmp_path / "metadata.yaml").write_text("rosbag2_bagfile_information: {version: 5}")
    with pytest.raises(TransportError, match="cannot be read as a bag: A metadata key is missing"):
        open_bag(tmp_path)
    monkeypatch.setitem(sys.modules, "swath.drivers.captures.rosbag.bag", None)
    with pytest.raises(TransportError, match=r"need rosbags, which is not installed: pip install '.\[import\]'"):
        open_bag(packed)
