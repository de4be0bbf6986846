"""Choose the PROJ operation that takes positions to a mapping frame, or refuse it.

PROJ always answers: with an identity where it knows nothing better than 1 m, with ellipsoidal heights where a geoid's
grid is missing. This module accepts an operation only if its steps are known to 5 cm, none is a guess ("ballpark"), and
no better one is left out for a missing grid. Two things are stated and not judged: how well a geoid model realises its
vertical datum, since the grid defines the heights; and which member of a datum ensemble (ETRS89, WGS 84) the output
realises, since every member is a valid one.
"""

from __future__ import annotations

import functools
import math
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
from pyproj import CRS, Transformer
from pyproj.crs import CoordinateOperation
from pyproj.datadir import get_user_data_dir
from pyproj.exceptions import CRSError, ProjError
from pyproj.network import set_network_enabled
from pyproj.transformer import AreaOfInterest, TransformerGroup

from swath.georef.arrays import FloatArray
from swath.georef.geodesy.earth import A_M, B_M, e_from_geodetic, geodetic_from_e
from swath.georef.mapping.crs_names import Place, plain_code, proposals

Area = tuple[float, float, float, float]

ACCURACY_M = 0.05
ELLIPSOID_M = 0.01  # tolerance of its axes: GRS 80 and WGS 84 differ by a tenth of a millimetre
WGS84 = "EPSG:4978"
SAME = "same"
OUTPUT, DATUM = "output.crs", "datum"  # keys, for messages
# Common geographic CRS of EPSG's: of plates (within metres of ITRF), and of older surveys.
CONTINENTS = (4258, 6318, 4617, 7844, 4283, 4167, 6668, 4674, 4148)
NATIONS = (4230, 4314, 4312, 4275, 4277, 4289, 4313, 4149, 4156, 4284, 4179, 4265, 4124, 4267, 4301, 4202, 4618, 4214)
_NAMED = 'name their datum (gnss.datum or --trajectory-datum, such as "EPSG:7912", ITRF2014, with output.epoch)'
_SAME = 'set "same" if they are already in {datum}'
_NOTHING = "PROJ knows no operation there"
_METRE = "metre"
_GEOCENTRIC_AXES = [
    {"name": f"Geocentric {name}", "abbreviation": name, "direction": f"geocentric{name}", "unit": _METRE}
    for name in "XYZ"
]


class MappingError(ValueError):
    """Raised for a mapping frame, datum or position that is refused: one line with the fault and the remedy."""


class UnknownCrsError(MappingError):
    """Raised for a name of a CRS that PROJ does not know; the message proposes codes.

    Attributes:
        text: the name.
        key: the option or key that it was given for.
    """

    def __init__(self, text: str, key: str, place: Place | None = None) -> None:
        self.text, self.key = text, key
        first, *others = proposals(text, place) or ("",)
        way = "EPSG:CODE, EPSG:CODE+CODE with heights, or WKT"
        if first:
            way = ", or ".join([first, *others]) + "; with heights that are not ellipsoidal, EPSG:CODE+CODE"
        super().__init__(f'{key} = "{text}" is unknown to PROJ; write {way}')


@dataclass(frozen=True)
class Target:
    """A mapping frame: its horizontal CRS (projected, or geocentric with `vertical` None), and its name.

    `key` is the option or the configuration's key that it was given for. The horizontal CRS of control may also be
    geographic, with three axes.
    """

    text: str
    crs: CRS
    horizontal: CRS
    vertical: CRS | None
    key: str = OUTPUT

    @property
    def said(self) -> str:
        """The key and its value, for messages."""
        return f'{self.key} = "{self.text}"'

    @property
    def datum_name(self) -> str:
        """The name of the horizontal datum."""
        geodetic = self.horizontal.geodetic_crs
        return str(geodetic.name) if geodetic is not None else "its datum"


