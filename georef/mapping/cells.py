"""Approximate a map by expansions over cubes of space: 15 ns a point where PROJ takes 300 ns, within 0.1 mm.

Cubes of 1024 m fill e, each halved as often as needed down to 16 m. A cube holds the map's value at its centre and the
first and second derivatives, from 19 exact values, and is checked against 72 more when it is made. Where even 16 m are
too large (a grid's edge, a crease of a coarse geoid), its points are mapped exactly, one by one. A cube depends on its
place alone, so a point's result does not depend on the points before it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from swath.georef.arrays import FloatArray, Int64Array, SingleArray
from swath.georef.compiled import jit_cached, jit_inline

Exact = Callable[[FloatArray], FloatArray]

APPROXIMATION_M = 1e-4
TOLERANCE_M = 3e-5  # a crease between the checked points can hide 2.4 times the error that they show
ROOT_M = 1024.0
LEVELS = 6
CELLS_KEPT = 100_000
CELLS_AT_ONCE = 512
BLOCK = 16_384
REACH_M = 8_388_608.0
LEAF, SPLIT, EXACT = 0, 1, 2
WIDTH = 34
CENTRE, HALF, VALUE, FIRST, SECOND = slice(0, 3), 3, slice(4, 7), slice(7, 16), slice(16, 34)

_OFFSET = 1 << 19
_MASK = (1 << 20) - 1
_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
_ABSENT, _BEYOND = -1, -2


def _stencil() -> FloatArray:
    """Return the centre, the faces' and the edges' centres of a cube of half size 1: (19, 3)."""
    lattice = np.array(list(itertools.product((0.0, -1.0, 1.0), repeat=3)))
    stencil: FloatArray = lattice[np.count_nonzero(lattice, axis=1) <= 2]
    return stencil


def _checks() -> FloatArray:
    """Return the points (72, 3) at which a cube is checked: its corners and a lattice inside.

    At the corners the neglected third order is largest and a crease cannot hide.
    """
    corners = itertools.product((-1.0, 1.0), repeat=3)
    inside = itertools.product((-0.75, -0.25, 0.25, 0.75), repeat=3)
    return np.array([*corners, *inside])


STENCIL, CHECKS = _stencil(), _checks()


def _index(offset: FloatArray) -> int:
    return int(np.flatnonzero(np.all(offset == STENCIL, axis=1))[0])


_AXIS = np.eye(3)
_PLUS = [_index(_AXIS[i]) for i in range(3)]
_MINUS = [_index(-_AXIS[i]) for i in range(3)]
_CROSS = {
    (i, j): [_index(a * _AXIS[i] + b * _AXIS[j]) for a, b in ((1, 1), (-1, -1), (1, -1), (-1, 1))]
    for i, j in _PAIRS
    if i != j
}


class Mapped(NamedTuple):
    """Coordinates (n, 3), sigmas (n, 3), directions of beams (n, 3), covariances (n, 6); None: not asked for."""

    points_map: FloatArray
    sigma_map: SingleArray | None = None
    beam_map: SingleArray | None = None
    covariance_map: SingleArray | None = None


class MapCells:
    """The cubes made so far, for one map.

    `exact` takes positions in e (n, 3) to map coordinates (n, 3), not finite where it has none; `unit_m` are the metres
    in a unit of each map coordinate; `admit` takes the centres of new cubes (n, 3) and raises where the map must not be
    used; `alone` replaces `exact` for points without a sufficiently accurate cube, and may raise.
    """

    def __init__(
        self, exact: Exact, unit_m: FloatArray, admit: Callable[[FloatArray], None], alone: Exact | None = None
    ) -> None:
        self._exact, self._unit_m, self._admit, self._alone = exact, unit_m, admit, alone or exact
        self._clear()

    def __len__(self) -> int:
        return len(self._node_of)

    def map(self, points_e: FloatArray) -> FloatArray:
        """Map positions in e (n, 3) to coordinates (n, 3); `alone` decides about points that have none."""
        mapped = np.empty((len(points_e), 3))
        for block in _blocks(len(points_e)):
            self._expand(points_e[block], mapped[block])
        return mapped

    def map_with_sigmas(self, points_e: FloatArray, covariance_e: FloatArray) -> tuple[FloatArray, SingleArray]:
        """Return `map`, and sigmas (n, 3) in metres along the map's axes.

        Covariances are (n, 6) in e, xx xy xz yy yz zz.
        """
        mapped = self.map_with_beams(points_e, covariance_e, None)
        assert mapped.sigma_map is not None
        return mapped.points_map, mapped.sigma_map

    def map_with_beams(
        self, points_e: FloatArray, covariance_e: FloatArray, origin_e: FloatArray | None, *, whole: bool = False
    ) -> Mapped:
        """Return `map` with sigmas; the directions of beams from origins (n, 3), if given; covariances, if ``whole``.

        Covariances are (n, 6) in e, xx xy xz yy yz zz.
        """
        n = len(points_e)
        mapped, sigmas = np.empty((n, 3)), np.empty((n, 3), dtype=np.float32)
        beams = None if origin_e is None else np.empty((n, 3), dtype=np.float32)
        covariances = np.empty((n, 6), dtype=np.float32) if whole else None
        for block in _blocks(n):
            nodes = self._expand(points_e[block], mapped[block])
            _project(nodes, covariance_e[block], self._rows, self._unit_m, sigmas[block])
            if beams is not None and origin_e is not None:
                _aim(nodes, origin_e[block], points_e[block], self._rows, self._unit_m, beams[block])
            if covariances is not None:
                _project_whole(nodes, covariance_e[block], self._rows, self._unit_m, covariances[block])
        return Mapped(mapped, sigmas, beams, covariances)

    def _expand(self, points: FloatArray, out: FloatArray) -> NDArray[np.int32]:
        """Fill ``out`` with coordinates, and return the cubes of the points."""
        nodes = self._locate(points)
        if _expand(points, nodes, self._rows, self._kinds, out):
            beyond = (nodes < 0) | (self._kinds[nodes] == EXACT)
            out[beyond] = self._alone(points[beyond])
        return nodes

    def _clear(self) -> None:
        self._node_of: dict[int, int] = {}
        self._rows = np.empty((256, WIDTH))
        self._kinds = np.empty(256, dtype=np.int8)
        self._children = np.full((256, 8), _ABSENT, dtype=np.int32)
        self._table_keys = np.zeros(1024, dtype=np.int64)
        self._table_nodes = np.full(1024, _ABSENT, dtype=np.int32)

    def _locate(self, points: FloatArray) -> NDArray[np.int32]:
        """Return the cube of each point, made if missing; negative for points not near the earth.

        All old cubes are dropped at once, before a block: making the few hundred of one block again costs less than
        tracking their use.
        """
        if len(self._node_of) > CELLS_KEPT:
            self._clear()
        nodes = np.full(len(points), _ABSENT, dtype=np.int32)
        wanted = np.empty(len(points), dtype=np.int64)
        while True:
            absent = _find(
                points, nodes, wanted, self._table_keys, self._table_nodes, self._children, self._kinds, self._rows
            )
            if not absent:
                return nodes
            keys = np.unique(wanted[:absent])
            for start in range(0, len(keys), CELLS_AT_ONCE):
                self._make(keys[start : start + CELLS_AT_ONCE])

    def _make(self, keys: Int64Array) -> None:
        """Make cubes and enter them in the tables."""
        level, corner = keys >> 60, np.stack([(keys >> shift & _MASK) - _OFFSET for shift in (40, 20, 0)], axis=-1)
        size = (ROOT_M / 2.0**level).astype(np.float64)
        centre = (corner + 0.5) * size[:, None]
        self._admit(centre[level == 0])
        first = len(self._node_of)
        self._grow(first + len(keys))
        rows, error_m = expand_cells(self._exact, centre, 0.5 * size, self._unit_m)
        good = error_m <= TOLERANCE_M
        self._rows[first : first + len(keys)] = rows
        self._kinds[first : first + len(keys)] = np.where(good, LEAF, np.where(level < LEVELS, SPLIT, EXACT))
        for i, key in enumerate(keys.tolist()):
            self._node_of[key] = first + i
            if level[i]:
                self._adopt(int(level[i]), corner[i], first + i)
        roots = np.flatnonzero(level == 0)
        if 4 * (self._rooted() + len(roots)) > len(self._table_keys):
            self._rehash()
        else:
            _enter(keys[roots], (first + roots).astype(np.int32), self._table_keys, self._table_nodes)

    def _adopt(self, level: int, corner: Int64Array, node: int) -> None:
        above, octant = corner >> 1, corner & 1
        parent = self._node_of[_packed(level - 1, *above.tolist())]
        self._children[parent, int(octant @ (1, 2, 4))] = node

    def _rooted(self) -> int:
        return int(np.count_nonzero(self._table_nodes >= 0))

    def _rehash(self) -> None:
        roots = [(key, node) for key, node in self._node_of.items() if key >> 60 == 0]
        size = len(self._table_keys)
        while 4 * len(roots) > size:
            size *= 2
        self._table_keys = np.zeros(size, dtype=np.int64)
        self._table_nodes = np.full(size, _ABSENT, dtype=np.int32)
        keys, nodes = np.array(roots, dtype=np.int64).T
        _enter(np.ascontiguousarray(keys), nodes.astype(np.int32), self._table_keys, self._table_nodes)

    def _grow(self, size: int) -> None:
        have = len(self._kinds)
        if size <= have:
            return
        more = max(size, 2 * have) - have
        self._rows = np.concatenate([self._rows, np.empty((more, WIDTH))])
        self._kinds = np.concatenate([self._kinds, np.empty(more, dtype=np.int8)])
        self._children = np.concatenate([self._children, np.full((more, 8), _ABSENT, dtype=np.int32)])


def expand_cells(
    exact: Exact, centre: FloatArray, half_m: FloatArray, unit_m: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return expansions (n, 34) about centres (n, 3), and the largest error in metres (n,) found in each cube.

    Derivatives are central differences over the whole cube; the error is infinite where the map has no value.
    """
    n = len(centre)
    offsets = np.concatenate([STENCIL, CHECKS])
    points = centre[:, None, :] + half_m[:, None, None] * offsets
    values = exact(points.reshape(-1, 3)).reshape(n, len(offsets), 3)
    f, checks = values[:, : len(STENCIL)], values[:, len(STENCIL) :]
    h = half_m[:, None]
    rows = np.empty((n, WIDTH))
    rows[:, CENTRE], rows[:, HALF], rows[:, VALUE] = centre, half_m, f[:, 0]
    first, second = np.empty((n, 3, 3)), np.empty((n, 3, 6))
    with np.errstate(invalid="ignore"):
        for i in range(3):
            first[:, :, i] = (f[:, _PLUS[i]] - f[:, _MINUS[i]]) / (2.0 * h)
        for k, (i, j) in enumerate(_PAIRS):
            if i == j:
                second[:, :, k] = (f[:, _PLUS[i]] - 2.0 * f[:, 0] + f[:, _MINUS[i]]) / (2.0 * h**2)
            else:
                a, b, c, d = _CROSS[i, j]
                second[:, :, k] = (f[:, a] + f[:, b] - f[:, c] - f[:, d]) / (4.0 * h**2)
        rows[:, FIRST], rows[:, SECOND] = first.reshape(n, 9), second.reshape(n, 18)
        squares = np.stack([CHECKS[:, i] * CHECKS[:, j] for i, j in _PAIRS], axis=-1)
        linear = np.einsum("nij,kj->nki", first, CHECKS) * h[:, None]
        curved = np.einsum("nij,kj->nki", second, squares) * h[:, None] ** 2
        error = np.abs(f[:, :1] + linear + curved - checks) * unit_m
    worst = error.reshape(n, -1).max(axis=1)
    return rows, np.where(np.isfinite(worst), worst, np.inf)


