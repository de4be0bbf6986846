"""Parsers, recordings and counts of messages that tests of several drivers use."""

from __future__ import annotations

import gzip
import re
from collections import Counter
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from swath.drivers.can_frames import encode_can_frame
from swath.drivers.gnss.novatel.parser import NovatelParser
from swath.drivers.parser import DeviceSettings, Parser
from swath.georef.arrays import StructArray
from swath.georef.records import (
    Chunk,
    ChunkBatch,
    DeviceClockSamples,
    ImuSamples,
    InsSolution,
    Record,
    ScannerReturns,
    TimeMessage,
)

# Other libraries count these messages differently. pynmeagps joins some makers' first field to the address (PFEC,GPatt)
# and refuses sentences with a good checksum that it does not know or whose fields it cannot convert (FOO, PTNTA cut
# into a GPGSV, RMC with a wrong speed, polls without fields). Swath names UBX configuration and aiding by number.
UNCOUNTED_BY_OTHERS = {
    "furuno_nmea.log": {"PFEC": 2},
    "isync.log": {"PTNTA": 1},
    "pygpsdata-nmeafoo1.log": {"FOO": 1},
    "pygpsdata-nmeafoo2.log": {"FOO": 1, "RMC": 1},
    "quectel_nmea_poll.log": {"PQTMCFGMSGRATE": 1, "PQTMSN": 1},
}
NAMED_BY_NUMBER = ("CFG-", "MGA-", "MON-0a32", "MON-BATCH", "PFEC")


def name_here(theirs: str) -> str:
    """Return our name of a message in expected.json."""
    protocol, _, name = theirs.partition(":")
    if protocol == "RTCM3":
        return "RTCM" + name.split("_")[0]
    return name[2:] if protocol == "NMEA" and not name.startswith("P") and len(name) == 5 else name


def comparable(messages: Mapping[str, int]) -> dict[str, int]:
    """Return the messages that have the same name in both decoders."""
    return {name: count for name, count in messages.items() if count and not name.startswith(NAMED_BY_NUMBER)}


def others_messages(name: str, entry: Mapping[str, Any]) -> dict[str, int]:
    """Return the messages that another decoder found, under our names."""
    theirs: Counter[str] = Counter(UNCOUNTED_BY_OTHERS.get(name, {}))
    for message, count in entry["messages"].items():
        theirs[name_here(message)] += count
    return comparable(theirs)


HOST_NS = 1_700_000_000_000_000_000
RecordT = TypeVar("RecordT")
NOVATEL_SPAN = "propak6-basic-fix.gps"
NOVATEL_COUNTS = {  # by an existing decoder and by checksum
    "oemv_200911218.gps": {
        "TRACKSTAT": 50,
        "BESTPOS": 49,
        "SATVIS": 49,
        "RANGECMP": 46,
        "NOVATEL-287": 90,
        "RAWEPHEM": 25,
        "GLOEPHEMERIS": 8,
    },
    "bestpos-bestvel-psrdop2-sync.gps": {"PSRDOP2": 33, "BESTPOS": 33, "BESTVEL": 33},
    NOVATEL_SPAN: {"CORRIMUDATA": 1988, "INSCOV": 1988, "INSPVAX": 1988, "BESTPOS": 2187, "BESTXYZ": 1988},
    "align.gps": {"HEADING2": 12},
    "bestpos.gps": {"INSPVAS": 10, "BESTPOS": 5, "BESTVEL": 5, "PSRDOP2": 2, "INSPVAX": 2, "BESTUTM": 2},
    "ins1.gps": {"INSPVAS": 243, "INSSTDEV": 29, "CORRIMUS": 10, "INSCONFIG": 2},
    "rxstatus.gps": {"RXSTATUS": 3},
    "time.gps": {"TIME": 6},
    "unit_test_vectors.bin": {
        "BESTPOS": 8,
        "RAWIMUSX": 4,
        "LOGLIST": 3,
        "SOURCETABLE": 1,
        "VERSION": 2,
        "PROFILEINFO": 1,
        "PORTSTATS": 1,
        "PSRDOP": 1,
        "VALIDMODELS": 1,
        "SETNAV-response": 2,
        "UALCONTROL": 1,
        "TRACKSTAT": 2,
        "BESTSATS": 1,
        "RAWGPSSUBFRAME": 1,
        "BESTUTM": 1,
        "INSPVA": 1,
        "INSPVAS": 1,
        "CONFIGCODE": 1,
        "RXCONFIG": 2,
    },
}


