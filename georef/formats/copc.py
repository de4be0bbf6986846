"""Write COPC 1.0: a LAZ file whose chunks are nodes of an octree, coarse ones first, so that viewers read a part.

A node holds a random share, about `NODE_POINTS`, of the points in its cube that no coarser node holds. The share
depends on a point's place in the order alone, so the same points give the same bytes. Points are spooled, sorted by
node into a second spool, and compressed node by node: memory holds a block of points and one node.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, BinaryIO

import lazrs
import numpy as np

from swath.georef.arrays import FloatArray, Int64Array, StructArray
from swath.georef.compiled import jit_cached
from swath.georef.formats.las import BLOCK, Clipped, LasSettings, PointPacker
from swath.georef.formats.las_header import POINT_FORMAT, LasHeader, encode_copc_info, encode_evlr, encode_vlr
from swath.georef.points import Points

NODE_POINTS = 65_536
ALL_OF = 1.5  # times that many: a node takes all remaining points, rather than leave a few to each of eight others
MAX_DEPTH = 10
SPACINGS = 128  # points along the edge of the root's cube, for the spacing in the header
READ_POINTS = 1 << 20
ENTRY_DTYPE = np.dtype([("key", "<i4", (4,)), ("offset", "<u8"), ("bytes", "<i4"), ("points", "<i4")])
_EVLR_HEAD_BYTES = 60
_AXIS_BITS = 16
_AXIS_MASK = (1 << _AXIS_BITS) - 1
_WEYL = np.uint64(0x9E3779B97F4A7C15)  # 2⁶⁴ / golden ratio: multiples of it fill the circle evenly


class CopcWriter:
    """Writes one COPC file.

    Args:
        stream: seekable, empty; the caller closes it.
        spools: two temporary files, opened for reading and writing, each as large as the points; the caller closes
            them.
        settings: of the run.
        strip: its number, which is the point source id.
    """

    def __init__(self, stream: BinaryIO, spools: tuple[BinaryIO, BinaryIO], settings: LasSettings, strip: int) -> None:
        self.header = settings.header(strip)
        self._packer = PointPacker(self.header, strip)
        self._stream = stream
        self._spool, self._sorted = spools
        self._laszip = lazrs.LazVlr.new_for_compression(POINT_FORMAT, self.header.dtype.itemsize - 30, True)
        self._first_s, self._last_s = np.inf, -np.inf

    @property
    def clipped(self) -> Clipped:
        """The counts of clipped values so far."""
        return self._packer.clipped

    def write(self, points: Points, *, scanner: int = 0, intensity_factor: float = 1.0, withheld: bool = False) -> None:
        """Append points; arguments and errors are those of `LasWriter.write`."""
        for first in range(0, len(points), BLOCK):
            records = self._packer.pack(
                points, first, scanner=scanner, intensity_factor=intensity_factor, withheld=withheld
            )
            self._first_s = min(self._first_s, float(records["gps_time"].min()))
            self._last_s = max(self._last_s, float(records["gps_time"].max()))
            self._spool.write(records.tobytes())

    def close(self) -> None:
        """Sort the points into nodes and write the file."""
        cube = _Cube.around(self.header)
        tree = _Tree.over(cube, self._blocks())
        nodes, counts = self._count_nodes(cube, tree)
        self._sort(cube, tree, nodes, counts)
        self._stream.write(self._encoded(cube, (0, 0)))
        entries = self._compress(nodes, counts)
        head = self.header
        self._stream.seek(0, 2)
        head.evlr_start, head.evlr_count = self._stream.tell(), 1
        self._stream.write(encode_evlr("copc", 1000, entries.tobytes(), "EPT hierarchy"))
        self._stream.seek(0)
        self._stream.write(self._encoded(cube, (head.evlr_start + _EVLR_HEAD_BYTES, entries.nbytes)))
        self._stream.seek(0, 2)

    def _encoded(self, cube: _Cube, hierarchy: tuple[int, int]) -> bytes:
        span = (self._first_s, self._last_s) if self.header.count else (0.0, 0.0)
        info = encode_copc_info(cube.low + cube.size / 2, cube.size / 2, cube.size / SPACINGS, hierarchy, span)
        return self.header.encode(self._laszip.record_data(), encode_vlr("copc", 1, info, "COPC info"), 1)

    def _blocks(self) -> Iterator[tuple[int, StructArray]]:
        """Yield records in the order in which they came, with the number of the first one."""
        self._spool.seek(0)
        dtype = self.header.dtype
        for first in range(0, self.header.count, READ_POINTS):
            yield first, np.frombuffer(self._spool.read(READ_POINTS * dtype.itemsize), dtype)

    def _count_nodes(self, cube: _Cube, tree: _Tree) -> tuple[Int64Array, Int64Array]:
        """Return nodes in the order of the file, and the number of points in each."""
        found = [np.unique(tree.nodes(cube, first, records), return_counts=True) for first, records in self._blocks()]
        return _summed(found)

    def _sort(self, cube: _Cube, tree: _Tree, nodes: Int64Array, counts: Int64Array) -> None:
        size = self.header.dtype.itemsize
        at = np.concatenate([[0], np.cumsum(counts)[:-1]]) if len(counts) else counts
        for first, records in self._blocks():
            node = tree.nodes(cube, first, records)
            order = np.argsort(node, kind="stable")
            ordered = records[order]
            present, starts, lengths = np.unique(node[order], return_index=True, return_counts=True)
            which = np.searchsorted(nodes, present)
            for place, start, length in zip(which.tolist(), starts.tolist(), lengths.tolist(), strict=True):
                self._sorted.seek(int(at[place]) * size)
                self._sorted.write(ordered[start : start + length].tobytes())
                at[place] += length

    def _compress(self, nodes: Int64Array, counts: Int64Array) -> StructArray:
        compressor: Any = lazrs.LasZipCompressor(self._stream, self._laszip)
        self._sorted.seek(0)
        for number, count in enumerate(counts.tolist()):
            if number:
                compressor.finish_current_chunk()
            compressor.compress_many(np.frombuffer(self._sorted.read(count * self.header.dtype.itemsize), np.uint8))
        compressor.done()
        points_at = len(self._encoded(_Cube.around(self.header), (0, 0)))
        self._stream.seek(points_at)
        table = lazrs.read_chunk_table(self._stream, self._laszip)
        entries = np.zeros(len(nodes), ENTRY_DTYPE)
        entries["key"] = np.stack(_unpacked(nodes), axis=1) if len(nodes) else np.zeros((0, 4))
        entries["points"] = counts
        entries["bytes"] = [size for _, size in table]
        entries["offset"] = points_at + 8 + np.cumsum(entries["bytes"].astype(np.int64)) - entries["bytes"]
        return entries


@dataclass(frozen=True)
class _Cube:
    """The root's cube in the units of the coordinate system, and the number of times it may be halved."""

    low: FloatArray
    size: float
    depth: int
    scale: FloatArray
    offset: FloatArray

    @classmethod
    def around(cls, header: LasHeader) -> _Cube:
        bounds = header.bounds
        size = float((bounds[1] - bounds[0]).max()) + 2.0 * float(header.scale.max())
        depth = math.ceil(math.log2(max(header.count / NODE_POINTS, 1.0)))  # enough where points lie along a line
        return cls(bounds[0] - header.scale, size, min(depth, MAX_DEPTH), header.scale, header.offset)

    def cells(self, records: StructArray) -> Int64Array:
        """Return (n,) the cell of the finest level that each record lies in."""
        cells = np.empty(len(records), np.int64)
        per_unit = (1 << self.depth) / self.size
        shift = (self.offset - self.low) * per_unit
        _fill_cells(records, self.scale * per_unit, shift, (1 << self.depth) - 1, cells)
        return cells


