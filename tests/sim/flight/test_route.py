"""Tests Dubins' paths against closed forms and the criterion of the shortest; legs keep their promises."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from scipy.integrate import quad

from swath.sim.flight.route import Arc, Leg, Pose, Route, Turning, Way, length_m, shortest_way, way_of_length

R = 300.0
FREE = Turning(R, R, 0.0)
NORTH, EAST, SOUTH = 0.0, math.pi / 2, math.pi


def random_poses(seed: int, count: int) -> list[Pose]:
    rng = np.random.default_rng(seed)
    return [Pose(*rng.uniform([-4 * R, -4 * R, 0.0], [4 * R, 4 * R, 2 * math.pi]).tolist()) for _ in range(count)]


def assert_joins(way: Way, start: Pose, end: Pose) -> None:
    ends = [start, *(arc.end for arc in way)]
    starts = [*(arc.start for arc in way), end]
    for before, behind in zip(ends, starts, strict=True):
        assert math.hypot(before.east_m - behind.east_m, before.north_m - behind.north_m) < 1e-6
        assert math.remainder(before.course_rad - behind.course_rad, 2 * math.pi) == pytest.approx(0.0, abs=1e-8)


def sides(way: Way) -> str:
    """Return the letters of a way's turns, with arcs that continue each other taken as one."""
    letters = ["S" if arc.curvature_per_m == 0 else "R" if arc.curvature_per_m > 0 else "L" for arc in way]
    return "".join(letter for letter, _ in itertools.groupby(letters))


PHI = math.asin(0.4)
KNOWN = {
    "S": (Pose(0, 0, EAST), Pose(1234.5, 0, EAST), 1234.5),
    "R": (Pose(0, 0, NORTH), Pose(2 * R, 0, SOUTH), math.pi * R),
    "L": (Pose(0, 0, NORTH), Pose(-2 * R, 0, SOUTH), math.pi * R),
    "RSR": (Pose(0, 0, NORTH), Pose(5 * R, 0, SOUTH), math.pi * R + 3 * R),
    "LSL": (Pose(0, 0, NORTH), Pose(-5 * R, 0, SOUTH), math.pi * R + 3 * R),
    # inner tangents of circles whose centres are 5 R apart
    "RSL": (Pose(0, 0, NORTH), Pose(2 * R, 5 * R, NORTH), math.sqrt(21) * R + 2 * R * PHI),
    "LSR": (Pose(0, 0, NORTH), Pose(-2 * R, 5 * R, NORTH), math.sqrt(21) * R + 2 * R * PHI),
    # three touching circles: π/3, 5π/3, π/3
    "RLR": (Pose(0, 0, NORTH), Pose(1e-7, 0, SOUTH), 7 * math.pi / 3 * R),
    "LRL": (Pose(0, 0, NORTH), Pose(-1e-7, 0, SOUTH), 7 * math.pi / 3 * R),
}


@pytest.mark.parametrize("word", KNOWN)
def test_path_lengths_match_their_closed_forms(word: str) -> None:
    start, end, want_m = KNOWN[word]
    way = shortest_way(start, end, FREE)
    assert length_m(way) == pytest.approx(want_m, abs=1e-6)
    if len(word) < 3 or "S" in word:
        assert sides(way) == word
    else:
        assert sides(way) in ("RLR", "LRL")  # of equal length here
    assert_joins(way, start, end)


def test_between_opposite_poses_the_path_turns_to_the_nearer_side() -> None:
    right = shortest_way(Pose(0, 0, NORTH), Pose(0.5 * R, 0, SOUTH), FREE)
    left = shortest_way(Pose(0, 0, NORTH), Pose(-0.5 * R, 0, SOUTH), FREE)
    assert (sides(right), sides(left)) == ("LRL", "RLR")
    assert length_m(right) == pytest.approx(length_m(left))


def test_no_path_is_shortened_by_a_waypoint() -> None:
    poses = random_poses(1, 240)
    words = set()
    for start, between, end in zip(poses[::3], poses[1::3], poses[2::3], strict=True):
        way = shortest_way(start, end, FREE)
        words.add(sides(way))
        assert_joins(way, start, end)
        assert all(abs(arc.curvature_per_m) in (0.0, 1.0 / R) for arc in way)
        by_m = length_m(shortest_way(start, between, FREE)) + length_m(shortest_way(between, end, FREE))
        assert length_m(way) <= by_m + 1e-6
    assert words >= {"RSR", "LSL", "RSL", "LSR"}


def turned(pose: Pose) -> Pose:
    return Pose(pose.east_m, pose.north_m, pose.course_rad + math.pi)


def test_the_reverse_path_has_the_same_length() -> None:
    poses = random_poses(2, 100)
    for start, end in zip(poses[::2], poses[1::2], strict=True):
        there_m = length_m(shortest_way(start, end, FREE))
        assert length_m(shortest_way(turned(end), turned(start), FREE)) == pytest.approx(there_m)


def test_equal_poses_give_an_empty_path() -> None:
    assert shortest_way(Pose(3, 4, 1.0), Pose(3, 4, 1.0), FREE) == ()


def test_rounding_does_not_turn_straight_flight_into_a_full_circle() -> None:
    for course in np.linspace(0.1, 6.2, 300).tolist():
        start = Pose(10.0, -20.0, course)
        for distance_m in (30.0, 100.0, 500.0, 987.6):
            way = shortest_way(start, start.ahead(distance_m), FREE)
            assert length_m(way) == pytest.approx(distance_m)


