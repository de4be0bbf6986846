"""Tests ground, villages, forests and control points of scenes, and impossible plans."""

from __future__ import annotations

import re

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from swath.georef.arrays import FloatArray
from swath.sim.plan.errors import PlanError
from swath.sim.scene.objects import build_solids
from swath.sim.scene.scene import build_scene
from swath.sim.scene.terrain import LARGEST_NODES, MARGIN_M, analytic_heights, ups
from swath.sim.scene.village import ROOFS, build_village
from swath.sim.shots import GROUND, MARKING, ROAD, ROOF
from swath.sim.site import Site, geodetic_from_e
from tests.sim.scenes import cast, plan_of, scene_of

pytestmark = pytest.mark.xdist_group("kernels")  # the loops that cast rays are compiled once, by one worker

SQUARE = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])


# --- ground ---------------------------------------------------------------------------------------------------------


def test_ground_has_the_height_of_the_plan_even_far_from_the_origin() -> None:
    """At a distance of 20 km the ellipsoid is 31 m below the site's plane; heights are checked at nodes."""
    scene = scene_of(
        "height_m = 730\nslope_percent = 2\nslope_towards_deg = 250\ncell_m = 20", 300.0, (16_000.0, -12_000.0)
    )
    east = 16_000.0 + np.arange(-200.0, 200.0, 20.0)
    north = -12_000.0 + np.arange(-200.0, 200.0, 20.0)
    towards = np.radians(250.0)
    expected = 730.0 - 0.02 * (east * np.sin(towards) + north * np.cos(towards))
    np.testing.assert_allclose(scene.ground_m(east, north), expected, rtol=0, atol=1e-5)
    assert abs(scene.site_z(east, north)[0] - expected[0] + 20_000.0**2 / (2 * 6.37e6)) < 1.0


def test_ground_between_nodes_is_bilinear_and_ends_at_the_edge() -> None:
    scene = scene_of("relief_m = 50\nwavelength_m = 100\ncell_m = 10")
    at = np.array([0.0, 10.0, 0.0, 10.0]), np.array([0.0, 0.0, 10.0, 10.0])
    z00, z10, z01, z11 = scene.site_z(*at)
    found = scene.site_z(np.array([3.0]), np.array([4.0]))[0]
    assert found == pytest.approx(0.42 * z00 + 0.18 * z10 + 0.28 * z01 + 0.12 * z11, abs=1e-12)
    edge = 200.0 + MARGIN_M
    there, beyond = scene.ground_m(np.array([edge, edge + 500.0]), np.array([0.0, 0.0]))
    assert there == beyond


def test_hills_have_the_height_and_length_of_the_plan() -> None:
    table = plan_of("height_m = 100\nrelief_m = 80\nwavelength_m = 500").tables.terrain
    axis = np.arange(-5000.0, 5000.0, 25.0)
    height = analytic_heights(table)(axis, axis)
    assert 0.8 * 80.0 < np.ptp(height) <= 80.0
    assert analytic_heights(table)(np.zeros(1), np.zeros(1))[0, 0] == 100.0
    power = np.abs(np.fft.rfft2(height - height.mean())) ** 2
    row, column = np.unravel_index(np.argmax(power), power.shape)
    number = np.hypot(np.fft.fftfreq(len(axis), 25.0)[row], np.fft.rfftfreq(len(axis), 25.0)[column])
    assert 1.0 / number == pytest.approx(500.0, rel=0.1)


def test_hills_depend_on_the_terrain_seed_and_not_on_the_flight_seed() -> None:
    text = "relief_m = 80\nseed = {}"
    place = np.linspace(-100.0, 100.0, 7)
    one, other = (scene_of(text.format(seed)).ground_m(place, place) for seed in (1, 2))
    assert np.abs(one - other).max() > 1.0
    plan = plan_of(text.format(1)).with_seed(99)
    again = build_scene(plan, Site.at(*plan.tables.flight.origin_deg), 200.0 * SQUARE)
    np.testing.assert_array_equal(again.ground_m(place, place), one)


