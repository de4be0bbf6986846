"""Draws a plan as a picture: map, height profile, density, overlap and a table on one page."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox

from swath.georef.arrays import FloatArray
from swath.sim.flight.envelope import Ground
from swath.sim.plan.errors import PlanError
from swath.sim.plan.plan import Plan
from swath.sim.preview.chart import Chart
from swath.sim.preview.coverage import Grid, Survey, grid_of, summary_of
from swath.sim.preview.map import (
    HALO,
    INK,
    MUTED,
    draw_ground,
    draw_map,
    heading,
    nice_step,
    page_of,
    shortened,
    thousands,
)
from swath.sim.scene.terrain import build_ground

FORMATS = (".pdf", ".png", ".svg")
DPI = 150
GROUND_CELLS = 500  # cells of the ground along the map's longer side
COORDINATE_IN = 0.6  # room for a coordinate on a small map
WIDE = 1.7  # maps wider than this times their height are above the other panels, not beside them
STRETCH = 8.0  # ratio of the sides from which on the shorter one is drawn at a larger scale
OVERLAP_COLOURS = ("#f2ead3", "#a8d5ba", "#5fb0a5", "#2f7fa3", "#3d4f96", "#4b2a78")
Box = tuple[float, float, float, float]  # left, bottom, width, height in inches
TALL_PAGE, WIDE_PAGE = (17.0, 10.6), (17.0, 11.4)
TALL_MAP: Box = (0.75, 1.05, 8.6, 8.45)
WIDE_PANELS: dict[str, Box] = {
    "map": (0.75, 6.0, 15.95, 4.3),
    "profile": (0.75, 0.75, 4.6, 3.6),
    "density": (6.1, 3.0, 4.2, 1.35),
    "overlap": (6.1, 0.75, 4.2, 1.35),
    "table": (11.0, 0.3, 5.7, 4.35),
}
HEADER_IN, LARGEST_PITCH_IN, SMALLEST_PITCH_IN = 0.42, 0.24, 0.145  # heights of the table's header and rows
MOST_ROWS = 24


def draw_plan(plan: Plan, path: Path) -> list[dict[str, Any]]:
    """Draw a plan onto one page and return its `swath.sim.preview.coverage.plan_summary`.

    Args:
        plan: of the flight.
        path: of a PNG, PDF or SVG.

    Raises:
        PlanError: the plan cannot be flown, or the path has another ending.
        OSError: the picture cannot be written.
    """
    if path.suffix.lower() not in FORMATS:
        raise PlanError(str(path), f"want a picture's name that ends in one of {', '.join(FORMATS)}")
    survey = Survey(plan)
    rows = summary_of(survey)
    track = _track(survey)
    chart = Chart(survey)
    low, high = _extent(survey, track, chart)
    wide = (high - low)[0] > WIDE * (high - low)[1]
    grid = grid_of(survey)
    page, panels = (WIDE_PAGE, WIDE_PANELS) if wide else (TALL_PAGE, _tall_panels(len(rows), grid))
    figure = Figure(figsize=page, facecolor="white")
    axes = {name: _panel(figure, page, box) for name, box in panels.items()}
    _title(figure, page, survey, rows)
    frame = _framed(low, high, panels["map"])
    ground_m = _wide_ground(survey, chart, *frame[:2])
    draw_map(axes["map"], survey, track, ground_m, frame, chart)
    _profile(axes["profile"], survey, track, ground_m, chart)
    _density(axes["density"], survey, grid, chart)
    _overlap(axes["overlap"], survey, grid, chart)
    _table(axes["table"], rows, chart.colours)
    figure.savefig(path, dpi=DPI)
    return rows


def _tall_panels(rows: int, grid: Grid) -> dict[str, Box]:
    """Return the panels of a tall page: the map at the left, the other panels at the right.

    The table gets the height that it needs, the small maps the height that suits their shape.
    """
    rows = min(rows, MOST_ROWS + 1)
    table = HEADER_IN + rows * float(np.clip(3.3 / rows, SMALLEST_PITCH_IN, LARGEST_PITCH_IN))
    bottom, left, width = 0.3 + table + 0.45, 10.35, 2.95
    maps = min(6.5 - bottom, max(1.6, width * len(grid.north_m) / len(grid.east_m)))
    profile = min(2.1 + 6.5 - bottom - maps, 3.0)
    return {
        "map": TALL_MAP,
        "profile": (left, 9.3 - profile, 6.3, profile),
        "density": (left, 8.5 - profile - maps, width, maps),
        "overlap": (left + 6.3 - width, 8.5 - profile - maps, width, maps),
        "table": (left - 0.35, 8.5 - profile - maps - 0.55 - table, 6.65, table),
    }


def _panel(figure: Figure, page: tuple[float, float], box: Box) -> Axes:
    left, bottom, width, height = box
    axes = figure.add_axes((left / page[0], bottom / page[1], width / page[0], height / page[1]))
    axes.tick_params(labelsize=7.5, colors=MUTED, length=3)
    axes.spines[:].set_color("#b8b8b0")
    return axes


def _track(survey: Survey) -> FloatArray:
    """Return (n, 4) time, east, north and ellipsoidal height of the aircraft, about every half second."""
    end_s = survey.trajectory.end_s
    time_s = np.linspace(0.0, end_s, int(np.clip(2 * end_s, 200, 8000)))
    points = survey.site.site_from_e(survey.trajectory.poses(time_s).position_e)
    return np.column_stack([time_s, points[:, :2], survey.site.heights(points)])


def _extent(survey: Survey, track: FloatArray, chart: Chart) -> tuple[FloatArray, FloatArray]:
    """Return the south-western and the north-eastern corner of the map."""
    points = chart.place(np.concatenate([track[:, 1:3], *(survey.edges(strip) for strip in survey.strips)]))
    low, high = points.min(axis=0), points.max(axis=0)
    border = 0.05 * (high - low)
    return low - border, high + border


def _framed(low: FloatArray, high: FloatArray, box: Box) -> tuple[FloatArray, FloatArray, float]:
    """Return the corners, moved apart until they fill a panel, and the scale of north divided by that of east."""
    panel, middle = np.array(box[2:]), (low + high) / 2
    scale = (high - low) / panel
    if scale.max() < STRETCH * scale.min():
        scale[:] = scale.max()
    half = panel * scale / 2
    return middle - half, middle + half, float(scale[0] / scale[1])


def _wide_ground(survey: Survey, chart: Chart, low: FloatArray, high: FloatArray) -> Ground:
    """Return a function that gives heights all over the map.

    A raster is read only where the flight needs it; beyond, heights are those at its edge.
    """
    if survey.plan.tables.terrain.raster:
        return survey.scene.ground_m
    cell_m = float(np.clip((high - low).max() / GROUND_CELLS, 0.25, 100.0))
    coarse = survey.plan.changed({"terrain": {"cell_m": cell_m}})
    corners = chart.back(np.array([[east, north] for east in (low[0], high[0]) for north in (low[1], high[1])]))
    ends = np.stack([corners.min(axis=0) - cell_m, corners.max(axis=0) + cell_m])
    return build_ground(coarse, survey.site, ends).ground_m


def _title(figure: Figure, page: tuple[float, float], survey: Survey, rows: Sequence[dict[str, Any]]) -> None:
    tables, total = survey.plan.tables, rows[-1]
    scanner_words = [f"{name}: {_scanner_words(table)}" for name, table in tables.scanner.items()]
    scanners = "; ".join(scanner_words) if len(scanner_words) < 4 else f"{len(scanner_words)} scanners"
    length_m = sum(row["length_m"] for row in rows[:-1])
    words = [
        f"{len(rows) - 1} line{'s' if len(rows) > 2 else ''}, {length_m / 1000:.1f} km",
        f"{_minutes(total['seconds'])} in all, {_minutes(total['line_s'])} on lines",
        f"{_count(total['pulses'])} pulses",
        f"log about {_bytes(total['log_bytes'])}",
        scanners,
    ]
    x, top = 0.75 / page[0], 1.0 - 0.42 / page[1]
    figure.text(x, top, f"Flight plan “{tables.flight.name}”", fontsize=17, weight="bold", color=INK, va="center")
    figure.text(x, top - 0.33 / page[1], "   ·   ".join(words), fontsize=9.5, color=MUTED, va="center")


def _scanner_words(table: Any) -> str:
    if table.kind in ("vlp16", "os1"):
        return f"{table.kind.upper()} to {table.range_max_m:g} m"
    return f"{table.kind}, {table.prf_hz / 1000:g} kHz, ±{table.half_angle_deg:g}°"


def _profile(axes: Axes, survey: Survey, track: FloatArray, ground: Ground, chart: Chart) -> None:
    """Draw heights over time: the ground below, the aircraft, and the height above ground on each line."""
    unit_s, unit = (60.0, "min") if track[-1, 0] > 300.0 else (1.0, "s")
    time, height_m = track[:, 0] / unit_s, track[:, 3]
    ground_m = ground(track[:, 1], track[:, 2])
    low, high = float(ground_m.min()), float(height_m.max())
    bottom, top = low - 0.12 * (high - low), high + 0.16 * (high - low)
    axes.fill_between(time, ground_m, bottom, color="#cdbb98", lw=0)
    axes.plot(time, ground_m, color="#8a7752", lw=0.9)
    axes.plot(time, height_m, color=INK, lw=1.4)
    axes.set(xlim=(0.0, time[-1]), ylim=(bottom, top))
    _profile_lines(axes, survey, unit_s, top, chart.colours)
    axes.set_xlabel(f"time ({unit})", fontsize=8, color=MUTED)
    axes.set_ylabel("ellipsoidal height (m)", fontsize=8, color=MUTED)
    heading(axes, "Height during the flight, and above ground on the lines", 16.0, weight="bold")
    axes.grid(axis="y", color="#dddddd", lw=0.5)
    axes.set_axisbelow(True)


def _profile_lines(axes: Axes, survey: Survey, unit_s: float, top: float, colours: Sequence[str]) -> None:
    """Draw each line's time in its colour and its height above ground; its name is above if there is room."""
    crowded = len(survey.strips) > 10
    for number, strip in enumerate(survey.strips):
        start, end, colour = strip.start_s / unit_s, strip.end_s / unit_s, colours[number]
        middle = (start + end) / 2
        axes.axvspan(start, end, color=colour, alpha=0.16, lw=0, zorder=0.5)
        _, above_m = survey.stations(strip)
        look: dict[str, Any] = {"rotation": 90, "fontsize": 6.5} if crowded else {"fontsize": 7.5}
        at_m, text = strip.height_m - 0.5 * float(above_m.mean()), f"{above_m.mean():.0f} m"
        axes.text(middle, at_m, text, color=INK, ha="center", va="center", **look)
        if not crowded:
            axes.text(middle, top, shortened(strip.name, 12), fontsize=6, color=INK, ha="center", va="bottom")


