"""Merges the NAV messages of an epoch into one `GnssFix`, and into a row of the device's own INS.

NAV-PVT or NAV-PVAT has everything; NAV-HPPOSLLH refines the position. Receivers and settings without them send
NAV-POSLLH, NAV-VELNED and NAV-SOL or NAV-STATUS: position, velocity, and whether there is a solution. A NAV-SOL alone
has all three in ECEF.
"""

from __future__ import annotations

import datetime as dt
import math
from typing import NamedTuple, TypeAlias, TypeVar

import numpy as np

from swath.drivers.gnss.date_floor import GPS_EPOCH
from swath.drivers.gnss.ubx import messages as ubx
from swath.drivers.parser import ParserCounters
from swath.drivers.record_rows import Row
from swath.georef.arrays import FloatArray
from swath.georef.records import FixType, GnssFix, GnssHeading, InsSolution, TimeScale, TimeTag

NavMessage: TypeAlias = (
    ubx.NavPvt
    | ubx.NavPvat
    | ubx.NavHpposllh
    | ubx.NavPosllh
    | ubx.NavVelned
    | ubx.NavSol
    | ubx.NavStatus
    | ubx.NavAtt
    | ubx.NavCov
    | ubx.NavTimegps
)
Parts: TypeAlias = dict[str, tuple[int, NavMessage]]
MessageT = TypeVar("MessageT", bound=NavMessage)

MS_NS = 1_000_000
DAY_MS = 86_400_000
WEEK_MS = 604_800_000
WEEK_NS = 604_800_000_000_000

# NAV-PVT fixType: 0 none, 1 dead reckoning, 2 2D, 3 3D, 4 GNSS + dead reckoning, 5 time only, at a fixed position
FIX_NONE = 0
SPECIAL_TYPES = {FIX_NONE: FixType.NONE, 1: FixType.DEAD_RECKONING, 5: FixType.MANUAL}
CARRIER_SHIFT = 6  # flags bits 6 and 7: 1 float, 2 fixed
CARRIER_TYPES = {1: FixType.RTK_FLOAT, 2: FixType.RTK_FIXED}
POSITION_MESSAGES = ("NAV-PVT", "NAV-PVAT", "NAV-HPPOSLLH", "NAV-POSLLH", "NAV-SOL")  # the first one names the fix
ATTITUDE_MESSAGES = ("NAV-PVAT", "NAV-ATT")
SATELLITE_BITS = 0x7F  # M8P firmware sets the highest bit
GREATEST_UNVOUCHED_M = 100.0  # accuracy beyond which a NAV-POSLLH without any status is no solution

SEMI_MAJOR_M, FLATTENING = 6_378_137.0, 1 / 298.257223563  # WGS 84
ECCENTRICITY_SQUARED = FLATTENING * (2 - FLATTENING)
LEAST_RADIUS_M = 6.0e6  # an ECEF position below it is not one of a receiver


class _Position(NamedTuple):
    """Latitude, longitude (rad), height above the ellipsoid (m), covariance and the geoid's height (m)."""

    lat_rad: float
    lon_rad: float
    height_m: float
    cov_l: FloatArray
    undulation_m: float | None


class _Velocity(NamedTuple):
    """North, east, down (m/s) and covariance."""

    velocity_l: tuple[float, float, float]
    cov_l: FloatArray


def _of(parts: Parts, name: str, kind: type[MessageT]) -> MessageT | None:
    """Return the part of a name."""
    _, message = parts.get(name, (0, None))
    return message if isinstance(message, kind) else None


def merge_epoch(parts: Parts, floor_week: int) -> GnssFix | None:
    """Merge an epoch's messages into a fix; return None where none of them has a position."""
    name = next((name for name in POSITION_MESSAGES if name in parts), None)
    high = _of(parts, "NAV-HPPOSLLH", ubx.NavHpposllh)
    high = high if high is not None and not high.flags & 1 else None
    if name is None or (name == "NAV-HPPOSLLH" and high is None):
        return None
    pvt, cov = _pvt(parts), _of(parts, "NAV-COV", ubx.NavCov)
    host_time_ns, message = parts[name]
    position = _position(parts, high)
    velocity = _velocity(parts, position)
    return GnssFix(
        host_time_ns=host_time_ns,
        time=_epoch_tag(message.itow_ms, pvt, _of(parts, "NAV-TIMEGPS", ubx.NavTimegps), floor_week),
        lat_rad=position.lat_rad if position else None,
        lon_rad=position.lon_rad if position else None,
        height_m=position.height_m if position else None,
        velocity_l=velocity.velocity_l if velocity else None,
        position_cov_l=_position_cov(position, cov),
        velocity_cov_l=_velocity_cov(velocity, cov),
        fix_type=_fix_type(parts),
        satellites=_satellites(parts),
        valid=position is not None and _vouched(parts, position),
        message=name,
        undulation_m=position.undulation_m if position else None,
    )


