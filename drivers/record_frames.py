"""Frames of protocol ``records``: records of receivers, inertial units and scanners that another program decoded.

Swath's own format, described on docs/devices/records.md. A frame is a header of 16 bytes, rows of one kind, and a CRC;
all numbers are little-endian, units are SI and radians, frames those of docs/conventions.md:

    0   4  "SwRc"
    4  u1  version, 1
    5  u1  kind of the rows
    6  u1  scale of the rows' times
    7  u1  flags
    8  u4  bytes of the frame, CRC included
    12 u4  number of rows
    16     rows
    …  u4  CRC-32 (ISO-HDLC, as in zip) of all before it
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from enum import IntEnum
from typing import Any

import numpy as np
from fastcrc.crc32 import iso_hdlc as crc32

from swath.drivers.framing.framer import FALSE_SYNC, OVER_BOUND, UNDECIDED, FrameKind
from swath.georef.arrays import Int64Array, StructArray
from swath.georef.timescales.gps_time import DAY_NS, GPS_EPOCH_UNIX_S, LEAP_SECOND_TABLE, SECOND_NS

SYNC, VERSION = b"SwRc", 1
HEADER, CRC = struct.Struct("<4s4B2I"), struct.Struct("<I")
OVERHEAD_BYTES = HEADER.size + CRC.size
MAX_BYTES = 60_000  # fits a datagram
NO_TIME_NS = -1
TAI_EPOCH_NS = (GPS_EPOCH_UNIX_S + 19) * SECOND_NS  # of GPS time 0, counted from 1970 in TAI
LATEST_NS = 1 << 62  # of a time: everything that is added to it still fits
TELLS_TIME = 1  # flag: the fixes also name the second in which they arrive
NO_ARRIVAL = 2  # flag: the unit's host time is the rows' own time, not that of an arrival


class Scale(IntEnum):
    """Names what the times of rows, in nanoseconds, count from."""

    GPS = 0  # 1980-01-06, GPS time
    UTC = 1  # 1970-01-01 without leap seconds (POSIX)
    COUNTER = 2  # any moment: a counter of the device or its computer


class RowKind(IntEnum):
    """Kinds of rows."""

    FIX = 1
    HEADING = 2
    TIME = 3
    MARK = 4
    SAMPLE = 5
    SOLUTION = 6
    RETURN = 7
    POINT = 8


_TIME: list[Any] = [("time_ns", "<i8")]  # in the frame's scale; −1: unknown
_TIMED: list[Any] = [*_TIME, ("time_sigma_s", "<f4")]  # nan: unknown
_MESSAGE: Any = ("message", "S24")  # its name where it was decoded

ROWS: dict[RowKind, np.dtype[Any]] = {
    RowKind.FIX: np.dtype(
        [
            *_TIMED,
            ("fix_type", "u1"),  # `swath.georef.records.FixType`
            ("valid", "u1"),
            ("satellites", "<i2"),  # −1: not given
            *((name, "<f8") for name in ("lat_rad", "lon_rad", "height_m", "undulation_m")),  # nan: not given
            ("velocity_l", "<f8", (3,)),  # north, east, down; nan: not given
            ("position_cov_l", "<f8", (6,)),  # nn, ne, nd, ee, ed, dd, m²; nan: not given
            ("velocity_cov_l", "<f8", (6,)),
            ("antenna", "S16"),
            _MESSAGE,
        ]
    ),
    RowKind.HEADING: np.dtype(
        [
            *_TIMED,
            ("valid", "<u4"),
            *(
                (name, "<f8")
                for name in ("heading_rad", "pitch_rad", "baseline_m", "heading_sigma_rad", "pitch_sigma_rad")
            ),
            _MESSAGE,
        ]
    ),
    RowKind.TIME: np.dtype(
        [*_TIMED, ("names_next", "u1"), ("bound", "u1"), ("valid", "u1"), ("leap_seconds", "i1"), _MESSAGE]
    ),
    RowKind.MARK: np.dtype(
        [
            *_TIME,
            ("time_sigma_s", "<f8"),
            ("count", "<i8"),  # −1: not given
            ("rising", "<i2"),  # −1: not given
            ("valid", "<u2"),
            ("reserved", "<u4"),
            ("channel", "S24"),
            _MESSAGE,
        ]
    ),
    RowKind.SAMPLE: np.dtype(
        [
            *_TIMED,
            ("temperature_c", "<f4"),  # nan: not given
            ("specific_force_b", "<f8", (3,)),  # along the unit's own axes
            ("angular_rate_b", "<f8", (3,)),
            ("pps_time_ns", "<i8"),  # of a counter, latched at the last edge; −1: none
            ("status", "<u4"),
            ("reserved", "<u4"),
        ]
    ),
    RowKind.SOLUTION: np.dtype(
        [
            *_TIME,
            *((name, "<f8") for name in ("lat_rad", "lon_rad", "height_m")),
            ("velocity_l", "<f8", (3,)),
            *((name, "<f8") for name in ("roll_rad", "pitch_rad", "heading_rad")),
            *((name, "<f4", (3,)) for name in ("position_sigma_l", "velocity_sigma_l", "attitude_sigma_rad")),
            ("status", "<u4"),
            ("valid", "<u4"),
            ("reserved", "<u4"),
        ]
    ),
    RowKind.RETURN: np.dtype(
        [
            *_TIME,
            *((name, "<f8") for name in ("range_m", "encoder_rad", "elevation_rad")),
            ("pulse_id", "<u8"),
            ("intensity", "<f4"),
            ("pulse_width_ns", "<f4"),  # 0: unknown
            ("channel", "<u2"),
            *((name, "u1") for name in ("return_number", "number_of_returns", "mta_zone", "flags")),
            ("reserved", "<u2"),
        ]
    ),
    RowKind.POINT: np.dtype(
        [
            *_TIME,
            *((name, "<f4") for name in ("x_m", "y_m", "z_m", "intensity")),  # x forward, y left, z up
            ("channel", "<u2"),
            *((name, "u1") for name in ("return_number", "number_of_returns", "flags")),
            ("reserved", "u1", (3,)),
        ]
    ),
}
NAMES = {kind: kind.name.lower() for kind in RowKind}


def encode_frame(kind: RowKind, rows: StructArray, scale: Scale = Scale.GPS, flags: int = 0) -> bytes:
    """Encode rows of a kind, of `ROWS`, as one frame.

    Raises:
        ValueError: they do not fit a frame.
    """
    length = OVERHEAD_BYTES + rows.nbytes
    if length > MAX_BYTES:
        raise ValueError(f"{len(rows)} rows need {length} bytes, a frame has {MAX_BYTES} at most")
    return pack_frame(kind, rows.astype(ROWS[kind]).tobytes(), len(rows), scale, flags)


def pack_frame(kind: RowKind, data: bytes, count: int, scale: Scale, flags: int) -> bytes:
    """Return the frame of ``count`` rows, given by their bytes."""
    content = HEADER.pack(SYNC, VERSION, kind, scale, flags, OVERHEAD_BYTES + len(data), count) + data
    return content + CRC.pack(crc32(content))


def most_rows(kind: RowKind) -> int:
    """Return how many rows a frame can have."""
    return (MAX_BYTES - OVERHEAD_BYTES) // ROWS[kind].itemsize


def encode_frames(kind: RowKind, rows: StructArray, scale: Scale = Scale.GPS, flags: int = 0) -> Iterator[bytes]:
    """Encode any number of rows as frames."""
    most = most_rows(kind)
    for first in range(0, len(rows), most):
        yield encode_frame(kind, rows[first : first + most], scale, flags)


def decode_rows(frame: bytes) -> tuple[RowKind, Scale, int, StructArray] | str:
    """Decode a frame whose CRC is good: its kind, scale, flags and rows; or the error code of what it cannot be."""
    _, version, kind, scale, flags, length, count = HEADER.unpack_from(frame)
    if version != VERSION:
        return "bad_version"
    if kind not in NAMES:
        return "bad_kind"
    if scale not in tuple(Scale):
        return "bad_scale"
    dtype = ROWS[RowKind(kind)]
    if length != len(frame) or length != OVERHEAD_BYTES + count * dtype.itemsize:
        return "bad_length"
    return RowKind(kind), Scale(scale), flags, np.frombuffer(frame, dtype, count, HEADER.size)


def measure(buffer: bytes, start: int, final: bool) -> int:
    """Return the length of the frame at ``start``, as `FrameKind` wants it."""
    del final
    if len(buffer) - start < HEADER.size:
        return UNDECIDED
    length: int = HEADER.unpack_from(buffer, start)[5]
    if length < OVERHEAD_BYTES:
        return FALSE_SYNC
    return length if length <= MAX_BYTES else OVER_BOUND


def intact(frame: bytes) -> bool:
    """Return whether a frame's CRC is good."""
    return bool(CRC.unpack_from(frame, len(frame) - CRC.size)[0] == crc32(frame[: -CRC.size]))


