"""Writes the page of a scanner's calibrations over time: what changed, tables, and a picture for each parameter."""

from __future__ import annotations

import datetime as dt
import io
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from swath.calib.labels import unknown, worded
from swath.calib.validation.courses import Course, ScannerCourse, Step
from swath.calib.validation.history import date_words
from swath.daemon.errors import ExitCode, UserError
from swath.daemon.processing.files import write_whole
from swath.daemon.processing.history.run import FIRST, Collected, csv_text, table_of
from swath.daemon.processing.pages.blocks import Block, Card, Image, Judged, Notes, Table, Words, data_uri
from swath.daemon.processing.pages.head import PageHead
from swath.daemon.processing.pages.names import HISTORY, HISTORY_TABLE, PRINTED
from swath.daemon.processing.pages.pdf import page_files
from swath.daemon.processing.pages.render import Page, html_of
from swath.daemon.processing.pages.words import INK, MUTED
from swath.georef.arrays import FloatArray
from swath.georef.scanner.calibration import INDEX, Calibration

DAY_S = 86_400.0
DPI = 110
DAYS_BESIDE = 15.0  # least shown on each side of the dates
LEAST_APART = 0.015  # of the width; calibrations of one flight have one date
PARAMETERS_ACROSS = 3  # in a table
COLOURS = ("#2f6690", "#b3541e", "#4f772d", "#7b4b94", "#9c6b00", "#1f7a8c")  # one a mounting
HOW = (
    "Points are values with one sigma at the dates of the flights, a colour for each mounting. Successive calibrations "
    "are compared by the χ² of all parameters that both estimated, with their correlations. Within one mounting a "
    "parameter is constant if chance explains its scatter (p of at least 0.001); otherwise a steady drift and a jump "
    "between two calibrations are tried."
)


def write_history(found: Collected, folder: Path, warnings: list[str]) -> list[Path]:
    """Write page, PDF and CSV into a folder; return their paths.

    Args:
        found: what was collected.
        folder: where the files go.
        warnings: gets a line if the PDF cannot be made.

    Raises:
        UserError: the folder cannot be written to.
    """
    page = folder / HISTORY
    files = page_files(page, history_page(found), warnings) | {folder / HISTORY_TABLE: csv_text(found).encode()}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        page.with_suffix(PRINTED).unlink(missing_ok=True)  # of an earlier run
        write_whole(files)
    except OSError as error:
        raise UserError(f"{folder}: is not writable ({error.strerror or error})", ExitCode.IO) from error
    return list(files)


def history_page(found: Collected) -> str:
    """Return the HTML text of the page."""
    blocks: list[Block] = []
    for one in found.scanners:
        blocks += _of_scanner(one, several=len(found.scanners) > 1)
    if found.notes:
        blocks.append(Notes(found.notes))
    entries = [entry for one in found.scanners for entry in one.entries]
    times = [time for one in found.scanners for time in one.times_s]
    changed = sum(step.changed for one in found.scanners for step in one.steps)
    cards: list[Card] = [
        _counted(len(entries), "calibration"),
        _counted(len(found.scanners), "scanner"),
        _counted(len({mounting for one in found.scanners for mounting in one.mountings}), "mounting"),
        _counted(changed, "significant change"),
    ]
    subtitle = " to ".join(dict.fromkeys(date_words(time)[:10] for time in (min(times), max(times))))
    heading = ", ".join(one.title for one in found.scanners)
    page = Page(
        "History of calibrations", heading, PageHead(), blocks, cards=cards, subtitle=subtitle,
        appendix=[Words(HOW, "How changes are told")],
    )  # fmt: skip
    return html_of(page)


def _counted(count: int, words: str) -> Card:
    return str(count), words if count == 1 else f"{words}s"


