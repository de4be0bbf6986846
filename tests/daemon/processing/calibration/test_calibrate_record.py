"""Tests what configuration and navigation contribute about the instruments to a calibration's record."""

from __future__ import annotations

from pathlib import Path

import pytest

from swath.calib.record.record import told_value
from swath.daemon.processing.calibration.record import instruments_of
from swath.daemon.processing.calibration.returns import read_flight
from swath.daemon.processing.flights.read import GeorefOptions
from swath.daemon.processing.flights.trajectory_choice import TrajectoryOptions
from swath.daemon.processing.setup.setup import Options
from tests.calib.village import Made, village

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("kernels")]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    return village(tmp_path_factory.mktemp("village"), prf_hz=2_000.0, lines=(0, 1))


def test_a_navigated_flight_names_its_instruments(made: Made, tmp_path: Path) -> None:
    options = Options(datum="same", uncertainty=False)
    kept = read_flight(
        GeorefOptions([made.flown.log], tmp_path, TrajectoryOptions(navigate=True), options), tmp_path, lambda *_: None
    )
    told = instruments_of(kept)
    config = made.flown.config
    (receiver,), (unit,) = config.gnss.values(), config.imu.values()
    assert told["CA_IMU.dataRate"].content == f"PT{1.0 / unit.rate_hz:g}S"
    assert told["CA_AuxiliaryDevice.leverarm"].content == tuple(receiver.lever_arm_m)
    assert told["CA_GNSS.registrationCycle"].content == "PT0.2S"  # of the plan
    satellites = told["CA_GNSS.numberSatellites"].content
    assert isinstance(satellites, int)
    assert 4 <= satellites <= 40
    for key, value in told.items():
        assert isinstance(value.content, str | int | float | tuple)
        told_value(key, value.content)  # raises unless the attribute exists and takes the value


def test_a_supplied_trajectory_names_no_instruments(made: Made, tmp_path: Path) -> None:
    options = Options(datum="same", uncertainty=False)
    trajectory = TrajectoryOptions(made.flown.folder / "true_trajectory.csv")
    assert (
        instruments_of(
            read_flight(GeorefOptions([made.flown.log], tmp_path, trajectory, options), tmp_path, lambda *_: None)
        )
        == {}
    )
