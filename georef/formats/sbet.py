"""Read and write SBET and smrmsg, the binary trajectories of Applanix POSPac and many others.

SBET: 17 little-endian doubles a record: time (s of the GPS week), latitude, longitude (rad), height (m), velocity x, y,
z (m/s), roll, pitch, platform heading, wander angle (rad), body accelerations x, y, z (m/s²), body rates (rad/s). The
platform's x axis points wander angle α west of north, so true heading = platform heading − α. POSPac's y axis points
left and z up, so that v_N = x cos α − y sin α, v_E = −x sin α − y cos α; other writers use right and down, and α = 0.
The positions show which convention a file follows.

smrmsg: 10 doubles: time, sigmas of north, east, down (m), of the velocities (m/s), of roll, pitch and heading (arc
minutes), once a second or as often as the SBET.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from swath.georef.arrays import BoolArray, FloatArray, Int64Array
from swath.georef.formats.trajectory.columns import (
    Span,
    TrajectoryColumns,
    continuous_of_week,
    course_pieces,
    mean_over,
    moved_l,
    placed_in_week,
    unsaid,
)
from swath.georef.geodesy.quaternions import conjugate, rotated
from swath.georef.timescales.gps_time import SECOND_NS, WEEK_NS, WEEK_S, week_from_gps
from swath.georef.trajectory.trajectory import Trajectory, TrajectoryError

SBET_DOUBLES, SMRMSG_DOUBLES = 17, 10
SBET_BYTES, SMRMSG_BYTES = 8 * SBET_DOUBLES, 8 * SMRMSG_DOUBLES
# no position, speed or angle is this large; the accelerations and rates after the eleventh double are ignored
LARGEST, USED_DOUBLES = 1e9, 11
ARC_MINUTE = float(np.radians(1.0 / 60.0))
# Signs of the platform's y and z axes against right and down: plain north, east, down; POSPac's; east, up
AXES = ((1.0, 1.0), (-1.0, -1.0), (1.0, -1.0))


@dataclass(frozen=True, slots=True)
class Sigmas:
    """Sigmas of a trajectory at their own epochs.

    Attributes:
        of_week_ns: (n,) nanoseconds since the start of the week of the first one.
        position_l, velocity_l: (n, 3) m, m/s, north, east, down.
        attitude_rad: (n, 3) roll, pitch, heading.
    """

    of_week_ns: Int64Array
    position_l: FloatArray
    velocity_l: FloatArray
    attitude_rad: FloatArray


def read_sbet(
    data: bytes, name: str, *, span_ns: Span | None = None, week: int | None = None, sigmas: Sigmas | None = None
) -> TrajectoryColumns:
    """Return rows of an SBET.

    Args:
        data: the file's bytes.
        name: for messages.
        span_ns: GPS time of the first and last record of its log, which gives the week.
        week: GPS week of the first record; takes precedence over span_ns.
        sigmas: of the smrmsg beside it.
    """
    table = _table(data, name, "SBET", SBET_DOUBLES)
    of_week_ns = continuous_of_week(table[:, 0], name)
    time_ns = placed_in_week(of_week_ns, name, span_ns, week)
    lat, lon, height = table[:, 1:4].T
    position, attitude = _sigmas_at(of_week_ns, sigmas, name)
    columns = TrajectoryColumns(
        time_ns,
        *(lat, lon, height, table[:, 4:7]),
        *(table[:, 7], table[:, 8], _once_round(table[:, 9] - table[:, 10])),
        *(position, attitude),
        angles_in="radians",
    )
    whole: BoolArray = np.logical_and.reduce(np.isfinite(table[:, 1:USED_DOUBLES]), axis=1)
    columns.velocity_l = _velocity_l(columns, table[:, 10], whole)
    return columns


def read_smrmsg(data: bytes, name: str) -> Sigmas:
    """Return sigmas of a trajectory.

    Raises:
        TrajectoryError: the file is not an smrmsg.
    """
    table = _table(data, name, "smrmsg", SMRMSG_DOUBLES)
    bad = (table[:, 1:] < 0.0).any(axis=1)  # nan: missing
    if bad.any():
        raise TrajectoryError(f"{name}: a sigma at record {int(np.argmax(bad)) + 1} is negative; smrmsg is expected")
    return Sigmas(continuous_of_week(table[:, 0], name), table[:, 1:4], table[:, 4:7], table[:, 7:10] * ARC_MINUTE)


def sbet_bytes(trajectory: Trajectory) -> bytes:
    """Return the trajectory as an SBET: wander angle 0, velocities north, east, down, time past the week's end.

    Accelerations are derivatives of the velocities relative to the earth, without gravity; rates are relative to e.
    """
    trajectory.require_attitude()
    n = len(trajectory)
    table = np.zeros((n, SBET_DOUBLES), dtype="<f8")
    table[:, 0] = _of_first_week_ns(trajectory) / SECOND_NS
    table[:, 1:4] = np.stack(trajectory.geodetic(), axis=1)
    table[:, 4:7] = trajectory.velocity_l()
    table[:, 7:10] = np.stack(trajectory.attitude(), axis=1)
    if n > 1:
        step_s = np.diff(trajectory.time_ns)[:, np.newaxis] / SECOND_NS
        acceleration_e = np.diff(trajectory.velocity_e, axis=0) / step_s
        table[:-1, 11:14] = rotated(conjugate(trajectory.q_e_from_b[:-1]), acceleration_e)
        table[:-1, 14:17] = trajectory.turn_rates_b()
        table[-1, 11:17] = table[-2, 11:17]
    return table.tobytes()


def smrmsg_bytes(trajectory: Trajectory, velocity_sigma_l: FloatArray | None = None) -> bytes:
    """Return the trajectory's sigmas as an smrmsg, one record per epoch; missing ones are nan.

    Args:
        trajectory: gives sigmas of position and attitude.
        velocity_sigma_l: (n, 3) north, east, down, m/s; None: missing.
    """
    table = np.full((len(trajectory), SMRMSG_DOUBLES), np.nan, dtype="<f8")
    if velocity_sigma_l is not None:
        table[:, 4:7] = velocity_sigma_l
    table[:, 0] = _of_first_week_ns(trajectory) / SECOND_NS
    table[:, 1:4] = trajectory.position_sigma_l
    table[:, 7:10] = trajectory.attitude_sigma_rad / ARC_MINUTE
    return table.tobytes()


def _table(data: bytes, name: str, kind: str, doubles: int) -> FloatArray:
    size = 8 * doubles
    over = len(data) % size
    if not data or over:
        whole = len(data) // size
        raise TrajectoryError(
            f"{name}: {len(data)} bytes are {whole} records of {kind} ({size} bytes) and {over} over: the file is "
            "truncated or of another kind"
        )
    table = np.frombuffer(data, dtype="<f8").reshape(-1, doubles).astype(np.float64)
    table[np.isnan(table)] = np.nan  # replaces signalling nans, which would raise at the first computation
    time_s = table[:, 0]
    wrong = ~((time_s >= 0.0) & (time_s < 10.0 * WEEK_S))
    if wrong.any():
        at = int(np.argmax(wrong))
        raise TrajectoryError(
            f"{name}: time {time_s[at]:.6g} at record {at + 1} is not a second of the week; {kind} is expected"
        )
    large = (np.abs(table[:, 1:USED_DOUBLES]) > LARGEST).any(axis=1)  # nan: missing
    if large.any():
        raise TrajectoryError(
            f"{name}: record {int(np.argmax(large)) + 1} has a number beyond {LARGEST:g}; {kind} is expected, "
            "metres and radians"
        )
    return table


def _velocity_l(columns: TrajectoryColumns, wander_rad: FloatArray, whole: BoolArray) -> FloatArray:
    """Return velocities north, east, down, by the platform axes with which they agree with the positions' motion.

    Only complete records, ``whole`` (n,), decide this.
    """
    x, y, z = columns.velocity_l.T
    cos, sin = np.cos(wander_rad), np.sin(wander_rad)
    velocities = [
        np.stack([x * cos + right * y * sin, right * y * cos - x * sin, down * z], axis=1) for right, down in AXES
    ]
    time_ns = columns.time_ns[whole]
    if not len(time_ns) or (np.diff(time_ns) <= 0).any():
        return velocities[0]
    pieces = course_pieces(time_ns)
    moved = moved_l(time_ns, columns.lat_rad[whole], columns.lon_rad[whole], columns.height_m[whole], pieces)
    misfits = [((mean_over(time_ns, velocity[whole], pieces) - moved) ** 2).sum() for velocity in velocities]
    return velocities[int(np.argmin(misfits))]


def _sigmas_at(of_week_ns: Int64Array, sigmas: Sigmas | None, name: str) -> tuple[FloatArray, FloatArray]:
    """Return position and attitude sigmas at the SBET's epochs, linear between their own, missing outside them."""
    if sigmas is None:
        return unsaid(len(of_week_ns)), unsaid(len(of_week_ns))
    for shift_ns in (0, WEEK_NS, -WEEK_NS):  # one of the two files may begin only after the week's end
        theirs = sigmas.of_week_ns + shift_ns
        if theirs[0] <= of_week_ns[-1] and of_week_ns[0] <= theirs[-1]:
            break
    else:
        raise TrajectoryError(f"{name}: the smrmsg beside it covers another time")
    inside = (of_week_ns >= theirs[0]) & (of_week_ns <= theirs[-1])

    def linear(column: FloatArray) -> FloatArray:
        at = np.stack([np.interp(of_week_ns, theirs, column[:, k]) for k in range(3)], axis=1)
        at[~inside] = np.nan
        return at

    return linear(sigmas.position_l), linear(sigmas.attitude_rad)


def _once_round(angle_rad: FloatArray) -> FloatArray:
    """Return angles in 0 … 2π where they lie within one turn of it; others stay as they are, to be refused."""
    return np.where(np.abs(angle_rad) <= 4 * np.pi, angle_rad % (2 * np.pi), angle_rad)


def _of_first_week_ns(trajectory: Trajectory) -> Int64Array:
    week, _ = week_from_gps(trajectory.span[0])
    since: Int64Array = trajectory.time_ns - week * WEEK_NS
    return since
