"""Tables of records: a NumPy row per record that begins with its GPS time; and their columns, flat, named with unit.

A table is a structured array. Times are GPS nanoseconds (since 1980-01-06); −1: the record has no time that is known.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swath.daemon.devices.listening import Times
from swath.georef.arrays import FloatArray, Int64Array, StructArray
from swath.georef.records import (
    AIMED_RETURN_DTYPE,
    IMU_DTYPE,
    INS_DTYPE,
    RETURN_DTYPE,
    DeviceStatus,
    EventMark,
    GnssFix,
    GnssHeading,
    ImuSamples,
    InsSolution,
    Record,
    ScannerReturns,
    TimeMessage,
)

NO_TIME_NS = -1
GUESSED_LEAP_S = 1.0  # sigma of a time in UTC whose leap seconds no receiver has told
_TIMED: list[Any] = [
    ("gps_ns", "i8"),  # −1: unknown
    ("time_sigma_s", "f8"),  # of gps_ns; 0: the device's own GPS time; nan: unknown
    ("host_time_ns", "i8"),  # of arrival
]


def _table(*fields: Any) -> np.dtype[Any]:
    return np.dtype([*_TIMED, *fields], align=True)


def _timed(dtype: np.dtype[Any]) -> np.dtype[Any]:
    """Return the row type of a table of records that are rows themselves."""
    taken = {name for name, *_ in _TIMED}
    assert dtype.names is not None
    return _table(*((name, dtype[name].base, dtype[name].shape) for name in dtype.names if name not in taken))


FIX_TABLE = _table(
    ("lat_rad", "f8"),  # nan: a velocity only
    ("lon_rad", "f8"),
    ("height_m", "f8"),  # ellipsoidal; nan: not given
    ("undulation_m", "f8"),  # geoid above the ellipsoid by the receiver's model; nan: not given
    ("velocity_l", "f8", (3,)),  # north, east, down, m/s; nan: not given
    ("position_cov_l", "f8", (3, 3)),  # m², north, east, down; nan: not given
    ("velocity_cov_l", "f8", (3, 3)),  # m²/s²
    ("fix_type", "u1"),  # `swath.georef.records.FixType`
    ("satellites", "i2"),  # −1: not given
    ("valid", "?"),
    ("antenna", "U12"),
    ("message", "U24"),
)
HEADING_TABLE = _table(
    ("heading_rad", "f8"),
    ("pitch_rad", "f8"),  # nan: not given, as in all that follow
    ("baseline_m", "f8"),
    ("heading_sigma_rad", "f8"),
    ("pitch_sigma_rad", "f8"),
    ("valid", "?"),
    ("message", "U24"),
)
MARK_TABLE = _table(
    ("channel", "U24"),
    ("rising", "i1"),  # 1 rising, 0 falling, −1 not given
    ("count", "i8"),  # −1: not given
    ("valid", "?"),
    ("message", "U24"),
)
TIME_TABLE = _table(
    ("edge", "U8"),  # the edge that the message names: previous or next
    ("bound", "?"),
    ("valid", "?"),
    ("leap_seconds", "i2"),  # GPS − UTC as the receiver knows it; −1: not given
    ("message", "U24"),
)
STATUS_TABLE = _table(("message", "U24"), ("values", "O"))
SAMPLE_TABLE = _timed(IMU_DTYPE)
SOLUTION_TABLE = _timed(INS_DTYPE)
RETURN_TABLE = _timed(RETURN_DTYPE)
AIMED_RETURN_TABLE = _timed(AIMED_RETURN_DTYPE)


def fix_rows(fixes: Sequence[GnssFix]) -> StructArray:
    """Return a table (n,) of fixes, without their times."""
    rows = _empty(FIX_TABLE, [fix.host_time_ns for fix in fixes])
    for name in ("lat_rad", "lon_rad", "height_m", "undulation_m"):
        rows[name] = _numbers([getattr(fix, name) for fix in fixes])
    for row, fix in zip(rows, fixes, strict=True):
        row["velocity_l"] = math.nan if fix.velocity_l is None else fix.velocity_l
        row["position_cov_l"] = math.nan if fix.position_cov_l is None else fix.position_cov_l
        row["velocity_cov_l"] = math.nan if fix.velocity_cov_l is None else fix.velocity_cov_l
    rows["fix_type"] = [int(fix.fix_type) for fix in fixes]
    rows["satellites"] = _counts([fix.satellites for fix in fixes])
    return _with_words(rows, fixes, "valid", "antenna", "message")


def heading_rows(headings: Sequence[GnssHeading]) -> StructArray:
    """Return a table (n,) of headings, without their times."""
    rows = _empty(HEADING_TABLE, [heading.host_time_ns for heading in headings])
    for name in ("heading_rad", "pitch_rad", "baseline_m", "heading_sigma_rad", "pitch_sigma_rad"):
        rows[name] = _numbers([getattr(heading, name) for heading in headings])
    return _with_words(rows, headings, "valid", "message")


def mark_rows(marks: Sequence[EventMark]) -> StructArray:
    """Return a table (n,) of event marks, without their times; the sigma of the time is the receiver's."""
    rows = _empty(MARK_TABLE, [mark.host_time_ns for mark in marks])
    rows["time_sigma_s"] = _numbers([mark.sigma_s for mark in marks])
    rows["rising"] = _counts([None if mark.rising is None else int(mark.rising) for mark in marks])
    rows["count"] = _counts([mark.count for mark in marks])
    return _with_words(rows, marks, "channel", "valid", "message")


