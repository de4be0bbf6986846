"""Draws a planned calibration: the plan's map with the planes that would be seen, and sigmas with their limits."""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import NullFormatter, NullLocator
from matplotlib.transforms import Bbox

from swath.calib.labels import Unknown, decimals_of, plain, unknown
from swath.daemon.errors import ExitCode, UserError
from swath.daemon.processing.calibration.plan.run import PlannedCalibration
from swath.georef.scanner.calibration import PARAMETERS
from swath.sim.preview.chart import Chart
from swath.sim.preview.map import INK, MUTED, draw_map

FORMATS = (".html", ".pdf", ".png", ".svg")
DPI = 150
PAGE = (17.0, 10.6)  # inches
MAP, COLOURS = (0.75, 1.05, 8.6, 8.45), (6.75, 1.35, 2.3, 0.12)
COLUMN, RIGHT = 9.9, 16.7  # left and right edge of the column beside the map
NAMES_IN, NUMBERS_IN, ROW_IN, TOP, FOOT = 2.0, 2.1, 0.3, 8.95, 1.05
GOOD, BAD = "#2f7fa3", "#c23b22"
SEEN_COLOURS = ("#f2c14e", "#5fb0a5", "#2f7fa3", "#3d4f96", "#4b2a78")
WORDS_PT, LINE_IN = 9.5, 0.21
MOST_RATIO, LEAST_RATIO = 30.0, 0.02
NAMES = {parameter.key: parameter.name for parameter in PARAMETERS}


def require_picture(path: Path) -> None:
    """Refuse with `UserError` a path that does not end as a page's or a picture's."""
    if path.suffix.lower() not in FORMATS:
        raise UserError(f"{path}: want a file's name that ends in one of {', '.join(FORMATS)}", ExitCode.USAGE)


def draw_planned(planned: PlannedCalibration, path: Path) -> None:
    """Draw a planned calibration on one page.

    Args:
        planned: result of `plan_calibration`.
        path: path of a PNG, PDF or SVG file.

    Raises:
        UserError: the path has another ending; OSError: the file cannot be written.
    """
    require_picture(path)
    figure = Figure(figsize=PAGE, facecolor="white")
    _title(figure, planned)
    _map(figure, planned)
    below = _sigmas(figure, planned.rows)
    _words(figure, planned, below)
    figure.savefig(path, dpi=DPI)


def map_png(planned: PlannedCalibration) -> bytes:
    """Return the map alone as PNG."""
    figure = Figure(figsize=PAGE, facecolor="white")
    _map(figure, planned)
    left, bottom, width, height = MAP
    box = Bbox([[left - 0.7, bottom - 0.95], [left + width + 0.25, bottom + height + 0.2]])
    made = io.BytesIO()
    figure.savefig(made, format="png", dpi=DPI, bbox_inches=box)
    return made.getvalue()


def _panel(figure: Figure, box: tuple[float, float, float, float]) -> Axes:
    left, bottom, width, height = box
    axes = figure.add_axes((left / PAGE[0], bottom / PAGE[1], width / PAGE[0], height / PAGE[1]))
    axes.tick_params(labelsize=7.5, colors=MUTED, length=3)
    axes.spines[:].set_color("#b8b8b0")
    return axes


def _title(figure: Figure, planned: PlannedCalibration) -> None:
    x, top = 0.75 / PAGE[0], 1.0 - 0.42 / PAGE[1]
    name = planned.survey.plan.tables.flight.name
    figure.text(x, top, f"Planned calibration “{name}”", fontsize=17, weight="bold", color=INK, va="center")
    colour = BAD if planned.lacking else GOOD
    figure.text(x, top - 0.33 / PAGE[1], planned.sentence, fontsize=11, weight="bold", color=colour, va="center")


