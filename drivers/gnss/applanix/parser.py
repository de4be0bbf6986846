"""Trimble GSOF (protocol ``gsof``) and Applanix POS groups (protocol ``applanix-pos``), each with its INS.

Frames: the vehicle's axes are forward, right, down, and roll, pitch and heading lead to them from north, east, down in
the order heading, pitch, roll; right wing down, nose up and clockwise are positive, as here. Group 1's heading is true:
its wander angle is that of the INS's own frame and is not part of it, nor of its velocities, which are north, east,
down (POS LV user ICD, group 1; its track angle is that of these velocities).

GSOF: records of one report make one `GnssFix` (1, 2, 8, 12, 70). Record 1 on the whole second and 16 name the previous
edge. 49 makes a row of `InsSolution`, with the sigmas of a 50 of the same time or else of the last 50 of a second.

POS: group 1 makes a row, with the sigmas of the last group 2 of a second. Its week comes from group 3. Group 7 is sent
for each pulse and names it; groups 5 and 6 are events, 10 the status. With ``solution_of`` the rows are those of sensor
1 or 2 instead, from groups 102 and 104 or 103 and 105 (`SensorSolutions`).

Group 4 has increments of velocity and angle in counts. The maker publishes neither their scale nor the corrections in
them ("U.S. and Canadian export control laws prohibit publication of the IMU data format", POS MV V5 ICD, group 4): each
is counted as ``imu_scale_unknown``, its bad frames as ``imu_bad_frames``, and the IMU's type becomes a status.

Rows without alignment (GSOF below "aligned", POS beyond "fine alignment") are counted as ``ins_not_aligned``.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import replace
from math import cos, isfinite, sin
from typing import Any, TypeAlias

import numpy as np

from swath.drivers.driver import STREAM_TRANSPORTS, Driver, times_only
from swath.drivers.framing.framer import Frame
from swath.drivers.framing.kinds import GENOUT, NMEA, POS, pos_name
from swath.drivers.framing.parser import FramedParser
from swath.drivers.gnss.applanix import groups as pos
from swath.drivers.gnss.applanix import gsof
from swath.drivers.gnss.applanix.solution import (
    WEEK_NS,
    SensorSolutions,
    Sigmas,
    Triple,
    navigation_row,
    sigmas_of,
)
from swath.drivers.gnss.date_floor import GREATEST_WEEK, WEEK_MS, ReceiverDates
from swath.drivers.parser import DeviceSettings, DriverSettingsError
from swath.drivers.record_rows import Row
from swath.georef.records import (
    DeviceStatus,
    EventMark,
    FixType,
    GnssFix,
    InsSolution,
    NamesEdge,
    Record,
    TimeMessage,
    TimeScale,
    TimeTag,
)
from swath.georef.timescales.gps_time import MILLISECOND_NS, SECOND_NS

Items: TypeAlias = list[Record | Row]

WEEK_S = WEEK_MS // 1000


class _Parser(FramedParser):
    """Holds what both protocols share: framing, weeks, and the filter of record types."""

    def __init__(self, settings: DeviceSettings, wanted: tuple[type, ...] | None, kinds: tuple[Any, ...]) -> None:
        super().__init__(kinds, wanted)
        self._dates = ReceiverDates(settings)
        self._sigmas: Sigmas | None = None

    def remarks(self) -> list[str]:
        """Return remarks on the receiver's weeks."""
        return self._dates.remarks()

    def decode_frames(self, frames: list[Frame]) -> Items:
        """Decode consecutive frames; return their records, or rows of them, in order."""
        return [item for frame in frames for item in self._decode(frame)]

    @abstractmethod
    def _decode(self, frame: Frame) -> Items:
        """Decode one frame."""

    def _week(self, week: int, host_time_ns: int) -> int | None:
        """Return a week after the move by roll-overs; None, counted, before the floor or where no week can be."""
        week = self._dates.week(week, host_time_ns)
        if week > GREATEST_WEEK:
            self.counters.errors["bad_time"] += 1
            return None
        if week < self._dates.floor_week:
            self.counters.errors["date_before_floor"] += 1
            return None
        return week


# --- GSOF ---


