"""Tests the flown trajectory against PROJ, SciPy, time differences and the physics of a coordinated turn."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyproj import Geod, Transformer
from scipy.spatial.transform import Rotation

from swath.georef.arrays import FloatArray
from swath.sim.flight.smoothing import PEAK, kernel, smoothed, spline_through
from swath.sim.flight.trajectory import Trajectory, fly
from swath.sim.plan.errors import PlanError
from swath.sim.plan.plan import Plan, load_plan, parse_plan
from swath.sim.site import Site

GEODETIC = Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
ECEF = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
STEP_S = 1.0 / 32.0  # of the knots
TERRAIN_M = 450.0

PLAN = """
[flight]
name = "test"
origin_deg = [47.5, 8.9]
speed_mps = 60.0
turbulence = "none"

[[line]]
name = "east"
from_m = [-1500.0, -200.0]
to_m = [1500.0, -200.0]
height_m = 900.0

[[line]]
name = "south"
from_m = [300.0, 1200.0]
to_m = [-100.0, -1200.0]
height_m = 1040.0
speed_mps = 45.0

[[line]]
name = "west"
from_m = [1500.0, -200.0]
to_m = [-1500.0, -200.0]
height_m = 900.0
"""
GROUND = {"runway_m": [-4000.0, -3000.0], "heading_deg": 60.0, "static_s": 30.0, "taxi_m": 150.0}


def plan_with(changes: dict[str, Any] | None = None, text: str = PLAN) -> Plan:
    return parse_plan(text, Path()).changed(changes or {})


def flat(east_m: FloatArray, _north_m: FloatArray) -> FloatArray:
    return np.full(len(east_m), TERRAIN_M)


def flown(changes: dict[str, Any] | None = None, text: str = PLAN) -> Trajectory:
    plan = plan_with(changes, text)
    return fly(plan, Site.at(*plan.tables.flight.origin_deg), flat)


@pytest.fixture(scope="module")
def quiet() -> Trajectory:
    return flown()


@pytest.fixture(scope="module")
def rough() -> Trajectory:
    return flown({"flight": {"turbulence": "moderate", "wind_mps": [8.0, -5.0]}})


@pytest.fixture(scope="module")
def from_ground() -> Trajectory:
    return flown({"ground": GROUND, "flight": {"turbulence": "light", "wind_mps": [4.0, 3.0]}})


def times(trajectory: Trajectory, step_s: float = 0.05) -> FloatArray:
    return np.arange(0.0, trajectory.end_s, step_s)


def geodetic(position_e: FloatArray) -> FloatArray:
    """Return (3, n) longitude, latitude (deg) and ellipsoidal height (m), by PROJ."""
    return np.stack(GEODETIC.transform(position_e[:, 0], position_e[:, 1], position_e[:, 2]))


def plane(trajectory: Trajectory, time_s: FloatArray) -> FloatArray:
    """Return (n, 3) east, north of the tangent plane and ellipsoidal height, m, by PROJ."""
    position_e = trajectory.poses(time_s).position_e
    topocentric = Transformer.from_pipeline("+proj=topocentric +ellps=WGS84 +lat_0=47.5 +lon_0=8.9 +h_0=0")
    places = np.stack(topocentric.transform(position_e[:, 0], position_e[:, 1], position_e[:, 2]), axis=-1)
    places[:, 2] = geodetic(position_e)[2]
    return places


def rot_e_from_l(position_e: FloatArray) -> FloatArray:
    """Return (n, 3, 3) with axes north, east, down in e as columns, from differences of PROJ's coordinates."""
    lon, lat, height = geodetic(position_e)
    axes = []
    for shift in ((0.0, 1e-4, 0.0), (1e-4, 0.0, 0.0), (0.0, 0.0, -10.0)):
        ends = [
            np.stack(ECEF.transform(lon + s * shift[0], lat + s * shift[1], height + s * shift[2])) for s in (-1, 1)
        ]
        axes.append((ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0], axis=0))
    return np.stack(axes, axis=-1).transpose(1, 0, 2)


def gravity_mps2(lat_rad: FloatArray, height_m: FloatArray) -> FloatArray:
    """Return gravity, m/s², by the international gravity formula 1980 with the free-air gradient.

    It is within 2e-5 m/s² of WGS 84's below 2 km.
    """
    sine = np.sin(lat_rad) ** 2
    surface = 9.780327 * (1 + 0.0053024 * sine - 0.0000058 * np.sin(2 * lat_rad) ** 2)
    return np.asarray(surface - (3.0877e-6 - 4.3e-9 * sine) * height_m + 7.2e-13 * height_m**2)


