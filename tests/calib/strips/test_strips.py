"""Tests residual strip errors against independent arithmetic and FORMULAS' printed numbers, and verdicts."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial import Delaunay

from swath.calib.flight import Flight
from swath.calib.planes.local import plane_through
from swath.calib.strips.cells import Cells, FlightStrip, Gathered, StripRules, numbers_of, overlap_cells, thinned
from swath.calib.strips.differences import Numbers, StripReport, differences, report_of
from swath.calib.strips.standards import ASPRS_2014, USGS, best_of, judge
from swath.georef.arrays import FloatArray
from tests.calib.surface_flight import FRAME, surface_flight, swath_of

pytestmark = pytest.mark.xdist_group("kernels")

RULES = StripRules(cell_m=2.0)

# FORMULAS 8 [chk 8.*]: a noisy patch of normal (0.3, −0.1, 1) and a point 0.12 m above it, as their script draws them
PATCH = np.array(
    [
        [float(value) for value in row.split(",")]
        for row in """
    1.0359,-0.7222,-0.3769 -1.8297,1.1976,0.6713 -0.5415,-1.3384,0.0416 -0.3218,-2.8147,-0.1782
    1.9733,-1.7403,-0.7541 -0.7018,-2.2249,-0.0155 0.4737,2.7601,0.1366 -0.7079,2.8155,0.4959
    -1.1414,2.3882,0.5939 -2.1976,-2.5098,0.4111 -1.3064,0.1420,0.4150 2.5189,0.3654,-0.7195
    1.8866,-2.1444,-0.7757 -0.0405,1.6557,0.1842 -0.8693,-1.2593,0.1333 0.9675,-1.2421,-0.4266
    1.7995,2.6721,-0.2645 -2.0780,-1.8623,0.4266 -0.1671,-1.5128,-0.1024 -0.0230,2.8299,0.2777
    -2.3084,-2.7175,0.4352 2.6025,0.0208,-0.7727 -2.9314,0.9048,0.9735 -1.7799,-0.3189,0.4888
    2.6841,-0.7156,-0.8843 -2.6830,-1.9851,0.6084 -2.5166,2.9080,1.0492 -1.3814,2.8758,0.7113
    -0.5846,2.8384,0.4623 2.4280,1.3682,-0.5909 -1.4113,1.5142,0.5639 -2.0508,-0.4034,0.5723
    0.7308,1.0543,-0.1229 -0.2898,-1.4860,-0.0512 0.1349,0.0249,-0.0431 -2.7555,-2.5476,0.5841
    -2.6132,2.2384,1.0053 0.3918,-0.1825,-0.1361 1.8298,-0.4853,-0.5821 0.1376,1.1430,0.0573