def _map(figure: Figure, planned: PlannedCalibration) -> None:
    """Draw the plan's own map, and on it every plane, coloured by the number of swaths that see it."""
    survey = planned.survey
    chart = Chart(survey)
    time_s = np.linspace(0.0, survey.trajectory.end_s, 2000)
    points = survey.site.site_from_e(survey.trajectory.poses(time_s).position_e)
    track = np.column_stack([time_s, points[:, :2], survey.site.heights(points)])
    corners = chart.place(np.concatenate([survey.edges(strip) for strip in survey.strips]))
    low, high = corners.min(axis=0), corners.max(axis=0)
    half = 0.6 * (high - low).max() * np.array(MAP[2:]) / min(MAP[2:])
    frame = ((low + high) / 2 - half, (low + high) / 2 + half, 1.0)
    axes = _panel(figure, MAP)
    draw_map(axes, survey, track, survey.scene.ground_m, frame, chart)
    seen = np.array([len(plane.patches) for plane in planned.features.planes])
    centres = np.array([plane.centre_t for plane in planned.features.planes]).reshape(-1, 3)
    centres = chart.place(survey.site.site_from_e(planned.flight.frame.e_from_t(centres))[:, :2])
    bounds = np.array([1, 2, 3, 5, 8, max(int(seen.max(initial=0)) + 1, 9)]) - 0.5
    colours = ListedColormap(SEEN_COLOURS)
    norm = BoundaryNorm(bounds.tolist(), colours.N)
    look: dict[str, Any] = {"cmap": colours, "norm": norm, "edgecolors": "white", "linewidths": 0.3, "zorder": 6}
    dots = axes.scatter(centres[:, 0], centres[:, 1], c=seen, s=13, **look)
    left, bottom, width, height = COLOURS
    place = (left - 0.12) / PAGE[0], (bottom - 0.22) / PAGE[1]
    size = (width + 0.24) / PAGE[0], (height + 0.48) / PAGE[1]
    look = {"fc": "white", "ec": "none", "alpha": 0.85, "zorder": 12}
    axes.add_patch(Rectangle(place, *size, transform=figure.transFigure, **look))
    inset = _panel(figure, COLOURS)
    bar = figure.colorbar(dots, cax=inset, orientation="horizontal", ticks=(bounds[:-1] + bounds[1:]) / 2)
    bar.ax.set_xticklabels(["1", "2", "3–4", "5–7", "8 +"], fontsize=7)
    inset.set_title("planes, by the number of swaths", fontsize=7.5, color=INK, pad=3)


def _sigmas(figure: Figure, rows: Sequence[dict[str, Any]]) -> float:
    """Draw bars of sigma over useful sigma on a logarithmic scale, with both numbers beside them.

    Returns:
        The lower edge of the chart, inches from that of the page. Beyond 1 a parameter is not determined.
    """
    row_in = min(ROW_IN, 4.6 / max(len(rows), 1))
    bottom = TOP - row_in * len(rows)
    width = RIGHT - NUMBERS_IN - COLUMN - NAMES_IN
    axes = _panel(figure, (COLUMN + NAMES_IN, bottom, width, TOP - bottom))
    place = np.arange(len(rows))[::-1]
    ratio = np.array([MOST_RATIO if row["sigma"] is None else row["sigma"] / row["wanted"] for row in rows])
    shown = np.clip(ratio, LEAST_RATIO, MOST_RATIO)
    colours = [GOOD if row["determined"] else BAD for row in rows]
    axes.barh(place, shown - LEAST_RATIO, left=LEAST_RATIO, color=colours, height=0.62)
    axes.axvline(1.0, color=INK, lw=1.0)
    axes.set_xscale("log")
    axes.set(xlim=(LEAST_RATIO, MOST_RATIO), ylim=(-0.5, len(rows) - 0.5), yticks=place)
    several = len({row["scanner"] for row in rows}) > 1
    size = 9.0 if row_in > 0.2 else 7.5
    names = [f"{row['scanner']}: {_named(row).words}" if several else _named(row).words for row in rows]
    axes.set_yticklabels(names, fontsize=size, color=INK)
    axes.set_xticks([0.1, 1.0, 10.0], labels=["0.1 ×", "1 ×", "10 ×"])
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("predicted sigma / largest useful sigma", fontsize=8.5, color=MUTED)
    columns = [RIGHT - 0.5 * NUMBERS_IN, RIGHT]
    for row, y in zip(rows, (bottom + row_in * (place + 0.5)).tolist(), strict=True):
        for x, text in zip(columns, _numbers(row), strict=True):
            figure.text(x / PAGE[0], y / PAGE[1], text, fontsize=size, color=INK, ha="right", va="center")
    above = (TOP + 0.1) / PAGE[1]
    for x, text in zip(columns, ("predicted", "useful"), strict=True):
        figure.text(x / PAGE[0], above, text, fontsize=8.5, color=MUTED, ha="right")
    look: dict[str, Any] = {"fontsize": 10.5, "weight": "bold", "color": INK}
    figure.text(COLUMN / PAGE[0], (TOP + 0.4) / PAGE[1], "Predicted sigmas beside the largest useful ones", **look)
    return bottom


