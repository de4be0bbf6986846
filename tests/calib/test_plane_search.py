"""Tests the planes found against the scene of the flight: what they consist of, and what is left out."""

from __future__ import annotations

from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from swath.calib.features import Features, Plane
from swath.calib.flight import Flight
from swath.calib.planes.fit import fit_sight
from swath.calib.planes.kernels import GOOD, MOMENTS, accumulate, fill_table, fit_cells, gather, grow
from swath.calib.planes.search import PlaneError, PlaneSettings, find_planes, given_planes, plane_rows
from swath.georef.arrays import FloatArray, Int64Array
from swath.sim.shots import CAR, GROUND, LEAVES, MARKING, ROAD, ROOF, WALL, WATER
from tests.calib.cast_flight import Cast, Line, cast_flight

pytestmark = pytest.mark.xdist_group("kernels")

LINES: tuple[Line, ...] = ((-140, 0, 140, 0, 850), (140, 50, -140, 50, 850), (0, 140, 0, -140, 850))
TERRAIN = """
height_m = 450.0
relief_m = 10.0
wavelength_m = 300.0
[[terrain.village]]
center_m = [0.0, 0.0]
size_m = [150.0, 120.0]
heading_deg = 25.0
houses = 14
[[terrain.building]]
center_m = [-110.0, 20.0]
size_m = [40.0, 20.0]
heading_deg = 20.0
roof_pitch_deg = 30.0
[[terrain.building]]
center_m = [-110.0, 60.0]
size_m = [16.0, 10.0]
heading_deg = 90.0
[[terrain.building]]
center_m = [-110.0, 71.0]
size_m = [16.0, 10.0]
heading_deg = 90.0
[[terrain.water]]
center_m = [100.0, -70.0]
radius_m = 30.0
[[terrain.forest]]
center_m = [110.0, 80.0]
size_m = [60.0, 60.0]
trees_per_ha = 300.0
[[terrain.car]]
from_m = [-20.0, -100.0]
to_m = [40.0, -100.0]
speed_mps = 0.0
"""


@pytest.fixture(scope="module")
def cast() -> Cast:
    return cast_flight(TERRAIN, LINES, prf_hz=50_000.0)


@pytest.fixture(scope="module")
def flight(cast: Cast) -> Flight:
    return cast.at_truth()


@pytest.fixture(scope="module")
def found(flight: Flight) -> Features:
    return find_planes(flight)


def of_kind(features: Features, kind: str) -> list[Plane]:
    return [plane for plane in features.planes if plane.kind == kind]


def made_of(cast: Cast, plane: Plane) -> Int64Array:
    """Return (10,) numbers of returns by surface."""
    parts = [np.bincount(cast.surface[patch.swath][patch.at], minlength=10) for patch in plane.patches]
    counts: Int64Array = np.sum(parts, axis=0)
    return counts


def true_face(cast: Cast, plane: Plane) -> tuple[int, float]:
    """Return the plane of the scene that most returns lie on, and the least share of a swath's returns that do."""
    shares = np.array([cast.faces(patch.swath, patch.at).mean(axis=0) for patch in plane.patches])
    face = int(np.argmax(shares.mean(axis=0)))
    return face, float(shares[:, face].min())


def built_roofs(cast: Cast, features: Features) -> list[tuple[Plane, int, float]]:
    """Return roofs that are roofs of the scene, with their faces; steep banks are planes too."""
    roofs = [plane for plane in of_kind(features, "roof") if made_of(cast, plane)[ROOF] > 0]
    return [(plane, *true_face(cast, plane)) for plane in roofs]


# --- what is found --------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_roof_is_one_face_of_the_scene_and_has_its_direction(cast: Cast, found: Features) -> None:
    roofs = built_roofs(cast, found)
    assert len(roofs) > 20
    angles, offsets = [], []
    for plane, face, share in roofs:
        assert share > 0.99, plane.name  # returns from beyond the ridge would lower every roof
        assert made_of(cast, plane)[ROOF] > 0.97 * plane.points, plane.name
        true = cast.planes[face]
        angles.append(np.degrees(np.arccos(min(1.0, float(plane.normal_t @ true[:3])))))
        offsets.append(float(true[:3] @ plane.centre_t - true[3]) / (plane.rms_m / np.sqrt(plane.points)))
    assert np.median(angles) < 0.06
    assert max(angles) < 0.4
    assert np.abs(offsets).max() < 4.0
    assert 0.7 < np.sqrt(np.mean(np.square(offsets))) < 1.3


