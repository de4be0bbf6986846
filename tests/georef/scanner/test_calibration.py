"""Tests the calibration file: the conventions page in SI units, and every mistake in one line."""

from __future__ import annotations

import math
import tomllib
from pathlib import Path

import numpy as np
import pytest

from swath.georef.scanner.calibration import (
    INDEX,
    PARAMETERS,
    BeamCorrection,
    CalibrationError,
    RangeOffset,
    nominal,
    read_calibration,
)
from swath.sim.plan.plan import parse_plan
from swath.sim.scanners.calibration_files import calibration_text

WHOLE = """
[calibration]
id = "2026-11-21T10:15:00Z-ab12"
scanner = "left"
created = 2026-11-21T10:15:00Z
conventions = 1
scanner_model = ""
installation_matrix = [[-1, 0, 0], [0, -1, 0], [0, 0, 1]]
mirror_factor = 2.0
ranges = "vacuum"
refraction = "ardc"
method = "planes"
logs = [{ name = "a.mcap", sha256 = "00" }]
variance_factor = 1.02
redundancy = 412345

[parameters]
omega_deg = 0.25
phi_deg = -0.5
kappa_deg = 0.75
range_offset_m = 0.35
range_scale_ppm = 40.0
scan_angle_offset_deg = 0.125
scan_angle_scale_ppm = 300.0
scan_plane_tilt_deg = 0.0625
lever_arm_x_m = 0.12
lever_arm_y_m = -0.03
lever_arm_z_m = 0.28
time_offset_us = 150.0
imu_latency_us = -20.0
encoder_latency_us = 1.5
torsion_us2 = 2000.0
pitch_slope_ppm = 200.0

[sigma]
omega_deg = 0.001
range_offset_m = 0.01
time_offset_us = 2.0

[correlation]
names = ["time_offset_us", "omega_deg"]
matrix = [[1, -0.5], [-0.5, 1]]

[ibrc]
intensity = [0, 100, 200]
correction_m = [0.02, 0.0, -0.01]

[[range_offset]]
return_slot = 1
offset_m = 0.012

[[range_offset]]
mta_zone = 2
prf_hz = 100_000
offset_m = -0.02

[[facet]]
index = 1
tilt_deg = 0.03

[[beam]]
channel = 3
azimuth_deg = 0.5
range_m = 0.04
"""
SHORTEST = """
[calibration]
id = "x"
scanner = "left"
method = "nominal"
[parameters]
omega_deg = 0
phi_deg = 0
kappa_deg = 0
range_offset_m = 0
lever_arm_x_m = 1
lever_arm_y_m = 0
lever_arm_z_m = 0
"""


def test_every_parameter_is_converted_to_si_units() -> None:
    calibration = read_calibration(WHOLE, "left.toml")
    degree = math.pi / 180
    want = [0.25 * degree, -0.5 * degree, 0.75 * degree, 0.35, 4e-5, 0.125 * degree, 3e-4, 0.0625 * degree]
    want += [0.12, -0.03, 0.28, 1.5e-4, -2e-5, 1.5e-6, 2e-9, 2e-4]
    assert calibration.parameters == pytest.approx(want, rel=1e-14)
    said = tomllib.loads(WHOLE)["parameters"]
    assert [parameter.key for parameter in PARAMETERS] == list(said)
    for parameter in PARAMETERS:
        assert calibration.value(parameter.name) == said[parameter.key] * parameter.factor
    assert calibration.lever_arm_b.tolist() == [0.12, -0.03, 0.28]


def test_header_and_tables_are_read() -> None:
    calibration = read_calibration(WHOLE, "left.toml")
    assert (calibration.id, calibration.scanner, calibration.method) == ("2026-11-21T10:15:00Z-ab12", "left", "planes")
    assert (calibration.ranges, calibration.refraction, calibration.mirror_factor) == ("vacuum", "ardc", 2.0)
    assert calibration.installation_matrix.tolist() == [[-1, 0, 0], [0, -1, 0], [0, 0, 1]]
    assert calibration.header["redundancy"] == 412345
    assert calibration.ibrc is not None
    assert [column.tolist() for column in calibration.ibrc] == [[0, 100, 200], [0.02, 0.0, -0.01]]
    assert calibration.range_offsets == (
        RangeOffset(0.012, return_slot=1),
        RangeOffset(-0.02, mta_zone=2, prf_hz=100_000.0),
    )
    assert calibration.facet_tilt_rad == {1: math.radians(0.03)}
    assert calibration.beams == {3: BeamCorrection(azimuth_rad=math.radians(0.5), range_m=0.04)}


