"""Tests that the place of a flight is found in a few seconds of its log."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from swath.daemon.log.parsers import stored_config
from swath.daemon.log.reader import open_logs
from swath.daemon.processing.flights.flight_places import flight_places
from swath.georef.arrays import FloatArray
from tests.daemon.one_line import Flown, fly

pytestmark = [pytest.mark.xdist_group("kernels"), pytest.mark.slow]


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    return fly(tmp_path_factory.mktemp("line"))


def places_of(log: Path) -> FloatArray:
    """Return the places of a log with its own configuration."""
    (session,) = open_logs([log])
    attachments = session.attachments()
    config = stored_config(attachments)
    assert config is not None
    return flight_places(session, config, attachments)


def test_places_lie_along_the_flight(flown: Flown) -> None:
    truth = flown.truth
    way = np.degrees(np.column_stack([truth["trajectory.lat_rad"], truth["trajectory.lon_rad"]]))
    places = places_of(flown.log)
    assert len(places) >= 6
    away, at = cKDTree(way).query(places)
    assert away.max() < 1e-3
    assert np.ptp(at) > 0.7 * len(way)


def test_a_log_that_was_cut_off_is_not_walked_through(flown: Flown, tmp_path: Path) -> None:
    log = flown.copy_of_log(tmp_path)
    log.write_bytes(log.read_bytes()[:-20])
    assert places_of(log).shape == (0, 2)
