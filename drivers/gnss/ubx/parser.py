"""u-blox UBX: NAV-PVT, NAV-PVAT, NAV-HPPOSLLH, NAV-COV, NAV-TIMEGPS, NAV-TIMEUTC, NAV-TIMELS, NAV-EOE, TIM-TP, TIM-TM2;
NAV-POSLLH, NAV-VELNED, NAV-STATUS and NAV-SOL of older receivers; NAV-RELPOSNED of two receivers on one
body; NAV-ATT, ESF-MEAS, ESF-RAW and ESF-INS of receivers with inertial sensors.

RXM-RAWX gives its time where no other message of the stream gives one: in a log of raw measurements for
post-processing. All other messages, RTCM3 and NMEA on the same port included, are framed, checked and counted.

Time: NAV-TIMEGPS and NAV-SOL carry GPS week and time of week in one message, NAV-PVT the UTC date; they refer to the
previous PPS edge, and so does NAV-TIMEUTC. TIM-TP refers to the next edge and is bound to it; its quantisation is the
edge's own error, edge = true second − qErr (u-blox states no sign; a counter started by a reference and stopped by an
F9T's pulse needed + qErr, anderswallin.net 2019/10). The epoch is a whole millisecond of iTOW by definition: a time
message's tag is rounded to it, a fix's tag is not.

An iTOW is joined with a week of the same message or of the same iTOW only, so that a week's roll-over cannot put a
fix of the new week into the old one. NAV-PVT and NAV-TIMEUTC carry UTC and iTOW: their difference is the leap count
that the receiver uses for its UTC, right or stale, and the second is that of iTOW. Where NAV-TIMELS or NAV-TIMEGPS
gives another count with its valid bit set, UTC is corrected by that count (``utc_contradicts_leap``). A UTC that
differs from its iTOW by anything but a whole number of seconds, up to 60, is not valid (``utc_contradicts_itow``).

Fix: the NAV messages of one iTOW make one `GnssFix` (`swath.drivers.gnss.epochs`), complete at NAV-EOE at the latest:
NAV-PVT, refined by NAV-HPPOSLLH, with the covariances of NAV-COV or else of the accuracies, and NAV-TIMEGPS's week.
Without NAV-PVT the older messages make it (`swath.drivers.gnss.ubx.fix`). Where a receiver sends no position in UBX,
the NMEA in its stream gives the fixes. NAV-ATT or NAV-PVAT makes a row of `InsSolution` with the fix of its epoch.
"""

from __future__ import annotations

import datetime as dt
import math
from collections.abc import Callable
from typing import Any, Protocol, TypeAlias, TypeVar

