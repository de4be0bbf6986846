"""Compute the effect of air on rays: the speed of light in it, and how it bends them.

Returns are processed in blocks, step by step: steps without a branch or a table are compiled for several returns at
once, and the block stays in the nearest cache. Profiles over height are tables of cubics: cell i holds heights from
FLOOR_M + i·STEP_M, and its polynomial runs in the share of the cell, 0 … 1. Beyond the table, 1 km below the sea and 20
km above it, the model has no air.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.special import roots_jacobi

from swath.georef.arrays import FloatArray
from swath.georef.compiled import jit_cached, jit_inline
from swath.georef.geodesy.earth import A_M, B_M, E2, EP2

FLOOR_M, STEP_M, CELLS = -1000.0, 250.0, 84
TOP_M = FLOOR_M + STEP_M * CELLS
STRAIGHT, ARDC, SPHERICAL = 0, 1, 2
FLATTEST_COS = math.cos(math.radians(80.0))  # limit for ARDC's tangent: flatter beams are bent like a beam at 80°
LEVEL_M = 0.01  # over a path that descends by less, the middle gives the mean
BLOCK = 128

# Rows of a block: origin; direction (the point before); up, ellipsoidal height and radius of curvature at the origin;
# cosine of the nadir angle; the given range; the range in air; Δd / sin α; the height reached; value and integral of
# the group refractivity at the origin and at the height reached; the part of the range that is corrected
(
    OX,
    OY,
    OZ,
    UX,
    UY,
    UZ,
    NX,
    NY,
    NZ,
    SENSOR,
    RADIUS,
    COS,
    SAID,
    LENGTH,
    TURNED,
    GROUND,
    TOP_VALUE,
    TOP_SUM,
    VALUE,
    SUM,
) = range(20)
TRAVELLED, ROWS = 20, 21

# Gauss-Jacobi: ∫ (1 − t) f(t) dt over 0 … 1 is exact for polynomials of degree 7
_roots, _weights = roots_jacobi(4, 1.0, 0.0)
NODES, WEIGHTS = 0.5 * (1.0 + _roots), 0.25 * _weights


@jit_inline
def vertical_of(x: float, y: float, z: float) -> tuple[float, float, float, float, float]:
    """Return the ellipsoid's normal (up, in e), height above it and its mean radius of curvature at an ECEF position.

    One step of Bowring (FORMULAS 1.2) without a trigonometric function: 1e-10 rad and 1e-9 m up to 20 km of height.
    """
    flat = math.sqrt(x * x + y * y)
    high, wide = A_M * z, B_M * flat
    scale = 1.0 / math.sqrt(high * high + wide * wide)
    sin, cos = high * scale, wide * scale
    high, wide = z + EP2 * B_M * sin * sin * sin, flat - E2 * A_M * cos * cos * cos
    scale = 1.0 / math.sqrt(high * high + wide * wide)
    sin, cos = high * scale, wide * scale
    bulge = 1.0 - E2 * sin * sin
    height = flat * cos + z * sin - A_M * math.sqrt(bulge)
    out = cos / max(flat, 1e-9)
    return x * out, y * out, sin, height, B_M / bulge


@jit_inline
def cell_of(height_m: float) -> tuple[int, float]:
    """Return the cell of a height and the share of it that lies below; not-a-number is treated as low."""
    if not height_m > FLOOR_M:
        return 0, 0.0
    if height_m >= TOP_M:
        return CELLS - 1, 1.0
    place = (height_m - FLOOR_M) / STEP_M
    cell = int(place)
    return cell, place - cell


@jit_inline
def value_of(table: FloatArray, height_m: float) -> float:
    """Return the refractivity at a height; columns 0 to 3 of the table are its cubic's coefficients."""
    cell, x = cell_of(height_m)
    value: float = table[cell, 0] + x * (table[cell, 1] + x * (table[cell, 2] + x * table[cell, 3]))
    return value


@jit_inline
def slope_of(table: FloatArray, height_m: float) -> tuple[float, float]:
    """Return the refractivity and its derivative by height, 1/m."""
    cell, x = cell_of(height_m)
    value = table[cell, 0] + x * (table[cell, 1] + x * (table[cell, 2] + x * table[cell, 3]))
    slope = table[cell, 1] + x * (2.0 * table[cell, 2] + x * 3.0 * table[cell, 3])
    return value, slope / STEP_M


@jit_inline
def sum_of(table: FloatArray, height_m: float) -> tuple[float, float]:
    """Return the refractivity and its integral from the table's floor; column 4 holds it at the floors of the cells."""
    cell, x = cell_of(height_m)
    first, second, third = table[cell, 1] * x, table[cell, 2] * x * x, table[cell, 3] * x * x * x
    value = table[cell, 0] + first + second + third
    return value, table[cell, 4] + STEP_M * x * (table[cell, 0] + first / 2.0 + second / 3.0 + third / 4.0)


