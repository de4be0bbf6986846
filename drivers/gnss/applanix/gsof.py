"""Trimble GSOF records as tables, the pages of a report, and encoders (Trimble OEM receiver help, GSOF messages).

A report is a number of records of type, length and data; it comes in pages of at most 244 bytes, and a record may lie
across two of them. All numbers are big-endian, angles in radians except those of the INS records.
"""

from __future__ import annotations

import struct
from typing import Generic, NamedTuple, TypeVar

from swath.drivers.parser import ParserCounters

RecordT = TypeVar("RecordT", bound=tuple[float, ...])

GENOUT_DATA_START = 4
PAGE_HEADER = struct.Struct(">BBB")  # transmission number, page, last page
PAGE_DATA_BYTES = 244


class Layout(Generic[RecordT]):
    """Encodes and decodes one record; newer firmware may append bytes."""

    def __init__(self, number: int, record: type[RecordT], fields: str) -> None:
        self.number = number
        self._record = record
        self._wire = struct.Struct(">" + fields)

    def decode(self, data: bytes) -> RecordT | None:
        """Decode a record's data; return None where they are too short."""
        return None if len(data) < self._wire.size else self._record(*self._wire.unpack_from(data))

    def encode(self, record: RecordT) -> bytes:
        """Encode a record with type and length."""
        return bytes([self.number, self._wire.size]) + self._wire.pack(*record)


class PositionTime(NamedTuple):
    """Record 1: time of the position and how it was computed."""

    milliseconds: int
    week: int
    satellites: int
    flags1: int
    flags2: int
    initialisation: int


CLOCK_COMPUTED, HORIZONTAL_COMPUTED, HEIGHT_COMPUTED = 2, 4, 8  # bits of flags1
DIFFERENTIAL, CARRIER, FIXED = 1, 2, 4  # bits of flags2


class LatLonHeight(NamedTuple):
    """Record 2: latitude, longitude (rad) and height above the ellipsoid of WGS 84 (m)."""

    lat_rad: float
    lon_rad: float
    height_m: float


class Velocity(NamedTuple):
    """Record 8: speed over ground (m/s), course from true north (rad) and vertical speed, up (m/s)."""

    flags: int  # bit 0: valid
    horizontal_mps: float
    course_rad: float
    up_mps: float


VELOCITY_VALID = 1


class PositionSigma(NamedTuple):
    """Record 12: sigmas (m) and the covariance of east and north (m²)."""

    rms_m: float
    east_sigma_m: float
    north_sigma_m: float
    east_north_m2: float
    up_sigma_m: float
    semi_major_m: float
    semi_minor_m: float
    orientation_deg: float
    unit_variance: float
    epochs: int


class CurrentTime(NamedTuple):
    """Record 16: GPS time, and GPS − UTC."""

    milliseconds: int
    week: int
    leap_seconds: int
    flags: int  # bit 0: time is valid, bit 1: leap seconds are valid


class PositionType(NamedTuple):
    """Record 38, its first fields: quality of the corrections."""

    error_scale: float
    solution_flags: int
    rtk_condition: int
    correction_age_s: float


class BasePosition(NamedTuple):
    """Record 41: position of the base station in use."""

    milliseconds: int
    week: int
    lat_rad: float
    lon_rad: float
    height_m: float
    quality: int


class InsNavigation(NamedTuple):
    """Record 49, INS full navigation: angles in degrees, rates about and accelerations along x, y, z of the vehicle."""

    week: int
    milliseconds: int
    alignment: int  # 0 GNSS only, 1 coarse levelling, 2 degraded, 3 aligned, 4 full navigation
    quality: int
    lat_deg: float
    lon_deg: float
    height_m: float
    north_mps: float
    east_mps: float
    down_mps: float
    speed_mps: float
    roll_deg: float
    pitch_deg: float
    heading_deg: float
    track_deg: float
    x_rate_dps: float
    y_rate_dps: float
    z_rate_dps: float
    x_acceleration_mps2: float
    y_acceleration_mps2: float
    z_acceleration_mps2: float