def specific_force_b(trajectory: Trajectory, time_s: FloatArray) -> FloatArray:
    """Return (n, 3) specific force, m/s², in b that an accelerometer triad in the body measures."""
    motion = trajectory.motion(time_s)
    _, lat, height = geodetic(motion.position_e)
    down_e = rot_e_from_l(motion.position_e)[:, :, 2]
    coriolis = 2 * 7.292115e-5 * np.cross([0.0, 0.0, 1.0], motion.velocity_e)
    force_e = motion.acceleration_e + coriolis - gravity_mps2(np.radians(lat), height)[:, np.newaxis] * down_e
    return np.asarray(np.einsum("nji,nj->ni", motion.rot_e_from_b, force_e))


def velocity_l(trajectory: Trajectory, time_s: FloatArray) -> FloatArray:
    motion = trajectory.motion(time_s)
    return np.asarray(np.einsum("nji,nj->ni", rot_e_from_l(motion.position_e), motion.velocity_e))


# ---------------------------------------------------------------------------------------------- lines


@pytest.mark.parametrize("changes", [{}, {"ground": GROUND}, {"flight": {"lead_s": 1.7}}])
def test_lines_are_straight_level_and_at_constant_speed(changes: dict[str, Any]) -> None:
    plan, trajectory = plan_with(changes), flown(changes)
    assert [line.name for line in trajectory.lines] == ["east", "south", "west"]
    for line, table in zip(trajectory.lines, plan.tables.line, strict=True):
        start, end = np.array(table.from_m), np.array(table.to_m)
        speed = table.speed_mps or 60.0
        assert (line.end_s - line.start_s) * speed == pytest.approx(np.linalg.norm(end - start))
        time_s = np.linspace(line.start_s, line.end_s, 3001)
        share = ((time_s - line.start_s) / (line.end_s - line.start_s))[:, np.newaxis]
        places = plane(trajectory, time_s)
        np.testing.assert_allclose(places[:, :2], start + share * (end - start), atol=1e-8)
        np.testing.assert_allclose(places[:, 2], table.height_m, atol=1e-8)


def test_lines_have_leads_before_and_after(quiet: Trajectory) -> None:
    first, last = quiet.lines[0], quiet.lines[-1]
    assert quiet.end_s == pytest.approx(last.end_s + 4.0)
    assert 12.0 <= first.start_s <= 14.0
    assert plane(quiet, np.zeros(1))[0] == pytest.approx([-1500.0 - 60.0 * first.start_s, -200.0, 900.0], abs=1e-4)
    for line, after in zip(quiet.lines, quiet.lines[1:], strict=False):
        assert after.start_s - line.end_s > 2 * 4.0


def test_line_at_names_the_line_from_its_start_until_its_end(quiet: Trajectory) -> None:
    first, second, _ = quiet.lines
    moments = [0.0, first.start_s - 1e-6, first.start_s, first.end_s - 1e-6, first.end_s, second.start_s, quiet.end_s]
    numbers = quiet.line_at(np.array(moments))
    assert numbers.tolist() == [-1, -1, 0, 0, -1, 1, -1]
    assert numbers.dtype == np.int16


def test_one_line_needs_no_lead() -> None:
    lines = [{"name": "a", "from_m": [0.0, 0.0], "to_m": [0.0, 300.0], "height_m": 700.0}]
    trajectory = flown({"line": lines, "flight": {"lead_s": 0.0}})
    assert trajectory.end_s == trajectory.lines[0].end_s
    assert plane(trajectory, np.array([trajectory.end_s]))[0] == pytest.approx([0.0, 300.0, 700.0], abs=1e-5)


def test_the_trajectory_extends_only_a_little_beyond_its_ends(quiet: Trajectory) -> None:
    end_s = quiet.end_s
    known = quiet.poses(np.array([-5.0, end_s + 5.0]))
    assert np.isfinite(known.position_e).all()
    assert np.isfinite(known.rot_e_from_b).all()
    assert np.isnan(quiet.poses(np.array([-6.0, end_s + 6.0])).position_e).all()


# ---------------------------------------------------------------------------------------------- derivatives


