"""Provides trajectories in closed form, for tests of what is measured on them."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, cast

import numpy as np
from scipy.spatial.transform import Rotation

from swath.georef.arrays import FloatArray
from swath.sim.flight.trajectory import Motion, fly
from swath.sim.plan.plan import Plan, parse_plan
from swath.sim.site import Site, e_from_geodetic, rot_e_from_ned

if TYPE_CHECKING:
    from pathlib import Path

    from swath.sim.flight.trajectory import Trajectory


# More than ten minutes: lines, turns to either side between them, and climbs, in rough air.
ROUGH_PLAN = """
[flight]
name = "rough"
turbulence = "severe"
bank_max_deg = 30.0
wind_mps = [6.0, -4.0]

[[line]]
name = "a"
from_m = [-3000.0, 0.0]
to_m = [3000.0, 0.0]
height_m = 1200.0

[[line]]
name = "b"
from_m = [3000.0, 800.0]
to_m = [-3000.0, 800.0]
height_m = 1400.0

[[line]]
name = "c"
from_m = [0.0, 3000.0]
to_m = [0.0, -3000.0]
height_m = 1250.0

[[line]]
name = "d"
from_m = [-2000.0, -2000.0]
to_m = [2000.0, 2000.0]
height_m = 1300.0
"""


class Moving:
    """A trajectory given by a function of time; stands in for `swath.sim.flight.trajectory.Trajectory`."""

    def __init__(self, end_s: float, motion: Callable[[FloatArray], Motion]) -> None:
        self.end_s, self.motion = end_s, motion


def standing(
    end_s: float, lat_deg: float = 47.5, height_m: float = 0.0, *, attitude_deg: tuple[float, float, float] = (0, 0, 0)
) -> Trajectory:
    """Return a body at rest on the earth, at a longitude of 8.5°; `attitude_deg` is heading, pitch and roll."""
    lat, lon, height = np.radians([lat_deg]), np.radians([8.5]), np.array([height_m])
    position_e = e_from_geodetic(lat, lon, height)
    body = Rotation.from_matrix(rot_e_from_ned(lat, lon)[0]) * Rotation.from_euler("ZYX", attitude_deg, degrees=True)

    def motion(time_s: FloatArray) -> Motion:
        many, still = len(time_s), np.zeros((len(time_s), 3))
        return Motion(np.repeat(position_e, many, 0), still, still, np.tile(body.as_matrix(), (many, 1, 1)), still)

    return cast("Trajectory", Moving(end_s, motion))


def circling_the_pole(end_s: float, radius_m: float, turn_radps: float, z_m: float) -> Trajectory:
    """Return a flight eastward around the north pole, wings level: x along the path, y outward, z down.

    Down is along the earth's axis, towards the equator's plane.
    """

    def motion(time_s: FloatArray) -> Motion:
        angle, zero = turn_radps * time_s, np.zeros(len(time_s))
        outward = np.stack([np.cos(angle), np.sin(angle), zero], axis=1)
        east = np.stack([-np.sin(angle), np.cos(angle), zero], axis=1)
        down = np.broadcast_to([0.0, 0.0, -1.0], east.shape)
        return Motion(
            position_e=radius_m * outward + [0.0, 0.0, z_m],
            velocity_e=radius_m * turn_radps * east,
            acceleration_e=-radius_m * turn_radps**2 * outward,
            rot_e_from_b=np.stack([east, outward, down], axis=2),
            rate_eb_b=np.broadcast_to([0.0, 0.0, -turn_radps], east.shape),
        )

    return cast("Trajectory", Moving(end_s, motion))


def rough_flight(folder: Path) -> Trajectory:
    """Return the flight of the plan above over a plain."""
    plan: Plan = parse_plan(ROUGH_PLAN, folder)
    site = Site.at(*plan.tables.flight.origin_deg)
    return fly(plan, site, lambda east_m, north_m: np.full(np.shape(east_m), 450.0))