def _density(axes: Axes, survey: Survey, grid: Grid, chart: Chart) -> None:
    shown = np.ma.masked_equal(grid.density, 0.0)
    top = nice_step(float(np.percentile(shown.compressed(), 95.0)), up=True)
    image = axes.imshow(shown, extent=_bounds(grid), origin="lower", cmap="YlGnBu", vmin=0.0, vmax=top, aspect="auto")
    _small_map(axes, survey, grid, chart, "Pulses per m²")
    _bar(axes, image, [])


def _overlap(axes: Axes, survey: Survey, grid: Grid, chart: Chart) -> None:
    most = min(int(grid.lines.max()), len(OVERLAP_COLOURS))
    colours = ListedColormap(OVERLAP_COLOURS[:most])
    shown = np.ma.masked_equal(np.minimum(grid.lines, most), 0)
    norm = BoundaryNorm(np.arange(0.5, most + 1), most)
    image = axes.imshow(
        shown, extent=_bounds(grid), origin="lower", cmap=colours, norm=norm, aspect="auto", interpolation="nearest"
    )
    _small_map(axes, survey, grid, chart, "Number of lines that see the ground")
    more = int(grid.lines.max()) > most
    _bar(axes, image, [f"{n}{' or more' if more and n == most else ''}" for n in range(1, most + 1)])


