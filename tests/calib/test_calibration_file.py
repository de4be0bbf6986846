"""Tests that the calibration file that is written is the one that is read."""

from __future__ import annotations

import datetime as dt
import math
import re
import tomllib
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from swath.calib.calibration_file import CalibrationFileError, Header, calibration_text
from swath.georef.scanner.calibration import (
    INDEX,
    PARAMETERS,
    BeamCorrection,
    Calibration,
    CalibrationError,
    RangeOffset,
    read_calibration,
)

CREATED = dt.datetime(2026, 11, 21, 10, 15, tzinfo=dt.UTC)
HEADER = Header("2026-11-21T10:15:00Z-ab12", CREATED, "planes", logs=(("a.mcap", "00ff"),))

REAL = st.floats(-1e3, 1e3, allow_subnormal=False)
TURN = st.floats(-math.tau, math.tau, allow_subnormal=False)  # more than a whole turn is refused
ANGLE = st.floats(-math.pi, math.pi, allow_subnormal=False)
TEXT = st.text(st.characters(exclude_categories=["Cs"]), min_size=1, max_size=20).filter(
    lambda text: text.splitlines() == [text]
)


@st.composite
def calibrations(draw: st.DrawFn) -> Calibration:
    """Draw any calibration: some parameters estimated, correlations of a random factor, every table."""
    count = len(PARAMETERS)
    seed = draw(st.integers(0, 2**32 - 1))
    random = np.random.default_rng(seed)
    estimated = np.array(draw(st.lists(st.booleans(), min_size=count, max_size=count)))
    held = ~estimated & np.array(draw(st.lists(st.booleans(), min_size=count, max_size=count)))
    factor = random.standard_normal((count, count + 3))
    covariance = factor @ factor.T
    correlation = covariance / np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
    correlation = (correlation + correlation.T) / 2.0
    np.fill_diagonal(correlation, 1.0)
    both = np.outer(estimated | held, estimated | held)
    turn, _ = np.linalg.qr(random.standard_normal((3, 3)))
    intensity = np.sort(random.choice(10_000, draw(st.integers(1, 6)), replace=False)).astype(np.float64)
    offsets = st.builds(RangeOffset, REAL, st.integers(1, 7), st.none() | st.integers(0, 9), st.none() | REAL.map(abs))
    return Calibration(
        id="x",
        scanner=draw(TEXT),
        method="nominal",
        parameters=np.array(draw(st.tuples(*(TURN if name.endswith("_rad") else REAL for name in INDEX)))),
        sigmas=np.where(estimated, random.lognormal(-8.0, 3.0, count), 0.0),
        correlation=np.where(both, correlation, np.eye(count)),
        held_sigmas=np.where(held, random.lognormal(-8.0, 3.0, count), 0.0),
        installation_matrix=turn * np.linalg.det(turn),
        mirror_factor=draw(st.none() | REAL),
        ranges=draw(st.sampled_from([None, "corrected", "vacuum"])),
        refraction=draw(st.sampled_from([None, "none", "ardc"])),
        ibrc=draw(st.sampled_from([None, (intensity, random.standard_normal(len(intensity)))])),
        range_offsets=tuple(draw(st.lists(offsets, max_size=3))),
        facet_tilt_rad=draw(st.dictionaries(st.integers(0, 65_535), ANGLE, max_size=3)),
        beams=draw(st.dictionaries(st.integers(0, 200), st.builds(BeamCorrection, ANGLE, ANGLE, REAL), max_size=3)),
    )


def close(read: Any, written: Any) -> None:
    """Assert that numbers agree to one unit of their last binary digit."""
    np.testing.assert_array_max_ulp(np.asarray(read, np.float64), np.asarray(written, np.float64), maxulp=1)


def same(read: Calibration, written: Calibration, *, exactly: bool) -> None:
    """Assert that everything in two files agrees."""
    check = np.testing.assert_array_equal if exactly else close
    for name in ("parameters", "sigmas", "held_sigmas"):
        check(getattr(read, name), getattr(written, name))
    for name in ("correlation", "installation_matrix"):
        np.testing.assert_array_equal(getattr(read, name), getattr(written, name))
    for name in ("scanner", "mirror_factor", "ranges", "refraction", "range_offsets"):
        assert getattr(read, name) == getattr(written, name), name
    assert (read.ibrc is None) == (written.ibrc is None)
    if read.ibrc is not None and written.ibrc is not None:
        np.testing.assert_array_equal(read.ibrc, written.ibrc)
    assert read.facet_tilt_rad.keys() == written.facet_tilt_rad.keys()
    assert read.beams.keys() == written.beams.keys()
    for index, tilt_rad in written.facet_tilt_rad.items():
        check(read.facet_tilt_rad[index], tilt_rad)
    for channel, beam in written.beams.items():
        got = read.beams[channel]
        check([got.azimuth_rad, got.elevation_rad, got.range_m], [beam.azimuth_rad, beam.elevation_rad, beam.range_m])


