"""The scene of a flight: the ground of the plan, the objects on it, and rays cast at them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import Delaunay

from swath.georef.arrays import BoolArray, FloatArray, Int64Array
from swath.sim.clocks import generator
from swath.sim.plan.errors import PlanError
from swath.sim.plan.plan import Plan
from swath.sim.plan.tables import ScannerTable
from swath.sim.plan.terrain_tables import CarTable, RoadTable, TerrainTable, WireTable
from swath.sim.scene.casting import CARS, COVERS, LAKES, ROADS, SOLIDS, THINGS, TREES, WIRES, Frame, SceneArrays
from swath.sim.scene.cells import CELL_M, Listed, build_cells
from swath.sim.scene.echoes import cast_pulses, workspace_bytes
from swath.sim.scene.objects import (
    CAR_SIZE_M,
    Solids,
    Things,
    build_cars,
    build_lakes,
    build_roads,
    build_solids,
    build_trees,
    build_wires,
    flat,
    near_circles,
    near_pieces,
)
from swath.sim.scene.terrain import Ground, build_ground, fill_lake
from swath.sim.scene.village import Houses, build_village
from swath.sim.shots import Echoes
from swath.sim.site import Site

Seen = Callable[[FloatArray, FloatArray], BoolArray]

FOOTPRINT_M = (1.0, 20.0)  # limits of the beam radius for which neighbouring cells list objects too
CONTROL_CLEAR_M = 4.0
_CAR_REACH_M = 3.0


@dataclass(frozen=True)
class Scene:
    """Everything that rays are cast at and that a map shows; places are east and north, metres, site frame.

    Attributes:
        site: the frame.
        ground: the ground without objects.
        corners: (k, 2) corners of the area that had to be covered.
        buildings: (n, 4, 2) corners of footprints.
        roads: of the plan and of villages.
        waters: (n, 3) centres and radii.
        trees: (n, 3) centres and radii of crowns.
        wires: (n, 4) from, to.
        cars: (n, 4) from, to.
        arrays: for the compiled functions.
    """

    site: Site
    ground: Ground
    corners: FloatArray
    buildings: FloatArray
    roads: list[RoadTable]
    waters: FloatArray
    trees: FloatArray
    wires: FloatArray
    cars: FloatArray
    arrays: SceneArrays

    def ground_m(self, east_m: FloatArray, north_m: FloatArray) -> FloatArray:
        """Return (n,) ellipsoidal heights of the ground at site x and y (n,).

        Beyond the area they are those of its nearest place.
        """
        return self.ground.ground_m(east_m, north_m)

    def site_z(self, east_m: FloatArray, north_m: FloatArray) -> FloatArray:
        """Return (n,) site z of the ground at site x and y (n,)."""
        return self.ground.site_z(east_m, north_m)

    def cast(
        self,
        origin: FloatArray,
        direction: FloatArray,
        time_s: FloatArray,
        number: Int64Array,
        divergence_rad: float,
        pulse_m: float,
        slots: int,
    ) -> Echoes:
        """Return echoes of pulses; those of a pulse do not depend on the other pulses of the batch.

        Args:
            origin: (n, 3) site frame, metres.
            direction: (n, 3) unit vectors, site frame.
            time_s: (n,) times of emission, which the positions of cars depend on.
            number: (n,) numbers of the pulses; random effects on a pulse depend on the plan's seed and this number.
            divergence_rad: full angle of the beam; 0: a line.
            pulse_m: echoes nearer to each other than this are merged.
            slots: echoes kept of a pulse: the first ones and the last.
        """
        shape = (len(origin), slots)
        range_m, reflectance, incidence_rad = np.full(shape, np.nan), np.zeros(shape), np.zeros(shape)
        surface = np.zeros(shape, np.uint8)
        cast_pulses(
            self.arrays,
            workspace_bytes(),
            np.ascontiguousarray(origin, np.float64),
            np.ascontiguousarray(direction, np.float64),
            np.ascontiguousarray(time_s, np.float64),
            np.ascontiguousarray(number, np.int64),
            0.5 * float(divergence_rad),
            float(pulse_m),
            range_m,
            reflectance,
            incidence_rad,
            surface,
        )
        return Echoes(range_m, reflectance, incidence_rad, surface)

    def control_points(self, count: int, seed: int, seen: Seen | None = None) -> FloatArray:
        """Return (count, 3) open places on the flatter half of the ground, far from each other, site frame.

        Args:
            count: number of places.
            seed: of the choice.
            seen: function that tells which places (n,) east and north count; None: all places between the corners.

        Raises:
            PlanError: ``control.points``: there are not so many.
        """
        draws = generator(seed, "control", "places")
        low, high = np.min(self.corners, axis=0), np.max(self.corners, axis=0)
        places = draws.uniform(low, high, (2000 + 50 * count, 2))
        if np.linalg.matrix_rank(self.corners - self.corners[0]) == 2:
            places = places[Delaunay(self.corners).find_simplex(places) >= 0]
        if seen is not None:
            places = places[seen(places[:, 0], places[:, 1])]
        places = places[~self._occupied(places, CONTROL_CLEAR_M)]
        if len(places) < 2 * count:
            raise PlanError(
                "control.points", f"the open ground has no room for {count}; set at most {len(places) // 2}"
            )
        slope = self.ground.slope(places[:, 0], places[:, 1])
        places = places[np.argsort(slope, kind="stable")[: max(2 * count, len(places) // 2)]]
        chosen = _far_apart(places, count)
        return self.ground.points(chosen[:, 0], chosen[:, 1])

    def _occupied(self, places: FloatArray, clear_m: float) -> BoolArray:
        """Return (n,) True where an object is nearer to places (n, 2) than this; roads do not count."""
        clear = np.full(len(places), clear_m)
        center = np.mean(self.buildings, axis=1)
        radius = np.max(np.linalg.norm(self.buildings - center[:, np.newaxis], axis=2), axis=1, initial=0.0)
        taken = near_circles(places, clear, center, radius)
        for circles in (self.trees, self.waters):
            taken |= near_circles(places, clear, circles[:, :2], circles[:, 2])
        for lines in (self.wires, self.cars):
            taken |= near_pieces(places, clear, lines, np.full(len(lines), _CAR_REACH_M))
        return taken


def _far_apart(places: FloatArray, count: int) -> FloatArray:
    """Return some of the places, each as far as possible from those chosen before."""
    chosen = np.zeros((count, 2))
    distance = np.full(len(places), np.inf)
    at = 0
    for k in range(count):
        chosen[k] = places[at]
        distance = np.minimum(distance, np.linalg.norm(places - places[at], axis=1))
        at = int(np.argmax(distance))
    return chosen


def build_scene(plan: Plan, site: Site, corners: FloatArray) -> Scene:
    """Return the scene over corners (k, 2) east, north, and `swath.sim.scene.terrain.MARGIN_M` around.

    Objects beyond are left out.

    Raises:
        PlanError: ``terrain.cell_m``: the area is too large for it; ``terrain.raster``: it cannot be used;
            ``terrain.village[i].houses``: there is no room for them.
    """
    table = plan.tables.terrain
    corners = np.asarray(corners, np.float64)
    ground = build_ground(plan, site, corners)
    lakes = [
        fill_lake(ground, water.center_m, water.radius_m, water.returns)
        for water in table.water
        if _covered(ground, [water.center_m])
    ]
    water = build_lakes(lakes)
    houses, roads = _settle(table, ground, water)
    road = build_roads(roads)
    solids = build_solids(houses, ground, table.seed)
    wires = [wire for wire in table.wire if _covered(ground, [wire.from_m, wire.to_m])]
    driven = [car for car in table.car if _covered(ground, [car.from_m, car.to_m])]
    planes, cars = build_cars(driven, table.seed, len(solids.plane))
    things = Things(
        np.concatenate([solids.plane, planes]),
        solids.solid,
        _standing(build_trees(table.forest, ground, table.seed), ground, houses, road, water),
        build_wires(wires, ground),
        cars,
        water,
        road,
    )
    return Scene(
        site,
        ground,
        corners,
        solids.polygon,
        roads,
        water[:, [0, 1, 6]],
        np.column_stack([things.tree[:, :2], 1 / things.tree[:, 3]]),
        _ends(wires),
        _ends(driven),
        _arrays(plan, ground, things, solids, _ends(driven)),
    )


def _ends(tables: list[WireTable] | list[CarTable]) -> FloatArray:
    """Return (n, 4) the two ends, from and to."""
    return np.array([[*table.from_m, *table.to_m] for table in tables], np.float64).reshape(-1, 4)


def _covered(ground: Ground, places: list[list[float]]) -> bool:
    points = np.array(places)
    return bool(np.all(ground.covers(points[:, 0], points[:, 1])))


def _settle(table: TerrainTable, ground: Ground, water: FloatArray) -> tuple[Houses, list[RoadTable]]:
    """Return buildings and roads: the plan's own, then villages where there is room beside them."""
    houses = Houses.of_tables(table.building)
    houses = houses.only(_on_grid(ground, houses))
    roads = list(table.road)
    for index, village in enumerate(table.village):
        more, streets = build_village(village, table.seed, index)
        road = build_roads(table.road)
        taken = near_circles(more.center_m, more.radius_m, houses.center_m, houses.radius_m)
        taken |= near_circles(more.center_m, more.radius_m, water[:, :2], water[:, 6])
        taken |= near_pieces(more.center_m, more.radius_m, road[:, :4], road[:, 4])
        houses = houses.and_also(more.only(_on_grid(ground, more) & ~taken))
        roads += streets
    return houses, roads


