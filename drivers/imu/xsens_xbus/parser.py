"""Xsens (Movella) MTi over serial: Xbus messages of type MTData2, with any items, order and number formats.

Sources: see `swath.drivers.imu.xsens_xbus.wire`; the tests compare two recordings with another library's decoding.

- Acceleration and RateOfTurn are means over the interval between two samples (the device integrates and divides
  again, MT0605P 4.9.3) in the axes of its housing. With ``sample = "increment"``, DeltaV and DeltaQ are used instead
  and divided by the interval 1/``rate_hz``.
- SampleTimeFine counts 0.1 ms (MT0605P 4.12.3).
- UtcTime gives the UTC of the sample; the first sample in the first half of each second names it. GnssPvtData names its
  own epoch instead while no sample has UTC.
- GnssPvtData is a fix; LatLon, AltitudeEllipsoid, VelocityXYZ and an orientation in one message are a solution
  (`swath.drivers.imu.xsens_xbus.receiver`). The leap seconds that GnssPvtData implies place its UTC in GPS time.
- Other items (rotation matrix, triggers, high-rate data) are skipped by their length.
"""

from __future__ import annotations

import datetime as dt
from fractions import Fraction
from math import atan2, hypot, isfinite, nan
from typing import NamedTuple

import numpy as np

from swath.drivers.driver import STREAM_TRANSPORTS, Driver, receiver_inside, times_only
from swath.drivers.framing.framer import Frame
from swath.drivers.framing.kinds import XBUS, XBUS_EXTENDED, XBUS_MTDATA2
from swath.drivers.framing.parser import FramedParser
from swath.drivers.gnss.date_floor import GREATEST_WEEK, WEEK_MS
from swath.drivers.imu.counters import CounterUnwrapper, GapCounter, nanoseconds
from swath.drivers.imu.unit_time import LATEST_IN_SECOND_NS, WEEK_NS, Moment, UnitTime
from swath.drivers.imu.xsens_xbus import receiver, wire
from swath.drivers.parser import DeviceSettings, DriverSettingsError
from swath.drivers.record_rows import Row, join_rows
from swath.georef.records import (
    IMU_DTYPE,
    DeviceStatus,
    GnssFix,
    ImuSamples,
    InsSolution,
    NamesEdge,
    Record,
    TimeMessage,
    TimeScale,
    TimeTag,
)
from swath.georef.timescales.gps_time import MILLISECOND_NS, SECOND_NS, gps_ns_from_utc

TICK_HZ = 10_000
COUNTER_BITS = 16
TICK_BITS = 32
COARSE_FORMATS = {wire.FLOAT32: "float 32", wire.FP1220: "fixed point 12.20"}


class Sample(NamedTuple):
    """Values of one message for a row, and its raw ticks (−1 where absent)."""

    host_time_ns: int
    ticks: int
    specific_force: wire.Values
    angular_rate: wire.Values
    temperature_c: float
    status: int


def rotation_vector(quaternion: wire.Values) -> wire.Values:
    """Return the rotation of a quaternion (scalar first, any length) as a vector in radians, by the shorter way."""
    scalar, *vector = quaternion if quaternion[0] >= 0.0 else tuple(-part for part in quaternion)
    length = hypot(*vector)
    factor = 2.0 * atan2(length, scalar) / length if length else 0.0
    return tuple(factor * part for part in vector)


