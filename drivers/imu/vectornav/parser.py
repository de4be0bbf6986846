"""VectorNav VN-100, 200, 300 and VN-x10: binary output messages with any groups and fields, over serial or Ethernet.

Sources: VectorNav's VN-300 user manual UM005 (5.2 to 5.8) and SDK 0.99 (``CompositeData.hpp``,
``MeasurementDatatypes.hpp``, ``Registers.hpp``). Every value of three recordings of a VN-310 is compared with what the
program INSTINCT of the University of Stuttgart decoded in them.

- Axes: the body's, x forward, y right, z down; yaw, pitch and roll turn it from north, east, down in the order 3-2-1.
  These are Swath's axes and angles. At rest and level the accelerometer's z is negative: it measures specific force.
- Samples: UncompAccel and UncompGyro, else Accel and AngularRate, from which the device has subtracted the biases of
  its own filter. With ``sample = "increment"``: DeltaVel and DeltaTheta, divided by their own interval.
- Time of samples: GPS time while the device vouches for it; with ``pps`` in the configuration its counter TimeStartup,
  beside the counter at the latest pulse on SyncIn, else at that of its own receiver (TimeSyncIn, TimeGpsPps).
- Uncertainties of INS position and velocity are one number each: it is taken as the sigma of each axis.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import isfinite, nan, radians
from typing import Any, TypeAlias

import numpy as np

from swath.drivers.driver import STREAM_TRANSPORTS, Driver, receiver_inside, times_only
from swath.drivers.framing.framer import Frame
from swath.drivers.framing.kinds import NMEA
from swath.drivers.framing.parser import FramedParser
from swath.drivers.imu.attitude import angles_of
from swath.drivers.imu.unit_time import WEEK_NS, Moment, UnitTime
from swath.drivers.imu.vectornav.startup import receiver_startup_messages, startup_messages
from swath.drivers.imu.vectornav.wire import VECTORNAV, read_values
from swath.drivers.parser import DeviceSettings
from swath.drivers.record_rows import Row
from swath.georef.records import (
    DeviceStatus,
    FixType,
    GnssFix,
    ImuSamples,
    InsSolution,
    NamesEdge,
    Record,
    TimeMessage,
    TimeTag,
)

Items: TypeAlias = list[Record | Row]
Values: TypeAlias = dict[str, tuple[Any, ...]]

TIME_KNOWN = 0x03  # time status, receiver's time info: time of week and date; the next bit: UTC
UTC_KNOWN = 0x04
INS_MODE = 0x03
INS_HAS_FIX = 0x04
INS_STATUS_BITS = 0x0377  # without the reserved bits, which toggle
NOT_TRACKING = 0
IMU_STATUS_SHIFT = 16  # status of a sample: saturation in the low bits, IMU status above
STATUS_KEYS = ("ins_status", "imu_status", "saturation", "vpe_status", "time_status", "gnss1.status", "gnss2.status")
# GPS fix of the manual and of the SDK (``Gnss1Fix``); 5 and 6 are RTK in the manual of VN-310 by INSTINCT
FIX_TYPES = {
    2: FixType.SINGLE,
    3: FixType.SINGLE,
    4: FixType.DIFFERENTIAL,
    5: FixType.RTK_FLOAT,
    6: FixType.RTK_FIXED,
    7: FixType.RTK_FLOAT,
    8: FixType.RTK_FIXED,
}
ANTENNAS = {"gnss1": "primary", "gnss2": "secondary"}  # a third receiver has no lever arm in Swath
MEASURED = (("uncomp_accel", "uncomp_gyro"), ("accel", "angular_rate"))


@dataclass(slots=True)
class _Epochs:
    """The latest values of which only changes become records."""

    fixes: dict[str, tuple[Any, ...]] = field(default_factory=dict)
    status: tuple[Any, ...] = ()
    startup_ns: int = 0
    leap_seconds: int | None = None


class VectornavParser(FramedParser):
    """Decodes binary output messages; ASCII messages between them are framed and counted.

    Args:
        settings: of the device's table, ``sample`` and ``pps`` are read.
        wanted: the record types to return; None: all.
    """

    def __init__(self, settings: DeviceSettings, *, wanted: tuple[type, ...] | None = None) -> None:
        super().__init__((VECTORNAV, NMEA), wanted)
        self._source = settings.source
        self._increments = settings.config.get("sample") == "increment"
        self._by_counter = settings.config.get("pps") is not None
        self._time = UnitTime(settings, self.counters, "TimeGps")
        self._latest = _Epochs()
        self._compensated = False

    def remarks(self) -> list[str]:
        """Return a remark where the samples have the device's own biases subtracted."""
        if not self._compensated:
            return []
        return [
            f"{self._source}: sends Accel and AngularRate only, from which its own filter's biases are subtracted; "
            "output UncompAccel and UncompGyro"
        ]

    def decode_frames(self, frames: list[Frame]) -> Items:
        """Decode consecutive frames; return their records, or rows of them, in order."""
        items: Items = []
        for kind, host_time_ns, data in frames:
            if kind == VECTORNAV.name:
                items += self._decode(host_time_ns, read_values(data))
        return items

    def _decode(self, host_time_ns: int, values: Values) -> Items:
        moment = self._moment(values)
        items: Items = [*self._time.name_second(host_time_ns, moment, self._latest.leap_seconds)]
        if self._wanted == (TimeMessage,):
            return items
        for receiver in ANTENNAS:
            items += self._fix(host_time_ns, receiver, values)
        return [
            *items,
            *self._sample(host_time_ns, values, moment),
            *self._solution(host_time_ns, values, moment),
            *self._status(host_time_ns, values),
        ]

    # --- time ---

    def _moment(self, values: Values) -> Moment | None:
        """Return the message's GPS time; None where it has none or an impossible one."""
        if "gps_tow" in values and "gps_week" in values:
            week, tow_ns = values["gps_week"][0], values["gps_tow"][0]
        elif "time_gps" in values:
            week, tow_ns = divmod(values["time_gps"][0], WEEK_NS)
        else:
            return None
        status, leap_seconds = values.get("gnss1.time_info", (0, 0))
        if status & UTC_KNOWN:
            self._latest.leap_seconds = leap_seconds
        return self._time.moment(week, tow_ns, valid=_vouched(values))

    # --- samples ---

    def _sample(self, host_time_ns: int, values: Values, moment: Moment | None) -> Items:
        found = self._increment(values) if self._increments else self._measurement(values)
        if found is None:
            return []
        force, rate = found
        if not all(map(isfinite, (*force, *rate))):
            self.counters.count_bad("bad_value")
            return []
        startup_ns = values.get("time_startup", (-1,))[0]
        device_ns, pps_ns, week = -1, -1, -1
        if moment is not None and moment.valid and not self._by_counter:
            device_ns, week = moment.tow_ns, moment.week
        elif 0 <= startup_ns < 1 << 63:
            device_ns, pps_ns = startup_ns, latched_ns(startup_ns, values)
            if startup_ns < self._latest.startup_ns:
                self.counters.errors["restart"] += 1
            self._latest.startup_ns = startup_ns
        status = values.get("saturation", (0,))[0] | values.get("imu_status", (0,))[0] << IMU_STATUS_SHIFT
        (celsius,) = values.get("temperature", (nan,))
        return [Row(ImuSamples, (host_time_ns, device_ns, pps_ns, force, rate, celsius, status, week))]

    def _measurement(self, values: Values) -> tuple[Any, Any] | None:
        """Return specific force and rate, uncompensated ones first; a half of them is counted."""
        for force, rate in MEASURED:
            if force in values and rate in values:
                self._compensated |= force == "accel"
                return values[force], values[rate]
        if any(name in values for pair in MEASURED for name in pair):
            self.counters.errors["sample_incomplete"] += 1
        elif "delta_vel" in values:
            self.counters.errors["increments_only"] += 1
        return None

    def _increment(self, values: Values) -> tuple[Any, Any] | None:
        """Return increments divided by their interval; angles come in degrees."""
        if "delta_theta" not in values or "delta_vel" not in values:
            if "delta_theta" in values or "delta_vel" in values:
                self.counters.errors["sample_incomplete"] += 1
            elif any(name in values for pair in MEASURED for name in pair):
                self.counters.errors["rates_only"] += 1
            return None
        interval_s, *angles = values["delta_theta"]
        if not interval_s > 0.0:
            return (nan,) * 3, (nan,) * 3
        force = tuple(velocity / interval_s for velocity in values["delta_vel"])
        return force, tuple(radians(angle) / interval_s for angle in angles)

    # --- solutions ---

    def _fix(self, host_time_ns: int, receiver: str, values: Values) -> Items:
        """Return the receiver's position, once for each of its epochs."""
        position, fix = values.get(f"{receiver}.pos_lla"), values.get(f"{receiver}.fix")
        if position is None or fix is None:
            return []
        tag = self._fix_time(receiver, values)
        if tag is None:
            self.counters.errors["time_unknown"] += 1
            return []
        epoch = (tag.week, tag.time_ns, *position)
        if self._latest.fixes.get(receiver) == epoch:
            return []
        self._latest.fixes[receiver] = epoch
        return [gnss_fix(host_time_ns, receiver, tag, values)]

    def _fix_time(self, receiver: str, values: Values) -> TimeTag | None:
        tow_ns, week = values.get(f"{receiver}.tow"), values.get(f"{receiver}.week")
        moment = None if tow_ns is None or week is None else self._time.moment(week[0], tow_ns[0], valid=True)
        if moment is None:
            return None
        status, leap = values.get(f"{receiver}.time_info", (0, 0))
        return replace(moment.tag, leap_seconds=leap if status & UTC_KNOWN else None)

    def _solution(self, host_time_ns: int, values: Values, moment: Moment | None) -> Items:
        angles = attitude(values)
        if "pos_lla" not in values or angles is None:
            return []
        status = values.get("ins_status", (0,))[0]
        if "ins_status" in values and status & INS_MODE == NOT_TRACKING:
            self.counters.errors["ins_no_solution"] += 1
            return []
        if moment is None or not moment.valid:
            self.counters.errors["time_unknown"] += 1
            return []
        latitude, longitude, height = values["pos_lla"]
        velocity = values.get("vel_ned", (nan,) * 3)
        if not all(map(isfinite, (latitude, longitude, height, *angles))):
            self.counters.count_bad("bad_value")
            return []
        yaw_sigma, pitch_sigma, roll_sigma = map(radians, values.get("ypr_sigma", (nan,) * 3))
        row = (
            host_time_ns,
            moment.gps_ns,
            *(radians(latitude), radians(longitude), height),
            velocity,
            *angles,
            values.get("pos_sigma", (nan,)) * 3,
            values.get("vel_sigma", (nan,)) * 3,
            (roll_sigma, pitch_sigma, yaw_sigma),
            status,
        )
        return [Row(InsSolution, row)]

    def _status(self, host_time_ns: int, values: Values) -> Items:
        """Return the status words of a message where any of them has changed."""
        words = {key.replace(".", "_"): values[key][0] for key in STATUS_KEYS if key in values}
        if "ins_status" in words:
            words["ins_status"] &= INS_STATUS_BITS
        state = tuple(words.items())
        if not words or state == self._latest.status:
            return []
        self._latest.status = state
        if "ins_status" in words:
            words["ins_mode"] = words["ins_status"] & INS_MODE
        if "sync_in_count" in values:
            words["sync_in_count"] = values["sync_in_count"][0]
        return [DeviceStatus(host_time_ns, words, message="status")]


