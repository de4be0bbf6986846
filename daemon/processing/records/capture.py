"""Reads a scanner's returns from a network capture, without a log: with the head's own times only."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from swath.daemon.config.config import Config
from swath.daemon.config.load import validate
from swath.daemon.errors import UserError
from swath.daemon.processing.points.runs import Run
from swath.daemon.processing.records.places import places_s
from swath.daemon.processing.records.tables import timed_rows
from swath.daemon.processing.setup.models import geometry_of
from swath.drivers.captures.base import CaptureTally
from swath.drivers.captures.opening import read_pcap
from swath.drivers.driver import find_driver
from swath.drivers.parser import Parser
from swath.georef.arrays import FloatArray, StructArray
from swath.georef.records import ChunkBatch, Record, ScannerReturns

NAME = "head"
SOURCE = f"scanner/{NAME}"
_ANY_WIRE = "udp:0.0.0.0:2368"  # what a table needs; nothing is opened


class CapturedScanner:
    """A scanner's datagrams in a pcap or pcapng file.

    Args:
        path: the file, possibly gzipped.
        protocol: as in a configuration.
        port: UDP port of its returns; None: the one that most bytes went to.
        options: other keys of ``[scanner.<name>]``, such as ``geometry`` or ``calibration``.

    Attributes:
        tally: damage of the file and packets left out, of the last reading.

    Raises:
        UserError: the protocol or an option is invalid, one line each.
        TransportError: the file is not a capture.
    """

    def __init__(self, path: Path, protocol: str, port: int | None, options: Mapping[str, Any]) -> None:
        table = {"transport": _ANY_WIRE, "installation": np.eye(3).tolist(), **options, "protocol": protocol}
        self._config: Config = validate(
            {"session": {"name": "capture", "directory": "."}, "scanner": {NAME: table}}, Path("swath.read_pcap"), ""
        )
        self.path, self._port = path, port
        self.tally = CaptureTally()
        self._parser = self._new_parser()  # wrong settings are reported now

    @property
    def errors(self) -> dict[str, int]:
        """Counts of what could not be decoded in the last reading, by error code."""
        return dict(self._parser.counters.errors)

    @cached_property
    def port(self) -> int:
        """The UDP port whose datagrams are read.

        Raises:
            UserError: the capture holds no datagram.
        """
        if self._port is not None:
            return self._port
        sizes: Counter[int] = Counter()
        for unit in read_pcap(self.path, tally=CaptureTally()):
            if unit.destination is not None:
                sizes[unit.destination[1]] += len(unit.data)
        if not sizes:
            raise UserError(f"{self.path}: holds no UDP datagram")
        return sizes.most_common(1)[0][0]

    def returns(self) -> Iterator[StructArray]:
        """Yield tables of returns, without GPS times, in order; memory is bounded."""
        self._parser, self.tally = self._new_parser(), CaptureTally()
        found: list[Record] = []
        run = Run(lambda batches: found.extend(self._parser.feed_batches(batches)))
        for unit in read_pcap(self.path, self.port, self.tally):
            row = np.frombuffer(unit.data, np.uint8).reshape(1, -1)
            run.add(ChunkBatch(SOURCE, np.array([unit.time_ns], np.int64), row))
            yield from _tables(found)
        run.flush()
        yield from _tables(found)
        yield from _tables(self._parser.close())

    def places(self) -> Iterator[tuple[FloatArray, StructArray]]:
        """Yield places (n, 3) in the scanner's frame, m, with the returns (n,) that have them.

        Raises:
            UserError: the protocol has no geometry that is known.
        """
        table = self._config.scanner[NAME]
        for rows in self.returns():
            try:
                geometry = geometry_of(table, self._parser)
            except ValueError as error:
                raise UserError(f"{self.path}: {error}") from error
            yield places_s(rows, geometry, (table.range_min_m, table.range_max_m))

    def _new_parser(self) -> Parser:
        table = self._config.scanner[NAME]
        driver = find_driver("scanner", table.protocol)
        return driver.make_parser(self._config.settings_of("scanner", NAME, table))


def _tables(records: list[Record]) -> Iterator[StructArray]:
    """Yield the tables of returns among records, and forget the records."""
    tables = [timed_rows(record.rows) for record in records if isinstance(record, ScannerReturns) and len(record.rows)]
    records.clear()
    yield from tables
