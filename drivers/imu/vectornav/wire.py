"""VectorNav's binary output message: sync FA, group bytes, field words, fields, CRC-16.

Sources: VectorNav's VN-300 user manual UM005 (5.2, binary output messages: header, groups, fields, CRC); the sizes of
all fields, also of those that the manual does not name, and the limits of a header from VectorNav's own SDK 0.99
(``BinaryMeasurementDefinitions.hpp``, ``FaPacketProtocol.cpp``). Where a message has a field that is not in the table,
its length is unknown: it is no frame.

The group bytes name groups 0 to 6, 8 to 14 and 16 to 22; bit 7 announces another byte. One or more words name the
fields of each group; bit 15 announces another word, whose bits are fields 16 to 30. Fields follow in rising order,
lowest byte first.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from functools import lru_cache
from typing import Any, NamedTuple

from swath.drivers.framing.checksums import crc16_ccitt
from swath.drivers.framing.framer import FALSE_SYNC, OVER_BOUND, UNDECIDED, FrameKind

SYNC = b"\xfa"
MAX_GROUP_BYTES = 3
MAX_FIELD_WORDS = 10
MAX_FIELD_BYTES = 4608  # all satellites of two receivers have 3668 bytes; the SDK's limit of 2000 is too low for them
CRC_BYTES = 2
MAX_BYTES = len(SYNC) + MAX_GROUP_BYTES + 2 * MAX_FIELD_WORDS + MAX_FIELD_BYTES + CRC_BYTES
GROUP_EXTENSION = 0x80
FIELD_EXTENSION = 0x8000
CACHED_HEADERS = 16  # a device has three binary outputs

COMMON, TIME, IMU, GNSS1, ATTITUDE, INS, GNSS2 = range(7)
GNSS3 = 12
RECEIVERS = {GNSS1: "gnss1", GNSS2: "gnss2", GNSS3: "gnss3"}
SAT_INFO, RAW_MEAS = 14, 16  # fields of a receiver's group that contain a count and so many items

_GNSS = (
    "utc:b5BH tow:Q week:H satellites:B fix:B pos_lla:3d pos_ecef:3d vel_ned:3f vel_ecef:3f pos_sigma:3f vel_sigma:f "
    "time_sigma:f time_info:Bb dop:7f ? ! ? status:H alt_msl:d"
)
# Group -> its fields in order, as name:format; several values of one field are joined by "+". "-" has no name, "?" has
# a variable size, "!" does not exist.
_TABLE = {
    COMMON: "time_startup:Q time_gps:Q time_sync_in:Q yaw_pitch_roll:3f quaternion:4f angular_rate:3f pos_lla:3d "
    "vel_ned:3f accel:3f uncomp_accel:3f+uncomp_gyro:3f mag:3f+temperature:f+pressure:f delta_theta:4f+delta_vel:3f "
    "ins_status:H sync_in_count:I time_gps_pps:Q",
    TIME: "time_startup:Q time_gps:Q gps_tow:Q gps_week:H time_sync_in:Q time_gps_pps:Q utc:b5BH sync_in_count:I "
    "sync_out_count:I time_status:B",
    IMU: "imu_status:H uncomp_mag:3f uncomp_accel:3f uncomp_gyro:3f temperature:f pressure:f delta_theta:4f "
    "delta_vel:3f mag:3f accel:3f angular_rate:3f saturation:H -:40x",
    GNSS1: _GNSS,
    ATTITUDE: "vpe_status:H yaw_pitch_roll:3f quaternion:4f dcm:9f mag_ned:3f accel_ned:3f linear_accel_body:3f "
    "linear_accel_ned:3f ypr_sigma:3f -:12x -:28x -:24x heave:3f attitude_sigma:f",
    INS: "ins_status:H pos_lla:3d pos_ecef:3d vel_body:3f vel_ned:3f vel_ecef:3f mag_ecef:3f accel_ecef:3f "
    "linear_accel_ecef:3f pos_sigma:f vel_sigma:f -:68x -:64x",
    GNSS2: _GNSS,
    GNSS3: _GNSS,
    16: "-:48x -:48x -:48x -:92x -:80x -:76x -:68x -:20x -:40x -:60x -:320x -:192x",
    17: "-:8x -:2x -:2x -:12x -:36x -:12x -:36x -:4x -:4x -:4x -:4x -:40x -:144x -:12x -:36x",
}


class Counted(NamedTuple):
    """A field of variable size: a head with the number of items at ``count_at``, then the items."""

    head_bytes: int
    count_at: int
    item_bytes: int
    most: int


COUNTED = {SAT_INFO: Counted(2, 0, 8, 35), RAW_MEAS: Counted(12, 10, 28, 55)}
Values = tuple[tuple[str, str], ...]  # name and struct format of each value in a field


def _read_table() -> dict[tuple[int, int], Values]:
    """Return the values of each field of constant size by group and field number."""
    fields: dict[tuple[int, int], Values] = {}
    for group, text in _TABLE.items():
        prefix = f"{RECEIVERS[group]}." if group in RECEIVERS else ""
        for number, field in enumerate(text.split()):
            if field not in ("?", "!"):
                parts = (part.split(":") for part in field.split("+"))
                fields[group, number] = tuple((name if name == "-" else prefix + name, one) for name, one in parts)
    return fields


FIELDS = _read_table()


class Stretch(NamedTuple):
    """Neighbouring fields of constant size, read at once: where each value lies in the result, by name; then, if any,
    a field of variable size.
    """

    layout: struct.Struct
    slices: tuple[tuple[str, slice], ...]
    counted: Counted | None


def read_header(buffer: bytes, start: int) -> int:
    """Return where the fields of a message begin; `UNDECIDED` or `FALSE_SYNC` otherwise."""
    at, groups = start + 1, 0
    for _ in range(MAX_GROUP_BYTES):
        if at >= len(buffer):
            return UNDECIDED
        groups += (buffer[at] & ~GROUP_EXTENSION).bit_count()
        at += 1
        if not buffer[at - 1] & GROUP_EXTENSION:
            break
    else:
        return FALSE_SYNC
    for _ in range(MAX_FIELD_WORDS):
        if not groups:
            return at
        if at + 2 > len(buffer):
            return UNDECIDED
        groups -= not buffer[at + 1] & 0x80
        at += 2
    return at if not groups else FALSE_SYNC


def group_and_field_numbers(header: bytes) -> list[tuple[int, int]]:
    """Return group and field number of each field that a header (group bytes and field words) names, in order."""
    first_word = next(index for index, byte in enumerate(header) if not byte & GROUP_EXTENSION) + 1
    words = iter(struct.unpack(f"<{(len(header) - first_word) // 2}H", header[first_word:]))
    found = []
    for index, byte in enumerate(header[:first_word]):
        for bit in range(7):
            first, word = 0, FIELD_EXTENSION if byte >> bit & 1 else 0
            while word & FIELD_EXTENSION:
                word = next(words)
                found += [(8 * index + bit, first + number) for number in range(15) if word >> number & 1]
                first += 16
    return found


@lru_cache(maxsize=CACHED_HEADERS)
def plan(header: bytes) -> tuple[Stretch, ...] | None:
    """Return how to read the fields that a header names; None where one is unknown or there are none."""
    stretches: list[Stretch] = []
    formats: list[str] = []
    slices: list[tuple[str, slice]] = []
    values = 0

    def close(counted: Counted | None) -> None:
        nonlocal formats, slices, values
        stretches.append(Stretch(struct.Struct("<" + "".join(formats)), tuple(slices), counted))
        formats, slices, values = [], [], 0

    for group, number in group_and_field_numbers(header):
        if group in RECEIVERS and number in COUNTED:
            close(COUNTED[number])
            continue
        if (group, number) not in FIELDS:
            return None
        for name, one in FIELDS[group, number]:
            count = 0 if name == "-" else len(struct.unpack(f"<{one}", bytes(struct.calcsize(f"<{one}"))))
            if count:
                slices.append((name, slice(values, values + count)))
            values += count
            formats.append(one)
    close(None)
    return tuple(stretches) if any(one.layout.size or one.counted for one in stretches) else None


def measure(buffer: bytes, start: int, final: bool) -> int:
    """Measure header, fields and CRC; a count of satellites determines the length of its field."""
    at = read_header(buffer, start)
    if at <= 0:
        return at
    stretches = plan(buffer[start + 1 : at])
    if stretches is None:
        return FALSE_SYNC
    first = at
    for stretch in stretches:
        at += stretch.layout.size
        if stretch.counted is not None:
            if at + stretch.counted.head_bytes > len(buffer):
                return UNDECIDED if at - first <= MAX_FIELD_BYTES else OVER_BOUND
            count = buffer[at + stretch.counted.count_at]
            if count > stretch.counted.most:
                return FALSE_SYNC
            at += stretch.counted.head_bytes + count * stretch.counted.item_bytes
    return at + CRC_BYTES - start if at - first <= MAX_FIELD_BYTES else OVER_BOUND


def message_name(frame: bytes) -> str:
    """Return the numbers of the groups in a message, such as ``groups 1+2``."""
    numbers = sorted({group for group, _ in group_and_field_numbers(frame[1 : read_header(frame, 0)])})
    return "groups " + "+".join(map(str, numbers))


VECTORNAV = FrameKind(
    "vectornav",
    (SYNC, bytes(range(1, 256))),
    MAX_BYTES,
    measure,
    lambda frame: crc16_ccitt(memoryview(frame)[1:]) == 0,
    message_name,
)


def read_values(frame: bytes) -> dict[str, tuple[Any, ...]]:
    """Return the values of a whole message by name; where two groups carry the same value, the last one.

    Values of a receiver's group have its name in front (``gnss1.pos_lla``). Fields of variable size are not read.
    """
    at = read_header(frame, 0)
    values: dict[str, tuple[Any, ...]] = {}
    for stretch in plan(frame[1:at]) or ():
        numbers = stretch.layout.unpack_from(frame, at)
        values.update((name, numbers[where]) for name, where in stretch.slices)
        at += stretch.layout.size
        if stretch.counted is not None:
            at += stretch.counted.head_bytes + frame[at + stretch.counted.count_at] * stretch.counted.item_bytes
    return values


def encode_field(group: int, number: int, *values: float | int) -> bytes:
    """Encode a field of constant size.

    Raises:
        KeyError: the table has no such field.
        struct.error: the values do not fit.
    """
    return struct.pack("<" + "".join(one for _, one in FIELDS[group, number]), *values)


def encode_frame(fields: Mapping[tuple[int, int], bytes]) -> bytes:
    """Encode a message of fields by group and field number; the fields need not be in order."""
    order = sorted(fields)
    words: dict[int, list[int]] = {}
    group_bytes = [0] * (max(group for group, _ in order) // 8 + 1)
    for group, number in order:
        group_bytes[group // 8] |= 1 << group % 8
        of_group = words.setdefault(group, [0])
        while len(of_group) <= number // 16:
            of_group[-1] |= FIELD_EXTENSION
            of_group.append(0)
        of_group[number // 16] |= 1 << number % 16
    for index in range(len(group_bytes) - 1):
        group_bytes[index] |= GROUP_EXTENSION
    named = [word for group in sorted(words) for word in words[group]]
    body = bytes(group_bytes) + struct.pack(f"<{len(named)}H", *named) + b"".join(fields[key] for key in order)
    return SYNC + body + crc16_ccitt(body).to_bytes(CRC_BYTES, "big")