def _vouched(values: Values) -> bool:
    """Return whether the device knows GPS time: by its time status, else by the fix of the INS or of its receiver."""
    if "time_status" in values:
        return bool(values["time_status"][0] & TIME_KNOWN == TIME_KNOWN)
    if "ins_status" in values:
        return bool(values["ins_status"][0] & INS_HAS_FIX)
    return bool(values.get("gnss1.time_info", (0,))[0] & TIME_KNOWN == TIME_KNOWN)


def latched_ns(startup_ns: int, values: Values) -> int:
    """Return the counter at the latest pulse on SyncIn, else of the device's own receiver; −1 without one.

    Before the first pulse the time since it equals the counter.
    """
    for name in ("time_sync_in", "time_gps_pps"):
        (since_ns,) = values.get(name, (startup_ns,))
        if 0 <= since_ns < startup_ns:
            return int(startup_ns - since_ns)
    return -1


def attitude(values: Values) -> tuple[float, float, float] | None:
    """Return roll, pitch and heading in radians of the angles, else of the quaternion (scalar last, from body to
    north, east, down); None without either.
    """
    if "yaw_pitch_roll" in values:
        yaw, pitch, roll = values["yaw_pitch_roll"]
        return radians(roll), radians(pitch), radians(yaw)
    if "quaternion" not in values:
        return None
    x, y, z, w = values["quaternion"]
    return angles_of(w, x, y, z)


