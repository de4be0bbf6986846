"""SBG Systems' sbgECom frame: FF 5A, message, class, length, data, CRC-16, 33; numbers with the low byte first.

Sources: SBG's sbgECom (github.com/SBG-Systems/sbgECom, 05c19cdd): ``doc/binaryProtocol.md`` (frame, CRC, large frames,
classes) and ``doc/binaryMessages.md`` (logs). A log may be longer than in older firmware, as the maker appends to it;
some are shorter in older firmware, so that a layout here ends before the appended fields.
"""

from __future__ import annotations

import struct
from typing import Any, NamedTuple

from fastcrc.crc16 import kermit as crc16_kermit

from swath.drivers.framing.framer import OVER_BOUND, UNDECIDED, FrameKind

SYNC = b"\xff\x5a"
END = 0x33
HEADER = struct.Struct("<2sBBH")
TAIL_BYTES = 3  # CRC and end
MAX_DATA_BYTES = 4086
MAX_BYTES = HEADER.size + MAX_DATA_BYTES + TAIL_BYTES
LARGE = 0x80  # bit of the class: a page of a large answer to a command
CLASSES = bytes([*range(6), 0x10, 0x90])
CLASS_NAMES = {0x02: "NMEA", 0x03: "NMEA-P", 0x04: "third-party", 0x05: "NMEA-GNSS", 0x10: "command", 0x90: "large"}

STATUS, UTC_TIME, IMU_DATA, IMU_SHORT = 1, 2, 3, 44
EKF_EULER, EKF_QUAT, EKF_NAV = 6, 7, 8
VELOCITIES, POSITIONS, HEADINGS = {13: 1, 16: 2}, {14: 1, 17: 2}, {15: 1, 18: 2}  # log: number of the receiver
EVENTS = dict(zip(range(24, 29), "ABCDE", strict=True))

NAMES = {
    **{1: "STATUS", 2: "UTC_TIME", 3: "IMU_DATA", 44: "IMU_SHORT", 4: "MAG", 5: "MAG_CALIB", 6: "EKF_EULER"},
    **{7: "EKF_QUAT", 8: "EKF_NAV", 9: "SHIP_MOTION", 32: "SHIP_MOTION_HP", 13: "GPS1_VEL", 14: "GPS1_POS"},
    **{15: "GPS1_HDT", 31: "GPS1_RAW", 50: "GPS1_SAT", 16: "GPS2_VEL", 17: "GPS2_POS", 18: "GPS2_HDT"},
    **{38: "GPS2_RAW", 51: "GPS2_SAT", 19: "ODO_VEL", 36: "AIR_DATA", 47: "DEPTH", 37: "USBL", 48: "DIAG"},
    **{29: "DVL_BOTTOM_TRACK", 30: "DVL_WATER_TRACK", 45: "EVENT_OUT_A", 46: "EVENT_OUT_B", 49: "RTCM_RAW"},
    **{52: "EKF_ROT_ACCEL_BODY", 53: "EKF_ROT_ACCEL_NED", 54: "EKF_VEL_BODY", 55: "SESSION_INFO", 57: "PTP_STATUS"},
    **{number: f"EVENT_{letter}" for number, letter in EVENTS.items()},
}


class UtcTime(NamedTuple):
    """UTC_TIME (02), without the clock's sigmas."""

    stamp_us: int
    status: int
    year: int
    month: int
    day: int
    hour: int
    minute: int
    second: int
    nanosecond: int
    tow_ms: int


class Position(NamedTuple):
    """GPSx_POS (14, 17) up to the accuracies; heights in metres, angles in degrees."""

    stamp_us: int
    status: int
    tow_ms: int
    lat_deg: float
    lon_deg: float
    altitude_m: float
    undulation_m: float
    lat_sigma_m: float
    lon_sigma_m: float
    altitude_sigma_m: float


class Velocity(NamedTuple):
    """GPSx_VEL (13, 16) without course."""

    stamp_us: int
    status: int
    tow_ms: int
    north: float
    east: float
    down: float
    north_sigma: float
    east_sigma: float
    down_sigma: float


class Heading(NamedTuple):
    """GPSx_HDT (15, 18) up to the accuracies, degrees."""

    stamp_us: int
    status: int
    tow_ms: int
    heading_deg: float
    heading_sigma_deg: float
    pitch_deg: float
    pitch_sigma_deg: float


