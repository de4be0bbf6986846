"""Knows the ROS messages that carry devices' bytes, and takes the bytes out of them.

A ROS 1 bag and most MCAP files hold the definitions of their messages; those count. A bag of SQLite holds none before
version 4 of its schema; the definitions here serve then. They are the fields of these packages:

    velodyne_msgs         github.com/ros-drivers/velodyne, velodyne_msgs/msg
    pandar_msgs           github.com/tier4/nebula, messages/pandar_msgs/msg (``hesai_msgs`` has the same)
    hesai_lidar           github.com/HesaiTechnology/HesaiLidar_General_ROS, msg
    hesai_ros_driver      github.com/HesaiTechnology/HesaiLidar_ROS_2.0, msg
    nebula_msgs           github.com/tier4/nebula, nebula_messages/nebula_msgs/msg
    robosense_msgs        github.com/tier4/nebula, nebula_messages/robosense_msgs/msg
    rslidar_msg           github.com/RoboSense-LiDAR/rslidar_sdk, src/msg
    rslidar_msgs          github.com/RoboSense-LiDAR/ros_rslidar, rslidar_msgs/msg
    ouster_ros            github.com/ouster-lidar/ouster-ros, msg (later ``ouster_sensor_msgs``)
    novatel_oem7_msgs     github.com/novatel/novatel_oem7_driver, src/novatel_oem7_msgs/msg
    can_msgs              github.com/ros-industrial/ros_canopen, can_msgs/msg
    ros2_socketcan_msgs   github.com/autowarefoundation/ros2_socketcan, ros2_socketcan_msgs/msg
    nmea_msgs, rtcm_msgs  github.com/ros-drivers/nmea_msgs, github.com/tilk/rtcm_msgs
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Carries = Literal["datagrams", "bytes", "can"]

SENTENCE = "nmea_msgs/msg/Sentence"  # its text is read as bytes, because a receiver may send any
SECOND = "#2"  # behind a topic's name: its units of the head's second port; no topic has this sign in its name


@dataclass(frozen=True, slots=True)
class RawType:
    """One type of message that carries a device's bytes.

    Attributes:
        name: as ROS 2 writes it, ``package/msg/Type``.
        carries: datagrams, pieces of a byte stream, or CAN frames.
        definitions: what the message may consist of where the bag does not say it: text in the form of ROS, whose
            other types follow after lines ``MSG: package/Type``, as in a ROS 1 bag.
        protocols: beginnings of the protocols that it may carry; empty: any.
        second: the messages hold packets of a head's second port.
        named: only a topic that the user names is read, because such messages may hold anything.
    """

    name: str
    carries: Carries
    definitions: tuple[str, ...]
    protocols: tuple[str, ...] = ()
    second: bool = False
    named: bool = False


_RULE = "=" * 80 + "\n"
_HEADER = "std_msgs/Header header\n"


def _scan(package: str, packet: str, *forms: str, header: str = _HEADER) -> tuple[str, ...]:
    """Return the definitions of a message with packets, one for each form of the packet."""
    head = f"{header}{package}/{packet}[] packets\n{_RULE}MSG: {package}/{packet}\n"
    return tuple(head + form for form in forms)


_STAMP = "builtin_interfaces/Time stamp\n"
_SEQUENCE = f"{_STAMP}uint8[] data\n"
_SIZED = f"{_STAMP}uint8[] data\nuint32 size\n"


def _fixed(length: int, *, size: bool) -> str:
    return f"{_STAMP}uint8[{length}] data\n" + ("uint32 size\n" if size else "")


_VELODYNE, _PANDAR, _ROBOSENSE = _fixed(1206, size=False), _fixed(1500, size=True), _fixed(1248, size=True)
_OLD_ROBOSENSE = _fixed(1248, size=False)
_LAYOUT = "std_msgs/MultiArrayLayout layout\n"
_BYTES = "uint8[] data\n"


def _datagrams(name: str, definitions: tuple[str, ...], *protocols: str, second: bool = False) -> RawType:
    return RawType(name, "datagrams", definitions, protocols, second=second)


def _bytes(name: str, definition: str, *protocols: str) -> RawType:
    return RawType(name, "bytes", (definition,), protocols, named=not protocols)


_ALL = (
    _datagrams("velodyne_msgs/msg/VelodyneScan", _scan("velodyne_msgs", "VelodynePacket", _VELODYNE), "velodyne-"),
    _datagrams("velodyne_msgs/msg/VelodynePacket", (_VELODYNE,), "velodyne-"),
    _datagrams("pandar_msgs/msg/PandarScan", _scan("pandar_msgs", "PandarPacket", _PANDAR, _SIZED), "hesai-"),
    _datagrams("hesai_msgs/msg/PandarScan", _scan("hesai_msgs", "PandarPacket", _PANDAR, _SIZED), "hesai-"),
    _datagrams("hesai_lidar/msg/PandarScan", _scan("hesai_lidar", "PandarPacket", _SIZED, _PANDAR), "hesai-"),
    _datagrams("pandar_msgs/msg/PandarPacket", (_PANDAR,), "hesai-"),
    _datagrams("pandar_msgs/msg/PandarJumboPacket", (_SIZED,), "hesai-"),
    _datagrams(
        "hesai_ros_driver/msg/UdpFrame",
        (
            *_scan("hesai_ros_driver", "UdpPacket", _SIZED, _PANDAR),
            *_scan("hesai_ros_driver", "UdpPacket", _SIZED, _PANDAR, header=""),
        ),
        "hesai-",
    ),
    _datagrams("nebula_msgs/msg/NebulaPackets", _scan("nebula_msgs", "NebulaPacket", _SEQUENCE)),
    _datagrams("nebula_msgs/msg/NebulaPacket", (_SEQUENCE,)),
    _datagrams("nebula_msgs/msg/RawPacketStamped", (_SEQUENCE,)),
    _datagrams("ouster_ros/msg/PacketMsg", ("uint8[] buf\n",), "ouster"),
    _datagrams("ouster_sensor_msgs/msg/PacketMsg", ("uint8[] buf\n",), "ouster"),
    _datagrams(
        "robosense_msgs/msg/RobosenseScan", _scan("robosense_msgs", "RobosensePacket", _ROBOSENSE), "robosense-"
    ),
    _datagrams(
        "robosense_msgs/msg/RobosenseInfoPacket",
        (
            f"string lidar_model\nrobosense_msgs/RobosensePacket packet\n{_RULE}"
            f"MSG: robosense_msgs/RobosensePacket\n{_ROBOSENSE}",
        ),
        "robosense-",
        second=True,
    ),
    _datagrams("rslidar_msgs/msg/rslidarScan", _scan("rslidar_msgs", "rslidarPacket", _OLD_ROBOSENSE), "robosense-"),
    # MSOP packets come in scans; one alone is a DIFOP packet
    _datagrams("rslidar_msgs/msg/rslidarPacket", (_OLD_ROBOSENSE,), "robosense-", second=True),
    _datagrams(
        "rslidar_msg/msg/RslidarPacket",
        (f"{_HEADER}uint8 is_difop\nuint8 is_frame_begin\n{_BYTES}",),
        "robosense-",
    ),
    _bytes("novatel_oem7_msgs/msg/Oem7RawMsg", f"{_HEADER}uint8[] message_data\n", "novatel"),
    _bytes(SENTENCE, f"{_HEADER}uint8[] sentence\n", "nmea"),
    _bytes("rtcm_msgs/msg/Message", f"{_HEADER}uint8[] message\n", "rtcm3"),
    _bytes("std_msgs/msg/UInt8MultiArray", _LAYOUT + _BYTES),
    _bytes("std_msgs/msg/ByteMultiArray", _LAYOUT + _BYTES),
    RawType(
        "can_msgs/msg/Frame",
        "can",
        (f"{_HEADER}uint32 id\nbool is_rtr\nbool is_extended\nbool is_error\nuint8 dlc\nuint8[8] data\n",),
    ),
    RawType(
        "ros2_socketcan_msgs/msg/FdFrame",
        "can",
        (f"{_HEADER}uint32 id\nbool is_extended\nbool is_error\nuint8 len\nuint8[<=64] data\n",),
    ),
)
RAW_TYPES = {raw.name: raw for raw in _ALL}
SPLIT_TYPE = "rslidar_msg/msg/RslidarPacket"  # its messages say which of the two ports a packet came from

DECODED_TYPES = {  # messages whose values another program decoded from a device's bytes, which they no longer hold
    "sensor_msgs/msg/Imu": "inertial samples",
    "sensor_msgs/msg/NavSatFix": "positions",
    "sensor_msgs/msg/TimeReference": "times of a receiver",
    "sensor_msgs/msg/PointCloud2": "points",
    "gps_common/msg/GPSFix": "positions and velocities",
    "gps_msgs/msg/GPSFix": "positions and velocities",
    "nav_msgs/msg/Odometry": "positions and attitudes",
    "livox_ros_driver/msg/CustomMsg": "points",
    "livox_ros_driver2/msg/CustomMsg": "points",
}


@dataclass(frozen=True, slots=True)
class BagTopic:
    """A topic of a bag, or that part of it which came from a head's second port.

    Attributes:
        name: the topic's name; the second port's part has `SECOND` behind it.
        kind: type of its messages, ``package/msg/Type``.
        count: its number of messages.
        raw: how its messages carry a device's bytes; None if they do not, or cannot be read.
        why: why it cannot be read; "" if it can.
    """

    name: str
    kind: str
    count: int
    raw: RawType | None
    why: str = ""

    @property
    def second(self) -> bool:
        """True if its units came from a head's second port."""
        if self.raw is not None and "ouster" in self.raw.protocols:
            return "imu" in self.name.rpartition("/")[2]
        return self.name.endswith(SECOND) or (self.raw is not None and self.raw.second)