@dataclass(frozen=True)
class Operation:
    """The way from positions in e to the mapping frame.

    `definition` is PROJ's pipeline; `accuracy_m` is that of the judged steps, `stated_accuracy_m` is PROJ's own sum,
    geoid and ensembles included (None: unknown); `realisation` is the member of the output's datum ensemble.
    """

    name: str
    definition: str
    accuracy_m: float
    stated_accuracy_m: float | None
    realisation: str
    grids: tuple[str, ...]

    @property
    def moves(self) -> bool:
        """True if it needs an epoch, for rates of a frame or a model of deformation."""
        return "t_epoch=" in self.definition or "proj=defmodel" in self.definition


@dataclass(frozen=True)
class _Judgement:
    """The verdict on one operation of PROJ: `fault` is empty if it may be used."""

    operation: Operation | None
    fault: str


def read_target(text: str, key: str = OUTPUT, *, geographic: bool = False) -> Target:
    """Return a mapping frame as the user wrote it (any text that PROJ reads, or a code that people write otherwise).

    Args:
        text: the frame.
        key: the option or key that it was given for, for messages.
        geographic: accept a geographic CRS, in degrees, too.

    Raises:
        MappingError: the frame is not projected (a geocentric one is accepted: ECEF), has axes other than east and
            north, or counts depths; UnknownCrsError: PROJ does not know it.
    """
    text = plain_code(text)
    crs = _read(text, key)
    parts = crs.sub_crs_list if crs.is_compound else [crs]
    horizontal, vertical = _unbound(parts[0]), parts[1] if crs.is_compound else None
    said = f'{key} = "{text}"'
    if horizontal.is_geographic and geographic:
        if vertical is not None:
            return Target(text, crs, horizontal, vertical, key)
        horizontal = horizontal.to_3d()
        return Target(text, horizontal, horizontal, None, key)
    if horizontal.is_geographic:
        raise MappingError(
            f'{said} ({crs.name}) is geographic, in degrees; use a projected CRS, such as "EPSG:326ZZ" '
            "for UTM zone ZZ north on WGS 84"
        )
    if horizontal.is_vertical:
        raise MappingError(f'{said} ({crs.name}) has heights only; write it after a projected CRS, "EPSG:25832+7837"')
    if not (horizontal.is_projected or (horizontal.is_geocentric and vertical is None)):
        raise MappingError(f"{said} ({crs.name}) is neither projected nor geocentric; use a projected CRS")
    _refuse_axes(said, crs, horizontal, vertical)
    return Target(text=text, crs=crs, horizontal=horizontal, vertical=vertical, key=key)


def read_source(datum: str | None, target: Target) -> CRS:
    """Return the geocentric CRS of positions in e: None is WGS 84 of unknown realisation, "same" the target's datum.

    Raises:
        MappingError: not a datum of positions, or on another ellipsoid than WGS 84's: latitudes, longitudes and heights
            of receivers and files are converted to e on that one.
    """
    if datum is None:
        return CRS.from_user_input(WGS84)
    if datum == SAME:
        source = _geocentric(target.horizontal)
        _refuse_ellipsoid(datum, source)
        return source
    crs = _unbound(_read(plain_code(datum), DATUM))
    if not (crs.is_geographic or crs.is_geocentric):
        geodetic = crs.geodetic_crs
        base = "" if geodetic is None else f', "{":".join(geodetic.to_authority() or (geodetic.name,))}"'
        raise MappingError(f'datum = "{datum}" ({crs.name}) is not a datum of positions; name its geodetic CRS{base}')
    _refuse_ellipsoid(datum, crs)
    return _geocentric(crs)


