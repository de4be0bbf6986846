"""Tests decoded messages of bags: every type becomes records with the right axes, covariances and times."""

from __future__ import annotations

import gzip
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag1 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from swath.drivers.captures.base import CapturedUnit, CaptureTally
from swath.drivers.captures.opening import read_bag
from swath.drivers.driver import find_driver
from swath.drivers.parser import DeviceKind, DeviceSettings
from swath.drivers.record_frames import Scale, decode_rows, gps_from_posix
from swath.georef.records import Chunk, FixType, GnssFix, ImuSamples, InsSolution, ScannerReturns
from tests.drivers.captures.bags import (
    CONTAINERS,
    START_NS,
    Container,
    Message,
    Ros,
    cloud_message,
    custom_message,
    fix_message,
    imu_message,
    write_bag,
)
from tests.drivers.recordings import FIXTURES

IMU, FIX, CLOUD = "sensor_msgs/msg/Imu", "sensor_msgs/msg/NavSatFix", "sensor_msgs/msg/PointCloud2"
LATE_NS = 37_000_000  # of the bag's times behind the stamps


def read(folder: Path, container: Container, messages: list[tuple[str, Any]], tally: CaptureTally | None = None) -> Any:
    """Return the units of messages of one topic."""
    told: list[Message] = [("/x", kind, START_NS + LATE_NS, message) for kind, message in messages]
    return list(read_bag(write_bag(folder / "bag", container, told), ["/x"], tally))


def records(units: list[CapturedUnit], kind: DeviceKind, **config: Any) -> list[Any]:
    """Return the records of units, as the driver reads them."""
    parser = find_driver(kind, "records").make_parser(DeviceSettings(f"{kind}/x", config))
    return [one for unit in units for one in parser.feed(Chunk(f"{kind}/x", unit.time_ns, unit.data))]


def gps_ns() -> int:
    return int(gps_from_posix(np.array([START_NS]))[0])


@pytest.mark.parametrize("container", CONTAINERS)
def test_samples_keep_their_axes(tmp_path: Path, container: Container) -> None:
    """At rest an upright unit reads +g along z, as REP 145 wants and the specific force is defined."""
    ros = Ros(container)
    messages = [(IMU, imu_message(ros, START_NS + n, (0.5, -0.25, 9.75), (0.1, 0.2, -0.3))) for n in (0, 10)]
    messages.append((IMU, imu_message(ros, START_NS, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), -1.0)))  # an attitude alone
    messages.append((IMU, imu_message(ros, START_NS, (0.0, 0.0, 0.5), (0.0, 0.0, 0.0), -1.0)))  # NovAtel marks all
    units = read(tmp_path, container, messages)
    assert [unit.time_ns for unit in units] == [START_NS + LATE_NS] * 3
    first, second, _ = records(units, "imu")
    assert isinstance(first, ImuSamples)
    assert first.rows["specific_force_b"][0].tolist() == [0.5, -0.25, 9.75]
    assert first.rows["angular_rate_b"][0].tolist() == [0.1, 0.2, -0.3]
    assert first.rows["time_sigma_s"][0] == np.float32(0.1)
    week_ns = 604_800_000_000_000
    assert int(first.rows["gps_week"][0]) * week_ns + first.rows["device_time_ns"][0] == gps_ns()
    assert second.rows["device_time_ns"][0] - first.rows["device_time_ns"][0] == 10
    [scaled, *_] = records(units, "imu", acceleration_unit="g")
    np.testing.assert_allclose(scaled.rows["specific_force_b"][0], np.array([0.5, -0.25, 9.75]) * 9.80665)


