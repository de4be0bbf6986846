"""Tests the verdict before landing against the truth of virtual flights with injected defects."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from tests.daemon.processing.flightplan.builders import (
    DENSITY,
    HALF_ANGLE_RAD,
    KINDS,
    WIDTH_M,
    Defect,
    Flight,
    drawn,
    flown,
    is_grave,
    moments_of,
    parallel,
)
from tests.daemon.processing.landing.builders import CELL_M, places_of, verdict_of, with_area

LENGTH_M, SPACING_M = 1800.0, 0.7 * WIDTH_M


def check(found: dict[str, Any], code: str) -> dict[str, Any]:
    (one,) = [each for each in found["checks"] if each["code"] == code]
    return dict(one)


def states(found: dict[str, Any]) -> dict[str, str]:
    return {one["code"]: one["state"] for one in found["checks"]}


@pytest.mark.parametrize("tells_water", [False, True])
def test_gaps_in_the_area_have_the_size_and_the_line_of_the_truth(tells_water: bool) -> None:
    """Line 1's scanner is silent for 5 s in the east, line 2 flies over a lake in the west, line 4 is not flown.

    The sizes follow from the geometry alone: 30° to either side at 600 m, 30 % overlap, 60 m/s. A scanner that tells
    its pulses without an echo makes the lake water, and no gap.
    """
    lines = parallel(4, SPACING_M, LENGTH_M)
    defects = [Defect("1", "silent", 0.75, 5.0), Defect("2", "water", 0.75, 5.0)]
    flight = flown(lines, defects, {"density_per_m2": 0.8 * DENSITY}, lines[:3], turbulence="none")
    places = places_of(flight)
    # from 200 m south of line 1 to 500 m north of line 3: line 1's neighbour covers what is 484 m away and more
    north_m = 2 * SPACING_M + 500.0
    corners = np.array([[100.0, -200.0], [LENGTH_M - 100.0, -200.0], [LENGTH_M - 100.0, north_m], [100.0, north_m]])
    found = verdict_of(flight, moments_of(flight), with_area(flight.plan, places, corners), tells_water=tells_water)
    assert found["sentence"] == "Fly again: line 1. Not flown: line 4"
    assert (found["state"], states(found)["gaps"]) == ("again", "again")
    half_m = 600.0 * math.tan(HALF_ANGLE_RAD)
    silent_m2 = 300.0 * (200.0 + SPACING_M - half_m)
    water_m2 = 300.0 * 2.0 * (SPACING_M - half_m)
    beyond_m2 = (LENGTH_M - 200.0) * (500.0 - half_m)
    gaps = {(gap["line"], tuple(gap["under"])): gap for gap in found["area"]["gaps"]}
    assert len(found["area"]["gaps"]) == 2 + (not tells_water)
    if tells_water:
        (gaps["2", ("2",)],) = found["area"]["waters"]
        assert found["area"]["water_m2"] == pytest.approx(water_m2, rel=0.05)
        assert " ha without an echo, as over water; " in check(found, "gaps")["text"]
        assert check(found, "gaps")["details"][-1].startswith("water 1: ")
    # the lake's gap is seen in line 2's swath; line 4's lies beyond the reach of line 3
    for key, area_m2, width_m in (
        (("1", ()), silent_m2, 300.0),
        (("4", ()), beyond_m2, 500.0 - half_m),
        (("2", ("2",)), water_m2, 2.0 * (SPACING_M - half_m)),
    ):
        assert key in gaps, (key, list(gaps))
        assert gaps[key]["area_m2"] == pytest.approx(area_m2, rel=0.05), key
        assert gaps[key]["width_m"] == pytest.approx(width_m, abs=4 * CELL_M), key
    place = gaps["1", ()]
    assert place["east_m"] == pytest.approx(0.75 * LENGTH_M, abs=150.0)
    here = places.local_m(np.array([[place["lat_deg"], place["lon_deg"]]]))[0]
    assert here == pytest.approx([place["east_m"], place["north_m"]], abs=0.1)
    total_m2 = (LENGTH_M - 200.0) * (north_m + 200.0)
    assert found["area"]["wanted_m2"] == pytest.approx(total_m2, rel=0.01)
    assert found["area"]["wanted_m2"] - found["area"]["covered_m2"] == pytest.approx(
        silent_m2 + beyond_m2 + water_m2, rel=0.05
    )


def test_a_complete_flight_goes_home_and_says_what_is_not_known() -> None:
    flight = flown(
        parallel(3, SPACING_M), [], {"density_per_m2": 0.8 * DENSITY, "overlap_percent": 20.0}, turbulence="none"
    )
    corners = np.array([[10.0, -300.0], [1190.0, -300.0], [1190.0, 2 * SPACING_M + 300.0], [10.0, 2 * SPACING_M + 300]])
    found = verdict_of(flight, moments_of(flight), with_area(flight.plan, places_of(flight), corners))
    assert found["state"] == "home"
    assert found["sentence"] == "You can go home. Not known: base data, standing still, log"
    assert [code for code, state in states(found).items() if state == "good"] == [
        "lines", "gaps", "density", "overlap", "calibration",
    ]  # fmt: skip
    assert found["area"]["density_per_m2"]["p50"] == pytest.approx(DENSITY, rel=0.45)  # and overlaps are denser
    assert found["overlaps"]["wanted_percent"] == 20.0
    assert {tuple(pair["lines"]): pair["least_percent"] for pair in found["overlaps"]["pairs"]} == {
        ("1", "2"): pytest.approx(30.0, abs=1.0),
        ("2", "3"): pytest.approx(30.0, abs=1.0),
    }
    assert "lines 1 and 2: least overlap 30 %, wanted 20 %" in check(found, "overlap")["details"]


def test_without_an_area_nothing_says_that_all_is_covered() -> None:
    flight = flown(parallel(2, SPACING_M), [], {}, turbulence="none")
    found = verdict_of(flight, moments_of(flight))
    assert states(found)["gaps"] == "unknown"
    assert states(found)["density"] == "unknown"
    assert found["sentence"].startswith("You can go home. Not known: gaps, density, overlap, base data")
    apart = flown(parallel(2, WIDTH_M + 15.0), [], {}, turbulence="none")
    found = verdict_of(apart, moments_of(apart))
    assert found["sentence"] in ("Close gaps: 1, beside line 1", "Close gaps: 1, beside line 2")
    (gap,) = found["area"]["gaps"]
    assert gap["area_m2"] == pytest.approx(1200.0 * 15.0, rel=0.4)  # in cells of 4 m


def test_the_operator_s_word_counts() -> None:
    flight = flown(parallel(2, SPACING_M), [Defect("1", "off", 0.5, 30.0)], {}, turbulence="none")
    rows = moments_of(flight)
    assert verdict_of(flight, rows)["sentence"].startswith("Fly again: line 1")
    found = verdict_of(flight, rows, marks=("line 1: accepted, no one lives there", "line 2: again"))
    assert found["sentence"].startswith("Fly again: line 2")
    assert check(found, "lines")["details"][0].startswith("line 1: accepted by the operator, no one lives there; 30 m")
    assert check(found, "lines")["details"][1] == "line 2: operator: fly again"


def test_gaps_of_an_accepted_line_are_accepted_too() -> None:
    flight = flown(parallel(2, SPACING_M), [Defect("1", "silent", 0.5, 5.0)], {}, turbulence="none")
    corners = np.array([[10.0, -300.0], [1190.0, -300.0], [1190.0, SPACING_M + 300.0], [10.0, SPACING_M + 300.0]])
    rows, plan = moments_of(flight), with_area(flight.plan, places_of(flight), corners)
    assert verdict_of(flight, rows, plan)["sentence"] == "Fly again: line 1"
    found = verdict_of(flight, rows, plan, marks=("line 1: accepted, quarry",))
    assert (found["state"], states(found)["gaps"]) == ("home", "remark")
    assert found["sentence"].startswith("You can go home. With remarks: lines, gaps")


def test_what_live_has_not_seen_is_not_good() -> None:
    flight = flown(parallel(1, SPACING_M), [], {}, turbulence="none")
    found = verdict_of(flight, moments_of(flight), live_skipped_s=12.0, damaged_chunks=2)
    log = check(found, "log")
    assert log["state"] == "remark"
    assert "2 damaged chunks" in log["text"]
    assert "12 s were not looked at" in log["text"]


def expected_again(flight: Flight) -> list[str]:
    """Return the lines that a flight's defects make to be flown again, in the order of the plan."""
    grave = {one.line for one in flight.defects if is_grave(one)}
    return [line.name for line in flight.plan.lines if line.name in grave]


def told_and_expected(seed: int) -> tuple[str, str]:
    """Return the verdict's sentence on a drawn flight, and what its defects make it; the begin of it if all is well."""
    flight = drawn(np.random.default_rng(seed), list(KINDS), seed)
    told = verdict_of(flight, moments_of(flight))["sentence"]
    again = expected_again(flight)
    if not again:
        return told.split(". ")[0], "You can go home"
    return told, f"Fly again: line{'s' if len(again) > 1 else ''} {', '.join(again)}"


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 4])
def test_the_verdict_on_a_drawn_flight_is_that_of_its_defects(seed: int) -> None:
    told, expected = told_and_expected(seed)
    assert told == expected


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_verdict_on_fifty_flights_is_that_of_their_defects() -> None:
    wrong = [(seed, *both) for seed in range(50) if (both := told_and_expected(seed))[0] != both[1]]
    assert wrong == []
