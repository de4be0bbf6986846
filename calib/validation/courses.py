"""Follow the parameters of a scanner through all its calibrations: constant, drifting, or changed at one time.

Successive calibrations are compared as in `swath.calib.validation.history`, with all parameters that both estimated. A
parameter's course within one mounting is tested by three models, each by the χ² of its residuals in sigmas:

    constant   x                      n − 1
    drift      a + b t                n − 2
    jump       x before, y after      n − 2

The simplest that chance does not reject is told; of drift and jump the one that fits better. Errors of different
calibrations count as independent.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from scipy import stats

from swath.calib.labels import number, p_words, unknown, with_sigma
from swath.calib.validation.history import (
    ALPHA,
    BORESIGHT,
    YEAR_S,
    Compared,
    HistoryError,
    compare,
    created_words,
    date_words,
    difference_between,
    flown_s,
    trend_of,
)
from swath.georef.arrays import FloatArray
from swath.georef.scanner.calibration import INDEX, PARAMETERS, Calibration

TIMES = 3.29  # sigmas; one in a thousand by chance
UNKNOWN_MOUNTING = "mounting not recorded"


@dataclass(frozen=True, slots=True)
class Course:
    """Describes how one parameter went through the calibrations of one mounting.

    Attributes:
        name: of the parameter.
        kind: ``constant``, ``drift``, ``jump``, ``varies``; ``once``: estimated once, or not comparably.
        count: number of calibrations that estimated it.
        value, sigma: weighted mean; of a drift: change a year; of a jump: its size; SI.
        p: of the model that is told.
        before, after: dates between which it jumped; empty: no jump.
    """

    name: str
    kind: str
    count: int
    value: float
    sigma: float
    p: float
    before: str = ""
    after: str = ""

    @property
    def words(self) -> str:
        """The course in one sentence without its end."""
        one = unknown(f".{self.name}")
        text = with_sigma(one.factor * self.value, one.factor * self.sigma, sign=self.kind in ("drift", "jump"))
        sized = f"{text}{'' if one.unit == '°' else ' '}{one.unit}"
        if self.kind == "once":
            return f"{one.words}: {sized}, of one calibration"
        if self.kind == "constant":
            return f"{one.words}: constant, {sized} (mean of {self.count}, {p_words(self.p)})"
        if self.kind == "drift":
            return f"{one.words}: drifts by {sized} a year (of the line {p_words(self.p)})"
        if self.kind == "jump":
            return f"{one.words}: jumped by {sized} between {self.before} and {self.after}"
        return (
            f"{one.words}: changes by more than its sigmas, neither steadily nor once; mean {sized} ({p_words(self.p)})"
        )

    def record(self) -> dict[str, Any]:
        """Return the course for JSON, in the unit of the key."""
        parameter = PARAMETERS[INDEX[self.name]]
        return {
            "parameter": parameter.key,
            "course": self.kind,
            "calibrations": self.count,
            "value": self.value / parameter.factor,
            "sigma": self.sigma / parameter.factor,
            "p": None if math.isnan(self.p) else self.p,
            "between": [self.before, self.after] if self.kind == "jump" else None,
        }


@dataclass(frozen=True, slots=True)
class Step:
    """The change from one calibration to the next.

    Attributes:
        compared: their differences; None: they cannot be compared.
        before, after: their dates.
        remounted: their mountings differ; None: one is not known.
        why_not: why they were not compared; empty: they were.
    """

    compared: Compared | None
    before: str
    after: str
    remounted: bool | None
    why_not: str = ""

    @property
    def changed(self) -> bool:
        """True if the parameters differ by more than chance explains."""
        return self.compared is not None and self.compared.moved

    @property
    def words(self) -> str:
        """The step in one line."""
        mounted = {True: ", mounted anew", None: ", perhaps mounted anew", False: ""}[self.remounted]
        when = f"{self.before} to {self.after}{mounted}"
        if self.compared is None:
            return f"{when}: not tested: {self.why_not}"
        step = self.compared
        p = f"χ² {number(step.chi2, '.1f')} of {step.freedom}, {p_words(step.p)}"
        if not step.moved:
            return f"{when}: no significant change ({p})"
        large = [row.words for row in sorted(step.rows, key=lambda row: -row.times) if row.times > TIMES]
        return f"{when}: changed: {', '.join(large) or 'all parameters together'} ({p})"

    def record(self) -> dict[str, Any]:
        """Return the step for JSON."""
        entry: dict[str, Any] = {"before": self.before, "after": self.after, "remounted": self.remounted}
        if self.compared is None:
            return entry | {"changed": None, "why_not": self.why_not}
        step = self.compared
        return entry | {
            "earlier": step.earlier,
            "later": step.later,
            "changed": step.moved,
            "chi2": step.chi2,
            "freedom": step.freedom,
            "p": None if math.isnan(step.p) else step.p,
            "differences": [row.record() for row in step.rows],
        }


@dataclass(frozen=True, eq=False)
class ScannerCourse:
    """All calibrations of one scanner, by the times of their flights.

    Attributes:
        scanner, serial: of the calibrations; serial: empty if it is not recorded.
        entries: calibrations; times_s: of their flights, seconds since 1970; mountings: of each.
        steps: from each calibration with sigmas to the next one.
        courses: by mounting, of every parameter that was estimated there.
    """

    scanner: str
    serial: str
    entries: tuple[Calibration, ...]
    times_s: tuple[float, ...]
    mountings: tuple[str, ...]
    steps: tuple[Step, ...]
    courses: dict[str, tuple[Course, ...]]

    @property
    def title(self) -> str:
        """Name and serial number for people."""
        return f"{self.scanner}, serial {self.serial}" if self.serial else self.scanner

    @property
    def names(self) -> list[str]:
        """Names of the parameters that a calibration estimated."""
        return [one.name for one in PARAMETERS if any(entry.sigmas[INDEX[one.name]] > 0.0 for entry in self.entries)]

    def record(self) -> dict[str, Any]:
        """Return everything for JSON."""
        return {
            "scanner": self.scanner,
            "serial": self.serial or None,
            "calibrations": [
                {
                    "id": entry.id,
                    "flown": date_words(time),
                    "created": created_words(entry),
                    "mounting": mounting,
                    "method": entry.method,
                }
                | {"parameters": {one.key: entry.value(one.name) / one.factor for one in PARAMETERS}}
                | {"sigmas": {one.key: sigma for one in PARAMETERS if (sigma := _sigma(entry, one.name) / one.factor)}}
                for entry, time, mounting in zip(self.entries, self.times_s, self.mountings, strict=True)
            ],
            "steps": [step.record() for step in self.steps],
            "courses": [
                {"mounting": mounting} | one.record() for mounting, found in self.courses.items() for one in found
            ],
        }


def courses(calibrations: Sequence[Calibration]) -> tuple[ScannerCourse, ...]:
    """Return the course of each scanner, told by its serial number where that is recorded, or else by its name.

    A calibration without serial number belongs to the only scanner of its name that has one, unless its mounting
    contradicts.

    Raises:
        HistoryError: a calibration has no time.
    """
    groups: dict[tuple[str, str], list[tuple[float, Calibration]]] = {}
    for one in sorted(calibrations, key=lambda entry: not _serial(entry)):  # those with serial number first
        serial = _serial(one)
        key = (f"{one.header.get('scanner_model') or ''} {serial}", "") if serial else ("", one.scanner)
        if not serial:
            named = [other for other, group in groups.items() if other[0] and _same_scanner(one, group)]
            key = named[0] if len(named) == 1 else key
        groups.setdefault(key, []).append((flown_s(one), one))
    found = [_of_scanner(sorted(group, key=lambda entry: entry[0])) for group in groups.values()]
    return tuple(sorted(found, key=lambda one: (one.scanner, one.serial)))


def _same_scanner(one: Calibration, group: Sequence[tuple[float, Calibration]]) -> bool:
    """Return whether a calibration without serial number may be one of a scanner's: name, and mounting if recorded."""
    names = {entry.scanner for _, entry in group}
    mountings = {str(entry.header.get("installation") or "") for _, entry in group}
    mounting = str(one.header.get("installation") or "")
    return one.scanner in names and (not mounting or mounting in mountings)