@pytest.mark.parametrize("which", ["quiet", "rough", "from_ground"])
def test_derivatives_match_those_of_positions_and_rotations(which: str, request: pytest.FixtureRequest) -> None:
    trajectory: Trajectory = request.getfixturevalue(which)
    knots = STEP_S * np.arange(1, int(trajectory.end_s / STEP_S))
    time_s, half_s = np.sort(np.concatenate([knots[::3], knots[::7] + 0.3 * STEP_S])), 1e-3
    now, before, after = (trajectory.motion(time_s + shift) for shift in (0.0, -half_s, half_s))
    # the next terms of the series: half²/6 of jerk (20 m/s³ at most) and of snap (100 m/s⁴)
    np.testing.assert_allclose((after.position_e - before.position_e) / (2 * half_s), now.velocity_e, atol=5e-6)
    np.testing.assert_allclose((after.velocity_e - before.velocity_e) / (2 * half_s), now.acceleration_e, atol=2e-5)
    turned = Rotation.from_matrix(before.rot_e_from_b).inv() * Rotation.from_matrix(after.rot_e_from_b)
    np.testing.assert_allclose(turned.as_rotvec() / (2 * half_s), now.rate_eb_b, atol=2e-6)


def test_poses_and_motion_agree_and_rotations_are_orthonormal(rough: Trajectory) -> None:
    time_s = times(rough)
    poses, motion = rough.poses(time_s), rough.motion(time_s)
    np.testing.assert_array_equal(poses.position_e, motion.position_e)
    np.testing.assert_array_equal(poses.rot_e_from_b, motion.rot_e_from_b)
    products = poses.rot_e_from_b @ np.swapaxes(poses.rot_e_from_b, 1, 2)
    np.testing.assert_allclose(products, np.broadcast_to(np.eye(3), products.shape), atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(poses.rot_e_from_b), 1.0, atol=1e-14)


@pytest.mark.parametrize("which", ["quiet", "rough", "from_ground"])
def test_four_derivatives_are_continuous_at_knots(which: str, request: pytest.FixtureRequest) -> None:
    trajectory: Trajectory = request.getfixturevalue(which)
    knots = STEP_S * np.arange(10, int(trajectory.end_s / STEP_S) - 10)
    step_s = STEP_S / 8
    left, right = (
        np.stack(
            [trajectory.motion(np.asarray(knots + side * k * step_s, np.float64)).acceleration_e for k in range(4)]
        )
        for side in (-1, 1)
    )
    # between knots the acceleration is a cubic, whose derivatives at a knot follow exactly from four values on a side
    jerk = np.array([-11.0, 18.0, -9.0, 2.0]) / 6.0 / step_s
    snap = np.array([2.0, -5.0, 4.0, -1.0]) / step_s**2
    for order, weights in ((1, jerk), (2, snap)):
        ahead = np.einsum("k,kni->ni", weights, right)
        behind = (-1) ** order * np.einsum("k,kni->ni", weights, left)
        np.testing.assert_allclose(ahead, behind, atol=1e-8 / step_s ** (order - 1))


def test_reported_states_match_the_poses(rough: Trajectory) -> None:
    time_s = times(rough, 0.5)
    poses = rough.poses(time_s)
    lat, lon, height = rough.geodetic(time_s)
    np.testing.assert_allclose(
        np.stack(ECEF.transform(np.degrees(lon), np.degrees(lat), height), axis=-1), poses.position_e, atol=1e-6
    )
    rot_l_from_b = np.swapaxes(rot_e_from_l(poses.position_e), 1, 2) @ poses.rot_e_from_b
    heading, pitch, roll = Rotation.from_matrix(rot_l_from_b).as_euler("ZYX").T
    want = np.stack([roll, pitch, heading % (2 * np.pi)])
    np.testing.assert_allclose(np.stack(rough.attitude(time_s)), want, atol=1e-7)
    np.testing.assert_allclose(rough.velocity_l(time_s), velocity_l(rough, time_s), atol=1e-5)


def test_the_spline_goes_through_its_values() -> None:
    knots = np.arange(-40, 80)
    rng = np.random.default_rng(6)
    inner = STEP_S * np.linspace(-36, 75, 997)
    for degree in range(6):
        polynomial = np.polynomial.Polynomial(rng.uniform(-1.0, 1.0, degree + 1))
        spline = spline_through(-40, polynomial(STEP_S * knots)[:, np.newaxis])
        np.testing.assert_allclose(spline(inner)[:, 0], polynomial(inner), atol=1e-12)
    assert np.isnan(spline(STEP_S * np.array([-36.1, 75.1]))).all()


