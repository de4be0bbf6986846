"""Draws the maps of a quick look: height, intensity, density, sigma of height, differences of strips."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm, LightSource, ListedColormap, Normalize, PowerNorm
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, MaxNLocator
from numpy.typing import NDArray
from scipy import ndimage

from swath.calib.labels import number
from swath.daemon.processing.pages.classes import (
    DZ_LIMITS_M,
    SHARE_INSIDE,
    SIZE_COLOURS,
    class_number,
    limits_for,
    size_words,
)
from swath.daemon.processing.pages.map_axes import HALO, along, coordinates, north_arrow, place_names, scale_bar
from swath.daemon.processing.pages.words import DPI, EMPTY, INK, MUTED, shortened, thousands
from swath.daemon.processing.quicklook.grids import COUNT, HEIGHT, INTENSITY, SIGMA_HEIGHT, Frame, filled, round_up
from swath.daemon.processing.quicklook.profile import axis_of
from swath.daemon.processing.quicklook.run import Look
from swath.daemon.processing.quicklook.strips import HISTOGRAM_HALF, HISTOGRAM_STEP_M
from swath.georef.arrays import FloatArray

LARGEST_MAP_IN, SMALLEST_MAP_IN = (7.4, 5.8), (3.0, 1.3)  # so small that words can be read on paper too
NARROW_SIDE_IN, WIDE_SIDE_IN = 1.55, 2.6
LEFT_IN, TOP_IN, BOTTOM_IN, LOWEST_PAGE_IN, LOWEST_HISTOGRAM_IN = 1.0, 0.8, 0.62, 4.9, 6.1
MOST_OUTLINES = 60
BARS_MM = (1, 2, 4, 5, 10, 20, 40, 80)  # widths of a histogram's bars, which divide the classes' limits
NAME_SHARES = (0.06, 0.94, 0.15, 0.85, 0.25, 0.75, 0.35, 0.65, 0.5)  # places for a strip's name along it: ends first


class MapPage:
    """A map with its title, axes in the files' coordinates, a scale bar, and a column for legends at the right.

    Attributes:
        figure: the page.
        axes: axes of the map, in the files' own coordinates.
    """

    def __init__(self, look: Look, title: str, under: str, side_in: float = NARROW_SIDE_IN) -> None:
        self.look, self.named = look, False
        low, high = look.surface.low_m[:2], look.surface.high_m[:2]
        border = np.maximum(0.03 * (high - low).max(), look.surface.frame.cell_m)
        self.low_m, self.high_m = low - border, high + border
        size_m = self.high_m - self.low_m
        map_in = np.maximum(size_m * float((np.array(LARGEST_MAP_IN) / size_m).min()), SMALLEST_MAP_IN)
        lowest_in = LOWEST_PAGE_IN if side_in == NARROW_SIDE_IN else LOWEST_HISTOGRAM_IN
        self.page_in = np.array([LEFT_IN + map_in[0] + side_in, max(TOP_IN + map_in[1] + BOTTOM_IN, lowest_in)])
        self.page_in[0] = max(self.page_in[0], 7.6)
        self.figure = Figure(figsize=(float(self.page_in[0]), float(self.page_in[1])), facecolor="white")
        bottom = self.page_in[1] - TOP_IN - map_in[1]
        self.axes = self._panel(LEFT_IN, bottom, self.page_in[0] - LEFT_IN - side_in, map_in[1])
        self.side_in = self.page_in[0] - side_in + 0.3
        self._dress()
        place = (LEFT_IN - 0.75) / self.page_in[0], 1.0 - 0.3 / self.page_in[1]
        self.figure.text(*place, title, fontsize=15, weight="bold", color=INK, va="center")
        self.figure.text(
            place[0], 1.0 - 0.57 / self.page_in[1], under, fontsize=9, color=MUTED, va="center", wrap=False
        )

    def _panel(self, left: float, bottom: float, width: float, height: float) -> Axes:
        across, up = self.page_in
        axes = self.figure.add_axes((left / across, bottom / up, width / across, height / up))
        axes.tick_params(labelsize=8, colors=MUTED, length=3)
        axes.spines[:].set_color("#b9bdb8")
        return axes

    def side(self, top: float, width: float, height: float) -> Axes:
        """Return a panel in the right column, ``top`` inches below the map's upper edge."""
        return self._panel(self.side_in, self.page_in[1] - TOP_IN - top - height, width, height)

    def say(self, top: float, text: str, **style: Any) -> None:
        """Write words in the right column."""
        look: dict[str, Any] = {"fontsize": 8.5, "color": INK, "va": "top", "linespacing": 1.5} | style
        x, y = self.side_in / self.page_in[0], (self.page_in[1] - TOP_IN - top) / self.page_in[1]
        self.figure.text(x, y, text, **look)

    def box(self, frame: Frame) -> tuple[float, float, float, float]:
        """Return a frame's west, east, south and north in the files' coordinates."""
        west_m, east_m, south_m, north_m = frame.extent_m
        units = self.look.units
        return west_m / units.east_m, east_m / units.east_m, south_m / units.north_m, north_m / units.north_m

    def image(self, values: NDArray[Any], frame: Frame, **style: Any) -> Any:
        """Draw cells (rows, columns[, colour]) on the map and return Matplotlib's image."""
        return self.axes.imshow(
            values, origin="lower", extent=self.box(frame), aspect=self.axes.get_aspect(), **({"zorder": 1} | style)
        )

    def _dress(self) -> None:
        units, axes = self.look.units, self.axes
        axes.set_facecolor(EMPTY)
        axes.set_aspect(units.north_m / units.east_m, adjustable="box", anchor="NW")
        axes.set_xlim(self.low_m[0] / units.east_m, self.high_m[0] / units.east_m)
        axes.set_ylim(self.low_m[1] / units.north_m, self.high_m[1] / units.north_m)
        coordinates(axes, units.name)

    def finish(self, path: Path) -> None:
        """Draw grid lines and scale bar, and save the file."""
        self.axes.grid(color="#7c858c", lw=0.4, alpha=0.35, zorder=2)
        scale_bar(self.axes, float((self.high_m - self.low_m)[0]))
        north_arrow(self.axes)
        self._names()
        self.figure.savefig(path, dpi=DPI)

    def outlines(self, *, light: bool = False) -> None:
        """Draw the outlines of the strips with their names."""
        look, units = self.look, self.look.units
        for index in range(min(len(look.strips), MOST_OUTLINES)):
            coverage = look.cells.coverage(index)
            there = ndimage.binary_closing(np.pad(coverage.there, 3), iterations=2, structure=np.ones((3, 3)))
            there = ndimage.binary_fill_holes(there)
            if not there.any():
                continue
            frame = coverage.frame
            east_m = frame.west_m + (np.arange(there.shape[1]) - 2.5) * frame.cell_m
            north_m = frame.south_m + (np.arange(there.shape[0]) - 2.5) * frame.cell_m
            colour = "white" if light else look.colours[index]
            shape = ndimage.gaussian_filter(there.astype(float), 0.7)
            self.axes.contour(
                east_m / units.east_m, north_m / units.north_m, shape, [0.4], colors=[colour], linewidths=0.9, zorder=3
            )
        self.named = 1 < len(look.strips) <= MOST_OUTLINES

    def _names(self) -> None:
        """Write the strips' names where they overlap nothing; a strip that has no such place stays unnamed."""
        look, names = self.look, []
        for index, strip in enumerate(look.strips if self.named else []):
            places_m = look.cells.coverage(index).centres()
            if not len(places_m):
                continue
            middle, axis = axis_of(places_m)
            distance_m = (places_m - middle) @ axis
            ends = np.stack([middle + axis * distance_m.min(), middle + axis * distance_m.max()])
            start, end = (ends / [look.units.east_m, look.units.north_m]).tolist()
            places = along(start, end, NAME_SHARES)
            text = self.axes.text(
                *places[0],
                shortened(strip.name, 24),
                color=look.colours[index],
                fontsize=8.5,
                weight="bold",
                ha="center",
                va="center",
                path_effects=HALO,
                zorder=8,
                clip_on=True,
            )
            names.append((text, places))
        place_names(self.axes, names)

    def bar(self, image: Any, label: str, **style: Any) -> None:
        """Draw a colour bar in the right column."""
        height = float(np.clip(self.page_in[1] - TOP_IN - BOTTOM_IN - 0.4, 1.5, 4.2))
        axes = self.side(0.35, 0.2, height)
        made = self.figure.colorbar(image, cax=axes, **style)
        made.ax.tick_params(labelsize=8, colors=MUTED, length=3)
        made.outline.set_edgecolor("#b9bdb8")
        self.say(0.0, label, fontsize=8.5)


