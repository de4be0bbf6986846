"""Tests analytic derivatives against central differences of the model, and printed ones (FORMULAS 5.2, 5.3)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pyproj import Transformer
from scipy.spatial.transform import Rotation

from swath.georef.arrays import FloatArray, StructArray
from swath.georef.points import Rays
from swath.georef.scanner.beams import LineGeometry
from swath.georef.scanner.calibration import INDEX, PARAMETERS, Calibration, nominal
from swath.georef.scanner.jacobian import OBSERVATIONS, columns_l, observation_columns_e, parameter_columns_e
from swath.georef.scanner.mount import Mount, Stage
from swath.georef.scanner.sensor_model import SensorModel
from swath.georef.trajectory.trajectory import Trajectory
from tests.georef.scanner_cases import CASES, TURNED, Case, rows_of, still_trajectory

pytestmark = pytest.mark.xdist_group("kernels")

TO_ECEF = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
RELATIVE = 1e-7
STEPS = {"range_offset_m": 1.0, "time_offset_s": 1e-3, "imu_latency_s": 1e-3, "encoder_latency_s": 1e-5}
STEPS |= {"torsion_s2": 1e-7, "lever_arm_x_m": 1.0, "lever_arm_y_m": 1.0, "lever_arm_z_m": 1.0}
ANGLE_STEP = 1e-3
ROLLING = Mount((Stage(np.array([0.1, -0.05, 0.3]), np.array([0.2, 0.1, 0.3])), Stage(np.array([-0.2, 0.0, 0.1]))))


def tumbling() -> Trajectory:
    """Return a body that flies and turns fast near the earth's centre, where coordinates have all their digits."""
    epochs = np.arange(5)
    position: FloatArray = np.array([0.6, -1.2, 0.3]) * epochs[:, np.newaxis].astype(np.float64)
    position[2:] += 0.3
    turned = Rotation.from_rotvec(np.outer(epochs, [0.05, -0.02, 0.09])) * Rotation.from_euler("ZYX", [1.2, -0.1, 0.2])
    unsaid = np.full((5, 3), np.nan)
    quaternions = turned.as_quat(scalar_first=True)
    return Trajectory(epochs * 20_000_000, position, quaternions, unsaid, unsaid, unsaid, 30_000_000, "tumbling")


class Shots:
    """Twenty pulses in the middle of an interval between epochs."""

    def __init__(self, case: Case, mount: Mount) -> None:
        rng = np.random.default_rng(3)
        self.case, self.mount, self.trajectory = case, mount, tumbling()
        self.rows: StructArray = rows_of(
            rng.uniform(-1.0, 1.0, 20) * case.reading_rad,
            rng.uniform(300.0, 3000.0, 20),
            channel=rng.integers(0, case.channels, 20),
            intensity=rng.uniform(0.0, 2000.0, 20),
            **case.elevations(rng, 20),
        )
        self.time_ns = rng.integers(25_000_000, 31_000_000, 20)
        self.motion = rng.uniform(-50.0, 50.0, 20), rng.uniform(-1e4, 1e4, 20)

    def model(self, calibration: Calibration) -> SensorModel:
        """Return the model with these parameters."""
        return SensorModel(calibration, self.case.geometry, mount=self.mount)

    def rays(self, calibration: Calibration, *, with_axes: bool = False) -> Rays:
        """Return the rays of the model."""
        rate, acceleration = self.motion
        rays = self.model(calibration).rays(
            self.rows,
            self.time_ns,
            self.trajectory,
            encoder_rate=rate,
            encoder_acceleration=acceleration,
            with_axes=with_axes,
        )
        assert not rays.fate.any()
        return rays


def slope_of(points: list[FloatArray], step: float) -> FloatArray:
    """Return the slope by central differences of points at −h, −h/2, h/2, h, extrapolated to remove h²."""
    wide, narrow = (points[3] - points[0]) / (2 * step), (points[2] - points[1]) / step
    return (4.0 * narrow - wide) / 3.0


@pytest.mark.parametrize("mount", [Mount(), ROLLING], ids=["rigid", "gimbal"])
@pytest.mark.parametrize("kind", CASES)
def test_parameter_derivatives_match_central_differences(kind: str, mount: Mount) -> None:
    case = CASES[kind]
    shots, calibration = Shots(case, mount), case.calibration()
    columns = parameter_columns_e(shots.rays(calibration, with_axes=True), shots.model(calibration), shots.trajectory)
    assert columns.shape == (20, len(PARAMETERS), 3)
    for name, index in INDEX.items():
        if name in case.geometry.without:
            assert not columns[:, index].any()
            continue
        step = STEPS.get(name, ANGLE_STEP)
        if kind == "risley" and name == "scan_angle_scale":
            step = 1e-6  # the angle has hundreds of radians
        at = calibration.value(name)
        moved = [shots.rays(calibration.changed(**{name: at + f * step})).points_e for f in (-1, -0.5, 0.5, 1)]
        slope = slope_of(moved, step)
        size = np.linalg.norm(slope, axis=1).max()
        error = np.linalg.norm(slope - columns[:, index], axis=1).max()
        assert error <= RELATIVE * size, (name, error / size)
        assert size > 0.0, name


