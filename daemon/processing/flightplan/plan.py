"""A flight plan: named lines and an area, on the ellipsoid of WGS 84.

Between two vertices a line is the geodesic, which is the way of an aircraft that flies straight ahead.
"""

from __future__ import annotations

from dataclasses import dataclass

from swath.georef.arrays import FloatArray


class PlanError(ValueError):
    """Raised for a plan that cannot be used; one line: fact and remedy."""


@dataclass(frozen=True, slots=True, eq=False)
class PlannedLine:
    """A line of the plan.

    Attributes:
        name: unique within the plan.
        lat_deg, lon_deg: (n,) of its vertices, n ≥ 2.
        height_m: (n,) ellipsoidal heights; nan where the plan gives none.
        above_ground_m: (n,) heights above ground; nan where the plan gives none.
        speed_mps: wanted speed over the ground; nan: the plan gives none.
    """

    name: str
    lat_deg: FloatArray
    lon_deg: FloatArray
    height_m: FloatArray
    above_ground_m: FloatArray
    speed_mps: float = float("nan")


@dataclass(frozen=True, slots=True, eq=False)
class FlightPlan:
    """A plan as it was read.

    Attributes:
        name: name of its file.
        lines: in the order of the file.
        area: polygons of the area to be covered: rings (n, 2) of latitude and longitude in degrees, the outer one
            first, then its holes.
        notes: what was assumed, one line each, for people.
    """

    name: str
    lines: tuple[PlannedLine, ...]
    area: tuple[tuple[FloatArray, ...], ...] = ()
    notes: tuple[str, ...] = ()
