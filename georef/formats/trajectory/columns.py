"""Convert the rows of any trajectory file to a trajectory, and refuse files that are wrong before they spoil a map."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swath.georef.arrays import BoolArray, ByteArray, FloatArray, Int64Array
from swath.georef.geodesy.earth import e_from_geodetic
from swath.georef.geodesy.quaternions import about, conjugate, product, rotated
from swath.georef.timescales.gps_time import DAY_NS, SECOND_NS, WEEK_NS, WEEK_S, week_from_gps
from swath.georef.trajectory.trajectory import Trajectory, TrajectoryError, gps_text

Span = tuple[int, int]

LOWEST_M, HIGHEST_M = -1000.0, 50_000.0
GREATEST_SPEED_MPS = 1000.0
GREATEST_SAID_MPS, GREATEST_SIGMA = 1e5, 1e6  # limits for single rows: numbers beyond them have another meaning or unit
EARLIEST_NS, LATEST_NS = 0, 1 << 62  # GPS time, 1980 to 2126: differences of times stay within 64 bits
LONGEST_GAP_AT_WEEKS_END_S = 3600.0  # of epochs left out between Saturday and Sunday
COURSE_FROM_MPS, GREATEST_COURSE_ERROR_RAD, COURSE_OUTLIERS = 20.0, float(np.radians(5.0)), 0.01
COURSE_PIECE_NS, LONGEST_PIECE_NS = SECOND_NS, 3 * SECOND_NS  # length of the pieces of flight whose course is checked
HEADING_OFF_RAD = float(np.radians(45.0))  # more than any drift angle


@dataclass(slots=True)
class TrajectoryColumns:
    """Rows of a file in SI units; (n,) or (n, 3); nan where the file gives no value.

    Attributes:
        time_ns: GPS time.
        lat_rad, lon_rad, height_m: height above the ellipsoid.
        velocity_l: north, east, down.
        roll_rad, pitch_rad, heading_rad: heading from true north.
        position_sigma_l, attitude_sigma_rad: one standard deviation.
        row: name of a row in messages: record, line.
        first_row: number of the first row.
        angles_in: the unit that the file should have for attitudes and positions, for messages.
        fix_type, satellites: (n,) of antenna positions, `swath.georef.records.FixType`; None: not in the file.
        velocity_sigma_l: (n, 3) one standard deviation; None: not in the file.
        position_correlation_l: (n, 3) of north–east, north–down, east–down; None: not in the file.
    """

    time_ns: Int64Array
    lat_rad: FloatArray
    lon_rad: FloatArray
    height_m: FloatArray
    velocity_l: FloatArray
    roll_rad: FloatArray
    pitch_rad: FloatArray
    heading_rad: FloatArray
    position_sigma_l: FloatArray
    attitude_sigma_rad: FloatArray
    row: str = "record"
    first_row: int = 1
    angles_in: str = "degrees"
    fix_type: ByteArray | None = None
    satellites: ByteArray | None = None
    velocity_sigma_l: FloatArray | None = None
    position_correlation_l: FloatArray | None = None

    def at(self, where: BoolArray) -> str:
        """Return the name of the first row for which a condition holds."""
        return f"{self.row} {int(np.argmax(where)) + self.first_row}"


def unsaid(n: int) -> FloatArray:
    """Return (n, 3) values of nan."""
    return np.full((n, 3), np.nan)


def trajectory_of(columns: TrajectoryColumns, name: str, max_gap_ns: int) -> Trajectory:
    """Return the trajectory of a file's rows.

    Raises:
        TrajectoryError: the rows cannot be valid.
    """
    if len(columns.time_ns) < 2:
        raise TrajectoryError(f"{name}: has {len(columns.time_ns)} epochs; a trajectory needs two")
    for check in CHECKS:
        check(columns, name)
    return Trajectory.from_geodetic(
        columns.time_ns,
        columns.lat_rad,
        columns.lon_rad,
        columns.height_m,
        columns.velocity_l,
        columns.roll_rad,
        columns.pitch_rad,
        columns.heading_rad,
        position_sigma_l=columns.position_sigma_l,
        attitude_sigma_rad=columns.attitude_sigma_rad,
        max_gap_ns=max_gap_ns,
        name=name,
    ).with_velocities()


# --- time of week ---


def continuous_of_week(time_s: FloatArray, name: str, row: str = "record", first_row: int = 1) -> Int64Array:
    """Return nanoseconds since the start of the first row's week from seconds of week, which may restart at its end."""
    steps = np.diff(time_s)
    crossing = (steps + WEEK_S >= -1.0) & (steps + WEEK_S <= LONGEST_GAP_AT_WEEKS_END_S)
    back = (steps < 0) & ~crossing
    if back.any():
        at = int(np.argmax(back))
        raise TrajectoryError(f"{name}: time goes back by {-steps[at]:.3f} s at {row} {at + 1 + first_row}")
    weeks = np.r_[0, np.cumsum(crossing)].astype(np.int64)
    since: Int64Array = np.rint(time_s * SECOND_NS).astype(np.int64) + weeks * WEEK_NS
    return since


