"""Tests tie points: intersections of planes with the covariance of a Monte Carlo run, and points of a file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from swath.calib.features import Features, Patch, Plane, TiePoint
from swath.calib.flight import Flight, Head, Swath, Tangent
from swath.calib.ties.intersections import TieSettings, find_ties, fit_patch, meet
from swath.calib.ties.picked import PickedError, PickedSettings, carried, picked_ties, read_picked
from swath.georef.arrays import FloatArray
from swath.georef.records import RETURN_DTYPE
from swath.georef.scanner.beams import LineGeometry
from swath.georef.scanner.calibration import nominal

SLOPE = np.radians(35.0)
UP, OUT = np.cos(SLOPE), np.sin(SLOPE)
# a hipped roof about the origin, its ridge 6 m up from x = −5 to 5: normals, and where the faces end
NORTH, SOUTH, EAST = np.array([0.0, OUT, UP]), np.array([0.0, -OUT, UP]), np.array([OUT, 0.0, UP])
RIDGE_END = np.array([5.0, 0.0, 6.0])
NOISE_M = 0.02


def face(normal: FloatArray, count: int, rng: np.random.Generator, noise_m: float = NOISE_M) -> FloatArray:
    """Return noisy returns on a face of the roof; the noise is along the normal."""
    fall = np.tan(SLOPE)
    down, side = rng.uniform(0.2, 4.0, count), rng.uniform(-1.0, 1.0, count)
    if normal is EAST:
        points = np.stack([5.0 + down, side * down, 6.0 - down * fall], axis=1)
    else:
        away = np.sign(normal[1]) * down
        points = np.stack([side * (5.0 + 0.9 * down), away, 6.0 - down * fall], axis=1)
    return points + rng.normal(0.0, noise_m, count)[:, np.newaxis] * normal


def flight_of(swaths: Sequence[Sequence[FloatArray]], normals: Sequence[FloatArray]) -> tuple[Flight, Features]:
    """Return swaths with the points of each face one after the other, and the planes of the faces."""
    made = []
    patches: list[list[Patch]] = [[] for _ in normals]
    for index, faces in enumerate(swaths):
        points = np.concatenate(faces)
        rows = np.zeros(len(points), RETURN_DTYPE)
        made.append(Swath(f"{index + 1:02d}", 0, index + 1, 0, rows, np.arange(len(points)), points))
        begin = 0
        for number, one in enumerate(faces):
            patches[number].append(Patch(index, np.arange(begin, begin + len(one))))
            begin += len(one)
    head = Head("left", nominal("left", (0.0, 0.0, 0.0), np.eye(3)), LineGeometry())
    frame = Tangent(np.zeros(3), np.eye(3))
    planes = tuple(
        Plane(f"p{number}", np.mean(swaths[0][number], axis=0), normal, tuple(patches[number]))
        for number, normal in enumerate(normals)
    )
    return Flight(frame, (head,), (), tuple(made)), Features(planes)


def roof(seed: int, shifts: Sequence[FloatArray], count: int = 60) -> tuple[Flight, Features]:
    rng = np.random.default_rng(seed)
    normals = (NORTH, SOUTH, EAST)
    return flight_of([[face(normal, count, rng) + shift for normal in normals] for shift in shifts], normals)


def by_kind(features: Features, kind: str) -> list[TiePoint]:
    return [tie for tie in features.ties if tie.kind == kind]


SHIFTS = (np.zeros(3), np.array([0.30, -0.20, 0.10]), np.array([-0.1, 0.4, 0.0]))


def test_a_corner_lies_where_its_faces_meet() -> None:
    flight, planes = roof(1, SHIFTS)
    (corner,) = by_kind(find_ties(flight, planes), "corner")
    assert [sighting.swath for sighting in corner.sightings] == [0, 1, 2]
    for sighting, shift in zip(corner.sightings, SHIFTS, strict=True):
        off = sighting.point_t - RIDGE_END - shift
        assert off @ np.linalg.solve(sighting.covariance_t, off) < 16.3  # χ²(3), 0.999
        nearest = flight.swaths[sighting.swath].points_t
        distance = np.linalg.norm(nearest - sighting.point_t, axis=1)
        assert sighting.at == np.argmin(distance)


def test_a_ridge_is_determined_across_and_not_along() -> None:
    flight, planes = roof(1, SHIFTS)
    ridges = {tie.name: tie for tie in by_kind(find_ties(flight, planes), "ridge")}
    assert set(ridges) == {"ridge p0/p1", "ridge p0/p2", "ridge p1/p2"}
    first, second, third = ridges["ridge p0/p1"].sightings
    for sighting, shift in zip((first, second, third), SHIFTS, strict=True):
        variance, axes = np.linalg.eigh(sighting.covariance_t)
        assert abs(axes[0, 2]) == pytest.approx(1.0, abs=1e-3)  # along x
        assert np.sqrt(variance[2]) == pytest.approx(TieSettings().along_sigma_m, rel=1e-3)
        assert np.sqrt(variance[1]) < 0.02
        across = (sighting.point_t - shift)[1:] - [0.0, 6.0]
        assert across @ np.linalg.solve(sighting.covariance_t[1:, 1:], across) < 13.8  # χ²(2), 0.999
        assert sighting.point_t[0] == pytest.approx(first.point_t[0], abs=0.01)  # a common place along it


def test_covariances_of_corners_and_ridges_match_a_monte_carlo_simulation() -> None:
    rng = np.random.default_rng(7)
    bare = [face(normal, 40, rng, 0.0) for normal in (NORTH, SOUTH, EAST)]
    line = np.array([1.0, 0.0, 0.0]), 0.0, 1e-12
    corners, ridges, said_corner, said_ridge = [], [], [], []
    for _ in range(1500):
        fits = [
            fit_patch(points + rng.normal(0.0, NOISE_M, 40)[:, np.newaxis] * normal, np.arange(40), normal)
            for points, normal in zip(bare, (NORTH, SOUTH, EAST), strict=True)
        ]
        point, covariance = meet(fits)
        corners.append(point)
        said_corner.append(covariance)
        point, covariance = meet(fits[:2], line)
        ridges.append(point)
        said_ridge.append(covariance)
    said, got = np.mean(said_corner, axis=0), np.cov(np.transpose(corners))
    np.testing.assert_allclose(np.mean(corners, axis=0), RIDGE_END, atol=5.0 * np.sqrt(said.max() / 1500))
    # 1500 draws: a variance has 3.7 %; whitened, all directions and correlations at once
    whitened = np.linalg.inv(np.linalg.cholesky(said))
    np.testing.assert_allclose(whitened @ got @ whitened.T, np.eye(3), atol=0.15)
    said, got = np.mean(said_ridge, axis=0)[1:, 1:], np.cov(np.transpose(ridges)[1:])
    whitened = np.linalg.inv(np.linalg.cholesky(said))
    np.testing.assert_allclose(whitened @ got @ whitened.T, np.eye(2), atol=0.15)


def test_a_tie_far_from_its_patch_is_less_certain() -> None:
    rng = np.random.default_rng(3)
    fit = fit_patch(face(NORTH, 60, rng), np.arange(60), NORTH)
    on_plane = fit.centre_t + 10.0 * fit.axes[1]
    assert fit.variance_at(on_plane) > 4.0 * fit.variance_at(fit.centre_t)
    assert fit.variance_at(fit.centre_t) == pytest.approx(NOISE_M**2 / 60, rel=0.4)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"reach_m": 0.01, "least_returns": 12}, "the planes do not intersect in two swaths"),
        ({"least_angle_rad": np.radians(80.0)}, "the planes are nearly parallel"),
        ({"greatest_sigma_m": 1e-4}, "too uncertain"),
        ({"least_length_m": 30.0}, "the swaths share too little of it"),
    ],
)
def test_patches_without_a_ridge_are_counted(
    change: dict[str, Any], reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("swath.calib.ties.intersections.SPACINGS", 0.0)
    flight, planes = roof(1, SHIFTS)
    found = find_ties(flight, planes, replace(TieSettings(), **change))
    assert found.refused[f"ridge: {reason}"] == 3
    assert not by_kind(found, "ridge")


def test_faces_of_two_houses_do_not_form_a_ridge() -> None:
    rng = np.random.default_rng(1)
    apart = np.array([0.0, 12.0, 0.0])
    swaths = [[face(NORTH, 60, rng), face(SOUTH, 60, rng) + apart] for _ in range(2)]
    flight, planes = flight_of(swaths, (NORTH, SOUTH))
    found = find_ties(flight, planes)
    assert not found.ties
    assert found.refused["ridge: the planes do not intersect in two swaths"] == 1


def test_a_single_swath_gives_no_ties() -> None:
    flight, planes = roof(1, SHIFTS[:1])
    assert not find_ties(flight, planes).ties
    assert not find_ties(flight, Features()).ties


TEXT = """name,strip,x,y,z,sigma_m
a,1,0.0,1.0,5.3,0.05
a,02,0.3,0.8,5.4,0.05
# a remark
b,1,0.0,-1.0,5.3,0.1

