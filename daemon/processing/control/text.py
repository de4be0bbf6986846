"""Read control from text: any separator, decimal points or commas, named columns or none.

Separator and decimal sign are those by which most lines have three numbers. A header may follow lines of a title, as
in reports; without a header the columns are name, two coordinates, height, or what the user says.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from swath.daemon.processing.control.columns import WANTED, Column, Role, column_of, fault_of, pair_of
from swath.daemon.processing.control.table import (
    HEADER,
    ControlTable,
    Mistakes,
    degrees_of,
    error_of,
    number_of,
    table_of,
)

LOOKED_AT = 200  # lines by which separator and decimal sign are found
TITLE_LINES = 40  # at most, before a header
FEWEST_NUMBERS = 3
SEPARATORS = {";": "semicolons", "\t": "tabs", ",": "commas", " ": "blanks"}

Row = tuple[int, list[str]]  # line number, fields


@dataclass(frozen=True, slots=True)
class Layout:
    """Describes how lines are divided and numbers are written."""

    separator: str
    decimal_comma: bool

    def fields(self, line: str) -> list[str]:
        """Return the fields of a line, numbers with a decimal point."""
        if self.separator == " " and '"' not in line:
            found = line.split()
        else:
            found = next(csv.reader([line], delimiter=self.separator, skipinitialspace=True), [])
        return [self._plain(field.strip()) for field in found]

    def _plain(self, field: str) -> str:
        if self.decimal_comma:
            pointed = field.replace(",", ".")
            return pointed if field.count(",") == 1 and _is_number(pointed) else field
        return field


def read_text(text: str, path: Path, given: Sequence[Column] | None = None) -> ControlTable:
    """Read the points of a text file.

    Args:
        text: of the file; lines that are empty or begin with # are ignored.
        path: the file, for messages.
        given: columns as the user says; None: by the header, or else as is usual.

    Raises:
        ControlError: one line for each of the first mistakes.
    """
    lines = [(number, line.strip("\r\n ")) for number, line in enumerate(text.lstrip("\ufeff").splitlines(), start=1)]
    lines = [(number, line) for number, line in lines if line.strip() and not line.lstrip().startswith("#")]
    if not lines:
        raise error_of(path, [f"the file is empty; it needs one line for each point, after a header such as {HEADER}"])
    layout = _layout([line for _, line in lines])
    try:
        rows = [(number, layout.fields(line)) for number, line in lines]
    except csv.Error as error:
        raise error_of(path, [f"is not a table of text: {error}; export it as CSV"]) from error
    _refuse_commas(path, layout, rows)
    header, columns, body, notes = _columns(path, rows, given)
    if not body:
        raise error_of(path, [f"line {header}: no points follow the header; add one line for each point"])
    width = _width(path, rows, header, columns, body, layout)
    placed = [(f"line {number}", fields[:width]) for number, fields in body]
    is_named = given is not None or header is not None
    return table_of(path, columns, placed, is_named=is_named, notes=notes)


def _is_number(text: str) -> bool:
    """Return whether a text is a number, or an angle with its signs: "N1" is a name."""
    angle = ("°" in text or ":" in text) and not math.isnan(degrees_of(text))
    return angle or not math.isnan(number_of(text))


def _layout(lines: Sequence[str]) -> Layout:
    """Return the layout by which most lines have three numbers; the first of several equal ones."""
    best, most = Layout(",", False), 0
    for separator in SEPARATORS:
        for decimal_comma in (False, True) if separator != "," else (False,):
            layout = Layout(separator, decimal_comma)
            found = sum(_numbers(layout, line) >= FEWEST_NUMBERS for line in lines[:LOOKED_AT])
            if found > most:
                best, most = layout, found
    return best


def _numbers(layout: Layout, line: str) -> int:
    try:
        return sum(map(_is_number, layout.fields(line)))
    except csv.Error:
        return 0


def _refuse_commas(path: Path, layout: Layout, rows: Sequence[Row]) -> None:
    """Refuse decimal commas between commas, which nobody can tell apart."""
    if layout.separator != ",":
        return
    fields = rows[-1][1]
    numbers = [field for field in fields if _is_number(field)]
    if len(numbers) >= 2 * FEWEST_NUMBERS and not any("." in number for number in numbers):
        text = "commas are both separators and decimal signs; separate the columns by semicolons or tabs"
        raise error_of(path, [f"line {rows[-1][0]}: {text}"])


def _columns(
    path: Path, rows: Sequence[Row], given: Sequence[Column] | None
) -> tuple[int | None, tuple[Column, ...], list[Row], tuple[str, ...]]:
    """Return the header's line (None: there is none), the columns, the rows of points, and notes."""
    if given is not None:
        pair = pair_of(given)
        assert pair is not None
        first = next((at for at, (_, fields) in enumerate(rows) if _has_numbers(fields, pair)), 0)
        return (rows[first - 1][0] if first else None), tuple(given), list(rows[first:]), ()
    for at, (number, fields) in enumerate(rows[:TITLE_LINES]):
        columns = [column_of(place, label) for place, label in enumerate(fields)]
        if pair_of(columns) is not None:
            if fault := fault_of(columns):
                raise error_of(path, [f"line {number}: {fault}"])
            known = tuple(column for column in columns if column.role is not Role.IGNORED)
            left_out = [column.label for column in columns if column.role is Role.IGNORED and column.label]
            notes = (f"columns that are not used: {', '.join(left_out)}",) if left_out else ()
            return number, known, list(rows[at + 1 :]), notes
        if sum(map(_is_number, fields)) >= FEWEST_NUMBERS:
            break
    number, fields = rows[0]
    if sum(map(_is_number, fields)) < FEWEST_NUMBERS:
        columns = [column_of(place, label) for place, label in enumerate(fields)]
        raise error_of(path, [f"line {number}: {fault_of(columns)}; or say them with --control-columns"])
    return None, _usual(path, rows[0]), list(rows), ()


