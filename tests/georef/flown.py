"""Makes a flight in closed form, for trajectory files: its velocities are the derivatives of its positions."""

from __future__ import annotations

from typing import Any

import numpy as np

from swath.georef.arrays import FloatArray
from swath.georef.trajectory.trajectory import Trajectory

WEEK, SECOND = 2445, 561_618
START_NS = (WEEK * 604_800 + SECOND) * 1_000_000_000
LAT, LON = np.radians(47.5), np.radians(8.9)


def flown(
    n: int = 600, step_s: float = 0.05, start_ns: int = START_NS, course_deg: float = 70.0, **changes: Any
) -> Trajectory:
    """Return a trajectory of n epochs in S-turns at 60 m/s, climbing, with 4° of drift."""
    t = step_s * np.arange(n, dtype=np.float64)
    columns = path(t, np.radians(course_deg))
    columns["time_ns"] = start_ns + np.rint(t * 1e9).astype(np.int64)
    columns["position_sigma_l"] = np.stack([0.02 + 0.001 * t, 0.03 + 0.001 * t, 0.04 + 0 * t], axis=1)
    columns["attitude_sigma_rad"] = np.radians(np.stack([0.005 + 0 * t, 0.006 + 0 * t, 0.02 + 0.0001 * t], axis=1))
    return Trajectory.from_geodetic(**(columns | changes))


def path(t: FloatArray, course_rad: float) -> dict[str, Any]:
    """Return the trajectory's columns by time, with metres converted to angles by the textbook's radii of curvature."""
    e2 = 0.00669437999014132
    w2 = 1 - e2 * np.sin(LAT) ** 2
    meridian_m, parallel_m = 6378137 * (1 - e2) / w2**1.5 + 900, (6378137 / np.sqrt(w2) + 900) * np.cos(LAT)
    swing = 0.25 * np.sin(t / 4)
    ahead, aside = 60 * t, 160 * np.sin(t / 7)
    v_ahead, v_aside = np.full(len(t), 60.0), 160 / 7 * np.cos(t / 7)
    cos, sin = np.cos(course_rad), np.sin(course_rad)
    north, east = cos * ahead - sin * aside, sin * ahead + cos * aside
    velocity = np.stack([cos * v_ahead - sin * v_aside, sin * v_ahead + cos * v_aside, np.full(len(t), -1.5)], axis=1)
    return {
        "lat_rad": LAT + north / meridian_m,
        "lon_rad": LON + east / parallel_m,
        "height_m": 900 + 1.5 * t,
        "velocity_l": velocity,
        "roll_rad": swing,
        "pitch_rad": 0.05 + 0.02 * np.cos(t / 3),
        "heading_rad": (np.arctan2(velocity[:, 1], velocity[:, 0]) + np.radians(4)) % (2 * np.pi),
    }