@dataclass(frozen=True)
class _Tree:
    """The share of each cell's points that every level takes.

    Attributes:
        cells: (k,) cells of the finest level that have points, rising.
        left: (k, depth + 1) share of their points that remains after a level and all above it have taken theirs.
    """

    cells: Int64Array
    left: FloatArray

    @classmethod
    def over(cls, cube: _Cube, blocks: Iterator[tuple[int, StructArray]]) -> _Tree:
        found = [np.unique(cube.cells(records), return_counts=True) for _, records in blocks]
        cells, counts = _summed(found)
        depth = cube.depth
        left = np.ones((len(cells), depth + 1))
        share = np.ones(len(cells))
        for level in range(depth + 1):
            _, which = np.unique(_coarser(cells, depth - level), return_inverse=True)
            waiting = np.bincount(which, counts * share)[which] if len(cells) else share
            taken = np.where(
                (waiting <= ALL_OF * NODE_POINTS) | (level == depth), 1.0, NODE_POINTS / np.maximum(waiting, 1.0)
            )
            share = share * (1.0 - taken)
            left[:, level] = share
        return cls(cells, left)

    def nodes(self, cube: _Cube, first: int, records: StructArray) -> Int64Array:
        """Return (n,) node of each record: level, x, y, z as bits of one number that rises in the order of the file."""
        nodes = np.empty(len(records), np.int64)
        _fill_nodes(cube.cells(records), first, self.cells, self.left, nodes)
        return nodes


