"""Tests a quick look's numbers against surfaces of closed form."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from pyproj import CRS

from swath.daemon.processing.quicklook.grids import Frame, frame_of, inner, round_up
from swath.daemon.processing.quicklook.profile import steps_of
from swath.daemon.processing.quicklook.read import BLOCK_POINTS, QuickLookError
from swath.daemon.processing.quicklook.run import Look, look_at, numbers_of
from swath.daemon.processing.quicklook.strips import MOMENTS, TILE, StripCells, _halved
from tests.daemon.builders import EAST_M, NORTH_M, Array, lattice, plane, write_laz
from tests.daemon.processing.quicklook.builders import two_strips

pytestmark = pytest.mark.xdist_group("kernels")


@pytest.fixture(scope="module")
def shifted(tmp_path_factory: pytest.TempPathFactory) -> Look:
    return two_strips(tmp_path_factory.mktemp("shifted"), 0.07)


def test_a_shift_between_strips_is_found_on_a_slope_to_a_tenth_of_a_millimetre(shifted: Look) -> None:
    (row,) = shifted.overlap.rows
    assert [shifted.names[row[key]] for key in ("first", "second")] == ["1", "2"]
    for key, truth in (("median_m", -0.07), ("mean_m", -0.07), ("rms_m", 0.07), ("p95_m", 0.07), ("max_m", 0.07)):
        assert row[key] == pytest.approx(truth, abs=1.5e-4), key  # coordinates are rounded to 0.1 mm
    cell_m2 = shifted.cells.frame.cell_m**2
    assert 0.98 * row["compared_cells"] <= row["cells"] <= row["compared_cells"]  # slivers have no plane
    assert row["cells"] * cell_m2 == pytest.approx(300.0 * 40.0, rel=0.12)  # cells at the edges are missing
    together = shifted.overlap.numbers()
    assert together is not None
    assert (together["median_m"], together["p95_m"]) == (-0.07, 0.07)


def test_density_area_and_length_match_the_lattice(shifted: Look) -> None:
    for strip in shifted.strips:
        assert strip.points == strip.pulses == 600 * 200
        assert strip.density == pytest.approx(4.0, rel=0.01)
        assert strip.area_m2 == pytest.approx(30_000.0, rel=0.05)
        assert strip.length_m == pytest.approx(300.0, rel=0.02)
    assert shifted.surface.points == 240_000
    assert shifted.density == pytest.approx(240_000 / (300.0 * 160.0), rel=0.03)
    assert shifted.area_m2 == pytest.approx(300.0 * 160.0, rel=0.05)


def test_the_profile_crosses_the_overlap_and_shows_half_the_shift_on_each_side(shifted: Look) -> None:
    assert shifted.profile is not None
    line = shifted.profile.line
    assert abs(line.ahead[1]) == pytest.approx(1.0, abs=0.01)  # strips run east
    middle = (line.start_m + line.end_m) / 2
    assert middle[1] == pytest.approx(NORTH_M + 80.0, abs=shifted.cells.frame.cell_m)
    assert line.length_m == pytest.approx(40.0 * 1.3, abs=6.0)
    steps = steps_of(shifted.profile)
    for strip, truth in ((0, -0.035), (1, 0.035)):
        known = steps.offset_m[strip][np.isfinite(steps.offset_m[strip])]
        assert len(known) > 10
        assert float(np.median(known)) == pytest.approx(truth, abs=1e-3)


def test_rough_and_steep_ground_is_not_compared(tmp_path: Path) -> None:
    def rough(x: Array, y: Array) -> Array:
        hedge = (x - EAST_M > 100.0) & (x - EAST_M < 150.0)
        steep = np.maximum(x - EAST_M - 200.0, 0.0)
        return plane(x, y) + hedge * ((x * 1.7 + y * 2.3) % 1.0) + 0.3 * steep

    look = two_strips(tmp_path, 0.02, rough)
    assert look.overlap.best is not None
    east_m = look.cells.frame.centres(look.overlap.best.row, look.overlap.best.column)[:, 0] - EAST_M
    cell_m = look.cells.frame.cell_m
    assert not ((east_m > 100.0 + cell_m) & (east_m < 150.0 - cell_m)).any()
    assert not (east_m > 200.0 + cell_m).any()
    assert (east_m < 100.0).sum() > 100
    assert ((east_m > 150.0) & (east_m < 200.0)).sum() > 50
    (row,) = look.overlap.rows
    assert row["compared_cells"] > row["cells"]
    assert row["median_m"] == pytest.approx(-0.02, abs=2e-4)


def test_only_single_returns_are_compared_and_first_returns_counted(tmp_path: Path) -> None:
    """Second returns are a metre below and would spoil both."""
    paths = []
    for number in (1, 2):
        x, y = lattice(EAST_M, NORTH_M, 60.0, 60.0, 0.5)
        x, y = np.concatenate([x, x]), np.concatenate([y, y])
        second = np.arange(len(x)) >= len(x) // 2
        many = second | (np.arange(len(x)) % 2 == 0)
        z = plane(x, y) + np.where(second, -1.0, np.where(many, 0.5, 0.04 * number))
        columns = {"return_number": 1 + second, "number_of_returns": 1 + many}
        paths.append(write_laz(tmp_path / f"{number}.las", x, y, z, number, **columns))
    look = look_at(paths)
    (row,) = look.overlap.rows
    assert row["median_m"] == pytest.approx(-0.04, abs=2e-4)
    assert row["max_m"] == pytest.approx(0.04, abs=5e-4)
    assert look.strips[0].density == pytest.approx(4.0, rel=0.01)
    assert look.density == pytest.approx(8.0, rel=0.02)
    assert look.strips[0].points == 2 * look.strips[0].pulses


def test_sigmas_are_root_mean_squares_and_unknown_ones_are_counted(tmp_path: Path) -> None:
    x, y = lattice(EAST_M, NORTH_M, 40.0, 40.0, 0.5)
    height = np.where(np.arange(len(x)) % 2, 0.03, 0.05)
    height[:100] = 6.5535
    path = write_laz(tmp_path / "s.laz", x, y, plane(x, y), sigma_m=(0.011, 0.022, height))
    look = look_at([path])
    (strip,) = look.strips
    assert strip.sigma_m is not None
    assert strip.largest_sigma_m is not None
    truth = [0.011, 0.022, math.sqrt((0.03**2 + 0.05**2) / 2)]
    np.testing.assert_allclose(strip.sigma_m, truth, atol=1e-7)
    np.testing.assert_allclose(strip.largest_sigma_m, [0.011, 0.022, 0.05], atol=1e-7)
    assert look.surface.unknown_sigma == 100
    assert look.surface.with_sigma == len(x) - 100
    assert any(note.startswith("100 points have sigmas that are unknown") for note in look.notes)
    assert float(np.nanmax(look.surface.mean(5))) <= 0.0500001


def test_means_of_cells_match_those_of_their_points(tmp_path: Path) -> None:
    x, y = lattice(EAST_M, NORTH_M, 30.0, 30.0, 0.5)
    intensity = (x - EAST_M).astype(int)
    look = look_at([write_laz(tmp_path / "s.las", x, y, plane(x, y), intensity=intensity)], cell_m=5.0)
    assert (look.surface.frame.rows, look.surface.frame.columns) == (6, 6)
    centres = EAST_M + 2.5 + 5.0 * np.arange(6)
    expected = plane(*np.meshgrid(centres, NORTH_M + 2.5 + 5.0 * np.arange(6)))
    np.testing.assert_allclose(look.surface.mean(2), expected, atol=0.002)  # the lattice is not centred on a cell
    np.testing.assert_allclose(look.surface.mean(3)[0], 2.0 + 5.0 * np.arange(6), atol=1e-9)


@pytest.mark.parametrize(
    ("dz_m", "best", "asprs_m"),
    [(0.03, "QL2", 0.05), (0.07, "QL2", 0.10), (0.115, "QL3", 0.15), (0.20, None, None)],
)
def test_quality_levels_follow_density_and_rmsdz(
    tmp_path: Path, dz_m: float, best: str | None, asprs_m: float | None
) -> None:
    """5 pulses per square metre are too few for QL1, whatever dZ is."""
    quality = two_strips(tmp_path, dz_m).agreement.record()
    assert quality["best"] == best
    assert quality["asprs_class_m"] == asprs_m
    within = [level["kept"]["overlap_max_m"] for level in quality["levels"][:4]]
    assert within == [dz_m < limit for limit in (0.08, 0.16, 0.16, 0.32)]


def test_feet_are_converted_to_metres(tmp_path: Path) -> None:
    """EPSG:2994 is in feet; a lattice of a foot has 1 / 0.3048² points per square metre."""
    x, y = lattice(600_000.0, 800_000.0, 300.0, 300.0, 1.0)
    paths = [
        write_laz(tmp_path / f"{n}.laz", x, y, 1000.0 + 0.05 * x + 0.1 * n, n, crs=CRS.from_epsg(2994), scale=0.001)
        for n in (1, 2)
    ]
    look = look_at(paths)
    (row,) = look.overlap.rows
    assert row["median_m"] == pytest.approx(-0.1 * 0.3048, abs=2e-4)
    assert look.strips[0].density == pytest.approx(0.3048**-2, rel=0.01)
    assert look.units.name == "foot"
    assert look.notes == ["no vertical CRS: heights are assumed to be in foot"]


def test_degrees_are_converted_to_metres(tmp_path: Path) -> None:
    x, y = lattice(9.0, 47.0, 2e-4, 2e-4, 2e-6)
    look = look_at([write_laz(tmp_path / "d.las", x, y, 0.0 * x, crs=CRS.from_epsg(4326), scale=1e-8)])
    truth = 1.0 / (2e-6 * 111_320.0) ** 2 / math.cos(math.radians(47.0))
    assert look.strips[0].density == pytest.approx(truth, rel=0.03)


def test_files_without_point_source_ids_are_separate_strips(tmp_path: Path) -> None:
    for name, lift_m in (("north", 0.0), ("south", 0.05)):
        x, y = lattice(EAST_M, NORTH_M, 40.0, 40.0, 0.5)
        write_laz(tmp_path / f"{name}.las", x, y, plane(x, y) + lift_m, 0, point_format=0)  # no GPS time, no CRS
    look = look_at([tmp_path])
    assert look.names == ["north", "south"]
    assert look.overlap.rows[0]["median_m"] == pytest.approx(-0.05, abs=2e-4)
    assert look.notes == ["no CRS in the header: coordinates are assumed to be in metres"]


def test_a_strip_in_two_files_is_one_strip(tmp_path: Path) -> None:
    for number in (0, 1):
        x, y = lattice(EAST_M + 50.0 * number, NORTH_M, 50.0, 40.0, 0.5)
        write_laz(tmp_path / f"tile{number}.laz", x, y, plane(x, y), 7)
    (strip,) = look_at([tmp_path]).strips
    assert (strip.name, strip.points) == ("7", 2 * 100 * 80)
    assert strip.length_m == pytest.approx(100.0, rel=0.05)


def test_noise_and_withheld_points_are_left_out_and_counted(tmp_path: Path) -> None:
    x, y = lattice(EAST_M, NORTH_M, 40.0, 40.0, 0.5)
    number = np.arange(len(x))
    z = plane(x, y) + np.where(number < 30, 500.0, 0.0)
    classes = np.where(number < 10, 7, np.where(number < 20, 18, 2))
    path = write_laz(tmp_path / "n.laz", x, y, z, classification=classes, withheld=(number >= 20) & (number < 30))
    look = look_at([path])
    assert (look.skipped, look.surface.points) == (30, len(x) - 30)
    assert look.surface.high_m[2] < 410.0
    assert any(note.startswith("30 points left out") for note in look.notes)


def test_a_wrong_extent_in_the_header_loses_no_point(tmp_path: Path) -> None:
    x, y = lattice(EAST_M, NORTH_M, 40.0, 40.0, 0.5)
    path = write_laz(tmp_path / "l.las", x, y, plane(x, y))
    raw = bytearray(path.read_bytes())
    raw[179:227] = np.array([EAST_M + 1, EAST_M, NORTH_M + 1, NORTH_M, 401.0, 400.0]).tobytes()
    path.write_bytes(raw)
    look = look_at([path])
    assert look.surface.outside == 0
    assert look.strips[0].density == pytest.approx(4.0, rel=0.01)


@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_the_readable_part_of_a_truncated_file_is_shown_and_reported(tmp_path: Path, suffix: str) -> None:
    x, y = lattice(EAST_M, NORTH_M, 500.0, 400.0, 0.5)
    path = write_laz(tmp_path / f"c.{suffix}", x, y, plane(x, y))
    assert len(x) > BLOCK_POINTS
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * 0.9)])
    if suffix == "laz":  # its table of chunks stands at the end
        with pytest.raises(QuickLookError, match=f"{path}: "):
            look_at([path])
        return
    look = look_at([path])
    assert 0.88 * len(x) < look.surface.points < 0.91 * len(x)
    assert f"of {len(x):,} points could be read" in look.sources[0].damage
    assert any(note.endswith("partial") for note in look.notes)


def test_two_crs_are_refused_naming_both_files(tmp_path: Path) -> None:
    x, y = lattice(EAST_M, NORTH_M, 10.0, 10.0, 0.5)
    for name, code in (("a", 25832), ("b", 25833)):
        write_laz(tmp_path / f"{name}.las", x, y, plane(x, y), crs=CRS.from_epsg(code))
    with pytest.raises(QuickLookError, match=r"b\.las is in ETRS89 / UTM zone 33N, .*a\.las in ETRS89 / UTM zone 32N"):
        look_at([tmp_path])


def test_geocentric_files_are_refused(tmp_path: Path) -> None:
    x, y = lattice(4e6, 6e5, 10.0, 10.0, 0.5)
    path = write_laz(tmp_path / "e.las", x, y, 4.7e6 + 0 * x, crs=CRS.from_epsg(4978), scale=0.01)
    with pytest.raises(QuickLookError, match="geocentric"):
        look_at([path])


def test_a_requested_profile_lies_at_its_requested_place(tmp_path: Path) -> None:
    x, y = lattice(EAST_M, NORTH_M, 60.0, 40.0, 0.5)
    path = write_laz(tmp_path / "s.laz", x, y, plane(x, y))
    ends = (EAST_M + 5.0, NORTH_M + 20.0, EAST_M + 45.0, NORTH_M + 20.0)
    profile = look_at([path], ends=ends).profile
    assert profile is not None
    assert profile.line.length_m == pytest.approx(40.0)
    width_m = 2 * profile.line.half_width_m
    assert len(profile.along_m) == pytest.approx(40.0 * width_m * 4.0, rel=0.15)
    truth = plane(EAST_M + 5.0 + profile.along_m, np.full(len(profile.along_m), NORTH_M + 20.0))
    assert np.abs(profile.height_m - truth).max() <= 0.07 * width_m / 2 + 1e-3
    with pytest.raises(QuickLookError, match="no points within"):
        look_at([path], ends=(0.0, 0.0, 1.0, 1.0))


def test_enlarged_cells_give_the_results_of_larger_cells(
    shifted: Look, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """With memory for few tiles the cells grow; the moments equal those of larger cells from the beginning."""
    monkeypatch.setattr("swath.daemon.processing.quicklook.strips.MOST_TILES", 30)
    look = two_strips(tmp_path, 0.07)
    assert look.cells.frame.cell_m >= 2 * shifted.cells.frame.cell_m
    (row,) = look.overlap.rows
    assert row["median_m"] == pytest.approx(-0.07, abs=1.5e-4)
    assert row["max_m"] == pytest.approx(0.07, abs=1.5e-4)
    assert [strip.pulses for strip in look.strips] == [120_000, 120_000]
    assert sum(float(look.cells.coverage(number).pulses.sum()) for number in (0, 1)) == 240_000


def test_moments_move_with_their_cells() -> None:
    """A quarter of a tile of cells twice as large is compared with moments summed there directly."""
    random = np.random.default_rng(5)
    x, y, z = random.uniform(0.0, TILE, (3, 4000))
    fine, coarse = np.zeros((TILE, TILE, MOMENTS)), np.zeros((TILE // 2, TILE // 2, MOMENTS))
    for into, cell_m in ((fine, 1.0), (coarse, 2.0)):
        up, across = (y // cell_m).astype(int), (x // cell_m).astype(int)
        dx, dy = x - (across + 0.5) * cell_m, y - (up + 0.5) * cell_m
        one = np.ones_like(x)
        columns = (one, one, dx, dy, z, dx * dx, dx * dy, dy * dy, dx * z, dy * z, z * z)
        np.add.at(into, (up, across), np.stack(columns, axis=1))
    np.testing.assert_allclose(_halved(fine.reshape(-1, MOMENTS), 1.0), coarse, atol=1e-9)


def test_tiles_are_stored_only_where_there_are_points() -> None:
    cells = StripCells(Frame(0.0, 0.0, 1.0, 1600, 1600), 0.0)
    assert cells.tiles.shape == (1, 100, 100)
    assert cells.used == 0


def test_an_overflowing_number_of_cells_is_too_many() -> None:
    """With `--cell 1e-9` the product of rows and columns exceeds a 64-bit integer."""
    frame = frame_of(np.array([0.0, 0.0]), np.array([1e4, 1e4]), 1e-9)
    assert 1_000_000 < frame.rows * frame.columns <= 2_000_000


def test_frames_stay_within_two_million_cells() -> None:
    frame = frame_of(np.array([0.0, 0.0]), np.array([1e5, 1e5]), 0.1)
    assert frame.rows * frame.columns <= 2_000_000
    assert frame.cell_m == 80.0
    assert [round_up(size) for size in (0.11, 1.0, 1.01, 7.0, 9.0)] == [0.15, 1.0, 1.5, 8.0, 10.0]


def test_inner_cells_have_all_their_neighbours() -> None:
    there = np.ones((5, 6), bool)
    there[2, 3] = False
    expected = np.zeros((5, 6), bool)
    expected[1:4, 1] = True
    np.testing.assert_array_equal(inner(there), expected)


def test_numbers_can_be_written_as_json(shifted: Look) -> None:
    numbers = json.loads(json.dumps(numbers_of(shifted), allow_nan=False))
    assert numbers["points"] == 240_000
    assert numbers["pairs"][0]["first"] == "1"
