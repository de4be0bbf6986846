"""Validate a calibration by the six methods of ISO/TS 19159-2, 6.8, each with numbers, a test and a sentence.

Distances are tested against their expected covariance: noise of the planes, the trajectory's errors, with their
correlation along the strips and from one to the next, and the sigmas of the calibration itself. So a χ² that is too
large indicates an error that none of these explains.

A test that passes is worth only as much as it could have detected: for every parameter the report gives the smallest
error that the tests would have detected with `POWER` (the minimal detectable bias of Baarda 1968, A testing procedure
for use in geodetic networks).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy import optimize, stats

from swath.calib.control.points import ControlRules
from swath.calib.equations.observability import RULES_OF_ALL
from swath.calib.equations.trajectory_prior import ERRORS, Taus, TrajectoryPrior, gauss_markov
from swath.calib.features import ControlPoint, Features
from swath.calib.flight import Flight
from swath.calib.labels import number, p_words
from swath.calib.strips.differences import Numbers
from swath.calib.strips.effects import EFFECTS
from swath.calib.validation.distances import Rows, control_rows, estimated_floor_m, plane_rows
from swath.calib.validation.history import Compared, compare
from swath.georef.arrays import BoolArray, FloatArray
from swath.georef.geodesy.earth import geodetic_from_e
from swath.georef.scanner.calibration import INDEX, PARAMETERS, Calibration

ALPHA = 0.001  # of each test: one true calibration in a thousand fails it
POWER = 0.8  # probability of detecting an error of the reported size
BLIND = 25.0  # plausible sizes: an error that is only detected above this counts as undetectable
FEWEST = 5
UNITS = {"rad": ("°", math.degrees(1.0)), "m": (" m", 1.0), "s": (" µs", 1e6), "s2": (" s²", 1.0)}
SIGMAS_M, SIGMAS_DEG = 0.05, (0.005, 0.005, 0.01)  # of trajectories without sigmas
KNOT_S = 1.0  # of trajectories that have only sigmas
WANDER, WANDER_TAUS = 0.3, Taus(2.0, 2.0, 2.0)  # of these sigmas: the part of errors that changes from plane to plane
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
    "testfield": "needs control (--control)",
    "crossStripFlight": "needs strips that cross",
    "secondFlight": "needs the log of a second flight",
    "secondAltitude": f"needs strips at heights above ground that differ by {100 * (HEIGHTS_RATIO - 1):.0f} % or more",
    "measurementActualParameters": "needs independently measured parameters (--anew)",
    "other": "needs strips that share planes",
}
NOT_BOTH = (
    "both calibrations estimated no common parameter; give a calibration file with sigmas, as swath calibrate writes it"
)


@dataclass(frozen=True, slots=True)
class Test:
    """A statistical test; p is the probability of a value this large if there is no error.

    The kinds are: ``chi2`` of all values; ``z`` of their mean; ``effects``: χ² of the part of them that the
    calibration's effects (roll, pitch, …) explain, which shows errors that the noise of all values hides; ``effect``:
    of the one effect that fits best, with the p of all of them together (Bonferroni), which shows a single wrong
    parameter best.
    """

    kind: str
    value: float
    freedom: float
    p: float
    words: str = ""

    @property
    def passed(self) -> bool:
        """True if p is at least `ALPHA`."""
        return self.p >= ALPHA


@dataclass(frozen=True, slots=True)
class Detectable:
    """The smallest error of a parameter that a test would have detected with `POWER`, if it were the only error.

    Attributes:
        scanner, parameter: as ``left``, ``omega_rad``.
        size: SI; deviations within the calibration's own sigmas are not errors.
    """

    scanner: str
    parameter: str
    size: float

    @property
    def seen(self) -> bool:
        """True if the size is below `BLIND` plausible errors of the parameter."""
        return self.size < BLIND * RULES_OF_ALL.of(f"{self.scanner}.{self.parameter}").plausible

    @property
    def words(self) -> str:
        """Name of the parameter and the size, as ``phi 0.0062°``."""
        unit, factor = UNITS.get(self.parameter.rpartition("_")[2], (" ppm", 1e6))
        return f"{self.name} {float(f'{factor * self.size:.2g}'):g}{unit}"

    @property
    def name(self) -> str:
        """Name of the parameter without its unit."""
        name, _, unit = self.parameter.rpartition("_")
        return name if unit in UNITS else self.parameter

    def record(self) -> dict[str, Any]:
        """Return the error for JSON, in the unit of the parameter's key; null if it is undetectable."""
        parameter = PARAMETERS[INDEX[self.parameter]]
        size = self.size / parameter.factor if self.seen else None
        return {"scanner": self.scanner, "parameter": parameter.key, "smallest_error": size}


