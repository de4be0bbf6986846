"""Compare the calibrations of one mounting over time, and test whether the boresight has moved.

Two calibrations are compared by their differences against the joint covariance of both; a trend is the weighted
straight line through all of them.

Two calibrations of a scanner are only comparable if they agree in everything that is not compared: held values, tables,
settings of the atmosphere. Where these differ, angles differ too, although the boresight has not moved.
"""

from __future__ import annotations

import datetime as dt
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from scipy import stats

from swath.calib.labels import number, p_words, with_sigma
from swath.georef.scanner.calibration import INDEX, PARAMETERS, BeamCorrection, Calibration

LIKE = 1.0 / 3.0  # of a sigma: a difference of this size adds a twentieth to the expected square
DISTANCE_M = 500.0  # distance at which metres are converted to angles
METRE = 1.0 / DISTANCE_M
TURNS = {  # approximate greatest change (radians) of an angle per unit (SI) of a parameter; else 1
    "range_offset_m": METRE,
    "lever_arm_x_m": METRE,
    "lever_arm_y_m": METRE,
    "lever_arm_z_m": METRE,
    "encoder_latency_s": 600.0,  # a mirror's rate
    "torsion_s2": 1e5,  # its acceleration
}
NO_BEAM = BeamCorrection()

BORESIGHT = ("omega_rad", "phi_rad", "kappa_rad")
ALPHA = 0.001
EARLIEST, LATEST = 1980, 2500  # years in which calibrations can have been flown and made
LOG_START = re.compile(r"(?<!\d)(\d{8}T\d{6})Z")  # in the name of a session
FEWEST_FOR_TREND = 3
YEAR_S = 365.25 * 86_400.0


class HistoryError(ValueError):
    """Calibrations that form no history; the message is one line for the user."""


@dataclass(frozen=True, slots=True)
class Difference:
    """The difference of one parameter, later − earlier, SI."""

    name: str
    difference: float
    sigma: float

    @property
    def words(self) -> str:
        """Text such as ``phi_deg +0.0081 ± 0.0012 (6.8 σ)``."""
        parameter = PARAMETERS[INDEX[self.name]]
        text = with_sigma(self.difference / parameter.factor, self.sigma / parameter.factor)
        return f"{parameter.key} {text} ({number(self.times, '.1f')} σ)"

    @property
    def times(self) -> float:
        """The size of the difference in sigmas."""
        return abs(self.difference) / self.sigma if self.sigma > 0.0 else math.inf

    def record(self) -> dict[str, Any]:
        """Return the difference for JSON, in the unit of the key."""
        parameter = PARAMETERS[INDEX[self.name]]
        return {
            "parameter": parameter.key,
            "difference": self.difference / parameter.factor,
            "sigma": self.sigma / parameter.factor,
        }


@dataclass(frozen=True, slots=True)
class Compared:
    """Two calibrations: differences of the parameters that both estimated, and χ² of all with their correlations.

    Attributes:
        weights: of each difference, diagonal of their covariance's inverse, SI: an error e adds weight · e² to χ².
    """

    earlier: str
    later: str
    rows: tuple[Difference, ...]
    chi2: float
    freedom: int
    weights: tuple[float, ...] = ()

    @property
    def p(self) -> float:
        """Probability of a χ² this large if no parameter has changed."""
        return float(stats.chi2.sf(self.chi2, self.freedom)) if self.freedom else math.nan

    @property
    def moved(self) -> bool:
        """True if the difference is larger than chance explains."""
        return bool(self.freedom and self.p < ALPHA)


