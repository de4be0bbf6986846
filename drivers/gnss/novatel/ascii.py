"""NovAtel OEM7 ASCII logs: header and fields to the bodies of `layouts`, and an encoder (docs.novatel.com/OEM7, ASCII).

A log has the fields of its binary form in the same order; enumerations are written by name, masks in hexadecimal
digits, a body of a short header begins with ``%``. A field that is added by a newer firmware is left out.
"""

from __future__ import annotations

import csv
import re
import struct
from collections.abc import Mapping
from typing import NamedTuple, TypeVar

from swath.drivers.framing.checksums import crc32_novatel
from swath.drivers.framing.kinds import NOVATEL_ASCII_TAIL_BYTES
from swath.drivers.gnss.novatel import layouts as nov
from swath.drivers.gnss.novatel import tables

NAMES: dict[str, Mapping[str, int]] = {  # enumerations by field
    "solution_status": tables.SOLUTION_STATUSES,
    "position_type": tables.POSITION_TYPES,
    "velocity_type": tables.POSITION_TYPES,
    "ins_status": tables.INS_STATUSES,
    "clock_status": tables.CLOCK_STATUSES,
    "utc_status": tables.UTC_STATUSES,
    "datum": {"WGS84": 61, "USER": 63},
    "imu_type": tables.IMU_TYPES,
}
HEXADECIMAL = frozenset(
    {"extended_status", "galileo_beidou_mask", "gps_glonass_mask", "imu_status", "imu_info", "solution_source"}
)
UNKNOWN_NAME = 0xFFFF  # of an enumeration: in no table
INTEGER = re.compile(r"[+-]?[0-9]{1,20}")
HEX_DIGITS = re.compile(r"[0-9A-Fa-f]{1,8}")
NUMBER = re.compile(r"[+-]?[0-9]{1,20}(?:\.[0-9]*)?(?:[eE][+-]?[0-9]{1,3})?|[+-]?(?:nan|inf)", re.IGNORECASE)
FORMAT_CODES = re.compile(r"(\d*)([a-zA-Z])")
ASCII_LETTER = "A"
NUMBERED = re.compile(r"_[0-9]+$")
SECONDARY = "_1"  # as in the binary header's source; older firmware sends other numbers without meaning
GREATEST_WEEK = 0xFFFF
WEEK_S = 604_800
SOFTWARE = 17002


BodyT = TypeVar("BodyT")


class FieldError(ValueError):
    """A field cannot be read; the log is counted as bad."""


class AsciiHeader(NamedTuple):
    """Header of an ASCII log; ``time_status`` is None in a short one, and ``source`` is 1 for a secondary antenna."""

    name: str
    week: int
    milliseconds: int
    time_status: int | None
    source: int


def split_log(frame: bytes) -> tuple[list[str], list[str]]:
    """Split a log into the fields of its header, name first, and of its body; a quoted text is one field.

    Raises:
        FieldError: it has no semicolon.
    """
    text = frame[1 : frame.rindex(b"*")].decode("ascii")
    head, semicolon, body = text.partition(";")
    if not semicolon:
        raise FieldError("header")
    return head.split(","), next(csv.reader([body]), [])


def read_header(frame: bytes, fields: list[str]) -> AsciiHeader:
    """Read the header: name, port, sequence, idle time, time status, week, seconds; a short one: name, week, seconds.

    Raises:
        FieldError: a field is missing or not a number.
    """
    short = frame[:1] == b"%"
    if len(fields) < (3 if short else 7):
        raise FieldError("header")
    name = NUMBERED.sub("", fields[0])
    week, seconds = (fields[1], fields[2]) if short else (fields[5], fields[6])
    if not INTEGER.fullmatch(week) or not NUMBER.fullmatch(seconds):
        raise FieldError("time")
    number, milliseconds = int(week), round(_seconds(seconds) * 1000)
    if not 0 <= number <= GREATEST_WEEK:
        raise FieldError("week")
    time_status = None if short else tables.TIME_STATUSES.get(fields[4], UNKNOWN_NAME)
    source = 1 if fields[0].endswith(SECONDARY) else 0
    return AsciiHeader(name.removesuffix(ASCII_LETTER), number, milliseconds, time_status, source)


