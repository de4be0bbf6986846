"""Planes of the ground in cubes of space, from the points themselves (least squares; moments of each cube).

A table holds cubes of two sizes, L and 4L, each with the number, sums and products of the coordinates of its
points. A plane is fitted when the first point asks for it. Coordinates are whole units of 1/1024 m, so that sums are
exact: planes depend on the points, and not on their order or their division into pieces.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from swath.georef.arrays import ByteArray, FloatArray, Int64Array, SingleArray
from swath.georef.compiled import jit_cached, jit_inline, whole
from swath.georef.scanner.kernels.types import Three

LEVELS, STEP = 2, 2  # sizes of cubes; bits from one to the next
LEAST_POINTS = 8
MOST_TILT_2 = 0.05**2  # rad²: variance of a plane's tilt beyond which a larger cube is tried
MOST_THICK_2 = 0.12**2  # of the thickness over the extent: points that are thicker have no plane, ...
MOST_NOISE_2 = 1.5**2  # ... unless the noise alone makes them so thick
REACH_2 = 16.0  # a point within four sigmas of a plane lies on it
STEEPEST_RAD = math.radians(80.0)
STEEPEST_COS_2 = math.cos(STEEPEST_RAD) ** 2
STEEPEST_TAN_2 = math.tan(STEEPEST_RAD) ** 2
ROUGHEST_TAN_2 = 4.0  # of the slope in a cube whose points lie on no plane; as where they fill it evenly
LEVEL_GROUND, PLANE, ROUGH = 1, 2, 3  # of `Points.surface`
UNIT_M = 2.0**-10
MOMENTS = 10  # n, x y z, xx xy xz yy yz zz, whole units from the centre of the cube of size 4L
# Columns of a plane: unit normal; centre of the points; their variance across the plane; one over that along its
# shorter axis, and the same over their number, both 0 where they are too few; 1 if fitted, 0 if points came since
NORMAL, MEAN, THICK, PER_BROAD, TILT, FITTED = 0, 3, 6, 7, 8, 9
WIDTH = 10
_OFFSET, _MASK = 1 << 19, (1 << 20) - 1
_ABSENT, _NONE, _TOP = whole(-1), whole(0), whole(STEP * (LEVELS - 1))
_FACTOR, _DOWN = np.uint64(0x9E3779B97F4A7C15), np.uint64(31)  # 2⁶⁴ / golden ratio: spreads keys that follow each other


class Cubes(NamedTuple):
    """The table of cubes.

    Attributes:
        slots: hash table of rows; −1: free. Its length is a power of two.
        keys, last_ns: (k,) size and place of a cube; time of its last point.
        moments, planes: (k, …) as above.
        origin_m: (3,) from which places count.
        shift: L is 2^shift units.
    """

    slots: NDArray[np.int32]
    keys: Int64Array
    last_ns: Int64Array
    moments: Int64Array
    planes: FloatArray
    origin_m: FloatArray
    shift: int


class Beam(NamedTuple):
    """What a scanner's ranges and angles are worth, as in `swath.georef.scanner.uncertainty.Noise`."""

    range_variance: float
    angle_variance: float
    quarter_rad: float  # of the full divergence


def new_cubes(rows: int, origin_m: FloatArray, shift: int) -> Cubes:
    """Return an empty table with room for a number of cubes, a power of two."""
    return Cubes(
        np.full(4 * rows, -1, np.int32),
        np.empty(rows, np.int64),
        np.empty(rows, np.int64),
        np.zeros((rows, MOMENTS), np.int64),
        np.zeros((rows, WIDTH)),
        origin_m,
        shift,
    )


@jit_inline
def key_of(level: int, i: int, j: int, k: int) -> int:
    """Return the key of a cube."""
    return (level << 60) | ((i + _OFFSET) & _MASK) << 40 | ((j + _OFFSET) & _MASK) << 20 | ((k + _OFFSET) & _MASK)


