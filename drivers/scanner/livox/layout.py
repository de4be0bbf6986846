"""Layouts of Livox packets of both SDKs, as tables, and their encoders.

SDK 1 (Mid-40, Mid-70, Tele-15, Horizon, Avia): header of 18 bytes, points whose number follows from their type, no
checksum. Sources: github.com/Livox-SDK/Livox-SDK @ 0f1015a, sdk_core/include/livox_def.h (header, time types);
github.com/Livox-SDK/livox_ros_driver, lds.h (points in a packet, intervals and lines of each model) and lds.cpp (UTC of
time type 3).

SDK 2 (Mid-360, HAP): header of 36 bytes with the number of points, the time from the first to the last, and a CRC-32 of
time and points. Sources: Livox, "Livox LiDAR Communication Protocol - Mid360" v1.4.10 and "… HAP" v1.4.8, Point Cloud &
IMU Data Protocol; github.com/Livox-SDK/Livox-SDK2 @ 08f523c, include/livox_lidar_def.h.
"""

from __future__ import annotations

import datetime as dt
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from swath.georef.arrays import StructArray

VERSION_1, VERSION_2 = 5, 0  # the header's first byte
# type of time in the header
NO_SYNC, PTP = 0, 1  # both SDKs: nanoseconds since power-on; of the PTP master
PPS_GPS_1, PPS_1 = 3, 4  # SDK 1: UTC of GPRMC and pulse; nanoseconds since the last pulse
GPS_2 = 2  # SDK 2: nanoseconds of UTC since 1970, of GPRMC and pulse
IMU_1, IMU_2 = 6, 0  # types of data
SAMPLES_HZ = 200.0  # of the IMU, "Livox SDK Communication Protocol", IMU Data Push Frequency

HEADER_1 = np.dtype(
    [
        ("version", "u1"),
        ("slot", "u1"),
        ("id", "u1"),
        ("reserved", "u1"),
        ("status", "<u4"),
        ("time_type", "u1"),
        ("data_type", "u1"),
        ("time", "u1", (8,)),
    ]
)
HEADER_2 = np.dtype(
    [
        ("version", "u1"),
        ("length", "<u2"),
        ("span_100ns", "<u2"),  # from the first point to the last
        ("points", "<u2"),
        ("count", "<u2"),
        ("frame", "u1"),
        ("data_type", "u1"),
        ("time_type", "u1"),
        ("reserved", "V12"),
        ("crc32", "<u4"),
        ("time", "u1", (8,)),
    ]
)
_UTC = np.dtype([("year", "u1"), ("month", "u1"), ("day", "u1"), ("hour", "u1"), ("microsecond", "<u4")])
IMU_DTYPE = np.dtype([("rate", "<f4", (3,)), ("force_g", "<f4", (3,))])  # rad/s; g

_XYZ = [("x", "<i4"), ("y", "<i4"), ("z", "<i4"), ("reflectivity", "u1")]
_TAGGED = [*_XYZ, ("tag", "u1")]
_POLAR = [("range", "<u4"), ("zenith", "<u2"), ("azimuth", "<u2"), ("reflectivity", "u1")]
_ECHO = [("range", "<u4"), ("reflectivity", "u1"), ("tag", "u1")]


@dataclass(frozen=True)
class PointType:
    """A type of data with points.

    Attributes:
        name: for the counters.
        dtype: of one pulse: fields ``x``, ``y``, ``z``, or ``range``, ``zenith`` and ``azimuth`` (0.01°), with
            ``reflectivity`` and ``tag``; of several returns in ``echoes``.
        pulses: in a packet of SDK 1; 0: the header gives the number.
        unit_m: metres of one unit of length.
    """

    name: str
    dtype: np.dtype[Any]
    pulses: int = 0
    unit_m: float = 1e-3

    @property
    def echoes(self) -> int:
        """The number of returns that a pulse can have."""
        names = self.dtype.names or ()
        return int(self.dtype["echoes"].shape[0]) if "echoes" in names else 1

    @property
    def is_polar(self) -> bool:
        """True if directions are angles; otherwise they are x, y, z."""
        return "zenith" in (self.dtype.names or ())

    @property
    def has_tag(self) -> bool:
        """True if a return has a tag."""
        return self.echoes > 1 or "tag" in (self.dtype.names or ())


def _echoes_xyz(count: int) -> np.dtype[Any]:
    return np.dtype([("echoes", np.dtype(_TAGGED), (count,))])


def _echoes_polar(count: int) -> np.dtype[Any]:
    return np.dtype([("zenith", "<u2"), ("azimuth", "<u2"), ("echoes", np.dtype(_ECHO), (count,))])


POINTS_1 = {
    0: PointType("cartesian", np.dtype(_XYZ), 100),
    1: PointType("spherical", np.dtype(_POLAR), 100),
    2: PointType("cartesian-tagged", np.dtype(_TAGGED), 96),
    3: PointType("spherical-tagged", np.dtype([*_POLAR, ("tag", "u1")]), 96),
    4: PointType("cartesian-dual", _echoes_xyz(2), 48),
    5: PointType("spherical-dual", _echoes_polar(2), 48),
    7: PointType("cartesian-triple", _echoes_xyz(3), 30),
    8: PointType("spherical-triple", _echoes_polar(3), 30),
}
_SHORT = [("x", "<i2"), ("y", "<i2"), ("z", "<i2"), ("reflectivity", "u1"), ("tag", "u1")]
POINTS_2 = {
    1: PointType("cartesian", np.dtype(_TAGGED)),
    2: PointType("cartesian-16", np.dtype(_SHORT), unit_m=1e-2),
    3: PointType("spherical", np.dtype([*_POLAR, ("tag", "u1")])),
}


