"""NovAtel logs of the virtual receiver: TIME, BESTPOS, BESTVEL, HEADING2, INSPVAS, INSPVAX (OEM7 manual)."""

from __future__ import annotations

import math

import numpy as np

from swath.drivers.gnss.novatel import layouts as nov
from swath.drivers.gnss.novatel.encoder import encode_log
from swath.drivers.gnss.novatel.tables import CLOCK_VALID, POSITION_NONE, SOL_COMPUTED, UTC_VALID
from swath.georef.records import FixType
from swath.sim.gnss.calendar import Calendar
from swath.sim.gnss.pulse import Pulse
from swath.sim.gnss.receiver import Epochs, InsEpochs
from swath.sim.plan.tables import GnssTable

INSUFFICIENT_OBSERVATIONS = 1  # solution status
NONE, SINGLE, FLOAT, FIXED = int(FixType.NONE), int(FixType.SINGLE), int(FixType.RTK_FLOAT), int(FixType.RTK_FIXED)
POSITION_TYPES = {NONE: POSITION_NONE, SINGLE: 16, FLOAT: 34, FIXED: 50}  # SINGLE, NARROW_FLOAT, NARROW_INT
INS_TYPES = {NONE: 53, SINGLE: 53, FLOAT: 55, FIXED: 56}  # INS_PSRSP, INS_RTKFLOAT, INS_RTKFIXED
HEADING_TYPES = {NONE: POSITION_NONE, SINGLE: 50, FLOAT: 34, FIXED: 50}  # the baseline's own ambiguities
INS_HIGH_VARIANCE, INS_SOLUTION_GOOD = 2, 3
INS_GOOD_S = 10.0  # longest time without satellites for a good solution
WGS84_DATUM = 61
STATION = b"BASE"
DIFFERENTIAL_AGE_S = 1.0
CLOCK_SIGMA_S = 2e-9


class NovatelMessages:
    """Encodes the NovAtel logs of an epoch.

    Args:
        table: of the receiver.
        calendar: of the plan.
        pulse: the edges that the receiver drives.
    """

    def __init__(self, table: GnssTable, calendar: Calendar, pulse: Pulse) -> None:
        self._calendar, self._pulse = calendar, pulse
        self._undulation_m = float(np.float32(table.undulation_m))  # BESTPOS rounds so; height + undulation stays exact
        second = table.secondary_lever_arm_m
        self._baseline_m = math.dist(second, table.lever_arm_m) if second is not None else None

    def epoch(self, epochs: Epochs, row: int) -> list[bytes]:
        """Return TIME on whole seconds, BESTPOS, BESTVEL, and HEADING2 with a second antenna."""
        stamp = self._calendar.at(float(epochs.time_s[row]))
        logs: list[tuple[str, nov.Body]] = []
        if stamp.second is not None:
            logs.append(("TIME", self._time(float(epochs.time_s[row]), stamp.second)))
        logs += [("BESTPOS", self._position(epochs, row)), ("BESTVEL", _velocity(epochs, row))]
        if self._baseline_m is not None:
            logs.append(("HEADING2", _heading(epochs, row, self._baseline_m)))
        return [encode_log(name, body, stamp.week, stamp.tow_ms) for name, body in logs]

    def ins_epoch(self, ins: InsEpochs, row: int) -> list[bytes]:
        """Return the log INSPVAS, and on whole seconds INSPVAX too."""
        stamp = self._calendar.at(float(ins.time_s[row]))
        status = INS_SOLUTION_GOOD if ins.since_update_s[row] <= INS_GOOD_S else INS_HIGH_VARIANCE
        lat, lon = math.degrees(ins.lat_rad[row]), math.degrees(ins.lon_rad[row])
        north, east, down = map(float, ins.velocity_l[row])
        roll, pitch, azimuth = map(math.degrees, ins.attitude_rad[row])
        motion = (north, east, -down, roll, pitch, azimuth)
        height = float(ins.height_m[row])
        short = nov.InsPva(stamp.week, stamp.tow_ms / 1000.0, lat, lon, height, *motion, status)
        logs = [encode_log("INSPVAS", short, stamp.week, stamp.tow_ms)]
        if stamp.second is not None:
            where = (lat, lon, height - self._undulation_m, self._undulation_m)
            since_s = int(ins.since_update_s[row])
            fix = INS_TYPES[int(ins.fix[row])]
            body = nov.InsPvax(status, fix, *where, *motion, *_ins_sigmas(ins, row), 0, since_s)
            logs.append(encode_log("INSPVAX", body, stamp.week, stamp.tow_ms))
        return logs

    def _time(self, time_s: float, second: int) -> nov.Time:
        """Return the TIME log of the edge just past; the pulse is early by the lead of the receiver's clock."""
        stamp = self._calendar.at(time_s)
        hour, minute, ms = stamp.clock
        return nov.Time(
            clock_status=CLOCK_VALID,
            clock_offset_s=-self._pulse.late_s(second),
            clock_offset_sigma_s=CLOCK_SIGMA_S,
            utc_offset_s=-float(self._calendar.leap_seconds),
            utc_year=stamp.date.year,
            utc_month=stamp.date.month,
            utc_day=stamp.date.day,
            utc_hour=hour,
            utc_minute=minute,
            utc_ms=ms,
            utc_status=UTC_VALID,
        )

    def _position(self, epochs: Epochs, row: int) -> nov.BestPos:
        fix, satellites = int(epochs.fix[row]), int(epochs.satellites[row])
        differential = fix in (FLOAT, FIXED)
        there = fix != NONE
        north, east, down = map(float, epochs.position_sigma_l[row]) if there else (0.0, 0.0, 0.0)
        return nov.BestPos(
            solution_status=SOL_COMPUTED if there else INSUFFICIENT_OBSERVATIONS,
            position_type=POSITION_TYPES[fix],
            lat_deg=math.degrees(epochs.lat_rad[row]) if there else 0.0,
            lon_deg=math.degrees(epochs.lon_rad[row]) if there else 0.0,
            height_m=float(epochs.height_m[row]) - self._undulation_m if there else 0.0,
            undulation_m=self._undulation_m if there else 0.0,
            datum=WGS84_DATUM,
            lat_sigma_m=north,
            lon_sigma_m=east,
            height_sigma_m=down,
            station=STATION if differential else b"",
            differential_age_s=DIFFERENTIAL_AGE_S if differential else 0.0,
            solution_age_s=0.0,
            satellites_tracked=satellites + 2 if there else 0,
            satellites_used=satellites,
            satellites_l1=satellites,
            satellites_multi=satellites,
            reserved=0,
            extended_status=0,
            galileo_beidou_mask=0,
            gps_glonass_mask=0,
        )


