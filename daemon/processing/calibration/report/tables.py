"""Builds the tables of a report as rows of words, the same for HTML and PDF."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from swath.calib.labels import (
    Unknown,
    decimals_of,
    is_undetermined,
    length,
    number,
    plain,
    share,
    thousands,
    unknown,
    words_of,
)
from swath.calib.outcome import FixedParameter, Residuals
from swath.calib.parameters import ANGLES
from swath.calib.summary import ReportInput
from swath.calib.verdict import held_words
from swath.daemon.processing.calibration.report.pictures import SUSPECT
from swath.daemon.processing.pages.blocks import Table
from swath.georef.arrays import BoolArray
from swath.georef.scanner.calibration import INDEX, PARAMETERS

MOST_ROWS = 25
INSIGNIFICANT = 2.0
SAME_RAD = 1e-6  # a pre-alignment by less has changed nothing
UNITLESS = ("priors", "trajectory")  # their observations are of several units
OBSERVED = {"range_m": "one range", "ties": "one coordinate of a tie point", "control": "one control point"}


@dataclass(frozen=True, slots=True)
class ParameterRow:
    """A parameter or an entry of a table, in the unit of reports.

    Attributes:
        one: its words and unit.
        start, first: the value given, and the one that the pre-alignment found; None: it was not pre-aligned.
        value: as found, or as held.
        sigma: of the value; of a held one: its plausible error, 0 if it has none.
        prior: sigma before the adjustment.
        state: ``held``, ``not determined``; empty: it was estimated.
    """

    one: Unknown
    start: float
    first: float | None
    value: float
    sigma: float
    prior: float
    state: str = ""

    @property
    def pattern(self) -> str:
        """Format of its values: to the place of the sigma's second digit."""
        return f".{decimals_of(self.sigma)}f" if self.sigma > 0.0 else ".6g"

    def text(self, value: float | None) -> str:
        """Return a value to the place of the sigma's second digit."""
        return number(value, self.pattern)

    @property
    def sigma_text(self) -> str:
        """The sigma with two digits; a dash if there is none."""
        return number(self.sigma, self.pattern) if self.sigma > 0.0 else "–"


def parameter_rows(report: ReportInput, scanner: str) -> list[ParameterRow]:
    """Return the parameters of a scanner: those that were estimated, then those that were held."""
    calibration, aligned = report.adjusted.calibrations[scanner], _prealigned(report, scanner)
    rows = [row for row in _estimated_rows(report, aligned) if row.one.scanner == scanner and row.one.is_parameter]
    held = {one.name: one for one in report.adjusted.held if one.scanner == scanner}
    for parameter in PARAMETERS:
        if parameter.name in held:
            one = unknown(f"{scanner}.{parameter.name}")
            value = calibration.value(parameter.name) * one.factor
            sigma = float(calibration.held_sigmas[INDEX[parameter.name]]) * one.factor
            state = "not determined" if is_undetermined(held[parameter.name]) else "held"
            rows.append(ParameterRow(one, value, aligned.get(parameter.name), value, sigma, math.inf, state))
    return rows


def entry_rows(report: ReportInput) -> list[ParameterRow]:
    """Return the unknowns that are entries of tables: IBRC, beams, range offsets."""
    return [row for row in _estimated_rows(report, {}) if not row.one.is_parameter]


def _prealigned(report: ReportInput, scanner: str) -> dict[str, float]:
    """Return the angles of a pre-alignment by name, in the unit of reports; empty if it changed none."""
    found, adjusted = report.prealigned.get(scanner), report.adjusted
    if found is None:
        return {}
    start = dict(zip(adjusted.names, adjusted.start.tolist(), strict=True))
    held = adjusted.calibrations[scanner]
    apart = [found.value(name) - start.get(f"{scanner}.{name}", held.value(name)) for name in ANGLES]
    if max(map(abs, apart)) <= SAME_RAD:
        return {}
    return {name: found.value(name) * unknown(f"{scanner}.{name}").factor for name in ANGLES}


def _estimated_rows(report: ReportInput, aligned: Mapping[str, float]) -> Iterator[ParameterRow]:
    adjusted = report.adjusted
    for i, name in enumerate(adjusted.names):
        one = unknown(name)
        start, value, sigma, prior = (
            one.factor * float(table[i])
            for table in (adjusted.start, adjusted.values, adjusted.sigmas, adjusted.prior_sigmas)
        )
        yield ParameterRow(one, start, aligned.get(one.name), value, sigma, prior)


def parameter_tables(report: ReportInput) -> list[Table]:
    """Return one table per scanner: start, estimate, change, sigma, significance; held parameters are paler."""
    names = list(report.adjusted.calibrations)
    return [_parameters(report, scanner, several=len(names) > 1) for scanner in names]


