"""Place control on the earth by its CRS, and check that it lies where the flight was.

A wrong order of columns, feet, a zone before the easting or degrees that are no degrees show kilometres away from the
flight: this is found before any long work, and the reading that would lie there is proposed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from pyproj import CRS, Transformer

from swath.calib.control.points import Surveyed, same_places
from swath.daemon.errors import ExitCode, UserError
from swath.daemon.processing.control.columns import Role
from swath.daemon.processing.control.table import HIGHEST, ControlTable, Mistakes, error_of
from swath.georef.arrays import FloatArray
from swath.georef.geodesy.earth import e_from_geodetic, geodetic_from_e
from swath.georef.map_fit import degrees_text, outside_deg
from swath.georef.mapping.datums import Target, UnknownCrsError, read_target
from swath.georef.mapping.frame import Mapping, MappingError

KEY = "--control-crs"
DEFAULT_SIGMA_M = 0.02  # of a point whose file gives none: what RTK reaches
FAR_M = 50_000.0  # from the few places of the flight that are known
OUTSIDE_DEG = 1.0  # from a CRS's area of use, where the flight's place is unknown
FOOT_M = 0.3048  # the US survey foot differs by 10 m in 5000 km
LONGEST_CODE = 40  # letters of a CRS that is named by its code, not as WKT
MILLION = 1e6
EXCHANGE = "exchange the names of the two columns, or say the columns with --control-columns"


@dataclass(frozen=True, slots=True)
class Placed:
    """Surveyed points, and what was assumed for them, one line each."""

    points: tuple[Surveyed, ...]
    notes: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _Reading:
    """A way to read the plane coordinates: as east, north (n, 2), with their latitude and longitude, degrees."""

    words: str
    plane: FloatArray
    lat_lon: FloatArray
    remedy: str = ""


def place_control(table: ControlTable, crs: str | None, project: Mapping, flight_deg: FloatArray) -> Placed:
    """Return the points of a table on the earth, in the datum of the flight's positions.

    Args:
        table: the points as in their file.
        crs: CRS that the user gives for them; None: that of the file, or else of the project, and for latitudes and
            longitudes the trajectory's datum.
        project: mapping frame of the flight's products.
        flight_deg: (n, 2) latitudes and longitudes of places of the flight, degrees; empty: unknown.

    Raises:
        UserError: the CRS cannot be used; ControlError: the points cannot be meant.
    """
    try:
        target = _target_of(table, crs, project)
    except UnknownCrsError as error:
        place = None if not len(flight_deg) else (float(flight_deg[0, 0]), float(flight_deg[0, 1]))
        raise UserError(f"{table.path}: {UnknownCrsError(error.text, error.key, place)}", ExitCode.USAGE) from error
    except MappingError as error:
        raise UserError(f"{table.path}: {error}", ExitCode.USAGE) from error
    _refuse_feet(table, target)
    height, kind = _height_of(table, target)
    reading = _reading_of(table, target, flight_deg)
    points_e, unit_m = _on_earth(table, target, project, reading, height)
    sigma_m, assumed = _sigmas(table, unit_m)
    lat, lon, above_m = geodetic_from_e(points_e)
    if target is None:  # as the file has them, without the rounding of two conversions
        lat, lon, above_m = *np.radians(reading.lat_lon).T, height
    values = zip(table.names, lat.tolist(), lon.tolist(), above_m.tolist(), sigma_m.tolist(), strict=True)
    points = tuple(Surveyed(*value) for value in values)
    _refuse_twice(table, points)
    notes = [] if table.is_native and crs is None else [_told(table, target, kind, reading), *table.notes]
    return Placed(points, tuple(f"{table.path}: {note}" for note in [*notes, *assumed]))


# ---------------------------------------------------------------------- CRS and heights


def _target_of(table: ControlTable, crs: str | None, project: Mapping) -> Target | None:
    """Return the CRS of the points; None: latitudes and longitudes in the trajectory's datum."""
    text, key = crs or table.crs, KEY if crs else "CRS of the file"
    if not text and table.is_degrees:
        return None
    target = read_target(text, key, geographic=True) if text else project.target
    flat = target.horizontal
    if flat.is_geocentric:
        raise MappingError(f"{target.said} ({flat.name}) is geocentric; give a projected or geographic CRS")
    if table.is_degrees and not flat.is_geographic:
        geodetic = flat.geodetic_crs
        base = "EPSG:CODE" if geodetic is None else ":".join(geodetic.to_authority() or ("EPSG", "CODE"))
        raise MappingError(
            f"{target.said} ({flat.name}) has eastings and northings, but the columns are latitude and longitude; give "
            f"their geographic CRS, such as {KEY} {base}"
        )
    if table.pair == (Role.EAST, Role.NORTH) and flat.is_geographic:
        raise MappingError(
            f"{target.said} ({flat.name}) has latitudes and longitudes, but the columns are easting and northing; give "
            "their projected CRS"
        )
    return target


