"""Tests alignment against truth: flights made without this code, and the simulator's unit near the poles."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from swath.georef.arrays import FloatArray, StructArray
from swath.georef.geodesy.earth import geodetic_from_e, rot_e_from_l
from swath.georef.geodesy.gravity import EARTH_RATE_RADPS
from swath.georef.geodesy.quaternions import rotation_vector
from swath.georef.geodesy.rotations import quaternion_from_rot, rot_from_quaternion, rot_z
from swath.georef.navigation.alignment.align import AlignedStart, Aligner, AlignmentError, align
from swath.georef.navigation.alignment.blocks import Blocks
from swath.georef.navigation.alignment.fit import TILT, Problem
from swath.georef.navigation.inputs import GRADES, OBSERVATION_DTYPE, ImuNoise, Inertial, Kind, Start, sort_observations
from swath.georef.records import FixType
from tests.georef.navigation.vehicles import (
    BEGIN_NS,
    Motion,
    Recording,
    car,
    made,
    normalised,
    ns,
    observed,
    reference,
    uav,
)

pytestmark = pytest.mark.xdist_group("kernels")

ARM = np.array([0.8, -0.4, -1.2])


def still(t: FloatArray) -> FloatArray:
    return np.zeros((len(t), 3))


def parked(heading_deg: float) -> Motion:
    angles = np.radians([3.0, -2.0, heading_deg])
    return Motion((0.8, 0.15, 400.0), still, lambda t: np.tile(angles, (len(t), 1)))


def winding(place: tuple[float, float, float], speed: float = 40.0, reverse: bool = False) -> Motion:
    """Return a motion along sines, banked, with the nose along the course or, with `reverse`, opposite to it."""

    def position(t: FloatArray) -> FloatArray:
        return np.column_stack([speed * t, 60.0 * np.sin(0.2 * t), 5.0 * np.cos(0.1 * t)])

    def attitude(t: FloatArray) -> FloatArray:
        course = np.arctan2(12.0 * np.cos(0.2 * t), speed)
        bank = np.arctan2(-2.4 * np.sin(0.2 * t), 9.8)
        return np.column_stack([bank, 0.05 + 0.02 * np.sin(0.3 * t), course + np.pi * reverse])

    return Motion(place, position, attitude)


def straight(crab_deg: float) -> Motion:
    """Return a motion due north at 50 m/s in still air, with the nose `crab_deg` off the course."""
    angles = np.radians([0.5, 2.0, crab_deg])
    return Motion(
        (0.8, 0.15, 400.0),
        lambda t: np.column_stack([50.0 * t, 0.0 * t, 0.0 * t]),
        lambda t: np.tile(angles, (len(t), 1)),
    )


def found(recording: Recording) -> AlignedStart:
    return align(recording.inertial, recording.rows, recording.setup)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["tactical", "mems"])
@pytest.mark.parametrize("kinds", [(Kind.POSITION, Kind.VELOCITY), (Kind.POSITION,)], ids=["both", "positions"])
def test_starts_anywhere_in_a_flight_are_as_accurate_as_their_sigmas(name: str, kinds: tuple[Kind, ...]) -> None:
    flight = reference(name)
    errors = []
    for begin in range(100_150, 101_700, 75):
        part = flight.cut(begin, begin + 20)
        start = align(part.inertial, part.only(*kinds), part.setup)
        assert start.method == "motion"
        assert np.degrees(start.attitude_sigma_rad[2]) < 2.0
        errors.append(normalised(flight, start))
    each = np.array(errors)
    spread = np.sqrt((each**2).mean(axis=0))
    # 21 normal numbers have 1 ± 0.15; roll and pitch share a bias and count as little more than one.
    assert (spread[2:] > 0.55).all()
    assert (spread[2:] < 1.45).all()
    assert (spread[:2] < 2.0).all()
    assert np.abs(each).max() < 4.0


@pytest.mark.slow
def test_seeds_scatter_as_their_sigmas_predict() -> None:
    errors = []
    for seed in range(24):
        recording = made(winding((0.8, 0.1, 400.0)), 14.0, GRADES["mems"], seed, lever_arm_b=ARM, rate_hz=50.0)
        errors.append(normalised(recording, found(recording)))
    spread = np.sqrt((np.array(errors) ** 2).mean(axis=0))  # of 24 normal numbers: 1 ± 0.14
    assert (spread > 0.58).all()
    assert (spread < 1.42).all()


@pytest.mark.slow
def test_gyroscopes_that_sense_earth_rotation_find_north_at_rest() -> None:
    noise, errors = GRADES["navigation"], []
    for seed in range(5):
        recording = made(parked(72.0 * seed), 32.0, noise, seed, lever_arm_b=ARM, rate_hz=50.0)
        start = found(recording)
        assert start.method == "still"
        assert start.text.startswith("aligned standing still, by gyrocompassing: heading ")
        assert np.degrees(start.attitude_sigma_rad[2]) < 2.0
        errors.append(normalised(recording, start))
    assert np.sqrt(np.mean(np.array(errors)[:, 2] ** 2)) < 1.0  # no real vehicle stands so still
    assert 0.4 < np.sqrt(np.mean(np.array(errors)[:, :2] ** 2)) < 1.5


@pytest.mark.slow
def test_gyroscopes_that_cannot_sense_earth_rotation_wait_for_motion_and_report_it() -> None:
    recording = made(parked(200.0), 64.0, GRADES["mems"], 3, lever_arm_b=ARM)
    with pytest.raises(AlignmentError, match=r"roll/pitch 0\.\d+° yet: waits for first motion") as refused:
        found(recording)
    said = re.search(r"heading (\d+)°", str(refused.value))
    assert said is not None
    assert int(said[1]) > 90  # with a bias of 25 °/h the earth's 10 °/h show no heading


def test_correlated_noise_is_not_taken_for_knowledge() -> None:
    parked_one = reference("mems").cut(100_010, 100_074)
    blocks = Blocks()
    blocks.feed(parked_one.inertial)
    felt = blocks.felt(int(ns(100_012.0)), int(ns(100_072.0)))
    assert felt is not None
    rows = parked_one.rows[parked_one.rows["time_ns"] >= felt.time_ns[0]]
    rows = rows[rows["time_ns"] <= felt.time_ns[-1]]
    problem = Problem(felt, rows, parked_one.setup, rows["time_ns"][rows["kind"] == Kind.POSITION])
    fitted = problem.fit(problem.first_guess())
    assert np.degrees(fitted.sigma(TILT)[2]) > 15.0  # 11° would result if the noise of residuals were taken for motion


def test_drifting_gnss_positions_are_not_taken_for_motion() -> None:
    ground = uav()
    begin = (int(ground.inertial.time_ns[0]) - BEGIN_NS) / 1e9
    with pytest.raises(AlignmentError, match="waits for first motion"):
        found(ground.cut(begin, begin + 60.0))


def test_blocks_carry_the_attitude_through_coning() -> None:
    def wobble(t: FloatArray) -> FloatArray:
        return np.column_stack([0.1 * np.sin(9.0 * t), 0.1 * np.cos(9.0 * t), 0.0 * t])

    motion = Motion((0.8, 0.15, 400.0), still, wobble)
    perfect = ImuNoise(0.0, 0.0, 0.0, 0.0)
    recording = made(motion, 20.0, perfect, 0, lever_arm_b=ARM, rate_hz=200.0)
    blocks = Blocks()
    blocks.feed(recording.inertial)
    felt = blocks.felt(BEGIN_NS, int(ns(19.5)))
    assert felt is not None
    assert recording.truth is not None
    rot, _, place = recording.truth(np.array([0.0, 19.5]))
    first, last = rot_e_from_l(*geodetic_from_e(place)[:2]) @ rot
    expected = (rot_z(EARTH_RATE_RADPS * 19.5) @ last).T @ first
    off = rotation_vector(quaternion_from_rot(rot_from_quaternion(felt.turn[0]) @ expected.T))
    assert np.abs(off).max() < 1e-3  # without coning within blocks it would be 0.88 rad · (9 · 0.05)² / 12 = 0.015


@pytest.mark.parametrize("heading_deg", [10.0, 190.0])
def test_a_second_antenna_gives_the_heading_at_once(heading_deg: float) -> None:
    baseline = np.array([0.0, 1.5, 0.1])
    errors = []
    for seed in range(8):
        motion = parked(heading_deg)
        recording = made(motion, 15.0, GRADES["mems"], seed, lever_arm_b=ARM, baseline_b=baseline)
        start = found(recording)
        assert start.method == "dual antenna"
        assert start.time_ns - int(recording.inertial.time_ns[0]) < 9e9
        errors.append(normalised(recording, start))
    assert 0.4 < np.sqrt(np.mean(np.array(errors)[:, :3] ** 2)) < 1.5


@pytest.mark.slow
def test_heading_of_a_straight_flight_is_its_course_with_the_sigma_of_crabbing() -> None:
    off = []
    for seed, crab in enumerate([-12.0, 3.0, 9.0]):
        recording = made(straight(crab), 34.0, GRADES["mems"], seed, lever_arm_b=ARM)
        start = found(recording)
        assert start.method == "course"
        assert "heading by the course over ground" in start.text
        assert 4.0 < np.degrees(start.attitude_sigma_rad[2]) < 10.5
        off.append(normalised(recording, start)[:3])
    assert np.abs(np.array(off)).max() < 2.5


@pytest.mark.parametrize(
    "place",
    [
        (np.radians(90.0 - 435.0 / 111_694.0), 2.0, 300.0),
        (np.radians(-89.9), -1.0, 2800.0),
        (-0.3, np.pi - 1e-5, 50.0),
        (0.0, 0.0, 0.0),
    ],
    ids=["north pole", "south pole", "antimeridian", "equator"],
)
def test_alignment_works_at_the_poles_and_the_antimeridian(place: tuple[float, float, float]) -> None:
    errors = []
    for seed in range(4):
        recording = made(winding(place), 20.0, GRADES["tactical"], seed, lever_arm_b=np.array([0.8, -6.0, -1.2]))
        start = found(recording)
        assert start.method == "motion"
        errors.append(normalised(recording, start))
    assert np.abs(np.array(errors)).max() < 3.7
    assert 0.6 < np.sqrt(np.mean(np.array(errors) ** 2)) < 1.4


def test_a_reversing_vehicle_is_not_turned_round() -> None:
    motion = winding((0.8, 0.1, 400.0), 8.0, reverse=True)
    for seed, sigma in enumerate([0.5, 0.9]):
        recording = made(motion, 34.0, GRADES["mems"], seed, lever_arm_b=ARM, sigma=(sigma, sigma), rate_hz=50.0)
        start = found(recording)
        assert start.method == "motion"
        assert np.abs(normalised(recording, start)).max() < 3.7


def test_a_given_attitude_is_used_and_propagated() -> None:
    recording = made(winding((0.8, 0.1, 400.0)), 20.0, GRADES["mems"], 5, lever_arm_b=ARM)
    assert recording.truth is not None
    rot = recording.truth(np.array([0.0]))[0][0]
    angles = np.array([np.arctan2(rot[2, 1], rot[2, 2]), -np.arcsin(rot[2, 0]), np.arctan2(rot[1, 0], rot[0, 0])])
    given = observed(Kind.ATTITUDE, np.array([0.01]), angles, np.radians([0.2, 0.2, 0.5]), FixType.NONE)
    rows = sort_observations(np.concatenate([given, recording.rows]))
    start = align(recording.inertial, rows, recording.setup)
    assert start.method == "given"
    assert np.abs(normalised(recording, start)).max() < 3.7
    assert np.degrees(start.attitude_sigma_rad[2]) < 0.6


@pytest.mark.slow
def test_heading_of_a_real_car_matches_its_direction_of_travel() -> None:
    drive, off = car(), []
    begin = (int(drive.inertial.time_ns[0]) - BEGIN_NS) / 1e9
    speed = drive.only(Kind.VELOCITY)
    for after in range(40, 500, 40):
        part = drive.cut(begin + after, begin + after + 40)
        start = found(part)
        now = int(np.searchsorted(speed["time_ns"], start.time_ns))
        course = np.arctan2(speed["value"][now, 1], speed["value"][now, 0])
        if np.hypot(*speed["value"][now, :2]) > 5.0:
            turn = (start.attitude_rad[2] - course + np.pi) % (2 * np.pi) - np.pi
            off.append(turn / np.hypot(start.attitude_sigma_rad[2], np.radians(2.0)))  # the car slips a little in bends
    assert len(off) > 6
    assert np.sqrt(np.mean(np.square(off))) < 1.5
    assert np.abs(off).max() < 3.0


def test_attitude_of_a_real_light_aircraft_matches_its_own_filter() -> None:
    flight = uav()
    assert flight.truth is not None
    off = []
    for after in range(220, 560, 60):
        start = found(flight.cut(after, after + 60))
        rot = flight.truth(np.array([(start.time_ns - BEGIN_NS) / 1e9]))[0][0]
        heading = np.arctan2(rot[1, 0], rot[0, 0])
        off.append(np.degrees((start.attitude_rad[2] - heading + np.pi) % (2 * np.pi) - np.pi))
        assert abs(np.degrees(start.attitude_rad[0] - np.arctan2(rot[2, 1], rot[2, 2]))) < 3.0
        assert abs(np.degrees(start.attitude_rad[1] + np.arcsin(rot[2, 0]))) < 3.0
    assert np.abs(off).max() < 6.0  # it crabs by up to 30°, and the filter itself is right to some degrees
    assert np.median(np.abs(off)) < 3.0


def feed(recording: Recording, cuts: list[int], order: list[bool]) -> Aligner:
    """Feed samples and observations in pieces up to the times `cuts`; `order` says where samples come first."""
    aligner = Aligner(recording.setup)
    for first, last, samples_first in zip([0, *cuts], [*cuts, 2**62], order, strict=True):
        rows = recording.rows[(recording.rows["time_ns"] >= first) & (recording.rows["time_ns"] < last)]
        span = np.searchsorted(recording.inertial.time_ns, [first, last]).tolist()
        for is_samples in (samples_first, not samples_first):
            if is_samples:
                aligner.feed(recording.inertial.between(*span))
            else:
                aligner.observe(rows)
    return aligner


def equal(a: Start, b: Start) -> bool:
    names = ("position_e", "velocity_l", "attitude_rad", "position_sigma_l", "velocity_sigma_l", "attitude_sigma_rad")
    return a.time_ns == b.time_ns and all(np.array_equal(getattr(a, name), getattr(b, name)) for name in names)


def test_results_do_not_depend_on_how_data_are_cut() -> None:
    part = reference("mems").cut(100_138, 100_170)
    whole = feed(part, [], [True]).start
    assert whole is not None
    rng = np.random.default_rng(1)
    for _ in range(4):
        cuts = np.sort(rng.integers(part.inertial.time_ns[0], part.inertial.time_ns[-1], 60))
        cuts[1::2] = cuts[::2] + 1_000_000
        pieces = feed(part, np.sort(cuts).tolist(), rng.integers(0, 2, 61).astype(bool).tolist())
        assert pieces.start is not None
        assert equal(pieces.start, whole)
        assert pieces.state == whole.text
    ahead, after = Aligner(part.setup), Aligner(part.setup)
    for row in range(len(part.rows)):
        ahead.observe(part.rows[row : row + 1])
    ahead.feed(part.inertial)
    after.feed(part.inertial)
    for row in range(len(part.rows)):
        after.observe(part.rows[row : row + 1])
    for each in (ahead, after):
        assert each.start is not None
        assert equal(each.start, whole)


def test_a_gap_of_samples_restarts_the_window() -> None:
    part = reference("tactical").cut(100_400, 100_440)
    inertial = part.inertial
    keep = (inertial.time_ns < ns(100_405.0)) | (inertial.time_ns > ns(100_407.0))
    samples = Inertial(
        inertial.time_ns[keep],
        inertial.interval_s[keep],
        inertial.angle_b[keep],
        inertial.velocity_b[keep],
        inertial.bridged[keep],
    )
    start = align(samples, part.rows, part.setup)
    assert start.time_ns >= ns(100_417.0)
    assert np.abs(normalised(part, start)).max() < 4.0


def test_a_single_bad_fix_is_harmless() -> None:
    part = reference("tactical").cut(100_400, 100_440)
    rows = part.rows.copy()
    place = np.flatnonzero(rows["kind"] == Kind.POSITION)
    rows["value"][place[6]] += 30.0
    rows["sigma"][place[3]] = np.nan
    aligner = Aligner(part.setup)
    aligner.feed(part.inertial)
    aligner.observe(rows)
    assert aligner.start is not None
    assert aligner.counts == {"unusable": 1}
    assert np.abs(normalised(part, aligner.start)).max() < 4.0


def test_antenna_and_body_origin_are_distinguished() -> None:
    part = reference("tactical").cut(100_700, 100_730)
    start = found(part)
    other = align(part.inertial, part.rows, replace(part.setup, lever_arms_b=np.zeros((1, 3))))
    assert part.truth is not None
    lengths = []
    for each in (start, other):
        place = part.truth(np.array([(each.time_ns - BEGIN_NS) / 1e9]))[2][0]
        lengths.append(np.linalg.norm(each.position_e - place))
    assert lengths[0] < 0.05
    assert abs(lengths[1] - np.linalg.norm(part.setup.lever_arms_b[0])) < 0.05


def states() -> list[tuple[Inertial, StructArray, str]]:
    part = reference("tactical").cut(100_400, 100_440)
    rows, none = part.rows, np.zeros(0, OBSERVATION_DTYPE)
    late = rows.copy()
    late["time_ns"] += 3600 * 10**9
    wrong = replace(part.inertial, angle_b=part.inertial.angle_b * [1.0, 1.0, -1.0])
    return [
        (part.inertial, none, "waits for GNSS positions and inertial samples"),
        (part.inertial.between(0, 0), rows, "waits for GNSS positions and inertial samples"),
        (part.inertial, late, "waits for GNSS positions and inertial samples"),
        (part.inertial, part.only(Kind.VELOCITY), "waits for GNSS positions and inertial samples"),
        (part.inertial.between(0, 700), rows, r"has \d s of GNSS and inertial samples together, needs 10 s"),
        (wrong, rows, r"do not fit GNSS's velocities \(residuals \d+ times their sigma\): check rotation_b_imu"),
    ]


@pytest.mark.parametrize("number", range(6))
def test_missing_data_are_reported(number: int) -> None:
    inertial, rows, words = states()[number]
    with pytest.raises(AlignmentError, match=words):
        align(inertial, rows, reference("tactical").setup)


def test_sigmas_of_a_start_grow_with_the_noise_of_the_imu() -> None:
    part = reference("tactical").cut(100_400, 100_440)
    rough = replace(part.setup, noise=replace(part.setup.noise, accel_bias=0.05, gyro_bias=1e-4))
    fine, coarse = found(part), align(part.inertial, part.rows, rough)
    assert (coarse.attitude_sigma_rad[:2] > 2.0 * fine.attitude_sigma_rad[:2]).all()
