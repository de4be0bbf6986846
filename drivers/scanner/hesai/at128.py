"""Hesai AT128: three turning mirrors in front of 128 lasers, and the file that gives the directions of their beams.

Sources: HesaiLidar_SDK_2.0 (libhesai/UdpProtocol/udp_protocol_v4_3.h, libhesai/UdpParser/src/udp4_3_parser.cc) for
protocol 4.3, version 1.5 of the angle correction file and the directions; the maker's older HesaiLidar_Swift_ROS for AT
heads (src/PandarSwiftDriver/src: input.h, pandarSwiftSDK.cc) for protocol 4.1, version 1.3 of the file, and how the
flags change a packet's length; nebula's pandar_at128.hpp for the times of firings.

A block has the angle of the mirrors' shaft, in parts of 1/256 of 0.01°. The circle is divided into frames, one for each
mirror. A mirror turns the beam by twice its own turn, and each laser has an azimuth and an elevation and for both a
correction that depends on the shaft's angle.
"""

from __future__ import annotations

import hashlib
import struct
from dataclasses import dataclass, replace

import numpy as np

from swath.drivers.parser import DriverSettingsError
from swath.drivers.scanner.beams import numbers
from swath.drivers.scanner.hesai.heads import (
    BLOCK,
    CONFIDENCE,
    LAST_ROUND,
    SAFETY,
    SEQUENCE,
    SIGNATURE,
    HesaiHead,
)
from swath.georef.arrays import BoolArray, FloatArray, Int64Array

LASERS = 128
FINE = 256  # parts of 0.01°
CIRCLE = 36_000 * FINE
FILE = "geometry.file"
FAULT_START = b"\xcd\xdc"
FAULT = struct.Struct("<2s11xBB2xB81x")  # mark, operating state, state of faults, number of fault codes
REPORT_BYTES = 273
_RAD = 2 * np.pi / CIRCLE
_START = b"\xee\xff"
_HEADER = struct.Struct("<2s5B8sB")  # mark, version, numbers of lasers, mirrors and frames, frame configuration, unit
_DIGEST_BYTES = hashlib.sha256().digest_size
_MOST_FRAMES = 8
_STEPS_1_5 = 180  # corrections of each laser, 2° apart
_STEPS_1_3 = 36_000  # corrections of all lasers, 0.01° apart

# Time of each laser's firing in a block. The maker's firetime correction file has other values for the lasers 5 (4114),
# 60 (13280), 80 (10768), 105 and 106 (12424); in nebula's table each time of a block's middle occurs eight times.
_FIRES_NS = """
0 0 8240 4112 4144 8240 0 0 12424 4144 4112 8264 12376 12376 8264 12424 0 0 4112 8240 4144 0 0 4144 12424 8264 4112
12376 12376 12424 8264 848 2504 4976 6616 6616 9112 2504 848 10768 13280 13280 4976 9112 14928 14928 10768 2504 848 6616
4976 9112 6616 848 2504 13280 10768 4976 13280 14928 9112 10768 14928 13280 848 9112 13280 2504 4976 848 2504 14928
10768 10768 14928 4976 6616 6616 9112 848 13280 13280 9112 4976 2504 2504 848 10768 14928 14928 10768 6616 4976 9112
6616 4112 12424 0 4144 0 0 12424 0 8264 4112 4144 8240 8240 8264 12376 12376 12424 4112 4144 0 0 0 0 0 12424 8264 8240
4144 8264 8240 12376 12376 8264
"""