@pytest.mark.slow
@settings(max_examples=120, deadline=None)
@given(calibrations(), TEXT, TEXT)
def test_a_written_calibration_is_read_back(calibration: Calibration, identity: str, serial: str) -> None:
    header = Header(identity, CREATED, "combined", scanner_serial=serial, logs=((serial, "ab"),))
    text = calibration_text(calibration, header)
    read = read_calibration(text, "test")
    same(read, calibration, exactly=False)
    assert (read.id, read.method, read.header["scanner_serial"]) == (identity, "combined", serial)
    assert read.header["created"] == CREATED
    # A file that was read and written again is unchanged to the last digit.
    again = calibration_text(read, header)
    assert again == text
    same(read_calibration(again, "test"), read, exactly=True)


def test_numbers_written_by_users_keep_their_digits() -> None:
    """By plain division 0.0009° in radians and back would become 0.0008999999999999999."""
    rows = {"omega_deg": "0.2513", "phi_deg": "-0.4021", "kappa_deg": "0.611", "range_offset_m": "0.3502"}
    rows |= {"range_scale_ppm": "12.7", "lever_arm_x_m": "0.12", "lever_arm_y_m": "-0.03", "lever_arm_z_m": "0.28"}
    rows |= {"time_offset_us": "33.1", "torsion_us2": "0.0018", "scan_plane_tilt_deg": "0.0009"}
    rows |= {"scan_angle_scale_ppm": "0.0019", "scan_angle_offset_deg": "-0.0035"}
    text = '[calibration]\nid = "a"\nscanner = "left"\nmethod = "planes"\n[parameters]\n'
    text += "\n".join(f"{key} = {value}" for key, value in rows.items())
    written = calibration_text(read_calibration(text, "given"), HEADER).splitlines()
    assert [line for key, value in rows.items() if (line := f"{key} = {value}") not in written] == []


def test_the_file_follows_the_conventions_page() -> None:
    """Keys and their order are those of the page; held parameters have no sigma; all sixteen parameters are written."""
    sigmas, correlation = np.zeros(16), np.eye(16)
    sigmas[INDEX["omega_rad"]], sigmas[INDEX["range_scale"]] = math.radians(0.001), 2e-6
    correlation[0, INDEX["range_scale"]] = correlation[INDEX["range_scale"], 0] = 0.25
    calibration = Calibration(
        "x",
        "left",
        "nominal",
        np.zeros(16),
        sigmas,
        correlation,
        mirror_factor=1.0,
        ranges="corrected",
        refraction="none",
    )
    header = Header("id", CREATED, "planes", "M", "S", "I", "HB-ABC/left", (("a.mcap", "0f"),), 1.02, 412345.0)
    text = calibration_text(calibration, header)
    assert text == calibration_text(calibration, header)
    document = tomllib.loads(text)
    assert (
        list(document["calibration"])
        == (
            "id scanner created conventions scanner_model scanner_serial imu_serial installation installation_matrix "
            "mirror_factor ranges refraction method logs variance_factor redundancy"
        ).split()
    )
    assert document["calibration"]["logs"] == [{"name": "a.mcap", "sha256": "0f"}]
    assert "redundancy = 412345\n" in text
    assert list(document["parameters"]) == [parameter.key for parameter in PARAMETERS]
    assert document["sigma"] == {"omega_deg": 0.001, "range_scale_ppm": 2.0}
    assert document["correlation"] == {"names": ["omega_deg", "range_scale_ppm"], "matrix": [[1, 0.25], [0.25, 1]]}


