"""Sums points into maps of cells: returns, pulses, heights, intensities, sigmas."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from swath.daemon.processing.quicklook.read import Block
from swath.georef.arrays import BoolArray, FloatArray, Int64Array
from swath.georef.compiled import jit_cached

MOST_CELLS = 2_000_000
STEPS = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0)  # factors of a power of ten
SMALLEST_CELL_M = 0.05
PULSES_FOR_DENSITY = 25  # in a cell of the density map: its count is then accurate to 20 %
WINDOWS = (1, 3, 5, 9, 15, 25)  # sides, in cells, of the squares that a smoothed value may be the mean of
COUNT, FIRST, HEIGHT, INTENSITY, SIGMAS, SIGMA_HEIGHT = range(6)


def round_up(size: float) -> float:
    """Return the smallest round size that is not below ``size``."""
    power = 10.0 ** math.floor(math.log10(size))
    found = min(step * power for step in (*STEPS, 10.0) if step * power >= size * (1.0 - 1e-9))
    return float(f"{found:.6g}")


@dataclass(frozen=True, slots=True)
class Frame:
    """Square cells that cover a rectangle, rows from south to north.

    Attributes:
        west_m, south_m: corner of the first cell.
        cell_m: side of a cell.
        rows, columns: number of rows and columns.
    """

    west_m: float
    south_m: float
    cell_m: float
    rows: int
    columns: int

    @property
    def extent_m(self) -> tuple[float, float, float, float]:
        """West, east, south and north edges."""
        east_m, north_m = self.west_m + self.columns * self.cell_m, self.south_m + self.rows * self.cell_m
        return self.west_m, east_m, self.south_m, north_m

    def centres(self, row: NDArray[Any], column: NDArray[Any]) -> FloatArray:
        """Return the centres (n, 2) of cells, east and north."""
        east_m = self.west_m + (column + 0.5) * self.cell_m
        return np.stack([east_m, self.south_m + (row + 0.5) * self.cell_m], axis=1)


def frame_of(low_m: FloatArray, high_m: FloatArray, cell_m: float) -> Frame:
    """Return cells from a south-western (2,) to a north-eastern (2,) corner; larger cells if there
    would be too many.
    """
    while True:
        first = np.floor(low_m[:2] / cell_m)
        columns, rows = (np.floor(high_m[:2] / cell_m) - first + 1.0).tolist()  # as floats, which do not overflow
        if rows * columns <= MOST_CELLS:
            return Frame(float(first[0] * cell_m), float(first[1] * cell_m), cell_m, int(rows), int(columns))
        cell_m = round_up(cell_m * 1.01)


def cell_for(density: float, points_a_cell: float) -> float:
    """Return a round side of cells that hold ``points_a_cell`` in the mean at ``density`` per square metre."""
    return round_up(max(math.sqrt(points_a_cell / density), SMALLEST_CELL_M))


@jit_cached
def _sum_up(
    x_m: Any,
    y_m: Any,
    z_m: Any,
    intensity: Any,
    first: Any,
    sigma_m: Any,
    west_m: float,
    south_m: float,
    cell_m: float,
    sums: FloatArray,
) -> int:
    """Add points to sums (rows, columns, 6); return how many lie outside."""
    rows, columns = sums.shape[0], sums.shape[1]
    outside = 0
    for i in range(len(x_m)):
        across, up = math.floor((x_m[i] - west_m) / cell_m), math.floor((y_m[i] - south_m) / cell_m)
        if not (0 <= across < columns and 0 <= up < rows):
            outside += 1
            continue
        cell = sums[up, across]
        cell[0] += 1.0
        cell[2] += z_m[i]
        if first[i]:
            cell[1] += 1.0
            cell[3] += intensity[i]
        if len(sigma_m) and not math.isnan(sigma_m[i, 2]):
            cell[4] += 1.0
            cell[5] += sigma_m[i, 2]
    return outside


@dataclass(slots=True)
class Surface:
    """Sums over all strips together in each cell.

    Attributes:
        frame: the cells.
        sums: (rows, columns, 6) by COUNT, FIRST … .
        outside: number of points beyond the frame.
        with_sigma: number of points whose sigma of height is known.
        unknown_sigma: number of points whose sigma field holds no known value.
        low_m, high_m: (3,) corners of the points themselves.
    """

    frame: Frame
    sums: FloatArray = field(init=False)
    outside: int = 0
    with_sigma: int = 0
    unknown_sigma: int = 0
    points: int = 0
    low_m: FloatArray = field(default_factory=lambda: np.full(3, np.inf))
    high_m: FloatArray = field(default_factory=lambda: np.full(3, -np.inf))

    def __post_init__(self) -> None:
        self.sums = np.zeros((self.frame.rows, self.frame.columns, 6))

    def add(self, block: Block) -> None:
        """Add a block's points to the sums."""
        if not len(block):
            return
        frame = self.frame
        for axis, values in enumerate((block.x_m, block.y_m, block.z_m)):
            self.low_m[axis] = min(self.low_m[axis], values.min())
            self.high_m[axis] = max(self.high_m[axis], values.max())
        self.points += len(block)
        known = int((~np.isnan(block.sigma_m[:, 2])).sum())
        self.with_sigma += known
        self.unknown_sigma += len(block.sigma_m) - known
        columns = (block.x_m, block.y_m, block.z_m, block.intensity, block.first, block.sigma_m)
        self.outside += _sum_up(*columns, frame.west_m, frame.south_m, frame.cell_m, self.sums)

    def mean(self, what: int) -> FloatArray:
        """Return means (rows, columns) of heights, intensities (of first returns) or sigmas; nan in empty cells."""
        counts = self.sums[:, :, {INTENSITY: FIRST, SIGMA_HEIGHT: SIGMAS}.get(what, COUNT)]
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(np.where(counts > 0, self.sums[:, :, what] / counts, np.nan))

    def density(self) -> tuple[FloatArray, float]:
        """Return pulses per square metre (rows, columns) in cells large enough for it, nan in empty ones; and their
        side.

        A pulse counts where its first return lies.
        """
        pulses = self.sums[:, :, FIRST]
        seen = pulses[pulses > 0]
        times = max(1, math.ceil(math.sqrt(PULSES_FOR_DENSITY / seen.mean()))) if len(seen) else 1
        rows, columns = (-(-size // times) for size in pulses.shape)
        padded = np.zeros((rows * times, columns * times))
        padded[: pulses.shape[0], : pulses.shape[1]] = pulses
        counts = padded.reshape(rows, times, columns, times).sum(axis=(1, 3))
        cell_m = times * self.frame.cell_m
        return np.where(counts > 0, counts / cell_m**2, np.nan), cell_m


def inner(there: BoolArray) -> BoolArray:
    """Return the cells all of whose eight neighbours are covered: others may be covered only partly."""
    found = np.zeros_like(there)
    if min(there.shape) > 2:
        found[1:-1, 1:-1] = there[1:-1, 1:-1]
        height, width = there.shape
        for down in range(3):
            for right in range(3):
                found[1:-1, 1:-1] &= there[down : height - 2 + down, right : width - 2 + right]
    return found if found.any() else there


def filled(values: FloatArray, times: int = 2) -> FloatArray:
    """Return values with gaps of a few cells filled by the mean of their neighbours, for display."""
    made = values.copy()
    for _ in range(times):
        known = np.isfinite(made)
        if known.all() or not known.any():
            break
        total, count = (_around(part) for part in (np.where(known, made, 0.0), known.astype(float)))
        fill = ~known & (count >= 3)
        made[fill] = total[fill] / count[fill]
    return made


def _around(values: FloatArray) -> FloatArray:
    """Return sums over each cell and its neighbours."""
    padded = np.pad(values, 1)
    rows = padded[:-2] + padded[1:-1] + padded[2:]
    return np.asarray(rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:])


def smoothed(
    values: FloatArray, sigmas: FloatArray, row: Int64Array, column: Int64Array, wanted_sigma: float
) -> tuple[FloatArray, FloatArray]:
    """Return means (n,) of cells' values over the smallest square around each that is precise enough, and their sigmas.

    The mean is weighted by the cells' variances. Where even the largest of the squares is not precise enough, it is
    that square's.

    Args:
        values, sigmas: (n,) of the cells, independent of each other.
        row, column: (n,) of the cells; no two are the same.
        wanted_sigma: sigma that a mean should have at most.
    """
    up, across = row - row.min(), column - column.min()
    weight = np.zeros((int(up.max()) + 1, int(across.max()) + 1))
    weight[up, across] = 1.0 / np.maximum(sigmas, 1e-6) ** 2
    product = np.zeros_like(weight)
    product[up, across] = weight[up, across] * values
    mean, sigma = values.astype(np.float64), sigmas.astype(np.float64)
    rough = sigma > wanted_sigma
    for side in WINDOWS[1:]:
        if not rough.any():
            break
        weights, products = (
            uniform_filter(grid, side, mode="constant")[up, across][rough] * side**2 for grid in (weight, product)
        )
        mean[rough], sigma[rough] = products / weights, 1.0 / np.sqrt(weights)
        rough &= sigma > wanted_sigma
    return mean, sigma