@dataclass(frozen=True, eq=False)
class Method:
    """One method of validation with its result.

    Attributes:
        name: of `CODES`.
        numbers: of the values; None: not available.
        tests: of the values.
        sentence: the result.
        more: further values for JSON.
        detectable: the smallest errors that it would have detected.
    """

    name: str
    numbers: Numbers | None
    tests: tuple[Test, ...]
    sentence: str
    more: Mapping[str, Any] = field(default_factory=dict)
    detectable: tuple[Detectable, ...] = ()

    @property
    def code(self) -> str:
        """Code of CA_ValidationMethod."""
        return CODES[self.name]

    @property
    def passed(self) -> bool | None:
        """True if all tests passed; None if the method could not be applied."""
        return None if not self.tests else all(test.passed for test in self.tests)


@dataclass(frozen=True, eq=False)
class Validation:
    """The results of all six methods.

    Attributes:
        methods: in the order of `CODES`.
        dependent: why they may not be independent of the calibration.
        undone: requests that could not be fulfilled.
    """

    methods: tuple[Method, ...]
    dependent: tuple[str, ...] = ()
    undone: tuple[str, ...] = ()

    @property
    def passed(self) -> bool | None:
        """True if all methods that could be applied passed; None if none could be applied."""
        known = [method.passed for method in self.methods if method.passed is not None]
        return all(known) if known else None

    @property
    def holds(self) -> bool:
        """True if all methods that could be applied passed, and all requests could be fulfilled."""
        return bool(self.passed) and not self.undone

    @property
    def detectable(self) -> tuple[Detectable, ...]:
        """The smallest errors that any of the methods would have detected."""
        best: dict[tuple[str, str], Detectable] = {}
        for one in (one for method in self.methods for one in method.detectable):
            there = best.setdefault((one.scanner, one.parameter), one)
            if one.size < there.size:
                best[one.scanner, one.parameter] = one
        return tuple(best.values())

    @property
    def sentence(self) -> str:
        """The verdict, with unfulfilled requests and undetectable errors."""
        applied = [method for method in self.methods if method.passed is not None]
        return self.summary + ("" if not applied or not all(method.passed for method in applied) else self._unseen())

    @property
    def summary(self) -> str:
        """The verdict, with unfulfilled requests."""
        applied = [method for method in self.methods if method.passed is not None]
        failed = [method.name for method in applied if not method.passed]
        undone = f"a requested check could not be done: {'; '.join(self.undone)}" if self.undone else ""
        if not applied:
            return f"nothing could be validated{'; ' if undone else ''}{undone}"
        alone = " (not independent)" if self.dependent else ""
        if failed:
            verdict = f"the calibration does not hold{alone}: {len(failed)} of {len(applied)} methods failed"
            verdict += "" if len(failed) == len(applied) else f": {', '.join(failed)}"
            return f"{verdict}{'; ' if undone else ''}{undone}"
        could = f"{len(applied)} of 6 methods could be applied, and all passed"
        if undone:
            return f"not validated as requested{alone}: {undone}; {could}"
        return f"the calibration holds{alone}: {could}"

    def _unseen(self) -> str:
        """Describe in words the errors that would not have been detected."""
        found = self.detectable
        several = len({one.scanner for one in found}) > 1
        below = [f"{one.scanner} {one.words}" if several else one.words for one in found if one.seen]
        blind = [f"{one.scanner} {one.name}" if several else one.name for one in found if not one.seen]
        words = (
            f"; errors below {', '.join(below)} would not be detected ({100 * POWER:.0f} % of larger ones would)"
            if below
            else ""
        )
        return words + (f"; errors of {', '.join(blind)} would not be detected" if blind else "")


@dataclass(frozen=True, eq=False)
class Asked:
    """Requests to a validation beyond the planes that two strips see.

    Attributes:
        control: points in the flight's frame; None: not requested.
        anew: by scanner, parameters measured anew from this flight or otherwise; None: not requested.
        why_not_anew: why there are none although they were requested.
        scanners: those whose calibrations were named; None: all.
    """

    control: Sequence[ControlPoint] | None = None
    anew: Mapping[str, Calibration] | None = None
    why_not_anew: str = ""
    scanners: Sequence[str] | None = None