def message_name(frame: bytes) -> str:
    """Return the name of the kind of rows."""
    return next((name for kind, name in NAMES.items() if frame[5] == kind), "unknown")


RECORDS = FrameKind("records", tuple(bytes([one]) for one in SYNC), MAX_BYTES, measure, intact, message_name)

# POSIX times from which on GPS − UTC is the count beside them
_LEAP_FROM_NS = np.array([(day.toordinal() - 719_163) * DAY_NS for day, _ in LEAP_SECOND_TABLE], np.int64)
_LEAP_NS = np.array([count for _, count in LEAP_SECOND_TABLE], np.int64) * SECOND_NS


def gps_from_posix(unix_ns: Int64Array) -> Int64Array:
    """Return GPS ns (n,) of POSIX times (n,), by the built-in table of leap seconds; −1 before 1980."""
    place = np.searchsorted(_LEAP_FROM_NS, unix_ns, side="right") - 1
    gps_ns = unix_ns - GPS_EPOCH_UNIX_S * SECOND_NS + _LEAP_NS[np.maximum(place, 0)]
    return np.where((place >= 0) & (unix_ns < LATEST_NS), gps_ns, NO_TIME_NS)


def posix_from_gps(gps_ns: Int64Array) -> Int64Array:
    """Return POSIX ns (n,) of GPS times (n,), by the built-in table of leap seconds."""
    starts_ns = _LEAP_FROM_NS - GPS_EPOCH_UNIX_S * SECOND_NS + _LEAP_NS
    place = np.maximum(np.searchsorted(starts_ns, gps_ns, side="right") - 1, 0)
    unix_ns: Int64Array = gps_ns + GPS_EPOCH_UNIX_S * SECOND_NS - _LEAP_NS[place]
    return unix_ns


def gps_times(time_ns: Int64Array, scale: Scale) -> Int64Array:
    """Return GPS ns (n,) of rows' times (n,); −1 where there is none."""
    if scale is Scale.COUNTER:
        return np.full(len(time_ns), NO_TIME_NS, np.int64)
    if scale is Scale.UTC:
        return gps_from_posix(time_ns)
    return np.where((time_ns >= 0) & (time_ns < LATEST_NS), time_ns, NO_TIME_NS)
