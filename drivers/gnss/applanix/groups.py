"""Applanix POS groups as tables, and an encoder (POS AV V6, POS LV V5 and POS MV V5 user interface control documents).

A group is ``$GRP``, its number, a length, the time and distance fields, its data, padding, a checksum and ``$#``.
All numbers are little-endian, angles in degrees.
"""

from __future__ import annotations

import struct
from typing import Generic, NamedTuple, TypeVar

GroupT = TypeVar("GroupT", bound=tuple[float, ...])

HEADER_BYTES = 8
TAIL_BYTES = 4  # checksum, $#
TAIL = b"$#"


class TimeDistance(NamedTuple):
    """Beginning of every group: two times, each of its own kind, and a distance."""

    time1_s: float
    time2_s: float
    distance: float
    time_types: int  # bits 0-3 of time 1, 4-7 of time 2: TIME_*
    distance_type: int


TIME_POS, TIME_GPS, TIME_UTC, TIME_USER = range(4)  # seconds since power-on, of the GPS week, of the UTC week, user's
TIME_DISTANCE = struct.Struct("<dddBB")


class Layout(Generic[GroupT]):
    """Encodes and decodes one group; newer firmware may append fields."""

    def __init__(self, number: int, group: type[GroupT], fields: str) -> None:
        self.number = number
        self._group = group
        self._wire = struct.Struct("<" + fields)

    def decode(self, frame: bytes) -> tuple[TimeDistance, GroupT] | None:
        """Decode a whole frame; return None where it is too short."""
        if len(frame) < HEADER_BYTES + TIME_DISTANCE.size + self._wire.size + TAIL_BYTES:
            return None
        times = TimeDistance(*TIME_DISTANCE.unpack_from(frame, HEADER_BYTES))
        return times, self._group(*self._wire.unpack_from(frame, HEADER_BYTES + TIME_DISTANCE.size))

    def encode(self, times: TimeDistance, group: GroupT) -> bytes:
        """Encode a group as a whole frame."""
        return encode_frame(b"$GRP", self.number, TIME_DISTANCE.pack(*times) + self._wire.pack(*group))


def encode_frame(start: bytes, number: int, data: bytes) -> bytes:
    """Build a frame: padding to a multiple of 4, and the checksum that makes all 16-bit words add up to 0."""
    data += bytes(-(len(data)) % 4)
    content = start + struct.pack("<HH", number, len(data) + TAIL_BYTES) + data
    total = sum(struct.unpack(f"<{len(content) // 2}H", content)) + int.from_bytes(TAIL, "little")
    return content + struct.pack("<H", -total & 0xFFFF) + TAIL


class Navigation(NamedTuple):
    """Group 1, vehicle navigation solution: height above the ellipsoid, attitude of the vehicle's frame."""

    lat_deg: float
    lon_deg: float
    height_m: float
    north_mps: float
    east_mps: float
    down_mps: float
    roll_deg: float
    pitch_deg: float
    heading_deg: float  # true
    wander_deg: float
    track_deg: float
    speed_mps: float
    x_rate_dps: float
    y_rate_dps: float
    z_rate_dps: float
    x_acceleration_mps2: float
    y_acceleration_mps2: float
    z_acceleration_mps2: float
    alignment: int  # 0 full navigation, 1 fine alignment, … 8 no valid solution


FULL_NAVIGATION, FINE_ALIGNMENT = 0, 1


class Performance(NamedTuple):
    """Group 2, vehicle navigation performance metrics: RMS errors, and the error ellipsoid."""

    north_m: float
    east_m: float
    down_m: float
    north_mps: float
    east_mps: float
    down_mps: float
    roll_deg: float
    pitch_deg: float
    heading_deg: float
    semi_major_m: float
    semi_minor_m: float
    orientation_deg: float


class GnssStatus(NamedTuple):
    """Group 3, primary GNSS status, its part behind the channels."""

    hdop: float
    vdop: float
    dgps_latency_s: float
    dgps_station: int
    week: int
    leap_seconds: float
    latency_s: float
    geoid_m: float
    receiver: int
    status: int


