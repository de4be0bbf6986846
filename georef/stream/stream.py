"""Streaming georeferencing: records in the order of the log in, points out as soon as the trajectory covers them.

Records are only collected when they come. `Stream.advance` makes all decisions (a clock's answer, whether a return is
placed, waits or is given up), at ticks of the log's own time. Therefore the same log gives the same points whatever the
division of its records, and whether or not it was still being written.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np

from swath.georef.arrays import BoolArray, ByteArray, FloatArray, Int64Array, StructArray
from swath.georef.points import FATE_NAMES, Fate, Points
from swath.georef.records import RETURN_DTYPE
from swath.georef.return_rows import WaitingReturns, after, any_has, compact, concatenate, split_at, take
from swath.georef.stream.clocks import StreamClocks
from swath.georef.stream.path import CompletePath, GrowingPath, Path
from swath.georef.timescales.gps_time import SECOND_NS

if TYPE_CHECKING:
    from swath.georef.trajectory.trajectory import Trajectory

__all__ = ["CompletePath", "GrowingPath", "Path", "ScannerChain", "Stream", "StreamSettings"]

CONTEXT_FLAG = 128  # of a return's flags: it serves only as a neighbour and gives no point itself
FATES_BY_NAME = {name: fate for fate, name in FATE_NAMES.items()}
NO_ROWS, NO_TIMES = np.empty(0, RETURN_DTYPE), np.empty(0, np.int64)
ZONE_UNKNOWN = 255  # of a return's MTA zone


@dataclass(frozen=True, slots=True)
class StreamSettings:
    """Waiting times, in seconds of the log's time, and limits of the amount that waits.

    Attributes:
        trajectory_wait_s: time for which a placed return waits for the trajectory to cover it.
        time_wait_s: time for which a return waits for an accurate time, as before the clocks are locked.
        settle_s: time for which a return is held before it gets its time, so that the clocks' later input counts too;
            0: no delay.
        max_time_sigma_ns: greatest sigma of a usable time. A free-running device is known by the arrival of its
            packets, 2 ms.
        max_rows: greatest number of a scanner's rows that wait for time, and of those that wait for the trajectory; the
            oldest are given up.
    """

    trajectory_wait_s: float = 2.0
    time_wait_s: float = 5.0
    settle_s: float = 0.0
    max_time_sigma_ns: float = 1e6
    max_rows: int = 4_000_000


class Georeferences(Protocol):
    """A maker of points from a scanner's returns: `swath.georef.georeference.Georeferencer`."""

    def georeference(self, rows: StructArray, time_ns: Int64Array, trajectory: Trajectory) -> tuple[Points, ByteArray]:
        """Return points, and the fate of every row."""


class Resolver(Protocol):
    """Finds emissions of returns with pulses in air; may hold some back (`swath.georef.scanner.ranging`)."""

    counts: Counter[str]

    @property
    def waiting(self) -> int:
        """The number of returns held back."""

    def feed(self, rows: StructArray, predicted_m: FloatArray | None = None) -> StructArray:
        """Take rows, and return those that are complete now, in the order of emission."""

    def flush(self) -> StructArray:
        """Return the rows held back, when no more will come."""


Moving = tuple[StructArray, Int64Array, FloatArray, FloatArray]


class Motion(Protocol):
    """Finds the encoder's rate and acceleration from neighbouring readings (`swath.georef.scanner.encoder_motion`)."""

    def feed(self, rows: StructArray, time_ns: Int64Array) -> Moving:
        """Take rows, and return those whose neighbourhood is complete now, their GPS times, rad/s, rad/s²."""

    def flush(self) -> Moving:
        """Return the rows held back, when no more will come."""


class GivenMotion:
    """Holds the encoder's motion of the present rows for a `swath.georef.georeference.Georeferencer`."""

    def __init__(self) -> None:
        self.rate = self.acceleration = np.empty(0)

    def motion(self, rows: StructArray, time_ns: Int64Array) -> tuple[FloatArray, FloatArray]:
        """Return the motion (n,), rad/s and rad/s², of the rows that are georeferenced now."""
        del rows, time_ns
        return self.rate, self.acceleration

    def keep(self, which: BoolArray) -> None:
        """Keep the motion of the masked rows, the only ones to be georeferenced next."""
        self.rate, self.acceleration = self.rate[which], self.acceleration[which]