def choose(
    source: CRS, target: Target, datum: str | None, area: Area | None, accuracy_m: float
) -> tuple[Operation, bool]:
    """Return the best operation from positions to the mapping frame in an area (west, south, east, north in degrees).

    Without an area the frame's own is used: False means that another operation may be best in a part of it.

    Raises:
        MappingError: the best operation is refused, or none in the frame's area is acceptable.
    """
    used = area or _area_of_use(target)
    flat = _candidates(_key(source), _key(target.horizontal), used)
    judged = [_judge(one, target, accuracy_m) for one in flat.operations] or [_Judgement(None, _NOTHING)]
    good = [one.operation for one in judged if one.operation is not None and not one.fault]
    open_still = area is None and flat.several and bool(good)
    faults = (
        []
        if open_still or (good and not flat.missing and not judged[0].fault)
        else [_refusal(flat, judged, target, datum)]
    )
    whole = None if target.vertical is None else _candidates(_key(source), _key(target.crs), used)
    if whole is not None:
        sure = [one for one in whole.operations if not _guesses(one)]
        if area is None and whole.several and sure:
            open_still = True
        elif whole.missing or not sure or _guesses(whole.operations[0]):
            faults.insert(0, _vertical_fault(whole))
    if faults:
        raise MappingError(f"{target.said} ({target.crs.name}): " + "; and ".join(faults))
    if whole is None or open_still:
        return good[0], not open_still
    return _with_heights(whole.operations[0], good[0], target, used, accuracy_m), True


def _area_of_use(target: Target) -> Area:
    area = target.horizontal.area_of_use
    return (-180.0, -90.0, 180.0, 90.0) if area is None else (area.west, area.south, area.east, area.north)


@dataclass(frozen=True)
class _Candidates:
    """PROJ's operations from one CRS to another, best first, and the missing grids of the best one.

    A grid is its file's name, and whether PROJ's server has it.
    """

    operations: tuple[Transformer, ...]
    several: bool
    missing: tuple[tuple[str, bool], ...]
    best_name: str


def _key(crs: CRS) -> str:
    """Return a text for a CRS that PROJ reads back without loss."""
    authority = crs.to_authority(min_confidence=100)
    return ":".join(authority) if authority and CRS.from_user_input(":".join(authority)) == crs else crs.to_json()


@functools.lru_cache(maxsize=64)
def _candidates(source: str, target: str, area: Area) -> _Candidates:
    """Ask PROJ for operations, which takes up to a second; grids are looked for on this machine alone."""
    set_network_enabled(False)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        one, other = CRS.from_user_input(source), CRS.from_user_input(target)
        try:
            group = TransformerGroup(one, other, always_xy=True, area_of_interest=AreaOfInterest(*area))
        except ProjError:
            return _Candidates((), False, (), "")
    lacking: tuple[tuple[str, bool], ...] = ()
    name = ""
    wanting = [one for one in group.unavailable_operations if not one.has_ballpark_transformation]
    if not group.best_available and wanting:
        lacking = tuple(
            dict.fromkeys((grid.short_name, bool(grid.url)) for grid in wanting[0].grids if not grid.available)
        )
        name = str(wanting[0].name)
    several = len(group.transformers) + len(group.unavailable_operations) > 1
    return _Candidates(tuple(group.transformers), several, lacking, name)


def _judge(candidate: Transformer, target: Target, accuracy_m: float) -> _Judgement:
    """Sum up the accuracies of the steps; a step from a member of the output's ensemble to the ensemble counts as 0."""
    total, realisation, grids = 0.0, "", []
    for step in _steps(candidate):
        grids += [grid.short_name for grid in step.grids]
        if step.has_ballpark_transformation:
            return _Judgement(None, f"PROJ knows no operation there and would guess ({step.name})")
        if step.type_name == "Conversion":
            continue
        member = _member(step, target)
        if member:
            realisation = member
        elif step.accuracy < 0.0:
            return _Judgement(None, f'the accuracy of PROJ\'s best operation, "{step.name}", is unknown')
        else:
            total += step.accuracy
    operation = _operation(candidate, total, realisation, tuple(grids))
    if total > accuracy_m + 1e-9:
        return _Judgement(
            operation, f'PROJ\'s best operation, "{_short(operation.name)}", is accurate to {total:g} m only'
        )
    return _Judgement(operation, "")


