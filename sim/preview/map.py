"""The map in a plan's picture: shaded ground, objects on it, swaths, lines and the way between them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import EllipseCollection, LineCollection, PolyCollection
from matplotlib.colors import LightSource, LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon
from matplotlib.patheffects import withStroke
from matplotlib.text import Annotation
from matplotlib.ticker import FuncFormatter, MaxNLocator
from matplotlib.transforms import Bbox, ScaledTranslation

from swath.georef.arrays import FloatArray
from swath.sim.flight.envelope import Ground
from swath.sim.preview.chart import Chart
from swath.sim.preview.coverage import Strip, Survey, control_points
from swath.sim.scene.village import STREET_M

INK, MUTED = "#22262b", "#5a6068"
ROOFS, WATER, TREES, ROAD, MAST, CAR = "#a65f4a", "#8fbfdc", "#7fa65e", "#8d8d89", "#3b3b3b", "#c23b22"
LAND = LinearSegmentedColormap.from_list("land", ["#c9d9b5", "#e3e7c8", "#f1e8cf", "#e4d3b3", "#d3ba97"])
HALO = (withStroke(linewidth=2.6, foreground="white", alpha=0.85),)
SHADE_CELLS = 420
KILOMETRES_FROM_M = 30_000.0
NAMES_ASIDE_PT = (0.0, 10.0, -10.0, 20.0, -20.0)  # to the right of a line, where its name is tried


def thousands(value: float) -> str:
    """Return a whole number with separated thousands and a real minus sign."""
    return f"{value:,.0f}".replace(",", "\u202f").replace("-", "−")


def shortened(name: str, most: int) -> str:
    """Return a name cut to at most this many letters."""
    return name if len(name) <= most else f"{name[: most - 1]}…"


def page_of(axes: Axes) -> Figure:
    """Return the figure that a panel is on."""
    figure = axes.get_figure()
    assert isinstance(figure, Figure)
    return figure


def nice_step(size: float, *, up: bool = False) -> float:
    """Return the largest of 1, 2, 5 × 10ⁿ not above a size; with ``up`` the smallest not below it."""
    if size <= 0.0:
        return 1.0
    power = 10.0 ** math.floor(math.log10(size))
    steps = [factor * power for factor in (1.0, 2.0, 5.0, 10.0)]
    return min(step for step in steps if step >= size) if up else max(step for step in steps if step <= size)


def draw_map(
    axes: Axes,
    survey: Survey,
    track: FloatArray,
    ground_m: Ground,
    frame: tuple[FloatArray, FloatArray, float],
    chart: Chart,
) -> None:
    """Draw the map between two corners.

    Args:
        axes: to draw in.
        survey: the flown plan.
        track: (n, 4) time, east, north and height of the aircraft.
        ground_m: function that gives heights all over the map, by east and north in the site frame.
        frame: (2,) easting and northing of either corner, then the factor by which north is drawn larger than east.
        chart: coordinates of the map, and the lines' colours.
    """
    low, high, stretch = frame
    _relief(axes, ground_m, low, high, chart)
    draw_ground(axes, survey, chart)
    for strip, colour in zip(survey.strips, chart.colours, strict=True):
        _swath(axes, chart.place(survey.edges(strip)), colour, 0.16 if len(survey.strips) < 5 else 0.09)
    way = chart.place(track[:, 1:3])
    axes.plot(way[:, 0], way[:, 1], color=INK, lw=0.8, ls=(0, (5, 2)), alpha=0.75, zorder=5)
    axes.plot(*way[0], marker="o", ms=5, color="white", mec=INK, mew=1.2, zorder=8)
    axes.plot(*way[-1], marker="s", ms=5, color=INK, mec="white", mew=0.8, zorder=8)
    for strip, colour in zip(survey.strips, chart.colours, strict=True):
        _line(axes, strip, colour, chart)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    _names(axes, survey, chart)
    control = chart.place(np.asarray(control_points(survey.plan, survey.scene))[:, :2])
    axes.plot(control[:, 0], control[:, 1], ls="", marker="^", ms=5.5, color="#ffd23f", mec=INK, mew=0.7, zorder=7)
    for axis, word, size_m in ((axes.xaxis, "Easting", high[0] - low[0]), (axes.yaxis, "Northing", high[1] - low[1])):
        unit, metres = ("km", 1000.0) if size_m > KILOMETRES_FROM_M else ("m", 1.0)
        axis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10]))
        axis.set_major_formatter(FuncFormatter(lambda value, _, metres=metres: thousands(value / metres)))
        axis.set_label_text(f"{word} ({unit})", fontsize=8, color=MUTED)
    axes.tick_params(axis="y", labelrotation=90)
    for label in axes.get_yticklabels():
        label.set(va="center")
    axes.grid(color="white", lw=0.6, alpha=0.55, zorder=1)
    _scale_bar(axes, low, high)
    _north_arrow(axes)
    _legend(axes, survey, chart.colours[0])
    _origin(axes, survey, stretch, chart)


def _relief(axes: Axes, ground_m: Ground, low: FloatArray, high: FloatArray, chart: Chart) -> None:
    """Draw heights as soft colours with shadows, and contour lines."""
    size = high - low
    shape = np.maximum((SHADE_CELLS * size / size.max()).astype(int), 40)
    east_m, north_m = (np.linspace(low[axis], high[axis], shape[axis]) for axis in (0, 1))
    east, north = np.meshgrid(east_m, north_m)
    places = chart.back(np.column_stack([east.ravel(), north.ravel()]))
    height_m = ground_m(np.ascontiguousarray(places[:, 0]), np.ascontiguousarray(places[:, 1])).reshape(east.shape)
    extent = (low[0], high[0], low[1], high[1])
    relief_m = float(np.ptp(height_m))
    if relief_m < 1.0:
        axes.set_facecolor("#e6e8cf")
        return
    step_m = size / shape
    slope = np.hypot(*np.gradient(height_m, step_m[1], step_m[0]))
    exaggeration = float(np.clip(0.3 / slope.mean(), 0.5, 15.0))
    light = LightSource(315.0, 45.0).hillshade(height_m, exaggeration, dx=float(step_m[0]), dy=-float(step_m[1]))
    tint = LAND((height_m - height_m.min()) / relief_m)[:, :, :3]
    image = np.clip(tint * (0.78 + 0.32 * light[:, :, np.newaxis]), 0.0, 1.0)
    axes.imshow(image, extent=extent, origin="lower", aspect="auto", interpolation="bilinear", zorder=0)
    step = nice_step(relief_m / 8.0, up=True)
    levels = step * np.arange(math.ceil(height_m.min() / step), math.floor(height_m.max() / step) + 1)
    if len(levels):
        lines = axes.contour(east_m, north_m, height_m, levels=levels, colors="#8a7752", linewidths=0.45, alpha=0.7)
        axes.clabel(lines, fmt="%g m", fontsize=6, inline_spacing=2)


def draw_ground(axes: Axes, survey: Survey, chart: Chart | None = None, *, outlines: bool = False) -> None:
    """Draw the objects on the ground.

    Args:
        axes: to draw in.
        survey: the flown plan.
        chart: coordinates of the map; None: those of the site frame.
        outlines: draw only outlines, which hide no colours beneath.
    """
    scene, place = survey.scene, np.asarray if chart is None else chart.place
    for forest in [] if outlines else survey.plan.tables.terrain.forest:
        corners = np.array(forest.center_m) + np.array(forest.size_m) / 2 * [[-1, -1], [1, -1], [1, 1], [-1, 1]]
        axes.add_patch(Polygon(place(corners), facecolor=TREES, alpha=0.3, lw=0, zorder=1.9))
    for circles, edge, face in ((scene.waters, "#4d88ad", WATER), (scene.trees, "#4f7a35", TREES)):
        width = 2.0 * circles[:, 2]
        look = {"edgecolors": edge, "linewidths": 0.4, "facecolors": "none"} if outlines else {"facecolors": face}
        if not outlines or circles is scene.waters:
            axes.add_collection(_circles(axes, place(circles[:, :2]), width, zorder=2.0, **look), autolim=False)
    for road in sorted(scene.roads, key=lambda road: road.width_m):
        points = place(np.array(road.points_m, np.float64)).T
        wide = 0.4 if outlines else 1.1 if road.width_m <= STREET_M else 2.2
        axes.plot(*points, color=ROAD, lw=wide, solid_joinstyle="round", zorder=2.2)
        if wide > 2.0:
            axes.plot(*points, color="#f4f2ec", lw=1.0, solid_joinstyle="round", zorder=2.3)
    edge, face = ("#555555", "none") if outlines else ("#6b3a2c", ROOFS)
    axes.add_collection(
        PolyCollection(
            [place(corners) for corners in scene.buildings],
            edgecolors=edge,
            facecolors=face,
            linewidths=0.25,
            zorder=2.5,
        ),
        autolim=False,
    )
    wires = place(scene.wires.reshape(-1, 2, 2))
    axes.add_collection(LineCollection(list(wires), colors=MAST, linewidths=0.5 if outlines else 0.9, zorder=2.6))
    if outlines:
        return
    axes.plot(*wires.reshape(-1, 2).T, ls="", marker="P", ms=3.4, color=MAST, mew=0.0, zorder=2.7)
    for way in place(scene.cars.reshape(-1, 2, 2)):
        axes.plot(*way.T, color=CAR, lw=0.9, ls=(0, (1, 1.2)), zorder=2.8)


def _circles(axes: Axes, centres: FloatArray, width: FloatArray, **look: Any) -> EllipseCollection:
    return EllipseCollection(
        width,
        width,
        np.zeros(len(width)),
        units="xy",
        offsets=centres,
        offset_transform=axes.transData,
        **look,
    )


def _swath(axes: Axes, outline: FloatArray, colour: str, alpha: float) -> None:
    axes.add_patch(Polygon(outline, facecolor=colour, alpha=alpha, lw=0, zorder=1.5))
    axes.add_patch(Polygon(outline, facecolor="none", edgecolor=colour, lw=0.7, alpha=0.7, zorder=3.5))


def _line(axes: Axes, strip: Strip, colour: str, chart: Chart) -> None:
    """Draw a line with an arrow, a little to its right."""
    start, end = chart.place(np.stack([strip.from_m, strip.end_m]))
    ahead = (end - start) / max(float(np.linalg.norm(end - start)), 1e-9)
    aside = np.array([ahead[1], -ahead[0]]) * 1.4 / 72.0
    moved = axes.transData + ScaledTranslation(aside[0], aside[1], page_of(axes).dpi_scale_trans)
    axes.plot([start[0], end[0]], [start[1], end[1]], color=colour, lw=2.0, transform=moved, zorder=6)
    turned = math.degrees(math.atan2(ahead[1], ahead[0]))
    for part in (0.3, 0.75):
        tip = start + part * (end - start)
        arrow = (3, 0, turned - 90.0)
        axes.plot(*tip, marker=arrow, ms=9, color=colour, mec="white", mew=0.7, transform=moved, zorder=6.2)


def _names(axes: Axes, survey: Survey, chart: Chart) -> None:
    """Write the lines' names at their beginnings or ends, where they cover no other name if there is such a place."""
    figure = page_of(axes)
    canvas: Any = figure.canvas if isinstance(figure.canvas, FigureCanvasAgg) else FigureCanvasAgg(figure)
    renderer, taken = canvas.get_renderer(), list[Bbox]()
    for strip, colour in zip(survey.strips, chart.colours, strict=True):
        start, end = chart.place(np.stack([strip.from_m, strip.end_m]))
        ahead = (end - start) / max(float(np.linalg.norm(end - start)), 1e-9)
        right, turned = np.array([ahead[1], -ahead[0]]), math.degrees(math.atan2(ahead[1], ahead[0]))
        upright = (turned + 90.0) % 180.0 - 90.0
        forward = abs(turned - upright) < 1.0
        style: dict[str, Any] = {"rotation": upright, "rotation_mode": "anchor", "va": "center", "zorder": 9}
        style |= {"fontsize": 8, "weight": "bold", "color": colour, "path_effects": HALO}
        tried: list[tuple[float, Annotation, Bbox]] = []
        for aside in NAMES_ASIDE_PT:
            for place, way in ((start, -1.0), (end, 1.0)):
                offset = 6.0 * way * ahead + aside * right
                flush = "right" if forward == (way < 0.0) else "left"
                words = axes.annotate(
                    shortened(strip.name, 20), (place[0], place[1]), (offset[0], offset[1]),
                    textcoords="offset points", ha=flush, **style,
                )  # fmt: skip
                box = words.get_window_extent(renderer)
                tried.append((sum(_shared(box, other) for other in taken), words, box))
        _, best, box = min(tried, key=lambda one: one[0])
        taken.append(box)
        for _, words, _ in tried:
            if words is not best:
                words.remove()


