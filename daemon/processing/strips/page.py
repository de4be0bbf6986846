"""Writes the files of a comparison of strips: its page, which begins with the verdict, PDF, maps and record."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path

from swath.calib.labels import decimals_of, number, thousands, words_of
from swath.calib.strips.signatures import MATTERS_M, SIGNIFICANT, Signature
from swath.calib.strips.standards import TO_CONFIRM
from swath.daemon.errors import ExitCode, UserError
from swath.daemon.processing.earlier_runs import listed_files, relative_to
from swath.daemon.processing.files import aside_folder, write_whole
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
from swath.daemon.processing.pages.names import STRIPS, STRIPS_PICTURES
from swath.daemon.processing.pages.pdf import page_files
from swath.daemon.processing.pages.render import Page, html_of
from swath.daemon.processing.quicklook.maps import draw_differences
from swath.daemon.processing.strips.compare import RECORD, WORST_PAIRS, Compared, Judgement
from swath.daemon.written import error_words

MAP_TITLE = "Height difference of overlapping strips"
MAP_TITLES = (f"{MAP_TITLE}, now", f"{MAP_TITLE}, before")
MOST_PAIRS = 300  # of the complete list
LEVEL_WORDS = {"none": "not significant", "small": "too small to matter", "not told": "not determined"}
TO_PLANE = (
    "To plane: distance of single returns of the first strip from the plane of the second strip's, along its normal, "
    "on all slopes up to 45°. Its RMS contains the noise of a single return in full, so it is larger than RMSDz."
)


def write_comparison(done: Compared, folder: Path, level: str | None, warnings: list[str]) -> list[Path]:
    """Write page, PDF, maps and record of a comparison into a folder; return what a person may open.

    Args:
        done: the comparison; its record gets the names of page and maps.
        folder: where the files go.
        level: quality level that the strips must meet; None: none is required.
        warnings: gets a line if the PDF cannot be made.

    Raises:
        UserError: the folder cannot be written to.
    """
    try:
        with aside_folder(folder, listed_files(folder / RECORD)) as aside:
            maps = []
            for name, title, one in zip(STRIPS_PICTURES, MAP_TITLES, (done.now, done.before), strict=True):
                if one is not None:
                    title = title if done.before is not None else MAP_TITLE
                    draw_differences(one.strips.look, aside / name, title)
                    maps.append((title, aside / name))
            files = page_files(aside / STRIPS, strips_page(done.now, done.before, level, maps), warnings)
            shown = [folder / path.name for path in (*files, *(path for _, path in maps))]
            pictures = [str(folder / path.name) for _, path in maps]
            points = [source.path for one in (done.now, done.before) if one for source in one.strips.look.sources]
            listed = {"of": relative_to(folder, points), "files": [path.name for path in shown]}
            done.record.update({"pictures": pictures, "page": str(folder / STRIPS)} | listed)
            files[aside / RECORD] = (json.dumps(done.record, indent=2, allow_nan=False) + "\n").encode()
            write_whole(files)
    except OSError as error:
        raise UserError(error_words(error, folder), ExitCode.IO) from error
    return shown


def strips_page(now: Judgement, before: Judgement | None, level: str | None, maps: Sequence[tuple[str, Path]]) -> str:
    """Return the HTML text of the page.

    Args:
        now: the strips that are judged.
        before: their earlier state; None: no comparison with one.
        level: quality level that they must meet; None: none is required.
        maps: titles and files of the maps of differences.
    """
    verdict = now.verdict(level)
    blocks: list[Block] = [
        *reasons_of(verdict),
        *_notes(now),
        *_change(now, before),
        _strips(now),
        *_pairs(now, WORST_PAIRS),
        *(Image(title, data_uri(path.read_bytes(), "image/png")) for title, path in maps),
        *_causes(now),
        *_specifications(now),
    ]
    every = _pairs(now, MOST_PAIRS) if len(now.pairs()) > WORST_PAIRS else []
    method = [
        Words(
            f"{now.agreement.measure}. First strip minus second; nothing else is judged.",
            "How it was measured",
        ),
        Words(TO_PLANE),
    ]
    heading = Path(now.strips.what).name or now.strips.what
    page = Page(
        "Comparison of strips", heading, now.strips.head, blocks, verdict, _cards(now), appendix=[*every, *method]
    )
    return html_of(page)


def _cm(metres: float | None, digits: int = 1, *, sign: bool = False) -> str:
    """Return centimetres without their unit, which the table's head gives."""
    return number(None if metres is None else 100.0 * metres, f"{'+' if sign else ''}.{digits}f")


def _cards(now: Judgement) -> list[Card]:
    agreement, numbers = now.agreement, now.agreement.numbers
    cards: list[Card] = []
    if numbers is not None:
        cards += [
            (f"{_cm(numbers['rms_m'])} cm", "RMSDz of all pairs"),
            (f"{_cm(numbers['p95_m'])} cm", "95 % of |dZ| are below"),
            (thousands(numbers["cells"]), f"comparisons in cells of {agreement.cell_m:g} m"),
        ]
    cards.append((agreement.best or ("none" if agreement.judged else "no verdict"), "best quality level met"))
    cards += [(str(len(now.strips.look.names)), "strips"), (str(len(now.pairs())), "pairs that overlap")]
    if math.isfinite(agreement.pulses_m2):
        cards.append((f"{agreement.pulses_m2:.3g}", "pulses per m², all strips together"))
    return cards