def validate(
    flight: Flight,
    features: Features,
    calibrations: Mapping[str, Calibration],
    asked: Asked = Asked(),
    prior: TrajectoryPrior | None = None,
    rules: ControlRules | None = None,
) -> Validation:
    """Validate calibrations by all methods that the flight allows.

    Args:
        flight: placed with the calibrations.
        features: planes found in it that no adjustment behind the calibrations has used.
        calibrations: by scanner, the ones to validate.
        asked: additional requests.
        prior: errors of the flight's trajectories from navigation; None: from the trajectories' sigmas. These do not
            tell how errors of one strip correlate with those of the next: comparisons of strips assume no correlation,
            and comparisons with control the one of `Taus`, so that each expects the larger errors.
        rules: of control.
    """
    apart, along = _by_sigmas(with_sigmas(flight)) if prior is None else (prior, prior)
    rows = plane_rows(flight, features, calibrations, apart)
    classes = _classes(flight, rows)
    rows = replace(rows, floor_m=estimated_floor_m(rows.take(rows.independent(classes["other"]))))
    found = {name: _of_rows(name, rows, which) for name, which in classes.items()}
    found["testfield"] = _testfield(flight, asked.control or (), calibrations, rules or ControlRules(), along)
    found["measurementActualParameters"] = _anew(calibrations, asked.anew)
    validation = Validation(tuple(found[name] for name in CODES))
    return replace(validation, undone=_undone(flight, validation, found, asked))


def _by_sigmas(flight: Flight) -> tuple[TrajectoryPrior, TrajectoryPrior]:
    """Return two priors from trajectories' sigmas: with independent strips and some wander, and with joint strips."""
    along = gauss_markov(flight, knot_s=KNOT_S)
    strips = np.repeat(along.trajectory_index * (along.strip.max() + 1) + along.strip, ERRORS)
    wander = gauss_markov(flight, WANDER_TAUS, KNOT_S).covariance
    covariance = along.covariance * (strips[:, np.newaxis] == strips) + WANDER**2 * wander
    return replace(along, covariance=covariance), along


def with_sigmas(flight: Flight) -> Flight:
    """Return the flight with the sigmas `SIGMAS_M` and `SIGMAS_DEG` where its trajectories have none."""
    trajectories = []
    for one in flight.trajectories:
        position = np.where(np.isfinite(one.position_sigma_l), one.position_sigma_l, SIGMAS_M)
        attitude = np.where(np.isfinite(one.attitude_sigma_rad), one.attitude_sigma_rad, np.radians(SIGMAS_DEG))
        trajectories.append(replace(one, position_sigma_l=position, attitude_sigma_rad=attitude))
    return replace(flight, trajectories=tuple(trajectories))


def _undone(flight: Flight, validation: Validation, found: Mapping[str, Method], asked: Asked) -> tuple[str, ...]:
    """Return one line for each request that could not be fulfilled."""
    lines = []
    if asked.control is not None and found["testfield"].passed is None:
        lines.append(f"control: {_why(found['testfield'])}")
    if asked.anew is not None and found["measurementActualParameters"].passed is None:
        lines.append(
            f"independently measured parameters: {asked.why_not_anew or _why(found['measurementActualParameters'])}"
        )
    if len(flight.trajectories) > 1 and found["secondFlight"].passed is None:
        lines.append(
            f"{len(flight.trajectories)} flights: two of them share fewer than {FEWEST} distances between planes"
        )
    if validation.passed is not None:
        seen = {one.scanner for one in validation.detectable if one.seen}
        wanted = [head.name for head in flight.heads] if asked.scanners is None else asked.scanners
        lines += [f"{name}: no method would detect an error of its calibration" for name in wanted if name not in seen]
    return tuple(lines)


def _why(method: Method) -> str:
    return method.sentence.partition("not applied: ")[2]


def same_logs(calibration: Calibration, logs: Sequence[tuple[str, str]]) -> tuple[str, ...]:
    """Return a sentence for each log (name, SHA-256) from which the calibration was made."""
    used = {entry.get("sha256", ""): entry.get("name", "") for entry in calibration.header.get("logs", [])}
    return tuple(
        f"{name}: calibration {calibration.id} was made from this log, so this validation is not independent"
        for name, sha256 in logs
        if sha256 in used
    )


# ---------------------------------------------------------------------- planes


def _classes(flight: Flight, rows: Rows) -> dict[str, BoolArray]:
    """Return masks of the rows that belong to each method."""
    headings, heights = _flown_so(flight)
    first, second = rows.first, rows.second
    if not len(rows):
        none = np.zeros(0, bool)
        return dict.fromkeys(WORDS, none)
    apart = np.abs((headings[first] - headings[second] + 90.0) % 180.0 - 90.0)
    ratio = np.maximum(heights[first], heights[second]) / np.minimum(heights[first], heights[second])
    trajectory_index = np.array([swath.trajectory_index for swath in flight.swaths])
    return {
        "crossStripFlight": apart >= CROSSING_DEG,
        "secondFlight": trajectory_index[first] != trajectory_index[second],
        "secondAltitude": ratio >= HEIGHTS_RATIO,
        "other": np.ones(len(rows), bool),
    }


