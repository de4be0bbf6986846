"""Tests ``swath export --records mcap`` by the decoder of mcap-protobuf-support and the schemas in the file."""

from __future__ import annotations

import json
from collections import defaultdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from pyproj import Transformer
from scipy.spatial.transform import Rotation

import swath as library
from swath.daemon.processing.records.mcap import POINT_DTYPE, location_fix, row_type
from swath.daemon.processing.records.tables import FIX_TABLE
from tests.daemon.commands import swath
from tests.daemon.short_flight import Flown
from tests.library.builders import fly

GPS_UNIX_NS = (315_964_800 - 18) * 10**9  # POSIX time of the GPS epoch, less the leap seconds since 2017
MOUNTED = ("/tf", "scanner_left")


class Decoded(NamedTuple):
    """A message with its schema and time."""

    schema: str
    time_ns: int
    values: Any


def messages_of(path: Path) -> dict[str, list[Decoded]]:
    """Return the messages by topic; transforms by topic and child too."""
    found: dict[Any, list[Decoded]] = defaultdict(list)
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for schema, channel, message, values in reader.iter_decoded_messages():
            assert schema is not None
            one = Decoded(schema.name, message.log_time, values)
            found[channel.topic].append(one)
            if channel.topic == "/tf":
                found[channel.topic, values.child_frame_id].append(one)
    return found


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    """Return the begin of a flight, with pulses on the ground."""
    return fly(tmp_path_factory.mktemp("mcap"), seconds=14.0)


@pytest.fixture(scope="module")
def found(flown: Flown) -> dict[Any, list[Decoded]]:
    done = swath("export", str(flown.folder / "logs"), str(flown.folder / "out"), "--records", "mcap", "--json")
    assert done.returncode == 0, done.stderr
    (session,) = json.loads(done.stdout)["sessions"]
    (path,) = Path(session["folder"]).iterdir()
    assert path.name == f"{path.parent.name}.mcap"
    messages = messages_of(path)
    assert {topic: len(one) for topic, one in messages.items() if isinstance(topic, str)} == session["rows"]
    return messages


def vector(values: Any) -> list[float]:
    return [values.x, values.y, values.z]


def rotations(quaternions: list[Any]) -> Rotation:
    return Rotation.from_quat([[q.x, q.y, q.z, q.w] for q in quaternions])