@jit_inline
def mean_of(from_m: float, from_sum: float, to_m: float, to_sum: float, value: float) -> float:
    """Return the mean refractivity between heights from the difference of integrals; for a level path ``value``."""
    apart = from_m - to_m
    return (from_sum - to_sum) / apart if abs(apart) > LEVEL_M else value


@jit_inline
def height_along(sensor_m: float, radius_m: float, range_m: float, cos: float) -> float:
    """Return the height reached along a straight line, on the sphere that touches the ellipsoid below the sensor.

    ``cos`` is of the nadir angle. The ellipsoid's other curvatures contribute 3 cm over 10 km, the series 5 µm.
    """
    centre = radius_m + sensor_m - range_m * cos
    across = range_m * range_m * (1.0 - cos * cos)
    return sensor_m - range_m * cos + across / (2.0 * centre) * (1.0 - 0.25 * across / (centre * centre))


@jit_inline
def bent_by_ardc(sensor_m: float, ground_m: float, cos: float) -> float:
    """Return δd / sin α of the ARDC model (NGA Eq. 4, 5): K over the cosine of the nadir angle.

    The model has no air below the sea; it leaves beams above the horizon unchanged.
    """
    upper, lower = 1e-3 * sensor_m, 1e-3 * max(ground_m, 0.0)
    first = upper / (upper * upper - 6.0 * upper + 250.0)
    second = lower * lower / ((lower * lower - 6.0 * lower + 250.0) * upper)
    down = (cos > 0.0) & (upper > lower)
    return 2410e-6 * (first - second) / max(cos, FLATTEST_COS) if down else 0.0


@jit_inline
def bent_by_layers(table: FloatArray, sensor_m: float, radius_m: float, range_m: float, cos: float) -> float:
    """Return δd / sin α in spherical layers: NGA Eq. 6 to 8 as an integral along the path.

    A ray turns by −(n'/n) sin ψ a metre, ψ its angle from the vertical, for which Snell's law holds (Eq. 6); its chord
    leaves the first direction by the integral of that, each metre weighted with the share of the path still to go. This
    holds in any direction, also level or upward, where Eq. 8 is singular. The path lies below the straight line, as if
    its curvature changed evenly along it: 1e-9 rad up to 75° from nadir at 6 km, 70° at 10 km.
    """
    value, slope = slope_of(table, sensor_m)
    last = slope_of(table, height_along(sensor_m, radius_m, range_m, cos))[1]
    sag = 0.5 * (1.0 - cos * cos) * range_m * range_m
    start = (1.0 + value) * (radius_m + sensor_m)
    turned, first = 0.0, slope
    for k in range(len(NODES)):
        share = NODES[k]
        height = height_along(sensor_m, radius_m, share * range_m, cos)
        height += sag * share * share * (first + (last - first) * share / 3.0)
        value, slope = slope_of(table, height)
        index = 1.0 + value
        turned -= WEIGHTS[k] * slope / (index * index * (radius_m + height))
    return turned * start * range_m


@jit_inline
def take(block: FloatArray, origin_e: FloatArray, points_e: FloatArray, start: int, n: int) -> None:
    """Fill a block with n returns."""
    for i in range(n):
        for axis in range(3):
            block[OX + axis, i] = origin_e[start + i, axis]
            block[UX + axis, i] = points_e[start + i, axis]


@jit_inline
def look(block: FloatArray, n: int) -> None:
    """Compute directions, ranges and nadir angles of a block."""
    for i in range(n):
        x, y, z = block[OX, i], block[OY, i], block[OZ, i]
        dx, dy, dz = block[UX, i] - x, block[UY, i] - y, block[UZ, i] - z
        said = math.sqrt(dx * dx + dy * dy + dz * dz)
        inverse = 1.0 / said
        dx, dy, dz = dx * inverse, dy * inverse, dz * inverse
        nx, ny, nz, sensor, radius = vertical_of(x, y, z)
        block[UX, i], block[UY, i], block[UZ, i] = dx, dy, dz
        block[NX, i], block[NY, i], block[NZ, i] = nx, ny, nz
        block[SENSOR, i], block[RADIUS, i] = sensor, radius
        block[COS, i] = -(dx * nx + dy * ny + dz * nz)
        block[SAID, i] = said
        block[LENGTH, i] = said


@jit_inline
def shorten(block: FloatArray, group: FloatArray, travelled_m: FloatArray, start: int, n: int, index: float) -> None:
    """Compute ranges with the air at the sensor; they differ by at most 100 ppm from those in the mean air."""
    for i in range(n):
        block[TOP_VALUE, i], block[TOP_SUM, i] = sum_of(group, block[SENSOR, i])
    if len(travelled_m):
        block[TRAVELLED, :n] = travelled_m[start : start + n]
    else:
        block[TRAVELLED, :n] = block[SAID, :n]
    for i in range(n):
        block[LENGTH, i] += block[TRAVELLED, i] * (index / (1.0 + block[TOP_VALUE, i]) - 1.0)