def placed_in_week(of_week_ns: Int64Array, name: str, span_ns: Span | None, week: int | None) -> Int64Array:
    """Return GPS time of nanoseconds of a week: in the given week, or in the one that overlaps a log's span most."""
    if week is not None:
        if not 0 <= week <= LATEST_NS // WEEK_NS:  # such as 24233, a week with a day of the week appended
            raise TrajectoryError(f"{name}: --week {week} is not a GPS week; give whole weeks since 1980, such as 2423")
        return of_week_ns + week * WEEK_NS
    if span_ns is None:
        raise TrajectoryError(f"{name}: has seconds of the week without the week; give the GPS week (--week)")
    first, last = int(of_week_ns[0]), int(of_week_ns[-1])
    near = week_from_gps(span_ns[0])[0]

    def overlap_ns(of_week: int) -> int:
        return min(span_ns[1], last + of_week * WEEK_NS) - max(span_ns[0], first + of_week * WEEK_NS)

    best = max(range(near - 2, near + 3), key=overlap_ns)
    if overlap_ns(best) < 0:
        raise TrajectoryError(_no_overlap(first, last, name, span_ns))
    return of_week_ns + best * WEEK_NS


def _no_overlap(first: int, last: int, name: str, span_ns: Span) -> str:
    week, begin = week_from_gps(span_ns[0])
    end = begin + span_ns[1] - span_ns[0]
    hint = "it belongs to another flight, or its time is not GPS time"
    if last < DAY_NS:
        days = [day for day in range(8) if first + day * DAY_NS <= end and last + day * DAY_NS >= begin]
        if days:
            hint = f"its times look like seconds of the day; add {days[0] * 86_400} s to have seconds of the week"
    spans = [f"{a / SECOND_NS:.1f} to {b / SECOND_NS:.1f} s" for a, b in ((first, last), (begin, end))]
    return f"{name}: {spans[0]} of the week does not overlap the log, {spans[1]} of GPS week {week}: {hint}"


# --- checks ---


def _check_finite(columns: TrajectoryColumns, name: str) -> None:
    for column in ("lat_rad", "lon_rad", "height_m"):
        bad: BoolArray = ~np.isfinite(getattr(columns, column))
        if bad.any():
            raise TrajectoryError(f"{name}: no number for {column.split('_')[0]} at {columns.at(bad)}")
    attitude = np.stack([columns.roll_rad, columns.pitch_rad, columns.heading_rad], axis=1)
    missing = np.asarray(~np.isfinite(attitude).all(axis=1))
    if missing.any() and not np.isnan(attitude).all():
        raise TrajectoryError(f"{name}: no number for roll, pitch or heading at {columns.at(missing)}")


def _check_sigmas(columns: TrajectoryColumns, name: str) -> None:
    for what, sigma in (("position", columns.position_sigma_l), ("attitude", columns.attitude_sigma_rad)):
        bad = np.logical_or.reduce(sigma < 0.0, axis=1)  # nan: missing
        if bad.any():
            raise TrajectoryError(f"{name}: a sigma of the {what} at {columns.at(bad)} is negative")
        bad = np.logical_or.reduce(sigma > GREATEST_SIGMA, axis=1)
        if bad.any():
            raise TrajectoryError(f"{name}: a sigma of the {what} at {columns.at(bad)} exceeds {GREATEST_SIGMA:g}")


def _check_velocity(columns: TrajectoryColumns, name: str) -> None:
    fast = np.logical_or.reduce(np.abs(columns.velocity_l) > GREATEST_SAID_MPS, axis=1)  # nan: missing
    if fast.any():
        raise TrajectoryError(
            f"{name}: a velocity at {columns.at(fast)} exceeds {GREATEST_SAID_MPS:g} m/s; metres per second are "
            "expected"
        )


