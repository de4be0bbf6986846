"""SBG Systems Ellipse, Pulse, Quanta, Navsight, Ekinox, Apogee: sbgECom logs over serial or Ethernet.

Source: SBG's ``doc/binaryMessages.md``, see `swath.drivers.imu.sbg_ecom.wire`.

- Axes: the body's, x forward, y right, z down; Euler angles turn it from north, east, down: Swath's own. Heights come
  above the geoid with its undulation; both are added.
- Samples: IMU_SHORT, means over the output interval ("moving average filter"); IMU_DATA only until the first one comes.
- Time: every log has a stamp in µs since power-on, which wraps after 71.6 min. UTC_TIME ties a stamp to GPS time; the
  latest one places all others. Samples have GPS time while the unit vouches for its clock; with ``pps`` in the
  configuration, or before that, the stamp is their counter, and its latch the last event on the Sync In ``pps_event``,
  else the whole second of UTC_TIME.
- EKF_NAV and EKF_EULER (or EKF_QUAT) of one stamp make a solution; GPSx_POS and GPSx_VEL of one time of week a fix.
"""

from __future__ import annotations

import datetime as dt
from dataclasses import dataclass, replace
from math import isfinite, radians
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from swath.drivers.driver import STREAM_TRANSPORTS, Driver, receiver_inside, times_only
from swath.drivers.framing.framer import Frame
from swath.drivers.framing.kinds import NMEA
from swath.drivers.framing.parser import FramedParser
from swath.drivers.gnss.date_floor import GPS_EPOCH, leap_seconds_of
from swath.drivers.gnss.epochs import EpochGatherer
from swath.drivers.imu.attitude import angles_of
from swath.drivers.imu.counters import LATE_LATCH_PART, CounterUnwrapper
from swath.drivers.imu.sbg_ecom import wire
from swath.drivers.imu.unit_time import WEEK_NS, Moment, UnitTime
from swath.drivers.parser import DeviceSettings, DriverSettingsError
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
)
from swath.georef.timescales.gps_time import MILLISECOND_NS, SECOND_NS

Items: TypeAlias = list[Record | Row]

TICK_BITS = 32
TICK_HZ = 1_000_000
TICK_NS = 1000
WRAP_US = 1 << TICK_BITS
GREATEST_AGE_US = 10_000_000  # of the UTC_TIME that places a stamp
DAY_NS = 86_400 * SECOND_NS
WEEK_MS = 604_800_000

CLOCK_STATE = 0x1E  # UTC_TIME status: state of the clock
CLOCK_VALID = 3 << 1
UTC_STATUS = 0x3C0
UTC_KNOWN = 2 << 6
COMMUNICATION_OK = 0x0001  # IMU status
HIGH_RATES = 0x0400
ACCEL_SCALE = 1.0 / 1_048_576.0  # m/s² of a count
RATE_SCALES = (1.0 / 67_108_864.0, 1.0 / 12_304_174.0)  # rad/s of a count, normal and of high rates
TEMPERATURE_SCALE = 1.0 / 256.0
SOLUTION_MODE = 0x0F
NAVIGATION_MODE = 4
STATE_BITS, TYPE_SHIFT = 0x3F, 6
BASELINE_VALID = 0x40
SATELLITES_UNKNOWN = 0xFF
FIX_TYPES = {
    **{1: FixType.SINGLE, 2: FixType.SINGLE, 3: FixType.DIFFERENTIAL, 4: FixType.DIFFERENTIAL},
    **{5: FixType.DIFFERENTIAL, 6: FixType.RTK_FLOAT, 7: FixType.RTK_FIXED, 8: FixType.PPP, 9: FixType.PPP},
    **{10: FixType.MANUAL},
}
ANTENNAS = {1: "primary", 2: "secondary"}


class Anchor(NamedTuple):
    """A stamp with its GPS time, from UTC_TIME."""

    stamp_us: int
    moment: Moment
    leap_seconds: int | None


class FixPart(NamedTuple):
    """One of the logs of a fix."""

    host_time_ns: int
    log: wire.Position | wire.Velocity
    satellites: int | None


