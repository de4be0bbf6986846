"""Sets a report on A4 pages: its words, tables and pictures one below the other."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

from matplotlib import rc_context
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, findfont, get_font
from matplotlib.ft2font import LoadFlags
from matplotlib.image import imread
from matplotlib.patches import Rectangle

from swath.calib.summary import Profile
from swath.daemon.processing.calibration.report.contents import Block, Notes, Words
from swath.daemon.processing.calibration.report.tables import Table
from swath.daemon.processing.pages.canvas import AFTER, BAD, GOOD, INK, MUTED, PAPER, SETTINGS, Canvas, Picture
from swath.georef.verdicts import Level, Verdict

PAGE_IN, MARGIN_IN = (8.27, 11.69), 0.585
TOP_IN, FOOT_IN = 0.6, 0.65
SIZE, SMALL = 8.5, 7.5  # points
LINE_IN = SIZE * 1.42 / 72.0
LEVEL_COLOURS = {Level.GOOD: GOOD, Level.CARE: "#e0a100", Level.UNUSABLE: BAD}
MONO = "DejaVu Sans Mono"
PROFILE_DPI, HIGHEST_PROFILE_IN = 220, 6.0
SLACK = 1.02  # viewers set some words wider than their font's metrics


@dataclass(frozen=True, slots=True)
class Set:
    """A piece of a page: its height, its drawing function, and whether the next piece must stand on the same page."""

    height_in: float
    draw: Callable[[Canvas], None]
    with_next: bool = False


def pdf_of(
    title: str,
    verdict: Verdict,
    cards: Sequence[tuple[str, str]],
    identity: Sequence[tuple[str, str]],
    blocks: Sequence[Block],
) -> bytes:
    """Return a report as a PDF file."""
    pieces = [_head(title), _judged(verdict), *_cards(cards), *_identity(identity)]
    for block in blocks:
        pieces += _pieces(block)
    held = io.BytesIO()
    described = {"Title": title, "CreationDate": None, "Creator": None, "Producer": None}
    with rc_context(SETTINGS), PdfPages(held, metadata=described) as file:
        pages = _paged(pieces)
        for number, page in enumerate(pages, 1):
            file.savefig(_page(page, f"{title} · {number} of {len(pages)}"))
    return held.getvalue()


def _paged(pieces: Sequence[Set]) -> list[list[Set]]:
    """Return pieces by page; a piece that must stand with its next one moves with it."""
    room_in = PAGE_IN[1] - TOP_IN - FOOT_IN
    pages: list[list[Set]] = [[]]
    i = 0
    while i < len(pieces):
        last = i
        while pieces[last].with_next and last + 1 < len(pieces):
            last += 1
        group = pieces[i : last + 1]
        used_in = sum(piece.height_in for piece in pages[-1])
        if pages[-1] and used_in + sum(piece.height_in for piece in group) > room_in:
            pages.append([])
        pages[-1] += group
        i = last + 1
    return pages


def _page(pieces: Sequence[Set], foot: str) -> Figure:
    figure = Figure(figsize=PAGE_IN, facecolor="white")
    top_in = TOP_IN
    for piece in pieces:
        piece.draw(Canvas(figure, PAPER, piece.height_in, (MARGIN_IN, top_in)))
        top_in += piece.height_in
    figure.text(MARGIN_IN / PAGE_IN[0], 0.33 / PAGE_IN[1], foot, fontsize=7, color=MUTED)
    return figure


def width_in(words: str, size: float = SIZE, family: str = "DejaVu Sans") -> float:
    """Return the width of words as they are set, in inches."""
    return SLACK * sum(_advance(character, family) for character in words) * size / 72.0


@cache
def _advance(character: str, family: str) -> float:
    """Return the advance of one character, in sizes of its font."""
    font = get_font(findfont(FontProperties(family=family)))
    font.set_size(SIZE, 72)
    glyph = font.load_char(ord(character), flags=LoadFlags.NO_HINTING)
    return float(glyph.linearHoriAdvance) / 65536.0 / SIZE


def wrapped(words: str, room_in: float, size: float = SIZE, family: str = "DejaVu Sans") -> list[str]:
    """Return lines that fit the room; words that are too long (hashes) are broken."""
    lines: list[str] = []
    line = ""
    for word in words.split():
        longer = f"{line} {word}" if line else word
        if not line or width_in(longer, size, family) <= room_in:
            line = longer
        else:
            lines.append(line)
            line = word
        if width_in(line, size, family) > room_in:
            most = max(int(len(line) * room_in / width_in(line, size, family)) - 1, 4)
            *full, line = textwrap.wrap(line, most) or [""]
            lines += full
    return [*lines, line] if line or not lines else lines


def _say(canvas: Canvas, left: float, top: float, lines: Sequence[str], **style: Any) -> None:
    for i, line in enumerate(lines):
        canvas.text(left, top + i * LINE_IN, line, parse_math=False, **({"fontsize": SIZE} | style))


def _head(title: str) -> Set:
    lines = wrapped(title, PAPER.width_in, 16)

    def draw(canvas: Canvas) -> None:
        canvas.text(0.0, 0.0, "CALIBRATION REPORT", fontsize=8, color=AFTER, weight="bold")
        for i, line in enumerate(lines):
            canvas.text(0.0, 0.2 + 0.3 * i, line, fontsize=16, weight="bold", parse_math=False)
        _rule(canvas, canvas.height_in - 0.12, AFTER, 1.6)

    return Set(0.36 + 0.3 * len(lines), draw)


def _rule(canvas: Canvas, top: float, colour: str, width: float, length: float = PAPER.width_in) -> None:
    _box(canvas, 0.0, top, length, width / 72.0, fc=colour, ec="none")


def _box(canvas: Canvas, left: float, top: float, width: float, height: float, **style: Any) -> None:
    (x0, y0), (x1, y1) = canvas.place(left, top + height), canvas.place(left + width, top)
    look: dict[str, Any] = {"fc": "white", "ec": "#d9dcd7", "lw": 0.7} | style
    box = Rectangle((x0, y0), x1 - x0, y1 - y0, transform=canvas.figure.transFigure, **look)
    canvas.figure.add_artist(box)


def _judged(verdict: Verdict) -> Set:
    lines = wrapped(verdict.sentence, PAPER.width_in - 0.4, 10.0)
    height = 0.2 + 0.2 * len(lines)

    def draw(canvas: Canvas) -> None:
        _box(canvas, 0.0, 0.0, canvas.form.width_in, height, fc="#f7f8f5", ec="none")
        _box(canvas, 0.0, 0.0, 0.07, height, fc=LEVEL_COLOURS[verdict.level], ec="none")
        for i, line in enumerate(lines):
            canvas.text(0.22, 0.1 + 0.2 * i, line, fontsize=10.0, parse_math=False)

    return Set(height + 0.18, draw)


def _cards(cards: Sequence[tuple[str, str]]) -> list[Set]:
    across = 5
    rows = [cards[first : first + across] for first in range(0, len(cards), across)]
    step = PAPER.width_in / across

    def drawn(row: Sequence[tuple[str, str]]) -> Callable[[Canvas], None]:
        def draw(canvas: Canvas) -> None:
            for i, (value, word) in enumerate(row):
                _box(canvas, i * step, 0.0, step - 0.08, 0.62)
                canvas.text(i * step + 0.08, 0.08, value, fontsize=12, weight="bold", parse_math=False)
                for k, line in enumerate(wrapped(word, step - 0.24, 6.6)[:2]):
                    canvas.text(i * step + 0.08, 0.32 + 0.13 * k, line, fontsize=6.6, color=MUTED)

        return draw

    return [Set(0.72, drawn(row)) for row in rows]


def _identity(rows: Sequence[tuple[str, str]]) -> list[Set]:
    table = Table("", ("", ""), [list(row) for row in rows], left=(0, 1))
    return _table(table) if rows else []


def _pieces(block: Block) -> list[Set]:
    if isinstance(block, Words):
        return [*_title(block.title), _paragraph(block.text)]
    if isinstance(block, Notes):
        return [_paragraph(f"• {line}") for line in block.lines]
    if isinstance(block, Table):
        return [*_title(block.title), *_table(block)]
    if isinstance(block, Profile):
        return _profile(block)
    return _picture(block)


def _title(title: str) -> list[Set]:
    if not title:
        return []
    return [Set(0.5, lambda canvas: _say(canvas, 0.0, 0.24, [title], fontsize=11, weight="bold"), with_next=True)]


def _paragraph(words: str, colour: str = INK, *, with_next: bool = False) -> Set:
    lines = wrapped(words, PAPER.width_in)
    return Set(
        len(lines) * LINE_IN + 0.07, lambda canvas: _say(canvas, 0.0, 0.02, lines, color=colour), with_next=with_next
    )


def _picture(picture: Picture) -> list[Set]:
    words = [_paragraph(picture.words, MUTED, with_next=True)] if picture.words else []
    height = picture.height_in(PAPER)
    return [*_title(picture.title), *words, Set(height + 0.05, picture.draw)]


def _profile(profile: Profile) -> list[Set]:
    if profile.figure is None:
        told = f"{profile.caption} (The picture stands on the page.)".strip()
        return [*_title(profile.title), _paragraph(told, MUTED)]
    words = [_paragraph(profile.caption, MUTED, with_next=True)] if profile.caption else []
    held = io.BytesIO()
    profile.figure().savefig(held, format="png", dpi=PROFILE_DPI)
    image = imread(io.BytesIO(held.getvalue()))
    height = min(PAPER.width_in * image.shape[0] / image.shape[1], HIGHEST_PROFILE_IN)

    def draw(canvas: Canvas) -> None:
        axes = canvas.panel(0.0, 0.0, PAPER.width_in, height)
        axes.set_axis_off()
        axes.imshow(image, aspect="equal", interpolation="none")
        axes.set_anchor("NW")

    return [*_title(profile.title), *words, Set(height + 0.05, draw)]


def _table(table: Table) -> list[Set]:
    """Return one piece per row so that a long table can continue on further pages; its heads stand
    with the first row.
    """
    size = SMALL
    columns = range(len(table.heads))
    wide = _widths(table, size)
    lefts = [sum(wide[:column]) for column in columns]
    left = {*table.left, *table.hashes}

    def row_of(cells: Sequence[str], colour: str, *, head: bool, last: bool) -> Set:
        words = [
            wrapped(
                cell,
                wide[j] - 0.12,
                SMALL - 1.0 if j in table.hashes else size,
                MONO if j in table.hashes else "DejaVu Sans",
            )
            for j, cell in enumerate(cells)
        ]
        height = 0.07 + max(len(lines) for lines in words) * LINE_IN * size / SIZE

        def draw(canvas: Canvas) -> None:
            for j, lines in enumerate(words):
                style: dict[str, Any] = {"color": colour, "fontsize": size}
                if j in table.hashes and not head:
                    style |= {"family": MONO, "fontsize": size - 1.0}
                at = lefts[j] if j in left else lefts[j] + wide[j] - 0.12
                for i, line in enumerate(lines):
                    top = 0.035 + i * LINE_IN * size / SIZE
                    canvas.text(at, top, line, ha="left" if j in left else "right", parse_math=False, **style)
            _rule(canvas, canvas.height_in, "#d9dcd7", 0.5, sum(wide))

        return Set(height, draw, with_next=head or last)

    pieces = [row_of(table.heads, MUTED, head=True, last=False)] if any(table.heads) else []
    for i, row in enumerate(table.rows):
        last = bool(table.under) and i == len(table.rows) - 1
        pieces.append(row_of(row, MUTED if i in table.pale else INK, head=False, last=last))
    if table.under:
        pieces.append(_paragraph(table.under, MUTED))
    return [*pieces, Set(0.1, lambda canvas: None)]


def _widths(table: Table, size: float) -> list[float]:
    """Return column widths: as wide as their words, while columns that may wrap share the rest."""
    natural = []
    for j, head in enumerate(table.heads):
        family = MONO if j in table.hashes else "DejaVu Sans"
        cells = [row[j] for row in table.rows]
        natural.append(max(width_in(cell, size, family) for cell in [head, *cells]) + 0.2)
    over = sum(natural) - PAPER.width_in
    if over <= 0.0:
        return natural
    may = [j for j in {*table.left, *table.hashes} if natural[j] > 1.0] or list(range(len(natural)))
    room = PAPER.width_in - sum(width for j, width in enumerate(natural) if j not in may)
    shares = {j: natural[j] ** 0.6 for j in may}
    whole = sum(shares.values())
    return [max(room, 1.0) * shares[j] / whole if j in may else width for j, width in enumerate(natural)]
