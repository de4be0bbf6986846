"""Tests models made from tables: gimbals with logged angles, pulse rates that no device reports."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from swath.daemon.config import Config
from swath.daemon.config.tables import GimbalConfig, ScannerConfig
from swath.daemon.errors import ConfigError
from swath.daemon.processing.setup.models import (
    connect,
    geometry_of,
    gimbal_sources,
    make_georeferencer,
    make_resolver,
    mount_of,
    refuse_logged_gimbals,
)
from swath.drivers.driver import find_driver
from swath.drivers.parser import DeviceSettings
from swath.drivers.scanner.srep.parser import SrepParser
from swath.georef.georeference import Georeferencer
from swath.georef.points import Fate
from swath.georef.scanner.beams import LineGeometry
from swath.georef.scanner.calibration import RangeOffset, nominal
from swath.georef.scanner.mount import AngleSeries
from swath.georef.scanner.ranging import ZoneResolver
from swath.georef.scanner.sensor_model import SensorModel
from swath.georef.stream.stream import ScannerChain
from tests.daemon.standin import aircraft_config
from tests.georef.scanner_cases import rows_of, still_trajectory

pytestmark = pytest.mark.xdist_group("kernels")

MS = 1_000_000
STAGES = {
    "stages": [
        {"source": "imu/gimbal", "angles_deg": [0.5, 0.0, -1.0], "lever_arm_m": [0.1, 0.0, 0.4]},
        {"angles_deg": [0.0, 10.0, 0.0]},
    ]
}


def test_a_scanner_without_declared_beams_is_not_taken_for_a_line_scanner() -> None:
    """srep's parser, which has no table of beams, is given under the name of a head that has one."""
    table = ScannerConfig.model_validate({"transport": "udp:0.0.0.0:2368", "protocol": "velodyne-vlp16"})
    with pytest.raises(
        ValueError,
        match="velodyne-vlp16: its parser has no beam table, its returns have no elevation, and it is not",
    ):
        geometry_of(table, SrepParser(DeviceSettings("scanner/left", {"mirror_factor": 2.0})))


def test_logged_angles_are_added_to_the_fixed_ones_of_the_stage() -> None:
    series = AngleSeries(np.array([0, 100]) * MS, np.array([[0.0, 0.1, 3.0], [0.2, 0.1, 3.2]]))
    mount = mount_of(GimbalConfig.model_validate(STAGES), {"imu/gimbal": series})
    rows, time_ns = rows_of(np.array([0.3, -0.2]), 800.0), np.array([25, 75]) * MS
    model = SensorModel(nominal("left", np.zeros(3), np.eye(3)), LineGeometry(), mount=mount)
    points = model.rays(rows, time_ns, still_trajectory()).points_e
    for point, share, theta in zip(points, (0.25, 0.75), (0.3, -0.2), strict=True):
        roll, pitch, yaw = np.array([0.2 * share, 0.1, 3.0 + 0.2 * share]) + np.radians([0.5, 0.0, -1.0])
        inner = Rotation.from_euler("y", 10.0, degrees=True)
        beam = 800.0 * np.array([0.0, np.sin(theta), np.cos(theta)])
        wanted = Rotation.from_euler("ZYX", [yaw, pitch, roll]).apply(np.array([0.1, 0.0, 0.4]) + inner.apply(beam))
        assert point == pytest.approx(wanted, abs=1e-9)


def test_returns_wait_until_the_angles_are_known() -> None:
    mount = mount_of(GimbalConfig.model_validate(STAGES))
    assert mount.moves
    model = SensorModel(nominal("left", np.zeros(3), np.eye(3)), LineGeometry(), mount=mount)
    rays = model.rays(rows_of(np.zeros(2), 800.0), np.array([0, 50]) * MS, still_trajectory())
    assert set(rays.fate.tolist()) == {Fate.OUTSIDE_TRAJECTORY}


def test_a_source_without_angles_is_refused_in_one_line() -> None:
    with pytest.raises(ValueError, match=r'^gimbal\.stages\[0\]\.source: "imu/gimbal" sent no angles$'):
        mount_of(GimbalConfig.model_validate(STAGES), {})


