"""MicroStrain's MIP packet: "ue", descriptor set, length, fields, Fletcher checksum; numbers with the high byte first.

Sources: MicroStrain's MIP SDK (github.com/LORD-MicroStrain/mip_sdk, e5a847d8: ``mip_packet.c``, ``data_sensor.hpp``,
``data_gnss.hpp``, ``data_filter.hpp``, ``data_shared.hpp``, ``data_system.hpp``). Each field begins with its length
and its descriptor, so that an unknown one is skipped.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import Any

from swath.drivers.framing.checksums import ubx_fletcher
from swath.drivers.framing.framer import UNDECIDED, FrameKind

SYNC = b"ue"
HEADER_BYTES = 4
CHECKSUM_BYTES = 2
MAX_BYTES = HEADER_BYTES + 255 + CHECKSUM_BYTES

SENSOR, GNSS, FILTER, SYSTEM = 0x80, 0x81, 0x82, 0xA0
RECEIVERS = {GNSS: "gnss", **{0x90 + number: f"gnss{number}" for number in range(1, 6)}}
SET_NAMES = {
    0x01: "base",
    0x0C: "3dm",
    0x0D: "filter command",
    0x0E: "gnss command",
    0x13: "aiding",
    0x7F: "system command",
}
SET_NAMES |= {SENSOR: "sensor", FILTER: "filter", SYSTEM: "system", **RECEIVERS}

# descriptor: name, format. These are common to all sets of data …
SHARED: dict[int, tuple[str, str]] = {
    0xD0: ("event_source", "B"),
    0xD3: ("gps_time", "dHH"),  # time of week, week, flags
    0xD5: ("reference_ns", "Q"),
    0xD6: ("reference_step_ns", "Q"),
}
_RECEIVER: dict[int, tuple[str, str]] = {
    0x03: (
        "position",
        "4d2fH",
    ),  # latitude, longitude, heights (ellipsoid, sea level), accuracies (horizontal, vertical)
    0x05: ("velocity", "8fH"),  # north, east, down, speed, ground speed, heading, accuracies (speed, heading)
    0x09: ("epoch", "dHH"),
    0x0B: ("fix", "BBHH"),  # type, satellites, flags, validity
    0x11: ("leap_seconds", "BH"),
}
# … and these belong to one
FIELDS: dict[int, dict[int, tuple[str, str]]] = {
    SENSOR: {
        0x04: ("accel_g", "3f"),
        0x05: ("gyro", "3f"),
        0x07: ("delta_theta", "3f"),
        0x08: ("delta_velocity_gs", "3f"),
        0x12: ("sensor_time", "dHH"),
        0x14: ("temperature", "3f"),  # lowest, highest, mean
        0x18: ("overrange", "H"),
    },
    FILTER: {
        0x01: ("position", "3dH"),
        0x02: ("velocity", "3fH"),
        0x05: ("euler", "3fH"),
        0x08: ("position_sigma", "3fH"),
        0x09: ("velocity_sigma", "3fH"),
        0x0A: ("euler_sigma", "3fH"),
        0x10: ("status", "3H"),  # state, dynamics mode, flags
        0x11: ("filter_time", "dHH"),
    },
    SYSTEM: {0x02: ("time_sync", "2B")},  # synchronised, seconds since the last pulse
    **dict.fromkeys(RECEIVERS, _RECEIVER),
}


def measure(buffer: bytes, start: int, final: bool) -> int:
    """Measure header, fields and checksum."""
    if len(buffer) - start < HEADER_BYTES:
        return UNDECIDED
    return HEADER_BYTES + buffer[start + 3] + CHECKSUM_BYTES


def message_name(frame: bytes) -> str:
    """Return the name of the descriptor set, or ``MIP-`` and its number."""
    return SET_NAMES.get(frame[2]) or f"MIP-{frame[2]:02X}"


MIP = FrameKind(
    "mip",
    (SYNC[:1], SYNC[1:]),
    MAX_BYTES,
    measure,
    lambda frame: (frame[-2], frame[-1]) == ubx_fletcher(frame[:-2]),
    message_name,
)


def split_fields(frame: bytes) -> list[tuple[int, bytes]] | None:
    """Return descriptor and content of each field; None where their lengths do not fill the packet."""
    fields, at, end = [], HEADER_BYTES, len(frame) - CHECKSUM_BYTES
    while at < end:
        length = frame[at]
        if length < 2 or at + length > end:
            return None
        fields.append((frame[at + 1], frame[at + 2 : at + length]))
        at += length
    return fields


def read_values(frame: bytes) -> dict[str, tuple[Any, ...]] | None:
    """Return the values of a packet's known fields by name; None where a length is wrong.

    A field may be longer than known, as the maker may append to it.
    """
    fields = split_fields(frame)
    if fields is None:
        return None
    known = FIELDS.get(frame[2], {})
    values: dict[str, tuple[Any, ...]] = {}
    for descriptor, content in fields:
        name, layout = known.get(descriptor) or SHARED.get(descriptor) or ("", "")
        if not name or frame[2] not in FIELDS:
            continue
        size = struct.calcsize(f">{layout}")
        if len(content) < size:
            return None
        values[name] = struct.unpack_from(f">{layout}", content)
    return values


def encode_packet(descriptor_set: int, *fields: tuple[int, bytes]) -> bytes:
    """Encode a packet of fields by descriptor.

    Raises:
        ValueError: the fields exceed a packet.
    """
    payload = b"".join(bytes([len(content) + 2, descriptor]) + content for descriptor, content in fields)
    body = SYNC + bytes([descriptor_set, len(payload)]) + payload
    return body + bytes(ubx_fletcher(body))


def encode_data(descriptor_set: int, values: Mapping[str, tuple[Any, ...]]) -> bytes:
    """Encode a packet of data by the names of its fields, in the order given."""
    numbers = {name: (number, layout) for number, (name, layout) in {**SHARED, **FIELDS[descriptor_set]}.items()}
    fields = [(numbers[name][0], struct.pack(f">{numbers[name][1]}", *content)) for name, content in values.items()]
    return encode_packet(descriptor_set, *fields)
