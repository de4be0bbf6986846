"""MicroStrain 3DM-GX5, CX5, CV7, GV7, GQ7: MIP packets of sensor, filter, receiver and system data.

Source: MicroStrain's MIP SDK, see `swath.drivers.imu.microstrain.wire`; states of the filter and flags of validity are
those of its ``data_filter.hpp``, ``data_gnss.hpp``, ``data_sensor.hpp`` and ``data_shared.hpp``.

- Axes: the vehicle frame, x forward, y right, z down; roll, pitch and yaw turn it from north, east, down. These are
  Swath's axes and angles: in the recording of a unit at rest, x of the specific force is g times the sine of the pitch,
  and z is negative.
- Samples: scaled accelerations in g of 9.80665 m/s² and rates. With ``sample = "increment"``: delta velocity and delta
  theta, divided by the step of the reference time, else by the interval 1/``rate_hz``.
- Time of samples: GPS time where it is valid; with ``pps`` in the configuration, or before that, the reference time,
  a counter of nanoseconds. Where both are given, the counter at the latest whole second of GPS time is its latch.
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
from swath.drivers.imu.microstrain.startup import receiver_startup_messages, startup_messages
from swath.drivers.imu.microstrain.wire import FILTER, MIP, RECEIVERS, SENSOR, read_values
from swath.drivers.imu.unit_time import WEEK_NS, Moment, UnitTime
from swath.drivers.parser import DeviceSettings
from swath.drivers.record_rows import Row
from swath.georef.records import (
    DeviceStatus,
    EventMark,
    FixType,
    GnssFix,
    ImuSamples,
    InsSolution,
    NamesEdge,
    Record,
    TimeMessage,
)
from swath.georef.timescales.gps_time import SECOND_NS

Items: TypeAlias = list[Record | Row]
Values: TypeAlias = dict[str, tuple[Any, ...]]

STANDARD_GRAVITY = 9.80665
# name of a time: its flags of a valid time of week and week
TIMES = {"gps_time": 0x03, "sensor_time": 0x18, "filter_time": 0x01, "epoch": 0x03}
VALID = 0x01
LAT_LON, ELLIPSOID, SEA_LEVEL, HORIZONTAL, VERTICAL = 1, 2, 4, 8, 16
VELOCITY_NED, SPEED_ACCURACY = 1, 16
FIX_FLAGS_VALID = 0x04
CORRECTED = 0x03  # SBAS or differential corrections used
LEAP_SECONDS_VALID = 0x02
FIX_TYPES = {0: FixType.SINGLE, 1: FixType.SINGLE, 5: FixType.RTK_FLOAT, 6: FixType.RTK_FIXED, 7: FixType.DIFFERENTIAL}
ANTENNAS = {"gnss": "primary", "gnss1": "primary", "gnss2": "secondary"}  # others have no lever arm in Swath
STATUS_SHIFT = 16  # status of a solution: the filter's state in the low bits, its flags above


@dataclass(slots=True)
class _Latest:
    """The latest values of which only changes become records."""

    fixes: dict[int, tuple[Any, ...]] = field(default_factory=dict)
    status: dict[int, tuple[Any, ...]] = field(default_factory=dict)
    reference_ns: int = -1
    leap_seconds: int | None = None


class MicrostrainParser(FramedParser):
    """Decodes packets of data; NMEA between them is framed and counted.

    Args:
        settings: of the device's table, ``sample``, ``rate_hz`` and ``pps`` are read.
        wanted: the record types to return; None: all.
    """

    def __init__(self, settings: DeviceSettings, *, wanted: tuple[type, ...] | None = None) -> None:
        super().__init__((MIP, NMEA), wanted)
        self._increments = settings.config.get("sample") == "increment"
        self._interval_s = 1.0 / float(settings.config.get("rate_hz") or nan)
        self._by_counter = settings.config.get("pps") is not None
        self._time = UnitTime(settings, self.counters, "GpsTime")
        self._latest = _Latest()

    def decode_frames(self, frames: list[Frame]) -> Items:
        """Decode consecutive frames; return their records, or rows of them, in order."""
        items: Items = []
        for kind, host_time_ns, data in frames:
            if kind != MIP.name:
                continue
            values = read_values(data)
            if values is None:
                self.counters.count_bad("bad_length")
            elif values:
                items += self._decode(host_time_ns, data[2], values)
        return items

    def _decode(self, host_time_ns: int, descriptor_set: int, values: Values) -> Items:
        if "leap_seconds" in values and values["leap_seconds"][1] & LEAP_SECONDS_VALID:
            self._latest.leap_seconds = values["leap_seconds"][0]
        moment = self._moment(values)
        (trigger,) = values.get("event_source", (0,))
        if trigger:  # sent for an event, not in the rhythm of the samples
            return self._event(host_time_ns, moment, trigger)
        items: Items = [*self._time.name_second(host_time_ns, moment, self._latest.leap_seconds)]
        if descriptor_set == SENSOR:
            items += self._sample(host_time_ns, values, moment)
        elif descriptor_set == FILTER:
            items += self._solution(host_time_ns, values, moment)
        elif RECEIVERS.get(descriptor_set) in ANTENNAS:
            items += self._fix(host_time_ns, descriptor_set, values, moment)
        return items + self._status(host_time_ns, descriptor_set, values)

    # --- time ---

    def _moment(self, values: Values) -> Moment | None:
        """Return the first GPS time of a packet; None where it has none or an impossible one."""
        name = next((name for name in TIMES if name in values), None)
        if name is None:
            return None
        tow_s, week, flags = values[name]
        if not 0.0 <= tow_s < 604_800.0:
            return None
        return self._time.moment(week, round(tow_s * 1e9) % WEEK_NS, valid=flags & TIMES[name] == TIMES[name])

    def _event(self, host_time_ns: int, moment: Moment | None, trigger: int) -> Items:
        if moment is None:
            self.counters.errors["time_unknown"] += 1
            return []
        channel = f"trigger{trigger}"
        return [EventMark(host_time_ns, moment.tag, channel, rising=None, valid=moment.valid, message="event")]

    # --- samples ---

    def _sample(self, host_time_ns: int, values: Values, moment: Moment | None) -> Items:
        found = self._increment(values) if self._increments else self._measurement(values)
        if found is None:
            return []
        force, rate = found
        if not all(map(isfinite, (*force, *rate))):
            self.counters.count_bad("bad_value")
            return []
        device_ns, pps_ns, week = -1, -1, -1
        (reference_ns,) = values.get("reference_ns", (-1,))
        if moment is not None and moment.valid and not self._by_counter:
            device_ns, week = moment.tow_ns, moment.week
        elif 0 <= reference_ns < 1 << 63:
            device_ns = reference_ns
            if moment is not None and moment.valid:
                pps_ns = max(reference_ns - moment.tow_ns % SECOND_NS, -1)
            if reference_ns < self._latest.reference_ns:
                self.counters.errors["restart"] += 1
            self._latest.reference_ns = reference_ns
        celsius = values.get("temperature", (nan,))[-1]
        (status,) = values.get("overrange", (0,))
        return [Row(ImuSamples, (host_time_ns, device_ns, pps_ns, force, rate, celsius, status, week))]

    def _measurement(self, values: Values) -> tuple[Any, Any] | None:
        """Return specific force and rate; a half of them, or increments alone, are counted."""
        if "accel_g" in values and "gyro" in values:
            return tuple(part * STANDARD_GRAVITY for part in values["accel_g"]), values["gyro"]
        if "accel_g" in values or "gyro" in values:
            self.counters.errors["sample_incomplete"] += 1
        elif "delta_velocity_gs" in values:
            self.counters.errors["increments_only"] += 1
        return None

    def _increment(self, values: Values) -> tuple[Any, Any] | None:
        """Return increments divided by the step of the reference time, else by the nominal interval."""
        if "delta_theta" not in values or "delta_velocity_gs" not in values:
            if "delta_theta" in values or "delta_velocity_gs" in values:
                self.counters.errors["sample_incomplete"] += 1
            elif "accel_g" in values:
                self.counters.errors["rates_only"] += 1
            return None
        (step_ns,) = values.get("reference_step_ns", (0,))
        interval_s = step_ns / SECOND_NS if step_ns else self._interval_s
        force = tuple(part * STANDARD_GRAVITY / interval_s for part in values["delta_velocity_gs"])
        return force, tuple(part / interval_s for part in values["delta_theta"])

    # --- solutions ---

    def _solution(self, host_time_ns: int, values: Values, moment: Moment | None) -> Items:
        position, angles = _valid(values, "position"), _valid(values, "euler")
        if "position" not in values or "euler" not in values:
            return []
        if position is None or angles is None:
            self.counters.errors["ins_no_solution"] += 1
            return []
        if moment is None or not moment.valid:
            self.counters.errors["time_unknown"] += 1
            return []
        unknown = (nan, nan, nan)
        state, _, flags = values.get("status", (0, 0, 0))
        row = (
            host_time_ns,
            moment.gps_ns,
            *(radians(position[0]), radians(position[1]), position[2]),
            _valid(values, "velocity") or unknown,
            *angles,
            _valid(values, "position_sigma") or unknown,
            _valid(values, "velocity_sigma") or unknown,
            _valid(values, "euler_sigma") or unknown,
            state | flags << STATUS_SHIFT,
        )
        return [Row(InsSolution, row)]

    def _fix(self, host_time_ns: int, descriptor_set: int, values: Values, moment: Moment | None) -> Items:
        """Return the position of a receiver, once for each of its epochs."""
        if "position" not in values or "fix" not in values:
            return []
        if moment is None:
            self.counters.errors["time_unknown"] += 1
            return []
        epoch = (moment.week, moment.tow_ns, *values["position"])
        if self._latest.fixes.get(descriptor_set) == epoch:
            return []
        self._latest.fixes[descriptor_set] = epoch
        return [gnss_fix(host_time_ns, RECEIVERS[descriptor_set], moment, values)]

    def _status(self, host_time_ns: int, descriptor_set: int, values: Values) -> Items:
        """Return the state of the filter or of the synchronisation where it has changed."""
        found: dict[str, float | int | str | bool] = {}
        if descriptor_set == FILTER and "status" in values:
            state, mode, flags = values["status"]
            found = {"filter_state": state, "dynamics_mode": mode, "filter_flags": flags}
        elif "time_sync" in values:
            found = {"pps_synchronised": bool(values["time_sync"][0])}
        state_now = tuple(found.values())
        if not found or self._latest.status.get(descriptor_set) == state_now:
            return []
        self._latest.status[descriptor_set] = state_now
        return [DeviceStatus(host_time_ns, found, message="filter" if descriptor_set == FILTER else "system")]


def _valid(values: Values, name: str) -> tuple[float, float, float] | None:
    """Return the three numbers of one of the filter's fields; None where absent, not valid or not finite."""
    if name not in values or not values[name][3] & VALID or not all(map(isfinite, values[name][:3])):
        return None
    first, second, third = values[name][:3]
    return first, second, third


