"""Tests ``swath import`` of ROS bags: topics find their devices, units stay exact, a list proposes a configuration."""

from __future__ import annotations

import gzip
import itertools
import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.import_bag import make_bag
from benchmarks.import_bag import run_import as run_bench_import
from swath.daemon.config import load_config
from swath.daemon.errors import UserError
from swath.daemon.exchange.capture_files import ImportOptions
from swath.drivers.captures.opening import read_candump, read_pcap
from tests.builders import ROOT
from tests.daemon.commands import swath
from tests.daemon.exchange.builders import content_of, run_import, write_config
from tests.drivers.captures.bags import (
    CONTAINERS,
    START_NS,
    Container,
    Message,
    Ros,
    cloud_message,
    every_type,
    imu_message,
    payloads,
    write_bag,
)

FIXTURES = ROOT / "fixtures"
SCAN, PACKET = "velodyne_msgs/msg/VelodyneScan", "velodyne_msgs/msg/VelodynePacket"
FRAME, OEM7, BYTES = "can_msgs/msg/Frame", "novatel_oem7_msgs/msg/Oem7RawMsg", "std_msgs/msg/UInt8MultiArray"
IMU = "sensor_msgs/msg/Imu"


def can_message(ros: Ros, time_ns: int, frame: bytes) -> Message:
    """Return a frame of 16 bytes as a message."""
    word = int.from_bytes(frame[:4], "little")
    flags = {"is_rtr": False, "is_extended": word >> 31 == 1, "is_error": False}
    header = ros.header(time_ns)
    message = ros.make(FRAME, header=header, id=word & 0x1FFF_FFFF, **flags, dlc=frame[4], data=frame[8:])
    return "/can/rx", FRAME, time_ns, message


def scan_message(ros: Ros, packets: list[tuple[int, bytes]], topic: str = "/left/velodyne_packets") -> Message:
    """Return one message of a Velodyne head."""
    return topic, SCAN, packets[-1][0], ros.scan(SCAN, PACKET, packets)


def flight(ros: Ros) -> tuple[list[Message], dict[str, list[tuple[int, bytes]]]]:
    """Return a short flight of three devices, its units by topic of the log, and messages that hold no bytes."""
    datagrams = payloads(1206, 300)
    stream = (FIXTURES / "novatel" / "bestpos.gps").read_bytes()
    pieces = [(START_NS + n * 10**6, stream[at : at + 97]) for n, at in enumerate(range(0, len(stream), 97))]
    candump = read_candump(FIXTURES / "canmod-gps" / "2F6913DB_00000004_00000001_candump.log.gz")
    frames = [(START_NS + n * 10**6 + 7, unit.data) for n, unit in enumerate(itertools.islice(candump, 400))]
    messages = [scan_message(ros, datagrams[at : at + 75]) for at in range(0, 300, 75)]
    messages += [
        ("/oem7/raw", OEM7, time, ros.make(OEM7, header=ros.header(time), message_data=data)) for time, data in pieces
    ]
    messages += [can_message(ros, time, frame) for time, frame in frames]
    messages.append(("/tf_text", "std_msgs/msg/String", START_NS, ros.make("std_msgs/msg/String", data="x")))
    messages.sort(key=lambda message: message[2])
    units = {"/scanner/top/raw": datagrams, "/gnss/rover/raw": pieces, "/imu/main/raw": frames}
    return messages, units


@pytest.mark.parametrize(
    "container", [one if one == "mcap" else pytest.param(one, marks=pytest.mark.slow) for one in CONTAINERS]
)
def test_a_bag_is_imported_and_comes_out_of_an_export_as_it_went_in(tmp_path: Path, container: Container) -> None:
    messages, units = flight(Ros(container))
    file = write_bag(tmp_path / "flight", container, messages)
    config = write_config(tmp_path)
    report, [capture] = run_import(config, [file], tmp_path / "logs")
    assert report.units == {"gnss/rover": len(units["/gnss/rover/raw"]), "imu/main": 400, "scanner/top": 300}
    assert capture.tally.passed == {"messages that hold no bytes of a device": 1}
    content = content_of(tmp_path / "logs")
    assert {topic: [one[:2] for one in found] for topic, found in content.items()} == units
    assert swath("export", str(tmp_path / "logs"), str(tmp_path / "out")).returncode == 0
    [folder] = (tmp_path / "out").iterdir()
    assert (folder / "gnss-rover.gps").read_bytes() == (FIXTURES / "novatel" / "bestpos.gps").read_bytes()
    again = load_config(folder / "config" / "config.toml")
    run_import(again, [folder], tmp_path / "again")
    assert content_of(tmp_path / "again") == content


