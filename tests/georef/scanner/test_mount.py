"""Tests gimbals: stages nested as in NGA Eq. 3, fixed and moving."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from swath.georef.points import Fate
from swath.georef.records import INS_DTYPE
from swath.georef.scanner.beams import LineGeometry, OusterGeometry
from swath.georef.scanner.calibration import nominal
from swath.georef.scanner.mount import AngleSeries, Mount, MountError, Stage
from swath.georef.scanner.sensor_model import SensorModel
from tests.georef.scanner_cases import TURNED, rows_of, still_trajectory

pytestmark = pytest.mark.xdist_group("kernels")

MS = 1_000_000
ERRORS = {"omega_rad": 0.02, "phi_rad": -0.03, "kappa_rad": 0.05, "pitch_slope": 1e-3, "scan_plane_tilt_rad": 0.01}


def turned(angles_rad: np.ndarray) -> Rotation:
    """Return roll, pitch and yaw as an attitude."""
    return Rotation.from_euler("ZYX", np.asarray(angles_rad)[..., ::-1])


def test_rigid_mount_matches_its_matrix() -> None:
    rotation, shift, known = Mount().poses(np.arange(5))
    assert (rotation.shape, shift.shape, known.tolist()) == ((1, 3, 3), (1, 3), [1])
    assert np.array_equal(rotation[0], np.eye(3))
    assert not shift.any()


def test_two_stages_are_applied_outermost_first() -> None:
    outer, inner = np.array([0.3, -0.2, 1.0]), np.array([-0.1, 0.4, 0.2])
    first, second = np.array([1.0, 0.2, -0.3]), np.array([0.1, -0.5, 0.4])
    mount = Mount((Stage(outer, first), Stage(inner, second)))
    rotation, shift, _ = mount.poses(np.arange(3))
    point = np.array([5.0, -7.0, 11.0])
    want = turned(outer).apply(first + turned(inner).apply(second + point))
    assert rotation[0] @ point + shift[0] == pytest.approx(want, abs=1e-14)


def test_chain_of_a_moving_gimbal_uses_the_angles_of_each_pulse() -> None:
    """The boresight is outermost, then the installation, then the head's own frame; each pulse has its own angles."""
    rng = np.random.default_rng(4)
    series = AngleSeries(np.array([0, 40, 80]) * MS, np.array([[0.0, 0.1, 3.1], [0.2, -0.1, -3.1], [0.1, 0.0, -3.0]]))
    zero = np.array([0.01, -0.02, 0.03])
    first, second = np.array([0.4, 0.1, 0.3]), np.array([0.0, 0.05, 0.2])
    mount = Mount((Stage(zero, first, series), Stage(np.array([0.1, 0.0, 0.5]), second)))
    assert mount.moves
    calibration = replace(nominal("left", [0.1, 0.2, 0.3], TURNED).changed(**ERRORS, time_offset_s=2e-3))
    theta, time_ns = rng.uniform(-0.8, 0.8, 30), rng.integers(0, 78, 30) * MS
    rows = rows_of(theta, 500.0)
    rays = SensorModel(calibration, LineGeometry(), mount=mount).rays(rows, time_ns, still_trajectory(), with_axes=True)
    assert not rays.fate.any()
    epochs = np.array([0.0, 40.0, 80.0])
    said = np.array([[0.0, 0.1, 3.1], [0.2, -0.1, 2 * np.pi - 3.1], [0.1, 0.0, 2 * np.pi - 3.0]])
    angles = np.stack([np.interp(time_ns / MS + 2.0, epochs, column) for column in said.T], axis=1) + zero
    beam = np.stack([np.full(30, -math.sin(0.01)), np.sin(theta) * math.cos(0.01), np.cos(theta) * math.cos(0.01)], 1)
    inner = turned(np.array([0.1, 0.0, 0.5])).apply(second + 500.0 * beam @ TURNED.T)
    gimbal = turned(angles).apply(first + inner)
    boresight = Rotation.from_euler(
        "XYZ", np.stack([np.full(30, 0.02), -0.03 + 1e-3 * theta, np.full(30, 0.05)], axis=1)
    )
    want = calibration.lever_arm_b + boresight.apply(gimbal)
    assert np.abs(rays.points_e - want).max() < 1e-10
    assert rays.arm_b is not None
    assert np.abs(rays.arm_b - want).max() < 1e-10


