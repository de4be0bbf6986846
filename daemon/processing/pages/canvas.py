"""Draws a report's pictures: the same picture wide, narrow and on paper."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

INK, MUTED, LINE, PALE = "#1d242b", "#5d6770", "#b9bdb8", "#eef0ec"
BEFORE, AFTER, GOOD, BAD = "#b8860b", "#0b5e8a", "#2f7d4f", "#b3261e"
SERIES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#7a5c00", "#56b4e9", "#8b1a1a", "#5b4fc4", "#444444")
MOST_MARKS = 400  # that are drawn as lines; more become an image, because each takes a millisecond to print
RASTER_DPI = 220
SETTINGS: Any = {
    "svg.hashsalt": "calibration",  # the same picture then gives the same text
    "font.family": "DejaVu Sans",
    "font.size": 8.5,
    "path.simplify": True,
    "axes.unicode_minus": True,
}


@dataclass(frozen=True, slots=True)
class Format:
    """The width of a picture, the number of panels side by side, and the number of ticks on an axis.

    Attributes:
        fonttype: how SVG holds text: "path" as outlines, since a reader's computer may lack the font; "none" as text.
    """

    width_in: float
    columns: int
    ticks: int
    narrow: bool = False
    fonttype: str = "path"


WIDE, NARROW, PAPER = Format(10.4, 2, 8), Format(4.1, 1, 4, narrow=True), Format(7.1, 2, 6, fonttype="none")


@dataclass(frozen=True, eq=False)
class Picture:
    """One picture of a report.

    Attributes:
        title, words: heading and text above it.
        height_in: gives its height, in inches, in a format.
        draw: draws it onto a canvas of that height.
    """

    title: str
    words: str
    height_in: Callable[[Format], float]
    draw: Callable[[Canvas], None]

    def svg(self, form: Format) -> bytes:
        """Return the picture as an SVG file; the same picture gives the same bytes."""
        with rc_context(SETTINGS | {"svg.fonttype": form.fonttype}):
            height_in = self.height_in(form)
            figure = Figure(figsize=(form.width_in, height_in), facecolor="white")
            self.draw(Canvas(figure, form, height_in))
            held = io.BytesIO()
            figure.savefig(held, format="svg", metadata={"Date": None, "Creator": None}, dpi=RASTER_DPI)
        return held.getvalue()


class Canvas:
    """A figure, measured in inches from its upper left corner.

    Attributes:
        figure: the Matplotlib figure.
        form, height_in: format and height of the canvas.
    """

    def __init__(self, figure: Figure, form: Format, height_in: float) -> None:
        self.figure, self.form, self.height_in = figure, form, height_in

    def place(self, left: float, top: float) -> tuple[float, float]:
        """Return a point in the figure's own coordinates, 0 … 1 from its lower left corner."""
        return left / self.form.width_in, 1.0 - top / self.height_in

    def panel(self, left: float, top: float, width: float, height: float, **more: Any) -> Axes:
        """Return styled axes of this size."""
        x, y = self.place(left, top + height)
        axes: Axes = self.figure.add_axes((x, y, width / self.form.width_in, height / self.height_in), **more)
        dress(axes)
        return axes

    def text(self, left: float, top: float, words: str, **style: Any) -> Any:
        """Write words with their upper left corner at a point, and return Matplotlib's text."""
        look: dict[str, Any] = {"fontsize": 8.5, "color": INK, "va": "top", "ha": "left"} | style
        return self.figure.text(*self.place(left, top), words, **look)

    def legend(self, handles: Sequence[Any], columns: int | None = None, top: float = 0.0) -> None:
        """Draw a legend along the upper edge."""
        most = columns or (3 if self.form.narrow else 9)
        rows = -(-len(handles) // most)
        across = -(-len(handles) // rows)
        filled = [*handles, *[Line2D([], [], ls="", label=" ") for _ in range(rows * across - len(handles))]]
        self.figure.legend(
            handles=[filled[row * across + column] for column in range(across) for row in range(rows)],
            loc="upper left",
            bbox_to_anchor=self.place(0.0, top),
            ncols=across,
            frameon=False,
            fontsize=8,
            labelcolor=INK,
            handlelength=1.3,
            handletextpad=0.5,
            columnspacing=1.3,
            borderaxespad=0.0,
            borderpad=0.1,
        )


class Panels:
    """Equal panels in rows and columns, as many side by side as the format allows.

    Attributes:
        axes: one per title.
    """

    GAP_IN, LEFT_IN, BOTTOM_IN = 0.62, 0.64, 0.5

    def __init__(
        self, canvas: Canvas, titles: Sequence[str], panel_in: float, top: float, columns: int | None = None
    ) -> None:
        across = min(columns or canvas.form.columns, len(titles))
        width = (canvas.form.width_in - 0.1) / across - self.LEFT_IN - 0.08
        self.axes: list[Axes] = []
        for i, title in enumerate(titles):
            row, column = divmod(i, across)
            left = self.LEFT_IN + column * (width + self.LEFT_IN + 0.08)
            axes = canvas.panel(left, top + 0.25 + row * (panel_in + self.GAP_IN), width, panel_in)
            axes.set_title(title, loc="left", fontsize=8.5, color=INK, pad=4)
            axes.xaxis.set_major_locator(MaxNLocator(canvas.form.ticks // (2 if across > 1 else 1) + 1))
            self.axes.append(axes)

    @classmethod
    def height_in(cls, form: Format, count: int, panel_in: float, columns: int | None = None) -> float:
        """Return the height of all rows together, in inches, without what stands above."""
        rows = -(-count // min(columns or form.columns, count))
        return 0.25 + rows * (panel_in + cls.GAP_IN) - cls.GAP_IN + cls.BOTTOM_IN


def dress(axes: Axes) -> None:
    """Style the colours, ticks and grid of a panel."""
    axes.tick_params(labelsize=8, colors=MUTED, length=3)
    axes.spines[:].set_color(LINE)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(color="#7c858c", lw=0.4, alpha=0.3)
    axes.set_axisbelow(True)


def colour_of(index: int) -> str:
    """Return the colour of a series of values."""
    return SERIES[index % len(SERIES)]
