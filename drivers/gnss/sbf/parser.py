"""Septentrio SBF: position with covariances, receiver time and pulse, events, heading, INS and IMU.

PVTGeodetic, PosCovGeodetic, VelCovGeodetic, PVTCartesian (time only), ReceiverTime, xPPSOffset, ExtEvent, AttEuler,
AttCovEuler, INSNavGeod and ExtSensorMeas are decoded. All other blocks, NMEA and RTCM3 on the same port are framed,
checked and counted; the prompts and replies of the receiver's command line (``COM1>``, ``$R: …``) are skipped.

Time: xPPSOffset is sent right after each pulse, so it refers to the previous edge and is bound to it; its offset is the
edge's own error, negative when the pulse came early. ReceiverTime refers to the previous edge too, and gives leap
seconds. So do PVTGeodetic, PVTCartesian and INSNavGeod on the whole second, once for each epoch. All of them give the
second of their time stamp; the clock's bias is removed from the times of records only.

Fix: PVTGeodetic, PosCovGeodetic and VelCovGeodetic of one time stamp make one `GnssFix` (`swath.drivers.gnss.epochs`),
complete at EndOfPVT at the latest. AttEuler and AttCovEuler make one `GnssHeading` in the same way.
"""

from __future__ import annotations

import datetime as dt
from collections.abc import Callable
from dataclasses import replace
from typing import TypeAlias

from swath.drivers.driver import STREAM_TRANSPORTS, Driver, times_only
from swath.drivers.framing.framer import Frame
from swath.drivers.framing.kinds import NMEA, RTCM3, SBF
from swath.drivers.framing.parser import FramedParser
from swath.drivers.gnss.date_floor import GREATEST_WEEK, ReceiverDates, leap_seconds_of
from swath.drivers.gnss.epochs import EpochGatherer
from swath.drivers.gnss.sbf import blocks as sbf
from swath.drivers.gnss.sbf import frame as wire
from swath.drivers.gnss.sbf import records
from swath.drivers.gnss.sbf.records import FixPart, HeadingPart, ImuPairs, ReceiverClock, Stamp
from swath.drivers.gnss.sbf.startup import startup_messages
from swath.drivers.parser import DeviceSettings
from swath.drivers.record_rows import Row
from swath.georef.records import (
    EventMark,
    GnssFix,
    GnssHeading,
    ImuSamples,
    InsSolution,
    NamesEdge,
    Record,
    TimeMessage,
)
from swath.georef.timescales.gps_time import SECOND_NS

Items: TypeAlias = list[Record | Row]

FRAME_KINDS = (replace(SBF, message_name=wire.name_of), NMEA, RTCM3)
GREATEST_OFFSET_NS = 1e6  # largest offset of a pulse that rounding to the receiver's clock can cause
PULSE_SCALES = frozenset(
    (sbf.SCALE_GPS, sbf.SCALE_UTC, sbf.SCALE_GLONASS, sbf.SCALE_GALILEO, sbf.SCALE_BEIDOU)
)  # scales with the seconds of GPS; the receiver's own clock is up to half a millisecond off

_CLOCKED = (GnssHeading, InsSolution, ImuSamples)  # records that need the clock bias of a position
GIVES: dict[int, tuple[type, ...]] = {  # record types to which a block contributes
    sbf.PVT_GEODETIC.number: (TimeMessage, GnssFix, *_CLOCKED),
    sbf.PVT_CARTESIAN.number: (TimeMessage, *_CLOCKED),
    sbf.POS_COV_GEODETIC.number: (GnssFix,),
    sbf.VEL_COV_GEODETIC.number: (GnssFix,),
    sbf.END_OF_PVT.number: (GnssFix,),
    sbf.RECEIVER_TIME.number: (TimeMessage,),
    sbf.MEAS_EPOCH: (TimeMessage,),
    sbf.XPPS_OFFSET.number: (TimeMessage,),
    sbf.EXT_EVENT.number: (EventMark,),
    sbf.ATT_EULER.number: (GnssHeading,),
    sbf.ATT_COV_EULER.number: (GnssHeading,),
    sbf.END_OF_ATT.number: (GnssHeading,),
    sbf.INS_NAV_GEOD.number: (TimeMessage, InsSolution),
    sbf.EXT_SENSOR_MEAS.number: (ImuSamples,),
}


