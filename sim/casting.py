"""Rays through the scene, compiled: each pulse on its own, one after the other, on one core.

A ray goes from cell to cell (`sim.cells`) until it meets something hard; in a cell it looks at what the cell lists and
at the ground. Crowns and wires it meets on the way take their share of its energy and let the rest through.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from sim.cells import Cells
from sim.objects import CAR_SIZE_M, Things
from sim.rays import (
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
from sim.shots import CAR, GROUND, LEAVES, MARKING, NO_SURFACE, ROAD, WATER, WIRE

FloatArray = NDArray[np.float64]
Hit = tuple[float, int, float, float]
"""Distance, index into `sim.shots.SURFACES`, reflectance, cosine of incidence."""

SOLIDS, TREES, WIRES, CARS = range(4)  # the last two bits of an item's code; its row stands before them
ROADS, LAKES = range(2)  # the last bit of a cover's code

RIM_SHARE = 0.1  # of a pulse's energy, for each of four rays on the rim of the footprint; the axis has the rest
LEAF_HITS = 4  # of one crown
SPENT = 0.03  # energy below which nothing goes on
WIRE_REFLECTANCE = 0.4
WATER_REFLECTANCE = 0.5
# Mean square slope of water at 4 m/s of wind (Cox and Munk, J. Opt. Soc. Am. 44, 1954: 0.003 + 0.00512 W).
WATER_SLOPE = 0.0235
DROWNED_M = 0.1  # ground in a lake's circle no higher above its level than this is under water
ASPHALT, PAINT = 0.12, 0.6
STRIPE_M, EDGE_M = 0.15, 0.3  # width of painted lines; from a road's edge to the middle of its edge line
DASH_M, DASHES_M = 4.0, 12.0  # length of a dash of the middle line, from one to the next
_WATER, _TEXTURE = 1 << 40, 1 << 41  # what random numbers are for; crowns use their own row number
_CAR_HALF = (0.5 * CAR_SIZE_M[0], 0.5 * CAR_SIZE_M[1])
_CAR_HEIGHT, _CAR_RADIUS = CAR_SIZE_M[2], 3.0


class SceneArrays(NamedTuple):
    """All that rays are cast at.

    Attributes:
        z, west, south, cell: the ground's nodes (`sim.terrain.Ground`).
        floor_z, roof_z: site z below and above everything.
        reflectance: of the ground.
        seed: of leaves and water.
        cells, things: what stands where.
    """

    z: FloatArray
    west: float
    south: float
    cell: float
    floor_z: float
    roof_z: float
    reflectance: float
    seed: int
    cells: Cells
    things: Things


@numba.njit(cache=True)
def span(scene: SceneArrays, ray: Ray) -> tuple[float, float]:
    """Distances between which a ray is within the box around the scene."""
    start, stop = 0.0, NEVER
    east = scene.west + (scene.z.shape[1] - 1) * scene.cell
    north = scene.south + (scene.z.shape[0] - 1) * scene.cell
    limits = ((scene.west, east), (scene.south, north), (scene.floor_z, scene.roof_z))
    for axis in range(3):
        at, step = ray[axis], ray[3 + axis]
        low, high = limits[axis]
        if step != 0.0:
            one, other = (low - at) / step, (high - at) / step
            start, stop = max(start, min(one, other)), min(stop, max(one, other))
        elif at < low or at > high:
            return 0.0, -1.0
    return start, stop


@numba.njit(cache=True)
def texture(x: float, y: float) -> float:
    """A factor about 1 that belongs to a place: patches of some 25 m, and grain of half a metre."""
    column, row = math.floor(x / 25.0), math.floor(y / 25.0)
    u, v = x / 25.0 - column, y / 25.0 - row
    u, v = u * u * (3.0 - 2.0 * u), v * v * (3.0 - 2.0 * v)
    southern = (1.0 - u) * uniform(0, column, row, _TEXTURE) + u * uniform(0, column + 1, row, _TEXTURE)
    northern = (1.0 - u) * uniform(0, column, row + 1, _TEXTURE) + u * uniform(0, column + 1, row + 1, _TEXTURE)
    grain = uniform(0, math.floor(2.0 * x), math.floor(2.0 * y), _TEXTURE + 1)
    return 1.0 + 0.3 * ((1.0 - v) * southern + v * northern - 0.5) + 0.1 * (grain - 0.5)


@numba.njit(cache=True)
def on_road(scene: SceneArrays, first: int, last: int, x: float, y: float) -> int:
    """What covers a place as far as roads go: `ROAD`, `MARKING` or `NO_SURFACE`; crossings bear no paint."""
    found, nearest, crossing, surface = -1.0, NEVER, False, NO_SURFACE
    for k in range(first, last):
        if scene.cells.cover[k] & 1 != ROADS:
            continue
        road = scene.things.road[scene.cells.cover[k] >> 1]
        ux, uy, px, py = road[2] - road[0], road[3] - road[1], x - road[0], y - road[1]
        length = math.sqrt(ux * ux + uy * uy)
        along = min(max((px * ux + py * uy) / length, 0.0), length)
        aside = math.hypot(px - along * ux / length, py - along * uy / length)
        if aside > road[4]:
            continue
        crossing = crossing or (found >= 0.0 and found != road[7])
        found = road[7]
        if aside < nearest:
            nearest = aside
            edge = abs(aside - (road[4] - EDGE_M)) < 0.5 * STRIPE_M
            middle = aside < 0.5 * STRIPE_M and (road[5] + along) % DASHES_M < DASH_M
            surface = MARKING if road[6] > 0.0 and (edge or middle) else ROAD
    return ROAD if crossing else surface


@numba.njit(cache=True)
def on_water(scene: SceneArrays, first: int, last: int, ray: Ray, at: float, number: int) -> Hit:
    """The lake above the ground that a ray meets at a distance; most pulses do not come back from it."""
    for k in range(first, last):
        if scene.cells.cover[k] & 1 != LAKES:
            continue
        row = scene.cells.cover[k] >> 1
        lake = scene.things.lake[row]
        wx, wy, wz = lake[0] - ray[0], lake[1] - ray[1], lake[2] - ray[2]
        cos = -(lake[3] * ray[3] + lake[4] * ray[4] + lake[5] * ray[5])
        if cos <= 0.0:
            continue
        level = -(lake[3] * wx + lake[4] * wy + lake[5] * wz) / cos
        x, y, z = wx - level * ray[3], wy - level * ray[4], wz - level * ray[5]
        if level <= 0.0 or level > at + DROWNED_M or x * x + y * y + z * z > lake[6] * lake[6]:
            continue
        likely = lake[7] * math.exp(-(1.0 / (cos * cos) - 1.0) / WATER_SLOPE)
        if uniform(scene.seed, number, row, _WATER) < likely:
            return level, WATER, WATER_REFLECTANCE, cos
        return level, NO_SURFACE, 0.0, cos
    return NEVER, NO_SURFACE, 0.0, 1.0


@numba.njit(cache=True)
def on_ground(scene: SceneArrays, cell: int, ray: Ray, at: float, number: int) -> Hit:
    """What a ray meets that goes below the ground at a distance: the ground itself or what covers it."""
    x, y = ray[0] + at * ray[3], ray[1] + at * ray[4]
    first, last = scene.cells.first_cover[cell], scene.cells.first_cover[cell + 1]
    surface, reflectance = GROUND, scene.reflectance
    if last > first:
        water = on_water(scene, first, last, ray, at, number)
        if water[0] < NEVER:
            return water
        covered = on_road(scene, first, last, x, y)
        if covered != NO_SURFACE:
            surface, reflectance = covered, PAINT if covered == MARKING else ASPHALT
    across, along = ground_normal(scene.z, scene.west, scene.south, scene.cell, x, y)
    cos = (across * ray[3] + along * ray[4] - ray[5]) / math.sqrt(across * across + along * along + 1.0)
    return at, surface, min(1.0, reflectance * texture(x, y)), min(1.0, max(cos, 0.0))


@numba.njit(cache=True)
def into_crown(scene: SceneArrays, row: int, ray: Ray, enter: float, number: int, soft: FloatArray, count: int) -> int:
    """Leaves a pulse meets in a crown: at depths after Beer and Lambert, each a share of the footprint."""
    tree = scene.things.tree[row]
    leave = crown_span(tree, ray)[1]
    at = enter
    for hit in range(LEAF_HITS):
        at -= math.log(1.0 - uniform(scene.seed, number, row, 2 * hit)) / tree[5]
        if at >= leave or count >= len(soft):
            break
        share = 0.25 + 0.5 * uniform(scene.seed, number, row, 2 * hit + 1)
        soft[count, 0], soft[count, 1], soft[count, 2], soft[count, 3], soft[count, 4] = at, share, tree[6], 1.0, LEAVES
        count += 1
    return count


@numba.njit(cache=True)
def into_wire(
    wire: FloatArray, ray: Ray, start: float, stop: float, spread: float, soft: FloatArray, count: int
) -> int:
    """A wire in the footprint, whose share of its area returns."""
    at, miss, cos = wire_passage(wire, ray)
    if start <= at < stop and count < len(soft):
        foot, radius = spread * at, wire[6]
        if miss < foot + radius:
            chord = 2.0 * math.sqrt((foot + radius) ** 2 - miss * miss)
            area = math.pi * foot * foot
            share = 1.0 if chord * 2.0 * radius >= area else chord * 2.0 * radius / area
            soft[count, 0], soft[count, 1], soft[count, 2] = at, share, WIRE_REFLECTANCE
            soft[count, 3], soft[count, 4] = cos, WIRE
            return count + 1
    return count


@numba.njit(cache=True)
def park(scene: SceneArrays, row: int, time_s: float, box: FloatArray) -> tuple[float, float, float]:
    """Center of a car's floor at a time; the planes around it go to ``box`` (5, 6)."""
    car = scene.things.car[row]
    ux, uy = car[2] - car[0], car[3] - car[1]
    length = math.hypot(ux, uy)
    if length > 0.0:
        ux, uy = ux / length, uy / length
        driven = (car[4] * time_s) % (2.0 * length)
        driven = min(driven, 2.0 * length - driven)
    else:
        ux, uy, driven = 0.0, 1.0, 0.0
    x, y = car[0] + driven * ux, car[1] + driven * uy
    z = ground_z(scene.z, scene.west, scene.south, scene.cell, x, y)
    box[:] = 0.0
    box[0, 0], box[0, 1], box[1, 0], box[1, 1] = ux, uy, -ux, -uy
    box[2, 0], box[2, 1], box[3, 0], box[3, 1] = uy, -ux, -uy, ux
    for side in range(4):
        box[side, 3] = box[side, 0] * x + box[side, 1] * y + _CAR_HALF[side // 2]
    box[4, 2], box[4, 3] = 1.0, z + _CAR_HEIGHT
    box[:, 4], box[:, 5] = CAR, car[5]
    return x, y, z


@numba.njit(cache=True)
def meet(
    scene: SceneArrays,
    cell: int,
    ray: Ray,
    start: float,
    stop: float,
    time_s: float,
    number: int,
    spread: float,
    soft: FloatArray,
    count: int,
    box: FloatArray,
) -> tuple[float, int, float, float, float, int]:
    """What a cell lists, between two distances.

    Returns the four numbers of the nearest hard `Hit`, the distance of an edge within the beam's reach, and how many
    rows of ``soft`` are in use.
    """
    best, edge, grow, things = (NEVER, NO_SURFACE, 0.0, 1.0), NEVER, spread * stop, scene.things
    for k in range(scene.cells.first[cell], scene.cells.first[cell + 1]):
        kind, row = scene.cells.item[k] & 3, scene.cells.item[k] >> 2
        if kind == TREES:
            if count >= 0:
                enter = crown_span(things.tree[row], ray)[0]
                if start <= enter < stop:
                    count = into_crown(scene, row, ray, enter, number, soft, count)
        elif kind == WIRES:
            if count >= 0:
                count = into_wire(things.wire[row], ray, start, stop, spread, soft, count)
        else:
            if kind == SOLIDS:
                ball, plane = things.ball[row], things.plane
                if passes(ray, ball[0], ball[1], ball[2], ball[3] + grow) == NEVER:
                    continue
                first, last = things.first_plane[row], things.first_plane[row + 1]
            else:
                x, y, z = park(scene, row, time_s, box)
                if passes(ray, x, y, z, _CAR_RADIUS + grow) == NEVER:
                    continue
                plane, first, last = box, 0, 5
            at, through, near = solid_entry(plane, first, last, ray, grow)
            edge = min(edge, near)
            if start <= at < stop and at < best[0]:
                face = plane[through]
                cos = -(face[0] * ray[3] + face[1] * ray[4] + face[2] * ray[5])
                grain = texture(ray[0] + at * ray[3], ray[1] + at * ray[4]) if kind == SOLIDS else 1.0
                best = at, int(face[4]), min(1.0, grain * face[5]), cos
    return best[0], best[1], best[2], best[3], edge, count


@numba.njit(cache=True)
def march(
    scene: SceneArrays,
    ray: Ray,
    time_s: float,
    number: int,
    spread: float,
    soft: FloatArray,
    count: int,
    box: FloatArray,
) -> tuple[float, int, float, float, float, int]:
    """As `meet`, for a whole ray; with ``count`` −1 crowns and wires are air."""
    cells, edge = scene.cells, NEVER
    at, stop = span(scene, ray)
    fresh = True
    rows, columns = cells.top.shape
    column = slice_at(ray[0] + at * ray[3], cells.west, cells.size, columns)
    row = slice_at(ray[1] + at * ray[4], cells.south, cells.size, rows)
    while at < stop:
        leave_x = boundary(ray[0], ray[3], cells.west, cells.size, column)
        leave_y = boundary(ray[1], ray[4], cells.south, cells.size, row)
        leave = max(at, min(stop, leave_x, leave_y))
        low = ray[2] + ray[5] * (leave if ray[5] < 0.0 else at)
        if low <= cells.top[row, column]:
            cell = row * columns + column
            best = (NEVER, NO_SURFACE, 0.0, 1.0)
            if cells.first[cell + 1] > cells.first[cell]:
                d, s, r, c, near, count = meet(scene, cell, ray, at, leave, time_s, number, spread, soft, count, box)
                best, edge = (d, s, r, c), min(edge, near)
            if low <= cells.ground_top[row, column]:
                below = ground_entry(scene.z, scene.west, scene.south, scene.cell, ray, at, min(leave, best[0]), fresh)
                if below < 0.0:
                    break
                if below < best[0]:
                    best = on_ground(scene, cell, ray, below, number)
            if best[0] < NEVER:
                return best[0], best[1], best[2], best[3], edge, count
        fresh = False
        at = leave
        if leave_x <= leave_y:
            column += 1 if ray[3] > 0.0 else -1
        else:
            row += 1 if ray[4] > 0.0 else -1
        if column < 0 or row < 0 or column >= columns or row >= rows:
            break
    return NEVER, NO_SURFACE, 0.0, 1.0, edge, count
