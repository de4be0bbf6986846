"""What `swath live` writes for the eye: read back by others' readers, against numbers computed here."""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from numpy.typing import NDArray
from PIL import Image
from pyproj import CRS, Transformer
from scipy.spatial.transform import Rotation

from swath.daemon.config.tables import LiveConfig
from swath.daemon.processing.live.grid import TILE, CountGrid
from swath.daemon.processing.live.mcap import CLOUD_DTYPE, END_BYTES, NAME, PREVIOUS, LiveMcap
from swath.daemon.processing.live.products import IMAGE_CELLS, LiveProducts, Room, Thinning, picture
from swath.georef.points import Points
from swath.georef.timescales.gps_time import SECOND_NS
from swath.georef.trajectory.trajectory import Trajectory

pytestmark = pytest.mark.xdist_group("kernels")

GPS_NS = 1_465_549_200 * SECOND_NS
LAT_DEG, LON_DEG, HEIGHT_M = 47.5, 8.9, 800.0


class Utm:
    """A mapping frame by PROJ alone; UTM unless another CRS is asked for."""

    def __init__(self, crs: str = "EPSG:32632", unit_m: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> None:
        self._transformer = Transformer.from_crs("EPSG:4978", crs, always_xy=True)
        self.wkt = CRS.from_user_input(crs).to_wkt()
        self.unit_m = np.array(unit_m)

    def map_from_e(self, points_e: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.stack(self._transformer.transform(*points_e.T), axis=-1)


def flight(epochs: int = 11) -> Trajectory:
    """Return a level flight to the north-east at 60 m/s."""
    t = np.arange(epochs) * 0.1
    lat = np.radians(LAT_DEG) + 60.0 * np.sqrt(0.5) * t / 6_366_000
    zero = np.zeros(epochs)
    return Trajectory.from_geodetic(
        GPS_NS + (t * SECOND_NS).astype(np.int64),
        lat,
        np.full(epochs, np.radians(LON_DEG)),
        np.full(epochs, HEIGHT_M),
        np.tile([60.0, 0.0, 0.0], (epochs, 1)),
        zero,
        zero,
        np.full(epochs, np.radians(45.0)),
        position_sigma_l=np.tile([0.02, 0.03, 0.05], (epochs, 1)),
    )


def points_at(points_map: NDArray[np.float64], time_ns: NDArray[np.int64] | None = None) -> Points:
    n = len(points_map)
    single, byte = np.zeros(n, np.float32), np.ones(n, np.uint8)
    times = GPS_NS + np.arange(n, dtype=np.int64) if time_ns is None else time_ns
    intensity = np.arange(n, dtype=np.float32)
    return Points(times, points_map, None, single, single, intensity, byte, byte, np.zeros(n, np.uint16), byte)


# ---------------------------------------------------------------------- protobuf, by the schema in the file


def fields_of(data: bytes) -> Iterator[tuple[int, Any]]:
    """Field numbers and raw values of a message (protobuf encoding)."""
    at = 0

    def varint() -> int:
        nonlocal at
        value = shift = 0
        while True:
            byte = data[at]
            at += 1
            value |= (byte & 127) << shift
            shift += 7
            if byte < 128:
                return value

    while at < len(data):
        key = varint()
        kind = key & 7
        if kind == 0:
            yield key >> 3, varint()
            continue
        length = {1: 8, 5: 4}.get(kind) or varint()
        yield key >> 3, data[at : at + length]
        at += length


TYPE_DOUBLE, TYPE_STRING, TYPE_MESSAGE, TYPE_FIXED32 = 1, 9, 11, 7


class Schema:
    """A FileDescriptorSet: message types by full name, their fields by number."""

    def __init__(self, data: bytes) -> None:
        self.types: dict[str, dict[int, tuple[str, int, str, bool]]] = {}
        for _, file in fields_of(data):
            parts = list(fields_of(file))
            package = next((value.decode() for number, value in parts if number == 2), "")
            for number, value in parts:
                if number == 4:
                    self._learn(f".{package}", value)

    def _learn(self, scope: str, message: bytes) -> None:
        parts = list(fields_of(message))
        name = f"{scope}.{next(value.decode() for number, value in parts if number == 1)}"
        fields: dict[int, tuple[str, int, str, bool]] = {}
        for number, value in parts:
            if number == 2:
                field = dict(fields_of(value))
                type_name = field.get(6, b"").decode()
                fields[field[3]] = (field[1].decode(), field[5], type_name, field.get(4) == 3)
            elif number == 3:
                self._learn(name, value)
        self.types[name] = fields

    def decode(self, name: str, data: bytes) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for number, value in fields_of(data):
            key, kind, type_name, repeated = self.types[name][number]
            if kind == TYPE_MESSAGE:
                value = self.decode(type_name, value)
            elif kind == TYPE_DOUBLE:
                values = list(struct.unpack(f"<{len(value) // 8}d", value))
                value = values if repeated else values[0]
                if repeated:
                    found[key] = values
                    continue
            elif kind == TYPE_FIXED32:
                value = struct.unpack("<I", value)[0]
            elif kind == TYPE_STRING:
                value = value.decode()
            if repeated:
                found.setdefault(key, []).append(value)
            else:
                found[key] = value
        return found


def read_back(path: Path) -> dict[str, list[dict[str, Any]]]:
    """Messages by topic, each decoded by the schema that the file holds for its channel."""
    found: dict[str, list[dict[str, Any]]] = {}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            assert schema is not None
            assert (schema.encoding, channel.message_encoding) == ("protobuf", "protobuf")
            decoded = Schema(schema.data).decode(f".{schema.name}", message.data)
            found.setdefault(channel.topic, []).append(decoded | {"schema": schema.name, "log_time": message.log_time})
    return found


class TestMcap:
    def test_clouds_positions_and_poses_are_read_back_by_their_schemas(self, tmp_path: Path) -> None:
        trajectory = flight()
        products = LiveProducts(tmp_path, LiveConfig(), Utm(), 0, "EPSG:32632")
        products.look_for_room()
        position = Utm().map_from_e(trajectory.position_e)[-1]
        ground = position + np.random.default_rng(1).uniform(-400, 400, (5000, 3))
        products.begin(trajectory)
        products.take("left", points_at(ground), trajectory, 77 * SECOND_NS)
        products.take_pose(trajectory, 78 * SECOND_NS)
        products.close()
        assert products.trouble == ""
        found = read_back(tmp_path / NAME)
        assert {topic: messages[0]["schema"] for topic, messages in found.items()} == {
            "/points/left": "foxglove.PointCloud",
            "/position": "foxglove.LocationFix",
            "/pose": "foxglove.PoseInFrame",
            "/tf": "foxglove.FrameTransform",
        }
        [cloud] = found["/points/left"]
        assert (cloud["frame_id"], cloud["point_stride"], cloud["log_time"]) == ("local", 16, 77 * SECOND_NS)
        assert cloud["timestamp"]["seconds"] == GPS_NS // SECOND_NS + 315_964_800 - 18
        assert [(one["name"], one.get("offset", 0), one["type"]) for one in cloud["fields"]] == [
            ("x", 0, 7),
            ("y", 4, 7),
            ("z", 8, 7),
            ("intensity", 12, 7),
        ]
        assert products.frame is not None
        rows = np.frombuffer(cloud["data"], CLOUD_DTYPE)
        kept = rows["intensity"].astype(int)
        local = np.stack([rows["x"], rows["y"], rows["z"]], axis=-1)
        np.testing.assert_allclose(local + products.frame.origin, ground[kept], rtol=0, atol=2e-4)
        assert np.abs(local).max() < 1000, "single precision is for what is near"
        [fix] = found["/position"]
        assert fix["latitude"] == pytest.approx(np.degrees(trajectory.geodetic()[0][-1]), abs=1e-9)
        assert fix["longitude"] == pytest.approx(LON_DEG, abs=1e-9)
        assert fix["altitude"] == pytest.approx(HEIGHT_M, abs=1e-6)
        assert fix["position_covariance"] == pytest.approx([0.03**2, 0, 0, 0, 0.02**2, 0, 0, 0, 0.05**2])
        [pose] = found["/pose"]
        place = [pose["pose"]["position"].get(axis, 0.0) for axis in "xyz"]
        np.testing.assert_allclose(place + products.frame.origin, position, rtol=0, atol=1e-6)
        turned = Rotation.from_quat([pose["pose"]["orientation"].get(axis, 0.0) for axis in "xyzw"])
        # heading 45° from true north; grid north lies east or west of it by the convergence, dλ sin φ (Snyder 8)
        convergence = np.radians(LON_DEG - 9.0) * np.sin(np.radians(LAT_DEG))
        heading = np.radians(45.0) - convergence
        np.testing.assert_allclose(turned.apply([1, 0, 0]), [np.sin(heading), np.cos(heading), 0], atol=1e-5)
        np.testing.assert_allclose(turned.apply([0, 0, 1]), [0, 0, -1], atol=1e-5)
        assert found["/tf"][0]["rotation"] == pose["pose"]["orientation"]
        with (tmp_path / NAME).open("rb") as file:
            [metadata] = make_reader(file).iter_metadata()
        assert json.loads(metadata.metadata["origin"]) == products.frame.origin.tolist()

    def test_the_quota_is_kept_by_deleting_the_previous_run_first(self, tmp_path: Path) -> None:
        cloud = np.zeros(2000, CLOUD_DTYPE)
        cloud["x"] = np.random.default_rng(2).random(2000)
        quota = 1_000_000
        for _ in range(2):
            writer = LiveMcap(tmp_path, quota, {})
            written = 0
            while writer.add_cloud("/points/left", cloud, SECOND_NS, SECOND_NS) and written < 10:
                written += 1
            writer.close()
        assert (tmp_path / PREVIOUS).exists()
        writer = LiveMcap(tmp_path, quota, {})
        added = sum(writer.add_cloud("/points/left", cloud, SECOND_NS, SECOND_NS) for _ in range(200))
        assert writer.is_full
        assert not writer.add_cloud("/points/left", cloud, SECOND_NS, SECOND_NS)
        writer.close()
        assert not (tmp_path / PREVIOUS).exists()
        assert 0.5 * quota < (tmp_path / NAME).stat().st_size <= quota
        assert len(read_back(tmp_path / NAME)["/points/left"]) == added < 200
        assert quota > 2 * END_BYTES

    def test_messages_that_are_not_written_are_counted(self, tmp_path: Path) -> None:
        products = LiveProducts(tmp_path, LiveConfig(), Utm(), 1 << 60, "EPSG:32632")
        trajectory = flight()
        products.look_for_room()
        assert products.trouble.startswith("free space is down to ")
        products.begin(trajectory)
        products.take("left", points_at(Utm().map_from_e(trajectory.position_e)), trajectory, SECOND_NS)
        products.save_coverage({})
        products.close()
        assert (products.points["left"], products.grid.points, products.shown) == (11, 11, 0)
        assert products.unwritten == 1
        assert list(tmp_path.iterdir()) == []

    def test_writing_resumes_slightly_above_the_limit_at_which_it_stopped(self, tmp_path: Path) -> None:
        room = Room(tmp_path, 0)
        assert room.look()
        free = room.free_bytes
        room.least_bytes = 2 * free
        assert not room.look()
        room.least_bytes = int(room.free_bytes / 1.02)
        assert not room.look()
        room.least_bytes = int(room.free_bytes / 1.2)
        assert room.look()


class TestThinning:
    def test_at_most_the_given_number_a_second_is_kept_evenly(self) -> None:
        rng = np.random.default_rng(3)
        times = np.sort(GPS_NS + rng.integers(0, 5 * SECOND_NS, 40_000))
        keep = Thinning(1000).keep(times)
        seconds = (times[keep] - GPS_NS) // SECOND_NS
        counts = np.bincount(seconds)
        assert counts.max() <= 1000
        assert counts[1:].min() > 800
        middle = times[keep][seconds == 2]
        assert np.diff(middle).max() < 10_000_000, "no hole in a second"

    def test_thinning_does_not_depend_on_blocks(self) -> None:
        rng = np.random.default_rng(4)
        times = GPS_NS + np.cumsum(rng.integers(0, 300_000, 30_000))
        whole = Thinning(500).keep(times)
        rule, pieces, first = Thinning(500), [], 0
        while first < len(times):
            step = int(rng.integers(1, 2000))
            pieces.append(first + rule.keep(times[first : first + step]))
            first += step
        np.testing.assert_array_equal(np.concatenate(pieces), whole)

    def test_few_points_are_all_kept(self) -> None:
        times = GPS_NS + np.arange(3000, dtype=np.int64) * 1_000_000
        assert Thinning(2000).keep(times).tolist()[-2000:] == list(range(1000, 3000))


class TestGrid:
    def test_counts_match_numpy(self) -> None:
        rng = np.random.default_rng(5)
        points = rng.uniform(-700, 900, (50_000, 3))
        grid = CountGrid(2.5)
        for piece in np.array_split(points, 7):
            grid.add(piece)
        image, west, north, cell = grid.image(10_000)
        rows, columns = image.shape
        assert cell == 2.5
        expected, _, _ = np.histogram2d(
            points[:, 1],
            points[:, 0],
            bins=[rows, columns],
            range=[[north - rows * cell, north], [west, west + columns * cell]],
        )
        np.testing.assert_array_equal(image, expected[::-1])
        numbers = grid.numbers()
        covered = expected[expected > 0]
        assert numbers["covered_m2"] == pytest.approx(covered.size * 6.25, abs=0.051)
        assert numbers["density_per_m2"]["mean"] == pytest.approx(covered.mean() / 6.25, abs=1e-3)
        assert numbers["density_per_m2"]["p50"] == pytest.approx(np.median(covered) / 6.25, abs=0.17)

    def test_memory_is_bounded_and_coarser_cells_are_the_sums(self) -> None:
        rng = np.random.default_rng(6)
        points = rng.uniform(-1000, 3000, (60_000, 3))
        few, enough = CountGrid(1.0, tiles=16), CountGrid(4.0)
        few.add(points)
        enough.add(points)
        assert few.cell_m == 4.0
        assert few.numbers() == enough.numbers()
        for limit in (10_000, TILE):
            ours, theirs = few.image(limit), enough.image(limit)
            np.testing.assert_array_equal(ours[0], theirs[0])
            assert ours[1:] == theirs[1:]
            assert max(ours[0].shape) <= max(limit, 2 * TILE)
            assert ours[0].sum() == len(points)

    def test_a_single_distant_point_does_not_enlarge_the_image(self) -> None:
        """A wrong first position would otherwise draw 137 million cells for 6 s, every 10 s."""
        grid = CountGrid(1.0)
        grid.add(np.array([[0.5, 0.5, 0.0], [5.5, 5.5, 0.0], [3e6 + 0.5, -3e6 + 0.5, 0.0]]))
        image, west, north, cell = grid.image(IMAGE_CELLS)
        assert max(image.shape) <= IMAGE_CELLS
        assert image.sum() == 3
        for east_m, north_m, count in ((1.0, 1.0, 2), (3e6, -3e6 + 1.0, 1)):
            assert image[int((north - north_m) // cell), int((east_m - west) // cell)] == count

    def test_non_finite_points_are_refused(self) -> None:
        grid = CountGrid(1.0)
        grid.add(np.array([[np.nan, 0, 0], [np.inf, 0, 0], [1e30, 0, 0], [0, 0, np.nan], [-0.5, -0.5, 0]]))
        assert (grid.points, grid.refused) == (5, 3)
        assert grid.image(100)[0].sum() == 2
        assert CountGrid(1.0).image(100)[0].size == 0


class TestPicture:
    def test_picture_is_a_png_with_the_colours_of_densities(self) -> None:
        counts = np.array([[0, 2, 4], [15, 400, 0]], dtype=np.uint64)
        image = Image.open(io.BytesIO(picture(counts, 2.0)))
        assert image.size == (3, 2)
        pixels = np.asarray(image.convert("RGBA"))
        assert [f"{r:02x}{g:02x}{b:02x}" for r, g, b, _ in pixels.reshape(-1, 4)[[1, 2, 3, 4]]] == [
            "5a0f1e",
            "b0282e",
            "e8743b",
            "1f5f8b",
        ]
        assert pixels[..., 3].tolist() == [[0, 255, 255], [255, 255, 0]]
