"""What an adjustment found: parameters with honest sigmas, what could not be determined, and how good the fit is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from swath.georef.arrays import FloatArray
from swath.georef.records import Int64Array
from swath.georef.scanner.calibration import Calibration


@dataclass(frozen=True, slots=True)
class FixedParameter:
    """A parameter of the model that was not estimated.

    Attributes:
        scanner, name: as ``left``, ``lever_arm_z_m`` (names of `swath.georef.scanner.calibration.PARAMETERS`).
        why: in plain words, for people.
        remedy: the flight line or control that would determine it; empty where it was held at the user's word.
        sigma: with which this flight would have determined it, SI; inf: not at all.
        with_others: parameters it cannot be told apart from, with the correlation.
    """

    scanner: str
    name: str
    why: str
    remedy: str = ""
    sigma: float = np.inf
    with_others: tuple[tuple[str, float], ...] = ()


@dataclass(frozen=True, slots=True)
class Considered:
    """A parameter that kept its start, and what the flight says of that.

    Attributes:
        scanner, name: as ``left``, ``scan_angle_scale``.
        value: at which it is held, SI.
        sigma: one sigma of its error, SI: what is plausible, or what the flight says where that is more.
        told: by how much the flight would change it if it were free, SI; nan: the flight says nothing.
        told_sigma: of that, with what is plausible of all that is held; of what is held without a sigma: of all else.
        contradicted: whether that is more than its sigmas allow.
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
    """Of one group of observations, one row an observation (n,).

    Attributes:
        group: ``planes``, ``ties``, ``control``.
        feature: index of the plane or tie point in `Features`.
        swath: index in `Flight.swaths`; −1: of control.
        at: index of the return in its swath; −1: of control.
        misclosure_m: e = −(w + A δ), metres along the plane's normal (of ties: east, north, up, one row each).
        sigma_m: √M, of the observation alone, with what returns of a moment have in common.
        redundancy: r_i; 0: uncontrolled, 1: fully.
        normalised: w_i = e / √(M r) of data snooping.
        weight: of the robust estimation, 0 … 1; 0: taken out.
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
    """A group of observations as a whole: variance component and what it contributes.

    Attributes:
        observations: all of them, those that were rejected too.
        rms_m: of those that were kept.
        rejected: so many of all.
    """

    group: str
    observations: int
    redundancy: float
    variance_factor: float
    rms_m: float
    rejected: int


@dataclass(frozen=True, slots=True)
class ControlFit:
    """One control point: its misclosure (surveyed − laser, up positive), and what leaving it out would change.

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
    """Corrections of the trajectory that were estimated along (k knots).

    Attributes:
        flown: (k,) index of the trajectory.
        time_ns: (k,).
        strip: (k,) number; 0: between.
        position_l: (k, 3) north, east, down, metres; attitude_rad: (k, 3) small turns about n, e, d.
        position_sigma_l, attitude_sigma_rad: (k, 3) after the adjustment; prior_…: before.
    """

    flown: Int64Array
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
    """The result.

    Attributes:
        calibrations: by scanner, ready to be written but for what a file says besides (id, logs, …): parameters,
            sigmas, correlations, tables.
        names: (u,) of the unknowns as ``left.omega_rad``, ``left.ibrc.3``, ``left.beam.12.azimuth_rad``.
        values, sigmas: (u,) SI; `start`: (u,) before; `prior_sigmas`: (u,) inf: none.
        correlation: (u, u). Sigmas and correlations hold what those considered may have wrong.
        held: what was not estimated, and why.
        considered: (c,) what was held and may be wrong.
        moved: (u, c) by how much one sigma of each of them moves the unknowns, SI.
        trajectory: corrections of it; None: it was taken as free of errors.
        residuals: by group.
        groups: fits by group.
        control: fits by point.
        variance_factor, redundancy: of all.
        global_test: p-value of r σ̂0² as χ²(r).
        iterations, matchings: how often it was linearised; how often correspondences were found anew.
        converged: False: the last step was too large.
        least_detectable: by name: range error (metres) of one return that is found with power 0.8, and the like.
        spectrum: eigenvalues of the reduced normal matrix scaled to unit diagonal, rising.
        scaled: whether sigmas were multiplied by √variance_factor, because the global test rejected; else they are
            what the sigmas of the observations say.
        notes: for people: what was assumed, and what they should know.
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
        """(u, u) SI, with what those considered may have wrong."""
        whole: FloatArray = self.correlation * np.outer(self.sigmas, self.sigmas)
        return whole

    @property
    def movements(self) -> FloatArray:
        """(u, c) `moved`, also where nothing is considered."""
        return self.moved if self.moved.size else np.zeros((len(self.names), len(self.considered)))
