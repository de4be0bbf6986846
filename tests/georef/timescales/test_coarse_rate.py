"""Tests that messages at another rate than the host's, as of a log replayed at another pace, give no time."""

from __future__ import annotations

import pytest

from swath.georef.timescales.coarse import CoarseClock
from swath.georef.timescales.gps_time import SECOND_NS


@pytest.mark.parametrize("rate", [0.5, 2.0, 4.0])
def test_an_implausible_rate_gives_no_time(rate: float) -> None:
    clock = CoarseClock()
    for second in range(12):
        clock.add(round(second * SECOND_NS / rate), (1000 + second) * SECOND_NS)
    assert clock.offset_ns() is None


def test_a_single_outlier_does_not_remove_the_time() -> None:
    clock = CoarseClock()
    for second in range(12):
        wrong = 50 * SECOND_NS if second == 6 else 0
        clock.add(second * SECOND_NS, (1000 + second) * SECOND_NS + wrong)
    assert clock.offset_ns() == 1000 * SECOND_NS + 250_000_000
