"""Provides a body that circles, climbs and banks in closed form, without code of the simulator."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pyproj import Transformer
from scipy.spatial.transform import Rotation

from swath.georef.arrays import FloatArray

LAT_DEG, LON_DEG, HEIGHT_M = 47.5, 8.9, 900.0
RADIUS_M, RATE_RAD_S = 600.0, 0.1  # 60 m/s
TO_E = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
TO_GEODETIC = Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
STEP_S = 0.02


@dataclass(frozen=True)
class Motion:
    """The motion that a receiver needs from a trajectory."""

    position_e: FloatArray
    velocity_e: FloatArray
    rot_e_from_b: FloatArray
    rate_eb_b: FloatArray


def geodetic(points_e: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return latitude, longitude (rad) and ellipsoidal height (m) of points (n, 3) in e, m."""
    lon, lat, height = TO_GEODETIC.transform(points_e[:, 0], points_e[:, 1], points_e[:, 2])
    return np.radians(lat), np.radians(lon), np.asarray(height)


def ned_from_e(lat_rad: FloatArray, lon_rad: FloatArray) -> Rotation:
    """Return rotations from e to the local level: about z by the longitude, then about y.

    After the second turn z points down the ellipsoid's normal.
    """
    turns = np.stack([lon_rad, -lat_rad - np.pi / 2], axis=-1)
    return Rotation.from_euler("ZY", turns).inv()


def derivative(function: object, time_s: FloatArray) -> FloatArray:
    """Return the derivative (n,) → (n, k) by five points, with an error of fourth order."""
    assert callable(function)
    one = function(time_s + STEP_S) - function(time_s - STEP_S)
    two = function(time_s + 2 * STEP_S) - function(time_s - 2 * STEP_S)
    return np.asarray((8 * one - two) / (12 * STEP_S))


class Circling:
    """Circles to the right around the site at 60 m/s.

    Args:
        level: True if roll and pitch are zero.
        end_s: the flight's end.
    """

    def __init__(self, *, level: bool = False, end_s: float = 1000.0) -> None:
        self.level, self.end_s = level, end_s
        self._origin_e = np.array(TO_E.transform(LON_DEG, LAT_DEG, HEIGHT_M))
        self._site = ned_from_e(np.radians([LAT_DEG]), np.radians([LON_DEG])).inv()

    def position_e(self, time_s: FloatArray) -> FloatArray:
        """Return (n, 3) positions of the body's origin."""
        angle = RATE_RAD_S * time_s
        down = 20.0 * np.cos(0.3 * time_s)
        ned = np.stack([RADIUS_M * np.sin(angle), -RADIUS_M * np.cos(angle), down], axis=-1)
        return np.asarray(self._origin_e + self._site.apply(ned))

    def attitude(self, time_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return roll, pitch and heading."""
        size = 0.0 if self.level else 1.0
        return (
            size * (0.3 + 0.1 * np.sin(time_s)),
            size * 0.05 * np.cos(0.7 * time_s),
            RATE_RAD_S * time_s % (2 * np.pi),
        )

    def turned(self, time_s: FloatArray) -> Rotation:
        """Return the rotation from b to e."""
        roll, pitch, heading = self.attitude(time_s)
        lat_rad, lon_rad, _ = geodetic(self.position_e(time_s))
        return ned_from_e(lat_rad, lon_rad).inv() * Rotation.from_euler("ZYX", np.stack([heading, pitch, roll], -1))

    def motion(self, time_s: FloatArray) -> Motion:
        """Return the motion at times, s; the rate of rotation by differences over 2 ms errs by less than 1e-6 rad/s."""
        before, after = self.turned(time_s - 1e-3), self.turned(time_s + 1e-3)
        return Motion(
            position_e=self.position_e(time_s),
            velocity_e=derivative(self.position_e, time_s),
            rot_e_from_b=self.turned(time_s).as_matrix(),
            rate_eb_b=(before.inv() * after).as_rotvec() / 2e-3,
        )

    def geodetic(self, time_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return latitude, longitude (rad) and ellipsoidal height (m) at times, s."""
        return geodetic(self.position_e(time_s))

    def velocity_l(self, time_s: FloatArray) -> FloatArray:
        """Return velocities north, east, down."""
        return self.velocity_of([0.0, 0.0, 0.0], time_s)

    def point_e(self, lever_arm_b: list[float], time_s: FloatArray) -> FloatArray:
        """Return (n, 3) positions of a point of the body."""
        return np.asarray(self.position_e(time_s) + self.turned(time_s).apply(lever_arm_b))

    def velocity_of(self, lever_arm_b: list[float], time_s: FloatArray) -> FloatArray:
        """Return velocities (n, 3), m/s, north, east, down of a point of the body, derived from its positions."""
        lat_rad, lon_rad, _ = geodetic(self.point_e(lever_arm_b, time_s))
        velocity_e = derivative(lambda t: self.point_e(lever_arm_b, t), time_s)
        return np.asarray(ned_from_e(lat_rad, lon_rad).apply(velocity_e))


class Standing(Circling):
    """A body that stands still, level, heading north, and costs little for many epochs."""

    def __init__(self) -> None:
        super().__init__(level=True, end_s=1e9)
        self._motion = super().motion(np.zeros(1))

    def motion(self, time_s: FloatArray) -> Motion:
        """Return a constant motion."""
        n = len(time_s)
        still = np.zeros((n, 3))
        position_e = np.broadcast_to(self._motion.position_e, (n, 3))
        return Motion(position_e, still, np.broadcast_to(self._motion.rot_e_from_b, (n, 3, 3)), still)

    def attitude(self, time_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return roll, pitch and heading, rad, which are zero."""
        return np.zeros(len(time_s)), np.zeros(len(time_s)), np.zeros(len(time_s))

    def geodetic(self, time_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return a constant position."""
        lat, lon, height = geodetic(self._motion.position_e)
        return np.full(len(time_s), lat), np.full(len(time_s), lon), np.full(len(time_s), height)

    def velocity_l(self, time_s: FloatArray) -> FloatArray:
        """Return the velocity, m/s, which is zero."""
        return np.zeros((len(time_s), 3))
