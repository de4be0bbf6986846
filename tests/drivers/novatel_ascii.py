"""Reads the output of NovAtel's own decoder (novatel-edie, ASCII logs) and its recordings for comparison."""

from __future__ import annotations

import csv
import gzip
from dataclasses import dataclass
from pathlib import Path

from swath.georef.timescales.gps_time import SECOND_NS

FIXTURES = Path(__file__).parents[2] / "fixtures/novatel"
WEEK_NS = 604_800 * SECOND_NS


def recording(name: str) -> bytes:
    """Return a recording's bytes, whether it is stored gzipped or not."""
    plain, packed = FIXTURES / name, FIXTURES / f"{name}.gz"
    return plain.read_bytes() if plain.exists() else gzip.decompress(packed.read_bytes())


@dataclass(frozen=True)
class AsciiLog:
    """One ASCII log.

    Attributes:
        name: without the format letter: ``BESTPOS``.
        status: GPS reference time status; empty in a short header.
        week, seconds: GPS week and seconds of the header.
        fields: everything after the semicolon, as text.
    """

    name: str
    status: str
    week: int
    seconds: float
    fields: tuple[str, ...]

    @property
    def time_ns(self) -> int:
        """Return the nanoseconds of the week in the header."""
        return round(self.seconds * 1000) * 1_000_000

    def numbers(self, *places: int) -> list[float]:
        """Return fields as numbers, by positions counted from 0."""
        return [float(self.fields[place]) for place in places]


def ascii_logs(name: str, *wanted: str) -> list[AsciiLog]:
    """Return the logs of an expectation file with the given names."""
    text = gzip.decompress((FIXTURES / f"{name}.edie.ascii.gz").read_bytes()).decode("ascii", "replace")
    logs: list[AsciiLog] = []
    for line in text.splitlines():
        head, _, rest = line.partition(";")
        header = head.split(",")
        log = header[0][1:].removesuffix("_2").removesuffix("A")
        if log not in wanted or head[0] not in "#%":
            continue
        status, week, seconds = ("", header[1], header[2]) if head[0] == "%" else (header[4], header[5], header[6])
        fields = next(csv.reader([rest.rpartition("*")[0]]))
        logs.append(AsciiLog(log, status, int(week), float(seconds), tuple(fields)))
    return logs
