"""Tests control: on which planes it lies, and which objections to it are found."""

from __future__ import annotations

import numpy as np
import pytest
from pyproj import Transformer

from swath.calib.control.doubts import Doubt, doubts
from swath.calib.control.points import ControlRules, Surveyed, control_planes, in_t, same_places
from swath.calib.features import ControlPoint
from swath.calib.flight import Flight
from swath.calib.planes.local import PlaneRules, is_inside, robust_plane
from swath.georef.arrays import FloatArray
from tests.calib.surface_flight import FRAME, surface_flight, swath_of

pytestmark = pytest.mark.xdist_group("kernels")


def unknown(position_e: FloatArray) -> None:
    """Return no undulation."""
    return


def rolling(east: FloatArray, north: FloatArray) -> FloatArray:
    """Return heights, m, of ground with slopes of every aspect, up to 12 %."""
    up: FloatArray = 500.0 + 1.2 * np.sin(east / 10.0) + 1.0 * np.cos(north / 9.0)
    return up


def surveyed(flight_height: FloatArray, shift: FloatArray, count: int = 12) -> list[ControlPoint]:
    """Return points on the rolling ground whose stated coordinates are displaced by a shift (3,), m."""
    draws = np.random.default_rng(3)
    places = draws.uniform(-50.0, 50.0, (count, 2))
    up = rolling(*places.T) + flight_height
    true = np.column_stack([places, up + draws.normal(0.0, 0.01, count)])
    return [ControlPoint(f"P{number}", place + shift, 0.01) for number, place in enumerate(true)]


def flight() -> Flight:
    """Return two swaths over the rolling ground."""
    return surface_flight([rolling, rolling])


def test_points_are_converted_to_the_tangent_frame() -> None:
    (point,) = in_t([Surveyed("GCP1", np.radians(47.4001), np.radians(8.9001), 512.34, 0.02)], FRAME)
    x, y, z = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True).transform(8.9001, 47.4001, 512.34)
    assert FRAME.e_from_t(point.position_t) == pytest.approx([x, y, z], abs=1e-6)
    assert point.sigma_m == 0.02
    assert point.position_t[0] == pytest.approx(7.548, abs=0.01)  # 0.0001° of longitude: cos(47.4°) · 11.13 m
    assert in_t((), FRAME) == ()


def test_two_points_of_one_place_are_found() -> None:
    places = [(47.4001, 512.34), (47.4101, 512.34), (47.4001, 512.345), (47.4001, 513.0)]
    points = [Surveyed(str(at), np.radians(lat), 0.15, height, 0.02) for at, (lat, height) in enumerate(places)]
    assert same_places(points) == [(2, 0)]
    assert same_places(points[:1]) == []


# ---------------------------------------------------------------------- planes


def test_each_control_point_gives_a_plane_with_the_returns_of_every_swath() -> None:
    found = control_planes(flight(), surveyed(np.zeros(1), np.zeros(3)))
    assert [plane.name for plane in found.planes] == [f"control P{number}" for number in range(12)]
    assert not found.refused
    for plane in found.planes:
        (point,) = plane.control
        assert [patch.swath for patch in plane.patches] == [0, 1]
        assert plane.kind == "control"
        assert plane.points > 30
        assert plane.rms_m < 0.03
        gradient = np.array([0.12 * np.cos(point.position_t[0] / 10.0), -np.sin(point.position_t[1] / 9.0) / 9.0])
        assert -plane.normal_t[:2] / plane.normal_t[2] == pytest.approx(gradient, abs=0.02)
        assert plane.normal_t @ (point.position_t - plane.centre_t) == pytest.approx(0.0, abs=0.03)


def test_returns_off_the_ground_are_dropped_and_the_other_indices_are_right() -> None:
    made = surface_flight([lambda east, north: 0.0 * east])
    points = made.swaths[0].points_t.copy()
    bush = (np.hypot(points[:, 0], points[:, 1]) < 1.4) & (np.arange(len(points)) % 4 == 0)
    points[bush, 2] += 0.7
    swath = swath_of(points)
    found = control_planes(Flight(FRAME, (), (), (swath,)), [ControlPoint("A", np.array([0.1, 0.1, 0.0]), 0.01)])
    at = found.planes[0].patches[0].at
    assert not bush[at].any()
    assert (np.diff(at) > 0).all()
    assert np.hypot(*(points[at, :2] - 0.1).T).max() < 1.5
    assert abs(found.planes[0].centre_t[2]) < 0.01


def tilted(slope: float, roughness_m: float) -> Flight:
    """Return a flight with one swath over a slope to the north."""
    return surface_flight([lambda east, north: slope * north], noise_m=roughness_m, half_m=6.0)


