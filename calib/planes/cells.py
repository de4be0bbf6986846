"""Find planes in one swath's returns: a grid of cells, and planes grown over them (Vosselman and Maas 2010, 2.3.3).

Cells belong to one lattice for all swaths, whose corner is t's origin. The key of a cell is row · 2³² + column. The
grid of a swath covers only part of its returns at a time, so its size stays bounded.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from swath.calib.flight import Flight, Swath, sensor_t
from swath.calib.planes.fit import PlaneError, PlaneSettings, expected_sigma
from swath.calib.planes.kernels import (
    EMPTY,
    FEW,
    GOOD,
    MOMENTS,
    ROUGH,
    SEVERAL,
    THIN,
    THIN_SPREAD,
    WALL,
    accumulate,
    fit_cells,
    grow,
)
from swath.calib.scale import spacing_m
from swath.georef.arrays import ByteArray, FloatArray, Int64Array
from swath.georef.points import contiguous

BLOCK = 1 << 18  # returns per kernel call; mapped ones are copied in blocks of this size
PIECE = 4 << 20  # returns that one grid covers
CELLS_MOST = 1 << 24  # of a grid; beyond that its returns are split
CELL_POINTS = 5.0  # least number in a cell for a significant plane of its own
CELL_SIZES_M = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0)
CELL_SHORT_M = 0.2  # a cell may be smaller than wanted by this much
WIDTH_LEAST_M, CELLS_LEAST = 1.2, 3  # of a plane
_FILL_LEAST = 0.5
_STRETCH = 100_000  # consecutive returns of a swath that represent its scan pattern
_SLANT_RAD = np.radians(60.0)
_ALIKE = float(np.cos(np.radians(15.0)))  # cosine between normals of a cell and of the plane it joins
_WHY = {
    FEW: "too few returns",
    THIN: "too few returns",
    SEVERAL: "several returns a pulse",
    ROUGH: "too rough",
    WALL: "wall",
}


@dataclass(frozen=True, eq=False)
class Segments:
    """Planes grown in swaths: k segments over c cells.

    Attributes:
        swath: (k,) its index.
        first: (k,) index of one of its returns.
        moments: (k, 10) of its returns, as in `swath.calib.planes.kernels`.
        normal_t: (k, 3).
        spread_m: (k, 3) standard deviations along the normal, and along the two axes of the plane, rising.
        cell_key, cell_of, cell_points: (c,) keys of cells, their segments, and their numbers of returns.
    """

    swath: Int64Array
    first: Int64Array
    moments: FloatArray
    normal_t: FloatArray
    spread_m: FloatArray
    cell_key: Int64Array
    cell_of: Int64Array
    cell_points: Int64Array

    def __len__(self) -> int:
        """Return the number of segments."""
        return len(self.swath)

    @classmethod
    def joined(cls, pieces: list[Segments]) -> Segments:
        """Concatenate one or more pieces, in order."""
        before = np.cumsum([0] + [len(piece) for piece in pieces])
        columns = [[getattr(piece, name) for piece in pieces] for name in cls.__dataclass_fields__]
        columns[6] = [piece.cell_of + shift for piece, shift in zip(pieces, before, strict=False)]
        return cls(*(np.concatenate(column) for column in columns))


def keys_of(columns: Int64Array, rows: Int64Array) -> Int64Array:
    """Return the keys of cells of the lattice."""
    keys: Int64Array = (rows << 32) + columns
    return keys


def cell_middles(keys: Int64Array, cell_m: float) -> FloatArray:
    """Return east and north (n, 2) of the cells' middles."""
    rows = (keys + (1 << 31)) >> 32
    return (np.stack([keys - (rows << 32), rows], axis=1) + 0.5) * cell_m


def blocks(swath: Swath, start: int = 0, stop: int | None = None) -> Iterator[tuple[int, FloatArray, ByteArray]]:
    """Yield a swath's returns in blocks: index of the first, points (n, 3), numbers of returns of their pulses (n,)."""
    stop = len(swath) if stop is None else stop
    for first in range(start, stop, BLOCK):
        part = slice(first, min(first + BLOCK, stop))
        yield first, contiguous(swath.points_t[part]), contiguous(swath.rows["number_of_returns"][part])


