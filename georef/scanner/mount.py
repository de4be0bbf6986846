"""Stabilised and pointed mounts: the stages of a gimbal between the scanner and the body (NGA Eq. 3; FORMULAS 2.1).

From the outermost stage inwards a point is

    x_b = lever_arm_b + R(ω, φ, κ) · G₁ ( a₁ + G₂ ( a₂ + … T x_s ) )

with G = Rz(yaw) Ry(pitch) Rx(roll) of each stage and a the vector from its centre to that of the next inner one (for
the last: to the scanner's origin), in the stage's own axes. The lever arm ends in the first stage's centre; the
boresight is that between gimbal and body.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from swath.georef.arrays import BoolArray, ByteArray, FloatArray, Int64Array, StructArray
from swath.georef.geodesy.rotations import rot_l_from_b

DEFAULT_MAX_GAP_NS = 1_000_000_000


class MountError(ValueError):
    """Raised for an impossible gimbal; one line for the user."""


def _zeros() -> FloatArray:
    return np.zeros(3)


@dataclass(frozen=True, eq=False)
class AngleSeries:
    """Angles of a stage over time, linear in between.

    Attributes:
        time_ns: (n,) GPS time, strictly rising, at least two.
        angles_rad: (n, 3) roll, pitch, yaw.
        max_gap_ns: over longer intervals they are unknown.
    """

    time_ns: Int64Array
    angles_rad: FloatArray
    max_gap_ns: int = DEFAULT_MAX_GAP_NS

    def __post_init__(self) -> None:
        """Refuse columns that do not fit, or times that do not rise, with `MountError`."""
        if len(self.time_ns) < 2 or self.angles_rad.shape != (len(self.time_ns), 3):
            raise MountError("gimbal angles: at least two epochs of roll, pitch and yaw are needed")
        if (np.diff(self.time_ns) <= 0).any():
            raise MountError("gimbal angles: time does not increase")

    @classmethod
    def of_solutions(cls, rows: StructArray, max_gap_ns: int = DEFAULT_MAX_GAP_NS) -> AngleSeries:
        """Return a device's roll, pitch and heading as the angles of the stage that it measures.

        Args:
            rows: `INS_DTYPE`, in the order in which they came; repeated or late epochs, and those without all three
                angles, are left out.
            max_gap_ns: over longer intervals they are unknown.

        Raises:
            MountError: fewer than two epochs are left.
        """
        angles = np.stack([rows["roll_rad"], rows["pitch_rad"], rows["heading_rad"]], axis=1)
        known = np.isfinite(angles).all(axis=1) & (rows["gps_ns"] >= 0)
        time_ns, angles = rows["gps_ns"][known], angles[known]
        newest = np.maximum.accumulate(np.concatenate([[-1], time_ns]))
        new = time_ns > newest[:-1]
        return cls(time_ns[new], angles[new], max_gap_ns)

    def joined(self, other: AngleSeries) -> AngleSeries:
        """Return this series joined with that of another recording; at common times this one's angles are kept."""
        time_ns, first = np.unique(np.concatenate([self.time_ns, other.time_ns]), return_index=True)
        return AngleSeries(time_ns, np.concatenate([self.angles_rad, other.angles_rad])[first], self.max_gap_ns)

    @cached_property
    def _unwrapped(self) -> FloatArray:
        return np.unwrap(self.angles_rad, axis=0)

    def at(self, time_ns: Int64Array) -> tuple[FloatArray, BoolArray]:
        """Return angles (n, 3) at GPS times (n,), and whether they are known."""
        last = len(self.time_ns) - 2
        epoch = np.clip(np.searchsorted(self.time_ns, time_ns, side="right") - 1, 0, last)
        begin, end = self.time_ns[epoch], self.time_ns[epoch + 1]
        share = (time_ns - begin) / (end - begin)
        known = (time_ns >= self.time_ns[0]) & (time_ns <= self.time_ns[-1]) & (end - begin <= self.max_gap_ns)
        turned = self._unwrapped
        return turned[epoch] + share[:, np.newaxis] * (turned[epoch + 1] - turned[epoch]), known


@dataclass(frozen=True, eq=False)
class Stage:
    """A stage of a gimbal.

    Attributes:
        angles_rad: (3,) roll, pitch, yaw; added to the series if there is one.
        lever_arm: (3,) from this stage's centre to the next inner one's, metres, in its own axes.
        series: angles over time; None: the stage does not move.
    """

    angles_rad: FloatArray = field(default_factory=_zeros)
    lever_arm: FloatArray = field(default_factory=_zeros)
    series: AngleSeries | None = None

    def joined(self, other: Stage) -> Stage:
        """Return the same stage over the time of two recordings."""
        if self.series is None or other.series is None:
            return self
        return replace(self, series=self.series.joined(other.series))


@dataclass(frozen=True, eq=False)
class Mount:
    """A gimbal, outermost stage first; without stages a rigid mount."""

    stages: tuple[Stage, ...] = ()

    @property
    def moves(self) -> bool:
        """True if a stage has angles over time."""
        return any(stage.series is not None for stage in self.stages)

    def joined(self, other: Mount) -> Mount:
        """Return the same mount over the time of two recordings."""
        return Mount(tuple(one.joined(again) for one, again in zip(self.stages, other.stages, strict=True)))

    def poses(self, time_ns: Int64Array) -> tuple[FloatArray, FloatArray, ByteArray]:
        """Return poses of the innermost stage at GPS times (n,).

        They lead outward from the installed scanner's axes to those the boresight turns.

        Returns:
            rotations (m, 3, 3), origins (m, 3), whether both are known (m,); m = n if the mount moves, else 1.
        """
        count = len(time_ns) if self.moves else 1
        rotation = np.broadcast_to(np.eye(3), (count, 3, 3))
        shift = np.zeros((count, 3))
        known = np.ones(count, dtype=np.bool_)
        for stage in reversed(self.stages):
            angles = np.broadcast_to(stage.angles_rad, (count, 3))
            if stage.series is not None:
                turned, there = stage.series.at(time_ns)
                angles, known = angles + turned, known & there
            stage_rotation = rot_l_from_b(*angles.T)
            rotation = stage_rotation @ rotation
            shift = np.einsum("nij,nj->ni", stage_rotation, shift + stage.lever_arm)
        return np.ascontiguousarray(rotation), shift, known.astype(np.uint8)
