"""The Example receiver: frames of position, velocity and time in a stream of bytes.

Layout: Example Receiver, Interface Manual, section 2: ``EX``, length of the content, content, CRC-16 of length and
content (CCITT from 0, high byte first). Numbers of the content are little-endian.
"""

from __future__ import annotations

import binascii
import math
import struct
from collections.abc import Iterable
from typing import Literal

from pydantic import Field

from swath.drivers.interface import (
    FALSE_SYNC,
    INTERFACE,
    STREAM_TRANSPORTS,
    UNDECIDED,
    DeviceSettings,
    Driver,
    FixType,
    Frame,
    FramedParser,
    FrameKind,
    GnssFix,
    NamesEdge,
    Options,
    Record,
    TimeMessage,
    TimeScale,
    TimeTag,
    read_options,
)

FIX = struct.Struct("<HI3i3iBBB")  # week, ms of week; 1e-7°, 1e-7°, mm; mm/s north, east, down; type, satellites, flags
HEAD_BYTES, CRC_BYTES = 3, 2
TIME_VALID = 1  # of the flags
FIX_TYPES = {1: FixType.SINGLE, 2: FixType.DIFFERENTIAL, 3: FixType.RTK_FLOAT, 4: FixType.RTK_FIXED}


def measure(buffer: bytes, start: int, final: bool) -> int:
    """Return the length of the frame at ``start``, as far as the bytes tell."""
    if len(buffer) < start + HEAD_BYTES:
        return UNDECIDED
    return HEAD_BYTES + FIX.size + CRC_BYTES if buffer[start + 2] == FIX.size else FALSE_SYNC


def intact(frame: bytes) -> bool:
    """Return whether the CRC is right: with its own CRC behind it a message has the CRC 0."""
    return binascii.crc_hqx(frame[2:], 0) == 0


FRAME = FrameKind(
    name="example",
    sync=(b"E", b"X"),
    max_bytes=HEAD_BYTES + FIX.size + CRC_BYTES,
    measure=measure,
    intact=intact,
    message_name=lambda frame: "FIX",
)


class ReceiverOptions(Options):
    """The keys of ``[gnss.<name>.options]``."""

    heights: Literal["ellipsoid", "geoid"] = Field(
        "ellipsoid", description="what its heights count from, as set in the receiver; of the geoid they are not used"
    )


class ReceiverParser(FramedParser):
    """Decodes fixes; the frame that carries one names the second of the edge before it."""

    def __init__(self, settings: DeviceSettings, wanted: tuple[type, ...] | None = None) -> None:
        super().__init__((FRAME,), wanted)
        self._has_height = read_options(settings, ReceiverOptions).heights == "ellipsoid"

    def decode_frames(self, frames: list[Frame]) -> Iterable[Record]:
        """Decode consecutive frames; return a time message and a fix of each."""
        for frame in frames:
            week, ms, lat, lon, height, *velocity, kind, satellites, flags = FIX.unpack_from(frame.data, HEAD_BYTES)
            time = TimeTag(TimeScale.GPS, ms * 1_000_000, week=week)
            valid = bool(flags & TIME_VALID)
            yield TimeMessage(frame.host_time_ns, time, NamesEdge.PREVIOUS, valid=valid, message="FIX")
            if kind in FIX_TYPES:
                yield GnssFix(
                    frame.host_time_ns,
                    time,
                    lat_rad=math.radians(lat * 1e-7),
                    lon_rad=math.radians(lon * 1e-7),
                    height_m=height * 1e-3 if self._has_height else None,
                    velocity_l=(velocity[0] * 1e-3, velocity[1] * 1e-3, velocity[2] * 1e-3),
                    fix_type=FIX_TYPES[kind],
                    satellites=satellites,
                    valid=valid,
                    message="FIX",
                )


def encode(week: int, ms: int, lat_deg: float, lon_deg: float, height_m: float, kind: int = 4) -> bytes:
    """Encode the frame of a receiver that does not move and knows the time, for tests."""
    place = round(lat_deg * 1e7), round(lon_deg * 1e7), round(height_m * 1e3)
    body = bytes([FIX.size]) + FIX.pack(week, ms, *place, 0, 0, 0, kind, 17, TIME_VALID)
    return b"EX" + body + binascii.crc_hqx(body, 0).to_bytes(CRC_BYTES, "big")


DRIVER = Driver(
    protocol="example-receiver",
    kind="gnss",
    transports=STREAM_TRANSPORTS,
    yields=(TimeMessage, GnssFix),
    summary="Example receiver: position, velocity and time",
    make_parser=ReceiverParser,
    make_time_parser=lambda settings: ReceiverParser(settings, wanted=(TimeMessage,)),
    names_edge=NamesEdge.PREVIOUS,
    options=ReceiverOptions,
    interface=INTERFACE,
)
