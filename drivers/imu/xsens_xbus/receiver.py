"""The GNSS receiver of an Xsens unit, and the unit's own solution: records of items.

- GnssPvtData is the receiver's own solution, at its antenna. Its accuracies are divided among the axes as those of
  u-blox's NAV-PVT, whose fields it has. Whether ambiguities are float or fixed is said by the status word only.
- Orientation (Quaternion, or Euler angles by turning about z, y, x) leads from the housing's axes to the local frame
  that the identifier names: east, north, up (0), north, east, down (4) or north, west, up (8); velocity has a frame of
  its own. In the recordings the orientation at rest turns the measured specific force up (MT0605P 4.2.3).
"""

from __future__ import annotations

import datetime as dt
from math import cos, hypot, isfinite, nan, radians, sin, sqrt

import numpy as np

from swath.drivers.gnss.date_floor import GPS_EPOCH, WEEK_MS, leap_seconds_of
from swath.drivers.imu.attitude import angles_of
from swath.drivers.imu.xsens_xbus import wire
from swath.drivers.record_rows import Row
from swath.georef.records import DeviceStatus, FixType, GnssFix, InsSolution, TimeScale, TimeTag
from swath.georef.timescales.gps_time import MILLISECOND_NS, SECOND_NS

DAY_MS = 86_400_000
WEEK_NS = WEEK_MS * MILLISECOND_NS
FIX_TYPES = {1: FixType.DEAD_RECKONING, 2: FixType.SINGLE, 3: FixType.SINGLE, 4: FixType.SINGLE}
RTK_TYPES = {1: FixType.RTK_FLOAT, 2: FixType.RTK_FIXED}
HALF = sqrt(0.5)
NED_FROM = {
    0x0: (0.0, HALF, HALF, 0.0),
    0x4: (1.0, 0.0, 0.0, 0.0),
    0x8: (0.0, 1.0, 0.0, 0.0),
}  # local frame: quaternion
UNKNOWN = (nan, nan, nan)


# --- receiver ---------------------------------------------------------------------------------------------------------


def utc_date(pvt: wire.Pvt) -> tuple[dt.date, int] | None:
    """Return date and milliseconds of the day of a solution; None where the receiver does not know them."""
    if pvt.valid & 3 != 3 or pvt.hour > 23 or pvt.minute > 59 or pvt.second > 60:
        return None
    try:
        date = dt.date(pvt.year, pvt.month, pvt.day)
    except ValueError:
        return None
    second = (pvt.hour * 60 + pvt.minute) * 60 + pvt.second
    return date, second * 1000 + round(pvt.nano_ns / MILLISECOND_NS)


def epoch_of(pvt: wire.Pvt) -> tuple[int | None, int, int | None]:
    """Return GPS week, time of week (ns) and leap seconds of a solution.

    The week is None without a date, the leap seconds where its two times do not imply whole ones. The fraction of a
    millisecond is that of UTC: the receiver's epochs may be half a millisecond off those of its time of week.
    """
    utc = utc_date(pvt)
    if utc is None:
        return None, pvt.itow_ms * MILLISECOND_NS, None
    date, of_day_ms = utc
    leap = leap_seconds_of(date, of_day_ms, pvt.itow_ms)
    days = (date - GPS_EPOCH).days
    week = round((days * DAY_MS + of_day_ms - pvt.itow_ms) / WEEK_MS)
    sub_ms_ns = pvt.nano_ns - round(pvt.nano_ns / MILLISECOND_NS) * MILLISECOND_NS
    week_ns = week * WEEK_NS + pvt.itow_ms * MILLISECOND_NS + (sub_ms_ns if leap is not None else 0)
    return *divmod(week_ns, WEEK_NS), leap


def gnss_fix(host_time_ns: int, pvt: wire.Pvt, week: int | None, time_ns: int, status_word: int) -> GnssFix | None:
    """Return the receiver's solution, without a position where it has none; None where a number is impossible."""
    lat_deg, lon_deg = pvt.lat_1e7_deg / 1e7, pvt.lon_1e7_deg / 1e7
    fix_type = FIX_TYPES.get(pvt.fix_type, FixType.NONE)
    there = fix_type is not FixType.NONE
    if there and (abs(lat_deg) > 90.0 or abs(lon_deg) > 180.0):
        return None
    if fix_type is FixType.SINGLE:
        plain = FixType.DIFFERENTIAL if pvt.flags & wire.DIFFERENTIAL else FixType.SINGLE
        fix_type = RTK_TYPES.get(status_word >> wire.RTK_SHIFT & wire.RTK_MASK, plain)
    level_m, up_m = pvt.horizontal_accuracy_mm / 1e3, pvt.vertical_accuracy_mm / 1e3
    speed_mps = pvt.speed_accuracy_mmps / 1e3
    return GnssFix(
        host_time_ns,
        TimeTag(TimeScale.GPS, time_ns, week=week),
        lat_rad=radians(lat_deg) if there else None,
        lon_rad=radians(lon_deg) if there else None,
        height_m=pvt.height_mm / 1e3 if there else None,
        velocity_l=(pvt.vel_n_mmps / 1e3, pvt.vel_e_mmps / 1e3, pvt.vel_d_mmps / 1e3) if there else None,
        position_cov_l=np.diag([level_m**2 / 2.0, level_m**2 / 2.0, up_m**2]) if there else None,
        velocity_cov_l=np.diag([speed_mps**2 / 2.0, speed_mps**2 / 2.0, speed_mps**2]) if there else None,
        fix_type=fix_type,
        satellites=pvt.satellites,
        valid=there and pvt.flags & wire.FIX_OK != 0,
        message="GnssPvtData",
        undulation_m=(pvt.height_mm - pvt.height_msl_mm) / 1e3 if there else None,
    )


