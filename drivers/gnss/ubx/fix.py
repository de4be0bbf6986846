"""Merges the NAV messages of an epoch into one `GnssFix`."""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np

from swath.drivers.gnss.ubx import messages as ubx
from swath.georef.arrays import FloatArray
from swath.georef.records import FixType, GnssFix, TimeScale, TimeTag

NavMessage: TypeAlias = ubx.NavPvt | ubx.NavHpposllh | ubx.NavCov | ubx.NavTimegps
Position: TypeAlias = tuple[float, float, float, FloatArray]

MS_NS = 1_000_000
WEEK_NS = 604_800_000_000_000

# NAV-PVT fixType: 0 none, 1 dead reckoning, 2 2D, 3 3D, 4 GNSS + dead reckoning, 5 time only, at a fixed position
FIX_NONE = 0
SPECIAL_TYPES = {FIX_NONE: FixType.NONE, 1: FixType.DEAD_RECKONING, 5: FixType.MANUAL}
CARRIER_SHIFT = 6  # flags bits 6 and 7: 1 float, 2 fixed
CARRIER_TYPES = {1: FixType.RTK_FLOAT, 2: FixType.RTK_FIXED}


def merge_epoch(parts: dict[str, tuple[int, NavMessage]], floor_week: int) -> GnssFix | None:
    """Merge an epoch's messages into a fix; return None where it has neither NAV-PVT nor NAV-HPPOSLLH."""
    _, pvt = parts.get("NAV-PVT", (0, None))
    _, high = parts.get("NAV-HPPOSLLH", (0, None))
    _, cov = parts.get("NAV-COV", (0, None))
    _, time = parts.get("NAV-TIMEGPS", (0, None))
    pvt = pvt if isinstance(pvt, ubx.NavPvt) else None
    high = high if isinstance(high, ubx.NavHpposllh) and not high.flags & 1 else None
    cov = cov if isinstance(cov, ubx.NavCov) else None
    time = time if isinstance(time, ubx.NavTimegps) else None
    if pvt is None and high is None:
        return None
    host_time_ns = parts["NAV-PVT" if pvt is not None else "NAV-HPPOSLLH"][0]
    itow_ms = pvt.itow_ms if pvt is not None else high.itow_ms if high is not None else 0
    position = _position(pvt, high)
    return GnssFix(
        host_time_ns=host_time_ns,
        time=_epoch_tag(itow_ms, pvt, time, floor_week),
        lat_rad=position[0] if position else None,
        lon_rad=position[1] if position else None,
        height_m=position[2] if position else None,
        velocity_l=_velocity(pvt),
        position_cov_l=_position_cov(position, cov),
        velocity_cov_l=_velocity_cov(pvt, cov),
        fix_type=_fix_type(pvt),
        satellites=pvt.satellites & 0x7F if pvt is not None else None,  # M8P firmware sets the highest bit
        valid=position is not None and (pvt is None or pvt.flags & ubx.PVT_FIX_OK != 0),
        message="NAV-PVT" if pvt is not None else "NAV-HPPOSLLH",
        undulation_m=_undulation_m(pvt, high) if position else None,
    )


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


def _position(pvt: ubx.NavPvt | None, high: ubx.NavHpposllh | None) -> Position | None:
    """Return latitude, longitude (rad), ellipsoidal height (m) and the covariance from the accuracies."""
    if high is not None:
        return (
            math.radians((high.lat_1e7_deg * 100 + high.lat_hp_1e9_deg) / 1e9),
            math.radians((high.lon_1e7_deg * 100 + high.lon_hp_1e9_deg) / 1e9),
            (high.height_mm * 10 + high.height_hp_tenth_mm) / 1e4,
            _accuracy_cov(high.horizontal_accuracy_tenth_mm / 1e4, high.vertical_accuracy_tenth_mm / 1e4),
        )
    if pvt is None or pvt.fix_type == FIX_NONE or pvt.flags3 & ubx.PVT_INVALID_POSITION:
        return None
    return (
        math.radians(pvt.lat_1e7_deg / 1e7),
        math.radians(pvt.lon_1e7_deg / 1e7),
        pvt.height_mm / 1e3,
        _accuracy_cov(pvt.horizontal_accuracy_mm / 1e3, pvt.vertical_accuracy_mm / 1e3),
    )


def _undulation_m(pvt: ubx.NavPvt | None, high: ubx.NavHpposllh | None) -> float | None:
    """Return the geoid's height above the ellipsoid: ellipsoidal height less height above mean sea level, m."""
    best = high if high is not None else pvt
    return None if best is None else (best.height_mm - best.height_msl_mm) / 1e3


def _accuracy_cov(horizontal: float, vertical: float) -> FloatArray:
    """Return the covariance of accuracies, m or m/s; the horizontal one covers both axes together, hAcc² = NN + EE."""
    return np.diag([horizontal**2 / 2.0, horizontal**2 / 2.0, vertical**2])


def _symmetric(nn: float, ne: float, nd: float, ee: float, ed: float, dd: float) -> FloatArray:
    return np.array([[nn, ne, nd], [ne, ee, ed], [nd, ed, dd]])


def _position_cov(position: Position | None, cov: ubx.NavCov | None) -> FloatArray | None:
    if cov is not None and cov.position_valid:
        return _symmetric(cov.pos_nn, cov.pos_ne, cov.pos_nd, cov.pos_ee, cov.pos_ed, cov.pos_dd)
    return position[3] if position is not None else None


def _velocity(pvt: ubx.NavPvt | None) -> tuple[float, float, float] | None:
    if pvt is None or pvt.fix_type == FIX_NONE:
        return None
    return pvt.vel_n_mmps / 1e3, pvt.vel_e_mmps / 1e3, pvt.vel_d_mmps / 1e3


def _velocity_cov(pvt: ubx.NavPvt | None, cov: ubx.NavCov | None) -> FloatArray | None:
    """Return NAV-COV's covariance, else one from the speed accuracy: compared with NAV-COV, sAcc² is close to NN + EE
    and to DD.
    """
    if cov is not None and cov.velocity_valid:
        return _symmetric(cov.vel_nn, cov.vel_ne, cov.vel_nd, cov.vel_ee, cov.vel_ed, cov.vel_dd)
    if pvt is None or _velocity(pvt) is None:
        return None
    speed_mps = pvt.speed_accuracy_mmps / 1e3
    return _accuracy_cov(speed_mps, speed_mps)


def _fix_type(pvt: ubx.NavPvt | None) -> FixType:
    """Return the fix type; a NAV-HPPOSLLH alone shows only that a position exists."""
    if pvt is None:
        return FixType.SINGLE
    if pvt.fix_type in SPECIAL_TYPES:
        return SPECIAL_TYPES[pvt.fix_type]
    plain = FixType.DIFFERENTIAL if pvt.flags & ubx.PVT_DIFFERENTIAL else FixType.SINGLE
    return CARRIER_TYPES.get(pvt.flags >> CARRIER_SHIFT, plain)