def gnss_fix(host_time_ns: int, receiver: str, tag: TimeTag, values: Values) -> GnssFix:
    """Return the position of one of the device's receivers; without position where it has no fix.

    Position sigmas are given north, east, down; that of the velocity is one number, taken for each axis.
    """

    def numbers(name: str) -> tuple[float, ...] | None:
        found = values.get(f"{receiver}.{name}")
        return found if found is not None and all(map(isfinite, found)) else None

    fix_type = FIX_TYPES.get(values[f"{receiver}.fix"][0], FixType.NONE)
    position, velocity = numbers("pos_lla"), numbers("vel_ned")
    there = fix_type is not FixType.NONE and position is not None
    latitude, longitude, height = position if position is not None and there else (nan,) * 3
    sigmas, speed_sigma = numbers("pos_sigma"), numbers("vel_sigma")
    satellites = values.get(f"{receiver}.satellites")
    return GnssFix(
        host_time_ns,
        tag,
        lat_rad=radians(latitude) if there else None,
        lon_rad=radians(longitude) if there else None,
        height_m=height if there else None,
        velocity_l=(velocity[0], velocity[1], velocity[2]) if velocity is not None and there else None,
        position_cov_l=np.diag(np.square(sigmas)) if sigmas is not None and there else None,
        velocity_cov_l=np.eye(3) * speed_sigma[0] ** 2 if speed_sigma is not None and there else None,
        fix_type=fix_type if there else FixType.NONE,
        satellites=satellites[0] if satellites is not None else None,
        antenna=ANTENNAS[receiver],
        valid=there,
        message=receiver,
    )


make_time_parser = times_only(VectornavParser)

UNIT = Driver(
    protocol="vectornav",
    kind="imu",
    transports=STREAM_TRANSPORTS,
    yields=(ImuSamples, InsSolution, TimeMessage, GnssFix, DeviceStatus),
    summary="VectorNav VN-100 to VN-x10: binary output, any groups and fields; IMU, INS, GNSS, time",
    make_parser=VectornavParser,
    make_time_parser=make_time_parser,
    names_edge=NamesEdge.PREVIOUS,
    startup=startup_messages,
)
DRIVERS = (UNIT, replace(receiver_inside(UNIT), startup=receiver_startup_messages))
