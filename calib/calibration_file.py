"""Write a calibration as the text of its file (CONVENTIONS, "Calibration file").

`swath.georef.scanner.calibration` reads it.
"""

from __future__ import annotations

import datetime as dt
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import tomlkit
from tomlkit.items import Array

from swath.georef.arrays import FloatArray
from swath.georef.scanner.calibration import (
    CONVENTIONS,
    PARAMETERS,
    Calibration,
    CalibrationError,
    RangeOffset,
    read_calibration,
)

_DEG = math.pi / 180.0
ROUNDING = 1e-9  # tolerance for the correlation of a parameter with itself


class CalibrationFileError(ValueError):
    """A calibration that cannot be written to a file; the message is one line for the user."""


@dataclass(frozen=True, slots=True)
class Header:
    """Holds the contents of a calibration file other than the calibration itself.

    Attributes:
        id: unique; copied into every product made with the calibration.
        created: time of creation, with its time zone.
        method: one of `swath.georef.scanner.calibration.METHODS`; empty: the calibration's own.
        scanner_model, scanner_serial, imu_serial: the devices it belongs to; empty: not compared.
        installation: id of the mounting.
        logs: name and SHA-256 (hex) of each log.
        variance_factor, redundancy: of the adjustment; None: there was no adjustment.
        verdict: one of `swath.georef.scanner.calibration.VERDICTS`; empty: not judged.
        verdict_reasons: why the verdict is not simply good, one sentence each.
        held: keys of parameters that were requested but not estimated.
        trajectory: ``navigated``, ``ins`` or ``file``, the source of the trajectory; empty: not known.
        flown: time of the first return used, with its time zone; None: not known.
    """

    id: str
    created: dt.datetime
    method: str = ""
    scanner_model: str = ""
    scanner_serial: str = ""
    imu_serial: str = ""
    installation: str = ""
    logs: tuple[tuple[str, str], ...] = ()
    variance_factor: float | None = None
    redundancy: float | None = None
    verdict: str = ""
    verdict_reasons: tuple[str, ...] = ()
    held: tuple[str, ...] = ()
    trajectory: str = ""
    flown: dt.datetime | None = None


def calibration_text(calibration: Calibration, header: Header) -> str:
    """Return the text of the file; the same calibration and header always give the same bytes.

    Numbers are in the file's units, with the fewest digits that read back to the same number. A few numbers (one in
    ten, of parameters in degrees and parts per million) are not the product of a double and their unit: these read back
    as the nearest such product, one unit of the last of 53 binary digits away, and keep that value from then on.

    Raises:
        CalibrationFileError: the calibration is one that readers refuse: not finite, a negative sigma, no rotation, a
            time without zone.
    """
    document: dict[str, Any] = {
        "calibration": _header(calibration, header),
        "parameters": _in_units(calibration.parameters),
        **_estimated(calibration),
        **_tables(calibration),
    }
    text = _encodable(tomlkit.dumps(document))
    try:
        read_calibration(text, f"calibration {header.id}")
    except CalibrationError as error:
        raise CalibrationFileError(str(error).splitlines()[0]) from error
    return text


def _encodable(text: str) -> str:
    """Return the text; refuse it if a name holds bytes that are no text, as names of files may."""
    try:
        text.encode()
    except UnicodeEncodeError as error:
        line = text[text.rfind("\n", 0, error.start) + 1 : text.find("\n", error.start)]
        raise CalibrationFileError(f"{line!r} cannot be encoded as UTF-8") from error
    return text


def _header(calibration: Calibration, header: Header) -> dict[str, Any]:
    rows: dict[str, Any] = {
        "id": header.id,
        "scanner": calibration.scanner,
        "created": _utc(header.created, "created"),
        "flown": None if header.flown is None else _utc(header.flown, "flown"),
        "conventions": CONVENTIONS,
        "scanner_model": header.scanner_model,
        "scanner_serial": header.scanner_serial,
        "imu_serial": header.imu_serial,
        "installation": header.installation,
        "installation_matrix": [_numbers(row) for row in np.asarray(calibration.installation_matrix).tolist()],
        "mirror_factor": _optional(calibration.mirror_factor),
        "ranges": calibration.ranges,
        "refraction": calibration.refraction,
        "method": header.method or calibration.method,
        "logs": _logs(header.logs),
        "variance_factor": _optional(header.variance_factor),
        "redundancy": None if header.redundancy is None else _number(header.redundancy),
        "trajectory": header.trajectory or None,
        "held": header.held if header.verdict or header.held else None,
        "verdict": header.verdict or None,
        "verdict_reasons": header.verdict_reasons if header.verdict else None,
    }
    return {key: value for key, value in rows.items() if value is not None}


def _in_units(values: FloatArray) -> dict[str, float]:
    """Return parameters or their sigmas (16,) by the file's keys, in the file's units."""
    rows = zip(PARAMETERS, values.tolist(), strict=True)
    return {parameter.key: in_unit(value, parameter.factor) for parameter, value in rows}


