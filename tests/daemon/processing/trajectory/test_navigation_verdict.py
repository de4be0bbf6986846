"""Tests the verdict on a flight: introduced faults are reported, and a sound flight is good."""

from __future__ import annotations

import copy
import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from swath.daemon.processing.trajectory.figures import CHI2_MEDIAN, Figures, figures_of
from swath.daemon.processing.trajectory.page import summary_of
from swath.daemon.processing.trajectory.series import Flight, separation_of
from swath.daemon.processing.trajectory.verdict import RULES, judge
from swath.georef.navigation.diagnosis.diagnose import Finding
from swath.georef.navigation.inputs import Fate, Kind
from swath.georef.timescales.gps_time import SECOND_NS
from swath.georef.verdicts import Level
from tests.daemon.navigation_flights import SMOOTHER_SIGMA, sound_flight, with_rows

pytestmark = pytest.mark.xdist_group("kernels")

DOC = Path(__file__).parents[4] / "docs" / "trajectory.md"


@pytest.fixture(scope="module")
def sound() -> Flight:
    return sound_flight()


@pytest.fixture(scope="module")
def figures(sound: Flight) -> Figures:
    return figures_of(sound, separation_of(sound))


def told(flight: Flight) -> dict[str, str]:
    """Return names and sentences of the reasons."""
    verdict = judge(figures_of(flight, separation_of(flight)))
    return {reason.name: reason.what for reason in verdict.reasons}


def seconds_of(flight: Flight) -> Any:
    rows = flight.forward.innovations
    return (rows["time_ns"] - rows["time_ns"][0]) / SECOND_NS


def test_a_sound_flight_is_good(figures: Figures) -> None:
    verdict = judge(figures)
    assert (verdict.level, verdict.reasons) == (Level.GOOD, ())
    assert verdict.sentence == (
        "Good: position to 0.5 cm, roll and pitch to 0.0020°, heading to 0.0040° (one sigma, root mean square over the "
        "flight)."
    )


def test_figures_match_the_simulated_errors(figures: Figures) -> None:
    assert figures["sigma_rms"]["down_m"] == pytest.approx(SMOOTHER_SIGMA[0][2])
    assert figures["sigma_p95"]["heading_deg"] == pytest.approx(np.degrees(SMOOTHER_SIGMA[2][2]))
    assert figures["rate_hz"] == pytest.approx(5.0)
    # 3 × 9134 independent values: their root mean square is known to 1 / √(2 · 27 402) = 0.0043
    assert all(abs(value - 1.0) < 4 * 0.0043 for value in figures["separation"].values())
    for row in figures["observations"].values():
        assert row["sigma_factor"] == pytest.approx(1.0, abs=0.06)  # the median of 1826 χ² with 3 degrees, 3 sigmas
        assert abs(row["correlation"]) < 3 / np.sqrt(3 * 1825)


def test_the_median_of_chi2_matches_scipy() -> None:
    assert CHI2_MEDIAN[1:] == pytest.approx([chi2.median(n) for n in (1, 2, 3)], abs=1e-4)


def test_summary_can_be_written_as_json(sound: Flight) -> None:
    summary = json.loads(json.dumps(summary_of(sound), allow_nan=False))
    assert summary["verdict"]["level"] == "good"
    assert summary["figures"]["positions"]["fix_types"] == {"rtk_fixed": 1826}


def test_a_filter_alone_is_judged_without_separation(sound: Flight) -> None:
    alone = replace(sound, smoothed=None)
    found = figures_of(alone, separation_of(alone))
    assert (found["solution"], found["separation"]) == ("filter", None)
    assert found["sigma_rms"]["north_m"] == pytest.approx(0.008)
    assert judge(found).level is Level.GOOD


