"""Tests verdicts: limits, their levels, and the order of reasons."""

from __future__ import annotations

import math
from collections.abc import Iterator

import pytest

from swath.georef.verdicts import Level, Reason, Rule, worst_first


def measured(values: list[float | None]) -> Iterator[tuple[str, float | None]]:
    """Yield each value with its place in words."""
    for number, value in enumerate(values):
        yield f"place {number}", value


def levels(rule: Rule[list[float | None]], values: list[float | None]) -> list[tuple[Level, str]]:
    return [(reason.level, reason.what) for reason in rule.judged(values)]


def test_a_value_at_its_limit_is_good_and_one_above_it_is_not() -> None:
    rule = Rule("sigma", measured, 1.0, 3.0, "{of} has {value:.1f}", "fly again")
    assert levels(rule, [1.0, 1.5, None, 3.0, 4.0]) == [
        (Level.CARE, "place 1 has 1.5"),
        (Level.CARE, "place 3 has 3.0"),
        (Level.UNUSABLE, "place 4 has 4.0"),
    ]


def test_a_minimum_is_broken_by_values_below_it() -> None:
    rule = Rule("positions", measured, 60, 10, "{value:.0f}", "give more", least=True)
    assert levels(rule, [60.0, 59.0, 9.0]) == [(Level.CARE, "59"), (Level.UNUSABLE, "9")]
    assert [reason.excess for reason in rule.judged([30.0, 0.0])] == [2.0, math.inf]


def test_a_value_that_is_no_number_is_the_worst() -> None:
    rule = Rule("sigma", measured, 1.0, None, "{value}", "look at the log", lambda value: f"{value:g} m")
    (reason,) = rule.judged([math.nan])
    assert (reason.level, reason.what, reason.excess) == (Level.CARE, "nan m", math.inf)


def test_reasons_stand_by_level_and_then_by_excess() -> None:
    reasons = [
        Reason(Level.CARE, "a", "", "", 9.0),
        Reason(Level.UNUSABLE, "b", "", "", 1.1),
        Reason(Level.CARE, "c", "", "", math.inf),
    ]
    level, ordered = worst_first(reasons)
    assert level is Level.UNUSABLE
    assert [reason.name for reason in ordered] == ["b", "c", "a"]
    assert worst_first([]) == (Level.GOOD, ())


@pytest.mark.parametrize(
    ("level", "words", "heading"),
    [(Level.GOOD, "good", "Good"), (Level.UNUSABLE, "not to be used", "Not to be used")],
)
def test_levels_have_words_and_begin_a_sentence(level: Level, words: str, heading: str) -> None:
    assert (level.words, level.heading) == (words, heading)
