"""Results of an adjustment: parameters with realistic sigmas, undetermined parameters, and the quality of the fit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.scanner.calibration import Calibration


@dataclass(frozen=True, slots=True)
class FixedParameter:
    """A parameter of the model that was not estimated.

    Attributes:
        scanner, name: as ``left``, ``lever_arm_z_m`` (names of `swath.georef.scanner.calibration.PARAMETERS`).
        why: the reason in plain words, for display.
        remedy: the flight line or control that would determine it; empty where the user asked to hold it.
        sigma: sigma with which this flight would have determined it, SI; inf: not at all.
        with_others: parameters from which it cannot be separated, with the correlation.
    """

    scanner: str
    name: str
    why: str
    remedy: str = ""
    sigma: float = np.inf
    with_others: tuple[tuple[str, float], ...] = ()


@dataclass(frozen=True, slots=True)
class Considered:
    """A parameter that kept its start, and the flight's own estimate of it.

    Attributes:
        scanner, name: as ``left``, ``scan_angle_scale``.
        value: value at which it is held, SI.
        sigma: one sigma of its error, SI: the plausible one, or the flight's estimate where that is larger.
        told: change that the flight would make if it were free, SI; nan: the flight cannot estimate it.
        told_sigma: sigma of `told`, with the plausible errors of all held parameters; for a parameter held without a
            sigma, with those of all others.
        contradicted: whether `told` is larger than its sigmas allow.
    """

    scanner: str
    name: str
    value: float
    sigma: float
    told: float = np.nan
    told_sigma: float = np.inf
    contradicted: bool = False


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals of one group of observations, one row per observation (n,).

    Attributes:
        group: ``planes``, ``ties``, ``control``.
        feature: index of the plane or tie point in `Features`.
        swath: index in `Flight.swaths`; −1: of control.
        at: index of the return in its swath; −1: of control.
        misclosure_m: e = −(w + A δ), metres along the plane's normal (of ties: east, north, up, one row each).
        sigma_m: √M, of the observation alone, with the errors that returns of one moment share.
        redundancy: r_i; 0: uncontrolled, 1: fully.
        normalised: w_i = e / √(M r) of data snooping.
        weight: of the robust estimation, 0 … 1; 0: excluded.
    """

    group: str
    feature: Int64Array
    swath: Int64Array
    at: Int64Array
    misclosure_m: FloatArray
    sigma_m: FloatArray
    redundancy: FloatArray
    normalised: FloatArray
    weight: FloatArray


@dataclass(frozen=True, slots=True)
class GroupFit:
    """Fit of a whole group of observations: its variance component and contribution.

    Attributes:
        observations: number of all observations, including rejected ones.
        rms_m: rms of the kept observations.
        rejected: number of rejected observations.
    """

    group: str
    observations: int
    redundancy: float
    variance_factor: float
    rms_m: float
    rejected: int


@dataclass(frozen=True, slots=True)
class ControlFit:
    """Fit of one control point: its misclosure (surveyed − laser, up positive) and the effect of leaving it out.

    Attributes:
        influence: change of each estimated parameter without this point, in its sigmas, by ``scanner.name``.
    """

    name: str
    misclosure_m: float
    sigma_m: float
    normalised: float
    influence: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class TrajectoryFit:
    """Corrections of the trajectory, estimated along with the parameters (k knots).

    Attributes:
        trajectory_index: (k,) index of the trajectory.
        time_ns: (k,).
        strip: (k,) number; 0: between strips.
        position_l: (k, 3) north, east, down, metres; attitude_rad: (k, 3) small turns about n, e, d.
        position_sigma_l, attitude_sigma_rad: (k, 3) after the adjustment; prior_…: before.
    """

    trajectory_index: Int64Array
    time_ns: Int64Array
    strip: Int64Array
    position_l: FloatArray
    attitude_rad: FloatArray
    position_sigma_l: FloatArray
    attitude_sigma_rad: FloatArray
    prior_position_sigma_l: FloatArray
    prior_attitude_sigma_rad: FloatArray


@dataclass(frozen=True, eq=False)
class Adjusted:
    """The result of an adjustment.

    Attributes:
        calibrations: by scanner, with parameters, sigmas, correlations and tables; complete except for a file's header
            (id, logs, …).
        names: (u,) of the unknowns as ``left.omega_rad``, ``left.ibrc.3``, ``left.beam.12.azimuth_rad``.
        values, sigmas: (u,) SI; `start`: (u,) before; `prior_sigmas`: (u,) inf: no prior.
        correlation: (u, u). Sigmas and correlations include the possible errors of the considered parameters.
        held: parameters that were not estimated, and why.
        considered: (c,) held parameters that may be wrong.
        moved: (u, c) change of the unknowns by one sigma of each considered parameter, SI.
        trajectory: corrections of the trajectory; None: it was taken as free of errors.
        residuals: by group.
        groups: fits by group.
        control: fits by point.
        variance_factor, redundancy: of all observations.
        global_test: p-value of r σ̂0² as χ²(r).
        iterations, matchings: number of linearisations; number of searches for correspondences.
        converged: False: the last step was too large.
        least_detectable: by name: range error (metres) of one return that is found with power 0.8, and the like.
        spectrum: eigenvalues of the reduced normal matrix scaled to unit diagonal, rising.
        scaled: whether sigmas were multiplied by √variance_factor, because the global test rejected; otherwise they
            follow from the sigmas of the observations.
        notes: assumptions and warnings for the user.
        planes_e: (q, 4) unit normals in e and s4 of the planes as adjusted: s · (x, 1) = 0.
    """

    calibrations: Mapping[str, Calibration]
    names: tuple[str, ...]
    start: FloatArray
    values: FloatArray
    sigmas: FloatArray
    prior_sigmas: FloatArray
    correlation: FloatArray
    held: tuple[FixedParameter, ...]
    trajectory: TrajectoryFit | None
    residuals: tuple[Residuals, ...]
    groups: tuple[GroupFit, ...]
    control: tuple[ControlFit, ...]
    variance_factor: float
    redundancy: float
    global_test: float
    iterations: int
    matchings: int
    converged: bool
    least_detectable: Mapping[str, float] = field(default_factory=dict)
    spectrum: FloatArray = field(default_factory=lambda: np.zeros(0))
    scaled: bool = False
    notes: tuple[str, ...] = ()
    planes_e: FloatArray = field(default_factory=lambda: np.zeros((0, 4)))
    considered: tuple[Considered, ...] = ()
    moved: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))

    @property
    def covariance(self) -> FloatArray:
        """Covariance (u, u) in SI, including the possible errors of the considered parameters."""
        whole: FloatArray = self.correlation * np.outer(self.sigmas, self.sigmas)
        return whole

    @property
    def movements(self) -> FloatArray:
        """The matrix `moved` (u, c), with its full shape even if no parameter is considered."""
        return self.moved if self.moved.size else np.zeros((len(self.names), len(self.considered)))