class GsofParser(_Parser):
    """Decodes GSOF reports.

    Args:
        settings: ``date_floor`` is the oldest accepted date, ``add_weeks`` is added to all weeks.
        wanted: the record types to return; None: all.
    """

    def __init__(self, settings: DeviceSettings, *, wanted: tuple[type, ...] | None = None) -> None:
        super().__init__(settings, wanted, (GENOUT, NMEA))
        self._pages = gsof.Pages(self.counters)

    def _decode(self, frame: Frame) -> Items:
        report = self._pages.add(frame.data) if frame.kind == GENOUT.name else None
        if report is None:
            return []
        records: dict[int, bytes] = {}
        for number, data in gsof.split_records(report, self.counters):
            self.counters.messages[f"GSOF{number}"] += 1
            records.setdefault(number, data)
        return self._report(frame.host_time_ns, records)

    def _report(self, host_time_ns: int, records: dict[int, bytes]) -> Items:
        found: dict[int, Any] = {}
        for layout in LAYOUTS:
            if layout.number not in records:
                continue
            message = layout.decode(records[layout.number])
            if message is None or getattr(message, "milliseconds", 0) >= WEEK_MS:
                self.counters.count_bad("bad_length" if message is None else "bad_time")
                continue
            if not all(map(isfinite, message)):
                self.counters.count_bad("not_finite")
                continue
            found[layout.number] = message
        items: Items = []
        for number, decode in self._decoders().items():
            if number in found:
                items += decode(host_time_ns, found)
        return items

    def _decoders(self) -> dict[int, Callable[[int, dict[int, Any]], Items]]:
        return {
            1: self._fix,
            16: self._current_time,
            38: self._quality,
            41: self._base,
            50: self._rms,
            49: self._navigation,
        }

    def _fix(self, host_time_ns: int, found: dict[int, Any]) -> Items:
        """Return the second and the fix of a report; without a record 2 the fix has a velocity only, or is none."""
        time: gsof.PositionTime = found[1]
        week = self._week(time.week, host_time_ns)
        tag = TimeTag(TimeScale.GPS, time.milliseconds * MILLISECOND_NS, week=week)
        items: Items = []
        if time.milliseconds % 1000 == 0 and week is not None:
            valid = time.flags1 & gsof.CLOCK_COMPUTED != 0
            items.append(TimeMessage(host_time_ns, tag, NamesEdge.PREVIOUS, valid=valid, message="GSOF1"))
        place: gsof.LatLonHeight | None = found.get(2)
        velocity = _velocity(found.get(8))
        if place is None and velocity is None:
            return items
        computed = time.flags1 & gsof.HORIZONTAL_COMPUTED != 0
        there = place if computed else None
        height_m = there.height_m if there is not None and time.flags1 & gsof.HEIGHT_COMPUTED else None
        geoid: gsof.LatLonGeoid | None = found.get(70)
        fix = GnssFix(
            host_time_ns,
            tag,
            there.lat_rad if there is not None else None,
            there.lon_rad if there is not None else None,
            height_m,
            velocity_l=velocity,
            position_cov_l=_covariance(found.get(12)) if there is not None else None,
            fix_type=_fix_type(time),
            satellites=time.satellites,
            valid=computed and week is not None,
            message="GSOF1",
            undulation_m=height_m - geoid.height_msl_m if height_m is not None and geoid is not None else None,
        )
        return [*items, fix]

    def _current_time(self, host_time_ns: int, found: dict[int, Any]) -> Items:
        """Return the time of a report, and leap seconds where they are valid."""
        time: gsof.CurrentTime = found[16]
        week = self._week(time.week, host_time_ns)
        leap = time.leap_seconds if time.flags & 2 else None
        tag = TimeTag(TimeScale.GPS, time.milliseconds * MILLISECOND_NS, week=week, leap_seconds=leap)
        valid = week is not None and time.flags & 1 != 0
        return [TimeMessage(host_time_ns, tag, NamesEdge.PREVIOUS, valid=valid, message="GSOF16")]

    def _quality(self, host_time_ns: int, found: dict[int, Any]) -> Items:
        return [DeviceStatus(host_time_ns, dict(found[38]._asdict()), message="GSOF38")]

    def _base(self, host_time_ns: int, found: dict[int, Any]) -> Items:
        return [DeviceStatus(host_time_ns, dict(found[41]._asdict()), message="GSOF41")]

    def _rms(self, host_time_ns: int, found: dict[int, Any]) -> Items:
        rms: gsof.InsRms = found[50]
        self._sigmas = sigmas_of(rms.milliseconds * MILLISECOND_NS, rms[4:])
        return []

    def _navigation(self, host_time_ns: int, found: dict[int, Any]) -> Items:
        navigation: gsof.InsNavigation = found[49]
        if navigation.alignment not in (gsof.ALIGNED, gsof.FULL_NAVIGATION):
            self.counters.errors["ins_not_aligned"] += 1
            return []
        week = self._week(navigation.week, host_time_ns)
        if week is None:
            return []
        time_ns = navigation.milliseconds * MILLISECOND_NS
        return [navigation_row(host_time_ns, week, time_ns, navigation, self._sigmas)]


