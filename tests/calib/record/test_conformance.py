"""Tests that the record's page on conformance names existing attributes and tests, and is true."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

import pytest

from swath.calib.record.dictionary import BY_KEY, LIDAR, OPTICAL, ROWS
from swath.calib.record.record import Record, RecordInput, record_of
from tests.calib.made_outcome import made_outcome

pytestmark = pytest.mark.xdist_group("kernels")

ROOT = Path(__file__).resolve().parents[3]
PAGE = (ROOT / "docs/calibration-record.md").read_text()
TESTS = "tests/calib/record/test_record.py"
UNLESS_TOLD = {"CA_Intensity.intensityCorrection"}  # the flight at hand has no such table


def section(title: str) -> str:
    """Return the text below a heading."""
    return PAGE.split(f"\n## {title}\n", 1)[1].split("\n## ", 1)[0]


def table(title: str, columns: int) -> list[list[str]]:
    """Return the rows of a section's table, as cells."""
    rows = [line.split("|")[1:-1] for line in section(title).splitlines() if line.startswith("| ")]
    assert all(len(row) == columns for row in rows), [row for row in rows if len(row) != columns]
    return [[cell.strip() for cell in row] for row in rows[1:]]


LASER = table("Conformance, ISO/TS 19159-2", 5)
CAMERA = table("Conformance, ISO/TS 19159-1, clause 7", 4)


def keys(owner: str, cell: str) -> set[str]:
    """Return ``CLASS.attribute`` for the words of a cell: each first word between commas, without brackets."""
    words = re.sub(r"\([^)]*\)", "", cell).split(",")
    return {f"{owner.split()[0].rstrip(':')}.{word.split()[0]}" for word in words if word.strip()}


@cache
def functions(path: str) -> frozenset[str]:
    """Return the names of the tests of a file."""
    nodes = ast.walk(ast.parse((ROOT / path).read_text()))
    return frozenset(node.name for node in nodes if isinstance(node, ast.FunctionDef) and node.name.startswith("test_"))


@pytest.fixture(scope="module")
def record() -> Record:
    """Return the record of a calibration without facts given by the user."""
    outcome = made_outcome(40_000)
    settings = {"Swath": "0.1.0"}
    return record_of(
        RecordInput(outcome.flight, outcome.features, outcome.adjusted, "left", outcome.header, settings=settings)
    )


@pytest.mark.parametrize("row", [*LASER, *CAMERA], ids=lambda row: row[0].split(":")[0])
def test_every_row_names_existing_tests(row: list[str]) -> None:
    words = re.findall(r"`([^`]+)`", row[3])
    assert words
    for word in words:
        if word.startswith("tests/"):
            assert functions(word), word
        else:
            assert word in functions(TESTS), word


def test_every_other_name_on_the_page_exists() -> None:
    for path in re.findall(r"`(tests/[^`]+)`", PAGE):
        assert (ROOT / path).is_file(), path
    for name in re.findall(r"`(test_\w+)`", PAGE):
        assert name in functions(TESTS), name


def test_the_tables_list_every_attribute_of_the_dictionary_once() -> None:
    """Attributes of validation are in both tables, because both parts of the standard have them."""
    named = [key for row in LASER for key in sorted(keys(row[0], row[1]))]
    also = [key for row in CAMERA for cell in row[1:3] for key in sorted(keys(row[0], cell))]
    for known in (named, also):
        assert len(known) == len(set(known))
        assert set(known) <= BY_KEY.keys()
    assert set(named) | set(also) == BY_KEY.keys()
    assert {row.key for row in ROWS if row.standard == LIDAR} <= set(named)
    both = {"CA_CalibrationValidation", "CA_GeometryValidation"}
    assert {row.key for row in ROWS if row.standard == OPTICAL and row.owner not in both} <= set(also)


def test_attributes_declared_as_present_are_in_the_record(record: Record) -> None:
    for owner, items, where, _, _ in LASER:
        for key in keys(owner, items) - UNLESS_TOLD:
            assert (key in record.missing) == where.startswith("missing"), key
            assert (key in record.values) != where.startswith("missing"), key
    for owner, there, told, _ in CAMERA:
        assert keys(owner, there) <= record.values.keys()
        for key in keys(owner, told):
            assert key not in record.values, key
            assert (key in record.missing) == (BY_KEY[key].obligation == "M"), key


def test_attributes_declared_as_unconfirmed_are_unconfirmed(record: Record) -> None:
    for owner, items, _, _, state in LASER:
        for key in keys(owner, items):
            assert BY_KEY[key].confirmed != ("not confirmed" in state or "no attribute's name is confirmed" in state)
