"""Tests the virtual aircraft's navigation: errors on the lines are as predicted, with misaligned axes too.

The long run is `python -m benchmarks.navigation_seeds`.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from swath.georef.navigation.filter.filter import run_filter
from swath.georef.navigation.filter.smoother import forward, smooth
from swath.georef.navigation.inputs import Setup, Solution
from swath.sim.imu.sensors import InertialUnit
from swath.sim.plan.tables import ImuTable
from tests.georef.navigation.flights import drawn_start
from tests.georef.navigation.virtual_aircraft import (
    ARM,
    BEGIN_S,
    REFERENCE,
    Aircraft,
    aircraft,
    on_lines,
    reference_noise,
    seeds_of,
    sensed,
    survey_plan,
    white_fixes,
)

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("kernels")]

SEEDS = 10
MISALIGNMENT = 5e-3  # so large that a filter without this state is far off


@cache
def craft() -> Aircraft:
    return aircraft(survey_plan(2, 1500.0, static_s=30.0))


def unit(lean: float) -> ImuTable:
    return ImuTable(noise=REFERENCE["mems"].model_copy(update={"misalignment_mrad": 1e3 * lean}))


@cache
def flown(lean: float, told: float, seed: int) -> tuple[Solution, Solution]:
    """Return filtered and smoothed solutions for axes misaligned by `lean`, rad, where the filter assumes `told`."""
    setup = Setup(replace(reference_noise("mems"), misalignment=told), np.array([ARM]))
    attitude_rad = (1e-3, 1e-3, 1e-2)
    start = drawn_start(craft().truth, seed, attitude_rad=attitude_rad, at_s=BEGIN_S)
    run = run_filter(sensed(craft(), unit(lean), seed), white_fixes(craft(), seed), setup, start)
    return forward(run), smooth(run)


@pytest.mark.parametrize("lean", [0.0, MISALIGNMENT], ids=["true axes", "leaning axes"])
def test_errors_on_the_lines_match_their_prediction(lean: float) -> None:
    """Over the seeds, filtered and smoothed RMS of position and attitude are in the 99 % interval of the prediction."""
    solutions = [flown(lean, lean, seed) for seed in range(SEEDS)]
    for column in zip(*solutions, strict=True):
        found = seeds_of([on_lines(craft(), solution) for solution in column])
        assert found.holds.all(), found


def test_axis_misalignments_are_estimated() -> None:
    """The misalignments drawn by the simulator are found within their sigmas; turns show those of the gyroscopes."""
    off, sigmas = [], []
    for seed in range(SEEDS):
        _, smoothed = flown(MISALIGNMENT, MISALIGNMENT, seed)
        force, rate = InertialUnit(unit(MISALIGNMENT), craft().truth.flight, seed, "main", noise=True).errors.matrices
        drawn = np.array([matrix[[1, 0, 0], [2, 2, 1]] for matrix in (rate, force)])
        found = np.stack([smoothed.gyro_misalignment[-1], smoothed.accel_misalignment[-1]])
        sigma = np.stack([smoothed.gyro_misalignment_sigma[-1], smoothed.accel_misalignment_sigma[-1]])
        off.append((found - drawn) / sigma)
        sigmas.append(sigma)
    assert 0.7 < np.sqrt(np.mean(np.square(off))) < 1.3  # 60 numbers
    assert np.mean(sigmas, axis=0)[0].min() < 0.3 * MISALIGNMENT


def test_a_filter_without_misalignment_states_is_recognised() -> None:
    """The interval is narrow enough to refuse a filter that leaves misalignment out."""
    found = seeds_of([on_lines(craft(), flown(MISALIGNMENT, 0.0, seed)[1]) for seed in range(4)])
    assert (found.measured > found.high)[3:].any(), found
