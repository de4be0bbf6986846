"""Values of a calibration record: the types that an attribute may hold, and the limits of matrices."""

from __future__ import annotations

import datetime as dt
import math
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from swath.georef.arrays import FloatArray
from swath.georef.timescales.gps_time import GPS_EPOCH, SECOND_NS, table_leap_seconds

INLINE = 400  # greatest size of a matrix that is stored in the record itself


@dataclass(frozen=True, eq=False)
class Matrix:
    """Rows and columns of numbers.

    Attributes:
        array: (rows, columns) as kept.
        rows: their total number; more than kept if only every k-th row is kept.
        every: k.
    """

    array: FloatArray
    rows: int
    every: int = 1

    @classmethod
    def of(cls, array: FloatArray) -> Matrix:
        """Create a matrix that keeps all rows of an array."""
        table = np.atleast_2d(np.asarray(array, np.float64))
        return cls(table, len(table))

    @property
    def inline(self) -> bool:
        """True if the matrix is small enough to be stored in the record, complete and finite."""
        return self.array.size <= INLINE and self.every == 1 and bool(np.isfinite(self.array).all())


Plain: TypeAlias = str | int | float | tuple[float, ...]


@dataclass(frozen=True, eq=False)
class Value:
    """The value of an attribute.

    Attributes:
        content: text, a number, numbers, or a matrix.
        unit: of numbers; empty: none.
        note: explains the value to readers.
    """

    content: Plain | Matrix
    unit: str = ""
    note: str = ""


def utc_text(gps_ns: int) -> str:
    """Format a GPS time as UTC in ISO 8601, with microseconds."""
    day = GPS_EPOCH + dt.timedelta(days=gps_ns // (86_400 * SECOND_NS))
    leap_seconds, _ = table_leap_seconds(day)
    start = dt.datetime(GPS_EPOCH.year, GPS_EPOCH.month, GPS_EPOCH.day, tzinfo=dt.UTC)
    moment = start + dt.timedelta(microseconds=gps_ns // 1000) - dt.timedelta(seconds=leap_seconds)
    return moment.isoformat().replace("+00:00", "Z")


def is_plain(value: object) -> bool:
    """Return whether a value is `Plain`: text, a finite number, or several numbers."""
    if isinstance(value, tuple):
        return all(_is_number(one) for one in value)
    return isinstance(value, str) or _is_number(value)


def is_document(document: Any) -> bool:
    """Return whether parsed JSON has the layout of a record: heads, classes, attributes with a value or a matrix."""
    heads = isinstance(document, dict) and all(isinstance(document.get(key), str) for key in ("id", "note"))
    if not heads or len(document["id"].splitlines()) != 1:
        return False
    classes, missing = document.get("classes"), document.get("missing")
    if not (isinstance(classes, list) and isinstance(missing, list)):
        return False
    lost = all(_has_words(one, ("class", "name"), ()) for one in missing)
    return lost and all(
        _has_words(owner, ("name", "standard"), ("attributes",))
        and isinstance(owner.get("attributes"), list)
        and all(_is_attribute(one) for one in owner["attributes"])
        for owner in classes
    )


def _is_attribute(one: Any) -> bool:
    if not _has_words(one, ("name", "type"), ("value", "values", "matrix")):
        return False
    if "matrix" in one:
        rows = one.get("values", [])
        numbers = isinstance(rows, list) and all(isinstance(row, list) and is_plain(tuple(row)) for row in rows)
        return numbers and _has_words(one["matrix"], (), ())
    value = one.get("value")
    return is_plain(tuple(value) if isinstance(value, list) else value)


def _has_words(table: Any, texts: tuple[str, ...], others: tuple[str, ...]) -> bool:
    """Return whether a table has these texts, and under names of letters only words, numbers or truth values.

    The keys in ``others`` may hold other types.
    """
    return (
        isinstance(table, dict)
        and all(isinstance(table.get(key), str) for key in texts)
        and all(key.isascii() and key.isidentifier() for key in table)
        and all(isinstance(value, bool) or is_plain(value) for key, value in table.items() if key not in others)
    )


def _is_number(value: object) -> bool:
    """Return whether a value is a finite number and not a truth value."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < math.inf