def _on_grid(ground: Ground, houses: Houses) -> BoolArray:
    radius = houses.radius_m[:, np.newaxis]
    low, high = houses.center_m - radius, houses.center_m + radius
    return ground.covers(low[:, 0], low[:, 1]) & ground.covers(high[:, 0], high[:, 1])


def _standing(trees: FloatArray, ground: Ground, houses: Houses, road: FloatArray, water: FloatArray) -> FloatArray:
    """Return the trees on the grid that touch no house, no water and no road."""
    place, radius = trees[:, :2], 1 / trees[:, 3]
    taken = near_circles(place, radius, houses.center_m, houses.radius_m)
    taken |= near_circles(place, radius, water[:, :2], water[:, 6])
    taken |= near_pieces(place, radius, road[:, :4], road[:, 4])
    return trees[~taken & ground.covers(place[:, 0], place[:, 1])]


def _arrays(plan: Plan, ground: Ground, things: Things, solids: Solids, ways: FloatArray) -> SceneArrays:
    """Return the tables and lists for the compiled functions."""
    foot_m = _footprint_m(list(plan.tables.scanner.values()))
    rows, starts = flat(things)
    tree, wire, lake = things.tree, things.wire, things.lake
    of_wire = np.concatenate([np.minimum(wire[:, :2], wire[:, 3:5]), np.maximum(wire[:, :2], wire[:, 3:5])], axis=1)
    piece, of_road = _pieces(things.road[:, :4])
    driven, of_car, car_top = _driven(ways, ground)
    cells = build_cells(
        ground,
        [
            _listed(THINGS, SOLIDS, starts["solid"], solids.box, solids.top_z + foot_m, foot_m),
            _listed(
                THINGS, TREES, starts["tree"], _around(tree[:, :2], 1 / tree[:, 3]), tree[:, 2] + 1 / tree[:, 4], 0.0
            ),
            _listed(THINGS, WIRES, starts["wire"], of_wire, np.maximum(wire[:, 2], wire[:, 5]) + foot_m, foot_m),
            _listed(THINGS, CARS, starts["car"][driven], of_car, car_top + foot_m, foot_m + _CAR_REACH_M),
        ],
        [
            _listed(COVERS, ROADS, starts["road"][piece], of_road, np.zeros(len(piece)), things.road[piece, 4]),
            _listed(COVERS, LAKES, starts["lake"], _around(lake[:, :2], lake[:, 6]), np.zeros(len(lake)), 1.0),
        ],
    )
    floor_z, roof_z = float(np.min(ground.z)) - 1.0, float(np.max(cells.top)) + 1.0
    table = plan.tables.terrain
    frame = Frame(ground.west_m, ground.south_m, ground.cell_m, cells.size_m, floor_z, roof_z, table.reflectance)
    return SceneArrays(frame, ground.z, *cells[1:], rows, plan.tables.flight.seed)