@pytest.mark.slow
def test_a_list_proposes_a_configuration_that_imports_all(tmp_path: Path) -> None:
    """Each topic is recognised by its bytes; the head's second port and the receiver inside the unit follow."""
    ros = Ros("mcap")
    messages = [
        (topic, kind, unit.time_ns, ros.make(kind, buf=unit.data))
        for unit in read_pcap(FIXTURES / "ouster" / "OS-0-32-U1_v2.2.0_1024x10.pcap.gz")
        if unit.destination is not None
        for kind, topic in [
            ("ouster_ros/msg/PacketMsg", f"/ouster/{'imu' if unit.destination[1] == 7503 else 'lidar'}_packets")
        ]
    ]
    shift_ns = START_NS - messages[0][2]
    messages = [(topic, kind, time + shift_ns, message) for topic, kind, time, message in messages]
    head = [(u.time_ns, u.data) for u in read_pcap(FIXTURES / "velodyne" / "nebula_vlp16.pcap.gz")]
    messages += [(topic, kind, START_NS, message) for topic, kind, _, message in [scan_message(ros, head)]]
    messages += [scan_message(ros, payloads(1206, 3), "/right/velodyne_packets")]
    messages += [one for one in flight(ros)[0] if "velodyne" not in one[0]]
    layout = ros.make("std_msgs/msg/MultiArrayLayout", dim=[], data_offset=0)
    stream = gzip.decompress((FIXTURES / "ubx" / "ublox-neo-m8t.log.gz").read_bytes())[:4000]
    messages.append(("/ublox", BYTES, START_NS, ros.make(BYTES, layout=layout, data=stream)))
    file = write_bag(tmp_path / "a bag", "mcap", messages)
    result = swath("import", "--list", str(file), "--json")
    assert result.returncode == 0, result.stderr
    [bag] = json.loads(result.stdout)["bags"]
    topics = {one["topic"]: one for one in bag["topics"]}
    assert {name: (one["protocol"], one["source"]) for name, one in topics.items()} == {
        "/can/rx": ("canmod-gps", "imu/can_rx"),
        "/left/velodyne_packets": ("velodyne-vlp16", "scanner/left_velodyne_packets"),
        "/right/velodyne_packets": (None, "raw/right_velodyne_packets"),
        "/oem7/raw": ("novatel", "gnss/oem7_raw"),
        "/ouster/imu_packets": ("ouster", "scanner/ouster_lidar_packets/aux"),
        "/ouster/lidar_packets": ("ouster", "scanner/ouster_lidar_packets"),
        "/tf_text": (None, None),
        "/ublox": ("ubx", "gnss/ublox"),
    }
    notes = {name: one["note"] for name, one in topics.items()}
    assert notes["/tf_text"] == "holds no bytes of a device"
    assert notes["/can/rx"] == "CAN frames of imu canmod-gps, with their own times"
    assert "s before those of the bag" in notes["/left/velodyne_packets"]
    assert notes["/ublox"] == "pieces of a byte stream of gnss ubx, with the times of the bag"
    assert notes["/right/velodyne_packets"] == "datagrams of a device that is not recognised, with their own times"
    text = swath("import", "--list", str(file)).stdout
    assert text.endswith(bag["configuration"])
    config = tmp_path / "config.toml"
    config.write_text(text)
    (tmp_path / "ouster_lidar_packets.file").write_bytes(
        (FIXTURES / "ouster" / "OS-0-32-U1_v2.2.0_1024x10.json").read_bytes()
    )
    loaded = load_config(config)
    assert {device.source for device in loaded.devices()} == {
        *("imu/can_rx", "gnss/can_rx", "scanner/left_velodyne_packets", "raw/right_velodyne_packets"),
        *("gnss/oem7_raw", "imu/oem7_raw", "scanner/ouster_lidar_packets", "gnss/ublox", "imu/ublox"),
    }
    named = [f"{one['source']}:{name}={file}" for name, one in topics.items() if one["source"]]
    assert all(f"--source '{one}'" in text for one in named)
    report, _ = run_import(loaded, [], tmp_path / "logs", ImportOptions(named))
    assert (
        sum(report.units.values())
        == sum(one["messages"] for name, one in topics.items() if one["source"] and "velodyne" not in name)
        + len(head)
        + 3
    )