def _range_of(values: FloatArray, low: float = 2.0, high: float = 98.0) -> tuple[float, float]:
    """Return percentiles that a colour scale spans; never an empty range."""
    known = values[np.isfinite(values)]
    if not len(known):
        return 0.0, 1.0
    first, last = (float(value) for value in np.percentile(known, (low, high)))
    least = max(1e-3 * abs(last), 1e-6)
    return (first, last) if last - first > least else (first - least, last + least)


def shade_of(heights: FloatArray, cell_m: float) -> FloatArray:
    """Return brightness (rows, columns), 0 … 1, of ground lit from the north-west; gaps take the nearest height."""
    missing = ~np.isfinite(heights)
    if missing.any():
        nearest = ndimage.distance_transform_edt(missing, return_distances=False, return_indices=True)
        heights = heights[tuple(nearest)]
    if min(heights.shape) < 2:
        return np.full(heights.shape, 0.7)
    slope = np.hypot(*np.gradient(heights, cell_m))[~missing]
    typical = float(np.percentile(slope, 75)) if len(slope) else 1.0
    exaggeration = float(np.clip(0.35 / max(typical, 1e-6), 0.3, 8.0))
    lit = LightSource(315.0, 45.0).hillshade(heights, exaggeration, dx=cell_m, dy=-cell_m)
    return np.asarray(lit, np.float64)


