"""Septentrio SBF blocks as tables: fields in wire order and in the wire's units.

Sources: PolaRx5TR reference guide (firmware 5.5.0), 4.2; for the attitude, INS and external sensor blocks, which that
receiver lacks, Septentrio's own ROS driver (septentrio_gnss_driver, ``sbf_blocks.hpp`` and its messages). Fields that
a later revision added have the do-not-use value as default. Reserved bytes are pad bytes.
"""

from __future__ import annotations

import struct
from typing import NamedTuple, TypeAlias

from swath.drivers.gnss.sbf.frame import BlockError, Layout

Triple: TypeAlias = tuple[float, float, float]

# Do-not-use values (4.1.7)
FLOAT_UNSET = -2e10
U1_UNSET, U2_UNSET, I1_UNSET, I2_UNSET = 0xFF, 0xFFFF, -128, -32768

# --- position and velocity ------------------------------------------------------------------------------------------


class PvtGeodetic(NamedTuple):
    """PVTGeodetic (4007, version 2): the position at a receiver time."""

    mode: int  # MODE_*
    error: int  # 0: none
    lat_rad: float
    lon_rad: float
    height_m: float  # above the ellipsoid
    undulation_m: float
    north_mps: float
    east_mps: float
    up_mps: float  # unset in 2D mode
    course_deg: float
    clock_bias_ms: float  # receiver time − GNSS time
    clock_drift_ppm: float
    time_system: int
    datum: int
    satellites: int
    wide_area_info: int
    reference_id: int
    mean_correction_age_10ms: int
    signals: int
    alert: int
    bases: int = 0  # revision 1
    ppp_info: int = 0
    latency_100us: int = U2_UNSET  # revision 2
    horizontal_accuracy_cm: int = U2_UNSET  # twice the RMS of the horizontal distance
    vertical_accuracy_cm: int = U2_UNSET  # two sigma
    misc: int = 0


class PvtCartesian(NamedTuple):
    """PVTCartesian (4006, version 2): the content of PVTGeodetic in ECEF."""

    mode: int
    error: int
    x_m: float
    y_m: float
    z_m: float
    undulation_m: float
    vx_mps: float
    vy_mps: float
    vz_mps: float
    course_deg: float
    clock_bias_ms: float
    clock_drift_ppm: float


MODE_TYPE_BITS = 0x0F  # bits of the mode with the type of solution


class PosCovGeodetic(NamedTuple):
    """PosCovGeodetic (5906): covariance of the position, m²; b is the clock's bias, in metres."""

    mode: int
    error: int
    lat_lat: float
    lon_lon: float
    height_height: float
    b_b: float
    lat_lon: float
    lat_height: float
    lat_b: float
    lon_height: float
    lon_b: float
    height_b: float


class VelCovGeodetic(NamedTuple):
    """VelCovGeodetic (5908), page 395: covariance of the velocity, m²/s²; t is the clock's drift."""

    mode: int
    error: int
    north_north: float
    east_east: float
    up_up: float
    t_t: float
    north_east: float
    north_up: float
    north_t: float
    east_up: float
    east_t: float
    up_t: float


class NoFields(NamedTuple):
    """EndOfPVT (5921), EndOfAtt (5943): all blocks of the epoch have been sent."""


PVT_GEODETIC = Layout(4007, PvtGeodetic, "BBdddfffffdfBBBBHHIB", "BH", "HHHB")
PVT_CARTESIAN = Layout(4006, PvtCartesian, "BBdddfffffdf")
POS_COV_GEODETIC = Layout(5906, PosCovGeodetic, "BB10f")
VEL_COV_GEODETIC = Layout(5908, VelCovGeodetic, "BB10f")
END_OF_PVT = Layout(5921, NoFields, "")
END_OF_ATT = Layout(5943, NoFields, "")

# --- time and events ------------------------------------------------------------------------------------------------


class ReceiverTime(NamedTuple):
    """ReceiverTime (5914), page 423: sent every second; the UTC fields belong to its time stamp."""

    year: int  # two digits
    month: int
    day: int
    hour: int
    minute: int
    second: int
    leap_seconds: int  # GPS − UTC; I1_UNSET: not yet received
    sync_level: int  # SYNC_*


SYNC_WEEK, SYNC_TOW, SYNC_FINE = 1, 2, 4
SYNC_FULL = SYNC_WEEK | SYNC_TOW | SYNC_FINE


class XppsOffset(NamedTuple):
    """xPPSOffset (5911), page 424: sent right after each pulse."""

    sync_age_s: int
    time_scale: int  # SCALE_*
    offset_ns: float  # pulse less true second; negative: it came early


SCALE_GPS, SCALE_UTC, SCALE_RECEIVER, SCALE_GLONASS, SCALE_GALILEO, SCALE_BEIDOU = range(1, 7)


class ExtEvent(NamedTuple):
    """ExtEvent (5924), page 426: GNSS time of the event is TOW + offset − clock bias."""

    source: int  # 1: EventA, 2: EventB
    polarity: int  # 0: rising, 1: falling
    offset_s: float
    clock_bias_s: float  # unset after ten minutes without a position
    pvt_age_s: int = U2_UNSET  # revision 1


RECEIVER_TIME = Layout(5914, ReceiverTime, "7bB")
XPPS_OFFSET = Layout(5911, XppsOffset, "BBf")
EXT_EVENT = Layout(5924, ExtEvent, "BBfd", "H")