def _packed(level: int, i: int, j: int, k: int) -> int:
    return (level << 60) | (i + _OFFSET << 40) | (j + _OFFSET << 20) | (k + _OFFSET)


def _blocks(size: int) -> list[slice]:
    return [slice(start, min(start + BLOCK, size)) for start in range(0, size, BLOCK)]


@jit_inline
def _key_at(level: int, x: float, y: float, z: float) -> int:
    per_m = 2.0**level / ROOT_M
    i, j, k = math.floor(x * per_m), math.floor(y * per_m), math.floor(z * per_m)
    return (level << 60) | (int(i) + _OFFSET << 40) | (int(j) + _OFFSET << 20) | (int(k) + _OFFSET)


@jit_inline
def _slot_of(key: int, size: int) -> int:
    unsigned = np.uint64(key)  # a signed product must not overflow
    mixed = (unsigned ^ (unsigned >> np.uint64(21))) * np.uint64(0x9E3779B1)
    slot: Any = np.int64((mixed ^ (mixed >> np.uint64(17))) & np.uint64(size - 1))
    return int(slot)


@jit_cached
def _enter(keys: Int64Array, nodes: NDArray[np.int32], table_keys: Int64Array, table_nodes: NDArray[np.int32]) -> None:
    for i in range(len(keys)):
        slot = _slot_of(keys[i], len(table_keys))
        while table_nodes[slot] >= 0:
            slot = (slot + 1) & (len(table_keys) - 1)
        table_keys[slot], table_nodes[slot] = keys[i], nodes[i]


