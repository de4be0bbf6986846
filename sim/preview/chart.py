"""Places a plan's map in the CRS of its products, and gives its lines colours."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from matplotlib.path import Path as Outline
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError

from swath.georef.arrays import BoolArray, FloatArray
from swath.georef.strip_colours import colours_of, contact
from swath.sim.preview.coverage import Survey

CELLS = 96  # along the longer side of a plan, in which it is counted how much ground lines share


class Chart:
    """Easting and northing of a plan's places, in metres.

    They are those of the plan's CRS; where that is not one of easting and northing in metres, those of the UTM zone.

    Attributes:
        name: name of the CRS.
    """

    def __init__(self, survey: Survey) -> None:
        self._survey = survey
        flight = survey.plan.tables.flight
        crs = _metric(flight.crs, *flight.origin_deg)
        self.name = str(crs.name)
        self._height_m = float(survey.plan.tables.terrain.height_m)
        self._to_map = Transformer.from_crs("EPSG:4978", crs, always_xy=True)
        self._to_earth = Transformer.from_crs(crs.to_3d(), "EPSG:4978", always_xy=True)

    def place(self, points: FloatArray) -> FloatArray:
        """Return easting and northing (…, 2) of places (…, 2) east and north in the site frame."""
        flat = np.asarray(points, np.float64).reshape(-1, 2)
        site = self._survey.site
        points_e = site.e_from_site(site.site_from_ground(flat[:, 0], flat[:, 1], np.full(len(flat), self._height_m)))
        east_m, north_m = self._to_map.transform(*points_e.T)[:2]
        return np.column_stack([east_m, north_m]).reshape(np.shape(points))

    def back(self, points: FloatArray) -> FloatArray:
        """Return east and north (n, 2) in the site frame of places (n, 2) on the map."""
        height_m = np.full(len(points), self._height_m)
        points_e = np.column_stack(self._to_earth.transform(points[:, 0], points[:, 1], height_m))
        return np.asarray(self._survey.site.site_from_e(points_e)[:, :2])

    @cached_property
    def colours(self) -> list[str]:
        """A colour for each line; lines whose swaths share ground or touch differ."""
        survey = self._survey
        outlines = [np.asarray(survey.edges(strip)) for strip in survey.strips]
        every = np.concatenate(outlines)
        low, side = every.min(axis=0), max(float(np.ptp(every, axis=0).max()), 1e-6) / CELLS
        middles = low + side * (np.stack(np.meshgrid(np.arange(CELLS), np.arange(CELLS)), axis=-1) + 0.5)
        occupied: BoolArray = np.zeros((len(outlines), CELLS, CELLS), bool)
        for number, outline in enumerate(outlines):
            inside = Outline(outline).contains_points(middles.reshape(-1, 2), radius=0.7 * side)
            inside |= Outline(outline).contains_points(middles.reshape(-1, 2), radius=-0.7 * side)
            occupied[number] = inside.reshape(CELLS, CELLS)
        return colours_of(contact(occupied))


def _metric(text: str, lat_deg: float, lon_deg: float) -> CRS:
    """Return the horizontal CRS of a text if it counts easting and northing in metres, else the UTM zone of a place."""
    try:
        crs = CRS(text)
    except CRSError:
        crs = None
    if crs is not None and crs.is_compound:
        crs = crs.sub_crs_list[0]
    if crs is not None and crs.is_projected and all(axis.unit_name == "metre" for axis in crs.axis_info):
        return crs
    zone = int((lon_deg + 180.0) // 6.0) % 60 + 1
    return CRS(f"EPSG:{(32600 if lat_deg >= 0.0 else 32700) + zone}")
