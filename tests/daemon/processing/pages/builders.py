"""Measures the texts of a drawn figure."""

from __future__ import annotations

from itertools import combinations
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text


def texts_of(figure: Figure) -> list[Text]:
    """Return all texts that a figure shows, tick labels and legends included."""
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    hidden = _hidden(figure)
    found = [text for text in figure.findobj(Text) if isinstance(text, Text) and id(text) not in hidden]
    return [text for text in found if text.get_visible() and text.get_text().strip()]


def _hidden(figure: Figure) -> set[int]:
    """Return labels of hidden axes and of ticks outside the view, which Matplotlib keeps but does not draw."""
    hidden: set[int] = set()
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            one: Any = axis
            drawn = one._update_ticks() if axes.axison and one.get_visible() else []
            for tick in [*one.get_major_ticks(), *one.get_minor_ticks()]:
                if tick not in drawn:
                    hidden |= {id(tick.label1), id(tick.label2)}
            if not axes.axison:
                hidden |= {id(one.label), id(one.offsetText)}
    return hidden


def overlapping(figure: Figure) -> list[tuple[str, str]]:
    """Return pairs of texts whose rectangles overlap by more than half a pixel, and texts that leave the page."""
    texts = texts_of(figure)
    canvas: Any = FigureCanvasAgg(figure)
    renderer = canvas.get_renderer()
    boxes = [(text.get_text(), Text.get_window_extent(text, renderer)) for text in texts]
    found = [
        (one, other)
        for (one, box), (other, beside) in combinations(boxes, 2)
        if min(box.x1, beside.x1) - max(box.x0, beside.x0) > 0.5
        and min(box.y1, beside.y1) - max(box.y0, beside.y0) > 0.5
    ]
    page = figure.bbox
    found += [
        (one, "the page's edge")
        for one, box in boxes
        if box.x0 < page.x0 - 0.5 or box.x1 > page.x1 + 0.5 or box.y0 < page.y0 - 0.5 or box.y1 > page.y1 + 0.5
    ]
    return found
