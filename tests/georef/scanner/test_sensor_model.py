"""Tests the sensor model against pyproj and SciPy, everywhere on earth, with every scanner and error at once."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from pyproj import Transformer
from scipy.spatial.transform import Rotation, Slerp

from swath.georef.arrays import FloatArray, Int64Array, StructArray
from swath.georef.geodesy.rotations import boresight, rot_x
from swath.georef.points import Fate, Rays
from swath.georef.scanner.beams import LineGeometry
from swath.georef.scanner.calibration import Calibration, RangeOffset, nominal
from swath.georef.scanner.mount import Mount, Stage
from swath.georef.scanner.sensor_model import SensorModel
from swath.georef.trajectory.trajectory import Trajectory
from tests.georef.scanner_cases import CASES, IBRC, TURNED, Case, rows_of, still_trajectory

pytestmark = pytest.mark.xdist_group("kernels")

TO_ECEF = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
GEOMETRIES = 1200
STEP_NS = 20_000_000  # between the two epochs of each geometry
EVERY_NS = 1_000_000_000  # from one geometry to the next
START_NS = 1_450_000_000_000_000_000
UNIT = nominal("left", [0, 0, 0], np.eye(3))


@dataclass
class Flights:
    """Many short flights all over the earth, one second apart, with two epochs each."""

    time_ns: Int64Array
    lat_rad: FloatArray
    lon_rad: FloatArray
    height_m: FloatArray
    attitude_rad: FloatArray  # roll, pitch, heading

    @classmethod
    def all_over_the_earth(cls, rng: np.random.Generator) -> Flights:
        count = GEOMETRIES
        lat = rng.uniform(-np.pi / 2, np.pi / 2, count)
        lon = rng.uniform(-np.pi, np.pi, count)
        lat[:40], lat[40:80] = np.pi / 2 - np.geomspace(1e-9, 1e-2, 40), -np.pi / 2 + np.geomspace(1e-9, 1e-2, 40)
        lat[80], lat[81] = np.pi / 2, -np.pi / 2
        lon[100:150] = np.pi - rng.uniform(0, 1e-6, 50)  # the second epochs lie beyond the antimeridian
        lat[150:200] = rng.uniform(-1e-6, 1e-6, 50)
        height = rng.uniform(300.0, 6000.0, count)
        attitude = rng.uniform([-0.3, -0.2, 0.0], [0.3, 0.2, 2 * np.pi], (count, 3))
        second = [lat - np.sign(lat) * 2e-7, lon + 3e-6, height + 0.5]
        turned = attitude + rng.uniform(-0.3, 0.3, (count, 3))  # up to 15 rad/s
        time_ns = START_NS + EVERY_NS * np.arange(count)[:, np.newaxis] + np.array([0, STEP_NS])
        lat, lon, height = (np.stack(pair, axis=1).ravel() for pair in zip([lat, lon, height], second, strict=True))
        return cls(time_ns.ravel(), lat, lon, height, np.stack([attitude, turned], axis=1).reshape(-1, 3))

    def trajectory(self) -> Trajectory:
        """Return the trajectory for the model."""
        still = np.zeros((len(self.time_ns), 3))
        return Trajectory.from_geodetic(
            self.time_ns, self.lat_rad, self.lon_rad, self.height_m, still, *self.attitude_rad.T, max_gap_ns=STEP_NS
        )

    def poses(self, time_s: FloatArray, attitude_s: FloatArray) -> tuple[FloatArray, Rotation]:
        """Return positions (n, 3), m, and attitudes in e, seconds after each first epoch, by pyproj and SciPy."""
        x, y, z = TO_ECEF.transform(np.degrees(self.lon_rad), np.degrees(self.lat_rad), self.height_m)
        ends = np.stack([x, y, z], axis=1).reshape(-1, 2, 3)
        share = (time_s / (STEP_NS * 1e-9))[:, np.newaxis]
        ned = Rotation.from_euler("ZY", np.stack([self.lon_rad, -self.lat_rad - np.pi / 2], axis=1))
        body = ned * Rotation.from_euler("ZYX", self.attitude_rad[:, ::-1])
        epochs = [0.0, STEP_NS * 1e-9]
        turned = [Slerp(epochs, body[2 * k : 2 * k + 2])(attitude_s[k]).as_quat() for k in range(GEOMETRIES)]
        return (1 - share) * ends[:, 0] + share * ends[:, 1], Rotation.from_quat(np.array(turned))


@dataclass
class Shots:
    """One pulse for each flight, and the encoder's motion."""

    rows: StructArray
    time_ns: Int64Array
    rate: FloatArray
    acceleration: FloatArray

    @classmethod
    def of(cls, case: Case, flights: Flights, rng: np.random.Generator) -> Shots:
        count = GEOMETRIES
        rows = rows_of(
            rng.uniform(-case.reading_rad, case.reading_rad, count),
            rng.uniform(200.0, 9000.0, count),
            channel=rng.integers(0, case.channels, count),
            intensity=rng.uniform(-10.0, 2500.0, count),
            return_number=rng.integers(1, 4, count),
            mta_zone=rng.integers(0, 4, count),
            **case.elevations(rng, count),
        )
        time_ns = flights.time_ns[::2] + rng.integers(4_000_000, 14_000_000, count)
        return cls(rows, time_ns, rng.uniform(-80.0, 80.0, count), rng.uniform(-2e4, 2e4, count))

    def rays(self, model: SensorModel, trajectory: Trajectory, *, with_axes: bool = False) -> Rays:
        """Return the rays of the model."""
        return model.rays(
            self.rows,
            self.time_ns,
            trajectory,
            encoder_rate=self.rate,
            encoder_acceleration=self.acceleration,
            with_axes=with_axes,
        )


