"""Compute the covariance of points from trajectory, range, angle, time and calibration (FORMULAS 5.2, 6.2, 10.3).

Sigmas are of the errors of one point, not of the difference of two: the trajectory's and the calibration's errors are
the same, or nearly, for neighbours.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from swath.georef.arrays import FloatArray
from swath.georef.geodesy.rotations import rot_x, rot_y
from swath.georef.points import contiguous
from swath.georef.scanner.calibration import INDEX, PARAMETERS, Calibration
from swath.georef.scanner.kernels.covariance import (
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
    Doubt,
    Flown,
    Known,
)
from swath.georef.trajectory.trajectory import Trajectory

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
    """Raised for an invalid covariance; one line for the user."""


@dataclass(frozen=True, slots=True)
class Noise:
    """One sigma of a single return.

    Attributes:
        range_m: of the range.
        angle_rad: of the scan angle (of a spinning head's azimuth); of each of two angles, azimuth and elevation, where
            a head gives both.
        time_s: of the pulse's time.
        divergence_rad: full divergence of the beam; used if the surface is known.
    """

    range_m: float = 0.02
    angle_rad: float = 2e-5
    time_s: float = 1e-6
    divergence_rad: float = 3e-4

    def times(self, share: float) -> Noise:
        """Return the noise multiplied by a factor."""
        return Noise(self.range_m * share, self.angle_rad * share, self.time_s * share, self.divergence_rad * share)


class Uncertainty:
    """Covariances of the points of one scanner, by `swath.georef.scanner.sensor_model.SensorModel.rays`."""

    def __init__(self, calibration: Calibration, noise: Noise, *, aimed: bool = False) -> None:
        """Take the parameters' covariance apart into independent errors.

        Args:
            calibration: of the scanner.
            noise: of its returns.
            aimed: whether returns have an elevation of their own.

        Raises:
            UncertaintyError: the calibration's correlations are not a covariance.
        """
        sigmas = calibration.all_sigmas
        active = np.flatnonzero(sigmas > 0.0)
        try:
            correlation = calibration.correlation[np.ix_(active, active)]
            factor = sigmas[active, np.newaxis] * np.linalg.cholesky(correlation)
        except np.linalg.LinAlgError as error:
            text = (
                f"calibration {calibration.id}: its correlations do not form a covariance; the matrix must be "
                "positive definite"
            )
            raise UncertaintyError(text) from error
        errors = factor.T @ _effects(calibration)[active]
        from_origin = errors.copy()  # turns about the body's origin instead of the scanner's
        from_origin[:, SHIFT : SHIFT + 3] -= np.cross(errors[:, TURN : TURN + 3], calibration.lever_arm_b)
        along = from_origin[:, ALONG_ONLY]
        self._known = Known(
            np.ascontiguousarray(errors),
            not errors[:, _BEYOND_LENGTH].any(),
            np.ascontiguousarray(along.T @ along),
            calibration.lever_arm_b,
            calibration.value("scan_angle_offset_rad"),
            noise.range_m,
            noise.angle_rad,
            noise.angle_rad if aimed else 0.0,
            noise.time_s,
            noise.divergence_rad,
        )

    def doubt(self, trajectory: Trajectory, count: int, incidence_rad: FloatArray | None = None) -> Doubt:
        """Return the kernels' input, with room for the covariances of n returns."""
        columns = (contiguous(getattr(trajectory, name)) for name in Flown._fields)
        incidence_rad = _NONE if incidence_rad is None else contiguous(incidence_rad)
        return Doubt(Flown(*columns), self._known, incidence_rad, np.empty((count, 6)))


def _effects(calibration: Calibration) -> FloatArray:
    """Return the effect (16, 18) of each parameter, by the columns of `swath.georef.scanner.kernels.covariance`.

    ω, φ and κ turn the beam about their own axes in b (FORMULAS 5.2); the effect of the pitch slope on κ's axis is left
    out (1e-4 of its part).
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