@dataclass(slots=True)
class _Latest:
    """The latest logs that later ones refer to."""

    anchor: Anchor | None = None
    short: bool = False  # whether IMU_SHORT has come
    pulse_us: int | None = None  # stamp of the last event on the Sync In of the PPS
    euler: tuple[Any, ...] | None = None
    nav: wire.Nav | None = None
    status: tuple[int, ...] = ()


class SbgEcomParser(FramedParser):
    """Decodes logs; NMEA between them is framed and counted, as are answers to commands and their large frames.

    Args:
        settings: of the device's table, ``pps``, ``pps_event`` and ``sample`` are read.
        wanted: the record types to return; None: all.

    Raises:
        DriverSettingsError: increments are configured, which the unit does not send.
    """

    def __init__(self, settings: DeviceSettings, *, wanted: tuple[type, ...] | None = None) -> None:
        super().__init__((wire.SBG_ECOM, NMEA), wanted)
        if settings.config.get("sample") == "increment":
            raise DriverSettingsError('sample: sbg-ecom has no increments; want "mean", which its logs contain')
        self._by_counter = settings.config.get("pps") is not None
        self._pulse_channel = settings.config.get("pps_event")
        self._time = UnitTime(settings, self.counters, "UTC_TIME")
        self._unwrapper = CounterUnwrapper(TICK_BITS, TICK_HZ)
        self._fixes = {number: EpochGatherer[FixPart](self.counters) for number in ANTENNAS}
        self._latest = _Latest()

    def finish(self) -> Items:
        """Return the last fixes."""
        items: Items = []
        for number, gatherer in self._fixes.items():
            items += self._give_fixes(number, gatherer.end())
        return items

    def decode_frames(self, frames: list[Frame]) -> Items:
        """Decode consecutive frames; return their records, or rows of them, in order."""
        items: Items = []
        for kind, host_time_ns, data in frames:
            log = wire.read_log(data) if kind == wire.SBG_ECOM.name else None
            if log is None:
                continue
            number, values, content = log
            if values:
                items += self._decode(host_time_ns, number, values, content)
            else:
                self.counters.count_bad("bad_length")
        return self._unwrap(items)

    def _decode(self, host_time_ns: int, number: int, values: tuple[Any, ...], data: bytes) -> Items:
        if number == wire.UTC_TIME:
            return self._utc_time(host_time_ns, wire.UtcTime(*values))
        if number in (wire.IMU_SHORT, wire.IMU_DATA):
            return self._sample(host_time_ns, number, values)
        if number in (wire.EKF_EULER, wire.EKF_QUAT, wire.EKF_NAV):
            return self._solution(host_time_ns, number, values)
        if number in wire.POSITIONS:
            satellites = data[wire.SATELLITES_AT] if len(data) > wire.SATELLITES_AT else SATELLITES_UNKNOWN
            known = satellites if satellites != SATELLITES_UNKNOWN else None
            return self._add_fix(wire.POSITIONS[number], "POS", FixPart(host_time_ns, wire.Position(*values), known))
        if number in wire.VELOCITIES:
            return self._add_fix(wire.VELOCITIES[number], "VEL", FixPart(host_time_ns, wire.Velocity(*values), None))
        if number in wire.HEADINGS:
            return self._heading(host_time_ns, wire.NAMES[number], wire.Heading(*values), data)
        if number in wire.EVENTS:
            return self._event(host_time_ns, wire.EVENTS[number], values)
        return self._status(host_time_ns, values)

    # --- time ---

    def _utc_time(self, host_time_ns: int, log: wire.UtcTime) -> Items:
        """Take the tie of a stamp to GPS time; return the second that it names."""
        if not log.status & UTC_STATUS:
            return []
        try:
            date = dt.date(log.year, log.month, log.day)
        except ValueError:
            self.counters.count_bad("bad_value")
            return []
        of_day_ns = ((log.hour * 60 + log.minute) * 60 + log.second) * SECOND_NS + log.nanosecond
        leap = leap_seconds_of(date, of_day_ns // MILLISECOND_NS, log.tow_ms)
        if leap is None or log.hour > 23 or log.minute > 59 or log.second > 60 or log.nanosecond >= SECOND_NS:
            self.counters.count_bad("bad_value")
            return []
        week, tow_ns = divmod((date - GPS_EPOCH).days * DAY_NS + of_day_ns + leap * SECOND_NS, WEEK_NS)
        moment = self._time.moment(week, tow_ns, valid=log.status & CLOCK_STATE == CLOCK_VALID)
        if moment is None:
            return []
        known = leap if log.status & UTC_STATUS == UTC_KNOWN else None
        self._latest.anchor = Anchor(log.stamp_us, moment, known)
        return [*self._time.name_second(host_time_ns, moment, known)]

    def _moment(self, stamp_us: int) -> Moment | None:
        """Return GPS time of a stamp; None where no recent UTC_TIME ties it."""
        anchor = self._latest.anchor
        if anchor is None:
            return None
        since_us = steps_between(anchor.stamp_us, stamp_us)
        if abs(since_us) > GREATEST_AGE_US:
            return None
        week, tow_ns = divmod(anchor.moment.gps_ns + since_us * TICK_NS, WEEK_NS)
        return Moment(week, tow_ns, anchor.moment.valid)

    # --- samples ---

    def _sample(self, host_time_ns: int, number: int, values: tuple[Any, ...]) -> Items:
        if number == wire.IMU_SHORT:
            self._latest.short = True
        elif self._latest.short:
            return []
        stamp_us, status = values[:2]
        if not status & COMMUNICATION_OK:
            self.counters.errors["imu_error"] += 1
            return []
        force, rate, celsius = physical(number, status, values)
        if not all(map(isfinite, (*force, *rate))):
            self.counters.count_bad("bad_value")
            return []
        moment = self._moment(stamp_us)
        if moment is not None and moment.valid and not self._by_counter:
            return [Row(ImuSamples, (host_time_ns, moment.tow_ns, -1, force, rate, celsius, status, moment.week))]
        since_ns = self._since_pulse(stamp_us, moment)
        return [Row(ImuSamples, (host_time_ns, stamp_us, since_ns, force, rate, celsius, status, -1))]

    def _since_pulse(self, stamp_us: int, moment: Moment | None) -> int | None:
        """Return the time since the last pulse: on the Sync In of the PPS, else since the whole second; None without
        one.
        """
        if self._pulse_channel is None:
            return moment.tow_ns % SECOND_NS if moment is not None and moment.valid else None
        if self._latest.pulse_us is None:
            return None
        since_us = (stamp_us - self._latest.pulse_us) % WRAP_US
        return (since_us - WRAP_US if since_us > WRAP_US - WRAP_US // LATE_LATCH_PART else since_us) * TICK_NS

    def _unwrap(self, items: Items) -> Items:
        """Complete the samples that have a stamp and the time since a pulse: make both continuous counters."""
        found = {
            at: item.values
            for at, item in enumerate(items)
            if isinstance(item, Row) and item.record is ImuSamples and item.values[-1] < 0
        }
        if not found:
            return items
        host, stamps = (np.array([values[at] for values in found.values()], np.int64) for at in (0, 1))
        counts, restart = self._unwrapper.unwrap(stamps.astype(np.uint64), host)
        if restart.any():
            self.counters.errors["restart"] += int(restart.sum())
        for (at, values), count in zip(found.items(), counts.tolist(), strict=True):
            device_ns = count * TICK_NS
            pps_ns = -1 if values[2] is None else max(device_ns - values[2], -1)
            items[at] = Row(ImuSamples, (values[0], device_ns, pps_ns, *values[3:]))
        return items

    # --- solutions and fixes ---

    def _solution(self, host_time_ns: int, number: int, values: tuple[Any, ...]) -> Items:
        """Keep the log; return the solution where the other one of its stamp is there."""
        if number == wire.EKF_NAV:
            self._latest.nav = wire.Nav(*values)
        elif number == wire.EKF_EULER:
            self._latest.euler = values[:7]
        elif self._latest.euler is None or self._latest.euler[0] != values[0]:
            self._latest.euler = (values[0], *angles_of(*values[1:5]), *values[5:8])
        nav, euler = self._latest.nav, self._latest.euler
        if nav is None or euler is None or nav.stamp_us != euler[0]:
            return []
        self._latest.nav = None
        if nav.status & SOLUTION_MODE != NAVIGATION_MODE:
            self.counters.errors["ins_no_solution"] += 1
            return []
        moment = self._moment(nav.stamp_us)
        if moment is None or not moment.valid:
            self.counters.errors["time_unknown"] += 1
            return []
        row = ins_row(host_time_ns, moment, nav, euler)
        if row is None:
            self.counters.count_bad("bad_value")
            return []
        return [row]

    def _add_fix(self, receiver: int, name: str, part: FixPart) -> Items:
        if part.log.tow_ms >= WEEK_MS:
            self.counters.count_bad("bad_value")
            return []
        return self._give_fixes(receiver, self._fixes[receiver].add(part.log.tow_ms, name, part))

    def _give_fixes(self, receiver: int, epochs: list[dict[str, FixPart]]) -> Items:
        items: Items = []
        for parts in epochs:
            position = parts.get("POS")
            moment = self._at(position.log.tow_ms) if position is not None else None
            if position is not None and moment is not None:
                items.append(gnss_fix(receiver, moment, position, parts.get("VEL")))
            elif position is not None:
                self.counters.errors["time_unknown"] += 1
        return items

    def _at(self, tow_ms: int) -> Moment | None:
        """Return a receiver's epoch, its week by the latest UTC_TIME."""
        if self._latest.anchor is None or tow_ms >= WEEK_MS:
            return None
        moment = self._latest.anchor.moment
        ahead_ns = tow_ms * MILLISECOND_NS - moment.tow_ns
        week = moment.week + (ahead_ns < -WEEK_NS // 2) - (ahead_ns > WEEK_NS // 2)
        return Moment(week, tow_ms * MILLISECOND_NS, moment.valid)

    def _heading(self, host_time_ns: int, name: str, log: wire.Heading, data: bytes) -> Items:
        """Return the heading and pitch from the main antenna to the other one."""
        moment = self._at(log.tow_ms)
        if not isfinite(log.heading_deg) or log.status & STATE_BITS:
            return []
        baseline = None
        if log.status & BASELINE_VALID and len(data) >= wire.BASELINE.size:
            (length,) = wire.BASELINE.unpack_from(data)
            baseline = length if isfinite(length) else None
        return [
            GnssHeading(
                host_time_ns,
                moment.tag if moment is not None else None,
                heading_rad=radians(log.heading_deg),
                pitch_rad=radians(log.pitch_deg) if isfinite(log.pitch_deg) else None,
                baseline_m=baseline,
                heading_sigma_rad=radians(log.heading_sigma_deg) if isfinite(log.heading_sigma_deg) else None,
                pitch_sigma_rad=radians(log.pitch_sigma_deg) if isfinite(log.pitch_sigma_deg) else None,
                valid=moment is not None,
                message=name,
            )
        ]

    # --- events and state ---

    def _event(self, host_time_ns: int, channel: str, values: tuple[Any, ...]) -> Items:
        """Return a mark for each event of a log; the pulses of the PPS latch the counter instead."""
        first_us, status, *offsets = values
        further = [offset for number, offset in enumerate(offsets) if status >> number + 1 & 1]
        stamps = [(first_us + offset) % WRAP_US for offset in (0, *further)]
        if channel == self._pulse_channel:
            self._latest.pulse_us = stamps[-1]
            return []
        items: Items = []
        for stamp_us in stamps:
            moment = self._moment(stamp_us)
            if moment is None:
                self.counters.errors["time_unknown"] += 1
                continue
            name = f"Sync{channel}"
            items.append(EventMark(host_time_ns, moment.tag, name, rising=None, valid=moment.valid, message="EVENT"))
        return items

    def _status(self, host_time_ns: int, values: tuple[Any, ...]) -> Items:
        """Return the unit's state where it has changed."""
        state = values[1:]
        if state == self._latest.status:
            return []
        self._latest.status = state
        names = ("general_status", "com_status_2", "com_status", "aiding_status")
        return [DeviceStatus(host_time_ns, dict(zip(names, state, strict=True)), message="STATUS")]


def steps_between(first_us: int, then_us: int) -> int:
    """Return the shorter way between two stamps of a wrapping counter, negative backwards."""
    half = WRAP_US // 2
    return (then_us - first_us + half) % WRAP_US - half


def physical(number: int, status: int, values: tuple[Any, ...]) -> tuple[tuple[float, ...], tuple[float, ...], float]:
    """Return specific force (m/s²), rate (rad/s) and temperature (°C) of an IMU log."""
    if number == wire.IMU_DATA:
        return values[9:12], values[12:15], values[8]
    scale = RATE_SCALES[bool(status & HIGH_RATES)]
    force = tuple(count * ACCEL_SCALE for count in values[2:5])
    return force, tuple(count * scale for count in values[5:8]), values[8] * TEMPERATURE_SCALE


def ins_row(host_time_ns: int, moment: Moment, nav: wire.Nav, euler: tuple[Any, ...]) -> Row | None:
    """Return a solution; None where a number is not finite."""
    if not all(map(isfinite, (*nav[1:4], *nav[7:11], *euler[1:4]))):
        return None
    values = (
        host_time_ns,
        moment.gps_ns,
        *(radians(nav.lat_deg), radians(nav.lon_deg), nav.altitude_m + nav.undulation_m),
        nav[1:4],
        *euler[1:4],
        nav[11:14],
        nav[4:7],
        euler[4:7],
        nav.status,
    )
    return Row(InsSolution, values)


def gnss_fix(receiver: int, moment: Moment, part: FixPart, motion: FixPart | None) -> GnssFix:
    """Return the position of a receiver with the velocity of the same epoch; without position where it has no fix."""
    log = part.log
    assert isinstance(log, wire.Position)
    fix_type = FIX_TYPES.get(log.status >> TYPE_SHIFT & STATE_BITS, FixType.NONE)
    numbers = (log.lat_deg, log.lon_deg, log.altitude_m, log.undulation_m)
    there = not log.status & STATE_BITS and fix_type is not FixType.NONE and all(map(isfinite, numbers))
    velocity = motion.log if motion is not None else None
    moving = isinstance(velocity, wire.Velocity) and velocity.status & STATE_BITS == 0
    moving = moving and velocity is not None and velocity.status >> TYPE_SHIFT & STATE_BITS != 0
    fix = GnssFix(
        part.host_time_ns,
        moment.tag,
        lat_rad=radians(log.lat_deg) if there else None,
        lon_rad=radians(log.lon_deg) if there else None,
        height_m=log.altitude_m + log.undulation_m if there else None,
        position_cov_l=np.diag(np.square([log.lat_sigma_m, log.lon_sigma_m, log.altitude_sigma_m])) if there else None,
        fix_type=fix_type if there else FixType.NONE,
        satellites=part.satellites,
        antenna=ANTENNAS[receiver],
        valid=there and moment.valid,
        message=f"GPS{receiver}_POS",
        undulation_m=log.undulation_m if there else None,
    )
    if moving and isinstance(velocity, wire.Velocity) and all(map(isfinite, velocity[3:6])):
        cov = np.diag(np.square([velocity.north_sigma, velocity.east_sigma, velocity.down_sigma]))
        fix = replace(fix, velocity_l=(velocity.north, velocity.east, velocity.down), velocity_cov_l=cov)
    return fix


make_time_parser = times_only(SbgEcomParser)

UNIT = Driver(
    protocol="sbg-ecom",
    kind="imu",
    transports=STREAM_TRANSPORTS,
    yields=(ImuSamples, InsSolution, TimeMessage, GnssFix, GnssHeading, EventMark, DeviceStatus),
    summary="SBG Systems by sbgECom: IMU, EKF, receivers, UTC, events",
    make_parser=SbgEcomParser,
    make_time_parser=make_time_parser,
    names_edge=NamesEdge.PREVIOUS,
)
DRIVERS = (UNIT, receiver_inside(UNIT))