@jit_inline
def _descend(
    x: float,
    y: float,
    z: float,
    table_keys: Int64Array,
    table_nodes: NDArray[np.int32],
    children: NDArray[np.int32],
    kinds: NDArray[np.int8],
    rows: FloatArray,
) -> tuple[int, int]:
    """Return the cube of a point and 0, or −1 and the key of the missing cube."""
    key = _key_at(0, x, y, z)
    slot = _slot_of(key, len(table_keys))
    while table_nodes[slot] >= 0 and table_keys[slot] != key:
        slot = (slot + 1) & (len(table_keys) - 1)
    node = table_nodes[slot]
    level = 0
    while node >= 0 and kinds[node] == SPLIT:
        octant = (x >= rows[node, 0]) + 2 * (y >= rows[node, 1]) + 4 * (z >= rows[node, 2])
        node = children[node, octant]
        level += 1
    if node >= 0:
        return node, 0
    return _ABSENT, _key_at(level, x, y, z)


@jit_cached
def _find(
    points: FloatArray,
    nodes: NDArray[np.int32],
    wanted: Int64Array,
    table_keys: Int64Array,
    table_nodes: NDArray[np.int32],
    children: NDArray[np.int32],
    kinds: NDArray[np.int8],
    rows: FloatArray,
) -> int:
    """Fill in `nodes` that are absent and known; list the keys of the others in `wanted`, and return their number."""
    absent = 0
    x0 = x1 = y0 = y1 = z0 = z1 = 0.0
    last = _ABSENT
    for i in range(len(points)):
        if nodes[i] != _ABSENT:
            continue
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        if last >= 0 and x0 <= x < x1 and y0 <= y < y1 and z0 <= z < z1:
            nodes[i] = last
            continue
        if not (abs(x) < REACH_M and abs(y) < REACH_M and abs(z) < REACH_M):
            nodes[i] = _BEYOND
            continue
        node, key = _descend(x, y, z, table_keys, table_nodes, children, kinds, rows)
        if node < 0:
            wanted[absent] = key
            absent += 1
            continue
        last = nodes[i] = node
        half = rows[node, 3]
        x0, y0, z0 = rows[node, 0] - half, rows[node, 1] - half, rows[node, 2] - half
        x1, y1, z1 = rows[node, 0] + half, rows[node, 1] + half, rows[node, 2] + half
    return absent


