"""Attitude of inertial units that give it as a quaternion."""

from __future__ import annotations

from math import asin, atan2


def angles_of(w: float, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return roll, pitch and heading in radians of a unit quaternion that turns the body to north, east, down."""
    roll = atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = asin(min(1.0, max(-1.0, 2.0 * (w * y - z * x))))
    return roll, pitch, atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
