"""Defines the tile files of the live map, writes and reads them.

The map's cells are square, in the frame ``local`` of `swath.daemon.processing.live.frame`: east and north in metres
from an origin that the index gives. A tile has `SIDE` by `SIDE` cells and is one file, replaced as a whole; the index
tells which tiles there are, and since which step of its sequence each one is as it is. docs/live.md states the layout.

This module needs NumPy alone, so that programs that only show the map need nothing else of processing.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import struct
from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swath.daemon.processing.live.files import exchange_file

FOLDER = "live"  # of all that live writes for other programs, in the log directory
TILES, INDEX = "tiles", "index.json"
SUFFIX = ".tile"
VERSION = 1
SIDE = 128  # cells along a side of a tile
MAGIC = b"SWTL"
HEAD = struct.Struct("<4sHHiiIIdQdI4x")  # 56 bytes
HEAD_BYTES = 64
NO_DIFFERENCE = -(1 << 15)
# As they lie in the file, each SIDE × SIDE cells, rows from south to north, columns from west to east.
STORED: dict[str, str] = {
    "points": "<u4",
    "pulses": "<u2",
    "height": "<f4",
    "lowest": "<i2",
    "highest": "<i2",
    "seconds": "<u2",
    "strip": "<u2",
    "difference": "<i2",
    "no_return": "<u2",
    "strips": "u1",
}
_SIZES = {name: np.dtype(kind).itemsize * SIDE * SIDE for name, kind in STORED.items()}
_PLACES = {name: HEAD_BYTES + sum(list(_SIZES.values())[:k]) for k, name in enumerate(STORED)}
FILE_BYTES = HEAD_BYTES + sum(_SIZES.values())
# What readers get: counts as integers, metres as float32 with nan where there is no value.
LAYERS = {
    "points": "points",
    "pulses": "pulses",
    "height_m": "height",
    "lowest_m": "lowest",
    "highest_m": "highest",
    "gps_s": "seconds",
    "strip": "strip",
    "strips": "strips",
    "difference_m": "difference",
    "no_return": "no_return",
}
SUMMED = ("points", "pulses", "no_return")
KEPT_FROM = 4  # cells on a side that one cell of the reader's smallest kept view stands for
_LEVELS = [KEPT_FROM << k for k in range((SIDE // KEPT_FROM).bit_length())]
DIRECT_TILES = 64  # tiles whose files one view in full resolution reads at most; more cells are joined instead
POWERS = [(first, total - first) for total in range(4) for first in range(total, -1, -1)]  # of a placement's terms
Place = tuple[int, int]  # column and row of a tile, counted from the origin
Layers = dict[str, NDArray[Any]]


@dataclass(frozen=True, slots=True)
class Head:
    """The head of a tile file.

    Attributes:
        column, row: place of the tile: its western edge is at ``column`` · `SIDE` · ``cell_m`` east of the origin.
        generation: number of the grid; another one has other cells, or belongs to another run.
        cell_m: side of a cell.
        sequence: step of the index's sequence at which the tile was written.
        base_m: height above the origin that the stored lowest and highest heights count from.
        first_gps_s: GPS second that the stored seconds count from, beginning with 1.
    """

    column: int
    row: int
    generation: int
    cell_m: float
    sequence: int
    base_m: float
    first_gps_s: int

    def pack(self) -> bytes:
        """Return the head as bytes."""
        return HEAD.pack(
            MAGIC, VERSION, HEAD_BYTES, self.column, self.row, self.generation, SIDE, self.cell_m, self.sequence,
            self.base_m, self.first_gps_s,
        ).ljust(HEAD_BYTES, b"\0")  # fmt: skip

    @classmethod
    def unpack(cls, data: bytes) -> Head | None:
        """Return the head that the bytes begin with; None: they are no tile of this version."""
        if len(data) < HEAD_BYTES or data[:4] != MAGIC:
            return None
        _, version, _, column, row, generation, side, cell_m, sequence, base_m, first_gps_s = HEAD.unpack_from(data)
        if (version, side) != (VERSION, SIDE) or not (math.isfinite(cell_m) and cell_m > 0.0 and math.isfinite(base_m)):
            return None
        return cls(column, row, generation, cell_m, sequence, base_m, first_gps_s)


def blank_tile(head: Head) -> tuple[bytearray, Layers]:
    """Return a tile file to be filled: its bytes, and in them the stored layers, each (`SIDE`, `SIDE`)."""
    data = bytearray(FILE_BYTES)
    data[:HEAD_BYTES] = head.pack()
    layers = {
        name: np.frombuffer(data, kind, SIDE * SIDE, _PLACES[name]).reshape(SIDE, SIDE) for name, kind in STORED.items()
    }
    return data, layers


class TileFolder:
    """Writes the tiles of one run into ``tiles/`` of a folder; those of the run before are removed.

    Attributes:
        sequence: number of times that the index was written.
        generation: number of the grid, higher than that of any run before in the same folder.
    """

    def __init__(self, folder: Path) -> None:
        """Prepare the folder's tiles; nothing is written yet."""
        self.sequence = 0
        self._folder = folder / TILES
        before = _json_of(self._folder / INDEX)
        self.generation = _whole(before.get("generation")) + 1
        self._sequences: dict[Place, int] = {}
        self._cleared = False

    @property
    def size(self) -> int:
        """Bytes of the tiles written."""
        return len(self._sequences) * FILE_BYTES

    def has(self, place: Place) -> bool:
        """Return whether a tile has been written."""
        return place in self._sequences

    def renew(self) -> None:
        """Begin another generation: the cells have another size, and all tiles written so far are outdated."""
        self.generation += 1
        self._sequences.clear()
        self._cleared = False

    def write(self, tiles: Iterable[tuple[Place, Callable[[Head], bytearray]]], about: Mapping[str, Any]) -> None:
        """Write tiles and then the index.

        Args:
            tiles: places, and functions that make the file from a head with place, generation and sequence filled in.
            about: what the index says beside that: ``cell_m``, ``origin`` and so on.

        Raises:
            OSError: a file cannot be written.
        """
        if not self._cleared:
            self._folder.mkdir(exist_ok=True)
        sequence = self.sequence + 1
        for place, make in tiles:
            head = Head(*place, self.generation, float(about["cell_m"]), sequence, 0.0, 0)
            exchange_file(self._folder, name_of(place), make(head))
            self._sequences[place] = sequence
        index = {
            "version": VERSION,
            "generation": self.generation,
            "sequence": sequence,
            "tile_cells": SIDE,
            **about,
            "tiles": {f"{column}_{row}": at for (column, row), at in self._sequences.items()},
        }
        exchange_file(self._folder, INDEX, json.dumps(index, separators=(",", ":")).encode())
        self.sequence = sequence
        if not self._cleared:
            self._remove_others()
            self._cleared = True

    def _remove_others(self) -> None:
        known = {name_of(place) for place in self._sequences}
        for path in self._folder.glob(f"*{SUFFIX}*"):
            if path.name not in known:
                path.unlink(missing_ok=True)