Predict = Callable[[StructArray, Int64Array, "Trajectory"], FloatArray]
Unanswered = Callable[[StructArray, Int64Array, "Trajectory"], None]
LeftOut = Callable[[StructArray, Int64Array, ByteArray, "Trajectory | None"], None]


@dataclass(slots=True)
class ScannerChain:
    """The processing steps of a scanner's returns.

    Attributes:
        name: of the configuration.
        georeferencer: makes points.
        resolver: finds emissions if a return's zone is unknown; None: all are known.
        predict: (n,) ranges that a terrain model predicts for rows at GPS times; None: no model.
        reach_ns: time after its stamp at which a return may need the trajectory.
        motion: computes the encoder's motion if the calibration needs it; holds back rows with incomplete
            neighbourhoods.
        given: passes that motion to the georeferencer; goes with ``motion``.
        left_out: takes the returns without a point: rows, GPS times (-1: unknown), fates, and the trajectory if one was
            used. Returns that the resolver drops are only counted.
        unanswered: takes pulses without a return whose range would not have been apparent: rows, GPS times, trajectory.
            Points and the encoder's motion are what they are without these.
    """

    name: str
    georeferencer: Georeferences
    resolver: Resolver | None = None
    predict: Predict | None = None
    reach_ns: int = 0
    motion: Motion | None = None
    given: GivenMotion | None = None
    left_out: LeftOut | None = None
    unanswered: Unanswered | None = None


