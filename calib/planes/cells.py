"""Planes in one swath's returns: a grid of cells, planes grown over them (Vosselman and Maas 2010, 2.3.3).

Cells belong to one lattice for all swaths, whose corner is t's origin: cell (column, row) has the key
row · 2³² + column. The grid of a swath is laid over so many returns at a time that its size stays bounded.
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
from swath.georef.arrays import FloatArray
from swath.georef.points import contiguous
from swath.georef.records import Int64Array

BLOCK = 1 << 18  # returns handed to a kernel at a time: mapped ones are copied so many at a time
PIECE = 4 << 20  # returns a grid is laid over
CELLS_MOST = 1 << 24  # of a grid; cells are made larger beyond
CELL_POINTS = 5.0  # least of a cell, for a plane of its own that says something
CELL_SIZES_M = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0)
CELL_SHORT_M = 0.2  # by which a cell may be smaller than wanted
WIDTH_LEAST_M, CELLS_LEAST = 1.2, 3  # of a plane
_FILL_LEAST = 0.5
_STRETCH = 100_000  # consecutive returns of a swath that are looked at for its pattern
_SLANT_RAD = np.radians(60.0)
_ALIKE = float(np.cos(np.radians(15.0)))  # normals of a cell and of the plane it is to join
_WHY = {
    FEW: "too few returns",
    THIN: "too few returns",
    SEVERAL: "several returns a pulse",
    ROUGH: "too rough",
    WALL: "wall",
}


@dataclass(frozen=True, eq=False)
class Segments:
    """Planes grown in swaths, k of them, over c cells.

    Attributes:
        swath: (k,) index of it.
        first: (k,) index of one of its returns.
        moments: (k, 10) of its returns, as in `swath.calib.planes.kernels`.
        normal_t: (k, 3).
        spread_m: (k, 3) standard deviations along the normal, and along the two axes of the plane, rising.
        cells: (c,) keys, (c,) of which segment, (c,) returns in them.
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
        """Number of segments."""
        return len(self.swath)

    @classmethod
    def joined(cls, pieces: list[Segments]) -> Segments:
        """Return one after the other; at least one piece."""
        before = np.cumsum([0] + [len(piece) for piece in pieces])
        columns = [[getattr(piece, name) for piece in pieces] for name in cls.__dataclass_fields__]
        columns[6] = [piece.cell_of + shift for piece, shift in zip(pieces, before, strict=False)]
        return cls(*(np.concatenate(column) for column in columns))


def keys_of(columns: Int64Array, rows: Int64Array) -> Int64Array:
    """Return keys of cells of the lattice."""
    keys: Int64Array = (rows << 32) + columns
    return keys


def cell_middles(keys: Int64Array, cell_m: float) -> FloatArray:
    """Return (n, 2) east and north of cells' middles."""
    rows = (keys + (1 << 31)) >> 32
    return (np.stack([keys - (rows << 32), rows], axis=1) + 0.5) * cell_m


def blocks(
    swath: Swath, start: int = 0, stop: int | None = None
) -> Iterator[tuple[int, FloatArray, NDArray[np.uint8]]]:
    """Yield a swath's returns by and by: index of the first, points (n, 3), returns of their pulses (n,)."""
    stop = len(swath) if stop is None else stop
    for first in range(start, stop, BLOCK):
        part = slice(first, min(first + BLOCK, stop))
        yield first, contiguous(swath.points_t[part]), contiguous(swath.rows["number_of_returns"][part])


def cell_size(flight: Flight, settings: PlaneSettings) -> float:
    """Metres: so many that most cells of a middling swath have the points wanted, of more than one line of the scan.

    One size for all swaths of a flight.

    Raises:
        PlaneError: no swath has points.
    """
    sizes = [spacing_m(swath) for swath in flight.swaths if len(swath)]
    sizes = [size for size in sizes if np.isfinite(size)]
    if not sizes:
        raise PlaneError("planes: the swaths have no points; want a trajectory and a calibration that place them")
    wanted = max(settings.cell_m, float(np.median(sizes)) * np.sqrt(settings.cell_points))
    large = [size for size in CELL_SIZES_M if size >= wanted - CELL_SHORT_M] or [CELL_SIZES_M[-1]]
    return next((size for size in large if _fill(flight, size) > _FILL_LEAST), large[-1])


def _fill(flight: Flight, cell_m: float) -> float:
    """Return share of the cells with points enough for a plane that have them on more than one line, in a middling
    swath.
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
    """Cells of the lattice from a column and a row on."""

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
        """Return columns and rows of the lattice of cells."""
        return at % self.columns + self.west, at // self.columns + self.south


def segments_of(
    flight: Flight, index: int, cell_m: float, settings: PlaneSettings, refused: Counter[str]
) -> list[Segments]:
    """Of one swath, by pieces of it; why other places bear no plane is counted, in tiles."""
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
    """Return around a part's points; None where it has none."""
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
    """Return cells a tile."""
    return max(2, round(settings.tile_m / cell_m))


def _coarse_sigma(flight: Flight, swath: Swath, part: range, settings: PlaneSettings) -> float:
    """Metres, of a return on a surface seen at a slant, as far away as most are."""
    at = np.arange(part.start, part.stop, max(1, len(part) // 1000))
    points = np.asarray(swath.points_t[at])
    range_m = float(np.nanmedian(np.linalg.norm(points - sensor_t(flight, swath, at), axis=1)))
    away = range_m * np.array([[np.sin(_SLANT_RAD), 0.0, np.cos(_SLANT_RAD)]])
    noise = flight.heads[swath.head].noise
    return float(expected_sigma(noise, away, np.array([[0.0, 0.0, 1.0]]), settings)[0])


def _count_refused(
    what: NDArray[np.uint8], label: NDArray[np.int32], grid: _Grid, tile: int, refused: Counter[str]
) -> None:
    """Tiles on which no plane grew, by what most of their cells are."""
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
    """Return those that are wide enough and have returns enough, as a table."""
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
