"""NovAtel OEM7 binary: headers and messages (docs.novatel.com/OEM7); status and scale tables: `tables`.

A message is a `NamedTuple` of its fields in wire order, and a `struct.Struct` in `LAYOUTS`. Angles are in degrees and
heights above the receiver's geoid where the manual defines them so: `swath.drivers.gnss.novatel.parser` converts them.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import NamedTuple


class LongHeader(NamedTuple):
    """Binary header, AA 44 12 (Messages, "Binary"); at least 28 bytes, its first field gives its length."""

    header_bytes: int
    message_id: int
    message_type: int
    port: int
    message_bytes: int
    sequence: int
    idle_time: int
    time_status: int
    week: int
    milliseconds: int
    receiver_status: int
    reserved: int
    software: int


class ShortHeader(NamedTuple):
    """Short binary header, AA 44 13 (Messages, "Description of ASCII and Binary Logs with Short Headers")."""

    message_bytes: int
    message_id: int
    week: int
    milliseconds: int


SYNC_LONG = b"\xaa\x44\x12"
SYNC_SHORT = b"\xaa\x44\x13"
LONG_HEADER = struct.Struct("<3xBHBBHHBBHIIHH")
SHORT_HEADER = struct.Struct("<3xBHHI")
CRC_BYTES = 4
RESPONSE_BIT = 0x80  # in message_type: the answer to a command, not a log
FORMAT_BITS = 0x60  # in message_type: 0 binary
SOURCE_BITS = 0x1F  # in message_type: 1 secondary antenna; older firmware sends other values without meaning


class BestPos(NamedTuple):
    """BESTPOS (42) and logs of the same layout; height above the geoid."""

    solution_status: int
    position_type: int
    lat_deg: float
    lon_deg: float
    height_m: float
    undulation_m: float
    datum: int
    lat_sigma_m: float
    lon_sigma_m: float
    height_sigma_m: float
    station: bytes
    differential_age_s: float
    solution_age_s: float
    satellites_tracked: int
    satellites_used: int
    satellites_l1: int
    satellites_multi: int
    reserved: int
    extended_status: int
    galileo_beidou_mask: int
    gps_glonass_mask: int


class BestVel(NamedTuple):
    """BESTVEL (99): track over ground from true north, vertical speed up; the latency must be subtracted from the
    time.
    """

    solution_status: int
    velocity_type: int
    latency_s: float
    differential_age_s: float
    horizontal_mps: float
    track_deg: float
    up_mps: float
    reserved: float


class Time(NamedTuple):
    """TIME (101): GPS system time = reference time − clock_offset_s; UTC = GPS + utc_offset_s."""

    clock_status: int
    clock_offset_s: float
    clock_offset_sigma_s: float
    utc_offset_s: float
    utc_year: int
    utc_month: int
    utc_day: int
    utc_hour: int
    utc_minute: int
    utc_ms: int
    utc_status: int


class InsPva(NamedTuple):
    """INSPVA (507), INSPVAS (508); height above the ellipsoid."""

    week: int
    seconds: float
    lat_deg: float
    lon_deg: float
    height_m: float
    north_mps: float
    east_mps: float
    up_mps: float
    roll_deg: float
    pitch_deg: float
    azimuth_deg: float
    ins_status: int


class InsPvax(NamedTuple):
    """INSPVAX (1465); height above the geoid."""

    ins_status: int
    position_type: int
    lat_deg: float
    lon_deg: float
    height_m: float
    undulation_m: float
    north_mps: float
    east_mps: float
    up_mps: float
    roll_deg: float
    pitch_deg: float
    azimuth_deg: float
    lat_sigma_m: float
    lon_sigma_m: float
    height_sigma_m: float
    north_sigma_mps: float
    east_sigma_mps: float
    up_sigma_mps: float
    roll_sigma_deg: float
    pitch_sigma_deg: float
    azimuth_sigma_deg: float
    extended_status: int
    seconds_since_update: int


class InsAtt(NamedTuple):
    """INSATT (263), INSATTS (319): attitude with its own time."""

    week: int
    seconds: float
    roll_deg: float
    pitch_deg: float
    azimuth_deg: float
    ins_status: int


class InsAttx(NamedTuple):
    """INSATTX (1457): attitude with its sigmas."""

    ins_status: int
    position_type: int
    roll_deg: float
    pitch_deg: float
    azimuth_deg: float
    roll_sigma_deg: float
    pitch_sigma_deg: float
    azimuth_sigma_deg: float
    extended_status: int
    seconds_since_update: int


class RawImu(NamedTuple):
    """RAWIMU (268), RAWIMUS (325): counts of velocity and angle increments in the order z, −y, x."""

    week: int
    seconds: float
    imu_status: int
    accel_z: int
    accel_minus_y: int
    accel_x: int
    gyro_z: int
    gyro_minus_y: int
    gyro_x: int


class RawImux(NamedTuple):
    """RAWIMUX (1461), RAWIMUSX (1462): as RAWIMU, with the type of the IMU."""

    imu_info: int
    imu_type: int
    week: int
    seconds: float
    imu_status: int
    accel_z: int
    accel_minus_y: int
    accel_x: int
    gyro_z: int
    gyro_minus_y: int
    gyro_x: int


class CorrImuData(NamedTuple):
    """CORRIMUDATA (812), CORRIMUDATAS (813), IMURATECORRIMUS (1362): increments (rad, m/s) since the last log.

    They are about and along the axes of the output frame: x right, y forward, z up. Gravity, earth rotation and the
    estimated sensor errors are already removed: this is motion, not specific force.
    """

    week: int
    seconds: float
    pitch_rad: float
    roll_rad: float
    yaw_rad: float
    lateral_mps: float
    longitudinal_mps: float
    vertical_mps: float


class CorrImu(NamedTuple):
    """CORRIMUS (2264): as CORRIMUDATA, summed over `imu_samples` samples of the IMU."""

    imu_samples: int
    pitch_rad: float
    roll_rad: float
    yaw_rad: float
    lateral_mps: float
    longitudinal_mps: float
    vertical_mps: float
    reserved_1: float
    reserved_2: int


class MarkTime(NamedTuple):
    """MARK1TIME (1130; MARKTIME, 231, before), MARK2TIME (616), …: GPS time = seconds − clock_offset_s."""

    week: int
    seconds: float
    clock_offset_s: float
    clock_offset_sigma_s: float
    utc_offset_s: float
    clock_status: int


class Heading2(NamedTuple):
    """HEADING2 (1335): heading from the master antenna to the rover's; baseline −1 where unknown."""

    solution_status: int
    position_type: int
    baseline_m: float
    heading_deg: float
    pitch_deg: float
    reserved_1: float
    heading_sigma_deg: float
    pitch_sigma_deg: float
    rover_station: bytes
    master_station: bytes
    satellites_tracked: int
    satellites_used: int
    satellites_observed: int
    satellites_multi: int
    solution_source: int
    extended_status: int
    galileo_beidou_mask: int
    gps_glonass_mask: int