def _around(center: FloatArray, radius: FloatArray) -> FloatArray:
    return np.concatenate([center - radius[:, np.newaxis], center + radius[:, np.newaxis]], axis=1)


def _footprint_m(scanners: list[ScannerTable]) -> float:
    """Return the radius of the widest beam at the end of its range, within `FOOTPRINT_M`."""
    widest = max((0.5e-3 * one.divergence_mrad * one.range_max_m for one in scanners), default=0.0)
    return float(np.clip(widest, *FOOTPRINT_M))


def _listed(
    kinds: int, kind: int, start: Int64Array, box: FloatArray, top_z: FloatArray, wider_m: FloatArray | float
) -> Listed:
    """Return the objects of a kind, in boxes widened on all sides."""
    wider = np.broadcast_to(wider_m, len(box))[:, np.newaxis]
    return Listed(kinds * start + kind, np.concatenate([box[:, :2] - wider, box[:, 2:] + wider], axis=1), top_z)


def _pieces(lines: FloatArray) -> tuple[Int64Array, FloatArray]:
    """Return straight lines (n, 4) cut into pieces about as long as a cell: the line of each, and its box (m, 4)."""
    length = np.linalg.norm(lines[:, 2:] - lines[:, :2], axis=1)
    count = np.maximum(np.ceil(length / CELL_M), 1).astype(np.int64)
    row = np.repeat(np.arange(len(lines)), count)
    number = np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count)
    first, last = (
        lines[row, :2] + (share / count[row])[:, np.newaxis] * (lines[row, 2:] - lines[row, :2])
        for share in (number, number + 1)
    )
    return row, np.concatenate([np.minimum(first, last), np.maximum(first, last)], axis=1)


def _driven(ways: FloatArray, ground: Ground) -> tuple[Int64Array, FloatArray, FloatArray]:
    """Return pieces of the cars' ways: the car of each, its box (m, 4), and the z limit of the car there (m,)."""
    row, box = _pieces(ways)
    across = np.linspace(0.0, 1.0, 2 + int(2 * CELL_M / ground.cell_m))
    x = box[:, np.newaxis, :1] + across[:, np.newaxis] * (box[:, 2:3] - box[:, :1])[:, np.newaxis]
    y = box[:, np.newaxis, 1:2] + across[:, np.newaxis] * (box[:, 3:] - box[:, 1:2])[:, np.newaxis]
    z = ground.site_z(*np.broadcast_arrays(x, np.swapaxes(y, 1, 2)))
    return row, box, np.max(z, axis=(1, 2), initial=-np.inf) + CAR_SIZE_M[2] + 1.0
