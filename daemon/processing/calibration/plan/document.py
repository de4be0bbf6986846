"""Writes a planned calibration as a page and PDF: the verdict, the map, every parameter's sigma, what to fly."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

from pyproj import CRS

from swath.calib.labels import Unknown, decimals_of, number, plain, thousands, unknown
from swath.daemon.processing.calibration.plan.page import NAMES, map_png
from swath.daemon.processing.calibration.plan.run import PlannedCalibration
from swath.daemon.processing.files import write_whole
from swath.daemon.processing.pages.blocks import Block, Card, Cell, Image, Judged, Notes, Table, Words, data_uri
from swath.daemon.processing.pages.head import PageHead, crs_words
from swath.daemon.processing.pages.pdf import page_files
from swath.daemon.processing.pages.render import Page, html_of
from swath.georef.verdicts import Level, Verdict

HTML = ".html"
TITLE = "Planned lines and planes"
WORDS = "Dots: planes, coloured by the number of swaths that see them. Lines and their swaths have the same colour."
HOW = (
    "The lines are flown on paper over the terrain. The returns that would lie on roofs, bare ground and around "
    "control points go through the equations of swath calibrate, with the errors that the trajectory is expected to "
    "have, correlated in time. A parameter is determined where its sigma, with the effect of held parameters, is not "
    "above the largest useful one."
)


def write_planned(planned: PlannedCalibration, path: Path, warnings: list[str]) -> list[Path]:
    """Write the page and its PDF; return what was written.

    Args:
        planned: result of `plan_calibration`.
        path: path of an HTML file; the PDF beside it has its stem.
        warnings: gets a line if the PDF cannot be made.

    Raises:
        OSError: a file cannot be written.
    """
    files = page_files(path, planned_page(planned), warnings)
    write_whole(files)
    return list(files)


def planned_page(planned: PlannedCalibration) -> str:
    """Return the HTML text of the page."""
    tables = planned.survey.plan.tables
    level = Level.UNUSABLE if planned.lacking else Level.GOOD
    missing = [
        [_words(planned, row), _sentence(planned, row["why"]), _sentence(planned, row["remedy"])]
        for row in planned.rows
        if row["why"]
    ]
    heads = ("parameter", "why", "what to fly")
    blocks: list[Block] = [
        *([Notes(planned.notes)] if planned.notes else []),
        _parameters(planned),
        *([Table("Not determined", heads, missing, left=(0, 1, 2), stacked=True)] if missing else []),
        Image(TITLE, data_uri(map_png(planned), "image/png"), title=TITLE, words=WORDS),
    ]
    crs = tables.flight.crs
    head = PageHead(crs=crs_words({"name": CRS.from_user_input(crs).name, "crs": crs}))
    page = Page(
        "Planned calibration",
        tables.flight.name,
        head,
        blocks,
        Verdict(level, planned.sentence, ()),
        _cards(planned),
        appendix=[Words(HOW, "How it was predicted")],
    )
    return html_of(page)


def _cards(planned: PlannedCalibration) -> list[Card]:
    kinds = Counter(plane.kind for plane in planned.features.planes)
    position_m, tilt_deg, heading_deg = planned.sigmas
    determined = sum(row["determined"] for row in planned.rows)
    return [
        (f"{determined} of {len(planned.rows)}", "parameters determined"),
        (str(len(planned.survey.strips)), "lines"),
        (thousands(kinds["roof"]), "roofs that two swaths or more see"),
        (thousands(kinds["ground"]), "pieces of ground"),
        (str(planned.control), "control points"),
        (f"{number(100.0 * position_m, '.2g')} cm", "trajectory, sigma of position"),
        (f"{number(tilt_deg, '.2g')}°", "sigma of roll and pitch"),
        (f"{number(heading_deg, '.2g')}°", "sigma of heading"),
    ]


def _parameters(planned: PlannedCalibration) -> Table:
    """Return a table of every parameter's predicted sigma and the largest useful one."""
    rows: list[list[Cell]] = []
    for row in planned.rows:
        useful = float(row["wanted"])
        sigma = "none" if row["sigma"] is None else sigma_words(row["sigma"])
        verdict = Judged("yes", good=True) if row["determined"] else Judged("no", good=False)
        rows.append([_words(planned, row), _unknown(row).unit, sigma, number(useful, ".6g"), verdict])
    return Table("Parameters", ("parameter", "unit", "predicted sigma", "largest useful sigma", "determined"), rows)


def sigma_words(sigma: float | None) -> str:
    """Return a sigma with two digits; a dash if there is none."""
    return "–" if sigma is None else number(sigma, f".{decimals_of(sigma)}f")


def _unknown(row: dict[str, Any]) -> Unknown:
    return unknown(f"{row['scanner']}.{NAMES[row['name']]}")


def _words(planned: PlannedCalibration, row: dict[str, Any]) -> str:
    """Return a parameter's words, with its scanner if there are several."""
    several = len({one["scanner"] for one in planned.rows}) > 1
    words = _unknown(row).words
    return f"{words} of {row['scanner']}" if several else words


def _sentence(planned: PlannedCalibration, text: str) -> str:
    several = len({one["scanner"] for one in planned.rows}) > 1
    return plain(text, several=several)
