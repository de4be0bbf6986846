"""Writes the page of a quick look: pictures and tables in one file that needs no network."""

from __future__ import annotations

import base64
import math
from collections.abc import Callable, Sequence
from html import escape
from pathlib import Path

from swath.calib.strips.standards import ASPRS_OVERLAP, QUALITY_LEVELS, TO_CONFIRM, USGS
from swath.daemon.processing.pages.style import QUICKLOOK_STYLE
from swath.daemon.processing.pages.words import thousands
from swath.daemon.processing.quicklook.maps import (
    draw_density,
    draw_differences,
    draw_height,
    draw_intensity,
    draw_sigma,
)
from swath.daemon.processing.quicklook.product_facts import calibrations_in, rows_of, warnings_in
from swath.daemon.processing.quicklook.profile_picture import draw_profile
from swath.daemon.processing.quicklook.run import Look
from swath.daemon.processing.quicklook.strips import FEWEST_RETURNS, ROUGHEST_M, STEEPEST_DEG

PAGE_NAME = "index.html"
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


def make_page(look: Look, folder: Path, title: str) -> Path:
    """Draw all pictures into a folder and write the page beside them; return its path.

    Raises:
        OSError: the folder cannot be written to.
    """
    folder.mkdir(parents=True, exist_ok=True)
    shown = []
    for name, words, draw, wanted in PICTURES:
        path = folder / f"{name}.png"
        path.unlink(missing_ok=True)  # left by an earlier run
        if wanted(look):
            draw(look, path)
            shown.append((words, path))
    page = folder / PAGE_NAME
    page.write_text(page_of(look, title, shown), encoding="utf-8")
    return page


def page_of(look: Look, title: str, pictures: Sequence[tuple[str, Path]]) -> str:
    """Return the HTML text of the page."""
    parts = [
        f"<!doctype html><html lang='en'><head><meta charset='utf-8'><title>{escape(title)}: quick look</title>",
        "<meta name='viewport' content='width=device-width, initial-scale=1'>",
        f"<style>{QUICKLOOK_STYLE}</style></head><body>",
        f"<h1>{escape(title)}</h1>",
        f"<p class='muted'>{escape(_crs_words(look))}</p>",
        _figures(look),
        _notes(look),
        *(_picture(words, path) for words, path in pictures),
        _quality(look),
        _pairs(look),
        _strips(look),
        _files(look),
        _sidecars(look),
        _method(look),
        "</body></html>\n",
    ]
    return "\n".join(part for part in parts if part)


def _crs_words(look: Look) -> str:
    crs = next((source.crs for source in look.sources if source.crs is not None), None)
    if crs is None:
        return "Coordinate reference system unknown"
    code = crs.to_authority(min_confidence=100)
    return f"{crs.name}{f' ({code[0]}:{code[1]})' if code else ''}"


def _figures(look: Look) -> str:
    agreement = look.agreement
    cards = [
        (thousands(look.surface.points), "points"),
        (_area(look.area_m2), "covered"),
        (f"{look.density:.3g} per m²", "pulses, all strips together"),
        (str(len(look.strips)), "strip" if len(look.strips) == 1 else "strips"),
    ]
    if agreement.numbers:
        words = f"RMSDz of strips, planes in cells of {agreement.cell_m:g} m"
        cards.append((f"{100 * agreement.numbers['rms_m']:.1f} cm", words))
        level = agreement.best or ("none" if agreement.judged else "no verdict")
        cards.append((level, "best quality level kept"))
    sigma_m = _root_mean_square(look)
    if sigma_m is not None:
        cards.append((f"{100 * sigma_m:.1f} cm", "sigma of height"))
    told = "".join(
        f"<div><b>{escape(value)}</b><span class='muted'>{escape(word)}</span></div>" for value, word in cards
    )
    return f"<div class='figures'>{told}</div>"


def _root_mean_square(look: Look) -> float | None:
    """Return the root mean square of all points' sigmas of height; None if they are not known."""
    known = [strip for strip in look.strips if strip.sigma_m is not None]
    points = sum(strip.points for strip in known)
    squares = sum(strip.points * float(strip.sigma_m[2]) ** 2 for strip in known if strip.sigma_m is not None)
    return math.sqrt(squares / points) if points else None