def _parameters(report: ReportInput, scanner: str, *, several: bool) -> Table:
    shown = parameter_rows(report, scanner)
    aligned = any(row.first is not None for row in shown)
    rows = [_cells(row, aligned=aligned) for row in shown]
    honest = report.adjusted.trajectory is not None
    words = (
        "including the trajectory's errors and the plausible errors of held parameters"
        if honest
        else "including the plausible errors of held parameters, but too small, because they leave out the common part "
        "of the trajectory's errors"
    )
    under = f"Sigmas are one standard deviation, {words}."
    if aligned:
        under += " The pre-alignment gives only the values from which the iterations began."
    for sentence in held_words(report.adjusted):
        under += f" {sentence[0].upper()}{sentence[1:]}."
    if any(row[-2].endswith("·") for row in rows):
        under += f" · the change is below {INSIGNIFICANT:g} sigmas: the initial value may have been as good."
    title = f"Parameters of {scanner}" if several else "Parameters"
    pale = frozenset(at for at, row in enumerate(shown) if row.state)
    return Table(title, _heads("parameter", aligned=aligned), rows, under, pale=pale)


def _heads(first: str, *, aligned: bool) -> tuple[str, ...]:
    between = ("pre-alignment",) if aligned else ()
    return (first, "unit", "estimate", "sigma", "start", *between, "change", "change / sigma", "sigma before")


def _cells(row: ParameterRow, *, aligned: bool) -> list[str]:
    cells = [row.one.words, row.one.unit, row.text(row.value), row.sigma_text, row.text(row.start)]
    cells += [row.text(row.first)] if aligned else []
    if row.state:
        return [*cells, row.state, "–", "–"]
    ratio = abs(row.value - row.start) / row.sigma if row.sigma > 0.0 else math.inf
    significance = thousands(ratio, 0) if ratio >= 100.0 else number(ratio, ".1f")
    significance += " ·" if ratio < INSIGNIFICANT else ""
    change = number(row.value - row.start, f"+{row.pattern}")
    return [*cells, change, significance, number(row.prior, f".{decimals_of(row.prior)}f")]


def entries_table(report: ReportInput) -> Table | None:
    """Return a table of unknowns that are entries of tables: IBRC, beams, range offsets; None if there are none."""
    rows = []
    for row in entry_rows(report):
        cells = _cells(row, aligned=False)
        rows.append([f"{row.one.scanner}: {cells[0]}", *cells[1:]])
    return Table("Tables of the calibration", _heads("entry", aligned=False), rows) if rows else None


def held_table(report: ReportInput) -> Table | None:
    """Return a table of parameters that this flight does not determine, with remedies; None if there are none."""
    several = len(report.adjusted.calibrations) > 1
    held = [one for one in report.adjusted.held if is_undetermined(one)]
    if not held:
        return None
    rows = [
        [
            words_of(one.scanner, one.name, several=several),
            _would_be(one),
            _alike(one),
            plain(one.why, several=several),
            plain(one.remedy, several=several),
        ]
        for one in held
    ]
    heads = ("parameter", "sigma if estimated", "cannot be separated from", "why", "remedy")
    under = (
        "These parameters keep their previous values; the calibration is valid only as far as these values are right."
    )
    return Table("Not determined by this flight", heads, rows, under, left=(0, 2, 3, 4), stacked=True)


def _would_be(held: FixedParameter) -> str:
    one = unknown(f"{held.scanner}.{held.name}")
    sigma = held.sigma * one.factor
    return f"{number(sigma, f'.{decimals_of(sigma)}f')} {one.unit}" if math.isfinite(sigma) else "none"


def _alike(held: FixedParameter) -> str:
    names = [(name if "." in name else f"{held.scanner}.{name}", value) for name, value in held.with_others]
    rows = [(unknown(name), value) for name, value in names]
    return ", ".join(f"{one.words} ({number(value, '+.2f')})" for one, value in rows) or "–"


def strips_table(report: ReportInput) -> Table | None:
    """Return a table of height differences by pair of strips; None if there are none."""
    if not report.after:
        return None
    rows = []
    pairs = sorted(report.after, key=lambda pair: -report.after[pair].rms_m)
    for pair in pairs[:MOST_ROWS]:
        before, after = report.before.get(pair), report.after[pair]
        early = "–" if before is None else number(100.0 * before.rms_m, ".1f")
        late = [number(100.0 * x, ".1f") for x in (after.rms_m, after.mean_m, after.std_m, after.max_m)]
        rows.append([f"{pair[0]} – {pair[1]}", thousands(after.count), early, *late])
    heads = ("strips", "compared", "RMSDz before, cm", "RMSDz after, cm", "mean, cm", "std, cm", "largest, cm")
    measure = f" {report.measure}." if report.measure else ""
    return Table("", heads, rows, f"{measure}{_more(len(pairs))}".strip())


def _more(count: int) -> str:
    return f" The {MOST_ROWS} worst of {count}." if count > MOST_ROWS else ""


