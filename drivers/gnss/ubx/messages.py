"""UBX messages as tables: layout, fields in wire order, encoder (u-blox F9 HPG 1.32 and M8 interface descriptions).

Each message is a NamedTuple with the wire's fields, in wire units and order; its `Layout` packs and unpacks it.
Bytes that the manuals call reserved are pad bytes.
"""

from __future__ import annotations

import struct
from typing import Generic, NamedTuple, TypeVar

from swath.drivers.framing.checksums import ubx_fletcher

MessageT = TypeVar("MessageT", bound=tuple[float, ...])


class Layout(Generic[MessageT]):
    """Encodes and decodes one message: class and id, payload layout and the resulting NamedTuple.

    Args:
        key: class and id.
        payload: struct format of the fields.
        message: the NamedTuple class.
        length: bytes of the encoded payload; bytes behind the fields are zero.
        min_length: bytes of the shortest payload, which older receivers send.
    """

    def __init__(self, key: bytes, payload: str, message: type[MessageT], length: int, min_length: int = 0) -> None:
        self.key = key
        self._struct = struct.Struct("<" + payload)
        self._message = message
        self._length = length
        self._min_length = min_length or length

    def decode(self, frame: bytes) -> MessageT | None:
        """Decode a whole frame; return None where it is shorter than the message."""
        payload_bytes = len(frame) - 8
        if payload_bytes < self._min_length:
            return None
        return self._message(*self._struct.unpack_from(frame, 6))

    def encode(self, message: MessageT) -> bytes:
        """Encode a message as a whole frame."""
        return encode_frame(self.key, self._struct.pack(*message).ljust(self._length, b"\0"))


def encode_frame(key: bytes, payload: bytes) -> bytes:
    """Build a frame: sync, class and id (``key``), length, payload, checksum."""
    body = key + struct.pack("<H", len(payload)) + payload
    return b"\xb5b" + body + bytes(ubx_fletcher(body))


class NavPvt(NamedTuple):
    """NAV-PVT, 3.15.13: the solution of an epoch in UTC and iTOW."""

    itow_ms: int
    year: int
    month: int
    day: int
    hour: int
    minute: int
    second: int  # 60 in a leap second
    valid: int  # PVT_VALID_*
    time_accuracy_ns: int
    nano_ns: int  # fraction of second, may be negative
    fix_type: int
    flags: int
    flags2: int
    satellites: int
    lon_1e7_deg: int
    lat_1e7_deg: int
    height_mm: int  # above the ellipsoid
    height_msl_mm: int
    horizontal_accuracy_mm: int  # both axes together: hAcc² = NN + EE of NAV-COV
    vertical_accuracy_mm: int
    vel_n_mmps: int
    vel_e_mmps: int
    vel_d_mmps: int
    ground_speed_mmps: int
    course_1e5_deg: int
    speed_accuracy_mmps: int
    course_accuracy_1e5_deg: int
    pdop_1e2: int
    flags3: int  # bit 0: position invalid; reserved bytes in the shorter message before protocol 15


PVT_VALID_DATE, PVT_VALID_TIME, PVT_FULLY_RESOLVED = 1, 2, 4
PVT_FIX_OK, PVT_DIFFERENTIAL = 1, 2
PVT_INVALID_POSITION = 1
PVT_FLAGS3_FRAME_BYTES = 92 + 8  # shorter frames have no flags3


class NavHpposllh(NamedTuple):
    """NAV-HPPOSLLH, 3.15.9: the position in high resolution."""

    version: int
    flags: int  # bit 0: invalid
    itow_ms: int
    lon_1e7_deg: int
    lat_1e7_deg: int
    height_mm: int
    height_msl_mm: int
    lon_hp_1e9_deg: int
    lat_hp_1e9_deg: int
    height_hp_tenth_mm: int
    height_msl_hp_tenth_mm: int
    horizontal_accuracy_tenth_mm: int
    vertical_accuracy_tenth_mm: int


class NavTimegps(NamedTuple):
    """NAV-TIMEGPS, 3.15.27: time of week and week in one message."""

    itow_ms: int
    ftow_ns: int  # time of week = iTOW + fTOW, ±500 000
    week: int
    leap_seconds: int
    valid: int  # TIMEGPS_*
    time_accuracy_ns: int


TIMEGPS_TOW, TIMEGPS_WEEK, TIMEGPS_LEAP = 1, 2, 4


class NavTimeutc(NamedTuple):
    """NAV-TIMEUTC, 3.15.31: UTC and time of week in one message."""

    itow_ms: int
    time_accuracy_ns: int
    nano_ns: int  # fraction of second, may be negative
    year: int
    month: int
    day: int
    hour: int
    minute: int
    second: int  # 60 in a leap second
    valid: int  # TIMEUTC_*


TIMEUTC_UTC, TIMEUTC_ALL = 4, 7  # UTC; with time of week and week number


class NavTimels(NamedTuple):
    """NAV-TIMELS, 3.15.29: leap seconds in use and announced."""

    itow_ms: int
    version: int
    current_source: int
    current: int
    change_source: int
    change: int
    time_to_event_s: int
    event_week: int
    event_day: int
    valid: int  # bit 0: current is valid, bit 1: the event is valid


TIMELS_CURRENT = 1


