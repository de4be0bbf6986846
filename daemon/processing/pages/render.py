"""Renders HTML pages from their template: one file each, with its style sheet, that needs no network."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from swath.daemon.processing.pages.blocks import Block, Card, Table
from swath.daemon.processing.pages.head import PageHead
from swath.georef.verdicts import Verdict

STYLE_SHEET, TEMPLATE = "page.css", "base.html"
BEFORE_UNIT = re.compile(r"(?<=\d) (?=(?:[ckm]?m|km²|m²|[µm]?s|min|h|ppm|mdeg|mrad|Hz|MB|GB|%|σ|sigmas?)(?![\w]))")
HYPHEN_AS_MINUS = re.compile(r"(?<![\w=.,/\-])-(?=\d)")  # not that of dates, names and definitions of CRS


@dataclass(frozen=True, slots=True)
class Page:
    """The content of a page.

    Attributes:
        kind: what it is, as ``Quick look``; stands above the heading.
        heading: name of what it is about.
        head: flight, logs, aircraft, coordinate system, calibration, software.
        blocks: all that stands below verdict and cards.
        verdict: None: nothing is judged.
        cards: the most important figures.
        subtitle: a line under the heading; empty: none.
        title: title of the document; empty: heading and kind.
        appendix: what stands at the end: formulas, methods, complete lists.
    """

    kind: str
    heading: str
    head: PageHead
    blocks: Sequence[Block]
    verdict: Verdict | None = None
    cards: Sequence[Card] = ()
    subtitle: str = ""
    title: str = ""
    appendix: Sequence[Block] = ()


@cache
def environment() -> Environment:
    """Return the environment of the templates beside this module; it escapes all text and refuses undefined names."""
    loader = PackageLoader("swath.daemon.processing.pages", "templates")
    made = Environment(
        loader=loader,
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        finalize=_typeset,
    )
    style, _, _ = loader.get_source(made, STYLE_SHEET)
    made.globals["style"] = Markup(style)
    return made


def _typeset(value: Any) -> Any:
    """Return a text with real minus signs before numbers, and with units that stay on the line of their number.

    Texts of other programs and of scripts have hyphens and plain spaces there.
    """
    return BEFORE_UNIT.sub("\u00a0", HYPHEN_AS_MINUS.sub("−", value)) if type(value) is str else value


def render(template: str, **values: Any) -> str:
    """Return the HTML text of a page; the same values give the same text.

    Raises:
        jinja2.UndefinedError: the template uses a value that is not given.
    """
    return environment().get_template(template).render(values)


def html_of(page: Page) -> str:
    """Return the HTML text of a page; the same content gives the same text."""
    return render(
        TEMPLATE,
        kind=page.kind,
        heading=page.heading,
        head=page.head,
        subtitle=page.subtitle,
        title=page.title or f"{page.heading}: {page.kind.lower()}",
        verdict=page.verdict,
        cards=page.cards,
        blocks=_shown(page.blocks),
        appendix=_shown(page.appendix),
    )


def _shown(blocks: Iterable[Block]) -> list[Block]:
    """Return the blocks without columns in which nothing is known."""
    return [block.known_columns() if isinstance(block, Table) else block for block in blocks]
