"""Knows the columns of tables of records: what a name means, in which unit, and which other names would be right.

A name is a quantity and its unit: ``gyro_x_deg_s``, also written ``Gyro X [deg/s]``. The names that `swath export
--records` writes are among them.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

from swath.drivers.record_frames import RowKind
from swath.drivers.transports.base import TransportError

SUFFIXES = (".csv", ".parquet", ".csv.gz")
STANDARD_GRAVITY = 9.80665  # m/s², CGPM 1901
KNOT = 1852.0 / 3600.0

UNITS: dict[str, dict[str, float]] = {  # by dimension: what a column's name ends in, the exported unit first
    "angle": {"rad": 1.0, "deg": math.pi / 180.0, "mrad": 1e-3},
    "length": {"m": 1.0, "cm": 0.01, "mm": 0.001, "km": 1000.0},
    "speed": {
        **dict.fromkeys(("mps", "m_s", "m_per_s"), 1.0),
        **dict.fromkeys(("kmh", "km_h"), 1.0 / 3.6),
        **dict.fromkeys(("kn", "kt", "knots"), KNOT),
    },
    "acceleration": {
        **dict.fromkeys(("mps2", "m_s2", "m_per_s2"), 1.0),
        "g": STANDARD_GRAVITY,
        "mg": STANDARD_GRAVITY / 1000.0,
    },
    "rate": {
        **dict.fromkeys(("radps", "rad_s", "rad_per_s"), 1.0),
        **dict.fromkeys(("degps", "deg_s", "deg_per_s", "dps"), math.pi / 180.0),
        "deg_h": math.pi / 180.0 / 3600.0,
    },
    "variance": {"m2": 1.0, "cm2": 1e-4},
    "variance of speed": {**dict.fromkeys(("m2ps2", "m2_s2"), 1.0)},
    "temperature": {"c": 1.0, "degc": 1.0},
    "duration": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    "width": {"ns": 1.0, "ps": 1e-3},
    "time": {"ns": 1.0, "us": 1e3, "ms": 1e6, "s": 1e9},
    "none": {"": 1.0},
}
_ANY_UNIT = {unit for units in UNITS.values() for unit in units}


def is_table(path: Path) -> bool:
    """Return whether a file is named as a table."""
    return path.name.lower().endswith(SUFFIXES)


class TableError(TransportError):
    """A table whose columns cannot be read; the text is one line that names the columns that would be right."""


@dataclass(frozen=True, slots=True)
class Quantity:
    """One quantity of a row.

    Attributes:
        name: of the field of the row; ``velocity_l/0`` is part 0 of a vector.
        dimension: of `UNITS`.
        bases: names without the unit, the exported one first.
        sign: −1: the column counts the other way.
        text: its cells are words.
    """

    name: str
    dimension: str
    bases: tuple[str, ...]
    sign: float = 1.0
    text: bool = False

    def names(self) -> Iterator[str]:
        """Yield the names that a column of it may have."""
        for base in self.bases:
            for unit in UNITS[self.dimension]:
                yield f"{base}_{unit}" if unit else base


def _each(name: str, dimension: str, parts: Iterable[str], *patterns: str) -> list[Quantity]:
    """Return the quantities of a vector; ``{}`` in a pattern is the part's name."""
    return [
        Quantity(f"{name}/{number}", dimension, tuple(pattern.format(part) for pattern in patterns))
        for number, part in enumerate(parts)
    ]


_PLACE = [
    Quantity("lat_rad", "angle", ("lat", "latitude")),
    Quantity("lon_rad", "angle", ("lon", "longitude", "lng")),
    Quantity("height_m", "length", ("height", "ellipsoidal_height", "height_ellipsoid", "hae")),
    Quantity("msl_m", "length", ("height_msl", "altitude_msl", "msl", "orthometric_height")),
    Quantity("undulation_m", "length", ("undulation", "geoid_separation", "geoid_height")),
]
_VELOCITY = [
    *_each(
        "velocity_l", "speed", ("north", "east", "down"), "velocity_{}", "vel_{}", "v_{}", "v{0[0]}", "velocity_{0[0]}"
    ),
    Quantity("velocity_l/2", "speed", ("velocity_up", "vel_up", "v_up", "vu", "climb"), sign=-1.0),
]
_COVARIANCES = ("nn", "ne", "nd", "ee", "ed", "dd")
_SIGMAS = [
    *_each("position_sigma_l", "length", ("north", "east", "down"), "sigma_{}", "{}_sigma", "sigma_{0[0]}", "sd_{}"),
    Quantity("position_sigma_l/2", "length", ("sigma_up", "sigma_height", "height_sigma", "sd_up", "sd_height")),
    *_each("velocity_sigma_l", "speed", ("north", "east", "down"), "sigma_velocity_{}", "velocity_{}_sigma"),
    Quantity("velocity_sigma_l/2", "speed", ("sigma_velocity_up", "velocity_up_sigma")),
]
_MESSAGE = Quantity("message", "none", ("message",), text=True)
_VALID = Quantity("valid", "none", ("valid",))
_STATUS = Quantity("status", "none", ("status",))
_HEADING = Quantity("heading_rad", "angle", ("heading", "true_heading"))
_SIGMA = Quantity("time_sigma_s", "duration", ("time_sigma", "sigma_time"))
_PITCH = Quantity("pitch_rad", "angle", ("pitch",))