def _steps(candidate: Transformer) -> tuple[CoordinateOperation, ...]:
    """Return the steps of an operation; an operation of one step is that step."""
    return tuple(candidate.operations or ()) or (CoordinateOperation.from_string(candidate.to_wkt()),)


def _operation(candidate: Transformer, accuracy_m: float, realisation: str, grids: tuple[str, ...]) -> Operation:
    return Operation(
        name=str(candidate.description),
        definition=str(candidate.definition),
        accuracy_m=accuracy_m,
        stated_accuracy_m=None if candidate.accuracy < 0.0 else float(candidate.accuracy),
        realisation=realisation,
        grids=tuple(dict.fromkeys(grids)),
    )


def _member(step: CoordinateOperation, target: Target) -> str:
    """Return the realisation's name if a step only renames it to the output's ensemble; empty otherwise."""
    text: dict[str, Any] = step.to_json_dict()
    source, ensemble = text.get("source_crs") or {}, (text.get("target_crs") or {}).get("datum_ensemble")
    geodetic = target.horizontal.geodetic_crs
    if ensemble is None or geodetic is None or geodetic.datum is None or ensemble["name"] != geodetic.datum.name:
        return ""
    names = {member["name"] for member in ensemble["members"]}
    return str(source["name"]) if source.get("datum", {}).get("name") in names else ""


def _refusal(flat: _Candidates, judged: list[_Judgement], target: Target, datum: str | None) -> str:
    """Return why the datum part is refused, and the remedy."""
    if flat.missing:
        return f'PROJ\'s best operation, "{_short(flat.best_name)}", lacks {_how_to_get(flat.missing)}'
    first = judged[0]
    same = f", or {_SAME.format(datum=target.datum_name)}" if _has_our_ellipsoid(target.horizontal) else ""
    if datum is None:
        return f"the positions are in WGS 84 of unknown realisation, and {first.fault}: {_NAMED}{same}"
    if target.key != OUTPUT:  # coordinates that are compared with the positions, whose datum is settled
        fault = f"the flight's positions are in \"{datum}\", and {first.fault}: give coordinates of the flight's datum"
    else:
        fault = f'the positions are in "{datum}", and {first.fault}: name another datum{same}'
    if first.operation is None:
        return fault
    return f"{fault}; or accept it with output.datum_accuracy_m = {first.operation.accuracy_m:g}"


def _vertical_fault(whole: _Candidates) -> str:
    """Return why the heights are refused."""
    if whole.missing:
        return f"its heights need {_how_to_get(whole.missing)}"
    return (
        "PROJ knows no geoid model for its heights: use a vertical CRS with a geoid model in PROJ, or ellipsoidal "
        "heights"
    )


def _guesses(candidate: Transformer) -> bool:
    return any(step.has_ballpark_transformation for step in _steps(candidate))


def _with_heights(best: Transformer, flat: Operation, target: Target, area: Area, accuracy_m: float) -> Operation:
    """Return the operation with heights, which must agree with the judged one in the plane."""
    grids = tuple(grid.short_name for step in _steps(best) for grid in step.grids)
    operation = _operation(best, flat.accuracy_m, flat.realisation, grids or _named_grids(str(best.definition)))
    if _apart_m(operation, flat, area) > max(accuracy_m, flat.stated_accuracy_m or 0.0):
        raise MappingError(
            f'{target.said}: PROJ\'s operation with heights, "{_short(operation.name)}", is not '
            f'"{_short(flat.name)}" in the plane: use ellipsoidal heights, or another datum'
        )
    return operation


def _named_grids(definition: str) -> tuple[str, ...]:
    return tuple(word.removeprefix("grids=") for word in definition.split() if word.startswith("grids="))


