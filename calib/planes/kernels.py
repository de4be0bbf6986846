"""Compiled loops of the plane search: moments of cells, growing of planes over cells, returns at known places.

A cell's place in the grid is ``row · columns + column``, rows to the north, columns to the east. Moments of n points
are (10,): n, mean x y z, and the sums of products of the differences from the mean, xx xy xz yy yz zz.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from swath.georef.arrays import ByteArray, FloatArray, Int64Array
from swath.georef.compiled import jit_cached, jit_inline, whole

Int32Array = NDArray[np.int32]

MOMENTS = 10
EMPTY, FEW, SEVERAL, ROUGH, WALL, THIN, GOOD = range(7)  # kinds of cells; thin ones have no direction of their own
THIN_POINTS = 2.0
THIN_SPREAD = 0.15  # of a cell's size: standard deviation of points on a line rather than on a plane
_ONE_RETURN = 1
_GOLDEN, _HIGH = whole(-7046029254386353131), whole(20)  # 2⁶⁴ over the golden ratio, and the number of bits dropped
_SURELY = 3.0  # sigmas of a plane's direction
_REFIT_SHARE = 1.15  # a growing plane is refitted when its points reach this multiple of the last fit's


@jit_inline
def smallest(xx: float, xy: float, xz: float, yy: float, yz: float, zz: float) -> tuple[float, float, float, float]:
    """Return the least eigenvalue of a symmetric matrix and its unit vector, z ≥ 0 (Smith, Comm. ACM 4, 1961)."""
    middle = (xx + yy + zz) / 3.0
    a, b, c = xx - middle, yy - middle, zz - middle
    size = math.sqrt((a * a + b * b + c * c + 2.0 * (xy * xy + xz * xz + yz * yz)) / 6.0)
    if size <= 0.0:
        return middle, 0.0, 0.0, 1.0
    half = 0.5 * (a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz)) / (size * size * size)
    angle = math.acos(min(1.0, max(-1.0, half))) / 3.0
    least = middle + 2.0 * size * math.cos(angle + 2.0 * math.pi / 3.0)
    a, b, c = xx - least, yy - least, zz - least
    x, y, z = xy * yz - xz * b, xz * xy - a * yz, a * b - xy * xy
    best = x * x + y * y + z * z
    others = (
        (xy * c - xz * yz, xz * xz - a * c, a * yz - xz * xy),
        (b * c - yz * yz, yz * xz - xy * c, xy * yz - b * xz),
    )
    for u, v, w in others:
        length = u * u + v * v + w * w
        if length > best:
            x, y, z, best = u, v, w, length
    if best <= 0.0:
        return least, 0.0, 0.0, 1.0
    scale = 1.0 / math.sqrt(best)
    if z < 0.0:
        scale = -scale
    return least, x * scale, y * scale, z * scale


@jit_inline
def shorter_axis(sums: FloatArray, least: float) -> float:
    """Return the middle eigenvalue of moments (10,), given the least one.

    It follows from the product and the sum of the two other eigenvalues.
    """
    xx, xy, xz, yy, yz, zz = sums[4], sums[5], sums[6], sums[7], sums[8], sums[9]
    rest = xx + yy + zz - least
    product = xx * yy - xy * xy + xx * zz - xz * xz + yy * zz - yz * yz - least * rest
    shorter: float = 0.5 * (rest - math.sqrt(max(rest * rest - 4.0 * product, 0.0)))
    return shorter


@jit_cached
def accumulate(
    points_t: FloatArray,
    returns: ByteArray,
    first: int,
    corner: tuple[float, float, float],
    shape: tuple[int, int],
    moments: FloatArray,
    base: FloatArray,
    several: Int32Array,
    seen: Int64Array,
) -> None:
    """Add points (n, 3) to the cells' sums; points of pulses with several returns are only counted.

    Args:
        points_t: nan: no point.
        returns: (n,) numbers of returns of their pulses.
        first: index of the first of them in its swath.
        corner: west, south, metres per cell.
        shape: rows, columns.
        moments: (cells, 10) sums, x and y from the cell's middle, z from ``base``.
        base: (cells,) height of a cell's first point.
        several: (cells,) points of pulses with several returns.
        seen: (cells,) index of a cell's first point.
    """
    west, south, cell_m = corner
    rows, columns = shape
    for i in range(len(points_t)):
        x, y, z = points_t[i, 0], points_t[i, 1], points_t[i, 2]
        if not (x == x and y == y and z == z):
            continue
        u, v = (x - west) / cell_m, (y - south) / cell_m
        column, row = math.floor(u), math.floor(v)
        if column < 0 or row < 0 or column >= columns or row >= rows:
            continue
        at = row * columns + column
        if returns[i] > _ONE_RETURN:
            several[at] += 1
            continue
        sums = moments[at]
        if sums[0] == 0.0:
            base[at] = z
            seen[at] = first + i
        x, y, z = (u - column - 0.5) * cell_m, (v - row - 0.5) * cell_m, z - base[at]
        sums[0] += 1.0
        sums[1] += x
        sums[2] += y
        sums[3] += z
        sums[4] += x * x
        sums[5] += x * y
        sums[6] += x * z
        sums[7] += y * y
        sums[8] += y * z
        sums[9] += z * z


@jit_cached
def fit_cells(
    moments: FloatArray,
    base: FloatArray,
    several: Int32Array,
    corner: tuple[float, float, float],
    columns: int,
    limits: tuple[float, float, float, float],
    normal: FloatArray,
    rms_m: FloatArray,
    what: ByteArray,
) -> None:
    """Fit planes to the cells; sums become moments, in the grid's coordinates.

    Args:
        moments, base, several: of `accumulate`.
        corner, columns: of the grid.
        limits: least points of a cell with a direction, share of points of pulses with several returns, greatest rms in
            metres, least n_z.
        normal: (cells, 3) unit.
        rms_m: (cells,) of the points from their plane.
        what: (cells,) EMPTY … GOOD.
    """
    west, south, cell_m = corner
    least_points, share, rough_m, level = limits
    for at in range(len(base)):
        sums = moments[at]
        n = sums[0]
        if n + several[at] == 0.0:
            what[at] = EMPTY
            continue
        if several[at] > share * (n + several[at]):
            what[at] = SEVERAL
            continue
        if n < THIN_POINTS:
            what[at] = FEW
            continue
        x, y, z = sums[1] / n, sums[2] / n, sums[3] / n
        sums[4] -= n * x * x
        sums[5] -= n * x * y
        sums[6] -= n * x * z
        sums[7] -= n * y * y
        sums[8] -= n * y * z
        sums[9] -= n * z * z
        sums[1] = x + west + (at % columns + 0.5) * cell_m
        sums[2] = y + south + (at // columns + 0.5) * cell_m
        sums[3] = z + base[at]
        squares, normal[at, 0], normal[at, 1], normal[at, 2] = smallest(
            sums[4], sums[5], sums[6], sums[7], sums[8], sums[9]
        )
        spread = math.sqrt(max(shorter_axis(sums, squares), 0.0) / n)
        rms_m[at] = math.sqrt(max(squares, 0.0) / max(n - 3.0, 1.0))
        if n < least_points or spread < THIN_SPREAD * cell_m:
            what[at] = THIN
        elif rms_m[at] > rough_m:
            what[at] = ROUGH
        elif normal[at, 2] < level:
            what[at] = WALL
        else:
            what[at] = GOOD


@jit_inline
def _joined(one: FloatArray, more: FloatArray) -> None:
    """Merge the moments of two sets of points into the first (Chan, Golub and LeVeque 1983)."""
    n, m = one[0], more[0]
    x, y, z = more[1] - one[1], more[2] - one[2], more[3] - one[3]
    share = m / (n + m)
    weight = n * share
    one[0] = n + m
    one[1] += share * x
    one[2] += share * y
    one[3] += share * z
    one[4] += more[4] + weight * x * x
    one[5] += more[5] + weight * x * y
    one[6] += more[6] + weight * x * z
    one[7] += more[7] + weight * y * y
    one[8] += more[8] + weight * y * z
    one[9] += more[9] + weight * z * z


@jit_inline
def _fits(
    cell: FloatArray, region: FloatArray, plane: FloatArray, doubt: float, rough_m: float, sigma_m: float
) -> bool:
    """Return whether a cell's points lie on a region's plane (3,), both all of them together and their mean.

    The plane's direction is itself uncertain (``doubt``, rad), which matters more for more distant cells.
    """
    u, v, w = cell[1] - region[1], cell[2] - region[2], cell[3] - region[3]
    x, y, z = plane[0], plane[1], plane[2]
    n, off = cell[0], x * u + y * v + z * w
    beyond = 3.0 * doubt * math.sqrt(u * u + v * v + w * w)
    if abs(off) > 3.0 * sigma_m / math.sqrt(n) + 0.01 + beyond:
        return False
    squares = x * x * cell[4] + y * y * cell[7] + z * z * cell[9]
    squares += 2.0 * (x * y * cell[5] + x * z * cell[6] + y * z * cell[8])
    off = max(abs(off) - beyond, 0.0)
    on_it: bool = squares / n + off * off <= rough_m * rough_m
    return on_it


@jit_inline
def _refitted(region: FloatArray, plane: FloatArray, sigma_m: float) -> float:
    """Refit the region's plane, and return the sigma of its direction, rad, from its spread along its shorter axis."""
    least, plane[0], plane[1], plane[2] = smallest(region[4], region[5], region[6], region[7], region[8], region[9])
    return sigma_m / math.sqrt(max(shorter_axis(region, least), 1e-6))


