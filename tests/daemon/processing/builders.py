"""Corrections and true trajectories that tests of the processing use."""

from __future__ import annotations

import numpy as np

from swath.georef.geodesy.rotations import quaternion_from_rot
from swath.georef.trajectory.trajectory import Trajectory
from tests.builders import Flown

STEP_S = 5e-4  # between such epochs of the true trajectory, a slerp is exact to a micrometre
IBRC = {"intensity": [0.0, 500.0, 2000.0, 65535.0], "correction_m": [0.02, 0.01, -0.005, -0.03]}


def true_trajectory(flown: Flown) -> Trajectory:
    """Return the true trajectory of the body, from SciPy's splines at small steps."""
    track = flown.track()
    time_s = np.linspace(track.time_s[0], track.time_s[-1], round((track.time_s[-1] - track.time_s[0]) / STEP_S) + 1)
    position_e, rotation = track.poses(time_s)
    q_e_from_b = quaternion_from_rot(rotation)
    turns = np.where((q_e_from_b[1:] * q_e_from_b[:-1]).sum(axis=1) < 0, -1.0, 1.0)
    q_e_from_b[1:] *= np.cumprod(turns)[:, np.newaxis]
    unsaid = np.full((len(time_s), 3), np.nan)
    time_ns = flown.plan.start_gps_ns + np.rint(time_s * 1e9).astype(np.int64)
    return Trajectory(time_ns, position_e, q_e_from_b, unsaid, unsaid, unsaid)