LAYOUTS: tuple[gsof.Layout[Any], ...] = (
    *(gsof.POSITION_TIME, gsof.LAT_LON_HEIGHT, gsof.VELOCITY, gsof.POSITION_SIGMA, gsof.CURRENT_TIME),
    *(gsof.POSITION_TYPE, gsof.BASE_POSITION, gsof.INS_NAVIGATION, gsof.INS_RMS, gsof.LAT_LON_GEOID),
)


def _fix_type(time: gsof.PositionTime) -> FixType:
    if not time.flags1 & gsof.HORIZONTAL_COMPUTED:
        return FixType.NONE
    if not time.flags2 & gsof.DIFFERENTIAL:
        return FixType.SINGLE
    if not time.flags2 & gsof.CARRIER:
        return FixType.DIFFERENTIAL
    return FixType.RTK_FIXED if time.flags2 & gsof.FIXED else FixType.RTK_FLOAT


def _velocity(velocity: gsof.Velocity | None) -> Triple | None:
    if velocity is None or not velocity.flags & gsof.VELOCITY_VALID:
        return None
    speed, course = velocity.horizontal_mps, velocity.course_rad
    return speed * cos(course), speed * sin(course), -velocity.up_mps


def _covariance(sigma: gsof.PositionSigma | None) -> np.ndarray[Any, np.dtype[np.float64]] | None:
    """Return the covariance of north, east, down."""
    if sigma is None:
        return None
    ne = sigma.east_north_m2
    return np.array(
        [
            [sigma.north_sigma_m**2, ne, 0.0],
            [ne, sigma.east_sigma_m**2, 0.0],
            [0.0, 0.0, sigma.up_sigma_m**2],
        ]
    )


# --- POS groups ---

POINTS = ("vehicle", "sensor1", "sensor2")  # of which a POS sends the navigation


