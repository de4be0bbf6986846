"""Items of MTData2 as tables, their number formats, and an encoder.

Sources: the maker's MTi user manual MT0605P (4.12, 5.3) and MTi family reference manual MT1600P (4.3); names,
identifiers and number formats as in github.com/einride/xsens-go; fields of GnssPvtData and GnssSatInfo, and bits of the
status word, as in the headers of the maker's SDK (xsrawgnsspvtdata.h, xssatinfo.h, xsstatusflag.h).
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any, NamedTuple

from swath.drivers.framing.kinds import XBUS, XBUS_EXTENDED, XBUS_MTDATA2

PREAMBLE = b"\xfa\xff"  # a device alone on its line is bus identifier FF
ITEM_HEADER = struct.Struct(">HB")  # identifier, length (MT0605P 5.3)
TYPE_BITS = 0xF8F0  # bits of an identifier: group and type
FORMAT_BITS = 0x0003  # number format
AXES_BITS = 0x000C  # local frame of orientations and velocities (MT0101P, revision W)

TEMPERATURE = 0x0810
UTC_TIME = 0x1010
PACKET_COUNTER = 0x1020
SAMPLE_TIME_FINE = 0x1060
QUATERNION = 0x2010
EULER_ANGLES = 0x2030
DELTA_V = 0x4010
ACCELERATION = 0x4020
ALTITUDE_ELLIPSOID = 0x5020
LAT_LON = 0x5040
GNSS_PVT_DATA = 0x7010
GNSS_SAT_INFO = 0x7020
RATE_OF_TURN = 0x8020
DELTA_Q = 0x8030
VELOCITY_XYZ = 0xD010
STATUS_BYTE = 0xE010
STATUS_WORD = 0xE020


class Pvt(NamedTuple):
    """GnssPvtData: the solution of the unit's receiver in UTC and time of the GPS week."""

    itow_ms: int
    year: int
    month: int
    day: int
    hour: int
    minute: int
    second: int
    valid: int  # UTC_VALID, PVT_RESOLVED
    time_accuracy_ns: int
    nano_ns: int  # fraction of second, may be negative
    fix_type: int
    flags: int
    satellites: int
    reserved: int
    lon_1e7_deg: int
    lat_1e7_deg: int
    height_mm: int  # above the ellipsoid
    height_msl_mm: int
    horizontal_accuracy_mm: int
    vertical_accuracy_mm: int
    vel_n_mmps: int
    vel_e_mmps: int
    vel_d_mmps: int
    ground_speed_mmps: int
    course_1e5_deg: int
    speed_accuracy_mmps: int
    course_accuracy_1e5_deg: int
    heading_1e5_deg: int
    gdop_1e2: int
    pdop_1e2: int
    tdop_1e2: int
    vdop_1e2: int
    hdop_1e2: int
    ndop_1e2: int
    edop_1e2: int


UTC = struct.Struct(">IHBBBBBB")  # nanoseconds, year, month, day, hour, minute, second, flags
PVT = struct.Struct(">IHBBBBBBIiBBBBiiiiIIiiiiiIIi7H")
SATELLITES_HEAD = struct.Struct(">IB3x")  # time of week (ms), number of satellites
SATELLITE = struct.Struct(">BBBB")  # system, number, C/N0 (dB Hz), flags
STRUCTS = {  # items of whole numbers
    PACKET_COUNTER: struct.Struct(">H"),
    SAMPLE_TIME_FINE: struct.Struct(">I"),
    STATUS_BYTE: struct.Struct(">B"),
    STATUS_WORD: struct.Struct(">I"),
    UTC_TIME: UTC,
    GNSS_PVT_DATA: PVT,
}
NUMBERS = {  # items of numbers of one format: how many
    **{TEMPERATURE: 1, DELTA_V: 3, ACCELERATION: 3, RATE_OF_TURN: 3, DELTA_Q: 4},
    **{QUATERNION: 4, EULER_ANGLES: 3, ALTITUDE_ELLIPSOID: 1, LAT_LON: 2, VELOCITY_XYZ: 3},
}
FLOAT32, FP1220, FP1632, FLOAT64 = range(4)
NUMBER_BYTES = (4, 4, 6, 8)

UTC_VALID = 0x07  # time of week, week number and UTC (MT0605P 4.12.2); date, time, fully resolved
ORIENTATION_VALID, GNSS_VALID = 0x02, 0x04  # of status byte and word
FILTER_MODE = 0x0380_0000  # of the status word: 0 without GNSS, 1 coasting, 3 with GNSS
RTK_SHIFT, RTK_MASK = 27, 3  # … 0 none, 1 float, 2 fixed
FIX_OK, DIFFERENTIAL = 1, 2  # flags of GnssPvtData
SATELLITE_USED = 0x08

Values = tuple[float, ...]
Items = dict[int, tuple[Any, ...]]


# --- numbers ----------------------------------------------------------------------------------------------------------