def _bounds(grid: Grid) -> tuple[float, float, float, float]:
    half = grid.cell_m / 2
    return (grid.east_m[0] - half, grid.east_m[-1] + half, grid.north_m[0] - half, grid.north_m[-1] + half)


def _small_map(axes: Axes, survey: Survey, grid: Grid, chart: Chart, title: str) -> None:
    """Draw the frame of a map of the swaths alone, with the objects on the ground for orientation."""
    west, east, south, north = _bounds(grid)
    panel = axes.get_position().bounds
    figure = page_of(axes)
    inches = np.array(panel[2:]) * np.array(figure.get_size_inches())
    low, high, _ = _framed(np.array([west, south]), np.array([east, north]), (0.0, 0.0, inches[0], inches[1]))
    draw_ground(axes, survey, outlines=True)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), facecolor="#f6f6f2")
    axes.set_xticks([])
    axes.set_yticks([])
    _graticule(axes, chart, low, high)
    heading(axes, title, 5.0, weight="bold")


def _graticule(axes: Axes, chart: Chart, low: FloatArray, high: FloatArray) -> None:
    """Draw lines of easting and northing, a little inclined here, and write their coordinates at the edges."""
    corners = np.array([[east, north] for east in (low[0], high[0]) for north in (low[1], high[1])])
    placed, inches = chart.place(corners), axes.get_position().size * page_of(axes).get_size_inches()
    first, last = placed.min(axis=0), placed.max(axis=0)
    style: dict[str, Any] = {"fontsize": 5.5, "color": MUTED, "path_effects": HALO, "zorder": 8}
    for axis in (0, 1):
        most = max(1.0, inches[axis] / COORDINATE_IN)
        step = nice_step(float(last[axis] - first[axis]) / most, up=True)
        for value in np.arange(np.ceil(first[axis] / step), last[axis] / step) * step:
            ends = np.array([first, last])
            ends[:, axis] = value
            (one, two) = chart.back(ends)
            axes.plot([one[0], two[0]], [one[1], two[1]], color=MUTED, lw=0.4, alpha=0.6, zorder=7.5)
            other = 1 - axis  # where the line meets the lower or the left edge
            place = one + (two - one) * (low[other] - one[other]) / (two[other] - one[other])
            share = float((place[axis] - low[axis]) / (high[axis] - low[axis]))
            if 0.1 < share < 0.93:
                turned: dict[str, Any] = {"ha": "center", "va": "bottom"}
                if axis == 1:
                    turned = {"ha": "left", "va": "center", "rotation": 90}
                x, y = (share, 0.012) if axis == 0 else (0.012, share)
                axes.text(x, y, thousands(value), transform=axes.transAxes, **turned, **style)