@jit_inline
def _second_order(row: FloatArray, j: int, x: float, y: float, z: float, squares: tuple[float, ...]) -> float:
    """Return coordinate j of an expansion at x, y, z from its centre."""
    a, b = np.uint64(7 + 3 * j), np.uint64(16 + 6 * j)
    xx, xy, xz, yy, yz, zz = squares
    ones = (np.uint64(1), np.uint64(2), np.uint64(3), np.uint64(4), np.uint64(5))
    first = row[a] * x + row[a + ones[0]] * y + row[a + ones[1]] * z
    pure = row[b] * xx + row[b + ones[2]] * yy + row[b + ones[4]] * zz
    mixed = row[b + ones[0]] * xy + row[b + ones[1]] * xz + row[b + ones[3]] * yz
    value: float = row[np.uint64(4 + j)] + (first + (pure + mixed))
    return value


@jit_cached
def _expand(
    points: FloatArray, nodes: NDArray[np.int32], rows: FloatArray, kinds: NDArray[np.int8], out: FloatArray
) -> int:
    """Evaluate the expansions; return the number of points without one, whose rows stay unchanged."""
    without = 0
    for i in range(len(points)):
        node = nodes[i]
        if node < 0 or kinds[node] == EXACT:
            without += 1
            continue
        row = rows[np.uint64(node)]
        x, y, z = points[i, 0] - row[0], points[i, 1] - row[1], points[i, 2] - row[2]
        squares = (x * x, x * y, x * z, y * y, y * z, z * z)
        out[i, 0] = _second_order(row, 0, x, y, z, squares)
        out[i, 1] = _second_order(row, 1, x, y, z, squares)
        out[i, 2] = _second_order(row, 2, x, y, z, squares)
    return without


