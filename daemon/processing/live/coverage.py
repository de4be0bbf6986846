"""Writes the map of a flight for others: as GeoTIFF in its coordinate system, and as KMZ for Google Earth.

Both are made from the tiles, so that they can be made at any time, by any process, of a run that is over or goes on.
"""

from __future__ import annotations

import importlib.util
import io
import zipfile
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import numpy as np
from pyproj import CRS
from pyproj.exceptions import CRSError

from swath.daemon.processing.live.files import replace_file
from swath.daemon.processing.live.painting import COLOURS, IMAGE_CELLS, picture
from swath.daemon.processing.live.tiles import SIDE, Layers, Placement, TileReader
from swath.daemon.written import PARTIAL

GEOTIFF, KMZ = "coverage.tif", "coverage.kmz"
MOST_CELLS = 400_000_000  # of the rectangle around the map; a single wrong point far away would make it endless
LAYERS = ("points", "height_m", "strips", "difference_m")
BANDS = (
    "points per square metre",
    "mean height of all points, in the coordinate system's unit",
    "number of strips",
    "height difference of strips, the earlier minus the later, m",
)
KML = """<?xml version="1.0" encoding="UTF-8"?>
<kml xmlns="http://www.opengis.net/kml/2.2" xmlns:gx="http://www.google.com/kml/ext/2.2">
<Document><name>{name}</name>
<GroundOverlay><name>points per square metre</name><description>{legend}</description>
<Icon><href>coverage.png</href></Icon>
<gx:LatLonQuad><coordinates>{corners}</coordinates></gx:LatLonQuad>
</GroundOverlay></Document></kml>
"""


def write_coverage(folder: Path) -> list[str]:
    """Write GeoTIFF and KMZ of the map below a folder of live products, beside it.

    Returns:
        For each file that is not written, the reason in one line.

    Raises:
        OSError: a file cannot be written.
    """
    reader = TileReader(folder)
    reader.refresh()
    extent_m = reader.extent_m()
    if extent_m is None:
        return ["no coverage is written: the map is empty"]
    west_m, south_m, east_m, north_m = extent_m
    if (east_m - west_m) * (north_m - south_m) > MOST_CELLS * reader.cell_m**2:
        return [f"no coverage is written: the map is {(east_m - west_m) / 1e3:.0f} km wide, which a wrong point causes"]
    left_out = [_write_geotiff(folder / GEOTIFF, reader, extent_m), _write_kmz(folder / KMZ, reader, extent_m)]
    return [why for why in left_out if why]


def _write_geotiff(path: Path, reader: TileReader, extent_m: tuple[float, float, float, float]) -> str:
    if importlib.util.find_spec("rasterio") is None:
        return f"{path.name} is not written: it needs `pip install 'swath[gis]'`"
    index = reader.index
    try:
        crs = CRS.from_user_input(index["crs"])
        origin, unit_m = (np.asarray(index[key], np.float64).reshape(3) for key in ("origin", "origin_unit_m"))
    except (CRSError, KeyError, TypeError, ValueError):
        return f"{path.name} is not written: the output has no map coordinates; set output.crs"
    if crs.is_geocentric:
        return f"{path.name} is not written: {crs.name} has no map; set another output.crs"
    aside = path.with_name(path.name + PARTIAL)
    _fill_geotiff(aside, reader, extent_m, crs, origin, unit_m)
    aside.replace(path)
    return ""


def _fill_geotiff(path: Path, reader: TileReader, extent_m: Any, crs: CRS, origin: Any, unit_m: Any) -> None:
    import rasterio  # an extra

    west_m, south_m, east_m, north_m = extent_m
    cell_m = reader.cell_m
    profile = {
        "driver": "GTiff",
        "width": round((east_m - west_m) / cell_m),
        "height": round((north_m - south_m) / cell_m),
        "count": len(LAYERS),
        "dtype": "float32",
        "nodata": np.nan,
        "crs": rasterio.crs.CRS.from_wkt(crs.to_wkt()),
        "transform": rasterio.Affine(
            cell_m / unit_m[0], 0.0, origin[0] + west_m / unit_m[0],
            0.0, -cell_m / unit_m[1], origin[1] + north_m / unit_m[1],
        ),
        "tiled": True,
        "blockxsize": SIDE,
        "blockysize": SIDE,
        "compress": "deflate",
        "zlevel": 1,
        "predictor": 3,
        "SPARSE_OK": True,
        "BIGTIFF": "IF_SAFER",
    }  # fmt: skip
    with rasterio.open(path, "w", **profile) as made:
        made.descriptions = BANDS
        for place in sorted(reader.changed()):
            view = reader.tile(place, LAYERS)
            if view is not None:
                across, down = round((view.west_m - west_m) / cell_m), round((north_m - view.south_m) / cell_m) - SIDE
                window = rasterio.windows.Window(across, down, SIDE, SIDE)
                made.write(_bands(view.layers, cell_m, origin, unit_m)[:, ::-1], window=window)


def _bands(layers: Layers, cell_m: float, origin: Any, unit_m: Any) -> Any:
    there = layers["points"] > 0
    return np.stack(
        [
            np.where(there, layers["points"] / cell_m**2, np.nan),
            origin[2] + layers["height_m"] / unit_m[2],
            np.where(there, layers["strips"], np.nan),
            layers["difference_m"],
        ]
    ).astype(np.float32)


def _write_kmz(path: Path, reader: TileReader, extent_m: tuple[float, float, float, float]) -> str:
    placement = Placement.of(reader.index)
    if placement is None:
        return f"{path.name} is not written: the map's place on the earth is not known"
    west_m, south_m, east_m, north_m = extent_m
    view = reader.view(*extent_m, max(east_m - west_m, north_m - south_m) / IMAGE_CELLS, ["points"])
    if view is None:
        return f"{path.name} is not written: no tile can be read"
    rows, columns = view.shape
    east_m, north_m = view.west_m + columns * view.cell_m, view.south_m + rows * view.cell_m
    corners = np.array([(view.west_m, view.south_m), (east_m, view.south_m), (east_m, north_m), (view.west_m, north_m)])
    text = " ".join(f"{lon:.8f},{lat:.8f}" for lat, lon in placement.geodetic(corners).tolist())
    legend = ", ".join(f"from {density:g}: #{colour:06x}" for density, colour in COLOURS)
    name = f"Coverage {reader.index.get('session_id', '')}".strip()
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("doc.kml", KML.format(name=escape(name), legend=escape(legend), corners=text))
        archive.writestr("coverage.png", picture(view.layers["points"][::-1], view.cell_m))
    replace_file(path, data.getvalue())
    return ""