def name_of(place: Place) -> str:
    """Return the name of a tile's file."""
    return f"{place[0]}_{place[1]}{SUFFIX}"


@dataclass(frozen=True, slots=True)
class View:
    """A part of the map, its rows from south to north.

    Attributes:
        west_m, south_m: edges in the frame ``local``.
        cell_m: side of a cell of this view.
        layers: by name of `LAYERS`, values (rows, columns). ``points``, ``pulses`` (first returns) and ``no_return``
            (of scanners whose parser tells such pulses) are numbers of a cell; heights are in metres above the
            origin; ``gps_s`` is the whole GPS second of the newest point, 0: none; ``strip`` is the newest strip, 0:
            none; ``strips`` the number of strips that have points there; ``difference_m`` is the height of an earlier
            strip minus that of a later one.
    """

    west_m: float
    south_m: float
    cell_m: float
    layers: Layers

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        rows, columns = next(iter(self.layers.values())).shape
        return int(rows), int(columns)


class TileReader:
    """Reads the map that a live run writes, while it is being written.

    Attributes:
        index: what the index says; empty: there is none yet.
        unreadable: number of tile files that could not be read, or were no tiles.
    """

    def __init__(self, folder: Path, kept: int = 2048) -> None:
        """Read the map below a folder of live products; joined cells of at most ``kept`` tiles stay in memory."""
        self.index: dict[str, Any] = {}
        self.unreadable = 0
        self._folder = folder / TILES
        self._sign: tuple[int, int, int] | None = None
        self._tiles: dict[Place, int] = {}
        self._kept = kept
        self._joined: OrderedDict[Place, tuple[int, int, dict[int, Layers]]] = OrderedDict()

    @property
    def generation(self) -> int:
        """Number of the grid; what was read of another one is outdated. 0: there is none."""
        return _whole(self.index.get("generation"))

    @property
    def sequence(self) -> int:
        """The newest step; 0: nothing has been read."""
        return _whole(self.index.get("sequence"))

    @property
    def cell_m(self) -> float:
        """Side of a cell."""
        return float(self.index.get("cell_m", math.nan))

    def refresh(self) -> bool:
        """Read the index if it has changed; return True if it has."""
        try:
            state = os.stat(self._folder / INDEX)
        except OSError:
            return False
        sign = state.st_ino, state.st_mtime_ns, state.st_size
        if sign == self._sign:
            return False
        index = _json_of(self._folder / INDEX)
        if index.get("version") != VERSION or index.get("tile_cells") != SIDE or not _is_length(index.get("cell_m")):
            return False
        self._sign, self.index = sign, index
        self._tiles = dict(_places(index.get("tiles")))
        return True

    def changed(self, since: int = 0) -> dict[Place, int]:
        """Return the tiles written after a step of the sequence, with their steps."""
        return {place: at for place, at in self._tiles.items() if at > since}

    def extent_m(self) -> tuple[float, float, float, float] | None:
        """Return west, south, east and north edge of all tiles; None: there are none."""
        if not self._tiles:
            return None
        side_m = SIDE * self.cell_m
        columns, rows = zip(*self._tiles, strict=True)
        return min(columns) * side_m, min(rows) * side_m, (max(columns) + 1) * side_m, (max(rows) + 1) * side_m

    def tile(self, place: Place, layers: Iterable[str] = tuple(LAYERS)) -> View | None:
        """Return a tile in full resolution; None: there is no such tile, or not of the index's generation."""
        path = self._folder / name_of(place)
        try:
            with path.open("rb") as file:
                head = Head.unpack(file.read(HEAD_BYTES))
                if head is None or os.fstat(file.fileno()).st_size != FILE_BYTES:
                    self.unreadable += 1
                    return None
                if (head.column, head.row) != place or head.generation != self.generation:
                    return None
                wanted = {name: _layer(_read(file, LAYERS[name]), name, head) for name in layers}
        except FileNotFoundError:
            return None
        except (OSError, ValueError):
            self.unreadable += 1
            return None
        side_m = SIDE * head.cell_m
        return View(head.column * side_m, head.row * side_m, head.cell_m, wanted)

    def view(
        self,
        west_m: float,
        south_m: float,
        east_m: float,
        north_m: float,
        cell_m: float,
        layers: Iterable[str] = tuple(LAYERS),
    ) -> View | None:
        """Return the part of the map that covers a rectangle, whole cells of it.

        Args:
            west_m, south_m, east_m, north_m: edges of the rectangle in the frame ``local``.
            cell_m: side of the cells wanted; the view has the largest that are not larger: the map's own or joined
                ones, 2, 4, … `SIDE` a side. If the rectangle has more than `DIRECT_TILES` tiles, they are joined ones.
            layers: names of `LAYERS`.

        Returns:
            The view; None: there is no map, or none of its tiles lies in the rectangle.
        """
        names = tuple(layers)
        if not self._tiles or not (west_m < east_m and south_m < north_m):
            return None
        own_m = self.cell_m
        step = 1
        while step < SIDE and 2 * step * own_m <= cell_m:
            step *= 2
        inside = self._inside(west_m, south_m, east_m, north_m)
        while step < KEPT_FROM and len(inside) > DIRECT_TILES:
            step *= 2
        if not inside:
            return None
        columns, rows = zip(*inside, strict=True)
        side = SIDE // step
        first, last = (min(columns) * side, min(rows) * side), ((max(columns) + 1) * side, (max(rows) + 1) * side)
        joined_m = step * own_m
        west, south = max(first[0], math.floor(west_m / joined_m)), max(first[1], math.floor(south_m / joined_m))
        east, north = min(last[0], math.ceil(east_m / joined_m)), min(last[1], math.ceil(north_m / joined_m))
        made = {name: _empty(name, (north - south, east - west)) for name in names}
        for place in inside:
            self._put(place, step, (west, south), made)
        return View(west * joined_m, south * joined_m, joined_m, made)

    def _inside(self, west_m: float, south_m: float, east_m: float, north_m: float) -> list[Place]:
        side_m = SIDE * self.cell_m
        return [
            (column, row)
            for column, row in self._tiles
            if column * side_m < east_m
            and (column + 1) * side_m > west_m
            and row * side_m < north_m
            and (row + 1) * side_m > south_m
        ]

    def _put(self, place: Place, step: int, corner: Place, made: Layers) -> None:
        """Copy the part of a tile that lies in a view whose first cell is ``corner``."""
        found = self._cells(place, step, tuple(made))
        if found is None:
            return
        side = SIDE // step
        left, low = place[0] * side - corner[0], place[1] * side - corner[1]
        rows, columns = next(iter(made.values())).shape
        up, across = slice(max(low, 0), min(low + side, rows)), slice(max(left, 0), min(left + side, columns))
        for name, values in made.items():
            part = found[name][up.start - low : up.stop - low, across.start - left : across.stop - left]
            values[up, across] = part

    def _cells(self, place: Place, step: int, names: tuple[str, ...]) -> Layers | None:
        if step < KEPT_FROM:
            needed = {*names, "points"} if "height_m" in names and step > 1 else set(names)
            tile = self.tile(place, needed)
            return None if tile is None else joined(tile.layers, step)
        kept = self._joined.get(place)
        now = self.generation, self._tiles[place]
        levels: dict[int, Layers] = {} if kept is None or kept[:2] != now else kept[2]
        known = levels.get(KEPT_FROM, {})
        missing = {name for name in names if name not in known}
        if missing:
            tile = self.tile(place, {*missing, "points"} if "height_m" in missing else missing)
            if tile is None:
                return _still_good(kept, now[0], step, names)
            made = joined(tile.layers, KEPT_FROM)
            for level in _LEVELS:
                made = made if level == KEPT_FROM else joined(made, 2)
                levels.setdefault(level, {}).update(made)
            self._joined[place] = *now, levels
            while len(self._joined) > self._kept:
                self._joined.popitem(last=False)
        self._joined.move_to_end(place)
        return levels[step]


