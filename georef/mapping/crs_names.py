"""Read the names of coordinate systems as people write them, and propose codes for names that PROJ does not know.

"EPSG: 25832", "25832" and "epsg:25832 + 7837" have one meaning and are understood. "UTM32" has several: the codes that
it may mean are proposed, those first that are used where the flight is.
"""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from pyproj.database import query_crs_info
from pyproj.enums import PJType

_CODES = re.compile(r"\s*(?:EPSG)?\s*:?\s*(\d{4,6})\s*(?:\+\s*(?:EPSG)?\s*:?\s*(\d{4,6})\s*)?", re.IGNORECASE)
_GAUSS_KRUGER = re.compile(r"\bgk\W*(?=\d)", re.IGNORECASE)
_UTM = re.compile(r"utm\W*(?:zone\W*)?(\d{1,2})(?!\d)\s*([a-z])?\b", re.IGNORECASE)
_TOKEN = re.compile(r"[a-z]+|\d+")
_IGNORED = frozenset({"zone", "epsg", "crs", "coordinate", "coordinates", "system", "height", "heights"})
_LETTERS = str.maketrans({"ä": "a", "ö": "o", "ü": "u", "ß": "ss", "é": "e", "è": "e"})
# Datums of the continents, one of which is wanted before WGS 84 wherever it is used.
_CONTINENTS = ("ETRS89", "NAD83(2011)", "GDA2020", "NZGD2000", "JGD2011", "SIRGAS 2000")
MOST = 3
LEAST_SCORE, NEARLY_AS_GOOD = 0.6, 0.15  # shares of a name's words

Place = tuple[float, float]  # latitude and longitude, degrees


@dataclass(frozen=True, slots=True)
class Proposal:
    """A CRS of EPSG's that a name may mean."""

    code: str
    name: str

    def __str__(self) -> str:
        return f"EPSG:{self.code} ({self.name})"


@dataclass(frozen=True, slots=True)
class _Known:
    code: str
    name: str
    tokens: tuple[str, ...]
    area: tuple[float, float, float, float] | None

    def is_used_at(self, place: Place | None) -> bool:
        if place is None or self.area is None:
            return False
        lat, lon = place
        west, south, east, north = self.area
        return south <= lat <= north and (lon - west) % 360.0 <= ((east - west) % 360.0 or 360.0)


def plain_code(text: str) -> str:
    """Return a code that is written with blanks, small letters or without its authority as PROJ reads it.

    Any other text is returned without blanks at its ends.
    """
    match = _CODES.fullmatch(text)
    if match is None:
        return text.strip()
    return f"EPSG:{match[1]}" + (f"+{match[2]}" if match[2] else "")


def proposals(text: str, place: Place | None = None) -> tuple[str, ...]:
    """Return codes, each with its name, that an unknown name of a CRS may mean; the likeliest first.

    Args:
        text: the name, such as "UTM32" or "ETRS89 / UTM 32N + DHHN2016".
        place: latitude and longitude of the flight, degrees; None: unknown.
    """
    head, _, tail = text.rpartition("+")
    heights = _proposed(tail, place, (PJType.VERTICAL_CRS,))[:1] if head else ()
    if not heights:
        return tuple(map(str, _proposed(text, place, (PJType.PROJECTED_CRS,))))
    flat = _proposed(head, place, (PJType.PROJECTED_CRS,))
    return tuple(f"EPSG:{one.code}+{heights[0].code} ({one.name} + {heights[0].name})" for one in flat)


def _proposed(text: str, place: Place | None, kinds: tuple[PJType, ...]) -> tuple[Proposal, ...]:
    known = _database(kinds)
    utm = _UTM.search(text)
    if utm is not None and PJType.PROJECTED_CRS in kinds:
        found = _of_zone(known, text.replace(utm[0], " "), int(utm[1]), (utm[2] or "").upper(), place)
    else:
        found = _by_name(known, _tokens(text), place)
    return tuple(Proposal(one.code, one.name) for one in found[:MOST])


def _of_zone(known: Sequence[_Known], rest: str, zone: int, letter: str, place: Place | None) -> list[_Known]:
    """Return the UTM zones of a number: on the datum that is named, or else on those that are used there."""
    south = letter == "S" or (letter != "" and letter < "N")
    if not letter and place is not None:
        south = place[0] < 0.0
    ending = f" / UTM zone {zone}{'S' if south else 'N'}"
    there = {one.name.removesuffix(ending): one for one in known if one.name.endswith(ending)}
    datum = "".join(_tokens(rest))
    named = [one for name, one in there.items() if datum and "".join(_tokens(name)) == datum]
    named += [one for name, one in there.items() if datum and "".join(_tokens(name)).startswith(datum)]
    if named:
        return list(dict.fromkeys(named))
    common = [there[name] for name in (*_CONTINENTS, "WGS 84") if name in there]
    if place is None:
        return [one for one in common if one.name.startswith("WGS")] + [
            one for one in common if not one.name.startswith("WGS")
        ]
    return [one for one in common if one.is_used_at(place) or one.name.startswith("WGS")]


def _by_name(known: Sequence[_Known], tokens: tuple[str, ...], place: Place | None) -> list[_Known]:
    """Return the CRS with the most words of a name, those used at the place first."""
    if not tokens:
        return []
    scored = []
    for one in known:
        score = _score(tokens, one.tokens)
        if score >= LEAST_SCORE:
            scored.append((-round(score, 3), not one.is_used_at(place), len(one.name), one.name, one))
    if place is not None and any(not elsewhere for _, elsewhere, *_ in scored):
        scored = [row for row in scored if not row[1]]
    least = min((row[0] for row in scored), default=0.0) + NEARLY_AS_GOOD
    scored = [row for row in scored if row[0] <= least]
    return [row[-1] for row in sorted(scored, key=lambda row: row[:4])]


def _score(wanted: Iterable[str], there: tuple[str, ...]) -> float:
    """Return the share of the wanted words that a name has, a little less for each word besides."""
    wanted = tuple(wanted)
    hits = sum(any(word == other or (len(word) > 3 and other.startswith(word)) for other in there) for word in wanted)
    return hits / len(wanted) - 0.02 * math.log1p(max(0, len(there) - hits))


def _tokens(text: str) -> tuple[str, ...]:
    """Return the words and numbers of a name: "ETRS89 / UTM zone 32N" is etrs, 89, utm, 32, n."""
    words = _TOKEN.findall(_GAUSS_KRUGER.sub("gauss kruger ", text).lower().translate(_LETTERS))
    return tuple(word for word in words if word not in _IGNORED)


@functools.lru_cache(maxsize=4)
def _database(kinds: tuple[PJType, ...]) -> tuple[_Known, ...]:
    """Return EPSG's CRS of some kinds; PROJ takes half a second to list them."""
    return tuple(
        _Known(
            info.code,
            info.name,
            _tokens(info.name),
            None if info.area_of_use is None else info.area_of_use.bounds,
        )
        for info in query_crs_info(auth_name="EPSG", pj_types=list(kinds))
    )
