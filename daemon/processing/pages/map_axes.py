"""Dresses maps: coordinates of the CRS on the axes, scale bar, north arrow, and names that do not overlap."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke
from matplotlib.text import Text
from matplotlib.ticker import FuncFormatter, MaxNLocator
from matplotlib.transforms import Bbox

from swath.daemon.processing.pages.words import INK, MUTED, round_down, thousands

HALO = [withStroke(linewidth=2.4, foreground="white")]
BAR_IN = 0.05  # height of a scale bar
LABEL_IN = 0.85  # room for a coordinate of seven digits
GAP_PX = 2.0  # minimum distance of two names


def coordinates(axes: Axes, unit: str = "m", ticks: tuple[int, int] = (5, 5)) -> None:
    """Write a CRS's coordinates on the axes of a map whose limits are set.

    Args:
        axes: the map; its data are easting and northing, or degrees.
        unit: unit of the coordinates; "°" makes them longitude and latitude.
        ticks: maximum number of intervals along easting and northing; fewer if the labels would touch.
    """
    size_in = _size_in(axes)
    ticks = ticks[0], min(ticks[1], max(1, int(size_in[1] / LABEL_IN)))
    ticks = min(ticks[0], max(1, int(size_in[0] / LABEL_IN))), ticks[1]
    words = ("Longitude", "Latitude") if unit == "°" else ("Easting", "Northing")
    for axis, word, limits, most in (
        (axes.xaxis, words[0], axes.get_xlim(), ticks[0]),
        (axes.yaxis, words[1], axes.get_ylim(), ticks[1]),
    ):
        step = (limits[1] - limits[0]) / (most + 1)
        digits = max(0, -math.floor(math.log10(step))) if 0.0 < step < 1.0 else 0
        axis.set_major_locator(MaxNLocator(most, steps=[1, 2, 5, 10]))
        axis.set_major_formatter(FuncFormatter(lambda value, _, digits=digits: thousands(value, digits)))
        axis.set_label_text(f"{word} ({unit})", fontsize=8.5, color=MUTED)
    for label in axes.get_yticklabels():
        label.set(rotation=90, va="center")


def _size_in(axes: Axes) -> tuple[float, float]:
    """Return width and height of a panel in inches."""
    figure = axes.get_figure()
    assert isinstance(figure, Figure)
    width, height = np.array(axes.get_position().size) * figure.get_size_inches()
    return float(width), float(height)


def scale_bar(axes: Axes, width_m: float, corner: tuple[float, float] | None = None) -> None:
    """Draw a scale bar, at most a fifth of the map's width.

    Args:
        axes: the map.
        width_m: width of the map on the ground.
        corner: place of the bar's lower left end in parts of the map; None: lower left corner.
    """
    length_m = round_down(0.2 * width_m)
    part, (x, y) = length_m / width_m, corner or (0.025, 0.035)
    place, (across_in, up_in) = axes.transAxes, _size_in(axes)
    thick = BAR_IN / up_in
    if corner is None:
        _paper(axes, (x - 0.08 / across_in, y - 0.07 / up_in), (part + 0.16 / across_in, 0.33 / up_in))
    bar = Rectangle((x, y), part, thick, transform=place, fc=INK, ec="white", lw=1.6, zorder=9, clip_on=False)
    bar.set_gid("scale bar")
    axes.add_patch(bar)
    words = f"{length_m / 1000:g} km" if length_m >= 1000 else f"{length_m:g} m"
    style: dict[str, Any] = {"fontsize": 8.5, "color": INK, "path_effects": HALO, "zorder": 10}
    axes.text(x + part / 2, y + 2.2 * thick, words, transform=place, ha="center", va="bottom", **style)


def north_arrow(axes: Axes) -> None:
    """Draw an arrow to grid north in the upper right corner."""
    across_in, up_in = _size_in(axes)
    _paper(axes, (0.97 - 0.14 / across_in, 0.985 - 0.55 / up_in), (0.28 / across_in, 0.55 / up_in))
    axes.annotate(
        "N",
        xy=(0.97, 0.975),
        xytext=(0.0, -27.0),
        xycoords="axes fraction",
        textcoords="offset points",
        ha="center",
        va="center",
        fontsize=9.5,
        weight="bold",
        color=INK,
        arrowprops={"arrowstyle": "-|>,head_width=0.25,head_length=0.6", "color": INK, "lw": 1.2, "shrinkA": 5},
        path_effects=HALO,
        zorder=11,
    )


def _paper(axes: Axes, corner: tuple[float, float], size: tuple[float, float]) -> None:
    """Draw pale paper below words on a map, so that lines of the map do not cross them; all in parts of the map."""
    axes.add_patch(Rectangle(corner, *size, transform=axes.transAxes, fc="white", ec="none", alpha=0.72, zorder=8.5))


def extents(texts: Iterable[Text], figure: Figure) -> list[Bbox]:
    """Return the rectangles of texts in pixels, as they will be drawn."""
    canvas: Any = figure.canvas if isinstance(figure.canvas, FigureCanvasAgg) else FigureCanvasAgg(figure)
    renderer = canvas.get_renderer()
    return [text.get_window_extent(renderer) for text in texts]


def overlaps(box: Bbox, others: Iterable[Bbox], gap_px: float = GAP_PX) -> bool:
    """Return True if a rectangle comes nearer to any other than a gap."""
    return any(
        box.x0 < other.x1 + gap_px
        and other.x0 < box.x1 + gap_px
        and box.y0 < other.y1 + gap_px
        and other.y0 < box.y1 + gap_px
        for other in others
    )


def place_names(axes: Axes, names: Sequence[tuple[Text, Sequence[tuple[float, float]]]]) -> None:
    """Move names to the first of their places where they overlap nothing; leave out those that find none.

    Args:
        axes: the map; its other texts stay where they are.
        names: texts, each with its places in data coordinates, the best first.
    """
    figure = axes.get_figure()
    assert isinstance(figure, Figure)
    movable = {id(text) for text, _ in names}
    fixed = [text for text in axes.texts if id(text) not in movable and text.get_visible() and text.get_text()]
    taken = extents(fixed, figure)
    inside = axes.get_window_extent()
    for text, places in names:
        for place in places:
            text.set_position(place)
            (box,) = extents([text], figure)
            whole = box.x0 >= inside.x0 and box.x1 <= inside.x1 and box.y0 >= inside.y0 and box.y1 <= inside.y1
            if whole and not overlaps(box, taken):
                taken.append(box)
                break
        else:
            text.set_visible(False)


def along(start: Sequence[float], end: Sequence[float], shares: Sequence[float]) -> list[tuple[float, float]]:
    """Return places on a line from its start to its end, at shares of its length."""
    first, last = np.asarray(start, np.float64), np.asarray(end, np.float64)
    return [(float(x), float(y)) for x, y in (first + share * (last - first) for share in shares)]
