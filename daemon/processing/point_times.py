"""Reads GPS times of points in LAS files: seconds of the week or adjusted standard time, by each file's header.

LAS 1.4 R15, 2.4: bit 0 of the global encoding is 0 for seconds of the GPS week, 1 for adjusted standard GPS time, GPS
seconds less 1e9. LAS 1.5 adds bit 6: GPS seconds less another multiple of 1e6, given in the header (Offset GPS Time).
Files of all kinds are merged and delivered side by side, and some headers contradict their times.
"""

from __future__ import annotations

import datetime as dt
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

import numpy as np
from laspy.header import GpsTimeType

from swath.daemon.processing.quicklook.point_files import UNREADABLE, PointReader, Selection, open_points
from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.timescales.gps_time import (
    GPS_EPOCH,
    GPS_EPOCH_UNIX_S,
    LAS_ADJUSTED_ZERO_S,
    SECOND_NS,
    WEEK_NS,
    WEEK_S,
)

SAMPLED_POINTS = 1000
OF_WEEK_BELOW_S = 2 * WEEK_S  # a flight that crosses the week's end may go on counting
NAMED_FILES = 3
DAY_S = 86_400
GPS_EPOCH_UTC = dt.datetime(1980, 1, 6, tzinfo=dt.UTC)
LARGEST_S = 4e9  # GPS seconds of 2106; larger numbers are something else
OFFSET_FLAG = 1 << 6  # LAS 1.5, 2.4: bit 6 of the global encoding
_OFFSET, _OFFSET_AT = struct.Struct("<H"), 391  # in millions of seconds


class TimeKind(Enum):
    """The kinds of times that a file's points may have."""

    NONE = "no GPS times"
    OF_WEEK = "seconds of the GPS week"
    ADJUSTED = "adjusted standard GPS time"


@dataclass(frozen=True, eq=False)
class PointTimes:
    """The kind of times in a file, with samples.

    Attributes:
        path: the file.
        kind: kind of its times; by the header unless the times contradict it.
        sample_s: (k,) times of the first points, seconds as in the file.
        doubt: why the header is not followed or is doubtful, one line; empty if there is no doubt.
        zero_s: GPS seconds from which adjusted times count.
    """

    path: Path
    kind: TimeKind
    sample_s: FloatArray
    doubt: str = ""
    zero_s: int = LAS_ADJUSTED_ZERO_S


def point_times_of(path: Path) -> PointTimes:
    """Return the kind of times of a file's points, from its header and its first points.

    A file that cannot be read has kind NONE and raises nothing here: the code that reads its points reports the error.
    """
    try:
        with open_points(path) as reader:
            header = reader.header
        if "gps_time" not in header.point_format.dimension_names:
            return PointTimes(path, TimeKind.NONE, np.zeros(0))
        with PointReader(path, Selection.XY_RETURNS_CHANNEL | Selection.GPS_TIME) as points:
            seconds = np.asarray(points.read(SAMPLED_POINTS)["gps_time"], np.float64)
    except UNREADABLE:
        return PointTimes(path, TimeKind.NONE, np.zeros(0))
    seconds = seconds[np.isfinite(seconds) & (np.abs(seconds) < LARGEST_S)]
    if not seconds.any():
        return PointTimes(path, TimeKind.NONE, np.zeros(0))
    if header.global_encoding.value & OFFSET_FLAG and (header.version.major, header.version.minor) >= (1, 5):
        return _offset(path, seconds)
    kind = TimeKind.ADJUSTED if header.global_encoding.gps_time_type == GpsTimeType.STANDARD else TimeKind.OF_WEEK
    return _weighed(path, kind, seconds)


def _offset(path: Path, seconds: FloatArray) -> PointTimes:
    """Return times that count from the zero in the header of a LAS 1.5 file; laspy does not read that field."""
    with path.open("rb") as file:
        file.seek(_OFFSET_AT)
        (millions,) = _OFFSET.unpack(file.read(_OFFSET.size))
    return PointTimes(path, TimeKind.ADJUSTED, seconds, zero_s=millions * 1_000_000)


def _weighed(path: Path, said: TimeKind, seconds: FloatArray) -> PointTimes:
    """Return the times with a doubt wherever the numbers contradict the header."""
    low, high = float(seconds.min()), float(seconds.max())
    future = _of_the_future(low)
    remedy = future or "set bit 0 of the header's global encoding"
    if said is TimeKind.OF_WEEK and not 0.0 <= low <= high < OF_WEEK_BELOW_S:
        doubt = (
            f"{path}: its header says {said.value}, but its times, from {low:,.0f} s on, are not; they are read as "
            f"{TimeKind.ADJUSTED.value}: {remedy}"
        )
        return PointTimes(path, TimeKind.ADJUSTED, seconds, doubt)
    if said is TimeKind.ADJUSTED and future:
        return PointTimes(path, said, seconds, f"{path}: its header says {said.value}: {future}")
    if said is TimeKind.ADJUSTED and 0.0 <= low <= high <= WEEK_S:
        day = GPS_EPOCH + dt.timedelta(seconds=LAS_ADJUSTED_ZERO_S + low)
        doubt = (
            f"{path}: its header says {said.value}, so its times, from {low:,.0f} s on, belong to {day}; if they are "
            f"{TimeKind.OF_WEEK.value}, clear bit 0 of the header's global encoding"
        )
        return PointTimes(path, said, seconds, doubt)
    return PointTimes(path, said, seconds)


