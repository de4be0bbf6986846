"""Judge whether a calibration may be used: a table of limits on its figures, and a sentence."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from swath.calib.labels import (
    degrees,
    is_undetermined,
    length,
    listed,
    number,
    share,
    sized,
    unknown,
    with_sigma,
    words_of,
)
from swath.calib.outcome import Adjusted, Considered
from swath.calib.summary import Difference, Pair, ReportInput
from swath.georef.verdicts import Level, Reason, Rule, Verdict, worst_first

DEG = 180.0 / math.pi
BORESIGHT = ("omega_rad", "phi_rad", "kappa_rad")
MOST_CORRELATED = 0.95
TOO_LARGE = 10.0  # ratio to the wanted sigma
# Wanted sigmas if the user sets none and the flight's points do not imply them
WANTED = {"omega_rad": 0.003 / DEG, "phi_rad": 0.003 / DEG, "kappa_rad": 0.006 / DEG, "range_offset_m": 0.02}


def overall_rms_m(pairs: Mapping[Pair, Difference]) -> float | None:
    """Return the root mean square over all cells of all pairs; None if nothing was compared."""
    cells = sum(one.count for one in pairs.values())
    return math.sqrt(sum(one.count * one.rms_m**2 for one in pairs.values()) / cells) if cells else None


def sigma_of(report: ReportInput, names: tuple[str, ...]) -> float | None:
    """Return the largest sigma (SI) of parameters of these names, estimated or held; None if they have no sigma."""
    adjusted = report.adjusted
    known = [s for n, s in zip(adjusted.names, adjusted.sigmas.tolist(), strict=True) if unknown(n).name in names]
    known += [one.sigma for one in adjusted.considered if one.name in names]
    return max(known, default=None)


def wanted_of(report: ReportInput) -> dict[str, float]:
    """Return the wanted sigmas (SI), by parameter's name."""
    required = {} if report.need is None else report.need.wanted
    return {**WANTED, **{name: sigma for name, sigma in required.items() if math.isfinite(sigma)}}


def held_words(adjusted: Adjusted) -> list[str]:
    """Return a sentence for each held parameter that would move an estimated one by more than its own sigma.

    An estimated parameter's own sigma is the one it would have if all held parameters were right.
    """
    several = len(adjusted.calibrations) > 1
    moved = adjusted.movements
    own = np.sqrt(np.maximum(adjusted.sigmas**2 - (moved**2).sum(axis=1), 0.0))
    found = []
    for column, one in enumerate(adjusted.considered):
        at = np.argsort(-np.abs(moved[:, column]) / np.maximum(own, 1e-300)).tolist()
        moves = [
            f"{unknown_words(adjusted.names[i], several)} by {sized(adjusted.names[i], abs(float(moved[i, column])))}"
            for i in at
            if abs(float(moved[i, column])) > own[i]
        ]
        if moves:
            found.append(f"{_held(one, several)}, which would move {listed(moves)}")
    return found


def unknown_words(name: str, several: bool) -> str:
    """Return the words for an unknown such as ``left.omega_rad``."""
    one = unknown(name)
    return words_of(one.scanner, one.name, several=several)


def _held(one: Considered, several: bool) -> str:
    """Describe a held parameter and its plausible error."""
    name = f"{one.scanner}.{one.name}"
    return f"{unknown_words(name, several)}, held, has a plausible error of {sized(name, one.sigma)}"


def undetermined(report: ReportInput) -> list[str]:
    """Return the words for the parameters that this flight does not determine."""
    several = len(report.adjusted.calibrations) > 1
    held = [one for one in report.adjusted.held if is_undetermined(one)]
    return [words_of(one.scanner, one.name, several=several) for one in held]


def _not_converged(report: ReportInput) -> Iterator[tuple[str, float]]:
    yield "", 0.0 if report.adjusted.converged else 1.0


def _no_redundancy(report: ReportInput) -> Iterator[tuple[str, float]]:
    yield number(report.adjusted.redundancy, ".0f"), 100.0 / max(report.adjusted.redundancy, 1e-9)