# --- attitude, INS, IMU ---------------------------------------------------------------------------------------------


class AttEuler(NamedTuple):
    """AttEuler (5938): attitude of the antennas; degrees, north east down."""

    satellites: int
    error: int  # bits 0-1 and 2-3: the baselines; bit 7: attitude is not requested
    mode: int  # 0: none
    heading_deg: float
    pitch_deg: float
    roll_deg: float
    pitch_rate_dps: float
    roll_rate_dps: float
    heading_rate_dps: float


class AttCovEuler(NamedTuple):
    """AttCovEuler (5939): covariance of the attitude, deg²."""

    error: int
    heading_heading: float
    pitch_pitch: float
    roll_roll: float
    heading_pitch: float
    heading_roll: float
    pitch_roll: float


class InsNavGeod(NamedTuple):
    """INSNavGeod (4226), without its sub-blocks."""

    gnss_mode: int
    error: int  # 0: none
    info: int  # bits 3-5: the point: 0 main antenna, 1 point of interest
    gnss_age_10ms: int
    lat_rad: float
    lon_rad: float
    height_m: float  # above the ellipsoid
    undulation_m: float
    accuracy_cm: int
    latency_100us: int
    datum: int
    sub_blocks: int  # INS_*: sub-blocks that follow, lowest bit first


INS_POSITION_SIGMA, INS_ATTITUDE, INS_ATTITUDE_SIGMA, INS_VELOCITY, INS_VELOCITY_SIGMA = 1, 2, 4, 8, 16
INS_TRIPLE = struct.Struct("<3f")
INS_SUB_BLOCKS = (  # sub-blocks after the fixed part, three numbers each
    INS_POSITION_SIGMA,  # latitude, longitude, height; m
    INS_ATTITUDE,  # heading, pitch, roll; degrees
    INS_ATTITUDE_SIGMA,
    INS_VELOCITY,  # east, north, up; m/s
    INS_VELOCITY_SIGMA,
)


class SensorSet(NamedTuple):
    """One measurement of an ExtSensorMeas (4050)."""

    source: int
    model: int
    kind: int  # SENSOR_*
    info: int
    data: bytes


class ExtSensorMeas(NamedTuple):
    """ExtSensorMeas (4050): number of measurements that follow, and their length."""

    sets: int
    set_bytes: int


SENSOR_ACCELERATION, SENSOR_ANGULAR_RATE, SENSOR_INFO = 0, 1, 3
SENSOR_SET = struct.Struct("<BBBB24s")
SENSOR_TRIPLE = struct.Struct("<3d")  # acceleration in m/s², angular rate in deg/s
SENSOR_TEMPERATURE = struct.Struct("<h22x")  # 0.01 °C

ATT_EULER = Layout(5938, AttEuler, "BBH2x6f")
ATT_COV_EULER = Layout(5939, AttCovEuler, "xB6f")
INS_NAV_GEOD = Layout(4226, InsNavGeod, "BBHHdddfHHBxH")
EXT_SENSOR_MEAS = Layout(4050, ExtSensorMeas, "BB")
MEAS_EPOCH = 4027  # its header has the time; the measurements are for post-processing


def ins_triples(frame: bytes, block: InsNavGeod) -> dict[int, Triple]:
    """Return the sub-blocks present in an INSNavGeod, by INS_*.

    Raises:
        BlockError: the frame is shorter than the block's fields require.
    """
    found: dict[int, Triple] = {}
    offset = INS_NAV_GEOD.end
    for bit in INS_SUB_BLOCKS:
        if not block.sub_blocks & bit:
            continue
        if offset + INS_TRIPLE.size > len(frame):
            raise BlockError("bad_length")
        found[bit] = INS_TRIPLE.unpack_from(frame, offset)
        offset += INS_TRIPLE.size
    return found


def encode_ins_nav_geod(block: InsNavGeod, triples: dict[int, Triple], tow_ms: int | None, week: int | None) -> bytes:
    """Encode the frame of an INSNavGeod; its ``sub_blocks`` field is derived from the triples."""
    behind = b"".join(INS_TRIPLE.pack(*triples[bit]) for bit in INS_SUB_BLOCKS if bit in triples)
    return INS_NAV_GEOD.encode(block._replace(sub_blocks=sum(triples)), tow_ms, week, behind=behind)


def sensor_sets(frame: bytes) -> list[SensorSet]:
    """Return the measurements of an ExtSensorMeas.

    Raises:
        BlockError: the frame is shorter than the block's fields require.
    """
    head = EXT_SENSOR_MEAS.decode(frame)
    start, step = EXT_SENSOR_MEAS.end, head.set_bytes
    if step < SENSOR_SET.size or start + head.sets * step > len(frame):
        raise BlockError("bad_length")
    return [SensorSet(*SENSOR_SET.unpack_from(frame, start + index * step)) for index in range(head.sets)]


def encode_ext_sensor_meas(sets: list[SensorSet], tow_ms: int | None, week: int | None) -> bytes:
    """Encode the frame of an ExtSensorMeas."""
    behind = b"".join(SENSOR_SET.pack(*one) for one in sets)
    return EXT_SENSOR_MEAS.encode(ExtSensorMeas(len(sets), SENSOR_SET.size), tow_ms, week, behind=behind)