def compare(earlier: Calibration, later: Calibration, names: Sequence[str] | None = None) -> Compared:
    """Compare two calibrations whose errors are independent.

    Args:
        earlier, later: of one scanner.
        names: of parameters; None: all. Only those that both calibrations estimated count.

    Raises:
        HistoryError: the installation matrices differ, so that angles mean different things.
    """
    if not np.allclose(earlier.installation_matrix, later.installation_matrix, atol=1e-9):
        raise HistoryError(
            f"calibrations {earlier.id} and {later.id} have different installation matrices: their angles cannot be "
            "compared"
        )
    at = [
        INDEX[name]
        for name in (names or [parameter.name for parameter in PARAMETERS])
        if earlier.sigmas[INDEX[name]] > 0.0 and later.sigmas[INDEX[name]] > 0.0
    ]
    difference = later.parameters[at] - earlier.parameters[at]
    covariance = (earlier.covariance() + later.covariance())[np.ix_(at, at)]
    sigmas = np.sqrt(np.diag(covariance))
    rows = tuple(
        Difference(PARAMETERS[index].name, float(value), float(sigma))
        for index, value, sigma in zip(at, difference, sigmas, strict=True)
    )
    scaled = covariance / np.outer(sigmas, sigmas)
    inverse = np.linalg.pinv(scaled, hermitian=True) if at else np.zeros((0, 0))
    whole = float((difference / sigmas) @ inverse @ (difference / sigmas))
    weights = tuple((np.diag(inverse) / sigmas**2).tolist())
    return Compared(earlier.id, later.id, rows, whole, len(at), weights)


@dataclass(frozen=True, slots=True)
class Trend:
    """A straight line through a parameter's values: change per year and its sigma, SI; p of the change."""

    name: str
    per_year: float
    sigma: float
    p: float

    def record(self) -> dict[str, Any]:
        """Return the trend for JSON, in the unit of the key."""
        parameter = PARAMETERS[INDEX[self.name]]
        return {
            "parameter": parameter.key,
            "per_year": self.per_year / parameter.factor,
            "sigma": self.sigma / parameter.factor,
            "p": self.p,
        }


@dataclass(frozen=True, eq=False)
class History:
    """Calibrations of a scanner in one mounting.

    Attributes:
        scanner, installation: of the calibrations.
        entries: in the order of their flights; times: (n,) of the flights, seconds since 1970.
        steps: each against the one before, boresight only; without those that cannot be compared.
        trends: of the boresight; empty: too few calibrations, or some that cannot be compared.
        sentences: the verdict.
    """

    scanner: str
    installation: str
    entries: tuple[Calibration, ...]
    times: tuple[float, ...]
    steps: tuple[Compared, ...]
    trends: tuple[Trend, ...]
    sentences: tuple[str, ...]

    @property
    def moved(self) -> bool:
        """True if the boresight has moved, suddenly or gradually."""
        return any(step.moved for step in self.steps) or any(trend.p < ALPHA for trend in self.trends)

    def table(self) -> list[dict[str, Any]]:
        """Return one row per calibration: id, flight, method, and the boresight with its sigmas, degrees."""
        rows = []
        for entry, time in zip(self.entries, self.times, strict=True):
            row: dict[str, Any] = {"id": entry.id, "flown": date_words(time), "method": entry.method}
            for name in BORESIGHT:
                key = PARAMETERS[INDEX[name]].key
                row[key] = math.degrees(entry.value(name))
                row[f"{key}_sigma"] = math.degrees(float(entry.sigmas[INDEX[name]])) or None
            rows.append(row)
        return rows

    def record(self) -> dict[str, Any]:
        """Return the history for JSON."""
        return {
            "scanner": self.scanner,
            "installation": self.installation,
            "moved": self.moved,
            "calibrations": self.table(),
            "steps": [
                {
                    "earlier": step.earlier,
                    "later": step.later,
                    "chi2": step.chi2,
                    "freedom": step.freedom,
                    "p": None if math.isnan(step.p) else step.p,
                    "differences": [row.record() for row in step.rows],
                }
                for step in self.steps
            ],
            "trends": [trend.record() for trend in self.trends],
            "sentences": list(self.sentences),
        }


def flown_s(one: Calibration) -> float:
    """Return when a calibration was flown, seconds since 1970.

    That is `calibration.flown`, or the earliest start in the names of its logs, or else the time when it was made.

    Raises:
        HistoryError: the file tells none of them.
    """
    if "flown" in one.header:
        return _time_s(one, "flown")
    logs = one.header.get("logs")
    names = [str(log.get("name")) for log in logs if isinstance(log, Mapping)] if isinstance(logs, list | tuple) else []
    starts = [start for name in names if (start := _start_s(name)) is not None]
    return min(starts) if starts else _time_s(one, "created")


def _start_s(name: str) -> float | None:
    """Return the start that the name of a log contains, such as ``north-20260615T090000Z-a6f2_0.mcap``."""
    found = LOG_START.search(name)
    try:
        start = dt.datetime.strptime(found[1], "%Y%m%dT%H%M%S").replace(tzinfo=dt.UTC) if found else None
    except ValueError:  # digits that are no date
        return None
    return start.timestamp() if start and EARLIEST <= start.year <= LATEST else None