def _shared(one: Bbox, other: Bbox) -> float:
    """Return the area that two rectangles share, square pixels."""
    both = Bbox.intersection(one, other)
    return 0.0 if both is None else float(both.width * both.height)


def _scale_bar(axes: Axes, low: FloatArray, high: FloatArray) -> None:
    """Draw a scale bar in metres or kilometres, at most 0.15 of the map's width."""
    length_m = nice_step(0.15 * float(high[0] - low[0]))
    part = length_m / float(high[0] - low[0])
    place = axes.transAxes
    x, y = 0.03, 0.035
    for number in range(4):
        piece = [x + number * part / 4, x + (number + 1) * part / 4], [y, y]
        for colour, width in ((INK, 5.5), (INK if number % 2 == 0 else "white", 3.5)):
            axes.plot(*piece, transform=place, color=colour, lw=width, solid_capstyle="butt", zorder=10)
    text = f"  {length_m / 1000:g} km" if length_m >= 1000.0 else f"  {length_m:g} m"
    axes.text(x + part, y, text, transform=place, fontsize=8, color=INK, va="center", path_effects=HALO, zorder=11)


def _north_arrow(axes: Axes) -> None:
    axes.annotate(
        "N",
        xy=(0.965, 0.965),
        xytext=(0.0, -34.0),
        xycoords="axes fraction",
        textcoords="offset points",
        ha="center",
        va="center",
        fontsize=11,
        weight="bold",
        color=INK,
        arrowprops={"arrowstyle": "-|>,head_width=0.35,head_length=0.8", "color": INK, "lw": 1.6},
        path_effects=HALO,
        zorder=11,
    )


