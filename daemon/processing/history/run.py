"""Collects the calibrations below folders, follows the parameters of each scanner, and writes page and CSV."""

from __future__ import annotations

import csv
import datetime as dt
import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from swath.calib.labels import number, unknown, with_sigma
from swath.calib.record.record import IDENTITY, Document, RecordError, read_document
from swath.calib.validation.courses import ScannerCourse, courses
from swath.calib.validation.history import BORESIGHT, HistoryError, created_words, date_words
from swath.daemon.errors import ExitCode, UserError
from swath.daemon.text_files import text_of
from swath.georef.geodesy.rotations import boresight
from swath.georef.scanner.calibration import INDEX, PARAMETERS, Calibration, CalibrationError, nominal, read_calibration
from swath.georef.text_encoding import decoded

RECORD_ENDS = ".record.json"
FIRST = 3  # column of the first parameter
OF_RECORD = {  # attributes of a record with values and sigmas, and the parameters that they hold
    "boresight": BORESIGHT,
    "range": ("range_offset_m",),
    "scanAngle": ("scan_angle_offset_rad",),
    "scannerAssembly": ("scan_plane_tilt_rad",),
}

REMEDY = "give folders with files of swath calibrate"
MOST_NOTES = 5  # that are told where there is no calibration


@dataclass(frozen=True, eq=False)
class Collected:
    """The calibrations that were found.

    Attributes:
        scanners: scanner by scanner.
        files: by id of the calibration, its file.
        notes: what was left out, and why.
    """

    scanners: tuple[ScannerCourse, ...]
    files: Mapping[str, Path]
    notes: tuple[str, ...]

    def record(self) -> dict[str, Any]:
        """Return all of it for JSON."""
        files = {name: str(path) for name, path in self.files.items()}
        return {"scanners": [one.record() for one in self.scanners], "files": files, "notes": list(self.notes)}


def collect(paths: Sequence[Path]) -> Collected:
    """Collect calibration files, and records of calibrations whose files are gone, from files and below folders.

    Raises:
        UserError: a path does not exist, a named file is no calibration, or there is no calibration at all.
    """
    found: dict[str, Calibration] = {}
    files: dict[str, Path] = {}
    notes: list[str] = []
    for path, one in [*_calibrations(paths, notes), *_of_records(paths, notes)]:
        if one.id not in found:
            found[one.id], files[one.id] = one, path
        elif path.suffix == ".toml" and not np.array_equal(found[one.id].parameters, one.parameters):
            notes.append(f"{path}: has the id of {files[one.id]}, {one.id}, but other values; it was left out")
    if not found:
        where = ", ".join(map(str, paths))
        raise UserError("\n".join([*notes[:MOST_NOTES], f"{where}: no calibration there; {REMEDY}"]))
    try:
        scanners = courses(list(found.values()))
    except HistoryError as error:
        raise UserError(str(error)) from error
    notes += [
        f"{files[entry.id]}: tells no serial number, and several scanners may be its {one.scanner}; it stands alone"
        for one in scanners
        if not one.serial and any(other.serial and one.scanner in other.scanner.split(" and ") for other in scanners)
        for entry in one.entries
    ]
    return Collected(scanners, files, tuple(notes))


def _calibrations(paths: Sequence[Path], notes: list[str]) -> Iterator[tuple[Path, Calibration]]:
    for path in _below(paths, ".toml"):
        text = decoded(path.read_bytes(), "replace") if path not in paths else text_of(path, "a calibration file")
        if path not in paths and "[calibration]" not in text:
            continue  # configurations and plans are TOML too
        try:
            yield path, read_calibration(text, str(path))
        except CalibrationError as error:
            if path in paths:
                raise UserError(str(error), ExitCode.USAGE) from error
            notes.append(f"{str(error).splitlines()[0]}; it was left out")


def _of_records(paths: Sequence[Path], notes: list[str]) -> Iterator[tuple[Path, Calibration]]:
    for path in _below(paths, RECORD_ENDS):
        try:
            document = read_document(text_of(path, "a record of swath calibrate"), str(path))
            yield path, calibration_of(document, path.name.removesuffix(RECORD_ENDS))
        except RecordError as error:
            notes.append(f"{error}; it was left out")
        except (KeyError, TypeError, ValueError):
            notes.append(f"{path}: lacks values of the calibration; it was left out")


def _below(paths: Sequence[Path], ending: str) -> Iterator[Path]:
    for path in paths:
        if not path.exists():
            raise UserError(f"{path}: no such file or folder", ExitCode.IO)
        if path.is_dir():
            yield from (one for one in sorted(path.rglob(f"*{ending}")) if one.is_file())
        elif path.name.endswith(ending):
            yield path


