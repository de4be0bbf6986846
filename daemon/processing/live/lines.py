"""Watches the lines of a flight while it is processed: gathers the facts, and writes ``lines.json``."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from swath.daemon.errors import one_line
from swath.daemon.log.mcap.chunks import LogBatch, json_objects
from swath.daemon.processing.flightplan.moments import STEP_NS, Moments, Returns, empty_moments
from swath.daemon.processing.flightplan.plan import FlightPlan, PlanError
from swath.daemon.processing.flightplan.read import plan_of
from swath.daemon.processing.flightplan.strips import StripWatch
from swath.daemon.processing.flightplan.watch import LineWatch
from swath.daemon.processing.landing.facts import LogFacts
from swath.daemon.processing.live.frame import LocalFrame
from swath.daemon.processing.live.tiles import replace_file
from swath.daemon.processing.points.feed import TICK_NS, Placed
from swath.daemon.processing.setup.setup import Setup
from swath.drivers.parser import Parser
from swath.georef.arrays import FloatArray, StructArray
from swath.georef.geodesy.earth import geodetic_from_e, rot_e_from_l
from swath.georef.geodesy.rotations import attitude_of, rot_from_quaternion
from swath.georef.points import Points
from swath.georef.records import FixType, GnssFix, Record, ScannerReturns
from swath.georef.stream.stream import Stream
from swath.georef.timescales import TimeState
from swath.georef.timescales.gps_time import SECOND_NS
from swath.georef.trajectory.trajectory import Trajectory, TrajectoryGapError

LINES, STEERING = "lines.json", "steering.json"
VERSION = 1
FIX_LASTS_NS = 2 * SECOND_NS  # an older position is none
SAMPLE = 400  # points of a scanner and moment by which the swath is measured
EDGE_SHARE = 0.01  # of the points that lie outside the swath's edges
NADIR_TAN = 0.15  # points below the aircraft give its height above ground
FEWEST = 20  # points that determine an edge
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
        self._stream, self._mapping, self._path = stream, setup.mapping, folder / LINES
        self._moments, self._facts = Moments(stream.scanners), facts
        self._frame: LocalFrame | None = None
        self._next_ns = self._steered_ns = -(1 << 62)
        self._fixes: dict[str, tuple[FixType, int]] = {}  # by receiver: quality and host time of the newest position
        self._seen: dict[str, list[int]] = {}  # by scanner: returns, and pulses without one, since the last tick
        self._ticked: set[str] = set()  # scanners with returns since the last tick
        self._lost = Counter[str]()
        self._lost_before = Counter[str]()
        self._tick_ns = self._saved_ns = 0
        self._written = b""

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
            seen = self._seen.setdefault(source.removeprefix("scanner/"), [0, 0])
            returns = int(np.count_nonzero(record.rows["number_of_returns"]))
            seen[0] += returns
            self._ticked.update([source.removeprefix("scanner/")] * (returns > 0))
            self._facts.flown.returns(source.removeprefix("scanner/"), record.rows)
            seen[1] += len(record.rows) - returns
        elif isinstance(record, GnssFix) and (record.lat_rad is not None or record.fix_type is FixType.NONE):
            self._facts.fix(source, record)
            fix_type = record.fix_type if record.valid else FixType.NONE
            self._fixes[source] = fix_type, record.host_time_ns

    def tick(self, tick_ns: int | None, placed: Placed) -> None:
        """Take the points of a tick, and the poses that became known at it."""
        self._tick_ns = self._tick_ns if tick_ns is None else tick_ns
        self._facts.flown.tick(list(self._ticked), TICK_NS / SECOND_NS)
        self._ticked.clear()
        if self.parser is not None:
            for name in self._stream.scanners:
                errors = self.parser(f"scanner/{name}").counters.errors
                self._lost[f"sequence {name}"] = int(errors.get("sequence_gap", 0))
        trajectory = self._stream.path.update()
        if trajectory is None:
            return
        if self._frame is None:
            self._frame = LocalFrame(trajectory.position_e[-1], self._mapping)
        for name, points in placed:
            self._take_points(name, points, trajectory, self._frame)
        rows = self.watch.poses(self._poses(trajectory))
        self._moments.add_poses(rows)
        if len(rows):
            for name, (returns, empty) in self._seen.items():
                self._moments.add_seen(int(rows["gps_ns"][-1]), name, returns, empty)
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
        times = times[trajectory.fates(times) == 0]
        if not len(times):
            return empty_moments(0)
        self._next_ns = int(times[-1]) + STEP_NS
        poses = trajectory.poses(times)
        self._facts.flown.poses(times, poses)
        rows = empty_moments(len(times))
        lat, lon, height = geodetic_from_e(poses.position_e)
        rot_l_from_e = rot_e_from_l(lat, lon).swapaxes(-1, -2)
        velocity_l = np.einsum("nij,nj->ni", rot_l_from_e, self._velocities(poses.velocity_e, times, trajectory))
        roll, _, _ = attitude_of(rot_l_from_e @ rot_from_quaternion(poses.q_e_from_b))
        rows["gps_ns"], rows["lat_rad"], rows["lon_rad"], rows["height_m"] = times, lat, lon, height
        rows["speed_mps"] = np.hypot(velocity_l[:, 0], velocity_l[:, 1])
        rows["track_rad"], rows["roll_rad"] = np.arctan2(velocity_l[:, 1], velocity_l[:, 0]), roll
        rows["fix"], rows["time"] = self._fix(), self._time()
        rows["lost"][-1] = (self._lost - self._lost_before).total()
        self._lost_before = self._lost.copy()
        return rows

    @staticmethod
    def _velocities(velocity_e: FloatArray, times: Any, trajectory: Trajectory) -> FloatArray:
        """Return velocities (n, 3), from positions where the source gives none."""
        if np.isfinite(velocity_e).all():
            return velocity_e
        known = trajectory.with_velocities().poses(times).velocity_e
        return np.nan_to_num(known, nan=0.0)

    def _fix(self) -> int:
        """Return the quality of the best receiver's position; -1: no receiver has sent any."""
        if not self._fixes:
            return -1
        found = self._fixes.values()
        return max((QUALITY[fix] for fix, at_ns in found if self._tick_ns - at_ns <= FIX_LASTS_NS), default=0)

    def _time(self) -> int:
        """Return the state of the worst scanner's clock: 0 locked, 1 doubtful, 2 none."""
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
        keys = points.time_ns // STEP_NS
        edges = [0, *(np.flatnonzero(np.diff(keys)) + 1).tolist(), len(keys)]
        parts: dict[int, list[tuple[int, int]]] = {}
        for start, end in pairwise(edges):
            parts.setdefault(int(keys[start]), []).append((start, end))
        for key, runs in parts.items():
            if key * STEP_NS < self._next_ns - 60 * SECOND_NS:
                continue
            found = self._moments.returns_at(key * STEP_NS, name)
            for start, end in runs:
                found.first += int(np.count_nonzero(points.return_number[start:end] <= 1))
            start, end = max(runs, key=lambda run: run[1] - run[0])
            if end - start >= FEWEST:
                self._measure(
                    found, key, points.points_map[start : end : max(1, (end - start) // SAMPLE)], trajectory, frame
                )

    @staticmethod
    def _measure(found: Returns, key: int, xyz: FloatArray, trajectory: Trajectory, frame: LocalFrame) -> None:
        """Measure the swath's edges across track, and the height above ground, by points of a moment."""
        first_ns, last_ns = trajectory.span
        begin_ns, end_ns = max(first_ns, key * STEP_NS), min(last_ns, (key + 1) * STEP_NS)
        if end_ns <= begin_ns:
            return
        try:
            poses = trajectory.poses([begin_ns, end_ns])
        except TrajectoryGapError:
            return
        one, _ = frame.pose_of(poses.position_e[0], poses.q_e_from_b[0])
        other, _ = frame.pose_of(poses.position_e[1], poses.q_e_from_b[1])
        way = other - one
        length = math.hypot(way[0], way[1])
        if length < 0.01:
            return
        away = frame.of_points(xyz) - (one + other) / 2.0
        across = (away[:, 0] * way[1] - away[:, 1] * way[0]) / length
        across_sorted = np.sort(across)
        skip = int(EDGE_SHARE * len(across))
        left, right = float(across_sorted[skip]), float(across_sorted[-1 - skip])
        found.left_m = left if math.isnan(found.left_m) else min(left, found.left_m)
        found.right_m = right if math.isnan(found.right_m) else max(right, found.right_m)
        below = -away[:, 2]
        nadir = np.abs(across) <= NADIR_TAN * np.abs(below)
        if int(nadir.sum()) >= 5:
            found.above_m = float(np.median(below[nadir]))

    # ------------------------------------------------------------------ result

    def plain_status(self) -> dict[str, Any]:
        """Return the lines in short for ``live.json``."""
        plain = self.watch.plain()
        states = Counter(line["state"] for line in plain["lines"])
        again = [line["name"] for line in plain["lines"] if line["state"] == "again"]
        lines = {key: plain[key] for key in ("plan", "current", "next")}
        lines |= {"states": dict(states), "fly_again": again, "trouble": self.trouble}
        return {"lines": lines}

    def save(self, log_time_ns: int, *, last: bool = False) -> None:
        """Write ``lines.json`` once a second of log time, and ``steering.json`` five times, if something changed.

        Raises:
            OSError: they cannot be written.
        """
        self._save_steering()
        if log_time_ns < self._saved_ns + SECOND_NS and not last:
            return
        self._saved_ns = log_time_ns
        found = {"version": VERSION, "trouble": self.trouble, "notes": list(self._notes)} | self.watch.plain()
        found["geometry"] = self.watch.plain_geometry()
        data = (json.dumps(found) + "\n").encode()
        if data != self._written:
            replace_file(self._path, data)
            self._written = data

    def _save_steering(self) -> None:
        """Write how to steer by the newest pose; a page for the pilot reads it."""
        if self._steered_ns == self._next_ns:
            return
        self._steered_ns = self._next_ns
        found = {"version": VERSION, "gps_ns": self._next_ns - STEP_NS} | self.watch.plain_steering()
        replace_file(self._path.with_name(STEERING), (json.dumps(found) + "\n").encode())
