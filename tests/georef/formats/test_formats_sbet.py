"""Tests SBET and smrmsg: PDAL's file, POSPac's axes, weeks, and wrong files."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import pytest

from swath.georef.arrays import FloatArray
from swath.georef.formats.sbet import sbet_bytes, smrmsg_bytes
from swath.georef.formats.trajectory.file import read_trajectory
from swath.georef.trajectory.trajectory import Trajectory, TrajectoryError
from tests.georef.flown import SECOND, START_NS, WEEK, flown

pytestmark = pytest.mark.xdist_group("kernels")

PDAL = (  # test/data/sbet/2-points.sbet of PDAL (BSD-3-Clause), field by field
    (
        151631.00283607095,
        0.5680211852972264,
        -2.04165439230394,
        107.71529532965604,
        -2.3324208666000246,
        -0.3335067504871401,
        -0.030939616317678383,
        -0.028134071493213387,
        -0.024299053938891393,
        3.0467732302786623,
        -0.021984147369226575,
        0.785963973775239,
        0.7849084719295495,
        -0.29788079164502623,
        6.226807982589819e-05,
        0.009312162756440178,
        0.07217812320996525,
    ),
    (
        151631.00783186406,
        0.5680211834722869,
        -2.0416543920340526,
        107.71514243575072,
        -2.3362282296912706,
        -0.3324663118952635,
        -0.030229489610089866,
        -0.02813856631423094,
        -0.024252156693921688,
        3.0471311052368106,
        -0.021984160079321084,
        0.8397590491636475,
        0.3252165276637165,
        -0.15588832259908442,
        0.0008379685112283802,
        0.0073728867847180765,
        0.07179027672314571,
    ),
)
WEEK_S = 604_800
SPAN = (START_NS, START_NS + 20_000_000_000)
COLUMNS = ("time_ns", "position_e", "velocity_e", "position_sigma_l", "attitude_sigma_rad")


def table_of(trajectory: Trajectory) -> FloatArray:
    return np.frombuffer(sbet_bytes(trajectory), "<f8").reshape(-1, 17).copy()


def read(table: FloatArray, **settings: Any) -> Trajectory:
    return read_trajectory(table.astype("<f8").tobytes(), "sbet.out", **({"span_ns": SPAN} | settings))


def same(one: Trajectory, other: Trajectory) -> None:
    np.testing.assert_array_equal(one.time_ns, other.time_ns)
    np.testing.assert_allclose(one.position_e, other.position_e, atol=5e-9)
    np.testing.assert_allclose(one.velocity_e, other.velocity_e, atol=1e-11)
    turned = np.abs((one.q_e_from_b * other.q_e_from_b).sum(axis=1))
    np.testing.assert_allclose(turned, 1, atol=1e-15)


# ------------------------------------------------------------------------------------------------ reading


def test_pdals_file_has_the_values_of_pdals_tests() -> None:
    """SbetReaderTest.cpp of PDAL has 151631.003 s, 0.5680211852972264, −2.04165439230394, 107.71529532965604, …"""
    trajectory = read_trajectory(struct.pack("<34d", *PDAL[0], *PDAL[1]), "2-points.sbet", week=1700)
    assert trajectory.time_ns[0] == 1700 * 604_800_000_000_000 + 151_631_002_836_071
    lat, lon, height = trajectory.geodetic()
    assert lat == pytest.approx([0.5680211852972264, 0.5680211834722869], abs=1e-15)
    assert lon == pytest.approx([-2.04165439230394, -2.0416543920340526], abs=1e-15)
    assert height == pytest.approx([107.71529532965604, 107.71514243575072], abs=2e-9)
    roll, pitch, heading = trajectory.attitude()
    assert roll == pytest.approx([PDAL[0][7], PDAL[1][7]], abs=1e-14)
    assert pitch == pytest.approx([PDAL[0][8], PDAL[1][8]], abs=1e-14)
    assert heading[0] == pytest.approx(PDAL[0][9] - PDAL[0][10], abs=1e-14)  # without wander
    # POSPac's axes are x south (2.33 m/s), y west, z up; this agrees with the file's positions
    step_l = np.degrees([lat[1] - lat[0], (lon[1] - lon[0]) * np.cos(lat[0])])
    course = np.arctan2(*trajectory.velocity_l()[0, 1::-1])
    assert course == pytest.approx(np.arctan2(step_l[1], step_l[0]), abs=np.radians(0.6))
    assert trajectory.velocity_l()[0, 2] == pytest.approx(0.030939616317678383)


def test_truncated_file_is_refused() -> None:
    with pytest.raises(TrajectoryError, match=r"bad: 271 bytes are 1 records of SBET \(136 bytes\) and 135 over"):
        read_trajectory(struct.pack("<34d", *PDAL[0], *PDAL[1])[:271], "bad", week=1700)


def test_a_written_trajectory_is_read_back() -> None:
    trajectory = flown()
    back = read_trajectory(sbet_bytes(trajectory), "sbet.out", span_ns=SPAN, smrmsg=smrmsg_bytes(trajectory))
    same(back, trajectory)
    np.testing.assert_allclose(back.position_sigma_l, trajectory.position_sigma_l, rtol=1e-12)
    np.testing.assert_allclose(back.attitude_sigma_rad, trajectory.attitude_sigma_rad, rtol=1e-12)
    table = table_of(trajectory)
    assert table[0, 0] == SECOND
    assert not table[:, 10].any()
    np.testing.assert_allclose(table[:, 4:7], trajectory.velocity_l(), atol=1e-12)
    turn = np.diff(np.unwrap(table[:, 9])) / 0.05
    assert np.corrcoef(turn, table[:-1, 16])[0, 1] > 0.99  # the rates turn as the heading does


@pytest.mark.parametrize("wander_deg", [-100.0, -1.3, 0.0, 25.0, 170.0])
@pytest.mark.parametrize("pospac", [True, False])
def test_wander_angle_rotates_heading_and_velocities(wander_deg: float, pospac: bool) -> None:
    """Platform x is α west of north; y is left and z up with POSPac, but right and down with other software."""
    trajectory = flown()
    table = table_of(trajectory)
    wander = np.radians(wander_deg) + 0.001 * np.arange(len(table))
    north, east, down = trajectory.velocity_l().T
    x = north * np.cos(wander) - east * np.sin(wander)
    west = -north * np.sin(wander) - east * np.cos(wander)
    table[:, 4:7] = np.stack([x, west, -down] if pospac else [x, -west, down], axis=1)
    table[:, 9] = (table[:, 9] + wander + np.pi) % (2 * np.pi) - np.pi
    table[:, 10] = wander
    same(read(table), trajectory)


@pytest.mark.parametrize("pospac", [True, False])
def test_a_record_without_velocity_leaves_the_other_records_rotated(pospac: bool) -> None:
    trajectory = flown()
    table = table_of(trajectory)
    wander = np.radians(25.0)
    north, east, down = trajectory.velocity_l().T
    x, west = north * np.cos(wander) - east * np.sin(wander), -north * np.sin(wander) - east * np.cos(wander)
    table[:, 4:7] = np.stack([x, west, -down] if pospac else [x, -west, down], axis=1)
    table[:, 9] = (table[:, 9] + wander + np.pi) % (2 * np.pi) - np.pi
    table[:, 10] = wander
    table[7, 5] = np.nan
    back, said = read(table), np.arange(len(table)) != 7
    np.testing.assert_allclose(back.velocity_e[said], trajectory.velocity_e[said], atol=1e-11)
    np.testing.assert_allclose(back.velocity_e[7], trajectory.velocity_e[7], atol=0.1)  # from neighbouring positions


def test_a_record_without_velocity_does_not_hide_later_wrong_velocities() -> None:
    table = table_of(flown())
    north, east = table[:, 4].copy(), table[:, 5].copy()
    cos, sin = np.cos(np.radians(40.0)), np.sin(np.radians(40.0))
    table[:, 4], table[:, 5] = north * cos - east * sin, north * sin + east * cos
    table[1, 5] = np.nan
    with pytest.raises(TrajectoryError, match="positions and velocities differ in course by 40°"):
        read(table)


def test_absent_sigmas_stay_absent() -> None:
    trajectory = flown(position_sigma_l=None)
    back = read_trajectory(sbet_bytes(trajectory), "sbet.out", span_ns=SPAN, smrmsg=smrmsg_bytes(trajectory))
    assert np.isnan(back.position_sigma_l).all()
    np.testing.assert_allclose(back.attitude_sigma_rad, trajectory.attitude_sigma_rad, rtol=1e-12)


def test_sigmas_given_once_a_second_apply_to_all_epochs_between() -> None:
    trajectory = flown()
    rows = np.frombuffer(smrmsg_bytes(trajectory), "<f8").reshape(-1, 10)
    assert rows[0, 9] == pytest.approx(0.02 * 60)  # arc minutes
    back = read_trajectory(sbet_bytes(trajectory), "sbet.out", span_ns=SPAN, smrmsg=rows[20:500:20].tobytes())
    assert np.isnan(back.position_sigma_l[:20]).all()
    assert np.isnan(back.attitude_sigma_rad[481:]).all()
    np.testing.assert_allclose(back.position_sigma_l[20:481], trajectory.position_sigma_l[20:481], rtol=1e-9)
    np.testing.assert_allclose(back.attitude_sigma_rad[20:481], trajectory.attitude_sigma_rad[20:481], rtol=1e-9)


# -------------------------------------------------------------------------------------------------- weeks


def test_the_week_is_chosen_to_overlap_the_log() -> None:
    trajectory = flown()
    for span in ((START_NS - 10**12, START_NS + 1), (START_NS + 29 * 10**9, START_NS + 10**13)):
        assert read(table_of(trajectory), span_ns=span).span == trajectory.span
    assert read(table_of(trajectory), week=100).span[0] == START_NS - (WEEK - 100) * WEEK_S * 10**9
    with pytest.raises(TrajectoryError, match=r"seconds of the week without the week; give the GPS week \(--week\)"):
        read(table_of(trajectory), span_ns=None)


@pytest.mark.parametrize("week", [-1, 24_233, 10**6, 10**20])
def test_an_impossible_week_is_refused(week: int) -> None:
    """24233 is the third day of week 2423 in the names of orbit files; as a week it exceeds 64 bits of nanoseconds."""
    with pytest.raises(TrajectoryError, match=rf"--week {week} is not a GPS week; give whole weeks since 1980"):
        read_trajectory(sbet_bytes(flown()), "s", week=week)


@pytest.mark.parametrize("begins_anew", [True, False])
@pytest.mark.parametrize("log_begins_s", [-20.0, 10.0])
def test_a_trajectory_across_the_end_of_a_week_is_read(begins_anew: bool, log_begins_s: float) -> None:
    """Some software counts seconds on across the end of a week and some begins anew; the log may lie on either side."""
    end_ns = (WEEK + 1) * WEEK_S * 10**9
    trajectory = flown(start_ns=end_ns - 15 * 10**9)
    table = table_of(trajectory)
    assert table[-1, 0] > WEEK_S
    if begins_anew:
        table[:, 0] %= WEEK_S
    begin_ns = end_ns + int(log_begins_s * 1e9)
    np.testing.assert_array_equal(read(table, span_ns=(begin_ns, begin_ns + 20 * 10**9)).time_ns, trajectory.time_ns)


def test_sigmas_that_begin_after_the_end_of_the_week_are_read() -> None:
    end_ns = (WEEK + 1) * WEEK_S * 10**9
    trajectory = flown(start_ns=end_ns - 15 * 10**9)
    rows = np.frombuffer(smrmsg_bytes(trajectory), "<f8").reshape(-1, 10)[400:].copy()
    rows[:, 0] -= WEEK_S
    back = read_trajectory(sbet_bytes(trajectory), "s", week=WEEK, smrmsg=rows.tobytes())
    np.testing.assert_allclose(back.position_sigma_l[400:], trajectory.position_sigma_l[400:], rtol=1e-12)
    assert np.isnan(back.position_sigma_l[:400]).all()
    rows[:, 0] += 50_000
    with pytest.raises(TrajectoryError, match="smrmsg beside it covers another time"):
        read_trajectory(sbet_bytes(trajectory), "s", week=WEEK, smrmsg=rows.tobytes())


def test_epochs_with_gaps_across_the_end_of_a_week_are_read() -> None:
    """Such gaps occur if only the lines of a flight were exported, or if epochs are seconds apart."""
    end_ns = (WEEK + 1) * WEEK_S * 10**9
    trajectory = flown(start_ns=end_ns - 10 * 10**9)
    table = table_of(trajectory)
    table[:, 0] %= WEEK_S
    kept = (trajectory.time_ns < end_ns - 2 * 10**9) | (trajectory.time_ns > end_ns + 3 * 10**9)
    back = read(table[kept], week=WEEK)
    np.testing.assert_allclose(back.time_ns, trajectory.time_ns[kept], atol=100)
    early = table[kept].copy()
    early[early[:, 0] < WEEK_S / 2, 0] += 4000.0
    with pytest.raises(TrajectoryError, match="time goes back by"):
        read(early, week=WEEK)


def test_error_for_another_flight_gives_both_time_spans() -> None:
    with pytest.raises(
        TrajectoryError,
        match=r"561618\.0 to 561647\.9 s of the week does not overlap the log, 61618.0 to 61638.0 s of GPS week 2445",
    ):
        read(table_of(flown()), span_ns=(START_NS - 500_000 * 10**9, START_NS - 499_980 * 10**9))


def test_error_names_times_in_seconds_of_day() -> None:
    table = table_of(flown())
    table[:, 0] -= 6 * 86_400
    with pytest.raises(TrajectoryError, match="look like seconds of the day; add 518400 s"):
        read(table)


# -------------------------------------------------------------------------------------------- wrong files


def spoilt(**changes: Any) -> FloatArray:
    right = table_of(flown())
    table = right.copy()
    for key, value in changes.items():
        table[:, int(key[1:])] = value(right)
    return table


DEGREES = 180 / np.pi


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"c1": lambda t: t[:, 1] * DEGREES}, r"latitude 47\.5 at record 1: radians .* look like degrees"),
        ({"c1": lambda t: t[:, 2] + 2, "c2": lambda t: t[:, 1]}, "radians north .* look like degrees"),
        ({"c1": lambda t: t[:, 2], "c2": lambda t: t[:, 1]}, "latitude and longitude are swapped"),
        ({"c2": lambda t: t[:, 2] * DEGREES}, "longitude at record 1 exceeds a full turn"),
        ({"c7": lambda t: t[:, 7] * DEGREES}, r"roll 3\.1.* radians are expected; these look like degrees"),
        ({"c9": lambda t: t[:, 9] * DEGREES}, r"heading .* radians are expected; these look like degrees"),
        ({"c3": lambda t: t[:, 3] * 1000}, r"height 900000\.0 at record 1: metres above the ellipsoid"),
        ({"c3": lambda t: np.where(t[:, 0] > SECOND + 2, np.nan, t[:, 3])}, "no number for height at record 42"),
        ({"c8": lambda t: np.where(t[:, 0] > SECOND + 2, np.nan, t[:, 8])}, "no number for roll, .* record 42"),
        ({"c0": lambda t: np.where(t[:, 0] > SECOND + 2, t[:, 0] - 3, t[:, 0])}, r"goes back by 2\.950 s at record 42"),
        ({"c0": lambda t: np.round(t[:, 0], 1)}, "time stands still at record"),
        ({"c0": lambda t: t[:, 0] * 1000}, "is not a second of the week; SBET is expected"),
        ({"c10": lambda t: np.full(len(t), 0.2)}, "from record 1 on .* differ in course by 11°: .* wander angle"),
        ({"c4": lambda t: t[:, 5], "c5": lambda t: t[:, 4]}, "velocities differ in course by"),
    ],
)
def test_wrong_file_is_refused_in_one_line(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(TrajectoryError, match=message) as caught:
        read(spoilt(**changes))
    assert str(caught.value).startswith("sbet.out: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("course_deg", [10.0, 100.0, 160.0, 250.0, 340.0])
def test_swapped_coordinates_are_reported_on_every_course(course_deg: float) -> None:
    table = table_of(flown(course_deg=course_deg))
    table[:, 1:3] = table[:, 2:0:-1]
    with pytest.raises(TrajectoryError, match="latitude and longitude are swapped"):
        read(table)


def test_slow_crabbing_is_not_reported_as_a_wrong_course() -> None:
    """Below 20 m/s the course of the positions is not compared with that of the velocities."""
    n = 600
    slow = flown(n, velocity_l=np.tile([15.0, 0, 0], (n, 1)))
    assert len(read(table_of(slow))) == n
    drifting = flown(
        n, velocity_l=np.tile([30.0, 0, 0], (n, 1)), lon_rad=0.1 + 2e-7 * np.arange(n), lat_rad=np.full(n, 0.8)
    )
    assert 15 < np.linalg.norm(np.diff(drifting.position_e, axis=0), axis=1).mean() / 0.05 < 20
    assert len(read(table_of(drifting))) == n


def test_error_names_sigmas_given_in_place_of_the_trajectory() -> None:
    rows = smrmsg_bytes(flown(601))
    with pytest.raises(TrajectoryError, match=r"is an smrmsg, which has the sigmas of a trajectory; give the SBET"):
        read_trajectory(rows, "smrmsg.out", span_ns=SPAN)


@pytest.mark.parametrize("data", [b"", struct.pack("<17d", *([1.0] * 17))])
def test_a_trajectory_without_epochs_is_refused(data: bytes) -> None:
    with pytest.raises(TrajectoryError, match=r"truncated or of another kind|has 1 epochs; a trajectory needs two"):
        read_trajectory(data, "short", week=WEEK)


def test_a_file_that_is_not_smrmsg_is_refused() -> None:
    rows = np.frombuffer(smrmsg_bytes(flown()), "<f8").reshape(-1, 10).copy()
    rows[2, 4] = -1
    with pytest.raises(TrajectoryError, match="smrmsg of s: a sigma at record 3 is negative; smrmsg is expected"):
        read_trajectory(sbet_bytes(flown()), "s", week=WEEK, smrmsg=rows.tobytes())