@jit_inline
def slot_of(key: int, cubes: Cubes) -> int:
    """Return the slot of a key, or the free one where it belongs."""
    mask = len(cubes.slots) - 1
    unsigned = np.uint64(key)  # a signed product must not overflow
    mixed = (unsigned ^ (unsigned >> _DOWN)) * _FACTOR
    slot: Any = np.int64((mixed ^ (mixed >> _DOWN)) & np.uint64(mask))
    while cubes.slots[slot] >= 0 and cubes.keys[cubes.slots[slot]] != key:
        slot = (slot + 1) & mask
    return int(slot)


@jit_inline
def row_of(key: int, cubes: Cubes) -> int:
    """Return the row of a cube; −1: there is none."""
    return int(cubes.slots[slot_of(key, cubes)])


@jit_inline
def whole_units(metres: float) -> Any:
    """Return a coordinate in whole units."""
    return np.int64(np.rint(metres * (1.0 / UNIT_M)))


@jit_inline
def put_run(cubes: Cubes, count: int, place: Any, time_ns: int, run: Any) -> int:
    """Add the moments of points of one smallest cube to it and to the larger ones; return the number of cubes."""
    i, j, k = place
    for level in range(LEVELS):
        down = STEP * level
        key = key_of(level, i >> down, j >> down, k >> down)
        slot = slot_of(key, cubes)
        row = cubes.slots[slot]
        if row < 0:
            row = count
            cubes.slots[slot], cubes.keys[row] = row, key
            cubes.moments[row, :] = 0
            count += 1
        cubes.last_ns[row], cubes.planes[row, FITTED] = time_ns, 0.0
        moments = cubes.moments[row]
        for column in range(MOMENTS):
            moments[column] += run[column]
    return count


@jit_cached
def add_points(
    cubes: Cubes, count: int, points_map: FloatArray, unit_m: FloatArray, time_ns: int, first: int
) -> tuple[int, int]:
    """Add points from row ``first`` on; return the number of cubes, and the row where the table was full."""
    x0, y0, z0 = cubes.origin_m
    room, shift = len(cubes.keys) - LEVELS, cubes.shift
    half = 1 << (shift + _TOP - 1)
    mask = 2 * half - 1
    place, held = (_NONE, _NONE, _NONE), False
    n = sx = sy = sz = xx = xy = xz = yy = yz = zz = _NONE
    for at in range(first, len(points_map)):
        x = whole_units(points_map[at, 0] * unit_m[0] - x0)
        y = whole_units(points_map[at, 1] * unit_m[1] - y0)
        z = whole_units(points_map[at, 2] * unit_m[2] - z0)
        i, j, k = x >> shift, y >> shift, z >> shift
        if not held or i != place[0] or j != place[1] or k != place[2]:
            if held:
                count = put_run(cubes, count, place, time_ns, (n, sx, sy, sz, xx, xy, xz, yy, yz, zz))
            if count > room:
                return count, at
            place, held = (i, j, k), True
            n = sx = sy = sz = xx = xy = xz = yy = yz = zz = _NONE
        a, b, c = (x & mask) - half, (y & mask) - half, (z & mask) - half
        n, sx, sy, sz = n + 1, sx + a, sy + b, sz + c
        xx, xy, xz, yy, yz, zz = xx + a * a, xy + a * b, xz + a * c, yy + b * b, yz + b * c, zz + c * c
    if held:
        count = put_run(cubes, count, place, time_ns, (n, sx, sy, sz, xx, xy, xz, yy, yz, zz))
    return count, len(points_map)


