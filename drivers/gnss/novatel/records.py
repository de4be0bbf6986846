"""Converts NovAtel logs to records: one function for each body, listed in `DECODERS`."""

from __future__ import annotations

import datetime as dt
from collections.abc import Callable
from dataclasses import dataclass, replace
from math import cos, isfinite, nan, radians, sin
from typing import Any, NamedTuple

import numpy as np

from swath.drivers.gnss.date_floor import GREATEST_WEEK, ReceiverDates, leap_seconds_of
from swath.drivers.gnss.novatel import layouts as nov
from swath.drivers.gnss.novatel import tables
from swath.drivers.parser import ParserCounters
from swath.drivers.record_rows import Row
from swath.georef.records import (
    DeviceStatus,
    EventMark,
    FixType,
    GnssFix,
    GnssHeading,
    ImuSamples,
    InsSolution,
    NamesEdge,
    Record,
    TimeMessage,
    TimeScale,
    TimeTag,
)
from swath.georef.timescales.gps_time import MILLISECOND_NS, SECOND_NS

WEEK_NS = 604_800 * SECOND_NS
GREATEST_PPS_ERROR_S = 1e-3  # a clock offset beyond this is not the offset of a steered PPS
GREATEST_LEAP_S = 255  # the navigation message has 8 bits
IMU_ERROR_BIT, IMU_ENCRYPTED_BIT = 1, 2  # bits of RAWIMUX's IMU info


class Header(NamedTuple):
    """Fields common to both headers, and the host time of the frame."""

    name: str
    host_time_ns: int
    week: int
    milliseconds: int
    time_status: int | None
    source: int
    floor_week: int = 0

    @property
    def before_floor(self) -> bool:
        """True if its week is known but before the floor, as from a receiver one roll-over behind."""
        return 0 < self.week < self.floor_week

    @property
    def time_valid(self) -> bool:
        """True if the receiver marks the time as valid; a short header has no status, so only its week counts."""
        known = is_week(self.week, self.floor_week)
        return known and (self.time_status is None or self.time_status in tables.TIME_VALID)

    def tag(self, earlier_ns: int = 0) -> TimeTag:
        """Return the header's GPS time less ``earlier_ns``."""
        return gps_tag(self.week, self.milliseconds * MILLISECOND_NS - earlier_ns, self.floor_week)


@dataclass(slots=True)
class State:
    """Holds the data that decoding needs besides the message.

    Attributes:
        counters: the parser's counters.
        dates: moves weeks by roll-overs and holds the oldest accepted week.
        configured_scale: IMU scale of the setting ``imu_type``.
        announced_scale: IMU scale of the last INSCONFIG.
    """

    counters: ParserCounters
    dates: ReceiverDates
    configured_scale: tables.ImuScale | None = None
    announced_scale: tables.ImuScale | None = None

    @property
    def floor_week(self) -> int:
        """Oldest accepted week."""
        return self.dates.floor_week

    def has_week(self, week: int) -> bool:
        """Return whether a solution's week is usable, and count those that are not."""
        known = is_week(week, self.floor_week)
        if not known:
            self.counters.errors["date_before_floor" if 0 < week < self.floor_week else "time_unknown"] += 1
        return known

    def time_counts(self, header: Header) -> bool:
        """Return whether a header's time is valid, and count weeks before the floor."""
        if header.before_floor:
            self.counters.errors["date_before_floor"] += 1
        return header.time_valid


def time_message(state: State, header: Header, time: nov.Time) -> list[Record | Row]:
    """Return the second of the edge in a TIME's header; the PPS is early by the amount that the receiver's clock is
    ahead.
    """
    if not state.has_week(header.week):
        return []
    says_leap = time.utc_status == tables.UTC_VALID and abs(time.utc_offset_s) < GREATEST_LEAP_S
    leap = round(-time.utc_offset_s) if says_leap else None
    implied = _leap_of_fields(header, time)
    if leap is not None and implied not in (None, leap):
        state.counters.errors["utc_contradicts_gps"] += 1
        leap = None
    steered = time.clock_status == tables.CLOCK_VALID and abs(time.clock_offset_s) < GREATEST_PPS_ERROR_S
    return [
        TimeMessage(
            host_time_ns=header.host_time_ns,
            time=replace(header.tag(), leap_seconds=leap),
            names_edge=NamesEdge.PREVIOUS,
            bound=True,
            valid=header.time_valid and time.clock_status == tables.CLOCK_VALID,
            quantisation_ns=-time.clock_offset_s * SECOND_NS if steered else 0.0,
            message=header.name,
        )
    ]