def test_up_is_the_normal_of_the_ellipsoid() -> None:
    site = Site.at(47.5, 8.9)
    points = np.array([[0.0, 0.0, 400.0], [9000.0, -4000.0, 1500.0]])
    lat, lon, _ = geodetic_from_e(site.e_from_site(points))
    normal_e = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=1)
    np.testing.assert_allclose(ups(site, points), normal_e @ site.rot_site_from_e.T, rtol=0, atol=1e-9)


def test_error_for_too_fine_a_grid_suggests_a_cell_size() -> None:
    plan = plan_of("cell_m = 0.25")
    site = Site.at(*plan.tables.flight.origin_deg)
    with pytest.raises(
        PlanError, match=r"^terrain\.cell_m: 0\.25 m over 4\.2 × 4\.2 km .* set 0\.8 m or more$"
    ) as error:
        build_scene(plan, site, 2000.0 * SQUARE)
    assert "\n" not in str(error.value)
    assert (4200 / 0.8) ** 2 < LARGEST_NODES < (4200 / 0.7) ** 2


# --- villages -------------------------------------------------------------------------------------------------------

VILLAGE = """height_m = 450
[[terrain.village]]
center_m = [40, -30]
size_m = [400, 300]
heading_deg = 25
houses = 90
"""


def overlap(one: FloatArray, other: FloatArray) -> bool:
    """Return True if two convex polygons overlap, because no side separates them (separating axis theorem)."""
    for polygon in (one, other):
        sides = np.roll(polygon, -1, axis=0) - polygon
        for normal in np.stack([-sides[:, 1], sides[:, 0]], axis=1):
            first, second = one @ normal, other @ normal
            if first.max() < second.min() or second.max() < first.min():
                return False
    return True


def test_houses_do_not_overlap_and_keep_off_the_streets() -> None:
    scene = scene_of(VILLAGE, 300.0)
    houses = scene.buildings
    assert len(houses) == 90
    for k, house in enumerate(houses):
        assert not any(overlap(house, other) for other in houses[:k])
        assert ConvexHull(house).volume > 30.0
    for road in scene.roads:
        ends = np.array(road.points_m)
        along = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
        normal = np.array([-along[1], along[0]])
        for house in houses:
            beside = (house - ends[0]) @ normal
            reach = (house - ends[0]) @ along
            if reach.max() > 0.0 and reach.min() < np.linalg.norm(ends[1] - ends[0]):
                assert beside.min() > 0.5 * road.width_m or beside.max() < -0.5 * road.width_m


def test_a_village_has_houses_of_many_kinds_within_its_bounds() -> None:
    table = plan_of(VILLAGE).tables.terrain.village[0]
    houses, streets = build_village(table, 1, 0)
    assert len(houses) == 90
    assert {ROOFS[index] for index in houses.roof} == set(ROOFS)
    assert np.degrees(houses.pitch_rad).min() >= 20.0
    assert np.degrees(houses.pitch_rad).max() <= 45.0
    turned = np.degrees(houses.heading_rad) - 25.0
    quarter = np.rint(turned / 90.0)
    assert set(quarter) == {0.0, 1.0}
    assert np.abs(turned - 90.0 * quarter).max() <= 10.0 + 1e-9
    assert np.std(turned - 90.0 * quarter) > 2.0
    heading = np.radians(25.0)
    offset = houses.center_m - table.center_m
    assert np.abs(offset @ [np.sin(heading), np.cos(heading)]).max() <= 150.0
    assert np.abs(offset @ [np.cos(heading), -np.sin(heading)]).max() <= 200.0
    directions = {round(np.degrees(np.arctan2(*np.diff(street.points_m, axis=0)[0])) % 180.0) for street in streets}
    assert directions == {25, 115}