class SbfParser(FramedParser):
    """Decodes the blocks listed above; all others are framed and counted.

    Args:
        settings: ``date_floor`` is the oldest accepted date, ``add_weeks`` is added to all weeks.
        wanted: the record types to return; None: all.
    """

    def __init__(self, settings: DeviceSettings, *, wanted: tuple[type, ...] | None = None) -> None:
        super().__init__(FRAME_KINDS, wanted)
        self._dates = ReceiverDates(settings)
        self._gathers_fixes = wanted is None or GnssFix in wanted
        self._clock = ReceiverClock(self.counters)
        self._imu = ImuPairs(self.counters)
        self._fixes: EpochGatherer[FixPart] = EpochGatherer(self.counters)
        self._headings: EpochGatherer[HeadingPart] = EpochGatherer(self.counters)
        self._synchronised: bool | None = None  # as the latest ReceiverTime reports
        self._last_named = -1
        self._has_solutions = False  # solutions give the second, so raw measurements, which come later, are not used
        decoders: dict[int, Callable[[Stamp, bytes], Items]] = {
            sbf.PVT_GEODETIC.number: self._pvt_geodetic,
            sbf.PVT_CARTESIAN.number: self._pvt_cartesian,
            sbf.POS_COV_GEODETIC.number: self._pos_cov,
            sbf.VEL_COV_GEODETIC.number: self._vel_cov,
            sbf.END_OF_PVT.number: self._end_of_pvt,
            sbf.RECEIVER_TIME.number: self._receiver_time,
            sbf.MEAS_EPOCH: self._meas_epoch,
            sbf.XPPS_OFFSET.number: self._xpps_offset,
            sbf.EXT_EVENT.number: self._ext_event,
            sbf.ATT_EULER.number: self._att_euler,
            sbf.ATT_COV_EULER.number: self._att_cov_euler,
            sbf.END_OF_ATT.number: self._end_of_att,
            sbf.INS_NAV_GEOD.number: self._ins_nav_geod,
            sbf.EXT_SENSOR_MEAS.number: self._ext_sensor_meas,
        }
        self._decoders = {
            number: decode
            for number, decode in decoders.items()
            if wanted is None or not set(wanted).isdisjoint(GIVES[number])
        }

    def finish(self) -> Items:
        """Return the records of the last epochs."""
        return self._give_fixes(self._fixes.end()) + self._give_headings(self._headings.end())

    def remarks(self) -> list[str]:
        """Return remarks on the receiver's weeks."""
        return self._dates.remarks()

    def decode_frames(self, frames: list[Frame]) -> Items:
        """Decode consecutive frames; return their records, or rows of them, in order."""
        items: Items = []
        for kind, host_time_ns, data in frames:
            decode = self._decoders.get(wire.number_of(data)) if kind == SBF.name else None
            if decode is None:
                continue
            try:
                items += decode(self._stamp(host_time_ns, data), data)
            except wire.BlockError as error:
                self.counters.count_bad(str(error))
        return items

    def _stamp(self, host_time_ns: int, frame: bytes) -> Stamp:
        """Return the block's time stamp; a week before the floor becomes None.

        Raises:
            BlockError: the frame is too short, or its time is impossible.
        """
        header = wire.read_header(frame)
        week = header.week
        if (header.tow_ms or 0) >= records.WEEK_MS or (week or 0) > GREATEST_WEEK:
            raise wire.BlockError("bad_time_stamp")
        week = None if week is None else self._dates.week(week, host_time_ns)
        if week is not None and week < self._dates.floor_week:
            self.counters.errors["date_before_floor"] += 1
            week = None
        return Stamp(wire.name_of(frame), host_time_ns, header.tow_ms, week)

    # --- time ---

    def _receiver_time(self, stamp: Stamp, frame: bytes) -> Items:
        block = sbf.RECEIVER_TIME.decode(frame)
        self._synchronised = block.sync_level & sbf.SYNC_FULL == sbf.SYNC_FULL
        tag = stamp.tag()
        if tag is None:
            return []
        leap = block.leap_seconds if block.leap_seconds != sbf.I1_UNSET else None
        if leap is not None and _leap_of_fields(block, stamp) not in (None, leap):
            self.counters.errors["utc_contradicts_gps"] += 1
            leap = None
        tag = replace(tag, leap_seconds=leap)
        valid = self._synchronised and tag.week is not None
        return [TimeMessage(stamp.host_time_ns, tag, NamesEdge.PREVIOUS, valid=valid, message=stamp.name)]

    def _xpps_offset(self, stamp: Stamp, frame: bytes) -> Items:
        block = sbf.XPPS_OFFSET.decode(frame)
        tag = stamp.tag()
        if tag is None:
            return []
        aligned = block.time_scale in PULSE_SCALES
        if not aligned:
            self.counters.errors["xpps_time_scale"] += 1
        offset_ns = records.usable(block.offset_ns)
        plausible = abs(offset_ns) < GREATEST_OFFSET_NS
        return [
            TimeMessage(
                stamp.host_time_ns,
                tag,
                NamesEdge.PREVIOUS,
                bound=True,
                valid=aligned and self._trusted(stamp),
                quantisation_ns=offset_ns if plausible else 0.0,
                message=stamp.name,
            )
        ]

    def _named_second(self, stamp: Stamp, computed: bool) -> Items:
        """Return the whole second of a solution, once for all blocks of an epoch."""
        tag = stamp.tag()
        if tag is None or tag.time_ns % SECOND_NS or stamp.epoch == self._last_named:
            return []
        self._last_named, self._has_solutions = stamp.epoch, True
        valid = computed and self._trusted(stamp)
        return [TimeMessage(stamp.host_time_ns, tag, NamesEdge.PREVIOUS, valid=valid, message=stamp.name)]

    def _meas_epoch(self, stamp: Stamp, frame: bytes) -> Items:
        """Return the whole second of raw measurements, in a stream for post-processing that contains no solution."""
        tag = stamp.tag()
        if self._has_solutions or tag is None or tag.time_ns % SECOND_NS:
            return []
        return [
            TimeMessage(stamp.host_time_ns, tag, NamesEdge.PREVIOUS, valid=stamp.week is not None, message=stamp.name)
        ]

    def _trusted(self, stamp: Stamp) -> bool:
        return stamp.week is not None and self._synchronised is not False

    # --- positions ---

    def _pvt_geodetic(self, stamp: Stamp, frame: bytes) -> Items:
        block = sbf.PVT_GEODETIC.decode(frame)
        self._clock.learn(stamp, block)
        return self._named_second(stamp, _computed(block)) + self._add_fix(stamp, block)

    def _pvt_cartesian(self, stamp: Stamp, frame: bytes) -> Items:
        block = sbf.PVT_CARTESIAN.decode(frame)
        self._clock.learn(stamp, block)
        return self._named_second(stamp, _computed(block))

    def _pos_cov(self, stamp: Stamp, frame: bytes) -> Items:
        return self._add_fix(stamp, sbf.POS_COV_GEODETIC.decode(frame))

    def _vel_cov(self, stamp: Stamp, frame: bytes) -> Items:
        return self._add_fix(stamp, sbf.VEL_COV_GEODETIC.decode(frame))

    def _end_of_pvt(self, stamp: Stamp, frame: bytes) -> Items:
        return self._give_fixes(self._fixes.end()) if stamp.epoch == self._fixes.key else []

    def _add_fix(self, stamp: Stamp, block: sbf.PvtGeodetic | sbf.PosCovGeodetic | sbf.VelCovGeodetic) -> Items:
        if not self._gathers_fixes or self._is_timeless(stamp):
            return []
        return self._give_fixes(self._fixes.add(stamp.epoch, stamp.name, (stamp, block)))

    def _give_fixes(self, epochs: list[dict[str, FixPart]]) -> Items:
        return [fix for parts in epochs if (fix := records.geodetic_fix(parts)) is not None]

    # --- the others ---

    def _ext_event(self, stamp: Stamp, frame: bytes) -> Items:
        event = sbf.EXT_EVENT.decode(frame)
        if self._is_timeless(stamp):
            return []
        mark = records.event_mark(stamp, event)
        return [mark] if mark is not None else []

    def _att_euler(self, stamp: Stamp, frame: bytes) -> Items:
        return self._add_heading(stamp, sbf.ATT_EULER.decode(frame))

    def _att_cov_euler(self, stamp: Stamp, frame: bytes) -> Items:
        return self._add_heading(stamp, sbf.ATT_COV_EULER.decode(frame))

    def _end_of_att(self, stamp: Stamp, frame: bytes) -> Items:
        return self._give_headings(self._headings.end()) if stamp.epoch == self._headings.key else []

    def _add_heading(self, stamp: Stamp, block: sbf.AttEuler | sbf.AttCovEuler) -> Items:
        if self._is_timeless(stamp):
            return []
        return self._give_headings(self._headings.add(stamp.epoch, stamp.name, (stamp, block)))

    def _give_headings(self, epochs: list[dict[str, HeadingPart]]) -> Items:
        found = (records.antenna_heading(parts, self._clock) for parts in epochs)
        return [heading for heading in found if heading is not None]

    def _ins_nav_geod(self, stamp: Stamp, frame: bytes) -> Items:
        block = sbf.INS_NAV_GEOD.decode(frame)
        triples = sbf.ins_triples(frame, block)
        items = self._named_second(stamp, block.error == 0)
        tag = self._clock.tag(stamp)
        if tag is None or tag.week is None:
            self.counters.errors["time_unknown"] += 1
            return items
        row = records.ins_row(stamp, tag, block, triples)
        if row is None:
            self.counters.errors["ins_no_solution"] += 1
            return items
        return [*items, row]

    def _ext_sensor_meas(self, stamp: Stamp, frame: bytes) -> Items:
        sets = sbf.sensor_sets(frame)
        return [*self._imu.add(stamp, self._clock.tag(stamp), sets)]

    def _is_timeless(self, stamp: Stamp) -> bool:
        """Return whether a block has no time, and count such blocks."""
        if stamp.tow_ms is None:
            self.counters.errors["time_unknown"] += 1
        return stamp.tow_ms is None


