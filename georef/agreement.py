"""Check whether a trajectory belongs to a log: its position against GNSS fixes, its rotation against the IMU.

Positions are compared as medians over blocks of time. The sigma of a median includes the error that a kind of fix keeps
for a whole flight; a receiver's own sigma describes only its noise from epoch to epoch. Turn rates are also compared
with those that the attitude would give if its angles had other signs, so that a message can name a wrong convention.

Gusts are turn rates above 0.5 Hz; they differ between two flights over the same lines. Slower rates come from the lines
flown and the turns between them, and another flight of the same plan has them too.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product as combinations

import numpy as np

from swath.georef.arrays import BoolArray, FloatArray, Int64Array, StructArray
from swath.georef.geodesy.earth import geodetic_from_e
from swath.georef.geodesy.gravity import gravity_e
from swath.georef.geodesy.quaternions import about, conjugate, product, rotated
from swath.georef.records import FixType
from swath.georef.timescales.gps_time import SECOND_NS
from swath.georef.trajectory.trajectory import EARTH_RATE_RADPS, Trajectory
from swath.georef.trajectory.turn_rates import REACH_STEPS, STEP_NS, Turning, turning

GUSTS_HZ = (0.5, 2.5)  # above the frequencies that autopilots and pilots steer, below those of engine vibration

ABOVE_HZ = (5.0, 9.5)  # the band of noise and vibration alone

# minimum rms of the gust band over that of the noise band; noise alone has 0.7, so a ninth of the power is noise
ABOVE_NOISE = 2.0


def gusts(told: FloatArray, felt: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """Return turn rates (k, 3) of a trajectory and an IMU in the band of gusts, at the lag with the best correlation.

    Other functions judge and report time offsets.

    Args:
        told, felt: (m, 3) rad/s over the same steps, of the trajectory and of the IMU.

    Returns:
        None where one of them holds little but noise in this band, or lacks these frequencies: a smoothed or coarse
        trajectory, calm air, a rotor.
    """
    pair = []
    for rates in (told, felt):
        band, noise = _within(rates, GUSTS_HZ), _within(rates, ABOVE_HZ)
        if not (band**2).sum() > ABOVE_NOISE**2 * (noise**2).sum():
            return None
        pair.append(band)
    one, other = pair
    return _lagged(one, other, _best_lag(one, other))


def _best_lag(one: FloatArray, other: FloatArray) -> int:
    """Return the number of steps, at most `REACH_STEPS` and half the length, by which the first lags the second."""
    spectra = (np.fft.rfft(rates, 2 * len(one), axis=0) for rates in (one, other))
    sums = np.fft.irfft(next(spectra) * np.conj(next(spectra)), 2 * len(one), axis=0).sum(axis=1)
    reach = min(REACH_STEPS, len(one) // 2)
    lags = np.arange(-reach, reach + 1)
    return int(lags[np.argmax(sums[lags])])


def _lagged(one: FloatArray, other: FloatArray, lag: int) -> tuple[FloatArray, FloatArray]:
    count = len(one) - abs(lag)
    return one[max(lag, 0) :][:count], other[max(-lag, 0) :][:count]


def _within(rates: FloatArray, band_hz: tuple[float, float]) -> FloatArray:
    """Return rates (m, 3) reduced to the frequencies of one band."""
    spectrum = np.fft.rfft(rates, axis=0)
    hz = np.fft.rfftfreq(len(rates), STEP_NS / SECOND_NS)
    spectrum[(hz < band_hz[0]) | (hz > band_hz[1])] = 0.0
    kept: FloatArray = np.fft.irfft(spectrum, len(rates), axis=0)
    return kept


# One sigma, horizontal and vertical, m, of errors that stay the same for a whole flight: the base's position and the
# troposphere over a baseline; ionosphere, orbits and multipath without a base. Usual figures for receivers in flight.
LASTING_M: dict[FixType, tuple[float, float]] = {
    FixType.RTK_FIXED: (0.02, 0.03),
    FixType.PPP: (0.1, 0.2),
    FixType.RTK_FLOAT: (0.3, 0.5),
    FixType.DIFFERENTIAL: (0.6, 1.2),
    FixType.SINGLE: (1.5, 3.0),
}
UNSAID_M = 0.05  # one sigma assumed for a trajectory that gives none
FEWEST_FIXES = 10
BLOCK_NS = 10 * SECOND_NS  # errors of fixes farther apart than this are taken as independent
FEWEST_BLOCKS = 5  # minimum number of blocks for measuring their scatter
LONGEST_S, TRIED_S = 40.0, 0.25  # more than all leap seconds; a step over which the path is nearly straight
MOST_FITTED = 1000
NOISIEST = 3.0  # limit of the scatter of fixes over their lasting error
MAD = 1.4826  # sigma of a normal distribution over its median absolute deviation
MEDIAN = 1.2533  # sigma of a median over that of a mean
SHORTEST_STEPS = round(8 * SECOND_NS / STEP_NS)
SECOND_STEPS = SECOND_NS // STEP_NS
SLOW_STEPS = 20  # one second, which averages out attitude noise and vibration
# greatest ratio of the difference after a change of convention, time or datum to the difference before it
MUCH_BETTER = 0.5
SURE = 4.0  # sigmas
LIKE = 0.7  # share of common motion below which, SURE sigmas included, two records are of different motions
FEWEST_TURNS = 10.0  # minimum seconds with horizontal acceleration for a heading
ACCELERATES = 0.5  # m/s²


@dataclass(frozen=True, eq=False)
class Compared:
    """Fixes of one kind beside the trajectory, epoch by epoch.

    Attributes:
        fix_type: the kind of these fixes.
        time_ns: (n,) GPS time.
        fix_e: (n, 3) the antenna's position by the receiver, m.
        apart_e: (n, 3) the antenna's position by the trajectory minus fix_e, m.
        q_e_from_b, velocity_e: (n, 4), (n, 3) of the trajectory.
        arm_b: (3,) the antenna's lever arm, m.
        sigma_l: (3,) median of the fixes' own sigmas, north, east, down, m.
        own_sigma_l: (3,) median of the trajectory's sigmas, m.
    """

    fix_type: FixType
    time_ns: Int64Array
    fix_e: FloatArray
    apart_e: FloatArray
    q_e_from_b: FloatArray
    velocity_e: FloatArray
    arm_b: FloatArray
    sigma_l: FloatArray
    own_sigma_l: FloatArray

    def in_l(self, vectors_e: FloatArray) -> FloatArray:
        """Return vectors (n, 3) along north, east and up."""
        turned = rotated(conjugate(_q_e_from_l(self.fix_e)), vectors_e)
        upward: FloatArray = turned * np.array([1.0, 1.0, -1.0])
        return upward

    @property
    def apart_b(self) -> FloatArray:
        """The difference (n, 3) along the body's axes, m."""
        return rotated(conjugate(self.q_e_from_b), self.apart_e)

    def blocks(self, values: FloatArray) -> FloatArray:
        """Return the medians (k, 3) of values (n, 3) over each block of time that holds any."""
        number = (self.time_ns - self.time_ns[0]) // BLOCK_NS
        return np.array([np.median(values[number == one], axis=0) for one in np.unique(number)])