PLACES: dict[str, Callable[[Figures, float], Any]] = {
    "not finite": lambda f, v: f.update(not_finite=v),
    "missing": lambda f, v: f.update(missing_s=v),
    "missing share": lambda f, v: f.update(missing_share=v),
    "positions used": lambda f, v: f["positions"].update(used=v),
    "position sigma": lambda f, v: f["sigma_p95"].update(east_m=v),
    "tilt sigma": lambda f, v: f["sigma_p95"].update(pitch_deg=v),
    "heading sigma": lambda f, v: f["sigma_p95"].update(heading_deg=v),
    "outage": lambda f, v: f["positions"].update(longest_outage_s=v),
    "rejected": lambda f, v: f["observations"]["position"].update(seen=1.0, rejected=v),
    "inflated": lambda f, v: f["observations"]["velocity"].update(seen=1.0, inflated=v),
    "unusable": lambda f, v: f["observations"]["velocity"].update(seen=1.0, unusable=v),
    "innovations large": lambda f, v: f["observations"]["position"].update(sigma_factor=v),
    "innovations small": lambda f, v: f["observations"]["position"].update(sigma_factor=1.0 / v),
    "noise found": lambda f, v: f.update(noise_found={"positions, rtk fixed": v}),
    "innovations correlated": lambda f, v: f["observations"]["position"].update(correlation=v),
    "separation": lambda f, v: f["separation"].update(attitude=v),
    "separation at worst": lambda f, v: f["separation_worst"].update(position={"value": v, "at_s": 700.0}),
    "bridged share": lambda f, v: f["bridged"].update(share=v),
    "bridged run": lambda f, v: f["bridged"].update(longest_s=v),
    "bias": lambda f, v: f["sensors"]["accel_bias"]["y"].update(largest_over_expected=v),
    "scale": lambda f, v: f["sensors"]["gyro_scale"]["z"].update(largest_over_expected=v),
    "lever arm moved": lambda f, v: f.update(lever_arm={"moved_m": [0, 0, v], "sigma_over_prior": [0, 0, 0]}),
    "lever arm unseen": lambda f, v: f.update(lever_arm={"moved_m": [0, 0, 0], "sigma_over_prior": [0, 0, v]}),
    "time offset": lambda f, v: f.update(time_offset={"estimate_s": v / 1e3, "significant": True}),
}


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.name)
def test_each_limit_gives_one_reason_only_when_exceeded(figures: Figures, rule: Any) -> None:
    """At a limit no reason is given; beyond it exactly one reason of that level."""
    for limit, level in ((rule.care, Level.CARE), (rule.unusable, Level.UNUSABLE)):
        if limit is None:
            continue
        beyond = limit - 1 if rule.least else limit * 1.0001 + (1.0 if limit == 0 else 0.0)
        changed = copy.deepcopy(figures)
        PLACES[rule.name](changed, beyond)
        verdict = judge(changed)
        worst = Level.UNUSABLE if rule.unusable == limit else level
        assert [(reason.name, reason.level) for reason in verdict.reasons] == [(rule.name, worst)]
        assert verdict.reasons[0].change
        assert verdict.reasons[0].what in verdict.sentence
        assert verdict.sentence.startswith(worst.words.capitalize())
        within = copy.deepcopy(figures)
        PLACES[rule.name](within, limit * (1 - 1e-9) if rule.name == "innovations small" else limit)
        assert all(reason.level < worst for reason in judge(within).reasons)


def test_the_documentation_has_the_table_of_limits() -> None:
    rows = re.findall(r"^\| ([a-z ]+) \| [^|]* \| ([^|]+) \| ([^|]+) \|", DOC.read_text(encoding="utf-8"), re.MULTILINE)

    def limit(value: float | None) -> str:
        return "–" if value is None else f"{value:g}"

    rows = [row for row in rows if row[0] != "limit"]
    documented = {name: (care.split()[0].rstrip("°"), unusable.split()[0].rstrip("°")) for name, care, unusable in rows}
    assert {rule.name: (limit(rule.care), limit(rule.unusable)) for rule in RULES} == documented


def test_rejected_and_inflated_observations_are_a_reason(sound: Flight) -> None:
    rows = sound.forward.innovations.copy()
    positions = np.flatnonzero(rows["kind"] == Kind.POSITION)
    rows["fate"][positions[::10]] = Fate.REJECTED
    rows["fate"][positions[5::10]] = Fate.INFLATED
    found = told(with_rows(sound, rows))
    assert found["rejected"] == "10.0% of the position observations were rejected"
    assert found["inflated"].startswith("10.0% of the position")


