"""Is a calibration right? The six methods of ISO/TS 19159-2, 6.8, each with numbers, a test and a sentence.

Distances are tested against the covariance that is expected of them: noise of the planes, errors of the strips'
trajectories, which all planes of a strip share, and the sigmas of the calibration itself. So a χ² that is too large
says that something is wrong which none of these explains.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from calib.control import ControlRules
from calib.effects import EFFECTS
from calib.features import ControlPoint, Features
from calib.flight import Flight
from calib.history import Compared, compare
from calib.strips import Numbers
from calib.validation_rows import Rows, control_rows, plane_rows
from georef.calibration import Calibration
from georef.earth import geodetic_from_e

FloatArray = NDArray[np.float64]

ALPHA = 0.001  # of each test: one true calibration in a thousand fails it
FEWEST = 5
CROSSING_DEG = 45.0
HEIGHTS_RATIO = 1.2
CODES = {  # CA_ValidationMethod
    "testfield": "001",
    "crossStripFlight": "002",
    "secondFlight": "003",
    "secondAltitude": "004",
    "measurementActualParameters": "005",
    "other": "006",
}
WORDS = {
    "crossStripFlight": "planes seen by crossing strips",
    "secondFlight": "planes seen by two flights",
    "secondAltitude": "planes seen from two heights",
    "other": "planes seen by any two strips",
}
WANTS = {
    "testfield": "want control (--control)",
    "crossStripFlight": "want strips that cross",
    "secondFlight": "want the log of a second flight",
    "secondAltitude": f"want strips at heights above ground that differ by {100 * (HEIGHTS_RATIO - 1):.0f} % or more",
    "measurementActualParameters": "want the parameters measured anew (--anew)",
    "other": "want strips that share planes",
}
NOT_BOTH = "no parameter was estimated in both; want a calibration file with sigmas, as swath calibrate writes it"


@dataclass(frozen=True, slots=True)
class Test:
    """A statistical test; p: chance of so much where nothing is wrong.

    ``chi2`` of all values; ``z`` of their mean; ``effects``: χ² of what the calibration's effects (roll, pitch, …)
    explain of them, which sees what all the rest hides.
    """

    kind: str
    value: float
    freedom: float
    p: float
    words: str = ""

    @property
    def passed(self) -> bool:
        """Whether it is no surprise."""
        return self.p >= ALPHA


@dataclass(frozen=True, eq=False)
class Method:
    """One method of validation.

    Attributes:
        name: of `CODES`.
        numbers: of the values; None: not available.
        tests: of them.
        sentence: what came of it.
        more: further values for JSON.
    """

    name: str
    numbers: Numbers | None
    tests: tuple[Test, ...]
    sentence: str
    more: Mapping[str, Any] = field(default_factory=dict)

    @property
    def code(self) -> str:
        """Of CA_ValidationMethod."""
        return CODES[self.name]

    @property
    def passed(self) -> bool | None:
        """None: it could not be applied."""
        return None if not self.tests else all(test.passed for test in self.tests)


@dataclass(frozen=True, eq=False)
class Validation:
    """All six; and why they may not be independent of the calibration."""

    methods: tuple[Method, ...]
    dependent: tuple[str, ...] = ()

    @property
    def passed(self) -> bool | None:
        """Whether all that could be applied passed; None: none could."""
        known = [method.passed for method in self.methods if method.passed is not None]
        return all(known) if known else None

    @property
    def sentence(self) -> str:
        """The verdict."""
        applied = [method for method in self.methods if method.passed is not None]
        failed = [method.name for method in applied if not method.passed]
        if not applied:
            return "nothing could be validated"
        alone = " (not independent)" if self.dependent else ""
        if failed:
            return f"the calibration does not hold{alone}: {', '.join(failed)} of {len(applied)} methods failed"
        return f"the calibration holds{alone}: {len(applied)} of 6 methods could be applied, none speaks against it"


def validate(
    flight: Flight,
    features: Features,
    calibrations: Mapping[str, Calibration],
    control: Sequence[ControlPoint] = (),
    anew: Mapping[str, Calibration] | None = None,
    rules: ControlRules | None = None,
) -> Validation:
    """Validate.

    Args:
        flight: placed with the calibrations.
        features: planes found in it, that no adjustment behind the calibrations has used.
        calibrations: by scanner, what is to be validated.
        control: in the flight's frame.
        anew: by scanner, parameters measured anew from this flight or otherwise; None: they were not.
        rules: of control.
    """
    rows = plane_rows(flight, features, calibrations)
    classes = _classes(flight, rows)
    found = {name: _of_rows(name, rows, which) for name, which in classes.items()}
    found["testfield"] = _testfield(flight, control, calibrations, rules or ControlRules())
    found["measurementActualParameters"] = _anew(calibrations, anew)
    return Validation(tuple(found[name] for name in CODES))


def same_logs(calibration: Calibration, logs: Sequence[tuple[str, str]]) -> tuple[str, ...]:
    """Sentences where logs (name, SHA-256) are those that a calibration was made of."""
    used = {entry.get("sha256", ""): entry.get("name", "") for entry in calibration.header.get("logs", [])}
    return tuple(
        f"{name}: calibration {calibration.id} was made of this log; this is no independent validation of it"
        for name, sha256 in logs
        if sha256 in used
    )


# ---------------------------------------------------------------------- planes


def _classes(flight: Flight, rows: Rows) -> dict[str, NDArray[np.bool_]]:
    """Which rows belong to which method."""
    headings, heights = _flown_so(flight)
    first, second = rows.first, rows.second
    if not len(rows):
        none = np.zeros(0, bool)
        return dict.fromkeys(WORDS, none)
    apart = np.abs((headings[first] - headings[second] + 90.0) % 180.0 - 90.0)
    ratio = np.maximum(heights[first], heights[second]) / np.minimum(heights[first], heights[second])
    flown = np.array([swath.flown for swath in flight.swaths])
    return {
        "crossStripFlight": apart >= CROSSING_DEG,
        "secondFlight": flown[first] != flown[second],
        "secondAltitude": ratio >= HEIGHTS_RATIO,
        "other": np.ones(len(rows), bool),
    }


def _flown_so(flight: Flight) -> tuple[FloatArray, FloatArray]:
    """(swaths,) headings, degrees, and heights above their points, metres."""
    headings, heights = np.zeros(len(flight.swaths)), np.ones(len(flight.swaths))
    for number, swath in enumerate(flight.swaths):
        if not len(swath):
            continue
        trajectory = flight.trajectories[swath.flown]
        within = trajectory.between(int(swath.time_ns[0]), int(swath.time_ns[-1]))
        way = within.velocity_l().mean(axis=0)
        headings[number] = math.degrees(math.atan2(way[1], way[0])) % 360.0
        ground = float(np.nanmedian(swath.points_t[:: max(len(swath) // 1000, 1), 2]))
        heights[number] = max(float(np.median(geodetic_from_e(within.position_e)[2])) - ground, 1.0)
    return headings, heights


def _of_rows(name: str, every: Rows, which: NDArray[np.bool_]) -> Method:
    rows, tested = every.take(which), every.take(every.independent(which))
    if len(tested) < FEWEST:
        return Method(name, None, (), f"{name} ({CODES[name]}): not applied: {WANTS[name]}")
    numbers, tests = Numbers.of(rows.value_m), distance_tests(tested)
    pairs = len({*zip(rows.first.tolist(), rows.second.tolist(), strict=True)})
    what = f"{WORDS[name]}: {numbers.count:,} distances on {len(set(rows.name)):,} planes, {pairs} pairs"
    return Method(name, numbers, tests, _sentence(name, what, numbers, tests), {"pairs": pairs})


def distance_tests(rows: Rows) -> tuple[Test, ...]:
    """χ² of values with their expected covariance, z of their mean (generalised least squares), χ² of effects.

    Of n values none of which follows from others χ² = dᵀ C⁻¹ d has n degrees of freedom;
    mean = (1ᵀ C⁻¹ d) / (1ᵀ C⁻¹ 1), z = mean · √(1ᵀ C⁻¹ 1).
    """
    factor = np.linalg.cholesky(rows.covariance())
    whitened = np.linalg.solve(factor, np.column_stack([rows.value_m, np.ones(len(rows))]))
    squares = float(whitened[:, 0] @ whitened[:, 0])
    weight = float(whitened[:, 1] @ whitened[:, 1])
    mean = float(whitened[:, 0] @ whitened[:, 1]) / weight
    z = mean * math.sqrt(weight)
    found = (
        Test("chi2", squares, float(len(rows)), float(stats.chi2.sf(squares, len(rows)))),
        Test("z", z, 1.0, float(2.0 * stats.norm.sf(abs(z)))),
    )
    if not rows.effects.any():
        return found
    return (*found, _effects_test(whitened[:, 0], np.linalg.solve(factor, rows.effects)))


def _effects_test(values: FloatArray, effects: FloatArray) -> Test:
    """χ² of what whitened effects (n, m) explain of whitened values (n,); in words the one that fits best."""
    length = np.linalg.norm(effects, axis=0)
    seen = np.flatnonzero(length > 1e-9 * length.max())
    unit = effects[:, seen] / length[seen]
    left, singular, _ = np.linalg.svd(unit, full_matrices=False)
    within = left[:, singular > 1e-3].T @ values
    alone = np.abs(unit.T @ values)
    name = EFFECTS[seen[int(alone.argmax())] % len(EFFECTS)].name
    squares, freedom = float(within @ within), len(within)
    words = f"as an error of {name} would leave ({alone.max():.1f} σ)"
    return Test("effects", squares, float(freedom), float(stats.chi2.sf(squares, freedom)), words)


def _sentence(name: str, what: str, numbers: Numbers, tests: Sequence[Test]) -> str:
    values = (
        f"mean {100 * numbers.mean_m:+.1f} cm, std {100 * numbers.std_m:.1f}, RMS {100 * numbers.rms_m:.1f}, "
        f"largest {100 * numbers.max_m:.1f}"
    )
    chi2, mean = tests[:2]
    if len(tests) > 2 and not tests[2].passed:
        verdict = f"{tests[2].words}: χ² {tests[2].value:,.0f} of {tests[2].freedom:,.0f}, p {tests[2].p:.2g}"
    elif not chi2.passed:
        verdict = f"more than is expected (χ² {chi2.value:,.0f} of {chi2.freedom:,.0f}, p {chi2.p:.2g})"
    elif not mean.passed:
        verdict = f"their mean is not zero (z {mean.value:.1f}, p {mean.p:.2g})"
    else:
        verdict = f"as expected (χ² {chi2.value:,.0f} of {chi2.freedom:,.0f}, p {chi2.p:.2g})"
    return f"{name} ({CODES[name]}): {what}: {values}: {verdict}"


# ---------------------------------------------------------------------- control, parameters


def _testfield(
    flight: Flight, control: Sequence[ControlPoint], calibrations: Mapping[str, Calibration], rules: ControlRules
) -> Method:
    rows = control_rows(flight, control, calibrations, replace(rules, farthest_m=math.inf))
    if len(rows) < FEWEST:
        why = WANTS["testfield"] if not control else f"control is seen {len(rows)} times only; want {FEWEST} or more"
        return Method("testfield", None, (), f"testfield ({CODES['testfield']}): not applied: {why}")
    numbers, tests = Numbers.of(rows.value_m), distance_tests(rows)
    what = f"laser above control: {numbers.count:,} distances at {len(set(rows.name))} points"
    sentence = _sentence("testfield", what, numbers, tests)
    return Method("testfield", numbers, tests, sentence, {"points": len(set(rows.name))})


def _anew(calibrations: Mapping[str, Calibration], anew: Mapping[str, Calibration] | None) -> Method:
    name = "measurementActualParameters"
    told: list[Compared] = []
    for scanner in sorted(set(calibrations) & set(anew or {})):
        assert anew is not None
        told.append(compare(calibrations[scanner], anew[scanner]))
    told = [one for one in told if one.freedom]
    if not told:
        return Method(name, None, (), f"{name} ({CODES[name]}): not applied: {NOT_BOTH if anew else WANTS[name]}")
    squares, freedom = sum(one.chi2 for one in told), sum(one.freedom for one in told)
    test = Test("chi2", squares, float(freedom), float(stats.chi2.sf(squares, freedom)))
    largest = max((row for one in told for row in one.rows), key=lambda row: abs(row.difference) / row.sigma)
    verdict = "agree with the calibration" if test.passed else "do not agree with the calibration"
    sentence = (
        f"{name} ({CODES[name]}): {freedom} parameters measured anew {verdict} (χ² {squares:.1f} of {freedom}, "
        f"p {test.p:.2g}); largest: {largest.words}"
    )
    return Method(name, None, (test,), sentence, {"parameters": [row.record() for one in told for row in one.rows]})