@dataclass(frozen=True, slots=True, eq=False)
class Apart:
    """The distance between a trajectory and fixes.

    Attributes:
        median_l: (3,) north, east, up, m.
        scatter_l: (3,) robust sigma of single differences, m.
        size_l: (3,) absolute median, or the median of the absolute block medians where that is larger, as differences
            may change sign.
        fix_sigma_l: (3,) one sigma of the median due to the fixes alone, lasting errors included, m.
        sigma_l: (3,) the same with the trajectory's own sigma, m.
        of: the compared fixes.
    """

    median_l: FloatArray
    scatter_l: FloatArray
    size_l: FloatArray
    fix_sigma_l: FloatArray
    sigma_l: FloatArray
    of: Compared

    @property
    def sigmas(self) -> float:
        """The size in units of sigma_l, along the worst axis."""
        return float(np.max(self.size_l / self.sigma_l))

    @property
    def fix_sigmas(self) -> float:
        """The size in units of fix_sigma_l, along the worst axis."""
        return float(np.max(self.size_l / self.fix_sigma_l))

    @property
    def metres(self) -> float:
        """The size along the axis where it is largest, m."""
        return float(np.max(self.size_l))


def apart_from_fixes(trajectory: Trajectory, positions: StructArray, arms_b: FloatArray) -> Apart | None:
    """Compare a trajectory plus lever arm with a receiver's fixes of the most informative kind.

    Args:
        trajectory: of the body's origin, with attitude.
        positions: OBSERVATION_DTYPE, positions only, in the trajectory's datum.
        arms_b: (k, 3) lever arms of the receiver's antennas, m.

    Returns:
        None where fewer than ten fixes of a kind lie within the trajectory.
    """
    within = trajectory.fates(positions["time_ns"]) == 0 if len(positions) else np.zeros(0, bool)
    rows = positions[within]
    found = []
    for fix_type in LASTING_M:
        for antenna in range(len(arms_b)):
            own = rows[(rows["fix_type"] == int(fix_type)) & (rows["antenna"] == antenna)]
            if len(own) >= FEWEST_FIXES:
                found.append(_apart(_compared(trajectory, own, fix_type, arms_b[antenna])))
    return min(found, key=lambda one: float(np.max(one.fix_sigma_l)), default=None)


