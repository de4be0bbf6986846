"""Writes bags of ROS 1 and ROS 2 by the library rosbags, with every type of message that holds a device's bytes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from swath.drivers.captures.rosbag.messages import RAW_TYPES, TOPIC_TYPES

Container = Literal["db3", "mcap", "bag"]
CONTAINERS: tuple[Container, ...] = ("db3", "mcap", "bag")
START_NS = 1_800_000_000_123_456_789
Message = tuple[str, str, int, Any]  # topic, type, time in the bag, the message or its bytes
Units = dict[str, list[tuple[int, bytes]]]  # time and bytes of each unit, by topic


class Ros:
    """Makes messages of ROS 1 or ROS 2 from their fields."""

    def __init__(self, container: Container, form: int = 0) -> None:
        self.container = container
        self.store = get_typestore(Stores.ROS1_NOETIC if container == "bag" else Stores.ROS2_HUMBLE)
        for name, raw in TOPIC_TYPES.items():
            if not raw.definitions:  # one of ROS's own, which the library knows
                continue
            text = raw.definitions[min(form, len(raw.definitions) - 1)]
            if name == "nmea_msgs/msg/Sentence":
                text = "std_msgs/Header header\nstring sentence\n"
            types = get_types_from_msg(text, name)
            self.store.register({one: types[one] for one in types if one not in self.store.fielddefs})

    def time(self, time_ns: int) -> Any:
        """Return a time; 0 as drivers leave it that set none."""
        return self.make("builtin_interfaces/msg/Time", sec=time_ns // 10**9, nanosec=time_ns % 10**9)

    def header(self, time_ns: int) -> Any:
        """Return a header, whose frame makes the fields behind it unaligned."""
        first = {"seq": 7} if self.container == "bag" else {}
        return self.make("std_msgs/msg/Header", **first, stamp=self.time(time_ns), frame_id="sensor")

    def make(self, kind: str, **fields: Any) -> Any:
        """Return a message; bytes become arrays."""
        values = {name: np.frombuffer(one, np.uint8) if isinstance(one, bytes) else one for name, one in fields.items()}
        return self.store.types[kind](**values)

    def scan(
        self, kind: str, packet: str, packets: list[tuple[int, bytes]], *, length: int = 0, sized: bool = False
    ) -> Any:
        """Return a message of packets, whose bytes fill ``length`` with 0xEE."""
        made = [
            self.make(
                packet,
                stamp=self.time(time),
                data=data.ljust(length, b"\xee"),
                **({"size": len(data)} if sized else {}),
            )
            for time, data in packets
        ]
        return self.make(kind, header=self.header(START_NS - 1), packets=made)


def bag_writer(path: Path, container: Container) -> tuple[Any, Path]:
    """Return a bag's writer and its file: ``path`` with the suffix of ROS 1, or in the folder ``path`` for ROS 2."""
    if container == "bag":
        file = path.with_suffix(".bag")
        return Ros1Writer(file), file
    plugin = StoragePlugin.MCAP if container == "mcap" else StoragePlugin.SQLITE3
    return Ros2Writer(path, version=9, storage_plugin=plugin), path / f"{path.name}.{container}"


def write_bag(path: Path, container: Container, messages: list[Message], form: int = 0) -> Path:
    """Write a bag and return its file, as `bag_writer` has it."""
    ros = Ros(container, form)
    writer, file = bag_writer(path, container)
    with writer:
        connections: dict[tuple[str, str], Any] = {}
        for topic, kind, time_ns, message in messages:
            if (topic, kind) not in connections:
                connections[topic, kind] = writer.add_connection(topic, kind, typestore=ros.store)
            if not isinstance(message, bytes):
                serialise = ros.store.serialize_ros1 if container == "bag" else ros.store.serialize_cdr
                message = bytes(serialise(message, kind))
            writer.write(connections[topic, kind], time_ns, message)
    return file


def payloads(length: int, count: int, seed: int = 0) -> list[tuple[int, bytes]]:
    """Return packets of random bytes, 1.3 ms apart."""
    rng = np.random.default_rng(seed)
    return [(START_NS + number * 1_300_000, rng.bytes(length)) for number in range(count)]