def ins_row(parts: Parts, fix: GnssFix | None, floor_week: int) -> Row | None:
    """Return the attitude of an epoch with its position and velocity, as a row of `INS_DTYPE`.

    NAV-PVAT says which angles are valid. NAV-ATT does not: its angles count where it gives each an accuracy. None
    without a valid attitude.
    """
    name = next((name for name in ATTITUDE_MESSAGES if name in parts), None)
    attitude = None if name is None else _attitude(parts[name][1])
    if name is None or attitude is None:
        return None
    host_time_ns, message = parts[name]
    tag = _epoch_tag(message.itow_ms, _pvt(parts), _of(parts, "NAV-TIMEGPS", ubx.NavTimegps), floor_week)
    week = tag.week if tag.week is not None else _week_of_utc(_pvt(parts), floor_week)
    unknown = (math.nan, math.nan, math.nan)
    usable = fix is not None and fix.valid and fix.height_m is not None
    return Row(
        InsSolution,
        (
            host_time_ns,
            -1 if week is None else week * WEEK_NS + tag.time_ns,
            *((fix.lat_rad, fix.lon_rad, fix.height_m) if fix is not None and usable else unknown),
            fix.velocity_l if fix is not None and usable and fix.velocity_l is not None else unknown,
            *attitude[:3],
            _sigmas(fix.position_cov_l if fix is not None and usable else None),
            _sigmas(fix.velocity_cov_l if fix is not None and usable else None),
            attitude[3:],
            0,
        ),
    )


def _sigmas(covariance: FloatArray | None) -> tuple[float, ...]:
    return (math.nan,) * 3 if covariance is None else tuple(np.sqrt(np.diag(covariance)).tolist())


def _attitude(message: NavMessage) -> tuple[float, ...] | None:
    """Return roll, pitch, heading and their sigmas, rad; None where the receiver has no attitude."""
    if isinstance(message, ubx.NavPvat):
        if message.flags & ubx.PVAT_ATTITUDE_VALID != ubx.PVAT_ATTITUDE_VALID:
            return None
        angles = (message.roll_1e5_deg, message.pitch_1e5_deg, message.heading_1e5_deg)
        hundredths = (message.roll_accuracy_1e2_deg, message.pitch_accuracy_1e2_deg, message.heading_accuracy_1e2_deg)
        accuracies = tuple(value / 1e2 for value in hundredths)
    elif isinstance(message, ubx.NavAtt):
        angles = (message.roll_1e5_deg, message.pitch_1e5_deg, message.heading_1e5_deg)
        fine = (message.roll_accuracy_1e5_deg, message.pitch_accuracy_1e5_deg, message.heading_accuracy_1e5_deg)
        accuracies = tuple(value / 1e5 for value in fine)
        if not all(0.0 < value < 180.0 for value in accuracies):
            return None
    else:
        return None
    return tuple(math.radians(value) for value in (*(angle / 1e5 for angle in angles), *accuracies))


def _week_of_utc(pvt: ubx.NavPvt | None, floor_week: int) -> int | None:
    """Return the GPS week in which the UTC date of a message has its iTOW; None without a date."""
    if pvt is None or not pvt.valid & ubx.PVT_VALID_DATE or not pvt.valid & ubx.PVT_VALID_TIME:
        return None
    try:
        days = (dt.date(pvt.year, pvt.month, pvt.day) - GPS_EPOCH).days
    except ValueError:
        return None
    utc_ms = days * DAY_MS + (pvt.hour * 3600 + pvt.minute * 60 + pvt.second) * 1000
    week = round((utc_ms - pvt.itow_ms) / WEEK_MS)
    return week if week >= floor_week else None