# Point cloud packet of protocol 4.1: 1064 bytes, 1068 with UDP sequence; confidence is always there, CRCs never.
AT128_4_1 = HesaiHead(
    name="AT128",
    protocol_major=4,
    protocol_minor=1,
    blocks=2,
    channels=LASERS,
    tail=(
        ("tail_reserved", "V6"),
        ("shutdown", "u1"),
        ("status", "V3"),
        ("motor_rpm", "<i2"),
        ("microsecond", "<u4"),
        ("mode", "u1"),
        ("factory", "u1"),
        ("utc", "V6"),
    ),
    flags=SEQUENCE,
    optional=SEQUENCE,
    round_ns=41_666,
    stamped_round=LAST_ROUND,
    start_ns=-9_249 - 41_666,
    offset_ns=np.array(numbers(_FIRES_NS), dtype=np.int64)[np.newaxis],
    duty=0.5,
)
# Of protocol 4.3: 1118 bytes with UDP sequence, confidence and signature. Block 2 fires at t0 − 50.915 µs, block 1
# 41.666 µs earlier, in dual return with it.
AT128 = replace(
    AT128_4_1,
    protocol_minor=3,
    tail=(
        ("tail_reserved", "V6"),
        ("shutdown", "u1"),
        ("status", "V11"),
        ("motor_0p1rpm", "<i2"),
        *AT128_4_1.tail[4:],
    ),
    flags=SEQUENCE | SIGNATURE | CONFIDENCE,
    optional=SEQUENCE | SAFETY | SIGNATURE | CONFIDENCE,
    block=(*BLOCK, ("fine", "u1")),
    channel_bytes=3,
    has_crc=True,
    older=AT128_4_1,
)


@dataclass(frozen=True)
class MirrorAngles:
    """Angles of a head, from its angle correction file.

    Attributes:
        start, end: (frames,) part of the circle of each mirror, in 0.01° / 256; it may contain the angle 0.
        azimuth_deg: (128,) azimuth of each laser, which is subtracted.
        elevation_deg: (128,).
        more_azimuth_deg: (steps, 128) or (steps, 1) corrections of the azimuth at equal steps of the shaft's circle.
        more_elevation_deg: of the elevation.
    """

    start: Int64Array
    end: Int64Array
    azimuth_deg: FloatArray
    elevation_deg: FloatArray
    more_azimuth_deg: FloatArray
    more_elevation_deg: FloatArray