def _cells_words(look: Look) -> str:
    return f"cells {look.surface.frame.cell_m:g} m"


def draw_height(look: Look, path: Path) -> None:
    """Draw the mean height of all returns, shaded, and the profile's line."""
    frame = look.surface.frame
    heights = filled(look.surface.mean(HEIGHT))
    low, high = _range_of(heights, 1.0, 99.0)
    norm, colours = Normalize(low, high), colormaps["gist_earth"].resampled(256)
    land = ListedColormap(colours(np.linspace(0.36, 0.95, 256)))
    light = shade_of(heights, frame.cell_m)
    image = land(norm(np.nan_to_num(heights, nan=low)))
    image[:, :, :3] = np.clip(image[:, :, :3] * (0.45 + 0.75 * light[:, :, np.newaxis]), 0.0, 1.0)
    image[:, :, 3] = np.isfinite(heights)
    spread = f"{thousands(look.surface.low_m[2], 2)} to {thousands(look.surface.high_m[2], 2)} m"
    page = MapPage(look, "Height", f"mean of all returns, shaded from the north-west, {_cells_words(look)}; {spread}")
    page.image(image, frame, interpolation="antialiased")
    page.bar(ScalarMappable(norm, land), "Height (m)", extend="both", ticks=MaxNLocator(8, steps=[1, 2, 5, 10]))
    page.outlines()
    _mark_profile(page)
    page.finish(path)


def _mark_profile(page: MapPage) -> None:
    if page.look.profile is None:
        return
    line, units = page.look.profile.line, page.look.units
    ends = np.stack([line.start_m, line.end_m]) / [units.east_m, units.north_m]
    page.axes.plot(*ends.T, color="white", lw=3.2, zorder=6, solid_capstyle="butt")
    page.axes.plot(*ends.T, color="#c1121f", lw=1.6, zorder=7, solid_capstyle="butt")
    for letter, place in zip("AB", ends, strict=True):
        style: dict[str, Any] = {"fontsize": 9.5, "weight": "bold", "color": "#c1121f", "path_effects": HALO}
        page.axes.text(place[0], place[1], letter, ha="center", va="center", zorder=9, **style)