QUANTITIES: dict[RowKind, list[Quantity]] = {
    RowKind.SAMPLE: [
        *_each(
            "specific_force_b",
            "acceleration",
            "xyz",
            *("specific_force_{}", "accel_{}", "acc_{}", "acceleration_{}", "linear_acceleration_{}", "a{}"),
        ),
        *_each(
            "angular_rate_b",
            "rate",
            "xyz",
            *("angular_rate_{}", "gyro_{}", "gyr_{}", "angular_velocity_{}", "rate_{}", "omega_{}", "w{}"),
        ),
        Quantity("temperature_c", "temperature", ("temperature", "temp")),
        Quantity("pps_time_ns", "time", ("pps_time",)),
        _STATUS,
        _SIGMA,
    ],
    RowKind.FIX: [
        *_PLACE,
        *_VELOCITY,
        *_each("position_cov_l", "variance", _COVARIANCES, "cov_{}"),
        *_each("velocity_cov_l", "variance of speed", _COVARIANCES, "cov_velocity_{}"),
        *_SIGMAS,
        Quantity("fix_type", "none", ("fix_type",), text=True),
        Quantity("satellites", "none", ("satellites", "num_sats", "num_satellites")),
        _VALID,
        Quantity("antenna", "none", ("antenna",), text=True),
        _MESSAGE,
        _SIGMA,
    ],
    RowKind.SOLUTION: [
        *_PLACE,
        *_VELOCITY,
        Quantity("roll_rad", "angle", ("roll",)),
        _PITCH,
        _HEADING,
        *_SIGMAS,
        *_each("attitude_sigma_rad", "angle", ("roll", "pitch", "heading"), "sigma_{}", "{}_sigma", "sd_{}"),
        _STATUS,
        _VALID,
    ],
    RowKind.HEADING: [
        _HEADING,
        _PITCH,
        Quantity("baseline_m", "length", ("baseline",)),
        Quantity("heading_sigma_rad", "angle", ("heading_sigma", "sigma_heading")),
        Quantity("pitch_sigma_rad", "angle", ("pitch_sigma", "sigma_pitch")),
        _VALID,
        _MESSAGE,
        _SIGMA,
    ],
    RowKind.TIME: [
        Quantity("edge", "none", ("edge",), text=True),
        Quantity("bound", "none", ("bound",)),
        _VALID,
        Quantity("leap_seconds", "none", ("leap_seconds",)),
        _MESSAGE,
        _SIGMA,
    ],
    RowKind.MARK: [
        Quantity("channel", "none", ("channel",), text=True),
        Quantity("rising", "none", ("rising",)),
        Quantity("count", "none", ("count",)),
        _VALID,
        _MESSAGE,
        _SIGMA,
    ],
    RowKind.RETURN: [
        Quantity("range_m", "length", ("range",)),
        Quantity("encoder_rad", "angle", ("encoder", "azimuth")),
        Quantity("elevation_rad", "angle", ("elevation",)),
        Quantity("pulse_width_ns", "width", ("pulse_width",)),
        *(
            Quantity(name, "none", (name,))
            for name in (
                *("pulse_id", "intensity", "channel", "return_number", "number_of_returns", "mta_zone", "flags"),
            )
        ),
    ],
    RowKind.POINT: [
        *(Quantity(f"{axis}_m", "length", (axis,)) for axis in "xyz"),
        *(
            Quantity(name, "none", (name,))
            for name in ("intensity", "channel", "return_number", "number_of_returns", "flags")
        ),
    ],
}
TIMES = [  # of a row; the first that is there counts
    Quantity("gps", "time", ("gps", "gps_time", "time_gps")),
    Quantity("tow", "time", ("tow", "gps_tow", "time_of_week", "sow", "gps_sow")),
    Quantity("unix", "time", ("unix", "unix_time", "posix", "time_unix")),
    Quantity("utc", "none", ("utc", "utc_time", "time_utc"), text=True),
    Quantity("counter", "time", ("device_time", "counter")),
]
WEEK = Quantity("week", "none", ("gps_week", "week"))
ARRIVAL = Quantity("host", "time", ("host_time",))
WANTED_TIME = "gps_ns, gps_s, gps_week with tow_s, unix_ns, unix_s or utc (2026-06-15T09:00:05.25Z)"

