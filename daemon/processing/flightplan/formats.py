"""Read lines and polygons from texts of planning programs: KML, GeoJSON and the plans of `swath sim`.

Each reader gives features as they stand in the file, with the meaning of their heights.
"""

from __future__ import annotations

import io
import json
import math
import re
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any
from xml.etree.ElementTree import Element, ParseError, TreeBuilder, XMLParser

import numpy as np

from swath.daemon.processing.flightplan.plan import PlanError
from swath.daemon.processing.vector_layers import Feature, Geometry
from swath.georef.arrays import FloatArray
from swath.georef.geodesy.earth import e_from_geodetic, geodetic_from_e, rot_e_from_l
from swath.georef.text_encoding import decoded
from swath.georef.toml_tables import TomlError, toml_tables

WGS84 = "EPSG:4326"
ELLIPSOID, GEOID, GROUND, NONE = "ellipsoid", "geoid", "ground", "none"  # what heights count from
MAX_UNPACKED_BYTES = 64 << 20
KML_MODES = {"absolute": GEOID, "relativeToGround": GROUND, "relativeToSeaFloor": GROUND}  # OGC 12-007r2, 9.20
POSITION_STEPS = 4  # corrections of a height in the tangent plane; each gains four digits


@dataclass(frozen=True, slots=True, eq=False)
class Drawn:
    """Features of a file, with what it says about their coordinates.

    Attributes:
        features: in the order of the file.
        crs: CRS as code or WKT, x east and y north; empty: the file has none.
        heights: by the feature's place in the list, what its z counts from.
        speeds: by a line's place in the list, wanted speed, m/s.
    """

    features: list[Feature]
    crs: str
    heights: list[str]
    speeds: list[float] = field(default_factory=list)


# ---------------------------------------------------------------------------------------------- KML


class _PlainTree(TreeBuilder):
    """Builds a tree; refuses the declarations by which a small file becomes an endless one."""

    def doctype(self, name: str, pubid: str | None, system: str | None) -> None:
        """Refuse a document type."""
        raise PlanError("has a document type declaration, which KML does not need; save it anew without")


def read_kml(data: bytes) -> Drawn:
    """Read the placemarks of a KML file (OGC 12-007r2).

    Raises:
        PlanError: it is not XML, or coordinates cannot be read.
    """
    parser = XMLParser(target=_PlainTree())
    try:
        parser.feed(data)
        root = parser.close()
    except (ParseError, ValueError, LookupError) as error:  # the last: of an unknown encoding
        if isinstance(error, PlanError):
            raise
        raise PlanError(f"is not KML: {error}; export it anew") from error
    drawn = Drawn([], WGS84, [])
    for number, placemark in enumerate((one for one in root.iter() if _tag(one) == "Placemark"), start=1):
        geometry, modes = Geometry(), set[str]()
        where = f"placemark {number}"
        for one in placemark.iter():
            if _tag(one) == "LineString":
                geometry.lines.append(_kml_rows(where, one))
                modes.add(_mode(one))
            elif _tag(one) == "Polygon":
                geometry.polygons.append(
                    [_kml_rows(where, ring) for side in ("outerBoundaryIs", "innerBoundaryIs")
                     for edge in one if _tag(edge) == side for ring in edge if _tag(ring) == "LinearRing"]
                )  # fmt: skip
        if len(modes) > 1:
            raise PlanError(f"{where}: its parts have different altitude modes; give them one")
        drawn.features.append(Feature(where, dict(_kml_attributes(placemark)), geometry))
        drawn.heights.append(modes.pop() if modes else NONE)
    return drawn


def _tag(element: Element) -> str:
    return str(element.tag).rpartition("}")[2]


def _text(element: Element, tag: str) -> str:
    return next(((one.text or "").strip() for one in element if _tag(one) == tag), "")


def _mode(element: Element) -> str:
    return KML_MODES.get(_text(element, "altitudeMode"), NONE)


def _kml_attributes(placemark: Element) -> Iterator[tuple[str, object]]:
    """Yield the values of a placemark: its extended data, name and description."""
    for one in placemark.iter():
        if _tag(one) == "SimpleData":
            yield str(one.get("name", "")), (one.text or "").strip()
        elif _tag(one) == "Data":
            yield str(one.get("name", "")), _text(one, "value")
    for tag in ("description", "name"):
        if text := _text(placemark, tag):
            yield tag, text


