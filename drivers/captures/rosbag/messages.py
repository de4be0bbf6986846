"""Knows the ROS messages that carry devices' bytes, or values that another program decoded from them.

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

Carries = Literal["datagrams", "bytes", "can", "records"]

SENTENCE = "nmea_msgs/msg/Sentence"  # its text is read as bytes, because a receiver may send any
SECOND = "#2"  # behind a topic's name: its units of the head's second port; no topic has this sign in its name


@dataclass(frozen=True, slots=True)
class RawType:
    """One type of message that carries a device's bytes.

    Attributes:
        name: as ROS 2 writes it, ``package/msg/Type``.
        carries: datagrams, pieces of a byte stream, CAN frames, or values that another program decoded.
        definitions: what the message may consist of where the bag does not say it: text in the form of ROS, whose
            other types follow after lines ``MSG: package/Type``, as in a ROS 1 bag.
        protocols: beginnings of the protocols that it may carry; empty: any.
        second: the messages hold packets of a head's second port.
        named: only a topic that the user names is read, because such messages may hold anything.
        device: of decoded values, the kind of device that they are of.
    """

    name: str
    carries: Carries
    definitions: tuple[str, ...]
    protocols: tuple[str, ...] = ()
    second: bool = False
    named: bool = False
    device: str = ""


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

CUSTOM_MSG = ("livox_ros_driver/msg/CustomMsg", "livox_ros_driver2/msg/CustomMsg")
_LIVOX = (
    f"{_HEADER}uint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\n{{package}}/CustomPoint[] points\n"
    f"{_RULE}MSG: {{package}}/CustomPoint\nuint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\n"
    "uint8 tag\nuint8 line\n"
)
_GPS_FIX = (
    f"{_HEADER}{{package}}/GPSStatus status\nfloat64 latitude\nfloat64 longitude\nfloat64 altitude\nfloat64 track\n"
    "float64 speed\nfloat64 climb\nfloat64 pitch\nfloat64 roll\nfloat64 dip\nfloat64 time\nfloat64 gdop\nfloat64 pdop\n"
    "float64 hdop\nfloat64 vdop\nfloat64 tdop\nfloat64 err\nfloat64 err_horz\nfloat64 err_vert\nfloat64 err_track\n"
    "float64 err_speed\nfloat64 err_climb\nfloat64 err_time\nfloat64 err_pitch\nfloat64 err_roll\nfloat64 err_dip\n"
    f"float64[9] position_covariance\nuint8 position_covariance_type\n{_RULE}MSG: {{package}}/GPSStatus\n{_HEADER}"
    "uint16 satellites_used\nint32[] satellite_used_prn\nuint16 satellites_visible\nint32[] satellite_visible_prn\n"
    "int32[] satellite_visible_z\nint32[] satellite_visible_azimuth\nint32[] satellite_visible_snr\nint16 status\n"
    "uint16 motion_source\nuint16 orientation_source\nuint16 position_source\n"
)


def _values(name: str, device: str, definition: str = "") -> RawType:
    texts = (definition.format(package=name.partition("/")[0]),) if definition else ()
    return RawType(name, "records", texts, ("records",), device=device)


# messages whose values another program decoded from a device's bytes, which they no longer hold
RECORD_TYPES = {
    one.name: one
    for one in (
        _values("sensor_msgs/msg/Imu", "imu"),
        _values("sensor_msgs/msg/NavSatFix", "gnss"),
        _values("sensor_msgs/msg/PointCloud2", "scanner"),
        _values("gps_common/msg/GPSFix", "gnss", _GPS_FIX),
        _values("gps_msgs/msg/GPSFix", "gnss", _GPS_FIX),
        _values("nav_msgs/msg/Odometry", "imu"),
        *(_values(name, "scanner", _LIVOX) for name in CUSTOM_MSG),
    )
}
TOPIC_TYPES = RAW_TYPES | RECORD_TYPES
DECODED_TYPES = {"sensor_msgs/msg/TimeReference": "times of a receiver"}  # that are not imported


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