@pytest.mark.parametrize("kind", ["polygon", "aimed"])
def test_observation_derivatives_match_central_differences(kind: str) -> None:
    case, time_ns = CASES[kind], np.full(3, 5_000_000)
    raised = {"elevation_rad": np.array([-1.2, 0.3, 0.9])} if case.raised_rad else {}
    rows = rows_of([-0.6, 0.1, 0.9], [900.0, 1500.0, 800.0], channel=[0, 1, 3], **raised)
    place = {"lat_rad": 0.82, "lon_rad": 0.15, "height_m": 1500.0}
    attitude = {"roll_rad": 0.05, "pitch_rad": -0.03, "heading_rad": 1.3}
    calibration = case.calibration(encoder_latency_s=0.0, torsion_s2=0.0)
    names = [*OBSERVATIONS, *raised]
    model = SensorModel(calibration, case.geometry)

    def rays(change: dict[str, float], *, with_axes: bool = False) -> tuple[Rays, Trajectory]:
        said = {name: np.full(2, value + change.get(name, 0.0)) for name, value in (place | attitude).items()}
        lat, lon, height, roll, pitch, heading = said.values()
        trajectory = Trajectory.from_geodetic(
            np.array([0, 10_000_000]), lat, lon, height, np.zeros((2, 3)), roll, pitch, heading
        )
        move = np.array([change.get(f"{axis}_e", 0.0) for axis in "xyz"])
        trajectory = replace(trajectory, position_e=trajectory.position_e + move)
        read = rows.copy()
        for name in ("range_m", "encoder_rad", *raised):
            read[name] += change.get(name, 0.0)
        return model.rays(read, time_ns, trajectory, with_axes=with_axes), trajectory

    seen, trajectory = rays({}, with_axes=True)
    columns = observation_columns_e(seen, model, trajectory)
    assert columns.shape == (3, len(names), 3)
    for index, name in enumerate(names):
        step = 10.0 if name.endswith(("_e", "_m")) else 1e-2
        moved = [rays({name: f * step})[0].points_e for f in (-1, -0.5, 0.5, 1)]
        slope = slope_of(moved, step)
        error = np.linalg.norm(slope - columns[:, index], axis=1) / np.linalg.norm(slope, axis=1)
        assert error.max() < RELATIVE, (name, error.max())


# --- printed columns (FORMULAS 5.2) ---------------------------------------------------------------------------------

OFFSET_M, RANGE_SCALE, ANGLE_OFFSET, ANGLE_SCALE = 0.12, 2e-5, np.radians(0.02), 3e-4
RANGE_M, THETA = 1043.217, np.radians(17.5)
PRINTED_L = {  # north, east, down
    "omega_rad": (946.831323, -240.454502, -366.451401),
    "phi_rad": (257.393935, 960.392912, 35.762995),
    "kappa_rad": (80.950827, 303.359701, 11.421014),
    "lever_arm_x_m": (0.25866138, 0.96533741, 0.0348994967),
    "lever_arm_y_m": (-0.965074791, 0.25670008, 0.0523040746),
    "lever_arm_z_m": (0.0415323763, -0.0472096686, 0.998021197),
    "range_offset_m": (0.330753947, -0.123485701, 0.935624448),  # ∂/∂Δρ
    "range_scale": (345.080929, -128.834625, 976.152082),  # with Δρ scaled too
    "scan_angle_offset_rad": (947.36404, -239.600132, -366.526961),  # ∂/∂Δθ
    "scan_angle_scale": (289.599692, -73.2433589, -112.043619),
    "scan_plane_tilt_rad": (269.35039, 1007.28487, 37.725152),
    "time_offset_s": (87.784794, -29.289757, -12.867005),
    "imu_latency_s": (29.784794, -22.289757, -13.467005),
    "encoder_latency_s": (69424.5838, -17558.3395, -26859.7716),
    "roll_rad": (947.233332, -240.55854, -366.553211),
    "pitch_rad": (252.760563, 943.315265, 34.99646),
    "heading_rad": (128.732765, 345.22128, 0.0),
}


