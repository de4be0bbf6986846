"""Rotations of the configuration: matrices as typed, or angles in degrees instead."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from swath.georef.arrays import FloatArray

ROTATION_TOLERANCE = 1e-6  # for a matrix typed with 7 digits; 0.2 arc seconds
WHOLE_TURN_DEG = 360.0
RIGHT_ANGLE_DEG = 90.0
NEARLY = 0.01  # farthest element of a matrix that is taken for a rotation with too few digits


def matrix_of_deg(angles_deg: list[float]) -> list[list[float]]:
    """Return the rows of Rz(yaw) Ry(pitch) Rx(roll), in that order of ``[roll, pitch, yaw]`` in degrees.

    The rotation is active and right-handed: it takes coordinates in the device's axes to the body (conventions). A
    device whose axes are parallel to the body's is turned about the body's x by roll, then about the body's y by pitch,
    then about the body's z by yaw. Multiples of 90° give exact zeros and ones.
    """
    (cr, sr), (cp, sp), (cy, sy) = ((_exact(math.cos, angle), _exact(math.sin, angle)) for angle in angles_deg)
    rows = (
        (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
        (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
        (-sp, cp * sr, cp * cr),
    )
    return [[value + 0.0 for value in row] for row in rows]  # no negative zeros


def _exact(function: Any, angle_deg: float) -> float:
    """Return sine or cosine of degrees, exact at multiples of 90°."""
    value = float(function(math.radians(angle_deg % 360.0)))
    return round(value) + 0.0 if abs(value - round(value)) < 1e-15 else value


def with_matrix(table: Any, matrix: str, angles: str) -> Any:
    """Return a table of the file with the key ``matrix`` filled in from ``angles``, if these are three numbers.

    Raises:
        ValueError: both keys are given.
    """
    if not isinstance(table, Mapping) or table.get(angles) is None:
        return table
    if table.get(matrix) is not None:
        raise ValueError(f"{matrix} and {angles} are both given; keep one of them")
    values = table[angles]
    right = isinstance(values, list) and len(values) == 3 and all(map(_is_number, values))
    return {**table, matrix: matrix_of_deg([float(value) for value in values])} if right else table


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e9  # also no NaN


def within_a_turn(angles_deg: list[float]) -> list[float]:
    """Return angles in degrees unchanged.

    Raises:
        ValueError: one is more than a whole turn, a slip of the key that its remainder would hide.
    """
    for angle in angles_deg:
        if abs(angle) > WHOLE_TURN_DEG:
            rest = round(math.remainder(angle, WHOLE_TURN_DEG), 9) + 0.0
            raise ValueError(f"{angle:g}° is more than a whole turn; give -360 to 360 ({rest:g}°, if it is meant)")
    return angles_deg


def angles_of_prisms(angles_deg: list[float]) -> list[float]:
    """Return angles between the faces of prisms, in degrees, unchanged.

    Raises:
        ValueError: one is a right angle or more.
    """
    for angle in angles_deg:
        if abs(angle) >= RIGHT_ANGLE_DEG:
            raise ValueError(f"{angle:g}° is no prism's; give the angle between its two faces, below 90")
    return angles_deg


def rotation_problem(rows: list[list[float]]) -> str | None:
    """Return why three rows are not a proper rotation matrix, with the nearest one if it is near; None if they are
    one.
    """
    matrix = np.array(rows, dtype=np.float64)
    lengths = np.linalg.norm(matrix, axis=1)
    for row in range(3):
        if abs(lengths[row] - 1.0) > ROTATION_TOLERANCE:
            return f"not a rotation: row {row + 1} has length {lengths[row]:.9g}, want 1{_nearest_text(matrix)}"
    if np.abs(matrix @ matrix.T - np.eye(3)).max() > ROTATION_TOLERANCE:
        return f"not a rotation: its rows are not perpendicular to each other{_nearest_text(matrix)}"
    if np.linalg.det(matrix) < 0.0:
        return "not a rotation but a reflection (determinant -1): change the sign of one axis"
    return None


def _nearest_text(matrix: FloatArray) -> str:
    """Return the nearest rotation as it may be typed, or nothing where it is not near."""
    left, _, right = np.linalg.svd(np.clip(matrix, -1e6, 1e6))
    nearest = left @ right
    if np.linalg.det(nearest) < 0.0 or np.abs(nearest - matrix).max() > NEARLY:
        return ""
    rows = ", ".join(f"[{', '.join(f'{value + 0.0:.7g}' for value in row)}]" for row in np.round(nearest, 7))
    return f"; the nearest rotation is [{rows}]"