def _check_position(columns: TrajectoryColumns, name: str) -> None:
    beyond: BoolArray = np.abs(columns.lat_rad) > np.pi / 2
    if beyond.any():
        value = columns.lat_rad[int(np.argmax(beyond))]
        shown = value if columns.angles_in == "radians" else np.degrees(value)
        hint = f"{columns.angles_in} north are expected"
        if columns.angles_in == "radians" and abs(shown) <= 90.0:
            hint += "; these look like degrees"
        elif (np.abs(columns.lon_rad) <= np.pi / 2).all():
            hint += "; latitude and longitude may be swapped"
        raise TrajectoryError(f"{name}: latitude {shown:.6g} at {columns.at(beyond)}: {hint}")
    around: BoolArray = np.abs(columns.lon_rad) > 2 * np.pi
    if around.any():
        raise TrajectoryError(f"{name}: longitude at {columns.at(around)} exceeds a full turn")
    high: BoolArray = (columns.height_m < LOWEST_M) | (columns.height_m > HIGHEST_M)
    if high.any():
        height = columns.height_m[int(np.argmax(high))]
        raise TrajectoryError(
            f"{name}: height {height:.1f} at {columns.at(high)}: metres above the ellipsoid are expected"
        )


def _check_attitude(columns: TrajectoryColumns, name: str) -> None:
    limits = (("roll", columns.roll_rad, np.pi), ("pitch", columns.pitch_rad, np.pi / 2))
    for what, angle, limit in (*limits, ("heading", columns.heading_rad, 2 * np.pi)):
        beyond: BoolArray = np.abs(angle) > limit + 1e-6
        if beyond.any():
            value = angle[int(np.argmax(beyond))]
            shown = value if columns.angles_in == "radians" else np.degrees(value)
            hint = "; these look like degrees" if columns.angles_in == "radians" else ""
            where = columns.at(beyond)
            raise TrajectoryError(f"{name}: {what} {shown:.6g} at {where}: {columns.angles_in} are expected{hint}")


def _check_time(columns: TrajectoryColumns, name: str) -> None:
    far = (columns.time_ns < EARLIEST_NS) | (columns.time_ns > LATEST_NS)
    if far.any():
        raise TrajectoryError(f"{name}: time at {columns.at(far)} is before 1980 or after 2125, so it is not GPS time")
    steps = np.diff(columns.time_ns)
    stuck = np.r_[False, steps <= 0]
    if stuck.any():
        at = int(np.argmax(stuck))
        what = f"goes back by {-steps[at - 1] / SECOND_NS:.3f} s" if steps[at - 1] else "stands still"
        raise TrajectoryError(f"{name}: time {what} at {columns.at(stuck)}, {gps_text(columns.time_ns[at])}")


def _check_course(columns: TrajectoryColumns, name: str) -> None:
    """Refuse positions that contradict velocities or heading: wrong signs, swapped columns, wrong units."""
    pieces = course_pieces(columns.time_ns)
    if not len(pieces):
        return
    moved = moved_l(columns.time_ns, columns.lat_rad, columns.lon_rad, columns.height_m, pieces)
    speed = np.linalg.norm(moved, axis=1)
    if np.median(speed) > GREATEST_SPEED_MPS:
        raise TrajectoryError(
            f"{name}: its positions move at {np.median(speed):.0f} m/s; check the units of latitude, longitude and time"
        )
    stated = mean_over(columns.time_ns, columns.velocity_l, pieces)
    fast = (np.hypot(*moved[:, :2].T) > COURSE_FROM_MPS) & (np.hypot(*stated[:, :2].T) > COURSE_FROM_MPS)
    error = _course_error(moved, stated)
    off = fast & (np.abs(error) > GREATEST_COURSE_ERROR_RAD)
    if off.sum() > COURSE_OUTLIERS * fast.sum():
        at = pieces[int(np.argmax(off)), 0]
        swapped = moved_l(columns.time_ns, columns.lon_rad, columns.lat_rad, columns.height_m, pieces)
        hint = "the velocities are not north, east, down, or the wander angle has another sign"
        mirrored = stated * np.array(
            [1.0, -1.0, 1.0]
        )  # the axes of an SBET may have been misjudged from such positions
        fits = [np.median(np.abs(_course_error(swapped, velocity))[fast]) for velocity in (stated, mirrored)]
        if min(fits) < GREATEST_COURSE_ERROR_RAD:
            hint = "latitude and longitude are swapped"
        degrees = np.degrees(np.median(np.abs(error[off])))
        where = f"{columns.row} {at + columns.first_row}"
        what = f"from {where} on positions and velocities differ in course by {degrees:.0f}°"
        raise TrajectoryError(f"{name}: {what}: {hint}")
    _check_heading_unit(columns, name, pieces, moved)