def _still_good(
    kept: tuple[int, int, dict[int, Layers]] | None, generation: int, step: int, names: tuple[str, ...]
) -> Layers | None:
    """Return what was read of a tile before, while it cannot be read anew; None: nothing of this grid."""
    if kept is None or kept[0] != generation or not set(names) <= set(kept[2][step]):
        return None
    return kept[2][step]


@dataclass(frozen=True, slots=True)
class Placement:
    """Converts between the frame ``local`` and latitude and longitude, by the polynomials of the index.

    Attributes:
        lat_deg, lon_deg: the place that angles count from.
        east_m, north_m: the same place in the frame ``local``.
        to_geodetic: coefficients (2, 10) of latitude and longitude, degrees, for east and north in kilometres.
        to_local: coefficients (2, 10) of east and north, kilometres, for latitude and longitude in degrees.
    """

    lat_deg: float
    lon_deg: float
    east_m: float
    north_m: float
    to_geodetic: NDArray[np.float64]
    to_local: NDArray[np.float64]

    @classmethod
    def of(cls, index: Mapping[str, Any]) -> Placement | None:
        """Return the placement that an index gives; None: it gives none."""
        try:
            said = index["placement"]
            lat, lon = (float(value) for value in said["about_deg"])
            east, north = (float(value) for value in said["about_m"])
            both = [np.asarray(said[key], np.float64).reshape(2, len(POWERS)) for key in ("to_geodetic", "to_local")]
        except (KeyError, TypeError, ValueError):
            return None
        return cls(lat, lon, east, north, both[0], both[1])

    def geodetic(self, places: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return latitudes and longitudes (n, 2), degrees, of places (n, 2), east and north, metres."""
        away = (places - (self.east_m, self.north_m)) / 1000.0
        return np.asarray(_terms(away) @ self.to_geodetic.T + (self.lat_deg, self.lon_deg))

    def local(self, geodetic: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return places (n, 2), east and north, metres, of latitudes and longitudes (n, 2), degrees."""
        away = geodetic - (self.lat_deg, self.lon_deg)
        away[:, 1] = (away[:, 1] + 180.0) % 360.0 - 180.0
        return np.asarray(1000.0 * (_terms(away) @ self.to_local.T) + (self.east_m, self.north_m))


def fit_placement(
    about_deg: tuple[float, float],
    away_deg: NDArray[np.float64],
    about_m: NDArray[np.float64],
    places_m: NDArray[np.float64],
) -> dict[str, Any]:
    """Return polynomials of third degree through places, as the index has them.

    Args:
        about_deg: latitude and longitude that angles count from.
        away_deg: (n, 2) latitudes and longitudes from there.
        about_m: (2,) the same place in the frame ``local``.
        places_m: (n, 2) places in the frame.
    """
    away_km = (places_m - about_m) / 1000.0
    to_geodetic = np.linalg.lstsq(_terms(away_km), away_deg, rcond=None)[0].T
    to_local = np.linalg.lstsq(_terms(away_deg), away_km, rcond=None)[0].T
    misfit_m = 1000.0 * np.abs(_terms(away_deg) @ to_local.T - away_km).max()
    return {
        "about_deg": list(about_deg),
        "about_m": about_m.tolist(),
        "to_geodetic": to_geodetic.tolist(),
        "to_local": to_local.tolist(),
        "misfit_m": round(float(misfit_m), 4),
    }


def _terms(pairs: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.stack([pairs[:, 0] ** first * pairs[:, 1] ** second for first, second in POWERS], axis=-1)


def joined(layers: Layers, step: int) -> Layers:
    """Return layers (rows, columns) in cells ``step`` times as wide, a power of two that divides both.

    Numbers are sums; heights are means of the points; differences are means of the cells that have one; the lowest,
    highest, newest are that.
    """
    while step > 1:
        layers = {name: _halved(name, values, layers) for name, values in layers.items()}
        step //= 2
    return layers


def _halved(name: str, values: NDArray[Any], layers: Layers) -> NDArray[Any]:
    four = [values[up::2, across::2] for up in (0, 1) for across in (0, 1)]
    if name in SUMMED:
        return np.asarray(four[0] + four[1] + four[2] + four[3])
    if name == "height_m":
        points = layers["points"]
        weights = [points[up::2, across::2] for up in (0, 1) for across in (0, 1)]
        return _mean(four, weights)
    if name == "difference_m":
        return _mean(four, [np.isfinite(one) for one in four])
    smaller = np.fmin if name == "lowest_m" else np.fmax
    return np.asarray(smaller(smaller(four[0], four[1]), smaller(four[2], four[3])))


def _mean(values: list[NDArray[Any]], weights: list[NDArray[Any]]) -> NDArray[np.float32]:
    total = sum((one.astype(np.float64) for one in weights), np.zeros(values[0].shape))
    products = sum((np.nan_to_num(one) * weight for one, weight in zip(values, weights, strict=True)), 0.0 * total)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(products / total, np.float32)


def _empty(name: str, shape: tuple[int, int]) -> NDArray[Any]:
    if name.endswith("_m"):
        return np.full(shape, np.nan, np.float32)
    return np.zeros(shape, np.int64)


def _read(file: Any, stored: str) -> NDArray[Any]:
    file.seek(_PLACES[stored])
    return np.frombuffer(file.read(_SIZES[stored]), STORED[stored]).reshape(SIDE, SIDE)


def _layer(stored: NDArray[Any], name: str, head: Head) -> NDArray[Any]:
    """Return stored values as readers get them."""
    if name == "height_m":
        return stored
    if name in ("lowest_m", "highest_m"):
        return np.where(stored == NO_DIFFERENCE, np.nan, head.base_m + 0.01 * stored).astype(np.float32)
    if name == "difference_m":
        return np.where(stored == NO_DIFFERENCE, np.nan, 0.001 * stored).astype(np.float32)
    if name == "gps_s":
        return np.where(stored > 0, stored.astype(np.int64) + (head.first_gps_s - 1), 0)
    return stored.astype(np.int64)


def _json_of(path: Path) -> dict[str, Any]:
    with contextlib.suppress(OSError, ValueError):
        found = json.loads(path.read_bytes())
        if isinstance(found, dict):
            return found
    return {}


def _whole(value: Any) -> int:
    return value if isinstance(value, int) and value > 0 else 0


def _is_length(value: Any) -> bool:
    return isinstance(value, int | float) and math.isfinite(value) and value > 0.0


def _places(tiles: Any) -> Iterable[tuple[Place, int]]:
    for name, sequence in tiles.items() if isinstance(tiles, dict) else ():
        column, _, row = str(name).partition("_")
        with contextlib.suppress(ValueError):
            yield (int(column), int(row)), _whole(sequence)
