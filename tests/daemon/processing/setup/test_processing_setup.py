"""Tests the way from a configuration to models, clocks and parsers, and every mistake in one line."""

from __future__ import annotations

import math
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from swath.daemon.config import Config
from swath.daemon.errors import ConfigError, UserError
from swath.daemon.log.format import SessionInfo
from swath.daemon.processing.setup.setup import Options, Setup
from swath.georef.records import INS_DTYPE, NamesEdge
from swath.georef.scanner.beams import LineGeometry, SpinningGeometry
from swath.georef.stream.clocks import DevicePlan, GnssPlan, PpsPlan
from swath.georef.timescales import StampScale
from tests.daemon.standin import AIRCRAFT, aircraft_config

pytestmark = pytest.mark.xdist_group("kernels")

INFO = SessionInfo("one", "swath", "host", "boot", 5_000, 2_000)
VLP = """
[scanner.top]
transport = "udp:0.0.0.0:2370"
protocol = "velodyne-vlp16"
installation = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]
lever_arm_m = [1, 2, 3]

[attitude]
"""


def config(folder: Path, **changes: str) -> Config:
    return aircraft_config(folder, {"[attitude]\n": VLP, **changes})


def inside_the_receiver() -> dict[str, str]:
    """Return the configuration with the receiver's INS in place of the IMU on CAN."""
    text = AIRCRAFT.read_text()
    imu = text[text.index("[imu.main]") : text.index("[imu.main.noise]")]
    rows = "[[0, 1, 0], [-1, 0, 0], [0, 0, 1]]"
    return {imu: f'[imu.main]\ntransport = "gnss:rover"\nprotocol = "novatel"\nrotation_b_imu = {rows}\n\n'}


def setup_of(config: Config, **options: Any) -> Setup:
    words: dict[str, Any] = {"datum": "same", "uncertainty": False, **options}
    return Setup.of_config(config, Options(**words))


@pytest.fixture
def setup(tmp_path: Path) -> Setup:
    return setup_of(config(tmp_path))


def test_each_scanner_has_its_geometry_calibration_and_gate(setup: Setup) -> None:
    assert setup.scanners == ["left", "top"]
    left, top = (setup.georeferencer(name).model for name in setup.scanners)
    assert isinstance(left.geometry, LineGeometry)
    assert isinstance(top.geometry, SpinningGeometry)
    assert top.geometry.elevation_deg[:3] == pytest.approx([-15, 1, -13])
    assert left.range_gate == (20.0, 3000.0)
    assert setup.calibrations["left"].id != "nominal"
    assert setup.calibrations["top"].id == "nominal"
    assert setup.calibrations["top"].lever_arm_b == pytest.approx([1, 2, 3])
    assert setup.calibrations["top"].installation_matrix[0] == pytest.approx([0, 0, 1])


def test_clocks_equal_those_of_the_recorder(setup: Setup) -> None:
    plan = setup.sources.clock_plan(INFO)
    assert plan.host_minus_monotonic_ns == 3_000
    assert plan.pps == {"pps/main": PpsPlan(18, 0)}
    assert plan.gnss == {"gnss/rover": GnssPlan("pps/main", None, 18)}
    # a head without its own pulse uses the host's clock; Velodyne's stamps count from the hour
    assert plan.devices == {
        "scanner/left": DevicePlan("pps/main"),
        "scanner/top": DevicePlan("pps/main", True, StampScale.AUTO),
    }


def test_a_configured_edge_and_delay_reach_the_clocks(tmp_path: Path) -> None:
    changed = config(tmp_path, **{'names_edge = "auto"': 'names_edge = "next"', "delay_ns = 0": "delay_ns = 70"})
    plan = setup_of(changed).sources.clock_plan(INFO)
    assert plan.gnss["gnss/rover"].names_edge is NamesEdge.NEXT
    assert plan.pps["pps/main"].delay_ns == 70


def test_sources_and_the_devices_inside_them_are_found(tmp_path: Path, setup: Setup) -> None:
    assert setup.sources.ins_source == "gnss/rover"
    assert setup.sources.ins_protocol == "novatel"
    assert setup.sources.inside("gnss/rover") == ["gnss/rover"]
    assert setup.sources.edge_of("pps/main") == "assert"
    assert setup.sources.edge_of("pps/other") is None
    text = AIRCRAFT.read_text()
    imu = text[text.index("[imu.main]") : text.index("[imu.main.noise]")]
    within = (
        '[imu.main]\ntransport = "gnss:rover"\nprotocol = "novatel"\nrotation_b_imu = [[0,1,0],[-1,0,0],[0,0,1]]\n\n'
    )
    span = setup_of(config(tmp_path / "span", **{imu: within})).sources
    assert span.ins_source == "imu/main"
    assert span.inside("gnss/rover") == ["gnss/rover", "imu/main"]
    assert list(span.ins_parser()) == ["imu/main"]