def cell_size(flight: Flight, settings: PlaneSettings) -> float:
    """Choose the size of cells in metres: most cells of a median swath have enough points on several scan lines.

    All swaths of a flight have the same size.

    Raises:
        PlaneError: no swath has points.
    """
    sizes = [spacing_m(swath) for swath in flight.swaths if len(swath)]
    sizes = [size for size in sizes if np.isfinite(size)]
    if not sizes:
        raise PlaneError("planes: the swaths have no points; use a trajectory and a calibration that georeference them")
    wanted = max(settings.cell_m, float(np.median(sizes)) * np.sqrt(settings.cell_points))
    large = [size for size in CELL_SIZES_M if size >= wanted - CELL_SHORT_M] or [CELL_SIZES_M[-1]]
    return next((size for size in large if _fill(flight, size) > _FILL_LEAST), large[-1])


def _fill(flight: Flight, cell_m: float) -> float:
    """Return the share of cells whose points lie on more than one scan line, in a median swath.

    Only cells with enough points for a plane count.
    """
    shares = []
    for swath in flight.swaths:
        middle, half = len(swath) // 2, _STRETCH // 2
        points = np.asarray(swath.points_t[max(middle - half, 0) : middle + half, :2])
        points = points[np.isfinite(points).all(axis=1)]
        columns, rows = np.floor(points.T / cell_m).astype(np.int64)
        _, cell = np.unique(keys_of(columns, rows), return_inverse=True)
        count = np.bincount(cell)
        x, y = (points - cell_m * np.stack([columns, rows], axis=1)).T
        mean_x, mean_y = np.bincount(cell, x) / count, np.bincount(cell, y) / count
        xx = np.bincount(cell, x * x) / count - mean_x**2
        yy = np.bincount(cell, y * y) / count - mean_y**2
        xy = np.bincount(cell, x * y) / count - mean_x * mean_y
        shorter = 0.5 * (xx + yy - np.sqrt((xx - yy) ** 2 + 4.0 * xy**2))
        enough = count >= CELL_POINTS
        if enough.any():
            shares.append(float((shorter > (1.3 * THIN_SPREAD * cell_m) ** 2)[enough].mean()))
    return float(np.median(shares)) if shares else 0.0


@dataclass(frozen=True, slots=True)
class _Grid:
    """A rectangular part of the lattice that begins at a column and a row."""

    west: int
    south: int
    columns: int
    rows: int
    cell_m: float

    @property
    def corner(self) -> tuple[float, float, float]:
        return self.west * self.cell_m, self.south * self.cell_m, self.cell_m

    @property
    def shape(self) -> tuple[int, int]:
        return self.rows, self.columns

    def places(self, at: Int64Array) -> tuple[Int64Array, Int64Array]:
        """Return columns and rows of cells in the lattice."""
        return at % self.columns + self.west, at // self.columns + self.south


def segments_of(
    flight: Flight, index: int, cell_m: float, settings: PlaneSettings, refused: Counter[str]
) -> list[Segments]:
    """Grow the planes of one swath, in pieces of it; the reasons why other tiles have no plane are counted."""
    swath = flight.swaths[index]
    parts = [range(at, min(at + PIECE, len(swath))) for at in range(0, len(swath), PIECE)]
    found = []
    while parts:
        part = parts.pop()
        grid = _grid(swath, part, cell_m)
        if grid is None:
            continue
        if grid.columns * grid.rows > CELLS_MOST and len(part) > 1:
            middle = part.start + len(part) // 2
            parts += [range(part.start, middle), range(middle, part.stop)]
            continue
        found.append(_segments(flight, index, part, grid, settings, refused))
    return found


def _grid(swath: Swath, part: range, cell_m: float) -> _Grid | None:
    """Return the grid around a part's points; None if it has no points."""
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for first in range(part.start, part.stop, BLOCK):
        points = swath.points_t[first : min(first + BLOCK, part.stop), :2]
        low, high = np.fmin(low, np.fmin.reduce(points)), np.fmax(high, np.fmax.reduce(points))
    if not (low <= high).all():
        return None
    west, south = (int(np.floor(value / cell_m)) for value in low)
    east, north = (int(np.floor(value / cell_m)) for value in high)
    return _Grid(west, south, east - west + 1, north - south + 1, cell_m)


