"""Read tie points that a user picked in the points of several strips, by hand or with another program."""

from __future__ import annotations

import csv
import io
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from swath.calib.features import Features, Sighting, TiePoint
from swath.calib.flight import Flight, Swath
from swath.georef.arrays import FloatArray

HEADER = ("name", "strip", "x", "y", "z", "sigma_m")
FARTHEST = 1e9  # in any unit of a map
SMALLEST_SIGMA_M, LARGEST_SIGMA_M = 1e-6, 10.0
CHUNK = 1_000_000


class PickedError(ValueError):
    """A file of picked points that cannot be used; the message is one line for the user."""


@dataclass(frozen=True, eq=False)
class Picked:
    """A point as it was picked in one strip.

    Attributes:
        name: of the point, the same in every strip.
        strip: number of the strip, or the swath's name.
        place: (3,) in the file's coordinates; in those of t for `picked_ties`.
        sigma_m: of each coordinate.
        where: file and line, for messages.
    """

    name: str
    strip: str
    place: FloatArray
    sigma_m: float
    where: str


@dataclass(frozen=True, slots=True)
class PickedSettings:
    """Limits for picked points.

    Attributes:
        nearest_m: greatest distance to the nearest return of the strip.
        apart_m: greatest distance of sightings of one point from their median, before a calibration.
    """

    nearest_m: float = 3.0
    apart_m: float = 50.0


_DEFAULT = PickedSettings()


def read_picked(text: str, name: str) -> tuple[Picked, ...]:
    """Read a CSV with the columns name, strip, x, y, z, sigma_m; coordinates are in the flight's CRS.

    Args:
        text: of the file.
        name: of the file, for messages.

    Raises:
        PickedError: it is not such a file; with the line and the remedy.
    """
    reader = csv.reader(io.StringIO(text))
    try:
        rows = [(reader.line_num, cells) for cells in reader]
    except csv.Error as error:
        raise PickedError(f"{name}: line {reader.line_num}: not CSV: {error}") from None
    header = [cell.strip() for cell in rows[0][1]] if rows else []
    if sorted(header) != sorted(HEADER):
        got = " ".join(", ".join(header).split()) or "nothing"
        raise PickedError(f"{name}: line 1: has {got}; the columns must be {', '.join(HEADER)}")
    picked = [
        _row(dict(zip(header, cells, strict=False)), f"{name}: line {number}")
        for number, cells in rows[1:]
        if any(cell.strip() for cell in cells) and not cells[0].lstrip().startswith("#")
    ]
    if not picked:
        raise PickedError(f"{name}: has no points; give at least one point that two strips see")
    return tuple(picked)


def _row(cells: dict[str, str], where: str) -> Picked:
    values = {}
    for key in HEADER:
        cell = cells.get(key, "").strip()
        if not cell:
            raise PickedError(f"{where}: {key} is missing; each line needs {', '.join(HEADER)}")
        values[key] = cell
    numbers = []
    for key in HEADER[2:]:
        try:
            number = float(values[key])
        except ValueError:
            number = math.nan
        if not abs(number) <= FARTHEST:
            raise PickedError(f"{where}: {key}: got {values[key]!r}, want a number of at most {FARTHEST:g}")
        numbers.append(number)
    if not SMALLEST_SIGMA_M <= numbers[3] <= LARGEST_SIGMA_M:
        raise PickedError(f"{where}: sigma_m: got {numbers[3]:g}, want more than 0, at most {LARGEST_SIGMA_M:g}")
    return Picked(values["name"], values["strip"], np.array(numbers[:3]), numbers[3], where)


def picked_ties(flight: Flight, picked: Sequence[Picked], settings: PickedSettings = _DEFAULT) -> Features:
    """Build tie points of picked points whose places are in t; refused points are counted by reason.

    Raises:
        PickedError: the flight does not have the strip, or several scanners have it.
    """
    refused: Counter[str] = Counter()
    named: dict[str, dict[int, Sighting]] = {}
    for one in picked:
        index = _swath(flight, one)
        at, away_m = _nearest(flight.swaths[index], one.place, settings.nearest_m)
        if not away_m <= settings.nearest_m:
            refused["picked: the strip has no return near it"] += 1
        elif index in named.setdefault(one.name, {}):
            refused["picked: given twice in one strip"] += 1
        else:
            named[one.name][index] = Sighting(index, at, one.place, one.sigma_m**2 * np.eye(3))
    ties = []
    for name, sightings in named.items():
        seen = [sightings[index] for index in sorted(sightings)]
        places = np.array([one.point_t for one in seen]).reshape(-1, 3)
        near = np.linalg.norm(places - np.median(places, axis=0), axis=1) <= settings.apart_m if len(seen) else []
        kept = tuple(one for one, good in zip(seen, near, strict=True) if good)
        refused["picked: far from its places in other strips"] += len(seen) - len(kept)
        if len(kept) > 1:
            ties.append(TiePoint(name, kept, kind="picked"))
        else:
            refused["picked: given in one strip only"] += 1
    return Features(ties=tuple(ties), refused=+refused)


def carried(picked: Features, picked_in: Flight, flight: Flight) -> Features:
    """Move picked tie points with their returns to where another calibration places them.

    An adjustment expects measured points among the flight's points, but a user picks in files of another calibration.
    """

    def seen(one: Sighting) -> Sighting:
        moved_t = flight.swaths[one.swath].points_t[one.at] - picked_in.swaths[one.swath].points_t[one.at]
        return replace(one, point_t=one.point_t + moved_t)

    ties = tuple(replace(tie, sightings=tuple(map(seen, tie.sightings))) for tie in picked.ties)
    return replace(picked, ties=ties)


def _swath(flight: Flight, one: Picked) -> int:
    names = [swath.name for swath in flight.swaths]
    if one.strip in names:
        return names.index(one.strip)
    numbered = [index for index, swath in enumerate(flight.swaths) if str(swath.strip) == one.strip.lstrip("0")]
    if len(numbered) == 1:
        return numbered[0]
    got = "is not a strip of the flight" if not numbered else "was scanned by several scanners"
    choice = ", ".join(names if not numbered else [names[index] for index in numbered])
    raise PickedError(f"{one.where}: strip {one.strip} {got}; use one of {choice}")


def _nearest(swath: Swath, place_t: FloatArray, within_m: float) -> tuple[int, float]:
    """Return the nearest return to a place, and its distance; inf if there is none within reach."""
    best, least = -1, math.inf
    for begin in range(0, len(swath), CHUNK):
        off = np.asarray(swath.points_t[begin : begin + CHUNK]) - place_t
        near = np.flatnonzero((np.abs(off) <= within_m).all(axis=1))
        if len(near):
            away = np.linalg.norm(off[near], axis=1)
            if away.min() < least:
                best, least = begin + int(near[np.argmin(away)]), float(away.min())
    return best, least
