"""Intersections of a ray with single objects: compiled functions of plain numbers.

A ray is ``(x, y, z, dx, dy, dz, 1 / dx, 1 / dy)``: origin and unit direction in the site frame. Distances along it are
metres from the origin; infinity means never.
"""

from __future__ import annotations

import math

import numpy as np

from swath.georef.arrays import FloatArray
from swath.sim.compiled import jit_inline

Ray = tuple[float, float, float, float, float, float, float, float]

PLANE = 6  # length of a plane's row
NEVER = math.inf
UNDERGROUND = -1.0
_MIX_1, _MIX_2 = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_ODD_1, _ODD_2 = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xD1B54A32D192ED03)
_ODD_3, _ODD_4 = np.uint64(0x8CB92BA72F3D8DD7), np.uint64(0xAEF17502108EF2D9)
_S11, _S27, _S30, _S31 = np.uint64(11), np.uint64(27), np.uint64(30), np.uint64(31)


@jit_inline
def uniform(seed: int, number: int, purpose: int, draw: int) -> float:
    """Return a number in [0, 1) that depends on the four arguments alone.

    It is the finaliser of SplitMix64 (Steele et al. 2014).
    """
    state = np.uint64(seed) * _ODD_1 + np.uint64(number) * _ODD_2 + np.uint64(purpose) * _ODD_3
    state += np.uint64(draw) * _ODD_4
    state = (state ^ (state >> _S30)) * _MIX_1
    state = (state ^ (state >> _S27)) * _MIX_2
    return float((state ^ (state >> _S31)) >> _S11) * 2.0**-53


@jit_inline
def patch_root(height: float, slope: float, bend: float) -> float:
    """Return the smallest s > 0 with height + slope · s + bend · s² = 0, for height > 0.

    It is the distance at which a ray goes below a patch.
    """
    inside = slope * slope - 4.0 * bend * height
    if inside < 0.0:
        return NEVER
    if slope < 0.0:
        return 2.0 * height / (math.sqrt(inside) - slope)
    if bend < 0.0:
        return -0.5 * (slope + math.sqrt(inside)) / bend
    return NEVER


@jit_inline
def boundary(at: float, step: float, per_step: float, low: float, size: float, index: int) -> float:
    """Return the distance at which a ray leaves slice ``index`` of slices of this size, in one coordinate."""
    if step > 0.0:
        return (low + (index + 1) * size - at) * per_step
    return (low + index * size - at) * per_step if step < 0.0 else NEVER


@jit_inline
def slice_at(value: float, low: float, size: float, count: int) -> int:
    """Return the index of the slice that holds a value; beyond the ends, that of the nearest slice."""
    return min(max(math.floor((value - low) / size), 0), count - 1)


@jit_inline
def ground_entry(
    z: FloatArray, west: float, south: float, cell: float, ray: Ray, start: float, stop: float, fresh: bool
) -> float:
    """Return the distance, between two limits, at which a ray goes below the bilinear ground.

    Within a cell the height of the ray above the patch is a quadratic of the distance; it is set up at the ray's entry
    into the cell, so that no large numbers cancel. The result is `UNDERGROUND` if a ``fresh`` ray begins below the
    ground.
    """
    ox, oy, oz, dx, dy, dz, per_dx, per_dy = ray
    columns, rows, per_cell = z.shape[1] - 1, z.shape[0] - 1, 1.0 / cell
    column = slice_at(ox + start * dx, west, cell, columns)
    row = slice_at(oy + start * dy, south, cell, rows)
    at = start
    while 0 <= column < columns and 0 <= row < rows:
        leave_x, leave_y = boundary(ox, dx, per_dx, west, cell, column), boundary(oy, dy, per_dy, south, cell, row)
        leave = max(at, min(stop, leave_x, leave_y))
        z00, z10, z01, z11 = z[row, column], z[row, column + 1], z[row + 1, column], z[row + 1, column + 1]
        here = oz + at * dz
        if min(here, oz + leave * dz) <= max(z00, z10, z01, z11) + 1e-6:
            a, b, twist = z10 - z00, z01 - z00, z11 - z10 - z01 + z00
            u, v = (ox + at * dx - west) * per_cell - column, (oy + at * dy - south) * per_cell - row
            du, dv = dx * per_cell, dy * per_cell
            height = here - (z00 + a * u + b * v + twist * u * v)
            if height <= 0.0:
                return UNDERGROUND if fresh and height < -1e-9 else at
            step = patch_root(height, dz - a * du - b * dv - twist * (u * dv + v * du), -twist * du * dv)
            if step <= leave - at + 1e-9:
                return at + step
        if leave >= stop:
            return NEVER
        fresh = False
        at = leave
        if leave_x <= leave_y:
            column += 1 if dx > 0.0 else -1
        else:
            row += 1 if dy > 0.0 else -1
    return NEVER


@jit_inline
def ground_normal(z: FloatArray, west: float, south: float, cell: float, x: float, y: float) -> tuple[float, float]:
    """Return the slope of the bilinear ground at a place: (dz/dx, dz/dy)."""
    column = slice_at(x, west, cell, z.shape[1] - 1)
    row = slice_at(y, south, cell, z.shape[0] - 1)
    z00, z10, z01, z11 = z[row, column], z[row, column + 1], z[row + 1, column], z[row + 1, column + 1]
    u, v = (x - west) / cell - column, (y - south) / cell - row
    twist = z11 - z10 - z01 + z00
    return (z10 - z00 + twist * v) / cell, (z01 - z00 + twist * u) / cell