def every_type(ros: Ros) -> tuple[list[Message], Units]:
    """Return messages of every type, and the units that they must give."""
    messages: list[Message] = []
    units: Units = {}

    def add(kind: str, message: Any, found: list[tuple[int, bytes]], topic: str = "") -> None:
        topic = topic or "/" + kind.replace("/msg/", "_").lower()
        messages.append((topic, kind, START_NS + len(messages), message))
        units.setdefault(topic.partition("#")[0] + ("#2" if "#" in topic else ""), []).extend(found)

    for number, (kind, packet, length, sized, size) in enumerate(
        [
            ("velodyne_msgs/msg/VelodyneScan", "velodyne_msgs/msg/VelodynePacket", 1206, False, 1206),
            ("pandar_msgs/msg/PandarScan", "pandar_msgs/msg/PandarPacket", 1500, True, 568),
            ("hesai_msgs/msg/PandarScan", "hesai_msgs/msg/PandarPacket", 1500, True, 1080),
            ("hesai_lidar/msg/PandarScan", "hesai_lidar/msg/PandarPacket", 0, True, 1194),
            ("hesai_ros_driver/msg/UdpFrame", "hesai_ros_driver/msg/UdpPacket", 0, True, 861),
            ("nebula_msgs/msg/NebulaPackets", "nebula_msgs/msg/NebulaPacket", 0, False, 1127),
            ("robosense_msgs/msg/RobosenseScan", "robosense_msgs/msg/RobosensePacket", 1248, True, 1248),
            ("rslidar_msgs/msg/rslidarScan", "rslidar_msgs/msg/rslidarPacket", 1248, False, 1248),
        ]
    ):
        for count in (3, 1, 0):
            packets = payloads(size, count, number)
            add(kind, ros.scan(kind, packet, packets, length=length, sized=sized), packets)
        if ros.store.fielddefs.get(packet) and packet in RAW_TYPES:
            fields = {"size": size} if sized else {}
            [(time, data)] = payloads(size, 1, 100 + number)
            add(packet, ros.make(packet, stamp=ros.time(time), data=data.ljust(length), **fields), [(time, data)])
    for kind in ("pandar_msgs/msg/PandarJumboPacket", "nebula_msgs/msg/RawPacketStamped"):
        [(time, data)] = payloads(1600, 1)
        fields = {"size": 1600} if "Jumbo" in kind else {}
        add(kind, ros.make(kind, stamp=ros.time(time), data=data, **fields), [(time, data)])
    for kind in ("ouster_ros/msg/PacketMsg", "ouster_sensor_msgs/msg/PacketMsg"):
        add(kind, ros.make(kind, buf=b"\1\2\3"), [(START_NS + len(messages), b"\1\2\3")])
    packet = ros.make("robosense_msgs/msg/RobosensePacket", stamp=ros.time(0), data=bytes(1248), size=1248)
    kind = "robosense_msgs/msg/RobosenseInfoPacket"
    add(kind, ros.make(kind, lidar_model="Helios", packet=packet), [(START_NS + len(messages), bytes(1248))])
    kind = "rslidar_msg/msg/RslidarPacket"
    for difop in (0, 1):
        message = ros.make(
            kind, header=ros.header(START_NS + difop), is_difop=difop, is_frame_begin=0, data=b"\x55\xaa"
        )
        messages.append(("/rslidar_packets", kind, START_NS + 5, message))
        units["/rslidar_packets" + "#2" * difop] = [(START_NS + difop, b"\x55\xaa")]
    for kind, field in (("novatel_oem7_msgs/msg/Oem7RawMsg", "message_data"), ("rtcm_msgs/msg/Message", "message")):
        add(
            kind,
            ros.make(kind, header=ros.header(START_NS + 9), **{field: b"\xaa\x44\x12"}),
            [(START_NS + 9, b"\xaa\x44\x12")],
        )
    kind = "nmea_msgs/msg/Sentence"
    for text in ("$GPGGA,*00", "$GPGGA,*00\r", "$GPGGA,*00\r\n"):
        add(kind, ros.make(kind, header=ros.header(START_NS), sentence=text), [(START_NS, b"$GPGGA,*00\r\n")])
    layout = ros.make("std_msgs/msg/MultiArrayLayout", dim=[], data_offset=0)
    for kind in ("std_msgs/msg/UInt8MultiArray", "std_msgs/msg/ByteMultiArray"):
        add(kind, ros.make(kind, layout=layout, data=b"bytes"), [(START_NS + len(messages), b"bytes")])
    kind = "can_msgs/msg/Frame"
    for flags, word in (("", 0x123), ("extended", 0x8000_0123), ("rtr", 0x4000_0123), ("error", 0x2000_0123)):
        given = {f"is_{name}": name == flags for name in ("rtr", "extended", "error")}
        message = ros.make(kind, header=ros.header(START_NS), id=0x123, **given, dlc=2, data=b"\7\x08" + bytes(6))
        add(kind, message, [(START_NS, word.to_bytes(4, "little") + b"\2\0\0\0\7\x08" + bytes(6))])
    kind = "ros2_socketcan_msgs/msg/FdFrame"
    message = ros.make(
        kind, header=ros.header(START_NS), id=0x1F, is_extended=False, is_error=False, len=12, data=bytes(12)
    )
    add(kind, message, [(START_NS, b"\x1f\0\0\0\x0c\4\0\0" + bytes(64))])
    return messages, units


