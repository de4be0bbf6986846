"""Tests gravity against published values and the normal potential, and samples against closed forms."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import simpson
from scipy.spatial.transform import Rotation

from swath.georef.arrays import FloatArray
from swath.sim.gravity import EARTH_RATE_RADPS, gravity_at, gravity_e, normal_gravity
from swath.sim.imu.grades import GRADES, noise_of, sensor_grades
from swath.sim.imu.sensors import (
    InertialUnit,
    SensorErrors,
    drift_constants,
    drift_level,
    specific_force,
    true_increments,
)
from swath.sim.plan.errors import PlanError
from swath.sim.plan.plan import parse_plan
from swath.sim.plan.tables import ImuNoiseTable, ImuTable, OscillatorTable
from swath.sim.site import e_from_geodetic, geodetic_from_e
from tests.sim.inertial_motion import ROUGH_PLAN, circling_the_pole, rough_flight, standing

OMEGA = 7.292115e-5
STANDARD_GRAVITY = 9.80665


def unit(trajectory: Any, seed: int = 1, *, noisy: bool = True, **keys: Any) -> InertialUnit:
    return InertialUnit(ImuTable(**keys), trajectory, seed, "main", noise=noisy)


# -- gravity


def test_gravity_on_the_ellipsoid_matches_the_published_values() -> None:
    """NIMA TR8350.2, table 3.4, gives the values at the equator, at a pole, and the mean over the ellipsoid."""
    equator, pole = normal_gravity(np.array([0.0, 1.0]), np.zeros(2))
    np.testing.assert_allclose([equator, pole], [9.7803253359, 9.8321849378], rtol=0, atol=1.5e-10)
    nodes, weights = np.polynomial.legendre.leggauss(60)
    sine = np.sin(nodes * np.pi / 2)
    area = weights * np.cos(nodes * np.pi / 2) / (1 - 0.00669437999014 * sine**2) ** 2
    assert np.average(normal_gravity(sine, 0 * sine), weights=area) == pytest.approx(9.7976432222, abs=1.5e-10)


def test_gravity_and_its_gradient_at_45_degrees_match_grs_80() -> None:
    """GRS 80 has 9.806199203 m/s² (Moritz 2000); WGS 84 has a smaller GM, and the same shape and centrifugal part."""
    sine = np.full(2, np.sqrt(0.5))
    ground, above = normal_gravity(sine, np.array([0.0, 1.0]))
    centrifugal = OMEGA**2 * 6388838.3 / 2  # N cos² φ
    expected = (9.806199203 + centrifugal) * (3986004.418 / 3986005.0) - centrifugal
    assert ground == pytest.approx(expected, abs=1e-9)
    assert above - ground == pytest.approx(-3.086e-6, abs=1e-9)  # the free-air gradient of every textbook


def normal_potential(point: FloatArray) -> float:
    """Return W of the level ellipsoid at x, z (Heiskanen and Moritz 1967, Eq. 2-62), centrifugal part included."""
    gm, a, b, omega = 3.986004418e14, 6378137.0, 6356752.3142, OMEGA
    e = np.sqrt(a * a - b * b)
    x, z = point
    sum_ = x * x + z * z - e * e
    u = np.sqrt(0.5 * sum_ * (1 + np.sqrt(1 + (2 * e * z / sum_) ** 2)))
    sin_beta = z / u

    def q(v: float) -> float:
        """Compute the function by its series, 2-57, because the closed form loses all digits."""
        n = np.arange(1, 12)
        return float((2 * (-1.0) ** (n + 1) * n / ((2 * n + 1) * (2 * n + 3)) * (e / v) ** (2 * n + 1)).sum())

    shape = 0.5 * omega**2 * a**2 * q(u) / q(b) * (sin_beta**2 - 1 / 3)
    return float(gm / e * np.arctan(e / u) + shape + 0.5 * omega**2 * x * x)


@pytest.mark.parametrize("lat_deg", [0.0, 30.0, 47.5, 75.0])
@pytest.mark.parametrize("height_m", [0.0, 500.0, 3000.0])
def test_gravity_above_the_ellipsoid_is_the_gradient_of_the_potential(lat_deg: float, height_m: float) -> None:
    """The series is first order in flattening, which errs by 2γ/a · 3f² = 1e-10 m/s² per metre.

    It stops at h², which errs by 5e-9 m/s² at 3 km.
    """
    lat = np.radians(lat_deg)
    up, step = np.array([np.cos(lat), np.sin(lat)]), 50.0
    place = e_from_geodetic(np.array([lat]), np.zeros(1), np.array([height_m]))[0, [0, 2]]
    slope = (normal_potential(place + step * up) - normal_potential(place - step * up)) / (2 * step)
    limit = 2e-9 + 1e-10 * height_m + 4 * 9.8 * (height_m / 6378137.0) ** 3
    assert normal_gravity(np.array([np.sin(lat)]), np.array([height_m]))[0] == pytest.approx(-slope, abs=limit)


def test_gravity_points_down_the_normal_in_proj_and_compiled_code() -> None:
    rng = np.random.default_rng(5)
    lat, lon, height = rng.uniform(-1.57, 1.57, 100), rng.uniform(-3.1, 3.1, 100), rng.uniform(-400, 9000, 100)
    points_e = e_from_geodetic(lat, lon, height)
    lower = e_from_geodetic(lat, lon, height - 1000.0)
    down = (lower - points_e) / 1000.0
    expected = down * normal_gravity(np.sin(lat), height)[:, None]
    np.testing.assert_allclose(gravity_e(points_e), expected, rtol=0, atol=2e-11)
    np.testing.assert_allclose([gravity_at(*point) for point in points_e], expected, rtol=0, atol=2e-11)


# -- what perfect sensors measure


def test_an_imu_at_rest_measures_gravity_upwards_and_the_earth_rate() -> None:
    lat, heading, height_m = np.radians(47.5), np.radians(35.0), 470.0
    still = unit(standing(3.0, 47.5, height_m, attitude_deg=(35, 0, 0)), grade="perfect", rate_hz=100)
    _, force, rate = still.samples(1, 300)
    gravity = normal_gravity(np.sin([lat]), np.array([height_m]))[0]
    np.testing.assert_allclose(force, np.tile([0.0, 0.0, -gravity], (300, 1)), rtol=0, atol=1e-9)
    north, east, down = OMEGA * np.cos(lat), 0.0, -OMEGA * np.sin(lat)
    forward, right = north * np.cos(heading) + east, -north * np.sin(heading)
    np.testing.assert_allclose(rate, np.tile([forward, right, down], (300, 1)), rtol=0, atol=1e-14)


def test_pitch_up_gives_forward_force_and_roll_right_gives_leftward_force() -> None:
    _, force, _ = unit(standing(1.0, attitude_deg=(0, 10, 0)), grade="perfect").samples(1, 1)
    assert force[0, 0] / np.linalg.norm(force[0]) == pytest.approx(np.sin(np.radians(10.0)), abs=1e-9)
    _, force, _ = unit(standing(1.0, attitude_deg=(0, 0, 10)), grade="perfect").samples(1, 1)
    assert force[0, 1] / np.linalg.norm(force[0]) == pytest.approx(-np.sin(np.radians(10.0)), abs=1e-9)


def test_a_steady_turn_gives_the_centripetal_force_of_inertial_space() -> None:
    """Around the pole the turn and the earth's rotation add to ρ (ω + Ω)² towards the axis, less the attraction."""
    radius_m, turn, z_m = 800.0, 0.075, 6357500.0
    circle = circling_the_pole(4.0, radius_m, turn, z_m)
    _, force, rate = unit(circle, grade="perfect", rate_hz=50).samples(1, 200)
    lat, _, height_m = geodetic_from_e(np.array([[radius_m, 0.0, z_m]]))
    gravity = normal_gravity(np.sin(lat), height_m)
    attraction = gravity * np.cos(lat) + OMEGA**2 * radius_m  # towards the axis
    outward = attraction - radius_m * (turn + OMEGA) ** 2
    expected = np.array([0.0, outward[0], -(gravity * np.sin(lat))[0]])
    np.testing.assert_allclose(force, np.tile(expected, (200, 1)), rtol=0, atol=1e-9)
    np.testing.assert_allclose(rate, np.tile([0.0, 0.0, -(turn + OMEGA)], (200, 1)), rtol=0, atol=1e-14)
    assert radius_m * turn**2 == pytest.approx(-outward[0], rel=5e-3)