_VECTOR = ("0", "1", "2")
REQUIRED: dict[RowKind, tuple[tuple[str, ...], ...]] = {  # each: one of these sets of quantities
    RowKind.SAMPLE: (tuple(f"{name}/{part}" for name in ("specific_force_b", "angular_rate_b") for part in _VECTOR),),
    RowKind.FIX: (
        ("lat_rad", "lon_rad", "height_m"),
        ("lat_rad", "lon_rad", "msl_m", "undulation_m"),
        ("velocity_l/0", "velocity_l/1", "velocity_l/2"),
    ),
    RowKind.SOLUTION: (
        ("lat_rad", "lon_rad", "height_m", "roll_rad", "pitch_rad", "heading_rad"),
        ("lat_rad", "lon_rad", "msl_m", "undulation_m", "roll_rad", "pitch_rad", "heading_rad"),
    ),
    RowKind.HEADING: (("heading_rad",),),
    RowKind.TIME: (("edge",),),
    RowKind.MARK: (("channel", "rising"),),
    RowKind.RETURN: (("range_m", "encoder_rad", "elevation_rad"),),
    RowKind.POINT: (("x_m", "y_m", "z_m"),),
}
KINDS_OF: dict[str, tuple[RowKind, ...]] = {  # the kinds of rows of a device, a kind of `swath.drivers.parser`
    "gnss": (RowKind.FIX, RowKind.HEADING, RowKind.TIME, RowKind.MARK),
    "imu": (RowKind.SAMPLE, RowKind.SOLUTION),
    "scanner": (RowKind.RETURN, RowKind.POINT),
}
_ALTITUDE = "does not say what it counts from; want height_m (above the ellipsoid), or height_msl_m with undulation_m"
_UNCLEAR = {  # names that many tables have, and that do not say what they mean
    "altitude": _ALTITUDE,
    "alt": _ALTITUDE,
    "yaw": "does not say where it counts from; want heading_deg, from true north to east",
    "timestamp": f"does not say its scale; want {WANTED_TIME}",
    "time": f"does not say its scale; want {WANTED_TIME}",
}


def normal(name: str) -> str:
    """Return a column's name in small letters, digits and underscores: ``Accel X [m/s²]`` as ``accel_x_m_s2``."""
    text = name.strip().lower().replace("²", "2").replace("^", "").replace("°", "deg").replace("µ", "u")
    return re.sub(r"[^0-9a-z]+", "_", text).strip("_")


@dataclass(frozen=True, slots=True)
class Column:
    """A column of a table: its own name, its quantity, and the factor to the unit of the row."""

    name: str
    quantity: Quantity
    factor: float


@dataclass(slots=True)
class Plan:
    """Says what of a table is read.

    Attributes:
        kinds: of rows, with their columns by quantity.
        time: column of the rows' time.
        week: column of the GPS week; None if the time does not need one.
        arrival: column of the arrival at a recorder; None if there is none.
        unused: names of the other columns.
    """

    kinds: dict[RowKind, dict[str, Column]]
    time: Column
    week: Column | None = None
    arrival: Column | None = None
    counter: Column | None = None
    unused: list[str] = field(default_factory=list)

    def columns(self) -> list[Column]:
        """Return all columns that are read, each once."""
        found = [column for columns in self.kinds.values() for column in columns.values()]
        found += [one for one in (self.time, self.week, self.arrival, self.counter) if one is not None]
        return list({column.name: column for column in found}.values())


@cache
def _lookup(kind: RowKind | None) -> Mapping[str, tuple[Quantity, float]]:
    """Return quantity and factor by each possible name, of a kind of rows or of the times."""
    quantities = QUANTITIES[kind] if kind is not None else [*TIMES, WEEK, ARRIVAL]
    found: dict[str, tuple[Quantity, float]] = {}
    for one in quantities:
        for base in one.bases:
            for unit, factor in UNITS[one.dimension].items():
                found.setdefault(f"{base}_{unit}" if unit else base, (one, one.sign * factor))
    return found


