"""``[terrain]`` of a plan: every key of the ground and of the objects on it."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from swath.sim.plan.base import NotNegative, Point, Positive, Section

Roof = Literal["flat", "gabled", "hipped"]


def _all_roofs() -> list[Roof]:
    return ["gabled", "hipped", "flat"]


class VillageTable(Section):
    """``[[terrain.village]]``: houses along roads that cross."""

    center_m: Point = Field(description="east, north of its centre")
    size_m: Point = Field(description="extent east, north")
    heading_deg: float = Field(0.0, description="heading of its streets")
    houses: int = Field(
        60, ge=1, le=100_000, description="houses on lots along its streets; those without room are left out"
    )
    roofs: list[Roof] = Field(default_factory=_all_roofs, min_length=1, description="kinds of roofs, drawn at random")


class BuildingTable(Section):
    """``[[terrain.building]]``: one building on a level floor at the terrain's height."""

    center_m: Point = Field(description="east, north of its centre")
    size_m: Point = Field(description="extent along and across its ridge")
    heading_deg: float = Field(0.0, description="heading of its ridge")
    eaves_m: Positive = Field(6.0, description="height of the eaves above the terrain")
    roof: Roof = Field("gabled", description="flat, of two planes, or of four planes")
    roof_pitch_deg: float = Field(35.0, gt=0.0, le=70.0, description="slope of the roof's planes")


class RoadTable(Section):
    """``[[terrain.road]]``: asphalt with painted lines along its edges and middle."""

    points_m: list[Point] = Field(min_length=2, description="east, north of its bends")
    width_m: Positive = Field(6.0, description="width of the asphalt")
    markings: bool = Field(True, description="painted lines, brighter than asphalt")


class WaterTable(Section):
    """``[[terrain.water]]``: a level lake; most pulses give no return."""

    center_m: Point = Field(description="east, north of its centre")
    radius_m: Positive = Field(description="radius of its shore")
    returns: float = Field(0.1, ge=0.0, le=1.0, description="share of pulses near nadir that give a return")


class ForestTable(Section):
    """``[[terrain.forest]]``: trees at random places."""

    center_m: Point = Field(description="east, north of its centre")
    size_m: Point = Field(description="extent east, north")
    trees_per_ha: Positive = Field(150.0, description="mean number of trees")
    height_m: Positive = Field(18.0, description="approximate height of its trees")


class WireTable(Section):
    """``[[terrain.wire]]``: a conductor between two masts."""

    from_m: Point = Field(description="east, north of one end")
    to_m: Point = Field(description="east, north of the other end")
    height_m: Positive = Field(20.0, description="height of its ends above the terrain")
    sag_m: NotNegative = Field(4.0, description="depth of its middle below its ends")
    diameter_m: Positive = Field(0.03, description="diameter of the conductor")


class CarTable(Section):
    """``[[terrain.car]]``: a car that drives from one point to the other and back again."""

    from_m: Point = Field(description="east, north of one end of its way")
    to_m: Point = Field(description="east, north of the other end")
    speed_mps: NotNegative = Field(14.0, description="speed; 0: parked")


class TerrainTable(Section):
    """``[terrain]``: the ground and the objects on it."""

    height_m: float = Field(450.0, ge=-500.0, le=9000.0, description="ellipsoidal height at the origin")
    slope_percent: float = Field(0.0, ge=0.0, le=100.0, description="slope of the whole site")
    slope_towards_deg: float = Field(0.0, description="azimuth towards which the site falls")
    relief_m: float = Field(0.0, ge=0.0, le=2000.0, description="height of hills above valleys")
    wavelength_m: float = Field(800.0, ge=50.0, description="distance from hill to hill")
    raster: str = Field("", description="GeoTIFF of ellipsoidal heights that replaces the hills; relative to the plan")
    cell_m: float = Field(5.0, ge=0.25, le=100.0, description="cell size of the ground's grid")
    reflectance: float = Field(0.35, gt=0.0, le=1.0, description="reflectance of the ground")
    seed: int = Field(1, ge=0, lt=2**63, description="seed of random places: hills, houses, trees")
    village: list[VillageTable] = Field(default_factory=list)
    building: list[BuildingTable] = Field(default_factory=list)
    road: list[RoadTable] = Field(default_factory=list)
    water: list[WaterTable] = Field(default_factory=list)
    forest: list[ForestTable] = Field(default_factory=list)
    wire: list[WireTable] = Field(default_factory=list)
    car: list[CarTable] = Field(default_factory=list)