def _kml_rows(where: str, element: Element) -> FloatArray:
    """Return longitudes, latitudes and, if all have one, altitudes of an element's ``coordinates``."""
    tuples = re.sub(r"\s*,\s*", ",", _text(element, "coordinates")).split()
    try:
        rows = [[float(value) for value in one.split(",")] for one in tuples]
    except ValueError as error:
        raise PlanError(f"{where}: its coordinates are not numbers: {error}; save it anew") from error
    return _rows(where, rows)


def read_kmz(data: bytes) -> Drawn:
    """Read the KML files of a KMZ archive; GDAL writes one for each layer.

    Raises:
        PlanError: it is no archive, holds no KML, or too much.
    """
    drawn, room = Drawn([], WGS84, []), MAX_UNPACKED_BYTES
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            names = sorted(one for one in archive.namelist() if one.lower().endswith(".kml"))
            if not names:
                raise PlanError("holds no KML file; save it anew")
            for name in names:
                with archive.open(name) as file:
                    text = file.read(room + 1)
                if len(text) > room:
                    raise PlanError(f"holds more than {MAX_UNPACKED_BYTES >> 20} MiB of KML; save the lines alone")
                room -= len(text)
                inner = read_kml(text)
                drawn.features.extend(inner.features)
                drawn.heights.extend(inner.heights)
    except (zipfile.BadZipFile, zlib.error, OSError, EOFError, NotImplementedError, RuntimeError, ValueError) as error:
        if isinstance(error, PlanError):
            raise
        raise PlanError(f"is not a KMZ archive: {error}; save it anew") from error
    return drawn


# ---------------------------------------------------------------------------------------------- GeoJSON


def read_geojson(data: bytes) -> Drawn:
    """Read GeoJSON (RFC 7946), or that of 2008 with a ``crs``. Heights count from the ellipsoid (RFC 7946, 4).

    Raises:
        PlanError: it is not GeoJSON, or coordinates cannot be read.
    """
    try:
        document = json.loads(decoded(data))
    except (ValueError, RecursionError) as error:
        raise PlanError(f"is not JSON: {one_text(error)}; export it anew") from error
    if not isinstance(document, dict):
        raise PlanError("is not GeoJSON: it is no object; export it anew")
    members = document.get("features") if document.get("type") == "FeatureCollection" else [document]
    if not isinstance(members, list):
        raise PlanError("is not GeoJSON: features is no list; export it anew")
    drawn = Drawn([], _geojson_crs(document), [])
    for number, member in enumerate(members, start=1):
        where = f"feature {number}"
        if not isinstance(member, dict):
            raise PlanError(f"{where}: is no object; export it anew")
        is_feature = member.get("type") == "Feature"
        attributes = member.get("properties") if is_feature else {}
        geometry = Geometry()
        _add_geojson(where, member.get("geometry") if is_feature else member, geometry, 0)
        named = {"id": member["id"]} if is_feature and "id" in member else {}
        named |= attributes if isinstance(attributes, dict) else {}
        drawn.features.append(Feature(where, named, geometry))
        drawn.heights.append(ELLIPSOID)
    return drawn


def one_text(error: Exception) -> str:
    """Return an error's text on one line."""
    return " ".join(str(error).split())


def _geojson_crs(document: Mapping[str, Any]) -> str:
    crs = document.get("crs")
    properties = crs.get("properties") if isinstance(crs, dict) else None
    name = properties.get("name") if isinstance(properties, dict) else None
    return name if isinstance(name, str) and name else WGS84