USUAL_PULSES = 96  # of a packet of SDK 2, which states their number


@dataclass(frozen=True)
class LivoxHead:
    """A family of models.

    Attributes:
        name: of the models.
        sdk: 1 or 2.
        pulses_hz: pulses a second by the data sheet. Packets of SDK 1, and files of Livox Viewer 2, do not tell when a
            pulse was fired.
        lines: lasers that fire in turn; a pulse's place in its packet gives its own (lds.h, comm.h of the ROS drivers).
    """

    name: str
    sdk: int
    lines: int
    pulses_hz: int

    @property
    def imu_bytes(self) -> int:
        """Bytes of a packet with a sample of the IMU."""
        return (HEADER_1 if self.sdk == 1 else HEADER_2).itemsize + IMU_DTYPE.itemsize

    @property
    def bytes_per_s(self) -> float:
        """The most that the head sends: the packets that take the most bytes for a pulse, and its IMU's."""
        kinds, header = (POINTS_1, HEADER_1) if self.sdk == 1 else (POINTS_2, HEADER_2)
        of_pulse = max(header.itemsize / (kind.pulses or USUAL_PULSES) + kind.dtype.itemsize for kind in kinds.values())
        return self.pulses_hz * of_pulse + SAMPLES_HZ * self.imu_bytes


MID40 = LivoxHead("Mid-40, Mid-70", 1, 1, 100_000)
AVIA = LivoxHead("Avia, Horizon, Tele-15", 1, 6, 240_000)
MID360 = LivoxHead("Mid-360", 2, 4, 200_000)
HAP = LivoxHead("HAP", 2, 6, 452_000)


def utc_bytes(when: dt.datetime) -> bytes:
    """Return time type 3 of SDK 1: year from 2000, month, day, hour, microseconds of the hour."""
    microsecond = (when.minute * 60 + when.second) * 1_000_000 + when.microsecond
    row = np.array([(when.year - 2000, when.month, when.day, when.hour, microsecond)], dtype=_UTC)
    return row.tobytes()


def utc_of(time: StructArray) -> tuple[Any, Any]:
    """Return nanoseconds since 1970 (n,) of time type 3, bytes (n, 8), and whether they are a time."""
    utc = np.ascontiguousarray(time).view(_UTC)[:, 0]
    year, month, day = (utc[name].astype(np.int64) for name in ("year", "month", "day"))
    good = (month >= 1) & (month <= 12) & (day >= 1) & (day <= 31) & (utc["hour"] < 24)
    good &= utc["microsecond"] <= 3_601_000_000  # a leap second is the hour's last
    months = (year + 30).astype("M8[Y]").astype("M8[M]") + (month - 1)
    days = (months.astype("M8[D]") + (day - 1)).astype(np.int64)
    hours = days * 24 + utc["hour"]
    return (hours * 3_600_000_000 + utc["microsecond"]) * 1000, good


def encode_packet_1(
    data_type: int,
    time_type: int,
    time: int | bytes,
    points: StructArray | Sequence[Any],
    *,
    status: int = 0,
    slot: int = 1,
    version: int = VERSION_1,
) -> bytes:
    """Encode a packet of SDK 1.

    Args:
        data_type: key of `POINTS_1`, or `IMU_1`.
        time_type: of the header.
        time: nanoseconds, or `utc_bytes`.
        points: (n,) of the type's dtype, or rows for it; fewer than a packet's are filled with zeros.
        status: the head's status code.
        slot: of the hub; 1 without a hub.
        version: of the protocol.
    """
    dtype, count = (IMU_DTYPE, 1) if data_type == IMU_1 else (POINTS_1[data_type].dtype, POINTS_1[data_type].pulses)
    table = np.zeros(count, dtype=dtype)
    table[: len(points)] = points
    header = np.zeros(1, dtype=HEADER_1)
    header["version"], header["slot"], header["id"], header["status"] = version, slot, 1, status
    header["time_type"], header["data_type"], header["time"] = time_type, data_type, _time_bytes(time)
    return header.tobytes() + table.tobytes()


def encode_packet_2(
    data_type: int,
    time_type: int,
    time_ns: int,
    points: StructArray | Sequence[Any],
    *,
    span_100ns: int = 4750,
    count: int = 0,
    crc: bool = True,
) -> bytes:
    """Encode a packet of SDK 2.

    Args:
        data_type: key of `POINTS_2`, or `IMU_2`.
        time_type: of the header.
        time_ns: of the first point.
        points: (n,) of the type's dtype, or rows for it.
        span_100ns: from the first point to the last.
        count: of packets.
        crc: False: 0 instead of the CRC, as a Mid-360 sends its points.
    """
    dtype = IMU_DTYPE if data_type == IMU_2 else POINTS_2[data_type].dtype
    data = np.array(points, dtype=dtype).tobytes()
    header = np.zeros(1, dtype=HEADER_2)
    header["version"], header["length"], header["points"] = VERSION_2, HEADER_2.itemsize + len(data), len(points)
    header["span_100ns"], header["count"], header["data_type"] = span_100ns, count % 65_536, data_type
    header["time_type"], header["time"] = time_type, _time_bytes(time_ns)
    header["crc32"] = zlib.crc32(header["time"].tobytes() + data) if crc else 0
    return header.tobytes() + data


def _time_bytes(time: int | bytes) -> ArrayLike:
    raw = time if isinstance(time, bytes) else time.to_bytes(8, "little")
    return np.frombuffer(raw, dtype=np.uint8)
