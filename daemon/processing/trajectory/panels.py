"""Draws panels over one time axis, and holds the data of a flight that they share."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, MaxNLocator, ScalarFormatter
from PIL import Image

from swath.daemon.processing.pages.map_axes import HALO, extents, overlaps
from swath.daemon.processing.pages.words import INK, MUTED, thousands
from swath.daemon.processing.trajectory.series import (
    Course,
    Flight,
    Pixels,
    Separation,
    bridged_spans,
    outages_of,
    straight_flight,
)
from swath.georef.arrays import BoolArray, FloatArray, Int64Array
from swath.georef.navigation.inputs import Solution
from swath.georef.timescales.gps_time import DAY_NS, SECOND_NS, table_leap_seconds, utc_from_gps

COLOURS_OF_PICTURE = 128
HEADROOM = 0.16  # of the first panel, for the numbers of strips
OUTAGE, BRIDGED, STRIP = "#d9dcd7", "#f3b8a8", "#e6eef6"


@dataclass(frozen=True, slots=True)
class Format:
    """The format of a picture: its width, its panels' height, its resolution and its ticks."""

    width_in: float
    panel_in: float
    dpi: int
    ticks: int


WIDE, NARROW = Format(8.6, 1.3, 136, 7), Format(4.1, 1.3, 180, 4)


