"""Records, the output of parsers and the input of everything else: ARCHITECTURE's table, as types.

Single events (a fix, an edge, a time message) are frozen dataclasses; pulses and inertial samples are NumPy structured
arrays in batches, wrapped so that their type names the content.
"""

from __future__ import annotations

import datetime as dt
from dataclasses import dataclass, field
from enum import IntEnum, StrEnum
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from swath.georef.arrays import FloatArray, Int64Array, StructArray

ByteRows: TypeAlias = NDArray[np.uint8]


class TimeScale(StrEnum):
    """The time scale in which a device names its second."""

    GPS = "gps"
    UTC = "utc"


class NamesEdge(StrEnum):
    """Which PPS edge a time message names: the one before its arrival, or the one after."""

    PREVIOUS = "previous"
    NEXT = "next"


class FixType(IntEnum):
    """Quality of a position solution, in the coarse classes that every receiver has."""

    NONE = 0
    SINGLE = 1
    DIFFERENTIAL = 2
    RTK_FLOAT = 3
    RTK_FIXED = 4
    PPP = 5
    DEAD_RECKONING = 6
    MANUAL = 7
    SIMULATED = 8


@dataclass(frozen=True, slots=True)
class Chunk:
    """Bytes of one unit (a serial read, a datagram, a CAN frame) as received.

    Attributes:
        source: ``kind/name`` of the configuration, for example ``gnss/rover``.
        host_time_ns: host time; the kernel's receive stamp if there is one.
        data: the unchanged bytes.
    """

    source: str
    host_time_ns: int
    data: bytes


@dataclass(frozen=True, slots=True)
class ChunkBatch:
    """Consecutive units of equal length of one channel: the hot path's `Chunk`.

    Attributes:
        source: ``kind/name``.
        host_time_ns: (n,) host time of each unit.
        units: (n, length) uint8, possibly a strided view: one row per unit.
    """

    source: str
    host_time_ns: Int64Array
    units: ByteRows


@dataclass(frozen=True, slots=True)
class PpsEdge:
    """One pulse per second: the host time of its edge and the kernel's sequence number."""

    host_time_ns: int
    sequence: int


@dataclass(frozen=True, slots=True)
class TimeTag:
    """A device's own time, as completely as the device gives it.

    Attributes:
        scale: GPS or UTC.
        time_ns: nanoseconds of the GPS week (scale gps) or of the UTC day (scale utc; 86 400 s and above in a leap
            second).
        week: full GPS week (roll-overs resolved), scale gps only; None if the message carries none.
        date: UTC date, scale utc only; None if the message carries none.
        leap_seconds: GPS − UTC, only if the receiver states that it knows it.
    """

    scale: TimeScale
    time_ns: int
    week: int | None = None
    date: dt.date | None = None
    leap_seconds: int | None = None


@dataclass(frozen=True, slots=True)
class TimeMessage:
    """A message that names the second of an edge.

    Attributes:
        host_time_ns: host time of its arrival.
        time: the second it names; a tag off the whole second does not vote.
        names_edge: the edge it belongs to.
        bound: the device itself ties the message to its edge (UBX TIM-TP, NovAtel TIME header, SBF xPPSOffset, a
            latched device), so that no delay can make it mean another second.
        valid: the receiver vouches for the time.
        quantisation_ns: the edge's own error if given (TIM-TP qErr), edge = true second + quantisation_ns.
        message: name of the message, for the log.
    """

    host_time_ns: int
    time: TimeTag
    names_edge: NamesEdge
    bound: bool = False
    valid: bool = True
    quantisation_ns: float = 0.0
    message: str = ""


@dataclass(frozen=True, slots=True)
class GnssFix:
    """A position and, if given, velocity solution of an antenna.

    Attributes:
        host_time_ns: host time of arrival.
        time: epoch of the solution; `swath.georef.timescales` completes it to GPS nanoseconds.
        lat_rad, lon_rad: geodetic, radians; None if the message has a velocity only.
        height_m: ellipsoidal height (geoid separation already added).
        velocity_l: north, east, down, m/s; None components absent from the protocol are nan.
        position_cov_l: (3, 3) m², north east down; None if not given.
        velocity_cov_l: (3, 3) m²/s²; None if not given.
        fix_type: coarse class.
        satellites: satellites used, None if not given.
        antenna: "primary", "secondary" or the receiver's name for it.
        valid: the receiver vouches for the solution.
        message: name of the message.
        undulation_m: geoid above the ellipsoid by the receiver's own model; None if not given.
    """

    host_time_ns: int
    time: TimeTag
    lat_rad: float | None
    lon_rad: float | None
    height_m: float | None
    velocity_l: tuple[float, float, float] | None = None
    position_cov_l: FloatArray | None = None
    velocity_cov_l: FloatArray | None = None
    fix_type: FixType = FixType.NONE
    satellites: int | None = None
    antenna: str = "primary"
    valid: bool = True
    message: str = ""
    undulation_m: float | None = None


@dataclass(frozen=True, slots=True)
class GnssHeading:
    """Heading (and pitch) of a two-antenna baseline or of a compass; radians, true north to east."""

    host_time_ns: int
    time: TimeTag | None
    heading_rad: float
    pitch_rad: float | None = None
    baseline_m: float | None = None
    heading_sigma_rad: float | None = None
    pitch_sigma_rad: float | None = None
    valid: bool = True
    message: str = ""


