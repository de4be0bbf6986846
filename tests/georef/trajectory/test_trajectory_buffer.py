"""Tests the growing trajectory against the complete one, with rows late, twice and without a solution."""

from __future__ import annotations

import numpy as np
import pytest

from swath.georef.arrays import StructArray
from swath.georef.records import INS_DTYPE
from swath.georef.trajectory.buffer import TrajectoryBuffer
from swath.georef.trajectory.trajectory import Trajectory

pytestmark = pytest.mark.xdist_group("kernels")

START_NS = 2445 * 604_800_000_000_000
STEP_NS = 10_000_000
COLUMNS = ("time_ns", "position_e", "q_e_from_b", "velocity_e", "position_sigma_l", "attitude_sigma_rad", "rotvec_b")


def solutions(n: int, first: int = 0) -> StructArray:
    """Return n rows of a climbing turn at 100 Hz, without sigmas, with the status of a good NovAtel solution."""
    at = first + np.arange(n)
    rows = np.zeros(n, INS_DTYPE)
    rows["gps_ns"] = START_NS + STEP_NS * at
    rows["lat_rad"], rows["lon_rad"], rows["height_m"] = 0.8 + 1e-7 * np.sin(at / 50), 0.1 + 1e-7 * at, 900 + 0.03 * at
    rows["velocity_l"] = np.stack([np.cos(at / 50), np.sin(at / 50), np.full(n, -3.0)], axis=1)
    rows["roll_rad"], rows["pitch_rad"], rows["heading_rad"] = 0.4, 0.03, (at / 50) % (2 * np.pi)
    for column in ("position_sigma_l", "velocity_sigma_l", "attitude_sigma_rad"):
        rows[column] = np.nan
    rows["status"] = 3
    return rows


def with_sigmas(rows: StructArray, position_m: float) -> StructArray:
    said = rows.copy()
    said["position_sigma_l"], said["attitude_sigma_rad"] = position_m, position_m / 1000
    return said


def filled(*batches: StructArray, protocol: str = "novatel") -> TrajectoryBuffer:
    buffer = TrajectoryBuffer(protocol)
    for rows in batches:
        buffer.append(rows)
    return buffer


def same(one: Trajectory, other: Trajectory) -> None:
    for column in COLUMNS:
        np.testing.assert_array_equal(getattr(one, column), getattr(other, column), err_msg=column)


def test_the_buffer_equals_the_trajectory_of_all_rows() -> None:
    rows = solutions(9000)
    snapshot = filled(rows).snapshot()
    expected = Trajectory.from_geodetic(
        rows["gps_ns"],
        rows["lat_rad"],
        rows["lon_rad"],
        rows["height_m"],
        rows["velocity_l"],
        rows["roll_rad"],
        rows["pitch_rad"],
        rows["heading_rad"],
    )
    same(snapshot, expected)


def test_the_buffer_does_not_depend_on_how_rows_are_cut() -> None:
    rows = np.concatenate([solutions(4000), with_sigmas(solutions(1, 3999), 0.02), solutions(5000, 4000)])
    rows = np.concatenate([rows[:100], with_sigmas(rows[99:100], 0.01), rows[100:]])
    cuts = np.sort(np.random.default_rng(2).integers(0, len(rows), 700))
    in_pieces, at_once = filled(*np.split(rows, cuts)), filled(rows)
    same(in_pieces.snapshot(), at_once.snapshot())
    assert (
        in_pieces.counts
        == at_once.counts
        == {"taken": 9000, "sigmas": 2, "repeated": 0, "out_of_order": 0}
        | {
            "no_solution": 0,
            "not_finite": 0,
        }
    )


def test_late_and_repeated_rows_are_counted_and_dropped() -> None:
    rows = solutions(100)
    disturbed = np.concatenate([rows[:50], rows[30:40], rows[49:50], rows[49:]])
    buffer = filled(disturbed)
    same(buffer.snapshot(), filled(rows).snapshot())
    counts = {"taken": 100, "out_of_order": 10, "repeated": 2, "sigmas": 0, "no_solution": 0, "not_finite": 0}
    assert buffer.counts == counts