# --- decoded values -------------------------------------------------------------------------------------------------


def vector(ros: Ros, x: float, y: float, z: float) -> Any:
    """Return a vector."""
    return ros.make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)


def imu_message(ros: Ros, stamp_ns: int, force: Sequence[float], rate: Sequence[float], mark: float = 0.0) -> Any:
    """Return a sample; ``mark`` is the first number of its covariances, -1 for none."""
    covariance = np.array([mark, *[0.0] * 8])
    return ros.make(
        "sensor_msgs/msg/Imu",
        header=ros.header(stamp_ns),
        orientation=ros.make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
        orientation_covariance=covariance,
        angular_velocity=vector(ros, *rate),
        angular_velocity_covariance=covariance,
        linear_acceleration=vector(ros, *force),
        linear_acceleration_covariance=covariance,
    )


def fix_message(ros: Ros, stamp_ns: int, place: Sequence[float], status: int = 0, **fields: Any) -> Any:
    """Return a position in degrees and m, with a covariance where ``fields`` give one."""
    latitude, longitude, altitude = place
    given = {"position_covariance": np.zeros(9), "position_covariance_type": 0} | fields
    return ros.make(
        "sensor_msgs/msg/NavSatFix",
        header=ros.header(stamp_ns),
        status=ros.make("sensor_msgs/msg/NavSatStatus", status=status, service=1),
        latitude=latitude,
        longitude=longitude,
        altitude=altitude,
        **given,
    )


def cloud_message(ros: Ros, stamp_ns: int, points: Any, **fields: Any) -> Any:
    """Return a cloud of points, a structured array (n,) or (rows, n), by the fields and offsets of its dtype."""
    codes = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
    dtype = points.dtype
    table = np.atleast_2d(points)
    given = {
        "height": table.shape[0],
        "width": table.shape[1],
        "is_bigendian": any(dtype[name].byteorder == ">" for name in dtype.names),
        "point_step": dtype.itemsize,
        "row_step": dtype.itemsize * table.shape[1],
        "data": np.frombuffer(table.tobytes(), np.uint8),
        "is_dense": False,
    }
    return ros.make(
        "sensor_msgs/msg/PointCloud2",
        header=ros.header(stamp_ns),
        fields=[
            ros.make(
                "sensor_msgs/msg/PointField",
                name=name,
                offset=dtype.fields[name][1],
                datatype=codes[dtype[name].str[1:]],
                count=1,
            )
            for name in dtype.names
        ],
        **given | fields,
    )


def custom_message(
    ros: Ros, stamp_ns: int, points: Sequence[Sequence[float]], package: str = "livox_ros_driver2"
) -> Any:
    """Return Livox points: offset in ns, x, y, z, reflectivity, tag, line."""
    names = ("offset_time", "x", "y", "z", "reflectivity", "tag", "line")
    made = [ros.make(f"{package}/msg/CustomPoint", **dict(zip(names, one, strict=True))) for one in points]
    return ros.make(
        f"{package}/msg/CustomMsg",
        header=ros.header(stamp_ns),
        timebase=stamp_ns,
        point_num=len(points),
        lidar_id=0,
        rsvd=np.zeros(3, np.uint8),
        points=made,
    )