def test_opposite_turns_are_wider_unless_a_straight_separates_them() -> None:
    turning = Turning(R, 1.5 * R, 4.0 * R)
    start = Pose(0, 0, NORTH)
    near = shortest_way(start, Pose(2 * R, 4 * R, NORTH), turning)
    far = shortest_way(start, Pose(2 * R, 6 * R, NORTH), turning)
    assert [1.0 / arc.curvature_per_m for arc in near[::2]] == pytest.approx([1.5 * R, -1.5 * R])
    assert [1.0 / arc.curvature_per_m for arc in far[::2]] == pytest.approx([R, -R])
    for _, end in zip(range(200), random_poses(3, 200), strict=True):
        way = shortest_way(start, end, turning)
        assert_joins(way, start, end)
        for before, behind in itertools.pairwise(way):
            if before.curvature_per_m * behind.curvature_per_m < 0.0:
                assert abs(before.curvature_per_m) == abs(behind.curvature_per_m) == pytest.approx(1 / (1.5 * R))


@pytest.mark.parametrize("factor", [0.5, 1.001, 1.3, 2.5, 7.0])
def test_a_lengthened_path_is_at_most_a_circle_longer(factor: float) -> None:
    for start, end in zip(random_poses(4, 20), random_poses(5, 20), strict=True):
        shortest_m = length_m(shortest_way(start, end, FREE))
        way = way_of_length(start, end, FREE, factor * shortest_m)
        assert_joins(way, start, end)
        assert length_m(way) >= factor * shortest_m
        assert length_m(way) <= max(shortest_m, factor * shortest_m + 2 * math.pi * R)
        assert all(abs(arc.curvature_per_m) in (0.0, 1.0 / R) for arc in way)


def test_a_lengthened_path_between_opposite_lines_flies_on_before_turning() -> None:
    way = way_of_length(Pose(0, 0, NORTH), Pose(2 * R, 0, SOUTH), FREE, math.pi * R + 400.0)
    assert sides(way) == "SRS"
    assert length_m(way) == pytest.approx(math.pi * R + 400.0, abs=0.011 * math.pi * R)


@pytest.mark.parametrize("curvature", [0.0, 1e-12, 1 / R, -1 / R, 1 / 50.0])
def test_an_arc_is_the_integral_of_its_course(curvature: float) -> None:
    arc = Arc(Pose(5.0, 7.0, 0.6), 700.0, curvature)
    for along_m in (-50.0, 0.0, 123.4, 700.0):
        east_m, _ = quad(lambda s: math.sin(0.6 + curvature * s), 0.0, along_m, limit=200)
        north_m, _ = quad(lambda s: math.cos(0.6 + curvature * s), 0.0, along_m, limit=200)
        assert arc.positions(np.array([along_m]))[0] == pytest.approx([5.0 + east_m, 7.0 + north_m], abs=1e-8)


def test_a_leg_changes_speed_and_height_evenly() -> None:
    way = (Arc(Pose(0, 0, EAST), 600.0, 0.0), Arc(Pose(600, 0, EAST), 900.0, 1 / R))
    leg = Leg.over(way, (40.0, 60.0), (500.0, 560.0))
    assert leg.duration_s == pytest.approx(30.0)
    waiting = Leg(way, leg.duration_s, leg.speeds_mps, leg.heights_m, wait_s=5.0)
    time_s = np.linspace(0.0, 30.0, 30001)
    sampled = waiting.sample(time_s)
    speed = np.linalg.norm(np.diff(sampled[:, :2], axis=0), axis=1) / 1e-3
    np.testing.assert_allclose(speed, 40.0 + 20.0 * (time_s[1:] - 5e-4) / 30.0, atol=1e-4)
    assert sampled[[0, 5000, 15000, 25000, 30000], 2] == pytest.approx([500.0, 500.0, 530.0, 560.0, 560.0])
    assert sampled[-1, :2] == pytest.approx([leg.end.east_m, leg.end.north_m])
    assert set(sampled[:, 3]) == {1.0}


def test_a_route_goes_on_beyond_its_ends() -> None:
    legs = [
        Leg.over((Arc(Pose(0, 0, EAST), 500.0, 0.0),), (50.0, 50.0), (100.0, 100.0)),
        Leg.over((Arc(Pose(500, 0, EAST), math.pi * R, 1 / R),), (50.0, 40.0), (100.0, 130.0)),
        Leg.over((Arc(Pose(500, -2 * R, -EAST), 400.0, 0.0),), (40.0, 40.0), (130.0, 130.0)),
    ]
    route = Route(legs)
    end_s = float(route.starts_s[-1])
    assert end_s == pytest.approx(10.0 + math.pi * R / 45.0 + 10.0)
    sampled = route.sample(np.array([-2.0, 0.0, 10.0, end_s - 10.0, end_s, end_s + 3.0]))
    want: list[list[float]] = [
        [-100, 0, 100],
        [0, 0, 100],
        [500, 0, 100],
        [500, -2 * R, 130],
        [100, -2 * R, 130],
        [-20, -2 * R, 130],
    ]
    np.testing.assert_allclose(sampled[:, :3], want, atol=1e-9)