def draw_intensity(look: Look, path: Path) -> None:
    """Draw the mean intensity of first returns."""
    values = filled(look.surface.mean(INTENSITY))
    norm = PowerNorm(0.6, *_range_of(values, 1.0, 99.5))  # keeps the rest visible beside a few bright roofs and signs
    page = MapPage(look, "Intensity", f"mean of first returns, as recorded, {_cells_words(look)}")
    image = page.image(values, look.surface.frame, cmap="gray", norm=norm, interpolation="antialiased")
    page.bar(image, "Intensity (no unit)", extend="both")
    page.finish(path)


def draw_density(look: Look, path: Path) -> None:
    """Draw the pulses per square metre."""
    values, cell_m = look.surface.density()
    frame = look.surface.frame
    cells = Frame(frame.west_m, frame.south_m, cell_m, *values.shape)
    top = _range_of(values)[1]
    known = values[np.isfinite(values)]
    few = f", 5 % of cells below {np.percentile(known, 5):.3g}" if len(known) else ""
    step = round_up(max(top, 1e-9) / 8)
    levels = step * np.arange(math.ceil(top / step) + 1)
    colours = colormaps["YlGnBu"].resampled(len(levels))(np.linspace(0.06, 1.0, len(levels)))
    norm = BoundaryNorm(levels, len(levels), extend="max")
    under = f"first returns per m², all strips together, cells {cell_m:g} m; mean {look.density:.3g}{few}"
    page = MapPage(look, "Density", under)
    image = page.image(values, cells, cmap=ListedColormap(colours), norm=norm, interpolation="nearest")
    page.bar(image, "Pulses per m²", extend="max", ticks=levels, format=FuncFormatter(lambda value, _: f"{value:.4g}"))
    page.outlines()
    page.finish(path)


def draw_sigma(look: Look, path: Path) -> None:
    """Draw the sigma of height from the files' points."""
    values = 100.0 * filled(look.surface.mean(SIGMA_HEIGHT))
    low, high = _range_of(values)
    low = max(min(low, 0.8 * high), 0.0)  # so that colours do not show differences that do not matter
    under = f"one standard deviation, as stored in the files, mean of all returns, {_cells_words(look)}"
    page = MapPage(look, "Sigma of height", under)
    image = page.image(values, look.surface.frame, cmap="viridis", vmin=low, vmax=high, interpolation="antialiased")
    page.bar(image, "σ of height (cm)", extend="both")
    page.outlines(light=True)
    page.finish(path)


def draw_differences(look: Look, path: Path, title: str = "Height difference of overlapping strips") -> None:
    """Draw differences of overlapping strips in smooth cells, by size, over the shaded ground.

    Each is the mean of so many cells around it that the map shows the pattern and not the noise.
    """
    frame, overlap = look.cells.frame, look.overlap
    numbers = overlap.numbers()
    assert numbers is not None
    page = MapPage(look, title, _difference_words(look), WIDE_SIDE_IN)
    _pale_ground(page)
    size = np.abs(overlap.shown_m).astype(float)
    limits = limits_for(float(np.nanquantile(size, SHARE_INSIDE)))
    colours = SIZE_COLOURS[: len(limits) + 1]
    norm = BoundaryNorm([0.0, *limits, 1e6], len(colours))
    cells = Frame(frame.west_m, frame.south_m, frame.cell_m, *size.shape)
    image = page.image(size, cells, cmap=ListedColormap(list(colours)), norm=norm, interpolation="nearest")
    image.set_zorder(2.5)
    page.outlines()
    words = size_words(limits)
    handles = [Patch(fc=colour, ec="none", label=word) for colour, word in zip(colours, words, strict=True)]
    legend = page.side(0.0, 2.3, 0.25 + 0.21 * len(handles))
    legend.set_axis_off()
    made = legend.legend(
        handles=handles, loc="upper left", frameon=False, fontsize=8.5, borderaxespad=0, title="|dZ|", labelcolor=INK
    )
    made.get_title().set(fontsize=8.5, color=INK)
    made.set_alignment("left")
    below = 0.5 + 0.21 * len(handles)
    figures = (
        f"single cells, all pairs\nRMSDz {100 * numbers['rms_m']:.1f} cm\n95 % ≤ {100 * numbers['p95_m']:.1f} cm\n"
        f"largest {100 * numbers['max_m']:.1f} cm"
    )
    page.say(below, figures)
    page.say(below + 0.95, _worst_pairs(look), color=MUTED, fontsize=8)
    _dz_histogram(page, below + 2.0)
    page.finish(path)


