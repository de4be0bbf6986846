"""Tests that classes end at round numbers that follow from the requirements."""

from __future__ import annotations

import pytest

from swath.calib.strips.standards import QUALITY_LEVELS
from swath.daemon.processing.pages.classes import (
    DZ_LIMITS_M,
    SIGNED_COLOURS,
    SIZE_COLOURS,
    around_required,
    class_number,
    limits_for,
    size_words,
)


def test_classes_of_differences_end_at_the_limits_of_quality_levels() -> None:
    assert {level.overlap_m for level in QUALITY_LEVELS} <= set(DZ_LIMITS_M)
    assert DZ_LIMITS_M == (0.02, 0.04, 0.08, 0.16, 0.32, 0.64)
    assert len(SIZE_COLOURS) == len(DZ_LIMITS_M) + 1
    assert len(SIGNED_COLOURS) == 9


def test_words_name_spans_units_and_levels() -> None:
    assert size_words(limits_for(0.01)) == [
        "≤ 2 cm",
        "2–4 cm (QL0)",
        "4–8 cm (QL1, QL2)",
        "8–16 cm (QL3)",
        "> 16 cm",
    ]


@pytest.mark.parametrize(("inside_m", "last_m"), [(0.001, 0.16), (0.159, 0.16), (0.2, 0.32), (0.5, 0.64), (9.0, 0.64)])
def test_there_are_as_many_classes_as_the_differences_need(inside_m: float, last_m: float) -> None:
    assert limits_for(inside_m)[-1] == last_m


@pytest.mark.parametrize(
    ("required_m", "limits_m"),
    [(0.045, (0.02, 0.04, 0.08)), (0.1, (0.05, 0.1, 0.2)), (0.033, (0.015, 0.03, 0.06)), (2.0, (1.0, 2.0, 4.0))],
)
def test_classes_around_a_required_accuracy_are_round(required_m: float, limits_m: tuple[float, ...]) -> None:
    assert around_required(required_m) == limits_m


def test_a_value_at_a_limit_keeps_it() -> None:
    assert [class_number(value, (0.02, 0.04)) for value in (0.02, 0.0201, 0.05)] == [0, 1, 2]
