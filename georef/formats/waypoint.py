"""Read text of Waypoint's export profiles (Inertial Explorer, GrafNav): columns under a line of names and one of units.

    Week     GPSTime       Latitude      Longitude      H-Ell         Roll        Pitch      Heading
               (sec)     (+/-D M S)     (+/-D M S)        (m)        (deg)        (deg)        (deg)

Columns are separated by blanks, or by commas, semicolons or tabs; with separators other than commas, numbers may have
decimal commas.

Attitude is that of a body whose y axis points forward: roll, pitch and heading mean the same as here. Its yaw counts
the other way round (Inertial Explorer User Guide 8.50, 3.2.3) and is not taken for a heading. Time is GPS time by week
and second of the week, or by date; UTC needs the offset, which the header may give.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.formats.rtklib_pos import byte_counts, degrees_of, fix_types
from swath.georef.formats.text_times import clock_ns, gps_days, gps_ns_of_day, leap_seconds_on
from swath.georef.formats.trajectory.columns import Span, TrajectoryColumns, continuous_of_week, placed_in_week
from swath.georef.records import FixType
from swath.georef.timescales.gps_time import DAY_NS, SECOND_NS, WEEK_NS, WEEK_S
from swath.georef.trajectory.trajectory import TrajectoryError

# Names of columns in export profiles, in lower case and without marks, and the quantity behind each
NAMES = {
    **dict.fromkeys(("week", "gpsweek"), "week"),
    **dict.fromkeys(("gpstime", "corrtime", "gpssow", "gpstow", "sow", "tow", "gpstod", "time"), "time"),
    **dict.fromkeys(("utctime", "utctod", "utcsow"), "utc_time"),
    **dict.fromkeys(("date", "gpsdate"), "date"),
    **dict.fromkeys(("utcdate",), "utc_date"),
    **dict.fromkeys(("latitude", "lat"), "lat"),
    **dict.fromkeys(("longitude", "lon", "long"), "lon"),
    **dict.fromkeys(("hell", "ellheight", "ellipsoidalheight"), "height"),
    **dict.fromkeys(("hmsl", "horth", "hort", "orthheight"), "height_above_geoid"),
    **{f"v{name}": f"v_{name}" for name in ("north", "east", "up")},
    **dict.fromkeys(("roll",), "roll"),
    **dict.fromkeys(("pitch",), "pitch"),
    **dict.fromkeys(("heading", "azimuth"), "heading"),
    **dict.fromkeys(("sdnorth",), "sigma_n"),
    **dict.fromkeys(("sdeast",), "sigma_e"),
    **dict.fromkeys(("sdheight", "sdup", "sdhell"), "sigma_d"),
    **dict.fromkeys(("rollsd", "sdroll"), "sigma_roll"),
    **dict.fromkeys(("pitchsd", "sdpitch"), "sigma_pitch"),
    **dict.fromkeys(("headingsd", "hdngsd", "sdheading", "headsd"), "sigma_heading"),
    **dict.fromkeys(("sdvn", "sdvnorth", "vnsd"), "sigma_v_north"),
    **dict.fromkeys(("sdve", "sdveast", "vesd"), "sigma_v_east"),
    **dict.fromkeys(("sdvh", "sdvu", "sdvup", "vhsd"), "sigma_v_up"),
    **dict.fromkeys(("q", "quality"), "quality"),
    **dict.fromkeys(("ns", "numsv", "numsats"), "satellites"),
}
# Quality number of Waypoint's programs: 1 fixed integer, 2 converged float or noisy fixed, 3 and 4 converging float, 5
# differential code, 6 worse
FIX_TYPES = {
    1: FixType.RTK_FIXED,
    2: FixType.RTK_FLOAT,
    3: FixType.RTK_FLOAT,
    4: FixType.RTK_FLOAT,
    5: FixType.DIFFERENTIAL,
    6: FixType.SINGLE,
}
NEEDED = {"lat": "Latitude", "lon": "Longitude", "height": "H-Ell"}
TOKEN = re.compile(r"\([^)]*\)|\S+")
SEPARATORS = (";", "\t", ",")
UNIT = re.compile(r"\((sec|m|deg|rad|HMS|\+/-D M S|D M S)\)")
DECIMAL_COMMA = re.compile(r"(?<=[0-9]),(?=[0-9])")
UTC_OFFSET = re.compile(r"^[ \t]*UTC Offset:[ \t]*-?([0-9]{1,3})(?:\.0*)?[ \t]*s?[ \t]*$", re.MULTILINE | re.IGNORECASE)
SCALING = re.compile(r"^[ \t]*(Position|Attitude):[ \t]*([0-9]{1,6}(?:\.[0-9]{1,9})?)[ \t]*$", re.MULTILINE)
MOST_COLUMNS = 200  # maximum in an export; profiles have about 30
DATE_ORDERS = {"(MDY)": "MDY", "(YMD)": "YMD", "(DMY)": "DMY"}
RADIANS, METRES, METRES_PER_SECOND = {"(deg)": np.pi / 180, "(rad)": 1.0}, {"(m)": 1.0}, {"(m/s)": 1.0}


@dataclass(frozen=True, slots=True)
class Column:
    """One column: its unit as printed, and the words of a line that belong to it."""

    unit: str
    first: int
    words: int


@dataclass(slots=True)
class Sheet:
    """The parts of an export file.

    Attributes:
        header: the lines above the table.
        columns: by quantity.
        lines: of data.
        first_line: number of the first line of data.
        name: of the file.
    """

    header: str
    columns: dict[str, Column]
    lines: list[str]
    first_line: int
    name: str

    def words(self, what: str) -> list[str]:
        """Return (n,) words of a column, one per line."""
        at = self.columns[what].first
        return [line.split()[at] for line in self.lines]

    def numbers(self, what: str) -> FloatArray:
        """Return the numbers of a column, (n, words) or, of one word, (n,); nan where the column is missing."""
        column = self.columns.get(what)
        if column is None:
            return np.full(len(self.lines), np.nan)
        words = range(column.first, column.first + column.words)
        try:
            table = np.loadtxt(self.lines, dtype=np.float64, usecols=words, ndmin=2, comments=None)
        except ValueError as error:
            raise TrajectoryError(f"{self.name}: {error}, counted from line {self.first_line}") from None
        return table[:, 0] if column.words == 1 else table

    def quantity(self, what: str, units: dict[str, float]) -> FloatArray:
        """Return (n,) values of a column in SI units, given in one of ``units``; without one, in the first."""
        column = self.columns.get(what)
        unit = column.unit.lower() if column is not None and column.unit else next(iter(units))
        if unit not in units:
            title = what.replace("_", " ")
            raise TrajectoryError(f"{self.name}: its {title} is in {unit}; export it in {' or '.join(units)}")
        return self.numbers(what) * units[unit]

    def angle_rad(self, what: str) -> FloatArray:
        """Return (n,) radians of a column in degrees, in degrees, minutes and seconds, or in radians."""
        column = self.columns.get(what)
        if column is not None and column.words == 3:
            return np.radians(degrees_of(self.numbers(what)))
        return self.quantity(what, RADIANS)


def is_waypoint(text: str) -> bool:
    """Return whether the text has a line of known column names followed by a line of units."""
    return _title_line(text.splitlines()) is not None


def read_waypoint(
    text: str, name: str, *, span_ns: Span | None = None, week: int | None = None, leap_seconds: int | None = None
) -> TrajectoryColumns:
    """Return rows of an export; attitude is nan where it has none.

    Args:
        text: of the file.
        name: for messages.
        span_ns: GPS time of the log's first and last record, which gives the week of a file without one.
        week: takes precedence over span_ns.
        leap_seconds: GPS − UTC for times in UTC; the file's header takes precedence over it.
    """
    sheet = _sheet(text, name)
    if "height" not in sheet.columns and "height_above_geoid" in sheet.columns:
        raise TrajectoryError(f"{name}: its heights are above the geoid (H-MSL); export H-Ell")
    for what, title in NEEDED.items():
        if what not in sheet.columns:
            raise TrajectoryError(f"{name}: has no column {title}; export latitude, longitude and ellipsoidal height")
    angles = ("roll", "pitch", "heading")
    absent = [angle for angle in angles if angle not in sheet.columns]
    if 0 < len(absent) < len(angles):
        raise TrajectoryError(f"{name}: has no column {absent[0].title()}; export roll, pitch and heading")
    scale = {what.lower(): float(factor) for what, factor in SCALING.findall(sheet.header)}
    if 0.0 in scale.values():
        raise TrajectoryError(f"{name}: its header scales sigmas by 0; export them at 1 sigma")
    up = np.array([1.0, 1.0, -1.0])
    sigmas = [sheet.quantity(f"sigma_{axis}", METRES) / scale.get("position", 1.0) for axis in "ned"]
    angle_sigmas = [sheet.angle_rad(f"sigma_{angle}") / scale.get("attitude", 1.0) for angle in angles]
    return TrajectoryColumns(
        _gps_ns(sheet, span_ns, week, leap_seconds),
        *(sheet.angle_rad("lat"), sheet.angle_rad("lon"), sheet.quantity("height", METRES)),
        np.stack([sheet.quantity(f"v_{axis}", METRES_PER_SECOND) for axis in ("north", "east", "up")], axis=1) * up,
        *(sheet.angle_rad("roll"), sheet.angle_rad("pitch"), sheet.angle_rad("heading")),
        *(np.stack(sigmas, axis=1), np.stack(angle_sigmas, axis=1)),
        "line",
        sheet.first_line,
        fix_type=fix_types(sheet.numbers("quality") if "quality" in sheet.columns else None, FIX_TYPES),
        satellites=byte_counts(sheet.numbers("satellites")) if "satellites" in sheet.columns else None,
        velocity_sigma_l=np.stack(
            [sheet.quantity(f"sigma_v_{axis}", METRES_PER_SECOND) for axis in ("north", "east", "up")], axis=1
        )
        if "sigma_v_north" in sheet.columns
        else None,
    )


# --- the table ---


def _title_line(lines: list[str]) -> int | None:
    """Return the number of the line of names: it has those of a position, and units below; None without such a line."""
    for number, (line, below) in enumerate(pairwise(lines)):
        known = {NAMES.get(_plain(cell)) for cell in _cells(line, _separator(line))}
        if {"lat", "lon"} <= known and UNIT.search(below):
            return number
    return None


def _separator(titles: str) -> str | None:
    """Return the separator between the names of columns; None for blanks."""
    return next((mark for mark in SEPARATORS if titles.count(mark) > 1), None)


def _cells(line: str, separator: str | None) -> list[str]:
    """Return the cells of a line, without quotes."""
    if separator is None:
        return line.split()
    return [cell.strip().strip('"').strip() for cell in line.split(separator)]


def _names(titles: str, separator: str | None) -> list[str]:
    """Return the names of columns; a trailing separator does not begin another one."""
    cells = _cells(titles, separator)
    return cells[:-1] if cells and not cells[-1] else cells


def _blank_separated(lines: list[str], separator: str | None, columns: int) -> list[str]:
    """Return lines of data with blanks between columns and decimal points; an empty cell becomes ``nan``."""
    if separator is None:
        text = " ".join(lines)
        return [DECIMAL_COMMA.sub(".", line) for line in lines] if "," in text and "." not in text else lines
    made = []
    for line in lines:
        cells = _cells(line, separator) if line.strip() else []
        if len(cells) == columns + 1 and not cells[-1]:  # a trailing separator
            cells.pop()
        joined = " ".join(cell or "nan" for cell in cells)
        made.append(joined if separator == "," else DECIMAL_COMMA.sub(".", joined))
    return made


def _plain(title: str) -> str:
    return re.sub(r"[^a-z]", "", title.lower())


def _sheet(text: str, name: str) -> Sheet:
    lines = text.lstrip("\ufeff").splitlines()
    at = _title_line(lines)
    if at is None:
        raise TrajectoryError(f"{name}: no line of column names (Latitude, Longitude, …) with their units below it")
    separator = _separator(lines[at])
    if len(_names(lines[at], separator)) > MOST_COLUMNS:
        raise TrajectoryError(
            f"{name}: line {at + 1} names more than {MOST_COLUMNS} columns; export those of a trajectory"
        )
    columns, words = _layout(lines[at], lines[at + 1], separator)
    below = _blank_separated(lines[at + 2 :], separator, len(_names(lines[at], separator)))
    counts = [len(line.split()) for line in below]
    rows = [number for number, count in enumerate(counts) if count == words]
    if not rows:
        most = max(counts, default=0)
        if separator == "," and words < most <= 2 * words:
            raise TrajectoryError(
                f"{name}: line {at + 3 + counts.index(most)} has {most} cells for {words} columns: decimal commas "
                "cannot be distinguished from commas between columns; export it with decimal points, or with "
                "semicolons or blanks between columns"
            )
        raise TrajectoryError(f"{name}: no line with {words} words, the number of its columns, follows line {at + 2}")
    for number in range(rows[0], rows[-1]):  # a header and a footer are allowed, but not a gap between lines of data
        if counts[number] != words:
            what = f"{words} words are expected, {counts[number]} were found"
            raise TrajectoryError(f"{name}: line {number + at + 3}: {what}")
    data = below[rows[0] : rows[-1] + 1]
    return Sheet("\n".join(lines[:at]), columns, data, at + 3 + rows[0], name)


def _layout(titles: str, units: str, separator: str | None) -> tuple[dict[str, Column], int]:
    """Return columns, and the number of words in a line. A unit belongs to the name above it, or in the same cell."""
    if separator is None:
        tokens, below = list(TOKEN.finditer(titles)), list(TOKEN.finditer(units))
        names, unit_of = [token[0] for token in tokens], _unit_of(tokens, below[: len(tokens)])
    else:
        names, unit_of = _names(titles, separator), dict(enumerate(_cells(units, separator)))
    columns: dict[str, Column] = {}
    first = 0
    for i, title in enumerate(names):
        unit = unit_of.get(i, "")
        words = 3 if re.search(r"D M S", unit) else 1
        columns.setdefault(NAMES.get(_plain(title), title), Column(unit, first, words))
        first += words
    return columns, first


def _unit_of(names: list[re.Match[str]], units: list[re.Match[str]]) -> dict[int, str]:
    """Return units by number of the name above: in order, one per name, with the least total distance between them."""
    # least total distance for the first j units below the first i names
    cost = np.full((len(units) + 1, len(names) + 1), np.inf)
    cost[0] = 0.0
    for j, unit in enumerate(units):
        for i in range(j, len(names)):
            apart = abs(sum(names[i].span()) - sum(unit.span()))
            cost[j + 1, i + 1] = min(cost[j + 1, i], cost[j, i] + apart)
    found: dict[int, str] = {}
    i = len(names)
    for j in reversed(range(len(units))):
        while cost[j + 1, i - 1] == cost[j + 1, i]:
            i -= 1
        i -= 1
        found[i] = units[j][0]
    return found


# --- time ---


def _gps_ns(sheet: Sheet, span_ns: Span | None, week: int | None, leap_seconds: int | None) -> Int64Array:
    name, columns = sheet.name, sheet.columns
    utc = "time" not in columns
    time = "utc_time" if utc else "time"
    if time not in columns:
        raise TrajectoryError(f"{name}: has no column of time; export GPSTime and Week")
    date = next((what for what in (("utc_date", "date") if utc else ("date",)) if what in columns), None)
    offset = UTC_OFFSET.search(sheet.header)
    leap = int(offset[1]) if offset else leap_seconds
    clock = columns[time].unit.upper() == "(HMS)"
    if utc and date is None and leap is None:
        raise TrajectoryError(f"{name}: its time is UTC, of unknown leap seconds; export GPSTime and Week")
    days = None if date is None else gps_days(sheet.words(date), _date_order(columns[date].unit), name)
    if clock:
        if days is None:
            raise TrajectoryError(f"{name}: a time of day without a date; export GPSTime and Week")
        gps_ns = gps_ns_of_day(days, clock_ns(sheet.words(time), name))
    else:
        if utc and leap is not None and span_ns is not None:
            span_ns = span_ns[0] - leap * SECOND_NS, span_ns[1] - leap * SECOND_NS
        gps_ns = _of_seconds(sheet, time, days, span_ns, week)
    if not utc:
        return gps_ns
    return gps_ns + leap_seconds_on(int(gps_ns[0]) // DAY_NS, leap, name) * SECOND_NS


def _of_seconds(sheet: Sheet, time: str, days: Int64Array | None, span_ns: Span | None, week: int | None) -> Int64Array:
    """Return GPS time (n,) of seconds of the week, or of the day where a date shows that they are."""
    seconds = sheet.numbers(time)
    if not ((seconds >= 0.0) & (seconds < 10.0 * WEEK_S)).all():
        raise TrajectoryError(f"{sheet.name}: a time is not a number of seconds of the week")
    if "week" in sheet.columns and week is None:
        week_numbers = sheet.numbers("week")
        if not ((week_numbers >= 0.0) & (week_numbers < 10_000.0)).all():
            raise TrajectoryError(f"{sheet.name}: a week is not a GPS week; whole numbers up to 9999 are expected")
        weeks = np.rint(week_numbers).astype(np.int64)
        gps_ns: Int64Array = weeks * WEEK_NS + np.rint(seconds * SECOND_NS).astype(np.int64)
        return gps_ns
    if days is not None:
        if seconds[0] // 86_400 == days[0] % 7:
            since_ns = continuous_of_week(seconds, sheet.name, "line", sheet.first_line)
            return placed_in_week(since_ns, sheet.name, None, int(days[0]) // 7)
        if seconds.max() < 86_401:
            return gps_ns_of_day(days, np.rint(seconds * SECOND_NS).astype(np.int64))
        raise TrajectoryError(f"{sheet.name}: its dates and its seconds of the week are of different days")
    of_week_ns = continuous_of_week(seconds, sheet.name, "line", sheet.first_line)
    return placed_in_week(of_week_ns, sheet.name, span_ns, week)


def _date_order(unit: str) -> str:
    return DATE_ORDERS.get(unit.upper(), "MDY")
