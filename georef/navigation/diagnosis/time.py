"""Find a time offset between GNSS and the inertial unit by comparing their motion at other times.

Three comparisons need neither an attitude nor the order, the signs or the unit of the sensors' axes. Over the intervals
between velocities they compare the size of the specific force with that needed for the change of velocity, the rate of
the course with a mixture of the three gyroscopes, and the change of speed with a mixture of the three accelerometers;
the shift with the greatest multiple correlation is the offset.

The uncertainty of an offset has two parts. A block bootstrap estimates the effect of chance (Künsch 1989: stretches of
20 s drawn with replacement). It cannot estimate the effect of motion that the comparison leaves out, such as a nose
that turns before the course does: the unexplained part of the motion may be shifted, and moves the peak by its share of
the signal over the signal's rate. Comparisons that contradict each other give no offset.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from swath.georef.arrays import FloatArray, Int64Array, StructArray
from swath.georef.geodesy.earth import geodetic_from_e, rot_e_from_l
from swath.georef.navigation.inputs import Inertial, Kind
from swath.georef.timescales.gps_time import SECOND_NS

G_MPS2 = 9.80665
REACH_S = 20.0  # more than all leap seconds
COARSE_S, FINE_S = 0.2, 0.01
LONGEST_S = 2.5  # greatest interval between compared velocities
SLOW_MPS = 3.0  # below this speed the course is undefined
FEWEST = 40  # minimum number of intervals
MOST = 6000  # greatest number of compared intervals: longer recordings are sampled in stretches throughout
WHOLE = 0.98  # share of an interval that samples must cover
CERTAIN, WEAK, BETTER_BY = 0.7, 0.5, 0.004  # correlation, and its minimum gain over that without a shift
UNNOTICED_S = {"force": 0.1, "turn": 0.2, "speed": 0.1}  # an aircraft's course turns differently from its nose
BLOCK_S, DRAWS = 20.0, 40  # of the bootstrap
COHERENT = 0.3  # share of the unexplained motion that may be the explained one at another time
# minimum size of an offset that may be reported, if it also improves the fit; distance of two that contradict each
# other
SIGMAS, APART = 3.0, 3.0


@dataclass(frozen=True, slots=True)
class Measure:
    """GNSS's times minus the inertial unit's, by one comparison.

    Attributes:
        compared: "force", "turn" or "speed".
        seconds: positive: GNSS's stamps are late.
        sigma: of `seconds`, without the effect of chance (which `TimeOffset` includes).
        correlation: of the motion after removing the offset; `unshifted`: before.
    """

    compared: str
    seconds: float
    sigma: float
    correlation: float
    unshifted: float


@dataclass(frozen=True, slots=True)
class TimeOffset:
    """GNSS's times minus the inertial unit's, by all comparisons.

    Attributes:
        seconds: of the most certain one; positive: GNSS's stamps are late.
        sigma: of `seconds`.
        correlation: of the motion after removing the offset; `unshifted`: before.
        compared: the comparison behind it.
        contradiction: another comparison's contradicting result in words; may be empty.
    """

    seconds: float
    sigma: float
    correlation: float
    unshifted: float
    compared: str
    contradiction: str = ""

    @property
    def is_certain(self) -> bool:
        """True if there was enough motion, and no comparison contradicts."""
        return self.correlation > CERTAIN and not self.contradiction

    @property
    def is_wrong(self) -> bool:
        """True if the clocks certainly differ by more than a negligible amount."""
        better = self.correlation - self.unshifted > BETTER_BY
        large = abs(self.seconds) > max(UNNOTICED_S[self.compared], SIGMAS * self.sigma)
        return self.is_certain and better and large


def time_offset(inertial: Inertial, observations: StructArray) -> TimeOffset | None:
    """Return the seconds by which GNSS's times are late; None if there is too little to compare."""
    time_ns, velocity_l = velocities(observations)
    if len(inertial) < FEWEST or len(time_ns) < FEWEST:
        return None
    compared = [_Comparison(name, *parts) for name, parts in _comparisons(inertial, time_ns, velocity_l).items()]
    found = [(each, measure) for each in compared if (measure := each.measure()) is not None]
    if not found:
        return None
    clear = [pair for pair in found if pair[1].correlation > WEAK] or found
    best, measure = min(clear, key=lambda pair: pair[1].sigma)
    # no offset will be reported, so that the effect of chance does not matter
    if abs(measure.seconds) <= UNNOTICED_S[measure.compared]:
        return TimeOffset(measure.seconds, measure.sigma, measure.correlation, measure.unshifted, measure.compared)
    sigma = float(np.hypot(measure.sigma, best.spread_s()))
    against = ""
    for each, other in clear:
        off = abs(other.seconds - measure.seconds)
        if each is best or off <= APART * np.hypot(sigma, other.sigma):
            continue
        of_other = float(np.hypot(other.sigma, each.spread_s()))
        if off > max(APART * np.hypot(sigma, of_other), UNNOTICED_S[other.compared]):
            against = f"by the {other.compared} {1000.0 * other.seconds:+.0f} ± {1000.0 * of_other:.0f} ms"
    return TimeOffset(measure.seconds, sigma, measure.correlation, measure.unshifted, measure.compared, against)


