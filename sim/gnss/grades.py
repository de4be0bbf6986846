"""Accuracies of each grade of GNSS solution, and the accuracies that a receiver reports."""

from __future__ import annotations

from dataclasses import dataclass

from swath.georef.records import FixType

Axes = tuple[float, float, float]  # north, east, down; each axis has its own draws

OPTIMISM = 0.8  # sigmas that receivers report, divided by the true ones


@dataclass(frozen=True, slots=True)
class Grade:
    """Errors of an antenna's solutions, one sigma for each axis.

    Attributes:
        fix: its usual fix type.
        white_m: part that changes from epoch to epoch.
        slow_m: correlated parts, each with its correlation time in seconds.
        velocity_mps: white noise of the velocity.
        satellites: usual number in use.
        float_s: time after an outage during which ambiguities are not fixed.
    """

    fix: FixType
    white_m: Axes
    slow_m: tuple[tuple[Axes, float], ...]
    velocity_mps: Axes
    satellites: int
    float_s: float

    @property
    def total_m(self) -> Axes:
        """Sigmas of all parts of the position error together."""
        parts = (self.white_m, *(sigma for sigma, _ in self.slow_m))
        north, east, down = (sum(part[axis] ** 2 for part in parts) ** 0.5 for axis in range(3))
        return north, east, down


GRADES = {
    "rtk": Grade(
        fix=FixType.RTK_FIXED,
        white_m=(0.008, 0.008, 0.015),
        slow_m=(((0.004, 0.004, 0.008), 10.0), ((0.006, 0.006, 0.012), 60.0)),
        velocity_mps=(0.010, 0.010, 0.020),
        satellites=20,
        float_s=10.0,
    ),
    "ppk": Grade(
        fix=FixType.RTK_FIXED,
        white_m=(0.004, 0.004, 0.008),
        slow_m=(((0.006, 0.006, 0.012), 60.0),),
        velocity_mps=(0.006, 0.006, 0.012),
        satellites=20,
        float_s=3.0,
    ),
    "spp": Grade(
        fix=FixType.SINGLE,
        white_m=(0.2, 0.2, 0.2),
        slow_m=(((1.2, 1.2, 2.0), 180.0),),
        velocity_mps=(0.03, 0.03, 0.06),
        satellites=17,
        float_s=0.0,
    ),
}
FLOAT_M: Axes = (0.25, 0.25, 0.40)  # added while ambiguities are not fixed
FLOAT_TAU_S = 20.0
SATELLITES_SIGMA, SATELLITES_TAU_S = 1.5, 300.0

# Heading and pitch of a baseline of one metre, degrees; longer ones are better in proportion.
BASELINE_DEG_M = (0.2, 0.4)
BASELINE_SLOW_SHARE, BASELINE_TAU_S = 0.6, 60.0  # multipath: this share of the sigma is correlated

# The receiver's own INS: smooth, (sigmas, correlation time in seconds)
INS_POSITION_M: tuple[Axes, float] = ((0.012, 0.012, 0.020), 60.0)
INS_VELOCITY_MPS: tuple[Axes, float] = ((0.005, 0.005, 0.005), 30.0)
INS_ATTITUDE_DEG: tuple[Axes, float] = ((0.005, 0.005, 0.010), 120.0)  # roll, pitch, heading
INS_COAST_S = 20.0  # time without satellites that doubles position and velocity errors
INS_RECOVERY_S = 3.0