@jit_inline
def least_axis(xx: float, xy: float, xz: float, yy: float, yz: float, zz: float) -> tuple[float, float, Three]:
    """Return the two smaller eigenvalues of a symmetric matrix, and the unit vector of the smallest.

    The eigenvalues are the roots of the characteristic cubic by its trigonometric solution; the vector is across two
    rows of A − λ.
    """
    mean = (xx + yy + zz) / 3.0
    a, b, c = xx - mean, yy - mean, zz - mean
    spread = math.sqrt((a * a + b * b + c * c + 2.0 * (xy * xy + xz * xz + yz * yz)) / 6.0)
    if not spread > 0.0:
        return mean, mean, (0.0, 0.0, 1.0)
    half = (a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz)) / (2.0 * spread**3)
    phi = math.acos(min(1.0, max(-1.0, half))) / 3.0
    largest = mean + 2.0 * spread * math.cos(phi)
    smallest = mean + 2.0 * spread * math.cos(phi + 2.0 * math.pi / 3.0)
    a, b, c = xx - smallest, yy - smallest, zz - smallest
    u = xy * yz - xz * b, xz * xy - a * yz, a * b - xy * xy
    v = xy * c - xz * yz, xz * xz - a * c, a * yz - xy * xz
    w = b * c - yz * yz, yz * xz - xy * c, xy * yz - b * xz
    uu, vv, ww = (
        u[0] * u[0] + u[1] * u[1] + u[2] * u[2],
        v[0] * v[0] + v[1] * v[1] + v[2] * v[2],
        w[0] * w[0] + w[1] * w[1] + w[2] * w[2],
    )
    if vv > uu:
        u, uu = v, vv
    if ww > uu:
        u, uu = w, ww
    if not uu > 0.0:
        return smallest, 3.0 * mean - largest - smallest, (0.0, 0.0, 1.0)
    per = 1.0 / math.sqrt(uu)
    return max(smallest, 0.0), 3.0 * mean - largest - smallest, (u[0] * per, u[1] * per, u[2] * per)


@jit_inline
def fit(cubes: Cubes, row: int) -> None:
    """Fit the plane of a cube."""
    m, plane = cubes.moments[row], cubes.planes[row]
    n = float(m[0])
    plane[FITTED], plane[PER_BROAD], plane[TILT] = 1.0, 0.0, 0.0
    if n < LEAST_POINTS:
        return
    per = UNIT_M / n
    x, y, z = m[1] * per, m[2] * per, m[3] * per
    per *= UNIT_M
    thin, broad, normal = least_axis(
        m[4] * per - x * x,
        m[5] * per - x * y,
        m[6] * per - x * z,
        m[7] * per - y * y,
        m[8] * per - y * z,
        m[9] * per - z * z,
    )
    key = cubes.keys[row]
    up, size = _TOP - STEP * (key >> 60), UNIT_M * 2.0 ** (cubes.shift + _TOP)
    plane[NORMAL], plane[NORMAL + 1], plane[NORMAL + 2] = normal
    plane[MEAN] = x + (((((key >> 40) & _MASK) - _OFFSET) >> up) + 0.5) * size
    plane[MEAN + 1] = y + (((((key >> 20) & _MASK) - _OFFSET) >> up) + 0.5) * size
    plane[MEAN + 2] = z + ((((key & _MASK) - _OFFSET) >> up) + 0.5) * size
    plane[THICK] = thin * n / (n - 3.0)
    if broad > 0.0:
        plane[PER_BROAD], plane[TILT] = 1.0 / broad, 1.0 / (broad * n)


