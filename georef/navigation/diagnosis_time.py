"""Are GNSS and the inertial unit on one clock? Their motion compared at other times tells by how much they are off.

Two numbers that need no attitude are compared over the intervals between velocities: the size of the specific force,
felt and needed for the change of velocity; and the rate of turn, felt about the apparent vertical and seen in the
course.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from georef.earth import geodetic_from_e, rot_e_from_l
from georef.navigation.inputs import Inertial, Kind
from georef.records import Int64Array, StructArray
from georef.timescales.gps_time import SECOND_NS

FloatArray = NDArray[np.float64]

G_MPS2 = 9.80665
REACH_S = 20.0  # more than all leap seconds
COARSE_S, FINE_S = 0.2, 0.005
LONGEST_S = 2.5  # between velocities that are compared
SLOW_MPS = 3.0  # below it there is no course
FEWEST = 40  # intervals
WHOLE = 0.98  # share of an interval that samples must cover
CERTAIN, BETTER_BY = 0.7, 0.004  # correlation, and by how much it must beat that without a shift
UNNOTICED_S = {"force": 0.1, "turn": 0.2}  # an aircraft's course turns otherwise than its nose


@dataclass(frozen=True, slots=True)
class TimeOffset:
    """GNSS's times less the inertial unit's.

    Attributes:
        seconds: positive: GNSS's stamps are late.
        sigma: of it.
        correlation: of the motion when it is taken off; `unshifted`: as the times are.
        compared: "force" or "turn".
    """

    seconds: float
    sigma: float
    correlation: float
    unshifted: float
    compared: str

    @property
    def is_certain(self) -> bool:
        """Whether there was motion enough to tell."""
        return self.correlation > CERTAIN

    @property
    def is_wrong(self) -> bool:
        """Whether the clocks certainly differ by more than small change."""
        better = self.correlation - self.unshifted > BETTER_BY
        return self.is_certain and better and abs(self.seconds) > max(UNNOTICED_S[self.compared], 5.0 * self.sigma)


def time_offset(inertial: Inertial, observations: StructArray) -> TimeOffset | None:
    """By how much GNSS's times are late; None where there is too little to compare."""
    time_ns, velocity_l = velocities(observations)
    step_s = np.diff(time_ns) / SECOND_NS
    if len(inertial) < FEWEST or len(time_ns) < FEWEST:
        return None
    push, turn = _seen(time_ns, velocity_l)
    felt = _Felt(inertial)
    near = (step_s < LONGEST_S) & felt.covers(time_ns)
    best: TimeOffset | None = None
    for name, seen, total in (("force", push, felt.force_sum), ("turn", turn, felt.turn_sum)):
        used = near & np.isfinite(seen)
        found = _best(time_ns, seen, used, felt, total, name) if used.sum() >= FEWEST else None
        if found is not None and (best is None or found.correlation > best.correlation):
            best = found
        if best is not None and best.is_certain:
            break
    return best


def velocities(observations: StructArray) -> tuple[Int64Array, FloatArray]:
    """Times (n,) and velocities (n, 3) north, east, down, at least 0.2 s apart; from positions where there are none."""
    rows = observations[observations["kind"] == Kind.VELOCITY]
    rows = _apart(rows[np.isfinite(rows["value"]).all(axis=1)])
    if len(rows) >= FEWEST:
        return rows["time_ns"].astype(np.int64), rows["value"]
    rows = observations[observations["kind"] == Kind.POSITION]
    rows = _apart(rows[np.isfinite(rows["value"]).all(axis=1)])
    if len(rows) < 2:
        return np.zeros(0, np.int64), np.zeros((0, 3))
    moved_e = np.diff(rows["value"], axis=0) / (np.diff(rows["time_ns"]) / SECOND_NS)[:, None]
    lat, lon, _ = geodetic_from_e(rows["value"][1:])
    middle_ns = rows["time_ns"][:-1] + np.diff(rows["time_ns"]) // 2
    return middle_ns, np.einsum("nji,nj->ni", rot_e_from_l(lat, lon), moved_e)


def _apart(rows: StructArray) -> StructArray:
    """Rows at least 0.2 s apart."""
    cell = rows["time_ns"] // (SECOND_NS // 5)
    return rows[np.concatenate([[True], np.diff(cell) > 0])] if len(rows) else rows