def _leap_of_fields(header: Header, time: nov.Time) -> int | None:
    """Return GPS − UTC as header and calendar fields of a TIME imply it; None where they do not."""
    try:
        date = dt.date(time.utc_year, time.utc_month, time.utc_day)
    except (ValueError, OverflowError):  # a year of 32 bits may exceed what a date's C integers hold
        return None
    of_day_ms = (time.utc_hour * 60 + time.utc_minute) * 60_000 + time.utc_ms
    return leap_seconds_of(date, of_day_ms, header.milliseconds)


def position_fix(state: State, header: Header, position: nov.BestPos) -> list[Record | Row]:
    """Return a fix with ellipsoidal height, the sum of the height above the geoid and the undulation."""
    there = position.position_type != tables.POSITION_NONE
    sigmas = (position.lat_sigma_m, position.lon_sigma_m, position.height_sigma_m)
    return [
        GnssFix(
            host_time_ns=header.host_time_ns,
            time=header.tag(),
            lat_rad=radians(position.lat_deg) if there else None,
            lon_rad=radians(position.lon_deg) if there else None,
            height_m=position.height_m + position.undulation_m if there else None,
            position_cov_l=np.diag(np.square(np.array(sigmas, np.float64))) if there else None,
            fix_type=tables.FIX_TYPES.get(position.position_type, FixType.NONE),
            satellites=position.satellites_used,
            antenna="secondary" if header.source == 1 else "primary",
            valid=state.time_counts(header) and there and position.solution_status == tables.SOL_COMPUTED,
            message=header.name,
            undulation_m=position.undulation_m if there else None,
        )
    ]


def velocity_fix(state: State, header: Header, velocity: nov.BestVel) -> list[Record | Row]:
    """Return a fix with the velocity, which is valid `latency_s` before the header's time (BESTVEL, field 4)."""
    track = radians(velocity.track_deg) if isfinite(velocity.track_deg) else nan
    north, east = velocity.horizontal_mps * cos(track), velocity.horizontal_mps * sin(track)
    there = velocity.velocity_type != tables.POSITION_NONE
    return [
        GnssFix(
            host_time_ns=header.host_time_ns,
            time=header.tag(earlier_ns=_nanoseconds(velocity.latency_s)),
            lat_rad=None,
            lon_rad=None,
            height_m=None,
            velocity_l=(north, east, -velocity.up_mps) if there else None,
            fix_type=tables.FIX_TYPES.get(velocity.velocity_type, FixType.NONE),
            antenna="secondary" if header.source == 1 else "primary",
            valid=state.time_counts(header) and there and velocity.solution_status == tables.SOL_COMPUTED,
            message=header.name,
        )
    ]


def ins_pva(state: State, header: Header, pva: nov.InsPva) -> list[Record | Row]:
    """Return a row with the log's own time, which is finer than the header's."""
    if not state.has_week(pva.week):
        return []
    time_ns = pva.week * WEEK_NS + _nanoseconds(pva.seconds)
    return _ins_row(header, time_ns, pva, pva.height_m, (nan,) * 9)


def ins_pvax(state: State, header: Header, pva: nov.InsPvax) -> list[Record | Row]:
    """Return a row with ellipsoidal height, the sum of height and undulation."""
    if not state.has_week(header.week):
        return []
    time_ns = header.week * WEEK_NS + header.milliseconds * MILLISECOND_NS
    attitude = (radians(pva.roll_sigma_deg), radians(pva.pitch_sigma_deg), radians(pva.azimuth_sigma_deg))
    return _ins_row(header, time_ns, pva, pva.height_m + pva.undulation_m, (*pva[12:18], *attitude))


