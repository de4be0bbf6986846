"""Read features of GeoPackages and shapefiles, without GDAL: geometries as arrays, attributes, the layer's CRS.

A GeoPackage is an SQLite database whose geometries are documented blobs (OGC 12-128r19, 2.1.3) around well-known binary
(ISO/IEC 13249-3, 5.1.46; OGC 06-103r4, 8.2). pyshp reads shapefiles; it is pure Python.
"""

from __future__ import annotations

import contextlib
import io
import math
import sqlite3
import struct
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from pyproj import CRS
from pyproj.exceptions import CRSError

from swath.drivers.extras import how_to_install
from swath.georef.arrays import FloatArray

ENVELOPE_BYTES = {0: 0, 1: 32, 2: 48, 3: 48, 4: 64}
UNDEFINED = (-1, 0)  # srs_id of layers without a CRS
EWKB_Z, EWKB_M, EWKB_SRID = 0x80000000, 0x40000000, 0x20000000
DEEPEST = 8  # collections within collections
_WAL_AT, _ROLLBACK = slice(18, 20), b"\x01\x01"  # the header's file format versions, SQLite file format 1.3.3
_SHORTEST_HEADER = 100


class LayerError(ValueError):
    """Raised for a file or geometry that cannot be read; one line without the file's name."""


@dataclass(slots=True, eq=False)
class Geometry:
    """A feature's geometry, taken apart.

    Attributes:
        points: arrays (2,) or (3,): x, y and possibly z.
        lines: arrays (n, 2) or (n, 3).
        polygons: a list of rings (n, 2) or (n, 3) each, the outer one first.
    """

    points: list[FloatArray] = field(default_factory=list)
    lines: list[FloatArray] = field(default_factory=list)
    polygons: list[list[FloatArray]] = field(default_factory=list)


@dataclass(frozen=True, slots=True, eq=False)
class Feature:
    """A feature of a layer.

    Attributes:
        where: place in the file, for messages: ``feature 3``.
        attributes: its values by name.
        geometry: as it stands in the file.
    """

    where: str
    attributes: Mapping[str, object]
    geometry: Geometry


@dataclass(frozen=True, slots=True, eq=False)
class Layer:
    """A layer: its features, and the CRS of their coordinates as code or WKT; empty: none is given."""

    name: str
    crs: str
    features: Sequence[Feature]


def code_of(wkt: str) -> str:
    """Return the code of a CRS that is given as WKT; the WKT itself if it has none."""
    try:
        code = CRS.from_user_input(wkt).to_epsg()
    except CRSError:
        code = None
    return wkt if code is None else f"EPSG:{code}"


# ---------------------------------------------------------------------------------------------- well-known binary


class _Reader:
    """Reads well-known binary from a position on."""

    def __init__(self, data: bytes, at: int) -> None:
        self.data, self.at = data, at
        self.order = "<"

    def take(self, code: str) -> int:
        (value,) = struct.unpack_from(self.order + code, self.data, self.at)
        self.at += struct.calcsize(code)
        return int(value)

    def rows(self, count: int, width: int, kept: int) -> FloatArray:
        """Return ``count`` rows of ``width`` ordinates, the first ``kept`` of each."""
        size = 8 * count * width
        if count < 0 or self.at + size > len(self.data):
            raise LayerError("a geometry is cut short")
        rows = np.frombuffer(self.data, f"{self.order}f8", count * width, self.at).reshape(count, width)
        self.at += size
        return rows[:, :kept].astype(np.float64)


def geometry_of_wkb(data: bytes, at: int = 0) -> Geometry:
    """Return the geometry of well-known binary, of ISO's or PostGIS's types, of either byte order.

    Raises:
        LayerError: it is cut short, or of a type that has neither points, lines nor polygons.
    """
    found = Geometry()
    try:
        _read(_Reader(data, at), found, 0)
    except struct.error as error:
        raise LayerError("a geometry is cut short") from error
    return found


