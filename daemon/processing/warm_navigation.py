"""A moment of standing still, aligned, filtered and smoothed, so that navigation's loops are compiled beforehand."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from swath.georef.geodesy.earth import e_from_geodetic
from swath.georef.geodesy.gravity import gravity_e
from swath.georef.navigation.alignment.align import Aligner
from swath.georef.navigation.filter.filter import NavigationFilter, run_filter
from swath.georef.navigation.filter.smoother import forward, smooth
from swath.georef.navigation.inputs import GRADES, OBSERVATION_DTYPE, Inertial, Kind, Setup, Start, sort_observations
from swath.georef.records import FixType, StructArray
from swath.georef.timescales import SECOND_NS

SECONDS, RATE_HZ = 12, 50
START_NS = 1_465_000_000 * SECOND_NS
PLACE = (np.radians(47.0), np.radians(9.0), 500.0)


def warm_navigation() -> None:
    """Run everything once."""
    position_e = e_from_geodetic(*PLACE)
    inertial, observations = _standing(float(np.linalg.norm(gravity_e(position_e)))), _seen(position_e)
    setup = Setup(GRADES["tactical"], np.array([[0.1, 0.0, -1.0]]))
    aligner = Aligner(setup)
    aligner.feed(inertial)
    aligner.observe(observations)
    small = np.full(3, 0.1)
    start = Start(START_NS, position_e, np.zeros(3), np.zeros(3), small, small, np.radians(small))
    run = run_filter(inertial, observations, setup, start)
    forward(run)
    smooth(run)
    live = NavigationFilter(setup, start, smoothed=False)
    live.observe(observations)
    live.feed(inertial)


def _standing(gravity_mps2: float) -> Inertial:
    count = SECONDS * RATE_HZ
    time_ns = START_NS + np.arange(1, count + 1) * (SECOND_NS // RATE_HZ)
    velocity_b = np.tile([0.0, 0.0, -gravity_mps2 / RATE_HZ], (count, 1))
    return Inertial(time_ns, np.full(count, 1 / RATE_HZ), np.zeros((count, 3)), velocity_b, np.zeros(count, np.bool_))


def _seen(position_e: NDArray[np.float64]) -> StructArray:
    rows = np.zeros(2 * SECONDS, OBSERVATION_DTYPE)
    rows["time_ns"] = START_NS + np.repeat(np.arange(SECONDS), 2) * SECOND_NS
    rows["kind"] = np.tile([int(Kind.POSITION), int(Kind.VELOCITY)], SECONDS)
    rows["fix_type"], rows["satellites"], rows["sigma"] = int(FixType.RTK_FIXED), 12, 0.02
    rows["value"][::2] = position_e
    return sort_observations(rows)
