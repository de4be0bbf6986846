"""The line through the PPS edges: phase and drift of a clock, with a realistic sigma.

Edge n is expected at host time ``anchor + n·1 s + x``, and x (the phase, ns) grows by y (the drift, ns/s; positive: the
host clock runs fast). The best number of past edges depends on the stamps' noise and on the oscillator: 50 ns stamps
need the last 16 s, user-space stamps of 300 µs several minutes, a crystal on a temperature ramp fewer again. Therefore
the line is not fitted over one fixed window: a bank of lines with fading memory (two-state filters, each assuming
another wander of the frequency) runs side by side and the data weight them; the result is their weighted mean, with the
spread between them in its variance. It is robust: an innovation beyond 3 × 1.48 MAD of the last 64 is left out. Both
the stamps' noise and the growth of prediction errors over 16 s to 256 s are estimated from the data, starting from the
priors in this module.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from swath.georef.arrays import FloatArray

# Documented priors. Wander of the frequency, ns/s per √s: 0.3e-9 (a good TCXO at rest) to 1e-7 (a crystal on a ramp of
# 0.5 ppm/min looks like 3e-8 to 1e-7 over a minute), and how common each is.
WANDER_GRID = (0.3, 1.0, 3.0, 10.0, 30.0, 100.0)
WANDER_PRIOR = (0.2, 0.3, 0.3, 0.14, 0.05, 0.01)
SWITCH_PER_S = 1.0 / 1200.0  # how often an oscillator changes its behaviour (temperature, airflow)
NOISE_FLOOR_NS = 5.0  # time stamping is never better than this
DRIFT_PRIOR = 1e5  # 100 ppm in ns/s, sigma before the first edges
NOISE_MEMORY = 128  # edges
MAD_WINDOW = 64
OUTLIER_MAD = 3 * 1.4826
TRUNCATED_VARIANCE = 0.9733  # of a normal distribution cut at 3 sigma
QUIET_EDGES, TOO_QUIET, QUIET_MARGIN = 16, 0.35, 2.0  # innovations half as large as predicted: the noise is smaller
# median of normalised innovations, 0.67 for the right noise: the first lock was on edges that were even by chance
TOO_LOUD = 1.2
OUTLIERS_IN_A_ROW = 4  # after this many outliers in a row they are accepted
HORIZONS = (16, 64, 256)  # seconds over which past predictions are compared with edges
HORIZON_MEMORY = 1200  # edges
SETTLING_EDGES = 64  # the first predictions carry no information about later ones
SHRINK_HORIZON = 64
SHRINK_BOUND = 0.25
WORST_ERROR = 1e3  # a squared prediction error counts up to this multiple of its variance


@dataclass(slots=True)
class Knot:
    """The line as it was after one edge: enough to predict with sigma at any time after (and before) it.

    Attributes:
        index: edge number n.
        phase_ns, drift_ns_s: x and y there.
        var_phase, var_cross, var_drift: their covariance (ns², ns²/s, ns²/s²).
        wander: variance of the frequency's random walk, (ns/s)²/s.
        excess: variance (ns²) by which predictions over HORIZONS were worse than that.
        shrink: factor (≤ 1) if they were better.
    """

    index: int
    phase_ns: float
    drift_ns_s: float
    var_phase: float
    var_cross: float
    var_drift: float
    wander: float
    excess: tuple[float, ...]
    shrink: float = 1.0

    def phase_at(self, index: float) -> float:
        """Return the phase (ns) extrapolated to an edge number."""
        return self.phase_ns + self.drift_ns_s * (index - self.index)

    def variance_at(self, index: float) -> float:
        """Return the variance (ns²) of that phase: as the filters predict it, plus the excess of past predictions."""
        seconds = abs(index - self.index)
        plain = self.plain_variance(seconds) * shrink_factor(self.shrink, seconds)
        return plain + excess_variance(self.excess, seconds)

    def plain_variance(self, seconds: float) -> float:
        """Return the variance (ns²) seconds after the knot, as the filters predict it."""
        return self.var_phase + seconds * (
            2.0 * self.var_cross + seconds * (self.var_drift + self.wander * seconds / 3.0)
        )


def shrink_factor(shrink: float, seconds: float) -> float:
    """Return a factor on the predicted variance after some seconds: 1 at the knot, `shrink` from SHRINK_HORIZON on."""
    return 1.0 + (shrink - 1.0) * min(seconds / SHRINK_HORIZON, 1.0)


def excess_variance(excess: tuple[float, ...], seconds: float) -> float:
    """Return the excess variance after some seconds, linear in their cube between HORIZONS (and 0).

    Beyond the last horizon it grows with the cube.
    """
    near_s, near = 0.0, 0.0
    for far_s, far in zip(HORIZONS, excess, strict=True):
        if seconds <= far_s:
            return near + (far - near) * (seconds**3 - near_s**3) / (far_s**3 - near_s**3)
        near_s, near = float(far_s), far
    return near * (seconds / near_s) ** 3


def excess_variances(excess: FloatArray, seconds: FloatArray) -> FloatArray:
    """Return `excess_variance` of rows (n, 3) at times (n,)."""
    cube = seconds**3
    near_s, near = 0.0, np.zeros_like(seconds)
    result = excess[:, -1] * cube / HORIZONS[-1] ** 3
    for column, far_s in reversed(list(enumerate(HORIZONS))):
        near_s = float(HORIZONS[column - 1]) if column else 0.0
        near = excess[:, column - 1] if column else np.zeros_like(seconds)
        inside = near + (excess[:, column] - near) * (cube - near_s**3) / (far_s**3 - near_s**3)
        result = np.where(seconds <= far_s, inside, result)
    return result


class _Excess:
    """The mean excess of squared prediction errors over noise plus predicted variance, for one horizon.

    It counts only as far as it is significant (1 sigma; errors over h seconds are independent every h seconds only).
    """

    def __init__(self, horizon: int) -> None:
        self.horizon = horizon
        self._count = 0.0
        self._excess = 0.0
        self._variance = 0.0
        self._weight = 0.0
        self._ratio = 0.0

    def add(self, error_ns: float, variance: float, noise: float) -> None:
        """Take one prediction error, its predicted variance and that of the stamp it was compared with."""
        squared = min(error_ns * error_ns, WORST_ERROR * (variance + noise))
        self._count = min(self._count + 1.0, HORIZON_MEMORY)
        share = 1.0 / self._count
        self._excess += (squared - noise - variance - self._excess) * share
        self._variance += (variance - self._variance) * share
        total = variance + noise
        weight = (variance / total) ** 2
        self._weight += (weight - self._weight) * share
        self._ratio += ((squared - noise) * variance / (total * total) - self._ratio) * share

    def variance(self, noise: float) -> float:
        """Return the excess variance, ns²."""
        if not self._count:
            return 0.0
        chance = noise * math.sqrt(2.0 / self._count) + self._variance * math.sqrt(2.0 * self.horizon / self._count)
        shrunk = self._excess * self._count / (self._count + self.horizon)
        return max(0.0, shrunk - 0.5 * chance)

    def shrink(self) -> float:
        """Return measured over predicted variance, at most 1: least squares of e² = R + f·V and a prior."""
        prior = float(self.horizon)
        ratio = (prior + self._count * self._ratio) / (prior + self._count * self._weight)
        return min(max(ratio, SHRINK_BOUND), 1.0)


class LineBank:
    """The weighted bank of lines; one `update` per edge (about 20 µs)."""

    def __init__(self, index: int, phase_ns: float, noise_ns: float) -> None:
        """Start at one edge; noise_ns is a first guess of the stamps' noise, worth eight edges."""
        size = len(WANDER_GRID)
        self._wander = [q * q for q in WANDER_GRID]
        self._noise = max(noise_ns, NOISE_FLOOR_NS) ** 2
        self._noise_count = 8.0
        self._phase = [phase_ns] * size
        self._drift = [0.0] * size
        self._pxx = [self._noise] * size
        self._pxy = [0.0] * size
        self._pyy = [DRIFT_PRIOR**2] * size
        self._weight = list(WANDER_PRIOR)
        self._normalised: deque[float] = deque(maxlen=MAD_WINDOW)
        self._outliers_in_a_row = 0
        self._excess = tuple(_Excess(horizon) for horizon in HORIZONS)
        self._settled_index = index + SETTLING_EDGES
        self._past: deque[Knot] = deque(maxlen=HORIZONS[-1] + 1)
        self._gain_phase = [1.0] * size
        self._gain_drift = [0.0] * size
        self.outliers = 0
        self.knot = self._moments(index)
        self._past.append(self.knot)

    @property
    def noise_ns(self) -> float:
        """The sigma of the stamps from the data."""
        return math.sqrt(self._noise)

    def update(self, index: int, phase_ns: float) -> bool:
        """Take the edge `index` seen at phase_ns; return False if it was left out as an outlier."""
        knot = self.knot
        innovation = phase_ns - knot.phase_at(index)
        variance = knot.variance_at(index)
        normalised = innovation / math.sqrt(variance + self._noise)
        if self._is_outlier(normalised):
            return False
        self._learn_noise(normalised, variance)
        self._learn_excess(index, phase_ns)
        self._filter(index, phase_ns)
        self.knot = self._moments(index)
        self._past.append(self.knot)
        return True

    def amend_last(self, correction_ns: float) -> None:
        """Move the last edge taken by correction_ns, known only afterwards (the filters are linear in it)."""
        for i in range(len(self._phase)):
            self._phase[i] += self._gain_phase[i] * correction_ns
            self._drift[i] += self._gain_drift[i] * correction_ns
        self.knot = self._moments(self.knot.index)
        self._past[-1] = self.knot

    def _is_outlier(self, normalised: float) -> bool:
        recent = self._normalised
        scale = OUTLIER_MAD
        if len(recent) >= 8:
            median = sorted(recent)[len(recent) // 2]
            scale = OUTLIER_MAD * max(median, 1.0 / 1.4826)
            if median < TOO_QUIET and len(recent) >= QUIET_EDGES:
                self._noise *= QUIET_MARGIN * (1.4826 * median) ** 2
                recent.clear()
            elif median > TOO_LOUD:
                self._noisier((1.4826 * median) ** 2)
                recent.clear()
        recent.append(abs(normalised))
        if abs(normalised) <= scale or self._outliers_in_a_row >= OUTLIERS_IN_A_ROW - 1:
            self._outliers_in_a_row = 0
            return False
        self._outliers_in_a_row += 1
        self.outliers += 1
        return True

    def _noisier(self, factor: float) -> None:
        """Scale up the stamps' variance, and everything computed with it, as it was too small by this factor."""
        self._noise *= factor
        for i in range(len(self._pxx)):
            self._pxx[i] *= factor
            self._pxy[i] *= factor
            self._pyy[i] *= factor
        self.knot = self._moments(self.knot.index)
        self._past[-1] = self.knot

    def _learn_noise(self, normalised: float, variance: float) -> None:
        """Update R = E[(1 − K) e²] = R·E[e²/S] towards the inliers' value, as fast as their number allows."""
        self._noise_count = min(self._noise_count + 1.0, NOISE_MEMORY)
        # after a long gap an innovation carries little information about the stamps
        share = self._noise / (self._noise + variance)
        seen = self._noise * min(normalised * normalised, 9.0) / TRUNCATED_VARIANCE
        self._noise += (seen - self._noise) * share / self._noise_count
        self._noise = max(self._noise, NOISE_FLOOR_NS**2)

    def _learn_excess(self, index: int, phase_ns: float) -> None:
        """Compare this edge with its predictions from HORIZONS seconds ago."""
        past = self._past
        for excess in self._excess:
            wanted = index - excess.horizon
            if wanted < self._settled_index:
                return
            place = max(0, len(past) - 1 - (past[-1].index - wanted))  # exact if no edge is missing, else too early
            while place < len(past) and past[place].index < wanted:
                place += 1
            if place < len(past) and past[place].index == wanted:
                knot = past[place]
                excess.add(phase_ns - knot.phase_at(index), knot.plain_variance(excess.horizon), self._noise)

    def _filter(self, index: int, phase_ns: float) -> None:
        """Advance every line in the bank by one step, and their weights."""
        seconds = float(index - self.knot.index)
        noise = self._noise
        scores = []
        for i, wander in enumerate(self._wander):
            pxy, pyy = self._pxy[i], self._pyy[i]
            pxx = self._pxx[i] + seconds * (2.0 * pxy + seconds * (pyy + wander * seconds / 3.0))
            pxy += seconds * (pyy + 0.5 * wander * seconds)
            pyy += wander * seconds
            phase = self._phase[i] + self._drift[i] * seconds
            innovation = phase_ns - phase
            total = pxx + noise
            gain_phase, gain_drift = pxx / total, pxy / total
            self._phase[i] = phase + gain_phase * innovation
            self._drift[i] += gain_drift * innovation
            self._pxx[i] = gain_phase * noise
            self._pxy[i] = gain_drift * noise
            self._pyy[i] = pyy - gain_drift * pxy
            self._gain_phase[i], self._gain_drift[i] = gain_phase, gain_drift
            scores.append(-0.5 * (innovation * innovation / total + math.log(total)))
        self._reweigh(scores, seconds)

    def _reweigh(self, scores: list[float], seconds: float) -> None:
        best = max(scores)
        raised = [weight * math.exp(score - best) for weight, score in zip(self._weight, scores, strict=True)]
        total = sum(raised)
        switch = min(0.5, SWITCH_PER_S * seconds)
        keep = (1.0 - switch) / total
        self._weight = [keep * weight + switch * prior for weight, prior in zip(raised, WANDER_PRIOR, strict=True)]

    def _moments(self, index: int) -> Knot:
        """Return the bank as one line: weighted mean, and within- plus between-line covariance."""
        mean_x = mean_y = 0.0
        for weight, x, y in zip(self._weight, self._phase, self._drift, strict=True):
            mean_x += weight * x
            mean_y += weight * y
        xx = xy = yy = wander = 0.0
        rows = zip(self._weight, self._phase, self._drift, self._pxx, self._pxy, self._pyy, self._wander, strict=True)
        for weight, x, y, pxx, pxy, pyy, q in rows:
            dx, dy = x - mean_x, y - mean_y
            xx += weight * (pxx + dx * dx)
            xy += weight * (pxy + dx * dy)
            yy += weight * (pyy + dy * dy)
            wander += weight * q
        excess = tuple(horizon.variance(self._noise) for horizon in self._excess)
        shrink = 1.0 if any(excess) else self._excess[HORIZONS.index(SHRINK_HORIZON)].shrink()
        return Knot(index, mean_x, mean_y, xx, xy, yy, wander, excess, shrink)
