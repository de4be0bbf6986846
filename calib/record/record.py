"""Build the record of a calibration: its metadata by the dictionary of ISO/TS 19159-2 and 19159-1, as XML and JSON.

Mandatory values that are neither given nor derivable are listed as missing, never made up.
"""

from __future__ import annotations

import json
import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from typing import Any

import numpy as np

from swath.calib.calibration_file import Header
from swath.calib.features import Features
from swath.calib.flight import Flight
from swath.calib.outcome import Adjusted
from swath.calib.record.content import content_of
from swath.calib.record.dictionary import BY_KEY, CALIBRATION_TYPES, CLASSES, ROWS, VALIDATION_METHODS, Class, Row
from swath.calib.record.values import Matrix, Plain, Value, is_document, is_plain
from swath.georef.toml_tables import key_text

Document = dict[str, Any]  # the content of a record's JSON

VERSION = 1
NAMESPACE = f"urn:swath:calibration-record:{VERSION}"
NOTE = (
    "Names of classes and attributes are those of ISO/TS 19159-2:2016 and ISO/TS 19159-1:2014; the namespace and the "
    "elements are this record's own, for no public schema of part 2 is known. confirmed=false: the name, its class, "
    "obligation or type is this record's reading of a clause."
)


IDENTITY = ("scanner", "scanner_model", "scanner_serial", "installation")  # as in the calibration's file

_LONGEST_KEY = 80  # greatest length of a name for the search of similar ones


class RecordError(ValueError):
    """Information on a calibration that no record can hold; the message is one line for the user."""


@dataclass(frozen=True, eq=False)
class RecordInput:
    """The inputs of a record.

    Attributes:
        flight, features, adjusted: of the calibration.
        scanner: the scanner of the record.
        header: of its calibration file.
        told: values that only users know, by ``CLASS.attribute`` of `swath.calib.record.dictionary.ROWS`, as
            ``CA_GNSS.numberSatellites``; numbers in SI units.
        settings: of the run, in words.
        attachment: name of the NPZ file with the complete matrices; empty: there is none.
        known: other known values, by ``CLASS.attribute``: of the instruments, whose configuration is not part of
            `calib`.
    """

    flight: Flight
    features: Features
    adjusted: Adjusted
    scanner: str
    header: Header
    told: Mapping[str, Plain] = field(default_factory=dict)
    settings: Mapping[str, str] = field(default_factory=dict)
    attachment: str = ""
    known: Mapping[str, Value] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Record:
    """The record of a calibration.

    Attributes:
        id: of the calibration.
        values: by ``CLASS.attribute``, in the order of the dictionary.
        missing: mandatory attributes without a value.
        attachment: name of the file with the matrices; empty: none.
        identity: what is known of `IDENTITY`.
    """

    id: str
    values: Mapping[str, Value]
    missing: tuple[str, ...]
    attachment: str = ""
    identity: Mapping[str, str] = field(default_factory=dict)

    def arrays(self) -> dict[str, np.ndarray[Any, np.dtype[np.float64]]]:
        """Return the matrices by attribute, for `numpy.savez_compressed`."""
        matrices = {key.partition(".")[2]: value.content for key, value in self.values.items()}
        return {name: content.array for name, content in matrices.items() if isinstance(content, Matrix)}


def record_of(given: RecordInput) -> Record:
    """Build the record of a calibration.

    Raises:
        RecordError: a given value belongs to no attribute, or has the wrong type for its attribute.
    """
    told = {key: told_value(key, value) for key, value in given.told.items()}
    found = content_of(given.flight, given.features, given.adjusted, given.scanner, given.header, given.settings)
    found |= {**given.known, **told}
    values = {row.key: found[row.key] for row in ROWS if row.key in found}
    missing = tuple(row.key for row in ROWS if row.obligation == "M" and row.key not in values)
    header = given.header
    identity = (given.scanner, header.scanner_model, header.scanner_serial, header.installation)
    known = {key: word for key, word in zip(IDENTITY, identity, strict=True) if word}
    return Record(header.id, values, missing, given.attachment, known)