def expected(case: Case, calibration: Calibration, flights: Flights, shots: Shots) -> FloatArray:
    """Return ground points (n, 3), m, in e, computed from the page of conventions by pyproj and SciPy."""
    value, rows = calibration.value, shots.rows
    rho = (1 + value("range_scale")) * rows["range_m"] + value("range_offset_m")
    rho -= np.interp(rows["intensity"], *IBRC)
    rho += np.where(rows["return_number"] == 1, 0.012, 0.0) + np.where(rows["mta_zone"] == 2, -0.03, 0.0)
    if case.beam_range_m is not None:
        rho += case.beam_range_m[rows["channel"]]
    for channel, beam in calibration.beams.items():
        rho += np.where(rows["channel"] == channel, beam.range_m, 0.0)
    theta = (1 + value("scan_angle_scale")) * (rows["encoder_rad"] - value("scan_angle_offset_rad"))
    theta += value("encoder_latency_s") * shots.rate + value("torsion_s2") * shots.acceleration
    points_s = case.points_s(calibration, rows, theta, rho)
    angles = np.stack(
        [
            np.full_like(theta, value("omega_rad")),
            value("phi_rad") + value("pitch_slope") * theta,
            np.full_like(theta, value("kappa_rad")),
        ],
        axis=1,
    )
    arm_b = calibration.lever_arm_b + Rotation.from_euler("XYZ", angles).apply(points_s @ TURNED.T)
    time_s = np.asarray(1e-9 * (shots.time_ns - flights.time_ns[::2]) + value("time_offset_s"), dtype=np.float64)
    body_e, rot_e_from_b = flights.poses(time_s, time_s + value("imu_latency_s"))
    points_e: FloatArray = body_e + rot_e_from_b.apply(arm_b)
    return points_e