class Heading(NamedTuple):
    """HEADING (971), DUALANTENNAHEADING (2042): as HEADING2, with one station."""

    solution_status: int
    position_type: int
    baseline_m: float
    heading_deg: float
    pitch_deg: float
    reserved_1: float
    heading_sigma_deg: float
    pitch_sigma_deg: float
    station: bytes
    satellites_tracked: int
    satellites_used: int
    satellites_observed: int
    satellites_multi: int
    solution_source: int
    extended_status: int
    galileo_beidou_mask: int
    gps_glonass_mask: int


class InsConfig(NamedTuple):
    """INSCONFIG (1945): its first field, the type of the IMU."""

    imu_type: int


Body = (
    BestPos
    | BestVel
    | Time
    | InsPva
    | InsPvax
    | InsAtt
    | InsAttx
    | RawImu
    | RawImux
    | CorrImuData
    | CorrImu
    | MarkTime
    | Heading2
    | Heading
    | InsConfig
)


@dataclass(frozen=True, slots=True)
class Layout:
    """A message's name, fields and wire format (a minimum length: newer firmware may append bytes)."""

    name: str
    body: type[Body]
    wire: struct.Struct
    short: bool = False


_BESTPOS = struct.Struct("<IIdddfIfff4sffBBBBBBBB")
_BESTVEL = struct.Struct("<IIffdddf")
_INSPVA = struct.Struct("<IddddddddddI")
_INSATT = struct.Struct("<IddddI")
_RAWIMU = struct.Struct("<IdIiiiiii")
_RAWIMUX = struct.Struct("<BBHdIiiiiii")
_CORRIMUDATA = struct.Struct("<Iddddddd")
_HEADING = struct.Struct("<IIffffff4sBBBBBBBB")
_MARKTIME = struct.Struct("<IddddI")

