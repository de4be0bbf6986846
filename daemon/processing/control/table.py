"""Hold the points of a control file as they stand there, and report its mistakes by line."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from swath.calib.control.points import ControlError
from swath.daemon.processing.control.columns import HEIGHTS, Column, Role, pair_of
from swath.georef.arrays import FloatArray

NATIVE = ("name", "lat_deg", "lon_deg", "h_ellipsoidal_m", "sigma_m")  # Swath's own columns
HEADER = ",".join(NATIVE)
MOST_MISTAKES = 10
LIMITS_DEG = {Role.LAT: 90.0, Role.LON: 360.0}
FARTHEST_MAP = 1e8  # largest easting or northing, in any unit
HIGHEST = 9000.0
SMALLEST_SIGMA_M, LARGEST_SIGMA_M = 1e-6, 10.0
_GROUPED = re.compile(r"[+-]?\d{1,3}(?:,\d{3})+\.\d+")
_DECIMAL = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
_ANGLE = re.compile(
    r"([NSEWO])?\s*([-+])?\s*(\d{1,3})\s*[°d:\s]\s*(\d{1,2})\s*['’′m:\s]\s*(\d{1,2}(?:\.\d*)?)\s*(?:\"|”|″|'')?"
    r"\s*([NSEWO])?",
    re.IGNORECASE,
)
_DEGREES = re.compile(r"([NSEW])?\s*([-+]?\d{1,3}(?:\.\d*)?)\s*°?\s*([NSEW])?", re.IGNORECASE)


@dataclass(frozen=True, eq=False)
class ControlTable:
    """The points of a file, in the file's own coordinates.

    Attributes:
        path: the file.
        names, where: of each point; `where` is its line or feature, for messages.
        plane: (n, 2) coordinates of the two columns that `pair` names.
        pair: columns of the plane coordinates, east before north as far as their names tell.
        is_named: True if the columns have names that tell east from north, or a format that does.
        heights: (n,) of each column of heights, by its role.
        labels: labels of the columns of heights.
        sigma_m: (n,) in the unit of the heights; nan: not given.
        crs: CRS that the file itself names; empty: none.
        is_native: True for Swath's own columns, whose meaning needs no note.
        feet: labels of columns whose names say feet.
        notes: what was assumed while reading, for people.
    """

    path: Path
    names: tuple[str, ...]
    where: tuple[str, ...]
    plane: FloatArray
    pair: tuple[Role, Role]
    is_named: bool
    heights: Mapping[Role, FloatArray]
    labels: Mapping[Role, str]
    sigma_m: FloatArray
    crs: str = ""
    is_native: bool = False
    feet: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def is_degrees(self) -> bool:
        """True if the plane coordinates are longitude and latitude."""
        return self.pair[1] is Role.LAT


class Mistakes:
    """Collects the mistakes of a file, a line each."""

    def __init__(self, path: Path) -> None:
        self._path, self.lines = path, list[str]()

    def add(self, where: str, text: str) -> None:
        """Note a mistake at a place of the file."""
        self.lines.append(f"{where}: {text}")

    def refuse(self) -> None:
        """Raise `ControlError` with the first mistakes if there are any."""
        if self.lines:
            raise error_of(self._path, self.lines)


def error_of(path: Path, lines: Sequence[str]) -> ControlError:
    """Return the error of a file with mistakes, at most `MOST_MISTAKES` lines."""
    return ControlError("\n".join(f"{path}: {line}" for line in lines[:MOST_MISTAKES]))


def number_of(text: str) -> float:
    """Return a number with a decimal point; apostrophes may group digits, and commas before a point; nan if none."""
    plain = text.strip().replace("'", "").replace("’", "")
    if _GROUPED.fullmatch(plain):
        plain = plain.replace(",", "")
    return float(plain) if _DECIMAL.fullmatch(plain) else math.nan


def degrees_of(text: str) -> float:
    """Return an angle in degrees: decimal, or degrees, minutes and seconds, with or without N, S, E, W; nan if none."""
    plain = text.strip()
    match = _ANGLE.fullmatch(plain)
    if match is not None:
        before, sign, degrees, minutes, seconds, after = match.groups()
        if float(minutes) >= 60.0 or float(seconds) >= 60.0:
            return math.nan
        value = float(degrees) + float(minutes) / 60.0 + float(seconds) / 3600.0
        return -value if (before or after or "").upper() in ("S", "W") or sign == "-" else value
    match = _DEGREES.fullmatch(plain)
    if match is None or not (match[1] or match[3] or "°" in plain):
        return number_of(plain)
    return -float(match[2]) if (match[1] or match[3] or "").upper() in ("S", "W") else float(match[2])


def plane_value(text: str, column: Column, where: str, mistakes: Mistakes) -> float:
    """Return a coordinate of the plane; note a mistake, and return nan, if it is none."""
    limit = LIMITS_DEG.get(column.role)
    value = number_of(text) if limit is None else degrees_of(text)
    if limit is None:
        if not abs(value) <= FARTHEST_MAP:
            mistakes.add(where, f'{column.label}: got "{text}", want a map coordinate, a number')
        return value
    if not abs(value) <= limit:
        hint = (
            "; are these map coordinates in metres? Then name the columns E and N, and give their CRS with "
            "--control-crs"
            if abs(value) > 1000.0
            else ""
        )
        mistakes.add(where, f'{column.label}: got "{text}", want degrees from {-limit:g} to {limit:g}{hint}')
    return value


def height_value(text: str, column: Column, where: str, mistakes: Mistakes) -> float:
    """Return a height; note a mistake, and return nan, if it is none."""
    value = number_of(text)
    if not abs(value) <= HIGHEST * (1.0 / 0.3048 if column.is_feet else 1.0):
        hint = "; are these feet?" if HIGHEST < value < 4.0 * HIGHEST else ""
        mistakes.add(where, f'{column.label}: got "{text}", want metres from {-HIGHEST:g} to {HIGHEST:g}{hint}')
    return value


def sigma_value(text: str, column: Column, where: str, mistakes: Mistakes) -> float:
    """Return a sigma, nan where none is given; note a mistake if it is none.

    A quality of zero, as programs give points that were entered by hand, counts as not given.
    """
    if not text.strip() and column.label != "sigma_m":
        return math.nan
    value = number_of(text)
    if value == 0.0 and "sigma" not in column.label.lower():
        return math.nan
    if not SMALLEST_SIGMA_M <= value <= LARGEST_SIGMA_M:
        mistakes.add(where, f'{column.label}: got "{text}", want metres above 0, at most {LARGEST_SIGMA_M:g}')
    return value


def largest(sigmas: Sequence[float]) -> float:
    """Return the largest of a point's sigmas; nan if it has none."""
    given = [one for one in sigmas if not math.isnan(one)]
    return max(given, default=math.nan)


