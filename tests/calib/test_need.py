"""Tests the error that a calibration leaves in points against draws, and the accuracy needed by height."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from swath.calib.need import POINT, SHARE, Need, need_of
from swath.calib.outcome import TrajectoryFit
from swath.georef.scanner.calibration import INDEX, PARAMETERS, Calibration
from tests.calib.roofs import LINES, NOISE, Line, Made, made

pytestmark = pytest.mark.xdist_group("kernels")

TILT_RAD, HEADING_RAD, POSITION_M = np.radians(0.003), np.radians(0.006), 0.02


def known(built: Made) -> Calibration:
    """Return the truth with a range offset sigma of 20 cm that a held scan angle scale cancels at the edges."""
    sigmas, held, correlation = np.zeros(len(PARAMETERS)), np.zeros(len(PARAMETERS)), np.eye(len(PARAMETERS))
    offset, scale = INDEX["range_offset_m"], INDEX["scan_angle_scale"]
    sigmas[offset], sigmas[INDEX["kappa_rad"]], held[scale] = 0.2, np.radians(0.01), 3e-4
    correlation[offset, scale] = correlation[scale, offset] = -0.98
    return replace(built.truth, sigmas=sigmas, held_sigmas=held, correlation=correlation)


def prior() -> TrajectoryFit:
    """Return the prior of one knot."""
    one, none = np.ones((1, 3)), np.zeros((1, 3))
    attitude = np.array([[TILT_RAD, TILT_RAD, HEADING_RAD]])
    time_ns = np.zeros(1, np.int64)
    return TrajectoryFit(time_ns, time_ns, time_ns, none, none, none, none, POSITION_M * one, attitude)


def of(built: Made, wanted: dict[str, float] | None = None) -> Need:
    flight = built.flight.placed({"left": built.truth})
    return need_of(flight, {"left": known(built)}, prior(), wanted)


def test_expected_point_errors_match_the_scatter_of_drawn_calibrations() -> None:
    built = made(lines=LINES[:4])
    calibration, rng = known(built), np.random.default_rng(8)
    draws = rng.multivariate_normal(calibration.parameters, calibration.covariance(), 300, method="eigh")
    squares = []
    for swath in built.flight.swaths:
        at = np.arange(0, len(swath), 7)
        true = built.flight.place(swath, built.truth, at)
        squares += [
            ((built.flight.place(swath, replace(calibration, parameters=one), at) - true) ** 2).sum(axis=1)
            for one in draws
        ]
    # 300 draws, mainly in one direction, determine their mean square to √(2 / 300)
    assert of(built).left_m["left"] ** 2 == pytest.approx(np.mean(np.concatenate(squares)), rel=0.25)


@pytest.mark.parametrize("height_m", [60.0, 800.0])
def test_the_needed_accuracy_of_an_angle_follows_the_height(height_m: float) -> None:
    """An angle must be known to half of the points' other errors, divided by the distance of measurement."""
    lines = [Line(0.0, height_m), Line(180.0, height_m)]
    built = made(lines=lines)
    need = of(built)
    slant_m = need.point_m / need.wanted["omega_rad"]
    assert 0.9 * height_m < slant_m < 1.3 * height_m
    least = np.sqrt(3 * POSITION_M**2 + 2 * (TILT_RAD * height_m) ** 2 + NOISE.range_m**2)
    assert 0.95 * least < need.own_m < 1.5 * least
    assert need.point_m == pytest.approx(SHARE * need.own_m)
    assert need.wanted["range_offset_m"] == need.point_m
    assert need.wanted["kappa_rad"] > need.wanted["phi_rad"]


def test_user_requirements_have_precedence() -> None:
    need = of(made(lines=LINES[:2]), {POINT: 0.1, "kappa_rad": 1e-3, "range_scale": 1e-5})
    assert need.point_m == need.wanted["range_offset_m"] == 0.1
    assert need.wanted["kappa_rad"] == 1e-3
    assert need.wanted["range_scale"] == 1e-5
