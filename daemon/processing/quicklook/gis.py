"""Writes a quick look for GIS: maps as cloud-optimised GeoTIFF, lines, footprints and control as GeoPackage."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import rasterio.features
import rasterio.shutil
from fudgeo import FeatureClass, Field, GeoPackage, SpatialReferenceSystem
from fudgeo.enumeration import FieldType, GPKGFlavors, ShapeType
from fudgeo.geometry import LineStringZ, MultiPolygon, PointZ
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError
from scipy import ndimage

from swath.daemon.errors import one_line
from swath.daemon.processing.files import utc_text
from swath.daemon.processing.pages.names import QUICK_LOOK_FEATURES, QUICK_LOOK_MAPS
from swath.daemon.processing.quicklook.grids import HEIGHT, INTENSITY, SIGMA_HEIGHT, Frame
from swath.daemon.processing.quicklook.product_facts import read_sidecar
from swath.daemon.processing.quicklook.run import Look
from swath.daemon.processing.strips.inputs import mapping_of, trajectories_beside
from swath.daemon.written import PARTIAL
from swath.georef.arrays import BoolArray, FloatArray
from swath.georef.mapping.frame import MappingError
from swath.georef.timescales.gps_time import SECOND_NS, table_leap_seconds, unix_ns_from_gps
from swath.georef.trajectory.trajectory import Trajectory, TrajectoryError

LINE_STEP_S = 0.5  # between vertices of a line
OWN_SRS_ID = 100_000  # of a coordinate system without a code of EPSG
CLOSED_CELLS = 2  # gaps that a footprint bridges, as on the maps
FIELD_TYPES = {str: FieldType.text, int: FieldType.integer, float: FieldType.double}
Bands = dict[str, FloatArray]  # by what they hold
Attributes = dict[str, str | int | float | None]
CONTROL_RECORDS = ("calibration.json", "validation.json")
NO_CRS = "the files state no coordinate system, so maps and features have none"


@dataclass(frozen=True, slots=True)
class GisFiles:
    """Names the files that were written, with notes for the user."""

    paths: list[Path]
    notes: list[str]


def write_gis(look: Look, folder: Path, inputs: Sequence[Path]) -> GisFiles:
    """Write maps and features of a quick look into a folder.

    Args:
        look: what was read.
        folder: where the files go.
        inputs: files and folders that were looked at: control residuals are read from the records there.

    Raises:
        OSError: a file cannot be written.
    """
    crs = next((source.crs for source in look.sources if source.crs is not None), None)
    notes = [] if crs is not None else [NO_CRS]
    maps = list(_maps(look, crs, folder))
    features = folder / QUICK_LOOK_FEATURES
    _write_features(features, look, crs, inputs, notes)
    return GisFiles([*maps, features], notes)


# ---------------------------------------------------------------------- maps


def _maps(look: Look, crs: CRS | None, folder: Path) -> Iterator[Path]:
    """Write every map that has values; yield its path. Values are NaN where a cell has none."""
    surface, overlap, units = look.surface, look.overlap, look.units
    density, density_cell_m = surface.density()
    frame, cells = surface.frame, look.cells.frame
    worst_m = np.asarray(overlap.worst_m, np.float64)
    of_strips = _of_shape(cells, cells.cell_m, worst_m)
    maps: dict[str, tuple[Bands, Frame]] = {
        "height.tif": ({"mean height of all returns, in the files' unit": surface.mean(HEIGHT) / units.up_m}, frame),
        "differences.tif": (
            {
                "height difference of strips, averaged as on the page's map, m": np.asarray(
                    overlap.shown_m, np.float64
                ),
                "height difference of strips, each cell's own, m": worst_m,
            },
            of_strips,
        ),
        "density.tif": ({"first returns per square metre": density}, _of_shape(frame, density_cell_m, density)),
        "intensity.tif": ({"mean intensity of first returns, as recorded": surface.mean(INTENSITY)}, frame),
        "sigma.tif": ({"mean sigma of height, m": surface.mean(SIGMA_HEIGHT)}, frame),
    }
    for name in QUICK_LOOK_MAPS:
        bands, of_map = maps[name]
        values = np.stack(list(bands.values()))
        if np.isfinite(values).any():
            part, cropped = _cropped(values, of_map)
            yield _write_map(folder / name, part, list(bands), cropped, look, crs)


def _of_shape(frame: Frame, cell_m: float, values: FloatArray) -> Frame:
    """Return the frame of values that begin where another frame does."""
    return Frame(frame.west_m, frame.south_m, cell_m, *values.shape)


def _cropped(values: FloatArray, frame: Frame) -> tuple[FloatArray, Frame]:
    """Return the smallest rectangle that has all values (bands, rows, columns), and its frame."""
    known: BoolArray = np.asarray(np.isfinite(values).any(axis=0))
    rows, columns = np.flatnonzero(known.any(axis=1)), np.flatnonzero(known.any(axis=0))
    part = values[:, rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    west_m, south_m = frame.west_m + columns[0] * frame.cell_m, frame.south_m + rows[0] * frame.cell_m
    return part, Frame(float(west_m), float(south_m), frame.cell_m, *part.shape[1:])


def _write_map(path: Path, values: FloatArray, words: Sequence[str], frame: Frame, look: Look, crs: CRS | None) -> Path:
    """Write values (bands, rows from the south, columns) as a cloud-optimised GeoTIFF with the files' coordinates."""
    units = look.units
    west_m, _, _, north_m = frame.extent_m
    across, up = frame.cell_m / units.east_m, frame.cell_m / units.north_m
    profile = {
        "driver": "GTiff",
        "width": frame.columns,
        "height": frame.rows,
        "count": len(words),
        "dtype": "float32",
        "nodata": np.nan,
        "transform": rasterio.Affine(across, 0.0, west_m / units.east_m, 0.0, -up, north_m / units.north_m),
        "crs": None if crs is None else rasterio.crs.CRS.from_wkt(crs.to_wkt()),
    }
    aside = path.with_name(path.name + PARTIAL)
    with rasterio.io.MemoryFile() as memory:
        with memory.open(**profile) as made:
            made.write(values[:, ::-1].astype(np.float32))
            made.descriptions = tuple(words)
        with memory.open() as made:
            rasterio.shutil.copy(made, aside, driver="COG", compress="DEFLATE", predictor="YES", overviews="AUTO")
    aside.replace(path)
    return path


