"""Tests ``live.mcap`` and exported records with the reader of Foxglove's viewer (@mcap/core) and published schemas."""

from __future__ import annotations

import json
import shutil
import struct
import subprocess
import sys
from base64 import b64decode
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

pytestmark = [pytest.mark.peers, pytest.mark.xdist_group("kernels")]

HERE = Path(__file__).parent
SCHEMAS = {
    "/points/left": "foxglove.PointCloud",
    "/position": "foxglove.LocationFix",
    "/pose": "foxglove.PoseInFrame",
    "/tf": "foxglove.FrameTransform",
    "/coverage": "foxglove.Grid",
    "/status": "foxglove.Log",
}


def swath(*arguments: str | Path) -> str:
    """Run a command that must succeed; return its output."""
    command = [sys.executable, "-m", "swath.daemon.cli.main", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=200, check=False, cwd=HERE.parents[1])
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a live run over the beginning of a virtual flight."""
    folder = tmp_path_factory.mktemp("foxglove")
    swath("sim", "fly", "small", "--seconds", "14", "-o", folder / "flight")
    swath("live", "--replay", folder / "flight", "-o", folder / "live", "--json", "--accept-verdict")
    return folder / "live"


@pytest.fixture(scope="module")
def read(live: Path) -> dict[str, Any]:
    """Return what Foxglove's libraries read from ``live.mcap``."""
    return read_file(live / "live.mcap")


def read_file(path: Path) -> dict[str, Any]:
    """Return what Foxglove's libraries read from a file."""
    node = shutil.which("node")
    assert node, "there is no node: apt-get install nodejs npm"
    assert (HERE / "node_modules/@mcap/core").is_dir(), f"no @mcap/core: npm install --prefix {HERE}"
    command = [node, str(HERE / "read_with_foxglove.mjs"), str(path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def test_every_topic_has_the_published_foxglove_schema(read: dict[str, Any]) -> None:
    assert {topic: found["schema"] for topic, found in read["topics"].items()} == SCHEMAS
    for topic, found in read["topics"].items():
        assert found["encoding"] == "protobuf"
        assert found["fields"], topic
        assert found["fields"] == found["published"], topic


def test_all_messages_and_points_are_present(live: Path, read: dict[str, Any]) -> None:
    with (live / "live.mcap").open("rb") as file:
        written = Counter(channel.topic for _, channel, _ in make_reader(file).iter_messages())
    assert {topic: found["messages"] for topic, found in read["topics"].items()} == written
    status = json.loads((live / "live.json").read_text())
    assert read["topics"]["/points/left"]["points"] == status["live_mcap"]["points_written"] > 0


def test_a_cloud_lies_below_the_aircraft_in_the_local_frame(read: dict[str, Any]) -> None:
    """Everything is in the frame ``local``: points are below the body, and the position in degrees is the pose's."""
    topics, metadata = read["topics"], read["metadata"]["swath.live"]
    cloud, pose, fix = (topics[name]["first"] for name in ("/points/left", "/pose", "/position"))
    assert cloud["frame_id"] == pose["frame_id"] == topics["/tf"]["first"]["parent_frame_id"] == "local"
    assert [field["name"] for field in cloud["fields"]] == ["x", "y", "z", "intensity"]
    x, y, z, _ = struct.unpack("<4f", b64decode(cloud["data"])[:16])
    at = pose["pose"]["position"]
    assert z < at["z"]
    assert abs(x - at["x"]) + abs(y - at["y"]) < 2000.0
    assert -90.0 < fix["latitude"] < 90.0
    assert fix["latitude"] != 0.0
    assert metadata["origin"]


def test_exported_records_are_read(live: Path, tmp_path: Path) -> None:
    """Foxglove's own schemas are its published ones; a row of a table has the schema in the file, with all fields."""
    swath("export", live.parent / "flight", tmp_path, "--records", "mcap")
    [path] = tmp_path.glob("*/*.mcap")
    with path.open("rb") as file:
        written = Counter(channel.topic for _, channel, _ in make_reader(file).iter_messages())
    topics = read_file(path)["topics"]
    assert {topic: found["messages"] for topic, found in topics.items()} == written
    schemas = {topic: found["schema"] for topic, found in topics.items()}
    named = {name for name in schemas.values() if name.startswith("foxglove.")}
    assert named == {*SCHEMAS.values()} - {"foxglove.Grid"}
    for topic, found in topics.items():
        assert found["fields"] == found["published"] or schemas[topic].startswith("swath."), topic
    sample = topics["/imu/main/samples"]["first"]
    assert -12.0 < sample["specific_force_z_mps2"] < -7.0
    assert int(sample["gps_ns"]) > 1_400_000_000_000_000_000