@pytest.mark.slow
class TestFile:
    def test_a_message_for_each_row_has_all_columns_of_the_tables(
        self, flown: Flown, found: dict[Any, list[Decoded]]
    ) -> None:
        log = library.open(flown.folder / "logs")
        for source, kinds in {
            "gnss/rover": ("fixes", "headings", "marks", "times", "solutions"),
            "imu/main": ("samples",),
        }.items():
            for kind in kinds:
                given = found[f"/{source}/{kind}"]
                frame = log.to_pandas(source, kind).reset_index().sort_values("gps_ns", kind="stable")
                assert len(given) == len(frame) > 5
                assert [one.time_ns for one in given] == (frame["gps_ns"] + GPS_UNIX_NS).tolist()
                for name in frame.columns:
                    column = [getattr(one.values, name) for one in given]
                    np.testing.assert_array_equal(column, frame[name].to_numpy(), err_msg=f"{kind} {name}")
        status = [one.values for one in found["/scanner/left/status/srep"]]
        rows = log["scanner/left"].status()
        assert [one.prf_hz for one in status] == [row["prf_hz"] for row in rows["values"]] == [1000] * len(rows)
        assert [one.pps_locked for one in status] == [row["pps_locked"] for row in rows["values"]]
        assert [one.gps_ns for one in status] == rows["gps_ns"].tolist()

    def test_positions_events_and_poses_have_the_schemas_of_foxglove(
        self, flown: Flown, found: dict[Any, list[Decoded]]
    ) -> None:
        """PROJ computes the places east, north, up; the attitude is that of roll, pitch, heading by SciPy."""
        log = library.open(flown.folder / "logs")
        fixes = log["gnss/rover"].fixes()
        fixes = fixes[np.isfinite(fixes["lat_rad"])]
        given = found["/gnss/rover/position"]
        assert given[0].schema == "foxglove.LocationFix"
        assert [one.values.latitude for one in given] == pytest.approx(np.degrees(fixes["lat_rad"]), abs=1e-12)
        assert [one.values.longitude for one in given] == pytest.approx(np.degrees(fixes["lon_rad"]), abs=1e-12)
        solutions = log["gnss/rover"].solutions()
        poses = [one.values.pose for one in found["/gnss/rover/pose"]]
        lon, lat, height = np.degrees(solutions["lon_rad"]), np.degrees(solutions["lat_rad"]), solutions["height_m"]
        local = Transformer.from_pipeline(
            "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
            f"+step +proj=topocentric +ellps=WGS84 +lat_0={lat[0]} +lon_0={lon[0]} +h_0={height[0]}"
        )
        places = np.stack(local.transform(lon, lat, height), axis=-1)
        np.testing.assert_allclose([vector(pose.position) for pose in poses], places, atol=1e-6)
        angles = np.stack([solutions[f"{name}_rad"] for name in ("heading", "pitch", "roll")], axis=-1)
        ned = Rotation.from_euler("ZYX", angles)
        enu = Rotation.from_matrix([[0, 1, 0], [1, 0, 0], [0, 0, -1]]) * ned
        turned = (rotations([pose.orientation for pose in poses]).inv() * enu).magnitude()
        assert turned.max() < 2e-4  # over 700 m, down turns by 1.1e-4 and north by 1.2e-4
        event = found["/events"][0]
        assert (event.schema, event.values.name) == ("foxglove.Log", "recorder")
        assert event.values.message.startswith("session_started: session library")

    def test_clouds_hold_the_returns_and_lie_on_the_ground(self, flown: Flown, found: dict[Any, list[Decoded]]) -> None:
        """By the transforms of the file, points are where georeferencing puts them, but for the motion in a cloud."""
        log = library.open(flown.folder / "logs")
        clouds = [one.values for one in found["/scanner/left/points"]]
        fields = {field.name: (field.offset, field.type) for field in clouds[0].fields}
        assert fields["time_ns"] == (16, 5)  # UINT32
        assert {name: place[0] for name, place in fields.items()} == {
            name: place[1] for name, place in (POINT_DTYPE.fields or {}).items()
        }
        parts = [np.frombuffer(cloud.data, POINT_DTYPE) for cloud in clouds]
        assert {cloud.point_stride for cloud in clouds} == {POINT_DTYPE.itemsize}
        points, returns = np.concatenate(parts), np.concatenate(list(log["scanner/left"].returns()))
        stamps = [
            cloud.timestamp.ToNanoseconds() + part["time_ns"].astype(np.int64)
            for cloud, part in zip(clouds, parts, strict=True)
        ]
        assert (np.concatenate(stamps) - GPS_UNIX_NS).tolist() == returns["gps_ns"].tolist()
        xyz = np.stack([points[axis].astype(float) for axis in "xyz"], axis=-1)
        assert np.linalg.norm(xyz, axis=1) == pytest.approx(returns["range_m"], abs=2e-4)
        for name in ("intensity", "time_sigma_s", "return_number", "flags"):
            np.testing.assert_allclose(points[name], returns[name], rtol=1e-6)
        mounted, moved = found["/tf", "scanner_left"], found["/tf", "body"]
        assert (mounted[0].values.parent_frame_id, moved[0].values.parent_frame_id) == ("body", "local")
        assert vector(mounted[0].values.translation) == flown.config.scanner["left"].lever_arm_m
        times = np.array([one.time_ns for one in moved])
        nearest = [moved[int(np.argmin(np.abs(times - cloud.timestamp.ToNanoseconds())))].values for cloud in clouds]
        mount = rotations([mounted[0].values.rotation])[0]
        ground = [
            rotations([body.rotation])[0].apply(mount.apply(points_s) + vector(mounted[0].values.translation))
            + vector(body.translation)
            for body, points_s in zip(
                nearest, np.split(xyz, np.cumsum([len(part) for part in parts])[:-1]), strict=True
            )
        ]
        origin = log["gnss/rover"].solutions()[0]
        truth = flown.folder / "left.true.toml"
        made = library.georeference(log, calibration=truth, crs="EPSG:32632").read()
        assert len(made) > 1000
        assert np.abs(returns["gps_ns"][: len(made)] - made["gps_ns"]).max() < 100
        to_local = Transformer.from_pipeline(
            "+proj=pipeline +step +inv +proj=utm +zone=32 +ellps=WGS84 +step +proj=cart +ellps=WGS84 "
            f"+step +proj=topocentric +ellps=WGS84 +lat_0={np.degrees(origin['lat_rad'])} "
            f"+lon_0={np.degrees(origin['lon_rad'])} +h_0={origin['height_m']}"
        )
        wanted = np.stack(to_local.transform(*made["xyz"].T), axis=-1)
        away = np.abs(np.concatenate(ground)[: len(made)] - wanted)
        assert (away.max(axis=0) < (6.0, 1.0, 1.0)).all()  # eastward at 50 m/s for 0.1 s, and turns of the body


def test_a_fix_has_its_covariance_east_north_up() -> None:
    """By hand, as in the test of ROS: rows of east, north, up; of a table they are north, east, down."""
    row = np.zeros(1, FIX_TABLE)[0]
    row["position_cov_l"] = [[1.0, 0.5, 0.3], [0.5, 4.0, 0.2], [0.3, 0.2, 9.0]]
    text = repr(location_fix(row, row["position_cov_l"], 1_800_000_000_000_000_005, "gnss_rover"))
    assert "[4.0, 0.5, -0.2, 0.5, 1.0, -0.3, -0.2, -0.3, 9.0]" in text
    assert "position_covariance_type=3" in text


def test_a_row_keeps_the_types_of_its_columns() -> None:
    columns = {
        "gps_ns": np.array([-1]),
        "text": np.array(["é"]),
        "flag": np.array([True]),
        "single": np.array([1.5], np.float32),
        "word": np.array([2**32 - 1], np.uint32),
        "small": np.array([-2], np.int16),
    }
    make, schema = row_type("Row", columns)
    row = make(**{name: column[0].item() for name, column in columns.items()})
    assert schema.name == "swath.Row"
    again = type(row).FromString(row.SerializeToString())
    assert (again.gps_ns, again.text, again.flag, again.single, again.word, again.small) == (
        *(-1, "é", True, 1.5, 2**32 - 1, -2),
    )