@pytest.mark.parametrize(
    ("protocol", "bad", "taken"),
    [("novatel", 1, 90), ("novatel", 2, 100), ("sbf", 5 << 16, 90), ("sbf", 0x0FFF, 100), ("", 1, 100)],
)
def test_rows_without_a_solution_are_refused_by_their_status(protocol: str, bad: int, taken: int) -> None:
    rows = solutions(100)
    rows["status"] = 3  # GOOD, and for INSNavGeod some info without an error
    rows["status"][40:50] = bad
    buffer = filled(rows, protocol=protocol)
    assert len(buffer.snapshot()) == buffer.counts["taken"] == taken
    assert buffer.counts["no_solution"] == 100 - taken


def test_rows_without_position_or_attitude_are_refused() -> None:
    rows = solutions(10)
    rows["lat_rad"][3] = np.nan  # INSATT
    rows["heading_rad"][7] = np.nan
    rows["velocity_l"][8] = np.nan  # may be absent
    buffer = filled(rows)
    assert buffer.counts["not_finite"] == 2
    assert len(buffer.snapshot()) == 8


def test_sigmas_given_once_a_second_are_held() -> None:
    """INSPVAS at 100 Hz has no sigmas; INSPVAX of the same epoch has them once a second."""
    buffer = filled(solutions(100), with_sigmas(solutions(1, 99), 0.02), solutions(100, 100))
    buffer.append(with_sigmas(solutions(1, 199), 0.05))
    buffer.append(solutions(400, 200))
    sigma = buffer.snapshot().position_sigma_l[:, 0]
    assert np.isnan(sigma[:99]).all()
    np.testing.assert_allclose(sigma[99:199], 0.02, rtol=1e-6)
    np.testing.assert_allclose(sigma[199:450], 0.05, rtol=1e-6)
    assert np.isnan(sigma[450:]).all()  # 2.5 s after the last one
    np.testing.assert_allclose(buffer.snapshot().attitude_sigma_rad[99:199], 0.02e-3, rtol=1e-6)
    assert buffer.counts["sigmas"] == 2


def test_sigmas_given_with_an_epoch_are_kept() -> None:
    buffer = filled(with_sigmas(solutions(10), 0.02), with_sigmas(solutions(1, 9), 0.05))
    np.testing.assert_allclose(buffer.snapshot().position_sigma_l, 0.02, rtol=1e-6)
    assert buffer.counts["repeated"] == 1


def test_the_buffer_covers_time_up_to_the_newest_epoch() -> None:
    buffer = filled()
    assert buffer.covered_until_ns is None
    assert len(buffer.snapshot()) == 0
    buffer.append(solutions(5))
    assert buffer.covered_until_ns == START_NS + 4 * STEP_NS


def test_a_snapshot_does_not_change() -> None:
    buffer = filled(solutions(4000))
    before = buffer.snapshot()
    kept = {column: getattr(before, column).copy() for column in COLUMNS}
    buffer.append(with_sigmas(solutions(1, 3999), 0.02))
    buffer.forget_before(START_NS + 3000 * STEP_NS)
    buffer.append(solutions(9000, 4000))
    for column in COLUMNS:
        np.testing.assert_array_equal(getattr(before, column), kept[column], err_msg=column)


def test_discarded_epochs_use_no_memory_and_change_no_pose() -> None:
    rows, buffer = solutions(60_000), filled()
    for first in range(0, 60_000, 50):
        buffer.append(rows[first : first + 50])
        buffer.forget_before(int(rows["gps_ns"][first]) - 3_000_000_000 + 1)
    snapshot = buffer.snapshot()
    assert len(snapshot) == 350  # the last append and the 3 s before it
    assert snapshot.position_e.base is not None
    assert len(snapshot.position_e.base) < 5000
    at = np.arange(*snapshot.span, 3_000_000)
    whole = filled(rows).snapshot()
    np.testing.assert_array_equal(snapshot.poses(at).q_e_from_b, whole.poses(at).q_e_from_b)