b,2,400.0,-1.0,5.3,0.1
c,03,1.0,1.0,5.3,0.2
"""


def test_a_file_of_picked_points_is_read() -> None:
    picked = read_picked(TEXT, "ties.csv")
    assert [(one.name, one.strip, one.sigma_m) for one in picked] == [
        ("a", "1", 0.05),
        ("a", "02", 0.05),
        ("b", "1", 0.1),
        ("b", "2", 0.1),
        ("c", "03", 0.2),
    ]
    np.testing.assert_array_equal(picked[1].place, [0.3, 0.8, 5.4])
    flight, _ = roof(1, SHIFTS)
    found = picked_ties(flight, picked)
    (tie,) = found.ties
    assert (tie.name, tie.kind, [one.swath for one in tie.sightings]) == ("a", "picked", [0, 1])
    np.testing.assert_allclose(tie.sightings[0].covariance_t, 0.05**2 * np.eye(3))
    distance = np.linalg.norm(flight.swaths[1].points_t - [0.3, 0.8, 5.4], axis=1)
    assert tie.sightings[1].at == np.argmin(distance)
    assert found.refused == {
        "picked: the strip has no return near it": 1,
        "picked: given in one strip only": 2,
    }


def test_picked_points_move_with_their_returns() -> None:
    flight, _ = roof(1, SHIFTS)
    picked = picked_ties(flight, read_picked(TEXT, "ties.csv"))
    away = np.array([3.0, -2.0, 0.5])
    second = replace(flight.swaths[1], points_t=flight.swaths[1].points_t + away)
    again = carried(picked, flight, replace(flight, swaths=(flight.swaths[0], second, *flight.swaths[2:])))
    (tie,) = again.ties
    np.testing.assert_allclose([one.point_t for one in tie.sightings], [[0.0, 1.0, 5.3], [3.3, -1.2, 5.9]])


def test_sighting_far_from_the_others_is_counted() -> None:
    flight, _ = roof(1, (*SHIFTS[:2], np.array([100.0, 0.0, 0.0])))
    text = "name,strip,x,y,z,sigma_m\n" + "".join(
        f"a,{number},{x},1.0,5.3,0.05\n" for number, x in ((1, 0.0), (2, 0.3), (3, 100.0))
    )
    found = picked_ties(flight, read_picked(text, "t"), PickedSettings(apart_m=20.0))
    assert [one.swath for one in found.ties[0].sightings] == [0, 1]
    assert found.refused == {"picked: far from its places in other strips": 1}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "t.csv: line 1: has nothing; the columns must be name, strip, x, y, z, sigma_m"),
        ("name,x\n", "t.csv: line 1: has name, x; the columns must be"),
        ("name,strip,x,y,z,sigma_m\n", "t.csv: has no points"),
        ("name,strip,x,y,z,sigma_m\na,1,2,3\n", "t.csv: line 2: z is missing"),
        ("name,strip,x,y,z,sigma_m\na,1,2,3,four,1\n", "t.csv: line 2: z: got 'four', want a number"),
        ("name,strip,x,y,z,sigma_m\na,1,2,3,nan,1\n", "t.csv: line 2: z: got 'nan', want a number"),
        ("name,strip,x,y,z,sigma_m\na,1,2,3,4,0\n", "t.csv: line 2: sigma_m: got 0, want more than 0"),
    ],
)
def test_unusable_files_of_picked_points_are_refused(text: str, said: str) -> None:
    with pytest.raises(PickedError) as caught:
        read_picked(text, "t.csv")
    assert str(caught.value).startswith(said)
    assert "\n" not in str(caught.value)


def test_a_strip_missing_from_the_flight_is_refused() -> None:
    flight, _ = roof(1, SHIFTS)
    (one,) = read_picked("name,strip,x,y,z,sigma_m\na,9,0,1,5.3,0.05\n", "t.csv")
    with pytest.raises(
        PickedError, match=r"t\.csv: line 2: strip 9 is not a strip of the flight; use one of 01, 02, 03"
    ):
        picked_ties(flight, [one])