# ---------------------------------------------------------------------- features


def _write_features(path: Path, look: Look, crs: CRS | None, inputs: Sequence[Path], notes: list[str]) -> None:
    """Write footprints of strips, lines and control residuals, each a layer, as far as they are known."""
    system = _spatial_reference(crs)
    aside = path.with_name(f"{path.stem}{PARTIAL}.gpkg")
    aside.unlink(missing_ok=True)
    package = GeoPackage.create(aside, flavor=GPKGFlavors.epsg)
    try:
        strips = [(_footprint(look, number, system.srs_id), _strip(look, number)) for number in range(len(look.strips))]
        known = [(shape, values) for shape, values in strips if shape is not None]
        _layer(package, "strips", ShapeType.multi_polygon, system, known, "footprints of the strips")
        lines = list(_lines(look, system.srs_id, notes))
        _layer(package, "lines", ShapeType.linestring, system, lines, "the aircraft's path along each strip", z=True)
        control = list(_control(inputs, crs, system.srs_id, notes))
        _layer(package, "control", ShapeType.point, system, control, "control points with residuals", z=True)
    finally:
        package.connection.close()
    aside.replace(path)


def _spatial_reference(crs: CRS | None) -> SpatialReferenceSystem:
    if crs is None:
        return SpatialReferenceSystem("Undefined Cartesian", "NONE", -1, "undefined")
    try:
        wkt = crs.to_wkt("WKT1_GDAL")
    except CRSError:  # what WKT 1 cannot say
        wkt = crs.to_wkt()
    code = crs.to_authority(min_confidence=100)
    if code is not None and code[0] == "EPSG":
        return SpatialReferenceSystem(crs.name, "EPSG", int(code[1]), wkt)
    return SpatialReferenceSystem(crs.name, "NONE", OWN_SRS_ID, wkt)