@pytest.mark.slow
def test_decoded_messages_are_listed_as_such(tmp_path: Path) -> None:
    """The bag is NovAtel's own, of its driver for ROS 1."""
    bag = tmp_path / "bestpos.bag"
    bag.write_bytes(gzip.decompress((FIXTURES / "novatel" / "bestpos.bag.gz").read_bytes()))
    text = swath("import", "--list", str(bag)).stdout
    assert f"# {bag}: ROS 1 bag, 58 messages of 7 topics" in text
    when = "from 2021-06-30 23:16:22.967 UTC to 2021-06-30 23:16:22.984 UTC"
    words = "decoded values of a receiver; without velocities"
    assert f"#   /gps/fix (sensor_msgs/msg/NavSatFix): 12 messages {when}\n#       {words}\n" in text
    assert "attitude and velocity only, as its frame of positions is not known" in text
    write_config(tmp_path)
    result = swath("import", str(tmp_path / "swath.toml"), str(bag), "-o", str(tmp_path / "logs"))
    want = f"swath: {bag}: holds topic /gps/gps (12), topic /gps/fix (12), topic /novatel/oem7/odom (12); "
    want += f"`swath import --list {bag}` proposes a configuration"
    assert (result.returncode, result.stderr) == (1, f"{want}\n")
    (tmp_path / "proposed.toml").write_text(text)
    named = [line.strip(" #\\").removeprefix("--source ") for line in text.splitlines() if "--source" in line]
    report, _ = run_import(load_config(tmp_path / "proposed.toml"), [], tmp_path / "logs", ImportOptions(named))
    assert report.units == {"gnss/gps_fix": 12, "gnss/gps_gps": 12, "imu/novatel_oem7_odom": 12}


def test_values_that_cannot_be_used_are_listed_as_such(tmp_path: Path) -> None:
    """NovAtel's CORRIMU has no gravity; Livox drivers send g; points without times are refused."""
    bag = tmp_path / "ins1.bag"
    bag.write_bytes(gzip.decompress((FIXTURES / "novatel" / "ins1.bag.gz").read_bytes()))
    text = swath("import", "--list", str(bag)).stdout
    assert "accelerations of 0.00 m/s² on average, so gravity was removed from them: no trajectory can be" in text
    assert "[session]" not in text
    ros = Ros("mcap")
    messages: list[Message] = []
    for number in range(50):
        at_ns = START_NS + number * 5_000_000
        messages.append(("/livox/imu", IMU, at_ns, imu_message(ros, at_ns, (0.01, 0.0, 1.0), (0.0, 0.0, 0.1))))
    bare = np.zeros(3, [(axis, "<f4") for axis in "xyz"])
    messages.append(("/points", "sensor_msgs/msg/PointCloud2", START_NS, cloud_message(ros, START_NS, bare)))
    text = swath("import", "--list", str(write_bag(tmp_path / "a", "mcap", messages))).stdout
    assert "about 200 a second; accelerations of 1.00, so they are in g, though the message is to have m/s²" in text
    assert "gravity shows that z points up" in text
    assert 'acceleration_unit = "g"' in text
    assert "rotation_b_imu = [[1, 0, 0], [0, -1, 0], [0, 0, -1]]  # change" in text
    assert "has no time of each point (fields x, y, z)" in text
    assert "[scanner" not in text


@pytest.mark.slow
@pytest.mark.parametrize(("container", "size"), [("db3", 2e9), ("mcap", 4e8), ("bag", 4e8)])
def test_the_memory_of_an_import_does_not_grow_with_the_bag(tmp_path: Path, container: Container, size: float) -> None:
    """A process that kept a fiftieth of the bag would have 40 MB more, or 8."""
    most = []
    for number, length in enumerate((2e7, size)):
        folder = tmp_path / str(number)
        folder.mkdir()
        bag = make_bag(folder / "bag", container, length)
        assert bag.stat().st_size > length
        most.append(run_bench_import(folder, bag)[2])
        bag.unlink()
    assert most[1] - most[0] < size / 50