def _apart_m(one: Operation, other: Operation, area: Area) -> float:
    """Return the distance in the plane between two operations in the middle of an area (in units of the map)."""
    lon, lat = (area[0] + area[2] + (360.0 if area[2] < area[0] else 0.0)) / 2.0, (area[1] + area[3]) / 2.0
    xyz = Transformer.from_pipeline("+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart")
    at = (*xyz.transform(lon, lat, 0.0), 2020.0)
    plane = [np.array(transformer_of(each).transform(*at, errcheck=False)[:2], dtype=float) for each in (one, other)]
    distance = float(np.linalg.norm(plane[0] - plane[1]))
    return distance if math.isfinite(distance) else 0.0  # the middle of a frame may lie outside its grids


def transformer_of(operation: Operation) -> Transformer:
    """Return PROJ's transformer of an operation, the same in every process.

    Raises:
        MappingError: a grid is no longer available.
    """
    set_network_enabled(False)
    try:
        return Transformer.from_pipeline(operation.definition)
    except ProjError as error:
        grids = ", ".join(operation.grids) or "none"
        raise MappingError(f"PROJ cannot set up '{_short(operation.name)}' (grids: {grids}): {error}") from error


def between_datums(positions_e: FloatArray, source: CRS, target: CRS, epoch: float) -> FloatArray | None:
    """Return positions (n, 3) of one geocentric CRS in another at a decimal year; None if PROJ has no operation."""
    set_network_enabled(False)
    try:
        transformer = Transformer.from_crs(source, target, always_xy=True, allow_ballpark=False)
        x, y, z = positions_e.T
        found = transformer.transform(x, y, z, np.full(len(positions_e), epoch), errcheck=False)
    except ProjError:
        return None
    moved = np.stack(found[:3], axis=-1)
    return moved if np.isfinite(moved).all() else None


def datum_that_explains(fix_e: FloatArray, apart_e: FloatArray, tolerance_m: float, epoch: float) -> str:
    """Return the name of the datum that explains the offset of a position from its true place; empty if none does.

    Datums of continents and nations whose area of use holds the place are tried, with their heights and with those of
    the place unchanged. Coordinates on another ellipsoid are taken as if they had been read on that of WGS 84, as they
    were here.

    Args:
        fix_e: (3,) the true place, in WGS 84 or ITRF, m.
        apart_e: (3,) the given place minus fix_e, m.
        tolerance_m: the difference below which a datum fits.
        epoch: decimal year.
    """
    lat, lon, height = (float(value[0]) for value in geodetic_from_e(fix_e[np.newaxis]))
    place = math.degrees(lon), math.degrees(lat), height
    best, named = tolerance_m, ""
    for source, codes in (("EPSG:7912", CONTINENTS), ("EPSG:4979", NATIONS)):
        for code in codes:
            for there_e in _misread(source, code, place, epoch):
                for sign in (1.0, -1.0):
                    rest = float(np.linalg.norm(apart_e - sign * (there_e - fix_e)))
                    if rest < best:
                        best, named = rest, str(CRS.from_epsg(code).name)
    return named


def _misread(source: str, code: int, place: tuple[float, float, float], epoch: float) -> list[FloatArray]:
    """Return positions (3,) of coordinates in a geographic CRS if they are read on the ellipsoid of WGS 84."""
    lon_deg, lat_deg, height = place
    area = CRS.from_epsg(code).area_of_use
    if area is None or not (area.south <= lat_deg <= area.north and _between_lon(lon_deg, area.west, area.east)):
        return []
    transformer = _to_geographic(source, code)
    if transformer is None:
        return []
    lon, lat, above, _ = transformer.transform(lon_deg, lat_deg, height, epoch, errcheck=False)
    if not (math.isfinite(lon) and math.isfinite(lat) and math.isfinite(above)):
        return []
    return [e_from_geodetic(math.radians(lat), math.radians(lon), one) for one in (above, height)]


def _between_lon(lon_deg: float, west_deg: float, east_deg: float) -> bool:
    return (lon_deg - west_deg) % 360.0 <= ((east_deg - west_deg) % 360.0 or 360.0)


