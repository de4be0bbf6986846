"""Villages: houses on lots along streets that cross."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from swath.georef.arrays import BoolArray, FloatArray, Int64Array
from swath.sim.clocks import generator
from swath.sim.plan.errors import PlanError
from swath.sim.plan.terrain_tables import BuildingTable, RoadTable, VillageTable

Placed = Callable[[FloatArray], FloatArray]
"""East, north of places along and across a village's heading, (n, 2) both."""

ROOFS = ("flat", "gabled", "hipped")
STREET_M = 6.0
VERGE_M = 2.0  # between a street and the lots
LARGEST_LOT_M = (26.0, 30.0)  # along and away from the street
SMALLEST_LOT_M = (13.0, 15.0)
LOTS_BETWEEN_CROSSINGS = 5
_TURN_DEG = 4.0  # one sigma of a house's heading relative to its street


@dataclass(frozen=True)
class Houses:
    """Buildings: rectangles with a roof.

    Attributes:
        center_m: (n, 2) east, north.
        size_m: (n, 2) along and across the ridge.
        heading_rad: (n,) azimuth of the ridge.
        eaves_m: (n,) height above the highest ground under the building.
        roof: (n,) index into `ROOFS`.
        pitch_rad: (n,) pitch of the roof.
    """

    center_m: FloatArray
    size_m: FloatArray
    heading_rad: FloatArray
    eaves_m: FloatArray
    roof: Int64Array
    pitch_rad: FloatArray

    @classmethod
    def of_tables(cls, tables: list[BuildingTable]) -> Houses:
        """Return the plan's own buildings."""
        return cls(
            np.array([table.center_m for table in tables], np.float64).reshape(-1, 2),
            np.array([table.size_m for table in tables], np.float64).reshape(-1, 2),
            np.radians([table.heading_deg for table in tables]),
            np.array([table.eaves_m for table in tables], np.float64),
            np.array([ROOFS.index(table.roof) for table in tables], np.int64),
            np.radians([table.roof_pitch_deg for table in tables]),
        )

    def __len__(self) -> int:
        """Return the number of buildings."""
        return len(self.eaves_m)

    @property
    def radius_m(self) -> FloatArray:
        """(n,) radii of the circles around the buildings."""
        return 0.5 * np.hypot(self.size_m[:, 0], self.size_m[:, 1])

    def only(self, wanted: BoolArray) -> Houses:
        """Return the buildings that are wanted."""
        return Houses(*(getattr(self, name)[wanted] for name in self.__dataclass_fields__))

    def and_also(self, others: Houses) -> Houses:
        """Return these buildings followed by others."""
        names = self.__dataclass_fields__
        return Houses(*(np.concatenate([getattr(self, name), getattr(others, name)]) for name in names))


@dataclass(frozen=True)
class _Lots:
    """The pattern of the streets, in metres along and across the village's heading.

    Attributes:
        center: (n, 2) centres of lots.
        size: (2,) of a lot, along and away from the street.
        along: positions, across the heading, of the streets along it.
        across: positions, along the heading, of the streets across it.
    """

    center: FloatArray
    size: FloatArray
    along: FloatArray
    across: FloatArray


def build_village(table: VillageTable, seed: int, index: int) -> tuple[Houses, list[RoadTable]]:
    """Return houses and streets; ``index`` of the table names it in errors and gives it its own random numbers.

    Raises:
        PlanError: ``terrain.village[i]``: there is no room for so many houses.
    """
    draws = generator(seed, "terrain", "village", index)
    extent = np.array([table.size_m[1], table.size_m[0]])  # north is along heading 0
    lots = _lots(extent, table.houses, f"terrain.village[{index}].houses")
    used = np.sort(draws.permutation(len(lots.center))[: table.houses])
    heading = math.radians(table.heading_deg)
    to_east_north = np.array([[math.sin(heading), math.cos(heading)], [math.cos(heading), -math.sin(heading)]])

    def placed(points: FloatArray) -> FloatArray:
        moved: FloatArray = points @ to_east_north.T + table.center_m
        return moved

    return _houses(table, draws, lots, placed, used), _streets(extent, lots, placed)


def _lots(extent: FloatArray, houses: int, key: str) -> _Lots:
    """Return the largest lots that have room for the houses."""
    for scale in np.linspace(1.0, SMALLEST_LOT_M[0] / LARGEST_LOT_M[0], 25):
        lots = _lots_of_size(extent, scale * np.array(LARGEST_LOT_M))
        if len(lots.center) >= houses:
            return lots
    place = f"{extent[1]:g} × {extent[0]:g} m"
    raise PlanError(key, f"{houses} do not fit into {place}; set at most {len(lots.center)}, or a larger size_m")


def _lots_of_size(extent: FloatArray, size: FloatArray) -> _Lots:
    """Return rows of lots on both sides of the streets along, with a crossing street every few lots."""
    street = STREET_M + 2 * VERGE_M
    strip = street + 2 * size[1]
    rows = int(extent[1] // strip)
    along = strip * (np.arange(rows) - 0.5 * (rows - 1))
    b = np.concatenate([along - 0.5 * (street + size[1]), along + 0.5 * (street + size[1])])
    across = np.arange(0.0, extent[0], street + LOTS_BETWEEN_CROSSINGS * size[0])
    a = (across[:, np.newaxis] + 0.5 * street + size[0] * (0.5 + np.arange(LOTS_BETWEEN_CROSSINGS))).ravel()
    a = a[a + 0.5 * size[0] <= extent[0]]
    center = np.stack([axis.ravel() for axis in np.meshgrid(a - 0.5 * extent[0], b, indexing="ij")], axis=1)
    return _Lots(center, size, along, across - 0.5 * extent[0])


def _houses(table: VillageTable, draws: np.random.Generator, lots: _Lots, placed: Placed, used: Int64Array) -> Houses:
    """Return one house on each used lot; it is turned a little, and all its corners stay within its lot."""
    count = len(used)
    turn = np.radians(np.clip(_TURN_DEG * draws.standard_normal(count), -10.0, 10.0))
    crosswise = draws.random(count) < 0.5
    room = lots.size - 1.0
    length = draws.uniform(0.55, 0.8, count) * room[0]
    width = np.minimum(draws.uniform(0.55, 0.85, count) * length, 0.6 * room[1])
    size = np.stack([length, width], axis=1)
    cos, sin = np.cos(turn), np.abs(np.sin(turn))
    reach = np.stack([length * cos + width * sin, length * sin + width * cos], axis=1)
    reach[crosswise] = reach[crosswise, ::-1]
    fits = np.minimum(1.0, np.min(room / reach, axis=1))[:, np.newaxis]
    size, reach = size * fits, reach * fits
    center = lots.center[used] + draws.uniform(-0.5, 0.5, (count, 2)) * (room - reach)
    return Houses(
        placed(center),
        size,
        math.radians(table.heading_deg) + turn + np.where(crosswise, 0.5 * math.pi, 0.0),
        draws.uniform(3.0, 7.0, count),
        np.array([ROOFS.index(roof) for roof in table.roofs], np.int64)[draws.integers(0, len(table.roofs), count)],
        np.radians(draws.uniform(20.0, 45.0, count)),
    )


def _streets(extent: FloatArray, lots: _Lots, placed: Placed) -> list[RoadTable]:
    half = 0.5 * extent
    ends = [[[-half[0], b], [half[0], b]] for b in lots.along]
    ends += [[[a, -half[1]], [a, half[1]]] for a in lots.across]
    return [RoadTable(points_m=placed(np.array(points)).tolist(), width_m=STREET_M) for points in ends]