def make_novatel() -> NovatelParser:
    """Return a parser of every message."""
    return NovatelParser(DeviceSettings("gnss/rover"))


def parse_novatel(data: bytes, parser: NovatelParser | None = None) -> list[Record]:
    """Return all records of a recording."""
    parser = parser or make_novatel()
    return [*parser.feed(Chunk("gnss/rover", HOST_NS, data)), *parser.close()]


def of_type(records: list[Record], kind: type[RecordT], message: str = "") -> list[RecordT]:
    """Return the records of one type, optionally of one message."""
    return [r for r in records if isinstance(r, kind) and (not message or getattr(r, "message", "") == message)]


def rows_of(records: list[Record], kind: type[InsSolution] | type[ImuSamples]) -> StructArray:
    """Return all rows of one type."""
    return np.concatenate([record.rows for record in records if isinstance(record, kind)])


NMEA2000_FIXTURES = Path(__file__).parents[2] / "fixtures/nmea2000"
NMEA2000_COUNTS = {  # messages of all sources: nmea2000 2026.10.3 (PyPI)
    "can0-2_candump.log.gz": {
        "126992": 177,
        "127250": 1786,
        "127251": 2383,
        "127252": 595,
        "127257": 1906,
        "129025": 1639,
        "129026": 1390,
        "129029": 356,
        "129539": 356,
    },
    "candumpSample2.txt.gz": {
        "129026": 46,
        "129025": 46,
        "127250": 46,
        "127251": 46,
        "129029": 5,
        "129539": 5,
        "126992": 5,
        "127257": 5,
    },
    "candumpSample3.txt.gz": {"127250": 175, "127251": 175, "127257": 175, "129025": 165, "129026": 66},
}
CANDUMP_LINE = re.compile(r"([0-9A-F]{8})(?:#([0-9A-F]*)|\s+\[\d\]\s+([0-9A-F ]+))\s*$")


@cache
def nmea2000_bus(name: str) -> tuple[bytes, ...]:
    """Return all frames with 29-bit identifiers of a recording in either format of candump."""
    with gzip.open(NMEA2000_FIXTURES / name, "rt") as file:
        found = [match for line in file if (match := CANDUMP_LINE.search(line))]
    return tuple(
        encode_can_frame(int(identifier, 16), bytes.fromhex(compact or spaced or ""), extended=True)
        for identifier, compact, spaced in (match.groups() for match in found)
    )


def feed(parser: Parser, units: list[bytes]) -> list[Record]:
    """Parse units, one millisecond apart; consecutive ones of equal length form a batch."""
    records: list[Record] = []
    at = 0
    while at < len(units):
        stop = at + 1
        while stop < len(units) and len(units[stop]) == len(units[at]):
            stop += 1
        rows = np.frombuffer(b"".join(units[at:stop]), dtype=np.uint8).reshape(stop - at, -1)
        records += parser.feed_batch(ChunkBatch("", np.arange(at, stop, dtype=np.int64) * 1_000_000, rows))
        at = stop
    return records


def returns_of(records: list[Record]) -> StructArray:
    """Return all returns, in order."""
    return np.concatenate([record.rows for record in records if isinstance(record, ScannerReturns)])


def clock_of(records: list[Record]) -> StructArray:
    """Return all clock samples, in order."""
    return np.concatenate([record.rows for record in records if isinstance(record, DeviceClockSamples)])


def times(records: list[Record]) -> list[TimeMessage]:
    """Return the time messages among records."""
    return [record for record in records if isinstance(record, TimeMessage)]