def _legend(axes: Axes, survey: Survey, colour: str) -> None:
    """Draw the legend below the map, with entries only for what the map contains."""
    scene, control = survey.scene, survey.plan.tables.control
    entries: list[tuple[Any, str, Any]] = [
        (True, "flight line", Line2D([], [], color=colour, lw=2)),
        (True, "swath", Patch(facecolor=colour, alpha=0.3)),
        (True, "way between", Line2D([], [], color=INK, lw=0.8, ls=(0, (5, 2)))),
        (True, "begin", Line2D([], [], ls="", marker="o", ms=5, color="white", mec=INK, mew=1.2)),
        (True, "end", Line2D([], [], ls="", marker="s", ms=5, color=INK)),
        (control.points, "control point", Line2D([], [], ls="", marker="^", ms=5.5, color="#ffd23f", mec=INK, mew=0.7)),
        (len(scene.buildings), "building", Patch(facecolor=ROOFS)),
        (scene.roads, "road", Line2D([], [], color=ROAD, lw=2.2)),
        (len(scene.waters), "water", Patch(facecolor=WATER)),
        (len(scene.trees), "trees", Patch(facecolor=TREES, alpha=0.65)),
        (len(scene.wires), "wire", Line2D([], [], color=MAST, lw=0.9, marker="P", ms=3.2)),
        (len(scene.cars), "cars", Line2D([], [], color=CAR, lw=0.9, ls=(0, (1, 1.2)))),
    ]
    shown = [(handle, text) for there, text, handle in entries if there]
    axes.legend(
        [handle for handle, _ in shown],
        [text for _, text in shown],
        loc="upper left",
        bbox_to_anchor=(0.0, 0.0),
        bbox_transform=axes.transAxes + ScaledTranslation(0.0, -0.48, page_of(axes).dpi_scale_trans),
        ncols=len(shown),
        fontsize=7.5,
        frameon=False,
        borderaxespad=0.0,
        handlelength=1.6,
        handletextpad=0.5,
        columnspacing=1.1,
        labelcolor=MUTED,
    )


def _origin(axes: Axes, survey: Survey, stretch: float, chart: Chart) -> None:
    """Write the CRS and the site's place on earth above the map."""
    lat_deg, lon_deg = survey.plan.tables.flight.origin_deg
    text = (
        f"origin {abs(lat_deg):.5f}° {'N' if lat_deg >= 0 else 'S'}, {abs(lon_deg):.5f}° {'E' if lon_deg >= 0 else 'W'}"
    )
    text += f"   coordinates: {chart.name}"
    if stretch != 1.0:
        larger = f"north drawn {stretch:.2g} × larger than east" if stretch > 1.0 else ""
        text += f"   {larger or f'east drawn {1.0 / stretch:.2g} × larger than north'}"
    heading(axes, text, 3.0, x=1.0, fontsize=7.5, color=MUTED, ha="right")


def heading(axes: Axes, text: str, above: float, *, x: float = 0.0, **style: Any) -> None:
    """Write a line of text this many points above a panel."""
    look: dict[str, Any] = {"fontsize": 9.5, "color": INK, "va": "bottom"} | style
    axes.annotate(text, (x, 1.0), xytext=(0.0, above), xycoords="axes fraction", textcoords="offset points", **look)