@pytest.mark.slow
@pytest.mark.parametrize("kind", CASES)
def test_the_model_is_exact_everywhere_on_earth_with_every_error(kind: str) -> None:
    case, rng = CASES[kind], np.random.default_rng(5)
    flights = Flights.all_over_the_earth(rng)
    shots = Shots.of(case, flights, rng)
    slope = 0.0 if kind == "fibre" else case.calibration().value("pitch_slope")  # each fibre has its own fixed θ
    calibration = case.calibration(pitch_slope=slope)
    rays = shots.rays(SensorModel(calibration, case.geometry), flights.trajectory())
    assert (rays.fate == Fate.GEOREFERENCED).all()
    missed = np.linalg.norm(rays.points_e - expected(case, calibration, flights, shots), axis=1)
    assert missed.max() < 1e-6, (missed.max(), missed.argmax())
    assert (rays.time_ns == shots.time_ns + 1_300_000).all()


def test_axes_reproduce_the_points() -> None:
    """A point is the arm in b, rotated by the interpolated attitude and added to the body's position."""
    case, rng = CASES["spinning"], np.random.default_rng(6)
    flights = Flights.all_over_the_earth(rng)
    shots = Shots.of(case, flights, rng)
    trajectory = flights.trajectory()
    model = SensorModel(case.calibration(), case.geometry)
    rays = shots.rays(model, trajectory, with_axes=True)
    assert rays.epoch is not None
    assert rays.share is not None
    assert rays.q_e_from_b is not None
    assert rays.range_axis_b is not None
    place = trajectory.position_e
    body_e = place[rays.epoch] + rays.share[:, np.newaxis] * (place[rays.epoch + 1] - place[rays.epoch])
    rotation = Rotation.from_quat(rays.q_e_from_b, scalar_first=True)
    assert np.abs(body_e + rotation.apply(rays.arm_b) - rays.points_e).max() < 1e-8
    counted = (1 + model.calibration.value("range_scale")) * shots.rows["range_m"]
    assert np.abs(rays.points_e - counted[:, None] * rotation.apply(rays.range_axis_b) - rays.origin_e).max() < 1e-8
    assert np.array_equal(rays.points_e, shots.rays(model, trajectory).points_e)


# --- the published equation, in its four forms (FORMULAS 2.1) --------------------------------------------------------

LAT, LON, HEIGHT_M = np.radians(47.1234567), np.radians(8.7), 1512.3
LEVER_ARM_B = np.array([0.15, -0.08, 0.42])
RANGE_M, THETA = 1043.217, np.radians(17.5)
ATTITUDE_RAD = np.radians([3.0, -2.0, 75.0])
BORESIGHT_RAD = np.radians([0.21, -0.35, 0.12])
GROUND_E = np.array([4297745.87263879, 657512.472772624, 4651743.38727272])


def hovering(lat: float = LAT, lon: float = LON, height_m: float = HEIGHT_M) -> Trajectory:
    """Return ten milliseconds of trajectory in one place."""
    same = np.ones(2)
    return Trajectory.from_geodetic(
        np.array([0, 10_000_000]),
        lat * same,
        lon * same,
        height_m * same,
        np.zeros((2, 3)),
        *np.outer(ATTITUDE_RAD, same),
    )


def published_model(**changes: float) -> SensorModel:
    """Return the sensor model of FORMULAS 2.1, with changed parameters."""
    names = ("omega_rad", "phi_rad", "kappa_rad")
    calibration = nominal("left", LEVER_ARM_B, TURNED).changed(**dict(zip(names, BORESIGHT_RAD.tolist(), strict=True)))
    return SensorModel(calibration.changed(**changes), LineGeometry())


