"""Find cells without a point inside the area to be covered, and how much of it is dense enough."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from swath.daemon.processing.live.tiles import SIDE, Place
from swath.georef.arrays import BoolArray, ByteArray, FloatArray, Int64Array, StructArray

BLOCK_M = 8.0  # side of the squares, or the next power of two of cells, over which density is judged
MOST_THIN = 0.01  # of cells that may be empty between two that are not, for each that is not; then cells are joined
MOST_CELLS = 8_000_000  # of a map whose gaps are looked for; cells of a larger one are joined
REACH_M = 25.0  # without an area, gaps are what lies between points no farther apart
MOST_OPEN = 0.1  # of a gap's edge without points, there; a corner between two swaths that cross has more
MOST_DEPTHS = 250_000
POINTS, NO_RETURN = 0, 1  # bits of a tile that are kept
SAMPLE = 60  # cells of a gap whose place is looked at
BESIDE = ndimage.generate_binary_structure(2, 2)  # cells that touch at a corner belong together


@dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """Holds cells of the ground with and without points; rows run from south to north.

    Attributes:
        west_m, south_m: edges, in the frame ``local``.
        cell_m: side of a cell.
        covered: (rows, columns) True where there is a point.
        water: (rows, columns) True where there is none, but pulses came whose echo did not return.
        block: cells along a side of a block.
        pulses: (rows / block, columns / block) first returns of a block.
    """

    west_m: float
    south_m: float
    cell_m: float
    covered: BoolArray
    water: BoolArray
    block: int
    pulses: FloatArray

    def centres_m(self, rows: Int64Array, columns: Int64Array) -> FloatArray:
        """Return east and north (n, 2) of cells' centres."""
        east, north = self.west_m + (columns + 0.5) * self.cell_m, self.south_m + (rows + 0.5) * self.cell_m
        return np.stack([east, north], axis=-1)


@dataclass(frozen=True, slots=True, eq=False)
class Gap:
    """Joined cells without a point.

    Attributes:
        area_m2: size.
        width_m: of the largest circle in it, to a cell; of a gap of more than a quarter million cells, to 1/250 of it.
        length_m: of the rectangle's diagonal around it.
        place_m: (2,) east and north of that circle's centre.
        sample_m: (n, 2) east and north of some of its cells, spread over it.
    """

    area_m2: float
    width_m: float
    length_m: float
    place_m: FloatArray
    sample_m: FloatArray


