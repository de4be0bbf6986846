"""Tests ray casting against closed forms, SciPy's root finder and independent triangles."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import brentq

from swath.georef.arrays import FloatArray
from swath.sim.scene.scene import Scene
from swath.sim.shots import CAR, GROUND, LEAVES, MARKING, NO_SURFACE, ROAD, ROOF, WALL, WATER, WIRE
from swath.sim.site import geodetic_from_e
from tests.sim.scenes import cast, plan_of, scene_of, towards

pytestmark = pytest.mark.xdist_group("kernels")  # the loops that cast rays are compiled once, by one worker

FAR_M = (3000.0, -2000.0)  # where the ellipsoid's normal leans 0.6 mrad against the site's z


def random_rays(
    seed: int,
    count: int,
    half_m: float = 150.0,
    lift_m: float = 700.0,
    center_m: tuple[float, float] = (0.0, 0.0),
    floor_m: float = 450.0,
) -> tuple[FloatArray, FloatArray]:
    """Return origins and directions of rays that go down to every side, most of them slanting."""
    random = np.random.default_rng(seed)
    target = np.column_stack([random.uniform(-half_m, half_m, (count, 2)) + center_m, np.full(count, floor_m)])
    aside = random.uniform(-2.0, 2.0, (count, 2)) * lift_m
    origin = target + np.column_stack([aside, np.full(count, lift_m)])
    return origin, towards(origin, target)


# --- ground ---------------------------------------------------------------------------------------------------------


def test_a_slope_is_hit_on_its_plane() -> None:
    """Close to the origin the ellipsoid differs from the site's plane only by d²/2R, 0.8 mm at 100 m."""
    scene = scene_of("height_m = 450\nslope_percent = 20\nslope_towards_deg = 90\ncell_m = 2")
    origin, direction = random_rays(1, 500, half_m=50.0, lift_m=100.0)
    slope = 0.2
    height = origin[:, 2] - (450.0 - slope * origin[:, 0])
    expected = height / -(direction[:, 2] + slope * direction[:, 0])
    found = cast(scene, origin, direction)
    hit = origin + found.range_m[:, :1] * direction
    bulge = np.sum(hit[:, :2] ** 2, axis=1) / (2 * 6.37e6)
    tolerance = (bulge + 2.0**2 / (8 * 6.37e6)) / np.abs(direction[:, 2] + slope * direction[:, 0]) + 1e-6
    assert (np.abs(found.range_m[:, 0] - expected) <= tolerance).all()
    normal = np.array([slope, 0.0, 1.0]) / np.hypot(slope, 1.0)
    np.testing.assert_allclose(found.incidence_rad[:, 0], np.arccos(-direction @ normal), rtol=0, atol=2e-5)
    assert (found.surface[:, 0] == GROUND).all()
    assert np.isnan(found.range_m[:, 1:]).all()
    assert (found.surface[:, 1:] == NO_SURFACE).all()


def ray_above(scene: Scene, origin: FloatArray, direction: FloatArray, at: float) -> float:
    """Return a ray's height above the ground, m, at a distance along it."""
    x, y, z = origin + at * direction
    return float(z - scene.site_z(np.array([x]), np.array([y]))[0])


@pytest.mark.parametrize("cell_m", [0.7, 5.0, 60.0])
def test_hills_are_hit_where_a_root_finder_meets_the_bilinear_ground(cell_m: float) -> None:
    scene = scene_of(f"height_m = 450\nrelief_m = 120\nwavelength_m = 150\nslope_percent = 5\ncell_m = {cell_m}")
    origin, direction = random_rays(2, 60)
    found = cast(scene, origin, direction)
    for o, d, at in zip(origin, direction, found.range_m[:, 0], strict=True):
        steps = np.arange(at - 400.0, at + 1.0, 0.05)
        points = o + steps[:, np.newaxis] * d
        below = points[:, 2] < scene.site_z(points[:, 0], points[:, 1])
        first = int(np.argmax(below))
        assert below[first]
        root = brentq(lambda t, o=o, d=d: ray_above(scene, o, d, t), steps[first - 1], steps[first], xtol=1e-12)
        assert abs(at - root) < 1e-7


