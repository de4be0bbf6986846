"""Fills rows of protocol ``records`` from a table's columns, with defaults for what a table need not say."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from swath.drivers.captures.tables.cells import Cells
from swath.drivers.captures.tables.columns import Column
from swath.drivers.record_frames import ROWS, RowKind, Scale
from swath.georef.records import FixType

UTC_SIGMA_S = 0.1  # of a time that another computer stamped, beside the fixes': decision 0041
_DIAGONAL = (0, 3, 5)  # of nn, ne, nd, ee, ed, dd
_FIX_TYPES = {one.name.lower(): int(one) for one in FixType} | {
    "fixed": int(FixType.RTK_FIXED),
    "float": int(FixType.RTK_FLOAT),
    "rtk": int(FixType.RTK_FIXED),
    "dgps": int(FixType.DIFFERENTIAL),
    "dgnss": int(FixType.DIFFERENTIAL),
    "sbas": int(FixType.DIFFERENTIAL),
    "autonomous": int(FixType.SINGLE),
    "none": int(FixType.NONE),
}
_MISSING = {"satellites": -1, "count": -1, "rising": -1, "leap_seconds": -1, "pps_time_ns": -1}
_MISSING |= {"valid": 1, "return_number": 1, "number_of_returns": 1}


def rows_of(kind: RowKind, columns: Mapping[str, Column], cells: Cells, scale: Scale) -> Any:
    """Return the rows (n,) of a block, without their times.

    Args:
        kind: of the rows.
        columns: by quantity.
        cells: the block's.
        scale: of the rows' times, which decides what sigma they have where the table has none.
    """
    rows = np.zeros(cells.count, ROWS[kind])
    for name in rows.dtype.names or ():
        if rows.dtype[name].base.kind == "f":
            rows[name] = np.nan
        elif name in _MISSING:
            rows[name] = _MISSING[name]
    for quantity, column in columns.items():
        name, _, part = quantity.partition("/")
        if name not in (rows.dtype.names or ()) or column.quantity.text:
            continue
        target = rows[name][:, int(part)] if part else rows[name]
        if target.dtype.kind == "f":
            with np.errstate(over="ignore"):  # a number that single precision cannot hold becomes infinite
                target[:] = cells.numbers(column)
        elif column.quantity.dimension == "time":
            target[:] = cells.times(column)
        else:
            limits = np.iinfo(target.dtype)
            whole = cells.whole(column, _MISSING.get(name, 0))
            target[:] = np.clip(whole, limits.min, min(limits.max, 2**63 - 1))
    for quantity, column in columns.items():
        if column.quantity.text:
            _fill_text(rows, quantity, cells.words(column))
    _FINISH.get(kind, _nothing)(rows, columns, cells)
    if kind is RowKind.SAMPLE and "time_sigma_s" not in columns:
        rows["time_sigma_s"] = UTC_SIGMA_S if scale is Scale.UTC else 0.0
    return rows


def _nothing(rows: Any, columns: Mapping[str, Column], cells: Cells) -> None:
    del rows, columns, cells


def _fill_text(rows: Any, name: str, words: list[str]) -> None:
    if name == "edge":
        rows["names_next"] = [word.strip().lower() == "next" for word in words]
    elif name == "fix_type":
        rows["fix_type"] = [_fix_type(word) for word in words]
    elif rows.dtype[name].kind == "S":
        rows[name] = [word.encode() for word in words]


def _fix_type(word: str) -> int:
    text = word.strip().lower().replace(" ", "_").replace("-", "_")
    if text.isdecimal():
        return min(int(text), 255)
    return _FIX_TYPES.get(text, int(FixType.NONE))


def _finish_fix(rows: Any, columns: Mapping[str, Column], cells: Cells) -> None:
    """Fill what fixes need not say: a fix of no known type is a single one, of no known antenna the primary's."""
    _ellipsoidal(rows, columns, cells)
    if "fix_type" not in columns:
        rows["fix_type"] = int(FixType.SINGLE)
    if "antenna" not in columns:
        rows["antenna"] = b"primary"
    for sigma, covariance in (("position_sigma_l", "position_cov_l"), ("velocity_sigma_l", "velocity_cov_l")):
        for part, place in enumerate(_DIAGONAL):
            column = columns.get(f"{sigma}/{part}")
            if column is not None and f"{covariance}/{place}" not in columns:
                rows[covariance][:, place] = cells.numbers(column) ** 2
        given = [place for place in range(6) if f"{covariance}/{place}" in columns]
        known = np.isfinite(rows[covariance][:, _DIAGONAL[0]])
        for place in set(range(6)) - set(_DIAGONAL) - set(given):
            rows[covariance][known, place] = 0.0


def _ellipsoidal(rows: Any, columns: Mapping[str, Column], cells: Cells) -> None:
    """Add the geoid's height to heights above it, where the table has none above the ellipsoid."""
    if "height_m" in columns or "msl_m" not in columns:
        return
    undulation = cells.numbers(columns["undulation_m"]) if "undulation_m" in columns else np.nan
    rows["height_m"] = cells.numbers(columns["msl_m"]) + undulation


def _finish_return(rows: Any, columns: Mapping[str, Column], cells: Cells) -> None:
    for name in ("intensity", "pulse_width_ns"):
        if name in (rows.dtype.names or ()):
            rows[name] = np.nan_to_num(rows[name], nan=0.0)
    if "pulse_id" not in columns and "pulse_id" in (rows.dtype.names or ()):
        rows["pulse_id"] = np.arange(cells.count)


_FINISH = {
    RowKind.FIX: _finish_fix,
    RowKind.SOLUTION: _ellipsoidal,
    RowKind.RETURN: _finish_return,
    RowKind.POINT: _finish_return,
}