def test_errors_of_normals_are_as_large_as_their_sigmas(cast: Cast, flight: Flight, found: Features) -> None:
    """Errors of each swath's own normals are compared with their sigmas in two components of different sigma."""
    ratios = []
    for plane, face, share in built_roofs(cast, found):
        for patch in plane.patches:
            sight = fit_sight(flight, flight.swaths[patch.swath], patch.at, PlaneSettings())
            if share > 0.98 and sight is not None:
                angle = np.arccos(min(1.0, float(sight.normal_t @ cast.planes[face, :3])))
                ratios.append(float(angle) / sight.normal_sigma_rad)
    assert len(ratios) > 30
    assert 0.7 < np.sqrt(np.mean(np.square(ratios))) < 1.5


def test_almost_every_large_roof_is_found(cast: Cast, flight: Flight, found: Features) -> None:
    faces = {face for _, face, _ in built_roofs(cast, found)}
    seen: Counter[int] = Counter()
    for index in range(len(flight.swaths)):
        roof = np.flatnonzero(cast.surface[index] == ROOF)
        on = cast.faces(index, roof)
        seen.update(np.flatnonzero((on.sum(axis=0) > 80) & (cast.planes[:, 4] == ROOF)).tolist())
    large = {face for face, swaths in seen.items() if swaths == 3 and cast.planes[face, 2] < np.cos(np.radians(10.0))}
    assert len(large) > 15
    assert len(large & faces) >= 0.95 * len(large)


def test_two_neighbouring_roofs_with_equal_slope_are_two_planes(cast: Cast, found: Features) -> None:
    faces = Counter(face for plane, face, _ in built_roofs(cast, found) if plane.centre_t[0] < -98.0)
    alike = [
        (one, other)
        for one in faces
        for other in faces
        if one < other and cast.planes[one, :3] @ cast.planes[other, :3] > 0.9999
    ]
    assert alike  # both faces were found, and by `true_face` no plane mixes them


def test_trees_water_walls_and_cars_give_no_planes(cast: Cast, found: Features) -> None:
    total = np.sum([made_of(cast, plane) for plane in found.planes], axis=0)
    assert min((surface == LEAVES).sum() for surface in cast.surface) > 1000
    assert total[[LEAVES, CAR, WATER]].sum() == 0
    assert total[WALL] < 0.002 * total.sum()
    for plane in of_kind(found, "ground"):
        counts = made_of(cast, plane)
        assert counts[[GROUND, ROAD, MARKING]].sum() == plane.points or counts[ROOF] == plane.points, plane.name


def test_no_plane_is_curved(cast: Cast, flight: Flight, found: Features) -> None:
    """Tiles of noiseless ground are bent by some centimetres, more than the best swath could detect."""
    settings = PlaneSettings()
    bent, told = [], []
    for plane in of_kind(found, "ground"):
        points = np.concatenate([cast.true_t[patch.swath][patch.at] for patch in plane.patches]) - plane.centre_t
        x, y, z = points.T
        x, y = x / np.ptp(x), y / np.ptp(y)
        design = np.stack([np.ones(len(x)), x, y, x * x, x * y, y * y], axis=1)
        bent.append(np.abs(np.linalg.lstsq(design, z, rcond=None)[0][3:]).max() / 4.0)
        sights = [fit_sight(flight, flight.swaths[patch.swath], patch.at, settings) for patch in plane.patches]
        told.append(max(settings.sag_m, 3.0 * min(sight.sag_sigma_m for sight in sights if sight is not None)))
    assert len(bent) > 10
    assert (np.array(bent) < told).all()
    assert np.mean(np.array(bent) < 0.011) > 0.9
    assert found.refused["curved"] > 0


