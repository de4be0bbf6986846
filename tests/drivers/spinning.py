"""Runs recordings through the parsers of spinning heads and compares their points with other decoders' clouds."""

from __future__ import annotations

import gzip
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from swath.drivers.captures.opening import read_pcap
from swath.drivers.scanner.beams import BeamTable, beam_points
from swath.georef.arrays import BoolArray, Int64Array, StructArray
from tests.drivers.recordings import FIXTURES

Points = NDArray[np.float64]


def payloads(path: str) -> list[bytes]:
    """Return datagrams of a capture in ``fixtures/``."""
    return [unit.data for unit in read_pcap(FIXTURES / path)]


def ros_points(rows: StructArray, beams: BeamTable) -> Points:
    """Return points (n, 3), m, in the frame of ROS decoders: x forward, y left."""
    x, y, z = beam_points(rows, beams).T
    return np.stack([y, -x, z], axis=1)


def xyz(points: StructArray) -> Points:
    """Return (n, 3) of records with the fields x, y, z."""
    return np.stack([points["x"], points["y"], points["z"]], axis=1).astype(np.float64)


def read_pcd(path: Path, dtype: np.dtype[np.void]) -> StructArray:
    """Return the points of a gzipped binary PCD file."""
    data = gzip.decompress(path.read_bytes())
    start = data.index(b"DATA binary\n") + len(b"DATA binary\n")
    return np.frombuffer(data[start:], dtype=dtype)


def are_near(points: Points, others: Points, cell_m: float) -> BoolArray:
    """Return (n,) True where another point is within half a cell on each axis; never True beyond 1.5 cells."""

    def keys(cells: Points) -> Int64Array:
        x, y, z = (cells.astype(np.int64) + (1 << 20)).T
        keyed: Int64Array = (x << 42) + (y << 21) + z
        return keyed

    there = keys(np.floor(others / cell_m))
    near = np.zeros(len(points), dtype=np.bool_)
    for shift in product((-0.5, 0.5), repeat=3):
        near |= np.isin(keys(np.floor(points / cell_m + np.array(shift))), there)
    return near