@jit_inline
def _sigma(row: FloatArray, j: int, xx: float, xy: float, xz: float, yy: float, yz: float, zz: float) -> float:
    """Return √(g Σ gᵀ), g the first derivatives of coordinate j (law of propagation of variances)."""
    at = np.uint64(7 + 3 * j)
    a, b, c = row[at], row[at + np.uint64(1)], row[at + np.uint64(2)]
    variance = a * (a * xx + 2.0 * (b * xy + c * xz)) + b * (b * yy + 2.0 * c * yz) + c * c * zz
    return math.sqrt(max(variance, 0.0))


@jit_cached
def _project(
    nodes: NDArray[np.int32],
    covariance: FloatArray,
    rows: FloatArray,
    unit_m: FloatArray,
    sigmas: SingleArray,
) -> None:
    """Compute sigmas along the axes of the map; nan beyond the reach of cubes."""
    for i in range(len(nodes)):
        if nodes[i] < 0:
            sigmas[i, 0] = sigmas[i, 1] = sigmas[i, 2] = np.nan
            continue
        row = rows[np.uint64(nodes[i])]
        xx, xy, xz = covariance[i, 0], covariance[i, 1], covariance[i, 2]
        yy, yz, zz = covariance[i, 3], covariance[i, 4], covariance[i, 5]
        sigmas[i, 0] = _sigma(row, 0, xx, xy, xz, yy, yz, zz) * unit_m[0]
        sigmas[i, 1] = _sigma(row, 1, xx, xy, xz, yy, yz, zz) * unit_m[1]
        sigmas[i, 2] = _sigma(row, 2, xx, xy, xz, yy, yz, zz) * unit_m[2]


@jit_inline
def _gradient(row: FloatArray, j: int, unit_m: float) -> tuple[float, float, float]:
    """Return the first derivatives of coordinate j, in metres per metre."""
    at = np.uint64(7 + 3 * j)
    return row[at] * unit_m, row[at + np.uint64(1)] * unit_m, row[at + np.uint64(2)] * unit_m


@jit_cached
def _aim(
    nodes: NDArray[np.int32],
    origin: FloatArray,
    points: FloatArray,
    rows: FloatArray,
    unit_m: FloatArray,
    beams: SingleArray,
) -> None:
    """Compute the change of map coordinates, in metres, along unit vectors from origins to points."""
    for i in range(len(nodes)):
        if nodes[i] < 0:
            beams[i, 0] = beams[i, 1] = beams[i, 2] = np.nan
            continue
        x, y, z = points[i, 0] - origin[i, 0], points[i, 1] - origin[i, 1], points[i, 2] - origin[i, 2]
        per = 1.0 / math.sqrt(x * x + y * y + z * z)
        row = rows[np.uint64(nodes[i])]
        for j in range(3):
            a, b, c = _gradient(row, j, unit_m[j] * per)
            beams[i, j] = a * x + b * y + c * z


@jit_cached
def _project_whole(
    nodes: NDArray[np.int32],
    covariance: FloatArray,
    rows: FloatArray,
    unit_m: FloatArray,
    out: SingleArray,
) -> None:
    """Compute G Σ Gᵀ, G the first derivatives of the map, as ee en eh nn nh hh; nan beyond the reach of cubes."""
    for i in range(len(nodes)):
        if nodes[i] < 0:
            out[i, :] = np.nan
            continue
        row = rows[np.uint64(nodes[i])]
        xx, xy, xz = covariance[i, 0], covariance[i, 1], covariance[i, 2]
        yy, yz, zz = covariance[i, 3], covariance[i, 4], covariance[i, 5]
        at = 0
        for j in range(3):
            a, b, c = _gradient(row, j, unit_m[j])
            x, y, z = xx * a + xy * b + xz * c, xy * a + yy * b + yz * c, xz * a + yz * b + zz * c
            for k in range(j, 3):
                a, b, c = _gradient(row, k, unit_m[k])
                out[i, at] = a * x + b * y + c * z
                at += 1
