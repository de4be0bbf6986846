"""Ground from a GeoTIFF of ellipsoidal heights, read by rasterio (``swath[raster]``)."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError, ProjError

from swath.drivers.extras import how_to_install
from swath.georef.arrays import FloatArray, Int64Array
from swath.sim.plan.errors import PlanError
from swath.sim.plan.plan import Plan
from swath.sim.site import Site, geodetic_from_e

Place = Callable[[FloatArray, FloatArray, FloatArray], FloatArray]

KEY = "terrain.raster"
MOST_PIXELS = 100_000_000  # 800 MB of heights
FARTHEST = 1e9  # largest coordinate of any map, in its units
FARTHEST_HEIGHT_M = 100_000.0
_CORNERS = ("south-west", "south-east", "north-west", "north-east")


class RasterHeights:
    """Heights of a raster on the grid of the ground, bilinear between the centres of its pixels.

    Args:
        plan: names the raster and, in ``flight.crs``, the CRS that it must have.
        site: of the grid.
        east_m, north_m: first and last column and row.
        of_height: makes a fast version, on that grid, of a smooth function of place and height
            (`swath.sim.scene.terrain.OfHeight`).

    Raises:
        PlanError: ``terrain.raster``, one line: rasterio is not installed, there is no such file, the CRS is another,
            or a corner is not covered; when called, a pixel has no data.
    """

    def __init__(
        self,
        plan: Plan,
        site: Site,
        east_m: tuple[float, float],
        north_m: tuple[float, float],
        of_height: Callable[[Place], Any],
    ) -> None:
        self._to_crs = _Projected(site, _plan_crs(plan))
        corners = np.array([[x, y] for y in north_m for x in east_m])
        pixels = _read(plan, self._to_crs, corners, plan.tables.terrain.height_m)
        self._pixels = pixels
        self._height_m = plan.tables.terrain.height_m
        self._column = of_height(lambda x, y, height: pixels.at(*self._to_crs(x, y, height))[0])
        self._row = of_height(lambda x, y, height: pixels.at(*self._to_crs(x, y, height))[1])

    def __call__(self, east_m: FloatArray, north_m: FloatArray) -> FloatArray:
        """Return (rows, columns) ellipsoidal heights at east (columns,) and north (rows,).

        The position on the map depends a little on the height: 0.8 m for 500 m at 10 km. Three iterations suffice.
        """
        height_m = np.full((len(north_m), len(east_m)), self._height_m)
        for _ in range(3):
            column, row = (pixel(east_m, north_m, height_m) for pixel in (self._column, self._row))
            height_m = self._pixels.sample(column, row)
            if not np.isfinite(height_m).all():
                at_row, at_column = np.argwhere(~np.isfinite(height_m))[0]
                self._refuse_hole(float(east_m[at_column]), float(north_m[at_row]))
        return height_m

    def _refuse_hole(self, east_m: float, north_m: float) -> None:
        easting, northing = self._to_crs(*(np.array([value]) for value in (east_m, north_m, self._height_m)))
        place = f"{easting[0]:.1f}, {northing[0]:.1f}"
        raise PlanError(KEY, f"has no data at {place}; use a raster with heights below all swaths")


@dataclass(frozen=True)
class _Projected:
    """Converts site places to easting and northing."""

    site: Site
    crs: CRS

    def __call__(self, east_m: FloatArray, north_m: FloatArray, height_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        points = self.site.site_from_ground(east_m, north_m, height_m)
        lat_rad, lon_rad, _ = geodetic_from_e(self.site.e_from_site(points))
        to_map = Transformer.from_crs("EPSG:4326", self.crs, always_xy=True)
        easting, northing = to_map.transform(np.degrees(lon_rad), np.degrees(lat_rad))
        return np.asarray(easting), np.asarray(northing)


class _Edges:
    """Converts places on the map to columns and rows, by the six numbers of a raster's affine transform."""

    def __init__(self, transform: Any) -> None:
        self._inverse = np.linalg.inv([[transform.a, transform.b], [transform.d, transform.e]])
        self._corner = np.array([transform.c, transform.f])

    def __call__(self, easting: FloatArray, northing: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return columns and rows, (n,) each."""
        x, y = easting - self._corner[0], northing - self._corner[1]
        (to_column_x, to_column_y), (to_row_x, to_row_y) = self._inverse
        return to_column_x * x + to_column_y * y, to_row_x * x + to_row_y * y


@dataclass(frozen=True)
class _Pixels:
    """A window of the raster.

    Attributes:
        values: (rows, columns), nan where there is no data.
        first: column and row of the window in the raster.
        edges: converts the map to columns and rows of the raster, whole at the pixels' edges.
    """

    values: FloatArray
    first: Int64Array
    edges: _Edges

    def at(self, easting: FloatArray, northing: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return column and row in the window, whole at the pixels' centres."""
        column, row = self.edges(easting, northing)
        return column - self.first[0] - 0.5, row - self.first[1] - 0.5

    def sample(self, column: FloatArray, row: FloatArray) -> FloatArray:
        """Return bilinear heights; in the outer half of the outermost pixels those at their centres."""
        rows, columns = self.values.shape
        column, row = np.clip(column, 0.0, columns - 1), np.clip(row, 0.0, rows - 1)
        left = np.minimum(column.astype(np.int64), max(columns - 2, 0))
        upper = np.minimum(row.astype(np.int64), max(rows - 2, 0))
        right, lower = np.minimum(left + 1, columns - 1), np.minimum(upper + 1, rows - 1)
        u, v = column - left, row - upper
        above = (1 - u) * self.values[upper, left] + u * self.values[upper, right]
        below = (1 - u) * self.values[lower, left] + u * self.values[lower, right]
        value: FloatArray = (1 - v) * above + v * below
        return value


def _plan_crs(plan: Plan) -> CRS:
    try:
        crs = CRS(plan.tables.flight.crs)
    except CRSError:
        raise PlanError(
            "flight.crs", f"PROJ does not know {plan.tables.flight.crs!r}; write it like EPSG:25832"
        ) from None
    return _horizontal(crs)


def _horizontal(crs: CRS) -> CRS:
    return CRS(crs.sub_crs_list[0]) if crs.is_compound else crs.to_2d()


def _read(plan: Plan, to_crs: _Projected, corners: FloatArray, height_m: float) -> _Pixels:
    """Return the pixels under the corners (4, 2) of the grid."""
    try:
        import rasterio
    except ImportError:
        raise PlanError(KEY, f"rasters need rasterio: {how_to_install('raster')}; or leave the raster out") from None
    path = plan.folder / plan.tables.terrain.raster
    if not path.is_file():
        raise PlanError(KEY, f"the file {path} does not exist; give the path of a GeoTIFF relative to the plan")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", rasterio.errors.NotGeoreferencedWarning)
            with rasterio.open(path) as source:
                _check_crs(source.crs, to_crs.crs, path)
                _check_pixels(source, path)
                easting, northing = to_crs(corners[:, 0], corners[:, 1], np.full(4, height_m))
                edges = _Edges(source.transform)
                column, row = edges(easting, northing)
                _check_cover(np.stack([column, row], axis=1), (source.width, source.height), easting, northing, path)
                first = np.floor([min(column), min(row)]).astype(int) - 2
                last = np.ceil([max(column), max(row)]).astype(int) + 2
                first, last = np.maximum(first, 0), np.minimum(last, [source.width, source.height])
                return _Pixels(_window(source, first, last - first, path), first, edges)
    except PlanError:
        raise
    except rasterio.errors.NotGeoreferencedWarning:
        raise PlanError(KEY, f"{path} has no georeference; use a georeferenced GeoTIFF of heights") from None
    except (rasterio.errors.RasterioError, ProjError, ValueError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise PlanError(KEY, f"{path} cannot be read: {reason}; use a GeoTIFF of heights") from None


def _window(source: Any, first: Int64Array, size: Int64Array, path: Path) -> FloatArray:
    """Return (rows, columns) of the first band, nan where it has no data.

    Values beyond any height on Earth count as no data too: they are marks that the file does not declare.
    """
    from rasterio.windows import Window

    columns, rows = map(int, size)
    if columns * rows > MOST_PIXELS:
        raise PlanError(
            KEY, f"{path} has {columns} × {rows} pixels under the swaths; use a raster with at most {MOST_PIXELS}"
        )
    window = Window(*map(int, first), columns, rows)
    with np.errstate(invalid="ignore"):  # a NaN of any kind means no data
        values: FloatArray = source.read(1, window=window, out_dtype="float64")
    values[(source.read_masks(1, window=window) == 0) | ~(np.abs(values) < FARTHEST_HEIGHT_M)] = np.nan
    return values


def _check_pixels(source: Any, path: Path) -> None:
    """Refuse pixels that cannot be heights of places on a map."""
    place = source.transform
    steps, corner = np.abs([place.a, place.b, place.d, place.e]), np.abs([place.c, place.f])
    area = abs(place.a * place.e - place.b * place.d) if steps.max() < FARTHEST else 0.0
    if not (1 / FARTHEST < area and corner.max() < FARTHEST):
        raise PlanError(KEY, f"{path} has an invalid georeference: {tuple(place)[:6]}; use a GeoTIFF of heights")
    rows, columns = source.block_shapes[0]
    if rows * columns * source.count > MOST_PIXELS:  # a block may hold all bands and is read whole
        raise PlanError(
            KEY,
            f"{path} has {source.count} bands in blocks of {columns} × {rows}; use a raster with one band of heights",
        )
    if not source.dtypes[0].startswith(("int", "uint", "float")):
        raise PlanError(KEY, f"{path} has pixels of type {source.dtypes[0]}; use a GeoTIFF of heights")


def _check_crs(found: Any, wanted: CRS, path: Path) -> None:
    if not found:
        raise PlanError(KEY, f"{path} has no CRS; use a raster in flight.crs, {_name(wanted)}")
    crs = _horizontal(CRS.from_wkt(found.to_wkt()))
    same_code = crs.to_epsg() is not None and crs.to_epsg() == wanted.to_epsg()
    if not same_code and not crs.equals(wanted, ignore_axis_order=True):
        raise PlanError(KEY, f"{path} is in {_name(crs)}; use a raster in flight.crs, {_name(wanted)}")


def _name(crs: CRS) -> str:
    code = crs.to_epsg()
    return f"EPSG:{code}" if code else f"{crs.name!r}"


def _check_cover(
    pixels: FloatArray, size: tuple[int, int], easting: FloatArray, northing: FloatArray, path: Path
) -> None:
    """Refuse a raster that does not reach all corners of the grid (4, 2), given as columns and rows."""
    inside = np.all((pixels >= 0.0) & (pixels <= size), axis=1)
    for name, there, e, n in zip(_CORNERS, inside, easting, northing, strict=True):
        if not there:
            raise PlanError(
                KEY,
                f"{path} does not reach the {name} corner at {e:.0f}, {n:.0f}; use a raster that covers all swaths "
                "and 100 m around them",
            )