def _ins_row(
    header: Header, time_ns: int, pva: nov.InsPva | nov.InsPvax, height_m: float, sigmas: tuple[float, ...]
) -> list[Record | Row]:
    """Return a row of `INS_DTYPE`; sigmas are those of position, velocity (m, m/s) and attitude (rad)."""
    values = (
        header.host_time_ns,
        time_ns,
        radians(pva.lat_deg),
        radians(pva.lon_deg),
        height_m,
        (pva.north_mps, pva.east_mps, -pva.up_mps),
        *_attitude(pva),
        sigmas[0:3],
        sigmas[3:6],
        sigmas[6:9],
        pva.ins_status,
    )
    return [Row(InsSolution, values)]


def ins_attitude(state: State, header: Header, attitude: nov.InsAtt | nov.InsAttx) -> list[Record | Row]:
    """Return a row with the attitude only; its position and velocity are nan."""
    week = attitude.week if isinstance(attitude, nov.InsAtt) else header.week
    if not state.has_week(week):
        return []
    if isinstance(attitude, nov.InsAtt):
        time_ns = attitude.week * WEEK_NS + _nanoseconds(attitude.seconds)
        sigmas = (nan, nan, nan)
    else:
        time_ns = header.week * WEEK_NS + header.milliseconds * MILLISECOND_NS
        degrees = (attitude.roll_sigma_deg, attitude.pitch_sigma_deg, attitude.azimuth_sigma_deg)
        sigmas = (radians(degrees[0]), radians(degrees[1]), radians(degrees[2]))
    none = (nan, nan, nan)
    where = (header.host_time_ns, time_ns, *none, none)
    return [Row(InsSolution, (*where, *_attitude(attitude), none, none, sigmas, attitude.ins_status))]


def raw_imu(state: State, header: Header, imu: nov.RawImu | nov.RawImux) -> list[Record | Row]:
    """Convert counts to rates: a sample's increments times the IMU's rate; the wire has the axes z, −y, x."""
    scale = state.configured_scale or state.announced_scale
    if isinstance(imu, nov.RawImux):
        scale = state.configured_scale or tables.IMU_SCALES.get(imu.imu_type)
        if imu.imu_info & IMU_ERROR_BIT:
            state.counters.errors["imu_error"] += 1
        if imu.imu_info & IMU_ENCRYPTED_BIT:  # "should not be used": not valid counts
            state.counters.errors["imu_encrypted"] += 1
            return []
    if scale is None:
        state.counters.errors["imu_scale_unknown"] += 1
        return []
    week = state.dates.week(imu.week, header.host_time_ns)
    force, rate = scale.mps_per_count * scale.rate_hz, scale.rad_per_count * scale.rate_hz
    values = (
        header.host_time_ns,
        _nanoseconds(imu.seconds),
        -1,
        (imu.accel_x * force, -imu.accel_minus_y * force, imu.accel_z * force),
        (imu.gyro_x * rate, -imu.gyro_minus_y * rate, imu.gyro_z * rate),
        nan,
        imu.imu_status,
        week if is_week(week, state.floor_week) else -1,
    )
    return [Row(ImuSamples, values)]


def corrected_imu(state: State, header: Header, imu: nov.CorrImu | nov.CorrImuData) -> list[Record | Row]:
    """Return increments since the last log in forward, right, down; gravity is removed, so they are not specific
    force.
    """
    values: dict[str, float | int | str | bool] = {
        "delta_angle_x_rad": imu.roll_rad,
        "delta_angle_y_rad": imu.pitch_rad,
        "delta_angle_z_rad": -imu.yaw_rad,
        "delta_velocity_x_mps": imu.longitudinal_mps,
        "delta_velocity_y_mps": imu.lateral_mps,
        "delta_velocity_z_mps": -imu.vertical_mps,
        "gps_week": header.week,
        "time_of_week_s": header.milliseconds / 1000.0,
    }
    if isinstance(imu, nov.CorrImu):
        values["imu_samples"] = imu.imu_samples
    else:
        values |= {"gps_week": imu.week, "time_of_week_s": imu.seconds}
    return [DeviceStatus(header.host_time_ns, values, message=header.name)]


