"""Whether a device's own INS tells the way of the body or of another point, as of its antenna."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from swath.georef.arrays import FloatArray
from swath.georef.geodesy.quaternions import conjugate, rotated
from swath.georef.points import Fate
from swath.georef.trajectory.trajectory import Trajectory

FEWEST = 20  # solutions to compare
STEP_NS = 1_000_000_000
APART_M = 0.2  # from where on another point is meant
STEADY = 0.5  # scatter of the offset in b, over its length, beyond which it is no point of the body
NEAR = 0.3  # of the lever arm: so near to the antenna it is the antenna


def offset_in_b(ins: Trajectory, navigated: Trajectory) -> tuple[FloatArray, FloatArray] | None:
    """Median and scatter (3,) of where an INS's point is, from the body's origin in b, m; None: too few to tell."""
    _, first = np.unique(ins.time_ns // STEP_NS, return_index=True)
    first = first[navigated.fates(ins.time_ns[first]) == Fate.GEOREFERENCED]
    if len(first) < FEWEST:
        return None
    poses = navigated.poses(ins.time_ns[first])
    apart_b = rotated(conjugate(poses.q_e_from_b), ins.position_e[first] - poses.position_e)
    middle: FloatArray = np.median(apart_b, axis=0)
    scatter: FloatArray = 1.4826 * np.median(np.abs(apart_b - middle), axis=0)
    return middle, scatter


def point_doubts(ins: Trajectory, navigated: Trajectory, lever_arms_b: Sequence[FloatArray], source: str) -> list[str]:
    """A line where the INS's point is not the body's origin, and which it seems to be."""
    found = offset_in_b(ins, navigated)
    if found is None:
        return []
    offset, scatter = found
    length_m = float(np.linalg.norm(offset))
    if length_m < APART_M or float(np.linalg.norm(scatter)) > STEADY * length_m:
        return []
    place = ", ".join(f"{value:.2f}" for value in offset)
    what, point = "another point than the IMU", place.replace(" ", "")
    for arm in lever_arms_b:
        length = float(np.linalg.norm(arm))
        if length > APART_M and float(np.linalg.norm(offset - arm)) < NEAR * length:
            what, point = "its antenna", "antenna"
            break
    return [
        f"{source}: its own INS tells the way of {what}, {length_m:.2f} m from the body's origin ({place} m in b); "
        f"with that solution want --trajectory-at {point}, or the receiver set to give it at the IMU"
    ]