def _time_s(one: Calibration, key: str) -> float:
    time = one.header.get(key)
    if not isinstance(time, dt.datetime):
        raise HistoryError(f"calibration {one.id}: calibration.{key} is not a time; write it like 2026-11-21T10:15:00Z")
    if not EARLIEST <= time.year <= LATEST:
        when = "made" if key == "created" else key
        raise HistoryError(
            f"calibration {one.id}: calibration.{key} lies in the year {time.year}; give the time when it was {when}"
        )
    return (time if time.tzinfo else time.replace(tzinfo=dt.UTC)).timestamp()


def history(calibrations: Sequence[Calibration]) -> tuple[History, ...]:
    """Return one history per scanner and installation, from calibrations in any order.

    Calibrations without any estimate (``method = "nominal"``) have no sigmas and are listed, but not tested.

    Raises:
        HistoryError: a calibration has no time or no installation, or occurs twice.
    """
    groups: dict[tuple[str, str], list[tuple[float, Calibration]]] = {}
    seen: set[str] = set()
    for one in calibrations:
        installation = one.header.get("installation")
        if not installation:
            raise HistoryError(f"calibration {one.id}: has no calibration.installation; a history needs it")
        time = flown_s(one)
        if one.id in seen:
            raise HistoryError(f"calibration {one.id}: is given twice; give each calibration once")
        seen.add(one.id)
        groups.setdefault((one.scanner, str(installation)), []).append((time, one))
    return tuple(_history(key, sorted(group, key=lambda entry: entry[0])) for key, group in sorted(groups.items()))


def _history(key: tuple[str, str], group: list[tuple[float, Calibration]]) -> History:
    times, entries = tuple(time for time, _ in group), tuple(entry for _, entry in group)
    tested = [(time, entry) for time, entry in group if compare(entry, entry, BORESIGHT).freedom]
    when = {entry.id: date_words(time)[:10] for time, entry in group}
    steps, notes = [], []
    for (_, one), (_, two) in pairwise(tested):
        step = compare(one, two, BORESIGHT)
        why = difference_between(one, two, min((row.sigma for row in step.rows), default=math.inf))
        if why:
            notes.append(f"{key[0]}: the step between {when[one.id]} and {when[two.id]} was not tested: {why}")
        else:
            steps.append(step)
    trends = (
        () if notes else tuple(trend_of(name, tested) for name in BORESIGHT if _told(name, tested) >= FEWEST_FOR_TREND)
    )
    sentences = [] if notes and not steps else _sentences(key[0], steps, trends, when)
    return History(*key, entries, times, tuple(steps), trends, (*sentences, *notes))


def _told(name: str, tested: Sequence[tuple[float, Calibration]]) -> int:
    return len({time for time, entry in tested if entry.sigmas[INDEX[name]] > 0.0})


def trend_of(name: str, tested: Sequence[tuple[float, Calibration]]) -> Trend:
    """Fit a weighted straight line; its sigma follows from the calibrations' own sigmas."""
    rows = [(t, e.value(name), float(e.sigmas[INDEX[name]])) for t, e in tested if e.sigmas[INDEX[name]] > 0.0]
    time, value, sigma = (np.array(column) for column in zip(*rows, strict=True))
    weight, years = 1.0 / sigma**2, time / YEAR_S
    years = years - (weight * years).sum() / weight.sum()
    spread = float((weight * years**2).sum())
    slope = float((weight * years * value).sum()) / spread
    return Trend(name, slope, 1.0 / math.sqrt(spread), float(2.0 * stats.norm.sf(abs(slope) * math.sqrt(spread))))


