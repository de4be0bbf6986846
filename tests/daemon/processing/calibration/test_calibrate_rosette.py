"""Tests a head of two angles from packets to calibration: points and boresight are within their sigmas."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from swath.daemon.cli.main import run_app
from swath.daemon.processing.calibration.returns import read_flight
from swath.daemon.processing.flights.read import GeorefOptions
from swath.daemon.processing.flights.trajectory_choice import TrajectoryOptions
from swath.daemon.processing.setup.setup import Options
from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.formats.trajectory.csv import csv_text
from swath.georef.points import Fate
from swath.georef.scanner.calibration import PARAMETERS, read_calibration
from swath.georef.scanner.uncertainty import Uncertainty
from tests.calib.village import HEADER, LINE, told
from tests.daemon.short_flight import Flown, fly_short

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("kernels")]

SCANNER = """
[scanner.left]
kind = "rosette"
prf_hz = 15000.0
scan_hz = 47.0
half_angle_deg = 35.0
prism_ratio = -0.63
direction_sigma_deg = 0.03
range_min_m = 1.0
range_max_m = 400.0
reference_range_m = 200.0
divergence_mrad = 2.0
installation = [[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]]

[scanner.left.range_noise]
sigma_m = 0.02
footprint = 0.0

[scanner.left.true]
omega_deg = 0.25
phi_deg = -0.4
kappa_deg = 0.6
range_offset_m = 0.12
"""
LINES = (
    ("east", (-200, 0), (200, 0), 650),
    ("west", (200, 60), (-200, 60), 650),
    ("south", (0, 200), (0, -200), 650),
    ("north", (80, -200), (80, 200), 720),
)
ESTIMATED = ("omega_rad", "phi_rad", "kappa_rad", "range_offset_m")


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    """Fly four lines over houses, 200 and 270 m above them; the true trajectory is beside the log."""
    text = HEADER.format(seed=4, prf_hz=1.0, true="").partition("[scanner.left]")[0] + SCANNER
    text = text.replace("speed_mps = 50.0", "speed_mps = 40.0")
    for name, (x0, y0), (x1, y1), height in LINES:
        text += LINE.format(name=name, x0=x0, y0=y0, x1=x1, y1=y1, height=height)
    made = fly_short(tmp_path_factory.mktemp("rosette"), text)
    (made.folder / "trajectory.csv").write_text(csv_text(told(made.truth(), 0.01, 0.002)))
    return made


def true_points(flown: Flown, time_ns: Int64Array) -> FloatArray:
    """Return the true points in e of the pulses at these times."""
    with np.load(flown.folder / "truth.npz") as truth:
        gps_ns, points_e = truth["left.gps_ns"], truth["left.point_e"]
    at = np.clip(np.searchsorted(gps_ns, time_ns), 1, len(gps_ns) - 1)
    at -= time_ns - gps_ns[at - 1] < gps_ns[at] - time_ns
    assert np.abs(gps_ns[at] - time_ns).max() < 1000
    found: FloatArray = points_e[at]
    return found


def test_points_lie_where_the_beams_hit_within_their_sigmas(flown: Flown, tmp_path: Path) -> None:
    """With the true calibration on the true trajectory only the scanner's own noise is left."""
    text = (flown.folder / "left.true.toml").read_text()
    options = Options(datum="same", uncertainty=False, calibrations={"left": (text, "left.true.toml")})
    request = GeorefOptions([flown.log], tmp_path, TrajectoryOptions(flown.folder / "trajectory.csv"), options)
    flight = read_flight(request, tmp_path, lambda *_: None).flight
    (head,) = flight.heads
    model, noise = head.model(head.start), head.noise
    assert np.degrees(noise.angle_rad) == pytest.approx(0.03)
    trajectory = flown.truth()
    trajectory.position_sigma_l[:], trajectory.attitude_sigma_rad[:] = 0.0, 0.0
    errors, across, chi2 = [], [], []
    for swath in flight.swaths:
        rows, time_ns = np.array(swath.rows[::7]), np.array(swath.time_ns[::7])
        sure = Uncertainty(read_calibration(text, "true"), noise, aimed=True)
        rays = model.rays(rows, time_ns, trajectory, uncertainty=sure)
        assert rays.covariance_e is not None
        assert (rays.fate == Fate.GEOREFERENCED).all()
        missed = rays.points_e - true_points(flown, time_ns)
        beam = (rays.points_e - rays.origin_e) / rays.range_m[:, np.newaxis]
        along = (missed * beam).sum(axis=1)
        wanted = (noise.angle_rad * rays.range_m) ** 2 * (1.0 + np.cos(rows["elevation_rad"]) ** 2)
        across.append(((missed**2).sum(axis=1) - along**2) / wanted)
        xx, xy, xz, yy, yz, zz = rays.covariance_e.T
        full = np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], axis=1).reshape(-1, 3, 3)
        chi2.append((missed * np.linalg.solve(full, missed[:, :, np.newaxis])[:, :, 0]).sum(axis=1) / 3.0)
        errors.append(missed)
    assert sum(map(len, errors)) > 50_000
    assert np.concatenate(across).mean() == pytest.approx(1.0, abs=0.03)  # of both angles together
    # the noise of a range falls with the echo's strength, from 2 cm where it is weak: the configured sigma
    assert 0.75 < np.concatenate(chi2).mean() < 1.05
    assert np.abs(np.concatenate(errors).mean(axis=0)).max() < 2e-3


def test_boresight_and_range_offset_are_found_within_their_sigmas(flown: Flown, tmp_path: Path) -> None:
    output = tmp_path / "left.toml"
    trajectory = ["--trajectory", str(flown.folder / "trajectory.csv"), "--trajectory-datum", "same"]
    known = ["--fix", "range_scale_ppm,time_offset_us", "--prior", "range_scale_ppm=1", "--prior", "time_offset_us=1"]
    assert run_app(["calibrate", str(flown.log), "-o", str(output), *trajectory, *known]) == 0
    found = read_calibration(output.read_text(), "left.toml")
    truth = read_calibration((flown.folder / "left.true.toml").read_text(), "left.true.toml")
    names = [parameter.name for parameter in PARAMETERS]
    for name in ESTIMATED:
        sigma = found.all_sigmas[names.index(name)]
        limit = 0.05 if name.endswith("_m") else np.radians(0.02)
        assert 0.0 < sigma < limit, (name, sigma)
        assert abs(found.value(name) - truth.value(name)) < 3.0 * sigma, name
