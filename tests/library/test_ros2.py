"""Tests ``swath export --ros2``: another program's decoder reads the bag, and its values are those of the log."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap_ros2_support_fast import DecoderFactory
from scipy.spatial.transform import Rotation
from small_mcap import read_message_decoded

import swath
from swath.daemon.processing.records.ros2 import POINT_DTYPE, fix_message, point_cloud
from swath.daemon.processing.records.tables import FIX_TABLE, RETURN_TABLE
from swath.georef.records import FixType
from tests.daemon.commands import swath as run
from tests.daemon.short_flight import Flown
from tests.library.builders import fly

FLU = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))  # forward, left, up from forward, right, down
GPS_UNIX_NS = (315_964_800 - 18) * 10**9  # POSIX time of the GPS epoch, less the leap seconds since 2017


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    """Return the begin of a flight, with pulses on the ground."""
    return fly(tmp_path_factory.mktemp("ros2"), seconds=14.0)


def messages_of(path: Path) -> Iterator[tuple[str, int, Any]]:
    """Yield topic, time and values of each message of a bag, by a decoder that is not rosbags'."""
    with path.open("rb") as stream:
        for one in read_message_decoded(stream, decoder_factories=[DecoderFactory()]):
            yield one.channel.topic, one.message.log_time, one.decoded_message


def stamp_ns(message: Any) -> int:
    """Return the time of a message's header, ns since 1970."""
    return int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)


def vector(values: Any) -> list[float]:
    return [values.x, values.y, values.z]


def rotation(q: Any) -> Rotation:
    return Rotation.from_quat([q.x, q.y, q.z, q.w])


def check_heading(message: Any, row: Any) -> None:
    """Check a heading: REP 103 counts yaw from east to north, and pitch positive with the nose down."""
    yaw, pitch, roll = rotation(message.orientation).as_euler("ZYX")
    assert (np.pi / 2 - yaw - row["heading_rad"] + np.pi) % (2 * np.pi) - np.pi == pytest.approx(0.0, abs=1e-9)
    assert (-pitch, roll) == pytest.approx((row["pitch_rad"], 0.0), abs=1e-9)
    covariance = np.reshape(message.orientation_covariance, (3, 3))
    assert covariance[2, 2] == pytest.approx(row["heading_sigma_rad"] ** 2, rel=1e-3)
    assert np.trace(covariance) == pytest.approx(row["heading_sigma_rad"] ** 2 + row["pitch_sigma_rad"] ** 2, rel=1e-6)


def check_solutions(found: dict[str, list[Any]], rows: Any) -> None:
    """Check the pose and velocity of the INS: over a second, the body moves as its velocity says."""
    odometry = found["/gnss/rover/odometry"]
    assert len(odometry) == len(found["/tf"]) == len(found["/gnss/rover/ins_fix"]) == len(rows)
    for one, row in ((odometry[0], rows[0]), (odometry[900], rows[900])):
        velocity = rotation(one.pose.pose.orientation).apply(vector(one.twist.twist.linear))
        north, east, down = row["velocity_l"]
        assert velocity == pytest.approx([east, north, -down], abs=0.02)  # the level turns by 1e-4 over 700 m
        yaw, pitch, roll = rotation(one.pose.pose.orientation).as_euler("ZYX")
        assert (roll, -pitch) == pytest.approx((row["roll_rad"], row["pitch_rad"]), abs=2e-4)
        assert np.pi / 2 - yaw == pytest.approx(row["heading_rad"], abs=2e-4)
    places = np.array([vector(one.pose.pose.position) for one in odometry])
    [moved] = found["/tf"][900].transforms
    assert (moved.header.frame_id, moved.child_frame_id) == ("local", "base_link")
    assert vector(moved.transform.translation) == places[900].tolist()
    seconds = (rows["gps_ns"][900] - rows["gps_ns"][500]) * 1e-9
    mean = rows["velocity_l"][500:900, 1].mean()
    assert (places[900, 0] - places[500, 0]) / seconds == pytest.approx(mean, abs=0.5)