def _flown_so(flight: Flight) -> tuple[FloatArray, FloatArray]:
    """Return headings (swaths,), degrees, and heights above their points, metres."""
    headings, heights = np.zeros(len(flight.swaths)), np.ones(len(flight.swaths))
    for index, swath in enumerate(flight.swaths):
        if not len(swath):
            continue
        trajectory = flight.trajectories[swath.trajectory_index]
        within = trajectory.between(int(swath.time_ns[0]), int(swath.time_ns[-1]))
        way = within.velocity_l().mean(axis=0)
        headings[index] = math.degrees(math.atan2(way[1], way[0])) % 360.0
        ground = float(np.nanmedian(swath.points_t[:: max(len(swath) // 1000, 1), 2]))
        heights[index] = max(float(np.median(geodetic_from_e(within.position_e)[2])) - ground, 1.0)
    return headings, heights


def _of_rows(name: str, every: Rows, which: BoolArray) -> Method:
    rows, tested = every.take(which), every.take(every.independent(which))
    if len(tested) < FEWEST:
        return Method(name, None, (), f"{name} ({CODES[name]}): not applied: {WANTS[name]}")
    numbers, tests = Numbers.of(rows.value_m), distance_tests(tested)
    smallest = smallest_errors(tested)
    pairs = len({*zip(rows.first.tolist(), rows.second.tolist(), strict=True)})
    what = f"{WORDS[name]}: {numbers.count:,} distances on {len(set(rows.name)):,} planes, {pairs} pairs"
    return Method(name, numbers, tests, _sentence(name, what, numbers, tests), {"pairs": pairs}, smallest)


def distance_tests(rows: Rows) -> tuple[Test, ...]:
    """Test values against their expected covariance: χ², z of their mean (generalised least squares), and effects.

    For n independent values χ² = dᵀ C⁻¹ d has n degrees of freedom, and

        mean = (1ᵀ C⁻¹ d) / (1ᵀ C⁻¹ 1)      z = mean · √(1ᵀ C⁻¹ 1)
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
    return (*found, *_effects_tests(whitened[:, 0], np.linalg.solve(factor, rows.effects)))


def _effects_tests(values: FloatArray, effects: FloatArray) -> tuple[Test, Test]:
    """Return χ² of the part of whitened values (n,) that effects (n, m) explain, and z of the best single effect."""
    length = np.linalg.norm(effects, axis=0)
    seen = np.flatnonzero(length > 1e-9 * length.max())
    unit = effects[:, seen] / length[seen]
    left, singular, _ = np.linalg.svd(unit, full_matrices=False)
    within = left[:, singular > 1e-3].T @ values
    alone = np.abs(unit.T @ values)
    name = EFFECTS[seen[int(alone.argmax())] % len(EFFECTS)].name
    squares, freedom, best = float(within @ within), len(within), float(alone.max())
    words = f"as an error of {name} would leave ({best:.1f} σ)"
    chance = min(1.0, 2.0 * len(seen) * float(stats.norm.sf(best)))
    together = Test("effects", squares, float(freedom), float(stats.chi2.sf(squares, freedom)), words)
    return together, Test("effect", best, 1.0, chance, words)


def smallest_errors(rows: Rows) -> tuple[Detectable, ...]:
    """Return, for every effect of every scanner, the smallest error that the test ``effect`` detects with `POWER`.

    A unit of it moves the whitened values by g, so that δ = (z₁₋α′⁄₂ + z_power) / |g|, α′ = `ALPHA` over the number of
    effects that are seen (Baarda 1968, the power of the other side neglected).
    """
    if not rows.effects.any():
        return ()
    moved = np.linalg.solve(np.linalg.cholesky(rows.covariance()), rows.effects)
    length = np.linalg.norm(moved, axis=0)
    seen = length > 1e-9 * length.max()
    shift = float(stats.norm.isf(ALPHA / 2.0 / seen.sum()) + stats.norm.ppf(POWER))
    return tuple(
        Detectable(head, effect.parameter, shift / value if there else math.inf)
        for (head, effect), value, there in zip(
            ((head, effect) for head in rows.heads for effect in EFFECTS), length.tolist(), seen.tolist(), strict=True
        )
    )


def _sentence(name: str, what: str, numbers: Numbers, tests: Sequence[Test]) -> str:
    values = (
        f"mean {number(100 * numbers.mean_m, '+.1f')} cm, std {100 * numbers.std_m:.1f}, "
        f"RMS {100 * numbers.rms_m:.1f}, largest {100 * numbers.max_m:.1f}"
    )
    chi2, mean = tests[:2]
    if len(tests) > 2 and not tests[2].passed:
        verdict = f"{tests[2].words}: χ² {tests[2].value:,.0f} of {tests[2].freedom:,.0f}, {p_words(tests[2].p)}"
    elif len(tests) > 3 and not tests[3].passed:
        verdict = f"{tests[3].words}: {p_words(tests[3].p)}"
    elif not chi2.passed:
        verdict = f"more than expected (χ² {chi2.value:,.0f} of {chi2.freedom:,.0f}, {p_words(chi2.p)})"
    elif not mean.passed:
        verdict = f"the mean is not zero (z {number(mean.value, '.1f')}, {p_words(mean.p)})"
    elif stats.chi2.cdf(chi2.value, chi2.freedom) < ALPHA:
        verdict = (
            f"less than expected (χ² {chi2.value:,.0f} of {chi2.freedom:,.0f}): the trajectory's sigmas are larger "
            "than its errors, so the test is less sensitive than it could be"
        )
    else:
        verdict = f"as expected (χ² {chi2.value:,.0f} of {chi2.freedom:,.0f}, {p_words(chi2.p)})"
    return f"{name} ({CODES[name]}): {what}: {values}: {verdict}"


# ---------------------------------------------------------------------- control, parameters


def _testfield(
    flight: Flight,
    control: Sequence[ControlPoint],
    calibrations: Mapping[str, Calibration],
    rules: ControlRules,
    prior: TrajectoryPrior,
) -> Method:
    rows = control_rows(flight, control, calibrations, replace(rules, farthest_m=math.inf), prior)
    if len(rows) < FEWEST:
        why = (
            WANTS["testfield"]
            if not control
            else f"strips see control {len(rows)} times only; {FEWEST} or more are needed"
        )
        return Method("testfield", None, (), f"testfield ({CODES['testfield']}): not applied: {why}")
    numbers, tests = Numbers.of(rows.value_m), distance_tests(rows)
    what = f"laser above control: {numbers.count:,} distances at {len(set(rows.name))} points"
    sentence = _sentence("testfield", what, numbers, tests)
    residuals: dict[str, list[float]] = {}
    for name, value in zip(rows.name, rows.value_m.tolist(), strict=True):
        residuals.setdefault(name, []).append(value)
    more = {"points": len(residuals), "residuals_m": residuals}
    return Method("testfield", numbers, tests, sentence, more, smallest_errors(rows))


def _anew(calibrations: Mapping[str, Calibration], anew: Mapping[str, Calibration] | None) -> Method:
    name = "measurementActualParameters"
    compared: list[tuple[str, Compared]] = []
    for scanner in sorted(set(calibrations) & set(anew or {})):
        assert anew is not None
        compared.append((scanner, compare(calibrations[scanner], anew[scanner])))
    compared = [one for one in compared if one[1].freedom]
    if not compared:
        return Method(name, None, (), f"{name} ({CODES[name]}): not applied: {NOT_BOTH if anew else WANTS[name]}")
    squares, freedom = sum(one.chi2 for _, one in compared), sum(one.freedom for _, one in compared)
    test = Test("chi2", squares, float(freedom), float(stats.chi2.sf(squares, freedom)))
    rows = [row for _, one in compared for row in one.rows]
    largest = max(rows, key=lambda row: abs(row.difference) / row.sigma)
    verdict = "agree with the calibration" if test.passed else "do not agree with the calibration"
    sentence = (
        f"{name} ({CODES[name]}): {freedom} independently measured parameters {verdict} (χ² {squares:.1f} of "
        f"{freedom}, {p_words(test.p)}); largest: {largest.words}"
    )
    shift = math.sqrt(_noncentrality(freedom))
    smallest = tuple(
        Detectable(scanner, row.name, shift / math.sqrt(weight))
        for scanner, one in compared
        for row, weight in zip(one.rows, one.weights, strict=True)
    )
    return Method(name, None, (test,), sentence, {"parameters": [row.record() for row in rows]}, smallest)


def _noncentrality(freedom: int) -> float:
    """Return λ with which χ² with ``freedom`` degrees of freedom fails at `ALPHA` with `POWER`."""
    limit = float(stats.chi2.isf(ALPHA, freedom))
    return float(optimize.brentq(lambda size: float(stats.ncx2.sf(limit, freedom, size)) - POWER, 1.0, 1e4))
