"""Measures the texts of a drawn figure, reads pages as a person would, and names faults of pages."""

from __future__ import annotations

import re
from html.parser import HTMLParser
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


class Tables(HTMLParser):
    """Parser that collects a page's words outside its style, and its tables as rows of cells, heads first."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.words: list[str] = []
        self.tables: list[list[list[str]]] = []
        self.headed: list[bool] = []
        self._inside = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag == "table":
            self.tables.append([])
            self.headed.append(False)
        elif tag == "tr":
            self.tables[-1].append([])
        elif tag in ("td", "th"):
            self.tables[-1][-1].append("")
            self.headed[-1] |= tag == "th"
        if tag in ("style", "td", "th"):
            self._inside = tag

    def handle_endtag(self, tag: str) -> None:
        self._inside = "" if tag == self._inside else self._inside

    def handle_data(self, data: str) -> None:
        if self._inside in ("td", "th"):
            self.tables[-1][-1][-1] += data
        if self._inside != "style":
            self.words.append(data)


def faults_of(text: str) -> list[str]:
    """Return what no page may have: empty heads, columns without content, hyphens as minus signs, negative zeros."""
    page, faults = Tables(text), []
    for table, headed in zip(page.tables, page.headed, strict=True):
        if headed:
            heads, *rows = table
            faults += [f"empty head in {heads}" for head in heads if not head.strip()]
            columns = zip(*rows, strict=True)
            faults += [
                f"nothing known: {head}"
                for number, (head, column) in enumerate(zip(heads, columns, strict=True))
                if number and {cell.strip() for cell in column} <= {"", "–"}
            ]
    faults += [f"zero with a sign: {word}" for word in page.words if re.fullmatch(r"\s*[−-]0(\.0+)?\s*", word)]
    words = " ".join(page.words)
    return faults + [f"hyphen: {found[0]}" for found in re.finditer(r".{0,20}(?<![\w=.,/-])-\d.{0,10}", words)]