def _layer(
    package: GeoPackage,
    name: str,
    shape_type: str,
    system: SpatialReferenceSystem,
    features: Sequence[tuple[Any, Attributes]],
    words: str,
    *,
    z: bool = False,
) -> None:
    """Write features that have the same attributes as a layer with a spatial index; no features: no layer."""
    if not features:
        return
    kinds = _kinds(values for _, values in features)
    fields = [Field(key, FIELD_TYPES[kind]) for key, kind in kinds.items()]
    layer = FeatureClass.create(
        package, name, shape_type, srs=system, z_enabled=z, fields=fields, description=words, geom_name="geom"
    )
    marks = ", ".join("?" for _ in range(len(kinds) + 1))
    names = ", ".join(["geom", *kinds])
    rows = [(shape, *(values[key] for key in kinds)) for shape, values in features]
    with package.connection as connection:
        connection.executemany(f"INSERT INTO {layer.escaped_name} ({names}) VALUES ({marks})", rows)
    layer.extent = layer.extent  # which a GIS reads before the features


def _kinds(rows: Iterable[Attributes]) -> dict[str, type]:
    """Return the type of each attribute; an attribute that is never known is text."""
    kinds: dict[str, type] = {}
    for values in rows:
        for key, value in values.items():
            if value is not None:
                kinds[key] = type(value)
            kinds.setdefault(key, str)
    return kinds


def _footprint(look: Look, number: int, srs_id: int) -> MultiPolygon | None:
    """Return the outline of a strip's cells, small gaps closed; None: it has no cells."""
    coverage, units = look.cells.coverage(number), look.units
    frame, pad = coverage.frame, CLOSED_CELLS + 1
    there = ndimage.binary_closing(np.pad(coverage.there, pad), iterations=CLOSED_CELLS, structure=np.ones((3, 3)))
    transform = rasterio.Affine(
        frame.cell_m / units.east_m,
        0.0,
        (frame.west_m - pad * frame.cell_m) / units.east_m,
        0.0,
        frame.cell_m / units.north_m,
        (frame.south_m - pad * frame.cell_m) / units.north_m,
    )
    shapes = rasterio.features.shapes(there.astype(np.uint8), mask=there, transform=transform)
    polygons = [shape["coordinates"] for shape, _ in shapes]
    return MultiPolygon(polygons, srs_id) if polygons else None


def _strip(look: Look, number: int) -> Attributes:
    strip = look.strips[number]
    sessions, source_id = look.origins[number] if number < len(look.origins) else ((), 0)
    return {
        "strip": strip.name,
        "session": ", ".join(sessions) or None,
        "point_source_id": int(source_id),
        "points": int(strip.points),
        "pulses": int(strip.pulses),
        "length_m": float(strip.length_m),
        "area_m2": float(strip.area_m2),
        "pulses_m2": float(strip.density) if np.isfinite(strip.density) else None,
        "sigma_height_m": None if strip.sigma_m is None else float(strip.sigma_m[2]),
    }


