"""Find cells in which strips overlap, and collect the returns that strips have in them.

Strips are read block by block, from memory, mapped files or LAZ, so that only the returns in chosen cells are kept.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from swath.calib.flight import Swath
from swath.georef.arrays import BoolArray, FloatArray, Int64Array

BLOCK = 1_000_000  # returns that are processed at a time
RETURNS_A_CELL = 16.0
FINEST_CELL_M, COARSEST_CELL_M = 0.5, 20.0
DENSITY_BLOCKS, DENSITY_CELL_M = 2, 5.0  # blocks and cells from which a strip's density is estimated


@dataclass(frozen=True, slots=True)
class StripRules:
    """Rules for the cells and planes of a comparison.

    Attributes:
        cell_m: side of a cell; None: a size that contains `RETURNS_A_CELL` of the thinnest strip.
        most_cells: greatest number of cells, spread over the whole overlap.
        fewest: least number of returns of a plane.
        roughest_m: greatest √λ0 of a plane.
        steepest_deg: greatest slope of a plane.
    """

    cell_m: float | None = None
    most_cells: int = 20_000
    fewest: int = 6
    roughest_m: float = 0.06
    steepest_deg: float = 45.0


@dataclass(frozen=True, eq=False)
class StripBlock:
    """Some returns of a strip.

    Attributes:
        points: (n, 3) metres.
        time_ns: (n,) GPS times.
        single: (n,) whether each is its pulse's only return.
        direction: (n,) the scan's direction there: +1 towards positive angles, −1, 0: not known.
    """

    points: FloatArray
    time_ns: Int64Array
    single: BoolArray
    direction: NDArray[np.int8]


class Strip(Protocol):
    """A strip that can be read block by block, more than once."""

    @property
    def name(self) -> str:
        """Name for display."""

    def blocks(self) -> Iterator[StripBlock]:
        """Yield all returns in blocks; the points are the same every time."""


@dataclass(frozen=True)
class FlightStrip:
    """A swath of a flight as a strip."""

    swath: Swath

    @property
    def name(self) -> str:
        """Name of the swath."""
        return self.swath.name

    def blocks(self) -> Iterator[StripBlock]:
        """Yield all returns in blocks."""
        swath = self.swath
        for begin in range(0, len(swath), BLOCK):
            rows = slice(begin, begin + BLOCK)
            single = np.asarray(swath.rows["number_of_returns"][rows] <= 1)
            rate = np.zeros(len(single)) if swath.encoder_rate is None else swath.encoder_rate[rows]
            yield StripBlock(
                np.asarray(swath.points_t[rows]), swath.time_ns[rows], single, np.sign(rate).astype(np.int8)
            )


@dataclass(frozen=True, eq=False)
class Cells:
    """Cells of the overlap: their side, their rising numbers (n,) (see `numbers_of`), and the origin (east, north)."""

    cell_m: float
    numbers: Int64Array
    origin: tuple[float, float] = (0.0, 0.0)


def numbers_of(points: FloatArray, cell_m: float, origin: tuple[float, float] = (0.0, 0.0)) -> Int64Array:
    """Return the number (n,) of the cell of each place (n, ≥ 2); it combines the cell's row and column."""
    east, north = (np.floor((points[:, axis] - origin[axis]) / cell_m).astype(np.int64) for axis in (0, 1))
    return np.asarray((north << 32) + east, np.int64)


def overlap_cells(strips: Sequence[Strip], rules: StripRules) -> Cells:
    """Return the cells in which two strips or more have returns, thinned evenly to ``most_cells``."""
    fine = rules.cell_m or _cell_for(strips)
    found = [_occupied(strip, fine) for strip in strips]
    numbers, strips_there = np.unique(np.concatenate([*found, np.zeros(0, np.int64)]), return_counts=True)
    return thinned(Cells(fine, numbers[strips_there > 1]), rules)


def thinned(cells: Cells, rules: StripRules) -> Cells:
    """Draw at most ``most_cells`` cells evenly; the same ones every time."""
    if len(cells.numbers) <= rules.most_cells:
        return cells
    chosen = np.random.default_rng(19159).choice(len(cells.numbers), rules.most_cells, replace=False)
    return Cells(cells.cell_m, cells.numbers[np.sort(chosen)], cells.origin)


def _occupied(strip: Strip, cell_m: float) -> Int64Array:
    found = [np.unique(numbers_of(_singles(block).points, cell_m)) for block in strip.blocks()]
    return np.unique(np.concatenate([*found, np.zeros(0, np.int64)]))


def _cell_for(strips: Sequence[Strip]) -> float:
    """Return a cell side that gives enough returns of the thinnest strip.

    The density of a strip follows from the coarse cells that it covers.
    """
    densities = [_density(strip) for strip in strips]
    least = min((one for one in densities if one > 0.0), default=4.0)
    return float(np.clip(math.sqrt(RETURNS_A_CELL / least), FINEST_CELL_M, COARSEST_CELL_M))


def _density(strip: Strip) -> float:
    """Return the density of single returns per square metre: the median of covered cells at the strip's beginning."""
    side_m = DENSITY_CELL_M
    numbers = [numbers_of(_singles(block).points, side_m) for block in islice(strip.blocks(), DENSITY_BLOCKS)]
    counts = np.unique(np.concatenate([*numbers, np.zeros(0, np.int64)]), return_counts=True)[1]
    return float(np.median(counts)) / side_m**2 if len(counts) else 0.0


def _singles(block: StripBlock) -> StripBlock:
    kept = block.single & np.isfinite(block.points).all(axis=1)
    return StripBlock(block.points[kept], block.time_ns[kept], block.single[kept], block.direction[kept])


# ---------------------------------------------------------------------- returns in the cells


@dataclass(frozen=True, eq=False)
class Gathered:
    """Single returns in the cells, (n,) or (n, 3), ordered by cell, then by strip."""

    cell: Int64Array
    strip: Int64Array
    points: FloatArray
    time_ns: Int64Array
    direction: NDArray[np.int8]


def blocks_of(strips: Sequence[Strip]) -> Iterator[tuple[int, StripBlock]]:
    """Return all blocks of strips, each with its strip's index."""
    return ((number, block) for number, strip in enumerate(strips) for block in strip.blocks())


def gather(blocks: Iterable[tuple[int, StripBlock]], cells: Cells) -> Gathered:
    """Collect the returns that lie in the cells, from blocks with the index of their strip."""
    none = np.zeros(0, np.int64)
    pieces = [(none, none, np.zeros((0, 3)), none, np.zeros(0, np.int8))]
    for number, raw in blocks:
        block = _singles(raw)
        if not len(block.points) or not len(cells.numbers):
            continue
        numbers = numbers_of(block.points, cells.cell_m, cells.origin)
        at = np.minimum(np.searchsorted(cells.numbers, numbers), len(cells.numbers) - 1)
        kept = np.flatnonzero(cells.numbers[at] == numbers)
        strip = np.full(len(kept), number)
        pieces.append((at[kept], strip, block.points[kept], block.time_ns[kept], block.direction[kept]))
    columns = [np.concatenate(column) for column in zip(*pieces, strict=True)]
    order = np.lexsort((columns[1], columns[0]))
    return Gathered(*(column[order] for column in columns))