def test_a_lever_arm_changes_the_radius_of_a_steady_turn() -> None:
    shorter = circling_the_pole(1.0, 798.0, 0.075, 6357499.5)
    edges_s = np.arange(0.0, 1.0, 0.01)
    there = true_increments(circling_the_pole(1.0, 800.0, 0.075, 6357500.0), edges_s, np.array([0.0, -2.0, 0.5]))
    np.testing.assert_allclose(there.velocity_b, true_increments(shorter, edges_s).velocity_b, rtol=0, atol=1e-11)


@pytest.mark.parametrize("rate_hz", [10, 100, 200, 1000])
def test_increments_match_a_fine_quadrature(rate_hz: int, tmp_path: Path) -> None:
    flight = rough_flight(tmp_path)
    edges_s = 31.0 + np.arange(41) / rate_hz
    fine = int(np.ceil(2000 / rate_hz)) * 2
    time_s = edges_s[:-1, None] + np.linspace(0.0, 1.0 / rate_hz, fine + 1)
    motion = flight.motion(time_s.ravel())
    to_b = Rotation.from_matrix(motion.rot_e_from_b).inv()
    rate_b = (motion.rate_eb_b + to_b.apply([0.0, 0.0, OMEGA])).reshape(*time_s.shape, 3)
    force_e = motion.acceleration_e + np.cross([0.0, 0.0, 2 * OMEGA], motion.velocity_e) - gravity_e(motion.position_e)
    force_b = to_b.apply(force_e).reshape(*time_s.shape, 3)
    made = true_increments(flight, edges_s)
    step_s = 1.0 / rate_hz / fine
    np.testing.assert_allclose(made.angle_b, simpson(rate_b, dx=step_s, axis=1), rtol=0, atol=1e-9 / rate_hz)
    np.testing.assert_allclose(made.velocity_b, simpson(force_b, dx=step_s, axis=1), rtol=0, atol=1e-7 / rate_hz)
    np.testing.assert_allclose(specific_force(motion), force_b.reshape(-1, 3), rtol=0, atol=1e-9)