def test_no_return_belongs_to_two_planes_and_names_are_unique(found: Features) -> None:
    taken = Counter((patch.swath, at) for plane in found.planes for patch in plane.patches for at in patch.at.tolist())
    assert max(taken.values()) == 1
    assert len({plane.name for plane in found.planes}) == len(found.planes)
    for plane in found.planes:
        assert len(plane.patches) >= 2
        assert len({patch.swath for patch in plane.patches}) == len(plane.patches)
        assert all((np.diff(patch.at) > 0).all() and len(patch.at) >= 10 for patch in plane.patches)
        assert plane.normal_t[2] > np.cos(np.radians(66.0))


def test_reasons_for_places_without_a_plane_are_reported(found: Features) -> None:
    assert found.refused["several returns a pulse"] + found.refused["too rough"] > 0
    assert found.refused["seen by one swath only"] > 0
    assert min(found.refused.values()) > 0


def test_ground_planes_are_spread_over_every_pair_of_swaths(flight: Flight, found: Features) -> None:
    """They lie in the middle and toward both edges of every swath, shared with each of the others."""
    for one in range(3):
        for other in range(3):
            shared = [
                plane for plane in of_kind(found, "ground") if {one, other} <= {patch.swath for patch in plane.patches}
            ]
            encoder = [
                float(np.degrees(flight.swaths[one].rows["encoder_rad"][patch.at].mean()))
                for plane in shared
                for patch in plane.patches
                if patch.swath == one
            ]
            assert min(encoder) < -8.0 < 8.0 < max(encoder)
            assert min(abs(angle) for angle in encoder) < 6.0
    assert len(of_kind(found, "ground")) < 80


def test_pulses_with_several_returns_are_ignored(flight: Flight, found: Features) -> None:
    for plane in found.planes:
        for patch in plane.patches:
            assert (flight.swaths[patch.swath].rows["number_of_returns"][patch.at] == 1).all()


# --- settings, input ------------------------------------------------------------------------------------------------


