"""Tests faults on demand: the effect of each on a source's units, and refusals of contradictory ones."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from swath.sim.faults import check_faults, windows, with_faults
from swath.sim.plan.errors import PlanError
from swath.sim.plan.plan import Plan, parse_plan
from swath.sim.shots import WireUnit

PLAN = """
[flight]
name = "faulty"
[[line]]
name = "1"
from_m = [0, 0]
to_m = [1000, 0]
height_m = 1000
"""


def plan(*faults: dict[str, Any]) -> Plan:
    """Return a plan with these faults."""
    return parse_plan(PLAN, Path()).changed({"fault": list(faults)})


def units(source: str = "scanner/left", count: int = 1000) -> list[WireUnit]:
    """Return a unit for each hundredth of a second, all different."""
    return [WireUnit(number / 100, source, number.to_bytes(4, "little") * 4) for number in range(count)]


def flown(*faults: dict[str, Any], source: str = "scanner/left") -> list[WireUnit]:
    """Return the units that remain."""
    return list(with_faults(plan(*faults), iter(units(source))))


def test_units_of_other_sources_are_unchanged() -> None:
    assert flown({"source": "imu/main", "kind": "silent", "at_s": 0, "for_s": 100}) == units()


@pytest.mark.parametrize("kind", ["silent", "unplugged"])
def test_a_silent_source_sends_nothing_in_its_window(kind: str) -> None:
    left = flown({"source": "scanner/left", "kind": kind, "at_s": 2, "for_s": 3})
    assert left == [unit for unit in units() if not 2 <= unit.time_s < 5]


def test_the_given_share_of_units_is_affected() -> None:
    left = flown({"source": "scanner/left", "kind": "silent", "at_s": 0, "for_s": 10, "share": 0.3})
    assert 640 < len(left) < 760  # binomial of 1000 with 0.7: four sigma


def test_a_fault_without_duration_affects_one_unit() -> None:
    left = flown({"source": "scanner/left", "kind": "silent", "at_s": 2.001})
    assert [unit for unit in units() if unit not in left] == [units()[201]]


def test_late_units_arrive_after_later_ones() -> None:
    late = flown({"source": "scanner/left", "kind": "late", "at_s": 2, "for_s": 1, "delay_s": 0.255})
    assert Counter(unit.data for unit in late) == Counter(unit.data for unit in units())
    assert [unit.time_s for unit in late] == sorted(unit.time_s for unit in late)
    moved = {unit.data: unit.time_s for unit in late}
    for unit in units():
        delay_s = 0.255 if 2 <= unit.time_s < 3 else 0.0
        assert moved[unit.data] == pytest.approx(unit.time_s + delay_s)


def test_corrupted_units_differ_in_one_byte() -> None:
    left = flown({"source": "scanner/left", "kind": "corrupted", "at_s": 2, "for_s": 1})
    differing = [
        sum(a != b for a, b in zip(one.data, two.data, strict=True)) for one, two in zip(left, units(), strict=True)
    ]
    assert differing == [1 if 200 <= number < 300 else 0 for number in range(1000)]


def test_duplicated_units_come_twice() -> None:
    left = flown({"source": "scanner/left", "kind": "duplicated", "at_s": 2, "for_s": 1})
    counts = Counter(unit.data for unit in left)
    assert [counts[unit.data] for unit in units()] == [2 if 200 <= number < 300 else 1 for number in range(1000)]


def test_reordered_units_change_places() -> None:
    left = flown({"source": "scanner/left", "kind": "reordered", "at_s": 2, "for_s": 0.05})
    assert [unit.time_s for unit in left] == [unit.time_s for unit in units()]
    expected = [unit.data for unit in units()]
    for at in (200, 202, 204):
        expected[at], expected[at + 1] = expected[at + 1], expected[at]
    assert [unit.data for unit in left] == expected


def edges(*faults: dict[str, Any]) -> list[float]:
    """Return times of ten edges."""
    pulses = (WireUnit(float(second), "pps/main", b"") for second in range(10))
    return [unit.time_s for unit in with_faults(plan(*faults), pulses)]


def test_lost_edges_do_not_reach_the_host() -> None:
    assert edges({"source": "pps/main", "kind": "pps_lost", "at_s": 2.5, "for_s": 3}) == [0, 1, 2, 6, 7, 8, 9]


def test_a_device_that_loses_its_edges_still_sends() -> None:
    fault = {"source": "scanner/left", "kind": "pps_lost", "at_s": 2, "for_s": 3}
    assert flown(fault) == units()
    assert windows(plan(fault).tables, "scanner/left", "pps_lost") == [(2, 5)]


def test_spurious_edges_stand_between_the_true_ones() -> None:
    times = edges({"source": "pps/main", "kind": "pps_spurious", "at_s": 3, "for_s": 2})
    assert [time for time in times if time == int(time)] == list(range(10))
    extra = [time for time in times if time != int(time)]
    assert [int(time) for time in extra] == [3, 4]
    assert all(0.05 <= time % 1 <= 0.95 for time in extra)
    assert times == sorted(times)


def test_faults_of_one_source_are_applied_in_their_order() -> None:
    silent = {"source": "scanner/left", "kind": "silent", "at_s": 2, "for_s": 3}
    twice = {"source": "scanner/left", "kind": "duplicated", "at_s": 4, "for_s": 3}
    assert len(flown(silent, twice)) == 1000 - 300 + 200


def bad() -> Iterator[tuple[dict[str, Any], str]]:
    """Yield contradictory faults, and the error of each."""
    yield (
        {"source": "scanner/right", "kind": "silent", "at_s": 0},
        r'fault\[0\].source: the plan has no "scanner/right"',
    )
    yield {"source": "imu/main", "kind": "clock_step", "at_s": 0}, r"fault\[0\].source: .* clock_step is of"
    yield {"source": "host", "kind": "silent", "at_s": 0}, r"fault\[0\].source"
    yield {"source": "gnss/rover", "kind": "pps_spurious", "at_s": 0}, "spurious edges are of a pps"
    yield {"source": "gnss/rover", "kind": "pps_lost", "at_s": 0}, "the receiver makes the edges"


@pytest.mark.parametrize(("fault", "words"), list(bad()))
def test_impossible_faults_are_refused(fault: dict[str, Any], words: str) -> None:
    with pytest.raises(PlanError, match=words):
        check_faults(plan(fault).tables)


def test_error_for_an_unknown_fault_names_its_key() -> None:
    with pytest.raises(PlanError, match=r"^fault\[0\]\.kind: got 'gremlins', want 'silent', "):
        plan({"source": "scanner/left", "kind": "gremlins", "at_s": 0})