def _held_angles(report: ReportInput) -> Iterator[tuple[str, float]]:
    """Yield the held boresight angles, and the ratio of their largest uncertainty to the wanted sigma."""
    yield from _held_of(report, BORESIGHT)


def _held_range(report: ReportInput) -> Iterator[tuple[str, float]]:
    yield from _held_of(report, ("range_offset_m",))


def _held_of(report: ReportInput, names: tuple[str, ...]) -> Iterator[tuple[str, float]]:
    adjusted, wanted = report.adjusted, wanted_of(report)
    several = len(adjusted.calibrations) > 1
    sigmas = {(one.scanner, one.name): one for one in adjusted.considered}
    held = [one for one in adjusted.held if one.name in names]
    if not held:
        return
    words, worst = [], 1e-9
    for one in held:
        known = sigmas.get((one.scanner, one.name), Considered(one.scanner, one.name, 0.0, 0.0))
        words.append(_held(known, several))
        worst = max(worst, known.sigma / wanted[one.name])
    yield listed(words), worst


def _beyond_wanted(report: ReportInput) -> Iterator[tuple[str, float]]:
    """Yield estimated parameters with their sigmas and the wanted ones, and the ratio."""
    several = len(report.adjusted.calibrations) > 1
    wanted = wanted_of(report)
    for name, sigma in zip(report.adjusted.names, report.adjusted.sigmas.tolist(), strict=True):
        limit = wanted.get(unknown(name).name)
        if limit is not None:
            known = f"{unknown_words(name, several)} is known to {sized(name, sigma)} only"
            words = f"{known}, where {sized(name, limit)} is required"
            yield words, sigma / limit


def _points(report: ReportInput) -> Iterator[tuple[str, float]]:
    """Yield the errors that the calibration leaves in points, and their ratio to the wanted sigma."""
    need = report.need
    if need is None or not need.point_m > 0.0:
        return
    several = len(need.left_m) > 1
    for scanner, left_m in need.left_m.items():
        of = f" of {scanner}" if several else ""
        if math.isfinite(left_m):
            words = f"leaves {length(left_m)} in points{of}, where {length(need.point_m)} is required"
            yield words, left_m / need.point_m


def _contradicted(report: ReportInput) -> Iterator[tuple[str, float]]:
    """Yield held parameters that the flight contradicts."""
    several = len(report.adjusted.calibrations) > 1
    for one in report.adjusted.considered:
        if one.contradicted:
            name = f"{one.scanner}.{one.name}"
            named = unknown(name)
            text = with_sigma(named.factor * one.told, named.factor * one.told_sigma)
            gap = "" if named.unit == "°" else "\u00a0"
            change = f"{text}{gap}{named.unit}"
            yield f"the held value of {unknown_words(name, several)}: it would change the value by {change}", 1.0


def _profiles(report: ReportInput) -> Iterator[tuple[str, float]]:
    """Yield the differences between profiles and the adjustment, in sigmas of the difference."""
    several = len(report.adjusted.calibrations) > 1
    for one in () if report.check is None else report.check.comparisons:
        name = f"{one.scanner}.{one.parameter}"
        apart = sized(name, one.told - one.adjusted, sign=True)
        sigmas = number(one.normalised, "+.1f")
        yield (
            f"{one.profiles} profiles put {unknown_words(name, several)} {apart} from the adjustment ({sigmas} sigmas)",
            abs(one.normalised),
        )


def _variance(report: ReportInput) -> Iterator[tuple[str, float]]:
    yield "", report.adjusted.variance_factor


def _variance_small(report: ReportInput) -> Iterator[tuple[str, float]]:
    yield number(report.adjusted.variance_factor, ".2f"), 1.0 / max(report.adjusted.variance_factor, 1e-9)


def _rejected(report: ReportInput) -> Iterator[tuple[str, float]]:
    for group in report.adjusted.groups:
        yield group.group, group.rejected / max(group.observations, 1)


def _beyond_prior(report: ReportInput) -> Iterator[tuple[str, float]]:
    adjusted = report.adjusted
    several = len(adjusted.calibrations) > 1
    change = np.abs(adjusted.values - adjusted.start)
    for i, name in enumerate(adjusted.names):
        prior = float(adjusted.prior_sigmas[i])
        if math.isfinite(prior) and prior > 0.0:
            one = unknown(name)
            yield words_of(one.scanner, one.name, several=several), float(change[i]) / prior