def test_roofs_face_every_side() -> None:
    """Calibration needs planes that lean to the four sides of the village."""
    houses, _ = build_village(plan_of(VILLAGE).tables.terrain.village[0], 1, 0)
    planes = build_solids(houses, scene_of(VILLAGE, 300.0).ground, 1).plane
    roofs = planes[(planes[:, 4] == ROOF) & (planes[:, 2] < 0.99)]
    aspect = np.degrees(np.arctan2(roofs[:, 0], roofs[:, 1])) - 25.0
    counted = np.bincount(np.rint(aspect / 90.0).astype(int) % 4, minlength=4)
    assert counted.min() >= 10


def test_error_for_too_many_houses_names_the_key_and_the_possible_number() -> None:
    text = "[[terrain.village]]\ncenter_m = [0, 0]\nsize_m = [100, 100]\nhouses = 500"
    with pytest.raises(
        PlanError, match=r"^terrain\.village\[0\]\.houses: 500 do not fit .* set at most (\d+)"
    ) as error:
        scene_of(text)
    most = re.search(r"at most (\d+)", str(error.value))
    assert most is not None
    assert len(scene_of(text.replace("500", most[1])).buildings) == int(most[1])


def test_streets_are_asphalt_with_paint() -> None:
    scene = scene_of(VILLAGE, 300.0)
    (ax, ay), (bx, by) = scene.roads[0].points_m
    share = np.linspace(0.0, 1.0, 400)
    origin = np.column_stack([ax + share * (bx - ax), ay + share * (by - ay), np.full(400, 900.0)])
    found = cast(scene, origin, np.tile([0.0, 0.0, -1.0], (400, 1)))
    assert set(found.surface[:, 0]) == {ROAD, MARKING}


# --- what is left out -----------------------------------------------------------------------------------------------


def test_objects_beyond_the_area_are_omitted() -> None:
    scene = scene_of(
        "[[terrain.building]]\ncenter_m = [5000, 0]\nsize_m = [10, 10]\n"
        "[[terrain.building]]\ncenter_m = [50, 0]\nsize_m = [10, 10]\n"
        "[[terrain.wire]]\nfrom_m = [0, 0]\nto_m = [5000, 0]\n"
        "[[terrain.car]]\nfrom_m = [0, 0]\nto_m = [5000, 0]\n"
        "[[terrain.water]]\ncenter_m = [5000, 0]\nradius_m = 50\n"
        "[[terrain.forest]]\ncenter_m = [5000, 0]\nsize_m = [50, 50]\n"
    )
    counts = [len(things) for things in (scene.buildings, scene.wires, scene.cars, scene.waters, scene.trees)]
    assert counts == [1, 0, 0, 0, 0]


def test_trees_keep_off_houses_roads_and_water() -> None:
    scene = scene_of(
        "[[terrain.building]]\ncenter_m = [0, 0]\nsize_m = [30, 20]\n"
        "[[terrain.water]]\ncenter_m = [60, 60]\nradius_m = 30\n"
        "[[terrain.road]]\npoints_m = [[-150, -50], [150, -50]]\n"
        "[[terrain.forest]]\ncenter_m = [0, 0]\nsize_m = [300, 300]\ntrees_per_ha = 400"
    )
    x, y, radius = scene.trees.T
    assert 2000 < len(x) < 3600
    assert (np.hypot(x - 60.0, y - 60.0) >= 30.0 + radius).all()
    assert (np.abs(y + 50.0) >= 3.0 + radius).all()
    assert (np.hypot(np.maximum(np.abs(x) - 10.0, 0.0), np.maximum(np.abs(y) - 15.0, 0.0)) >= radius).all()