@jit_inline
def tan2_on(
    cubes: Cubes, row: int, p: Three, u: Three, per_length2: float, distance_m: float, beam: Beam, compared: bool
) -> tuple[float, float, float]:
    """Return how far a point lies off a cube's plane, in squared sigmas, tan² and cos² of the incidence there.

    tan² contains the plane's doubt: the variance of its tilt, and the slope of the ridge or step that thickness beyond
    the noise may be. The first is infinite where there is no plane that is sure enough, or the point is not on it; tan²
    is then that of slopes in the cube, −1 if it has too few points to tell.
    """
    nothing = math.inf, -1.0, 0.0
    if row < 0:
        return nothing
    plane = cubes.planes[row]
    if plane[FITTED] == 0.0:
        fit(cubes, row)
    if plane[TILT] == 0.0:
        return nothing
    cos = plane[NORMAL] * u[0] + plane[NORMAL + 1] * u[1] + plane[NORMAL + 2] * u[2]
    true2 = cos * cos * per_length2
    cos2 = min(1.0, max(true2, STEEPEST_COS_2))
    sin2 = 1.0 - cos2
    foot2 = (beam.quarter_rad * beam.quarter_rad + beam.angle_variance) * distance_m * distance_m
    noise = beam.range_variance * cos2 + foot2 * sin2
    thick, per_broad = max(plane[THICK], noise), plane[PER_BROAD]
    tilt2 = thick * plane[TILT]
    a, b, c = p[0] - plane[MEAN], p[1] - plane[MEAN + 1], p[2] - plane[MEAN + 2]
    off = plane[NORMAL] * a + plane[NORMAL + 1] * b + plane[NORMAL + 2] * c
    off2, expected2 = off * off, thick + tilt2 * (a * a + b * b + c * c)
    too_thick = plane[THICK] > MOST_NOISE_2 * noise and plane[THICK] * per_broad > MOST_THICK_2
    if too_thick or off2 > REACH_2 * expected2:
        return math.inf, min(ROUGHEST_TAN_2, max(4.0 * plane[THICK], off2) * per_broad), 0.0
    rough2 = 4.0 * max(plane[THICK] - noise, 0.0) * per_broad
    per2 = 1.0 / cos2
    tan2 = sin2 * per2 + tilt2 * per2 * per2 + rough2
    if tilt2 > MOST_TILT_2:
        return math.inf, tan2, 0.0
    return off2 / expected2 if compared else 0.0, tan2, true2


@jit_cached
def find_planes(
    cubes: Cubes,
    points_map: FloatArray,
    unit_m: FloatArray,
    beam_map: SingleArray,
    range_m: SingleArray,
    beam: Beam,
    tan2: SingleArray,
    incidence_rad: SingleArray,
    surface: ByteArray,
) -> int:
    """Fill tan², incidence and kind of surface of points (n,); return the number whose incidence is beyond 80°.

    Incidences have no rows where they are not wanted.

    A point's plane is that of its own cube of size L, or of the one of its three nearest neighbours that it fits best,
    or of its cube of size 4L. Where it lies on none of these, the ground is taken as level, with a slope added
    that is as large as the smallest of its cubes that has points enough allows.
    """
    x0, y0, z0 = cubes.origin_m
    shift, half = cubes.shift, 1 << (cubes.shift - 1)
    mask = 2 * half - 1
    steep = 0
    held, row = _ABSENT, _ABSENT
    for at in range(len(points_map)):
        u = float(beam_map[at, 0]), float(beam_map[at, 1]), float(beam_map[at, 2])
        per_length2 = 2.0 - (u[0] * u[0] + u[1] * u[1] + u[2] * u[2])  # the map's scale is 1, within a few thousandths
        p = points_map[at, 0] * unit_m[0] - x0, points_map[at, 1] * unit_m[1] - y0, points_map[at, 2] * unit_m[2] - z0
        distance = float(range_m[at])
        x, y, z = whole_units(p[0]), whole_units(p[1]), whole_units(p[2])
        i, j, k = x >> shift, y >> shift, z >> shift
        key = key_of(0, i, j, k)
        if key != held:
            held, row = key, row_of(key, cubes)
        away2, found, cos2 = tan2_on(cubes, row, p, u, per_length2, distance, beam, False)
        if away2 == math.inf:
            rough2 = found
            beside = (
                key_of(0, i + (1 if x & mask >= half else -1), j, k),
                key_of(0, i, j + (1 if y & mask >= half else -1), k),
                key_of(0, i, j, k + (1 if z & mask >= half else -1)),
            )
            for near in beside:
                other = tan2_on(cubes, row_of(near, cubes), p, u, per_length2, distance, beam, True)
                if other[0] < away2:
                    away2, found, cos2 = other
            for level in range(1, LEVELS):
                if away2 == math.inf:
                    down = STEP * level
                    larger = key_of(level, i >> down, j >> down, k >> down)
                    away2, found, cos2 = tan2_on(cubes, row_of(larger, cubes), p, u, per_length2, distance, beam, False)
                    if rough2 < 0.0:
                        rough2 = found
        surface[at] = PLANE
        if away2 == math.inf:
            surface[at], cos2 = ROUGH if rough2 >= 0.0 else LEVEL_GROUND, u[2] * u[2] * per_length2
            found = (1.0 - cos2) / cos2 + max(rough2, 0.0)
        if len(incidence_rad):
            incidence_rad[at] = math.acos(min(1.0, math.sqrt(cos2)))
        if not cos2 >= STEEPEST_COS_2:
            steep += 1
        tan2[at] = found if found < STEEPEST_TAN_2 else STEEPEST_TAN_2
    return steep


