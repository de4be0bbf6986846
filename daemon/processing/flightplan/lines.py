"""Lines as they are flown: their passes, the verdict on them, and the operator's word."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from swath.daemon.processing.flightplan.judge import Judged, Limits, LineVerdict, Reason, judge, judge_line
from swath.daemon.processing.flightplan.moments import empty_moments, join_moments
from swath.georef.arrays import StructArray
from swath.georef.timescales.gps_time import SECOND_NS

LEAST_PASS_S, LEAST_PASS_SHARE = 5.0, 0.2  # a shorter pass only crossed the line, if it is not a fair part of it
VERDICTS = {"accepted": "accepted", "good": "accepted", "again": "again", "reset": "", "planned": ""}


@dataclass(slots=True)
class Overrule:
    """The operator's word on a line: ``accepted`` or ``again``, the note, and the event's time in the log."""

    verdict: str
    note: str
    time_ns: int


@dataclass(slots=True, eq=False)
class Pass:
    """One flight along a line.

    Attributes:
        number: of all passes of the flight.
        line: place of the line in the plan.
        is_reverse: flown against the line's own direction.
        rows: moments so far.
        begin_ns: GPS time of its first pose.
        left_ns: GPS time when the aircraft left the line; None: it has not.
        is_settled: the aircraft has left the line, and all its moments have come.
    """

    number: int
    line: int
    is_reverse: bool
    begin_ns: int
    rows: list[StructArray] = field(default_factory=list)
    left_ns: int | None = None
    is_settled: bool = False

    def moments(self) -> StructArray:
        """Return its moments in one array."""
        if len(self.rows) > 1:
            self.rows = [join_moments(self.rows)]
        return self.rows[0] if self.rows else empty_moments(0)


@dataclass(slots=True, eq=False)
class Line:
    """A line of the watch: its passes, and the verdict by those that have been judged."""

    name: str
    length_m: float
    limits: Limits
    passes: list[Pass] = field(default_factory=list)
    overrule: Overrule | None = None
    verdict: LineVerdict | None = None
    overlap: Reason | None = None
    judged: dict[int, Judged] = field(default_factory=dict)  # by the pass's number
    is_new: bool = True  # moments or passes came since the last verdict
    told: dict[str, Any] | None = None  # by `plain_line`, until something changes

    def take_word(self, overrule: Overrule | None) -> None:
        """Take the operator's word on the line; None takes it back."""
        self.overrule, self.told = overrule, None

    def take_overlap(self, reason: Reason | None) -> None:
        """Take the reason why the overlap with its neighbours is too small; None: it is not."""
        if reason != self.overlap:
            self.overlap, self.told = reason, None

    def refresh(self) -> None:
        """Judge the passes anew if something came."""
        if not self.is_new:
            return
        self.is_new, self.told = False, None
        counted = []
        for one in self.passes:
            rows = one.moments()
            if not len(rows) or not (one.left_ns is None or self._counts(rows)):
                self.judged.pop(one.number, None)
                continue
            if one.number not in self.judged or len(self.judged[one.number].rows) != len(rows):
                self.judged[one.number] = judge(rows, self.limits)
            counted.append(self.judged[one.number])
        self.verdict = judge_line(counted, self.length_m) if counted else None

    def _counts(self, rows: StructArray) -> bool:
        """Return whether a finished pass flew the line, and did not only cross it in a turn."""
        flown_m = float(np.ptp(rows["along_m"]))
        seconds = (int(rows["gps_ns"][-1]) - int(rows["gps_ns"][0])) / SECOND_NS
        is_level = float(np.median(np.abs(rows["roll_rad"]))) <= 1.5 * self.limits.bank_rad
        return is_level and (seconds >= LEAST_PASS_S or flown_m >= LEAST_PASS_SHARE * self.length_m)

    @property
    def is_open(self) -> bool:
        """True while it is being flown, or was left so shortly ago that moments of it are still to come."""
        return any(not one.is_settled for one in self.passes)

    @property
    def reasons(self) -> list[Reason]:
        """All reasons, the gravest first; the end is not missed while moments of a judged pass are still to come."""
        if self.verdict is None:
            return []
        found = [reason for reason in self.verdict.reasons if reason.code != "early_end" or not self._grows]
        found += [self.overlap] if self.overlap is not None else []
        return sorted(found, key=lambda reason: not reason.is_grave)

    @property
    def _grows(self) -> bool:
        return any(not one.is_settled and one.number in self.judged for one in self.passes)

    @property
    def state(self) -> str:
        """State of a line that is not open: ``planned``, ``good``, ``remarks`` or ``again``."""
        if self.overrule is not None:
            if self.overrule.verdict == "again":
                return "again"
            return "remarks" if self.reasons or self.overrule.note else "good"
        if self.verdict is None:
            return "planned"
        reasons = self.reasons
        return "again" if any(one.is_grave for one in reasons) else "remarks" if reasons else "good"


def plain_line(line: Line) -> dict[str, Any]:
    """Return the state of a line as plain values, which are not to be changed."""
    if line.told is None:
        line.told = _plain(line)
    return line.told | {"state": "flying"} if line.is_open else line.told


def _plain(line: Line) -> dict[str, Any]:
    verdict = line.verdict
    flown = np.empty(0, np.bool_) if verdict is None else verdict.flown
    times = [int(one.rows["gps_ns"][place]) for one in line.judged.values() for place in (0, -1)]
    places = np.flatnonzero(flown)
    cell_m = 0.0 if verdict is None else verdict.cell_m
    overrule = line.overrule
    return {
        "name": line.name,
        "state": line.state,
        "reasons": [reason.plain() for reason in line.reasons],
        "begin_gps_ns": min(times) if times else None,
        "end_gps_ns": max(times) if times else None,
        "length_m": round(line.length_m, 1),
        "flown_fraction": round(float(flown.mean()), 4) if len(flown) else 0.0,
        "flown_from_m": round(float(places[0]) * cell_m, 1) if len(places) else None,
        "flown_to_m": round(min(float(places[-1] + 1) * cell_m, line.length_m), 1) if len(places) else None,
        "passes": len(line.judged),
        "overruled": None
        if overrule is None
        else {"verdict": overrule.verdict, "note": overrule.note, "time_ns": overrule.time_ns},
    }


def parsed_overrule(text: str, names: Sequence[str]) -> tuple[int | None, str, str]:
    """Return the line, the verdict (``accepted``, ``again``, or empty to take it back) and the note of an event's text.

    The text has the form ``line NAME: accepted, NOTE``; the line is None if it is another text, or of no known line.
    """
    told = text.strip()
    for place in sorted(range(len(names)), key=lambda place: -len(names[place])):
        head = f"line {names[place]}:"
        if told.lower().startswith(head.lower()):
            word, _, note = told[len(head) :].strip().partition(",")
            if word.strip().lower() in VERDICTS:
                return place, VERDICTS[word.strip().lower()], note.strip()
    return None, "", ""