def test_covariance_is_read() -> None:
    covariance = read_calibration(WHOLE, "left.toml").covariance()
    omega, offset, time = (INDEX[name] for name in ("omega_rad", "range_offset_m", "time_offset_s"))
    sigma_omega, sigma_time = math.radians(0.001), 2e-6
    assert covariance[omega, omega] == pytest.approx(sigma_omega**2, rel=1e-12)
    assert covariance[offset, offset] == pytest.approx(1e-4, rel=1e-12)
    assert covariance[omega, time] == covariance[time, omega] == pytest.approx(-0.5 * sigma_omega * sigma_time)
    assert np.count_nonzero(covariance) == 5  # held parameters have none


def test_the_shortest_valid_file_is_read() -> None:
    calibration = read_calibration(SHORTEST, "left.toml")
    assert calibration.parameters.tolist() == nominal("left", [1, 0, 0], np.eye(3)).parameters.tolist()
    assert not calibration.covariance().any()
    assert (calibration.ranges, calibration.mirror_factor, calibration.ibrc) == (None, None, None)
    assert calibration.range_offsets == ()


def test_files_of_the_simulator_match_their_plan(tmp_path: Path) -> None:
    plan = parse_plan(
        '[flight]\nname = "x"\n[[line]]\nname = "1"\nfrom_m = [0, 0]\nto_m = [500, 0]\nheight_m = 900\n'
        '[scanner.left]\nkind = "polygon"\n[scanner.left.true]\nomega_deg = 0.3\ntorsion_us2 = 50.0\n'
        "[[scanner.left.facet]]\nindex = 2\ntilt_deg = 0.1\n",
        tmp_path,
    )
    calibration = read_calibration(calibration_text(plan, "left", true=True), "left.true.toml")
    assert calibration.value("omega_rad") == math.radians(0.3)
    assert calibration.value("torsion_s2") == pytest.approx(5e-11)
    assert calibration.facet_tilt_rad == {2: math.radians(0.1)}


def test_changing_a_calibration_leaves_the_original_unchanged() -> None:
    old = nominal("left", [0, 0, 0], np.eye(3))
    assert old.changed(phi_rad=0.1).value("phi_rad") == 0.1
    assert old.value("phi_rad") == 0.0


@pytest.mark.parametrize(
    ("old", "new", "wrong"),
    [
        ('id = "x"', "", "calibration.id: missing; give text in quotes"),
        ('scanner = "left"', "scanner = 3", "calibration.scanner: not text; give text in quotes"),
        ('"nominal"', '"guess"', "calibration.method: got 'guess', want one of nominal, planes"),
        ('method = "nominal"', 'method = "nominal"\nranges = "wet"', "calibration.ranges: got 'wet', want one of corr"),
        ("omega_deg = 0", "", "parameters.omega_deg: missing, want a number"),
        ("omega_deg = 0", "omega_deg = true", "parameters.omega_deg: got True, want a number"),
        ("omega_deg = 0", "omega_deg = nan", "parameters.omega_deg: got nan, want a number"),
        ("omega_deg = 0", "omega_deg = 400", "parameters.omega_deg: 400° is more than a whole turn; give -360 to 360"),
        ("omega_deg = 0", "omega_deg = 0\nomega_rad = 0", "parameters.omega_rad: not a parameter of the model"),
        (
            "[parameters]",
            "installation_matrix = [[1, 0, 0]]\n[parameters]",
            "calibration.installation_matrix: not a rot",
        ),
        (
            "[parameters]",
            "installation_matrix = [[1, 0, 0], [0, 1, 0], [0, 0, -1]]\n[parameters]",
            "calibration.installation_matrix: not a rotation; give 3 × 3 numbers",
        ),
        ("[parameters]", "mirror_factor = 'two'\n[parameters]", "calibration.mirror_factor: got 'two', want a number"),
    ],
)
def test_wrong_headers_and_parameters_are_refused(old: str, new: str, wrong: str) -> None:
    assert old in SHORTEST
    with pytest.raises(CalibrationError) as caught:
        read_calibration(SHORTEST.replace(old, new, 1), "left.toml")
    (line,) = str(caught.value).splitlines()
    assert line.startswith(f"left.toml: {wrong}")


