"""Writes the page of a quick look: pictures and tables in one file that needs no network."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path

from swath.calib.labels import length, number
from swath.calib.strips.standards import ASPRS_OVERLAP, QUALITY_LEVELS, TO_CONFIRM, USGS
from swath.daemon.processing.carried_verdict import points_verdicts
from swath.daemon.processing.files import write_whole
from swath.daemon.processing.pages.blocks import Block, Card, Cell, Image, Judged, Notes, Table, Words, data_uri
from swath.daemon.processing.pages.head import head_of_sidecars
from swath.daemon.processing.pages.names import QUICK_LOOK, QUICK_LOOK_FEATURES, QUICK_LOOK_MAPS
from swath.daemon.processing.pages.pdf import page_files
from swath.daemon.processing.pages.render import Page, html_of
from swath.daemon.processing.pages.words import thousands
from swath.daemon.processing.quicklook.maps import (
    draw_density,
    draw_differences,
    draw_height,
    draw_intensity,
    draw_sigma,
)
from swath.daemon.processing.quicklook.product_facts import calibrations_in, crs_of, rows_of, warnings_in
from swath.daemon.processing.quicklook.profile_picture import draw_profile
from swath.daemon.processing.quicklook.run import Look
from swath.daemon.processing.quicklook.strips import FEWEST_RETURNS, ROUGHEST_M, STEEPEST_DEG
from swath.georef.progress import Tell, silent
from swath.georef.verdicts import Verdict, worst_first

MOST_ROWS = 300
FEW_CELLS = 30
PICTURES: tuple[tuple[str, str, Callable[[Look, Path], None], Callable[[Look], bool]], ...] = (
    ("height", "Height", draw_height, lambda look: True),
    ("differences", "Height difference of overlapping strips", draw_differences, lambda look: look.overlap.cells > 0),
    ("profile", "Profile", draw_profile, lambda look: look.profile is not None),
    ("density", "Density", draw_density, lambda look: True),
    ("intensity", "Intensity", draw_intensity, lambda look: True),
    ("sigma", "Sigma of height", draw_sigma, lambda look: look.surface.with_sigma > 0),
)


def make_page(look: Look, folder: Path, title: str, warnings: list[str], tell: Tell = silent) -> Path:
    """Draw all pictures into a folder and write the page and its PDF beside them; return the page's path.

    ``warnings`` gets a line if the PDF cannot be made.

    ``tell`` is called with the progress.

    Raises:
        OSError: the folder cannot be written to.
    """
    shown = []
    for index, (name, alt, draw, wanted) in enumerate(PICTURES):
        tell("pictures", index, len(PICTURES), "pictures")
        path = folder / f"{name}.png"
        if wanted(look):
            draw(look, path)
            shown.append(Image(alt, data_uri(path.read_bytes(), "image/png")))
    for name in (*QUICK_LOOK_MAPS, QUICK_LOOK_FEATURES):
        (folder / name).unlink(missing_ok=True)
    page = folder / QUICK_LOOK
    write_whole(page_files(page, page_of(look, title, shown), warnings))
    return page


def page_of(look: Look, title: str, pictures: Sequence[Image]) -> str:
    """Return the HTML text of the page."""
    page = Page(
        "Quick look",
        title,
        head_of_sidecars((source.sidecar for source in look.sources), crs_of(source.crs for source in look.sources)),
        [*_notes(look), *pictures, *_quality(look), *_pairs(look), _strips(look), _files(look)],
        verdict_of(look),
        cards=_cards(look),
        appendix=[*([_method(look)] if look.overlap.rows else []), *_sidecars(look)],
    )
    return html_of(page)


def verdict_of(look: Look) -> Verdict | None:
    """Return the verdict on what the points were made with; None if nothing is doubtful."""
    reasons = [one.reason for one in points_verdicts([source.sidecar for source in look.sources])]
    if not reasons:
        return None
    worst, ordered = worst_first(reasons)
    return Verdict(worst, f"{worst.heading}: {'; '.join(reason.what for reason in ordered)}.", ordered)


def _cards(look: Look) -> list[Card]:
    agreement = look.agreement
    cards = [
        (thousands(look.surface.points), "points"),
        (_area(look.area_m2), "covered"),
        (f"{look.density:.3g}", "pulses per m², all strips together"),
        (str(len(look.strips)), "strip" if len(look.strips) == 1 else "strips"),
    ]
    if agreement.numbers:
        words = f"RMSDz of strips, planes in cells of {agreement.cell_m:g} m"
        cards.append((f"{100 * agreement.numbers['rms_m']:.1f} cm", words))
        level = agreement.best or ("none" if agreement.judged else "no verdict")
        cards.append((level, "best quality level met"))
    sigma_m = _root_mean_square(look)
    if sigma_m is not None:
        cards.append((length(sigma_m), "sigma of height"))
    return cards


def _root_mean_square(look: Look) -> float | None:
    """Return the root mean square of all points' sigmas of height; None if they are not known."""
    known = [strip for strip in look.strips if strip.sigma_m is not None]
    points = sum(strip.points for strip in known)
    squares = sum(strip.points * float(strip.sigma_m[2]) ** 2 for strip in known if strip.sigma_m is not None)
    return math.sqrt(squares / points) if points else None


