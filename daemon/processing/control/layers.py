"""Read control from GeoPackages and shapefiles of points.

The standard library and pyshp read them; GDAL is not needed for either.
"""

from __future__ import annotations

import math
import sqlite3
import struct
from collections.abc import Iterable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from swath.daemon.errors import ExitCode, UserError
from swath.daemon.processing.control.columns import HEIGHTS, WANTED, Column, Role, column_of
from swath.daemon.processing.control.table import ControlTable, error_of, table_of
from swath.daemon.processing.vector_layers import (
    LayerError,
    code_of,
    crs_of_srs,
    geometry_of_blob,
    shapefile_module,
)

X_Y_Z = ("geometry x", "geometry y", "geometry z")

Feature = tuple[str, Sequence[float], Sequence[object]]  # where, x y and possibly z, attributes


def read_geopackage(path: Path) -> ControlTable:
    """Read the points of a GeoPackage that has one layer of points.

    Raises:
        UserError: the file cannot be read; ControlError: it has not one layer of points, or points have mistakes.
    """
    try:
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)) as database:
            return _read_geopackage(path, database)
    except sqlite3.Error as error:
        raise UserError(f"{path}: cannot be read as a GeoPackage: {error}", ExitCode.IO) from error


def _read_geopackage(path: Path, database: sqlite3.Connection) -> ControlTable:
    layers = database.execute(
        "SELECT table_name, column_name, srs_id FROM gpkg_geometry_columns "
        "WHERE upper(geometry_type_name) IN ('POINT', 'GEOMETRY')"
    ).fetchall()
    if len(layers) != 1:
        names = ", ".join(str(name) for name, _, _ in layers) or "none"
        raise error_of(path, [f"has {len(layers)} layers of points ({names}); save the control's layer alone"])
    table, geometry, srs = layers[0]
    quoted = '"' + str(table).replace('"', '""') + '"'
    cursor = database.execute(f"SELECT * FROM {quoted}")  # the name is one of the file's own
    labels = [str(column[0]) for column in cursor.description]
    at = labels.index(geometry)
    keys = {str(row[1]) for row in database.execute(f"PRAGMA table_info({quoted})") if row[5]}
    features = []
    for number, row in enumerate(cursor, start=1):
        where = f"feature {number}"
        point = _point_of(row[at])
        if point is None:
            raise error_of(path, [f"{where}: has no point; save the layer with one point for each feature"])
        features.append((where, point, [value for column, value in enumerate(row) if column != at]))
    del labels[at]
    return _table(path, labels, features, crs_of_srs(database, int(srs)), keys)


def _point_of(blob: object) -> tuple[float, ...] | None:
    """Return the ordinates x, y and, if there is one, z of a GeoPackage's geometry; None if it is not one point."""
    try:
        found = geometry_of_blob(blob)
    except LayerError:
        return None
    if found is None or len(found.points) != 1 or found.lines or found.polygons:
        return None
    values = tuple(found.points[0].tolist())
    return values if all(map(math.isfinite, values[:2])) else None


def read_shapefile(path: Path) -> ControlTable:
    """Read the points of a shapefile; its CRS is that of the .prj beside it.

    Raises:
        UserError: the file cannot be read; ControlError: it does not hold points, or points have mistakes.
    """
    try:
        shapefile = shapefile_module(f"{path}: shapefiles")
    except LayerError as error:
        raise UserError(str(error), ExitCode.USAGE) from error
    try:
        with shapefile.Reader(str(path), encodingErrors="replace") as reader:
            if reader.shapeType not in (shapefile.POINT, shapefile.POINTZ, shapefile.POINTM):
                raise error_of(path, [f"holds {reader.shapeTypeName.lower()} instead of points; give points"])
            has_z = reader.shapeType == shapefile.POINTZ
            labels = [str(field[0]) for field in reader.fields if field[0] != "DeletionFlag"]
            features = [_feature(number, one, has_z=has_z) for number, one in enumerate(reader.iterShapeRecords(), 1)]
    except (OSError, shapefile.ShapefileException, struct.error, ValueError) as error:
        if isinstance(error, ValueError) and str(error).startswith(f"{path}: "):
            raise
        raise UserError(f"{path}: cannot be read as a shapefile: {error}", ExitCode.IO) from error
    prj = path.with_suffix(".prj")
    crs = code_of(prj.read_text("utf-8", "replace").strip()) if prj.is_file() else ""
    return _table(path, labels, features, crs, set())


def _feature(number: int, one: Any, *, has_z: bool) -> Feature:
    point = tuple(one.shape.points[0]) if one.shape.points else (math.nan, math.nan)
    above = tuple(one.shape.z[:1]) if has_z else ()
    return f"feature {number}", (*point[:2], *above), list(one.record)


def _table(path: Path, labels: Sequence[str], features: Iterable[Feature], crs: str, keys: set[str]) -> ControlTable:
    """Return the table of features: plane coordinates of the geometry, height of it or of a column."""
    features = list(features)
    if not features:
        raise error_of(path, ["has no points; give at least one"])
    has_z = all(len(point) > 2 and math.isfinite(point[2]) for _, point, _ in features)
    attributes = [column_of(at, label) for at, label in enumerate(labels)]
    wanted = [one for one in attributes if one.role in (Role.NAME, Role.SIGMA, *HEIGHTS)]
    named = [one for one in wanted if one.role is Role.NAME]
    if any(one.label not in keys for one in named):  # a table's key names its rows only if nothing else does
        wanted = [one for one in wanted if one.role is not Role.NAME or one.label not in keys]
    # the geometry's height if it has one that is not zero throughout, as of points drawn on a map
    drawn = has_z and not all(point[2] == 0.0 for _, point, _ in features)
    if drawn:
        wanted = [one for one in wanted if one.role not in HEIGHTS]
    elif not any(one.role in HEIGHTS for one in wanted):
        raise error_of(path, [f"the points have no heights, and no column has any; the columns are {WANTED}"])
    width = len(labels)
    geometry = [Column(width, X_Y_Z[0], Role.X), Column(width + 1, X_Y_Z[1], Role.Y)]
    if drawn:
        geometry.append(Column(width + 2, X_Y_Z[2], Role.HEIGHT))
    rows = [
        (where, [*("" if one is None else str(one) for one in values), *(repr(float(one)) for one in point)])
        for where, point, values in features
    ]
    used = ", ".join(one.label for one in wanted if one.role in HEIGHTS) or "those of the geometry"
    return table_of(path, [*geometry, *wanted], rows, is_named=True, crs=crs, notes=(f"heights are {used}",))
