"""Watch a flight without a plan: its lines are the strips that the office will find, judged where no plan is needed."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from swath.daemon.config.tables import PlanConfig
from swath.daemon.processing.flightplan.judge import Limits
from swath.daemon.processing.flightplan.lines import Line, Overrule, Pass, parsed_overrule, plain_line
from swath.daemon.processing.flightplan.moments import empty_moments, join_moments
from swath.daemon.processing.flightplan.watch import mark_fixes
from swath.georef.arrays import FloatArray, StructArray
from swath.georef.strips import Span, StripRules, straight_spans
from swath.georef.timescales.gps_time import SECOND_NS

PAUSE_NS = 30 * SECOND_NS  # the laser is off for longer between two strips on one straight line
LOOK_NS = SECOND_NS
SHOWN_STEP_S = 5.0  # between two vertices of a strip on the map


class StripWatch:
    """Finds strips as they are flown, ``strip 1``, ``strip 2``, …, and judges them.

    A strip is straight flight by the office's rules (`swath.georef.strips`), from its first return to its last one.

    Args:
        config: table ``[plan]``, for the tolerances and what is wanted.
    """

    def __init__(self, config: PlanConfig) -> None:
        self.lines: list[Line] = []
        self._config = config
        self._rules = StripRules()
        self._limits = Limits.of(config)
        self._rows, self._new = empty_moments(0), list[StructArray]()
        self._closed_ns = self._looked_ns = -(1 << 62)
        self._is_flying = False
        self._best_fix = 0
        self._overrules: dict[str, Overrule] = {}

    def poses(self, rows: StructArray) -> StructArray:
        """Take the newest poses (n,), and return them for `moments`."""
        rows = rows.copy()
        if len(rows):
            self._best_fix = mark_fixes(rows, self._config, self._best_fix)
        return rows

    def moments(self, rows: StructArray) -> None:
        """Take moments (n,) whose returns are complete, in the order of time."""
        if not len(rows):
            return
        self._new.append(rows)
        newest_ns = int(rows["gps_ns"][-1])
        if newest_ns - self._looked_ns >= LOOK_NS:
            self._looked_ns = newest_ns
            self._look(newest_ns)

    def _look(self, newest_ns: int) -> None:
        """Find the strips that have ended, and the one that is being flown."""
        self._rows = join_moments([self._rows, *self._new])
        self._new.clear()
        rows, rules = self._rows, self._rules
        settled_ns = newest_ns - round((rules.window_s / 2 + rules.min_turn_s) * SECOND_NS)
        if self._is_flying:
            self.lines.pop()
            self._is_flying = False
        for begin, end in straight_spans(rows["gps_ns"], rows["track_rad"], rows["roll_rad"], rules):
            for strip in self._measured((max(begin, self._closed_ns), end)):
                ends = min(end, strip[1] + PAUSE_NS) < settled_ns
                self._add(strip, ends=ends)
                if ends:
                    self._closed_ns = strip[1]
                self._is_flying = not ends
        keep_ns = min(newest_ns, max(self._closed_ns, self._begin_ns(newest_ns))) - round(rules.window_s * SECOND_NS)
        self._rows = rows[rows["gps_ns"] >= keep_ns]

    def _begin_ns(self, newest_ns: int) -> int:
        """Return from when on rows may still belong to a strip: of straight flight without returns only the last."""
        if self._is_flying:
            return int(self.lines[-1].passes[0].begin_ns)
        busy = self._rows["gps_ns"][(self._rows["returns"] > 0) & (self._rows["gps_ns"] > self._closed_ns)]
        return int(busy[0]) if len(busy) else newest_ns

    def _measured(self, span: Span) -> list[Span]:
        """Return the stretches of a straight span from a first to a last return, without long pauses of the laser."""
        rows = self._rows
        inside = (rows["gps_ns"] >= span[0]) & (rows["gps_ns"] < span[1]) & (rows["returns"] > 0)
        times = rows["gps_ns"][inside]
        if not len(times):
            return []
        cuts = np.flatnonzero(np.diff(times) > PAUSE_NS)
        firsts, lasts = times[np.concatenate([[0], cuts + 1])], times[np.concatenate([cuts, [len(times) - 1]])]
        shortest_ns = round(self._rules.min_strip_s * SECOND_NS)
        found = zip(firsts.tolist(), lasts.tolist(), strict=True)
        return [(first, last + 1) for first, last in found if last - first >= shortest_ns]

    def _add(self, strip: Span, *, ends: bool) -> None:
        rows = self._rows[(self._rows["gps_ns"] >= strip[0]) & (self._rows["gps_ns"] < strip[1])].copy()
        step_s = np.diff(rows["gps_ns"]) / SECOND_NS
        rows["along_m"] = np.concatenate([[0.0], np.cumsum(step_s * rows["speed_mps"][1:])])
        number = len(self.lines)
        one = Pass(number, number, False, strip[0], [rows], strip[1] if ends else None, ends)
        length_m = max(1.0, float(rows["along_m"][-1]))
        name = f"strip {number + 1}"
        self.lines.append(Line(name, length_m, self._limits, [one], self._overrules.get(name)))

    def overrule(self, text: str, time_ns: int) -> bool:
        """Take the operator's note, ``line strip 3: accepted, NOTE``; return whether it is one."""
        line, verdict, note = parsed_overrule(text, [line.name for line in self.lines])
        if line is None:
            return False
        overrule = Overrule(verdict, note, time_ns) if verdict else None
        self.lines[line].take_word(overrule)
        self._overrules.pop(self.lines[line].name, None)
        if overrule is not None:
            self._overrules[self.lines[line].name] = overrule
        return True

    def close(self) -> None:
        """End the strip that is being flown: no more moments come."""
        rows = join_moments([self._rows, *self._new])
        if len(rows):
            self._look(int(rows["gps_ns"][-1]))
        if self._is_flying:
            self.lines[-1].passes[0].is_settled = True
        self._is_flying = False

    def plain(self) -> dict[str, Any]:
        """Return the state of all strips as plain values, without the geometry."""
        for line in self.lines:
            line.refresh()
        return {"plan": None, "lines": [plain_line(line) for line in self.lines]} | self.plain_steering()

    def plain_steering(self) -> dict[str, Any]:
        """Return the strip that is flown; there is nothing to steer to."""
        return {"current": self.lines[-1].name if self._is_flying else None, "next": None, "steering": None}

    def plain_geometry(self) -> dict[str, Any]:
        """Return the way of each strip in degrees, for maps."""
        return {"lines": {line.name: _way(line.passes[0].moments()) for line in self.lines}, "area": []}


def _way(rows: StructArray) -> list[list[float | None]]:
    step = max(1, round(SHOWN_STEP_S * 10))
    places = sorted({*range(0, len(rows), step), len(rows) - 1})
    columns: list[FloatArray] = [np.degrees(rows["lat_rad"]), np.degrees(rows["lon_rad"]), rows["height_m"]]
    return [
        [None if math.isnan(value) else round(float(value), 8) for value in (column[place] for column in columns)]
        for place in places
    ]