def test_ranges_end_on_the_bilinear_ground() -> None:
    scene = scene_of("height_m = 450\nrelief_m = 60\nwavelength_m = 90\ncell_m = 3.3", center_m=FAR_M)
    origin, direction = random_rays(3, 20_000, center_m=FAR_M)
    found = cast(scene, origin, direction)
    hit = origin + found.range_m[:, :1] * direction
    met = np.isfinite(found.range_m[:, 0])
    assert met.mean() > 0.9
    assert np.abs(hit[met, 2] - scene.site_z(hit[met, 0], hit[met, 1])).max() < 1e-9


def test_beams_that_point_up_or_leave_the_area_hit_nothing() -> None:
    scene = scene_of("height_m = 450\nrelief_m = 30")
    origin = np.array(
        [[0.0, 0.0, 900.0], [0.0, 0.0, 900.0], [5000.0, 0.0, 900.0], [0.0, 0.0, 400.0], [0.0, 0.0, 900.0]]
    )
    direction = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 0.0, -1.0], [0.0, 0.0, -1.0]])
    found = cast(scene, origin, direction)
    assert np.isfinite(found.range_m[:, 0]).tolist() == [False, False, False, False, True]


# --- buildings ------------------------------------------------------------------------------------------------------

BUILDINGS = """
[[terrain.building]]
center_m = [{x0}, {y0}]
size_m = [14, 9]
heading_deg = 33
roof = "gabled"
roof_pitch_deg = 38
[[terrain.building]]
center_m = [{x1}, {y0}]
size_m = [16, 10]
heading_deg = 110
roof = "hipped"
roof_pitch_deg = 27
eaves_m = 4.5
[[terrain.building]]
center_m = [{x0}, {y1}]
size_m = [20, 12]
heading_deg = -20
roof = "flat"
eaves_m = 9
[[terrain.building]]
center_m = [{x1}, {y1}]
size_m = [8, 13]
heading_deg = 70
roof = "hipped"
roof_pitch_deg = 45
"""
QUADS = [(0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)]


def houses_at(center_m: tuple[float, float]) -> str:
    """Return the text of a plan with four buildings around a place."""
    x, y = center_m
    slope = "height_m = 450\nslope_percent = 4\nslope_towards_deg = 20\n"  # makes a corner the highest ground
    return slope + BUILDINGS.format(x0=x - 15.0, x1=x + 15.0, y0=y - 15.0, y1=y + 15.0)


def up_at(scene: Scene, place: FloatArray) -> FloatArray:
    """Return the ellipsoid's normal in the site's frame, from latitude and longitude."""
    lat, lon, _ = geodetic_from_e(scene.site.e_from_site(place[np.newaxis]))
    normal_e = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])[:, 0]
    up: FloatArray = scene.site.rot_site_from_e @ normal_e
    return up


def triangles_of(
    scene: Scene, center: list[float], size: list[float], heading_deg: float, eaves_m: float, ridge: tuple[float, float]
) -> FloatArray:
    """Return (m, 3, 3) triangles of a building, from its corners; ``ridge`` is height above eaves and half length.

    A ridge lies along the longer side.
    """
    sin, cos = np.sin(np.radians(heading_deg)), np.cos(np.radians(heading_deg))
    half_a, half_b = 0.5 * size[0], 0.5 * size[1]
    ring = [(-half_a, -half_b), (half_a, -half_b), (half_a, half_b), (-half_a, half_b)]
    corners = np.array([[a * sin + b * cos, a * cos - b * sin] for a, b in ring]) + center
    base = np.array([*center, np.max(scene.site_z(corners[:, 0], corners[:, 1]))])
    up = up_at(scene, base)
    along = np.array([sin, cos, 0.0])
    along -= (along @ up) * up
    along /= np.linalg.norm(along)
    right = np.cross(along, up)
    if size[0] < size[1]:
        along, right = right, -along
        ring = [(-half_b, -half_a), (half_b, -half_a), (half_b, half_a), (-half_b, half_a)]

    def point(a: float, b: float, height: float) -> FloatArray:
        there: FloatArray = base + a * along + b * right + height * up
        return there

    points = [point(a, b, -3.0) for a, b in ring] + [point(a, b, eaves_m) for a, b in ring]
    points += [point(end * ridge[1], 0.0, eaves_m + ridge[0]) for end in (-1, 1)]
    faces = [three for a, b, c, d in QUADS for three in ((a, b, c), (a, c, d))]
    faces += [(4, 5, 9), (4, 9, 8), (6, 7, 8), (6, 8, 9), (5, 6, 9), (7, 4, 8)]
    return np.array([[points[index] for index in face] for face in faces])