def _strips(report: ReportInput) -> Iterator[tuple[str, float]]:
    rms_m = overall_rms_m(dict(report.after))
    if rms_m is not None:
        yield "", rms_m


def _worse(report: ReportInput) -> Iterator[tuple[str, float]]:
    before_m, after_m = overall_rms_m(dict(report.before)), overall_rms_m(dict(report.after))
    if before_m and after_m:
        yield f"{length(before_m)} before, {length(after_m)} after", after_m / before_m


def _control(report: ReportInput) -> Iterator[tuple[str, float]]:
    for point in report.adjusted.control:
        yield f"{point.name} ({length(point.misclosure_m)})", abs(point.normalised)


def _influence(report: ReportInput) -> Iterator[tuple[str, float]]:
    several = len(report.adjusted.calibrations) > 1
    for point in report.adjusted.control:
        if point.influence:
            name, moved = max(point.influence.items(), key=lambda item: abs(item[1]))
            one = unknown(name)
            yield f"{point.name} moves {words_of(one.scanner, one.name, several=several)}", abs(moved)


def _trajectory(report: ReportInput) -> Iterator[tuple[str, float]]:
    fit = report.adjusted.trajectory
    if fit is not None and len(fit.time_ns):
        for words, value, prior in (
            ("positions", fit.position_l, fit.prior_position_sigma_l),
            ("attitude", fit.attitude_rad, fit.prior_attitude_sigma_rad),
        ):
            known = prior > 0.0
            if known.any():
                yield words, float(np.sqrt(np.mean((value[known] / prior[known]) ** 2)))


def _correlated(report: ReportInput) -> Iterator[tuple[str, float]]:
    """Yield pairs of parameters of which only the sum is known.

    Scanners whose points are as accurate as wanted are left out: for them the sum suffices.
    """
    adjusted, need = report.adjusted, report.need
    left_m = {} if need is None else need.left_m
    enough = {scanner for scanner, left in left_m.items() if need is not None and left <= need.point_m}
    several = len(adjusted.calibrations) > 1
    at = [i for i, name in enumerate(adjusted.names) if unknown(name).is_parameter]
    known = [unknown(adjusted.names[i]) for i in at]
    words = [words_of(one.scanner, one.name, several=several) for one in known]
    matrix = np.abs(adjusted.correlation[np.ix_(at, at)])
    for i, j in np.argwhere(np.triu(matrix, 1) > MOST_CORRELATED):
        if not {known[i].scanner, known[j].scanner} <= enough:
            yield f"{words[i]} and {words[j]}", float(matrix[i, j])


def _sigmas_words(value: float) -> str:
    return number(value, ".1f")


