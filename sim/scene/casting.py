"""Casts rays through the scene, compiled: one pulse after the other, on one core.

A ray goes from cell to cell (`swath.sim.scene.cells`) until it meets something hard; in each cell it is tested against
the objects that the cell lists and against the ground. Crowns and wires on the way take their share of its energy and
let the rest through.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from swath.georef.arrays import FloatArray, Int64Array
from swath.sim.compiled import jit_inline, whole
from swath.sim.scene.rays import (
    NEVER,
    Ray,
    boundary,
    crown_span,
    ground_entry,
    ground_normal,
    ground_z,
    passes,
    slice_at,
    solid_entry,
    uniform,
    wire_passage,
)
from swath.sim.shots import GROUND, LEAVES, MARKING, NO_SURFACE, ROAD, WATER, WIRE

Pulse = tuple[float, int, int]
"""Time of emission, number, seed of all pulses."""
Hit = tuple[float, int, float, float]
"""Distance, index into `swath.sim.shots.SURFACES`, reflectance, cosine of incidence."""

THINGS, COVERS = 4, 2  # number of kinds of each
SOLIDS, TREES, WIRES, CARS = range(THINGS)
ROADS, LAKES = range(COVERS)

RIM_SHARE = 0.1  # share of a pulse's energy in each of four rays on the footprint's rim; the axis has the rest
LEAF_HITS = 4  # most leaves that a ray meets in one crown
SPENT = 0.03  # energy below which a ray ends
WIRE_REFLECTANCE = 0.4
WATER_REFLECTANCE = 0.5
# Mean square slope of water at 4 m/s of wind (Cox and Munk, J. Opt. Soc. Am. 44, 1954: 0.003 + 0.00512 W).
WATER_SLOPE = 0.0235
DROWNED_M = 0.1  # ground in a lake's circle no higher above its level than this is under water
ASPHALT, PAINT = 0.12, 0.6
STRIPE_M, EDGE_M = 0.15, 0.3  # width of painted lines; from a road's edge to the middle of its edge line
DASH_M, DASHES_M = 4.0, 12.0  # length of a dash of the middle line, from one to the next
_WATER, _PATCHES, _GRAIN = whole(1 << 40), whole(1 << 41), whole(1 << 42)  # numbers of draws, above those of any crown
_NO_SEED = whole(0)


class Frame(NamedTuple):
    """Position of the grids, metres, site frame.

    Attributes:
        west, south: their south-west corner.
        cell: between nodes of the ground; ``size``: of the cells that list objects.
        floor_z, roof_z: site z below and above everything.
        reflectance: of the ground.
    """

    west: float
    south: float
    cell: float
    size: float
    floor_z: float
    roof_z: float
    reflectance: float


class SceneArrays(NamedTuple):
    """Arrays of everything that rays can meet.

    Attributes:
        frame: see `Frame`.
        z: (rows, columns) the ground's nodes (`swath.sim.scene.terrain.Ground`).
        top: (2, rows, columns) upper limit of site z of everything in a cell, and of its ground.
        first: (2, cells + 1) a cell's things are ``item[first[0, c] : first[0, c + 1]]``, its covers those of row 1.
        item: code of an object: where its row begins in ``rows``, times `THINGS` or `COVERS`, plus its kind.
        rows: the tables of `swath.sim.scene.objects.Things`, one behind the other.
        seed: of leaves and water.
    """

    frame: Frame
    z: FloatArray
    top: FloatArray
    first: Int64Array
    item: Int64Array
    rows: FloatArray
    seed: int


@jit_inline
def clipped(at: float, step: float, low: float, high: float, start: float, stop: float) -> tuple[float, float]:
    """Return the two distances between which a coordinate of a ray lies between limits."""
    if step == 0.0:
        return (start, stop) if low <= at <= high else (start, -1.0)
    one, other = (low - at) / step, (high - at) / step
    return max(start, min(one, other)), min(stop, max(one, other))


@jit_inline
def texture(x: float, y: float) -> float:
    """Return a factor about 1 that depends on the place: patches of some 25 m, and grain of half a metre."""
    column, row = math.floor(x / 25.0), math.floor(y / 25.0)
    u, v = x / 25.0 - column, y / 25.0 - row
    u, v = u * u * (3.0 - 2.0 * u), v * v * (3.0 - 2.0 * v)
    southern = (1.0 - u) * uniform(_NO_SEED, column, row, _PATCHES) + u * uniform(_NO_SEED, column + 1, row, _PATCHES)
    northern = (1.0 - u) * uniform(_NO_SEED, column, row + 1, _PATCHES) + u * uniform(
        _NO_SEED, column + 1, row + 1, _PATCHES
    )
    grain = uniform(_NO_SEED, math.floor(2.0 * x), math.floor(2.0 * y), _GRAIN)
    return 1.0 + 0.3 * ((1.0 - v) * southern + v * northern - 0.5) + 0.1 * (grain - 0.5)


@jit_inline
def on_road(rows: FloatArray, item: Int64Array, first: int, last: int, x: float, y: float) -> int:
    """Return the road surface at a place: `ROAD`, `MARKING` or `NO_SURFACE`; crossings have no paint."""
    found, nearest, crossing, surface = -1.0, NEVER, False, NO_SURFACE
    for k in range(first, last):
        if item[k] & 1 != ROADS:
            continue
        road = item[k] >> 1
        px, py, half = x - rows[road], y - rows[road + 1], rows[road + 4]
        ux, uy = rows[road + 2] - rows[road], rows[road + 3] - rows[road + 1]
        length = math.sqrt(ux * ux + uy * uy)
        along = min(max((px * ux + py * uy) / length, 0.0), length)
        aside = math.hypot(px - along * ux / length, py - along * uy / length)
        if aside > half:
            continue
        crossing = crossing or (found >= 0.0 and found != rows[road + 7])
        found = rows[road + 7]
        if aside < nearest:
            nearest = aside
            edge = abs(aside - (half - EDGE_M)) < 0.5 * STRIPE_M
            middle = aside < 0.5 * STRIPE_M and (rows[road + 5] + along) % DASHES_M < DASH_M
            surface = MARKING if rows[road + 6] > 0.0 and (edge or middle) else ROAD
    return ROAD if crossing else surface


@jit_inline
def on_water(rows: FloatArray, item: Int64Array, first: int, last: int, ray: Ray, at: float, pulse: Pulse) -> Hit:
    """Return the hit on a lake that a ray meets above the ground, if any; most pulses do not return from water."""
    for k in range(first, last):
        if item[k] & 1 != LAKES:
            continue
        lake = item[k] >> 1
        wx, wy, wz = rows[lake] - ray[0], rows[lake + 1] - ray[1], rows[lake + 2] - ray[2]
        cos = -(rows[lake + 3] * ray[3] + rows[lake + 4] * ray[4] + rows[lake + 5] * ray[5])
        if cos <= 0.0:
            continue
        level = -(rows[lake + 3] * wx + rows[lake + 4] * wy + rows[lake + 5] * wz) / cos
        x, y, z = wx - level * ray[3], wy - level * ray[4], wz - level * ray[5]
        if level <= 0.0 or level > at + DROWNED_M or x * x + y * y + z * z > rows[lake + 6] ** 2:
            continue
        likely = rows[lake + 7] * math.exp(-(1.0 / (cos * cos) - 1.0) / WATER_SLOPE)
        if uniform(pulse[2], pulse[1], lake, _WATER) < likely:
            return level, WATER, WATER_REFLECTANCE, cos
        return level, NO_SURFACE, 0.0, cos
    return NEVER, NO_SURFACE, 0.0, 1.0


@jit_inline
def on_ground(
    frame: Frame,
    z: FloatArray,
    rows: FloatArray,
    item: Int64Array,
    first: int,
    last: int,
    ray: Ray,
    at: float,
    pulse: Pulse,
) -> Hit:
    """Return the hit of a ray that reaches the ground at a distance: on the ground itself or on its cover."""
    x, y = ray[0] + at * ray[3], ray[1] + at * ray[4]
    surface, reflectance = GROUND, frame.reflectance
    if last > first:
        water = on_water(rows, item, first, last, ray, at, pulse)
        if water[0] < NEVER:
            return water
        covered = on_road(rows, item, first, last, x, y)
        if covered != NO_SURFACE:
            surface, reflectance = covered, PAINT if covered == MARKING else ASPHALT
    across, along = ground_normal(z, frame.west, frame.south, frame.cell, x, y)
    cos = (across * ray[3] + along * ray[4] - ray[5]) / math.sqrt(across * across + along * along + 1.0)
    return at, surface, min(1.0, reflectance * texture(x, y)), min(1.0, max(cos, 0.0))


@jit_inline
def into_crown(
    rows: FloatArray, tree: int, ray: Ray, start: float, stop: float, pulse: Pulse, soft: FloatArray, count: int
) -> int:
    """Add the leaves that a pulse meets in a crown to ``soft``; return the rows in use.

    The ray must enter the crown between the two distances. Depths of hits follow the Beer-Lambert law; their shares of
    the energy are random.
    """
    at, leave = crown_span(rows, tree, ray)
    if at < start or at >= stop:
        return count
    for hit in range(LEAF_HITS):
        at -= math.log(1.0 - uniform(pulse[2], pulse[1], tree, 2 * hit)) / rows[tree + 5]
        if at >= leave or count >= len(soft):
            break
        soft[count, 0], soft[count, 1] = at, 0.25 + 0.5 * uniform(pulse[2], pulse[1], tree, 2 * hit + 1)
        soft[count, 2], soft[count, 3], soft[count, 4] = rows[tree + 6], 1.0, LEAVES
        count += 1
    return count


@jit_inline
def into_wire(
    rows: FloatArray, wire: int, ray: Ray, start: float, stop: float, spread: float, soft: FloatArray, count: int
) -> int:
    """Add a wire in the footprint between two distances to ``soft``; return the rows in use.

    The wire returns its share of the footprint's area.
    """
    at, miss, cos = wire_passage(rows, wire, ray)
    foot, radius = spread * at, rows[wire + 6]
    if start <= at < stop and miss < foot + radius:
        area = 4.0 * radius * math.sqrt((foot + radius) ** 2 - miss * miss)
        whole = math.pi * foot * foot
        soft[count, 0], soft[count, 1] = at, 1.0 if area >= whole else area / whole
        soft[count, 2], soft[count, 3], soft[count, 4] = WIRE_REFLECTANCE, cos, WIRE
        return count + 1
    return count


@jit_inline
def beside_car(frame: Frame, z: FloatArray, rows: FloatArray, car: int, ray: Ray, time_s: float) -> Ray:
    """Return a ray in the coordinates of a moving car, whose origin is the middle of the car's floor.

    The floor follows the ground.
    """
    length = rows[car + 10]
    driven = (rows[car + 11] * time_s) % (2.0 * length) if length > 0.0 else 0.0
    driven = min(driven, 2.0 * length - driven)
    x, y = rows[car + 6] + driven * rows[car + 8], rows[car + 7] + driven * rows[car + 9]
    floor = ground_z(z, frame.west, frame.south, frame.cell, x, y)
    return ray[0] - x, ray[1] - y, ray[2] - floor, ray[3], ray[4], ray[5], ray[6], ray[7]


@jit_inline
def meet(
    frame: Frame,
    z: FloatArray,
    rows: FloatArray,
    item: Int64Array,
    first: int,
    last: int,
    ray: Ray,
    start: float,
    stop: float,
    spread: float,
    pulse: Pulse,
    soft: FloatArray,
    count: int,
    room: int,
) -> tuple[float, int, float, float, float, int]:
    """Return the hits on the objects that a cell lists, between two distances.

    Returns the four numbers of the nearest hard `Hit`, the distance of an edge within the beam's reach, and the number
    of rows of ``soft`` in use.
    """
    best, surface, reflectance, cosine, edge, grow = NEVER, NO_SURFACE, 0.0, 1.0, NEVER, spread * stop
    for k in range(first, last):
        kind, row = item[k] & 3, item[k] >> 2
        if kind == SOLIDS or kind == CARS:
            near = beside_car(frame, z, rows, row, ray, pulse[0]) if kind == CARS else ray
            if passes(near, rows[row], rows[row + 1], rows[row + 2], rows[row + 3] + grow) < NEVER:
                at, through, cos, rim = solid_entry(rows, int(rows[row + 4]), int(rows[row + 5]), near, grow)
                edge = min(edge, rim)
                if start <= at < stop and at < best:
                    best, surface, cosine = at, int(rows[through + 4]), cos
                    reflectance = rows[through + 5] * texture(near[0] + at * near[3], near[1] + at * near[4])
        elif count < room:
            if kind == TREES:
                count = into_crown(rows, row, ray, start, stop, pulse, soft, count)
            else:
                count = into_wire(rows, row, ray, start, stop, spread, soft, count)
    return best, surface, reflectance, cosine, edge, count


@jit_inline
def march(
    frame: Frame,
    z: FloatArray,
    top: FloatArray,
    listed: Int64Array,
    item: Int64Array,
    rows: FloatArray,
    ray: Ray,
    spread: float,
    pulse: Pulse,
    soft: FloatArray,
    count: int,
    room: int,
) -> tuple[float, int, float, float, float, int]:
    """Return the same as `meet` for a whole ray."""
    best, surface, reflectance, cosine, edge, fresh = NEVER, NO_SURFACE, 0.0, 1.0, NEVER, True
    deep, wide = top.shape[1], top.shape[2]
    at, stop = clipped(ray[2], ray[5], frame.floor_z, frame.roof_z, 0.0, NEVER)
    at, stop = clipped(ray[0], ray[3], frame.west, frame.west + (z.shape[1] - 1) * frame.cell, at, stop)
    at, stop = clipped(ray[1], ray[4], frame.south, frame.south + (z.shape[0] - 1) * frame.cell, at, stop)
    column = slice_at(ray[0] + at * ray[3], frame.west, frame.size, wide)
    row = slice_at(ray[1] + at * ray[4], frame.south, frame.size, deep)
    while at < stop and 0 <= column < wide and 0 <= row < deep:
        leave_x = boundary(ray[0], ray[3], ray[6], frame.west, frame.size, column)
        leave_y = boundary(ray[1], ray[4], ray[7], frame.south, frame.size, row)
        leave = max(at, min(stop, leave_x, leave_y))
        low = ray[2] + ray[5] * (leave if ray[5] < 0.0 else at)
        if low <= top[0, row, column]:
            cell = row * wide + column
            first, last = listed[0, cell], listed[0, cell + 1]
            if last > first:
                best, surface, reflectance, cosine, near, count = meet(
                    frame, z, rows, item, first, last, ray, at, leave, spread, pulse, soft, count, room
                )
                edge = min(edge, near)
            if low <= top[1, row, column]:
                below = ground_entry(z, frame.west, frame.south, frame.cell, ray, at, min(leave, best), fresh)
                if below < 0.0:
                    break
                if below < best:
                    first, last = listed[1, cell], listed[1, cell + 1]
                    best, surface, reflectance, cosine = on_ground(frame, z, rows, item, first, last, ray, below, pulse)
            if best < NEVER:
                break
        fresh = False
        at = leave
        if leave_x <= leave_y:
            column += 1 if ray[3] > 0.0 else -1
        else:
            row += 1 if ray[4] > 0.0 else -1
    return best, surface, reflectance, cosine, edge, count
