"""Converts VectorNav recordings of the program INSTINCT (.vnb) into the messages that the unit sent.

A .vnb file begins with the field masks of six groups (time, IMU, GNSS1, attitude, INS, GNSS2; u32 each). A record is
INSTINCT's own time (i32, i32, f64) and the fields as the unit sent them, but for one padding byte in the heads of the
fields of satellites, which the file leaves out (VectorNavFile.cpp of INSTINCT 701b1707).
"""

from __future__ import annotations

import gzip
import struct
from pathlib import Path

from swath.drivers.imu.vectornav import wire

GROUPS = (wire.TIME, wire.IMU, wire.GNSS1, wire.ATTITUDE, wire.INS, wire.GNSS2)
HEAD = struct.Struct("<6I")
OWN_TIME_BYTES = 16
EXTENSION = 15


def read_messages(path: Path) -> list[bytes]:
    """Return the messages of a recording, header and CRC made by the encoder."""
    data = gzip.decompress(path.read_bytes())
    masks = HEAD.unpack_from(data)
    keys = [
        (group, number)
        for group, mask in zip(GROUPS, masks, strict=True)
        for number in range(32)
        if mask >> number & 1 and number != EXTENSION
    ]
    messages, at = [], HEAD.size
    while at < len(data):
        at += OWN_TIME_BYTES
        fields = {}
        for key in keys:
            counted = wire.COUNTED.get(key[1]) if key[0] in wire.RECEIVERS else None
            if counted is None:
                size = struct.calcsize("<" + "".join(one for _, one in wire.FIELDS[key]))
                fields[key] = data[at : at + size]
            else:  # the head without its last byte
                size = counted.head_bytes - 1 + data[at + counted.count_at] * counted.item_bytes
                head = data[at : at + counted.head_bytes - 1]
                fields[key] = head + b"\0" + data[at + counted.head_bytes - 1 : at + size]
            at += size
        messages.append(wire.encode_frame(fields))
    assert at == len(data)
    return messages