RULES: tuple[Rule[ReportInput], ...] = (
    Rule(
        "not converged",
        _not_converged,
        None,
        0.5,
        "the adjustment did not converge{of}",
        "start from a better calibration (pre-alignment), or look for wrong matches",
    ),
    Rule(
        "redundancy",
        _no_redundancy,
        1.0,
        10.0,
        "there are only {of} observations more than unknowns",
        "fly over more roofs and slopes, with more overlap of lines",
    ),
    Rule(
        "held angles",
        _held_angles,
        0.0,
        TOO_LARGE,
        "the boresight is not calibrated: {of}",
        "fly the lines or measure the control listed below under Not determined",
    ),
    Rule(
        "held range",
        _held_range,
        1.0,
        None,
        "{of}",
        "measure control on flat, hard ground (at least 8 points of 1 cm)",
    ),
    Rule(
        "wanted sigma",
        _beyond_wanted,
        1.0,
        TOO_LARGE,
        "{of}",
        "fly more of the lines that determine it, or set [calibration] wanted if a lower accuracy is enough",
    ),
    Rule(
        "points",
        _points,
        1.0,
        TOO_LARGE,
        "the calibration {of}",
        "add lines, control or flying heights, or set [calibration] wanted if a lower accuracy is enough",
    ),
    Rule(
        "contradicted",
        _contradicted,
        0.5,
        None,
        "the flight contradicts {of}",
        "free it (--free), or set its true value",
    ),
    Rule(
        "profiles",
        _profiles,
        2.9,
        8.0,
        "{of}",
        "see the profiles below: which pairs differ, and whether all differ with the same sign",
    ),
    Rule(
        "variance factor",
        _variance,
        2.0,
        9.0,
        "residuals are larger than their sigmas predict (variance factor {value})",
        "check the noise settings of scanner and trajectory; see below where residuals are large",
        number,
    ),
    Rule(
        "variance factor small",
        _variance_small,
        4.0,
        None,
        "residuals are far smaller than their sigmas predict (variance factor {of})",
        "lower the stated noise of scanner or trajectory; the sigmas here are too large",
    ),
    Rule(
        "rejected",
        _rejected,
        0.05,
        0.4,
        "{value} of the observations ({of}) were rejected as outliers",
        "see below on which planes, in which strips and at which angles they lie",
        share,
    ),
    Rule(
        "beyond prior",
        _beyond_prior,
        3.3,
        10.0,
        "{of} has moved by {value} times its prior sigma",
        "check the measurement on the ground, or set a larger prior sigma",
        _sigmas_words,
    ),
    Rule(
        "strips",
        _strips,
        0.08,
        0.5,
        "strips differ by {value} (RMSDz) after the calibration",
        "see below which pairs differ: a strip that differs from all others has a bad trajectory",
        length,
    ),
    Rule(
        "strips worse",
        _worse,
        1.05,
        1.5,
        "strips agree less well than before ({of})",
        "see below which pairs do, and the outliers",
    ),
    Rule(
        "control",
        _control,
        3.29,
        10.0,
        "control point {of} is {value} sigmas off",
        "check its height system (ellipsoidal?), its position and the vegetation on it, or leave it out",
        _sigmas_words,
    ),
    Rule(
        "control influence",
        _influence,
        1.5,
        6.0,
        "leaving out control point {of} by {value} sigmas",
        "measure more control: no parameter should depend on a single point",
        _sigmas_words,
    ),
    Rule(
        "trajectory",
        _trajectory,
        1.6,
        4.0,
        "corrections of the trajectory's {of} are {value} times the value that its sigmas predict",
        "process the trajectory again; its sigmas are too small",
        _sigmas_words,
    ),
    Rule(
        "correlated",
        _correlated,
        MOST_CORRELATED,
        None,
        "{of} can hardly be separated (correlation {value})",
        "fly a second height or speed, or hold one of them",
        number,
    ),
)


def judge(report: ReportInput) -> Verdict:
    """Judge the calibration of a report."""
    reasons = [reason for rule in RULES for reason in rule.judged(report)]
    reasons += [
        Reason(Level.UNUSABLE if one.unusable else Level.CARE, "finding", one.what, one.change, one.excess)
        for one in report.findings
    ]
    level, ordered = worst_first(reasons)
    return Verdict(level, _sentence(level, report, ordered), ordered)


def accuracy_words(report: ReportInput) -> str:
    """Return sigmas and agreement of strips in words."""
    boresight, offset_m = sigma_of(report, BORESIGHT), sigma_of(report, ("range_offset_m",))
    words = [f"boresight to {degrees(boresight * DEG)}"] if boresight is not None else []
    words += [f"range offset to {length(offset_m)}"] if offset_m is not None else []
    rms_m = overall_rms_m(dict(report.after))
    accuracy = ", ".join(words) or "the model has neither boresight nor range offset"
    return accuracy + (f"; strips agree to {length(rms_m)} (RMSDz)" if rms_m is not None else "")


def _sentence(level: Level, report: ReportInput, reasons: Sequence[Reason]) -> str:
    accuracy, missing = accuracy_words(report), undetermined(report)
    tail = f" Not determined by this flight: {listed(missing)}." if missing else ""
    if level is Level.GOOD:
        return f"{level.heading}: {accuracy}.{tail}"
    return f"{level.heading}: {reasons[0].what}. {accuracy[0].upper()}{accuracy[1:]}.{tail}"