def decode_numbers(data: bytes, number_format: int) -> Values:
    """Decode numbers of one format: float32, fixed point 12.20 and 16.32, float64, all high byte first.

    16.32 comes as its 32 fraction bits, then its 16 whole bits.
    """
    if number_format == FLOAT32:
        return struct.unpack(f">{len(data) // 4}f", data)
    if number_format == FLOAT64:
        return struct.unpack(f">{len(data) // 8}d", data)
    if number_format == FP1220:
        return tuple(number / 2.0**20 for number in struct.unpack(f">{len(data) // 4}i", data))
    parts = struct.unpack(">" + "Ih" * (len(data) // 6), data)
    return tuple(whole + fraction / 2.0**32 for fraction, whole in zip(parts[::2], parts[1::2], strict=True))


def encode_numbers(values: Sequence[float], number_format: int) -> bytes:
    """Encode numbers as the inverse of `decode_numbers`, rounded to the format's resolution.

    Raises:
        struct.error: a value does not fit.
    """
    if number_format == FLOAT32:
        return struct.pack(f">{len(values)}f", *values)
    if number_format == FLOAT64:
        return struct.pack(f">{len(values)}d", *values)
    if number_format == FP1220:
        return struct.pack(f">{len(values)}i", *(round(value * 2**20) for value in values))
    scaled = [round(value * 2**32) for value in values]
    return b"".join(struct.pack(">Ih", number & 0xFFFF_FFFF, number >> 32) for number in scaled)


# --- writing ----------------------------------------------------------------------------------------------------------


def encode_message(identifier: int, data: bytes) -> bytes:
    """Encode one Xbus message, with an extended length where it needs one.

    Raises:
        ValueError: the data exceed the length of a message.
    """
    if len(data) + 7 > XBUS.max_bytes:
        raise ValueError(f"an Xbus message cannot hold {len(data)} bytes")
    length = bytes([len(data)]) if len(data) < XBUS_EXTENDED else bytes([XBUS_EXTENDED]) + struct.pack(">H", len(data))
    body = PREAMBLE[1:] + bytes([identifier]) + length + data
    return PREAMBLE[:1] + body + bytes([-sum(body) & 0xFF])


def encode_item(kind: int, values: Sequence[float | int], number_format: int = FLOAT32) -> bytes:
    """Encode one item of MTData2 by its fields; ``kind`` may have the bits of a local frame."""
    layout = STRUCTS.get(kind)
    if layout is not None:
        return ITEM_HEADER.pack(kind, layout.size) + layout.pack(*values)
    data = encode_numbers(values, number_format)
    return ITEM_HEADER.pack(kind | number_format, len(data)) + data


def encode_mtdata2(*items: bytes) -> bytes:
    """Encode an MTData2 message of items."""
    return encode_message(XBUS_MTDATA2, b"".join(items))


def encode_satellites(itow_ms: int, satellites: Sequence[tuple[int, int, int, int]]) -> bytes:
    """Encode an item `GNSS_SAT_INFO` of satellites: system, number, C/N0 and flags of each."""
    data = SATELLITES_HEAD.pack(itow_ms, len(satellites)) + b"".join(SATELLITE.pack(*one) for one in satellites)
    return ITEM_HEADER.pack(GNSS_SAT_INFO, len(data)) + data


# --- reading ----------------------------------------------------------------------------------------------------------


def split_items(data: bytes) -> dict[int, tuple[int, bytes]] | None:
    """Return the format bits and content of each item by identifier without them; None where the items do not fill the
    message.
    """
    items: dict[int, tuple[int, bytes]] = {}
    position = 0
    while position + ITEM_HEADER.size <= len(data):
        identifier, length = ITEM_HEADER.unpack_from(data, position)
        start = position + ITEM_HEADER.size
        position = start + length
        items[identifier & TYPE_BITS] = (identifier & (FORMAT_BITS | AXES_BITS), data[start:position])
    return items if position == len(data) else None


def read_items(found: dict[int, tuple[int, bytes]]) -> Items | None:
    """Return values of the known items of a message; None where a length is wrong."""
    values: Items = {}
    for kind, (form, contents) in found.items():
        layout, count = STRUCTS.get(kind), NUMBERS.get(kind)
        if layout is not None:
            if len(contents) != layout.size:
                return None
            values[kind] = layout.unpack(contents)
        elif count is not None:
            if len(contents) != count * NUMBER_BYTES[form & FORMAT_BITS]:
                return None
            values[kind] = decode_numbers(contents, form & FORMAT_BITS)
        elif kind == GNSS_SAT_INFO:
            satellites = read_satellites(contents)
            if satellites is None:
                return None
            values[kind] = satellites
    return values


def read_satellites(data: bytes) -> tuple[Any, ...] | None:
    """Return time of week (ms), then each satellite's fields; None where the item is shorter than its satellites."""
    if len(data) < SATELLITES_HEAD.size:
        return None
    itow_ms, number = SATELLITES_HEAD.unpack_from(data)
    end = SATELLITES_HEAD.size + number * SATELLITE.size
    if len(data) < end:
        return None
    return (itow_ms, *SATELLITE.iter_unpack(data[SATELLITES_HEAD.size : end]))