def _bar(axes: Axes, image: Any, labels: Sequence[str]) -> None:
    figure = page_of(axes)
    place: Bbox = axes.get_position()
    height = figure.get_size_inches()[1]
    bar = figure.add_axes((place.x0, place.y0 - 0.17 / height, place.width, 0.1 / height))
    drawn = figure.colorbar(image, cax=bar, orientation="horizontal")
    if labels:
        drawn.set_ticks(list(range(1, len(labels) + 1)), labels=list(labels))
    bar.tick_params(labelsize=7, colors=MUTED, length=2)
    drawn.outline.set_visible(False)


COLUMNS: tuple[tuple[str, float, Callable[[dict[str, Any]], str]], ...] = (  # heading, its place, text of a row
    ("line", 0.03, lambda row: shortened(row["name"], 24)),
    ("length", 0.32, lambda row: f"{thousands(row['length_m'])} m"),
    ("time", 0.43, lambda row: f"{row['seconds']:.1f} s"),
    ("above ground\nmin / mean", 0.62, lambda row: f"{row['height_min_m']:.0f} / {row['height_mean_m']:.0f} m"),
    ("swath", 0.74, lambda row: f"{row['swath_m']:.0f} m"),
    ("pulses\nper m²", 0.85, lambda row: f"{row['density_per_m2']:.1f}"),
    ("overlap of\nneighbour", 1.0, lambda row: f"{row['overlap_percent']:.0f} %" if row["overlap_percent"] else "–"),
)


def _table(axes: Axes, rows: Sequence[dict[str, Any]], colours: Sequence[str]) -> None:
    """Draw the summary's rows, each with its line's colour."""
    lines, left_out = rows[:-1][:MOST_ROWS], len(rows) - 1 - MOST_ROWS
    columns = [column for column in COLUMNS if any(column[2](row) != "–" for row in lines)]
    figure = page_of(axes)
    inches = axes.get_position().height * figure.get_size_inches()[1]
    pitch = min(LARGEST_PITCH_IN, (inches - HEADER_IN) / (len(lines) + (left_out > 0)))
    size = min(8.5, 0.66 * 72.0 * pitch)
    axes.axis("off")
    axes.set(xlim=(0.0, 1.0), ylim=(inches, 0.0))
    for text, x, _ in columns:
        ha = "left" if x < 0.1 else "right"
        axes.text(x, HEADER_IN - 0.1, text, fontsize=7.5, color=MUTED, ha=ha, va="bottom", linespacing=1.1)
    for number, row in enumerate(lines):
        y = HEADER_IN + (number + 0.5) * pitch
        if number % 2 == 0:
            axes.axhspan(y - pitch / 2, y + pitch / 2, color="#f2f2ec", lw=0)
        axes.plot([0.008], [y], marker="s", ms=0.6 * size, color=colours[number], clip_on=False)
        for _, x, say in columns:
            ha = "left" if x < 0.1 else "right"
            axes.text(x, y, say(row), fontsize=size, color=INK, ha=ha, va="center_baseline")
    if left_out > 0:
        y = HEADER_IN + (len(lines) + 0.5) * pitch
        axes.text(COLUMNS[0][1], y, f"and {left_out} more", fontsize=size, color=MUTED, va="center_baseline")


def _minutes(seconds: float) -> str:
    whole = round(seconds)
    return f"{whole} s" if whole < 120 else f"{whole // 60} min {whole % 60:02d} s"


def _count(number: float) -> str:
    return f"{number / 1e6:.1f} M" if number < 1e8 else f"{number / 1e6:.0f} M"


def _bytes(number: float) -> str:
    power = min(int(math.log10(max(number, 1.0)) // 3), 4)
    return f"{number / 1000**power:.3g} {('B', 'kB', 'MB', 'GB', 'TB')[power]}"