class ImuHead(NamedTuple):
    """Group 4, time-tagged IMU data, behind its six counts of velocity and angle (POS TNG3 core ICD, table 19)."""

    bad_frames: int  # bits: one, two, three bad frames of the IMU
    imu_type: int  # the maker's own designation
    rate: int
    imu_status: int


IMU_RATES_HZ = (50, 100, 200, 400, 125, 500)  # by ImuHead.rate


class Event(NamedTuple):
    """Groups 5 and 6, events 1 and 2."""

    pulse: int


class Pps(NamedTuple):
    """Group 7, PPS time recovery and status."""

    pulses: int
    status: int  # 0 not synchronised, 1 synchronising, 2 synchronised, 3 with an old offset


PPS_SYNCHRONISED = 2


class General(NamedTuple):
    """Group 10, general status and FDIR: status words A to C, then those of faults."""

    status_a: int
    status_b: int
    status_c: int


class SensorNavigation(NamedTuple):
    """Groups 102 and 103, navigation of sensors 1 and 2 (POS MV V5 ICD, table 29): attitude of the sensor's frame."""

    lat_deg: float
    lon_deg: float
    height_m: float
    along_mps: float
    across_mps: float
    down_mps: float
    roll_deg: float
    pitch_deg: float
    heading_deg: float
    wander_deg: float
    heave_m: float  # down
    x_rate_dps: float
    y_rate_dps: float
    z_rate_dps: float
    x_acceleration_mps2: float
    y_acceleration_mps2: float
    z_acceleration_mps2: float


class SensorPerformance(NamedTuple):
    """Groups 104 and 105, performance metrics of sensors 1 and 2: RMS errors (POS MV V5 ICD, table 30)."""

    north_m: float
    east_m: float
    down_m: float
    along_mps: float
    across_mps: float
    down_mps: float
    roll_deg: float
    pitch_deg: float
    heading_deg: float


NAVIGATION = Layout(1, Navigation, "dddfffddddffffffffB")
PERFORMANCE = Layout(2, Performance, "12f")
IMU = Layout(4, ImuHead, "24xBBBH")
EVENT_1, EVENT_2 = Layout(5, Event, "I"), Layout(6, Event, "I")
PPS = Layout(7, Pps, "IB")
GENERAL = Layout(10, General, "III")
SENSORS = tuple(Layout(number, SensorNavigation, "dddfffddddfffffff") for number in (102, 103))
SENSOR_PERFORMANCES = tuple(Layout(number, SensorPerformance, "9f") for number in (104, 105))
GNSS_STATUS_NUMBER = 3
_GNSS_HEAD = struct.Struct("<bBH")  # solution, satellites, bytes of the channels
_GNSS_TAIL = struct.Struct("<fffHIdffHI")


def decode_gnss_status(frame: bytes) -> tuple[TimeDistance, int, GnssStatus] | None:
    """Return times, solution and fields of a group 3; None where it is too short for its channels."""
    start = HEADER_BYTES + TIME_DISTANCE.size
    if len(frame) < start + _GNSS_HEAD.size + _GNSS_TAIL.size + TAIL_BYTES:
        return None
    solution, _, channel_bytes = _GNSS_HEAD.unpack_from(frame, start)
    tail = start + _GNSS_HEAD.size + channel_bytes
    if len(frame) < tail + _GNSS_TAIL.size + TAIL_BYTES:
        return None
    times = TimeDistance(*TIME_DISTANCE.unpack_from(frame, HEADER_BYTES))
    return times, solution, GnssStatus(*_GNSS_TAIL.unpack_from(frame, tail))


def encode_gnss_status(times: TimeDistance, solution: int, status: GnssStatus, channels: bytes = b"") -> bytes:
    """Encode a group 3; ``channels`` holds 20 bytes for each satellite."""
    head = _GNSS_HEAD.pack(solution, len(channels) // 20, len(channels))
    return encode_frame(
        b"$GRP", GNSS_STATUS_NUMBER, TIME_DISTANCE.pack(*times) + head + channels + _GNSS_TAIL.pack(*status)
    )
