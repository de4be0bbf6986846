"""Tests the monotone curve through knots against SciPy's, and its derivatives against differences."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import PchipInterpolator

from swath.calib.intensity_curve import STEPS, at_knots, curve, curve_by_knots, nodes_of
from swath.georef.arrays import FloatArray


@st.composite
def tables(draw: st.DrawFn) -> tuple[FloatArray, FloatArray]:
    """Draw knots, and corrections of a few centimetres at them, with some equal neighbours."""
    count = draw(st.integers(3, 9))
    gaps = draw(st.lists(st.floats(0.5, 40.0), min_size=count, max_size=count))
    corrections = draw(st.lists(st.integers(-80, 80), min_size=count, max_size=count))
    return np.cumsum(gaps), 1e-3 * np.array(corrections, dtype=np.float64)


@given(tables())
def test_the_curve_is_the_monotone_cubic(table: tuple[FloatArray, FloatArray]) -> None:
    """The curve is exact at the nodes; between them its error is the share of the knots' differences set by `STEPS`."""
    knots, correction_m = table
    nodes, found, cubic = nodes_of(knots), curve(knots, correction_m), PchipInterpolator(knots, correction_m)
    assert at_knots(nodes).tolist() == knots.tolist()
    assert at_knots(found).tolist() == correction_m.tolist()
    np.testing.assert_allclose(found, cubic(nodes), atol=1e-14)
    between = np.linspace(knots[0], knots[-1], 3001)
    missed_m = np.abs(np.interp(between, nodes, found) - cubic(between)).max()
    assert missed_m <= 1.5 / STEPS**2 * np.abs(np.diff(correction_m)).max() + 1e-14
    assert 1.5 / STEPS**2 * 0.05 < 5e-5


@given(tables())
def test_monotone_knots_give_a_monotone_table(table: tuple[FloatArray, FloatArray]) -> None:
    """Each piece between two knots is monotone, whatever the other pieces do."""
    knots, correction_m = table
    for values in (correction_m, np.sort(correction_m), np.sort(correction_m)[::-1]):
        found = curve(knots, values)
        for piece, rise_m in enumerate(np.diff(values)):
            steps_m = np.diff(found[piece * STEPS : (piece + 1) * STEPS + 1])
            assert (steps_m * np.sign(rise_m) >= -1e-16).all()
            assert rise_m != 0.0 or np.abs(steps_m).max() < 1e-16


@pytest.mark.parametrize("seed", range(20))
def test_derivatives_match_finite_differences(seed: int) -> None:
    """Complex steps fail because slopes compare signs, so central differences are used away from zero secants."""
    g = np.random.default_rng(seed)
    knots = np.cumsum(g.uniform(2.0, 40.0, 6))
    correction_m = np.cumsum(g.uniform(0.01, 0.05, 6) * (g.choice([-1.0, 1.0], 6) if seed % 2 else 1.0))
    step_m = 1e-6
    moved = [
        (curve(knots, correction_m + step_m * one) - curve(knots, correction_m - step_m * one)) / (2.0 * step_m)
        for one in np.eye(6)
    ]
    np.testing.assert_allclose(curve_by_knots(knots, correction_m), moved, atol=1e-7)


def test_equal_knots_have_the_derivatives_of_a_gentle_rise() -> None:
    """An adjustment begins there, so its columns must separate the knots and together move all points."""
    knots = np.array([0.0, 10.0, 30.0, 60.0, 100.0])
    found = curve_by_knots(knots, np.zeros(5))
    np.testing.assert_allclose(found.sum(axis=0), 1.0, atol=1e-14)
    np.testing.assert_allclose(found, curve_by_knots(knots, 1e-3 * knots), atol=1e-12)
    assert np.linalg.matrix_rank(found) == 5


def test_two_knots_give_a_straight_line() -> None:
    knots, correction_m = np.array([5.0, 25.0]), np.array([-0.01, 0.03])
    np.testing.assert_allclose(curve(knots, correction_m), np.interp(nodes_of(knots), knots, correction_m), atol=1e-15)
    np.testing.assert_allclose(
        correction_m @ curve_by_knots(knots, correction_m), curve(knots, correction_m), atol=1e-15
    )
