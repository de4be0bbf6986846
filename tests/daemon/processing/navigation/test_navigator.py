"""Tests the navigator on a growing log without a device's INS: true poses, however it is fed."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from unittest.mock import patch

import numpy as np
import pytest

from swath.daemon.log.mcap.chunks import LogBatch
from swath.daemon.processing.points.feed import LogFeed
from swath.daemon.processing.setup.setup import Options, Setup
from swath.georef.arrays import StructArray
from swath.georef.navigation.inputs import OBSERVATION_DTYPE
from swath.georef.points import Fate, Points
from swath.georef.timescales import SECOND_NS
from swath.georef.trajectory.trajectory import Trajectory
from tests.daemon.short_flight import Flown, fly_short

pytestmark = pytest.mark.xdist_group("kernels")

PLAN = """
[flight]
name = "navigator"
seed = 8
speed_mps = 50.0

[[line]]
name = "1"
from_m = [-600, 0]
to_m = [600, 0]
height_m = 700

[gnss.rover]
rate_hz = 5
secondary_lever_arm_m = [0.1, 1.15, -1.2]
{ins}

[imu.main]
rate_hz = 200
rotation_b_imu = [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]

[scanner.left]
prf_hz = 2000
on_lines_only = false
"""
SECONDS = 32.0
CONVERGED_NS = 5_000_000_000
SINGLY_NS = 14_000_000_000


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    return fly_short(tmp_path_factory.mktemp("navigator"), PLAN.format(ins=""), SECONDS)


@pytest.fixture(scope="module")
def setup(flown: Flown) -> Setup:
    return Setup.of_log(flown.session().attachments(), Options(datum="same", uncertainty=False))


Told = tuple[StructArray, list[tuple[str, Points]], LogFeed]


def told(setup: Setup, flown: Flown, batches: Iterable[LogBatch]) -> Told:
    """Return the poses that the navigator gave, the points and the feed."""
    feed = LogFeed(setup, setup.live_stream(flown.session().info))
    navigator = feed.navigator
    assert navigator is not None
    poses: list[StructArray] = []
    path = feed.stream.path
    add = path.add

    def noted(rows: StructArray) -> None:
        poses.append(rows)
        add(rows)

    with patch.object(path, "add", noted):
        placed = [piece for batch in batches for piece in feed.take(batch)] + feed.close()
    return np.concatenate(poses), placed, feed


@pytest.fixture(scope="module")
def followed(setup: Setup, flown: Flown) -> Told:
    return told(setup, flown, flown.session().batches())


def one_by_one(batches: Iterable[LogBatch]) -> Iterator[LogBatch]:
    """Yield single messages until some seconds after the start that is found, then batches cut in two."""
    begun_ns = 0
    for batch in batches:
        count = len(batch.log_time_ns)
        if batch.channel.topic.startswith("/scanner/"):
            yield batch
        else:
            begun_ns = begun_ns or int(batch.log_time_ns[0])
            step = 1 if batch.log_time_ns[0] < begun_ns + SINGLY_NS else max(count // 2, 1)
            yield from (batch.between(at, min(at + step, count)) for at in range(0, count, step))


@pytest.mark.slow
def test_poses_match_the_truth_within_their_sigmas(followed: Told, flown: Flown) -> None:
    rows, truth = followed[0], flown.truth()
    assert (np.diff(rows["gps_ns"]) > 0).all()
    rows = rows[rows["gps_ns"] > rows["gps_ns"][0] + CONVERGED_NS]
    rows = rows[truth.fates(rows["gps_ns"]) == 0]
    assert len(rows) > 10 * 200
    true = truth.poses(rows["gps_ns"])
    found = Trajectory.from_geodetic(
        *(rows[name] for name in ("gps_ns", "lat_rad", "lon_rad", "height_m", "velocity_l")),
        *(rows[name] for name in ("roll_rad", "pitch_rad", "heading_rad")),
    )
    away_m = np.linalg.norm(found.position_e - true.position_e, axis=1)
    assert away_m.max() < 0.12
    assert (away_m / np.linalg.norm(rows["position_sigma_l"], axis=1)).mean() < 2.0
    unsaid = np.full((len(rows), 3), np.nan)
    attitude = Trajectory(rows["gps_ns"], true.position_e, true.q_e_from_b, true.velocity_e, unsaid, unsaid)
    for name, there in zip(("roll_rad", "pitch_rad", "heading_rad"), attitude.attitude(), strict=True):
        wrong = np.abs((rows[name] - there + np.pi) % (2 * np.pi) - np.pi)
        assert np.degrees(wrong.max()) < (0.6 if name == "heading_rad" else 0.25), name


def test_points_are_georeferenced_with_the_poses(followed: Told) -> None:
    _, placed, feed = followed
    points = sum(len(points) for _, points in placed)
    fates = feed.stream.fates("left")
    assert points == fates[Fate.GEOREFERENCED] > 0.4 * sum(fates.values())
    assert not feed.stream.waiting("left")
    assert feed.navigator is not None
    assert feed.navigator.state.startswith("aligned")


@pytest.mark.slow
def test_poses_do_not_depend_on_how_messages_arrive(followed: Told, setup: Setup, flown: Flown) -> None:
    again, _, _ = told(setup, flown, one_by_one(flown.session().batches()))
    assert again.tobytes() == followed[0].tobytes()


def test_an_epoch_whose_messages_come_in_two_ticks_is_used_once(setup: Setup, flown: Flown) -> None:
    """BESTPOS before a tick and BESTGNSSPOS after it are one position with the same errors."""
    navigator = LogFeed(setup, setup.live_stream(flown.session().info)).navigator
    assert navigator is not None
    rows = np.zeros(3, OBSERVATION_DTYPE)
    rows["time_ns"], rows["kind"] = [5 * SECOND_NS, 5 * SECOND_NS, 6 * SECOND_NS], [0, 1, 0]
    assert len(navigator._fresh(rows[:1])) == 1
    assert navigator._fresh(rows)["time_ns"].tolist() == [5 * SECOND_NS, 6 * SECOND_NS]
    assert navigator.counts["fix repeated in epoch"] == 1
    rows["time_ns"] += 3 * SECOND_NS
    assert len(navigator._fresh(rows)) == 3


def test_a_device_solution_is_used_as_soon_as_it_exists(tmp_path_factory: pytest.TempPathFactory) -> None:
    flown = fly_short(tmp_path_factory.mktemp("ins"), PLAN.format(ins="ins = true"), 4.0)
    setup = Setup.of_log(flown.session().attachments(), Options(datum="same", uncertainty=False))
    feed = LogFeed(setup, setup.live_stream(flown.session().info))
    assert feed.navigator is not None
    for batch in flown.session().batches():
        feed.take(batch)
    feed.close()
    assert feed.navigator is None
    assert feed.stream.path.covered_until_ns is not None