@jit_cached
def _fill_cells(records: Any, per_unit: FloatArray, shift: FloatArray, most: int, cells: Int64Array) -> None:
    for i in range(len(records)):
        x = min(max(int(records[i].x * per_unit[0] + shift[0]), 0), most)
        y = min(max(int(records[i].y * per_unit[1] + shift[1]), 0), most)
        z = min(max(int(records[i].z * per_unit[2] + shift[2]), 0), most)
        cells[i] = x << 2 * _AXIS_BITS | y << _AXIS_BITS | z


@jit_cached
def _fill_nodes(cells: Int64Array, first: int, known: Int64Array, left: FloatArray, nodes: Int64Array) -> None:
    for i in range(len(cells)):
        draw = float((np.uint64(first + i) * _WEYL) >> np.uint64(11)) * 2.0**-53
        row, level = left[np.searchsorted(known, cells[i])], 0
        while draw < row[level]:
            level += 1
        up, cell = left.shape[1] - 1 - level, cells[i]
        x, y, z = cell >> 2 * _AXIS_BITS, cell >> _AXIS_BITS & _AXIS_MASK, cell & _AXIS_MASK
        nodes[i] = (((level << _AXIS_BITS | x >> up) << _AXIS_BITS) | y >> up) << _AXIS_BITS | z >> up


def _coarser(cells: Int64Array, levels: int) -> Int64Array:
    """Return the cells that contain the given ones, the given number of levels up."""
    x, y, z = (cells >> shift & _AXIS_MASK for shift in (2 * _AXIS_BITS, _AXIS_BITS, 0))
    coarse: Int64Array
    coarse = (x >> levels) << 2 * _AXIS_BITS | (y >> levels) << _AXIS_BITS | z >> levels
    return coarse


def _unpacked(nodes: Int64Array) -> list[Int64Array]:
    """Return level, x, y and z of nodes."""
    return [nodes >> shift * _AXIS_BITS & (_AXIS_MASK if shift < 3 else 15) for shift in (3, 2, 1, 0)]


def _summed(found: list[tuple[Int64Array, Int64Array]]) -> tuple[Int64Array, Int64Array]:
    """Return the numbers found, rising, and the total count of each."""
    if not found:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    numbers, which = np.unique(np.concatenate([one for one, _ in found]), return_inverse=True)
    counts = np.zeros(len(numbers), np.int64)
    np.add.at(counts, which, np.concatenate([count for _, count in found]))
    return numbers, counts