def test_a_covariance_east_north_up_becomes_north_east_down(tmp_path: Path) -> None:
    """Each number is distinct, so that a wrong place or sign shows."""
    ros = Ros("mcap")
    enu = np.array([4.0, 0.5, -0.25, 0.5, 9.0, 0.125, -0.25, 0.125, 16.0])
    place = (47.5, -8.25, 512.5)
    messages = [
        fix_message(ros, START_NS, place, 2, position_covariance=enu, position_covariance_type=3),
        fix_message(ros, START_NS, place, -1),
        fix_message(ros, START_NS, place, 0, position_covariance=enu, position_covariance_type=0),
    ]
    found = records(read(tmp_path, "mcap", [(FIX, one) for one in messages]), "gnss")
    good, none, single = (one for one in found if isinstance(one, GnssFix))
    assert (good.lat_rad, good.lon_rad, good.height_m) == (math.radians(47.5), math.radians(-8.25), 512.5)
    assert good.position_cov_l is not None
    np.testing.assert_array_equal(good.position_cov_l, [[9.0, 0.5, -0.125], [0.5, 4.0, 0.25], [-0.125, 0.25, 16.0]])
    assert (good.fix_type, none.fix_type, single.fix_type) == (FixType.DIFFERENTIAL, FixType.NONE, FixType.SINGLE)
    assert (good.valid, none.valid) == (True, False)
    assert single.position_cov_l is None
    assert good.velocity_l is None


def test_attitude_and_velocity_are_those_of_novatels_own_log(tmp_path: Path) -> None:
    """NovAtel's driver made /odom (east, north, up) of INSPVA (roll, pitch, azimuth), which the bag has too."""
    bag = tmp_path / "bestpos.bag"
    bag.write_bytes(gzip.decompress((FIXTURES / "novatel" / "bestpos.bag.gz").read_bytes()))
    store = get_typestore(Stores.ROS1_NOETIC)
    own: list[Any] = []
    with Reader(bag) as reader:
        for one in reader.connections:
            types = get_types_from_msg(one.msgdef.data, one.msgtype)
            store.register({name: fields for name, fields in types.items() if name not in store.fielddefs})
        for one, _, data in reader.messages():
            if one.topic.endswith("inspva"):
                own.append(store.deserialize_ros1(data, one.msgtype))
    solutions = records(list(read_bag(bag, ["/novatel/oem7/odom"])), "imu")
    assert len(solutions) == 12
    for one in solutions:
        assert isinstance(one, InsSolution)
        [row] = one.rows
        angles = np.degrees([row["roll_rad"], row["pitch_rad"], row["heading_rad"]])
        velocity = row["velocity_l"] * (1.0, 1.0, -1.0)
        apart = [
            max(
                np.abs((angles - (log.roll, log.pitch, log.azimuth) + 180.0) % 360.0 - 180.0).max(),
                np.abs(velocity - (log.north_velocity, log.east_velocity, log.up_velocity)).max(),
            )
            for log in own
        ]
        assert min(apart) < 1e-5
        assert np.isnan(row["lat_rad"])


def test_a_gps_fix_has_its_velocity_too(tmp_path: Path) -> None:
    """Track counts from north; the errors of speed and climb are those of 95 %, twice the sigma."""
    ros = Ros("bag")
    numbers = dict.fromkeys(
        (
            *("pitch", "roll", "dip", "time", "gdop", "pdop", "hdop", "vdop", "tdop", "err", "err_horz", "err_vert"),
            *("err_track", "err_time", "err_pitch", "err_roll", "err_dip"),
        ),
        0.0,
    )
    empty = np.empty(0, np.int32)
    arrays = ("satellite_used_prn", *(f"satellite_visible_{name}" for name in ("prn", "z", "azimuth", "snr")))
    status = ros.make(
        "gps_common/msg/GPSStatus",
        header=ros.header(0),
        satellites_used=11,
        satellites_visible=12,
        status=18,
        motion_source=0,
        orientation_source=0,
        position_source=0,
        **dict.fromkeys(arrays, empty),
    )
    message = ros.make(
        "gps_common/msg/GPSFix",
        header=ros.header(START_NS),
        status=status,
        latitude=1.0,
        longitude=2.0,
        altitude=3.0,
        track=90.0,
        speed=20.0,
        climb=2.0,
        err_speed=0.2,
        err_climb=0.4,
        position_covariance=np.diag([1.0, 4.0, 9.0]).reshape(9),
        position_covariance_type=2,
        **numbers,
    )
    found = records(read(tmp_path, "bag", [("gps_common/msg/GPSFix", message)]), "gnss")
    [fix] = [one for one in found if isinstance(one, GnssFix)]
    np.testing.assert_allclose(fix.velocity_l or (), (0.0, 20.0, -2.0), atol=1e-12)
    assert fix.velocity_cov_l is not None
    np.testing.assert_allclose(np.diag(fix.velocity_cov_l), [0.01, 0.01, 0.04])
    assert fix.position_cov_l is not None
    assert np.diag(fix.position_cov_l).tolist() == [4.0, 1.0, 9.0]
    assert (fix.satellites, fix.fix_type) == (11, FixType.DIFFERENTIAL)