def test_increments_use_the_axes_and_clock_of_the_unit() -> None:
    """The unit is mounted with x right and y backward; its clock is 100 ppm fast, so intervals and means shrink."""
    mounted = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    still = standing(3.0, attitude_deg=(20, 4, 2))
    fast = OscillatorTable(offset_ppm=100.0)
    _, force_b, rate_b = unit(still, grade="perfect").samples(1, 500)
    end_s, force, rate = unit(still, grade="perfect", rotation_b_imu=mounted, oscillator=fast).samples(1, 500)
    np.testing.assert_allclose(end_s, np.arange(1, 501) / 200 / 1.0001, rtol=0, atol=1e-12)
    for of_unit, of_body in ((force, force_b), (rate, rate_b)):
        turned = np.stack([of_body[:, 1], -of_body[:, 0], of_body[:, 2]], axis=1)
        np.testing.assert_allclose(of_unit, turned / 1.0001, rtol=1e-9)


# -- its errors


def pooled_allan(values: FloatArray, rate_hz: int, tau_s: float) -> float:
    """Return the Allan deviation at τ, with adjacent clusters (IEEE Std 952-1997, C.3), pooled over columns."""
    size = round(tau_s * rate_hz)
    clusters = len(values) // size
    means = values[: clusters * size].reshape(clusters, size, -1).mean(axis=1)
    return float(np.sqrt(0.5 * np.mean(np.diff(means, axis=0) ** 2)))


def expected_allan(white: float, drift: float, constants_s: FloatArray, tau_s: float, clusters: int) -> tuple[Any, Any]:
    """Return the Allan deviation at τ of white noise and Gauss-Markov processes, and one sigma of its estimate.

    The estimate is from one column. With covariances c_k of cluster means k apart, differences have d_k = 2 c_k −
    c_{k+1} − c_{k−1}, and the Allan variance is d_0 / 2. As the differences are Gaussian, the variance of the mean of
    their squares is 2/M Σ (1 − |k|/M) d_k².
    """
    lag = np.arange(clusters + 1)
    n = tau_s / constants_s[:, None]
    later = ((1 - np.exp(-n)) / n) ** 2 * np.exp(-(lag - 1) * n)
    means = np.where(lag == 0, 2 / n * (1 - (1 - np.exp(-n)) / n), later)
    covariance = drift**2 * means.sum(axis=0) + np.where(lag == 0, white**2 / tau_s, 0.0)
    before = np.abs(np.arange(clusters) - 1)
    d = 2 * covariance[:-1] - covariance[1:] - covariance[before]
    count = clusters - 1
    weight = np.where(lag[:count] == 0, 1.0, 2.0) * (1 - lag[:count] / count)
    spread = np.sqrt(2 / count * (weight * d[:count] ** 2).sum()) / d[0]
    deviation = np.sqrt(d[0] / 2)
    return deviation, 0.5 * spread * deviation


