"""Draws a planned calibration: the plan's map with the planes that would be seen, and sigmas with their limits."""

from __future__ import annotations

import textwrap
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from swath.daemon.errors import ExitCode, UserError
from swath.daemon.processing.calibration.plan.run import PlannedCalibration
from swath.sim.preview.map import INK, MUTED, draw_map

FORMATS = (".pdf", ".png", ".svg")
DPI = 150
PAGE = (17.0, 10.6)  # inches
MAP, SIGMAS, COLOURS, WORDS = (0.75, 1.05, 8.6, 8.45), (12.2, 6.1, 4.4, 3.2), (6.7, 1.3, 2.4, 0.12), (10.2, 0.45)
GOOD, BAD = "#2f7fa3", "#c23b22"
SEEN_COLOURS = ("#f2c14e", "#5fb0a5", "#2f7fa3", "#3d4f96", "#4b2a78")
LINE_IN, LETTERS = 0.185, 92
MOST_RATIO, LEAST_RATIO = 30.0, 0.02


def require_picture(path: Path) -> None:
    """Refuse with `UserError` a path that does not end as a picture's."""
    if path.suffix.lower() not in FORMATS:
        raise UserError(f"{path}: want a picture's name that ends in one of {', '.join(FORMATS)}", ExitCode.USAGE)


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
    _sigmas(_panel(figure, SIGMAS), planned.rows)
    _words(figure, planned)
    figure.savefig(path, dpi=DPI)


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
    time_s = np.linspace(0.0, survey.trajectory.end_s, 2000)
    points = survey.site.site_from_e(survey.trajectory.poses(time_s).position_e)
    track = np.column_stack([time_s, points[:, :2], survey.site.heights(points)])
    corners = np.concatenate([survey.edges(strip) for strip in survey.strips])
    low, high = corners.min(axis=0), corners.max(axis=0)
    half = 0.6 * (high - low).max() * np.array(MAP[2:]) / min(MAP[2:])
    frame = ((low + high) / 2 - half, (low + high) / 2 + half, 1.0)
    axes = _panel(figure, MAP)
    draw_map(axes, survey, track, survey.scene.ground_m, frame)
    seen = np.array([len(plane.patches) for plane in planned.features.planes])
    centres = np.array([plane.centre_t for plane in planned.features.planes])
    bounds = np.array([1, 2, 3, 5, 8, max(int(seen.max()) + 1, 9)]) - 0.5
    colours = ListedColormap(SEEN_COLOURS)
    norm = BoundaryNorm(bounds.tolist(), colours.N)
    look: dict[str, Any] = {"cmap": colours, "norm": norm, "edgecolors": "white", "linewidths": 0.3, "zorder": 6}
    dots = axes.scatter(centres[:, 0], centres[:, 1], c=seen, s=13, **look)
    inset = _panel(figure, COLOURS)
    bar = figure.colorbar(dots, cax=inset, orientation="horizontal", ticks=(bounds[:-1] + bounds[1:]) / 2)
    bar.ax.set_xticklabels(["1", "2", "3–4", "5–7", "8 +"], fontsize=7)
    inset.set_title("planes, by the swaths that see them", fontsize=7.5, color=INK, pad=3)


def _sigmas(axes: Axes, rows: Sequence[dict[str, Any]]) -> None:
    """Draw bars of sigma over wanted sigma on a logarithmic scale; beyond 1 a parameter is not determined."""
    place = np.arange(len(rows))[::-1]
    ratio = np.array([MOST_RATIO if row["sigma"] is None else row["sigma"] / row["wanted"] for row in rows])
    shown = np.clip(ratio, LEAST_RATIO, MOST_RATIO)
    colours = [GOOD if row["determined"] else BAD for row in rows]
    axes.barh(place, shown - LEAST_RATIO, left=LEAST_RATIO, color=colours, height=0.62)
    axes.axvline(1.0, color=INK, lw=1.0)
    axes.set_xscale("log")
    axes.set(xlim=(LEAST_RATIO, MOST_RATIO * 12), ylim=(-0.7, len(rows) - 0.3), yticks=place)
    several = len({row["scanner"] for row in rows}) > 1
    names = [f"{row['scanner']} {row['name']}" if several else row["name"] for row in rows]
    axes.set_yticklabels(names, fontsize=7.5, color=INK)
    axes.set_xticks([0.1, 1.0, 10.0], labels=["a tenth", "wanted", "ten times"])
    axes.xaxis.set_minor_locator(NullLocator())
    for y, width, row in zip(place, shown, rows, strict=True):
        axes.text(width * 1.15, y, _sigma_words(row), fontsize=7.5, color=INK, va="center")
    axes.set_title(
        "Predicted sigma relative to the largest useful one", fontsize=9, weight="bold", color=INK, loc="left"
    )


def _sigma_words(row: dict[str, Any]) -> str:
    if row["sigma"] is None:
        return "undetermined"
    return f"± {row['sigma']:,.0f}" if row["sigma"] >= 1000.0 else f"± {row['sigma']:.3g}"


def _words(figure: Figure, planned: PlannedCalibration) -> None:
    """Write which parameters are not determined, what to fly for them, and what the prediction assumes."""
    left, line = WORDS[0] / PAGE[0], LINE_IN / PAGE[1]
    y = (SIGMAS[1] - 0.55) / PAGE[1]
    blocks = [
        (f"{row['name']}: {row['why']}.", f"To determine it: {row['remedy']}.") for row in planned.rows if row["why"]
    ]
    for number, (why, remedy) in enumerate(blocks or [("Every parameter of the model would be determined.", "")]):
        pieces = [(piece, "normal") for piece in textwrap.wrap(why, LETTERS)]
        pieces += [(piece, "bold") for piece in textwrap.wrap(remedy, LETTERS)]
        if y - len(pieces) * line < WORDS[1] / PAGE[1] + 4 * line:
            pieces = [(f"… and {len(blocks) - number} more, as the bars show.", "normal")]
        for piece, weight in pieces:
            figure.text(left, y, piece, fontsize=8, color=INK, weight=weight, va="top")
            y -= line
        y -= 0.45 * line
        if pieces[0][0].startswith("…"):
            break
    kinds = Counter(plane.kind for plane in planned.features.planes)
    position_m, tilt_deg, heading_deg = planned.sigmas
    assumed = (
        f"Predicted from {kinds['roof']} roofs and {kinds['ground']} pieces of ground that two swaths or more see, "
        f"{planned.control} control points; trajectory ± {position_m:.2g} m, roll and pitch ± {tilt_deg:.2g}°, heading "
        f"± {heading_deg:.2g}°, correlated in time."
    )
    text = "\n".join(textwrap.wrap(assumed, LETTERS + 8))
    figure.text(left, WORDS[1] / PAGE[1], text, fontsize=7.5, color=MUTED, va="bottom")
