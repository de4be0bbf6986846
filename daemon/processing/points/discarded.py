"""Writes returns that are left out of the products, if asked for.

Returns beyond the range gate become points that are flagged as withheld; those without a place are listed with their
known values.
"""

from __future__ import annotations

import gzip
from collections.abc import Callable
from copy import copy
from functools import partial
from pathlib import Path
from typing import BinaryIO

import numpy as np

from swath.georef.arrays import BoolArray, ByteArray, Int64Array, StructArray
from swath.georef.georeference import Georeferencer
from swath.georef.mapping.frame import MappingError
from swath.georef.points import FATE_NAMES, Fate, Points
from swath.georef.stream.stream import Stream
from swath.georef.trajectory.trajectory import Trajectory

LIFTED_GATE_M = (0.0, 100_000.0)  # smallest and largest values that range_min_m and range_max_m can have
BLOCK_ROWS = 1 << 15  # converted to text at once
COLUMNS = ("device_time_ns", "host_time_ns", "pulse_id", "return_number", "number_of_returns", "channel", "mta_zone")
HEAD = ",".join(["scanner", "reason", "gps_ns", *COLUMNS, "range_m", "encoder_deg", "intensity"])
GATED = (Fate.BELOW_RANGE_GATE, Fate.ABOVE_RANGE_GATE)


class DiscardedPoints:
    """Takes the returns that a stream leaves out, in the stream's own order.

    Args:
        path: path of the list, gzipped CSV; it is created with the first row.
        stream: a stream whose parsers are already connected.
        put: takes points beyond the gate, with the scanner's name.

    Attributes:
        withheld, rows: number of points given to ``put``, and of rows of the list.
    """

    def __init__(self, path: Path, stream: Stream, put: Callable[[str, Points], None]) -> None:
        self.withheld = self.rows = 0
        self._path, self._put = path, put
        self._raw: BinaryIO | None = None
        self._text: gzip.GzipFile | None = None
        for name in stream.scanners:
            chain = stream.chain(name)
            assert isinstance(chain.georeferencer, Georeferencer)
            chain.left_out = partial(self._take, name, without_gate(chain.georeferencer))

    def close(self) -> None:
        """Finish and close the list."""
        for file in (self._text, self._raw):
            if file is not None:
                file.close()

    def _take(
        self,
        name: str,
        ungated: Georeferencer,
        rows: StructArray,
        time_ns: Int64Array,
        fates: ByteArray,
        trajectory: Trajectory | None,
    ) -> None:
        if trajectory is not None and np.isin(fates, GATED).any():
            placed = self._placed(name, ungated, rows, time_ns, trajectory)
            rows, time_ns, fates = rows[~placed], time_ns[~placed], fates[~placed]
        for first in range(0, len(rows), BLOCK_ROWS):
            block = slice(first, first + BLOCK_ROWS)
            self._list(name, rows[block], time_ns[block], fates[block])

    def _placed(
        self, name: str, ungated: Georeferencer, rows: StructArray, time_ns: Int64Array, trajectory: Trajectory
    ) -> BoolArray:
        """Put the rows that have a place; return flags (n,) of these."""
        try:
            points, fates = ungated.georeference(rows, time_ns, trajectory)
        except MappingError:  # the map has no place for any of them
            return np.zeros(len(rows), np.bool_)
        if len(points):
            self._put(name, points)
            self.withheld += len(points)
        there: BoolArray = fates == Fate.GEOREFERENCED
        return there

    def _list(self, name: str, rows: StructArray, time_ns: Int64Array, fates: ByteArray) -> None:
        reasons = [FATE_NAMES[Fate(fate)] for fate in fates.tolist()]
        times = ["" if time < 0 else str(time) for time in time_ns.tolist()]
        whole = [rows[column].tolist() for column in COLUMNS]
        measured = [rows["range_m"].tolist(), np.degrees(rows["encoder_rad"]).tolist(), rows["intensity"].tolist()]
        line = f"{name},{{}},{{}}{',{}' * len(whole)},{{:.4f}},{{:.6f}},{{:g}}\n".format
        self._file().write("".join(map(line, reasons, times, *whole, *measured)).encode())
        self.rows += len(rows)

    def _file(self) -> gzip.GzipFile:
        if self._text is None:
            self._raw = self._path.open("xb")
            self._text = gzip.GzipFile(
                "", "wb", fileobj=self._raw, mtime=0
            )  # without name and time: same rows, same bytes
            self._text.write(f"{HEAD}\n".encode())
        return self._text


def without_gate(gated: Georeferencer) -> Georeferencer:
    """Return a copy of a georeferencer whose range gate is lifted."""
    made = copy(gated)
    made.model = copy(gated.model)
    made.model.range_gate = LIFTED_GATE_M
    return made
