"""The errors of a flight's points in few numbers: covariances of points and of differences of points (FORMULAS 10).

The model is ULEM's: a collection unit is a strip of one scanner. It has the trajectory's errors as posts in time, the
calibration's errors as offsets of position, angles and range, an unmodelled error that is correlated in space, and the
noise of single returns.

Frame of all vectors: m, easting, northing and height of the mapping frame in metres. Path system of a unit: x along the
flight path, y right, z down.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.error_model.accuracy import principal_root
from swath.georef.error_model.correlation import Correlation
from swath.georef.error_model.kernels import Numbers, crossed_covariances, point_covariances

OFFSETS = 7  # Δx, Δy, Δz, θ1, θ2, θ3, Δr
GROUPS = ("horizontal position", "height", "roll and pitch", "heading")  # of the trajectory's errors
GROUP_OF = (0, 0, 1, 2, 2, 3)  # of the six components
LEAST_VARIANCE = 1e-30
AXES = ("u", "v", "w")  # of the unmodelled error: along the path, right, down


class ErrorModelError(ValueError):
    """Raised for a model that is no model, or a point that it does not cover; one line."""


@dataclass(frozen=True, eq=False)
class Unit:
    """A strip of one scanner.

    Attributes:
        strip: number, as the points' source id; scanner: its name in the configuration.
        start_ns, end_ns: GPS time of its first and last return.
        azimuth_rad: of the path system's x axis, clockwise from northing.
        post_ns: (k,) GPS times of the posts, rising.
        position_m: (k, 3) of the body at the posts.
        covariance: (k, 6, 6) of the trajectory's errors at the posts: position in m, then small turns about m's axes.
        calibration: (q, 7) offsets that each independent error of the calibration makes in the path system: Δx, Δy, Δz
            in metres, θ1, θ2, θ3 in rad, Δr in metres. Units of one scanner share the errors.
        unmodelled: (3, 3) covariance in the path system.
        unmodelled_correlation: along u, v, w; lags in metres.
        noise: (3,) sigmas of single returns: along the beam (m), across and along the path (rad).
    """

    strip: int
    scanner: str
    start_ns: int
    end_ns: int
    azimuth_rad: float
    post_ns: Int64Array
    position_m: FloatArray
    covariance: FloatArray
    calibration: FloatArray
    unmodelled: FloatArray
    unmodelled_correlation: tuple[Correlation, Correlation, Correlation]
    noise: FloatArray


def path_axes(azimuth_rad: float) -> FloatArray:
    """Return the matrix (3, 3) from the path system to m: columns are forward, right and down (FORMULAS 10.1)."""
    sin, cos = np.sin(azimuth_rad), np.cos(azimuth_rad)
    return np.array([[sin, cos, 0.0], [cos, -sin, 0.0], [0.0, 0.0, -1.0]])


def normalised_time(time_ns: ArrayLike, start_ns: int, end_ns: int) -> FloatArray:
    """Return times −1 at the start of a unit, 1 at its end: (2t − t_end − t_start) / (t_end − t_start)."""
    since: FloatArray = (np.asarray(time_ns, np.int64) - start_ns) / float(end_ns - start_ns)
    return 2.0 * since - 1.0


def offset_columns(beam_m: FloatArray, azimuth_rad: float) -> FloatArray:
    """Return ∂point/∂offset (n, 3, 7) in m, for beams (n, 3) in m from the body to the point (FORMULAS 10.2)."""
    axes = path_axes(azimuth_rad)
    columns = np.empty((len(beam_m), 3, OFFSETS))
    columns[:, :, :3] = axes
    columns[:, :, 3:6] = np.cross(axes.T[np.newaxis], beam_m[:, np.newaxis]).transpose(0, 2, 1)
    columns[:, :, 6] = beam_m / np.linalg.norm(beam_m, axis=1, keepdims=True)
    return columns


class ErrorModel:
    """Answers how sure a point is, and how sure the difference of two."""

    def __init__(self, units: Sequence[Unit], correlations: Sequence[Correlation]) -> None:
        """Take units, and the correlations in time of the trajectory's errors by `GROUPS`; lags in seconds.

        Raises:
            ErrorModelError: there is no unit, or one has no posts.
        """
        if not units or len(correlations) != len(GROUPS):
            raise ErrorModelError(f"an error model needs a unit and {len(GROUPS)} correlations in time")
        self.units, self.correlations = tuple(units), tuple(correlations)
        self._names = {(unit.strip, unit.scanner): number for number, unit in enumerate(self.units)}
        self._numbers = _numbers(self.units, self.correlations)

    def unit_of(self, strip: int, scanner: str | None = None) -> int:
        """Return the number of a strip's unit; without a scanner, of the strip's first.

        Raises:
            ErrorModelError: the model has no such unit.
        """
        for number, unit in enumerate(self.units):
            if unit.strip == strip and scanner in (None, unit.scanner):
                return number
        strips = ", ".join(str(one) for one in sorted({unit.strip for unit in self.units}))
        raise ErrorModelError(f"the error model has no strip {strip}; it has {strips}")

    def covariance(self, points_m: FloatArray, time_ns: Int64Array, unit: ArrayLike) -> FloatArray:
        """Return the covariances (n, 3, 3), m², of points (n, 3) at GPS times (n,) of units (n,), or of one unit."""
        points, times, units = self._packed(points_m, time_ns, unit)
        found = np.empty((len(points), 3, 3))
        point_covariances(self._numbers, points, times, units, found)
        return found

    def cross_covariance(
        self,
        first_m: FloatArray, first_ns: Int64Array, first_unit: ArrayLike,
        second_m: FloatArray, second_ns: Int64Array, second_unit: ArrayLike,
    ) -> FloatArray:  # fmt: skip
        """Return the covariances (n, 3, 3), m², of the errors of first points with those of second ones."""
        first = self._packed(first_m, first_ns, first_unit)
        second = self._packed(second_m, second_ns, second_unit)
        found = np.empty((len(first[0]), 3, 3))
        crossed_covariances(self._numbers, *first, *second, found)
        return found

    def difference(
        self,
        first_m: FloatArray, first_ns: Int64Array, first_unit: ArrayLike,
        second_m: FloatArray, second_ns: Int64Array, second_unit: ArrayLike,
    ) -> FloatArray:  # fmt: skip
        """Return the covariances (n, 3, 3), m², of differences of two different returns (ULEM Eq. 2)."""
        crossed = self.cross_covariance(first_m, first_ns, first_unit, second_m, second_ns, second_unit)
        alone = self.covariance(first_m, first_ns, first_unit) + self.covariance(second_m, second_ns, second_unit)
        difference: FloatArray = alone - crossed - np.swapaxes(crossed, 1, 2)
        return difference

    def _packed(
        self, points_m: FloatArray, time_ns: Int64Array, unit: ArrayLike
    ) -> tuple[FloatArray, Int64Array, Int64Array]:
        points = np.ascontiguousarray(points_m, np.float64)
        units = np.broadcast_to(np.asarray(unit, np.int64), len(points)).copy()
        if len(units) and not 0 <= units.min() <= units.max() < len(self.units):
            raise ErrorModelError(
                f"units {units.min()} to {units.max()} were asked for; the error model has 0 to {len(self.units) - 1}"
            )
        return points, np.ascontiguousarray(time_ns, np.int64), units


def _numbers(units: Sequence[Unit], correlations: Sequence[Correlation]) -> Numbers:
    """Pack a model for the loops: posts of all units in a row, everything turned to m."""
    for unit in units:
        if not len(unit.post_ns):
            raise ErrorModelError(f"strip {unit.strip} has no posts in its error model")
    axes = [path_axes(unit.azimuth_rad) for unit in units]
    scanners = sorted({unit.scanner for unit in units})
    most = max(len(unit.calibration) for unit in units)
    calibration = np.zeros((len(units), most, OFFSETS))
    for number, unit in enumerate(units):
        offsets = calibration[number, : len(unit.calibration)]
        offsets[:, :3], offsets[:, 3:6] = (
            unit.calibration[:, :3] @ axes[number].T,
            unit.calibration[:, 3:6] @ axes[number].T,
        )
        offsets[:, 6] = unit.calibration[:, 6]
    ends = np.cumsum([0, *(len(unit.post_ns) for unit in units)])
    return Numbers(
        first_post=ends.astype(np.int64),
        post_ns=np.concatenate([unit.post_ns for unit in units]).astype(np.int64),
        position_m=np.ascontiguousarray(np.concatenate([unit.position_m for unit in units])),
        root=np.ascontiguousarray(
            np.concatenate(
                [post_roots(unit.covariance, np.full(len(unit.post_ns), unit.azimuth_rad)) for unit in units]
            )
        ),
        calibration=calibration,
        scanner=np.array([scanners.index(unit.scanner) for unit in units], np.int64),
        axes=np.ascontiguousarray(axes),
        unmodelled=np.ascontiguousarray(
            [turn @ principal_root(unit.unmodelled) for turn, unit in zip(axes, units, strict=True)]
        ),
        in_space=np.array([[one.as_array() for one in unit.unmodelled_correlation] for unit in units]),
        in_time=np.array([correlations[group].as_array() for group in GROUP_OF]),
        noise=np.array([unit.noise for unit in units]),
    )


def post_roots(covariance: FloatArray, azimuth_rad: FloatArray) -> FloatArray:
    """Return roots R (k, 6, 6), R Rᵀ the covariances in m; each column is an independent error.

    It is the principal root of the correlations, times the sigmas, so that metres and radians do not mix. Positions are
    taken in m and turns in the path system of each azimuth (k,): a tilt comes from accelerometers, turns with the
    aircraft, and after a turn of half a circle has another sign in m.
    """
    turn = np.zeros((len(azimuth_rad), 6, 6))
    turn[:, :3, :3] = np.eye(3)
    turn[:, 3:, 3:] = np.array([path_axes(azimuth) for azimuth in azimuth_rad.tolist()]).reshape(-1, 3, 3)
    back = turn.transpose(0, 2, 1)
    mixed = back @ covariance @ turn
    sigma = np.sqrt(np.maximum(np.diagonal(mixed, axis1=1, axis2=2), LEAST_VARIANCE))
    root: FloatArray = turn @ (
        sigma[:, :, np.newaxis] * principal_root(mixed / (sigma[:, :, np.newaxis] * sigma[:, np.newaxis, :]))
    )
    return root