def _seen(time_ns: Int64Array, velocity_l: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(n − 1,) specific force m/s² that changes of velocity needed, and turn of the course rad/s; nan where unknown."""
    step_s = np.maximum(np.diff(time_ns) / SECOND_NS, 1e-3)
    needed = np.diff(velocity_l, axis=0) / step_s[:, None] - [0.0, 0.0, G_MPS2]
    course = np.arctan2(velocity_l[:, 1], velocity_l[:, 0])
    turn = ((np.diff(course) + np.pi) % (2.0 * np.pi) - np.pi) / step_s
    slow = np.hypot(velocity_l[:, 0], velocity_l[:, 1]) < SLOW_MPS
    return np.linalg.norm(needed, axis=1), np.where(slow[1:] | slow[:-1], np.nan, turn)


class _Felt:
    """Running sums of what was felt: size of the specific force, turn about the apparent vertical."""

    GRID_NS = 50_000_000

    def __init__(self, inertial: Inertial) -> None:
        first, last = int(inertial.time_ns[0]), int(inertial.time_ns[-1])
        self.first_ns = first
        grid_ns = np.arange(0, last - first, self.GRID_NS)
        self.grid_s = grid_ns / SECOND_NS
        since_ns = inertial.time_ns - first

        def gridded(values: FloatArray) -> FloatArray:
            sums = np.cumsum(values, axis=0)
            at = [np.interp(grid_ns, since_ns, sums[:, axis]) for axis in range(3)]
            return np.diff(np.stack(at, axis=-1), axis=0)

        self.time_sum = np.interp(grid_ns, since_ns, np.cumsum(inertial.interval_s))  # of samples that there are

        force, turn = gridded(inertial.velocity_b), gridded(inertial.angle_b)
        smooth = np.stack([np.convolve(force[:, axis], np.ones(21) / 21, mode="same") for axis in range(3)], axis=-1)
        size = np.linalg.norm(smooth, axis=1, keepdims=True)
        down = -smooth / np.maximum(size, 1e-9)
        self.force_sum = np.append(0.0, np.cumsum(np.linalg.norm(force, axis=1)))
        self.turn_sum = np.append(0.0, np.cumsum((turn * down).sum(axis=1)))

    def covers(self, time_ns: Int64Array) -> NDArray[np.bool_]:
        """(n − 1,) whether an interval lies within the samples."""
        at_s = (time_ns - self.first_ns) / SECOND_NS
        within: NDArray[np.bool_] = (at_s[:-1] >= 0.0) & (at_s[1:] <= self.grid_s[-1])
        return within


def _best(
    time_ns: Int64Array, seen: FloatArray, used: NDArray[np.bool_], felt: _Felt, total: FloatArray, name: str
) -> TimeOffset | None:
    """The shift of the best correlation; None where nothing moves."""
    at_s = (time_ns - felt.first_ns) / SECOND_NS
    begins_s, ends_s, seen = at_s[:-1][used], at_s[1:][used], seen[used]
    if np.std(seen) < 1e-6:
        return None

    def correlations(lates_s: FloatArray) -> FloatArray:
        found = []
        for late in lates_s:
            there = (begins_s - late >= felt.grid_s[0]) & (ends_s - late <= felt.grid_s[-1])
            inside, sampled_s = (
                np.interp(ends_s - late, felt.grid_s, sums) - np.interp(begins_s - late, felt.grid_s, sums)
                for sums in (total, felt.time_sum)
            )
            there &= sampled_s > WHOLE * (ends_s - begins_s)
            mean = (inside / (ends_s - begins_s))[there]
            still = there.sum() < FEWEST or np.std(mean) < 1e-9
            found.append(-1.0 if still else float(np.corrcoef(mean, seen[there])[0, 1]))
        return np.array(found)

    coarse = np.arange(-REACH_S, REACH_S + COARSE_S / 2, COARSE_S)
    middle = coarse[int(np.argmax(correlations(coarse)))]
    fine = np.arange(middle - 2 * COARSE_S, middle + 2 * COARSE_S + FINE_S / 2, FINE_S)
    values = correlations(fine)
    peak = int(np.argmax(values))
    height = float(values[peak])
    spread = 20  # steps of the parabola: 0.1 s to either side
    low, high = max(peak - spread, 0), min(peak + spread, len(fine) - 1)
    bend = -2.0 * float(np.polyfit(fine[low : high + 1] - fine[peak], values[low : high + 1], 2)[0])
    if height <= 0.0 or bend <= 0.0:
        return None
    sigma = float(np.sqrt((1.0 - min(height, 1.0 - 1e-9)) / (height * bend * used.sum())))
    return TimeOffset(float(fine[peak]), max(sigma, FINE_S), height, float(correlations(np.zeros(1))[0]), name)