@jit_cached
def on_level_ground(beam_map: SingleArray, tan2: SingleArray, incidence_rad: SingleArray, surface: ByteArray) -> int:
    """Fill tan², incidence and kind of surface for level ground; return the number whose incidence is beyond 80°."""
    steep = 0
    for at in range(len(beam_map)):
        x, y, z = beam_map[at, 0], beam_map[at, 1], beam_map[at, 2]
        cos2 = float(z * z) / float(x * x + y * y + z * z)
        surface[at] = LEVEL_GROUND
        if len(incidence_rad):
            incidence_rad[at] = math.acos(min(1.0, math.sqrt(cos2)))
        if not cos2 >= STEEPEST_COS_2:
            steep += 1
            cos2 = STEEPEST_COS_2
        tan2[at] = (1.0 - cos2) / cos2
    return steep


@jit_cached
def add_along_beams(
    tan2: SingleArray,
    range_m: SingleArray,
    beam_map: SingleArray,
    beam: Beam,
    sigma_map: SingleArray,
    covariance_map: SingleArray,
    range_sigma_m: SingleArray,
) -> None:
    """Add the footprint's variance, (quarter · ρ)² tan² i, along the beams to sigmas, covariances and the range's.

    Covariances and range sigmas have no rows where they are not wanted.
    """
    for at in range(len(tan2)):
        side = beam.quarter_rad * range_m[at]
        variance = side * side * tan2[at]
        x, y, z = float(beam_map[at, 0]), float(beam_map[at, 1]), float(beam_map[at, 2])
        a, b, c = float(sigma_map[at, 0]), float(sigma_map[at, 1]), float(sigma_map[at, 2])
        sigma_map[at, 0] = math.sqrt(a * a + variance * x * x)
        sigma_map[at, 1] = math.sqrt(b * b + variance * y * y)
        sigma_map[at, 2] = math.sqrt(c * c + variance * z * z)
        if len(covariance_map):
            covariance_map[at, 0] += variance * x * x
            covariance_map[at, 1] += variance * x * y
            covariance_map[at, 2] += variance * x * z
            covariance_map[at, 3] += variance * y * y
            covariance_map[at, 4] += variance * y * z
            covariance_map[at, 5] += variance * z * z
        if len(range_sigma_m):
            range_sigma_m[at] = math.sqrt(beam.range_variance + variance)


@jit_cached
def moved_over(old: Cubes, count: int, since_ns: int, new: Cubes) -> int:
    """Copy the cubes with points since a time to an empty table; return their number."""
    kept = 0
    for row in range(count):
        if old.last_ns[row] < since_ns:
            continue
        new.slots[slot_of(old.keys[row], new)] = kept
        new.keys[kept], new.last_ns[kept] = old.keys[row], old.last_ns[row]
        for column in range(MOMENTS):
            new.moments[kept, column] = old.moments[row, column]
        for column in range(WIDTH):
            new.planes[kept, column] = old.planes[row, column]
        kept += 1
    return kept