class TestRefusals:
    """What cannot be decided, or read, is said in a line with the option that decides it."""

    @pytest.fixture
    def bag(self, tmp_path: Path) -> Path:
        """Return a bag with two heads, frames, decoded messages and bytes of nobody knows what."""
        ros = Ros("bag")
        messages = [scan_message(ros, payloads(1206, 3), f"/{name}/velodyne_packets") for name in ("left", "right")]
        messages += [one for one in every_type(ros)[0] if one[1] in (FRAME, BYTES)]
        return write_bag(tmp_path / "two", "bag", messages)

    @pytest.mark.parametrize(
        ("named", "line"),
        [
            (
                [],
                "/left/velodyne_packets and /right/velodyne_packets may belong to scanner/top; "
                "want --source scanner/top:/left/velodyne_packets={}",
            ),
            (
                ["scanner/top={}"],
                "topics that fit scanner/top: /left/velodyne_packets, /right/velodyne_packets; "
                "want --source scanner/top:/left/velodyne_packets={}",
            ),
            (["scanner/top:/middle={}"], "has no topic /middle; of those with a device's bytes there are: /left/"),
            (["scanner/top:can_msgs_frame={}"], "/can_msgs_frame holds CAN frames, but scanner/top uses udp in this"),
            (
                ["scanner/top:/left/velodyne_packets={}", "scanner/top/aux:/left/velodyne_packets={}"],
                "/left/velodyne_packets is named for scanner/top and scanner/top/aux; want one of them",
            ),
            (["scanner/nobody={}"], "scanner/nobody is not a source of the configuration"),
        ],
    )
    def test_topics_that_cannot_be_assigned_are_refused(
        self, tmp_path: Path, bag: Path, named: list[str], line: str
    ) -> None:
        options = ImportOptions([one.replace("{}", str(bag)) for one in named])
        with pytest.raises(UserError) as caught:
            run_import(write_config(tmp_path), [] if named else [bag], tmp_path / "logs", options)
        assert line.replace("{}", str(bag)) in caught.value.message
        assert caught.value.exit_code == 2
        assert not (tmp_path / "logs").exists()

    def test_what_is_named_leaves_the_rest_to_be_found(self, tmp_path: Path, bag: Path) -> None:
        """Bytes of any kind are read only where they are named; the other head is reported."""
        options = ImportOptions([f"scanner/top:left/velodyne_packets={bag}", f"gnss/rover={bag}"])
        report, [capture] = run_import(write_config(tmp_path), [bag], tmp_path / "logs", options)
        assert report.units == {"gnss/rover": 1, "imu/main": 4, "scanner/top": 3}
        assert capture.passed == {"topic /right/velodyne_packets": 1}

    def test_a_bag_cut_off_is_read_and_reported(self, tmp_path: Path, bag: Path) -> None:
        bag.write_bytes(bag.read_bytes()[:-200])
        write_config(tmp_path)
        named = ["--source", f"scanner/top:/left/velodyne_packets={bag}"]
        result = swath("import", str(tmp_path / "swath.toml"), *named, "-o", str(tmp_path / "logs"))
        assert result.returncode == 4
        assert result.stderr.startswith(f"swath: {bag}: cannot be read further: ")
        assert result.stderr.count("\n") == 1
        assert len(content_of(tmp_path / "logs")["/scanner/top/raw"]) == 3
        listed = swath("import", "--list", str(bag))
        assert listed.returncode == 0
        assert "topics; it has no index, because its recorder was stopped\n" in listed.stdout

    def test_a_file_that_only_begins_like_a_bag_is_refused(self, tmp_path: Path, bag: Path) -> None:
        bag.write_bytes(b"#ROSBAG V2.0\n" + bytes(100))
        write_config(tmp_path)
        result = swath("import", str(tmp_path / "swath.toml"), str(bag), "-o", str(tmp_path / "logs"))
        assert result.returncode == 3
        assert result.stderr.startswith(f"swath: {bag}: cannot be read as a bag: ")
        assert result.stderr.count("\n") == 1

    def test_an_import_without_a_directory_is_refused(self, tmp_path: Path, bag: Path) -> None:
        result = swath("import", str(tmp_path / "swath.toml"), str(bag))
        want = "swath: import: want -o DIR, the directory for the log (or --list BAG)\n"
        assert (result.returncode, result.stderr) == (2, want)
