"""Tests trajectories against SciPy's slerp, PROJ and hand-made motions."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pyproj import Transformer
from scipy.spatial.transform import Rotation, Slerp

from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.points import Fate
from swath.georef.trajectory.trajectory import Trajectory, TrajectoryError, TrajectoryGapError, locate_epoch
from tests.georef.builders import as_rotation

pytestmark = pytest.mark.xdist_group("kernels")

TO_ECEF = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
START_NS = 2445 * 604_800_000_000_000 + 561_618_000_000_000
MS = 1_000_000


def wild(n: int = 400, seed: int = 3, **changes: Any) -> Trajectory:
    """Return a trajectory with large turns, uneven steps and every heading."""
    rng = np.random.default_rng(seed)
    columns: dict[str, Any] = {
        "time_ns": START_NS + np.cumsum(rng.integers(4 * MS, 60 * MS, n)),
        "lat_rad": np.radians(47.5) + np.cumsum(rng.normal(0, 1e-7, n)),
        "lon_rad": np.radians(8.9) + np.cumsum(rng.normal(0, 1e-7, n)),
        "height_m": 900 + np.cumsum(rng.normal(0, 0.2, n)),
        "velocity_l": rng.normal(0, 30, (n, 3)),
        "roll_rad": rng.uniform(-np.pi, np.pi, n),
        "pitch_rad": rng.uniform(-1.4, 1.4, n),
        "heading_rad": rng.uniform(0, 2 * np.pi, n),
        "position_sigma_l": rng.uniform(0.01, 0.1, (n, 3)),
        "attitude_sigma_rad": rng.uniform(1e-5, 1e-4, (n, 3)),
        "name": "wild",
    }
    return Trajectory.from_geodetic(**(columns | changes))


def inside(trajectory: Trajectory, n: int = 5000) -> Int64Array:
    """Return times (ns) over the whole span, the epochs among them."""
    first_ns, last_ns = trajectory.span
    return np.sort(np.r_[np.random.default_rng(5).integers(first_ns, last_ns, n), trajectory.time_ns])


def attitude_by_scipy(lat_rad: Any, lon_rad: Any, roll_rad: Any, pitch_rad: Any, heading_rad: Any) -> Rotation:
    ned = Rotation.from_euler("ZY", np.stack([lon_rad, -np.asarray(lat_rad) - np.pi / 2], axis=-1))
    return ned * Rotation.from_euler("ZYX", np.stack([heading_rad, pitch_rad, roll_rad], axis=-1))


# ------------------------------------------------------------------------------------------- interpolation


def test_attitude_between_epochs_matches_scipys_slerp() -> None:
    trajectory = wild()
    at = inside(trajectory)
    seconds = (trajectory.time_ns - START_NS) / 1e9
    expected = Slerp(seconds, as_rotation(trajectory.q_e_from_b))((at - START_NS) / 1e9)
    difference = (as_rotation(trajectory.poses(at).q_e_from_b) * expected.inv()).magnitude()
    assert difference.max() < 1e-12  # 1e-9 m at a kilometre, although rotations are up to π


def test_small_rotations_match_scipys_slerp() -> None:
    n = 200
    wobble = np.radians(15.0) * np.sin(np.arange(n) / 9.0)
    trajectory = wild(n, roll_rad=wobble, pitch_rad=wobble[::-1], heading_rad=np.radians(355) + wobble)
    assert 0.04 < np.linalg.norm(trajectory.rotvec_b, axis=1).max() < 0.06
    at = inside(trajectory)
    seconds = (trajectory.time_ns - START_NS) / 1e9
    expected = Slerp(seconds, as_rotation(trajectory.q_e_from_b))((at - START_NS) / 1e9)
    difference = (as_rotation(trajectory.poses(at).q_e_from_b) * expected.inv()).magnitude()
    assert difference.max() < 1e-14 * 50  # limited by SciPy's own rounding
    np.testing.assert_allclose(np.linalg.norm(trajectory.poses(at).q_e_from_b, axis=1), 1, rtol=0, atol=2e-15)


def test_position_velocity_and_sigmas_are_linear_in_time() -> None:
    trajectory = wild()
    at = inside(trajectory)
    poses = trajectory.poses(at)
    grid, where = (trajectory.time_ns - START_NS).astype(float), (at - START_NS).astype(float)
    for name in ("position_e", "velocity_e", "position_sigma_l", "attitude_sigma_rad"):
        column = getattr(trajectory, name)
        expected = np.stack([np.interp(where, grid, column[:, k]) for k in range(3)], axis=1)
        np.testing.assert_allclose(getattr(poses, name), expected, rtol=0, atol=3e-9, err_msg=name)


def test_height_follows_a_climb_between_epochs() -> None:
    """A quarter of the interval is a quarter of the climb; PDAL's filters.georeference swaps the ends' weights."""
    two: dict[str, Any] = {"lat_rad": [0.8, 0.8], "lon_rad": [0.1, 0.1], "height_m": [500.0, 500.02]}
    trajectory = wild(2, time_ns=START_NS + np.array([0, 20 * MS]), **two)
    x, y, z = trajectory.poses([START_NS + 5 * MS]).position_e[0]
    height = TO_ECEF.transform(x, y, z, direction="INVERSE")[2]
    assert height == pytest.approx(500.005, abs=1e-8)


def test_turn_rate_matches_a_steady_turn() -> None:
    """The body rolls at 0.3 rad/s, sampled at 200 Hz, over a fixed place."""
    n, rate = 100, 0.3
    times = START_NS + 5 * MS * np.arange(n)
    still: dict[str, Any] = {"lat_rad": np.full(n, 0.8), "lon_rad": np.full(n, 0.1), "height_m": np.full(n, 500.0)}
    level: dict[str, Any] = {"pitch_rad": np.full(n, 0.05), "heading_rad": np.full(n, 4.0)}
    trajectory = wild(n, time_ns=times, roll_rad=rate * (times - START_NS) / 1e9, **still, **level)
    poses = trajectory.poses(times[:-1] + MS)
    np.testing.assert_allclose(poses.rate_eb_b, np.tile([rate, 0, 0], (n - 1, 1)), atol=1e-11)
    np.testing.assert_allclose(trajectory.turn_rates_b("l"), np.tile([rate, 0, 0], (n - 1, 1)), atol=1e-11)


def test_inertial_turn_rate_includes_earth_rotation() -> None:
    """Level, heading north and at rest, the earth's rate is all about x at the equator and all about −z at the pole."""
    n = 4
    rest: dict[str, Any] = {key: np.zeros(n) for key in ("roll_rad", "pitch_rad", "heading_rad", "lon_rad")}
    for lat_rad, expected in ((0.0, [7.292115e-5, 0, 0]), (np.pi / 2, [0, 0, -7.292115e-5])):
        still = wild(n, lat_rad=np.full(n, lat_rad), height_m=np.zeros(n), **rest)
        np.testing.assert_allclose(still.turn_rates_b("i"), np.tile(expected, (n - 1, 1)), atol=1e-13)