class NavCov(NamedTuple):
    """NAV-COV, 3.15.3: covariances, north east down, m² and m²/s²."""

    itow_ms: int
    version: int
    position_valid: int
    velocity_valid: int
    pos_nn: float
    pos_ne: float
    pos_nd: float
    pos_ee: float
    pos_ed: float
    pos_dd: float
    vel_nn: float
    vel_ne: float
    vel_nd: float
    vel_ee: float
    vel_ed: float
    vel_dd: float


class NavSol(NamedTuple):
    """Beginning of NAV-SOL (u-blox 4 to M8): the time of older receivers."""

    itow_ms: int
    ftow_ns: int
    week: int
    fix_type: int
    flags: int  # SOL_*


SOL_WEEK, SOL_TOW = 4, 8


class NavEoe(NamedTuple):
    """NAV-EOE, 3.15.5: all messages of the epoch have been sent."""

    itow_ms: int


class TimTp(NamedTuple):
    """TIM-TP, 3.20.2: the time of the next pulse."""

    tow_ms: int
    tow_sub_ms: int  # 2^-32 ms
    quantisation_ps: int
    week: int
    flags: int  # TP_*
    reference: int  # bits 0-3: GNSS of the time base, 0 GPS; reserved (0) before M8


TP_UTC_BASE, TP_UTC_AVAILABLE, TP_QUANTISATION_INVALID, TP_NOT_LOCKED = 1, 2, 0x10, 0x20
TP_REFERENCE_MASK, TP_REFERENCE_GPS = 0x0F, 0


class RxmRawx(NamedTuple):
    """RXM-RAWX, 3.17.5, without its measurements."""

    receiver_tow_s: float  # receiver's clock, some ten microseconds from GPS time, steered to whole milliseconds
    week: int
    leap_seconds: int
    measurements: int
    status: int  # RAWX_*


RAWX_LEAP_KNOWN = 1


class TimTm2(NamedTuple):
    """TIM-TM2, 3.20.1: edges on an EXTINT pin."""

    channel: int
    flags: int  # TM2_*
    rising_count: int
    week_rising: int
    week_falling: int
    tow_rising_ms: int
    tow_rising_sub_ns: int
    tow_falling_ms: int
    tow_falling_sub_ns: int
    accuracy_ns: int


TM2_NEW_FALLING, TM2_TIME_VALID, TM2_NEW_RISING = 4, 0x40, 0x80
TM2_BASE_SHIFT, TM2_BASE_MASK = 3, 3  # 0 receiver time, 1 GNSS, 2 UTC
TM2_BASE_RECEIVER, TM2_BASE_UTC = 0, 2

NAV_PVT = Layout(b"\x01\x07", "IHBBBBBBIiBBBBiiiiIIiiiiiIIHH", NavPvt, 92, min_length=84)
NAV_HPPOSLLH = Layout(b"\x01\x14", "B2xBIiiiibbbbII", NavHpposllh, 36)
NAV_TIMEGPS = Layout(b"\x01\x20", "IihbBI", NavTimegps, 16)
NAV_TIMEUTC = Layout(b"\x01\x21", "IIiHBBBBBB", NavTimeutc, 20)
NAV_TIMELS = Layout(b"\x01\x26", "IB3xBbBbiHH3xB", NavTimels, 24)
NAV_COV = Layout(b"\x01\x36", "IBBB9x12f", NavCov, 64)
NAV_SOL = Layout(b"\x01\x06", "IihBB", NavSol, 52)
NAV_EOE = Layout(b"\x01\x61", "I", NavEoe, 4)
TIM_TP = Layout(b"\x0d\x01", "IIiHBB", TimTp, 16)
TIM_TM2 = Layout(b"\x0d\x03", "BBHHHIIIII", TimTm2, 28)
RXM_RAWX = Layout(b"\x02\x15", "dHbBB", RxmRawx, 16)


def encode_nav_pvt(message: NavPvt) -> bytes:
    """Encode the frame of a NAV-PVT."""
    return NAV_PVT.encode(message)


def encode_nav_hpposllh(message: NavHpposllh) -> bytes:
    """Encode the frame of a NAV-HPPOSLLH."""
    return NAV_HPPOSLLH.encode(message)


def encode_nav_timegps(message: NavTimegps) -> bytes:
    """Encode the frame of a NAV-TIMEGPS."""
    return NAV_TIMEGPS.encode(message)


def encode_nav_timeutc(message: NavTimeutc) -> bytes:
    """Encode the frame of a NAV-TIMEUTC."""
    return NAV_TIMEUTC.encode(message)


def encode_nav_timels(message: NavTimels) -> bytes:
    """Encode the frame of a NAV-TIMELS."""
    return NAV_TIMELS.encode(message)


def encode_nav_cov(message: NavCov) -> bytes:
    """Encode the frame of a NAV-COV."""
    return NAV_COV.encode(message)


def encode_nav_eoe(message: NavEoe) -> bytes:
    """Encode the frame of a NAV-EOE."""
    return NAV_EOE.encode(message)


def encode_tim_tp(message: TimTp) -> bytes:
    """Encode the frame of a TIM-TP."""
    return TIM_TP.encode(message)


def encode_tim_tm2(message: TimTm2) -> bytes:
    """Encode the frame of a TIM-TM2."""
    return TIM_TM2.encode(message)
