"""Tests that sigmas are honest, with returns of virtual flights whose errors are drawn as stated.

Each draw has its own errors of trajectory, calibration, range, angle and time; the first two are constant over a strip.
One return of each draw counts, so that draws are independent and the normalised squared error has three degrees of
freedom (FORMULAS 6.5).
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from swath.daemon.config import ScannerConfig
from swath.daemon.processing.setup.models import make_motion
from swath.georef.arrays import FloatArray
from swath.georef.geodesy.earth import rot_e_from_l
from swath.georef.scanner.beams import LineGeometry
from swath.georef.scanner.calibration import PARAMETERS, read_calibration
from swath.georef.scanner.sensor_model import SensorModel
from swath.georef.scanner.uncertainty import Noise, Uncertainty
from swath.georef.trajectory.trajectory import Trajectory
from tests.builders import EVERY_ERROR, TURNED, Flown, fly_and_decode
from tests.daemon.processing.builders import IBRC, true_trajectory

pytestmark = pytest.mark.xdist_group("proof")

DRAWS = 250  # a flight
NOISE = Noise(range_m=0.015, angle_rad=2e-5, time_s=2e-5)
POSITION_SIGMA_L = np.array([0.02, 0.02, 0.04])
ATTITUDE_SIGMA_RAD = np.radians([0.003, 0.003, 0.008])
SIGMAS = {
    "omega_rad": 2e-5,
    "phi_rad": 2e-5,
    "kappa_rad": 6e-5,
    "range_offset_m": 0.01,
    "scan_angle_scale": 3e-5,
    "lever_arm_x_m": 0.01,
    "lever_arm_y_m": 0.01,
    "lever_arm_z_m": 0.01,
    "time_offset_s": 1e-4,
    "encoder_latency_s": 1e-7,
}


def wrong(trajectory: Trajectory, rng: np.random.Generator) -> Trajectory:
    """Return the trajectory with errors drawn from the sigmas that it states."""
    lat, lon, height = trajectory.geodetic()
    errors = ATTITUDE_SIGMA_RAD * rng.normal(size=3)
    roll, pitch, heading = (angle + error for angle, error in zip(trajectory.attitude(), errors, strict=True))
    turned = Trajectory.from_geodetic(
        trajectory.time_ns,
        lat,
        lon,
        height,
        np.zeros((len(lat), 3)),
        roll,
        pitch,
        heading,
        position_sigma_l=np.tile(POSITION_SIGMA_L, (len(lat), 1)),
        attitude_sigma_rad=np.tile(ATTITUDE_SIGMA_RAD, (len(lat), 1)),
    )
    shift_e = rot_e_from_l(lat[0], lon[0]) @ (POSITION_SIGMA_L * rng.normal(size=3))
    return replace(turned, position_e=trajectory.position_e + shift_e)


def normalised_errors(flown: Flown, seed: int) -> FloatArray:
    """Return (DRAWS,) eᵀ C⁻¹ e."""
    rng = np.random.default_rng(seed)
    names = [parameter.name for parameter in PARAMETERS]
    sigmas = np.array([SIGMAS.get(name, 0.0) for name in names])
    true = replace(read_calibration(flown.files["left.true.toml"].decode(), "left.true.toml"), sigmas=sigmas)
    time_ns = flown.plan.start_gps_ns + np.rint(flown.time_s * 1e9).astype(np.int64)
    motion = make_motion(flown_config(), SensorModel(true, LineGeometry()))
    assert motion is not None
    pieces = [motion.feed(flown.rows, time_ns), motion.flush()]
    _, _, rate, acceleration = (np.concatenate(column) for column in zip(*pieces, strict=True))
    truth = true_trajectory(flown)
    errors = []
    for k in rng.integers(0, len(flown.rows), DRAWS).tolist():
        drawn = replace(true, parameters=true.parameters + sigmas * rng.normal(size=len(names)))
        row = flown.rows[k : k + 1].copy()
        row["range_m"] += NOISE.range_m * rng.normal()
        row["encoder_rad"] += NOISE.angle_rad * rng.normal()
        at_ns = time_ns[k : k + 1] + round(1e9 * NOISE.time_s * rng.normal())
        around = wrong(truth.between(int(at_ns[0]) - 20_000_000, int(at_ns[0]) + 20_000_000), rng)
        rays = SensorModel(drawn, LineGeometry()).rays(
            row,
            at_ns,
            around,
            encoder_rate=rate[k : k + 1],
            encoder_acceleration=acceleration[k : k + 1],
            uncertainty=Uncertainty(drawn, NOISE),
        )
        assert rays.covariance_e is not None
        xx, xy, xz, yy, yz, zz = rays.covariance_e[0]
        covariance = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        missed = rays.points_e[0] - flown.truth["left.point_e"][k]
        errors.append(missed @ np.linalg.solve(covariance, missed))
    return np.array(errors)


def flown_config() -> ScannerConfig:
    """Return the configuration of the head."""
    return ScannerConfig(transport="udp:0.0.0.0:2368", protocol="srep", mirror_factor=2.0)


@pytest.mark.slow
def test_normalised_errors_have_unit_variance(tmp_path: Path) -> None:
    found = []
    for seed in (1, 2):
        scanner = {"motion": "sine", "true": EVERY_ERROR, "installation": TURNED, "ibrc": IBRC}
        flown = fly_and_decode(tmp_path, {"scanner": {"left": scanner}, "flight": {"seed": seed}})
        found.append(normalised_errors(flown, seed))
    errors = np.concatenate(found)
    low, high = chi2.ppf([0.001, 0.999], 3 * len(errors)) / len(errors)
    assert low < errors.mean() < high
    assert chi2.ppf(0.5, 3) == pytest.approx(np.median(errors), rel=0.12)
