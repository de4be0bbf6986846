"""Watches the lines of a flight while it is processed: gathers the facts, and writes ``lines.json``."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from swath.daemon.config.tables import PlanConfig
from swath.daemon.errors import one_line
from swath.daemon.log.mcap.chunks import LogBatch, json_objects
from swath.daemon.processing.flightplan.moments import STEP_NS, Moments, Returns, empty_moments
from swath.daemon.processing.flightplan.plan import FlightPlan, PlanError, PlannedLine
from swath.daemon.processing.flightplan.read import plan_of
from swath.daemon.processing.flightplan.strips import StripWatch
from swath.daemon.processing.flightplan.watch import LineWatch
from swath.daemon.processing.landing.facts import LogFacts
from swath.daemon.processing.landing.flown import FlownTrack
from swath.daemon.processing.live.files import exchange_file
from swath.daemon.processing.live.frame import LocalFrame
from swath.daemon.processing.points.feed import TICK_NS, Placed
from swath.daemon.processing.setup.setup import Setup
from swath.drivers.parser import Parser
from swath.georef.arrays import FloatArray, StructArray
from swath.georef.compiled import jit_cached, jit_inline
from swath.georef.geodesy.earth import geodetic_of
from swath.georef.geodesy.vectors import dot, heading_and_roll, rot_of, vector_at
from swath.georef.points import Points
from swath.georef.records import RETURN_DTYPE, FixType, GnssFix, Record, ScannerReturns
from swath.georef.stream.stream import Stream
from swath.georef.timescales import TimeState
from swath.georef.timescales.gps_time import SECOND_NS
from swath.georef.trajectory.trajectory import Trajectory, locate_epoch, slerp

LINES, STEERING = "lines.json", "steering.json"
VERSION = 1
LOOK_NS = 600_000_000  # of the log's time, between two looks
SAVE_NS = 2 * SECOND_NS  # of the log's time, between two times that the lines are judged and written
FIX_LASTS_NS = 2 * SECOND_NS  # an older position is none
SAMPLE = 400  # points of a scanner and moment by which the swath is measured
EDGE_SHARE = 0.01  # of the points that lie outside the swath's edges
NADIR_TAN = 0.15  # points below the aircraft give its height above ground
FEWEST = 20  # points that determine an edge
FEWEST_BELOW = 5  # points that give a height above ground
MOST_RUNS = 512  # pieces of a block's points that are looked at together
QUALITY = {
    FixType.NONE: 0,
    FixType.DEAD_RECKONING: 0,
    FixType.SINGLE: 1,
    FixType.DIFFERENTIAL: 1,
    FixType.RTK_FLOAT: 2,
    FixType.PPP: 2,
    FixType.RTK_FIXED: 3,
    FixType.MANUAL: 3,
    FixType.SIMULATED: 3,
}
LOST_KEYS = ("lost_kernel", "lost_queue", "lost_write")


class LiveLines:
    """Gathers facts of a session as its feed's watch, and keeps the state of its lines.

    Attributes:
        trouble: why there is no plan although one is configured; empty: there is one, or none is wanted.
        plan: the plan that is used; None: there is none.
        parser: gives a source's parser, for the gaps that it counts; the feed's.
    """

    def __init__(self, setup: Setup, stream: Stream, folder: Path, facts: LogFacts) -> None:
        self.trouble = ""
        self.parser: Callable[[str], Parser] | None = None
        self.watch: LineWatch | StripWatch = StripWatch(setup.config.tables.plan)
        self.plan = plan = self._plan(setup)
        if plan is not None:
            self.watch = LineWatch(plan, setup.config.tables.plan)
        self._notes = () if plan is None else plan.notes
        self._stream, self._mapping, self._folder = stream, setup.mapping, folder
        self._moments, self._facts = Moments(stream.scanners), facts
        self._frame: LocalFrame | None = None
        self._next_ns = self._steered_ns = -(1 << 62)
        self._fixes: dict[str, tuple[FixType, int]] = {}  # by receiver: quality and host time of the newest position
        self._seen: dict[str, list[int]] = {}  # by scanner: returns, and pulses without one, since the last look
        self._ticked: set[str] = set()  # scanners with returns since the last tick
        self._placed: Placed = []  # since the last look
        self._lost = Counter[str]()
        self._lost_before = Counter[str]()
        self._tick_ns = self._saved_ns = self._asked_ns = self._worst = 0
        self._written = b""
        self._steering: dict[str, Any] = {}
        self._steering_ns = -(1 << 62)
        self._plain: dict[str, Any] = {}

    def _plan(self, setup: Setup) -> FlightPlan | None:
        try:
            return plan_of(setup.config, setup.sources.attachments)
        except PlanError as error:
            self.trouble = one_line(f"no flight plan: {error}")
            return None

    # ------------------------------------------------------------------ the feed's watch

    def taker(self, topic: str) -> Callable[[LogBatch], None] | None:
        """Return what takes the operator's marks and the scanners' account."""
        if topic == "/events":
            return self._take_events
        return self._take_status if topic.startswith("/status/scanner/") else None

    def _take_events(self, batch: LogBatch) -> None:
        for time_ns, event in json_objects(batch):
            if event.get("code") == "mark" and isinstance(event.get("text"), str):
                self.watch.overrule(event["text"], time_ns)

    def _take_status(self, batch: LogBatch) -> None:
        for _, status in json_objects(batch):
            values = (status.get(key) for key in LOST_KEYS)
            lost = sum(value for value in values if isinstance(value, int))
            if batch.channel.topic not in self._lost:
                self._lost_before[batch.channel.topic] = lost  # before this program began
            self._lost[batch.channel.topic] = lost

    def record(self, source: str, record: Record) -> None:
        """Take positions of receivers, and the number of returns."""
        if isinstance(record, ScannerReturns):
            name = source.removeprefix("scanner/")
            seen = self._seen.setdefault(name, [0, 0])
            returns = self._facts.flown.returns(name, record.rows)
            seen[0] += returns
            seen[1] += len(record.rows) - returns
            if returns:
                self._ticked.add(name)
        elif isinstance(record, GnssFix) and (record.lat_rad is not None or record.fix_type is FixType.NONE):
            self._facts.fix(source, record)
            fix_type = record.fix_type if record.valid else FixType.NONE
            self._fixes[source] = fix_type, record.host_time_ns

    def tick(self, tick_ns: int | None, placed: Placed) -> None:
        """Take the points of a tick; look at them, and at the poses that became known, three times in two seconds."""
        self._facts.flown.tick(list(self._ticked), TICK_NS / SECOND_NS)
        self._ticked.clear()
        self._placed += placed
        if tick_ns is not None:
            if tick_ns // LOOK_NS == self._tick_ns // LOOK_NS:
                return
            self._tick_ns = tick_ns
        if self.parser is not None:
            for name in self._stream.scanners:
                errors = self.parser(f"scanner/{name}").counters.errors
                self._lost[f"sequence {name}"] = int(errors.get("sequence_gap", 0))
        trajectory = self._stream.path.update()
        if trajectory is None:
            return
        if self._frame is None:
            self._frame = LocalFrame(trajectory.position_e[-1], self._mapping)
        for name, points in self._placed:
            self._take_points(name, points, trajectory, self._frame)
        self._placed.clear()
        rows = self.watch.poses(self._poses(trajectory))
        self._moments.add_poses(rows)
        if len(rows):
            for name, (returns, empty) in self._seen.items():
                self._moments.add_seen(rows["gps_ns"].tolist(), name, returns, empty)
            self._seen.clear()
        settled = self._moments.settled(last=tick_ns is None)
        self._facts.moments(settled)
        self.watch.moments(settled)
        if tick_ns is None:
            self.watch.close()

    # ------------------------------------------------------------------ poses

    def _poses(self, trajectory: Trajectory) -> StructArray:
        """Return the poses (n,) that have become known, ten a second, with the facts of this tick."""
        last_ns = int(trajectory.time_ns[-1])
        first_ns = -(-max(self._next_ns, int(trajectory.time_ns[0])) // STEP_NS) * STEP_NS
        times = np.arange(first_ns, last_ns + 1, STEP_NS, dtype=np.int64)
        rows = empty_moments(len(times))
        rows["gps_ns"] = times
        rows = rows[: _put_poses(trajectory, rows)]
        if not len(rows):
            return rows
        self._next_ns = int(rows["gps_ns"][-1]) + STEP_NS
        times = rows["gps_ns"].copy()
        self._facts.flown.poses(times, trajectory.poses(times))
        if np.isnan(rows["speed_mps"]).any():  # the source gives no velocities: positions do
            _put_poses(trajectory.with_velocities(), rows)
            for name in ("speed_mps", "track_rad"):
                np.nan_to_num(rows[name], copy=False)
        rows["fix"], rows["time"] = self._fix(), self._time()
        rows["lost"][-1] = (self._lost - self._lost_before).total()
        self._lost_before = self._lost.copy()
        return rows

    def _fix(self) -> int:
        """Return the quality of the best receiver's position; -1: no receiver has sent any."""
        if not self._fixes:
            return -1
        found = self._fixes.values()
        return max((QUALITY[fix] for fix, at_ns in found if self._tick_ns - at_ns <= FIX_LASTS_NS), default=0)

    def _time(self) -> int:
        """Return the state of the worst scanner's clock, asked once a second: 0 locked, 1 doubtful, 2 none."""
        if self._tick_ns >= self._asked_ns + SECOND_NS:
            self._asked_ns, self._worst = self._tick_ns, self._worst_clock()
        return self._worst

    def _worst_clock(self) -> int:
        host, worst = self._stream.clocks.host, 0
        for name in self._stream.scanners:
            device = host.plan.devices.get(f"scanner/{name}")
            if device is None:
                continue
            state = host.status(device.clock, self._tick_ns).state
            if state in (TimeState.NO_TIME, TimeState.LOST):
                worst = 2
            elif state is TimeState.HOLDOVER or (state is TimeState.COARSE and device.clock.startswith("pps/")):
                worst = max(worst, 1)
        return worst

    # ------------------------------------------------------------------ points

    def _take_points(self, name: str, points: Points, trajectory: Trajectory, frame: LocalFrame) -> None:
        """Count a scanner's first returns, and measure its swath, by moments."""
        runs = np.empty((MOST_RUNS, 4), np.int64)
        done = 0
        while done < len(points):
            count, done = _find_runs(points.time_ns, points.return_number, done, runs)
            longest: dict[int, tuple[int, int]] = {}
            for key, start, end, first in runs[:count].tolist():
                if key * STEP_NS < self._next_ns - 60 * SECOND_NS:
                    continue
                self._moments.returns_at(key * STEP_NS, name).first += first
                if end - start >= max(FEWEST, 1 + longest.get(key, (0, 0))[0]):
                    longest[key] = end - start, start
            ways = _ways(list(longest), trajectory, frame)
            for key, (size, start) in longest.items():
                if key in ways:
                    xyz = frame.of_points(points.points_map[start : start + size : max(1, size // SAMPLE)])
                    self._measure(self._moments.returns_at(key * STEP_NS, name), xyz, ways[key])

    @staticmethod
    def _measure(found: Returns, xyz: FloatArray, way: FloatArray) -> None:
        """Measure the swath's edges across track, and the height above ground, by points of a moment."""
        left, right, above = _swath_of(xyz, way)
        if math.isnan(left):
            return
        found.left_m = left if math.isnan(found.left_m) else min(left, found.left_m)
        found.right_m = right if math.isnan(found.right_m) else max(right, found.right_m)
        if not math.isnan(above):
            found.above_m = above

    # ------------------------------------------------------------------ result

    def plain_status(self) -> dict[str, Any]:
        """Return the lines in short for ``live.json``, as they were when ``lines.json`` was last written."""
        plain = self._plain or self.watch.plain()
        states = Counter(line["state"] for line in plain["lines"])
        again = [line["name"] for line in plain["lines"] if line["state"] == "again"]
        lines = {key: plain[key] for key in ("plan", "current", "next")}
        lines |= {"states": dict(states), "fly_again": again, "trouble": self.trouble}
        return {"lines": lines}

    def save(self, log_time_ns: int, *, last: bool = False) -> None:
        """Write ``steering.json`` at each look, and ``lines.json`` every other second of log time.

        The latter is also written when another line is flown; neither if nothing changed.

        Raises:
            OSError: they cannot be written.
        """
        is_due = last or log_time_ns >= self._saved_ns + SAVE_NS
        if self._steered_ns != self._next_ns or last:
            self._steered_ns = self._next_ns
            steering = self.watch.plain_steering()
            is_due |= steering["current"] != self._steering.get("current")
            self._save_steering(steering, last=last)
        if is_due:
            self._saved_ns = log_time_ns
            self._plain = self.watch.plain()
            found = {"version": VERSION, "trouble": self.trouble, "notes": list(self._notes)} | self._plain
            data = (json.dumps(found | {"geometry": self.watch.plain_geometry()}) + "\n").encode()
            if data != self._written:
                exchange_file(self._folder, LINES, data)
                self._written = data

    def _save_steering(self, steering: dict[str, Any], *, last: bool) -> None:
        """Write how to steer by the newest pose, for the pilot's page: on a line each time, else once a second."""
        is_near = steering["current"] is not None or steering["current"] != self._steering.get("current")
        if not is_near and not last and (steering == self._steering or self._next_ns < self._steering_ns + SECOND_NS):
            return
        self._steering, self._steering_ns = steering, self._next_ns
        found = {"version": VERSION, "gps_ns": self._next_ns - STEP_NS} | steering
        exchange_file(self._folder, STEERING, (json.dumps(found) + "\n").encode())


def _ways(keys: list[int], trajectory: Trajectory, frame: LocalFrame) -> dict[int, FloatArray]:
    """Return by moment where the aircraft was at its beginning and end, (2, 3); only where that is known."""
    first_ns, last_ns = trajectory.span
    times = np.array([(max(first_ns, key * STEP_NS), min(last_ns, (key + 1) * STEP_NS)) for key in keys], np.int64)
    if not len(times):
        return {}
    places_e = np.empty((*times.shape, 3))
    _fill_places(trajectory.time_ns, trajectory.max_gap_ns, trajectory.position_e, times, places_e)
    known = np.flatnonzero(np.isfinite(places_e).all(axis=(1, 2)) & (times[:, 0] < times[:, 1]))
    places = frame.of_e(places_e[known].reshape(-1, 3)).reshape(-1, 2, 3)
    return {keys[place]: way for place, way in zip(known.tolist(), places, strict=True)}


# ---------------------------------------------------------------------------------------------- compiled loops


def warm_up_lines(points: Points, trajectory: Trajectory, frame: LocalFrame) -> None:
    """Run every loop of the lines once, on points and poses that do not matter."""
    rows = empty_moments(2)
    rows["gps_ns"] = trajectory.time_ns[:2]
    _put_poses(trajectory, rows)
    lat, lon = np.degrees([rows["lat_rad"][0], rows["lon_rad"][0]])
    height_m = np.full(2, math.nan)
    line = PlannedLine("warm-up", np.array([lat - 0.01, lat + 0.01]), np.array([lon, lon]), height_m, height_m)
    watch = LineWatch(FlightPlan("warm-up", (line,)), PlanConfig())
    rows["speed_mps"] = 50.0
    for track_rad in (1.5, 0.0):  # first across the line, then on it
        rows["track_rad"] = track_rad
        watch.poses(rows)
    for way in _ways([int(trajectory.time_ns[0]) // STEP_NS], trajectory, frame).values():
        _swath_of(frame.of_points(points.points_map[:10]), way)
    _find_runs(points.time_ns, points.return_number, 0, np.empty((1, 4), np.int64))
    FlownTrack().returns("line", np.zeros(1, RETURN_DTYPE))


def _put_poses(trajectory: Trajectory, rows: StructArray) -> int:
    """Do what `_fill_poses` does, with a trajectory."""
    return _fill_poses(
        trajectory.time_ns,
        trajectory.max_gap_ns,
        trajectory.position_e,
        trajectory.q_e_from_b,
        trajectory.rotvec_b,
        trajectory.velocity_e,
        rows,
    )


@jit_inline
def _epoch_of(time_ns: Any, max_gap_ns: int, t: int, guess: int) -> int:
    """Return the epoch before a time; −1: it lies outside, or in a gap."""
    at = locate_epoch(time_ns, t, guess)
    return -1 if at < 0 or time_ns[at + 1] - time_ns[at] > max_gap_ns else at


@jit_cached
def _fill_poses(
    time_ns: Any, max_gap_ns: int, position_e: Any, q_e_from_b: Any, rotvec_b: Any, velocity_e: Any, rows: Any
) -> int:
    """Fill moments (n,) with the poses at their times; return how many have one: they are moved to the front."""
    count = at = 0
    for i in range(len(rows)):
        t = rows[i].gps_ns
        at = _epoch_of(time_ns, max_gap_ns, t, at)
        if at < 0:
            continue
        share = (t - time_ns[at]) / (time_ns[at + 1] - time_ns[at])
        x, y, z = vector_at(position_e, at)
        x += share * (position_e[at + 1, 0] - x)
        y += share * (position_e[at + 1, 1] - y)
        z += share * (position_e[at + 1, 2] - z)
        lat, lon, height = geodetic_of(x, y, z)
        north = -math.sin(lat) * math.cos(lon), -math.sin(lat) * math.sin(lon), math.cos(lat)
        east = -math.sin(lon), math.cos(lon), 0.0
        u, v, w = vector_at(velocity_e, at)
        u += share * (velocity_e[at + 1, 0] - u)
        v += share * (velocity_e[at + 1, 1] - v)
        w += share * (velocity_e[at + 1, 2] - w)
        to_north, to_east = dot(north, (u, v, w)), dot(east, (u, v, w))
        q, turn = q_e_from_b[at], rotvec_b[at]
        rot = rot_of(*slerp(q[0], q[1], q[2], q[3], turn[0], turn[1], turn[2], share))
        _, roll = heading_and_roll(lat, lon, rot)
        row = rows[count]
        row.gps_ns, row.lat_rad, row.lon_rad, row.height_m = t, lat, lon, height
        row.speed_mps, row.track_rad = math.hypot(to_north, to_east), math.atan2(to_east, to_north)
        row.roll_rad = roll
        count += 1
    return count


@jit_cached
def _fill_places(time_ns: Any, max_gap_ns: int, position_e: Any, times: Any, places_e: Any) -> None:
    """Fill ``places_e`` (n, 2, 3) with the positions at times (n, 2); nan: not known."""
    at = 0
    for i in range(len(times)):
        for end in range(2):
            at = _epoch_of(time_ns, max_gap_ns, times[i, end], at)
            if at < 0:
                places_e[i, end] = math.nan
                continue
            share = (times[i, end] - time_ns[at]) / (time_ns[at + 1] - time_ns[at])
            places_e[i, end] = position_e[at] + share * (position_e[at + 1] - position_e[at])


@jit_cached
def _find_runs(time_ns: Any, return_number: Any, first: int, runs: Any) -> tuple[int, int]:
    """Find runs of points within one moment, from ``first`` on; fill rows of moment, begin, end, first returns.

    Returns:
        Number of runs, and how far it came: less than all if there was no room.
    """
    count = -1
    begin_ns = end_ns = np.int64(0)
    for i in range(first, len(time_ns)):
        t = time_ns[i]
        if t < begin_ns or t >= end_ns or count < 0:
            count += 1
            if count == len(runs):
                return count, i
            key = t // STEP_NS
            begin_ns, end_ns = key * STEP_NS, (key + 1) * STEP_NS
            runs[count, 0], runs[count, 1], runs[count, 3] = key, i, 0
        runs[count, 2] = i + 1
        if return_number[i] <= 1:
            runs[count, 3] += 1
    return count + 1, len(time_ns)


@jit_cached
def _swath_of(xyz: Any, way: Any) -> tuple[float, float, float]:
    """Return the left and the right edge of points (n, 3), and the height above ground; nan: not known.

    ``way`` (2, 3) is where the aircraft was at the beginning and at the end.
    """
    along_x, along_y = way[1, 0] - way[0, 0], way[1, 1] - way[0, 1]
    length = math.hypot(along_x, along_y)
    if length < 0.01:
        return math.nan, math.nan, math.nan
    middle = (way[0] + way[1]) / 2.0
    across, below = np.empty(len(xyz)), np.empty(len(xyz))
    near = 0
    for i in range(len(xyz)):
        across[i] = ((xyz[i, 0] - middle[0]) * along_y - (xyz[i, 1] - middle[1]) * along_x) / length
        down = middle[2] - xyz[i, 2]
        if abs(across[i]) <= NADIR_TAN * abs(down):
            below[near] = down
            near += 1
    across.sort()
    skip = int(EDGE_SHARE * len(across))
    above = np.median(below[:near]) if near >= FEWEST_BELOW else math.nan
    return across[skip], across[len(across) - 1 - skip], above
