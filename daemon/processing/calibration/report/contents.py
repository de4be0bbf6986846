"""Collects the contents of a report in order: words, tables and pictures, the same for HTML and PDF."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

from swath.calib.labels import degrees, is_undetermined, length, number, plain, thousands, words_of
from swath.calib.summary import Profile, ReportInput
from swath.calib.verdict import BORESIGHT, DEG, overall_rms_m, sigma_of
from swath.daemon.processing.calibration.report.cuts import cut_picture
from swath.daemon.processing.calibration.report.maps import difference_picture, map_picture
from swath.daemon.processing.calibration.report.pictures import (
    control_picture,
    correlation_picture,
    intensity_picture,
    strips_picture,
    trajectory_pictures,
)
from swath.daemon.processing.calibration.report.profiles import comparison_table, profiles_table
from swath.daemon.processing.calibration.report.residuals import normal_picture, residual_picture
from swath.daemon.processing.calibration.report.tables import (
    Table,
    control_table,
    detectable_table,
    entries_table,
    groups_table,
    held_table,
    outlier_tables,
    parameter_tables,
    refused_table,
    strips_table,
)
from swath.daemon.processing.pages.canvas import Picture
from swath.georef.verdicts import Verdict


@dataclass(frozen=True, slots=True)
class Words:
    """A paragraph, with an optional title above it."""

    text: str
    title: str = ""


@dataclass(frozen=True, slots=True)
class Notes:
    """Sentences that are set apart from the text."""

    lines: Sequence[str]


Block: TypeAlias = Words | Notes | Table | Picture | Profile
MOST_REASONS = 40


def blocks_of(report: ReportInput, verdict: Verdict) -> list[Block]:
    """Return all blocks below the verdict."""
    several = len(report.adjusted.calibrations) > 1
    notes = [plain(line, several=several) for line in (*report.notes, *report.adjusted.notes)]
    found: list[Block | None] = [
        _reasons(verdict),
        Notes(notes) if notes else None,
        *parameter_tables(report),
        _by_wish(report),
        entries_table(report),
        intensity_picture(report),
        correlation_picture(report),
        held_table(report),
        map_picture(report),
        _observed(report),
        refused_table(report),
        strips_picture(report),
        strips_table(report),
        difference_picture(report),
        cut_picture(report),
        *_checked(report),
        *report.profiles,
        residual_picture(report),
        normal_picture(report),
        *_outliers(report),
        control_picture(report),
        control_table(report),
        *trajectory_pictures(report),
        *_method(report),
        groups_table(report),
        detectable_table(report),
        _run(report),
        *_inputs(report),
    ]
    return [block for block in found if block is not None]


def cards_of(report: ReportInput) -> list[tuple[str, str]]:
    """Return the most important figures with their labels."""
    adjusted, features = report.adjusted, report.features
    boresight, offset_m = sigma_of(report, BORESIGHT), sigma_of(report, ("range_offset_m",))
    before_m, after_m = overall_rms_m(dict(report.before)), overall_rms_m(dict(report.after))
    cards = [(degrees(boresight * DEG), "boresight, largest sigma")] if boresight is not None else []
    cards += [(length(offset_m), "range offset, sigma")] if offset_m is not None else []
    if after_m is not None:
        was = f", before {length(before_m)}" if before_m is not None else ""
        level = f"; {report.level}" if report.level else ""
        cards.append((length(after_m), f"RMSDz of strips{was}{level}"))
    cards.append((str(len(report.flight.swaths)), "strips"))
    cards += [(thousands(len(features.planes)), "planes")] if features.planes else []
    cards += [(thousands(len(features.ties)), "tie points")] if features.ties else []
    cards += [(thousands(len(adjusted.control)), "control points")] if adjusted.control else []
    cards.append((thousands(sum(group.observations for group in adjusted.groups)), "observations"))
    cards.append((number(adjusted.variance_factor, ".3f"), "variance factor"))
    return cards


def identity_rows(report: ReportInput) -> list[tuple[str, str]]:
    """Return rows that identify the calibration; unknown entries are left out."""
    rows: list[tuple[str, str]] = []
    several = len(report.headers) > 1
    for scanner, header in report.headers.items():
        of = f" of {scanner}" if several else ""
        rows += [
            (f"Calibration{of}", header.id),
            (f"Scanner{of}", " ".join(x for x in (scanner, header.scanner_model, header.scanner_serial) if x)),
            ("Inertial unit", header.imu_serial),
            ("Installation", header.installation),
            ("Made", header.created.strftime("%Y-%m-%d %H:%M %Z")),
        ]
    return [row for row in dict.fromkeys(rows) if row[1]]


def _reasons(verdict: Verdict) -> Table | None:
    if not verdict.reasons:
        return None
    rows = [[reason.what, reason.change] for reason in verdict.reasons[:MOST_REASONS]]
    return Table("Reasons", ("what", "remedy"), rows, left=(0, 1), stacked=True)


def _by_wish(report: ReportInput) -> Words | None:
    several = len(report.adjusted.calibrations) > 1
    held = [one for one in report.adjusted.held if not is_undetermined(one)]
    if not held:
        return None
    by_why: dict[str, list[str]] = {}
    for one in held:
        by_why.setdefault(one.why, []).append(words_of(one.scanner, one.name, several=several))
    return Words(" ".join(f"Held: {', '.join(names)} ({why.rstrip('.')})." for why, names in by_why.items()))


def _observed(report: ReportInput) -> Words:
    features = report.features
    kinds: dict[str, int] = {}
    for plane in features.planes:
        kinds[plane.kind or "other"] = kinds.get(plane.kind or "other", 0) + 1
    patches = sum(len(plane.patches) for plane in features.planes)
    points = sum(plane.points for plane in features.planes)
    counts = ", ".join(f"{count} {kind}" for kind, count in sorted(kinds.items(), key=lambda item: -item[1]))
    words = f"{len(features.planes)} planes ({counts}) in {patches} patches of {thousands(points)} returns"
    return Words(words + (f"; {len(features.ties)} tie points." if features.ties else "."))


def _checked(report: ReportInput) -> list[Block]:
    if report.check is None:
        return []
    tables = (comparison_table(report.check), profiles_table(report.check))
    return [table for table in tables if table is not None]


def _outliers(report: ReportInput) -> list[Block]:
    tables = outlier_tables(report)
    if not tables:
        return [Words("No observation was rejected.", "Outliers")]
    rejected = sum(group.rejected for group in report.adjusted.groups)
    every = max(sum(group.observations for group in report.adjusted.groups), 1)
    text = f"{thousands(rejected)} of {thousands(every)} observations were rejected."
    return [Words(text, "Outliers"), *tables]


MODEL = (
    "Each point is x_e = x_b + R_e_l · R_l_b · (a + R_b_s · x_s) at the pulse's time (ISO/TS 19159-2, Eq. 10), with "
    "the beam, range and scan angle corrected by the parameters above. Points of one plane in several strips satisfy "
    "n · x = d (Eq. 16, 17), |n| = 1 held exactly. Parameters and planes are estimated together (Gauss–Helmert, Eq. "
    "19, 20; Skaloud and Lichti 2006): eight observables a point (position and attitude of the body, range, scan "
    "angle), planes eliminated one by one (Schur complement)."
)
STOCHASTIC = (
    "Range and scan angle have the scanner's noise, independent for each return. Errors of the trajectory are the "
    "same for neighbouring returns: the adjustment estimates them too, as corrections at knots in time with the "
    "trajectory's own sigmas and correlation. Gross errors are weighted down, then tested one by one (data snooping; "
    "Baarda 1968, Pope 1976)."
)
NO_TRAJECTORY = (
    "Range and scan angle have the scanner's noise. The adjustment took the trajectory's errors as independent for "
    "each return, which they are not: the sigmas here are too small. Gross errors are weighted down, then tested one "
    "by one (data snooping; Baarda 1968, Pope 1976)."
)


def _method(report: ReportInput) -> list[Block]:
    adjusted = report.adjusted
    ended = "converged" if adjusted.converged else "did NOT converge"
    spectrum = adjusted.spectrum
    weakest = (
        f" Smallest eigenvalue of the scaled normal matrix: {number(float(spectrum.min()), '.2g')}."
        if len(spectrum)
        else ""
    )
    test = (
        ""
        if adjusted.global_test >= 0.001
        else (
            "; with so many observations the test detects differences that do not matter, so judge by the factor itself"
        )
    )
    text = (
        f"{len(adjusted.names)} unknowns, redundancy {thousands(adjusted.redundancy)}. The adjustment {ended} after "
        f"{adjusted.iterations} iterations; matches were searched again {adjusted.matchings} "
        f"{'time' if adjusted.matchings == 1 else 'times'}. Variance factor {number(adjusted.variance_factor, '.3f')} "
        f"(global test: p = {number(adjusted.global_test, '.2g')}{test}).{weakest}"
    )
    if adjusted.scaled:
        text += " The global test failed: all sigmas are multiplied by the square root of the variance factor."
    stochastic = NO_TRAJECTORY if adjusted.trajectory is None else STOCHASTIC
    return [Words(MODEL, "How it was computed"), Words(stochastic), Words(text)]


def _run(report: ReportInput) -> Table | None:
    rows = [[key, value] for key, value in report.settings.items()]
    return Table("Software and settings", ("", ""), rows, left=(0, 1)) if rows else None


def _inputs(report: ReportInput) -> list[Block]:
    rows = [[name, sha256] for name, sha256 in report.inputs]
    return [Table("Inputs", ("file", "SHA-256"), rows, hashes=(1,), stacked=True)] if rows else []