@dataclass(frozen=True, slots=True)
class EventMark:
    """An external event that the receiver stamped (camera trigger, photo pulse); `rising` None: edge not given."""

    host_time_ns: int
    time: TimeTag
    channel: str
    rising: bool | None = True
    count: int | None = None
    sigma_s: float | None = None
    valid: bool = True
    message: str = ""


IMU_DTYPE = np.dtype(
    [
        ("host_time_ns", "i8"),  # of the unit that completed the sample
        ("device_time_ns", "i8"),  # unwrapped device counter or GPS time of week; -1: the device gives none
        ("pps_time_ns", "i8"),  # device counter latched at the last PPS edge, same scale; -1: none
        ("specific_force_b", "f8", (3,)),  # m/s²
        ("angular_rate_b", "f8", (3,)),  # rad/s
        ("temperature_c", "f4"),  # nan: not given
        ("status", "u4"),
        ("gps_week", "i4"),  # if device time is GPS time of week; -1: otherwise
        ("time_sigma_s", "f4"),  # of that GPS time; 0: the device's own clock is set by GNSS
    ],
    align=True,
)

INS_DTYPE = np.dtype(
    [
        ("host_time_ns", "i8"),
        ("gps_ns", "i8"),
        ("lat_rad", "f8"),
        ("lon_rad", "f8"),
        ("height_m", "f8"),
        ("velocity_l", "f8", (3,)),  # north, east, down, m/s
        ("roll_rad", "f8"),
        ("pitch_rad", "f8"),
        ("heading_rad", "f8"),
        ("position_sigma_l", "f4", (3,)),  # nan: not given
        ("velocity_sigma_l", "f4", (3,)),
        ("attitude_sigma_rad", "f4", (3,)),
        ("status", "u4"),  # the receiver's INS status word
    ],
    align=True,
)

_RETURN: list[tuple[str, str]] = [
    ("host_time_ns", "i8"),  # of the datagram
    ("device_time_ns", "i8"),  # emission of the pulse in the device's own time
    ("range_m", "f8"),  # as measured, before any correction
    ("encoder_rad", "f8"),  # scan angle θ_encoder, or azimuth of a spinning head, 0 … 2π
    ("pulse_id", "u8"),
    ("intensity", "f4"),
    ("pulse_width_ns", "f4"),  # 0: unknown
    ("channel", "u2"),  # beam of a multi-beam head, or facet of a polygon
    ("return_number", "u1"),  # 1 … number_of_returns
    ("number_of_returns", "u1"),
    ("mta_zone", "u1"),  # 255: unknown
    ("flags", "u1"),  # RETURN_FLAG_*
]
RETURN_DTYPE = np.dtype(_RETURN, align=True)
# Of heads that give a direction by two angles: the same row, then the angle above the plane in which encoder_rad counts
# (decision 0037); encoder_rad is −π … π.
AIMED_RETURN_DTYPE = np.dtype([*_RETURN, ("elevation_rad", "f8")], align=True)
RETURN_FLAG_STRONGEST = 1  # a spinning head's strongest return
RETURN_FLAG_LAST = 2
RETURN_FLAG_PPS_LOCKED = 4
RETURN_FLAG_DOUBTED = 8  # the device's own filter takes the return for noise, or may do so

DEVICE_CLOCK_DTYPE = np.dtype(
    [
        ("host_time_ns", "i8"),  # host time of the unit that carried it
        ("device_time_ns", "i8"),  # device time nearest to the unit's sending (its last pulse or sample)
        ("pps_time_ns", "i8"),  # device time latched at the latest PPS edge; -1: no latch
        ("pps_count", "i8"),  # edges since power-on; -1: not given
        ("locked", "i1"),  # 1 locked, 0 not, -1 not given
    ],
    align=True,
)


@dataclass(frozen=True, slots=True)
class ImuSamples:
    """Inertial samples, one row per sample (`IMU_DTYPE`)."""

    rows: StructArray


@dataclass(frozen=True, slots=True)
class InsSolution:
    """Solutions that a device's own INS computed, one row per epoch (`INS_DTYPE`)."""

    rows: StructArray


@dataclass(frozen=True, slots=True)
class ScannerReturns:
    """Laser returns, one row per return (`RETURN_DTYPE`, or `AIMED_RETURN_DTYPE`: always the same of one device)."""

    rows: StructArray


@dataclass(frozen=True, slots=True)
class DeviceClockSamples:
    """A device's clock readings beside the host's, one row per unit (`DEVICE_CLOCK_DTYPE`)."""

    rows: StructArray


@dataclass(frozen=True, slots=True)
class DeviceStatus:
    """Health as the device reports it; keys carry their unit (``temperature_c``)."""

    host_time_ns: int
    values: dict[str, float | int | str | bool] = field(default_factory=dict)
    message: str = ""


Record: TypeAlias = (
    TimeMessage
    | GnssFix
    | GnssHeading
    | EventMark
    | ImuSamples
    | InsSolution
    | ScannerReturns
    | DeviceClockSamples
    | DeviceStatus
)