def _read(reader: _Reader, found: Geometry, depth: int) -> None:
    if depth > DEEPEST:
        raise LayerError(f"a geometry has collections more than {DEEPEST} deep")
    reader.order = "<" if reader.take("B") == 1 else ">"
    kind = reader.take("I")
    if kind & EWKB_SRID:
        reader.take("I")
    has_z, has_m = bool(kind & EWKB_Z), bool(kind & EWKB_M)
    base, more = (kind & 0x1FFFFFFF) % 1000, (kind & 0x1FFFFFFF) // 1000
    has_z, has_m = has_z or more in (1, 3), has_m or more in (2, 3)
    width, kept = 2 + has_z + has_m, 3 if has_z else 2
    if base == 1:
        found.points.append(reader.rows(1, width, kept)[0])
    elif base == 2:
        found.lines.append(reader.rows(reader.take("I"), width, kept))
    elif base == 3:
        found.polygons.append([reader.rows(reader.take("I"), width, kept) for _ in range(reader.take("I"))])
    elif base in (4, 5, 6, 7):
        for _ in range(reader.take("I")):
            _read(reader, found, depth + 1)
    else:
        raise LayerError(f"a geometry has the type {kind}; save points, lines or polygons without arcs")


def geometry_of_blob(blob: object) -> Geometry | None:
    """Return the geometry of a GeoPackage's blob; None if it is not one, or empty.

    Raises:
        LayerError: its well-known binary cannot be read.
    """
    if not isinstance(blob, bytes) or len(blob) < 8 or blob[:2] != b"GP":
        return None
    start = 8 + ENVELOPE_BYTES.get(blob[3] >> 1 & 7, len(blob))
    return geometry_of_wkb(blob, start) if len(blob) >= start + 5 else None


# ---------------------------------------------------------------------------------------------- GeoPackage


def crs_of_srs(database: sqlite3.Connection, srs: int) -> str:
    """Return the CRS of a GeoPackage's ``srs_id`` as code or WKT; empty if it has none."""
    if srs in UNDEFINED:
        return ""
    row = database.execute(
        "SELECT organization, organization_coordsys_id, definition FROM gpkg_spatial_ref_sys WHERE srs_id = ?", (srs,)
    ).fetchone()
    if row is None:
        return ""
    organization, code, definition = row
    return f"EPSG:{code}" if str(organization).upper() == "EPSG" else code_of(str(definition))


def geopackage_layers(data: bytes) -> list[Layer]:
    """Return the layers of a GeoPackage given as bytes.

    Raises:
        LayerError: it cannot be read.
    """
    if len(data) < _SHORTEST_HEADER or not data.startswith(b"SQLite format 3\0"):
        raise LayerError("cannot be read as a GeoPackage: it is no SQLite database; save it anew")
    plain = bytearray(data)
    plain[_WAL_AT] = _ROLLBACK  # a database in memory has no write-ahead log
    database = sqlite3.connect(":memory:")
    try:
        database.text_factory = lambda text: text.decode("utf-8", "replace")
        database.deserialize(bytes(plain))
        return list(_layers(database))
    except (sqlite3.Error, ValueError, TypeError, OverflowError) as error:
        if isinstance(error, LayerError):
            raise
        raise LayerError(f"cannot be read as a GeoPackage: {error}; save it anew") from error
    finally:
        database.close()


def _layers(database: sqlite3.Connection) -> Iterator[Layer]:
    tables = database.execute("SELECT table_name, column_name, srs_id FROM gpkg_geometry_columns").fetchall()
    for table, geometry, srs in tables:
        quoted = '"' + str(table).replace('"', '""') + '"'
        cursor = database.execute(f"SELECT * FROM {quoted}")  # the name is one of the file's own
        labels = [str(column[0]) for column in cursor.description]
        if geometry not in labels:
            raise LayerError(f"layer {table}: has no column {geometry}; save it anew")
        at = labels.index(geometry)
        features = []
        for number, row in enumerate(cursor, start=1):
            found = geometry_of_blob(row[at])
            if found is not None:
                attributes = {label: value for column, (label, value) in enumerate(zip(labels, row, strict=True))
                              if column != at}  # fmt: skip
                features.append(Feature(f"{table}, feature {number}", attributes, found))
        yield Layer(str(table), crs_of_srs(database, int(srs)), features)