def _sentences(scanner: str, steps: Sequence[Compared], trends: Sequence[Trend], when: Mapping[str, str]) -> list[str]:
    if not steps:
        return [f"{scanner}: drift cannot be tested, because fewer than two calibrations have sigmas"]
    found = []
    for step in steps:
        if step.moved:
            largest = max(step.rows, key=lambda row: abs(row.difference) / row.sigma)
            found.append(
                f"{scanner}: the boresight has moved between {when[step.earlier]} and {when[step.later]}: "
                f"{largest.words}; χ² {step.chi2:.1f} of {step.freedom}, {p_words(step.p)}"
            )
    for trend in trends:
        if trend.p < ALPHA:
            key = PARAMETERS[INDEX[trend.name]].key
            text = with_sigma(math.degrees(trend.per_year), math.degrees(trend.sigma))
            found.append(f"{scanner}: {key} drifts by {text} a year ({p_words(trend.p)})")
    worst = min(step.p for step in steps)
    return found or [
        f"{scanner}: the boresight has not moved: {len(steps)} steps, the least likely with {p_words(worst)}"
    ]


def created_words(one: Calibration) -> str:
    """Return when a calibration was made, in UTC; empty if its file does not tell it."""
    return date_words(_time_s(one, "created")) if isinstance(one.header.get("created"), dt.datetime) else ""


def date_words(time_s: float) -> str:
    return dt.datetime.fromtimestamp(time_s, dt.UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def difference_between(one: Calibration, other: Calibration, sigma_rad: float) -> str:
    """Describe the first difference of two calibrations that matters, other than the angles; empty: nothing differs.

    A difference matters if it is more than a part of the sigma of the compared angles. Parameters that both estimated
    do not count, because the angles' sigmas include their errors. A value that a file leaves out does not count as
    different.
    """
    return next(_differences(one, other, LIKE * sigma_rad), "")


def _differences(one: Calibration, other: Calibration, limit_rad: float) -> Iterator[str]:
    for word, first, second in (
        ("mirror_factor", one.mirror_factor, other.mirror_factor),
        ("ranges", one.ranges, other.ranges),
        ("refraction", one.refraction, other.refraction),
    ):
        if first is not None and second is not None and first != second:
            yield f"{word} is {first} and {second}"
    for index, parameter in enumerate(PARAMETERS):
        values = float(one.parameters[index]), float(other.parameters[index])
        estimated = bool(one.sigmas[index] > 0.0) + bool(other.sigmas[index] > 0.0)
        if estimated < 2 and abs(values[1] - values[0]) * TURNS.get(parameter.name, 1.0) > limit_rad:
            held = "held in one of them" if estimated else "held"
            yield f"{parameter.key}, {held}, is {values[0] / parameter.factor:g} and {values[1] / parameter.factor:g}"
    for word, apart_rad in (
        ("range corrections by intensity", METRE * _ibrc_apart_m(one, other)),
        ("range offsets by return, zone or rate", METRE * _offsets_apart_m(one, other)),
        ("tilts of facets", _facets_apart_rad(one, other)),
        ("corrections of beams", _beams_apart_rad(one, other)),
    ):
        if apart_rad > limit_rad:
            yield f"{word} differ"


def _ibrc_apart_m(one: Calibration, other: Calibration) -> float:
    """Return the greatest difference of corrections by intensity; without a table the correction is zero."""
    tables = [table for table in (one.ibrc, other.ibrc) if table is not None]
    if not tables:
        return 0.0
    at = np.unique(np.concatenate([nodes for nodes, _ in tables]))
    first, second = (np.zeros(len(at)) if each.ibrc is None else np.interp(at, *each.ibrc) for each in (one, other))
    return float(np.abs(second - first).max())


def _offsets_apart_m(one: Calibration, other: Calibration) -> float:
    first, second = (
        {(offset.return_slot, offset.mta_zone, offset.prf_hz): offset.offset_m for offset in each.range_offsets}
        for each in (one, other)
    )
    return max((abs(first.get(key, 0.0) - second.get(key, 0.0)) for key in {*first, *second}), default=0.0)


def _facets_apart_rad(one: Calibration, other: Calibration) -> float:
    first, second = one.facet_tilt_rad, other.facet_tilt_rad
    return max((abs(first.get(key, 0.0) - second.get(key, 0.0)) for key in {*first, *second}), default=0.0)


def _beams_apart_rad(one: Calibration, other: Calibration) -> float:
    apart = 0.0
    for channel in {*one.beams, *other.beams}:
        first, second = (each.beams.get(channel, NO_BEAM) for each in (one, other))
        turned = math.hypot(first.azimuth_rad - second.azimuth_rad, first.elevation_rad - second.elevation_rad)
        apart = max(apart, turned, METRE * abs(first.range_m - second.range_m))
    return apart
