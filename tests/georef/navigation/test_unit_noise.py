"""Another noise of the unit is asked for where the flight's innovations fit it, and only there."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from georef.navigation.inputs import GRADES, ImuNoise, Setup
from georef.navigation.noise import Run
from georef.navigation.solve import stretch_of
from georef.navigation.unit_noise import better_grade, contradicted, noise_findings
from tests.georef.navigation.flights import Fixes, Truth, drawn_start, fly, noised, survey

pytestmark = pytest.mark.xdist_group("kernels")

ARM = np.array([0.35, -0.12, -1.1])


@cache
def flight() -> Truth:
    return fly(survey(), 150.0, 50.0)


def flown(unit: ImuNoise, told: ImuNoise) -> tuple[Run, Setup]:
    """A flight of 150 s with a unit, and the setup of somebody who takes it for another."""
    inertial, rows = noised(flight(), unit, Fixes(rate_hz=5.0, velocity_mps=0.02), ARM, 7)
    return stretch_of(inertial, rows, drawn_start(flight(), 7)), Setup(told, ARM[None])


@pytest.mark.parametrize(("unit", "told"), [("mems", "tactical"), ("tactical", "mems")])
def test_a_flight_fits_its_own_grade(unit: str, told: str) -> None:
    run, setup = flown(GRADES[unit], GRADES[told])
    asked = better_grade(run, setup, {name: GRADES[name] for name in ("tactical", "mems", "consumer")})
    assert asked is not None
    assert asked.name == unit
    (finding,) = noise_findings(run, setup, told, {unit: GRADES[unit]}, "imu.main.noise")
    assert finding.text.startswith(f"innovations fit grade {unit} better than {told} (ln likelihood +")
    assert f'set imu.main.noise.grade = "{unit}"' in finding.text


def test_a_flight_of_the_grade_that_was_named_asks_for_nothing() -> None:
    run, setup = flown(GRADES["tactical"], GRADES["tactical"])
    assert better_grade(run, setup, GRADES) is None
    assert contradicted(run, setup) == []


@pytest.mark.parametrize(("field", "told"), [("gyro_scale", 1e-5), ("misalignment", 0.0)])
def test_a_scale_factor_or_a_misalignment_that_cannot_be_is_named(field: str, told: float) -> None:
    """The unit's is 5 mrad or 0.5 %, the configuration says (next to) none."""
    noise = replace(GRADES["tactical"], **{field: told})
    run, setup = flown(replace(noise, **{field: 5e-3}), noise)
    assert contradicted(run, setup)[0].name == field
    findings = list(noise_findings(run, setup, "tactical", {}, "imu.main.noise"))
    assert findings[0].code == "imu_noise"
    assert "the flight contradicts" in findings[0].text
