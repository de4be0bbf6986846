"""Encode a LAS 1.4 header and the records around the points (LAS 1.4-R15; LASzip 3; COPC 1.0), without computation."""

from __future__ import annotations

import datetime as dt
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import BinaryIO, NamedTuple

import numpy as np

from swath.georef.arrays import FloatArray, Int64Array

HEADER_BYTES = 375
POINT_FORMAT = 6
COMPRESSED_BIT = 0x80
RETURNS = 15
GPS_TIME_IS_ADJUSTED = 1 << 0
CRS_IS_WKT = 1 << 4

_HEADER = struct.Struct("<4sHH16sBB32s32sHHHIIBHI5I3d3d6dQQIQ15Q")
_VLR = struct.Struct("<H16sHH32s")
_EVLR = struct.Struct("<H16sHQ32s")
_EVLR_PLACE, _EVLR_AT = struct.Struct("<QI"), 235  # where extended records begin, and their number
_EXTRA_BYTES = struct.Struct("<2xBB32s4x24x24x24xd16x24x32s")
_UINT8, _UINT16, _FLOAT, _SCALED = 1, 3, 9, 1 << 3
_COPC_INFO = struct.Struct("<5dQQ2d88x")

# Bytes of a point as a file holds them; the fields of format 6 come first.
_POINT_FIELDS = [
    ("x", "<i4"),
    ("y", "<i4"),
    ("z", "<i4"),
    ("intensity", "<u2"),
    ("returns", "u1"),  # return number, number of returns: four bits each
    ("flags", "u1"),  # classification flags (withheld is bit 2), scanner channel in bits 4 and 5
    ("classification", "u1"),
    ("user_data", "u1"),
    ("scan_angle", "<i2"),
    ("point_source_id", "<u2"),
    ("gps_time", "<f8"),
]
SIGMA_SCALE_M = 1e-4
INCIDENCE_SCALE_DEG = 0.01


class ExtraByte(NamedTuple):
    """A field that follows a point: its name, type in NumPy and in LAS, scale (0: none), and description."""

    name: str
    dtype: str
    type: int
    scale: float
    description: str


SIGMA_FIELDS = tuple(
    ExtraByte(name, "<u2", _UINT16, SIGMA_SCALE_M, "one sigma, m; 6.5535: or more")
    for name in ("sigma_easting", "sigma_northing", "sigma_height")
)
INCIDENCE_FIELDS = (
    ExtraByte("incidence_angle", "<u2", _UINT16, INCIDENCE_SCALE_DEG, "beam to the normal, degrees"),
    ExtraByte("surface", "u1", _UINT8, 0.0, "1: level, 2: plane, 3: rough"),
)
RANGE_SIGMA_FIELDS = (ExtraByte("sigma_range", "<u2", _UINT16, SIGMA_SCALE_M, "one sigma, m; 6.5535: or more"),)
COVARIANCE_FIELDS = tuple(
    ExtraByte(f"covariance_{axes}", "<f4", _FLOAT, 0.0, "m2; e, n, h: the axes")
    for axes in ("ee", "en", "eh", "nn", "nh", "hh")
)