def _of_the_future(adjusted_s: float) -> str:
    """Return why adjusted times later than now are wrong, and the remedy; empty if they are not later.

    Some software writes GPS seconds with nothing taken off them, or seconds since 1970, under the same bit.
    """
    now_s = (dt.datetime.now(dt.UTC) - GPS_EPOCH_UTC).total_seconds()
    if adjusted_s + LAS_ADJUSTED_ZERO_S <= now_s + DAY_S:
        return ""
    day = GPS_EPOCH + dt.timedelta(seconds=LAS_ADJUSTED_ZERO_S + adjusted_s)
    words = f"its times, from {adjusted_s:,.0f} s on, then belong to {day}, in the future"
    for what, zero_s in (("GPS seconds", 0), ("seconds since 1970", GPS_EPOCH_UNIX_S)):
        if adjusted_s - zero_s <= now_s + DAY_S:
            leap = ", and add the leap seconds" if zero_s else ""
            return f"{words}; they look like {what}: subtract {LAS_ADJUSTED_ZERO_S + zero_s:,} s from them{leap}"
    return words


def time_notes(times: Sequence[PointTimes]) -> list[str]:
    """Return lines on files whose header is doubtful, and a line on files that mix kinds of times."""
    notes = [one.doubt for one in times if one.doubt]
    of_week = [one.path.name for one in times if one.kind is TimeKind.OF_WEEK]
    adjusted = [one.path.name for one in times if one.kind is TimeKind.ADJUSTED]
    if of_week and adjusted:
        notes.append(
            f"files have different kinds of times: {TimeKind.OF_WEEK.value} in {_named(of_week)}; "
            f"{TimeKind.ADJUSTED.value} in {_named(adjusted)}; convert them to one kind before you merge them into a "
            "file"
        )
    return notes


def _named(names: Sequence[str]) -> str:
    more = len(names) - NAMED_FILES
    return ", ".join(names[:NAMED_FILES]) + (f" and {more} more" if more > 0 else "")


class PointClock:
    """Gives GPS times of points of several files, some of which only have seconds of the week."""

    def __init__(self, times: Sequence[PointTimes], week: int | None = None, near_ns: int | None = None) -> None:
        """Take the times of all files and settle the week.

        Args:
            times: times of all files.
            week: GPS week of the first time of files that have seconds of the week; None: not given.
            near_ns: a GPS time of the flight, from a trajectory beside the points; None: there is none.
        """
        self._kinds = {one.path: one.kind for one in times}
        self._zeros_s = {one.path: one.zero_s for one in times}
        of_week = [one.sample_s for one in times if one.kind is TimeKind.OF_WEEK]
        adjusted = [one for one in times if one.kind is TimeKind.ADJUSTED]
        self.notes: list[str] = []
        self._near_ns = 0
        if of_week:
            first_ns, length_ns = _span_of_week(np.concatenate(of_week))
            self._near_ns = first_ns + length_ns // 2
            if week is not None:
                self._near_ns += week * WEEK_NS
            elif near_ns is not None:
                self._near_ns = near_ns
            elif adjusted:
                self._near_ns = int(np.median(np.concatenate([_since(one.sample_s, one.zero_s) for one in adjusted])))
            else:
                self.notes.append(_untold([one.path.name for one in times if one.kind is TimeKind.OF_WEEK]))

    def time_ns(self, path: Path, seconds: FloatArray) -> Int64Array:
        """Return GPS times (n,) for seconds (n,) as in a file; 0 for values that are no valid time."""
        known = np.isfinite(seconds) & (np.abs(seconds) < LARGEST_S)
        seconds = np.where(known, seconds, 0.0)
        kind = self._kinds.get(path, TimeKind.NONE)
        if kind is TimeKind.NONE:
            return np.zeros(len(seconds), np.int64)
        if kind is TimeKind.ADJUSTED:
            return np.where(known, _since(seconds, self._zeros_s[path]), 0)
        of_week_ns = np.rint(seconds * SECOND_NS).astype(np.int64)
        away_ns = (of_week_ns - self._near_ns + WEEK_NS // 2) % WEEK_NS - WEEK_NS // 2
        return np.where(known, self._near_ns + away_ns, 0)


def _since(seconds: FloatArray, zero_s: int) -> Int64Array:
    """Return GPS times (n,) for seconds (n,) that count from ``zero_s`` in GPS seconds."""
    whole = np.rint(seconds * SECOND_NS).astype(np.int64)
    return np.asarray(whole + zero_s * SECOND_NS)


def _span_of_week(seconds: FloatArray) -> tuple[int, int]:
    """Return first time and length, ns, of the shortest span that holds all times of a week; it may cross the week's
    end.
    """
    times = np.unique(np.rint((seconds % WEEK_S) * SECOND_NS).astype(np.int64))
    gaps = np.diff(times, append=times[0] + WEEK_NS)
    last = int(np.argmax(gaps))
    first_ns = int(times[(last + 1) % len(times)])
    return first_ns, int(WEEK_NS - gaps[last])


def _untold(names: Sequence[str]) -> str:
    return (
        f"{_named(names)}: times are {TimeKind.OF_WEEK.value}, and no file gives the week, so times are only relative "
        "to each other; give the week with --week"
    )