def told_value(key: str, value: Plain, note: str = "as told") -> Value:
    """Check a value that a user gives for an attribute, and return it as the record holds it.

    Raises:
        RecordError: there is no such attribute, or the value has the wrong type for it.
    """
    row = BY_KEY.get(key)
    if row is None:
        near = get_close_matches(key[:_LONGEST_KEY], BY_KEY, 1, 0.0)
        named = ".".join(map(key_text, key.split(".")))
        raise RecordError(f"{named}: the record has no such attribute; did you mean {near[0]}?")
    if not is_plain(value):
        raise RecordError(f"{key}: got {value!r}, want text, a number, or a list of numbers")
    choices = {"CA_ValidationMethod": tuple(VALIDATION_METHODS), "CA_CalibrationType": CALIBRATION_TYPES}.get(row.type)
    if choices is not None and any(word not in choices for word in str(value).split(", ")):
        raise RecordError(f"{key}: got {value!r}, want {', '.join(choices)}")
    if row.type == "Integer" and (isinstance(value, bool) or not isinstance(value, int)):
        raise RecordError(f"{key}: got {value!r}, want a whole number")
    if row.type == "Length" and isinstance(value, str):
        raise RecordError(f"{key}: got {value!r}, want metres")
    unit = {"Length": "m", "Angle": "rad", "DirectPosition": "m"}.get(row.type, "")
    return Value(value, unit if not isinstance(value, str) else "", note)


def _summary(matrix: Matrix, name: str, attachment: str) -> dict[str, Any]:
    """Summarise a matrix: its size, the magnitude of its numbers, and their place in the attachment."""
    known = matrix.array[np.isfinite(matrix.array)]
    told: dict[str, Any] = {"rows": matrix.rows, "columns": matrix.array.shape[1], "every": matrix.every}
    if len(known):
        rms = math.sqrt(float(np.mean(np.square(known))))
        told |= {"rms": rms, "smallest": float(known.min()), "largest": float(known.max())}
    return told | ({"attachment": attachment, "array": name} if attachment else {})


def record_json(record: Record) -> str:
    """Return the record as JSON; the text is the same for the same record."""
    return document_json(_document(record))


def document_json(document: Document) -> str:
    """Return the JSON text of a document, for example one that `with_told` returns."""
    return json.dumps(document, ensure_ascii=False, indent=1, allow_nan=False) + "\n"


def _document(record: Record) -> Document:
    classes = []
    for owner in CLASSES:
        rows = [row for row in ROWS if row.owner == owner.name and row.key in record.values]
        if rows:
            attributes = [_attribute(row, record.values[row.key], record.attachment) for row in rows]
            classes.append(_of_class(owner) | {"attributes": attributes})
    missing = [{"class": BY_KEY[key].owner, "name": BY_KEY[key].name} for key in record.missing]
    head = {"version": VERSION, "id": record.id, **record.identity, "note": NOTE}
    return head | {"classes": classes, "missing": missing}


def _of_class(owner: Class) -> dict[str, Any]:
    told = {"name": owner.name, "standard": owner.standard, "confirmed": owner.confirmed}
    more = {"specialises": owner.specialises, "note": owner.note}
    return told | {key: word for key, word in more.items() if word}


def _attribute(row: Row, value: Value, attachment: str) -> dict[str, Any]:
    told: dict[str, Any] = {"name": row.name, "type": row.type, "confirmed": row.confirmed}
    more = {"obligation": row.obligation, "occurrence": row.occurrence, "unit": value.unit, "note": value.note}
    told |= {key: word for key, word in more.items() if word}
    content = value.content
    if isinstance(content, Matrix):
        told["matrix"] = _summary(content, row.name, attachment)
        if content.inline:
            told["values"] = content.array.tolist()
    else:
        told["value"] = list(content) if isinstance(content, tuple) else content
    return told


def record_xml(record: Record) -> str:
    """Return the record as XML with an element per class, attribute and value; numbers have all their digits."""
    return document_xml(_document(record))