def test_a_head_with_its_own_axes_works_inside_a_gimbal() -> None:
    lidar = np.eye(4)
    lidar[:3, :3], lidar[:3, 3] = np.diag([-1.0, -1.0, 1.0]), (0.0, 0.0, 0.5)
    head = OusterGeometry(np.zeros(1), np.zeros(1), (0.0, 0.0), lidar)
    sideways = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    mount = Mount((Stage(np.array([0.0, 0.0, np.pi / 2]), np.array([0.0, 0.0, 1.0])),))
    model = SensorModel(nominal("nose", [0.0, 0.0, 0.0], sideways), head, mount=mount)
    point = model.rays(rows_of(0.0, 10.0), np.array([5]), still_trajectory()).points_e[0]
    # lidar (10, 0, 0) → head (−10, 0, 0.5) → mount (0.5, −10, 0) + (0, 0, 1) → a quarter turn to the right
    assert point == pytest.approx([10.0, 0.5, 1.0], abs=1e-12)


def test_pulses_without_gimbal_angles_give_no_point() -> None:
    series = AngleSeries(np.array([10, 20, 100, 110]) * MS, np.zeros((4, 3)), max_gap_ns=20 * MS)
    model = SensorModel(nominal("left", [0, 0, 0], np.eye(3)), LineGeometry(), mount=Mount((Stage(series=series),)))
    time_ns = np.array([9, 10, 15, 50, 105, 110, 111]) * MS
    fates = model.rays(rows_of(np.zeros(7), 100.0), time_ns, still_trajectory()).fate
    assert (fates == Fate.GEOREFERENCED).tolist() == [False, True, True, False, True, True, False]
    assert set(fates[[0, 3, 6]].tolist()) == {Fate.OUTSIDE_TRAJECTORY}


def test_impossible_angle_series_are_refused() -> None:
    with pytest.raises(MountError, match="gimbal angles: at least two epochs of roll, pitch and yaw are needed"):
        AngleSeries(np.array([1]), np.zeros((1, 3)))
    with pytest.raises(MountError, match="gimbal angles: time does not increase"):
        AngleSeries(np.array([1, 1]), np.zeros((2, 3)))


def test_angles_reported_by_a_device_are_those_of_the_stage() -> None:
    """Angles that are repeated, late, or without heading or time are dropped."""
    rows = np.zeros(7, INS_DTYPE)
    rows["gps_ns"] = np.array([10, 20, 20, 15, 30, -1, 40]) * MS
    rows["gps_ns"][5] = -1
    rows["roll_rad"], rows["pitch_rad"] = np.arange(7) * 0.1, np.arange(7) * -0.01
    rows["heading_rad"] = 6.2
    rows["heading_rad"][4], rows["heading_rad"][6] = np.nan, 0.1
    series = AngleSeries.of_solutions(rows, 25 * MS)
    assert series.time_ns.tolist() == [10 * MS, 20 * MS, 40 * MS]
    assert series.angles_rad[:, 0].tolist() == pytest.approx([0.0, 0.1, 0.6])
    angles, known = series.at(np.array([5, 15, 30, 41]) * MS)
    assert known.tolist() == [False, True, True, False]
    assert angles[1:3, 1] == pytest.approx([-0.005, -0.035])
    assert angles[2, 2] == pytest.approx(0.5 * (6.2 + 0.1 + 2 * math.pi))
    with pytest.raises(MountError, match="at least two epochs"):
        AngleSeries.of_solutions(rows[:1])


def test_angles_of_two_recordings_cover_the_time_of_both() -> None:
    """The order of the recordings does not matter, and no angles are known between them."""
    early = AngleSeries(np.array([0, 10]) * MS, np.full((2, 3), 0.1), max_gap_ns=20 * MS)
    late = AngleSeries(np.array([100, 110]) * MS, np.full((2, 3), 0.2), max_gap_ns=20 * MS)
    still = Stage(angles_rad=np.array([0.0, 0.0, 0.5]))
    for first, second in ((early, late), (late, early)):
        mount = Mount((Stage(series=first), still)).joined(Mount((Stage(series=second), still)))
        rotations, _, known = mount.poses(np.array([5, 50, 105]) * MS)
        assert known.tolist() == [1, 0, 1]
        for rotation, series in ((rotations[0], early), (rotations[2], late)):
            alone, _, _ = Mount((Stage(series=series), still)).poses(series.time_ns[:1])
            np.testing.assert_array_equal(rotation, alone[0])