def test_a_forest_has_the_number_of_trees_of_the_plan() -> None:
    scene = scene_of("[[terrain.forest]]\ncenter_m = [10, -20]\nsize_m = [200, 100]\ntrees_per_ha = 150\nheight_m = 18")
    assert len(scene.trees) == 300
    assert np.abs(scene.trees[:, 0] - 10.0).max() <= 100.0
    assert np.abs(scene.trees[:, 1] + 20.0).max() <= 50.0
    down = np.tile([0.0, 0.0, -1.0], (300, 1))
    found = cast(scene, np.column_stack([scene.trees[:, :2], np.full(300, 900.0)]), down)
    top = 900.0 - found.range_m[:, 0] - scene.site_z(scene.trees[:, 0], scene.trees[:, 1])
    assert top.max() <= 1.4 * 18.0
    assert 12.0 < np.median(top) < 20.0


# --- control points -------------------------------------------------------------------------------------------------


def test_control_points_lie_on_open_ground() -> None:
    scene = scene_of(
        VILLAGE + "[[terrain.forest]]\ncenter_m = [-200, 200]\nsize_m = [150, 150]\n"
        "[[terrain.water]]\ncenter_m = [200, 200]\nradius_m = 50\n", 300.0,
    )  # fmt: skip
    points = scene.control_points(40, 7)
    assert points.shape == (40, 3)
    np.testing.assert_array_equal(points[:, 2], scene.site_z(points[:, 0], points[:, 1]))
    assert np.abs(points[:, :2]).max() <= 300.0
    apart = np.linalg.norm(points[:, np.newaxis, :2] - points[:, :2], axis=2) + 1e9 * np.eye(40)
    assert apart.min() > 20.0
    aside = np.array([[0.0, 0.0], [3.9, 0.0], [-3.9, 0.0], [0.0, 3.9], [0.0, -3.9]])
    above = (points[:, np.newaxis] + np.column_stack([aside, np.full(5, 500.0)])).reshape(-1, 3)
    found = cast(scene, above, np.tile([0.0, 0.0, -1.0], (len(above), 1)))
    assert set(found.surface[:, 0]) <= {GROUND, ROAD, MARKING}
    np.testing.assert_allclose(found.range_m[::5, 0], 500.0, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(scene.control_points(40, 7), points)
    assert (scene.control_points(40, 8) != points).any()


def test_control_points_lie_on_flatter_ground() -> None:
    scene = scene_of("relief_m = 60\nwavelength_m = 200", 400.0)
    random = np.random.default_rng(1).uniform(-400.0, 400.0, (2000, 2))
    slope = scene.ground.slope(random[:, 0], random[:, 1])
    points = scene.control_points(25, 1)
    assert scene.ground.slope(points[:, 0], points[:, 1]).max() < 1.1 * np.median(slope)


def test_error_for_control_points_without_room_names_the_key() -> None:
    scene = scene_of("[[terrain.water]]\ncenter_m = [0, 0]\nradius_m = 290")
    with pytest.raises(PlanError, match=r"^control\.points: the open ground has no room for 10; set at most \d+$"):
        scene.control_points(10, 1)
    assert scene.control_points(0, 1).shape == (0, 3)


def test_a_wide_area_gets_larger_cells_and_the_same_echoes(monkeypatch: pytest.MonkeyPatch) -> None:
    text = VILLAGE + "[[terrain.forest]]\ncenter_m = [-200, 200]\nsize_m = [150, 150]\n"
    fine = scene_of(text, 300.0)
    monkeypatch.setattr("swath.sim.scene.cells.MOST_CELLS", 50)
    coarse = scene_of(text, 300.0)
    assert fine.arrays.frame.size == 20.0
    assert coarse.arrays.frame.size == 120.0
    random = np.random.default_rng(2)
    origin = np.column_stack([random.uniform(-300.0, 300.0, (5000, 2)), np.full(5000, 900.0)])
    down = np.tile([0.6, 0.0, -0.8], (5000, 1))
    for name in ("range_m", "reflectance", "surface"):
        np.testing.assert_array_equal(*(getattr(cast(one, origin, down), name) for one in (fine, coarse)))
