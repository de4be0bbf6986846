"""Reads LAS, LAZ and COPC files in blocks of points, in metres, with a number for every strip."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import laspy
import numpy as np
from laspy.errors import LaspyException
from numpy.typing import NDArray
from pyproj import CRS, Proj
from pyproj.exceptions import CRSError

from swath.daemon.processing.point_times import PointTimes, point_times_of
from swath.daemon.processing.quicklook.point_files import (
    UNREADABLE,
    PointReader,
    Points,
    Selection,
    open_points,
    sample_of,
)
from swath.daemon.processing.quicklook.product_facts import height_unit_in, sessions_in, sidecar_of
from swath.georef.arrays import BoolArray, FloatArray, SingleArray
from swath.georef.map_fit import misfit_of, scales_at

SUFFIXES = (".las", ".laz")
BLOCK_POINTS = 200_000
SALVAGED_POINTS = 1000
SAMPLE_POINTS = 100_000
SAMPLE_A_CELL = 8.0
SIGMA_NAMES = ("sigma_easting", "sigma_northing", "sigma_height")
NOISE_CLASSES = (7, 18)  # LAS 1.4 R15, table 17: low and high noise
LARGEST_SCALE, FARTHEST = 1000.0, 1e9  # units of the coordinates, in any map
MOST_CELLS = 1_000_000_000  # along a side, so that a cell's number fits 64 bits
FARTHEST_SCALE = 10.0  # scale of a map on the ground; beyond it, the coordinates are of another map
METRES_PER_DEGREE = 111_320.0  # on the equator; accurate to 0.5 % anywhere, for pictures only
WANTED = (  # layers of LAZ that are decoded; others would cost time without use
    Selection.XY_RETURNS_CHANNEL
    | Selection.Z
    | Selection.CLASSIFICATION
    | Selection.FLAGS
    | Selection.INTENSITY
    | Selection.POINT_SOURCE_ID
    | Selection.ALL_EXTRA_BYTES
)
BAD_CRS = (CRSError, LaspyException, ValueError, KeyError, IndexError, TypeError, struct.error)


class QuickLookError(ValueError):
    """Raised for files that cannot be looked at; its text is one line that names the file and the remedy."""


@dataclass(frozen=True, slots=True)
class Units:
    """The units of a file's coordinates, with a note for the user.

    Attributes:
        east_m, north_m, up_m: metres per unit.
        name: name of the horizontal unit.
        note: assumption that was made; empty: no assumption.
    """

    east_m: float = 1.0
    north_m: float = 1.0
    up_m: float = 1.0
    name: str = "m"
    note: str = ""


@dataclass(frozen=True, slots=True)
class Block:
    """A block of points with numbered strips, without noise and withheld points.

    Attributes:
        x_m, y_m, z_m: (n,) metres, as in the file.
        intensity: (n,).
        strip: (n,) i4 number of the strip.
        first, single: (n,) bool; True for the first return of a pulse, and for its only return.
        sigma_m: (n, 3) f4 of easting, northing and height, nan if unknown; (0, 3) if the file has no sigmas.
        skipped: number of noise and withheld points left out.
    """

    x_m: FloatArray
    y_m: FloatArray
    z_m: FloatArray
    intensity: SingleArray
    strip: NDArray[np.int32]
    first: BoolArray
    single: BoolArray
    sigma_m: SingleArray
    skipped: int

    def __len__(self) -> int:
        return len(self.x_m)


@dataclass(slots=True)
class Source:
    """A file of points.

    Attributes:
        path: path of the file.
        version, point_format, point_count: from its header.
        crs: None: it has no CRS, or one unknown to PROJ.
        trouble: why there is no CRS; empty: there is one.
        low, high: (3,) corners in its header, in its own unit.
        sigmas: True if every point has three sigmas.
        times: kind of its points' times.
        sidecar: content of the JSON beside it; empty: there is none.
        damage: why not all of it could be read; empty: all was read.
        boxes_m: (4,) west, south, east, north of each block read.
    """

    path: Path
    version: str
    point_format: int
    point_count: int
    crs: CRS | None
    trouble: str
    low: FloatArray
    high: FloatArray
    sigmas: bool
    times: PointTimes
    sidecar: dict[str, Any] = field(default_factory=dict)
    damage: str = ""
    boxes_m: list[FloatArray] = field(default_factory=list)

    @property
    def sessions(self) -> tuple[str, ...]:
        """Sessions of the run that wrote it, from the sidecar; empty if not stated."""
        return tuple(sessions_in(self.sidecar))


class StripBook:
    """Assigns numbers from 0 to strips: by run and point source id; points without an id get their file's number.

    Attributes:
        names: names by number; ``4/2`` is strip 4 of the second run that has one.
        origins: by number, sessions of the run and point source id, 0 if there is none.
        notes: notes on strips of equal ids.
    """

    def __init__(self) -> None:
        self.names: list[str] = []
        self.origins: list[tuple[tuple[str, ...], int]] = []
        self.notes: list[str] = []
        self._of_key: dict[tuple[tuple[str, ...], int] | Path, int] = {}
        self._tables: dict[Path, NDArray[np.int32]] = {}

    def numbers(self, source: Source, source_ids: NDArray[np.uint16]) -> NDArray[np.int32]:
        """Return the strip (n,) of each point of a file."""
        table = self._tables.setdefault(source.path, np.full(65536, -1, np.int32))
        found = table[source_ids]
        if len(found) and found.min() < 0:
            for source_id in np.unique(source_ids[found < 0]):
                table[source_id] = self._number(int(source_id), source)
            found = table[source_ids]
        return np.asarray(found, np.int32)

    def _number(self, source_id: int, source: Source) -> int:
        origin = source.sessions, source_id
        key: tuple[tuple[str, ...], int] | Path = origin if source_id else source.path
        if key not in self._of_key:
            self._of_key[key] = len(self.names)
            self.names.append(self._name(source_id, source))
            self.origins.append(origin)
        return self._of_key[key]

    def _name(self, source_id: int, source: Source) -> str:
        if not source_id:
            return source.path.stem
        before = sum(source_id == other for _, other in self.origins)
        if not before:
            return str(source_id)
        name = f"{source_id}/{before + 1}"
        self.notes.append(f"strip {name} comes from {source.path}, which belongs to other sessions than {source_id}")
        return name


def find_files(paths: Sequence[Path]) -> list[Path]:
    """Return the point files among paths and in their folders, each once, by name.

    Raises:
        QuickLookError: a path does not exist, or holds no such file.
    """
    found: dict[Path, Path] = {}
    for path in paths:
        if path.is_dir():
            inside = sorted(one for one in path.rglob("*") if one.suffix.lower() in SUFFIXES and one.is_file())
            if not inside:
                raise QuickLookError(f"{path}: has no LAS or LAZ file")
        elif path.exists():
            inside = [path]
        else:
            raise QuickLookError(f"{path}: no such file or folder")
        found.update((one.resolve(), one) for one in inside)
    return list(found.values())


def open_source(path: Path) -> Source:
    """Return a file with its header and sidecar read.

    Raises:
        QuickLookError: it is not a LAS or LAZ file, or its coordinates are geocentric.
    """
    try:
        with open_points(path) as reader:
            header = reader.header
            names = set(header.point_format.extra_dimension_names)
    except UNREADABLE as error:
        raise QuickLookError(f"{path}: cannot be read as a LAS or LAZ file ({_line(error)})") from error
    scales, offsets = np.asarray(header.scales, float), np.asarray(header.offsets, float)
    if not ((scales > 0) & (scales <= LARGEST_SCALE)).all():
        wrong = f"the header's scale factors are {scales.tolist()}, want numbers above 0, at most {LARGEST_SCALE:g}"
        raise QuickLookError(f"{path}: {wrong}")
    if not (np.abs(offsets) <= FARTHEST).all():
        raise QuickLookError(f"{path}: the header's offsets are {offsets.tolist()}, want at most {FARTHEST:g}")
    low, high = np.array(header.mins, float), np.array(header.maxs, float)
    if not (np.abs([low, high]) <= FARTHEST).all():
        low, high = np.full(3, np.nan), np.full(3, np.nan)  # the extent then follows from the points
    crs, trouble = _crs_of(header)
    if crs is not None and crs.is_geocentric:
        raise QuickLookError(f"{path}: coordinates are geocentric ({crs.name}); a map needs a projected CRS")
    return Source(
        path=path,
        version=str(header.version),
        point_format=int(header.point_format.id),
        point_count=int(header.point_count),
        crs=crs,
        trouble=trouble,
        low=low,
        high=high,
        sigmas=names.issuperset(SIGMA_NAMES),
        times=point_times_of(path),
        sidecar=sidecar_of(path),
    )


def _line(error: BaseException) -> str:
    return " ".join(str(error).split())[:120] or type(error).__name__


def _crs_of(header: laspy.LasHeader) -> tuple[CRS | None, str]:
    """Return the CRS in the header, or the reason why there is none."""
    try:
        crs = header.parse_crs()
    except BAD_CRS:
        return None, "the CRS in the header cannot be read"
    return crs, "" if crs is not None else "no CRS in the header"


def units_of(sources: Sequence[Source]) -> Units:
    """Return the units of files of one CRS in metres; degrees at the first file's latitude, as on a sphere."""
    known = [source for source in sources if source.crs is not None]
    crs = known[0].crs if known else None
    if crs is None:
        return Units(note=f"{sources[0].trouble}: coordinates are assumed to be in metres")
    plain = crs.source_crs if crs.is_bound and crs.source_crs is not None else crs
    axes = plain.axis_info
    if plain.is_geographic or any("degree" in axis.unit_name for axis in axes):
        north_m = METRES_PER_DEGREE
        up_m = axes[2].unit_conversion_factor if len(axes) > 2 else 1.0
        lat_deg = float(np.clip(np.nan_to_num(sources[0].low[1] + sources[0].high[1]) / 2, -89.9, 89.9))
        east_m = north_m * math.cos(math.radians(lat_deg))
        return Units(
            east_m, north_m, up_m, "°", "coordinates in degrees, so lengths and areas are accurate to 1 % only"
        )
    if not axes:
        return Units(note="the CRS names no unit: coordinates are assumed to be in metres")
    across_m, name = axes[0].unit_conversion_factor, axes[0].unit_name.replace("metre", "m")
    flat_m, misfit = _on_the_ground(plain, known)
    units = _projected(axes, across_m, name, known)
    notes = "; ".join(filter(None, (units.note, misfit)))
    return replace(units, east_m=units.east_m / flat_m, north_m=units.north_m / flat_m, note=notes)