def _check_heading_unit(columns: TrajectoryColumns, name: str, pieces: Int64Array, moved: FloatArray) -> None:
    """Refuse headings in radians: none exceeds 6.3, and as radians, but not as degrees, they agree with the course."""
    fast = np.hypot(*moved[:, :2].T) > COURSE_FROM_MPS
    if columns.angles_in == "radians" or not fast.any() or np.degrees(np.abs(columns.heading_rad)).max() > 2 * np.pi:
        return
    course, nose = np.arctan2(moved[:, 1], moved[:, 0])[fast], columns.heading_rad[pieces[:, 0]][fast]
    off, off_as_radians = (np.median(np.abs(_folded(course - heading))) for heading in (nose, np.degrees(nose)))
    if off > HEADING_OFF_RAD > off_as_radians:
        raise TrajectoryError(f"{name}: degrees are expected; roll, pitch and heading look like radians")


CHECKS = (
    _check_finite,
    _check_sigmas,
    _check_velocity,
    _check_position,
    _check_attitude,
    _check_time,
    _check_course,
)


# --- pieces of flight ---


def course_pieces(time_ns: Int64Array) -> Int64Array:
    """Return (k, 2) rows at the ends of pieces of about a second, none of which spans a gap."""
    begun = np.unique((time_ns - time_ns[0]) // COURSE_PIECE_NS, return_index=True)[1]
    rows = np.unique(np.r_[begun, len(time_ns) - 1])
    pieces = np.stack([rows[:-1], rows[1:]], axis=1)
    short: Int64Array = pieces[np.diff(time_ns[rows]) <= LONGEST_PIECE_NS]
    return short


def moved_l(
    time_ns: Int64Array, lat_rad: FloatArray, lon_rad: FloatArray, height_m: FloatArray, pieces: Int64Array
) -> FloatArray:
    """Return (k, 3) mean velocity of each piece by its positions, north, east, down at its middle, m/s."""
    begin, end = pieces[:, 0], pieces[:, 1]
    places_e = [e_from_geodetic(lat_rad[rows], lon_rad[rows], height_m[rows]) for rows in (begin, end)]
    lat = (lat_rad[begin] + lat_rad[end]) / 2
    lon = lon_rad[begin] + _folded(lon_rad[end] - lon_rad[begin]) / 2
    q_e_from_l = product(about(2, lon), about(1, -lat - np.pi / 2))
    length_s = np.diff(time_ns[pieces], axis=1) / SECOND_NS
    moved: FloatArray = rotated(conjugate(q_e_from_l), places_e[1] - places_e[0]) / length_s
    return moved


def mean_over(time_ns: Int64Array, values: FloatArray, pieces: Int64Array) -> FloatArray:
    """Return (k, 3) mean of values (n, 3), linear between rows, over each piece; nan where a row of it has none."""
    steps = np.diff(time_ns)[:, np.newaxis] / SECOND_NS * (values[1:] + values[:-1]) / 2
    unsaid = np.isnan(steps)

    def over(columns: NDArray[Any]) -> NDArray[Any]:
        since = np.concatenate([np.zeros((1, 3), columns.dtype), np.cumsum(columns, axis=0)])
        return np.asarray(since[pieces[:, 1]] - since[pieces[:, 0]])

    length_s = np.diff(time_ns[pieces], axis=1) / SECOND_NS
    mean: FloatArray = np.where(
        over(unsaid.astype(np.int64)) > 0, np.nan, over(np.where(unsaid, 0.0, steps)) / length_s
    )
    return mean


def _course_error(moved: FloatArray, said: FloatArray) -> FloatArray:
    return _folded(np.arctan2(moved[:, 1], moved[:, 0]) - np.arctan2(said[:, 1], said[:, 0]))


def _folded(angle_rad: FloatArray) -> FloatArray:
    folded: FloatArray = (angle_rad + np.pi) % (2 * np.pi) - np.pi
    return folded
