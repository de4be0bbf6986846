"""Check whether inertial samples and GNSS describe one motion of one body, by fits over windows.

The fit of `alignment_fit` assumes nothing about the mounting of the unit: it finds the attitude with which the sensor
integrals agree with GNSS. Where that fails, other orders and signs of the gyroscopes' axes are tried; where it
succeeds, the body's axes are compared with the direction of travel, and the lever arm is fitted as well.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import permutations, product

import numpy as np

from swath.georef.arrays import BoolArray, FloatArray, Int64Array, StructArray
from swath.georef.geodesy.rotations import rot_z
from swath.georef.navigation.alignment.blocks import Blocks, Felt
from swath.georef.navigation.alignment.fit import ARM, GYRO, TILT, Fitted, Problem
from swath.georef.navigation.diagnosis.time import velocities
from swath.georef.navigation.inputs import Inertial, Kind, Setup
from swath.georef.timescales.gps_time import SECOND_NS

WINDOW_NS = 40 * SECOND_NS
MOST_WINDOWS = 6
THINNED_NS = 9 * SECOND_NS // 10
FEWEST = 8  # minimum positions in a window
FITS, FAILS = 20.0, 60.0  # reduced χ² of a fit that is right, and of one that is not
BETTER = 10.0  # times less χ² than with the given axes
ALIKE = 3.0  # times the best's χ²: fits below this cannot be told from the best
SHORTLIST = 4  # pairs that are fitted, of those whose changes of velocity agree best
# of the gyroscopes: the scale's prior sigma when the unit is in doubt, and the greatest error then
FREE_SCALE, MOST_SCALE = 0.5, 0.1
COURSE_MPS = 5.0
ALONG = 0.85  # minimum cosine between the body's axes and the vehicle's, after a turn by right angles
# prior sigma for a free lever arm; the same, times the arm, where only its axes may differ
ARM_SIGMA_M, NEAR_ARM = 5.0, 1.5
G_MPS2 = 9.80665
NO_INDEX = np.zeros(0, np.int64)
SCALE = slice(GYRO.start + 3, GYRO.stop)


@dataclass(frozen=True, eq=False)
class Window:
    """A stretch of data with motion.

    Attributes:
        inertial: samples.
        felt: integrals back to its end.
        rows: observations in it, thinned, by time.
        fitted: by positions and velocities alone.
    """

    inertial: Inertial
    felt: Felt
    rows: StructArray
    fitted: Fitted


@dataclass(frozen=True, eq=False)
class Mounting:
    """The change of the sensors' axes and units with which gyroscopes, accelerometers and GNSS describe one motion.

    Attributes:
        gyro, accel: (3, 3) signed permutations, good = matrix · given. Without the direction of travel they are known
            up to a common turn.
        unit: factor on the gyroscopes' signals.
        gain: ratio of the misfit before to that after the change.
        left: misfit after the change.
        rivals: other pairs of gyro and accel that fit as well; may be empty.
    """

    gyro: FloatArray
    accel: FloatArray
    unit: float
    gain: float
    left: float
    rivals: tuple[tuple[FloatArray, FloatArray], ...] = ()

    @property
    def is_as_it_is(self) -> bool:
        """True if the sensors agree as given, so that any misfit has another cause."""
        return self.unit == 1.0 and np.array_equal(self.gyro, np.eye(3)) and np.array_equal(self.accel, np.eye(3))


def windows(inertial: Inertial, observations: StructArray, setup: Setup) -> list[Window]:
    """Return the stretches with the most motion, by time; fewer if data are few."""
    rows = _used(observations, len(setup.lever_arms_b))
    place = rows[rows["kind"] == Kind.POSITION]
    begins_ns = np.arange(max(_first(inertial.time_ns), _first(place["time_ns"])), _last(inertial.time_ns), WINDOW_NS)
    scores = [_eventfulness(inertial, rows, int(begin)) for begin in begins_ns]
    chosen = sorted(np.argsort(np.array(scores), kind="stable")[::-1][:MOST_WINDOWS].tolist())
    found = []
    for number in chosen:
        window = _window(inertial, rows, setup, int(begins_ns[number])) if scores[number] > 0.0 else None
        if window is not None:
            found.append(window)
    return found


def median_misfit(chosen: list[Window]) -> float:
    """Return the median reduced χ² of the windows; 0 without any."""
    return float(np.median([window.fitted.misfit for window in chosen])) if chosen else 0.0


def mounting_of(chosen: list[Window], setup: Setup) -> Mounting | None:
    """Find the order, signs or unit of the sensors' axes with which gyroscopes and accelerometers agree.

    Each triad allows 48 signed permutations; a turn of both together makes no difference here, so that 96 pairs remain:
    48 of the gyroscopes, with the accelerometers as given or all negated. A wrong unit is tried only if no pair fits,
    and reported only if the gyroscopes' scale, estimated with it, is 1 within its uncertainty.

    Returns:
        None if everything fits as given, or if no permutation fits.
    """
    if median_misfit(chosen) < FITS:
        return None
    worst = sorted(chosen, key=lambda window: window.fitted.misfit)[::-1][:2]
    pairs = [(gyro, sign * np.eye(3)) for sign in (1.0, -1.0) for gyro in _signed_permutations()]
    before = np.inf
    for unit in (1.0, np.pi / 180.0, 180.0 / np.pi):
        unlike = sum(_unlikeness(window, _taken(window, unit)) for window in worst)
        best = np.argsort(np.ravel(unlike), kind="stable")[:SHORTLIST].tolist()
        likely = [pairs[number] for number in dict.fromkeys([0, *best])]  # the first is the given one
        asked = setup if unit == 1.0 else replace(setup, noise=replace(setup.noise, gyro_scale=FREE_SCALE))
        fitted = [(pair, *_fits(worst, unit, pair, asked)) for pair in likely]
        if unit == 1.0:
            if fitted[0][1] < FITS:
                return Mounting(pairs[0][0], pairs[0][1], 1.0, 1.0, fitted[0][1])
            before = fitted[0][1]
        fitted.sort(key=lambda each: each[1])
        pair, left, scale_is_one = fitted[0]
        if left < FITS and before > BETTER * left and (unit == 1.0 or scale_is_one):
            rivals = tuple(other for other, its, _ in fitted[1:] if its < ALIKE * max(left, 1.0))
            return Mounting(pair[0], pair[1], unit, before / max(left, 1e-9), left, rivals)
        before = min(before, left)  # a unit has to explain more than any order of the axes
    return None


def _fits(worst: list[Window], unit: float, pair: tuple[FloatArray, FloatArray], setup: Setup) -> tuple[float, bool]:
    """Return a pair's larger misfit in windows, and whether the gyroscopes' scale is 1 there."""
    left, is_one = 0.0, False
    for window in worst:
        fitted = _fit(_taken(window, unit * pair[0], pair[1]), window.rows, setup, free_arm=True)
        left = max(left, fitted.misfit)
        sigma = fitted.sigma(SCALE)
        best = int(np.argmin(sigma))  # the axis that turned most
        known = float(sigma[best]) < MOST_SCALE
        is_one |= known and abs(float(fitted.gyro_scale[best])) < max(3.0 * float(sigma[best]), MOST_SCALE)
    return left, is_one


def body_axes(chosen: list[Window], setup: Setup, mounting: Mounting | None = None) -> FloatArray | None:
    """Return the turn by right angles (of 24) that takes the body's axes to the vehicle's; the identity if they agree.

    Args:
        chosen: windows.
        setup: lever arms and noise.
        mounting: change of the sensors' axes; None: as given.

    Returns:
        None if the vehicle was too slow, or if its axes lie between right angles.
    """
    total, count = np.zeros((3, 3)), 0
    for window in chosen:
        felt, fitted = window.felt, window.fitted
        if mounting is not None:
            felt = _taken(window, mounting.unit * mounting.gyro, mounting.accel)
            fitted = _fit(felt, window.rows, setup, free_arm=True)
        time_ns, velocity_l = velocities(window.rows)
        fast = np.hypot(velocity_l[:, 0], velocity_l[:, 1]) > COURSE_MPS
        if fitted.misfit > FAILS or not fast.any():
            continue
        turn = felt.at(time_ns[fast]).rot
        track = rot_z(np.arctan2(velocity_l[fast, 1], velocity_l[fast, 0]))
        total += (np.swapaxes(track, 1, 2) @ (fitted.rot_l_from_b @ turn)).sum(axis=0)
        count += int(fast.sum())
    if count < FEWEST:
        return None
    scores = [(float(np.trace(matrix.T @ total)) / (3 * count), matrix) for matrix in _signed_permutations(proper=True)]
    score, matrix = max(scores, key=lambda each: each[0])
    return matrix if score > ALONG else None


def heading_offset(chosen: list[Window], setup: Setup) -> tuple[float, float] | None:
    """Return dual-antenna heading minus the baseline's heading by motion, and its sigma, rad; None if either lacks."""
    if setup.baseline_b is None:
        return None
    offsets, sigmas = [], []
    for window in chosen:
        rows = window.rows[window.rows["kind"] == Kind.HEADING]
        sigma = float(window.fitted.sigma(TILT)[2])
        if len(rows) < FEWEST or sigma > 0.2 or window.fitted.misfit > FAILS:
            continue
        turn = window.felt.at(rows["time_ns"]).rot
        ahead = np.einsum("nij,j->ni", window.fitted.rot_l_from_b @ turn, setup.baseline_b)
        off = rows["value"][:, 0] - np.arctan2(ahead[:, 1], ahead[:, 0])
        offsets.append(np.exp(1j * off).mean())
        sigmas.append(sigma)
    if not offsets:
        return None
    mean = complex(np.mean(offsets))
    return float(np.angle(mean)), max(float(np.median(sigmas)), float(np.std(np.angle(np.array(offsets) / mean))))