def groups_table(report: ReportInput) -> Table:
    """Return a table of the fit of each group of observations."""
    rows = [
        [
            group.group,
            thousands(group.observations),
            thousands(group.redundancy, 0 if group.redundancy >= 100.0 else 1),
            number(group.variance_factor, ".3f"),
            "–" if group.group in UNITLESS else length(group.rms_m),
            f"{thousands(group.rejected)} ({share(group.rejected / max(group.observations, 1))})",
        ]
        for group in report.adjusted.groups
    ]
    heads = ("observations", "number", "redundancy", "variance factor", "RMS residual", "rejected")
    return Table("Fit by group of observations", heads, rows)


def outlier_tables(report: ReportInput) -> list[Table]:
    """Return tables of where rejected observations lie, and of the largest residuals that were kept."""
    rejected, suspects = [], []
    for group in report.adjusted.residuals:
        out = group.weight <= 0.0
        if out.any():
            count = np.bincount(group.feature[out], minlength=1)
            of = np.bincount(group.feature, minlength=len(count))
            for index in np.argsort(-count, kind="stable")[: MOST_ROWS // 2].tolist():
                if count[index]:
                    name = _feature(report, group, index)
                    share_of_all = f"{thousands(count[index])} of {thousands(of[index])}"
                    rejected.append(
                        [name, group.group, share_of_all, _strips(report, group, out & (group.feature == index))]
                    )
        kept = np.flatnonzero(~out & (np.abs(group.normalised) > SUSPECT))
        for row in kept[np.argsort(-np.abs(group.normalised[kept]), kind="stable")][:8].tolist():
            one = np.zeros(len(out), np.bool_)
            one[row] = True
            value, w = length(float(group.misclosure_m[row])), number(float(group.normalised[row]), "+.1f")
            suspects.append(
                [_feature(report, group, int(group.feature[row])), group.group, value, w, _strips(report, group, one)]
            )
    tables = []
    if rejected:
        tables.append(Table("", ("where", "group", "rejected", "strips"), rejected, left=(0, 3)))
    if suspects:
        heads = ("where", "group", "residual", "w", "strip")
        under = (
            "The largest normalised residuals that were accepted; one good observation in a thousand exceeds |w| "
            f"= {SUSPECT:g}."
        )
        tables.append(Table("", heads, suspects, under, left=(0, 4)))
    return tables


def _feature(report: ReportInput, group: Residuals, index: int) -> str:
    known = report.features.ties if group.group == "ties" else report.features.planes
    return known[index].name if 0 <= index < len(known) else str(index)


def _strips(report: ReportInput, group: Residuals, rows: BoolArray) -> str:
    swaths = np.unique(group.swath[rows])
    return ", ".join(report.flight.swaths[index].name if index >= 0 else "control" for index in swaths.tolist())


def refused_table(report: ReportInput) -> Table | None:
    """Return a table of the reasons why candidates were not used; None if all were."""
    rows = [[reason, thousands(count)] for reason, count in report.features.refused.most_common()]
    return Table("", ("rejected candidates", "number"), rows) if rows else None


def control_table(report: ReportInput) -> Table | None:
    """Return a table of the laser above each point, and of the effect of leaving it out; None without control."""
    if not report.adjusted.control:
        return None
    several = len(report.adjusted.calibrations) > 1
    rows = []
    for point in report.adjusted.control:
        effect = "–"
        if point.influence:
            name, moved = max(point.influence.items(), key=lambda item: abs(item[1]))
            one = unknown(name)
            effect = f"{words_of(one.scanner, one.name, several=several)}: {number(moved, '+.2f')} sigmas"
        fit = (
            number(-100.0 * point.misclosure_m, "+.1f"),
            number(100.0 * point.sigma_m, ".1f"),
            number(-point.normalised, "+.2f"),
        )
        rows.append([point.name, *fit, effect])
    values = np.array([-point.misclosure_m for point in report.adjusted.control])
    rms, mean = (length(float(x)) for x in (np.sqrt(np.mean(values**2)), values.mean()))
    under = f"{len(values)} points: RMS {rms}, mean {mean}. "
    under += (
        "The adjustment used every point; the rightmost column shows the parameter that changes most when the point "
        "is left out."
    )
    heads = ("point", "laser above it, cm", "sigma, cm", "w", "changes most if left out")
    return Table("", heads, rows, under, left=(0, 4))


def detectable_table(report: ReportInput) -> Table | None:
    """Return a table of the smallest errors that would be detected; None if there are none."""
    rows = [[OBSERVED.get(name, name), length(value)] for name, value in report.adjusted.least_detectable.items()]
    under = "An error of this size in one observation is detected with probability 0.8 (significance 0.001)."
    return Table("Smallest detectable errors", ("observation", "size"), rows, under) if rows else None
