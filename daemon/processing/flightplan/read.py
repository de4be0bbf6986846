"""Read a flight plan from the files that ``[plan]`` names: which lines and polygons it holds, where they lie, and how
the lines are named.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import PurePath

import numpy as np
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError, ProjError
from pyproj.transformer import TransformerGroup

from swath.daemon.config.checks import PLAN_SUFFIXES
from swath.daemon.config.config import Config, plan_attachment
from swath.daemon.config.tables import PlanConfig
from swath.daemon.errors import one_line
from swath.daemon.processing.flightplan.formats import (
    ELLIPSOID,
    GEOID,
    GROUND,
    NONE,
    Drawn,
    read_geojson,
    read_kml,
    read_kmz,
    read_sim_plan,
)
from swath.daemon.processing.flightplan.plan import FlightPlan, PlanError, PlannedLine
from swath.daemon.processing.vector_layers import Feature, LayerError, geopackage_layers, shapefile_layer
from swath.georef.arrays import FloatArray
from swath.georef.geodesy.earth import e_from_geodetic

MAX_LINES, MAX_VERTICES = 2_000, 200_000
USUAL_NAMES = ("name", "line", "line_name", "linename", "line_no", "lineno", "line_id", "lineid", "label", "id", "fid")
SAME_PLACE_DEG = 1e-8  # 1 mm: parts of a line that touch are one line
SHORTEST_M, LONGEST_M = 0.001, 2_000_000.0  # between two vertices
BEYOND = 1e9  # no coordinate on earth is larger, in whatever unit
NAME_CHARACTERS = 60
EGM96 = "EPSG:4326+5773"  # of KML's absolute altitudes (OGC 12-007r2, 9.20)

Files = Mapping[str, bytes]  # content by name of the file


def read_plan(config: PlanConfig, files: Files) -> FlightPlan | None:
    """Return the plan that a configuration names; None if it names none.

    Args:
        config: table ``[plan]``.
        files: content of the plan's files and of those beside them, by their names without folder.

    Raises:
        PlanError: a file is missing or cannot be used; one line that names it.
    """
    if config.file is None:
        return None
    name = PurePath(config.file).name
    drawn = _drawn(config.file, files, config.layer)
    notes: list[str] = []
    try:
        lines = _lines(config, drawn, notes)
        area = _polygons(config, drawn)
    except PlanError as error:
        raise PlanError(one_line(f"{name}: {error}")) from error
    if config.area is not None:
        area_name = PurePath(config.area).name
        try:
            area = _polygons(config, _drawn(config.area, files, None))
            if not area:
                raise PlanError(f"{area_name}: has no polygon; give the file of the area, or remove plan.area")
        except PlanError as error:
            text = str(error)
            raise PlanError(text if text.startswith(area_name) else one_line(f"{area_name}: {text}")) from error
    return FlightPlan(name, tuple(lines), tuple(area), tuple(f"{name}: {note}" for note in notes))


def plan_of(config: Config, attachments: Files) -> FlightPlan | None:
    """Return the plan of a configuration from the attachments of its log; raises `PlanError` as `read_plan` does."""
    prefix = plan_attachment("")
    files = {name.removeprefix(prefix): data for name, data in attachments.items() if name.startswith(prefix)}
    return read_plan(config.tables.plan, files)


# ---------------------------------------------------------------------------------------------- files


def _drawn(named: str, files: Files, layer: str | None) -> list[Drawn]:
    """Return the features of a file, for each of its layers."""
    path = PurePath(named)
    data, suffix = files.get(path.name), path.suffix.lower()
    if data is None:
        raise PlanError(f"{path.name}: is not stored with the log; add the file and begin a new recording")
    texts: dict[str, Callable[[bytes], Drawn]] = {
        ".kml": read_kml,
        ".kmz": read_kmz,
        ".geojson": read_geojson,
        ".json": read_geojson,
        ".toml": read_sim_plan,
    }
    try:
        if suffix in texts:
            return [texts[suffix](data)]
        if suffix == ".shp":
            beside = {one: files[name] for one in (".dbf", ".prj", ".cpg") if (name := _beside(path, one, files))}
            layers = [shapefile_layer({".shp": data, **beside})]
        elif suffix == ".gpkg":
            layers = geopackage_layers(data)
            if layer is not None:
                known = ", ".join(one.name for one in layers)
                layers = [one for one in layers if one.name == layer]
                if not layers:
                    raise PlanError(f'has no layer "{layer}"; it has: {known}')
        else:
            raise PlanError(f"is of no known kind; give one of {', '.join(PLAN_SUFFIXES)}")
    except (PlanError, LayerError) as error:
        raise PlanError(one_line(f"{path.name}: {error}")) from error
    return [Drawn(list(one.features), one.crs, [""] * len(one.features)) for one in layers]


def _beside(path: PurePath, suffix: str, files: Files) -> str:
    return next((name for name in files if name.lower() == path.with_suffix(suffix).name.lower()), "")


# ---------------------------------------------------------------------------------------------- places


class _Places:
    """Turns a layer's coordinates into latitude, longitude and heights."""

    def __init__(self, crs: str, config: PlanConfig) -> None:
        given = crs or config.crs
        if not given:
            raise PlanError('has no coordinate system; say it with plan.crs, such as "EPSG:25832"')
        try:
            self._crs = CRS.from_user_input(given)
        except CRSError as error:
            raise PlanError(f'the coordinate system "{given[:60]}" is not known to PROJ; set plan.crs') from error
        self._config = config
        flat = self._crs.to_2d() if len(self._crs.axis_info) < 3 else self._horizontal()
        self._plane = self._transformer(flat)

    def _horizontal(self) -> CRS:
        return self._crs.sub_crs_list[0] if self._crs.is_compound else self._crs.to_2d()

    @staticmethod
    def _transformer(crs: CRS) -> Transformer:
        try:
            return Transformer.from_crs(crs, "EPSG:4326", always_xy=True, allow_ballpark=False)
        except ProjError as error:
            text = f"PROJ knows no transformation from {crs.name} to WGS 84; save the plan in WGS 84"
            raise PlanError(text) from error

    def degrees(self, where: str, rows: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return latitudes and longitudes (n,) in degrees."""
        lon, lat = self._plane.transform(rows[:, 0], rows[:, 1])
        lat, lon = np.asarray(lat), np.asarray(lon)
        if not (np.isfinite(lat).all() and np.isfinite(lon).all()):
            text = f"{where}: lies outside the coordinate system {self._crs.name}; set plan.crs to the one that it has"
            raise PlanError(text)
        if (np.abs(lat) > 90.0).any() or (np.abs(lon) > 360.0).any():
            raise PlanError(f"{where}: latitude {lat[0]:g}, longitude {lon[0]:g} is no place; set plan.crs")
        return lat, (lon + 180.0) % 360.0 - 180.0

    def heights(self, where: str, rows: FloatArray, meaning: str) -> tuple[FloatArray, FloatArray]:
        """Return ellipsoidal heights and heights above ground (n,); nan where unknown."""
        nan = np.full(len(rows), math.nan)
        if rows.shape[1] < 3 or not np.isfinite(rows[:, 2]).all() or not rows[:, 2].any():
            return nan, nan.copy()  # zero throughout: drawn on a map
        told = self._config.heights if self._config.heights != "auto" else meaning or self._meaning()
        if told == NONE:
            return nan, nan.copy()
        if told == GROUND:
            return nan, rows[:, 2].copy()
        if told == ELLIPSOID:
            return rows[:, 2].copy(), nan
        return self._above_ellipsoid(where, rows), nan

    def _meaning(self) -> str:
        return GEOID if self._crs.is_compound else ELLIPSOID

    def _above_ellipsoid(self, where: str, rows: FloatArray) -> FloatArray:
        if self._config.undulation_m is not None:
            return rows[:, 2] + self._config.undulation_m
        source = self._crs if self._crs.is_compound else CRS.from_user_input(EGM96)
        x, y = rows[:, 0], rows[:, 1]
        if not self._crs.is_compound:
            y, x = self.degrees(where, rows)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of a geoid that is not installed, which is reported below
            group = TransformerGroup(source, "EPSG:4979", always_xy=True, allow_ballpark=False)
        if group.transformers and group.best_available:
            height = np.asarray(group.transformers[0].transform(x, y, rows[:, 2])[2])
            if np.isfinite(height).all():
                return height
        raise PlanError(
            f"{where}: its heights count from sea level, and PROJ has no geoid for them here; set plan.undulation_m, "
            'the geoid\'s height above the ellipsoid, or plan.heights = "ground", "ellipsoid" or "none"'
        )


# ---------------------------------------------------------------------------------------------- lines


def _lines(config: PlanConfig, layers: Sequence[Drawn], notes: list[str]) -> list[PlannedLine]:
    drawn = [(one, index) for one in layers for index, feature in enumerate(one.features) if feature.geometry.lines]
    if not drawn:
        raise PlanError("has no lines; give the file of the flight lines")
    if len(drawn) > MAX_LINES:
        raise PlanError(f"has {len(drawn)} lines, more than {MAX_LINES}; give the file of the flight lines alone")
    label = _label(config, [one.features[index] for one, index in drawn])
    if label is None:
        notes.append("its lines have no names; they are numbered in the order of the file")
    places = {id(one): _Places(one.crs, config) for one, _ in drawn}
    lines: list[PlannedLine] = []
    for number, (one, index) in enumerate(drawn, start=1):
        feature = one.features[index]
        name = _name(feature, label) or str(number)
        _refuse_infinite(f"line {name} ({feature.where})", feature.geometry.lines)
        parts = _joined(feature.geometry.lines)
        for part, rows in enumerate(parts, start=1):
            where = f"line {name} ({feature.where})"
            rows = _without_repeats(rows)
            if len(rows) < 2:
                raise PlanError(f"{where}: has no two different vertices; remove it or draw it anew")
            lat, lon = places[id(one)].degrees(where, rows)
            _refuse_steps(where, lat, lon)
            height_m, above_m = places[id(one)].heights(where, rows, one.heights[index])
            speed = one.speeds[index] if one.speeds else math.nan
            lines.append(PlannedLine(name if len(parts) == 1 else f"{name}-{part}", lat, lon, height_m, above_m, speed))
        if len(parts) > 1:
            notes.append(f"line {name} has {len(parts)} parts, which are lines of their own: {name}-1, {name}-2, …")
    if sum(len(line.lat_deg) for line in lines) > MAX_VERTICES:
        raise PlanError(f"its lines have more than {MAX_VERTICES} vertices; simplify them")
    return _uniquely_named(lines, notes)


def _label(config: PlanConfig, features: Sequence[Feature]) -> str | None:
    """Return the attribute that names the lines: the configured one, or the first usual one that has values."""
    there = list(dict.fromkeys(label for feature in features for label in feature.attributes))
    if config.names is not None:
        if config.names not in there:
            known = ", ".join(there[:20]) or "none"
            raise PlanError(f'its lines have no attribute "{config.names}"; set plan.names to one of: {known}')
        return config.names
    by_word = {label.lower().replace(" ", "_"): label for label in reversed(there)}
    usual = [by_word[word] for word in USUAL_NAMES if word in by_word]
    return next((label for label in usual if any(_name(feature, label) for feature in features)), None)


def _name(feature: Feature, label: str | None) -> str:
    value = feature.attributes.get(label) if label is not None else None
    if value is None:
        return ""
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    return one_line(str(value)).strip()[:NAME_CHARACTERS]


def _refuse_infinite(where: str, parts: Sequence[FloatArray]) -> None:
    if any(not (np.abs(rows[:, :2]) < BEYOND).all() for rows in parts):
        raise PlanError(f"{where}: has a position that is no place on earth; save it anew")


def _refuse_steps(where: str, lat_deg: FloatArray, lon_deg: FloatArray) -> None:
    """Refuse neighbouring vertices that are at one place on earth, or on different continents."""
    e = e_from_geodetic(np.radians(lat_deg), np.radians(lon_deg), np.zeros(len(lat_deg)))
    steps_m = np.linalg.norm(np.diff(e, axis=0), axis=1)
    if steps_m.min() < SHORTEST_M:
        raise PlanError(f"{where}: has two vertices in one place; remove one")
    if steps_m.max() > LONGEST_M:
        raise PlanError(f"{where}: has vertices {steps_m.max() / 1000.0:.0f} km apart; mend them, or set plan.crs")


def _joined(parts: Sequence[FloatArray]) -> list[FloatArray]:
    """Return the parts of a line, those joined that follow each other at the same place."""
    joined: list[FloatArray] = []
    for rows in parts:
        if joined and len(rows) and len(joined[-1]) and rows.shape[1] == joined[-1].shape[1]:
            scale = 1.0 if np.abs(rows[:, :2]).max() <= 360.0 else 1e5  # degrees, or metres
            if np.abs(joined[-1][-1, :2] - rows[0, :2]).max() <= SAME_PLACE_DEG * scale:
                joined[-1] = np.concatenate([joined[-1], rows[1:]])
                continue
        joined.append(rows)
    return joined


def _without_repeats(rows: FloatArray) -> FloatArray:
    if len(rows) < 2:
        return rows
    moved = np.concatenate([[True], (np.diff(rows[:, :2], axis=0) != 0.0).any(axis=1)])
    kept: FloatArray = rows[moved]
    return kept


def _uniquely_named(lines: Sequence[PlannedLine], notes: list[str]) -> list[PlannedLine]:
    """Return the lines with names that occur once; of several equal ones the later ones get a number."""
    taken: set[str] = {line.name for line in lines}
    seen: set[str] = set()
    found: list[PlannedLine] = []
    for line in lines:
        name, count = line.name, 1
        while name in seen or (count > 1 and name in taken):
            count += 1
            name = f"{line.name} ({count})"
        if name != line.name:
            notes.append(f'the name "{line.name}" occurs more than once; one of its lines is called "{name}"')
        seen.add(name)
        found.append(replace(line, name=name))
    return found


def _polygons(config: PlanConfig, layers: Sequence[Drawn]) -> list[tuple[FloatArray, ...]]:
    return [polygon for one in layers for polygon in _polygons_of(config, one)]


def _polygons_of(config: PlanConfig, one: Drawn) -> Iterator[tuple[FloatArray, ...]]:
    drawn = [(feature.where, polygon) for feature in one.features for polygon in feature.geometry.polygons]
    places = _Places(one.crs, config) if drawn else None
    for where, polygon in drawn:
        rings = []
        _refuse_infinite(where, polygon)
        for ring in polygon:
            if len(ring) < 4:
                raise PlanError(f"{where}: a ring of its polygon has {len(ring)} vertices, fewer than 4; draw it anew")
            assert places is not None
            rings.append(np.column_stack(places.degrees(where, ring)))
        yield tuple(rings)