class Painted:
    """Keeps what the map's tiles say in a few bits a cell, so that a look at a large area takes no time."""

    def __init__(self) -> None:
        self._cell_m = 0.0
        self._tiles: dict[Place, tuple[ByteArray, FloatArray]] = {}

    def take(self, cell_m: float, tiles: Iterable[tuple[Place, StructArray]]) -> None:
        """Take the cells (`SIDE`, `SIDE`) of tiles that have changed; of wider cells, all tiles."""
        if cell_m != self._cell_m:
            self._tiles.clear()
            self._cell_m = cell_m
        block = self.block
        for place, cells in tiles:
            sums = cells["pulses"].reshape(SIDE // block, block, SIDE // block, block).sum(axis=(1, 3), dtype=float)
            self._tiles[place] = np.packbits([cells["points"] > 0, cells["no_return"] > 0], axis=2), sums

    @property
    def block(self) -> int:
        """Cells along a side of a block."""
        block = 1
        while block < SIDE and block * self._cell_m < BLOCK_M:
            block *= 2
        return block

    @property
    def has_points(self) -> bool:
        """True if there is a tile."""
        return bool(self._tiles)

    def edges_m(self) -> FloatArray | None:
        """Return west, south, east, north of all tiles (4,); None: there are none."""
        if not self._tiles:
            return None
        places = np.array(list(self._tiles))
        edges: FloatArray = np.concatenate([places.min(axis=0), places.max(axis=0) + 1]) * (SIDE * self._cell_m)
        return edges

    def ground(self, edges_m: FloatArray) -> Ground:
        """Return the cells of whole tiles around edges (4,): west, south, east, north.

        They are the map's, or joined ones so wide that hardly any is empty for lack of pulses alone.
        """
        side_m = SIDE * self._cell_m
        west, south = np.floor(edges_m[:2] / side_m).astype(int).tolist()
        east, north = np.maximum(np.ceil(edges_m[2:] / side_m).astype(int), (west + 1, south + 1)).tolist()
        join = 1
        while join < SIDE and (east - west) * (north - south) * (SIDE // join) ** 2 > MOST_CELLS:
            join *= 2
        covered, mute = (self._cells((west, south, east, north), join, kind) for kind in (POINTS, NO_RETURN))
        while join < SIDE and _thin_share(covered | mute) > MOST_THIN:
            join *= 2
            covered, mute = _joined(covered), _joined(mute)
        block = max(join, self.block)
        pulses = self._pulses((west, south, east, north), block)
        return Ground(
            west * side_m, south * side_m, join * self._cell_m, covered, mute & ~covered, block // join, pulses
        )

    def _cells(self, edges: tuple[int, int, int, int], join: int, kind: int) -> BoolArray:
        """Return cells between edges, in tiles, ``join`` of the map's along a side.

        True: has a point (`POINTS`), or a pulse without an echo (`NO_RETURN`).
        """
        west, south, east, north = edges
        side = SIDE // join
        covered = np.zeros(((north - south) * side, (east - west) * side), np.bool_)
        for (column, row), (bits, _) in self._tiles.items():
            if west <= column < east and south <= row < north:
                cells: BoolArray = np.unpackbits(bits[kind], axis=1).view(np.bool_)
                for _ in range(join.bit_length() - 1):  # a power of two
                    cells = _joined(cells)
                up, across = (row - south) * side, (column - west) * side
                covered[up : up + side, across : across + side] = cells
        return covered

    def _pulses(self, edges: tuple[int, int, int, int], block: int) -> FloatArray:
        """Return first returns of blocks between edges, in tiles."""
        west, south, east, north = edges
        side, within = SIDE // block, block // self.block
        pulses = np.zeros(((north - south) * side, (east - west) * side))
        for (column, row), (_, sums) in self._tiles.items():
            if west <= column < east and south <= row < north:
                up, across = (row - south) * side, (column - west) * side
                joined = sums.reshape(side, within, side, within).sum(axis=(1, 3))
                pulses[up : up + side, across : across + side] = joined
        return pulses


def _joined(covered: BoolArray) -> BoolArray:
    """Return cells joined four to one."""
    pairs = covered[0::2] | covered[1::2]
    found: BoolArray = pairs[:, 0::2] | pairs[:, 1::2]
    return found


def _thin_share(covered: BoolArray) -> float:
    """Return the number of empty cells just between two covered ones, in a row or column, over that of the covered."""
    empty = ~covered[1:-1, 1:-1]
    row, column = covered[1:-1, :-2] & covered[1:-1, 2:], covered[:-2, 1:-1] & covered[2:, 1:-1]
    return float((empty & (row | column)).sum()) / max(1.0, float(covered.sum()))


def inside(ground: Ground, polygons: Sequence[Sequence[FloatArray]]) -> BoolArray:
    """Return the cells (rows, columns) whose centres lie in polygons of rings (n, 2), east and north, metres.

    Rings after a polygon's first one are holes.
    """
    found = np.zeros(ground.covered.shape, np.bool_)
    for rings in polygons:
        found |= _even_odd(ground, rings)
    return found


def _even_odd(ground: Ground, rings: Sequence[FloatArray]) -> BoolArray:
    """Return the cells that an odd number of edges lies west of."""
    rows, columns = ground.covered.shape
    toggles = np.zeros((rows, columns + 1), np.uint8)
    for ring in rings:
        cells = (ring - (ground.west_m, ground.south_m)) / ground.cell_m - 0.5  # centres have whole numbers
        for (x0, y0), (x1, y1) in zip(cells.tolist(), np.roll(cells, -1, axis=0).tolist(), strict=True):
            low, high = sorted((y0, y1))
            across = np.arange(max(0, int(np.ceil(low))), min(rows, int(np.ceil(high))))
            if len(across):
                x = x0 + (across - y0) * (x1 - x0) / (y1 - y0)
                np.bitwise_xor.at(toggles, (across, np.clip(np.ceil(x), 0, columns).astype(np.int64)), 1)
    odd: BoolArray = np.bitwise_xor.accumulate(toggles[:, :-1], axis=1).view(np.bool_)
    return odd


def between(ground: Ground) -> BoolArray:
    """Return the cells with points, and those that lie between points no more than `REACH_M` apart."""
    margin = int(np.ceil(REACH_M / ground.cell_m)) + 1
    covered = np.pad(ground.covered, margin)
    reach = REACH_M / 2.0 / ground.cell_m
    if not covered.any():
        return ground.covered
    near = ndimage.distance_transform_edt(~covered) <= reach
    closed = ndimage.distance_transform_edt(near) > reach
    labels, _ = ndimage.label(closed & ~covered, BESIDE)
    for number, box in enumerate(ndimage.find_objects(labels), 1):
        around = tuple(slice(max(0, one.start - 1), one.stop + 1) for one in box)
        mine = labels[around] == number
        ring = ndimage.binary_dilation(mine, BESIDE) & ~mine
        if (ring & ~covered[around]).sum() > MOST_OPEN * ring.sum():
            closed[around] &= ~mine
    found: BoolArray = (closed | covered)[margin:-margin, margin:-margin]
    return found


def gaps_of(ground: Ground, wanted: BoolArray, least_m2: float) -> list[Gap]:
    """Return the gaps in the wanted cells (rows, columns), of at least a size, the largest first; water is none."""
    return joined_cells(ground, wanted & ~ground.covered & ~ground.water, least_m2)


def joined_cells(ground: Ground, mask: BoolArray, least_m2: float) -> list[Gap]:
    """Return what masked cells (rows, columns) form that touch each other, of at least a size, the largest first."""
    labels, count = ndimage.label(mask, BESIDE)
    if not count:
        return []
    sizes = np.bincount(labels.ravel())[1:] * ground.cell_m**2
    boxes = ndimage.find_objects(labels)
    large = np.flatnonzero(sizes >= least_m2)
    return [
        _gap(ground, labels[boxes[at]] == at + 1, boxes[at], float(sizes[at]))
        for at in large[np.argsort(-sizes[large], kind="stable")].tolist()
    ]


def _gap(ground: Ground, mask: BoolArray, box: tuple[slice, slice], area_m2: float) -> Gap:
    every = max(1, int(np.sqrt(mask.size / MOST_DEPTHS)))  # a large gap is measured in coarser steps
    depth = every * ndimage.distance_transform_edt(np.pad(mask[::every, ::every], 1))[1:-1, 1:-1]
    deepest = every * np.array(np.unravel_index(int(np.argmax(depth)), depth.shape))
    rows, columns = np.nonzero(mask)
    step = max(1, len(rows) // SAMPLE)
    origin = np.array([box[0].start, box[1].start])
    place = ground.centres_m(*(deepest + origin)[:, np.newaxis])
    sample = ground.centres_m(rows[::step] + origin[0], columns[::step] + origin[1])
    width_m = (2.0 * float(depth.max()) - every) * ground.cell_m
    return Gap(area_m2, width_m, float(np.hypot(*mask.shape)) * ground.cell_m, place[0], sample)


def densities(ground: Ground, wanted: BoolArray) -> FloatArray:
    """Return first returns on a square metre (n,) of the blocks that lie in the wanted cells and are covered wholly."""
    block = ground.block
    whole = wanted & ground.covered
    for _ in range(block.bit_length() - 1):  # a power of two
        whole = ~_joined(~whole)
    size_m2 = (block * ground.cell_m) ** 2
    found: FloatArray = ground.pulses[whole] / size_m2
    return found