def _computed(block: sbf.PvtGeodetic | sbf.PvtCartesian) -> bool:
    return block.error == 0 and block.mode & sbf.MODE_TYPE_BITS != 0


def _leap_of_fields(block: sbf.ReceiverTime, stamp: Stamp) -> int | None:
    """Return GPS − UTC as the calendar fields and the time stamp of a ReceiverTime imply it; None where they do not."""
    try:
        date = dt.date(2000 + block.year, block.month, block.day)
    except ValueError:
        return None
    of_day_ms = ((block.hour * 60 + block.minute) * 60 + block.second) * 1000
    return None if stamp.tow_ms is None else leap_seconds_of(date, of_day_ms, stamp.tow_ms)


make_time_parser = times_only(SbfParser)

DRIVERS = (
    Driver(
        protocol="sbf",
        kind="gnss",
        transports=STREAM_TRANSPORTS,
        yields=(TimeMessage, GnssFix, GnssHeading, EventMark, InsSolution, ImuSamples),
        summary="Septentrio binary (PVTGeodetic, ReceiverTime, xPPSOffset, ExtEvent, INS), NMEA and RTCM3 beside it",
        make_parser=SbfParser,
        make_time_parser=make_time_parser,
        names_edge=NamesEdge.PREVIOUS,
        startup=startup_messages,
    ),
)
