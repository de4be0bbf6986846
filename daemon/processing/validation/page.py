"""Writes the page of a validation: verdict, each method with figures and limits, errors that would be missed."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from scipy import stats

from swath.calib.labels import decimals_of, number, p_words, thousands, worded, words_of
from swath.calib.validation.history import History
from swath.calib.validation.methods import (
    ALPHA,
    POWER,
    WANTS,
    WORDS,
    Detectable,
    Method,
    Test,
    Validation,
)
from swath.daemon.processing.carried_verdict import Carried
from swath.daemon.processing.pages.blocks import (
    Block,
    Card,
    Cell,
    Image,
    Judged,
    Notes,
    Table,
    Words,
    data_uri,
    reasons_of,
)
from swath.daemon.processing.pages.head import PageHead
from swath.daemon.processing.pages.render import Page, html_of
from swath.georef.scanner.calibration import INDEX, PARAMETERS
from swath.georef.verdicts import Level, Reason, Verdict, worst_first

COMPARED = {
    **WORDS,
    "testfield": "laser above control points",
    "measurementActualParameters": "parameters, measured anew",
}
TESTS = {
    "chi2": "χ² of all distances",
    "z": "size of their mean, in sigmas",
    "effects": "χ² of the part that errors of the calibration explain",
    "effect": "largest single error, in sigmas",
}
HOW = (
    "Every distance is tested against its expected covariance: noise of the planes, errors of the trajectory with "
    "their correlation along the strips, and the sigmas of the calibration itself. A test fails where chance alone "
    f"gives a larger figure in less than {ALPHA:g} of all cases; the limit of p is therefore {ALPHA:g}."
)


def validation_page(
    heading: str,
    head: PageHead,
    validation: Validation | None,
    histories: Sequence[History],
    carried: Sequence[Carried],
    notes: Sequence[str],
    picture: bytes | None,
) -> str:
    """Return the HTML text of the page.

    Args:
        heading: name of the calibrations.
        head: flight and calibrations.
        validation: result against logs; None: not made.
        histories: earlier calibrations of the installations.
        carried: verdicts on the inputs, other than good.
        notes: for the reader, one sentence each.
        picture: PNG of the histories; None: there are none.
    """
    verdict = verdict_of(validation, histories, carried)
    blocks: list[Block] = [
        *reasons_of(verdict),
        *_notes(notes, validation),
        *([] if validation is None else [*_methods(validation), *_detectable(validation)]),
        *_histories(histories, picture),
    ]
    appendix: list[Block] = [] if validation is None else [*_tests(validation), Words(HOW, "How it was tested")]
    cards = _cards(validation, histories)
    return html_of(Page("Validation", heading, head, blocks, verdict, cards, title=heading, appendix=appendix))


def verdict_of(validation: Validation | None, histories: Sequence[History], carried: Sequence[Carried]) -> Verdict:
    """Return the verdict on calibrations by all tests that were made."""
    reasons = [one.reason for one in carried]
    words = []
    if validation is not None:
        words.append(validation.summary)
        failed = [method for method in validation.methods if method.passed is False]
        remedy = "calibrate again; until then do not use the calibration"
        reasons += [Reason(Level.UNUSABLE, one.name, _failure(one), remedy, 2.0) for one in failed]
        reasons += [Reason(Level.CARE, "undone", f"not done as requested: {one}", "", 1.0) for one in validation.undone]
        if validation.passed is None:
            reasons.append(Reason(Level.CARE, "nothing", "no method could be applied", "give other logs, or control"))
        reasons += [
            Reason(Level.CARE, "logs", one, "validate with a flight of its own") for one in validation.dependent
        ]
    for one in histories:
        words += one.sentences
        if one.moved:
            what = f"the boresight of {one.scanner} has moved"
            reasons.append(Reason(Level.UNUSABLE, "moved", what, "fasten the scanner and calibrate again", 3.0))
    worst, ordered = worst_first(reasons)
    return Verdict(worst, f"{worst.heading}: {'; '.join(words)}.", ordered)


def _notes(notes: Sequence[str], validation: Validation | None) -> list[Block]:
    """Return the notes that are not among the reasons."""
    shown = [note for note in notes if "--record" not in note]  # how to call the command again is no reader's matter
    shown = [note for note in shown if validation is None or note not in validation.dependent]
    return [Notes(shown)] if shown else []


def _cards(validation: Validation | None, histories: Sequence[History]) -> list[Card]:
    cards: list[Card] = []
    if validation is not None:
        applied = [method for method in validation.methods if method.passed is not None]
        passed = sum(method.passed is True for method in applied)
        cards.append((f"{passed} of {len(applied)}", "methods passed, of those that could be applied"))
        for method in applied:
            if method.numbers is not None:
                cards.append((f"{_cm(method.numbers.rms_m)} cm", f"RMS, {COMPARED[method.name]}"))
    cards += [(str(len(one.entries)), f"calibrations of {one.scanner} compared") for one in histories]
    return cards


def _cm(metres: float, pattern: str = ".1f") -> str:
    return number(100.0 * metres, pattern)


def _methods(validation: Validation) -> list[Block]:
    """Return a table of the methods with their deciding tests, the first that fails, and one of those not applied."""
    rows: list[list[Cell]] = []
    missing: list[list[Cell]] = []
    for method in validation.methods:
        if method.passed is None:
            why = method.sentence.partition("not applied: ")[2] or WANTS[method.name]
            missing.append([COMPARED[method.name], method.code, why])
            continue
        test = next((one for one in method.tests if not one.passed), method.tests[0])
        numbers = method.numbers
        sizes = ["–"] * 5
        if numbers is not None:
            sizes = [thousands(numbers.count), _cm(numbers.mean_m, "+.1f")]
            sizes += [_cm(value) for value in (numbers.std_m, numbers.rms_m, numbers.max_m)]
        verdict = Judged("passed" if method.passed else "failed", bool(method.passed))
        rows.append([COMPARED[method.name], method.code, *sizes, *_figures(test), verdict])
    heads = ("method", "code", "distances", "mean, cm", "std, cm", "RMS, cm", "largest, cm", "figure", "limit", "p")
    under = (
        "Codes: ISO/TS 19159-2, 6.8. Figure and limit are those of the test that failed, otherwise of "
        f"{TESTS['chi2']}; the appendix has all tests."
    )
    tables: list[Block] = [Table("Methods", (*heads, "verdict"), rows, under)] if rows else []
    if missing:
        tables.append(Table("Methods not applied", ("method", "code", "why"), missing, left=(0, 2)))
    return tables


def _failure(method: Method) -> str:
    """Return in words how a method failed."""
    test = next(one for one in method.tests if not one.passed)
    size = "" if method.numbers is None else f"RMS {_cm(method.numbers.rms_m)} cm, "
    best = next((one.words for one in method.tests if one.words and not one.passed), "")
    return f"{COMPARED[method.name]}: {size}{best or f'{TESTS[test.kind]} beyond the limit'}"


def _figures(test: Test) -> list[str]:
    """Return figure, limit and p of a test."""
    digits, limit = 0 if abs(test.value) >= 100.0 else 1, _limit(test)
    most = "–" if limit is None else f"≤ {thousands(limit, digits)}"
    return [thousands(abs(test.value), digits), most, p_words(test.p).removeprefix("p ")]


def _limit(test: Test) -> float | None:
    """Return the value that a test may reach; None for a test whose p depends on the number of errors tried."""
    if test.kind in ("chi2", "effects"):
        return float(stats.chi2.isf(ALPHA, test.freedom))
    return float(stats.norm.isf(ALPHA / 2.0)) if test.kind == "z" else None


def _tests(validation: Validation) -> list[Block]:
    """Return a table of all tests of all methods that were applied."""
    rows: list[list[Cell]] = [
        [
            COMPARED[method.name],
            TESTS[test.kind],
            thousands(test.freedom) if test.kind in ("chi2", "effects") else "–",
            *_figures(test),
            Judged("passed" if test.passed else "failed", test.passed),
        ]
        for method in validation.methods
        for test in method.tests
    ]
    heads = ("method", "test", "degrees of freedom", "figure", "limit", "p", "verdict")
    return [Table("All tests", heads, rows, left=(0, 1, 6))] if rows else []


def _detectable(validation: Validation) -> list[Block]:
    """Return a table of the smallest errors that the tests would have detected."""
    found = validation.detectable
    several = len({one.scanner for one in found}) > 1
    rows = [[words_of(one.scanner, one.parameter, several=several), _size(one)] for one in found]
    under = (
        f"A single error of this size would have failed a test with a probability of {100 * POWER:.0f} %; "
        "smaller ones may remain unseen."
    )
    return [Table("Smallest errors that would be detected", ("parameter", "error"), rows, under)] if rows else []


def _size(one: Detectable) -> str:
    parameter = PARAMETERS[INDEX[one.parameter]]
    ending = parameter.key.rpartition("_")[2]
    unit = {"deg": "°", "us": "µs", "us2": "µs²"}.get(ending, ending)
    if not one.seen:
        return "none would be detected"
    size = float(f"{one.size / parameter.factor:.2g}")
    return f"{number(size, f'.{decimals_of(size)}f')}{'' if unit == '°' else ' '}{unit}"


def _histories(histories: Iterable[History], picture: bytes | None) -> list[Block]:
    """Return a table of the boresight in all calibrations of each installation, and the picture of all."""
    blocks: list[Block] = []
    keys = ("omega_deg", "phi_deg", "kappa_deg")
    for one in histories:
        rows = [
            [row["id"], row["flown"], *(_with_sigma(row[key], row[f"{key}_sigma"]) for key in keys)]
            for row in one.table()
        ]
        heads = ("calibration", "flown", "ω, °", "φ, °", "κ, °")
        title = f"Calibrations of {one.scanner}" + (f", {one.installation}" if one.installation else "")
        under = " ".join(f"{line[0].upper()}{line[1:]}." for line in one.sentences)
        blocks += [Table(title, heads, rows, worded(under))]
    return [*blocks, *([Image("Boresight over time", data_uri(picture, "image/png"))] if picture else [])]


def _with_sigma(value: float, sigma: float | None) -> str:
    """Return a value with its sigma; a value without one has four decimals."""
    if not sigma:
        return number(value, ".4f")
    pattern = f".{decimals_of(sigma)}f"
    return f"{number(value, pattern)} ± {number(sigma, pattern)}"