def _add_geojson(where: str, geometry: Any, found: Geometry, depth: int) -> None:
    if geometry is None:
        return
    if not isinstance(geometry, dict) or depth > 8:
        raise PlanError(f"{where}: has no geometry that can be read; export it anew")
    kind, coordinates = geometry.get("type"), geometry.get("coordinates")
    if kind == "GeometryCollection":
        members = geometry.get("geometries")
        for one in members if isinstance(members, list) else []:
            _add_geojson(where, one, found, depth + 1)
    elif kind == "LineString":
        found.lines.append(_rows(where, coordinates))
    elif kind == "MultiLineString":
        found.lines += [_rows(where, one) for one in _list(where, coordinates)]
    elif kind == "Polygon":
        found.polygons.append([_rows(where, ring) for ring in _list(where, coordinates)])
    elif kind == "MultiPolygon":
        for polygon in _list(where, coordinates):
            found.polygons.append([_rows(where, ring) for ring in _list(where, polygon)])
    elif kind not in ("Point", "MultiPoint"):
        raise PlanError(f"{where}: has the type {str(kind)[:40]!r}; want lines or polygons")


def _list(where: str, value: Any) -> list[Any]:
    if not isinstance(value, list):
        raise PlanError(f"{where}: its coordinates are no list; export it anew")
    return value


def _rows(where: str, value: Any) -> FloatArray:
    """Return coordinates as (n, 3), or (n, 2) if one of them has no height."""
    rows = _list(where, value)
    for row in rows:
        if not isinstance(row, list) or len(row) < 2 or not all(map(_is_number, row[:3])):
            raise PlanError(f"{where}: has a position that is not two or three numbers; export it anew")
    width = 3 if rows and all(len(row) > 2 for row in rows) else 2
    return np.array([row[:width] for row in rows], np.float64).reshape(-1, width)


def _is_number(value: Any) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return abs(value) < 1e12 and math.isfinite(value)


# ---------------------------------------------------------------------------------------------- plans of swath sim


def read_sim_plan(data: bytes) -> Drawn:
    """Read the lines of a plan of the virtual aircraft: metres east and north in the tangent plane at its origin, and
    ellipsoidal heights.

    Raises:
        PlanError: it is not such a plan.
    """
    try:
        document = toml_tables(decoded(data))
    except (TomlError, UnicodeDecodeError) as error:
        raise PlanError(f"{one_text(error)}; want a plan of swath sim") from error
    flight, lines = document.get("flight"), document.get("line")
    if not isinstance(flight, dict) or not isinstance(lines, list):
        raise PlanError("is not a plan of swath sim; want the tables [flight] and [[line]]")
    origin: Any = flight.get("origin_deg", [47.5, 8.9])  # the default of swath sim
    if not _are_numbers(origin, 2):
        raise PlanError("flight.origin_deg: want latitude and longitude")
    drawn = Drawn([], WGS84, [])
    for number, line in enumerate(lines):
        where = f"line[{number}]"
        ends: list[Any] = [line.get("from_m"), line.get("to_m")] if isinstance(line, dict) else []
        if not ends or not all(_are_numbers(end, 2) for end in ends) or not _is_number(line.get("height_m")):
            raise PlanError(f"{where}: want from_m, to_m and height_m")
        rows = np.array([_place(origin, end, float(line["height_m"])) for end in ends])
        drawn.features.append(Feature(where, {"name": line.get("name", "")}, Geometry(lines=[rows])))
        drawn.heights.append(ELLIPSOID)
        speed = line.get("speed_mps", flight.get("speed_mps", 60.0))
        drawn.speeds.append(float(speed) if _is_number(speed) else math.nan)
    return drawn


def _are_numbers(value: Any, count: int) -> bool:
    return isinstance(value, list) and len(value) == count and all(map(_is_number, value))


def _place(origin_deg: list[float], end_m: list[float], height_m: float) -> list[float]:
    """Return longitude, latitude in degrees, and height, of a place east and north in the plane at the origin."""
    lat, lon = math.radians(origin_deg[0]), math.radians(origin_deg[1])
    north_e, east_e, down_e = rot_e_from_l(lat, lon).T
    flat = e_from_geodetic(lat, lon, 0.0) + float(end_m[0]) * east_e + float(end_m[1]) * north_e
    up_m = height_m
    for _ in range(POSITION_STEPS):
        place_lat, place_lon, reached_m = geodetic_from_e(flat - up_m * down_e)
        up_m += height_m - float(reached_m)
    return [math.degrees(place_lon), math.degrees(place_lat), height_m]
