"""Compute how points move with errors of a calibration: the effects of FORMULAS 5.3, exact for any attitude."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from swath.calib.flight import Flight, Head, Swath, Tangent
from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.geodesy.earth import geodetic_from_e, rot_e_from_l
from swath.georef.geodesy.rotations import rot_from_quaternion
from swath.georef.scanner.beams import AimedGeometry, SpinningGeometry
from swath.georef.scanner.calibration import INDEX, PARAMETERS
from swath.georef.trajectory.trajectory import Poses, Trajectory


@dataclass(frozen=True, slots=True)
class Effect:
    """An effect of a calibration error on the ground.

    Attributes:
        name: for display.
        parameter: parameter with the error, SI (`swath.georef.scanner.calibration.PARAMETERS`).
        factor, unit: of the report.
        look: its appearance in the strips.
        remedy: the flight line that shows it.
    """

    name: str
    parameter: str
    factor: float
    unit: str
    look: str
    remedy: str

    @property
    def key(self) -> str:
        """Key of the parameter in calibration files, which has the report's unit: ``omega_deg``."""
        return PARAMETERS[INDEX[self.parameter]].key


_DEG = 180.0 / math.pi
EFFECTS = (
    Effect("roll", "omega_rad", _DEG, "°", "opposite strips tilt against each other", "two opposite lines"),
    Effect("pitch", "phi_rad", _DEG, "°", "strips are shifted along track", "opposite lines over slopes or roofs"),
    Effect("heading", "kappa_rad", _DEG, "°", "strips are skewed", "parallel lines side by side over slopes or roofs"),
    Effect(
        "torsion",
        "scan_angle_scale",
        1e6,
        "ppm of the scan angle",
        "strips smile: edges up or down on both sides",
        "lines where the edge of one lies on the nadir of another",
    ),
    Effect(
        "time",
        "time_offset_s",
        1e6,
        "µs",
        "strips are shifted along track in proportion to their speed",
        "lines at two speeds",
    ),
    Effect(
        "scan direction",
        "encoder_latency_s",
        1e6,
        "µs",
        "scan lines of the two directions lie apart: zig-zag",
        "a scanner that reports its scan direction",
    ),
    Effect(
        "range",
        "range_offset_m",
        1.0,
        "m",
        "heights disagree between nadir and edges, and on slopes",
        "inclined planes seen from different angles, or ground control",
    ),
)
NAMES = tuple(effect.name for effect in EFFECTS)


@dataclass(frozen=True, eq=False)
class SeenFrom:
    """The places from which strips were seen: the frame of the checks' points, and the trajectory of each strip.

    Attributes:
        frame: the frame t.
        trajectories: of the body, one per session.
        trajectory_index: of each strip, the index of its trajectory.
        scan_rate: of each strip, |θ̇| in rad/s, typical; 0: not known.
        rot_b_from_s: of each strip, (3, 3), mounting of its scanner; directions of the scan are about its x axis.
    """

    frame: Tangent
    trajectories: Sequence[Trajectory]
    trajectory_index: Sequence[int]
    scan_rate: Sequence[float]
    rot_b_from_s: Sequence[FloatArray]

    @classmethod
    def of(cls, flight: Flight) -> SeenFrom:
        """Create it for a flight."""
        rates = [
            0.0 if swath.encoder_rate is None or not len(swath) else float(np.median(np.abs(swath.encoder_rate[::97])))
            for swath in flight.swaths
        ]
        mounted = [_rot_b_from_s(flight.heads[swath.head], swath) for swath in flight.swaths]
        return cls(
            flight.frame, flight.trajectories, [swath.trajectory_index for swath in flight.swaths], rates, mounted
        )


