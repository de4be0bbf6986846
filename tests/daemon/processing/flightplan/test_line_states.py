"""Tests steering and the states of lines, fed by the virtual aircraft's truth with injected defects."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from pyproj import Geod

from swath.daemon.processing.flightplan.geometry import LineGeometry, Places
from swath.daemon.processing.flightplan.lines import parsed_overrule
from swath.daemon.processing.flightplan.moments import STEP_NS, Moments, empty_moments
from swath.daemon.processing.flightplan.watch import LineWatch
from swath.georef.arrays import FloatArray
from tests.daemon.processing.flightplan.builders import (
    DENSITY,
    KINDS,
    WIDTH_M,
    Defect,
    Flight,
    drawn,
    flown,
    is_grave,
    moments_of,
    parallel,
    watch,
)

GEOD = Geod(ellps="WGS84")


def states(flight: Flight, **options: Any) -> dict[str, tuple[str, dict[str, bool]]]:
    """Return the state of each line, and its reasons with whether they are grave."""
    plain = watch(flight, moments_of(flight), **options).plain()
    return {
        line["name"]: (line["state"], {reason["code"]: reason["grave"] for reason in line["reasons"]})
        for line in plain["lines"]
    }


SIZES = {
    "off": 30.0, "high": 80.0, "fast": 12.0, "bank": 24.0, "tilt": 14.0, "silent": 5.0, "late": 200.0, "early": 200.0,
    "gnss": 6.0, "time": 4.0, "holdover": 4.0, "sparse": 0.4, "lost": 3.0, "water": 4.0,
}  # fmt: skip


@pytest.mark.parametrize("kinds", [list(KINDS)[:7], list(KINDS)[7:]])
def test_each_defect_is_found_and_no_other(kinds: list[str]) -> None:
    """A line without a defect is flown last. Faster flight makes the points sparser too."""
    lines = parallel(8, 420.0, 1800.0)
    defects = [Defect(str(place + 1), kind, 0.6, SIZES[kind]) for place, kind in enumerate(kinds)]
    found = states(flown(lines, defects, {"density_per_m2": 0.85 * DENSITY, "speed_mps": 60.0}, seed=7))
    for defect in defects:
        code, grave = KINDS[defect.kind]
        allowed = {"density"} if defect.kind == "fast" else set()
        state, reasons = found[defect.line]
        assert reasons.get(code) is bool(grave), (defect, reasons)
        assert set(reasons) - {code} <= allowed, (defect, reasons)
        assert state == ("again" if any(reasons.values()) else "remarks")
    assert found["8"] == ("good", {})


def test_few_poses_and_many_at_once_give_the_same_states() -> None:
    """Live has two poses at a tick."""
    flight = flown(parallel(3, 500.0), [Defect("2", "silent", 0.5, 5.0)], {"overlap_percent": 20.0}, seed=2)
    rows = moments_of(flight)
    one, many = (watch(flight, rows, step=step).plain() for step in (3, 20))
    assert one == many
    assert [line["state"] for line in one["lines"]] == ["good", "again", "good"]
    (reason,) = one["lines"][1]["reasons"]
    assert reason["text"].startswith("no returns from ")
    assert reason["to_gps_ns"] - reason["from_gps_ns"] == pytest.approx(5e9, abs=5e8)
    assert reason["to_m"] - reason["from_m"] == pytest.approx(300.0, abs=25.0)


def test_a_line_is_judged_only_when_its_last_returns_have_come() -> None:
    """Line 2 ends 300 m early, which is said as soon as that is known: 3 s after the aircraft left it."""
    lines = parallel(3, 500.0)
    really = [lines[0], lines[1] | {"to_m": [-300.0, 500.0]}, lines[2]]
    flight = flown(lines, [], {"overlap_percent": 20.0}, really)
    shown: list[dict[str, Any]] = []
    last = watch(flight, moments_of(flight), step=3, seen=shown.append).plain()
    assert [line["state"] for line in last["lines"]] == ["good", "again", "good"]
    for place, (name, verdict) in enumerate({"1": "good", "2": "again", "3": "good"}.items()):
        states = [plain["lines"][place]["state"] for plain in shown]
        assert [one for one, before in zip(states, ["", *states], strict=False) if one != before] == [
            "planned", "flying", verdict
        ]  # fmt: skip
        left = max(at for at, plain in enumerate(shown) if plain["current"] == name)
        assert states[left:].index(verdict) * 3 * STEP_NS <= 4e9
        assert not any(
            reason["code"] == "early_end" for plain in shown[: left + 10] for reason in plain["lines"][place]["reasons"]
        )
        after = [plain["next"] for plain in shown[left + 1 :]]
        assert name not in (after[:10] if name == "2" else after)


def test_a_line_may_be_flown_again_and_in_pieces() -> None:
    """Line 1: first with a silent scanner, then well. Line 2: its east half, then its west half the other way."""
    lines = parallel(2, 600.0, 2000.0)
    halves = [lines[1] | {"to_m": [-50.0, 600.0]}, lines[1] | {"from_m": [-1000.0, 600.0], "to_m": [50.0, 600.0]}]
    again = lines[0] | {"name": "1 again", "from_m": lines[0]["to_m"], "to_m": lines[0]["from_m"]}
    flight = flown(lines, [Defect("1", "silent", 0.5, 6.0)], {}, [lines[0], *halves, again], seed=3)
    plain = watch(flight, moments_of(flight)).plain()
    assert [(line["state"], line["passes"], line["flown_fraction"]) for line in plain["lines"]] == [
        ("good", 2, 1.0)
    ] * 2
    half = flown(lines, [], {}, [lines[0], halves[0]], seed=3)
    watched = watch(half, moments_of(half))
    (reason,) = watched.plain()["lines"][1]["reasons"]
    assert (reason["code"], reason["grave"]) == ("early_end", True)
    assert reason["value"] == pytest.approx(950.0 - 60.0, abs=20.0)  # the laser goes on for a second
    assert watched.plain()["lines"][1]["flown_to_m"] == pytest.approx(1110.0, abs=20.0)


def test_overlap_is_the_fault_of_the_line_that_left_its_plan() -> None:
    """Swaths of 693 m: 30 % overlap is planned. Line 2 is flown 90 m to the north, away from line 1, then line 3."""
    spacing_m = 0.7 * WIDTH_M
    lines = parallel(3, spacing_m)
    off = [Defect("2", "off", 0.5, 90.0)]  # it flies west: its right is north
    found = states(flown(lines, off, {"overlap_percent": 20.0}, turbulence="none"))
    assert found["1"] == found["3"] == ("good", {})
    assert found["2"][1] == {"cross_track": True, "overlap": False}
    apart = parallel(2, 0.9 * WIDTH_M)
    plain = watch(flight := flown(apart, [], {"overlap_percent": 20.0}, turbulence="none"), moments_of(flight)).plain()
    assert [line["state"] for line in plain["lines"]] == ["good", "again"]  # of a plan's own fault, the later one's
    (reason,) = plain["lines"][1]["reasons"]
    assert reason["value"] == pytest.approx(10.0, abs=1.0)
    assert reason["text"].startswith("overlap 10 % with line 1, below 20 % on 1200 m")


def test_least_overlap_of_pairs_is_that_of_the_geometry_and_is_not_looked_for_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Swaths of 693 m, 15 % and 30 % overlap; line 2 (to the west) is flown 30 m to its right, away from line 1."""
    lines = [*parallel(2, 0.85 * WIDTH_M), parallel(3, 0.85 * WIDTH_M)[2] | {"name": "3"}]
    lines[2] |= {key: [lines[2][key][0], 1.55 * WIDTH_M] for key in ("from_m", "to_m")}
    flight = flown(lines, [Defect("2", "off", 0.5, 30.0)], {"overlap_percent": 20.0}, turbulence="none")
    looks: list[FloatArray] = []
    places = LineGeometry.places

    def counted(geometry: LineGeometry, lat_rad: FloatArray, lon_rad: FloatArray) -> Places:
        looks.append(lat_rad)
        return places(geometry, lat_rad, lon_rad)

    watched = watch(flight, moments_of(flight))
    assert isinstance(watched, LineWatch)
    monkeypatch.setattr(LineGeometry, "places", counted)
    away = 30.0 / WIDTH_M
    assert [(one.first, one.second) for one in watched.overlap_pairs()] == [("1", "2"), ("2", "3")]
    assert [one.least for one in watched.overlap_pairs()] == pytest.approx([0.15 - away, 0.30 + away], abs=0.01)
    before = watched.plain()
    looks.clear()
    watched.lines[1].is_new = True
    assert watched.plain() == before
    assert looks == []  # where lines lie beside each other is known from the plan, once they have been flown