class _Lane:
    """One scanner's returns in processing."""

    def __init__(self, chain: ScannerChain, settings: StreamSettings) -> None:
        self.chain = chain
        self.new: list[StructArray] = []
        self.fates: Int64Array = np.zeros(len(Fate), np.int64)
        self._settings = settings
        self._untimed: deque[WaitingReturns] = deque()
        self._timed: deque[WaitingReturns] = deque()
        self._resolves = False  # whether a return of unknown zone has come
        self._held_back = 0  # number of returns held back by resolver and motion

    @property
    def waiting(self) -> int:
        """The number of returns without a fate yet."""
        return sum(len(held.rows) for queue in (self._untimed, self._timed) for held in queue) + self._held_back

    def advance(self, tick_ns: int, clocks: StreamClocks, path: Path, *, last: bool) -> Points | None:
        """Process what is ready; ``last``: no more will come."""
        self._take(tick_ns)
        self._place(tick_ns, clocks, last=last)
        trajectory, covered_ns = path.update(), path.covered_until_ns
        if trajectory is None or covered_ns is None:
            self._give_up_unseen(tick_ns, last=last)
            return None
        ready = self._covered(tick_ns, covered_ns, last=last)
        rows = concatenate([held.rows for held in ready], NO_ROWS)
        time_ns = concatenate([held.time_ns for held in ready], NO_TIMES)
        if self.chain.resolver is not None:
            rows, time_ns = self._resolved(self.chain.resolver, rows, time_ns, trajectory, clocks, last=last)
        return self._points(rows, time_ns, trajectory, last=last)

    def _take(self, tick_ns: int) -> None:
        pieces, self.new = [rows for rows in self.new if len(rows)], []
        if pieces:
            self._untimed.append(WaitingReturns(compact(concatenate(pieces, NO_ROWS)), tick_ns, NO_TIMES))
        for held in after(self._untimed, self._settings.max_rows):
            self._give_up(held.rows, Fate.NO_TIME)

    def _place(self, tick_ns: int, clocks: StreamClocks, *, last: bool) -> None:
        """Give GPS times to new and still waiting returns; count those that will never have one."""
        waiting, self._untimed = self._untimed, deque()
        worth_asking = self._is_worth_asking(waiting, tick_ns, clocks)
        for held in waiting:
            waited_s = (tick_ns - held.since_ns) / SECOND_NS
            if waited_s < self._settings.settle_s and not last:
                self._untimed.append(held)
                continue
            overdue = last or waited_s >= self._settings.settle_s + self._settings.time_wait_s
            if self._was_asked(held, tick_ns) and not overdue and not worth_asking:
                self._untimed.append(held)
                continue
            good, time_ns = self._times(held.rows, clocks)
            timed, rest = split_at(WaitingReturns(held.rows, tick_ns, time_ns), good)
            self._timed += timed
            for untimed in rest:
                if overdue:
                    self._give_up(untimed.rows, Fate.NO_TIME)
                else:
                    self._untimed.append(WaitingReturns(untimed.rows, held.since_ns, held.time_ns))
        for held in after(self._timed, self._settings.max_rows):
            self._give_up(held.rows, Fate.OUTSIDE_TRAJECTORY, held.time_ns)

    def _times(self, rows: StructArray, clocks: StreamClocks) -> tuple[BoolArray, Int64Array]:
        return clocks.place(f"scanner/{self.chain.name}", rows, self._settings.max_time_sigma_ns)

    def _was_asked(self, held: WaitingReturns, tick_ns: int) -> bool:
        return (tick_ns - held.since_ns) / SECOND_NS > self._settings.settle_s

    def _is_worth_asking(self, waiting: deque[WaitingReturns], tick_ns: int, clocks: StreamClocks) -> bool:
        """Return whether the first or the last return that got no time has one now, so that all should be tried."""
        asked = [held for held in waiting if self._was_asked(held, tick_ns)]
        if not asked:
            return False
        ends = np.concatenate([asked[0].rows[:1], asked[-1].rows[-1:]])
        return bool(self._times(ends, clocks)[0].any())

    def _is_overdue(self, held: WaitingReturns, tick_ns: int) -> bool:
        return (tick_ns - held.since_ns) / SECOND_NS >= self._settings.trajectory_wait_s

    def _give_up_unseen(self, tick_ns: int, *, last: bool) -> None:
        """Give up overdue returns while no trajectory exists."""
        while self._timed and (last or self._is_overdue(self._timed[0], tick_ns)):
            held = self._timed.popleft()
            self._give_up(held.rows, Fate.OUTSIDE_TRAJECTORY, held.time_ns)

    def _covered(self, tick_ns: int, covered_ns: int, *, last: bool) -> list[WaitingReturns]:
        """Remove from the queue the returns that the trajectory covers, and overdue ones, and return them."""
        ready: list[WaitingReturns] = []
        waiting, self._timed = self._timed, deque()
        for held in waiting:
            if last or self._is_overdue(held, tick_ns):
                ready.append(held)
                continue
            covered, rest = split_at(held, held.time_ns <= covered_ns - self.chain.reach_ns)
            ready += covered
            self._timed += rest
        return ready

    def _resolved(
        self,
        resolver: Resolver,
        rows: StructArray,
        time_ns: Int64Array,
        trajectory: Trajectory,
        clocks: StreamClocks,
        *,
        last: bool,
    ) -> tuple[StructArray, Int64Array]:
        """Return rows with the times of their emissions, as far as these are known now."""
        self._resolves = self._resolves or any_has(rows, "mta_zone", ZONE_UNKNOWN)
        if not self._resolves:
            return rows, time_ns
        answered = (rows["number_of_returns"] > 0) | (rows["mta_zone"] == ZONE_UNKNOWN)
        if not answered.all():  # no emission of an echo that is looked for
            rows, time_ns = take(rows, answered), time_ns[answered]
        held = resolver.waiting
        predict = self.chain.predict
        given = (
            [resolver.feed(rows, None if predict is None else predict(rows, time_ns, trajectory))] if len(rows) else []
        )
        given += [resolver.flush()] if last else []
        known = concatenate(given, rows)
        self._held_back += resolver.waiting - held
        good, emitted_ns = self._times(known, clocks)
        if good.all():
            return known, emitted_ns
        self._give_up(known[~good], Fate.NO_TIME)
        return take(known, good), emitted_ns[good]

    def _points(self, rows: StructArray, time_ns: Int64Array, trajectory: Trajectory, *, last: bool) -> Points | None:
        chain = self.chain
        if chain.unanswered is not None and any_has(rows, "flags", CONTEXT_FLAG):
            alone = rows["number_of_returns"] == 0
            if alone.any():
                chain.unanswered(take(rows, alone), time_ns[alone], trajectory)
                rows, time_ns = take(rows, ~alone), time_ns[~alone]
        if chain.motion is not None and chain.given is not None:
            rows, time_ns, chain.given.rate, chain.given.acceleration = self._moving(
                chain.motion, rows, time_ns, last=last
            )
        if any_has(rows, "flags", CONTEXT_FLAG):
            own = rows["flags"] & CONTEXT_FLAG == 0
            rows, time_ns = take(rows, own), time_ns[own]
            if chain.given is not None:
                chain.given.keep(own)
        if not len(rows):
            return None
        points, fates = chain.georeferencer.georeference(rows, time_ns, trajectory)
        self.fates += np.bincount(fates, minlength=len(self.fates))
        if chain.left_out is not None and fates.any():
            lost = fates != Fate.GEOREFERENCED
            if chain.given is not None:
                chain.given.keep(lost)
            chain.left_out(take(rows, lost), time_ns[lost], fates[lost], trajectory)
        return points if len(points) else None

    def _moving(self, motion: Motion, rows: StructArray, time_ns: Int64Array, *, last: bool) -> Moving:
        """Return rows with the encoder's motion, as far as it is known now."""
        moving = motion.feed(rows, time_ns)
        if last:
            (one, at_ns, rate, acceleration), rest = moving, motion.flush()
            moving = (
                concatenate([one, rest[0]], NO_ROWS),
                concatenate([at_ns, rest[1]], NO_TIMES),
                np.concatenate([rate, rest[2]]),
                np.concatenate([acceleration, rest[3]]),
            )
        self._held_back += len(rows) - len(moving[0])
        return moving

    def _give_up(self, rows: StructArray, fate: Fate, time_ns: Int64Array | None = None) -> None:
        """Count returns without a point, except those of the margin; pulses without a return do not count."""
        own = (rows["flags"] & CONTEXT_FLAG == 0) & (rows["number_of_returns"] > 0)
        count = int(np.count_nonzero(own))
        self.fates[fate] += count
        if self.chain.left_out is not None and count:
            times = np.full(count, -1) if time_ns is None else time_ns[own]
            self.chain.left_out(take(rows, own), times, np.full(count, fate, np.uint8), None)


