"""Read trajectory files of every kind, recognised by their content."""

from __future__ import annotations

import numpy as np

from swath.georef.formats.rtklib_pos import is_rtklib_pos, read_rtklib_pos
from swath.georef.formats.sbet import SBET_BYTES, SMRMSG_BYTES, Sigmas, read_sbet, read_smrmsg
from swath.georef.formats.trajectory.columns import Span, TrajectoryColumns, trajectory_of
from swath.georef.formats.trajectory.csv import is_csv, read_csv
from swath.georef.formats.waypoint import is_waypoint, read_waypoint
from swath.georef.text_encoding import decoded, encoding_of
from swath.georef.timescales.gps_time import SECOND_NS
from swath.georef.trajectory.trajectory import DEFAULT_MAX_GAP_NS, Trajectory, TrajectoryError

LOOKED_AT = 65_536  # bytes examined to distinguish text from binary numbers


def read_trajectory(
    data: bytes,
    name: str,
    *,
    span_ns: Span | None = None,
    week: int | None = None,
    leap_seconds: int | None = None,
    smrmsg: bytes | None = None,
    max_gap_ns: int = DEFAULT_MAX_GAP_NS,
    needs_attitude: bool = True,
) -> Trajectory:
    """Return the trajectory in a file: SBET, Waypoint text, RTKLIB .pos or trajectory CSV.

    Args:
        data: the file's bytes.
        name: for messages, and of the trajectory.
        span_ns: GPS time of the first and last record of its log, which gives the week of a file without one.
        week: GPS week of the file's first record; takes precedence over span_ns.
        leap_seconds: GPS − UTC as the log knows it, for files in UTC.
        smrmsg: the sigmas that came with an SBET.
        max_gap_ns: longer intervals are gaps.
        needs_attitude: whether to refuse positions without attitude.

    Raises:
        TrajectoryError: one line that names the fault.
    """
    text = _text_of(data)
    if text is None:
        sigmas = None if smrmsg is None else read_smrmsg(smrmsg, f"smrmsg of {name}")
        columns = _sbet(data, name, span_ns, week, sigmas)
    elif is_csv(text):
        columns = read_csv(text, name)
    elif is_rtklib_pos(text):
        columns = read_rtklib_pos(text, name, leap_seconds=leap_seconds)
    elif is_waypoint(text):
        columns = read_waypoint(text, name, span_ns=span_ns, week=week, leap_seconds=leap_seconds)
    else:
        raise TrajectoryError(f"{name}: is not a trajectory; give SBET, Waypoint text, RTKLIB .pos or trajectory CSV")
    trajectory = trajectory_of(columns, name, max_gap_ns)
    if needs_attitude:
        trajectory.require_attitude()
        _refuse_sparse(trajectory)
    return trajectory


def _refuse_sparse(trajectory: Trajectory) -> None:
    """Refuse a trajectory that consists of gaps alone with `TrajectoryError`."""
    step_ns = int(np.median(np.diff(trajectory.time_ns)))
    if step_ns > trajectory.max_gap_ns:
        raise TrajectoryError(
            f"{trajectory.name}: its epochs are {step_ns / SECOND_NS:.3f} s apart, and epochs more than "
            f"{trajectory.max_gap_ns / SECOND_NS:.3f} s apart count as a gap: export it at 10 Hz or more"
        )


def _text_of(data: bytes) -> str | None:
    """Return the text, or None for binary numbers."""
    if encoding_of(data[:4]) != "utf-8-sig":
        return decoded(data, "replace")
    head = data[:LOOKED_AT]
    if not data or any(byte < 9 or 13 < byte < 32 for byte in head):
        return None
    return decoded(data, "replace")


def _sbet(data: bytes, name: str, span_ns: Span | None, week: int | None, sigmas: Sigmas | None) -> TrajectoryColumns:
    """Return the rows of an SBET; a message names an smrmsg given in its place."""
    if len(data) % SBET_BYTES and data and not len(data) % SMRMSG_BYTES:
        try:
            read_smrmsg(data, name)
        except TrajectoryError:
            pass
        else:
            raise TrajectoryError(
                f"{name}: is an smrmsg, which has the sigmas of a trajectory; give the SBET (sbet_….out)"
            )
    return read_sbet(data, name, span_ns=span_ns, week=week, sigmas=sigmas)