@jit_cached
def grow(
    order: Int64Array,
    what: ByteArray,
    moments: FloatArray,
    normal: FloatArray,
    shape: tuple[int, int],
    tiles: tuple[int, int, int],
    limits: tuple[float, float, float, float],
    label: Int32Array,
    regions: FloatArray,
) -> int:
    """Grow planes from good cells, best first, over their eight neighbours.

    A plane that cannot grow further is refitted and tried again at all its cells, until no cell joins. Level planes end
    at the grid's tiles, so that all swaths cut the ground alike; steep ones end at their edges. A plane counts as level
    until, at the end of its growth, it is significantly steep, and again when it no longer is. Otherwise a plane that
    began in a cell that looks steeper than it is could spread over all the ground of its swath.

    Args:
        order: good cells, in the order in which planes begin.
        what, moments, normal: of `fit_cells`.
        shape: rows, columns.
        tiles: cells per tile, column and row in the tiles' grid of the corner.
        limits: greatest rms and sigma of a return in metres, cosine between normals, least n_z of level planes.
        label: (cells,) −1; becomes the plane's number.
        regions: (k, 10) room for moments of the planes.

    Returns:
        The number of planes.
    """
    rows, columns = shape
    tile, east, north = tiles
    rough_m, sigma_m, alike, level = limits
    members = np.empty(len(what), np.int64)
    plane = np.empty(3)
    count = 0
    for seed in order:
        if label[seed] >= 0 or count == len(regions):
            continue
        region = regions[count]
        region[:] = moments[seed]
        doubt = _refitted(region, plane, sigma_m)
        flat = True
        home_column, home_row = (seed % columns + east) // tile, (seed // columns + north) // tile
        label[seed] = count
        fitted, size, begun, at_last, members[0] = region[0], 1, 0, 0, seed
        while True:
            if begun == size:
                if size == at_last:
                    break
                at_last, begun = size, 0
                doubt, fitted = _refitted(region, plane, sigma_m), region[0]
                flat = plane[2] >= math.cos(math.acos(level) + _SURELY * doubt)
            here = members[begun]
            begun += 1
            row, column = here // columns, here % columns
            for beside_row in range(max(row - 1, 0), min(row + 2, rows)):
                for beside_column in range(max(column - 1, 0), min(column + 2, columns)):
                    at = beside_row * columns + beside_column
                    if label[at] >= 0 or what[at] < THIN:
                        continue
                    if flat and (
                        (beside_column + east) // tile != home_column or (beside_row + north) // tile != home_row
                    ):
                        continue
                    cosine = plane[0] * normal[at, 0] + plane[1] * normal[at, 1] + plane[2] * normal[at, 2]
                    if (what[at] == GOOD and cosine < alike) or not _fits(
                        moments[at], region, plane, doubt, rough_m, sigma_m
                    ):
                        continue
                    label[at] = count
                    _joined(region, moments[at])
                    members[size] = at
                    size += 1
                    if region[0] > _REFIT_SHARE * fitted:
                        doubt, fitted = _refitted(region, plane, sigma_m), region[0]
                        flat = flat or plane[2] >= level
        count += 1
    return count