def test_steering_agrees_with_geodesics() -> None:
    """Across by the plan's own geometry: the line is flown 30 m to its right. Distances by PROJ."""
    flight = flown(parallel(2, 500.0), [Defect("1", "off", 0.5, 30.0)], {"speed_mps": 55.0}, turbulence="none")
    watched, rows = LineWatch(flight.plan, flight.config), moments_of(flight)
    first, second = flight.track.lines
    for at_s, name in (
        (first.start_s - 2.0, "1"),
        ((first.start_s + first.end_s) / 2, "1"),
        (second.start_s - 3.0, "2"),
    ):
        row = rows[round(at_s * 10) : round(at_s * 10) + 1]
        watched.poses(row)
        steering = watched.steering
        assert steering is not None
        assert (steering.line, steering.is_reverse) == (name, False)
        planned = flight.plan.lines[int(name) - 1]
        here = np.degrees([row["lon_rad"][0], row["lat_rad"][0]]).tolist()
        ends = zip(planned.lon_deg.tolist(), planned.lat_deg.tolist(), strict=True)
        begin_m, end_m = (GEOD.inv(here[0], here[1], lon, lat)[2] for lon, lat in ends)
        off_m = 30.0 if name == "1" else 0.0
        assert steering.cross_track_m == pytest.approx(off_m, abs=0.4)  # just behind a turn
        assert steering.height_m == pytest.approx(0.0, abs=0.3)
        azimuth_deg = GEOD.inv(planned.lon_deg[0], planned.lat_deg[0], planned.lon_deg[1], planned.lat_deg[1])[0]
        error_deg = (math.degrees(row["track_rad"][0]) - azimuth_deg + 180.0) % 360.0 - 180.0
        assert steering.track_error_deg == pytest.approx(error_deg, abs=0.02)
        before = at_s < {"1": first, "2": second}[name].start_s
        assert steering.to_begin_m == (pytest.approx(begin_m, abs=0.1) if before else 0.0)
        assert steering.to_end_m == pytest.approx(
            math.hypot(end_m, off_m) if before else math.sqrt(end_m**2 - off_m**2), abs=3.0
        )
        plain = steering.plain(10.0)
        assert plain["to_end_s"] == pytest.approx(steering.to_end_m / 60.0, rel=1e-2)
        assert (plain["wanted_speed_mps"], plain["bank_limit_deg"]) == (60.0, 10.0)
    assert watched.next_line == "2"


