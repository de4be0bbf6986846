"""How good a point is: its covariance from trajectory, range, angle, time and calibration (FORMULAS 5.2, 6.2, 10.3).

Sigmas are of the errors of one point, not of the difference of two: the trajectory's and the calibration's errors are
the same, or nearly, for neighbours.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from georef.calibration import INDEX, PARAMETERS, Calibration
from georef.earth import geodetic_from_e, rot_e_from_l
from georef.kernels.covariance import (
    ALONG_ONLY,
    ANGLE,
    ANGLE_BY_ACCELERATION,
    ANGLE_BY_RATE,
    ANGLE_BY_READING,
    ATTITUDE_LATER,
    COLUMNS,
    LATER,
    LONGER,
    LONGER_BY_RANGE,
    SHIFT,
    TILTED,
    TURN,
    TURN_BY_ANGLE,
    Flown,
    Known,
    Seen,
    covariances,
)
from georef.points import Rays
from georef.records import Int64Array
from georef.rotations import rot_from_quaternion, rot_x, rot_y
from georef.trajectory import Trajectory

FloatArray = NDArray[np.float64]
_NONE = np.zeros(0)
_ALONE = {
    "range_offset_m": LONGER,
    "range_scale": LONGER_BY_RANGE,
    "scan_plane_tilt_rad": TILTED,
    "time_offset_s": LATER,
    "imu_latency_s": ATTITUDE_LATER,
    "scan_angle_scale": ANGLE_BY_READING,
    "encoder_latency_s": ANGLE_BY_RATE,
    "torsion_s2": ANGLE_BY_ACCELERATION,
}
_BEYOND_LENGTH = [*range(TURN_BY_ANGLE, TURN_BY_ANGLE + 3), *range(TILTED, COLUMNS)]


class UncertaintyError(ValueError):
    """A covariance that is none; one line for the user."""


@dataclass(frozen=True, slots=True)
class Noise:
    """One sigma of a single return.

    Attributes:
        range_m: of the range.
        angle_rad: of the scan angle (of a spinning head's azimuth).
        time_s: of the pulse's time.
        divergence_rad: full divergence of the beam; counts where the surface is known.
    """

    range_m: float = 0.02
    angle_rad: float = 2e-5
    time_s: float = 1e-6
    divergence_rad: float = 3e-4


class Uncertainty:
    """Covariances of the points of one scanner."""

    def __init__(self, calibration: Calibration, noise: Noise) -> None:
        """Take the parameters' covariance apart.

        Raises:
            UncertaintyError: the calibration's correlations are no covariance.
        """
        active = np.flatnonzero(calibration.sigmas > 0.0)
        try:
            correlation = calibration.correlation[np.ix_(active, active)]
            factor = calibration.sigmas[active, np.newaxis] * np.linalg.cholesky(correlation)
        except np.linalg.LinAlgError as error:
            text = f"calibration {calibration.id}: its correlations are no covariance; want a positive definite matrix"
            raise UncertaintyError(text) from error
        errors = factor.T @ _effects(calibration)[active]
        along = errors[:, ALONG_ONLY]
        self._known = Known(
            np.ascontiguousarray(errors),
            not errors[:, _BEYOND_LENGTH].any(),
            np.ascontiguousarray(along.T @ along),
            calibration.lever_arm_b,
            calibration.value("scan_angle_offset_rad"),
            noise.range_m,
            noise.angle_rad,
            noise.time_s,
            noise.divergence_rad,
        )

    def covariance_e(
        self,
        rays: Rays,
        trajectory: Trajectory,
        incidence_rad: FloatArray | None = None,
        flown: Flown | None = None,
    ) -> FloatArray:
        """(n, 6) xx xy xz yy yz zz in e, m²; nan where the trajectory says no sigma.

        Args:
            rays: georeferenced returns only, with axes, of this trajectory.
            trajectory: whose sigmas count.
            incidence_rad: (n,) between beam and the surface's normal, where the surface is known.
            flown: of the trajectory, for callers that ask more than once (`flown_between`).
        """
        covariance_e = np.empty((len(rays.points_e), 6))
        if not len(covariance_e):
            return covariance_e
        seen = _seen(rays, _NONE if incidence_rad is None else incidence_rad)
        if flown is None:
            flown = _flown(trajectory, int(seen.epoch.min()), int(seen.epoch.max()) + 2)
        covariances(seen, flown, self._known, covariance_e)
        return covariance_e


def flown_during(trajectory: Trajectory, time_ns: Int64Array, offset_s: float) -> Flown | None:
    """As `flown_between`, for pulses at stamps (n,) and an offset of these; negative stamps are none."""
    if len(time_ns) and time_ns.min() < 0:
        time_ns = time_ns[time_ns >= 0]
    if len(trajectory) < 2 or not len(time_ns):
        return None
    offset_ns = round(offset_s * 1e9)
    return flown_between(trajectory, int(time_ns.min()) + offset_ns, int(time_ns.max()) + offset_ns)


def flown_between(trajectory: Trajectory, first_ns: int, last_ns: int) -> Flown:
    """What `covariance_e` needs of a trajectory for pulses from first_ns to last_ns; what lies outside it is left out.

    The trajectory has at least two epochs.
    """
    last = len(trajectory.time_ns) - 2
    first, end = np.searchsorted(trajectory.time_ns, [first_ns, last_ns], side="right") - 1
    return _flown(trajectory, min(max(int(first), 0), last), min(max(int(end), 0), last) + 2)


def _effects(calibration: Calibration) -> FloatArray:
    """(16, 18) what each parameter does (FORMULAS 5.2), columns as in `georef.kernels.covariance`.

    ω, φ and κ turn the beam about their own axes in b; that the pitch slope moves κ's is left out (1e-4 of its part).
    """
    effects = np.zeros((len(PARAMETERS), COLUMNS))
    omega = rot_x(calibration.value("omega_rad"))
    phi_axis = omega[:, 1]
    effects[INDEX["omega_rad"], TURN : TURN + 3] = (1.0, 0.0, 0.0)
    effects[INDEX["phi_rad"], TURN : TURN + 3] = phi_axis
    effects[INDEX["kappa_rad"], TURN : TURN + 3] = (omega @ rot_y(calibration.value("phi_rad")))[:, 2]
    effects[INDEX["pitch_slope"], TURN_BY_ANGLE : TURN_BY_ANGLE + 3] = phi_axis
    effects[INDEX["scan_angle_offset_rad"], ANGLE] = -(1.0 + calibration.value("scan_angle_scale"))
    for axis, name in enumerate("xyz"):
        effects[INDEX[f"lever_arm_{name}_m"], SHIFT + axis] = 1.0
    for name, column in _ALONE.items():
        effects[INDEX[name], column] = 1.0
    return effects


def _seen(rays: Rays, incidence_rad: FloatArray) -> Seen:
    columns = {name: getattr(rays, name) for name in Seen._fields if name != "incidence_rad"}
    across = {name: np.ascontiguousarray(column.T) for name, column in columns.items()}
    return Seen(**across, incidence_rad=incidence_rad)


def _flown(trajectory: Trajectory, first: int, end: int) -> Flown:
    """Covariances at epochs first … end − 1, motion of the intervals between them."""
    part = slice(first, end)
    lat, lon, _ = geodetic_from_e(trajectory.position_e[part])
    ned = rot_e_from_l(lat, lon)
    seconds = np.diff(trajectory.time_ns[part])[:, np.newaxis] * 1e-9
    return Flown(
        first,
        _covariance(ned * trajectory.position_sigma_l[part, np.newaxis, :]),
        _covariance(
            _attitude_axes_b(trajectory.q_e_from_b[part], ned) * trajectory.attitude_sigma_rad[part, np.newaxis]
        ),
        np.diff(trajectory.position_e[part], axis=0) / seconds,
        trajectory.rotvec_b[first : end - 1] / seconds,
    )


def _covariance(axes: FloatArray) -> FloatArray:
    """(m, 6) xx xy xz yy yz zz of axes (m, 3, 3), each column what one sigma of one error does."""
    full = axes @ np.swapaxes(axes, 1, 2)
    six: FloatArray = full[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    return np.ascontiguousarray(six)


def _attitude_axes_b(q_e_from_b: FloatArray, rot_e_from_ned: FloatArray) -> FloatArray:
    """(m, 3, 3), columns: axes in b about which roll, pitch and heading turn the body: its x, the level y, and down."""
    rot_l_from_b = np.swapaxes(rot_e_from_ned, 1, 2) @ rot_from_quaternion(q_e_from_b)
    nose_n, nose_e = rot_l_from_b[:, 0, 0], rot_l_from_b[:, 1, 0]
    level = np.hypot(nose_n, nose_e)
    level_y = np.stack([-nose_e / level, nose_n / level, np.zeros_like(level)], axis=1)
    axes = np.zeros((len(level), 3, 3))
    axes[:, 0, 0] = 1.0
    axes[:, :, 1] = np.einsum("nji,nj->ni", rot_l_from_b, level_y)
    axes[:, :, 2] = rot_l_from_b[:, 2]
    return axes