@jit_inline
def _slot(key: int, mask: int) -> int:
    """Return the first slot of a key: Fibonacci hashing (Knuth, The Art of Computer Programming 3, 6.4)."""
    slot: int = ((key * _GOLDEN) >> _HIGH) & mask
    return slot


@jit_cached
def fill_table(keys: Int64Array, labels: Int32Array, table_keys: Int64Array, table_labels: Int32Array) -> None:
    """Fill a hash table of labels by key (open addressing); its size is a power of two, empty slots have label −1."""
    mask = len(table_keys) - 1
    for i in range(len(keys)):
        at = _slot(keys[i], mask)
        while table_labels[at] >= 0 and table_keys[at] != keys[i]:
            at = (at + 1) & mask
        table_keys[at], table_labels[at] = keys[i], labels[i]


@jit_cached
def gather(
    points_t: FloatArray,
    returns: ByteArray,
    first: int,
    cell_m: float,
    table_keys: Int64Array,
    table_labels: Int32Array,
    planes: FloatArray,
    at: Int64Array,
    label: Int32Array,
) -> int:
    """Collect single returns in cells of a table that lie near the plane of their cell.

    Args:
        points_t, returns, first: as in `accumulate`.
        cell_m: metres per cell of the keys (`cell_key`).
        table_keys, table_labels: of `fill_table`.
        planes: (k, 5) normal, its product with points on the plane, greatest distance.
        at, label: (n,) room for the results, indexes in the swath and labels.

    Returns:
        The number of collected returns.
    """
    found = 0
    mask = len(table_keys) - 1
    for i in range(len(points_t)):
        if returns[i] > _ONE_RETURN:
            continue
        x, y, z = points_t[i, 0], points_t[i, 1], points_t[i, 2]
        if not (x == x and y == y and z == z):
            continue
        key = (math.floor(y / cell_m) << 32) + math.floor(x / cell_m)
        slot = _slot(key, mask)
        while table_labels[slot] >= 0 and table_keys[slot] != key:
            slot = (slot + 1) & mask
        one = table_labels[slot]
        if one < 0:
            continue
        plane = planes[one]
        if abs(plane[0] * x + plane[1] * y + plane[2] * z - plane[3]) <= plane[4]:
            at[found], label[found] = first + i, one
            found += 1
    return found
