"""Turns ROS messages whose values another program decoded into frames of protocol ``records``.

Definitions: sensor_msgs, nav_msgs and geometry_msgs of ROS; gps_common and gps_msgs (github.com/swri-robotics/gps_umd);
livox_ros_driver and livox_ros_driver2 (github.com/Livox-SDK). Frames: REP 103 (body x forward, y left, z up; world
east, north, up), REP 105, REP 145 (an IMU's axes are its own). Values keep their axes, but for covariances and
velocities of receivers and the attitude of an odometry, which have only one meaning: north, east, down.

A stamp since 1970 counts as UTC, an earlier one as a counter (decision 0041).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from swath.drivers.captures.rosbag.messages import CUSTOM_MSG, RawType
from swath.drivers.captures.rosbag.unwrap import Unit
from swath.drivers.record_frames import (
    NO_TIME_NS,
    ROWS,
    TELLS_TIME,
    RowKind,
    Scale,
    encode_frame,
    encode_frames,
)
from swath.georef.arrays import FloatArray, Int64Array, StructArray
from swath.georef.records import FixType
from swath.georef.timescales.gps_time import SECOND_NS

SIGMA_S = 0.1  # of a sample's stamp beside those of the fixes: decision 0041
COUNTED_BEFORE_NS = 1_000_000_000 * SECOND_NS  # a stamp before 2001-09-09 counts from a start
NED_FROM_ENU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
FLU_FROM_FRD = np.diag([1.0, -1.0, -1.0])
_UPPER = np.triu_indices(3)
# sensor_msgs/NavSatStatus; and gps_common/GPSStatus, which adds 18 (DGPS) and 33 (WAAS)
_FIX_TYPES = {0: FixType.SINGLE, 1: FixType.DIFFERENTIAL, 2: FixType.DIFFERENTIAL}
_FIX_TYPES |= {18: FixType.DIFFERENTIAL, 33: FixType.DIFFERENTIAL}
_COVARIANCE_UNKNOWN = 0
_POINT_FIELDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}  # sensor_msgs/PointField
_TIMES = ("timestamp", "time", "t", "time_stamp", "offset_time", "timeoffset")
_INTENSITIES = ("intensity", "reflectivity", "i")
_CHANNELS = ("ring", "channel", "line", "laser_id")
_ABSOLUTE_S, _ABSOLUTE_NS = 1e8, 1e17  # from here on a number of seconds, or of nanoseconds, counts from 1970
_LONGEST_CLOUD_NS = 10 * SECOND_NS
_CUSTOM_POINT: list[Any] = [
    ("offset_time", "u4"),  # ns since the header's stamp
    *((axis, "f4") for axis in "xyz"),  # m
    *((name, "u1") for name in ("reflectivity", "tag", "line")),
]


class Records:
    """Reads messages of one type of decoded values.

    Args:
        raw: the type.
        decode: decodes a message into an object, and raises ValueError.
        ros2: messages are serialised as CDR.
    """

    def __init__(self, raw: RawType, decode: Callable[[bytes], Any], *, ros2: bool) -> None:
        self._raw, self._decode, self._ros2 = raw, decode, ros2

    def units(self, data: bytes) -> Iterable[Unit]:
        """Return the frames of a message, each with the message's stamp; raises ValueError."""
        if self._raw.name in CUSTOM_MSG:
            return _custom(data, ros2=self._ros2)
        return _MAKERS[self._raw.name](self._decode(data))


def _stamped(message: Any) -> tuple[int, int, Scale]:
    """Return a message's stamp, ns; its time, −1: none; and what that counts from."""
    stamp = message.header.stamp
    return _scaled(int(stamp.sec) * SECOND_NS + int(stamp.nanosec))


def _scaled(stamp_ns: int) -> tuple[int, int, Scale]:
    scale = Scale.UTC if stamp_ns >= COUNTED_BEFORE_NS else Scale.COUNTER
    return stamp_ns, stamp_ns if stamp_ns > 0 else NO_TIME_NS, scale


def _row(kind: RowKind, time_ns: int) -> StructArray:
    rows = np.zeros(1, ROWS[kind])
    for name in rows.dtype.names or ():
        if rows.dtype[name].base.kind == "f":
            rows[name] = np.nan
    rows["time_ns"] = time_ns
    return rows


def _vector(value: Any) -> tuple[float, float, float]:
    return float(value.x), float(value.y), float(value.z)