def _area(area_m2: float) -> str:
    return f"{number(area_m2 / 1e6, '#.3g').removesuffix('.')} km²" if area_m2 >= 1e5 else f"{thousands(area_m2)} m²"


def _notes(look: Look) -> list[Block]:
    notes = [*look.notes, *warnings_of(look)]
    return [Notes(notes)] if notes else []


def warnings_of(look: Look) -> list[str]:
    """Return the warnings in the files' sidecars, each once."""
    return list(dict.fromkeys(line for source in look.sources for line in warnings_in(source.sidecar)))


def _table(title: str, heads: Sequence[str], rows: Sequence[Sequence[Cell]], under: str = "") -> Table:
    """Return a table of the first rows."""
    return Table(title, heads, rows[:MOST_ROWS], under, omitted=max(len(rows) - MOST_ROWS, 0))


def _sigma_cm(sigma_m: float) -> str:
    """Return a sigma in centimetres with two digits."""
    return f"{100 * sigma_m:.1f}" if sigma_m >= 0.00995 else f"{100 * sigma_m:.2f}"


def _kept(limit: str, kept: bool | None) -> Cell:
    """Return a limit, with whether it is met if that is known."""
    return limit if kept is None else Judged(f"{limit}{' met' if kept else ' not met'}", kept)


def _quality(look: Look) -> list[Block]:
    agreement = look.agreement
    if not agreement.judged:
        return [Words(_unjudged(look), "Quality levels")]
    numbers = agreement.numbers
    assert numbers is not None
    within_m = agreement.record()["within_m"]
    kept = {one.level: one.kept for one in agreement.judged if one.standard == USGS}
    measures = (
        ("pulses per m²", f"{agreement.pulses_m2:.3g}", "pulses_m2", "≥ {:g}", 1.0),
        ("RMSDz", _cm(numbers["rms_m"]), "overlap_m", "≤ {:g} cm", 100.0),
        ("99 % of |dZ|", _cm(numbers["p99_m"]), "overlap_max_m", "≤ {:g} cm", 100.0),
        ("sigma within strips", _cm(within_m), "within_m", "≤ {:g} cm", 100.0),
    )
    rows: list[list[Cell]] = [
        [
            words,
            measured,
            *(_kept(limit.format(factor * getattr(level, name)), kept[level.name][name]) for level in QUALITY_LEVELS),
        ]
        for words, measured, name, limit, factor in measures
    ]
    heads = ["measure", "measured", *(level.name for level in QUALITY_LEVELS)]
    verdicts = " ".join(f"{line}." for line in agreement.verdicts() if line != TO_CONFIRM)
    words = (
        f"{agreement.measure}. Density: first returns per m² where cells are covered wholly, all strips together. 99 % "
        "of the cells must meet the limit of |dZ|, because single cars or leaves cause the largest of all. ASPRS asks "
        f"for an RMSDz between swaths of at most {ASPRS_OVERLAP:g} × the vertical accuracy class. "
        f"{TO_CONFIRM[0].upper()}{TO_CONFIRM[1:]}. Absolute accuracy is not judged here: it needs check points."
    )
    return [_table("Quality levels", heads, rows), Words(verdicts), Words(words, muted=True)]


def _unjudged(look: Look) -> str:
    if look.agreement.numbers is None:
        return "No strips overlap on smooth ground: relative accuracy is not judged."
    reason = look.agreement.no_verdict
    return f"{reason[0].upper()}{reason[1:]}."