def _named(row: dict[str, Any]) -> Unknown:
    """Return the name of a row's parameter for display, with its unit."""
    return unknown(f"{row['scanner']}.{NAMES[row['name']]}")


def _numbers(row: dict[str, Any]) -> tuple[str, str]:
    """Return the predicted and the useful sigma with their unit; the first with two digits."""
    unit = _named(row).unit
    space = "" if unit == "°" else " "
    useful = f"± {row['wanted']:g}{space}{unit}"
    if row["sigma"] is None:
        return "undetermined", useful
    return f"± {row['sigma']:.{decimals_of(row['sigma'])}f}{space}{unit}", useful


def _words(figure: Figure, planned: PlannedCalibration, below: float) -> None:
    """Write which parameters are not determined, what to fly for them, and what the prediction assumes."""
    several = len({row["scanner"] for row in planned.rows}) > 1
    y = below - 0.85
    blocks = [_why(row, several=several) for row in planned.rows if row["why"]]
    for number, (why, remedy) in enumerate(blocks or [("Every parameter of the model would be determined.", "")]):
        pieces = [(piece, "normal") for piece in _wrapped(figure, why, "normal")]
        pieces += [(piece, "bold") for piece in _wrapped(figure, remedy, "bold")]
        left_out = y - len(pieces) * LINE_IN < FOOT + 4 * LINE_IN
        if left_out:
            pieces = [(f"… and {len(blocks) - number} more, as the bars show.", "normal")]
        for piece, weight in pieces:
            style: dict[str, Any] = {"fontsize": WORDS_PT, "color": INK, "weight": weight, "va": "top"}
            figure.text(COLUMN / PAGE[0], y / PAGE[1], piece, **style)
            y -= LINE_IN
        y -= 0.45 * LINE_IN
        if left_out:
            break
    kinds = Counter(plane.kind for plane in planned.features.planes)
    position_m, tilt_deg, heading_deg = planned.sigmas
    assumed = (
        f"Predicted from {kinds['roof']} roofs and {kinds['ground']} pieces of ground that two swaths or more see, "
        f"{planned.control} control points; trajectory ± {100.0 * position_m:.2g} cm, roll and pitch "
        f"± {tilt_deg:.2g}°, heading ± {heading_deg:.2g}°, correlated in time."
    )
    text = "\n".join(_wrapped(figure, assumed, "normal"))
    figure.text(COLUMN / PAGE[0], FOOT / PAGE[1], text, fontsize=WORDS_PT, color=MUTED, va="bottom", linespacing=1.4)


def _why(row: dict[str, Any], *, several: bool) -> tuple[str, str]:
    """Return why a parameter is not determined, and what to fly for it."""
    name = f"{row['scanner']}: {_named(row).words}" if several else _named(row).words
    predicted, useful = _numbers(row)
    why = (
        f"{predicted}, {useful} or better is useful" if row["sigma"] is not None else plain(row["why"], several=several)
    )
    return f"{name[0].upper()}{name[1:]}: {why}.", f"To determine it: {plain(row['remedy'], several=several)}."


def _wrapped(figure: Figure, text: str, weight: str) -> list[str]:
    """Return the lines of a text that fit into the column, by the widths of its words as drawn."""
    canvas: Any = FigureCanvasAgg(figure)
    renderer = canvas.get_renderer()
    most_px = (RIGHT - COLUMN) * figure.dpi
    probe = figure.text(0.0, 0.0, "", fontsize=WORDS_PT, weight=weight)
    lines: list[str] = []
    for word in text.split(" ") if text else []:
        probe.set_text(f"{lines[-1]} {word}" if lines else word)
        if lines and probe.get_window_extent(renderer).width <= most_px:
            lines[-1] = probe.get_text()
        else:
            lines.append(word)
    probe.remove()
    return lines