def test_turn_rate_in_l_excludes_the_transport_rate() -> None:
    """In level flight north at 100 m/s, l itself pitches down at v / M."""
    n, step_s = 50, 0.005
    lat = 0.8 + 100 / 6_367_000 * step_s * np.arange(n)
    level: dict[str, Any] = {key: np.zeros(n) for key in ("roll_rad", "pitch_rad", "heading_rad", "lon_rad")}
    times = START_NS + 5 * MS * np.arange(n)
    trajectory = wild(n, time_ns=times, lat_rad=lat, height_m=np.zeros(n), **level)
    np.testing.assert_allclose(trajectory.turn_rates_b("l"), 0, atol=1e-12)
    np.testing.assert_allclose(trajectory.turn_rates_b("e")[:, 1], -100 / 6_367_000, rtol=1e-8)


# ------------------------------------------------------------------------------- from and to geodetic


def test_from_geodetic_matches_proj_and_scipy_everywhere() -> None:
    rng = np.random.default_rng(11)
    n = 1000
    lat, lon = np.arcsin(rng.uniform(-1, 1, n)), rng.uniform(-np.pi, np.pi, n)
    lat[:3], lon[:3] = (np.pi / 2, -np.pi / 2, 0.3), (0.4, -2.0, np.pi)
    height = rng.uniform(-400, 9000, n)
    roll, pitch, heading = rng.uniform(-3, 3, n), rng.uniform(-1.5, 1.5, n), rng.uniform(0, 2 * np.pi, n)
    velocity = rng.normal(0, 50, (n, 3))
    trajectory = Trajectory.from_geodetic(
        START_NS + MS * np.arange(n), lat, lon, height, velocity, roll, pitch, heading
    )
    expected_e = np.stack(TO_ECEF.transform(np.degrees(lon), np.degrees(lat), height), axis=1)
    np.testing.assert_allclose(trajectory.position_e, expected_e, atol=2e-8)
    body = attitude_by_scipy(lat, lon, roll, pitch, heading)
    assert (as_rotation(trajectory.q_e_from_b) * body.inv()).magnitude().max() < 1e-14
    ned = Rotation.from_euler("ZY", np.stack([lon, -lat - np.pi / 2], axis=1))
    np.testing.assert_allclose(trajectory.velocity_e, ned.apply(velocity), atol=1e-12)
    for back, there in zip(trajectory.attitude(), (roll, pitch, heading), strict=True):
        error = (back - there + np.pi) % (2 * np.pi) - np.pi
        assert abs(error[3:]).max() < 1e-12  # longitude has no meaning at the poles
    np.testing.assert_allclose(trajectory.velocity_l()[3:], velocity[3:], atol=1e-11)
    for back, there in zip(trajectory.geodetic(), (lat, lon, height), strict=True):
        np.testing.assert_allclose(back[3:], there[3:], atol=5e-9)
    assert np.isnan(trajectory.position_sigma_l).all()