def _serial(one: Calibration) -> str:
    return str(one.header.get("scanner_serial") or "")


def _of_scanner(group: list[tuple[float, Calibration]]) -> ScannerCourse:
    entries, times_s = tuple(entry for _, entry in group), tuple(time for time, _ in group)
    mountings = _mountings(entries)
    estimated = [at for at, entry in enumerate(entries) if (entry.sigmas > 0.0).any()]
    steps, broken = [], set()
    for one, two in pairwise(estimated):
        remounted = None if UNKNOWN_MOUNTING in (mountings[one], mountings[two]) else mountings[one] != mountings[two]
        step = _step((times_s[one], entries[one]), (times_s[two], entries[two]), remounted)
        steps.append(step)
        if step.why_not and mountings[one] == mountings[two]:
            broken.add(mountings[one])
    by_mounting = {
        mounting: tuple(_courses([group[at] for at in estimated if mountings[at] == mounting], mounting in broken))
        for mounting in dict.fromkeys(mountings[at] for at in estimated)
    }
    names = " and ".join(dict.fromkeys(entry.scanner for entry in entries))
    serial = next((known for entry in reversed(entries) if (known := _serial(entry))), "")
    return ScannerCourse(names, serial, entries, times_s, mountings, tuple(steps), by_mounting)