def test_numbers_of_planes_and_points_are_limited(flight: Flight) -> None:
    few = find_planes(flight, PlaneSettings(most_planes=12, most_points=40))
    assert 8 <= len(few.planes) <= 12
    assert max(len(patch.at) for plane in few.planes for patch in plane.patches) <= 40
    aspects = {int(row.aspect_rad // (np.pi / 4)) for row in plane_rows(flight, few) if row.kind == "roof"}
    assert len(aspects) >= 4  # those left face many ways
    assert few.refused["more than needed"] > 0


def test_a_large_face_is_divided(cast: Cast, found: Features) -> None:
    """The roof of 40 m is divided into three pieces a side, none longer than a tile's diagonal."""
    long = [plane for plane, face, _ in built_roofs(cast, found) if np.hypot(*(plane.centre_t[:2] - (-110, 20))) < 22]
    assert len(long) >= 4
    for plane in found.planes:
        assert np.linalg.norm(np.ptp(_points(cast, plane)[:, :2], axis=0)) < 26.0, plane.name


def _points(cast: Cast, plane: Plane) -> FloatArray:
    return np.concatenate([cast.true_t[patch.swath][patch.at] for patch in plane.patches])


def test_memory_mapped_points_and_swaths_in_parts_give_the_same_planes(
    flight: Flight, found: Features, tmp_path: Path
) -> None:
    swaths = []
    for index, swath in enumerate(flight.swaths):
        np.save(tmp_path / f"{index}.npy", swath.points_t)
        swaths.append(replace(swath, points_t=np.load(tmp_path / f"{index}.npy", mmap_mode="r")))
    with ThreadPoolExecutor(3) as pool:
        mapped = find_planes(replace(flight, swaths=tuple(swaths)), each=pool.map)
    assert [plane.name for plane in mapped.planes] == [plane.name for plane in found.planes]
    for one, other in zip(mapped.planes, found.planes, strict=True):
        np.testing.assert_array_equal(one.patches[0].at, other.patches[0].at)
    assert mapped.refused == found.refused


def test_a_flight_without_points_is_refused(flight: Flight) -> None:
    empty = tuple(replace(swath, points_t=np.full_like(swath.points_t, np.nan)) for swath in flight.swaths)
    with pytest.raises(PlaneError, match="no points; use a trajectory"):
        find_planes(replace(flight, swaths=empty))


def test_a_single_swath_gives_no_planes(flight: Flight) -> None:
    alone = find_planes(replace(flight, swaths=flight.swaths[:1]))
    assert alone.planes == ()
    assert alone.refused["seen by one swath only"] > 100


def test_report_rows_describe_the_planes(flight: Flight, found: Features) -> None:
    row = plane_rows(flight, found)[0]
    plane = found.planes[0]
    assert (row.name, row.points, row.rms_m) == (plane.name, plane.points, plane.rms_m)
    assert row.swaths == tuple(flight.swaths[patch.swath].name for patch in plane.patches)
    horizontal = np.sin(row.slope_rad)
    turned = [horizontal * np.sin(row.aspect_rad), horizontal * np.cos(row.aspect_rad), np.cos(row.slope_rad)]
    np.testing.assert_allclose(turned, plane.normal_t, atol=1e-12)


# --- given polygons -------------------------------------------------------------------------------------------------


def test_a_polygon_on_a_roof_gives_its_plane(cast: Cast, flight: Flight, found: Features) -> None:
    plane, face, _ = max(built_roofs(cast, found), key=lambda one: one[0].points)
    ring = plane.centre_t[:2] + np.array([[-3.0, -3.0], [3.0, -3.0], [3.0, 3.0], [-3.0, 3.0]])
    given = given_planes(flight, {"barn": ring})
    (one,) = given.planes
    assert (one.name, one.kind, len(one.patches)) == ("barn", "user", 3)
    assert one.normal_t @ cast.planes[face, :3] > np.cos(np.radians(0.3))
    for patch in one.patches:
        place = flight.swaths[patch.swath].points_t[patch.at, :2]
        assert (place >= ring[0]).all()
        assert (place <= ring[2]).all()


def test_a_polygon_across_a_ridge_is_mixed(cast: Cast, flight: Flight) -> None:
    east, north, _ = cast.flight.frame.t_from_e(cast.scene.site.e_from_site(np.array([[-110.0, 20.0, 0.0]])))[0]
    ring = np.array([[east - 7, north - 7], [east + 7, north - 7], [east + 7, north + 7], [east - 7, north + 7]])
    given = given_planes(flight, [("ridge", ring)])
    assert given.planes == ()
    assert sum(count for why, count in given.refused.items() if why.startswith("mixed")) == 3


@pytest.mark.parametrize(
    ("polygons", "text"),
    [
        ([("a", [[0, 0], [1, 1]])], r"polygon a: corners have the shape \(2, 2\); \(k, 2\)"),
        ([("a", [[0, 0], [1, 1], [1, 0]])] * 2, "polygon a: two polygons have this name"),
        (
            {"a": [[0, 0], [20, 0], [-5e5, -5e6]]},
            "polygon a: measures 500,020 m by 5,000,000 m; draw it around one face",
        ),
    ],
)
def test_a_wrong_polygon_is_reported(flight: Flight, polygons: list[tuple[str, FloatArray]], text: str) -> None:
    with pytest.raises(PlaneError, match=text):
        given_planes(flight, polygons)


# --- kernels --------------------------------------------------------------------------------------------------------


def test_planes_of_cells_match_those_of_their_points() -> None:
    """NumPy's eigenvectors and covariances are the reference, far from the origin and from height 0."""
    draws = np.random.default_rng(3)
    corner, shape = (3000.0, -7000.0, 2.0), (3, 4)
    points = np.array([3000.0, -7000.0, 800.0]) + draws.uniform(0.0, 1.0, (4000, 3)) * [8.0, 6.0, 0.3]
    points[:, 2] += 0.4 * points[:, 0] - 0.2 * points[:, 1]
    moments, base = np.zeros((12, MOMENTS)), np.zeros(12)
    several, seen = np.zeros(12, np.int32), np.zeros(12, np.int64)
    accumulate(points, np.ones(4000, np.uint8), 50, corner, shape, moments, base, several, seen)
    normal, rms_m, what = np.zeros((12, 3)), np.zeros(12), np.zeros(12, np.uint8)
    fit_cells(moments, base, several, corner, 4, (5.0, 0.3, 1.0, 0.4), normal, rms_m, what)
    cell = (points[:, 0] - 3000.0) // 2 + 4 * ((points[:, 1] + 7000.0) // 2)
    for at in range(12):
        mine = points[cell == at]
        assert seen[at] == 50 + np.flatnonzero(cell == at)[0]
        values, vectors = np.linalg.eigh(np.cov(mine.T, bias=True))
        np.testing.assert_allclose(moments[at, 1:4], mine.mean(axis=0), rtol=0, atol=1e-9)
        assert abs(normal[at] @ vectors[:, 0]) == pytest.approx(1.0, abs=1e-10)
        assert rms_m[at] == pytest.approx(np.sqrt(values[0] * len(mine) / (len(mine) - 3)), rel=1e-6)


def _grown_over(slope_rad: float, sigma_m: float, limit_rad: float) -> NDArray[np.int32]:
    """Return (40, 40) the number of each cell's plane, on a noisy slope up to the east.

    Cells are 1.5 m wide and hold six returns.
    """
    draws, corner, shape, count = np.random.default_rng(8), (0.0, 0.0, 1.5), (40, 40), 1600
    points = draws.uniform(0.0, 60.0, (6 * count, 3))
    points[:, 2] = np.tan(slope_rad) * points[:, 0] + sigma_m * draws.standard_normal(6 * count)
    moments, base = np.zeros((count, MOMENTS)), np.zeros(count)
    several, seen = np.zeros(count, np.int32), np.zeros(count, np.int64)
    accumulate(points, np.ones(6 * count, np.uint8), 0, corner, shape, moments, base, several, seen)
    normal, rms_m, what = np.zeros((count, 3)), np.zeros(count), np.zeros(count, np.uint8)
    fit_cells(moments, base, several, corner, 40, (5.0, 0.3, 1.5 * sigma_m, 0.4), normal, rms_m, what)
    good = np.flatnonzero(what == GOOD)
    order = good[np.argsort(rms_m[good], kind="stable")]
    label, regions = np.full(count, -1, np.int32), np.zeros((len(order), MOMENTS))
    limits = (1.5 * sigma_m, sigma_m, float(np.cos(np.radians(15.0))), float(np.cos(limit_rad)))
    grow(order, what, moments, normal, shape, (10, 0, 0), limits, label, regions)
    return label.reshape(shape)


def test_sloping_ground_ends_at_tile_borders() -> None:
    """A cell of sloping ground may look steeper than ground is; a plane begun there once grew over a whole swath."""
    label = _grown_over(np.radians(7.0), 0.04, np.radians(10.0))
    tile = np.add.outer(4 * (np.arange(40) // 10), np.arange(40) // 10)
    for plane in np.unique(label[label >= 0]):
        assert len(np.unique(tile[label == plane])) == 1


def test_a_steep_face_continues_across_tiles() -> None:
    label = _grown_over(np.radians(20.0), 0.04, np.radians(10.0))
    assert np.bincount(label[label >= 0]).max() > 0.9 * label.size


def test_the_cell_table_finds_what_an_exhaustive_search_finds() -> None:
    draws = np.random.default_rng(4)
    points = draws.uniform(-40.0, 40.0, (20_000, 3))
    column, row = draws.integers(-40, 40, (2, 900))
    keys = np.unique((row << 32) + column)
    labels = np.arange(len(keys), dtype=np.int32) % 7
    table_keys, table_labels = np.zeros(4096, np.int64), np.full(4096, -1, np.int32)
    fill_table(keys, labels, table_keys, table_labels)
    planes = np.column_stack([np.tile([0.0, 0.0, 1.0], (7, 1)), np.arange(7.0), np.full(7, 5.0)])
    at, label = np.empty(20_000, np.int64), np.empty(20_000, np.int32)
    returns = draws.integers(1, 3, 20_000).astype(np.uint8)
    count = gather(points, returns, 0, 1.0, table_keys, table_labels, planes, at, label)
    known = dict(zip(keys.tolist(), labels.tolist(), strict=True))
    wanted = []
    for index, (x, y, z) in enumerate(points):
        one = known.get((int(np.floor(y)) << 32) + int(np.floor(x)))
        if one is not None and returns[index] == 1 and abs(z - one) <= 5.0:
            wanted.append((index, one))
    assert list(zip(at[:count].tolist(), label[:count].tolist(), strict=True)) == wanted
