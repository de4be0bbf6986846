"""The inertial unit: exact increments from the trajectory, and the errors of its sensors.

A gyroscope triad integrates the body's rotation against inertial space, an accelerometer triad the specific force, both
in the rotating body frame:

    ω_ib^b = ω_eb^b + R_e^b ω_ie^e        f^b = R_e^b (r̈_e + 2 Ω × ṙ_e − γ_e(r))

The force is Newton's law with the derivatives taken in the rotating earth frame. r̈ in inertial space is
r̈_e + 2 Ω × ṙ_e + Ω × (Ω × r), from which the attraction is subtracted. Normal gravity already contains the centrifugal
term Ω × (Ω × r) (γ is attraction − Ω × (Ω × r)), so it must not be added again.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.signal import lfilter

from swath.georef.arrays import FloatArray, Int64Array
from swath.sim.clocks import Oscillator, generator
from swath.sim.gravity import EARTH_RATE_RADPS, RATE_IE_E, gravity_e
from swath.sim.imu.grades import sensor_grades
from swath.sim.plan.errors import PlanError
from swath.sim.plan.tables import ImuNoiseTable, ImuTable

if TYPE_CHECKING:
    from swath.sim.flight.trajectory import Motion, Trajectory


PIECE_S = 0.006  # longest piece integrated at once: relative error 1e-7 for a motion of 20 Hz, 2e-11 for 5 Hz
NODES, WEIGHTS = np.polynomial.legendre.leggauss(3)
DRIFT_RATIO = 4.0  # ratio of neighbouring time constants of the drift
DRIFT_SHORTEST_S = 10.0  # below it white noise hides the drift of any unit
ROTATION_TOLERANCE = 1e-6  # the same as the configuration's


@dataclass(frozen=True, slots=True)
class Increments:
    """Integrals over n intervals, in the body frame of each moment; with a lever arm they hold at the unit's point.

    Attributes:
        angle_b: (n, 3) ∫ ω_ib^b dt, rad.
        velocity_b: (n, 3) ∫ f^b dt, m/s.
    """

    angle_b: FloatArray
    velocity_b: FloatArray


def true_increments(trajectory: Trajectory, edges_s: FloatArray, lever_arm_b: FloatArray | None = None) -> Increments:
    """Return the integrals of perfect sensors between neighbouring times, by the Gauss-Legendre rule of three points.

    Args:
        trajectory: of the body's origin.
        edges_s: (n + 1,) times, ascending.
        lever_arm_b: (3,) from the trajectory's point to the sensors' point, metres; None: they coincide. Its force is
            exact: ω̇ × l integrates to the difference of ω × l, and the rule integrates the rest.
    """
    pieces = int(np.ceil(np.diff(edges_s).max() / PIECE_S))
    share = ((np.arange(pieces)[:, None] + 0.5 * (1.0 + NODES)) / pieces).ravel()
    span_s = np.diff(edges_s)
    motion = trajectory.motion((edges_s[:-1, None] + span_s[:, None] * share).ravel())
    weights = np.tile(0.5 * WEIGHTS / pieces, pieces)

    def integral(values: FloatArray) -> FloatArray:
        summed: FloatArray = np.einsum("nkj,k->nj", values.reshape(len(span_s), len(share), 3), weights)
        return summed * span_s[:, None]

    force_b = specific_force(motion, lever_arm_b)
    velocity_b = integral(force_b)
    if lever_arm_b is not None:
        velocity_b += np.cross(np.diff(trajectory.motion(edges_s).rate_eb_b, axis=0), lever_arm_b)
    return Increments(integral(motion.rate_eb_b + EARTH_RATE_RADPS * motion.rot_e_from_b[:, 2, :]), velocity_b)


def specific_force(motion: Motion, lever_arm_b: FloatArray | None = None) -> FloatArray:
    """Return (n, 3) f^b, m/s², at the unit's point, without the lever arm's ω̇ × l."""
    rot_e_from_b = motion.rot_e_from_b
    position_e, velocity_e = motion.position_e, motion.velocity_e
    extra_b: FloatArray | float = 0.0
    if lever_arm_b is not None:
        swing_b = np.cross(motion.rate_eb_b, lever_arm_b)
        position_e = position_e + rot_e_from_b @ lever_arm_b
        velocity_e = velocity_e + np.einsum("nij,nj->ni", rot_e_from_b, swing_b)
        extra_b = np.cross(motion.rate_eb_b, swing_b)
    force_e = motion.acceleration_e + 2 * np.cross(RATE_IE_E, velocity_e) - gravity_e(position_e)
    force_b: FloatArray = np.einsum("nji,nj->ni", rot_e_from_b, force_e) + extra_b
    return force_b


class SensorErrors:
    """Errors of a unit: values drawn when it is switched on, and noise and drift of each sample.

    Columns are specific force x, y, z, then angular rate x, y, z, in the unit's axes. An output is (I + E) · truth +
    bias + drift + white noise. E has scale factors on its diagonal and, symmetric beside it, the angles by which axes
    lean towards each other. It contains no rotation of the triad, because the body's axes are the triad's mean axes.
    The drift is a sum of Gauss-Markov processes with time constants a factor of four apart, the longest as requested.
    The sum is flicker noise whose Allan deviation is level at the requested instability.

    Args:
        table: of the plan.
        seed, name: names that the random numbers depend on.
        noise: False gives a unit without errors.
    """

    def __init__(self, table: ImuTable, seed: int, name: str, *, noise: bool) -> None:
        if not noise:
            table = table.model_copy(update={"grade": "perfect", "noise": ImuNoiseTable()})
        self._rate_hz = table.rate_hz
        self._names = (seed, "imu", name)
        grades = sensor_grades(table)
        bias, scale, lean = generator(*self._names, "turn-on").standard_normal((3, 2, 3))
        self.bias = np.concatenate([grade.bias * bias[number] for number, grade in enumerate(grades)])
        self.matrices = np.stack(
            [
                error_matrix(grade.scale * scale[number], grade.misalignment_rad * lean[number])
                for number, grade in enumerate(grades)
            ]
        )
        self.constants_s = drift_constants(grades[0].correlation_s)
        level = drift_level(self.constants_s)
        self._white = np.repeat([grade.random_walk for grade in grades], 3) * np.sqrt(self._rate_hz)
        self._drift = np.repeat([grade.instability for grade in grades], 3) / level
        start = generator(*self._names, "drift").standard_normal((len(self.constants_s), 6))
        self._starts = [start]  # start of each second's drift, in units of its sigma

    def of_second(self, second: int) -> FloatArray:
        """Return (rate, 6) bias, drift and white noise of the samples of a second."""
        while len(self._starts) <= second:
            last = len(self._starts) - 1
            self._starts.append(self._drift_of(last, self._draws(last))[-1])
        draws = self._draws(second)
        drift = self._drift_of(second, draws).sum(axis=1)
        errors: FloatArray = self.bias + self._drift * drift + self._white * draws[:, -1]
        return errors

    def _draws(self, second: int) -> FloatArray:
        """Return (rate, processes + 1, 6) random numbers that drive the drift, and last those of the white noise."""
        shape = (self._rate_hz, len(self.constants_s) + 1, 6)
        return generator(*self._names, "noise", second).standard_normal(shape)

    def _drift_of(self, second: int, draws: FloatArray) -> FloatArray:
        """Return (rate, processes, 6) Gauss-Markov processes of sigma 1, sampled exactly."""
        drift = np.empty((self._rate_hz, len(self.constants_s), 6))
        for number, kept in enumerate(np.exp(-1.0 / (self._rate_hz * self.constants_s))):
            drive = np.sqrt(1 - kept * kept) * draws[:, number]
            before = kept * self._starts[second][None, number]
            drift[:, number], _ = lfilter([1.0], [1.0, -kept], drive, axis=0, zi=before)
        return drift


def error_matrix(scale: FloatArray, lean_rad: FloatArray) -> FloatArray:
    """Return (3, 3) I + E of scale factors (3,) and of the angles (3,) between y and z, z and x, x and y."""
    x, y, z = lean_rad
    matrix: FloatArray = np.eye(3) + np.diag(scale) + np.array([[0.0, z, y], [z, 0.0, x], [y, x, 0.0]])
    return matrix


def drift_constants(longest_s: float) -> FloatArray:
    """Return (k,) time constants of the drift, seconds, longest first."""
    count = 1 + max(int(np.log(longest_s / DRIFT_SHORTEST_S) / np.log(DRIFT_RATIO)), 0)
    constants_s: FloatArray = longest_s * DRIFT_RATIO ** -np.arange(count, dtype=np.float64)
    return constants_s


def drift_level(constants_s: FloatArray) -> float:
    """Return the greatest Allan deviation of a sum of Gauss-Markov processes of sigma 1 with these time constants.

    The Allan variance of one process is IEEE Std 952-1997, annex C, Eq. C.20, with q_c² T_c = 2 σ².
    """
    tau_s = np.geomspace(constants_s.min() / 10, 10 * constants_s.max(), 2000)
    n = tau_s[:, None] / constants_s
    variance = (2 / n * (1 - (3 - 4 * np.exp(-n) + np.exp(-2 * n)) / (2 * n))).sum(axis=1)
    return float(np.sqrt(variance.max()))


class InertialUnit:
    """An inertial unit at the body's origin, sampled by its own oscillator.

    Sample k ends when its counter has gained k · tick_hz / rate_hz since the plan's start; sample 1 is the first. The
    unit reports the mean over the interval: the increment divided by the interval as its own clock counts it, 1 /
    rate_hz. The means are therefore wrong by the parts per million of its clock, and times wander against GPS as in a
    real unit. Values are computed in whole seconds of samples, whichever samples are requested.

    Args:
        table: of the plan.
        trajectory: of the body's origin.
        seed, name: names that its errors depend on; the name is the plan's.
        noise: False gives perfect sensors.
        lever_arm_b: (3,) from the trajectory's point to the unit, metres.

    Raises:
        PlanError: rotation_b_imu is not a rotation.
    """

    def __init__(
        self,
        table: ImuTable,
        trajectory: Trajectory,
        seed: int,
        name: str,
        *,
        noise: bool,
        lever_arm_b: FloatArray | None = None,
    ) -> None:
        self.table, self.name, self.seed, self.noise = table, name, seed, noise
        self.oscillator = Oscillator(table.tick_hz, table.oscillator)
        self.errors = SensorErrors(table, seed, name, noise=noise)
        self._trajectory, self._lever_arm_b = trajectory, lever_arm_b
        rot_b_from_imu = np.array(table.rotation_b_imu)
        off = np.abs(rot_b_from_imu @ rot_b_from_imu.T - np.eye(3)).max()
        if off > ROTATION_TOLERANCE or np.linalg.det(rot_b_from_imu) < 0.0:
            text = f"not a rotation: rows are off by {off:.2g}, determinant {np.linalg.det(rot_b_from_imu):.6g}, want 1"
            raise PlanError(f"imu.{name}.rotation_b_imu", text)
        self._rot_imu_from_b = np.linalg.inv(rot_b_from_imu)
        self.last = self.count(trajectory.end_s)
        self._kept: dict[int, FloatArray] = {}  # values of the last two seconds: a request may span both

    def ends_s(self, number: FloatArray | Int64Array) -> FloatArray:
        """Return (n,) true times at which samples (n,) end."""
        return self.oscillator.time_of(np.asarray(number, np.float64) * self.table.tick_hz / self.table.rate_hz)

    def count(self, stop_s: float) -> int:
        """Return the number of samples that have ended at this time."""
        phase = self.oscillator.phase(np.array([stop_s]))
        number = np.floor(phase * self.table.rate_hz / self.table.tick_hz) + np.array([1.0, 0.0, -1.0])
        return max(int(number[np.argmax(self.ends_s(number) <= stop_s)]), 0)

    def samples(self, first: int, count: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return samples by number.

        Returns:
            (n,) true times at which their intervals end, (n, 3) specific force m/s², (n, 3) angular rate rad/s, in the
            unit's own axes.

        Raises:
            ValueError: the flight has no such samples.
        """
        if first < 1 or first + count - 1 > self.last:
            raise ValueError(f"samples {first} to {first + count - 1}: the flight has 1 to {self.last}")
        rate_hz = self.table.rate_hz
        number = np.arange(first, first + count)
        values = np.empty((count, 6))
        for second in np.unique(number // rate_hz).tolist():
            inside = number // rate_hz == second
            values[inside] = self._second(second)[number[inside] - max(second * rate_hz, 1)]
        return self.ends_s(number), values[:, :3], values[:, 3:]

    def drawn(self) -> dict[str, FloatArray]:
        """Return the values drawn at switch-on, in the unit's own axes: biases (3,), error matrices (3, 3)."""
        return {
            "accel_bias_mps2": self.errors.bias[:3],
            "gyro_bias_radps": self.errors.bias[3:],
            "accel_matrix": self.errors.matrices[0],
            "gyro_matrix": self.errors.matrices[1],
        }

    def _second(self, second: int) -> FloatArray:
        """Return (n, 6) values of the samples of a second, from second · rate_hz on.

        The flight may end earlier, and there is no sample 0.
        """
        if second not in self._kept:
            rate_hz = self.table.rate_hz
            begin, end = max(second * rate_hz, 1), min((second + 1) * rate_hz, self.last + 1)
            errors = self.errors.of_second(second)[begin - second * rate_hz : end - second * rate_hz]
            newest = {number: self._kept[number] for number in list(self._kept)[-1:]}
            self._kept = newest | {second: self._means(begin, end) + errors}
        return self._kept[second]

    def _means(self, begin: int, end: int) -> FloatArray:
        """Return (n, 6) means of samples ``begin`` to before ``end``, with scale factors and leaning axes."""
        increments = true_increments(self._trajectory, self.ends_s(np.arange(begin - 1, end)), self._lever_arm_b)
        accelerometers, gyroscopes = self.errors.matrices @ self._rot_imu_from_b
        sensed = [increments.velocity_b @ accelerometers.T, increments.angle_b @ gyroscopes.T]
        return self.table.rate_hz * np.concatenate(sensed, axis=1)