def _imu(message: Any) -> list[Unit]:
    """Return a sample along the axes of the message; its orientation is not used.

    A covariance that begins with −1 means by definition that the message has no such quantity; some drivers write that
    beside values, so that only zeros count as none.
    """
    parts = (message.linear_acceleration, message.angular_velocity)
    marked = (message.linear_acceleration_covariance[0], message.angular_velocity_covariance[0]) == (-1.0, -1.0)
    if marked and not any(value for part in parts for value in _vector(part)):
        return []
    stamp_ns, time_ns, scale = _stamped(message)
    rows = _row(RowKind.SAMPLE, time_ns)
    rows["time_sigma_s"] = SIGMA_S
    rows["specific_force_b"], rows["angular_rate_b"] = (
        _vector(message.linear_acceleration),
        _vector(message.angular_velocity),
    )
    rows["pps_time_ns"] = NO_TIME_NS
    return [Unit(stamp_ns, encode_frame(RowKind.SAMPLE, rows, scale))]


def _fix_rows(message: Any, status: int) -> tuple[int, Scale, StructArray]:
    """Return stamp, scale and row of a fix: what NavSatFix and GPSFix have in common."""
    stamp_ns, time_ns, scale = _stamped(message)
    rows = _row(RowKind.FIX, time_ns)
    rows["lat_rad"], rows["lon_rad"] = math.radians(message.latitude), math.radians(message.longitude)
    rows["height_m"] = message.altitude
    rows["fix_type"] = _FIX_TYPES.get(status, FixType.NONE)
    rows["valid"] = status in _FIX_TYPES
    rows["satellites"], rows["antenna"] = -1, b"primary"
    covariance = np.asarray(message.position_covariance, np.float64).reshape(3, 3)
    if message.position_covariance_type != _COVARIANCE_UNKNOWN and (np.diag(covariance) > 0.0).all():
        rows["position_cov_l"] = (NED_FROM_ENU @ covariance @ NED_FROM_ENU.T)[_UPPER]
    return stamp_ns, scale, rows


def _nav_sat_fix(message: Any) -> list[Unit]:
    """Return a position: altitude is above the ellipsoid by definition, the covariance is east, north, up."""
    stamp_ns, scale, rows = _fix_rows(message, int(message.status.status))
    rows["message"] = b"NavSatFix"
    return [Unit(stamp_ns, encode_frame(RowKind.FIX, rows, scale, TELLS_TIME))]


def _gps_fix(message: Any) -> list[Unit]:
    """Return position and velocity: track from north, speed over ground, climb upwards."""
    stamp_ns, scale, rows = _fix_rows(message, int(message.status.status))
    rows["message"] = b"GPSFix"
    track, speed = math.radians(message.track), float(message.speed)
    rows["velocity_l"] = speed * math.cos(track), speed * math.sin(track), -float(message.climb)
    used = int(message.status.satellites_used)
    rows["satellites"] = used if 0 < used < 32_768 else -1
    if (message.err_speed, message.err_climb) != (0.0, 0.0):  # "95 % confidence", that is 2 sigma
        level, up = (float(error) / 2.0 for error in (message.err_speed, message.err_climb))
        rows["velocity_cov_l"] = (level**2, 0.0, 0.0, level**2, 0.0, up**2)
    return [Unit(stamp_ns, encode_frame(RowKind.FIX, rows, scale, TELLS_TIME))]


def _odometry(message: Any) -> list[Unit]:
    """Return attitude and velocity, if the world is east, north, up; positions in an unknown frame are left out."""
    stamp_ns, time_ns, scale = _stamped(message)
    rows = _row(RowKind.SOLUTION, time_ns)
    rows["valid"] = 1
    pose, twist = message.pose.pose.orientation, message.twist.twist.linear
    quaternion = np.array([pose.w, pose.x, pose.y, pose.z], np.float64)
    length = float(np.linalg.norm(quaternion))
    if not abs(length - 1.0) < 0.01:
        raise ValueError(f"its quaternion has the length {length:g}")
    rot_enu_from_flu = _rotation(quaternion / length)
    rot_l_from_b = NED_FROM_ENU @ rot_enu_from_flu @ FLU_FROM_FRD
    rows["roll_rad"] = math.atan2(rot_l_from_b[2, 1], rot_l_from_b[2, 2])
    rows["pitch_rad"] = -math.asin(max(-1.0, min(1.0, float(rot_l_from_b[2, 0]))))
    heading = math.atan2(rot_l_from_b[1, 0], rot_l_from_b[0, 0]) % math.tau
    rows["heading_rad"] = heading if heading < math.tau else 0.0  # of a tiny negative angle
    rows["velocity_l"] = NED_FROM_ENU @ rot_enu_from_flu @ np.array(_vector(twist))
    return [Unit(stamp_ns, encode_frame(RowKind.SOLUTION, rows, scale))]