""".split()
    ]
)
POINT = np.array([0.4, -0.7, -0.07])


def level(east: FloatArray, north: FloatArray) -> FloatArray:
    """Return the heights of flat ground."""
    return np.zeros_like(east + north)


def in_one_cell(first: FloatArray, second: FloatArray) -> Gathered:
    """Return the returns of two strips in one cell."""
    strip = np.repeat([0, 1], [len(first), len(second)])
    count = len(strip)
    times = np.arange(count, dtype=np.int64) * 1_000_000
    direction = np.where(np.arange(count) % 2, 1, -1).astype(np.int8)
    return Gathered(np.zeros(count, np.int64), strip, np.concatenate([first, second]), times, direction)


def patch_at(height_m: float, *, slope: float = 0.0, noise_m: float = 0.0, seed: int = 0) -> FloatArray:
    """Return twenty returns in a cell of 2 m."""
    draws = np.random.default_rng(seed)
    places = draws.uniform(-1.0, 1.0, (20, 2))
    return np.column_stack([places, height_m + slope * places[:, 0] + draws.normal(0.0, 1.0, 20) * noise_m])


def compared(first: FloatArray, second: FloatArray, rules: StripRules = RULES) -> StripReport:
    """Return the comparison of two patches."""
    return report_of(["a", "b"], in_one_cell(first, second), rules, 2.0)


# ---------------------------------------------------------------------- the printed numbers


def test_point_to_plane_distances_match_the_printed_numbers() -> None:
    plane = plane_through(PATCH)
    assert round(plane.distance_m(POINT), 4) == 0.1125
    assert round(plane.above_m(POINT), 4) == 0.1180


def test_strip_differences_match_the_printed_numbers() -> None:
    near = POINT + 0.02 * np.array([[1, 0, -0.3], [0, 1, 0.1], [-1, 0, 0.3], [0, -1, -0.1], [1, 1, -0.2], [0, 0, 0]])
    wide = np.array([[2.0, 0, -0.6], [0, 2.0, 0.2], [-2.0, 0, 0.6], [0, -2.0, -0.2], [2.0, 2.0, -0.4]]) + POINT
    centre = PATCH.mean(axis=0)
    around = np.concatenate([wide, near[-1:]])
    assert np.hypot(*(near[-1, :2] - centre[:2])) < np.hypot(*(wide[:, :2] - centre[:2]).T).min()
    report = report_of(["a", "b"], in_one_cell(around, PATCH), RULES, 6.0)
    assert report.checks.distance_m == pytest.approx([0.1125], abs=5e-5)
    assert report.checks.height_m == pytest.approx([0.1180], abs=5e-5)


# ---------------------------------------------------------------------- what is compared


def _width_m(points: FloatArray) -> float:
    """Return the spread (one sigma), m, of a patch across its longest direction."""
    return float(np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[1]) / math.sqrt(len(points))


def test_every_check_matches_a_plain_computation() -> None:
    draws = np.random.default_rng(8)
    cells, strips, points = [], [], []
    for cell in range(30):
        for strip in range(3):
            places = draws.uniform(0.0, 2.0, (draws.integers(4, 25), 2)) + np.array([2.0 * cell, 0.0])
            up = 0.3 * places[:, 0] - 0.2 * places[:, 1] + 0.05 * strip + draws.normal(0.0, 0.02, len(places))
            cells += [cell] * len(places)
            strips += [strip] * len(places)
            points += np.column_stack([places, up]).tolist()
    count = len(points)
    gathered = Gathered(
        np.array(cells), np.array(strips), np.array(points), np.arange(count) * 7, np.ones(count, np.int8)
    )
    report = report_of(["a", "b", "c"], gathered, StripRules(cell_m=2.0, roughest_m=0.1), 2.0)
    told = {
        (int(point[0] // 2.0), first, second): (d, dz)
        for point, first, second, d, dz in zip(
            report.checks.centre,
            report.checks.first,
            report.checks.second,
            report.checks.distance_m,
            report.checks.height_m,
            strict=True,
        )
    }
    seen = 0
    for cell in range(30):
        own = {strip: gathered.points[(gathered.cell == cell) & (gathered.strip == strip)] for strip in range(3)}
        for first, second in ((0, 1), (0, 2), (1, 2)):
            a, b = own[first], own[second]
            if min(len(a), len(b)) < 6 or min(_width_m(a), _width_m(b)) < 0.25:
                assert (cell, first, second) not in told
                continue
            centre = b.mean(axis=0)
            _, _, vt = np.linalg.svd(b - centre)
            normal = vt[2] * np.sign(vt[2, 2])
            point = a[np.argmin(np.hypot(*(a[:, :2] - centre[:2]).T))]
            inside = Delaunay(b[:, :2]).find_simplex(point[:2]) >= 0
            assert ((cell, first, second) in told) == bool(inside)
            if inside:
                d = float(normal @ (point - centre))
                assert told[cell, first, second] == pytest.approx((d, d / normal[2]), abs=1e-9)
                seen += 1
    assert seen > 60
    assert len(told) == seen


@pytest.mark.parametrize(
    ("first", "second", "reason"),
    [
        (patch_at(0.0)[:5], patch_at(0.0), "too few returns"),
        (patch_at(0.0, noise_m=0.2), patch_at(0.0), "too rough"),
        (patch_at(0.0), patch_at(0.0, noise_m=0.2), "too rough"),
        (patch_at(0.0), patch_at(0.0, slope=1.2), "too steep"),
        (patch_at(0.0), patch_at(0.0) * [1.0, 0.02, 1.0], "returns in a line"),
        (patch_at(0.0) + np.array([5.0, 0.0, 0.0]), patch_at(0.0), "not within the returns"),
    ],
)
def test_non_planar_overlap_is_refused_by_reason(first: FloatArray, second: FloatArray, reason: str) -> None:
    assert len(compared(patch_at(0.0), patch_at(0.0, seed=1)).checks) == 1
    report = compared(first, second)
    assert len(report.checks) == 0
    assert report.refused == {reason: 1}


def test_a_higher_second_strip_gives_a_negative_difference() -> None:
    report = differences(surface_flight([level, lambda e, n: level(e, n) + 0.07], noise_m=0.02), RULES)
    (pair,) = report.pairs
    assert (pair.first, pair.second) == ("01", "02")
    assert pair.distance.mean_m == pytest.approx(-0.07, abs=0.002)
    assert pair.distance.std_m == pytest.approx(0.02, rel=0.1)
    assert pair.distance.rms_m**2 == pytest.approx(pair.distance.mean_m**2 + pair.distance.std_m**2)
    assert pair.distance.max_m == np.abs(report.checks.distance_m).max() > 0.1
    assert pair.noise_m == pytest.approx(0.0206, rel=0.03)  # 2 cm of the point, and 2 cm / √16 of the plane
    assert pair.systematic_m == pytest.approx(0.07, abs=0.002)
    assert report.roughness_m["01"] == pytest.approx(0.02, rel=0.02)


def test_height_differences_use_gentle_slopes_only() -> None:
    def roof(east: FloatArray, north: FloatArray) -> FloatArray:
        return np.where(east > 0.0, 0.5 * east, 0.0) + 0.0 * north

    flight = surface_flight([roof, lambda e, n: roof(e - 0.2, n)], noise_m=0.005)
    report = differences(flight, RULES)
    assert report.all.height.count < 0.6 * report.all.distance.count
    assert report.all.height.mean_m == pytest.approx(0.0, abs=0.003)
    steep = report.checks.take(~report.checks.gentle)
    assert float(np.median(steep.height_m)) == pytest.approx(0.1, abs=0.005)  # 0.2 m along a slope of one half
    assert float(np.median(steep.distance_m)) == pytest.approx(0.1 / math.hypot(1.0, 0.5), abs=0.005)


def test_pulses_with_several_returns_are_ignored() -> None:
    made = surface_flight([level, level])
    points = made.swaths[1].points_t + np.array([0.0, 0.0, 0.3])
    both = np.concatenate([made.swaths[1].points_t, points])
    returns = np.repeat([1, 2], len(points)).astype(np.uint8)
    flight = Flight(FRAME, (), (), (made.swaths[0], swath_of(both, 2, returns)))
    report = differences(flight, RULES)
    assert report.all.distance.mean_m == pytest.approx(0.0, abs=0.002)
    assert report.refused["too rough"] == 0


def test_strips_that_do_not_overlap_give_no_pair() -> None:
    made = surface_flight([level, level], half_m=10.0)
    away = swath_of(made.swaths[1].points_t + np.array([500.0, 0.0, 0.0]), 2)
    report = differences(Flight(FRAME, (), (), (made.swaths[0], away)), RULES)
    assert report.pairs == ()
    assert report.all.distance.count == 0
    assert math.isnan(report.all.distance.rms_m)
    assert differences(Flight(FRAME, (), (), ()), RULES).pairs == ()


def test_returns_without_coordinates_are_dropped() -> None:
    made = surface_flight([level, level], half_m=10.0)
    holed = made.swaths[1].points_t.copy()
    holed[::3] = np.nan
    report = differences(Flight(FRAME, (), (), (made.swaths[0], swath_of(holed, 2))), RULES)
    assert report.all.distance.count > 30
    assert np.isfinite(report.checks.distance_m).all()


# ---------------------------------------------------------------------- cells


def test_cells_have_distinct_numbers_on_all_sides_of_zero() -> None:
    east, north = np.meshgrid(np.arange(-5, 5), np.arange(-5, 5))
    places = np.column_stack([east.ravel() + 0.5, north.ravel() + 0.5])
    assert len(np.unique(numbers_of(places, 1.0))) == 100
    assert len(np.unique(numbers_of(places + 0.4, 1.0))) == 100
    assert len(np.unique(numbers_of(places * 0.5, 1.0))) == 36


def test_at_most_the_requested_number_of_overlap_cells_is_taken() -> None:
    made = surface_flight([level, level], half_m=20.0)
    beside = swath_of(made.swaths[1].points_t + np.array([20.0, 0.0, 0.0]), 2)
    strips = [FlightStrip(made.swaths[0]), FlightStrip(beside)]
    cells = overlap_cells(strips, RULES)
    assert len(cells.numbers) == pytest.approx(10 * 20, rel=0.2)
    assert (np.diff(cells.numbers) > 0).all()
    few = thinned(cells, StripRules(cell_m=2.0, most_cells=50))
    assert len(few.numbers) == 50
    assert np.isin(few.numbers, cells.numbers).all()
    assert (few.numbers == thinned(cells, StripRules(cell_m=2.0, most_cells=50)).numbers).all()


def test_the_cell_size_follows_the_sparsest_strip() -> None:
    dense, thin = surface_flight([level], step_m=0.5), surface_flight([level], step_m=1.0)
    strips = [FlightStrip(dense.swaths[0]), FlightStrip(thin.swaths[0])]
    assert overlap_cells(strips, StripRules()).cell_m == pytest.approx(4.0, rel=0.1)  # 16 returns at 1 per m²
    assert overlap_cells(strips[:1], StripRules()).cell_m == pytest.approx(2.0, rel=0.1)


def test_empty_cells_give_an_empty_report() -> None:
    report = report_of(["a"], in_one_cell(np.zeros((0, 3)), np.zeros((0, 3))), RULES, 2.0)
    assert len(report.checks) == 0
    assert Cells(1.0, np.zeros(0, np.int64)).cell_m == 1.0
    assert Numbers.of(np.zeros(0)).count == 0


# ---------------------------------------------------------------------- verdicts


@pytest.mark.parametrize(
    ("rms_m", "max_m", "best", "asprs"),
    [
        (0.03, 0.07, "QL0", "5 cm"),
        (0.03, 0.09, "QL1", "10 cm"),
        (0.041, 0.08, "QL1", "10 cm"),
        (0.081, 0.16, "QL3", "15 cm"),
        (0.2, 0.3, None, "20 cm"),
        (9.0, 9.0, None, "20 cm"),
    ],
)
def test_a_quality_level_is_met_if_rms_and_largest_difference_are_within_limits(
    rms_m: float, max_m: float, best: str | None, asprs: str
) -> None:
    judged = judge(overlap_rms_m=rms_m, overlap_max_m=max_m)
    assert best_of(judged) == best
    assert (judged[-1].standard, judged[-1].level) == (ASPRS_2014, asprs)
    assert judged[-1].all_kept is (best is not None)
    assert [one.level for one in judged if one.standard == USGS] == ["QL0", "QL1", "QL2", "QL3"]


def test_repeatability_is_not_judged_by_the_limit_of_the_largest_difference() -> None:
    judged = judge(overlap_rms_m=0.02, overlap_max_m=0.05, within_rms_m=0.029)
    assert judged[-1].kept["within_m"] is None
    assert judged[0].kept["within_m"] is True


def test_unmeasured_figures_are_neither_met_nor_missed() -> None:
    judged = judge(overlap_rms_m=None)
    assert best_of(judged) is None
    assert all(kept is None for one in judged for kept in one.kept.values())


def test_density_limits_are_minima_and_height_limits_are_maxima() -> None:
    judged = {one.level: one for one in judge(overlap_rms_m=0.01, pulses_m2=2.5, rmse_z_m=0.07, within_rms_m=0.02)}
    assert judged["QL1"].kept == {
        "pulses_m2": False,
        "within_m": True,
        "overlap_m": True,
        "overlap_max_m": None,
        "rmse_z_m": True,
    }
    assert judged["QL0"].kept["rmse_z_m"] is False
    assert best_of(tuple(judged.values())) == "QL2"