def _area(area_m2: float) -> str:
    return f"{area_m2 / 1e6:.3g} km²" if area_m2 >= 1e5 else f"{thousands(area_m2)} m²"


def _notes(look: Look) -> str:
    notes = [*look.notes, *warnings_of(look)]
    return f"<ul class='notes'>{''.join(f'<li>{escape(note)}</li>' for note in notes)}</ul>" if notes else ""


def warnings_of(look: Look) -> list[str]:
    """Return the warnings in the files' sidecars, each once."""
    return list(dict.fromkeys(line for source in look.sources for line in warnings_in(source.sidecar)))


def _picture(words: str, path: Path) -> str:
    data = base64.b64encode(path.read_bytes()).decode("ascii")
    return f"<figure><img alt='{escape(words)}' src='data:image/png;base64,{data}'></figure>"


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return an HTML table of cells that are HTML themselves; the caller has escaped foreign text."""
    head = "".join(f"<th>{word}</th>" for word in heads)
    body = "".join(f"<tr>{''.join(f'<td>{cell}</td>' for cell in row)}</tr>" for row in rows[:MOST_ROWS])
    more = f"<p class='muted'>and {len(rows) - MOST_ROWS} more</p>" if len(rows) > MOST_ROWS else ""
    return f"<div class='scroll'><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>{more}"


def _judged(kept: bool | None) -> str:
    return "–" if kept is None else "<span class='ok'>kept</span>" if kept else "<span class='no'>not kept</span>"


def _quality(look: Look) -> str:
    agreement = look.agreement
    if not agreement.judged:
        return f"<h2>Quality levels</h2><p>{escape(_unjudged(look))}</p>"
    numbers = agreement.numbers
    assert numbers is not None
    within_m = agreement.record()["within_m"]
    kept = {one.level: one.kept for one in agreement.judged if one.standard == USGS}
    rows = []
    for level in QUALITY_LEVELS:
        row = [level.name]
        for limit, word in (
            (f"≥ {level.pulses_m2:g}", "pulses_m2"),
            (f"≤ {100 * level.overlap_m:g} cm", "overlap_m"),
            (f"≤ {100 * level.overlap_max_m:g} cm", "overlap_max_m"),
            (f"≤ {100 * level.within_m:g} cm", "within_m"),
        ):
            row += [limit, _judged(kept[level.name][word])]
        rows.append(row)
    heads = ["level", "pulses per m²", f"here {agreement.pulses_m2:.3g}", "RMSDz", f"here {_cm(numbers['rms_m'])}"]
    heads += ("99 % of |dZ|", f"here {_cm(numbers['p99_m'])}", "within strips", f"here {_cm(within_m)}")
    told = " ".join(f"{escape(line)}." for line in agreement.verdicts() if line != TO_CONFIRM)
    return (
        "<h2>Quality levels</h2>"
        + _table(heads, rows)
        + f"<p>{told}</p><p class='muted'>{escape(agreement.measure)}. Density: first returns per m² where cells are "
        "covered wholly, all strips together. Single cars or leaves decide over a largest |dZ|, so 99 % of the cells "
        f"must keep its limit. ASPRS asks for an RMSDz between swaths of at most {ASPRS_OVERLAP:g} × the vertical "
        f"accuracy class. {TO_CONFIRM[0].upper()}{TO_CONFIRM[1:]}. Absolute accuracy wants check points; nothing here "
        "says it.</p>"
    )


def _unjudged(look: Look) -> str:
    if look.agreement.numbers is None:
        return "No strips overlap on smooth ground: relative accuracy is not judged."
    told = look.agreement.no_verdict
    return f"{told[0].upper()}{told[1:]}."


def _cm(metres: float | None) -> str:
    return "–" if metres is None else f"{100 * metres:.1f} cm"


def _percent(share: float) -> str:
    return f"{100 * math.floor(share * 1e4) / 1e4:.2f} %"  # 100 % only if it is all


def _pairs(look: Look) -> str:
    if not look.overlap.rows:
        return ""
    rows = [
        [
            f"{escape(look.names[row['first']])} − {escape(look.names[row['second']])}",
            f"{thousands(row['cells'])}{' (few)' if row['cells'] < FEW_CELLS else ''}",
            thousands(100 * row["median_m"], 1),
            thousands(100 * row["mean_m"], 1),
            f"{100 * row['rms_m']:.1f}",
            f"{100 * row['p95_m']:.1f}",
            f"{100 * row['max_m']:.1f}",
            f"{_percent(row['cells'] / row['compared_cells'])}",
        ]
        for row in sorted(look.overlap.rows, key=lambda row: -row["rms_m"])
    ]
    heads = ("strips", "smooth cells", "median dZ", "mean", "RMSDz", "95 % of |dZ|", "largest", "of cells smooth")
    under = f"<p class='muted'>Centimetres. {escape(look.agreement.measure)}.</p>"
    return "<h2>Strips against each other</h2>" + _table(heads, rows) + under


def _strips(look: Look) -> str:
    sigmas = any(strip.sigma_m is not None for strip in look.strips)
    heads = ["strip", "points", "pulses", "length m", "area", "pulses per m²"]
    heads += ["σ east cm", "σ north cm", "σ height cm", "largest σ height"] if sigmas else []
    rows = []
    for strip in look.strips:
        row = [escape(strip.name), thousands(strip.points), thousands(strip.pulses), thousands(strip.length_m)]
        row += [_area(strip.area_m2), "–" if math.isnan(strip.density) else f"{strip.density:.3g}"]
        if strip.sigma_m is not None and strip.largest_sigma_m is not None:
            row += [f"{100 * value:.2f}" for value in (*strip.sigma_m, strip.largest_sigma_m[2])]
        elif sigmas:
            row += ["–"] * 4
        rows.append(row)
    under = (
        "<p class='muted'>Sigmas: root mean square over the strip's points, as the files say them.</p>"
        if sigmas
        else ""
    )
    return "<h2>Strips</h2>" + _table(heads, rows) + under


def _files(look: Look) -> str:
    rows = [
        [
            escape(source.path.name),
            thousands(source.point_count),
            f"{escape(source.version)}, {source.point_format}",
            escape(source.crs.name if source.crs is not None else source.trouble),
            escape(", ".join(calibrations_in(source.sidecar)) or "–"),
            "<span class='no'>partial</span>" if source.damage else "whole",
        ]
        for source in look.sources
    ]
    return "<h2>Files</h2>" + _table(("file", "points", "LAS, format", "CRS", "calibration", "read"), rows)


def _sidecars(look: Look) -> str:
    """Return the parts about how files were made, from each different sidecar."""
    said: list[tuple[list[str], list[tuple[str, str]]]] = []
    for source in look.sources:
        rows = rows_of(source.sidecar)
        same = next((names for names, known in said if known == rows), None)
        if same is not None:
            same.append(source.path.name)
        elif rows:
            said.append(([source.path.name], rows))
    parts = []
    for names, rows in said[:MOST_ROWS]:
        told = ", ".join(names[:6]) + (f" and {len(names) - 6} more" if len(names) > 6 else "")
        cells = "".join(
            f"<tr><td>{escape(label)}</td><td class='left'>{escape(text)}</td></tr>" for label, text in rows
        )
        parts.append(f"<p class='muted'>{escape(told)}</p><div class='scroll'><table>{cells}</table></div>")
    return f"<h2>How the points were made</h2>{''.join(parts)}" if parts else ""


def _method(look: Look) -> str:
    frame = look.cells.frame
    return (
        "<h2>How dZ was found</h2><p class='muted'>"
        f"In each cell of {frame.cell_m:g} m a least squares plane goes through each strip's single returns; the "
        "planes' heights at the middle of the two strips' centroids are compared, so that a slope does not count as a "
        "difference. A cell counts "
        f"where both strips have at least {FEWEST_RETURNS} returns that spread over it, lie within "
        f"{100 * ROUGHEST_M:g} cm (one sigma) of their plane, and the plane is no steeper than {STEEPEST_DEG:g}°. "
        "Trees, walls, eaves and steep ground drop out. A cell's dZ holds noise of its own: the median says more of a "
        "pair than its largest.</p>"
    )