def satellites_status(host_time_ns: int, item: tuple[object, ...]) -> DeviceStatus:
    """Return how many satellites the receiver tracks and uses, of a GnssSatInfo."""
    flags = [one[3] for one in item[1:] if isinstance(one, tuple)]
    used = sum(value & wire.SATELLITE_USED != 0 for value in flags)
    return DeviceStatus(
        host_time_ns, {"satellites_tracked": len(flags), "satellites_used": used}, message="GnssSatInfo"
    )


# --- the unit's own solution ------------------------------------------------------------------------------------------


def quaternion_of(roll: float, pitch: float, yaw: float) -> wire.Values:
    """Return the quaternion of angles in radians: first roll about x, then pitch about y, last yaw about z."""
    (cr, sr), (cp, sp), (cy, sy) = ((cos(angle / 2.0), sin(angle / 2.0)) for angle in (roll, pitch, yaw))
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def multiplied(first: wire.Values, second: wire.Values) -> wire.Values:
    """Return the product of two quaternions: the second rotation, then the first."""
    a, b, c, d = first
    w, x, y, z = second
    return (
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    )


def attitude_of(items: wire.Items, frames: dict[int, int]) -> tuple[float, float, float] | None:
    """Return roll, pitch and heading (rad) of the housing from north, east, down; None without an orientation."""
    if wire.QUATERNION in items:
        kind, quaternion = wire.QUATERNION, items[wire.QUATERNION]
    elif wire.EULER_ANGLES in items:
        roll, pitch, yaw = items[wire.EULER_ANGLES]
        kind, quaternion = wire.EULER_ANGLES, quaternion_of(radians(roll), radians(pitch), radians(yaw))
    else:
        return None
    turn = NED_FROM.get(frames[kind])
    length = hypot(*quaternion)
    if turn is None or not (isfinite(length) and length > 0.5):
        return None
    w, x, y, z = multiplied(turn, tuple(part / length for part in quaternion))
    return angles_of(w, x, y, z)


def velocity_of(items: wire.Items, frames: dict[int, int]) -> tuple[float, float, float] | None:
    """Return north, east, down (m/s); None without a velocity."""
    if wire.VELOCITY_XYZ not in items:
        return None
    x, y, z = items[wire.VELOCITY_XYZ]
    return {0x0: (y, x, -z), 0x4: (x, y, z), 0x8: (x, -y, -z)}.get(frames[wire.VELOCITY_XYZ])


def solution_row(host_time_ns: int, gps_ns: int, items: wire.Items, frames: dict[int, int], status: int) -> Row | None:
    """Return the unit's own solution; None where a number is impossible."""
    lat_deg, lon_deg = items[wire.LAT_LON]
    (height_m,) = items[wire.ALTITUDE_ELLIPSOID]
    velocity_l, attitude = velocity_of(items, frames), attitude_of(items, frames)
    if velocity_l is None or attitude is None:
        return None
    if not all(map(isfinite, (lat_deg, lon_deg, height_m, *velocity_l, *attitude))):
        return None
    if abs(lat_deg) > 90.0 or abs(lon_deg) > 180.0:
        return None
    place = (radians(lat_deg), radians(lon_deg), height_m)
    return Row(
        InsSolution,
        (host_time_ns, gps_ns, *place, velocity_l, *attitude, UNKNOWN, UNKNOWN, UNKNOWN, status),
    )


def is_whole(items: wire.Items) -> bool:
    """Return whether a message has a position, a velocity and an orientation."""
    oriented = wire.QUATERNION in items or wire.EULER_ANGLES in items
    return oriented and all(kind in items for kind in (wire.LAT_LON, wire.ALTITUDE_ELLIPSOID, wire.VELOCITY_XYZ))


def has_solution(items: wire.Items) -> bool:
    """Return whether the unit vouches for its solution: valid orientation, a fix, a filter with GNSS or coasting."""
    (status,) = items.get(wire.STATUS_WORD) or items.get(wire.STATUS_BYTE) or (0,)
    needed = wire.ORIENTATION_VALID | wire.GNSS_VALID
    filtered = wire.STATUS_WORD not in items or status & wire.FILTER_MODE != 0
    return status & needed == needed and filtered


def seconds_ns(utc: tuple[int, ...]) -> int:
    """Return nanoseconds of the UTC day of an UtcTime."""
    nanosecond, _, _, _, hour, minute, second, _ = utc
    return ((hour * 60 + minute) * 60 + second) * SECOND_NS + nanosecond