def other_signs(arm_b: FloatArray, fitted_b: FloatArray, sigma_m: FloatArray) -> FloatArray | None:
    """Return signs (3,) with which a lever arm fits clearly better; None if it fits as given, or with no signs."""
    off = np.linalg.norm(fitted_b - arm_b)
    if off < max(0.3, 8.0 * float(sigma_m.max())):
        return None
    patterns = [np.array(signs) for signs in product((1.0, -1.0), repeat=3)]
    best = min(patterns, key=lambda signs: float(np.linalg.norm(fitted_b - signs * arm_b)))
    best = np.where(np.abs(arm_b) > 0.1, best, 1.0)
    better = np.linalg.norm(fitted_b - best * arm_b) < 0.35 * off
    return best if better and (best < 0.0).any() else None


def lever_arm(chosen: list[Window], setup: Setup) -> tuple[FloatArray, FloatArray] | None:
    """Return the lever arm (3,) of antenna 0 that positions and velocities fit best, m in b, and its sigma (3,)."""
    information, weighted = np.zeros((3, 3)), np.zeros(3)
    for window in chosen:
        rows = window.rows[(window.rows["antenna"] == 0) & _is_motion(window.rows)]
        if (rows["kind"] == Kind.POSITION).sum() < FEWEST:
            continue
        free = Problem(window.felt, rows, setup, NO_INDEX, ARM_SIGMA_M).fit(window.fitted.rot_l_from_b)
        if free.misfit > FAILS:
            continue
        weight = np.linalg.inv(free.covariance[ARM, ARM] * max(free.misfit, 1.0))
        information += weight
        weighted += weight @ (setup.lever_arms_b[0] + free.arm_b)
    if not information.any():
        return None
    covariance = np.linalg.inv(information)
    return np.asarray(covariance @ weighted, dtype=np.float64), np.sqrt(np.diag(covariance))


