"""Fixtures that tests of several parts of calib use."""

from __future__ import annotations

import pytest

from tests.calib.made_outcome import Outcome, made_outcome


@pytest.fixture(scope="module")
def outcome() -> Outcome:
    """Return an outcome of a calibration with 40 000 returns a strip."""
    return made_outcome(40_000)