def _name_of(target: Target | None) -> str:
    """Return the CRS of the points for people."""
    if target is None:
        return "the trajectory's datum"
    return f"{target.text} ({target.crs.name})" if len(target.text) <= LONGEST_CODE else str(target.crs.name)


def _refuse_feet(table: ControlTable, target: Target | None) -> None:
    """Refuse columns whose names say feet where the CRS has metres."""
    axes = [] if target is None else list(target.horizontal.axis_info)
    axes += [] if target is None or target.vertical is None else list(target.vertical.axis_info)
    if table.feet and not any("foot" in axis.unit_name.lower() or "feet" in axis.unit_name.lower() for axis in axes):
        what = "metres above the ellipsoid" if target is None else f"metres in {target.crs.name}"
        raise error_of(
            table.path,
            [f'column "{table.feet[0]}" is in feet, but these are {what}; export metres, or give a CRS in feet'],
        )


def _height_of(table: ControlTable, target: Target | None) -> tuple[FloatArray, str]:
    """Return the heights (n,) of the kind that the CRS has, and the kind for people."""
    vertical = None if target is None else target.vertical
    wanted = Role.ELLIPSOIDAL if vertical is None else Role.ORTHOMETRIC
    role = next((one for one in (wanted, Role.HEIGHT) if one in table.heights), None)
    if role is None:
        other = next(iter(table.heights))
        name = _name_of(target) if target is None else f"{target.said} ({target.crs.name})"
        if vertical is None:
            base = KEY if target is None else f"{KEY} {target.text}"
            text = (
                f'the heights of column "{table.labels[other]}" are above the geoid, but {name} has no vertical part; '
                f"give it: {base}+CODE with the code of the heights, such as 7837 for DHHN2016, or export heights "
                "above the ellipsoid"
            )
        else:
            text = (
                f'the heights of column "{table.labels[other]}" are above the ellipsoid, but {name} has others; give '
                f"{KEY} without its vertical part, or export heights in {vertical.name}"
            )
        raise error_of(table.path, [text])
    heights = table.heights[role]
    mistakes = Mistakes(table.path)
    for where, value in zip(table.where, heights.tolist(), strict=True):
        if not abs(value) <= HIGHEST / FOOT_M:
            mistakes.add(where, f"{table.labels[role]}: no height; give it, or remove the point")
    mistakes.refuse()
    if vertical is not None:
        return heights, f"heights in {vertical.name}"
    why = "" if target is None or role is Role.ELLIPSOIDAL else ", because this CRS has no vertical part"
    return heights, f"heights above the ellipsoid{why}"


def _sigmas(table: ControlTable, unit_m: float) -> tuple[FloatArray, list[str]]:
    """Return the sigmas (n,) in metres, and a note where the default stands for those that are not given."""
    given = np.isfinite(table.sigma_m)
    missing = int((~given).sum())
    if not missing:
        return table.sigma_m * unit_m, []
    who = "no point has a sigma" if missing == len(given) else f"{missing} of {len(given)} points have no sigma"
    return np.where(given, table.sigma_m * unit_m, DEFAULT_SIGMA_M), [f"{who}: {DEFAULT_SIGMA_M:g} m is used for them"]


