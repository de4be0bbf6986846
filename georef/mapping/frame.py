"""Convert earth-centred positions to the delivered coordinates: any projected CRS, with heights, by PROJ.

`Mapping` returns easting, northing and height in this order and in the CRS's own units, whatever order the CRS lists
its axes in. georef/mapping/datums.py chooses the operation and refuses unsuitable ones; georef/mapping/cells.py makes
it quick. A geocentric CRS gives ECEF metres.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pyproj
from numpy.typing import ArrayLike
from pyproj import CRS
from pyproj.database import get_database_metadata
from pyproj.enums import TransformDirection
from pyproj.exceptions import CRSError

from swath.georef.arrays import BoolArray, FloatArray, SingleArray
from swath.georef.geodesy.earth import geodetic_from_e
from swath.georef.map_fit import degrees_text, misfit_of, outside_deg
from swath.georef.mapping.cells import APPROXIMATION_M, ROOT_M, MapCells, Mapped
from swath.georef.mapping.datums import (
    ACCURACY_M,
    OUTPUT,
    SAME,
    Area,
    MappingError,
    Operation,
    Target,
    choose,
    read_source,
    read_target,
    transformer_of,
)

__all__ = ["Mapping", "MappingError"]


EPOCHS = (1980.0, 2100.0)
NEARBY_DEG = 0.5
FAR_DEG = 9.0


class Mapping:
    """A mapping frame m and the operation that leads there from e.

    `crs` is any text that PROJ reads; `datum` names the realisation of the positions (None: WGS 84, realisation
    unknown; "same": the user states that it is the output's datum); `epoch` is the positions' (decimal years); `area`
    (west, south, east, north, degrees) is where the points lie; `accuracy_m` is the accuracy that the operation must
    have; `key` is the option that names it, for messages; `geographic` accepts degrees, east before north. Where PROJ
    knows several operations and no area is given, `settle` or the first mapped point decides.

    Raises MappingError, at once or later, for a frame or an operation that is refused.
    """

    def __init__(
        self,
        crs: str,
        *,
        datum: str | None = None,
        epoch: float | None = None,
        area: Area | None = None,
        accuracy_m: float = ACCURACY_M,
        key: str = OUTPUT,
        geographic: bool = False,
    ) -> None:
        self._said = (crs, datum, epoch, accuracy_m)
        self._area = area
        self._epoch = _checked_epoch(epoch)
        self._target = read_target(crs, key, geographic=geographic)
        self._source = read_source(datum, self._target)
        self._operation: Operation | None = None
        operation, settled = choose(self._source, self._target, datum, area, accuracy_m)
        self._refuse_timeless(operation)
        if settled:
            self._take(operation)

    def __getstate__(self) -> dict[str, Any]:
        key, geographic = self._target.key, bool(self._target.horizontal.is_geographic)
        said = (*self._said, key, geographic)
        return {"said": said, "area": self._area, "operation": self._operation}

    def __setstate__(self, state: dict[str, Any]) -> None:
        crs, datum, epoch, accuracy_m, key, geographic = state["said"]
        self._said = (crs, datum, epoch, accuracy_m)
        self._area, self._epoch = state["area"], epoch
        self._target = read_target(crs, key, geographic=geographic)
        self._source = read_source(datum, self._target)
        self._operation = None
        if state["operation"] is not None:
            self._take(state["operation"])

    @property
    def wkt(self) -> str:
        """Well-known text of the whole CRS: version 1 as LAS 1.4 demands (OGC 01-009), or 2 if 1 cannot express it."""
        return _wkt(self._target.crs)

    def beside(self, crs: str, key: str) -> Mapping:
        """Return a frame of another CRS, which may be geographic, for positions of this one's datum and epoch.

        Raises:
            MappingError: as the constructor.
        """
        _, datum, epoch, accuracy_m = self._said
        if datum == SAME:
            authority = self._source.to_authority()
            datum = ":".join(authority) if authority else self._source.to_json()
        return Mapping(crs, datum=datum, epoch=epoch, accuracy_m=accuracy_m, key=key, geographic=True)

    @property
    def target(self) -> Target:
        """The CRS and its parts."""
        return self._target

    @property
    def datum_crs(self) -> CRS:
        """The geocentric CRS of positions in e."""
        return self._source

    def convergence_rad(self, position_e: FloatArray) -> float:
        """Return the direction of grid north at a position (3,), clockwise from true north, rad; 0 if not projected."""
        if self.is_geocentric:
            return 0.0
        lat, lon, _ = (math.degrees(float(value[0])) for value in geodetic_from_e(position_e[np.newaxis]))
        return math.radians(float(pyproj.Proj(self._target.horizontal).get_factors(lon, lat).meridian_convergence))

    @property
    def unit_m(self) -> FloatArray:
        """Metres in a unit of easting, northing and height (3,)."""
        units = [axis.unit_conversion_factor for axis in self._target.horizontal.axis_info]
        if self._target.vertical is not None:
            units = units[:2] + [axis.unit_conversion_factor for axis in self._target.vertical.axis_info]
        return np.array([*units, 1.0][:3])

    def misfit(self, points_e: FloatArray) -> str:
        """Return why the frame does not suit positions in e (n, 3), by `misfit_of`; empty if it suits."""
        if self.is_geocentric or not len(points_e):
            return ""
        lat, lon, _ = (np.degrees(angle) for angle in geodetic_from_e(points_e))
        return misfit_of(self._target.horizontal, f"{self._target.said} ({self._target.crs.name})", lat, lon)

    def settle(self, points_e: ArrayLike) -> None:
        """Choose the operation for positions in e (n, 3) if it is still open; call this before sharing out work.

        Raises:
            MappingError: the best operation is refused.
        """
        if self._operation is None:
            _, datum, _, accuracy_m = self._said
            self._area = _area_of(np.asarray(points_e, dtype=np.float64).reshape(-1, 3))
            operation, _ = choose(self._source, self._target, datum, self._area, accuracy_m)
            self._refuse_timeless(operation)
            self._take(operation)

    def map_from_e(self, points_e: FloatArray) -> FloatArray:
        """Return easting, northing, height (n, 3) of positions in e (n, 3), within 0.1 mm of PROJ's own.

        A point's result depends on the point alone.

        Raises:
            MappingError: PROJ has no coordinates for a point; the message names the place.
        """
        points = np.ascontiguousarray(points_e, dtype=np.float64)
        self._settle_by_first(points)
        return self._cells.map(points)

    def map_with_sigmas(
        self, points_e: FloatArray, covariance_e: FloatArray | None
    ) -> tuple[FloatArray, SingleArray | None]:
        """Return `map_from_e`, and sigmas (n, 3) along easting, northing and up, in metres, if covariances are given.

        Covariances are (n, 6) xx xy xz yy yz zz in e, m². The sigmas are those of the coordinates in the file: the
        projection's scale is left in (a part in a thousand in UTM), units other than metres are taken out. They come
        from the derivatives at the cube's centre.
        """
        if covariance_e is None:
            return self.map_from_e(points_e), None
        mapped = self.map_with_beams(points_e, covariance_e, None)
        return mapped.points_map, mapped.sigma_map

    def map_with_beams(
        self, points_e: FloatArray, covariance_e: FloatArray, origin_e: FloatArray | None, *, whole: bool = False
    ) -> Mapped:
        """Return `map_with_sigmas`; the directions of beams from origins (n, 3) in e, if given; and, if ``whole``,
        covariances (n, 6) along the same axes as the sigmas, m².
        """
        points = np.ascontiguousarray(points_e, dtype=np.float64)
        self._settle_by_first(points)
        origins = None if origin_e is None else np.ascontiguousarray(origin_e, dtype=np.float64)
        covariance_e = np.ascontiguousarray(covariance_e, dtype=np.float64)
        return self._cells.map_with_beams(points, covariance_e, origins, whole=whole)

    def reaches(self, points_e: FloatArray) -> BoolArray:
        """Return whether `map_from_e` has coordinates for each of positions in e (n, 3), without raising for any.

        Raises:
            MappingError: no operation can be chosen.
        """
        points = np.ascontiguousarray(points_e, dtype=np.float64)
        reached: BoolArray = np.logical_and.reduce(np.isfinite(points), axis=1)
        points = points[reached]
        self._settle_by_first(points)
        centres, cube = np.unique(np.floor(points / ROOT_M), axis=0, return_inverse=True)
        admitted = np.ones(len(centres), dtype=bool)
        for k, centre in enumerate((centres + 0.5) * ROOT_M):
            try:
                self._admit(centre[np.newaxis])
            except MappingError:
                admitted[k] = False
        reached[reached] = (
            np.logical_and.reduce(np.isfinite(self._forward(points)), axis=1) & admitted[cube.reshape(-1)]
        )
        return reached

    def exact(self, points_e: FloatArray) -> FloatArray:
        """Return PROJ's own results (n, 3), which `map_from_e` approximates."""
        points = np.ascontiguousarray(points_e, dtype=np.float64)
        self._settle_by_first(points)
        return _finite(self._forward(points), points, self._target.said)

    def e_from_map(self, points_map: FloatArray) -> FloatArray:
        """Return positions in e (n, 3) of easting, northing, height (n, 3), by PROJ. The operation must be settled."""
        if self._operation is None:
            raise MappingError(f"{self._target.said}: the operation that leads to this CRS is not yet chosen")
        points = np.ascontiguousarray(points_map, dtype=np.float64)
        found = self._transform(points, TransformDirection.INVERSE)
        wrong = np.flatnonzero(~np.isfinite(found).all(axis=1))
        if len(wrong):
            raise MappingError(f"{points[wrong[0]].tolist()} is not a place in {self._target.crs.name}")
        return found

    def description(self) -> dict[str, Any]:
        """Return the description of the frame for a sidecar file: plain numbers and texts."""
        target, (_, datum, epoch, accuracy_m) = self._target, self._said
        stated: dict[str, Any] = {
            "crs": target.text,
            "name": str(target.crs.name),
            "axes": [axis.name for axis in self._target.crs.axis_info] if self.is_geocentric else ["E", "N", "up"],
            "units": {"metres": self.unit_m.tolist(), "names": self._unit_names()},
            "heights": self._heights(),
            "datum": self._datum_text(datum),
            "datum_said": datum,
            "epoch": epoch,
            "accuracy_wanted_m": accuracy_m,
            "proj": pyproj.proj_version_str,
            "epsg": str(get_database_metadata("EPSG.VERSION")),
            "approximation_m": APPROXIMATION_M,
        }
        return stated | self._operation_text()

    @property
    def is_geocentric(self) -> bool:
        """True if coordinates are earth-centred, so that there is no map."""
        return bool(self._target.horizontal.is_geocentric)

    def _unit_names(self) -> list[str]:
        parts = [self._target.horizontal, *([self._target.vertical] if self._target.vertical is not None else [])]
        names = [axis.unit_name for part in parts for axis in part.axis_info]
        return [*names, "metre"][:3]

    def _heights(self) -> str:
        if self.is_geocentric:
            return "none: earth-centred coordinates"
        if self._target.vertical is not None:
            grids = self._operation.grids if self._operation is not None else ()
            return str(self._target.vertical.name) if self._target.vertical.name != "unknown" else f"above {grids}"
        kept = self._operation is not None and "push v_3" in self._operation.definition
        return f"ellipsoidal ({_ellipsoid(self._source if kept else self._target.horizontal)})"

    def _datum_text(self, datum: str | None) -> str:
        if datum == SAME:
            ellipsoid = _ellipsoid(self._target.horizontal)
            return f"same: positions are in {self._target.datum_name} (ellipsoid {ellipsoid}) by the user's word"
        return "WGS 84, realisation unknown" if datum is None else f"{datum} ({self._source.name})"

    def _operation_text(self) -> dict[str, Any]:
        operation = self._operation
        if operation is None:
            return {"operation": None}
        return {
            "operation": operation.name,
            "pipeline": operation.definition,
            "accuracy_m": operation.accuracy_m,
            "stated_accuracy_m": operation.stated_accuracy_m,
            "realisation": operation.realisation or None,
            "grids": list(operation.grids),
            "area": None if self._area is None else list(self._area),
        }

    def _settle_by_first(self, points_e: FloatArray) -> None:
        if self._operation is None and len(points_e):
            self.settle(points_e[:1])

    def _refuse_timeless(self, operation: Operation) -> None:
        if operation.moves and self._epoch is None:
            raise MappingError(
                f'{self._target.said}: "{operation.name.split(" + ")[0]}" changes with time: give the '
                "epoch of the positions, such as output.epoch = 2026.9"
            )

    def _take(self, operation: Operation) -> None:
        self._operation = operation
        self._transformer = transformer_of(operation)
        self._cells = MapCells(self._forward, self.unit_m, self._admit, alone=self.exact)

    def _forward(self, points_e: FloatArray) -> FloatArray:
        return self._transform(points_e, TransformDirection.FORWARD)

    def _transform(self, points: FloatArray, direction: TransformDirection) -> FloatArray:
        x, y, z = (points[:, i].copy() for i in range(3))
        t = np.full(len(points), np.inf if self._epoch is None else self._epoch)
        found = self._transformer.transform(x, y, z, t, direction=direction, errcheck=False)
        return np.stack(found[:3], axis=-1)

    def _admit(self, centre_e: FloatArray) -> None:
        """Refuse cubes more than 1000 km outside the CRS's area of use: a wrong zone, or a wrong country."""
        area = self._target.horizontal.area_of_use
        if area is None or not len(centre_e):
            return
        lat, lon, _ = (np.degrees(angle) for angle in geodetic_from_e(centre_e))
        far = np.flatnonzero(outside_deg(self._target.horizontal, lat, lon) > FAR_DEG)
        if len(far):
            where = degrees_text(float(lat[far[0]]), float(lon[far[0]]), 1)
            raise MappingError(
                f"{self._target.said} ({self._target.crs.name}) is used from {area.west:g}° to "
                f"{area.east:g}° E, {area.south:g}° to {area.north:g}° N: points lie more than 1000 km outside, "
                f"at {where}"
            )


def _ellipsoid(crs: CRS) -> str:
    geodetic = crs.geodetic_crs
    return str(geodetic.ellipsoid.name) if geodetic is not None and geodetic.ellipsoid is not None else "unknown"


def _checked_epoch(epoch: float | None) -> float | None:
    if epoch is None:
        return None
    if not EPOCHS[0] <= epoch <= EPOCHS[1]:
        raise MappingError(f"output.epoch = {epoch:g} is not a decimal year from 1980 to 2100, such as 2026.9")
    return float(epoch)


def _area_of(points_e: FloatArray) -> Area:
    """Return the box around positions, half a degree wider, across the antimeridian where that is shorter."""
    lat, lon, _ = (np.degrees(angle) for angle in geodetic_from_e(points_e))
    finite = np.isfinite(lat) & np.isfinite(lon)
    if not finite.any():
        raise MappingError(
            "the first position is not a number, so no datum operation can be chosen; give finite positions"
        )
    lat, lon = lat[finite], np.sort(lon[finite])
    south, north = max(float(lat.min()) - NEARBY_DEG, -90.0), min(float(lat.max()) + NEARBY_DEG, 90.0)
    gaps = np.diff(np.append(lon, lon[0] + 360.0))
    widest = int(gaps.argmax())
    margin = NEARBY_DEG / max(0.01, math.cos(math.radians(max(abs(south), abs(north)))))
    if gaps[widest] <= 2.0 * margin:
        return -180.0, south, 180.0, north
    west, east = float(lon[(widest + 1) % len(lon)]) - margin, float(lon[widest]) + margin
    return _wrapped(west), south, _wrapped(east), north


def _wrapped(lon_deg: float) -> float:
    return (lon_deg + 180.0) % 360.0 - 180.0


def _finite(mapped: FloatArray, points_e: FloatArray, said: str) -> FloatArray:
    """Return ``mapped`` if all of it is finite; else refuse it, naming the first place without coordinates."""
    wrong = np.flatnonzero(~np.isfinite(mapped).all(axis=1))
    if len(wrong):
        raise MappingError(
            f"{said} has no coordinates for {len(wrong)} points, the first at "
            f"{_place(points_e[wrong[0]])}: they lie outside the domain of the projection or of its grids"
        )
    return mapped


def _place(point_e: FloatArray) -> str:
    if not np.isfinite(point_e).all():
        return "positions that are not numbers"
    lat, lon, height = geodetic_from_e(point_e)
    return f"{degrees_text(math.degrees(float(lat)), math.degrees(float(lon)), 4)}, height {float(height):.0f} m"


def _wkt(crs: CRS) -> str:
    flat = crs.to_2d() if crs.is_projected and not crs.is_compound else crs
    try:
        return str(flat.to_wkt("WKT1_GDAL"))
    except CRSError:
        return str(flat.to_wkt("WKT2_2019"))
