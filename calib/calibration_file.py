"""Write a calibration as the text of its file (CONVENTIONS, "Calibration file").

`swath.georef.scanner.calibration` reads it.
"""

from __future__ import annotations

import datetime as dt
import json
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from swath.georef.arrays import FloatArray
from swath.georef.scanner.calibration import CONVENTIONS, PARAMETERS, Calibration, CalibrationError, read_calibration

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


def calibration_text(calibration: Calibration, header: Header) -> str:
    """Return the text of the file; the same calibration and header always give the same bytes.

    Numbers are in the file's units, with the fewest digits that read back to the same number. A few numbers (one in
    ten, of parameters in degrees and parts per million) are not the product of a double and their unit: these read back
    as the nearest such product, one unit of the last of 53 binary digits away, and keep that value from then on.

    Raises:
        CalibrationFileError: the calibration is one that readers refuse: not finite, a negative sigma, no rotation, a
            time without zone.
    """
    blocks = [
        _header(calibration, header),
        _parameters(calibration),
        *_estimated(calibration),
        *_tables(calibration),
    ]
    text = "\n\n".join("\n".join(block) for block in blocks) + "\n"
    try:
        read_calibration(text, f"calibration {header.id}")
    except CalibrationError as error:
        raise CalibrationFileError(str(error).splitlines()[0]) from error
    return text


def _header(calibration: Calibration, header: Header) -> list[str]:
    logs = ", ".join(f"{{ name = {_text(name)}, sha256 = {_text(sha256)} }}" for name, sha256 in header.logs)
    rows: list[tuple[str, str | None]] = [
        ("id", _text(header.id)),
        ("scanner", _text(calibration.scanner)),
        ("created", _time(header.created)),
        ("conventions", str(CONVENTIONS)),
        ("scanner_model", _text(header.scanner_model)),
        ("scanner_serial", _text(header.scanner_serial)),
        ("imu_serial", _text(header.imu_serial)),
        ("installation", _text(header.installation)),
        ("installation_matrix", _matrix(calibration.installation_matrix)),
        ("mirror_factor", _optional(calibration.mirror_factor)),
        ("ranges", _said(calibration.ranges)),
        ("refraction", _said(calibration.refraction)),
        ("method", _text(header.method or calibration.method)),
        ("logs", f"[{logs}]"),
        ("variance_factor", _optional(header.variance_factor)),
        ("redundancy", None if header.redundancy is None else _number(header.redundancy)),
        ("trajectory", _text(header.trajectory) if header.trajectory else None),
        ("held", _texts(header.held) if header.verdict or header.held else None),
        ("verdict", _text(header.verdict) if header.verdict else None),
        ("verdict_reasons", _texts(header.verdict_reasons) if header.verdict else None),
    ]
    return ["[calibration]", *(f"{key} = {value}" for key, value in rows if value is not None)]


def _parameters(calibration: Calibration) -> list[str]:
    values = calibration.parameters.tolist()
    rows = zip(PARAMETERS, values, strict=True)
    return ["[parameters]", *(f"{parameter.key} = {in_unit(value, parameter.factor)!r}" for parameter, value in rows)]


def _estimated(calibration: Calibration) -> list[list[str]]:
    """Return the tables [sigma], [held_sigma] and [correlation]; the correlation covers both kinds of parameters."""
    blocks = []
    for title, sigmas in (("sigma", calibration.sigmas), ("held_sigma", calibration.held_sigmas)):
        rows = [
            f"{parameter.key} = {in_unit(sigma, parameter.factor)!r}"
            for parameter, sigma in zip(PARAMETERS, sigmas.tolist(), strict=True)
            if sigma != 0.0
        ]
        blocks += [[f"[{title}]", *rows]] if rows else []
    at = np.flatnonzero(calibration.all_sigmas)
    if not len(at):
        return []
    matrix = calibration.correlation[np.ix_(at, at)]
    np.fill_diagonal(matrix, np.where(np.abs(np.diag(matrix) - 1.0) < ROUNDING, 1.0, np.diag(matrix)))
    names = ", ".join(_text(PARAMETERS[index].key) for index in at)
    return [*blocks, ["[correlation]", f"names = [{names}]", f"matrix = {_long_matrix(matrix)}"]]


def _tables(calibration: Calibration) -> list[list[str]]:
    blocks = []
    if calibration.ibrc is not None:
        intensity, correction_m = (_list(column.tolist()) for column in calibration.ibrc)
        blocks.append(["[ibrc]", f"intensity = {intensity}", f"correction_m = {correction_m}"])
    for offset in calibration.range_offsets:
        rows = [("return_slot", offset.return_slot), ("mta_zone", offset.mta_zone)]
        block = ["[[range_offset]]", *(f"{key} = {value:d}" for key, value in rows if value is not None)]
        block += [f"prf_hz = {_number(offset.prf_hz)}"] if offset.prf_hz is not None else []
        blocks.append([*block, f"offset_m = {in_unit(offset.offset_m, 1.0)!r}"])
    for index, tilt_rad in sorted(calibration.facet_tilt_rad.items()):
        blocks.append(["[[facet]]", f"index = {index:d}", f"tilt_deg = {in_unit(tilt_rad, _DEG, math.radians)!r}"])
    for channel, beam in sorted(calibration.beams.items()):
        angles = [("azimuth_deg", beam.azimuth_rad), ("elevation_deg", beam.elevation_rad)]
        block = ["[[beam]]", f"channel = {channel:d}"]
        block += [f"{key} = {in_unit(value, _DEG, math.radians)!r}" for key, value in angles]
        blocks.append([*block, f"range_m = {in_unit(beam.range_m, 1.0)!r}"])
    return blocks


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


def _number(value: float) -> str:
    """Format a number; whole numbers have no decimal point, as counts and rates are written."""
    if not math.isfinite(value):
        raise CalibrationFileError(f"a calibration contains {value!r}; every number must be finite")
    return str(int(value)) if float(value).is_integer() and abs(value) < 1e15 else repr(float(value))


def _optional(value: float | None) -> str | None:
    return None if value is None else repr(in_unit(float(value), 1.0))


def _said(value: str | None) -> str | None:
    return None if value is None else _text(value)


def _text(value: str) -> str:
    """Return a basic TOML string: JSON's escapes are valid in TOML, which also requires DEL to be escaped."""
    try:
        value.encode()
    except UnicodeEncodeError as error:
        raise CalibrationFileError(f"{value!r} cannot be encoded as UTF-8") from error
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def _time(value: dt.datetime) -> str:
    if value.utcoffset() is None:
        raise CalibrationFileError(f"created: {value.isoformat()} has no time zone; give it in UTC")
    return value.astimezone(dt.UTC).replace(tzinfo=None).isoformat() + "Z"


def _texts(values: Iterable[str]) -> str:
    return f"[{', '.join(map(_text, values))}]"


def _list(values: Iterable[float]) -> str:
    return f"[{', '.join(_number(value) for value in values)}]"


def _matrix(rows: Sequence[Sequence[float]] | FloatArray) -> str:
    return f"[{', '.join(_list(row) for row in np.asarray(rows).tolist())}]"


def _long_matrix(matrix: FloatArray) -> str:
    """Return a matrix with one row on each line."""
    return "".join(["[\n", *(f"  {_list(row)},\n" for row in matrix.tolist()), "]"])
