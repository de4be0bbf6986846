"""Reads what a user gives beside the logs: surveyed control, points picked in the strips, and polygons that planes
fill.

Picked points and polygons are in the flight's coordinate system, ``output.crs``, as the strips' own points are.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from swath.calib.control.doubts import doubts
from swath.calib.control.points import in_t
from swath.calib.features import ControlPoint, Features
from swath.calib.flight import Flight
from swath.calib.ties.picked import picked_ties, read_picked
from swath.daemon.errors import UserError
from swath.daemon.processing.calibration.returns import KeptFlight
from swath.daemon.processing.control.files import ControlFile
from swath.daemon.text_files import text_of
from swath.georef.arrays import FloatArray
from swath.georef.mapping.frame import Mapping

COLUMNS = ("WKT", "name")
FARTHEST = 1e9  # largest coordinate accepted, in any unit of a map
_POLYGON = re.compile(r"^POLYGON\s*(?:Z\s*)?\(\(([^()]*)\)\)$", re.IGNORECASE)
_WANT = 'write "POLYGON ((x y, x y, x y, x y))", one ring without holes'


class PolygonError(ValueError):
    """Raised for a file of polygons that cannot be used; its text is one line for the user."""


def control_of(
    control: ControlFile, flight: Flight, suffered: Collection[str]
) -> tuple[tuple[ControlPoint, ...], list[str]]:
    """Return the surveyed points in the flight's frame, and doubts about them, one line each.

    Args:
        control: file whose points are placed.
        flight: the flight, with its points placed as well as is known.
        suffered: kinds of doubts about the whole (`swath.calib.control.doubts.Doubt`) that are reported but not
            refused.

    Raises:
        UserError: it is doubtful as a whole.
    """
    points, path = in_t(control.points, flight.frame), control.path
    found = doubts(flight, points)
    refusing = [f"{path}: {one.text}" for one in found if one.refuses and one.kind not in suffered]
    if refusing:
        raise UserError(refusing[0])
    return points, [*control.notes, *(f"{path}: {one.text}" for one in found)]


def control_places(
    points: Sequence[ControlPoint], flight: Flight, mapping: Mapping | None
) -> dict[str, dict[str, Any]]:
    """Return place and coordinate system of control points by name, for records; empty without a mapping."""
    if mapping is None or not points:
        return {}
    crs = mapping.description()["crs"]
    places = mapping.map_from_e(flight.frame.e_from_t(np.stack([point.position_t for point in points])))
    keys = ("easting", "northing", "height")
    return {
        point.name: dict(zip(keys, place, strict=True)) | {"crs": crs}
        for point, place in zip(points, places.tolist(), strict=True)
    }


def ties_of(path: Path, kept: KeptFlight) -> Features:
    """Return tie points from points that were picked in the strips as placed with the initial calibrations.

    Raises:
        UserError: the file cannot be read, or no tie point is left; PickedError: it is not such a file.
    """
    picked = read_picked(text_of(path), str(path))
    places_t = _t_from_map(kept, np.stack([one.place for one in picked]))
    found = picked_ties(kept.flight, [replace(one, place=at) for one, at in zip(picked, places_t, strict=True)])
    if not found.ties:
        why = ", ".join(f"{count} {reason}" for reason, count in found.refused.most_common(3))
        raise UserError(
            f"{path}: no tie point remains ({why}); give positions in output.crs, like the points of the strips"
        )
    return found


def read_polygons(text: str, name: str) -> dict[str, FloatArray]:
    """Return the polygons of a CSV with the columns WKT and name, as GIS programs write layers of polygons.

    Args:
        text: content of the file.
        name: name of the file, for messages.

    Returns:
        By name, corners (k, 2) in the file's coordinates, not closed.

    Raises:
        PolygonError: it is not such a file; the message names the line and the remedy.
    """
    reader = csv.DictReader(io.StringIO(text), skipinitialspace=True)
    try:
        return _rings(reader, name)
    except csv.Error as error:
        raise PolygonError(f"{name}: line {reader.reader.line_num}: not CSV: {error}") from None


def _rings(reader: csv.DictReader[str], name: str) -> dict[str, FloatArray]:
    missing = [column for column in COLUMNS if column not in (reader.fieldnames or ())]
    if missing:
        raise PolygonError(f"{name}: line 1: column {missing[0]} is missing; the columns must be {', '.join(COLUMNS)}")
    found: dict[str, FloatArray] = {}
    for row in reader:
        where, key = f"{name}: line {reader.line_num}", (row["name"] or "").strip()
        if not key or key in found:
            wrong = f"{' '.join(key.split())} is given twice" if key else "is missing"
            raise PolygonError(f"{where}: name: {wrong}; give every polygon its own name")
        found[key] = _ring(row["WKT"] or "", where)
    if not found:
        raise PolygonError(f"{name}: has no polygons; give at least one")
    return found


def _ring(text: str, where: str) -> FloatArray:
    match = _POLYGON.match(text.strip())
    if match is None:
        raise PolygonError(f"{where}: WKT: got {text.strip()[:40]!r}; {_WANT}")
    corners = []
    for corner in match[1].split(","):
        try:
            x, y = (float(word) for word in corner.split()[:2])
        except ValueError:
            x = y = math.nan
        if not (abs(x) <= FARTHEST and abs(y) <= FARTHEST):
            raise PolygonError(f"{where}: WKT: the corner is {corner.strip()!r}; {_WANT}")
        corners.append((x, y))
    if len(corners) > 1 and corners[0] == corners[-1]:
        corners.pop()
    if len(corners) < 3:
        raise PolygonError(f"{where}: WKT: has {len(corners)} corners; at least three are needed")
    return np.array(corners)


def rings_of(path: Path, kept: KeptFlight) -> dict[str, FloatArray]:
    """Return the corners (k, 2) of polygons, east and north in t, by name.

    Raises:
        UserError: the file cannot be read, as of `text_of`; PolygonError: as of `read_polygons`.
    """
    polygons = read_polygons(text_of(path), str(path))
    height = _height_on_map(kept)
    rings = {}
    for name, ring in polygons.items():
        rings[name] = _t_from_map(kept, np.column_stack([ring, np.full(len(ring), height)]))[:, :2]
    return rings


def _height_on_map(kept: KeptFlight) -> float:
    """Return the height of a point in the middle of the flight; other ground heights move a corner
    by millimetres only.
    """
    mapping = kept.logged[0].setup.mapping
    swath = kept.flight.swaths[len(kept.flight.swaths) // 2]
    point_e = kept.flight.frame.e_from_t(np.asarray(swath.points_t[len(swath) // 2], np.float64)[np.newaxis])
    return float(point_e[0, 2] if mapping is None else mapping.map_from_e(point_e)[0, 2])


def _t_from_map(kept: KeptFlight, points_map: FloatArray) -> FloatArray:
    mapping = kept.logged[0].setup.mapping
    return kept.flight.frame.t_from_e(points_map if mapping is None else mapping.e_from_map(points_map))