@pytest.mark.parametrize(
    ("made", "place", "reason"),
    [
        (tilted(0.0, 0.3), (0.0, 0.0, 0.0), "control: no plane|control: too rough"),
        (tilted(1.5, 0.01), (0.0, 0.0, 0.0), "control: too steep"),
        (tilted(0.0, 0.01), (-6.9, 0.0, 0.0), "control: returns do not surround it"),
        (tilted(0.0, 0.01), (-8.5, 0.0, 0.0), "control: no returns"),
        (tilted(0.0, 0.01), (-6.9, -6.9, 0.0), "control: too few returns"),
        (tilted(0.0, 0.01), (0.0, 0.0, 30.0), "control: far above or below"),
    ],
)
def test_refused_points_are_counted_by_reason(made: Flight, place: tuple[float, ...], reason: str) -> None:
    found = control_planes(made, [ControlPoint("A", np.array(place), 0.01)], ControlRules(widest_m=1.5))
    assert found.planes == ()
    assert sum(found.refused.values()) == 1
    assert next(iter(found.refused)) in reason.split("|")


def test_a_swath_that_shows_another_surface_is_not_joined() -> None:
    made = surface_flight([lambda e, n: 0.0 * e, lambda e, n: 0.0 * e, lambda e, n: 0.0 * e + 4.0], half_m=6.0)
    found = control_planes(made, [ControlPoint("A", np.zeros(3), 0.01)])
    assert [patch.swath for patch in found.planes[0].patches] == [0, 1]
    assert found.refused == {"control: another surface": 1}


def test_unusable_returns_raise_no_error() -> None:
    empty = Flight(FRAME, (), (), (swath_of(np.full((5, 3), np.nan)),))
    found = control_planes(empty, [ControlPoint("A", np.zeros(3), 0.01)])
    assert found.refused == {"control: no returns": 1}


def test_a_robust_plane_withstands_a_third_of_outliers() -> None:
    draws = np.random.default_rng(1)
    places = draws.uniform(-1.0, 1.0, (60, 2))
    up = 0.2 * places[:, 0] - 0.1 * places[:, 1] + draws.normal(0.0, 0.01, 60)
    up[:20] += draws.uniform(0.3, 2.0, 20)
    plane, kept, reason = robust_plane(np.column_stack([places, up]), PlaneRules())
    assert plane is not None
    assert reason == ""
    assert kept[20:].sum() > 37
    assert not kept[:20].any()
    assert -plane.normal_t[:2] / plane.normal_t[2] == pytest.approx([0.2, -0.1], abs=0.01)


@pytest.mark.parametrize(("place", "inside"), [((0.2, 0.2), True), ((0.9, 0.9), False), ((1.0, 0.0), True)])
def test_a_place_inside_a_triangle_is_recognised(place: tuple[float, float], inside: bool) -> None:
    assert is_inside(np.array(place), np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])) is inside


# ---------------------------------------------------------------------- doubts


def only(found: tuple[Doubt, ...]) -> Doubt:
    """Return the only warning."""
    (doubt,) = found
    return doubt


def test_good_control_gives_no_warning() -> None:
    assert doubts(flight(), surveyed(np.zeros(1), np.zeros(3)), undulation=unknown) == ()


def test_orthometric_heights_are_recognised_by_the_geoid_undulation() -> None:
    points = surveyed(np.zeros(1), np.array([0.0, 0.0, -48.3]))
    doubt = only(doubts(flight(), points, undulation=lambda position_e: (48.1, "EGM96")))
    assert (doubt.kind, doubt.refuses) == ("orthometric", True)
    assert "control lies 48.3 m below the laser's ground everywhere, as orthometric heights would" in doubt.text
    assert "the undulation there is 48.1 m (EGM96)" in doubt.text


def test_ellipsoidal_heights_read_as_heights_above_the_geoid_are_recognised() -> None:
    points = surveyed(np.zeros(1), np.array([0.0, 0.0, 48.3]))
    doubt = only(doubts(flight(), points, undulation=lambda position_e: (48.1, "EGM96")))
    assert (doubt.kind, doubt.refuses) == ("ellipsoidal", True)
    assert "48.3 m above the laser's ground everywhere, as ellipsoidal heights read as heights above" in doubt.text
    assert "without its vertical part" in doubt.text


def test_without_a_geoid_the_constant_offset_is_named() -> None:
    doubt = only(doubts(flight(), surveyed(np.zeros(1), np.array([0.0, 0.0, 31.2])), undulation=unknown))
    assert doubt.kind == "orthometric"
    assert "31.2 m above" in doubt.text
    assert "undulation is -31.2 m" in doubt.text