def velocities(observations: StructArray) -> tuple[Int64Array, FloatArray]:
    """Return times (n,) and velocities (n, 3) north, east, down, the first of each fifth of a second.

    Without observed velocities, those between the first positions of each second: between nearer ones noise hides the
    motion.
    """
    rows = observations[observations["kind"] == Kind.VELOCITY]
    rows = _apart(rows[np.isfinite(rows["value"]).all(axis=1)], SECOND_NS // 5)
    if len(rows) >= FEWEST:
        return rows["time_ns"].astype(np.int64), rows["value"]
    rows = observations[observations["kind"] == Kind.POSITION]
    rows = _apart(rows[np.isfinite(rows["value"]).all(axis=1)], SECOND_NS)
    if len(rows) < 2:
        return np.zeros(0, np.int64), np.zeros((0, 3))
    moved_e = np.diff(rows["value"], axis=0) / (np.diff(rows["time_ns"]) / SECOND_NS)[:, None]
    lat, lon, _ = geodetic_from_e(rows["value"][1:])
    middle_ns = rows["time_ns"][:-1] + np.diff(rows["time_ns"]) // 2
    return middle_ns, np.einsum("nji,nj->ni", rot_e_from_l(lat, lon), moved_e)


def _apart(rows: StructArray, step_ns: int) -> StructArray:
    """Return the first row of each time step."""
    cell = rows["time_ns"] // step_ns
    return rows[np.concatenate([[True], np.diff(cell) > 0])] if len(rows) else rows


def _seen(time_ns: Int64Array, velocity_l: FloatArray) -> dict[str, FloatArray]:
    """Return what GNSS shows by interval (n − 1,), nan where unknown.

    It is the specific force m/s² that changes of velocity need, the turn of the course rad/s, and the change of speed
    m/s².
    """
    step_s = np.maximum(np.diff(time_ns) / SECOND_NS, 1e-3)
    needed = np.diff(velocity_l, axis=0) / step_s[:, None] - [0.0, 0.0, G_MPS2]
    course = np.arctan2(velocity_l[:, 1], velocity_l[:, 0])
    turn = ((np.diff(course) + np.pi) % (2.0 * np.pi) - np.pi) / step_s
    speed = np.hypot(velocity_l[:, 0], velocity_l[:, 1])
    stands = (speed[1:] < SLOW_MPS) | (speed[:-1] < SLOW_MPS)
    return {
        "force": np.linalg.norm(needed, axis=1),
        "turn": np.where(stands, np.nan, turn),
        "speed": np.where(stands, np.nan, np.diff(speed) / step_s),
    }


def _comparisons(
    inertial: Inertial, time_ns: Int64Array, velocity_l: FloatArray
) -> dict[str, tuple[FloatArray, FloatArray, FloatArray, _Felt]]:
    """Return by name the starts and ends (n,), s, GNSS's values (n,), and the sensors' sums."""
    step_s = np.diff(time_ns) / SECOND_NS
    first = int(inertial.time_ns[0])
    at_s = (time_ns - first) / SECOND_NS
    grid_s = np.arange(0.0, (int(inertial.time_ns[-1]) - first) / SECOND_NS, _Felt.GRID_S)
    since_s = (inertial.time_ns - first) / SECOND_NS
    force, turn = (
        np.stack([np.interp(grid_s, since_s, column) for column in np.cumsum(values, axis=0).T], axis=-1)
        for values in (inertial.velocity_b, inertial.angle_b)
    )
    sampled_s = np.interp(grid_s, since_s, np.cumsum(inertial.interval_s))
    size = np.linalg.norm(np.diff(force, axis=0), axis=1)
    felt = {"force": np.append(0.0, np.cumsum(size))[:, None], "turn": turn, "speed": force}
    within = (step_s < LONGEST_S) & (at_s[:-1] >= 0.0) & (at_s[1:] <= grid_s[-1])
    found = {}
    for name, seen in _seen(time_ns, velocity_l).items():
        used = np.flatnonzero(within & np.isfinite(seen))
        if len(used) > MOST:  # complete blocks, evenly over the flight
            block = np.arange(len(used)) // 100
            used = used[block % -(-len(used) // MOST) == 0]
        if len(used) >= FEWEST and np.std(seen[used]) > 1e-6:
            found[name] = at_s[:-1][used], at_s[1:][used], seen[used], _Felt(grid_s, felt[name], sampled_s)
    return found


@dataclass(frozen=True, eq=False)
class _Felt:
    """Cumulative sums over a grid of times: of the sensors' values (m, k), and of the samples' intervals (m,)."""

    GRID_S = 0.05

    grid_s: FloatArray
    sums: FloatArray
    sampled_s: FloatArray


class _Comparison:
    """One comparison at all shifts: sums of squares and products by blocks, which any mixture of blocks adds up."""

    def __init__(self, name: str, begins_s: FloatArray, ends_s: FloatArray, seen: FloatArray, felt: _Felt) -> None:
        self._name, self._begins_s, self._ends_s, self._seen, self._felt = name, begins_s, ends_s, seen, felt
        number = ((begins_s - begins_s[0]) // BLOCK_S).astype(np.int64)
        self._first = np.flatnonzero(np.diff(number, prepend=-1))
        self._coarse_s = np.arange(-REACH_S, REACH_S + COARSE_S / 2, COARSE_S)
        self._coarse = self._sums(self._coarse_s)
        self._peak = int(np.argmax(_explained(self._coarse.sum(axis=1))))
        middle = self._coarse_s[self._peak]
        self._fine_s = np.arange(middle - 2 * COARSE_S, middle + 2 * COARSE_S + FINE_S / 2, FINE_S)
        self._fine = self._sums(self._fine_s)

    def measure(self) -> Measure | None:
        """Return the shift with the greatest correlation; None without motion."""
        explained = _explained(self._fine.sum(axis=1))
        at_s, bend = self._top(explained)
        height = float(explained.max())
        if height <= 0.0 or bend <= 0.0:
            return None
        width_s = np.sqrt(height / bend)
        unexplained = np.sqrt(max(1.0 / height - 1.0, 0.0))
        sigma = max(COHERENT * unexplained * width_s, FINE_S / 2)
        unshifted = _explained(self._sums(np.zeros(1)).sum(axis=1))[0]
        return Measure(self._name, at_s, float(sigma), float(np.sqrt(height)), float(np.sqrt(max(unshifted, 0.0))))

    def spread_s(self) -> float:
        """Return the standard deviation of the shift over mixtures of blocks drawn with replacement."""
        blocks = len(self._first)
        if blocks < 2:
            return REACH_S
        drawn = np.random.default_rng(0).multinomial(blocks, np.full(blocks, 1.0 / blocks), size=DRAWS)
        found = []
        for weights in drawn.astype(np.float64):
            coarse = int(np.argmax(_explained(np.tensordot(self._coarse, weights, axes=(1, 0)))))
            if abs(coarse - self._peak) > 2:
                found.append(float(self._coarse_s[coarse]))
            else:
                found.append(self._top(_explained(np.tensordot(self._fine, weights, axes=(1, 0))))[0])
        return float(np.std(found))

    def _top(self, explained: FloatArray) -> tuple[float, float]:
        """Return the position of a parabola's top about the greatest value, s, and its curvature, 1/s²."""
        peak = int(np.argmax(explained))
        low, high = max(peak - 10, 0), min(peak + 10, len(explained) - 1)
        near = self._fine_s[low : high + 1] - self._fine_s[peak]
        bend, slope, _ = np.polyfit(near, explained[low : high + 1], 2)
        inside = -0.5 * slope / bend if bend < 0.0 else 0.0
        return float(self._fine_s[peak] + np.clip(inside, -0.1, 0.1)), float(-bend)

    def _sums(self, lates_s: FloatArray) -> FloatArray:
        """Return (shifts, …) `_blocks` at each shift; tensordot needs the blocks second."""
        return np.stack([self._blocks(float(late)) for late in lates_s])

    def _blocks(self, late_s: float) -> FloatArray:
        """Return sums (blocks, k + 2, k + 2) of products of 1, the sensors' values and GNSS's value."""
        begins_s, ends_s, felt = self._begins_s - late_s, self._ends_s - late_s, self._felt
        length_s = ends_s - begins_s
        columns = [*felt.sums.T, felt.sampled_s]
        *inside, sampled_s = (
            np.interp(ends_s, felt.grid_s, column) - np.interp(begins_s, felt.grid_s, column) for column in columns
        )
        there = (begins_s >= felt.grid_s[0]) & (ends_s <= felt.grid_s[-1]) & (sampled_s > WHOLE * length_s)
        rows = np.column_stack([np.ones(len(length_s)), *(part / length_s for part in inside), self._seen])
        rows *= there[:, None]
        products = rows[:, :, None] * rows[:, None, :]
        return np.asarray(np.add.reduceat(products, self._first, axis=0))


def _explained(sums: FloatArray) -> FloatArray:
    """Return (…) the share of the variance that is explained, less that by chance, of sums (…, k + 2, k + 2).

    A size of one component explains only values that grow with it.
    """
    count = sums[..., 0, 0]
    mean = sums[..., 0, 1:] / np.maximum(count, 1.0)[..., None]
    scatter = sums[..., 1:, 1:] - count[..., None, None] * mean[..., :, None] * mean[..., None, :]
    felt, both, seen = scatter[..., :-1, :-1], scatter[..., :-1, -1], scatter[..., -1, -1]
    known = felt.shape[-1]
    ridge = 1e-9 * np.trace(felt, axis1=-2, axis2=-1)[..., None, None] + 1e-300
    gains = np.linalg.solve(felt + ridge * np.eye(known), both[..., None])[..., 0]
    share = np.clip((gains * both).sum(axis=-1) / np.maximum(seen, 1e-300), 0.0, 1.0)
    if known == 1:
        share = np.where(gains[..., 0] > 0.0, share, 0.0)
    free = np.maximum(count - known - 1.0, 1.0)
    adjusted: FloatArray = np.where(count >= FEWEST, 1.0 - (1.0 - share) * (count - 1.0) / free, 0.0)
    return adjusted
