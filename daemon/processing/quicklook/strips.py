"""Compares strips: a plane goes through each strip's returns in each cell, and the planes' heights are compared.

Means of heights would compare slopes: where two strips sample a cell differently, their means differ by the slope times
the distance of their centroids. Planes do not, where the surface is smooth.

Cells begin fine and are merged, two by two, until they hold enough returns of the thinnest strip: their size depends on
the points themselves, not on their order, and their places do not depend on the extent of a file.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swath.calib.strips.differences import single_return_sigma_m
from swath.daemon.processing.quicklook.grids import Frame, inner, smoothed
from swath.daemon.processing.quicklook.read import Block
from swath.georef.arrays import BoolArray, FloatArray, Int64Array, SingleArray
from swath.georef.compiled import jit_cached, jit_inline

TILE = 16  # cells along a side; memory is allocated by tiles
TILE_CELLS = TILE * TILE
MOMENTS = 11  # first returns; then of single returns n, x, y, z, xx, xy, yy, xz, yz, zz
MOST_TILES = 12_000  # of all strips: 3 M cells, 270 MB; with more, cells become twice as large
TILES_AT_ONCE = 64  # that are merged together: 1.4 MB, which stays in a cache
MOST_STRIPS = 2000
MOST_FRAME_CELLS = 16_000_000  # within the extent, with or without points
MOST_TILE_PLACES = 8_000_000  # of all strips, with or without tiles
FINEST_CELL_M = 0.5
LEVELS = 5  # doublings from the finest cell to the coarsest, 16 m
RETURNS_A_CELL = 16.0  # single returns on open ground of the thinnest strip, within a factor of two
RETURNS_TO_MEASURE = 64.0  # of a strip in a block of cells from which its density is measured
OPEN = 0.7  # share of a block's pulses with one return only: open ground
LEAST_SHARE = 0.05  # of the largest strip's overlap; strips with less do not affect the cells' size
PULSES_FOR_DENSITY = 25.0  # in a cell for which density is given: its count is then accurate to 20 %
FEWEST_CELLS, FEWEST_PLACES, FEWEST_IN_PLACE = 100, 3, 3  # required for a verdict
PLACE = TILE // 2  # cells along a side of a place
FEWEST_RETURNS = 6
STEEPEST_DEG = 10.0  # USGS Lidar Base Specification: overlap is judged where slopes are below 10 degrees
ROUGHEST_M = 0.10
SMALLEST_CELL_M = 0.01
COARSEST_CELL_M = 20.0
PULSES_TO_COVER = 6.0
NARROWEST = 0.125  # of a cell: the smallest spread (one sigma) of a strip's returns in it, in any direction
HISTOGRAM_STEP_M, HISTOGRAM_HALF = 0.001, 10_000
SHOWN_SIGMA_M = 0.0025  # sigma of a difference on maps: an eighth of their first class, 2 cm


@jit_inline
def add_moments(cell: Any, x: float, y: float, z: float) -> None:
    """Add a single return, in metres from its cell's middle, to the cell's moments (`MOMENTS`,)."""
    cell[1] += 1.0
    cell[2] += x
    cell[3] += y
    cell[4] += z
    cell[5] += x * x
    cell[6] += x * y
    cell[7] += y * y
    cell[8] += x * z
    cell[9] += y * z
    cell[10] += z * z


@jit_cached
def _sum_moments(
    begin: int,
    x_m: FloatArray,
    y_m: FloatArray,
    z_m: FloatArray,
    strip: Any,
    first: Any,
    single: Any,
    frame: tuple[float, float, float, float],
    tiles: Any,
    used: int,
    moments: FloatArray,
) -> tuple[int, int, int]:
    """Add points from ``begin`` on; return where it stopped for lack of a tile, the tiles in use, and points outside.

    ``frame``: west, south, cell, reference height. ``tiles``: (strips, rows, columns) of tiles, −1 where there is none.
    """
    west_m, south_m, cell_m, reference_m = frame
    outside = 0
    for i in range(begin, len(x_m)):
        across, up = math.floor((x_m[i] - west_m) / cell_m), math.floor((y_m[i] - south_m) / cell_m)
        if not (0 <= across < tiles.shape[2] * 16 and 0 <= up < tiles.shape[1] * 16 and strip[i] < tiles.shape[0]):
            outside += 1
            continue
        tile = tiles[strip[i], up >> 4, across >> 4]
        if tile < 0:
            if used == len(moments):
                return i, used, outside
            tile = used
            tiles[strip[i], up >> 4, across >> 4] = tile
            used += 1
        cell = moments[tile, ((up & 15) << 4) + (across & 15)]
        if first[i]:
            cell[0] += 1.0
        if single[i]:
            x, y = x_m[i] - west_m - (across + 0.5) * cell_m, y_m[i] - south_m - (up + 0.5) * cell_m
            z = z_m[i] - reference_m
            add_moments(cell, x, y, z)
    return len(x_m), used, outside


@dataclass(slots=True)
class Pair:
    """Height differences of two strips in their common smooth cells, the first strip minus the second.

    Attributes:
        first, second: numbers of the strips.
        dz_m: (n,) differences.
        sigma_m: (n,) their sigmas, from the scatter of the returns about their planes.
        row, column: (n,) cells.
        compared: number of cells where both strips have enough single returns, smooth or not.
        scatter: for each strip, variances (m,) of its single returns about their planes, m², and the numbers (m,) of
            these returns, in level cells, smooth or not.
    """

    first: int
    second: int
    dz_m: FloatArray
    sigma_m: FloatArray
    row: Int64Array
    column: Int64Array
    compared: int
    scatter: tuple[tuple[FloatArray, FloatArray], ...] = ()

    def numbers(self) -> dict[str, Any]:
        """Return median, mean, root mean square, 95 % of the absolute and largest difference, metres."""
        size = np.abs(self.dz_m)
        return {
            "cells": len(size),
            "compared_cells": self.compared,
            "median_m": float(np.median(self.dz_m)),
            "mean_m": float(self.dz_m.mean()),
            "rms_m": float(np.sqrt(np.mean(self.dz_m**2))),
            "p95_m": float(np.percentile(size, 95.0)),
            "max_m": float(size.max()),
        }


@dataclass(frozen=True, slots=True)
class Coverage:
    """Cells around a strip, with the number of its first returns in each."""

    frame: Frame
    pulses: FloatArray

    @property
    def there(self) -> BoolArray:
        """Flags of cells with a pulse."""
        return np.asarray(self.pulses > 0)

    def centres(self) -> FloatArray:
        """Return the centres (n, 2), east and north, of cells with a pulse."""
        return self.frame.centres(*np.nonzero(self.there))


@dataclass(slots=True)
class StripCells:
    """Moments of every strip's single returns in cells; tiles without returns take no memory.

    Attributes:
        frame: the cells; they are enlarged if there are too many tiles.
        reference_m: height that moments refer to.
        left_out: number of points outside the frame, or of strips beyond the maximum.
        fixed: True if the user gave the cells' size: `settle` keeps it.
    """

    frame: Frame
    reference_m: float
    left_out: int = 0
    fixed: bool = False
    tiles: NDArray[np.int32] = field(init=False)
    moments: FloatArray = field(init=False)
    used: int = 0

    def __post_init__(self) -> None:
        self.tiles = self._no_tiles(1)
        self.moments = np.zeros((min(64, MOST_TILES), TILE_CELLS, MOMENTS))

    def _no_tiles(self, strips: int) -> NDArray[np.int32]:
        return np.full((strips, -(-self.frame.rows // TILE), -(-self.frame.columns // TILE)), -1, np.int32)

    def add(self, block: Block) -> None:
        """Add a block's points to the moments."""
        if not len(block):
            return
        strips = min(int(block.strip.max()) + 1, MOST_STRIPS)
        while strips * self.tiles[0].size > MOST_TILE_PLACES and self.tiles[0].size > 1:
            self._coarsen()
        if strips > len(self.tiles):
            self.tiles = np.concatenate([self.tiles, self._no_tiles(strips - len(self.tiles))])
        columns = (block.x_m, block.y_m, block.z_m, block.strip, block.first, block.single)
        begin = 0
        while True:
            frame = (self.frame.west_m, self.frame.south_m, self.frame.cell_m, self.reference_m)
            begin, self.used, left = _sum_moments(begin, *columns, frame, self.tiles, self.used, self.moments)
            self.left_out += left
            if begin == len(block):
                return
            if self.used < MOST_TILES:
                more = min(self.used, MOST_TILES - self.used)
                self.moments = np.concatenate([self.moments, np.zeros((more, TILE_CELLS, MOMENTS))])
            else:
                self._coarsen()

    def _coarsen(self) -> None:
        """Double the cells: merge the moments of four cells, referred to their common centre."""
        old, old_tiles, old_moments = self.frame, self.tiles, self.moments
        self.frame = Frame(old.west_m, old.south_m, 2 * old.cell_m, -(-old.rows // 2), -(-old.columns // 2))
        self.tiles = self._no_tiles(len(old_tiles))
        strip, up, across = np.nonzero(old_tiles >= 0)
        made = np.zeros(self.tiles.shape, np.bool_)
        made[strip, up // 2, across // 2] = True
        self.used = int(made.sum())
        self.tiles[made] = np.arange(self.used)
        self.moments = np.zeros((max(self.used, 1), TILE_CELLS, MOMENTS))
        quarters = self.moments.reshape(-1, 2, TILE // 2, 2, TILE // 2, MOMENTS)
        for begin in range(0, len(strip), TILES_AT_ONCE):
            part = slice(begin, begin + TILES_AT_ONCE)
            s, u, a = strip[part], up[part], across[part]
            quarters[self.tiles[s, u // 2, a // 2], u % 2, :, a % 2] = _halved(
                old_moments[old_tiles[s, u, a]], old.cell_m
            )

    def settle(self) -> None:
        """Enlarge the cells as the thinnest strip requires, after all points have been added."""
        if self.fixed:
            return
        known = [density for density in self.single_densities() if density > 0.0]
        wanted_m = math.sqrt(RETURNS_A_CELL / min(known)) if known else 0.0
        coarsest_m = self.frame.cell_m * 2**LEVELS
        while self.frame.cell_m * math.sqrt(2.0) < wanted_m and self.frame.cell_m < min(coarsest_m, COARSEST_CELL_M):
            self._coarsen()

    def single_densities(self) -> list[float]:
        """Return by strip its single returns per square metre, on open ground where it overlaps others.

        It is the median over blocks of cells. 0: the strip has no points, or hardly overlaps.
        """
        there = (self.tiles >= 0).reshape(len(self.tiles), -1)
        shared = there & (there.sum(axis=0) > 1)
        sizes = shared.sum(axis=1)
        if not sizes.any():  # no strips overlap: use all cells
            shared, sizes = there, there.sum(axis=1)
        densities = []
        for strip in range(len(self.tiles)):
            if sizes[strip] < LEAST_SHARE * sizes.max() or not sizes[strip]:
                densities.append(0.0)
                continue
            moments = self.moments[self.tiles[strip].ravel()[shared[strip]], :, :2]
            densities.append(open_density(moments, self.frame.cell_m))
        return densities

    def pulse_density(self) -> tuple[float, float]:
        """Return mean pulses per square metre of all strips together in fully covered cells, and the covered area."""
        ups, acrosses = np.nonzero((self.tiles >= 0).any(axis=0))
        if not len(ups):
            return math.nan, 0.0
        up, across = int(ups.min()), int(acrosses.min())
        pulses = np.zeros((int(ups.max()) - up + 1, TILE, int(acrosses.max()) - across + 1, TILE), np.float32)
        for tiles in self.tiles:
            row, column = np.nonzero(tiles >= 0)
            pulses[row - up, :, column - across] += self.moments[tiles[row, column], :, 0].reshape(-1, TILE, TILE)
        counts: NDArray[Any] = pulses.reshape(pulses.shape[0] * TILE, -1)
        cell_m = self.frame.cell_m
        while (counts > 0).any() and counts[counts > 0].mean() < PULSES_FOR_DENSITY and max(counts.shape) > 1:
            counts, cell_m = _pooled(counts), 2.0 * cell_m
        there = counts > 0
        density = float(counts[inner(there)].mean()) / cell_m**2 if there.any() else math.nan
        return density, float(there.sum()) * cell_m**2

    def coverage(self, strip: int) -> Coverage:
        """Return the coverage of a strip, in cells that hold enough of its pulses to tell a gap from chance."""
        ups, acrosses = np.nonzero(self.tiles[strip] >= 0) if strip < len(self.tiles) else (np.array([], int),) * 2
        if not len(ups):
            return Coverage(Frame(self.frame.west_m, self.frame.south_m, self.frame.cell_m, 1, 1), np.zeros((1, 1)))
        up, across = int(ups.min()), int(acrosses.min())
        made = np.zeros((int(ups.max()) - up + 1, TILE, int(acrosses.max()) - across + 1, TILE))
        tiles = self.moments[self.tiles[strip, ups, acrosses], :, 0]
        made[ups - up, :, acrosses - across] = tiles.reshape(-1, TILE, TILE)
        pulses = made.reshape(made.shape[0] * TILE, made.shape[2] * TILE)
        side_m = TILE * self.frame.cell_m
        west_m, south_m, cell_m = (
            self.frame.west_m + across * side_m,
            self.frame.south_m + up * side_m,
            self.frame.cell_m,
        )
        while (pulses > 0).any() and pulses[pulses > 0].mean() < PULSES_TO_COVER and max(pulses.shape) > 1:
            pulses, cell_m = _pooled(pulses), 2 * cell_m
        return Coverage(Frame(west_m, south_m, cell_m, *pulses.shape), pulses)

    def pairs(self) -> Iterator[Pair]:
        """Yield every two strips that share a smooth cell."""
        there = (self.tiles >= 0).reshape(len(self.tiles), -1).astype(np.float32)
        for first, second in np.argwhere(np.triu(there @ there.T, 1) > 0):
            found = self._pair(int(first), int(second))
            if found is not None:
                yield found

    def _pair(self, first: int, second: int) -> Pair | None:
        ups, acrosses = np.nonzero((self.tiles[first] >= 0) & (self.tiles[second] >= 0))
        a, b = (self.moments[self.tiles[strip, ups, acrosses]] for strip in (first, second))
        tile, inside = np.nonzero((a[:, :, 1] >= FEWEST_RETURNS) & (b[:, :, 1] >= FEWEST_RETURNS))
        plane_a, plane_b = (planes_of(one[tile, inside], self.frame.cell_m) for one in (a, b))
        keep = plane_a.smooth & plane_b.smooth
        if not keep.any():
            return None
        x_m, y_m = (plane_a.x_m + plane_b.x_m) / 2, (plane_a.y_m + plane_b.y_m) / 2
        dz_m = plane_a.height(x_m, y_m) - plane_b.height(x_m, y_m)
        sigma_m = np.sqrt(plane_a.height_variance(x_m, y_m) + plane_b.height_variance(x_m, y_m))
        row, column = ups[tile] * TILE + inside // TILE, acrosses[tile] * TILE + inside % TILE
        scatter = tuple((one.variance_m2[one.level], one.count[one.level]) for one in (plane_a, plane_b))
        return Pair(first, second, dz_m[keep], sigma_m[keep], row[keep], column[keep], len(tile), scatter)


@dataclass(frozen=True, slots=True)
class Planes:
    """Planes (n,) through cells' returns: centroid, counted from the cell's centre, gradient, and whether the surface
    is smooth.

    ``level``: gentle, with returns that spread over the cell; ``smooth``: in addition their scatter ``variance_m2`` is
    small.
    """

    x_m: FloatArray
    y_m: FloatArray
    z_m: FloatArray
    east: FloatArray
    north: FloatArray
    level: BoolArray
    smooth: BoolArray
    variance_m2: FloatArray
    count: FloatArray
    spread_m2: tuple[FloatArray, FloatArray, FloatArray]  # second moments about the centroid: xx, xy, yy

    def height(self, x_m: FloatArray, y_m: FloatArray) -> FloatArray:
        """Return the heights (n,) of the planes at places counted from the cells' centres."""
        return self.z_m + self.east * (x_m - self.x_m) + self.north * (y_m - self.y_m)

    def height_variance(self, x_m: FloatArray, y_m: FloatArray) -> FloatArray:
        """Return variances of the planes' heights; a scatter that is small by chance counts as the typical one."""
        x, y, (xx, xy, yy) = x_m - self.x_m, y_m - self.y_m, self.spread_m2
        typical = float(np.median(self.variance_m2[self.smooth])) if self.smooth.any() else 0.0
        determinant = np.where(self.level, xx * yy - xy * xy, 1.0)
        lever = (x * x * yy - 2.0 * x * y * xy + y * y * xx) / determinant
        return np.asarray(np.maximum(self.variance_m2, typical) * (1.0 + np.maximum(lever, 0.0)) / self.count)


def planes_of(moments: FloatArray, cell_m: float) -> Planes:
    """Return least squares planes of cells (n, MOMENTS) of a side, each with more than three single returns."""
    n = moments[:, 1]
    x, y, z, xx, xy, yy, xz, yz, zz = (moments[:, 2:] / n[:, np.newaxis]).T
    xx, xy, yy, xz, yz, zz = xx - x * x, xy - x * y, yy - y * y, xz - x * z, yz - y * z, zz - z * z
    least = (xx + yy) / 2 - np.hypot((xx - yy) / 2, xy)
    spread = least >= (NARROWEST * cell_m) ** 2
    determinant = np.where(spread, xx * yy - xy * xy, 1.0)
    east, north = (xz * yy - yz * xy) / determinant, (yz * xx - xz * xy) / determinant
    variance = np.maximum(zz - east * xz - north * yz, 0.0) * n / (n - 3.0)
    gentle = np.hypot(east, north) <= math.tan(math.radians(STEEPEST_DEG))
    smooth = spread & gentle & (variance <= ROUGHEST_M**2)
    return Planes(x, y, z, east, north, spread & gentle, smooth, variance, n, (xx, xy, yy))


def _pooled(counts: NDArray[Any]) -> NDArray[Any]:
    """Return sums of two by two cells (rows, columns)."""
    rows, columns = (-(-size // 2) for size in counts.shape)
    even = np.zeros((2 * rows, 2 * columns), counts.dtype)
    even[: counts.shape[0], : counts.shape[1]] = counts
    return np.asarray(even.reshape(rows, 2, columns, 2).sum(axis=(1, 3)))


def open_density(moments: FloatArray, cell_m: float) -> float:
    """Return single returns per square metre on open ground of tiles (n, 256, 2): pulses and single returns."""
    block = 1
    while True:
        sums = moments.reshape(-1, TILE // block, block, TILE // block, block, 2).sum(axis=(2, 4)).reshape(-1, 2)
        covered = sums[sums[:, 0] > 0]
        if not len(covered):
            return 0.0
        if block == TILE or np.median(covered[:, 0]) >= RETURNS_TO_MEASURE:
            break
        block *= 2
    open_ground = covered[covered[:, 1] >= OPEN * covered[:, 0]]
    used = open_ground if len(open_ground) else covered
    return float(np.median(used[:, 1])) / (block * cell_m) ** 2


def strip_frame(low_m: FloatArray, high_m: FloatArray, cell_m: float | None = None) -> Frame:
    """Return the fine cells that strips are summed into, of the given side or the finest.

    They begin at whole multiples of the coarsest cells' tiles, so that merged cells are the same wherever a file
    begins.
    """
    side_m = FINEST_CELL_M if cell_m is None else max(cell_m, SMALLEST_CELL_M)
    step_m = TILE * side_m * 2**LEVELS
    west_m, south_m = (np.floor(low_m[:2] / step_m) * step_m).tolist()
    while True:
        columns, rows = (np.floor((high_m[:2] - (west_m, south_m)) / side_m) + 1.0).tolist()
        if rows * columns <= MOST_FRAME_CELLS:
            return Frame(west_m, south_m, side_m, int(rows), int(columns))
        side_m *= 2.0


def _halved(moments: FloatArray, cell_m: float) -> FloatArray:
    """Return tiles (…, 256, MOMENTS) as quarters (…, 8, 8, MOMENTS) of tiles with cells twice as large."""
    return merged(moments.reshape(*moments.shape[:-2], TILE, TILE, MOMENTS), cell_m)


def merged(cells: FloatArray, cell_m: float) -> FloatArray:
    """Return moments of cells (…, rows, columns, MOMENTS), both even, joined two by two about the centre of the four.

    Args:
        cells: moments about the centre of each cell.
        cell_m: side of these cells.
    """
    rows, columns = cells.shape[-3:-1]
    made = np.zeros((*cells.shape[:-3], rows // 2, columns // 2, MOMENTS))
    for up in range(2):
        for across in range(2):
            part = cells[..., up::2, across::2, :]
            east, north = (across - 0.5) * cell_m, (up - 0.5) * cell_m
            first, n, x, y, z, xx, xy, yy, xz, yz, zz = np.moveaxis(part, -1, 0)
            moved = (
                first,
                n,
                x + n * east,
                y + n * north,
                z,
                xx + 2 * east * x + n * east**2,
                xy + east * y + north * x + n * east * north,
                yy + 2 * north * y + n * north**2,
                xz + east * z,
                yz + north * z,
                zz,
            )
            made += np.stack(moved, axis=-1)
    return made


@dataclass(slots=True)
class Overlap:
    """The differences of all pairs together.

    Attributes:
        worst_m: (rows, columns) f4 largest difference by size in each cell, nan if none was compared.
        signed: histogram of dZ in millimetres, with open bins at both ends.
        shown_m, shown_sigma_m: (rows, columns) f4 the same for maps: each pair's differences are smoothed to
            `SHOWN_SIGMA_M` before the largest is taken; and its sigma.
    """

    worst_m: SingleArray
    signed: Int64Array = field(default_factory=lambda: np.zeros(2 * HISTOGRAM_HALF + 1, np.int64))
    cells: int = 0
    squares: float = 0.0
    largest_m: float = 0.0
    rows: list[dict[str, Any]] = field(default_factory=list)
    best: Pair | None = None
    scatter: dict[int, list[tuple[FloatArray, FloatArray]]] = field(default_factory=dict)
    shown_m: SingleArray = field(init=False)
    shown_sigma_m: SingleArray = field(init=False)

    def __post_init__(self) -> None:
        self.shown_m, self.shown_sigma_m = (np.full_like(self.worst_m, np.nan) for _ in range(2))

    def add(self, pair: Pair) -> None:
        """Add a pair; the one with most cells is kept as the best."""
        before = self.worst_m[pair.row, pair.column]
        larger = ~(np.abs(before) >= np.abs(pair.dz_m))  # also if there was no value
        self.worst_m[pair.row[larger], pair.column[larger]] = pair.dz_m[larger]
        mean_m, sigma_m = smoothed(pair.dz_m, pair.sigma_m, pair.row, pair.column, SHOWN_SIGMA_M)
        larger = ~(np.abs(self.shown_m[pair.row, pair.column]) >= np.abs(mean_m))
        self.shown_m[pair.row[larger], pair.column[larger]] = mean_m[larger]
        self.shown_sigma_m[pair.row[larger], pair.column[larger]] = sigma_m[larger]
        steps = np.clip(np.rint(pair.dz_m / HISTOGRAM_STEP_M), -HISTOGRAM_HALF, HISTOGRAM_HALF).astype(int)
        self.signed += np.bincount(steps + HISTOGRAM_HALF, minlength=len(self.signed))
        self.cells += len(pair.dz_m)
        self.squares += float((pair.dz_m**2).sum())
        self.largest_m = max(self.largest_m, float(np.abs(pair.dz_m).max()))
        self.rows.append({"first": pair.first, "second": pair.second} | pair.numbers())
        if self.best is None or len(pair.dz_m) > len(self.best.dz_m):
            self.best = pair
        for strip, scatter in zip((pair.first, pair.second), pair.scatter, strict=False):
            self.scatter.setdefault(strip, []).append(scatter)

    @property
    def compared_cells(self) -> int:
        """Number of cells in which any two strips were compared."""
        return int(np.isfinite(self.worst_m).sum())

    @property
    def places(self) -> int:
        """Number of separate places: blocks with compared cells, of which neighbours count once."""
        rows, columns = (size // PLACE for size in self.worst_m.shape)
        cells = np.isfinite(self.worst_m).reshape(rows, PLACE, columns, PLACE).sum(axis=(1, 3))
        found = 0
        while cells.max(initial=0) >= FEWEST_IN_PLACE:
            row, column = np.unravel_index(int(cells.argmax()), cells.shape)
            cells[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2] = 0
            found += 1
        return found

    def repeatability_m(self) -> dict[int, float]:
        """Return by strip the sigma of its single returns on the smoothest quarter of gentle ground in the overlap."""
        return {
            strip: single_return_sigma_m(*(np.concatenate(column) for column in zip(*parts, strict=True)))
            for strip, parts in sorted(self.scatter.items())
            if sum(len(one) for one, _ in parts)
        }

    def numbers(self) -> dict[str, Any] | None:
        """Return the numbers of all pairs' cells, 95 % and 99 % of |dZ| to the millimetre; None if no cell was
        compared.
        """
        if not self.cells:
            return None
        size = self.signed[HISTOGRAM_HALF:].copy()
        size[1:] += self.signed[:HISTOGRAM_HALF][::-1]
        p95_m = float(np.searchsorted(np.cumsum(size), 0.95 * self.cells)) * HISTOGRAM_STEP_M
        median = int(np.searchsorted(np.cumsum(self.signed), 0.5 * self.cells)) - HISTOGRAM_HALF
        p99_m = float(np.searchsorted(np.cumsum(size), 0.99 * self.cells)) * HISTOGRAM_STEP_M
        mean_m = sum(row["cells"] * row["mean_m"] for row in self.rows) / self.cells
        return {
            "cells": self.cells,
            "median_m": median * HISTOGRAM_STEP_M,
            "mean_m": mean_m,
            "std_m": math.sqrt(max(self.squares / self.cells - mean_m**2, 0.0)),
            "rms_m": math.sqrt(self.squares / self.cells),
            "p95_m": p95_m,
            "p99_m": p99_m,
            "max_m": self.largest_m,
        }


def compare(cells: StripCells) -> Overlap:
    """Compare all pairs of strips, in cells of the size that `StripCells.settle` finds."""
    cells.settle()
    rows, columns = (size * TILE for size in cells.tiles.shape[1:])
    overlap = Overlap(np.full((rows, columns), np.nan, np.float32))
    for pair in cells.pairs():
        overlap.add(pair)
    return overlap