def calibration_of(document: Document, scanner: str) -> Calibration:
    """Return the calibration of which a record tells: mounting angles, range and scan angle, without correlations.

    Args:
        document: the record.
        scanner: name of its scanner, if the record does not have it.

    Raises:
        KeyError, TypeError, ValueError: the record lacks values.
    """
    scanner = str(document.get("scanner") or scanner)
    by_key = {
        f"{owner['name']}.{entry['name']}": entry for owner in document["classes"] for entry in owner["attributes"]
    }
    names = [name for names in OF_RECORD.values() for name in names]
    pairs = np.concatenate([np.array(by_key[f"CA_ErrorModel.{key}"]["values"], np.float64) for key in OF_RECORD])
    values = dict(zip(names, pairs[:, 0].tolist(), strict=True))
    matrix = np.array(by_key["CA_BFrame.attitudeSensor"]["values"], np.float64)
    turned = boresight(*(values[name] for name in BORESIGHT)).T @ matrix
    one = nominal(scanner, by_key["CA_BFrame.leverArm"]["value"], np.round(turned, 9).tolist()).changed(**values)
    sigmas = np.zeros(len(PARAMETERS))
    sigmas[[INDEX[name] for name in names]] = pairs[:, 1]
    created = dt.datetime.fromisoformat(by_key["CA_OpticsSensorGeometry.geometryCalibrationDate"]["value"])
    header: dict[str, Any] = {key: document[key] for key in IDENTITY if key in document} | {"created": created}
    if "CA_Frames.timeRecording" in by_key:
        header["flown"] = dt.datetime.fromisoformat(by_key["CA_Frames.timeRecording"]["value"])
    return replace(one, id=document["id"], method="record", sigmas=sigmas, header=header)


# ---------------------------------------------------------------------- output


def history_lines(found: Collected) -> list[str]:
    """Return tables and sentences for people, scanner by scanner."""
    return [line for one in found.scanners for line in _lines(one)] + list(found.notes)


def _lines(one: ScannerCourse) -> list[str]:
    heads, rows = table_of(one)
    heads[FIRST:] = [f"{named.symbol} {named.unit}" for name in one.names if (named := unknown(f".{name}"))]
    widths = [max(len(row[column]) for row in [heads, *rows]) + 2 for column in range(len(heads))]
    count = len(one.entries)
    lines = [f"{one.title}: {count} calibration{'s' if count > 1 else ''}"]
    for row in [heads, *rows]:
        cells = [f"{cell:<{width}}" for cell, width in zip(row[:FIRST], widths[:FIRST], strict=True)]
        cells += [f"{cell:>{width}}" for cell, width in zip(row[FIRST:], widths[FIRST:], strict=True)]
        lines.append("".join(cells).rstrip())
    lines += [step.words for step in one.steps]
    for mounting, found in one.courses.items():
        lines += [f"{mounting}: {course.words}" for course in found if course.kind != "once"]  # else as in the table
    return lines


def table_of(one: ScannerCourse) -> tuple[list[str], list[list[str]]]:
    """Return heads and rows of a scanner's table: a calibration a row, with sigmas."""
    heads = ["flown", "calibration", "mounting"]
    for name in one.names:
        named = unknown(f".{name}")
        heads.append(f"{named.words}, {named.unit}")
    rows = []
    for entry, time, mounting in zip(one.entries, one.times_s, one.mountings, strict=True):
        rows.append([date_words(time)[:10], entry.id, mounting, *(_cell(entry, name) for name in one.names)])
    return heads, rows


def _cell(entry: Calibration, name: str) -> str:
    factor, sigma = unknown(f".{name}").factor, float(entry.sigmas[INDEX[name]])
    value = factor * entry.value(name)
    return with_sigma(value, factor * sigma, sign=False) if sigma > 0.0 else f"{number(value, '.6g')} held"


def csv_text(found: Collected) -> str:
    """Return a row for each calibration: who and when, then every parameter of the model with its sigma."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    keys = [(one, f"{one.key}_sigma") for one in PARAMETERS]
    head = ["scanner", "scanner_serial", "mounting", "flown", "created", "id", "method", "file"]
    writer.writerow([*head, *(word for one, sigma in keys for word in (one.key, sigma))])
    for scanner in found.scanners:
        for entry, time, mounting in zip(scanner.entries, scanner.times_s, scanner.mountings, strict=True):
            row = [entry.scanner, scanner.serial, mounting, date_words(time), created_words(entry)]
            row += [entry.id, entry.method, str(found.files[entry.id])]
            for one, _ in keys:
                sigma = float(entry.sigmas[INDEX[one.name]]) / one.factor
                row += [f"{entry.value(one.name) / one.factor:.9g}", f"{sigma:.4g}" if sigma > 0.0 else ""]
            writer.writerow(row)
    return text.getvalue()