@pytest.mark.parametrize("half", [0, 3, 16, 77, 200])
def test_the_kernel_preserves_straight_lines_and_limits_its_peak(half: int) -> None:
    weights = kernel(half)
    assert len(weights) == 2 * half + 1
    np.testing.assert_array_equal(weights, weights[::-1])
    assert weights.sum() == pytest.approx(1.0)
    if half >= 16:
        assert weights.max() * half <= PEAK
    line = 3.0 + 0.25 * np.arange(1000.0)
    np.testing.assert_allclose(smoothed(line, half, 200), line[200:-200], atol=1e-11)


# ---------------------------------------------------------------------------------------------- how it flies


@pytest.mark.parametrize("wind_mps", [[0.0, 0.0], [10.0, -15.0]])
def test_no_sideways_force_acts_in_flight(wind_mps: list[float]) -> None:
    trajectory = flown({"flight": {"wind_mps": wind_mps}})
    force_b = specific_force_b(trajectory, times(trajectory))
    assert np.abs(force_b[:, 1]).max() < 2e-5
    assert force_b[:, 2].max() < -5.0


def test_bank_follows_from_speed_and_rate_of_turn() -> None:
    """In a steady level turn at constant speed tan(roll) = v ω / g."""
    lines = [
        {"name": "a", "from_m": [0.0, 0.0], "to_m": [2000.0, 0.0], "height_m": 900.0},
        {"name": "b", "from_m": [2000.0, -2600.0], "to_m": [0.0, -2600.0], "height_m": 900.0},
    ]
    trajectory = flown({"line": lines})
    first, second = trajectory.lines
    middle_s = np.linspace(first.end_s + 4.0 + 8.0, second.start_s - 4.0 - 8.0, 50)[:12]
    roll, _, _ = trajectory.attitude(middle_s)
    north, east, _ = velocity_l(trajectory, middle_s).T
    before, after = (velocity_l(trajectory, middle_s + shift) for shift in (-0.01, 0.01))
    course_rate = (np.arctan2(after[:, 1], after[:, 0]) - np.arctan2(before[:, 1], before[:, 0])) % (2 * np.pi) / 0.02
    want = np.hypot(north, east) * course_rate / 9.806
    assert math.degrees(roll.min()) > 20.0
    np.testing.assert_allclose(np.tan(roll), want, atol=2e-3)  # Coriolis: 2 Ω v / g


def test_limits_of_the_plan_hold() -> None:
    changes = {"flight": {"bank_max_deg": 30.0, "climb_max_mps": 3.0, "pitch_deg": 5.0}}
    trajectory = flown(changes)
    time_s = times(trajectory)
    roll, _, _ = trajectory.attitude(time_s)
    assert 27.0 < math.degrees(np.abs(roll).max()) <= 30.0
    assert math.degrees(np.abs(np.gradient(roll, time_s)).max()) <= 15.0
    down = velocity_l(trajectory, time_s)[:, 2]
    assert 1.0 < np.abs(down).max() <= 3.0 + 1e-6
    speed = np.linalg.norm(velocity_l(trajectory, time_s)[:, :2], axis=1)
    assert speed.min() > 43.0
    assert speed.max() < 60.1


def test_a_climb_that_is_too_long_for_a_turn_lengthens_the_path() -> None:
    lines = plan_with().tables.model_dump()["line"]
    lines[1]["height_m"] = 1500.0
    short, long = flown(), flown({"line": lines, "flight": {"climb_max_mps": 3.0}})
    gap_s = long.lines[1].start_s - long.lines[0].end_s
    assert short.lines[1].start_s - short.lines[0].end_s < 120.0
    assert 600.0 / 3.0 + 8.0 <= gap_s <= 600.0 / 3.0 + 130.0
    time_s = times(long)
    assert np.abs(velocity_l(long, time_s)[:, 2]).max() <= 3.0 + 1e-6
    assert math.degrees(np.abs(long.attitude(time_s)[0]).max()) <= 25.0