XYZ: list[Any] = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]
START_S = START_NS / 1e9
DRIVERS: dict[str, tuple[Any, list[float], float]] = {  # fields; times; their tolerance, ns
    "velodyne": ([*XYZ, ("intensity", "<f4"), ("ring", "<u2"), ("time", "<f4")], [-0.05, 0.0, 0.05], 2.0),
    "ouster": (
        {
            "names": ["x", "y", "z", "intensity", "t", "ring"],
            "formats": ["<f4", "<f4", "<f4", "<f4", "<u4", "<u2"],
            "offsets": [0, 4, 8, 16, 20, 26],
            "itemsize": 48,
        },
        [0, 50_000_000, 99_999_999],
        0.0,
    ),
    "hesai": ([*XYZ, ("intensity", "<f4"), ("timestamp", "<f8"), ("ring", "<u2")], [START_S, START_S + 0.05], 130.0),
    "livox": ([*XYZ, ("tag", "u1"), ("line", "u1"), ("timestamp", "<f8")], [START_NS, START_NS + 1e8], 130.0),
    "nebula": (
        [*XYZ, ("intensity", "u1"), ("return_type", "u1"), ("channel", "<u2"), ("time_stamp", "<u4")],
        [7, 9],
        0,
    ),
    "big-endian": ([(name, ">f4") for name in ("x", "y", "z", "time")], [0.0, 0.25], 0.0),
}


@pytest.mark.parametrize("driver", DRIVERS)
def test_points_of_the_usual_drivers_have_their_times(tmp_path: Path, driver: str) -> None:
    fields, times, tolerance_ns = DRIVERS[driver]
    dtype: Any = np.dtype(fields)
    points = np.zeros(len(times), dtype)
    points["x"], points["y"], points["z"] = 3.0, -4.0, 12.0
    name = next(one for one in dtype.names if one.startswith("t") and one != "tag")
    points[name] = times
    for channel in {"ring", "line", "channel"} & set(dtype.names):
        points[channel] = np.arange(len(times)) + 1
    ros = Ros("mcap")
    found = records(read(tmp_path, "mcap", [(CLOUD, cloud_message(ros, START_NS, points))]), "scanner")
    [returns] = [one for one in found if isinstance(one, ScannerReturns)]
    scale = {"hesai": (1e9, 0), "livox": (1.0, 0), "velodyne": (1e9, START_NS), "big-endian": (1e9, START_NS)}
    factor, origin_ns = scale.get(driver, (1.0, START_NS))
    expected = [origin_ns + round(one * factor) for one in points[name].tolist()]
    assert np.abs(returns.rows["device_time_ns"] - np.array(expected)).max() <= tolerance_ns
    assert returns.rows["range_m"].tolist() == [13.0] * len(times)
    assert returns.rows["encoder_rad"].tolist() == [math.atan2(-4.0, 3.0)] * len(times)
    if "big" not in driver:
        assert returns.rows["channel"].tolist() == list(range(1, len(times) + 1))


def test_organised_clouds_with_gaps_are_read_in_order_of_time(tmp_path: Path) -> None:
    """Rows may be padded; points without a place, NaN or in the origin, are pulses without a return."""
    points = np.zeros((2, 3), [*XYZ, ("t", "<u4")])
    points["x"] = [[1.0, np.nan, 3.0], [4.0, 0.0, 6.0]]
    points["t"] = [[10, 30, 50], [20, 40, 60]]
    ros = Ros("mcap")
    data = b"".join(row.tobytes() + b"\xee" * 5 for row in points)
    message = cloud_message(ros, START_NS, points, row_step=3 * 16 + 5, data=np.frombuffer(data, np.uint8))
    found = records(read(tmp_path, "mcap", [(CLOUD, message)]), "scanner")
    [returns] = [one for one in found if isinstance(one, ScannerReturns)]
    assert returns.rows["range_m"].tolist() == [1.0, 4.0, 3.0, 6.0]
    assert (returns.rows["device_time_ns"] - START_NS).tolist() == [10, 20, 50, 60]