@pytest.mark.parametrize("grade", ["navigation", "tactical", "mems"])
def test_random_walk_at_one_second_matches_the_grade(grade: Any) -> None:
    """600 s of six sensors at rest determine it to 6 % (three sigmas); at a second nearly all noise is white."""
    rate_hz, seconds = 20, 600
    _, force, rate = unit(standing(seconds + 1.0), grade=grade, rate_hz=rate_hz).samples(1, seconds * rate_hz)
    for values, sensor in zip((force, rate), sensor_grades(ImuTable(grade=grade)), strict=True):
        constants_s = drift_constants(3600.0)
        drift = sensor.instability / drift_level(constants_s)
        for tau_s in (1.0, 4.0):
            clusters = int(seconds / tau_s)
            expected, sigma = expected_allan(sensor.random_walk, drift, constants_s, tau_s, clusters)
            assert pooled_allan(values, rate_hz, tau_s) == pytest.approx(expected, abs=3 * sigma / np.sqrt(3))
            if tau_s == 1.0:
                assert 1.0 <= expected / sensor.random_walk < 1.05


def test_drift_level_matches_the_requested_instability() -> None:
    """Short constants make the drift larger than the white noise; the maximum of its curve is the instability."""
    keys = {"gyro_bias_instability_deg_per_h": 30.0, "accel_bias_instability_mg": 0.5, "bias_correlation_h": 80 / 3600}
    table = ImuTable(grade="navigation", rate_hz=10, noise=ImuNoiseTable(**keys))
    seconds, constants_s = 6000, np.array([80.0, 20.0])
    errors = SensorErrors(table, 3, "main", noise=True)
    values = np.concatenate([errors.of_second(second) for second in range(seconds)])
    for columns, sensor in zip((values[:, :3], values[:, 3:]), sensor_grades(table), strict=True):
        drift = sensor.instability / drift_level(constants_s)
        tops = []
        for tau_s in (5.0, 20.0, 60.0, 150.0):
            clusters = int(seconds / tau_s)
            expected, sigma = expected_allan(sensor.random_walk, drift, constants_s, tau_s, clusters)
            assert pooled_allan(columns, 10, tau_s) == pytest.approx(expected, abs=3 * sigma / np.sqrt(3))
            tops.append(expected)
        assert max(tops) == pytest.approx(sensor.instability, rel=0.02)


def test_default_drift_is_level_over_two_decades() -> None:
    """Flicker noise is within a tenth of its maximum from a minute to half an hour."""
    constants_s = drift_constants(3600.0)
    drift = 1.0 / drift_level(constants_s)
    curve = [expected_allan(0.0, drift, constants_s, tau_s, 4)[0] for tau_s in np.geomspace(60.0, 1800.0, 30)]
    assert 0.9 < min(curve)
    assert max(curve) <= 1.0


def test_turn_on_errors_have_the_spread_of_the_grade() -> None:
    """One sigma of a variance of 900 draws is √(2/900), so three are 14 %."""
    table = ImuTable(grade="mems")
    noise, limit = noise_of(table), 3 * np.sqrt(2 / 900)
    drawn = [SensorErrors(table, seed, "main", noise=True) for seed in range(300)]
    sigmas = {
        "accel_bias_mg": np.stack([one.bias[:3] for one in drawn]) / (1e-3 * STANDARD_GRAVITY),
        "gyro_bias_deg_per_h": np.degrees(np.stack([one.bias[3:] for one in drawn])) * 3600,
        "accel_scale_ppm": 1e6 * np.stack([np.diag(one.matrices[0]) - 1 for one in drawn]),
        "gyro_scale_ppm": 1e6 * np.stack([np.diag(one.matrices[1]) - 1 for one in drawn]),
        "misalignment_mrad": 1e3 * np.stack([one.matrices[0][[0, 0, 1], [1, 2, 2]] for one in drawn]),
    }
    for key, values in sigmas.items():
        assert np.mean(values**2) / noise[key] ** 2 == pytest.approx(1.0, abs=limit), key
    for one in drawn:
        np.testing.assert_array_equal(one.matrices, one.matrices.transpose(0, 2, 1))


