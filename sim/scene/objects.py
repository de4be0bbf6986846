"""Objects on the ground, as tables of numbers at which rays are cast; `Things` describes the columns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from swath.georef.arrays import BoolArray, FloatArray, Int64Array
from swath.sim.clocks import generator
from swath.sim.plan.terrain_tables import CarTable, ForestTable, RoadTable, WireTable
from swath.sim.scene.rays import PLANE
from swath.sim.scene.terrain import Ground, Lake, ups
from swath.sim.scene.village import ROOFS, Houses
from swath.sim.shots import CAR, ROOF, WALL

CAR_SIZE_M = (4.4, 1.8, 1.5)
WIRE_PIECE_M = 6.0
_FLAT, _GABLED, _HIPPED = range(len(ROOFS))


class Things(NamedTuple):
    """Tables of objects in the site frame, metres.

    Attributes:
        plane: (p, 6) outward normal, its product with points of the plane, surface, reflectance.
        solid: (n, 6) centre and radius of the sphere around it, then in `flat` the beginning and end of its planes.
        tree: (n, 7) crown's centre, one divided by its radius and by its half height, interceptions a metre,
            reflectance.
        wire: (n, 7) ends of a straight piece, radius.
        car: (n, 12) as ``solid``, about the middle of its floor; from, direction, length of its way, speed in m/s.
        lake: (n, 8) centre, normal, radius, share of pulses that return.
        road: (n, 8) ends of a straight piece, half width, metres of road before it, 1 if painted, number of the road.
    """

    plane: FloatArray
    solid: FloatArray
    tree: FloatArray
    wire: FloatArray
    car: FloatArray
    lake: FloatArray
    road: FloatArray


def flat(things: Things) -> tuple[FloatArray, dict[str, Int64Array]]:
    """Return all tables one behind the other, planes first, and the position at which each row of each begins."""
    starts, at = {}, 0
    for name, table in things._asdict().items():
        starts[name] = at + table.shape[1] * np.arange(len(table), dtype=np.int64)
        at += table.size
    return np.concatenate([np.ravel(table) for table in things]), starts


@dataclass(frozen=True)
class Solids:
    """Buildings as bodies between planes; they have no floor, because the ground is in the way.

    Attributes:
        plane, solid: see `Things`.
        polygon: (n, 4, 2) east, north of the corners of the footprints.
        box: (n, 4) west, south, east, north of the footprints.
        top_z: (n,) site z of the highest point.
    """

    plane: FloatArray
    solid: FloatArray
    polygon: FloatArray
    box: FloatArray
    top_z: FloatArray


def build_solids(houses: Houses, ground: Ground, seed: int) -> Solids:
    """Return the walls and roofs of houses; the eaves are above the highest ground under each building."""
    base, low_m = _bases(houses, ground)
    up = ups(ground.site, base)
    axes = _axes(houses.heading_rad, up)
    half = 0.5 * houses.size_m
    rise = np.tan(houses.pitch_rad) * np.where(houses.roof == _HIPPED, np.min(half, axis=1), half[:, 1])
    top_m = houses.eaves_m + np.where(houses.roof == _FLAT, 0.0, rise)
    bottom_m = low_m - 1.0
    center = base + up * (0.5 * (top_m + bottom_m))[:, np.newaxis]
    radius = np.sqrt(np.sum(half**2, axis=1) + (0.5 * (top_m - bottom_m)) ** 2)
    planes, used = _planes(houses, base, axes, seed)
    last = np.cumsum(used.sum(axis=1))
    signs = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]])
    corners = base[:, np.newaxis] + np.einsum("ck,nk,nkx->ncx", signs, half, axes[:, :2])
    polygon = corners[:, :, :2]
    return Solids(
        planes[used],
        np.column_stack([center, radius, PLANE * (last - used.sum(axis=1)), PLANE * last]),
        polygon,
        np.concatenate([polygon.min(axis=1), polygon.max(axis=1)], axis=1),
        np.max(corners[:, :, 2], axis=1) + top_m,
    )


def _bases(houses: Houses, ground: Ground) -> tuple[FloatArray, FloatArray]:
    """Return centres (n, 3) at the highest ground beneath, and the height of the lowest ground against it (n,).

    That height is never positive.
    """
    longest = float(np.max(houses.size_m, initial=0.0))
    count = int(np.clip(np.ceil(2 * longest / ground.cell_m), 4, 40)) + 1
    steps = np.linspace(-0.5, 0.5, count)
    a, b = (axis.ravel() for axis in np.meshgrid(steps, steps))
    along, across = a * houses.size_m[:, :1], b * houses.size_m[:, 1:]
    sin, cos = np.sin(houses.heading_rad)[:, np.newaxis], np.cos(houses.heading_rad)[:, np.newaxis]
    z = ground.site_z(
        houses.center_m[:, :1] + along * sin + across * cos, houses.center_m[:, 1:] + along * cos - across * sin
    )
    highest, lowest = z.max(axis=1, initial=-np.inf), z.min(axis=1, initial=np.inf)
    return np.concatenate([houses.center_m, highest[:, np.newaxis]], axis=1), lowest - highest


def _axes(heading_rad: FloatArray, up: FloatArray) -> FloatArray:
    """Return (n, 3, 3) rows of orthogonal axes: along the ridge, to its right, up; the first two are level there."""
    along = np.stack([np.sin(heading_rad), np.cos(heading_rad), np.zeros(len(heading_rad))], axis=1)
    right = np.cross(along, up)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return np.stack([np.cross(up, right), right, up], axis=1)


def _planes(houses: Houses, base: FloatArray, axes: FloatArray, seed: int) -> tuple[FloatArray, BoolArray]:
    """Return (n, 9, 6) the planes that a building may have, and (n, 9) True for those that it has.

    The planes are four walls, a flat roof, slopes and hips.
    """
    count = len(houses)
    sin, cos = np.sin(houses.pitch_rad), np.cos(houses.pitch_rad)
    half, eaves = 0.5 * houses.size_m, houses.eaves_m
    normal, offset = np.zeros((count, 9, 3)), np.zeros((count, 9))
    for axis in (0, 1):
        for side, sign in enumerate((1.0, -1.0)):
            wall, slope = 2 * axis + side, 5 + 2 * (1 - axis) + side
            normal[:, wall, axis], offset[:, wall] = sign, half[:, axis]
            normal[:, slope, axis], normal[:, slope, 2] = sign * sin, cos
            offset[:, slope] = half[:, axis] * sin + eaves * cos
    normal[:, 4, 2], offset[:, 4] = 1.0, eaves
    normal = np.einsum("npk,nkx->npx", normal, axes)
    offset += np.einsum("npx,nx->np", normal, base)
    of_wall = np.arange(9) < 4
    draws = generator(seed, "terrain", "paint")
    reflectance = np.where(of_wall, draws.uniform(0.3, 0.6, (count, 1)), draws.uniform(0.15, 0.45, (count, 1)))
    surface = np.broadcast_to(np.where(of_wall, float(WALL), float(ROOF)), (count, 9))
    planes = np.concatenate([normal, np.stack([offset, surface, reflectance], axis=2)], axis=2)
    used = np.ones((count, 9), np.bool_)
    used[:, 4] = houses.roof == _FLAT
    used[:, 5:7] = (houses.roof != _FLAT)[:, np.newaxis]
    used[:, 7:9] = (houses.roof == _HIPPED)[:, np.newaxis]
    return planes, used


def build_trees(forests: list[ForestTable], ground: Ground, seed: int) -> FloatArray:
    """Return `Things.tree`, including trees at places that other objects occupy."""
    rows = [np.zeros((0, 7))]
    for index, table in enumerate(forests):
        draws = generator(seed, "terrain", "forest", index)
        size = np.array(table.size_m)
        count = int(np.rint(table.trees_per_ha * abs(np.prod(size)) / 10_000.0))
        place = np.array(table.center_m) + size * draws.uniform(-0.5, 0.5, (count, 2))
        height = table.height_m * np.clip(1.0 + 0.12 * draws.standard_normal(count), 0.6, 1.4)
        radius = height * draws.uniform(0.13, 0.2, count)
        half = 0.5 * height * draws.uniform(0.55, 0.75, count)
        foot = ground.points(place[:, 0], place[:, 1])
        foot[:, 2] += height - half
        leaves = np.stack(
            [1.0 / radius, 1.0 / half, draws.uniform(0.25, 0.5, count), draws.uniform(0.35, 0.6, count)], axis=1
        )
        rows.append(np.concatenate([foot, leaves], axis=1))
    return np.concatenate(rows)


def build_wires(tables: list[WireTable], ground: Ground) -> FloatArray:
    """Return `Things.wire`: parabolas between the tops of their masts, in straight pieces."""
    rows = [np.zeros((0, 7))]
    for table in tables:
        ends = np.array([table.from_m, table.to_m])
        top = ground.points(ends[:, 0], ends[:, 1]) + np.array([0.0, 0.0, table.height_m])
        count = int(np.clip(np.ceil(np.linalg.norm(top[1] - top[0]) / WIRE_PIECE_M), 8, 2000))
        share = np.linspace(0.0, 1.0, count + 1)[:, np.newaxis]
        points = top[0] + share * (top[1] - top[0])
        points[:, 2:] -= 4.0 * table.sag_m * share * (1.0 - share)
        radius = np.full((count, 1), 0.5 * table.diameter_m)
        rows.append(np.concatenate([points[:-1], points[1:], radius], axis=1))
    return np.concatenate(rows)


def build_cars(tables: list[CarTable], seed: int, planes_before: int) -> tuple[FloatArray, FloatArray]:
    """Return planes (5 n, 6) of boxes without a floor, and `Things.car`.

    The planes are to follow ``planes_before`` others.
    """
    paint = generator(seed, "terrain", "cars").uniform(0.1, 0.7, len(tables))
    planes, cars = [np.zeros((0, PLANE))], [np.zeros((0, 12))]
    half_along, half_across, height = np.array(CAR_SIZE_M) * [0.5, 0.5, 1.0]
    for index, table in enumerate(tables):
        way = np.subtract(table.to_m, table.from_m)
        length = float(np.hypot(*way))
        x, y = way / length if length > 0.0 else (0.0, 1.0)
        box = np.zeros((5, PLANE))
        box[:, :3] = np.array([[x, y, 0.0], [-x, -y, 0.0], [y, -x, 0.0], [-y, x, 0.0], [0.0, 0.0, 1.0]])
        box[:, 3] = [half_along, half_along, half_across, half_across, height]
        box[:, 4], box[:, 5] = CAR, paint[index]
        planes.append(box)
        first = PLANE * (planes_before + 5 * index)
        ball = [0.0, 0.0, 0.5 * height, float(np.hypot(half_along, half_across)) + 0.5 * height]
        car = [*ball, first, first + box.size, *table.from_m, x, y, length, table.speed_mps]
        cars.append(np.array([car], np.float64))
    return np.concatenate(planes), np.concatenate(cars)


def build_lakes(lakes: list[Lake]) -> FloatArray:
    """Return the rows of `Things.lake`."""
    rows = [[*lake.center, *lake.up, lake.radius_m, lake.returns] for lake in lakes]
    return np.array(rows, np.float64).reshape(-1, 8)


def build_roads(tables: list[RoadTable]) -> FloatArray:
    """Return `Things.road`: the pieces between the points of each road."""
    rows = [np.zeros((0, 8))]
    for number, table in enumerate(tables):
        points = np.array(table.points_m)
        length = np.linalg.norm(np.diff(points, axis=0), axis=1)
        kept = length > 0.0
        piece = np.zeros((int(kept.sum()), 8))
        piece[:, :2], piece[:, 2:4] = points[:-1][kept], points[1:][kept]
        piece[:, 4], piece[:, 6], piece[:, 7] = 0.5 * table.width_m, table.markings, number
        piece[:, 5] = (np.cumsum(length) - length)[kept]
        rows.append(piece)
    return np.concatenate(rows)


def near_circles(points: FloatArray, radius_m: FloatArray, centers: FloatArray, within_m: FloatArray) -> BoolArray:
    """Return (n,) True where circles about points (n, 2) touch circles about centres (k, 2)."""
    near = np.zeros(len(points), np.bool_)
    if len(points) and len(centers):
        tree = cKDTree(points)
        for center, within, found in zip(
            centers, within_m, tree.query_ball_point(centers, within_m + np.max(radius_m)), strict=True
        ):
            at = np.array(found, np.int64)
            near[at] |= np.linalg.norm(points[at] - center, axis=1) < within + radius_m[at]
    return near


def near_pieces(points: FloatArray, radius_m: FloatArray, pieces: FloatArray, within_m: FloatArray) -> BoolArray:
    """Return (n,) True where circles about points (n, 2) come within (k,) of straight pieces (k, 4) from, to."""
    near = np.zeros(len(points), np.bool_)
    if not len(points) or not len(pieces):
        return near
    tree = cKDTree(points)
    along = pieces[:, 2:] - pieces[:, :2]
    reach = 0.5 * np.linalg.norm(along, axis=1) + within_m + np.max(radius_m)
    for piece, step, within, found in zip(
        pieces, along, within_m, tree.query_ball_point(pieces[:, :2] + 0.5 * along, reach), strict=True
    ):
        at = np.array(found, np.int64)
        offset = points[at] - piece[:2]
        share = np.clip(offset @ step / max(float(step @ step), 1e-12), 0.0, 1.0)
        near[at] |= np.linalg.norm(offset - share[:, np.newaxis] * step, axis=1) < within + radius_m[at]
    return near