@pytest.mark.parametrize(
    ("dtype", "fields", "words"),
    [
        (XYZ, {}, "has no time of each point (fields x, y, z), so the motion cannot be taken into account"),
        ([*XYZ[:2], ("t", "<u4")], {}, "has the fields x, y, t, no x, y, z"),
        ([*XYZ, ("t", "<u4")], {"width": 9}, "bytes for 1 rows of 9 points of 16 bytes"),
        ([*XYZ, ("t", "<u4")], {"point_step": 12}, "has a field beyond its point of 12 bytes"),
        ([*XYZ, ("t", "u1")], {}, "has times t of 1 bytes; want nanoseconds"),
        ([*XYZ, ("time", "<f4")], {"offset": 60.0}, "has points 60 s from its stamp"),
    ],
)
def test_clouds_that_cannot_be_used_are_damage(tmp_path: Path, dtype: Any, fields: dict[str, Any], words: str) -> None:
    points = np.ones(2, dtype)
    if "offset" in fields:
        points["time"] = fields["offset"]
    tally = CaptureTally()
    given = {name: value for name, value in fields.items() if name != "offset"}
    message = cloud_message(Ros("mcap"), START_NS, points, **given)
    assert read(tmp_path, "mcap", [(CLOUD, message)], tally) == []
    assert tally.damage == 1
    assert words in tally.first_damage


@pytest.mark.parametrize("container", CONTAINERS)
@pytest.mark.parametrize("package", ["livox_ros_driver", "livox_ros_driver2"])
def test_livox_points_are_read_by_their_layout(tmp_path: Path, container: Container, package: str) -> None:
    """The messages are serialised by rosbags; a frame's name of any length moves what follows."""
    ros = Ros(container)
    points = [(0, 1.0, 2.0, 2.0, 200, 16, 3), (41, 0.0, 0.0, 0.0, 0, 0, 0), (1000, -2.0, 4.0, -4.0, 9, 0, 5)]
    units = read(tmp_path, container, [(f"{package}/msg/CustomMsg", custom_message(ros, START_NS, points, package))])
    [returns] = [one for one in records(units, "scanner") if isinstance(one, ScannerReturns)]
    assert returns.rows["range_m"].tolist() == [3.0, 6.0]
    assert (returns.rows["device_time_ns"] - START_NS).tolist() == [0, 1000]
    assert returns.rows["intensity"].tolist() == [200.0, 9.0]
    assert returns.rows["channel"].tolist() == [3, 5]


def test_stamps_before_2001_are_a_counter(tmp_path: Path) -> None:
    """A simulator's clock begins at 0. A fix then has the bag's time; a stamp of 0 says nothing."""
    ros = Ros("mcap")
    samples = [(IMU, imu_message(ros, stamp_ns, (0.0, 0.0, 9.8), (0.0, 0.0, 0.0))) for stamp_ns in (0, 7_000_000_000)]
    units = read(tmp_path, "mcap", samples)
    assert [found[1] for unit in units if not isinstance(found := decode_rows(unit.data), str)] == [Scale.COUNTER] * 2
    first, second = records(units, "imu")
    assert (first.rows["device_time_ns"][0], second.rows["device_time_ns"][0]) == (-1, 7_000_000_000)
    assert second.rows["gps_week"][0] == -1
    units = read(tmp_path / "fix", "mcap", [(FIX, fix_message(ros, 5_000_000_000, (47.0, 8.0, 500.0)))])
    [fix] = [one for one in records(units, "gnss") if isinstance(one, GnssFix)]
    assert (fix.time.week or 0) * 604_800_000_000_000 + fix.time.time_ns == gps_ns() + LATE_NS
