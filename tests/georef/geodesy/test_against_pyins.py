"""Tests the filter against pyins', with other code in another frame, on the same samples and fixes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from pyins import filters, measurements, strapdown
from pyins.inertial_sensor import EstimationModel as Model
from pyins.util import LLA_COLS, RPH_COLS, VEL_COLS

from swath.georef.geodesy.earth import e_from_geodetic, geodetic_from_e, rot_e_from_l
from swath.georef.navigation.filter.filter import run_filter
from swath.georef.navigation.filter.smoother import forward
from swath.georef.navigation.inputs import GRADES
from tests.georef.navigation.flights import Fixes, drawn_start, fly, noised, setup_for, survey

pytestmark = [
    pytest.mark.slow,
    pytest.mark.xdist_group("kernels"),
    pytest.mark.filterwarnings("ignore"),  # pyins causes warnings of newer pandas
]

NOISE = replace(GRADES["tactical"], bias_correlation_s=1e9, misalignment=0.0)
ARM = np.array([0.35, -0.12, -1.1])


def test_filter_results_match_pyins() -> None:
    """Over half a minute with a turn, positions agree to a fifth of their sigma and sigmas to 3 %.

    Both estimate biases and scales. Biases are constant in both, because pyins has no Gauss–Markov biases.
    """
    truth = fly(survey(line_s=25.0), 30.0, 50.0)
    inertial, rows = noised(truth, NOISE, Fixes(sigma_m=(0.015, 0.015, 0.015), first_s=0.32), ARM, 22)
    start = drawn_start(truth, 22, attitude_rad=(2e-3, 2e-3, 5e-3))
    setup = replace(setup_for(NOISE, ARM), gate_probability=1e-9)  # pyins has no gate
    mine = forward(run_filter(inertial, rows, setup, start))

    names = ["gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z"]
    seconds = np.append(0.0, (inertial.time_ns - start.time_ns) / 1e9)  # pyins only takes the start from its first row
    sensed = np.vstack([np.zeros(6), np.hstack([inertial.angle_b, inertial.velocity_b])])
    table = pd.DataFrame(sensed, index=seconds, columns=names)
    increments = strapdown.compute_increments_from_imu(table, "increment")
    lat, lon, height = (float(value) for value in geodetic_from_e(start.position_e))
    angles = np.degrees(start.attitude_rad)
    state = [np.degrees(lat), np.degrees(lon), height, *start.velocity_l, *angles]
    pva = pd.Series(state, LLA_COLS + VEL_COLS + RPH_COLS, name=0.0)
    there = geodetic_from_e(rows["value"])
    fixes = np.column_stack([np.degrees(there[0]), np.degrees(there[1]), there[2]])
    seen = pd.DataFrame(fixes, index=(rows["time_ns"] - start.time_ns) / 1e9, columns=LLA_COLS)
    noise = setup.noise
    theirs = filters.run_feedback_filter(
        pva, 0.05, 0.05, np.degrees(2e-3), np.degrees(5e-3), increments,
        Model(noise.gyro_bias, noise.angle_random_walk, None, np.eye(3) * noise.gyro_scale),
        Model(noise.accel_bias, noise.velocity_random_walk, None, np.eye(3) * noise.accel_scale),
        [measurements.Position(seen, 0.015, ARM)], time_step=0.02,
    )  # fmt: skip
    last, sigma = theirs.trajectory.iloc[-1], theirs.trajectory_sd.iloc[-1]
    place = e_from_geodetic(np.radians(last["lat"]), np.radians(last["lon"]), last["alt"])
    off = rot_e_from_l(np.radians(last["lat"]), np.radians(last["lon"])).T @ (mine.position_e[-1] - place)
    assert (np.abs(off) < 0.2 * mine.position_sigma_l[-1]).all(), off / mine.position_sigma_l[-1]
    found = np.degrees(np.array([value[-1] for value in mine.trajectory().attitude()]))
    turned = (found - last[RPH_COLS].to_numpy() + 180.0) % 360.0 - 180.0
    assert (np.abs(turned) < 0.2 * np.degrees(mine.attitude_sigma_rad[-1])).all(), turned
    np.testing.assert_allclose(mine.position_sigma_l[-1], sigma[["north", "east", "down"]], rtol=0.03)
    np.testing.assert_allclose(np.degrees(mine.attitude_sigma_rad[-1]), sigma[RPH_COLS], rtol=0.03)
