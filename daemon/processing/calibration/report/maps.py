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
from matplotlib.text import Text
from matplotlib.transforms import Affine2D
from scipy.spatial import ConvexHull, QhullError

from swath.calib.features import ControlPoint
from swath.calib.flight import Flight, Swath
from swath.calib.labels import length
from swath.calib.summary import DifferenceMap, ReportInput
from swath.daemon.processing.pages.canvas import INK, MOST_MARKS, MUTED, PAPER, Canvas, Format, Picture
from swath.daemon.processing.pages.classes import (
    DZ_LIMITS_M,
    LEVEL_LIMITS_M,
    SIGNED_COLOURS,
    SIZE_COLOURS,
    around_required,
    class_number,
)
from swath.daemon.processing.pages.map_axes import coordinates, north_arrow, place_names, scale_bar
from swath.georef.arrays import BoolArray, FloatArray
from swath.georef.mapping.chart import chart_of
from swath.georef.strip_colours import colours_of, contact

MOST_OUTLINE_POINTS = 4000
MARKERS = {"roof": "^", "ground": "o", "wall": "s", "control": "*", "user": "D"}
DIFFERENCE_LIMITS_M = (*(-limit for limit in DZ_LIMITS_M[3::-1]), *DZ_LIMITS_M[:4])
PLANE_COLOURS = (*SIZE_COLOURS[:3], SIZE_COLOURS[4])
SHARE_CELLS = 64  # along the longer side of a flight, in which it is counted how much ground strips share


def map_picture(report: ReportInput) -> Picture:
    """Return a map of strips and planes; planes are coloured by how far strips lie from them in the mean."""
    shown = _Shown(report)

    def height_in(form: Format) -> float:
        return shown.up_in(form) + (1.2 if form.narrow else 0.9)

    def draw(canvas: Canvas) -> None:
        width, up = canvas.form.width_in - 0.8, shown.up_in(canvas.form)
        axes = canvas.panel(0.68, 0.7 if canvas.form.narrow else 0.4, width, up)
        axes.spines[:].set_visible(True)
        shown.frame(axes, width / up)
        shown.draw(axes)
        canvas.legend(shown.legend(), 3 if canvas.form.narrow else 10)

    words = (
        f"Colour: the largest mean distance of a strip's returns from a plane. {shown.limit_words} "
        f"Arrows: strips in the direction of flight. Coordinates: {shown.chart.name}."
    )
    return Picture("Strips and planes", words, height_in, draw)


def difference_picture(report: ReportInput) -> Picture | None:
    """Return maps of height differences of overlapping strips before and after; None if there are none."""
    grid = report.differences
    if grid is None:
        return None
    shown = _Shown(report)
    corners = shown.corners_of(grid)
    shown.low, shown.high = corners.min(axis=0), corners.max(axis=0)
    height = _side_by_side(shown)

    def height_in(form: Format) -> float:
        rows_of_panels = 1 if form.columns == 2 else 2
        return rows_of_panels * (height(form) + 0.75) + (0.55 if form.narrow else 0.4)

    def draw(canvas: Canvas) -> None:
        form = canvas.form
        width = (form.width_in - 0.1) / form.columns - 0.7
        panels = (("Before", grid.before_m, grid.before_words), ("After", grid.after_m, grid.after_words))
        for i, (words, values_m, overall) in enumerate(panels):
            row, column = divmod(i, form.columns)
            top = (0.75 if form.narrow else 0.6) + row * (height(form) + 0.75)
            axes = canvas.panel(0.62 + column * (width + 0.7), top, width, height(form))
            shown.frame(axes, width / height(form), ticks=(3, 4))
            _differences(axes, grid, values_m, corners)
            axes.set_title(f"{words}: {overall}" if overall else words, loc="left", fontsize=8.5, color=INK, pad=4)
        canvas.legend(_difference_legend(), 3 if form.narrow else 5 if form is PAPER else 9)

    words = (
        "Height differences of overlapping strips, first − second, averaged over neighbouring cells until their noise "
        "does not show; where several pairs meet, the largest. Classes end at limits of quality levels: 4 cm (QL0), "
        "8 cm (QL1, QL2), 16 cm (QL3). RMSDz is of single cells, all pairs."
    )
    return Picture("Difference maps", words, height_in, draw)