def _has_numbers(fields: Sequence[str], pair: tuple[Column, Column]) -> bool:
    return all(column.at < len(fields) and _is_number(fields[column.at]) for column in pair)


def _usual(path: Path, row: Row) -> tuple[Column, ...]:
    """Return the columns of a file without a header: name, two coordinates, height, each the next that is a number."""
    number, fields = row
    numeric = [at for at, field in enumerate(fields) if _is_number(field)]
    has_name = 0 not in numeric or (len(numeric) > FEWEST_NUMBERS and "." not in fields[0])
    if has_name:
        numeric = [at for at in numeric if at > 0]
    if len(numeric) < FEWEST_NUMBERS:
        raise error_of(path, [f"line {number}: too few numbers; the columns are {WANTED}"])
    if all(abs(degrees_of(fields[at])) <= 360.0 for at in numeric[:2]):
        text = "no header tells which column is the latitude; say the columns with --control-columns name,lat,lon,h"
        raise error_of(path, [f"line {number}: {text}"])
    names = [Column(0, "column 1", Role.NAME)] if has_name else []
    roles = (Role.X, Role.Y, Role.HEIGHT)
    return (
        *names,
        *(Column(at, f"column {at + 1}", role) for at, role in zip(numeric[:FEWEST_NUMBERS], roles, strict=True)),
    )


def _width(
    path: Path,
    rows: Sequence[Row],
    header: int | None,
    columns: Sequence[Column],
    body: Sequence[Row],
    layout: Layout,
) -> int:
    """Return the number of fields of a row; refuse rows with too few, or with more than the header names."""
    labels = next((fields for number, fields in rows if number == header), None)
    fewest = max(column.at for column in columns) + 1
    most = max(len(labels), fewest) if labels is not None else math.inf
    mistakes = Mistakes(path)
    for number, fields in body:
        if fewest <= len(fields) <= most or (len(fields) > most and not any(fields[int(most) :])):
            continue
        wanted = len(labels) if labels is not None else fewest
        named = f": {','.join(labels)}" if labels is not None else f", separated by {SEPARATORS[layout.separator]}"
        mistakes.add(f"line {number}", f"{len(fields)} fields instead of {wanted}{named}")
    mistakes.refuse()
    return max(len(fields) for _, fields in body) if labels is None else int(most)
