"""Watch a flight: which line is flown, how to steer, and the state of each line.

All decisions depend on the poses and moments that come in, never on a clock, so that a replay gives the same states.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from swath.daemon.config.tables import PlanConfig
from swath.daemon.processing.flightplan.geometry import (
    ABOVE_GROUND,
    ACROSS,
    ALONG,
    AZIMUTH,
    HEIGHT,
    LineGeometry,
    Places,
)
from swath.daemon.processing.flightplan.judge import Limits
from swath.daemon.processing.flightplan.lines import Line, Overrule, Pass, parsed_overrule, plain_line
from swath.daemon.processing.flightplan.overlap import Overlaps, Pair
from swath.daemon.processing.flightplan.plan import FlightPlan
from swath.georef.arrays import BoolArray, FloatArray, StructArray
from swath.georef.compiled import jit_cached, jit_inline
from swath.georef.timescales.gps_time import SECOND_NS

ALIGNED_RAD, STILL_ALIGNED_RAD = math.radians(20.0), math.radians(35.0)  # between track and line
REACH_TOLERANCES, LEAST_REACH_M = 5.0, 100.0  # how far beside a line it still counts as flown, and badly
NEARER = 0.5  # another line takes over if it is this much nearer
REVERSE_M = 10.0  # of two lines at one place, the one whose direction is flown counts
AWAY_NS = 3 * SECOND_NS  # off a line for less, the pass goes on
SLOWEST_MPS = 1.0  # slower, the track has no direction
FIXED = 3  # quality of a position, as in `MOMENT_DTYPE`
APPROACH_RAD, APPROACH_M, APPROACH_ACROSS_M = math.radians(45.0), 20_000.0, 2_000.0


@dataclass(slots=True)
class Steering:
    """How to steer; lengths on the ellipsoid.

    Attributes:
        line, is_reverse: the line to be flown, and against its own direction.
        cross_track_m: positive: the aircraft is to the right of the line, as seen in the direction of flight.
        height_m: above the planned height; nan: none is planned.
        track_error_deg: direction of flight minus that of the line.
        to_begin_m, to_end_m: to the line's begin, 0 once it is passed, and to its end.
        speed_mps, wanted_speed_mps, bank_deg: nan where nothing is wanted.
    """

    line: str
    is_reverse: bool
    cross_track_m: float
    height_m: float
    track_error_deg: float
    to_begin_m: float
    to_end_m: float
    speed_mps: float
    wanted_speed_mps: float
    bank_deg: float

    def plain(self, bank_limit_deg: float) -> dict[str, Any]:
        """Return plain values for ``lines.json``."""
        slow = self.speed_mps < SLOWEST_MPS
        numbers = {
            "cross_track_m": self.cross_track_m,
            "height_m": self.height_m,
            "track_error_deg": self.track_error_deg,
            "to_begin_m": self.to_begin_m,
            "to_end_m": self.to_end_m,
            "to_begin_s": math.nan if slow else self.to_begin_m / self.speed_mps,
            "to_end_s": math.nan if slow else self.to_end_m / self.speed_mps,
            "speed_mps": self.speed_mps,
            "wanted_speed_mps": self.wanted_speed_mps,
            "bank_deg": self.bank_deg,
            "bank_limit_deg": bank_limit_deg,
        }
        told = {key: round(value, 2) if math.isfinite(value) else None for key, value in numbers.items()}
        return {"line": self.line, "reverse": self.is_reverse, **told}


@jit_cached
def _approach(columns: Any, length_m: Any, left: Any, track_rad: float) -> tuple[int, bool]:
    """Return the nearest line ahead of a place that is ``left`` (lines,), and if against its direction; −1: none is."""
    least, best, is_reverse = math.inf, -1, False
    for line in range(len(length_m)):
        along, across = columns[ALONG, 0, line], abs(columns[ACROSS, 0, line])
        off = abs(_turned_inside(track_rad - columns[AZIMUTH, 0, line]))
        ahead = -1.0
        if off <= APPROACH_RAD:
            ahead = -along
        elif off >= math.pi - APPROACH_RAD:
            ahead = along - length_m[line]
        if left[line] and 0.0 <= ahead <= APPROACH_M and across <= APPROACH_ACROSS_M:
            distance = math.hypot(ahead, across)
            if distance < least:
                least, best, is_reverse = distance, line, off >= math.pi - APPROACH_RAD
    return best, is_reverse


@jit_cached
def _note(rows: Any, place: int, number: int, line: int, columns: Any) -> None:
    """Note in a pose the pass and the line that it is flown on; ``columns`` are those of `Places`."""
    row = rows[place]
    row.run, row.along_m, row.across_m = number, columns[ALONG, place, line], columns[ACROSS, place, line]
    row.planned_m, row.planned_above_m = columns[HEIGHT, place, line], columns[ABOVE_GROUND, place, line]


def _turned(angle_rad: Any) -> Any:
    """Return angles as −π … π."""
    return (angle_rad + math.pi) % (2.0 * math.pi) - math.pi


_turned_inside = jit_inline(_turned)


@jit_cached
def _fit(columns: Any, length_m: Any, rows: Any, reach_m: float, off: Any, cost: Any, keeps: Any, best: Any) -> None:
    """Compare poses with every line.

    Args:
        columns: (6, n, lines) of `Places`.
        length_m: (lines,).
        rows: the poses (n,).
        reach_m: how far beside a line it still counts as flown.
        off, cost: (n, lines) angle between track and line, and how badly the line is flown.
        keeps: (n, lines) whether a pass goes on.
        best: (n,) the line that is flown best; −1: none is.
    """
    along_m, across_m, azimuth_rad, planned_m = columns[ALONG], columns[ACROSS], columns[AZIMUTH], columns[HEIGHT]
    for i in range(len(rows)):
        track, speed, height = rows[i].track_rad, rows[i].speed_mps, rows[i].height_m
        least, best[i] = math.inf, -1
        for k in range(len(length_m)):
            turned = _turned_inside(track - azimuth_rad[i, k])
            away, across, above = abs(turned), abs(across_m[i, k]), abs(height - planned_m[i, k])
            angle = min(away, math.pi - away)
            inside = 0.0 <= along_m[i, k] <= length_m[k] and speed >= SLOWEST_MPS
            off[i, k] = turned
            keeps[i, k] = inside and angle <= STILL_ALIGNED_RAD and across <= 1.5 * reach_m
            cost[i, k] = across + (0.0 if math.isnan(above) else above) + (REVERSE_M if away > math.pi / 2 else 0.0)
            if inside and angle <= ALIGNED_RAD and across <= reach_m and cost[i, k] < least:
                least, best[i] = cost[i, k], k


class LineWatch:
    """Watches the lines of a plan.

    Args:
        plan: with at least one line.
        config: table ``[plan]``, for the tolerances and what is wanted.

    Attributes:
        lines: in the order of the plan.
        current: the line that is flown now; None: none.
        steering: to the line that is flown, or that comes next; None: before the first pose, or nothing is left to fly.
    """

    def __init__(self, plan: FlightPlan, config: PlanConfig) -> None:
        self.plan, self._config = plan, config
        self.geometry = LineGeometry(plan.lines)
        self.lines = [
            Line(line.name, float(length_m), Limits.of(config, line.speed_mps))
            for line, length_m in zip(plan.lines, self.geometry.length_m, strict=True)
        ]
        self.current: Pass | None = None
        self.steering: Steering | None = None
        self._passes: dict[int, Pass] = {}  # by number, until they are settled
        self._count = 0
        self._best_fix = 0
        self._last_line: int | None = None
        self._due_lines: BoolArray | None = None
        self._geometry = self._drawn()
        self._overlaps = Overlaps(plan.lines, self.geometry)
        self._reach_m = max(REACH_TOLERANCES * config.tolerance.cross_track_m, LEAST_REACH_M)

    # ------------------------------------------------------------------ poses

    def poses(self, rows: StructArray) -> StructArray:
        """Take the newest poses (n,), and return them with the lines that they are flown on, for `moments`."""
        rows = rows.copy()
        if not len(rows):
            return rows
        self._best_fix = mark_fixes(rows, self._config, self._best_fix)
        places = self.geometry.places(rows["lat_rad"], rows["lon_rad"])
        off, cost = np.empty((2, len(rows), len(self.lines)))
        keeps, best = np.empty(off.shape, np.bool_), np.empty(len(rows), np.int64)
        _fit(places.columns, self.geometry.length_m, rows, self._reach_m, off, cost, keeps, best)
        for place, (gps_ns, line) in enumerate(zip(rows["gps_ns"].tolist(), best.tolist(), strict=True)):
            self._choose(gps_ns, off[place], keeps[place], cost[place], line if line >= 0 else None)
            if self.current is not None:
                _note(rows, place, self.current.number, self.current.line, places.columns)
        self.steering = self._steer(rows[-1:], places.last())
        return rows

    def _choose(self, gps_ns: int, off: FloatArray, keeps: BoolArray, cost: FloatArray, best: int | None) -> None:
        """Find the line that is flown, and begin or end a pass; arrays (lines,)."""
        if self.current is not None:
            line = self.current.line
            same_way = (abs(off[line]) > math.pi / 2) == self.current.is_reverse
            nearer = best is not None and best != line and cost[best] < NEARER * cost[line]
            if keeps[line] and same_way and not nearer:
                return
            self.current.left_ns = gps_ns
            self.lines[line].is_new = True
            self._last_line, self.current = line, None
        if best is None:
            return
        is_reverse = bool(abs(off[best]) > math.pi / 2)
        earlier = self.lines[best].passes[-1] if self.lines[best].passes else None
        if (
            earlier is not None
            and earlier.left_ns is not None
            and earlier.is_reverse == is_reverse
            and gps_ns - earlier.left_ns < AWAY_NS
        ):
            earlier.left_ns, self.current = None, earlier
            return
        self._begin(gps_ns, best, is_reverse=is_reverse)

    def _begin(self, gps_ns: int, line: int, *, is_reverse: bool) -> None:
        self.current = Pass(self._count, line, is_reverse, gps_ns)
        self._count += 1
        self._passes[self.current.number] = self.current
        flown = self.lines[line]
        flown.passes.append(self.current)
        flown.is_new = True
        if flown.overrule is not None and flown.overrule.verdict == "again":
            flown.take_word(None)  # it is being done
            self._due_lines = None

    # ------------------------------------------------------------------ steering

    def _steer(self, row: StructArray, places: Places) -> Steering | None:
        speed_mps, track = float(row["speed_mps"][0]), float(row["track_rad"][0])
        if self.current is not None:
            line, is_reverse = self.current.line, self.current.is_reverse
        else:
            found = self._approached(places, track)
            if found is None:
                return None
            line, is_reverse = found
        length_m = float(self.geometry.length_m[line])
        along, across = float(places.along_m[0, line]), float(places.across_m[0, line])
        azimuth = float(places.azimuth_rad[0, line]) + (math.pi if is_reverse else 0.0)
        flown_m = length_m - along if is_reverse else along
        to_begin = math.hypot(flown_m, across) if flown_m < 0.0 else 0.0
        to_end = math.hypot(length_m - flown_m, across) if flown_m > length_m else length_m - flown_m
        limits = self.lines[line].limits
        planned = float(places.height_m[0, line])
        return Steering(
            self.lines[line].name,
            is_reverse,
            -across if is_reverse else across,
            float(row["height_m"][0]) - planned,
            math.degrees(float(_turned(track - azimuth))),
            to_begin,
            to_end,
            speed_mps,
            limits.wanted_speed_mps,
            math.degrees(float(row["roll_rad"][0])),
        )

    def _approached(self, places: Places, track_rad: float) -> tuple[int, bool] | None:
        """Return the line to be flown next, and its direction: one ahead, or the next of the plan."""
        left = self._due()
        if not left.any():
            return None
        line, is_reverse = _approach(places.columns, self.geometry.length_m, left, track_rad)
        if line >= 0:
            return line, is_reverse
        line = self._following(left, self._last_line)
        return line, bool(places.along_m[0, line] > self.geometry.length_m[line] / 2.0)

    @staticmethod
    def _following(left: BoolArray, last: int | None) -> int:
        """Return the first line after the last one flown that has to be flown."""
        start = 0 if last is None else last + 1
        order = [*range(start, len(left)), *range(min(start, len(left)))]
        return int(next(line for line in order if left[line]))

    def _due(self) -> BoolArray:
        """Return which lines have to be flown (lines,), as known since the last change."""
        if self._due_lines is None:
            self._due_lines = np.array([line.state in ("planned", "again") for line in self.lines])
        return self._due_lines

    @property
    def next_line(self) -> str | None:
        """Name of the line to be flown after the present one; None: none is left."""
        if self.current is None and self.steering is not None:
            return self.steering.line
        left, last = self._due(), self._last_line
        if self.current is not None:
            left, last = left.copy(), self.current.line
            left[last] = False
        return self.lines[self._following(left, last)].name if left.any() else None

    # ------------------------------------------------------------------ moments

    def moments(self, rows: StructArray) -> None:
        """Take moments (n,) whose returns are complete, in the order of time."""
        if not len(rows):
            return
        numbers = rows["run"]
        edges = [0, *(np.flatnonzero(np.diff(numbers)) + 1).tolist(), len(rows)]
        for start, end in pairwise(edges):
            one = self._passes.get(int(numbers[start]))
            if one is not None:
                one.rows.append(rows[start:end])
                self.lines[one.line].is_new = True
        newest_ns = int(rows["gps_ns"][-1])
        for one in list(self._passes.values()):
            if one.left_ns is not None and newest_ns > one.left_ns:
                self._settle(one)

    def _settle(self, one: Pass) -> None:
        """Note that all moments of a pass have come; it cannot go on either, as moments are older than `AWAY_NS`."""
        one.is_settled = self.lines[one.line].is_new = True
        del self._passes[one.number]

    def close(self) -> None:
        """End all passes: no more moments come."""
        for one in list(self._passes.values()):
            if one.left_ns is None:
                rows = one.moments()
                one.left_ns = int(rows["gps_ns"][-1]) if len(rows) else one.begin_ns
            self._settle(one)
        self.current = self.steering = None
        self.refresh()

    def overrule(self, text: str, time_ns: int) -> bool:
        """Take the operator's note, ``line NAME: accepted, NOTE``; return whether it is one."""
        line, verdict, note = parsed_overrule(text, [line.name for line in self.lines])
        if line is None:
            return False
        self.lines[line].take_word(Overrule(verdict, note, time_ns) if verdict else None)
        self._due_lines = None
        return True

    # ------------------------------------------------------------------ result

    def refresh(self) -> None:
        """Judge all lines anew that have something new."""
        changed = [place for place, line in enumerate(self.lines) if line.is_new]
        if changed:
            self._due_lines = None
        for line in self.lines:
            line.refresh()
        if changed and self._config.wanted.overlap_percent is not None:
            self._overlaps.blame(self.lines, self._config, changed)

    def overlap_pairs(self) -> list[Pair]:
        """Return how much the swaths of neighbouring lines overlap that have been flown."""
        self.refresh()
        return self._overlaps.pairs(self.lines)

    def plain(self) -> dict[str, Any]:
        """Return the state of all lines as plain values, without the geometry."""
        self.refresh()
        lines = [plain_line(line) for line in self.lines]
        return {"plan": self.plan.name, "lines": lines} | self.plain_steering()

    def plain_steering(self) -> dict[str, Any]:
        """Return the line that is flown, the next one, and how to steer, as plain values."""
        bank_deg = self._config.tolerance.bank_deg
        return {
            "current": None if self.current is None else self.lines[self.current.line].name,
            "next": self.next_line,
            "steering": None if self.steering is None else self.steering.plain(bank_deg),
        }

    def plain_geometry(self) -> dict[str, Any]:
        """Return the lines and the area in degrees, for maps; they never change."""
        return self._geometry

    def _drawn(self) -> dict[str, Any]:
        return {
            "lines": {
                line.name: [
                    [round(lat, 8), round(lon, 8), None if math.isnan(height) else round(height, 2)]
                    for lat, lon, height in zip(
                        line.lat_deg.tolist(), line.lon_deg.tolist(), line.height_m.tolist(), strict=True
                    )
                ]
                for line in self.plan.lines
            },
            "area": [[ring.round(8).tolist() for ring in polygon] for polygon in self.plan.area],
        }


def mark_fixes(rows: StructArray, config: PlanConfig, best: int) -> int:
    """Note in poses (n,) whether positions are as good as wanted.

    Args:
        rows: poses, changed in place.
        config: table ``[plan]``.
        best: best quality before them.

    Returns:
        The best quality so far.
    """
    wanted = {"auto": 0, "any": 1, "float": 2, "fixed": FIXED}[config.wanted.fix]
    return int(_mark(rows, wanted, best))


@jit_cached
def _mark(rows: Any, wanted: int, best: int) -> int:
    """Do what `mark_fixes` does; ``wanted`` is a quality, 0: as good as the best one if that is fixed."""
    for i in range(len(rows)):
        fix = rows[i].fix
        best = max(best, fix)
        least = wanted if wanted > 0 else (FIXED if best >= FIXED else 1)
        rows[i].is_fixed_enough = -1 if fix < 0 else (1 if fix >= least else 0)
    return best
