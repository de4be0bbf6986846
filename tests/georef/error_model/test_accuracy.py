"""Tests figures of accuracy against the formula sheet's worked numbers (FORMULAS 10.3, 10.5)."""

from __future__ import annotations

import numpy as np
import pytest

from swath.georef.error_model.accuracy import (
    CE90_PER_SIGMA,
    ce90,
    cross_covariance,
    ellipse,
    le90,
    principal_root,
    relative_covariance,
)
from swath.georef.error_model.correlation import Correlation

FIRST = np.array([[0.04, 0.01, 0.002], [0.01, 0.03, -0.004], [0.002, -0.004, 0.01]])
SECOND = np.array([[0.05, -0.01, 0.001], [-0.01, 0.02, 0.003], [0.001, 0.003, 0.012]])


def test_the_difference_of_two_points_is_that_of_the_formula_sheet() -> None:
    scales = ((8.0, 20.0), (3.0, 15.0), (1.0, 10.0))
    correlation = np.prod([Correlation(1.0, 0.0, 0.0, tau).at(apart) for apart, tau in scales])
    assert correlation == pytest.approx(0.49658530379140947, rel=1e-14)
    crossed = cross_covariance(FIRST, SECOND, float(correlation))
    expected = [[0.021437, -0.000808, 0.001018], [0.000636, 0.011194, 0.000274], [0.001322, -0.000575, 0.005232]]
    np.testing.assert_allclose(crossed, expected, atol=5.1e-7)
    relative = relative_covariance(FIRST, SECOND, crossed)
    np.testing.assert_allclose(np.diag(relative), [0.047125, 0.027612, 0.011535], atol=5.1e-7)
    assert ce90(relative[:2, :2]) == pytest.approx(0.416060592586446, rel=1e-9)
    assert le90(relative[2, 2]) == pytest.approx(0.1766627617776515, rel=1e-7)


def test_the_cross_covariance_of_a_point_with_itself_is_its_covariance() -> None:
    np.testing.assert_allclose(cross_covariance(FIRST, FIRST, 1.0), FIRST, atol=1e-16)
    np.testing.assert_allclose(
        principal_root(np.stack([FIRST, SECOND]))[1] @ principal_root(SECOND), SECOND, atol=1e-16
    )


def test_a_circle_s_radius_is_known_in_closed_form() -> None:
    assert CE90_PER_SIGMA == pytest.approx(np.sqrt(2.0 * np.log(10.0)), rel=1e-15)
    assert ce90(np.eye(2)) == pytest.approx(CE90_PER_SIGMA, rel=1e-10)
    assert ce90(np.diag([4.0, 0.0])) == pytest.approx(2.0 * 1.6448536269514722, rel=1e-9)
    assert ce90(np.zeros((2, 2))) == 0.0


@pytest.mark.parametrize("ratio", [0.9, 0.5, 0.1, 0.01])
def test_ninety_of_a_hundred_errors_lie_in_the_circle(ratio: float) -> None:
    drawn = np.random.default_rng(8).standard_normal((400_000, 2)) * [1.0, ratio]
    inside = np.mean(np.hypot(*drawn.T) < ce90(np.diag([1.0, ratio**2])))
    assert abs(inside - 0.9) < 4.0 * np.sqrt(0.09 / len(drawn))


def test_a_matrix_that_is_no_covariance_is_refused() -> None:
    with pytest.raises(ValueError, match="no covariance"):
        ce90(np.diag([1.0, -0.5]))


@pytest.mark.parametrize("azimuth_deg", [0.0, 30.0, 90.0, 150.0])
def test_the_ellipse_s_azimuth_counts_from_north_clockwise(azimuth_deg: float) -> None:
    azimuth = np.radians(azimuth_deg)
    along, across = np.array([np.sin(azimuth), np.cos(azimuth)]), np.array([np.cos(azimuth), -np.sin(azimuth)])
    found = ellipse(9.0 * np.outer(along, along) + np.outer(across, across))
    assert (found.major_m, found.minor_m) == pytest.approx((3.0, 1.0))
    assert found.azimuth_deg == pytest.approx(azimuth_deg, abs=1e-9) or azimuth_deg == 0.0
    assert np.sin(np.radians(found.azimuth_deg)) == pytest.approx(np.sin(azimuth), abs=1e-9)