class PosParser(_Parser):
    """Decodes POS groups; messages (``$MSG``) and all other groups are framed and counted.

    Args:
        settings: ``date_floor`` is the oldest accepted date, ``add_weeks`` is added to all weeks, ``solution_of`` is
            the point whose navigation is returned.
        wanted: the record types to return; None: all.

    Raises:
        DriverSettingsError: ``solution_of`` is no point of a POS.
    """

    def __init__(self, settings: DeviceSettings, *, wanted: tuple[type, ...] | None = None) -> None:
        super().__init__(settings, wanted, (POS, NMEA))
        self._status: tuple[int, int, int] | None = None  # week, time of week (ns) and leap seconds of the last group 3
        self._imu_told: tuple[int, int] | None = None  # type and rate of the last group 4
        point = settings.config.get("solution_of") or POINTS[0]
        if point not in POINTS:
            raise DriverSettingsError(f"solution_of: got {point!r}, want {', '.join(POINTS[:-1])} or {POINTS[-1]}")
        self._sensor = SensorSolutions(POINTS.index(point), self.counters) if point != POINTS[0] else None

    def finish(self) -> Items:
        """Count a sensor's navigation that no navigation of the vehicle followed."""
        if self._sensor is not None:
            self._sensor.finish()
        return []

    def _decode(self, frame: Frame) -> Items:
        if frame.kind != POS.name:
            return []
        decoders: dict[str, Callable[[int, bytes], Items]] = {
            **self._sensor_decoders(),
            "GRP1": self._navigation,
            "GRP2": self._performance,
            "GRP3": self._gnss_status,
            "GRP4": self._imu,
            "GRP5": self._event,
            "GRP6": self._event,
            "GRP7": self._pps,
            "GRP10": self._general,
        }
        decode = decoders.get(pos_name(frame.data))
        return [] if decode is None else decode(frame.host_time_ns, frame.data)

    def _sensor_decoders(self) -> dict[str, Callable[[int, bytes], Items]]:
        if self._sensor is None:
            return {}
        index = self._sensor.index
        return {
            f"GRP{pos.SENSORS[index].number}": self._sensor_navigation,
            f"GRP{pos.SENSOR_PERFORMANCES[index].number}": self._sensor_performance,
        }

    def _tag(self, times: pos.TimeDistance) -> TimeTag | None:
        """Return GPS time of a group: of its first or second time, whichever is GPS or UTC time; None, counted, else.

        The week is that of the last group 3, carried over the week's end. UTC becomes GPS time by its leap seconds.
        """
        kinds = ((times.time1_s, times.time_types & 0xF), (times.time2_s, times.time_types >> 4))
        for kind in (pos.TIME_GPS, pos.TIME_UTC):
            seconds = next((seconds for seconds, found in kinds if found == kind), None)
            if seconds is None or not -1.0 < seconds < WEEK_S + 1.0:
                continue
            if kind == pos.TIME_UTC and self._status is None:
                continue
            leap = self._status[2] if kind == pos.TIME_UTC and self._status is not None else 0
            time_ns = round(seconds * SECOND_NS) + leap * SECOND_NS
            if self._status is None:
                return TimeTag(TimeScale.GPS, time_ns % WEEK_NS)
            week, status_ns, _ = self._status
            week += time_ns // WEEK_NS + round((status_ns - time_ns % WEEK_NS) / WEEK_NS)
            return TimeTag(TimeScale.GPS, time_ns % WEEK_NS, week=week)
        self.counters.errors["time_unknown"] += 1
        return None

    def _navigation(self, host_time_ns: int, data: bytes) -> Items:
        found = pos.NAVIGATION.decode(data)
        if found is None or not all(map(isfinite, (*found[0], *found[1]))):
            self.counters.count_bad("bad_length" if found is None else "not_finite")
            return []
        times, navigation = found
        if self._sensor is None and navigation.alignment not in (pos.FULL_NAVIGATION, pos.FINE_ALIGNMENT):
            self.counters.errors["ins_not_aligned"] += 1
            return []
        week, time_ns = self._moment(times)
        if week is None:
            return []
        if self._sensor is not None:
            return self._sensor.add_vehicle(host_time_ns, time_ns, navigation)
        return [navigation_row(host_time_ns, week, time_ns, navigation, self._sigmas)]

    def _moment(self, times: pos.TimeDistance) -> tuple[int | None, int]:
        """Return week and time of week of a solution; no week, counted, where one of them is unknown."""
        tag = self._tag(times)
        if tag is not None and tag.week is None:
            self.counters.errors["time_unknown"] += 1
        return (None, 0) if tag is None else (tag.week, tag.time_ns)

    def _sensor_navigation(self, host_time_ns: int, data: bytes) -> Items:
        assert self._sensor is not None
        found = pos.SENSORS[self._sensor.index].decode(data)
        if found is None or not all(map(isfinite, (*found[0], *found[1][:9]))):
            self.counters.count_bad("bad_length" if found is None else "not_finite")
            return []
        week, time_ns = self._moment(found[0])
        return [] if week is None else self._sensor.add_sensor(host_time_ns, week, time_ns, found[1])

    def _sensor_performance(self, host_time_ns: int, data: bytes) -> Items:
        assert self._sensor is not None
        found = pos.SENSOR_PERFORMANCES[self._sensor.index].decode(data)
        if found is None or not all(map(isfinite, (*found[0], *found[1]))):
            self.counters.count_bad("bad_length" if found is None else "not_finite")
            return []
        tag = self._tag(found[0])
        if tag is not None:
            self._sensor.sigmas = sigmas_of(tag.time_ns, found[1])
        return []

    def _performance(self, host_time_ns: int, data: bytes) -> Items:
        found = pos.PERFORMANCE.decode(data)
        if found is None or not all(map(isfinite, (*found[0], *found[1]))):
            self.counters.count_bad("bad_length" if found is None else "not_finite")
            return []
        tag = self._tag(found[0])
        if tag is not None:
            self._sigmas = sigmas_of(tag.time_ns, found[1])
        return []

    def _gnss_status(self, host_time_ns: int, data: bytes) -> Items:
        """Note week and leap seconds; return the status."""
        found = pos.decode_gnss_status(data)
        if found is None or not all(map(isfinite, (*found[0], *found[2]))):
            self.counters.count_bad("bad_length" if found is None else "not_finite")
            return []
        times, solution, status = found
        week = self._week(status.week, host_time_ns) if 0 < status.week <= 0xFFFF else None
        leap = round(status.leap_seconds) if abs(status.leap_seconds) < 100 else None
        if week is not None and leap is not None:
            seconds = times.time1_s if times.time_types & 0xF == pos.TIME_GPS else times.time1_s + leap
            if times.time_types & 0xF in (pos.TIME_GPS, pos.TIME_UTC) and 0.0 <= seconds < WEEK_S:
                self._status = week, round(seconds * SECOND_NS), leap
        return [DeviceStatus(host_time_ns, {"solution": solution, **status._asdict()}, message="GRP3")]

    def _imu(self, host_time_ns: int, data: bytes) -> Items:
        """Return the IMU's type where it is new; its increments have no public scale."""
        found = pos.IMU.decode(data)
        if found is None:
            self.counters.count_bad("bad_length")
            return []
        head = found[1]
        self.counters.errors["imu_scale_unknown"] += 1
        if head.bad_frames:
            self.counters.errors["imu_bad_frames"] += head.bad_frames.bit_length()
        if self._imu_told == (head.imu_type, head.rate):
            return []
        self._imu_told = head.imu_type, head.rate
        status: dict[str, float | int | str | bool] = {"imu_type": head.imu_type, "rate_code": head.rate}
        if head.rate < len(pos.IMU_RATES_HZ):
            status["rate_hz"] = pos.IMU_RATES_HZ[head.rate]
        return [DeviceStatus(host_time_ns, status, message="GRP4")]

    def _event(self, host_time_ns: int, data: bytes) -> Items:
        layout = pos.EVENT_1 if pos_name(data) == "GRP5" else pos.EVENT_2
        found = layout.decode(data)
        if found is None or not all(map(isfinite, found[0])):
            self.counters.count_bad("bad_length" if found is None else "not_finite")
            return []
        tag = self._tag(found[0])
        if tag is None:
            return []
        channel = "EVENT1" if layout is pos.EVENT_1 else "EVENT2"
        valid = tag.week is not None
        name = pos_name(data)
        return [EventMark(host_time_ns, tag, channel, rising=None, count=found[1].pulse, valid=valid, message=name)]

    def _pps(self, host_time_ns: int, data: bytes) -> Items:
        """Return the second of a pulse; group 7 is sent after each pulse, with its time."""
        found = pos.PPS.decode(data)
        if found is None or not all(map(isfinite, found[0])):
            self.counters.count_bad("bad_length" if found is None else "not_finite")
            return []
        tag = self._tag(found[0])
        if tag is None:
            return []
        leap = self._status[2] if self._status is not None else None
        valid = found[1].status == pos.PPS_SYNCHRONISED and tag.week is not None
        tag = replace(tag, leap_seconds=leap)
        return [TimeMessage(host_time_ns, tag, NamesEdge.PREVIOUS, bound=True, valid=valid, message="GRP7")]

    def _general(self, host_time_ns: int, data: bytes) -> Items:
        found = pos.GENERAL.decode(data)
        if found is None:
            self.counters.count_bad("bad_length")
            return []
        return [DeviceStatus(host_time_ns, dict(found[1]._asdict()), message="GRP10")]


DRIVERS = (
    Driver(
        protocol="gsof",
        kind="gnss",
        transports=STREAM_TRANSPORTS,
        yields=(TimeMessage, GnssFix, InsSolution, DeviceStatus),
        summary="Trimble GSOF reports, with the INS of an Applanix receiver (records 1 2 8 12 16 38 41 49 50 70)",
        make_parser=GsofParser,
        make_time_parser=times_only(GsofParser),
        names_edge=NamesEdge.PREVIOUS,
    ),
    Driver(
        protocol="applanix-pos",
        kind="gnss",
        transports=STREAM_TRANSPORTS,
        yields=(TimeMessage, InsSolution, EventMark, DeviceStatus),
        summary="Applanix POS groups (1 to 7, 10, 102 to 105): INS, PPS and events of a POS AV, LV or MV",
        make_parser=PosParser,
        make_time_parser=times_only(PosParser),
        names_edge=NamesEdge.PREVIOUS,
    ),
)