@dataclass(frozen=True, eq=False)
class Drawn:
    """A flight with data that several pictures need."""

    flight: Flight
    course: Course
    separation: Separation | None

    @cached_property
    def outages_s(self) -> FloatArray:
        """Outages (k, 2), seconds from the first epoch."""
        return (outages_of(self.flight) - self.flight.start_ns) / SECOND_NS

    @cached_property
    def bridged_s(self) -> FloatArray:
        """Spans of bridged samples (k, 2), seconds from the first epoch."""
        return (bridged_spans(self.flight.best) - self.flight.start_ns) / SECOND_NS

    @cached_property
    def strips_s(self) -> FloatArray:
        """Straight flight (k, 2), seconds from the first epoch."""
        return (straight_flight(self.flight) - self.flight.start_ns) / SECOND_NS

    def utc(self, seconds: float, *, fine: bool = False) -> str:
        """Return the time of day in UTC at seconds from the first epoch; fine: to the tenth of a second."""
        date, _ = utc_from_gps(self.flight.start_ns, 18)
        gps_ns = self.flight.start_ns + round(seconds * SECOND_NS)
        tenths = (utc_from_gps(gps_ns, table_leap_seconds(date)[0])[1] + SECOND_NS // 20) // (SECOND_NS // 10)
        whole, tenth = divmod(tenths % (DAY_NS // SECOND_NS * 10), 10)
        text = f"{whole // 3600:02d}:{whole // 60 % 60:02d}:{whole % 60:02d}"
        return f"{text}.{tenth}" if fine else text

    @property
    def utc_date(self) -> str:
        """The day of the first epoch in UTC."""
        date, _ = utc_from_gps(self.flight.start_ns, 18)
        return utc_from_gps(self.flight.start_ns, table_leap_seconds(date)[0])[0].isoformat()

    @cached_property
    def _bands(self) -> dict[tuple[int, str], FloatArray]:
        return {}

    def band(self, pixels: Pixels, solution: Solution, column: str) -> FloatArray:
        """Return the band (2, m, …) of a solution's column; it is computed once for both formats."""
        key = id(solution), column
        if key not in self._bands:
            self._bands[key] = pixels.band(getattr(solution, column))
        return self._bands[key]

    @cached_property
    def filter_pixels(self) -> Pixels:
        """Pixels of the filter's epochs."""
        return Pixels(self.flight.forward.time_ns, self.flight.start_ns)

    @cached_property
    def node_pixels(self) -> Pixels:
        """Pixels of the nodes of the best solution."""
        return Pixels(self.flight.best.node_time_ns, self.flight.start_ns)

    def since_start_s(self, time_ns: Int64Array) -> FloatArray:
        """Return seconds (n,) from the first epoch to GPS times."""
        seconds: FloatArray = (time_ns - self.flight.start_ns) / SECOND_NS
        return seconds


class Sheet:
    """Panels one below the other over one time axis."""

    def __init__(self, drawn: Drawn, form: Format, words: Sequence[str], panel: float = 1.0) -> None:
        self.drawn, self.form = drawn, form
        count = len(words)
        panel_in = panel * form.panel_in
        gap_in, top_in, bottom_in = 0.33, 0.32, 0.64
        height_in = top_in + bottom_in + count * panel_in + (count - 1) * gap_in
        self.figure = Figure(figsize=(form.width_in, height_in), facecolor="white")
        self.panels: list[Axes] = list(np.ravel(self.figure.subplots(count, 1, sharex=True, squeeze=False)))
        self.figure.subplots_adjust(
            left=0.6 / form.width_in,
            right=1.0 - 0.3 / form.width_in,
            top=1.0 - top_in / height_in,
            bottom=bottom_in / height_in,
            hspace=gap_in / panel_in,
        )
        duration_s = drawn.flight.duration_s
        self.unit_s, unit = (
            next(
                (size_s, word)
                for size_s, word in ((3600.0, "h"), (60.0, "min"), (1.0, "s"))
                if duration_s >= 3 * size_s
            )
            if duration_s >= 3.0
            else (1.0, "s")
        )
        label = f"Time since the start ({unit}); below it UTC, from {drawn.utc_date}"
        self.panels[-1].set_xlabel(label, fontsize=8.5, color=MUTED)
        self.panels[-1].set_xlim(0.0, max(duration_s, 1e-3) / self.unit_s)
        self.panels[-1].xaxis.set_major_formatter(FuncFormatter(self._time_words))
        for axes, title in zip(self.panels, words, strict=True):
            self._dress(axes, title)

    def _time_words(self, value: float, _: int | None = None) -> str:
        """Return the words at a tick of the time axis: time since the start, and UTC."""
        digits = 0 if self.drawn.flight.duration_s >= 6.0 * self.unit_s else 1
        fine = self.drawn.flight.duration_s < 6.0
        return f"{thousands(value, digits)}\n{self.drawn.utc(value * self.unit_s, fine=fine)}"

    def _dress(self, axes: Axes, title: str) -> None:
        dress(axes)
        axes.set_title(title, loc="left", fontsize=8.5, color=INK, pad=4)
        axes.xaxis.set_major_locator(MaxNLocator(self.form.ticks, steps=[1, 2, 5, 10]))
        axes.yaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10]))
        axes.yaxis.set_major_formatter(ScalarFormatter(useOffset=False))
        spans = (
            (self.drawn.strips_s, STRIP, 0.4),
            (self.drawn.outages_s, OUTAGE, 0.5),
            (self.drawn.bridged_s, BRIDGED, 0.6),
        )
        for spans_s, colour, level in spans:
            ends = spans_s / self.unit_s
            if len(ends):
                axes.broken_barh(
                    list(zip(ends[:, 0], ends[:, 1] - ends[:, 0], strict=True)),
                    (0.0, 1.0),
                    transform=axes.get_xaxis_transform(),
                    color=colour,
                    lw=0.0,
                    zorder=level,
                )

    def line(self, axes: Axes, pixels: Pixels, band: FloatArray, colour: str, broken: BoolArray | None = None) -> None:
        """Draw a line through bands (2, m); ``broken`` (m − 1,) marks additional breaks."""
        at_s, values = pixels.line(band, broken)
        axes.plot(at_s / self.unit_s, values, color=colour, lw=0.9, solid_joinstyle="round")

    def fill(self, axes: Axes, pixels: Pixels, low: FloatArray, high: FloatArray, colour: str) -> None:
        """Fill between two lines (m,)."""
        axes.fill_between(pixels.at_s / self.unit_s, low, high, color=colour, lw=0.0, alpha=0.18)

    def legend(self, axes: Axes, handles: Sequence[tuple[str, str]]) -> None:
        """Draw a legend of colours and words, at the right of a panel's title."""
        lines = [Line2D([], [], color=colour, lw=1.8, label=word) for colour, word in handles]
        self.legend_of(axes, lines)

    def legend_of(self, axes: Axes, handles: Sequence[Any]) -> None:
        """Draw a legend of any handles at the same place."""
        axes.legend(
            handles=list(handles),
            loc="lower right",
            bbox_to_anchor=(1.0, 1.0),
            ncols=len(handles),
            frameon=False,
            fontsize=8,
            labelcolor=INK,
            handlelength=1.0,
            handletextpad=0.4,
            columnspacing=1.0,
            borderaxespad=0.1,
        )

    def _number_strips(self) -> None:
        """Write the strips' numbers above the lines of the first panel, as far as they have room."""
        axes, last = self.panels[0], None
        if len(self.drawn.strips_s):
            low, high = axes.get_ylim()
            log = axes.get_yscale() == "log"
            axes.set_ylim(low, high * (high / low) ** HEADROOM if log else high + HEADROOM * (high - low))
        for number, (begin, end) in enumerate(self.drawn.strips_s / self.unit_s, start=1):
            place: dict[str, Any] = {"transform": axes.get_xaxis_transform(), "ha": "center", "va": "top", "zorder": 6}
            look: dict[str, Any] = {"fontsize": 7.5, "color": MUTED, "path_effects": HALO}
            text = axes.text((begin + end) / 2, 0.96, str(number), **place, **look)
            text.set_gid("strip")
            (box,) = extents([text], self.figure)
            if last is not None and overlaps(box, [last]):
                text.set_visible(False)
            else:
                last = box

    def picture(self) -> bytes:
        """Return the sheet as PNG."""
        self._number_strips()
        return picture_of(self.figure, self.form)


def dress(axes: Axes) -> None:
    """Style the colours, ticks and grid of a panel."""
    axes.tick_params(labelsize=8, colors=MUTED, length=3)
    axes.spines[:].set_color("#b9bdb8")
    axes.grid(color="#7c858c", lw=0.4, alpha=0.35)
    axes.set_axisbelow(True)


def picture_of(figure: Figure, form: Format) -> bytes:
    """Return a figure as PNG with few colours: a third of the bytes, without a visible difference."""
    figure.set_dpi(form.dpi)
    canvas: Any = FigureCanvasAgg(figure)
    with rc_context({"axes.unicode_minus": True}):
        canvas.draw()
    image = Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3])
    small = io.BytesIO()
    image.quantize(COLOURS_OF_PICTURE, method=Image.Quantize.FASTOCTREE).save(small, format="png")
    return small.getvalue()