def table_of(
    path: Path,
    columns: Sequence[Column],
    rows: Sequence[tuple[str, Sequence[str]]],
    *,
    is_named: bool,
    crs: str = "",
    notes: tuple[str, ...] = (),
) -> ControlTable:
    """Return the points of rows of texts.

    Args:
        path: the file.
        columns: columns with a meaning, those of coordinates and heights among them.
        rows: place and fields of each row.
        is_named, crs, notes: as of `ControlTable`.

    Raises:
        ControlError: rows have mistakes; a line for each. Where a file has several columns of heights, the code that
            chooses one reports its gaps.
    """
    mistakes = Mistakes(path)
    pair = pair_of(columns)
    assert pair is not None
    names_at = next((column.at for column in columns if column.role is Role.NAME), None)
    sigma_columns = [column for column in columns if column.role is Role.SIGMA]
    heights = {column.role: column for column in reversed(columns) if column.role in HEIGHTS}
    names, plane, sigmas = [], [], []
    above: dict[Role, list[float]] = {role: [] for role in heights}
    for number, (where, fields) in enumerate(rows, start=1):
        name = str(number) if names_at is None else fields[names_at].strip()
        if not name:
            mistakes.add(where, "the point has no name")
        names.append(name)
        plane.append([plane_value(fields[column.at], column, where, mistakes) for column in pair])
        for role, column in heights.items():
            only = Mistakes(path) if len(heights) > 1 else mistakes
            above[role].append(height_value(fields[column.at], column, where, only))
        sigmas.append(largest([sigma_value(fields[one.at], one, where, mistakes) for one in sigma_columns]))
    _note_twice(names, [where for where, _ in rows], mistakes)
    mistakes.refuse()
    return ControlTable(
        path=path,
        names=tuple(names),
        where=tuple(where for where, _ in rows),
        plane=np.array(plane, np.float64).reshape(-1, 2),
        pair=(pair[0].role, pair[1].role),
        is_named=is_named,
        heights={role: np.array(values) for role, values in above.items()},
        labels={role: column.label for role, column in heights.items()},
        sigma_m=np.array(sigmas, np.float64),
        crs=crs,
        is_native=tuple(column.label for column in columns) == NATIVE,
        feet=tuple(one.label for one in (*pair, *heights.values()) if one.is_feet),
        notes=notes,
    )


def _note_twice(names: Sequence[str], where: Sequence[str], mistakes: Mistakes) -> None:
    """Note names that occur twice: such a point would count twice."""
    first: dict[str, str] = {}
    for name, place in zip(names, where, strict=True):
        if name in first:
            mistakes.add(place, f"{name} already stands in {first[name]}; list each point once")
        elif name:
            first[name] = place
