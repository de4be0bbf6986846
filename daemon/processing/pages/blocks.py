"""Defines the blocks of a page, which the templates show in the order given: words, notes, tables and images."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, TypeAlias

from swath.calib.labels import worded
from swath.georef.verdicts import Verdict


@dataclass(frozen=True, slots=True)
class Words:
    """A paragraph, with an optional title above it; muted: in a paler colour."""

    kind: ClassVar = "words"
    text: str
    title: str = ""
    muted: bool = False


@dataclass(frozen=True, slots=True)
class Notes:
    """Sentences that are set apart from the text."""

    kind: ClassVar = "notes"
    lines: Sequence[str]


@dataclass(frozen=True, slots=True)
class Judged:
    """A cell of a table whose colour says whether its content is good or bad."""

    text: str
    good: bool


Cell: TypeAlias = str | Judged
UNKNOWN = ("", "–")  # texts of cells that say nothing


def text_of_cell(cell: Cell) -> str:
    """Return the words of a cell."""
    return cell if isinstance(cell, str) else cell.text


@dataclass(frozen=True, slots=True)
class Table:
    """A table of words.

    Attributes:
        title: heading above it; empty: it continues the block before.
        heads, rows: words; every row has as many as heads. Empty heads are not shown.
        under: explanation below the table.
        left: columns that are set flush left and may wrap.
        hashes: columns of long hexadecimal numbers.
        pale: rows that are set in a paler colour.
        stacked: on narrow screens cells stand one below the other.
        omitted: number of further rows that are not shown.
    """

    kind: ClassVar = "table"
    title: str
    heads: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    under: str = ""
    left: tuple[int, ...] = (0,)
    hashes: tuple[int, ...] = ()
    pale: frozenset[int] = frozenset()
    stacked: bool = False
    omitted: int = 0

    def known_columns(self) -> Table:
        """Return the table without columns whose every cell is empty or a dash; the first column stays."""
        if not self.rows:
            return self
        kept = [
            column
            for column in range(len(self.heads))
            if column == 0 or any(text_of_cell(row[column]).strip() not in UNKNOWN for row in self.rows)
        ]
        if len(kept) == len(self.heads):
            return self
        return replace(
            self,
            heads=[self.heads[column] for column in kept],
            rows=[[row[column] for column in kept] for row in self.rows],
            left=tuple(kept.index(column) for column in self.left if column in kept),
            hashes=tuple(kept.index(column) for column in self.hashes if column in kept),
        )


@dataclass(frozen=True, slots=True)
class Image:
    """A picture within the page.

    Attributes:
        alt: words for readers who do not see it.
        wide, narrow: the picture as data URI, and the one for narrow windows; empty: the same.
        title, words: heading and text above it; empty: none.
        limited: its height is limited, because its proportions are not known.
    """

    kind: ClassVar = "image"
    alt: str
    wide: str
    narrow: str = ""
    title: str = ""
    words: str = ""
    limited: bool = False


def reasons_of(verdict: Verdict) -> list[Block]:
    """Return a table of the reasons of a verdict with their remedies, without those that its sentence tells wholly."""
    rows = [[worded(one.what), one.change] for one in verdict.reasons if one.change or one.what not in verdict.sentence]
    return [Table("Reasons", ("reason", "remedy"), rows, left=(0, 1), stacked=True)] if rows else []


Block: TypeAlias = Words | Notes | Table | Image
Card: TypeAlias = tuple[str, str]  # a figure and its label


def data_uri(data: bytes, media_type: str) -> str:
    """Return a file's content as data URI, so that the page needs no other file."""
    return f"data:{media_type};base64,{base64.b64encode(data).decode('ascii')}"