def _rotation(q: FloatArray) -> FloatArray:
    """Return the rotation matrix of a unit quaternion w, x, y, z."""
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


# --- points ---------------------------------------------------------------------------------------------------------


def _cloud(message: Any) -> list[Unit]:
    """Return the points of a cloud with a time each; those without a place are pulses without a return."""
    stamp_ns, _, scale = _stamped(message)
    points = _points_of(message)
    names = points.dtype.names or ()
    if not {"x", "y", "z"} <= set(names):
        raise ValueError(f"has the fields {', '.join(names)}, no x, y, z")
    time_ns, scale = _point_times(points, stamp_ns, scale)
    rows = np.zeros(len(points), ROWS[RowKind.POINT])
    rows["time_ns"] = time_ns
    with np.errstate(over="ignore", invalid="ignore"):
        for axis in "xyz":
            rows[f"{axis}_m"] = points[axis]
        _fill(rows, "intensity", points, _INTENSITIES)
        _fill(rows, "channel", points, _CHANNELS)
    return _frames(rows, stamp_ns, scale)


def _points_of(message: Any) -> StructArray:
    """Return the points (n,) of a cloud; raises ValueError if its layout contradicts itself."""
    order = ">" if message.is_bigendian else "<"
    step, row_step = int(message.point_step), int(message.row_step)
    width, height = int(message.width), int(message.height)
    fields = [field for field in message.fields if int(field.datatype) in _POINT_FIELDS and int(field.count) in (0, 1)]
    formats = [order + _POINT_FIELDS[int(field.datatype)] for field in fields]
    offsets = [int(field.offset) for field in fields]
    if any(at + np.dtype(kind).itemsize > step for at, kind in zip(offsets, formats, strict=True)):
        raise ValueError(f"has a field beyond its point of {step} bytes")
    data = np.asarray(message.data, np.uint8)
    if width * step > row_step or height * row_step > len(data):
        raise ValueError(f"has {len(data)} bytes for {height} rows of {width} points of {step} bytes")
    names = [str(field.name) for field in fields]
    try:
        dtype = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": step})
    except (ValueError, TypeError) as error:
        raise ValueError(f"has fields that make no point: {error}") from error
    table = data[: height * row_step].reshape(height, row_step)[:, : width * step]
    return np.ascontiguousarray(table).reshape(-1).view(dtype)


def _point_times(points: StructArray, stamp_ns: int, scale: Scale) -> tuple[Int64Array, Scale]:
    """Return the times (n,) of points, by the field of the usual drivers, and what they count from.

    Whole numbers are nanoseconds (Ouster ``t``, nebula ``time_stamp``, Livox ``offset_time``), others seconds (Velodyne
    ``time``). What is as large as a date counts from 1970 (Hesai and RoboSense ``timestamp`` in seconds, Livox
    ``timestamp`` in nanoseconds), anything else from the cloud's stamp.
    """
    name = next((one for one in _TIMES if one in (points.dtype.names or ())), None)
    if name is None:
        there = ", ".join(points.dtype.names or ())
        raise ValueError(f"has no time of each point (fields {there}), so the motion cannot be taken into account")
    values = points[name]
    if not len(values):
        return np.empty(0, np.int64), scale
    if values.dtype.kind in "iu":
        if values.dtype.itemsize < 4:
            raise ValueError(f"has times {name} of {values.dtype.itemsize} bytes; want nanoseconds")
        return _since(values.astype(np.int64), stamp_ns, scale)
    good = np.isfinite(values)
    seconds = np.where(good, values, 0.0).astype(np.float64)
    largest = float(np.abs(seconds).max())
    if largest >= _ABSOLUTE_NS:
        return np.where(good & (seconds > 0), seconds, NO_TIME_NS).astype(np.int64), Scale.UTC
    if largest >= _ABSOLUTE_S:
        whole = np.floor(seconds)
        time_ns = whole.astype(np.int64) * SECOND_NS + np.rint((seconds - whole) * SECOND_NS).astype(np.int64)
        return np.where(good & (seconds > 0), time_ns, NO_TIME_NS), Scale.UTC
    return _since(np.rint(seconds * SECOND_NS).astype(np.int64), stamp_ns, scale)


