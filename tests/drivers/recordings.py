"""Reads the receivers' recordings in fixtures/ and what others found in them."""

from __future__ import annotations

import gzip
import json
from functools import cache
from pathlib import Path
from typing import Any

FIXTURES = Path(__file__).parents[2] / "fixtures"
FAMILIES = ("nmea", "ubx", "rtcm3")


@cache
def expected(family: str) -> dict[str, dict[str, Any]]:
    """Return by file the contents of ``fixtures/<family>/expected.json``."""
    found: dict[str, dict[str, Any]] = json.loads((FIXTURES / family / "expected.json").read_text())
    return found


@cache
def recording(family: str, name: str) -> bytes:
    """Return the receiver's bytes, unpacked and without the comment header of gpsd's logs."""
    data = gzip.decompress((FIXTURES / family / f"{name}.gz").read_bytes())
    entry = expected(family)[name]
    assert len(data) == entry["bytes"], f"{name} is not the file of expected.json"
    return data[entry.get("comment_header_bytes_skipped", 0) :]


def gpsd_reports(family: str, name: str) -> list[dict[str, Any]]:
    """Return gpsd's TPV reports of a log that have a position."""
    return [report for report in gpsd_output(family, name, "TPV") if "lat" in report and "time" in report]


def gpsd_output(family: str, name: str, kind: str) -> list[dict[str, Any]]:
    """Return gpsd's reports of one class from a log, in order."""
    return [json.loads(line) for line in gpsd_lines(family, name) if line.startswith(b'{"class":"%s"' % kind.encode())]


def gpsd_lines(family: str, name: str) -> list[bytes]:
    """Return gpsd's output from a log: its reports, and the receiver's sentences or ones made from its messages."""
    return gzip.decompress((FIXTURES / family / f"{name}.chk.gz").read_bytes()).splitlines()


def every_recording() -> list[tuple[str, str]]:
    """Return all (family, file) pairs."""
    return [(family, name) for family in FAMILIES for name in sorted(expected(family))]