def _compared(trajectory: Trajectory, rows: StructArray, fix_type: FixType, arm_b: FloatArray) -> Compared:
    poses = trajectory.poses(rows["time_ns"])
    antenna_e = poses.position_e + rotated(poses.q_e_from_b, np.broadcast_to(arm_b, (len(rows), 3)))
    known = np.isfinite(poses.position_sigma_l)
    own = np.median(np.where(known, poses.position_sigma_l, UNSAID_M), axis=0)
    return Compared(
        fix_type,
        np.asarray(rows["time_ns"], np.int64),
        np.asarray(rows["value"], np.float64),
        antenna_e - rows["value"],
        poses.q_e_from_b,
        poses.velocity_e,
        arm_b,
        np.median(rows["sigma"], axis=0),
        own,
    )


def _apart(of: Compared) -> Apart:
    apart_l = of.in_l(of.apart_e)
    blocks = of.blocks(apart_l)
    median = np.median(apart_l, axis=0)
    scatter = MAD * np.median(np.abs(apart_l - median), axis=0)
    usual = MAD * np.median(np.abs(blocks - np.median(blocks, axis=0)), axis=0)
    noise = usual if len(blocks) >= FEWEST_BLOCKS else scatter
    horizontal, vertical = LASTING_M[of.fix_type]
    lasting = np.maximum(of.sigma_l, (horizontal, horizontal, vertical))
    # the trajectory causes a larger scatter, which must not excuse its error
    noise = np.minimum(noise, NOISIEST * lasting)
    fix_sigma = np.hypot(lasting, MEDIAN * noise / np.sqrt(len(blocks)))
    size = np.maximum(np.abs(median), np.median(np.abs(blocks), axis=0))
    return Apart(median, scatter, size, fix_sigma, np.hypot(fix_sigma, of.own_sigma_l), of)