# ---------------------------------------------------------------------------------------------- shapefile


def shapefile_module(what: str) -> Any:
    """Return pyshp's module; ``what`` names the file for the message.

    Raises:
        LayerError: it is not installed.
    """
    try:
        import shapefile
    except ImportError as error:
        raise LayerError(f"{what} need pyshp, which is not installed: {how_to_install('process')}") from error
    return shapefile


def shapefile_layer(files: Mapping[str, bytes]) -> Layer:
    """Return the layer of a shapefile.

    Args:
        files: content by suffix: ``.shp``, and of ``.dbf``, ``.prj``, ``.cpg`` those that exist.

    Raises:
        LayerError: it cannot be read.
    """
    module = shapefile_module("shapefiles")
    parts: dict[str, Any] = {"shp": io.BytesIO(files[".shp"])}
    if ".dbf" in files:
        parts["dbf"] = io.BytesIO(files[".dbf"])
    try:
        encoding = _encoding(files.get(".cpg", b""))
        with _quietly(), module.Reader(**parts, encoding=encoding, encodingErrors="replace") as reader:
            fields = reader.fields if ".dbf" in files else []
            labels = [str(one[0]) for one in fields if one[0] != "DeletionFlag"]
            features = []
            for number, shape in enumerate(reader.iterShapes(), start=1):
                values = list(reader.record(number - 1)) if ".dbf" in files else []
                attributes = dict(zip(labels, values, strict=False))
                features.append(Feature(f"feature {number}", attributes, _geometry_of_shape(module, shape)))
    except (
        OSError,
        module.ShapefileException,
        struct.error,
        ArithmeticError,
        ValueError,
        LookupError,
        TypeError,
    ) as error:
        raise LayerError(f"cannot be read as a shapefile: {' '.join(str(error).split())}; save it anew") from error
    prj = files.get(".prj", b"").decode("utf-8", "replace").strip()
    return Layer("", code_of(prj) if prj else "", features)


@contextlib.contextmanager
def _quietly() -> Iterator[None]:
    """Keep pyshp's warnings about headers from the user: what it reads all the same is used."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def _encoding(cpg: bytes) -> str:
    name = cpg.decode("ascii", "replace").strip().lower().removeprefix("ansi ") or "utf-8"
    name = f"cp{name}" if name.isdigit() else name
    try:
        "".encode(name)
    except LookupError:
        return "utf-8"
    return name


def _geometry_of_shape(module: Any, shape: Any) -> Geometry:
    found = Geometry()
    lines = (module.POLYLINE, module.POLYLINEZ, module.POLYLINEM)
    polygons = (module.POLYGON, module.POLYGONZ, module.POLYGONM)
    if shape.shapeType not in (*lines, *polygons):
        return found
    rows = np.array([point[:2] for point in shape.points], np.float64).reshape(-1, 2)
    if shape.shapeType in (module.POLYLINEZ, module.POLYGONZ):
        rows = np.column_stack([rows, np.array(shape.z, np.float64)])
    starts = [*shape.parts, len(rows)]
    parts = [rows[begin:end] for begin, end in pairwise(starts)]
    if shape.shapeType in lines:
        found.lines += parts
        return found
    for ring in parts:  # an outer ring runs clockwise, its holes the other way (ESRI shapefile description, page 8)
        if not found.polygons or _area(ring) < 0.0:
            found.polygons.append([ring])
        else:
            found.polygons[-1].append(ring)
    return found


def _area(ring: FloatArray) -> float:
    x, y = np.clip(ring.T[:2], -1e12, 1e12)
    return math.fsum((x[:-1] - x[0]) * (y[1:] - y[0]) - (x[1:] - x[0]) * (y[:-1] - y[0])) / 2.0