def test_a_constant_unlike_the_undulation_is_another_height_reference() -> None:
    points = surveyed(np.zeros(1), np.array([0.0, 0.0, 0.8]))
    doubt = only(doubts(flight(), points, undulation=lambda position_e: (48.1, "EGM96")))
    assert doubt.kind == "height"
    assert "0.80 m above" in doubt.text
    assert "48.1 m there" in doubt.text


def test_heights_in_feet_are_reported() -> None:
    points = [
        ControlPoint(point.name, point.position_t * [1.0, 1.0, 1.0 / 0.3048], 0.01)
        for point in surveyed(np.zeros(1), np.zeros(3))
    ]
    doubt = only(doubts(flight(), points, undulation=unknown))
    assert doubt.kind == "height"
    assert "feet" in doubt.text


def test_another_datum_is_recognised_from_slopes() -> None:
    points = surveyed(np.zeros(1), np.array([0.9, 0.9, 0.0]), count=30)
    doubt = only(doubts(flight(), points, undulation=unknown))
    assert (doubt.kind, doubt.refuses) == ("shift", True)
    assert "to the north-east" in doubt.text
    found = float(doubt.text.split("control lies ")[1].split(" m")[0])
    assert found == pytest.approx(0.9 * np.sqrt(2.0), abs=0.2)


def test_disagreeing_swaths_give_no_datum_warning() -> None:
    """A wrong boresight displaces each swath, and their mean too, so this is no sign of a wrong datum."""
    points = surveyed(np.zeros(1), np.zeros(3), count=30)
    beside = surface_flight(
        [lambda east, north: rolling(east + 2.5, north + 2.5), lambda east, north: rolling(east - 0.7, north - 0.7)]
    )
    assert not any(doubt.kind == "shift" for doubt in doubts(beside, points, undulation=unknown))


def test_on_level_ground_no_shift_is_reported() -> None:
    level = surface_flight([lambda east, north: 0.0 * east])
    places = np.random.default_rng(2).uniform(-50.0, 50.0, (20, 2))
    points = [ControlPoint(f"P{k}", np.array([*place, 0.01 * (k % 3)]), 0.01) for k, place in enumerate(places)]
    assert doubts(level, points, undulation=unknown) == ()


def test_a_single_disagreeing_point_is_named_and_not_refused() -> None:
    points = surveyed(np.zeros(1), np.zeros(3))
    points[4] = ControlPoint("P4", points[4].position_t + np.array([0.0, 0.0, 0.6]), 0.01)
    doubt = only(doubts(flight(), points, undulation=unknown))
    assert (doubt.kind, doubt.points, doubt.refuses) == ("point", ("P4",), False)
    assert "P4 lies 0.59 m above" in doubt.text
    assert "2 swaths" in doubt.text


def test_points_outside_the_flight_are_reported_and_refused_if_all_lie_outside() -> None:
    points = surveyed(np.zeros(1), np.zeros(3))
    points[0] = ControlPoint("P0", np.array([900.0, 0.0, 500.0]), 0.01)
    one = only(doubts(flight(), points, undulation=unknown))
    assert (one.kind, one.refuses) == ("point", False)
    assert "P0 lies outside the flight, 84" in one.text
    elsewhere = surveyed(np.zeros(1), np.array([9000.0, 0.0, 0.0]))
    everyone = only(doubts(flight(), elsewhere, undulation=unknown))
    assert (everyone.kind, everyone.refuses) == ("outside", True)
    assert "km from its returns" in everyone.text


def test_the_search_radius_grows_to_its_limit_where_returns_are_sparse() -> None:
    thin = surface_flight([lambda east, north: 0.1 * east], step_m=1.5)
    point = ControlPoint("A", np.array([0.0, 0.0, 0.0]), 0.01)
    at = control_planes(thin, [point]).planes[0].patches[0].at
    away = np.hypot(*thin.swaths[0].points_t[at, :2].T)
    assert len(at) == 12
    assert 1.5 < away.max() < 4.0
    assert control_planes(thin, [point], ControlRules(widest_m=1.5)).refused == {"control: too few returns": 1}


def test_a_wider_circle_takes_more_returns() -> None:
    points = [ControlPoint("A", np.array([0.0, 0.0, 501.0]), 0.01)]
    narrow, wide = (
        control_planes(flight(), points, ControlRules(radius_m=radius)).planes[0].points for radius in (1.0, 2.0)
    )
    assert wide > 3 * narrow
