"""Places pulses that gave no return, as over water, where they would have met the ground.

A pulse's direction is known by its time and encoder as that of any other. Its range is not: the level is taken from
the scanner's returns before and after it, and the ray is followed down to that.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import minimum_filter1d

from swath.daemon.processing.live.frame import LocalFrame
from swath.daemon.processing.points.discarded import without_gate
from swath.georef.arrays import FloatArray, Int64Array, StructArray
from swath.georef.georeference import Georeferencer
from swath.georef.mapping.frame import MappingError
from swath.georef.points import Fate, Points
from swath.georef.stream.stream import CONTEXT_FLAG
from swath.georef.timescales.gps_time import SECOND_NS
from swath.georef.trajectory.trajectory import Trajectory

NEAR_M, FAR_M = 100.0, 1000.0  # ranges of the two points that give a ray
LEVEL_POINTS = 15  # the lowest of so many returns is taken for the ground, between trees and roofs
REACH_BLOCKS = 50  # blocks of points, ten seconds of ticks, whose ranges tell how far the scanner sees
REACH_STEP, REACH_SHARE = 16, 0.995  # of the ranges: every so many, and the quantile that is the reach
REACH_MARGIN = 1.05  # a pulse without a return may have gone so many times as far
LONGEST_NS = 5 * SECOND_NS  # without points: pulses get the last level known
MOST_WAITING = 2_000_000  # pulses; beyond that the oldest are left out
STEEPEST = math.cos(math.radians(80.0))  # a ray nearer to level meets the ground nowhere in particular


@dataclass(frozen=True, slots=True)
class _Rays:
    """Rays of pulses: GPS times (n,), and places (n, 3) at `NEAR_M` and `FAR_M`, in the points' coordinates."""

    time_ns: Int64Array
    near: FloatArray
    far: FloatArray

    def take(self, which: slice) -> _Rays:
        """Return some of them."""
        return _Rays(self.time_ns[which], self.near[which], self.far[which])