@jit_inline
def bend(block: FloatArray, phase: FloatArray, n: int, model: int) -> None:
    """Compute Δd / sin α by the chosen bending model."""
    if model == ARDC:
        for i in range(n):
            sensor, cos = block[SENSOR, i], block[COS, i]
            ground = height_along(sensor, block[RADIUS, i], block[LENGTH, i], cos)
            block[TURNED, i] = bent_by_ardc(sensor, ground, cos)
    else:
        for i in range(n):
            place = block[SENSOR, i], block[RADIUS, i]
            block[TURNED, i] = bent_by_layers(phase, place[0], place[1], block[LENGTH, i], block[COS, i])


@jit_inline
def turn(block: FloatArray, n: int) -> None:
    """Turn directions towards nadir by Δd: u' = sin(α − Δd)/sin α u + sin Δd/sin α d (FORMULAS 4.1), at nadir too."""
    for i in range(n):
        cos, turned = block[COS, i], block[TURNED, i]
        square = turned * turned * (1.0 - cos * cos)  # Δd², below 1e-6: two terms of sine and cosine suffice
        down = turned * (1.0 - square / 6.0)
        along = 1.0 - 0.5 * square - cos * down
        block[UX, i] = along * block[UX, i] - down * block[NX, i]
        block[UY, i] = along * block[UY, i] - down * block[NY, i]
        block[UZ, i] = along * block[UZ, i] - down * block[NZ, i]
        block[COS, i] = along * cos + down


@jit_inline
def measure(block: FloatArray, group: FloatArray, n: int, index: float) -> None:
    """Compute ranges in the mean air of their paths; one Newton step settles the mean, which depends on the range."""
    for i in range(n):
        block[GROUND, i] = height_along(block[SENSOR, i], block[RADIUS, i], block[LENGTH, i], block[COS, i])
    for i in range(n):
        block[VALUE, i], block[SUM, i] = sum_of(group, block[GROUND, i])
    for i in range(n):
        travelled, sensor, ground, value = block[TRAVELLED, i], block[SENSOR, i], block[GROUND, i], block[VALUE, i]
        mean = mean_of(sensor, block[TOP_SUM, i], ground, block[SUM, i], value)
        apart = sensor - ground
        slope = (mean - value) / apart if abs(apart) > LEVEL_M else 0.0
        length = block[SAID, i] + travelled * (index / (1.0 + mean) - 1.0)
        mean += slope * (block[LENGTH, i] - length) * block[COS, i]
        block[LENGTH, i] = block[SAID, i] + travelled * (index / (1.0 + mean) - 1.0)


@jit_inline
def give(block: FloatArray, points_e: FloatArray, start: int, n: int) -> None:
    """Copy points out of a block; a row without a range keeps its point."""
    for i in range(n):
        if block[SAID, i] > 0.0:
            for axis in range(3):
                points_e[start + i, axis] = block[OX + axis, i] + block[LENGTH, i] * block[UX + axis, i]


@jit_cached
def apply_air(
    origin_e: FloatArray,
    points_e: FloatArray,
    travelled_m: FloatArray,
    group: FloatArray,
    phase: FloatArray,
    reference_index: float,
    corrects: bool,
    bends: int,
) -> None:
    """Move points (n, 3) in place: ranges of vacuum to ranges in air, and first directions to chords.

    Args:
        origin_e, points_e: (n, 3) metres.
        travelled_m: (n,) the part of each range that came from time of flight; empty: all of it.
        group, phase: tables of group and phase refractivity.
        reference_index: of the instrument.
        corrects: whether ranges are corrected.
        bends: STRAIGHT, ARDC or SPHERICAL.
    """
    block = np.empty((ROWS, BLOCK))
    for start in range(0, len(origin_e), BLOCK):
        n = min(BLOCK, len(origin_e) - start)
        take(block, origin_e, points_e, start, n)
        look(block, n)
        if corrects:
            shorten(block, group, travelled_m, start, n, reference_index)
        if bends != STRAIGHT:
            bend(block, phase, n, bends)
            turn(block, n)
        if corrects:
            measure(block, group, n, reference_index)
        give(block, points_e, start, n)


@jit_cached
def means(table: FloatArray, from_m: FloatArray, to_m: FloatArray, out: FloatArray) -> None:
    """Compute mean refractivities between heights, all (n,), into ``out``."""
    for i in range(len(out)):
        middle = value_of(table, 0.5 * (from_m[i] + to_m[i]))
        from_sum, to_sum = sum_of(table, from_m[i])[1], sum_of(table, to_m[i])[1]
        out[i] = mean_of(from_m[i], from_sum, to_m[i], to_sum, middle)