class XbusParser(FramedParser):
    """Converts MTData2 to samples, solutions, fixes and, once a second, to `TimeMessage`."""

    def __init__(self, settings: DeviceSettings, *, wanted: tuple[type, ...] | None = None) -> None:
        """Prepare a parser for one device.

        Args:
            settings: of the device's table, ``sample``, ``rate_hz`` and ``date_floor`` are read.
            wanted: the record types to return; None: all.

        Raises:
            DriverSettingsError: increments are configured without a rate to divide them by.
        """
        super().__init__((XBUS,), wanted)
        self._source = settings.source
        self._increments = settings.config.get("sample") == "increment"
        self._rate_hz = float(settings.config.get("rate_hz") or 0.0)
        if self._increments and self._rate_hz <= 0.0:
            raise DriverSettingsError('rate_hz: needed with sample = "increment", to divide by the interval')
        self._gaps = GapCounter(COUNTER_BITS)
        self._unwrapper = CounterUnwrapper(TICK_BITS, TICK_HZ)
        self._time = UnitTime(settings, self.counters, "GnssPvtData")
        self._last_second: tuple[int, ...] | None = None  # of an UtcTime, which named it
        self._leap_seconds: int | None = None
        self._status_word = 0
        self._coarse: str | None = None  # number format of a LatLon that resolves less than the filter

    def remarks(self) -> list[str]:
        """Return a line where positions come in a format that rounds them to 0.1 m or more."""
        if self._coarse is None:
            return []
        return [
            f"{self._source}: LatLon comes as {self._coarse}, which rounds positions to 0.1 m or more; "
            "set its precision to fixed point 16.32 or float 64 in MT Manager"
        ]

    def decode_frames(self, frames: list[Frame]) -> list[Record]:
        """Return time messages, fixes and solutions in order, then the samples of all frames."""
        records: list[Record | Row] = []
        samples: list[Sample] = []
        packets: list[int] = []
        for frame in frames:
            if frame.data[2] != XBUS_MTDATA2:
                continue
            found = wire.split_items(frame.data[6 if frame.data[3] == XBUS_EXTENDED else 4 : -1])
            items = wire.read_items(found) if found is not None else None
            if found is None or items is None:
                self.counters.count_bad("bad_length")
                continue
            packets += items.get(wire.PACKET_COUNTER, ())
            (self._status_word,) = items.get(wire.STATUS_WORD, (self._status_word,))
            if wire.GNSS_PVT_DATA in items:
                records += self._pvt(frame.host_time_ns, wire.Pvt(*items[wire.GNSS_PVT_DATA]))
            else:
                records += self._time_message(frame.host_time_ns, items)
            if wire.GNSS_SAT_INFO in items:
                records.append(receiver.satellites_status(frame.host_time_ns, items[wire.GNSS_SAT_INFO]))
            if receiver.is_whole(items):
                records += self._solution(frame.host_time_ns, items, {kind: form for kind, (form, _) in found.items()})
            if self._wanted is None or ImuSamples in self._wanted:
                samples += self._sample(frame.host_time_ns, items)
        missing = self._gaps.missing(np.array(packets, dtype=np.uint64))
        if missing:
            self.counters.errors["packet_gap"] += missing
        rows = [self._rows(samples)] if samples else []
        return [*join_rows(records), *rows]

    # --- time and solutions ---

    def _utc(self, items: wire.Items) -> tuple[dt.date, int] | None:
        """Return date and nanoseconds of the day of an UtcTime; None, counted, where they are impossible."""
        nanosecond, year, month, day, hour, minute, second, _ = items[wire.UTC_TIME]
        try:
            date = dt.date(year, month, day)
        except ValueError:
            date = None
        if date is None or hour > 23 or minute > 59 or second > 60 or nanosecond > SECOND_NS:
            self.counters.errors["bad_value"] += 1
            return None
        return date, receiver.seconds_ns(items[wire.UTC_TIME])

    def _time_message(self, host_time_ns: int, items: wire.Items) -> list[Record]:
        """Return the second of the first sample in its first half; its edge is the one before the arrival."""
        named = items[wire.UTC_TIME][1:7] if wire.UTC_TIME in items else None
        if named is None or named == self._last_second:
            return []
        utc = self._utc(items)
        if utc is None or utc[1] % SECOND_NS >= LATEST_IN_SECOND_NS:
            return []
        self._last_second = named
        date, of_day_ns = utc
        whole_ns = of_day_ns // SECOND_NS * SECOND_NS
        tag = TimeTag(TimeScale.UTC, whole_ns, date=date, leap_seconds=self._leap_seconds)
        valid = items[wire.UTC_TIME][7] & wire.UTC_VALID == wire.UTC_VALID
        return [TimeMessage(host_time_ns, tag, NamesEdge.PREVIOUS, valid=valid, message="UtcTime")]

    def _pvt(self, host_time_ns: int, pvt: wire.Pvt) -> list[Record]:
        """Return the fix of the receiver, and its second while no sample has UTC."""
        if pvt.itow_ms >= WEEK_MS or abs(pvt.nano_ns) > SECOND_NS:
            self.counters.count_bad("bad_value")
            return []
        week, time_ns, leap = receiver.epoch_of(pvt)
        vouched = pvt.valid & wire.UTC_VALID == wire.UTC_VALID and leap is not None
        if vouched:
            self._leap_seconds = leap
        moment = self._time.moment(week, time_ns, valid=vouched) if week is not None else None
        fix = receiver.gnss_fix(
            host_time_ns, pvt, moment.week if moment is not None else None, time_ns, self._status_word
        )
        if fix is None:
            self.counters.count_bad("bad_value")
            return []
        if self._last_second is not None:
            return [fix]
        return [*self._time.name_second(host_time_ns, _rounded(moment), leap if vouched else None), fix]

    def _solution(self, host_time_ns: int, items: wire.Items, frames: dict[int, int]) -> list[Record | Row]:
        """Return the unit's own solution where it vouches for it and its time is known."""
        number_format = frames[wire.LAT_LON] & wire.FORMAT_BITS
        self._coarse = COARSE_FORMATS.get(number_format)
        if not receiver.has_solution(items):
            self.counters.errors["ins_no_solution"] += 1
            return []
        utc = self._utc(items) if wire.UTC_TIME in items else None
        known = utc is not None and items[wire.UTC_TIME][7] & wire.UTC_VALID == wire.UTC_VALID
        if utc is None or not known or self._leap_seconds is None:
            self.counters.errors["time_unknown"] += 1
            return []
        gps_ns = gps_ns_from_utc(*utc, self._leap_seconds)
        week, tow_ns = divmod(gps_ns, WEEK_NS)
        if week > GREATEST_WEEK:
            self.counters.count_bad("bad_value")
            return []
        if self._time.moment(week, tow_ns, valid=True) is None:  # before the floor, which it counts
            return []
        (status,) = items.get(wire.STATUS_WORD) or items[wire.STATUS_BYTE]
        axes = {kind: form & wire.AXES_BITS for kind, form in frames.items()}
        row = receiver.solution_row(host_time_ns, gps_ns, items, axes, status)
        if row is None:
            self.counters.count_bad("bad_value")
            return []
        return [row]

    # --- samples ---

    def _sample(self, host_time_ns: int, items: wire.Items) -> list[Sample]:
        """Return the sample of a message; an empty list, counted, for a message with only a part of it or with the
        other kind.
        """
        kinds = (wire.DELTA_V, wire.DELTA_Q) if self._increments else (wire.ACCELERATION, wire.RATE_OF_TURN)
        force, rate = (items.get(kind) for kind in kinds)
        if force is None or rate is None:
            if force is not None or rate is not None:
                self.counters.errors["sample_incomplete"] += 1
            elif self._increments and wire.ACCELERATION in items:
                self.counters.errors["rates_only"] += 1
            elif not self._increments and wire.DELTA_V in items:
                self.counters.errors["increments_only"] += 1
            return []
        if self._increments:
            force = tuple(part * self._rate_hz for part in force)
            rate = tuple(part * self._rate_hz for part in rotation_vector(rate))
        if not all(map(isfinite, (*force, *rate))):
            self.counters.count_bad("bad_value")
            return []
        (ticks,) = items.get(wire.SAMPLE_TIME_FINE, (-1,))
        (celsius,) = items.get(wire.TEMPERATURE, (nan,))
        (status,) = items.get(wire.STATUS_WORD) or items.get(wire.STATUS_BYTE) or (0,)
        return [Sample(host_time_ns, ticks, force, rate, celsius, status)]

    def _rows(self, samples: list[Sample]) -> ImuSamples:
        """Convert samples to rows and unwrap their ticks."""
        rows = np.zeros(len(samples), IMU_DTYPE)
        host, ticks, force, rate, celsius, status = zip(*samples, strict=True)
        rows["host_time_ns"], rows["specific_force_b"], rows["angular_rate_b"] = host, force, rate
        rows["temperature_c"], rows["status"] = celsius, status
        rows["pps_time_ns"] = rows["gps_week"] = rows["device_time_ns"] = -1
        raw = np.array(ticks, dtype=np.int64)
        timed = raw >= 0
        counts, restart = self._unwrapper.unwrap(raw[timed].astype(np.uint64), rows["host_time_ns"][timed])
        if restart.any():
            self.counters.errors["restart"] += int(restart.sum())
        rows["device_time_ns"][timed] = nanoseconds(counts, Fraction(TICK_HZ))
        return ImuSamples(rows)


def _rounded(moment: Moment | None) -> Moment | None:
    """Return a moment on the nearest millisecond, so that an epoch just before its second names it."""
    if moment is None:
        return None
    week, tow_ns = divmod(round(moment.gps_ns / MILLISECOND_NS) * MILLISECOND_NS, WEEK_NS)
    return Moment(week, tow_ns, moment.valid)


make_time_parser = times_only(XbusParser)

UNIT = Driver(
    protocol="xsens-xbus",
    kind="imu",
    transports=STREAM_TRANSPORTS,
    yields=(ImuSamples, InsSolution, TimeMessage, GnssFix, DeviceStatus),
    summary="Xsens MTi over serial: Xbus, MTData2; samples, the unit's own solution, its receiver",
    make_parser=XbusParser,
    make_time_parser=make_time_parser,
    names_edge=NamesEdge.PREVIOUS,
)
DRIVERS = (UNIT, receiver_inside(UNIT))