def nearest_triangle(origin: FloatArray, direction: FloatArray, triangles: FloatArray) -> FloatArray:
    """Return (n,) distances, m, by Möller and Trumbore (1997), infinite where a ray meets no triangle."""
    edge_1, edge_2 = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    cross = np.cross(direction[:, np.newaxis], edge_2)
    determinant = np.einsum("nmx,mx->nm", cross, edge_1)
    offset = origin[:, np.newaxis] - triangles[:, 0]
    u = np.einsum("nmx,nmx->nm", offset, cross) / determinant
    turned = np.cross(offset, edge_1)
    v = np.einsum("nx,nmx->nm", direction, turned) / determinant
    at = np.einsum("nmx,mx->nm", turned, edge_2) / determinant
    inside = (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (at > 0.0)
    distance: FloatArray = np.min(np.where(inside, at, np.inf), axis=1)
    return distance


@pytest.mark.parametrize("center_m", [(0.0, 0.0), FAR_M])
def test_buildings_are_hit_on_their_triangles(center_m: tuple[float, float]) -> None:
    scene = scene_of(houses_at(center_m), 60.0, center_m)
    x, y = center_m
    tan = [np.tan(np.radians(pitch)) for pitch in (38.0, 27.0, 45.0)]
    bodies = [
        triangles_of(scene, [x - 15, y - 15], [14, 9], 33, 6.0, (4.5 * tan[0], 7.0)),
        triangles_of(scene, [x + 15, y - 15], [16, 10], 110, 4.5, (5.0 * tan[1], 3.0)),
        triangles_of(scene, [x - 15, y + 15], [20, 12], -20, 9.0, (0.0, 4.0)),
        triangles_of(scene, [x + 15, y + 15], [8, 13], 70, 6.0, (4.0 * tan[2], 2.5)),
    ]
    floor_m = float(scene.site_z(np.array([x]), np.array([y]))[0])
    origin, direction = random_rays(4, 6000, 32.0, 300.0, center_m, floor_m)
    expected = nearest_triangle(origin, direction, np.concatenate(bodies))
    found = cast(scene, origin, direction)
    built = np.isin(found.surface[:, 0], (ROOF, WALL))
    assert 0.2 < built.mean() < 0.9
    assert np.abs(found.range_m[built, 0] - expected[built]).max() < 1e-6
    assert (expected[~built] > found.range_m[~built, 0]).all()
    assert (found.surface[built, 0] == WALL).mean() > 0.1


def test_incidence_on_a_roof_seen_from_above_is_its_pitch() -> None:
    scene = scene_of(houses_at((0.0, 0.0)))
    along = np.radians(33.0)
    right = np.array([np.cos(along), -np.sin(along)])
    origin = np.array([[*(np.array([-15.0, -15.0]) + 2.0 * side * right), 900.0] for side in (-1, 1)])
    found = cast(scene, origin, np.array([[0.0, 0.0, -1.0]] * 2))
    assert found.surface[:, 0].tolist() == [ROOF, ROOF]
    np.testing.assert_allclose(np.degrees(found.incidence_rad[:, 0]), 38.0, rtol=0, atol=1e-3)


def test_a_footprint_across_an_edge_gives_two_echoes_that_share_the_light() -> None:
    """The beam goes down beside a wall 9 m high; each of its four rim rays has a tenth of the light.

    One or two of them meet the roof.
    """
    scene = scene_of(
        "height_m = 450\n[[terrain.building]]\ncenter_m = [0, 0]\nsize_m = [40, 40]\nroof = 'flat'\neaves_m = 9"
    )
    radius = 0.5 * 1e-3 * 800.0
    x = np.array([20.0 + 0.5 * radius, 20.0 - 0.5 * radius, 20.0 + 2 * radius, 20.0 - 2 * radius])
    origin = np.column_stack([x, np.zeros(4), np.full(4, 1259.0)])
    found = cast(scene, origin, np.tile([0.0, 0.0, -1.0], (4, 1)), divergence_rad=1e-3)
    assert found.surface[:, :2].tolist() == [[ROOF, GROUND], [ROOF, GROUND], [GROUND, 0], [ROOF, 0]]
    np.testing.assert_allclose(found.range_m[:2, 1] - found.range_m[:2, 0], 9.0, rtol=0, atol=2e-3)
    whole_ground, whole_roof = found.reflectance[2, 0], found.reflectance[3, 0]
    np.testing.assert_allclose(found.reflectance[0, :2] / [whole_roof, whole_ground], [0.1, 0.9], rtol=0.15)
    np.testing.assert_allclose(found.reflectance[1, :2] / [whole_roof, whole_ground], [0.9, 0.1], rtol=0.15)
    one = cast(scene, origin[:2], np.tile([0.0, 0.0, -1.0], (2, 1)), divergence_rad=1e-3, pulse_m=20.0)
    assert one.surface[:, :2].tolist() == [[GROUND, 0], [ROOF, 0]]
    np.testing.assert_allclose(one.reflectance[:, 0], found.reflectance[:2].sum(axis=1), rtol=1e-12)


# --- what lets light through ----------------------------------------------------------------------------------------

FOREST = """height_m = 450
[[terrain.forest]]
center_m = [0, 0]
size_m = [300, 300]
trees_per_ha = 300
"""


def test_echoes_of_trees_come_in_order_before_the_ground() -> None:
    scene = scene_of(FOREST)
    origin, direction = random_rays(5, 20_000)
    pulse_m = 0.45
    found = cast(scene, origin, direction, slots=30, pulse_m=pulse_m)
    count = np.isfinite(found.range_m).sum(axis=1)
    assert count.max() >= 4
    assert (count >= 2).mean() > 0.2
    gaps = np.diff(found.range_m, axis=1)
    assert np.nanmin(gaps) >= pulse_m
    last = found.surface[np.arange(len(count)), np.maximum(count - 1, 0)]
    inner = found.surface[:, :-1][np.isfinite(found.range_m[:, 1:])]
    assert (inner == LEAVES).all()
    assert set(last[count > 0]) == {GROUND, LEAVES}


def test_leaves_and_ground_share_the_light() -> None:
    """Each leaf's echo is its share of the light times a reflectance of 0.35 … 0.6; the ground gets the rest."""
    origin, direction = random_rays(6, 20_000)
    wooded = cast(scene_of(FOREST), origin, direction, slots=30, pulse_m=0.0)
    bare = cast(scene_of("height_m = 450"), origin, direction)
    on_ground = wooded.surface == GROUND
    rays = np.flatnonzero(on_ground.any(axis=1) & (bare.surface[:, 0] == GROUND))
    left = wooded.reflectance[on_ground][np.isin(np.flatnonzero(on_ground.any(axis=1)), rays)]
    left = left / bare.reflectance[rays, 0]
    leaves = np.where(wooded.surface == LEAVES, wooded.reflectance, 0.0).sum(axis=1)[rays]
    assert (leaves > 0.0).sum() > 1000
    assert (1.0 - left >= leaves / 0.6 - 1e-9).all()
    assert (1.0 - left <= leaves / 0.35 + 1e-9).all()
    assert left.min() >= 0.03 - 1e-9


def test_transmission_through_a_crown_follows_beer_and_lambert() -> None:
    """Through the middle of a crown of height h the probability of no interception is exp(−rate · h)."""
    scene = scene_of(FOREST)
    apart = np.linalg.norm(scene.trees[:, np.newaxis, :2] - scene.trees[:, :2], axis=2)
    np.fill_diagonal(apart, np.inf)
    middle = scene.trees[np.argmax(apart.min(axis=1))]
    row = scene.arrays.rows
    tree = next(at for at in range(0, len(row) - 6) if row[at] == middle[0] and row[at + 1] == middle[1])
    origin = np.tile([middle[0], middle[1], 900.0], (40_000, 1))
    down = np.tile([0.0, 0.0, -1.0], (40_000, 1))
    found = cast(scene, origin, down, slots=10, pulse_m=0.0)
    alone = (found.surface[:, 0] == GROUND).mean()
    clear = np.exp(-row[tree + 5] * 2.0 / row[tree + 4])
    assert abs(alone - clear) < 4 * np.sqrt(clear / 40_000) + 1e-4
    first = found.range_m[found.surface[:, 0] == LEAVES, 0]
    top = 900.0 - row[tree + 2] - 1.0 / row[tree + 4]
    depth = first - top
    assert depth.min() >= 0.0
    assert depth.max() <= 2.0 / row[tree + 4]
    half = np.log(2.0) / row[tree + 5]
    assert abs((depth < half).mean() - 0.5) < 0.02


def test_a_wire_is_hit_on_its_catenary() -> None:
    """Masts 20 m high, 200 m apart, with a sag of 4 m, leave 16 m in the middle and 17 m half-way to it."""
    scene = scene_of(
        "height_m = 450\n[[terrain.wire]]\nfrom_m = [-100, 0]\nto_m = [100, 0]\n"
        "height_m = 20\nsag_m = 4\ndiameter_m = 0.03"
    )
    x = np.array([0.0, 50.0, 0.0, 0.0])
    aside = np.array([0.0, 0.0, 0.1, 0.4])
    origin = np.column_stack([x, aside, np.full(4, 450.0 + 616.0)])
    down = np.tile([0.0, 0.0, -1.0], (4, 1))
    found = cast(scene, origin, down, divergence_rad=0.5e-3)
    assert found.surface[:, :2].tolist() == [[WIRE, GROUND], [WIRE, GROUND], [WIRE, GROUND], [GROUND, 0]]
    # a chord of 6.06 m hangs at most 4 s² · sag = 3.7 mm above its parabola, and the site's plane 0.8 mm at 100 m
    np.testing.assert_allclose(found.range_m[:3, 0], [600.0, 599.0, 600.0], rtol=0, atol=6e-3)
    foot = 0.25e-3 * 600.0
    share = 2 * foot * 0.03 / (np.pi * foot**2)
    np.testing.assert_allclose(found.reflectance[0, 0], 0.4 * share, rtol=0.01 + 0.015 / foot)
    assert found.reflectance[2, 0] < found.reflectance[0, 0]
    open_ground = cast(scene, origin[3:], down[3:], divergence_rad=0.5e-3).reflectance[0, 0]
    np.testing.assert_allclose(found.reflectance[0, 1], open_ground * (1 - share), rtol=0.12)
    assert cast(scene, origin[:1], down[:1]).surface[0].tolist() == [WIRE, 0, 0, 0, 0]


# --- what moves, what lies on the ground -----------------------------------------------------------------------------


@pytest.mark.parametrize(("time_s", "east_m"), [(0.0, -50.0), (3.0, -20.0), (10.0, 50.0), (13.0, 20.0), (20.0, -50.0)])
def test_a_car_is_at_its_place_at_each_time(time_s: float, east_m: float) -> None:
    """The car drives 100 m at 10 m/s, there and back in 20 s; it is 4.4 m long and 1.5 m high."""
    scene = scene_of("height_m = 450\n[[terrain.car]]\nfrom_m = [-50, 8]\nto_m = [50, 8]\nspeed_mps = 10")
    east = np.arange(-60.0, 60.0, 0.05) + 0.01
    origin = np.column_stack([east, np.full(len(east), 8.3), np.full(len(east), 900.0)])
    found = cast(scene, origin, np.tile([0.0, 0.0, -1.0], (len(east), 1)), time_s=time_s)
    on_car = found.surface[:, 0] == CAR
    assert abs(np.mean(east[on_car]) - east_m) < 0.05
    assert abs(np.sum(on_car) * 0.05 - 4.4) <= 0.1
    np.testing.assert_allclose(found.range_m[on_car, 0], 900.0 - 450.0 - 1.5, rtol=0, atol=1e-3)


def test_few_pulses_return_from_water_and_fewer_at_oblique_incidence() -> None:
    """A tenth returns near nadir, and exp(−tan² i / 0.0235) of that at angle i (slopes of Cox and Munk)."""
    scene = scene_of(
        "height_m = 450\nslope_percent = 3\n[[terrain.water]]\ncenter_m = [0, 0]\nradius_m = 80\nreturns = 0.1"
    )
    count = 20_000
    angle = np.radians(np.repeat([0.0, 5.0, 10.0, 25.0], count))
    direction = np.column_stack([np.sin(angle), np.zeros(len(angle)), -np.cos(angle)])
    origin = np.array([0.0, 10.0, 0.0]) - 800.0 * direction + [0.0, 0.0, 450.0]
    found = cast(scene, origin, direction)
    wet = (found.surface[:, 0] == WATER).reshape(4, count).mean(axis=1)
    expected = 0.1 * np.exp(-(np.tan(np.radians([0.0, 5.0, 10.0, 25.0])) ** 2) / 0.0235)
    np.testing.assert_allclose(wet, expected, rtol=0, atol=4 * np.sqrt(0.1 / count))
    assert set(found.surface[:, 0]) == {NO_SURFACE, WATER}


def test_water_is_level_at_its_lowest_shore() -> None:
    """On a slope of 3 % down to the north, the shore 80 m from the middle is 2.4 m below it."""
    scene = scene_of(
        "height_m = 450\nslope_percent = 3\ncell_m = 2\n[[terrain.water]]\ncenter_m = [0, 0]\n"
        "radius_m = 80\nreturns = 1.0"
    )
    random = np.random.default_rng(3)
    place = random.uniform(-50.0, 50.0, (500, 2))
    origin = np.column_stack([place, np.full(500, 1000.0)])
    found = cast(scene, origin, np.tile([0.0, 0.0, -1.0], (500, 1)))
    wet = found.surface[:, 0] == WATER
    assert wet.mean() > 0.99
    points = origin[wet] - found.range_m[wet, :1] * [0.0, 0.0, 1.0]
    np.testing.assert_allclose(scene.site.heights(points), 450.0 - 2.4, rtol=0, atol=2e-3)


def test_markings_lie_along_the_edges_and_in_dashes_in_the_middle() -> None:
    """The road is 6 m wide with lines of 0.15 m, 0.3 m from either edge, and dashes of 4 m every 12 m."""
    scene = scene_of("height_m = 450\n[[terrain.road]]\npoints_m = [[-90, -20], [90, -20]]\nwidth_m = 6")
    north = np.array([-20.0, -20.0, -17.3, -22.7, -18.5, -17.1, -16.9])
    east = np.array([-90.0 + 24.0 + 2.0, -90.0 + 24.0 + 6.0, 1.0, 1.0, 1.0, 1.0, 1.0])
    origin = np.column_stack([east, north, np.full(7, 900.0)])
    found = cast(scene, origin, np.tile([0.0, 0.0, -1.0], (7, 1)))
    assert found.surface[:, 0].tolist() == [MARKING, ROAD, MARKING, MARKING, ROAD, ROAD, GROUND]
    painted, asphalt = found.reflectance[[0, 2, 3], 0], found.reflectance[[1, 4, 5], 0]
    assert painted.min() > 3 * asphalt.max()


def test_a_crossing_has_no_paint_and_a_road_may_have_none() -> None:
    scene = scene_of(
        "height_m = 450\n[[terrain.road]]\npoints_m = [[-90, 0], [90, 0]]\n"
        "[[terrain.road]]\npoints_m = [[0, -90], [0, 90]]\n[[terrain.road]]\npoints_m = [[-90, 60], [90, 60]]\n"
        "markings = false"
    )
    place = np.array([[0.0, 0.0], [0.0, 2.7], [40.0, 2.7], [40.0, 62.7]])
    origin = np.column_stack([place, np.full(4, 900.0)])
    found = cast(scene, origin, np.tile([0.0, 0.0, -1.0], (4, 1)))
    assert found.surface[:, 0].tolist() == [ROAD, ROAD, MARKING, ROAD]


# --- batches --------------------------------------------------------------------------------------------------------

EVERYTHING = """height_m = 450
relief_m = 20
wavelength_m = 200
[[terrain.village]]
center_m = [-60, 0]
size_m = [150, 150]
houses = 20
[[terrain.forest]]
center_m = [90, 60]
size_m = [100, 150]
[[terrain.water]]
center_m = [90, -90]
radius_m = 40
returns = 0.4
[[terrain.wire]]
from_m = [-150, 60]
to_m = [150, 60]
[[terrain.car]]
from_m = [-100, 3]
to_m = [100, 3]
"""


def test_echoes_do_not_depend_on_how_pulses_are_cut_into_batches() -> None:
    scene = scene_of(EVERYTHING)
    origin, direction = random_rays(7, 30_000)
    time_s, number = np.linspace(0.0, 9.0, 30_000), np.arange(30_000) + 5_000_000_000
    whole = scene.cast(origin, direction, time_s, number, 1e-3, 0.45, 4)
    assert set(np.unique(whole.surface)) >= {NO_SURFACE, GROUND, ROOF, WALL, ROAD, MARKING, WATER, LEAVES, WIRE, CAR}
    turned = np.random.default_rng(8).permutation(30_000)
    for part in np.array_split(turned, [1, 7, 10_000]):
        piece = scene.cast(origin[part], direction[part], time_s[part], number[part], 1e-3, 0.45, 4)
        for name in ("range_m", "reflectance", "incidence_rad", "surface"):
            np.testing.assert_array_equal(getattr(piece, name), getattr(whole, name)[part])


def test_another_seed_gives_other_leaves_on_the_same_trees() -> None:
    one = scene_of(EVERYTHING)
    plan = plan_of(EVERYTHING).with_seed(2)
    from swath.sim.scene.scene import build_scene

    other = build_scene(plan, one.site, one.corners)
    np.testing.assert_array_equal(one.trees, other.trees)
    np.testing.assert_array_equal(one.buildings, other.buildings)
    origin, direction = random_rays(9, 5000)
    first, second = cast(one, origin, direction), cast(other, origin, direction)
    same = first.range_m[:, 0] == second.range_m[:, 0]
    leaves = first.surface[:, 0] == LEAVES
    assert same[first.surface[:, 0] == ROOF].all()
    assert same[leaves].mean() < 0.1


def test_slots_keep_the_first_echoes_and_the_last() -> None:
    scene = scene_of(FOREST)
    origin, direction = random_rays(10, 5000)
    every, three = cast(scene, origin, direction, slots=30), cast(scene, origin, direction, slots=3)
    count = np.isfinite(every.range_m).sum(axis=1)
    many = np.flatnonzero(count > 3)
    assert len(many) > 50
    np.testing.assert_array_equal(three.range_m[many, :2], every.range_m[many, :2])
    np.testing.assert_array_equal(three.range_m[many, 2], every.range_m[many, count[many] - 1])
    few = np.flatnonzero(count <= 3)
    np.testing.assert_array_equal(three.range_m[few], every.range_m[few, :3])