def test_the_attitude_of_an_ins_is_converted_to_the_body(tmp_path: Path) -> None:
    setup = setup_of(config(tmp_path, **inside_the_receiver()))
    row = np.zeros(1, INS_DTYPE)
    row["roll_rad"], row["pitch_rad"], row["heading_rad"] = 0.1, -0.2, 1.0
    turned = setup.sources.ins_rows(row)[0]
    told = Rotation.from_euler("ZYX", [1.0, -0.2, 0.1])
    got = Rotation.from_euler("ZYX", [turned["heading_rad"], turned["pitch_rad"], turned["roll_rad"]])
    rot_b_from_imu = Rotation.from_matrix([[0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    assert (got.inv() * told * rot_b_from_imu.inv()).magnitude() < 1e-12
    # the same rotation of the aircraft, measured along the IMU's axes
    assert setup.sources.in_b(np.array([[1.0, 2.0, 3.0]]))[0] == pytest.approx([2.0, -1.0, 3.0])
    assert row["roll_rad"][0] == 0.1


def test_deflection_of_the_vertical_is_in_radians(tmp_path: Path, setup: Setup) -> None:
    assert setup.deflection_rad is None
    plumb = 'vertical = "plumb"\nxi_arcsec = 10.0\neta_arcsec = -5.0'
    turned = setup_of(config(tmp_path / "plumb", **{'vertical = "ellipsoid"': plumb}))
    assert turned.deflection_rad == pytest.approx((math.radians(10 / 3600), math.radians(-5 / 3600)))


def test_a_setup_can_be_pickled(setup: Setup) -> None:
    again = pickle.loads(pickle.dumps(setup))
    assert again.mapping is not None
    assert setup.mapping is not None
    assert again.mapping.wkt == setup.mapping.wkt
    assert again.live_stream(INFO).scanners == ["left", "top"]


def test_only_the_requested_scanners_are_set_up(tmp_path: Path) -> None:
    setup = setup_of(config(tmp_path), scanners=("top",))
    assert setup.scanners == ["top"]
    assert list(setup.sources.parsers(("scanner",))) == ["scanner/top"]


@pytest.mark.parametrize(
    ("header", "said"),
    [
        ('scanner = "right"', 'calibration.scanner: belongs to scanner "right"; use a calibration of "left"'),
        (
            'scanner_serial = "77"',
            'calibration.scanner_serial: belongs to another head: "77", the configuration has "1234"',
        ),
        ('ranges = "vacuum"', 'was estimated with ranges = "vacuum", [atmosphere] has "corrected"'),
        ('refraction = "ardc"', 'was estimated with refraction = "ardc", [atmosphere] has "none"'),
        ("mirror_factor = 2.0", "was estimated with 2, the configuration has 1; set both alike, or calibrate again"),
        ("installation_matrix = [[0,1,0],[-1,0,0],[0,0,1]]", "differs from the configuration's installation"),
        ('method = "guessed"', "guessed"),
    ],
)
def test_a_calibration_of_another_flight_is_refused(tmp_path: Path, header: str, said: str) -> None:
    key = header.split(" = ")[0]
    lines = (AIRCRAFT.parent / "left.toml").read_text().splitlines()
    lines = [line for line in lines if not line.startswith(f"{key} =")]
    lines.insert(lines.index("[calibration]") + 1, header)
    with pytest.raises(ConfigError) as caught:
        setup_of(config(tmp_path), calibrations={"left": ("\n".join(lines), "mine.toml")})
    assert len(caught.value.lines) == 1
    assert caught.value.lines[0].startswith("mine.toml: ")
    assert said in caught.value.lines[0]


@pytest.mark.parametrize(
    ("changes", "options", "said"),
    [
        ({}, {"scanners": ("front",)}, "scanner front: is not in the configuration, which has: left, top"),
        ({}, {"crs": "EPSG:99999"}, "EPSG:99999"),
        (
            {"angles_deg = [0, 0, 0]": 'source = "imu/main", angles_deg = [0, 0, 0]'},
            {},
            'scanner.left: gimbal.stages[0].source: "imu/main" sends no gimbal angles',
        ),
    ],
)
def test_impossible_settings_are_refused_in_one_line(
    tmp_path: Path, changes: dict[str, str], options: dict[str, Any], said: str
) -> None:
    with pytest.raises(ConfigError) as caught:
        setup_of(config(tmp_path, **changes), **options)
    assert len(caught.value.lines) == 1
    assert said in caught.value.lines[0]


def test_error_for_a_log_without_configuration_gives_the_remedy() -> None:
    with pytest.raises(UserError, match="--config"):
        Setup.of_log({})


def test_error_names_a_calibration_missing_from_the_log(tmp_path: Path) -> None:
    files = {name: data for name, _, data in config(tmp_path).attachments()}
    assert Setup.of_log(files, Options(datum="same")).calibrations["left"].id
    del files["calibration/left.toml"]
    with pytest.raises(ConfigError, match=r"left\.toml is not in the log"):
        Setup.of_log(files, Options(datum="same"))
