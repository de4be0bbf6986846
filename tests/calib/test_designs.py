"""Sigmas of calibrations hold on flights of many designs, whatever is held and off by what is plausible of it."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.calibration_designs import LIMIT, run

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("kernels")]


def test_no_parameter_of_forty_flights_is_beyond_four_of_its_sigmas() -> None:
    offsets, flights = run(range(1, 41), minutes=60.0)
    assert flights == 40
    assert len({one.case.design for one in offsets}) == 7  # one line, …, two heights
    assert sum(one.held for one in offsets) > 100
    assert max(abs(one.normalised) for one in offsets) <= LIMIT
    told = np.array([one.normalised for one in offsets if not one.held])
    assert 0.8 < np.mean(told**2) < 1.25  # of some 250 estimates, many of one flight
