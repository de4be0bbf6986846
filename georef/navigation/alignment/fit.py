"""Fit attitude, velocity and position at a moment by least squares, so that sensor integrals match GNSS before it.

The frame of computation does not turn: it has the axes of l at the moment T. With the integrals of `alignment_blocks`,

    velocity of an antenna at t = v − R α(t) − ∫_t^T γ + R D(t) (ω × l)
    position of an antenna at t = p − v (T − t) + R ∫_t^T α + ∫∫ γ + R D(t) l

γ is gravitation, R = rot_l_from_b at T. R, v, p and the sensors' biases and scale factors are unknown, the last two
with the sigmas of the unit's noise, so that the covariance shows what the motion left undetermined: at rest, the
heading is known as well as the gyroscopes distinguish the earth's rate from their bias. The sensors' noise correlates
the residuals (random walks of attitude and velocity, integrated); its covariance is added to GNSS's.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import solve_triangular

from swath.georef.arrays import BoolArray, FloatArray, Int64Array, StructArray
from swath.georef.geodesy.earth import geodetic_from_e, rot_e_from_l
from swath.georef.geodesy.quaternions import rotation_vector
from swath.georef.geodesy.rotations import quaternion_from_rot, rot_l_from_b, rot_z, skew
from swath.georef.navigation.alignment.blocks import Felt
from swath.georef.navigation.alignment.frame import RATE_IE_E, Frame
from swath.georef.navigation.alignment.noise import covariances as noise_covariances
from swath.georef.navigation.alignment.noise import spaced_headings
from swath.georef.navigation.inputs import Kind, Setup

TILT, VELOCITY, PLACE, GYRO, ACCEL, ARM = (
    slice(0, 3),
    slice(3, 6),
    slice(6, 9),
    slice(9, 15),
    slice(15, 21),
    slice(21, 24),
)
UNKNOWNS = 24
NO_ROWS = np.zeros((0, 1 + UNKNOWNS))
PRIOR = (2.0, 200.0, 200.0)  # rad, m/s, m: wide enough to mean no knowledge, but finite for a stable inversion
ITERATIONS = 8
CONVERGED = 1e-3  # sigmas
OUTLIER, SOUND = 6.0, 3.0  # sigmas of a row, and misfit, above which a row may be left out
MOST_OUTLIERS = 4
HELPED = 0.7  # times the misfit: the reduction that leaving a row out must achieve


@dataclass(frozen=True, eq=False)
class Fitted:
    """The result of a fit at T.

    Attributes:
        rot_l_from_b: (3, 3).
        position_e: (3,) of the body's origin.
        velocity_l: (3,) relative to the earth.
        arm_b: (3,) correction of the lever arms in b, m; zero if they are held fixed.
        covariance: (24, 24) of attitude about north, east, down, of velocity, position, sensors' errors, lever arm.
        cost: weighted sum of squares, with that of the course and of the sensors' sigmas.
        misfit: reduced χ² of GNSS's residuals.
        left: (m, 3) these residuals, velocities then positions.
        gyro_scale: (3,) scale factors of the gyroscopes.
    """

    rot_l_from_b: FloatArray
    position_e: FloatArray
    velocity_l: FloatArray
    arm_b: FloatArray
    covariance: FloatArray
    cost: float
    misfit: float
    left: FloatArray
    gyro_scale: FloatArray

    def sigma(self, part: slice) -> FloatArray:
        """Return sigmas (3,) of attitude, velocity or position; larger where the residuals exceed their sigmas."""
        variance: FloatArray = np.diag(self.covariance)[part] * max(self.misfit, 1.0)
        sigma: FloatArray = np.sqrt(variance)
        return sigma


class Problem:
    """Observations of a window together with the sensor integrals over it.

    Args:
        felt: integrals back to T.
        rows: observations within `felt`, usable, by time; POSITION among them.
        setup: lever arms, baseline, noise, floors.
        still: (m,) GPS times at which the vehicle stands still.
        arm_sigma_m: sigma of a common correction of the lever arms; 0: they are held fixed.
    """

    def __init__(
        self, felt: Felt, rows: StructArray, setup: Setup, still: Int64Array, arm_sigma_m: float = 0.0
    ) -> None:
        kind = {each: rows[rows["kind"] == each] for each in Kind}
        place, speed, heading, attitude = (
            kind[each] for each in (Kind.POSITION, Kind.VELOCITY, Kind.HEADING, Kind.ATTITUDE)
        )
        self._frame = Frame(place, int(felt.time_ns[-1]))
        noise = setup.noise
        sensors = np.repeat([noise.gyro_bias, noise.gyro_scale, noise.accel_bias, noise.accel_scale], 3)
        known = np.append(sensors, np.repeat(arm_sigma_m, 3))
        self._prior = np.concatenate([np.repeat(PRIOR, 3), np.maximum(known, 1e-12)])
        pull = self._frame.gravitation(felt)
        speed_ns = np.concatenate([speed["time_ns"], still])
        self._speed = felt.at(speed_ns)
        arms = np.concatenate([setup.lever_arms_b[speed["antenna"]], np.zeros((len(still), 3))])
        self._swing = np.einsum("nij,nj->ni", self._speed.rot, np.cross(self._speed.rate_b, arms))
        self._swing_by_arm = self._speed.rot @ skew(self._speed.rate_b)
        self._swing_by_arm[len(speed) :] = 0.0
        self._speed_seen = self._speeds_seen(speed, still) + pull.velocity(speed_ns)
        self._place = felt.at(place["time_ns"])
        self._arm = np.einsum("nij,nj->ni", self._place.rot, setup.lever_arms_b[place["antenna"]])
        self._place_seen = self._frame.place(place) - pull.place(place["time_ns"])
        self._observed = speed, place, setup
        self._heading = spaced_headings(heading, setup) if setup.baseline_b is not None else heading[:0]
        self._heading_felt = felt.at(self._heading["time_ns"])
        self._baseline_b = np.zeros(3) if setup.baseline_b is None else setup.baseline_b
        self._attitude, self._attitude_felt = attitude, felt.at(attitude["time_ns"])
        self._floor_rad = setup.attitude_floor_rad

    @property
    def has_heading(self) -> bool:
        """Dual-antenna headings are among the observations."""
        return len(self._heading) > 0

    @property
    def has_attitude(self) -> bool:
        """A device's own attitudes are among the observations."""
        return len(self._attitude) > 0

    def first_guess(self) -> FloatArray:
        """Return rot_l_from_b at T from changes of velocity and the forces between them, and from observed headings."""
        if self.has_attitude:
            last = self._attitude[-1]
            there = self._frame.rot_from_l(last["time_ns"][None])[0] @ rot_l_from_b(*last["value"])
            given: FloatArray = there @ self._attitude_felt.rot[-1].T
            return given
        seen, felt = self._changes()
        rot = _turned_onto(seen, felt)
        if self.has_heading:
            ahead = rot @ self._heading_felt.rot[-1] @ self._baseline_b
            rot = rot_z(self._heading["value"][-1, 0] - np.arctan2(ahead[1], ahead[0])) @ rot
        return rot

    def fit(self, rot: FloatArray, course: tuple[float, float] | None = None) -> Fitted:
        """Return the least-squares fit from a first guess of R, without outliers.

        Args:
            rot: (3, 3) first guess.
            course: heading at T and its sigma, rad, from the direction of travel; None: unused.
        """
        gone = np.zeros(len(self._speed_seen) + len(self._place_seen), np.bool_)
        self._weigh(gone)
        best = self._converged(rot, course)
        sigma = np.stack([np.sqrt(np.diag(total)) for total, _ in self._noise], axis=-1)
        for _ in range(MOST_OUTLIERS):
            off = (np.abs(best.left) / sigma).max(axis=1)
            worst = int(np.argmax(off))
            if best.misfit < SOUND or off[worst] < OUTLIER:
                break
            gone[worst] = True
            self._weigh(gone)
            without = self._converged(best.rot_l_from_b, course)
            if without.misfit > HELPED * best.misfit:
                break
            best = without
        return best

    @cached_property
    def _noise(self) -> list[tuple[FloatArray, FloatArray]]:
        return noise_covariances(self._speed, self._place, *self._observed)

    def _converged(self, rot: FloatArray, course: tuple[float, float] | None) -> Fitted:
        """Return the fit after Gauss–Newton steps until convergence."""
        state = np.zeros(UNKNOWNS)
        state[VELOCITY] = self._speed_seen[-1] if len(self._speed_seen) else self._mean_speed()
        for _ in range(ITERATIONS):
            residual, design = self._rows(rot, state, course)
            step = self._covariance(design) @ (design.T @ residual)
            rot = _turn(step[TILT] / max(float(np.linalg.norm(step[TILT])), 1.0)) @ rot
            state += step
            if float(np.linalg.norm(design @ step)) < CONVERGED:
                break
        residual, design = self._rows(rot, state, course)
        return self._fitted(rot, state, residual, design)

    def _weigh(self, gone: BoolArray) -> None:
        """Compute the matrices that whiten residuals, with negligible weight for the rows in ``gone``."""
        self._whiteners, self._shares = [], []
        for total, own in self._noise:
            wide = total + np.diag(np.where(gone, 1e6 * np.diag(total), 0.0))
            white = solve_triangular(np.linalg.cholesky(wide), np.eye(len(wide)), lower=True)
            self._whiteners.append(white)
            self._shares.append(own @ white.T)

    def _fitted(self, rot: FloatArray, state: FloatArray, residual: FloatArray, design: FloatArray) -> Fitted:
        gnss = 3 * (len(self._speed_seen) + len(self._place_seen))
        position_e = self._frame.origin_e + self._frame.rot_e_from_l @ state[PLACE]
        earth_l = self._frame.rot_e_from_l.T @ np.cross(RATE_IE_E, position_e)
        covariance = self._covariance(design)
        cost = float(residual @ residual)
        misfit = float(residual[:gnss] @ residual[:gnss]) / max(gnss - 9, 1)
        # l at the body's own position
        there = rot_e_from_l(*geodetic_from_e(position_e)[:2]).T @ self._frame.rot_e_from_l
        velocity_l = there @ (state[VELOCITY] - earth_l)
        left = np.concatenate(self._left(rot, state))
        scale = state[GYRO][3:]
        return Fitted(there @ rot, position_e, velocity_l, state[ARM], covariance, cost, misfit, left, scale)

    def _covariance(self, design: FloatArray) -> FloatArray:
        """Return (24, 24) of the unknowns, inverted in units of their prior sigmas."""
        scaled = design * self._prior
        return np.asarray(np.linalg.inv(scaled.T @ scaled), dtype=np.float64) * np.outer(self._prior, self._prior)

    def _speeds_seen(self, speed: StructArray, still: Int64Array) -> FloatArray:
        """Return (m, 3) velocities against inertial space; those at rest follow from the position."""
        rest = np.zeros(len(still), speed.dtype)
        rest["time_ns"] = still
        return self._frame.velocity(np.concatenate([speed, rest]))

    def _changes(self) -> tuple[FloatArray, FloatArray]:
        """Return velocity changes without gravitation's share, and the sensors' values for them, in axes of b at T."""
        if len(self._speed_seen) >= len(self._place_seen):
            order = np.argsort(-self._speed.before_s, kind="stable")
            return np.diff(self._speed_seen[order], axis=0), np.diff((self._swing - self._speed.alpha)[order], axis=0)
        step_s = -np.diff(self._place.before_s)[:, None]
        speed = np.diff(self._place_seen, axis=0) / step_s
        felt = np.diff(self._place.alpha_sum + self._arm, axis=0) / step_s
        return np.diff(speed, axis=0), np.diff(felt, axis=0)

    def _mean_speed(self) -> FloatArray:
        step_s = self._place.before_s[0] - self._place.before_s[-1]
        mean: FloatArray = (self._place_seen[-1] - self._place_seen[0]) / max(step_s, 1.0)
        return mean

    def _turned(self, rot: FloatArray, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return changes (m, 3) of velocity and position up to T, by the sensors less their current error estimates."""
        speed, place = self._speed, self._place
        alpha = speed.alpha + speed.alpha_by_gyro @ state[GYRO] + speed.alpha_by_accel @ state[ACCEL] - self._swing
        alpha -= self._swing_by_arm @ state[ARM]
        total = place.alpha_sum + place.sum_by_gyro @ state[GYRO] + place.sum_by_accel @ state[ACCEL] + self._arm
        total += place.rot @ state[ARM]
        return -alpha @ rot.T, total @ rot.T

    def _left(self, rot: FloatArray, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return (m, 3) residuals of velocities and of positions, observed − computed."""
        pushed, moved = self._turned(rot, state)
        flown = state[PLACE] - self._place.before_s[:, None] * state[VELOCITY]
        return self._speed_seen - state[VELOCITY] - pushed, self._place_seen - flown - moved

    def _rows(
        self, rot: FloatArray, state: FloatArray, course: tuple[float, float] | None
    ) -> tuple[FloatArray, FloatArray]:
        """Return whitened residuals (k,) and design (k, 24): GNSS, headings, attitudes, course, prior knowledge."""
        speed_left, place_left = self._left(rot, state)
        speed, place = self._speed, self._place
        by_speed, by_place = np.zeros((len(speed_left), 3, UNKNOWNS)), np.zeros((len(place_left), 3, UNKNOWNS))
        left = np.concatenate([speed_left, place_left])
        # Only the motion turns with the attitude, not the noise in it. Without removing the inertial unit's share of
        # the residuals, noise that turns along with R would pass for information about the attitude.
        own = [
            share @ (white @ left[:, axis])
            for axis, (share, white) in enumerate(zip(self._shares, self._whiteners, strict=True))
        ]
        motion = np.concatenate(self._turned(rot, state)) + np.stack(own, axis=-1)
        by_speed[..., TILT] = -skew(motion[: len(speed_left)])
        by_speed[..., VELOCITY] = np.eye(3)
        by_speed[..., GYRO] = -rot @ speed.alpha_by_gyro
        by_speed[..., ACCEL] = -rot @ speed.alpha_by_accel
        by_speed[..., ARM] = rot @ self._swing_by_arm
        by_place[..., ARM] = rot @ place.rot
        by_place[..., TILT] = -skew(motion[len(speed_left) :])
        by_place[..., VELOCITY] = -place.before_s[:, None, None] * np.eye(3)
        by_place[..., PLACE] = np.eye(3)
        by_place[..., GYRO] = rot @ place.sum_by_gyro
        by_place[..., ACCEL] = rot @ place.sum_by_accel
        design = np.concatenate([by_speed, by_place])
        parts = []
        for axis, whitener in enumerate(self._whiteners):
            white = whitener @ np.column_stack([left[:, axis], design[:, axis]])
            parts.append(white)
        parts += [self._heading_rows(rot, state), self._attitude_rows(rot, state), self._prior_rows(state)]
        if course is not None:
            parts.append(_course_row(rot, *course))
        rows = np.concatenate(parts)
        return rows[:, 0], rows[:, 1:]

    def _heading_rows(self, rot: FloatArray, state: FloatArray) -> FloatArray:
        """Return rows for the baseline's direction, and for its slope where that is observed."""
        rows = []
        if not len(self._heading):
            return NO_ROWS
        back = np.swapaxes(self._frame.rot_from_l(self._heading["time_ns"]), 1, 2)
        for seen, rot_l, turn, tilt in zip(
            self._heading, back, self._heading_felt.rot, self._heading_felt.tilt_by_gyro, strict=True
        ):
            spun = rot @ (tilt @ state[GYRO])
            north, east, down = rot_l @ (_turn(spun) @ rot @ turn @ self._baseline_b)
            flat = np.hypot(north, east)
            by_turn = np.array(
                [[-down * north / flat**2, -down * east / flat**2, 1.0], [-east / flat, north / flat, 0.0]]
            )
            left = seen["value"][:2] - [np.arctan2(east, north), -np.arctan2(down, flat)]
            left[0] = (left[0] + np.pi) % (2.0 * np.pi) - np.pi
            sigma = np.maximum(seen["sigma"][:2], self._floor_rad)
            for number in (0, 1):
                if np.isfinite(left[number]) and np.isfinite(sigma[number]):
                    row = np.zeros(1 + UNKNOWNS)
                    row[0], row[1:4] = left[number], by_turn[number] @ rot_l
                    row[10:16] = by_turn[number] @ rot_l @ rot @ tilt
                    rows.append(row / sigma[number])
        return np.array(rows).reshape(-1, 1 + UNKNOWNS)

    def _attitude_rows(self, rot: FloatArray, state: FloatArray) -> FloatArray:
        """Return rows for a device's own attitudes."""
        felt, seen = self._attitude_felt, self._attitude
        if not len(seen):
            return NO_ROWS
        there = self._frame.rot_from_l(seen["time_ns"]) @ rot_l_from_b(*seen["value"].T)
        design = np.zeros((len(seen), 3, 1 + UNKNOWNS))
        spun = np.einsum("nij,j->ni", rot @ felt.tilt_by_gyro, state[GYRO])
        here = np.stack([_turn(each) for each in spun]) @ rot @ felt.rot
        design[..., 0] = rotation_vector(quaternion_from_rot(there @ np.swapaxes(here, 1, 2)))
        design[..., 1:4] = np.eye(3)
        design[..., 10:16] = rot @ felt.tilt_by_gyro
        tilt = np.maximum(seen["sigma"][:, :2].max(axis=1, initial=0.0), self._floor_rad)
        sigma = np.stack([tilt, tilt, np.maximum(seen["sigma"][:, 2], self._floor_rad)], axis=-1)
        rows: FloatArray = (design / sigma[..., None]).reshape(-1, 1 + UNKNOWNS)
        return rows

    def _prior_rows(self, state: FloatArray) -> FloatArray:
        """Return rows for prior knowledge: sensor errors with their sigmas, other unknowns with very wide ones."""
        left = np.where(np.arange(UNKNOWNS) < 9, 0.0, -state)
        rows: FloatArray = np.column_stack([left, np.eye(UNKNOWNS)]) / self._prior[:, None]
        return rows


def _course_row(rot: FloatArray, course_rad: float, sigma_rad: float) -> FloatArray:
    """Return the row that sets the heading equal to the course within the sigma of crabbing."""
    north, east, down = rot[:, 0]
    row = np.zeros((1, 1 + UNKNOWNS))
    row[0, 0] = (course_rad - np.arctan2(east, north) + np.pi) % (2.0 * np.pi) - np.pi
    row[0, 1:4] = _by_turn(north, east, down)
    return row / sigma_rad


def _by_turn(north: float, east: float, down: float) -> FloatArray:
    """Return the derivatives (3,) of a vector's heading by turns about north, east, down."""
    square = max(north * north + east * east, 1e-12)
    return np.array([-down * north / square, -down * east / square, 1.0])


def _turned_onto(seen: FloatArray, felt: FloatArray) -> FloatArray:
    """Return the rotation (3, 3) from vectors (n, 3) felt to those seen (Wahba 1965, Markley 1988).

    It is that of least squares.
    """
    u, _, vt = np.linalg.svd(seen.T @ felt)
    return np.asarray(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt, dtype=np.float64)


def _turn(vector: FloatArray) -> FloatArray:
    """Return the matrix (3, 3) of a rotation vector (3,) (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    cross = skew(vector)
    turned: FloatArray = (
        np.eye(3) + np.sinc(angle / np.pi) * cross + 0.5 * np.sinc(0.5 * angle / np.pi) ** 2 * cross @ cross
    )
    return turned