def _taken(window: Window, gyro: FloatArray | float, accel: FloatArray | float = 1.0) -> Felt:
    """Return the integrals with other sensor axes, summed anew because axes matter within blocks too."""
    own = window.inertial
    blocks = Blocks()
    angle_b = own.angle_b @ (gyro * np.eye(3) if isinstance(gyro, float) else gyro).T
    velocity_b = own.velocity_b @ (accel * np.eye(3) if isinstance(accel, float) else accel).T
    blocks.feed(replace(own, angle_b=angle_b, velocity_b=velocity_b))
    other = blocks.felt(int(window.felt.time_ns[0]), int(window.felt.time_ns[-1]))
    return window.felt if other is None else other


def _unlikeness(window: Window, felt: Felt) -> FloatArray:
    """Return (2, 48) the disagreement of velocity changes seen and felt, with accelerometers as given and negated.

    The best turn of one onto the other is taken out (Kabsch 1976), gravity is that of a flat earth, and the lever arm
    is ignored: good enough to choose candidates for fits.
    """
    time_ns, velocity_l = velocities(window.rows)
    inside = (time_ns >= felt.time_ns[0]) & (time_ns <= felt.time_ns[-1])
    time_ns, velocity_l = time_ns[inside], velocity_l[inside]
    step_s = np.diff(time_ns)[:, None] / SECOND_NS
    seen = np.diff(velocity_l, axis=0) - step_s * [0.0, 0.0, G_MPS2]
    since, edges = (time_ns - felt.time_ns[0]).astype(np.float64), (felt.time_ns - felt.time_ns[0]).astype(np.float64)
    alpha = np.stack([felt.pushed(gyro) for gyro in _signed_permutations()])
    there = np.stack([[np.interp(since, edges, column) for column in one.T] for one in alpha])  # (48, 3, m)
    pushed = -np.diff(there, axis=2)
    both = np.einsum("nk,gjn->gkj", seen, pushed)
    size = (seen**2).sum() + (pushed**2).sum(axis=(1, 2))
    singular = np.linalg.svd(both, compute_uv=False)
    mirrored = np.sign(np.linalg.det(both))
    agree = np.stack([singular[:, :2].sum(axis=1) + sign * mirrored * singular[:, 2] for sign in (1.0, -1.0)])
    left: FloatArray = (size - 2.0 * agree) / max(len(seen), 1)
    return left