def test_neighbouring_quaternions_have_the_same_sign() -> None:
    n = 720
    turning = wild(n, roll_rad=np.zeros(n), pitch_rad=np.zeros(n), heading_rad=np.linspace(0, 8 * np.pi, n))
    q = turning.q_e_from_b
    assert ((q[1:] * q[:-1]).sum(axis=1) > 0.99).all()


# --------------------------------------------------------------------------------------------- velocities


def eastwards(times_ns: Int64Array, said: FloatArray | None = None) -> Trajectory:
    """Return a trajectory along the equator whose speed grows by 2 m/s²."""
    seconds = (times_ns - START_NS) / 1e9
    lon = (60.0 * seconds + seconds**2) / 6_378_137.0
    flat: dict[str, Any] = dict.fromkeys(
        ("lat_rad", "height_m", "roll_rad", "pitch_rad", "heading_rad"), np.zeros(len(times_ns))
    )
    velocity_l = np.full((len(times_ns), 3), np.nan) if said is None else said
    return wild(len(times_ns), time_ns=times_ns, lon_rad=lon, velocity_l=velocity_l, **flat)


def test_absent_velocities_are_derived_from_positions() -> None:
    times = START_NS + 50 * MS * np.arange(40)
    found = eastwards(times).with_velocities().velocity_l()
    expected = 60.0 + 2.0 * (times - START_NS) / 1e9
    np.testing.assert_allclose(found[1:-1, 1], expected[1:-1], rtol=1e-9)
    np.testing.assert_allclose(found[[0, -1], 1], expected[[0, -1]] + [0.05, -0.05], rtol=1e-9)  # half an interval
    np.testing.assert_allclose(found[:, [0, 2]], 0.0, atol=1e-3)  # down: a chord over 6 m of the earth


def test_velocities_are_not_derived_across_gaps_or_for_a_single_epoch() -> None:
    times = START_NS + 10 * MS * np.r_[np.arange(10), 60, np.arange(160, 170)]
    trajectory = eastwards(times).with_velocities()
    found = trajectory.velocity_l()[:, 1]
    assert np.flatnonzero(np.isnan(found)).tolist() == [10]
    known = np.r_[0:10, 11:21]
    half = np.zeros(21)
    half[[0, 11]], half[[9, 20]] = 0.01, -0.01
    expected = 60.0 + 2.0 * (times - START_NS) / 1e9 + half
    np.testing.assert_allclose(found[known], expected[known], rtol=1e-9)
    poses = trajectory.poses(np.r_[times[0] + 5 * MS, times[12] + 5 * MS])
    assert np.isfinite(poses.velocity_e).all()