def matrices() -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return x_b^e, R_l^e, R_b^l, R_s^b, computed by pyproj and SciPy."""
    body_e = np.array(TO_ECEF.transform(np.degrees(LON), np.degrees(LAT), HEIGHT_M))
    rot_e_l = Rotation.from_euler("ZY", [LON, -LAT - np.pi / 2]).as_matrix()
    rot_l_b = Rotation.from_euler("ZYX", ATTITUDE_RAD[::-1]).as_matrix()
    return body_e, rot_e_l, rot_l_b, Rotation.from_euler("XYZ", BORESIGHT_RAD).as_matrix() @ TURNED


def beam() -> FloatArray:
    """Return u(θ) of ISO Eq. 1."""
    return np.array([0.0, np.sin(THETA), np.cos(THETA)])


def form_9() -> FloatArray:
    """Return the point by ISO Eq. 9, which starts from the foot point on the ellipsoid."""
    _, rot_e_l, rot_l_b, rot_b_s = matrices()
    foot_e = np.array(TO_ECEF.transform(np.degrees(LON), np.degrees(LAT), 0.0))
    body_l = np.array([0.0, 0.0, -HEIGHT_M])
    return np.asarray(foot_e + rot_e_l @ (body_l + rot_l_b @ (LEVER_ARM_B + rot_b_s @ (RANGE_M * beam()))))


def form_10() -> FloatArray:
    """Return the point by ISO Eq. 10."""
    body_e, rot_e_l, rot_l_b, rot_b_s = matrices()
    return np.asarray(body_e + rot_e_l @ rot_l_b @ (LEVER_ARM_B + rot_b_s @ (RANGE_M * beam())))


def form_11(lever_sign: float = 1.0) -> FloatArray:
    """Return the point by ISO Eq. 11, with the lever arm in s and the sign that makes the equation true."""
    body_e, rot_e_l, rot_l_b, rot_b_s = matrices()
    lever_s = rot_b_s.T @ LEVER_ARM_B
    return np.asarray(body_e + rot_e_l @ rot_l_b @ rot_b_s @ (lever_sign * lever_s + RANGE_M * beam()))


def form_nga() -> FloatArray:
    """Return the point by NGA Eq. 3: antenna, IMU, gimbal centre, scanner."""
    body_e, rot_e_l, rot_l_b, _ = matrices()
    antenna_b = np.array([-1.2, 0.05, -1.35])
    platform = Rotation.from_euler("XYZ", BORESIGHT_RAD).as_matrix()
    gimbal = platform.T @ (0.4 * LEVER_ARM_B) + TURNED @ rot_x(-THETA) @ np.array([0.0, 0.0, RANGE_M])
    antenna_e = body_e + rot_e_l @ rot_l_b @ antenna_b
    return np.asarray(antenna_e + rot_e_l @ rot_l_b @ (-antenna_b + 0.6 * LEVER_ARM_B + platform @ gimbal))


@pytest.mark.parametrize("form", [form_9, form_10, form_11, form_nga])
def test_four_forms_of_the_equation_match_the_model(form: Callable[[], FloatArray]) -> None:
    rays = published_model().rays(rows_of(THETA, RANGE_M), np.array([4_000_000]), hovering())
    assert np.abs(form() - GROUND_E).max() < 1e-8 + 1e-8  # as printed
    assert np.abs(rays.points_e[0] - form()).max() < 1e-8 + 1e-8


def test_published_misprints_have_the_expected_size() -> None:
    truth = form_10()
    body_e, rot_e_l, rot_l_b, rot_b_s = matrices()
    beam_s = RANGE_M * beam()
    assert np.linalg.norm(form_11(-1.0) - truth) == pytest.approx(0.90620086, abs=1e-8)  # 2 |lever arm|
    outside = body_e + rot_e_l @ rot_l_b @ rot_b_s @ beam_s + LEVER_ARM_B
    assert np.linalg.norm(outside - truth) == pytest.approx(0.84779891, abs=1e-8)
    transposed = body_e + rot_e_l @ rot_l_b.T @ (LEVER_ARM_B + rot_b_s @ beam_s)
    assert np.linalg.norm(transposed - truth) == pytest.approx(629.68402, abs=1e-5)


def test_the_model_with_a_fixed_gimbal_equals_the_rigid_model() -> None:
    """The gimbal has one fixed stage with r_GIM and one that is the installation."""
    lever_gimbal = boresight(*BORESIGHT_RAD).T @ (0.4 * LEVER_ARM_B)
    mount = Mount((Stage(lever_arm=lever_gimbal), Stage(angles_rad=np.array([0.0, 0.0, np.pi]))))
    calibration = replace(published_model().calibration, installation_matrix=np.eye(3))
    lever = 0.6 * LEVER_ARM_B
    calibration = calibration.changed(**{f"lever_arm_{axis}_m": lever[k] for k, axis in enumerate("xyz")})
    model = SensorModel(calibration, LineGeometry(), mount=mount)
    rays = model.rays(rows_of(THETA, RANGE_M), np.array([4_000_000]), hovering())
    assert np.abs(rays.points_e[0] - GROUND_E).max() < 2e-8


def test_small_corrections_have_the_sizes_of_the_formula_sheet() -> None:
    """FORMULAS 9 gives the effect of encoder latency and IMU latency on the ground at H = 1000 m."""
    rows, time_ns = rows_of(0.0, 1000.0), np.array([4_000_000])
    model = SensorModel(UNIT.changed(encoder_latency_s=1e-6), LineGeometry())
    rate = np.radians([4200.0])
    turned = model.rays(rows, time_ns, still_trajectory(), encoder_rate=rate, encoder_acceleration=np.zeros(1))
    assert turned.points_e[0, 1] == pytest.approx(0.0733038, abs=1e-6)
    rolling = replace(
        still_trajectory(),
        q_e_from_b=np.array([[1.0, 0, 0, 0], [math.cos(np.radians(1)), math.sin(np.radians(1)), 0, 0]]),
    )  # 2°/s
    late = SensorModel(UNIT.changed(imu_latency_s=1e-3), LineGeometry())
    rays = [one.rays(rows, np.array([0]), rolling) for one in (late, SensorModel(UNIT, LineGeometry()))]
    assert np.linalg.norm(rays[0].points_e - rays[1].points_e) == pytest.approx(0.034906585, abs=1e-8)
    slope = 1.85e-5 / math.radians(1.0)  # of the lecture, 1.06e-3: half a metre at 30° from 902.5 m (FORMULAS 5.4)
    swept = SensorModel(UNIT.changed(pitch_slope=slope), LineGeometry())
    edge = swept.rays(rows_of(math.radians(30.0), 902.5 / math.cos(math.radians(30.0))), time_ns, still_trajectory())
    assert edge.points_e[0, 0] == pytest.approx(0.50, abs=0.005)
    torsion = SensorModel(UNIT.changed(torsion_s2=2e-9), LineGeometry())
    theta = 0.5
    pulled = -((2 * np.pi * 40.0) ** 2) * theta  # acceleration of a sine at 40 Hz
    rays_1 = torsion.rays(
        rows_of(theta, 1000.0),
        time_ns,
        still_trajectory(),
        encoder_rate=np.zeros(1),
        encoder_acceleration=np.array([pulled]),
    )
    assert rays_1.angle_rad[0] / theta - 1 == pytest.approx(-0.0001263309363, abs=1e-12)


# --- what gives no point --------------------------------------------------------------------------------------------


def test_every_return_has_one_fate() -> None:
    ms = 1_000_000
    time_ns = np.array([0, 10, 20, 500, 510]) * ms
    flat = np.zeros(5)
    trajectory = Trajectory.from_geodetic(
        time_ns, flat, flat, flat + 1000.0, np.zeros((5, 3)), flat, flat, flat, max_gap_ns=100 * ms
    )
    rows = rows_of(np.zeros(10), [800, 800, 800, 800, 99.9, 1500.1, np.nan, 800, 800, 100.0])
    rows["encoder_rad"][7] = np.inf
    stamps = np.array([5, -1, 511, 300, 5, 5, 5, 5, 510, 10]) * ms
    stamps[2] += 1
    calibration = UNIT
    rays = SensorModel(calibration, LineGeometry(), (100.0, 1500.0)).rays(rows, stamps, trajectory)
    want = [
        Fate.GEOREFERENCED,
        Fate.NO_TIME,
        Fate.OUTSIDE_TRAJECTORY,
        Fate.TRAJECTORY_GAP,
        Fate.BELOW_RANGE_GATE,
        Fate.ABOVE_RANGE_GATE,
        Fate.NOT_FINITE,
        Fate.NOT_FINITE,
        Fate.GEOREFERENCED,
        Fate.GEOREFERENCED,
    ]
    assert rays.fate.tolist() == want
    polygon = SensorModel(calibration, LineGeometry(4))
    rows["channel"][:2] = 4, 3
    assert polygon.rays(rows[:2], np.array([5 * ms, 5 * ms]), trajectory).fate.tolist() == [
        Fate.NOT_FINITE,
        Fate.GEOREFERENCED,
    ]


def test_latencies_count_for_the_trajectory_coverage() -> None:
    """A late IMU's attitude is needed at a time after the pulse, when the trajectory may have ended."""
    ns = still_trajectory().time_ns[-1]
    base = UNIT
    rows = rows_of(np.zeros(3), np.full(3, 500.0))
    stamps = ns - np.array([0, 1_000_000, 1_000_001])
    for changed in ({"imu_latency_s": 1.0000004e-3}, {"time_offset_s": 1.0000004e-3}):
        fates = SensorModel(base.changed(**changed), LineGeometry()).rays(rows, stamps, still_trajectory()).fate
        assert fates.tolist() == [Fate.OUTSIDE_TRAJECTORY, Fate.GEOREFERENCED, Fate.GEOREFERENCED]


