"""Draws where a calibration's planes, ties and control lie, and how strips differ over the ground."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from scipy.spatial import ConvexHull, QhullError

from swath.calib.features import ControlPoint
from swath.calib.flight import Flight, Swath
from swath.calib.summary import DifferenceMap, ReportInput
from swath.daemon.processing.pages.canvas import (
    INK,
    MOST_MARKS,
    MUTED,
    PAPER,
    Canvas,
    Format,
    Picture,
    class_of,
    class_words,
    colour_of,
)
from swath.georef.arrays import FloatArray

MOST_OUTLINE_POINTS = 4000
MARKERS = {"roof": "^", "ground": "o", "wall": "s", "control": "*", "user": "D"}
DIFFERENCE_LIMITS_CM = (-20.0, -10.0, -5.0, -3.0, 3.0, 5.0, 10.0, 20.0)
DIFFERENCE_COLOURS = ("#3b0f70", "#2166ac", "#67a9cf", "#c6dbef", "#dff0d8", "#fddbc7", "#ef8a62", "#b2182b", "#67001f")


def map_picture(report: ReportInput) -> Picture:
    """Return a map of strips and planes; planes are coloured by the root mean square of their residuals."""
    shown = _Shown(report)

    def height_in(form: Format) -> float:
        return shown.up_in(form) + (1.2 if form.narrow else 0.9)

    def draw(canvas: Canvas) -> None:
        width, up = canvas.form.width_in - 0.8, shown.up_in(canvas.form)
        axes = canvas.panel(0.68, 0.7 if canvas.form.narrow else 0.4, width, up)
        axes.spines[:].set_visible(True)
        shown.draw(axes)
        shown.frame(axes, width / up)
        canvas.legend(shown.legend(), 3 if canvas.form.narrow else 10)
        _words(axes)

    words = "Colour: root mean square of a plane's residuals. Arrows: strips in the direction of flight."
    return Picture("Strips and planes", words, height_in, draw)


def difference_picture(report: ReportInput) -> Picture | None:
    """Return maps of height differences of overlapping strips before and after; None if there are none."""
    grid = report.differences
    if grid is None:
        return None
    shown = _Shown(report)
    rows, columns = grid.before_m.shape
    shown.low_m = np.array([grid.west_m, grid.south_m])
    shown.high_m = shown.low_m + grid.cell_m * np.array([columns, rows])
    height = _side_by_side(shown)

    def height_in(form: Format) -> float:
        rows_of_panels = 1 if form.columns == 2 else 2
        return rows_of_panels * (height(form) + 0.75) + 0.6

    def draw(canvas: Canvas) -> None:
        form = canvas.form
        width = (form.width_in - 0.1) / form.columns - 0.7
        panels = (("Before", grid.before_m, grid.before_words), ("After", grid.after_m, grid.after_words))
        for i, (words, values_m, overall) in enumerate(panels):
            row, column = divmod(i, form.columns)
            top = 0.75 + row * (height(form) + 0.75)
            axes = canvas.panel(0.62 + column * (width + 0.7), top, width, height(form))
            _differences(axes, grid, 100.0 * values_m)
            axes.set_title(f"{words}: {overall}" if overall else words, loc="left", fontsize=8.5, color=INK, pad=4)
            shown.frame(axes, width / height(form))
            _words(axes)
        canvas.legend(_difference_legend(), 3 if form.narrow else 5 if form is PAPER else 9)

    words = (
        "Height differences of overlapping strips, first − second, the largest in each cell; RMSDz covers all pairs."
    )
    return Picture("Difference maps", words, height_in, draw)


def _side_by_side(shown: _Shown) -> Callable[[Format], float]:
    def height(form: Format) -> float:
        width = (form.width_in - 0.1) / form.columns - 0.7
        size = shown.high_m - shown.low_m
        return float(np.clip(width * size[1] / size[0], 0.3 * width, 1.3 * width))

    return height


def _differences(axes: Axes, grid: DifferenceMap, values_cm: FloatArray) -> None:
    rows, columns = values_cm.shape
    limits = DIFFERENCE_LIMITS_CM
    norm = BoundaryNorm([-1e9, *limits, 1e9], len(DIFFERENCE_COLOURS))
    east, north = grid.west_m + columns * grid.cell_m, grid.south_m + rows * grid.cell_m
    axes.imshow(
        np.ma.masked_invalid(values_cm),
        origin="lower",
        extent=(grid.west_m, east, grid.south_m, north),
        cmap=ListedColormap(DIFFERENCE_COLOURS),
        norm=norm,
        interpolation="nearest",
        zorder=1,
    )


def _difference_legend() -> list[Line2D]:
    limits = [f"{value:g}".replace("-", "−") for value in DIFFERENCE_LIMITS_CM]
    words = [f"< {limits[0]}", *(f"{a} … {b}" for a, b in pairwise(limits)), f"> {limits[-1]}"]
    style: dict[str, Any] = {"marker": "s", "ls": "", "ms": 7, "mec": "#888888", "mew": 0.4}
    rows = zip(DIFFERENCE_COLOURS, words, strict=True)
    return [
        Line2D([], [], color=colour, label=f"{word} cm" if i == 0 else word, **style)
        for i, (colour, word) in enumerate(rows)
    ]


class _Shown:
    """The parts of a flight that the map shows, in t."""

    def __init__(self, report: ReportInput) -> None:
        self.flight, self.features = report.flight, report.features
        self.tracks = [track_of(report.flight, swath) for swath in report.flight.swaths]
        self.outlines = [outline_of(swath) for swath in report.flight.swaths]
        self.rms_cm = plane_rms_cm(report)
        self.control = control_of(report)
        centres = [plane.centre_t[:2] for plane in self.features.planes]
        places = [*self.tracks, *self.outlines, np.array(centres).reshape(-1, 2)]
        every = np.concatenate([place for place in places if len(place)] or [np.zeros((1, 2))])
        border = 0.04 * float(np.ptp(every, axis=0).max()) + 1.0
        self.low_m, self.high_m = every.min(axis=0) - border, every.max(axis=0) + border

    def up_in(self, form: Format) -> float:
        """Return the height of the map's panel in inches."""
        width = form.width_in - 0.8
        size = self.high_m - self.low_m
        most = 1.1 if form.narrow else 0.66
        return float(np.clip(width * size[1] / size[0], 0.35 * width, most * width))

    def frame(self, axes: Axes, wide_to_high: float) -> None:
        """Set limits with equal scales in a panel of these proportions."""
        middle, half = (self.low_m + self.high_m) / 2.0, (self.high_m - self.low_m) / 2.0
        half = np.maximum(half, half[::-1] * [wide_to_high, 1.0 / wide_to_high])
        axes.set_xlim(middle[0] - half[0], middle[0] + half[0])
        axes.set_ylim(middle[1] - half[1], middle[1] + half[1])
        axes.set_aspect("auto")
        axes.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 2.5, 5, 10]))
        axes.yaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 2.5, 5, 10]))

    def draw(self, axes: Axes) -> None:
        """Draw strips, planes, tie points and control."""
        for i, (track, outline) in enumerate(zip(self.tracks, self.outlines, strict=True)):
            if len(outline):
                axes.fill(outline[:, 0], outline[:, 1], color=colour_of(i), alpha=0.05, lw=0.0, zorder=1)
            if len(track) > 1:
                axes.plot(track[:, 0], track[:, 1], color=colour_of(i), lw=1.0, alpha=0.9, zorder=2)
                _arrow(axes, track, colour_of(i), self.flight.swaths[i].name)
        self._planes(axes)
        ties = [tie.sightings[0].point_t for tie in self.features.ties if tie.sightings]
        if ties:
            place = np.array(ties)
            axes.plot(place[:, 0], place[:, 1], "D", ms=3.0, color="white", mec=INK, mew=0.7, zorder=4)
        for point in self.control:
            axes.plot(*point.position_t[:2], "*", ms=9, color=INK, mec="white", mew=0.7, zorder=6)

    def _planes(self, axes: Axes) -> None:
        known = [
            (plane, self.rms_cm[i]) for i, plane in enumerate(self.features.planes) if math.isfinite(self.rms_cm[i])
        ]
        size = float(np.clip(90.0 / math.sqrt(max(len(known), 1)), 2.2, 5.5))
        for kind in sorted({plane.kind for plane, _ in known}):
            for colour, _ in class_words():
                mine = np.array([p.centre_t[:2] for p, rms in known if p.kind == kind and class_of(rms) == colour])
                if len(mine):
                    look: dict[str, Any] = {"ms": size, "mec": "white", "mew": 0.3, "zorder": 5}
                    look["rasterized"] = len(known) > MOST_MARKS
                    axes.plot(mine[:, 0], mine[:, 1], MARKERS.get(kind, "o"), color=colour, **look)

    def legend(self) -> list[Line2D]:
        """Return legend entries: colours of residuals, then shapes of planes."""
        handles = [Line2D([], [], marker="o", ls="", ms=6, color=colour, label=word) for colour, word in class_words()]
        look: dict[str, Any] = {"ls": "", "ms": 5.5, "color": MUTED}
        kinds = sorted({plane.kind for plane in self.features.planes})
        handles += [Line2D([], [], marker=MARKERS.get(kind, "o"), label=kind or "plane", **look) for kind in kinds]
        if self.features.ties:
            handles.append(Line2D([], [], marker="D", ls="", ms=4, color="white", mec=INK, label="tie point"))
        if self.control:
            handles.append(Line2D([], [], marker="*", ls="", ms=9, color=INK, label="control"))
        return handles