def _velocity(epochs: Epochs, row: int) -> nov.BestVel:
    fix = int(epochs.fix[row])
    if fix == NONE:
        return nov.BestVel(INSUFFICIENT_OBSERVATIONS, POSITION_NONE, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    north, east, down = map(float, epochs.velocity_l[row])
    return nov.BestVel(
        solution_status=SOL_COMPUTED,
        velocity_type=POSITION_TYPES[fix],
        latency_s=float(epochs.velocity_age_s[row]),
        differential_age_s=0.0 if fix == SINGLE else DIFFERENTIAL_AGE_S,
        horizontal_mps=math.hypot(north, east),
        track_deg=math.degrees(math.atan2(east, north)) % 360.0,
        up_mps=-down,
        reserved=0.0,
    )


def _heading(epochs: Epochs, row: int, baseline_m: float) -> nov.Heading2:
    """Return the HEADING2 log; master and rover are the primary and the secondary antenna."""
    fix, satellites = int(epochs.fix[row]), int(epochs.satellites[row])
    there = fix != NONE
    return nov.Heading2(
        solution_status=SOL_COMPUTED if there else INSUFFICIENT_OBSERVATIONS,
        position_type=HEADING_TYPES[fix],
        baseline_m=baseline_m if there else -1.0,
        heading_deg=math.degrees(epochs.heading_rad[row]) if there else 0.0,
        pitch_deg=math.degrees(epochs.pitch_rad[row]) if there else 0.0,
        reserved_1=0.0,
        heading_sigma_deg=math.degrees(epochs.heading_sigma_rad[row]) if there else 0.0,
        pitch_sigma_deg=math.degrees(epochs.pitch_sigma_rad[row]) if there else 0.0,
        rover_station=b"SECD",
        master_station=b"PRIM",
        satellites_tracked=satellites,
        satellites_used=satellites,
        satellites_observed=satellites,
        satellites_multi=satellites,
        solution_source=0,
        extended_status=0,
        galileo_beidou_mask=0,
        gps_glonass_mask=0,
    )


def _ins_sigmas(ins: InsEpochs, row: int) -> tuple[float, float, float, float, float, float, float, float, float]:
    """Return the sigmas of position, velocity, and of attitude in degrees."""
    north_m, east_m, down_m = map(float, ins.position_sigma_l[row])
    north_mps, east_mps, down_mps = map(float, ins.velocity_sigma_l[row])
    roll, pitch, heading = map(math.degrees, ins.attitude_sigma_rad[row])
    return north_m, east_m, down_m, north_mps, east_mps, down_mps, roll, pitch, heading
