"""Tests that every preset, and every plan of the page, can be flown and is as the page states."""

from __future__ import annotations

import math
import re
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from swath.sim.faults import check_faults
from swath.sim.plan.plan import PRESETS, load_plan, parse_plan
from swath.sim.preview.coverage import Survey, summary_of

PAGE = (Path(__file__).parents[3] / "docs/simulation.md").read_text()
EXAMPLES = [text for text in re.findall(r"^```toml\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL) if "[flight]" in text]


@cache
def survey(preset: str) -> Survey:
    return Survey(load_plan(preset))


@cache
def rows(preset: str) -> list[dict[str, Any]]:
    return summary_of(survey(preset))


def headings_deg(preset: str) -> list[float]:
    return [math.degrees(math.atan2(strip.ahead[0], strip.ahead[1])) % 360.0 for strip in survey(preset).strips]


class TestEveryPreset:
    @pytest.mark.parametrize("preset", PRESETS)
    def test_every_preset_stays_within_the_range_of_its_scanner(self, preset: str) -> None:
        """The ground below is in range from the middle of a swath to its edges."""
        flown = survey(preset)
        assert flown.plan.tables.flight.name == preset
        check_faults(flown.plan.tables)
        scanner = flown.plan.tables.scanner["left"]
        for strip in flown.strips:
            _, above_m = flown.stations(strip)
            slant_m = above_m / math.cos(math.radians(scanner.half_angle_deg))
            assert above_m.min() > 2 * scanner.range_min_m
            assert slant_m.max() < 0.8 * scanner.range_max_m

    @pytest.mark.parametrize("preset", PRESETS)
    def test_lines_are_flown_in_their_listed_order(self, preset: str) -> None:
        flown, tables = survey(preset), survey(preset).plan.tables
        assert [line.name for line in flown.trajectory.lines] == [line.name for line in tables.line]
        for strip, line in zip(flown.strips, tables.line, strict=True):
            length_m = math.dist(line.from_m, line.to_m)
            speed_mps = line.speed_mps or tables.flight.speed_mps
            assert strip.end_s - strip.start_s == pytest.approx(length_m / speed_mps, rel=1e-3)

    @pytest.mark.parametrize("preset", PRESETS)
    def test_the_log_size_matches_the_page(self, preset: str) -> None:
        told = re.search(rf"^\| `{preset}` \|.*?([\d.]+) GB", PAGE, re.MULTILINE)
        log_gb = rows(preset)[-1]["log_bytes"] / 1e9
        assert log_gb < 2.0 if told is None else log_gb == pytest.approx(float(told[1]), rel=0.1)


class TestSmallPreset:
    def test_preset_is_short_and_contains_every_kind_of_object(self) -> None:
        flown = survey("small")
        total, scene = rows("small")[-1], flown.scene
        assert len(flown.strips) == 3
        assert total["seconds"] <= 150.0
        assert 2e6 <= total["pulses"] <= 4e6
        for things in (scene.buildings, scene.roads, scene.waters, scene.trees, scene.wires, scene.cars):
            assert len(things) > 0
        assert len(scene.buildings) >= 50

    def test_two_lines_overlap_and_one_crosses(self) -> None:
        east, south, west, _ = rows("small")
        assert headings_deg("small") == pytest.approx([90.0, 180.0, 270.0])
        assert east["overlap_percent"] > 40.0
        assert west["overlap_percent"] > 40.0
        assert south["overlap_percent"] == 0.0


class TestCalibrationPreset:
    def test_preset_takes_eleven_minutes_and_twenty_million_pulses(self) -> None:
        total = rows("calibration")[-1]
        assert total["seconds"] == pytest.approx(660.0, abs=20.0)
        assert total["pulses"] == pytest.approx(20e6, rel=0.05)

    def test_flight_turns_to_both_sides(self) -> None:
        """Turns to one side only would let the gyroscopes' misalignment look like accelerometer biases."""
        flown = survey("calibration")
        turned_deg = []
        for before, behind in pairwise(flown.strips):
            time_s = np.arange(before.end_s, behind.start_s, 0.1)
            heading = np.unwrap(flown.trajectory.attitude(time_s)[2])
            turned_deg.append(math.degrees(heading[-1] - heading[0]))
        assert sum(angle > 90.0 for angle in turned_deg) >= 5
        assert sum(angle < -90.0 for angle in turned_deg) >= 5

    def test_flight_has_two_heights_and_two_speeds(self) -> None:
        lines = rows("calibration")[:-1]
        low = [row["height_mean_m"] for row in lines if row["name"].startswith("low")]
        high = [row["height_mean_m"] for row in lines if row["name"].startswith("high")]
        assert len(low) == len(high) == 7
        assert min(high) / max(low) >= 1.7
        assert len({strip.speed_mps for strip in survey("calibration").strips}) == 2

    def test_each_height_has_opposite_crossing_and_parallel_lines(self) -> None:
        strips, headings = survey("calibration").strips, headings_deg("calibration")
        for height_m in {strip.height_m for strip in strips}:
            level = [
                (heading, strip) for heading, strip in zip(headings, strips, strict=True) if strip.height_m == height_m
            ]
            assert {round(heading) % 360 for heading, _ in level} == {0, 90, 180, 270}
            apart = [
                abs(float(strip.beside(*other.from_m)[1]))
                for heading, strip in level
                for heading_of_other, other in level
                if round(heading - heading_of_other) % 360 == 180
            ]
            assert min(apart) < 1.0
            assert max(apart) > 100.0

    def test_nominal_calibration_is_zero_and_wrong(self) -> None:
        scanner = survey("calibration").plan.tables.scanner["left"]
        nominal, true = scanner.nominal.model_dump(), scanner.true.model_dump()
        assert all(value == 0.0 for key, value in nominal.items() if not key.startswith("lever_arm"))
        assert true["range_offset_m"] == 0.35
        for key in ("omega_deg", "phi_deg", "kappa_deg"):
            assert 0.1 <= abs(true[key]) < 1.0
        for key in ("scan_angle_scale_ppm", "scan_plane_tilt_deg", "time_offset_us"):
            assert true[key] != 0.0

    def test_roofs_face_every_direction(self) -> None:
        """At least 150 houses have ridges, some of them in every sixth of the half circle."""
        corners = survey("calibration").scene.buildings
        assert len(corners) >= 150
        side = corners[:, 1] - corners[:, 0]
        azimuth = np.degrees(np.arctan2(side[:, 0], side[:, 1])) % 90.0
        assert np.histogram(azimuth, bins=3, range=(0.0, 90.0))[0].min() >= 5

    def test_every_roof_is_seen_from_at_least_six_lines(self) -> None:
        flown = survey("calibration")
        east_m, north_m = flown.scene.buildings.mean(axis=1).T
        ground_m = flown.scene.ground_m(east_m, north_m)
        seen = sum(strip.covers(east_m, north_m, ground_m).astype(int) for strip in flown.strips)
        assert np.min(seen) >= 3
        assert np.median(seen) >= 6


class TestOtherPresets:
    def test_corridor_follows_its_wire_both_ways(self) -> None:
        """Every mast is seen, most of them from a line out and a line back; either leaves out masts at its turns."""
        flown = survey("corridor")
        east_m, north_m = flown.scene.wires.reshape(-1, 2).T
        ground_m = flown.scene.ground_m(east_m, north_m)
        for way in ("out", "back"):
            seen = [strip.covers(east_m, north_m, ground_m) for strip in flown.strips if strip.name.startswith(way)]
            assert np.any(seen, axis=0).mean() >= 0.65
        every = [strip.covers(east_m, north_m, ground_m) for strip in flown.strips]
        assert np.any(every, axis=0).all()
        assert len({round(heading) % 180 for heading in headings_deg("corridor")}) == 5
        assert {facet.index for facet in flown.plan.tables.scanner["left"].facet} == set(range(8))

    def test_block_has_no_gaps(self) -> None:
        lines = rows("block")[:-1]
        assert len(lines) == 22
        assert [row["name"] for row in lines[-2:]] == ["cross-1", "cross-2"]
        assert all(25.0 < row["overlap_percent"] < 50.0 for row in lines[:-2])
        neighbours = sorted(survey("block").strips[:20], key=lambda strip: float(strip.from_m[1]))
        for south, north in pairwise(neighbours):
            assert south.ahead == pytest.approx(-north.ahead)

    def test_bench_is_one_long_line_of_many_pulses(self) -> None:
        flown = survey("bench")
        (strip,) = flown.strips
        assert strip.start_s < 15.0
        assert strip.end_s - strip.start_s >= 1800.0
        assert flown.plan.tables.scanner["left"].prf_hz == 400_000.0
        assert len(flown.scene.buildings) + len(flown.scene.trees) == 0


class TestPage:
    @pytest.mark.parametrize("text", EXAMPLES, ids=["first", "drone"])
    def test_example_plans_can_be_flown(self, text: str) -> None:
        plan = parse_plan(text, Path())
        summary = summary_of(Survey(plan))
        assert len(summary) == len(plan.tables.line) + 1
        assert all(row["density_per_m2"] > 0.5 for row in summary[:-1])
