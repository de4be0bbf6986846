"""Reads raster maps of the user: MBTiles and PMTiles in web Mercator, GeoTIFF in any CRS.

Sources: MBTiles Specification 1.3 (rows of tiles are counted from the south), PMTiles Specification 3, EPSG method 1024
(web Mercator: the sphere's Mercator projection of ellipsoidal latitudes).
"""

from __future__ import annotations

import contextlib
import io
import math
import os
import sqlite3
import warnings
from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from pmtiles.reader import Reader
from pmtiles.tile import Compression, TileType, deserialize_directory

from swath.daemon.errors import ExitCode, UserError, one_line
from swath.drivers.extras import how_to_install

EQUATOR_M = 2.0 * math.pi * 6_378_137.0
WANTED = "a map of pictures would be right: MBTiles or PMTiles with PNG, JPEG or WebP, or GeoTIFF"
MOST_TILE_BYTES = 8 << 20
MOST_TILE_PIXELS = 1024  # along a side
MOST_PIXELS = 2048  # along a side of what is read for one picture
KEPT_BYTES = 24 << 20  # of decoded tiles
SMALL = 8192  # pixels along a side of a GeoTIFF that needs no overviews
ATTRIBUTION_CHARACTERS = 200
GDAL_CACHE_MB = 32
PIXELS = 256  # along a side of a square of the map
NODES = np.linspace(0.0, PIXELS - 1.0, 16)  # pixels of a square whose place is computed
_BETWEEN = np.stack([np.interp(np.arange(PIXELS), NODES, one) for one in np.eye(len(NODES))], axis=1)  # for the others
Picture = NDArray[np.uint8]
Degrees = NDArray[np.float64]


class Raster(Protocol):
    """A map of pictures.

    Attributes:
        name: the file's name.
        attribution: whom its maker names, as text.
        is_photo: True if its pictures are JPEG, so that others may be as well.
    """

    name: str
    attribution: str
    is_photo: bool

    def sample(self, lat_deg: Degrees, lon_deg: Degrees, pixel_m: float) -> Picture | None:
        """Return red, green, blue and opacity (`PIXELS`, `PIXELS`, 4) of a square; None: nothing is there.

        Args:
            lat_deg, lon_deg: of the pixels `NODES` (rows, columns); between them straight lines are near enough.
            pixel_m: width of a pixel.

        Raises:
            OSError, ValueError: the file is damaged.
        """

    def close(self) -> None:
        """Close the file."""