def test_given_velocities_are_kept() -> None:
    times = START_NS + 10 * MS * np.arange(20)
    said = np.tile([1.0, 2.0, 3.0], (20, 1))
    whole = eastwards(times, said)
    assert whole.with_velocities() is whole
    said[5, 2] = np.nan
    found = eastwards(times, said).with_velocities()
    others = np.arange(20) != 5
    np.testing.assert_array_equal(found.velocity_e[others], whole.velocity_e[others])
    assert found.velocity_l()[5, 1] == pytest.approx(60.1, abs=1e-6)


# --------------------------------------------------------------------------------------------- gaps, ends


def gapped() -> Trajectory:
    times = START_NS + 10 * MS * np.r_[np.arange(20), np.arange(60, 80)]
    return wild(40, time_ns=times)


def test_a_gap_raises_an_error_or_gives_a_fate() -> None:
    trajectory = gapped()
    before, after = trajectory.time_ns[19], trajectory.time_ns[20]
    at = np.array([before - 1, before + 1, after - 1, after])
    assert trajectory.fates(at).tolist() == [0, Fate.TRAJECTORY_GAP, Fate.TRAJECTORY_GAP, 0]
    with pytest.raises(
        TrajectoryGapError, match=r"gap in trajectory wild: from GPS week 2445, 561618\.190 s to .*561618\.600 s"
    ) as caught:
        trajectory.poses(at)
    assert (caught.value.start_ns, caught.value.end_ns) == (before, after)
    assert trajectory.gaps().tolist() == [[before, after]]


def test_an_interval_as_long_as_allowed_is_not_a_gap() -> None:
    trajectory = wild(2, time_ns=START_NS + np.array([0, 150 * MS]))
    assert not trajectory.fates([START_NS + 75 * MS]).any()
    trajectory = wild(2, time_ns=START_NS + np.array([0, 150 * MS + 1]))
    assert trajectory.fates([START_NS + 75 * MS]).tolist() == [Fate.TRAJECTORY_GAP]


def test_nothing_is_extrapolated() -> None:
    trajectory = wild()
    first, last = trajectory.span
    outside = int(Fate.OUTSIDE_TRAJECTORY)
    assert trajectory.fates([first - 1, first, last, last + 1]).tolist() == [outside, 0, 0, outside]
    with pytest.raises(TrajectoryGapError, match="after the end of trajectory wild") as late:
        trajectory.poses([first, last + 5])
    assert (late.value.start_ns, late.value.end_ns) == (last, last + 5)
    with pytest.raises(TrajectoryGapError, match="before the start") as early:
        trajectory.poses([first - 7, first])
    assert (early.value.start_ns, early.value.end_ns) == (first - 7, first)


@pytest.mark.parametrize("n", [0, 1])
def test_too_few_epochs_cover_nothing(n: int) -> None:
    trajectory = wild(n)
    assert trajectory.fates([START_NS]).tolist() == [Fate.OUTSIDE_TRAJECTORY]
    assert trajectory.poses([]).position_e.shape == (0, 3)
    assert len(trajectory.between(0, START_NS)) == n


def test_epoch_found_does_not_depend_on_the_guess() -> None:
    times = np.array([0, 10, 20, 30, 40], dtype=np.int64)
    expected = {-1: -1, 0: 0, 9: 0, 10: 1, 19: 1, 20: 2, 39: 3, 40: 3, 41: -1}
    for t, epoch in expected.items():
        assert {locate_epoch(times, t, guess) for guess in range(-2, 9)} == {epoch}


def test_part_of_a_trajectory_gives_the_same_poses() -> None:
    trajectory = wild()
    first, last = int(trajectory.time_ns[100]) + 3, int(trajectory.time_ns[200]) - 3
    part = trajectory.between(first, last)
    assert len(part) == 101
    at = np.r_[np.arange(first, last, 3 * MS), last]
    for name in ("position_e", "q_e_from_b", "rate_eb_b"):
        np.testing.assert_array_equal(getattr(part.poses(at), name), getattr(trajectory.poses(at), name))


def test_times_that_do_not_increase_are_refused() -> None:
    times = START_NS + 10 * MS * np.arange(5)
    times[3] = times[2]
    with pytest.raises(TrajectoryError, match=r"wild: time does not increase at GPS week 2445, 561618\.020 s"):
        wild(5, time_ns=times)


