"""Tests that sigmas of calibrations hold for many flight designs, with held parameters plausibly wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.calibration.designs import LIMIT, Case, flight_of, normalised, run
from swath.calib.adjust import adjust
from swath.calib.equations.solve import Settings
from swath.calib.equations.trajectory_prior import Taus, gauss_markov
from swath.calib.features import ControlPoint, Features
from swath.calib.parameters import ParameterOptions

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("kernels")]

ANGLES = {"left.omega_rad", "left.phi_rad", "left.kappa_rad"}


def test_no_parameter_of_forty_flights_exceeds_four_sigmas() -> None:
    offsets, flights = run(range(1, 41), minutes=60.0)
    assert flights == 40
    assert len({one.case.design for one in offsets}) == 7  # one line, …, two heights
    assert sum(one.held for one in offsets) > 100
    assert max(abs(one.normalised) for one in offsets) <= LIMIT
    told = np.array([one.normalised for one in offsets if not one.held])
    assert 0.8 < np.mean(told**2) < 1.25  # of some 250 estimates, many of one flight


def with_points(features: Features, each: int, seed: int) -> Features:
    """Add so many control points of 1 cm to every level plane."""
    rng = np.random.default_rng(seed)
    planes = []
    for plane in features.planes:
        places = plane.centre_t + np.column_stack([rng.uniform(-5.0, 5.0, (each, 2)), 0.01 * rng.normal(size=each)])
        points = tuple(ControlPoint(f"{plane.name}.{at}", place, 0.01) for at, place in enumerate(places))
        planes.append(replace(plane, control=points) if plane.normal_t[2] > 0.999 else plane)
    return Features(tuple(planes))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_six_lines_and_thirty_control_points_determine_the_boresight_with_a_mems_imu(seed: int) -> None:
    """Attitude errors are six times those of a tactical unit; no angle is held, and each is within its sigmas."""
    case = Case(seed, "six", "MEMS", "basic", 1.0, 35.0, control=False)
    built, planes = flight_of(case)
    features = with_points(planes, 6, seed)
    assert sum(len(plane.control) for plane in features.planes) == 30
    prior = gauss_markov(built.flight, Taus(), 4.0)
    found = adjust(built.flight, features, ParameterOptions(case.model), prior, Settings(huber=0.0, family=0.0))
    assert set(found.names) == {*ANGLES, "left.range_offset_m"}
    assert found.held == ()
    sigmas = dict(zip(found.names, found.sigmas.tolist(), strict=True))
    assert all(np.radians(0.005) < sigmas[name] < np.radians(0.03) for name in ANGLES), sigmas
    assert 0.0 < sigmas["left.range_offset_m"] < 0.1
    assert max(abs(one.normalised) for one in normalised(case, built, found)) < LIMIT