def event_mark(state: State, header: Header, mark: nov.MarkTime) -> list[Record | Row]:
    """Return a mark with GPS time: the receiver's time less its clock's offset (MARKxTIME, fields 3 and 4).

    The mark belongs to the pulse's leading edge, the falling one unless MARKCONTROL was set otherwise; no log shows it.
    """
    week = state.dates.week(mark.week, header.host_time_ns)
    return [
        EventMark(
            host_time_ns=header.host_time_ns,
            time=gps_tag(week, _nanoseconds(mark.seconds) - _nanoseconds(mark.clock_offset_s), state.floor_week),
            channel=nov.MARK_CHANNELS[header.name],
            rising=None,
            sigma_s=mark.clock_offset_sigma_s,
            valid=state.time_counts(header) and mark.clock_status == tables.CLOCK_VALID,
            message=header.name,
        )
    ]


def baseline_heading(state: State, header: Header, heading: nov.Heading2 | nov.Heading) -> list[Record | Row]:
    """Return the heading from the master antenna to the rover's."""
    there = heading.position_type != tables.POSITION_NONE
    return [
        GnssHeading(
            host_time_ns=header.host_time_ns,
            time=header.tag(),
            heading_rad=radians(heading.heading_deg),
            pitch_rad=radians(heading.pitch_deg),
            baseline_m=heading.baseline_m if heading.baseline_m > 0.0 else None,
            heading_sigma_rad=radians(heading.heading_sigma_deg),
            pitch_sigma_rad=radians(heading.pitch_sigma_deg),
            valid=state.time_counts(header) and there and heading.solution_status == tables.SOL_COMPUTED,
            message=header.name,
        )
    ]


def ins_config(state: State, header: Header, config: nov.InsConfig) -> list[Record | Row]:
    """Note the connected IMU's scale for raw logs that do not name the IMU."""
    state.announced_scale = tables.IMU_SCALES.get(config.imu_type)
    return []


def is_week(week: int, floor_week: int) -> bool:
    """Return whether a message has a week that is accepted."""
    return max(1, floor_week) <= week <= GREATEST_WEEK


def gps_tag(week: int, time_ns: int, floor_week: int) -> TimeTag:
    """Return GPS time of week, carried over the week's end; the week is None where the receiver has no accepted one."""
    weeks, time_ns = divmod(time_ns, WEEK_NS)
    return TimeTag(TimeScale.GPS, time_ns, week=week + weeks if is_week(week, floor_week) else None)


def _nanoseconds(seconds: float) -> int:
    """Return the nearest nanosecond, 0 for a value out of range or not a number."""
    return round(seconds * SECOND_NS) if abs(seconds) < 1e9 else 0


def _attitude(row: nov.InsPva | nov.InsPvax | nov.InsAtt | nov.InsAttx) -> tuple[float, float, float]:
    """Return roll, pitch and heading by the definitions of CONVENTIONS.

    SPAN's frame is x right, y forward, z up: its roll about y and its pitch about x are right-handed, its azimuth is
    clockwise from north; so right wing down, nose up and heading are positive, as here.
    """
    return radians(row.roll_deg), radians(row.pitch_deg), radians(row.azimuth_deg)


DECODERS: dict[type[nov.Body], Callable[[State, Header, Any], list[Record | Row]]] = {
    nov.Time: time_message,
    nov.BestPos: position_fix,
    nov.BestVel: velocity_fix,
    nov.InsPva: ins_pva,
    nov.InsPvax: ins_pvax,
    nov.InsAtt: ins_attitude,
    nov.InsAttx: ins_attitude,
    nov.RawImu: raw_imu,
    nov.RawImux: raw_imu,
    nov.CorrImu: corrected_imu,
    nov.CorrImuData: corrected_imu,
    nov.MarkTime: event_mark,
    nov.Heading2: baseline_heading,
    nov.Heading: baseline_heading,
    nov.InsConfig: ins_config,
}