def test_result_does_not_depend_on_the_batch() -> None:
    case, rng = CASES["polygon"], np.random.default_rng(8)
    flights = Flights.all_over_the_earth(rng)
    shots = Shots.of(case, flights, rng)
    model, trajectory = SensorModel(case.calibration(), case.geometry), flights.trajectory()
    whole = shots.rays(model, trajectory).points_e
    order = rng.permutation(GEOMETRIES)
    for part in np.array_split(order, 7):
        piece = Shots(shots.rows[part], shots.time_ns[part], shots.rate[part], shots.acceleration[part])
        assert np.array_equal(piece.rays(model, trajectory).points_e, whole[part])


def test_empty_input_gives_no_rays() -> None:
    model = SensorModel(UNIT, LineGeometry())
    assert len(model.rays(rows_of([], []), np.zeros(0, np.int64), still_trajectory(), with_axes=True).points_e) == 0
    rays = model.rays(rows_of(0.0, 10.0), np.array([5]), still_trajectory().between(-2, -1))
    assert rays.fate.tolist() == [Fate.OUTSIDE_TRAJECTORY]


def test_range_offset_is_applied_by_pulse_rate() -> None:
    calibration = replace(UNIT, range_offsets=(RangeOffset(0.5, prf_hz=1e5),))
    model = SensorModel(calibration, LineGeometry())
    rows, time_ns = rows_of(0.0, 100.0), np.array([5])
    ranges = [model.rays(rows, time_ns, still_trajectory(), prf_hz=prf).range_m[0] for prf in (None, 1.002e5, 2e5)]
    assert ranges == [100.0, 100.5, 100.0]


def test_encoder_motion_is_required_with_an_encoder_latency() -> None:
    model = SensorModel(UNIT.changed(torsion_s2=1e-9), LineGeometry())
    assert model.needs_encoder_motion
    with pytest.raises(ValueError, match="calibration of left: encoder latency and torsion need the encoder's motion"):
        model.rays(rows_of(0.0, 100.0), np.array([5]), still_trajectory())


def test_read_only_columns_are_taken() -> None:
    rows = rows_of(0.0, 100.0)
    rows.flags.writeable = False
    model = SensorModel(UNIT, LineGeometry())
    assert np.allclose(model.rays(rows, np.array([5]), still_trajectory()).points_e, [[0.0, 0.0, 100.0]], atol=1e-12)