def _seconds(text: str) -> float:
    seconds = float(text)
    if not 0.0 <= seconds < WEEK_S:
        raise FieldError("time of week")
    return seconds


def read_body(body: type[BodyT], wire: struct.Struct, texts: list[str]) -> BodyT:
    """Read the fields of a body, as its binary form has them.

    Raises:
        FieldError: a field is missing, not a number, or larger than its place in the binary form.
    """
    codes = wire_codes(wire)
    if len(texts) < len(codes):
        raise FieldError("fields")
    names: tuple[str, ...] = getattr(body, "_fields", ())
    values = [_value(name, code, text) for name, code, text in zip(names, codes, texts, strict=False)]
    try:
        return body(*wire.unpack(wire.pack(*values)))
    except (struct.error, OverflowError):
        raise FieldError("range") from None


def wire_codes(wire: struct.Struct) -> list[str]:
    """Return the format codes of a layout's fields; a text of several bytes is one field."""
    codes: list[str] = []
    for count, code in FORMAT_CODES.findall(wire.format):
        codes += [count + code] if code == "s" else [] if code == "x" else [code] * int(count or 1)
    return codes


def _value(name: str, code: str, text: str) -> float | bytes:
    if code.endswith("s"):
        return text.encode("ascii")
    if code in "df":
        if not NUMBER.fullmatch(text):
            raise FieldError(name)
        return float(text)
    if name in HEXADECIMAL:
        if not HEX_DIGITS.fullmatch(text):
            raise FieldError(name)
        return int(text, 16)
    if INTEGER.fullmatch(text):
        return int(text)
    if name not in NAMES:
        raise FieldError(name)
    known = NAMES[name].get(text.upper(), UNKNOWN_NAME)
    return min(known, 0xFF) if code == "B" else known


# --- encoder ---


def encode_ascii(
    name: str, body: nov.Body, week: int, milliseconds: int, *, time_status: str = "FINESTEERING", port: str = "COM1"
) -> bytes:
    """Encode a log by name in ASCII, with the header form that belongs to it.

    Raises:
        KeyError: no layout has that name.
    """
    layout = nov.LAYOUTS[nov.IDS[name]]
    texts = field_texts(layout.body, layout.wire, tuple(body))
    seconds = f"{milliseconds / 1000:.3f}"
    if layout.short:
        head = f"{name}A,{week},{seconds}"
        return seal(b"%", f"{head};{','.join(texts)}")
    head = f"{name}A,{port},0,60.0,{time_status},{week},{seconds},00000000,0000,{SOFTWARE}"
    return seal(b"#", f"{head};{','.join(texts)}")


def seal(sync: bytes, text: str) -> bytes:
    """Return a log of its text between sync and star, with checksum and line end."""
    content = text.encode("ascii")
    digits = f"*{crc32_novatel(content):08x}".encode()
    assert len(digits) == NOVATEL_ASCII_TAIL_BYTES
    return sync + content + digits + b"\r\n"


def field_texts(body: type, wire: struct.Struct, values: tuple[float | bytes, ...]) -> list[str]:
    """Return the texts of a body's values."""
    names: tuple[str, ...] = getattr(body, "_fields", ())
    return [_text(name, code, value) for name, code, value in zip(names, wire_codes(wire), values, strict=True)]


def _text(name: str, code: str, value: float | bytes) -> str:
    if isinstance(value, bytes):
        return '"' + value.rstrip(b"\0").decode("ascii") + '"'
    if code in "df":
        return repr(float(value))
    if name in HEXADECIMAL:
        return f"{int(value):08x}" if code == "I" else f"{int(value):02x}"
    if name in NAMES:
        return next((text for text, number in NAMES[name].items() if number == value), str(value))
    return str(value)