def _levels(at_ns: Int64Array, time_ns: Int64Array, up_m: FloatArray) -> FloatArray:
    """Return the ground's level (n,) at times, between the lowest of the points before each and of those after it."""
    before = minimum_filter1d(up_m, LEVEL_POINTS, mode="nearest", origin=(LEVEL_POINTS - 1) // 2)
    after = minimum_filter1d(up_m, LEVEL_POINTS, mode="nearest", origin=-((LEVEL_POINTS - 1) // 2))
    later = np.searchsorted(time_ns, at_ns, side="right")
    earlier, later = np.maximum(later - 1, 0), np.minimum(later, len(time_ns) - 1)
    span_ns = np.maximum(time_ns[later] - time_ns[earlier], 1)
    share = np.clip((at_ns - time_ns[earlier]) / span_ns, 0.0, 1.0)
    return np.asarray((1.0 - share) * before[earlier] + share * after[later])


class _Still:
    """Takes the encoder as standing still: its latency and torsion move a pulse by less than a cell."""

    def motion(self, rows: StructArray, time_ns: Int64Array) -> tuple[FloatArray, FloatArray]:
        """Return rates and accelerations (n,), rad/s and rad/s²."""
        return np.zeros(len(rows)), np.zeros(len(time_ns))


class UnansweredPulses:
    """One scanner's pulses without a return.

    Attributes:
        left_out: number of pulses without a place: too many waited, or no point had told the ground's level.
    """

    def __init__(self, georeferencer: Georeferencer) -> None:
        """Begin; the georeferencer is the scanner's own."""
        self.left_out = 0
        self._georeferencer = without_gate(georeferencer)
        self._georeferencer.encoder_motion = _Still()
        self._waiting: deque[_Rays] = deque()
        self._count = 0
        self._reach: deque[float] = deque(maxlen=REACH_BLOCKS)
        self._time_ns: Int64Array = np.empty(0, np.int64)  # of the last points, with their heights
        self._up_m: FloatArray = np.empty(0)

    def take_pulses(self, rows: StructArray, time_ns: Int64Array, trajectory: Trajectory) -> None:
        """Take pulses in the order of time; `places` gives them back when the points around them are known."""
        rows = rows.copy()
        rows["flags"] &= ~np.uint8(CONTEXT_FLAG)
        rows["number_of_returns"] = rows["return_number"] = 1
        found = []
        for range_m in (NEAR_M, FAR_M):
            rows["range_m"] = range_m
            try:
                points, fates = self._georeferencer.georeference(rows, time_ns, trajectory)
            except MappingError:  # the map has no place for any of them
                return
            placed = np.zeros((len(rows), 3))
            placed[fates == Fate.GEOREFERENCED] = points.points_map
            found.append((placed, fates == Fate.GEOREFERENCED, points.time_ns))
        (near, is_near, times_ns), (far, is_far, _) = found
        both = is_near & is_far
        if not both.any():
            return
        times_ns = times_ns[both[is_near]]
        order = np.argsort(times_ns, kind="stable")
        self._waiting.append(_Rays(times_ns[order], near[both][order], far[both][order]))
        self._count += len(order)
        while self._count > MOST_WAITING:
            self._leave_out()

    def _leave_out(self) -> None:
        oldest = len(self._waiting.popleft().time_ns)
        self._count -= oldest
        self.left_out += oldest

    def places(self, points: Points, frame: LocalFrame) -> FloatArray:
        """Return places (n, 3) in the frame ``local`` of pulses up to the newest of a block of points."""
        self._reach.append(float(np.quantile(points.range_m[::REACH_STEP], REACH_SHARE)))
        newest_ns = int(points.time_ns.max())
        rays = self._ready(newest_ns)
        of_use = points if rays else points.take(slice(-LEVEL_POINTS, None))
        order = np.argsort(of_use.time_ns, kind="stable")
        time_ns = np.concatenate([self._time_ns, of_use.time_ns[order]])
        up_m = np.concatenate([self._up_m, frame.of_points(of_use.points_map[order])[:, 2]])
        self._time_ns, self._up_m = time_ns[-LEVEL_POINTS:], up_m[-LEVEL_POINTS:]
        if not rays:
            return np.empty((0, 3))
        return self._meet(rays, _levels(np.concatenate([one.time_ns for one in rays]), time_ns, up_m), frame)

    def overdue(self, now_ns: int, frame: LocalFrame) -> FloatArray:
        """Return places of pulses after which no point has come for `LONGEST_NS`, at the last level known."""
        if not self._waiting or now_ns - int(self._waiting[0].time_ns[0]) < LONGEST_NS:
            return np.empty((0, 3))
        rays = self._ready(now_ns - LONGEST_NS // 2)
        count = sum(len(one.time_ns) for one in rays)
        if not len(self._up_m):
            self.left_out += count
            return np.empty((0, 3))
        return self._meet(rays, np.full(count, self._up_m.min()), frame)

    def _ready(self, newest_ns: int) -> list[_Rays]:
        """Remove the rays up to a time, and return them."""
        ready = []
        while self._waiting and int(self._waiting[0].time_ns[0]) <= newest_ns:
            first = self._waiting.popleft()
            count = int(np.searchsorted(first.time_ns, newest_ns, side="right"))
            ready.append(first.take(slice(count)))
            self._count -= count
            if count < len(first.time_ns):
                self._waiting.appendleft(first.take(slice(count, None)))
                break
        return ready

    def _meet(self, rays: list[_Rays], level_m: FloatArray, frame: LocalFrame) -> FloatArray:
        """Return where rays meet levels; those that do not, or beyond the scanner's reach, are left out."""
        near = frame.of_points(np.concatenate([one.near for one in rays]))
        away = frame.of_points(np.concatenate([one.far for one in rays])) - near
        down = -away[:, 2]
        steep = down > STEEPEST * (FAR_M - NEAR_M)
        share = np.where(steep, (near[:, 2] - level_m) / np.where(steep, down, 1.0), -1.0)
        range_m = NEAR_M + share * (FAR_M - NEAR_M)
        meets = steep & (range_m > 0.0) & (range_m < REACH_MARGIN * max(self._reach, default=0.0))
        return near[meets] + share[meets, np.newaxis] * away[meets]
