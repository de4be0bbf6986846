"""Tests predicted covariances against draws of all inputs through a model of NumPy, SciPy and PROJ."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from pyproj import Transformer
from scipy.spatial.transform import Rotation

from swath.georef.arrays import FloatArray
from swath.georef.points import Fate
from swath.georef.records import RETURN_DTYPE
from swath.georef.scanner.beams import LineGeometry
from swath.georef.scanner.calibration import PARAMETERS, Calibration, nominal
from swath.georef.scanner.jacobian import observation_columns_e, parameter_columns_e
from swath.georef.scanner.mount import Mount, Stage
from swath.georef.scanner.sensor_model import SensorModel
from swath.georef.scanner.uncertainty import Noise, Uncertainty, UncertaintyError
from swath.georef.trajectory.trajectory import Trajectory

pytestmark = pytest.mark.xdist_group("kernels")


NAMES = [parameter.name for parameter in PARAMETERS]
TO_ECEF = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
DRAWS, GEOMETRIES = 20_000, 100  # the sample's own scatter is 1 % of a variance: 4 % is four sigmas
START_NS, STEP_NS = 1_479_297_618_000_000_000, 5_000_000
NOISE = Noise(range_m=0.02, angle_rad=3e-5, time_s=2e-5, divergence_rad=3e-4)
NOMINAL = nominal("left", np.zeros(3), np.eye(3))
DEG = np.pi / 180
# value and sigma of each parameter; each sigma is large enough to matter beside the others
SIZES = {
    "omega_rad": (0.5 * DEG, 4e-5),
    "phi_rad": (0.5 * DEG, 4e-5),
    "kappa_rad": (0.5 * DEG, 8e-5),
    "range_offset_m": (0.3, 0.02),
    "range_scale": (5e-5, 2e-5),
    "scan_angle_offset_rad": (0.05 * DEG, 3e-5),
    "scan_angle_scale": (3e-4, 6e-5),
    "scan_plane_tilt_rad": (0.02 * DEG, 4e-5),
    "lever_arm_x_m": (0.3, 0.02),
    "lever_arm_y_m": (0.3, 0.02),
    "lever_arm_z_m": (0.5, 0.02),
    "time_offset_s": (2e-4, 3e-4),
    "imu_latency_s": (1e-3, 5e-4),
    "encoder_latency_s": (1e-6, 5e-7),
    "torsion_s2": (2e-9, 2e-9),
    "pitch_slope": (2e-4, 8e-5),
}


USUAL = [name for name in NAMES if name in ("omega_rad", "phi_rad", "kappa_rad") or name.startswith(("range", "lever"))]


@dataclass
class Geometry:
    """One return and everything that determines its point."""

    calibration: Calibration
    lat_deg: float
    lon_deg: float
    height_m: float
    attitude_rad: FloatArray  # roll, pitch, heading at the first of two epochs
    velocity_l: FloatArray
    rate_b: FloatArray
    position_sigma_l: FloatArray
    attitude_sigma_rad: FloatArray
    range_m: float
    encoder_rad: float
    encoder_rate: float
    encoder_acceleration: float

    @property
    def rot_e_from_l(self) -> FloatArray:
        """Return the rotation (3, 3) from l to e."""
        columns: FloatArray = Rotation.from_euler("ZY", [self.lon_deg, -self.lat_deg - 90.0], degrees=True).as_matrix()
        return columns

    def trajectory(self) -> Trajectory:
        """Return two epochs of steady motion."""
        step_s = STEP_NS * 1e-9
        start = np.array(TO_ECEF.transform(self.lon_deg, self.lat_deg, self.height_m))
        step_e = self.rot_e_from_l @ self.velocity_l * step_s
        e_from_l = Rotation.from_matrix(self.rot_e_from_l)
        body = e_from_l * Rotation.from_euler("ZYX", self.attitude_rad[::-1])
        turned = body * Rotation.from_rotvec(self.rate_b * step_s)
        return Trajectory(
            START_NS + np.array([0, STEP_NS]),
            np.stack([start, start + step_e]),
            np.roll(np.stack([body.as_quat(), turned.as_quat()]), 1, axis=1),
            np.tile(self.rot_e_from_l @ self.velocity_l, (2, 1)),
            np.tile(self.position_sigma_l, (2, 1)),
            np.tile(self.attitude_sigma_rad, (2, 1)),
        )

    def covariance_e(self, noise: Noise, incidence_rad: FloatArray | None = None) -> FloatArray:
        """Return the covariance (6,) of the point, 1.5 ms after the first epoch."""
        rows = np.zeros(1, RETURN_DTYPE)
        rows["range_m"], rows["encoder_rad"] = self.range_m, self.encoder_rad
        rows["return_number"] = rows["number_of_returns"] = 1
        rows["mta_zone"] = 255
        model = SensorModel(self.calibration, LineGeometry(), range_gate=(0.0, 10_000.0))
        rays = model.rays(
            rows,
            np.array([START_NS + 1_500_000]),
            self.trajectory(),
            encoder_rate=np.array([self.encoder_rate]),
            encoder_acceleration=np.array([self.encoder_acceleration]),
            uncertainty=Uncertainty(self.calibration, noise),
            incidence_rad=incidence_rad,
        )
        assert rays.fate.tolist() == [0]
        assert rays.covariance_e is not None
        covariance: FloatArray = rays.covariance_e[0]
        return covariance


def random_geometry(rng: np.random.Generator, correlation: FloatArray) -> Geometry:
    """Return a geometry anywhere on the globe, with any heading and with every parameter set."""
    signs = rng.uniform(-1, 1, len(NAMES))
    values = {name: float(sign * SIZES[name][0]) for name, sign in zip(NAMES, signs, strict=True)}
    sigmas = np.array([SIZES[name][1] for name in NAMES]) * rng.uniform(0.3, 1.0, len(NAMES))
    calibration = replace(NOMINAL.changed(**values), sigmas=sigmas, correlation=correlation)
    return Geometry(
        calibration,
        float(rng.uniform(-80, 80)),
        float(rng.uniform(-180, 180)),
        float(rng.uniform(300, 4000)),
        np.array([rng.uniform(-0.3, 0.3), rng.uniform(-0.2, 0.2), rng.uniform(0, 2 * np.pi)]),
        rng.uniform([-60, -60, -3], [60, 60, 3]),
        rng.uniform(-0.2, 0.2, 3),
        rng.uniform(0.01, 0.06, 3),
        np.radians(rng.uniform(0.002, 0.01, 3)),
        float(rng.uniform(200, 2500)),
        float(rng.uniform(-0.6, 0.6)),
        float(rng.uniform(-150, 150)),
        float(rng.uniform(-3e4, 3e4)),
    )


def drawn_points_e(geometry: Geometry, rng: np.random.Generator, draws: int) -> FloatArray:
    """Return points (draws, 3) minus the body's position, m, in e, with every input drawn from its covariance.

    The equation is that of the page of conventions.
    """
    calibration = geometry.calibration
    drawn = rng.multivariate_normal(calibration.parameters, calibration.covariance(), draws, method="eigh")
    value = dict(zip(NAMES, drawn.T, strict=True))
    theta = (1 + value["scan_angle_scale"]) * (geometry.encoder_rad - value["scan_angle_offset_rad"])
    theta = theta + value["encoder_latency_s"] * geometry.encoder_rate
    theta = theta + value["torsion_s2"] * geometry.encoder_acceleration + NOISE.angle_rad * rng.normal(size=draws)
    rho = (1 + value["range_scale"]) * geometry.range_m + value["range_offset_m"]
    rho = rho + NOISE.range_m * rng.normal(size=draws)
    eta = value["scan_plane_tilt_rad"]
    beam_s = np.stack([-np.sin(eta), np.sin(theta) * np.cos(eta), np.cos(theta) * np.cos(eta)], axis=1)
    phi = value["phi_rad"] + value["pitch_slope"] * theta
    boresight = Rotation.from_euler("XYZ", np.stack([value["omega_rad"], phi, value["kappa_rad"]], axis=1))
    point_b = boresight.apply(rho[:, np.newaxis] * beam_s)
    point_b += np.stack([value[f"lever_arm_{axis}_m"] for axis in "xyz"], axis=1)
    seconds = 1.5e-3 + value["time_offset_s"] + NOISE.time_s * rng.normal(size=draws)
    turned = (seconds + value["imu_latency_s"])[:, np.newaxis] * geometry.rate_b
    angles = geometry.attitude_rad + geometry.attitude_sigma_rad * rng.normal(size=(draws, 3))
    point_l = Rotation.from_euler("ZYX", angles[:, ::-1]).apply(Rotation.from_rotvec(turned).apply(point_b))
    point_l += geometry.position_sigma_l * rng.normal(size=(draws, 3))
    point_l += seconds[:, np.newaxis] * geometry.velocity_l
    points: FloatArray = point_l @ geometry.rot_e_from_l.T
    return points


def as_matrix(six: FloatArray) -> FloatArray:
    """Return the (3, 3) matrix of xx xy xz yy yz zz."""
    xx, xy, xz, yy, yz, zz = six
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def random_correlation(rng: np.random.Generator) -> FloatArray:
    """Return a correlation matrix of all parameters, with some strong correlations."""
    mixed = np.eye(len(NAMES)) + 0.35 * rng.normal(size=(len(NAMES), len(NAMES)))
    covariance = mixed @ mixed.T
    sigma = np.sqrt(np.diag(covariance))
    correlation: FloatArray = covariance / np.outer(sigma, sigma)
    return correlation


@pytest.mark.slow
def test_every_covariance_element_matches_sampled_inputs() -> None:
    rng = np.random.default_rng(5)
    worst = 0.0
    for k in range(GEOMETRIES):
        geometry = random_geometry(rng, random_correlation(rng))
        if k % 3 == 0:  # with the few usual parameters, errors are summed before the returns
            few = [name in USUAL for name in NAMES]
            sigmas = np.where(few, geometry.calibration.sigmas, 0.0)
            geometry = replace(geometry, calibration=replace(geometry.calibration, sigmas=sigmas))
        predicted = as_matrix(geometry.covariance_e(NOISE))
        sample = np.cov(drawn_points_e(geometry, rng, DRAWS), rowvar=False)
        sigma = np.sqrt(np.diag(predicted))
        worst = max(worst, np.abs((sample - predicted) / np.outer(sigma, sigma)).max())
    assert worst < 0.04


@pytest.mark.slow
@pytest.mark.parametrize("stages", [0, 1])
def test_covariances_and_axes_requested_together_equal_those_requested_alone(stages: int) -> None:
    rng = np.random.default_rng(5)
    geometry = random_geometry(rng, random_correlation(rng))
    count = 300  # more than a block of the kernel
    rows = np.zeros(count, RETURN_DTYPE)
    rows["range_m"], rows["encoder_rad"] = rng.uniform(300.0, 2000.0, count), rng.uniform(-0.6, 0.6, count)
    rows["return_number"] = rows["number_of_returns"] = 1
    mount = Mount((Stage(np.array([0.1, -0.05, 0.3]), np.array([0.2, 0.1, 0.3])),) * stages)
    model = SensorModel(geometry.calibration, LineGeometry(), mount=mount)
    given = (rows, START_NS + rng.integers(1_400_000, 1_600_000, count), geometry.trajectory())
    motion: dict[str, Any] = {"encoder_rate": np.full(count, 40.0), "encoder_acceleration": np.full(count, -2000.0)}
    uncertainty = Uncertainty(geometry.calibration, NOISE)
    both = model.rays(*given, **motion, uncertainty=uncertainty, with_axes=True)
    with_axes = model.rays(*given, **motion, with_axes=True)
    with_covariances = model.rays(*given, **motion, uncertainty=uncertainty)
    assert with_covariances.covariance_e is not None
    assert both.covariance_e is not None
    assert (both.fate == Fate.GEOREFERENCED).all()
    np.testing.assert_array_equal(both.covariance_e, with_covariances.covariance_e)
    for columns_e in (parameter_columns_e, observation_columns_e):
        alone = columns_e(with_axes, model, given[2])
        assert np.isfinite(alone).all()
        np.testing.assert_array_equal(columns_e(both, model, given[2]), alone)


def level(calibration: Calibration) -> Geometry:
    """Return the geometry of FORMULAS 10.5: 20° to the right, 1000 m down, heading 75°."""
    return Geometry(
        calibration,
        47.0,
        8.0,
        1500.0,
        np.radians([0.0, 0.0, 75.0]),
        np.zeros(3),
        np.zeros(3),
        np.array([0.03, 0.03, 0.05]),
        np.radians([0.003, 0.003, 0.007]),
        1000.0 / np.cos(np.radians(20.0)),
        np.radians(20.0),
        0.0,
        0.0,
    )


def sigmas_enu(geometry: Geometry, noise: Noise, incidence_rad: float | None = None) -> FloatArray:
    """Return one sigma east, north, up."""
    given = None if incidence_rad is None else np.array([incidence_rad])
    local = geometry.rot_e_from_l.T @ as_matrix(geometry.covariance_e(noise, given)) @ geometry.rot_e_from_l
    sigmas: FloatArray = np.sqrt(np.diag(local))[[1, 0, 2]]
    return sigmas


def test_sigmas_match_the_formula_sheet() -> None:
    noise = Noise(range_m=0.02, angle_rad=0.0, time_s=0.0)
    np.testing.assert_allclose(sigmas_enu(level(NOMINAL), noise), [0.0741, 0.0618, 0.0567], atol=5e-5)


def test_a_slope_widens_the_range_sigma_by_the_footprint() -> None:
    geometry = level(NOMINAL)
    noise = Noise(range_m=0.02, angle_rad=0.0, time_s=0.0, divergence_rad=5e-4)
    plain, smeared = sigmas_enu(geometry, noise), sigmas_enu(geometry, noise, np.radians(50.0))
    smear = 0.25 * 5e-4 * geometry.range_m * np.tan(np.radians(50.0))  # FORMULAS 6.2
    np.testing.assert_allclose(smeared[2] ** 2 - plain[2] ** 2, (smear * np.cos(np.radians(20.0))) ** 2, rtol=1e-9)
    np.testing.assert_array_equal(sigmas_enu(geometry, noise, 0.0), plain)


def test_a_trajectory_without_sigmas_gives_no_sigmas() -> None:
    geometry = replace(level(NOMINAL), attitude_sigma_rad=np.full(3, np.nan))
    assert np.isnan(geometry.covariance_e(NOISE)).all()


def test_an_invalid_correlation_matrix_is_refused() -> None:
    wrong = np.eye(len(NAMES))
    wrong[0, 1] = wrong[1, 0] = 1.5
    calibration = replace(NOMINAL, sigmas=np.ones(len(NAMES)), correlation=wrong)
    with pytest.raises(UncertaintyError, match="positive definite"):
        Uncertainty(calibration, NOISE)


def test_a_zero_encoder_latency_with_a_sigma_still_contributes() -> None:
    sigmas = np.where(np.array(NAMES) == "encoder_latency_s", 1e-6, 0.0)
    geometry = replace(level(replace(NOMINAL, sigmas=sigmas)), encoder_rate=60.0)
    plain = replace(geometry, calibration=NOMINAL)
    more = np.trace(as_matrix(geometry.covariance_e(NOISE)) - as_matrix(plain.covariance_e(NOISE)))
    assert more == pytest.approx((60.0 * 1e-6 * geometry.range_m) ** 2, rel=1e-6)
    assert SensorModel(geometry.calibration, LineGeometry()).needs_encoder_motion
    assert not SensorModel(NOMINAL, LineGeometry()).needs_encoder_motion


def test_a_fixed_parameter_adds_to_sigmas_and_cancels_with_correlated_estimates() -> None:
    """A range offset held to 5 cm makes points 5 cm uncertain, unless a lever arm estimated with it compensates it."""
    none, arm, offset = np.zeros(len(NAMES)), NAMES.index("lever_arm_z_m"), NAMES.index("range_offset_m")
    held, sigmas, correlation = none.copy(), none.copy(), np.eye(len(NAMES))
    held[offset] = sigmas[arm] = 0.05
    silent = Noise(0.0, 0.0, 0.0, 0.0)
    alone = sigmas_enu(level(replace(NOMINAL, held_sigmas=held)), silent)
    exact = sigmas_enu(level(NOMINAL), silent)
    up = 0.05 * np.cos(np.radians(20.0))
    assert alone[2] == pytest.approx(np.hypot(exact[2], up), abs=1e-6)
    correlation[arm, offset] = correlation[offset, arm] = -0.9999
    both = sigmas_enu(level(replace(NOMINAL, sigmas=sigmas, held_sigmas=held, correlation=correlation)), silent)
    assert both[2] == pytest.approx(exact[2], abs=2e-4)
