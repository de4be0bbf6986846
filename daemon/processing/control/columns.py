"""Recognise columns of control files by the names that Trimble, Leica and other programs, or people, give them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

from swath.daemon.errors import ExitCode, UserError


class Role(Enum):
    """The meaning of a column; the value names it in `--control-columns` and in messages."""

    NAME = "name"
    EAST = "E"
    NORTH = "N"
    X = "X"  # east or north: of surveyors in some countries X points north
    Y = "Y"
    LAT = "lat"
    LON = "lon"
    HEIGHT = "H"
    ELLIPSOIDAL = "h_ellipsoidal"
    ORTHOMETRIC = "h_orthometric"
    SIGMA = "sigma"
    IGNORED = "-"


HEIGHTS = (Role.HEIGHT, Role.ELLIPSOIDAL, Role.ORTHOMETRIC)
PAIRS = ((Role.EAST, Role.NORTH), (Role.LON, Role.LAT), (Role.X, Role.Y))  # each as east, north
WANTED = "name, E, N, H, or name, lat, lon, h; sigma is optional"

_LETTERS = str.maketrans({"ä": "ae", "ö": "oe", "ü": "ue", "ß": "ss", "é": "e", "è": "e", "σ": "sigma"})
_WORD = re.compile(r"[a-z]+|\d+")
_FEET = re.compile(r"\b(?:ft|ftus|usft|feet|foot|sft|ift)\b")

_SIGMAS = frozenset(
    "sigma sigmas sd std stdev stddev dev cq precision prec accuracy acc error err rms rmse quality qualitaet "
    "genauigkeit standardabweichung mp se sn sh sx sy sz".split()
)
_INSTRUMENT = frozenset(
    "antenna antenne target ziel zielhoehe rod pole stab instrument instrumentenhoehe reflector reflektor prism "
    "prisma separation sep undulation offset ht hi geoidundulation geoidsep".split()
)
_HEIGHTS = frozenset("h height heights hgt elevation elev z hoehe hohe alt altitude level rl hoehen".split())
_ELLIPSOIDAL = frozenset("ellip ellipsoidal ellips ell ellipsoid ellipsoidische global hell".split())
_ORTHOMETRIC = frozenset(
    "ortho orthom orthometric orthometrische orthometrisch nhn nn nap msl normal normalhoehe gebrauchshoehe "
    "gebrauchshoehen geoid dhhn gravity meereshoehe".split()
)
_EAST = frozenset("e east easting eastings rechtswert rechts rw ost ostwert easternly est".split())
_NORTH = frozenset("n north northing northings hochwert hoch hw nord nordwert".split())
_LAT = frozenset("lat latitude breite phi".split())
_LON = frozenset("lon long longitude lng laenge lambda".split())
_NAME = frozenset(
    "name point points pointname pointid pointno pointnumber pt ptid ptno ptname id no nr num number nummer punkt "
    "punktnr punktnummer punktname punktid punktkennung pktnr pkt pn pnr station gcp gcpid label bezeichnung marker "
    "matricule".split()
)
_COMPOUNDS = (
    (re.compile(r"punkt(?:nummer|name|nr|id)|pkt(?:nr)?|point(?:id|name|no|number|nr)"), "point"),
    (re.compile(r"rechtswert|ostwert"), "east"),
    (re.compile(r"hochwert|nordwert"), "north"),
    (re.compile(r"ellipsoidhoehe|ellipsoidenhoehe"), "ellip height"),
    (re.compile(r"normalhoehe|meereshoehe|gebrauchshoehe"), "ortho height"),
)


@dataclass(frozen=True, slots=True)
class Column:
    """A column of a file: its place in a row, its label, its meaning, and whether its label names feet."""

    at: int
    label: str
    role: Role
    is_feet: bool = False


def column_of(at: int, label: str) -> Column:
    """Return the meaning of a column by its label."""
    text = label.lower().translate(_LETTERS)
    for pattern, word in _COMPOUNDS:
        text = pattern.sub(f" {word} ", text)
    words: list[str] = _WORD.findall(text.replace("_", " "))
    feet = bool(_FEET.search(" ".join(words)))
    words = [word for word in words if not _FEET.fullmatch(word)]
    while len(words) > 1 and words[-1] in ("m", "meter", "meters", "metre", "metres", "deg", "degrees", "us", "survey"):
        words.pop()
    return Column(at, label.strip(), _role(words), feet)


def _role(words: Sequence[str]) -> Role:
    """Return the meaning of a label's words; the first rule that fits decides."""
    there = set(words)
    if there & _SIGMAS:
        return Role.SIGMA
    if there & _INSTRUMENT:
        return Role.IGNORED
    first = words[0] if words else ""
    for role, named in ((Role.LAT, _LAT), (Role.LON, _LON)):
        if there & named:
            return role
    if there & _HEIGHTS and not there & {"x", "y"}:
        if there & _ELLIPSOIDAL:
            return Role.ELLIPSOIDAL
        return Role.ORTHOMETRIC if there & _ORTHOMETRIC else Role.HEIGHT
    for role, named in ((Role.EAST, _EAST), (Role.NORTH, _NORTH)):
        if there & named:
            return role
    if first in ("x", "y"):
        return Role.X if first == "x" else Role.Y
    if there & _NAME and not there & {"code", "class", "role", "type", "description"}:
        return Role.NAME
    return Role.IGNORED


def given_columns(text: str) -> tuple[Column, ...]:
    """Return the columns that `--control-columns` names, such as ``name,E,N,H,-,sigma``.

    Raises:
        UserError: a name has no meaning, or coordinates are missing.
    """
    columns = []
    for at, label in enumerate(re.split(r"[,;\s]\s*", text.strip())):
        column = column_of(at, label)
        if column.role is Role.IGNORED and label.lower() not in ("", "-", "code", "description"):
            raise UserError(
                f'--control-columns: got "{label}", want {", ".join(role.value for role in Role)}', ExitCode.USAGE
            )
        columns.append(column)
    if fault := fault_of(columns):
        raise UserError(f"--control-columns: {fault}", ExitCode.USAGE)
    return tuple(columns)


def pair_of(columns: Sequence[Column]) -> tuple[Column, Column] | None:
    """Return the columns of the plane coordinates, east before north; None if there are none."""
    first = {column.role: column for column in reversed(columns)}
    return next(((first[one], first[other]) for one, other in PAIRS if one in first and other in first), None)


def fault_of(columns: Sequence[Column]) -> str:
    """Return why points cannot be read from columns; empty if they can."""
    missing = "coordinates" if pair_of(columns) is None else ""
    if not missing and not any(column.role in HEIGHTS for column in columns):
        missing = "heights"
    if missing:
        labels = ", ".join(f'"{column.label}"' for column in columns[:8])
        return f"no column of {missing} among {labels}; name the columns {WANTED}"
    return ""
