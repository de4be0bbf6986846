"""Tests that `swath live` shows metres and level axes, whatever the output's unit."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyproj import CRS, Transformer
from scipy.spatial.transform import Rotation

from swath.daemon.config.tables import LiveConfig
from swath.daemon.processing.live.frame import LocalFrame
from swath.daemon.processing.live.mcap import NAME
from swath.daemon.processing.live.points import PointsFile
from swath.daemon.processing.live.products import LiveProducts, Room
from swath.daemon.processing.live.tiles import Placement
from swath.georef.timescales.gps_time import SECOND_NS
from tests.daemon.processing.live.builders import HEIGHT_M, LAT_DEG, LON_DEG, Utm, flight, points_at, read_back

pytestmark = pytest.mark.xdist_group("kernels")

FEET = CRS.from_proj4("+proj=utm +zone=32 +datum=WGS84 +units=us-ft +type=crs").to_wkt()
FOOT_M = 1200.0 / 3937.0  # US survey foot, by its definition


class TestFrame:
    def test_a_frame_without_a_mapping_is_level_at_the_first_position(self) -> None:
        trajectory = flight()
        frame = LocalFrame(trajectory.position_e[0], None)
        east, north, up = frame.of_points(trajectory.position_e)[-1]
        assert (east, up) == (pytest.approx(0, abs=1e-3), pytest.approx(0, abs=1e-3))
        assert north == pytest.approx(60.0 * np.sqrt(0.5), rel=2e-3)
        _, q = frame.pose_of(trajectory.position_e[0], trajectory.q_e_from_b[0])
        nose = Rotation.from_quat(np.roll(q, -1)).apply([1, 0, 0])
        np.testing.assert_allclose(nose, [np.sqrt(0.5), np.sqrt(0.5), 0], atol=1e-9)

    @pytest.mark.parametrize("maps", [Utm(), None], ids=["UTM", "level"])
    def test_polynomials_place_the_map_by_latitude_and_longitude(self, maps: Utm | None) -> None:
        """PROJ maps places within 30 km; readers of the map do without it."""
        trajectory = flight()
        frame = LocalFrame(trajectory.position_e[0], maps)
        index = json.loads(json.dumps({"placement": frame.placement()}))
        placement = Placement.of(index)
        assert placement is not None
        rng = np.random.default_rng(3)
        lat_lon = np.array([LAT_DEG, LON_DEG]) + rng.uniform((-0.27, -0.4), (0.27, 0.4), (200, 2))
        position_e = np.stack(
            Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True).transform(
                lat_lon[:, 1], lat_lon[:, 0], np.full(200, HEIGHT_M)
            ),
            axis=-1,
        )
        local = frame.of_points(position_e if maps is None else maps.map_from_e(position_e))[:, :2]
        assert np.abs(local).max() > 25_000
        np.testing.assert_allclose(placement.local(lat_lon), local, rtol=0, atol=0.1)
        np.testing.assert_allclose(placement.geodetic(local), lat_lon, rtol=0, atol=1e-6)
        assert index["placement"]["misfit_m"] < 0.2
        for wrong in ({}, {"placement": None}, {"placement": {**index["placement"], "to_local": [[1.0]]}}):
            assert Placement.of(wrong) is None

    def test_a_frame_in_feet_is_converted_to_metres(self, tmp_path: Path) -> None:
        """The same points in UTM metres and in UTM feet give the same cells, clouds and poses."""
        trajectory = flight()
        told: list[tuple[Any, ...]] = []
        for maps in (Utm(), Utm(FEET, (FOOT_M, FOOT_M, 1.0))):
            (folder := tmp_path / str(len(told))).mkdir()
            products = LiveProducts(folder, LiveConfig(cell_m=1.0), maps, 0, "here")
            products.look_for_room()
            products.begin(trajectory)
            assert products.frame is not None
            products.frame.origin = maps.map_from_e(trajectory.position_e[:1])[0]  # not a round number in either unit
            ground = Utm().map_from_e(trajectory.position_e)[-1]
            ground = ground + np.random.default_rng(8).uniform(-400, 400, (5000, 3))
            products.take("left", points_at(ground / maps.unit_m), trajectory, 77 * SECOND_NS)
            products.take_pose(trajectory, 78 * SECOND_NS)
            products.close()
            found = read_back(folder / NAME)
            cloud = np.frombuffer(found["/points/left"][0]["data"], np.float32).reshape(-1, 4)
            pose = found["/pose"][0]["pose"]
            values = [pose[part].get(axis, 0.0) for part in ("position", "orientation") for axis in "xyzw"]
            told.append((products.map.grid.numbers(), cloud, values, products.origin()["origin_unit_m"]))
        assert told[0][0] == told[1][0]
        assert told[0][0]["density_per_m2"]["mean"] == pytest.approx(1.0, abs=0.1)
        np.testing.assert_allclose(told[1][1], told[0][1], rtol=0, atol=1e-3)
        np.testing.assert_allclose(told[1][2], told[0][2], rtol=0, atol=1e-6)
        assert [one[3] for one in told] == [[1.0, 1.0, 1.0], [FOOT_M, FOOT_M, 1.0]]

    def test_an_earth_centred_output_gets_a_level_frame(self) -> None:
        trajectory = flight()
        plain = LocalFrame(trajectory.position_e[0], None)
        frame = LocalFrame(trajectory.position_e[0], Utm("EPSG:4978"))
        keep = np.arange(0, 11, 2)
        np.testing.assert_allclose(
            frame.of_points(trajectory.position_e), plain.of_points(trajectory.position_e), atol=1e-8
        )
        cloud = frame.cloud_of(points_at(trajectory.position_e), keep)
        np.testing.assert_allclose(cloud["y"], plain.of_points(trajectory.position_e)[keep, 1], atol=1e-5)
        assert cloud["intensity"].tolist() == keep.tolist()
        for one, other in zip(
            frame.pose_of(trajectory.position_e[3], trajectory.q_e_from_b[3]),
            plain.pose_of(trajectory.position_e[3], trajectory.q_e_from_b[3]),
            strict=True,
        ):
            np.testing.assert_allclose(one, other, atol=1e-8)

    def test_attitudes_match_scipy(self) -> None:
        """If a map stretches east and north by two and more, the rotation is the one nearest to its steps."""
        rng = np.random.default_rng(9)
        position_e = flight().position_e[0]
        half_turns = [Rotation.from_rotvec(np.pi * axis) for axis in np.eye(3)]
        others = [Rotation.random(random_state=int(rng.integers(1 << 30))) for _ in range(40)]
        for k, turned in enumerate([*half_turns, *half_turns[::-1], *others]):
            stretch = np.diag([1.0, 1.0, 1.0] if k % 2 else [2.3, 2.3, 1.0])
            frame = LocalFrame(position_e, None)
            frame._rot_points_from_enu = stretch  # replaces the axes east, north, up of the frame
            _, q = frame.pose_of(position_e, np.roll(turned.as_quat(), 1))
            expected = np.roll(turned.as_quat(), 1)
            np.testing.assert_allclose(q * np.sign(q @ expected), expected, rtol=0, atol=1e-8)
            assert q[0] >= 0.0


class TestPointsFile:
    def test_points_file_is_one_array_for_numpy(self, tmp_path: Path) -> None:
        points = points_at(np.random.default_rng(7).random((10, 3)))
        file = PointsFile(tmp_path / "p.npy", ["right", "left"])
        file.add("right", points.take(slice(0, 4)))
        file.add("left", points.take(slice(4, None)))
        file.close()
        rows = np.load(tmp_path / "p.npy")
        np.testing.assert_array_equal(rows["points_map"], points.points_map)
        np.testing.assert_array_equal(rows["scanner"], [1] * 4 + [0] * 6)
        assert len(rows) == file.count == 10

    def test_points_file_ends_when_the_recorder_needs_the_space(self, tmp_path: Path) -> None:
        points = points_at(np.random.default_rng(7).random((10, 3)))
        room = Room(tmp_path, 0)
        file = PointsFile(tmp_path / "p.npy", ["left"], room)
        file.look_for_room()
        file.add("left", points)
        room.least_bytes = 1 << 60
        file.look_for_room()
        file.add("left", points)
        room.least_bytes = 0
        file.look_for_room()
        file.add("left", points)
        file.close()
        assert (file.count, file.left_out) == (10, 20), "a file with a hole in it would look whole"
        assert file.trouble.startswith("p.npy ends after 10 points: free space is down to ")
        np.testing.assert_array_equal(np.load(tmp_path / "p.npy")["points_map"], points.points_map)

    def test_a_full_disk_ends_points_beside_a_recorder_and_stops_a_replay(self, tmp_path: Path) -> None:
        points = points_at(np.zeros((10_000, 3)))
        file = PointsFile(Path("/dev/full"), ["left"], Room(tmp_path, 0))
        file.add("left", points)
        file.add("left", points)
        file.close()
        assert (file.count, file.left_out) == (0, 20_000)
        assert file.trouble == "full ends after 0 points: No space left on device"
        strict = PointsFile(Path("/dev/full"), ["left"])
        with pytest.raises(OSError, match="No space left"):
            strict.add("left", points)
        with pytest.raises(OSError, match="No space left"):
            strict.close()

    def test_a_removed_folder_does_not_stop_a_flight(self, tmp_path: Path) -> None:
        (folder := tmp_path / "live").mkdir()
        products = LiveProducts(folder, LiveConfig(), Utm(), 0, "EPSG:32632")
        file = PointsFile(tmp_path / "p.npy", ["left"], Room(folder, 0))
        folder.rmdir()
        products.look_for_room()
        file.look_for_room()
        trajectory = flight()
        assert products.trouble == f"{folder}: No such file or directory: nothing is written any more"
        products.begin(trajectory)
        products.take("left", points_at(Utm().map_from_e(trajectory.position_e)), trajectory, SECOND_NS)
        products.save_coverage({})
        products.close()
        file.close()
        assert file.trouble == "p.npy ends after 0 points: No such file or directory"
        assert products.points["left"] == 11