# ------------------------------------------------------------------------------- reference point, deflection


def test_body_position_is_derived_from_the_antenna() -> None:
    trajectory = wild(300, seed=8)
    arm_b = np.array([0.4, -0.2, -1.3])
    turn = as_rotation(trajectory.q_e_from_b)
    antenna_e = trajectory.position_e + turn.apply(arm_b)
    columns = {name: getattr(trajectory, name) for name in ("time_ns", "q_e_from_b", "velocity_e")}
    sigmas = (trajectory.position_sigma_l, trajectory.attitude_sigma_rad)
    of_antenna = Trajectory(columns["time_ns"], antenna_e, columns["q_e_from_b"], columns["velocity_e"], *sigmas)
    np.testing.assert_allclose(of_antenna.at_body(arm_b).position_e, trajectory.position_e, atol=3e-9)


def test_body_velocity_differs_from_the_antenna_velocity_in_a_turn() -> None:
    """Turning right at 0.1 rad/s over one spot, heading north, an antenna 2 m ahead moves right, that is east."""
    n = 201
    times = START_NS + 5 * MS * np.arange(n)
    heading = 0.1 * (times - times[100]) / 1e9
    still: dict[str, Any] = {key: np.full(n, value) for key, value in (("lat_rad", 0.8), ("lon_rad", 0.1))}
    level: dict[str, Any] = {"height_m": np.full(n, 500.0), "roll_rad": np.zeros(n), "pitch_rad": np.zeros(n)}
    speed = np.stack([-0.2 * np.sin(heading), 0.2 * np.cos(heading), np.zeros(n)], axis=1)
    antenna = wild(n, time_ns=times, velocity_l=speed, heading_rad=heading, **still, **level)
    np.testing.assert_allclose(antenna.velocity_l()[100], [0, 0.2, 0], atol=1e-12)
    np.testing.assert_allclose(antenna.at_body([2.0, 0, 0]).velocity_l(), 0, atol=1e-6)
    # the rotation over a gap does not affect the turn rate of the epochs beside it
    kept = np.r_[0:80, 150:n]
    gap = wild(
        len(kept),
        time_ns=times[kept],
        velocity_l=speed[kept],
        heading_rad=np.where(kept < 100, heading[kept], heading[kept] + 1.0),
        max_gap_ns=10 * MS,
        **{key: values[kept] for key, values in (still | level).items()},
    )
    turned = np.linalg.norm(gap.velocity_e - gap.at_body([2.0, 0, 0]).velocity_e, axis=1)
    np.testing.assert_allclose(turned, 0.2, atol=1e-6)


def test_deflection_tilts_the_attitude_as_in_the_formula_sheet() -> None:
    """With ξ +8″, η −5″, 1000 m along the plumb line end 38.8 mm south and 24.2 mm east of the normal's foot."""
    level: dict[str, Any] = {key: np.zeros(3) for key in ("roll_rad", "pitch_rad", "heading_rad")}
    trajectory = wild(3, lat_rad=np.full(3, np.radians(47.1234567)), lon_rad=np.full(3, np.radians(8.7)), **level)
    tilted = trajectory.with_deflection(np.radians(8 / 3600), np.radians(-5 / 3600))
    ned = as_rotation(trajectory.q_e_from_b)  # level and north: b is l
    down_l = (ned.inv() * as_rotation(tilted.q_e_from_b)).apply([0, 0, 1000.0])
    np.testing.assert_allclose(down_l, np.tile([-0.0388, 0.0242, 1000.0], (3, 1)), atol=5e-5)
    assert abs(np.sin(tilted.attitude()[2])).max() < 1e-9  # heading stays geodetic


def test_positions_without_attitude_cannot_be_used_for_georeferencing() -> None:
    bare = wild(5, roll_rad=np.full(5, np.nan))
    assert not bare.has_attitude
    with pytest.raises(TrajectoryError, match="positions but no attitude; georeferencing needs roll, pitch"):
        bare.require_attitude()
    np.testing.assert_allclose(bare.poses(bare.time_ns).position_e, bare.position_e)