def test_the_operators_mark_overrules_until_the_line_is_flown_again() -> None:
    flight = flown(parallel(2, 500.0), [Defect("1", "off", 0.5, 30.0)], {}, seed=4)
    watched = watch(flight, moments_of(flight))
    assert watched.overrule("line 1: accepted, client agrees, by radio", 5)
    first, second = watched.plain()["lines"]
    assert (first["state"], second["state"]) == ("remarks", "good")
    assert first["overruled"] == {"verdict": "accepted", "note": "client agrees, by radio", "time_ns": 5}
    assert watched.overrule("Line 2: AGAIN", 6)
    assert [line["state"] for line in watched.plain()["lines"]] == ["remarks", "again"]
    assert watched.overrule("line 1: reset", 7)
    assert watched.overrule("line 2: reset", 7)
    assert [line["state"] for line in watched.plain()["lines"]] == ["again", "good"]
    assert not watched.overrule("line 4 start", 8)


def test_the_text_of_an_overrule_names_a_known_line() -> None:
    names = ["4", "4: accepted", "Nord, west"]
    assert parsed_overrule("line 4: accepted", names) == (0, "accepted", "")
    assert parsed_overrule("LINE 4: accepted: again, x", names) == (1, "again", "x")
    assert parsed_overrule(" line nord, West: again ,  wind ", names) == (2, "again", "wind")
    for text in ("line 5: again", "line 4 again", "line 4: bad", "4: again", ""):
        assert parsed_overrule(text, names)[0] is None