def _segments(
    flight: Flight, index: int, part: range, grid: _Grid, settings: PlaneSettings, refused: Counter[str]
) -> Segments:
    swath, count = flight.swaths[index], grid.columns * grid.rows
    moments, base = np.zeros((count, MOMENTS)), np.zeros(count)
    several, seen = np.zeros(count, np.int32), np.zeros(count, np.int64)
    for first, points, returns in blocks(swath, part.start, part.stop):
        accumulate(points, returns, first, grid.corner, grid.shape, moments, base, several, seen)
    sigma_m = _coarse_sigma(flight, swath, part, settings)
    rough_m = settings.rough * sigma_m
    normal, rms_m, what = np.zeros((count, 3)), np.zeros(count), np.zeros(count, np.uint8)
    cell_limits = (CELL_POINTS, settings.several, rough_m, float(np.cos(settings.wall_slope_rad)))
    fit_cells(moments, base, several, grid.corner, grid.columns, cell_limits, normal, rms_m, what)
    good = np.flatnonzero(what == GOOD)
    order = good[np.argsort(rms_m[good], kind="stable")]
    label, regions = np.full(count, -1, np.int32), np.zeros((len(order), MOMENTS))
    tile = tile_cells(grid.cell_m, settings)
    tiles = (tile, grid.west % tile, grid.south % tile)
    limits = (rough_m, sigma_m, _ALIKE, float(np.cos(settings.roof_slope_rad)))
    grown = grow(order, what, moments, normal, grid.shape, tiles, limits, label, regions)
    _count_refused(what, label, grid, tile, refused)
    return _table(index, label, moments[:, 0], seen, grid, regions[:grown], settings, refused)


def tile_cells(cell_m: float, settings: PlaneSettings) -> int:
    """Return the number of cells along a tile."""
    return max(2, round(settings.tile_m / cell_m))


def _coarse_sigma(flight: Flight, swath: Swath, part: range, settings: PlaneSettings) -> float:
    """Return the sigma in metres of a return on an inclined surface at the median range."""
    at = np.arange(part.start, part.stop, max(1, len(part) // 1000))
    points = np.asarray(swath.points_t[at])
    range_m = float(np.nanmedian(np.linalg.norm(points - sensor_t(flight, swath, at), axis=1)))
    away = range_m * np.array([[np.sin(_SLANT_RAD), 0.0, np.cos(_SLANT_RAD)]])
    noise = flight.heads[swath.head].noise
    return float(expected_sigma(noise, away, np.array([[0.0, 0.0, 1.0]]), settings)[0])


def _count_refused(what: ByteArray, label: NDArray[np.int32], grid: _Grid, tile: int, refused: Counter[str]) -> None:
    """Count tiles in which no plane grew, by the kind of most of their cells."""
    at = np.flatnonzero(what != EMPTY)
    columns, rows = grid.places(at)
    _, of_tile = np.unique(keys_of(columns // tile, rows // tile), return_inverse=True)
    kinds = np.zeros((int(of_tile.max(initial=-1)) + 1, GOOD + 1), np.int64)
    np.add.at(kinds, (of_tile, what[at]), 1)
    grew = np.zeros(len(kinds), np.bool_)
    grew[of_tile[label[at] >= 0]] = True
    most = np.argmax(kinds[~grew], axis=1)
    for kind, count in zip(*np.unique(most, return_counts=True), strict=True):
        refused[_WHY[int(kind)]] += int(count)


def _table(
    index: int,
    label: NDArray[np.int32],
    points: FloatArray,
    seen: Int64Array,
    grid: _Grid,
    regions: FloatArray,
    settings: PlaneSettings,
    refused: Counter[str],
) -> Segments:
    """Return the table of the planes that are wide enough and have enough returns."""
    at = np.flatnonzero(label >= 0)
    of = label[at].astype(np.int64)
    cells = np.bincount(of, minlength=len(regions))
    variances, axes = _axes(regions)
    wide = np.sqrt(12.0 * variances[:, 1]) >= WIDTH_LEAST_M
    taken = wide & (cells >= CELLS_LEAST) & (regions[:, 0] >= settings.least_points)
    refused["too small"] += int((~taken & (cells > 1)).sum())
    first = np.zeros(len(regions), np.int64)
    first[of[::-1]] = seen[at[::-1]]
    number = np.cumsum(taken) - 1
    kept = taken[of]
    at, of = at[kept], number[of[kept]]
    keys = keys_of(*grid.places(at))
    swath = np.full(int(taken.sum()), index, np.int64)
    spread = np.sqrt(variances[taken])
    return Segments(swath, first[taken], regions[taken], axes[taken], spread, keys, of, points[at].astype(np.int64))


def _axes(moments: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return variances (k, 3), rising, and normals (k, 3) pointing up, of moments."""
    xx, xy, xz, yy, yz, zz = (moments[:, 4:] / moments[:, :1]).T
    matrix = np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], axis=1).reshape(-1, 3, 3)
    variances, vectors = np.linalg.eigh(matrix)
    normals = vectors[:, :, 0]
    return np.maximum(variances, 0.0), normals * np.where(normals[:, 2:] < 0.0, -1.0, 1.0)
