"""Tests sensors that are rotated, swapped or mirrored: each of 48 ways is found, with the right remedy."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from itertools import permutations, product

import numpy as np
import pytest

from swath.georef.arrays import FloatArray, StructArray
from swath.georef.navigation.diagnosis.diagnose import diagnose
from swath.georef.navigation.inputs import GRADES, Inertial, Setup, sort_observations
from tests.georef.navigation.flights import Fixes, fly, noised, setup_for, survey
from tests.georef.navigation.vehicles import car, uav

pytestmark = pytest.mark.xdist_group("kernels")

ARM_B = np.array([0.3, -0.1, -1.1])
SENSORS = ("gyro", "accel", "both")


def ways() -> list[FloatArray]:
    """Return the 24 rotations and 24 mirrored rotations by right angles, (3, 3) each."""
    found = []
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[np.arange(3), order] = signs
            found.append(matrix)
    return found


@cache
def flight() -> tuple[Inertial, StructArray, Setup]:
    """Return a flight of 20 s lines with turns between them, at 50 Hz, with fixes of 1 cm and 3 cm/s at 1 Hz."""
    noise = GRADES["tactical"]
    inertial, rows = noised(fly(survey(60.0, 20.0), 100.0, 50.0), noise, Fixes(velocity_mps=0.03), ARM_B, seed=3)
    return inertial, sort_observations(rows), setup_for(noise, ARM_B)


def mounted(sensor: str, matrix: FloatArray, unit: float = 1.0) -> tuple[Inertial, StructArray, Setup]:
    """Return the flight with the axes of one triad, or of both, exchanged by a matrix; `unit` scales the gyroscopes."""
    inertial, rows, setup = flight()
    gyro = matrix if sensor != "accel" else np.eye(3)
    accel = matrix if sensor != "gyro" else np.eye(3)
    angle_b, velocity_b = unit * inertial.angle_b @ gyro.T, inertial.velocity_b @ accel.T
    return replace(inertial, angle_b=angle_b, velocity_b=velocity_b), rows, setup


def remedy(text: str) -> FloatArray:
    """Return the matrix (3, 3) that a finding recommends: rows of rotation_b_imu, or the signals for body x, y, z."""
    said = re.search(r"by (\[\[.*\]\])", text)
    if said is not None:
        return np.array([[float(value) for value in row.split(",")] for row in re.findall(r"\[([^\[\]]+)\]", said[1])])
    taken = re.search(r"read as \(([^)]*)\)", text)
    assert taken is not None, text
    matrix = np.zeros((3, 3))
    for row, axis in enumerate(taken[1].split(", ")):
        matrix[row, "xyz".index(axis[1])] = 1.0 if axis[0] == "+" else -1.0
    return matrix


def check(sensor: str, matrix: FloatArray) -> None:
    """Check that the only finding's remedy undoes the exchange of axes."""
    found = diagnose(*mounted(sensor, matrix))
    if np.array_equal(matrix, np.eye(3)):
        assert found == []
        return
    (finding,) = found
    turned = "axes" if np.linalg.det(matrix) > 0.0 else "axes_mirrored"
    assert finding.code == {"gyro": "gyro_axes", "accel": "accel_axes", "both": turned}[sensor], finding.text
    assert finding.severity == "error"
    assert np.array_equal(remedy(finding.text) @ matrix, np.eye(3)), finding.text


@pytest.mark.parametrize(
    ("sensor", "number"), [("gyro", 13), ("accel", 2), ("both", 0), ("both", 7), ("both", 30), ("gyro", 46)]
)
def test_common_wrong_axis_assignments_are_found(sensor: str, number: int) -> None:
    check(sensor, ways()[number])


@pytest.mark.slow
@pytest.mark.parametrize("number", range(48))
@pytest.mark.parametrize("sensor", SENSORS)
def test_each_of_the_48_axis_assignments_is_found(sensor: str, number: int) -> None:
    check(sensor, ways()[number])


def test_degrees_given_as_radians_are_found_by_the_gain() -> None:
    (finding,) = diagnose(*mounted("gyro", np.eye(3), unit=180.0 / np.pi))
    assert finding.code == "gyro_unit"
    assert "degrees are read as radians" in finding.text


@pytest.mark.parametrize("unit", [0.6, 1.7, 20.0])
def test_a_gain_that_fits_no_unit_is_not_reported_as_a_wrong_unit(unit: float) -> None:
    """Only a gain that equals the ratio of two units is reported as a wrong unit."""
    assert all("unit: " not in finding.text for finding in diagnose(*mounted("gyro", np.eye(3), unit=unit)))


@pytest.mark.slow
@pytest.mark.parametrize("recording", [car, uav], ids=["car", "uav"])
def test_real_recordings_with_rotated_axes_give_no_time_offset_and_no_unit(recording: object) -> None:
    """The recordings are cut into two-minute pieces; only the axes may be reported, never a time offset or a unit."""
    assert callable(recording)
    whole = recording()
    begin, end = (float(edge) for edge in (whole.inertial.time_ns[[0, -1]] - 2300 * 604_800 * 10**9) / 1e9)
    for first in np.arange(begin, end - 120.0, 120.0):
        part = whole.cut(float(first), float(first) + 120.0)
        for matrix in (np.eye(3), np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])):
            turned = replace(
                part.inertial,
                angle_b=part.inertial.angle_b @ matrix.T,
                velocity_b=part.inertial.velocity_b @ matrix.T,
            )
            codes = {finding.code for finding in diagnose(turned, part.rows, part.setup)}
            assert not codes & {"time_offset", "time_unclear", "gyro_unit"}, (first, codes)
