"""Positions from post-processing as observations, in place of the receiver's own (``--gnss FILE``)."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from daemon.errors import ExitCode, UserError
from daemon.processing.navigation_observations import DEFAULT_SIGMAS, Observed
from georef.earth import e_from_geodetic
from georef.formats.antenna_positions import read_antenna_positions
from georef.formats.trajectory_columns import TrajectoryColumns
from georef.navigation.inputs import OBSERVATION_DTYPE, Kind, sort_observations
from georef.navigation.measurements import POSITION_FLOORS_M
from georef.records import FixType, StructArray
from georef.trajectory import TrajectoryError, gps_text


@dataclass(frozen=True, slots=True)
class OutsidePositions:
    """What a file of positions gave."""

    file: Path
    observed: Observed


def refuse_unreadable(file: Path) -> None:
    """UserError where a file cannot be opened."""
    try:
        file.open("rb").close()
    except OSError as error:
        raise UserError(f"--gnss {file}: cannot be read: {error.strerror}", ExitCode.IO) from error


def outside_observations(
    file: Path, span_ns: tuple[int, int], week: int | None, leap_seconds: int | None
) -> OutsidePositions:
    """Positions and velocities of the file's antenna, the primary one.

    Args:
        file: RTKLIB .pos or Waypoint text.
        span_ns: GPS time of the log's first and last inertial sample.
        week: of a file that says none.
        leap_seconds: as the log knows them, for files in UTC.

    Raises:
        UserError: it cannot be read, or is of another time.
    """
    refuse_unreadable(file)
    try:
        columns = read_antenna_positions(
            file.read_bytes(), str(file), span_ns=span_ns, week=week, leap_seconds=leap_seconds
        )
    except TrajectoryError as error:
        raise UserError(f"--gnss {error}") from error
    first, last = int(columns.time_ns[0]), int(columns.time_ns[-1])
    if last < span_ns[0] or first > span_ns[1]:
        raise UserError(
            f"--gnss {file}: is from {gps_text(first)} to {gps_text(last)}, the log's samples from "
            f"{gps_text(span_ns[0])} to {gps_text(span_ns[1])}: of another flight, or of another time scale"
        )
    return OutsidePositions(file, _observed(columns))


def _observed(columns: TrajectoryColumns) -> Observed:
    fix = _fix_types(columns)
    usable = np.isin(fix, [int(known) for known in DEFAULT_SIGMAS])
    position_e = e_from_geodetic(columns.lat_rad, columns.lon_rad, columns.height_m)
    positions, assumed = _rows(columns, fix, Kind.POSITION, position_e, columns.position_sigma_l)
    if columns.position_correlation_l is not None:
        positions["correlation"] = columns.position_correlation_l
    parts, counts = [positions[usable]], Counter(position=int(assumed[usable].sum()))
    moving = usable & np.isfinite(columns.velocity_l).all(axis=1)
    if moving.any():
        velocities, assumed = _rows(columns, fix, Kind.VELOCITY, columns.velocity_l, columns.velocity_sigma_l)
        parts.append(velocities[moving])
        counts["velocity"] = int(assumed[moving].sum())
    return Observed(sort_observations(np.concatenate(parts)), +Counter(fix_type=int((~usable).sum())), +counts)


def _fix_types(columns: TrajectoryColumns) -> NDArray[np.uint8]:
    """Of a file that says none: the kind of fix that is as good as its horizontal sigmas; without them a single one."""
    if columns.fix_type is not None:
        return columns.fix_type
    types = np.full(len(columns.time_ns), int(FixType.SINGLE), np.uint8)
    if columns.position_sigma_l is not None:
        sigma_m = columns.position_sigma_l[:, :2].max(axis=1)
        for better, worse in pairwise((FixType.RTK_FIXED, FixType.RTK_FLOAT, FixType.DIFFERENTIAL, FixType.SINGLE)):
            of_it = (sigma_m > 0.0) & (sigma_m < POSITION_FLOORS_M[worse]) & (types == int(FixType.SINGLE))
            types[of_it] = int(better)
    return types


def _rows(
    columns: TrajectoryColumns,
    fix: NDArray[np.uint8],
    kind: Kind,
    value: NDArray[np.float64],
    sigma: NDArray[np.float64] | None,
) -> tuple[StructArray, NDArray[np.bool_]]:
    """Rows of a kind, and where a default sigma stands in them."""
    n = len(columns.time_ns)
    default = np.ones((n, 3))
    for known, sigmas in DEFAULT_SIGMAS.items():
        horizontal, vertical = sigmas[0 if kind == Kind.POSITION else 1]
        default[fix == int(known)] = (horizontal, horizontal, vertical)
    given = np.full((n, 3), np.nan) if sigma is None else sigma
    said = np.isfinite(given) & (given > 0.0)
    rows = np.zeros(n, OBSERVATION_DTYPE)
    rows["time_ns"], rows["kind"], rows["fix_type"] = columns.time_ns, kind, fix
    rows["satellites"] = 0 if columns.satellites is None else columns.satellites
    rows["value"], rows["sigma"] = value, np.where(said, given, default)
    return rows, np.asarray(~said.all(axis=1))
