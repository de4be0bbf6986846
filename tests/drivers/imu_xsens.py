"""Recordings of an Xsens unit with another library's decoding, and a parser that reads bytes to the end."""

from __future__ import annotations

import gzip
from functools import cache
from typing import Any

from swath.drivers.imu.xsens_xbus import wire as xbus
from swath.drivers.imu.xsens_xbus.parser import XbusParser
from swath.drivers.parser import DeviceSettings
from swath.georef.records import Record
from tests.drivers.harness import feed_pieces
from tests.drivers.recordings import FIXTURES

NAMES = ("1_output", "2_output")
FORMATS = (xbus.FLOAT32, xbus.FP1220, xbus.FP1632, xbus.FLOAT64)

Block = dict[str, list[str]]


@cache
def recording(name: str) -> bytes:
    return gzip.decompress((FIXTURES / f"xsens/{name}.bin.gz").read_bytes())


@cache
def decoded(name: str) -> list[Block]:
    """Return xsens-go's decoding: one block per message, with the lines below each item's name."""
    text = gzip.decompress((FIXTURES / f"xsens/{name}.golden.gz").read_bytes()).decode()
    blocks = []
    for part in text.strip().split("\n\n"):
        block: Block = {}
        for line in part.splitlines():
            if line.startswith("  "):
                block[list(block)[-1]].append(line.strip())
            else:
                block[line.partition("(")[0].rstrip(":")] = []
        blocks.append(block)
    return blocks


def vector(block: Block, item: str) -> list[float]:
    """Return the numbers of an item, ``X:…`` or ``Q0:…``."""
    return [float(line.partition(":")[2]) for line in block[item]]


def make(**config: Any) -> XbusParser:
    return XbusParser(DeviceSettings("imu/main", config))


def parse(*pieces: bytes, **config: Any) -> tuple[list[Record], XbusParser]:
    """Parse the pieces to the end; return records and parser."""
    parser = make(**config)
    return feed_pieces(parser, pieces), parser