def _cm(metres: float | None) -> str:
    return "–" if metres is None else f"{100 * metres:.1f} cm"


def _percent(share: float) -> str:
    return f"{math.floor(share * 1e3) / 10:.1f} %"  # 100 % only if it is all


def _pairs(look: Look) -> list[Block]:
    if not look.overlap.rows:
        return []
    rows = [
        [
            f"{look.names[row['first']]} − {look.names[row['second']]}",
            f"{thousands(row['cells'])}{' (few)' if row['cells'] < FEW_CELLS else ''}",
            number(100 * row["median_m"], "+.1f"),
            number(100 * row["mean_m"], "+.1f"),
            f"{100 * row['rms_m']:.1f}",
            f"{100 * row['p95_m']:.1f}",
            f"{100 * row['max_m']:.1f}",
            _percent(row["cells"] / row["compared_cells"]),
        ]
        for row in sorted(look.overlap.rows, key=lambda row: -row["rms_m"])
    ]
    heads = ("strips", "smooth cells", "median dZ, cm", "mean, cm", "RMSDz, cm", "95 % of |dZ|, cm", "largest, cm")
    return [_table("Strips against each other", (*heads, "share of smooth cells"), rows, f"{look.agreement.measure}.")]


def _strips(look: Look) -> Table:
    sigmas = any(strip.sigma_m is not None for strip in look.strips)
    heads = ["strip", "points", "pulses", "length, m", "area", "pulses per m²"]
    heads += ["σ east, cm", "σ north, cm", "σ height, cm", "largest σ height, cm"] if sigmas else []
    rows = []
    for strip in look.strips:
        row = [strip.name, thousands(strip.points), thousands(strip.pulses), thousands(strip.length_m)]
        row += [_area(strip.area_m2), "–" if math.isnan(strip.density) else f"{strip.density:.3g}"]
        if strip.sigma_m is not None and strip.largest_sigma_m is not None:
            row += [_sigma_cm(value) for value in (*strip.sigma_m, strip.largest_sigma_m[2])]
        elif sigmas:
            row += ["–"] * 4
        rows.append(row)
    under = "Sigmas: root mean square over the strip's points, as stored in the files." if sigmas else ""
    return _table("Strips", heads, rows, under)


def _files(look: Look) -> Table:
    rows = [
        [
            source.path.name,
            thousands(source.point_count),
            f"{source.version}, {source.point_format}",
            source.crs.name if source.crs is not None else source.trouble,
            ", ".join(calibrations_in(source.sidecar)) or "–",
            Judged("partial", good=False) if source.damage else "whole",
        ]
        for source in look.sources
    ]
    return _table("Files", ("file", "points", "LAS, format", "CRS", "calibration", "read"), rows)


def _sidecars(look: Look) -> list[Block]:
    """Return the parts about how files were made, from each different sidecar."""
    known: list[tuple[list[str], list[tuple[str, str]]]] = []
    for source in look.sources:
        rows = rows_of(source.sidecar)
        same = next((names for names, others in known if others == rows), None)
        if same is not None:
            same.append(source.path.name)
        elif rows:
            known.append(([source.path.name], rows))
    blocks: list[Block] = []
    for names, rows in known[:MOST_ROWS]:
        files = ", ".join(names[:6]) + (f" and {len(names) - 6} more" if len(names) > 6 else "")
        title = "" if blocks else "How the points were made"
        blocks += [Words(files, title, muted=True), Table("", ("", ""), rows, left=(0, 1))]
    return blocks


def _method(look: Look) -> Words:
    frame = look.cells.frame
    text = (
        f"In each cell of {frame.cell_m:g} m a least squares plane goes through each strip's single returns; the "
        "planes' heights at the middle of the two strips' centroids are compared, so that a slope does not count as a "
        "difference. A cell counts "
        f"where both strips have at least {FEWEST_RETURNS} returns that spread over it, lie within "
        f"{100 * ROUGHEST_M:g} cm (one sigma) of their plane, and the plane is no steeper than {STEEPEST_DEG:g}°. "
        "Trees, walls, eaves and steep ground drop out. A cell's dZ holds noise of its own: the median says more of a "
        "pair than its largest."
    )
    return Words(text, "How dZ was found", muted=True)
