"""Tests allowed but improbable settings, and the geometry in words and as a drawing, as `swath check` prints them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from swath.daemon.config import load_config, parse_config
from swath.daemon.config.findings import NO_SOURCE, configuration_findings
from swath.daemon.config.geometry import Placed, drawing, geometry_lines, place_words, placed_devices
from tests.daemon.commands import swath

FIXTURES = Path(__file__).parents[3] / "fixtures/config"
AIRCRAFT = FIXTURES / "aircraft.toml"
MILLIMETRES = FIXTURES / "lever-arm-in-mm.toml"
CAN_IMU = '[imu.m]\ntransport = "can:socketcan:can0"\nprotocol = "xsens-mti"\ntick_hz = 10000\npps = "p"\n'
PPS = '[pps.p]\nsource = "/dev/pps0"\n'


def findings(text: str) -> list[str]:
    return configuration_findings(parse_config(f'[session]\nname = "x"\n{text}', FIXTURES / "a.toml"))


def test_a_sound_configuration_has_no_findings() -> None:
    assert configuration_findings(load_config(AIRCRAFT)) == []
    assert findings(PPS) == []


def test_a_lever_arm_in_millimetres_is_named_with_its_metres() -> None:
    assert configuration_findings(load_config(MILLIMETRES)) == [
        "scanner.left.lever_arm_m: is 306 m long; give metres: if these are millimetres, [0.12, -0.03, 0.28]"
    ]
    receiver = '[gnss.r]\ntransport = "serial:/dev/ttyS0"\nprotocol = "ubx"\nlever_arm_m = [29, 7, 1]\n'
    assert findings(f"{receiver}secondary_lever_arm_m = [31, 0, 0]\n") == [
        "gnss.r.secondary_lever_arm_m: is 31 m long; give metres: if these are millimetres, [0.031, 0, 0]"
    ]


def test_a_baud_rate_of_no_port_and_a_configuration_without_sources_are_named() -> None:
    receiver = '[gnss.r]\ntransport = "serial:/dev/ttyS0?baud={}"\nprotocol = "ubx"\n'
    assert findings(receiver.format(115000)) == [
        "gnss.r.transport: no usual port runs at 115000 baud; did you mean baud=115200?"
    ]
    assert findings(receiver.format(921600)) == []
    assert findings("") == [NO_SOURCE]


def test_a_pps_that_nothing_can_show_is_named() -> None:
    assert findings(PPS + CAN_IMU) == [
        "imu.m.pps: nothing shows that the device sees its PPS: xsens-mti does not send what it latches at a pulse; "
        "remove pps"
    ]
    assert "pps_event is missing" in findings(PPS + CAN_IMU.replace("xsens-mti", "sbg-ellipse"))[0]
    ncom = '[imu.m]\ntransport = "udp:0.0.0.0:3000"\nprotocol = "oxts-ncom"\npps = "p"\n'
    assert "oxts-ncom does not send what it latches at a pulse" in findings(PPS + ncom)[0]
    head = (
        '[scanner.l]\ntransport = "udp:0.0.0.0:2368"\nprotocol = "velodyne-vlp16"\ninstallation_deg = [0, 0, 0]\n'
        'pps = "p"\n'
    )
    assert findings(PPS + head)[0].endswith("no port receives them; set auxiliary")
    assert findings(PPS + head + 'auxiliary = "udp:0.0.0.0:8308"\n') == []


def test_angles_that_nothing_can_state_are_named() -> None:
    head = '[scanner.l]\ntransport = "udp:0.0.0.0:6699"\ninstallation_deg = [0, 0, 0]\nprotocol = "robosense-rs32"\n'
    (line,) = findings(head)
    assert line.startswith(
        "scanner.l.auxiliary: is missing, the port of the DIFOP packets, which alone state the angles"
    )
    assert findings(head + 'auxiliary = "udp:0.0.0.0:7788"\n') == []
    assert findings(head + '[scanner.l.geometry]\nfile = "../robosense/rs32.difop"\n') == []


def test_the_geometry_is_said_in_words() -> None:
    assert place_words(np.array([0.10, -0.05, -1.20])) == "0.10 m forward, 0.05 m left, 1.20 m above the IMU"
    assert place_words(np.array([-0.4, 0.2, 0.0])) == "0.40 m backward, 0.20 m right of the IMU"
    assert place_words(np.array([0.0, 0.004, 0.3])) == "0.30 m below the IMU"
    assert place_words(np.zeros(3)) == "at the IMU"
    lines = geometry_lines(placed_devices(load_config(AIRCRAFT)))
    assert lines == [
        "imu/main: its x forward, y right, z down",
        "antenna of gnss/rover: 0.10 m forward, 0.05 m left, 1.20 m above the IMU",
        "second antenna of gnss/rover: 0.10 m forward, 0.95 m right, 1.20 m above the IMU",
        "scanner/left: 0.12 m forward, 0.03 m left, 0.28 m below the IMU; its x forward, y right, z down",
    ]
    tilted = np.array([[0.75**0.5, 0, 0.5], [0, 1, 0], [-0.5, 0, 0.75**0.5]])  # nose up by 30°
    (line,) = geometry_lines([Placed("scanner/x", np.array([1.0, 0, 0]), tilted)])
    assert line == (
        "scanner/x: 1.00 m forward of the IMU; its x forward and 30.0° towards up, y right, "
        "z down and 30.0° towards forward"
    )


def test_the_drawing_shows_forward_to_the_right_and_up_upwards() -> None:
    antenna = Placed("antenna", np.array([0.3, -0.2, -0.4]))  # forward, left, above
    scanner = Placed("scanner", np.array([-0.2, 0.1, 0.2]))  # backward, right, below
    assert drawing([Placed("imu/m", np.zeros(3)), antenna, scanner]) == [
        "from the right: forward →, up ↑   from above: right →, forward ↑",
        "··········A                       A······",
        "···········                       ·······",
        "···········                       ·······",
        "···········                       ····I··",
        "····I······                       ·······",
        "···········                       ······B",
        "B··········",
        "I IMU, A antenna, B scanner; a column is 0.05 m, a row 0.1 m",
    ]
    assert drawing([Placed("imu/m", np.zeros(3)), Placed("antenna", np.zeros(3))]) == []
    assert drawing([Placed("antenna", np.array([1e300, 0, 0]))]) == []


@pytest.mark.parametrize("as_json", [False, True])
def test_check_offline_prints_geometry_and_findings(as_json: bool) -> None:
    run = swath("check", "--offline", str(MILLIMETRES), *(["--json"] if as_json else []))
    assert run.returncode == 1
    if as_json:
        found = json.loads(run.stdout)
        assert (found["ok"], len(found["findings"]), len(found["geometry"])) == (False, 1, 2)
        return
    assert "antenna of gnss/rover: 0.10 m forward, 0.05 m left, 1.20 m above the IMU\n" in run.stdout
    assert "scanner.left.lever_arm_m: is 306 m long; give metres" in run.stdout
    assert run.stdout.count("from the right: forward →, up ↑") == 1


def test_a_crs_that_does_not_exist_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text(AIRCRAFT.read_text().replace("EPSG:25832", "EPSG:999999"))
    for name in ("imu.dbc", "left.toml"):
        (tmp_path / name).write_bytes((FIXTURES / name).read_bytes())
    run = swath("check", "--offline", str(tmp_path / "a.toml"))
    assert (run.returncode, run.stdout.splitlines()[-1]) == (
        1,
        'output.crs = "EPSG:999999" is unknown to PROJ; write EPSG:CODE, EPSG:CODE+CODE with heights, or WKT',
    )


def test_a_flight_plan_is_measured_and_what_was_assumed_is_named(tmp_path: Path) -> None:
    """One minute of latitude is a nautical mile; the second line's vertices are in one place."""
    lines = [[[8.0, 47.0, 0.0], [8.0, 47.0 + 1 / 60, 0.0]], [[8.0, 47.0], [8.0, 47.0]]]
    text = (FIXTURES / "aircraft.toml").read_text().replace("[plan]", '[plan]\nfile = "plan.geojson"')
    text = text.replace('names = "line"\n', "")
    for name in ("imu.dbc", "left.toml"):
        (tmp_path / name).write_bytes((FIXTURES / name).read_bytes())
    (tmp_path / "swath.toml").write_text(text)
    told = []
    for count in (1, 2):
        shape = {"type": "MultiLineString", "coordinates": lines[:count]}
        (tmp_path / "plan.geojson").write_text(json.dumps(shape))
        done = swath("check", "--offline", "--json", str(tmp_path / "swath.toml"))
        found = json.loads(done.stdout)
        told.append((done.returncode, found.get("plan"), found["findings"]))
    unnamed = "plan.geojson: its lines have no names; they are numbered in the order of the file"
    assert told[0] == (0, ["plan plan.geojson: 1 line, 1.9 km, no area", unnamed], [])
    broken = "plan.file: plan.geojson: line 1 (feature 1): has no two different vertices; remove it or draw it anew"
    assert told[1] == (1, None, [broken])


def test_run_without_sources_says_so_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text('[session]\nname = "x"\ndirectory = "."\nreserve_mb = 1\n')
    run = swath("run", str(tmp_path / "a.toml"), "--seconds", "0.1")
    assert run.returncode == 0
    assert run.stderr.count(f"WARNING  {tmp_path / 'a.toml'}: {NO_SOURCE}\n") == 1
