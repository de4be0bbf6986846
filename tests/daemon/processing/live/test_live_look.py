"""Tests what `swath live` says about the last moments, over a made-up flight whose ground is known."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest

from swath.daemon.config.tables import LiveConfig
from swath.daemon.processing.live.look import PROFILE, RECENT, RECENT_POINTS, LastLook, read_recent
from swath.daemon.processing.live.products import LiveProducts
from swath.daemon.processing.live.status import fix_in_words
from swath.georef.records import FixType, GnssFix, TimeScale, TimeTag
from swath.georef.timescales.gps_time import SECOND_NS
from tests.daemon.processing.live.builders import GPS_NS, HEIGHT_M, LAT_DEG, LON_DEG, Utm, flight, points_at

pytestmark = pytest.mark.xdist_group("kernels")

NO_HEIGHTS = np.zeros((0, 3), np.int64)
STRIPS = np.array([[GPS_NS, GPS_NS + 900 * SECOND_NS, 5]])


def nothing(places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return that there are no earlier strips."""
    return np.full(len(places), np.nan), np.zeros(len(places), np.int64)


def looked(seconds: float = 4.0, *, forward_m: float = 0.0) -> LastLook:
    """Return a look at level flight to the north at 50 m/s, 300 m above ground that rises by 0.1 to the east."""
    look, rng = LastLook(), np.random.default_rng(1)
    for tenth in range(round(10 * seconds)):
        t = tenth / 10 + np.arange(2000) / 20_000
        across = 120.0 * np.sin(2 * np.pi * 50.0 * t)
        cloud = np.zeros((len(t), 4), np.float32)
        cloud[:, 0], cloud[:, 1] = 1000.0 + across, 50.0 * t + forward_m
        cloud[:, 2], cloud[:, 3] = 0.1 * across, 7.0
        points = points_at(np.zeros((len(t), 3)), GPS_NS + np.rint(t * SECOND_NS).astype(np.int64))
        points.return_number[rng.random(len(t)) < 0.25] = 2
        points.range_m[:] = np.hypot(across, 300.0)
        look.take_pose(GPS_NS + tenth * SECOND_NS // 10, np.array([1000.0, 5.0 * tenth, 300.0]))
        look.take("left", points, np.arange(len(t)), cloud)
    return look


def test_the_ground_is_seen_from_the_points_nearest_to_the_vertical() -> None:
    found = looked().ground()["left"]
    assert found["height_above_ground_m"] == pytest.approx(300.0, abs=1.0)
    assert found["nadir_range_m"] == pytest.approx(300.0, abs=1.0)
    assert found["returns_per_pulse"] == pytest.approx(1 / 0.75, abs=0.02)
    assert found["intensity_mean"] == 7.0
    slanted = looked(forward_m=200.0).ground()["left"]
    assert slanted["height_above_ground_m"] == pytest.approx(300.0, abs=5.0)
    assert slanted["nadir_range_m"] is None
    silent = looked()
    silent.take_pose(GPS_NS + 9 * SECOND_NS, np.array([1000.0, 450.0, 300.0]))
    assert silent.ground() == {}


def test_a_profile_lies_across_track_and_shows_earlier_strips() -> None:
    def earlier(places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        up = 0.1 * (places[:, 0] - 1000.0) + 0.05
        return np.where(places[:, 0] > 1050.0, up, np.nan), np.full(len(places), 3)

    found = looked().profile(STRIPS, earlier)
    assert found is not None
    assert found["gps_ns"] == pytest.approx(GPS_NS + 2.9 * SECOND_NS, abs=0.1 * SECOND_NS)
    assert (found["track_deg"], found["east_m"]) == (0.0, 1000.0)
    assert set(found["strips"]) == {"3", "5"}
    own, before = (found["strips"][number] for number in ("5", "3"))
    np.testing.assert_allclose(own["up_m"], 0.1 * np.array(own["across_m"]), atol=0.002)
    assert max(own["across_m"]) > 100.0 > -100.0 > min(own["across_m"])
    np.testing.assert_allclose(before["up_m"], 0.1 * np.array(before["across_m"]) + 0.05, atol=0.002)
    assert min(before["across_m"]) > 50.0
    assert LastLook().profile(STRIPS, earlier) is None


def test_a_minute_of_points_stays_within_its_number() -> None:
    """The layout is that of docs/live.md, read here by the offsets stated there."""
    look = looked(70.0)
    data = look.recent(STRIPS)
    rows, first_ns = read_recent(data)
    assert RECENT_POINTS * 0.8 < len(rows) <= RECENT_POINTS
    seconds = (first_ns - GPS_NS) / SECOND_NS + rows["seconds"]
    assert 9.0 < seconds.min() < 11.0
    assert seconds.max() > 69.9
    assert np.bincount(seconds.astype(int))[10:].min() > 500
    np.testing.assert_allclose(rows["north"], 50.0 * seconds, atol=0.01)
    assert set(rows["strip"]) == {5}
    head = struct.unpack_from("<4sHHIIq", data)
    assert head == (b"SWTR", 1, 24, 24, len(rows), first_ns)
    assert struct.unpack_from("<5fHBB", data, 24)[3:] == (7.0, 0.0, 5, 0, rows["return_number"][0])
    assert len(read_recent(LastLook().recent(NO_HEIGHTS))[0]) == 0
    for wrong in (b"", data[:-1], b"X" + data[1:]):
        with pytest.raises(ValueError, match="recent points"):
            read_recent(wrong)


def test_pose_and_last_moments_are_written(tmp_path: Path) -> None:
    trajectory = flight(41)
    products = LiveProducts(tmp_path, LiveConfig(), Utm(), 0, "EPSG:32632")
    assert products.pose() is None
    position = Utm().map_from_e(trajectory.position_e)
    for last in range(2, 42, 3):
        part = trajectory.between(GPS_NS, int(trajectory.time_ns[last - 1]) - 1)
        ground = position[len(part) - 1] + np.random.default_rng(last).uniform(-40, 40, (400, 3))
        times = int(part.time_ns[-1]) + np.arange(400, dtype=np.int64)
        products.take("left", points_at(ground, times), part, last * SECOND_NS // 10)
        products.take_pose(part, last * SECOND_NS // 10)
        products.save_map({}, last * SECOND_NS // 10)
    products.close()
    pose = products.pose()
    assert pose is not None
    assert products.frame is not None
    assert (pose["lon_deg"], pose["height_m"]) == pytest.approx((LON_DEG, HEIGHT_M), abs=1e-6)
    assert pose["lat_deg"] > LAT_DEG
    place = np.array([pose[key] for key in ("east_m", "north_m", "up_m")]) + products.frame.origin
    np.testing.assert_allclose(place, position[len(part) - 1], atol=0.002)
    assert (pose["heading_deg"], pose["track_deg"], pose["speed_mps"]) == pytest.approx((45.0, 0.0, 60.0), abs=0.01)
    # grid north differs from true north by the convergence, dλ sin φ (Snyder 8)
    convergence_deg = (LON_DEG - 9.0) * np.sin(np.radians(LAT_DEG))
    assert pose["map_heading_deg"] == pytest.approx(45.0 - convergence_deg, abs=0.001)
    assert (pose["roll_deg"], pose["pitch_deg"]) == pytest.approx((0.0, 0.0), abs=1e-3)
    assert pose["sigma_m"] == [0.02, 0.03, 0.05]
    assert json.loads((tmp_path / PROFILE).read_text())["track_deg"] == pytest.approx(-convergence_deg % 360, abs=0.1)
    assert len(read_recent((tmp_path / RECENT).read_bytes())[0]) > 1000


def test_a_position_is_told_with_what_the_receiver_gives() -> None:
    tag = TimeTag(TimeScale.GPS, 0)
    covariance = np.diag([0.0001, 0.0004, 0.0009])
    fix = GnssFix(SECOND_NS, tag, 0.8, 0.1, 500.0, None, covariance, fix_type=FixType.RTK_FIXED, satellites=17)
    assert fix_in_words(fix, SECOND_NS + 1_234_000_000) == {
        "fix": "rtk_fixed", "valid": True, "satellites": 17, "sigma_m": [0.01, 0.02, 0.03], "age_s": 1.234,
    }  # fmt: skip
    bare = fix_in_words(GnssFix(0, tag, 0.8, 0.1, None, valid=False), 0)
    assert (bare["fix"], bare["valid"], bare["satellites"], bare["sigma_m"]) == ("none", False, None, None)