def time_rows(messages: Sequence[TimeMessage]) -> StructArray:
    """Return a table (n,) of time messages, without the times that they name."""
    rows = _empty(TIME_TABLE, [message.host_time_ns for message in messages])
    rows["edge"] = [str(message.names_edge) for message in messages]
    rows["leap_seconds"] = _counts([message.time.leap_seconds for message in messages])
    return _with_words(rows, messages, "bound", "valid", "message")


def status_rows(statuses: Sequence[DeviceStatus]) -> StructArray:
    """Return a table (n,) of devices' status, without times; ``values`` is a dict whose keys carry their unit."""
    rows = _empty(STATUS_TABLE, [status.host_time_ns for status in statuses])
    rows["message"] = [status.message for status in statuses]
    for row, status in zip(rows, statuses, strict=True):
        row["values"] = dict(status.values)
    return rows


def timed_rows(rows: StructArray) -> StructArray:
    """Return rows of `swath.georef.records` with columns for their times, which are unknown yet."""
    assert rows.dtype.names is not None
    table = _empty(_timed(rows.dtype), rows["host_time_ns"])
    for name in rows.dtype.names:
        if name != "time_sigma_s":
            table[name] = rows[name]
    return table


def _empty(dtype: np.dtype[Any], host_time_ns: Sequence[int] | Int64Array) -> StructArray:
    rows = np.zeros(len(host_time_ns), dtype)
    rows["gps_ns"], rows["time_sigma_s"], rows["host_time_ns"] = NO_TIME_NS, math.nan, host_time_ns
    return rows


def _with_words(rows: StructArray, records: Sequence[Any], *names: str) -> StructArray:
    for name in names:
        rows[name] = [getattr(record, name) for record in records]
    return rows


def _numbers(values: Sequence[float | None]) -> FloatArray:
    return np.array([math.nan if value is None else value for value in values], np.float64)


def _counts(values: Sequence[int | None]) -> Int64Array:
    return np.array([-1 if value is None else value for value in values], np.int64)


@dataclass(frozen=True, slots=True)
class RecordKind:
    """A kind of records and its table.

    Attributes:
        name: as users ask for it: ``fixes``.
        record: the type that parsers give.
        dtype: row type of an empty table.
        rows: makes a table of records; None: the record is rows, see `timed_rows`.
        names_time: True if a record names its time itself, as ``time``.
    """

    name: str
    record: type
    dtype: np.dtype[Any]
    rows: Callable[[Sequence[Any]], StructArray] | None = None
    names_time: bool = False

    def table(self, records: Sequence[Any]) -> StructArray:
        """Return a table of records, without times."""
        if not records:
            return np.empty(0, self.dtype)
        if self.rows is not None:
            return self.rows(records)
        return timed_rows(np.concatenate([record.rows for record in records]))


KINDS = {
    kind.name: kind
    for kind in (
        RecordKind("fixes", GnssFix, FIX_TABLE, fix_rows, names_time=True),
        RecordKind("headings", GnssHeading, HEADING_TABLE, heading_rows, names_time=True),
        RecordKind("marks", EventMark, MARK_TABLE, mark_rows, names_time=True),
        RecordKind("times", TimeMessage, TIME_TABLE, time_rows, names_time=True),
        RecordKind("status", DeviceStatus, STATUS_TABLE, status_rows),
        RecordKind("samples", ImuSamples, SAMPLE_TABLE),
        RecordKind("solutions", InsSolution, SOLUTION_TABLE),
        RecordKind("returns", ScannerReturns, RETURN_TABLE),
    )
}


def table_of(kind: RecordKind, records: Sequence[Record], times: Sequence[Times]) -> StructArray:
    """Return a table of the records of a kind among others, with their times; empty if there are none.

    Args:
        kind: of `KINDS`.
        records: of any types, in order.
        times: theirs; empty: no times are known.
    """
    chosen = [place for place, record in enumerate(records) if isinstance(record, kind.record)]
    table = kind.table([records[place] for place in chosen])
    if len(table) and times:
        table["gps_ns"] = np.concatenate([times[place].gps_ns for place in chosen])
        table["time_sigma_s"] = np.concatenate([times[place].sigma_s for place in chosen])
    return table


# Names of the parts of a vector's columns, by field; the unit ends the name, as it does in all scalar columns.
_COVARIANCES = ("nn", "ne", "nd", "ee", "ed", "dd")
_PARTS = {
    "velocity_l": ("velocity_north_mps", "velocity_east_mps", "velocity_down_mps"),
    "specific_force_b": ("specific_force_x_mps2", "specific_force_y_mps2", "specific_force_z_mps2"),
    "angular_rate_b": ("angular_rate_x_radps", "angular_rate_y_radps", "angular_rate_z_radps"),
    "position_sigma_l": ("sigma_north_m", "sigma_east_m", "sigma_down_m"),
    "velocity_sigma_l": ("sigma_velocity_north_mps", "sigma_velocity_east_mps", "sigma_velocity_down_mps"),
    "attitude_sigma_rad": ("sigma_roll_rad", "sigma_pitch_rad", "sigma_heading_rad"),
    "position_cov_l": tuple(f"cov_{part}_m2" for part in _COVARIANCES),
    "velocity_cov_l": tuple(f"cov_velocity_{part}_m2ps2" for part in _COVARIANCES),
}
_UPPER = np.triu_indices(3)


def flat_columns(table: StructArray) -> dict[str, NDArray[Any]]:
    """Return a table's columns (n,) by name, with unit where there is one; vectors and covariances in parts."""
    assert table.dtype.names is not None
    columns: dict[str, NDArray[Any]] = {}
    for name in table.dtype.names:
        column = table[name]
        if column.ndim == 1:
            columns[name] = column
            continue
        parts = column[:, _UPPER[0], _UPPER[1]] if column.ndim == 3 else column
        columns |= dict(zip(_PARTS[name], parts.T, strict=True))
    return columns