LAYOUTS: dict[int, Layout] = {
    42: Layout("BESTPOS", BestPos, _BESTPOS),
    1429: Layout("BESTGNSSPOS", BestPos, _BESTPOS),
    1538: Layout("PPPPOS", BestPos, _BESTPOS),
    99: Layout("BESTVEL", BestVel, _BESTVEL),
    1430: Layout("BESTGNSSVEL", BestVel, _BESTVEL),
    101: Layout("TIME", Time, struct.Struct("<IdddIBBBBII")),
    507: Layout("INSPVA", InsPva, _INSPVA),
    508: Layout("INSPVAS", InsPva, _INSPVA, short=True),
    1465: Layout("INSPVAX", InsPvax, struct.Struct("<IIdddfddddddfffffffffIH")),
    263: Layout("INSATT", InsAtt, _INSATT),
    319: Layout("INSATTS", InsAtt, _INSATT, short=True),
    1457: Layout("INSATTX", InsAttx, struct.Struct("<IIdddfffIH")),
    268: Layout("RAWIMU", RawImu, _RAWIMU),
    325: Layout("RAWIMUS", RawImu, _RAWIMU, short=True),
    1461: Layout("RAWIMUX", RawImux, _RAWIMUX),
    1462: Layout("RAWIMUSX", RawImux, _RAWIMUX, short=True),
    812: Layout("CORRIMUDATA", CorrImuData, _CORRIMUDATA),
    813: Layout("CORRIMUDATAS", CorrImuData, _CORRIMUDATA, short=True),
    1362: Layout("IMURATECORRIMUS", CorrImuData, _CORRIMUDATA, short=True),
    2264: Layout("CORRIMUS", CorrImu, struct.Struct("<IddddddfI"), short=True),
    231: Layout("MARKTIME", MarkTime, _MARKTIME),
    1130: Layout("MARK1TIME", MarkTime, _MARKTIME),
    616: Layout("MARK2TIME", MarkTime, _MARKTIME),
    1075: Layout("MARK3TIME", MarkTime, _MARKTIME),
    1076: Layout("MARK4TIME", MarkTime, _MARKTIME),
    1335: Layout("HEADING2", Heading2, struct.Struct("<IIffffff4s4sBBBBBBBB")),
    971: Layout("HEADING", Heading, _HEADING),
    2042: Layout("DUALANTENNAHEADING", Heading, _HEADING),
    1945: Layout("INSCONFIG", InsConfig, struct.Struct("<I")),
}
IDS = {layout.name: number for number, layout in LAYOUTS.items()}
MARK_CHANNELS = {
    "MARKTIME": "MARK1",
    "MARK1TIME": "MARK1",
    "MARK2TIME": "MARK2",
    "MARK3TIME": "MARK3",
    "MARK4TIME": "MARK4",
}
OTHER_NAMES = {  # framed, counted and kept, not decoded
    5: "LOGLIST",
    25: "RAWGPSSUBFRAME",
    37: "VERSION",
    41: "RAWEPHEM",
    43: "RANGE",
    48: "SATVIS",
    72: "PORTSTATS",
    83: "TRACKSTAT",
    93: "RXSTATUS",
    128: "RXCONFIG",
    140: "RANGECMP",
    162: "SETNAV",
    174: "PSRDOP",
    206: "VALIDMODELS",
    241: "BESTXYZ",
    264: "INSCOV",
    723: "GLOEPHEMERIS",
    726: "BESTUTM",
    1041: "CONFIGCODE",
    1163: "PSRDOP2",
    1194: "BESTSATS",
    1344: "SOURCETABLE",
    1412: "PROFILEINFO",
    1627: "UALCONTROL",
    2051: "INSSTDEV",
}