@dataclass(slots=True)
class LasHeader:
    """The contents of a header.

    Attributes:
        scale, offset: (3,) coordinates = integer · scale + offset.
        extra: fields that follow each point.
        wkt: coordinate system.
        creation_date: of the file; here the date of the flight, so that the same input gives the same bytes.
        system_identifier, software: at most 32 bytes are kept.
        file_source_id: number of the strip where the file is one strip.
        provenance: inputs and settings behind the points, JSON, written as a record of this project; empty: no record.
        count, count_by_return, minimum, maximum: set when all points are written; the coordinates' integers.
    """

    scale: FloatArray
    offset: FloatArray
    extra: tuple[ExtraByte, ...]
    wkt: str
    creation_date: dt.date
    system_identifier: str = ""
    software: str = ""
    file_source_id: int = 0
    provenance: str = ""
    count: int = 0
    count_by_return: Int64Array = field(default_factory=lambda: np.zeros(RETURNS + 1, np.int64))
    minimum: FloatArray = field(default_factory=lambda: np.full(3, np.inf))
    maximum: FloatArray = field(default_factory=lambda: np.full(3, -np.inf))
    evlr_start: int = 0
    evlr_count: int = 0

    @property
    def dtype(self) -> np.dtype[np.void]:
        """The record type of a point."""
        return point_dtype(self.extra)

    @property
    def bounds(self) -> FloatArray:
        """Least and largest coordinates (2, 3); zeros without points."""
        if not self.count:
            return np.zeros((2, 3))
        bounds: FloatArray = np.stack([self.minimum, self.maximum]) * self.scale + self.offset
        return bounds

    def encode(self, laszip: bytes, first_vlrs: bytes = b"", first_count: int = 0) -> bytes:
        """Return the header and the records before the points.

        Args:
            laszip: data of the LASzip record.
            first_vlrs, first_count: records that must come first, and their number.
        """
        vlrs = first_vlrs + encode_vlr("LASF_Projection", 2112, _terminated(self.wkt), "OGC WKT coordinate system")
        count = first_count + 2
        if self.extra:
            vlrs += encode_vlr("LASF_Spec", 4, b"".join(map(_extra_record, self.extra)), "extra bytes")
            count += 1
        if self.provenance:
            vlrs += encode_vlr("swath", 1, self.provenance.encode(), "provenance, JSON")
            count += 1
        vlrs += encode_vlr("laszip encoded", 22204, laszip, "LASzip")
        day = self.creation_date.timetuple().tm_yday
        (min_x, min_y, min_z), (max_x, max_y, max_z) = self.bounds
        head = _HEADER.pack(
            b"LASF",
            self.file_source_id,
            GPS_TIME_IS_ADJUSTED | CRS_IS_WKT,
            bytes(16),
            1,
            4,
            self.system_identifier.encode()[:32],
            self.software.encode()[:32],
            day,
            self.creation_date.year,
            HEADER_BYTES,
            HEADER_BYTES + len(vlrs),
            count,
            POINT_FORMAT | COMPRESSED_BIT,
            self.dtype.itemsize,
            *([0] * 6),  # the counts of LAS 1.3, which does not have format 6
            *self.scale,
            *self.offset,
            *(max_x, min_x, max_y, min_y, max_z, min_z),
            0,
            self.evlr_start,
            self.evlr_count,
            self.count,
            *self.count_by_return[1:].tolist(),
        )
        return head + vlrs


def point_dtype(extra: Sequence[ExtraByte]) -> np.dtype[np.void]:
    """Return the record type of a point with fields that follow it."""
    return np.dtype(_POINT_FIELDS + [(field.name, field.dtype) for field in extra])


def encode_vlr(user_id: str, record_id: int, data: bytes, description: str) -> bytes:
    """Return a variable length record.

    Raises:
        ValueError: the data is too long for such a record.
    """
    if len(data) > 0xFFFF:
        raise ValueError(f"record {user_id} {record_id} of {len(data)} bytes, more than 65535")
    return _VLR.pack(0, user_id.encode(), record_id, len(data), description.encode()) + data


def encode_evlr(user_id: str, record_id: int, data: bytes, description: str) -> bytes:
    """Return an extended variable length record, which follows the points."""
    return _EVLR.pack(0, user_id.encode(), record_id, len(data), description.encode()) + data


def append_evlr(stream: BinaryIO, record: bytes) -> None:
    """Append an extended record, as of `encode_evlr`, to a finished file, behind those that it has.

    Raises:
        ValueError: the file's last extended record does not end it; another program would lose what comes behind.
    """
    stream.seek(_EVLR_AT)
    start, count = _EVLR_PLACE.unpack(stream.read(_EVLR_PLACE.size))
    end = stream.seek(0, 2)
    at = start
    for _ in range(count):
        stream.seek(at)
        at += _EVLR.size + _EVLR.unpack(stream.read(_EVLR.size))[3]
    if count and at != end:
        raise ValueError(f"the file's {count} extended records end at byte {at}, the file at {end}")
    stream.seek(0, 2)
    stream.write(record)
    stream.seek(_EVLR_AT)
    stream.write(_EVLR_PLACE.pack(start if count else end, count + 1))
    stream.seek(0, 2)


def encode_copc_info(
    centre: FloatArray,
    half_size: float,
    spacing: float,
    hierarchy: tuple[int, int],
    gps_time: tuple[float, float],
) -> bytes:
    """Return COPC's first record: the root's cube, its point spacing, offset and size of the root page, time span."""
    return _COPC_INFO.pack(*centre, half_size, spacing, *hierarchy, *gps_time)


def _terminated(text: str) -> bytes:
    return text.encode() + b"\0"


def _extra_record(field: ExtraByte) -> bytes:
    options = _SCALED if field.scale else 0
    return _EXTRA_BYTES.pack(field.type, options, field.name.encode(), field.scale, field.description.encode())
