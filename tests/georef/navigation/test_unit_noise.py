"""Tests that another noise of the unit is proposed exactly where the flight's innovations fit it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from swath.georef.navigation.inputs import GRADES, ImuNoise, Setup
from swath.georef.navigation.noise import Run
from swath.georef.navigation.solve import stretch_of
from swath.georef.navigation.unit_noise import better_grade, contradicted, noise_findings
from tests.georef.navigation.flights import Fixes, Truth, drawn_start, fly, noised, survey

pytestmark = pytest.mark.xdist_group("kernels")

ARM = np.array([0.35, -0.12, -1.1])


@cache
def flight() -> Truth:
    return fly(survey(), 150.0, 50.0)


def flown(unit: ImuNoise, told: ImuNoise) -> tuple[Run, Setup]:
    """Return a flight of 150 s with a unit, and a setup that assumes another unit."""
    inertial, rows = noised(flight(), unit, Fixes(rate_hz=5.0, velocity_mps=0.02), ARM, 7)
    return stretch_of(inertial, rows, drawn_start(flight(), 7)), Setup(told, ARM[None])


def test_the_consumer_grade_matches_its_data_sheet() -> None:
    """InvenSense PS-MPU-6000A 3.4, 6.1, 6.2 state 0.005 °/s/√Hz, 400 µg/√Hz, ±80 mg, scales of ±3 %, axes of ±2 %."""
    noise = GRADES["consumer"]
    assert noise.velocity_random_walk == pytest.approx(400e-6 * 9.80665, rel=0.03)
    assert 1.0 <= noise.angle_random_walk / np.radians(0.005) < 2.0  # other units of the grade have more
    assert noise.accel_bias == pytest.approx(0.080 * 9.80665, rel=1e-3)
    assert np.radians(0.1) < noise.gyro_bias < np.radians(1.0)
    assert max(noise.gyro_scale, noise.accel_scale) == pytest.approx(0.03 / 3.0)
    assert noise.misalignment == pytest.approx(0.02 / 2.0)


@pytest.mark.parametrize(
    ("unit", "told"), [("mems", "tactical"), ("tactical", "mems"), ("consumer", "mems"), ("mems", "consumer")]
)
def test_a_flight_fits_its_own_grade(unit: str, told: str) -> None:
    run, setup = flown(GRADES[unit], GRADES[told])
    asked = better_grade(run, setup, {name: GRADES[name] for name in ("tactical", "mems", "consumer")})
    assert asked is not None
    assert asked.name == unit
    (finding,) = noise_findings(run, setup, told, {unit: GRADES[unit]}, "imu.main.noise")
    assert finding.text.startswith(f"innovations fit grade {unit} better than {told} (ln likelihood +")
    assert f'set imu.main.noise.grade = "{unit}"' in finding.text


def test_a_flight_of_the_configured_grade_gives_no_advice() -> None:
    run, setup = flown(GRADES["tactical"], GRADES["tactical"])
    assert better_grade(run, setup, GRADES) is None
    assert contradicted(run, setup) == []


@pytest.mark.slow
@pytest.mark.parametrize(("field", "told"), [("gyro_scale", 1e-5), ("misalignment", 0.0)])
def test_an_implausible_scale_factor_or_misalignment_is_reported(field: str, told: float) -> None:
    """The unit has 5 mrad or 0.5 %, and the configuration states almost zero."""
    noise = replace(GRADES["tactical"], **{field: told})
    run, setup = flown(replace(noise, **{field: 5e-3}), noise)
    assert contradicted(run, setup)[0].name == field
    findings = list(noise_findings(run, setup, "tactical", {}, "imu.main.noise"))
    assert findings[0].code == "imu_noise"
    assert "the flight contradicts" in findings[0].text