def test_rows_outside_the_run_are_ignored(sound: Flight) -> None:
    rows = sound.forward.innovations.copy()
    rows["fate"][: len(rows) // 2] = Fate.OUTSIDE
    rows["fate"][-40::2] = Fate.REJECTED
    found = figures_of(with_rows(sound, rows), None)["observations"]["position"]
    assert (found["outside"], found["seen"], found["rejected"]) == (913, 913, 20)


def test_an_outage_is_reported_with_its_duration(sound: Flight) -> None:
    at_s = seconds_of(sound)
    gone = with_rows(sound, sound.forward.innovations[(at_s <= 600) | (at_s >= 645)])
    assert told(gone) == {"outage": "45 s passed without a usable position"}
    rejected = sound.forward.innovations.copy()
    rejected["fate"][(at_s > 600) & (at_s < 645)] = Fate.REJECTED
    assert told(with_rows(sound, rejected))["outage"] == told(gone)["outage"]


def test_enlarged_innovations_are_found_among_outliers(sound: Flight) -> None:
    rows = sound.forward.innovations.copy()
    rows["normalised"] *= 2.0
    rows["chi2"] *= 4.0
    rows["chi2"][::50] = 1e6
    assert told(with_rows(sound, rows))["innovations large"].startswith("innovations of ")
    found = figures_of(with_rows(sound, rows), None)["observations"]["velocity"]
    assert found["sigma_factor"] == pytest.approx(2.0, abs=0.15)


def test_correlated_innovations_are_a_reason(sound: Flight) -> None:
    rows = sound.forward.innovations.copy()
    for kind, memory in ((Kind.POSITION, 0.8), (Kind.VELOCITY, 0.2)):
        mine = np.flatnonzero(rows["kind"] == kind)
        values = rows["normalised"][mine]
        for i in range(1, len(values)):
            values[i] = memory * values[i - 1] + np.sqrt(1 - memory**2) * values[i]
        rows["normalised"][mine] = values
    found = figures_of(with_rows(sound, rows), None)["observations"]
    assert found["position"]["correlation"] == pytest.approx(0.8, abs=0.03)
    assert found["velocity"]["correlation"] == pytest.approx(0.2, abs=0.05)
    assert set(told(with_rows(sound, rows))) == {"innovations correlated"}


def test_too_large_a_separation_is_a_reason(sound: Flight) -> None:
    small = replace(sound.forward, position_sigma_l=sound.forward.position_sigma_l / 2)
    assert "separation" in told(replace(sound, forward=small))


def test_seconds_of_a_wrong_fix_are_reported_with_their_time_in_any_flight(sound: Flight) -> None:
    at_s = (sound.forward.time_ns - sound.start_ns) / SECOND_NS
    moved = sound.forward.position_e.copy()
    during = (at_s > 700.0) & (at_s < 712.0)
    moved[during] += 20.0 * sound.forward.position_sigma_l[during]
    wrong = replace(sound, forward=replace(sound.forward, position_e=moved))
    found = figures_of(wrong, separation_of(wrong))
    assert found["separation"]["position"] < 2.0
    assert found["separation_worst"]["position"]["at_s"] == pytest.approx(706.0, abs=10.0)
    assert found["separation_worst"]["velocity"]["value"] < 2.5
    assert "filter and smoother differ in position 7" in told(wrong)["separation at worst"]
    assert "separation" not in told(wrong)


def test_a_long_bridge_of_samples_is_a_reason(sound: Flight) -> None:
    assert sound.smoothed is not None
    bridged = np.zeros(len(sound.smoothed), bool)
    bridged[1000:1008] = True  # 1.6 s
    found = told(replace(sound, smoothed=replace(sound.smoothed, bridged=bridged)))
    assert found == {"bridged run": "inertial samples are missing for 1.6 s without a break"}


def test_lever_arm_and_time_offset_are_reasons(sound: Flight) -> None:
    assert sound.smoothed is not None
    count = len(sound.smoothed.node_time_ns)
    best = replace(
        sound.smoothed,
        lever_arm_sigma=np.tile([0.01, 0.01, 0.2], (count, 1)),
        time_offset_s=np.full(count, 0.125),
        time_offset_sigma_s=np.full(count, 0.001),
    )
    arms = np.array([[0.35, 0.12, -0.8]])
    setup = replace(sound.setup, estimate_lever_arm=0.3, estimate_time_offset_s=0.2, lever_arms_b=arms)
    found = told(replace(sound, smoothed=best, setup=setup))
    assert found["lever arm moved"] == "the antenna was estimated 0.24 m from its place by lever_arm_m (y)"
    assert found["lever arm unseen"].startswith(
        "this flight hardly determines lever arm z"
    )  # and its 0.3 m are within three sigmas
    assert found["time offset"].startswith("GNSS stamps are 125.0 ms early")


def test_a_flight_without_positions_is_unusable(sound: Flight) -> None:
    none = with_rows(sound, sound.forward.innovations[:0])
    verdict = judge(figures_of(none, separation_of(none)))
    assert verdict.level is Level.UNUSABLE
    assert "the filter used only 0 positions" in [reason.what for reason in verdict.reasons]


@pytest.mark.parametrize(("severity", "words"), [("warning", "Usable with care"), ("error", "Not to be used")])
def test_findings_are_reasons_and_come_first(figures: Figures, severity: Any, words: str) -> None:
    changed = copy.deepcopy(figures)
    changed["positions"]["longest_outage_s"] = 300.0
    verdict = judge(changed, [Finding("gravity", severity, "axis y reads 1 g: turn rotation_b_imu")])
    assert [reason.name for reason in verdict.reasons] == ["gravity", "outage"]
    assert verdict.sentence == f"{words}: axis y reads 1 g: turn rotation_b_imu; 1 more reason."
