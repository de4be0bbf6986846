"""Read RTKLIB .pos: antenna positions with sigmas, without attitude (RTKLIB manual 2.4.2, appendix B.1).

Comment lines begin with %; the last one names the time system (GPST, UTC, JST) and the columns. Time is a date and a
clock time, or week and seconds; positions are latitude, longitude and height, or ECEF.
"""

from __future__ import annotations

import re

import numpy as np

from swath.georef.arrays import ByteArray, FloatArray, Int64Array
from swath.georef.formats.text_times import clock_ns, gps_days, gps_ns_of_day, leap_seconds_on, weeks_ns
from swath.georef.formats.trajectory.columns import TrajectoryColumns, unsaid
from swath.georef.geodesy.earth import geodetic_from_e, rot_e_from_l
from swath.georef.records import FixType
from swath.georef.timescales.gps_time import DAY_NS, SECOND_NS
from swath.georef.trajectory.trajectory import TrajectoryError

TIME_SYSTEMS = ("GPST", "UTC", "JST")
HEADER = re.compile(rf"^%\s*({'|'.join(TIME_SYSTEMS)})\s+(\S.*)$", re.MULTILINE)
DMS = "(d'\")"
LARGEST = 1e9  # no position, speed or sigma is this large
GEODETIC, ECEF = ("latitude", "longitude", "height"), ("x-ecef", "y-ecef", "z-ecef")
# Column Q (manual, appendix B.1): 1 fix, 2 float, 3 SBAS, 4 DGPS, 5 single, 6 PPP
FIX_TYPES = {
    1: FixType.RTK_FIXED,
    2: FixType.RTK_FLOAT,
    3: FixType.DIFFERENTIAL,
    4: FixType.DIFFERENTIAL,
    5: FixType.SINGLE,
    6: FixType.PPP,
}


def is_rtklib_pos(text: str) -> bool:
    """Return whether a comment line names a time system and columns."""
    return text.lstrip("\ufeff \r\n").startswith("%") and HEADER.search(text) is not None


def read_rtklib_pos(text: str, name: str, *, leap_seconds: int | None = None) -> TrajectoryColumns:
    """Return rows of a .pos file; attitude is nan. ``leap_seconds``, GPS − UTC, is used for files in UTC."""
    *_, found = HEADER.finditer(text)
    system, titles = found[1], found[2].split()
    if re.search(r"height=\S*/geodetic", text[: found.start()]):
        raise TrajectoryError(f"{name}: its heights are above the geoid; export ellipsoidal heights")
    body = text[found.end() :]
    separator = next((mark for mark in ",;" if mark in body), None)
    rows = [line.replace(separator, " ").split() if separator else line.split() for line in body.splitlines()]
    first_line = text[: found.end()].count("\n") + 1
    numbered = [(number, row) for number, row in enumerate(rows, first_line) if row and not row[0].startswith("%")]
    if not numbered:
        raise TrajectoryError(f"{name}: has no positions")
    table = _columns(numbered, titles, name)
    days_or_weeks, clocks = [row[0] for _, row in numbered], [row[1] for _, row in numbered]
    time_ns = _gps_ns(system, days_or_weeks, clocks, name, leap_seconds)
    lat, lon, height, position_sigma_l, velocity_l = _solution(table, name)
    nothing = np.full(len(time_ns), np.nan)
    return TrajectoryColumns(
        *(time_ns, lat, lon, height, velocity_l),
        *(nothing, nothing, nothing),
        *(position_sigma_l, unsaid(len(time_ns))),
        "line",
        numbered[0][0],
        fix_type=fix_types(table.get("q"), FIX_TYPES),
        satellites=None if "ns" not in table else byte_counts(table["ns"]),
        velocity_sigma_l=_stacked(table, ("sdvn", "sdve", "sdvu")) if "sdvn" in table else None,
        position_correlation_l=_correlation_l(table, position_sigma_l),
    )


def _columns(numbered: list[tuple[int, list[str]]], titles: list[str], name: str) -> dict[str, FloatArray]:
    """Return columns by name without unit; degrees, minutes and seconds are converted to degrees."""
    widths = [3 if title.endswith(DMS) else 1 for title in titles]
    needed = 2 + sum(widths)
    for number, row in numbered:
        if len(row) != needed:
            raise TrajectoryError(f"{name}: line {number}: {needed} fields are expected, {len(row)} were found")
    try:
        values = np.array([row[2:] for _, row in numbered], dtype=np.float64).reshape(len(numbered), -1)
    except ValueError as error:
        raise TrajectoryError(f"{name}: {error}") from None
    large = (np.abs(values) > LARGEST).any(axis=1)  # nan: missing
    if large.any():
        raise TrajectoryError(f"{name}: line {numbered[int(np.argmax(large))][0]} has a number beyond {LARGEST:g}")
    table, begin = {}, 0
    for title, width in zip(titles, widths, strict=True):
        value = values[:, begin]
        if width == 3:
            value = degrees_of(values[:, begin : begin + 3])
        table[title.split("(")[0].lower()] = value
        begin += width
    return table