def _projected(axes: Sequence[Any], across_m: float, name: str, known: Sequence[Source]) -> Units:
    """Return the units of a map's axes from their CRS."""
    if len(axes) > 2:
        return Units(across_m, across_m, axes[2].unit_conversion_factor, name)
    if across_m == 1.0:
        return Units(name=name)
    said_m = height_unit_in(known[0].sidecar)
    if said_m is not None:
        return Units(across_m, across_m, said_m, name)
    return Units(across_m, across_m, across_m, name, f"no vertical CRS: heights are assumed to be in {name}")


def _on_the_ground(crs: CRS, sources: Sequence[Source]) -> tuple[float, str]:
    """Return the map's scale on the ground in the files' middle, or 1 if close to it; and a misfit in words.

    A misfit is a map far from true scale there, as web Mercator, or one whose area of use is elsewhere.
    """
    flat = crs.sub_crs_list[0] if crs.is_compound and crs.sub_crs_list else crs
    middles = np.array([(source.low + source.high)[:2] / 2 for source in sources if source.point_count])
    middles = middles[np.isfinite(middles).all(axis=1)]
    if not flat.is_projected or not len(middles):
        return 1.0, ""
    lon_deg, lat_deg = Proj(flat)(middles[:, 0], middles[:, 1], inverse=True)
    there = np.isfinite(lon_deg) & np.isfinite(lat_deg)
    if not there.any():
        return 1.0, f"{crs.name}: the coordinates do not belong to it; give the files' own CRS"
    misfit = misfit_of(flat, crs.name, lat_deg[there], lon_deg[there])
    if not misfit:
        return 1.0, ""
    scale = float(np.sqrt(np.median(scales_at(flat, lat_deg[there], lon_deg[there]).prod(axis=0))))
    if not 1.0 / FARTHEST_SCALE < scale < FARTHEST_SCALE:
        return 1.0, misfit
    return scale, f"{misfit}; lengths and areas shown are those on the ground"