def test_attitude_angles_have_the_documented_signs(quiet: Trajectory) -> None:
    east, south, west = ((line.start_s + line.end_s) / 2 for line in quiet.lines)
    roll, pitch, heading = (np.degrees(angle) for angle in quiet.attitude(np.array([east, south, west])))
    assert np.abs(roll).max() < 0.07  # 2 Ω v / g
    assert pitch == pytest.approx([2.0, 2.0, 2.0], abs=1e-3)  # over a metre the ellipsoid bends by 1e-5°
    lon, lat, _ = geodetic(quiet.poses(np.array([east, east + 1, south, south + 1])).position_e)
    azimuth, _, _ = Geod(ellps="WGS84").inv(lon[::2], lat[::2], lon[1::2], lat[1::2])
    assert heading[:2] == pytest.approx(azimuth % 360.0, abs=1e-5)
    assert heading == pytest.approx([90.0, 180.0 + math.degrees(math.atan2(400, 2400)), 270.0], abs=0.02)


def test_right_turns_bank_right_and_climbs_raise_the_nose() -> None:
    lines = [
        {"name": "a", "from_m": [0.0, 0.0], "to_m": [2000.0, 0.0], "height_m": 900.0},
        {"name": "b", "from_m": [5000.0, -3000.0], "to_m": [5000.0, -6000.0], "height_m": 1100.0},
    ]
    trajectory = flown({"line": lines})
    time_s = np.linspace(trajectory.lines[0].end_s, trajectory.lines[1].start_s, 500)
    roll, pitch, heading = (np.degrees(angle) for angle in trajectory.attitude(time_s))
    assert roll.max() > 20.0
    assert roll.min() > -0.1
    assert pitch.min() > 1.99
    north, east, down = velocity_l(trajectory, time_s).T
    assert down.min() < -2.0
    np.testing.assert_allclose(pitch, 2.0 - np.degrees(np.arctan(down / np.hypot(north, east))), atol=2e-4)
    assert (np.diff(heading) > -1e-3).all()
    rate = trajectory.motion(time_s).rate_eb_b
    assert rate[:, 2].max() > 0.05  # to the right about the axis that points down


def test_the_nose_points_into_the_relative_wind() -> None:
    trajectory = flown({"flight": {"wind_mps": [0.0, -12.0]}})
    east = (trajectory.lines[0].start_s + trajectory.lines[0].end_s) / 2
    _, _, heading = trajectory.attitude(np.array([east]))
    # on a course of east with wind from the north, the nose points left of the course
    assert math.degrees(heading[0]) == pytest.approx(90.0 - math.degrees(math.atan2(12.0, 60.0)), abs=0.01)


# ---------------------------------------------------------------------------------------------- turbulence


LONG = [{"name": "a", "from_m": [-40000.0, 0.0], "to_m": [40000.0, 0.0], "height_m": 900.0}]


@pytest.mark.parametrize(("turbulence", "factor"), [("light", 1.0), ("moderate", 2.5), ("severe", 5.0)])
def test_turbulence_has_the_magnitude_of_its_name(turbulence: str, factor: float) -> None:
    changes = {"line": LONG, "flight": {"turbulence": turbulence, "seed": 5}}
    still, trajectory = flown({"line": LONG}), flown(changes)
    time_s = times(trajectory, 0.25)
    shaking = trajectory.velocity_l(time_s) - still.velocity_l(time_s)
    assert np.std(shaking, axis=0) == pytest.approx(factor * np.array([0.2, 0.2, 0.3]), rel=0.15)
    tilt = np.stack(trajectory.attitude(time_s)) - np.stack(still.attitude(time_s))
    assert np.degrees(np.std(tilt, axis=1)) == pytest.approx(factor * np.array([0.5, 0.25, 0.2]), rel=0.15)
    assert np.abs(np.mean(shaking, axis=0)).max() < 0.01 * factor
    drift_m = np.linalg.norm(trajectory.poses(time_s).position_e - still.poses(time_s).position_e, axis=1)
    assert drift_m.max() < 3.0 * factor


def test_the_same_seed_gives_the_same_bytes() -> None:
    rough = {"flight": {"turbulence": "moderate", "seed": 3}}
    time_s = np.linspace(0.0, 200.0, 777)
    first, again = flown(rough).motion(time_s), flown(rough).motion(time_s)
    other = flown({"flight": {"turbulence": "moderate", "seed": 4}}).motion(time_s)
    for name in ("position_e", "velocity_e", "acceleration_e", "rot_e_from_b", "rate_eb_b"):
        assert getattr(first, name).tobytes() == getattr(again, name).tobytes()
        assert not np.array_equal(getattr(first, name), getattr(other, name))