def _difference_words(look: Look) -> str:
    """Return what the map of differences shows."""
    sigma_m = look.overlap.shown_sigma_m[np.isfinite(look.overlap.shown_sigma_m)]
    parts = [
        f"smooth cells of {look.cells.frame.cell_m:g} m, averaged with their neighbours to "
        f"± {1000 * float(np.quantile(sigma_m, 0.95)):.1f} mm (one sigma)",
        "where more than two strips meet, the largest" if len(look.strips) > 2 else "",
    ]
    return "; ".join(part for part in parts if part)


def _worst_pairs(look: Look) -> str:
    """Return lines on the pairs whose medians are farthest from zero."""
    rows = sorted(look.overlap.rows, key=lambda row: -abs(row["median_m"]))[:4]
    names = [f"{shortened(look.names[row['first']], 10)} − {shortened(look.names[row['second']], 10)}" for row in rows]
    lines = [f"{name}:  {number(100 * row['median_m'], '+.1f')} cm" for name, row in zip(names, rows, strict=True)]
    return "\n".join(["medians" if len(rows) == len(look.overlap.rows) else "largest medians", *lines])


def _pale_ground(page: MapPage) -> None:
    surface = page.look.surface
    heights = filled(surface.mean(HEIGHT))
    light = 0.62 + 0.36 * shade_of(heights, surface.frame.cell_m)
    image = np.repeat(light[:, :, np.newaxis], 4, axis=2)
    image[:, :, 3] = filled(np.where(surface.sums[:, :, COUNT] > 0, 1.0, np.nan)) > 0
    page.image(np.clip(image, 0.0, 1.0), surface.frame, interpolation="antialiased")


def _dz_histogram(page: MapPage, top: float) -> None:
    """Draw a histogram of the single cells' signed differences, coloured like the map; bars end at class limits."""
    room = page.page_in[1] - TOP_IN - top - 0.75
    if room < 0.6:
        return
    axes = page.side(top, 2.2, float(min(room, 2.0)))
    counts = page.look.overlap.signed
    share = np.cumsum(np.bincount(np.abs(np.arange(len(counts)) - HISTOGRAM_HALF), counts)) / counts.sum()
    half_m = max(1.5 * DZ_LIMITS_M[1], 1.1 * HISTOGRAM_STEP_M * float(np.searchsorted(share, 0.995)))
    step = next((size for size in BARS_MM if size >= half_m / 0.03), BARS_MM[-1])
    low_mm = np.floor((np.arange(len(counts)) - HISTOGRAM_HALF) / step).astype(int) * step
    lows_mm, which = np.unique(low_mm, return_inverse=True)
    totals, middles_m = np.bincount(which, counts), (lows_mm + step / 2) * HISTOGRAM_STEP_M
    inside = np.abs(middles_m) <= half_m
    limits = [limit for limit in DZ_LIMITS_M if limit < half_m]
    colours = [SIZE_COLOURS[class_number(abs(middle), limits)] for middle in middles_m[inside].tolist()]
    axes.bar(100 * middles_m[inside], totals[inside], width=0.1 * step, color=colours)
    axes.axvline(0.0, color=INK, lw=0.7)
    axes.set_xlim(-100 * half_m, 100 * half_m)
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: thousands(value, 0 if value % 1 == 0 else 1)))
    axes.set_yticks([])
    axes.spines[["left", "right", "top"]].set_visible(False)
    axes.set_xlabel("dZ of single cells (cm),\nfirst strip − second", fontsize=8, color=MUTED)
