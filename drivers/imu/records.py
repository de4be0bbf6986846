"""Records of receivers and inertial units that another program decoded (`swath.drivers.record_frames`).

One stream may hold both, and is then read once for each (``transport = "gnss:NAME"`` or ``"imu:NAME"``).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from swath.drivers.driver import RECEIVER_RECORDS, STREAM_TRANSPORTS, Driver
from swath.drivers.framing.framer import Frame
from swath.drivers.framing.parser import FramedParser
from swath.drivers.parser import DeviceSettings
from swath.drivers.record_frames import (
    NO_ARRIVAL,
    NO_TIME_NS,
    RECORDS,
    TELLS_TIME,
    RowKind,
    Scale,
    decode_rows,
    gps_from_posix,
    gps_times,
)
from swath.drivers.record_rows import Row
from swath.georef.arrays import FloatArray, Int64Array, StructArray
from swath.georef.records import (
    IMU_DTYPE,
    INS_DTYPE,
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
from swath.georef.timescales.coarse import TYPICAL_DELAY_NS
from swath.georef.timescales.gps_time import LEAP_TABLE_VALID_UNTIL, SECOND_NS, WEEK_NS, gps_ns_from_utc

_UPPER = np.triu_indices(3)
_FIX_TYPES = {int(one): one for one in FixType}
_LEAPS_KNOWN_NS = gps_ns_from_utc(LEAP_TABLE_VALID_UNTIL, 0, 18)
UNKNOWN_SIGMA_S = 1.0
STANDARD_GRAVITY = 9.80665  # m/s², CGPM 1901
INERTIAL_RECORDS = (ImuSamples, InsSolution)


class RecordsParser(FramedParser):
    """Turns frames into records.

    Counts ``bad_version``, ``bad_kind``, ``bad_scale`` and ``bad_length`` of frames with a good CRC; and of rows
    ``no_time``, those of a receiver without a time that is known, and ``no_solution``, which are left out.

    Args:
        settings: ``acceleration_unit``, if the values are not in the frame's m/s².
        wanted: the record types to return.
    """

    def __init__(self, settings: DeviceSettings, wanted: tuple[type, ...]) -> None:
        super().__init__((RECORDS,), wanted)
        self._source = settings.source
        self._unit = STANDARD_GRAVITY if settings.config.get("acceleration_unit") == "g" else 1.0
        self._inertial = any(kind in wanted for kind in INERTIAL_RECORDS)
        self._receiver = any(kind in wanted for kind in RECEIVER_RECORDS)
        self._told_second = NO_TIME_NS  # that a fix named last
        self._after_table = False

    def decode_frames(self, frames: list[Frame]) -> Iterator[Record | Row]:
        """Decode consecutive frames; neighbours of one kind together, as most hold few rows."""
        run: list[tuple[int, StructArray]] = []
        of_run: tuple[RowKind, Scale, int] | None = None
        for frame in frames:
            found = decode_rows(frame.data)
            if isinstance(found, str):
                self.counters.count_bad(found)
                continue
            if found[:3] != of_run and of_run is not None:
                yield from self._decode(*of_run, run)
                run = []
            of_run = found[:3]
            run.append((frame.host_time_ns, found[3]))
        if of_run is not None:
            yield from self._decode(*of_run, run)

    def _decode(self, kind: RowKind, scale: Scale, flags: int, run: list[tuple[int, StructArray]]) -> Iterator[Record]:
        rows = np.concatenate([rows for _, rows in run])
        host_ns = np.repeat(np.array([at for at, _ in run], np.int64), [len(rows) for _, rows in run])
        gps_ns = gps_times(rows["time_ns"], scale)
        self._after_table |= scale is Scale.UTC and bool((gps_ns > _LEAPS_KNOWN_NS).any())
        if self._inertial and len(rows) and kind is RowKind.SAMPLE:
            yield _samples(rows, host_ns, gps_ns, scale, self._unit)
        elif self._inertial and len(rows) and kind is RowKind.SOLUTION:
            good = rows["valid"] != 0
            if not good.all():
                self.counters.errors["no_solution"] += int((~good).sum())
            if good.any():
                yield _solutions(rows[good], host_ns[good], gps_ns[good])
        elif self._receiver and kind in _READERS:
            if scale is Scale.COUNTER:  # which has no date, so that the arrival counts as UTC
                gps_ns = gps_from_posix(host_ns)
            yield from self._of_receiver(kind, flags, rows, host_ns, gps_ns)

    def remarks(self) -> list[str]:
        """Return a line if times in UTC are later than the leap seconds that are known."""
        if not self._after_table:
            return []
        return [
            f"{self._source}: its times are UTC after {LEAP_TABLE_VALID_UNTIL}, to which the table of leap seconds "
            "reaches; GPS − UTC is taken as 18 s. If that is wrong, all its times are wrong by the same whole second"
        ]

    def _of_receiver(
        self, kind: RowKind, flags: int, rows: StructArray, host_ns: Int64Array, gps_ns: Int64Array
    ) -> Iterator[Record]:
        read = _READERS[kind]
        for row, arrival_ns, at_ns in zip(rows, host_ns.tolist(), gps_ns.tolist(), strict=True):
            if at_ns < 0 and kind is not RowKind.HEADING:
                self.counters.errors["no_time"] += 1
                continue
            record = read(arrival_ns, _tag(at_ns), row) if at_ns >= 0 else _heading(arrival_ns, None, row)
            if flags & TELLS_TIME and isinstance(record, GnssFix) and record.valid:
                yield from self._second(record, flags, at_ns)
            yield record

    def _second(self, fix: GnssFix, flags: int, gps_ns: int) -> Iterator[TimeMessage]:
        """Yield a message that names a fix's second, once for each: it began the fix's fraction before the arrival."""
        second, fraction_ns = divmod(gps_ns, SECOND_NS)
        if second == self._told_second:
            return
        self._told_second = second
        arrival_ns = fix.host_time_ns + (TYPICAL_DELAY_NS if flags & NO_ARRIVAL else 0) - fraction_ns
        tag = _tag(second * SECOND_NS)
        yield TimeMessage(arrival_ns, tag, NamesEdge.PREVIOUS, message=fix.message or "fix")


def _tag(gps_ns: int) -> TimeTag:
    week, tow_ns = divmod(gps_ns, WEEK_NS)
    return TimeTag(TimeScale.GPS, tow_ns, week)


def _given(value: Any) -> float | None:
    number = float(value)
    return None if number != number else number


def _text(value: bytes) -> str:
    return value.decode("utf-8", "replace")


def _covariance(upper: FloatArray) -> FloatArray | None:
    if np.isnan(upper).all():
        return None
    full = np.empty((3, 3))
    full[_UPPER] = upper
    full.T[_UPPER] = upper
    return full


def _fix(host_ns: int, tag: TimeTag, row: Any) -> GnssFix:
    velocity = tuple(row["velocity_l"].tolist())
    satellites = int(row["satellites"])
    return GnssFix(
        host_time_ns=host_ns,
        time=tag,
        lat_rad=_given(row["lat_rad"]),
        lon_rad=_given(row["lon_rad"]),
        height_m=_given(row["height_m"]),
        velocity_l=None if np.isnan(row["velocity_l"]).all() else velocity,
        position_cov_l=_covariance(row["position_cov_l"]),
        velocity_cov_l=_covariance(row["velocity_cov_l"]),
        fix_type=_FIX_TYPES.get(int(row["fix_type"]), FixType.NONE),
        satellites=None if satellites < 0 else satellites,
        antenna=_text(row["antenna"]),
        valid=bool(row["valid"]),
        message=_text(row["message"]),
        undulation_m=_given(row["undulation_m"]),
    )


def _heading(host_ns: int, tag: TimeTag | None, row: Any) -> GnssHeading:
    return GnssHeading(
        host_time_ns=host_ns,
        time=tag,
        heading_rad=float(row["heading_rad"]),
        pitch_rad=_given(row["pitch_rad"]),
        baseline_m=_given(row["baseline_m"]),
        heading_sigma_rad=_given(row["heading_sigma_rad"]),
        pitch_sigma_rad=_given(row["pitch_sigma_rad"]),
        valid=bool(row["valid"]),
        message=_text(row["message"]),
    )


def _time(host_ns: int, tag: TimeTag, row: Any) -> TimeMessage:
    edge = NamesEdge.NEXT if row["names_next"] else NamesEdge.PREVIOUS
    if row["leap_seconds"] >= 0:
        tag = replace(tag, leap_seconds=int(row["leap_seconds"]))
    return TimeMessage(host_ns, tag, edge, bool(row["bound"]), bool(row["valid"]), message=_text(row["message"]))


def _mark(host_ns: int, tag: TimeTag, row: Any) -> EventMark:
    count, rising = int(row["count"]), int(row["rising"])
    return EventMark(
        host_time_ns=host_ns,
        time=tag,
        channel=_text(row["channel"]),
        rising=None if rising < 0 else bool(rising),
        count=None if count < 0 else count,
        sigma_s=_given(row["time_sigma_s"]),
        valid=bool(row["valid"]),
        message=_text(row["message"]),
    )


_READERS: dict[RowKind, Callable[[int, TimeTag, Any], Record]] = {
    RowKind.FIX: _fix,
    RowKind.HEADING: _heading,
    RowKind.TIME: _time,
    RowKind.MARK: _mark,
}


@np.errstate(invalid="ignore")  # a signalling NaN on the wire is a NaN like any other
def _samples(rows: StructArray, host_ns: Int64Array, gps_ns: Int64Array, scale: Scale, unit: float) -> ImuSamples:
    """Return inertial samples: with GPS time of week, or a counter; an unknown sigma of the time counts as 1 s."""
    found = np.zeros(len(rows), IMU_DTYPE)
    found["host_time_ns"] = host_ns
    known = gps_ns >= 0
    found["gps_week"] = np.where(known, gps_ns // WEEK_NS, -1)
    counter = np.where(rows["time_ns"] < 0, NO_TIME_NS, rows["time_ns"]) if scale is Scale.COUNTER else NO_TIME_NS
    found["device_time_ns"] = np.where(known, gps_ns % WEEK_NS, counter)
    found["pps_time_ns"] = np.where(known, NO_TIME_NS, rows["pps_time_ns"])
    sigma_s = rows["time_sigma_s"]
    found["time_sigma_s"] = np.where(known, np.where(sigma_s >= 0.0, sigma_s, UNKNOWN_SIGMA_S), 0.0)
    for name in ("specific_force_b", "angular_rate_b", "temperature_c", "status"):
        found[name] = rows[name]
    found["specific_force_b"] *= unit
    return ImuSamples(found)


@np.errstate(invalid="ignore")
def _solutions(rows: StructArray, host_ns: Int64Array, gps_ns: Int64Array) -> InsSolution:
    found = np.zeros(len(rows), INS_DTYPE)
    for name in INS_DTYPE.names or ():
        if name in (rows.dtype.names or ()):
            found[name] = rows[name]
    found["host_time_ns"], found["gps_ns"] = host_ns, gps_ns
    return InsSolution(found)


def _only(wanted: Iterable[type]) -> Any:
    return partial(RecordsParser, wanted=tuple(wanted))


_SUMMARY = "of other programs: CSV, Parquet and ROS messages by swath import"

DRIVERS = (
    Driver(
        protocol="records",
        kind="imu",
        transports=(*STREAM_TRANSPORTS, "gnss"),
        yields=INERTIAL_RECORDS,
        summary=f"inertial samples and INS solutions {_SUMMARY}",
        make_parser=_only(INERTIAL_RECORDS),
    ),
    Driver(
        protocol="records",
        kind="gnss",
        transports=(*STREAM_TRANSPORTS, "imu"),
        yields=RECEIVER_RECORDS,
        summary=f"fixes, headings, times, marks {_SUMMARY}",
        make_parser=_only(RECEIVER_RECORDS),
        make_time_parser=_only((TimeMessage,)),
        names_edge=NamesEdge.PREVIOUS,
    ),
)