def _lines(look: Look, srs_id: int, notes: list[str]) -> Iterator[tuple[LineStringZ, Attributes]]:
    """Yield the aircraft's path along each strip, from the trajectories beside the points."""
    try:
        trajectories = trajectories_beside(look)
    except (TrajectoryError, OSError, ValueError) as error:
        notes.append(f"no lines: {error}")
        return
    names = {source.path.name for source in look.sources}
    for source in {str(one.path.parent): one for one in look.sources if one.sidecar}.values():
        for entry in (one for one in _entries(source.sidecar, "strips") if Path(str(one.get("file"))).name in names):
            span = (entry.get("first_gps_ns"), entry.get("last_gps_ns"))
            found = next((one for one in trajectories if _covers(one, *span)), None)
            if found is None:
                continue
            begin, end = (int(str(gps_ns)) for gps_ns in span)
            try:
                vertices = _vertices(source.sidecar, found, begin, end)
            except (MappingError, KeyError, TypeError) as error:
                notes.append(f"no lines: {error}")
                return
            values: Attributes = {
                "strip": str(entry.get("number")),
                "session": found.name,
                "begin_utc": _utc(begin),
                "end_utc": _utc(end),
                "seconds": (end - begin) / SECOND_NS,
            }
            yield LineStringZ(vertices.tolist(), srs_id), values


def _entries(sidecar: Mapping[str, Any], key: str) -> list[dict[str, Any]]:
    entries = sidecar.get(key)
    return [entry for entry in entries if isinstance(entry, dict)] if isinstance(entries, list) else []


def _covers(trajectory: Trajectory, begin: Any, end: Any) -> bool:
    first, last = trajectory.span
    return isinstance(begin, int) and isinstance(end, int) and first <= begin < end <= last


def _vertices(sidecar: Mapping[str, Any], trajectory: Trajectory, begin: int, end: int) -> FloatArray:
    """Return vertices (n, 3) of a part of a trajectory, in the coordinates of the points."""
    within = trajectory.between(begin, end)
    step = max(1, round(LINE_STEP_S * SECOND_NS / max(float(np.median(np.diff(within.time_ns))), 1.0)))
    inside = np.flatnonzero((within.time_ns >= begin) & (within.time_ns <= end))
    chosen = np.unique(np.append(inside[::step], inside[-1:]))
    mapping = mapping_of(sidecar["crs"])
    mapping.settle(within.position_e)
    return mapping.map_from_e(within.position_e[chosen])


def _utc(gps_ns: int) -> str:
    leap_seconds, _ = table_leap_seconds(np.datetime64(unix_ns_from_gps(gps_ns, 0), "ns").astype("M8[D]").item())
    return utc_text(unix_ns_from_gps(gps_ns, leap_seconds))


def _control(
    inputs: Sequence[Path], crs: CRS | None, srs_id: int, notes: list[str]
) -> Iterator[tuple[PointZ, Attributes]]:
    """Yield the control points of records in the folders that were looked at, in the files' coordinate system."""
    folders = dict.fromkeys(path if path.is_dir() else path.parent for path in inputs)
    places = [place for folder in folders for place in sorted({*folder.glob("*.json"), *folder.glob("*/*.json")})]
    for path in (place for place in places if place.name in CONTROL_RECORDS):
        for entry in _entries(read_sidecar(path), "control"):
            try:
                place = _placed(entry, crs)
                above_m = float(entry["laser_above_m"])
            except (CRSError, KeyError, TypeError, ValueError) as error:
                notes.append(f"{path}: a control point is left out: {one_line(str(error))}")
                continue
            values: Attributes = {
                "name": str(entry.get("name")),
                "record": path.stem,
                "laser_above_m": above_m,
                "sigma_m": _number(entry.get("sigma_m")),
                "sights": int(entry.get("sights", 1)),
            }
            yield PointZ(x=place[0], y=place[1], z=place[2], srs_id=srs_id), values


def _number(value: Any) -> float | None:
    return float(value) if isinstance(value, int | float) else None


def _placed(entry: Mapping[str, Any], crs: CRS | None) -> tuple[float, float, float]:
    """Return a control point in the files' coordinate system; its height is that of the record."""
    east, north, height = (float(entry[key]) for key in ("easting", "northing", "height"))
    own = CRS.from_user_input(entry["crs"])
    if crs is None or own.to_2d().equals(crs.to_2d(), ignore_axis_order=True):
        return east, north, height
    placed = Transformer.from_crs(own.to_2d(), crs.to_2d(), always_xy=True).transform(east, north)
    return float(placed[0]), float(placed[1]), height
