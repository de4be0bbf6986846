"""Tests gravity against published values and the simulator's, and its gradient against differences."""

from __future__ import annotations

import numpy as np
import pytest

from swath.georef.geodesy.earth import e_from_geodetic
from swath.georef.geodesy.gravity import gradient_of, gravity_e
from swath.sim.gravity import gravity_e as simulated

pytestmark = pytest.mark.xdist_group("kernels")

LAT = np.radians([0.0, 47.5, -33.0, 89.999, 90.0, -90.0, 12.0])
LON = np.radians([0.0, 8.5, 180.0, -179.999, 0.0, 77.0, -120.0])
HEIGHT = np.array([0.0, 450.0, 6000.0, 3000.0, 0.0, 120.0, -50.0])
PLACES = e_from_geodetic(LAT, LON, HEIGHT)


def test_gravity_at_the_equator_and_the_poles_matches_the_published_values() -> None:
    """The published values are those of NIMA TR8350.2, table 3.4."""
    there = gravity_e(np.array([[6_378_137.0, 0.0, 0.0], [0.0, 0.0, 6_356_752.314245], [0.0, 0.0, -6_356_752.314245]]))
    published = [[-9.7803253359, 0, 0], [0, 0, -9.8321849378], [0, 0, 9.8321849378]]
    np.testing.assert_allclose(there, published, rtol=0, atol=2e-10)


def test_gravity_anywhere_matches_the_simulator() -> None:
    """The simulator computes the normal independently, with PROJ."""
    np.testing.assert_allclose(gravity_e(PLACES), simulated(PLACES), rtol=0, atol=1e-11)


def test_the_gravity_gradient_matches_difference_quotients() -> None:
    step = 50.0
    forth = np.stack([gravity_e(PLACES + step * axis) for axis in np.eye(3)], axis=-1)
    back = np.stack([gravity_e(PLACES - step * axis) for axis in np.eye(3)], axis=-1)
    quotient = (forth - back) / (2.0 * step)
    gradient = [gradient_of(*place) for place in PLACES.tolist()]
    np.testing.assert_allclose(gradient, quotient, rtol=0, atol=1e-10)  # of 3e-6 1/s²
