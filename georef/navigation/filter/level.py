"""The local level at a state, compiled: its axes in e; roll, pitch and heading, and their errors by those of ψ."""

from __future__ import annotations

import math
from typing import NamedTuple

from swath.georef.arrays import FloatArray
from swath.georef.compiled import jit_inline
from swath.georef.geodesy.gravity import normal_of
from swath.georef.geodesy.vectors import cross, dot, plus
from swath.georef.navigation.filter.strapdown import POSITION
from swath.georef.scanner.kernels.types import Matrix, Three


class Axes(NamedTuple):
    """The axes of l in e, the reference of headings and sigmas."""

    north: Three
    east: Three
    down: Three


@jit_inline
def level_axes(x: FloatArray) -> Axes:
    """Return north, east and down in e at the state's position; at a pole those of longitude 0."""
    up, _ = normal_of(x[POSITION], x[POSITION + 1], x[POSITION + 2])
    flat = math.sqrt(up[0] * up[0] + up[1] * up[1])
    east = (-up[1] / flat, up[0] / flat, 0.0) if flat > 0.0 else (0.0, 1.0, 0.0)
    return Axes(cross(up, east), east, (-up[0], -up[1], -up[2]))


@jit_inline
def in_level(axes: Axes, v: Three) -> Three:
    """Return the components north, east, down of a vector in e."""
    return dot(axes.north, v), dot(axes.east, v), dot(axes.down, v)


@jit_inline
def attitude_rows(axes: Axes, rot: Matrix) -> tuple[Three, Matrix]:
    """Return roll, pitch, heading, and the rows that convert ψ in e to their errors."""
    nose = in_level(axes, (rot[0][0], rot[1][0], rot[2][0]))
    flat = max(math.sqrt(nose[0] * nose[0] + nose[1] * nose[1]), 1e-9)
    cos, sin = nose[0] / flat, nose[1] / flat
    right = dot(axes.down, (rot[0][1], rot[1][1], rot[2][1]))
    below = dot(axes.down, (rot[0][2], rot[1][2], rot[2][2]))
    n, e, d = axes
    zero = (0.0, 0.0, 0.0)
    roll = plus(plus(zero, cos / flat, n), sin / flat, e)
    pitch = plus(plus(zero, -sin, n), cos, e)
    angles = math.atan2(right, below), math.atan2(-nose[2], flat), math.atan2(nose[1], nose[0])
    return angles, (roll, pitch, plus(d, -nose[2], roll))


@jit_inline
def wrapped(angle: float) -> float:
    """Return an angle reduced to −π … π."""
    return angle - 2.0 * math.pi * math.floor(angle / (2.0 * math.pi) + 0.5)
