"""Writes the outcome of a calibration as lines: parameters, fit, strips, notes, and the verdict last."""

from __future__ import annotations

import math
from collections.abc import Sequence

from swath.calib.labels import number
from swath.calib.outcome import Adjusted
from swath.calib.profiles.check import Check
from swath.calib.summary import ReportInput
from swath.calib.verdict import held_words
from swath.daemon.processing.calibration.model import key_of
from swath.daemon.processing.calibration.report.tables import ParameterRow, entry_rows, parameter_rows
from swath.daemon.processing.calibration.run import Calibrated
from swath.daemon.processing.strip_agreement import FlightStrips
from swath.georef.verdicts import Verdict

ALIGNED = "pre-aligned"
HEADS = ("unit", "start", ALIGNED, "found", "sigma")
WIDTHS = (34, 5, 13, 13, 13, 11)


def calibration_lines(
    done: Calibrated,
    report: ReportInput,
    knots: Sequence[float],
    strips: tuple[FlightStrips, FlightStrips],
    verdict: Verdict,
) -> list[str]:
    """Return the outcome as lines for people.

    Args:
        done: the calibration.
        report: the same as the report shows it.
        knots: intensities of the knots of the range correction.
        strips: before and after.
        verdict: on the calibration.
    """
    adjusted, after = done.adjusted, strips[1]
    lines = [*_parameter_lines(report, knots), *_held_lines(adjusted, knots)]
    planes, ties = len(done.features.planes), len(done.features.ties)
    seen = [f"{planes:,} planes", *([f"{ties:,} tie points"] if ties else [])]
    control = sum(len(plane.control) for plane in done.features.planes)
    used = f", {control} of {len(done.control)} control points" if done.control else ""
    fit = f"redundancy {adjusted.redundancy:,.0f}, variance factor {adjusted.variance_factor:.2f}"
    lines.append(f"{' and '.join(seen)}{used}, {fit}")
    rms = [f"{100.0 * one.rms_m:.1f} cm" if math.isfinite(one.rms_m) else "nothing" for one in strips]
    lines.append(f"strips differ by {rms[0]} (RMSDz) before, {rms[1]} after; {after.agreement.level_words}")
    lines.append(after.agreement.measure)
    lines += _profile_lines(done.check)
    lines += [f"note: {note}" for note in done.notes]
    return [*lines, verdict.sentence, *(f"also: {reason.what}" for reason in verdict.reasons[1:])]


def _parameter_lines(report: ReportInput, knots: Sequence[float]) -> list[str]:
    """Return the table of parameters, the same as in the report: digits by the sigmas, held ones marked."""
    rows = [row for scanner in report.adjusted.calibrations for row in parameter_rows(report, scanner)]
    rows += entry_rows(report)
    aligned = any(row.first is not None for row in rows)
    return [_line(("parameter", *HEADS), aligned=aligned), *(_row(row, knots, aligned=aligned) for row in rows)]


def _row(row: ParameterRow, knots: Sequence[float], *, aligned: bool) -> str:
    name = f"{row.one.scanner}.{key_of(row.one.name, knots)[0]}"
    if not row.state:
        cells = (row.text(row.start), row.text(row.first), row.text(row.value), row.sigma_text)
        return _line((name, row.one.unit, *cells), aligned=aligned)
    state = row.state if row.sigma <= 0.0 else f"{row.state}, ± {row.sigma_text}"
    line = _line((name, row.one.unit, row.text(row.start), row.text(row.first), "", ""), aligned=aligned)
    return f"{line.rstrip()}  {state}"


def _line(cells: Sequence[str], *, aligned: bool) -> str:
    """Return a line of the table; the column of the pre-alignment only if there was one."""
    kept = [at for at, head in enumerate(("", *HEADS)) if aligned or head != ALIGNED]
    first, unit, *rest = kept
    words = f"{cells[first]:{WIDTHS[first]}}{cells[unit]:{WIDTHS[unit]}}"
    return words + "".join(f"{cells[at]:>{WIDTHS[at]}}" for at in rest)


def _held_lines(adjusted: Adjusted, knots: Sequence[float]) -> list[str]:
    """Return why parameters were not estimated, and which of the held ones may be wrong."""
    lines = []
    for held in adjusted.held:
        remedy = f"; {held.remedy}" if held.remedy else ""
        lines.append(f"not estimated: {held.scanner} {key_of(held.name, knots)[0]}: {held.why}{remedy}")
    return [*lines, *(f"held: {words}" for words in held_words(adjusted))]


def _profile_lines(check: Check) -> list[str]:
    differences = [
        f"{one.scanner}.{key_of(one.parameter)[0]} {number(one.normalised, '+.1f')}" for one in check.comparisons
    ]
    return [f"profiles less adjustment, in sigmas: {', '.join(differences)}"] if differences else []
