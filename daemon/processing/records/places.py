"""Places of what a log's records show: points in the scanner's frame, and the body in a level frame near the flight."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from swath.daemon.config.geometry import placed_devices
from swath.daemon.processing.records.read import LogRecords
from swath.drivers.parser import DriverSettingsError
from swath.georef.arrays import FloatArray, Int64Array, StructArray
from swath.georef.geodesy.earth import e_from_geodetic, rot_e_from_l
from swath.georef.geodesy.rotations import quaternion_from_rot, rot_l_from_b
from swath.georef.points import Fate
from swath.georef.records import AIMED_RETURN_DTYPE, RETURN_DTYPE
from swath.georef.scanner.beams import Geometry
from swath.georef.scanner.calibration import nominal
from swath.georef.scanner.sensor_model import SensorModel
from swath.georef.timescales import SECOND_NS
from swath.georef.trajectory.trajectory import Trajectory

LOCAL = "local"  # east, north, up from the first position
ROWS_AT_ONCE = 4096
CLOUD_NS = SECOND_NS // 10  # the longest span of a cloud
ENU_FROM_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
FORWARD_RIGHT_DOWN = np.eye(3)  # the axes of b
_STILL_NS = np.array([0, 2], np.int64)
_AT_E = np.array([6_378_137.0, 0.0, 0.0])  # any place on the earth, for a body that does not turn


def places_s(
    rows: StructArray, geometry: Geometry, range_gate_m: tuple[float, float]
) -> tuple[FloatArray, StructArray]:
    """Return the places (m, 3) of returns in the scanner's frame s, m, and the m rows that have one.

    Args:
        rows: (n,) table of returns.
        geometry: of the head's beams.
        range_gate_m: smallest and largest range that is a return.
    """
    unsaid = np.full((2, 3), np.nan)
    still = Trajectory(
        _STILL_NS, np.stack([_AT_E] * 2), np.array([[1.0, 0, 0, 0]] * 2), np.zeros((2, 3)), unsaid, unsaid
    )
    model = SensorModel(nominal("s", (0.0, 0.0, 0.0), np.eye(3)), geometry, range_gate_m)
    rays = model.rays(_as_measured(rows), np.ones(len(rows), np.int64), still)
    placed = rays.fate == Fate.GEOREFERENCED
    return rays.points_e[placed] - _AT_E, rows[placed]


def _as_measured(table: StructArray) -> StructArray:
    """Return a table's rows without their times."""
    dtype = AIMED_RETURN_DTYPE if "elevation_rad" in (table.dtype.names or ()) else RETURN_DTYPE
    rows = np.zeros(len(table), dtype)
    for name in dtype.names or ():
        rows[name] = table[name]
    return rows


class Cloud(NamedTuple):
    """Returns of a tenth of a second at most.

    Attributes:
        places: (n, 3) in the scanner's frame, m.
        rows: (n,) table of the returns.
        posix_ns: (n,) their times, as `LogRecords.posix_ns` gives them.
    """

    places: FloatArray
    rows: StructArray
    posix_ns: Int64Array


def clouds(
    records: LogRecords, source: str, notes: list[str], start_ns: int | None = None, stop_ns: int | None = None
) -> Iterator[Cloud]:
    """Yield the returns of a scanner that its model places, in order; ``notes`` gets a line about those it does not."""
    table = records.config.scanner[source.removeprefix("scanner/")]
    try:
        geometry = records.geometry(source)
    except (ValueError, DriverSettingsError) as error:
        notes.append(f"{source}: no points: {error}")
        return
    total = missing = 0
    for rows in records.returns(source, start_ns, stop_ns):
        places, placed = places_s(rows, geometry, (table.range_min_m, table.range_max_m))
        total, missing = total + len(rows), missing + len(rows) - len(placed)
        posix_ns = records.posix_ns(placed)
        cuts = np.flatnonzero(np.diff(posix_ns // CLOUD_NS)) + 1
        for part in np.split(np.arange(len(placed)), cuts):
            if len(part):
                yield Cloud(places[part], placed[part], posix_ns[part])
    if missing:
        notes.append(f"{source}: {missing:,} of {total:,} returns have no place, such as a range beyond the limits")


class Pose(NamedTuple):
    """A pose of the body in a frame that is level (east, north, up) at an origin.

    Attributes:
        position: (3,) m.
        rotation: (3, 3) from the body's axes to that frame.
        q: (4,) the same, scalar first.
    """

    position: FloatArray
    rotation: FloatArray
    q: FloatArray


def first_place(tables: Mapping[str, Mapping[str, StructArray]]) -> Any:
    """Return the row of the first position among tables by source and kind; None: there is none."""
    for name in ("solutions", "fixes"):
        for found in tables.values():
            rows = found[name][np.isfinite(found[name]["lat_rad"]) & np.isfinite(found[name]["height_m"])]
            if len(rows):
                return rows[0]
    return None


def with_pose(solutions: StructArray) -> StructArray:
    """Return the rows of solutions that have position and attitude."""
    fields = ("lat_rad", "lon_rad", "height_m", "roll_rad", "pitch_rad", "heading_rad")
    rows: StructArray = solutions[np.all([np.isfinite(solutions[name]) for name in fields], axis=0)]
    return rows


def local_poses(solutions: StructArray, origin: Any, rot_b: FloatArray = FORWARD_RIGHT_DOWN) -> Iterator[Pose]:
    """Yield the poses of solutions in a frame that is level at an origin.

    Args:
        solutions: (n,) rows with position and attitude.
        origin: row of fixes or solutions.
        rot_b: (3, 3) from the axes whose pose is wanted to b.
    """
    if not len(solutions):
        return
    lat, lon, height = (np.asarray(origin[name]) for name in ("lat_rad", "lon_rad", "height_m"))
    rot_local_from_e = ENU_FROM_NED @ rot_e_from_l(lat, lon).T
    origin_e = e_from_geodetic(lat, lon, height)
    for begin in range(0, len(solutions), ROWS_AT_ONCE):
        rows = solutions[begin : begin + ROWS_AT_ONCE]
        latitudes, longitudes = rows["lat_rad"], rows["lon_rad"]
        away_e = e_from_geodetic(latitudes, longitudes, rows["height_m"]) - origin_e
        rot_l = rot_l_from_b(rows["roll_rad"], rows["pitch_rad"], rows["heading_rad"])
        rotations = rot_local_from_e @ rot_e_from_l(latitudes, longitudes) @ rot_l @ rot_b
        yield from map(Pose, away_e @ rot_local_from_e.T, rotations, quaternion_from_rot(rotations))


def frame_of(source: str) -> str:
    """Return the name of a source's frame."""
    return source.replace("/", "_")


def mount_of(records: LogRecords, source: str) -> tuple[FloatArray, FloatArray] | None:
    """Return a scanner's place in the body (3,), m, and the rotation (3, 3) of its axes to b, as installed.

    None: a gimbal moves it.
    """
    if records.config.scanner[source.removeprefix("scanner/")].gimbal is not None:
        return None
    [placed] = [one for one in placed_devices(records.config) if one.name == source]
    assert placed.rot_b is not None
    return placed.arm_b, placed.rot_b
