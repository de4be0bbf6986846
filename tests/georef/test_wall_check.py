"""Tests a receiver's time against the computer's clock: time zones, old dates, and cases without a finding."""

from __future__ import annotations

import datetime as dt

import pytest

from swath.georef.records import NamesEdge, TimeMessage, TimeScale, TimeTag
from swath.georef.timescales import SECOND_NS, WallComparison, ahead_s, distance_text

CLOCK = "this computer's clock"
NOON_NS = int(dt.datetime(2026, 5, 10, 12, tzinfo=dt.UTC).timestamp()) * SECOND_NS
DAY_S = 86_400.0


@pytest.mark.parametrize(
    ("ahead", "kept", "said"),
    [
        (7199.8, True, "2 h ahead of"),
        (-7200.4, False, "2 h behind"),
        (19_800.0, False, "5.5 h ahead of"),
        (-3 * DAY_S - 0.3, False, "3 days behind"),
        (-DAY_S, True, "1 day behind"),
        (-1234.56 * DAY_S, True, "1,234.6 days behind"),
        (2220.0, True, "37 min ahead of"),
        (45.0, True, "45 s ahead of"),
    ],
)
def test_a_time_difference_is_described_in_words(ahead: float, kept: bool, said: str) -> None:
    text = distance_text(ahead, kept=kept, clock=CLOCK)
    assert f"its time is {said} {CLOCK}" in text
    assert ("time zone" in text) == (" h " in said)
    assert ("old date" in text) == ("day" in said)


@pytest.mark.parametrize(
    ("ahead", "kept"),
    [
        (0.4, True),
        (-18.0, True),  # leap seconds that the receiver does not yet know, which are judged with the edges' second
        (2220.0, False),
        (-1234.56 * DAY_S, False),
        (15 * 3600.0, False),  # no time zone is so far from UTC
    ],
)
def test_small_differences_and_unset_clocks_give_no_warning(ahead: float, kept: bool) -> None:
    assert distance_text(ahead, kept=kept, clock=CLOCK) == ""


@pytest.mark.parametrize(
    ("tag", "ahead"),
    [
        (TimeTag(TimeScale.UTC, 14 * 3600 * SECOND_NS, date=dt.date(2026, 5, 10)), 7200.0),
        (TimeTag(TimeScale.UTC, 14 * 3600 * SECOND_NS), 7200.0),  # as of GGA, without a date
        (TimeTag(TimeScale.UTC, 12 * 3600 * SECOND_NS, date=dt.date(2026, 5, 7)), -3 * DAY_S),
        # 2026-05-10 is a Sunday, the first day of GPS week 2418; GPS − UTC is 18 s
        (TimeTag(TimeScale.GPS, (12 * 3600 + 18) * SECOND_NS, week=2418), 0.0),
        (TimeTag(TimeScale.GPS, (12 * 3600 + 18) * SECOND_NS, week=2417), -7 * DAY_S),
    ],
)
def test_a_tag_is_compared_with_the_wall_clock(tag: TimeTag, ahead: float) -> None:
    assert ahead_s(tag, NOON_NS) == ahead


def heard(ahead: list[float], *, kept: bool, whole_log: bool, step_s: int = 0) -> WallComparison:
    """Compare the wall clock with one message a second.

    `ahead` says by how many seconds each message leads the clock; `step_s` by how much the clock was stepped.
    """
    comparison = WallComparison(CLOCK, whole_log=whole_log)
    comparison.set_wall(step_s * SECOND_NS, kept=kept)
    for second, seconds in enumerate(ahead):
        tag = TimeTag(TimeScale.UTC, round((12 * 3600 + second + seconds) * SECOND_NS), date=dt.date(2026, 5, 10))
        host_ns = NOON_NS + (second - step_s) * SECOND_NS
        comparison.hear("gnss/rover", TimeMessage(host_ns, tag, NamesEdge.PREVIOUS))
    return comparison


def test_the_whole_log_is_judged_by_the_majority_of_messages() -> None:
    """A receiver that finds its date after some seconds is right, though it looked wrong while it was recorded."""
    ahead = [7200.0] * 20 + [-0.2] * 200
    assert heard(ahead, kept=True, whole_log=True).lines() == []
    assert heard(ahead[:20], kept=True, whole_log=False).lines() != []


def test_few_or_contradicting_messages_give_no_warning() -> None:
    assert heard([7200.0] * 5, kept=True, whole_log=True).lines() == []
    assert heard([0.0, 3600.0, 7200.0] * 20, kept=True, whole_log=True).lines() == []


def test_a_clock_set_during_the_session_gives_no_warning() -> None:
    assert heard([0.0] * 20, kept=True, whole_log=True, step_s=-90_000).lines() == []