@functools.lru_cache(maxsize=64)
def _to_geographic(source: str, code: int) -> Transformer | None:
    """Return the transformer to a geographic CRS with ellipsoidal heights; PROJ takes tenths of a second to find it."""
    set_network_enabled(False)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return Transformer.from_crs(source, CRS.from_epsg(code).to_3d(), always_xy=True, allow_ballpark=False)
        except (ProjError, CRSError):
            return None


def _how_to_get(grids: tuple[tuple[str, bool], ...]) -> str:
    listed = ", ".join(name for name, _ in grids)
    command = " ".join(f"--file {name}" for name, offered in grids if offered)
    get = f"`projsync {command}` (or `pyproj sync`), or " if command else ""
    return (
        f"the grid {listed}, which is not installed: {get}copy it to {get_user_data_dir()}, PROJ's folder of this user"
    )


def _short(name: str) -> str:
    """Return an operation's name without its conversions."""
    parts = [part for part in name.split(" + ") if not part.startswith(("Conversion from", "axis order", "Null geo"))]
    return " + ".join(parts) or name


def _read(text: str, key: str) -> CRS:
    try:
        return CRS.from_user_input(text)
    except CRSError as error:
        if key == DATUM:
            raise MappingError(
                f'{key} = "{text}" is unknown to PROJ; write EPSG:CODE, a name such as ITRF2014, or WKT'
            ) from error
        raise UnknownCrsError(text, key) from error


def _unbound(crs: CRS) -> CRS:
    return crs.source_crs if crs.is_bound and crs.source_crs is not None else crs


def _has_our_ellipsoid(crs: CRS) -> bool:
    """Return whether a CRS has the ellipsoid of `swath.georef.geodesy.earth`, within `ELLIPSOID_M`."""
    ellipsoid = crs.ellipsoid
    if ellipsoid is None:
        return False
    apart_m = max(abs(ellipsoid.semi_major_metre - A_M), abs(ellipsoid.semi_minor_metre - B_M))
    return bool(apart_m < ELLIPSOID_M)


def _refuse_ellipsoid(datum: str, crs: CRS) -> None:
    if not _has_our_ellipsoid(crs):
        ellipsoid = "unknown" if crs.ellipsoid is None else crs.ellipsoid.name
        raise MappingError(
            f'datum = "{datum}": {crs.name} is on the ellipsoid {ellipsoid}, but positions are read on that of WGS 84 '
            'and GRS 1980: name the datum of the receiver or its corrections, such as "EPSG:7912"'
        )


def _geocentric(crs: CRS) -> CRS:
    """Return the geocentric CRS on the datum of the given one."""
    if crs.is_geocentric:
        return crs
    geodetic = crs.geodetic_crs
    if geodetic is None:
        raise MappingError(f"{crs.name} has no datum for positions")
    text = geodetic.to_json_dict()
    kept = {key: text[key] for key in ("name", "datum", "datum_ensemble", "prime_meridian") if key in text}
    system = {"subtype": "Cartesian", "axis": _GEOCENTRIC_AXES}
    return CRS.from_json_dict({"type": "GeodeticCRS", **kept, "coordinate_system": system})


def _refuse_axes(said: str, crs: CRS, horizontal: CRS, vertical: CRS | None) -> None:
    """Refuse axes that point west, south or down, which PROJ leaves as they are; it swaps northing and easting."""
    if any(axis.direction == "west" for axis in horizontal.axis_info) and horizontal.is_projected:
        raise MappingError(
            f"{said} ({crs.name}) counts towards the west and south: points are written as easting, "
            "northing, height, so use the version of the CRS with these axes"
        )
    if vertical is not None and any(axis.direction == "down" for axis in vertical.axis_info):
        raise MappingError(f"{said} ({crs.name}) counts depths downwards; use a CRS with heights")