FIXED = "angles_deg = [0, 0, 0]"


def logged(folder: Path, source: str) -> Config:
    """Return an aircraft whose gimbal is read by a source; its receiver, a NovAtel, is an INS too."""
    return aircraft_config(folder, {FIXED: f'source = "{source}", angles_deg = [0, 0, 0]'})


def test_sources_of_gimbal_angles_are_found(tmp_path: Path) -> None:
    assert list(gimbal_sources(aircraft_config(tmp_path / "fixed", {}), "left")) == []
    assert list(gimbal_sources(logged(tmp_path / "logged", "gnss/rover"), "left")) == [(0, "gnss/rover")]


def test_a_source_without_an_ins_is_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r'^gimbal.stages.0..source: "imu/main" sends no gimbal angles') as caught:
        georeferencer(logged(tmp_path, "imu/main"), "srep")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("source", ["imu/nobody", "scanner/left"])
def test_a_source_that_is_not_configured_is_refused_before_the_flight(tmp_path: Path, source: str) -> None:
    with pytest.raises(ConfigError, match=f'gimbal.stages.0..source: got "{source}", want one of: gnss/rover, imu/ma'):
        logged(tmp_path, source)


def test_logged_angles_are_refused_where_waiting_is_impossible(tmp_path: Path) -> None:
    refuse_logged_gimbals(aircraft_config(tmp_path / "fixed", {}), ["left"])
    config = logged(tmp_path / "logged", "gnss/rover")
    refuse_logged_gimbals(config, [])
    with pytest.raises(ValueError, match=r'^scanner\.left\.gimbal\.stages\[0\]\.source: angles of "gnss/rover" are'):
        refuse_logged_gimbals(config, ["left"])
    with pytest.raises(ValueError, match="sent no angles"):
        georeferencer(config, "srep")
    assert georeferencer(config, "srep", angles=None).model.mount.moves


def georeferencer(config: Config, protocol: str, **keys: Any) -> Georeferencer:
    offsets = (RangeOffset(0.01, return_slot=1), RangeOffset(0.02, prf_hz=100e3))
    calibration = replace(nominal("left", np.zeros(3), np.eye(3)), range_offsets=offsets)
    settings = DeviceSettings("scanner/left", {"mirror_factor": 1.0})
    parser = find_driver("scanner", protocol).make_parser(settings)
    config.scanner["left"] = config.scanner["left"].model_copy(update={"protocol": protocol})
    return make_georeferencer(config, "left", calibration, parser, None, None, uncertainty=False, **keys)


def test_an_offset_by_an_unreported_pulse_rate_is_refused_in_one_line(tmp_path: Path) -> None:
    config = aircraft_config(tmp_path, {})
    assert georeferencer(config, "srep").rates is None
    with pytest.raises(ValueError, match=r"range_offset\.prf_hz: velodyne-vlp16 sends no pulse rate; use") as caught:
        georeferencer(config, "velodyne-vlp16")
    assert "\n" not in str(caught.value)


def test_a_chain_receives_the_emissions_and_rates_of_its_parser() -> None:
    keys = {"transport": "udp:0.0.0.0:2368", "protocol": "srep", "mirror_factor": 2.0}
    table = ScannerConfig.model_validate(keys)
    made = Georeferencer(SensorModel(nominal("left", np.zeros(3), np.eye(3)), LineGeometry()))
    chain = ScannerChain("left", made, make_resolver(table, 1000.0))
    parser = SrepParser(DeviceSettings("scanner/left", {"mirror_factor": 2.0}))
    connect(chain, parser)
    assert parser.emissions
    assert parser.tell_rates is not None
    parser.tell_rates(7, 90_000.0, 10**7)
    assert isinstance(chain.resolver, ZoneResolver)
    assert chain.resolver.rates is made.rates
    assert made.rates is not None
    assert made.rates.runs(np.array([7])) == [(0, 1, 90_000.0, 10**7)]
    connect(ScannerChain("top", made), find_driver("scanner", "velodyne-vlp16").make_parser(DeviceSettings("top")))
