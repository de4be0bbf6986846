"""Writes the report of a calibration: one HTML page that needs no network, and the same as PDF."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from html import escape

from swath.calib.summary import Difference, DifferenceMap, PairDifference, Profile, ReportInput
from swath.calib.verdict import judge
from swath.daemon.processing.calibration.report.contents import Block, Notes, Words, blocks_of, cards_of, identity_rows
from swath.daemon.processing.calibration.report.pdf import pdf_of
from swath.daemon.processing.calibration.report.tables import Table
from swath.daemon.processing.pages.canvas import NARROW, WIDE, Picture
from swath.daemon.processing.pages.style import REPORT_STYLE
from swath.georef.verdicts import Verdict

__all__ = ["Difference", "DifferenceMap", "PairDifference", "Profile", "ReportInput", "html", "judge", "pdf"]

NARROW_PX = 640  # window width up to which the narrow pictures are shown


def html(report: ReportInput) -> str:
    """Return the report as an HTML page; the same input gives the same text."""
    verdict = judge(report)
    parts = [
        f"<!doctype html><html lang='en'><head><meta charset='utf-8'><title>{escape(report.heading)}</title>",
        "<meta name='viewport' content='width=device-width, initial-scale=1'>",
        f"<style>{REPORT_STYLE}</style></head><body>",
        f"<header><p class='kind'>Calibration report</p><h1>{escape(report.heading)}</h1></header>",
        _verdict(verdict),
        _cards(cards_of(report)),
        _identity(identity_rows(report)),
        *(_block(block) for block in blocks_of(report, verdict)),
        "</body></html>\n",
    ]
    return "\n".join(part for part in parts if part)


def pdf(report: ReportInput) -> bytes:
    """Return the report on A4 pages as PDF; the same input gives the same bytes."""
    verdict = judge(report)
    blocks = blocks_of(report, verdict)
    return pdf_of(report.heading, verdict, cards_of(report), identity_rows(report), blocks)


def _verdict(verdict: Verdict) -> str:
    return f"<p class='verdict {verdict.level.name.lower()}'>{escape(verdict.sentence)}</p>"


def _cards(cards: Sequence[tuple[str, str]]) -> str:
    told = "".join(
        f"<div><b>{escape(value)}</b><span class='muted'>{escape(word)}</span></div>" for value, word in cards
    )
    return f"<div class='figures'>{told}</div>"


def _identity(rows: Sequence[tuple[str, str]]) -> str:
    cells = "".join(f"<tr><th>{escape(key)}</th><td class='left'>{escape(value)}</td></tr>" for key, value in rows)
    return f"<table class='identity'>{cells}</table>" if rows else ""


def _block(block: Block) -> str:
    if isinstance(block, Words):
        return f"{_title(block.title)}<p class='method'>{escape(block.text)}</p>"
    if isinstance(block, Notes):
        return f"<ul class='notes'>{''.join(f'<li>{escape(line)}</li>' for line in block.lines)}</ul>"
    if isinstance(block, Table):
        return _table(block)
    if isinstance(block, Profile):
        return _figure(block.title, block.caption, [block.svg.encode()], "given")
    return _figure(block.title, block.words, _drawn(block))


def _title(title: str) -> str:
    return f"<h2>{escape(title)}</h2>" if title else ""


def _drawn(picture: Picture) -> list[bytes]:
    return [picture.svg(WIDE), picture.svg(NARROW)]


def _figure(title: str, words: str, svgs: Sequence[bytes], look: str = "drawn") -> str:
    """Return a figure of a wide and, if given, a narrow picture; each is an image of its own so that their ids do not
    collide.
    """
    data = [f"data:image/svg+xml;base64,{base64.b64encode(svg).decode('ascii')}" for svg in svgs]
    narrow = f"<source media='(max-width: {NARROW_PX}px)' srcset='{data[1]}'>" if len(data) > 1 else ""
    told = f"<p class='muted'>{escape(words)}</p>" if words else ""
    picture = f"<picture>{narrow}<img alt='{escape(title)}' src='{data[0]}'></picture>"
    return f"{_title(title)}{told}<figure class='{look}'>{picture}</figure>"


def _table(table: Table) -> str:
    def cell(word: str, column: int) -> str:
        look = "hash" if column in table.hashes else "left" if column in table.left and column else ""
        named = f" data-head='{escape(table.heads[column])}'" if table.stacked else ""
        shown = f" class='{look}'" if look else ""
        return f"<td{shown}{named}>{escape(word)}</td>"

    classes = [
        ("left" if column in table.left or column in table.hashes else "", word)
        for column, word in enumerate(table.heads)
    ]
    head = "".join(
        f"<th class='{look}'>{escape(word)}</th>" if look else f"<th>{escape(word)}</th>" for look, word in classes
    )
    body = "".join(
        f"<tr{' class=held' if i in table.pale else ''}>{''.join(cell(word, j) for j, word in enumerate(row))}</tr>"
        for i, row in enumerate(table.rows)
    )
    heads = f"<thead><tr>{head}</tr></thead>" if any(table.heads) else ""
    look = " class='stacked'" if table.stacked else ""
    under = f"<p class='muted'>{escape(table.under)}</p>" if table.under else ""
    whole = f"<div class='scroll'><table{look}>{heads}<tbody>{body}</tbody></table></div>"
    return f"{_title(table.title)}{whole}{under}"