def _arrow(axes: Axes, track: FloatArray, colour: str, name: str) -> None:
    along = track[-1] - track[0]
    degrees = math.degrees(math.atan2(along[1], along[0]))
    axes.plot(*track[-1], marker=(3, 0, degrees - 90.0), ms=7, color=colour, mec="white", mew=0.5, zorder=7)
    if name:
        box = {"boxstyle": "round,pad=0.18", "fc": "white", "ec": colour, "lw": 0.7}
        axes.text(
            float(track[0, 0]),
            float(track[0, 1]),
            name,
            fontsize=7.5,
            color=colour,
            ha="center",
            va="center",
            zorder=8,
            bbox=box,
        )


def _words(axes: Axes) -> None:
    axes.set_xlabel("East of the flight's middle (m)", fontsize=8.5, color=MUTED)
    axes.set_ylabel("North (m)", fontsize=8.5, color=MUTED)


def track_of(flight: Flight, swath: Swath) -> FloatArray:
    """Return the body's track (k, 2), east and north in t, while a swath was flown."""
    trajectory = flight.trajectories[swath.trajectory_index]
    if not len(swath.time_ns):
        return np.zeros((0, 2))
    first, last = np.searchsorted(trajectory.time_ns, [swath.time_ns[0], swath.time_ns[-1]])
    at = np.unique(np.linspace(first, min(last, len(trajectory.time_ns) - 1), 60).astype(np.int64))
    places: FloatArray = flight.frame.t_from_e(trajectory.position_e[at])[:, :2]
    return places[np.isfinite(places).all(axis=1)]