def time_that_explains(apart: Apart) -> float | None:
    """Return the seconds by which the trajectory is late if a time offset explains its distance; None if it does not.

    The antenna's path by the trajectory is moved in time, by whole steps and then along its velocity, until it fits. An
    error that no time offset reduces much, such as a height, is not attributed to time, however poor the fixes are.
    """
    of = apart.of
    step = max(1, len(of.time_ns) // MOST_FITTED)
    time_s = (of.time_ns[::step] - of.time_ns[0]) / SECOND_NS
    fix_l, way_l = of.in_l(of.fix_e - of.fix_e[0])[::step], of.in_l(of.fix_e + of.apart_e - of.fix_e[0])[::step]
    speed = np.median(np.linalg.norm(np.diff(way_l, axis=0), axis=1) / np.diff(time_s)) if len(time_s) > 1 else 0.0
    best, late_s, left = np.inf, 0.0, np.inf
    for tried_s in np.arange(-LONGEST_S, LONGEST_S + 0.5 * TRIED_S, TRIED_S):
        there = (time_s + tried_s >= 0.0) & (time_s + tried_s <= time_s[-1])
        if there.sum() < FEWEST_FIXES or not speed > 1.0:
            continue
        rest = _way_at(way_l, time_s, time_s[there] + tried_s) - fix_l[there]
        usual = float(np.median(np.linalg.norm(rest, axis=1)))
        if usual < best:
            moved = _way_at(way_l, time_s, time_s[there] + tried_s + TRIED_S) - fix_l[there] - rest
            share = float((rest * moved).sum() / max((moved**2).sum(), 1e-9))
            best, late_s = usual, float(tried_s) - share * TRIED_S
            # beyond the next step a straight extrapolation would be a guess: it could reach any place ahead
            within = abs(share) <= 1.0
            left = float(np.median(np.linalg.norm(rest - share * moved, axis=1))) if within else np.inf
    most = max(3.0 * float(apart.fix_sigma_l.max()), 0.05 * apart.metres)
    as_it_is = float(np.median(np.linalg.norm(way_l - fix_l, axis=1)))
    return late_s if left < min(most, MUCH_BETTER * as_it_is) else None


def _way_at(way_l: FloatArray, time_s: FloatArray, at_s: FloatArray) -> FloatArray:
    return np.stack([np.interp(at_s, time_s, column) for column in way_l.T], axis=1)


def _q_e_from_l(position_e: FloatArray) -> FloatArray:
    lat, lon, _ = geodetic_from_e(position_e)
    return product(about(2, lon), about(1, -lat - np.pi / 2))


# ---------------------------------------------------------------------- turn rates


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """A trajectory's turn rates compared with those that an IMU measured at the same times.

    Attributes:
        correlation: over three axes, −1 … 1.
        by_axis: (3,) forward, right, down; nan where nothing turns.
        convention: words for the attitude convention whose turn rates fit; empty if the given one does.
        converted: the correlation under that convention.
        is_other: the two surely record different motions.
        gusts: correlation above 0.5 Hz; nan where one of the two has little power there.
        gusts_are_others: the gusts surely record different motions, such as two flights over the same lines.
    """

    correlation: float
    by_axis: FloatArray
    convention: str
    converted: float
    is_other: bool
    gusts: float
    gusts_are_others: bool


def compare_motion(trajectory: Trajectory, imu_time_ns: Int64Array, imu_rate_b: FloatArray) -> Motion | None:
    """Compare turn rates axis by axis, and with the attitude read in other conventions.

    Args:
        trajectory: with attitude.
        imu_time_ns: (m,) GPS time of inertial samples, rising.
        imu_rate_b: (m, 3) their angular rates in b, rad/s.

    Returns:
        None where the two have less than eight seconds in common.
    """
    pair = _turned(trajectory, imu_time_ns, imu_rate_b)
    if pair is None:
        return None
    turned, felt, ends = pair
    as_it_is = _power(felt - turned)
    best, words, rates = as_it_is.sum(), "", turned
    for name, other in _conventions(turned, ends):
        power = _power(felt - other)
        if power.sum() < best and _is_better(as_it_is, power):
            best, words, rates = power.sum(), name, other
    correlation = _correlation(turned, felt)
    other_motion = not words and all(_is_other(_coarser(turned, n), _coarser(felt, n)) for n in (1, SLOW_STEPS))
    by_axis = np.array([_correlation(turned[:, [k]], felt[:, [k]]) for k in range(3)])
    shaken = gusts(turned, felt)
    by_gusts = float("nan") if shaken is None else _correlation(*shaken)
    other_gusts = shaken is not None and not words and _is_other(*shaken)
    return Motion(correlation, by_axis, words, _correlation(rates, felt), other_motion, by_gusts, other_gusts)


def _turned(
    trajectory: Trajectory, imu_time_ns: Int64Array, imu_rate_b: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Return trajectory's and IMU's turn rates (m, 3) over steps that both know, and angles (m, 2, 3) at their ends."""
    if len(trajectory) < 2 or len(imu_time_ns) < 2:
        return None
    first = max(-(-int(imu_time_ns[0]) // STEP_NS), -(-trajectory.span[0] // STEP_NS))
    last = min(int(imu_time_ns[-1]) // STEP_NS, trajectory.span[1] // STEP_NS)
    if last - first < SHORTEST_STEPS:
        return None
    gap_ns = 2 * int(np.median(np.diff(imu_time_ns))) + STEP_NS
    felt = turning(imu_time_ns, imu_rate_b[1:], gap_ns, (first, last))
    told = turning(trajectory.time_ns, trajectory.turn_rates_b("l"), trajectory.max_gap_ns, (first, last))
    known = _known(told) & _known(felt)
    if known.sum() < SHORTEST_STEPS:
        return None
    since_s = (trajectory.time_ns - first * STEP_NS) / SECOND_NS
    at_s = np.arange(last - first + 1) * (STEP_NS / SECOND_NS)
    angles = np.stack([np.interp(at_s, since_s, np.unwrap(angle)) for angle in trajectory.attitude()], axis=1)
    ends = np.stack([angles[:-1], angles[1:]], axis=1)[known]
    return _centred(told.rate_b[known]), _centred(felt.rate_b[known]), ends


def _known(turned: Turning) -> BoolArray:
    return turned.known > 0.0


def _centred(rates: FloatArray) -> FloatArray:
    centred: FloatArray = rates - rates.mean(axis=0)
    return centred


def _conventions(told: FloatArray, ends: FloatArray) -> Iterator[tuple[str, FloatArray]]:
    """Yield a description of each other reading of the attitude, and the turn rates (m, 3) that it implies."""
    names = ("roll", "pitch", "heading")
    for swapped in (False, True):
        for signs in combinations((1.0, -1.0), repeat=3):
            if not swapped and signs == (1.0, 1.0, 1.0):
                continue
            angles = ends[:, :, [1, 0, 2]] if swapped else ends
            negated = [name for name, sign in zip(names, signs, strict=True) if sign < 0.0]
            parts = ["roll and pitch are swapped"] if swapped else []
            if negated:
                parts.append(f"{' and '.join(negated)} {'has' if len(negated) == 1 else 'have'} the opposite sign")
            extra = " (axes forward, left, up against east, north, up)" if negated == ["pitch", "heading"] else ""
            yield " and ".join(parts) + extra, _centred(_rates_of(angles * np.array(signs)))
    for quarter, words in ((1, "right"), (2, "back"), (3, "left")):
        cos, sin = np.round(np.cos(quarter * np.pi / 2)), np.round(np.sin(quarter * np.pi / 2))
        turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        yield f"its x axis points {words}", told @ turn.T


def _rates_of(ends: FloatArray) -> FloatArray:
    """Return turn rates in b (m, 3) from roll, pitch and heading (m, 2, 3) at the ends of steps (FORMULAS 1.4)."""
    middle = ends.mean(axis=1)
    roll_rate, pitch_rate, heading_rate = ((ends[:, 1] - ends[:, 0]) / (STEP_NS / SECOND_NS)).T
    sin_roll, cos_roll = np.sin(middle[:, 0]), np.cos(middle[:, 0])
    sin_pitch, cos_pitch = np.sin(middle[:, 1]), np.cos(middle[:, 1])
    rates: FloatArray = np.stack(
        [
            roll_rate - heading_rate * sin_pitch,
            pitch_rate * cos_roll + heading_rate * sin_roll * cos_pitch,
            heading_rate * cos_roll * cos_pitch - pitch_rate * sin_roll,
        ],
        axis=1,
    )
    return rates


def _power(residual: FloatArray) -> FloatArray:
    """Return the sum of squares of (m, 3) values in each second."""
    squares = (residual**2).sum(axis=1)
    whole = len(squares) // SECOND_STEPS * SECOND_STEPS
    sums: FloatArray = squares[:whole].reshape(-1, SECOND_STEPS).sum(axis=1)
    return sums


def _is_better(before: FloatArray, after: FloatArray) -> bool:
    """Return whether residual powers by second (k,) fall much, and in more seconds than chance explains."""
    gain = before - after
    sigma = np.std(gain, ddof=1) * np.sqrt(len(gain))
    return bool(after.sum() < MUCH_BETTER * before.sum() and gain.sum() > SURE * sigma)


def _correlation(one: FloatArray, other: FloatArray) -> float:
    scale = float(np.sqrt((one**2).sum() * (other**2).sum()))
    return float((one * other).sum() / scale) if scale > 0.0 else float("nan")


def _coarser(rates: FloatArray, steps: int) -> FloatArray:
    whole = len(rates) // steps * steps
    means: FloatArray = rates[:whole].reshape(-1, steps, 3).mean(axis=1)
    return means


def _is_other(told: FloatArray, felt: FloatArray) -> bool:
    """Return whether neither motion contains the other, judged by the share of each that the other holds.

    Noise in one of them alone leaves the share of the other at 1. Sigmas come from leaving out parts of the time
    (jackknife).
    """
    for one, other in ((told, felt), (felt, told)):
        product_of, square = (one * other).sum(axis=1), (one**2).sum(axis=1)
        parts = np.array_split(np.arange(len(one)), min(20, len(one)))
        whole = square.sum()
        if whole <= 0.0:
            return False
        share = product_of.sum() / whole
        left_out = [
            (product_of.sum() - product_of[part].sum()) / max(whole - square[part].sum(), 1e-30) for part in parts
        ]
        sigma = float(np.sqrt((len(parts) - 1) / len(parts) * ((np.array(left_out) - share) ** 2).sum()))
        if share + SURE * sigma >= LIKE:
            return False
    return True


# ---------------------------------------------------------------------- heading offset


@dataclass(frozen=True, slots=True)
class HeadingOffset:
    """The excess of a trajectory's heading, rad, and its sigma."""

    offset_rad: float
    sigma_rad: float


def heading_offset(trajectory: Trajectory, imu_time_ns: Int64Array, imu_force_b: FloatArray) -> HeadingOffset | None:
    """Compare accelerations of the path flown with those that the IMU measured: their directions show a heading error.

    Accelerometer biases are estimated with it. Only turns and changes of speed carry information.

    Args:
        trajectory: of the body's origin, with attitude.
        imu_time_ns: (m,) GPS time of inertial samples, rising.
        imu_force_b: (m, 3) specific forces in b, m/s².

    Returns:
        None where less than ten seconds have a horizontal acceleration of 0.5 m/s².
    """
    seconds = _whole_seconds(trajectory, imu_time_ns)
    if len(seconds) < 2 or not np.isfinite(trajectory.velocity_e).all():
        return None
    with_velocities = trajectory.with_velocities()
    number = np.searchsorted(seconds, imu_time_ns, side="right") - 1
    inside = (number >= 0) & (number < len(seconds))
    inside[inside] = (imu_time_ns[inside] - seconds[number[inside]]) < SECOND_NS
    times, number = imu_time_ns[inside], number[inside]
    step = max(1, round(len(times) / len(seconds) / 50))
    times, number, force_b = times[::step], number[::step], imu_force_b[inside][::step]
    count = np.bincount(number, minlength=len(seconds)).astype(np.float64)
    poses = with_velocities.poses(times)
    felt_e = np.stack([np.bincount(number, column, len(seconds)) for column in rotated(poses.q_e_from_b, force_b).T], 1)
    full = count >= 0.8 * np.median(count)
    middle = with_velocities.poses(seconds + SECOND_NS // 2)
    q_l_from_e = conjugate(_q_e_from_l(middle.position_e))
    felt_l = rotated(q_l_from_e, felt_e / np.maximum(count, 1.0)[:, np.newaxis])
    flown_l = _force_flown(with_velocities, seconds, q_l_from_e, middle.position_e, middle.velocity_e)
    heavy = full & (np.hypot(flown_l[:, 0], flown_l[:, 1]) > ACCELERATES)
    if heavy.sum() < FEWEST_TURNS:
        return None
    q_l_from_b = product(q_l_from_e, middle.q_e_from_b)
    return _fitted(felt_l[full], flown_l[full], q_l_from_b[full])


def _whole_seconds(trajectory: Trajectory, imu_time_ns: Int64Array) -> Int64Array:
    """Return the start times of the seconds that both cover."""
    first = max(int(imu_time_ns[0]), trajectory.span[0]) + 1
    last = min(int(imu_time_ns[-1]), trajectory.span[1]) - 1
    begins = np.arange(first, last - SECOND_NS, SECOND_NS, dtype=np.int64)
    if not len(begins):
        return begins
    good = np.ones(len(begins), bool)
    for start, end in trajectory.gaps().tolist():
        good &= (begins + SECOND_NS < start) | (begins > end)
    return begins[good]


def _force_flown(
    flown: Trajectory, seconds: Int64Array, q_l_from_e: FloatArray, position_e: FloatArray, velocity_e: FloatArray
) -> FloatArray:
    """Return the specific force (k, 3) in l that the path flown needs: acceleration and Coriolis less gravity."""
    change_e = flown.poses(seconds + SECOND_NS).velocity_e - flown.poses(seconds).velocity_e
    earth = np.array([0.0, 0.0, EARTH_RATE_RADPS])
    inertial_l = rotated(q_l_from_e, change_e + 2.0 * np.cross(earth, velocity_e))
    force_l: FloatArray = inertial_l - rotated(q_l_from_e, gravity_e(position_e))
    return force_l


def _fitted(felt_l: FloatArray, flown_l: FloatArray, q_l_from_b: FloatArray) -> HeadingOffset:
    """Fit a turn about the vertical and biases in b, with sigmas from leaving out tenths (jackknife)."""
    rest = felt_l - flown_l
    columns = np.zeros((len(rest), 3, 4))
    columns[:, 0, 0], columns[:, 1, 0] = -flown_l[:, 1], flown_l[:, 0]
    for axis in range(3):
        unit = np.zeros(3)
        unit[axis] = 1.0
        columns[:, :, 1 + axis] = rotated(q_l_from_b, np.broadcast_to(unit, (len(rest), 3)))

    def solved(rows: Int64Array) -> float:
        return float(np.linalg.lstsq(columns[rows].reshape(-1, 4), rest[rows].reshape(-1), rcond=None)[0][0])

    everything = np.arange(len(rest))
    parts = np.array_split(everything, 10)
    whole = solved(everything)
    left_out = np.array([solved(np.setdiff1d(everything, part)) for part in parts])
    sigma = float(np.sqrt(0.9 * ((left_out - left_out.mean()) ** 2).sum()))
    return HeadingOffset(whole, sigma)