def _notes(now: Judgement) -> list[Block]:
    return [Notes(now.strips.notes)] if now.strips.notes else []


def _change(now: Judgement, before: Judgement | None) -> list[Block]:
    """Return a table of the differences before and now."""
    if before is None:
        return []
    rows = [
        [words, *(_cm(numbers[key]) for key in ("mean_m", "rms_m", "p95_m", "max_m"))]
        for words, one in (("before", before), ("now", now))
        if (numbers := one.agreement.numbers) is not None
    ]
    heads = ("all pairs", "mean dZ, cm", "RMSDz, cm", "95 % of |dZ|, cm", "largest, cm")
    return [Table("Before and now", heads, rows)] if rows else []


def _strips(now: Judgement) -> Table:
    """Return a table of every strip against all others."""
    rows = [
        [
            one.name,
            str(one.neighbours),
            thousands(one.cells),
            _cm(one.above_m, sign=True),
            _cm(one.rms_m),
            _cm(one.scatter_m),
            number(one.returns_m2, ".1f"),
        ]
        for one in now.strip_rows()
    ]
    heads = ("strip", "neighbours", "smooth cells", "above the others, cm", "RMSDz, cm", "scatter within, cm")
    under = "Scatter within: sigma of single returns about their planes, on the smoothest quarter of gentle ground."
    return Table("Strips", (*heads, "single returns per m²"), rows, under)


def _pairs(now: Judgement, most: int) -> list[Block]:
    """Return a table of the pairs with the largest RMSDz."""
    pairs = now.pairs()
    rows = []
    for first, second, heights, to_plane in pairs[:most]:
        numbers = heights or {}
        row = [f"{first} − {second}", thousands(numbers["cells"]) if numbers else "–"]
        row += [_cm(numbers.get("mean_m"), sign=True), *(_cm(numbers.get(key)) for key in ("rms_m", "p95_m", "max_m"))]
        row += ["–", "–"] if to_plane is None else [_cm(to_plane.distance.rms_m), _cm(to_plane.noise_m)]
        rows.append(row)
    if not rows:
        return []
    several = len(pairs) > WORST_PAIRS
    title = "Pairs" if not several else f"The {WORST_PAIRS} worst pairs" if most == WORST_PAIRS else "All pairs"
    heads = (
        "strips",
        "smooth cells",
        "mean dZ, cm",
        "RMSDz, cm",
        "95 % of |dZ|, cm",
        "largest, cm",
        "to plane, RMS cm",
    )
    return [
        Table(title, (*heads, "of it noise, cm"), rows, omitted=len(pairs) - len(rows) if most > WORST_PAIRS else 0)
    ]


def _causes(now: Judgement) -> list[Block]:
    """Return what the differences look like: an error of the calibration, or none."""
    title = "What the differences look like"
    found = now.signatures
    if found is None:
        return []
    if found.rough:
        return [Words(f"{line[0].upper()}{line[1:]}.", title) for line in found.lines]
    rows = [_effect(one) for one in found.found]
    heads = ("effect", "parameter", "to be added", "sigma", "size / sigma", "at the swath's edge, cm", "verdict")
    under = (
        f"Significant: beyond {SIGNIFICANT:g} sigmas and {100 * MATTERS_M:g} cm at the swath's edge. RMS of "
        f"{thousands(found.rows)} distances: {_cm(found.rms_m)} cm; {_cm(found.left_rms_m)} cm without the effects and "
        f"the errors of the trajectory. {' '.join(f'{note[0].upper()}{note[1:]}.' for note in found.prior_notes)}"
    )
    return [Table(title, heads, rows, under, left=(0, 1, 6))]


def _effect(one: Signature) -> list[Cell]:
    effect = one.effect
    parameter = words_of("", effect.parameter, several=False)
    if not math.isfinite(one.value):
        why = one.words.partition(": ")[2] or one.words
        return [effect.name, parameter, "–", "–", "–", "–", f"{LEVEL_WORDS.get(one.level, one.level)}: {why}"]
    pattern = f".{decimals_of(effect.factor * one.sigma)}f"
    value, sigma = (
        f"{number(effect.factor * size, form)} {effect.unit.partition(' of ')[0]}".replace(" °", "°")
        for size, form in ((one.value, f"+{pattern}"), (one.sigma, pattern))
    )
    verdict: Cell = LEVEL_WORDS.get(one.level, one.level)
    if one.level == "significant":
        verdict = Judged(f"significant: {effect.look}", good=False)
    times = number(abs(one.value) / one.sigma, ".1f")
    return [effect.name, parameter, value, sigma, times, _cm(one.edge_m), verdict]


def _specifications(now: Judgement) -> list[Block]:
    lines = now.agreement.verdicts()
    confirm = [Words(f"{TO_CONFIRM[0].upper()}{TO_CONFIRM[1:]}.", muted=True)] if TO_CONFIRM in lines else []
    said = [line for line in lines if line != TO_CONFIRM]
    return [Words(" ".join(f"{line[0].upper()}{line[1:]}." for line in said), "Specifications"), *confirm]