def outline_of(swath: Swath) -> FloatArray:
    """Return the convex outline (k, 2) of a swath's points in t."""
    points = np.asarray(swath.points_t[:: max(1, len(swath) // MOST_OUTLINE_POINTS), :2], np.float64)
    points = points[np.isfinite(points).all(axis=1)]
    try:
        return points[ConvexHull(points).vertices] if len(points) > 2 else np.zeros((0, 2))
    except QhullError:
        return np.zeros((0, 2))


def plane_rms_cm(report: ReportInput) -> FloatArray:
    """Return the root mean square of residuals (planes,), centimetres; nan if all observations of a plane were
    rejected.
    """
    count = len(report.features.planes)
    squares, counts = np.zeros(count), np.zeros(count)
    for group in report.adjusted.residuals:
        if group.group == "planes":
            kept = group.weight > 0.0
            squares += np.bincount(group.feature[kept], group.misclosure_m[kept] ** 2, count)
            counts += np.bincount(group.feature[kept], minlength=count)
    with np.errstate(invalid="ignore"):
        rms_cm: FloatArray = 100.0 * np.sqrt(squares / counts)
    return rms_cm


def control_of(report: ReportInput) -> list[ControlPoint]:
    """Return every surveyed point once."""
    points = [point for plane in report.features.planes for point in plane.control]
    points += [tie.control for tie in report.features.ties if tie.control is not None]
    return list({point.name: point for point in points}.values())