def _side_by_side(shown: _Shown) -> Callable[[Format], float]:
    def height(form: Format) -> float:
        width = (form.width_in - 0.1) / form.columns - 0.7
        size = shown.high - shown.low
        return float(np.clip(width * size[1] / size[0], 0.3 * width, 1.3 * width))

    return height


def _differences(axes: Axes, grid: DifferenceMap, values_m: FloatArray, corners: FloatArray) -> None:
    """Draw a grid whose south-western, south-eastern, north-western and north-eastern corners lie there on the map."""
    norm = BoundaryNorm([-1e9, *DIFFERENCE_LIMITS_M, 1e9], len(SIGNED_COLOURS))
    across, up, origin = corners[1] - corners[0], corners[2] - corners[0], corners[0]
    placed = Affine2D(np.array([[across[0], up[0], origin[0]], [across[1], up[1], origin[1]], [0.0, 0.0, 1.0]]))
    limits = axes.get_xlim(), axes.get_ylim()
    image = axes.imshow(
        np.ma.masked_invalid(values_m),
        origin="lower",
        extent=(0.0, 1.0, 0.0, 1.0),
        cmap=ListedColormap(SIGNED_COLOURS),
        norm=norm,
        interpolation="nearest",
        aspect="auto",
        zorder=1,
    )
    image.set_transform(placed + axes.transData)
    axes.set(xlim=limits[0], ylim=limits[1])


def _difference_legend() -> list[Line2D]:
    limits = [f"{100 * value:g}".replace("-", "−") for value in DIFFERENCE_LIMITS_M]
    words = [f"< {limits[0]} cm", *(f"{a} … {b} cm" for a, b in pairwise(limits)), f"> {limits[-1]} cm"]
    style: dict[str, Any] = {"marker": "s", "ls": "", "ms": 7, "mec": "#888888", "mew": 0.4}
    return [
        Line2D([], [], color=colour, label=word, **style) for colour, word in zip(SIGNED_COLOURS, words, strict=True)
    ]