def test_without_a_plan_strips_are_found_and_judged() -> None:
    defects = [Defect("2", "silent", 0.5, 6.0), Defect("3", "gnss", 0.5, 6.0)]
    flight = flown(parallel(3, 500.0, 2000.0), defects, {"density_per_m2": 0.85 * DENSITY}, seed=5)
    plain = watch(flight, moments_of(flight), planned=False).plain()
    found = {line["name"]: (line["state"], [one["code"] for one in line["reasons"]]) for line in plain["lines"]}
    assert found == {
        "strip 1": ("good", []),
        "strip 2": ("again", ["laser_off"]),
        "strip 3": ("remarks", ["gnss"]),
    }
    for line, leg in zip(plain["lines"], flight.track.lines, strict=True):
        seconds = (line["end_gps_ns"] - line["begin_gps_ns"]) / 1e9
        assert seconds == pytest.approx(leg.end_s - leg.start_s + 2.0, abs=0.5)


def test_moments_wait_for_returns_and_tell_water_from_silence() -> None:
    """A scanner that tells its pulses without a return gives none over water; then it is silent; then without time."""
    join = Moments(["left"])
    rows = empty_moments(60)
    rows["gps_ns"] = np.arange(60) * STEP_NS
    for place in range(60):
        gps_ns = place * STEP_NS
        if place < 20:
            join.returns_at(gps_ns, "left").first = 100
        join.add_seen([gps_ns - STEP_NS, gps_ns], "left", 90 if place >= 50 else 0, 100 if place < 30 else 0)
    join.add_poses(rows)
    settled = join.settled()
    assert len(settled) == 29  # older than 3 s
    assert settled["returns"].tolist() == [100] * 20 + [0] * 9
    assert settled["empty"].tolist() == [0] * 20 + [1] * 9
    last = join.settled(last=True)
    assert (last["silent"][8:].tolist()[:7], last["untimed"][-9:].tolist()) == ([1] * 7, [1] * 9)
    assert len(join.settled(last=True)) == 0


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_every_defect_of_fifty_flights_is_found() -> None:
    """At most 1 % of the verdicts may be false; the last flight is repeated without a plan."""
    kinds, wrong, verdicts = list(KINDS), [], 0
    for seed in range(50):
        rng = np.random.default_rng(seed)
        flight = drawn(rng, kinds, seed)
        plain = watch(flight, moments_of(flight)).plain()
        for line in plain["lines"]:
            verdicts += 1
            mine = [one for one in flight.defects if one.line == line["name"]]
            reasons = {reason["code"]: reason["grave"] for reason in line["reasons"]}
            due = {KINDS[one.kind][0]: is_grave(one) for one in mine}
            for code, grave in due.items():
                assert reasons.get(code) is grave, (seed, mine, line["reasons"])
            also = {"density"} if any(one.kind in ("fast", "high") for one in mine) else set()
            expected = "again" if any(due.values()) else "remarks" if due else "good"
            if set(reasons) - set(due) - also or (line["state"] != expected and not also):
                wrong.append((seed, line["name"], mine, line["reasons"]))
    assert len(wrong) <= 0.01 * verdicts, wrong