def judged() -> tuple[Calibration, Header]:
    """Return a calibration with roll estimated and a correlated scan angle scale held, and a header with a verdict."""
    sigmas, held, correlation = np.zeros(16), np.zeros(16), np.eye(16)
    roll, scale = INDEX["omega_rad"], INDEX["scan_angle_scale"]
    sigmas[roll], held[scale] = math.radians(0.01), 3e-4
    correlation[roll, scale] = correlation[scale, roll] = -0.99
    header = Header("id", CREATED, "planes", verdict="usable with care", trajectory="navigated")
    header = replace(header, verdict_reasons=('κ is "held"', "two"), held=("scan_angle_scale_ppm",))
    return Calibration("x", "left", "nominal", np.zeros(16), sigmas, correlation, held_sigmas=held), header


def test_verdict_and_held_parameters_are_written_to_the_file() -> None:
    calibration, header = judged()
    read = read_calibration(calibration_text(calibration, header), "test")
    assert read.header["verdict"] == "usable with care"
    assert read.header["verdict_reasons"] == ['κ is "held"', "two"]
    assert read.header["held"] == ["scan_angle_scale_ppm"]
    assert read.header["trajectory"] == "navigated"
    covariance, scale = read.covariance(), INDEX["scan_angle_scale"]
    assert covariance[scale, scale] == pytest.approx(9e-8)
    assert covariance[0, scale] == pytest.approx(-0.99 * math.radians(0.01) * 3e-4)
    assert (read.sigmas[scale], read.held_sigmas[0]) == (0.0, 0.0)


@pytest.mark.parametrize(
    ("said", "instead", "message"),
    [
        ("omega_deg = 0.01", "omega_deg = 0.01\nscan_angle_scale_ppm = 1.0", "is also in [sigma]"),
        ("scan_angle_scale_ppm = 300.0", "scan_angle_scale_ppm = -1.0", "held_sigma.scan_angle_scale_ppm: got -1"),
        ("scan_angle_scale_ppm = 300.0", "twist_deg = 1.0", "held_sigma.twist_deg: not a parameter of the model"),
        ('"usable with care"', '"fine"', "calibration.verdict: got 'fine', want one of good, usable with care"),
    ],
)
def test_a_file_that_contradicts_itself_is_refused(said: str, instead: str, message: str) -> None:
    text = calibration_text(*judged())
    assert said in text
    with pytest.raises(CalibrationError, match=re.escape(message)):
        read_calibration(text.replace(said, instead), "test")


def test_table_rows_keep_their_matching_keys() -> None:
    """Each row keeps the keys that it matches on, and no others."""
    offsets = (RangeOffset(0.012, return_slot=2), RangeOffset(-0.03, mta_zone=0, prf_hz=400_000.0))
    calibration = Calibration("x", "left", "planes", np.zeros(16), range_offsets=offsets)
    document = tomllib.loads(calibration_text(calibration, HEADER))
    assert document["range_offset"] == [
        {"return_slot": 2, "offset_m": 0.012},
        {"mta_zone": 0, "prf_hz": 400_000, "offset_m": -0.03},
    ]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"parameters": np.full(16, np.nan)}, "nan"),
        ({"sigmas": np.full(16, np.inf)}, "inf"),
        ({"sigmas": np.full(16, -1.0)}, "sigma.omega_deg"),
        ({"installation_matrix": np.diag([1.0, 1.0, -1.0])}, "installation_matrix"),
        ({"correlation": np.full((16, 16), np.nan), "sigmas": np.ones(16)}, "nan"),
        ({"range_offsets": (RangeOffset(0.1),)}, "matches every return"),
        ({"scanner": ""}, "calibration.scanner"),
    ],
)
def test_invalid_calibrations_are_not_written(change: dict[str, Any], message: str) -> None:
    given = {"id": "x", "scanner": "left", "method": "planes", "parameters": np.zeros(16)} | change
    with pytest.raises(CalibrationFileError, match=message) as caught:
        calibration_text(Calibration(**given), HEADER)
    assert "\n" not in str(caught.value)


def test_a_time_needs_a_time_zone() -> None:
    calibration = Calibration("x", "left", "planes", np.zeros(16))
    with pytest.raises(CalibrationFileError, match="time zone"):
        calibration_text(calibration, Header("id", dt.datetime(2026, 1, 1, tzinfo=dt.UTC).replace(tzinfo=None)))
    zone = dt.timezone(dt.timedelta(hours=2))
    text = calibration_text(calibration, Header("id", dt.datetime(2026, 1, 1, 1, 30, tzinfo=zone)))
    assert "created = 2025-12-31T23:30:00Z\n" in text