def test_results_do_not_depend_on_how_times_are_requested(rough: Trajectory) -> None:
    time_s = times(rough)
    whole = rough.poses(time_s)
    for part in np.array_split(np.arange(len(time_s)), 7):
        np.testing.assert_array_equal(rough.poses(time_s[part]).position_e, whole.position_e[part])
        np.testing.assert_array_equal(rough.poses(time_s[part]).rot_e_from_b, whole.rot_e_from_b[part])


# ---------------------------------------------------------------------------------------------- from the ground


def test_a_parked_aircraft_stands_exactly_still(from_ground: Trajectory) -> None:
    time_s = np.linspace(0.0, 30.0, 5001)
    motion = from_ground.motion(time_s)
    assert not motion.velocity_e.any()
    assert not motion.acceleration_e.any()
    assert not motion.rate_eb_b.any()
    np.testing.assert_allclose(motion.position_e - motion.position_e[0], 0.0, atol=2e-9)
    course = np.radians(60.0)
    start = np.array([-4000.0, -3000.0]) - 150.0 * np.array([np.sin(course), np.cos(course)])
    assert plane(from_ground, time_s[:1])[0] == pytest.approx([*start, TERRAIN_M + 1.5], abs=1e-4)
    roll, pitch, heading = (np.degrees(angle) for angle in from_ground.attitude(time_s))
    assert np.abs(roll).max() < 1e-6
    assert np.abs(pitch).max() < 1e-6
    convergence = math.degrees(start[0] * math.tan(math.radians(47.5)) / 6.39e6)
    assert heading == pytest.approx(np.full(5001, 60.0 + convergence), abs=1e-3)


def test_a_start_taxies_runs_and_climbs_out(from_ground: Trajectory) -> None:
    time_s = np.arange(30.0, from_ground.lines[0].start_s, 0.1)
    places, (roll, pitch, _) = plane(from_ground, time_s), from_ground.attitude(time_s)
    velocity = velocity_l(from_ground, time_s)
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    course = np.radians(60.0)
    along = (places[:, 0] + 4000.0) * np.sin(course) + (places[:, 1] + 3000.0) * np.cos(course)
    across = (places[:, 0] + 4000.0) * np.cos(course) - (places[:, 1] + 3000.0) * np.sin(course)
    taxiing = along < -60.0
    assert speed[taxiing].max() == pytest.approx(8.0, abs=0.05)
    rolling = speed < 0.8 * 60.0 - 12.0  # well before the nose comes up
    on_ground = np.cumsum(~rolling) == 0
    assert np.abs(places[on_ground, 2] - TERRAIN_M - 1.5).max() < 1e-6
    assert np.abs(across[on_ground]).max() < 1e-5
    assert np.abs(np.degrees([roll[on_ground], pitch[on_ground]])).max() < 1e-6
    assert np.gradient(speed, 0.1)[on_ground].max() == pytest.approx(2.5, abs=0.01)
    climb = -velocity[:, 2]
    assert climb.max() <= 5.0 + 1.5  # moving air adds to it
    assert climb.max() > 4.5
    assert math.degrees(pitch.max()) > 5.0
    assert from_ground.lines[0].start_s < 400.0


@pytest.mark.parametrize("taxi_m", [0.0, 10.0, 5000.0])
def test_any_taxiway_leads_to_the_runway(taxi_m: float) -> None:
    trajectory = flown({"ground": GROUND | {"taxi_m": taxi_m, "static_s": 0.0}})
    time_s = np.arange(0.0, trajectory.lines[0].start_s, 0.1)
    places = plane(trajectory, time_s)
    course = np.radians(60.0)
    start = np.array([-4000.0, -3000.0]) - taxi_m * np.array([np.sin(course), np.cos(course)])
    assert places[0, :2] == pytest.approx(start, abs=1e-4)
    assert np.linalg.norm(places[:, :2] - [-4000.0, -3000.0], axis=1).min() < 5.0
    assert math.degrees(np.abs(trajectory.attitude(time_s)[0]).max()) <= 25.0


# ---------------------------------------------------------------------------------------------- presets and mistakes


