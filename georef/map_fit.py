"""Check whether a projected CRS suits a place: its area of use, and the length of a metre on its map."""

from __future__ import annotations

import numpy as np
import pyproj
from pyproj import CRS
from pyproj.aoi import AreaOfInterest
from pyproj.database import query_utm_crs_info

from swath.georef.arrays import FloatArray

OVERLAP_M = 40_000.0  # overlap of neighbouring UTM zones
DEGREE_M = 111_200.0  # of a great circle
GREATEST_SCALE = 0.005  # greatest deviation of the scale from 1


def scales_at(crs: CRS, lat_deg: FloatArray, lon_deg: FloatArray) -> FloatArray:
    """Return the map metres per metre on the ground along meridian and parallel (2, n), of a projected CRS."""
    factors = pyproj.Proj(crs).get_factors(lon_deg, lat_deg)
    return np.stack([np.asarray(factors.meridional_scale), np.asarray(factors.parallel_scale)])


def misfit_of(crs: CRS, said: str, lat_deg: FloatArray, lon_deg: FloatArray) -> str:
    """Return why a projected CRS does not suit places (n,), with a zone that would; empty if it suits.

    It does not suit if a place lies farther outside the area of use than neighbouring zones overlap, or if the scale
    there deviates from 1 by 0.5 %, so that a metre of the map is not one on the ground.

    Args:
        crs: without heights.
        said: its name for the message.
        lat_deg, lon_deg: the places.
    """
    away_m = DEGREE_M * outside_deg(crs, lat_deg, lon_deg)
    scales = scales_at(crs, lat_deg, lon_deg)
    off = np.where(np.isfinite(scales), np.abs(scales - 1.0), np.inf).max(axis=0)
    far, wide = away_m > OVERLAP_M, off > GREATEST_SCALE
    if not (far.any() or wide.any()):
        return ""
    at = int(np.argmax(away_m)) if far.any() else int(np.argmax(off))
    scale = float(scales[int(np.argmax(np.abs(scales[:, at] - 1.0))), at])
    where = degrees_text(float(lat_deg[at]), float(lon_deg[at]), 2)
    outside = ":"
    if far.any() and (area := crs.area_of_use) is not None:
        outside = (
            f" is used from {area.west:g}° to {area.east:g}° E, {area.south:g}° to {area.north:g}° N, and "
            f"{away_m[at] / 1e3:.0f} km away,"
        )
    return (
        f"{said}{outside} at {where} a metre on the ground is {scale:.4f} m in the map; "
        f"{_better(crs, float(lat_deg[at]), float(lon_deg[at]))}"
    )


def outside_deg(crs: CRS, lat_deg: FloatArray, lon_deg: FloatArray) -> FloatArray:
    """Return the distances of places (n,) outside a CRS's area of use, in degrees of a great circle."""
    area = crs.area_of_use
    if area is None:
        return np.zeros(len(lat_deg))
    width = (area.east - area.west) % 360.0 or 360.0
    east = (lon_deg - area.west) % 360.0
    beside = np.where(east <= width, 0.0, np.minimum(east - width, 360.0 - east)) * np.cos(np.radians(lat_deg))
    above = np.maximum(0.0, np.maximum(area.south - lat_deg, lat_deg - area.north))
    outside: FloatArray = np.hypot(beside, above)
    return outside


def _better(crs: CRS, lat: float, lon: float) -> str:
    """Return the UTM zone of a place, on the CRS's own datum where that has zones."""
    place = AreaOfInterest(lon, lat, lon, lat)
    geodetic = crs.geodetic_crs
    for datum in (geodetic.name if geodetic is not None else "", "WGS 84"):
        for info in query_utm_crs_info(datum_name=datum, area_of_interest=place):
            zone = info.name.removeprefix(f"{datum} / UTM zone ")
            if len(zone) <= len("32N"):  # excludes zones with axes in another order
                return f'use "EPSG:{info.code}" ({info.name}), or another CRS that is used there'
    return "use a CRS that is used there"


def degrees_text(lat_deg: float, lon_deg: float, digits: int) -> str:
    """Return a place as text in degrees."""
    north, east = "NS"[lat_deg < 0.0], "EW"[lon_deg < 0.0]
    return f"{abs(lat_deg):.{digits}f}° {north}, {abs(lon_deg):.{digits}f}° {east}"
