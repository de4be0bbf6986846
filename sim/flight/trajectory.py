"""The flown trajectory of the virtual aircraft: position and attitude of its body and their derivatives, at any time.

It is one quintic spline through positions and quaternions at even knots, four times continuously differentiable.
Everything else follows from it exactly: velocity and acceleration as its derivatives, the angular rate from
ω = 2 q* ⊗ q̇ of the normalised quaternion (J. Diebel, "Representing attitude", Stanford 2006, Eq. 156).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from scipy.spatial.transform import Rotation

from swath.georef.arrays import FloatArray, Int64Array
from swath.sim.flight.envelope import Envelope, Ground, refuse_lines
from swath.sim.flight.itinerary import route_of
from swath.sim.flight.route import Route
from swath.sim.flight.smoothing import STEP_S, smoothed, spline_through
from swath.sim.flight.turbulence import angles_rad, displacement_m
from swath.sim.gravity import RATE_IE_E, gravity_e
from swath.sim.plan.plan import Plan
from swath.sim.plan.tables import FlightTable, Tables
from swath.sim.site import Site, geodetic_from_e, rot_e_from_ned

_ROLLING_MPS = 1.0  # at lower speed the runway gives the heading


BEYOND_S = 5.0  # the trajectory extends this far before its start and after its end
_GUARD = 8  # knots that two successive splines lose at either end


@dataclass(frozen=True, slots=True)
class FlownLine:
    """A flight line as it was flown, without leads.

    Attributes:
        index: its index in the plan.
        name: its name.
        start_s, end_s: times at which it begins and ends.
    """

    index: int
    name: str
    start_s: float
    end_s: float


@dataclass(frozen=True, slots=True)
class Poses:
    """Positions and attitudes of the body: ``position_e`` (n, 3) metres ECEF, ``rot_e_from_b`` (n, 3, 3)."""

    position_e: FloatArray
    rot_e_from_b: FloatArray


@dataclass(frozen=True, slots=True)
class Motion:
    """Motion of the body relative to the earth.

    Attributes:
        position_e, velocity_e, acceleration_e: (n, 3) metres and seconds, ECEF.
        rot_e_from_b: (n, 3, 3).
        rate_eb_b: (n, 3) rotation of b against e, rad/s, in b.
    """

    position_e: FloatArray
    velocity_e: FloatArray
    acceleration_e: FloatArray
    rot_e_from_b: FloatArray
    rate_eb_b: FloatArray


class Trajectory:
    """A flight from 0 to ``end_s``, in seconds since the plan's start.

    The trajectory extends `BEYOND_S` beyond either end and is nan farther out.

    Args:
        spline: columns 0 to 2 are the position in e less ``origin_e``, columns 3 to 6 the quaternion of e from b (x, y,
            z, w), of any length.
        origin_e: (3,) origin of the site.
        lines: flown lines in order of time.
        end_s: end of the last line's lead.
    """

    def __init__(self, spline: BSpline, origin_e: FloatArray, lines: tuple[FlownLine, ...], end_s: float) -> None:
        self.lines, self.end_s = lines, end_s
        self._origin_e = origin_e
        self._spline = spline
        self._first = spline.derivative(1)
        self._second = BSpline(spline.t, spline.c[:, :3], spline.k, extrapolate=False).derivative(2)
        self._bounds_s = np.array([[line.start_s, line.end_s] for line in lines]).ravel()

    def poses(self, time_s: FloatArray) -> Poses:
        """Return positions and attitudes at times (n,)."""
        values = self._spline(time_s)
        return Poses(values[:, :3] + self._origin_e, _matrices(values[:, 3:]))

    def motion(self, time_s: FloatArray) -> Motion:
        """Return positions, attitudes and their derivatives at times (n,)."""
        values, slopes = self._spline(time_s), self._first(time_s)
        quaternion, change = values[:, 3:], slopes[:, 3:]
        vector, scalar = quaternion[:, :3], quaternion[:, 3:]
        rate = scalar * change[:, :3] - change[:, 3:] * vector - np.cross(vector, change[:, :3])
        rate *= 2.0 / np.sum(quaternion**2, axis=1, keepdims=True)
        return Motion(values[:, :3] + self._origin_e, slopes[:, :3], self._second(time_s), _matrices(quaternion), rate)

    def line_at(self, time_s: FloatArray) -> NDArray[np.int16]:
        """Return (n,) the index of the line flown at each time; −1 off the lines."""
        place = np.searchsorted(self._bounds_s, time_s, side="right")
        indices = np.array([line.index for line in self.lines], np.int16)
        return np.where(place % 2 == 1, indices[np.minimum(place // 2, len(indices) - 1)], np.int16(-1))

    def geodetic(self, time_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return latitude, longitude (radians) and ellipsoidal height at times (n,), (n,) each."""
        return geodetic_from_e(self._spline(time_s)[:, :3] + self._origin_e)

    def attitude(self, time_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return roll, pitch and heading (0 … 2π) against north, east and down there, radians, (n,) each."""
        poses = self.poses(time_s)
        lat_rad, lon_rad, _ = geodetic_from_e(poses.position_e)
        rot_l_from_b = np.swapaxes(rot_e_from_ned(lat_rad, lon_rad), 1, 2) @ poses.rot_e_from_b
        roll = np.arctan2(rot_l_from_b[:, 2, 1], rot_l_from_b[:, 2, 2])
        pitch = -np.arcsin(np.clip(rot_l_from_b[:, 2, 0], -1.0, 1.0))
        return roll, pitch, np.arctan2(rot_l_from_b[:, 1, 0], rot_l_from_b[:, 0, 0]) % (2.0 * np.pi)

    def velocity_l(self, time_s: FloatArray) -> FloatArray:
        """Return (n, 3) velocities north, east, down, m/s."""
        lat_rad, lon_rad, _ = self.geodetic(time_s)
        velocity: FloatArray = np.einsum("nji,nj->ni", rot_e_from_ned(lat_rad, lon_rad), self._first(time_s)[:, :3])
        return velocity


def fly(plan: Plan, site: Site, ground_m: Ground) -> Trajectory:
    """Fly the plan's lines in order.

    Args:
        plan: of the flight.
        site: site frame at the plan's origin.
        ground_m: function from (east_m, north_m), (n,) each, to ellipsoidal heights (n,); called along lines and at the
            runway.

    Raises:
        PlanError: the plan cannot be flown.
    """
    tables = plan.tables
    refuse_lines(tables, ground_m)
    envelope = Envelope.of(tables)
    route = route_of(tables, envelope, ground_m)
    end_s = float(route.starts_s[-1])
    knots = np.arange(math.floor(-BEYOND_S / STEP_S) - _GUARD, math.ceil((end_s + BEYOND_S) / STEP_S) + _GUARD + 1)
    path = _smooth_path(route, envelope, knots)
    values = _values(path, tables, site, int(knots[0]))
    if tables.ground is not None:  # bit-equal at rest: libraries may treat neighbours in an array differently
        still = ~np.any(path[4:-4, :3] - path[0, :3], axis=1)
        values[still] = values[0]
    lines = tuple(
        FlownLine(leg.line, tables.line[leg.line].name, float(start_s), float(start_s) + leg.duration_s)
        for leg, start_s in zip(route.legs, route.starts_s, strict=False)
        if leg.line >= 0
    )
    return Trajectory(spline_through(int(knots[4]), values), site.origin_e, lines, end_s)


def _smooth_path(route: Route, envelope: Envelope, knots: Int64Array) -> FloatArray:
    """Return (n, 4) smooth east, north, height, airborne at knots (n,).

    Where the aircraft stands, values are equal to the last bit: they are taken relative to the first place, so that
    sums of zeros are zero.
    """
    half, climb_half = (int(s / STEP_S) for s in (envelope.smoothing_s, envelope.climb_smoothing_s))
    raw = route.sample(STEP_S * np.arange(knots[0] - climb_half, knots[-1] + climb_half + 1))
    first = raw[0].copy()
    columns = [
        smoothed(column, wide, climb_half)
        for column, wide in zip((raw - first).T, (half, half, climb_half, half), strict=True)
    ]
    path: FloatArray = np.stack(columns, axis=-1) + first
    return path


def _values(path: FloatArray, tables: Tables, site: Site, first: int) -> FloatArray:
    """Return (n − 8, 7) positions less the site's origin, and quaternions, at all knots but four at either end.

    The attitude is that of the path in still air; turbulence then moves both.
    """
    flight, inner = tables.flight, slice(4, -4)
    quiet = spline_through(first, _relative_e(path[:, :3], site))
    time_s = STEP_S * np.arange(first + 4, first + len(path) - 4)
    airborne = path[inner, 3]
    heading = math.radians(tables.ground.heading_deg) if tables.ground else 0.0
    runway_e = np.array([math.sin(heading), math.cos(heading), 0.0]) @ site.rot_site_from_e
    motion_e = quiet(time_s) + site.origin_e, quiet(time_s, 1), quiet(time_s, 2)
    attitude = coordinated(motion_e, runway_e, airborne, flight)
    attitude += airborne[:, np.newaxis] * angles_rad(flight.turbulence, flight.seed, len(airborne))
    shaken = path[inner, :3] + airborne[:, np.newaxis] * displacement_m(flight.turbulence, flight.seed, len(airborne))
    relative_e = _relative_e(shaken, site)
    return np.concatenate([relative_e, quaternions_e_from_b(relative_e + site.origin_e, attitude)], axis=1)


def _relative_e(points: FloatArray, site: Site) -> FloatArray:
    """Return (n, 3) ECEF less the site's origin for east, north and ellipsoidal height (n, 3)."""
    relative: FloatArray = site.site_from_ground(points[:, 0], points[:, 1], points[:, 2]) @ site.rot_site_from_e
    return relative


def _matrices(quaternion: FloatArray) -> FloatArray:
    """Return (n, 3, 3) rotation matrices of quaternions (n, 4), x, y, z, w, of any length."""
    x, y, z, w = (quaternion * np.sqrt(2.0 / np.sum(quaternion**2, axis=1, keepdims=True))).T
    matrices = np.empty((len(quaternion), 3, 3))
    matrices[:, 0, 0], matrices[:, 0, 1], matrices[:, 0, 2] = 1.0 - y * y - z * z, x * y - z * w, x * z + y * w
    matrices[:, 1, 0], matrices[:, 1, 1], matrices[:, 1, 2] = x * y + z * w, 1.0 - x * x - z * z, y * z - x * w
    matrices[:, 2, 0], matrices[:, 2, 1], matrices[:, 2, 2] = x * z - y * w, y * z + x * w, 1.0 - x * x - y * y
    return matrices


def coordinated(
    motion_e: tuple[FloatArray, FloatArray, FloatArray], runway_e: FloatArray, airborne: FloatArray, flight: FlightTable
) -> FloatArray:
    """Return (n, 3) roll, pitch and heading of coordinated flight, radians.

    The nose points along the air's velocity in the level plane and ``pitch_deg`` above the path. The roll is the one at
    which the specific force (acceleration in inertial space less gravity) has no sideways component. On the ground the
    wings and the nose are level and the wheels hold the course.

    Args:
        motion_e: position, velocity and acceleration, (n, 3) each, ECEF.
        runway_e: (3,) direction of the runway.
        airborne: (n,) 0 on the ground, 1 in the air, in between at take-off.
        flight: the plan's table.
    """
    position_e, velocity_e, acceleration_e = motion_e
    lat_rad, lon_rad, _ = geodetic_from_e(position_e)
    rot_e_from_l = rot_e_from_ned(lat_rad, lon_rad)
    force_e = acceleration_e + 2.0 * np.cross(RATE_IE_E, velocity_e) - gravity_e(position_e)
    velocity_l, force_l = (np.einsum("nji,nj->ni", rot_e_from_l, vector) for vector in (velocity_e, force_e))
    runway_l = np.einsum("nji,j->ni", rot_e_from_l, runway_e)
    air = velocity_l[:, :2] - airborne[:, np.newaxis] * np.array([flight.wind_mps[1], flight.wind_mps[0]])
    speed_mps = np.hypot(velocity_l[:, 0], velocity_l[:, 1])
    nose = np.where(speed_mps[:, np.newaxis] > _ROLLING_MPS, air, runway_l[:, :2])
    heading = np.arctan2(nose[:, 1], nose[:, 0])
    pitch = airborne * (np.arctan2(-velocity_l[:, 2], speed_mps) + math.radians(flight.pitch_deg))
    forward = force_l[:, 0] * np.cos(heading) + force_l[:, 1] * np.sin(heading)
    right = force_l[:, 1] * np.cos(heading) - force_l[:, 0] * np.sin(heading)
    down = np.sin(pitch) * forward + np.cos(pitch) * force_l[:, 2]
    return np.stack([airborne * np.arctan2(right, -down), pitch, heading], axis=-1)


def quaternions_e_from_b(position_e: FloatArray, angles_rad: FloatArray) -> FloatArray:
    """Return (n, 4) quaternions x, y, z, w of roll, pitch, heading (n, 3) at places (n, 3), without changes of sign."""
    lat_rad, lon_rad, _ = geodetic_from_e(position_e)
    rot_e_from_l = Rotation.from_matrix(rot_e_from_ned(lat_rad, lon_rad))
    turned = rot_e_from_l * Rotation.from_euler("ZYX", angles_rad[:, ::-1])
    quaternions: FloatArray = turned.as_quat()
    flips = np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0.0
    quaternions[1:][np.cumsum(flips) % 2 == 1] *= -1.0
    return quaternions