class Mirrors:
    """Computes directions of beams in the frame of heads that give two angles: x at azimuth 90°, y at azimuth 0, z up.

    In this frame, x is forward (the middle of the field of view) and y left, so that α = 90° − the maker's azimuth.

    Args:
        angles: of the head.
    """

    def __init__(self, angles: MirrorAngles) -> None:
        self._start, self._end = angles.start, angles.end
        self._step = CIRCLE / len(angles.more_azimuth_deg)
        azimuth = np.radians(angles.azimuth_deg - angles.more_azimuth_deg)
        elevation = np.radians(angles.elevation_deg + angles.more_elevation_deg)
        self._widest = float(np.abs(azimuth).max())
        self._at = azimuth, elevation
        self._to_next = tuple(np.roll(table, -1, axis=0) - table for table in self._at)

    def directions(self, shaft: Int64Array) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Return the directions of all lasers at angles of the shaft.

        Args:
            shaft: (n,) in 0.01° / 256, 0 … 360°.

        Returns:
            azimuth_rad, elevation_rad: (n, 128); azimuth from x towards y, −π … π.
            inside: (n,) False where the angle is of no mirror.
        """
        since = (shaft[:, np.newaxis] - self._start) % CIRCLE
        of_frame = since <= (self._end - self._start) % CIRCLE
        frame = of_frame.argmax(axis=1)
        middle = np.pi / 2 - 2 * _RAD * since[np.arange(len(shaft)), frame]
        middle -= 2 * np.pi * np.rint(middle / (2 * np.pi))
        step = shaft / self._step
        low = step.astype(np.intp)
        part = (step - low)[:, np.newaxis]
        azimuth, elevation = (
            to_next.take(low, axis=0) * part + at.take(low, axis=0)
            for at, to_next in zip(self._at, self._to_next, strict=True)
        )
        azimuth += middle[:, np.newaxis]
        if (np.abs(middle) > np.pi - self._widest).any():
            azimuth -= 2 * np.pi * np.rint(azimuth / (2 * np.pi))
        inside: BoolArray = np.any(of_frame, axis=1)
        return azimuth, elevation, inside


def read_mirror_angles(data: bytes) -> MirrorAngles:
    """Read an angle correction file of version 1.5 or 1.3.

    Raises:
        DriverSettingsError: the file is no such file, or damaged.
    """
    at = data.find(_START)
    if at < 0 or len(data) < at + _HEADER.size:
        raise DriverSettingsError(f"{FILE}: no angle correction file of an AT128 (want EE FF at its beginning)")
    content = data[at:]
    _, major, minor, lasers, mirrors, frames, _, unit = _HEADER.unpack_from(content)
    if (major, minor) not in ((1, 5), (1, 3)):
        raise DriverSettingsError(f"{FILE}: is of version {major}.{minor}, want 1.5 or 1.3")
    if lasers != LASERS or not 1 <= frames <= mirrors <= _MOST_FRAMES or not unit:
        raise DriverSettingsError(
            f"{FILE}: has {lasers} lasers, {mirrors} mirrors, {frames} frames, unit {unit}; want those of an AT128"
        )
    if minor == 3 and unit != 1:  # sources differ about which numbers count in this unit
        raise DriverSettingsError(f"{FILE}: version 1.3 with a unit of {unit}, want 1")
    kind = _file_dtype(minor, mirrors)
    if len(content) < kind.itemsize:
        raise DriverSettingsError(f"{FILE}: has {len(content)} bytes, want {kind.itemsize}")
    checked = kind.itemsize - _DIGEST_BYTES
    if hashlib.sha256(content[:checked]).digest() != content[checked : kind.itemsize]:
        raise DriverSettingsError(f"{FILE}: its SHA-256 is wrong; read it from the head again")
    file = np.frombuffer(content, dtype=kind, count=1)[0]
    units = unit * (1 if minor == 5 else FINE)
    start, end = (file[name][:frames].astype(np.int64) * units for name in ("start", "end"))
    angles = MirrorAngles(
        start,
        end,
        *(file[name] * (units * 360.0 / CIRCLE) for name in ("azimuth", "elevation")),
        *(file[name].T * (0.01 * unit) for name in ("more_azimuth", "more_elevation")),
    )
    if (start >= CIRCLE).any() or (end >= CIRCLE).any() or (np.abs(angles.elevation_deg) > 90).any():
        raise DriverSettingsError(f"{FILE}: angles beyond a circle")
    return angles


def encode_mirror_angles(angles: MirrorAngles, *, unit: int = 1, older: bool = False) -> bytes:
    """Encode an angle correction file of version 1.5, or of the older 1.3; angles are rounded to its units."""
    kind = _file_dtype(3 if older else 5, len(angles.start))
    file = np.zeros(1, dtype=kind)
    header = (_START, 1, 3 if older else 5, LASERS, len(angles.start), len(angles.start), bytes(8), unit)
    file["header"] = np.void(_HEADER.pack(*header))
    units = unit * (FINE if older else 1)
    for name in ("start", "end"):
        file[name] = getattr(angles, name) // units
    for name in ("azimuth", "elevation"):
        file[name] = np.rint(getattr(angles, f"{name}_deg") * (CIRCLE / 360 / units))
        file[f"more_{name}"] = np.rint(getattr(angles, f"more_{name}_deg").T * (100 / unit))
    content = file.tobytes()[:-_DIGEST_BYTES]
    return content + hashlib.sha256(content).digest()


def _file_dtype(minor: int, mirrors: int) -> np.dtype[np.void]:
    """Return the layout of a file: frames in 0.01° / 256 (1.5) or 0.01° (1.3), corrections in 0.01°."""
    whole, signed = ("<u4", "<i4") if minor == 5 else ("<u2", "<i2")
    steps = (LASERS, _STEPS_1_5) if minor == 5 else (1, _STEPS_1_3)
    return np.dtype(
        [
            ("header", f"V{_HEADER.size}"),
            ("start", whole, (mirrors,)),
            ("end", whole, (mirrors,)),
            ("azimuth", signed, (LASERS,)),
            ("elevation", signed, (LASERS,)),
            ("more_azimuth", "i1", steps),
            ("more_elevation", "i1", steps),
            ("digest", f"V{_DIGEST_BYTES}"),
        ]
    )