def _rot_b_from_s(head: Head, swath: Swath) -> FloatArray:
    """Return the rotation (3, 3) of a swath's scanner, in the middle of the swath if the mount moves."""
    if isinstance(head.geometry, SpinningGeometry | AimedGeometry) or not len(swath):
        return np.eye(3)  # a spinning head has its own axis, and no scan angle for such a column
    turned: FloatArray = head.mount.poses(swath.time_ns[len(swath) // 2 :][:1])[0][0]
    return turned @ head.start.installation_matrix


@dataclass(frozen=True, eq=False)
class _Arms:
    """The places from which points were seen.

    Attributes:
        poses: (n,) of the body.
        rot_t_from_b: (n, 3, 3).
        arm_t, arm_b: (n, 3) from the body to the point, in t and in b.
    """

    poses: Poses
    rot_t_from_b: FloatArray
    arm_t: FloatArray
    arm_b: FloatArray

    @classmethod
    def of(cls, points_t: FloatArray, strip: int, time_ns: Int64Array, seen: SeenFrom) -> _Arms:
        """Compute the places for points (n, 3) at GPS times (n,)."""
        poses = seen.trajectories[seen.trajectory_index[strip]].poses(time_ns)
        rot_t_from_b = seen.frame.rot_t_from_e @ rot_from_quaternion(poses.q_e_from_b)
        arm_t = points_t - seen.frame.t_from_e(poses.position_e)
        return cls(poses, rot_t_from_b, arm_t, np.einsum("nji,nj->ni", rot_t_from_b, arm_t))


def error_columns(points_t: FloatArray, strip: Int64Array, time_ns: Int64Array, seen: SeenFrom) -> FloatArray:
    """Return how points move with errors of the trajectory at their times.

    Args:
        points_t: (n, 3) metres.
        strip: (n,) index.
        time_ns: (n,) GPS time.
        seen: the places from which they were seen.

    Returns:
        (n, 6, 3) in t, metres per unit of the correction of the trajectory: position north, east, down (m), then small
        turns of the body about north, east, down (rad), as in `swath.calib.equations.trajectory_prior`.
    """
    moved = np.zeros((len(points_t), 6, 3))
    for number in np.unique(strip).tolist():
        own = strip == number
        arms = _Arms.of(points_t[own], number, time_ns[own], seen)
        lat, lon, _ = geodetic_from_e(arms.poses.position_e)
        axes_t = np.swapaxes(seen.frame.rot_t_from_e @ rot_e_from_l(lat, lon), 1, 2)  # one row each: north, east, down
        moved[own, :3] = axes_t
        moved[own, 3:] = np.cross(axes_t, arms.arm_t[:, np.newaxis])
    return moved


def effect_columns(
    points_t: FloatArray, strip: Int64Array, time_ns: Int64Array, direction: FloatArray, seen: SeenFrom
) -> tuple[FloatArray, FloatArray]:
    """Return how points move with effects, and with errors of their strip.

    Args:
        points_t: (n, 3) metres.
        strip: (n,) index.
        time_ns: (n,) GPS time.
        direction: (n,) of the scan, −1 … 1.
        seen: the places from which they were seen.

    Returns:
        (n, effects, 3) and (n, 6, 3) in t, metres per unit in SI: FORMULAS 5.2 with the lever arm left out of the
        boresight's columns (a part in a thousand); position east, north, up, then turns about the body's axes.
    """
    columns, errors = np.zeros((len(points_t), len(EFFECTS), 3)), np.zeros((len(points_t), 6, 3))
    for number in np.unique(strip).tolist():
        own = strip == number
        arms = _Arms.of(points_t[own], number, time_ns[own], seen)
        poses, rot_t_from_b, arm = arms.poses, arms.rot_t_from_b, arms.arm_b  # forward, right, down
        velocity = np.einsum("nji,nj->ni", rot_t_from_b, poses.velocity_e @ seen.frame.rot_t_from_e.T)
        turning = velocity + np.cross(poses.rate_eb_b, arm)
        arm_s = arm @ seen.rot_b_from_s[number]
        by_angle_s = np.stack([np.zeros(len(arm)), arm_s[:, 2], -arm_s[:, 1]], axis=1)
        by_angle = by_angle_s @ seen.rot_b_from_s[number].T
        angle = np.arctan2(arm_s[:, 1], arm_s[:, 2])[:, np.newaxis]
        in_b = np.stack(
            [
                np.cross([1.0, 0.0, 0.0], arm),
                np.cross([0.0, 1.0, 0.0], arm),
                np.cross([0.0, 0.0, 1.0], arm),
                angle * by_angle,
                turning,
                (direction[own] * seen.scan_rate[number])[:, np.newaxis] * by_angle,
                arm / np.linalg.norm(arm, axis=1)[:, np.newaxis],
            ],
            axis=1,
        )
        columns[own] = np.einsum("nij,nkj->nki", rot_t_from_b, in_b)
        errors[own, :3] = np.eye(3)
        errors[own, 3:] = columns[own, :3]
    return columns, errors