def plan_of(path: object, names: Iterable[str], device: str) -> Plan:
    """Return what of a table with these columns is read for a device of a kind.

    Args:
        path: of the table, for messages.
        names: of its columns.
        device: ``gnss``, ``imu``, ``scanner``.

    Raises:
        TableError: columns are missing, or have no unit that is known.
    """
    by_name = {normal(name): name for name in names}
    _refuse_unclear(path, by_name)
    kinds: dict[RowKind, dict[str, Column]] = {}
    for kind in KINDS_OF[device]:
        if _holds(by_name, kind):
            kinds[kind] = _columns(by_name, kind)
    if RowKind.FIX in kinds or RowKind.MARK in kinds or "roll_rad" in _columns(by_name, RowKind.SOLUTION):
        kinds.pop(RowKind.HEADING, None)  # an INS's heading is none of a pair of antennas
    _refuse_without_unit(path, by_name, device, kinds)
    if not kinds:
        raise TableError(_missing(path, by_name, device))
    times = _columns(by_name, None)
    plan = Plan(kinds, _time(path, times), arrival=times.get("host"), counter=times.get("counter"))
    plan.week = times.get("week") if plan.time.quantity.name == "tow" else None
    used = {column.name for column in plan.columns()} | {column.name for column in times.values()}
    plan.unused = [name for name in by_name.values() if name not in used]
    return plan


def devices_of(names: Iterable[str]) -> list[str]:
    """Return the kinds of devices whose rows a table with these columns holds.

    Positions beside an attitude are those of an INS, and no receiver's unless the user says so.
    """
    by_name = {normal(name): name for name in names}
    held = [kind for kind in RowKind if _holds(by_name, kind)]
    if RowKind.SOLUTION in held:
        held = [kind for kind in held if kind not in (RowKind.FIX, RowKind.HEADING)]
    return [device for device, kinds in KINDS_OF.items() if set(kinds) & set(held)]


def _holds(by_name: Mapping[str, str], kind: RowKind) -> bool:
    found = set(_columns(by_name, kind))
    return any(set(wanted) <= found for wanted in REQUIRED[kind])


def _columns(by_name: Mapping[str, str], kind: RowKind | None) -> dict[str, Column]:
    found: dict[str, Column] = {}
    for short, name in by_name.items():
        if short in (lookup := _lookup(kind)):
            quantity, factor = lookup[short]
            found.setdefault(quantity.name, Column(name, quantity, factor))
    return found


def _time(path: object, times: Mapping[str, Column]) -> Column:
    for quantity in TIMES:
        if quantity.name not in times:
            continue
        if quantity.name == "tow" and "week" not in times:
            raise TableError(f'{path}: "{times["tow"].name}" has no week; want a column gps_week beside it')
        return times[quantity.name]
    raise TableError(f"{path}: has no column of time; want {WANTED_TIME}")


def _refuse_unclear(path: object, by_name: Mapping[str, str]) -> None:
    """Refuse a name that says neither origin nor scale, where no clear name of the same quantity is there."""
    clear = {quantity for kind in QUANTITIES for quantity in _columns(by_name, kind)}
    timed = any(quantity.name in _columns(by_name, None) for quantity in TIMES[:-1])
    answered = {
        "altitude": "height_m" in clear or "msl_m" in clear,
        "yaw": "heading_rad" in clear,
        "time": timed,
        "timestamp": timed,
    }
    answered["alt"] = answered["altitude"]
    for short, name in by_name.items():
        base, _, unit = short.rpartition("_")
        for unclear in (short, base if unit in _ANY_UNIT else ""):
            if unclear in _UNCLEAR and not answered[unclear]:
                raise TableError(f'{path}: "{name}" {_UNCLEAR[unclear]}')


def _refuse_without_unit(
    path: object, by_name: Mapping[str, str], device: str, kinds: Mapping[RowKind, object]
) -> None:
    """Refuse a column that is named like a quantity, but without its unit or with that of another dimension."""
    known = {short for kind in (None, *RowKind) for short in _lookup(kind)}
    for kind in [*kinds] or KINDS_OF[device]:
        for quantity in QUANTITIES[kind]:
            for base in quantity.bases if quantity.dimension != "none" else ():
                others = {f"{base}_{unit}" for unit in _ANY_UNIT if unit} | {base}
                for short in sorted(others & set(by_name) - known):
                    wanted = ", ".join(list(Quantity(base, quantity.dimension, (base,)).names())[:4])
                    lacks = "has no unit" if short == base else "has a unit of another quantity"
                    raise TableError(f'{path}: "{by_name[short]}" {lacks}; want {wanted}')


def _missing(path: object, by_name: Mapping[str, str], device: str) -> str:
    """Return a line on what a table lacks, for the kind of rows of which it has most."""
    best: tuple[float, list[str]] = (-1.0, [])
    for kind in KINDS_OF[device]:
        found = _columns(by_name, kind)
        for wanted in REQUIRED[kind]:
            share = sum(name in found for name in wanted) / len(wanted)
            if share > best[0]:
                names = {one.name: next(one.names()) for one in reversed(QUANTITIES[kind])}
                best = share, [names[name] for name in wanted if name not in found]
    what = {"gnss": "of fixes", "imu": "of samples or INS solutions", "scanner": "of returns by angles or x, y, z"}
    return f"{path}: is no table {what[device]}: missing columns such as {', '.join(best[1])}"