def _since(offset_ns: Int64Array, stamp_ns: int, scale: Scale) -> tuple[Int64Array, Scale]:
    """Return times that count from the stamp, or from 1970 where they are as large as that."""
    if int(np.abs(offset_ns).max()) >= COUNTED_BEFORE_NS:
        return offset_ns, Scale.UTC
    if int(np.abs(offset_ns).max()) > _LONGEST_CLOUD_NS:
        raise ValueError(f"has points {int(np.abs(offset_ns).max()) / SECOND_NS:.0f} s from its stamp")
    return stamp_ns + offset_ns, scale


def _fill(rows: StructArray, target: str, points: StructArray, names: Iterable[str]) -> None:
    name = next((one for one in names if one in (points.dtype.names or ())), None)
    if name is not None:
        values = np.nan_to_num(points[name]) if points[name].dtype.kind == "f" else points[name]
        rows[target] = values.astype(rows.dtype[target])


def _frames(rows: StructArray, stamp_ns: int, scale: Scale) -> list[Unit]:
    """Return the frames of points in order of time, without those that have no place."""
    place = np.stack([rows["x_m"], rows["y_m"], rows["z_m"]])
    rows = rows[np.isfinite(place).all(axis=0) & (place != 0.0).any(axis=0)]
    rows["return_number"] = rows["number_of_returns"] = 1
    rows = rows[np.argsort(rows["time_ns"], kind="stable")]
    return [Unit(stamp_ns, frame) for frame in encode_frames(RowKind.POINT, rows, scale)]


def _custom(data: bytes, *, ros2: bool) -> list[Unit]:
    """Return the points of a Livox ``CustomMsg``, read by its layout, because objects of each point cost too much.

    header, u8 timebase (ns), u4 number of points, u1 head, u1[3] reserved, points (`_CUSTOM_POINT`).
    """
    order, at, start = "<", 0, 0
    if ros2:
        if data[:2] not in (b"\0\0", b"\0\1"):
            raise ValueError("is not CDR; if its messages are compressed, give the folder of the bag")
        order, at, start = "<" if data[1] else ">", 4, 4
    try:
        seconds, rest_ns, length = struct.unpack_from(order + "III", data, at + (0 if ros2 else 4))
        at += (12 if ros2 else 16) + length
        at = _aligned(at, 8, start) if ros2 else at
        at += 8 + 4 + 1 + 3
        at = _aligned(at, 4, start) if ros2 else at
        (count,) = struct.unpack_from(order + "I", data, at)
    except struct.error as error:
        raise ValueError("ends before its points") from error
    dtype = np.dtype([(name, order + kind) for name, kind in _CUSTOM_POINT])
    stride = _aligned(dtype.itemsize, 4, 0) if ros2 else dtype.itemsize
    at, end = at + 4, at + 4 + max(count - 1, 0) * stride + (dtype.itemsize if count else 0)
    if end > len(data):
        raise ValueError(f"has {len(data)} bytes, but its {count} points end at {end}")
    points: StructArray = np.ndarray((count,), dtype, data, at, (stride,))
    stamp_ns, _, scale = _scaled(seconds * SECOND_NS + rest_ns)
    rows = np.zeros(count, ROWS[RowKind.POINT])
    rows["time_ns"] = stamp_ns + points["offset_time"].astype(np.int64)
    for axis in "xyz":
        rows[f"{axis}_m"] = points[axis]
    rows["intensity"], rows["channel"] = points["reflectivity"], points["line"]
    return _frames(rows, stamp_ns, scale)


def _aligned(at: int, size: int, start: int) -> int:
    return start + (at - start + size - 1) // size * size


_MAKERS: dict[str, Callable[[Any], list[Unit]]] = {
    "sensor_msgs/msg/Imu": _imu,
    "sensor_msgs/msg/NavSatFix": _nav_sat_fix,
    "sensor_msgs/msg/PointCloud2": _cloud,
    "gps_common/msg/GPSFix": _gps_fix,
    "gps_msgs/msg/GPSFix": _gps_fix,
    "nav_msgs/msg/Odometry": _odometry,
}
