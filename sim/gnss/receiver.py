"""A GNSS receiver: its solutions at its epochs, and their errors.

Epochs stand at whole multiples of the interval since the plan's start. Errors are local (north, east, down); grades and
their sizes are in `swath.sim.gnss.grades`. Without noise only the outages and jumps that the plan scripts remain.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.records import FixType
from swath.sim.gnss import grades
from swath.sim.gnss.noise import Noise
from swath.sim.plan.errors import PlanError
from swath.sim.plan.tables import GnssTable
from swath.sim.site import e_from_geodetic, geodetic_from_e, rot_e_from_ned

INS_RATE_HZ = 100
VELOCITY_AGE_S = {"novatel": 0.05, "ubx": 0.0, "nmea": 0.0}  # velocity lags its epoch; BESTVEL reports the lag


class BodyMotion(Protocol):
    """The part of `swath.sim.flight.trajectory.Motion` that an antenna needs."""

    @property
    def position_e(self) -> FloatArray: ...
    @property
    def velocity_e(self) -> FloatArray: ...
    @property
    def rot_e_from_b(self) -> FloatArray: ...
    @property
    def rate_eb_b(self) -> FloatArray: ...


class Flown(Protocol):
    """The part of `swath.sim.flight.trajectory.Trajectory` that a receiver needs."""

    @property
    def end_s(self) -> float: ...
    def motion(self, time_s: FloatArray) -> BodyMotion: ...
    def attitude(self, time_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]: ...
    def geodetic(self, time_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]: ...
    def velocity_l(self, time_s: FloatArray) -> FloatArray: ...


@dataclass(frozen=True, slots=True)
class Epochs:
    """Solutions of n epochs; where ``fix`` is `FixType.NONE` there is no solution, whatever the other columns hold.

    Attributes:
        index: (n,) number of the epoch, 0 at the plan's start.
        time_s: (n,) time of the position, seconds since the plan's start.
        lat_rad, lon_rad, height_m: (n,) solved position of the antenna; ellipsoidal height.
        velocity_l: (n, 3) velocity of the antenna, north east down, ``velocity_age_s`` (n,) before ``time_s``.
        fix: (n,) values of `FixType`.
        satellites: (n,) number in use.
        position_sigma_l, velocity_sigma_l: (n, 3) as reported.
        heading_rad, pitch_rad: (n,) direction from the primary to the secondary antenna; nan without a secondary
            antenna.
        heading_sigma_rad, pitch_sigma_rad: (n,) as reported.
        position_error_l, velocity_error_l: (n, 3) solution minus truth, jumps included.
        heading_error_rad, pitch_error_rad: (n,) solution minus truth.
    """

    index: Int64Array
    time_s: FloatArray
    lat_rad: FloatArray
    lon_rad: FloatArray
    height_m: FloatArray
    velocity_l: FloatArray
    velocity_age_s: FloatArray
    fix: Int64Array
    satellites: Int64Array
    position_sigma_l: FloatArray
    velocity_sigma_l: FloatArray
    heading_rad: FloatArray
    pitch_rad: FloatArray
    heading_sigma_rad: FloatArray
    pitch_sigma_rad: FloatArray
    position_error_l: FloatArray
    velocity_error_l: FloatArray
    heading_error_rad: FloatArray
    pitch_error_rad: FloatArray


@dataclass(frozen=True, slots=True)
class InsEpochs:
    """Solutions of the receiver's INS for the body's origin, at n epochs.

    Attributes:
        index: (n,) number of the epoch at `INS_RATE_HZ`; time_s: (n,).
        lat_rad, lon_rad, height_m: (n,), ellipsoidal height.
        velocity_l: (n, 3) north east down.
        attitude_rad: (n, 3) roll, pitch, heading 0 … 2π.
        fix: (n,) `FixType` of the satellite solution that the INS uses.
        since_update_s: (n,) time without satellites.
        position_sigma_l, velocity_sigma_l, attitude_sigma_rad: (n, 3) as reported.
        position_error_l, velocity_error_l, attitude_error_rad: (n, 3) solution minus truth.
    """

    index: Int64Array
    time_s: FloatArray
    lat_rad: FloatArray
    lon_rad: FloatArray
    height_m: FloatArray
    velocity_l: FloatArray
    attitude_rad: FloatArray
    fix: Int64Array
    since_update_s: FloatArray
    position_sigma_l: FloatArray
    velocity_sigma_l: FloatArray
    attitude_sigma_rad: FloatArray
    position_error_l: FloatArray
    velocity_error_l: FloatArray
    attitude_error_rad: FloatArray


class Receiver:
    """A receiver with one antenna or two, and optionally an INS of its own.

    Args:
        table: of the plan.
        trajectory: of the body.
        seed, name: names that its errors depend on.
        noise: False leaves only the jumps as errors.

    Raises:
        PlanError: both antennas are at the same place.
    """

    def __init__(self, table: GnssTable, trajectory: Flown, *, seed: int, name: str, noise: bool) -> None:
        self.table, self.trajectory = table, trajectory
        self._grade = grades.GRADES[table.grade]
        self._lever_arm_b = np.array(table.lever_arm_m)
        self._baseline_b = _baseline_b(table, name)
        self._seed, self._name, self._noisy = seed, name, noise
        step_s = 1.0 / table.rate_hz
        grade = self._grade
        self._position = [
            self._noise(("position", "white"), grade.white_m, 0.0, step_s),
            *(self._noise(("position", f"{tau_s:g}"), sigma, tau_s, step_s) for sigma, tau_s in grade.slow_m),
        ]
        self._float = self._noise(("float",), grades.FLOAT_M, grades.FLOAT_TAU_S, step_s)
        self._velocity = self._noise(("velocity",), grade.velocity_mps, 0.0, step_s)
        self._satellites = self._noise(("satellites",), (grades.SATELLITES_SIGMA,), grades.SATELLITES_TAU_S, step_s)
        self._direction = self._direction_noise(step_s)
        self._ins = [
            self._noise(("ins", part), sigma, tau_s, 1.0 / INS_RATE_HZ, smooth=True)
            for part, (sigma, tau_s) in zip(("position", "velocity", "attitude"), _INS_PARTS, strict=True)
        ]

    def epochs(self, first: int, count: int) -> Epochs:
        """Return ``count`` epochs from number ``first`` on; they are equal to rounding however they are requested."""
        index = np.arange(first, first + count)
        time_s = index / self.table.rate_hz
        fix = self._fix(time_s)
        floating = (fix == FixType.RTK_FLOAT)[:, None]
        satellites = np.rint(self._grade.satellites + self._satellites.rows(first, count)[:, 0])
        dilution = np.sqrt(self._grade.satellites / satellites)[:, None]

        error_l = _summed(self._position, first, count, 3)
        error_l += np.where(floating, self._float.rows(first, count), 0.0) + self._jump_l(time_s)
        sigma_l = np.hypot(self._grade.total_m, np.where(floating, grades.FLOAT_M, 0.0))
        motion = self.trajectory.motion(time_s)
        position_e, rot_e_from_l = self._antenna(motion)
        lat_rad, lon_rad, height_m = geodetic_from_e(position_e + _turned(rot_e_from_l, error_l))

        age_s = np.minimum(VELOCITY_AGE_S[self.table.protocol], time_s)
        moved = self.trajectory.motion(time_s - age_s) if age_s.any() else motion
        velocity_error_l = self._velocity.rows(first, count)
        heading, pitch = self._baseline_direction(motion, rot_e_from_l)
        direction_error = _summed(self._direction, first, count, 2)
        direction_sigma = grades.OPTIMISM * self._direction_sigma_rad() * np.ones((count, 1))
        return Epochs(
            index=index,
            time_s=time_s,
            lat_rad=lat_rad,
            lon_rad=lon_rad,
            height_m=height_m,
            velocity_l=self._velocity_l(moved) + velocity_error_l,
            velocity_age_s=age_s,
            fix=fix,
            satellites=np.where(fix == FixType.NONE, 0, satellites).astype(np.int64),
            position_sigma_l=grades.OPTIMISM * dilution * sigma_l,
            velocity_sigma_l=grades.OPTIMISM * dilution * np.array(self._grade.velocity_mps),
            heading_rad=(heading + direction_error[:, 0]) % (2 * np.pi),
            pitch_rad=pitch + direction_error[:, 1],
            heading_sigma_rad=direction_sigma[:, 0],
            pitch_sigma_rad=direction_sigma[:, 1],
            position_error_l=error_l,
            velocity_error_l=velocity_error_l,
            heading_error_rad=direction_error[:, 0],
            pitch_error_rad=direction_error[:, 1],
        )

    def ins_epochs(self, first: int, count: int) -> InsEpochs:
        """Return ``count`` solutions of the INS at `INS_RATE_HZ`; without satellites the INS continues and drifts."""
        index = np.arange(first, first + count)
        time_s = index / INS_RATE_HZ
        drift, since_update_s = self._coasting(time_s)
        position, velocity, attitude = (part.rows(first, count) for part in self._ins)
        sigmas = [np.asarray(sigma) for sigma, _ in _INS_PARTS]
        lat_rad, lon_rad, height_m = self.trajectory.geodetic(time_s)
        moved_e = _turned(rot_e_from_ned(lat_rad, lon_rad), drift * position)
        solved = geodetic_from_e(e_from_geodetic(lat_rad, lon_rad, height_m) + moved_e)
        attitude_rad = np.stack(self.trajectory.attitude(time_s), axis=-1) + attitude
        attitude_rad[:, 2] %= 2 * np.pi
        return InsEpochs(
            index=index,
            time_s=time_s,
            lat_rad=solved[0],
            lon_rad=solved[1],
            height_m=solved[2],
            velocity_l=self.trajectory.velocity_l(time_s) + drift * velocity,
            attitude_rad=attitude_rad,
            fix=self._fix(time_s),
            since_update_s=since_update_s,
            position_sigma_l=drift * sigmas[0],
            velocity_sigma_l=drift * sigmas[1],
            attitude_sigma_rad=np.ones((count, 1)) * sigmas[2],
            position_error_l=drift * position,
            velocity_error_l=drift * velocity,
            attitude_error_rad=attitude,
        )

    # --- geometry ---

    def _antenna(self, motion: BodyMotion) -> tuple[FloatArray, FloatArray]:
        """Return the position (n, 3) of the primary antenna in e and the axes of the local level there (n, 3, 3)."""
        position_e = motion.position_e + motion.rot_e_from_b @ self._lever_arm_b
        lat_rad, lon_rad, _ = geodetic_from_e(position_e)
        return position_e, rot_e_from_ned(lat_rad, lon_rad)

    def _velocity_l(self, motion: BodyMotion) -> FloatArray:
        """Return (n, 3) velocities of the primary antenna, north east down."""
        turning_b = np.cross(motion.rate_eb_b, self._lever_arm_b)
        velocity_e = motion.velocity_e + _turned(motion.rot_e_from_b, turning_b)
        _, rot_e_from_l = self._antenna(motion)
        return _turned(rot_e_from_l.swapaxes(-1, -2), velocity_e)

    def _baseline_direction(self, motion: BodyMotion, rot_e_from_l: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return heading and pitch of the baseline; pitch is positive if the secondary antenna is above the primary."""
        baseline_e = motion.rot_e_from_b @ self._baseline_b
        north, east, down = _turned(rot_e_from_l.swapaxes(-1, -2), baseline_e).T
        return np.arctan2(east, north), np.arctan2(-down, np.hypot(north, east))

    # --- events scripted in the plan ---

    def _fix(self, time_s: FloatArray) -> Int64Array:
        fix = np.full(len(time_s), int(self._grade.fix))
        for outage in self.table.outage:
            back_s = outage.at_s + outage.for_s
            fix[(time_s >= back_s) & (time_s < back_s + self._grade.float_s)] = FixType.RTK_FLOAT
        for outage in self.table.outage:
            fix[(time_s >= outage.at_s) & (time_s < outage.at_s + outage.for_s)] = FixType.NONE
        return fix

    def _jump_l(self, time_s: FloatArray) -> FloatArray:
        offset_l = np.zeros((len(time_s), 3))
        for jump in self.table.jump:
            offset_l[(time_s >= jump.at_s) & (time_s < jump.at_s + jump.for_s)] += jump.offset_l_m
        return offset_l

    def _coasting(self, time_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the factor on the errors of the INS (n, 1) and the time without satellites (n,).

        The factor grows with the square of that time.
        """
        drift, since_s = np.ones(len(time_s)), np.zeros(len(time_s))
        for outage in self.table.outage:
            age_s = np.clip(time_s - outage.at_s, 0.0, outage.for_s)
            behind_s = np.maximum(time_s - outage.at_s - outage.for_s, 0.0)
            drift += (age_s / grades.INS_COAST_S) ** 2 * np.exp(-behind_s / grades.INS_RECOVERY_S)
            since_s = np.maximum(since_s, np.where(time_s < outage.at_s + outage.for_s, age_s, 0.0))
        return drift[:, None], since_s

    # --- errors ---

    def _noise(
        self, part: tuple[str, ...], sigma: ArrayLike, tau_s: float, step_s: float, *, smooth: bool = False
    ) -> Noise:
        size = np.asarray(sigma) * (1.0 if self._noisy else 0.0)
        return Noise(self._seed, ("gnss", self._name, *part), size, tau_s, step_s, smooth=smooth)

    def _direction_sigma_rad(self) -> FloatArray:
        """Return (2,) sigmas of heading and pitch; nan without a second antenna."""
        sigma_rad: FloatArray = np.radians(grades.BASELINE_DEG_M) / np.linalg.norm(self._baseline_b)
        return sigma_rad

    def _direction_noise(self, step_s: float) -> list[Noise]:
        if self.table.secondary_lever_arm_m is None:
            return []
        sigma, slow = self._direction_sigma_rad(), grades.BASELINE_SLOW_SHARE
        return [
            self._noise(("direction", "white"), (1.0 - slow**2) ** 0.5 * sigma, 0.0, step_s),
            self._noise(("direction", "slow"), slow * sigma, grades.BASELINE_TAU_S, step_s),
        ]


_INS_PARTS: tuple[tuple[ArrayLike, float], ...] = (
    grades.INS_POSITION_M,
    grades.INS_VELOCITY_MPS,
    (np.radians(grades.INS_ATTITUDE_DEG[0]), grades.INS_ATTITUDE_DEG[1]),
)


def _baseline_b(table: GnssTable, name: str) -> FloatArray:
    """Return (3,) the vector from the primary to the secondary antenna; nan without a secondary antenna."""
    if table.secondary_lever_arm_m is None:
        return np.full(3, np.nan)
    baseline_b: FloatArray = np.array(table.secondary_lever_arm_m) - np.array(table.lever_arm_m)
    if not baseline_b.any():
        raise PlanError(
            f"gnss.{name}.secondary_lever_arm_m", "equals lever_arm_m; give the position of the second antenna"
        )
    return baseline_b


def _turned(rotations: FloatArray, vectors: FloatArray) -> FloatArray:
    """Return the products (n, 3) of matrices (n, 3, 3) and vectors (n, 3)."""
    turned: FloatArray = np.einsum("nij,nj->ni", rotations, vectors)
    return turned


def _summed(parts: list[Noise], first: int, count: int, columns: int) -> FloatArray:
    """Return (count, columns) the sum of the parts' rows; zero without parts."""
    rows = np.zeros((count, columns))
    for part in parts:
        rows += part.rows(first, count)
    return rows
