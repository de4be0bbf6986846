"""Reads post-processed positions as observations, in place of the receiver's own (``--gnss FILE``)."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from swath.daemon.errors import ExitCode, UserError
from swath.daemon.processing.navigation.observations import DEFAULT_SIGMAS, Observed
from swath.georef.arrays import BoolArray, ByteArray, FloatArray, StructArray
from swath.georef.formats.antenna_positions import read_antenna_positions
from swath.georef.formats.trajectory.columns import TrajectoryColumns
from swath.georef.geodesy.earth import e_from_geodetic
from swath.georef.navigation.filter.measurements import POSITION_FLOORS_M
from swath.georef.navigation.inputs import OBSERVATION_DTYPE, Kind, sort_observations
from swath.georef.records import FixType
from swath.georef.timescales import SECOND_NS
from swath.georef.trajectory.trajectory import TrajectoryError, gps_text

FEWEST_SHIFTED = 10
MOST_SHIFT_S = 40  # TAI is 37 s from UTC, 19 s from GPS time
SHIFTED_M, NEARER = 5.0, 5.0  # apart by more, and by so many times the distance after the shift
LARGEST_STEP_NS = 2 * SECOND_NS  # positions farther apart are not interpolated


@dataclass(frozen=True, slots=True)
class OutsidePositions:
    """A file of positions and its observations."""

    file: Path
    observed: Observed


def refuse_unreadable(file: Path) -> None:
    """Refuse with `UserError` a file that cannot be opened."""
    try:
        file.open("rb").close()
    except OSError as error:
        raise UserError(f"--gnss {file}: cannot be read: {error.strerror}", ExitCode.IO) from error


def outside_observations(
    file: Path, span_ns: tuple[int, int], week: int | None, leap_seconds: int | None
) -> OutsidePositions:
    """Return positions and velocities of the file's antenna, the primary one.

    Args:
        file: RTKLIB .pos or Waypoint text.
        span_ns: GPS time of the log's first and last inertial sample.
        week: GPS week of a file without one.
        leap_seconds: leap seconds as the log knows them, for files in UTC.

    Raises:
        UserError: the file cannot be read, or is of another time.
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
            f"--gnss {file}: covers {gps_text(first)} to {gps_text(last)}, the log's samples from "
            f"{gps_text(span_ns[0])} to {gps_text(span_ns[1])}: it belongs to another flight, or its time scale "
            "differs; give the positions of this flight in GPS time"
        )
    return OutsidePositions(file, _observed(columns))


def refuse_shifted(outside: OutsidePositions, own: StructArray) -> None:
    """Refuse positions that are the receiver's own, but shifted by whole seconds.

    Args:
        outside: positions of a file.
        own: observations of the log's receiver.

    Raises:
        UserError: the positions agree after a shift by whole seconds, and not without it.
    """
    own = own[own["kind"] == Kind.POSITION]
    rows = outside.observed.rows
    rows = rows[rows["kind"] == Kind.POSITION]
    if len(own) < FEWEST_SHIFTED or len(rows) < FEWEST_SHIFTED:
        return
    apart_m = {shift_s: _apart_m(own, rows, shift_s) for shift_s in range(-MOST_SHIFT_S, MOST_SHIFT_S + 1)}
    best_s = min(apart_m, key=lambda shift_s: apart_m[shift_s])
    if best_s == 0 or not apart_m[0] > max(SHIFTED_M, NEARER * apart_m[best_s]):
        return
    raise UserError(
        f"--gnss {outside.file}: its positions are those of the log's receiver {abs(best_s)} s "
        f"{'later' if best_s > 0 else 'earlier'} ({apart_m[0]:.0f} m apart unshifted, {apart_m[best_s]:.1f} m "
        "shifted): the file uses another number of leap seconds or another time scale (GPS instead of UTC); write it "
        "in GPS time"
    )


def _apart_m(own: StructArray, rows: StructArray, shift_s: int) -> float:
    """Return the median distance of the receiver's positions from the file's ``shift_s`` later; inf
    if too few overlap.
    """
    epochs = rows["time_ns"]
    wanted = own["time_ns"] + shift_s * SECOND_NS
    after = np.clip(np.searchsorted(epochs, wanted), 1, len(epochs) - 1)
    close = epochs[after] - epochs[after - 1] <= LARGEST_STEP_NS
    there = close & (wanted >= epochs[0]) & (wanted <= epochs[-1])
    if there.sum() < FEWEST_SHIFTED:
        return float("inf")
    since, at = ((times - epochs[0]).astype(np.float64) for times in (wanted[there], epochs))
    places = np.stack([np.interp(since, at, column) for column in rows["value"].T], axis=1)
    return float(np.median(np.linalg.norm(places - own["value"][there], axis=1)))


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


def _fix_types(columns: TrajectoryColumns) -> ByteArray:
    """Return the types of fixes; in a file without them, the type whose quality fits the horizontal sigmas, else
    single.
    """
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
    fix: ByteArray,
    kind: Kind,
    value: FloatArray,
    sigma: FloatArray | None,
) -> tuple[StructArray, BoolArray]:
    """Return rows of a kind, and flags (n,) of those in which a default sigma is used."""
    n = len(columns.time_ns)
    default = np.ones((n, 3))
    for known, sigmas in DEFAULT_SIGMAS.items():
        horizontal, vertical = sigmas[0 if kind == Kind.POSITION else 1]
        default[fix == int(known)] = (horizontal, horizontal, vertical)
    given = np.full((n, 3), np.nan) if sigma is None else sigma
    has_sigma = np.isfinite(given) & (given > 0.0)
    rows = np.zeros(n, OBSERVATION_DTYPE)
    rows["time_ns"], rows["kind"], rows["fix_type"] = columns.time_ns, kind, fix
    rows["satellites"] = 0 if columns.satellites is None else columns.satellites
    rows["value"], rows["sigma"] = value, np.where(has_sigma, given, default)
    return rows, np.asarray(~has_sigma.all(axis=1))