class Nav(NamedTuple):
    """EKF_NAV (08): velocity, position and their sigmas."""

    stamp_us: int
    north: float
    east: float
    down: float
    north_sigma: float
    east_sigma: float
    down_sigma: float
    lat_deg: float
    lon_deg: float
    altitude_m: float
    undulation_m: float
    lat_sigma_m: float
    lon_sigma_m: float
    altitude_sigma_m: float
    status: int


LAYOUTS: dict[int, struct.Struct] = {
    STATUS: struct.Struct("<I2H2I"),  # stamp, general, communication 2 and 1, aiding
    UTC_TIME: struct.Struct("<I2H5B2I"),
    IMU_DATA: struct.Struct("<IH6ff6f"),  # stamp, status, accelerations, rates, temperature, both again
    IMU_SHORT: struct.Struct("<IH6ih"),
    EKF_EULER: struct.Struct("<I6fI"),  # stamp, roll, pitch, yaw, their sigmas, status
    EKF_QUAT: struct.Struct("<I7fI"),  # stamp, w, x, y, z, sigmas of the angles, status
    EKF_NAV: struct.Struct("<I6f3d4fI"),
    **dict.fromkeys(VELOCITIES, struct.Struct("<3I6f")),
    **dict.fromkeys(POSITIONS, struct.Struct("<3I3d4f")),
    **dict.fromkeys(HEADINGS, struct.Struct("<IHI4f")),
    **dict.fromkeys(EVENTS, struct.Struct("<I5H")),  # stamp, status, offsets of further events
}
SATELLITES_AT = 52  # in GPSx_POS, since sbgECom 1.4
BASELINE = struct.Struct("<26xf")  # in GPSx_HDT, since sbgECom 1.11


def measure(buffer: bytes, start: int, final: bool) -> int:
    """Measure header, data by the length field, CRC and end."""
    if len(buffer) - start < HEADER.size:
        return UNDECIDED
    length: int = HEADER.unpack_from(buffer, start)[3]
    return HEADER.size + length + TAIL_BYTES if length <= MAX_DATA_BYTES else OVER_BOUND


def intact(frame: bytes) -> bool:
    """Return whether the CRC over message to data and the end are right."""
    return frame[-1] == END and crc16_kermit(frame[2:-TAIL_BYTES]) == int.from_bytes(frame[-TAIL_BYTES:-1], "little")


def message_name(frame: bytes) -> str:
    """Return the log's name, or that of the class and the message's number."""
    message, kind = frame[2], frame[3]
    if kind == 0:
        return NAMES.get(message, f"LOG-{message}")
    return f"{CLASS_NAMES.get(kind, f'class {kind}')}-{message}"


SBG_ECOM = FrameKind(
    "sbg-ecom", (SYNC[:1], SYNC[1:], bytes(range(256)), CLASSES), MAX_BYTES, measure, intact, message_name
)


def read_log(frame: bytes) -> tuple[int, tuple[Any, ...], bytes] | None:
    """Return number, values and data of a frame that is a known log (values empty where it is too short); None for
    any other.
    """
    layout = LAYOUTS.get(frame[2]) if frame[3] == 0 else None
    if layout is None:
        return None
    data = frame[HEADER.size : -TAIL_BYTES]
    return frame[2], layout.unpack_from(data) if len(data) >= layout.size else (), data


def encode_frame(message: int, data: bytes, kind: int = 0) -> bytes:
    """Encode a frame.

    Raises:
        ValueError: the data are longer than a frame can hold.
    """
    if len(data) > MAX_DATA_BYTES:
        raise ValueError(f"an sbgECom frame cannot hold {len(data)} bytes")
    body = HEADER.pack(SYNC, message, kind, len(data)) + data
    return body + crc16_kermit(body[2:]).to_bytes(2, "little") + bytes([END])


def encode_log(message: int, *values: float | int, more: bytes = b"") -> bytes:
    """Encode a log by its layout, then the fields that newer firmware appends.

    Raises:
        KeyError: no layout of that log.
        struct.error: the values do not fit.
    """
    return encode_frame(message, LAYOUTS[message].pack(*values) + more)