def published_flight() -> Trajectory:
    """Return a millisecond around the published pose, with its velocity and its rates of roll, pitch and heading."""
    lat_deg, lon_deg = 47.1234567, 8.7
    middle_e = np.array(TO_ECEF.transform(lon_deg, lat_deg, 1512.3))
    rot_e_l = Rotation.from_euler("ZY", [lon_deg, -lat_deg - 90.0], degrees=True)
    seconds = np.array([-5e-4, 5e-4])[:, np.newaxis]
    position = middle_e + rot_e_l.apply(seconds * np.array([58.0, -7.0, 0.6]))
    attitude = np.array([3.0, -2.0, 75.0]) + seconds * np.array([2.0, -1.1, 0.7])
    quaternions = (rot_e_l * Rotation.from_euler("ZYX", attitude[:, ::-1], degrees=True)).as_quat(scalar_first=True)
    unsaid = np.full((2, 3), np.nan)
    return Trajectory(np.array([0, 1_000_000]), position, quaternions, unsaid, unsaid, unsaid)


def test_columns_match_the_formula_sheet() -> None:
    """By the header of FORMULAS, its Δρ stands inside the scale, and its Δθ has the opposite sign."""
    errors = dict(zip(("omega_rad", "phi_rad", "kappa_rad"), np.radians([0.05, -0.08, 0.03]), strict=True))
    errors |= {"range_offset_m": (1 + RANGE_SCALE) * OFFSET_M, "range_scale": RANGE_SCALE}
    errors |= {"scan_angle_offset_rad": -ANGLE_OFFSET, "scan_angle_scale": ANGLE_SCALE}
    errors |= {"scan_plane_tilt_rad": np.radians(0.01)}
    calibration = nominal("left", [0.15, -0.08, 0.42], TURNED).changed(**errors)
    model, trajectory = SensorModel(calibration, LineGeometry()), published_flight()
    rays = model.rays(
        rows_of(THETA, RANGE_M),
        np.array([500_000]),
        trajectory,
        encoder_rate=np.radians([4200.0]),
        encoder_acceleration=np.zeros(1),
        with_axes=True,
    )
    by_parameter = columns_l(parameter_columns_e(rays, model, trajectory), rays, trajectory)[0]
    by_observation = columns_l(observation_columns_e(rays, model, trajectory), rays, trajectory)[0]
    ours = {name: by_parameter[index] for name, index in INDEX.items()}
    ours |= {name: by_observation[index] for index, name in enumerate(OBSERVATIONS)}
    along = ours["range_offset_m"].copy()
    ours["range_scale"] = ours["range_scale"] + OFFSET_M * along
    ours["range_offset_m"] = (1 + RANGE_SCALE) * along
    ours["scan_angle_offset_rad"] = -ours["scan_angle_offset_rad"]
    for name, printed in PRINTED_L.items():
        assert ours[name] == pytest.approx(printed, rel=1e-8, abs=1e-6 if name != "encoder_latency_s" else 1e-4), name


def test_first_order_effects_on_flat_ground_match_the_formula_sheet() -> None:
    """FORMULAS 5.3 lists forward, right, down for level flight at H = 1000 m and θ = 20°."""
    theta = np.radians(20.0)
    model = SensorModel(nominal("left", [0, 0, 0], np.eye(3)), LineGeometry())
    rays = model.rays(
        rows_of(theta, 1000.0 / np.cos(theta)), np.array([500_000_000]), still_trajectory(), with_axes=True
    )
    columns = parameter_columns_e(rays, model, still_trajectory())[0]
    want = {
        "omega_rad": (0, -1000, 363.97023),
        "phi_rad": (1000, 0, 0),
        "kappa_rad": (-363.97023, 0, 0),
        "range_offset_m": (0, 0.34202014, 0.93969262),
        "scan_angle_offset_rad": (0, -1000, 363.97023),  # like ω = −Δθ, so they cannot be separated
        "scan_angle_scale": (0, 349.06585, -127.04958),
        "scan_plane_tilt_rad": (-1064.1778, 0, 0),
        "pitch_slope": (1000 * theta, 0, 0),
    }
    for name, effect in want.items():
        assert columns[INDEX[name]] == pytest.approx(effect, rel=1e-7, abs=1e-7), name


def test_rays_without_axes_have_no_columns() -> None:
    model = SensorModel(nominal("left", [0, 0, 0], np.eye(3)), LineGeometry())
    rays = model.rays(rows_of(0.0, 100.0), np.array([5]), still_trajectory())
    with pytest.raises(ValueError, match="rays without axes; want rays"):
        parameter_columns_e(rays, model, still_trajectory())
