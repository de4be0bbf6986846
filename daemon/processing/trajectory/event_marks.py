"""Lists event marks of a log (camera triggers) with the body's pose at their time; marks without a
pose have a row too.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from swath.daemon.processing.navigation.inputs import Mark
from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.points import Fate
from swath.georef.trajectory.trajectory import Trajectory

HEADER = (
    "source,channel,edge,count,gps_ns,lat_deg,lon_deg,height_m,roll_deg,pitch_deg,heading_deg,sigma_n_m,sigma_e_m,"
    "sigma_d_m,sigma_roll_deg,sigma_pitch_deg,sigma_heading_deg,sigma_time_s,fate"
)
EDGES = {True: "rising", False: "falling", None: ""}
PLACED = "placed"
FATES = {
    Fate.GEOREFERENCED: PLACED,
    Fate.OUTSIDE_TRAJECTORY: "outside the trajectory",
    Fate.TRAJECTORY_GAP: "in a gap of the trajectory",
}
NUMBERS = (11, 11, 4, 6, 6, 6, 4, 4, 4, 6, 6, 6)  # decimals, from latitude to sigma of heading
NOTHING = "," * (len(NUMBERS) - 1)


@dataclass(frozen=True, slots=True)
class EventTable:
    """Event marks as a CSV file.

    Attributes:
        text: header and one line per mark, in the order of their arrival.
        fates: number of marks by fate.
    """

    text: str
    fates: Counter[str]


def event_table(marks: Sequence[Mark], trajectory: Trajectory) -> EventTable:
    """Return position (of the body's origin), attitude and sigmas of marks.

    A mark's own sigma of time enters the sigmas of the position through the velocity.
    """
    timed = np.array([mark.gps_ns for mark in marks if mark.gps_ns is not None], np.int64)
    fates = trajectory.fates(timed) if len(timed) else np.empty(0, np.uint8)
    inside = np.unique(timed[fates == Fate.GEOREFERENCED])
    numbers = dict(zip(inside.tolist(), _poses(trajectory, inside), strict=True))
    of_timed = iter(fates.tolist())
    lines, counts = [HEADER], Counter[str]()
    for mark in marks:
        fate = _untimed(mark) if mark.gps_ns is None else FATES[Fate(next(of_timed))]
        counts[fate] += 1
        row = numbers.get(mark.gps_ns) if mark.gps_ns is not None else None
        lines.append(_line(mark, row, fate))
    return EventTable("\n".join([*lines, ""]), counts)


def _untimed(mark: Mark) -> str:
    return (
        "the receiver does not vouch for its time"
        if not mark.event.valid
        else "its time cannot be converted to GPS time"
    )


def _line(mark: Mark, row: FloatArray | None, fate: str) -> str:
    event = mark.event
    sigma_s = event.sigma_s if event.sigma_s is not None and np.isfinite(event.sigma_s) else None
    pose = NOTHING
    if row is not None:
        values = row[:12].copy()
        along_m = row[12:15] * (sigma_s or 0.0)
        values[6:9] = np.hypot(values[6:9], along_m)
        words = (
            f"{value:.{digits}f}" if np.isfinite(value) else "" for value, digits in zip(values, NUMBERS, strict=True)
        )
        pose = ",".join(words)
    fields = (
        mark.source,
        event.channel,
        EDGES[event.rising],
        "" if event.count is None else str(event.count),
        "" if mark.gps_ns is None else str(mark.gps_ns),
        pose,
        "" if sigma_s is None else f"{sigma_s:.3e}",
        fate,
    )
    return ",".join(fields)


def _poses(trajectory: Trajectory, time_ns: Int64Array) -> FloatArray:
    """Return (n, 15): latitude to sigma of heading as in the file, then velocity north, east, down, m/s."""
    if not len(time_ns):
        return np.empty((0, 15))
    poses = trajectory.poses(time_ns)
    at = replace(
        trajectory,
        time_ns=time_ns,
        position_e=poses.position_e,
        q_e_from_b=poses.q_e_from_b,
        velocity_e=poses.velocity_e,
        position_sigma_l=poses.position_sigma_l,
        attitude_sigma_rad=poses.attitude_sigma_rad,
    )
    lat, lon, height = at.geodetic()
    angles = np.degrees(np.stack(at.attitude(), axis=1))
    sigmas = np.concatenate([at.position_sigma_l, np.degrees(at.attitude_sigma_rad)], axis=1)
    place = np.stack([np.degrees(lat), np.degrees(lon), height], axis=1)
    return np.concatenate([place, angles, sigmas, at.velocity_l()], axis=1)
