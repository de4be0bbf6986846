"""Tests the correlation functions against the formula sheet's values (FORMULAS 10.4)."""

from __future__ import annotations

import numpy as np
import pytest

from swath.georef.error_model.correlation import Correlation, fit

SHEET = Correlation(0.95, 0.1, 0.5, 10.0)


def test_values_are_those_of_the_formula_sheet() -> None:
    expected = [0.6918666189924749, 0.4935045649697116, 0.09817506456747077]
    np.testing.assert_allclose(SHEET.at([5.0, 10.0, 60.0]), expected, rtol=1e-14)
    assert SHEET.at(1e-12) == pytest.approx(0.95, abs=1e-12)
    assert SHEET.at(0.0) == 1.0
    np.testing.assert_array_equal(SHEET.at([-5.0, 1e9]), [SHEET.at(5.0), 0.095])


def test_without_three_of_its_parameters_it_is_an_exponential() -> None:
    lag = np.array([0.1, 3.0, 50.0])
    np.testing.assert_allclose(Correlation(1.0, 0.0, 0.0, 7.0).at(lag), np.exp(-lag / 7.0), rtol=1e-14)


@pytest.mark.parametrize("values", [(1.0, 0.999, 10.0, 3.0), (0.3, 0.0, 5.0, 20.0), (0.95, 0.1, 0.5, 10.0)])
def test_every_function_makes_a_covariance(values: tuple[float, float, float, float]) -> None:
    times = np.sort(np.random.default_rng(4).uniform(0.0, 60.0, 80))
    matrix = Correlation(*values).at(times[:, np.newaxis] - times)
    assert np.linalg.eigvalsh(matrix).min() > 0.0 if values[0] < 1.0 else np.linalg.eigvalsh(matrix).min() > -1e-12


@pytest.mark.parametrize(
    "values", [(0.0, 0.0, 0.0, 1.0), (1.1, 0.0, 0.0, 1.0), (1.0, 1.0, 0.0, 1.0), (1.0, 0.0, 11.0, 1.0), (1, 0, 0, 0.0)]
)
def test_what_is_no_correlation_is_refused(values: tuple[float, float, float, float]) -> None:
    with pytest.raises(ValueError, match="are no correlation function"):
        Correlation(*values)


@pytest.mark.parametrize("truth", [SHEET, Correlation(1.0, 0.3, 3.0, 40.0), Correlation(0.8, 0.0, 0.0, 15.0)])
def test_a_fit_finds_the_function_again(truth: Correlation) -> None:
    lag = np.linspace(0.5, 150.0, 120)
    found = fit(lag, truth.at(lag))
    np.testing.assert_allclose(found.correlation.at(lag), truth.at(lag), atol=2e-4)
    assert found.largest < 2e-4


def test_a_fit_tells_what_it_leaves() -> None:
    lag = np.arange(1.0, 40.0)
    found = fit(lag, np.where(lag % 2 == 0, 0.1, -0.1))
    assert found.rms == pytest.approx(0.1, rel=0.1)
    assert found.largest > 0.05
    with pytest.raises(ValueError, match="lags that are not zero"):
        fit([0.0], [1.0])
