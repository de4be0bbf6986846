"""Tests that an error model is written and read back to the bit, and that wrong files are refused."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from swath.georef.error_model.model import ErrorModel, ErrorModelError
from swath.georef.error_model.state import model_of_state, state_of
from tests.georef.error_model.builders import SECOND, SLOW, unit

pytestmark = pytest.mark.xdist_group("kernels")


def state() -> dict[str, Any]:
    """Return the state of a model of two strips, as read from JSON."""
    read: dict[str, Any] = json.loads(json.dumps(state_of(ErrorModel([unit(1), unit(2, 255.0, start_s=260)], SLOW))))
    return read


def test_a_model_that_was_read_answers_as_the_one_written() -> None:
    written, read = ErrorModel([unit(1), unit(2, 255.0, start_s=260)], SLOW), model_of_state(state())
    places, times = np.array([[100.0, 400.0, 20.0], [0.0, 3.0, 1.0]]), np.array([120, 300]) * SECOND
    np.testing.assert_allclose(
        written.covariance(places, times, [0, 1]), read.covariance(places, times, [0, 1]), rtol=1e-13
    )
    assert state_of(read) == state_of(written)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda one: one.update(version=2), "version 2; this program reads"),
        (lambda one: one.update(format="GPM"), "is 'GPM', version 1"),
        (lambda one: one.pop("units"), "lacks 'units'"),
        (lambda one: one["units"][0].pop("noise"), "lacks 'noise'"),
        (lambda one: one["units"][0].update(noise=[1.0, float("nan"), 0.0]), "a number is not finite"),
        (lambda one: one["units"][0]["posts"]["gps_ns"].reverse(), "not in the order of their times"),
        (lambda one: one["units"][0]["posts"]["position_m"].pop(), "wrong value"),
        (lambda one: one["correlation_in_time"]["height"].update(alpha=1.0), "are no correlation function"),
        (lambda one: one.update(units=[]), "needs a unit"),
        (lambda one: one.update(units=3), "wrong value"),
    ],
)
def test_a_wrong_state_is_refused_in_one_line(change: Any, told: str) -> None:
    wrong = state()
    change(wrong)
    with pytest.raises(ErrorModelError, match=told) as caught:
        model_of_state(wrong)
    assert "\n" not in str(caught.value)