def check_one_crs(sources: Sequence[Source]) -> None:
    """Refuse files that cannot lie on one map.

    Raises:
        QuickLookError: two files have different CRS.
    """
    known = [source for source in sources if source.crs is not None]
    for source in known[1:]:
        if source.crs != known[0].crs:
            first, other = known[0], source
            assert first.crs is not None
            assert other.crs is not None
            raise QuickLookError(
                f"{other.path} is in {other.crs.name}, {first.path} in {first.crs.name}: one map needs one CRS; view "
                "the files one by one"
            )


def read_blocks(source: Source, units: Units, book: StripBook, wanted: Sequence[int] | None = None) -> Iterator[Block]:
    """Yield a file's points block by block; unreadable parts are noted in the source's ``damage``.

    Args:
        source: the file; the boxes of its blocks are noted if it is read completely.
        units: units of all files of a map.
        book: assigns numbers to strips.
        wanted: numbers of blocks, rising; None: all.
    """
    numbers = range(-(-source.point_count // BLOCK_POINTS)) if wanted is None else wanted
    begin = 0
    try:
        with PointReader(source.path, WANTED) as reader:
            for number in numbers:
                begin = number * BLOCK_POINTS
                reader.go_to(begin)
                asked = min(BLOCK_POINTS, source.point_count - begin)
                points = reader.read(asked)
                if len(points) < asked:
                    raise EOFError("the file ends too early")
                block = _block(points, source, units, book)
                if wanted is None:
                    source.boxes_m.append(_box(block))
                yield block
    except UNREADABLE as error:
        yield from _salvaged(source, units, book, begin, _line(error))


def _salvaged(source: Source, units: Units, book: StripBook, begin: int, why: str) -> Iterator[Block]:
    """Yield the readable points of a block that cannot be read at once, in small pieces, and note the damage."""
    try:
        with PointReader(source.path, WANTED) as reader:
            reader.go_to(begin)
            while begin < source.point_count:
                points = reader.read(min(SALVAGED_POINTS, source.point_count - begin))
                if not len(points):
                    break
                block = _block(points, source, units, book)
                begin += len(points)
                yield block
    except UNREADABLE:
        pass
    source.damage = f"{begin:,} of {source.point_count:,} points could be read ({why})"


def density_near(source: Source, units: Units) -> float:
    """Return returns per square metre, roughly, from a sample of points: the header's box is wrong for oblique strips.

    Return 0 if the sample cannot be read.
    """
    try:
        points = sample_of(source.path, SAMPLE_POINTS)
        places_m = np.stack([np.asarray(points.x) * units.east_m, np.asarray(points.y) * units.north_m], axis=1)
    except UNREADABLE:
        return 0.0
    places_m = places_m[np.isfinite(places_m).all(axis=1)]
    if len(places_m) < 2:
        return 0.0
    extent_m = np.maximum(np.ptp(places_m, axis=0), 1.0)
    side_m = math.sqrt(float(extent_m.prod()) / len(places_m))
    for _ in range(8):  # cells shrink until they hold just enough points to tell them from empty ones
        cells = np.minimum(np.floor((places_m - places_m.min(axis=0)) / side_m), MOST_CELLS).astype(np.int64)
        covered = len(np.unique(cells[:, 0] * (min(int(extent_m[1] / side_m), MOST_CELLS) + 2) + cells[:, 1]))
        found = len(places_m) / covered
        if SAMPLE_A_CELL / 2 <= found <= SAMPLE_A_CELL * 2:
            break
        side_m *= math.sqrt(SAMPLE_A_CELL / found)
    whole_m = np.maximum((source.high - source.low)[:2] * [units.east_m, units.north_m], 1.0)
    shuffled = source.point_count / len(points) * float(extent_m.prod() / whole_m.prod())
    return found / side_m**2 * (shuffled if np.isfinite(shuffled) and shuffled > 2.0 else 1.0)


def _box(block: Block) -> FloatArray:
    if not len(block):
        return np.array([np.inf, np.inf, -np.inf, -np.inf])
    return np.array([block.x_m.min(), block.y_m.min(), block.x_m.max(), block.y_m.max()])


def _sigma(points: Points, name: str) -> SingleArray:
    """Return sigmas (n,), metres, as in this software's files; the largest integer means larger or unknown, and gives
    nan.
    """
    kind = points.array.dtype[name]
    values = np.array(points[name], np.float32)
    if kind.kind in "iu":
        values[points.array[name] == np.iinfo(kind).max] = np.nan
    return values


def _block(points: Points, source: Source, units: Units, book: StripBook) -> Block:
    noise = np.isin(np.asarray(points["classification"]), NOISE_CLASSES) | (np.asarray(points["withheld"]) != 0)
    skipped = int(noise.sum())
    if skipped:
        points = points[~noise]
    number, count = np.asarray(points["return_number"]), np.asarray(points["number_of_returns"])
    sigma_m = np.empty((0, 3), np.float32)
    if source.sigmas:
        sigma_m = np.stack([_sigma(points, name) for name in SIGMA_NAMES], axis=1)
    return Block(
        x_m=np.asarray(points.x, np.float64) * units.east_m,
        y_m=np.asarray(points.y, np.float64) * units.north_m,
        z_m=np.asarray(points.z, np.float64) * units.up_m,
        intensity=np.asarray(points["intensity"], np.float32),
        strip=book.numbers(source, np.asarray(points["point_source_id"])),
        first=number <= 1,
        single=count <= 1,
        sigma_m=sigma_m,
        skipped=skipped,
    )
