"""Tests that planes are found again: stable where nothing moves, right where the points have moved."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from swath.calib.features import ControlPoint, Features, Patch, Plane, Sighting, TiePoint
from swath.calib.flight import Flight
from swath.calib.planes.matching import LOST, rematch
from swath.calib.planes.returns import limited
from swath.calib.planes.search import find_planes
from swath.georef.arrays import FloatArray
from tests.calib.cast_flight import Cast, Line, cast_flight

pytestmark = pytest.mark.xdist_group("kernels")

LINES: tuple[Line, ...] = ((-100, 0, 100, 0, 850), (100, 30, -100, 30, 850), (0, 100, 0, -100, 850))
TERRAIN = """
height_m = 450.0
relief_m = 3.0
wavelength_m = 400.0
[[terrain.village]]
center_m = [0.0, 0.0]
size_m = [140.0, 120.0]
heading_deg = 25.0
houses = 12
"""


@pytest.fixture(scope="module")
def cast() -> Cast:
    return cast_flight(TERRAIN, LINES, prf_hz=50_000.0)


@pytest.fixture(scope="module")
def flight(cast: Cast) -> Flight:
    return cast.at_truth()


@pytest.fixture(scope="module")
def settled(flight: Flight) -> Features:
    return rematch(flight, find_planes(flight))


def sets(features: Features) -> dict[tuple[str, int], set[int]]:
    """Return the returns by plane and swath."""
    return {(plane.name, patch.swath): set(patch.at.tolist()) for plane in features.planes for patch in plane.patches}


def common(one: Features, other: Features) -> FloatArray:
    """Return, for each patch of either, the share of the returns of both that both contain."""
    first, second = sets(one), sets(other)
    empty: set[int] = set()
    return np.array(
        [
            len(first.get(key, empty) & second.get(key, empty)) / len(first.get(key, empty) | second.get(key, empty))
            for key in first.keys() | second.keys()
        ]
    )


def moved(cast: Cast, **by: float) -> Flight:
    return cast.flight.placed(
        {"left": cast.truth.changed(**{name: cast.truth.value(name) + value for name, value in by.items()})}
    )


def shifted(flight: Flight, swath: int, by_m: float) -> Flight:
    """Raise one swath."""
    swaths = list(flight.swaths)
    swaths[swath] = replace(swaths[swath], points_t=swaths[swath].points_t + np.array([0.0, 0.0, by_m]))
    return replace(flight, swaths=tuple(swaths))


@pytest.mark.slow
def test_unmoved_points_keep_their_planes(flight: Flight, settled: Features) -> None:
    """All but a patch or two are unchanged at once; after that they are equal bit for bit."""
    again = rematch(flight, settled)
    assert len(again.planes) == len(settled.planes)
    assert np.mean(common(settled, again) == 1.0) > 0.98
    third = rematch(flight, again)
    assert sets(rematch(flight, third)) == sets(third)
    for one, other in zip(third.planes, rematch(flight, third).planes, strict=True):
        np.testing.assert_array_equal(one.normal_t, other.normal_t)


def test_matched_planes_equal_the_planes_found(flight: Flight, settled: Features) -> None:
    found = find_planes(flight)
    assert len(settled.planes) >= len(found.planes) - 1
    assert np.median(common(found, settled)) > 0.9
    for one, other in zip(found.planes, settled.planes, strict=False):
        assert one.normal_t @ other.normal_t > np.cos(np.radians(0.5))


@pytest.mark.slow
def test_displaced_planes_are_found_again_after_alignment(cast: Cast, flight: Flight) -> None:
    """The planes were found with 0.03° of error in all angles; after the first adjustment points move by 0.4 m."""
    wrong = moved(cast, omega_rad=5e-4, phi_rad=-5e-4, kappa_rad=1e-3)
    first = find_planes(wrong)
    matched = rematch(flight, first)
    assert len(matched.planes) > 0.95 * len(first.planes)
    for plane in matched.planes:
        if plane.kind == "roof":
            shares = np.mean([cast.faces(patch.swath, patch.at).mean(axis=0) for patch in plane.patches], axis=0)
            true = cast.planes[int(np.argmax(shares))]
            assert shares.max() > 0.9, plane.name
            assert abs(true[:3] @ plane.centre_t - true[3]) < 0.01, plane.name
            assert plane.normal_t @ true[:3] > np.cos(np.radians(0.5)), plane.name


def test_a_displaced_swath_is_dropped(flight: Flight, settled: Features) -> None:
    """The displaced swath lies half a metre above the other two, which hold the planes."""
    matched = rematch(shifted(flight, 1, 0.5), settled)
    kept = [plane for plane in matched.planes if {patch.swath for patch in plane.patches} == {0, 2}]
    assert len(kept) > 0.9 * sum({0, 2} <= {patch.swath for patch in plane.patches} for plane in settled.planes)
    assert all(1 not in {patch.swath for patch in plane.patches} for plane in kept)
    both = sum({patch.swath for patch in plane.patches} == {0, 1} for plane in settled.planes)
    assert matched.refused[LOST] >= both


def test_a_swath_that_shows_a_plane_is_added(flight: Flight, settled: Features) -> None:
    full = [plane for plane in settled.planes if len(plane.patches) == 3]
    without = tuple(replace(plane, patches=plane.patches[:2]) for plane in full)
    matched = rematch(flight, Features(planes=without))
    assert sum(len(plane.patches) == 3 for plane in matched.planes) > 0.95 * len(full)
    again = common(Features(planes=tuple(full)), matched)
    assert np.median(again) > 0.95


def test_surveyed_planes_need_one_swath_and_keep_their_known_values(flight: Flight, settled: Features) -> None:
    plane = settled.planes[0]
    control = ControlPoint("c1", plane.centre_t, 0.01)
    surveyed = replace(plane, patches=plane.patches[:1], control=(control,), kind="control")
    moved_away = shifted(shifted(flight, 1, 5.0), 2, -5.0)
    (one,) = rematch(moved_away, Features(planes=(surveyed,))).planes
    assert (one.control, one.kind, len(one.patches)) == ((control,), "control", 1)
    free = Features(planes=(replace(surveyed, control=()),))
    lost = rematch(moved_away, free)
    assert lost.planes == ()
    assert lost.refused[LOST] == 1


def test_missing_points_are_not_matched(flight: Flight, settled: Features) -> None:
    swaths = list(flight.swaths)
    swaths[0] = replace(swaths[0], points_t=np.full_like(swaths[0].points_t, np.nan))
    matched = rematch(replace(flight, swaths=tuple(swaths)), settled)
    assert matched.planes
    assert all(patch.swath != 0 for plane in matched.planes for patch in plane.patches)


def test_other_features_are_passed_on(flight: Flight, settled: Features) -> None:
    sighting = Sighting(0, 3, np.zeros(3), np.eye(3))
    tie = TiePoint("ridge 1", (sighting, replace(sighting, swath=1)))
    features = replace(settled, ties=(tie,), refused=settled.refused.copy())
    matched = rematch(flight, features)
    assert matched.ties == (tie,)
    assert matched.refused == settled.refused


def test_a_patch_without_a_plane_is_dropped(flight: Flight) -> None:
    """Its returns are spread over a whole swath."""
    at = np.arange(0, len(flight.swaths[0]), 1000)
    nonsense = Plane("x", np.zeros(3), np.array([0.0, 0.0, 1.0]), (Patch(0, at), Patch(1, at)))
    matched = rematch(flight, Features(planes=(nonsense,)))
    assert matched.planes == ()
    assert matched.refused == {LOST: 1}


@pytest.mark.parametrize("rows", [16, 60, 190, 240, 1000])
def test_a_limit_on_returns_shortens_the_largest_patches(rows: int) -> None:
    """The limit is one number for all patches; a number larger by one would exceed the total."""
    sizes = [[5, 100], [40], [7, 90]]
    planes = [
        Plane(str(at), np.zeros(3), np.array([0.0, 0.0, 1.0]), tuple(Patch(i, np.arange(n)) for i, n in enumerate(own)))
        for at, own in enumerate(sizes)
    ]
    whole = Features(tuple(planes))
    found = limited(whole, rows)
    counts = np.array([len(patch.at) for plane in found.planes for patch in plane.patches])
    every = np.concatenate(sizes)
    most = counts.max()
    np.testing.assert_array_equal(counts, np.minimum(every, most))
    assert counts.sum() <= rows
    assert np.minimum(every, most + 1).sum() > rows or most == every.max()