class _Shown:
    """The parts of a flight that the map shows, in the coordinates of the report's CRS."""

    def __init__(self, report: ReportInput) -> None:
        self.flight, self.features = report.flight, report.features
        positions_e = np.concatenate([one.position_e[:1000] for one in report.flight.trajectories])
        self.chart = report.chart or chart_of(None, positions_e)
        self.tracks = [track_of(report.flight, swath, self.map_from_t) for swath in report.flight.swaths]
        self.outlines = [outline_of(swath, self.map_from_t) for swath in report.flight.swaths]
        self.colours = strip_colours(report.flight)
        self.means_m = plane_means_m(report)
        required_m = report.need.point_m if report.need is not None else math.nan
        self.limits_m = around_required(required_m if required_m > 0.0 else LEVEL_LIMITS_M[0])
        self.limit_words = (
            f"The calibration may leave {length(required_m)} in points; classes end at about half, once and twice that."
            if required_m > 0.0
            else ""
        )
        self.control = control_of(report)
        self.centres = self.map_from_t(np.array([plane.centre_t for plane in self.features.planes]).reshape(-1, 3))
        places = [*self.tracks, *self.outlines, self.centres]
        every = np.concatenate([place for place in places if len(place)] or [np.zeros((1, 2))])
        border = 0.04 * float(np.ptp(every, axis=0).max()) + 1.0
        self.low, self.high = every.min(axis=0) - border, every.max(axis=0) + border

    def map_from_t(self, points_t: FloatArray) -> FloatArray:
        """Return easting and northing (n, 2) of points in t (n, 3)."""
        if not len(points_t):
            return np.zeros((0, 2))
        placed: FloatArray = self.chart.map_from_e(self.flight.frame.e_from_t(points_t))
        return placed

    def corners_of(self, grid: DifferenceMap) -> FloatArray:
        """Return the corners (4, 2) of a grid on the map: south-west, south-east, north-west, north-east."""
        rows, columns = grid.before_m.shape
        share = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
        corners = np.array([grid.west_m, grid.south_m]) + share * grid.cell_m * np.array([columns, rows])
        if not grid.in_t:
            return np.asarray(corners)
        heights = [np.asarray(swath.points_t[:1, 2]) for swath in self.flight.swaths]
        height_m = float(np.concatenate(heights).mean()) if sum(map(len, heights)) else 0.0
        return self.map_from_t(np.column_stack([corners, np.full(4, height_m)]))

    def up_in(self, form: Format) -> float:
        """Return the height of the map's panel in inches."""
        width = form.width_in - 0.8
        size = self.high - self.low
        most = 1.1 if form.narrow else 0.66
        return float(np.clip(width * size[1] / size[0], 0.35 * width, most * width))

    def frame(self, axes: Axes, wide_to_high: float, ticks: tuple[int, int] = (5, 5)) -> None:
        """Set limits with equal scales in a panel of these proportions; write coordinates, scale and north."""
        middle, half = (self.low + self.high) / 2.0, (self.high - self.low) / 2.0
        half = np.maximum(half, half[::-1] * [wide_to_high, 1.0 / wide_to_high])
        axes.set_xlim(middle[0] - half[0], middle[0] + half[0])
        axes.set_ylim(middle[1] - half[1], middle[1] + half[1])
        axes.set_aspect("auto")
        coordinates(axes, self.chart.unit, ticks)
        scale_bar(axes, 2.0 * float(half[0]) * self.chart.unit_m)
        north_arrow(axes)

    def draw(self, axes: Axes) -> None:
        """Draw strips, planes, tie points and control."""
        names = []
        for i, (track, outline) in enumerate(zip(self.tracks, self.outlines, strict=True)):
            colour = self.colours[i]
            if len(outline):
                axes.fill(outline[:, 0], outline[:, 1], color=colour, alpha=0.05, lw=0.0, zorder=1)
            if len(track) > 1:
                axes.plot(track[:, 0], track[:, 1], color=colour, lw=1.0, alpha=0.9, zorder=2)
                _arrow(axes, track, colour)
                if self.flight.swaths[i].name:
                    at = np.linspace(0, len(track) - 1, 12).astype(int)
                    names.append((_name(axes, self.flight.swaths[i].name, colour), track[at].tolist()))
        self._planes(axes)
        ties = self.map_from_t(np.array([tie.sightings[0].point_t for tie in self.features.ties if tie.sightings]))
        axes.plot(ties[:, 0], ties[:, 1], "D", ms=3.0, color="white", mec=INK, mew=0.7, zorder=4)
        control = self.map_from_t(np.array([point.position_t for point in self.control]))
        axes.plot(control[:, 0], control[:, 1], "*", ls="", ms=9, color=INK, mec="white", mew=0.7, zorder=6)
        place_names(axes, names)

    def _planes(self, axes: Axes) -> None:
        known = np.isfinite(self.means_m)
        size = float(np.clip(110.0 / math.sqrt(max(int(known.sum()), 1)), 2.8, 5.5))
        kinds = np.array([plane.kind for plane in self.features.planes])
        classes = np.array([class_number(mean_m, self.limits_m) for mean_m in self.means_m.tolist()])
        for kind in sorted(set(kinds[known].tolist())):
            for number, colour in enumerate(PLANE_COLOURS):
                mine = self.centres[known & (kinds == kind) & (classes == number)]
                if len(mine):
                    look: dict[str, Any] = {"ms": size, "mec": "white", "mew": 0.2, "zorder": 5 + 0.1 * number}
                    look["rasterized"] = int(known.sum()) > MOST_MARKS
                    axes.plot(mine[:, 0], mine[:, 1], MARKERS.get(kind, "o"), color=colour, **look)

    def legend(self) -> list[Line2D]:
        """Return legend entries: colours of residuals, then shapes of planes."""
        limits = [f"{100 * limit:g}" for limit in self.limits_m]
        words = [f"≤ {limits[0]} cm", *(f"{low}–{high} cm" for low, high in pairwise(limits)), f"> {limits[-1]} cm"]
        handles = [
            Line2D([], [], marker="o", ls="", ms=6, color=colour, label=word)
            for colour, word in zip(PLANE_COLOURS, words, strict=True)
        ]
        look: dict[str, Any] = {"ls": "", "ms": 5.5, "color": MUTED}
        kinds = sorted({plane.kind for plane in self.features.planes} - {"control"})  # their points have an entry below
        handles += [Line2D([], [], marker=MARKERS.get(kind, "o"), label=kind or "plane", **look) for kind in kinds]
        if self.features.ties:
            handles.append(Line2D([], [], marker="D", ls="", ms=4, color="white", mec=INK, label="tie point"))
        if self.control:
            handles.append(Line2D([], [], marker="*", ls="", ms=9, color=INK, label="control"))
        return handles