@jit_inline
def ground_z(z: FloatArray, west: float, south: float, cell: float, x: float, y: float) -> float:
    """Return the site z of the bilinear ground at a place."""
    column = slice_at(x, west, cell, z.shape[1] - 1)
    row = slice_at(y, south, cell, z.shape[0] - 1)
    u, v = (x - west) / cell - column, (y - south) / cell - row
    southern = (1.0 - u) * z[row, column] + u * z[row, column + 1]
    northern = (1.0 - u) * z[row + 1, column] + u * z[row + 1, column + 1]
    return float((1.0 - v) * southern + v * northern)


@jit_inline
def passes(ray: Ray, x: float, y: float, z: float, radius: float) -> float:
    """Return the distance at which a ray is nearest to a point, if that is ahead and within a radius; else `NEVER`."""
    ox, oy, oz, dx, dy, dz, _, _ = ray
    wx, wy, wz = x - ox, y - oy, z - oz
    along = wx * dx + wy * dy + wz * dz
    if wx * wx + wy * wy + wz * wz - along * along > radius * radius or along < -radius:
        return NEVER
    return along


@jit_inline
def solid_entry(rows: FloatArray, first: int, last: int, ray: Ray, grow: float) -> tuple[float, int, float, float]:
    """Return the entry of a ray into the body behind the planes in ``rows[first:last]`` (`Things.plane`).

    Returns the distance, the beginning of the plane's row, the cosine of incidence, and the distance of an edge in
    reach. The last is finite where the beam's rim, ``grow`` from its axis, may meet something else than the axis does.
    """
    ox, oy, oz, dx, dy, dz, _, _ = ray
    enter, leave, wide_enter, wide_leave, through, cos = -NEVER, NEVER, -NEVER, NEVER, first, 1.0
    for k in range(first, last, PLANE):
        speed = rows[k] * dx + rows[k + 1] * dy + rows[k + 2] * dz
        gap = rows[k + 3] - (rows[k] * ox + rows[k + 1] * oy + rows[k + 2] * oz)
        if speed == 0.0:
            if gap < -grow:
                return NEVER, first, 1.0, NEVER
            if gap < 0.0:
                enter = NEVER
            continue
        at = gap / speed
        if speed < 0.0:
            wide_enter = max(wide_enter, at + grow / speed)
            if at > enter:
                enter, through, cos = at, k, -speed
        else:
            leave, wide_leave = min(leave, at), min(wide_leave, at + grow / speed)
    if wide_enter > wide_leave or wide_leave < 0.0:
        return NEVER, first, 1.0, NEVER
    if enter >= leave or enter <= 0.0:
        return NEVER, first, 1.0, max(wide_enter, 0.0)
    x, y, z, reach = ox + enter * dx, oy + enter * dy, oz + enter * dz, grow / max(cos, 0.02)
    for k in range(first, last, PLANE):
        if k != through and rows[k + 3] - (rows[k] * x + rows[k + 1] * y + rows[k + 2] * z) < reach:
            return enter, through, cos, enter
    return enter, through, cos, NEVER


@jit_inline
def crown_span(rows: FloatArray, tree: int, ray: Ray) -> tuple[float, float]:
    """Return the distances at which a ray enters and leaves an upright ellipsoid (`Things.tree`, at ``rows[tree]``)."""
    ox, oy, oz, dx, dy, dz, _, _ = ray
    across, upright = rows[tree + 3], rows[tree + 4]
    px, py, pz = (ox - rows[tree]) * across, (oy - rows[tree + 1]) * across, (oz - rows[tree + 2]) * upright
    ux, uy, uz = dx * across, dy * across, dz * upright
    a = ux * ux + uy * uy + uz * uz
    b = px * ux + py * uy + pz * uz
    inside = b * b - a * (px * px + py * py + pz * pz - 1.0)
    if inside <= 0.0:
        return NEVER, NEVER
    root = math.sqrt(inside)
    return (-b - root) / a, (root - b) / a


@jit_inline
def wire_passage(rows: FloatArray, wire: int, ray: Ray) -> tuple[float, float, float]:
    """Return distance, miss distance and cosine at which a ray passes a piece of wire (`Things.wire`).

    The distances are `NEVER` if it passes beside the ends.
    """
    ox, oy, oz, dx, dy, dz, _, _ = ray
    ux, uy, uz = rows[wire + 3] - rows[wire], rows[wire + 4] - rows[wire + 1], rows[wire + 5] - rows[wire + 2]
    wx, wy, wz = ox - rows[wire], oy - rows[wire + 1], oz - rows[wire + 2]
    square = ux * ux + uy * uy + uz * uz
    along, ahead, behind = dx * ux + dy * uy + dz * uz, dx * wx + dy * wy + dz * wz, ux * wx + uy * wy + uz * wz
    across = square - along * along
    if across <= 1e-12 * square:
        return NEVER, NEVER, 0.0
    share = (behind - along * ahead) / across
    at = (along * behind - square * ahead) / across
    if share < 0.0 or share >= 1.0 or at <= 0.0:
        return NEVER, NEVER, 0.0
    mx, my, mz = wx + at * dx - share * ux, wy + at * dy - share * uy, wz + at * dz - share * uz
    return at, math.sqrt(mx * mx + my * my + mz * mz), math.sqrt(across / square)
