"""Reads the coarse terrain model of ``[mta]``: a GeoTIFF of ellipsoidal heights, by rasterio (``swath[raster]``)."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
from pyproj import CRS, Transformer
from pyproj.exceptions import ProjError

from swath.daemon.config.config import Config
from swath.daemon.errors import ConfigError
from swath.drivers.extras import how_to_install
from swath.georef.arrays import FloatArray
from swath.georef.coarse_terrain import CoarseTerrain

MAX_NODES = 25_000_000  # 200 MB of heights; a coarse model of a whole country has fewer
FARTHEST = 1e9  # units of the coordinates, in any map
FARTHEST_HEIGHT_M = 100_000.0
KEY = "mta.terrain"


class ToGrid:
    """Converts latitudes and longitudes to easting and northing, or degrees, for `CoarseTerrain`; pickles.

    Attributes:
        turn: length of x once round the earth, 360 for degrees; None: x is not a longitude.
    """

    def __init__(self, wkt: str) -> None:
        crs = CRS.from_wkt(wkt)
        self._transformer = Transformer.from_crs("EPSG:4979", crs, always_xy=True)
        self.turn = 2.0 * np.pi / crs.axis_info[0].unit_conversion_factor if crs.is_geographic else None

    def __call__(self, lat_rad: FloatArray, lon_rad: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return x and y (n,) in the raster's CRS."""
        x, y = self._transformer.transform(np.degrees(lon_rad), np.degrees(lat_rad))
        return np.asarray(x), np.asarray(y)


def terrain_of(config: Config) -> CoarseTerrain | None:
    """Return the terrain model of a configuration; None if it names none.

    Raises:
        ConfigError: the model cannot be read.
    """
    if not config.mta.terrain:
        return None
    path = config.resolve(config.mta.terrain)
    if not path.exists():
        raise ConfigError(
            f"mta.terrain: {path} does not exist, and logs do not contain it; put the file there, or remove the key"
        )
    return read_terrain(path)


def read_terrain(path: Path) -> CoarseTerrain:
    """Return the terrain model of a raster's first band, its nodes at the pixels' centres.

    Raises:
        ConfigError: ``mta.terrain``, one line: rasterio, heights, CRS or place are missing, or the raster is rotated or
            too large.
    """
    try:
        import rasterio
    except ImportError as error:
        raise ConfigError(f"{KEY}: reading {path} needs rasterio: {how_to_install('raster')}") from error
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", rasterio.errors.NotGeoreferencedWarning)
            with rasterio.open(path) as raster:
                _check(raster, path)
                transform, wkt = raster.transform, raster.crs.to_wkt()
                height_m = _heights(raster)
        first = (transform.c + 0.5 * transform.a, transform.f + 0.5 * transform.e)
        to_grid = ToGrid(wkt)
        return CoarseTerrain(height_m, first, (transform.a, transform.e), to_grid, to_grid.turn)
    except rasterio.errors.NotGeoreferencedWarning as error:
        raise ConfigError(f"{KEY}: {path} has no georeference; use a georeferenced GeoTIFF") from error
    except (rasterio.errors.RasterioError, ProjError, ValueError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise ConfigError(f"{KEY}: {path} cannot be read: {reason}") from error


def _check(raster: Any, path: Path) -> None:
    """Check that a raster can be a grid of heights in a map.

    Raises:
        ConfigError: it cannot be such a grid.
    """
    place = raster.transform
    if raster.crs is None:
        raise ConfigError(f"{KEY}: {path} has no CRS; use a GeoTIFF with a CRS")
    if place.b or place.d:
        raise ConfigError(f"{KEY}: {path} is rotated; use a raster with columns to the east and rows to the north")
    if not (max(abs(place.c), abs(place.f)) < FARTHEST and all(1 / FARTHEST < abs(x) < FARTHEST for x in place[:5:4])):
        raise ConfigError(f"{KEY}: {path} has pixels of {place.a:g} × {place.e:g} from {place.c:g}, {place.f:g} on")
    if raster.width * raster.height > MAX_NODES:
        raise ConfigError(f"{KEY}: {path} has {raster.width} × {raster.height} pixels; use a coarser model")
    rows, columns = raster.block_shapes[0]
    if rows * columns * raster.count > MAX_NODES:  # a block may hold all bands, and is read as a whole
        raise ConfigError(
            f"{KEY}: {path} has {raster.count} bands in blocks of {columns} × {rows}; use a raster with one band "
            "of heights"
        )
    if not raster.dtypes[0].startswith(("int", "uint", "float")):
        raise ConfigError(f"{KEY}: {path} has pixels of type {raster.dtypes[0]}; use a raster of heights")


def _heights(raster: Any) -> FloatArray:
    """Return heights (rows, columns) of the first band; nan where it has none, or one beyond any on Earth (an unnamed
    mark).
    """
    with np.errstate(invalid="ignore"):  # NaNs of any kind count as missing
        height_m: FloatArray = raster.read(1, out_dtype="float64")
    height_m[(raster.read_masks(1) == 0) | ~(np.abs(height_m) < FARTHEST_HEIGHT_M)] = np.nan
    return height_m