@pytest.mark.parametrize(
    ("added", "wrong"),
    [
        ("[sigma]\nomega_deg = -1", "sigma.omega_deg: got -1, want at least 0"),
        ("sigma = 3", "sigma: not a table; add [sigma]"),
        (
            "[correlation]\nnames = ['omega_deg']\nmatrix = [[1]]",
            "correlation.names: must be a list of keys of [sigma]",
        ),
        (
            "[sigma]\nomega_deg = 1\nphi_deg = 1\n[correlation]\nnames = ['omega_deg', 'phi_deg']\n"
            "matrix = [[1, 0.5], [0.4, 1]]",
            "correlation.matrix: must be 2 × 2 numbers: symmetric",
        ),
        (
            "[sigma]\nomega_deg = 1\nphi_deg = 1\n[correlation]\nnames = ['omega_deg', 'phi_deg']\n"
            "matrix = [[1, 1.5], [1.5, 1]]",
            "correlation.matrix: must be 2 × 2 numbers: symmetric",
        ),
        ("[ibrc]\nintensity = [1, 2]\ncorrection_m = [1]", "ibrc: needs intensity and correction_m"),
        ("[ibrc]\nintensity = [1, 1]\ncorrection_m = [1, 2]", "ibrc.intensity: values must increase"),
        ("[[range_offset]]\noffset_m = 1", "range_offset[0]: matches every return; give return_slot"),
        ("[[range_offset]]\nreturn_slot = 1", "range_offset[0].offset_m: missing, want a number"),
        ("[[range_offset]]\nmta_zone = -1\noffset_m = 1", "range_offset[0].mta_zone: got -1, want a whole number"),
        ("[[facet]]\ntilt_deg = 1", "facet[0].index: missing, want a whole number"),
        ("[[facet]]\nindex = 1\ntilt_deg = 1\n[[facet]]\nindex = 1\ntilt_deg = 2", "facet[1].index: facet 1 is given"),
        ("[[beam]]\nchannel = 1\n[[beam]]\nchannel = 1", "beam[1].channel: beam 1 is given twice; give it once"),
        ("[beam]\nchannel = 1", "beam: must be tables [[beam]]"),
        ("[[range_offsets]]\nreturn_slot = 1\noffset_m = 1", "range_offsets: is unknown; use calibration, param"),
        (
            "[ibrcs]\nintensity = [1]",
            "ibrcs: is unknown; use calibration, parameters, sigma, held_sigma, correlation, ibrc",
        ),
        ("[[beam]]\nchannel = 1\nazimuth_rad = 0.1", "beam[0].azimuth_rad: is unknown; use channel, azimuth_deg"),
        ("[[range_offset]]\nreturn_slot = 0\noffset_m = 1", "range_offset[0].return_slot: got 0, want a whole"),
        ("[[beam]]\nchannel = 70000", "beam[0].channel: got 70000, want a whole number from 0 to 65535"),
        ("[correlation]\nnames = [['a']]\nmatrix = [[1]]", "correlation.names: must be a list of keys of [sigma]"),
    ],
)
def test_wrong_tables_are_refused(added: str, wrong: str) -> None:
    text = f"{added}\n{SHORTEST}" if added.startswith("sigma =") else f"{SHORTEST}\n{added}\n"
    with pytest.raises(CalibrationError) as caught:
        read_calibration(text, "left.toml")
    (line,) = str(caught.value).splitlines()
    assert line.startswith(f"left.toml: {wrong}")


def test_each_mistake_is_reported_in_one_line() -> None:
    text = SHORTEST.replace("phi_deg = 0", "").replace("kappa_deg = 0", "kappa_deg = 'x'")
    with pytest.raises(CalibrationError) as caught:
        read_calibration(text, "left.toml")
    assert [line.split(":")[1].strip() for line in str(caught.value).splitlines()] == [
        "parameters.phi_deg",
        "parameters.kappa_deg",
    ]


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        ("[calibration", "left.toml: not TOML: "),
        ("", "left.toml: calibration: missing; add [calibration]\nleft.toml: parameters: missing; add [parameters]"),
    ],
)
def test_a_file_that_is_not_a_calibration_is_refused(text: str, wrong: str) -> None:
    with pytest.raises(CalibrationError) as caught:
        read_calibration(text, "left.toml")
    assert str(caught.value).startswith(wrong)