def _estimated(calibration: Calibration) -> dict[str, Any]:
    """Return the tables [sigma], [held_sigma] and [correlation]; the correlation covers both kinds of parameters."""
    tables: dict[str, Any] = {}
    for title, sigmas in (("sigma", calibration.sigmas), ("held_sigma", calibration.held_sigmas)):
        if rows := {key: sigma for key, sigma in _in_units(sigmas).items() if sigma != 0.0}:
            tables[title] = rows
    at = np.flatnonzero(calibration.all_sigmas)
    if not len(at):
        return {}
    matrix = calibration.correlation[np.ix_(at, at)]
    np.fill_diagonal(matrix, np.where(np.abs(np.diag(matrix) - 1.0) < ROUNDING, 1.0, np.diag(matrix)))
    return tables | {"correlation": {"names": [PARAMETERS[index].key for index in at], "matrix": _long_matrix(matrix)}}


def _tables(calibration: Calibration) -> dict[str, Any]:
    tables: dict[str, Any] = {}
    if calibration.ibrc is not None:
        intensity, correction_m = (_numbers(column.tolist()) for column in calibration.ibrc)
        tables["ibrc"] = {"intensity": intensity, "correction_m": correction_m}
    tables["range_offset"] = [_range_offset(offset) for offset in calibration.range_offsets]
    tables["facet"] = [
        {"index": int(index), "tilt_deg": in_unit(tilt_rad, _DEG, math.radians)}
        for index, tilt_rad in sorted(calibration.facet_tilt_rad.items())
    ]
    tables["beam"] = [
        {
            "channel": int(channel),
            "azimuth_deg": in_unit(beam.azimuth_rad, _DEG, math.radians),
            "elevation_deg": in_unit(beam.elevation_rad, _DEG, math.radians),
            "range_m": in_unit(beam.range_m, 1.0),
        }
        for channel, beam in sorted(calibration.beams.items())
    ]
    return {title: rows for title, rows in tables.items() if rows}


def _range_offset(offset: RangeOffset) -> dict[str, float]:
    matched = {"return_slot": offset.return_slot, "mta_zone": offset.mta_zone, "prf_hz": offset.prf_hz}
    rows = {key: _number(value) for key, value in matched.items() if value is not None}
    return rows | {"offset_m": in_unit(offset.offset_m, 1.0)}


def in_unit(value: float, factor: float, back: Callable[[float], float] | None = None) -> float:
    """Return a number in a file's unit: of the numbers that read back as ``value``, the one with the fewest digits.

    Args:
        value: SI.
        factor: SI units per unit of the file.
        back: conversion that a reader applies; None: times ``factor``.

    Raises:
        CalibrationFileError: the value is not finite.
    """
    if not math.isfinite(value):
        raise CalibrationFileError(f"a calibration contains {value!r}; every number must be finite")
    if value == 0.0:
        return 0.0

    def read(number: float) -> float:
        return number * factor if back is None else back(number)

    nearest = value / factor
    around = [nearest, *(float(f"{nearest:.{digits}g}") for digits in (13, 14, 15, 16))]
    return min(around, key=lambda number: (abs(read(number) - value), len(repr(number))))


def _number(value: float) -> float:
    """Return a number as it is written; whole numbers become integers, because counts and rates have no decimal point.

    Raises:
        CalibrationFileError: the value is not finite.
    """
    if not math.isfinite(value):
        raise CalibrationFileError(f"a calibration contains {value!r}; every number must be finite")
    return int(value) if float(value).is_integer() and abs(value) < 1e15 else float(value)


def _numbers(values: Iterable[float]) -> Array:
    """Return numbers on one line, added at once: tomlkit's time for adding them singly grows with their square."""
    row = tomlkit.array()
    items = [item for value in values for item in (tomlkit.ws(", "), _number(value))]
    row.add_line(*items[1:], indent="", newline=False, add_comma=False)
    return row


def _optional(value: float | None) -> float | None:
    return None if value is None else in_unit(float(value), 1.0)


def _utc(value: dt.datetime, key: str) -> dt.datetime:
    if value.utcoffset() is None:
        raise CalibrationFileError(f"{key}: {value.isoformat()} has no time zone; give it in UTC")
    return value.astimezone(dt.UTC)


def _logs(logs: Iterable[tuple[str, str]]) -> Array:
    """Return the logs as tables of one line each; as an array of tables they would follow all keys of [calibration]."""
    rows = tomlkit.array()
    for name, sha256 in logs:
        row = tomlkit.inline_table()
        row.add(tomlkit.ws(" "))
        row.add("name", name)
        row.add("sha256", sha256)
        row.add(tomlkit.ws(" "))
        rows.append(row)
    return rows


def _long_matrix(matrix: FloatArray) -> Array:
    """Return a matrix with one row on each line."""
    rows = tomlkit.array()
    for row in matrix.tolist():
        rows.add_line(_numbers(row), indent="  ")
    rows.add_line(indent="")
    return rows
