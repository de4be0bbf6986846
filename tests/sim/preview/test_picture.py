"""Tests what a plan covers, against hand computation and the scanners' own pulses, and its picture."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from swath.georef.arrays import FloatArray
from swath.sim.plan.errors import PlanError
from swath.sim.plan.plan import Plan, parse_plan
from swath.sim.plan.tables import ScannerTable
from swath.sim.preview.coverage import Strip, Survey, corners, fan_of, grid_of, plan_summary, pulse_rate_hz, strip_of
from swath.sim.preview.picture import _framed, draw_plan
from swath.sim.scanners.line_heads import LineHead
from swath.sim.scanners.spinning_heads import Os1Head, Vlp16Head
from tests.sim.preview.builders import FLAT, flat_plan, line

ACROSS = [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]  # a head whose axis points forward


def strip(plan: Plan, index: int = 0) -> Strip:
    return strip_of(plan, index, 0.0, 0.0)


class TestSummary:
    def test_summary_matches_a_calculation_by_hand(self) -> None:
        """With H = 400 m and ±30° a swath is 800/√3 m wide; lines 230.94 m apart overlap by half.

        A line of 1000 m takes 20 s at 50 m/s.
        """
        apart = 400.0 / math.sqrt(3.0)
        plan = flat_plan(
            line("a", "-500.0, 0.0", "500.0, 0.0"),
            line("b", f"500.0, {apart!r}", f"-500.0, {apart!r}"),
            line("c", "0.0, -500.0", "0.0, 500.0", 1000.0),
        )
        first, second, crossing, total = plan_summary(plan)
        swath = 800.0 / math.sqrt(3.0)
        assert [row["name"] for row in (first, second, crossing, total)] == ["a", "b", "c", "total"]
        assert first["length_m"] == pytest.approx(1000.0)
        assert first["seconds"] == pytest.approx(20.0)
        assert first["height_min_m"] == pytest.approx(400.0, abs=1e-3)
        assert first["height_mean_m"] == pytest.approx(400.0, abs=1e-3)
        assert first["swath_m"] == pytest.approx(swath, rel=1e-5)
        assert first["density_per_m2"] == pytest.approx(100_000.0 / (50.0 * swath), rel=1e-5)
        assert first["overlap_percent"] == pytest.approx(50.0, abs=0.3)
        assert second["overlap_percent"] == pytest.approx(50.0, abs=0.3)
        assert crossing["overlap_percent"] == 0.0
        assert crossing["swath_m"] == pytest.approx(swath * 1.5, rel=1e-5)
        assert total["line_s"] == pytest.approx(60.0)
        assert total["pulses"] == pytest.approx(6_000_000, abs=1)
        assert total["seconds"] > 60.0

    def test_datagrams_dominate_the_size_of_the_log(self) -> None:
        """A datagram of SREP/1 with 100 pulses has 48 + 100 · (8 + 8 · 3) + 4 bytes."""
        plan = flat_plan(line("a", "-500.0, 0.0", "500.0, 0.0"))
        datagrams = 20_000 * (48 + 100 * 32 + 4)
        assert datagrams < plan_summary(plan)[-1]["log_bytes"] < 1.15 * datagrams

    def test_a_slope_reduces_the_height_above_ground(self) -> None:
        """A slope of 10 % that falls west along the line gives ±50 m over 500 m, with the mean of the origin."""
        more = "slope_percent = 10.0\nslope_towards_deg = 270.0\n[control]\npoints = 0\n"
        text = FLAT.replace("[control]\npoints = 3\n", more)
        row = plan_summary(parse_plan(text + line("a", "-500.0, 0.0", "500.0, 0.0"), Path()))[0]
        assert row["height_min_m"] == pytest.approx(350.0, abs=0.1)
        assert row["height_mean_m"] == pytest.approx(400.0, abs=0.1)

    def test_swath_of_a_spinning_head_is_limited_by_its_range(self) -> None:
        """From 60 m, a range of 100 m reaches 80 m to either side; acos 0.6 of half a turn of pulses reach ground."""
        head = f'[scanner.belly]\nkind = "vlp16"\nscan_hz = 10.0\nrange_max_m = 100.0\ninstallation = {ACROSS}\n'
        text = FLAT.partition("[scanner.left]")[0] + head + line("a", "-500.0, 0.0", "500.0, 0.0", 460.0)
        row = plan_summary(parse_plan(text, Path()))[0]
        assert row["swath_m"] == pytest.approx(160.0, abs=0.01)
        reaching = 16 / 55.296e-6 * math.acos(0.6) / math.pi
        assert row["density_per_m2"] == pytest.approx(reaching / (50.0 * 160.0), rel=1e-3)

    @pytest.mark.parametrize(
        ("ranges", "words"),
        [
            ("range_max_m = 350.0", "400 m above ground, but scanner.left measures to 350 m; set a height"),
            ("range_min_m = 500.0", "400 m above ground, but scanner.left measures from 500 m on; set a height"),
        ],
    )
    def test_a_line_out_of_range_is_refused(self, ranges: str, words: str) -> None:
        plan = flat_plan(line("a", "-500.0, 0.0", "500.0, 0.0"), more=ranges)
        with pytest.raises(PlanError, match=words) as caught:
            plan_summary(plan)
        assert caught.value.key == "line[0].height_m"


def scanner(**keys: Any) -> ScannerTable:
    return ScannerTable.model_validate({"prf_hz": 100_000.0, "scan_hz": 40.0} | keys)


KINDS = {
    "sine": scanner(kind="oscillating", motion="sine"),
    "triangle": scanner(kind="oscillating", motion="triangle"),
    "polygon": scanner(kind="polygon", facets=8, half_angle_deg=35.0),
    "monogon": scanner(kind="monogon", half_angle_deg=60.0),
    "nutating": scanner(kind="nutating", nutation_deg=8.0),
    "risley": scanner(kind="risley", wedge_deg=[12.0, 7.0]),
    "vlp16": scanner(kind="vlp16", scan_hz=10.0, installation=ACROSS),
    "os1": scanner(kind="os1", scan_hz=20.0, installation=ACROSS),
}
SPAN_S = 0.4  # each scanner makes whole turns or swings in it
HEADS: dict[str, Callable[[ScannerTable, str], Vlp16Head | Os1Head | LineHead]] = {"vlp16": Vlp16Head, "os1": Os1Head}


class TestFans:
    """The expected angles are those of the pulses that the scanners themselves emit."""

    def angles(self, table: ScannerTable) -> FloatArray:
        """Return the angle (n,), rad, of every pulse across the flight, from nadir."""
        head = HEADS.get(table.kind, LineHead)(table, "left")
        pulses = head.pulses(0.0, SPAN_S)
        beams = pulses.direction_s @ np.array(table.installation).T
        angles: FloatArray = np.arctan2(beams[:, 1], beams[:, 2])
        return angles

    @pytest.mark.parametrize("kind", KINDS)
    def test_rate_and_half_angle_match_the_pulses(self, kind: str) -> None:
        angles, fan = self.angles(KINDS[kind]), fan_of(KINDS[kind])
        assert len(angles) == pytest.approx(SPAN_S * pulse_rate_hz(KINDS[kind]), rel=2e-3)
        assert np.abs(angles).max() == pytest.approx(fan.half_angle_rad, rel=5e-3)

    @pytest.mark.parametrize("kind", ["sine", "polygon", "monogon", "nutating", "vlp16", "os1"])
    def test_shares_of_pulses_below_each_angle_match(self, kind: str) -> None:
        """The beams of spinning heads lean, so their shares differ slightly from those of turns."""
        angles, fan = self.angles(KINDS[kind]), fan_of(KINDS[kind])
        at = np.linspace(-0.95, 0.95, 39) * fan.half_angle_rad
        below = np.searchsorted(np.sort(angles), at) / len(angles)
        assert np.abs(below - fan.share(at)).max() < 0.01

    def test_a_scanner_mounted_with_roll_looks_sideways(self) -> None:
        """The scanner is rolled by 20° to the left, so the beam at 0 points right."""
        roll = math.radians(-20.0)
        turned = [[1.0, 0.0, 0.0], [0.0, math.cos(roll), -math.sin(roll)], [0.0, math.sin(roll), math.cos(roll)]]
        table = scanner(kind="polygon", facets=8, half_angle_deg=35.0, installation=turned, prf_hz=1e6)
        angles = self.angles(table)
        first, last = fan_of(table).limits(np.array([400.0]))
        assert (angles.min(), angles.max()) == pytest.approx((first[0], last[0]), abs=1e-3)
        assert last[0] == pytest.approx(math.radians(55.0))


class TestStrips:
    def test_strip_has_its_sides_and_ends(self) -> None:
        """On a line to the north-east, right is south-east."""
        one = strip(flat_plan(line("a", "100.0, 200.0", "400.0, 600.0")))
        east, north = np.array([220.0, 180.0, 100.0, 400.0]), np.array([360.0, 390.0, 200.0, 600.0])
        along, right = one.beside(east, north)
        assert along == pytest.approx([200.0, 200.0, 0.0, 500.0])
        assert right == pytest.approx([0.0, -50.0, 0.0, 0.0])
        assert np.stack(one.point(along, right)) == pytest.approx(np.stack([east, north]))

    def test_covered_ground_is_what_the_beam_reaches(self) -> None:
        """±30° from 400 m cover 230.9 m on level ground and 173.2 m on ground 100 m higher."""
        one = strip(flat_plan(line("a", "0.0, 0.0", "500.0, 0.0")))
        east = np.array([100.0, 100.0, 100.0, 100.0, 501.0, 499.0])
        north = np.array([230.0, -232.0, 180.0, -170.0, 0.0, 0.0])
        ground = np.array([400.0, 400.0, 500.0, 500.0, 400.0, 400.0])
        assert one.covers(east, north, ground).tolist() == [True, False, False, True, False, True]

    def test_the_map_contains_every_pulse(self) -> None:
        survey = Survey(flat_plan(line("a", "-500.0, 0.0", "500.0, 0.0"), line("b", "0.0, 500.0", "0.0, -500.0")))
        grid = grid_of(survey)
        assert grid.density.sum() * grid.cell_m**2 == pytest.approx(100_000.0 * 40.0, rel=0.01)
        assert grid.lines.max() == 2
        covered = (grid.lines > 0).sum() * grid.cell_m**2
        swath = 800.0 / math.sqrt(3.0)
        assert covered == pytest.approx(2 * 1000.0 * swath - swath**2, rel=0.01)

    def test_density_follows_the_mirror(self) -> None:
        """Uniform angles give rate / (v · 2 θmax) · cos² θ / H; a sine gives more points at its edges."""
        plan = flat_plan(line("a", "0.0, 0.0", "500.0, 0.0"))
        even = plan.changed({"scanner": {"left": {"kind": "oscillating", "motion": "triangle"}}})
        east, north, ground = np.full(2, 250.0), np.array([0.0, 200.0]), np.full(2, 400.0)
        angle = np.arctan2(north, 400.0)
        expected = 100_000.0 / (50.0 * 2 * math.radians(30.0)) * np.cos(angle) ** 2 / 400.0
        assert strip(even).density(east, north, ground, 0.1) == pytest.approx(expected, rel=1e-4)
        sine = 100_000.0 / (50.0 * math.pi * np.sqrt(math.radians(30.0) ** 2 - angle**2)) * np.cos(angle) ** 2 / 400.0
        assert strip(plan).density(east, north, ground, 0.1) == pytest.approx(sine, rel=1e-4)

    def test_ground_heights_are_requested_only_inside_the_swath(self) -> None:
        plan = flat_plan(line("a", "-500.0, 0.0", "500.0, 0.0"))
        found = corners(plan)
        swath = 800.0 / math.sqrt(3.0)
        assert np.ptp(found[:, 0]) == pytest.approx(1000.0)
        assert np.ptp(found[:, 1]) == pytest.approx(swath)
        shaken = corners(plan.changed({"flight": {"turbulence": "severe"}}))
        assert np.ptp(shaken[:, 1]) > swath + 50.0


def png_size(path: Path) -> tuple[int, int]:
    """Return width and height from the header chunk (PNG specification, 11.2.2)."""
    data = path.read_bytes()
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    width, height = struct.unpack(">II", data[16:24])
    return width, height


class TestFrames:
    BOX = (0.0, 0.0, 8.0, 4.0)

    def test_a_map_fills_its_panel_to_scale(self) -> None:
        low, high, stretch = _framed(np.array([0.0, 0.0]), np.array([1000.0, 2000.0]), self.BOX)
        assert low == pytest.approx([-1500.0, 0.0])
        assert high == pytest.approx([2500.0, 2000.0])
        assert stretch == 1.0

    def test_a_long_narrow_map_is_stretched(self) -> None:
        low, high, stretch = _framed(np.array([0.0, 0.0]), np.array([500.0, 40_000.0]), self.BOX)
        assert [*low, *high] == pytest.approx([0.0, 0.0, 500.0, 40_000.0])
        assert stretch == pytest.approx((500.0 / 8.0) / (40_000.0 / 4.0))


class TestDrawing:
    def test_a_page_is_drawn(self, tmp_path: Path) -> None:
        things = (
            "[[terrain.village]]\ncenter_m = [0.0, 0.0]\nsize_m = [200.0, 200.0]\nhouses = 10\n"
            "[[terrain.water]]\ncenter_m = [-300.0, 100.0]\nradius_m = 50.0\n"
            "[[terrain.wire]]\nfrom_m = [-300.0, -100.0]\nto_m = [0.0, -120.0]\n"
            "[[terrain.forest]]\ncenter_m = [300.0, 0.0]\nsize_m = [80.0, 80.0]\n"
            "[[terrain.car]]\nfrom_m = [-300.0, -150.0]\nto_m = [300.0, -150.0]\n"
        )
        hills = FLAT.replace("height_m = 400.0", "height_m = 400.0\nrelief_m = 40.0")
        lines = line("a", "-500.0, 0.0", "500.0, 0.0") + line("b", "0.0, 500.0", "0.0, -500.0")
        plan = parse_plan(hills + things + lines, Path())
        rows = draw_plan(plan, tmp_path / "plan.png")
        assert rows == plan_summary(plan)
        assert png_size(tmp_path / "plan.png") == (2550, 1590)
        assert (tmp_path / "plan.png").stat().st_size > 200_000

    def test_a_long_line_gets_a_wide_page(self, tmp_path: Path) -> None:
        """The page has 17 × 11.4 inches of 72 points."""
        draw_plan(flat_plan(line("a", "-20000.0, 0.0", "20000.0, 0.0")), tmp_path / "plan.PDF")
        data = (tmp_path / "plan.PDF").read_bytes()
        assert data[:5] == b"%PDF-"
        assert b"/MediaBox [ 0 0 1224 820.8 ]" in data

    def test_another_file_extension_is_refused_before_flying(self, tmp_path: Path) -> None:
        plan = flat_plan(line("a", "-500.0, 0.0", "500.0, 0.0", 300.0))  # below the ground
        with pytest.raises(PlanError, match=r"plan\.docx: want a picture's name that ends in one of \.pdf, \.png, "):
            draw_plan(plan, tmp_path / "plan.docx")
        with pytest.raises(PlanError, match=r"^line\[0\]\.height_m: 300 m is 100\.0 m below the terrain"):
            draw_plan(plan, tmp_path / "plan.png")
        assert not list(tmp_path.iterdir())

    def test_a_missing_folder_is_refused(self, tmp_path: Path) -> None:
        with pytest.raises(FileNotFoundError):
            draw_plan(flat_plan(line("a", "-500.0, 0.0", "500.0, 0.0")), tmp_path / "nowhere" / "plan.png")