class InsRms(NamedTuple):
    """Record 50, INS RMS: sigmas of position (m), velocity (m/s), roll, pitch, heading (deg)."""

    week: int
    milliseconds: int
    alignment: int
    quality: int
    north_m: float
    east_m: float
    down_m: float
    north_mps: float
    east_mps: float
    down_mps: float
    roll_deg: float
    pitch_deg: float
    heading_deg: float


ALIGNED, FULL_NAVIGATION = 3, 4


class LatLonGeoid(NamedTuple):
    """Record 70: latitude, longitude (rad) and height above the geoid (m); the name of the geoid's model follows."""

    lat_rad: float
    lon_rad: float
    height_msl_m: float


POSITION_TIME = Layout(1, PositionTime, "IHBBBB")
LAT_LON_HEIGHT = Layout(2, LatLonHeight, "ddd")
VELOCITY = Layout(8, Velocity, "Bfff")
POSITION_SIGMA = Layout(12, PositionSigma, "fffffffffH")
CURRENT_TIME = Layout(16, CurrentTime, "IHhB")
POSITION_TYPE = Layout(38, PositionType, "fBBf")
BASE_POSITION = Layout(41, BasePosition, "IHdddB")
INS_NAVIGATION = Layout(49, InsNavigation, "HIBBdddffffddddffffff")
INS_RMS = Layout(50, InsRms, "HIBBfffffffff")
LAT_LON_GEOID = Layout(70, LatLonGeoid, "ddd")


class Pages:
    """Puts the pages of reports together.

    A page that is missing or comes out of order loses the report: counted as ``pages_incomplete``.
    """

    def __init__(self, counters: ParserCounters) -> None:
        self._counters = counters
        self._transmission = -1
        self._data = b""
        self._next = 0

    def add(self, frame: bytes) -> bytes | None:
        """Take a packet; return a report's records once it is complete."""
        payload = frame[GENOUT_DATA_START:-2]
        if len(payload) < PAGE_HEADER.size:
            self._counters.count_bad("bad_length")
            return None
        transmission, page, last = PAGE_HEADER.unpack_from(payload)
        if page == 0:
            self._drop()
            self._transmission, self._data = transmission, b""
        elif transmission != self._transmission or page != self._next:
            self._drop()
            self._counters.errors["pages_incomplete"] += self._next == 0
            self._next = 0
            return None
        self._data += payload[PAGE_HEADER.size :]
        self._next = page + 1
        if page < last:
            return None
        complete, self._data, self._next, self._transmission = self._data, b"", 0, -1
        return complete

    def _drop(self) -> None:
        """Count a report that was begun and is not complete."""
        if self._next:
            self._counters.errors["pages_incomplete"] += 1
        self._next, self._transmission = 0, -1


def split_records(report: bytes, counters: ParserCounters) -> list[tuple[int, bytes]]:
    """Return type and data of a report's records; one that is longer than the report is counted as ``bad_length``."""
    records, at = [], 0
    while at + 2 <= len(report):
        number, length = report[at], report[at + 1]
        if at + 2 + length > len(report):
            counters.count_bad("bad_length")
            break
        records.append((number, report[at + 2 : at + 2 + length]))
        at += 2 + length
    return records


def encode_report(records: list[bytes], transmission: int, *, page_bytes: int = PAGE_DATA_BYTES) -> bytes:
    """Encode a report of records in as many GENOUT packets as it needs."""
    data = b"".join(records)
    pages = [data[at : at + page_bytes] for at in range(0, len(data), page_bytes)] or [b""]
    frames = b""
    for number, page in enumerate(pages):
        payload = PAGE_HEADER.pack(transmission & 0xFF, number, len(pages) - 1) + page
        content = b"\0\x40" + bytes([len(payload)]) + payload
        frames += b"\x02" + content + bytes([sum(content) & 0xFF]) + b"\x03"
    return frames