class Stream:
    """Takes records by source, and returns (scanner's name, points) at ticks, in order of names and of arrival.

    Attributes:
        clocks: fed by the reader of the log: readings, edges, messages, devices' samples.
        path: fed likewise with a device's INS solutions.
    """

    def __init__(
        self,
        chains: Mapping[str, ScannerChain],
        clocks: StreamClocks,
        path: Path,
        settings: StreamSettings | None = None,
    ) -> None:
        self.clocks = clocks
        self.path = path
        self._lanes = {name: _Lane(chains[name], settings or StreamSettings()) for name in sorted(chains)}
        self._tick_ns = 0

    def chain(self, name: str) -> ScannerChain:
        """Return the processing steps of a scanner's returns."""
        return self._lanes[name].chain

    @property
    def scanners(self) -> list[str]:
        """The names, in the order in which points come."""
        return list(self._lanes)

    def add_returns(self, name: str, rows: StructArray) -> None:
        """Take returns of a scanner in its parser's order; those with `CONTEXT_FLAG` give no point."""
        self._lanes[name].new.append(rows)

    def advance(self, tick_ns: int) -> list[tuple[str, Points]]:
        """Decide on all input so far, at a time of the log that never goes back."""
        self._tick_ns = tick_ns
        return self._advance(last=False)

    def close(self) -> list[tuple[str, Points]]:
        """End the stream: georeference or give up all waiting returns."""
        return self._advance(last=True)

    def _advance(self, *, last: bool) -> list[tuple[str, Points]]:
        self.clocks.update()
        given = []
        for name, lane in self._lanes.items():
            points = lane.advance(self._tick_ns, self.clocks, self.path, last=last)
            if points is not None:
                given.append((name, points))
        return given

    def waiting(self, name: str) -> int:
        """Return the number of a scanner's returns whose fate is open."""
        lane = self._lanes[name]
        return lane.waiting + sum(len(rows) for rows in lane.new)

    def fates(self, name: str) -> dict[Fate, int]:
        """Return counts of a scanner's returns so far by fate; those without a fate yet are `waiting`."""
        lane = self._lanes[name]
        counts = {fate: int(lane.fates[fate]) for fate in Fate}
        if lane.chain.resolver is not None:
            for reason, count in lane.chain.resolver.counts.items():
                counts[FATES_BY_NAME[reason]] += count
        return {fate: count for fate, count in counts.items() if count}