def _fit(felt: Felt, rows: StructArray, setup: Setup, *, free_arm: bool = False) -> Fitted:
    """Return the fit, with a free lever arm if the axes are in question, since other axes change it."""
    arm_m = NEAR_ARM * float(np.linalg.norm(setup.lever_arms_b[0])) + MOST_SCALE if free_arm else 0.0
    problem = Problem(felt, rows[_is_motion(rows)], setup, NO_INDEX, arm_m)
    return problem.fit(problem.first_guess())


def _window(inertial: Inertial, rows: StructArray, setup: Setup, begin_ns: int) -> Window | None:
    span = np.array([begin_ns - SECOND_NS, begin_ns + WINDOW_NS + SECOND_NS])
    part = inertial.between(*np.searchsorted(inertial.time_ns, span).tolist())
    inside = rows[(rows["time_ns"] >= begin_ns) & (rows["time_ns"] <= begin_ns + WINDOW_NS)]
    place = inside[inside["kind"] == Kind.POSITION]
    if len(place) < FEWEST or len(part) < FEWEST:
        return None
    blocks = Blocks()
    blocks.feed(part)
    felt = blocks.felt(begin_ns, int(place["time_ns"][-1]))
    if felt is None:
        return None
    inside = inside[(inside["time_ns"] >= felt.time_ns[0]) & (inside["time_ns"] <= felt.time_ns[-1])]
    if (inside["kind"] == Kind.POSITION).sum() < FEWEST:
        return None
    return Window(part, felt, inside, _fit(felt, inside, setup))


def _used(observations: StructArray, antennas: int) -> StructArray:
    """Return usable rows, thinned to about one a second of each kind."""
    rows = observations[np.isin(observations["kind"], (Kind.POSITION, Kind.VELOCITY, Kind.HEADING))]
    needed = np.where(rows["kind"] == Kind.HEADING, 1, 3)
    sound = np.isfinite(rows["value"]) & np.isfinite(rows["sigma"]) & (rows["sigma"] > 0.0)
    sound |= np.arange(3) >= needed[:, None]
    rows = rows[sound.all(axis=1) & (rows["antenna"] < antennas)]
    keep = np.zeros(len(rows), np.bool_)
    latest: dict[tuple[int, int], int] = {}
    for number, (time, kind, antenna) in enumerate(
        zip(rows["time_ns"].tolist(), rows["kind"].tolist(), rows["antenna"].tolist(), strict=True)
    ):
        if time - latest.get((kind, antenna), time - THINNED_NS) >= THINNED_NS:
            latest[kind, antenna] = time
            keep[number] = True
    used: StructArray = rows[keep]
    return used


def _eventfulness(inertial: Inertial, rows: StructArray, begin_ns: int) -> float:
    """Return how much GNSS's velocity or the sensed turn rate changes in a window; 0 if either has a gap."""
    end_ns = begin_ns + WINDOW_NS
    first, last = np.searchsorted(inertial.time_ns, [begin_ns, end_ns])
    speed = rows[(rows["kind"] == Kind.VELOCITY) & (rows["time_ns"] >= begin_ns) & (rows["time_ns"] < end_ns)]
    place = rows[(rows["kind"] == Kind.POSITION) & (rows["time_ns"] >= begin_ns) & (rows["time_ns"] < end_ns)]
    if last - first < FEWEST or len(place) < FEWEST:
        return 0.0
    changed = float(np.std(speed["value"][:, :2], axis=0).max()) if len(speed) else 0.0
    turned = float(np.linalg.norm(inertial.angle_b[first:last].sum(axis=0)))
    return 1e-6 + changed + 5.0 * turned


def _is_motion(rows: StructArray) -> BoolArray:
    return np.asarray(np.isin(rows["kind"], (Kind.POSITION, Kind.VELOCITY)))


def _signed_permutations(*, proper: bool = False) -> Iterator[FloatArray]:
    """Yield the 48 matrices that swap and mirror axes; 24 of them are rotations."""
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[np.arange(3), order] = signs
            if not proper or np.linalg.det(matrix) > 0.0:
                yield matrix


def _first(time_ns: Int64Array) -> int:
    return int(time_ns[0]) if len(time_ns) else 0


def _last(time_ns: Int64Array) -> int:
    return int(time_ns[-1]) if len(time_ns) else 0
