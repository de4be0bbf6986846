"""Writes the report of a calibration: one HTML page that needs no network, and the same as PDF."""

from __future__ import annotations

from typing import TypeAlias

from swath.calib.labels import degrees, is_undetermined, length, number, plain, thousands, words_of
from swath.calib.summary import Profile, ReportInput
from swath.calib.verdict import BORESIGHT, DEG, judge, overall_rms_m, sigma_of
from swath.daemon.processing.calibration.report.cuts import cut_picture
from swath.daemon.processing.calibration.report.maps import difference_picture, map_picture
from swath.daemon.processing.calibration.report.pictures import (
    control_picture,
    correlation_picture,
    intensity_picture,
    strips_picture,
    trajectory_pictures,
)
from swath.daemon.processing.calibration.report.profiles import comparison_table, formulas_table, profiles_table
from swath.daemon.processing.calibration.report.residuals import normal_picture, residual_picture
from swath.daemon.processing.calibration.report.tables import (
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
from swath.daemon.processing.pages.blocks import Block, Card, Image, Notes, Table, Words, data_uri
from swath.daemon.processing.pages.canvas import NARROW, PAPER, WIDE, Format, Picture
from swath.daemon.processing.pages.head import NOTHING_KNOWN, PageHead
from swath.daemon.processing.pages.pdf import pdf_of
from swath.daemon.processing.pages.render import Page, html_of
from swath.georef.verdicts import Verdict

Content: TypeAlias = Words | Notes | Table | Picture | Profile
MOST_REASONS = 40
SVG = "image/svg+xml"


def html(report: ReportInput, head: PageHead = NOTHING_KNOWN) -> str:
    """Return the report as an HTML page; the same input gives the same text."""
    return _page(report, head, WIDE, NARROW)


def pdf(report: ReportInput, head: PageHead = NOTHING_KNOWN) -> bytes:
    """Return the report on A4 pages as PDF; the same input gives the same bytes.

    Raises:
        PdfUnavailableError: this computer lacks the library that sets text.
    """
    return pdf_of(paper_page(report, head))


def paper_page(report: ReportInput, head: PageHead = NOTHING_KNOWN) -> str:
    """Return the HTML page that is printed: pictures have the width of paper."""
    return _page(report, head, PAPER)


def _page(report: ReportInput, head: PageHead, form: Format, narrow: Format | None = None) -> str:
    """Return the page's text with pictures in one format, or in one for wide and one for narrow windows."""
    verdict = judge(report)
    shown, appendix = contents_of(report, verdict), appendix_of(report)
    page = Page(
        "Calibration report",
        report.heading,
        head,
        [_block(content, form, narrow) for content in shown],
        verdict,
        cards_of(report),
        title=report.heading,
        appendix=[_block(content, form, narrow) for content in appendix],
    )
    return html_of(page)


def _block(content: Content, form: Format, narrow: Format | None) -> Block:
    """Return contents as they are, and pictures as images: each is a file of its own, so that ids do not collide."""
    if isinstance(content, Picture):
        wide = data_uri(content.svg(form), SVG)
        other = "" if narrow is None else data_uri(content.svg(narrow), SVG)
        return Image(content.title, wide, other, content.title, content.words)
    if isinstance(content, Profile):
        uri = data_uri(content.svg.encode(), SVG)
        return Image(content.title, uri, "", content.title, content.caption, limited=True)
    return content


def contents_of(report: ReportInput, verdict: Verdict) -> list[Content]:
    """Return all that stands below the cards."""
    several = len(report.adjusted.calibrations) > 1
    told = report.settings.get("trajectory errors", "")  # stands with the settings
    every = (*report.notes, *report.adjusted.notes)
    notes = [plain(line, several=several) for line in every if line not in told]
    found: list[Content | None] = [
        _identity(report),
        _reasons(verdict),
        Notes(notes) if notes else None,
        *parameter_tables(report),
        _fixed(report),
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
        groups_table(report),
        detectable_table(report),
    ]
    return [block for block in found if block is not None]


def appendix_of(report: ReportInput) -> list[Content]:
    """Return what stands at the end: how it was computed, formulas, settings and inputs."""
    formulas = None if report.check is None else formulas_table(report.check)
    found = [*_method(report), formulas, _run(report), *_inputs(report)]
    return [block for block in found if block is not None]


def cards_of(report: ReportInput) -> list[Card]:
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


def _identity(report: ReportInput) -> Table | None:
    """Return a table of what identifies the calibration; unknown entries are left out."""
    rows: list[tuple[str, str]] = []
    several = len(report.headers) > 1
    for scanner, header in report.headers.items():
        of = f" of {scanner}" if several else ""
        rows += [
            (f"Scanner{of}", " ".join(x for x in (scanner, header.scanner_model, header.scanner_serial) if x)),
            ("Inertial unit", header.imu_serial),
            ("Installation", header.installation),
        ]
    known = [row for row in dict.fromkeys(rows) if row[1]]
    return Table("", ("", ""), known, left=(0, 1)) if known else None


def _reasons(verdict: Verdict) -> Table | None:
    if not verdict.reasons:
        return None
    rows = [[reason.what, reason.change] for reason in verdict.reasons[:MOST_REASONS]]
    return Table("Reasons", ("what", "remedy"), rows, left=(0, 1), stacked=True)


def _fixed(report: ReportInput) -> Words | None:
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
    often = sorted(kinds.items(), key=lambda item: -item[1])
    by_kind = ", ".join(f"{thousands(count)} {kind}" for kind, count in often)
    words = f"{thousands(len(features.planes))} planes ({by_kind}) in {thousands(patches)} patches of "
    ties = f"; {thousands(len(features.ties))} tie points" if features.ties else ""
    return Words(f"{words}{thousands(points)} returns{ties}.")


def _checked(report: ReportInput) -> list[Content]:
    if report.check is None:
        return []
    tables = (comparison_table(report.check), profiles_table(report.check))
    return [table for table in tables if table is not None]


def _outliers(report: ReportInput) -> list[Content]:
    tables = outlier_tables(report)
    if not tables:
        return [Words("No observation was rejected.", "Outliers")]
    rejected = sum(group.rejected for group in report.adjusted.groups)
    every = max(sum(group.observations for group in report.adjusted.groups), 1)
    return [Words(f"{thousands(rejected)} of {thousands(every)} observations were rejected.", "Outliers"), *tables]


MODEL = (
    "Each point is x_e = x_b + R_e_l · R_l_b · (a + R_b_s · x_s) at the pulse's time (ISO/TS 19159-2, Eq. 10), with "
    "the beam, range and scan angle corrected by the parameters above. Points of one plane in several strips satisfy "
    "n · x = d (Eq. 16, 17), |n| = 1 held exactly. Parameters and planes are estimated together (Gauss–Helmert, "
    "Eq. 19, 20; Skaloud and Lichti 2006): eight observables a point (position and attitude of the body, range, scan "
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


def _method(report: ReportInput) -> list[Content]:
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
    words = (
        f"{len(adjusted.names)} unknowns, redundancy {thousands(adjusted.redundancy)}. The adjustment {ended} after "
        f"{adjusted.iterations} iterations; matches were searched again {adjusted.matchings} "
        f"{'time' if adjusted.matchings == 1 else 'times'}. Variance factor {number(adjusted.variance_factor, '.3f')} "
        f"(global test: p = {number(adjusted.global_test, '.2g')}{test}).{weakest}"
    )
    if adjusted.scaled:
        words += " The global test failed: all sigmas are multiplied by the square root of the variance factor."
    stochastic = NO_TRAJECTORY if adjusted.trajectory is None else STOCHASTIC
    return [Words(MODEL, "How it was computed"), Words(stochastic), Words(words)]


def _run(report: ReportInput) -> Table | None:
    rows = [[key, value] for key, value in report.settings.items()]
    return Table("Software and settings", ("", ""), rows, left=(0, 1)) if rows else None


def _inputs(report: ReportInput) -> list[Content]:
    rows = [[name, sha256] for name, sha256 in report.inputs]
    return [Table("Inputs", ("file", "SHA-256"), rows, hashes=(1,), stacked=True)] if rows else []
