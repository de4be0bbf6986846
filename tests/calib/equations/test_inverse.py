"""Tests inverses of matrices of mixed units against NumPy's, and covariances rotated between frames."""

from __future__ import annotations

import numpy as np
import pytest

from swath.calib.equations.inverse import inverted
from swath.calib.equations.normals import TrajectoryWeight
from swath.calib.equations.rows import Rows
from swath.calib.equations.trajectory_prior import gauss_markov
from swath.calib.parameters import ParameterOptions, unknowns
from tests.calib.roofs import LINES, made


def test_the_inverse_matches_numpy_despite_mixed_units() -> None:
    g = np.random.default_rng(8)
    unit = 10.0 ** g.uniform(-8.0, 3.0, 40)
    root = g.normal(size=(40, 60))
    plain = root @ root.T
    found = inverted(plain * np.outer(unit, unit)) * np.outer(unit, unit)
    np.testing.assert_allclose(found, np.linalg.inv(plain), rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(found, found.T)


@pytest.mark.parametrize("last", [1.0, 2.0, np.nan])
def test_a_matrix_that_is_not_positive_definite_is_refused(last: float) -> None:
    matrix = np.array([[1.0, last], [last, 1.0]])
    with pytest.raises(np.linalg.LinAlgError):
        inverted(matrix)


def test_weights_and_variances_of_the_trajectory_are_rotated_with_the_axes() -> None:
    flight = made(lines=LINES[:2], points=2).flight
    prior = gauss_markov(flight, knot_s=5.0)
    weight = TrajectoryWeight(Rows(flight, (), unknowns(flight, ParameterOptions()), prior))
    turn = np.zeros((len(prior), 2, 3, len(prior), 2, 3))
    for knot in range(len(prior)):
        turn[knot, 0, :, knot, 0] = turn[knot, 1, :, knot, 1] = weight.rot_e_from_l[knot]
    whole = turn.reshape(6 * len(prior), -1)
    covariance_e = whole @ prior.covariance @ whole.T
    unit = np.sqrt(np.outer(np.diag(covariance_e), np.diag(covariance_e)))
    np.testing.assert_allclose(weight.normal * unit, np.linalg.inv(covariance_e / unit), rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(weight.variances_l(covariance_e), np.diag(prior.covariance), rtol=1e-9)