def _arrow(axes: Axes, track: FloatArray, colour: str) -> None:
    along = track[-1] - track[0]
    degrees = math.degrees(math.atan2(along[1], along[0]))
    axes.plot(*track[-1], marker=(3, 0, degrees - 90.0), ms=7, color=colour, mec="white", mew=0.5, zorder=7)


def _name(axes: Axes, name: str, colour: str) -> Text:
    box = {"boxstyle": "round,pad=0.18", "fc": "white", "ec": colour, "lw": 0.7}
    style: dict[str, Any] = {"fontsize": 7.5, "color": colour, "ha": "center", "va": "center", "zorder": 8}
    return axes.text(0.0, 0.0, name, bbox=box, **style)


def strip_colours(flight: Flight) -> list[str]:
    """Return a colour for each of a flight's strips; strips that share ground differ."""
    samples = [np.asarray(swath.points_t[:: max(1, len(swath) // 20_000), :2], np.float64) for swath in flight.swaths]
    samples = [points[np.isfinite(points).all(axis=1)] for points in samples]
    every = np.concatenate([np.zeros((0, 2)), *samples])
    if not len(every):
        return colours_of(np.zeros((len(samples), len(samples))))
    low, side = every.min(axis=0), max(float(np.ptp(every, axis=0).max()), 1e-6) / SHARE_CELLS
    occupied: BoolArray = np.zeros((len(samples), SHARE_CELLS + 1, SHARE_CELLS + 1), bool)
    for number, points in enumerate(samples):
        column, row = np.floor((points - low) / side).astype(int).T
        occupied[number, row, column] = True
    return colours_of(contact(occupied))


def track_of(flight: Flight, swath: Swath, map_from_t: Callable[[FloatArray], FloatArray]) -> FloatArray:
    """Return the body's track (k, 2) on the map while a swath was flown."""
    trajectory = flight.trajectories[swath.trajectory_index]
    if not len(swath.time_ns):
        return np.zeros((0, 2))
    first, last = np.searchsorted(trajectory.time_ns, [swath.time_ns[0], swath.time_ns[-1]])
    at = np.unique(np.linspace(first, min(last, len(trajectory.time_ns) - 1), 60).astype(np.int64))
    places = flight.frame.t_from_e(trajectory.position_e[at])
    return map_from_t(places[np.isfinite(places).all(axis=1)])


def outline_of(swath: Swath, map_from_t: Callable[[FloatArray], FloatArray]) -> FloatArray:
    """Return the convex outline (k, 2) of a swath's points on the map."""
    points = np.asarray(swath.points_t[:: max(1, len(swath) // MOST_OUTLINE_POINTS)], np.float64)
    points = points[np.isfinite(points).all(axis=1)]
    try:
        return map_from_t(points[ConvexHull(points[:, :2]).vertices]) if len(points) > 2 else np.zeros((0, 2))
    except QhullError:
        return np.zeros((0, 2))


def plane_means_m(report: ReportInput) -> FloatArray:
    """Return by plane the largest size of its strips' mean residuals (planes,); nan if all returns were rejected.

    The mean over all strips is zero, because the plane was estimated from them; the root mean square of single returns
    is the scanner's noise.
    """
    planes, swaths = len(report.features.planes), len(report.flight.swaths)
    sums, counts = np.zeros(planes * swaths), np.zeros(planes * swaths)
    for group in report.adjusted.residuals:
        if group.group == "planes":
            kept = (group.weight > 0.0) & (group.swath >= 0)
            cell = group.feature[kept] * swaths + group.swath[kept]
            sums += np.bincount(cell, group.misclosure_m[kept], planes * swaths)
            counts += np.bincount(cell, minlength=planes * swaths)
    means_m = np.where(counts > 0.0, np.abs(sums) / np.maximum(counts, 1.0), -1.0).reshape(planes, swaths)
    largest: FloatArray = means_m.max(axis=1, initial=-1.0)
    return np.where(largest >= 0.0, largest, np.nan)


def control_of(report: ReportInput) -> list[ControlPoint]:
    """Return every surveyed point once."""
    points = [point for plane in report.features.planes for point in plane.control]
    points += [tie.control for tie in report.features.ties if tie.control is not None]
    return list({point.name: point for point in points}.values())
