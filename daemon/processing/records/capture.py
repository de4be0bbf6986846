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
from swath.daemon.processing.records.tables import timed_rows
from swath.daemon.processing.setup.models import geometry_of
from swath.drivers.captures.base import CaptureTally
from swath.drivers.captures.opening import read_pcap
from swath.drivers.driver import find_driver
from swath.drivers.parser import Parser
from swath.georef.arrays import FloatArray, StructArray
from swath.georef.points import Fate
from swath.georef.records import AIMED_RETURN_DTYPE, RETURN_DTYPE, ChunkBatch, Record, ScannerReturns
from swath.georef.scanner.beams import Geometry
from swath.georef.scanner.calibration import nominal
from swath.georef.scanner.sensor_model import SensorModel
from swath.georef.trajectory.trajectory import Trajectory

NAME = "head"
SOURCE = f"scanner/{NAME}"
_STILL_NS = np.array([0, 2], np.int64)
_AT_E = np.array([6_378_137.0, 0.0, 0.0])  # any place on the earth, for a body that does not turn
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


def places_s(
    rows: StructArray, geometry: Geometry, range_gate_m: tuple[float, float]
) -> tuple[FloatArray, StructArray]:
    """Return the places (m, 3) of returns in the scanner's frame s, m, and the m rows that have one.

    Args:
        rows: (n,) table of returns.
        geometry: of the head's beams.
        range_gate_m: smallest and largest range that is a return.
    """
    unsaid = np.full((2, 3), np.nan)
    still = Trajectory(
        _STILL_NS, np.stack([_AT_E] * 2), np.array([[1.0, 0, 0, 0]] * 2), np.zeros((2, 3)), unsaid, unsaid
    )
    model = SensorModel(nominal("s", (0.0, 0.0, 0.0), np.eye(3)), geometry, range_gate_m)
    rays = model.rays(_as_measured(rows), np.ones(len(rows), np.int64), still)
    placed = rays.fate == Fate.GEOREFERENCED
    return rays.points_e[placed] - _AT_E, rows[placed]


def _as_measured(table: StructArray) -> StructArray:
    """Return a table's rows without their times."""
    dtype = AIMED_RETURN_DTYPE if "elevation_rad" in (table.dtype.names or ()) else RETURN_DTYPE
    rows = np.zeros(len(table), dtype)
    for name in dtype.names or ():
        rows[name] = table[name]
    return rows
