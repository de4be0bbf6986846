"""Tests ``swath calibrate`` on whole virtual flights: more parameters than the boresight, and two scanners."""

from __future__ import annotations

from pathlib import Path

import pytest

from swath.daemon.cli.main import run_app
from swath.georef.scanner.calibration import INDEX, PARAMETERS, Calibration, read_calibration
from tests.calib.village import KNOWN, TRUE, Made, village

pytestmark = [pytest.mark.long, pytest.mark.timeout(3000)]

MORE = {"scan_angle_scale_ppm": 300.0, "time_offset_us": 1500.0, "encoder_latency_us": 2.0}
NAMES = ("scan_angle_scale", "time_offset_s", "encoder_latency_s")
RIGHT = """
[scanner.right]
prf_hz = 10000.0
scan_hz = 40.0
half_angle_deg = 25.0
range_max_m = 1500.0
reference_range_m = 500.0
[scanner.right.true]
omega_deg = -0.2
phi_deg = 0.3
kappa_deg = -0.5
range_offset_m = -0.08
"""


def calibrated(made: Made, output: Path, model: str) -> None:
    folder = made.flown.folder
    given = ("--trajectory", str(folder / "true_trajectory.csv"), "--trajectory-datum", "same")
    control = ("--control", str(folder / "control.csv"), "--model", model, *(KNOWN if model == "basic" else ()))
    assert run_app(["calibrate", str(made.flown.log), "-o", str(output), *given, *control, "--workers", "2"]) == 0


def read(path: Path) -> Calibration:
    return read_calibration(path.read_text(), path.name)


def off_by(found: Calibration, truth: Calibration) -> dict[str, float]:
    """Return the errors of the estimated parameters in sigmas, by name."""
    errors = found.parameters - truth.parameters
    estimated = zip(PARAMETERS, errors.tolist(), found.sigmas.tolist(), strict=True)
    return {parameter.name: error / sigma for parameter, error, sigma in estimated if sigma > 0.0}


@pytest.mark.parametrize("there", [True, False], ids=["there", "not there"])
def test_additional_parameters_are_found_only_where_they_are_wrong(tmp_path: Path, there: bool) -> None:
    made = village(tmp_path, prf_hz=20_000.0, lines=(0, 1, 2, 3, 4, 5), true=TRUE | MORE if there else TRUE)
    calibrated(made, tmp_path / "left.toml", "full")
    found = read(tmp_path / "left.toml")
    errors = off_by(found, made.truth)
    assert {"omega_rad", "phi_rad", "kappa_rad", "range_offset_m", *NAMES} <= set(errors)
    assert max(map(abs, errors.values())) < 3.0, errors
    significant = {name for name in NAMES if abs(found.value(name)) > 3.0 * found.sigmas[INDEX[name]]}
    assert significant == (set(NAMES) if there else set())


def test_two_scanners_get_a_file_each(tmp_path: Path) -> None:
    """Both offsets are correlated through the height of the trajectory; both must be found."""
    made = village(tmp_path, lines=(0, 1, 2, 3, 4), plan_more=RIGHT)
    calibrated(made, tmp_path / "found", "basic")
    for name in ("left", "right"):
        errors = off_by(read(tmp_path / "found" / f"{name}.toml"), read(tmp_path / f"{name}.true.toml"))
        assert {"omega_rad", "range_offset_m"} <= set(errors)
        assert max(map(abs, errors.values())) < 3.0, (name, errors)