def degrees_of(dms: FloatArray) -> FloatArray:
    """Return (n,) degrees of degrees, minutes, seconds (n, 3); the sign is that of the degrees, also of −0."""
    size = np.abs(dms) @ np.array([1.0, 1.0 / 60.0, 1.0 / 3600.0])
    degrees: FloatArray = np.copysign(size, dms[:, 0])
    return degrees


def fix_types(quality: FloatArray | None, known: dict[int, FixType]) -> ByteArray | None:
    """Return (n,) `FixType` of a column of quality numbers: NONE for an unknown number; None without the column."""
    if quality is None:
        return None
    return np.array([known.get(int(q) if np.isfinite(q) else 0, FixType.NONE) for q in quality], dtype=np.uint8)


def byte_counts(said: FloatArray) -> ByteArray:
    """Return (n,) whole numbers from 0 to 255; missing ones become 0."""
    return np.clip(np.nan_to_num(said, nan=0.0), 0, 255).astype(np.uint8)


def _correlation_l(table: dict[str, FloatArray], sigma_l: FloatArray) -> FloatArray | None:
    """Return correlations (n, 3), north–east, north–down, east–down, from sdne, sdeu, sdun: signed covariance roots."""
    if not all(column in table for column in ("sdne", "sdeu", "sdun")):
        return None
    mixed = _stacked(table, ("sdne", "sdun", "sdeu")) * np.array([1.0, -1.0, -1.0])
    scale = sigma_l[:, [0, 0, 1]] * sigma_l[:, [1, 2, 2]]
    found: FloatArray = np.copysign(mixed**2, mixed) / np.where(scale > mixed**2, scale, np.inf)
    return np.where(np.isfinite(found), found, 0.0)


def _gps_ns(system: str, dates: list[str], clocks: list[str], name: str, leap_seconds: int | None) -> Int64Array:
    if system == "JST":
        raise TrajectoryError(f"{name}: its time is Japan Standard Time; export it in GPST")
    if "/" in dates[0]:
        gps_ns = gps_ns_of_day(gps_days(dates, "YMD", name), clock_ns(clocks, name))
    else:
        gps_ns = weeks_ns(dates, clocks, name)
    if system == "UTC":
        gps_ns = gps_ns + leap_seconds_on(int(gps_ns[0]) // DAY_NS, leap_seconds, name) * SECOND_NS
    return gps_ns


def _solution(
    table: dict[str, FloatArray], name: str
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return latitude, longitude (rad), height (m), sigmas and velocity (n, 3) in l."""
    if all(column in table for column in GEODETIC):
        lat, lon, height = (table[column] for column in GEODETIC)
        sigma = _stacked(table, ("sdn", "sde", "sdu"))
        velocity = _stacked(table, ("vn", "ve", "vu")) * np.array([1.0, 1.0, -1.0])
        return np.radians(lat), np.radians(lon), height, sigma, velocity
    if not all(column in table for column in ECEF):
        raise TrajectoryError(f"{name}: has neither latitude, longitude and height nor ECEF: {', '.join(table)}")
    lat, lon, height = geodetic_from_e(_stacked(table, ECEF))
    to_e = rot_e_from_l(lat, lon)
    sigma_x, sigma_y, sigma_z = _stacked(table, ("sdx", "sdy", "sdz")).T
    mixed = _stacked(table, ("sdxy", "sdyz", "sdzx"))
    xy, yz, zx = np.where(np.isfinite(mixed), np.copysign(mixed**2, mixed), 0.0).T
    rows = ((sigma_x**2, xy, zx), (xy, sigma_y**2, yz), (zx, yz, sigma_z**2))
    covariance_e = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    variance_l = np.einsum("nji,njk,nki->ni", to_e, covariance_e, to_e)
    velocity_l = np.einsum("nji,nj->ni", to_e, _stacked(table, ("vx", "vy", "vz")))
    return lat, lon, height, np.sqrt(np.maximum(variance_l, 0.0)), velocity_l


def _stacked(table: dict[str, FloatArray], columns: tuple[str, str, str]) -> FloatArray:
    nothing = np.full(len(next(iter(table.values()))), np.nan)
    return np.stack([table.get(column, nothing) for column in columns], axis=1)
