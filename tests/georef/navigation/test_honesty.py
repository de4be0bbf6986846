"""Tests that sigmas equal errors over many seeds, with white and lasting GNSS errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from swath.georef.arrays import FloatArray
from swath.georef.navigation.filter.filter import run_filter
from swath.georef.navigation.filter.smoother import forward, smooth
from swath.georef.navigation.inputs import GRADES, Fate
from tests.georef.navigation.builders import flight
from tests.georef.navigation.flights import Fixes, drawn_start, noised, setup_for
from tests.georef.navigation.honesty import judge, squares

pytestmark = pytest.mark.xdist_group("kernels")

ARM = np.array([0.35, -0.12, -1.1])


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.0, 0.7], ids=["white", "lasting"])
@pytest.mark.parametrize("grade", ["tactical", "mems"])
def test_errors_are_as_large_as_their_sigmas(grade: str, share: float) -> None:
    """In 32 flights, NEES of position, velocity and attitude lie within the 99.8 % interval, filtered and smoothed.

    The innovations are as large as predicted too.
    """
    moments: list[float] = []
    squared: dict[str, list[FloatArray]] = {"filtered": [], "smoothed": []}
    for seed in range(32):
        inertial, rows = noised(flight(), GRADES[grade], Fixes(share=share, tau_s=60.0), ARM, seed)
        setup = replace(setup_for(GRADES[grade], ARM), gnss_correlated_share=share, position_floor_m=0.001)
        run = run_filter(inertial, rows, setup, drawn_start(flight(), seed))
        told = run.innovations[run.innovations["fate"] <= Fate.REACQUIRED]
        moments.append(float(np.mean(told["normalised"] ** 2)))
        for what, solution in (("filtered", forward(run)), ("smoothed", smooth(run))):
            squared[what].append(squares(flight(), solution, 30.0, 0.5))
    for what, flights in squared.items():
        for name, honesty in judge(flights).items():
            assert honesty.holds, (what, name, honesty)
            assert honesty.independent > 40.0, (what, name, honesty)
    assert 0.95 < np.mean(moments) < 1.05


def test_errors_with_a_consumer_imu_are_as_large_as_their_sigmas() -> None:
    """In 8 flights, filtered and smoothed, biases are 0.4 °/s and 80 mg, and axes are misaligned by 10 mrad."""
    squared: dict[str, list[FloatArray]] = {"filtered": [], "smoothed": []}
    for seed in range(8):
        inertial, rows = noised(flight(), GRADES["consumer"], Fixes(), ARM, seed)
        run = run_filter(
            inertial,
            rows,
            replace(setup_for(GRADES["consumer"], ARM), position_floor_m=0.001),
            drawn_start(flight(), seed),
        )
        for what, solution in (("filtered", forward(run)), ("smoothed", smooth(run))):
            squared[what].append(squares(flight(), solution, 30.0, 0.5))
    for what, flights in squared.items():
        for name, honesty in judge(flights).items():
            assert honesty.holds, (what, name, honesty)


def test_errors_with_correlated_fast_gnss_positions_are_as_large_as_their_sigmas() -> None:
    """Half of the positions' variance lasts for 10 s, and the filter knows it, so its estimate must decay likewise."""
    fixes = Fixes((0.014, 0.014, 0.02), 0.5, 10.0, 5.0, 0.03)
    setup = replace(setup_for(GRADES["tactical"], ARM), gnss_correlated_share=0.5, gnss_correlation_s=10.0)
    setup = replace(setup, position_floor_m=0.001)
    squared: dict[str, list[FloatArray]] = {"filtered": [], "smoothed": []}
    for seed in range(12):
        inertial, rows = noised(flight(), GRADES["tactical"], fixes, ARM, seed)
        run = run_filter(inertial, rows, setup, drawn_start(flight(), seed))
        for what, solution in (("filtered", forward(run)), ("smoothed", smooth(run))):
            squared[what].append(squares(flight(), solution, 30.0, 0.5))
    for what, flights in squared.items():
        position = judge(flights)["position"]
        assert position.holds, (what, position)
        assert position.independent > 40.0, (what, position)