def _on_earth(
    table: ControlTable, target: Target | None, project: Mapping, reading: _Reading, height: FloatArray
) -> tuple[FloatArray, float]:
    """Return positions (n, 3) in e, in the datum of the flight's positions, and the metres in a unit of height."""
    lat, lon = np.radians(reading.lat_lon).T
    rough_e = e_from_geodetic(lat, lon, height)
    if target is None:
        return rough_e, 1.0
    try:
        frame = project.beside(target.text, target.key)
        frame.settle(rough_e)
        return frame.e_from_map(np.column_stack([reading.plane, height])), float(frame.unit_m[2])
    except MappingError as error:
        raise UserError(f"{table.path}: {error}", ExitCode.USAGE) from error


# ---------------------------------------------------------------------- the plane


def _reading_of(table: ControlTable, target: Target | None, flight_deg: FloatArray) -> _Reading:
    """Return how the plane coordinates are read: as their names say, or in the order that fits the place."""
    flat = None if target is None else target.horizontal
    straight, turned = table.plane, table.plane[:, ::-1]
    words = [" and ".join(_words(role) for role in table.pair), " and ".join(_words(role) for role in table.pair[::-1])]

    def read(plane: FloatArray, words: str, remedy: str = "") -> _Reading:
        return _Reading(words, plane, _lat_lon(flat, plane), remedy)

    def away(reading: _Reading) -> float:
        return _away_m(reading.lat_lon, flat, flight_deg)

    first, second = read(straight, words[0]), read(turned, words[1])
    if away(first) <= _limit_m(flight_deg):
        if table.is_named or away(second) > _limit_m(flight_deg):
            return first
    elif table.pair == (Role.X, Role.Y) and away(second) <= _limit_m(flight_deg):
        return _Reading(
            "Y as easting and X as northing" if table.is_named else "northing and easting", turned, second.lat_lon
        )
    elif not _is_known(flat, flight_deg):
        return first
    else:
        raise error_of(table.path, [_lost(table, target, flight_deg, first, away, read)])
    if _is_known(flat, flight_deg):
        raise error_of(
            table.path,
            [
                "has no header, and both orders of its coordinates lie near the flight; say the columns, as "
                "--control-columns name,E,N,H"
            ],
        )
    raise error_of(table.path, ["has no header; say the columns, as --control-columns name,E,N,H"])


