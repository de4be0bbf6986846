"""Adds a validation to a calibration's record: writes the record of `swath calibrate --report` anew with it."""

from __future__ import annotations

import datetime as dt
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from swath.calib.record.record import Document, RecordError, document_json, document_xml, read_document, with_told
from swath.calib.record.values import Plain
from swath.calib.validation.methods import Validation
from swath.daemon.errors import ExitCode, UserError
from swath.daemon.text_files import text_of
from swath.georef.scanner.calibration import Calibration


@dataclass(frozen=True)
class Recorded:
    """The records of calibrations that are validated.

    Attributes:
        documents: records by scanner.
        notes: one line per calibration without a record.
    """

    documents: Mapping[str, Document]
    notes: tuple[str, ...] = ()


def records_of(files: Sequence[tuple[Path, Calibration]], where: Path | None) -> Recorded:
    """Return the records of calibrations, from beside their files or from where the user says.

    Args:
        files: calibration files with their contents.
        where: a record or a folder of records; None: beside the files, where they may be missing.

    Raises:
        UserError: a file that the user names is not a record, or is of another calibration.
    """
    if where is not None and where.is_file() and len(files) > 1:
        raise UserError(f"--record {where}: for several calibrations, give the folder of their records", ExitCode.USAGE)
    documents: dict[str, Document] = {}
    notes: list[str] = []
    for file, calibration in files:
        name = f"{calibration.scanner}.record.json"
        path = file.parent / name if where is None else where / name if where.is_dir() else where
        if where is None and not path.exists():
            notes.append(
                f"{file}: no {name} beside it; give its place with --record to add this validation to the record"
            )
            continue
        try:
            documents[calibration.scanner] = _document(path, file, calibration)
        except UserError as error:
            if where is not None:
                raise
            notes.append(f"{error.message}; the record is unchanged")
    return Recorded(documents, tuple(notes))


def _document(path: Path, file: Path, calibration: Calibration) -> Document:
    try:
        document = read_document(text_of(path, "a record of swath calibrate"), str(path))
    except RecordError as error:
        raise UserError(str(error), ExitCode.USAGE) from error
    if document["id"] != calibration.id:
        what = f"is the record of calibration {document['id']}, but {file} is {calibration.id}"
        raise UserError(f"{path}: {what}", ExitCode.USAGE)
    return document


def record_files(
    folder: Path, documents: Mapping[str, Document], validation: Validation, logs: Sequence[tuple[str, str]]
) -> dict[Path, bytes]:
    """Return records with the validation in them as XML and JSON, by path.

    Args:
        folder: where the files go.
        documents: records by scanner.
        validation: the result; methods that could not be applied are not listed.
        logs: name and SHA-256 of the logs that it was validated against.
    """
    values = told_of(validation, logs, dt.datetime.now(dt.UTC))
    files: dict[Path, bytes] = {}
    for scanner, document in documents.items():
        validated = with_told(document, values)
        files[folder / f"{scanner}.record.xml"] = document_xml(validated).encode()
        files[folder / f"{scanner}.record.json"] = document_json(validated).encode()
    return files


def told_of(validation: Validation, logs: Sequence[tuple[str, str]], now: dt.datetime) -> dict[str, tuple[Plain, str]]:
    """Return values and notes by ``CLASS.attribute``: methods with results, time, logs and number of check points."""
    applied = [method for method in validation.methods if method.passed is not None]
    against = ", ".join(f"{name} (SHA-256 {sha256})" for name, sha256 in logs)
    values: dict[str, tuple[Plain, str]] = {
        "CA_GeometryValidation.validationMethod": (
            ", ".join(method.name for method in applied),
            ". ".join([validation.sentence, *(method.sentence for method in applied), *validation.dependent]),
        ),
        "CA_GeometryValidation.validationTime": (
            now.replace(microsecond=0).isoformat().replace("+00:00", "Z"),
            f"against {against}",
        ),
    }
    for method in applied:
        if method.name == "testfield":
            note = "points given to the validation; the user must make sure that the calibration did not use them"
            values["CA_TestRange.numberCheckPoints"] = (int(method.more["points"]), note)
    return values
