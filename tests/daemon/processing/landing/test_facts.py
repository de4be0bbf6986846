"""Tests what the verdict before landing takes from the log, and what it says where that is not enough."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from matplotlib.path import Path as Outline

from swath.daemon.config.tables import PlanWantedConfig
from swath.daemon.processing.flightplan.overlap import Pair
from swath.daemon.processing.landing.checks import (
    base_check,
    calibration_check,
    density_check,
    log_check,
    overlap_check,
    sentence,
    static_check,
)
from swath.daemon.processing.landing.facts import LogFacts
from swath.daemon.processing.landing.gaps import Ground, gaps_of, inside
from swath.daemon.processing.landing.tracks import FlownPairs, Track, pairs_of, tracks_of
from swath.georef.records import FixType, GnssFix, TimeScale, TimeTag
from tests.daemon.processing.flightplan.builders import HEIGHT_M, flown, moments_of, parallel

S = 10**9
STATUS = {"units": 10, "written": 10, "lost_kernel": 0, "lost_queue": 0, "lost_write": 0, "state": "receiving"}
LINES: dict[str, Any] = {"plan": "p", "lines": []}


def fix_at(time_s: float, speed_mps: float | None, east_m: float = 0.0) -> GnssFix:
    velocity = None if speed_mps is None else (0.0, speed_mps, 0.0)
    lon = 0.15 + east_m / 6_378_137.0 / math.cos(0.8)
    return GnssFix(round(time_s * S), TimeTag(TimeScale.GPS, 0), 0.8, lon, 400.0, velocity, fix_type=FixType.RTK_FIXED)


@pytest.mark.parametrize("told", [True, False])
def test_standing_still_is_counted_before_the_take_off_and_after_the_landing(told: bool) -> None:
    """90 s still, 30 s taxiing at 8 m/s, 60 s at 50 m/s, 20 s at 5 m/s, 70 s still; with and without velocities."""
    facts, east_m = LogFacts(0), 0.0
    speeds = [0.0] * 90 + [8.0] * 30 + [50.0] * 60 + [5.0] * 20 + [0.0] * 70
    said = []
    for second, speed_mps in enumerate(speeds):
        east_m += speed_mps
        facts.fix("gnss/rover", fix_at(second, speed_mps if told else None, east_m))
        if second in (50, 179, 240, 269):
            said.append(static_check(facts, 60.0))
    assert [one.state for one in said] == ["open", "open", "open", "good"]
    assert "the aircraft has not flown yet" in said[0].text
    assert "after landing stand still for 60 s" in said[1].text
    standing = facts.standing["gnss/rover"]
    assert (standing.before_s, standing.after_s) == pytest.approx((89.0, 69.0), abs=1.0 if told else 11.0)
    assert static_check(facts, 100.0).state == "remark"
    assert "s before take-off, less than 100 s; after landing stand still" in static_check(facts, 100.0).text
    facts.has_ended = True
    assert static_check(facts, 100.0).text.endswith("after landing, less than 100 s")
    assert (static_check(facts, 0.0).state, static_check(LogFacts(0), 60.0).state) == ("good", "unknown")


def test_corrections_are_judged_by_how_much_of_the_flight_they_cover() -> None:
    facts = LogFacts(0)
    facts.units("imu/main", np.arange(0, 1000, 10) * S)
    assert base_check(facts, []).state == "unknown"
    assert base_check(facts, ["base"]).state == "remark"  # configured, and nothing came
    facts.units("corrections/base", np.arange(0, 1000, 5) * S)
    assert base_check(facts, ["base"]).state == "good"
    holed = LogFacts(0)
    holed.units("imu/main", np.arange(0, 1000, 10) * S)
    holed.units("corrections/base", np.arange(100, 500, 5) * S)
    holed.units("corrections/base", np.arange(700, 1000, 5) * S)
    found = base_check(holed, ["base"])
    assert found.state == "remark"
    # of 990 s, the first 100 s and 205 s in the middle are missing
    assert found.text.startswith("base: corrections during 69 % of the flight, longest pause 205 s")


def test_the_log_is_complete_only_where_every_unit_is_known() -> None:
    facts = LogFacts(0)
    facts.units("scanner/left", np.array([S]))
    assert log_check(facts, {}).state == "unknown"  # no account of units
    facts.status("scanner/left", S, STATUS)
    assert log_check(facts, {"part": 1}).text == "2 parts; every unit written"
    facts.status("scanner/left", 2 * S, STATUS | {"lost_queue": 3, "written": 7})
    lost = log_check(facts, {})
    assert (lost.state, lost.text) == ("remark", "units lost: scanner/left 3")
    facts.status("scanner/left", 3 * S, STATUS | {"written": 9})
    assert "units not accounted for: scanner/left 1" in log_check(facts, {}).text
    facts.status("scanner/left", 4 * S, STATUS)
    facts.event(4 * S, {"code": "disk_full", "severity": "error", "source": "recorder", "text": "no space"})
    assert log_check(facts, {}).details == ("recorder disk_full: no space",)
    silent = LogFacts(0)
    silent.status("imu/main", 0, STATUS | {"state": "silent", "last_unit_age_s": 9.0})
    assert log_check(silent, {}).details == ("now: imu/main silent for 9 s",)


def test_what_was_recorded_before_live_began_is_not_judged() -> None:
    late = LogFacts(0)
    late.units("imu/main", np.array([60 * S]))
    late.status("imu/main", 60 * S, STATUS)
    assert log_check(late, {}).state == "unknown"
    assert "began 60 s or more after the recording" in log_check(late, {}).text
    missed = LogFacts(0)  # what is still in memory is read from the beginning, without scanners
    missed.status("scanner/left", 5 * S, STATUS)
    missed.units("scanner/left", np.array([25 * S]))
    assert missed.late_ns == 20 * S
    missed.fix("gnss/rover", fix_at(0, 50.0))
    assert static_check(missed, 60.0).text.startswith("before take-off not known")


def test_a_mark_asks_for_the_verdict() -> None:
    facts = LogFacts(0)
    facts.event(5, {"code": "mark", "text": "line 4 start"})
    assert facts.marked_ns is None
    facts.event(6, {"code": "mark", "text": "Landing: You can go home"})
    assert facts.marked_ns == 6


def test_pairs_of_strips_are_found_in_the_truth_of_a_flight() -> None:
    """Two lines to and fro at one place, one across, and one along at twice the height above ground."""
    lines = parallel(2, 30.0)
    high = lines[0] | {"name": "3", "height_m": HEIGHT_M + 600.0}
    cross = lines[0] | {"name": "4", "from_m": [0.0, -600.0], "to_m": [0.0, 600.0]}
    away = lines[0] | {"name": "5", "from_m": [-600.0, 3000.0], "to_m": [600.0, 3000.0]}
    flight = flown([*lines, high, cross, away], [], {}, turbulence="none")
    tracks = tracks_of(moments_of(flight)[::10])
    assert [round(one.above_m / 600.0) for one in tracks] == [1, 1, 2, 1, 1]
    assert [one.length_m for one in tracks] == pytest.approx([1200.0] * 5, abs=180.0)
    assert pairs_of(tracks) == FlownPairs(5, opposite=2, crossing=3, heights=3)  # 2 and 3 are opposite too
    assert pairs_of([tracks[0], tracks[4]]) == FlownPairs(2)
    unknown = [replace(one, above_m=math.nan) for one in tracks]
    assert pairs_of(unknown).heights == 0
    assert isinstance(tracks[0], Track)


def test_calibration_lines_matter_where_the_calibration_is_not_good() -> None:
    nominal = {"level": "not to be used", "reasons": [{"level": "not to be used", "what": "left is nominal"}]}
    assert calibration_check(FlownPairs(), {"level": "good", "reasons": []}).state == "good"
    lacking = calibration_check(FlownPairs(3, 1, 0, 1), nominal)
    assert (lacking.state, lacking.details) == ("remark", ("left is nominal",))
    assert lacking.text.startswith("opposite lines flown, crossing lines not flown, two heights flown")


def test_nothing_is_good_that_was_not_asked_for_or_not_measured() -> None:
    wanted = PlanWantedConfig()
    assert density_check(LINES, wanted, None).state == "unknown"
    assert overlap_check(LINES, wanted, {"cells": 0}).state == "unknown"
    asked = PlanWantedConfig(overlap_percent=20.0)
    assert overlap_check(LINES, asked, {"cells": 9, "rms_m": 0.03}).state == "good"
    assert overlap_check(LINES, asked, {"cells": 9, "rms_m": 0.12}).state == "remark"
    pairs = [Pair(str(n), str(n + 1), 0.3 - 0.01 * n) for n in range(22)]
    lacking = overlap_check(LINES, asked, {"cells": 9, "rms_m": 0.03}, pairs)
    assert (lacking.state, lacking.text.split(";")[0]) == ("remark", "less than 20 % of 11 pairs of lines")
    assert lacking.details[0] == "lines 21 and 22: least overlap 9 %, wanted 20 %"
    assert lacking.details[20:] == ("2 pairs of lines more: at least 29 %, wanted 20 %",)
    assert overlap_check(LINES, wanted, {"cells": 0}, pairs[:1]).details == ("lines 0 and 1: least overlap 30 %",)
    assert overlap_check(LINES | {"plan": None}, asked, {"cells": 9, "rms_m": 0.03}).state == "unknown"
    assert sentence(LINES, [], None) == ("wait", "Nothing has been flown yet")
    flying = LINES | {"lines": [{"name": "4", "state": "flying"}]}
    assert sentence(flying, [], None) == ("wait", "Wait: line 4 is being flown")


def test_cells_inside_an_area_are_those_of_another_library() -> None:
    """Against Matplotlib's, for a star with a hole."""
    angle = np.linspace(0.0, 2.0 * np.pi, 11)[:-1]
    star = 40.3 * np.stack([np.cos(angle), np.sin(angle)], axis=-1) * np.where(np.arange(10) % 2, 0.4, 1.0)[:, None]
    hole = 8.7 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    none = np.zeros((96, 104), np.bool_)
    ground = Ground(-50.0, -50.0, 1.0, none, none, 8, np.zeros((12, 13)))
    rows, columns = np.indices(ground.covered.shape)
    centres = ground.centres_m(rows.ravel(), columns.ravel())
    expected = Outline(star).contains_points(centres) & ~Outline(hole).contains_points(centres)
    found = inside(ground, [[star, hole]])
    assert expected.sum() > 500
    assert (found.ravel() == expected).all()
    (gap,) = gaps_of(ground, found, 10.0)
    assert gap.area_m2 == found.sum()
    assert Outline(star).contains_points(gap.place_m[np.newaxis])[0]
