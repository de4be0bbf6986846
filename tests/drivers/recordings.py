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
    """By file: the decoders' counts and the checksum-only scan of ``fixtures/<family>/expected.json``."""
    found: dict[str, dict[str, Any]] = json.loads((FIXTURES / family / "expected.json").read_text())
    return found


@cache
def recording(family: str, name: str) -> bytes:
    """The receiver's bytes: unpacked, without the comment header of gpsd's logs."""
    data = gzip.decompress((FIXTURES / family / f"{name}.gz").read_bytes())
    entry = expected(family)[name]
    assert len(data) == entry["bytes"], f"{name} is not the file of expected.json"
    return data[entry.get("comment_header_bytes_skipped", 0) :]


def gpsd_reports(family: str, name: str) -> list[dict[str, Any]]:
    """gpsd's TPV reports of a log that have a position."""
    lines = gzip.decompress((FIXTURES / family / f"{name}.chk.gz").read_bytes()).decode().splitlines()
    reports = [json.loads(line[line.index('{"class"') :]) for line in lines]
    return [report for report in reports if "lat" in report and "time" in report]


def every_recording() -> list[tuple[str, str]]:
    """All (family, file) pairs."""
    return [(family, name) for family in FAMILIES for name in sorted(expected(family))]
