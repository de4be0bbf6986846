"""Find a trajectory's time error by comparing its turn rates with those that the log's IMU measured.

Both are averaged over the same short steps; the normalised cross-correlation over three axes has its peak where the
trajectory's time is right. Whole days are tried as well, so that a wrong week or seconds of the day can be reported.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.timescales.gps_time import DAY_NS, SECOND_NS, table_leap_seconds, utc_from_gps
from swath.georef.trajectory.trajectory import Trajectory, TrajectoryError

STEP_NS = 50_000_000  # aircraft turn at less than 10 Hz, their engines vibrate faster
REACH_S = 20.0  # more than all leap seconds
REACH_STEPS = round(REACH_S * SECOND_NS / STEP_NS)
SHORTEST_NS = 30 * SECOND_NS  # of flight in common
CERTAIN = 0.6  # minimum correlation of a credible shift
BETTER_BY = 0.05  # minimum gain over the correlation without a shift
UNNOTICED_S = 0.02  # smaller shifts are not reported
NEAR_S = 0.25  # tolerance from whole leap seconds
PARABOLA_S = 5e-4  # error of a parabola through three steps


@dataclass(frozen=True, slots=True)
class TimeShift:
    """The shift to add to a trajectory's time so that it turns when the IMU does.

    Attributes:
        seconds: to be added, whole days included.
        correlation: at that shift, −1 … 1; nan if there was too little to compare.
        sigma: of `seconds`, s.
        unshifted: correlation with the given times; nan if they have too little in common.
        leap_seconds: GPS − UTC at the time of the log, by the built-in table.
    """

    seconds: float
    correlation: float
    sigma: float
    unshifted: float
    leap_seconds: int

    @property
    def is_certain(self) -> bool:
        """True if motion and correlation suffice for a decision."""
        return self.correlation >= CERTAIN

    @property
    def is_wrong(self) -> bool:
        """True if the trajectory's time certainly differs from the log's."""
        better = not self.correlation - self.unshifted < BETTER_BY
        return self.is_certain and better and abs(self.seconds) > max(UNNOTICED_S, 5 * self.sigma)

    @property
    def what(self) -> str:
        """The fault in words that follow a file's name; empty without a certain fault."""
        if not self.is_wrong:
            return ""
        days = round(self.seconds * SECOND_NS / DAY_NS)
        rest_s = self.seconds - days * (DAY_NS // SECOND_NS)
        parts = []
        if days and days % 7 == 0:
            parts.append(f"its week is wrong: add {days // 7:+d}")
        elif days:
            seconds = days * (DAY_NS // SECOND_NS)
            parts.append(f"its day is wrong, or its time is in seconds of the day: add {seconds:+d} s")
        if self.leap_seconds and abs(rest_s - self.leap_seconds) < NEAR_S:
            parts.append(f"its time is UTC, not GPS: add {self.leap_seconds:+d} s")
        elif self.leap_seconds and abs(rest_s + self.leap_seconds) < NEAR_S:
            parts.append(f"leap seconds were added to it twice: add {-self.leap_seconds:+d} s")
        elif not days or abs(rest_s) > max(UNNOTICED_S, 5 * self.sigma):
            parts.append(f"its time is off: add {rest_s:+.3f} s")
        return "; ".join(parts)


@dataclass(frozen=True, slots=True)
class Turning:
    """Mean rates over successive steps; the first begins at a whole multiple of a step.

    Attributes:
        first: number of the first step since the GPS epoch.
        rate_b: (n, 3) rad/s; 0 where unknown.
        known: (n,) 1 or 0.
    """

    first: int
    rate_b: FloatArray
    known: FloatArray


def correlate_turn_rates(trajectory: Trajectory, imu_time_ns: Int64Array, imu_rate_b: FloatArray) -> TimeShift:
    """Return the shift at which a trajectory and an IMU turn alike.

    Args:
        trajectory: with attitude.
        imu_time_ns: (m,) GPS time of inertial samples, rising: the ends of their intervals.
        imu_rate_b: (m, 3) their angular rates in b, rad/s.

    Raises:
        TrajectoryError: no attitude, or fewer than two epochs or samples.
    """
    trajectory.require_attitude()
    if len(trajectory) < 2 or len(imu_time_ns) < 2:
        raise TrajectoryError(f"trajectory {trajectory.name}: has too few epochs or inertial samples for a comparison")
    steps = -(-int(imu_time_ns[0]) // STEP_NS), int(imu_time_ns[-1]) // STEP_NS
    felt = turning(imu_time_ns, imu_rate_b[1:], 2 * int(np.median(np.diff(imu_time_ns))) + STEP_NS, steps)
    first_ns, last_ns = trajectory.span
    apart_days = round((int(imu_time_ns[0] + imu_time_ns[-1]) - first_ns - last_ns) / (2 * DAY_NS))
    day, _ = utc_from_gps(int(imu_time_ns[0]), 0)
    best = TimeShift(0.0, np.nan, np.nan, np.nan, table_leap_seconds(day)[0])
    for days in sorted({0, apart_days - 1, apart_days, apart_days + 1}, key=abs):
        coarse = days * (DAY_NS // STEP_NS)
        near = _told_near(trajectory, felt, coarse)
        found = None if near is None else _best_shift(near, felt, coarse)
        if found is None:
            continue
        shift_s, correlation, sigma, unshifted = found
        here = unshifted if days == 0 else best.unshifted
        if not correlation <= best.correlation:
            best = TimeShift(shift_s, correlation, sigma, here, best.leap_seconds)
    return best


def _told_near(trajectory: Trajectory, felt: Turning, coarse: int) -> Turning | None:
    """Return a trajectory's turning over the IMU's time and the searched reach around it, some steps away."""
    first = felt.first - REACH_STEPS - coarse
    last = felt.first + len(felt.rate_b) + REACH_STEPS - coarse
    part = trajectory.between(first * STEP_NS, last * STEP_NS)
    if len(part) < 2:
        return None
    begin, end = -(-part.span[0] // STEP_NS), part.span[1] // STEP_NS  # beyond a gap, these may be years away
    steps = max(first, begin), min(last, end)
    return None if steps[1] <= steps[0] else turning(part.time_ns, part.turn_rates_b("i"), part.max_gap_ns, steps)


def turning(time_ns: Int64Array, rate_b: FloatArray, max_gap_ns: int, steps: tuple[int, int]) -> Turning:
    """Return mean rates over steps, from rates (n − 1, 3) over the intervals between times (n,).

    Rates are integrated, interpolated at the ends of steps, and differenced. Gaps and values that are not numbers are
    unknown.
    """
    first, last = steps
    since_s = (time_ns - first * STEP_NS) / SECOND_NS
    length_s = np.diff(since_s)[:, np.newaxis]
    gap = (length_s[:, 0] * SECOND_NS > max_gap_ns) | ~np.isfinite(rate_b).all(axis=1)
    turned = np.concatenate([np.zeros((1, 3)), np.cumsum(np.where(gap[:, np.newaxis], 0.0, rate_b) * length_s, axis=0)])
    unknown_s = np.r_[0.0, np.cumsum(np.where(gap, length_s[:, 0], 0.0))]
    ends_s = np.arange(last - first + 1) * (STEP_NS / SECOND_NS)
    at_ends = [np.interp(ends_s, since_s, column) for column in (*turned.T, unknown_s)]
    step_s = STEP_NS / SECOND_NS
    known = np.diff(at_ends[3]) == 0.0
    rate = np.diff(np.stack(at_ends[:3], axis=1), axis=0) / step_s
    if known.any():
        rate -= rate[known].mean(axis=0)
    rate[~known] = 0.0
    return Turning(first, rate, known.astype(np.float64))


def _best_shift(told: Turning, felt: Turning, coarse: int) -> tuple[float, float, float, float] | None:
    """Return seconds, correlation, sigma and the correlation at the coarse shift; None if too little is in common."""
    begin = felt.first - REACH_STEPS - told.first - coarse  # of told's rows, which may lie outside
    wanted = np.arange(begin, begin + len(felt.rate_b) + 2 * REACH_STEPS)
    there = (wanted >= 0) & (wanted < len(told.rate_b))
    rate, known = np.zeros((len(wanted), 3)), np.zeros(len(wanted))
    rate[there], known[there] = told.rate_b[wanted[there]], told.known[wanted[there]]

    common = _at_lags(known, felt.known)
    product = np.sum([_at_lags(rate[:, k], felt.rate_b[:, k]) for k in range(3)], axis=0)
    energy_told = _at_lags((rate**2).sum(axis=1), felt.known)
    energy_felt = _at_lags(known, (felt.rate_b**2).sum(axis=1))
    enough = common * STEP_NS > SHORTEST_NS
    if not enough.any():
        return None
    scale = np.sqrt(np.maximum(energy_told, 0.0) * np.maximum(energy_felt, 0.0))
    correlation = np.where(enough & (scale > 0.0), product / np.maximum(scale, 1e-30), -1.0)
    at = int(np.argmax(correlation))
    residual = max(energy_told[at] + energy_felt[at] - 2.0 * product[at], 0.0) / (3.0 * common[at])
    steepness = (np.diff(rate, axis=0) ** 2).sum() / (STEP_NS / SECOND_NS) ** 2
    sigma = float(np.sqrt(residual / steepness + PARABOLA_S**2)) if steepness > 0.0 else np.inf
    # if a later row of the trajectory fits, the trajectory's time is late
    lag = REACH_STEPS - at - _peak(correlation, at)
    shift_s = (coarse + lag) * STEP_NS / SECOND_NS
    unshifted = float(correlation[REACH_STEPS]) if enough[REACH_STEPS] else float("nan")
    return shift_s, float(correlation[at]), sigma, unshifted


def _at_lags(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return Σ a[k + j] b[j] for every k at which b lies within a."""
    size = 1 << (len(a) - 1).bit_length()  # the wrap-around affects only values beyond these k
    spectrum = np.fft.rfft(a, size) * np.conj(np.fft.rfft(b, size))
    sums: FloatArray = np.fft.irfft(spectrum, size)[: len(a) - len(b) + 1]
    return sums


def _peak(values: FloatArray, at: int) -> float:
    """Return the top of the parabola through `at` and its neighbours, relative to `at`, −0.5 … 0.5."""
    if not 0 < at < len(values) - 1:
        return 0.0
    before, top, after = values[at - 1 : at + 2]
    bend = before - 2.0 * top + after
    return float((before - after) / (2.0 * bend)) if bend < 0.0 else 0.0
