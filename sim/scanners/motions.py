"""Motions of deflectors: the angle that CONVENTIONS counts (θ of the beam, γ of a shaft), its rate and acceleration.

All are closed forms of the true time, so a motion is continuous however time is cut.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from swath.georef.arrays import BoolArray, FloatArray

TURNING_SHARE = 0.2  # share of a triangle's time that its turning points take


@dataclass(frozen=True, slots=True)
class Swing:
    """Positions of a deflector at n times.

    Attributes:
        angle_rad: (n,) true beam angle, or the shaft's angle where the beam draws a figure.
        rate_rps, acceleration_rps2: (n,) its derivatives by time, radians.
        centre_rad: (n,) the shaft's reading at angle 0: of a polygon the centre of the facet, else 0.
        facet: (n,) of a polygon, else 0.
    """

    angle_rad: FloatArray
    rate_rps: FloatArray
    acceleration_rps2: FloatArray
    centre_rad: FloatArray
    facet: NDArray[np.uint16]

    def chosen(self, which: BoolArray) -> Swing:
        """Return the positions at the chosen times."""
        return Swing(
            self.angle_rad[which],
            self.rate_rps[which],
            self.acceleration_rps2[which],
            self.centre_rad[which],
            self.facet[which],
        )


Motion = Callable[[FloatArray], Swing]


def sine(half_angle_rad: float, scan_hz: float) -> Motion:
    """Return the motion θ = A sin 2πft."""
    turn = 2 * np.pi * scan_hz

    def swing(time_s: FloatArray) -> Swing:
        phase = 2 * np.pi * _within(scan_hz * time_s)
        angle = half_angle_rad * np.sin(phase)
        return _simple(angle, half_angle_rad * turn * np.cos(phase), -(turn**2) * angle)

    return swing


def triangle(half_angle_rad: float, scan_hz: float) -> Motion:
    """Return an even motion to and fro with smooth turning points.

    At a turning point the rate goes from +v to −v as a cosine, so θ̈ is continuous. Phases are in periods: from a zero
    crossing the even part goes to (1 − q)/4, the turning takes q/2.
    """
    even, turning = (1.0 - TURNING_SHARE) / 4, TURNING_SHARE / 2
    speed = half_angle_rad / (even + turning / np.pi)  # radians a period

    def swing(time_s: FloatArray) -> Swing:
        phase = _within(scan_hz * time_s)
        back = np.abs(phase) > 0.25
        away = np.where(back, phase - np.copysign(0.5, phase), phase)
        way = np.where(back, -1.0, 1.0)
        turned = np.maximum(np.abs(away) - even, 0.0) * (np.pi / turning)
        side = way * np.copysign(1.0, away)
        angle = side * speed * (np.minimum(np.abs(away), even) + turning / np.pi * np.sin(turned))
        rate = way * speed * scan_hz * np.cos(turned)
        return _simple(angle, rate, -side * speed * np.pi / turning * scan_hz**2 * np.sin(turned))

    return swing


def turning(scan_hz: float, turns: int = 1) -> Motion:
    """Return the motion of an evenly turning shaft.

    Its angle counts through this many turns, from minus to plus half of them.
    """

    def swing(time_s: FloatArray) -> Swing:
        angle = 2 * np.pi * turns * _within(scan_hz * time_s / turns)
        return _simple(angle, np.full_like(angle, 2 * np.pi * scan_hz), np.zeros_like(angle))

    return swing


def polygon(scan_hz: float, facets: int) -> Motion:
    """Return the motion of an evenly turning polygon: θ is twice the shaft's angle from the centre of the lit facet."""

    def swing(time_s: FloatArray) -> Swing:
        turns = scan_hz * time_s
        passed = facets * (turns - np.floor(turns))
        facet = np.minimum(np.floor(passed), facets - 1)
        angle = 4 * np.pi / facets * (passed - facet - 0.5)
        rate = np.full_like(angle, 4 * np.pi * scan_hz)
        centre = 2 * np.pi / facets * (facet + 0.5)
        return Swing(angle, rate, np.zeros_like(angle), centre, facet.astype(np.uint16))

    return swing


def _within(periods: FloatArray) -> FloatArray:
    """Return (n,) the periods without whole periods, −½ … ½."""
    rest: FloatArray = periods - np.floor(periods + 0.5)
    return rest


def _simple(angle_rad: FloatArray, rate_rps: FloatArray, acceleration_rps2: FloatArray) -> Swing:
    n = len(angle_rad)
    return Swing(angle_rad, rate_rps, acceleration_rps2, np.zeros(n), np.zeros(n, np.uint16))