def open_raster(path: Path) -> Raster:
    """Open a map by what its first bytes say.

    Raises:
        UserError: it is none of the kinds, or cannot be read; the text says what would be right.
    """
    try:
        with path.open("rb") as file:
            head = file.read(16)
    except OSError as error:
        raise _refused(path, f"{error.strerror}; {WANTED}") from error
    raster: MbTiles | PmTiles | GeoTiff
    if head.startswith(b"SQLite format 3\0"):
        raster = MbTiles(path)
    elif head.startswith(b"PMTiles"):
        raster = PmTiles(path)
    elif head[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
        raster = GeoTiff(path)
    else:
        raise _refused(path, f"is neither MBTiles, PMTiles nor GeoTIFF; {WANTED}")
    try:
        raster.check()
    except UserError:
        raster.close()
        raise
    return raster


def _refused(path: Path, why: str) -> UserError:
    return UserError(one_line(f"[console] background: {path}: {why}"), ExitCode.USAGE)


class Tiled(ABC):
    """A map in square tiles of web Mercator.

    Attributes:
        zooms: first and last zoom of its tiles.
        side: pixels along a side of a tile.
    """

    is_photo = False

    def __init__(self, path: Path) -> None:
        self.name, self.attribution = path.name, ""
        self.zooms, self.side = (0, 0), 256
        self._kept: OrderedDict[tuple[int, int, int], Picture | None] = OrderedDict()
        self._bytes = 0

    @abstractmethod
    def encoded(self, zoom: int, x: int, y: int) -> bytes | None:
        """Return a tile's file, counted from the north-west; None: there is none."""

    def begin(self, first: bytes) -> None:
        """Take side and kind from one of the tiles.

        Raises:
            OSError, ValueError: it is no picture.
        """
        with Image.open(io.BytesIO(first)) as image:
            self.is_photo = image.format == "JPEG"
            self.side = image.width
        _decoded(first, self.side)

    def zoom_for(self, lat_deg: float, pixel_m: float) -> int:
        """Return the zoom whose pixels are nearest to so many metres."""
        whole_m = EQUATOR_M * math.cos(math.radians(lat_deg)) / self.side
        return min(max(round(math.log2(max(1.0, whole_m / pixel_m))), self.zooms[0]), self.zooms[1])

    def sample(self, lat_deg: Degrees, lon_deg: Degrees, pixel_m: float) -> Picture | None:
        """Return the pictures at places, as `Raster` does."""
        zoom = self.zoom_for(float(lat_deg.mean()), pixel_m)
        x, y = mercator(lat_deg, lon_deg)
        columns, rows = x * (self.side << zoom), y * (self.side << zoom)
        most = (1 << zoom) - 1
        west, north = (max(0, math.floor((values.min() - 1.0) / self.side)) for values in (columns, rows))
        east, south = (min(most, math.floor((values.max() + 1.0) / self.side)) for values in (columns, rows))
        if east < west or south < north or max(east - west, south - north) + 1 > MOST_PIXELS // self.side:
            return None
        whole: Picture = np.zeros(((south - north + 1) * self.side, (east - west + 1) * self.side, 4), np.uint8)
        found = False
        for row in range(north, south + 1):
            for column in range(west, east + 1):
                tile = self._tile(zoom, column, row)
                if tile is not None:
                    up, across = (row - north) * self.side, (column - west) * self.side
                    whole[up : up + self.side, across : across + self.side] = tile
                    found = True
        return between(whole, columns - west * self.side, rows - north * self.side) if found else None

    def _tile(self, zoom: int, x: int, y: int) -> Picture | None:
        key = zoom, x, y
        if key in self._kept:
            self._kept.move_to_end(key)
            return self._kept[key]
        data = self.encoded(zoom, x, y)
        made = None if data is None else _decoded(data, self.side)
        self._kept[key] = made
        self._bytes += 0 if made is None else made.nbytes
        while self._bytes > KEPT_BYTES or len(self._kept) > 4096:
            _, old = self._kept.popitem(last=False)
            self._bytes -= 0 if old is None else old.nbytes
        return made


def _decoded(data: bytes, side: int) -> Picture:
    """Return a tile's pixels (side, side, 4).

    Raises:
        OSError, ValueError: it is no picture of this size.
    """
    if len(data) > MOST_TILE_BYTES:
        raise ValueError(f"a tile has {len(data)} bytes")
    with Image.open(io.BytesIO(data)) as image:
        if image.size != (side, side) or side > MOST_TILE_PIXELS:
            raise ValueError(f"a tile has {image.width} by {image.height} pixels, others {side} by {side}")
        return np.asarray(image.convert("RGBA"))


class MbTiles(Tiled):
    """A map in a database of tiles."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._path = path
        # a database with a write-ahead log needs files beside it, which the service may not make: sqlite.org/wal.html
        how = "mode=ro" if os.access(path.resolve().parent, os.W_OK) else "immutable=1"
        self._base = sqlite3.connect(f"{path.resolve().as_uri()}?{how}", uri=True, check_same_thread=False)

    def check(self) -> None:
        """Read what the map says of itself; refuse what is no map of pictures with `UserError`."""
        try:
            about = {str(name): str(value) for name, value in self._base.execute("SELECT name, value FROM metadata")}
            first = self._base.execute("SELECT tile_data FROM tiles LIMIT 1").fetchone()
            zooms = self._base.execute("SELECT min(zoom_level), max(zoom_level) FROM tiles").fetchone()
        except sqlite3.Error as error:
            raise _refused(self._path, f"no MBTiles: {error}; {WANTED}") from error
        if first is None:
            raise _refused(self._path, f"has no tiles; {WANTED}")
        self.zooms, self.attribution = (int(zooms[0]), int(zooms[1])), as_text(about.get("attribution", ""))
        with _as_refusal(self._path, about.get("format", "")):
            self.begin(bytes(first[0]))

    def close(self) -> None:
        """Close the file."""
        self._base.close()

    def encoded(self, zoom: int, x: int, y: int) -> bytes | None:
        """Return a tile's file; the database counts its rows from the south."""
        try:
            found = self._base.execute(
                "SELECT tile_data FROM tiles WHERE zoom_level = ? AND tile_column = ? AND tile_row = ?",
                (zoom, x, (1 << zoom) - 1 - y),
            ).fetchone()
        except sqlite3.Error as error:
            raise OSError(str(error)) from error
        return None if found is None else bytes(found[0])


class PmTiles(Tiled):
    """A map in an archive of tiles, read by the library of its makers."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._path, self._file = path, path.open("rb")
        self._reader: Any = Reader(self._bytes_at)

    def check(self) -> None:
        """Read what the map says of itself; refuse what is no map of pictures with `UserError`."""
        with _as_refusal(self._path, ""):
            head = self._reader.header()
            kind = head["tile_type"]
        if head["tile_compression"] not in (Compression.NONE, Compression.UNKNOWN) or kind == TileType.MVT:
            raise _refused(self._path, f"holds {kind.name} and not pictures; {WANTED}")
        with _as_refusal(self._path, kind.name):
            self.zooms = int(head["min_zoom"]), int(head["max_zoom"])
            self.attribution = as_text(str(self._reader.metadata().get("attribution") or ""))
            self.begin(self._first(head))

    def _first(self, head: dict[str, Any]) -> bytes:
        """Return the first tile's file."""
        place = head["root_offset"], head["root_length"]
        for _ in range(4):  # directories lead to directories, at most so deep
            entry = deserialize_directory(self._bytes_at(*place))[0]
            if entry.run_length:
                return self._bytes_at(head["tile_data_offset"] + entry.offset, entry.length)
            place = head["leaf_directory_offset"] + entry.offset, entry.length
        raise ValueError("its directories have no end")

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _bytes_at(self, offset: int, length: int) -> bytes:
        if length > MOST_TILE_BYTES:
            raise ValueError(f"{length} bytes are too many for a tile or a directory")
        return os.pread(self._file.fileno(), length, offset)  # no mapping: a file cut meanwhile would end the console

    def encoded(self, zoom: int, x: int, y: int) -> bytes | None:
        """Return a tile's file."""
        with _as_damage():
            found: bytes | None = self._reader.get(zoom, x, y)
            return found


@contextlib.contextmanager
def _as_damage() -> Iterator[None]:
    """Raise what a library says of damaged bytes as `ValueError`."""
    try:
        yield
    except (OSError, ValueError):
        raise
    except Exception as error:  # the library has no class of its own for them
        raise ValueError(f"is damaged: {type(error).__name__} {error}") from error


@contextlib.contextmanager
def _as_refusal(path: Path, kind: str) -> Iterator[None]:
    try:
        with _as_damage():
            yield
    except (OSError, ValueError) as error:
        what = f"holds {kind} and not pictures" if kind in ("pbf", "MVT") else f"its tiles cannot be read: {error}"
        raise _refused(path, f"{what}; {WANTED}") from error


class GeoTiff:
    """A map in one picture with its place, read by GDAL."""

    is_photo = True

    def __init__(self, path: Path) -> None:
        try:
            import rasterio
            import rasterio.enums
            import rasterio.warp
            import rasterio.windows
        except ImportError as error:
            raise _refused(path, f"needs rasterio, which is not installed: {how_to_install('raster')}") from error
        try:
            with rasterio.Env(GDAL_CACHEMAX=GDAL_CACHE_MB), warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of a place that is missing; it is refused below
                self._data = rasterio.open(path, driver="GTiff")
        except rasterio.errors.RasterioError as error:
            raise _refused(path, f"no GeoTIFF: {error}; {WANTED}") from error
        self._path, self.name, self._library = path, path.name, rasterio
        self.attribution = as_text(str(self._data.tags().get("TIFFTAG_COPYRIGHT", "")))
        self._palette: Picture | None = None

    def check(self) -> None:
        """Refuse what has no place, is no picture or is too large with `UserError`."""
        data, path = self._data, self._path
        if data.crs is None:
            raise _refused(path, "has no coordinate system; set it: gdal_edit.py -a_srs EPSG:… FILE")
        if data.count not in (1, 3, 4) or set(data.dtypes) != {"uint8"}:
            what = f"has {data.count} bands of {data.dtypes[0]}; 1, 3 or 4 of uint8 would be right"
            raise _refused(path, f"{what}: gdal_translate -ot Byte -scale FILE NEW")
        if max(data.width, data.height) > SMALL and not data.overviews(1):
            what = f"has {data.width} by {data.height} pixels and no overviews"
            raise _refused(path, f"{what}; make them: gdaladdo -r average FILE")
        with contextlib.suppress(ValueError):  # it has none
            colours = data.colormap(1)
            self._palette = np.array([colours.get(value, (0, 0, 0, 0)) for value in range(256)], np.uint8)

    def close(self) -> None:
        """Close the file."""
        self._data.close()

    def sample(self, lat_deg: Degrees, lon_deg: Degrees, pixel_m: float) -> Picture | None:
        """Return the picture at places, as `Raster` does."""
        library = self._library
        try:
            with library.Env(GDAL_CACHEMAX=GDAL_CACHE_MB):
                columns, rows = self._pixels(lat_deg, lon_deg)
                return self._read(columns, rows)
        except library.errors.RasterioError as error:
            raise OSError(str(error)) from error

    def _pixels(self, lat_deg: Degrees, lon_deg: Degrees) -> tuple[Degrees, Degrees]:
        """Return columns and rows of places."""
        found = self._library.warp.transform("EPSG:4326", self._data.crs, lon_deg.ravel(), lat_deg.ravel())
        x, y = (np.array(values).reshape(lat_deg.shape) for values in found)
        inverse = ~self._data.transform
        return inverse.a * x + inverse.b * y + inverse.c, inverse.d * x + inverse.e * y + inverse.f

    def _read(self, columns: Degrees, rows: Degrees) -> Picture | None:
        data = self._data
        if not (np.isfinite(columns).all() and np.isfinite(rows).all()):
            return None
        west, north = (max(0, math.floor(values.min()) - 1) for values in (columns, rows))
        east = min(data.width, math.ceil(columns.max()) + 1)
        south = min(data.height, math.ceil(rows.max()) + 1)
        if east <= west or south <= north:
            return None
        # so many of the file's pixels as a pixel of the picture has
        coarser = max(1.0, *(float(np.ptp(values) / (1.5 * PIXELS)) for values in (columns, rows)))
        size = [min(MOST_PIXELS, max(1, math.ceil(length / coarser))) for length in (south - north, east - west)]
        window = self._library.windows.Window(west, north, east - west, south - north)
        ways = self._library.enums.Resampling
        how = ways.bilinear if self._palette is None else ways.nearest
        bands = data.read(window=window, out_shape=(data.count, *size), resampling=how)
        whole: Picture = np.empty((*size, 4), np.uint8)
        if self._palette is not None:
            whole[:] = self._palette[bands[0]]
        else:
            whole[..., :3] = np.moveaxis(bands[:3] if data.count >= 3 else bands[[0, 0, 0]], 0, -1)
            whole[..., 3] = data.dataset_mask(window=window, out_shape=tuple(size))
        return between(
            whole, (columns - west) * (size[1] / (east - west)), (rows - north) * (size[0] / (south - north))
        )


def mercator(lat_deg: Degrees, lon_deg: Degrees) -> tuple[Degrees, Degrees]:
    """Return places in web Mercator, as parts of the whole map from west and from north."""
    lat = np.radians(np.clip(lat_deg, -85.06, 85.06))
    return lon_deg / 360.0 + 0.5, 0.5 - np.arcsinh(np.tan(lat)) / (2.0 * math.pi)


def between(picture: Picture, columns: Degrees, rows: Degrees) -> Picture:
    """Return a square (`PIXELS`, `PIXELS`, 4) of a picture (rows, columns, 4), mixed of the four pixels around a place.

    Args:
        picture: the picture; centres of its pixels are at halves.
        columns, rows: places of the square's pixels `NODES`.
    """
    height, width = picture.shape[:2]
    columns, rows = (_BETWEEN @ values @ _BETWEEN.T for values in (columns, rows))
    inside = (columns >= 0.0) & (columns < width) & (rows >= 0.0) & (rows < height)
    x = np.clip(columns - 0.5, 0.0, width - 1.0).astype(np.float32)
    y = np.clip(rows - 0.5, 0.0, height - 1.0).astype(np.float32)
    left, up = x.astype(np.int32), y.astype(np.int32)
    right, down = np.minimum(left + 1, width - 1), np.minimum(up + 1, height - 1)
    across, along = (x - left)[..., np.newaxis], (y - up)[..., np.newaxis]
    flat = picture.reshape(-1, 4)
    upper, lower = (
        flat[row * width + left] * (1.0 - across) + flat[row * width + right] * across for row in (up, down)
    )
    made: Picture = np.rint(upper + (lower - upper) * along).astype(np.uint8)
    at_edge = made[..., 3] < 255  # colours of clear pixels mean nothing: no mixture, but the nearest one
    nearest = np.clip(rows, 0.0, height - 1.0).astype(np.int32), np.clip(columns, 0.0, width - 1.0).astype(np.int32)
    made[at_edge] = picture[nearest[0][at_edge], nearest[1][at_edge]]
    made[~inside] = 0
    return made


class _Text(HTMLParser):
    """Collects the text of a piece of HTML."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_data(self, data: str) -> None:
        """Keep a piece of text."""
        self.found.append(data)


def as_text(markup: str) -> str:
    """Return the text of an attribution, which may hold links."""
    parser = _Text()
    parser.feed(markup[: 10 * ATTRIBUTION_CHARACTERS])
    parser.close()
    return one_line(" ".join("".join(parser.found).split()))[:ATTRIBUTION_CHARACTERS]