@pytest.mark.parametrize(("name", "longest_s"), [("small", 150.0), ("calibration", 680.0), ("corridor", 300.0)])
def test_presets_can_be_flown(name: str, longest_s: float) -> None:
    plan = load_plan(name).changed({"flight": {"turbulence": "none"}})
    trajectory = fly(plan, Site.at(*plan.tables.flight.origin_deg), flat)
    assert trajectory.end_s <= longest_s
    time_s = times(trajectory)
    roll, _, _ = trajectory.attitude(time_s)
    assert math.degrees(np.abs(roll).max()) <= plan.tables.flight.bank_max_deg
    assert math.degrees(np.abs(np.gradient(roll, time_s)).max()) <= 15.0
    down = velocity_l(trajectory, time_s)[:, 2]
    assert np.abs(down).max() <= plan.tables.flight.climb_max_mps + 1e-6
    assert np.abs(np.gradient(down, time_s)).max() <= 1.5


def line_changed(index: int, **changes: Any) -> dict[str, Any]:
    lines = plan_with().tables.model_dump(exclude_unset=True)["line"]
    lines[index] |= changes
    return {"line": lines}


MISTAKES = {
    "line[1].name": (line_changed(1, name="east"), "'east' is also the name of line[0]; choose another"),
    "line[0].from_m": (
        line_changed(0, from_m=[500_000.0, 5_200_000.0]),
        "5224 km from flight.origin_deg; give metres east and north of it, at most 100 km away",
    ),
    "line[2].to_m": (
        line_changed(2, to_m=[1460.0, -200.0]),
        "a line of 40.0 m; make it at least 60 m long, one second of flight",
    ),
    "line[1].height_m": (
        line_changed(1, height_m=460.0),
        "460 m is only 10.0 m above the terrain 0 m from its start (east 300, north 1200); plan at least 465 m",
    ),
    "line[2].height_m": (
        line_changed(2, height_m=11000.0),
        "9960 m of climb to this line takes 33 min at 5 m/s; plan at most 9000 m, or a larger flight.climb_max_mps",
    ),
    "flight.lead_s": (
        {"flight": {"lead_s": 1.0}},
        "1 s is too short to roll out of a bank of 25° at 12°/s; set at least 1.7 s",
    ),
    "flight.wind_mps": (
        {"flight": {"wind_mps": [-20.0, 15.0]}},
        "25.0 m/s is more than half the speed of the slowest line, 45 m/s; set less",
    ),
    "flight.turn_radius_m": (
        {"flight": {"turn_radius_m": 500.0}},
        "500 m is tighter than flight.bank_max_deg of 25° at 60 m/s allows; set 812 m or more",
    ),
    "flight.bank_max_deg": (
        {"flight": {"bank_max_deg": 5.0, "speed_mps": 140.0}},
        "turns of 24 km radius; set a bank and a speed that keep it below 20 km",
    ),
    "ground.height_m": (
        {"ground": GROUND | {"height_m": 500.0}},
        "500 m differs from the terrain's height, 450.0 m; give a height within 10 m of it",
    ),
    "ground.runway_m": (
        {"ground": GROUND | {"runway_m": [0.0, -150_000.0]}},
        "150 km from flight.origin_deg; give metres east and north of it, at most 100 km away",
    ),
}


@pytest.mark.parametrize("key", MISTAKES)
def test_error_for_a_plan_that_cannot_be_flown_names_its_key(key: str) -> None:
    changes, text = MISTAKES[key]
    with pytest.raises(PlanError) as caught:
        flown(changes)
    assert str(caught.value) == f"{key}: {text}"
    assert caught.value.key == key


def test_error_for_a_line_below_a_hill_gives_the_place() -> None:
    plan = plan_with()

    def hill(east_m: FloatArray, north_m: FloatArray) -> FloatArray:
        return np.asarray(TERRAIN_M + 500.0 * np.exp(-((east_m - 600.0) ** 2 + (north_m + 200.0) ** 2) / 200.0**2))

    below = r"^line\[0\]\.height_m: 900 m is 50\.0 m below the terrain 2100 m from its start \(east 600, north -200\);"
    with pytest.raises(PlanError, match=below + " plan at least 965 m$"):
        fly(plan, Site.at(*plan.tables.flight.origin_deg), hill)


def test_a_wider_turn_than_needed_is_flown_as_asked() -> None:
    changes = {"flight": {"turn_radius_m": 1500.0}}
    trajectory = flown(changes)
    roll, _, _ = trajectory.attitude(times(trajectory))
    assert math.degrees(np.abs(roll).max()) == pytest.approx(math.degrees(math.atan(60.0**2 / 1500.0 / 9.806)), abs=0.3)