def _of_scanner(one: ScannerCourse, *, several: bool) -> Iterator[Block]:
    prefix = f"{one.title}: " if several else ""
    steps = [
        [
            f"{step.before} to {step.after}",
            {True: "yes", False: "no", None: "not known"}[step.remounted],
            _change_cell(step),
        ]
        for step in one.steps
    ]
    if steps:
        yield Table(
            f"{prefix}From one calibration to the next", ("between", "mounted anew", "change"), steps, left=(0, 1, 2)
        )
    rows = [[mounting, *_course_cells(course)] for mounting, courses_of in one.courses.items() for course in courses_of]
    if rows:
        yield Table(f"{prefix}Within each mounting", ("mounting", "parameter", "course"), rows, left=(0, 1, 2))
    for name in one.names:
        words = unknown(f".{name}").words
        yield Image(f"{words} over time", data_uri(picture(one, name), "image/png"), title=f"{prefix}{words}")
    heads, all_rows = table_of(one)
    for first in range(FIRST, len(heads), PARAMETERS_ACROSS):  # as many as a sheet of paper holds
        shown = [0, 1, *([2] if first == FIRST else []), *range(first, min(first + PARAMETERS_ACROSS, len(heads)))]
        title = f"{prefix}All calibrations" if first == FIRST else ""
        picked = [[row[column] for column in shown] for row in all_rows]
        yield Table(title, [heads[column] for column in shown], picked, left=(0, 1, 2) if first == FIRST else (0, 1))


def _change_cell(step: Step) -> str | Judged:
    """Return what changed; after a new mounting a change is expected, and no colour judges it."""
    words = worded(step.words.partition(": ")[2])
    return words if step.remounted or step.compared is None else Judged(words, good=not step.changed)


def _course_cells(course: Course) -> list[str | Judged]:
    name, _, words = course.words.partition(": ")
    return [name, words if course.kind in ("constant", "once") else Judged(words, good=False)]


def picture(one: ScannerCourse, name: str) -> bytes:
    """Return a PNG of a parameter's values with one sigma over time, a colour for each mounting."""
    figure = Figure(figsize=(9.0, 3.0), facecolor="white", layout="constrained")
    axes = figure.subplots()
    named = unknown(f".{name}")
    mountings = list(dict.fromkeys(one.mountings))
    drawn = _apart(np.array(one.times_s) / DAY_S)  # Matplotlib's dates: days since 1970
    for index, mounting in enumerate(mountings):
        at = [k for k, entry in enumerate(one.entries) if one.mountings[k] == mounting and _sigma(entry, name) > 0.0]
        if not at:
            continue
        values = np.array([one.entries[k].value(name) for k in at]) * named.factor
        sigmas = np.array([_sigma(one.entries[k], name) for k in at]) * named.factor
        days = drawn[at]
        axes.errorbar(
            days, values, sigmas, fmt="o-", color=COLOURS[index % len(COLOURS)], capsize=3, lw=1.0, ms=4.5,
            label=mounting,
        )  # fmt: skip
    _style(axes, f"{named.words.partition(' (')[0]}, {named.unit}", legend=len(mountings) > 1)
    made = io.BytesIO()
    figure.savefig(made, dpi=DPI)
    return made.getvalue()


def _apart(days: FloatArray) -> FloatArray:
    """Move dates (n,) that would cover each other apart, in their order, by a little of the width of the picture."""
    least = LEAST_APART * max(float(np.ptp(days)), 2.0 * DAYS_BESIDE)
    moved = days.copy()
    for at in range(1, len(days)):
        moved[at] = max(days[at], moved[at - 1] + least)
    return moved


def _style(axes: Axes, label: str, *, legend: bool) -> None:
    axes.set_ylabel(label, fontsize=9, color=INK)
    axes.ticklabel_format(axis="y", useOffset=False)
    axes.tick_params(labelsize=8, colors=MUTED)
    axes.xaxis_date(dt.UTC)
    axes.margins(x=0.08)
    if axes.dataLim.width < 2.0 * DAYS_BESIDE:  # of one date alone Matplotlib shows years
        middle = (axes.dataLim.x0 + axes.dataLim.x1) / 2.0
        axes.set_xlim(middle - DAYS_BESIDE, middle + DAYS_BESIDE)
    axes.grid(color="#c9cecb", lw=0.4)
    axes.spines[["top", "right"]].set_visible(False)
    if legend:
        axes.legend(fontsize=8, frameon=False, loc="best")


def _sigma(entry: Calibration, name: str) -> float:
    return float(entry.sigmas[INDEX[name]])
