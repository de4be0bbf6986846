"""Tests the pictures and messages of `swath live` with other readers, against numbers computed here."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

from swath.daemon.config.tables import LiveConfig
from swath.daemon.processing.live.grid import CellGrid
from swath.daemon.processing.live.mcap import CLOUD_DTYPE, END_BYTES, NAME, PREVIOUS, LiveMcap, cloud_message
from swath.daemon.processing.live.painting import HERE, IMAGE_CELLS, METRES, picture
from swath.daemon.processing.live.products import LiveProducts, Room, Thinning
from swath.daemon.processing.live.tiles import SIDE
from swath.georef.timescales.gps_time import SECOND_NS
from tests.daemon.processing.live.builders import (
    GPS_NS,
    HEIGHT_M,
    LAT_DEG,
    LON_DEG,
    Utm,
    flight,
    points_at,
    read_back,
    read_map,
)

pytestmark = pytest.mark.xdist_group("kernels")


def added(writer: LiveMcap, cloud: NDArray[Any]) -> bool:
    """Add a cloud to a file; return whether it was written."""
    message = cloud_message(cloud, SECOND_NS)
    return writer.add("/points/left", message.get_schema(), message.encode(), SECOND_NS)


# ---------------------------------------------------------------------- protobuf, by the schema in the file


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
            "/coverage": "foxglove.Grid",
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
        # heading is 45° from true north, which differs from grid north by the convergence, dλ sin φ (Snyder 8)
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
            while added(writer, cloud) and written < 10:
                written += 1
            writer.close()
        assert (tmp_path / PREVIOUS).exists()
        writer = LiveMcap(tmp_path, quota, {})
        count = sum(added(writer, cloud) for _ in range(200))
        assert writer.is_full
        assert not added(writer, cloud)
        writer.close()
        assert not (tmp_path / PREVIOUS).exists()
        assert 0.5 * quota < (tmp_path / NAME).stat().st_size <= quota
        assert len(read_back(tmp_path / NAME)["/points/left"]) == count < 200
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
        assert (products.points["left"], products.map.grid.points, products.shown) == (11, 11, 0)
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
        grid = CellGrid(2.5)
        for piece in np.array_split(points, 7):
            grid.add(points_at(piece), HERE, METRES)
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

    def test_memory_is_bounded_and_coarser_cells_are_those_of_a_coarse_grid(self, tmp_path: Path) -> None:
        rng = np.random.default_rng(6)
        points = rng.uniform(-1000, 1000, (60_000, 3)) * (1.0, 1.0, 0.1)
        few, enough = CellGrid(1.0, tiles=16), CellGrid(4.0)
        for grid in (few, enough):
            for piece in np.array_split(points, 3):
                grid.add(points_at(piece), HERE, METRES)
        assert few.cell_m == 4.0
        assert few.numbers() == enough.numbers()
        for limit in (10_000, SIDE):
            ours, theirs = few.image(limit), enough.image(limit)
            np.testing.assert_array_equal(ours[0], theirs[0])
            assert ours[1:] == theirs[1:]
            assert max(ours[0].shape) <= max(limit, 2 * SIDE)
            assert ours[0].sum() == len(points)
        one, other = (read_map(tmp_path / name, grid) for name, grid in (("few", few), ("enough", enough)))
        for name, values in one.items():
            within = 0.011 if name.endswith("_m") else 0  # bases differ, and are rounded to centimetres
            np.testing.assert_allclose(values, other[name], rtol=0, atol=within, err_msg=name)

    def test_a_single_distant_point_does_not_enlarge_the_image(self) -> None:
        """A wrong first position would otherwise draw 137 million cells for 6 s, every 10 s."""
        grid = CellGrid(1.0)
        points = np.array([[0.5, 0.5, 0.0], [5.5, 5.5, 0.0], [3e6 + 0.5, -3e6 + 0.5, 0.0]])
        grid.add(points_at(points), HERE, METRES)
        image, west, north, cell = grid.image(IMAGE_CELLS)
        assert max(image.shape) <= IMAGE_CELLS
        assert image.sum() == 3
        for east_m, north_m, count in ((1.0, 1.0, 2), (3e6, -3e6 + 1.0, 1)):
            assert image[int((north - north_m) // cell), int((east_m - west) // cell)] == count

    def test_non_finite_points_are_refused(self) -> None:
        grid = CellGrid(1.0)
        points = np.array([[np.nan, 0, 0], [np.inf, 0, 0], [1e30, 0, 0], [0, 0, np.nan], [-0.5, -0.5, 0]])
        grid.add(points_at(points), HERE, METRES)
        assert (grid.points, grid.refused) == (5, 4)
        assert grid.image(100)[0].sum() == 1
        assert CellGrid(1.0).image(100)[0].size == 0


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
