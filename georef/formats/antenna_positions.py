"""Read post-processed antenna positions as observations for navigation: RTKLIB .pos and Waypoint text."""

from __future__ import annotations

import numpy as np

from swath.georef.formats.rtklib_pos import is_rtklib_pos, read_rtklib_pos
from swath.georef.formats.trajectory.columns import Span, TrajectoryColumns, trajectory_of
from swath.georef.formats.trajectory.csv import is_csv
from swath.georef.formats.waypoint import is_waypoint, read_waypoint
from swath.georef.text_encoding import decoded
from swath.georef.trajectory.trajectory import DEFAULT_MAX_GAP_NS, TrajectoryError


def read_antenna_positions(
    data: bytes, name: str, *, span_ns: Span | None = None, week: int | None = None, leap_seconds: int | None = None
) -> TrajectoryColumns:
    """Return rows of a file of positions, with sigmas, fix types and velocities as far as the file gives them.

    Args:
        data: the file's bytes.
        name: for messages.
        span_ns: GPS time of the log's first and last record, which gives the week of a file without one.
        week: GPS week of the first row; takes precedence over span_ns.
        leap_seconds: GPS − UTC as the log knows it, for files in UTC.

    Raises:
        TrajectoryError: one line that names the fault; a file with attitudes is not of an antenna.
    """
    text = decoded(data, "replace")
    if is_rtklib_pos(text):
        columns = read_rtklib_pos(text, name, leap_seconds=leap_seconds)
    elif is_waypoint(text):
        columns = read_waypoint(text, name, span_ns=span_ns, week=week, leap_seconds=leap_seconds)
    elif is_csv(text):
        raise TrajectoryError(_finished(name))
    else:
        raise TrajectoryError(f"{name}: is not a file of antenna positions; give RTKLIB .pos or Waypoint text")
    if np.isfinite(columns.roll_rad).any():
        raise TrajectoryError(_finished(name))
    trajectory_of(columns, name, DEFAULT_MAX_GAP_NS)  # refuses rows that cannot be valid
    return columns


def _finished(name: str) -> str:
    return f"{name}: has attitudes, so it is a finished trajectory; give a file of GNSS positions alone"