@pytest.mark.slow
def test_a_bag_of_standard_messages_has_the_records_of_the_log(flown: Flown, tmp_path: Path) -> None:
    logs = str(flown.folder / "logs")
    done = run("export", logs, str(tmp_path / "out"), "--ros2", "--json")
    assert done.returncode == 0, done.stderr
    [session] = json.loads(done.stdout)["sessions"]
    folder = Path(session["folder"])
    assert (folder / "metadata.yaml").is_file()
    found: dict[str, list[Any]] = defaultdict(list)
    for topic, _, message in messages_of(folder / f"{folder.name}.mcap"):
        found[topic].append(message)
    assert {topic: len(messages) for topic, messages in found.items()} == session["messages"]
    log = swath.open(logs)
    fixes = log["gnss/rover"].fixes()
    fixes = fixes[np.isfinite(fixes["lat_rad"])]
    given = found["/gnss/rover/fix"]
    assert [stamp_ns(one) for one in given] == (fixes["gps_ns"] + GPS_UNIX_NS).tolist()
    assert [one.latitude for one in given] == pytest.approx(np.degrees(fixes["lat_rad"]), abs=1e-12)
    assert [one.altitude for one in given] == pytest.approx(fixes["height_m"])
    samples = log["imu/main"].samples()
    given = found["/imu/main/data_raw"]
    assert [stamp_ns(one) for one in given] == (samples["gps_ns"] + GPS_UNIX_NS).tolist()
    assert [one.linear_acceleration.z for one in given] == samples["specific_force_b"][:, 2].tolist()
    assert [one.angular_velocity.x for one in given] == samples["angular_rate_b"][:, 0].tolist()
    assert given[0].header.frame_id == "imu_main"
    assert given[0].orientation_covariance[0] == -1.0
    check_heading(found["/gnss/rover/heading"][5], log["gnss/rover"].headings()[5])
    check_solutions(found, log["gnss/rover"].solutions())
    [mounts] = found["/tf_static"]
    [mount] = mounts.transforms
    assert (mount.header.frame_id, mount.child_frame_id) == ("base_link", "scanner_left")
    forward, right, down = flown.config.scanner["left"].lever_arm_m
    assert vector(mount.transform.translation) == [forward, -right, -down]
    installed = Rotation.from_matrix(np.array(flown.config.scanner["left"].installation))
    assert (FLU * installed * rotation(mount.transform.rotation).inv()).magnitude() == pytest.approx(0.0, abs=1e-9)
    [status, *_] = found["/diagnostics"][0].status
    assert (status.name, status.level) == ("scanner/left: srep", 0)
    assert {one.key: one.value for one in status.values}["prf_hz"] == "1000.0"
    [first, *_] = found["/gnss/rover/time"]
    assert abs(first.time_ref.sec - stamp_ns(first) * 1e-9) < 2.0
    clouds = found["/scanner/left/points"]
    points = [np.frombuffer(bytes(cloud.data), POINT_DTYPE) for cloud in clouds]
    returns = np.concatenate(list(log["scanner/left"].returns()))
    table = np.concatenate(points)
    ranges = np.sqrt(sum(table[axis].astype(float) ** 2 for axis in "xyz"))
    assert len(table) == len(returns)
    assert ranges == pytest.approx(returns["range_m"], abs=2e-4)
    after = [np.round(part["time"].astype(float) * 1e9).astype(np.int64) for part in points]
    stamps = np.concatenate([stamp_ns(cloud) + part for cloud, part in zip(clouds, after, strict=True)])
    assert np.abs(stamps - returns["gps_ns"] - GPS_UNIX_NS).max() < 20
    assert max(float(part["time"].max()) for part in points) <= 0.1
    again = run("export", logs, str(tmp_path / "out"), "--ros2")
    assert (again.returncode, again.stderr.count("\n")) == (2, 1)
    assert "already exists; choose another folder or use --overwrite" in again.stderr
    assert run("export", logs, str(tmp_path / "out"), "--ros2", "--overwrite").returncode == 0


def test_a_fix_has_its_covariance_east_north_up() -> None:
    """By hand: sensor_msgs/NavSatFix has rows of east, north, up; of a table they are north, east, down."""
    row = np.zeros(1, FIX_TABLE)[0]
    row["position_cov_l"] = [[1.0, 0.5, 0.3], [0.5, 4.0, 0.2], [0.3, 0.2, 9.0]]
    row["valid"], row["fix_type"] = True, FixType.RTK_FIXED
    message = fix_message(row, 1_800_000_000_000_000_005, "gnss_rover")
    want = [4.0, 0.5, -0.2, 0.5, 1.0, -0.3, -0.2, -0.3, 9.0]
    assert message.position_covariance.tolist() == want
    assert (message.position_covariance_type, message.status.status) == (3, 2)
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (1_800_000_000, 5)
    row["position_cov_l"], row["valid"] = np.nan, False
    message = fix_message(row, 0, "gnss_rover")
    assert message.position_covariance.tolist() == [0.0] * 9
    assert (message.position_covariance_type, message.status.status) == (0, -1)


def test_a_cloud_has_places_and_times_of_its_points() -> None:
    rows = np.zeros(2, RETURN_TABLE)
    rows["intensity"] = 7.0, 8.0
    times = np.array([1_800_000_000_000_000_000, 1_800_000_000_050_000_000])
    cloud = point_cloud(np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]), rows, times, "scanner_left")
    assert (cloud.width, cloud.height, cloud.point_step, cloud.row_step) == (2, 1, 20, 40)
    assert [(field.name, field.offset) for field in cloud.fields] == [
        *(("x", 0), ("y", 4), ("z", 8), ("intensity", 12), ("time", 16))
    ]
    assert cloud.data.view("<f4").tolist() == pytest.approx([1, 2, 3, 7, 0, 4, 5, 6, 8, 0.05])
