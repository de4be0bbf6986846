"""Gives easting and northing to pictures of a flight: in its products' CRS, or else in the UTM zone it lies in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from pyproj import CRS, Transformer
from pyproj.aoi import AreaOfInterest
from pyproj.database import query_utm_crs_info

from swath.georef.arrays import FloatArray
from swath.georef.geodesy.earth import geodetic_from_e
from swath.georef.mapping.datums import MappingError
from swath.georef.mapping.frame import Mapping

POLAR = ("EPSG:32661", "EPSG:32761")  # WGS 84 / UPS North and South (E,N), beyond the zones of UTM


@dataclass(frozen=True, eq=False)
class Chart:
    """Coordinates of a map that is drawn.

    Attributes:
        name: name of the CRS.
        unit: unit of its coordinates, as an abbreviation.
        unit_m: metres in this unit.
        map_from_e: function that returns easting and northing (n, 2) of positions in e (n, 3).
    """

    name: str
    unit: str
    unit_m: float
    map_from_e: Callable[[FloatArray], FloatArray]


def chart_of(mapping: Mapping | None, positions_e: FloatArray) -> Chart:
    """Return the coordinates in which a flight's maps are drawn.

    Args:
        mapping: mapping of the flight's products; None, or one in degrees or in e, or one that does not reach the
            positions: the UTM zone.
        positions_e: (n, 3) of the flight.
    """
    known = positions_e[np.isfinite(positions_e).all(axis=1)]
    if mapping is not None and len(known):
        try:
            described = mapping.description()
            if described["axes"][0] == "E":
                mapping.map_from_e(known[:: max(1, len(known) // 100)])
                unit = str(described["units"]["names"][0])
                short = {"metre": "m", "foot": "ft", "US survey foot": "US ft"}.get(unit, unit)
                return Chart(
                    str(described["name"]),
                    short,
                    float(mapping.unit_m[0]),
                    lambda points: mapping.map_from_e(points)[:, :2],
                )
        except MappingError:
            pass
    return _utm(known if len(known) else np.array([[6_378_137.0, 0.0, 0.0]]))


def _utm(positions_e: FloatArray) -> Chart:
    """Return the chart of the UTM zone on WGS 84 in which the middle of a flight lies; near the poles that of UPS."""
    lat, lon, _ = (np.degrees(angle) for angle in geodetic_from_e(positions_e[len(positions_e) // 2, np.newaxis]))
    place = AreaOfInterest(float(lon[0]), float(lat[0]), float(lon[0]), float(lat[0]))
    zones = query_utm_crs_info(datum_name="WGS 84", area_of_interest=place)
    found = [zone.code for zone in zones if len(zone.name) <= len("WGS 84 / UTM zone 32N")]  # others list north first
    crs = CRS(f"EPSG:{found[0]}" if found else POLAR[float(lat[0]) < 0.0])
    transformer = Transformer.from_crs("EPSG:4978", crs, always_xy=True)

    def map_from_e(points_e: FloatArray) -> FloatArray:
        x, y, z = np.asarray(points_e, np.float64).T
        east_m, north_m = transformer.transform(x, y, z)[:2]
        return np.column_stack([east_m, north_m])

    return Chart(str(crs.name), "m", 1.0, map_from_e)