def _mountings(entries: Sequence[Calibration]) -> tuple[str, ...]:
    """Return the mounting of each; where it is not recorded, that of both neighbours in time if they have the same."""
    told = [str(entry.header.get("installation") or "") for entry in entries]
    found = []
    for at, mounting in enumerate(told):
        before = next((one for one in reversed(told[:at]) if one), "")
        after = next((one for one in told[at + 1 :] if one), "")
        found.append(mounting or (before if before == after and before else UNKNOWN_MOUNTING))
    return tuple(found)


def _step(one: tuple[float, Calibration], two: tuple[float, Calibration], remounted: bool | None) -> Step:
    dates = date_words(one[0])[:10], date_words(two[0])[:10]
    try:
        compared = compare(one[1], two[1])
    except HistoryError as error:
        return Step(None, *dates, remounted, str(error))
    if not compared.freedom:
        return Step(None, *dates, remounted, "they estimated no parameter in common")
    angles = [row.sigma for row in compared.rows if row.name in BORESIGHT]
    why_not = difference_between(one[1], two[1], min(angles, default=math.inf))
    return Step(None if why_not else compared, *dates, remounted, why_not)


def _courses(entries: list[tuple[float, Calibration]], broken: bool) -> Iterator[Course]:
    """Yield the courses of all parameters; broken: some calibrations cannot be compared, and nothing is tested."""
    for parameter in PARAMETERS:
        known = [(time, entry) for time, entry in entries if _sigma(entry, parameter.name) > 0.0]
        if not known:
            continue
        if broken or len(known) == 1:
            _, last = known[-1]
            value, sigma = last.value(parameter.name), _sigma(last, parameter.name)
            yield Course(parameter.name, "once", 1, value, sigma, math.nan)
        else:
            yield _course(parameter.name, known)


def _course(name: str, known: list[tuple[float, Calibration]]) -> Course:
    """Return the simplest course that chance does not reject."""
    value = np.array([entry.value(name) for _, entry in known])
    sigma = np.array([_sigma(entry, name) for _, entry in known])
    mean, mean_sigma, chi2 = _mean(value, sigma)
    count, p = len(known), float(stats.chi2.sf(chi2, len(known) - 1))
    if p >= ALPHA:
        return Course(name, "constant", count, mean, mean_sigma, p)
    jumps = [(*_jump(value, sigma, at), at) for at in range(1, count)]
    size, size_sigma, left, at = min(jumps, key=lambda one: one[2])
    dates = [date_words(time)[:10] for time, _ in known[at - 1 : at + 1]]
    freedom = count - 2
    p_jump = float(stats.chi2.sf(left, freedom)) if freedom else 1.0
    jump = Course(name, "jump", count, size, size_sigma, p_jump, *dates)
    if freedom and len({time for time, _ in known}) > 1:
        trend = trend_of(name, known)
        years = np.array([time for time, _ in known]) / YEAR_S
        off = _mean(value - trend.per_year * years, sigma)[2]
        p_drift = float(stats.chi2.sf(off, freedom))
        if p_drift >= ALPHA and off < left and abs(trend.per_year) > TIMES * trend.sigma:
            return Course(name, "drift", count, trend.per_year, trend.sigma, p_drift)
    jumped = p_jump >= ALPHA and abs(size) > TIMES * size_sigma
    return jump if jumped else Course(name, "varies", count, mean, mean_sigma, p)


def _mean(value: FloatArray, sigma: FloatArray) -> tuple[float, float, float]:
    """Return the weighted mean, its sigma, and the χ² of the residuals."""
    weight = 1.0 / sigma**2
    mean = float((weight * value).sum() / weight.sum())
    return mean, 1.0 / math.sqrt(float(weight.sum())), float((weight * (value - mean) ** 2).sum())


def _jump(value: FloatArray, sigma: FloatArray, at: int) -> tuple[float, float, float]:
    """Return the difference of the means from an index on and before it, its sigma, and the χ² that is left."""
    before, after = _mean(value[:at], sigma[:at]), _mean(value[at:], sigma[at:])
    return after[0] - before[0], math.hypot(before[1], after[1]), before[2] + after[2]


def _sigma(one: Calibration, name: str) -> float:
    return float(one.sigmas[INDEX[name]])
