"""The coarse terrain model of ``[mta]``: a GeoTIFF of ellipsoidal heights, read by rasterio (``swath[raster]``)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError

from daemon.config.config import Config
from daemon.errors import ConfigError
from georef.coarse_terrain import CoarseTerrain

FloatArray = NDArray[np.float64]
MAX_NODES = 25_000_000  # 200 MB of heights; a coarse model of a whole country has fewer
KEY = "mta.terrain"


class ToGrid:
    """Easting and northing, or degrees, of latitudes and longitudes, for `CoarseTerrain`; pickles."""

    def __init__(self, wkt: str) -> None:
        self._transformer = Transformer.from_crs("EPSG:4979", CRS.from_wkt(wkt), always_xy=True)

    def __call__(self, lat_rad: FloatArray, lon_rad: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(n,) x and y in the raster's CRS."""
        x, y = self._transformer.transform(np.degrees(lon_rad), np.degrees(lat_rad))
        return np.asarray(x), np.asarray(y)


def terrain_of(config: Config) -> CoarseTerrain | None:
    """Of a configuration; None: it names none.

    Raises:
        ConfigError: it cannot be read.
    """
    if not config.mta.terrain:
        return None
    path = config.resolve(config.mta.terrain)
    if not path.exists():
        raise ConfigError(f"mta.terrain: {path} is not there, and no log holds it; put it there, or take it out")
    return read_terrain(path)


def read_terrain(path: Path) -> CoarseTerrain:
    """A terrain model of a raster's first band, its nodes at the pixels' centres.

    Raises:
        ConfigError: ``mta.terrain``, one line: no rasterio, no raster, no CRS, turned, or too large.
    """
    try:
        import rasterio
    except ImportError as error:
        raise ConfigError(f"{KEY}: reading {path} needs rasterio: pip install 'swath[raster]'") from error
    try:
        with rasterio.open(path) as raster:
            if raster.crs is None:
                raise ConfigError(f"{KEY}: {path} has no CRS; want a GeoTIFF that says its own")
            if raster.transform.b or raster.transform.d:
                raise ConfigError(f"{KEY}: {path} is turned against its axes; want columns east and rows north")
            if raster.width * raster.height > MAX_NODES:
                raise ConfigError(f"{KEY}: {path} has {raster.width} × {raster.height} pixels; want a coarse model")
            height_m = raster.read(1, masked=True).astype(np.float64).filled(np.nan)
            transform, wkt = raster.transform, raster.crs.to_wkt()
        first = (transform.c + 0.5 * transform.a, transform.f + 0.5 * transform.e)
        return CoarseTerrain(height_m, first, (transform.a, transform.e), ToGrid(wkt))
    except (rasterio.errors.RasterioError, CRSError, ValueError) as error:
        if isinstance(error, ConfigError):
            raise
        raise ConfigError(f"{KEY}: {path} cannot be read: {str(error).splitlines()[0]}") from error
