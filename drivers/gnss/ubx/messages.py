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
    """NAV-SOL (u-blox 4 to M8): time and solution of older receivers, in ECEF."""

    itow_ms: int
    ftow_ns: int
    week: int
    fix_type: int  # as of NAV-PVT
    flags: int  # SOL_*
    x_cm: int
    y_cm: int
    z_cm: int
    position_accuracy_cm: int  # all axes together
    vx_cmps: int
    vy_cmps: int
    vz_cmps: int
    speed_accuracy_cmps: int
    pdop_1e2: int
    satellites: int


SOL_FIX_OK, SOL_DIFFERENTIAL, SOL_WEEK, SOL_TOW = 1, 2, 4, 8


class NavStatus(NamedTuple):
    """NAV-STATUS, 3.15.26: whether there is a solution; older receivers send it beside NAV-POSLLH."""

    itow_ms: int
    fix_type: int
    flags: int  # bits as of NAV-SOL


class NavPosllh(NamedTuple):
    """NAV-POSLLH, 3.15.11: the position."""

    itow_ms: int
    lon_1e7_deg: int
    lat_1e7_deg: int
    height_mm: int  # above the ellipsoid
    height_msl_mm: int
    horizontal_accuracy_mm: int  # both axes together
    vertical_accuracy_mm: int


class NavVelned(NamedTuple):
    """NAV-VELNED, 3.15.36: the velocity."""

    itow_ms: int
    vel_n_cmps: int
    vel_e_cmps: int
    vel_d_cmps: int
    speed_cmps: int
    ground_speed_cmps: int
    course_1e5_deg: int
    speed_accuracy_cmps: int
    course_accuracy_1e5_deg: int


class NavAtt(NamedTuple):
    """NAV-ATT (M8 ADR and UDR 19.20, F9 HPS 1.30): attitude of the vehicle, whose axes are forward, right, down."""

    itow_ms: int
    version: int
    roll_1e5_deg: int
    pitch_1e5_deg: int
    heading_1e5_deg: int
    roll_accuracy_1e5_deg: int
    pitch_accuracy_1e5_deg: int
    heading_accuracy_1e5_deg: int


class NavRelposned(NamedTuple):
    """NAV-RELPOSNED version 1, 3.15.22: vector from the reference's antenna to this receiver's own."""

    version: int
    station: int
    itow_ms: int
    north_cm: int
    east_cm: int
    down_cm: int
    length_cm: int
    heading_1e5_deg: int
    north_hp_tenth_mm: int
    east_hp_tenth_mm: int
    down_hp_tenth_mm: int
    length_hp_tenth_mm: int
    north_accuracy_tenth_mm: int
    east_accuracy_tenth_mm: int
    down_accuracy_tenth_mm: int
    length_accuracy_tenth_mm: int
    heading_accuracy_1e5_deg: int
    flags: int  # RELPOS_*


RELPOS_FIX_OK, RELPOS_VALID, RELPOS_MOVING, RELPOS_HEADING_VALID, RELPOS_NORMALISED = 1, 4, 0x20, 0x100, 0x200
RELPOS_CARRIER_SHIFT, RELPOS_CARRIER_BITS, RELPOS_FIXED = 3, 3, 2


class NavPvat(NamedTuple):
    """NAV-PVAT (F9 HPS 1.30, class 01 id 17): position, velocity, attitude and UTC of an epoch."""

    itow_ms: int
    version: int
    valid: int  # PVT_VALID_*
    year: int
    month: int
    day: int
    hour: int
    minute: int
    second: int
    time_accuracy_ns: int
    nano_ns: int
    fix_type: int
    flags: int  # as of NAV-PVT, and PVAT_*
    flags2: int
    satellites: int
    lon_1e7_deg: int
    lat_1e7_deg: int
    height_mm: int
    height_msl_mm: int
    horizontal_accuracy_mm: int
    vertical_accuracy_mm: int
    vel_n_mmps: int
    vel_e_mmps: int
    vel_d_mmps: int
    ground_speed_mmps: int
    speed_accuracy_mmps: int
    roll_1e5_deg: int
    pitch_1e5_deg: int
    heading_1e5_deg: int
    course_1e5_deg: int
    roll_accuracy_1e2_deg: int
    pitch_accuracy_1e2_deg: int
    heading_accuracy_1e2_deg: int


PVAT_ROLL_VALID, PVAT_PITCH_VALID, PVAT_HEADING_VALID = 8, 16, 32
PVAT_ATTITUDE_VALID = PVAT_ROLL_VALID | PVAT_PITCH_VALID | PVAT_HEADING_VALID


class EsfIns(NamedTuple):
    """ESF-INS (M8 ADR 19.20, F9 HPS 1.30): rates and accelerations of the vehicle, without gravity and biases."""

    flags: int  # bits 8 to 13: x, y, z rate and x, y, z acceleration are valid
    itow_ms: int
    x_rate_1e3_dps: int
    y_rate_1e3_dps: int
    z_rate_1e3_dps: int
    x_acceleration_1e2_mps2: int
    y_acceleration_1e2_mps2: int
    z_acceleration_1e2_mps2: int


ESF_INS_FIRST_VALID_BIT = 8


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
NAV_SOL = Layout(b"\x01\x06", "IihBBiiiIiiiIHxB", NavSol, 52)
NAV_STATUS = Layout(b"\x01\x03", "IBB", NavStatus, 16)
NAV_POSLLH = Layout(b"\x01\x02", "IiiiiII", NavPosllh, 28)
NAV_VELNED = Layout(b"\x01\x12", "IiiiIIiII", NavVelned, 36)
NAV_ATT = Layout(b"\x01\x05", "IB3xiiiIII", NavAtt, 32)
NAV_RELPOSNED = Layout(b"\x01\x3c", "BxHIiiiii4xbbbbIIIII4xI", NavRelposned, 64)
NAV_PVAT = Layout(b"\x01\x17", "IBBHBBBBB3xIiBBBBiiiiIIiiiiIiiiiHHH", NavPvat, 116)
ESF_INS = Layout(b"\x10\x15", "I4xIiiiiii", EsfIns, 36)
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