def test_outputs_are_the_truth_with_the_drawn_errors() -> None:
    still = standing(2.0, attitude_deg=(30, 20, -15))
    quiet = {"angle_random_walk_deg_per_sqrt_h": 0.0, "velocity_random_walk_m_per_s_per_sqrt_h": 0.0}
    quiet |= {"gyro_bias_instability_deg_per_h": 0.0, "accel_bias_instability_mg": 0.0}
    one = unit(still, grade="mems", noise=ImuNoiseTable(**quiet))
    perfect = unit(still, grade="perfect")
    drawn = one.drawn()
    _, force, rate = one.samples(1, 100)
    _, true_force, true_rate = perfect.samples(1, 100)
    expected = true_force @ drawn["accel_matrix"].T + drawn["accel_bias_mps2"]
    np.testing.assert_allclose(force, expected, rtol=0, atol=1e-12)
    expected = true_rate @ drawn["gyro_matrix"].T + drawn["gyro_bias_radps"]
    np.testing.assert_allclose(rate, expected, rtol=0, atol=1e-15)
    assert np.abs(force - true_force).max() > 1e-3


def test_a_flight_without_noise_is_perfect_with_any_grade() -> None:
    still = standing(1.0)
    without = unit(still, grade="mems", noisy=False)
    for got, expected in zip(without.samples(1, 50), unit(still, grade="perfect").samples(1, 50), strict=True):
        np.testing.assert_array_equal(got, expected)


def unit_of(flight: Any, seed: int, grade: str = "tactical") -> FloatArray:
    parts = unit(flight, seed, grade=grade).samples(1, 1000)
    return np.concatenate([parts[0][:, None], *parts[1:]], axis=1)


def test_values_depend_only_on_the_seed(tmp_path: Path) -> None:
    flight = rough_flight(tmp_path)
    whole = unit_of(flight, 1)
    piecewise = unit(flight, 1)
    cuts = [1, 2, 150, 199, 200, 201, 640, 1001]
    pieces = {a: piecewise.samples(a, b - a) for a, b in reversed(list(pairwise(cuts)))}
    together = [np.concatenate([pieces[a][column] for a in cuts[:-1]]) for column in range(3)]
    np.testing.assert_array_equal(np.concatenate([together[0][:, None], *together[1:]], axis=1), whole)
    assert not np.array_equal(unit_of(flight, 2), whole)


def test_samples_begin_and_end_with_the_flight() -> None:
    slow = unit(standing(10.0), oscillator=OscillatorTable(offset_ppm=-1000.0), rate_hz=100)
    assert slow.last == 999
    assert slow.samples(999, 1)[0] <= 10.0
    assert slow.count(0.0) == 0
    assert [slow.count(float(slow.ends_s(np.array([7]))[0]) + shift) for shift in (-1e-9, 0.0)] == [6, 7]
    assert slow.samples(5, 0)[1].shape == (0, 3)
    for first, count in ((0, 1), (999, 2)):
        with pytest.raises(ValueError, match="the flight has 1 to 999"):
            slow.samples(first, count)


def test_grades_are_ordered_and_single_keys_override_them() -> None:
    order = ["perfect", "navigation", "tactical", "mems", "consumer"]
    for key in set(ImuNoiseTable.model_fields) - {"bias_correlation_h"}:
        values = [getattr(GRADES[grade], key) for grade in order]
        assert values == sorted(values), key
    noise = noise_of(ImuTable(grade="tactical", noise=ImuNoiseTable(gyro_bias_deg_per_h=0.0)))
    assert (noise["gyro_bias_deg_per_h"], noise["accel_bias_mg"]) == (0.0, 1.0)
    assert EARTH_RATE_RADPS == OMEGA


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            'grade = "best"',
            r"^imu\.main\.grade: got 'best', want 'navigation', 'tactical', 'mems', 'consumer' or 'perfect'$",
        ),
        ("noise = { gyro_bias = 1.0 }", r"^imu\.main\.noise\.gyro_bias: unknown key$"),
        ("noise = { accel_bias_mg = -1.0 }", r"^imu\.main\.noise\.accel_bias_mg: got -1\.0, want greater"),
    ],
)
def test_a_plan_with_an_unknown_grade_is_refused(text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(PlanError, match=message):
        parse_plan(f"{ROUGH_PLAN}\n[imu.main]\n{text}\n", tmp_path)


@pytest.mark.parametrize("row", [[0.0, 0.0, -1.0], [0.0, 0.1, 1.0]])
def test_a_matrix_that_is_not_a_rotation_is_refused(row: list[float]) -> None:
    with pytest.raises(PlanError, match=r"^imu\.main\.rotation_b_imu: not a rotation"):
        unit(standing(1.0), rotation_b_imu=[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], row])
