"""A flight that several tests of navigation under noise use."""

from __future__ import annotations

from functools import cache

from tests.georef.navigation.flights import Truth, fly, survey


@cache
def flight() -> Truth:
    """Return the truth of 240 s of survey lines at 50 Hz."""
    return fly(survey(), 240.0, 50.0)