def _lost(
    table: ControlTable,
    target: Target | None,
    flight_deg: FloatArray,
    first: _Reading,
    away: Callable[[_Reading], float],
    read: Callable[[FloatArray, str, str], _Reading],
) -> str:
    """Return the line about points that lie nowhere near, with the reading that would explain them if there is one."""
    limit_m = _limit_m(flight_deg)
    name = _name_of(target)
    nearest = int(np.argmin(_away_each_m(first.lat_lon, target, flight_deg)))
    distance_m = away(first)
    place = "the flight" if len(flight_deg) else "the area where this CRS is used"
    what = f"no control point lies near {place}: read as {first.words} in {name}, the nearest, {table.names[nearest]}, "
    what += f"is {distance_m / 1e3:,.0f} km from it" if math.isfinite(distance_m) else "has no place on the earth"
    for other in _others(table, target, read):
        if away(other) <= limit_m:
            return f"{what}; {other.words}: {other.remedy}"
    where = ""
    if len(flight_deg):
        lat_deg, lon_deg = flight_deg[len(flight_deg) // 2].tolist()
        where = f", at {degrees_text(lat_deg, lon_deg, 2)}"
    remedy = (
        "give geodetic latitude and longitude in degrees" if target is None else f"give the CRS of the file with {KEY}"
    )
    return f"{what}{where}; {remedy}, or the control of this flight"


def _others(
    table: ControlTable, target: Target | None, read: Callable[[FloatArray, str, str], _Reading]
) -> list[_Reading]:
    """Return other ways to read the coordinates: mistakes that people make, with their remedies."""
    plane = table.plane
    if target is None or target.horizontal.is_geographic:
        return [read(plane[:, ::-1], "latitude and longitude look swapped", EXCHANGE)]
    found = [read(plane[:, ::-1], "easting and northing look swapped", EXCHANGE)]
    found.append(read(plane * FOOT_M, "the coordinates look like feet", "export metres, or give a CRS in feet"))
    zone = np.floor(plane[:, 0] / MILLION)
    if (zone > 0).any():
        without = np.column_stack([plane[:, 0] - zone * MILLION, plane[:, 1]])
        remedy = "remove it, or give the CRS with zones in its eastings, such as EPSG:4647 for ETRS89 / UTM zone 32N"
        found.append(read(without, f"the easting begins with the zone, {int(zone[0])}", remedy))
    if np.abs(plane).max() <= 360.0:
        remedy = "name the columns lat and lon"
        lat_lon = [_Reading("the coordinates look like degrees", plane, one, remedy) for one in (plane, plane[:, ::-1])]
        found += lat_lon
    return found


def _lat_lon(flat: CRS | None, plane: FloatArray) -> FloatArray:
    """Return latitudes and longitudes (n, 2), degrees, of coordinates east, north; not finite where there are none.

    The datum is the CRS's own, so that they are good to a few hundred metres.
    """
    if flat is None or flat.is_geographic:
        found = plane[:, ::-1]
        return np.where((np.abs(found[:, :1]) <= 90.0) & (np.abs(found[:, 1:]) <= 360.0), found, np.inf)
    transformer = Transformer.from_crs(flat, flat.geodetic_crs, always_xy=True)
    lon, lat = transformer.transform(plane[:, 0], plane[:, 1], errcheck=False)
    return np.column_stack([lat, lon])


def _is_known(flat: CRS | None, flight_deg: FloatArray) -> bool:
    """Return whether there is a place to compare with: the flight's, or a CRS's area of use."""
    return bool(len(flight_deg)) or (flat is not None and flat.is_projected and flat.area_of_use is not None)


def _limit_m(flight_deg: FloatArray) -> float:
    return FAR_M if len(flight_deg) else OUTSIDE_DEG * 111_200.0


def _away_m(lat_lon: FloatArray, flat: CRS | None, flight_deg: FloatArray) -> float:
    """Return the distance of the nearest point from the flight, or from the CRS's area of use."""
    return float(np.min(_away_flat_m(lat_lon, flat, flight_deg)))


def _away_each_m(lat_lon: FloatArray, target: Target | None, flight_deg: FloatArray) -> FloatArray:
    return _away_flat_m(lat_lon, None if target is None else target.horizontal, flight_deg)


def _away_flat_m(lat_lon: FloatArray, flat: CRS | None, flight_deg: FloatArray) -> FloatArray:
    """Return the distances (n,) of points from the nearest place of the flight, or outside the CRS's area of use."""
    finite = np.isfinite(lat_lon).all(axis=1)
    away = np.full(len(lat_lon), np.inf)
    if not finite.any():
        return away
    lat, lon = lat_lon[finite].T
    if not len(flight_deg):
        away[finite] = 111_200.0 * outside_deg(flat, lat, lon) if flat is not None else 0.0
        return away
    zero = np.zeros(len(lat))
    points_e = e_from_geodetic(np.radians(lat), np.radians(lon), zero)
    flight_lat, flight_lon = np.radians(flight_deg).T
    flight_e = e_from_geodetic(flight_lat, flight_lon, np.zeros(len(flight_deg)))
    away[finite] = np.linalg.norm(points_e[:, np.newaxis] - flight_e, axis=-1).min(axis=1)
    return away


def _words(role: Role) -> str:
    words = {Role.EAST: "easting", Role.NORTH: "northing", Role.X: "easting", Role.Y: "northing"}
    return words.get(role) or ("latitude" if role is Role.LAT else "longitude")


def _told(table: ControlTable, target: Target | None, kind: str, reading: _Reading) -> str:
    how = f", read as {reading.words} because the other order lies elsewhere" if not table.is_named else ""
    how = f", {reading.words}" if table.is_named and reading.words.startswith("Y as") else how
    return f"{len(table.names)} points in {_name_of(target)}, {kind}{how}"


def _refuse_twice(table: ControlTable, points: Sequence[Surveyed]) -> None:
    """Refuse places that occur under two names: they would count twice."""
    mistakes = Mistakes(table.path)
    for later, earlier in same_places(points):
        what = f"{points[later].name} has the position of {points[earlier].name} in {table.where[earlier]}"
        mistakes.add(table.where[later], f"{what}; list each point once")
    mistakes.refuse()