from swath.drivers.driver import STREAM_TRANSPORTS, Driver, times_only
from swath.drivers.framing.framer import Frame
from swath.drivers.framing.kinds import GNSS_KINDS
from swath.drivers.framing.parser import FramedParser
from swath.drivers.gnss.date_floor import GPS_EPOCH, ReceiverDates, leap_seconds_of
from swath.drivers.gnss.epochs import EpochGatherer
from swath.drivers.gnss.nmea.beside import NmeaFixes
from swath.drivers.gnss.ubx import messages as ubx
from swath.drivers.gnss.ubx.fix import (
    POSITION_MESSAGES,
    NavMessage,
    baseline_heading,
    ins_row,
    merge_epoch,
    pvt_of,
)
from swath.drivers.gnss.ubx.sensors import MEAS_KEY, RAW_KEY, SensorSamples, vehicle_motion
from swath.drivers.gnss.ubx.startup import startup_messages
from swath.drivers.parser import DeviceSettings
from swath.drivers.record_rows import Row
from swath.georef.records import (
    DeviceStatus,
    EventMark,
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

MS_NS = 1_000_000
DAY_NS = 86_400_000_000_000
DAY_MS = 86_400_000
WEEK_MS = 604_800_000


class _HasItow(Protocol):
    @property
    def itow_ms(self) -> int: ...


_AnyT = TypeVar("_AnyT")
_NavT = TypeVar("_NavT", bound=_HasItow)


class MessageError(ValueError):
    """A message with a good checksum has impossible content; it is counted as bad."""


Items: TypeAlias = list[Record | Row]

_EPOCH = (GnssFix, InsSolution)  # records that an epoch's messages make together
GIVES: dict[bytes, tuple[type, ...]] = {  # record types to which a message contributes
    ubx.NAV_PVT.key: (TimeMessage, *_EPOCH),
    ubx.NAV_PVAT.key: (TimeMessage, *_EPOCH),
    ubx.NAV_TIMEGPS.key: (TimeMessage, *_EPOCH),
    ubx.NAV_TIMEUTC.key: (TimeMessage,),
    ubx.NAV_TIMELS.key: (TimeMessage,),
    ubx.NAV_SOL.key: (TimeMessage, *_EPOCH),
    ubx.TIM_TP.key: (TimeMessage,),
    ubx.RXM_RAWX.key: (TimeMessage,),
    ubx.NAV_HPPOSLLH.key: _EPOCH,
    ubx.NAV_POSLLH.key: _EPOCH,
    ubx.NAV_VELNED.key: _EPOCH,
    ubx.NAV_STATUS.key: _EPOCH,
    ubx.NAV_COV.key: _EPOCH,
    ubx.NAV_EOE.key: _EPOCH,
    ubx.NAV_ATT.key: (InsSolution,),
    ubx.NAV_RELPOSNED.key: (GnssHeading,),
    ubx.TIM_TM2.key: (EventMark,),
    MEAS_KEY: (ImuSamples,),
    RAW_KEY: (ImuSamples,),
    ubx.ESF_INS.key: (DeviceStatus,),
}

NAV_PARTS: dict[bytes, tuple[str, ubx.Layout[Any]]] = {  # messages that contribute to their epoch only
    ubx.NAV_HPPOSLLH.key: ("NAV-HPPOSLLH", ubx.NAV_HPPOSLLH),
    ubx.NAV_POSLLH.key: ("NAV-POSLLH", ubx.NAV_POSLLH),
    ubx.NAV_VELNED.key: ("NAV-VELNED", ubx.NAV_VELNED),
    ubx.NAV_STATUS.key: ("NAV-STATUS", ubx.NAV_STATUS),
    ubx.NAV_ATT.key: ("NAV-ATT", ubx.NAV_ATT),
}


class UbxParser(FramedParser):
    """Converts UBX frames to records.

    Args:
        settings: ``date_floor`` is the oldest accepted date (or week), ``add_weeks`` is added to all of them;
            ``tick_hz`` is the rate of the inertial sensors' time tags.
        wanted: the record types to return; None: all.

    Raises:
        DriverSettingsError: a setting is not valid.
    """

    def __init__(self, settings: DeviceSettings, *, wanted: tuple[type, ...] | None = None) -> None:
        super().__init__(GNSS_KINDS, wanted)
        self._dates = ReceiverDates(settings)
        self._epochs: EpochGatherer[tuple[int, NavMessage]] = EpochGatherer(self.counters)
        self._gathers = wanted is None or not set(wanted).isdisjoint(_EPOCH)
        self._nmea = NmeaFixes(settings, self.counters) if wanted is None or GnssFix in wanted else None
        self._sensors = SensorSamples(settings, self.counters)
        self._leap_seconds: int | None = None  # the last valid count of NAV-TIMELS or NAV-TIMEGPS
        self._vouched: bool | None = None  # whether the latest navigation message with time marks it as valid
        decoders: dict[bytes, Callable[[int, bytes], Items]] = {
            ubx.NAV_PVT.key: self._nav_pvt,
            ubx.NAV_PVAT.key: self._nav_pvat,
            ubx.NAV_TIMEGPS.key: self._nav_timegps,
            ubx.NAV_TIMEUTC.key: self._nav_timeutc,
            ubx.NAV_TIMELS.key: self._nav_timels,
            ubx.NAV_SOL.key: self._nav_sol,
            ubx.TIM_TP.key: self._tim_tp,
            ubx.RXM_RAWX.key: self._rxm_rawx,
            ubx.NAV_HPPOSLLH.key: self._nav_part,
            ubx.NAV_POSLLH.key: self._nav_part,
            ubx.NAV_VELNED.key: self._nav_part,
            ubx.NAV_STATUS.key: self._nav_part,
            ubx.NAV_ATT.key: self._nav_part,
            ubx.NAV_RELPOSNED.key: self._nav_relposned,
            ubx.NAV_COV.key: self._nav_cov,
            ubx.NAV_EOE.key: self._nav_eoe,
            ubx.TIM_TM2.key: self._tim_tm2,
            MEAS_KEY: self._esf_meas,
            RAW_KEY: self._esf_raw,
            ubx.ESF_INS.key: self._esf_ins,
        }
        self._decoders = {
            key: decode for key, decode in decoders.items() if wanted is None or not set(wanted).isdisjoint(GIVES[key])
        }

    def finish(self) -> Items:
        """Return the records of the last epoch."""
        items = self._merged(self._epochs.end())
        return items + (list(self._nmea.close()) if self._nmea is not None else [])

    def remarks(self) -> list[str]:
        """Return remarks on the receiver's dates."""
        return self._dates.remarks()

    def decode_frames(self, frames: list[Frame]) -> Items:
        """Decode consecutive frames; return their records, or rows of them, in order."""
        items: Items = []
        for frame in frames:
            if frame.kind == "nmea" and self._nmea is not None:
                items += self._nmea.add(frame)
            elif frame.kind == "ubx" and self._nmea is not None:
                self._nmea.own_frame()
            decoder = self._decoders.get(frame.data[2:4])
            if decoder is None or frame.kind != "ubx":
                continue
            try:
                items += decoder(frame.host_time_ns, frame.data)
            except MessageError:
                self.counters.bad_messages += 1
        return items

    # --- navigation messages ---

    def _nav_pvt(self, host_time_ns: int, frame: bytes) -> Items:
        message = _checked(ubx.NAV_PVT.decode(frame))
        if len(frame) < ubx.PVT_FLAGS3_FRAME_BYTES:
            message = message._replace(flags3=0)
        items = self._time_of_pvt(host_time_ns, message, "NAV-PVT")
        return items + self._add(host_time_ns, "NAV-PVT", message._replace(**self._moved_date(host_time_ns, message)))

    def _nav_pvat(self, host_time_ns: int, frame: bytes) -> Items:
        message = _checked(ubx.NAV_PVAT.decode(frame))
        items = self._time_of_pvt(host_time_ns, pvt_of(message), "NAV-PVAT")
        return items + self._add(host_time_ns, "NAV-PVAT", message._replace(**self._moved_date(host_time_ns, message)))

    def _time_of_pvt(self, host_time_ns: int, message: ubx.NavPvt, name: str) -> Items:
        has_date = message.valid & ubx.PVT_VALID_DATE != 0
        has_time = message.valid & ubx.PVT_VALID_TIME != 0
        self._vouched = has_date and has_time and message.valid & ubx.PVT_FULLY_RESOLVED != 0
        return self._utc_message(host_time_ns, message, has_date, self._vouched, name) if has_time else []

    def _moved_date(self, host_time_ns: int, message: ubx.NavPvt | ubx.NavPvat) -> dict[str, int]:
        """Return year, month and day after the move by roll-overs, as far as they are a date."""
        if not message.valid & ubx.PVT_VALID_DATE:
            return {}
        try:
            date = self._dates.date(dt.date(message.year, message.month, message.day), host_time_ns)
        except ValueError:
            return {}
        return {"year": date.year, "month": date.month, "day": date.day}

    def _nav_part(self, host_time_ns: int, frame: bytes) -> Items:
        """Take a message that contributes to its epoch only."""
        name, layout = NAV_PARTS[frame[2:4]]
        return self._add(host_time_ns, name, _checked(layout.decode(frame)))

    def _nav_timeutc(self, host_time_ns: int, frame: bytes) -> Items:
        message = _checked(ubx.NAV_TIMEUTC.decode(frame))
        vouched = message.valid & ubx.TIMEUTC_ALL == ubx.TIMEUTC_ALL
        has_date = message.valid & ubx.TIMEUTC_UTC != 0
        return self._utc_message(host_time_ns, message, has_date, vouched, "NAV-TIMEUTC") if has_date else []

    def _utc_message(
        self, host_time_ns: int, message: ubx.NavPvt | ubx.NavTimeutc, has_date: bool, vouched: bool, name: str
    ) -> Items:
        """Return the second of the previous edge in UTC, valid if it agrees with the message's own iTOW."""
        tag = self._utc_tag(host_time_ns, message, has_date)
        agrees = tag.date is None or tag.leap_seconds is not None
        if not agrees:
            self.counters.errors["utc_contradicts_itow"] += 1
        believed = tag.date is not None and self._date_believed(tag.date)
        valid = vouched and believed and agrees
        return [TimeMessage(host_time_ns, tag, NamesEdge.PREVIOUS, valid=valid, message=name)]

    def _utc_tag(self, host_time_ns: int, message: ubx.NavPvt | ubx.NavTimeutc, has_date: bool) -> TimeTag:
        """Return UTC of a message to the millisecond, with the leap seconds that its own iTOW implies.

        Where the receiver reports a valid leap count other than the one in its UTC, UTC is corrected by it: the second
        is that of iTOW.
        """
        if message.hour > 23 or message.minute > 59 or message.second > 60 or abs(message.nano_ns) > 1_000_000_000:
            raise MessageError("time of day")
        second = message.hour * 3600 + message.minute * 60 + message.second
        milliseconds = second * 1000 + round(message.nano_ns / MS_NS)
        if not has_date:
            return TimeTag(TimeScale.UTC, milliseconds * MS_NS)
        try:
            date = dt.date(message.year, message.month, message.day)
        except ValueError:
            raise MessageError("date") from None
        leap, known = leap_seconds_of(date, milliseconds, message.itow_ms), self._leap_seconds
        date = self._dates.date(date, host_time_ns)
        if leap is not None and known is not None and known != leap:
            self.counters.errors["utc_contradicts_leap"] += 1
            milliseconds, leap = milliseconds + (leap - known) * 1000, known
        if milliseconds < 0 and date > dt.date.min:
            date, milliseconds = date - dt.timedelta(days=1), milliseconds + DAY_MS
        elif milliseconds >= DAY_MS + 1000 and date < dt.date.max:
            date, milliseconds = date + dt.timedelta(days=1), milliseconds - DAY_MS
        return TimeTag(TimeScale.UTC, milliseconds * MS_NS, date=date, leap_seconds=leap)

    def _nav_timegps(self, host_time_ns: int, frame: bytes) -> Items:
        message = _checked(ubx.NAV_TIMEGPS.decode(frame))
        message = message._replace(week=self._dates.week(message.week, host_time_ns))
        has_leap = message.valid & ubx.TIMEGPS_LEAP != 0
        has_week = message.valid & ubx.TIMEGPS_WEEK != 0
        vouched = has_week and message.valid & ubx.TIMEGPS_TOW != 0
        if has_leap:
            self._leap_seconds = message.leap_seconds
        leap = message.leap_seconds if has_leap else None
        records = self._gps_message(host_time_ns, message.itow_ms, message.week, has_week, vouched, "NAV-TIMEGPS", leap)
        return records + self._add(host_time_ns, "NAV-TIMEGPS", message)

    def _nav_sol(self, host_time_ns: int, frame: bytes) -> Items:
        message = _checked(ubx.NAV_SOL.decode(frame))
        message = message._replace(week=self._dates.week(message.week, host_time_ns))
        has_week = message.flags & ubx.SOL_WEEK != 0
        vouched = has_week and message.flags & ubx.SOL_TOW != 0
        records = self._gps_message(host_time_ns, message.itow_ms, message.week, has_week, vouched, "NAV-SOL")
        return records + self._add(host_time_ns, "NAV-SOL", message)

    def _gps_message(
        self,
        host_time_ns: int,
        itow_ms: int,
        week: int,
        has_week: bool,
        vouched: bool,
        name: str,
        leap_seconds: int | None = None,
    ) -> Items:
        """Return the second of the previous edge by week and time of week of one message."""
        self._vouched = vouched
        tag = TimeTag(TimeScale.GPS, itow_ms * MS_NS, week=week if has_week else None, leap_seconds=leap_seconds)
        valid = vouched and self._week_believed(week)
        return [TimeMessage(host_time_ns, tag, NamesEdge.PREVIOUS, valid=valid, message=name)]

    def _nav_timels(self, host_time_ns: int, frame: bytes) -> Items:
        message = _checked(ubx.NAV_TIMELS.decode(frame))
        if not message.valid & ubx.TIMELS_CURRENT:
            return []
        self._leap_seconds = message.current
        tag = TimeTag(TimeScale.GPS, message.itow_ms * MS_NS, leap_seconds=message.current)
        # its own flag covers the leap seconds only
        valid = self._vouched is not False
        return [TimeMessage(host_time_ns, tag, NamesEdge.PREVIOUS, valid=valid, message="NAV-TIMELS")]

    def _nav_relposned(self, host_time_ns: int, frame: bytes) -> Items:
        message = _checked(ubx.NAV_RELPOSNED.decode(frame))
        if message.version != 1:  # version 0, of M8 and early F9, has no heading
            self.counters.errors["relposned_version"] += 1
            return []
        heading = baseline_heading(host_time_ns, message, self.counters)
        return [] if heading is None else [heading]

    def _nav_cov(self, host_time_ns: int, frame: bytes) -> Items:
        message = _checked(ubx.NAV_COV.decode(frame))
        if not all(map(math.isfinite, message)):
            raise MessageError("covariance")
        return self._add(host_time_ns, "NAV-COV", message)

    def _nav_eoe(self, host_time_ns: int, frame: bytes) -> Items:
        message = _checked(ubx.NAV_EOE.decode(frame))
        return self._merged(self._epochs.end()) if message.itow_ms == self._epochs.key else []

    def _rxm_rawx(self, host_time_ns: int, frame: bytes) -> Items:
        """Return the second of raw measurements, in a stream without navigation messages, which arrive earlier."""
        if self._vouched is not None:
            return []
        message = _present(ubx.RXM_RAWX.decode(frame))
        if not 0.0 <= message.receiver_tow_s < WEEK_MS / 1000:
            raise MessageError("time of week")
        known = message.status & ubx.RAWX_LEAP_KNOWN != 0
        leap = message.leap_seconds if known else None
        time_ns = round(message.receiver_tow_s * 1000) * MS_NS % (WEEK_MS * MS_NS)
        tag = TimeTag(TimeScale.GPS, time_ns, week=message.week, leap_seconds=leap)
        valid = known and self._week_believed(message.week)
        return [TimeMessage(host_time_ns, tag, NamesEdge.PREVIOUS, valid=valid, message="RXM-RAWX")]

    # --- pulse and event messages ---

    def _tim_tp(self, host_time_ns: int, frame: bytes) -> Items:
        message = _present(ubx.TIM_TP.decode(frame))
        if message.tow_ms >= WEEK_MS:
            raise MessageError("time of week")
        utc = message.flags & ubx.TP_UTC_BASE != 0
        gps = message.reference & ubx.TP_REFERENCE_MASK == ubx.TP_REFERENCE_GPS
        if not utc and not gps:
            self.counters.errors["tim_tp_time_base"] += 1  # GLONASS, BeiDou, Galileo time has other seconds or weeks
        week = self._dates.week(message.week, host_time_ns)
        time_ns = message.tow_ms * MS_NS + round(message.tow_sub_ms * MS_NS / 2**32)
        known = message.flags & ubx.TP_UTC_AVAILABLE != 0 if utc else gps
        locked = not message.flags & ubx.TP_NOT_LOCKED and self._vouched is not False
        quantised = not message.flags & ubx.TP_QUANTISATION_INVALID
        return [
            TimeMessage(
                host_time_ns,
                self._week_tag(week, time_ns, utc),
                NamesEdge.NEXT,
                bound=True,
                valid=known and locked and self._week_believed(week),
                quantisation_ns=-message.quantisation_ps / 1000.0 if quantised else 0.0,
                message="TIM-TP",
            )
        ]

    def _tim_tm2(self, host_time_ns: int, frame: bytes) -> Items:
        message = _present(ubx.TIM_TM2.decode(frame))
        base = message.flags >> ubx.TM2_BASE_SHIFT & ubx.TM2_BASE_MASK
        valid = message.flags & ubx.TM2_TIME_VALID != 0 and base != ubx.TM2_BASE_RECEIVER
        edges = (
            (ubx.TM2_NEW_RISING, True, message.week_rising, message.tow_rising_ms, message.tow_rising_sub_ns),
            (ubx.TM2_NEW_FALLING, False, message.week_falling, message.tow_falling_ms, message.tow_falling_sub_ns),
        )
        records: Items = []
        for flag, rising, week, tow_ms, sub_ns in edges:
            if not message.flags & flag:
                continue
            if tow_ms >= WEEK_MS:
                raise MessageError("time of week")
            week = self._dates.week(week, host_time_ns)
            records.append(
                EventMark(
                    host_time_ns,
                    self._week_tag(week, tow_ms * MS_NS + sub_ns, base == ubx.TM2_BASE_UTC),
                    channel=f"EXTINT{message.channel}",
                    rising=rising,
                    count=message.rising_count if rising else None,
                    sigma_s=message.accuracy_ns / 1e9,
                    valid=valid,
                    message="TIM-TM2",
                )
            )
        return records

    @staticmethod
    def _week_tag(week: int, time_ns: int, utc: bool) -> TimeTag:
        """Return week and time of week as GPS time, or as UTC with date and time of day."""
        if not utc:
            return TimeTag(TimeScale.GPS, time_ns, week=week)
        days, time_of_day_ns = divmod(time_ns, DAY_NS)
        return TimeTag(TimeScale.UTC, time_of_day_ns, date=GPS_EPOCH + dt.timedelta(days=week * 7 + days))

    # --- belief and epochs ---

    def _week_believed(self, week: int) -> bool:
        if week < self._dates.floor_week:
            self.counters.errors["date_before_floor"] += 1
            return False
        return True

    def _date_believed(self, date: dt.date) -> bool:
        if date < self._dates.floor:
            self.counters.errors["date_before_floor"] += 1
            return False
        return True

    def _add(self, host_time_ns: int, name: str, message: NavMessage) -> Items:
        if name in POSITION_MESSAGES and self._nmea is not None:
            self._nmea.own_position()
        return self._merged(self._epochs.add(message.itow_ms, name, (host_time_ns, message))) if self._gathers else []

    def _merged(self, epochs: list[dict[str, tuple[int, NavMessage]]]) -> Items:
        """Return the fix and the attitude of each epoch; an attitude without a week is counted."""
        items: Items = []
        for parts in epochs:
            fix = merge_epoch(parts, self._dates.floor_week)
            if fix is not None:
                items.append(fix)
            row = ins_row(parts, fix, self._dates.floor_week)
            if row is not None and row.values[1] < 0:
                self.counters.errors["time_unknown"] += 1
            elif row is not None:
                items.append(row)
        return items

    # --- inertial sensors ---

    def _esf_meas(self, host_time_ns: int, frame: bytes) -> Items:
        return [*_present(self._sensors.measured(host_time_ns, frame))]

    def _esf_raw(self, host_time_ns: int, frame: bytes) -> Items:
        return [*_present(self._sensors.raw(host_time_ns, frame))]

    def _esf_ins(self, host_time_ns: int, frame: bytes) -> Items:
        return [vehicle_motion(host_time_ns, _checked(ubx.ESF_INS.decode(frame)))]


def _present(message: _AnyT | None) -> _AnyT:
    """Return the message; raise `MessageError` where its length is wrong."""
    if message is None:
        raise MessageError("length")
    return message


def _checked(message: _NavT | None) -> _NavT:
    """Return the message; raise `MessageError` where its length is wrong or its iTOW is beyond the week."""
    if message is None or message.itow_ms >= WEEK_MS:
        raise MessageError("length or iTOW")
    return message


DRIVERS = (
    Driver(
        protocol="ubx",
        kind="gnss",
        transports=STREAM_TRANSPORTS,
        yields=(TimeMessage, GnssFix, GnssHeading, EventMark, InsSolution, ImuSamples, DeviceStatus),
        summary="u-blox binary (NAV-PVT, older NAV, TIM-TP TM2, NAV-ATT, ESF), NMEA and RTCM3 beside it",
        make_parser=UbxParser,
        make_time_parser=times_only(UbxParser),
        startup=startup_messages,
    ),
)