def gnss_fix(host_time_ns: int, receiver: str, moment: Moment, values: Values) -> GnssFix:
    """Return the position of one receiver; without position where it has no fix.

    The horizontal accuracy holds for both axes together, h² = NN + EE; that of the speed is taken for each axis.
    """
    kind, satellites, flags, valid = values["fix"]
    latitude, longitude, ellipsoid, sea_level, horizontal, vertical, known = values["position"]
    fix_type = FIX_TYPES.get(kind, FixType.NONE)
    if fix_type is FixType.SINGLE and valid & FIX_FLAGS_VALID and flags & CORRECTED:
        fix_type = FixType.DIFFERENTIAL
    there = fix_type is not FixType.NONE and known & LAT_LON != 0 and isfinite(latitude) and isfinite(longitude)
    has_height = there and known & ELLIPSOID != 0 and isfinite(ellipsoid)
    cov = np.diag([horizontal**2 / 2.0, horizontal**2 / 2.0, vertical**2 if known & VERTICAL else nan])
    undulation = ellipsoid - sea_level if has_height and known & SEA_LEVEL and isfinite(sea_level) else None
    *velocity, _, _, _, speed_sigma, _, velocity_known = values.get("velocity", (nan,) * 8 + (0,))
    moving = there and velocity_known & VELOCITY_NED != 0 and all(map(isfinite, velocity))
    return GnssFix(
        host_time_ns,
        moment.tag,
        lat_rad=radians(latitude) if there else None,
        lon_rad=radians(longitude) if there else None,
        height_m=ellipsoid if has_height else None,
        velocity_l=(velocity[0], velocity[1], velocity[2]) if moving else None,
        position_cov_l=cov if there and known & HORIZONTAL and isfinite(horizontal) else None,
        velocity_cov_l=np.eye(3) * speed_sigma**2 if moving and velocity_known & SPEED_ACCURACY else None,
        fix_type=fix_type if there else FixType.NONE,
        satellites=satellites,
        antenna=ANTENNAS[receiver],
        valid=there and moment.valid,
        message=receiver,
        undulation_m=undulation,
    )


make_time_parser = times_only(MicrostrainParser)

UNIT = Driver(
    protocol="microstrain",
    kind="imu",
    transports=STREAM_TRANSPORTS,
    yields=(ImuSamples, InsSolution, TimeMessage, GnssFix, EventMark, DeviceStatus),
    summary="MicroStrain (LORD, HBK) by MIP: sensor, filter, receiver and system data",
    make_parser=MicrostrainParser,
    make_time_parser=make_time_parser,
    names_edge=NamesEdge.PREVIOUS,
    startup=startup_messages,
)
DRIVERS = (UNIT, replace(receiver_inside(UNIT), startup=receiver_startup_messages))