def document_xml(document: Document) -> str:
    """Return the XML text of a document that holds a record's JSON."""
    ET.register_namespace("cr", NAMESPACE)
    head = {"version": str(document["version"])}
    head |= {key: _clean(document[key]) for key in ("id", *IDENTITY) if key in document}
    root = ET.Element(_tag("calibrationRecord"), head)
    ET.SubElement(root, _tag("note")).text = document["note"]
    for owner in document["classes"]:
        element = ET.SubElement(root, _tag("class"), _words(owner, ("attributes",)))
        for attribute in owner["attributes"]:
            _xml_attribute(element, attribute)
    missing = ET.SubElement(root, _tag("missing"))
    for one in document["missing"]:
        ET.SubElement(missing, _tag("attribute"), one)
    ET.indent(root)
    return "<?xml version='1.0' encoding='UTF-8'?>\n" + ET.tostring(root, encoding="unicode") + "\n"


def _xml_attribute(owner: ET.Element, attribute: Mapping[str, Any]) -> None:
    element = ET.SubElement(owner, _tag("attribute"), _words(attribute, ("value", "values", "matrix")))
    if "matrix" in attribute:
        ET.SubElement(element, _tag("matrix"), _words(attribute["matrix"], ()))
        for row in attribute.get("values", ()):
            ET.SubElement(element, _tag("row")).text = " ".join(_word(number) for number in row)
    else:
        value = attribute["value"]
        for one in value if isinstance(value, list) else [value]:
            ET.SubElement(element, _tag("value")).text = _word(one)


def _tag(name: str) -> str:
    return f"{{{NAMESPACE}}}{name}"


def _words(told: Mapping[str, Any], without: tuple[str, ...]) -> dict[str, str]:
    return {key: _word(value) for key, value in told.items() if key not in without}


def _word(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    return repr(value) if isinstance(value, float) else _clean(str(value))


def _clean(text: str) -> str:
    """Replace the control characters that XML cannot hold."""
    return "".join(one if (one >= " " or one in "\t\n") and one not in "\ufffe\uffff" else "\ufffd" for one in text)


# ---------------------------------------------------------------------- a record that is told more


def read_document(text: str, name: str) -> Document:
    """Read a record as `record_json` wrote it.

    Args:
        text: of the file.
        name: of the file, for messages.

    Raises:
        RecordError: it is not such a record.
    """
    try:
        document = json.loads(text, parse_constant=_refuse)
        json.dumps(document, ensure_ascii=False).encode()  # raises an error for half a surrogate pair, which is no text
        known = document["version"] == VERSION and is_document(document)
        known &= all(isinstance(document.get(key, ""), str) for key in IDENTITY)
        named = [(owner["name"], one["name"]) for owner in document["classes"] for one in owner["attributes"]]
        lost = [(one["class"], one["name"]) for one in document["missing"]]
    except (ValueError, KeyError, TypeError, RecursionError):
        known, named, lost = False, [], []
    if not known or any(f"{owner}.{one}" not in BY_KEY for owner, one in (*named, *lost)):
        raise RecordError(
            f"{name}: not a calibration record; give the NAME.record.json that swath calibrate --report writes"
        )
    told: Document = document
    return told


def _refuse(constant: str) -> float:
    """Refuse NaN and infinity: Python's reader accepts them, but JSON has neither."""
    raise ValueError(constant)


def with_told(document: Document, told: Mapping[str, tuple[Plain, str]]) -> Document:
    """Return the same record with more values, such as facts from after the calibration.

    Args:
        document: of `read_document`.
        told: values and their notes by ``CLASS.attribute``, as `RecordInput.told`; they replace earlier values.

    Raises:
        RecordError: a given value belongs to no attribute, or has the wrong type for its attribute.
    """
    found = {f"{owner['name']}.{one['name']}": one for owner in document["classes"] for one in owner["attributes"]}
    for key, (value, note) in told.items():
        content = told_value(key, value, note)
        found[key] = _attribute(BY_KEY[key], content, "")
    classes = []
    for owner in CLASSES:
        attributes = [found[row.key] for row in ROWS if row.owner == owner.name and row.key in found]
        if attributes:
            classes.append(_of_class(owner) | {"attributes": attributes})
    missing = [one for one in document["missing"] if f"{one['class']}.{one['name']}" not in told]
    return document | {"classes": classes, "missing": missing}
