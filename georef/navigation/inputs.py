"""Inputs and outputs of navigation: inertial samples, observations, noise, installation, start, solution.

SI units, radians, GPS time in nanoseconds; frames as in `swath.georef.navigation`.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np

from swath.georef.arrays import BoolArray, FloatArray, Int64Array, StructArray
from swath.georef.trajectory.trajectory import DEFAULT_MAX_GAP_NS, Trajectory

ARM_UNSAID_M = 2.0  # prior sigma of a lever arm that is not configured: it is estimated with the flight
_SQRT_HOUR = 60.0  # √3600 s
_HOUR_S = 3600.0
_MILLI_G = 9.80665e-3  # m/s², the standard g₀ / 1000


class NavigationError(ValueError):
    """Raised for input that navigation cannot use; one line for the user."""


class Kind(IntEnum):
    """The quantity of an observation."""

    POSITION = 0
    VELOCITY = 1
    HEADING = 2  # direction of the baseline between two antennas
    ZERO_VELOCITY = 3
    NON_HOLONOMIC = 4  # zero velocity of a ground vehicle sideways and through its floor
    HEIGHT = 5  # barometer
    ATTITUDE = 6  # roll, pitch, heading of a device's own solution


class Fate(IntEnum):
    """The fate of an observation."""

    TAKEN = 0
    INFLATED = 1  # beyond the gate, taken with a larger sigma
    REJECTED = 2  # far beyond the gate
    REACQUIRED = 3  # beyond the gate after a time without, or after many refusals (which widened the state): taken
    UNUSABLE = 4  # not finite, without sigma or fix, or without anything comparable to the state
    OUTSIDE = 5  # before the start, after the last sample, or too late for a filter that has moved on


OBSERVATION_DTYPE = np.dtype(
    [
        ("time_ns", "<i8"),
        ("kind", "u1"),  # Kind
        ("fix_type", "u1"),  # records.FixType
        ("satellites", "u1"),
        ("antenna", "u1"),  # row of Setup.lever_arms_b
        ("value", "<f8", (3,)),  # m in e | m/s north, east, down | heading, pitch (nan: missing) | height | rad
        ("sigma", "<f8", (3,)),  # m north, east, down | m/s north, east, down | rad
        ("correlation", "<f8", (3,)),  # of north–east, north–down, east–down; 0 if missing
    ]
)

INNOVATION_DTYPE = np.dtype(
    [
        ("time_ns", "<i8"),
        ("kind", "u1"),
        ("fate", "u1"),  # Fate
        ("fix_type", "u1"),
        ("satellites", "u1"),
        ("antenna", "u1"),
        ("dimension", "u1"),  # number of components used; the others are nan below
        ("value", "<f8", (3,)),  # observed − computed; positions and velocities north, east, down
        ("sigma", "<f8", (3,)),  # predicted, of the innovation, before any inflation
        ("normalised", "<f8", (3,)),  # whitened by the Cholesky factor of the innovation's covariance
        ("chi2", "<f8"),  # their sum of squares
        ("log_det", "<f8"),  # ln of the determinant of the innovation's covariance
        ("inflation", "<f8"),  # factor on the observation's sigma
    ]
)


def sort_observations(rows: StructArray) -> StructArray:
    """Sort by time; rows of one time by kind and antenna, equal ones in the order given."""
    order = np.lexsort((rows["antenna"], rows["kind"], rows["time_ns"]))
    return rows[order]


@dataclass(frozen=True, eq=False)
class Inertial:
    """Increments of a strapdown unit over n intervals, in the body frame of each moment.

    Attributes:
        time_ns: (n,) END of each interval, strictly rising.
        interval_s: (n,) length; the interval begins where the one before ends unless samples are missing.
        angle_b: (n, 3) ∫ ω_ib^b dt, rad.
        velocity_b: (n, 3) ∫ f^b dt, m/s.
        bridged: (n,) the interval is made up over a gap.
    """

    time_ns: Int64Array
    interval_s: FloatArray
    angle_b: FloatArray
    velocity_b: FloatArray
    bridged: BoolArray

    def __post_init__(self) -> None:
        """Refuse columns that differ in length, or times that do not rise, with `NavigationError`."""
        n = len(self.time_ns)
        shapes = (self.interval_s.shape, self.angle_b.shape, self.velocity_b.shape, self.bridged.shape)
        if shapes != ((n,), (n, 3), (n, 3), (n,)):
            raise NavigationError(f"inertial samples: columns of {n} times have shapes {shapes}")
        if n > 1 and not (np.diff(self.time_ns) > 0).all():
            at = int(np.argmax(np.diff(self.time_ns) <= 0)) + 1
            raise NavigationError(f"inertial samples: time does not increase at sample {at}")

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.time_ns)

    def between(self, first: int, last: int) -> Inertial:
        """Return samples first to last − 1, as views."""
        part = slice(first, last)
        return Inertial(
            self.time_ns[part], self.interval_s[part], self.angle_b[part], self.velocity_b[part], self.bridged[part]
        )


@dataclass(frozen=True)
class ImuNoise:
    """Noise of an inertial unit, one standard deviation, equal for every axis.

    Attributes:
        angle_random_walk: rad/√s.
        velocity_random_walk: m/s/√s.
        gyro_bias, accel_bias: rad/s, m/s², Gauss–Markov of `bias_correlation_s`.
        bias_correlation_s: e-folding time.
        gyro_scale, accel_scale: errors of the scale factors, 1, constant.
        misalignment: rad, of the angles by which axes of a triad lean towards each other, constant; 0: they are
            perpendicular, and the angles are not estimated.
    """

    angle_random_walk: float
    velocity_random_walk: float
    gyro_bias: float
    accel_bias: float
    bias_correlation_s: float = 3600.0
    gyro_scale: float = 0.0
    accel_scale: float = 0.0
    misalignment: float = 0.0


def imu_noise(
    angle_random_walk_deg_per_sqrt_h: float,
    velocity_random_walk_m_per_s_per_sqrt_h: float,
    gyro_bias_deg_per_h: float,
    accel_bias_mg: float,
    bias_correlation_h: float = 1.0,
    gyro_scale_ppm: float = 0.0,
    accel_scale_ppm: float = 0.0,
    misalignment_mrad: float = 0.0,
) -> ImuNoise:
    """Return `ImuNoise` from the units of data sheets and of the configuration."""
    return ImuNoise(
        angle_random_walk=float(np.radians(angle_random_walk_deg_per_sqrt_h)) / _SQRT_HOUR,
        velocity_random_walk=velocity_random_walk_m_per_s_per_sqrt_h / _SQRT_HOUR,
        gyro_bias=float(np.radians(gyro_bias_deg_per_h)) / _HOUR_S,
        accel_bias=accel_bias_mg * _MILLI_G,
        bias_correlation_s=bias_correlation_h * _HOUR_S,
        gyro_scale=gyro_scale_ppm * 1e-6,
        accel_scale=accel_scale_ppm * 1e-6,
        misalignment=misalignment_mrad * 1e-3,
    )


GRADES: dict[str, ImuNoise] = {
    "navigation": imu_noise(0.002, 0.005, 0.0035, 0.025, 1.0, 5.0, 100.0),
    "tactical": imu_noise(0.1, 0.03, 1.0, 1.0, 1.0, 300.0, 300.0, 0.1),
    "mems": imu_noise(0.3, 0.07, 36.0, 3.0, 1.0, 1000.0, 1000.0, 0.5),
    "consumer": imu_noise(0.5, 0.24, 1500.0, 80.0, 1.0, 10_000.0, 10_000.0, 10.0),
}
"""Classes as data sheets have them: Honeywell HG9900; iMAR IMU-FSAS, Honeywell HG1700; Analog Devices ADIS16488 with
accelerometers as a Sensonor STIM300's; InvenSense MPU-6050 (PS-MPU-6000A 3.4: accelerometers ±50 and ±80 mg, 400
µg/√Hz, scale factors ±3 %, across axes ±2 %, taken for limits; gyroscopes 0.005 °/s/√Hz), the gyroscopes' bias between
the 360 and 3600 °/h that El-Sheimy and Youssef 2020 and the Xsens MTi-G's sheet have. Other misalignments are of the
size such units have, and of no sheet. Those of the first would be below 0.01 mrad, 0.002° of heading after half a turn.
"""


def _no_arms() -> FloatArray:
    return np.zeros((1, 3))


@dataclass(frozen=True, eq=False)
class Setup:
    """Installation, noise and rules of one filter.

    Attributes:
        noise: of the inertial unit.
        lever_arms_b: (k, 3) body origin → phase centre of antenna 0 … k − 1, m.
        baseline_b: (3,) primary → secondary antenna, m; None: no dual-antenna heading.
        estimate_lever_arm: prior sigma of antenna 0's lever arm, m; 0: it is known.
        estimate_time_offset_s: prior sigma of the GNSS time offset; 0: no offset. It is added to GNSS stamps to get the
            inertial unit's time (positive: GNSS stamps are early, or inertial ones late).
        gnss_correlation_s: e-folding time of the GNSS positions' common error.
        gnss_correlated_share: share (0 … 1) of the positions' variance that is time-correlated; 0: white.
        gnss_velocity_correlation_s, gnss_velocity_share: the same of the velocities.
        gnss_heading_correlation_s, gnss_heading_share: the same of dual-antenna headings and their pitch.
        height_bias_m: prior sigma of a barometer's bias; 0: heights have no bias.
        height_correlation_s: e-folding time of that bias.
        position_floor_m, velocity_floor_mps: the least sigma used; for positions without a fixed solution it is larger.
        attitude_floor_rad: the same of headings and attitudes.
        gate_probability: probability that a sound observation exceeds the gate.
        reject_factor: times the gate's radius beyond which an observation is rejected; up to there it is inflated.
        reacquire_after: number of successive rejections of one kind, over at least `reacquire_s`, that widens the
            state.
        reacquire_s: see there, for positions that leapt six times as long (`gate.leapt`); and the time for which a
            state that has drifted, or has just begun, may settle.
        node_s: longest time between nodes of the smoother.
        step_s: longest step of the covariance.
        gnss_sigma_scale, gnss_velocity_scale: by fix type, factor on positions' and velocities' sigmas, floors included
            (as found by an earlier pass).
        gnss_vertical_scale, gnss_velocity_vertical_scale: by fix type, a further factor on those of the vertical.
        gnss_heading_scale: factor on those of headings.
    """

    noise: ImuNoise
    lever_arms_b: FloatArray = field(default_factory=_no_arms)
    baseline_b: FloatArray | None = None
    estimate_lever_arm: float = 0.0
    estimate_time_offset_s: float = 0.0
    gnss_correlation_s: float = 60.0
    gnss_correlated_share: float = 0.0
    gnss_velocity_correlation_s: float = 2.0
    gnss_velocity_share: float = 0.0
    gnss_heading_correlation_s: float = 60.0
    gnss_heading_share: float = 0.0
    height_bias_m: float = 10.0
    height_correlation_s: float = 3600.0
    position_floor_m: float = 0.005
    velocity_floor_mps: float = 0.01
    attitude_floor_rad: float = 5e-4
    gate_probability: float = 1e-3
    reject_factor: float = 5.0
    reacquire_after: int = 5
    reacquire_s: float = 5.0
    node_s: float = 1.0
    step_s: float = 0.1
    gnss_sigma_scale: dict[int, float] = field(default_factory=dict)
    gnss_velocity_scale: dict[int, float] = field(default_factory=dict)
    gnss_vertical_scale: dict[int, float] = field(default_factory=dict)
    gnss_velocity_vertical_scale: dict[int, float] = field(default_factory=dict)
    gnss_heading_scale: float = 1.0


@dataclass(frozen=True, eq=False)
class Start:
    """The start of navigation; the sensors' errors begin at zero with the sigmas of their noise.

    Attributes:
        time_ns: GPS time.
        position_e: (3,) m of the body's origin.
        velocity_l: (3,) north, east, down, m/s.
        attitude_rad: (3,) roll, pitch, heading.
        position_sigma_l, velocity_sigma_l: (3,) north, east, down.
        attitude_sigma_rad: (3,) of roll, pitch, heading.
    """

    time_ns: int
    position_e: FloatArray
    velocity_l: FloatArray
    attitude_rad: FloatArray
    position_sigma_l: FloatArray
    velocity_sigma_l: FloatArray
    attitude_sigma_rad: FloatArray


@dataclass(frozen=True, eq=False)
class Solution:
    """A navigated trajectory of the body's origin.

    A solution of `swath.georef.navigation.solve` is in GNSS's time if a time offset was estimated. The smoothed one's
    position sigmas hold at that time, the forward one's at the time that the filter assumed then.

    Attributes:
        time_ns: (n,) epochs.
        position_e, velocity_e: (n, 3) m, m/s relative to the earth.
        q_e_from_b: (n, 4) scalar first.
        position_sigma_l, velocity_sigma_l: (n, 3) north, east, down.
        attitude_sigma_rad: (n, 3) roll, pitch, heading.
        bridged: (n,) whether the inertial sample that ends at the epoch was made up.
        node_time_ns: (m,) the smoother's nodes.
        gyro_bias, accel_bias, gyro_scale, accel_scale: (m, 3) estimates, b.
        gyro_bias_sigma, accel_bias_sigma, gyro_scale_sigma, accel_scale_sigma: (m, 3).
        gyro_misalignment, accel_misalignment: (m, 3) rad by which axes y and z, z and x, x and y lean towards each
            other, and their sigmas; (0, 3) where not estimated.
        lever_arm_b, lever_arm_sigma: (m, 3) of antenna 0, m; constant with sigma 0 where not estimated.
        time_offset_s, time_offset_sigma_s: (m,) of GNSS; 0 where not estimated.
        innovations: INNOVATION_DTYPE, one per observation, whatever its fate.
        counts: events, by name.
        separation: (m, 9) forward − smoothed of position and velocity north, east, down, of roll, pitch, heading; (0,
            9) in a forward solution.
        separation_sigma: (m, 9) its predicted sigma, √(P forward − P smoothed).
    """

    time_ns: Int64Array
    position_e: FloatArray
    velocity_e: FloatArray
    q_e_from_b: FloatArray
    position_sigma_l: FloatArray
    velocity_sigma_l: FloatArray
    attitude_sigma_rad: FloatArray
    bridged: BoolArray
    node_time_ns: Int64Array
    gyro_bias: FloatArray
    accel_bias: FloatArray
    gyro_scale: FloatArray
    accel_scale: FloatArray
    gyro_bias_sigma: FloatArray
    accel_bias_sigma: FloatArray
    gyro_scale_sigma: FloatArray
    accel_scale_sigma: FloatArray
    lever_arm_b: FloatArray
    lever_arm_sigma: FloatArray
    time_offset_s: FloatArray
    time_offset_sigma_s: FloatArray
    innovations: StructArray
    counts: Counter[str]
    separation: FloatArray = field(default_factory=lambda: np.zeros((0, 9)))
    separation_sigma: FloatArray = field(default_factory=lambda: np.zeros((0, 9)))
    gyro_misalignment: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    accel_misalignment: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    gyro_misalignment_sigma: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    accel_misalignment_sigma: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))

    def __len__(self) -> int:
        """Return the number of epochs."""
        return len(self.time_ns)

    def trajectory(self, max_gap_ns: int = DEFAULT_MAX_GAP_NS, name: str = "navigation") -> Trajectory:
        """Return the solution as a `Trajectory` for georeferencing."""
        return Trajectory(
            self.time_ns,
            self.position_e,
            self.q_e_from_b,
            self.velocity_e,
            self.position_sigma_l,
            self.attitude_sigma_rad,
            max_gap_ns,
            name,
        )