def _pvt(parts: Parts) -> ubx.NavPvt | None:
    """Return an epoch's NAV-PVT, or the part of its NAV-PVAT that a NAV-PVT has."""
    pvt, pvat = _of(parts, "NAV-PVT", ubx.NavPvt), _of(parts, "NAV-PVAT", ubx.NavPvat)
    return pvt if pvt is not None or pvat is None else pvt_of(pvat)


def pvt_of(message: ubx.NavPvat) -> ubx.NavPvt:
    """Return the part of a NAV-PVAT that a NAV-PVT has."""
    carrier = message.flags & (3 << CARRIER_SHIFT | ubx.PVT_FIX_OK | ubx.PVT_DIFFERENTIAL)
    common = {name: value for name, value in message._asdict().items() if name in ubx.NavPvt._fields}
    missing = {"course_accuracy_1e5_deg": 0, "pdop_1e2": 0, "flags3": 0}
    return ubx.NavPvt(**(common | missing | {"flags": carrier}))


def _epoch_tag(itow_ms: int, pvt: ubx.NavPvt | None, time: ubx.NavTimegps | None, floor_week: int) -> TimeTag:
    """Return GPS time of the epoch with its sub-millisecond part; the week only from a NAV-TIMEGPS of this iTOW.

    The receiver's clock may differ from the millisecond of iTOW by up to half a millisecond.
    """
    sub_ms_ns, week, leap = 0, None, None
    if time is not None and time.valid & ubx.TIMEGPS_TOW:
        sub_ms_ns = time.ftow_ns
        week = time.week if time.valid & ubx.TIMEGPS_WEEK and time.week >= floor_week else None
        leap = time.leap_seconds if time.valid & ubx.TIMEGPS_LEAP else None
    elif pvt is not None and pvt.valid & ubx.PVT_VALID_TIME:
        sub_ms_ns = (pvt.nano_ns + MS_NS // 2) % MS_NS - MS_NS // 2
    time_ns = itow_ms * MS_NS + sub_ms_ns
    if not 0 <= time_ns < WEEK_NS:
        week = week + (1 if time_ns > 0 else -1) if week is not None else None
        time_ns %= WEEK_NS
    return TimeTag(TimeScale.GPS, time_ns, week=week, leap_seconds=leap)


def _position(parts: Parts, high: ubx.NavHpposllh | None) -> _Position | None:
    """Return the best position of an epoch, with the covariance of its accuracies."""
    pvt, low = _pvt(parts), _of(parts, "NAV-POSLLH", ubx.NavPosllh)
    if high is not None:
        return _Position(
            math.radians((high.lat_1e7_deg * 100 + high.lat_hp_1e9_deg) / 1e9),
            math.radians((high.lon_1e7_deg * 100 + high.lon_hp_1e9_deg) / 1e9),
            (high.height_mm * 10 + high.height_hp_tenth_mm) / 1e4,
            _accuracy_cov(high.horizontal_accuracy_tenth_mm / 1e4, high.vertical_accuracy_tenth_mm / 1e4),
            (high.height_mm - high.height_msl_mm) / 1e3,
        )
    if pvt is not None:
        return None if pvt.fix_type == FIX_NONE or pvt.flags3 & ubx.PVT_INVALID_POSITION else _of_integers(pvt)
    return _of_integers(low) if low is not None else _ecef_position(_of(parts, "NAV-SOL", ubx.NavSol))


def _of_integers(message: ubx.NavPvt | ubx.NavPosllh) -> _Position:
    return _Position(
        math.radians(message.lat_1e7_deg / 1e7),
        math.radians(message.lon_1e7_deg / 1e7),
        message.height_mm / 1e3,
        _accuracy_cov(message.horizontal_accuracy_mm / 1e3, message.vertical_accuracy_mm / 1e3),
        (message.height_mm - message.height_msl_mm) / 1e3,
    )


def _ecef_position(sol: ubx.NavSol | None) -> _Position | None:
    """Return the position of a NAV-SOL; its accuracy is shared equally among the axes."""
    if sol is None or sol.fix_type == FIX_NONE:
        return None
    x_m, y_m, z_m = sol.x_cm / 1e2, sol.y_cm / 1e2, sol.z_cm / 1e2
    if math.hypot(x_m, y_m, z_m) < LEAST_RADIUS_M:
        return None
    covariance = np.diag([(sol.position_accuracy_cm / 1e2) ** 2 / 3.0] * 3)
    return _Position(*geodetic_from_ecef(x_m, y_m, z_m), covariance, None)


def geodetic_from_ecef(x_m: float, y_m: float, z_m: float) -> tuple[float, float, float]:
    """Return latitude, longitude (rad) and ellipsoidal height (m) of a place near the earth's surface.

    Bowring's start and two more steps (Bowring 1976); below 1 nm up to 100 km height.
    """
    axis_m = math.hypot(x_m, y_m)
    reduced = math.atan2(z_m, (1 - FLATTENING) * axis_m)
    lat = reduced
    second = ECCENTRICITY_SQUARED / (1 - ECCENTRICITY_SQUARED)
    for _ in range(3):
        lat = math.atan2(
            z_m + second * (1 - FLATTENING) * SEMI_MAJOR_M * math.sin(reduced) ** 3,
            axis_m - ECCENTRICITY_SQUARED * SEMI_MAJOR_M * math.cos(reduced) ** 3,
        )
        reduced = math.atan2((1 - FLATTENING) * math.sin(lat), math.cos(lat))
    sine = math.sin(lat)
    height_m = axis_m * math.cos(lat) + z_m * sine - SEMI_MAJOR_M * math.sqrt(1 - ECCENTRICITY_SQUARED * sine * sine)
    return lat, math.atan2(y_m, x_m), height_m


def _accuracy_cov(horizontal: float, vertical: float) -> FloatArray:
    """Return the covariance of accuracies, m or m/s; the horizontal one covers both axes together, hAcc² = NN + EE."""
    return np.diag([horizontal**2 / 2.0, horizontal**2 / 2.0, vertical**2])


def _symmetric(nn: float, ne: float, nd: float, ee: float, ed: float, dd: float) -> FloatArray:
    return np.array([[nn, ne, nd], [ne, ee, ed], [nd, ed, dd]])


def _position_cov(position: _Position | None, cov: ubx.NavCov | None) -> FloatArray | None:
    if cov is not None and cov.position_valid:
        return _symmetric(cov.pos_nn, cov.pos_ne, cov.pos_nd, cov.pos_ee, cov.pos_ed, cov.pos_dd)
    return position.cov_l if position is not None else None


def _velocity(parts: Parts, position: _Position | None) -> _Velocity | None:
    """Return the velocity of NAV-PVT, else of NAV-VELNED, else of NAV-SOL.

    Its covariance is of the speed accuracy: compared with NAV-COV, sAcc² is close to NN + EE and to DD.
    """
    pvt, ned, sol = _pvt(parts), _of(parts, "NAV-VELNED", ubx.NavVelned), _of(parts, "NAV-SOL", ubx.NavSol)
    if pvt is not None:
        speed_mps, velocity = pvt.speed_accuracy_mmps / 1e3, (pvt.vel_n_mmps, pvt.vel_e_mmps, pvt.vel_d_mmps)
        north, east, down = (value / 1e3 for value in velocity)
        there = pvt.fix_type != FIX_NONE
    elif ned is not None:
        speed_mps = ned.speed_accuracy_cmps / 1e2
        north, east, down = (value / 1e2 for value in (ned.vel_n_cmps, ned.vel_e_cmps, ned.vel_d_cmps))
        there = position is not None and _fix_type(parts) is not FixType.NONE
    elif sol is not None and position is not None:
        speed_mps, there = sol.speed_accuracy_cmps / 1e2, sol.fix_type != FIX_NONE
        sin_lat, cos_lat = math.sin(position.lat_rad), math.cos(position.lat_rad)
        sin_lon, cos_lon = math.sin(position.lon_rad), math.cos(position.lon_rad)
        x, y, z = (value / 1e2 for value in (sol.vx_cmps, sol.vy_cmps, sol.vz_cmps))
        outward = cos_lon * x + sin_lon * y
        north, east = cos_lat * z - sin_lat * outward, cos_lon * y - sin_lon * x
        down = -cos_lat * outward - sin_lat * z
    else:
        return None
    return _Velocity((north, east, down), _accuracy_cov(speed_mps, speed_mps)) if there else None


def _velocity_cov(velocity: _Velocity | None, cov: ubx.NavCov | None) -> FloatArray | None:
    if cov is not None and cov.velocity_valid:
        return _symmetric(cov.vel_nn, cov.vel_ne, cov.vel_nd, cov.vel_ee, cov.vel_ed, cov.vel_dd)
    return velocity.cov_l if velocity is not None else None


def _satellites(parts: Parts) -> int | None:
    counting = _pvt(parts) or _of(parts, "NAV-SOL", ubx.NavSol)
    return counting.satellites & SATELLITE_BITS if counting is not None else None


def _fix_type(parts: Parts) -> FixType:
    """Return the fix type; NAV-HPPOSLLH and NAV-POSLLH alone show only that a position exists."""
    status = _status(parts)
    if status is None:
        return FixType.SINGLE
    if status.fix_type in SPECIAL_TYPES:
        return SPECIAL_TYPES[status.fix_type]
    plain = FixType.DIFFERENTIAL if status.flags & ubx.PVT_DIFFERENTIAL else FixType.SINGLE
    return CARRIER_TYPES.get(status.flags >> CARRIER_SHIFT, plain) if isinstance(status, ubx.NavPvt) else plain


def _vouched(parts: Parts, position: _Position) -> bool:
    """Return whether the receiver calls the solution good, or, where nothing says so, gives it a good accuracy."""
    status = _status(parts)
    if status is not None:
        return status.flags & ubx.PVT_FIX_OK != 0
    return "NAV-HPPOSLLH" in parts or bool(np.sqrt(np.trace(position.cov_l)) < GREATEST_UNVOUCHED_M)


def _status(parts: Parts) -> ubx.NavPvt | ubx.NavSol | ubx.NavStatus | None:
    """Return the message that has the fix type and flags; their lowest two bits mean the same in all of them."""
    return _pvt(parts) or _of(parts, "NAV-SOL", ubx.NavSol) or _of(parts, "NAV-STATUS", ubx.NavStatus)


def baseline_heading(host_time_ns: int, message: ubx.NavRelposned, counters: ParserCounters) -> GnssHeading | None:
    """Return the direction from this receiver's antenna, whose positions it sends, to the reference's on the same body.

    The message has the vector in the other direction (3.15.22). None if the reference does not move: then it stands
    somewhere on the ground. Without fixed ambiguities it is not valid, and counted.
    """
    if not message.flags & ubx.RELPOS_MOVING:
        return None
    needed = ubx.RELPOS_FIX_OK | ubx.RELPOS_VALID | ubx.RELPOS_HEADING_VALID
    there = message.flags & needed == needed
    fixed = message.flags >> ubx.RELPOS_CARRIER_SHIFT & ubx.RELPOS_CARRIER_BITS == ubx.RELPOS_FIXED
    if not (there and fixed):
        counters.errors["heading_not_fixed" if there else "heading_not_valid"] += 1
    north_m = message.north_cm / 1e2 + message.north_hp_tenth_mm / 1e4
    east_m = message.east_cm / 1e2 + message.east_hp_tenth_mm / 1e4
    down_m = message.down_cm / 1e2 + message.down_hp_tenth_mm / 1e4
    length_m = math.hypot(north_m, east_m, down_m)
    if not length_m:
        return None
    normalised = message.flags & ubx.RELPOS_NORMALISED
    return GnssHeading(
        host_time_ns,
        TimeTag(TimeScale.GPS, message.itow_ms * MS_NS),
        heading_rad=math.radians((message.heading_1e5_deg / 1e5 + 180.0) % 360.0),
        pitch_rad=math.atan2(down_m, math.hypot(north_m, east_m)),
        baseline_m=None if normalised else message.length_cm / 1e2 + message.length_hp_tenth_mm / 1e4,
        heading_sigma_rad=math.radians(message.heading_accuracy_1e5_deg / 1e5) or None,
        pitch_sigma_rad=math.atan(message.down_accuracy_tenth_mm / 1e4 / length_m) or None,
        valid=there and fixed,
        message="NAV-RELPOSNED",
    )
