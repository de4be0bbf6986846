"""Draws cuts through roofs before and after: they show at a glance the effect of a calibration."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from swath.calib.features import Plane
from swath.calib.flight import Flight
from swath.calib.summary import ReportInput
from swath.daemon.processing.calibration.report.maps import strip_colours
from swath.daemon.processing.pages.canvas import INK, MOST_MARKS, MUTED, Canvas, Format, Panels, Picture
from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.scanner.calibration import Calibration

MOST_CUTS = 3
HALF_LENGTH_M, HALF_WIDTH_M, MARGIN_M = 11.0, 0.6, 6.0
LEAST_SLOPE_DEG, MOST_SLOPE_DEG = 15.0, 65.0
MOST_DRAWN = 1500  # maximum points drawn per swath
PANEL_IN = 1.75
MARKS = ("o", "^", "s", "D")


@dataclass(frozen=True, eq=False)
class Cut:
    """Points along a line down a roof.

    Attributes:
        name: name of the roof's plane.
        before, after: points (n, 2) by index of the swath: along the line and up from the plane's centre, metres.
    """

    name: str
    before: Mapping[int, FloatArray]
    after: Mapping[int, FloatArray]


def cuts_of(report: ReportInput) -> list[Cut]:
    """Return cuts through a few roofs that most swaths saw, far from each other."""
    chosen: list[Plane] = []
    slopes = [plane for plane in report.features.planes if _is_roof(plane)]
    for plane in sorted(slopes, key=lambda one: (-len(one.patches), -one.points, one.name)):
        apart = [float(np.linalg.norm(plane.centre_t - other.centre_t)) for other in chosen]
        if min(apart, default=np.inf) > 4.0 * HALF_LENGTH_M:
            chosen.append(plane)
        if len(chosen) == MOST_CUTS:
            break
    cuts = [_cut(report.flight, report.adjusted.calibrations, plane) for plane in chosen]
    return [cut for cut in cuts if len(cut.after) > 1]


def _is_roof(plane: Plane) -> bool:
    slope = math.degrees(math.acos(min(abs(float(plane.normal_t[2])), 1.0)))
    return LEAST_SLOPE_DEG < slope < MOST_SLOPE_DEG and len(plane.patches) > 1


def _cut(flight: Flight, calibrations: Mapping[str, Calibration], plane: Plane) -> Cut:
    down = plane.normal_t[:2] / float(np.linalg.norm(plane.normal_t[:2]))
    starts = flight.starts()
    before: dict[int, FloatArray] = {}
    after: dict[int, FloatArray] = {}
    for index in sorted({patch.swath for patch in plane.patches}):
        swath = flight.swaths[index]
        at = _near(swath.points_t, plane.centre_t, HALF_LENGTH_M + MARGIN_M)
        name = flight.heads[swath.head].name
        for held, calibration in ((before, starts[name]), (after, calibrations[name])):
            points = flight.place(swath, calibration, at) - plane.centre_t
            along, across = points[:, :2] @ down, points[:, 0] * -down[1] + points[:, 1] * down[0]
            inside = (np.abs(along) < HALF_LENGTH_M) & (np.abs(across) < HALF_WIDTH_M)
            held[index] = np.column_stack([along, points[:, 2]])[inside]
    seen = {index for index, points in after.items() if len(points)}
    return Cut(plane.name, {i: before[i] for i in sorted(seen)}, {i: after[i] for i in sorted(seen)})


def _near(points_t: FloatArray, centre_t: FloatArray, half_m: float) -> Int64Array:
    """Return indexes of the points within a square, searching mapped arrays piece by piece."""
    found, step = [], 1 << 20
    for first in range(0, len(points_t), step):
        piece = np.asarray(points_t[first : first + step, :2])
        inside = (np.abs(piece - centre_t[:2]) < half_m).all(axis=1)
        found.append(np.flatnonzero(inside) + first)
    return np.concatenate(found) if found else np.zeros(0, np.int64)


def cut_picture(report: ReportInput) -> Picture | None:
    """Return a picture of each cut with the initial and the estimated calibrations; None if there is no cut."""
    cuts = cuts_of(report)
    if not cuts:
        return None
    names, colours = [swath.name for swath in report.flight.swaths], strip_colours(report.flight)
    marks = marks_of(colours)
    swaths = sorted({index for cut in cuts for index in cut.after})
    titles = [f"{cut.name}, {word}" for cut in cuts for word in ("before", "after")]

    def top_in(form: Format) -> float:
        return 0.12 + 0.19 * math.ceil(len(swaths) / (4 if form.narrow else 10))

    def draw(canvas: Canvas) -> None:
        panels = Panels(canvas, titles, PANEL_IN, top_in(canvas.form))
        for i, cut in enumerate(cuts):
            pair = panels.axes[2 * i : 2 * i + 2]
            for axes, points in zip(pair, (cut.before, cut.after), strict=True):
                _points(axes, points, colours, marks)
            every = np.concatenate([*cut.before.values(), *cut.after.values()])[:, 1]
            low, high = np.percentile(every, [0.5, 99.5])
            for axes in pair:
                axes.set_ylim(low - 0.7, high + 0.7)
                axes.set_xlim(-HALF_LENGTH_M, HALF_LENGTH_M)
        for axes in panels.axes[:: canvas.form.columns]:
            axes.set_ylabel("Height (m)", fontsize=8.5, color=MUTED)
        for axes in panels.axes[-canvas.form.columns :]:
            axes.set_xlabel("Down the roof (m)", fontsize=8.5, color=MUTED)
        look = [Line2D([], [], marker=marks[i], ls="", ms=4, color=colours[i], label=names[i]) for i in swaths]
        canvas.legend(look, 4 if canvas.form.narrow else 10)

    words = (
        f"Points of all strips within {100 * HALF_WIDTH_M:.0f} cm of a line down a roof, heights relative to its "
        "middle. The calibration alone is applied, without corrections of the trajectory."
    )
    height = Panels.height_in
    return Picture("Profiles", words, lambda form: top_in(form) + height(form, len(titles), PANEL_IN), draw)


def marks_of(colours: Sequence[str]) -> list[str]:
    """Return a mark for each strip: those of one colour differ, because all strips may meet at one roof."""
    return [MARKS[list(colours[:index]).count(colour) % len(MARKS)] for index, colour in enumerate(colours)]


def _points(axes: Axes, points: Mapping[int, FloatArray], colours: Sequence[str], marks: Sequence[str]) -> None:
    many = sum(map(len, points.values())) > MOST_MARKS
    for index, place in points.items():
        shown = place[:: max(1, len(place) // MOST_DRAWN)]
        size = float(np.clip(60.0 / math.sqrt(max(len(shown), 1)), 1.2, 3.0))
        (line,) = axes.plot(shown[:, 0], shown[:, 1], marks[index], ms=size, color=colours[index], mew=0.0, alpha=0.8)
        line.set_rasterized(many)
    axes.axvline(0.0, color=INK, lw=0.4, alpha=0.4)
